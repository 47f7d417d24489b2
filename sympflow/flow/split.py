"""SympFlows of exact flows: of a system's linear part, and of the other parts of H with trained weights and filters.

    linear    Σ_f s_f(t) E_f(x), E_f the energy of the modes of frequency ω_f, turned by the exact flow
    kick      V(t, q) = w(t) U(A(t) q) − γ(t) ½|∇_q U(A(t) q)|²_{M⁻¹},  A(t) = C φ(t) C⁻¹ a filter of the normal modes
    shear     the same for a part H_k(q, p) of which no two variables are conjugate, without γ

in the notation of `sympflow.linear_part` and `sympflow.parts`; s, w, γ and φ are even polynomials in t, times t, t,
t³ and 1. The impulse method (φ = 1), the mollified impulse (φ = sinc) and Nyström splittings with the exact linear flow
are the untrained cases. Frozen at any t the flow is a list of maps, and runs in the compiled loops of these methods.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from sympflow.arrays import jvp
from sympflow.flow.base import FlowMap
from sympflow.flow.columns import Column
from sympflow.flow.contents import Contents
from sympflow.flow.placement import checked_device, checked_dtype
from sympflow.flow.potentials import Time
from sympflow.flow.split_layers import KeptMaps, PartsBinding, SplitLayer
from sympflow.flow.sympflow import SympFlow
from sympflow.hamiltonian.parts import LINEAR, ExactParts, Map, exact_parts

if TYPE_CHECKING:
    from sympflow.hamiltonian.system import HamiltonianSystem
    from sympflow.kernels.split_flow import SplitFlowKernel

FILTERED = ("oscillator", "hyperbolic")
"""The kinds of modes that filters act on; others pass."""


class SplitFlow(SympFlow):
    """A palindromic SympFlow of the exact flows of a system's parts; made by `SympFlow.split`.

    Time-reversible: continued to negative t by its formulas, ψ̄_{−t} = (ψ̄_t)⁻¹.

    Parameters
    ----------
    ndof : int
    sequence : sequence of int
        The part that each map is of, 0 for the linear one; it must read the same backwards.
    kinds : sequence of str
        Of the parts 1, 2, …: "kick" for a potential, else "shear".
    classes : sequence of str
        What the distinct frequencies are, see `LinearPart.kinds`.
    terms : int
        Basis functions of each coefficient.
    filters : bool
    gradients : sequence of int
        Which of the kicks carry a force gradient, counted from 0; the same from either end.
    dt : float
        Δt.
    expressions : sequence of str, optional
        The parts, where they are not those that are detected.
    system : HamiltonianSystem, optional
        Without it the flow has maps, but no values.
    dtype, device
        Of the parameters.

    Attributes
    ----------
    linear : ModuleList of Column
        s_f, for each frequency, of the linear maps.
    weights, filters, gradients : ModuleList of Column
        w, φ (for each frequency) and γ of the other parts, part by part.
    """

    def __init__(
        self,
        ndof: int,
        sequence: Sequence[int],
        kinds: Sequence[str],
        classes: Sequence[str],
        terms: int,
        filters: bool,
        gradients: Sequence[int],
        dt: float = 1.0,
        expressions: Sequence[str] | None = None,
        system: HamiltonianSystem | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        FlowMap.__init__(self, ndof, dt)
        self.sequence, self.kinds, self.classes = tuple(sequence), tuple(kinds), tuple(classes)
        if not self.sequence or self.sequence != self.sequence[::-1]:
            raise ValueError("`sequence` must read the same backwards: make it a palindrome.")
        if set(self.sequence) - set(range(len(self.kinds) + 1)):
            raise ValueError(f"`sequence` names parts beyond the {len(self.kinds)} there are: check `kinds`.")
        if isinstance(terms, bool) or not isinstance(terms, int) or terms < 1:
            raise ValueError(f"`terms` must be a positive integer; got {terms!r}.")
        self.terms, self.filtered, self.gradient_kicks = terms, bool(filters), tuple(sorted(set(gradients)))
        n_kicks = self.sequence.count(1)
        if self.gradient_kicks != tuple(sorted(n_kicks - 1 - i for i in self.gradient_kicks)):
            raise ValueError(f"`force_gradient` {gradients!r} is not the same from either end of {n_kicks} kicks.")
        if not set(self.gradient_kicks) <= set(range(n_kicks)) or (gradients and "shear" in self.kinds):
            raise ValueError(f"`force_gradient` {gradients!r} names no kicks: count them from 0 to {n_kicks - 1}.")
        like: dict[str, Any] = {"dtype": checked_dtype(dtype), "device": checked_device(device)}

        def column(part: int, power: int, total: str | None) -> Column:
            n = self.sequence.count(part)
            return Column(n, terms, self.dt, power, total, **like)

        modules = torch.nn.ModuleList
        rest = [k for k in range(1, len(self.kinds) + 1) if k in self.sequence]
        turning = [f for f, kind in enumerate(self.classes) if kind in FILTERED]
        linear = range(len(self.classes)) if LINEAR in self.sequence else ()
        self.linear = modules(column(LINEAR, 1, "always") for _ in linear)
        self.weights = modules(column(k, 1, "start") for k in rest)
        self.filters = modules(column(k, 0, None) for k in rest for _ in turning if filters)
        n_gradients = len(self.gradient_kicks)
        self.gradients = modules(Column(n_gradients, terms, self.dt, 3, **like) for _ in range(n_gradients > 0))
        self._slot = {k: i for i, k in enumerate(rest)}
        self._turning = turning
        for c in self.columns():  # equal steps, φ = 1
            if c.power < 3:
                c.set(np.eye(1, terms).repeat(c.n, 0) / (c.n if c.power else 1))
        self._binding = PartsBinding(system, expressions)
        self._known: tuple[bytes, KeptMaps] | None = None
        self._contents = Contents(column._parameters for column in self.columns())
        # A tuple, not a ModuleList: the layers own no parameters, they share the columns.
        self.layers = tuple(SplitLayer(self, i) for i in range(len(self.sequence)))  # type: ignore[assignment]
        if system is not None:
            self._check_parts(self._binding.parts)
            self.fingerprint, self.system_name = system.fingerprint, system.name

    def columns(self) -> list[Column]:
        """All coefficients: s, w, φ, γ."""
        groups = (self.linear, self.weights, self.filters, self.gradients)
        return [column for group in groups for column in group if isinstance(column, Column)]

    @property
    def dtype(self) -> torch.dtype:
        return self._contents.first().dtype

    @property
    def device(self) -> torch.device:
        return self._contents.first().device

    # the maps -----------------------------------------------------------------------------------------------

    def maps(self, t: Time) -> list[Map]:
        """ψ̄_t as maps of the parts, their entries tensors of the shape of t."""
        if isinstance(t, Tensor) and t.dtype != self.dtype:
            t = t.to(self.dtype)
        return self._assemble(lambda column: column.values(t), lambda entries: torch.stack(entries, dim=-1))

    def numpy_maps(self, t: np.ndarray) -> list[Map]:
        """The same of an array of times, for the compiled loops; for t < 0 the inverse of ψ̄_|t| (one sign for all)."""
        t = np.asarray(t, dtype=float)
        return self.frozen().maps(float(t)) if t.ndim == 0 else self._numpy_maps(t)

    def frozen(self) -> KeptMaps:
        """The maps of the numbers that the flow has now."""
        snapshot = self._contents.snapshot()
        if self._known is None or self._known[0] != snapshot:
            self._known = (
                snapshot,
                KeptMaps(self._numpy_maps, self._coefficient_maps(), self.dt, self._contents.first()),
            )
        return self._known[1]

    def _numpy_maps(self, t: np.ndarray) -> list[Map]:
        maps = self._assemble(
            lambda column: np.moveaxis(column.at(np.abs(t)), -1, 0), lambda entries: np.stack(entries, axis=-1)
        )
        return [m.inverse() for m in reversed(maps)] if (t < 0).any() else maps

    def _coefficient_maps(self) -> list[Map]:
        """The maps with the coefficients of the columns, (K, …), in place of their values."""
        return self._assemble(
            lambda column: column.table.detach().cpu().double().numpy(),
            lambda entries: np.stack(entries, axis=-1),
            np.eye(1, self.terms)[0],
        )

    def _assemble(self, values: Any, stack: Any, unity: Any = None) -> list[Map]:
        linear = [values(column) for column in self.linear]
        weights, filters, gradients = (
            [values(c) for c in group] for group in (self.weights, self.filters, self.gradients)
        )
        seen: dict[int, int] = {}
        maps = []
        for part in self.sequence:
            i = seen[part] = seen.get(part, -1) + 1
            if part == LINEAR:
                maps.append(Map(LINEAR, stack([column[i] for column in linear])))
                continue
            slot = self._slot[part]
            phi = None
            if filters:
                n, one = len(self._turning), 1 + 0 * weights[slot][i] if unity is None else unity
                own = dict(zip(self._turning, filters[slot * n : (slot + 1) * n], strict=True))
                phi = stack([own[f][i] if f in own else one for f in range(len(self.classes))])
            gradient = gradients[0][self.gradient_kicks.index(i)] if i in self.gradient_kicks else 0.0
            maps.append(Map(part, weights[slot][i], gradient, phi))
        return maps

    def _map(self, t: float | Tensor, y: Tensor) -> Tensor:
        return self._run(self.maps(t), y)

    def _map_inverse(self, t: float | Tensor, y: Tensor) -> Tensor:
        return self._run([m.inverse() for m in reversed(self.maps(t))], y)

    def _map_tangent(self, t: float | Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        return jvp(lambda s: self._map(t + s, y), y.new_zeros(()), y.new_ones(()))

    def _run(self, maps: Sequence[Map], y: Tensor) -> Tensor:
        parts = self.parts
        return parts.from_modes(*parts.apply(maps, *parts.to_modes(y.T))).T

    def kernel_for(self, system: HamiltonianSystem) -> SplitFlowKernel:
        """The compiled loops of this flow, the same while no number of it changes."""
        flow = self.bound(system)
        frozen = flow.frozen()
        if frozen.kernel is None or frozen.kernel.parts is not flow.parts:
            from sympflow.kernels.split_flow import SplitFlowKernel

            frozen.kernel = SplitFlowKernel(flow)
        return frozen.kernel

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        """Evaluations of the slopes of parts, and of force gradients, as `FixedStep.evaluations`."""
        return self.frozen().evaluations(n_steps, n_saved, n_extra, backend)

    # its system ---------------------------------------------------------------------------------------------

    @property
    def parts(self) -> ExactParts:
        return self._binding.parts

    @property
    def system(self) -> HamiltonianSystem | None:
        """The system whose parts the flow uses, None for one loaded without it."""
        return self._binding.system

    def bind(self, system: HamiltonianSystem) -> SplitFlow:
        """Give a flow that was loaded from a file the parts of its system; itself.

        Raises
        ------
        ValueError
            If it is not the system that the flow was made for.
        """
        self.check_system(system)
        parts = exact_parts(system, self._binding.expressions)
        self._check_parts(parts)
        self._binding.bind(system, parts)
        return self

    def bound(self, system: HamiltonianSystem) -> SplitFlow:
        """This flow, bound to `system` if it was loaded without one."""
        return self if self._binding.system is not None else self.bind(system)

    def _check_parts(self, parts: ExactParts) -> None:
        if part_kinds(parts) != self.kinds or class_kinds(parts) != self.classes:
            raise ValueError(
                f"`system` has the parts {part_kinds(parts)} and frequencies {class_kinds(parts)}, but the flow is for "
                f" {self.kinds} and {self.classes}: pass the system of the flow."
            )
        if self.filtered:
            for k in self._slot:
                parts.check_filters(k)
        if self.gradient_kicks and not parts.has_force_gradient:
            raise ValueError("`force_gradient` needs H = ½ pᵀM⁻¹p + ½ qᵀKq + U(q): leave it out.")

    def architecture(self) -> dict[str, Any]:
        expressions = self._binding.expressions
        return {
            "ndof": self.ndof,
            "split": {
                "sequence": list(self.sequence),
                "kinds": list(self.kinds),
                "classes": list(self.classes),
                "terms": self.terms,
                "filters": self.filtered,
                "gradients": list(self.gradient_kicks),
                "expressions": None if expressions is None else list(expressions),
            },
        }


def part_kinds(parts: ExactParts) -> tuple[str, ...]:
    """ "kick" for a potential, else "shear", of the parts 1, 2, …"""
    return tuple("kick" if part.of_positions else "shear" for part in parts.rest)


def class_kinds(parts: ExactParts) -> tuple[str, ...]:
    """What each of the distinct frequencies is."""
    if parts.linear is None:
        return ()
    return tuple(parts.linear.kinds[j] for j in parts.linear.representatives)
