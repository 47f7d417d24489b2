"""Kicks as generated code: every shape gives the same momenta; the costs by which one is chosen."""

import math
import re

import numpy as np
import pytest
import sympy as sp

from sympflow import Box, SympFlow, systems
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.approximations import on_interval, position_ranges
from sympflow.kernels.codegen import printed
from sympflow.kernels.kicks import _by_products, _function, _scheduled, kicks_source, shapes
from sympflow.kernels.scheduling import ADD, FUSED, MULTIPLY, Schedule, nested
from sympflow.schemes import CURVATURE, FORCE_GRADIENT

SCENES = {
    "henon_heiles": systems.henon_heiles,
    "pendulum": systems.pendulum,
    "quartic": systems.quartic,
    "kepler": systems.kepler,
    "masses": lambda: HamiltonianSystem.from_sympy("p1**2 + p1*p2/3 + p2**2/5 + q1**4*q2**2 - q1*q2 + q2**6/7"),
    "one term": lambda: HamiltonianSystem.from_sympy("p**2/2 - q**4/4"),
    "roots": lambda: HamiltonianSystem.from_sympy("p**2/2 + sqrt(1 + q**2) - 1/(2 + q**2) + (3 + q)**1.5"),
    "constant force": lambda: HamiltonianSystem.from_sympy("(p1**2 + p2**2)/2 + q1 - 2*q2 + q2**3", y0=[0.0] * 4),
    "no force": lambda: HamiltonianSystem.from_sympy("(p1**2 + p2**2)/2 + q1**2", y0=[0.0] * 4),
    "kinks": lambda: HamiltonianSystem.from_sympy("p**2/2 + Abs(q)**3 + Piecewise((q**2, q > 0), (0, True))"),
}
ELEMENTARY = {
    "math": math,
    "fast_sin": math.sin,
    "fast_cos": math.cos,
    "fast_exp": math.exp,
    "fast_tanh": math.tanh,
    "fused_multiply_add": lambda a, b, c: a * b + c,
    "njit": lambda **_: lambda f: f,
    "OPTIONS": {},
}


@pytest.mark.parametrize(
    ("name", "terms"),
    [
        pytest.param(name, terms, marks=[pytest.mark.slow] * (terms == 3 and name in ("quartic", "masses")))
        for name in SCENES
        for terms in (1, 2, 3)
    ],
)
def test_every_shape_gives_the_same_momenta(name, terms):
    system = SCENES[name]()
    forms = list(shapes(system.symbols, terms))
    rewritten = name != "kinks" and (name, terms) != ("roots", 3)  # that one is too long
    assert len(forms) >= (3 if rewritten else 1)
    check_kicks(
        system,
        terms,
        [_scheduled(system.symbols, form, "s_", common) for form in forms for common in (True, False)],
    )


@pytest.mark.parametrize("terms", [1, 2, 3])
@pytest.mark.parametrize("name", [*SCENES, "bonds"])
def test_so_do_kicks_of_lanes_by_products(name, terms):
    system = RANGED[name][0]() if name == "bonds" else SCENES[name]()
    found = _by_products(system.symbols, terms, "s_")
    assert len(found) == (name != "kinks")
    check_kicks(system, terms, found)


@pytest.mark.parametrize("H", ["p**2/2 + (q - 50)**4/4", "p**2/2 + k*(q - a)**4"])
def test_powers_about_positions_far_from_0_are_not_multiplied_out(H):
    """So much cancels that a force gradient at q = 50.5 had errors of 1e-8."""
    values = {"k": 0.25, "a": 50.0} if "k" in H else {}
    symbols = HamiltonianSystem.from_sympy(H, params=values).symbols
    functions = dict(ELEMENTARY)
    exec(kicks_source(symbols, FORCE_GRADIENT), functions)
    q, p, numbers = 50.5, 0.2, (0.3, 0.02, *(values[s.name] for s in symbols.parameters))
    table = np.zeros((1, functions["N_COEFFICIENTS"]))
    functions["fill_coefficients"](numbers, table[0])
    expected = p - 0.3 * 0.5**3 + 0.02 * 3 * 0.5**5
    for found in (
        functions["gradient_kicked"]((q,), (p,), table, 0),
        functions["gradient_kicked_lane"]((q,), (p,), numbers),
    ):
        assert found[0] == pytest.approx(expected, rel=0, abs=1e-15)


