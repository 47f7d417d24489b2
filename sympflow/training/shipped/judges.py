"""The figures of a flow: errors of steps, energy errors over long runs, and cost, by which the shipped are chosen."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from sympflow.flow.certificate import upper_limit
from sympflow.flow.clocked import ClockedFlow
from sympflow.flow.flow_map import FlowMap
from sympflow.flow.planetary import KeplerFlow
from sympflow.flow.primed import PrimedFlow
from sympflow.flow.split import SplitFlow
from sympflow.hamiltonian.exact_flow import reference_step
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.flows import LogSympFlow
from sympflow.metrics.energy import max_energy_error
from sympflow.metrics.energy_balance import energy_balance_error
from sympflow.solver import solve
from sympflow.training.points import Labels, Stream, start_times

FRACTIONAL_TIMES = 50
HELD_OUT = 1000  # states of the certificate
OUTPUTS = 1000  # at which an energy error is looked at, where it is not the certificate that does
RUNS_SEED = 1_000_003  # of the held-out states of flows without a certificate


# cost ---------------------------------------------------------------------------------------------------------------

OF_A_GRADIENT, OF_A_CURVATURE, OF_A_MONOMIAL, OF_A_PARAMETER = 0.3, 0.4, 0.05, 0.4  # forces
OF_A_LOGARITHM = 2.0  # forces: a kick and a drift of the logarithmic Hamiltonian, a division in each
OF_AN_ORBIT = 1.0  # forces: Kepler's drift of all planets


def cost_of(flow: Any) -> float:
    """Force evaluations in a unit of time, by count: a figure that no other load on the machine disturbs.

    With 0.3 for a force gradient, 0.4 for a curvature term and 0.05 for a monomial, as was measured; exact linear flows
    count nothing, and the parameters of a network as many forces as make up for its multiplications.
    """
    if isinstance(flow, ClockedFlow):
        return OF_A_LOGARITHM * flow.scheme.force_evaluations / flow.figures["step"]
    if isinstance(flow, KeplerFlow):
        return (1.0 + OF_AN_ORBIT) / flow.dt
    if isinstance(flow, PrimedFlow):
        kernel = flow.kernel_scheme()
        beside = OF_A_GRADIENT * kernel.hessian_evaluations + OF_A_CURVATURE * kernel.curvature_evaluations
        beside += OF_A_MONOMIAL * len(kernel.monomials) * kernel.force_evaluations
        return (kernel.force_evaluations + beside) / flow.dt
    if isinstance(flow, SplitFlow):
        one, two = (flow.evaluations(n, 0, 0, "compiled") for n in (1, 2))
        more = {name: two[name] - one[name] for name in one}
        return (more["force_evaluations"] + OF_A_GRADIENT * more["hessian_evaluations"]) / flow.dt
    return OF_A_PARAMETER * flow.n_parameters / flow.dt


# errors -------------------------------------------------------------------------------------------------------------


def _mean(values: np.ndarray) -> float | None:
    mean = float(values.mean())
    return mean if math.isfinite(mean) else None


@torch.no_grad()
def one_step_errors(
    flow: FlowMap, system: HamiltonianSystem, x: np.ndarray, *, times: int = FRACTIONAL_TIMES, omega: float = 1.0
) -> tuple[float, float]:
    """Means of ‖ψ̄_t(x) − φ_H,t(x)‖ over the states x (n, 2d), as [q, p/ω]: at Δt, and at times spread before it."""
    units = np.repeat([1.0, omega], system.ndof)
    t = flow.dt * (np.arange(times) + 0.5) / times
    begun = start_times(system, flow.dt, len(x), 0, Stream.REFERENCE)
    labels = Labels.of(system, x, np.append(t, flow.dt), t0=begun)
    start = torch.as_tensor(labels.x, dtype=flow.dtype, device=flow.device)
    t0 = None if labels.t0 is None else torch.as_tensor(labels.t0, dtype=flow.dtype, device=flow.device)
    psi = np.stack([flow.psi(s, start, t0).cpu().numpy() for s in labels.t.tolist()])
    error = np.linalg.norm((psi - labels.y) / units, axis=-1).mean(-1)
    return float(error[-1]), float(error[:-1].mean())


# judges -------------------------------------------------------------------------------------------------------------

Judge = Callable[[Any, HamiltonianSystem], None]
"""A measurement of a trained flow, which puts the figures by which flows are chosen, and a certificate, into it."""


def by_certificate(
    flow: Any,
    system: HamiltonianSystem,
    t_end: float = 1000.0,
    states: int = 2000,
    times: int = 33,
    held_out: int = HELD_OUT,
) -> None:
    """The certificate over T = t_end, and from it the figures."""
    certificate = flow.certificate(system, states=states, times=times, held_out=held_out, t_end=t_end)
    flow.figures |= {
        "one_step_error_median": certificate.one_step_error.median,
        "one_step_error_max": certificate.one_step_error.largest,
        "energy_error_median": certificate.relative_energy_error.median,
        "energy_error_95": certificate.relative_limit,
        "t_end": t_end,
        "cost": round(cost_of(flow), 3),
    }


def of_domain(system: HamiltonianSystem) -> np.ndarray:
    """Held-out states of flows without a certificate."""
    assert system.domain is not None
    return system.domain.sample(HELD_OUT, RUNS_SEED)


def balance_errors(sol: Any) -> Any:
    """The largest relative errors of the energy balance of runs of a driven system."""
    return energy_balance_error(sol, relative=True).max(-1)


@dataclass(frozen=True)
class ByRuns:
    """Errors of runs in the physical time over T = t_end, at steps and between them; a certificate if requested."""

    errors: Callable[[Any], Any] = max_energy_error
    states: Callable[[HamiltonianSystem], np.ndarray] = of_domain
    t_end: float = 1000.0
    t_certified: float | None = None

    def __call__(self, flow: Any, system: HamiltonianSystem) -> None:
        if self.t_certified is not None:
            flow.certificate(system, t_end=self.t_certified)
        method: Any = flow
        if isinstance(flow, ClockedFlow):
            method = LogSympFlow(flow=flow, shift=flow.recipe["transforms"]["shift"])
        times = np.linspace(0.0, self.t_end, OUTPUTS + 1)
        sol = solve(system, method, (0.0, self.t_end), self.states(system), t_eval=times, on_domain_exit="ignore")
        errors = np.asarray(self.errors(sol))
        flow.figures |= {
            "energy_error_median": float(np.quantile(errors, 0.5, method="higher")),
            "energy_error_95": upper_limit(errors),
            "t_end": self.t_end,
            "cost": round(cost_of(flow), 8),
        }


@dataclass(frozen=True)
class AsPublished:
    """Figures of a network, `one_step_errors`, and a certificate if it is symplectic."""

    initial: Callable[[], np.ndarray]
    omega: float = 1.0

    @torch.no_grad()
    def measured(self, flow: FlowMap, system: HamiltonianSystem, steps: int = 1000) -> dict[str, Any]:
        """Figures of a flow from the initial states, as the published checkpoints were measured."""
        units = np.repeat([1.0, self.omega], system.ndof)
        x = self.initial()
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

    def __call__(self, flow: FlowMap, system: HamiltonianSystem) -> None:
        flow.figures |= self.measured(flow, system)
        at_end, between = one_step_errors(flow, system, self.initial(), omega=self.omega)
        flow.figures |= {"error_at_dt": at_end, "fractional_error": between}
        if flow.kind == "sympflow":
            by_certificate(flow, system)


PHASES = (*(k / 20 for k in range(1, 20)), 0.97, 0.98, 0.99, 0.995)  # of a step, for figures between steps
STIFF_STATES, STIFF_SEED = 20, 20_261_121  # of the energy figure, from a seed that no training uses


def of_stiff(flow: SplitFlow, system: HamiltonianSystem) -> None:
    """Largest energy errors of y0 and of held-out states over the interval, and a certificate of few states."""
    bound = flow.bound(system)
    on_grid = solve(system, bound, on_domain_exit="ignore")
    n = round((system.t_span[1] - system.t_span[0]) / flow.dt) - 1
    t = np.unique(np.linspace(0, n, 500).round())[:, None] + np.array(PHASES)
    between = solve(system, bound, on_domain_exit="ignore", t_eval=t.ravel() * flow.dt + system.t_span[0])
    domain = bound.domain_for(system)
    assert domain is not None
    x = domain.sample(STIFF_STATES, STIFF_SEED)
    steps = np.arange(0.0, system.t_span[1] + flow.dt / 2, flow.dt)[::10]
    many = solve(system, bound, y0=x, t_eval=steps[steps <= system.t_span[1]], on_domain_exit="ignore")
    H = np.asarray(many.energy())
    drift = np.abs(H - H[..., :1]).max(-1)
    scale = np.abs(H[..., 0]) if system.energy_scale is None else system.energy_scale
    bound.figures |= {
        "orbit_energy_error": float(np.abs(on_grid.energy_error()).max()),
        "between_steps": float(np.abs(between.energy() / system.hamiltonian(system.y0) - 1).max()),
        "energy_error": float(drift.mean()),
        "energy_error_max": float(drift.max()),
        "energy_error_95": float(np.quantile(drift / scale, 0.95, method="higher")),
        "t_end": system.t_span[1],
        "cost": round(cost_of(bound), 3),
    }
    # fewer states than the default: one costs dear
    bound.certificate(system, t_end=system.t_span[1], states=500, times=17, held_out=20)
