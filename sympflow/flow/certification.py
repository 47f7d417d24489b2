"""How a certificate is found: estimates over seeded samples of Ω × [0, Δt], and errors of held-out orbits."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from sympflow.flow.certificate import Certificate, Quantiles, upper_limit
from sympflow.hamiltonian.domain import Domain

if TYPE_CHECKING:
    from sympflow.flow.base import FlowMap
    from sympflow.flow.sympflow import SympFlow
    from sympflow.hamiltonian.system import HamiltonianSystem

SAVED_VALUES = 1_000_000  # of a piece of the measured runs, which are never held whole
WORST = 16  # states of a time from which the largest rate is searched
OFFSPRING, ROUNDS = 16, 16  # new states of each, and how often
GOLDEN = (math.sqrt(5) - 1) / 2
FIRST_STEP, SHRINK = 0.2, 0.65  # how far these are, in standard deviations of Ω, and how much nearer each time


def certificate(
    flow: FlowMap,
    system: HamiltonianSystem,
    *,
    states: int,
    times: int,
    held_out: int,
    t_end: float,
    seed: int,
) -> Certificate:
    """`FlowMap.certificate`."""
    from sympflow.domain_exit import domain_of
    from sympflow.flow.record import checksum
    from sympflow.flow.sympflow import SympFlow

    if not isinstance(flow, SympFlow):
        raise TypeError(
            "`flow` is an unconstrained network, which is the flow of no Hamiltonian, so nothing bounds its energy "
            "error: use a SympFlow for a certificate."
        )
    for name, value, least in (
        ("states", states, 1),
        ("times", times, 2),
        ("held_out", held_out, 1),
        ("seed", seed, 0),
    ):
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise ValueError(f"`{name}` must be an integer and at least {least}; got {value!r}.")
    if not flow.dt <= t_end < math.inf:
        raise ValueError(f"`t_end` must be finite and at least Δt = {flow.dt:g}; got {t_end!r}.")
    flow.check_system(system)
    flow.bound(system)
    domain = domain_of(flow, system)
    if domain is None:
        raise ValueError("`flow` has no domain and neither has its system: give the system a `domain`, say a Box.")
    x, unseen = (domain.sample(n, _seed(seed, i)) for i, n in enumerate((states, held_out)))
    energy, relative, left = _energy_errors(flow, system, domain, unseen, t_end)
    return Certificate(
        system.name,
        flow.dt,
        states,
        times,
        seed,
        *_over_sample(flow, system, domain, x, times, np.random.default_rng(_seed(seed, 2))),
        held_out,
        float(t_end),
        _one_step_error(flow, system, unseen),
        Quantiles.of(energy),
        Quantiles.of(relative),
        left,
        checksum(flow.state_dict()),
        upper_limit(relative),
    )


def _largest_nearby(
    function: Callable[[np.ndarray, np.ndarray], np.ndarray],
    domain: Domain,
    t: np.ndarray,
    x: np.ndarray,
    values: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """The largest value of a function of (t, x) at each time, from its values (J, n) at states x (n, 2d) of Ω.

    From the worst states of each time by random steps in Ω, ever shorter, of which the best are kept.
    """
    worst = np.argsort(values, axis=1)[:, -WORST:]
    best, found = x[worst], np.take_along_axis(values, worst, 1)  # (J, W, 2d), (J, W)
    if not np.isfinite(found).all():
        return found.max(1)
    length, times = FIRST_STEP * x.std(0), np.broadcast_to(t[:, None], (OFFSPRING, *found.shape))
    for _ in range(ROUNDS):
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
    flow: SympFlow, system: HamiltonianSystem, domain: Domain, x: np.ndarray, times: int, rng: np.random.Generator
) -> tuple[Quantiles, Quantiles, Quantiles]:
    """The defect, the error of 𝓗 and δ, over states x (n, 2d)."""
    points = torch.as_tensor(x, dtype=flow.dtype, device=flow.device)
    H = system.hamiltonian(points)
    defects, mismatches, gains = [], [], []

    def gained(t: float | torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The defect, and ∇H of it: ∇H·J∇H = 0, so that ∇H·J∇𝓗 may lose that part, and with it the rounding."""
        y, velocity = flow.psi_and_velocity(t, points)
        defect = velocity - system.vector_field(y)
        return defect, (system.gradient(y) * defect).sum(-1)

    def rate(t: np.ndarray, states: np.ndarray) -> np.ndarray:
        at, z = (torch.as_tensor(a, dtype=flow.dtype, device=flow.device) for a in (t, states))
        return _finite(_array(gained(at, z)[1]))

    instants = np.linspace(0.0, flow.dt, times)
    for t in instants.tolist():
        defect, gain = gained(t, points)
        gains.append(_finite(_array(gain)))
        defects.append(torch.linalg.vector_norm(defect, dim=-1))
        difference = flow.hamiltonian_unchecked(t, points) - H
        mismatches.append(difference - difference.mean())
    rates = np.array([list(asdict(Quantiles.of(row)).values()) for row in gains])  # (times, 3)
    rates[:, 2] = _largest_nearby(rate, domain, instants, x, np.array(gains), rng)
    delta = Quantiles(*(float(np.trapezoid(column, dx=flow.dt / (times - 1))) for column in rates.T))
    return Quantiles.of(_array(torch.stack(defects))), Quantiles.of(_array(torch.stack(mismatches))), delta


