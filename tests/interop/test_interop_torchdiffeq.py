"""Our methods inside torchdiffeq's `odeint` and `odeint_event`: the numbers of `solve`, and exact gradients."""

import gc
import weakref
from importlib import import_module

import numpy as np
import pytest
import torch
import torchdiffeq
from conftest import refusals

from sympflow import MLPFlow, SympFlow, available, get, solve, systems
from sympflow.integrators.base import FixedStep
from sympflow.integrators.tableaux import FIXED
from sympflow.interop.torchdiffeq import odeint, odeint_adjoint, odeint_dense, odeint_event, register

HH, PENDULUM, OSCILLATOR = systems.henon_heiles(), systems.pendulum(), systems.harmonic_oscillator()
EPS = np.finfo(float).eps
OURS = [
    name
    for name in available()
    if issubclass(get(name), FixedStep) and get(name).on_grid and name not in (*FIXED, "sympflow", "mlp")
    if getattr(get(name), "splitting", "") != "kepler"  # of planets
]
METHODS = [*OURS, "sympflow"]
KINDS = ["verlet", "leapfrog", "chin4a", "gauss_legendre4", "mollified_impulse", "linear_omelyan4", "strang_parts"]


def flow(seed=0, **options):
    """An untrained flow: all structure, no accuracy."""
    return SympFlow(1, hidden=(5,), dt=0.5, seed=seed, **options)


def times(*values):
    return torch.tensor(values, dtype=torch.float64)


def options(method):
    return {} if method == "sympflow" else {"dt": 0.1}


@pytest.mark.parametrize(
    ("method", "t"),
    [
        *((m, (0.5, 0.45, -2.0)) for m in METHODS),
        *((m, t) for m in [*KINDS, "sympflow"] for t in ((0.0, 0.25, 1.0, 3.7), (1.0,))),
    ],
)
def test_equal_solve(method, t):
    y = odeint(HH, torch.tensor(HH.y0), times(*t), method=method, options=options(method))
    sol = solve(HH, method, (t[0], t[-1]), t_eval=t, on_domain_exit="ignore", **options(method))
    np.testing.assert_allclose(y.numpy(), sol.y.T, atol=200 * EPS)


@pytest.mark.parametrize("method", [*KINDS, "sympflow"])
class TestValues:
    def test_batches_and_tuples(self, method):
        y0 = torch.tensor(HH.domain.sample(6, 1).reshape(2, 3, 4))
        t = times(0.0, 0.5, 1.0)
        y = odeint(HH, y0, t, method=method, options=options(method))
        assert y.shape == (3, 2, 3, 4)
        q, p = odeint(HH, (y0[..., :2], y0[..., 2:]), t, method=method, options=options(method))
        assert torch.equal(torch.cat([q, p], -1), y)
        one = odeint(HH, y0[1, 2], t, method=method, options=options(method))
        torch.testing.assert_close(y[:, 1, 2], one, rtol=0, atol=200 * EPS)


@pytest.mark.parametrize(
    ("method", "t"), [(name, ((0.0, 0.25, 0.31), (0.2, -0.13, -0.39))[i % 2]) for i, name in enumerate(KINDS)]
)
def test_gradients_to_y0_and_t(method, t):
    """At times between grid points, where ψ is smooth in t; a time on the grid has the slope of the step there."""
    y0 = torch.tensor(HH.domain.sample(2, 1), requires_grad=True)
    t = times(*t).requires_grad_(True)
    assert torch.autograd.gradcheck(lambda y, s: odeint(HH, y, s, method=method, options={"dt": 0.1}), (y0, t))


