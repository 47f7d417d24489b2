"""Adaptive Runge–Kutta methods that step in Python: SciPy's and torchdiffeq's."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.integrate import solve_ivp
from torchdiffeq import odeint

from contenders.contender import Contender, Outputs, Scene, Work
from contenders.loops import torch_force


def scalar_rhs(t: float, y: np.ndarray) -> list[float]:
    """J∇H as a user of SciPy would write it by hand."""
    q1, q2, p1, p2 = y
    return [p1, p2, -q1 - 2 * q1 * q2, -q2 - q1 * q1 + q2 * q2]


def first_after(times: np.ndarray, instants: np.ndarray) -> np.ndarray:
    """Indices of the first of `times` at or after each instant, or of the last of all."""
    return np.minimum(np.searchsorted(times, instants * (1 - 1e-14)), len(times) - 1)


def run_scipy(scene: Scene, rhs: Callable[..., Any], method: str, tol: float, t_end: float) -> Any:
    return solve_ivp(rhs, (0.0, t_end), scene.y0, method=method, rtol=tol, atol=tol)


def scipy_outputs(scene: Scene, rhs: Callable[..., Any], method: str, tol: float, t_end: float) -> Outputs:
    result = run_scipy(scene, rhs, method, tol, t_end)
    states = result.y.T[first_after(result.t, scene.instants(t_end))]
    return Outputs(states, result.y[:, -1], Work(result.t.size - 1, result.nfev))


class TorchRhs:
    """J∇H for torchdiffeq, which calls back with the state at the beginning of each accepted step."""

    def __init__(self) -> None:
        self.evaluations = 0
        self.times: list[float] = []
        self.states: list[torch.Tensor] = []

    def __call__(self, t: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        self.evaluations += 1
        return torch.cat([y[..., 2:], torch_force(y[..., :2])], dim=-1)


class RecordingTorchRhs(TorchRhs):
    def callback_accept_step(self, t: torch.Tensor, y: torch.Tensor, dt: torch.Tensor) -> None:
        self.times.append(float(t))
        self.states.append(y)


@torch.inference_mode()
def run_torchdiffeq(scene: Scene, method: str, tol: float, t_end: float, rhs: TorchRhs | None = None) -> torch.Tensor:
    y0, t = torch.from_numpy(scene.y0), torch.tensor([0.0, t_end], dtype=torch.float64)
    return odeint(TorchRhs() if rhs is None else rhs, y0, t, rtol=tol, atol=tol, method=method)[-1]


def torchdiffeq_outputs(scene: Scene, method: str, tol: float, t_end: float) -> Outputs:
    rhs = RecordingTorchRhs()
    final = run_torchdiffeq(scene, method, tol, t_end, rhs)
    at = first_after(np.array(rhs.times), scene.instants(t_end))
    return Outputs(torch.stack(rhs.states).numpy()[at], final.numpy(), Work(len(rhs.times), rhs.evaluations))


def contenders(scene: Scene) -> list[Contender]:
    scipy_guesses: dict[str, dict[float, float]] = {
        "RK45": {1e-3: 5e-7, 1e-6: 4.8e-10, 1e-9: 4.8e-13},
        "DOP853": {1e-3: 1.1e-6, 1e-6: 2.1e-9, 1e-9: 5.6e-12},
    }
    rows = [
        Contender(
            f"{method}, {kind} right-hand side",
            "SciPy",
            1,
            "tol",
            partial(run_scipy, scene, rhs, method),
            partial(scipy_outputs, scene, rhs, method),
            guesses=guesses,
        )
        for method, guesses in scipy_guesses.items()
        for kind, rhs in [("generated", scene.system), ("scalar", scalar_rhs)]
    ]
    torch_guesses: dict[str, dict[float, float]] = {
        "dopri5": {1e-3: 3e-7, 1e-6: 3e-10, 1e-9: 2.5e-13},
        "dopri8": {1e-3: 6e-7, 1e-6: 1.3e-9, 1e-9: 3e-12},
    }
    rows += [
        Contender(
            method,
            "torchdiffeq",
            1,
            "tol",
            partial(run_torchdiffeq, scene, method),
            partial(torchdiffeq_outputs, scene, method),
            guesses=guesses,
            window=0.5,
            short=(1e-9,) if method == "dopri5" else (),
        )
        for method, guesses in torch_guesses.items()
    ]
    return rows
