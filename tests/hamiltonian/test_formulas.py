"""Formulas of all kinds: right values, or an error at once; compiled code has the values of arrays."""

import random

import mpmath
import numpy as np
import pytest
import sympy as sp
import torch
from conftest import refusals
from numba import njit
from scipy.interpolate import CubicSpline

from sympflow import HamiltonianSystem, doubled, solve
from sympflow.integrators.implicit import gauss_legendre
from sympflow.kernels.newton import newton_code
from sympflow.kernels.one_steps import lettered

made = HamiltonianSystem.from_sympy
Y = np.array([0.31, 0.47, 0.23, -0.39])
TIMES = np.linspace(-2, 2, 9)
HELD = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
q, p = sp.symbols("q p")


@njit
def compiled_H(q, p):
    return (p**2).sum(-1) / 2 + (q**2).sum(-1) / 2


HIDDEN = "hide all that follows"
REFUSED = [
    (lambda: made("p**2/2 + q**2/2 # + q**4\n + 5*q**3"), f"^`expression` .*{HIDDEN}"),
    (lambda: HamiltonianSystem.lattice(onsite="q**2 # + q**4", shape=4), f"^`onsite` .*{HIDDEN}"),
    (lambda: HamiltonianSystem.pairs("1/r # + r", masses=[1, 1]), f"^`potential` .*{HIDDEN}"),
    (lambda: doubled(made("p**2/2 + q**2/2"), "-p # q"), f"^`force` .*{HIDDEN}"),
    (lambda: made("p**2/2 + V", params={"V": CubicSpline(TIMES, TIMES**2)}), "^`params` has V, a spline"),
    (lambda: made("p**2/2 + k*q**2", params={"k": HELD}), TypeError, r"^`params\['k'\]` is a tensor.*detach"),
    (
        lambda: HamiltonianSystem.lattice(onsite="k*q**2", shape=4, params={"k": HELD}),
        TypeError,
        r"^`params\['k'\]` is a tensor.*detach",
    ),
    (lambda: HamiltonianSystem.pairs("1/r", masses=HELD.expand(2)), TypeError, "^`masses` is a tensor.*detach"),
    (lambda: made("p**2/2 + (-0.3)**q"), "^`expression` is complex.*positive base"),
    (lambda: made("p**2/2 + a**q", params={"a": -0.3}), "^`params` has a = -0.3"),
    (lambda: made("p**2/2 + asin(2)*q"), "^`expression` is complex"),
    (lambda: made(sp.Matrix([[p**2, q], [q, p]])), r"^`expression` must be a scalar.*\(2, 2\)"),
    (lambda: made(f"p**2/2 + Max({','.join(f'{i}*q' for i in range(200))})"), "Max has 200 arguments"),
    (lambda: made("p1**2/2 + q99999999999"), "^`expression` has coordinates numbered up to 99999999999"),
    (lambda: HamiltonianSystem(hamiltonian=compiled_H, ndof=1), TypeError, "^`hamiltonian` is a Numba function"),
]


test_what_has_no_right_value_is_refused = refusals(*REFUSED)


MICRO, GREEK = "\u00b5", "\u03bc"
SUM = " + ".join(["q**2/1000"] * 250)
SAME = [
    (made(sp.Matrix([[p**2 / 2 + q**2 / 2]])), made("p**2/2 + q**2/2")),
    *(
        (made(f"p**2/2 + {text}*q**2", params={name: 2.0}), made("p**2/2 + 2*q**2"))
        for text in (MICRO, GREEK)
        for name in (MICRO, GREEK)
    ),
    (made(f"p**2/2 + {SUM} + Piecewise((q**2, q <= 1), (1, True))"), made("p**2/2 + q**2/4 + q**2")),
    (made("p**2/2 + Piecewise((q**2, q < 1))"), made("p**2/2 + q**2")),
]


@pytest.mark.parametrize(("one", "other"), SAME)
def test_one_formula_in_two_spellings(one, other):
    y = np.array([[0.3, 0.2], [-0.7, 0.4]])
    np.testing.assert_allclose(one.hamiltonian(y), other.hamiltonian(y), rtol=1e-13)
    np.testing.assert_allclose(one.gradient(y), other.gradient(y), rtol=1e-13)


