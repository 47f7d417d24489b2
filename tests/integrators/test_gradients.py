"""Tensors run compiled, with the numbers of NumPy calls and the derivatives of the map that ran."""

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline

from sympflow import Box, HamiltonianSystem, SympFlow, get, solve
from sympflow.flow.shipped import named
from sympflow.kernels import reverse
from sympflow.systems import driven_pendulum, henon_heiles, solar_system

CUBIC = HamiltonianSystem.from_sympy(
    "(p1**2/m + p2**2)/2 + k*(q1**2 + q2**2)/2 + g*(q1**2*q2 - q2**3/3)", params={"k": 1.0, "g": 0.9, "m": 1.2}
)
PARAMS = {"k": 1.1, "g": 0.9, "m": 1.2}
DRIVEN = HamiltonianSystem.from_sympy(
    "p**2/2 - w*cos(q) + a*q*cos(b*t)", params={"w": 1.0, "a": 0.3, "b": 0.7}, time="t"
)
DAMPED = HamiltonianSystem.from_sympy("p**2/2 - w*cos(q)", params={"w": 1.0}, damping=0.2)
RELATIVISTIC = HamiltonianSystem.from_sympy("sqrt(1 + p**2) + q**4/4")
KEPLER = HamiltonianSystem.from_sympy("(p1**2 + p2**2)/2 - 1/sqrt(q1**2 + q2**2 + 0.3)")
GEODESIC = HamiltonianSystem.from_sympy("(p1**2 + p2**2)/2*(1 + q1**2) + (q1**4 + q2**4)/4")
BODIES = HamiltonianSystem.pairs("-m1*m2/sqrt(r**2 + 0.3)", masses=[1.0, 0.5, 0.3], dim=2)
RING = HamiltonianSystem.lattice(shape=9, onsite="q**2/2", bond="r**2/2 + r**4/4", kinetic="sqrt(1 + p**2)")
PLATE = HamiltonianSystem.lattice(
    shape=(5, 4),
    fields=("u", "w"),
    onsite="u**2*w**2/2 + u**2",
    bond={1: "(r_u**2 + r_w**2)/2", 2: "r_u**4/8"},
    kinetic="(m*p_u**2 + p_w**2)/2",
    params={"m": np.linspace(0.5, 1.0, 20).reshape(5, 4)},
    boundary=("free", "fixed"),
)
FLOWS = [
    named("henon_heiles-primed-1-0.82").load(henon_heiles()),
    named("driven_pendulum-primed-6-0.4").load(driven_pendulum()),
]
SYSTEMS = [
    (CUBIC, "verlet"),
    (CUBIC, "srkn11b"),
    (CUBIC, "chin4c"),
    (DRIVEN, "kahan_li8"),
    (DAMPED, "verlet"),
    (RELATIVISTIC, "blanes_moan4"),
    (KEPLER, "leapfrog"),
    (GEODESIC, "rk4"),
    (DRIVEN, "heun3"),
    (DAMPED, "midpoint"),
    (BODIES, "kahan_li8"),
    (DRIVEN, "implicit_midpoint"),
    (GEODESIC, "gauss_legendre4"),
    (DAMPED, "gauss_legendre6"),
    (CUBIC, "linear_aba864"),
    (CUBIC, "mollified_impulse"),
    (KEPLER, "strang_parts"),
    (GEODESIC, "tao4"),
    (DRIVEN, "kahan_li8_parts"),
    *((flow.system, flow) for flow in FLOWS),
    (RING, "kahan_li8"),
    (PLATE, "chin4c"),
    (KEPLER, SympFlow(ndof=2, pairs=2, hidden=(7, 5), activation="swish", dt=0.1).requires_grad_(False)),
]
RUNS = [
    {"t_span": (0, 2), "dt": 0.1, "t_eval": [2.0]},
    {"t_span": (0, 2), "dt": 0.1},
    {"t_span": (0, 2), "dt": 0.07, "t_eval": [0.0, 0.1, 0.21, 1.9]},
    {"t_span": (2, 0), "dt": 0.1, "save_every": 3},
]


def start(system, batch):
    return np.random.default_rng(0).uniform(0.1, 0.3, (*batch, 2 * system.ndof))


def weighted(sol):
    return (torch.as_tensor(sol.y) * torch.as_tensor(np.random.default_rng(1).normal(size=sol.y.shape))).sum()


