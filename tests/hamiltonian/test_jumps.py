"""Jumps, impulses and periods that are read from the expression of H."""

import itertools
import math
import pickle

import numpy as np
import pytest
import sympy as sp
import torch
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline, PPoly, make_interp_spline

import sympflow
from sympflow import HamiltonianSystem, solve
from sympflow.hamiltonian.times import check_period
from sympflow.interop.scipy import as_scipy
from sympflow.interop.torchdiffeq import odeint

made = HamiltonianSystem.from_sympy

q, p, t = sp.symbols("q p t", real=True)
PI = math.pi


def driven(drive, **scene):
    """A free body under a force of t."""
    return made(p**2 / 2 - q * drive, time="t", **scene)


# kinks ---------------------------------------------------------------------------------------------


def triangle(x):
    """asin(sin x), by whole turns."""
    turn = np.mod(x + PI / 2, 2 * PI) - PI
    return PI / 2 - np.abs(turn)


KINKS = {
    "asin(sin(3*t))": lambda s: triangle(3 * s),
    "acos(cos(t + 0.4))": lambda s: PI / 2 - triangle(s + 0.4 + PI / 2),
    "asin(cos(t))*t": lambda s: triangle(s + PI / 2) * s,
    "abs(sin(t))": lambda s: np.abs(np.sin(s)),
    "Max(sin(2*t), 0.3)": lambda s: np.maximum(np.sin(2 * s), 0.3),
    "Min(t, 5) + abs(t - 2.03)": lambda s: np.minimum(s, 5) + np.abs(s - 2.03),
    "sqrt(1 - cos(2*t))": lambda s: math.sqrt(2) * np.abs(np.sin(s)),
    "t*(1 + sin(t))**1.5": lambda s: s * np.abs(math.sqrt(2) * np.cos(s / 2 - PI / 4)) ** 3,
    "exp(-sqrt(cosh(t - 2.03) - 1))": lambda s: np.exp(-math.sqrt(2) * np.abs(np.sinh((s - 2.03) / 2))),
    "sqrt(1 - cos(t)**3)": lambda s: np.sqrt(2 + 2 * np.cos(s) + 2 * np.cos(s) ** 2) * np.abs(np.sin(s / 2)),
    "t*acos(0.5 + 0.5*cos(2*t))": lambda s: s * np.arccos(np.minimum(0.5 + 0.5 * np.cos(2 * s), 1)),
}


@pytest.mark.parametrize("drive", KINKS)
def test_methods_of_high_order_keep_it_at_kinks_in_t(drive):
    force, ends = KINKS[drive], np.linspace(0, 12, 7)
    exact = solve_ivp(
        lambda s, y: [y[1], force(s) - y[0]], (0, 12), [1, 0], "DOP853", ends, rtol=1e-13, atol=1e-13, max_step=5e-3
    )
    sol = solve(made(f"p**2/2 + q**2/2 - q*({drive})", time="t"), "kahan_li8", (0, 12), [1, 0], dt=0.05, t_eval=ends)
    np.testing.assert_allclose(sol.y, exact.y, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "drive",
    [
        lambda s: np.abs(np.sin(s)),
        lambda s: np.maximum(np.sin(s), 0.2),
        lambda s: np.arcsin(np.sin(s)),
        lambda s: np.sqrt(1 - np.cos(2 * s)),
    ],
)
def test_kinks_of_functions_are_met(drive):
    y, ends = [1, 0], [0, *np.arange(1, 6) * np.pi / 2, *np.arcsin(0.2) + np.pi * np.arange(3), 9]
    ends += [np.pi - np.arcsin(0.2), 3 * np.pi - np.arcsin(0.2)]
    for a, b in itertools.pairwise(sorted(x for x in ends if x <= 9)):  # between all kinks
        y = solve_ivp(lambda s, y: [y[1], drive(s) - y[0]], (a, b), y, "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    system = HamiltonianSystem(
        potential=lambda s, q: q[..., 0] ** 2 / 2 - q[..., 0] * drive(s), ndof=1, time=True, y0=[1, 0]
    )
    sol = solve(system, "kahan_li8", (0, 9), dt=0.05)
    np.testing.assert_allclose(sol.y[:, -1], y, rtol=0, atol=1e-10)


def bent(w=1.0, k=1.0, T=9.0):
    """[q, p] at T of q'' = |sin wt| − kq from (1, 0)."""
    y, ends = [1.0, 0.0], [*np.arange(0, T, PI / w), T]
    for a, b in itertools.pairwise(ends):
        own = solve_ivp(
            lambda s, y: [y[1], abs(math.sin(w * s)) - k * y[0]], (a, b), y, "DOP853", rtol=1e-13, atol=1e-13
        )
        y = own.y[:, -1]
    return y


BENT = made("p**2/2 + k*q**2/2 - q*abs(sin(w*t))", time="t", params={"w": 1.0, "k": 1.0}, y0=[1, 0])


