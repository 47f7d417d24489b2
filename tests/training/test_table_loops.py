"""The compiled errors of labels, beside those of arrays."""

import pickle

import numpy as np
import pytest

from sympflow import HamiltonianSystem
from sympflow.training.least_squares import _Factored
from sympflow.training.points import Labels
from sympflow.training.table_fit import TableFit
from sympflow.training.table_step import TableStep

SEQUENCE = ("kick", "drift") * 3 + ("kick",)
PLAIN = HamiltonianSystem.from_sympy(
    "p1**2/2 + p2**2 + p1*p2/5 + exp(q1)*cos(q2) + a*q1**2*q2**2 + tanh(q2)", params={"a": 0.7}
)
DRIVEN = "p**2/2 - cos(q)*(1 + a*cos(w*t))", {"time": "t", "params": {"a": 0.3, "w": 1.7}, "period": 2 * np.pi / 1.7}


def by_arrays(q):
    return (q**4).sum(-1) / 4 + np.cos(q[..., 0]) * q[..., 1]


def in_time(t, q):
    return (1 + 0.3 * np.cos(t)) * np.cos(q[..., 0])


CASES = {
    "curvature": (PLAIN, 2, ()),
    "polynomial": (PLAIN, 3, ((2, 0), (1, 1), (0, 4))),
    "driven": (HamiltonianSystem.from_sympy(DRIVEN[0], **DRIVEN[1]), 2, ()),
    "driven and damped": (HamiltonianSystem.from_sympy(DRIVEN[0], **DRIVEN[1], damping=0.3), 0, ()),
    "damped by a matrix": (
        HamiltonianSystem.from_sympy(
            "p1**2/(2*m) + p2**2 + q1**2 + q2**4/4 + q1*q2", params={"m": 0.8}, damping=[[0.3, 0.1], [0.1, 0.2]]
        ),
        1,
        (),
    ),
    "a traced function": (HamiltonianSystem(by_arrays, ndof=2), 1, ()),
    "a traced function of t": (HamiltonianSystem(in_time, ndof=1, time=True), 0, ()),
}


@pytest.fixture(scope="module", params=CASES)
def fits(request):
    """Fits of one system at two times to random labels: by arrays and compiled, without and with a weight of H."""
    system, level, of = CASES[request.param]
    d, rng = system.ndof, np.random.default_rng(0)
    states, times = 5 if level == 0 else 70, np.array([0.3, 0.5])  # fewer than lanes too
    t0 = None if system.autonomous else rng.uniform(0, 3, states)
    steps = [TableStep(system, SEQUENCE, level, of, compiled) for compiled in (False, True)]
    assert steps[1].loops is not None
    n, width = steps[0].n_coefficients, 2 * d + steps[0].balanced
    x, y = 0.5 * rng.normal(size=(states, 2 * d)), rng.normal(size=(2, states, width))
    work = y[..., 2 * d] if steps[0].balanced else None
    labels = Labels(times, x, y[..., : 2 * d], t0, work)
    offset, design = 0.1 * rng.normal(size=(2, n)), 0.1 * rng.normal(size=(2, n, 5))
    design[:, :, 2] = 0.0
    slope = rng.normal(size=(2, states, width))
    common = labels, offset, design, rng.uniform(1, 2, 2 * d), np.array([1.0, 3.0])
    fits = [TableFit(step, *common, of_energy) for of_energy in (None, slope) for step in steps]
    return fits, level in (0, 3)  # arrays take the third derivatives of V as differences


def test_errors_and_their_derivatives_are_those_of_arrays(fits):
    fits, exact = fits
    theta = np.random.default_rng(2).normal(size=5)
    for arrays, compiled in (fits[:2], fits[2:]):
        (r, J), (r_compiled, J_compiled) = arrays.linearized(theta), compiled.linearized(theta)
        np.testing.assert_allclose(r_compiled, r, atol=1e-12 * np.abs(r).max(), rtol=0)
        close = 1e-12 if exact else 1e-7
        assert (np.abs(J_compiled - J) <= close * np.abs(J).max(0)).all()
        h = 1e-4  # the differences are right to h⁴
        near, far = (
            np.stack([compiled.residuals(theta + s) - compiled.residuals(theta - s) for s in k * h * np.eye(5)], -1)
            for k in (1, 2)
        )
        np.testing.assert_allclose(J_compiled, (8 * near - far) / (12 * h), rtol=0, atol=1e-8 * np.abs(J).max())
        assert not J[:, 2].any()
        assert not J_compiled[:, 2].any()
        np.testing.assert_allclose(compiled.residuals(theta), r_compiled, atol=1e-12)
        for fit, found in ((arrays, (r, J)), (compiled, (r_compiled, J_compiled))):
            again = pickle.loads(pickle.dumps(fit)).linearized(theta)
            assert all(np.array_equal(a, b) for a, b in zip(again, found, strict=True))


def test_steps_are_those_of_arrays(fits):
    rng = np.random.default_rng(3)
    arrays, compiled = (fit.step for fit in fits[0][:2])
    c, y = 0.1 * rng.normal(size=(arrays.n_coefficients, 1)), 0.5 * rng.normal(size=(2 * arrays.ndof, 9))
    t0 = rng.uniform(0, 3, 9)  # of a driven system
    np.testing.assert_allclose(compiled(c, y, t0=t0), arrays(c, y, t0=t0), atol=1e-13)


def test_steps_by_blocks_of_a_jacobian_are_those_by_the_whole(fits):
    theta, compiled = np.random.default_rng(2).normal(size=5), fits[0][3]
    r, blocks = compiled.model(theta)
    assert blocks.matrices.shape[0] == 2
    linear = lambda x: r + blocks.whole() @ (x - theta)  # noqa: E731
    found = [
        (model.scale, *model.trial(1e-3))
        for residuals in (compiled.residuals, linear)
        for J in (blocks, blocks.whole())
        for model in [_Factored(theta, r, J, np.zeros(5), residuals)]
    ]
    for one, other in ((found[0], found[1]), (found[2], found[3])):
        for mine, theirs in zip(one, other, strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-9, atol=1e-12)
    J, D = blocks.whole(), np.diag(np.where(found[0][0] > 0, found[0][0], 1.0))
    exact = -np.linalg.lstsq(np.concatenate([J, 1e-3**0.5 * D]), np.append(r, np.zeros(5)), rcond=None)[0]
    np.testing.assert_allclose(found[2][1] - theta, exact, rtol=1e-9, atol=1e-12)
