"""Planets about a star: Kepler's motion | interaction, compiled and by arrays, correctors, encounters, elements."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import sympflow
from sympflow import HamiltonianSystem, gali, lyapunov, solve, splitting_method, systems
from sympflow.arrays import jvp
from sympflow.kernels.protocol import RunCheckpoint
from sympflow.schemes import CORRECTORS, corrector_maps
from sympflow.testing import check_integrator

EPS = np.finfo(float).eps
METHODS = ("wisdom_holman", "kepler_aba104", "kepler_aba864", "kepler_aba1064")
MODIFIED = "kepler_takahashi_imada"
ELEMENTS = {"a": [5.2, 9.55, 19.2], "e": [0.05, 0.06, 0.05], "inc": [0.02, 0.04, 0.01], "M": [0.3, 2.0, 4.0]}
MASSES = [1.0, 1e-3, 3e-4, 5e-5]
GAUSS = 0.01720209895**2
BENT = splitting_method("chin4a", "kepler")
OUTER = systems.solar_system(("Jupiter", "Saturn", "Uranus", "Neptune"))
RELATIVITY = "-3*(G*m/(c*r))**2"
LIGHT_A_DAY = 173.144632674


def giants(**options):
    return HamiltonianSystem.planets(MASSES, **{"elements": ELEMENTS, "G": GAUSS, **options})


GIANTS = giants()
DEMOCRATIC = giants(coordinates="democratic")
EXTRA = giants(extra=RELATIVITY + " + k*z**2/r**5", params={"c": 1.0, "k": 1e-5})
MANY = HamiltonianSystem.planets(
    [1.0, *[1e-6] * 11], elements={"a": 1.3 ** np.arange(11), "e": 0.02, "M": 2.0 * np.arange(11)}
)
LIGHT = {
    "a": [5.2, 9.55, 3.0, 2.5, 15.0, 7.0, 3.3],
    "e": [0.05, 0.06, 0.05, 0.1, 0.2, 0.01, 0.0],
    "inc": [0.02, 0.04, 0.01, 0.1, 0.0, 0.3, 0.0],
    "M": [0.3, 2.0, 4.0, 1.0, 2.0, 5.0, 6.0],
}


def asteroids(**options):
    return HamiltonianSystem.planets([1.0, 1e-3, 3e-4, *[0.0] * 5], elements=LIGHT, G=GAUSS, encounter=None, **options)


@pytest.mark.parametrize(
    ("method", "system"),
    [
        *(
            pytest.param(m, s, marks=pytest.mark.slow if (k - i) % 3 == 2 else ())
            for i, m in enumerate(METHODS)
            for k, s in enumerate((GIANTS, DEMOCRATIC, MANY))
        ),
        *((BENT, GIANTS), (BENT, EXTRA), (MODIFIED, MANY), (MODIFIED, EXTRA)),
        ("kepler_aba864", EXTRA),
    ],
)
def test_compiled_steps_are_those_of_arrays(method, system):
    y0 = system.y0 * np.linspace(1.0, 1.01, 3)[:, None]
    t = np.array([0.0, 1.0, 7.3, 20.0]) * system.dt
    runs = [solve(system, method, (0, t[-1]), y0=y0, t_eval=t, backend=b) for b in ("compiled", "array")]
    scale = np.abs(system.y0).reshape(2, -1).max(-1).repeat(system.ndof)[:, None]
    assert np.abs((runs[0].y - runs[1].y) / scale).max() < 40 * 20 * EPS
    alone = solve(system, method, (0, t[-1]), y0=y0[1], t_eval=t)
    assert np.array_equal(alone.y, runs[0].y[1])
    tensors = solve(system, method, (0, t[-1]), y0=torch.as_tensor(y0), t_eval=t)
    assert np.abs((tensors.y.numpy() - runs[1].y) / scale).max() < 40 * 20 * EPS


@pytest.mark.parametrize("order", CORRECTORS)
def test_correctors_remove_errors_of_first_order_in_the_masses(order):
    system = HamiltonianSystem.planets([1.0, 1e-6, 1e-6], elements={"a": [1.0, 1.6], "e": [0.05, 0.02], "M": [0, 2.0]})
    errors = []
    for dt in (0.2, 0.1):
        sol = solve(system, "wisdom_holman", (0, 200.0), dt=dt, corrector=order)
        H = system.hamiltonian(sol.y.T)
        errors.append(np.abs(H / H[0] - 1).max())
    plain = system.hamiltonian(solve(system, "wisdom_holman", (0, 200.0), dt=0.1).y.T)
    assert errors[1] < 0.2 * np.abs(plain / plain[0] - 1).max()
    assert errors[1] < 3e-14 or np.log2(errors[0] / errors[1]) > min(order, 7) - 1.2


@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize("order", CORRECTORS)
def test_a_corrector_and_its_inverse(order, symmetric):
    there, back = (corrector_maps(order, sign, symmetric) for sign in (1, -1))
    assert sum(c for kind, c in there if kind == "kick") == pytest.approx(0, abs=1e-14)
    assert np.allclose([-c for _, c in reversed(back)], [c for _, c in there], atol=1e-15)


def test_compensated_sums_keep_round_off_small():
    """Without them energies walk by the roundings of six numbers in 1.6 million kicks and drifts."""
    given = {"dt": 150.0, "t_span": (0, 3e7), "save_every": 1000, "on_domain_exit": "ignore"}
    plain, summed = (solve(OUTER, "kepler_aba1064", **given, compensated=c).energy_error() for c in (False, True))
    walk = np.sqrt(6 * 1.6e6) * EPS
    assert np.abs(plain).max() < walk
    assert np.abs(summed).max() < 0.05 * walk


# deviation vectors ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("system", "method", "options"),
    [
        (GIANTS, "wisdom_holman", {"corrector": 5}),
        (EXTRA, "kepler_aba864", {}),
        (DEMOCRATIC, "wisdom_holman", {}),
        (MANY, BENT, {}),
        (asteroids(extra="1e-4/r**3"), "wisdom_holman", {"corrector": 5}),
        (asteroids(coordinates="democratic"), "kepler_aba864", {}),
    ],
)
def test_vectors_are_moved_by_the_derivative_of_a_step(system, method, options):
    method = sympflow.get(method)(dt=system.dt, **options)
    composition, n = method.composed(system), 2 * system.ndof
    W = np.random.default_rng(0).normal(size=(n, 3))
    end, moved = composition.jvp(system.y0, 5 * system.dt, W)
    y0, h = torch.as_tensor(system.y0), torch.tensor(5 * system.dt, dtype=torch.float64)
    for k in range(3):
        right = jvp(lambda y: composition.step(y, h), y0, torch.as_tensor(W[:, k]))
        assert np.abs(right[0].numpy() - end).max() < 100 * EPS * np.abs(end).max()
        assert np.abs(right[1].numpy() - moved[:, k]).max() < 100 * EPS * np.abs(moved).max()
    for function, more in ((lyapunov, {}), (gali, {"k": 3, "below": 0.0})):
        given = {**options, **more, "t_span": (0, 8 * system.dt), "dt": system.dt}
        found = [function(system, type(method), backend=b, **given).value for b in ("compiled", "array")]
        assert found[0] == pytest.approx(found[1], rel=1e-10)


# an extra potential --------------------------------------------------------------------------------------------------


def test_the_perihelion_of_mercury():
    """The 1/r² potential of general relativity turns it by 6πGM/(c² a (1 − e²)) an orbit: 42.98″ a century."""
    turns = []
    for extra in ({}, {"extra": RELATIVITY, "params": {"c": LIGHT_A_DAY}}):
        system = HamiltonianSystem.planets(
            [1.0, 1 / 6_023_600, 1 / 408_523.71],
            elements={"a": [0.38709927, 0.72333566], "e": [0.20563593, 0.0067], "inc": [0.12, 0.05], "M": [1.0, 2.0]},
            units="AU, day, solar mass",
            **extra,
        )
        sol = solve(system, "wisdom_holman", (0, 36_525.0), dt=2.0, corrector=17, save_every=10)
        assert np.abs(sol.energy_error()).max() < 1e-11
        orbits = sympflow.elements(sol)
        turns.append(
            np.polyfit(sol.t / 36_525, np.degrees(np.unwrap(orbits.node[0]) + np.unwrap(orbits.peri[0])), 1)[0]
        )
    assert (turns[1] - turns[0]) * 3600 == pytest.approx(42.98, abs=0.02)


@pytest.mark.parametrize("backend", ["compiled", "array"])
def test_an_encounter_ends_the_run(backend):
    orbits = {"a": [1.0, 1.1], "M": [0.0, 1.0]}
    system = HamiltonianSystem.planets([1.0, 1e-4, 1e-4], elements=orbits)
    sol = solve(system, "wisdom_holman", (0, 2000.0), dt=0.2, save_every=100, backend=backend)
    assert sol.status == -1
    assert "`encounter` Hill radii" in sol.message
    assert "splitting 'kinetic'" in sol.message
    assert 0 < sol.stats["failed_at"] < 2000
    if backend == "compiled":
        assert "Bodies 1 and 2 were" in sol.message
    free = HamiltonianSystem.planets([1.0, 1e-4, 1e-4], elements=orbits, encounter=None)
    assert solve(free, "wisdom_holman", (0, 100.0), dt=0.2, backend=backend).status == 0


# bad input ---------------------------------------------------------------------------------------------------------

BAD = [
    ({"masses": [1e-3, 1.0]}, "`masses` must begin with the star"),
    ({"masses": [1.0]}, "`masses` must be those of a star and one planet"),
    ({"masses": [1.0, -1e-3, 1e-3, 0.1]}, "`masses` must be positive, or 0"),
    ({"elements": None}, "`elements` or `y0`"),
    ({"y0": np.zeros(24)}, "`elements` or `y0`"),
    ({"elements": None, "y0": np.zeros(7)}, "`y0` must be a finite state"),
    ({"elements": {"a": [1, 2, 3], "omega": 0.1}}, "`elements` has 'omega'"),
    ({"elements": {"a": [1, 2]}}, "`elements` must give a, e, inc"),
    ({"elements": {"a": [1, 2, 3], "e": [0.1, -0.2, 0]}}, "`elements` of planet 2 .* negative"),
    ({"elements": {"a": [1, 2, 3], "e": [0.1, 1.2, 0]}}, "`elements` of planet 2 .* wrong sign"),
    ({"elements": {"a": [1, 2, 3], "inc": [7.0, 0, 0]}}, "`elements` of planet 1 .* radians"),
    ({"elements": None, "y0": np.zeros(24)}, "`y0` has body 1 at the place of the star"),
    ({"elements": {"a": [1, 2, np.nan]}}, "`elements` of planet 3 .* finite"),
    ({"G": -1.0}, "`G` must be positive"),
    ({"units": "AU, day, solar mass"}, "`units` determine `G`"),
    ({"G": None, "units": "AU, day"}, "`units` must be 'SI', or names of a length"),
    ({"G": None, "units": "parsec, day, kg"}, "The names are m, km, AU; s, day, year; kg, solar mass"),
    ({"G": None, "units": ("AU", "fortnight", "kg")}, "got .'AU', 'fortnight', 'kg'"),
    ({"coordinates": "heliocentric"}, "`coordinates` must be 'jacobi' or 'democratic'"),
    ({"encounter": -1}, "`encounter` must be positive"),
    ({"extra": "w*r"}, "`extra` holds w, and its names are x, y, z, r, G, m"),
    ({"extra": "r +"}, "`extra` cannot be parsed"),
    ({"extra": "G*m"}, "`extra` must depend on x, y, z, r"),
    ({"extra": "sign(x - 1)"}, "`extra` jumps where"),
    ({"extra": "1/r", "params": {"c": 2.0}}, "`params` has 'c', which `extra` does not use"),
    ({"extra": "1/r", "params": {"r": 2.0}}, "`params` gives a value to 'r'"),
    ({"params": {"c": 2.0}}, "`params` are those of `extra`"),
]


@pytest.mark.parametrize(("options", "message"), BAD)
def test_bad_arguments(options, message):
    given = {"masses": MASSES, "elements": ELEMENTS, "G": GAUSS, **options}
    with pytest.raises(ValueError, match=message):
        HamiltonianSystem.planets(given.pop("masses"), **given)


@pytest.mark.parametrize(
    ("units", "G"),
    [
        ("AU, day, solar mass", 2.959122082856e-4),
        (("AU", "year", "solar mass"), 39.476926421373),
        ("m, s, kg", 6.67430e-11),
        ("SI", 6.67430e-11),
        ("km, s, Earth mass", 3.986004e5),
    ],
)
def test_units(units, G):
    system = HamiltonianSystem.planets([10.0, 1.0], elements={"a": 1.0}, units=units)
    assert system.params["G"] == pytest.approx(G, rel=1e-8)


# the system, the choice of a method, elements -----------------------------------------------------------------------


def test_elements_of_solutions_and_back():
    system = systems.solar_system(("Jupiter", "Saturn"))
    sol = solve(system, t_span=(0, 400_000.0), dt=200.0, save_every=20)
    found = sympflow.elements(sol)
    assert found.a.shape == (2, len(sol.t))
    assert np.allclose(found.a.mean(-1), [5.20, 9.54], atol=0.05)
    for about in ("star", "jacobi"):
        assert np.ptp(sympflow.elements(sol, about=about).e[0]) < 0.04
    last = sympflow.elements(sol.y[:, -1], system)
    assert np.allclose(sympflow.states_of_elements(last, system), sol.y[:, -1], rtol=1e-9, atol=1e-12)
    assert last["a"] is last.a is last[0]
    table = sympflow.elements(sol.y.T, system)
    assert np.allclose(sympflow.states_of_elements(table, system), sol.y.T, rtol=1e-9, atol=1e-12)


def test_a_moon_is_no_planet():
    moon = GIANTS.y0.copy().reshape(2, 4, 3)
    moon[0, 3] = moon[0, 1] + [0.01, 0, 0]
    moon[1, 3] = MASSES[3] * (moon[1, 1] / MASSES[1] + [0, np.sqrt(GAUSS * 1e-3 / 0.01), 0])
    system = HamiltonianSystem.planets(MASSES, y0=moon.ravel(), G=GAUSS, dt=1.0)
    with pytest.raises(ValueError, match="bodies 1 and 3 are bound to each other: take the splitting 'kinetic'"):
        solve(system, "wisdom_holman", (0, 100.0))
    assert solve(system, t_span=(0, 100.0)).integrator.name == "log_kahan_li8"
    chosen = HamiltonianSystem.planets(MASSES, y0=moon.ravel(), G=GAUSS)
    assert np.abs(solve(chosen, t_span=(0, 10.0)).energy_error()).max() < 1e-9  # steps of the moon, not of planets


@pytest.mark.parametrize("method", ["wisdom_holman", "kepler_aba1064", None])
def test_a_star_may_have_bodies_without_mass_alone(method):
    """They are on ellipses: after a period each is where it began."""
    system = HamiltonianSystem.planets([1.0, 0.0, 0.0], elements={"a": [1.0, 2.0], "e": 0.3})
    ends = 2 * np.pi * np.array([1.0, 2.0**1.5])
    y = solve(system, method, (0, ends[1]), t_eval=ends).y
    np.testing.assert_allclose(y[3:6, 0], system.y0[3:6], rtol=0, atol=1e-12)
    np.testing.assert_allclose(y[6:9, 1], system.y0[6:9], rtol=0, atol=1e-12)


# bodies without mass ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["wisdom_holman", "srkn11b", "gauss_legendre6", "rk4"])
def test_forms_of_bodies_without_mass(method):
    """Two forms are kept: one of the planets, and one of the others for given motions of these, per unit mass."""
    sol = solve(asteroids(), method, (0, 400.0), dt=40.0)
    keeps = method != "rk4"
    assert (sympflow.symplecticity_defect(sol) < 1e-12) == keeps
    assert (sympflow.symplecticity_estimate(sol, 3).value < 1e-10) == keeps  # steps over masses are 1e5
    system, step = sol.system, 1e-4 * np.eye(24)
    q = system.y0[:24]
    slope = np.stack([(system.force(q - h) - system.force(q + h)) / 2e-4 for h in step], axis=-1)
    assert np.abs(system.potential_hessian(q) - slope).max() < 1e-6 * np.abs(slope).max()


def test_a_planet_on_a_straight_line_bounces_and_its_collision_is_told():
    system = HamiltonianSystem.planets([1.0, 1e-3], y0=[0.0, 0, 0, 1, 0, 0, *[0.0] * 6])
    with pytest.warns(RuntimeWarning, match=r"about t = 1\.11016579, by a collision"):  # π/√(8·1.001)
        sol = solve(system, "wisdom_holman", (0, 3), dt=0.01)
    assert sol.success
    assert sympflow.max_energy_error(sol) < 1e-12


@pytest.mark.parametrize("method", ["wisdom_holman", "kepler_aba864", "srkn11b", "gauss_legendre6"])
def test_bodies_without_mass_move_as_those_of_hardly_any(method):
    given = {"elements": LIGHT, "G": GAUSS, "encounter": None}
    none, least = (HamiltonianSystem.planets([1.0, 1e-3, 3e-4, *[m] * 5], **given) for m in (0.0, 1e-15))
    sols = [solve(s, method, (0, 8000.0), dt=40.0) for s in (none, least)]
    assert np.abs(sols[0].y[:24] - sols[1].y[:24]).max() < 1e-10
    p, v = sols[0].y[33:], sols[1].y[33:] / 1e-15
    assert np.abs(p - v).max() < 1e-12
    assert np.abs(sols[0].energy_error()).max() < 1e-6


def test_any_star_and_bodies_in_pairs_are_planets():
    with pytest.warns(RuntimeWarning, match="orbits that cross, .* bodies 4 and 5"):
        sol = solve(systems.outer_solar_system(), "kepler_aba864", (0, 20_000.0), dt=100.0)
    assert np.abs(sol.energy_error()).max() < 1e-10


def field_with_extra(t, y, k):
    """Hamilton's equations of EXTRA, written out."""
    q, p = y.reshape(2, 4, 3)
    m, F = np.array(MASSES)[:, None], np.zeros((4, 3))
    for i, j in zip(*np.triu_indices(4, 1), strict=True):
        pull = GAUSS * m[i] * m[j] * (q[j] - q[i]) / np.linalg.norm(q[j] - q[i]) ** 3
        F[i] += pull
        F[j] -= pull
    x = q[1:] - q[0]
    r, z = np.linalg.norm(x, axis=1, keepdims=True), x[:, 2:]
    slope = 6 * GAUSS**2 * x / r**4 + k * (2 * z * [0, 0, 1] / r**5 - 5 * z**2 * x / r**7)
    F[1:] -= m[1:] * slope
    F[0] += (m[1:] * slope).sum(0)
    return np.concatenate([(p / m).ravel(), F.ravel()])


