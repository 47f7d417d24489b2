"""SympFlows of exact flows: of a system's linear part, and of the other parts of H with trained weights and filters.

    linear    Σ_f s_f(t) E_f(x), E_f the energy of the modes of frequency ω_f, turned by the exact flow
    kick      V(t, q) = w(t) U(A(t) q) − γ(t) ½|∇_q U(A(t) q)|²_{M⁻¹},  A(t) = C φ(t) C⁻¹ a filter of the normal modes
    shear     the same for a part H_k(q, p) without two conjugate variables, without γ

in the notation of `sympflow.linear_part` and `sympflow.parts`; s, w, γ and φ are even polynomials in t, times t, t,
t³ and 1. The impulse method (φ = 1), the mollified impulse (φ = sinc) and Nyström splittings with the exact linear flow
are the untrained cases. Frozen at any t the flow is a list of maps, and runs in the compiled loops of these methods.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor

from sympflow.arguments import check_counts, check_flag, plain
from sympflow.flow.coefficients import Column
from sympflow.flow.flow_map import check_system
from sympflow.flow.layers import OwnLayer
from sympflow.flow.potentials import Time, by_time
from sympflow.flow.records import MAX_DEGREE, MAX_LAYERS, MAX_PARAMETERS, Refused, checked_integer
from sympflow.flow.sympflow import SystemFlow
from sympflow.flow.tables import Memory, Total
from sympflow.flow.weights import Kept, doubles
from sympflow.hamiltonian.expression import Unreadable, read
from sympflow.hamiltonian.fingerprint import check_for_flows
from sympflow.hamiltonian.parts import LINEAR, ExactParts, SubFlow, exact_parts, map_evaluations
from sympflow.hamiltonian.system import HamiltonianSystem

if TYPE_CHECKING:  # a flow needs it only to be compiled
    from sympflow.flow.loops import SplitFlowKernel

MOST_KEPT = 64  # steps whose maps are kept
KINDS_OF_MODES = ("oscillator", "hyperbolic", "free", "idle")
FILTERED = ("oscillator", "hyperbolic")
"""The kinds of modes that filters act on; others pass."""


class KeptMaps(Memory):
    """The maps of fixed numbers, the same objects for the same step, and what they cost."""

    def __init__(self, make: Callable[[np.ndarray], list[SubFlow]], coefficients: list[SubFlow], dt: float) -> None:
        super().__init__(MOST_KEPT)
        self._make, self._dt = make, dt
        self._coefficients = coefficients, [m.inverse() for m in reversed(coefficients)]

    def maps(self, t: float) -> list[SubFlow]:
        return self.kept(t, lambda: self._make(np.array(t)))

    def coefficients(self, back: bool) -> list[SubFlow]:
        """Return the maps at all t, or those of the inverse: see `PartsKernel.step_by_coefficients`."""
        return self._coefficients[back]

    def evaluations(self, *run: Any) -> dict[str, int]:
        """Count slopes of parts, and force gradients, of a run: `FlowMap.evaluations`."""
        return dict(self.kept(run, lambda: map_evaluations(self.maps(self._dt), *run)))


class SplitLayer(OwnLayer):
    """The exact flow of a part of H, times functions of t; `index` is its place in the flow."""

    def __init__(self, flow: SplitFlow, index: int) -> None:
        super().__init__(flow)
        self.index = index

    def moved(self, t: Time, y: Tensor, back: bool) -> Tensor:
        m, parts = self.flow.maps(t)[self.index], self.flow.parts
        return parts.from_modes(*parts.apply([m.inverse() if back else m], *parts.to_modes(y)))

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

        return q, p, by_time(generator, q)[1]


class SplitFlow(SystemFlow):
    """A palindromic, time-reversible SympFlow of the exact flows of a system's parts; made by `SympFlow.split`.

    `sequence` names the part of each map, 0 for the linear one, and `classes` the kinds of the distinct frequencies.
    The columns are s_f of the linear maps in `linear`, and w, φ (for each frequency) and γ in `weights`, `filters` and
    `gradients`, part by part. Without a system the flow has maps, but no values.
    """

    PLAN = "split"
    MADE = "made of the parts of a system"

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
        super().__init__(ndof, dt, dtype, device)
        self.expressions = None if expressions is None else tuple(expressions)
        self.sequence, self.kinds, self.classes = tuple(sequence), tuple(kinds), tuple(classes)
        if not self.sequence or self.sequence != self.sequence[::-1]:
            raise ValueError("`sequence` must read the same backwards: make it a palindrome.")
        if set(self.sequence) - set(range(len(self.kinds) + 1)):
            raise ValueError(f"`sequence` names parts beyond the {len(self.kinds)} there are: check `kinds`.")
        check_counts(terms=terms)
        self.terms, self.filtered, self.gradient_kicks = terms, bool(filters), tuple(sorted(set(gradients)))
        n_kicks = self.sequence.count(1)
        if self.gradient_kicks != tuple(sorted(n_kicks - 1 - i for i in self.gradient_kicks)):
            raise ValueError(f"`force_gradient` {gradients!r} is not the same from either end of {n_kicks} kicks.")
        if not set(self.gradient_kicks) <= set(range(n_kicks)) or (gradients and "shear" in self.kinds):
            raise ValueError(f"`force_gradient` {gradients!r} names no kicks: count them from 0 to {n_kicks - 1}.")

        def column(n: int, power: int, total: Total = None) -> Column:
            return Column(n, range(terms), power, total=total, dt=self.dt, **self._like)

        modules = torch.nn.ModuleList
        rest = [k for k in range(1, len(self.kinds) + 1) if k in self.sequence]
        turning = [f for f, kind in enumerate(self.classes) if kind in FILTERED]
        linear = range(len(self.classes)) if LINEAR in self.sequence else ()
        count = self.sequence.count
        self.linear = modules(column(count(LINEAR), 1, "always") for _ in linear)
        self.weights = modules(column(count(k), 1, "start") for k in rest)
        self.filters = modules(column(count(k), 0) for k in rest for _ in turning if filters)
        self.gradients = modules(column(len(self.gradient_kicks), 3) for _ in range(bool(self.gradient_kicks)))
        self._slot = {k: i for i, k in enumerate(rest)}
        self._turning = turning
        for c in self.columns():  # equal steps, φ = 1
            if c.power < 3:
                c.set(np.eye(1, terms).repeat(c.n, 0) / (c.n if c.power else 1))
        self._maps: Kept[KeptMaps] = Kept(column._parameters for column in self.columns())
        # A tuple, not a ModuleList: the layers own no parameters, they share the columns.
        self.layers = tuple(SplitLayer(self, i) for i in range(len(self.sequence)))
        self._made_of(system)

    @classmethod
    def untrained(cls, system: HamiltonianSystem, *, parts: Sequence[str] | None, **given: Any) -> Self:
        """Return a flow of so many equal Strang steps: see `SympFlow.split`."""
        stages, terms, filters, force_gradient, linear_outside = (
            plain(given[name]) for name in ("stages", "terms", "filters", "force_gradient", "linear_outside")
        )
        like = {name: given[name] for name in ("dt", "dtype", "device")}
        check_system(system)
        check_for_flows(system)
        check_flag("filters", filters)
        check_flag("linear_outside", linear_outside)
        if isinstance(stages, bool) or not isinstance(stages, int) or not 1 <= stages <= 1000:
            raise ValueError(f"`stages` must be a positive integer, at most 1000; got {stages!r}: 4 is usual.")
        exact = exact_parts(system, parts)
        if force_gradient is None:
            force_gradient = exact.has_force_gradient
        order = exact.sequence
        if linear_outside and order[-1] == LINEAR:
            order = (LINEAR, *order[:-1])
        one = (*order, *order[-2::-1])
        sequence = one + (stages - 1) * one[1:]
        kicks: Sequence[int] = range(sequence.count(1)) if isinstance(force_gradient, bool) else force_gradient
        return cls(
            system.ndof,
            sequence,
            part_kinds(exact),
            class_kinds(exact),
            terms=terms,
            filters=filters,
            gradients=() if force_gradient is False else kicks,
            expressions=parts,
            system=system,
            **like,
        )

    def columns(self) -> list[Column]:
        """Return all coefficients: s, w, φ, γ."""
        groups = (self.linear, self.weights, self.filters, self.gradients)
        return [column for group in groups for column in group if isinstance(column, Column)]

    def _number(self) -> Tensor:
        return self._maps.first()

    # the maps -----------------------------------------------------------------------------------------------

    def maps(self, t: Time) -> list[SubFlow]:
        """ψ̄_t as maps of the parts, their entries tensors of the shape of t."""
        if isinstance(t, Tensor) and t.dtype != self.dtype:
            t = t.to(self.dtype)
        return self._assemble(lambda column: column.values(t), lambda entries: torch.stack(entries, dim=-1))

    def frozen(self) -> KeptMaps:
        """Return the maps of the numbers that the flow has now."""
        return self._maps.current(lambda: KeptMaps(self._numpy_maps, self._coefficient_maps(), self.dt))

    def _numpy_maps(self, t: np.ndarray) -> list[SubFlow]:
        """The `maps` of an array of times of one sign, for the compiled loops; for t < 0 of the inverse of ψ̄_|t|."""
        maps = self._assemble(
            lambda column: np.moveaxis(column.at(np.abs(t)), -1, 0), lambda entries: np.stack(entries, axis=-1)
        )
        return [m.inverse() for m in reversed(maps)] if (t < 0).any() else maps

    def _coefficient_maps(self) -> list[SubFlow]:
        """The maps with the coefficients of the columns, (K, …), in place of their values."""
        return self._assemble(
            lambda column: doubles(column.table), lambda entries: np.stack(entries, axis=-1), np.eye(1, self.terms)[0]
        )

    def _assemble(self, values: Any, stack: Any, unity: Any = None) -> list[SubFlow]:
        linear = [values(column) for column in self.linear]
        weights, filters, gradients = (
            [values(c) for c in group] for group in (self.weights, self.filters, self.gradients)
        )
        seen: dict[int, int] = {}
        maps = []
        for part in self.sequence:
            i = seen[part] = seen.get(part, -1) + 1
            if part == LINEAR:
                maps.append(SubFlow(LINEAR, stack([column[i] for column in linear])))
                continue
            slot = self._slot[part]
            phi = None
            if filters:
                n, one = len(self._turning), 1 + 0 * weights[slot][i] if unity is None else unity
                own = dict(zip(self._turning, filters[slot * n : (slot + 1) * n], strict=True))
                phi = stack([own[f][i] if f in own else one for f in range(len(self.classes))])
            gradient = gradients[0][self.gradient_kicks.index(i)] if i in self.gradient_kicks else 0.0
            maps.append(SubFlow(part, weights[slot][i], gradient, phi))
        return maps

    def _map(self, t: float | Tensor, y: Tensor) -> Tensor:
        return self._run(self.maps(t), y)

    def _map_inverse(self, t: float | Tensor, y: Tensor) -> Tensor:
        return self._run([m.inverse() for m in reversed(self.maps(t))], y)

    def _map_tangent(self, t: float | Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        return by_time(lambda s: self._map(t + s, y), y)

    def _run(self, maps: Sequence[SubFlow], y: Tensor) -> Tensor:
        parts = self.parts
        return parts.from_modes(*parts.apply(maps, *parts.to_modes(y.T))).T

    def _compiled_for(self, system: HamiltonianSystem, compensated: bool) -> SplitFlowKernel:
        from sympflow.flow.loops import SplitFlowKernel

        return SplitFlowKernel(self.frozen(), self.parts, self.dt)

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        return self.frozen().evaluations(n_steps, n_saved, n_extra, backend)

    # its system ---------------------------------------------------------------------------------------------

    @property
    def parts(self) -> ExactParts:
        return self._binding.parts

    def _take(self, system: HamiltonianSystem) -> None:
        parts = exact_parts(system, self.expressions)
        self._check_parts(parts)
        self._binding.bind(system, parts)

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

    def plan(self) -> dict[str, Any]:
        return {
            "sequence": list(self.sequence),
            "kinds": list(self.kinds),
            "classes": list(self.classes),
            "terms": self.terms,
            "filters": self.filtered,
            "gradients": list(self.gradient_kicks),
            "expressions": None if self.expressions is None else list(self.expressions),
        }

    @classmethod
    def checked_plan(cls, plan: dict[str, Any], ndof: int) -> dict[str, Any]:
        if not isinstance(plan.get("filters"), bool):
            raise Refused("its filters are neither true nor false")
        gradients = plan.get("gradients")
        if not isinstance(gradients, list) or not all(isinstance(i, int) and 0 <= i < MAX_LAYERS for i in gradients):
            raise Refused("its gradients are not a list of kicks")
        for name, admissible in (("kinds", ("kick", "shear")), ("classes", KINDS_OF_MODES)):
            value = plan.get(name)
            if not isinstance(value, list) or len(value) > MAX_LAYERS or not all(each in admissible for each in value):
                raise Refused(f"its {name} are not a list of {', '.join(admissible)}")
        sequence, expressions, n = plan.get("sequence"), plan.get("expressions"), len(plan["kinds"])
        if not isinstance(sequence, list) or not 1 <= len(sequence) <= MAX_LAYERS:
            raise Refused("its sequence of maps is missing or too long")
        if not all(isinstance(k, int) and not isinstance(k, bool) and 0 <= k <= n for k in sequence):
            raise Refused("its sequence of maps does not consist of numbers of parts")
        if expressions is not None:
            _check_expressions(expressions, n)
        terms = checked_integer(plan.get("terms"), "number of terms", MAX_DEGREE)
        if len(sequence) * terms * (len(plan["classes"]) + 2) > MAX_PARAMETERS // 100:
            raise Refused("its architecture is too large")
        names = ("sequence", "kinds", "classes", "terms", "filters", "gradients", "expressions")
        return {name: plan.get(name) for name in names}


def part_kinds(parts: ExactParts) -> tuple[str, ...]:
    """Return "kick" for a potential, else "shear", of the parts 1, 2, …"""
    return tuple("kick" if part.of_positions else "shear" for part in parts.rest)


def class_kinds(parts: ExactParts) -> tuple[str, ...]:
    """Return the kind of each of the distinct frequencies."""
    if parts.linear is None:
        return ()
    return tuple(parts.linear.kinds[j] for j in parts.linear.representatives)


def _check_expressions(expressions: Any, kinds: int) -> None:
    if not (isinstance(expressions, list) and all(isinstance(e, str) for e in expressions)):
        raise Refused("its parts are not a list of expressions")
    if len(expressions) > kinds + 1:
        raise Refused("it has more parts than kinds of them")
    try:
        for expression in expressions:
            read(expression)
    except Unreadable as error:
        raise Refused(f"its parts are not all expressions ({error})") from None
