"""Kicks with a polynomial in q: its monomials, their derivatives, and tables that carry it."""

import numpy as np
import pytest
import sympy as sp
import torch

import sympflow
from sympflow import HamiltonianSystem, SympFlow, systems, train
from sympflow.hamiltonian.monomials import gradient, in_monomials, monomials, value
from sympflow.integrators.splitting import Splitting
from sympflow.kernels.splitting_loops import splitting_loops
from sympflow.schemes import Scheme
from sympflow.training.fits import PrimedFit

pytestmark = pytest.mark.slow

EPS = np.finfo(float).eps
HH, QUARTIC = systems.henon_heiles(), systems.quartic()
MONOMIALS = ((2, 0), (1, 1), (0, 3), (2, 3))


@pytest.mark.parametrize(
    ("H", "degree", "expected"),
    [
        # as even as a potential that is no polynomial
        ("cos(q1) + q2", 2, {(0, 1), (0, 2), (2, 0)}),
        ("cos(q1)*cos(q2)", 3, {(0, 2), (2, 0)}),
        # those that commutators make
        ("q1**4 + q2**4 + q1**2", 6, {(2, 0), (4, 0), (0, 4), (6, 0), (0, 6)}),  # the coordinates do not mix
        ("q1**2*q2 - q2**3", 3, {(0, 3), (2, 1)}),
        ("q1**2*q2 - q2**3", 4, {(0, 3), (2, 1), (0, 4), (2, 2), (4, 0)}),
        ("q1**4 + q1*q2**3", 4, {(4, 0), (1, 3)}),
        ("3*q1 + q2**2", 4, {(1, 0), (0, 2)}),  # a constant, the product of the gradients of q1, is no monomial
        # ∇fᵀM⁻¹∇g of q1² and q2² is 4 (M⁻¹)₁₂ q1 q2
        ("q1**2 + 2*q2**2", 2, {(2, 0), (0, 2)}),
        ("p1**2 + p2**2 + p1*p2/3 + q1**2 + 2*q2**2", 2, {(2, 0), (0, 2), (1, 1)}),
    ],
)
def test_monomials_are_those_that_are_needed(H, degree, expected):
    whole = HamiltonianSystem.from_sympy(H) if "p1" in H else HamiltonianSystem.from_sympy(f"(p1**2 + p2**2)/2 + {H}")
    assert set(monomials(whole.symbols, degree)) == expected


@pytest.mark.parametrize("system", [HH, QUARTIC], ids=["henon_heiles", "quartic"])
def test_monomials_hold_what_the_formula_of_baker_campbell_and_hausdorff_has(system):
    """The force gradient, the curvature, and the next products of gradients."""
    symbols = system.symbols
    q, V = symbols.q, symbols.V

    def product(f, g):
        return sp.expand(sum(sp.diff(f, x) * sp.diff(g, x) for x in q))

    second = product(V, V)
    third = product(V, second)
    for f in (V, second, third, product(second, second), product(V, third)):
        degree = sp.Poly(f, *q).total_degree()
        assert in_monomials(f, symbols, monomials(symbols, degree)) is not None


@pytest.mark.parametrize(
    ("system", "message"),
    [
        (QUARTIC, "`polynomial` 1 leaves no monomial that suits V: take a higher degree"),
        (HamiltonianSystem(lambda q: (q**2).sum(-1) / 2, ndof=1), r"^`polynomial` is for symbolic systems"),
    ],
)
def test_systems_without_monomials_are_refused(system, message):
    with pytest.raises(ValueError, match=message):
        SympFlow.primed(system, 2, polynomial=1)


def test_the_force_gradient_of_a_polynomial_is_one():
    q = np.random.default_rng(0).normal(size=(5, 2))
    symbols, of_kicks = QUARTIC.symbols, monomials(QUARTIC.symbols, 6)
    e = in_monomials(symbols.force_gradient, symbols, of_kicks)
    expected = -(QUARTIC.force(q) ** 2).sum(-1) / 2
    np.testing.assert_allclose(value(of_kicks, e, q), expected, rtol=64 * EPS)
    assert in_monomials(symbols.force_gradient, symbols, monomials(symbols, 4)) is None
    assert in_monomials(sp.cos(symbols.q[0]), symbols, of_kicks) is None