class TestEvents:
    @pytest.mark.parametrize("as_tuple", [False, True])
    def test_as_torchdiffeq_finds_it(self, as_tuple):
        y0 = torch.tensor(HH.y0)
        y0 = (y0[:2], y0[2:]) if as_tuple else y0

        def event_fn(t, y):
            q = y[0] if as_tuple else y[:2]
            return torch.stack([q[0] - 0.1, q[1] + 5.0, t - 50.0])  # the first of several

        ours = odeint_event(HH, y0, times(0.0)[0], event_fn=event_fn, method="kahan_li8")
        theirs = odeint_event(HH, y0, times(0.0)[0], event_fn=event_fn, method="dopri5", atol=1e-10, rtol=1e-10)
        torch.testing.assert_close(ours[0], theirs[0], rtol=0, atol=1e-8)
        torch.testing.assert_close(ours[1], theirs[1], rtol=0, atol=1e-8)

    @pytest.mark.parametrize("reverse", [False, True])
    @pytest.mark.parametrize("method", ["verlet", "rotation"])
    def test_the_first_zero(self, method, reverse, rotation):
        method = rotation if method == "rotation" else method
        t, y = odeint_event(
            OSCILLATOR, times(1.0, 0.0), times(0.3)[0], event_fn=lambda t, y: y[0], reverse_time=reverse, method=method
        )
        expected = 0.3 + (-1 if reverse else 1) * np.pi / 2
        assert float(t) == pytest.approx(expected, abs=1e-3 if method == "verlet" else 1e-13)
        assert y.shape == (2, 2)
        assert abs(float(y[1, 0])) < 1e-14

    @pytest.mark.parametrize("reverse", [False, True])
    def test_the_first_of_two_zeros_within_a_step_is_seen(self, rotation, reverse):
        """q grows from cos 0.45 to 1 and falls again: it passes 0.95 twice within Δt = 1."""
        y0 = times(np.cos(0.45), (-1 if reverse else 1) * np.sin(0.45)).repeat(2, 1)
        t, y = odeint_event(
            OSCILLATOR,
            y0,
            times(0.0)[0],
            event_fn=lambda t, y: 0.95 - y[..., 0].mean(),
            reverse_time=reverse,
            method=rotation,
        )
        assert abs(float(t)) == pytest.approx(0.45 - np.arccos(0.95), abs=1e-13)
        torch.testing.assert_close(y[1, :, 0], times(0.95, 0.95))

    @pytest.mark.parametrize("reverse", [False, True])
    @pytest.mark.slow
    def test_gradients_of_time_and_state(self, reverse):
        y0 = times(1.0, 0.2).requires_grad_(True)
        t0 = times(0.1)[0].requires_grad_(True)
        psi = flow(seed=3)

        def of_verlet(y, t):
            return odeint_event(
                PENDULUM, y, t, event_fn=lambda t, y: y[0] - 0.3 + 0.1 * t, reverse_time=reverse, method="verlet"
            )

        def of_flow(y, t, *weights):
            return odeint_event(PENDULUM, y, t, event_fn=lambda t, y: y[1] - 0.21, method=psi)

        assert torch.autograd.gradcheck(of_verlet, (y0, t0))
        crossed = odeint_event(PENDULUM, y0, t0, event_fn=lambda t, y: t - 0.83, method=psi)
        assert float(crossed[0].detach()) == pytest.approx(0.83)
        end = torch.autograd.gradcheck(
            lambda y, *w: odeint_event(PENDULUM, y, t0.detach(), event_fn=lambda t, y: t + y[0] - 1.9, method=psi),
            (y0, *psi.parameters()),
        )
        assert end

    @pytest.mark.parametrize("unit", [1e-170, 1e-300, 1e300])
    def test_the_unit_of_the_event_function_does_not_matter(self, unit):
        found = [
            odeint_event(HH, torch.tensor(HH.y0), times(0.0)[0], event_fn=lambda t, y, c=c: y[0] * c, method="verlet")
            for c in (1.0, unit)
        ]
        torch.testing.assert_close(found[0][0], found[1][0], rtol=1e-14, atol=0.0)