@pytest.mark.parametrize(
    ("system", "method", "run", "batch"),
    [(*of, RUNS[(i + k) % 4], batch) for i, of in enumerate(SYSTEMS) for k, batch in enumerate([(), (2, 9)])],
)
def test_values_are_those_of_arrays_and_gradients_those_of_backpropagation(system, method, run, batch):
    y0, found = start(system, batch), {}
    plain = solve(system, method, y0=y0, **run)
    for backend in ("compiled", "array"):
        y = torch.tensor(y0, requires_grad=True)
        sol = solve(system, method, y0=y, backend=backend, **run)
        found[backend] = torch.autograd.grad(weighted(sol), y)[0]
        if backend == "compiled":
            np.testing.assert_array_equal(sol.y.detach().numpy(), plain.y)
            assert sol.stats["backend"] == "compiled"
    scale = found["array"].abs().max()
    torch.testing.assert_close(found["compiled"] / scale, found["array"] / scale, rtol=0, atol=1e-11)
    h, v = 3e-4, np.random.default_rng(2).normal(size=y0.shape)  # differences are right to h⁴, and to rounding over h
    ends = [weighted(solve(system, method, y0=y0 + k * h * v, **run)) for k in (-2, -1, 1, 2)]
    difference = float(ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * h)
    along = float((found["compiled"] * torch.as_tensor(v)).sum())
    assert along == pytest.approx(difference, rel=0, abs=1e-9 * float(scale) * v.size)


