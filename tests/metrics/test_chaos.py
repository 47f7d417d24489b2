"""Lyapunov exponents, SALI and GALI: compiled and by arrays, against what is known of orbits."""

import numpy as np
import pytest

import sympflow
from sympflow import HamiltonianSystem
from sympflow.integrators.contract import forward_tangent
from sympflow.integrators.registry import build
from sympflow.systems import henon_heiles, henon_heiles_escape

CHAOTIC, REGULAR = [0.0, -0.25, 0.42081, 0.0], [0.0, 0.55, 0.2417, 0.0]  # E = 1/8, of Skokos (2001), figure 1
BOTH = [CHAOTIC, REGULAR]
TIMES = [0.0, 10.0, 100.02, 200.0]


@pytest.fixture(scope="module")
def wells():
    return henon_heiles()


def both_ways(function, system, method, t_span, y0, **options):
    found = [function(system, method, t_span, y0, backend=b, **options) for b in ("compiled", "array")]
    np.testing.assert_array_equal(found[0].status, found[1].status)
    return found


@pytest.mark.parametrize("method", ["verlet", pytest.param("chin4c", marks=pytest.mark.slow)])
def test_compiled_vectors_are_those_of_the_differentiated_steps(wells, method):
    compiled, arrays = both_ways(sympflow.sali, wells, method, (0, 200.02), BOTH, t_eval=TIMES, dt=0.1, below=0)
    # rounding grows with the distance of neighbouring orbits, exp(0.05 · 200) on the chaotic one, and 1/SALI
    np.testing.assert_allclose(compiled.history, arrays.history, rtol=1e-6)
    np.testing.assert_allclose(compiled.value, arrays.value, rtol=1e-6)
    assert compiled.t_end == pytest.approx(200.0)


def test_orbits_do_not_depend_on_their_neighbours_nor_on_how_often_they_are_looked_at(wells, monkeypatch):
    y0 = np.random.default_rng(0).uniform(-0.2, 0.2, (70, 4))
    whole = sympflow.sali(wells, "verlet", (0, 300), y0, dt=0.1, below=1e-2)
    assert 0 < (whole.status == 1).sum() < 70
    parts = [sympflow.sali(wells, "verlet", (0, 300), part, dt=0.1, below=1e-2) for part in (y0[:3], y0[3:])]
    np.testing.assert_array_equal(whole.value, np.concatenate([part.value for part in parts]))
    np.testing.assert_array_equal(whole.t_end, np.concatenate([part.t_end for part in parts]))
    full = sympflow.sali(wells, "verlet", (0, 300), y0, dt=0.1, below=0)
    monkeypatch.setattr("sympflow.kernels.tangents.EVERY", 17)
    monkeypatch.setattr("sympflow.kernels.rollouts._CODES", {})
    again = sympflow.sali(henon_heiles(), "verlet", (0, 300), y0, dt=0.1, below=0)
    np.testing.assert_array_equal(full.value, again.value)


@pytest.mark.parametrize(
    ("k", "power"), [(2, 0), *(pytest.param(k, 4 - 2 * k, marks=pytest.mark.slow) for k in (3, 4))]
)
def test_gali_on_a_torus_falls_by_its_power(wells, k, power):
    times = np.geomspace(40, 4000, 60)
    index = sympflow.gali(wells, "verlet", (0, 4000), [REGULAR], k=k, dt=0.1, below=0, t_eval=times)
    slope = np.polyfit(np.log(index.t), np.log(index.history[0]), 1)[0]
    assert slope == pytest.approx(power, abs=0.3)


def test_vectors_of_a_driven_system_are_those_of_neighbouring_orbits():
    text, values = "p**2/2 - cos(q)*(1 + a*cos(w*t))", {"a": 0.8, "w": 1.7}
    system = HamiltonianSystem.from_sympy(text, time="t", params=values)
    y0, w0, step = np.array([1.0, 0.2]), np.array([0.8, 0.6]), 1e-7
    scale = np.array([1.8**0.25, 1.8**-0.25])  # q and p in units of the oscillation at rest, at t = 0
    how = {"method": "verlet", "t_span": (0.3, 10.3), "dt": 0.1, "backend": "array"}
    found = sympflow.lyapunov(system, y0=y0, deviations=w0, **how)
    ends = [sympflow.solve(system, y0=y0 + x * w0, **how).y[:, -1] for x in (step, -step)]
    lengths = [np.linalg.norm(scale * w) for w in (ends[0] - ends[1], 2 * step * w0)]
    rate = np.log(lengths[0] / lengths[1]) / 10
    assert found.value == pytest.approx(rate, abs=1e-7)
    with pytest.raises(ValueError, match="the steps of a batch `y0`"):
        sympflow.lyapunov(system, "dop853", (0, 1), [y0, y0])


