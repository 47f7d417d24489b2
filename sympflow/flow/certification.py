"""Certificates measured: suprema over seeded samples of Ω × [0, Δt], and errors of held-out orbits."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sympflow.compiler import NotCompiled
from sympflow.flow.certificate import Certificate, Quantiles, sizes, upper_limit
from sympflow.flow.weights import doubles
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.system import HamiltonianSystem

SAVED_VALUES = 1_000_000  # of a piece of the measured runs, which are never held whole
WORST = 16  # states of a time from which the largest rate is searched
OFFSPRING, ROUNDS = 16, 16  # new states of each, and how often
SEARCHED = 4_000_000  # numbers that are handled for these states, of many degrees of freedom
GOLDEN = (math.sqrt(5) - 1) / 2
FIRST_STEP, SHRINK = 0.2, 0.65  # how far these are, in standard deviations of Ω, and how much nearer each time


def certify(
    flow: Any, system: HamiltonianSystem, domain: Domain, weights: str, size: Mapping[str, int], t_end: float
) -> Certificate:
    """Find the certificate of a flow on a domain: `FlowMap.certificate`; `weights` is their checksum."""
    from sympflow.hamiltonian.exact_flow import reference_step

    states, times, held_out, seed = (size[name] for name in ("states", "times", "held_out", "seed"))
    system.check_conservative(
        "which takes energy away, and a certificate bounds the error of a conserved energy",
        "see flow.figures, or sympflow.reference_error of a run",
    )
    system.check_autonomous(
        "so that its energy changes, and a certificate bounds the error of a conserved energy",
        "see flow.figures, or sympflow.energy_balance_error of a run",
    )
    x, unseen = (domain.sample(n, _seed(seed, i)) for i, n in enumerate((states, held_out)))
    energy, relative, left = _energy_errors(flow, system, domain, unseen, t_end)
    with torch.no_grad():
        end = flow.psi(flow.dt, torch.as_tensor(unseen, dtype=flow.dtype, device=flow.device)).cpu().double().numpy()
    return Certificate(
        system.name,
        flow.dt,
        states,
        times,
        seed,
        *_over_sample(flow, system, domain, x, times, np.random.default_rng(_seed(seed, 2))),
        held_out,
        float(t_end),
        Quantiles.of(np.linalg.norm(end - reference_step(system, unseen, flow.dt), axis=-1)),
        Quantiles.of(energy),
        Quantiles.of(relative),
        left,
        weights,
        upper_limit(relative),
    )


def _largest_nearby(
    function: Callable[[np.ndarray, np.ndarray], np.ndarray],
    domain: Domain,
    t: np.ndarray,
    x: np.ndarray,
    values: np.ndarray,
    rng: np.random.Generator,
    numbers: int,
) -> np.ndarray:
    """The largest value of a function of (t, x) at each time, by ever shorter random steps from the worst states."""
    few = SEARCHED // (OFFSPRING * len(t) * numbers)
    worst = np.argsort(values, axis=1)[:, -max(1, min(WORST, few)) :]
    best, found = x[worst], np.take_along_axis(values, worst, 1)  # (J, W, 2d), (J, W)
    if not np.isfinite(found).all():
        return found.max(1)
    length, times = FIRST_STEP * x.std(0), np.broadcast_to(t[:, None], (OFFSPRING, *found.shape))
    for _ in range(min(ROUNDS, few // worst.shape[1])):
        new = best + rng.normal(size=(OFFSPRING, *best.shape)) * length
        inside = domain.contains(new)
        rates = np.full(inside.shape, -math.inf)
        if inside.any():
            rates[inside] = function(times[inside], new[inside])
        top = rates.argmax(0)[None]
        rate = np.take_along_axis(rates, top, 0)[0]
        better = rate > found
        best = np.where(better[..., None], np.take_along_axis(new, top[..., None], 0)[0], best)
        found, length = np.maximum(found, rate), SHRINK * length
    return found.max(1)


@torch.no_grad()
def _over_sample(
    flow: Any, system: HamiltonianSystem, domain: Domain, x: np.ndarray, times: int, rng: np.random.Generator
) -> tuple[Quantiles, Quantiles, Quantiles]:
    """The defect, the error of 𝓗 and δ, over states x (n, 2d)."""
    points = torch.as_tensor(x, dtype=flow.dtype, device=flow.device)
    H = system.hamiltonian(points)
    defects, mismatches, gains = [], [], []

    def gained(t: float | Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        """The defect, and ∇H of it: ∇H·J∇H = 0, so that ∇H·J∇𝓗 may lose that part, and with it the rounding."""
        y, velocity = flow.psi_and_velocity(t, points)
        defect = velocity - system.vector_field(y)
        return defect, (system.gradient(y) * defect).sum(-1)

    def rate(t: np.ndarray, states: np.ndarray) -> np.ndarray:
        at, z = (torch.as_tensor(a, dtype=flow.dtype, device=flow.device) for a in (t, states))
        return sizes(doubles(gained(at, z)[1]))

    numbers = x.shape[1] if system.local is None else system.local.numbers
    instants = np.linspace(0.0, flow.dt, times)
    for t in instants.tolist():
        defect, gain = gained(t, points)
        gains.append(sizes(doubles(gain)))
        defects.append(torch.linalg.vector_norm(defect, dim=-1))
        difference = flow.hamiltonian_unchecked(t, points) - H
        mismatches.append(difference - difference.mean())
    rates = np.array([list(asdict(Quantiles.of(row)).values()) for row in gains])  # (times, 3)
    rates[:, 2] = _largest_nearby(rate, domain, instants, x, np.array(gains), rng, numbers)
    delta = Quantiles(*(float(np.trapezoid(column, dx=flow.dt / (times - 1))) for column in rates.T))
    return Quantiles.of(doubles(torch.stack(defects))), Quantiles.of(doubles(torch.stack(mismatches))), delta


def _energy_errors(
    flow: Any, system: HamiltonianSystem, domain: Domain, x: np.ndarray, t_end: float
) -> tuple[np.ndarray, np.ndarray, int]:
    """The largest |H − H0| of each orbit in Ω up to t_end, the same relative, how many left Ω."""
    steps = int(t_end / flow.dt * (1 + 1e-12))
    piece = max(1, min(steps, SAVED_VALUES // (2 * x.size)))
    y = x.astype(str(flow.dtype).removeprefix("torch."))
    H0 = system.hamiltonian(y).astype(float)
    largest, inside, done = np.zeros(len(x)), np.full(len(x), True), 0
    while done < steps and inside.any():
        n = min(piece, steps - done)
        with np.errstate(all="ignore"):
            orbit = _orbit(flow, system, y, done, n)  # (2n + 1, N, 2d)
            error = np.abs(system.hamiltonian(orbit) - H0)
            stays = np.logical_and.accumulate(domain.contains(orbit), axis=0) & inside
        # what was reached from Ω counts, even if it ends outside
        counted = np.concatenate([inside[None], stays[:-1]])
        error = np.where(np.isnan(error), math.inf, error)
        largest = np.maximum(largest, np.where(counted, error, 0.0).max(0))
        inside = stays[-1]
        y, done = np.where(inside[:, None], orbit[-1], y), done + n
    scale = np.abs(H0) if system.energy_scale is None else np.full_like(H0, system.energy_scale)
    relative = largest / np.where(scale > 0, scale, 1.0)
    return largest, relative, int((~inside).sum())


@torch.no_grad()
def _orbit(flow: Any, system: HamiltonianSystem, y: np.ndarray, done: int, n: int) -> np.ndarray:
    """The states at 0, 1, …, n steps of Δt, and at one time between every two: (2n + 1, N, 2d)."""
    k = np.arange(n)
    between = flow.dt * (k + (done + k + 1) * GOLDEN % 1) - k * flow.dt
    lengths = np.broadcast_to(between[:, None], (n, len(y))).astype(y.dtype)
    orbit = np.empty((2 * n + 1, *y.shape), dtype=y.dtype)
    try:
        kernel = flow.kernel_for(system)
    except NotCompiled:
        start = torch.from_numpy(y).to(flow.device)
        states = [flow.prepare(flow.dt, start)]
        for _ in range(n):
            states.append(flow.kernel_step(flow.dt, states[-1]))
        tensors = torch.cat([start[None], flow.finish(flow.dt, torch.stack(states))[1:]])
        orbit[::2] = tensors.cpu().numpy()
        orbit[1::2] = flow(torch.from_numpy(lengths).to(flow.device), tensors[:-1]).cpu().numpy()
        return orbit
    orbit[::2] = kernel.run(flow.dt, y, n, np.arange(n + 1)).states.swapaxes(0, 1)
    rows = orbit[:-1:2].reshape(-1, y.shape[1])
    orbit[1::2] = kernel.step(lengths.ravel(), rows).states.reshape(n, *y.shape)
    return orbit


def _seed(seed: int, stream: int) -> int:
    return int(np.random.SeedSequence([seed, 20_261, stream]).generate_state(1)[0])
