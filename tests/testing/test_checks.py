"""The checks themselves: every built-in method passes, and each lie that an integrator can tell is caught."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import torch
from conftest import refusals

from sympflow import HamiltonianSystem, available, get, systems
from sympflow.arrays import concatenate, like, per_state, to_numpy
from sympflow.integrators.base import FixedStep, Outcome, OwnSteps
from sympflow.integrators.steppers import Stepper
from sympflow.integrators.tableaux import ADAPTIVE, MULTISTEP
from sympflow.testing import laws
from sympflow.testing.checks import CHECKS, check_integrator, parametrize_with_checks

NO_STEP = {check.__name__ for check in laws.OF_STEPS} - {"the_order_is_the_slope"}


def not_applicable(integrator):
    """The checks that have nothing to check, from what a method is."""
    name, skipped = integrator.name, set()
    if not integrator.symplectic or integrator.keeps:
        skipped.add("the_inverse_undoes_the_step")
    if integrator.trained:
        skipped.add("the_order_is_the_slope")
    if name == "mlp":
        skipped.add("both_directions")
    if name in ("rk45", "dop853") or integrator.tangent_holds:
        skipped.add("dtype_device_and_gradient_of_tensors")
    if name in MULTISTEP:
        skipped |= {*NO_STEP, "the_run_is_its_steps", "states_within_a_step_belong_to_it"}
    if integrator.tangent_holds or name in ("adaptive_heun", "fehlberg2"):
        skipped.add("the_tangent_is_the_derivative_of_the_step")
    if not integrator.takes_friction or integrator.trained:  # no flow of the default system has friction or a drive
        skipped.add("friction_is_in_the_steps")
    if not integrator.takes_driving or integrator.trained:
        skipped.add("the_drive_is_in_the_steps")
    return skipped


@pytest.mark.parametrize("name", [m for m in available() if getattr(get(m), "splitting", "") != "kepler"])
@pytest.mark.filterwarnings("ignore:Functional iteration did not converge")
def test_built_in_methods_pass_and_skip_only_what_has_no_meaning(name):
    loose = 1e-3 if name == "adaptive_heun" else 1e-4  # of order 2: else it takes many times the others' steps
    integrator = get(name)(**({"rtol": loose, "atol": loose / 100} if name in ADAPTIVE else {}))
    assert set(check_integrator(lambda: integrator).skipped) == not_applicable(integrator)


@dataclass(frozen=True)
class SymplecticEuler(FixedStep):
    """p += h F(q), then q += h ∇T(p)."""

    name: ClassVar[str] = "symplectic_euler"
    order: ClassVar[int | None] = 1
    symplectic: ClassVar[bool] = True

    def step(self, system, t, y, h):
        d, h = system.ndof, per_state(h, y)
        p = y[..., d:] + h * system.force(y[..., :d])
        return concatenate([y[..., :d] + h * system.velocity(p), p])


def lying(**lie):
    return dataclass(frozen=True)(type("Liar", (SymplecticEuler,), lie))


def test_a_new_integrator_passes_without_further_work():
    report = check_integrator(SymplecticEuler)
    assert {"the_order_is_the_slope", "events_are_zeros_of_the_dense_output"} <= set(report)
    untaken = ["friction_is_in_the_steps", "the_drive_is_in_the_steps"]
    assert list(report.skipped) == ["the_inverse_undoes_the_step", *untaken]
    assert "has no exact inverse" in report.skipped["the_inverse_undoes_the_step"]
    assert "passed   declarations\n" in str(report)
    assert str(report).splitlines()[-3].startswith("skipped  the_inverse_undoes_the_step: `method`")
    assert set(report) | set(report.skipped) == {check.name for check in CHECKS}


ARRAYS = "steps by NumPy: pass y0.numpy()"


def with_numpy_only(self, system, t, y, h):
    """A step that makes arrays of tensors."""
    d, h = system.ndof, per_state(np.asarray(h), y)
    q, p = np.asarray(y)[..., :d], np.asarray(y)[..., d:]
    p = p + h * system.force(q)
    return np.concatenate([q + h * system.velocity(p), p], axis=-1).astype(q.dtype)


def refuses_tensors(self, system, t, y, h):
    if not isinstance(y, np.ndarray):
        raise TypeError("`y0` must be an array.")
    return with_numpy_only(self, system, t, y, h)


def heun(self, system, t, y, h):
    h = np.asarray(per_state(h, y))
    k = np.asarray(system(t, y))
    return (y + h / 2 * (k + np.asarray(system(t, y + h * k)))).astype(y.dtype)


def test_what_runs_on_arrays_alone_is_judged_all_the_same():
    """By finite differences of the step, since it cannot be differentiated."""
    report = check_integrator(lying(step=with_numpy_only, arrays_only=ARRAYS))
    assert "symplecticity_as_declared" in report.passed
    assert "it takes NumPy arrays only, as it says" in report.skipped["dtype_device_and_gradient_of_tensors"]
    assert "volume and symplecticity cannot be measured" in report.skipped["the_tangent_is_the_derivative_of_the_step"]
    for undeclared in (with_numpy_only, refuses_tensors):
        with pytest.raises(AssertionError, match=r"^dtype_device_and_gradient_of_tensors .* or declare `arrays_only`"):
            check_integrator(lying(step=undeclared))
    overcautious = {"arrays_only": ARRAYS, "check_library": lambda *_: None}
    with pytest.raises(AssertionError, match=r"`arrays_only` is declared, but tensors are taken: leave it out"):
        laws.dtype_device_and_gradient_of_tensors(lying(**overcautious)(), laws.default_system())

    def unaware_heun(self, system, t, y, h):
        return heun(self, system, t, refuses_tensors(self, system, t, y, 0 * h) * 0 + y, h)

    with pytest.raises(AssertionError, match=r"^symplecticity_as_declared of .*declared symplectic, but AᵀJA − J is"):
        check_integrator(lying(step=unaware_heun, order=2, arrays_only=ARRAYS))


def forgets_the_short_step(self, problem):
    outcome = SymplecticEuler.run(self, problem)
    return Outcome(outcome.t[:-1], outcome.y[:-1], 0, outcome.message, outcome.stats, outcome.sol)


def writes_to_its_argument(self, system, t, y, h):
    if isinstance(y, np.ndarray):
        y *= 1.0000001
    return SymplecticEuler.step(self, system, t, y, h)


def mixes_the_lengths(self, system, t, y, h):
    """Takes the step length of the first state for all of a batch."""
    return SymplecticEuler.step(self, system, t, y, h if np.ndim(h) == 0 else h.reshape(-1)[0])


def hides_nan(self, system, t, y, h):
    result = SymplecticEuler.step(self, system, t, y, h)
    return np.nan_to_num(result, posinf=1e30, neginf=-1e30) if isinstance(y, np.ndarray) else result


def goes_forward_only(self, system, t, y, h):
    if np.any(to_numpy(h) < 0):
        raise ValueError("`h` must be positive.")
    return SymplecticEuler.step(self, system, t, y, h)


def verlet(self, system, t, y, h):
    return get("verlet")().step(system, t, y, h)


def leaves_the_graph(self, system, t, y, h):
    """Takes tensors, but not where they carry a gradient."""
    if isinstance(y, np.ndarray):
        return SymplecticEuler.step(self, system, t, y, h)
    return torch.from_numpy(SymplecticEuler.step(self, system, t, y.numpy(), np.asarray(h)))


def loses_gradients(self, system, t, y, h):
    return SymplecticEuler.step(self, system, t, y if isinstance(y, np.ndarray) else y.detach(), h)


def says_nothing(self, n_steps, n_saved, n_extra, backend):
    return {"force_evaluations": 0, "hessian_evaluations": 0}


def says_two(self, n_steps, n_saved, n_extra, backend):
    return {"force_evaluations": 2 * (n_steps + n_extra), "hessian_evaluations": 0}


def by_its_own_force(self, system, t, y, h):
    """Hénon–Heiles by heart: no function of the system is called."""
    q1, q2, h = y[..., :1], y[..., 1:2], per_state(h, y)
    p = y[..., 2:] - h * concatenate([q1 + 2 * q1 * q2, q2 + q1**2 - q2**2])
    return concatenate([y[..., :2] + h * p, p])


def wrong_tangent(self, system, t, y, h):
    return self.step(system, t, y, h), np.broadcast_to(np.eye(y.shape[-1]), (*y.shape, y.shape[-1])).copy()


def crashes(self, system, t, y, h):
    raise RuntimeError("some library failed")


def hides_failure(self, problem):
    outcome = SymplecticEuler.run(self, problem)
    outcome.status = np.abs(outcome.status) * 0
    return outcome


@pytest.mark.parametrize(
    ("lie", "message"),
    [
        ({"order": 2}, r"^the_order_is_the_slope of .*declared 2, measured 1"),
        ({"symplectic": False}, r"^symplecticity_as_declared .*declare `symplectic = True`"),
        ({"name": ""}, r"^declarations .*`name` must be a string"),
        ({"order": "first"}, r"^declarations .*`order` must be a count"),
        ({"step": lambda self, system, t, y, h: y * (1 + 0.01 * per_state(h, y))}, r"Liar"),
        ({"inverse": lambda self, system, t, y, h: y}, r"^the_inverse_undoes_the_step .*does not undo"),
        ({"run": forgets_the_short_step}, r"Liar"),
        ({"run": hides_failure}, r"^a_blow_up_is_status_minus_one"),
        ({"step": writes_to_its_argument}, r"Liar"),
        ({"step": verlet}, r"^the_order_is_the_slope of .*declared 1, measured 2"),
        ({"step": mixes_the_lengths}, r"^a_step_length_for_each_state of .*state 1 of a batch with its own h differs"),
        ({"step": hides_nan}, r"^(a_blow_up_is_status_minus_one|what_is_not_finite_stays_so) of "),
        ({"step": goes_forward_only}, r"^both_directions of .*it raised ValueError: `h` must be positive"),
        ({"tangent": wrong_tangent}, r"^the_tangent_is_the_derivative_of_the_step of .*finite differences"),
        ({"step": crashes}, r"^dtype_and_shape_of_arrays of .*it raised RuntimeError: some library failed"),
        (
            {"step": leaves_the_graph},
            r"^dtype_device_and_gradient_of_tensors of .*Can't call.*or declare `arrays_only`",
        ),
        ({"step": loses_gradients}, r"^dtype_device_and_gradient_of_tensors of .*loses the gradient of the tensors"),
        ({"evaluations": says_nothing}, r"^statistics of .*stats count no force: count them, or correct"),
        ({"evaluations": says_two}, r"^statistics of .*`evaluations` states 2 forces a step, but step\(\) evaluates 1"),
        ({"step": by_its_own_force}, r"^statistics of .*stats count no force"),
    ],
)
def test_lies_are_caught(lie, message):
    with pytest.raises(AssertionError, match=message):
        check_integrator(lying(**lie))


Verlet = get("verlet")


@dataclass(frozen=True)
class SoundVerlet(FixedStep):
    """Verlet as a third party writes it; the liars below derive from it, each correct but for one thing."""

    name: ClassVar[str] = "sound_verlet"
    order: ClassVar[int | None] = 2
    symplectic: ClassVar[bool] = True

    def step(self, system, t, y, h):
        return Verlet().step(system, t, y, h)


def unsound(**lie):
    return dataclass(frozen=True)(type("Liar", (SoundVerlet,), lie))


def rollout_of_verlet(self, problem, h, n_steps, save):
    return SoundVerlet(self.dt).rollout(problem, h, n_steps, save)


class EulerWithinSteps(Stepper):
    def shorter(self, y, h, t=0.0):
        return y + per_state(h, y) * self.system.vector_field(y)


def euler_within_steps(self, problem):
    return EulerWithinSteps(self, problem, OwnSteps(self, problem, None, True))


def identity_for_gradients(self, system, t, y, h):
    plain = SoundVerlet.step(self, system, t, y.detach() if isinstance(y, torch.Tensor) else y, h)
    return plain + (y - y.detach()) if isinstance(y, torch.Tensor) and y.requires_grad else plain


def other_steps(self, system, t_span, y0):
    for t, y, h in FixedStep.steps(self, system, t_span, y0):
        yield t, 1.1 * y, h


def hides_failures_of_batches(self, problem):
    outcome = FixedStep.run(self, problem)
    if np.ndim(outcome.status):
        outcome.status = np.zeros_like(outcome.status)
    return outcome


def clock_in_the_step(self, system, t, y, h):
    return SoundVerlet.step(self, system, t, y, h * (1 + 1e-3 * like(np.sin(to_numpy(t)), y)))


def first_event_only(self, problem):
    outcome = FixedStep.run(self, problem)
    if problem.events is not None:
        problem.events.found = [zeros[:1] for zeros in problem.events.found]
    return outcome


def upward_events_only(self, problem):
    if problem.events is not None:
        problem.events.events = tuple(replace(event, direction=1.0) for event in problem.events.events)
    return FixedStep.run(self, problem)


def no_backward_events(self, problem):
    outcome = FixedStep.run(self, problem)
    if problem.events is not None and problem.t1 < problem.t0:
        problem.events.found = [[] for _ in problem.events.found]
    return outcome


def saves_every_step(self, problem):
    return FixedStep.run(self, replace(problem, save_every=1))


def friction_far_out(self, system, t, y, h):
    y_next = SoundVerlet.step(self, system, t, y, h)
    far = (y * y).sum(-1) > 0.5
    return y_next * (1 - 1e-3 * (far.to(y.dtype) if torch.is_tensor(y) else np.asarray(far, y.dtype)))[..., None]


@pytest.mark.parametrize(
    ("lie", "message"),
    [
        (
            {
                "order": 6,
                "step": lambda self, system, t, y, h: get("kahan_li6")().step(system, t, y, h),
                "rollout": rollout_of_verlet,
            },
            r"^the_run_is_its_steps of .*step\(\) does not give the next state of the run",
        ),
        ({"stepper": euler_within_steps}, r"^(the_run_is_its_steps|states_within_a_step_belong_to_it) of "),
        ({"step": identity_for_gradients}, r"^dtype_device_and_gradient_of_tensors of .*differences of the run"),
        ({"steps": other_steps}, r"^the_run_is_its_steps of .*steps\(\) does not begin at y0"),
        ({"run": hides_failures_of_batches}, r"^a_batch_reports_its_failures of .*call for -1"),
        ({"step": clock_in_the_step}, r"^(the_run_is_its_steps|events_are_zeros_of_the_dense_output) of "),
        ({"run": first_event_only}, r"^every_event_is_found of .*1 events of direction 0"),
        ({"run": upward_events_only}, r"^every_event_is_found of .*events of direction 0"),
        ({"run": no_backward_events}, r"^every_event_is_found of .*0 events of direction 0 towards t = -2.03"),
        ({"run": saves_every_step}, r"^save_every_thins_the_outputs of .*reports other times"),
        (
            {"evaluations": lambda self, *counts: {"force_evaluations": -7, "hessian_evaluations": 0}},
            r"^statistics of .*a count of force_evaluations; they hold -7",
        ),
        ({"step": friction_far_out}, r"^symplecticity_as_declared of .*declared symplectic, but"),
    ],
)
def test_what_is_wrong_in_one_place_only_is_caught(lie, message):
    """Correct Verlet, but for what the bare step at t = 0 from ordinary states does not show."""
    with pytest.raises(AssertionError, match=message):
        check_integrator(unsound(**lie))


def test_the_sound_method_passes():
    assert len(check_integrator(SoundVerlet).passed) == len(CHECKS) - 3  # it says nothing of friction and drive


class Rk4(FixedStep):
    """The classical Runge–Kutta method, with each stage by `slope(system, t, y, c, h)`."""

    name: ClassVar[str] = "own_rk4"
    order: ClassVar[int | None] = 4
    takes_driving = takes_friction = True

    @staticmethod
    def slope(system, t, y, c, h):
        return system.vector_field(y, t + c * h)

    def step(self, system, t, y, h):
        s = per_state(h, y)
        k = self.slope(system, t, y, 0.0, h)
        total = k
        for c, weight in ((0.5, 2), (0.5, 2), (1.0, 1)):
            k = self.slope(system, t, y + c * s * k, c, h)
            total = total + weight * k
        return y + s / 6 * total


class LateDrive(Rk4):
    """One that takes the drive at the beginning of every step."""

    @staticmethod
    def slope(system, t, y, c, h):
        return system.vector_field(y, t + 0 * h)


class HalfFriction(Rk4):
    """One that adds friction after a step without it."""

    takes_friction = True

    def step(self, system, t, y, h):
        d, s = system.ndof, per_state(h, y)
        end = get("rk4")().step(laws.default_system() if system.friction else system, t, y, h)
        if not system.friction:
            return end
        return concatenate([end[..., :d], (1 - s * system.friction.largest) * end[..., d:]])


def test_the_order_with_a_drive_or_friction_is_measured():
    check = {check.name: check for check in CHECKS}
    for name in ("the_drive_is_in_the_steps", "friction_is_in_the_steps"):
        check[name](Rk4(dt=0.01))
    with pytest.raises(AssertionError, match=r"with a drive the order is 1\.\d\d, and 4 is declared"):
        check["the_drive_is_in_the_steps"](LateDrive(dt=0.01))
    with pytest.raises(AssertionError, match=r"with friction the order is [01]\.\d\d, and 4 is declared"):
        check["friction_is_in_the_steps"](HalfFriction(dt=0.01))


def test_what_does_not_apply_is_skipped_with_the_reason():
    names, cases = parametrize_with_checks([get("rk4")]).args
    assert names == ("integrator", "check")
    skipped = {}
    for case in cases:
        integrator, check = case.values
        try:
            check(integrator)
        except pytest.skip.Exception as reason:
            skipped[case.id] = str(reason)
    assert len(cases) == len(CHECKS)
    assert list(skipped) == ["rk4-the_inverse_undoes_the_step"]
    assert skipped["rk4-the_inverse_undoes_the_step"].startswith("`method` 'rk4' has no exact inverse")


NAMELESS = type("Nameless", (FixedStep,), {})
PRODUCT = HamiltonianSystem.from_sympy("(p**2 + 1)*(q**2 + 1)/2", y0=[0.1, 0.2])

test_refusals = refusals(
    (lambda: check_integrator(lambda: 3), TypeError, "^`factory` must make an Integrator; it made int"),
    (lambda: check_integrator("verlet"), TypeError, "^`factory` must be an integrator's class, .* got a str"),
    (lambda: check_integrator(Verlet, "henon_heiles"), TypeError, "^`system` must be a HamiltonianSystem; got str"),
    (lambda: check_integrator(Verlet, PRODUCT), "^`method` 'verlet' needs a separable system"),
    (lambda: check_integrator(Verlet, systems.damped_pendulum()), "has friction, .*: leave `system` out"),
    (lambda: check_integrator(Verlet, systems.driven_pendulum()), "is driven, .*: leave `system` out"),
    (lambda: parametrize_with_checks([NAMELESS]), TypeError, "^`factory` made a Nameless without `name`: set that"),
)