@pytest.mark.parametrize(
    ("system", "method", "params", "run"),
    [
        (CUBIC, "verlet", {"k": 1.0, "g": 0.0}, RUNS[0]),
        (CUBIC, "chin4c", {"k": np.array([1.0, 0.9, 0.0]), "m": 1.3}, RUNS[2]),
        (DRIVEN, "srkn11b", {"w": 1.1, "a": 0.3, "b": 0.7}, RUNS[2]),
        (DAMPED, "verlet", {"w": np.array([1.0, 1.2])}, RUNS[1]),
        (CUBIC, "rk4", {"k": np.array([1.0, 0.9, 0.0]), "m": 1.3}, RUNS[1]),
        (DRIVEN, "heun3", {"w": 1.1, "a": 0.3, "b": 0.7}, RUNS[1]),
        (DAMPED, "implicit_midpoint", {"w": np.array([1.0, 1.2])}, RUNS[1]),
        (DAMPED, "gauss_legendre4", {"w": 1.2}, RUNS[1]),
        (CUBIC, "gauss_legendre6", {"k": np.array([1.0, 0.9, 0.0]), "m": 1.3}, RUNS[0]),
    ],
)
def test_gradients_by_parameters(system, method, params, run):
    """The derivative of the same run by finite differences, whose error is that of rounding and h²."""
    y0, h = start(system, ()), 1e-6

    def value(**changed):
        return float(weighted(solve(system, method, y0=y0, params={**params, **changed}, **run)))

    tensors = {name: torch.tensor(value, dtype=torch.float64, requires_grad=True) for name, value in params.items()}
    sol = solve(system, method, y0=y0, params=tensors, **run)
    np.testing.assert_allclose(  # numbers of the run in place of constants round otherwise
        sol.y.detach().numpy(), solve(system, method, y0=y0, params=params, **run).y, rtol=0, atol=1e-14
    )
    for name, gradient in zip(params, torch.autograd.grad(weighted(sol), list(tensors.values())), strict=True):
        difference = (value(**{name: params[name] + h}) - value(**{name: params[name] - h})) / (2 * h)
        np.testing.assert_allclose(float(gradient.sum()), difference, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(("method", "batch"), [("wisdom_holman", ()), ("kepler_aba1064", (2,))])
def test_gradients_of_planets(method, batch):
    system, found = solar_system(2), []
    y0 = system.y0 * np.random.default_rng(0).uniform(0.999, 1.001, (*batch, len(system.y0)))
    for backend in ("compiled", "array"):
        y = torch.tensor(y0, requires_grad=True)
        sol = solve(system, method, (0, 30), y, dt=4.0, t_eval=[0.0, 8.0, 29.0, 30.0], backend=backend)
        found.append(torch.autograd.grad(weighted(sol), y)[0])
    torch.testing.assert_close(*found, rtol=1e-12, atol=1e-12 * float(found[1].abs().max()))


@pytest.mark.parametrize("rows", [1, 300])
@pytest.mark.parametrize("method", ["verlet", "gauss_legendre4", SYSTEMS[-1][1]])
def test_segments_give_the_same_bits(method, rows, monkeypatch):
    y0, found = start(CUBIC, (rows,)), []
    for most in (reverse.MOST_KEPT, 0):
        monkeypatch.setattr(reverse, "MOST_KEPT", most)
        monkeypatch.setattr(reverse, "SEGMENT", 20 * min(rows, reverse.ROWS))
        y = torch.tensor(y0, requires_grad=True)
        sol = solve(CUBIC, method, (0, 3), y, dt=0.1, save_every=7)
        found.append((sol.y.detach().numpy(), torch.autograd.grad(weighted(sol), y)[0].numpy()))
    np.testing.assert_array_equal(found[0][0], found[1][0])
    np.testing.assert_array_equal(found[0][1], found[1][1])


@pytest.mark.parametrize(("system", "batch"), [(CUBIC, ()), (DRIVEN, (2,)), (DAMPED, ())])
@pytest.mark.parametrize("t_eval", [None, [0.5, 1.13]])
def test_gradients_by_times(system, batch, t_eval):
    """The derivative of the solution, which the method of order 8 has to 1e-9, by finite differences."""
    y0, h, names = start(system, batch), 1e-5, [0, 1] if t_eval is None else [0, 1, 2, 3]
    times = np.array([0.2, 1.4, *(t_eval or ())])

    def value(times, tensors=False):
        ends, outputs = tuple(times[:2]), None if t_eval is None else [*times[2:]] if tensors else times[2:]
        return weighted(
            solve(system, "kahan_li8", ends, y0, dt=0.05, t_eval=outputs, save_every=None if t_eval else 100)
        )

    tensors = [torch.tensor(t, dtype=torch.float64, requires_grad=True) for t in times]
    found = torch.autograd.grad(value(tensors, True), tensors, allow_unused=True, materialize_grads=True)
    for i in names:
        e = h * np.eye(len(times))[i]
        difference = float(value(times + e) - value(times - e)) / (2 * h)
        np.testing.assert_allclose(float(found[i]), difference, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("method", ["verlet", "rk4", "gauss_legendre4"])
def test_drives_by_samples_move_no_derivative_of_a_linear_system(method):
    t = np.linspace(0, 2, 21)
    system = HamiltonianSystem.from_sympy("p**2/2 + q**2/2 - f*q", params={"f": CubicSpline(t, np.sin(t))})
    y0, slopes = torch.tensor([1.0, 0.0], dtype=torch.float64, requires_grad=True), []
    for each in (system, HamiltonianSystem.from_sympy("p**2/2 + q**2/2")):
        sol = solve(each, method, (0, 1), y0, dt=0.05)
        assert sol.stats["backend"] == "compiled"
        slopes.append(torch.autograd.grad(sol.y[0, -1], y0)[0])
    torch.testing.assert_close(*slopes, rtol=1e-13, atol=1e-14)


class Coordinates(torch.nn.Module):
    """V of an angle and a distance, with a term that is known."""

    def __init__(self):
        super().__init__()
        self.layers = torch.nn.ModuleList([torch.nn.Linear(3, 7, bias=False), torch.nn.Linear(7, 5)])
        self.end = torch.nn.Linear(5, 2)

    def forward(self, q):
        x = torch.stack([torch.sin(q[..., 0]), torch.cos(q[..., 0]), q[..., 1]], -1)
        for layer in self.layers:
            x = torch.nn.functional.silu(layer(x))
        a = self.end(x)
        return a[..., 0] * a[..., 1] + 0.5 * (q**2).sum(-1)


def network(kind):
    torch.manual_seed(2)
    linear, tanh = torch.nn.Linear, torch.nn.Tanh
    made = {
        "two layers": lambda: torch.nn.Sequential(linear(2, 9), tanh(), linear(9, 8), tanh(), linear(8, 1)),
        "one layer": lambda: torch.nn.Sequential(linear(2, 1)),
        "coordinates": Coordinates,
    }[kind]().double()
    return made, lambda q: made(q).reshape(q.shape[:-1])


@pytest.mark.parametrize("kind", ["two layers", "one layer", "coordinates"])
@pytest.mark.parametrize(
    ("method", "run", "batch"), [("verlet", RUNS[0], ()), ("kahan_li8", RUNS[2], (3, 7)), ("verlet", RUNS[3], (3, 7))]
)
def test_weights_of_a_network_in_H(kind, method, run, batch):
    net, V = network(kind)
    system = HamiltonianSystem(V, ndof=2, mass=[1.0, 2.0])
    y0, found = start(system, batch), []
    for backend in ("compiled", "array"):
        y = torch.tensor(y0, requires_grad=True)
        sol = solve(system, method, y0=y, backend=backend, **run)
        assert sol.stats["backend"] == {"compiled": "compiled", "array": "torch"}[backend]
        gradients = torch.autograd.grad(weighted(sol), [y, *net.parameters()], allow_unused=True)
        found.append([sol.y.detach(), *(g for g in gradients if g is not None and g.abs().max() > 0)])
    for compiled, expected in zip(*found, strict=True):
        torch.testing.assert_close(compiled, expected, rtol=0, atol=1e-12 * float(expected.abs().max()))
    np.testing.assert_array_equal(solve(system, method, y0=y0, **run).y, found[0][0].numpy())


def test_networks_that_are_no_chain_run_as_arrays():
    net = torch.nn.Sequential(torch.nn.Linear(2, 60), torch.nn.Tanh(), torch.nn.Linear(60, 1)).double()
    system = HamiltonianSystem(lambda q: (net(q) + net(q + 0.1))[..., 0], ndof=2)
    sol = solve(system, "verlet", (0, 1), torch.tensor(start(system, ())), dt=0.1)
    assert sol.stats["backend"] == "torch"
    assert "its linear layers do not follow one another" in repr(system)
    assert torch.autograd.grad(sol.y.sum(), net[0].weight)[0].abs().max() > 0


def test_rows_that_become_infinite_add_nothing_to_derivatives_by_weights():
    net, _ = network("two layers")
    system = HamiltonianSystem(lambda q: net(q)[..., 0] ** 2 - (q**4).sum(-1), ndof=2)
    y0 = np.array([[0.1, 0.0, 0.2, 0.1], [0.0, 30.0, 0.0, 30.0], [0.0, 0.1, 0.3, 0.0]])
    found = []
    for rows in ([0, 1, 2], [0, 2]):
        sol = solve(system, "verlet", (0, 2), torch.tensor(y0[rows]), dt=0.1, diagnose=False)
        found.append(torch.autograd.grad(sol.y[0].sum() + sol.y[-1].sum(), net[0].weight)[0])
    torch.testing.assert_close(*found, rtol=1e-13, atol=0)


ONE = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)


def moved(force):
    """A run whose jumps a parameter moves: the derivative of a state by their time is that of no stage."""
    system = HamiltonianSystem.from_sympy(f"p**2/2 + q**2/2 - q*{force}", time="t", params={"c": 1.3}, y0=[0.0, 0.0])
    return solve(system, "kahan_li8", (0, 3), dt=0.1, params={"c": ONE})


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        *(
            (lambda y, m=m, more=more: solve(CUBIC, m, (0, 1), y, params={"k": ONE}, **more), ValueError, "has k.*" + x)
            for m, more, x in (
                ("dopri5", {}, "use a splitting method"),
                ("dop853", {}, "use a splitting method"),
                ("verlet", {"backend": "array"}, "Detach them"),
                ("verlet", {"events": lambda t, y: y[0]}, "leave these out"),
                ("verlet", {"on_domain_exit": "stop"}, "leave these out"),
            )
        ),
        *(
            (lambda y, f=f: moved(f), ValueError, "c that requires gradients and moves the times at which H jumps")
            for f in ("Heaviside(t - c)", "floor(c*t)", "Piecewise((1, t < c), (0, True))")
        ),
        (lambda y: solve(CUBIC, "verlet", (0, ONE), y, dt=0.1, dense_output=True), ValueError, "^`t_span`.*detach"),
        (lambda y: solve(CUBIC, "verlet", (0, 1), y, dt=0.1, t_eval=[ONE], store="out"), ValueError, "^`t_span` or"),
        (lambda y: solve(CUBIC, "verlet", (0, 1), y, dt=ONE / 10), ValueError, "^`dt`"),
        (lambda y: solve(CUBIC, "verlet", (0, 1), y, dt=0.1, store="out"), TypeError, r"^`y0`.*`store`.*y0\.detach"),
        (lambda y: solve(CUBIC, "verlet", (0, 1), y.to("meta"), dt=0.1), TypeError, "^`y0` must be a dense tensor"),
        (lambda y: CUBIC.with_params(k=ONE), TypeError, r"^`params\['k'\]`.*params=\{name: tensor\}"),
        (lambda y: HamiltonianSystem.pairs("-1/r", masses=ONE.expand(3)), TypeError, "^`masses`.*hamiltonian="),
        (lambda y: HamiltonianSystem.from_sympy("p**2/2", damping=ONE), TypeError, "^`damping`.*detach"),
    ],
)
def test_what_no_gradient_flows_to_is_refused(call, error, message):
    with pytest.raises(error, match=message):
        call(torch.tensor(start(CUBIC, ()), requires_grad=True))


