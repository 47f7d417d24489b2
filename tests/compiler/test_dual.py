"""Dual numbers: their rates are the tangents of programs, and those that torch finds."""

import numpy as np
import pytest
import torch

from sympflow.compiler.dual import Dual
from sympflow.compiler.functions import apply, fma, where
from sympflow.compiler.program import Program, fused, tangent, traced

FORMULAS = {
    "products": lambda x, y: x * y + 2.0 * x - y,
    "quotients": lambda x, y: (x - y) / (1.0 + x * x) - 3.0 / y,
    "fused": lambda x, y: fma(x, y, fma(2.0, y, x)) - fma(x, 3.0, 1.0),
    "powers": lambda x, y: x**3 + y**-0.5,
    "functions": lambda x, y: apply("tanh", x * apply("sin", y)) + apply("log", y),
    "cases": lambda x, y: where(x < y, x * y, apply("max", x, 0.2) - y),
}


@pytest.mark.parametrize("name", FORMULAS)
def test_rates_are_tangents(name):
    f, rng = FORMULAS[name], np.random.default_rng(0)
    x, y, dx, dy = rng.uniform(0.2, 1.5, (4, 9))
    found = f(Dual(x, dx), Dual(y, dy))
    program = traced(lambda *v: [f(*v)], "x", "y")
    z, w = program.inputs[0].recording.input("z"), program.inputs[0].recording.input("w")
    moved = Program([*program.inputs, z, w], tangent(program.outputs, program.inputs, [z, w]))
    np.testing.assert_allclose(found.value, f(x, y), rtol=1e-14)
    np.testing.assert_allclose(found.rate, moved(x, y, dx, dy)[0], rtol=1e-13)
    np.testing.assert_allclose(f(Dual(x, dx), y).rate, moved(x, y, dx, 0.0 * y)[0], rtol=1e-13)
    given = [tuple(map(torch.tensor, pair)) for pair in ((x, y), (dx, dy))]
    np.testing.assert_allclose(found.rate, torch.func.jvp(f, *given)[1], rtol=1e-13)


@pytest.mark.parametrize("name", FORMULAS)
def test_fused_programs_give_the_same_with_fewer_operations(name):
    program = traced(lambda *v: [FORMULAS[name](*v)], "x", "y")
    joined = fused(program)
    values = np.random.default_rng(1).uniform(0.2, 1.5, (2, 9))
    np.testing.assert_allclose(joined(*values)[0], program(*values)[0], rtol=1e-14)
    assert len(joined) <= len(program) + sum(x.name == "neg" for x in joined.operations)