METHODS = [
    ("dop853", {"rtol": 1e-10, "atol": 1e-12}),
    pytest.param("gauss_legendre6", {"dt": 0.1}, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("method", "options"), METHODS)
def test_other_methods(wells, method, options):
    exact, found = (
        sympflow.sali(wells, name, (0, 10), BOTH, below=0, **given)
        for name, given in (("kahan_li8", {"dt": 0.1}), (method, options))
    )
    np.testing.assert_allclose(found.value, exact.value, rtol=1e-6)


@pytest.mark.parametrize("function", [sympflow.lyapunov, sympflow.sali])
def test_the_end_of_an_orbit_is_its_last_finite_step(function):
    """Orbits fail within the first block of steps, after which all are looked at."""
    system, y0 = henon_heiles_escape(), [[9.0, 0.1, 0.0, 0.0], [0, 0.1, 0, 0], [5.0, 0.1, 3.0, 0.0]]
    ends = [sympflow.solve(system, "verlet", (0, 10), y, dt=0.1).stats.get("failed_at", 10.0) for y in y0]
    assert 0 < ends[0] < ends[2] < 5
    for found in both_ways(function, system, "verlet", (0, 10), y0, dt=0.1):
        assert found.status.tolist() == [-1, 0, -1]
        assert np.all((np.array(ends) - 0.5 < found.t_end) & (found.t_end <= np.array(ends) + 1e-12))
        assert f"after t = {found.t_end[0]:.15g}" in found.message
        assert "(index 0)" in found.message


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"below": 2}, "`below` must be a number"),
        ({"deviations": [[1, 0], [0, 1]]}, "`deviations` must have shape"),
        ({"deviations": np.zeros((2, 4))}, "`deviations` must be finite and not 0"),
        ({"backend": "gpu"}, "`backend` must be one of"),
        ({"dt": 300.0}, "`t_span` is shorter than one step"),
        ({"t_eval": [300]}, "`t_eval` must lie within"),
        ({"method": "gauss_legendre6", "backend": "compiled"}, "`backend` 'compiled' does not apply"),
        ({"method": "tao4"}, "keeps the second copy of phase space"),
        ({"method": "log_kahan_li8"}, "is differentiated with"),
    ],
)
def test_bad_arguments(wells, arguments, message):
    arguments = {"method": "verlet", **arguments}
    with pytest.raises(ValueError, match=message):
        sympflow.sali(wells, t_span=(0, 200), y0=REGULAR, **arguments)
    with pytest.raises(ValueError, match="`k` must be from 2 to 4"):
        sympflow.gali(wells, "verlet", k=5)


LATTICES = {
    "chain": {"bond": "r**2/2 + r**3/9 + r**4/4", "onsite": "1 - cos(q)", "shape": 7, "boundary": "free"},
    "masses": {"bond": "r**2/2 + r**4/4", "kinetic": "p**2/(2*m)", "params": {"m": 1 + np.arange(6) / 5}, "shape": 6},
    "two fields": {
        "fields": ("u", "v"),
        "onsite": "u**2*v**2/2 + u**4/4",
        "bond": "r_u**2/2 + r_v**2",
        "kinetic": "p_u**2/2 + p_v**2/6",
        "shape": (2, 3),
        "boundary": "fixed",
    },
    "relativistic": {"bond": "r**2/2 + r**4/4", "kinetic": "sqrt(1 + p**2)", "shape": 5},
    "damped": {"bond": "r**2/2 + r**4/4", "damping": 0.3, "shape": 5},
}


def in_pairs():
    return HamiltonianSystem.pairs("-1/r", masses=[1.0, 2.0, 0.5], dim=2, softening=0.3)


