"""Systems of many terms: loops over the terms of each kind, against the functions of arrays."""

import itertools
from functools import partial

import numpy as np
import pytest

from sympflow import HamiltonianSystem, solve
from sympflow.kernels import terms
from sympflow.kernels.array_splittings import term_code
from sympflow.kernels.protocol import Task, run_states
from sympflow.kernels.splittings import Splitting, SplittingCode
from sympflow.schemes import CURVATURE, FORCE_GRADIENT, POLYNOMIAL

SITES = 18


def chain(kinetic="p{0}**2/2"):
    """Springs of Fermi, Pasta, Ulam and Tsingou between fixed ends, the last one of another kind."""
    x = ["0", *(f"q{i}" for i in range(1, SITES + 1)), "0"]
    springs = [f"({b} - {a})**2/2 + ({b} - {a})**3/12" for a, b in itertools.pairwise(x)]
    moved = [kinetic.format(i) for i in range(1, SITES + 1)]
    y0 = 0.3 * np.sin(np.arange(1, 2 * SITES + 1))
    return HamiltonianSystem.from_sympy(" + ".join([*moved, *springs, f"cos(q{SITES})/7 + 3"]), y0=y0)


SYSTEM = chain()


SMALL = {"masses": "p1**2/2 + p2**2/3 + p3**2/4 + ", "coupled": "p1**2/2 + p2**2/2 + p3**2/2 + p1*p2/3 + "}
V = "(q1 - q2)**2/2 + (q2 - q3)**2/3 + (q1 - q2)**4/5 + (q2 - q3)**4/6 + cos(q1) + sqrt(2 + q3**2) + 7"


def small(kind="masses", **more):
    return HamiltonianSystem.from_sympy(SMALL[kind] + V, y0=[0.3, -0.2, 0.5, 0.1, 0.4, -0.3], **more)


@pytest.mark.parametrize(
    ("kind", "compensated", "level", "friction"),
    [
        ("masses", False, 0, None), ("coupled", True, 0, None), ("coupled", False, 0, 0),
        ("coupled", False, FORCE_GRADIENT, None), ("masses", True, FORCE_GRADIENT, None),
        ("masses", False, FORCE_GRADIENT, 1),
        ("masses", True, CURVATURE, None), ("coupled", False, CURVATURE, 0), ("masses", False, POLYNOMIAL, 0),
        ("coupled", True, POLYNOMIAL, None), ("coupled", False, POLYNOMIAL, 1),
    ],
)  # fmt: skip
def test_loops_over_terms_are_the_stages_that_are_written_out(kind, compensated, level, friction):
    system = small(kind)
    monomials = ((4, 0, 0), (1, 2, 1)) if level == POLYNOMIAL else ()
    splitting = Splitting(system.symbols, level, monomials, compensated, friction)
    rng, save = np.random.default_rng(0), np.array([0, 2, 7])
    table = 0.05 * rng.standard_normal((len(splitting.numbers), 4))
    table[3:] *= 0.02  # curvatures, polynomials, and growth by friction
    table[-1, 1] = 0.0  # a kick with fewer terms
    y0, found = system.y0 + 0.1 * rng.standard_normal((11, 6)), []
    y0[5] = 1e60  # leaves to infinity
    for code in (SplittingCode(splitting), term_code(splitting)):
        run, one = (
            run_states(partial(code.run, table), Task(0.1, y, 7, save, threads=1), code.n_values, 1)
            for y in (y0, y0[3:4])
        )
        assert np.array_equal(one.states[0], run.states[3])
        assert np.isnan(run.states[5, 2]).all()
        assert (run.n_finite < 7).tolist() == [i == 5 for i in range(11)]
        found.append(np.delete(run.states, 5, axis=0))
    assert np.abs(found[0]).max() < 1e3
    assert np.abs(found[0] - found[1]).max() < 1e-12 * np.abs(found[0]).max()


def test_systems_of_very_many_kinds_of_terms_run_as_arrays_and_say_why(monkeypatch):
    powers = [(a, b, c) for a in range(1, 5) for b in range(1, 5) for c in range(1, 4)]
    products = [f"q{1 + n % 3}**{a}*cos(q{1 + (n + 1) % 3})**{b}*sin(q4)**{c}" for n, (a, b, c) in enumerate(powers)]
    H = f"p1**2 + p2**2 + p3**2 + p4**2 + {' + '.join(products)}"
    system = HamiltonianSystem.from_sympy(H, y0=np.full(8, 0.1))
    assert terms.is_large(system.symbols)
    monkeypatch.setattr(terms, "MOST_OPERATIONS", 10)
    monkeypatch.setattr(terms, "MOST_COMPILED", 500)
    with pytest.raises(ValueError, match=r"`system` has so many terms of different kinds.*Give it by Numba functions"):
        solve(system, "verlet", (0, 0.1), dt=0.05, backend="compiled")
    assert solve(system, "verlet", (0, 0.1), dt=0.05).stats["backend"] != "compiled"
    assert solve(SYSTEM, "verlet", (0, 0.1), dt=0.05).stats["backend"] == "compiled"
