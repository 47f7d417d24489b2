"""Runs on an extended phase space: the states that were asked for are projections of those of the run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.arguments import warn
from sympflow.arrays import Array, to_numpy
from sympflow.events import EventSearch
from sympflow.integrators.contract import Interrupted, Outcome, Problem
from sympflow.integrators.interpolants import DenseOutput

if TYPE_CHECKING:
    from sympflow.integrators.compositions import Composition
    from sympflow.storage.runs import RunStore

APART = 0.1  # distance of two copies, over the size of the states of the run, beyond which these mean little


class ProjectedSolution(DenseOutput):
    """The dense output of a run on an extended phase space."""

    def __init__(self, sol: Any, extension: Composition) -> None:
        self.sol, self.extension, self.t_min, self.t_max = sol, extension, sol.t_min, sol.t_max

    def states(self, times: np.ndarray) -> Array:
        return self.extension.project(self.sol.states(times))


def extended_run(run: Callable[[Problem], Outcome], extension: Composition, problem: Problem) -> Outcome:
    """The outcome of a problem that is run on an extended phase space."""
    search = problem.events
    lifted, before = None, []
    if search is not None:  # which may go on from an earlier piece of the run
        lifted, before = EventSearch(_of_projections(search, extension), search.max_interval), search.found
        lifted.found, lifted.values, lifted.n_dense = [[*zeros] for zeros in before], search.values, search.n_dense
    store = problem.store
    if store is not None:
        store.project = lambda x: _noted(store, extension, x)
    stopped = None
    try:
        outcome = run(replace(problem, y0=extension.lift(problem.y0), events=lifted))
    except Interrupted as stop:
        outcome, stopped = stop.outcome, stop
    x = outcome.y
    if search is not None and lifted is not None:
        search.found = [
            old + [(t, extension.project(y)) for t, y in zeros[len(old) :]]
            for old, zeros in zip(before, lifted.found, strict=True)
        ]
        search.values = lifted.values
        search.end = None if lifted.end is None else (lifted.end[0], extension.project(lifted.end[1]))
        search.n_dense = lifted.n_dense
    outcome.y = extension.project(x)
    if outcome.sol is not None:
        outcome.sol = ProjectedSolution(outcome.sol, extension)
    if store is not None and "copy_distance" in store.noted:
        noted = np.array([store.noted[name] for name in ("copy_distance", "size")])
        outcome.stats["copy_distance"] = apart = float(_ratio(noted))
        if apart > APART and np.all(np.asarray(outcome.status) >= 0):
            _warn(extension, apart, "")
    elif len(x):
        _warn_of_distance(extension, to_numpy(x), outcome)
    if stopped is not None:
        raise stopped
    return outcome


def _of_projections(search: EventSearch, extension: Composition) -> Any:
    return tuple(
        replace(event, g=lambda t, x, g=event.g: g(t, extension.project(x)))  # type: ignore[misc]
        for event in search.events
    )


def _noted(store: RunStore, extension: Composition, x: np.ndarray) -> np.ndarray:
    """The states of those of the extended space; a store keeps how far these are from ones that stand for a state."""
    with np.errstate(all="ignore"):
        found = np.asarray(extension.distance(x)).reshape(-1, 2)
    if not np.isnan(found).all():
        apart, size = np.nanmax(found, axis=0).tolist()
        store.note(copy_distance=apart, size=size)
    return np.asarray(extension.project(x))


def _warn_of_distance(extension: Composition, x: np.ndarray, outcome: Outcome) -> None:
    with np.errstate(all="ignore"):
        ratio = _ratio(np.asarray(extension.distance(x)).max(0))
    outcome.stats["copy_distance"] = float(np.nanmax(ratio)) if not np.isnan(ratio).all() else float("nan")
    lost = (ratio > APART) & (np.asarray(outcome.status) >= 0)  # what has failed says more
    if lost.any():
        which = "" if lost.ndim == 0 else f" of {np.count_nonzero(lost)} of {lost.size} trajectories"
        _warn(extension, float(np.nanmax(ratio)), which)


def _ratio(found: np.ndarray) -> np.ndarray:
    """Distances in units of sizes, (..., 2) to (...); 0 where nothing is apart."""
    apart, size = found[..., 0], found[..., 1]
    return np.where(apart == 0, 0.0, apart / np.where(size == 0, 1.0, size))


def _warn(extension: Composition, apart: float, which: str) -> None:
    warn(
        f"The two copies{which} that method {extension.method!r} keeps differ by up to {apart:.3g} of the size of "
        "the states: these say little about the system. Reduce `dt`, or change `omega`, the strength by which the "
        "copies are bound.",
        RuntimeWarning,
    )
