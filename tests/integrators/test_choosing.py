"""solve() chooses a method where none is given, and a step for a tolerance."""

import math
import warnings

import numpy as np
import pytest

import sympflow
from sympflow import HamiltonianSystem, choose_step, solve, systems

text = HamiltonianSystem.from_sympy
KEPLER = "p1**2/2 + p2**2/2 - 1.1/sqrt(q1**2 + q2**2)"

PAIRS = sympflow.HamiltonianSystem.pairs
CHOSEN = {
    "a flow that ships": (systems.henon_heiles, None, {}, "sympflow"),
    "outside of its domain": (systems.henon_heiles, [0, 0.9, 0.4, 0], {}, "srkn11b"),
    "a step is given": (systems.henon_heiles, None, {"dt": 0.1}, "srkn11b"),
    "no flow has this tolerance": (systems.henon_heiles, None, {"tol": 1e-13}, "srkn11b"),
    "½ pᵀM⁻¹p": (lambda: text("p**2/2 + q**4/4"), [1, 0], {}, "srkn11b"),
    "separable": (lambda: text("sqrt(1 + p**2) + q**4/4"), [1, 0], {}, "kahan_li8"),
    "not separable": (lambda: text("(1 + p**2)*(1 + q**2)/2"), [1, 0], {}, "gauss_legendre6"),
    "attraction at 0": (lambda: text(KEPLER), [1, 0, 0, 0.8], {}, "log_kahan_li8"),
    "elsewhere": (lambda: text(KEPLER.replace("q1*", "(q1 - 1)*")), [2, 0, 0, 0.3], {}, "log_kahan_li8"),
    "two": (lambda: text(f"{KEPLER} - 1/sqrt((q1 - 1)**2 + q2**2)"), [2, 0, 0, 0.3], {}, "log_kahan_li8"),
    "few bodies": (lambda: PAIRS("-1/r", masses=[1, 1], dim=2), [1, 0, -1, 0, 0, 0.05, 0, -0.05], {}, "log_kahan_li8"),
    "that repel": (lambda: PAIRS("1/r", masses=[1, 1], dim=2), [1, 0, -1, 0, 0, 0.05, 0, -0.05], {}, "srkn11b"),
    "a logarithm": (lambda: text("p1**2/2 + p2**2/2 + log(q1**2 + q2**2)"), [1, 0, 0, 0.01], {}, "dop853"),
    "softened": (lambda: text("p1**2/2 + p2**2/2 + log(q1**2 + q2**2 + 1)"), [1, 0, 0, 0.01], {}, "srkn11b"),
    "repulsion at 0": (lambda: text("p**2/2 + 1/q**2 + q**2"), [1, 0], {}, "srkn11b"),
    "events": (lambda: text(KEPLER), [1, 0, 0, 0.8], {"events": lambda t, y: y[0]}, "srkn11b"),
    "tolerances": (lambda: text("p**2/2 + q**4/4"), [1, 0], {"rtol": 1e-8}, "dop853"),
    "friction": (lambda: text("p**2/2 + q**2/2", damping=0.1), [1, 0], {}, "srkn11b"),
    "parameters": (lambda: text("p**2/2 + k*q**2/2", params={"k": 1.0}), [1, 0], {"params": {"k": [1, 2]}}, "srkn11b"),
}


@pytest.mark.parametrize(("make", "y0", "options", "name"), CHOSEN.values(), ids=CHOSEN)
def test_the_method_suits_the_system(make, y0, options, name):
    sol = solve(make(), t_span=(0, 5), y0=y0, **options)
    assert sol.success
    assert sol.integrator.name == name
    assert sol.stats["chosen"].startswith(f"{name}: ")
    assert f"Method {name!r} was chosen" in sol.message


WELL = "p**2/2 - q**2/2 + q**4/4"
AT_ZERO = {
    "parabola": (KEPLER, [1, 0, 0, 2.2**0.5], 20),
    "typed": (KEPLER, [1, 0, 0, 1.4832], 20),
    "slow": (KEPLER.replace("1.1", "1e-8"), [1, 0, 0, 2e-8**0.5], 2e5),
    "separatrix": (WELL, [2**0.5, 0], 20),
    "beside a saddle": (WELL, [1e-3, 0], 20),
    "towards it": (WELL, [-1e-3, 1e-3], 20),
}


@pytest.mark.parametrize(("expression", "y0", "length"), AT_ZERO.values(), ids=AT_ZERO)
def test_energies_about_zero_are_compared_with_their_terms(expression, y0, length):
    """The step is as that of a like orbit of another energy: no error in units of an energy that is about 0."""
    sol = solve(expression, "srkn11b", (0, length), y0, tol=1e-9)
    assert sympflow.max_energy_error(sol) <= 1e-9
    assert 0.01 < sol.stats["dt"] * 20 / length < 0.2


