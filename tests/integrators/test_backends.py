"""Compiled and array results agree to rounding; the choice is reported, can be forced, and explains itself."""

import numpy as np
import pytest
import torch

from sympflow import HamiltonianSystem, solve, systems
from sympflow.compiler import NotCompiled
from sympflow.integrators.loops import compiled_loops
from sympflow.schemes import SCHEMES

HH = systems.henon_heiles()
PLAIN = HamiltonianSystem(lambda q: np.median(q, axis=-1) ** 4, ndof=1, y0=[1.0, 0.0], gradient=lambda q: 4 * q**3)
TRACED = HamiltonianSystem(lambda q: (q**4).sum(-1), ndof=1, y0=[1.0, 0.0])
AIRY = HamiltonianSystem.from_sympy("p**2/2 - airyai(q)", y0=[1.0, 0.0])


@pytest.mark.parametrize(
    ("system", "arguments", "backend"),
    [
        (HH, {}, "compiled"),
        (HH, {"dtype": "float32"}, "numpy"),
        (HH, {"y0": torch.tensor(HH.y0)}, "compiled"),
        (HH, {"y0": torch.tensor(HH.y0), "backend": "array"}, "torch"),
        (HH, {"backend": "array"}, "numpy"),
        (TRACED, {}, "compiled"),
        (PLAIN, {}, "numpy: `potential` could not be traced, because numpy.median has no rule"),
        (AIRY, {}, "numpy"),
    ],
)
def test_auto_chooses_what_applies(system, arguments, backend):
    assert solve(system, "verlet", (0.0, 1.0), **arguments).stats["backend"] == backend


@pytest.mark.parametrize("q", [1e12, 1e16, 1e18, 1e21, 1e100, 1e300])
def test_sines_of_far_states_stay_bounded(q):
    sol = solve(systems.pendulum(), "verlet", (0.0, 0.01), y0=[q, 0.0], dt=0.01)
    assert sol.status == 0
    assert abs(sol.p[0, -1]) <= 0.01 * (1 + 1e-15)  # |force| <= 1


@pytest.mark.parametrize("method", sorted(SCHEMES))
def test_evaluations_are_counted_as_they_are_made(method):
    calls = {"force": 0, "hessian": 0}

    def gradient(q):
        calls["force"] += 1
        return q**3

    def hessian_vector(q, v):
        calls["hessian"] += 1
        return 3 * q**2 * v

    system = HamiltonianSystem(
        lambda q: (q**4).sum(-1) / 4, gradient=gradient, hessian_vector=hessian_vector, ndof=1, check=False
    )
    sol = solve(system, method, (0.0, 1.0), y0=[1.0, 0.0], dt=0.1)
    assert sol.stats["force_evaluations"] == calls["force"]
    assert sol.stats["hessian_evaluations"] == calls["hessian"]


def test_only_an_error_that_says_so_means_array_operations():
    def refused():
        raise NotCompiled("`system` has no loops.")

    def broken():
        raise ValueError("a fault of the loops")

    assert compiled_loops(refused, np.zeros(2), "auto") is None
    with pytest.raises(ValueError, match="a fault"):
        compiled_loops(broken, np.zeros(2), "auto")