@pytest.mark.parametrize(
    ("params", "method"),
    [
        ({"w": [1.0, 1.3]}, "kahan_li8"),
        ({"w": [1.1, 1.3]}, "gauss_legendre6"),
        ({"k": [1.1, 2.0]}, "kahan_li8"),
        ({"k": [1.1, 2.0], "w": [1.3, 1.3]}, "kahan_li8"),
    ],
)
@pytest.mark.parametrize("options", [{}, {"t_eval": [4.0, 9.0]}, {"dense_output": True}], ids=str)
def test_trajectories_with_parameters_of_their_own_land_on_kinks(params, method, options):
    sol = solve(BENT, method, (0, 9), params=params, dt=0.05, **options)
    assert sol.y.shape == (2, 2, 2 if "t_eval" in options else 181)
    for i in range(2):
        exact = bent(**{name: values[i] for name, values in params.items()})
        np.testing.assert_allclose(sol.y[i, :, -1], exact, rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", ["w", "k"])
def test_gradients_by_parameters_that_move_kinks(name):
    value = torch.tensor(1.1, dtype=torch.float64, requires_grad=True)
    end = solve(BENT, "kahan_li8", (0, 9), params={name: value}, dt=0.05).y[0, -1]
    (slope,) = torch.autograd.grad(end, value)
    h = 1e-4
    difference = (bent(**{name: 1.1 + h})[0] - bent(**{name: 1.1 - h})[0]) / (2 * h)
    assert end.item() == pytest.approx(bent(**{name: 1.1})[0], abs=1e-11)
    assert slope.item() == pytest.approx(difference, rel=1e-5)


def test_fixed_steps_of_torchdiffeq_land_on_kinks():
    """With steps of half the length the error of order 4 is 16 times smaller."""
    y0, ends, right = torch.tensor([1.0, 0.0]).double(), torch.tensor([0.0, 9.0]).double(), bent()
    errors = [
        np.abs(odeint(BENT, y0, ends, method="rk4", options={"step_size": h})[-1].numpy() - right).max()
        for h in (0.1, 0.05)
    ]
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.2)


def test_runs_that_do_not_land_on_kinks_warn(tmp_path):
    for run in (
        lambda: solve(BENT, "kahan_li8", (0, 9), dt=0.05, store=tmp_path / "run.zarr"),
        lambda: solve(BENT, "kahan_li8", (0, 9), dt=0.05, params={"w": [1.1, 1.3]}),
        lambda: solve(BENT, "mclachlan4", (0, 9), dt=0.05),
        lambda: sympflow.lyapunov(BENT, "kahan_li8", (0, 9), dt=0.05),
        lambda: odeint(BENT, torch.tensor([1.0, 0.0]).double(), torch.tensor([0.0, 9.0]), method="kahan_li8"),
    ):
        with pytest.warns(RuntimeWarning, match="has a kink in t within a step, at t ="):
            run()


@pytest.mark.parametrize("drive", ["(t - 1.03)/Abs(t - 1.03)", "tanh(1/(t - 1.03))", "atan(1/(t - 1.03))"])
def test_a_divisor_that_vanishes_at_a_jump_is_no_pole(drive):
    """Two runs meet it within a step and at its end; a warning would be an error."""
    late, early = (
        solve(made(f"p**2/2 + q**2/2 + q*{drive}", time="t"), "gauss_legendre6", (0, 6), [1, 0], dt=dt).y[:, -1]
        for dt in (0.01, 6 / 571)
    )
    np.testing.assert_allclose(late, early, rtol=0, atol=1e-11)


def test_kinks_of_samples_are_met():
    times = np.linspace(0, 20, 41)
    a = CubicSpline(times, np.sin(times))
    system = made("p**2/2 + q**2/2 - q*Max(a, 0)", time="t", params={"a": a})
    sol = solve(system, "kahan_li8", (0, 20), [1, 0], dt=0.05)
    exact = solve_ivp(
        lambda s, y: [y[1], max(a(s), 0) - y[0]], (0, 20), [1, 0], "DOP853", rtol=1e-12, atol=1e-12, max_step=1e-2
    )
    np.testing.assert_allclose(sol.y[:, -1], exact.y[:, -1], rtol=0, atol=1e-8)


@pytest.mark.parametrize("periodic", [False, True])
def test_knots_of_linear_samples_are_met(periodic):
    times = np.array([0, 0.71, 1.5, 2.03, 3.3, 4.1])
    a = make_interp_spline(times, [0, 1, 0.2, -0.5, 0.8, 0], k=1)
    if periodic:
        a = PPoly.from_spline(a, extrapolate="periodic")
    end, y = 8.1 if periodic else 4.0, [1.0, 0.0]
    ends = [s for s in np.unique(np.concatenate([times, times + times[-1]])) if s < end]
    for low, high in itertools.pairwise([*ends, end]):
        own = solve_ivp(lambda s, y: [y[1], a(s) - y[0]], (low, high), y, "DOP853", rtol=1e-13, atol=1e-13)
        y = own.y[:, -1]
    system = made("p**2/2 + q**2/2 - q*a", time="t", params={"a": a})
    sol = solve(system, "kahan_li8", (0, end), [1, 0], dt=0.05)
    assert sol.stats["jumps"] == len(ends) - 1
    np.testing.assert_allclose(sol.y[:, -1], y, rtol=0, atol=1e-11)


def test_the_force_of_a_triangle_wave_is_that_of_its_sides():
    q = np.array([5.0, 1.0, -1.0, 2.0, 7.0])
    system = made("p**2/2 + asin(sin(q)) + 10*acos(cos(q))")
    y = np.stack([q, 0 * q], axis=-1)
    np.testing.assert_allclose(system.gradient(y)[:, 0], np.sign(np.cos(q)) + 10 * np.sign(np.sin(q)), rtol=1e-14)
    np.testing.assert_allclose(system.hamiltonian(y), np.arcsin(np.sin(q)) + 10 * np.arccos(np.cos(q)), rtol=1e-14)
    sol = solve(system, "verlet", (0, 0.1), y, dt=0.1)
    np.testing.assert_allclose(sol.y[:, 0, -1], q - 0.005 * system.gradient(y)[:, 0], rtol=1e-14)


# impulses ------------------------------------------------------------------------------------------

COMB = made(p**2 / 2 + q**2 / 2 - q * sum(sp.DiracDelta(t - k * sp.pi) for k in range(1, 21)), time="t", y0=[0, 0])
TIMES = np.unique(np.concatenate([np.linspace(0, 70, 351), PI * np.arange(21)]))


