"""One run made in every way is one run: compiled, by arrays and tensors, in a batch, in windows, there and back."""

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline

from sympflow import HamiltonianSystem, doubled, get, solve, systems
from sympflow.integrators import clocks, grid_runs, progress
from sympflow.integrators.tableaux import FIXED

made = HamiltonianSystem.from_sympy
EPS = np.finfo(float).eps
TIMES, TURN = np.linspace(0, 5, 40), np.linspace(0, 2 * np.pi, 30)
SINE = CubicSpline(TIMES, 1 + 0.3 * np.sin(TIMES))
UNEVEN = CubicSpline(5 * (TIMES / 5) ** 1.3, np.cos(TIMES))
WAVE = np.append(1 + 0.3 * np.sin(TURN[:-1]), 1)
PERIODIC = CubicSpline(TURN, WAVE, bc_type="periodic", extrapolate="periodic")
TURNING = "(p1**2 + p2**2)*(1 + q1**2 + q2**2)/2 + (q1**2 + q2**2)**2/4"
BONDS = " + ".join(f"p{i}**2/2 + (q{i + 1} - q{i})**2/2 + 0.{i}*(q{i + 1} - q{i})**4" for i in range(1, 20))
STIFF = "p1**2/2 + p2**2/2 + 8*q1**2 + q2**2/2 + q1*q2*cos(1.3*t) + q1**4/4*(1 + sin(t)) + q2**4/4"
POLAR = "p1**2/2*(1 + 0.2*sin(t)) + p2**2/(2*(1 + q1**2)) + q1**2/2 + q2**2/2*(1 + a)"


def far(d):
    """A state of d coordinates and d momenta, none of which are alike."""
    return np.random.default_rng(d).normal(size=2 * d)


def bodies(n, dim):
    """Bodies of several kinds, in a box with a cut-off: written out or in memory."""
    rng = np.random.default_rng(dim)
    y0 = np.concatenate([rng.uniform(-9, 9, n * dim), rng.standard_normal(n * dim)])
    masses, kinds = rng.uniform(1, 2, n), {"c": rng.uniform(-1, 1, n)}
    space = {"dim": dim, "box": 4.0 + np.arange(dim), "cutoff": 1.9}
    V = "c1*c2*(exp(-k*r) + log(1 + r)/(m1 + m2))"
    return HamiltonianSystem.pairs(V, masses=masses, bodies=kinds, params={"k": 0.5}, y0=y0, dt=0.01, **space)


def many(forces="", kinetic="p20**2/2", **more):
    """A chain of 20 bodies, whose terms are looped over."""
    H = f"{kinetic} + {BONDS} + cos(q1){forces}"
    return made(H, y0=np.linspace(-0.3, 0.3, 40), dt=0.02, **more)


