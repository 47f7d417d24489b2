"""Verlet as one writes it first: a Python loop over NumPy arrays or torch tensors."""

from __future__ import annotations

from functools import partial

import numpy as np
import torch

from contenders.contender import Contender, whole_steps
from contenders.scene import Scene


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
    loops = []
    for n in (1, scene.trajectories):
        y0 = scene.start(n)
        for label, package, run in [
            ("Verlet loop", "NumPy", partial(numpy_verlet, y0)),
            ("Verlet loop, eager", "torch", partial(torch_verlet, torch.from_numpy(y0))),
        ]:
            loops.append(Contender(label, package, n, "dt", run, same_steps_as="verlet"))
    return loops
