"""Waves on lattices: their exact solutions, to which the grid and the methods converge with their orders."""

import math

import numpy as np
import pytest

import sympflow
from sympflow import solve, systems

WAVES = {  # scenes of an equation on the line, and h H of them
    "pulse": (lambda **g: systems.wave_equation(**{k: v for k, v in g.items() if k != "length"}), None),
    "breather": (lambda **g: systems.sine_gordon("breather", 0.7, 0.4, **g), 16 * math.sqrt(0.51 / 0.84)),
    "kink": (lambda **g: systems.sine_gordon("kink", velocity=-0.5, **g), 8 / math.sqrt(0.75)),
    "phi4": (lambda **g: systems.phi4(velocity=0.6, **g), 2 * math.sqrt(2) / 3 / 0.8),
}
CHAINS = {"toda": lambda: systems.toda_chain(96, 0.8), "fput": lambda: systems.fput_beta(16, 2.0, 0.4)}


def residual(system, t, step=1e-4):
    """d/dt of the exact solution less the vector field there: by a difference of order 4."""
    e = system.exact(t + step * np.array([-2, -1, 1, 2]))
    slope = (e[0] - 8 * e[1] + 8 * e[2] - e[3]) / (12 * step)
    return abs(slope - system.vector_field(system.exact(t))).max()


@pytest.mark.parametrize("accuracy", [2, 4, 6])
@pytest.mark.parametrize("wave", WAVES)
def test_an_exact_wave_solves_the_equation_of_the_grid_to_the_order_of_its_stencil(wave, accuracy):
    make, energy = WAVES[wave]
    coarse, fine = (make(n=n, length=60.0, accuracy=accuracy) for n in (300, 600))
    t = 0.3 * coarse.t_span[1]
    slope = math.log2(residual(coarse, t) / residual(fine, t))
    assert slope == pytest.approx(accuracy, abs=0.35)
    if energy is not None and accuracy == 6:
        assert fine.params["h"] * fine.hamiltonian(fine.y0) == pytest.approx(energy, rel=1e-5)


@pytest.mark.parametrize(("method", "order"), [("verlet", 2), ("srkn6b", 4), ("kahan_li6", 6)])
@pytest.mark.parametrize("chain", CHAINS)
def test_methods_converge_to_the_exact_solution_of_a_chain(chain, method, order):
    system, span = CHAINS[chain](), (0.0, 3.0)
    steps = {"verlet": (60, 120), "srkn6b": (30, 60), "kahan_li6": (15, 30)}[method]
    errors = [
        abs(solve(system, method, span, dt=3 / n, t_eval=[3.0], backend="array").y[:, -1] - system.exact(3.0)).max()
        for n in steps
    ]
    assert math.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.4)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: systems.sine_gordon("soliton"), "`wave` must be one of 'breather', 'kink'"),
        (lambda: systems.sine_gordon(frequency=1.0), "`frequency` must be between 0 and 1, of a breather"),
        (lambda: systems.sine_gordon("kink", velocity=1.0), "`velocity` must be a number between"),
        (lambda: systems.sine_gordon(length=math.inf), "`length` must be positive"),
        (lambda: systems.phi4(accuracy=3), "`accuracy` must be 2, 4 or 6"),
        (lambda: systems.phi4(n=4), "`n` must be a whole number"),
        (lambda: systems.wave_equation(speed=0), "`speed` must be positive"),
        (lambda: systems.toda_chain(kappa=50.0), "`kappa` must be at most 20"),
        (lambda: systems.fput_beta(n=15), "`n` must be even"),
        (lambda: systems.grid(systems.pendulum()), "`system` must be a lattice of one axis"),
    ],
)
def test_bad_parameters_of_waves_are_refused(make, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        make()


def test_the_schroedinger_soliton_goes_around_the_ring():
    ring = sympflow.systems.nonlinear_schroedinger(velocity=3.0, n=256, length=40.0)
    sol = solve(ring, "linear_kahan_li8", (0, 20), dt=0.02, t_eval=[0.0, 10.0, 20.0])  # one turn and a half
    assert abs(sol.states - ring.exact(sol.t)).max() < 1e-7


@pytest.mark.parametrize("chain", CHAINS)
def test_the_solution_of_a_chain_is_exact(chain):
    system = CHAINS[chain]()
    times = np.linspace(*system.t_span, 9)
    rounding = 10 * np.finfo(float).eps * system.t_span[1] / 1e-4  # of the phase, in a difference over 1e-4
    assert max(residual(system, t) for t in times[1:-1]) < rounding
    np.testing.assert_array_equal(system.exact(0.0), system.y0)
    energies = system.hamiltonian(system.exact(times))
    np.testing.assert_allclose(energies, energies[0], rtol=1e-12)
    assert system.domain.contains(system.exact(times)).all()


def test_grid_and_method_converge_together_to_a_moving_kink():
    """The wave of the line: halved are h and dt, of order 4 both."""
    errors = []
    for n in (160, 320):
        system = systems.sine_gordon("kink", velocity=0.5, n=n, length=50.0)
        sol = solve(system, "srkn6b", (0.0, 8.0), dt=32 / n, t_eval=[8.0], backend="array")
        errors.append(abs(sol.y[:, -1] - system.exact(8.0)).max())
    assert math.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.4)


def test_a_small_soliton_of_a_chain_is_that_of_korteweg_and_de_vries():
    """r = −κ² sech²(κ(i − i₀ − (1 + κ²/6)t)), up to O(κ⁴)."""
    defects = []
    for kappa in (0.2, 0.1):
        chain, t = systems.toda_chain(400, kappa), 12.0
        r = np.diff(chain.exact(t)[:400])
        x = systems.grid(chain)[:-1] + 100 - (1 + kappa**2 / 6) * t
        defects.append(abs(r + kappa**2 / np.cosh(kappa * x) ** 2).max())
    assert math.log2(defects[0] / defects[1]) > 3.7
