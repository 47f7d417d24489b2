"""Text as an expression: what is understood, and that nothing in it is executed or runs away."""

import json
import struct
from functools import cache

import mpmath
import numpy as np
import pytest
import sympy as sp
import torch
from watchdog import watched

from sympflow import HamiltonianSystem, SympFlow, load, solve, systems
from sympflow.flow.records import KEY, SUM, text_checksum
from sympflow.hamiltonian.expression import read
from sympflow.hamiltonian.grammar import Unreadable
from sympflow.hamiltonian.removable import Max, with_own_functions

q, p, q1, q2 = sp.symbols("q p q1 q2", real=True)

UNDERSTOOD = {
    "p**2/2 + q^4/4": p**2 / 2 + q**4 / 4,
    "-q + +p - (-2)": p - q + 2,
    "q/2/3*p": q * p / 6,
    "2**3**2*q": 512 * q,
    "1/(q1**2+q2**2)**(3/2)": (q1**2 + q2**2) ** sp.Rational(-3, 2),
    "Rational(1, 3)*q\n + pi": q / 3 + sp.pi,
    "E**q + ln(q2)": sp.exp(q) + sp.log(q2),
    "max(q, 0) + abs(p)": Max(q, 0) + sp.Abs(p),
    "frac(q) + ceiling(p)": sp.frac(q) + sp.ceiling(p),
    "floor(q)*Mod(p, 2)": sp.floor(q) * sp.Mod(p, 2),
    "besselj(0, q)*gamma(5)": 24 * sp.besselj(0, q),
    "Piecewise((q, q > 0), (0, True))": sp.Piecewise((q, q > 0), (0, True)),
}

HOSTILE = {
    'S(\'__import__("os").system("touch PWNED")\') + q': "the function S is unknown",
    "__import__('os').system('touch PWNED') + q": "a function is called by its name",
    "q.__class__": "not understood",
    "sympify(q)": "the function sympify is unknown",
    "lambdify(q, q)": "unknown",
    "preview(q)": "unknown",
    "[q][5]": "not understood",
    "'q'": "not a number",
    "True + q": "not a number",
    "q if p else 1": "not understood",
    "(lambda: q)()": "by its name",
    "q(3)": "unknown",
    "sin()": "not understood",
    "sin(q, p)": "not understood",
    "sin(x=q)": "not understood",
    "q < 3": "not understood",
    "Rational(q, 2)": "whole numbers",
    "Rational(1, 0)": "whole numbers",
    "Piecewise(q)": "pairs",
    "Piecewise((q, p))": "condition",
    "q/0": "divides by zero",
    "0**-1*q": "divides by zero",
    "log(0) + q": "infinite or undefined",
    "1e999*q": "out of range",
    "9**9**9**9": "out of range",
    "p**2/2 + q**(9**9**9)": "out of range",
    "q**1001": "an exponent of 1001",
    "(q**900)**900": "out of range",
    "(10**300*q)**1000": "out of range",
    "(q + 10**300)**1000": "out of range",
    "exp(exp(exp(exp(9)))) + q": "out of range",
    "gamma(10**9)*q": "out of range",
    "(q + p + 1)**900": "more than 50,000 terms",
    "((q + 1)**99 + p)**99": "more than 50,000 terms",
    "9" * 5000: "digits",
    "(" * 5000 + "q" + ")" * 5000: "nested",
    "-" * 50_000 + "q": "nested",
    "**".join(["q"] * 300): "nested",
    "q" * 200_000: "characters",
    "q*" * 24_000 + "q": "nested",
    "\0q": "null",
    "": "syntax",
}


@pytest.mark.parametrize("text", UNDERSTOOD)
def test_text_means_what_sympy_means_by_it(text):
    assert sp.simplify(read(text) - UNDERSTOOD[text]) == 0


def test_a_parameter_may_have_the_name_of_a_function():
    assert read("gamma*q", ["gamma"]) == sp.Symbol("gamma", real=True) * q


