"""Derivatives and transforms of torch through `odeint`, `solve` and flows: right, or refused, never silently zero."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.autograd import forward_ad
from torch.autograd.functional import jacobian
from torch.func import functional_call, grad, hessian, jacfwd, jacrev, jvp, vjp, vmap

from sympflow import HamiltonianSystem, MLPFlow, SympFlow, get, solve, systems
from sympflow.interop.torchdiffeq import odeint, odeint_dense, odeint_event

PENDULUM, OSCILLATOR = systems.pendulum(), systems.harmonic_oscillator()
KINDS = ["verlet", "kahan_li8", "chin4a", "gauss_legendre4", "strang_parts", "mollified_impulse", "sympflow", "mlp"]
Y = torch.tensor([[1.0, 0.2], [0.3, -0.4], [0.1, 0.1]], dtype=torch.float64)
T = torch.tensor([0.0, 0.25, 0.7], dtype=torch.float64)
TIMES = torch.stack([T, 1.7 * T, T + 0.3])
CLOSE = {"rtol": 1e-11, "atol": 1e-12}


def tangent_along_ones(f, x):
    with forward_ad.dual_level():
        return forward_ad.unpack_dual(f(forward_ad.make_dual(x, torch.ones_like(x)))).tangent


DERIVATIVES = {
    "backward": lambda f, x, J: (jacobian(f, x), J),
    "dual tensors": lambda f, x, J: (tangent_along_ones(f, x), J.sum(-1)),
    "jacobian, forward mode": lambda f, x, J: (jacobian(f, x, strategy="forward-mode", vectorize=True), J),
    "jacobian, vectorized": lambda f, x, J: (jacobian(f, x, vectorize=True), J),
    "grad": lambda f, x, J: (grad(lambda z: f(z).sum())(x), J.sum(0)),
    "vjp": lambda f, x, J: (vjp(f, x)[1](torch.ones(2, dtype=x.dtype))[0], J.sum(0)),
    "jvp": lambda f, x, J: (jvp(f, (x,), (torch.ones_like(x),))[1], J.sum(-1)),
    "jacrev": lambda f, x, J: (jacrev(f)(x), J),
    "jacfwd": lambda f, x, J: (jacfwd(f)(x), J),
}


def options(method):
    return {"flow": MLPFlow(1, hidden=(4,))} if method == "mlp" else {} if method == "sympflow" else {"dt": 0.1}


def problem(method):
    """The end of a run as a function of y0 and t, by `odeint` and by `solve`."""
    system = OSCILLATOR if method == "mollified_impulse" else PENDULUM
    chosen = options(method)

    def by_odeint(y, t=T):
        return odeint(system, y, t, method=method, options=chosen)[-1]

    def by_solve(y):
        return solve(system, method, (0.0, 0.7), y, t_eval=[0.25, 0.7], on_domain_exit="ignore", **chosen).y[..., -1]

    return by_odeint, by_solve


@pytest.mark.parametrize("method", KINDS)
class TestEveryTransform:
    def test_derivatives_in_y0(self, method):
        """One kind by `solve`, the next by `odeint`."""
        f = problem(method)[(KINDS.index(method) + 1) % 2]
        columns = [(f(Y[0] + h) - f(Y[0] - h)) / 2e-6 for h in 1e-6 * torch.eye(2, dtype=Y.dtype)]
        J = jacobian(f, Y[0])
        torch.testing.assert_close(J, torch.stack(columns, -1), rtol=0, atol=1e-8)
        for name, derivative in DERIVATIVES.items():
            torch.testing.assert_close(*derivative(f, Y[0], J), **CLOSE, msg=name)
        second = torch.autograd.functional.hessian(lambda y: f(y).sum(), Y[0])
        torch.testing.assert_close(hessian(lambda y: f(y).sum())(Y[0]), second, rtol=0, atol=1e-9)

    def test_derivatives_in_t(self, method):
        by_odeint, _ = problem(method)
        J = jacobian(lambda t: by_odeint(Y[0], t), T)
        assert J.abs().max() > 0.1
        for name, derivative in DERIVATIVES.items():
            torch.testing.assert_close(*derivative(lambda t: by_odeint(Y[0], t), T, J), **CLOSE, msg=name)

    def test_vmap(self, method):
        by_odeint, by_solve = problem(method)
        for f in (by_odeint, by_solve):
            each = torch.stack([f(y) for y in Y])
            torch.testing.assert_close(vmap(f)(Y), each, **CLOSE)
            torch.testing.assert_close(vmap(f, 1, 1)(Y.T.contiguous()), each.T, **CLOSE)
            J = torch.stack([jacobian(f, y) for y in Y])
            torch.testing.assert_close(vmap(jacrev(f))(Y), J, **CLOSE)
            torch.testing.assert_close(vmap(jacfwd(f))(Y), J, **CLOSE)
        each = torch.stack([by_odeint(y, t) for y, t in zip(Y, TIMES, strict=True)])
        torch.testing.assert_close(vmap(by_odeint)(Y, TIMES), each, **CLOSE)  # each lane counts its own steps


FLOWS = {
    "layers": lambda: SympFlow(1, hidden=(5,), dt=0.5),
    "primed": lambda: SympFlow.primed(PENDULUM),
    "mlp": lambda: MLPFlow(1, hidden=(4,), dt=0.5),
}


@pytest.mark.parametrize("kind", FLOWS)
class TestFlows:
    def test_vmap_over_times_and_states(self, kind):
        psi = FLOWS[kind]()
        t = torch.tensor([0.0, 0.7, 1.3 if kind == "mlp" else -1.3], dtype=torch.float64)
        each = torch.stack([psi(float(s), y) for s, y in zip(t, Y, strict=True)])
        torch.testing.assert_close(vmap(psi)(t, Y), each, **CLOSE)
        torch.testing.assert_close(
            vmap(psi, (0, None))(t, Y[0]), torch.stack([psi(float(s), Y[0]) for s in t]), **CLOSE
        )
        J = torch.stack([jacobian(lambda x, s=s: psi(float(s), x), y) for s, y in zip(t, Y, strict=True)])
        torch.testing.assert_close(vmap(jacrev(psi, 1))(t, Y), J, **CLOSE)
        torch.testing.assert_close(vmap(jacfwd(psi, 1))(t, Y), J, **CLOSE)

    def test_derivatives_in_one_time(self, kind):
        """A time () beyond Δt, and one that is a whole number of steps."""
        psi = FLOWS[kind]()
        for t in (0.7, 2 * psi.dt):
            time = torch.tensor(t, dtype=torch.float64)
            slope = jacobian(lambda s: psi(s, Y[0]), time)
            assert slope.abs().max() > 0
            torch.testing.assert_close(tangent_along_ones(lambda s: psi(s, Y[0]), time), slope, **CLOSE)
            torch.testing.assert_close(jacfwd(psi)(time, Y[0]), slope, **CLOSE)
            torch.testing.assert_close(jacrev(psi)(time, Y[0]), slope, **CLOSE)

    def test_functional_weights(self, kind):
        """Weights handed in by functional_call are those that run, in `odeint` too, though y0 is a plain tensor."""
        psi = FLOWS[kind]().requires_grad_(True)
        weights = dict(psi.named_parameters())

        def end(w):
            return functional_call(_End(psi), {f"psi.{name}": value for name, value in w.items()}, (Y,)).sum()

        found = grad(end)(weights)
        expected = torch.autograd.grad(odeint(PENDULUM, Y, T, method=psi)[-1].sum(), list(weights.values()))
        for name, value in zip(weights, expected, strict=True):
            torch.testing.assert_close(found[name], value, **CLOSE)
        ones = {name: torch.ones_like(value) for name, value in weights.items()}
        along = sum(value.sum() for value in expected)
        torch.testing.assert_close(jvp(end, (weights,), (ones,))[1], along, rtol=1e-9, atol=1e-12)


class _End(torch.nn.Module):
    def __init__(self, psi):
        super().__init__()
        self.psi = psi

    def forward(self, y):
        return odeint(PENDULUM, y, T, method=self.psi)[-1]


class TestNumbersOfH:
    """Tensors within the functions of a system that torch follows, though y0 is a plain tensor."""

    y0 = Y[0]  # made here: a Y[0] within a transform of torch.func would be a tensor of that transform

    def system(self, k):
        return HamiltonianSystem(lambda q: -k * torch.cos(q).sum(-1), ndof=1)

    def end(self, k, method="verlet"):
        return odeint(self.system(k), self.y0, T, method=method, options={"dt": 0.1})[-1]

    @pytest.mark.parametrize("derivative", [jacfwd, jacrev, lambda f: partial(tangent_along_ones, f)])
    def test_derivatives_by_a_mass(self, derivative):
        def end(mass):
            system = HamiltonianSystem(lambda q: torch.cos(q).sum(-1), ndof=1, mass=mass)
            return odeint(system, self.y0, T, method="verlet", options={"dt": 0.1})[-1]

        mass, small = torch.tensor(1.3, dtype=torch.float64), 1e-5
        differences = (end(mass + small) - end(mass - small)) / (2 * small)
        torch.testing.assert_close(derivative(end)(mass), differences, rtol=0, atol=1e-8)

    def test_of_dense_output_and_event_times(self):
        def within(k):
            return odeint_dense(self.system(k), self.y0, 0.0, 0.7, method="verlet", options={"dt": 0.1})(T[1])

        def crossing(k):
            return odeint_event(self.system(k), self.y0, T[0], event_fn=lambda t, y: y[0] - 0.3, method="verlet")[0]

        k = torch.tensor(1.3, dtype=torch.float64)
        for f in (within, crossing):
            J = jacobian(f, k)
            assert J.abs().min() > 0.01
            torch.testing.assert_close(jacfwd(f)(k), J, rtol=0, atol=1e-9)
            torch.testing.assert_close(jacrev(f)(k), J, rtol=0, atol=1e-9)
            torch.testing.assert_close(tangent_along_ones(f, k), J, rtol=0, atol=1e-9)
        with pytest.raises(TypeError, match=r"^`event_fn` is followed by the values.*torch\.func\.vmap"):
            vmap(crossing)(k[None])


class TestEvents:
    def event(self, y, method="verlet"):
        return odeint_event(PENDULUM, y, T[0], event_fn=lambda t, y: y[0] - 0.3 + 0.1 * t, method=method)

    def test_times_in_both_modes(self):
        for part in (lambda y: self.event(y)[0], lambda y: self.event(y)[1][1]):
            J = jacobian(part, Y[0])
            assert J.abs().max() > 0.1
            torch.testing.assert_close(jacfwd(part)(Y[0]), J, rtol=0, atol=1e-9)
            torch.testing.assert_close(jacrev(part)(Y[0]), J, rtol=0, atol=1e-9)
            torch.testing.assert_close(tangent_along_ones(part, Y[0]), J.sum(-1), rtol=0, atol=1e-9)

    def test_second_derivatives(self):
        """The derivatives of a derivative: a Newton step with a fixed slope alone would make them wrong."""
        y = Y[0].clone().requires_grad_(True)
        assert torch.autograd.gradgradcheck(lambda y: self.event(y)[0], (y,))
        torch.testing.assert_close(
            hessian(lambda y: self.event(y)[0])(Y[0]),
            torch.autograd.functional.hessian(lambda y: self.event(y)[0], Y[0]),
            rtol=0,
            atol=1e-9,
        )


@pytest.mark.filterwarnings("ignore::UserWarning")  # Dynamo's own, of code that it traces
class TestCompiled:
    """`torch.compile(fullgraph=True)`: steps and flows are one graph; whole runs say that they are none."""

    @pytest.mark.parametrize("method", ["verlet", "strang_parts", "implicit_midpoint"])
    def test_steps(self, method):
        torch.compiler.reset()
        integrator = get(method)(dt=0.1)
        expected = integrator.step(PENDULUM, 0.0, Y, 0.1)  # the parts of H are found in the first call
        compiled = torch.compile(lambda y: integrator.step(PENDULUM, 0.0, y, 0.1), backend="eager", fullgraph=True)
        torch.testing.assert_close(compiled(Y), expected, **CLOSE)

    @pytest.mark.parametrize("which", [0, 1], ids=["odeint", "solve"])
    def test_whole_runs_are_refused(self, which):
        torch.compiler.reset()
        f = problem("verlet")[which]
        with pytest.raises(Exception, match=r"looks at values, which torch\.compile hides: compile the steps"):
            torch.compile(f, backend="eager", fullgraph=True)(Y[0])

    def test_flows(self):
        torch.compiler.reset()
        psi = SympFlow(1, hidden=(5,), dt=0.5)
        expected = psi(1.2, Y)
        compiled = torch.compile(lambda y: psi(1.2, y), backend="eager", fullgraph=True)
        torch.testing.assert_close(compiled(Y), expected, **CLOSE)
        compiled = torch.compile(psi.psi, backend="eager", fullgraph=True)
        torch.testing.assert_close(compiled(T[1], Y), psi(0.25, Y), **CLOSE)


class TestRefusals:
    """Calls that cannot be right raise an error that names the remedy."""

    @pytest.mark.parametrize("argument", ["t_span", "t_eval", "t"])
    def test_times_of_solve_that_are_transformed(self, argument):
        end = torch.tensor(0.7, dtype=torch.float64)

        def f(s):
            if argument == "t_span":
                return solve(PENDULUM, "verlet", (0.0, s), Y[0]).y
            if argument == "t_eval":
                return solve(PENDULUM, "verlet", (0.0, 1.0), Y[0], t_eval=s[None]).y
            return solve(PENDULUM, "verlet", (0.0, 1.0), Y[0], dense_output=True).sol(s)

        assert torch.isfinite(f(end)).all()  # plain ones are numbers
        runs = [lambda: jacfwd(f)(end), lambda: vmap(f)(end[None])]
        for run in [*runs, *[lambda: f(end.clone().requires_grad_(True))] * (argument == "t")]:
            with pytest.raises(TypeError, match=rf"^`{argument}` is a tensor that torch .*odeint"):
                run()

    @pytest.mark.parametrize(
        ("more", "message"),
        [
            ({"events": lambda t, y: y[0]}, "^`events` are found by the values"),
            ({"on_domain_exit": "stop"}, "^`on_domain_exit` 'stop' needs the values"),
            ({"method": "rk45"}, "^`y0` is a tensor"),
            ({"method": "dopri5"}, "^`method` 'dopri5' chooses its steps by the values"),
            ({"method": "explicit_adams"}, "^`method` 'explicit_adams' .* the values"),
            ({"method": "sympflow", "tol": 1e-6}, "^`tol` needs the values of y0"),
        ],
    )
    def test_vmap(self, more, message):
        arguments = {"method": "verlet", "t_span": (0.0, 0.5)} | more
        with pytest.raises((TypeError, ValueError), match=message):
            vmap(lambda y: solve(PENDULUM, y0=y, **arguments).y)(Y)


@pytest.mark.parametrize("method", ["rk4", "explicit_adams", "dopri5"])
def test_methods_of_torchdiffeq(method):
    """Its adaptive steps have derivatives in reverse mode only, and say so."""

    def end(y):
        return solve(PENDULUM, method, (0.0, 0.7), y, t_eval=[0.25, 0.7]).y[..., -1]

    J = jacobian(end, Y[0])
    for derivative in (lambda: jacfwd(end)(Y[0]).sum(-1), lambda: tangent_along_ones(end, Y[0])):
        if method == "dopri5":
            with pytest.raises(TypeError, match=r"^`method` 'dopri5' .*forward mode or inside torch\.func: use"):
                derivative()
        else:
            torch.testing.assert_close(derivative(), J.sum(-1), rtol=0, atol=1e-12)
    if method == "rk4":
        torch.testing.assert_close(vmap(end)(Y), torch.stack([end(y) for y in Y]), **CLOSE)


class TestBatchesUnderVmap:
    def test_a_lane_that_fails_leaves_the_others(self):
        hh = systems.henon_heiles()
        y0 = torch.tensor(np.array([hh.y0, [0.0, 0.0, 0.0, 0.7]]))
        seen = []

        def end(y):
            sol = solve(hh, "verlet", (0.0, 20.0), y, dt=0.05)
            seen.append(sol)
            return sol.y

        states = vmap(end)(y0)
        torch.testing.assert_close(states[0], solve(hh, "verlet", (0.0, 20.0), y0[0], dt=0.05).y, **CLOSE)
        assert not torch.isfinite(states[1]).all()
        assert seen[0].status == -1
        assert "in some lane of torch.func.vmap" in seen[0].message
        good = vmap(lambda y: end(y)[:, -1])(y0[:1])
        assert torch.isfinite(good).all()
        assert seen[1].status == 0

    def test_y0_must_be_finite_in_every_lane(self):
        bad = torch.tensor([[1.0, 0.0], [np.nan, 0.0]], dtype=torch.float64)
        with pytest.raises(ValueError, match=r"^`y0` must be finite"):
            vmap(problem("verlet")[1])(bad)
        with pytest.raises(ValueError, match=r"^`y0` must be finite"):
            vmap(problem("verlet")[0])(bad)


def test_the_state_at_a_terminal_event_of_solve_says_that_it_has_no_derivative():
    def crossing(t, y):
        return y[0] - 0.9

    crossing.terminal = True
    with pytest.warns(UserWarning, match="has no gradient.*odeint_event"):
        jacfwd(lambda y: solve(PENDULUM, "verlet", (0.0, 5.0), y, events=crossing).y)(Y[0])
    with pytest.warns(UserWarning, match="has no gradient.*odeint_event"):
        solve(PENDULUM, "verlet", (0.0, 5.0), Y[0].clone().requires_grad_(True), events=crossing)
    assert solve(PENDULUM, "verlet", (0.0, 5.0), Y[0], events=crossing).status == 1


DOCUMENTED = {
    "`backward`, `torch.autograd.grad`": ["backward"],
    "dual tensors, `torch.autograd.forward_ad`": ["dual tensors"],
    "`torch.autograd.functional.jacobian`, both strategies": ["jacobian, forward mode", "jacobian, vectorized"],
    "`torch.func.grad`, `vjp`, `jacrev`": ["grad", "vjp", "jacrev"],
    "`torch.func.jvp`, `jacfwd`": ["jvp", "jacfwd"],
    "`torch.func.hessian`": ["TestEveryTransform.test_derivatives_in_y0"],
    "`torch.func.vmap`, of these too": ["TestEveryTransform.test_vmap"],
    "`torch.func.functional_call`": ["TestFlows.test_functional_weights"],
    "`torch.compile(fullgraph=True)`": ["TestCompiled.test_steps", "TestCompiled.test_whole_runs_are_refused"],
}


def test_every_row_of_the_documented_table_is_executed():
    page = (Path(__file__).parents[2] / "docs" / "plugins-and-interop.md").read_text(encoding="utf-8")
    table = page.partition("| transform |")[2].partition("\n\n")[0]
    rows = [line.split("|")[1].strip() for line in table.splitlines()[2:]]
    assert rows == list(DOCUMENTED)
    for names in DOCUMENTED.values():
        for name in names:
            cls, _, test = name.partition(".")
            assert name in DERIVATIVES or callable(getattr(globals()[cls], test))
