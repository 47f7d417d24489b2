"""ψ_s(y0) as a differentiable function of the elapsed time s, of y0 and of all weights; and its first zero."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sympflow.arguments import warn
from sympflow.arrays import differentiable, one_lane, readable, to_numpy, unfollowed, values_of_times
from sympflow.events import Event, EventSearch
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep, Problem
from sympflow.integrators.grid import Grid
from sympflow.integrators.impulses import landings
from sympflow.integrators.registry import naming_plugin
from sympflow.integrators.steppers import rollout

MAX_EVENT_STEPS = 1_000_000
_EPS = 4 * float(np.finfo(float).eps)
BeforeStep = Callable[[float, Tensor, float], None]
"""Called before a step with the elapsed time, the state and the signed length."""


def numbers(t: Tensor) -> np.ndarray:
    """Values of times, of all lanes of `torch.func.vmap`, (..., n)."""
    return values_of_times(t, "use sympflow.solve, whose times are numbers")


class Path:
    """The trajectory of an integrator from y0, on the grid k·dt of elapsed times, in one direction of time.

    Parameters
    ----------
    integrator : FixedStep
    system : HamiltonianSystem or None
        None for a flow that needs none.
    y0 : tensor of shape (..., 2d)
    direction : 1 or -1
    t0 : tensor of shape ()
        The time of y0, on which the steps of a driven system depend.
    before_step : callable, optional
        Called before each step, which are then made one by one.
    """

    def __init__(
        self,
        integrator: FixedStep,
        system: HamiltonianSystem | None,
        y0: Tensor,
        direction: int,
        t0: Tensor,
        before_step: BeforeStep | None = None,
    ) -> None:
        self.integrator, self.y0, self.before_step = integrator, y0, before_step
        self.system: HamiltonianSystem = system  # type: ignore[assignment]
        self.h = math.copysign(integrator.step_length(self.system), direction)
        self.driven = system is not None and not system.autonomous
        self.start = t0.to(torch.float64)
        self.t0: Any = 0.0 if not self.driven else self.start if differentiable(t0) else float(t0)
        learns = system is not None and system.learns(y0)  # True if torch follows numbers of H
        self.eager = learns or differentiable(*self.weights(), self.t0)

    def __call__(self, s: Tensor) -> Tensor:
        """ψ_s(y0), (n, ..., 2d), for elapsed times s (n,), each 0 or with the sign of the direction.

        Differentiable in s (where an s is a whole number of steps: in the step that begins or ends there).
        """
        count, r = self.located(s)
        saved = np.unique(numbers(count))
        states = self.rollout(saved)[_places(saved, count)]
        if not (differentiable(r) or numbers(r).any()):
            return states
        if self.before_step is not None and numbers(r)[-1]:
            self.before_step(float(numbers(count)[-1]) * self.h, states[-1], float(numbers(r)[-1]))
        return self.step(states, _each(r.to(states.dtype), states), self.times(count, states))

    def times(self, count: Tensor, states: Tensor) -> Any:
        """The times (n, ...) of states (n, ..., 2d) after `count` (n,) steps."""
        return _each(self.t0 + count.to(torch.float64) * self.h, states)

    def located(self, s: Tensor) -> tuple[Tensor, Tensor]:
        """Counts k of whole steps and remainders r (n,), in float64, with s = k·h + r; gradients flow from s to r.

        As `Grid.locate`: a quotient within a few ulp of an integer is that integer. Under `torch.func.vmap` each lane
        has its own.
        """
        elapsed = numbers(s)
        far = float(np.abs(elapsed).max(initial=0.0))
        if self.driven:
            t0 = float(one_lane(self.start))
            span = float(t0 + elapsed.min(initial=0.0)), float(t0 + elapsed.max(initial=0.0))
            self.system.check_times(*span)
            told, _ = landings(self.integrator, self.system, *span, able=False)
            if told:
                warn(told, RuntimeWarning)
        Grid(0.0, math.copysign(far, self.h) or self.h, abs(self.h))  # refuses too many steps
        s = s.to(torch.float64)
        x = s.detach() / self.h
        nearest = x.round()
        on_grid = (x - nearest).abs() <= _EPS * (nearest.abs() + x.abs())
        count = torch.where(on_grid, nearest, x.floor())
        r = s - count * self.h
        return count.to(torch.int64), torch.where(on_grid, r - r.detach(), r)

    def rollout(self, save: np.ndarray, start: Tensor | None = None, first: int = 0) -> Tensor:
        """The states after the steps `save` (sorted counts): compiled if torch follows nothing.

        From y0, or from `start`, the state after `first` steps.
        """
        y: Any = self.y0 if start is None else start
        if self.before_step is not None:
            return self._one_by_one(save)
        n_steps, t0 = int(save.max(initial=0)), self.t0 + first * self.h
        if isinstance(t0, Tensor):  # followed by torch, which the numbers of a run are not
            return rollout(lambda k, z: self.step(z, self.h, t0 + k * self.h), y, n_steps, save)[0]
        plain = self._plain(y)
        if plain:
            y = to_numpy(y)
        with naming_plugin(self.integrator):
            stepper = self.integrator.stepper(Problem(self.system, t0, t0 + n_steps * self.h, y))
            states, _ = stepper.rollout(y, self.h, n_steps, save, t0)
        return torch.from_numpy(np.ascontiguousarray(states)) if plain else states

    def _one_by_one(self, save: np.ndarray) -> Tensor:
        """`rollout` with a call of `before_step` for each step."""
        assert self.before_step is not None
        y, states = self.y0, []
        for k in range(int(save.max(initial=0)) + 1):
            if k in save:
                states.append(y)
            if k < save.max(initial=0):
                self.before_step(k * self.h, y, self.h)
                y = self.step(y, self.h, self.t0 + k * self.h)
        return torch.stack(states)

    def step(self, y: Tensor, h: float | Tensor, t: Any) -> Tensor:
        """A step of length h from the time t, each a number or one for each state.

        By NumPy if nothing is differentiated.
        """
        return self._stepped(self.integrator.step, y, h, t)

    def inverse(self, y: Tensor, t: Any) -> Tensor:
        """The state from which a whole step, which begins at t, leads to y."""
        return self._stepped(self.integrator.inverse, y, self.h, t)

    def _stepped(self, function: Callable[..., Any], y: Tensor, h: float | Tensor, t: Any) -> Tensor:
        with naming_plugin(self.integrator):
            if differentiable(h, t) or not self._plain(y):
                return function(self.system, t, y, h)
            at, length = (to_numpy(x) if isinstance(x, Tensor) else x for x in (t, h))
            stepped = function(self.system, at, to_numpy(y), length)
        return torch.from_numpy(np.ascontiguousarray(stepped))

    def _plain(self, y: Tensor) -> bool:
        """True if NumPy may step y: on the CPU, and with nothing that torch follows, of the state or of weights."""
        return not (self.eager or differentiable(y)) and y.device.type == "cpu"

    def weights(self) -> list[Tensor]:
        """The weights of the flow, if there is one."""
        flow = self.integrator.flow_for(self.system)
        return [] if flow is None else list(flow.parameters())

    def first_zero(self, g: Callable[[Tensor, Tensor], Tensor]) -> tuple[Tensor, Tensor]:
        """The elapsed time s at which g(s, ψ_s(y0)), a number, first vanishes, and the state there.

        g is tested at every step, and every `system.dt` within longer ones, such as those of a flow.

        Their derivatives are those of the implicit function g(s, ψ_s) = 0, in both modes, the first and the second.

        Raises
        ------
        RuntimeError
            If there is none within a million steps, or the state became non-finite before.
        TypeError
            If the values of the states are hidden, by `torch.func.vmap` or `torch.compile`.
        """
        if not readable(self.y0) or (self.eager and not readable(self.step(self.y0, self.h, self.t0))):
            raise TypeError(
                "`event_fn` is followed by the values of the states, which torch.func.vmap and torch.compile hide: "
                "call it outside of them, for one event at a time."
            )
        with torch.no_grad():
            value = self._located(g)
        s = zero = torch.tensor(value, dtype=torch.float64, device=self.y0.device)
        count, r = self.located(zero[None])
        start, inside = self(count.to(torch.float64) * self.h)[0], float(r[0])
        t = self.t0 + float(count[0]) * self.h

        def state(time: Tensor) -> Tensor:
            remainder = (time - zero + inside).to(start.dtype)
            moves = inside or differentiable(remainder)
            return self.step(start, remainder.expand(start.shape[:-1]), t) if moves else start

        if not differentiable(c := g(s, state(s))):
            return s, state(s)
        slope = torch.func.grad(lambda time: g(time, state(time)))(zero).detach()
        # Newton's method with a fixed slope: each iteration makes the derivatives of one more order right
        for _ in range(2):
            s_next = s - (c - c.detach()) / slope
            c = g(s_next, state(s_next))
            s = s_next
        return s, state(s)

    def _located(self, g: Callable[[Tensor, Tensor], Tensor]) -> float:
        """The elapsed time of the first zero."""
        y, t0 = self.y0.detach(), unfollowed(self.start)
        event = Event(lambda s, y: g(torch.tensor(s, dtype=torch.float64, device=y.device), y), label="`event_fn`")
        search, k, chunk = EventSearch((event,)), 0, 8
        while k < MAX_EVENT_STEPS:
            ahead = Path(self.integrator, self.system, y, 1 if self.h > 0 else -1, t0 + k * self.h)
            ahead.eager = self.eager  # the map whose derivatives follow, not a compiled copy of its weights
            states = ahead.rollout(np.arange(chunk + 1))
            inner = ahead._samples(states[:-1])
            for j in range(chunk):
                begin, t = (k + j) * self.h, ahead.t0 + j * self.h
                if self.driven:
                    self.system.check_times(ahead.t0, t)

                def inside(s: float, begin: float = begin, y: Tensor = states[j], t: float = t) -> Tensor:
                    return self.step(y, s - begin, t)

                search.step(begin, states[j], (k + j + 1) * self.h, states[j + 1], inside, list(inner[j]))
                if search.found[0]:
                    return search.found[0][0][0]
                if not np.isfinite(search.values or ()).all():
                    raise RuntimeError(
                        f"`event_fn` found no zero: the solution became non-finite after an elapsed time of "
                        f"{begin:.6g}. Check y0, or use a smaller dt."
                    )
            k, y, chunk = k + chunk, states[-1], min(2 * chunk, 1024)
        raise RuntimeError(f"`event_fn` found no zero within {MAX_EVENT_STEPS:,} steps: check that there is one.")

    def _samples(self, states: Tensor) -> Tensor:
        """States (n, parts − 1, ..., 2d) that divide the steps from `states` (n, ..., 2d) into equal parts."""
        longest = abs(self.h) if self.system is None else self.system.dt
        parts = max(1, math.ceil(abs(self.h) / longest * (1 - _EPS)))
        repeated = states[:, None].expand(-1, parts - 1, *states.shape[1:])
        fractions = torch.arange(1, parts, dtype=states.dtype, device=states.device) / parts
        h = (self.h * fractions).reshape(-1, *[1] * (states.ndim - 2)).expand(repeated.shape[:-1])
        return repeated if parts == 1 else self.step(repeated, h, self.times(torch.arange(len(states)), repeated))


class DensePath(Path):
    """A path to a known end whose states on the grid are computed once.

    Parameters
    ----------
    integrator, system, y0, direction
        As for `Path`.
    times : tensor of shape (2,)
        Its beginning and end.
    """

    def __init__(
        self, integrator: FixedStep, system: HamiltonianSystem | None, y0: Tensor, direction: int, times: Tensor
    ) -> None:
        super().__init__(integrator, system, y0, direction, times[0])
        count, _ = self.located(times[1:] - times[0])
        self.span = numbers(times)
        self.states = super().rollout(np.arange(int(numbers(count).max()) + 1))

    def __call__(self, s: Tensor) -> Tensor:
        found, length, slack = numbers(s), self.span[1] - self.span[0], _EPS * np.abs(self.span).max()
        if found.size and not (found.min() >= min(0.0, length) - slack and found.max() <= max(0.0, length) + slack):
            raise ValueError(
                f"`t` must lie between {self.span[0]:g} and {self.span[1]:g}, the interval that was solved."
            )
        return super().__call__(s)

    def rollout(self, save: np.ndarray, start: Tensor | None = None, first: int = 0) -> Tensor:
        return self.states[torch.as_tensor(save, device=self.states.device)]


class AdjointPath(Path):
    """A path whose derivatives are pulled back step by step, along the states that the inverse of the map steps to.

    Memory does not grow with the number of steps: only the states at the outputs are kept. They are those of
    backpropagation to the rounding of the inverse, which an unstable orbit magnifies from output to output. A map
    without an inverse is run again from its outputs, with √n states kept of n steps between two of them.

    Reverse mode only, and once.

    Parameters
    ----------
    integrator, system, y0, direction, before_step
        As for `Path`.
    parameters : sequence of tensors
        Numbers of H that get gradients, beside the weights of a flow.
    """

    def __init__(self, *arguments: Any, parameters: Sequence[Tensor] = (), **more: Any) -> None:
        super().__init__(*arguments, **more)
        self.eager = False  # nothing is differentiated in the forward run
        self.t0 = float(self.start.detach()) if self.driven else 0.0
        known = {id(w): w for w in (*self.weights(), *parameters) if w.requires_grad}
        self.parameters = tuple(known.values())

    def __call__(self, s: Tensor) -> Tensor:
        return _PulledBack.apply(self, s, self.start if self.driven else None, self.y0, *self.parameters)

    def backwards(self, grid: Tensor, saved: np.ndarray) -> Iterator[tuple[int, Tensor]]:
        """The states after k steps, k from the last of `saved` to 0, where those after the steps `saved` are known."""
        for i in range(len(saved) - 1, 0, -1):
            first, last = int(saved[i - 1]), int(saved[i])
            yield last, grid[i]
            try:
                y = grid[i]
                for k in range(last - 1, first, -1):
                    y = self.inverse(y, self.t0 + k * self.h)
                    yield k, y
            except TypeError:  # there is none
                yield from self._run_again(grid[i - 1], first, last)
        yield 0, grid[0]

    def _run_again(self, y: Tensor, first: int, last: int) -> Iterator[tuple[int, Tensor]]:
        """The same for the steps between two counts, of a map without an inverse."""
        t0 = torch.tensor(self.t0 + first * self.h, dtype=torch.float64)
        path = Path(self.integrator, self.system, y, 1 if self.h > 0 else -1, t0)
        stride = math.isqrt(last - first) + 1
        marks = np.arange(0, last - first, stride)
        for mark, start in zip(marks[::-1].tolist(), path.rollout(marks).flip(0), strict=True):
            n = min(stride, last - first - mark)
            for j, state in zip(range(n - 1, -1, -1), path.rollout(np.arange(n), start, mark).flip(0), strict=True):
                if mark + j:
                    yield first + mark + j, state

    def pulled(self, y: Tensor, h: float | Tensor, t: Any, a: Tensor) -> tuple[Tensor, list[Any], list[Any]]:
        """The cotangents of y, of h and t, and of the parameters in a step from y at t, where that of its end is a.

        None for an h or t without a graph.
        """
        with torch.enable_grad(), naming_plugin(self.integrator):
            y = y.detach().requires_grad_(True)
            inputs: list[Any] = [y, *self.parameters]
            wanted = [isinstance(x, Tensor) and x.requires_grad for x in (h, t)]
            inputs += [x for x, asked in zip((h, t), wanted, strict=True) if asked]
            end = self.integrator.step(self.system, t, y, h)
            # what is retained is freed with `end`; the part of a graph that lies outside of the step has to stay
            found: list[Tensor | None] = list(torch.autograd.grad(end, inputs, a, allow_unused=True, retain_graph=True))
        of_y = torch.zeros_like(y) if found[0] is None else found[0]
        n = len(self.parameters)
        others = iter(found[1 + n :])
        return of_y, [next(others) if asked else None for asked in wanted], found[1 : 1 + n]


class _PulledBack(torch.autograd.Function):
    """The states of an `AdjointPath` at the elapsed times s."""

    @staticmethod
    def forward(ctx: Any, path: AdjointPath, s: Tensor, start: Tensor | None, y0: Tensor, *weights: Tensor) -> Tensor:
        count, r = path.located(s)
        saved = np.union1d(0, numbers(count))
        grid = path.rollout(saved)
        ctx.path, ctx.saved, ctx.dtype = path, saved, s.dtype
        ctx.save_for_backward(s, grid, *weights)
        states = grid[_places(saved, count)]
        return path.step(states, _each(r.to(states.dtype), states), path.times(count, states)) if r.any() else states

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangents: Tensor) -> tuple[Any, ...]:
        path, saved = ctx.path, ctx.saved
        s, grid, *_ = ctx.saved_tensors
        count, r = path.located(s.detach())
        counts, remainders = numbers(count), numbers(r)
        of_s, of_parameters = torch.zeros_like(r), [torch.zeros_like(w) for w in path.parameters]
        of_start = torch.zeros((), dtype=torch.float64, device=s.device)
        a, top = torch.zeros_like(grid[0]), int(saved[-1])

        def add(found: list[Tensor | None]) -> None:
            for i, part in enumerate(found):
                if part is not None:
                    of_parameters[i] += part

        for k, y in path.backwards(grid, saved):
            t: Any = 0.0
            if path.driven:
                t = torch.tensor(path.t0 + k * path.h, dtype=torch.float64, device=s.device)
                t.requires_grad_(ctx.needs_input_grad[2])
            if k < top:
                a, (_, of_t), found = path.pulled(y, path.h, t, a)
                add(found)
                of_start = of_start if of_t is None else of_start + of_t
            for i in np.flatnonzero(counts == k).tolist():
                if not (ctx.needs_input_grad[1] or remainders[i]):
                    a = a + cotangents[i]
                    continue
                h = r[i].to(y.dtype).requires_grad_(ctx.needs_input_grad[1])
                with torch.enable_grad():
                    lengths = h.expand(y.shape[:-1])
                of_y, (of_lengths, of_t), found = path.pulled(y, lengths, t, cotangents[i])
                a = a + of_y
                add(found)
                of_start = of_start if of_t is None else of_start + of_t
                if of_lengths is not None:
                    of_s[i] = of_lengths.sum()
        times = (of_s.to(ctx.dtype) if ctx.needs_input_grad[1] else None, of_start if ctx.needs_input_grad[2] else None)
        return None, *times, a, *of_parameters


def _places(saved: np.ndarray, count: Tensor) -> Tensor:
    """The index of each count among those that were saved."""
    return torch.searchsorted(torch.as_tensor(saved, device=count.device), count)


def _each(h: Tensor, states: Tensor) -> Tensor:
    """Lengths (n,) for states (n, ..., 2d): (n, ...)."""
    return h.reshape(-1, *[1] * (states.ndim - 2)).expand(states.shape[:-1])