@pytest.mark.parametrize("text", HOSTILE, ids=lambda text: text[:30].replace("\0", "0"))
def test_hostile_text_is_refused_at_once(text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with watched(), pytest.raises(Unreadable, match=HOSTILE[text]):
        read(text)
    with watched(), pytest.raises(ValueError, match=r"^`expression` cannot be parsed"):
        HamiltonianSystem.from_sympy(text)
    with watched(), pytest.raises(ValueError, match=r"^`parts` has one that is not admissible"):
        SympFlow.split(systems.pendulum(), 1, dt=0.1, parts=("p1**2/2", text))
    assert not list(tmp_path.iterdir())


def test_objects_are_not_read_as_text():
    class Hostile:
        def __str__(self):
            raise AssertionError("it was read as text")

    for value in (Hostile(), {"q": 1}, None, object):
        with pytest.raises(ValueError, match=r"^`expression` must be a scalar"):
            HamiltonianSystem.from_sympy(value)


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "flow.safetensors"
    SympFlow.split(systems.pendulum(), 1, dt=0.1, parts=("1 - cos(q1)", "p1**2/2")).save(path)
    return path


def edit(path, change):
    content = path.read_bytes()
    (n,) = struct.unpack("<Q", content[:8])
    header = json.loads(content[8 : 8 + n])
    record = json.loads(header["__metadata__"][KEY])
    change(record)
    text = json.dumps(record)
    header["__metadata__"] = {KEY: text, SUM: text_checksum(text)}
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + content[8 + n :])


def with_parts(*expressions):
    def change(record):
        record["architecture"]["split"]["expressions"] = list(expressions)

    return change


@pytest.mark.parametrize("text", [t for t in HOSTILE if len(t) < 1000], ids=lambda text: text[:30].replace("\0", "0"))
def test_a_file_that_names_hostile_parts_is_refused(file, text, monkeypatch):
    monkeypatch.chdir(file.parent)
    edit(file, with_parts(text, "p1**2/2"))
    with watched(), pytest.raises(ValueError, match=r"^`path` .* its parts are not all expressions"):
        load(file, system=systems.pendulum())
    assert [f.name for f in file.parent.iterdir()] == [file.name]


def test_sums_of_thousands_of_terms_are_read():
    terms = [f"{n}*{'q1' if n % 2 else 'q2'}" for n in range(1, 3001)]
    total = 1500**2 * q1 + 1500 * 1501 * q2
    assert read(" + ".join(terms)) == total
    assert read(f"sin({' - '.join(terms)})/2 - q") == sp.sin(2 * q1 - total) / 2 - q


@pytest.mark.parametrize(
    "text",
    [
        "-q + 1.5e-3*q1 - 2e+3 + q2",
        "Max(q - 1 + q1, q2 - q) - -q",
        "Piecewise((q - q1 + 1, q + q2 - 1 > q1 - q), (0, True))",
    ],
)
def test_sums_are_the_same_however_they_are_grouped(text, monkeypatch):
    expected = read(text)
    monkeypatch.setattr("sympflow.hamiltonian.grammar.TERMS_IN_A_ROW", 1)
    assert sp.expand(read(text) - expected) == 0


SINC = [
    ("sinc(q)", 1.0, 1.0),
    ("sin(q)/q", 1.0, 1.0),
    ("3*sin(q)/(2*q)", 1.5, 1.0),
    ("sin(3*q)/q", 3.0, 3.0),
    ("sin(k*q)/q", 1.3, 1.3),
    ("sin(k*q)/(k*q)", 1.0, 1.3),
]
"""V, and c, k with V = c sin(kq)/(kq); that of a cosine below, c (sin(kq)/(kq))²."""
SQUARES = [
    ("(1 - cos(q))/q**2", 0.5, 0.5),
    ("1/q**2 - cos(q)/q**2", 0.5, 0.5),
    ("sin(q)**2/q**2", 1.0, 1.0),
    ("(cos(k*q) - 1)/(k*q)**2", -0.5, 0.65),
]


@cache
def of_sinc(V):
    return HamiltonianSystem.from_sympy(f"p**2/2 + {V}", params={"k": 1.3} if "k*" in V else None)


