"""Flows of lattices: fitted on a ring of a few sites, written out by its coordinates, judged on many.

The numbers of a primed flow depend on the potential and Δt, not on the size. So they are fitted at states of the energy
density of the large lattice. Held-out states and the certificate are those of the large one, with its own ends.

The error of one step on a few sites does not determine the energy error of a large lattice after a thousand. The
modified energy that a flow keeps differs from H by terms that hardly change in a step, such as the actions of waves
whose frequencies are a bit wrong; these change as waves exchange energy, and a few sites have few wave lengths. So the
best few tables at Δt that labels find are fitted further, to the errors of H in runs from many states of a larger ring.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from sympflow.flow.flow_map import FlowMap
from sympflow.flow.primed import PrimedFlow
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.lattice import BOUNDARIES
from sympflow.hamiltonian.lattice_states import DRAWN, LatticeStates
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.training.fits import PrimedFit
from sympflow.training.least_squares import Check
from sympflow.training.points import Labels, Stream, shares_missed, states, step_errors
from sympflow.training.starts import frequency
from sympflow.training.table_fit import RunsFit, Table

MOST_FITTED = 16
"""Degrees of freedom up to which a lattice is fitted as it is, and not by a subsystem."""
TAIL = 2.0
"""Times the upper density that the states of a subsystem have.

In a large lattice a few neighbours at a time have so much, and a flow's errors there decide about the energy of all."""
NUMBERS = 16_000
"""Numbers that the functions of a judgement handle, of all states together."""
FEWEST, MOST_ORBITS, MOST_STATES, TIMES, CERTIFIED = 8, 40, 200, 9, 250
"""The certificate: fewest and most orbits, states, times in [0, Δt], and the steps of the orbits."""
STEPS, SEEN, COPIES, ENDS_STATES = 200, 5, 4, 16
"""Energy errors at ends: steps, steps between two looks, subsystems in a row, and states."""


def by_subsystem(system: HamiltonianSystem) -> bool:
    """Return True for a lattice, which a flow is fitted to by a subsystem."""
    local, damping = system.local, system.damping
    return local is not None and local.has_subsystem and (damping is None or not damping.ndim)


