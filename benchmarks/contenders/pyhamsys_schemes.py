"""pyhamsys: splitting schemes that step in NumPy, one trajectory or a whole batch at a time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from pyhamsys import Parameters, solve_ivp_symp

from contenders.contender import Contender, Outputs, Scene, Work, whole_steps
from contenders.runge_kutta import first_after

FORCES = {"BM4": 6, "RKN6b": 11}


def force(q: np.ndarray) -> np.ndarray:
    return np.stack([-q[0] - 2 * q[0] * q[1], -q[1] - q[0] * q[0] + q[1] * q[1]])


def drift_then_kick(h: float, t: float, y: np.ndarray) -> np.ndarray:
    q = y[:2] + h * y[2:]
    return np.concatenate([q, y[2:] + h * force(q)])


def kick_then_drift(h: float, t: float, y: np.ndarray) -> np.ndarray:
    p = y[2:] + h * force(y[:2])
    return np.concatenate([y[:2] + h * p, p])


def integrate(
    y0: np.ndarray, method: str, n: int, t_end: float, see: Callable[[float, np.ndarray], None] | None = None
) -> np.ndarray:
    """The states at t_end after n steps; `see` is told the time and the state (4, ...) of each."""
    # with two outputs it takes one step more than fit the interval
    how = Parameters(solver=method, step=t_end / (n - 1.5), display=False)
    ends = np.array([0.0, t_end])
    return solve_ivp_symp(kick_then_drift, drift_then_kick, ends, y0.T, ends, how, see).y[..., -1].T


def run(scene: Scene, method: str, trajectories: int, dt: float, t_end: float) -> np.ndarray:
    return integrate(scene.start(trajectories), method, whole_steps(t_end, dt), t_end)


def outputs(scene: Scene, method: str, trajectories: int, dt: float, t_end: float) -> Outputs:
    n, y0 = whole_steps(t_end, dt), scene.sample(trajectories)
    steps: list[np.ndarray] = []
    integrate(y0, method, n, t_end, lambda t, y: steps.append(y.T))
    assert len(steps) == n + 1
    at = first_after(np.linspace(0.0, t_end, n + 1), scene.instants(t_end))
    return Outputs(np.array(steps)[at], steps[-1], Work(n, FORCES[method] * n))


def contenders(scene: Scene) -> list[Contender]:
    guesses = {
        "BM4": {1e-3: 1.1, 1e-6: 0.204, 1e-9: 0.0364},
        "RKN6b": {1e-3: 1.69, 1e-6: 0.84, 1e-9: 0.32},
    }
    return [
        Contender(
            method,
            "pyhamsys",
            n,
            "dt",
            partial(run, scene, method, n),
            partial(outputs, scene, method, n),
            guesses=guesses[method],
            order=4.0 if method == "BM4" else 6.0,
            window=0.5,
        )
        for n in (1, scene.trajectories)
        for method in guesses
    ]
