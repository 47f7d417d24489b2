"""The fit of a flow of a lattice to long runs: to the energy errors of many sites.

One step of the exact flow on a few sites tells little of what a large lattice does to its energy in a thousand. The
modified energy that a flow keeps differs from H by terms that hardly change in a step, such as the actions of waves
whose frequencies are a bit wrong; these change as waves exchange energy, and a few sites have few wave lengths. So the
best few tables at Δt that labels find are fitted further, to the errors of H in runs from many states of a ring: which
of them is best is not seen in a step. The labels stay as a weak bound. The polynomials in t vary as
little as may be, or are fitted to labels before Δt from there.
"""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING

import numpy as np

from sympflow.flow.primed import PrimedFlow
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.training.fits import PrimedFit
from sympflow.training.points import Stream, states
from sympflow.training.starts import frequency
from sympflow.training.table_fit import RunsFit, Table
from sympflow.training.table_step import Check

if TYPE_CHECKING:
    from sympflow.training.lattice_fit import LatticePiece

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
    """Raise ValueError unless a flow of the system can be fitted to the `runs` that are asked for."""
    if not (system.local is not None and system.local.has_piece and system.conservative):
        raise ValueError(f"`runs` are of lattices that keep their energy, and {system.name!r} is none: leave it out.")
    if fit.data is not None:
        raise ValueError(
            "`runs` begin in states of a larger piece of the system, and `data` are of itself: leave out one of them."
        )


def runs_of(piece: LatticePiece, runs: int, seed: int, fitted: PrimedFlow) -> EnergyRuns:
    """Return the energy errors in so many runs of a larger piece, by the numbers of a flow of the piece."""
    whole = piece.lattice
    assert whole.local is not None
    larger = whole.piece(*whole.local.many())
    domain = piece.states.of(larger)
    x = states(domain, runs, seed, Stream.RUNS)
    t_end = PERIODS * 2 * math.pi / frequency(larger, domain)
    return EnergyRuns(fitted.of_any_size(larger), larger, x, float(larger.hamiltonian(domain.at_rest)), t_end)
