"""Runs over places at which H is infinite or NaN, and runs near them."""

import re
import warnings

import numpy as np
import pytest
import sympy as sp
from watchdog import watched

import sympflow as sf
from sympflow import HamiltonianSystem

CROSSED = {
    "-1/Abs(q)": ([1.0, 0.0], 0.01, 2.0),
    "1/q": ([1.0, -5.0], 0.3, 1.0),
    "4*(q**-12 - q**-6)": ([3.0, -20.0], 0.3, 1.0),
    "log(q)": ([1.0, 0.0], 0.03, 2.0),
    "log(q**2)": ([1.0, 0.0], 0.03, 2.0),
    "csch(q)**2": ([1.0, -30.0], 0.1, 1.0),
    "coth(q)": ([1.0, -30.0], 0.1, 1.0),
    "atanh(q/10)": ([9.0, 8.0], 0.1, 1.0),
    "1/(1 - cos(q))": ([1.0, -30.0], 0.1, 0.3),
    "1/(1 + sin(q))/1e6": ([1.0, -30.0], 0.1, 0.3),
    "1/(q**2 - 1)": ([2.0, -40.0], 0.1, 0.3),
    "tan(q)": ([0.0, 30.0], 0.2, 0.4),
    "1/(exp(q) - 1 - q)": ([1.0, -30.0], 0.1, 0.3),
    "exp(-1/q)": ([1.0, -1.0], 0.1, 2.0),
    "q**2/2 + 1e-9/q**2": ([1.0, 0.0], 0.07, 2.0),
}
"""V, a start, a step, and an end, in which the step leaps over a pole."""

SILENT = {
    "1/(1 + q**2)": [3.0, -2.0],
    "sqrt(q**2 + 1e-20)": [1.0, 0.3],
    "log(1 + q**2)": [1.0, 0.0],
    "sin(q)/q": [1.0, -3.0],
    "(cosh(q) - 1)/q**2": [1.0, -3.0],
    "Abs(q)": [1.0, 0.0],
    "Abs(q)**1.5": [1.0, 0.0],
    "-q*cot(q)": [0.5, -1.5],
    "4*(q**-12 - q**-6)": [1.5, 0.0],
    "exp(-1/q**2)": [1.0, -3.0],
    "cbrt(q**2)": [1.0, -3.0],
    "q**1.5": [0.0, 5.0],
    "Max(q - 1, 0)**2.5": [0.0, 0.5],
    "Abs(q)**2.5": [0.0, 0.5],
    "Piecewise((q**2*log(q), q > 0), (0, True))": [1.0, -3.0],
    "Piecewise((0, q <= 0), (q**2.5, True))": [1.0, -3.0],
}
"""V that are finite along a run, of which some divisors vanish."""


