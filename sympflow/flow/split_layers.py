"""The layers of a split flow, the parts that they are made of, and its maps, kept from run to run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from sympflow.arrays import jvp
from sympflow.flow.layers import Layer
from sympflow.flow.potentials import Time
from sympflow.hamiltonian.parts import LINEAR, ExactParts, Map, exact_parts

if TYPE_CHECKING:
    from sympflow.flow.split import SplitFlow
    from sympflow.hamiltonian.system import HamiltonianSystem
    from sympflow.kernels.split_flow import SplitFlowKernel

MOST_KEPT = 64  # steps whose maps are kept


class PartsBinding:
    """The system whose parts a flow is made of; shared by copies of the flow, stored in no file."""

    def __init__(self, system: HamiltonianSystem | None, expressions: Sequence[str] | None) -> None:
        self.expressions = None if expressions is None else tuple(expressions)
        self.system, self._parts = system, None if system is None else exact_parts(system, expressions)

    @property
    def parts(self) -> ExactParts:
        if self._parts is None:
            raise ValueError(
                "`flow` is made of the parts of a system, which its file does not hold: give it by "
                "sympflow.load(path, system=system) or flow.bind(system)."
            )
        return self._parts

    def bind(self, system: HamiltonianSystem, parts: ExactParts) -> None:
        self.system, self._parts = system, parts

    def __deepcopy__(self, memo: dict[int, Any]) -> PartsBinding:
        copied = PartsBinding(None, self.expressions)
        copied.system, copied._parts = self.system, self._parts
        return copied


class KeptMaps:
    """The maps of a flow of fixed numbers, the same objects for the same step, and what they cost.

    Attributes
    ----------
    compilable : bool
        Whether the numbers are float64 on the CPU: asked once, as torch answers slowly.
    """

    kernel: SplitFlowKernel | None = None
    """The compiled loops that were made of these last."""

    def __init__(
        self, make: Callable[[np.ndarray], list[Map]], coefficients: list[Map], dt: float, like: Tensor
    ) -> None:
        self._make, self._dt = make, dt
        self._coefficients = coefficients, [m.inverse() for m in reversed(coefficients)]
        self.compilable = like.dtype == torch.float64 and like.device.type == "cpu"
        self._maps: dict[float, list[Map]] = {}
        self._counts: dict[tuple[int, int, int, str], dict[str, int]] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "kernel"}

    def maps(self, t: float) -> list[Map]:
        if t not in self._maps:
            if len(self._maps) >= MOST_KEPT:
                self._maps.clear()
            self._maps[t] = self._make(np.array(t))
        return self._maps[t]

    def coefficients(self, back: bool) -> list[Map]:
        """The maps at all t, or those of the inverse: see `PartsKernel.step_by_coefficients`."""
        return self._coefficients[back]

    def evaluations(self, *run: Any) -> dict[str, int]:
        """As `FixedStep.evaluations`."""
        from sympflow.hamiltonian.parts import map_evaluations

        if run not in self._counts:
            if len(self._counts) >= MOST_KEPT:
                self._counts.clear()
            self._counts[run] = map_evaluations(self.maps(self._dt), *run)
        return dict(self._counts[run])


class SplitLayer(Layer):
    """The exact flow of a part of H, times functions of t; `index` is its place in the flow."""

    def __init__(self, flow: SplitFlow, index: int) -> None:
        super().__init__()
        self.ndof, self.index = flow.ndof, index
        self.part = flow.sequence[index]
        self.kind = "linear" if self.part == LINEAR else flow.kinds[self.part - 1]  # type: ignore[misc]
        self._of = (flow,)  # in a tuple: a layer does not own its flow

    @property
    def flow(self) -> SplitFlow:
        return self._of[0]

    def forward(self, t: Time, q: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
        return self._apply_map(self.flow.maps(t)[self.index], q, p)

    def inverse(self, t: Time, q: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
        return self._apply_map(self.flow.maps(t)[self.index].inverse(), q, p)

    def tangent(self, t: Time, q: Tensor, p: Tensor, dq: Tensor, dp: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        def along(s: Tensor) -> Tensor:
            return torch.cat(self(t + s, q + s * dq, p + s * dp))

        x, dx = jvp(along, q.new_zeros(()), q.new_ones(()))
        return (*x.chunk(2), *dx.chunk(2))

    def pull_back(self, t: Time, q: Tensor, p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        q, p = self.inverse(t, q, p)
        parts = self.flow.parts
        X, Y = parts.to_modes(torch.cat([q, p]).T)

        def generator(s: Tensor) -> Tensor:
            m = self.flow.maps(t + s)[self.index]
            if m.part == LINEAR:
                return (m.length * parts.linear_energies(X, Y)).sum(-1)
            V = m.length * parts.value(m.part, X, Y, m.filters)
            if isinstance(m.gradient, Tensor):
                slope, _ = parts.slopes(m.part, X, Y, m.filters)
                V = V - m.gradient * (slope * parts.inverse_masses(X) * slope).sum(-1) / 2
            return V

        return q, p, jvp(generator, q.new_zeros(()), q.new_ones(()))[1]

    def _apply_map(self, m: Map, q: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
        parts = self.flow.parts
        y = parts.from_modes(*parts.apply([m], *parts.to_modes(torch.cat([q, p]).T))).T
        return y.chunk(2)

    def to_dict(self) -> dict[str, Any]:
        return {"kind": self.kind, "part": self.part}
