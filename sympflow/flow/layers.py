"""The layers of a SympFlow: exact flows of simple Hamiltonians, applied one after another.

Arrays are feature-major, as in `sympflow.flow.potentials`: q and p have shape (d, N).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor, nn

from sympflow.flow.potentials import Potential, Time, by_time

if TYPE_CHECKING:  # a flow needs it only to be compiled
    from sympflow.hamiltonian.system import HamiltonianSystem


class Layer(nn.Module):
    """The flow φ_t, t ≥ 0, of a Hamiltonian H_t, with φ_0 the identity.

    A list of layers of any kinds in any order is a SympFlow; a new kind of layer is a subclass.

    Duties
    ------
    1. `forward(t, q, p)`: φ_t(q, p).
    2. `pull_back(t, q, p)`: φ_t⁻¹(q, p), and H_t(q, p) of shape (N,).
    3. `to_dict()`: the architecture, JSON-able.
    """

    kind: ClassVar[str]
    ndof: int

    def forward(self, t: Time, q: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
        raise NotImplementedError

    def inverse(self, t: Time, q: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
        """φ_t⁻¹(q, p)."""
        q, p, _ = self.pull_back(t, q, p)
        return q, p

    def tangent(self, t: Time, q: Tensor, p: Tensor, dq: Tensor, dp: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """φ_t(x) and d/dt φ_t(x(t)) along a curve with velocity (dq, dp), here by forward-mode differentiation."""
        x, dx = by_time(lambda s: torch.cat(self(t + s, q + s * dq, p + s * dp)), q)
        return (*x.split([len(q), len(p)]), *dx.split([len(q), len(p)]))

    def pull_back(self, t: Time, q: Tensor, p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        raise NotImplementedError


class OwnLayer(Layer, ABC):
    """A layer that takes its numbers and functions from its flow, and moves rows of states by `moved`."""

    def __init__(self, flow: Any) -> None:
        super().__init__()
        self.ndof = flow.ndof
        self._of = (flow,)  # in a tuple: a layer does not own its flow

    @property
    def flow(self) -> Any:
        return self._of[0]

    @abstractmethod
    def moved(self, t: Time, y: Tensor, back: bool) -> Tensor:
        """φ_t(y), or φ_t⁻¹(y), of rows (N, 2d)."""

    def forward(self, t: Time, q: Tensor, p: Tensor, back: bool = False) -> tuple[Tensor, Tensor]:
        q, p = self.moved(t, torch.cat([q, p]).T, back).T.chunk(2)
        return q, p

    def inverse(self, t: Time, q: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
        return self.forward(t, q, p, back=True)


class Binding:
    """The system whose functions a flow evaluates, shared by its copies; `made` is its use, for messages."""

    def __init__(self, system: HamiltonianSystem | None, made: str, parts: Any = None) -> None:
        self._system, self._made, self._parts = system, made, parts

    @property
    def known(self) -> bool:
        return self._system is not None

    @property
    def system(self) -> HamiltonianSystem:
        if self._system is None:
            raise ValueError(
                f"`flow` is {self._made}, which is not in its file: give it by "
                "sympflow.load(path, system=system) or flow.bind(system)."
            )
        return self._system

    @property
    def parts(self) -> Any:
        return self._parts if self.known else self.system

    def bind(self, system: HamiltonianSystem, parts: Any = None) -> None:
        self._system, self._parts = system, parts

    def __deepcopy__(self, memo: dict[int, Any]) -> Binding:
        return Binding(self._system, self._made, self._parts)


class PotentialLayer(Layer, ABC):
    """A layer that moves p by the impulse of a potential of q, or q by that of a potential of p."""

    def __init__(self, potential: Potential) -> None:
        super().__init__()
        self.potential = potential
        self.ndof = potential.ndof

    @abstractmethod
    def _argument(self, q: Tensor, p: Tensor) -> Tensor:
        """The argument of the potential: q or p."""

    @abstractmethod
    def _moved(self, q: Tensor, p: Tensor, g: Tensor) -> tuple[Tensor, Tensor]:
        """q and p after an impulse g of the potential."""

    def forward(self, t: Time, q: Tensor, p: Tensor, back: bool = False) -> tuple[Tensor, Tensor]:
        g = self.potential.impulse(t, self._argument(q, p))
        return self._moved(q, p, -g if back else g)

    def inverse(self, t: Time, q: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
        return self.forward(t, q, p, back=True)

    def tangent(self, t: Time, q: Tensor, p: Tensor, dq: Tensor, dp: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        g, dg = self.potential.impulse_and_tangent(t, self._argument(q, p), self._argument(dq, dp))
        return *self._moved(q, p, g), *self._moved(dq, dp, dg)

    def pull_back(self, t: Time, q: Tensor, p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        g, rate = self.potential.impulse_and_rate(t, self._argument(q, p))
        return *self._moved(q, p, -g), rate

    def to_dict(self) -> dict[str, Any]:
        return {"kind": self.kind, "potential": self.potential.to_dict()}


class Kick(PotentialLayer):
    """φ_t(q, p) = (q, p − (∇V(t, q) − ∇V(0, q))), the flow of H_t = ∂_tV(t, q)."""

    kind = "kick"

    def _argument(self, q: Tensor, p: Tensor) -> Tensor:
        return q

    def _moved(self, q: Tensor, p: Tensor, g: Tensor) -> tuple[Tensor, Tensor]:
        return q, p - g


class Drift(PotentialLayer):
    """φ_t(q, p) = (q + (∇V(t, p) − ∇V(0, p)), p), the flow of H_t = ∂_tV(t, p)."""

    kind = "drift"

    def _argument(self, q: Tensor, p: Tensor) -> Tensor:
        return p

    def _moved(self, q: Tensor, p: Tensor, g: Tensor) -> tuple[Tensor, Tensor]:
        return q + g, p


LAYERS: dict[str, type[PotentialLayer]] = {layer.kind: layer for layer in (Kick, Drift)}
