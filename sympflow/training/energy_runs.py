"""The fit of a flow of a lattice or of like bodies to long runs: to the energy errors of many sites or bodies.

One step of the exact flow on a few sites tells little of what a large lattice does to its energy in a thousand. The
modified energy that a flow keeps differs from H by terms that hardly change in a step, such as the actions of waves
whose frequencies are a bit wrong; these change as waves exchange energy, and a few sites have few wave lengths. So the
table at Δt, found by labels, is fitted further: to the errors of H in runs from many states of a ring, or of a cluster.
The labels stay as a weak bound. Then the table is made to vary with t as little as may be, so that steps somewhat
shorter than Δt keep energy as well.
"""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING

import numpy as np

from sympflow.flow.primed import PrimedFlow
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.training.options import check_counts
from sympflow.training.points import Labels, Stream, states
from sympflow.training.session import Deadline
from sympflow.training.starts import frequency
from sympflow.training.table_fit import Fit, StackedFit, Table, TableFit, energy_slope
from sympflow.training.table_step import Check, TableStep

if TYPE_CHECKING:
    from sympflow.training.lattice_fit import Piece

PERIODS, LOOKS = 25.0, 6
"""Length of a run in periods of the fastest waves, and how often its energy is looked at."""
LABEL_WEIGHT, ENERGY_WEIGHT = 1e-5, 100.0
"""Weight of the labels at Δt beside the energies of runs, and among labels that of the energy."""
POINTS, ITERATIONS = 60, 30
"""Labelled states, and most iterations of the fit."""
PROBE = 1e-6
"""Step of differences, in units of Δt or of the number that is changed, if that is more."""


class EnergyRuns(Fit):
    """Relative energy errors in runs of a lattice or of like bodies, as a function of the frozen parameters of a flow.

    Parameters
    ----------
    flow : PrimedFlow
        Of the system; its numbers are changed.
    system : HamiltonianSystem
        The lattice or the bodies.
    x : ndarray of shape (N, 2d)
        Where the runs begin.
    rest : float
        H of the system at rest.
    t_end : float
    """

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

    def parameters(self, theta: np.ndarray) -> np.ndarray:
        """The flow's parameters that make the table of `theta` at Δt and vary with t as little as may be."""
        wanted = self._frozen[0] + self._frozen[1] @ theta
        found = self.table.continued(wanted)
        return found + self._back @ (wanted - self._at_dt[0] - self._at_dt[1] @ found)

    def start(self) -> np.ndarray:
        """The frozen parameters of the flow as it was given."""
        return self.table.frozen_parameters(self._at_dt[0] + self._at_dt[1] @ self.table.parameters())

    @np.errstate(all="ignore")  # of tables that are far from the exact flow
    def residuals(self, theta: np.ndarray, check: Check = lambda: None) -> np.ndarray:
        check()
        wanted = self.parameters(theta)
        if not np.isfinite(wanted).all():  # of a step that overflowed
            return np.full(len(self._x) * (len(self._save) - 1), np.inf)
        self.table.assign(wanted)
        kernel, n = self.flow.kernel_for(self.system), int(self._save[-1])
        H = self.system.hamiltonian(kernel.run_batch(self.flow.dt, self._x, n, self._save)[0])
        return ((H[:, 1:] - self._H[:, None]) / self._scale[:, None]).ravel()

    def linearized(self, theta: np.ndarray, check: Check = lambda: None) -> tuple[np.ndarray, np.ndarray]:
        r = self.residuals(theta, check)
        J = np.empty((len(r), len(theta)))
        for i, x in enumerate(theta):
            moved = theta.copy()
            moved[i] += PROBE * max(self.flow.dt, abs(x))
            J[:, i] = (self.residuals(moved, check) - r) / (moved[i] - x)
        return r, J


def check_runs(system: HamiltonianSystem, runs: int) -> None:
    """Raise ValueError unless a flow of the system can be fitted to so many runs."""
    check_counts(runs=runs)
    if not (system.local is not None and system.local.has_piece and system.conservative):
        raise ValueError(
            f"`runs` are of lattices and like bodies that keep their energy, and {system.name!r} is none: leave it out."
        )


def fit_to_runs(fitted: PrimedFlow, piece: Piece, runs: int, seed: int, deadline: Deadline) -> None:
    """Fit the numbers of a flow of a piece further, to so many runs of a larger one.

    They stay as they are, with a warning, where the runs of the flow are not finite, or there is no time.
    """
    whole, dt = piece.lattice, fitted.dt
    assert whole.local is not None
    larger = whole.piece(*whole.local.many())
    domain = piece.states.of(larger)
    x = states(domain, runs, seed, Stream.RUNS)
    t_end = PERIODS * 2 * math.pi / frequency(larger, domain)
    energies = EnergyRuns(fitted.of_any_size(larger), larger, x, float(larger.hamiltonian(domain.at_rest)), t_end)
    theta = energies.start()
    late = deadline.over()
    if late or not np.isfinite(energies.residuals(theta)).all():
        reason = "the time was up" if late else "those of the flow do not stay finite: take a shorter `dt`"
        warnings.warn(f"The flow was not fitted to `runs`, because {reason}.", RuntimeWarning, stacklevel=4)
        return
    step = TableStep(piece.system, fitted.sequence, fitted.tables.level, compiled=True)
    labels = Labels.needed(piece.system, states(piece.domain, POINTS, seed, Stream.LABELS), np.array([dt]))
    table, unit = Table(fitted), np.full(2 * piece.system.ndof, labels.x.std(0).mean())
    slope = energy_slope(piece.system, labels, ENERGY_WEIGHT)
    bound = TableFit(step, labels, *table.frozen(dt), unit, np.ones(1), slope)
    found = StackedFit((1.0, energies), (LABEL_WEIGHT, bound)).minimize(theta, ITERATIONS, deadline)
    table.assign(energies.parameters(found.x))
    stage = {"optimizer": "gauss-newton", "loss": "energy", "runs": runs, "seed": seed, "t_end": t_end}
    fitted.recipe["stages"] = [*fitted.recipe["stages"], stage]
