"""Tensors in compiled loops: the numbers of a NumPy call, and gradients by the compiled reverse of the run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sympflow.arguments import check_not_followed
from sympflow.arrays import detached, differentiable, to_numpy, transformed
from sympflow.integrators.steppers import Stepper
from sympflow.kernels.protocol import RunCheckpoint, Task


class TensorStepper(Stepper):
    """Compiled loops for tensors on the CPU: float32 is computed in double, and rounded at the outputs."""

    def rollout(
        self, y0: Tensor, h: float, n_steps: int, save: np.ndarray, t0: float = 0.0, carry: RunCheckpoint | None = None
    ) -> tuple[Tensor, np.ndarray]:
        if y0.dtype != torch.float64:
            states, finite = self.rollout(y0.double(), h, n_steps, save, t0, carry)
            return states.to(y0.dtype), finite
        followed = self.followed
        if not differentiable(y0, *followed):
            found, finite = super().rollout(to_numpy(y0), h, n_steps, save, t0, carry)
            return torch.from_numpy(found), finite
        run = _Rolled(self, h, n_steps, save, t0)
        return _Run.apply(run, y0, *followed), run.finite

    def shorter(self, y: Tensor, h: Any, t: Any = 0.0) -> Tensor:
        """Return the states a step of length h after y, differentiable by their lengths too."""
        _check_steps(self)
        if transformed(y, h):
            return _by_arrays(self, y, h, t, *self.followed)
        if y.dtype != torch.float64:
            h = h.double() if isinstance(h, Tensor) else h
            return self.shorter(y.double(), h, t).to(y.dtype)
        h = torch.as_tensor(h, dtype=y.dtype).expand(y.shape[:-1])
        return _Step.apply(self, t, y, h, *self.followed)


class MovingTimes:
    """Times of a run that torch follows: outputs move along the field with them, and starts against it.

    This is the derivative of the solution, and that of a step of a method of order p up to O(hᵖ).
    """

    def __init__(self, t_span: Any, t_eval: Any) -> None:
        self._ends = (None, None) if t_span is None else tuple(t_span)
        listed = isinstance(t_eval, list | tuple)
        self._times = torch.stack([torch.as_tensor(t, dtype=torch.float64) for t in t_eval]) if listed else t_eval
        for name, times in (("t_span", self._ends), ("t_eval", (self._times,))):
            if transformed(*times):
                check_not_followed(name, times)

    @property
    def numbers(self) -> tuple[Any, Any]:
        """The ends and the times of outputs, as numbers."""
        ends = None if self._ends[0] is None else tuple(detached(t) for t in self._ends)
        return ends, None if self._times is None else to_numpy(self._times)

    def started(self, system: Any, y0: Any, t0: float) -> Tensor:
        """The initial states, which move with the start."""
        y0, start = torch.as_tensor(y0), self._ends[0]
        return _moved(system, y0, start, t0, -1.0) if differentiable(start) else y0

    def ended(self, system: Any, y: Tensor, t: np.ndarray) -> Tensor:
        """The outputs (..., 2d, n) at times t, which move with these."""
        states, times = y.movedim(-1, 0), self._times
        if times is None:  # the grid moves with the start, but for the end
            start, end = (torch.as_tensor(t, dtype=torch.float64).reshape(1) for t in self._ends)
            times = torch.cat([start.expand(max(len(t) - 1, 0)), end if t[-1] == to_numpy(end) else start])
        if not differentiable(times):
            return y
        at = t.reshape(-1, *[1] * (states.ndim - 2))
        return _moved(system, states, times[: len(t)].reshape(at.shape), at).movedim(0, -1)


def _moved(system: Any, y: Tensor, t: Tensor, at: Any, sign: float = 1.0) -> Tensor:
    """The same states y (..., 2d) at times t, whose values are `at`, with the derivative by these, or less that."""
    system = system.between_impulses  # which are at times of their own
    field = system.vector_field(y, torch.as_tensor(at).expand(y.shape[:-1]))
    return y + sign * field * (t - t.detach()).to(y)[..., None]


class _Rolled:
    """A run of a stepper from y0: its numbers, its reverse, and the same by tensor operations."""

    def __init__(self, stepper: Any, h: float, n_steps: int, save: np.ndarray, t0: float) -> None:
        self.stepper, self.h, self.n_steps, self.save, self.t0 = stepper, h, n_steps, save, t0
        self.finite = np.empty(0)

    def run(self, y0: Tensor) -> Tensor:
        rows = to_numpy(y0).reshape(-1, y0.shape[-1])
        self.recorded = self.stepper.kernel.recorded(Task(self.h, rows, self.n_steps, self.save, None, self.t0))
        self.finite = self.recorded.n_finite.reshape(y0.shape[:-1])
        return torch.from_numpy(self.recorded.states.swapaxes(0, 1).reshape(len(self.save), *y0.shape))

    def pulled(self, cotangents: Tensor, followed: Sequence[Tensor]) -> list[Tensor]:
        """The cotangents of y0 and of the tensors that are followed."""
        shape = cotangents.shape[1:]
        given = to_numpy(cotangents).reshape(len(self.save), -1, shape[-1]).swapaxes(0, 1)
        of_states, of_values = self.recorded.pulled(given, bool(followed))
        found = [torch.from_numpy(of_states.reshape(shape))]
        if self.stepper.kernel.tensors:
            ends = np.cumsum([w.numel() for w in followed])
            pieces = [(x, w.shape) for x, w in zip(np.split(of_values.sum(1), ends), followed, strict=False)]
        else:
            pieces = [(x, shape[:-1]) for x in of_values]
        for (x, of), w in zip(pieces, followed, strict=False):
            number = torch.from_numpy(x.reshape(of))
            number = number if w.shape == of else number.sum_to_size(w.shape)
            found.append(number if w.dtype == number.dtype and w.device.type == "cpu" else number.to(w))
        return found

    def by_arrays(self, y0: Tensor, *followed: Tensor) -> Tensor:
        y, states, wanted = y0, [], self.save.tolist()
        for k in range(self.n_steps + 1):
            states += [y] * wanted.count(k)
            if k < self.n_steps:
                y = _by_arrays(self.stepper, y, self.h, self.t0 + k * self.h, *followed)
        return torch.stack(states)


class _Run(torch.autograd.Function):
    """The states of a run; second derivatives by tensor operations."""

    @staticmethod
    def forward(ctx: Any, run: _Rolled, y0: Tensor, *followed: Tensor) -> Tensor:
        ctx.run = run
        ctx.save_for_backward(y0, *followed)
        return run.run(y0)

    @staticmethod
    def backward(ctx: Any, cotangents: Tensor) -> tuple[Any, ...]:
        inputs, wanted = ctx.saved_tensors, ctx.needs_input_grad[1:]
        if torch.is_grad_enabled() or transformed(cotangents):
            return None, *_pulled(ctx.run.by_arrays, inputs, wanted, cotangents)
        if any(wanted[1:]):
            return None, *ctx.run.pulled(cotangents, inputs[1:])
        return None, *ctx.run.pulled(cotangents, ()), *[None for _ in wanted[1:]]


class _Step(torch.autograd.Function):
    """The states after single steps, each of its own length; derivatives by tensor operations."""

    @staticmethod
    def forward(ctx: Any, stepper: Any, t: Any, y: Tensor, h: Tensor, *followed: Tensor) -> Tensor:
        ctx.step = lambda y, h, *numbers: _by_arrays(stepper, y, h, t, *numbers)
        ctx.save_for_backward(y, h, *followed)
        return torch.from_numpy(Stepper.shorter(stepper, to_numpy(y), to_numpy(h), t))

    @staticmethod
    def backward(ctx: Any, cotangents: Tensor) -> tuple[Any, ...]:
        return None, None, *_pulled(ctx.step, ctx.saved_tensors, ctx.needs_input_grad[2:], cotangents)


def _by_arrays(stepper: Any, y: Tensor, h: Any, t: Any, *followed: Tensor) -> Tensor:
    """A step by tensor operations, of which torch follows the parameters too."""
    if not stepper.problem.followed:  # weights are read by the functions themselves
        return stepper.arrays.step(y, h, t)
    _check_steps(stepper)
    batch = stepper.problem.y0.shape[:-1]
    return stepper.kernel.stepped(y, h, t, [x.to(y).expand(batch) for x in followed])


def _check_steps(stepper: Any) -> None:
    """Refuse steps by tensor operations where gradients flow to parameters and there are none."""
    if stepper.problem.followed and not stepper.kernel.steps_tensors:
        raise ValueError(
            "`params` with gradients have no second derivatives, and none at times between two steps, where a system "
            "has friction or the method is not a splitting method: choose times on the grid, or detach them."
        )


def _pulled(
    function: Callable[..., Tensor], inputs: Sequence[Tensor], wanted: Sequence[bool], cotangents: Tensor
) -> list[Tensor | None]:
    """The cotangents of those inputs that are wanted, with a graph of their own where one is asked for."""
    gate, again = _Gate(), torch.is_grad_enabled()
    with torch.enable_grad():
        if again:
            inputs = [x if x.is_leaf else _Gated.apply(x, gate) for x in inputs]
        else:
            inputs = [x if x.is_leaf else x.detach().requires_grad_() for x in inputs]
        y = function(*inputs)
    some = [x for x, asked in zip(inputs, wanted, strict=True) if asked]
    found = iter(torch.autograd.grad(y, some, cotangents, create_graph=again, allow_unused=True))
    gate.open = True
    return [next(found) if asked else None for asked in wanted]


class _Gate:
    """Closed while derivatives are taken by each input alone, though one of them may depend on another."""

    open = False


class _Gated(torch.autograd.Function):
    """The same tensor, through which derivatives reach its own inputs only while a gate is open."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, gate: _Gate) -> Tensor:
        ctx.gate = gate
        return x.view_as(x)

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Any, ...]:
        return cotangent if ctx.gate.open else None, None