SYSTEMS = {
    "separable": systems.henon_heiles(),
    "not separable": made(TURNING, y0=[0.6, 0.1, -0.2, 0.5], dt=0.05),
    "product": systems.nonseparable(),
    "many terms": many(),
    "many, relativistic": many(kinetic="sqrt(1 + p20**2)"),
    "many, damped": many(damping=0.2),
    "many, driven": many(" - q1*cos(1.3*t)", time="t"),
    "many, driven and damped": many(" - q1*cos(1.3*t)", time="t", damping=np.linspace(0, 0.2, 20)),
    "damped by a matrix": made(TURNING, damping=[[0.3, 0.1], [0.1, 0.2]], y0=[0.6, 0.1, -0.2, 0.5], dt=0.02),
    "pendulum": made("p**2/2 - cos(q)*(1 + 0.3*cos(1.7*t))", time="t", y0=[1.0, 0.3], dt=0.1),
    "duffing": made("p**2/2 - q**2/2 + q**4/4 - 0.3*q*cos(1.2*t)", time="t", damping=0.2, y0=[1.0, 0.3], dt=0.1),
    "even samples": made("p**2/2 + a*q**2/2", params={"a": SINE}, y0=[1.0, 0.3], dt=0.1),
    "uneven samples": made("p**2/2 + a*q**2/2", params={"a": UNEVEN}, y0=[1.0, 0.3], dt=0.1),
    "periodic samples": made("a*p**2/2 + q**2/2", params={"a": PERIODIC}, y0=[1.0, 0.3], dt=0.5),
    "turning, driven": made("p**2/2 + q**4/4 - 0.3*q*cos(1.3*t) + p*q*sin(t)", time="t", y0=[0.3, 0.1], dt=0.02),
    "stiff, driven": made(STIFF, time="t", y0=[0.3, 0.5, 0.2, -0.1], dt=0.05),
    "polar, driven": made(POLAR, params={"a": SINE}, y0=[0.3, 0.5, 0.2, -0.1], dt=0.05),
    "kepler": systems.kepler(0.3),
    "bodies": HamiltonianSystem.pairs("-m1*m2/r", masses=[1.0, 0.5, 0.3], dim=2, y0=far(6), dt=0.01),
    "damped bodies": HamiltonianSystem.pairs(
        "-m1*m2/sqrt(r**2 + 0.01)", masses=np.linspace(1.0, 2.0, 10), dim=2, damping=0.1, y0=far(20), dt=0.01
    ),
    "few damped bodies": HamiltonianSystem.pairs(
        "-m1*m2/r", masses=[1.0, 0.5, 0.3], dim=2, damping=0.1, y0=far(6), dt=0.01
    ),
    "kinds in a box": bodies(5, 2),
    "many on a line": bodies(20, 1),
    "many in a box": bodies(20, 3),
    "chain": HamiltonianSystem.lattice(
        shape=12, onsite="k*q**2/2 + q**4/4", bond="r**2/2", params={"k": np.linspace(1, 2, 12)}, y0=far(12), dt=0.01
    ),
    "function": HamiltonianSystem(
        hamiltonian=lambda q, p: ((q**2 + 1) * (p**2 + 1) / 2).sum(-1), ndof=1, y0=[0.3, 0.8], dt=0.05
    ),
}
SYSTEMS["forced"] = doubled(SYSTEMS["turning, driven"], "-0.1*p*abs(p) + cos(2*t)").physical
ANY = ("gauss_legendre4", "rk4")
ROWS = [
    *(("separable", m, {}) for m in ("verlet", "chin4a", "impulse", "mollified_impulse", "strang_parts", "tao4")),
    *(("separable", m, {}) for m in ("linear_omelyan4", "rk4", "sympflow")),
    *(("separable", m, {"compensated": True}) for m in ("kahan_li8", "gauss_legendre4")),
    *(("not separable", m, {}) for m in ("implicit_midpoint", "gauss_legendre6", "gauss_legendre8", *ANY)),
    ("product", "tao4", {"omega": 4.0}),
    *(("many terms", m, {}) for m in ("srkn14a", "implicit_midpoint", "rk4")),
    ("many, relativistic", "verlet", {}),
    *((f"many, {more}", m, {}) for more in ("damped", "driven", "driven and damped") for m in ("verlet", "chin4c")),
    ("many, driven and damped", "rk4", {}),
    ("damped by a matrix", "rk4", {}),
    *(("pendulum", m, {}) for m in ("verlet", "leapfrog", "omelyan6", "gauss_legendre4")),
    *(("duffing", m, {}) for m in ("verlet", "chin4c", "kahan_li6")),
    *((f"{kind} samples", m, {}) for kind in ("even", "uneven") for m in ("verlet", "chin4c")),
    *((f"{kind} samples", "rk4", {}) for kind in ("even", "periodic")),
    *(("periodic samples", m, {}) for m in ("verlet", "kahan_li8")),
    *(("turning, driven", m, {}) for m in FIXED),
    ("forced", "rk4", {}),
    *(("stiff, driven", m, {}) for m in ("linear_omelyan4", "tao4")),
    *(("polar, driven", m, {}) for m in ("strang_parts", "kahan_li6_parts")),
    ("kepler", "log_leapfrog", {}),
    *(("bodies", m, {}) for m in (*ANY, "tao4", "log_kahan_li8")),
    *(("damped bodies", m, {}) for m in (*ANY, "verlet")),
    ("few damped bodies", "verlet", {}),
    *((kind, m, {}) for kind in ("kinds in a box", "many on a line", "many in a box") for m in ("verlet", "chin4a")),
    *(("chain", m, {}) for m in ("implicit_midpoint", "heun3", "srkn6b")),
    ("chain", "log_kahan_li8", {"shift": 200.0}),
    *(("function", m, {}) for m in ("tao4", "gauss_legendre4")),
]
EACH = pytest.mark.parametrize(
    ("name", "method", "options"), ROWS, ids=lambda x: x if isinstance(x, str) else "+".join(x)
)


