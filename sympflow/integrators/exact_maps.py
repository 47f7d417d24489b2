"""Steppers that are lists of exact flows of the parts of a system: their runs, compiled or by arrays, and counts."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar, Self
from weakref import WeakKeyDictionary

import numpy as np

from sympflow.arrays import Array, concatenate, is_tensor
from sympflow.hamiltonian.parts import ExactParts, Map, map_evaluations
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.array_rollout import rollout
from sympflow.integrators.base import FixedStep, Outcome, Problem

if TYPE_CHECKING:
    from sympflow.kernels.parts import PartsKernel

__all__ = ["MapsStepper", "kernel_of", "known_maps"]


class MapsStepper(FixedStep):
    """A fixed-step method whose step is a list of exact flows of the parts of H; a subclass defines these."""

    symplectic: ClassVar[bool] = True
    compiles: ClassVar[bool] = True
    saves_finite: ClassVar[bool] = True
    counted_maps: ClassVar[Sequence[Map]] = ()

    def parts_of(self, system: HamiltonianSystem) -> ExactParts:
        """The parts of the system that the method takes."""
        raise NotImplementedError

    def maps(self, parts: ExactParts, h: Any) -> list[Map]:
        """The maps of a step of length h, a number or an array (...)."""
        raise NotImplementedError

    def check(self, system: HamiltonianSystem) -> None:
        self.parts_of(system)

    def run(self, problem: Problem) -> Outcome:
        return super(MapsStepper, self.counting(problem.system)).run(problem)

    def counting(self, system: HamiltonianSystem) -> Self:
        counted = copy.copy(self)  # one that knows the maps whose evaluations it counts
        object.__setattr__(counted, "counted_maps", known_maps(self, self.parts_of(system), 1.0))
        return counted

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        return map_evaluations(self.counted_maps, n_steps, n_saved, n_extra, backend)

    def step(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        parts = self.parts_of(system)
        return parts.from_modes(*parts.apply(self.maps(parts, h), *parts.to_modes(y)))

    def inverse(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        parts = self.parts_of(system)
        back = [m.inverse() for m in reversed(self.maps(parts, h))]
        return parts.from_modes(*parts.apply(back, *parts.to_modes(y)))

    def rollout(self, problem: Problem, h: float, n_steps: int, save: np.ndarray) -> tuple[Array, np.ndarray, str]:
        parts, y0 = self.parts_of(problem.system), problem.y0
        kernel = parts_kernel(parts, problem)
        if kernel is None:
            states, finite = rollout_in_modes(parts, self.maps(parts, h), y0, n_steps, save)
            return states, finite, "torch" if is_tensor(y0) else "numpy"

        def maps(length: np.ndarray) -> Sequence[Map]:
            return known_maps(self, parts, float(length))

        if y0.ndim == 1:
            states, last = kernel.run(maps, h, y0, n_steps, save)
            return states, np.asarray(last), "compiled"
        rows = y0.reshape(-1, y0.shape[-1])
        states, finite = kernel.run_batch(maps, h, rows, n_steps, save)
        return states.swapaxes(0, 1).reshape(len(save), *y0.shape), finite.reshape(y0.shape[:-1]), "compiled"

    def substep(self, system: HamiltonianSystem, y: Array, h: Any, backend: str) -> Array:
        if backend != "compiled":
            return self.step(system, 0.0, y, h)
        from sympflow.kernels.parts import PartsKernel

        parts = self.parts_of(system)
        rows = np.ascontiguousarray(y).reshape(-1, y.shape[-1])
        lengths = np.broadcast_to(h, y.shape[:-1]).reshape(-1)
        kernel = kernel_of(parts, PartsKernel)
        return kernel.step(lambda length: self.maps(parts, length), lengths, rows).reshape(y.shape)


@lru_cache(maxsize=64)
def known_maps(method: MapsStepper, parts: ExactParts, h: float) -> Sequence[Map]:
    """The maps of a step, the same object for the same step, whose table the kernel then knows."""
    return method.maps(parts, h)


_KERNELS: WeakKeyDictionary[ExactParts, Any] = WeakKeyDictionary()


def kernel_of(parts: ExactParts, make: Callable[[ExactParts], Any]) -> Any:
    """The compiled loops of the parts, made once."""
    if parts not in _KERNELS:
        _KERNELS[parts] = make(parts)
    return _KERNELS[parts]


def parts_kernel(parts: ExactParts, problem: Problem) -> PartsKernel | None:
    """The compiled loops for a problem, or None where it needs, or asks for, array operations."""
    y0 = problem.y0
    try:
        if problem.backend == "array":
            return None
        if is_tensor(y0):
            raise ValueError("`y0` is a tensor: pass a NumPy array, or use backend='array'.")
        if y0.dtype != np.float64:
            raise ValueError(f"`y0` is {y0.dtype}: use float64, or backend='array'.")
        from sympflow.kernels.parts import PartsKernel

        kernel = kernel_of(parts, PartsKernel)
        kernel.source()
        return kernel
    except ValueError as reason:
        if problem.backend == "compiled":
            raise ValueError(f"`backend` 'compiled' does not apply. {reason}") from None
        return None


def rollout_in_modes(
    parts: ExactParts, maps: Sequence[Map], y0: Array, n_steps: int, save: np.ndarray
) -> tuple[Array, np.ndarray]:
    """`rollout` by array operations, in the modes from beginning to end."""
    d = parts.ndof
    start = parts.to_modes(y0)
    known = parts.prepared(maps, start[0])

    def step(k: int, z: Array) -> Array:
        return concatenate(parts.apply(known, z[..., :d], z[..., d:]))

    modes, finite = rollout(step, concatenate(start), n_steps, save)
    states = parts.from_modes(modes[..., :d], modes[..., d:])
    if len(save) and save[0] == 0:
        states = concatenate_first(y0, states)
    return states, finite


def concatenate_first(y0: Array, states: Array) -> Array:
    """`states` with y0 itself in place of the first."""
    if is_tensor(states):
        import torch

        return torch.cat([y0[None], states[1:]])
    return np.concatenate([y0[None], states[1:]])
