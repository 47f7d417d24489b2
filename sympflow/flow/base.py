"""FlowMap: what every learned flow map ψ_t has in common, from its extension to all times to its record."""

from __future__ import annotations

import math
import os
from itertools import chain
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor, nn

from sympflow.arguments import plain
from sympflow.flow.arguments import bare_time, check_system, checked_time
from sympflow.flow.steps import whole_steps, whole_steps_of_each
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.fingerprint import same_system

if TYPE_CHECKING:
    from sympflow.flow.certificate import Certificate
    from sympflow.hamiltonian.system import HamiltonianSystem

MIN_DT, MAX_DT = 1e-18, 1e18  # were they seconds, from an attosecond to more than the age of the universe


class FlowMap(nn.Module):
    """A learned map ψ̄_t, t ∈ [0, Δt], of states [q, p], and its extension ψ_t to every t.

    Duties of a subclass
    --------------------
    1. `_map(t, y)`: ψ̄_t on columns y (2d, N), for a time t that is a float or a tensor () or (N,).
    2. `_map_inverse(t, y)`: ψ̄_t⁻¹, if it has one.
    3. `_map_tangent(t, y)`: ψ̄_t(y) and d/dt ψ̄_t(y).
    4. `architecture()`: a JSON-able description from which `flow.io` builds it again.

    Attributes
    ----------
    ndof : int
    dt : float
        Δt, the longest time of the bare map.
    domain : Domain or None
        Ω, where it was trained.
    fingerprint, system_name : tuple of float or None, str or None
        The system it was trained for.
    recipe, figures : dict
        How it was trained, and what it achieved.
    history : list of dict
        Held-out figures over its training in this session; not saved.
    certified : Certificate or None
        What `certificate` found, or the file held that the flow was loaded from.
    """

    kind: ClassVar[str]

    def __init__(self, ndof: int, dt: float) -> None:
        super().__init__()
        ndof, dt = plain(ndof), plain(dt)
        if isinstance(ndof, bool) or not isinstance(ndof, int) or ndof < 1:
            raise ValueError(f"`ndof` must be a positive integer, the degrees of freedom; got {ndof!r}.")
        if isinstance(dt, bool) or not isinstance(dt, (int, float)) or not 0 < dt < math.inf:
            raise ValueError(f"`dt` must be a positive finite number, the Δt of the flow; got {dt!r}: 1.0 is usual.")
        if not MIN_DT <= dt <= MAX_DT:
            raise ValueError(
                f"`dt` must lie between {MIN_DT:g} and {MAX_DT:g}; got {dt!r}: choose another unit of time."
            )
        self.ndof, self.dt = ndof, float(dt)
        self.domain: Domain | None = None
        self.fingerprint: tuple[float, ...] | None = None
        self.system_name: str | None = None
        self.recipe: dict[str, Any] = {}
        self.figures: dict[str, Any] = {}
        self.history: list[dict[str, float]] = []
        self.certified: Certificate | None = None

    def _map(self, t: float | Tensor, y: Tensor) -> Tensor:
        raise NotImplementedError

    def _map_inverse(self, t: float | Tensor, y: Tensor) -> Tensor:
        raise NotImplementedError

    def _map_tangent(self, t: float | Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        raise NotImplementedError

    def architecture(self) -> dict[str, Any]:
        raise NotImplementedError

    # the bare map on [0, Δt] --------------------------------------------------------------------------

    def psi(self, t: float | Tensor, x: Tensor) -> Tensor:
        """ψ̄_t(x) for t ∈ [0, Δt], unchecked and without synchronising with the host: for inner loops.

        `t` is a number or a tensor that broadcasts against the batch shape of `x` (..., 2d).
        """
        t, y, batch = self._columns(t, x)
        return self._states(self._map(t, y), batch)

    def psi_inverse(self, t: float | Tensor, x: Tensor) -> Tensor:
        """ψ̄_t⁻¹(x) for t ∈ [0, Δt], unchecked."""
        t, y, batch = self._columns(t, x)
        return self._states(self._map_inverse(t, y), batch)

    def psi_and_velocity(self, t: float | Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """ψ̄_t(x) and d/dt ψ̄_t(x), each (..., 2d), for t ∈ [0, Δt], unchecked."""
        t, y, batch = self._columns(t, x)
        y, dy = self._map_tangent(t, y)
        return self._states(y, batch), self._states(dy, batch)

    def velocity(self, t: float | Tensor, x: Tensor) -> Tensor:
        """d/dt ψ̄_t(x), (..., 2d), for t ∈ [0, Δt], in closed form."""
        t = bare_time(self, t, x)
        return self.psi_and_velocity(t, x)[1]

    # every t ------------------------------------------------------------------------------------------

    def forward(self, t: float | Tensor, x: Tensor) -> Tensor:
        """ψ_t(x) for every t.

        ψ_t = ψ̄_r ∘ (ψ̄_Δt)^k with k = ⌊t/Δt⌋, r = t − kΔt; for t < 0 it is (ψ̄_r)⁻¹ ∘ (ψ̄_Δt)⁻ᵏ with |t| for t.
        k is an integer count: a t that is a multiple of Δt up to rounding is exactly k steps.

        Parameters
        ----------
        t : float or tensor
            One time, or a tensor that broadcasts against the batch shape of x.
        x : tensor, shape (..., 2d)
            In the dtype and on the device of the flow.

        Raises
        ------
        ValueError, TypeError
            If an argument has the wrong type, shape, dtype or device, or t is not finite.
        """
        t = checked_time(self, t, x)
        if isinstance(t, float):
            return self._whole(whole_steps(abs(t), self.dt), t < 0, x)
        k, r, back, x = self._split(t, x)
        x = self._repeat(k * ~back, False, x)
        x = self._repeat(k * back, True, x)
        return self._remainder(r, back, x)

    def inverse(self, t: float | Tensor, x: Tensor) -> Tensor:
        """The exact inverse of ψ_t, for every t: arguments as for the call."""
        t = checked_time(self, t, x)
        if isinstance(t, float):
            return self._whole(whole_steps(abs(t), self.dt), t >= 0, x, remainder_first=True)
        k, r, back, x = self._split(t, x)
        x = self._remainder(r, ~back, x)
        x = self._repeat(k * ~back, True, x)
        return self._repeat(k * back, False, x)

    def _whole(self, count: tuple[int, float], back: bool, x: Tensor, remainder_first: bool = False) -> Tensor:
        """k steps and the remainder of one time for all states."""
        k, r = count
        _, y, batch = self._columns(self.dt, x)
        step = self._map_inverse if back else self._map
        if r and remainder_first:
            y = step(r, y)
        for _ in range(k):
            y = step(self.dt, y)
        if r and not remainder_first:
            y = step(r, y)
        return self._states(y, batch)

    def _split(self, t: Tensor, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Counts k, remainders r and directions of the times t, broadcast with the states x."""
        batch = torch.broadcast_shapes(t.shape, x.shape[:-1])
        k, r = whole_steps_of_each(torch.where(t < 0, -t, t), self.dt)
        k, r, back = (v.expand(batch) for v in (k, r.to(x.dtype), t < 0))
        return k, r, back, x.expand(*batch, x.shape[-1])

    def _repeat(self, k: Tensor, back: bool, x: Tensor) -> Tensor:
        """ψ̄_Δt, or its inverse, k times, with a count k for each state."""
        step = self.psi_inverse if back else self.psi
        for j in range(int(k.max()) if k.numel() else 0):
            active = k > j
            x = x.index_put((active,), step(self.dt, x[active]))
        return x

    def _remainder(self, r: Tensor, back: Tensor, x: Tensor) -> Tensor:
        moving = (r > 0) | r.requires_grad  # at r = 0 the state stays, but has a derivative
        for step, active in ((self.psi, moving & ~back), (self.psi_inverse, moving & back)):
            if active.any():
                x = x.index_put((active,), step(r[active], x[active]))
        return x

    # layout --------------------------------------------------------------------------------------------

    def _columns(self, t: float | Tensor, x: Tensor) -> tuple[float | Tensor, Tensor, torch.Size]:
        """States (..., 2d) as columns (2d, N), times to match, and the batch shape."""
        batch = x.shape[:-1]
        if isinstance(t, Tensor) and t.ndim:
            batch = torch.broadcast_shapes(t.shape, batch)
            x = x.expand(*batch, x.shape[-1])
            t = t.expand(batch).reshape(-1)
        return t, x.reshape(-1, x.shape[-1]).T.contiguous(), batch

    @staticmethod
    def _states(y: Tensor, batch: torch.Size) -> Tensor:
        return y.T.reshape(*batch, y.shape[0])

    # what it is --------------------------------------------------------------------------------------------

    @property
    def dtype(self) -> torch.dtype:
        """That of its numbers; float64 if it has none."""
        return next((w.dtype for w in chain(self.parameters(), self.buffers())), torch.float64)

    @property
    def device(self) -> torch.device:
        """Where its numbers are; the CPU if it has none."""
        return next((w.device for w in chain(self.parameters(), self.buffers())), torch.device("cpu"))

    @property
    def n_parameters(self) -> int:
        """Number of trainable parameters."""
        return sum(w.numel() for w in self.parameters())

    def check_system(self, system: HamiltonianSystem) -> None:
        """Raise ValueError if `system` is not the one this flow was trained for (a bare flow fits any)."""
        check_system(system)
        mine, origin = self.fingerprint, self.recipe.get("transforms")
        if mine is not None and system.ndof == self.ndof and same_system(mine, system.fingerprint):
            return
        if origin is not None and same_system(origin["fingerprint"], system.fingerprint):
            raise ValueError(
                f"`system` {system.name!r} is the one of this flow, but in another time: pass time_transformed(system, "
                f"{origin['shift']:g}) here; solve(system, 'sympflow', flow=flow) runs it in the physical time."
            )
        remedy = "pass the flow of this system, or train one with sympflow.train(system)."
        if system.ndof != self.ndof:
            raise ValueError(
                f"`system` {system.name!r} has {system.ndof} degrees of freedom but the flow {self.ndof}: {remedy}"
            )
        if mine is not None:
            raise ValueError(
                f"`system` {system.name!r} is not the one that this flow was trained for ({self.system_name!r}, or its "
                f"parameters differ): {remedy}"
            )

    def bound(self, system: HamiltonianSystem) -> FlowMap:
        """This flow, ready to be used on `system`: one that is made of the system's own functions takes them."""
        return self

    def certificate(
        self,
        system: HamiltonianSystem,
        *,
        states: int = 2000,
        times: int = 33,
        held_out: int = 100,
        t_end: float = 1000.0,
        seed: int = 0,
    ) -> Certificate:
        """An a-posteriori statement on this flow's energy error, kept as `certified` and stored by `save`.

        Over a seeded sample of Ω × [0, Δt] it estimates the defect, sup |𝓗 − H − c(t)|, and the δ with which
        |H(ψ_kΔt(x)) − H(x)| ≤ kδ while the orbit is in Ω at every step; beside it stands the measured error of orbits
        from held-out states. It is an estimate, not a proof: the suprema are the largest values in the sample.

        Parameters
        ----------
        system : HamiltonianSystem
        states, times : int
            Size of the sample.
        held_out : int
            Number of held-out states.
        t_end : float
            How far their orbits are followed.
        seed : int

        Raises
        ------
        TypeError
            If this is an unconstrained network, which has no Hamiltonian.
        ValueError
            If `system` is not that of the flow, there is no domain, or an argument is not admissible.

        References
        ----------
        .. [1] E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration, 2006, section IX.8, for the argument.

        Examples
        --------
        >>> print(flow.certificate(system))
        """
        from sympflow.flow.certification import certificate

        self.certified = certificate(
            self, system, states=states, times=times, held_out=held_out, t_end=t_end, seed=seed
        )
        return self.certified

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the flow to a safetensors file, with all that `sympflow.load` needs and its record."""
        from sympflow.flow.io import save

        save(self, path)

    def __repr__(self) -> str:
        system = f" of {self.system_name}" if self.system_name else ""
        return f"<{type(self).__name__}{system}: ndof={self.ndof}, dt={self.dt:g}, {self.n_parameters} parameters>"