def comb(times):
    """Σ Θ(t − kπ) sin(t − kπ), and its derivative, continuous from the right."""
    since = times[:, None] - PI * np.arange(1, 21)
    on = since > -1e-12
    return np.stack([(on * np.sin(since)).sum(1), (on * np.cos(since)).sum(1)])


@pytest.mark.parametrize(
    "method",
    [
        *("kahan_li8", "linear_kahan_li8", "dop853"),
        *(pytest.param(m, marks=pytest.mark.slow) for m in ("gauss_legendre6", "tao8", "dopri5")),
    ],
)
def test_an_oscillator_under_impulses_is_a_sum_of_sines(method):
    """There and back, at given times and at the steps, by the dense output and in a batch."""
    adaptive = method in ("dop853", "dopri5")
    options = {"rtol": 1e-11, "atol": 1e-13} if adaptive else {"backend": "array"}
    near = {"rtol": 0, "atol": 1e-8 if adaptive else 1e-11}
    end = comb(TIMES[-1:])[:, 0]
    for span, y0 in (((0.0, 70.0), [0.0, 0.0]), ((70.0, 0.0), end)):
        sign = 1 if span[1] else -1
        sol = solve(COMB, method, span, y0, t_eval=TIMES[::sign], dense_output=True, **options)
        assert sol.success
        assert sol.stats["impulses"] == 20
        np.testing.assert_array_equal(sol.t, TIMES[::sign])
        np.testing.assert_allclose(sol.y, comb(TIMES)[:, ::sign], **near)
        np.testing.assert_allclose(pickle.loads(pickle.dumps(sol.sol))(TIMES), comb(TIMES), **near)
        np.testing.assert_allclose(sol.sol(70.0), end, **near)
        steps = solve(COMB, method, span, y0, **options)
        assert (np.diff(steps.t) * sign > 0).all()
        np.testing.assert_allclose(steps.y, comb(steps.t), **near)
    if method == "kahan_li8":
        many = solve(COMB, method, (0, 70), np.array([[0.0, 0.0], [1.0, 0.5]]), t_eval=TIMES, **options)
        free = np.stack([np.cos(TIMES) + 0.5 * np.sin(TIMES), 0.5 * np.cos(TIMES) - np.sin(TIMES)])
        np.testing.assert_allclose(many.y, comb(TIMES) + np.stack([0 * free, free]), **near)


def test_an_impulse_belongs_to_the_interval_that_ends_with_it():
    first = solve(COMB, "kahan_li8", (0, PI), backend="array")
    np.testing.assert_allclose(first.y[:, -1], [0, 1], atol=1e-12)
    again = solve(COMB, "kahan_li8", (PI, 2 * PI), first.y[:, -1], backend="array")
    np.testing.assert_allclose(again.y[:, -1], [0, 0], atol=1e-12)
    assert again.stats["impulses"] == 1
    back = solve(COMB, "kahan_li8", (PI, 0), first.y[:, -1], backend="array")
    np.testing.assert_allclose(back.y[:, -1], [0, 0], atol=1e-12)
    assert solve(COMB, "kahan_li8", (0, 3), backend="array").stats["impulses"] == 0


def test_the_kicked_rotor_is_the_standard_map():
    """δ(sin πt) has the weight 1/π; with other parameters for each trajectory, gradients, and in an ensemble."""
    rotor = made(
        "p**2/2 + pi*K*cos(q)*DiracDelta(sin(pi*t))", params={"K": 1.1}, time="t", period=1.0, y0=[1.0, 0.3], dt=0.5
    )

    def mapped(K, n=12):
        x, v = 1.0, 0.3
        for _ in range(n):
            x += v
            v += K * math.sin(x)
        return [x, v]

    pair = solve(rotor, "leapfrog", (0, 12), params={"K": np.array([1.1, 0.4])}, backend="array")
    np.testing.assert_allclose(pair.y[..., -1], [mapped(1.1), mapped(0.4)], rtol=1e-11)
    np.testing.assert_allclose(solve(rotor, "leapfrog", (0, 12)).y[:, -1], mapped(1.1), rtol=1e-11)  # compiled
    y0 = torch.tensor([1.0, 0.3], dtype=torch.float64, requires_grad=True)
    end = solve(pickle.loads(pickle.dumps(rotor)), "leapfrog", (0, 12), y0).y[:, -1]
    M = torch.stack([torch.autograd.grad(x, y0, retain_graph=True)[0] for x in end])
    assert float(torch.linalg.det(M)) == pytest.approx(1.0, abs=1e-8)
    kept = sympflow.ensemble(rotor, "leapfrog", y0=np.tile(rotor.y0, (3, 1)), t_span=(0, 12), reduce="final")
    np.testing.assert_allclose(kept.final[0], mapped(1.1), rtol=1e-11)


def test_impulses_of_a_damped_body_with_events():
    """p' = −γp + δ(t − 1) + 2δ(2t − 6): p jumps by 1 at 1 and at 3, and decays between."""
    body = made("p**2/2 - q*DiracDelta(t - 1) - 2*q*DiracDelta(2*t - 6)", time="t", damping=0.5, y0=[0, 0])
    times = np.array([0.5, 1.0, 2.0, 3.0, 4.0])
    sol = solve(body, "verlet", (0, 4), t_eval=times, backend="array", events=lambda s, y: y[0] - 1.0)
    decayed = [(s >= a) * math.exp(-0.5 * (s - a)) for a in (1, 3) for s in times]
    np.testing.assert_allclose(sol.y[1], np.reshape(decayed, (2, 5)).sum(0), rtol=1e-12)
    np.testing.assert_allclose(sol.t_events[0], [1 + 2 * math.log(2)], rtol=1e-10)
    body.between_impulses.check_impulses("", "")
    assert body.between_impulses.autonomous
    assert [kick.t for kick in body.kicks(0, 4)] == [1.0, 3.0]