def solved(*arguments, **options):
    """A solution, and the warnings of poles."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sol = sf.solve(*arguments, **options)
    return sol, [str(w.message) for w in caught if "infinite" in str(w.message)]


def in_units(V, s):
    """½p² + V(q) with q in units of s, and p in those of 1/s."""
    return HamiltonianSystem.from_sympy(
        f"p**2*s**2/2 + {V.replace('q', '(q/s)').replace('s(q/s)rt', 'sqrt')}", params={"s": s}
    )


@pytest.mark.parametrize("V", CROSSED)
def test_a_run_over_a_pole_ends_before_it(V):
    (y0, dt, t1), system = CROSSED[V], HamiltonianSystem.from_sympy(f"p**2/2 + {V}")
    sol, _ = solved(system, "verlet", (0, t1), y0, dt=dt)
    last, _ = solved(system, "verlet", (0, t1), y0, dt=dt, t_eval=[t1])
    assert sol.status == last.status == -1
    assert "where H is infinite or NaN: no solution does. Reduce `dt`" in sol.message
    assert sol.stats["failed_at"] == pytest.approx(last.stats["failed_at"])
    assert sol.t[-1] == sol.stats["failed_at"]
    assert last.t.size == 0


def of_functions(V):
    """The same as a function of arrays."""
    potential = sp.lambdify("q", sp.sympify(V), "numpy")
    return HamiltonianSystem(lambda q: potential(q[..., 0]), ndof=1)


@pytest.mark.parametrize("V", [pytest.param(V, marks=pytest.mark.slow if i % 2 else ()) for i, V in enumerate(CROSSED)])
def test_a_run_of_functions_ends_there_too(V):
    y0, dt, t1 = CROSSED[V]
    sols = [solved(f, "verlet", (0, t1), y0, dt=dt)[0] for f in (of_functions(V), in_units(V, 1.0))]
    assert sols[0].status == -1
    assert sols[0].stats["failed_at"] == sols[1].stats["failed_at"]


@pytest.mark.parametrize("V", [V for V in SILENT if V not in ("-q*cot(q)", "cbrt(q**2)")])
def test_a_run_of_functions_over_none_is_left_alone(V):
    sol, told = solved(of_functions(V), "verlet", (0, 3), SILENT[V], dt=0.03)
    assert sol.success
    assert not told


@pytest.mark.parametrize(
    "V", ["tan(sinh(2 - 1/q))", "exp(-exp(1/q))*log(q)**2", "sin(exp(exp(q**-2)))", "sech(exp(q**-2))"]
)
def test_functions_of_numbers_beyond_all_others_are_judged_at_once(V):
    system = HamiltonianSystem.from_sympy(f"p**2/2 + {V}")
    with watched(30):
        assert sf.solve(system, "verlet", (0, 0.03), [2.6, 0.1], dt=0.01).success


@pytest.mark.parametrize("V", SILENT)
@pytest.mark.parametrize("method", ["verlet", "rk4", "rk45"])
def test_a_run_over_none_is_left_alone(V, method):
    sol, told = solved(
        HamiltonianSystem.from_sympy(f"p**2/2 + {V}"),
        method,
        (0, 3),
        SILENT[V],
        **{} if method == "rk45" else {"dt": 0.03},
    )
    assert sol.success
    assert not told


@pytest.mark.parametrize("s", [1e-10, 1e10])
@pytest.mark.parametrize("V", ["-1/Abs(q)", "1/(q**2 - 1)", "log(q)", "1/(1 - cos(q))"])
def test_the_verdict_does_not_depend_on_units(V, s):
    (q, p), dt, t1 = CROSSED[V]
    one = sf.solve(in_units(V, 1.0), "verlet", (0, t1), [q, p], dt=dt)
    other = sf.solve(in_units(V, s), "verlet", (0, t1), [q * s, p / s], dt=dt)
    assert one.status == other.status == -1
    assert one.stats["failed_at"] == other.stats["failed_at"]


@pytest.mark.parametrize("s", [1e-10, 1.0, 1e10])
def test_a_centre_that_is_passed_nearly_head_on_is_warned_of(s):
    kepler = HamiltonianSystem.from_sympy("(p1**2 + p2**2)*s**2/2 - s/sqrt(q1**2 + q2**2)", params={"s": s})
    _, told = solved(kepler, "verlet", (0, 3), [s, 0, 0, 0.05 / s], dt=0.01)
    assert len(told) == 1
    assert "q1**2 + q2**2 = 0" in told[0]
    _, told = solved(kepler, "verlet", (0, 20), [1.9 * s, 0, 0, np.sqrt(0.1 / 1.9) / s], dt=0.01)
    assert not told


@pytest.mark.parametrize("method", ["tao2", "leapfrog", "rk4", "rk45", "gauss_legendre4", "kahan_li8"])
def test_every_method_is_looked_after(method):
    system = HamiltonianSystem.from_sympy("p**2/2 + 1/q", y0=[1, 0])
    adaptive = method == "rk45"
    sol, told = solved(
        system, method, (0, 0.5), [1.0, -30.0], **{"rtol": 1.0, "atol": 1e3} if adaptive else {"dt": 0.5}
    )
    assert sol.status == -1 or told
    assert "Reduce `rtol` and `atol`" in sol.message if adaptive else "Reduce `dt`" in sol.message + "".join(told)


def test_of_a_batch_the_trajectories_that_pass_a_pole_end():
    system = HamiltonianSystem.from_sympy("p**2/2 - 1/Abs(q)")
    y0 = np.array([[1.0, 0.0], [1.0, 2.0], [-1.0, 0.0], [4.0, 0.0]])
    sol = sf.solve(system, "verlet", (0, 1.3), y0, dt=0.01)
    np.testing.assert_array_equal(sol.status, [-1, 0, -1, 0])
    np.testing.assert_allclose(sol.stats["failed_at"], [1.11, np.nan, 1.11, np.nan])
    for row in range(4):
        np.testing.assert_array_equal(np.isfinite(sol.y[row]).all(0), sol.t <= (1.111 if row in (0, 2) else 2))
    assert "trajectory 0, the first of 2," in sol.message
    np.testing.assert_allclose(sol.stats["blow_up_time"][0], np.pi / 2**1.5)


@pytest.mark.parametrize(
    ("H", "options", "span"),
    [
        ("p**2/2 - 1/Abs(q)", {}, (0, -2)),
        ("p**2/2 - 1/Abs(q)", {"damping": 0.1}, (0, 2)),
        ("p**2/2 - 1/Abs(q) + q*cos(t)/10", {"time": "t"}, (0, 2)),
        ("p**2/2 + q/(t - 1)", {"time": "t"}, (0, 2)),
        ("p**2/2 - 1/Abs(q)", {}, (5, 7)),
    ],
)
def test_backwards_damped_and_driven(H, options, span):
    sol, _ = solved(HamiltonianSystem.from_sympy(H, **options), "verlet", span, [1.0, 0.0], dt=0.03, t_eval=[span[1]])
    assert sol.status == -1
    assert "where H is infinite" in sol.message


def test_where_the_way_over_a_divisor_of_zero_is_finite_a_run_goes_on():
    pendulum = HamiltonianSystem.from_sympy("p1**2/2 + p2**2/(2*sin(q1)**2) - cos(q1)")
    sol, told = solved(pendulum, "gauss_legendre4", (0, 20), [1.0, 0, 0, 0], dt=0.05)
    assert sol.success
    assert not told
    assert np.sign(sol.y[0]).min() == -1
    assert sf.solve(pendulum, "gauss_legendre4", (0, 1), [1.0, 0, -20, 1e-3], dt=0.2).status == -1


def test_two_bodies_on_a_line_do_not_pass_each_other():
    system = HamiltonianSystem.from_sympy("(p1**2 + p2**2)/2 + 1/(q1 - q2)**2")
    sol = sf.solve(system, "verlet", (0, 1), [-1, 1, 30, -20], dt=0.1)
    assert sol.status == -1
    assert "passed q1 - q2 = 0" in sol.message


@pytest.mark.parametrize(
    ("dim", "V", "speed"),
    [(1, "1/r", 30.0), (2, "-m1*m2/r", 30.0), (3, "1/r**12 - 1/r**6", 30.0), (2, "-1/r", 0.0), (3, "1/r", 30.0)],
)
def test_two_bodies_in_space_do_not_pass_each_other(dim, V, speed):
    """Head-on, along a line of any direction; and beside each other they may."""
    u, across = np.array([[3.0, 1.0, -2.0], [1.0, -3.0, 0.0]])[:, :dim] / np.sqrt([9.0, 10.0, 14.0][dim - 1])
    system = HamiltonianSystem.pairs(V, masses=[1.0, 2.0], dim=dim)
    y0 = np.concatenate([-2 * u, 2 * u, speed * u, -speed * u])
    sol = sf.solve(system, "verlet", (0, 8 if speed == 0 else 1), y0, dt=0.1)
    assert sol.status == -1
    assert "passed r = 0 of two bodies" in sol.message
    if dim > 1 and speed:
        along_an_axis = np.outer([-2, 2, speed, -speed], np.eye(dim)[0]).ravel()
        assert sf.solve(system, "verlet", (0, 1), along_an_axis, dt=0.1, dtype="float32").status == -1
        y0[:dim] += across
        assert sf.solve(system, "verlet", (0, 1), y0, dt=0.001).success


@pytest.mark.parametrize("backend", ["array", "compiled"])
@pytest.mark.parametrize("method", ["verlet", "chin4a", "gauss_legendre4"])
def test_where_no_piece_holds_there_is_no_force(method, backend):
    system = HamiltonianSystem.from_sympy("p**2/2 + Piecewise((q**2, q < 1))")
    sol = sf.solve(system, method, (0, 2), [0.5, 2.0], dt=0.1, backend=backend)
    assert sol.status == -1
    assert sol.y[0].max() < 1.2


def test_a_start_without_h_is_told():
    system = HamiltonianSystem.from_sympy("p**2/2 + log(q)")
    sol = sf.solve(system, "verlet", (0, 1), [[1.0, 0.0], [-1.0, 0.0]], dt=0.03)
    np.testing.assert_array_equal(sol.status, [0, -1])
    assert sol.message == "H of trajectory 1 is infinite, or NaN, at `y0`: start elsewhere."
    assert sf.solve(system, "verlet", (0, 1), [-1.0, 0.0], dt=0.03, diagnose=False).success


@pytest.mark.parametrize("V", ["csch(q) - 1/q", "(exp(q) - 1 - q)/q**2", "tan(q)/q", "exp(-1/q**2)"])
def test_a_place_where_only_parts_of_H_are_infinite_is_passed_without_a_word(V):
    """Also from there, where the formula as it is written is 0/0."""
    system = HamiltonianSystem.from_sympy(f"p**2/2 + {V}")
    for y0 in [1.0, -2.0], *([[0.0, 0.1]] * (not V.startswith("exp(-1"))):
        sol = sf.solve(system, "srkn11b", (0, 0.8), y0, dt=0.01)
        assert sol.success
        assert np.ptp(sol.energy()) < 0.01**5


@pytest.mark.parametrize("method", ["verlet", "gauss_legendre4"])
@pytest.mark.parametrize(
    "params", [{"k": [1.0, 2.0, -3.0]}, {"a": [0.0, -2.0, 3.0]}, {"k": [1.0, 0.0, 2.0], "a": -1.0}]
)
def test_trajectories_with_parameters_of_their_own_are_looked_after(params, method):
    system = HamiltonianSystem.from_sympy("p**2/2 - k/Abs(q - a)", params={"k": 1.0, "a": 0.0})
    params = {name: np.array(value) for name, value in params.items()}
    sol, _ = solved(system, method, (0, 6), [1.0, 0.0], params=params, dt=0.07)
    each = []
    for i in range(3):
        own = system.with_params(**{name: np.broadcast_to(x, 3)[i].item() for name, x in params.items()})
        each.append(solved(own, method, (0, 6), [1.0, 0.0], dt=0.07))
    np.testing.assert_array_equal(sol.status, [one.status for one, _ in each])
    assert -1 in sol.status
    if any("passed q1" in one.message for one, _ in each[:1]):
        assert "passed q1" in sol.message


def test_a_warning_of_a_leap_names_the_parameters():
    system = HamiltonianSystem.from_sympy("(p1**2 + p2**2)/2 - k/sqrt(q1**2 + q2**2)", params={"k": 1.0})
    with pytest.warns(RuntimeWarning, match=r"H with k = 1 changed permanently between t = 1\.1 and 1\.11"):
        sf.solve(system, "verlet", (0, 3), [1, 0, 0, 0.05], dt=0.01, params={"k": np.array([-3.0, 1.0])})


BATCH = [[1.0, 0.0], [5.0, 3.0], [2.0, 0.0]]


@pytest.mark.parametrize(
    ("y0", "more"),
    [(BATCH[0], {}), (BATCH[1], {"save_every": 20}), (BATCH, {"save_every": 20}), (BATCH, {"t_eval": [0.5, 1.0, 6.0]})],
)
def test_stored_runs_are_looked_after(tmp_path, y0, more):
    system = HamiltonianSystem.from_sympy("p**2/2 - 1/Abs(q)")
    kept = sf.solve(system, "verlet", (0, 6), y0, dt=0.07, **more)
    for store, spans in {"once": [6], "twice": [0.5, 6], "again": [6, 6]}.items():
        if store == "twice" and "t_eval" in more:
            continue
        for i, t1 in enumerate(spans):
            sol = sf.solve(system, "verlet", (0, t1), y0, dt=0.07, store=tmp_path / store, resume=i > 0, **more)
        np.testing.assert_array_equal(sol.status, kept.status)
        np.testing.assert_array_equal(sol.stats.get("failed_at", np.nan), kept.stats.get("failed_at", np.nan))
        assert ("The contents of the store after that are meaningless" in sol.message) == bool(np.any(kept.status))


COLLISIONS = {
    "rest": ("p**2/2 - 1/Abs(q)", [1.0, 0.0], np.pi / 8**0.5),
    "plane": ("(p1**2 + p2**2)/2 - 1/sqrt(q1**2 + q2**2)", [0.6, 0.8, 0.0, 0.0], np.pi / 8**0.5),
    "two bodies": ("p1**2/2 + p2**2/4 - 2/Abs(q1 - q2)", [0.0, 1.0, 0.3, 0.6], np.pi / 24**0.5),
    "repelled": ("p**2/2 + 1/q**2", [1.0, -3.0], None),
    "past": ("(p1**2 + p2**2)/2 - 1/sqrt(q1**2 + q2**2)", [1.0, 0.0, 0.0, 1e-4], None),
    "ends before": ("p**2/2 - 1/q", [9.0, 0.0], None),
}
"""H, a start, and the time in which it falls into the centre: π/√8 · (r³/GM)^½ from rest at r."""


def time_told(message):
    return float(re.search(r"at about t = ([^,]*),", message)[1])


@pytest.mark.parametrize("s", [1e-9, 1.0, 1e11])
@pytest.mark.parametrize("method", ["log_leapfrog", "log_kahan_li8"])
@pytest.mark.parametrize("name", COLLISIONS)
def test_a_run_that_turns_at_a_collision_is_warned_of(name, method, s):
    H, y0, t = COLLISIONS[name]
    d = len(y0) // 2
    system = HamiltonianSystem.from_sympy(
        re.sub(r"([qp]\d?)\b", lambda x: f"({x[0]}{'/s' if x[0][0] == 'q' else '*s'})", H), params={"s": s}
    )
    start = np.array(y0) * np.repeat([s, 1 / s], d)
    sol, told = solved(system, method, (0, 3), start, dt=0.01)
    assert sol.success
    assert [time_told(each) for each in told] == ([] if t is None else [pytest.approx(t, rel=1e-6)])


def test_a_planet_that_falls_into_its_star_is_told():
    r, v = 1.0, 0.25  # mass 1 and G = 1: a = 1/(2/r − v²), and the way inward of a radial orbit that begins outward
    system = HamiltonianSystem.planets([1.0, 1e-9], y0=[0, 0, 0, r, 0, 0, 0, 0, 0, 1e-9 * v, 0, 0], G=1.0)
    a = 1 / (2 / r - v * v)
    u = np.arccos(1 - r / a)  # r = a(1 − cos u)
    t = a**1.5 * (2 * np.pi - (u - np.sin(u)))
    sol, [told] = solved(system, "wisdom_holman", (0, 5), dt=0.05)
    assert sol.success
    assert time_told(told) == pytest.approx(t, rel=1e-6)
