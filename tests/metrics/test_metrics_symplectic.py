"""Volume, symplecticity and transported area of the map as executed."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
import torch
from conftest import refusals

from sympflow import HamiltonianSystem, get, loop_area_error, solve, symplecticity_defect, systems, volume_error
from sympflow.flow.shipped import shipped
from sympflow.integrators.base import FixedStep
from sympflow.metrics.symplectic import loop_area, natural_scale, step_tangents

pytestmark = pytest.mark.filterwarnings("ignore:`dt` .* is too long:RuntimeWarning")

EPS = np.finfo(float).eps


@dataclass(frozen=True)
class Damped(FixedStep):
    """Verlet, then p multiplied by `factor`: log det = d log|factor| a step, exactly."""

    factor: float = 0.9
    name: ClassVar[str] = "damped"
    order: ClassVar[int | None] = None
    symplectic: ClassVar[bool] = False

    def step(self, system, t, y, h):
        y = get("verlet")().step(system, t, y, h)
        return (
            y * y.new_tensor([1.0] * system.ndof + [self.factor] * system.ndof)
            if torch.is_tensor(y)
            else (y * np.repeat([1.0, self.factor], system.ndof))
        )


def test_rk45_and_a_damped_map_do_not():
    system = systems.henon_heiles()
    rk45 = solve(system, "rk45", (0, 20))
    assert volume_error(rk45) < -1e-3
    assert symplecticity_defect(rk45) > 1e-4
    damped = solve(system, Damped(dt=0.1, factor=0.9), (0, 1.05))
    steps = 11  # ten, and a shorter one
    assert volume_error(damped) == pytest.approx(steps * 2 * np.log(0.9), rel=1e-12)
    assert symplecticity_defect(damped) == pytest.approx(0.1, rel=1e-9)  # ‖(factor − 1) J‖


def test_volume_of_one_rk45_step_is_that_of_its_stability_function():
    """On the oscillator det A = |R(iz)|², R the degree-6 stability polynomial of Dormand–Prince."""
    z = 0.7
    sol = solve(systems.harmonic_oscillator(), "rk45", (0, z), first_step=z, rtol=1e3, atol=1e3)
    assert len(sol.t) == 2
    R = sum(c * (1j * z) ** k for k, c in enumerate([1, 1, 1 / 2, 1 / 6, 1 / 24, 1 / 120, 1 / 600]))
    assert volume_error(sol) == pytest.approx(2 * np.log(abs(R)), rel=1e-10)


def test_a_negative_determinant_is_reported():
    sol = solve(systems.harmonic_oscillator(), Damped(dt=0.1, factor=-1.0), (0, 1))
    with pytest.warns(RuntimeWarning, match="determinant of step 1, from t = 0, is negative"):
        assert volume_error(sol) == np.inf
    singular = solve(systems.harmonic_oscillator(), Damped(dt=0.1, factor=0.0), (0, 1))
    with pytest.warns(RuntimeWarning, match="is zero"):
        assert volume_error(singular) == np.inf


def test_a_batch_is_judged_trajectory_by_trajectory():
    system = systems.henon_heiles()
    y0 = system.domain.sample(6, 0).reshape(2, 3, 4)
    t = np.linspace(0, 10, 5)
    for method in ("rk45", "verlet", Damped(dt=0.3)):
        batch = solve(system, method, (0, 10), y0, t_eval=t)
        alone = solve(system, method, (0, 10), y0[1, 2], t_eval=t)
        assert volume_error(batch).shape == symplecticity_defect(batch).shape == (2, 3)
        assert volume_error(batch)[1, 2] == pytest.approx(volume_error(alone), rel=1e-9, abs=1e-13)
        assert symplecticity_defect(batch)[1, 2] == pytest.approx(symplecticity_defect(alone), rel=1e-9, abs=1e-13)
        series = volume_error(batch, over_time=True)
        assert series.shape == (2, 3, 5)
        np.testing.assert_allclose(series[1, 2], volume_error(alone, over_time=True), rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize("method", ["verlet", "kahan_li8", "chin4a", "sympflow"])
def test_the_metrics_are_those_of_the_precision_that_was_executed(method):
    """The rounding of an entry of A is eps(float32) ≈ 1.2e-7; that of a float64 step would be 2e-16."""
    eps = float(np.finfo(np.float32).eps)
    system = systems.henon_heiles()
    how = shipped(system).to(torch.float32) if method == "sympflow" else method
    sol = solve(system, how, (0, 5), dtype="float32")
    assert sol.y.dtype == np.float32
    n_steps, operations = sol.stats["n_steps"], 100
    assert eps / 10 < symplecticity_defect(sol) < operations * eps
    assert EPS * n_steps * operations < abs(volume_error(sol)) < n_steps * operations * eps
    for _, _, A in step_tangents(sol):
        assert A.dtype == np.float64
        assert np.array_equal(A, A.astype(np.float32))


def circle(n, center=(0.8, 0.0), radius=0.3):
    angle = 2 * np.pi * np.arange(n) / n
    return np.stack([center[0] + radius * np.cos(angle), center[1] - radius * np.sin(angle)], axis=-1)


def test_loop_area_of_a_circle_is_exact():
    for n in (8, 9, 64):
        assert loop_area(circle(n)) == pytest.approx(np.pi * 0.09, rel=1e-14)


@pytest.mark.parametrize("method", ["verlet", "rk4"])
def test_what_is_missing_is_said_before_jacobians_are_made(method, monkeypatch):
    """A gradient alone has no Hessian: no array of (2d)² numbers is asked for to find that out."""
    d = 50_000
    system = HamiltonianSystem(lambda q: (q**2).sum(-1) / 2, ndof=d, gradient=lambda q: q, y0=np.ones(2 * d))
    sol = solve(system, method, (0, 0.1), dt=0.1)
    with pytest.raises(ValueError, match=r"^`sol` has 1 trajectories of 100000 variables, so that the Jacobians"):
        volume_error(sol)
    monkeypatch.setattr("sympflow.integrators.contract.MAX_ASKED_VALUES", math.inf)
    for metric in (volume_error, symplecticity_defect):
        with pytest.raises(ValueError, match=r"^`hessian_vector` is needed here"):
            metric(sol)


def of(metric, system, *start, **options):
    return lambda: metric(solve(system, "verlet", (0, 1), *start), **options)


test_refusals = refusals(
    (of(symplecticity_defect, systems.pendulum(), scale=0.0), "`scale` must be positive"),
    (of(symplecticity_defect, systems.pendulum(), scale=[1.0] * 3), "`scale` must be a number or 1 of"),
    (of(symplecticity_defect, systems.pendulum(), scale="natural"), TypeError, "`scale` must be a number or 1 of them"),
    (of(loop_area_error, systems.henon_heiles()), "`sol` must have one degree of freedom"),
    (of(loop_area_error, systems.pendulum()), "`sol` must start from a loop"),
    (of(loop_area_error, systems.pendulum(), np.ones((16, 2))), "without area"),
)


def test_volume_over_time_is_the_running_sum_of_the_steps_that_have_ended():
    system = systems.pendulum()
    sol = solve(system, Damped(dt=0.1), (0, 100), t_eval=[0, 0.05, 0.1, 0.25, 60, 99.99, 100])
    expected = np.log(0.9) * np.array([0, 0, 1, 2, 600, 999, 1000])
    np.testing.assert_allclose(volume_error(sol, over_time=True), expected, rtol=1e-11)
    back = solve(system, Damped(dt=0.1), (10, 0), t_eval=[10, 9.85, 0])
    np.testing.assert_allclose(volume_error(back, over_time=True), np.log(0.9) * np.array([0, 1, 100]), rtol=1e-11)


@pytest.mark.parametrize("omega", [1.0, 1e3, 1e6])
def test_scaled_defect_is_the_same_at_every_frequency(omega):
    """In (√ω q, p/√ω) the step of length z/ω is the same matrix for every ω."""
    system = systems.harmonic_oscillator(omega)
    np.testing.assert_allclose(natural_scale(system), np.sqrt(omega), rtol=1e-14)
    sol = solve(system, "rk45", (0, 0.5 / omega), first_step=0.5 / omega, rtol=1e3, atol=1e3)
    R = sum(c * (0.5j) ** k for k, c in enumerate([1, 1, 1 / 2, 1 / 6, 1 / 24, 1 / 120, 1 / 600]))
    assert symplecticity_defect(sol) == pytest.approx(1 - abs(R) ** 2, rel=1e-8)
    verlet = solve(system, "verlet", (0, 100 / omega), dt=1 / omega)
    assert symplecticity_defect(verlet) < 10 * EPS


def test_determinant_one_is_weaker_than_symplectic():
    """(q₁, q₂, p₁, p₂) ↦ (q₁, q₂, 2p₁, p₂/2) keeps volume and is not symplectic: its defect is 1."""

    @dataclass(frozen=True)
    class Squeeze(FixedStep):
        name: ClassVar[str] = "squeeze"
        order: ClassVar[int | None] = None
        symplectic: ClassVar[bool] = False

        def step(self, system, t, y, h):
            factors = [1.0, 1.0, 2.0, 0.5]
            return y * (y.new_tensor(factors) if torch.is_tensor(y) else np.array(factors))

    sol = solve(systems.henon_heiles(), Squeeze(dt=1.0), (0, 3))
    assert abs(volume_error(sol)) < 1e-15
    assert symplecticity_defect(sol) == pytest.approx(1.0)


def test_symplectic_methods_carry_a_loop_with_its_area():
    system, t = systems.pendulum(), np.linspace(0, 20, 5)
    sol = solve(system, "verlet", (0, 20), circle(256), t_eval=t, dt=0.5)  # a large step: not accurate, but symplectic
    assert loop_area_error(sol).shape == (5,)
    assert np.abs(loop_area_error(sol)).max() < 1e-12
    damped = solve(system, Damped(dt=0.5, factor=0.99), (0, 20), circle(256), t_eval=t)
    np.testing.assert_allclose(loop_area_error(damped), 0.99 ** (t / 0.5) - 1, rtol=1e-9, atol=1e-14)


def test_loops_are_checked():
    with pytest.raises(ValueError, match="`sol` must have one degree of freedom"):
        loop_area_error(solve(systems.henon_heiles(), "verlet", (0, 1)))
    with pytest.raises(ValueError, match="`sol` must start from a loop"):
        loop_area_error(solve(systems.pendulum(), "verlet", (0, 1)))
    with pytest.raises(ValueError, match="without area"):
        loop_area_error(solve(systems.pendulum(), "verlet", (0, 1), np.ones((16, 2))))


def test_an_unresolved_loop_warns():
    sol = solve(systems.pendulum(), "verlet", (0, 200), circle(16, radius=0.7), t_eval=[200])
    with pytest.warns(RuntimeWarning, match="too stretched"):
        loop_area_error(sol)
