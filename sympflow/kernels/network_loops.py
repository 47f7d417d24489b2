"""Compiled loops of SympFlows whose potentials are multilayer perceptrons."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numba import njit
from numba.core.registry import CPUDispatcher
from numpy.typing import ArrayLike

from sympflow.kernels.modules import OPTIONS, load_around, load_module, template
from sympflow.kernels.protocol import Carry, Kernel, Run, Steps, run_states

__all__ = ["MLPFlowKernel", "NetworkLayer"]

_ACTIVATIONS = ("tanh", "sin", "sigmoid", "softplus", "logcosh", "swish")
_LANES = 32  # states side by side in a batch
_UNROLLED = 16  # the widest product that is unrolled whole


@dataclass(frozen=True, eq=False)
class NetworkLayer:
    """The weights of a kick or a drift, whose potential is V(t, x) = w · σ(… σ(K x + k t + b_1) …).

    Attributes
    ----------
    is_kick : bool
    activation : str
        The name of σ.
    K, k : ndarrays of shape (h_1, d) and (h_1,)
    biases : sequence of ndarrays of shape (h_l,)
    weights : sequence of ndarrays of shape (h_{l+1}, h_l)
    w : ndarray of shape (h_n,)
    slopes : callable, optional
        Where the loops do not know σ by its name: a function of a number a that returns σ(a) and σ'(a).
    """

    is_kick: bool
    activation: str
    K: np.ndarray
    k: np.ndarray
    biases: Sequence[np.ndarray]
    weights: Sequence[np.ndarray]
    w: np.ndarray
    slopes: Callable[[float], Any] | None = None


@dataclass(frozen=True)
class _Architecture:
    ndof: int
    depth: int
    width: int
    activation: str
    slopes: Callable[[float], Any] | None = None

    @cache  # noqa: B019  (a few architectures in a process)
    def rollout(self, states: int) -> Callable[..., None]:
        """The compiled loops with `states` states side by side."""
        chunk = self.width if self.width <= _UNROLLED else 8
        own = self.activation not in _ACTIVATIONS
        constants = (
            f"import math\n\nfrom numba import njit\n\nOPTIONS = {OPTIONS | {'cache': not own}}\n"
            f"NDOF = {self.ndof}\nDEPTH = {self.depth}\nWIDTH = {self.width}\nCHUNK = {chunk}\nSTATES = {states}"
        )
        after = map(template, ("aligned", "network"))
        if own:  # a function of the user's: compiled for this process only
            slopes = self.slopes if isinstance(self.slopes, CPUDispatcher) else njit(**OPTIONS)(self.slopes)
            return load_around("\n\n".join([constants, *after]), activation=slopes).rollout
        activation = f"activation = {self.activation}\n"
        before = map(template, ("elementary", "activation_slopes"))
        source = "\n\n".join([constants, *before, activation, *after])
        return load_module(source).rollout


class MLPFlowKernel(Kernel):
    """Compiled loops of one SympFlow with the weights given, a `Kernel`; a step h < 0 is the inverse of ψ̄_|h|.

    Parameters
    ----------
    ndof : int
        d.
    layers : sequence of NetworkLayer
        In their order, with potentials of one depth and one activation; steps |h| are at most Δt.

    Raises
    ------
    ValueError
        If depths or activations differ, or there is no compiled form of the activation.
    """

    saves_finite = False

    def __init__(self, ndof: int, layers: Sequence[NetworkLayer]) -> None:
        depths, activations = {len(layer.biases) for layer in layers}, {layer.activation for layer in layers}
        slopes = layers[0].slopes
        if len(depths) > 1 or len(activations) > 1 or not (activations <= set(_ACTIVATIONS) or slopes is not None):
            raise ValueError(
                "`flow` must have potentials of one depth with one activation out of "
                f"{', '.join(_ACTIVATIONS)}, or one that was registered with `compiled`, to be compiled: use "
                "backend='array'."
            )
        width = max(len(b) for layer in layers for b in layer.biases)
        if width > _UNROLLED:
            width = -(-width // 8) * 8
        self._architecture = _Architecture(ndof, depths.pop(), width, activations.pop(), slopes)
        padded = [_padded(layer, self._architecture) for layer in layers]
        K, k, b, W, w = (np.stack(arrays) for arrays in zip(*padded, strict=True))
        is_kick = np.array([layer.is_kick for layer in layers])
        self._weights = is_kick, K, k, b, W, np.ascontiguousarray(W.swapaxes(-1, -2)), w

    def run(self, h: float, y0: np.ndarray, n_steps: int, save: np.ndarray, carry: Carry | None = None) -> Run:
        """`n_steps` times ψ̄_h from one state: see `Kernel`."""
        Y, n_finite, _ = self._rollout(h, y0[None], n_steps, save, 1, carry)
        return Run(Y[0], int(n_finite[0]))

    def run_batch(
        self,
        h: float,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        threads: int | None = None,
        carry: Carry | None = None,
    ) -> Run:
        """`run` for every row of `y0` (N, 2d), in vector lanes and, where it pays, on several threads."""
        return self._rollout(h, y0, n_steps, save, threads, carry)

    def step(self, h: ArrayLike, y: np.ndarray) -> Steps:
        """ψ̄_h of each row of `y` (N, 2d), each with its own h (N,), negative for the inverse."""
        steps = np.broadcast_to(np.asarray(h, dtype=np.float64), y.shape[:1])
        out = np.empty(y.shape)
        for rows in (steps >= 0, steps < 0):
            if rows.any():
                out[rows] = self._rollout(steps[rows], y[rows], 1, np.array([1]), None).states[:, 0]
        return Steps(out)

    def _rollout(
        self,
        h: ArrayLike,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        threads: int | None,
        carry: Carry | None = None,
    ) -> Run:
        steps = np.full(len(y0), h, dtype=np.float64)
        backwards, t = bool((steps < 0).any()), np.abs(steps)
        lanes = _LANES if len(y0) >= _LANES // 4 else 1
        rollout = self._architecture.rollout(lanes)

        def rows(i: slice, *rest: Any) -> None:
            rollout(self._weights, backwards, t[i], *rest)

        return run_states(rows, y0, n_steps, save, threads, carry, y0.shape[1], 1000)


def _padded(layer: NetworkLayer, architecture: _Architecture) -> tuple[np.ndarray, ...]:
    """The weights K (d, h), k (h,), b (n+1, h), W (n−1, h, h), w (h,); a zero row closes b."""
    h, n = architecture.width, architecture.depth
    padded = np.zeros((architecture.ndof, h)), np.zeros(h), np.zeros((n + 1, h)), np.zeros((n - 1, h, h)), np.zeros(h)
    rows = [(padded[0], layer.K.T), (padded[1], layer.k), (padded[4], layer.w)]
    rows += [*zip(padded[2], layer.biases, strict=False), *zip(padded[3], layer.weights, strict=True)]
    for target, values in rows:
        target[tuple(slice(size) for size in values.shape)] = values
    return padded