@pytest.mark.parametrize(
    ("method", "dt"),
    [("srkn11b", 50.0), ("takahashi_imada", 2.0), ("gauss_legendre6", 50.0), ("rk4", 10.0), ("log_kahan_li8", 50.0)],
)
def test_other_methods_have_compiled_steps_with_an_extra_potential(method, dt):
    """Its parameters are values that `with_params` changes; steps are so short that k = 1e-5 counts 20 times more."""
    system = EXTRA.with_params(k=2e-5)
    runs = [solve(system, method, (0, 1000.0), dt=dt, backend=b) for b in ("compiled", "array")]
    assert np.abs(runs[0].y - runs[1].y).max() < 1000 / dt * 40 * EPS * np.abs(system.y0).max()
    exact = solve_ivp(field_with_extra, (0, 1000.0), system.y0, "DOP853", args=(2e-5,), rtol=1e-12, atol=1e-15)
    assert np.abs(runs[0].y[:, -1] - exact.y[:, -1])[:12].max() < 1e-5


SOLAR = systems.solar_system()


def test_the_periods_and_momenta_of_the_solar_system():
    periods = SOLAR.local.frame.periods
    means = np.array([87.9691, 224.7008, 365.2564, 686.9796, 4332.59, 10_759.2, 30_685.4, 60_189.0])
    off = np.abs(periods / means - 1)
    assert off[:4].max() < 2e-5
    assert (off[4:] < [1e-3, 1e-2, 1e-2, 1e-2]).all()  # Jupiter and Saturn pull the outer ones off their means
    sol = solve(SOLAR, t_span=(0, 36_525.0))
    assert sol.integrator.name == "wisdom_holman"
    assert sol.integrator.corrector == 17
    assert "planets move about a star" in sol.message
    assert np.abs(sol.energy_error()).max() < 1e-11
    L = sympflow.angular_momentum(sol)
    assert np.abs(sympflow.momentum(sol)).max() < 1e-17
    assert np.abs(L - L[:, :1]).max() < 1e-13 * np.linalg.norm(L[:, 0])


