"""A system in other units is the same system: H' = (ab/c) H(q'/a, p'/b, t'/c) for q' = aq, p' = bp, t' = ct."""

import warnings
from functools import cache

import numpy as np
import pytest

import sympflow
from sympflow import HamiltonianSystem, solve
from sympflow.hamiltonian.fingerprint import fingerprint, same_system
from sympflow.hamiltonian.scales import natural_scale, smallest_size
from sympflow.metrics.reference import reference

UNITS = [
    (1e11, 1e29, 1e7),  # a planet in SI units
    (1e-10, 1e-24, 1e-15),  # an atom
    (1e30, 1e-30, 1.0),
    (1e-30, 1e30, 1e-30),
    (1e30, 1e30, 1e30),
    (1e-30, 1e-30, 1e30),
]
FORMS = {
    "well": ("(p/b)**2/2 + (q/a)**2/2 + (q/a)**4/4", [1.0, 0.3]),  # with a linear part
    "kepler": ("((p1/b)**2 + (p2/b)**2)/2 - 1/sqrt((q1/a)**2 + (q2/a)**2)", [1.0, 0.0, 0.1, 1.1]),  # singular at 0
    "bent": ("(p/b)**2*(1 + (q/a)**2)/2 + (q/a)**4/4", [1.0, 0.3]),  # not separable, without curvature at 0
    "driven": ("(p/b)**2/2 - cos(q/a)*(1 + cos(2*t/c)/2)", [1.0, 0.3]),
    "damped": ("(p/b)**2/2 - cos(q/a)", [1.0, 0.3]),
}


@cache
def scaled(form, units=(1.0, 1.0, 1.0)):
    """A system in units of (a, b, c) for q, p and t; the energy is in units of ab/c."""
    a, b, c = units
    text, y0 = FORMS[form]
    more = {"time": "t", "period": np.pi * c} if form == "driven" else {}
    more |= {"damping": 0.2 / c} if form == "damped" else {}
    params = {"a": a, "b": b, "E": a * b / c} | ({"c": c} if form == "driven" else {})
    return HamiltonianSystem.from_sympy(
        f"E*({text})", params=params, y0=y0 * of_states(form, units), t_span=(0.0, 2 * c), dt=0.05 * c, **more
    )


