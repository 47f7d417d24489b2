"""Events: the zeros of functions g(t, y) along a solution, found step by step while it is computed."""

from __future__ import annotations

import inspect
import itertools
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from sympflow.arguments import warn
from sympflow.arrays import Array, copied, detached, differentiable, stack, to_numpy

EventFunction = Callable[[float, Array], Any]
Dense = Callable[[float], Array]  # the state at a time within one step
_EPS = float(np.finfo(float).eps)


@dataclass(frozen=True)
class Event:
    """A function g(t, y) of one state (2d,), zero at the event, with SciPy's attributes."""

    g: EventFunction
    limit: float = math.inf  # the occurrence at which the solution ends
    direction: float = 0.0  # positive: only where g increases; negative: where it decreases; zero: both
    label: str = "`events`"  # in messages

    def value(self, t: float, y: Array) -> float:
        value = self.g(t, copied(y))  # a g that writes into its y changes no result
        try:
            number = float(to_numpy(value))
            if isinstance(value, bool | np.bool_):
                raise TypeError(f"it returned {value}, which does not locate the event")
        except (TypeError, ValueError) as error:
            raise TypeError(
                f"{self.label} must return one number for a time and a state of shape {tuple(y.shape)}; {error}. "
                "Return a scalar, e.g. y[0]."
            ) from error
        if math.isnan(number) and np.isfinite(to_numpy(y)).all():
            raise ValueError(f"{self.label} returned NaN at t = {t:.15g}: return a number for every finite state.")
        return number

    def crossed(self, before: float, after: float) -> bool:
        """Return True if the sign changed in the required direction, from `before` to `after`."""
        up, down = before <= 0 <= after, before >= 0 >= after
        return (up and self.direction >= 0) or (down and self.direction <= 0)


def parse(events: Any) -> tuple[Event, ...]:
    """Events from functions with optional attributes `terminal`, True or a count, and `direction`."""
    if events is None:
        return ()
    functions = (events,) if callable(events) else events
    if not isinstance(functions, Sequence):
        raise TypeError(f"`events` must be a function g(t, y) or a list of them; got {type(events).__name__}.")
    return tuple(_parse_one(g, f"`events[{i}]`" if len(functions) > 1 else "`events`") for i, g in enumerate(functions))


def _parse_one(g: Any, label: str) -> Event:
    if not callable(g):
        raise TypeError(f"{label} must be a function g(t, y); got {type(g).__name__}.")
    with suppress(ValueError):  # of a function without a signature
        try:
            inspect.signature(g).bind(0.0, None)
        except TypeError as error:
            raise TypeError(f"{label} is called with (t, y), a time and a state: {error}. Write g(t, y).") from error
    terminal, direction = getattr(g, "terminal", None), getattr(g, "direction", 0)
    if terminal is None or terminal is False or terminal == 0:
        limit = math.inf
    elif isinstance(terminal, int | float | np.number | np.bool_) and terminal > 0 and int(terminal) == terminal:
        limit = float(terminal)
    else:
        raise ValueError(f"{label} has `terminal` = {terminal!r}: make it True, False or a positive count.")
    if not isinstance(direction, int | float | np.number) or math.isnan(direction):
        raise ValueError(f"{label} has `direction` = {direction!r}: make it a positive or negative number, or 0.")
    return Event(g, limit, float(direction), label)