def test_a_body_without_mass_that_meets_a_planet():
    orbits = {"a": [1.0, 1.9, 1.06], "M": [0.0, 2.0, 1.0]}
    system = HamiltonianSystem.planets([1.0, 1e-4, 1e-4, 0.0], elements=orbits)
    sol = solve(system, "wisdom_holman", (0, 2000.0), dt=0.2)
    assert sol.status == -1
    assert "Bodies 1 and 3 were" in sol.message


@pytest.mark.parametrize("dt", [5.0, 8.0])
def test_usual_steps_of_the_solar_system_are_warned_of_and_right(dt):
    """Kicks eleven times in a period of Mercury: in ten years it stays within 1e-5 of its place."""
    system = systems.solar_system()
    right = solve(system, "dop853", (0, 3652.5), t_eval=[3652.5], rtol=1e-12, atol=1e-15).y[3:6, 0]
    with pytest.warns(RuntimeWarning, match=f"`dt` {dt:g} is long .* more than a twentieth of the period of body 1"):
        found = solve(system, "wisdom_holman", (0, 3652.5), dt=dt, corrector=17, t_eval=[3652.5]).y[3:6, 0]
    assert np.linalg.norm(found - right) < 1e-5 * np.linalg.norm(right)


@pytest.mark.parametrize("compensated", [False, True])
def test_threads_share_bodies_without_mass(compensated):
    rng, n = np.random.default_rng(0), 50
    orbits = {"a": [5.2, 9.55, *rng.uniform(2.0, 4.0, n)], "e": 0.05, "M": rng.uniform(0, 6, n + 2)}
    for encounter in (None, 1.0):
        system = HamiltonianSystem.planets([1.0, 1e-3, 3e-4, *[0.0] * n], elements=orbits, G=GAUSS, encounter=encounter)
        kernel = sympflow.get("wisdom_holman")(dt=40.0).composed(system).kernel(compensated)
        runs = []
        for threads in (1, 3):
            carry = RunCheckpoint()
            first = kernel.run(40.0, system.y0, 300, np.arange(0, 300, 50), carry, threads=threads)
            last = kernel.run(40.0, system.y0, 600, np.arange(300, 600, 50), carry, threads=threads)
            runs.append((first.states, last.states, last.n_finite, kernel.remark))
        for one, other in zip(*runs, strict=True):
            assert np.array_equal(one, other, equal_nan=not isinstance(one, str))


