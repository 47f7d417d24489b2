"""heyoka: adaptive Taylor series, compiled just in time; one trajectory, or as many as fit a vector register."""

from __future__ import annotations

from functools import cache, partial

import heyoka as hy
import numpy as np

from contenders.contender import Contender, Outputs, Work
from contenders.scene import Scene

Q1, Q2, P1, P2 = hy.make_vars("q1", "q2", "p1", "p2")
FIELD = [(Q1, P1), (Q2, P2), (P1, -Q1 - 2 * Q1 * Q2), (P2, -Q2 - Q1 * Q1 + Q2 * Q2)]
WIDTH = 2 * hy.recommended_simd_size()  # faster here than the recommended width, or than four times it


@cache
def scalar(tol: float) -> hy.taylor_adaptive:
    return hy.taylor_adaptive(FIELD, np.zeros(4), tol=tol)


@cache
def lanes(tol: float) -> hy.taylor_adaptive_batch:
    return hy.taylor_adaptive_batch(FIELD, np.zeros((4, WIDTH)), tol=tol)


def run_scalar(scene: Scene, tol: float, t_end: float) -> np.ndarray:
    integrator = scalar(tol)
    integrator.time = 0.0
    integrator.state[:] = scene.y0
    integrator.propagate_until(t_end)
    return integrator.state.copy()


def scalar_outputs(scene: Scene, tol: float, t_end: float) -> Outputs:
    integrator = scalar(tol)
    integrator.time = 0.0
    integrator.state[:] = scene.y0
    *_, n_steps, _, states = integrator.propagate_grid(np.append(0.0, scene.instants(t_end)))
    return Outputs(states[1:], states[-1], Work(n_steps, None, None))


def run_lanes(scene: Scene, tol: float, t_end: float) -> np.ndarray:
    integrator = lanes(tol)
    columns = whole_lanes(scene.batch).T
    final = np.empty_like(columns)
    for start in range(0, columns.shape[1], WIDTH):
        block = slice(start, start + WIDTH)
        integrator.set_time(0.0)
        integrator.state[:] = columns[:, block]
        integrator.propagate_until(t_end)
        final[:, block] = integrator.state
    return final.T[: scene.trajectories]


def lanes_outputs(scene: Scene, tol: float, t_end: float) -> Outputs:
    integrator = lanes(tol)
    sample = scene.sample(scene.trajectories)
    columns = whole_lanes(sample).T
    grid = np.repeat(np.append(0.0, scene.instants(t_end))[:, None], WIDTH, axis=1)
    blocks, steps = [], []
    for start in range(0, columns.shape[1], WIDTH):
        integrator.set_time(0.0)
        integrator.state[:] = columns[:, start : start + WIDTH]
        blocks.append(integrator.propagate_grid(grid)[-1][1:])
        steps += [n for *_, n in integrator.propagate_res]
    states = np.concatenate(blocks, axis=2)[:, :, : len(sample)].swapaxes(1, 2)
    return Outputs(states, states[-1], Work(round(float(np.median(steps))), None, None))


def whole_lanes(y0: np.ndarray) -> np.ndarray:
    """The states, the last one repeated up to a whole number of vectors."""
    return np.concatenate([y0, np.repeat(y0[-1:], -len(y0) % WIDTH, axis=0)])


def contenders(scene: Scene) -> list[Contender]:
    guesses = {1e-3: 3e-4, 1e-6: 1e-7, 1e-9: 1e-10, 1e-12: 1e-13}
    return [
        Contender(
            "Taylor, scalar",
            "heyoka",
            1,
            "tol",
            partial(run_scalar, scene),
            partial(scalar_outputs, scene),
            guesses=guesses,
        ),
        Contender(
            f"Taylor, SIMD batch of {WIDTH}",
            "heyoka",
            scene.trajectories,
            "tol",
            partial(run_lanes, scene),
            partial(lanes_outputs, scene),
            guesses=guesses,
        ),
    ]
