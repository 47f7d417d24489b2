"""FlowMap: what every learned flow map ψ_t has in common, from its extension to all times to its file."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor, nn

from sympflow.arguments import plain
from sympflow.arrays import differentiable, finite_states, has_values, readable, to_numpy, values, values_of_times
from sympflow.compiler import NotCompiled
from sympflow.flow.certificate import Certificate
from sympflow.flow.certification import certify
from sympflow.flow.files import write
from sympflow.flow.known import KnownFlow
from sympflow.flow.records import MAX_DT, MIN_DT, Provenance
from sympflow.flow.weights import checksum
from sympflow.hamiltonian.domain import EnergySublevel
from sympflow.hamiltonian.doubling import doubled
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.show.cards import Card, Shown, brief
from sympflow.show.pictures import trajectory_figure
from sympflow.show.style import saved

if TYPE_CHECKING:  # a flow needs it only to be compiled
    from matplotlib.figure import Figure

    from sympflow.kernels.network_tangents import NetworkTangents

DRAWN, DRAWN_STEPS, SHOWN_STEPS = 4, 400, 100  # orbits of a figure, their steps, and those that a notebook shows
MAX_STEPS = 10_000_000  # of one call
NO_NUMBER = torch.empty(0, dtype=torch.float64)
MEAN_TIMES = (0.5 - 0.75**0.5 / 3, 0.5 + 0.75**0.5 / 3)  # in Δt, at which 𝓗 is averaged: Gauss's


def check_system(system: Any) -> None:
    """Raise TypeError unless `system` is a HamiltonianSystem; ValueError if its functions are wrong."""
    if not isinstance(system, HamiltonianSystem):
        raise TypeError(
            f"`system` must be a HamiltonianSystem; got {type(system).__name__}: take a scene of sympflow.systems, or "
            "define one with HamiltonianSystem.from_sympy."
        )
    if system.functions_given:
        system.check_functions(torch.empty(0, dtype=torch.float64) if system.definition.takes_tensors else None)


@dataclass(frozen=True, eq=False)
class MeanHamiltonian:
    """The mean of a flow's 𝓗(t, x) over t ∈ [0, Δt], as a function of q and p: tensors (..., d)."""

    flow: FlowMap

    def __call__(self, q: Tensor, p: Tensor) -> Tensor:
        x, flow = torch.cat([q, p], -1), self.flow
        return torch.stack([flow.hamiltonian_unchecked(flow.dt * t, x) for t in MEAN_TIMES]).mean(0)