@pytest.mark.slow
def test_the_contract_of_integrators():
    """A star with heavy companions, whose momenta are of the size of the differences that the checks make."""
    orbits = {"a": [1.5, 9.0], "e": [0.1, 0.05], "inc": [0.02, 0.04], "M": [0.0, 2.0]}
    system = HamiltonianSystem.planets([2.0, 0.5, 0.4], elements=orbits, t_span=(0, 60.0), dt=0.3, encounter=None)
    around = solve(system, "srkn11b", (0, 300.0), dt=0.05, save_every=20).y.T
    system = system.with_scene(domain=sympflow.Tube(around, 0.02))
    report = check_integrator(sympflow.get("wisdom_holman"), system)
    assert set(report.skipped) == {"friction_is_in_the_steps", "the_drive_is_in_the_steps"}


@pytest.mark.parametrize("factor", [1, 100])
@pytest.mark.parametrize(
    ("method", "power"), [("wisdom_holman", 2), ("kepler_aba104", 4), ("kepler_aba864", 4), (BENT, 4)]
)
def test_the_error_grows_with_the_step_and_the_masses(method, power, factor):
    """The leading error is ε dt² (Wisdom and Holman 1991); of the others ε² dt⁴, beside ε with high powers of dt."""
    masses = [1.0, *(factor * 1e-2 * np.array(MASSES[1:]))]
    system = HamiltonianSystem.planets(masses, elements=ELEMENTS, G=GAUSS)
    errors = []
    for dt in (200.0, 100.0):
        H = system.hamiltonian(solve(system, method, (0, 60_000.0), dt=dt).y.T)
        errors.append(np.abs(H / H[0] - 1).max())
    assert errors[0] < 1e-4 * factor
    if errors[1] > 100 * EPS:
        assert np.log2(errors[0] / errors[1]) > power - 0.7