class TestAdjoint:
    """Gradients by stepping back: those of backpropagation, in memory that does not grow with the steps."""

    @pytest.mark.parametrize("t", [(0.0, 0.25, 0.31, 1.7), (0.2, 0.1, -1.4)])
    @pytest.mark.parametrize("method", [*KINDS, "sympflow"])
    def test_backpropagation_to_rounding(self, method, t):
        y0 = torch.tensor(HH.domain.sample(2, 1), requires_grad=True)
        t = times(*t).requires_grad_(True)
        found = []
        for run in (odeint, odeint_adjoint):
            y = run(HH, y0, t, method=method, options=options(method))
            found.append((y, *torch.autograd.grad(y.sin().sum(), (y0, t))))
        for ours, expected in zip(found[1], found[0], strict=True):
            torch.testing.assert_close(ours, expected, rtol=0, atol=1e-10)

    @pytest.mark.parametrize("kind", ["layers", "primed", "mlp"])
    def test_the_weights_of_a_flow(self, kind):
        """A map without an inverse is run again from its outputs."""
        made = {"layers": flow, "primed": lambda: SympFlow.primed(PENDULUM), "mlp": lambda: MLPFlow(1, hidden=(4,))}
        psi = made[kind]().requires_grad_(True)
        y0 = times(1.0, 0.2).requires_grad_(True)
        found = [
            torch.autograd.grad(
                run(PENDULUM, y0, times(0.0, 0.3, 9.3, 15.0), method=psi).sin().sum(), (y0, *psi.parameters())
            )
            for run in (odeint, odeint_adjoint)
        ]
        for ours, expected in zip(*found, strict=True):
            torch.testing.assert_close(ours, expected, rtol=1e-10, atol=1e-10)

    def test_what_has_no_meaning_is_said(self):
        y0, t = times(1.0, 0.0).requires_grad_(True), times(0.0, 1.0)
        with pytest.raises(TypeError, match=r"^`odeint_adjoint` is for reverse mode.*use odeint"):
            torch.func.jacrev(lambda y: odeint_adjoint(PENDULUM, y, t, method="verlet"))(y0.detach())
        with (
            torch.autograd.forward_ad.dual_level(),
            pytest.raises(TypeError, match=r"^`odeint_adjoint` is for reverse"),
        ):
            dual = torch.autograd.forward_ad.make_dual(y0.detach(), y0.detach())
            odeint_adjoint(PENDULUM, dual, t, method="verlet")
        with pytest.raises(ValueError, match=r"^`adjoint_method` is 'rk4', but the gradients of 'verlet'"):
            odeint_adjoint(PENDULUM, y0, t, method="verlet", adjoint_method="rk4")
        with pytest.warns(UserWarning, match=r"`adjoint_rtol`.* have no effect on the fixed-step method 'verlet'"):
            odeint_adjoint(PENDULUM, y0, t, method="verlet", adjoint_rtol=1e-3)
        (slope,) = torch.autograd.grad(
            odeint_adjoint(PENDULUM, y0, t, method="verlet")[-1].square().sum(), y0, create_graph=True
        )
        with pytest.raises(RuntimeError, match="once_differentiable"):
            slope.sum().backward()

    def test_memory_does_not_grow_with_the_steps(self):
        """The most that autograd keeps at a time, forward and backward."""

        def most_kept(run, n):
            live, most = 0, 0

            class Kept:
                def __init__(self, x):
                    nonlocal live, most
                    self.x = x
                    live += x.numel()
                    most = max(most, live)

                def __del__(self):
                    nonlocal live
                    live -= self.x.numel()

            y0 = torch.tensor(HH.y0, requires_grad=True)
            with torch.autograd.graph.saved_tensors_hooks(Kept, lambda kept: kept.x):
                odeint_end = run(HH, y0, times(0.0, 0.05 * n), method="strang_parts", options={"dt": 0.05})[-1]
                odeint_end.sum().backward()
            return most

        assert most_kept(odeint_adjoint, 400) == most_kept(odeint_adjoint, 40)
        assert most_kept(odeint, 400) == most_kept(odeint, 40)  # compiled: the states are kept elsewhere, up to 64 MB