@pytest.mark.parametrize("method", ["gauss_legendre4", "gauss_legendre6", "gauss_legendre8"])
def test_gradients_where_forces_are_rounding(method):
    """The sums of p and q of a ring are P and Q + tP; a step in polar coordinates on a circle is symplectic."""
    ring = HamiltonianSystem.lattice(shape=16, bond="r**2/2 + r**4/4", y0=np.r_[np.linspace(0, 1, 16), np.zeros(16)])
    y0 = torch.tensor(ring.y0, requires_grad=True)
    solve(ring, method, (0, 1), y0, t_eval=[1.0], dt=0.05).y.sum().backward()
    np.testing.assert_allclose(y0.grad, np.repeat([1.0, 2.0], 16), rtol=1e-12)
    circle = HamiltonianSystem.from_sympy("p1**2/2 + p2**2/(2*q1**2) - 1/q1", y0=[1.1, 0.0, 0.0, np.sqrt(1.1)])
    step = get(method)()
    J = torch.autograd.functional.jacobian(lambda y: step.step(circle, 0.0, y, 0.05), torch.tensor(circle.y0))
    omega = torch.tensor(np.kron([[0.0, 1.0], [-1.0, 0.0]], np.eye(2)))
    torch.testing.assert_close(J.T @ omega @ J, omega, rtol=0, atol=1e-13)