def check_kicks(system, terms, kicks):
    """They give p − b∇V + g∇²V v − c∇(½ v·∇²V v), or as many of these terms."""
    symbols, d = system.symbols, system.ndof
    rng = np.random.default_rng(0)
    for kick in kicks:
        functions = dict(ELEMENTARY)
        lines = [*kick.coefficients, *kick.lines]
        exec(_function(symbols, "kick", "q, p, b, g, c", lines, kick.results), functions)
        for _ in range(5):
            q, p, (b, g, c) = rng.uniform(0.3, 1.2, d), rng.normal(size=d), rng.normal(size=3)
            F = system.force(q)
            expected = p + b * F
            if terms > 1:
                expected = expected - g * system.potential_hessian(q) @ system.velocity(F)
            if terms > 2:
                expected = expected - c * system.curvature_gradient(q)
            found = functions["kick"](q.tolist(), p.tolist(), float(b), float(g), float(c))
            np.testing.assert_allclose(found, expected, rtol=0, atol=3e-14 * (1 + np.abs(expected).max()))


@pytest.mark.parametrize(
    ("H", "most", "exponentials"),
    [
        ("p1**2/4 + p2**2 + 2*p1*p2/5 + (q1**2 + q2**2)/2 + 3*q1**2*q2/10 + (q1**4 + q2**4)/5", 21, 0),
        ("(p1**2 + p2**2)/2 + (1 - exp(-q1))**2 + (1 - exp(q1 - q2))**2", 24, 2),
    ],
)
def test_a_force_gradient_of_a_lane_takes_few_operations_and_no_function_of_the_library(H, most, exponentials):
    source = kicks_source(HamiltonianSystem.from_sympy(H).symbols, FORCE_GRADIENT)
    body = source.partition("def gradient_kicked_lane(")[2].partition("return")[0]
    operations = [line for line in body.splitlines() if re.search(r"= .*[qp]\d|= .*g_\d", line)]
    assert len(operations) <= most
    assert body.count("fast_exp(") == exponentials
    assert "math." not in source.partition("def kicked_lane(")[2].partition("return")[0] + body


RANGED = {
    "pendulum": (systems.pendulum, ((-2.7, 2.7),)),
    "well": (lambda: HamiltonianSystem.from_sympy("p**2/2 + sqrt(1 + q**2) + exp(-q)/3"), ((-0.4, 0.9),)),
    "bonds": (
        lambda: HamiltonianSystem.from_sympy(
            "p1**2/2 + p2**2/3 + (1 - exp(-q1))**2 + exp(q1/2 - 3*q2)/2 + tanh(q1 - q2) + q1**2*q2"
        ),
        ((-0.4, 0.9), (-0.3, 0.5)),
    ),
}


@pytest.mark.parametrize("level", [FORCE_GRADIENT, CURVATURE])
@pytest.mark.parametrize("name", RANGED)
def test_kicks_in_ranges_of_positions_are_the_same_but_for_rounding(name, level):
    """Kicks of a trajectory and of lanes, in the ranges and beyond."""
    make, ranges = RANGED[name]
    system = make()
    functions = ELEMENTARY | {"fast_exp": math.exp, "fast_tanh": math.tanh}
    exec(kicks_source(system.symbols, level, ranges=ranges), functions)
    rng = np.random.default_rng(2)
    low, high = np.transpose(ranges)
    numbers = rng.normal(size=level + 1) * [0.5, 0.05, 0.005][: level + 1]
    table = np.empty((1, functions["N_COEFFICIENTS"]))
    functions["fill_coefficients"](numbers, table[0])
    kind = {FORCE_GRADIENT: "gradient", CURVATURE: "curvature"}[level]
    inside, beyond = rng.uniform(low, high, (10, system.ndof)), rng.uniform(high, high + 0.3, (3, system.ndof))
    for q in (*inside, *beyond):
        p, F = rng.normal(size=system.ndof), system.force(q)
        expected = p + numbers[0] * F - numbers[1] * system.potential_hessian(q) @ system.velocity(F)
        if level == CURVATURE:
            expected = expected - numbers[2] * system.curvature_gradient(q)
        alone = functions[f"{kind}_kicked"](q, p, table, 0)
        lane = functions[f"{kind}_kicked_lane"](q, p, numbers)
        np.testing.assert_allclose(alone, expected, rtol=0, atol=1e-14 * np.abs(expected).max())
        np.testing.assert_allclose(lane, expected, rtol=0, atol=1e-14 * np.abs(expected).max())