REFUSED = {
    "a force": lambda: COMB.force(np.zeros(1), 0.0),
    "an energy": lambda: COMB.hamiltonian(np.zeros(2), 0.0),
    "multipliers": lambda: sympflow.floquet_multipliers(COMB, period=PI),
    "exponents": lambda: sympflow.lyapunov(COMB),
    "indicators": lambda: sympflow.ensemble(COMB, "verlet", (0, 4), np.zeros((2, 2)), reduce="sali"),
    "a balance": lambda: sympflow.energy_balance_error(solve(COMB, "verlet", (0, 4), backend="array")),
    "symplecticity": lambda: sympflow.symplecticity_defect(solve(COMB, "verlet", (0, 4), backend="array")),
    "a store": lambda: solve(COMB, "verlet", (0, 4), store="never.zarr"),
    "no end": lambda: solve(COMB, "verlet", (0, math.inf), events=ends),
    "copies": lambda: solve(COMB, "tao2", (0, 4), events=ends),
}


def ends(s, y):
    return y[0] - 1e9


ends.terminal = True


@pytest.mark.parametrize("what", REFUSED)
def test_what_takes_no_impulses_says_so(what):
    with pytest.raises(
        ValueError, match=r"^`system` 'H = .*' has impulses, DiracDelta in H, .*: .*(solve|store|use|end|give)"
    ):
        REFUSED[what]()


def test_studies_of_impulses_compare_solutions():
    short = made("p**2/2 + q**2/2 - q*DiracDelta(t - 1)", time="t", y0=[0, 0], t_span=(0, 3))
    rows = sympflow.compare(short, ["leapfrog", "kahan_li8"], dt=0.1, backend="array", repeats=1).rows
    errors = [row.error for row in rows]
    assert 1e-5 < errors[0] < 1e-2
    assert errors[1] < 1e-10


@pytest.mark.parametrize(
    ("H", "words"),
    [
        (p**2 / 2 + sp.DiracDelta(q - 1), r"`expression` holds DiracDelta\(q1 - 1\), and only impulses"),
        (p**2 / 2 + q * sp.DiracDelta(t - 1, 1), "a derivative of a delta function"),
        (p**2 / 2 + q * sp.DiracDelta(t - 1) ** 2, "not linear in a delta function"),
        (p**2 / 2 + q * sp.exp(sp.DiracDelta(t - 1)), "not linear in a delta function"),
        (p**2 / 2 + p * q * sp.DiracDelta(t - 1), "without p1"),
        (p**2 / 2 + sp.DiracDelta(q - t), "and only impulses"),
    ],
)
def test_other_delta_functions_are_refused(H, words):
    with pytest.raises(ValueError, match=words):
        made(H, **({"time": "t"} if H.has(t) else {}))
    with pytest.raises(ValueError, match=r"^`force` holds DiracDelta\(q1\)"):
        sympflow.doubled(made("p**2/2 + q**2/2"), ["DiracDelta(q)"])


@pytest.mark.parametrize(
    ("H", "words"),
    [
        ("p**2/2 - q*Heaviside(t - 1)*DiracDelta(t - 1)", "a factor that jumps at one: leave that out"),
        ("p**2/2 - q*DiracDelta((t - 1)**3)", r"a double zero: write it as DiracDelta\(t - a\)"),
    ],
)
def test_impulses_without_a_meaning_are_refused_where_a_run_meets_them(H, words):
    system = made(H, time="t", y0=[0, 0])
    with pytest.raises(ValueError, match=rf"^`t_span` .* has impulses DiracDelta.*{words}"):
        solve(system, "leapfrog", (0, 3), backend="array")
    assert solve(system, "leapfrog", (0, 0.5), backend="array").success


def test_outputs_between_impulses_move_with_their_times():
    system = made(p**2 / 2 + q**2 / 2 - q * sp.DiracDelta(t - 1) / 4, time="t", y0=[1.0, 0.0])
    start, end = (torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (0.0, 2.0))
    solve(system, "kahan_li8", (start, end), dt=0.01).y[0, -1].backward()  # q = cos(t1 − t0) + sin(t1 − 1)/4
    assert float(start.grad) == pytest.approx(math.sin(2), abs=1e-10)
    assert float(end.grad) == pytest.approx(math.cos(1) / 4 - math.sin(2), abs=1e-10)


# jumps in states -----------------------------------------------------------------------------------