class TestDense:
    """torchdiffeq's `odeint_dense` as a function of t, with derivatives."""

    @pytest.mark.parametrize("method", [*KINDS, "sympflow"])
    @pytest.mark.parametrize("end", [1.2, -1.25])
    def test_equal_odeint(self, method, end):
        t = end * times(0.0, 0.1, 0.35, 1.0)
        y = odeint_dense(HH, torch.tensor(HH.y0), t[0], t[-1], method=method, options=options(method))
        expected = odeint(HH, torch.tensor(HH.y0), t, method=method, options=options(method))
        torch.testing.assert_close(y(t), expected, rtol=0, atol=200 * EPS)
        torch.testing.assert_close(y(t[2]), expected[2], rtol=0, atol=200 * EPS)

    def test_theirs_and_what_is_refused(self):
        y0 = torch.tensor(HH.y0)
        theirs = torchdiffeq.odeint_dense(HH, y0, times(0.0)[0], times(1.0)[0], method="dopri5")
        ours = odeint_dense(HH, y0, times(0.0)[0], times(1.0)[0], method="dopri5")
        assert torch.equal(theirs(times(0.7)[0]), ours(times(0.7)[0]))
        found = [
            run(HH, y0, times(0.0, 1.0), adjoint_params=()) for run in (odeint_adjoint, torchdiffeq.odeint_adjoint)
        ]
        assert torch.equal(*found)
        y = odeint_dense(HH, y0, 0.0, 1.0, method="verlet")
        for t in (times(1.1), times(-0.01)):
            with pytest.raises(ValueError, match=r"^`t` must lie between 0 and 1"):
                y(t)
        with pytest.raises(TypeError, match=r"^`t` must be a floating-point tensor"):
            y(0.5)
        with pytest.raises(ValueError, match=r"^`method` 'rk4' has no dense output in torchdiffeq"):
            odeint_dense(HH, y0, 0.0, 1.0, method="rk4")
        with pytest.raises(TypeError, match=r"^`y0` must be a tensor"):
            odeint_dense(HH, (y0[:2], y0[2:]), 0.0, 1.0, method="verlet")


class TestCallbacks:
    """torchdiffeq's `callback_step`, called before each step as its own fixed-step methods call it."""

    @pytest.mark.parametrize("t", [(0.0, 0.2, 0.5), (0.0, -0.35)])
    @pytest.mark.parametrize("as_tuple", [False, True])
    def test_as_rk4_calls_it(self, t, as_tuple):
        called = {}
        y0 = (times(1.0), times(0.2)) if as_tuple else times(1.0, 0.2)
        for method in ("rk4", "verlet"):
            system, seen = systems.pendulum(), []

            def note(t0, y, dt, seen=seen):
                seen.append((float(t0), float(dt), len(y)))

            system.callback_step = note
            run = odeint(system, y0, times(*t), method=method, options={"step_size": 0.1})
            called[method] = np.array(seen)
            assert len(run) == (2 if as_tuple else len(t))
        np.testing.assert_allclose(called["verlet"], called["rk4"], atol=1e-12)

    def test_states_and_gradients_are_those_of_the_run(self):
        system, seen = systems.pendulum(), []
        system.callback_step = lambda t0, y, dt: seen.append(y)
        y0 = times(1.0, 0.2).requires_grad_(True)
        y = odeint(system, y0, times(0.0, 0.1, 0.2, 0.3), method="verlet", options={"dt": 0.1})
        torch.testing.assert_close(torch.stack(seen), y[:-1], rtol=0, atol=0)
        plain = odeint(PENDULUM, y0, times(0.0, 0.1, 0.2, 0.3), method="verlet", options={"dt": 0.1})
        torch.testing.assert_close(y, plain, rtol=0, atol=1e-15)  # which is compiled