@pytest.mark.parametrize("q", [0.0, 1e-20, 1e-9, -1e-4, 0.3])
@pytest.mark.parametrize(("V", "c", "k", "n"), [(*row, 1) for row in SINC] + [(*row, 2) for row in SQUARES])
def test_sinc_and_what_is_written_for_it_are_right_near_zero(V, c, k, n, q):
    system = of_sinc(V)
    with mpmath.workdps(100):
        value = [float(mpmath.diff(lambda x: c * mpmath.sinc(k * x) ** n, q, order)) for order in range(3)]
    y = np.array([[q, 0.7], [q, 0.0]])
    np.testing.assert_allclose(system.potential(y[:, :1]), value[0], rtol=1e-15)
    np.testing.assert_allclose(-system.force(y[:, :1])[0], value[1], rtol=2e-15)
    np.testing.assert_allclose(system.hessian(y)[0, 0, 0], value[2], rtol=2e-15)
    tensor = torch.tensor(y, requires_grad=True)
    (gradient,) = torch.autograd.grad(system.hamiltonian(tensor).sum(), tensor)
    np.testing.assert_allclose(gradient.numpy(), system.gradient(y), rtol=1e-14)


REMOVABLE = [
    *("sinc(q)", "3*sin(q)/(2*q)", "sin(k*q)/(k*q)", "(cos(k*q) - 1)/(k*q)**2", "1/q**2 - cos(q)/q**2"),
    *("sin(q)**2/q**2", "tan(q)/q", "tanh(q)/q", "atan(k*q)/q", "erf(q)/q", "q*csch(q)", "q/(exp(q) - 1)", "q*cot(q)"),
    *("log(1 + q)/q", "(exp(q) - 1 - q)/q**2", "k*(exp(k*q) - 1 - k*q)/q**2", "(q - sin(q))/q**3", "besselj(1, q)/q"),
    *("1/q - csch(q)", "csch(q)**2 - 1/q**2", "k*csch(k*q) - 1/q", "exp(-q**2)*sinh(q)/q", "sqrt(tanh(q)/q)"),
    *("(sqrt(1 + q) - 1)/q", "sin(pi*(q + 1))/q", "(q**2 - q)/(q - q**3)", "1/q - 1/(q + q**2)", "1/q - 1/sin(q)"),
    *("1/sin(q) - 1/tan(q)", "log(q) - log(sin(q))", "log(exp(q) - 1) - log(q)"),
]
"""V that is 0/0 or ∞ − ∞ at 0, in parts, and smooth there."""


@cache
def of_removable(V):
    return HamiltonianSystem.from_sympy(f"p**2/2 + {V}", params={"k": 1.3} if "k" in V else None)


@pytest.mark.parametrize("q", [0.0, 1e-20, 1e-9, -1e-4, 0.3, 0.9])
@pytest.mark.parametrize("V", REMOVABLE)
def test_what_is_finite_though_its_parts_are_not_is_right_near_that_place(V, q):
    """Two derivatives too, beside 200 digits; rounding grows as far from the place as the parts cancel."""
    system, s, y = of_removable(V), sp.Symbol("q", real=True), np.array([[q, 0.7], [q, 0.0]])
    written = sp.sympify(V.replace("sinc(q)", "sin(q)/q"), {"q": s, "k": sp.Rational(1.3)})
    with mpmath.workdps(200):
        exact = [sp.lambdify(s, written.diff(s, order), "mpmath") for order in range(3)]
        value = [float(mpmath.re(f(mpmath.mpf(q) or mpmath.mpf(10) ** -30))) for f in exact]
    np.testing.assert_allclose(system.potential(y[:, :1]), value[0], rtol=1e-14, atol=1e-16)
    np.testing.assert_allclose(-system.force(y[:, :1])[0], value[1], rtol=1e-13, atol=1e-16)
    np.testing.assert_allclose(system.hessian(y)[0, 0, 0], value[2], rtol=1e-12, atol=1e-16)
    if "bessel" not in V:
        tensor = torch.tensor(y, requires_grad=True)
        (gradient,) = torch.autograd.grad(system.hamiltonian(tensor).sum(), tensor)
        np.testing.assert_allclose(gradient.numpy(), system.gradient(y), rtol=1e-13, atol=1e-16)


