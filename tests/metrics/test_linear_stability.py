"""Linear stability: the trace of a step on the oscillator, its exits from [−2, 2], and what touches without one."""

import math
from fractions import Fraction

import numpy as np
import pytest

from sympflow import HamiltonianSystem, get, max_energy_error, solve, systems
from sympflow.metrics.linear_stability import half_trace, linear_stability, of_method, small_oscillations
from sympflow.schemes import SCHEMES, Scheme, compose

pytestmark = pytest.mark.filterwarnings("ignore:`dt` .* is too long:RuntimeWarning")

FIRST_EXIT = {
    **{"verlet": 2.0, "leapfrog": 2.0, "yoshida4": 1.5734, "yoshida6": 2.2691, "suzuki4": 2.7210, "mclachlan4": 3.0355},
    **{"blanes_moan4": 3.1328, "kahan_li6": 2.5326, "kahan_li8": 3.0964, "srkn6b": 3.1635, "srkn11b": 3.1414},
    **{
        "srkn14a": 3.1409,
        "takahashi_imada": math.sqrt(12),
        "chin4a": math.sqrt(12),
        "chin4c": math.sqrt(8),
        "omelyan4": 3.1393,
        "omelyan6": 3.0426,
    },
    **{"aba104": 3.0896, "aba864": 3.1422, "aba1064": 3.1461},
}


@pytest.mark.parametrize("name", SCHEMES)
def test_the_first_exit_of_each_scheme(name):
    assert linear_stability(name).limit == pytest.approx(FIRST_EXIT[name], abs=6e-5)