NEAR_LJ = "Piecewise((4*(r**-12 - r**-6) + s, r < 2.5), (0, True))"
JUMPING = {
    "step": "p**2/2 + 5*Heaviside(q - 1)",
    "pieces": "p**2/2 + Piecewise((0, q < 1), (5, True))",
    "sign": "p**2/2 + sign(q)",
    "quotient": "p**2/2 + q/abs(q)",
    "acot": "p**2/2 + acot(q)",
    "atan": "p**2/2 + atan(1/q)",
    "angle": "p1**2/2 + p2**2/2 + atan2(q2, q1)",
    "far": "p**2/2 + sign(q**2 - 3e22)",
    "small": "p**2/2 + 1e-30*Heaviside(q - 1e-12)",
    "radius": "p1**2/2 + p2**2/2 + Heaviside(sqrt(q1**2 + q2**2) - 1e11)",
    "narrow": "p**2/2 + Piecewise((1, (q - 1)**2 < 1e-6), (0, True))",
    "barrier": "p**2/2 + Piecewise((1, abs(q - 5) < 0.001), (0, True))",
    "elsewhere": "p1**2/2 + p2**2/2 + Heaviside(q1 - 1)*Max(q2 - 3, 0)",
    "waves": "p**2/2 + Heaviside(cos(q))",
    "momentum": "p**2/2 + Heaviside(p - 1) + q**2",
    "not separable": "p**2*(1 + Heaviside(q))",
    "floor": p**2 / 2 + sp.floor(q),
    "ceiling": p**2 / 2 + sp.ceiling(q),
    "frac": p**2 / 2 + sp.frac(q),
    "Mod": p**2 / 2 + sp.Mod(q, 2),
}
CONTINUOUS = {
    "wall": "p**2/2 + Max(q - 3, 0)**2",
    "pieces": "p**2/2 + Piecewise((q**2/2, q < 1), (q - 1/2, True))",
    "seven figures": "p**2/2 + Piecewise((0.1*q**2, q < 3), (0.9000001, True))",
    "three": "p**2/2 + Piecewise((0, q < 1), (7.3*(q - 1)**3, q < 2), (7.3*(3*q - 5), True))",
    "kink": "p**2/2 + Abs(q - 0.1)",
    "far kink": "p**2/2 + Abs(q**2 - 3e22)/1e22",
    "one side": "p**2/2 + q**2*Heaviside(q)",
    "odd": "p**2/2 + sign(q)*q**3",
    "waves": "p**2/2 + sin(q)*sign(sin(q))",
    "angle": "p1**2/2 + p2**2/2 + cos(3*atan2(q2, q1))*(q1**2 + q2**2)**2",
    "ring": "p1**2/2 + p2**2/2 + Max(sqrt(q1**2 + q2**2) - 2, 0)**2",
    "well": "p**2/2 + Piecewise((1e9*((q - 1)**2 - 1e-6)**2, (q - 1)**2 < 1e-6), (0, True))",
    "pole": "p**2/2 + 1/abs(q)",
    "gate": "p**2/2 + exp(-1/q**2)",
}


@pytest.mark.parametrize("name", JUMPING)
def test_a_potential_that_jumps_is_refused(name):
    with pytest.raises(ValueError, match=r"^`expression` jumps where .* = 0, at [qp]\d? = .* reflect p\.$"):
        made(JUMPING[name])


def of_functions(H):
    """½p² + V(q) as functions of arrays."""
    H = sp.sympify(H)
    names = [f"q{i + 1}" for i in range(2)] if H.has(sp.Symbol("q1")) else ["q"]
    V = sp.lambdify(names, H.subs(dict.fromkeys(sp.symbols("p p1 p2"), 0)), "numpy")
    return HamiltonianSystem(
        lambda q: V(*(q[..., i] for i in range(len(names)))), ndof=len(names), y0=[0.3, 0.1] * len(names)
    )


@pytest.mark.parametrize("name", ["step", "pieces", "sign", "angle", "far", "small", "barrier", "waves"])
def test_functions_that_jump_are_refused(name):
    with pytest.raises(ValueError, match=r"^`potential` jumps where .* = 0, at q\d? = .* reflect p\.$"):
        solve(of_functions(JUMPING[name]), "verlet", (0, 0.1), dt=0.01)
    with pytest.raises(ValueError, match=r"^`potential` jumps where q1 - 1 = 0"):
        solve(HamiltonianSystem(lambda q: 5.0 * (q[..., 0] > 1), ndof=1, y0=[0, 1]), "verlet", (0, 0.1), dt=0.01)


@pytest.mark.parametrize(
    "name", ["wall", "pieces", "seven figures", "three", "kink", "one side", "odd", "ring", "well"]
)
def test_functions_with_kinks_stay(name):
    assert solve(of_functions(CONTINUOUS[name]), "verlet", (0, 0.1), dt=0.01).success


@pytest.mark.parametrize("name", CONTINUOUS)
def test_a_potential_with_kinks_stays(name):
    system = made(CONTINUOUS[name])
    H, states = sp.sympify(CONTINUOUS[name]), np.random.default_rng(0).normal(size=(5, 2 * system.ndof))
    for y in states.tolist():
        names = [f"{letter}{i + 1}" for letter in "qp" for i in range(system.ndof)] if system.ndof > 1 else ["q", "p"]
        assert system.hamiltonian(np.array(y)) == pytest.approx(float(H.subs(dict(zip(names, y, strict=True)))))


def test_jumps_of_lattices_pairs_and_parameters():
    site, wells = np.linspace(1, 2, 8), "Piecewise((a*rho, rho < 1), (rho, True))"
    waves = HamiltonianSystem.schroedinger(wells, shape=8, params={"a": 1.0})
    refused = (
        ("`bond` jumps where r - 1 = 0", lambda: HamiltonianSystem.lattice(shape=8, bond="r**2/2 + Heaviside(r - 1)")),
        (
            "`onsite` jumps where a - u = 0",
            lambda: HamiltonianSystem.lattice(
                shape=8, onsite="Piecewise((1, u < a), (0, True))", fields="u", params={"a": site}
            ),
        ),
        (
            "`potential` jumps where r - 2.5 = 0",
            lambda: HamiltonianSystem.pairs(NEAR_LJ, masses=np.ones(3), params={"s": 0.01}),
        ),
        ("`expression` jumps", lambda: made("p**2/2 + V*Heaviside(q)", params={"V": 0.0}).with_params(V=1.0)),
        ("`onsite` jumps", lambda: waves.with_params(a=2.0)),
    )
    for words, make in refused:
        with pytest.raises(ValueError, match=f"^{words}"):
            make()
    HamiltonianSystem.lattice(shape=8, bond="r**2/2 + Max(r - 1, 0)**2")
    HamiltonianSystem.pairs(NEAR_LJ, masses=np.ones(3), params={"s": 0.016316891136})
    friction = sympflow.doubled(made("p**2/2 + q**2/2"), ["-0.1*sign(p)"])
    assert friction.ndof == 2


