"""Splines of SciPy in functions of the user: compiled, with their coefficients as data."""

import pickle

import numpy as np
import pytest
from scipy.interpolate import (
    CubicSpline,
    NdBSpline,
    PchipInterpolator,
    PPoly,
    RectBivariateSpline,
    RegularGridInterpolator,
    UnivariateSpline,
    make_interp_spline,
)

from sympflow import HamiltonianSystem, solve

EPS = np.finfo(float).eps
X = np.linspace(-3.0, 3.0, 41)
UNEVEN = np.sort(np.random.default_rng(0).uniform(-3.0, 3.0, 40))
WELL = X**4 / 4 - X**2 / 2
GRID = np.stack(np.meshgrid(X, X, indexing="ij"), -1)
V2 = (GRID**2).sum(-1) / 2 + GRID[..., 0] ** 2 * GRID[..., 1] - GRID[..., 1] ** 3 / 3
COARSE = np.linspace(-2.0, 2.0, 12)
CUBE = np.stack(np.meshgrid(COARSE, COARSE, COARSE, indexing="ij"), -1)
V3 = (CUBE**2).sum(-1) / 2 + CUBE.prod(-1) / 4

cubic, uneven = CubicSpline(X, WELL), CubicSpline(UNEVEN, np.sin(UNEVEN))
angles = np.linspace(0.0, 2 * np.pi, 31)
periodic = CubicSpline(angles, np.append(-np.cos(angles[:-1]), -1.0), bc_type="periodic")
field = make_interp_spline(UNEVEN, np.stack([np.sin(UNEVEN), np.cos(UNEVEN)], -1), k=5)
smoothed = UnivariateSpline(X, WELL, s=0, k=5)
held = UnivariateSpline(X, WELL, s=0, k=4, ext=3)
surface = RectBivariateSpline(X, X, V2)
bounded = RegularGridInterpolator((X, X), V2, method="cubic")
quintic = RegularGridInterpolator((X, X), V2, method="quintic", bounds_error=False, fill_value=None)
volume = RegularGridInterpolator((COARSE,) * 3, V3, method="cubic")
tensor = NdBSpline(volume._spline.t, volume._spline.c, volume._spline.k)
POTENTIALS = {
    "CubicSpline": (lambda q: cubic(q[..., 0]), 1),
    "uneven knots": (lambda q: uneven(q[..., 0]) + q[..., 0] ** 2, 1),
    "periodic": (lambda q: periodic(q[..., 0]), 1),
    "components of a BSpline": (lambda q: (field(q[..., 0]) ** 2).sum(-1) + q[..., 0] ** 2, 1),
    "UnivariateSpline": (lambda q: smoothed(q[..., 0]), 1),
    "UnivariateSpline, held": (lambda q: held(q[..., 0]), 1),
    "a derivative": (lambda q: smoothed(q[..., 0], 2) ** 2, 1),
    "each of three": (lambda q: cubic(q).sum(-1), 3),
    "RectBivariateSpline": (lambda q: surface.ev(q[..., 0], q[..., 1]), 2),
    "its call": (lambda q: surface(q[..., 0], q[..., 1], grid=False), 2),
    "RegularGridInterpolator": (lambda q: bounded((q[..., 0], q[..., 1])), 2),
    "quintic": (lambda q: quintic((q[..., 0], q[..., 1])), 2),
    "three axes": (lambda q: volume((q[..., 0], q[..., 1], q[..., 2])), 3),
    "NdBSpline": (tensor, 3),
}


def _system(name):
    V, d = POTENTIALS[name]
    return HamiltonianSystem(V, ndof=d), np.linspace(0.1, 0.4, 2 * d)


@pytest.mark.parametrize("name", POTENTIALS)
def test_values_are_those_of_scipy(name):
    V, d = POTENTIALS[name]
    system, _ = _system(name)
    q = np.random.default_rng(1).uniform(-1.9, 1.9, (200, d))
    expected = V(q)
    np.testing.assert_allclose(system.form.value(q), expected, rtol=0, atol=64 * EPS * np.abs(expected).max())
    steps = 1e-5 * np.eye(d)
    inside = q[np.abs(q).max(-1) < 1.5][:40]
    slope = np.stack([(V(inside + h) - V(inside - h)) / 2e-5 for h in steps], axis=-1)
    np.testing.assert_allclose(-system.force(inside), slope, rtol=0, atol=1e-7 * np.abs(slope).max())