class FlowMap(KnownFlow, Shown, nn.Module):
    """A learned map ψ̄_t, t ∈ [0, Δt], of states [q, p], and its extension ψ_t to every t.

    Duties of a subclass
    --------------------
    1. `_map(t, y)`: ψ̄_t on columns y (2d, N), for a time t that is a float or a tensor () or (N,).
    2. `_map_inverse(t, y)`: ψ̄_t⁻¹, if it has one.
    3. `_map_tangent(t, y)`: ψ̄_t(y) and d/dt ψ̄_t(y).
    4. `architecture()`: a JSON-able description, and `from_architecture`, which builds it again.

    A subclass may also have a Hamiltonian, compiled loops, a clock, or functions of its system:
    `hamiltonian`, `kernel_for`, `clock_numbers`, `bound`, `evaluations`.

    Attributes
    ----------
    ndof : int
    dt : float
        Δt, the longest time of the bare map.
    history : list of dict
        Held-out figures over its training in this session; not saved. What else is known of it, as `domain`, `recipe`,
        `figures` and `certified`, is its `provenance`: see `sympflow.flow.records.Provenance`.
    """

    learned: HamiltonianSystem | None = None
    """The system that `sympflow.learn` found, of the flow that it made."""
    replicas: Any = None
    """The `Replicas` of `sympflow.learn`, if it was asked for them; not saved."""

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
        self.provenance = Provenance()
        self.history: list[dict[str, float]] = []

    def _map(self, t: float | Tensor, y: Tensor) -> Tensor:
        raise NotImplementedError

    def _map_inverse(self, t: float | Tensor, y: Tensor) -> Tensor:
        raise NotImplementedError

    def _map_tangent(self, t: float | Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        raise NotImplementedError

    def architecture(self) -> dict[str, Any]:
        raise NotImplementedError

    @classmethod
    def from_architecture(cls, ndof: int, plan: dict[str, Any], dt: float, dtype: torch.dtype) -> Self:
        """Return an untrained flow of the architecture in a file, after a check of all its entries.

        Raises
        ------
        Refused, ValueError
            If it is not admissible.
        """
        raise NotImplementedError

    # the bare map on [0, Δt] --------------------------------------------------------------------------

    def psi(self, t: float | Tensor, x: Tensor, t0: Any = None) -> Tensor:
        """ψ̄_t(x) for t ∈ [0, Δt], unchecked and without synchronising with the host: for inner loops.

        `t` is a number or a tensor that broadcasts against the batch shape of `x` (..., 2d); so is `t0`, the time of x,
        which the flow of a driven system takes.
        """
        return self.project(self._psi(t, self.lift(x, t0)))

    def psi_inverse(self, t: float | Tensor, x: Tensor, t0: Any = None) -> Tensor:
        """ψ̄_t⁻¹(x) for t ∈ [0, Δt], unchecked; x is at the time t0 + t."""
        return self.project(self._psi(t, self.lift(x, t0, t), back=True))

    def psi_and_velocity(self, t: float | Tensor, x: Tensor, t0: Any = None) -> tuple[Tensor, Tensor]:
        """ψ̄_t(x) and d/dt ψ̄_t(x), each (..., 2d), for t ∈ [0, Δt], unchecked."""
        t, y, batch = self._columns(t, self.lift(x, t0))
        y, dy = self._map_tangent(t, y)
        return self.project(self._states(y, batch)), self.project(self._states(dy, batch))

    def velocity(self, t: float | Tensor, x: Tensor, t0: Any = None) -> Tensor:
        """d/dt ψ̄_t(x), (..., 2d), for t ∈ [0, Δt], in closed form."""
        return self.psi_and_velocity(self._bare_time(t, x), x, t0)[1]

    def initial_velocity(self, x: Tensor, t0: Any = None) -> Tensor:
        """d/dt ψ̄_t(x) at t = 0, (..., 2d)."""
        return self.velocity(0.0, x, t0)

    def hamiltonian(self, t: float | Tensor, x: Tensor, t0: Any = None) -> Tensor:
        """𝓗(ψ̄)(t, x), (...), for t ∈ [0, Δt]: the Hamiltonian whose exact flow is ψ̄_t.

        The sum over the layers of ∂_tV at the point pulled back through the layers after it (Canizares et al. 2024,
        section 2.2), defined up to a function of t alone. That of a driven system is near H(t0 + t, x).

        Raises
        ------
        TypeError
            If this is an unconstrained network, which has none.
        """
        return self.hamiltonian_unchecked(self._bare_time(t, x), x, t0)

    def hamiltonian_unchecked(self, t: float | Tensor, x: Tensor, t0: Any = None) -> Tensor:
        """`hamiltonian` without checks, for inner loops."""
        raise TypeError("`flow` is an unconstrained network, which has no Hamiltonian: use a SympFlow.")

    # every t ------------------------------------------------------------------------------------------

    def forward(self, t: float | Tensor, x: Tensor, t0: Any = None) -> Tensor:
        """ψ_t(x) for every t.

        ψ_t = ψ̄_r ∘ (ψ̄_Δt)^k with k = ⌊t/Δt⌋, r = t − kΔt; for t < 0 it is (ψ̄_r)⁻¹ ∘ (ψ̄_Δt)⁻ᵏ with |t| for t.
        k is an integer count: a t that is a multiple of Δt up to rounding is exactly k steps.

        Parameters
        ----------
        t : float or tensor
            One time, or a tensor that broadcasts against the batch shape of x.
        x : tensor, shape (..., 2d)
            In the dtype and on the device of the flow.
        t0 : float or tensor
            The time of x, for a driven system only: one number, or one for each state.

        Raises
        ------
        ValueError, TypeError
            If an argument has the wrong type, shape, dtype or device, t or t0 is not finite, or t0 is missing.
        """
        return self._continued(t, x, t0)

    def inverse(self, t: float | Tensor, x: Tensor, t0: Any = None) -> Tensor:
        """The exact inverse of ψ_t, for every t: arguments as for the call, x being at the time t0 + t."""
        return self._continued(t, x, t0, inverse=True)

    def _continued(self, t: Any, x: Tensor, t0: Any, inverse: bool = False) -> Tensor:
        t = self._checked_time(t, x)
        self.warn_of_times(t)
        self.warn_of_drive(t0, t)
        x = self.lift(x, t0, t if inverse else 0.0)
        if isinstance(t, float):
            return self.project(self._whole(whole_steps(abs(t), self.dt), (t < 0) is not inverse, x, inverse))
        k, r, negative, x = self._split(t, x)
        back = negative ^ inverse
        if inverse:
            x = self._remainder(r, back, x)
        for rows in (back, ~back) if inverse else (~back, back):
            x = self._repeat(k * rows, rows is back, x)
        return self.project(x if inverse else self._remainder(r, back, x))

    # the time as a coordinate -------------------------------------------------------------------------

    def lift(self, x: Tensor, t0: Any = None, passed: Any = 0.0) -> Tensor:
        """The states that the maps take: of a driven system (..., 2d) at the time t0 + passed to [q, t, p], else x.

        Raises
        ------
        TypeError, ValueError
            If a driven system's t0 is missing, no finite number, or of another shape than the batch.
        """
        if not self.driven:
            return x
        time = start_time(t0, x, self.period)
        time = (time + torch.as_tensor(passed, dtype=torch.float64, device=x.device)).to(x.dtype)
        batch = torch.broadcast_shapes(x.shape[:-1], time.shape)
        x, time = x.expand(*batch, x.shape[-1]), time.expand(batch)
        return torch.cat([x[..., : self.ndof], time[..., None], x[..., self.ndof :]], dim=-1)

    def project(self, z: Tensor) -> Tensor:
        """The states [q, p] of those that the maps take."""
        return torch.cat([z[..., : self.ndof], z[..., self.ndof + 1 :]], dim=-1) if self.driven else z

    def on_extended(self, extended: HamiltonianSystem) -> Self | None:
        """Return the same maps of a driven system with one more coordinate, whose momentum is −∫ ∂H/∂t dt.

        None where the maps do not use the functions of a system.
        """
        return None

    def at_time(self, z: Tensor, time: Any) -> Tensor:
        """Replace the time in states of a driven system, by a number or (...)."""
        d = self.ndof
        time = torch.as_tensor(time, dtype=z.dtype, device=z.device).expand(z.shape[:-1])
        return torch.cat([z[..., :d], time[..., None], z[..., d + 1 :]], dim=-1)

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
        for j in range(int(to_values(k).max(initial=0))):
            x = _where(k > j, lambda t, y: self._psi(self.dt, y, back), k, x)
        return x

    def _remainder(self, r: Tensor, back: Tensor, x: Tensor) -> Tensor:
        moving = (r > 0) | differentiable(r)  # at r = 0 the state stays, but has a derivative
        x = _where(moving & ~back, self._psi, r, x)
        return _where(moving & back, partial(self._psi, back=True), r, x)

    def _psi(self, t: float | Tensor, z: Tensor, back: bool = False) -> Tensor:
        """ψ̄_t, or its inverse, of lifted states."""
        t, y, batch = self._columns(t, z)
        return self._states((self._map_inverse if back else self._map)(t, y), batch)

    # a run of many steps, of lifted states --------------------------------------------------------------------

    def prepare(self, t: float | Tensor, x: Tensor) -> Tensor:
        """χ_t⁻¹(x), unchecked, where ψ̄_t = χ_t ∘ K_t ∘ χ_t⁻¹: the start of a run of steps of t by `kernel_step`."""
        return x

    def kernel_step(self, t: float | Tensor, x: Tensor, back: bool = False) -> Tensor:
        """K_t(x), or its inverse, unchecked; K_t is ψ̄_t where there is no χ."""
        return self._psi(t, x, back)

    def finish(self, t: float | Tensor, x: Tensor) -> Tensor:
        """χ_t(x), unchecked: the output of such a run."""
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

    def tangents(self) -> NetworkTangents | None:
        """Return compiled derivatives of ψ̄_t and d/dt ψ̄_t by the parameters, for Gauss–Newton; None if it has none."""
        return None

    # its numbers -------------------------------------------------------------------------------------------

    def _number(self) -> Tensor:
        """One of its numbers."""
        return next(chain(self.parameters(), self.buffers()), NO_NUMBER)

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of its numbers; float64 if it has none."""
        return self._number().dtype

    @property
    def device(self) -> torch.device:
        """The device of its numbers; the CPU if it has none."""
        return self._number().device

    @property
    def n_parameters(self) -> int:
        """Number of trainable parameters."""
        return sum(w.numel() for w in self.parameters())

    def identity_parts(self) -> Any:
        """Return the description by which a store recognises it: the map alone, without its records."""
        return [self.kind, self.architecture(), self.dt, dict(self.state_dict())]

    # its system ---------------------------------------------------------------------------------------------

    @property
    def system(self) -> HamiltonianSystem | None:
        """The system whose functions the flow evaluates, or which was learned with it; None for other networks.

        None too for a flow that was loaded without its system, unless that was learned.
        """
        return self.learned

    def check_functions(self, system: HamiltonianSystem) -> None:
        check_system(system)

    def mean_system(self, **scene: Any) -> HamiltonianSystem:
        """Return the system of the flow's own Hamiltonian, the mean of 𝓗(ψ̄)(t, x) over t ∈ [0, Δt].

        Of a flow that was fitted to data without an H: its orbits are those of the flow to the order of what 𝓗 changes
        with t. It is evaluated by array operations.

        Parameters
        ----------
        **scene
            Of `HamiltonianSystem`: name, domain, y0, t_span, dt.
        """
        return HamiltonianSystem(hamiltonian=MeanHamiltonian(self), ndof=self.ndof, check=False, **scene)

    def take_learned(self, system: HamiltonianSystem | None = None) -> None:
        """Bind the system that was learned with the flow: as it was found, or as in the file of the flow."""
        told = self.recipe.get("learned")
        if system is None and told is not None and told.get("own_hamiltonian"):
            system = self.mean_system(name="learned", domain=self.domain, dt=self.dt)
        if system is None and told is not None and self.identity is not None and self.identity.expression is not None:
            name, scene = self.system_name or "learned", {key: told.get(key) for key in ("damping", "time", "period")}
            if told.get("drag") is None:
                system = HamiltonianSystem.from_sympy(self.identity.expression, name=name, domain=self.domain, **scene)
            else:
                physical = HamiltonianSystem.from_sympy(told["physical"], name=name, **scene)
                system = doubled(physical, told["drag"], name=name, domain=self.domain)
            self.check_system(system)
        if system is not None:
            self.learned = system
            self.bound(system)

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
        |H(ψ_kΔt(x)) − H(x)| ≤ kδ while the orbit is in Ω at every step; it also measures the error of orbits from
        held-out states. It is an estimate, not a proof: the suprema are the largest values in the sample.

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
        if not self.symplectic:
            raise TypeError(
                "`flow` is an unconstrained network, which has no Hamiltonian, so nothing bounds its energy "
                "error: use a SympFlow for a certificate."
            )
        counts = {"states": (states, 1), "times": (times, 2), "held_out": (held_out, 1), "seed": (seed, 0)}
        for name, (value, least) in counts.items():
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ValueError(f"`{name}` must be an integer and at least {least}; got {value!r}.")
        if not self.dt <= t_end < math.inf:
            raise ValueError(f"`t_end` must be finite and at least Δt = {self.dt:g}; got {t_end!r}.")
        self.check_system(system)
        domain = self.bound(system).domain_for(system)
        if domain is None:
            raise ValueError("`flow` has no domain and neither has its system: give the system a `domain`, say a Box.")
        size = {name: value for name, (value, _) in counts.items()}
        self.certified = certify(self, system, domain, checksum(self.state_dict()), size, t_end)
        return self.certified

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the flow to a safetensors file, atomically, with all that `sympflow.load` needs and its record.

        A flow without a system (one that was never trained) is recorded as such, and fits any when it is loaded.

        Raises
        ------
        TypeError
            If `path` is not a path.
        ValueError
            If a weight is not finite, the record is one that `load` would refuse, or the file cannot be written.

        Warns
        -----
        RuntimeWarning
            If the flow's certificate is one of other weights: it is left out.
        """
        write(path, self.kind, self.architecture(), self.dt, self.state_dict(), self.provenance)

    # arguments ----------------------------------------------------------------------------------------------

    def _checked_time(self, t: Any, x: Any) -> float | Tensor:
        """Return `t` as a finite float or tensor; `x` is checked to be a state for this flow."""
        if not isinstance(x, Tensor):
            raise TypeError(f"`x` must be a torch tensor, not {type(x).__name__}: use torch.as_tensor(x).")
        if x.dtype != self.dtype:
            raise TypeError(f"`x` is {x.dtype} but the flow is {self.dtype}: convert one, as by x.to({self.dtype}).")
        if x.device != self.device:
            raise ValueError(f"`x` is on {x.device} but the flow on {self.device}: move one, as by x.to(flow.device).")
        if x.ndim == 0 or x.shape[-1] != 2 * self.ndof:
            raise ValueError(
                f"`x` must have shape (..., {2 * self.ndof}), states [q, p]; got {tuple(x.shape)}: "
                "put them on the last axis."
            )
        if isinstance(t, Tensor) and (t.ndim or differentiable(t)):
            if t.device != x.device:
                raise ValueError(f"`t` is on {t.device} but `x` on {x.device}: move one of them.")
            _check_real("t", t, "remove its NaN and infinite entries")
            try:
                torch.broadcast_shapes(t.shape, x.shape[:-1])
            except RuntimeError:
                raise ValueError(
                    f"`t` of shape {tuple(t.shape)} does not broadcast against the batch shape "
                    f"{tuple(x.shape[:-1])} of `x`: add axes, as by t[:, None]."
                ) from None
            if t.ndim == x.ndim > 1 and t.shape == (*x.shape[:-1], 1) and len(t) > 1:
                raise ValueError(
                    f"`t` of shape {tuple(t.shape)} would take every state to the time of every other: pass t[..., 0], "
                    "one time for each state; or x[None], if all times of all states are meant."
                )
            return t
        try:
            value = float(t)
        except (TypeError, ValueError):
            raise TypeError(
                f"`t` must be a number or a tensor of times; got {type(t).__name__}: pass seconds."
            ) from None
        if not -math.inf < value < math.inf:
            raise ValueError(f"`t` must be finite; got {value}: pass a finite time.")
        return value

    def _bare_time(self, t: Any, x: Any) -> float | Tensor:
        """Return `t`, checked to lie in [0, Δt]."""
        t = self._checked_time(t, x)
        low, high, slack = 0.0, 0.0, 1e-14
        if isinstance(t, float):
            low = high = t
        elif t.numel() and (times := values(t)) is not None:
            low, high = float(times.min()), float(times.max())
            slack = 1e-6 if t.dtype == torch.float32 else slack
        if low < 0 or high > self.dt * (1 + slack):
            raise ValueError(f"`t` must lie in [0, dt] = [0, {self.dt:g}]; got {low} to {high}: reduce it modulo dt.")
        return t.to(x.dtype) if isinstance(t, Tensor) else t

    def card(self) -> Card:
        told = {name.replace("_", " "): value for name, value in self.figures.items() if isinstance(value, int | float)}
        facts = {
            "Δt": f"{self.dt:g}",
            "degrees of freedom": f"{self.ndof:,}",
            "parameters": f"{self.n_parameters:,}",
            "domain": "" if self.domain is None else brief(repr(self.domain)),
            **{name: f"{value:.3g}" for name, value in told.items()},
        }
        certificate = "" if self.certified is None else str(self.certified)
        return Card(repr(self).split(":")[0].strip("<>"), facts, certificate)

    def preview(self) -> Figure | None:
        return self._drawn(self.system, SHOWN_STEPS) if self.domain is not None or self.system is not None else None

    def plot(self, system: HamiltonianSystem | None = None, path: str | os.PathLike[str] | None = None) -> Figure:
        """Draw orbits of the flow from four states of its domain, and their energy error.

        With a `path` (.png, .pdf or .svg) the figure is saved too; matplotlib is needed.

        Parameters
        ----------
        system : HamiltonianSystem, optional
            The system that it was trained for; by default the one that it holds. The energy is left out if it has none.

        Raises
        ------
        ValueError
            If it has neither a domain nor a system with a `y0`.
        """
        return saved(self._drawn(self.system if system is None else system, DRAWN_STEPS), path)

    def _drawn(self, system: HamiltonianSystem | None, steps: int) -> Figure:
        """The figure of so many steps."""
        domain = self.domain if system is None else self.domain_for(system) or system.domain
        if domain is None and (system is None or system.y0 is None):
            raise ValueError("`system` is needed, because the flow has no domain to start in: pass one with a `y0`.")
        if isinstance(domain, EnergySublevel) and domain.hamiltonian is None:
            raise ValueError(
                "`system` is needed, whose H bounds the domain of the flow: pass it, or load the flow with it."
            )
        y0 = np.atleast_2d(system.y0) if domain is None else domain.sample(DRAWN, 0)  # type: ignore[union-attr]
        y = np.moveaxis(self._orbits(system, y0, steps), -2, -1)
        error = None
        if system is not None and system.keeps_energy:
            H = np.asarray(system.hamiltonian(np.moveaxis(y, -1, 0))).T
            error = (H - H[:, :1]) / (system.energy_scale or np.abs(H[:, :1]))
        heading = f"{repr(self).split(':')[0].strip('<>')}, Δt = {self.dt:g}"
        return trajectory_figure(self.dt * np.arange(y.shape[-1]), y, error, heading, marker=".")

    def _orbits(self, system: HamiltonianSystem | None, y0: np.ndarray, steps: int) -> np.ndarray:
        """The states (N, n, 2d) after steps from the states y0 (N, 2d), compiled where that is possible."""
        if system is not None:
            with suppress(NotCompiled):
                kernel = self.kernel_for(system)
                return kernel.run(self.dt, y0, steps, np.arange(steps + 1)).states
        states = [torch.as_tensor(y0, dtype=self.dtype, device=self.device)]
        with torch.no_grad():
            for k in range(steps):
                states.append(self(self.dt, states[-1], **({"t0": k * self.dt} if self.driven else {})))
        return to_numpy(torch.stack(states, dim=-2)).astype(float)

    def __repr__(self) -> str:
        system = f" of {self.system_name}" if self.system_name else ""
        return f"<{type(self).__name__}{system}: ndof={self.ndof}, dt={self.dt:g}, {self.n_parameters} parameters>"


def start_time(t0: Any, x: Tensor, period: float | None) -> Tensor:
    """Return the time of states x (..., 2d) of a driven system in float64; for float32 reduced by the period."""
    if t0 is None:
        raise TypeError("`t0` is missing, the time of `x`: the system of the flow is driven, as in flow(t, x, t0=0.0).")
    try:
        time = t0 if isinstance(t0, Tensor) else torch.as_tensor(np.array(t0))
        time = time.to(x.device)
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(f"`t0` must be a number or a tensor of times; got {t0!r}: pass seconds.") from None
    if time.ndim and not _fits(time.shape, x.shape[:-1]):
        raise ValueError(
            f"`t0` of shape {tuple(time.shape)} does not fit the batch shape {tuple(x.shape[:-1])} of `x`: give one "
            "time, or one for each state."
        )
    _check_real("t0", time, "pass the time of the states")
    time = time.double()
    if x.dtype == torch.float64:
        return time
    if period is None:
        raise TypeError(f"`x` is {x.dtype}, which rounds times too much: use float64, or give the system its `period`.")
    return time % period


def _check_real(name: str, times: Tensor, remedy: str) -> None:
    """Raise TypeError or ValueError unless times are real and finite."""
    if times.dtype == torch.bool or times.is_complex():
        raise TypeError(f"`{name}` must be real times; got {times.dtype}: use a floating-point tensor.")
    if has_values(times) and not finite_states(times[..., None].double()).all():
        raise ValueError(f"`{name}` must be finite: {remedy}.")


def _fits(shape: torch.Size, batch: torch.Size) -> bool:
    """Return True if an array broadcasts to a batch."""
    return len(shape) <= len(batch) and all(n in (1, m) for n, m in zip(shape[::-1], batch[::-1], strict=False))


def to_values(t: Tensor) -> np.ndarray:
    """Values of times, with those of all lanes of `torch.func.vmap`."""
    return values_of_times(t, "pass a number, or call psi(t, x), for t in [0, Δt]")


def _where(active: Tensor, step: Callable[[Tensor, Tensor], Tensor], t: Tensor, x: Tensor) -> Tensor:
    """step(t, x) where `active`, which is of the batch shape of x, and x elsewhere."""
    if not to_values(active).any():
        return x
    if active.ndim and readable(active) and readable(x):
        return x.index_put((active,), step(t[active], x[active]))
    return torch.where(active[..., None], step(t, x), x)  # under vmap each lane chooses its own


def whole_steps(t: float, dt: float) -> tuple[int, float]:
    """Return k = ⌊t/Δt⌋ and r = t − kΔt for t ≥ 0; a multiple of Δt up to rounding counts as one, 0.3/0.1 is 3."""
    ratio = t / dt
    if ratio > MAX_STEPS:
        raise _too_many_steps(t, dt)
    near = round(ratio)
    if abs(ratio - near) <= 2 * np.finfo(float).eps * near:
        return near, 0.0
    k = math.floor(ratio)
    return k, min(max(t - k * dt, 0.0), dt)


def whole_steps_of_each(t: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    """Return the same for a tensor of times t ≥ 0, each to the rounding of its dtype; gradients flow through r."""
    eps = torch.finfo(t.dtype).eps if t.is_floating_point() else 0.0
    t = t.to(torch.float64)
    ratio = t.detach() / dt
    near = ratio.round()
    exact = (ratio - near).abs() <= 2 * eps * near
    k = torch.where(exact, near, ratio.floor())
    if to_values(k).max(initial=0) > MAX_STEPS:
        raise _too_many_steps(float(to_values(t).max()), dt)
    r = t - k * dt
    return k.to(torch.int64), torch.where(exact, r - r.detach(), r).clamp(0.0, dt)


def _too_many_steps(t: float, dt: float) -> ValueError:
    return ValueError(f"`t` = {t:g} needs more than {MAX_STEPS:,} steps of dt = {dt:g}: use sympflow.solve.")
