"""Is the right-hand side that a peer was given the system that our method solves?"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from sympflow.arrays import to_numpy
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep


def own_velocity(integrator: FixedStep, system: HamiltonianSystem | None, y: np.ndarray) -> np.ndarray:
    """The velocity at y of the motion that the integrator computes: ∂_tψ̄ at t = 0 for a flow, else J∇H."""
    flow = integrator.given_flow if system is None else integrator.flow_for(system)
    if flow is None:
        assert system is not None
        return system.vector_field(y)
    import torch

    with torch.no_grad():
        return to_numpy(flow.initial_velocity(torch.from_numpy(np.array(y)).to(flow.dtype)))


def warn_of_another_system(
    integrator: FixedStep, system: HamiltonianSystem | None, y: np.ndarray, slope: np.ndarray, stacklevel: int
) -> None:
    """Warn if `slope`, the right-hand side at y, is not the velocity of the method's own motion.

    A flow is trained to a residual: it may differ by a tenth of the largest velocity.
    """
    velocity = own_velocity(integrator, system, y)
    allowed = (0.1 if integrator.trained else 1e-6) * max(np.abs(slope).max(), np.abs(velocity).max(), 1e-3)
    if velocity.shape == slope.shape and np.abs(velocity - slope).max() > allowed:
        warnings.warn(
            f"The method {integrator.name!r} moves the initial state with velocity {_short(velocity)}, but the "
            f"right-hand side there is {_short(slope)}: it solves its own system, not this one. Pass the system, or "
            "the flow, that belongs to the right-hand side.",
            UserWarning,
            stacklevel=stacklevel,
        )


def fixed_step(method: Any, options: dict[str, Any], peer: str) -> FixedStep:
    """The fixed-step integrator that `method` and `options` mean.

    Raises
    ------
    TypeError
        If the method chooses its own steps: the peer has such methods itself; if its steps, or those of a flow, are not
        on a grid; or if a run keeps more than the state.
    """
    from sympflow.integrators.registry import build

    integrator = build(method, options)
    if not isinstance(integrator, FixedStep):
        raise TypeError(
            f"`method` {integrator.name!r} is no fixed-step map, which is what can be handed to {peer}: use a "
            f"splitting method or a trained flow, or {peer}'s own method."
        )
    if integrator.in_another_time and integrator.given_flow is not None:
        raise TypeError(
            f"`flow` runs in another time, so that its steps are not equal in t, which {peer} cannot drive: use "
            "solve(), or a flow in the system's own time (sympflow.shipped_flows() lists them, `shift` is None)."
        )
    if integrator.keeps:
        raise TypeError(
            f"`method` {integrator.name!r} keeps {integrator.keeps} from step to step, which {peer} cannot hand on: "
            "use solve(), or another method."
        )
    if not integrator.on_grid:
        raise TypeError(
            f"`method` {integrator.name!r} takes steps that are not equal in t, which {peer} cannot drive: use "
            "solve(), or another method."
        )
    return integrator


def _short(v: np.ndarray) -> str:
    shown = ", ".join(f"{x:.3g}" for x in v.ravel()[:4])
    return f"({shown}{', …' if v.size > 4 else ''})"