class EventSearch:
    """The events of one run. The integrator hands over every step; the zeros inside are located by Brent's method.

    A zero that falls exactly on the end of a step counts once, in that step; one at t0 counts, as in SciPy. Steps
    longer than `max_interval` are sampled in between, at equal parts; the default is the integrator's choice.
    """

    def __init__(self, events: tuple[Event, ...], max_interval: float | None = None) -> None:
        self.events, self.max_interval = events, max_interval
        self.may_end_run = any(math.isfinite(event.limit) for event in events)
        self.found: list[list[tuple[float, Array]]] = [[] for _ in events]
        self.values: list[float] | None = None
        self.end: tuple[float, Array] | None = None  # the time and state of the terminal event that ended the run
        self.n_dense = 0  # evaluations of the dense output
        self.project: Callable[[Array], Array] = lambda x: x  # of the states of the run to those that events are given

    def afresh(self) -> EventSearch:
        """Return a search for the same events that has found none."""
        return EventSearch(self.events, self.max_interval)

    def forget_after(self, t: float, h: float) -> None:
        """Leave out events later in the run than t, in steps of length h that were not searched."""
        self.end = None
        for zeros in self.found:
            while zeros and (zeros[-1][0] - t) * h > 0:
                zeros.pop()

    def parts(self, h: float, default: float = math.inf) -> int:
        """The number of equal parts at whose ends a step of length h is sampled; `default` is the interval if unset."""
        return max(1, math.ceil(abs(h) / (self.max_interval or default) * (1 - 4 * _EPS)))

    def step(
        self, t_old: float, y_old: Array, t: float, y: Array, dense: Dense, inner: Sequence[Array] | None = None
    ) -> tuple[float, Array] | None:
        """Search one step from (t_old, y_old) to (t, y): where the run ends in it, if it does.

        `inner` are the states that divide the step into equal parts, if they are known already.
        """
        first = self.values is None
        if first:
            self.values = [event.value(t_old, self.project(y_old)) for event in self.events]

        def inside(s: float) -> Array:
            if s in (t, t_old):
                return y if s == t else y_old
            self.n_dense += 1
            return dense(s)

        n = self.parts(t - t_old) if inner is None else len(inner) + 1
        ends = [t_old + (t - t_old) * i / n for i in range(n)] + [t]
        for i, (a, b) in enumerate(itertools.pairwise(ends)):
            y_b = inside(b) if inner is None or i == n - 1 else inner[i]
            if self._part(a, b, y_b, inside, first):
                return self.end
            first = False
        return None

    def _part(self, a: float, b: float, y_b: Array, inside: Dense, first: bool) -> bool:
        before = self.values
        assert before is not None
        self.values = after = [event.value(b, self.project(y_b)) for event in self.events]
        zeros: list[tuple[float, int]] = []
        for i, event in enumerate(self.events):
            if (before[i] or first) and event.crossed(before[i], after[i]):
                zeros.append((self._locate(event, a, b, before[i], after[i], inside), i))
        for t, i in sorted(zeros, key=lambda zero: zero[0] if b >= a else -zero[0]):
            y = inside(t)
            followed = differentiable(y)
            y = detached(y)  # the time depends on y0 as well: a gradient through y alone is wrong
            self.found[i].append((t, self.project(y)))
            if len(self.found[i]) >= self.events[i].limit:
                if followed:
                    warn(
                        "The state at the event that ends the run has no gradient, nor has its time: use "
                        "sympflow.interop.torchdiffeq.odeint_event, which gives both.",
                        UserWarning,
                    )
                self.end = (t, y)
                return True
        return False

    def _locate(self, event: Event, a: float, b: float, g_a: float, g_b: float, inside: Dense) -> float:
        """The zero in [a, b], to rounding."""
        if g_a == 0 or a == b:
            return a
        if g_b == 0:
            return b
        known = {a: g_a, b: g_b}
        # a power of two, exact: Brent's products shall not underflow
        unit = math.ldexp(1.0, min(-math.frexp(max(abs(g_a), abs(g_b)))[1], 1000))

        def g(s: float) -> float:
            return unit * (known[s] if s in known else event.value(s, self.project(inside(s))))

        from scipy.optimize import brentq  # half of the imports of a run, which most runs do without

        return float(brentq(g, a, b, xtol=4 * _EPS, rtol=4 * _EPS))

    def times(self) -> list[np.ndarray]:
        """`t_events` of the solution: one array for each event."""
        return [np.array([t for t, _ in zeros], dtype=float) for zeros in self.found]

    def states(self, y0: Array) -> list[Array]:
        """`y_events` of the solution: an array (n, 2d) for each event, like `y0`; tensors without gradient."""
        return [stack([y for _, y in zeros], axis=0) if zeros else y0[None][:0] for zeros in self.found]
