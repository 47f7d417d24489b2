"""The SympFlow kernel: a trained flow with MLP potentials, compiled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike

from sympflow.kernels.modules import OPTIONS, load_module, run_rows, template

if TYPE_CHECKING:
    from sympflow.flow.potentials import MLPPotential
    from sympflow.flow.sympflow import SympFlow

__all__ = ["MLPFlowKernel", "mlp_flow_kernel"]

_ACTIVATIONS = ("tanh", "sin", "sigmoid", "softplus", "logcosh")
_LANES = 32  # states side by side in a batch
_UNROLLED = 16  # the widest product that is unrolled whole


def mlp_flow_kernel(flow: SympFlow) -> MLPFlowKernel:
    """The compiled loops of a flow, made anew when its weights have changed.

    Raises
    ------
    ValueError
        If the flow cannot be compiled, with the reason.
    """
    known = _KERNELS.get(flow)
    if known is None or known.outdated():
        known = _KERNELS[flow] = MLPFlowKernel(flow)
    return known


_KERNELS: WeakKeyDictionary[Any, MLPFlowKernel] = WeakKeyDictionary()


@dataclass(frozen=True)
class _Architecture:
    ndof: int
    depth: int
    width: int
    activation: str

    @cache  # noqa: B019  (a few architectures in a process)
    def rollout(self, states: int) -> Callable[..., None]:
        """The compiled loops with `states` states side by side."""
        chunk = self.width if self.width <= _UNROLLED else 8
        constants = (
            f"import math\n\nfrom numba import njit\n\nOPTIONS = {OPTIONS | {'cache': True}}\n"
            f"NDOF = {self.ndof}\nDEPTH = {self.depth}\nWIDTH = {self.width}\nCHUNK = {chunk}\nSTATES = {states}"
        )
        activation = f"activation = {self.activation}\n"
        before, after = map(template, ("elementary", "activations")), map(template, ("aligned", "flow_loops"))
        source = "\n\n".join([constants, *before, activation, *after])
        return load_module(source).rollout


class MLPFlowKernel:
    """Compiled loops of one SympFlow with the weights that it has now; states are [q, p], float64.

    Parameters
    ----------
    flow : SympFlow
        Of kicks and drifts with MLP potentials of one depth and one activation, in float64 on the CPU.
    """

    def __init__(self, flow: SympFlow) -> None:
        from sympflow.flow.weights import Contents

        self.ndof = flow.ndof
        self._architecture, self._weights = _freeze(flow)
        self._contents = Contents(d for m in flow.modules() for d in (m._parameters, m._buffers))
        self._snapshot = self._contents.snapshot()

    def outdated(self) -> bool:
        """Whether the flow's weights are no longer those that were compiled in."""
        return self._contents.snapshot() != self._snapshot

    def run(self, h: float, y0: np.ndarray, n_steps: int, save: np.ndarray) -> tuple[np.ndarray, int]:
        """`n_steps` times ψ̄_h, or for h < 0 the inverse of ψ̄_|h|, from one state.

        Parameters
        ----------
        h : float
            Step, |h| ≤ Δt.
        y0 : ndarray of shape (2d,)
        n_steps : int
        save : ndarray of int64, sorted, in 0 … n_steps
            The steps whose states are kept.

        Returns
        -------
        Y : ndarray of shape (len(save), 2d)
            NaN after the last finite state.
        n_finite : int
            Index of the last step that ends in a finite state, `n_steps` if all do; the run stops there.
        """
        Y, n_finite = self._rollout(h, y0[None], n_steps, save, threads=1)
        return Y[0], int(n_finite[0])

    def run_batch(
        self, h: float, y0: np.ndarray, n_steps: int, save: np.ndarray, threads: int | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """`run` for every row of `y0` (N, 2d), in vector lanes and, where it pays, on several threads.

        Returns
        -------
        Y : ndarray of shape (N, len(save), 2d)
        n_finite : ndarray of int64, shape (N,)
        """
        return self._rollout(h, y0, n_steps, save, threads)

    def step(self, h: ArrayLike, y: np.ndarray) -> np.ndarray:
        """ψ̄_h of each row of `y` (N, 2d), each with its own h (N,), negative for the inverse."""
        steps = np.broadcast_to(np.asarray(h, dtype=np.float64), y.shape[:1])
        out = np.empty(y.shape)
        for rows in (steps >= 0, steps < 0):
            if rows.any():
                out[rows] = self._rollout(steps[rows], y[rows], 1, np.array([1]), None)[0][:, 0]
        return out

    def _rollout(
        self, h: ArrayLike, y0: np.ndarray, n_steps: int, save: np.ndarray, threads: int | None
    ) -> tuple[np.ndarray, np.ndarray]:
        y0, save = np.ascontiguousarray(y0, dtype=np.float64), np.ascontiguousarray(save, dtype=np.int64)
        steps = np.full(len(y0), h, dtype=np.float64)
        backwards, t = bool((steps < 0).any()), np.abs(steps)
        lanes = _LANES if len(y0) >= _LANES // 4 else 1
        rollout = self._architecture.rollout(lanes)
        out = np.empty((len(y0), len(save), y0.shape[1]))
        n_finite = np.empty(len(y0), dtype=np.int64)

        def rows(i: slice, stop: np.ndarray) -> None:
            rollout(self._weights, backwards, t[i], y0[i], n_steps, save, out[i], n_finite[i], stop)

        run_rows(rows, len(y0), 1000 * n_steps, threads)
        return out, n_finite


def _freeze(flow: SympFlow) -> tuple[_Architecture, tuple[np.ndarray, ...]]:
    """The architecture, and the arrays (is_kick, K, k, b, W, Wᵀ, w) of `flow_loops`, one entry a layer."""
    potentials: list[Any] = [getattr(layer, "potential", None) for layer in flow.layers]
    kinds = [layer.kind for layer in flow.layers]
    if any(kind not in {"kick", "drift"} for kind in kinds) or any(not hasattr(V, "folded") for V in potentials):
        raise ValueError("`flow` has layers other than kicks and drifts with MLP potentials: use backend='array'.")
    if str(flow.dtype) != "torch.float64" or flow.device.type != "cpu":
        raise ValueError(f"`flow` is {flow.dtype} on {flow.device}: compiled flows are float64 on the CPU.")
    depths, activations = {len(V.hidden) for V in potentials}, {V.activation for V in potentials}
    if len(depths) > 1 or len(activations) > 1 or not activations <= set(_ACTIVATIONS):
        raise ValueError(
            "`flow` must have potentials of one depth with one activation out of "
            f"{', '.join(_ACTIVATIONS)} to be compiled: use backend='array'."
        )
    width = max(max(V.hidden) for V in potentials)
    if width > _UNROLLED:
        width = -(-width // 8) * 8
    architecture = _Architecture(flow.ndof, depths.pop(), width, activations.pop())
    layers = [_padded(V, architecture) for V in potentials]
    K, k, b, W, w = (np.stack(arrays) for arrays in zip(*layers, strict=True))
    is_kick = np.array([kind == "kick" for kind in kinds])
    return architecture, (is_kick, K, k, b, W, np.ascontiguousarray(W.swapaxes(-1, -2)), w)


def _padded(potential: MLPPotential, architecture: _Architecture) -> tuple[np.ndarray, ...]:
    """The folded weights K (d, h), k (h,), b (n+1, h), W (n−1, h, h), w (h,); a zero row closes b."""
    K, k, biases, weights, w = potential.folded()
    h, n = architecture.width, architecture.depth
    padded = np.zeros((architecture.ndof, h)), np.zeros(h), np.zeros((n + 1, h)), np.zeros((n - 1, h, h)), np.zeros(h)
    rows = [(padded[0], K.T), (padded[1], k), (padded[4], w)]
    rows += [*zip(padded[2], biases, strict=False), *zip(padded[3], weights, strict=True)]
    for target, tensor in rows:
        values = tensor.detach().numpy()
        target[tuple(slice(size) for size in values.shape)] = values
    return padded
