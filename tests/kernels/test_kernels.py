"""The splitting kernel against plain NumPy loops, and what it promises about saves, blow-ups, lanes and caches."""

import numpy as np
import pytest
from conftest import FULL_MASS_MATRIX, RELATIVISTIC
from numba import njit

from sympflow.compiler.machine import compiled
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.protocol import RunCheckpoint
from sympflow.kernels.splitting_loops import splitting_loops
from sympflow.schemes import SCHEMES, Scheme
from sympflow.systems import henon_heiles

VERLET, KAHAN_LI8 = SCHEMES["verlet"], SCHEMES["kahan_li8"]
EULER = Scheme("symplectic_euler", 1, (1.0,), (1.0,), (0.0,), "kick, then drift: nothing to merge")
DRIFT = Scheme("drift", None, (0.0,), (1.0,), (0.0,), "")
PRIMED = Scheme("primed", None, (0.4, 0.6, 0.1), (0.5, 0.5, 0.0), (0.01, 0.0, 0.02), "", nystrom=True)


def plain_run(system, scheme, h, y0, n_steps):
    """Every state of a run, by NumPy, nothing merged: (n_steps + 1, ..., 2d)."""
    d, states = system.ndof, [np.array(y0, dtype=float)]
    for _ in range(n_steps):
        q, p = states[-1][..., :d], states[-1][..., d:]
        for b, g, a in zip(scheme.kicks, scheme.gradients, scheme.drifts, strict=True):
            F = system.force(q)
            p = p + b * h * F
            if g:
                p = p - g * h**3 * (system.potential_hessian(q) @ system.velocity(F)[..., None])[..., 0]
            q = q + a * h * system.velocity(p)
        states.append(np.concatenate([q, p], axis=-1))
    return np.array(states)


@njit
def chain_potential(q):
    V = q[0] ** 4 / 4
    for i in range(len(q) - 1):
        V += (q[i + 1] - q[i]) ** 2 / 2 + (q[i + 1] - q[i]) ** 4 / 4
    return V


@njit
def chain_gradient(q, out):
    out[:] = 0.0
    out[0] = q[0] ** 3
    for i in range(len(q) - 1):
        r = q[i + 1] - q[i]
        out[i] -= r + r**3
        out[i + 1] += r + r**3


@njit
def chain_hessian_vector(q, v, out):
    out[:] = 0.0
    out[0] = 3 * q[0] ** 2 * v[0]
    for i in range(len(q) - 1):
        w = (1 + 3 * (q[i + 1] - q[i]) ** 2) * (v[i + 1] - v[i])
        out[i] -= w
        out[i + 1] += w


MASS = np.array([[2.0, 0.3, 0.0], [0.3, 1.0, 0.2], [0.0, 0.2, 1.5]])


def numba_chain(mass=MASS):
    return HamiltonianSystem(
        potential=chain_potential,
        gradient=chain_gradient,
        hessian_vector=chain_hessian_vector,
        mass=mass,
        ndof=3,
        y0=[0.3, -0.2, 0.1, 0.0, 0.4, -0.1],
    )


@pytest.fixture(scope="module")
def systems():
    """Built once: a kernel belongs to a system."""
    return {
        "henon_heiles": henon_heiles(),
        "pendulum": HamiltonianSystem.from_sympy("p**2/2 - cos(q)", y0=[1.0, 0.3]),
        "numba_chain": numba_chain(),
        "full mass matrix": HamiltonianSystem.from_sympy(FULL_MASS_MATRIX, y0=[0.3, -0.2, 0.0, 0.4]),
        "relativistic": HamiltonianSystem.from_sympy(RELATIVISTIC, y0=[0.5, 0.4]),
        "kepler": HamiltonianSystem.from_sympy("(p1**2 + p2**2)/2 - 1/sqrt(q1**2 + q2**2)", y0=[1.0, 0.0, 0.0, 0.9]),
    }


# --- agreement ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "scheme", "h"),
    [
        *(("henon_heiles", s, 0.1) for s in [*SCHEMES.values(), EULER, DRIFT, PRIMED]),
        *(("numba_chain", s, -0.1) for s in [*SCHEMES.values(), EULER, DRIFT, PRIMED]),
        *((name, KAHAN_LI8, h) for name in ("pendulum", "relativistic", "kepler") for h in (0.1, -0.1)),
        ("full mass matrix", SCHEMES["omelyan6"], 0.1),
    ],
    ids=lambda x: getattr(x, "name", x),
)
def test_kernel_agrees_with_numpy(systems, name, scheme, h):
    system = systems[name]
    expected = plain_run(system, scheme, h, system.y0, 40)
    loops = splitting_loops(system)
    Y, n_finite, _ = loops.kernel(scheme).run(h, system.y0, 40, np.arange(41))
    assert n_finite == 40
    assert np.abs(Y - expected).max() < 2e-14 * len(scheme.kicks) ** 0.5
    y = loops.kernel(scheme).step([h, h / 3], np.array([system.y0, system.y0])).states
    assert np.abs(y[0] - expected[1]).max() < 2e-15
    assert np.abs(y[1] - plain_run(system, scheme, h / 3, system.y0, 1)[1]).max() < 2e-15


# --- parameters -----------------------------------------------------------------------------------------------


# --- saves ----------------------------------------------------------------------------------------------------


# --- non-finite states ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def runaway():
    """q'' = q³ from rest doubles its digits every few steps once large: it overflows at a definite step."""
    return HamiltonianSystem.from_sympy("p**2/2 - q**4/4", y0=[1.0, 0.0])


