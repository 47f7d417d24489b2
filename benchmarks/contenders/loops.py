"""Hand-written loops for Hénon–Heiles: in Numba, what a compiled splitting method can cost at best; in Python, in NumPy
and in torch as one writes them first.

The Numba loops are given everything that a careful author would: last and first kick merged, multiply-adds contracted,
no state kept; the batch in blocks that stay in the first-level cache, so that the loop over them becomes vector
instructions.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
from numba import njit

from contenders.contender import Contender, Scene, whole_steps
from sympflow.schemes import SCHEMES

OPTIONS = {"error_model": "numpy", "fastmath": {"contract"}}
LANES = 64


@njit(**OPTIONS)
def verlet(q1, q2, p1, p2, h, n):
    """n steps of kick–drift–kick Verlet."""
    p1 += 0.5 * h * (-q1 - 2 * q1 * q2)
    p2 += 0.5 * h * (-q2 - q1 * q1 + q2 * q2)
    for _ in range(n):
        q1 += h * p1
        q2 += h * p2
        p1 += h * (-q1 - 2 * q1 * q2)
        p2 += h * (-q2 - q1 * q1 + q2 * q2)
    p1 -= 0.5 * h * (-q1 - 2 * q1 * q2)
    p2 -= 0.5 * h * (-q2 - q1 * q1 + q2 * q2)
    return q1, q2, p1, p2


@njit(**OPTIONS)
def composition(q1, q2, p1, p2, n, first, drifts, kicks):
    """n steps of a drift-first composition, whose last drift and next first one are merged."""
    q1 += first * p1
    q2 += first * p2
    for _ in range(n):
        for j in range(len(kicks)):
            b, a = kicks[j], drifts[j]
            f1 = -q1 - 2 * q1 * q2
            f2 = -q2 - q1 * q1 + q2 * q2
            p1 += b * f1
            p2 += b * f2
            q1 += a * p1
            q2 += a * p2
    return q1 - first * p1, q2 - first * p2, p1, p2


@njit(**OPTIONS)
def verlet_batch(y0, h, n):
    """n Verlet steps from each row of y0 (N, 4), N a multiple of the block."""
    out = np.empty_like(y0)
    q1, q2, p1, p2 = np.empty(LANES), np.empty(LANES), np.empty(LANES), np.empty(LANES)
    for start in range(0, len(y0), LANES):
        for k in range(LANES):
            q1[k], q2[k], p1[k], p2[k] = y0[start + k]
            p1[k] += 0.5 * h * (-q1[k] - 2 * q1[k] * q2[k])
            p2[k] += 0.5 * h * (-q2[k] - q1[k] * q1[k] + q2[k] * q2[k])
        for _ in range(n):
            for k in range(LANES):
                x = q1[k] + h * p1[k]
                y = q2[k] + h * p2[k]
                q1[k] = x
                q2[k] = y
                p1[k] += h * (-x - 2 * x * y)
                p2[k] += h * (-y - x * x + y * y)
        for k in range(LANES):
            p1[k] -= 0.5 * h * (-q1[k] - 2 * q1[k] * q2[k])
            p2[k] -= 0.5 * h * (-q2[k] - q1[k] * q1[k] + q2[k] * q2[k])
            out[start + k, 0], out[start + k, 1], out[start + k, 2], out[start + k, 3] = q1[k], q2[k], p1[k], p2[k]
    return out


@njit(**OPTIONS)
def composition_batch(y0, n, first, drifts, kicks):
    """`composition` of each row of y0 (N, 4), N a multiple of the block."""
    out = np.empty_like(y0)
    q1, q2, p1, p2 = np.empty(LANES), np.empty(LANES), np.empty(LANES), np.empty(LANES)
    for start in range(0, len(y0), LANES):
        for k in range(LANES):
            q1[k], q2[k], p1[k], p2[k] = y0[start + k]
            q1[k] += first * p1[k]
            q2[k] += first * p2[k]
        for _ in range(n):
            for j in range(len(kicks)):
                b, a = kicks[j], drifts[j]
                for k in range(LANES):
                    x, y = q1[k], q2[k]
                    u = p1[k] + b * (-x - 2 * x * y)
                    v = p2[k] + b * (-y - x * x + y * y)
                    p1[k] = u
                    p2[k] = v
                    q1[k] = x + a * u
                    q2[k] = y + a * v
        for k in range(LANES):
            out[start + k, 0], out[start + k, 1] = q1[k] - first * p1[k], q2[k] - first * p2[k]
            out[start + k, 2], out[start + k, 3] = p1[k], p2[k]
    return out


def run_verlet(scene: Scene, trajectories: int, dt: float, t_end: float) -> np.ndarray:
    n = whole_steps(t_end, dt)
    if trajectories == 1:
        return np.array(verlet(*scene.y0.tolist(), t_end / n, n))
    return verlet_batch(whole_blocks(scene.batch), t_end / n, n)[:trajectories]


def run_kahan_li8(scene: Scene, trajectories: int, dt: float, t_end: float) -> np.ndarray:
    n = whole_steps(t_end, dt)
    first, drifts, kicks = composition_table("kahan_li8", t_end / n)
    if trajectories == 1:
        return np.array(composition(*scene.y0.tolist(), n, first, drifts, kicks))
    return composition_batch(whole_blocks(scene.batch), n, first, drifts, kicks)[:trajectories]


def composition_table(name: str, h: float) -> tuple[float, np.ndarray, np.ndarray]:
    """The first drift, and the drifts that follow the kicks, of a drift-first scheme run many times; times h."""
    substeps = [(kind, c) for kind, c, *_ in SCHEMES[name].substeps]
    drifts = h * np.array([c for kind, c in substeps if kind == "drift"])
    kicks = h * np.array([c for kind, c in substeps if kind == "kick"])
    assert substeps[0][0] == substeps[-1][0] == "drift"
    return drifts[0], np.append(drifts[1:-1], drifts[-1] + drifts[0]), kicks


def whole_blocks(y0: np.ndarray) -> np.ndarray:
    """The batch, its last row repeated up to a whole number of blocks."""
    return np.concatenate([y0, np.repeat(y0[-1:], -len(y0) % LANES, axis=0)])


def numpy_verlet(y0: np.ndarray, dt: float, t_end: float) -> np.ndarray:
    n = whole_steps(t_end, dt)
    h = t_end / n
    q, p = y0[..., :2], y0[..., 2:]
    f = numpy_force(q)
    for _ in range(n):
        p = p + 0.5 * h * f
        q = q + h * p
        f = numpy_force(q)
        p = p + 0.5 * h * f
    return np.concatenate([q, p], axis=-1)


def numpy_force(q: np.ndarray) -> np.ndarray:
    f = np.empty_like(q)
    q1, q2 = q[..., 0], q[..., 1]
    f[..., 0] = -q1 - 2 * q1 * q2
    f[..., 1] = -q2 - q1 * q1 + q2 * q2
    return f


@torch.inference_mode()
def torch_verlet(y0: torch.Tensor, dt: float, t_end: float) -> torch.Tensor:
    n = whole_steps(t_end, dt)
    h = t_end / n
    q, p = y0[..., :2], y0[..., 2:]
    f = torch_force(q)
    for _ in range(n):
        p = p + 0.5 * h * f
        q = q + h * p
        f = torch_force(q)
        p = p + 0.5 * h * f
    return torch.cat([q, p], dim=-1)


def torch_force(q: torch.Tensor) -> torch.Tensor:
    q1, q2 = q.unbind(-1)
    return torch.stack([-q1 - 2 * q1 * q2, -q2 - q1 * q1 + q2 * q2], dim=-1)


def contenders(scene: Scene) -> list[Contender]:
    """Verlet, written by hand in Numba, NumPy and torch: the very steps of our `verlet`."""
    loops = []
    for n in (1, scene.trajectories):
        y0 = scene.start(n)
        for label, package, run in [
            ("Verlet loop", "Numba", partial(run_verlet, scene, n)),
            ("Verlet loop", "NumPy", partial(numpy_verlet, y0)),
            ("Verlet loop, eager", "torch", partial(torch_verlet, torch.from_numpy(y0))),
        ]:
            loops.append(Contender(label, package, n, "dt", run, same_steps_as="verlet"))
    return loops