class TestRegistration:
    """In torchdiffeq's private table, only when asked for."""

    @pytest.fixture(autouse=True)
    def registered(self):
        table = import_module("torchdiffeq._impl.odeint").SOLVERS
        with pytest.raises(ValueError, match="Invalid method"):
            torchdiffeq.odeint(HH, torch.tensor(HH.y0), times(0.0, 1.0), method="verlet")
        register("verlet")
        register("sympflow")
        yield
        del table["verlet"], table["sympflow"]

    @pytest.mark.parametrize("t", [(0.0, 0.35, 2.0), (1.0, 0.65, -1.0)])
    def test_torchdiffeqs_own_odeint_runs_them(self, t):
        y0 = torch.tensor(HH.y0)
        for method in ("verlet", "sympflow"):
            theirs = torchdiffeq.odeint(HH, y0, times(*t), method=method)
            assert torch.equal(theirs, odeint(HH, y0, times(*t), method=method))
        q, p = torchdiffeq.odeint(HH, (y0[:2], y0[2:]), times(*t), method="verlet")
        assert torch.equal(torch.cat([q, p], -1), odeint(HH, y0, times(*t), method="verlet"))

    @pytest.mark.parametrize("reverse", [False, True])
    def test_events(self, reverse):
        y0 = times(1.0, 0.0)
        arguments = {"event_fn": lambda t, y: y[0], "method": "verlet", "reverse_time": reverse}
        theirs = torchdiffeq.odeint_event(OSCILLATOR, y0, times(0.3)[0], **arguments)
        ours = odeint_event(OSCILLATOR, y0, times(0.3)[0], **arguments)
        torch.testing.assert_close(theirs[0], ours[0])
        torch.testing.assert_close(theirs[1], ours[1])

    def test_gradients_and_the_adjoint(self):
        y0 = times(1.0, 0.2).requires_grad_(True)
        register("verlet")  # again: it is ours already
        t = times(0.0, 0.33)
        assert torch.autograd.gradcheck(lambda y: torchdiffeq.odeint(PENDULUM, y, t, method="verlet"), (y0,))
        with pytest.raises(ValueError, match=r"^`method` 'verlet' cannot be used with torchdiffeq's own odeint_adj"):
            torchdiffeq.odeint_adjoint(PENDULUM, y0, times(0.0, 0.33), method="verlet", adjoint_params=())


def right_hand_side(t, y):
    return torch.stack([y[1], -torch.sin(y[0])])


class Counted:
    """The pendulum as a plain function that counts its calls, and can become another one."""

    def __init__(self):
        self.calls, self.k = 0, 1.0

    def __call__(self, t, y):
        self.calls += 1
        return torch.stack([y[..., 1], -self.k * torch.sin(y[..., 0])], -1)

    def run(self, y0=(1.0, 0.5), t=(0.0, 1.0), system=PENDULUM):
        """The calls that a run costs."""
        before = self.calls
        odeint(self, times(*y0), times(*t), method="verlet", options={"dt": 0.1, "system": system})
        return self.calls - before


class TestRemembered:
    """A right-hand side that a whole run found to be the system is compared at start and end alone in the next."""

    def test_what_was_compared_is_not_compared_again(self):
        func = Counted()
        first = func.run()
        assert first > 15
        assert func.run() == func.run(t=(0.2, 0.8)) == 2

    def test_a_change_of_the_function_is_seen(self):
        func = Counted()
        func.run()
        func.k = 1.01
        with pytest.raises(ValueError, match=r"^`func` is not the system"):
            func.run()

    def test_what_was_refused_is_not_remembered(self):
        func = Counted()
        func.k = 1.01
        with pytest.raises(ValueError, match=r"^`func` is not the system"):
            func.run()
        func.k = 1.0
        assert func.run() > 15

    def test_nothing_is_kept_alive(self):
        func, system = Counted(), systems.pendulum()
        func.run(system=system)
        kept = weakref.ref(func), weakref.ref(system)
        del func, system
        gc.collect()
        assert [reference() for reference in kept] == [None, None]


