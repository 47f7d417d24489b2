"""The few array operations that NumPy and torch spell differently.

Dispatch is on the type of the argument, so that NumPy calls never import torch.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import cache
from typing import Any

import numpy as np

Array = Any  # a NumPy array or a torch tensor


def is_tensor(x: object) -> bool:
    """Return True for a torch tensor, decided without importing torch."""
    if type(x) is np.ndarray:
        return False
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(x, torch.Tensor)


def as_tensor(x: Array) -> Array:
    """Return a tensor of the same numbers: itself, or of a copy of an array."""
    import torch

    return x if isinstance(x, torch.Tensor) else torch.as_tensor(np.array(x))


def as_array(x: Any) -> Array:
    """Return a tensor as it is, and all else as an array."""
    return x if is_tensor(x) else np.asarray(x)


def without_torch(x: Any) -> Any:
    """Return the values of a tensor as an array, and all else as it is."""
    return to_numpy(x) if is_tensor(x) else x


def copied(x: Array) -> Array:
    """Return a copy, in the graph of a tensor."""
    return x.clone() if is_tensor(x) else x.copy()


def library(x: Array) -> Any:
    """Return the module of the functions for `x`: NumPy or torch."""
    return sys.modules["torch"] if is_tensor(x) else np


def library_name(x: Array) -> str:
    """Return "torch" for a tensor and "numpy" for an array."""
    return library(x).__name__


def concatenate(parts: Sequence[Array], axis: int = -1) -> Array:
    """Join arrays along an axis."""
    return library(parts[0]).concatenate(tuple(parts), axis=axis)


def stack(parts: Sequence[Array], axis: int = -1) -> Array:
    """Join arrays along a new axis."""
    return library(parts[0]).stack(tuple(parts), axis=axis)


def largest(x: Array) -> Array:
    """Return the largest |x_i| along the last axis, (..., 1)."""
    return library(x).amax(abs(x), axis=-1, keepdims=True)


def last(y: Array) -> Array:
    """Return y with its first axis as the last: time first as time last."""
    return y.T if y.ndim == 2 else moveaxis(y, 0, -1)


def moveaxis(y: Array, source: int, target: int) -> Array:
    """Return y with an axis in another place; torch maps `movedim`, and no `moveaxis`, over lanes."""
    return y.movedim(source, target) if is_tensor(y) else np.moveaxis(y, source, target)


def expanded(y: Array, shape: tuple[int, ...]) -> Array:
    """Return y broadcast to a shape: itself where it has that."""
    if tuple(y.shape) == shape:
        return y
    return library(y).broadcast_to(y, shape)


def masked(y: Array, mask: Any, value: Any) -> Array:
    """Return y with a value, a number or an array like it, where the mask, which broadcasts against it, is True."""
    return library(y).where(like(mask, y) != 0, value, y)


def of_library(value: Any, like: Array) -> Array:
    """Return a tensor as it is where `like` is one, and else as an array."""
    return value if is_tensor(like) else to_numpy(value)


def assemble(values: Sequence[Any], like: Array) -> Array:
    """Stack numbers, and arrays that broadcast to `like.shape`, along a new last axis, in the dtype of `like`."""
    if is_tensor(like):
        import torch

        # numbers, and what depends on the time alone, are the same for all of a batch
        full = [v + torch.zeros_like(like) if is_number(v) or v.ndim < like.ndim else v for v in values]
        return torch.stack(full, dim=-1).to(like.dtype)
    out = np.empty((*np.shape(like), len(values)), dtype=like.dtype)
    for i, value in enumerate(values):
        out[..., i] = value
    return out


def is_number(x: object) -> bool:
    """Return True for a Python scalar rather than an array (generated code returns these for constants)."""
    return isinstance(x, int | float)


def per_state(h: Any, y: Array) -> Any:
    """`h` of shape y.shape[:-1] (one value a state) made to broadcast against (..., k); numbers pass."""
    return h[..., None] if getattr(h, "ndim", 0) else h


def to_numpy(x: Array) -> np.ndarray:
    """The values of `x`, in no graph; a TypeError where it stands for many arrays, as under vmap, or none."""
    found = values(x)
    if found is None or (found is not x and found.ndim != np.ndim(x)):
        where = "in a graph that torch.compile traces" if found is None else "inside torch.func.vmap"
        raise TypeError(
            f"The values of a tensor of shape {tuple(x.shape)} are needed as numbers, and it has none {where}: make "
            "this call outside, on the results."
        )
    return found


def learnable(*arrays: Any) -> bool:
    """Return True if torch could follow one of these tensors, were gradients enabled."""
    return any(x.requires_grad or _is_transformed(x) for x in filter(is_tensor, arrays))


def differentiable(*arrays: Any) -> bool:
    """Return True if torch follows one of these tensors, by any means: NumPy would silently drop its derivatives."""
    return learnable(*arrays) and (_keeps_graphs() or transformed(*arrays))


def values(x: Any) -> np.ndarray | None:
    """Return the values of x, of a tensor (*lanes, *x.shape), lanes of vmap first; None where torch.compile traces."""
    plain, order = _behind(x)
    if plain is None or isinstance(plain, np.ndarray):
        return plain
    if isinstance(order, range):
        return plain.numpy()
    import torch

    with torch._C._DisableFuncTorch():
        return plain.cpu().numpy().transpose(order)


def values_of_times(t: Any, remedy: str) -> np.ndarray:
    """Return the values of times that say how many steps are made; a TypeError with the remedy if there are none."""
    found = values(t)
    if found is None:
        raise TypeError(
            f"`t` is a tensor without values where torch.compile traces, but it says how many steps are made: {remedy}."
        )
    return found


def has_values(x: Array) -> bool:
    """Return True unless `x` is a tensor without values, in a graph that `torch.compile` traces."""
    return _behind(x)[0] is not None


def one_lane(x: Array) -> np.ndarray:
    """Return the values of `x`, under `torch.func.vmap` those of the first lane."""
    found = values(x)
    return to_numpy(x) if found is None else found[(0,) * (found.ndim - x.ndim)]


def unfollowed(x: Array) -> Array:
    """Return `x` as a tensor that torch follows by no means, under `torch.func.vmap` its first lane; arrays pass.

    `x.detach()` inside a transform of `torch.func` is a tensor of that transform still.
    """
    plain, order = _behind(x)
    if plain is None or isinstance(plain, np.ndarray):
        return detached(x)
    import torch

    with torch._C._DisableFuncTorch():
        return plain.permute(tuple(order))[(0,) * (plain.ndim - x.ndim)]


def lanes(x: Array) -> int:
    """Return the number of axes, hidden in the shape of `x`, over which `torch.func.vmap` maps it."""
    return len(_behind(x)[1]) - x.ndim


def readable(x: Array) -> bool:
    """Return True if the values of `x` are there, one for each entry: not under vmap, nor where a graph is traced."""
    plain, order = _behind(x)
    return plain is not None and len(order) == x.ndim


def untransformed() -> AbstractContextManager[Any]:
    """Return a context in which tensors are made outside of the transforms of `torch.func` that may be under way."""
    from torch._functorch.pyfunctorch import temporarily_clear_interpreter_stack

    return temporarily_clear_interpreter_stack()


def _behind(x: Any) -> tuple[Any, Sequence[int]]:
    """The tensor with the values of x, in no graph, and the order of its axes: lanes first; None without values."""
    if not is_tensor(x):
        return (x := np.asarray(x)), range(x.ndim)
    import torch

    if torch.compiler.is_dynamo_compiling():
        return None, []
    functorch = torch._C._functorch
    if type(x) is torch.Tensor and x.is_cpu and functorch.peek_interpreter_stack() is None:
        return x.detach(), range(x.ndim)
    axes = list(range(x.ndim))
    with torch._C._DisableFuncTorch():
        while functorch.is_functorch_wrapped_tensor(x):
            if functorch.is_batchedtensor(x):
                axes.insert(functorch.maybe_get_bdim(x), min([0, *axes]) - 1)
            x = functorch.get_unwrapped(x)
        order = sorted(range(len(axes)), key=axes.__getitem__)
        return (None if _is_symbolic(x) else x.detach()), order


def transformed(*arrays: Any) -> bool:
    """Return True if torch follows one of these tensors by other means than a graph for reverse mode."""
    return any(map(_is_transformed, filter(is_tensor, arrays)))


def _keeps_graphs() -> bool:
    import torch

    return torch.is_grad_enabled()


def _is_transformed(x: Any) -> bool:
    import torch

    functorch = torch._C._functorch
    if torch.compiler.is_compiling() or functorch.is_functorch_wrapped_tensor(x) or _is_symbolic(x):
        return True
    if functorch.is_legacy_batchedtensor(x):  # cotangents side by side, of torch.autograd.grad(is_grads_batched=True)
        return True
    forward = torch.autograd.forward_ad
    return forward._current_level >= 0 and forward.unpack_dual(x).tangent is not None


def _is_symbolic(x: Any) -> bool:
    """True for the tensors without values with which `torch.compile` traces."""
    import torch

    if type(x) is torch.Tensor:
        return False
    from torch._subclasses import FakeTensor
    from torch._subclasses.functional_tensor import FunctionalTensor

    return isinstance(x, FakeTensor | FunctionalTensor)


def finite_states(y: Array, *, in_any_lane: bool = False) -> np.ndarray:
    """Return True for each of the states y (..., k) that is finite: (...) booleans.

    Tensors under `torch.func.vmap` are judged in all lanes, or in any; where there are no values, all states pass.
    """
    if str(y.device) == "cpu" and (found := values(y)) is not None and found.ndim == y.ndim:
        return np.isfinite(found).all(-1)
    finite = values(library(y).isfinite(y).all(-1))
    if finite is None:
        return np.ones(y.shape[:-1], dtype=bool)
    hidden = tuple(range(finite.ndim - y.ndim + 1))
    return np.asarray(finite.any(hidden) if in_any_lane else finite.all(hidden))


def full_of_nan(y: Array) -> Array:
    """NaN in the shape, dtype and library of `y`, and in no graph."""
    return library(y).full_like(y, np.nan)


def rows_of_nan(n: int, y: Array) -> Array:
    """Return NaN for n states such as y, (n, ...), with the n as the last axis but one in memory."""
    return moveaxis(like(np.full((*y.shape[:-1], n, y.shape[-1]), np.nan), y), -2, 0)


def with_rows(y: Array, rows: Any, values: Array) -> Array:
    """Return y with other rows, given by a slice or their numbers: the same array, or a tensor with its graph."""
    if is_tensor(y):
        import torch

        return y.index_copy(0, torch.arange(len(y), device=y.device)[rows], values)
    y[rows] = values
    return y


def known_finite(y: Array) -> bool:
    """Return True if an array is finite all over; of tensors that is not looked for."""
    return isinstance(y, np.ndarray) and bool(np.isfinite(y).all())


def jvp(f: Callable[[Array], Array], x: Array, v: Array) -> tuple[Array, Array]:
    """Return f(x) and its derivative at the tensor x along v, by torch, without the warnings that its set-up gives.

    By forward mode; inside `torch.autograd.forward_ad`, which cannot be nested, by reverse mode twice.
    """
    import torch

    _set_up()
    try:
        y, dy = torch.func.jvp(f, (x,), (v,))[:2]
    except RuntimeError as error:
        if "Nested forward mode" not in str(error):
            raise
        y, pull = torch.func.vjp(f, x)[:2]
        dy = torch.func.vjp(lambda u: pull(u)[0], torch.zeros_like(y))[1](v)[0]
    return y, dy


def jacobian(f: Callable[[Array], Array], x: Array, directions: Array | None = None) -> tuple[Array, Array]:
    """Return f of a tensor x (..., n), and its derivative (..., m, k) along directions (..., n, k), by default all."""
    import torch

    if directions is None:
        directions = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
    found = [jvp(f, x, v + 0 * x.detach()) for v in directions.unbind(-1)]
    return found[0][0], torch.stack([column for _, column in found], dim=-1)


@cache
def _set_up() -> None:
    """The first forward-mode derivative of a process makes torch import modules that warn of its own deprecations."""
    import torch

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        x = torch.zeros(1)
        torch.func.jvp(torch.sin, (x,), (x,))


def like(values: Any, x: Array) -> Array:
    """Return values in the library, dtype and device of `x`."""
    if is_tensor(x):
        return as_tensor(values).to(dtype=x.dtype, device=x.device)
    return np.asarray(values, dtype=x.dtype)


def beside(t: Any, x: Array) -> Any:
    """Return a time, a number or (...), as it stands beside x: as doubles, of a tensor on its device."""
    if not is_tensor(x):
        return np.float64(t) if type(t) is float else np.asarray(t, dtype=float)[()]  # 1/t at 0 is infinite, no error
    import torch

    return as_tensor(t).to(dtype=torch.float64, device=x.device)


def detached(x: Any) -> Any:
    """Return a tensor without the graph that it is in; all else as it is."""
    return x.detach() if is_tensor(x) else x


def opaque(function: Any, *x: Array) -> Array:
    """Return a function of NumPy arrays of arrays x, or of tensors, which torch differentiates by its own rules.

    It has `value(*arrays)`; `jvp(x, v)`, the derivative along v, whose entries may be None; `vjp(x, w, wanted)`,
    the derivatives of Σ w·value by those of x that are wanted.
    """
    return _opaque_function().apply(function, *x) if is_tensor(x[0]) else function.value(*x)


@cache
def _opaque_function() -> Any:
    import torch

    class Opaque(torch.autograd.Function):
        @staticmethod
        def forward(function: Any, *x: torch.Tensor) -> torch.Tensor:
            return torch.as_tensor(function.value(*map(to_numpy, x)), dtype=x[0].dtype, device=x[0].device)

        @staticmethod
        def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
            ctx.function, *x = inputs
            ctx.save_for_backward(*x)
            ctx.save_for_forward(*x)
            ctx.set_materialize_grads(False)  # so that what does not vary is told from what does

        @staticmethod
        def backward(ctx: Any, w: torch.Tensor | None) -> tuple[Any, ...]:
            x, wanted = ctx.saved_tensors, ctx.needs_input_grad[1:]
            return None, *((None,) * len(x) if w is None else ctx.function.vjp(x, w, wanted))

        @staticmethod
        def jvp(ctx: Any, _: None, *v: torch.Tensor | None) -> torch.Tensor:
            return ctx.function.jvp(ctx.saved_tensors, v)

        @staticmethod
        def vmap(info: Any, in_dims: tuple[Any, ...], function: Any, *x: torch.Tensor) -> tuple[torch.Tensor, int]:
            n, dims = info.batch_size, in_dims[1:]
            moved = [y.expand(n, *y.shape) if i is None else y.movedim(i, 0) for y, i in zip(x, dims, strict=True)]
            return Opaque.apply(function, *moved), 0

    return Opaque