NUMBERS = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in ([1.1, 0.7], 0.9)]


def of_numbers(q):
    k, g = NUMBERS
    return torch.exp(-g) * (k**2 * q**2).sum(-1) + g * k[0] * q[..., 0] ** 2 * q[..., 1]


OF_NUMBERS = HamiltonianSystem(of_numbers, ndof=2)
BENT = HamiltonianSystem(
    hamiltonian=lambda q, p: (1 + NUMBERS[0][1] * q[..., 0] ** 2) * (p**2).sum(-1) / 2 + of_numbers(q), ndof=2
)


@pytest.mark.parametrize("batch", [(), (2, 3)], ids=["one", "batch"])
@pytest.mark.parametrize(
    ("system", "method"),
    [(OF_NUMBERS, "srkn11b"), (OF_NUMBERS, "chin4a"), (OF_NUMBERS, "gauss_legendre4"), (BENT, "rk4")],
)
def test_gradients_flow_to_tensors_that_a_function_holds(system, method, batch):
    found, y0 = [], start(system, batch)
    for backend in ("compiled", "array"):
        y = torch.tensor(y0, requires_grad=True)
        sol = solve(system, method, (0, 1), y, dt=0.1, backend=backend)
        assert sol.stats["backend"] == {"compiled": "compiled", "array": "torch"}[backend]
        found.append([sol.y.detach(), *torch.autograd.grad(weighted(sol), [y, *NUMBERS])])
    for compiled, expected in zip(*found, strict=True):
        torch.testing.assert_close(compiled, expected, rtol=0, atol=1e-12 * float(expected.abs().max()))
    with torch.no_grad():  # as an optimiser does
        NUMBERS[0].mul_(1.01)
    runs = [solve(system, method, (0, 1), y0, dt=0.1, backend=backend).y for backend in ("compiled", "array")]
    np.testing.assert_allclose(*runs, rtol=0, atol=1e-13)


def test_second_derivatives_by_tensors_that_a_function_holds():
    def ends(k):
        system = HamiltonianSystem(lambda q: (k * q**2).sum(-1) / 2 + (q**4).sum(-1), ndof=2)
        return solve(system, "rk4", (0, 0.5), torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64), dt=0.1).y[:, -1]

    assert torch.autograd.gradgradcheck(ends, torch.tensor([1.0, 2.0], dtype=torch.float64, requires_grad=True))


def of_two(q):
    return torch.cos(q[..., 0] - q[..., 1]) + (q**4).sum(-1) / 4


def verlet_by_hand(y, mass, n_steps, dt):
    q, p = y.chunk(2)
    force = torch.func.grad(of_two)
    for _ in range(n_steps):
        p = p - dt / 2 * force(q)
        q = q + dt * (p / mass if mass.ndim < 2 else torch.linalg.solve(mass, p))
        p = p - dt / 2 * force(q)
    return torch.cat([q, p])


OF_MASSES = ("kahan_li8", "srkn11b", "takahashi_imada", "gauss_legendre6", "rk4")
MASSES = {"one": 1.7, "each": [1.7, 0.6], "matrix": [[1.7, 0.3], [0.3, 0.9]]}