@dataclass(frozen=True)
class LatticeSubsystem:
    """The few sites that a flow of a lattice is fitted on."""

    lattice: HamiltonianSystem
    few: HamiltonianSystem
    system: HamiltonianSystem
    domain: Domain
    states: LatticeStates

    @classmethod
    def of(cls, lattice: HamiltonianSystem, domain: Domain) -> LatticeSubsystem:
        """The subsystem of a lattice, for states of a domain of it."""
        found = domain if isinstance(domain, LatticeStates) else LatticeStates.of_states(lattice, domain.sample(DRAWN))
        small = lattice.ndof <= MOST_FITTED
        few = lattice if small else lattice.subsystem()
        assert few.local is not None
        H, written = few.local.written_out(), few
        if H is not None:
            scene: Any = {"damping": lattice.damping, "t_span": lattice.t_span, "dt": lattice.dt}
            written = HamiltonianSystem.from_sympy(H, name=lattice.name, **scene)
        low, high = found.bounds
        excited = replace(found, density=(low, TAIL * high)).of(few)
        return cls(lattice, few, written, domain if small else excited, found.of(lattice))

    def small(self, flow: FlowMap) -> PrimedFlow:
        """A flow of the lattice as one of the subsystem by its coordinates."""
        assert isinstance(flow, PrimedFlow)
        flow.check_system(self.lattice)
        made = flow.bound(self.few).transferred(self.system)
        made.recipe, made.figures = dict(flow.recipe), dict(flow.figures)
        return made

    def whole(self, fitted: PrimedFlow) -> PrimedFlow:
        """The flow of the lattice with the fitted numbers, and its errors there."""
        flow = fitted.of_any_size(self.lattice)
        flow.domain = self.states
        flow.identify(self.lattice, self.states)
        flow.recipe = {name: value for name, value in fitted.recipe.items() if name != "scaling"}
        flow.recipe["fitted_on"] = self.few.ndof
        flow.figures, flow.history = dict(fitted.figures), fitted.history
        local = self.lattice.local
        assert local is not None
        if self.lattice.damping is None and local.uniform and local.ends:
            flow.figures |= {f"ends_{end}": self._error_at(flow, end) for end in BOUNDARIES}
        smaller = local.judged()  # with the same ends
        judged = self.lattice.subsystem(*smaller) if smaller else self.lattice
        assert judged.local is not None
        own = flow.bound(judged) if smaller else flow
        domain = self.states.of(judged)
        width = judged.local.numbers
        n = max(FEWEST, min(MOST_ORBITS, NUMBERS // width))
        labels = Labels.of(judged, states(domain, n, 0, Stream.REFERENCE), flow.dt * np.array([0.5, 1.0]))
        start = torch.as_tensor(labels.x)
        found = np.stack([own.psi(t, start).numpy() for t in labels.t.tolist()]) - labels.y
        unit = labels.x.std(0).mean() + np.zeros(labels.x.shape[1])
        flow.figures |= {**step_errors(found), "missed_share": shares_missed(found[-1], labels, unit)[0]}
        if judged.conservative:
            size = max(FEWEST, min(MOST_STATES, NUMBERS // width))
            certificate = own.certificate(judged, states=size, times=TIMES, held_out=n, t_end=CERTIFIED * own.dt)
            flow.certified = certificate
            flow.figures |= {
                "energy_error_median": certificate.relative_energy_error.median,
                "energy_error_95": certificate.relative_limit,
                "t_end": certificate.t_end,
                "judged_on": float(judged.ndof),
            }
        return flow

    def _error_at(self, flow: PrimedFlow, end: str) -> float:
        """The relative energy error, above rest, of a few in a row with such ends: the median over states."""
        few = self.lattice.subsystem()
        assert few.local is not None
        row = self.lattice.subsystem((COPIES * few.local.shape[0], *few.local.shape[1:]), (end, *few.local.ends[1:]))
        domain = self.states.of(row)
        x = states(domain, ENDS_STATES, 0, Stream.VALIDATION)
        kernel, H0 = flow.bound(row).kernel_for(row), row.hamiltonian(x)
        seen = row.hamiltonian(kernel.run(flow.dt, x, STEPS, np.arange(SEEN, STEPS + 1, SEEN)).states)
        worst = np.abs(seen - H0[:, None]).max(1) / (H0 - row.hamiltonian(domain.at_rest))
        return float(np.quantile(worst, 0.5, method="lower"))


# long runs ----------------------------------------------------------------------------------------------------------

PERIODS, LOOKS = 25.0, 10
"""Length of a run in periods of the fastest waves, and how often its energy is looked at."""
PROBE = 1e-6
"""Step of differences, in units of Δt or of the number that is changed, if that is more."""


class EnergyRuns(RunsFit):
    """Relative energy errors in runs of a lattice, as a function of the frozen parameters of a flow."""

    compiled = True

    def __init__(self, flow: PrimedFlow, system: HamiltonianSystem, x: np.ndarray, rest: float, t_end: float) -> None:
        self.flow, self.system, self._x = flow, system, x
        self.table = Table(flow)
        self._save = np.unique(np.linspace(0, math.ceil(t_end / flow.dt), LOOKS + 1).round().astype(np.int64))
        self._H = system.hamiltonian(x)
        self._scale = (self._H - rest) * math.sqrt(len(x) * (len(self._save) - 1))
        offset, design = self.table.frozen(flow.dt)
        self._frozen = offset[0], design[0]
        offset, design = self.table.polynomial(np.array([flow.dt]))
        self._at_dt = offset[0], design[0]
        self._back = np.linalg.pinv(design[0])
        self.record = {"runs": len(x), "runs_t_end": t_end}

    def own(self) -> EnergyRuns:  # the parameters are put into the flow
        other = copy.copy(self)
        other.flow = copy.deepcopy(self.flow)
        other.table = Table(other.flow)
        return other

    def parameters(self, theta: np.ndarray) -> np.ndarray:
        """The flow's parameters that make the table of `theta` at Δt and vary with t as little as may be."""
        wanted = self._frozen[0] + self._frozen[1] @ theta
        found = self.table.continued(wanted)
        return found + self._back @ (wanted - self._at_dt[0] - self._at_dt[1] @ found)

    @np.errstate(all="ignore")  # of tables that are far from the exact flow
    def residuals(self, theta: np.ndarray, check: Check = lambda: None) -> np.ndarray:
        check()
        wanted = self.parameters(theta)
        if not np.isfinite(wanted).all():  # of a step that overflowed
            return np.full(len(self._x) * (len(self._save) - 1), np.inf)
        self.table.assign(wanted)
        kernel, n = self.flow.kernel_for(self.system), int(self._save[-1])
        H = self.system.hamiltonian(kernel.run(self.flow.dt, self._x, n, self._save)[0])
        return ((H[:, 1:] - self._H[:, None]) / self._scale[:, None]).ravel()

    def linearized(self, theta: np.ndarray, check: Check = lambda: None) -> tuple[np.ndarray, np.ndarray]:
        r = self.residuals(theta, check)
        J = np.empty((len(r), len(theta)))
        for i, x in enumerate(theta):
            moved = theta.copy()
            moved[i] += PROBE * max(self.flow.dt, abs(x))
            J[:, i] = (self.residuals(moved, check) - r) / (moved[i] - x)
        return r, J


def check_runs(system: HamiltonianSystem, fit: PrimedFit) -> None:
    """Raise ValueError unless a flow of the system can be fitted to `runs`."""
    if not (system.local is not None and system.local.has_subsystem and system.conservative):
        raise ValueError(
            f"`runs` need a lattice that conserves its energy, and {system.name!r} is not one: leave it out."
        )
    if fit.data is not None:
        raise ValueError(
            "`runs` begin in states of a larger subsystem, and `data` are of the system itself: leave out one of them."
        )


def runs_of(subsystem: LatticeSubsystem, runs: int, seed: int, fitted: PrimedFlow) -> EnergyRuns:
    """Return the energy errors in so many runs of a larger subsystem, by the numbers of a flow of the subsystem."""
    whole = subsystem.lattice
    assert whole.local is not None
    larger = whole.subsystem(*whole.local.many())
    domain = subsystem.states.of(larger)
    x = states(domain, runs, seed, Stream.RUNS)
    t_end = PERIODS * 2 * math.pi / frequency(larger, domain)
    return EnergyRuns(fitted.of_any_size(larger), larger, x, float(larger.hamiltonian(domain.at_rest)), t_end)