@pytest.mark.parametrize("name", SCHEMES)
def test_the_polynomial_is_that_of_the_executed_step(name):
    """½ tr of the Jacobian of a step, at steps in each interval and window; and cos z up to the order."""
    oscillator, method = systems.harmonic_oscillator(3.0), get(name)()
    p = np.array([float(c) for c in half_trace(SCHEMES[name])])
    z = np.array([0.3, 1.0, 2.2, 3.14])
    _, A = method.tangent(oscillator, 0.0, np.zeros((4, 2)), z / 3.0)
    np.testing.assert_allclose(np.trace(A, axis1=1, axis2=2) / 2, np.polyval(p[::-1], z**2), rtol=1e-11, atol=1e-12)
    order = SCHEMES[name].order
    for k in range(order // 2 + 1):
        assert p[k] == pytest.approx((-1) ** k / math.factorial(2 * k), rel=1e-12)


@pytest.mark.parametrize("name", SCHEMES)
def test_the_spectral_radius_exceeds_one_in_the_windows_alone(name):
    found = linear_stability(name)
    p = np.array([float(c) for c in half_trace(SCHEMES[name])])[::-1]
    for z in np.linspace(0.01, 7.0, 500):
        window = found.window_of(z)
        c = abs(np.polyval(p, z**2))
        assert (c > 1) == (window is not None) or abs(c - 1) < 1e-6
        if window is not None:
            assert c + math.sqrt(max(0.0, c * c - 1)) <= window.growth * (1 + 1e-9)


def test_touching_is_a_resonance_and_no_exit():
    """n Verlet steps of h/n: ½ tr = T_n(1 − z²/2n²) touches ±1 at n − 1 interior points, where the step is ±1."""
    for n in (2, 3, 4):
        found = linear_stability(compose("n", 2, (1 / n,) * n, ""))
        assert found.limit == pytest.approx(2 * n, rel=1e-14)
        assert len(found.intervals) == 1
        touching = sorted(n * math.sqrt(2 - 2 * math.cos(k * math.pi / n)) for k in range(1, n))
        np.testing.assert_allclose(found.resonances, touching, rtol=1e-14)
    apart = linear_stability(compose("n", 2, (0.33, 0.34, 0.33), ""))  # no longer equal: an exit, however narrow
    assert len(apart.windows) == 3
    assert apart.limit < 3.0


@pytest.mark.parametrize("method", ["impulse", "strang_parts", "log_leapfrog", "rk4", "implicit_midpoint", "dop853"])
def test_what_is_no_table_of_kicks_and_drifts_is_refused(method):
    with pytest.raises(ValueError, match=r"^`method` .* has no table of kicks and drifts.*Use stability"):
        linear_stability(method)


def _small(system):
    return small_oscillations(system, system.y0, lambda: system.y0[None])


def test_frequencies_about_the_equilibrium_of_lowest_energy():
    np.testing.assert_allclose(_small(systems.fput(50.0)).frequencies, [0, 0, 0, 50, 50, 50], atol=1e-6)
    well = _small(systems.double_well())  # its origin is a saddle
    assert well.fastest == pytest.approx(math.sqrt(2))
    assert abs(well.equilibrium[0]) == pytest.approx(1)
    assert not well.everywhere
    assert _small(systems.harmonic_oscillator(1e6)).everywhere
    heavy = HamiltonianSystem(lambda q: 8 * ((q - 1) ** 2).sum(-1), ndof=1, mass=4.0, y0=[2.0, 0.0])
    assert _small(heavy).fastest == pytest.approx(2)
    assert _small(heavy).everywhere
    hardens = HamiltonianSystem.from_sympy("p**2/2 + q**2/2 + 1e-6*q**4", y0=[1.0, 0.0])
    assert not _small(hardens).everywhere


def test_without_an_equilibrium_the_largest_frequency_along_the_orbit_counts():
    kepler = systems.kepler(0.6)
    found = small_oscillations(kepler, kepler.y0, lambda: np.array([kepler.y0, 2 * kepler.y0]))
    assert found.equilibrium is None
    assert found.fastest == pytest.approx(0.4**-1.5)  # 1/r³ across the radius, at the pericentre


def test_a_resonance_of_the_impulse_method_is_a_window():
    """K = ω², U = κq²/2: ½ tr = cos hω − (hκ/2ω) sin hω, outside [−1, 1] just below hω = π for κ < 0."""
    system = HamiltonianSystem.from_sympy("p**2/2 + 25*q**2/2 - 1 + cos(q)", y0=[0.1, 0.0])
    found = of_method(get("impulse")(), system, _small(system), 1.0)
    h = np.linspace(0.4, 0.9, 100_001)
    outside = h[np.abs(np.cos(5 * h) + h / 10 * np.sin(5 * h)) > 1]
    assert found.windows[0].start == pytest.approx(outside[0], abs=2e-4)
    assert found.windows[0].stop == pytest.approx(outside[-1], abs=2e-4)


def test_the_trace_is_exact():
    assert half_trace(SCHEMES["verlet"]) == (1, Fraction(-1, 2))
    sixth = Fraction(1.0 / 6.0)  # of Chin's table as it is stored
    a, b, g = Fraction(1, 2), (sixth, Fraction(2.0 / 3.0)), Fraction(1.0 / 36.0)
    assert half_trace(SCHEMES["chin4a"])[1] == -a * (2 * b[0] + b[1])
    assert half_trace(SCHEMES["chin4a"])[3] == -(a**2) * b[0] * g


@pytest.mark.parametrize(("name", "inside"), [("srkn14a", 3.1415), ("omelyan4", 3.145), ("mclachlan4", 3.1)])
def test_a_run_in_a_narrow_window_is_lost_and_beside_it_is_not(name, inside):
    """The window of SRKN 14a is 0.0012 wide and its growth 1.0006 a step: enough in 1e5 of them."""
    (first, *_), oscillator = linear_stability(name).windows, systems.harmonic_oscillator()
    assert first.start < inside < first.stop
    for z, lost in ((0.999 * first.start, False), (inside, True), (1.002 * first.stop, False)):
        sol = solve(oscillator, name, (0, 1e5 * z), [1.0, 0.3], dt=z, save_every=1000)
        assert (max_energy_error(sol) > 1e6) == lost


BOUNDS = {"verlet": lambda z: z**2 / 4, "leapfrog": lambda z: z**2 / 4 / (1 - z**2 / 4)}


@pytest.mark.parametrize(
    ("method", "omega", "z"),
    [("verlet", 1.0, 1.99), ("verlet", 1e6, 0.1), ("leapfrog", 1e3, 1.9), ("leapfrog", 1e6, 1.99)],
)
def test_the_energy_error_approaches_its_bound_and_stays_below(method, omega, z):
    """And beyond the limit the state grows by the root of λ² − 2cλ + 1, c = 1 − z²/2."""
    error = max_energy_error(solve(systems.harmonic_oscillator(omega), method, (0.0, 1e5 * z / omega), dt=z / omega))
    bound = BOUNDS[method](z)
    # rounding of 1e5 steps, amplified by the eccentricity of the ellipse that the iterates lie on
    assert 0.99 * bound < error < bound * (1 + 1e5 * np.finfo(float).eps / (2 - z))
    q, beyond = (
        solve(systems.harmonic_oscillator(omega), method, (0.0, 201 / omega), dt=2.01 / omega).q[0],
        2.01**2 / 2 - 1,
    )
    assert abs(q[-1] / q[-2]) == pytest.approx(beyond + np.sqrt(beyond**2 - 1), rel=1e-6)  # 1.2213


def test_windows_of_several_frequencies_are_united():
    found = linear_stability("mclachlan4")
    (a, b, growth), (c, *_) = found.windows
    both = found.in_steps([0.0, 1.0, 2.0])
    assert both.intervals == ((0.0, a / 2), (b / 2, a), (b, c / 2))
    assert both.windows[0].growth == growth
    assert both.window_of(a).stop == b
    assert found.in_steps([]).limit == math.inf
    assert found.in_steps([4.0]).limit == a / 4


def test_an_inconsistent_table_is_unstable_from_the_beginning():
    backwards = Scheme("x", None, (-1.0,), (1.0,), (0.0,), "")
    assert linear_stability(backwards).limit == 0
    assert linear_stability(backwards).intervals == ()