METHODS = "verlet", "srkn11b", "kahan_li8", "omelyan4", "gauss_legendre6", "implicit_midpoint"


@pytest.mark.parametrize("tol", [1e-4, 1e-8])
@pytest.mark.parametrize("method", METHODS)
def test_the_step_meets_the_tolerance(method, tol):
    """It is met over the whole interval, and not by far: a step 4 times longer does not, or is the whole interval."""
    system, span = systems.henon_heiles(), (0, 40)
    sol = solve(system, method, span, tol=tol)
    assert sympflow.max_energy_error(sol) <= tol
    assert sol.stats["energy_error"] == sympflow.max_energy_error(sol)
    longer = solve(system, method, span, dt=4 * sol.stats["dt"], diagnose=False)
    assert not sympflow.max_energy_error(longer) <= tol


def test_with_a_drive_the_balance_of_energy_and_work_counts():
    system = text("p**2/2 + q**2/2 - q*cos(2*t)/9", time="t", y0=[1, 0])
    dt = choose_step(system, "kahan_li6", 1e-7, t_span=(0, 20))
    sol = solve(system, "kahan_li6", (0, 20), dt=dt)
    assert 1e-9 < sympflow.energy_balance_error(sol, relative=True).max() <= 1e-7


def test_with_friction_energy_is_compared_with_finer_runs():
    system = text("p**2/2 + q**4/4", damping=0.1, y0=[1, 0])
    dt = choose_step(system, "kahan_li6", 1e-7, t_span=(0, 20))
    coarse, fine = (solve(system, "kahan_li6", (0, 20), dt=h, t_eval=np.linspace(0, 20, 9)) for h in (dt, dt / 8))
    scale = abs(float(system.hamiltonian(system.y0, 0.0)))
    assert 1e-10 < np.abs(coarse.energy() - fine.energy()).max() / scale <= 1e-7


@pytest.mark.parametrize(
    ("H", "y0", "method"),
    [
        ("p**2/2 + q**2/2", [1.0, 0.0], "gauss_legendre6"),
        ("(p1 + q2/2)**2/2 + (p2 - q1/2)**2/2", [1.0, 0.0, 0.0, 1.0], "gauss_legendre4"),
    ],
    ids=["oscillator", "charge"],
)
def test_where_every_step_keeps_the_energy_the_error_is_that_of_the_states(H, y0, method):
    """Both motions have the period 2π."""
    span = (0.0, 20 * np.pi)
    sol = solve(text(H), method, span, y0, tol=1e-7, t_eval=[span[1]])
    assert 1e-11 < np.abs(sol.y[:, -1] - y0).max() <= 2e-7


DEFAULT_STEPS = {
    "ω = 1": ("p**2/2 + q**2/2", [1, 0], 0.05),
    "ω = 10": ("p**2/2 + 50*q**2", [1, 0], 0.005),
    "the largest of two": ("(p1**2 + p2**2 + q1**2 + 25*q2**2)/2", [1, 0, 0, 0], 0.01),
    "a free particle": ("p**2/2", [1, 0], 0.05),
    "unstable": ("p**2/2 - 50*q**2", [1, 0], 0.005),
}


@pytest.mark.parametrize(("H", "y0", "dt"), DEFAULT_STEPS.values(), ids=DEFAULT_STEPS)
def test_the_default_step_is_a_twentieth_of_a_radian(H, y0, dt):
    assert text(H, y0=y0).dt == dt
    assert text(H, y0=y0, dt=0.3).dt == 0.3
    assert solve(text(H), "verlet", (0, 1), y0).stats["dt"] == dt


def test_a_missed_tolerance_is_told(monkeypatch):
    """An orbit from its apocentre, whose trial runs are cut before the pericentre."""
    monkeypatch.setattr("sympflow.integrators.choosing.TRIAL_STEPS", 8)
    monkeypatch.setattr("sympflow.integrators.choosing.TRIAL_LENGTH", 1)
    with pytest.warns(RuntimeWarning, match="more than `tol` 1e-06: pass a smaller one"):
        sol = solve(text(KEPLER, y0=[1, 0, 0, 0.4]), "verlet", (0, 20), tol=1e-6)
    assert "more than `tol`" in sol.message


LONG_RUNS = {
    "states": (systems.henon_heiles(), "verlet", 5000, {"tol": 1e-4, "tol_of": "state"}),
    "a quartic": (systems.quartic(), "rk4", 3000, {"tol": 1e-5, "tol_of": "state"}),
    "a drive": (systems.driven_pendulum(), "rk4", 1000, {"tol": 1e-5}),
    "friction": (text("p**2/2 + q**4/4", damping=1e-3, y0=[1, 0]), "rk4", 1000, {"tol": 1e-5}),
}


