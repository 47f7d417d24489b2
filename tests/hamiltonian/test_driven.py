"""Driven systems, H(t, q, p): their functions, samples of functions of t, drifts of T(p, t), what is refused."""

import pickle

import numpy as np
import pytest
import torch
from conftest import refusals
from numba import njit
from scipy.interpolate import CubicSpline, make_interp_spline

import sympflow
from sympflow import HamiltonianSystem, solve
from sympflow.hamiltonian.fingerprint import same_system
from sympflow.testing.checks import CHECKS

made = HamiltonianSystem.from_sympy

W = 1.7
PERIOD = 2 * np.pi / W
TEXT = "p**2/2 - cos(q)*(1 + a*cos(w*t))"
DRIVEN = made(
    TEXT, time="t", params={"a": 0.3, "w": W}, period=PERIOD, y0=[1, 0], t_span=(0, 10), name="driven_pendulum"
)
Y, T = np.array([[0.3, 0.2], [0.5, -0.1]]), np.array([0.3, 4.1])


def potential(t, q):
    return -torch.cos(q[..., 0]) * (1 + 0.3 * torch.cos(W * t))


def potential_of_arrays(t, q):
    return -np.cos(q[..., 0]) * (1 + 0.3 * np.cos(W * t))


@njit
def numba_potential(t, q):
    return -np.cos(q[0]) * (1 + 0.3 * np.cos(W * t))


@njit
def numba_gradient(t, q, out):
    out[0] = np.sin(q[0]) * (1 + 0.3 * np.cos(W * t))


@njit
def numba_product(t, q, v, out):
    out[0] = np.cos(q[0]) * (1 + 0.3 * np.cos(W * t)) * v[0]


SAME = {
    "torch": HamiltonianSystem(potential, ndof=1, time=True, period=PERIOD),
    "torch, H": HamiltonianSystem(
        hamiltonian=lambda t, q, p: p[..., 0] ** 2 / 2 + potential(t, q), ndof=1, time=True, period=PERIOD
    ),
    "arrays": HamiltonianSystem(
        potential_of_arrays,
        gradient=lambda t, q: np.sin(q) * (1 + 0.3 * np.cos(W * t)),
        hessian_vector=lambda t, q, v: np.cos(q) * (1 + 0.3 * np.cos(W * t)) * v,
        ndof=1,
        time=True,
    ),
    "numba": HamiltonianSystem(
        numba_potential, gradient=numba_gradient, hessian_vector=numba_product, ndof=1, time=True, period=PERIOD
    ),
    "another name of t": made(TEXT.replace("t)", "tau)"), time="tau", params={"a": 0.3, "w": W}),
}


@pytest.mark.parametrize("name", SAME)
@pytest.mark.parametrize("times", [0.3, T])
def test_functions_take_the_time_after_the_state(name, times):
    system = SAME[name]
    for function in ("hamiltonian", "gradient", "hessian", "vector_field", "field_jacobian", "time_derivative"):
        expected = getattr(DRIVEN, function)(Y, times)
        np.testing.assert_allclose(getattr(system, function)(Y, times), expected, rtol=1e-11, atol=1e-13)
        if name != "arrays":
            found = getattr(system, function)(torch.tensor(Y), times)
            np.testing.assert_allclose(found.detach(), expected, rtol=1e-11, atol=1e-13)
    assert not system.autonomous
    assert same_system(system.fingerprint, DRIVEN.fingerprint)
    system.check_functions(Y)


def test_derivatives_are_those_of_h_at_each_time():
    h = 1e-6
    for t in T:
        slopes = [(DRIVEN.hamiltonian(Y + h * e, t) - DRIVEN.hamiltonian(Y - h * e, t)) / (2 * h) for e in np.eye(2)]
        np.testing.assert_allclose(DRIVEN.gradient(Y, t), np.stack(slopes, -1), atol=1e-9)
        slope = (DRIVEN.hamiltonian(Y, t + h) - DRIVEN.hamiltonian(Y, t - h)) / (2 * h)
        np.testing.assert_allclose(DRIVEN.time_derivative(Y, t), slope, atol=1e-9)
    np.testing.assert_array_equal(DRIVEN(0.3, Y[0]), DRIVEN.vector_field(Y[0], 0.3))
    single = DRIVEN.hamiltonian(torch.tensor(Y, dtype=torch.float32), 1e4)  # the phase is that of a double
    np.testing.assert_allclose(single, DRIVEN.hamiltonian(Y, 1e4), rtol=1e-6)
    assert DRIVEN.hamiltonian(Y.astype(np.float32), 1e4).dtype == np.float32


TIMES = np.linspace(0, 10, 81)
SPLINES = {
    "cubic": CubicSpline(TIMES, np.cos(W * TIMES)),
    "b-spline": make_interp_spline(TIMES, np.cos(W * TIMES), k=5),
    "periodic": CubicSpline(np.linspace(0, PERIOD, 61), np.cos(np.linspace(0, 2 * np.pi, 61)), bc_type="periodic"),
    "periodic b-spline": make_interp_spline(
        np.linspace(0, PERIOD, 61), np.cos(np.linspace(0, 2 * np.pi, 61)), bc_type="periodic"
    ),
}


