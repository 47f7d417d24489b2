"""The tables of numbers that a primed flow is at a fixed t, kept while no number of the flow changes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch

from sympflow.flow.coefficients import Coefficients, Entry
from sympflow.flow.contents import Contents
from sympflow.hamiltonian.monomials import Monomials
from sympflow.schemes import CURVATURE, POLYNOMIAL, Scheme, scheme_evaluations

if TYPE_CHECKING:
    from sympflow.kernels.primed_flow import PrimedFlowKernel

Kind = Literal["kick", "drift"]

MOST_KEPT = 256  # a flow with a processor has five for each step length


@dataclass(frozen=True)
class Substep:
    """A kick or a drift of the flow: its coefficient.

    And for a kick those of the other terms: force gradient, curvature; or of each monomial of a polynomial.
    """

    kind: Kind
    weight: Entry
    more: tuple[Entry, ...] = ()

    @property
    def entries(self) -> tuple[Entry, ...]:
        return self.weight, *self.more


class Tables:
    """The numbers of kicks and drifts of ψ̄_t, K_t and χ_t: at one t as a `Scheme`, at all t as polynomials.

    Parameters
    ----------
    substeps : sequence of Substep
        χ⁻¹, K, χ, with the numbers that they have now.
    outer : int
        How many of them χ has.
    dt : float
        Δt.
    monomials
        Of the polynomials of kicks, where they have them.
    """

    kernel: PrimedFlowKernel | None = None
    """The compiled loops that were made of these last."""

    def __init__(self, substeps: Sequence[Substep], outer: int, dt: float, monomials: Monomials = ()) -> None:
        last = len(substeps) - outer
        self._parts = {"primed": substeps, "primed kernel": substeps[outer:last], "primed processor": substeps[last:]}
        self.dt, self.processed = dt, outer > 0
        self.monomials = monomials
        self.level = POLYNOMIAL if monomials else max(len(s.more) for s in substeps)
        numbers = [c.table for c in columns_of(substeps)]
        self.compilable = all(c.dtype == torch.float64 and c.device.type == "cpu" for c in numbers)
        exponents = columns_of(substeps)[0].exponents
        self._coefficients = {id(c): c.table.detach().cpu().double().numpy() for c in columns_of(substeps)}
        self._exponents = np.array(exponents, dtype=float)
        self._even = exponents[1:2] != (1,)
        self._kept: dict[Any, Any] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "kernel"}

    def kept(self, key: Any, make: Callable[[], Any]) -> Any:
        """What `make` gives, made once for each key."""
        if key not in self._kept:
            if len(self._kept) > MOST_KEPT:
                self._kept.clear()
            self._kept[key] = make()
        return self._kept[key]

    def scheme(self, part: str, t: float | None, back: bool = False) -> Scheme:
        """The part at t ∈ (0, Δt], the default Δt; `back` its inverse."""

        def make() -> Scheme:
            return self.scheme(part, t).inverse() if back else self._frozen(part, t)

        return self.kept((part, t, back), make)

    def polynomials(self, back: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Kicks, drifts, gradients and curvatures (m, K) of the stages of ψ̄_t, or of its inverse.

        They are divided by t, t, t³ and t⁵. They multiply the powers 0 … K−1 of `variable`; K is at least 3, by zeros
        if need be. In place of curvatures there may be polynomials (m, M, K), divided by t³.
        """

        def make() -> tuple[np.ndarray, ...]:
            parts, sign = self._parts["primed"], -1 if back else 1
            substeps = reversed(parts) if back else parts
            stages = self._stages((s.kind, _numbers(s, self._coefficients, sign)) for s in substeps)
            numbers = np.array(stages, dtype=float)  # (m, columns, K)
            numbers = np.pad(numbers, ((0, 0), (0, 0), (0, max(0, 3 - numbers.shape[2]))))
            kicks, gradients, drifts = numbers[:, 0], numbers[:, 1], numbers[:, -1]
            more = numbers[:, 3:-1] if self.monomials else numbers[:, 2]
            return tuple(np.ascontiguousarray(c) for c in (kicks, drifts, gradients, more))

        return self.kept(("polynomials", back), make)

    def variable(self, t: np.ndarray) -> np.ndarray:
        """t/Δt, or its square where all polynomials are even.

        Raises
        ------
        ValueError
            If a t lies beyond Δt.
        """
        tau = t / self.dt
        if not (tau <= 1 + 1e-12).all():
            raise ValueError(f"`t` must lie in (0, dt] = (0, {self.dt:g}]; got {t.max():g}.")
        return tau * tau if self._even else tau

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        """Forces, force gradients and curvature terms of a run, as `FixedStep.evaluations`."""

        def make() -> dict[str, int]:
            counts = [scheme_evaluations(self.scheme("primed kernel", None), n_steps, n_saved, 0, backend)]
            if n_extra:
                counts.append(scheme_evaluations(self.scheme("primed", None), 0, 0, n_extra, backend))
            if self.processed:  # once at the start, and for each output
                n = n_saved + (n_steps > 0)
                counts.append(scheme_evaluations(self.scheme("primed processor", None), 0, 0, n, backend))
            return {name: sum(count[name] for count in counts) for name in counts[0]}

        return dict(self.kept((n_steps, n_saved, n_extra, backend), make))

    def _frozen(self, part: str, t: float | None) -> Scheme:
        t = self.dt if t is None else float(t)
        if not 0 < t <= self.dt * (1 + 1e-12):
            raise ValueError(
                f"`t` must lie in (0, dt] = (0, {self.dt:g}]; got {t!r}: longer times are several steps, of at most dt."
            )
        powers = (t / self.dt) ** self._exponents
        values = {column: table @ powers for column, table in self._coefficients.items()}
        stages = self._stages((s.kind, _numbers(s, values, 1)) for s in self._parts[part])
        columns = [tuple(map(float, column)) for column in zip(*stages, strict=True)]
        kicks, gradients, curvatures, drifts = *columns[:3], columns[-1]
        source = f"a primed SympFlow, Δt = {self.dt:g}, frozen at t = {t:g}"
        more: dict[str, Any] = {"curvatures": curvatures} if self.level == CURVATURE else {}
        if self.monomials:
            more = {"polynomials": tuple(zip(*columns[3:-1], strict=True)), "monomials": self.monomials}
        return Scheme(part, None, kicks, drifts, gradients, source, self.level > 0, **more)

    def _stages(self, substeps: Iterable[tuple[Kind, list[Any]]]) -> list[list[Any]]:
        """[kick, gradient, curvature, polynomial …, drift] of the stages, neighbours of one kind merged."""
        stages: list[list[Any]] = []
        before = "drift"
        width = 3 + len(self.monomials)
        for kind, numbers in substeps:
            zero = 0 * numbers[0]
            if kind == "drift" and stages:
                stages[-1][-1] = stages[-1][-1] + numbers[0]
            elif kind == "drift":
                stages.append([zero] * width + numbers)
            else:
                # Polynomials stand in place of force gradients and curvatures.
                kick = [numbers[0], *([zero] * 2 if self.monomials else []), *numbers[1:]]
                kick += [zero] * (width - len(kick))
                if before == "kick" and stages:
                    stages[-1][:-1] = [one + two for one, two in zip(stages[-1][:-1], kick, strict=True)]
                else:
                    stages.append([*kick, zero])
            before = kind
        return stages


class KeptTables:
    """The `Tables` of a flow, made anew when one of its numbers has changed."""

    def __init__(self, substeps: Sequence[Substep], outer: int, dt: float, monomials: Monomials) -> None:
        self._of = tuple(substeps), outer, dt, monomials
        self._contents = Contents(column._parameters for column in columns_of(substeps))
        self._known: tuple[bytes, Tables] | None = None

    def current(self) -> Tables:
        snapshot = self._contents.snapshot()
        if self._known is None or self._known[0] != snapshot:
            self._known = snapshot, Tables(*self._of)
        return self._known[1]


def columns_of(substeps: Sequence[Substep]) -> list[Coefficients]:
    """The distinct columns that the substeps take their numbers from."""
    entries = [entry for s in substeps for entry in s.entries]
    return list({id(entry.column): entry.column for entry in entries}.values())


def _numbers(s: Substep, values: dict[int, np.ndarray], sign: int) -> list[Any]:
    """The coefficients of a substep, out of those of the columns."""
    return [sign * e.sign * values[id(e.column)][e.row] for e in s.entries]
