"""Steppers: one run of a fixed-step method, in compiled loops or by array operations."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.arrays import (
    Array,
    copied,
    differentiable,
    finite_states,
    full_of_nan,
    library_name,
    like,
    stack,
    transformed,
    with_rows,
)
from sympflow.integrators.contract import Problem
from sympflow.integrators.grid import Grid
from sympflow.kernels.protocol import RunCheckpoint

if TYPE_CHECKING:
    from sympflow.kernels.protocol import Kernel

_ADVICE = re.compile(r"(, or use|: use|\. Use) backend='array'\.$")


class ArraySteps:
    """The steps of one run by array operations, and the count of their evaluations; a subclass defines `step`."""

    takes_carry: bool = True
    counts: Mapping[str, int] | None = None  # the evaluations that were made so far, where they are counted
    stages: int = 0
    """Evaluations of the force and the Hessian in each iteration of an implicit step; 0 of an explicit one."""
    iterations: int = 0
    backend: str = ""  # the name of what runs, if it is not the library of the states

    def step(self, y: Array, h: Any, t: Any = 0.0) -> Array:
        """One step of length h, a number or one for each state, from y (..., 2d) at the time t, of either kind."""
        raise NotImplementedError

    def rollout(
        self, y0: Array, h: float, n_steps: int, save: np.ndarray, t0: float = 0.0, carry: RunCheckpoint | None = None
    ) -> tuple[Array, np.ndarray]:
        """See `Stepper.rollout`."""
        return rollout(lambda k, y: self.step(y, h, t0 + k * h), y0, n_steps, save, carry=carry)

    def check_lengths(self, h: Any) -> None:
        """Warn of lengths of steps, including those of compiled loops, that are not recommended for the method."""

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        """Evaluations of forces and their derivatives, as `FixedStep.evaluations`."""
        raise NotImplementedError


class Stepper:
    """One run of a fixed-step integrator: all that a run changes or counts is here, its kernel and its arrays."""

    def __init__(
        self,
        integrator: Any,
        problem: Problem,
        arrays: ArraySteps,
        kernel: Kernel | None = None,
        told: Sequence[str] = (),
    ) -> None:
        self.integrator, self.system, self.problem = integrator, problem.system, problem
        self.arrays, self.kernel, self.compiled = arrays, kernel, kernel is not None
        self.counts_itself = arrays.counts is not None or arrays.stages > 0  # whatever the steps
        self.saves_finite = kernel is not None and kernel.saves_finite  # of saved states up to the last finite one
        self.remark = self.why = ""  # the reasons why a formula is not compiled, and functions of Python run as such
        y0, untraced = problem.y0, None if kernel is not None or problem.system is None else problem.system.untraced
        if untraced and problem.backend == "auto" and y0.dtype == np.float64:
            name = "potential" if problem.system.separable else "hamiltonian"
            self.why = f": `{name}` could not be traced, because {untraced}"
        if told and problem.system.definition.symbolic:
            self.remark = f" Its steps were array operations: {_ADVICE.sub('.', told[0])}"
        elif told and problem.system.form is not None:  # functions that were traced
            self.why = f": {_ADVICE.sub('', told[0])}"

    @property
    def backend(self) -> str:
        """The means of the run, for `stats["backend"]`: "compiled", "numpy", "torch", or another library's name."""
        if self.kernel is not None:
            return self.kernel.backend
        return self.arrays.backend or library_name(self.problem.y0)

    @property
    def takes_carry(self) -> bool:
        """True if `rollout` takes a carry: unless the steps are those of a `rollout` that a class has of its own."""
        if self.kernel is None:
            return self.arrays.takes_carry
        y0 = self.problem.y0  # where torch follows the run, it cannot from piece to piece
        return not differentiable(y0, *self.followed)

    @property
    def followed(self) -> Sequence[Any]:
        """The tensors besides y0 to which gradients of compiled loops flow: parameters, or weights in H."""
        return [*self.problem.followed.values()] or (() if self.kernel is None else self.kernel.tensors)

    def rollout(
        self, y0: Array, h: float, n_steps: int, save: np.ndarray, t0: float = 0.0, carry: RunCheckpoint | None = None
    ) -> tuple[Array, np.ndarray]:
        """Return the states (len(save), ..., 2d) after the steps `save` (sorted counts in 0 … n_steps) of length h.

        Also the index of the last finite state of each trajectory, of shape y0.shape[:-1]. With a `carry` the run from
        y0 goes on from there: see `kernels.protocol.Kernel.run`.
        """
        if self.kernel is None:
            return self.arrays.rollout(y0, h, n_steps, save, t0, carry)
        rows = y0 if y0.ndim == 1 else y0.reshape(-1, y0.shape[-1])
        states, last, iterations = self.kernel.run(h, rows, n_steps, save, carry, t0)
        self.remark = self.kernel.remark
        if y0.ndim > 1:
            states = states.swapaxes(0, 1).reshape(len(save), *y0.shape)
        self.arrays.iterations += iterations
        return states, np.asarray(last).reshape(y0.shape[:-1])

    def shorter(self, y: Array, h: Any, t: Any = 0.0) -> Array:
        """Return the states a step of length h, a number or one for each state, after y (..., 2d) at the time t."""
        if self.kernel is None:
            return self.arrays.step(y, h, t)
        self.arrays.check_lengths(h)
        times = t if np.ndim(t) == 0 else np.broadcast_to(t, y.shape[:-1]).reshape(-1)
        rows = y if y.ndim == 2 else np.ascontiguousarray(y).reshape(-1, y.shape[-1])
        lengths = h if np.shape(h) == (len(rows),) else np.broadcast_to(h, y.shape[:-1]).reshape(-1)
        states, iterations = self.kernel.step(lengths, rows, times)
        self.arrays.iterations += iterations
        return states.reshape(y.shape)

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int) -> dict[str, int]:
        """Evaluations of the force and its derivatives so far, if it made so many steps, saves and shorter steps."""
        arrays = self.arrays
        if arrays.stages:
            return dict.fromkeys(("force_evaluations", "hessian_evaluations"), arrays.iterations * arrays.stages)
        known = arrays.counts if self.kernel is None else self.kernel.evaluations(n_steps, n_saved, n_extra)
        return arrays.evaluations(n_steps, n_saved, n_extra, self.backend) if known is None else dict(known)