@pytest.mark.parametrize(("system", "method", "end", "asked"), LONG_RUNS.values(), ids=LONG_RUNS)
def test_errors_that_grow_beyond_the_trial_runs_are_told(system, method, end, asked):
    """The error told is that against an adaptive run of another family, up to the part that half the step has too.

    That of energy is added up over the run: friction −γp forgets errors by e^{−2γt}, which it leaves out.
    """
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        sol = solve(system, method, (0, end), **asked)
    exact = solve(system, "dop853", (0, end), t_eval=sol.t[::-1][:: len(sol.t) // 100][::-1], rtol=1e-10, atol=1e-12)
    kept = np.searchsorted(sol.t, exact.t)
    if "tol_of" in asked:
        error = np.abs(sol.y[:, kept] - exact.y).max() / np.abs(system.y0).max()
    elif system.damping is None:
        error = sympflow.energy_balance_error(sol, relative=True).max()
    else:
        error = np.abs(sol.energy()[kept] - exact.energy()).max() / sol.energy_scale()
        rate = 2 * system.damping
        error *= rate * end / (1 - math.exp(-rate * end))
    found = sol.stats[f"{asked.get('tol_of', 'energy')}_error"]
    assert 0.4 < found / error < 1.5
    assert [f"more than `tol` {asked['tol']:g}" in str(each.message) for each in told] == [True] * (
        found > asked["tol"]
    )


@pytest.mark.parametrize("asked", [{"tol": 1e-4}, {"tol": 1e-7}, {"tol": 1e-4, "tol_of": "state"}])
def test_trial_runs_end_steps_where_H_jumps(asked):
    """The cell is of quadrupoles and drifts: its steps are as long as these, and no shorter by the jumps."""
    sol = solve(systems.fodo_cell(), t_span=(0, 10), **asked)
    assert sol.stats["dt"] >= 0.125
    error = sympflow.reference_error(sol).max()
    assert 1e-13 < error <= asked["tol"]
    assert 0.5 < sol.stats["state_error"] / error < 2


@pytest.mark.parametrize(("sign", "slow"), [(1, True), (-1, False)])
def test_a_step_is_doubted_for_motions_that_there_are(sign, slow):
    """Two oscillators with a stiff spring, driven together: the spring moves in one case and rests in the other."""
    H = "(p1**2 + p2**2)/2 + (q1**2 + q2**2)/2 + 50*(q1 - q2)**2 - cos(t/2)*(q1 + q2)/5"
    system = HamiltonianSystem.from_sympy(H, time="t")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        sol = solve(system, "verlet", (0, 30), [1.0, sign, 0.0, 0.0], dt=0.05)
    t, common = sol.t, 4 / 15 * (np.cos(sol.t / 2) - np.cos(sol.t))  # of both from rest
    apart = np.cos(t) if slow else np.cos(np.sqrt(201) * t)
    error = np.abs(sol.y[0] - common - apart).max()
    assert ["rate of the motion is 14.2" in str(warning.message) for warning in told] == [True] * (not slow)
    assert error < 0.01 if slow else error > 1


@pytest.mark.parametrize(("method", "tol"), [("verlet", 1e-4), ("srkn11b", 1e-6), ("kahan_li8", 1e-9)])
def test_the_balance_is_that_of_chaotic_orbits_too(method, tol):
    """Two runs of Duffing's oscillator differ by 1 % of the energy after T = 100 with steps that keep it to `tol`."""
    sol = solve(systems.duffing(), method, (0, 100), tol=tol)
    assert sol.stats["energy_error"] <= tol
    coarser = solve(systems.duffing(), method, (0, 100), dt=4 * sol.stats["dt"], diagnose=False)
    assert np.abs(coarser.energy()[-1] - sol.energy()[-1]) > 10 * tol


def test_the_error_of_states_can_be_asked_for():
    system = systems.henon_heiles()
    dt = choose_step(system, "srkn11b", 1e-8, t_span=(0, 40), tol_of="state")
    sol = solve(system, "srkn11b", (0, 40), dt=dt)
    assert sympflow.reference_error(sol).max() <= 1e-8
    assert dt < choose_step(system, "srkn11b", 1e-8, t_span=(0, 40))


@pytest.mark.parametrize("unit", [1e-20, 1e12])
def test_steps_scale_with_the_unit_of_time(unit):
    """H = ½ p² + ½ (q/T)²: with times in units of T the steps are the same."""
    steps = []
    for T in (1.0, unit):
        system = text("p**2/2 + q**2/(2*T**2)", params={"T": T}, y0=[1, 0.5 / T], t_span=(0, 100 * T))
        steps.append([system.dt / T, choose_step(system, "kahan_li8", 1e-9) / T])
    np.testing.assert_allclose(steps[1], steps[0], rtol=1e-2)
