"""Kicks with a polynomial in q: its monomials, their derivatives, and tables that carry it."""

import numpy as np
import pytest
import sympy as sp
import torch

from sympflow import systems
from sympflow.hamiltonian.monomials import gradient, in_monomials, monomials, value
from sympflow.integrators.splitting import Splitting
from sympflow.kernels.splitting_loops import splitting_loops
from sympflow.schemes import Scheme

pytestmark = pytest.mark.slow

EPS = np.finfo(float).eps
HH, QUARTIC = systems.henon_heiles(), systems.quartic()
MONOMIALS = ((2, 0), (1, 1), (0, 3), (2, 3))


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


def test_the_force_gradient_of_a_polynomial_is_one():
    q = np.random.default_rng(0).normal(size=(5, 2))
    symbols, of_kicks = QUARTIC.symbols, monomials(QUARTIC.symbols, 6)
    e = in_monomials(symbols.force_gradient, symbols, of_kicks)
    expected = -(QUARTIC.force(q) ** 2).sum(-1) / 2
    np.testing.assert_allclose(value(of_kicks, e, q), expected, rtol=64 * EPS)
    assert in_monomials(symbols.force_gradient, symbols, monomials(symbols, 4)) is None
    assert in_monomials(sp.cos(symbols.q[0]), symbols, of_kicks) is None
