"""Flows of lattices: fitted on a few sites, judged on many.

The numbers of a primed flow know the potential and Δt, not the size. So they are fitted to the exact flow of a ring of
a few sites, written out by its coordinates, at states of the energy density of the large lattice. Held-out states and
the certificate are those of the large one, with its own ends.
"""

from __future__ import annotations

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
from sympflow.training.points import Labels, Stream, shares_missed, states, step_errors

MOST_FITTED = 16
"""Degrees of freedom up to which a lattice is fitted as it is, and not by a piece."""
TAIL = 2.0
"""Times the upper density that the states of a piece have.

In a large lattice a few neighbours at a time have so much, and a flow's errors there decide about the energy of all."""
NUMBERS = 16_000
"""Numbers that the functions of a judgement handle, of all states together."""
FEWEST, MOST_ORBITS, MOST_STATES, TIMES, CERTIFIED = 8, 40, 200, 9, 250
"""The certificate: fewest and most orbits, states, times in [0, Δt], and the steps of the orbits."""
STEPS, SEEN, COPIES, ENDS_STATES = 200, 5, 4, 16
"""Energy errors at ends: steps, steps between two looks, pieces in a row, and states."""


def on_piece(system: HamiltonianSystem) -> bool:
    """Return True for a lattice, which a flow is fitted to by a piece."""
    return system.local is not None and system.local.has_piece and (system.damping is None or not system.damping.ndim)


@dataclass(frozen=True)
class LatticePiece:
    """The few sites that a flow of a lattice is fitted on."""

    lattice: HamiltonianSystem
    few: HamiltonianSystem
    system: HamiltonianSystem
    domain: Domain
    states: LatticeStates

    @classmethod
    def of(cls, lattice: HamiltonianSystem, domain: Domain) -> LatticePiece:
        """The piece of a lattice, for states of a domain of it."""
        found = domain if isinstance(domain, LatticeStates) else LatticeStates.of_states(lattice, domain.sample(DRAWN))
        small = lattice.ndof <= MOST_FITTED
        few = lattice if small else lattice.piece()
        local = few.local
        assert local is not None
        H, written = local.written_out(), few
        if H is not None:
            scene: Any = {"damping": lattice.damping, "t_span": lattice.t_span, "dt": lattice.dt}
            written = HamiltonianSystem.from_sympy(H, name=lattice.name, **scene)
        low, high = found.bounds
        excited = replace(found, density=(low, TAIL * high)).of(few)
        return cls(lattice, few, written, domain if small else excited, found.of(lattice))

    def small(self, flow: FlowMap) -> PrimedFlow:
        """A flow of the lattice as one of the piece by its coordinates."""
        assert isinstance(flow, PrimedFlow)
        flow.check_system(self.lattice)
        made = flow.bound(self.few).transferred(self.system)
        made.recipe, made.figures = dict(flow.recipe), dict(flow.figures)
        return made

    def whole(self, fitted: PrimedFlow) -> PrimedFlow:
        """The flow of the lattice with the numbers that were fitted, and what it achieves there."""
        flow = fitted.of_any_size(self.lattice)
        flow.domain = self.states
        flow.identify(self.lattice, self.states)
        flow.recipe = {name: value for name, value in fitted.recipe.items() if name != "scaling"}
        flow.recipe["fitted_on"] = self.few.ndof
        flow.figures, flow.history = dict(fitted.figures), fitted.history
        local = self.lattice.local
        if self.lattice.damping is None and local is not None and local.uniform and local.ends:
            flow.figures |= {f"ends_{end}": self._error_at(flow, end) for end in BOUNDARIES}
        judged, own = self._judged, flow
        assert judged.local is not None
        if judged is not self.lattice:
            own = flow.bound(judged)
        domain = self.states.of(judged)
        width = judged.local.numbers
        n = max(FEWEST, min(MOST_ORBITS, NUMBERS // width))
        flow.figures |= self._step_figures(own, judged, domain, n)
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

    @property
    def _judged(self) -> HamiltonianSystem:
        """The system, or a smaller one with the same ends."""
        assert self.lattice.local is not None
        judged = self.lattice.local.judged()
        return self.lattice.piece(*judged) if judged else self.lattice

    @torch.no_grad()
    def _step_figures(self, flow: PrimedFlow, system: HamiltonianSystem, domain: Domain, n: int) -> dict[str, float]:
        """Errors of one step at held-out states of the lattice, and the share that it misses."""
        x = states(domain, n, 0, Stream.REFERENCE)
        labels = Labels.of(system, x, flow.dt * np.array([0.5, 1.0]))
        start = torch.as_tensor(labels.x)
        found = np.stack([flow.psi(t, start).numpy() for t in labels.t.tolist()]) - labels.y
        unit = labels.x.std(0).mean() + np.zeros(labels.x.shape[1])
        missed = shares_missed(found[-1], labels, unit)[0]
        return {**step_errors(found), "missed_share": missed}

    @torch.no_grad()
    def _error_at(self, flow: PrimedFlow, end: str) -> float:
        """The relative energy error, above rest, of a few pieces in a row with such ends: the median over states."""
        few = self.lattice.piece()
        assert few.local is not None
        row = self.lattice.piece((COPIES * few.local.shape[0], *few.local.shape[1:]), (end, *few.local.ends[1:]))
        domain = self.states.of(row)
        x = torch.as_tensor(states(domain, ENDS_STATES, 0, Stream.VALIDATION))
        own = flow.bound(row)
        still = torch.as_tensor(domain.at_rest)
        H0, y = row.hamiltonian(x), own.prepare(flow.dt, x)
        worst = torch.zeros_like(H0)
        for k in range(1, STEPS + 1):
            y = own.kernel_step(flow.dt, y)
            if k % SEEN == 0:
                worst = torch.maximum(worst, (row.hamiltonian(own.finish(flow.dt, y)) - H0).abs())
        return float((worst / (H0 - row.hamiltonian(still))).median())
