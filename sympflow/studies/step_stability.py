"""stability(): how long a step each method bears on a system, and what happens beyond."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import check_counts, check_t_span
from sympflow.arrays import is_tensor
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.solver import check_y0, solve
from sympflow.studies.candidates import candidates
from sympflow.studies.comparison_report import title
from sympflow.studies.stability_report import StabilityReport, StabilityRow, StepLimit
from sympflow.studies.stability_study import Study
from sympflow.studies.step_limits import step_limit

DEFAULT = ("sympflow", "verlet", "leapfrog", "kahan_li8", "implicit_midpoint", "rk4", "rk45")
METRICS = ("energy", "drift", "volume", "symplecticity", "domain")
PHASES = (0.0, 3.0, 10.0, 31.0)
"""Where the initial states lie along the orbit, in the system's steps: several, for one may hide an instability."""


def stability(
    system: HamiltonianSystem | Sequence[HamiltonianSystem],
    methods: Sequence[Any] = DEFAULT,
    *,
    steps: Sequence[float] | None = None,
    t_span: tuple[float, float] | None = None,
    y0: ArrayLike | None = None,
    dtypes: Sequence[str] = ("float64",),
    metrics: Sequence[str] = METRICS,
    bound: float = 1e3,
    min_steps: int = 1000,
    max_steps: int = 1_000_000,
    limits: bool = True,
    progress: Callable[[str], None] | None = None,
) -> StabilityReport:
    """Run every method with a range of steps, find the longest stable one, and say how the longer ones fail.

    Parameters
    ----------
    system : HamiltonianSystem or sequence of them
        A sequence is a family, such as one system at several stiffnesses: it gives a stability map.
    methods : sequence
        As for `compare`. A trained flow is run at fractions of its Δt; an adaptive method once, at its tolerance.
    steps : sequence of float, optional
        Steps of the fixed-step methods; by default from half the system's `dt` to 64 times it.
    t_span : (float, float), optional
        The default is the system's. It is extended to hold `min_steps` steps, and shortened to hold `max_steps`.
    y0 : array_like (2d,) or (n, 2d), optional
        Initial states. From one state, by default the system's, three more are taken along its orbit: from a single
        state an instability may not show (of an oscillator at rest at its largest q, at exactly dt·ω = 2).
    dtypes : sequence of "float64", "float32"
    metrics : sequence of str
        Any of "energy", "drift", "volume", "symplecticity" and "domain". The Jacobians for volume and symplecticity
        are those of the first 256 steps.
    bound : float
        A run whose energy error exceeds it counts as unstable, as one that becomes non-finite does.
    min_steps, max_steps : int
        Steps of a run; where both cannot be, `max_steps` holds. Methods that run with array operations, and float32,
        take at most `max_steps`/200.
    limits : bool
        Whether to find the longest stable step, by bisection between the longest stable and the shortest unstable one,
        to 0.2 %. If all are stable, longer ones are tried, and shorter ones if none is.
    progress : callable, optional
        Called with a line of text when something begins: a method, each of its steps, each trial for the longest one.

    Returns
    -------
    StabilityReport
        With `.rows` (one for each system, method, precision and step), `.limits`, `.table()`, `.to_csv()`, `.plot()`.

    Examples
    --------
    >>> import sympflow
    >>> oscillator = sympflow.systems.harmonic_oscillator(1000.0)
    >>> report = sympflow.stability(oscillator, ["verlet"], steps=[1e-3, 3e-3], metrics=("energy",))
    >>> [row.status for row in report.rows]
    ['stable', 'unstable']
    >>> round(1000 * report.limits[0].stable, 2)
    2.0
    """
    family = (system,) if isinstance(system, HamiltonianSystem) else tuple(system)
    if not family or not all(isinstance(s, HamiltonianSystem) for s in family):
        raise TypeError("`system` must be a HamiltonianSystem or a sequence of them.")
    unknown = [m for m in metrics if m not in METRICS]
    if isinstance(metrics, str) or unknown:
        raise ValueError(f"`metrics` must be a list of names from {', '.join(METRICS)}; got {metrics!r}.")
    check_counts(min_steps=min_steps, max_steps=max_steps)
    real = isinstance(bound, int | float | np.number) and not isinstance(bound, bool)
    if not real or np.iscomplexobj(bound) or not 0 < bound < math.inf:
        raise ValueError(f"`bound` must be positive and finite, a relative energy error; got {bound!r}.")
    if progress is not None and not callable(progress):
        raise TypeError(f"`progress` must be a function of one line of text; got {progress!r}.")
    lengths = None if steps is None else _checked_steps(steps)
    unknown = [d for d in dtypes if d not in ("float32", "float64")]
    if isinstance(dtypes, str) or unknown or not len(dtypes):
        raise ValueError(f"`dtypes` must be a list of 'float32' and 'float64'; got {dtypes!r}.")
    rows: list[StabilityRow] = []
    found: list[StepLimit] = []
    for one in family:
        span = check_t_span(one.t_span if t_span is None else t_span)
        if span[0] == span[1]:
            raise ValueError("`t_span` has length zero, so there is nothing to run: choose a later end.")
        starts = initial_states(one, y0)
        for candidate in candidates(methods):
            for dtype in dtypes:
                say = partial(_say, progress, f"{title(one)}: {candidate.label}, {dtype}")
                study = Study(one, candidate, dtype, span, starts, tuple(metrics), bound, min_steps, max_steps, say)
                say("")
                own = [study.row(h) for h in study.lengths(lengths)]
                rows += own
                if limits and study.has_steps and any(row.status != "not applicable" for row in own):
                    found.append(step_limit(study, own))
    return StabilityReport(family, tuple(metrics), float(bound), tuple(rows), tuple(found))


def _say(progress: Callable[[str], None] | None, what: str, detail: str) -> None:
    if progress is not None:
        progress(f"{what}, {detail}" if detail else what)


def initial_states(system: HamiltonianSystem, y0: ArrayLike | None) -> np.ndarray:
    """The states (n, 2d) that runs start from: those given, or one and three more along its orbit."""
    if is_tensor(y0):
        raise TypeError("`y0` must be a NumPy array, for every method of the study takes one: pass y0.numpy().")
    given = check_y0(system, system.y0 if y0 is None else y0, None)
    if given.ndim > 2:
        raise ValueError(f"`y0` must have shape (2d,) or (n, 2d); got {given.shape}.")
    if given.ndim == 2:
        return given
    times = system.dt * np.array(PHASES)
    sol = solve(system, "dop853", (0.0, float(times[-1])), given, t_eval=times, rtol=1e-11, atol=1e-13)
    return sol.states if sol.success and np.isfinite(sol.y).all() else given[None]


def _checked_steps(steps: Sequence[float]) -> list[float]:
    try:
        if any(isinstance(h, bool | np.bool_ | str) for h in steps):
            raise TypeError("no step lengths")
        lengths = sorted(float(h) for h in steps)
    except (TypeError, ValueError) as error:
        raise TypeError(f"`steps` must be a list of step lengths; got {steps!r}.") from error
    if not lengths or not all(0 < h < math.inf for h in lengths):
        raise ValueError(f"`steps` must be positive and finite; got {steps!r}.")
    return lengths