@pytest.mark.parametrize("kind", SPLINES)
def test_a_parameter_may_be_a_function_of_t_by_its_samples(kind):
    spline = SPLINES[kind]
    system = made("p**2/2 - cos(q)*(1 + 0.3*a)", params={"a": spline}, y0=[1, 0], t_span=(0, 9))
    t = np.array([1.3, 8.7])
    expected = Y[:, 1] ** 2 / 2 - np.cos(Y[:, 0]) * (1 + 0.3 * spline(t))
    np.testing.assert_allclose(system.hamiltonian(Y, t), expected, rtol=1e-14)
    np.testing.assert_allclose(system.hamiltonian(torch.tensor(Y), t), expected, rtol=1e-14)
    rate = -0.3 * np.cos(Y[:, 0]) * spline(t, 1)
    np.testing.assert_allclose(system.time_derivative(Y, t), rate, rtol=1e-12)
    copy = pickle.loads(pickle.dumps(system))
    assert copy.expression == system.expression
    assert copy.fingerprint == system.fingerprint
    assert "samples" in repr(system)
    sol = solve(system, "rk45", (0, 9), rtol=1e-10, atol=1e-10)
    assert np.abs(sol.y[:, -1] - solve(DRIVEN, "rk45", (0, 9), rtol=1e-10, atol=1e-10).y[:, -1]).max() < 1e-3
    if "periodic" in kind:
        assert solve(system, "rk45", (0, 30)).success
    else:
        with pytest.raises(ValueError, match=r"^`t_span` \(0, 30\) leaves the samples of the parameter 'a'"):
            solve(system, "rk45", (0, 30))


def test_another_drive_is_another_system():
    splines = SPLINES["cubic"], CubicSpline(TIMES, np.cos(W * TIMES) * (TIMES < 5))
    one, two = (made("p**2/2 - a*cos(q)", params={"a": a}, t_span=(0, 9)) for a in splines)
    assert one.expression != two.expression
    assert not same_system(one.fingerprint, two.fingerprint)
    for w in (1.71, W * (1 + 1e-6)):
        assert not same_system(DRIVEN.fingerprint, made(TEXT, time="t", params={"a": 0.3, "w": w}).fingerprint)


def test_the_drift_of_t_dependent_kinetic_energy_is_its_integral():
    text = "(p1 - A*cos(w*t) - a)**2/2 + (1 + t**2/10)*sqrt(1 + p2**2) - cos(q1)*cos(q2)"
    system = made(text, time="t", params={"A": 0.3, "w": W, "a": SPLINES["periodic"]}, t_span=(0, 9))
    p, s = np.array([0.4, -0.3]), np.array([0.7, -5.0])
    nodes, weights = np.polynomial.legendre.leggauss(400)
    for t, duration in zip(T, s, strict=True):
        u = t + duration * (1 + nodes) / 2
        expected = duration / 2 * (weights @ np.stack([system.velocity(p, x) for x in u]))
        np.testing.assert_allclose(system.drift(p, t, duration), expected, atol=1e-12)
        np.testing.assert_allclose(system.drift(torch.tensor(p), t, duration), expected, atol=1e-12)
        h = 1e-6
        columns = [
            (system.drift(p + h * e, t, duration) - system.drift(p - h * e, t, duration)) / (2 * h) for e in np.eye(2)
        ]
        np.testing.assert_allclose(system.drift_jacobian(p, t, duration), np.stack(columns, -1), atol=1e-8)
    both = system.drift(np.stack([p, p]), T, s)
    np.testing.assert_allclose(both, [system.drift(p, a, b) for a, b in zip(T, s, strict=True)], rtol=1e-14)
    np.testing.assert_array_equal(DRIVEN.drift(p[:1], 0.3, 0.5), 0.5 * p[:1])


SOL = solve(DRIVEN, "rk45", (0, 3), t_eval=np.linspace(0, 3, 40))
SUBLEVEL = sympflow.EnergySublevel(1.0, sympflow.Box([-1, -1], [1, 1]))
AW, SAMPLED = {"a": 1, "w": W}, {"a": SPLINES["cubic"]}
HERE = "^`system` 'driven_pendulum' is driven"


