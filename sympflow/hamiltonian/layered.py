"""Potentials with linear layers, such as trained networks: their weights are arguments of the compiled code."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from sympflow.arrays import to_numpy
from sympflow.compiler.program import Program, adjoint, gradient, tangent, traced
from sympflow.compiler.tracing import Chain, Untraceable

MOST_FEATURES, MOST_OUTPUTS = 1024, 16  # of all layers, and of the last one


class LayeredPotential:
    """V(q) as a chain of linear layers, a_l = W_l x_l + b_l with x_{l+1} = σ(a_l), and ½ p·M⁻¹p.

    `first` leads from q to x_1, a layer from and to as many numbers as `sizes` says; `tensors` are weights and biases.
    """

    def __init__(self, ndof: int, chain: Chain, inverse_mass: np.ndarray | None) -> None:
        M = np.ones(ndof) if inverse_mass is None else inverse_mass
        self.ndof, self._chain, self.inverse_mass = ndof, chain, np.diag(M) if M.ndim == 1 else M
        self.first = chain.first
        self.sizes = [(w.shape[1], w.shape[0]) for w, _ in chain.layers]
        self.tensors = [x for pair in chain.layers for x in pair if x is not None]
        self.n_weights = sum(x.numel() for x in self.tensors)
        if sum(map(sum, self.sizes)) > MOST_FEATURES or self.sizes[-1][1] > MOST_OUTPUTS:
            raise Untraceable(f"its layers have more than {MOST_FEATURES} features, or {MOST_OUTPUTS} at the end")

    @cached_property
    def key(self) -> tuple[Any, ...]:
        """Same for potentials that share their code."""
        chain = self._chain
        programs = map(str, (chain.first, *chain.between, chain.last))
        biases = tuple(bias is not None for _, bias in chain.layers)
        return self.ndof, *programs, tuple(self.sizes), biases, self.inverse_mass.tobytes()

    @cached_property
    def starts(self) -> list[tuple[int, int | None]]:
        """Indices among all numbers at which the weights and the biases of each layer begin."""
        found, n = [], 0
        for (come, go), (_, bias) in zip(self.sizes, self._chain.layers, strict=True):
            found.append((n, None if bias is None else n + come * go))
            n += (come + (bias is not None)) * go
        return found

    @property
    def weights(self) -> np.ndarray:
        """The numbers of all tensors as they are now."""
        return np.concatenate([to_numpy(x).ravel() for x in self.tensors], dtype=np.float64)

    def value(self, q: np.ndarray) -> np.ndarray:
        """V (n,) of q (n, d)."""
        chain, columns = self._chain, list(q.T)
        x = np.stack(np.broadcast_arrays(*chain.first(*columns), columns[0])[:-1])
        for k, (weight, bias) in enumerate(chain.layers):
            a = to_numpy(weight) @ x + (0.0 if bias is None else to_numpy(bias)[:, None])
            x = chain.between[k](a)[0] if k < len(chain.between) else a
        return np.asarray(chain.last(*columns, *x)[0])

    @cached_property
    def activations(self) -> list[Program]:
        """From a to σ(a), σ'(a) and σ''(a), behind each layer but the last."""
        found = []
        for program in self._chain.between:
            (slope,) = gradient(program.outputs[0], program.inputs)
            found.append(Program(program.inputs, [*program.outputs, slope, *gradient(slope, program.inputs)]))
        return found

    @cached_property
    def first_moved(self) -> Program:
        """From q and v to x and its derivative along v."""
        d = self.ndof

        def both(*numbers: Any) -> list[Any]:
            x = self.first(*numbers[:d])
            return [*x, *tangent(x, numbers[:d], numbers[d:])]

        return traced(both, *_names("qv", d))

    @cached_property
    def first_reversed(self) -> Program:
        """From q and cotangents of x to those of q."""
        return adjoint(traced(self.first, *_names("q", self.ndof)))

    @cached_property
    def first_moved_reversed(self) -> Program:
        """From q, v and cotangents of what `first_moved` gives to those of q and v."""
        return adjoint(traced(self.first_moved, *_names("qv", self.ndof)))

    @cached_property
    def slopes(self) -> Program:
        """From q and what the last layer returns to the derivatives of V by these."""
        d, n = self.ndof, self.sizes[-1][1]

        def slopes(*numbers: Any) -> list[Any]:
            return gradient(self._chain.last(*numbers)[0], numbers)

        return traced(slopes, *_names("q", d), *_names("a", n))

    @cached_property
    def slopes_moved(self) -> Program:
        """The derivatives of v·∂V/∂q + w·∂V/∂a by q, a, v and w, from q, a, v and w."""
        d, n = self.ndof, self.sizes[-1][1]

        def slopes(*numbers: Any) -> list[Any]:
            x, moves = numbers[: d + n], numbers[d + n :]
            total: Any = 0.0
            for slope, move in zip(self.slopes(*x), moves, strict=True):
                total = total + slope * move
            return gradient(total, numbers)

        return traced(slopes, *_names("q", d), *_names("a", n), *_names("v", d), *_names("w", n))


def _names(letters: Sequence[str], n: int) -> list[str]:
    return [f"{letter}{i}" for letter in letters for i in range(n)]