@pytest.mark.parametrize("each", [False, True], ids=["one polynomial", "one for each state"])
def test_values_and_gradients(each):
    """Derivatives of torch by its own differentiation; NumPy gives the same."""
    rng = np.random.default_rng(1)
    q, c = rng.normal(size=(6, 2)), rng.normal(size=(6, 4) if each else 4)
    x, t = torch.tensor(q, requires_grad=True), torch.tensor(c)
    written = sum(t[..., m] * x[:, 0] ** a * x[:, 1] ** b for m, (a, b) in enumerate(MONOMIALS))
    (slope,) = torch.autograd.grad(written.sum(), x)
    for numbers, at in ((c, q), (t, torch.tensor(q))):
        np.testing.assert_allclose(np.asarray(value(MONOMIALS, numbers, at)), written.detach(), rtol=1e-13, atol=1e-14)
        np.testing.assert_allclose(np.asarray(gradient(MONOMIALS, numbers, at)), slope, rtol=1e-13, atol=1e-14)


def scheme(seed=0, last=0.3):
    e = 0.1 * np.random.default_rng(seed).normal(size=(2, len(MONOMIALS)))
    stages = (tuple(e[0]), tuple(e[1]), tuple(e[0]))
    return Scheme("s", None, (0.3, 0.4, last), (0.5, 0.5, 0.0), (0.0,) * 3, "a test", True, (), stages, MONOMIALS)


@pytest.mark.parametrize("compensated", [False, True])
@pytest.mark.parametrize("last", [0.3, 0.2])
def test_compiled_runs_are_the_steps_of_arrays(last, compensated):
    table = scheme(last=last)

    class Stepper(Splitting):
        name, scheme = "s", table

    loops, stepper, y = splitting_loops(HH), Stepper(), HH.domain.sample(11, 0)
    expected = [y]
    for _ in range(3):
        expected.append(stepper.step(HH, 0.0, expected[-1], 0.2))
    save = np.array([0, 1, 3])
    expected = np.stack([expected[n] for n in save], axis=1)
    many = loops.kernel(table, compensated).run(0.2, y, 3, save).states
    one = loops.kernel(table, compensated).run(0.2, y[4], 3, save).states
    np.testing.assert_allclose(many, expected, atol=16 * EPS)
    np.testing.assert_allclose(one, expected[4], atol=16 * EPS)
    h = np.linspace(-0.2, 0.3, 11)
    there = loops.kernel(table).step(h, y).states
    np.testing.assert_allclose(there, stepper.step(HH, 0.0, y, h), atol=16 * EPS)
    np.testing.assert_allclose(loops.kernel(table.inverse()).step(h, there).states, y, atol=16 * EPS)
    np.testing.assert_allclose(stepper.inverse(HH, 0.0, there, h), y, atol=16 * EPS)
    assert table.symmetric == (last == 0.3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"monomials": MONOMIALS[:3]}, "`polynomials` must have 3 coefficients per stage"),
        ({"polynomials": ((0.0,) * 4,)}, "`polynomials` must have 4 coefficients per stage"),
        ({"gradients": (0.1, 0.0, 0.0)}, "`polynomials` stand in place of `gradients`"),
    ],
)
def test_tables_that_do_not_fit_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Scheme(**(vars(scheme()) | changes))


def test_a_rung_takes_over_the_force_gradients():
    """The search begins at the table without a polynomial, where one holds ½|∇V|², and comes nearer than that."""
    options = {"restarts": 1, "points": 60, "label_times": 2, "reference_states": 50}
    before = train(QUARTIC, flow=SympFlow.primed(QUARTIC, 3, dt=0.5, processor=2), **{**options, "restarts": 3})
    start, after = PrimedFit(0.5, stages=3, processor=2, polynomial=6).flow(QUARTIC, earlier=before), {}
    flow = train(QUARTIC, flow=start, steps=1, callback=lambda n, figures: after.update(figures), **options)
    assert flow.monomials == monomials(QUARTIC.symbols, 6)
    assert after["one_step_error"] < before.figures["one_step_error"]
    assert flow.kernel_scheme().symmetric
    sol = sympflow.solve(QUARTIC, flow, (0.0, 3.3), QUARTIC.domain.sample(4, 1))
    assert sol.stats["backend"] == "compiled"
    assert sympflow.symplecticity_defect(sol).max() < 1e-12