class TestAnotherSystem:
    """A right-hand side that is not what the method solves is refused, wherever it differs."""

    def test_of_a_bare_flow(self, rotation):
        with pytest.raises(ValueError, match=r"^`func` is not the system that method 'sympflow' solves"):
            odeint(lambda t, y: 9.0 * y, times(1.0, 0.5), times(0.0, 1.0), method=rotation)
        odeint(lambda t, y: torch.stack([y[1], -y[0]]), times(1.0, 0.5), times(0.0, 1.0), method=rotation)
        with pytest.raises(ValueError, match=r"^`func` is not the system that method 'sympflow' solves"):
            odeint(PENDULUM, times(1.9, 0.5), times(0.0, 1.0), method=rotation)
        primed = SympFlow.primed(PENDULUM, curvature=True).requires_grad_(False)  # it knows its system
        odeint(right_hand_side, times(1.0, 0.5), times(0.0, 1.0), method=primed)
        with pytest.raises(ValueError, match=r"^`func` is not the system that method 'sympflow' solves"):
            odeint(OSCILLATOR, times(0.0, 0.5), times(0.0, 1.0), method=primed, options={"system": PENDULUM})

    @pytest.mark.parametrize("change", [lambda t: 0.01 * t, lambda t: t > 9.9])
    def test_in_the_adjoint_and_the_dense_output(self, change):
        def func(t, y):
            return right_hand_side(t, y) * (1 + change(t))

        arguments = {"method": "verlet", "options": {"system": PENDULUM}}
        for run in (
            lambda f: odeint_adjoint(f, times(0.0, 1.9), times(0.0, 10.0), **arguments),
            lambda f: odeint_dense(f, times(0.0, 1.9), 0.0, 10.0, **arguments),
        ):
            run(right_hand_side)
            with pytest.raises(ValueError, match=r"^`func` depends on the time"):
                run(func)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"method": "rk45"}, TypeError, r"^`method` 'rk45' is not a fixed-step map"),
        (
            {"method": "nothing"},
            ValueError,
            r"^`method` 'nothing' is unknown. Choose one of .*dopri5.*scipy_solver.*verlet",
        ),
        ({"method": "verlett"}, ValueError, r"^`method` 'verlett' is unknown. Did you mean 'verlet'\?"),
        ({"method": "dopri55"}, ValueError, r"^`method` 'dopri55' is unknown. Did you mean 'dopri5'\?"),
        ({"method": "dopri5", "event_fn": lambda t, y: y[0], "t": times(0, 1, 2)}, ValueError, r"^We require len\(t\)"),
        ({"options": {"norm": None, "interp": "cubic"}}, TypeError, r"^`interp` is not an option of method"),
        ({"t": times(0.0, 1.0, 0.5)}, ValueError, r"^`t` must be finite and strictly"),
        ({"t": times(0.0, np.nan)}, ValueError, r"^`t` must be finite and strictly"),
        ({"t": torch.tensor([0, 1])}, TypeError, r"^`t` must be a one-dimensional floating"),
        ({"t": [0.0, 1.0]}, TypeError, r"^`t` must be a one-dimensional floating"),
        ({"options": [0.1]}, TypeError, r"^`options` must be a dict"),
        (
            {"options": {"system": "pendulum"}},
            TypeError,
            r"^`options` has a 'system' that is not a HamiltonianSystem: str",
        ),
        ({"method": "log_leapfrog"}, TypeError, r"^`method` 'log_leapfrog' takes steps that are not equal in t"),
        ({"y0": times(1.0, np.nan)}, ValueError, r"^`y0` must be finite"),
        ({"y0": times(1.0)}, ValueError, r"^`y0` must have shape \(\.\.\., 2\)"),
        ({"y0": torch.tensor([1, 0])}, TypeError, r"^`y0` must be real floating-point"),
        ({"y0": torch.zeros(2, dtype=torch.complex128)}, TypeError, r"^`y0` must be real floating-point"),
        ({"y0": (times(1.0), times(1.0), times(1.0))}, TypeError, r"^`y0` must be a tensor \[q, p\] or a tuple"),
        ({"y0": (times(1.0), times(1.0, 2.0))}, ValueError, r"^`y0` \(q, p\) must have equal shapes"),
        ({"y0": [1.0, 0.0]}, TypeError, r"^`y0` must be a tensor"),
        ({"func": lambda t, y: y}, TypeError, r"^`func` must be a HamiltonianSystem for method 'verlet'"),
        ({"method": flow(), "y0": times(1.0, 2.0, 3.0, 4.0)}, ValueError, r"^`y0` must have shape"),
        ({"method": SympFlow(2)}, ValueError, r"^`system` .* degrees of freedom"),
        ({"method": MLPFlow(1), "t": times(1.0, 0.0)}, (TypeError, ValueError), r"inverse|negative"),
        ({"t": times(0.0, 1.0, 2.0), "event_fn": lambda t, y: y[0]}, ValueError, r"^`t` must have 2 entries"),
    ],
)
def test_bad_arguments_are_named(arguments, error, message):
    defaults = {"func": PENDULUM, "y0": times(1.0, 0.0), "t": times(0.0, 1.0), "method": "verlet"}
    arguments = defaults | arguments
    with pytest.raises(error, match=message):
        odeint(arguments.pop("func"), arguments.pop("y0"), arguments.pop("t"), **arguments)