@pytest.mark.parametrize(
    ("mass", "method"),
    [
        pytest.param(mass, m, marks=pytest.mark.slow if (i - k) % 3 else (), id=f"{name}-{m}")
        for i, (name, mass) in enumerate(MASSES.items())
        for k, m in enumerate(OF_MASSES)
    ],
)
def test_gradients_flow_to_masses(mass, method):
    y0, mass = torch.tensor([0.3, 0.5, -0.2, 0.7], dtype=torch.float64), torch.tensor(mass, dtype=torch.float64)
    mass.requires_grad_()
    system = HamiltonianSystem(of_two, ndof=2, mass=mass, y0=y0.numpy())
    (expected,) = torch.autograd.grad(verlet_by_hand(y0, mass, 10, 0.1).square().sum(), mass)
    sol = solve(system, "verlet", (0, 1), y0, dt=0.1)
    assert sol.stats["backend"] == "compiled"
    (found,) = torch.autograd.grad(sol.y[:, -1].square().sum(), mass)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-13)
    # of small steps
    sol = solve(system, method, (0, 1), y0, dt=0.02)
    assert sol.stats["backend"] == "compiled"
    (near,) = torch.autograd.grad(sol.y[:, -1].square().sum(), mass)
    torch.testing.assert_close(near, expected, rtol=0, atol=0.03)
    small = 1e-5 * torch.ones_like(mass)
    ends = [
        solve(HamiltonianSystem(of_two, ndof=2, mass=(mass + sign * small).detach()), method, (0, 1), y0, dt=0.02)
        for sign in (1, -1)
    ]
    slope = (ends[0].y[:, -1].square().sum() - ends[1].y[:, -1].square().sum()) / 2e-5
    torch.testing.assert_close(near.sum(), slope, rtol=0, atol=1e-8)


def test_masses_may_change_between_runs():
    y0, mass = torch.tensor([0.3, 0.5, -0.2, 0.7], dtype=torch.float64), torch.tensor([1.0, 2.0], dtype=torch.float64)
    mass.requires_grad_()
    system = HamiltonianSystem(of_two, ndof=2, mass=mass, y0=y0.numpy(), stiffness_matrix=np.eye(2))
    for values in ([1.0, 2.0], [0.5, 3.0]):
        with torch.no_grad():
            mass.copy_(torch.tensor(values))
        expected = verlet_by_hand(y0, mass.detach(), 10, 0.1)
        torch.testing.assert_close(solve(system, "verlet", (0, 1), y0, dt=0.1).y[:, -1], expected, rtol=0, atol=1e-14)
        sol = solve(system, "verlet", (0, 1), dt=0.1)
        assert "`mass` requires gradients" in sol.stats["backend"]
        np.testing.assert_allclose(sol.y[:, -1], expected, rtol=0, atol=1e-14)
    with pytest.raises(ValueError, match=r"^`mass` requires gradients, .* pass mass\.detach"):
        solve(system, "linear_srkn6b", (0, 1), y0, dt=0.1)


BODIES = {
    "three in space": ("-G*m1*m2/r", [1.0, 0.5, 0.2], 3, "kahan_li8", {}),
    "with softening": ("-G*m1*m2/r", [1.0, 0.5, 0.2], 2, "srkn11b", {"softening": 0.1}),
    "in a box": ("G*exp(-r)", [1.0, 0.5, 0.7], 1, "verlet", {"box": 6.0, "cutoff": 2.5}),
    "two on a line": ("G*(r - 1)**2/2", [1.3, 0.6], 1, "gauss_legendre4", {}),
    "by Runge and Kutta": ("G*(r - 1)**2/2", [1.3, 0.6], 1, "rk4", {}),
}


@pytest.mark.parametrize("batch", [(), (3,)], ids=["one", "batch"])
@pytest.mark.parametrize("kind", BODIES)
def test_gradients_flow_to_masses_and_parameters_of_bodies(kind, batch):
    V, masses, dim, method, options = BODIES[kind]
    system = HamiltonianSystem.pairs(V, masses=masses, dim=dim, params={"G": 1.2}, **options)
    rng = np.random.default_rng(3)
    q = np.arange(len(masses))[:, None] * np.eye(dim)[0] * 1.9 + 0.1 * rng.normal(size=(*batch, len(masses), dim))
    q, p = (x.reshape(*batch, system.ndof) for x in (q, 0.2 * rng.normal(size=q.shape)))
    y0 = np.concatenate([q, p], axis=-1)

    def end(m, G):
        sol = solve(system, method, (0.0, 1.0), y0, dt=0.05, t_eval=[1.0], params={"masses": m, "G": G})
        assert sol.stats["backend"] == "compiled"
        return (sol.y**2).sum()

    m, G = (torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (masses, 1.2))
    of_masses, of_G = torch.autograd.grad(end(m, G), (m, G))
    h = 1e-5
    differences = [(end(masses + h * e, 1.2) - end(masses - h * e, 1.2)) / (2 * h) for e in np.eye(len(masses))]
    scale = np.abs(differences).max()
    np.testing.assert_allclose(of_masses, differences, rtol=0, atol=1e-7 * scale)
    np.testing.assert_allclose(of_G, (end(np.array(masses), 1.2 + h) - end(np.array(masses), 1.2 - h)) / (2 * h), 1e-6)