ROOTS = {
    "sqrt(exp(q) + exp(-q) - 2)": lambda x: 2 * mpmath.sinh(x / 2),
    "sqrt(k*exp(2*q) + k*exp(-2*q) - 2*k)": lambda x: 2 * mpmath.sqrt(mpmath.mpf(1.3)) * mpmath.sinh(x),
    "sqrt(1 - cos(2*q))": lambda x: mpmath.sqrt(2) * mpmath.sin(x),
    "(k - k*cos(q))**1.5": lambda x: mpmath.sqrt(mpmath.mpf(1.3) * 2) ** 3 * mpmath.sin(x / 2) ** 3,
    "1/sqrt(1 - cos(q)**2)": mpmath.csc,
    "log(cosh(q) - 1)/2": lambda x: mpmath.log(mpmath.sqrt(2) * mpmath.sinh(x / 2)),
    "sqrt(1 + sin(q - pi/2))": lambda x: mpmath.sqrt(2) * mpmath.sin(x / 2),
    "sqrt(1 - sqrt(1 - q**2))": lambda x: x / mpmath.sqrt(1 + mpmath.sqrt(1 - x**2)),
    "sqrt(exp(q) - 1 - q)": lambda x: mpmath.sqrt(mpmath.expm1(x) - x),
}
"""V by roots and logarithms of sums that touch 0 at q = 0, and the same for q > 0."""


@pytest.mark.parametrize("q", [1e-9, 1e-5, 1e-3, 0.3])
@pytest.mark.parametrize("V", ROOTS)
def test_roots_of_what_touches_zero_keep_their_digits_there(V, q):
    system = of_removable(V)
    with mpmath.workdps(80):
        value, slope = (float(mpmath.diff(ROOTS[V], mpmath.mpf(q), order)) for order in (0, 1))
    np.testing.assert_allclose(system.potential(np.array([[q]])), value, rtol=2e-14)
    np.testing.assert_allclose(-system.force(np.array([q]))[0], slope, rtol=2e-14)


@pytest.mark.parametrize(("q", "rtol"), [(1e-9, 1e-14), (0.3, 1e-12)])
@pytest.mark.parametrize("V", ["k*csch(q) - c/q", "(k*cosh(q) - c)/q", "k/q - c*cos(q)/q"])
def test_terms_that_cancel_by_the_values_of_parameters_are_right_or_refused(V, q, rtol):
    """V(q)/k is −q/6, q/2 or q/2 near 0: the slope beside 60 digits."""
    with mpmath.workdps(60):
        f = sp.lambdify(sp.Symbol("q"), sp.sympify(V, {"k": 1, "c": 1}), "mpmath")
        slope = float(mpmath.diff(f, mpmath.mpf(q)))
    H = f"p**2/2 + {V}"
    system = HamiltonianSystem.from_sympy(H, params={"k": 2.5, "c": 1.5}, y0=[q, 0])
    for k in (1.0, 2.5):
        same = HamiltonianSystem.from_sympy(H, params={"k": k, "c": k})
        np.testing.assert_allclose(-same.force(np.array([q]))[0], k * slope, rtol=rtol)
        run = solve(system, "verlet", (0, 1e-9), dt=1e-9, params={"k": k, "c": k})
        np.testing.assert_allclose(-run.p[0, -1] / 1e-9, k * slope, rtol=1e-6)
        with pytest.raises(ValueError, match=r"^`bond` has terms that cancel .* write these values as numbers"):
            HamiltonianSystem.lattice(shape=3, bond=V.replace("q", "r"), params={"k": k, "c": k})
        with pytest.raises(ValueError, match=r"^`potential` has terms that cancel"):
            HamiltonianSystem.pairs(V.replace("q", "r"), masses=[1, 1], dim=1, params={"k": k, "c": k})


@pytest.mark.parametrize("r", [0.0, 1e-9, 1e-3, 0.3])
def test_bonds_and_pairs_have_forces_where_parts_of_V_are_infinite(r):
    """V = k tanh(r)/r, V′ ≈ −2kr/3 + 8kr³/15."""
    systems = [
        HamiltonianSystem.lattice(shape=2, bond="k*tanh(r)/r", boundary="free", params={"k": 1.3}),
        HamiltonianSystem.pairs("k*tanh(r)/r", masses=[1, 1], dim=1, params={"k": 1.3}),
    ]
    with mpmath.workdps(60):
        slope = float(mpmath.diff(lambda x: 1.3 * mpmath.tanh(x) / x, mpmath.mpf(r) or mpmath.mpf(10) ** -20))
    for system in systems:
        np.testing.assert_allclose(-system.force(np.array([0.0, r]))[1], slope, rtol=1e-14, atol=1e-19)