MATRIX = HamiltonianSystem.from_sympy("3*p1**2/4 + p1*p2/2 + p2**2/3 + q1**4/4 + q1**2*q2**2/3 + q2**2/2")
JOINED = {
    "henon_heiles": (systems.henon_heiles(), ()),
    "quartic": (systems.quartic(), ()),
    "matrix": (MATRIX, ()),
    **{name: (make(), ranges) for name, (make, ranges) in RANGED.items()},
}


@pytest.mark.parametrize("level", [0, FORCE_GRADIENT, CURVATURE])
@pytest.mark.parametrize("name", JOINED)
def test_kicks_joined_with_drifts_are_the_same_but_for_rounding(name, level):
    system, ranges = JOINED[name]
    functions = ELEMENTARY | {"fast_exp": math.exp, "fast_tanh": math.tanh}
    source = kicks_source(system.symbols, level, ranges=ranges if level else (), joined=True)
    exec(source, functions)
    rng = np.random.default_rng(3)
    numbers = rng.normal(size=level + 1) * [0.5, 0.05, 0.005][: level + 1]
    table = np.empty((1, functions["N_COEFFICIENTS"]))
    functions["fill_coefficients"](numbers, table[0])
    kind = {0: "", FORCE_GRADIENT: "gradient_", CURVATURE: "curvature_"}[level]
    for q in rng.uniform(-0.4, 0.4, (5, system.ndof)) + np.array([[0.0]] * 4 + [[3.0 if ranges else 0.0]]):
        p, a = rng.normal(size=system.ndof), 0.3
        moved, kicked = functions[f"{kind}kicked_and_drifted"](q, p, table, 0, a)
        expected = functions[f"{kind}kicked_lane"](q, p, numbers)
        scale = np.abs(expected).max() + np.abs(q).max()
        np.testing.assert_allclose(kicked, expected, rtol=0, atol=1e-14 * scale)
        np.testing.assert_allclose(moved, functions["drifted"](q, expected, a), rtol=0, atol=1e-14 * scale)


def test_drifts_do_not_wait_for_the_kicks_that_they_are_joined_with():
    """Beside the old state, the new q is made of no new p: only products and sums that come before."""
    source = kicks_source(systems.henon_heiles().symbols, FORCE_GRADIENT, joined=True)
    body = source.partition("def gradient_kicked_and_drifted(")[2].partition("return ")
    q, p = body[2].splitlines()[0].strip("()").split(", ), (")
    made = {line.split(" = ")[0].strip(): line for line in body[0].splitlines() if " = " in line}
    for new in q.split(", "):
        assert not any(name in made[new] for name in p.rstrip(", )").split(", "))


def test_kinks_have_no_ranges():
    system = HamiltonianSystem.from_sympy("p**2/2 + Abs(q)", domain=Box([-1, -1], [1, 1]))
    assert position_ranges(system.symbols, system.domain) == ()
    assert "DiracDelta" not in kicks_source(system.symbols, FORCE_GRADIENT)