@pytest.mark.parametrize("method", ["verlet", "rk4", "linear_aba864", "mollified_impulse", "tao4", "strang_parts"])
def test_other_values_of_parameters_compile_nothing(method, monkeypatch):
    system = HamiltonianSystem.from_sympy("(p1**2/m + p2**2 + k*q1**2 + q2**2)/2 + g*q1*q2**2", params=PARAMS)
    solve(system, method, (0, 1), start(system, ()), dt=0.1)
    monkeypatch.setattr("sympflow.kernels.runs.compiled", None)
    for values in ({"g": 0.7}, {"k": 1.3, "m": 0.8}):
        found, expected = (
            solve(system, method, (0, 1), start(system, ()), dt=0.1, params=values, backend=backend)
            for backend in ("compiled", "array")
        )
        np.testing.assert_allclose(found.y, expected.y, rtol=0, atol=1e-14)


def test_float32_is_computed_in_double_and_rounded_at_the_outputs():
    y0 = torch.tensor(start(CUBIC, ()), dtype=torch.float32, requires_grad=True)
    sol = solve(CUBIC, "verlet", (0, 2), y0, dt=0.1)
    double = solve(CUBIC, "verlet", (0, 2), y0.detach().double(), dt=0.1)
    assert sol.y.dtype == torch.float32
    torch.testing.assert_close(sol.y.detach(), double.y.float(), rtol=0, atol=0)
    assert torch.autograd.grad(weighted(sol), y0)[0].dtype == torch.float32


def test_masses_of_bodies_are_parameters_of_a_run():
    masses, y0 = np.array([1.0, 0.5, 0.2]), np.arange(18.0)
    system = HamiltonianSystem.pairs("-1/r", masses=[1.0, 1.0, 1.0])
    anew = HamiltonianSystem.pairs("-1/r", masses=masses)
    sol = solve(system, "verlet", (0.0, 1.0), y0, dt=0.01, params={"masses": masses})
    expected = solve(anew, "verlet", (0.0, 1.0), y0, dt=0.01)
    np.testing.assert_array_equal(sol.y, expected.y)
    np.testing.assert_array_equal(sol.energy(), expected.energy())
    for wrong, message in (([1.0, 2.0], "one for each of the 3 bodies"), ([1.0, 0.0, 1.0], "not positive")):
        with pytest.raises(ValueError, match=f"^`params` has masses .*{message}"):
            solve(system, "verlet", (0.0, 1.0), y0, dt=0.01, params={"masses": wrong})


def test_first_and_second_derivatives():
    y0 = torch.tensor(start(CUBIC, (2,)), requires_grad=True)
    k = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)

    def states(y, k):
        return solve(CUBIC, "srkn6b", (0, 0.3), y, dt=0.1, t_eval=[0.13, 0.3], params={"k": k}).y

    assert torch.autograd.gradcheck(states, (y0, k))
    assert torch.autograd.gradgradcheck(states, (y0, k))


def test_a_chaotic_run():
    """Finite differences of the compiled run itself: arrays have other states there."""
    y0 = np.array([0.0, 0.1, 0.47, 0.1])
    system = HamiltonianSystem.from_sympy("(p1**2 + p2**2)/2 + (q1**2 + q2**2)/2 + q1**2*q2 - q2**3/3")
    run = {"t_span": (0, 100), "dt": 0.05, "t_eval": [100.0]}
    y = torch.tensor(y0, requires_grad=True)
    (gradient,) = torch.autograd.grad(weighted(solve(system, "verlet", y0=y, **run)), y)
    columns, h = [], 1e-7
    for e in np.eye(4):
        columns.append([float(weighted(solve(system, "verlet", y0=y0 + s * h * e, **run))) for s in (1, -1)])
    difference = (np.array(columns)[:, 0] - np.array(columns)[:, 1]) / (2 * h)
    np.testing.assert_allclose(gradient.numpy(), difference, rtol=1e-4, atol=1e-4 * np.abs(difference).max())