def of_states(form, units):
    """The factors by which states [q, p] of size 1 are multiplied."""
    return np.repeat(units[:2], len(FORMS[form][1]) // 2)


def assert_alike(measure, form, rtol=1e-8, scales=UNITS):
    """Assert that a measure of a system and its units, free of dimensions, is the same in all units, without a word."""
    expected = np.asarray(measure(scaled(form), (1.0, 1.0, 1.0)), dtype=float)
    assert np.isfinite(expected).any()
    atol = rtol * np.nanmax(np.abs(expected)) + 1e-13  # what is rounding differs
    for units in scales:
        found = measure(scaled(form, units), units)
        np.testing.assert_allclose(found, expected, rtol=0, atol=atol, err_msg=str(units))


METHODS = [
    m
    for m in sympflow.available()
    if not sympflow.get(m).trained
    and m not in ("projected", "adaptive_heun")
    and getattr(sympflow.get(m), "splitting", "") != "kepler"
]


def applies(method, form):
    """True if a method takes a system of this form."""
    try:
        solve(scaled(form), method, t_eval=[0.0])
    except (ValueError, TypeError):
        return False
    return True


@pytest.mark.parametrize("method", METHODS)
def test_methods(method):
    adaptive = "rtol" in sympflow.get(method)().options()
    forms = [form for form in FORMS if applies(method, form)]
    assert "well" in forms
    for k, form in enumerate(forms[: 1 if adaptive else None]):
        told = []

        def end(system, units, form=form, told=told):
            how = {"rtol": 1e-8, "atol": 1e-10 * smallest_size(system, system.y0)} if adaptive else {"backend": "array"}
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                sol = solve(system, method, t_eval=[system.t_span[1]], **how)
            told.append(["is too long" in str(each.message) for each in caught])
            assert sol.success, sol.message
            return sol.y[:, -1] / of_states(form, units)

        assert_alike(end, form, 1e-5 if adaptive else 1e-9, UNITS[k % 2 :: 2])
        assert all(each == told[0] for each in told)
        assert told[0] == [] or (method, told[0]) == ("euler", [True])


def run(system, method="verlet", n=40):
    method = method if system.separable else "implicit_midpoint"
    t = np.linspace(0.0, 2 * system.t_span[1], n + 1)
    return solve(system, method, (0.0, t[-1]), t_eval=t, backend="array")


def steps_of(system, method="rk4"):
    """A run of few steps of a method that is not symplectic."""
    return solve(system, method, backend="array")


def followed(function):
    """A chaos indicator at the end and before; an exponent in units of 1/t."""

    def measure(system, units):
        method = "verlet" if system.separable else "implicit_midpoint"
        c = units[2]
        found = function(system, method, (0, 20 * c), backend="array", t_eval=[5 * c])
        return np.append(found.history, found.value) * (c if function is sympflow.lyapunov else 1)

    return measure


def lines(system, units):
    method = "verlet" if system.separable else "implicit_midpoint"
    found = sympflow.frequencies(system, method, (0, 20 * units[2]), n=2, backend="array")
    return found.frequencies * units[2], np.abs(found.amplitudes) / np.sqrt(units[0] * units[1])


def compared(system, units):
    methods = ["verlet", "rk4"] if system.separable else ["implicit_midpoint", "rk4"]
    how = {"t_span": (0, 5 * units[2]), "n_outputs": 40, "repeats": 1, "backend": "auto"}
    rows = sympflow.compare(system, methods, **how).rows
    assert all(row.status == "ok" and not row.reason for row in rows)
    drifts = [(row.energy_drift or 0.0) * units[2] for row in rows]
    return drifts, [row.energy_error or row.balance_error or row.conformal_defect for row in rows]


def stable(system, units):
    methods, c = ["verlet"] if system.separable else ["rk4"], units[2]
    how = {"steps": [0.1 * c, 0.5 * c], "t_span": (0, 20 * c), "min_steps": 100, "max_steps": 2000}
    (limit,), rows = (report := sympflow.stability(system, methods, **how)).limits, report.rows
    figures = [limit.stable / c, limit.linear and limit.linear / c, limit.frequency and limit.frequency * c]
    return [*(row.energy_error for row in rows), *(np.nan if x is None else x for x in figures)]


def left(system, units):
    method, radius = "verlet" if system.separable else "implicit_midpoint", 1.05 if system.ndof == 2 else 0.9
    found = sympflow.escape_times(system, method, (0, 20 * units[2]), outside=radius * units[0], backend="array")
    return found.time / units[2]


MEASURES = {
    "energy_error": lambda s, u: run(s).energy_error(),
    "energy_drift": lambda s, u: sympflow.energy_drift(run(s)).slope * u[2],
    "symplecticity_defect": lambda s, u: sympflow.symplecticity_defect(steps_of(s)),
    "volume_error": lambda s, u: sympflow.volume_error(steps_of(s)),
    "lyapunov": followed(sympflow.lyapunov),
    "sali": followed(sympflow.sali),
    "gali": followed(sympflow.gali),
    "frequencies": lines,
    "escape_times": left,
    "compare": compared,
    "stability": stable,
}
RELATIVE = {"compare": 1e-4, "stability": 1e-3, "frequencies": 1e-6}  # by differences of energies, bisection, iteration


@pytest.mark.parametrize("form", ["well", "kepler", "bent"])
@pytest.mark.parametrize("name", [pytest.param(m, marks=pytest.mark.slow) if m == "stability" else m for m in MEASURES])
def test_metrics(name, form):
    assert_alike(MEASURES[name], form, RELATIVE.get(name, 1e-8))


OF_DRIVEN = {
    "energy_balance_error": lambda s, u: sympflow.energy_balance_error(steps_of(s, "verlet"), relative=True),
    "by quadrature": lambda s, u: sympflow.energy_balance_error(steps_of(s), relative=True),
    "section": lambda s, u: sympflow.poincare_section(s, "verlet", (0, 10 * u[2])).states / of_states("driven", u),
    "floquet": lambda s, u: np.sort(np.abs(sympflow.floquet_multipliers(s, [0.0, 0.0]).multipliers)),
    "compare": compared,
}


@pytest.mark.parametrize("name", OF_DRIVEN)
def test_metrics_of_driven_systems(name):
    assert_alike(OF_DRIVEN[name], "driven", 1e-4 if name == "compare" else 1e-7)


def test_metrics_of_damped_systems():
    assert_alike(lambda s, u: sympflow.conformal_defect(steps_of(s)), "damped")
    assert_alike(compared, "damped")


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("at_rest", [False, True])
def test_references(form, at_rest):
    """Their accuracy, of a norm of states, is measured in units of the larger of q and p."""

    def states(system, units):
        start = system.y0 * (0 if at_rest and form != "kepler" else 1)
        found = reference(system, system.t_span, start, np.linspace(*system.t_span, 5))
        assert found.accuracy <= 1e-10 * max(units[:2])
        return found.y / of_states(form, units)[:, None]

    expected = states(scaled(form), (1.0, 1.0, 1.0))
    for units in UNITS:
        np.testing.assert_allclose(states(scaled(form, units), units), expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("units", UNITS)
@pytest.mark.parametrize("form", FORMS)
def test_sizes_of_q_and_p_go_with_the_units(form, units):
    a, b, _ = units
    expected = natural_scale(scaled(form)) * np.sqrt(b) / np.sqrt(a)
    np.testing.assert_allclose(natural_scale(scaled(form, units)), expected, rtol=1e-12)


G, SUN, EARTH, AU = 6.674e-11, 1.989e30, 5.972e24, 1.496e11
YEAR = 2 * np.pi * np.sqrt(AU**3 / (G * (SUN + EARTH)))


@pytest.fixture(scope="module")
def two_bodies():
    """The Earth and the Sun, in metres, kilograms and seconds."""
    speed = 2 * np.pi * AU / YEAR * SUN / (SUN + EARTH)
    return HamiltonianSystem.from_sympy(
        "(p1**2 + p2**2)/(2*M) + (p3**2 + p4**2)/(2*m) - G*M*m/sqrt((q1 - q3)**2 + (q2 - q4)**2)",
        params={"G": G, "M": SUN, "m": EARTH},
        y0=[0, 0, AU, 0, 0, -EARTH * speed, 0, EARTH * speed],
        t_span=(0.0, YEAR),
        dt=YEAR / 365,
    )


@pytest.mark.parametrize("backend", ["compiled", "array"])
@pytest.mark.parametrize("method", ["tao2", "tao8", "gauss_legendre4", "gauss_legendre8", "kahan_li8"])
def test_the_earth_is_back_after_a_year(two_bodies, method, backend):
    sol = solve(two_bodies, method, t_eval=[YEAR], backend=backend)
    assert sol.success, sol.message
    away = sol.y[2:4, -1] - sol.y[0:2, -1] - [AU, 0]
    assert np.hypot(*away) < (2e-3 if method == "tao2" else 1e-6) * AU


@pytest.mark.parametrize("units", UNITS)
@pytest.mark.parametrize("method", ["rk45", "dop853", "dopri5", "bosh3"])
def test_a_default_tolerance_hides_no_errors(method, units):
    def end(units):
        return solve(scaled("well", units), method, t_eval=[units[2]]).y[:, -1] / of_states("well", units)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_allclose(end(units), end((1.0, 1.0, 1.0)), atol=5e-3)
        solve(scaled("well", units), method, y0=[0.0, 0.0])


def by_functions(separable, a, b, c):
    """A system of Python functions in units of (a, b, c)."""
    E = a * b / c
    how = {"ndof": 1, "y0": [1.0 * a, 0.3 * b], "t_span": (0.0, 2 * c), "dt": 0.05 * c}
    if separable:
        return HamiltonianSystem(
            potential=lambda q: E * ((q / a) ** 2 / 2 + (q / a) ** 4 / 4).sum(-1), mass=b * b / E, **how
        )
    return HamiltonianSystem(
        hamiltonian=lambda q, p: E * ((p / b) ** 2 * (1 + (q / a) ** 2) / 2 + (q / a) ** 4 / 4).sum(-1), **how
    )


@pytest.mark.slow
@pytest.mark.parametrize("separable", [True, False])
def test_systems_of_functions(separable):
    ends, exponents = [], []
    for units in ((1.0, 1.0, 1.0), *UNITS):
        system = by_functions(separable, *units)
        methods = ["gauss_legendre4", "tao4", *(["verlet", "chin4a"] if separable else [])]
        ends.append([solve(system, m, t_eval=[system.t_span[1]]).y[:, -1] / units[:2] for m in methods])
        followed = sympflow.lyapunov(system, methods[-1] if separable else "implicit_midpoint", backend="array")
        exponents.append(followed.value * units[2])
    np.testing.assert_allclose(ends[1:], np.broadcast_to(ends[0], np.shape(ends[1:])), rtol=0, atol=1e-9)
    np.testing.assert_allclose(exponents, exponents[0], rtol=1e-6)


def test_bodies_have_scales_of_their_masses():
    """A grain of dust beside a star: each momentum is compared with its own mass."""
    system = HamiltonianSystem.pairs(
        "-G/r", masses=[2e30, 6e24, 1e-9], dim=2, params={"G": 6.7e-11}, y0=[0, 0, 1.5e11, 0, 2e11, 0, *[0] * 6]
    )
    s = natural_scale(system)
    np.testing.assert_allclose(s**2 / s[0] ** 2, np.repeat([1, 3e-6, 5e-40], 2), rtol=1e-9)


def test_copies_that_part_are_told_in_any_units(two_bodies):
    apart, long = "two copies that method 'tao2' keeps differ by .* change `omega`", "`dt` .* is too long"
    with pytest.warns(RuntimeWarning, match=apart), pytest.warns(RuntimeWarning, match=long):
        solve(two_bodies, "tao2", dt=YEAR / 4, omega=1e-3 / YEAR, backend="array")


@pytest.mark.parametrize("units", UNITS[:2])
@pytest.mark.parametrize("well", ["((u/a)**2 - 1)**2/4", "(1 - cos(u/a))", "cos(u/a)", "(u/a - 2)**2/2"])
def test_states_of_lattices(well, units):
    def drawn(a, b, c):
        lattice = HamiltonianSystem.lattice(
            shape=6,
            onsite=f"E*{well}",
            bond="E*(r/a)**2/2",
            kinetic="E*(p/b)**2/2",
            params={"a": a, "b": b, "E": a * b / c},
            domain=sympflow.LatticeStates(0.1 * a * b / c),
            fields="u",
        )
        return lattice.domain.sample(8, 0) / np.repeat([a, b], 6)

    np.testing.assert_allclose(drawn(*units), drawn(1.0, 1.0, 1.0), atol=1e-6)  # minima are known to √ε of scales


@pytest.mark.parametrize("a", [1e-10, 1.0, 1e11])
def test_identities_of_bodies(a):
    def identity(k):
        V = "(r/a)**-12 - k*(r/a)**-6"
        return fingerprint(HamiltonianSystem.pairs(V, masses=np.ones(3), params={"a": a, "k": k}))

    assert same_system(identity(1.0), identity(1.0))
    assert not same_system(identity(1.0), identity(1.001))
