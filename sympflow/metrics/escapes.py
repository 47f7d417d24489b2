"""escape_times(): when orbits leave a region of phase space."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import real_number, warn
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep
from sympflow.integrators.contract import FINISHED, Problem
from sympflow.integrators.diagnosis import try_steps
from sympflow.integrators.grid import Grid
from sympflow.integrators.impulses import landings, pieces_of
from sympflow.integrators.registry import naming_plugin
from sympflow.integrators.steppers import Stepper
from sympflow.metrics.crossings import bisected
from sympflow.metrics.orbits import OfOrbits, Orbits, checked_orbits, of_many
from sympflow.systems.given import GivenSystem, given_system

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WINDOW = 256  # steps between which orbits that have left are put aside
MOST_VALUES = 1 << 21  # numbers of states that are held at a time
HALVINGS = 48

Outside = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, repr=False)
class Escapes(OfOrbits):
    """When and where orbits left a region.

    Attributes
    ----------
    time : float or ndarray of shape (...)
        The time of the escape; inf of an orbit that stayed, NaN of one that failed.
    state : ndarray of shape (..., 2d)
        The state then; NaN of an orbit that did not escape.
    status : int or ndarray of shape (...)
        1 where the orbit escaped, 0 where it stayed to the end, −1 where it became non-finite before it was outside.
    message : str
    """

    caption: ClassVar[str] = "Escapes"
    facts: ClassVar[tuple[str, ...]] = ("time", "state", "status")
    time: Any
    state: np.ndarray = field(repr=False)
    status: Any
    message: str

    def drawn(self) -> Figure:
        return of_many("time of escape", self.time, "it is `time`")


def escape_times(
    system: GivenSystem,
    method: Any = None,
    t_span: tuple[float, float] | None = None,
    y0: ArrayLike | None = None,
    *,
    outside: Any = None,
    backend: str = "auto",
    **options: Any,
) -> Escapes:
    """The times at which orbits leave a region of phase space.

    The states after each step are checked; the time of the escape is found by bisection, with shorter steps from the
    last state inside. An orbit that is outside only between two steps is not detected. No states are stored, and an
    orbit that has left is not continued.

    Parameters
    ----------
    system : HamiltonianSystem
    method : str, Integrator or trained flow, optional
        By default one that suits the system, as for `solve`; of fixed steps.
    t_span, y0
        As for `solve`; y0 may be a batch of shape (..., 2d).
    outside : float, domain or callable, optional
        A radius: outside is |q| > radius; a domain such as `sympflow.Box`: outside is not in it; or a function of
        states (..., 2d) that returns booleans (...). The default is the system's domain.
    backend : "auto", "compiled" or "array"
        As for `solve`.
    **options
        Options of the method, such as `dt`.

    Returns
    -------
    Escapes

    Raises
    ------
    ValueError, TypeError
        For bad arguments, at once.

    Examples
    --------
    >>> import sympflow
    >>> system = sympflow.systems.henon_heiles_escape()
    >>> found = escape_times(system, "kahan_li8", (0, 20), outside=10.0, dt=0.01)
    >>> round(float(found.time), 3), int(found.status)
    (4.656, 1)
    """
    system = given_system(system)
    orbits = checked_orbits(system, method, t_span, y0, options, "escapes are located on")
    region, rows = region_of(outside, system), orbits.rows
    _inside(region, rows[:1])
    time, state, status = escapes(orbits, region, backend)
    message = FINISHED
    if (status < 0).any():
        message = (
            f"{int((status < 0).sum())} of {len(rows)} orbits ceased to be finite before they were seen outside, the "
            f"first of them of index {int(np.argmax(status < 0))}: reduce `dt`."
        )
    batch = orbits.batch
    return Escapes(time.reshape(batch)[()], state.reshape((*batch, -1)), status.reshape(batch)[()], message)


def region_of(outside: Any, system: HamiltonianSystem) -> Outside:
    """The function of states that `outside` means; a ValueError or TypeError if it means none."""
    if outside is None:
        if system.domain is None:
            raise ValueError(
                f"`outside` is needed, as {system.name!r} has no domain: pass a radius, a domain or a function."
            )
        outside = system.domain
    if real_number(outside):
        if not 0 < outside < np.inf:
            raise ValueError(f"`outside` must be a positive radius; got {outside!r}.")
        return lambda y: np.square(y[..., : system.ndof]).sum(-1) > outside**2
    contains = getattr(outside, "contains", None)
    if contains is not None:
        return lambda y: ~contains(y)
    if not callable(outside):
        raise TypeError(
            f"`outside` must be a radius, a domain, or a function of states (..., 2d); got {type(outside).__name__}."
        )
    return outside


def _inside(region: Outside, y: np.ndarray) -> np.ndarray:
    with np.errstate(all="ignore"):
        out = np.asarray(region(y))
    if out.shape != y.shape[:-1] or out.dtype != bool:
        raise ValueError(
            f"`outside` must return booleans of shape {y.shape[:-1]} for states of shape {y.shape}; got {out.dtype} of "
            f"shape {out.shape}."
        )
    return ~out


def escapes(orbits: Orbits, region: Outside, backend: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The times (N,), states (N, 2d) and statuses (N,), some rows after others; a ValueError without fixed steps."""
    integrator = orbits.integrator
    if not (isinstance(integrator, FixedStep) and integrator.on_grid):
        raise ValueError(
            f"`method` {integrator.name!r} has no fixed steps of the states, after which escapes are looked for: use "
            "a splitting method such as 'kahan_li8', or 'gauss_legendre6'."
        )
    told, _ = landings(integrator, orbits.system, *orbits.t_span)
    if told:
        warn(told, RuntimeWarning)
    rows = orbits.rows
    try_steps(integrator, orbits.system, orbits.t_span, rows)
    most = max(1, MOST_VALUES // (WINDOW * rows.shape[1]))
    with naming_plugin(integrator):
        parts = [_escapes(integrator, orbits, rows[i : i + most], region, backend) for i in range(0, len(rows), most)]
    time, state, status = (np.concatenate(found) for found in zip(*parts, strict=True))
    return time, state, status


def _escapes(
    integrator: FixedStep, orbits: Orbits, rows: np.ndarray, region: Outside, backend: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    system, (t0, t1) = orbits.system, orbits.t_span
    time, state = np.full(len(rows), np.inf), np.full(rows.shape, np.nan)
    status = np.zeros(len(rows), dtype=np.int64)
    began = ~_inside(region, rows)
    time[began], state[began], status[began] = t0, rows[began], 1
    where = np.flatnonzero(~began)
    y = rows[where]
    for start, end in pieces_of(integrator, system, t0, t1):
        grid, k = Grid(start, end, integrator.step_length(system)), 0
        total = grid.n_steps + bool(grid.remainder)
        while k < total and where.size:
            n = min(WINDOW, grid.n_steps - k)
            stepper = integrator.stepper(Problem(system, grid.time(k), end, y, backend=backend))
            with np.errstate(all="ignore"):
                if n:
                    h = grid.h
                    states, _ = stepper.rollout(y, h, n, np.arange(n + 1), grid.time(k))
                else:
                    n, h = 1, grid.remainder
                    states = np.stack([y, stepper.shorter(y, h, grid.time(k))])
            finite = np.isfinite(states).all(-1)
            left = ~finite
            left[finite] = ~_inside(region, states[finite])
            gone, first = left.any(0), np.argmax(left, axis=0)
            lanes = np.flatnonzero(gone)
            before, escaped = states[first[lanes] - 1, lanes], finite[first[lanes], lanes]
            status[where[lanes]] = np.where(escaped, 1, -1)
            time[where[lanes]] = np.nan
            found = where[lanes[escaped]]
            begin = grid.t0 + (k + first[lanes[escaped]] - 1) * grid.h
            if len(found):
                part, state[found] = _located(stepper, begin, before[escaped], h, region)
                time[found] = begin + part
            y, where = states[-1, ~gone], where[~gone]
            k += n
    return time, state, status


def _located(stepper: Stepper, times: Any, y: np.ndarray, h: float, region: Outside) -> tuple[np.ndarray, np.ndarray]:
    """The parts (n,) of steps from y (n, 2d) at times (n,) after which states are outside, and these states."""

    def inside(part: np.ndarray) -> np.ndarray:
        return _inside(region, np.asarray(stepper.shorter(y, part * h, times)))

    _, out = bisected(np.zeros(len(y)), np.ones(len(y)), inside, HALVINGS)
    return out * h, np.asarray(stepper.shorter(y, out * h, times))
