"""A SympFlow that is exact: the harmonic oscillator's rotation as three shears, without any training.

A new kind of potential is one small class; any list of layers is a SympFlow. Here kick(tan t/2) · drift(sin t) ·
kick(tan t/2), each with a potential w(t)·x²/2, is the rotation by t, for |t| < π.

    python examples/exact_rotation.py
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from sympflow import SympFlow, solve, systems
from sympflow.flow.layers import Drift, Kick
from sympflow.flow.potentials import Potential, Time, register_potential

FUNCTIONS: dict[str, Callable[[Tensor], Tensor]] = {"sin t": torch.sin, "tan t/2": lambda t: torch.tan(t / 2)}
"""w, of tensors."""


class Shear(Potential):
    """V(t, x) = c·w(t)·|x|²/2 with w(0) = 0: its impulse is c·w(t)·x.

    Parameters
    ----------
    function : str
        The name of w in `FUNCTIONS`.
    ndof : int
    """

    def __init__(self, function: str, ndof: int = 1) -> None:
        super().__init__()
        self.function, self.ndof = function, ndof
        self.w = FUNCTIONS[function]
        self.c = nn.Parameter(torch.ones((), dtype=torch.float64))

    def value(self, t: Time, x: Tensor) -> Tensor:
        return self.c * self.w(torch.as_tensor(t, dtype=x.dtype)) * (x * x).sum(0) / 2

    def impulse(self, t: Time, x: Tensor) -> Tensor:
        return self.c * self.w(torch.as_tensor(t, dtype=x.dtype)) * x

    def to_dict(self) -> dict[str, Any]:
        return {"type": "shear", "function": self.function}

    @classmethod
    def from_dict(cls, ndof: int, plan: Mapping[str, Any], dtype: torch.dtype) -> Shear:
        return cls(plan["function"], ndof).to(dtype)


register_potential("shear", Shear)  # files of flows with it can be read where this module is imported


def rotation(dt: float = 1.0) -> SympFlow:
    """The exact flow of (p² + q²)/2 for t ∈ [0, dt]."""
    flow = SympFlow.from_layers([Kick(Shear("tan t/2")), Drift(Shear("sin t")), Kick(Shear("tan t/2"))], dt=dt)
    return flow.requires_grad_(False)


def main() -> None:
    oscillator = systems.harmonic_oscillator()
    sol = solve(oscillator, rotation(), (0.0, 200.0), y0=[1.0, 0.0], events=lambda t, y: y[0], on_domain_exit="ignore")
    zeros = np.array([math.pi * (k + 0.5) for k in range(64)])
    print(f"{len(sol.t_events[0])} zeros of cos t in [0, 200] from {sol.stats['n_steps']} steps")
    print(f"largest error of a zero:  {np.abs(sol.t_events[0] - zeros).max():.1e}")
    print(f"largest error of a state: {np.abs(sol.y - [np.cos(sol.t), -np.sin(sol.t)]).max():.1e}")


if __name__ == "__main__":
    main()