def rollout(
    step: Callable[[int, Array], Array],
    y: Array,
    n_steps: int,
    save: np.ndarray,
    block: int = 64,
    carry: RunCheckpoint | None = None,
) -> tuple[Array, np.ndarray]:
    """States at the counts `save` of n_steps times `step(k, y)`, and the last finite count of each trajectory."""
    k = 0
    if carry is not None and carry.running is not None:
        k, y = carry.steps, carry.running
    position, wanted = 0, save.tolist()
    out = [full_of_nan(y)] * len(wanted)
    finite = np.where(finite_states(y, in_any_lane=True), n_steps, -1)
    if wanted and wanted[0] == 0:
        out[0], position = copied(y), 1
    with np.errstate(all="ignore"):
        while k < n_steps and (finite == n_steps).any():
            start, y_start = k, y
            for k in range(start, min(start + block, n_steps)):
                y = checked_state(step(k, y), y)
                if position < len(wanted) and wanted[position] == k + 1:
                    out[position] = copied(y)
                    position += 1
            k += 1
            failed = (finite == n_steps) & ~finite_states(y, in_any_lane=True)
            if failed.any():
                z = y_start
                for j in range(start, k):
                    z = step(j, z)
                    first = failed & (finite == n_steps) & ~finite_states(z, in_any_lane=True)
                    finite = np.where(first, j, finite)
    if carry is not None:
        carry.advance(n_steps, y)
    return stack(out, axis=0) if out else y[None][:0], np.asarray(finite)


def checked_state(y_next: Any, y: Array) -> Array:
    """Return the result of a step from y, checked to be of the same kind, shape and dtype: it may be a plug-in's."""
    shape = getattr(y_next, "shape", None)
    if shape == y.shape and y_next.dtype == y.dtype:
        if differentiable(y) and not (y_next.requires_grad or transformed(y)):
            raise TypeError(
                "`step` loses the gradient of the tensors that it is given: pass NumPy arrays, or y0.detach(). A class "
                "whose step takes arrays only says so by `arrays_only`."
            )
        return y_next
    what = "" if shape is None else f" of {y_next.dtype} and shape {tuple(shape)}"
    raise TypeError(
        f"`step` must return states as those that it is given, of {y.dtype} and shape {tuple(y.shape)}; got "
        f"{type(y_next).__name__}{what}. Correct the integrator: check_integrator tests it."
    )


def shorter_steps(stepper: Stepper, grid: Grid, y: Array, count: np.ndarray, remainder: np.ndarray) -> Array:
    """Replace the states y, those at grid points `count`, by those a step later where the remainder h is not 0."""
    extra = remainder.nonzero()[0]
    if not extra.size:
        return y
    h, t = remainder[extra], grid.t0 + count[extra] * grid.h
    first, end = int(extra[0]), int(extra[-1]) + 1
    rows: Any = slice(first, end) if end - first == len(extra) else extra  # nearly always, and sooner copied
    states = y[rows]
    if y.ndim != 2:
        h, t = (np.broadcast_to(x.reshape(-1, *[1] * (y.ndim - 2)), states.shape[:-1]).copy() for x in (h, t))
    with np.errstate(all="ignore"):
        return with_rows(y, rows, checked_state(stepper.shorter(states, like(h, states), t), states))