def test_force_gradients_remove_errors_of_second_order_in_the_masses():
    """With a corrector the error is ε² dt² of plain kicks, and ε² dt⁴ (Wisdom, Holman and Touma 1996)."""
    errors = []
    for method in ("wisdom_holman", MODIFIED):
        for dt in (60.0, 120.0):
            given = {"dt": dt, "t_span": (0, 1.2e6), "save_every": 50, "on_domain_exit": "ignore"}
            errors.append(np.abs(solve(OUTER, method, corrector=17, **given).energy_error()).max())
    assert errors[2] < 0.01 * errors[0]
    assert np.log2(errors[1] / errors[0]) == pytest.approx(2, abs=0.6)
    assert np.log2(errors[3] / errors[2]) > 3.3


def test_momentum_and_angular_momentum_are_kept():
    sol = solve(GIANTS, "kepler_aba864", (0, 400_000.0), dt=100.0, save_every=100)
    q, p = (x.reshape(4, 3, -1) for x in (sol.y[:12], sol.y[12:]))
    L = np.cross(q, p, axis=1).sum(0)
    assert np.abs(p.sum(0)).max() < 1e-15 * np.abs(p).max() * 50
    assert np.abs(L - L[:, :1]).max() < 1e-12 * np.linalg.norm(L[:, 0])
    moving = GIANTS.y0 + np.concatenate([np.tile([1.0, 2.0, 3.0], 4), np.outer(MASSES, [1e-3, 0, 2e-3]).ravel()])
    other = solve(GIANTS, "kepler_aba864", (0, 4000.0), dt=100.0, y0=moving)
    still = solve(GIANTS, "kepler_aba864", (0, 4000.0), dt=100.0)
    away = (other.y - still.y)[:12].reshape(4, 3, -1)
    right = np.array([1.0, 2.0, 3.0])[:, None] + np.array([1e-3, 0, 2e-3])[:, None] * still.t
    assert np.allclose(away, right, rtol=1e-11)


