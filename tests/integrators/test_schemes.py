"""The splitting tables: order conditions in the free algebra, symmetry, inverse, counts."""

import dataclasses

import numpy as np
import pytest

from sympflow.schemes import SCHEMES, Scheme

ALL = pytest.mark.parametrize("scheme", SCHEMES.values(), ids=SCHEMES.keys())


# --- order conditions ---------------------------------------------------------------------------------------
# A series in two noncommuting letters A (drift) and B (kick), h counting the degree, is a list whose n-th
# entry holds the coefficients of the words of length n in an array of shape (2,)*n.


def letter_product(series, word_coefficients, degree):
    """`series` times a homogeneous polynomial of the given degree, truncated."""
    product = [np.zeros_like(term) for term in series]
    for n in range(len(series) - degree):
        product[n + degree] = np.multiply.outer(series[n], word_coefficients)
    return product


def add(one, other, factor=1.0):
    return [x + factor * y for x, y in zip(one, other, strict=True)]


def times_exponential(series, generators):
    """`series` · exp(Σ generators), the generators given as (degree, coefficients)."""
    total, term = series, series
    for k in range(1, len(series)):
        parts = [letter_product(term, words, degree) for degree, words in generators]
        term = [sum(entries) / k for entries in zip(*parts, strict=True)]
        total = add(total, term)
    return total


A, B = np.array([1.0, 0.0]), np.array([0.0, 1.0])


def bracket(x, y):
    return np.multiply.outer(x, y) - np.multiply.outer(y, x)


def scheme_series(scheme, order):
    series = [np.ones(())] + [np.zeros((2,) * n) for n in range(1, order + 1)]
    gradient = 0.5 * bracket(B, bracket(A, B))
    for b, g, a in zip(scheme.kicks, scheme.gradients, scheme.drifts, strict=True):
        kick = [(1, b * B)] + ([(3, g * gradient)] if order >= 3 else [])
        series = times_exponential(times_exponential(series, kick), [(1, a * A)])
    return series


def nystrom_ideal(degree):
    """Words u [B,[B,[B,A]]] w of the given length: they vanish when the kinetic energy is quadratic in p."""
    generator = bracket(B, bracket(B, bracket(B, A)))
    letters = degree - 4
    rows = []
    for left in range(max(letters, -1) + 1):
        for u in np.eye(2**left):
            for w in np.eye(2 ** (letters - left)):
                outer = np.multiply.outer(u.reshape((2,) * left), generator)
                rows.append(np.multiply.outer(outer, w.reshape((2,) * (letters - left))).ravel())
    return np.array(rows).reshape(len(rows), 2**degree).T


def order_defects(scheme, order):
    """Distance of the degree-n terms from those of exp(h(A + B)), modulo the Nyström ideal if it applies."""
    exact = [np.ones(())] + [np.zeros((2,) * n) for n in range(1, order + 1)]
    exact = times_exponential(exact, [(1, A + B)])
    defects = []
    for n, term in enumerate(add(scheme_series(scheme, order), exact, -1.0)):
        residual = np.asarray(term).ravel()
        if scheme.nystrom and n >= 4:
            ideal = nystrom_ideal(n)
            residual = residual - ideal @ np.linalg.lstsq(ideal, residual, rcond=None)[0]
        defects.append(np.linalg.norm(residual))
    return np.array(defects)


@ALL
def test_order_conditions_hold_up_to_the_order_and_not_beyond(scheme):
    defects = order_defects(scheme, scheme.order + 1)
    assert defects[:-1].max() < 2e-14, defects
    assert defects[-1] > 1e-8, defects


@pytest.mark.parametrize(
    ("name", "degrees"), [("aba104", {1: 10, 2: 4}), ("aba864", {1: 8, 2: 6, 3: 4}), ("aba1064", {1: 10, 2: 6, 3: 4})]
)
def test_a_scheme_for_nearly_integrable_systems_is_of_higher_order_where_kicks_are_few(name, degrees):
    """With kicks of order ε the terms of degree n with k letters B are of order εᵏhⁿ: they hold up to degree n_k."""
    highest = max(degrees.values()) + 1
    exact = [np.ones(())] + [np.zeros((2,) * n) for n in range(1, highest + 1)]
    exact = times_exponential(exact, [(1, A + B)])
    difference = add(scheme_series(SCHEMES[name], highest), exact, -1.0)
    for kicks, degree in degrees.items():
        largest = [abs(term[np.indices(term.shape).sum(0) == kicks]).max(initial=0.0) for term in difference[1:]]
        assert max(largest[:degree]) < 1e-15
        assert largest[degree] > 1e-12


@pytest.mark.parametrize("name", [s.name for s in SCHEMES.values() if not any(s.gradients)])
def test_nystrom_flag_says_whether_the_order_needs_a_quadratic_kinetic_energy(name):
    scheme = dataclasses.replace(SCHEMES[name], nystrom=False)
    holds_for_every_kinetic_energy = order_defects(scheme, scheme.order).max() < 2e-14
    assert bool(holds_for_every_kinetic_energy) is not SCHEMES[name].nystrom


# --- symmetry, counts ---------------------------------------------------------------------------------------


@ALL
def test_all_schemes_are_symmetric_and_have_an_inverse_that_has_one(scheme):
    """Other laws hold for all methods: the inverse undoes the executed step, that of a symmetric one is itself."""
    assert scheme.symmetric
    assert scheme.inverse().inverse().substeps == scheme.substeps


EVALUATIONS = {
    **{"verlet": (1, 0), "leapfrog": (1, 0), "yoshida4": (3, 0), "yoshida6": (7, 0), "suzuki4": (5, 0)},
    **{"mclachlan4": (5, 0), "blanes_moan4": (6, 0), "kahan_li6": (9, 0), "kahan_li8": (17, 0)},
    **{"srkn6b": (6, 0), "srkn11b": (11, 0), "srkn14a": (14, 0), "aba104": (7, 0), "aba864": (7, 0), "aba1064": (8, 0)},
    **{"chin4a": (2, 1), "chin4c": (3, 1), "omelyan4": (3, 1), "omelyan6": (5, 3)},
}
"""Forces and force gradients of a step, as the papers count them."""


def test_evaluations_per_step():
    for name, counts in EVALUATIONS.items():
        scheme = SCHEMES[name]
        assert scheme.first_same_as_last
        assert (scheme.force_evaluations, scheme.hessian_evaluations) == counts, name


def test_order_conditions_see_a_coefficient_changed_in_the_tenth_digit():
    good = SCHEMES["kahan_li8"]
    kicks = (*good.kicks[:3], good.kicks[3] + 1e-10, *good.kicks[4:])
    bad = Scheme("bad", 8, kicks, good.drifts, good.gradients, "")
    assert order_defects(bad, 8).max() > 1e-11
