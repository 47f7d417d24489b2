"""Arguments of functions that follow orbits, states as NumPy arrays: checked as `solve` checks them."""

from __future__ import annotations

import os
from abc import abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import check_array, check_t_span
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.choosing import integrator_for, with_start
from sympflow.integrators.contract import Integrator
from sympflow.integrators.problems import check_y0
from sympflow.integrators.registry import check_applies
from sympflow.show.cards import Answering, Card, numbers
from sympflow.show.pictures import histogram_figure
from sympflow.show.style import saved
from sympflow.systems.given import GivenSystem, given_system

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class OfOrbits(Answering):
    """Results of orbits, with a `status`, negative for orbits that failed, a `message`, and a figure."""

    caption: ClassVar[str]
    facts: ClassVar[tuple[str, ...]]  # names of what a card shows
    status: Any
    message: str

    @property
    def success(self) -> bool:
        """True if no orbit failed."""
        return bool(np.all(np.asarray(self.status) >= 0))

    def card(self) -> Card:
        values = ((name, getattr(self, name)) for name in self.facts)
        shown = {name: numbers(np.abs(x) if np.iscomplexobj(x) else x) for name, x in values}
        return Card(self.caption, shown, self.message)

    @abstractmethod
    def drawn(self) -> Figure:
        """Return the figure; a ValueError if there is nothing to draw."""

    def preview(self) -> Figure | None:
        try:
            return self.drawn()
        except ValueError:
            return None

    def plot(self, path: str | os.PathLike[str] | None = None) -> Figure:
        """Draw the result. With a `path` (.png, .pdf or .svg) the figure is saved too; matplotlib is needed.

        Raises
        ------
        ValueError
            If there is nothing to draw: one number, or none that is finite.
        """
        return saved(self.drawn(), path)


def of_many(name: str, values: Any, remedy: str) -> Figure:
    """Return the histogram of a number of each orbit; a ValueError with the remedy where there are fewer than two."""
    values = np.ravel(values)
    if np.count_nonzero(np.isfinite(values)) < 2:
        raise ValueError(f"`plot` needs at least two orbits with a finite {name}, for a histogram: {remedy}.")
    return histogram_figure({name: values}, f"{len(values):,} orbits")


class Orbits(NamedTuple):
    """A method on a system, the interval, and the initial states (..., 2d)."""

    system: HamiltonianSystem
    integrator: Integrator
    t_span: tuple[float, float]
    y0: np.ndarray

    @property
    def rows(self) -> np.ndarray:
        """The initial states as (N, 2d)."""
        return self.y0.reshape(-1, self.y0.shape[-1])

    @property
    def batch(self) -> tuple[int, ...]:
        """The shape of the batch, () of one orbit."""
        return self.y0.shape[:-1]


def checked_orbits(
    system: GivenSystem,
    method: Any,
    t_span: tuple[float, float] | None,
    y0: ArrayLike | None,
    options: Mapping[str, Any],
    purpose: str,
) -> Orbits:
    """Orbits, the arguments checked as those of `solve`; `purpose` is what NumPy arrays are needed for, as a clause."""
    system = given_system(system)
    span = check_t_span(system.t_span if t_span is None else t_span)
    check_array(y0, f"{purpose} NumPy arrays")
    start = check_y0(system, system.y0 if y0 is None else y0, None)
    integrator = integrator_for(system, method, options, span, start)
    system = with_start(integrator, system, start)
    integrator = integrator.resolved(system, start, abs(span[1] - span[0]))
    check_applies(integrator, system, start)
    return Orbits(system, integrator, span, start)