@pytest.mark.parametrize("method", ["verlet", "srkn14a", "gauss_legendre4", "rk4"])
@pytest.mark.parametrize("name", ["CubicSpline", "uneven knots", "periodic", "RectBivariateSpline", "three axes"])
def test_runs_are_compiled_and_those_of_arrays(name, method):
    system, y0 = _system(name)
    batch = y0 + np.linspace(0.0, 0.5, 17)[:, None]
    runs = [solve(system, method, (0.0, 2.0), batch, dt=0.05, backend=b) for b in ("auto", "array")]
    assert runs[0].stats["backend"] == "compiled"
    np.testing.assert_allclose(runs[0].y, runs[1].y, rtol=0, atol=1e-12)
    alone = solve(system, method, (0.0, 2.0), batch[5], dt=0.05)
    np.testing.assert_array_equal(alone.y, runs[0].y[5])


@pytest.mark.parametrize(
    ("spline", "point"),
    [(cubic, 3.5), (cubic, -4.0), (uneven, 9.0), (periodic, -20.0), (periodic, 100.0), (held, 5.0), (held, -5.0)],
)
def test_beyond_the_data_as_scipy(spline, point):
    system = HamiltonianSystem(lambda q: spline(q[..., 0]), ndof=1)
    expected = spline(np.array([point]))
    np.testing.assert_allclose(system.form.value(np.array([[point]])), expected, rtol=1e-12)


def test_a_run_that_leaves_a_grid_with_bounds_ends():
    system, _ = _system("RegularGridInterpolator")
    sol = solve(system, "verlet", (0.0, 10.0), np.array([0.0, 2.0, 0.0, 3.0]), dt=0.01)
    assert sol.stats["backend"] == "compiled"
    assert sol.status == -1
    assert np.abs(sol.y[:2]).max() <= X[-1]


kinked = PchipInterpolator(X, WELL)
linear = RegularGridInterpolator((X, X), V2)
zero_beyond = UnivariateSpline(X, WELL, s=0, ext=1)


@pytest.mark.parametrize(
    ("V", "d", "message"),
    [
        (lambda q: PPoly(np.ones((4, 2)), [1.0, 0.0, -1.0])(q[..., 0]), 1, "decreasing breakpoints: make it with"),
        (lambda q: kinked(q[..., 0]), 1, "second derivative jumps: take a smoother one, such as CubicSpline"),
        (lambda q: cubic(q[..., 0], 1), 1, "second derivative jumps"),
        (lambda q: surface.ev(q[..., 0], q[..., 1], dx=1), 2, "second derivative jumps"),
        (lambda q: linear((q[..., 0], q[..., 1])), 2, "with kinks: pass method='cubic'"),
        (bounded, 2, r"gives shape \(1,\) for one state: call it with coordinates"),
        (lambda q: surface(q[..., 0], q[..., 1]), 2, "pass grid=False"),
        (lambda q: zero_beyond(q[..., 0]), 1, "pass ext=0 or 3"),
    ],
)
def test_what_is_not_recorded_says_why(V, d, message):
    with pytest.raises(TypeError, match=message):
        solve(HamiltonianSystem(V, ndof=d), "verlet", (0.0, 1.0), np.full(2 * d, 0.1), dt=0.1)


def test_programs_with_tables_can_be_pickled():
    system, _ = _system("CubicSpline")
    program = pickle.loads(pickle.dumps(system.form.program))
    q = np.linspace(-2.0, 2.0, 9)
    np.testing.assert_array_equal(program(q)[0], system.form.program(q)[0])
    assert str(program) == str(system.form.program)


def test_a_spline_in_a_text_is_sent_to_functions():
    with pytest.raises(ValueError, match=r"^`expression` cannot be parsed: .* Give a potential by a function, Ham"):
        HamiltonianSystem.from_sympy("p**2/2 + V(q)", params={"V": cubic})


def test_gradients_flow_through_compiled_runs():
    torch = pytest.importorskip("torch")
    system, y0 = _system("RectBivariateSpline")

    def end(y):
        return solve(system, "verlet", (0.0, 1.0), y, dt=0.05, t_eval=[1.0])

    y = torch.tensor(y0, requires_grad=True)
    sol = end(y)
    assert sol.stats["backend"] == "compiled"
    (found,) = torch.autograd.grad(sol.y.sum(), y)
    h = 1e-6
    differences = [(end(y0 + h * e).y.sum() - end(y0 - h * e).y.sum()) / (2 * h) for e in np.eye(4)]
    np.testing.assert_allclose(found, differences, rtol=1e-8)
