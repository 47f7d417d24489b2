"""The driven scenes: the truths that their docstrings tell."""

import math
import warnings

import numpy as np
import pytest
import sympy as sp
from conftest import refusals
from scipy.special import mathieu_a, mathieu_b, mathieu_cem

from sympflow import HamiltonianSystem, energy_balance_error, floquet_multipliers, solve, systems
from sympflow.hamiltonian.domain import domain_from_dict

SCENES = {name: systems.get(name)() for name in ("driven-pendulum", "paul-trap", "duffing", "fodo-cell", "kicked")}


@pytest.mark.parametrize("name", SCENES)
def test_the_scene_starts_inside_its_domain_and_its_step_divides_its_period(name):
    system = SCENES[name]
    assert not system.autonomous
    assert system.domain.contains(system.y0)
    assert domain_from_dict(system.domain.to_dict()) == system.domain
    steps = system.period / system.dt
    assert abs(steps - round(steps)) < 1e-12
    assert system.conservative == (name != "duffing")


@pytest.mark.parametrize("name", sorted(SCENES.keys() - {"kicked"}))  # whose step is that of the standard map
def test_the_default_step_is_sensible(name):
    """Half of it changes the end of 160 steps by less than 1e-11 in a method of order 8."""
    system = SCENES[name]
    span = (0, 160 * system.dt)
    one, half = (solve(system, "kahan_li8", span, dt=system.dt / n, t_eval=[span[1]], backend="array") for n in (1, 2))
    assert np.abs(one.y - half.y).max() < 1e-11


@pytest.mark.parametrize(("upright", "drive"), [(False, 0.5), (True, 0.7)])
def test_small_deviations_of_the_driven_pendulum_follow_mathieu(upright, drive):
    """At a characteristic value α a multiplier is −1, of b₁ about q = 0, or 1, of a₀ about q = π."""
    alpha = -mathieu_a(0, drive) if upright else mathieu_b(1, drive)
    w = 2 / math.sqrt(alpha)
    system = systems.driven_pendulum(drive * w**2 / 2, w)
    found = floquet_multipliers(system, [math.pi if upright else 0.0, 0.0])
    assert np.trace(found.monodromy) == pytest.approx(2 if upright else -2, abs=1e-9)


def cell(system, method, **options):
    """The matrices of a cell, (2, 2, 2), by the solutions from unit vectors."""
    sol = solve(system, method, (0, system.period), np.eye(4), t_eval=[system.period], backend="array", **options)
    M = sol.y[..., -1].T
    return np.stack([M[np.ix_(i, i)] for i in ([0, 2], [1, 3])])


def test_the_matrices_of_the_lattice():
    for lengths in ({}, {"strength": 0.5, "quadrupole": 0.4, "drift": 1.1}):
        system, exact = systems.fodo_cell(**lengths), systems.fodo_matrices(**lengths)
        np.testing.assert_allclose(cell(system, "kahan_li8"), exact, atol=1e-11)
        np.testing.assert_allclose(np.linalg.det(exact), 1)
    advance = np.arccos(np.trace(systems.fodo_matrices(0.8e4, 0.5e-4), axis1=1, axis2=2) / 2)
    np.testing.assert_allclose(np.sin(advance / 2), 2.0 * 0.4 / 2, rtol=1e-4)  # thin quadrupoles


def test_steps_of_the_kicked_scene_are_the_standard_map():
    K, n = 1.1, 30
    for modes in (1, 4):
        system = systems.kicked(K, modes)
        sol = solve(system, "verlet", (0, n), save_every=2 * modes + 1, backend="array")
        q, p = system.y0
        p += K / 2 * math.sin(q)
        for k in range(1, n + 1):
            q += p
            np.testing.assert_allclose(sol.y[:, k], [q, p + K / 2 * math.sin(q)], atol=1e-10)
            p += K * math.sin(q)


test_bad_parameters = refusals(
    (lambda: systems.driven_pendulum(-1.0), r"^`amplitude` must be positive"),
    (lambda: systems.duffing(force=0), r"^`force` must not be 0"),
    (lambda: systems.driven_pendulum(0.1, 0.0), r"^`frequency` must be positive"),
    (lambda: systems.paul_trap(0.0, math.nan), r"^`q` must be a finite number"),
    (lambda: systems.duffing(damping=-0.1), r"^`damping` must be"),
    (lambda: systems.fodo_cell(quadrupole=1 / 3), r"^`drift` 2.0 and half the `quadrupole` .* multiple"),
    (lambda: systems.kicked(modes=0), r"^`modes` must be a whole number"),
)