# jumps in t ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("drive", "times"),
    [
        ((t - 1.03) / sp.Abs(t - 1.03), [1.03]),
        (sp.acot(t - 1.03), [1.03]),
        (sp.atan(1 / (t - 1.03)), [1.03]),
        (sp.atan2(sp.sin(t), sp.cos(t)), [PI]),
        (sp.sign(sp.cos(t)), [PI / 2, 3 * PI / 2]),
        (sp.floor(t / sp.Float(1.7)), [1.7, 3.4]),
        (sp.frac(t / 2), [2, 4]),
        (sp.Mod(t, 2), [2, 4]),
        (sp.Piecewise((1, sp.Mod(t, 2) < 0.5), (0, True)), [0.5, 2, 2.5, 4, 4.5]),
        (sp.Piecewise((1, (t > 1) & (t < 2)), (0, True)), [1, 2]),
        (sp.Heaviside(t**2 - 4), [2]),
        (sp.Heaviside(2 * t - 2) - sp.Heaviside(1 - t), [1]),
        (sp.Heaviside(t - 1) + sp.Heaviside(1 - t), []),
        ((t - 1.2) * sp.Heaviside(t - 1.2), []),
        (sp.Abs(sp.sin(t)), []),
        (sp.sin(t) * sp.sign(sp.sin(t)), []),
        (sp.Piecewise((t**2, t < 1.3), (1.69 + 2.6 * (t - 1.3), True)), []),
        (sp.exp(-sp.Abs(t - 2)), []),
        (sp.Heaviside(t**3 - 8), [2]),
        (sp.sign((t - 1) ** 2 * (t - 3)), [3]),
        (sp.cos(t), []),
        (sp.atan(sp.tan(t)), [PI / 2, 3 * PI / 2]),
    ],
)
def test_jumps_are_read_from_the_expression(drive, times):
    system = driven(drive)
    np.testing.assert_allclose(system.jump_times(0, 5, 0.01), times, rtol=1e-14)
    assert system.symbols.jumps == bool(times)


def test_jumps_at_states_and_times_of_any_size():
    wall = made(p**2 / 2 + sp.Heaviside(t - 1.03) * sp.Max(q - 3, 0) ** 2, time="t")
    for _ in range(2):
        assert wall.jump_times(0, 5, 0.01).tolist() == [1.03]
    distant = made(p**2 / 2 + sp.Heaviside(t - 1.03) * sp.Max(q - 1e9, 0) ** 2, time="t")
    assert distant.jump_times(0, 5, 0.01).tolist() == [1.03]
    assert driven(sp.Heaviside(t - 1e6)).symbols.jumps
    np.testing.assert_allclose(driven(sp.Heaviside(t**3 - 1e12)).jump_times(0, 1e6, 1e-3), [1e4], rtol=1e-14)
    laser = driven(1e-20 * sp.sign(sp.cos(t * 1e15)))
    np.testing.assert_allclose(laser.jump_times(0, 5e-15, 1e-17), [PI / 2 * 1e-15, 3 * PI / 2 * 1e-15])
    sol = solve(wall, "kahan_li8", (0, 2), [5.0, 0.0], dt=0.1, backend="array")
    assert sol.y[0, -1] == pytest.approx(3 + 2 * math.cos(math.sqrt(2) * (2 - 1.03)), rel=1e-13)


def switched(t_jump: float, states: np.ndarray, times: np.ndarray) -> np.ndarray:
    """The errors of q along an orbit of an oscillator to whose force 1 is added at t_jump."""
    since = np.maximum(times - t_jump, 0)
    return np.abs(states - (0.5 * np.cos(times) + 0.1 * np.sin(times) + 1 - np.cos(since)))


@pytest.mark.parametrize("t_jump", [1, sp.Rational(103, 100)])
@pytest.mark.parametrize(
    ("method", "order"),
    [
        ("leapfrog", 2),
        ("chin4c", 4),
        ("gauss_legendre4", 4),
        ("linear_aba864", None),
        ("verlet", 2),
        ("rk4", 4),
        ("impulse", 2),
        ("mollified_impulse", 2),
        ("linear_srkn11b", None),
        ("strang_parts", 2),
        ("kahan_li8_parts", None),
        ("tao2", 2),
        ("tao8", None),
    ],
)
def test_a_method_keeps_its_order_at_jumps(method, order, t_jump):
    """Runs land on them, whether their steps do or not."""
    system = made(p**2 / 2 + q**2 / 2 - q * sp.Piecewise((0, t < t_jump), (1, True)), time="t", y0=[0.5, 0.1])
    errors = []
    for n in (8, 16):
        sol = solve(system, method, (0, 3), dt=1 / n, backend="array")
        errors.append(switched(float(t_jump), sol.y[0], sol.t).max())
    if order is None:
        assert errors[1] < 1e-13
    else:
        assert math.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.15)


LATE = made(
    p**2 / 2 + q**2 / 2 - q * sp.Heaviside(t - sp.Symbol("c", real=True)),
    time="t",
    params={"c": 1.03},
    y0=[0.5, 0.1],
    t_span=(0, 3),
    dt=0.1,
)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"save_every": 7},
        {"t_eval": [0, 0.5, 1.03, 1.031, 3]},
        {"dense_output": True},
        {"y0": np.array([[0.5, 0.1]] * 3)},
        {"events": lambda t, y: y[0] - 0.9},
        {"params": {"c": [1.03, 0.77, 2.0]}, "t_eval": [0, 1.5, 3]},
        {"y0": torch.tensor([0.5, 0.1], dtype=torch.float64)},
    ],
    ids="+".join,
)
def test_what_a_run_gives_where_it_lands_on_jumps(options):
    sol = solve(LATE, "kahan_li8", **options)
    jumps = np.reshape(options.get("params", {"c": 1.03})["c"], (-1, 1))
    assert switched(jumps, np.asarray(sol.y)[..., 0, :], sol.t).max() < 1e-13
    if "dense_output" in options:
        times = np.append(np.linspace(0, 3, 50), 1.03)
        assert switched(1.03, sol.sol(times)[0], times).max() < 1e-13
    if "events" in options:
        [[at]] = sol.t_events
        assert switched(1.03, 0.9, at) < 1e-13
    back = solve(LATE, "kahan_li8", (3, 0), np.asarray(sol.y)[..., -1])
    if "params" not in options:
        np.testing.assert_allclose(back.y[..., -1] - [0.5, 0.1], 0, atol=1e-13)