@pytest.mark.parametrize("scheme", [VERLET, SCHEMES["leapfrog"], EULER, KAHAN_LI8], ids=lambda s: s.name)
@pytest.mark.parametrize("stride", [1, 7, 1000])
def test_the_last_finite_step_is_exact(runaway, scheme, stride):
    h, n_steps = 0.005, 2000
    with np.errstate(all="ignore"):
        expected = plain_run(runaway, scheme, h, runaway.y0, n_steps)
    finite = np.isfinite(expected).all(axis=1)
    last = finite.argmin() - 1
    assert not finite[last + 1 :].any()
    save = np.arange(0, n_steps + 1, stride)
    Y, n_finite, _ = splitting_loops(runaway).kernel(scheme).run(h, runaway.y0, n_steps, save)
    assert n_finite == last
    assert np.isfinite(Y[save <= last]).all()
    assert np.isnan(Y[save > last]).all()


def test_a_lane_that_overflows_leaves_the_others_unharmed(runaway):
    loops, save = splitting_loops(runaway), np.array([0, 100, 400])
    y0 = np.array([[1.0, 0.0], [1e-3, 0.0], [1e308, 0.0], [5e-324, 5e-324], [0.1, 0.0]])
    Y, n_finite, _ = loops.kernel(VERLET).run(0.01, y0, 400, save)
    singles = [loops.kernel(VERLET).run(0.01, y, 400, save) for y in y0]
    assert n_finite.tolist() == [run.n_finite for run in singles]
    assert n_finite[0] < 400
    assert n_finite[2] == 0
    assert (n_finite[[1, 3, 4]] == 400).all()
    for i, (single, n, _) in enumerate(singles):
        assert np.array_equal(np.isnan(Y[i]), np.isnan(single))
        rows = save <= n
        np.testing.assert_allclose(Y[i][rows], single[rows], rtol=1e-11, atol=0)


# --- what cannot be compiled -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("system", "message"),
    [
        (lambda: HamiltonianSystem.from_sympy(RELATIVISTIC), "`scheme` has force gradients"),
        (lambda: HamiltonianSystem.from_sympy("p**2*q**2/2 + q**2"), "`system` is not separable"),
        (lambda: HamiltonianSystem.from_sympy("p**2/2 + airyai(q)"), "no compiled function"),
        (
            lambda: HamiltonianSystem(potential=lambda q: np.median(q, axis=-1), ndof=1),
            r"`system` cannot be compiled, .*: numpy\.median has no rule",
        ),
    ],
)
def test_refusals(system, message):
    with pytest.raises(ValueError, match=message):
        splitting_loops(system()).kernel(SCHEMES["chin4a"])


@pytest.mark.parametrize("scheme", [VERLET, SCHEMES["leapfrog"], EULER], ids=lambda s: s.name)
@pytest.mark.parametrize("save", [[], [0], [0, 0, 5, 5], [1, 2, 3, 700], [999], [1000], [0, 255, 256, 257, 512]])
def test_saving_never_changes_the_trajectory(systems, scheme, save):
    system = systems["henon_heiles"]
    loops, save = splitting_loops(system), np.array(save, dtype=np.int64)
    every, *_ = loops.kernel(scheme).run(0.1, system.y0, 1000, np.arange(1001))
    some, n_finite, _ = loops.kernel(scheme).run(0.1, system.y0, 1000, save)
    assert n_finite == 1000
    assert np.array_equal(some, every[save])


def test_runs_without_outputs_or_steps_reach_their_end(systems):
    kernel, y0, carry = splitting_loops(systems["henon_heiles"]).kernel(VERLET), np.full((37, 4), 0.1), RunCheckpoint()
    run = kernel.run(0.1, y0, 50, np.zeros(0, int), carry)
    assert (run.n_finite == 50).all()
    assert np.isfinite(carry.running).all()
    Y, n_finite, _ = kernel.run(0.1, y0, 0, np.array([0]))
    assert np.array_equal(Y, y0[:, None])
    assert not n_finite.any()


PARAMETERS = {"m": 1.5, "M": 0.7, "w": 1.3, "lam": 0.9}, {"m": 0.8, "M": 2, "w": 0.9, "lam": -0.4}


@pytest.fixture
def texts(monkeypatch):
    """The texts that functions are made of, as they are asked for."""
    found = []

    def spy(text, *rest):
        found.append(text)
        return compiled(text, *rest)

    monkeypatch.setattr("sympflow.kernels.runs.compiled", spy)
    monkeypatch.setattr("sympflow.kernels.rollouts._CODES", {})
    return found


def with_parameters(**params):
    text = "p1**2/(2*m) + p2**2/(2*M) + w**2*(q1**2 + q2**2)/2 + lam*(q1**n*q2 - q2**3/3)"
    return HamiltonianSystem.from_sympy(text, params={"n": 2, **params}, y0=[0.1, 0.2, 0.3, -0.1])


@pytest.mark.parametrize("compensated", [False, True])
def test_other_values_of_parameters_need_no_other_code(texts, compensated):
    for i, params in enumerate(PARAMETERS):
        system = with_parameters(**params)
        kernel, save = splitting_loops(system).kernel(VERLET, compensated), np.array([0, 3, 40])
        y0 = system.y0 + 0.01 * np.arange(9)[:, None]
        found = kernel.run(0.1, y0[1], 40, save).states, kernel.run(0.1, y0, 40, save).states
        step = kernel.step(np.linspace(0.05, 0.1, 9), y0).states if not compensated else None
        assert bool(texts) == (i == 0)
        texts.clear()
        expected = plain_run(system, VERLET, 0.1, y0, 40).swapaxes(0, 1)[:, save]
        assert np.abs(found[0] - expected[1]).max() < 2e-14
        assert np.abs(found[1] - expected).max() < 2e-14
        if step is not None:
            assert np.abs(step[-1] - plain_run(system, VERLET, 0.1, y0[-1], 1)[-1]).max() < 2e-15
