"""Checks of runs of trained flows: the system must be that of the flow, and the states in its domain Ω."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from sympflow.arguments import warn
from sympflow.arrays import Array, finite_states, has_values, masked, one_lane, readable, to_numpy
from sympflow.hamiltonian.domain import Box, Domain, EnergySublevel
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.contract import Integrator, Outcome

if TYPE_CHECKING:
    from sympflow.flow.known import KnownFlow

STATES_COMPARED, MOST_COMPARED = 16, 64
"""Outputs of a run, and states of a batch, at which H is compared with that of the flow."""
MANY_TIMES = 1000.0  # times the certified energy error of a flow beyond which an error outside its domain is warned of
MANY_STEPS = 100.0  # times the error of one step of a flow without a certificate
LOOKED_AT = 32  # outputs of a run whose energy is compared with that of its start


def _surely_within(flow: KnownFlow | None, system: HamiltonianSystem, y: np.ndarray, slack: float) -> bool:
    """True if all states y (..., 2d) are in the domain of the flow and compiled code can tell."""
    domain = (None if flow is None else flow.domain) or system.domain
    if type(domain) is not EnergySublevel and type(domain) is not Box:
        return False
    return _compiled()(system, domain, y, slack)


@cache
def _compiled() -> Callable[..., bool]:
    from sympflow.kernels.passes import all_within

    return all_within


def _domain(flow: KnownFlow | None, system: HamiltonianSystem) -> Domain | None:
    return system.domain if flow is None else flow.domain_for(system)


def check_system_along(outcome: Outcome, integrator: Integrator, system: HamiltonianSystem, y0: Array) -> None:
    """A trained flow must have run on its own system: H is compared at the start and at a few states of the run."""
    identity = integrator.identity_for(system)
    if identity is None or identity.is_proved(system):
        return
    if not has_values(outcome.y):
        return
    width = 2 * system.ndof
    y = one_lane(outcome.y)
    chosen = y[np.linspace(0, len(y) - 1, min(len(y), STATES_COMPARED)).astype(int)].reshape(-1, width)
    starts = one_lane(y0).reshape(-1, width)
    rows = [states[:: max(1, len(states) // MOST_COMPARED)] for states in (starts, chosen)]
    states = np.concatenate(rows).astype(float)
    states = states[np.isfinite(states).all(-1)]
    first = identity.first_difference(system, states)
    if first is None:
        return
    shown = ", ".join(f"{x:.6g}" for x in states[first][:8]) + (", …" if width > 8 else "")
    raise ValueError(
        f"`system` {system.name!r} is not the one that the flow was trained for: at the state ({shown}) of this run "
        "its H is another. Pass the flow of this system, or train one with sympflow.train(system)."
    )


def warn_of_loss(outcome: Outcome, integrator: Integrator, system: HamiltonianSystem, y0: Array) -> None:
    """Warn of a run that left the domain of its flow and lost far more energy than the flow does inside."""
    flow = integrator.known_flow(system)
    if flow is None or "domain_exit" not in outcome.stats or not system.keeps_energy:
        return
    width = 2 * system.ndof
    with np.errstate(all="ignore"):
        y = to_numpy(outcome.y if readable(outcome.y) else outcome.y[-1:])
        y = y[:: -max(1, len(y) // LOOKED_AT)]
        H0, H = system.hamiltonian(to_numpy(y0).reshape(-1, width)), system.hamiltonian(y.reshape(len(y), -1, width))
        error = np.fmax.reduce(np.abs(H - H0) / (system.energy_scale or np.maximum(np.abs(H0), np.abs(H))))
    certificate, figures = flow.certified, flow.figures
    known, held, times = "has an error in one step of", figures.get("one_step_error_max") or 0.0, MANY_STEPS
    if certificate is not None:
        held = certificate.relative_limit or certificate.relative_energy_error.largest
        known, times = "is certified for", MANY_TIMES
    off = error > times * held
    if not (held and off.any()):
        return
    row = int(np.argmax(np.where(off, error, 0)))
    which = "" if len(off) == 1 else f" of trajectory {row}, the worst of {off.sum()} such,"
    warn(
        f"The state left the domain of the flow at t = {outcome.stats['domain_exit']:.10g}, and the relative energy "
        f"error{which} is {error[row]:.2g}: the flow {known} {held:.2g} inside. "
        "Start inside its `domain`, train a flow on one that holds these states, or take a scheme such as 'srkn11b'.",
        RuntimeWarning,
    )


def check_start(flow: KnownFlow, system: HamiltonianSystem, y0: Array, compiled: bool) -> None:
    """A flow that is taken for its accuracy must start where its accuracy was measured."""
    if compiled and _surely_within(flow, system, y0, 0.0):
        return
    domain = _domain(flow, system)
    if domain is None:
        return
    if not readable(y0):
        raise ValueError(
            "`tol` needs the values of y0, to see that it is in the domain of the flow, and torch.func.vmap and "
            "torch.compile hide them: pass the flow itself, as `flow`."
        )
    inside = np.asarray(domain.contains(y0))
    if not inside.all():
        which = f" (trajectory {', '.join(map(str, np.argwhere(~inside)[0].tolist()))})" if inside.ndim else ""
        raise ValueError(
            f"`y0` is outside the domain{which} that the flow with Δt = {flow.dt:g} was trained and measured on, so it "
            "has no known accuracy to meet `tol` there: start inside, or train a flow there and pass flow=flow."
        )


def check_domain(outcome: Outcome, integrator: Integrator, system: HamiltonianSystem, action: str) -> None:
    """Note the first output outside the domain, or end the run there."""
    flow = integrator.known_flow(system)
    slack = 0.0 if flow is None else float(flow.figures.get("energy_error_max") or 0.0)
    if outcome.stats.get("backend") == "compiled" and _surely_within(flow, system, outcome.y, slack):
        return
    domain = _domain(flow, system)
    if domain is None or not len(outcome.t):
        return
    inside = np.asarray(domain.contains(outcome.y, slack=slack))  # (n, ...)
    if inside.all():
        return
    with np.errstate(invalid="ignore"):
        inside = inside | ~finite_states(outcome.y)  # what has become non-finite is reported as that
    if inside.all():
        return
    first = int(np.argmin(inside.reshape(len(inside), -1).all(1)))
    t = float(outcome.t[first])
    outcome.stats["domain_exit"] = t
    which = ""
    if inside.ndim > 1:
        index = tuple(np.argwhere(~inside[first])[0].tolist())
        count = int((~inside).any(0).sum())
        which = f" (trajectory {', '.join(map(str, index))}, the first of {count})"
    note = f"The state left the domain at t = {t:.15g}{which}"
    if action == "warn":
        worth = ""
        if flow is not None and not any(flow.evaluations(1, 1, 0, "array").values()):  # else forces of the system
            worth = (
                ", where its network was not trained: it stays finite, even past a singularity, but its results "
                "are meaningless from that time on. Start inside the domain, or use a classical method"
            )
        held = "the figures" if flow is None or flow.certified is None else "the figures and the certificate"
        outcome.message += f" {note}: {held} of a trained flow do not hold there{worth}."
        return
    outcome.message = f"{note}. Start inside the domain, or pass on_domain_exit='warn'."
    if inside.ndim == 1:
        outcome.t, outcome.y = outcome.t[: first + 1], outcome.y[: first + 1]
        outcome.status = -1
        return
    outside = np.logical_or.accumulate(~inside, axis=0)
    after = np.concatenate([np.zeros_like(outside[:1]), outside[:-1]])  # the exit itself is kept
    outcome.status = np.where(outside[-1], -1, outcome.status)
    outcome.y = masked(outcome.y, after[..., None], np.nan)