def test_functions_are_polynomials_where_few_powers_are_exact():
    x = sp.Symbol("x", real=True)
    sine = on_interval([sp.sin(x)], x, -2.5, 2.4)
    assert sine is not None
    assert (sine.low, sine.high, sine.center) == (-2.5, 2.5, 0.0)
    assert not sine.coefficients[0, ::2].any()  # odd
    at = np.linspace(-2.5, 2.5, 201)
    np.testing.assert_allclose(np.polyval(sine.coefficients[0, ::-1], at), np.sin(at), rtol=0, atol=2e-15)
    assert on_interval([sp.sin(40 * x)], x, -1.0, 1.0) is None  # too long
    assert on_interval([1 / x**2], x, 0.01, 1.0) is None
    assert on_interval([sp.log(x)], x, -1.0, 2.0) is None  # not defined everywhere


@pytest.mark.parametrize("name", SCENES)
def test_the_curvature_is_that_of_v_along_the_acceleration(name):
    """½ v·∇²V v, v = M⁻¹∇V, and its gradient by differences of it."""
    system = SCENES[name]()
    rng = np.random.default_rng(1)
    q = rng.uniform(0.3, 1.2, (5, system.ndof))
    v = -system.velocity(system.force(q))
    W = (v * system.hessian_vector(q, v)).sum(-1) / 2
    np.testing.assert_allclose(system.curvature(q), W, rtol=1e-13)
    h, e = 1e-6, np.eye(system.ndof)
    slope = np.stack([(system.curvature(q + h * d) - system.curvature(q - h * d)) / (2 * h) for d in e], axis=-1)
    np.testing.assert_allclose(system.curvature_gradient(q), slope, rtol=1e-7, atol=1e-7 * np.abs(W).max())


def test_a_sum_begins_with_what_is_known_first():
    x, y, c = sp.symbols("x y c", real=True)
    schedule = Schedule({x: 0.0, y: -20.0}, printed)
    time, name = schedule.value(y + c * x)
    assert time == FUSED
    assert schedule.lines == [f"{name} = y + c*x"]
    assert not schedule.early
    assert schedule.operations == 1


def test_coefficients_wait_for_nothing():
    x, b, g = sp.symbols("x b g", real=True)
    schedule = Schedule({x: 0.0}, printed)
    time, _ = schedule.value(sp.Mul(3 * b - g, x, evaluate=False))
    assert time == MULTIPLY
    assert len(schedule.early) >= 2
    assert len(schedule.lines) == 1


def test_long_sums_and_powers_are_split():
    names = sp.symbols("x_0:8", real=True)
    time, _ = Schedule(dict.fromkeys(names, 0.0), printed).value(sp.Add(*names))
    assert time < 7 * ADD
    time, _ = Schedule({names[0]: 0.0}, printed).value(names[0] ** 8)
    assert time == 3 * MULTIPLY


def test_nested_forms_end_with_what_is_known_last():
    x, y, p, a, b, c = sp.symbols("x y p a b c", real=True)
    terms = [a * y, -b * y**2, b * x**2, c * x**2 * y, c * y**3]
    form = nested(p, terms, {p: -FUSED, x: 0.0, y: 0.0})
    assert sp.expand(form - sp.Add(p, *terms)) == 0
    # p + x²(b + c y) + y(a + y(c y − b)): three levels, x² and p no later than these
    time, _ = Schedule({p: -FUSED, x: 0.0, y: 0.0}, printed).value(form)
    assert time == 3 * FUSED
    late = nested(p, [a * x, b * y], {p: -FUSED, x: 50.0, y: 0.0})
    assert Schedule({p: -FUSED, x: 50.0, y: 0.0}, printed).value(late)[0] == 50.0 + FUSED


def test_one_trajectory_waits_for_the_longest_chain_or_for_units():
    """Two products start in each cycle: a chain of three takes as long as 18 of them beside one another."""
    x, y = sp.symbols("x y", real=True)
    schedule = Schedule({x: 0.0, y: 0.0}, printed)
    results = [schedule.value(x**8)[1]]
    assert schedule.cycles(results) == 3 * MULTIPLY
    assert schedule.operations == 3
    results += [schedule.value(sp.Mul(n, y, evaluate=False))[1] for n in range(2, 22)]
    assert schedule.cycles(results) == 23 / 2
    schedule.value(1 / x)
    schedule.value(1 / y)
    schedule.value(1 / (x + y))
    assert schedule.cycles(results) == 15.0