PULSE = made(
    p**2 / 2 + q**2 / 200 - 100 * q * sp.Piecewise((1, (t > 50) & (t < sp.Rational(5001, 100))), (0, True)),
    time="t",
    y0=[0, 0],
    t_span=(0, 100),
    dt=0.1,
)


@pytest.mark.parametrize("method", ["dop853", "rk45", "dopri5", "bosh3", "kahan_li8", "explicit_adams"])
def test_no_step_leaps_over_a_pulse(method):
    exact = 1e4 * (math.cos(0.1 * 49.99) - math.cos(0.1 * 50))
    sol = solve(PULSE, method, t_eval=[100.0])
    assert sol.y[0, -1] == pytest.approx(exact, rel=1e-3)
    assert sol.stats["jumps"] == 2
    if method != "explicit_adams":
        chunks = [*sol.integrator.steps(PULSE, (0.0, 100.0), sol.y0)]
        y, h = np.concatenate([chunk[1] for chunk in chunks]), np.concatenate([chunk[2] for chunk in chunks])
        assert h.sum() == pytest.approx(100)
        swing = math.hypot(0.1 * y[-1, 0], y[-1, 1])
        assert swing == pytest.approx(2000 * math.sin(0.0005), rel=1e-3)  # of the pulse, before the last step


def test_metrics_of_a_run_that_lands_on_jumps_are_those_of_its_steps():
    ensemble = sympflow.ensemble(LATE, "kahan_li8", y0=np.array([[0.5, 0.1]] * 3), t_eval=[3.0])
    assert switched(1.03, ensemble.y[:, 0, 0], 3.0).max() < 1e-13
    sol = solve(LATE, "rk4")
    chunks = [*sol.integrator.steps(LATE, (0.0, 3.0), sol.y0)]
    times, lengths = (np.concatenate([chunk[i] for chunk in chunks]) for i in (0, 2))
    np.testing.assert_allclose(times, sol.t[:-1], atol=1e-12)
    np.testing.assert_allclose(np.concatenate([chunk[1] for chunk in chunks]), sol.y[:, :-1].T, atol=1e-15)
    assert lengths.sum() == pytest.approx(3, abs=1e-12)
    assert sympflow.lyapunov(LATE, "kahan_li8", (0, 30)).value == pytest.approx(0, abs=0.05)
    left = sympflow.escape_times(LATE, "kahan_li8", outside=0.9)
    assert switched(1.03, 0.9, left.time) < 1e-13
    for span in ((0, 3), (0, 1.03)):
        scipy = solve_ivp(LATE, span, [0.5, 0.1], method=as_scipy("kahan_li8", LATE), dense_output=True)
        assert scipy.t[-1] == span[1]
        assert switched(1.03, scipy.y[0], scipy.t).max() < 1e-13
        times = np.linspace(*span, 77)
        assert switched(1.03, scipy.sol(times)[0], times).max() < 1e-13


@pytest.mark.parametrize("method", ["tao4", "kahan_li8", "gauss_legendre6", "strang_parts", "dop853"])
@pytest.mark.parametrize(("limit", "n"), [(None, 2), (1, 1), (2, 2)])
def test_events_of_all_pieces_between_jumps_are_kept(method, limit, n):
    """A free body that is pushed up at 1.003, down at 2.007 and never again, of which every method's step is exact."""
    force = sp.Heaviside(t - 1.003) - 3 * sp.Heaviside(t - 2.007) + 2 * sp.Heaviside(t - 3.013)
    rise, fall = 1.003, 2.007

    def height(s, y):
        return y[0] - 0.3

    def level(s, y):
        return y[1]

    height.terminal = limit or False
    options = {"rtol": 1e-10, "atol": 1e-12} if method == "dop853" else {"dt": 0.01}
    sol = solve(driven(force, y0=[0.0, 0.0]), method, (0.5, 6), events=[height, level], **options)
    v = fall - rise
    up = rise + math.sqrt(0.6)
    top = fall + v / 2
    q, p_end = v**2 / 2 + v * (3.013 - fall) - (3.013 - fall) ** 2, v - 2 * (3.013 - fall)
    expected = [up, 3.013 + (0.3 - q) / p_end]
    np.testing.assert_allclose(sol.t_events[0], expected[:n], rtol=0, atol=1e-12)
    if limit != 1:
        np.testing.assert_allclose(sol.t_events[1][-1], top, rtol=0, atol=1e-12)


def test_runs_that_do_not_land_on_jumps_warn(tmp_path):
    fast = made(p**2 / 2 + q**2 / 2 - q * sp.sign(sp.sin(50000 * t)), time="t", y0=[0.5, 0.1])
    for run in (
        lambda: solve(LATE, "kahan_li8", store=tmp_path / "run.zarr"),
        lambda: solve(fast, "leapfrog", (0, 10), dt=0.1),
        lambda: solve(LATE, "mclachlan4"),  # whose forces lie beyond the ends of its steps
        lambda: odeint(LATE, torch.tensor([0.5, 0.1]).double(), torch.tensor([0.0, 3.0]), method="kahan_li8"),
        lambda: odeint(LATE, torch.tensor([0.5, 0.1]), torch.tensor([0.0, 3.0]), method="implicit_adams"),
        lambda: solve(fast, "dop853", (0, 10), max_steps=10),
    ):
        with pytest.warns(RuntimeWarning, match="jumps (within a step|in t), at t ="):
            run()