FAR_AND_NEAR = {
    "coth(q)": lambda x: 1 / mpmath.tanh(x),
    "csch(q)": lambda x: 1 / mpmath.sinh(x),
    "sech(q)": lambda x: 1 / mpmath.cosh(x),
    "cot(q)": lambda x: 1 / mpmath.tan(x),
    "Abs(csch(q))": lambda x: abs(1 / mpmath.sinh(x)),
}


@pytest.mark.parametrize("V", FAR_AND_NEAR)
@pytest.mark.parametrize("q", [1e-9, -0.3, 700.0, 1e5])
def test_reciprocals_have_their_values_near_zero_and_far_from_it(V, q):
    with mpmath.workdps(30):
        right = float(FAR_AND_NEAR[V](mpmath.mpf(q)))
    system = made(f"p**2/2 + {V}")
    with np.errstate(over="ignore"):
        found = [
            system.potential(np.array([[q]]))[0],
            system.potential(torch.tensor([[q]], dtype=torch.float64))[0].item(),
        ]
    np.testing.assert_allclose(found, right, rtol=1e-9 if V == "cot(q)" else 1e-14)


OF_ARRAYS = {
    **dict.fromkeys(["erf(q)", "erfc(q)", "sec(q/3)", "csc(q + 2)", "cot(q + 2)", "acot(q)*q"], True),
    **dict.fromkeys(["sech(q)", "csch(q + 2)", "coth(q + 2)", "sinc(q)"], True),
    "Piecewise((q**2, Piecewise((q, q > 0), (-q, True)) > 1), (2*Abs(q) - 1, True))": True,
    "Max(Piecewise((q, Heaviside(q) > 0.3), (-q, True)), 1)*q**2": True,
    **dict.fromkeys(["gamma(q + 2)", "loggamma(q + 2)", "besselj(1, q)", "besselk(0, q + 2)"], False),
    **dict.fromkeys(["elliptic_k(q/4)", "elliptic_e(q, 0.3)", "airyai(q)", "LambertW(q + 1)"], False),
}
"""V, and True if torch has it; else tensors are refused."""


@pytest.mark.parametrize("V", OF_ARRAYS)
def test_functions_of_arrays_have_their_values(V):
    system, q = made(f"p**2/2 + {V}"), np.array([0.7, 1.3, -0.3])
    y = np.stack([q, 0 * q], axis=-1)
    exact = sp.lambdify(system.symbols.q[0], system.symbols.V, "mpmath")
    with mpmath.workdps(40):
        right = [[float(mpmath.diff(exact, x, n)) for x in q.tolist()] for n in range(3)]
    found = system.potential(y[:, :1]), -system.force(y[:, :1])[:, 0], system.hessian(y)[:, 0, 0]
    np.testing.assert_allclose(found, right, rtol=1e-13, atol=1e-14)
    if OF_ARRAYS[V]:
        np.testing.assert_allclose(system.gradient(torch.tensor(y)), system.gradient(y), rtol=1e-13, atol=1e-14)
    else:
        with pytest.raises(TypeError, match=r"`expression` holds .* which torch does not have: solve on NumPy states"):
            system.hamiltonian(torch.tensor(y))


@pytest.mark.parametrize("method", ["verlet", "gauss_legendre4"])
def test_what_has_no_compiled_form_runs_with_arrays_and_says_so(method):
    sol = solve(made("p**2/2 + airyai(q)"), method, (0, 0.05), y0=[0.3, 0.2], dt=0.01)
    assert sol.success
    assert sol.stats["backend"] == "numpy"
    assert "array operations: `system` has the term" in sol.message


@pytest.mark.parametrize("T", ["(p1 + p2)**2/2", "-p1**2/2 - p2**2/2", "p1*p2"])
def test_linear_parts_need_positive_masses(T):
    system = made(f"{T} + q1**2 + q2**2", y0=Y)
    with pytest.raises(ValueError, match=r"^`system` has a kinetic energy.*not positive definite.*'kahan_li8'"):
        solve(system, "impulse", (0, 0.05), dt=0.01)


# random formulas --------------------------------------------------------------------------------------------------

FUNCTIONS = ["sin", "cos", "exp", "tanh", "atan", "sqrt", "log", "Abs", "cosh"]
FUNCTIONS += ["erf", "asinh", "sech", "tan", "asin", "sinh", "gamma", "acot"]


