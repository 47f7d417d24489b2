"""`discover`: the true terms and no other, with errors that are those of the coefficients; and honest refusals."""

import numpy as np
import pytest
import sympy as sp

import sympflow
from sympflow.learning.library import Library, coordinates, library_for, polynomials
from sympflow.systems import damped_pendulum, pendulum

t = np.linspace(0, 5, 31)
(q,), (p,) = coordinates(1)


def measured(system, sigma, n=6, seed=0):
    starts = pendulum().domain.sample(n, seed)
    sol = sympflow.solve(system, "kahan_li8" if system.conservative else "srkn11b", (0, 5), starts, t_eval=t, dt=0.05)
    return t, sol.y + sigma * np.random.default_rng(seed).normal(size=sol.y.shape)


@pytest.fixture(scope="module")
def found():
    return sympflow.discover(measured(pendulum(), 0.01))


def test_the_true_terms_and_no_other(found):
    record = found.discovery
    assert set(record.terms) == {sp.cos(q), p**2}
    truth = {sp.cos(q): -1.0, p**2: 0.5}
    for f, c, error in zip(record.terms, record.coefficients, record.errors, strict=True):
        assert abs(c - truth[f]) < min(5 * error, 0.01 * abs(truth[f]))
    np.testing.assert_allclose(record.noise, 0.01, rtol=0.15)
    assert record.explains
    assert not record.remark
    assert record.formula().startswith("- 0.9") or record.formula().startswith("- 1.0")


def test_missing_values_irregular_times_and_one_trajectory():
    _, y = measured(pendulum(), 0.01, n=1)
    random = np.random.default_rng(1)
    y[random.random(y.shape) < 0.2] = np.nan
    kept = np.sort(random.permutation(len(t))[:26])
    system = sympflow.discover([(t[kept], y[0][:, kept])], ["p**2", "cos(q)", "q**2", "q**4", "p**4"])
    assert set(system.discovery.terms) == {sp.cos(q), p**2}
    assert all(model.held_out is None for model in system.discovery.path)


def noisy(H, ndof, seed, n=6, sigma=0.01):
    """Trajectories of a symbolic H over a period or so, with noise."""
    random = np.random.default_rng(seed)
    system = sympflow.HamiltonianSystem.from_sympy(H, y0=[0.7] * (2 * ndof))
    times = np.linspace(0, 6, 31)
    starts = random.uniform(-1, 1, (n, 2 * ndof))
    y = np.stack([sympflow.solve(system, "gauss_legendre6", (0, 6), x, t_eval=times, dt=0.05).y for x in starts])
    return times, y + sigma * random.normal(size=y.shape)


@pytest.mark.parametrize(
    ("H", "ndof"),
    [("0.3*q*p", 1), ("q1*p2 - q2*p1", 2), ("(p1**2 + p2**2)/2 + 0.8*(q1*p2 - q2*p1) + 0.32*(q1**2 + q2**2)", 2)],
    ids=["q p", "rotation", "Larmor"],
)
def test_quadratic_forms_of_q_and_p_are_found(H, ndof):
    found = sympflow.discover(noisy(H, ndof, 0), "polynomials", degree=2)
    names = {s.name: s for pair in coordinates(ndof) for s in pair} | ({"q": q, "p": p} if ndof == 1 else {})
    assert set(found.discovery.terms) == set(sp.expand(sp.sympify(H, names)).as_coefficients_dict())
    assert found.discovery.explains


def circles(sigma):
    """Ten orbits of one radius: those of q²/2 + p²/2, of −1/r + p²/2, of q1 p2 − q2 p1."""
    random = np.random.default_rng(0)
    angle = random.uniform(0, 2 * np.pi, 10)[:, None] + t
    y = np.stack([np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)], 1)
    return t, y + sigma * random.normal(size=y.shape)


@pytest.mark.parametrize(
    ("data", "same"),
    [pytest.param(circles(0.0), "p2 - q1, p1 + q2", marks=pytest.mark.slow), (circles(0.01), "p2 - q1, p1 + q2")],
)
def test_what_the_data_do_not_tell_is_said(data, same):
    with pytest.warns(UserWarning, match="The data do not tell H beyond themselves: .* to the noise, ") as said:
        found = sympflow.discover(data, [*polynomials(2, 2), "cos(q1)", "cos(q2/2)"])
    assert same in str(said[-1].message)
    record = found.discovery
    assert not record.explains
    assert record.unseen
    assert Library(record.unseen, 2).values(data[1][0].T).std(axis=0).max() < 0.1
    assert found.domain.contains(data[1][0].T).all()
    assert not found.domain.contains(np.zeros((1, 4))).any() or same.startswith("q1")


def test_friction_and_a_wrong_library_are_told():
    with pytest.warns(UserWarning, match=r"No sparse Hamiltonian .* times the noise. Friction p' = -γp with γ = 0"):
        system = sympflow.discover(measured(damped_pendulum(0.1), 0.01), ["p**2", "cos(q)"])
    assert not system.discovery.explains
    with pytest.warns(UserWarning, match="Terms outside of the library fit much better"):
        sympflow.discover(measured(pendulum(), 0.01), ["p**2", "q**2"])


def test_the_hamiltonian_behind_a_flow():
    flow = next(f for f in sympflow.shipped_flows() if f.name == "pendulum-primed-3-0.4").load(pendulum())
    record = sympflow.discover(flow).discovery
    assert set(record.terms) == {sp.cos(q), p**2}
    np.testing.assert_allclose(sorted(record.coefficients), [-1.0, 0.5], rtol=1e-3)


def test_libraries_leave_out_what_the_data_cannot_tell():
    states = np.random.default_rng(0).uniform(-1, 1, (200, 2))
    library, superfluous = library_for(["q**2", "2*q**2 + 1", "polynomials", "distances"], 1, 2, states)
    assert library.expressions == (q**2, q, p, p * q, p**2)  # r comes near 0, so no power of it is a term
    assert superfluous == (2 * q**2 + 1,)
    four = library_for("polynomials", 4, 4, np.random.default_rng(0).normal(size=(500, 8)))[0]
    (a, b, *_), _ = coordinates(4)
    assert (a - b) ** 4 in four.expressions
    assert a * b not in four.expressions
