"""The training of a flow's clock: the times that the exact solution takes to where a scheme comes, by least squares.

A splitting scheme on a logarithmic Hamiltonian comes in a step s from x to a state near the orbit through x, and holds
a time for it. The label is the time at which the exact solution in the physical time is nearest to that state; the
clock is linear in its numbers.
"""

from __future__ import annotations

import time

import numpy as np
import torch
from scipy.integrate import solve_ivp

from sympflow.flow.clocked import ClockedFlow
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.fingerprint import Identity
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.hamiltonian.time_transformation import default_shift, lifted, projected, time_scale, time_transformed
from sympflow.training.fits import ClockedFit
from sympflow.training.points import Stream, states, step_errors

TOLERANCE = 1e-13
NEWTON_STEPS = 5  # to the nearest point of an orbit
FRACTIONAL_TIMES = 50


def train_clock(system: HamiltonianSystem, fit: ClockedFit, domain: Domain) -> ClockedFlow:
    """A flow with a trained clock for a separable system, with its record."""
    dt, points, label_times, seed = 1.0 if fit.dt is None else fit.dt, fit.points, fit.label_times, fit.seed
    scheme, terms = fit.scheme, fit.terms
    started, cpu = time.perf_counter(), time.process_time()
    shift = default_shift(system)
    transformed = time_transformed(system, shift)
    flow = ClockedFlow(transformed.ndof, scheme, terms, dt * time_scale(system, shift), transformed)
    x = lifted(system, states(domain, points, seed, Stream.RESIDUAL), shift)
    s = np.repeat(flow.dt * np.arange(1, label_times + 1) / label_times, len(x))
    late = _lateness(flow, system, np.tile(x, (label_times, 1)), s)
    B = np.tile(x[:, -1], label_times)
    columns = np.stack([s ** (3 + 2 * k) * B**k for k in range(terms)], axis=-1)
    unit = np.abs(columns).max(0)
    numbers = np.linalg.lstsq(columns / unit, late, rcond=None)[0] / unit
    with torch.no_grad():
        flow.clock.numbers.copy_(torch.as_tensor(numbers))
    flow.requires_grad_(False)
    stage = {"optimizer": "least squares", "loss": "clock", "points": points, "label_times": label_times, "seed": seed}
    flow.recipe = {
        "stages": [stage],
        "torch": torch.__version__,
        "transforms": {
            "system": system.name,
            "shift": shift,
            "fingerprint": list(system.fingerprint),
            "identity": Identity.of(system, domain).to_dict(),
        },
    }
    flow.figures = {"step": dt, **clock_errors(flow, system, domain, seed)}
    flow.figures["training_seconds"] = round(time.perf_counter() - started, 3)
    flow.figures["training_cpu_seconds"] = round(time.process_time() - cpu, 3)
    return flow


def _lateness(flow: ClockedFlow, system: HamiltonianSystem, x: np.ndarray, s: np.ndarray) -> np.ndarray:
    """How much later than ψ̄_s(x) of rows holds the exact solution is where it comes: (N,)."""
    transformed = flow.system
    assert transformed is not None
    end = flow.kernel_for(transformed).step(s, x).states
    held = end[:, system.ndof]
    y, start, t = projected(end), projected(x), held.copy()
    for _ in range(NEWTON_STEPS):
        exact = _at(system, start, t)
        v = system.vector_field(exact)
        t = t + ((y - exact) * v).sum(-1) / (v * v).sum(-1)
    return t - held


def clock_errors(
    flow: ClockedFlow, system: HamiltonianSystem, domain: Domain, seed: int, points: int = 100
) -> dict[str, float]:
    """‖[q, p] of ψ̄_s(x) − φ_t(x)‖, t the time that ψ̄_s(x) holds: at Δ, and its mean over fractional steps."""
    shift = flow.recipe["transforms"]["shift"]
    x = lifted(system, states(domain, points, seed, Stream.REFERENCE), shift)
    kernel = flow.kernel_for(flow.system)  # type: ignore[arg-type]
    differences = []
    for s in flow.dt * np.append((np.arange(FRACTIONAL_TIMES) + 0.5) / FRACTIONAL_TIMES, 1.0):
        end = kernel.step(np.full(len(x), s), x).states
        exact = _at(system, projected(x), end[:, system.ndof])
        differences.append(projected(end) - exact)
    return step_errors(np.stack(differences))


def _at(system: HamiltonianSystem, x: np.ndarray, t: np.ndarray) -> np.ndarray:
    """φ_t(x) of rows, each at its own time t (N,), by DOP853: all of them in a time that runs from 0 to 1."""

    def velocity(_: float, y: np.ndarray) -> np.ndarray:
        return (t[:, None] * system.vector_field(y.reshape(x.shape))).ravel()

    run = solve_ivp(velocity, (0.0, 1.0), x.ravel(), "DOP853", rtol=TOLERANCE, atol=1e-2 * TOLERANCE)
    return run.y[:, -1].reshape(x.shape)
