"""Runs cut in pieces: with a carry they give the same bits as in one piece."""

import numpy as np
import pytest

from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.contract import Problem
from sympflow.integrators.registry import build
from sympflow.kernels.protocol import RunCheckpoint
from sympflow.systems import henon_heiles

SYSTEM = henon_heiles()
DAMPED = HamiltonianSystem.from_sympy("p**2/2 - cos(q)", damping=0.1, y0=[1.0, 0.3], dt=0.1)
N_STEPS, CUTS = 1500, [1, 2, 700, 1100, 1500]
CASES = [
    (SYSTEM, "verlet", {}),
    (SYSTEM, "kahan_li8", {"compensated": True}),
    (SYSTEM, "sympflow", {}),
    (SYSTEM, "linear_srkn11b", {}),
    (SYSTEM, "tao4", {}),
    (SYSTEM, "gauss_legendre4", {"compensated": True}),
    (DAMPED, "kahan_li6", {}),
]


def in_pieces(run, h, y0, save):
    carry, states, before = RunCheckpoint(), [], -1
    for cut in CUTS:
        piece = run(h, y0, cut, save[(save > before) & (save <= cut)], carry=carry)
        states.append(piece.states)
        before = cut
        assert carry.steps == cut
    return np.concatenate(states, axis=y0.ndim - 1), piece.n_finite


@pytest.mark.parametrize(("system", "method", "options"), CASES, ids=lambda case: case if isinstance(case, str) else "")
def test_pieces_of_a_run_are_the_run(system, method, options):
    integrator = build(method, dict(options)).resolved(system, system.y0, 100.0)
    y0 = np.tile(system.y0, 2) if method == "tao4" else system.y0
    many = y0 + 0.02 * np.random.default_rng(0).standard_normal((70, len(y0)))
    kernel, h = integrator.own_stepper(Problem(system, 0.0, 1.0, y0)).kernel, integrator.step_length(system)
    for start, save in (
        (y0, np.arange(0, N_STEPS + 1, 7)),
        (many, np.array([0, 1, 3, 900, N_STEPS])),
        (many[:1], np.array([N_STEPS])),
    ):
        whole = kernel.run(h, start, N_STEPS, save)
        states, n_finite = in_pieces(kernel.run, h, start, save)
        np.testing.assert_array_equal(states, whole.states)
        np.testing.assert_array_equal(n_finite, whole.n_finite)


def test_what_has_ended_stays_ended():
    """The pieces after the one in which a trajectory is lost hold NaN, in single runs and in lanes."""
    system = HamiltonianSystem.from_sympy("p**2/2 - q**4/4")
    kernel = build("verlet", {"dt": 0.1}).own_stepper(Problem(system, 0.0, 1.0, np.ones(2))).kernel
    y0, save = np.array([[1.0, 1.0], [1e-3, 0.0]]), np.array([200])
    for start in (y0[0], y0):
        whole, carry = kernel.run(0.1, start, 200, save), RunCheckpoint()
        first = kernel.run(0.1, start, 100, save[:0], carry=carry)
        then = kernel.run(0.1, start, 200, save, carry=carry)
        np.testing.assert_array_equal(np.where(np.less(first.n_finite, 100), first.n_finite, 200), whole.n_finite)
        np.testing.assert_array_equal(then.states, whole.states)
