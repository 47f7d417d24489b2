"""Kicks of compiled stages: those of arrays, in ranges of positions too; of flows by tables that follow weights."""

import numpy as np
import pytest

from sympflow import SympFlow, systems
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.splitting_loops import splitting_loops
from sympflow.kernels.stages import StageTable
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
EPS = np.finfo(float).eps


def kicked(system, level, numbers, y, ranges=None):
    """The states y (N, 2d) after one kick, each row by itself and all in lanes."""
    column = [0.0, *numbers, *[0.0] * (3 - len(numbers))]
    table = StageTable(level, np.array([[[x, 0.0, 0.0]] for x in column]))
    loops = splitting_loops(system)

    def step(rows):
        ones = np.ones(len(rows))
        return loops.step_rows(table, ones, ones, rows, ranges=ranges)

    together = step(y)
    assert np.array_equal(together, np.concatenate([step(row[None]) for row in y]))
    return together


def check(system, level, q, ranges=None):
    """Kicks are those of the system's own functions of arrays, but for rounding."""
    rng = np.random.default_rng(2)
    numbers, p = rng.normal(size=level + 1) * [0.5, 0.05, 0.005][: level + 1], rng.normal(size=q.shape)
    F = system.force(q)
    terms = [p, numbers[0] * F]
    if level >= FORCE_GRADIENT:
        terms.append(numbers[1] * system.hessian_vector(q, system.velocity(-F)))
    if level == CURVATURE:
        terms.append(-numbers[2] * system.curvature_gradient(q))
    found = kicked(system, level, numbers, np.concatenate([q, p], axis=1), ranges)
    assert np.array_equal(found[:, : system.ndof], q)
    assert np.abs(found[:, system.ndof :] - sum(terms)).max() < 64 * EPS * max(np.abs(term).max() for term in terms)


@pytest.mark.parametrize("level", [0, FORCE_GRADIENT, CURVATURE])
@pytest.mark.parametrize("name", SCENES)
def test_kicks_are_those_of_arrays(name, level):
    system = SCENES[name]()
    check(system, level, np.random.default_rng(0).uniform(0.3, 1.2, (19, system.ndof)))


@pytest.mark.parametrize("level", [FORCE_GRADIENT, CURVATURE])
@pytest.mark.parametrize(
    ("H", "low", "high"), [("p**2/2 - cos(q)", -2.7, 2.7), ("p**2/3 + sqrt(1 + q**2) + exp(-q)/3", -0.4, 0.9)]
)
def test_kicks_in_a_range_of_positions_are_the_same_but_for_rounding(H, low, high, level):
    """Rows in the range and beyond it, side by side in registers."""
    rng = np.random.default_rng(3)
    q = np.concatenate([rng.uniform(low, high, 30), rng.uniform(high, high + 0.3, 9)])
    check(HamiltonianSystem.from_sympy(H), level, rng.permutation(q)[:, None], ((low, high),))


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