def test_round_off_is_a_random_walk():
    """After 4e5 steps the energy is off by rounding alone, beside ε² dt² of the corrected method."""
    system = HamiltonianSystem.planets([1.0, 1e-9, 1e-9], elements={"a": [1.0, 1.7], "e": [0.1, 0.2], "M": [0, 2.0]})
    H = system.hamiltonian(
        solve(system, "wisdom_holman", dt=0.15, t_span=(0, 60_000.0), save_every=1000, corrector=17).y.T
    )
    assert np.abs(H / H[0] - 1).max() < 3 * np.sqrt(4e5) * EPS


@pytest.mark.filterwarnings("ignore:`system` has orbits that cross")
@pytest.mark.parametrize(("e", "noise"), [(0.1, EPS / 2), (0.5, EPS), (0.7, 2 * EPS)])
def test_drifts_have_no_bias(e, noise):
    """Energies of planets alone change by no more than a random walk of rounding does.

    Near the pericentre the energy is a difference of terms (1 + e)/(1 − e) times larger.
    """
    orbits = {"a": 1 + 0.1 * np.arange(7), "e": e, "M": 0.9 * np.arange(7), "inc": 0.1 * np.arange(7)}
    system = HamiltonianSystem.planets([1.0, *[1e-30] * 7], elements=orbits, encounter=None)
    n = 2_000_000
    given = {"dt": 0.3, "t_span": (0, 0.3 * n), "save_every": n // 50, "compensated": True}
    q, p = (x.reshape(8, 3, -1) for x in np.split(solve(system, "wisdom_holman", **given).y, 2))
    x, v = (z[1:] - z[:1] for z in (q, p / system.local.masses[:, None, None]))
    E = (v**2).sum(1) / 2 - 1 / np.sqrt((x**2).sum(1))
    assert np.abs(E[:, -1] / E[:, 0] - 1).max() < 3 * np.sqrt(n) * noise


@pytest.mark.filterwarnings("ignore:`dt` .* is long")
def test_vectors_where_the_general_solver_takes_over():
    system = HamiltonianSystem.planets([1.0, 1e-5, 1e-6], elements={"a": [1.0, 40.0], "e": [0.99, 0.9], "M": [3, 0.1]})
    composition = sympflow.get("wisdom_holman")().composed(system)
    for h in (0.1, 7.0, -30.0):
        _, J = composition.tangent(system.y0, h)
        scale = np.repeat(system.local.inertia, 3) ** 0.5
        J = np.concatenate([scale, 1 / scale])[:, None] * J / np.concatenate([scale, 1 / scale])
        M = np.kron([[0, 1], [-1, 0]], np.eye(9))
        assert np.abs(J.T @ M @ J - M).max() < EPS * np.abs(J).max() ** 2 / (1 - 0.99)


def test_a_lyapunov_time_is_found_where_planets_are_packed():
    chaotic = HamiltonianSystem.planets(
        [1.0, 1e-4, 1e-4], elements={"a": [1.0, 1.135], "e": 0.02, "M": [0.0, 2.0]}, encounter=None
    )
    rates = [lyapunov(s, "wisdom_holman", (0, 20_000.0), dt=0.2).value for s in (chaotic, MANY)]
    assert rates[0] > 10 * rates[1]


@pytest.mark.parametrize("mass", [1e-9, 0.0])
def test_a_flattened_star_turns_the_node(mass):
    """By −3/2 n J₂ (R/p)² cos i, of bodies with and without mass."""
    J2, a, e, tilt = 1e-5, np.array([1.0, 2.0]), 0.1, 0.4
    system = HamiltonianSystem.planets(
        [1.0, 1e-9, mass],
        elements={"a": a, "e": e, "inc": tilt, "M": [0.0, 2.0]},
        extra="J2*G*m*R**2*(3*z**2/r**2 - 1)/(2*r**3)",
        params={"J2": J2, "R": 0.5},
    )
    ends = [solve(system, m, (0, 4.0), dt=0.05).y[:, -1] for m in ("kepler_aba1064", "srkn11b")]
    assert np.allclose(*ends, rtol=1e-8, atol=1e-10)
    sol = solve(system, "wisdom_holman", (0, 120.0), dt=0.2)
    node = np.unwrap(sympflow.elements(sol).node)
    right = -1.5 * a**-1.5 * J2 * (0.5 / (a * (1 - e * e))) ** 2 * np.cos(tilt)
    assert np.allclose([np.polyfit(sol.t, x, 1)[0] for x in node], right, rtol=0.03)


@pytest.mark.filterwarnings("ignore:`dt` .* is long")
def test_long_drifts_and_eccentric_orbits():
    """The few corrections of the compiled drift do not suffice there: the general solver takes over, as on arrays."""
    system = HamiltonianSystem.planets(
        [1.0, 1e-5, 1e-6], elements={"a": [1.0, 40.0], "e": [0.99, 0.9], "M": [3.0, 0.1]}
    )
    for dt in (0.1, 2.0, 40.0, -3.0):
        t = np.sign(dt) * np.abs(dt) * np.arange(3)
        runs = [
            solve(system, "wisdom_holman", (0, t[-1]), dt=abs(dt), t_eval=t, backend=b).y for b in ("auto", "array")
        ]
        assert np.abs(runs[0] - runs[1]).max() < 1e-10


@pytest.mark.filterwarnings("ignore:`dt` .* is long")
@pytest.mark.parametrize("dt", [3e3, 6e3, 1e9, 1e20])
def test_a_flight_out_on_a_hyperbola_in_one_step(dt):
    """The first guess of a compiled drift is beyond what numbers hold: the general solver takes over."""
    system = HamiltonianSystem.planets([1.0, 1e-20], elements={"a": [-5.0], "e": [1.2], "inc": [0.3]}, encounter=None)
    runs = [solve(system, "wisdom_holman", (0, dt), dt=dt, t_eval=[dt], backend=b) for b in ("auto", "array")]
    q = [(y[3:6] - y[:3]) / dt for y in (run.y[:, -1] for run in runs)]
    assert [run.status for run in runs] == [0, 0]
    assert np.abs(q[0] - q[1]).max() < 1e-13


@pytest.mark.parametrize("coordinates", ["jacobi", "democratic"])
@pytest.mark.parametrize("planets", [2, 8])
def test_bodies_without_mass_are_compiled(planets, coordinates):
    rng = np.random.default_rng(0)
    a = np.concatenate([2.0 * 1.5 ** np.arange(planets), rng.uniform(1.0, 40.0, 30)])
    orbits = {"a": a, "e": 0.02, "inc": rng.uniform(0, 0.1, len(a)), "M": rng.uniform(0, 6, len(a))}
    given = {"coordinates": coordinates, "encounter": None, "extra": "1e-4/r**3"}
    system = HamiltonianSystem.planets([1.0, *[1e-5] * planets, *[0.0] * 30], elements=orbits, **given)
    runs = [solve(system, "wisdom_holman", (0, 12.0), dt=0.3, backend=b).y for b in ("compiled", "array")]
    assert np.abs(runs[0] - runs[1]).max() < 1e-11
    exact = solve(system, "dop853", (0, 12.0), t_eval=[12.0], rtol=1e-10, atol=1e-12).y[:, 0]
    q = slice(system.ndof)
    assert np.abs(runs[0][q, -1] - exact[q]).max() < 5e-5  # the extra potential moves them by 5e-3
    few = {name: x if name == "e" else x[:planets] for name, x in orbits.items()}
    alone = HamiltonianSystem.planets([1.0, *[1e-5] * planets], elements=few, **given)
    d = 3 * (1 + planets)
    assert np.abs(solve(alone, "wisdom_holman", (0, 12.0), dt=0.3).y[:d] - runs[0][:d]).max() < 1e-11


@pytest.mark.parametrize("options", [{}, {"corrector": 11}])
def test_windows_stores_and_dense_outputs(options, tmp_path):
    given = {"method": "wisdom_holman", "t_span": (0, 40_000.0), "dt": 50.0, **options}
    whole = solve(GIANTS, save_every=20, **given)
    stored = solve(GIANTS, save_every=20, store=tmp_path / "half", **{**given, "t_span": (0, 20_000.0)})
    assert np.array_equal(stored.y, whole.y[:, : stored.y.shape[1]])
    stored = solve(GIANTS, save_every=20, store=tmp_path / "half", resume=True, **given)
    assert np.array_equal(stored.y, whole.y)
    dense = solve(GIANTS, save_every=20, dense_output=True, **given)
    assert np.array_equal(dense.sol(whole.t), whole.y)