test_registrations_that_are_refused = refusals(
    (lambda: register("dopri5"), "is torchdiffeq's own already"),
    (lambda: register("rk45"), TypeError, "^`method` 'rk45' is not a fixed-step map"),
    (lambda: register("verlett"), r"^`method` 'verlett' is unknown. Did you mean 'verlet'\?"),
    (lambda: register(3), TypeError, "^`method` must be the name of a method"),
    (
        lambda: odeint_event(HH, torch.tensor(HH.y0), 0.0, event_fn=lambda t, y: y[0], method="verlet"),
        TypeError,
        "^`t0` must be a floating-point tensor with one time",
    ),
)


def test_tolerances_have_no_effect_and_say_so():
    with pytest.warns(UserWarning, match="`rtol` and `atol` have no effect"):
        odeint(PENDULUM, times(1.0, 0.0), times(0.0, 1.0), method="verlet", rtol=1e-3)


def test_everything_else_is_handed_on():
    y0, t = torch.tensor(HH.y0), times(0.0, 1.0, 2.0)
    assert torch.equal(odeint(HH, y0, t), torchdiffeq.odeint(HH, y0, t))
    settings = {"method": "rk4", "options": {"step_size": 0.1}}
    assert torch.equal(odeint(HH, y0, t, **settings), torchdiffeq.odeint(HH, y0, t, **settings))
    q, p = odeint(HH, (y0[:2], y0[2:]), t, method="dopri5")  # a HamiltonianSystem takes the pair, too
    torch.testing.assert_close(torch.cat([q, p], -1), torchdiffeq.odeint(HH, y0, t), rtol=1e-5, atol=1e-5)
    module = torch.nn.Linear(4, 4).double()
    theirs = torchdiffeq.odeint_adjoint(lambda t, y: module(y), y0, t, adjoint_params=())
    assert torch.equal(odeint_adjoint(lambda t, y: module(y), y0, t, adjoint_params=()), theirs)


@pytest.mark.parametrize("t", [(0.0, 0.25, 1.2), (0.2, -0.13, -1.4)])
def test_gradients_of_a_flow_to_y0_t_and_weights(t):
    psi = SympFlow(1, hidden=(2,), dt=0.5)
    y0 = torch.tensor([[1.0, 0.2], [0.3, -0.4]], dtype=torch.float64, requires_grad=True)

    def states(y, s, *weights):
        return odeint(PENDULUM, y, s, method="sympflow", options={"flow": psi})

    assert torch.autograd.gradcheck(states, (y0, times(*t).requires_grad_(True), *psi.parameters()))


def test_gradient_in_t_on_the_grid_is_the_velocity(rotation):
    t = times(0.0, 0.5, 2.0).requires_grad_(True)
    y = odeint(OSCILLATOR, times(1.0, 0.0), t, method=rotation)
    slope = torch.autograd.functional.jacobian(
        lambda s: odeint(OSCILLATOR, times(1.0, 0.0), s, method=rotation)[2, 0], t.detach()
    )
    torch.testing.assert_close(slope[2], y[2, 1].detach())  # dq/dt = p
    torch.testing.assert_close(slope[0], -y[2, 1].detach())