def test_the_flow_steps_every_row_by_its_own_time():
    system = systems.henon_heiles()
    flow = SympFlow.primed(system, 2, dt=0.6, processor=2)
    rng = np.random.default_rng(1)
    for parameter in flow.parameters():
        parameter.data += 0.02 * (parameter.data + 0.5)
    kernel = flow.kernel_for(system)
    y = system.y0 + rng.uniform(-0.05, 0.05, (40, 4))
    h = rng.uniform(0.05, 0.6, 40) * np.where(np.arange(40) % 3, 1.0, -1.0)
    h[7] = 0.0
    together = kernel.step(h, y).states
    assert np.array_equal(together[7], y[7])
    apart = np.concatenate([kernel.step(h[i : i + 1], y[i : i + 1]).states for i in range(40)])
    assert np.abs(together - apart).max() < 1e-14
    assert np.abs(together - y).max() > 1e-3
    assert np.abs(kernel.step(-h, together).states - y).max() < 1e-13
    with pytest.raises(ValueError, match="`t` must lie in"):
        kernel.step(np.linspace(0.1, 0.7, 40), y)


def test_tables_follow_the_weights():
    system = systems.henon_heiles()
    flow = SympFlow.primed(system, 2, dt=0.6)
    before, *_ = flow.kernel_for(system).run(0.6, system.y0, 10, np.array([10]))
    flow.drifts.free.data.add_(0.01)
    flow.kicks.free.data = flow.kicks.free.data * 1.02
    after, *_ = flow.kernel_for(system).run(0.6, system.y0, 10, np.array([10]))
    expected = system.y0
    for _ in range(10):
        expected = flow.kernel_for(system).step(np.array([0.6]), expected[None]).states[0]
    assert np.abs(after - before).max() > 1e-4
    assert np.abs(after[0] - expected).max() < 1e-13


def test_the_curvature_without_symbols():
    """By automatic differentiation of tensors, and by differences of arrays and of Numba functions."""
    import torch
    from numba import njit

    plain = HamiltonianSystem(potential=lambda q: (q**4).sum(-1) / 4 + q[..., 0] * q[..., 1] ** 2, ndof=2)

    @njit
    def potential(q):
        return (q[0] ** 4 + q[1] ** 4) / 4 + q[0] * q[1] ** 2

    @njit
    def gradient(q, out):
        out[0], out[1] = q[0] ** 3 + q[1] ** 2, q[1] ** 3 + 2 * q[0] * q[1]

    @njit
    def product(q, v, out):
        out[0] = 3 * q[0] ** 2 * v[0] + 2 * q[1] * v[1]
        out[1] = 2 * q[1] * v[0] + (3 * q[1] ** 2 + 2 * q[0]) * v[1]

    compiled = HamiltonianSystem(potential=potential, gradient=gradient, hessian_vector=product, ndof=2)
    symbolic = HamiltonianSystem.from_sympy("p1**2/2 + p2**2/2 + (q1**4 + q2**4)/4 + q1*q2**2")
    q = np.random.default_rng(2).normal(size=(5, 2))
    W, expected = symbolic.curvature(q), symbolic.curvature_gradient(q)
    for system in (plain, compiled):
        for x, accuracy in ((torch.as_tensor(q), 1e-13 if system is plain else 1e-9), (q, 1e-9)):
            np.testing.assert_allclose(np.asarray(system.curvature(x)), W, rtol=1e-12)
            found = np.asarray(system.curvature_gradient(x).detach() if x is not q else system.curvature_gradient(x))
            np.testing.assert_allclose(found, expected, rtol=accuracy, atol=accuracy * np.abs(expected).max())
        assert system.curvature_gradient(q[:0]).shape == (0, 2)