@pytest.mark.parametrize("n", range(4))
def test_derivatives_of_sinc_have_their_values_on_both_sides_of_where_its_series_ends(n):
    x = np.concatenate([np.linspace(-4, 4, 41), [1.9999999, 2.0000001, 30.0, -1e3]])
    s = sp.Symbol("s", real=True)
    with mpmath.workdps(40):
        exact = sp.lambdify(s, sp.diff(sp.sin(s) / s, s, n), "mpmath")
        right = [float(exact(mpmath.mpf(v))) if v else [1, 0, -1 / 3, 0][n] for v in x.tolist()]
    f = sp.lambdify(s, with_own_functions(sp.sinc(s)).diff(s, n), "numpy")
    np.testing.assert_allclose(f(x), right, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("V", ["sinc(q)", "sin(k*q)/q - q**2", "q*csch(q)"])
@pytest.mark.parametrize("method", ["verlet", "srkn11b", "gauss_legendre4"])
def test_compiled_runs_through_a_place_where_parts_are_infinite(V, method):
    runs = [solve(of_removable(V), method, (0, 3), [0.0, 0.7], dt=0.1, backend=each) for each in ("compiled", "array")]
    np.testing.assert_allclose(runs[0].y, runs[1].y, rtol=1e-12, atol=1e-13)


def nested(choices):
    """Max and Min in each other, fourteen deep, as text."""
    text = "q"
    for k in range(7):
        text = (
            f"{choices[1]}({choices[0]}({text} + 0.2*q, {choices[1]}(q - {k}, -q)) - 0.1, -{choices[0]}(p, {k + 1}*q))"
        )
    return text


@pytest.mark.parametrize(
    "text", [nested(("Min", "Max")), nested(("Max", "Min")), "Max(q, -p, q + p/2, Min(q, 1), 0.3)"]
)
def test_extremes_have_the_values_and_slopes_of_arrays(text):
    """SymPy compares each argument with all others: of nested ones that takes minutes."""
    f, x = read(text), np.random.default_rng(0).uniform(-2, 2, (2, 200))
    own = {"Max": lambda *a: np.max(np.broadcast_arrays(*a), 0), "Min": lambda *a: np.min(np.broadcast_arrays(*a), 0)}
    expected = eval(text, own | {"q": x[0], "p": x[1]})
    np.testing.assert_array_equal(sp.lambdify((q, p), f, "numpy")(*x), expected)
    moved = [eval(text, own | {"q": x[0] + h, "p": x[1]}) for h in (-1e-7, 1e-7)]
    slope = sp.lambdify((q, p), sp.diff(f, q), [{"Heaviside": np.heaviside}, "numpy"])(*x)
    np.testing.assert_allclose(slope, (moved[1] - moved[0]) / 2e-7, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "expected"), [("Max(3, q, 5)", Max(5, q)), ("Min(q**2, -1)", -1), ("Max(q**2, 0)", q**2), ("Max(q, q)", q)]
)
def test_extremes_of_numbers_are_taken(text, expected):
    assert read(text) == expected


def test_ninety_pieces_and_a_sum_to_a_high_power():
    pieces = ", ".join(f"({k}*q - {k * (k - 1) / 2}, q < {k})" for k in range(1, 91))
    system = HamiltonianSystem.from_sympy(f"p**2/2 + Piecewise({pieces}, (91*q - 4095, True))", y0=[0.0, 0.0])
    at = np.array([[-0.5], [0.5], [41.5], [95.0]])
    np.testing.assert_array_equal(system.force(at)[:, 0], [-1, -1, -42, -91])
    assert not HamiltonianSystem.from_sympy("(1 + q + p)**300").separable
    assert HamiltonianSystem.from_sympy("(q + p)**2 - 2*q*p").separable