@pytest.mark.parametrize(
    ("name", "method"),
    [
        *(("chain", m) for m in ("verlet", "chin4a", "linear_srkn6b", "linear_omelyan4", "mollified_impulse", "rk4")),
        ("masses", "srkn6b"),
        *(("two fields", m) for m in ("omelyan4", "linear_srkn6b")),
        *(("relativistic", m) for m in ("leapfrog", "gauss_legendre4")),
        *(("damped", "verlet"), ("pairs", "chin4a")),
    ],
)
def test_vectors_of_large_systems_are_moved_by_the_derivative_of_the_step(name, method):
    system = in_pairs() if name == "pairs" else HamiltonianSystem.lattice(**LATTICES[name])
    integrator = build(method, {"dt": 0.1})
    rng = np.random.default_rng(3)
    y, W = rng.normal(size=(2, 2 * system.ndof)), rng.normal(size=(2, 2 * system.ndof, 3))
    h = np.array([0.1, -0.2])
    moved = integrator.jvp(system, 0.0, y, h, W)
    expected = forward_tangent(lambda x, s: integrator.step(system, 0.0, x, s), y, h)[1] @ W
    np.testing.assert_allclose(moved, expected, rtol=0, atol=1e-12)


def test_a_large_lattice_has_vectors_without_matrices():
    lattice = HamiltonianSystem.lattice(bond="r**2/2 + r**4/4", shape=40_000)
    found = sympflow.sali(lattice, "srkn6b", (0, 0.5), np.random.default_rng(0).normal(size=80_000) / 3, dt=0.05)
    assert found.status == 0
    with pytest.raises(ValueError, match=r"^`system` has 40,000 degrees of freedom.*of an implicit step.*srkn6b"):
        sympflow.solve(lattice, "gauss_legendre4", (0, 0.1), np.zeros(80_000), dt=0.1)


def test_a_chaotic_orbit_is_told_from_a_regular_one(wells):
    index = sympflow.sali(wells, "verlet", (0, 3000), BOTH, dt=0.1)
    assert index.status.tolist() == [1, 0]
    assert index.success
    assert index.value[0] < 1e-12
    assert 300 < index.t_end[0] < 1500  # exp(−λt) = 1e-12, λ about 0.04
    assert index.value[1] > 0.1
    assert "1 of 2 orbits ended early" in index.message


@pytest.mark.slow
def test_the_exponents_of_henon_heiles(wells):
    exponents = sympflow.lyapunov(wells, "verlet", (0, 2e5), BOTH, dt=0.1, t_eval=[2e3, 2e4])
    assert 0.035 < exponents.value[0] < 0.055  # 0.047 by Skokos (2001)
    # the vectors of a regular orbit grow like t
    assert (exponents.history[1] < 2 * np.log(exponents.t) / exponents.t).all()


def test_gali_of_two_vectors_is_sali_times_the_other_diagonal(wells):
    s = sympflow.sali(wells, "verlet", (0, 50), BOTH, dt=0.1, below=0).value
    g = sympflow.gali(wells, "verlet", (0, 50), BOTH, dt=0.1, below=0).value
    np.testing.assert_allclose(g, s * np.sqrt(4 - s**2) / 2, rtol=1e-12)


@pytest.mark.slow
def test_the_exponent_of_a_ridge_with_friction():
    """λ of q'' = q − γq' is (−γ + √(γ² + 4))/2; the verlet step has this rate up to O(h²)."""
    y0, gamma = [1e-3, 2e-3], 0.4
    system = HamiltonianSystem.from_sympy("p**2/2 - q**2/2", damping=gamma, name="ridge")
    compiled, arrays = both_ways(sympflow.lyapunov, system, "verlet", (0, 40), y0, dt=0.02, deviations=[1.0, 0.5])
    np.testing.assert_allclose(compiled.value, arrays.value, rtol=1e-10)
    np.testing.assert_allclose(compiled.value, (-gamma + np.sqrt(gamma**2 + 4)) / 2, atol=0.02)


@pytest.mark.parametrize("method", ["srkn6b", "chin4a", "linear_srkn6b"])
def test_the_exponent_of_a_lattice_is_that_of_its_coordinates(method):
    lattice = HamiltonianSystem.lattice(bond="r**2/2 + r**4/4", shape=8)
    written = HamiltonianSystem.from_sympy(str(lattice.local.written_out()))
    y0 = np.random.default_rng(0).normal(size=16) / 2
    found = [sympflow.lyapunov(system, method, (0, 10), y0, dt=0.05) for system in (lattice, written)]
    assert found[0].value == pytest.approx(found[1].value, abs=1e-12)


def test_backwards(wells):
    back = both_ways(sympflow.sali, wells, "verlet", (0, -10), BOTH, dt=0.1, t_eval=[-3, -5], below=0)
    np.testing.assert_allclose(back[0].history, back[1].history, rtol=1e-9)
