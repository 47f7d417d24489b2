"""The states, runs and references that the checks of integrators share."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from sympflow.integrators.base import Integrator
from sympflow.solution import Solution
from sympflow.solver import solve
from sympflow.system import HamiltonianSystem

EPS = float(np.finfo(float).eps)
T_END = 2.03  # divisible by no ordinary step


class NotApplicable(Exception):
    """Raised by a check where there is nothing to check, with the reason."""


@cache
def default_system() -> HamiltonianSystem:
    from sympflow.systems import henon_heiles

    return henon_heiles()


def states(system: HamiltonianSystem, n: int) -> np.ndarray:
    """n fixed states of the domain, or around y0."""
    if system.domain is not None:
        return system.domain.sample(n, 7)
    return start(system) * np.linspace(0.7, 1.0, n)[:, None]


def start(system: HamiltonianSystem) -> np.ndarray:
    assert system.y0 is not None, "`system` needs a default `y0` for the checks"
    return system.y0


def run(
    integrator: Integrator, system: HamiltonianSystem, t_span: tuple[float, float], y0: Any = None, **arguments: Any
) -> Solution:
    """A solution of the integrator's, from the system's y0 unless another is given."""
    y0 = start(system) if y0 is None else y0
    return solve(system, integrator, t_span, y0=y0, on_domain_exit="ignore", **arguments)


@cache
def exact(system: HamiltonianSystem, h: float = T_END, n: int = 0) -> np.ndarray:
    """The states a time h after `states(system, n)`, or after y0 for n = 0, to 13 digits."""
    y0 = states(system, n) if n else start(system)
    return solve(system, "dop853", (0.0, h), y0=y0, t_eval=[h], rtol=1e-13, atol=1e-15).y[..., 0]


def assert_close(actual: Any, expected: Any, tolerance: float, what: str) -> None:
    error = float(np.abs(np.asarray(actual) - np.asarray(expected)).max(initial=0.0))
    scale = max(1.0, float(np.abs(expected).max(initial=0.0)))
    assert error <= tolerance * scale, f"{what} by {error:.1e}"