@pytest.fixture
def windows(monkeypatch):
    """Runs are made in windows of few steps, where progress is asked for."""
    for name, size in {"ONE": 8, "MANY": 24, "ARRAY_STEPS": 3, "FEW_STEPS": 2, "LEAST": 2, "DENSE": 1}.items():
        monkeypatch.setattr(grid_runs, name, size)
    monkeypatch.setattr(clocks, "FIRST_CHUNK", 2)
    monkeypatch.setattr(clocks, "LARGEST_CHUNK", 4)
    monkeypatch.setattr(grid_runs.Pace, "took", lambda self, n: None)
    monkeypatch.setattr(progress, "BETWEEN", 0.0)


@EACH
def test_a_run_is_the_same_in_every_way(name, method, options, windows):
    """Compiled, by arrays and back to rounding; from tensors, in a batch and in windows to the bit."""
    system, method = SYSTEMS[name], get(method)(**options)
    y0 = system.y0 * np.linspace(0.9, 1.0, 11)[:, None]
    times = 0.3 + method.step_length(system) * np.array([0.0, 1.0, 7.3, 7.3, 15.0, 20.4])
    span = 0.3, times[-1]
    found = solve(system, method, span, y0, t_eval=times)
    assert found.stats["backend"] == "compiled"
    close = {"rtol": 0, "atol": 2000 * EPS * max(1.0, np.abs(found.y).max())}
    if not options.get("compensated"):
        arrays = solve(system, method, span, y0, t_eval=times, backend="array")
        np.testing.assert_allclose(found.y, arrays.y, **close)
        counts = found.stats["force_evaluations"], arrays.stats["force_evaluations"]
        assert counts[0] <= counts[1] if method.symplectic else counts[0] == counts[1]  # compiled kicks are merged
    if not method.arrays_only:
        tensors = solve(system, method, span, torch.tensor(y0), t_eval=times)
        assert tensors.stats["backend"] == "compiled"
        np.testing.assert_array_equal(tensors.y.numpy(), found.y)
    if method.symplectic and not (method.keeps or system.friction):
        back = solve(system, method, (times[4], span[0]), found.y[..., 4], t_eval=[span[0]])
        np.testing.assert_allclose(back.y[..., 0], y0, **close)
    np.testing.assert_array_equal(solve(system, method, span, y0[1], t_eval=times).y, found.y[1])
    for start, when in ((y0, times), (y0, None), (y0[1], None)):
        told: list[tuple[float, float]] = []
        whole = solve(system, method, span, start, t_eval=when)
        cut = solve(system, method, span, start, t_eval=when, progress=lambda *now, told=told: told.append(now))
        assert len(told) > 3 or not method.on_grid
        np.testing.assert_array_equal(cut.y, whole.y)
        assert {**cut.stats, "wall_time": 0} == {**whole.stats, "wall_time": 0}


@EACH
def test_an_event_has_the_state_of_the_dense_output(name, method, options):
    system, y0 = SYSTEMS[name], SYSTEMS[name].y0
    span, middle = (0.3, 0.3 + 20.4 * system.dt), 0.3 + 9.7 * system.dt

    def passed(t, y):
        return (t - middle) / system.dt + 0.1 * (y[0] - y0[0])

    sol = solve(system, get(method)(**options), span, y0, events=passed, dense_output=True)
    (t,), (y,) = sol.t_events[0], sol.y_events[0]
    assert abs(passed(t, y)) < 1e-11
    np.testing.assert_allclose(sol.sol(t), y, rtol=0, atol=1e-12)
    np.testing.assert_allclose(sol.sol(sol.t), sol.y, rtol=0, atol=1e-12)