def test_rows_that_become_infinite_leave_the_others_alone():
    y0 = np.array([[0.1, 0.0, 0.2, 0.1], [0.0, 30.0, 0.0, 30.0], [0.0, 0.1, 0.3, 0.0]])
    y = torch.tensor(y0, requires_grad=True)
    sol = solve(CUBIC, "verlet", (0, 2), y, dt=0.1, diagnose=False)
    assert list(sol.status) == [0, -1, 0]
    (gradient,) = torch.autograd.grad(sol.y[[0, 2], :, -1].sum() + sol.y[1, :, 1].sum(), y)
    for row, last in ((0, -1), (1, 1), (2, -1)):
        alone = torch.tensor(y0[row], requires_grad=True)
        t_eval = sol.t[: 2 if last == 1 else None]
        part = solve(CUBIC, "verlet", (0, 2), alone, dt=0.1, t_eval=t_eval, diagnose=False)
        expected = torch.autograd.grad(part.y[:, last].sum(), alone)[0]
        torch.testing.assert_close(gradient[row], expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize("method", ["verlet", "rk4", "gauss_legendre4"])
def test_transforms_of_runs(method):
    """Jacobians and Hessians of a compiled run by torch.func, forward and reverse, by tensor operations."""
    y0 = torch.tensor(start(CUBIC, ()))

    def end(y):
        return solve(CUBIC, method, (0, 0.5), y, dt=0.1, t_eval=[0.5]).y[:, 0]

    J = torch.autograd.functional.jacobian(end, y0)
    for each in (torch.func.jacrev(end)(y0), torch.func.jacfwd(end)(y0)):
        torch.testing.assert_close(each, J, rtol=1e-12, atol=1e-13)
    H = torch.autograd.functional.hessian(lambda y: (end(y) ** 2).sum(), y0)
    torch.testing.assert_close(torch.func.hessian(lambda y: (end(y) ** 2).sum())(y0), H, rtol=1e-11, atol=1e-12)
    with pytest.raises(TypeError, match=r"^`params` has k that torch\.func"):
        torch.func.jvp(lambda k: solve(CUBIC, method, (0, 1), y0, dt=0.1, params={"k": k}).y, (ONE,), (ONE,))


def test_dense_output_has_the_gradients_of_outputs():
    found = []
    for more in ({"dense_output": True}, {"t_eval": [1.234]}):
        y = torch.tensor(start(CUBIC, ()), requires_grad=True)
        sol = solve(CUBIC, "srkn6b", (0, 2), y, dt=0.1, **more)
        state = sol.y[:, 0] if not sol.sol else sol.sol(1.234)
        found.append(torch.autograd.grad(state.sum(), y)[0])
    torch.testing.assert_close(*found, rtol=1e-13, atol=0)


def test_weights_are_arguments():
    """A step of an optimizer changes the run, and nothing is compiled again; what is not followed is refused."""
    net, V = network("two layers")
    system, y0 = HamiltonianSystem(V, ndof=2), start(CUBIC, (3,))
    solve(system, "verlet", (0, 1), y0, dt=0.1)
    with torch.no_grad():
        net[2].weight *= 1.5
    again = solve(system, "verlet", (0, 1), y0, dt=0.1)
    np.testing.assert_array_equal(again.y, solve(HamiltonianSystem(V, ndof=2), "verlet", (0, 1), y0, dt=0.1).y)
    net[2] = torch.nn.Linear(9, 8).double()
    with pytest.raises(ValueError, match=r"^`potential` has another value than when it was traced"):
        solve(system, "verlet", (0, 1), y0, dt=0.1)


def test_second_derivatives_by_weights_through_two_runs():
    net, V = network("two layers")
    system, found = HamiltonianSystem(V, ndof=2), []
    for backend in ("compiled", "array"):
        middle = solve(system, "verlet", (0, 0.5), torch.tensor(start(system, (2,))), dt=0.1, backend=backend).y[
            ..., -1
        ]
        end = solve(system, "verlet", (0, 0.5), middle, dt=0.1, t_eval=[0.5], backend=backend).y
        first = torch.autograd.grad((end**2).sum(), [p for p in net.parameters() if p.numel() > 1], create_graph=True)
        found.append(torch.autograd.grad(sum((g**2).sum() for g in first), net[2].weight)[0])
    torch.testing.assert_close(*found, rtol=1e-11, atol=1e-14)


@pytest.mark.parametrize("asked", [{"events": lambda t, y: y[0] - 0.05}, {"on_domain_exit": "stop"}])
def test_outputs_have_the_same_gradients_with_events_and_up_to_a_stop(asked):
    system = HamiltonianSystem.from_sympy("(p**2 + q**2)/2", domain=Box([-1, -0.35], [1, 1]))
    found = []
    for more in (asked, {}):
        y = torch.tensor([0.3, 0.2], dtype=torch.float64, requires_grad=True)
        sol = solve(system, "verlet", (0, 3), y, dt=0.07, **more)
        n = len(found[0][0]) if found else len(sol.t)
        found.append((sol.t[:n], torch.autograd.grad(sol.y[:, n // 2].sum() + sol.y[0, n - 1], y)[0]))
    assert (n < len(sol.t)) == ("on_domain_exit" in asked)
    torch.testing.assert_close(found[0][1], found[1][1], rtol=1e-14, atol=0)
