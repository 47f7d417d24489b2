"""The checks themselves: every built-in method passes, and each lie that an integrator can tell is caught."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
import torch

from sympflow import HamiltonianSystem, available, get
from sympflow.arrays import concatenate, per_state, to_numpy
from sympflow.integrators import checks_of_steps
from sympflow.integrators.base import FixedStep, Outcome
from sympflow.integrators.checks import CHECKS, check_integrator, parametrize_with_checks
from sympflow.integrators.tableaux import ADAPTIVE
from sympflow.integrators.torchdiffeq_methods import MULTISTEP

NO_STEP = {check.__name__ for check in checks_of_steps.ALL} - {"the_order_is_the_slope"}


def not_applicable(integrator):
    """The checks that have nothing to check, from what a method is."""
    name, skipped = integrator.name, set()
    if not integrator.symplectic:
        skipped.add("the_inverse_undoes_the_step")
    if integrator.trained:
        skipped.add("the_order_is_the_slope")
    if name == "mlp":
        skipped.add("both_directions")
    if name in ("rk45", "dop853") or integrator.tangent_holds:
        skipped.add("dtype_device_and_gradient_of_tensors")
    if name in MULTISTEP:
        skipped |= NO_STEP
    if integrator.tangent_holds or name in ("adaptive_heun", "fehlberg2"):
        skipped.add("the_tangent_is_the_derivative_of_the_step")
    return skipped


@pytest.mark.parametrize("name", available())
@pytest.mark.filterwarnings("ignore:Functional iteration did not converge")
def test_built_in_methods_pass_and_skip_only_what_has_no_meaning(name):
    integrator = get(name)(**({"rtol": 1e-5, "atol": 1e-7} if name in ADAPTIVE else {}))
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
    assert list(report.skipped) == ["the_inverse_undoes_the_step"]
    assert "has no exact inverse" in report.skipped["the_inverse_undoes_the_step"]
    assert "passed   declarations\n" in str(report)
    assert str(report).splitlines()[-1].startswith("skipped  the_inverse_undoes_the_step: `method`")
    assert set(report) | set(report.skipped) == {check.name for check in CHECKS}


def with_numpy_only(self, system, t, y, h):
    """A step that neither takes tensors nor says so."""
    d, h = system.ndof, per_state(np.asarray(h), y)
    q, p = np.asarray(y)[..., :d], np.asarray(y)[..., d:]
    p = p + h * system.force(q)
    return np.concatenate([q + h * system.velocity(p), p], axis=-1)


def numpy_only_and_says_so(self, system, t, y, h):
    if not isinstance(y, np.ndarray):
        raise TypeError("`y0` must be an array.")
    return with_numpy_only(self, system, t, y, h)


def heun(self, system, t, y, h):
    h = np.asarray(per_state(h, y))
    k = np.asarray(system(t, y))
    return y + h / 2 * (k + np.asarray(system(t, y + h * k)))


def test_what_runs_on_arrays_alone_is_judged_all_the_same():
    """By finite differences of the step, since it cannot be differentiated."""
    check_integrator(lying(step=with_numpy_only))
    report = check_integrator(lying(step=numpy_only_and_says_so))
    assert "symplecticity_as_declared" in report.passed
    assert "it takes no tensors" in report.skipped["dtype_device_and_gradient_of_tensors"]
    assert "volume and symplecticity cannot be measured" in report.skipped["the_tangent_is_the_derivative_of_the_step"]

    def unaware_heun(self, system, t, y, h):
        return heun(self, system, t, numpy_only_and_says_so(self, system, t, y, 0 * h) * 0 + y, h)

    with pytest.raises(AssertionError, match=r"^symplecticity_as_declared of .*declared symplectic, but AᵀJA − J is"):
        check_integrator(lying(step=unaware_heun, order=2))


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
        ({"step": leaves_the_graph}, r"^dtype_device_and_gradient_of_tensors of .*it raised RuntimeError: Can't call"),
    ],
)
def test_lies_are_caught(lie, message):
    with pytest.raises(AssertionError, match=message):
        check_integrator(lying(**lie))


def test_nan_is_seen_by_the_step_alone():
    with pytest.raises(AssertionError, match=r"^what_is_not_finite_stays_so of .*a step from nan is finite"):
        {check.name: check for check in CHECKS}["what_is_not_finite_stays_so"](lying(step=hides_nan)())


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


def test_a_method_that_does_not_apply_to_the_system_is_refused():
    with pytest.raises(ValueError, match=r"^`method` 'verlet' needs a separable system"):
        check_integrator(get("verlet"), HamiltonianSystem.from_sympy("(p**2 + 1)*(q**2 + 1)/2", y0=[0.1, 0.2]))


def test_what_makes_no_integrator_is_refused():
    with pytest.raises(TypeError, match=r"^`factory` must make an Integrator; it made int"):
        check_integrator(lambda: 3)
    with pytest.raises(TypeError, match=r"^`factory` must be an integrator's class, .* got a str"):
        check_integrator("verlet")
    with pytest.raises(TypeError, match=r"^`system` must be a HamiltonianSystem; got str"):
        check_integrator(get("verlet"), "henon_heiles")