def _finite(values: np.ndarray) -> np.ndarray:
    """|values|, and infinity for what is not a number."""
    return np.where(np.isnan(values), math.inf, np.abs(values))


def _array(values: torch.Tensor) -> np.ndarray:
    return values.detach().cpu().double().numpy()


def _one_step_error(flow: SympFlow, system: HamiltonianSystem, x: np.ndarray) -> Quantiles:
    from sympflow.hamiltonian.exact_flow import reference_step

    with torch.no_grad():
        y = flow.psi(flow.dt, torch.as_tensor(x, dtype=flow.dtype, device=flow.device)).cpu().double().numpy()
    return Quantiles.of(np.linalg.norm(y - reference_step(system, x, flow.dt), axis=-1))


def _energy_errors(
    flow: SympFlow, system: HamiltonianSystem, domain: Domain, x: np.ndarray, t_end: float
) -> tuple[np.ndarray, np.ndarray, int]:
    """The largest |H − H0| of each orbit in Ω up to t_end, the same relative, how many left Ω.

    Looked at are all steps, and between every two of them one time at another fraction of Δt: there an output is a
    shorter step, whose error is its own.
    """
    from sympflow.solver import solve

    steps = int(t_end / flow.dt * (1 + 1e-12))
    piece = max(1, min(steps, SAVED_VALUES // (2 * x.size)))
    y = x.astype(str(flow.dtype).removeprefix("torch."))
    precision: dict[str, Any] = {"dtype": str(y.dtype)} if flow.device.type == "cpu" else {}
    H0 = system.hamiltonian(y).astype(float)
    largest, inside, done = np.zeros(len(x)), np.full(len(x), True), 0
    while done < steps and inside.any():
        n = min(piece, steps - done)
        times = flow.dt * _steps_and_between(done, n)
        state = torch.as_tensor(y, device=flow.device) if flow.device.type != "cpu" else y
        with torch.no_grad(), np.errstate(all="ignore"):
            run = solve(system, flow, (0.0, times[-1]), state, t_eval=times, on_domain_exit="ignore", **precision)
            orbit = np.moveaxis(torch.as_tensor(run.y).cpu().numpy(), -1, 0)  # (2n + 1, N, 2d)
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


def _steps_and_between(done: int, n: int) -> np.ndarray:
    """0, 1, …, n, and one number between every two, in units of Δt: (2n + 1,). The fractions fill (0, 1) evenly."""
    k = np.arange(n)
    return np.append(np.stack([k, k + (done + k + 1) * GOLDEN % 1], axis=1).ravel(), n)


def _seed(seed: int, stream: int) -> int:
    return int(np.random.SeedSequence([seed, 20_261, stream]).generate_state(1)[0])
