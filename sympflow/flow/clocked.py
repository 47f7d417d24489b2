"""SympFlows of a logarithmic Hamiltonian whose clock is trained: a splitting scheme, and a correction of the time.

In the variables [q, t, p, B] of `sympflow.time_transformed` every kick and drift keeps B, and nothing depends on t. So
the flow of any function of B alone,

    V_m(t, P) = Σ_k c_k t^(3+2k) B^(k+1)/(k+1),        t ← t + Σ_k c_k t^(3+2k) B^k,

commutes with all maps of a splitting scheme: it leaves the orbit as it is, and moves the time along it. Of a Kepler
ellipse the leapfrog in these variables is late by a function of the step and of B, the same everywhere on the orbit:
with the c_k trained, orbit and time are exact but for what the series leaves out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from sympflow.arguments import check_counts
from sympflow.flow.layers import Drift, Kick, Layer
from sympflow.flow.potentials import Potential, Time
from sympflow.flow.primed_potentials import KINETIC, POTENTIAL, PrimedPotential
from sympflow.flow.records import MAX_DEGREE, Refused, checked_integer
from sympflow.flow.sympflow import SystemFlow
from sympflow.flow.weights import Kept, doubles
from sympflow.hamiltonian.fingerprint import check_for_flows
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.schemes import SCHEMES, scheme_evaluations

if TYPE_CHECKING:  # a flow needs it only to be compiled
    from sympflow.flow.loops import ClockedFlowKernel


class ClockPotential(Potential):
    """Σ_k c_k t^(3+2k) B^(k+1)/(k+1), B the last momentum, of d + 1 degrees of freedom; `numbers` are the c_k."""

    def __init__(
        self, ndof: int, terms: int, dtype: torch.dtype = torch.float64, device: torch.device | None = None
    ) -> None:
        super().__init__()
        self.ndof = ndof
        self.numbers = nn.Parameter(torch.zeros(terms, dtype=dtype, device=device))

    def value(self, t: Time, x: Tensor) -> Tensor:
        B = x[-1]
        return sum((c * t ** (3 + 2 * k) * B ** (k + 1) / (k + 1) for k, c in enumerate(self.numbers)), 0 * B)

    def impulse(self, t: Time, x: Tensor) -> Tensor:
        B = x[-1]
        advance = sum((c * t ** (3 + 2 * k) * B**k for k, c in enumerate(self.numbers)), 0 * B)
        return torch.cat([torch.zeros_like(x[:-1]), advance[None]])


@dataclass(frozen=True)
class Share:
    """The coefficient c·t of a fixed scheme."""

    c: float

    def value(self, t: Time) -> Time:
        return self.c * t

    def rate(self, t: Time) -> Time:
        """Its time derivative."""
        return self.c + 0 * t


class ClockedFlow(SystemFlow):
    """A symmetric splitting scheme on a logarithmic Hamiltonian, and after it the trained clock of so many `terms`.

    Both are odd in the flow's time s, and commute: ψ̄_{−s} = (ψ̄_s)⁻¹, continued to negative s by its formulas. It is
    no approximation of the exact flow in s, for a scheme is early or late there, but in the physical time: ψ̄_s(x) lies
    on the solution through x, at the time t that it holds. `dt` is the longest step in s, `ndof` of the transformed
    system, one of `sympflow.time_transformed`, without which the flow has no values. A ValueError if the scheme is not
    symmetric or has force gradients, or the system has no `shift`.
    """

    PLAN = "clocked"

    def __init__(
        self,
        ndof: int,
        scheme: str = "leapfrog",
        terms: int = 8,
        dt: float = 1.0,
        system: HamiltonianSystem | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__(ndof, dt, dtype, device)
        table = SCHEMES.get(scheme)
        if table is None or not table.symmetric or any(table.gradients) or table.nystrom:
            raise ValueError(f"`scheme` {scheme!r} is not a symmetric one without force gradients: take 'leapfrog'.")
        check_counts(terms=terms)
        self.scheme = table
        self.clock = ClockPotential(ndof, terms, **self._like)
        self._numbers: Kept[tuple[float, ...]] = Kept([self.clock._parameters])
        maps: list[Layer] = []
        for kind, c, *_ in table.substeps:
            term = KINETIC if kind == "drift" else POTENTIAL
            potential = PrimedPotential(ndof, self._binding, [(term, Share(float(c)))])
            maps.append(Drift(potential) if kind == "drift" else Kick(potential))
        # A tuple, not a ModuleList: the clock is the only one with parameters, and they are the flow's.
        self.layers = (*maps, Drift(self.clock))
        self._made_of(system)

    def _number(self) -> Tensor:
        return self.clock.numbers

    def advance(self, s: Any, B: Any) -> Any:
        """Return by how much the clock puts the time forward in steps s at B: numbers or arrays; s may be negative."""
        square = s * s * B
        total = 0.0 * square
        for c in self.clock_numbers():
            total = total * square + c
        return s * s * s * total

    def clock_numbers(self) -> tuple[float, ...]:
        """Return the c_k that the clock has now, the last one first."""
        return self._numbers.current(lambda: tuple(doubles(self.clock.numbers)[::-1].tolist()))

    def _compiled_for(self, system: HamiltonianSystem, compensated: bool) -> ClockedFlowKernel:
        from sympflow.flow.loops import ClockedFlowKernel

        return ClockedFlowKernel(self.scheme, system, self.advance)

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        return scheme_evaluations(self.scheme, n_steps, n_saved, n_extra, backend)

    def _take(self, system: HamiltonianSystem) -> None:
        check_for_flows(system)
        if "shift" not in system.params:
            raise ValueError(
                "`system` is not a logarithmic Hamiltonian: make one by sympflow.time_transformed(system)."
            )
        super()._take(system)

    def plan(self) -> dict[str, Any]:
        return {"scheme": self.scheme.name, "terms": len(self.clock.numbers)}

    @classmethod
    def checked_plan(cls, plan: dict[str, Any], ndof: int) -> dict[str, Any]:
        if not isinstance(plan.get("scheme"), str):
            raise Refused("its scheme is missing")
        return {"scheme": plan["scheme"], "terms": checked_integer(plan.get("terms"), "number of terms", MAX_DEGREE)}