test_bad_input_is_named = refusals(
    (lambda: made("p**2/2 + t*q**2"), TypeError, '^`expression` depends on the time.*time="t"'),
    (lambda: made("p**2/2 + q**2", time="t"), "^`time` is 't', which H does not"),
    (lambda: made("p**2/2 + q**2", time="q1"), "^`time` 'q1' is a coordinate"),
    (lambda: made("p**2/2 + q**2", time="2t"), "^`time` '2t' is not the name of a symbol"),
    (lambda: made("p**2/2 + a*q**2", params=AW, time="a"), "^`time` 'a' is a"),
    (lambda: made("p**2/2 + t*q**2", time=1), TypeError, "^`time` must be the name"),
    (lambda: made("p**2/2 + q**2", period=1), TypeError, "^`period` only goes with `time`"),
    (lambda: made(TEXT, time="t", params=AW, period=3.7), "^`period` 3.7 is not a period"),
    (lambda: made(TEXT, time="t", params=AW, period=-1), "^`period` must be"),
    (lambda: made("p**2/2 + q**2", params=SAMPLED), "^`params` has 'a'"),
    (
        lambda: made("p**2/2 + a*q", params={"a": CubicSpline([0, 1], [[0, 1], [1, 2]])}),
        "^`params` has a, a spline that is not of real numbers",
    ),
    (
        lambda: HamiltonianSystem(lambda q: q[..., 0], ndof=1, time=True),
        TypeError,
        r"^`potential` is called with \(t, q\), the time first",
    ),
    (lambda: HamiltonianSystem(potential, ndof=1, time="t"), TypeError, "^`time` must be True"),
    (lambda: DRIVEN.hamiltonian(Y), TypeError, "^`t` is missing"),
    (lambda: DRIVEN.force(Y[:, :1]), TypeError, "^`t` is missing"),
    (lambda: DRIVEN.hamiltonian(Y, 1j), TypeError, "^`t` must be a real number"),
    (lambda: DRIVEN.hamiltonian(Y, np.zeros(3)), "^`t` must be a number, or have the shape"),
    (
        lambda: made("sqrt(1 + (p - cos(t))**2) + q", time="t").drift(Y[:, :1], 0.0, 0.1),
        "^`system` has a kinetic energy .* not elementary",
    ),
    (lambda: sympflow.time_transformed(DRIVEN), HERE),
    (lambda: solve(DRIVEN, "log_kahan_li8"), HERE),
    (lambda: solve(DRIVEN, "linear_srkn6b"), "do not depend on t"),
    (lambda: solve(DRIVEN, "mlp"), HERE),
    (lambda: sympflow.energy_error(SOL), "energy_balance_error"),
    (lambda: sympflow.max_energy_error(SOL), "energy_balance_error"),
    (lambda: sympflow.energy_drift(SOL), "energy_balance_error"),
    (lambda: sympflow.stability(DRIVEN), "is driven"),
    (lambda: sympflow.compare(DRIVEN, ["rk45"], match="energy_error"), "is driven.*'balance'"),
    (lambda: sympflow.compare(DRIVEN, ["rk45"], ["energy"]), "is driven"),
    (lambda: made(TEXT, time="t", params=AW, domain=SUBLEVEL), "is driven"),
)


def test_a_gradient_that_is_right_at_its_first_time_alone_is_found():
    wrong = HamiltonianSystem(
        potential_of_arrays, gradient=lambda t, q: 1.3 * np.sin(q), ndof=1, time=True, y0=[1, 0], t_span=(0, 10)
    )
    with pytest.raises(ValueError, match=r"^`gradient` is not that of `potential`: at t = 1\.327, q = "):
        solve(wrong, "rk45", (0, 1))


class FirstOrder(sympflow.integrators.base.FixedStep):
    """Symplectic Euler that leaves the time out, and does not say that it takes it."""

    name, order, symplectic = "forgets_t", 1, True

    def step(self, system, t, y, h):
        return y + h * system.vector_field(y)


class Pretender(FirstOrder):
    """One that says that it takes the time, and leaves it out."""

    takes_driving = True

    def step(self, system, t, y, h):
        return y + h * system.vector_field(y, 0.0)


def test_a_method_that_says_nothing_of_the_time_is_refused_and_one_that_lies_is_caught():
    with pytest.raises(ValueError, match="'forgets_t' does not take the time into account"):
        solve(DRIVEN, FirstOrder)
    check = {check.name: check for check in CHECKS}["the_drive_is_in_the_steps"]
    with pytest.raises(AssertionError, match="do not say `takes_driving`"):
        check(Pretender(dt=0.001))
    check(sympflow.get("rk4")())


def test_order_of_steps_and_their_jacobians():
    method = sympflow.get("rk4")()
    ends = [solve(DRIVEN, "rk4", (0.4, 3.6), dt=h, t_eval=[3.6]).y[:, -1] for h in (0.2, 0.1, 0.05)]
    slope = np.log2(np.abs(ends[0] - ends[1]).max() / np.abs(ends[1] - ends[2]).max())
    assert 3.6 < slope < 4.6
    h = np.array([0.1, -0.2])
    end, A = method.tangent(DRIVEN, T, Y, h)
    np.testing.assert_allclose(end, method.step(DRIVEN, T, Y, h), rtol=1e-15)
    e = 1e-6
    columns = [
        (method.step(DRIVEN, T, Y + e * v, h) - method.step(DRIVEN, T, Y - e * v, h)) / (2 * e) for v in np.eye(2)
    ]
    np.testing.assert_allclose(A, np.stack(columns, -1), atol=1e-9)
    sol = solve(DRIVEN, "dop853", (0, 5), rtol=1e-11, atol=1e-11)
    assert sympflow.symplecticity_defect(sol) < 1e-8
    assert abs(sympflow.volume_error(sol)) < 1e-8
    assert sympflow.reference_error(sol).max() < 1e-9
    assert sympflow.time_reversal_error(sol) < 1e-8
