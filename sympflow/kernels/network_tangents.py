"""Compiled derivatives of SympFlows with MLP potentials by their weights, for Gauss–Newton fits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np

from sympflow.kernels.modules import OPTIONS, load_module, template
from sympflow.kernels.threads import run_rows

__all__ = ["BENDING", "NetworkTangents", "TrainedNetwork"]

BENDING = ("tanh", "sin", "sigmoid", "softplus", "logcosh", "swish")
"""The activations that have three derivatives in compiled code: see the text `activation_bends`."""

LANES = 32  # points side by side, which divide those that a thread takes


@dataclass(frozen=True)
class TrainedNetwork:
    """The network of a kick or a drift, V(t, x) = w · σ(… σ(K x + k t + b_1) …), as it is fitted.

    Attributes
    ----------
    inputs : int
        Beside t: the d of x, and constants of a step.
    widths : tuple of int
        Of the hidden layers.
    activation : str
    units : ndarray
        The derivatives of K (h_1, inputs), k (h_1,), w (h_n,), b_1 … b_n, W_1 … W_{n−1}, one after another, by the
        parameters of the network, each a multiple of its own.
    """

    inputs: int
    widths: tuple[int, ...]
    activation: str
    units: np.ndarray


class NetworkTangents:
    """ψ̄_t of kicks and drifts with networks of one architecture, with d/dt ψ̄_t, and their derivatives by the weights.

    Parameters
    ----------
    ndof : int
        d.
    is_kick : sequence of bool
    networks : sequence of TrainedNetwork
        Of the layers, in their order, as are their parameters; all alike, with an activation of `BENDING`.
    """

    def __init__(self, ndof: int, is_kick: Sequence[bool], networks: Sequence[TrainedNetwork]) -> None:
        self.ndof = ndof
        self._is_kick, self._units = np.array(is_kick), np.concatenate([n.units for n in networks])
        first = networks[0]
        self._activation, self._plan = first.activation, _plan(ndof, first.inputs, first.widths)
        self._kept: dict[tuple[bool, int], np.ndarray] = {}

    def values(
        self, parameters: np.ndarray, t: np.ndarray, x: np.ndarray, constants: np.ndarray, velocity: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """ψ̄_t(x) and, if asked for, d/dt ψ̄_t(x), of states (N, 2d) at times (N,), constants being (inputs − d, N)."""
        y, dy = np.empty(x.shape), np.empty(x.shape if velocity else (0, 0))
        self._run(velocity, "map_points", len(t), 1, parameters, t, x, constants, (y, dy))
        return y, dy

    def jacobian(
        self,
        parameters: np.ndarray,
        t: np.ndarray,
        x: np.ndarray,
        constants: np.ndarray,
        by_state: np.ndarray,
        by_velocity: np.ndarray | None = None,
        by_start: np.ndarray | None = None,
    ) -> np.ndarray:
        """J (n, 2d, N), the derivatives of 2d functions of ψ̄ and d/dt ψ̄ by the parameters.

        The next call for as many points overwrites it: it is tens of megabytes.

        Parameters
        ----------
        by_state : ndarray, shape (N, 2d, 2d)
            The derivatives of the functions by ψ̄_t(x).
        by_velocity : ndarray, shape (2d,), optional
            Those of each function by its component of d/dt ψ̄_t(x), if they depend on that.
        by_start : ndarray, shape (2d, 2d, N), optional
            Filled with the derivatives of the functions by x, without those of constants.
        """
        velocity = by_velocity is not None
        key, shape = (velocity, len(t)), (len(parameters), 2 * self.ndof, len(t))
        if key not in self._kept:
            self._kept = {k: J for k, J in self._kept.items() if k[0] != velocity} | {key: np.empty(shape)}
        J = self._kept[key]
        factors = by_state, by_velocity if velocity else np.zeros(2 * self.ndof)
        rest = self._units, *factors, J, np.empty((0, 0, 0)) if by_start is None else by_start
        self._run(velocity, "differentiate", len(t), 10 * self.ndof, parameters, t, x, constants, rest)
        return J

    def _run(
        self,
        velocity: bool,
        name: str,
        n_points: int,
        factor: int,
        parameters: np.ndarray,
        t: np.ndarray,
        x: np.ndarray,
        constants: np.ndarray,
        rest: tuple[Any, ...],
    ) -> None:
        """Call a function of the text on all blocks of points, on several threads where it pays."""
        function: Callable[..., None] = getattr(_loops(self._activation, velocity), name)
        weights = parameters * self._units

        def rows(points: slice, stop: np.ndarray) -> None:
            blocks = points.start // LANES, -(-points.stop // LANES)
            function(weights, self._plan, self._is_kick, t, x, constants, *blocks, *rest)

        run_rows(rows, n_points, factor * len(weights), None)


def _plan(ndof: int, inputs: int, widths: tuple[int, ...]) -> tuple[Any, ...]:
    """The plan of networks as the text takes it."""
    h = np.array(widths)
    time = inputs * widths[0]
    out = time + widths[0]
    biases = out + widths[-1] + np.cumsum([0, *widths[:-1]])
    matrices = biases[-1] + widths[-1] + np.cumsum([0, *(h[1:] * h[:-1])])
    return ndof, inputs, h, biases, matrices[:-1], time, out, int(matrices[-1])


@cache
def _loops(activation: str, velocity: bool) -> ModuleType:
    constants = (
        f"import math\n\nfrom numba import njit\n\nOPTIONS = {OPTIONS | {'cache': True}}\n"
        f"LANES = {LANES}\nVELOCITY = {velocity}"
    )
    before = map(template, ("elementary", "activation_bends"))
    return load_module("\n\n\n".join([constants, *before, f"activation = {activation}", template("network_tangents")]))