@pytest.mark.parametrize(("method", "back"), [("dopri5", False), ("dopri8", True), ("bosh3", False), ("rk4", True)])
def test_methods_of_torchdiffeq_end_their_steps_at_jumps(method, back):
    """A pulse of a ten-thousandth of the interval, in which no step would begin."""
    a, b, height = 10.003, 10.005, 500.0
    pulse = height * (sp.Heaviside(t - a) - sp.Heaviside(t - b))
    system = driven(pulse, y0=[0.0, 0.0])
    ends = torch.tensor([20.0, 0.0] if back else [0.0, 20.0], dtype=torch.float64)
    options = {"step_size": 0.02} if method == "rk4" else None
    found = odeint(system, torch.zeros(2, dtype=torch.float64), ends, method=method, options=options)[-1, 0].item()
    T = ends[1].item()
    exact = height * ((T - a) ** 2 - (T - b) ** 2) / 2 * (-1 if back else 1)
    assert found == pytest.approx(exact, rel=1e-11)  # of 1000 steps
    before = torch.tensor([20.0, b + 1e-3] if back else [0.0, a - 1e-3], dtype=torch.float64)
    still = odeint(system, torch.zeros(2, dtype=torch.float64), before, method=method, options=options)
    assert not still.any()


@pytest.mark.parametrize(
    ("drive", "span"),
    [
        (sp.Heaviside(t), (0, 2)),  # ½ at t = 0
        (sp.Piecewise((0, t < 0), (1, True)), (0, 2)),
        (sp.Piecewise((0, t < 2), (1, True)), (0, 2)),
        (sp.Piecewise((0, t < 2), (1, True)), (2, 0)),
        (sp.Piecewise((0, t <= 2), (1, True)), (2, 0)),
    ],
)
def test_the_value_of_a_jump_at_an_end_of_the_run(drive, span):
    inside = float(drive.subs(t, 1))
    steady = made(p**2 / 2 - q * inside, y0=[0.5, 0.1])
    exact = solve(steady, "verlet", span, dt=0.25, backend="array")
    sol = solve(driven(drive, y0=[0.5, 0.1]), "verlet", span, dt=0.25, backend="array")
    np.testing.assert_allclose(sol.y, exact.y, atol=1e-13)


# periods -------------------------------------------------------------------------------------------

SPLINE = CubicSpline(np.linspace(0, 2, 21), np.cos(np.linspace(0, 2 * PI, 21)), bc_type="periodic")


@pytest.mark.parametrize(
    ("V", "period", "other"),
    [
        (q * sp.cos(t), 2 * PI, PI),
        (q * sp.cos(t), 4 * PI, 6.28),
        (q * sp.cos(t) ** 2, PI, 2.0),
        (q * (sp.cos(2 * t) + sp.sin(3 * t)), 2 * PI, PI),
        (sp.cos(q - t), 2 * PI, PI),
        (q * sp.sign(sp.sin(t)), 2 * PI, PI),
        (q * sp.Heaviside(sp.sin(2 * sp.pi * t)), 1.0, 0.5),  # an edge at t = 0
        (q * sp.Piecewise((1, sp.Mod(t, 2) < 1), (0, True)), 2.0, 1.0),
        (q * (t - sp.floor(t)), 1.0, 0.5),
        (q * t - q * sp.floor(t), 1.0, 0.5),
        (q * sp.DiracDelta(sp.sin(t)), PI, PI / 2),
        (sp.Max(q - 1e9, 0) * sp.cos(t) ** 2, PI, 2.0),  # far states
        (q**2 + 1e-12 * q * sp.cos(t), 2 * PI, 2.0),  # a small drive
        (q * sp.exp(sp.cos(1e15 * t)), 2e-15 * PI, 1e-15),
        (q * sp.Symbol("a"), 2.0, 1.0),
        (q * sp.exp(-((t - 1000) ** 2)), None, 1.0),  # a late pulse
        (q * sp.Heaviside(t - 100), None, 1.0),
        (q * t, None, 1.0),
    ],
)
def test_the_period_is_that_of_the_expression(V, period, other):
    params = {"a": SPLINE} if V.has(sp.Symbol("a")) else None
    if period is not None:
        assert made(p**2 / 2 + V, time="t", period=period, params=params).period == period
    with pytest.raises(ValueError, match=r"^`period` .* is not a period of H"):
        made(p**2 / 2 + V, time="t", period=other, params=params)


@pytest.mark.parametrize(
    ("V", "period", "is_one"),
    [
        (lambda s, x: x * np.cos(s), 2 * PI, True),
        (lambda s, x: x * np.sign(np.sin(s)), 2 * PI, True),
        (lambda s, x: x * (s % 1.0 < 0.5), 1.0, True),
        (lambda s, x: x**4 + x * np.cos(1e15 * s), 2e-15 * PI, True),
        (lambda s, x: x**2 / 2 + 1e-9 * x * np.cos(s), 3.0, False),
        (lambda s, x: np.maximum(x - 50, 0) * np.cos(s), 3.0, False),
        (lambda s, x: x * np.exp(-((s - 40) ** 2) / 100), 1.0, False),
    ],
)
def test_the_period_of_functions_is_tried_at_states_and_times_of_all_sizes(V, period, is_one):
    def H(y, s):
        return y[..., 1] ** 2 / 2 + V(s, y[..., 0])

    if is_one:
        check_period(H, 1, None, period)
        return
    with pytest.raises(ValueError, match=r"^`period` .* is not a period of H"):
        check_period(H, 1, None, period)
