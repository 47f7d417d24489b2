"""What a flow achieves, measured as the published checkpoints were: errors after 1, 10, 100 steps, energy over 1000."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from sympflow.flow.base import FlowMap
from sympflow.hamiltonian.exact_flow import reference_step
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.training.labels import Labels

FRACTIONAL_TIMES = 50


@torch.no_grad()
def measure(
    flow: FlowMap, system: HamiltonianSystem, x: np.ndarray, *, steps: int = 1000, omega: float = 1.0
) -> dict[str, Any]:
    """Figures of a flow from the initial states x (n, 2d).

    Parameters
    ----------
    flow, system
    x : ndarray, shape (n, 2d)
    steps : int
        Over which the energy is followed.
    omega : float
        Frequency of the system: states are measured as [q, p/ω], energies in H's own units.

    Returns
    -------
    dict
        `error_1`, `error_10`, `error_100`: mean over the states of ‖ψ_kΔt(x) − φ_H,kΔt(x)‖, the reference by DOP853;
        `energy_error`: of each state the largest |H − H0| over the steps, then the mean over the states;
        `energy_error_max`: the largest of all. None where a state is not finite.
    """
    units = np.repeat([1.0, omega], system.ndof)
    y = torch.as_tensor(x, dtype=flow.dtype, device=flow.device)
    H0 = system.hamiltonian(y)
    largest = torch.zeros_like(H0)
    reference, reached = x, 0
    figures: dict[str, Any] = {}
    for k in range(1, steps + 1):
        y = flow.psi(flow.dt, y)
        # torch.maximum keeps a NaN, so a blow-up is not reported as a small error
        largest = torch.maximum(largest, (system.hamiltonian(y) - H0).abs())
        if k in (1, 10, 100):
            reference, reached = reference_step(system, reference, (k - reached) * flow.dt), k
            with np.errstate(all="ignore"):
                figures[f"error_{k}"] = _mean(np.linalg.norm((y.cpu().numpy() - reference) / units, axis=-1))
    energy = largest.cpu().numpy()
    figures["energy_error"] = _mean(energy)
    figures["energy_error_max"] = float(energy.max()) if np.isfinite(energy).all() else None
    return figures


def _mean(values: np.ndarray) -> float | None:
    mean = float(values.mean())
    return mean if math.isfinite(mean) else None


@torch.no_grad()
def one_step_errors(
    flow: FlowMap, system: HamiltonianSystem, x: np.ndarray, *, times: int = FRACTIONAL_TIMES, omega: float = 1.0
) -> tuple[float, float]:
    """Means of ‖ψ̄_t(x) − φ_H,t(x)‖ over the states x (n, 2d): at Δt, and over as many times spread over (0, Δt).

    A flow of which the second is far larger than the first is a map for Δt only. States are measured as [q, p/ω].
    """
    units = np.repeat([1.0, omega], system.ndof)
    t = flow.dt * (np.arange(times) + 0.5) / times
    labels = Labels.of(system, x, np.append(t, flow.dt))
    start = torch.as_tensor(labels.x, dtype=flow.dtype, device=flow.device)
    psi = np.stack([flow.psi(s, start).cpu().numpy() for s in labels.t.tolist()])
    error = np.linalg.norm((psi - labels.y) / units, axis=-1).mean(-1)
    return float(error[-1]), float(error[:-1].mean())
