"""V, ∇V and ∇²V·v given as Numba functions of one state, as functions of arrays and tensors."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np

from sympflow.arrays import Array, is_tensor, to_numpy


class NumbaFunctions:
    """The three functions of a system, for any batch of states.

    Tensors are taken through NumPy; derivatives of V and of ∇V flow back by ∇V and ∇²V·v, in reverse and forward mode.

    Parameters
    ----------
    potential : Numba function
        q (d,) ↦ V.
    gradient : Numba function
        (q, out) ↦ None.
    hessian_vector : Numba function, optional
        (q, v, out) ↦ None.
    """

    def __init__(self, potential: Any, gradient: Any, hessian_vector: Any | None) -> None:
        self.functions = potential, gradient, hessian_vector

    def potential(self, q: Array) -> Array:
        """V(q): (..., d) to (...)."""
        return self._on_tensors[0](q) if is_tensor(q) else self._potential(q)

    def gradient(self, q: Array) -> Array:
        """∇V(q): (..., d) to (..., d)."""
        return self._on_tensors[1](q) if is_tensor(q) else self._gradient(q)

    def hessian_vector(self, q: Array, v: Array) -> Array:
        """∇²V(q)·v: (..., d), (..., d) to (..., d)."""
        return self._on_tensors[2](q, v) if is_tensor(q) else self._hessian_vector(q, v)

    @cached_property
    def _on_tensors(self) -> tuple[Callable[..., Array], ...]:
        return _tensor_functions(self)

    def __getstate__(self) -> dict[str, Any]:
        return {"functions": self.functions}  # what is generated cannot be pickled

    def _potential(self, q: np.ndarray) -> np.ndarray:
        f = self.functions[0]
        return np.array([f(row) for row in _rows(q, q.shape)], dtype=q.dtype).reshape(q.shape[:-1])

    def _gradient(self, q: np.ndarray) -> np.ndarray:
        return _each_row(self.functions[1], q)

    def _hessian_vector(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        if self.functions[2] is None:
            raise ValueError(
                "`hessian_vector` is needed here (force-gradient methods, volume and symplecticity metrics) and was "
                "not given: pass it to HamiltonianSystem."
            )
        return _each_row(self.functions[2], q, v)


def _rows(x: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    return np.ascontiguousarray(np.broadcast_to(x, shape), dtype=float).reshape(-1, shape[-1])


def _each_row(f: Any, *arguments: np.ndarray) -> np.ndarray:
    """f(row, …, out) for every state."""
    shape = np.broadcast_shapes(*(a.shape for a in arguments))
    rows = [_rows(a, shape) for a in arguments]
    out = np.empty_like(rows[0])
    for each in zip(*rows, out, strict=True):
        f(*each)
    return out.reshape(shape).astype(arguments[0].dtype, copy=False)


def _tensor_functions(numba: NumbaFunctions) -> tuple[Callable[..., Array], ...]:
    """The same as differentiable functions of tensors."""
    import torch

    def through_numpy(f: Callable[..., np.ndarray], *x: torch.Tensor) -> torch.Tensor:
        return torch.as_tensor(f(*map(to_numpy, x)), dtype=x[0].dtype, device=x[0].device)

    class Function(torch.autograd.Function):
        @staticmethod
        def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
            ctx.save_for_backward(*inputs)
            ctx.save_for_forward(*inputs)

        @classmethod
        def in_batch(cls, in_dims: tuple[Any, ...], *x: torch.Tensor) -> tuple[torch.Tensor, int]:
            n = next(y.shape[i] for y, i in zip(x, in_dims, strict=True) if i is not None)
            moved = [y.expand(n, *y.shape) if i is None else y.movedim(i, 0) for y, i in zip(x, in_dims, strict=True)]
            return cls.apply(*moved), 0

    class Potential(Function):
        @staticmethod
        def forward(q: torch.Tensor) -> torch.Tensor:
            return through_numpy(numba._potential, q)

        @staticmethod
        def backward(ctx: Any, v: torch.Tensor) -> torch.Tensor:
            return v[..., None] * Gradient.apply(*ctx.saved_tensors)

        @staticmethod
        def jvp(ctx: Any, v: torch.Tensor) -> torch.Tensor:
            return (v * Gradient.apply(*ctx.saved_tensors)).sum(-1)

        @staticmethod
        def vmap(info: Any, in_dims: tuple[Any, ...], q: torch.Tensor) -> tuple[torch.Tensor, int]:
            return Potential.in_batch(in_dims, q)

    class Gradient(Function):
        @staticmethod
        def forward(q: torch.Tensor) -> torch.Tensor:
            return through_numpy(numba._gradient, q)

        @staticmethod
        def backward(ctx: Any, v: torch.Tensor) -> torch.Tensor:
            return HessianVector.apply(*ctx.saved_tensors, v)

        @staticmethod
        def jvp(ctx: Any, v: torch.Tensor) -> torch.Tensor:
            return HessianVector.apply(*ctx.saved_tensors, v)

        @staticmethod
        def vmap(info: Any, in_dims: tuple[Any, ...], q: torch.Tensor) -> tuple[torch.Tensor, int]:
            return Gradient.in_batch(in_dims, q)

    class HessianVector(Function):
        @staticmethod
        def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
            Function.setup_context(ctx, inputs, output)
            ctx.set_materialize_grads(False)  # so that a q that does not vary is told from one that does

        @staticmethod
        def forward(q: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
            return through_numpy(numba._hessian_vector, q, v)

        @staticmethod
        def backward(ctx: Any, w: torch.Tensor | None) -> tuple[None, torch.Tensor | None]:
            if w is None:
                return None, None
            if ctx.needs_input_grad[0]:
                raise _third_derivative()
            return None, HessianVector.apply(ctx.saved_tensors[0], w)

        @staticmethod
        def jvp(ctx: Any, dq: torch.Tensor | None, dv: torch.Tensor | None) -> torch.Tensor:
            if dq is not None or dv is None:
                raise _third_derivative()
            return HessianVector.apply(ctx.saved_tensors[0], dv)

        @staticmethod
        def vmap(info: Any, in_dims: tuple[Any, ...], *x: torch.Tensor) -> tuple[torch.Tensor, int]:
            return HessianVector.in_batch(in_dims, *x)

    return Potential.apply, Gradient.apply, HessianVector.apply


def _third_derivative() -> Exception:
    return ValueError(
        "`hessian_vector` would have to be differentiated, and a system given by Numba functions has no third "
        "derivatives: use a method without force gradients, or define the system with HamiltonianSystem.from_sympy."
    )