def test_a_periodic_orbit_of_the_paul_trap_is_a_mathieu_function():
    q, t = 0.4, np.linspace(0, 10, 6)
    system = systems.paul_trap(float(mathieu_a(0, q)), q)
    exact = mathieu_cem(0, q, np.degrees(t))[0]
    sol = solve(system, "kahan_li8", (0, 10), [exact[0], 0, 0, 0], t_eval=t, backend="array")
    np.testing.assert_allclose(sol.y[0], exact, atol=1e-12)


def test_the_paul_trap_holds_the_ion_up_to_the_first_boundary():
    """q = 0.9080463337 at a = 0, where b₁(q) = 0, by bisection; the tip of the region where both planes are stable."""
    trap, low, high = SCENES["paul-trap"], 0.9, 0.92
    while high - low > 1e-5:
        q = (low + high) / 2
        stable = floquet_multipliers(trap.with_params(drive=q), np.zeros(4)).stable
        low, high = (q, high) if stable else (low, q)
    assert low == pytest.approx(0.9080463337, abs=2e-5)
    assert mathieu_b(1, 0.9080463337) == pytest.approx(0.0, abs=1e-9)
    for a, stable in ((0.2365, True), (0.2375, False)):
        assert floquet_multipliers(systems.paul_trap(a, 0.7060), np.zeros(4)).stable is stable


def test_the_multipliers_of_duffings_oscillator_have_the_product_of_the_friction():
    """An orbit of the period of the drive, found by Newton's method, by 60 steps a period."""
    system, y = SCENES["duffing"], np.array([-0.148, 0.018])  # of the linear equation
    T, dt = system.period, system.period / 60
    for _ in range(8):
        end = solve(system, "kahan_li8", (0, T), y, dt=dt, t_eval=[T], backend="array").y[:, -1]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # not periodic yet
            M = floquet_multipliers(system, y, dt=dt).monodromy
        y = y - np.linalg.solve(M - np.eye(2), end - y)
    found = floquet_multipliers(system, y, dt=dt)
    assert found.mismatch < 1e-10
    assert not found.stable  # it is part of the strange attractor
    assert np.prod(found.multipliers).real == pytest.approx(math.exp(-0.25 * T), rel=1e-10)
    assert found.pairing < 1e-13
    assert systems.duffing(damping=0).conservative


@pytest.mark.parametrize(("method", "order"), [("leapfrog", 2), ("chin4c", 4), ("gauss_legendre4", 4), ("verlet", 2)])
def test_order_in_a_lattice_whose_steps_meet_the_jumps(method, order):
    system, exact = SCENES["fodo-cell"], systems.fodo_matrices()
    errors = [np.abs(cell(system, method, dt=system.dt / n) - exact).max() for n in (1, 2)]
    assert math.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.1)


def test_runs_land_on_jumps_within_their_steps():
    cell = SCENES["fodo-cell"]
    t = sp.Symbol("t", real=True)

    def system(drive, **scene):
        q, p = sp.symbols("q p", real=True)
        return HamiltonianSystem.from_sympy(p**2 / 2 + q**2 / 2 - q * drive, time="t", y0=[0.5, 0.1], **scene)

    switched = system(sp.Piecewise((0, t < 1.2), (1, True)))
    waves = system(sp.sign(sp.cos(t)))
    ramp = system((t - 1.2) * sp.Heaviside(t - 1.2))
    for each, t0, dt in (
        (cell, 0.0, 0.2),
        (cell, 0.06, cell.dt),
        (switched, 0.0, 0.3),
        (switched, 0.2, 0.25),
        (waves, 0.0, 0.1),
        (waves, 2.0, -0.1),
        (waves, -math.pi / 2, math.pi / 14),
    ):
        span = t0, t0 + math.copysign(2.0, dt)
        found, finer = (
            solve(each, "gauss_legendre8", span, dt=h, t_eval=[span[1]], backend="array").y
            for h in (abs(dt), abs(dt) / 2)
        )
        np.testing.assert_allclose(found, finer, rtol=1e-8)
    solve(ramp, "kahan_li8", (0.0, 2.0), dt=0.5, backend="array")  # of a kink there is no word
    with pytest.raises(ValueError, match="jumps at some times"):
        energy_balance_error(solve(switched, "leapfrog", (0, 2), dt=0.4, backend="array"))
    solve(switched, "dop853", (0.0, 2.0))  # its steps are its own