@pytest.mark.parametrize(
    ("method", "backend"), [("verlet", "array"), ("chin4a", "compiled"), ("gauss_legendre6", "compiled")]
)
def test_a_power_of_a_maximum_between_one_and_two(method, backend):
    """V'' is 0·∞ where the maximum is 0, and every method there of order 3/2: a free body, then a wall."""
    system = made("p**2/2 + Max(q - 1, 0)**1.5", y0=[0.0, 0.5])
    assert not system.hessian(np.array([0.3, 0.5]))[0].any()
    sol = solve(system, method, (0, 8), dt=0.002, backend=backend)
    assert sol.status == 0
    reference = solve(system, "dop853", (0, 8), rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(sol.y[:, -1], reference.y[:, -1], atol=5 * 0.002**1.5)


@pytest.mark.parametrize(
    "V",
    ["gamma(Abs(erfc(q**-3)))", "q/(1 + Max(q**-3, pi))", "csch(Max(0.3, 1/q) + Piecewise((1/q, q > 2), (0.5, True)))"],
)
def test_what_is_infinite_within_a_function_is_no_raw_error(V):
    assert solve(made(f"p**2/2 + {V}"), "verlet", (0, 0.03), [2.6, 0.1], dt=0.01).success


def formula(r: random.Random, depth: int) -> str:
    """A random expression in q1, p1, q2, p2 and a."""
    if depth == 0 or r.random() < 0.15:
        return r.choice(["q1", "p1", "q2", "p2", "a", "2", "0.7", "1/3"])
    a, b, c, e = (formula(r, depth - 1) for _ in range(4))
    whole = f"({a} + {b})", f"({a})*({b})", f"({a})/({b})", f"({a})**2.5", f"({a})**17", f"({a})**({b})"
    chosen = f"Max({a}, {b})", f"Min({a}, {b})", f"Piecewise(({a}, ({b})**2 <= {c}), ({e}, True))"
    return r.choice([*whole, *chosen, *(f"{r.choice(FUNCTIONS)}({a})" for _ in range(7))])


def slopes(system):
    """∇H and the upper triangle of ∇²H as they are compiled."""
    return newton_code(lettered(system.symbols, [system.symbols.H]), gauss_legendre(1), False, False).slopes


REFUSED = (2, 18, 21, 22, 24)  # seeds of formulas that jump, or are not real


@pytest.mark.parametrize("seed", [seed for seed in range(30) if seed not in REFUSED])
def test_derivatives_of_random_formulas_are_those_of_H_and_of_compiled_code(seed):
    text = formula(random.Random(seed), 2)
    system = made(f"p1**2/2 + p2**2/2 + a*q1 + {text}", params={"a": 0.6})
    with np.errstate(all="ignore"):
        g, h = system.gradient(Y), system.hessian(Y)
        differences = [(system.hamiltonian(Y + d) - system.hamiltonian(Y - d)) / 2e-5 for d in 1e-5 * np.eye(4)]
    assert np.isfinite(g).all()
    assert np.isfinite(h).all()
    np.testing.assert_allclose(g, differences, rtol=1e-4, atol=1e-5)
    found = slopes(system)(*Y.tolist())
    np.testing.assert_allclose(found[:4], g, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found[4:], h[np.triu_indices(4)], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("seed", REFUSED)
def test_random_formulas_that_jump_or_are_not_real_are_refused(seed):
    text = formula(random.Random(seed), 2)
    with pytest.raises(ValueError, match=r"`expression` jumps where|is not a finite real one"):
        made(f"p1**2/2 + p2**2/2 + a*q1 + {text}", params={"a": 0.6})


@pytest.mark.parametrize("q", [0.0, 1e-9, 1e-4, 0.999, 1.001, 30.0])
def test_the_compiled_derivatives_of_sinc_do_not_cancel(q):
    found = slopes(made("p**2/2 + sinc(q)"))(q, 0.0)
    with mpmath.workdps(60):
        x = mpmath.mpf(q or 1e-20)
        sin, cos = mpmath.sin(x), mpmath.cos(x)
        exact = [(x * cos - sin) / x**2, -sin / x - 2 * cos / x**2 + 2 * sin / x**3]
    assert [found[0], found[2]] == pytest.approx([float(e) for e in exact], rel=1e-13, abs=1e-19)
