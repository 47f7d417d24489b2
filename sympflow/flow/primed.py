"""Primed SympFlows: every potential is the system's own V or T times a trained function of t.

    kick    V_p(t, q) = t b(τ) V(q) − t³ γ(τ) ½|∇V(q)|²_{M⁻¹} + t⁵ c(τ) ½ v·∇²V(q) v,   v = M⁻¹∇V(q)
    drift   V_m(t, p) = t a(τ) T(p)                                                         τ = t/Δt

In place of the last two terms a kick may have a trained polynomial, t³ Σ_m e_m(τ) q^m.

Frozen at any t such a flow is a splitting scheme, kicks b, force gradients γ, curvatures c and drifts a in the
convention of `sympflow.schemes`: a SympFlow of this kind is a table of numbers that varies smoothly with t.

With a processor it is ψ̄_t = χ_t ∘ K_t ∘ χ_t⁻¹, the kernel K and the processor χ being such tables: over many steps
of Δt only K is executed, as the χ between two steps cancel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor, nn

from sympflow.arguments import check_flag, plain
from sympflow.arrays import to_numpy
from sympflow.flow.coefficients import Coefficients, Entry
from sympflow.flow.files import MAX_DEGREE, MAX_LAYERS, Refused, checked_integer
from sympflow.flow.flow_map import FlowMap, check_system
from sympflow.flow.layers import Drift, Kick
from sympflow.flow.potentials import Time
from sympflow.flow.primed_potentials import (
    CURVATURE,
    FORCE_GRADIENT,
    POTENTIAL,
    Binding,
    PolynomialTerm,
    PrimedDrift,
    PrimedPotential,
    Sum,
    Term,
)
from sympflow.flow.sympflow import SympFlow
from sympflow.flow.weights import Kept, check_compilable, checked_device, checked_dtype
from sympflow.hamiltonian.domain import states_of
from sympflow.hamiltonian.fingerprint import check_for_flows
from sympflow.hamiltonian.local_states import DRAWN, LocalStates
from sympflow.hamiltonian.monomials import MOST_MONOMIALS, Monomials, monomials
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.schemes import CURVATURE as CURVATURE_LEVEL
from sympflow.schemes import POLYNOMIAL as POLYNOMIAL_LEVEL
from sympflow.schemes import SCHEMES, Scheme, compose, scheme_evaluations, scheme_named

if TYPE_CHECKING:  # Numba and SymPy, which a flow needs only to be compiled
    from sympflow.hamiltonian.local import LocalHamiltonian
    from sympflow.kernels.flow_loops import PrimedFlowKernel
    from sympflow.kernels.stages import StageTable

Kind = Literal["kick", "drift"]

WORSE = 2.0
"""Times the energy error of a ring that a lattice with ends may have for the numbers of a flow to hold there."""
MOST_KEPT = 256  # a flow with a processor has five for each step length


@dataclass(frozen=True)
class PrimedShape:
    """The architecture of a primed flow.

    Parameters
    ----------
    first : {"kick", "drift"}
        The map that comes first, in the kernel and in the processor.
    maps : int
        How many kicks and drifts the kernel has.
    degree : int
        Degree in t of t b(t/Δt) and t a(t/Δt).
    palindromic, force_gradient : bool
    processor : int
        Number C of pairs of χ, 2C + 1 maps; 0 for none.
    curvature : bool
        True if kicks with force gradients have curvature terms too, for symbolic systems and lattices.
    monomials : tuple of tuple of int
        The exponents m of polynomials that stand in place of both, for symbolic systems; none for none.
    timed : bool
        True if the drifts of the kernel add up to t at every t, as they must with friction, with an exact e^{−γt},
        and in a driven system, in which the time moves with them.
    gradient_kicks : tuple of int, optional
        The kicks of the kernel, counted from 0, that have force gradients, where others have none.
    curvature_kicks : tuple of int, optional
        Those of them that have curvature terms, where others have none.

    Raises
    ------
    ValueError
        If there is no such flow.
    """

    first: Kind
    maps: int
    degree: int
    palindromic: bool
    force_gradient: bool
    processor: int = 0
    curvature: bool = False
    monomials: Monomials = ()
    timed: bool = False
    gradient_kicks: tuple[int, ...] | None = None
    curvature_kicks: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        maps, degree, processor = self.maps, self.degree, self.processor
        for name, value, least in (("maps", maps, 1), ("degree", degree, 1), ("processor", processor, 0)):
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                kind = "positive" if least else "non-negative"
                remedy = "give 1 or more" if least else "0 is for none"
                raise ValueError(f"`{name}` must be a {kind} integer; got {value!r}: {remedy}.")
        if maps < 2 or (self.palindromic and maps % 2 == 0):
            raise ValueError(f"`maps` must be at least 2, and odd for a palindrome; got {maps}: add a kick or a drift.")
        if processor and degree < 2:
            raise ValueError(
                f"`degree` must be at least 2 with a processor, whose lowest power of t is t²; got {degree}."
            )
        if self.curvature and not self.force_gradient:
            raise ValueError("`curvature` goes with force gradients: leave it out.")
        if self.monomials and self.force_gradient:
            raise ValueError("`monomials` stand in place of force gradients: leave these out.")
        if self.gradient_kicks is not None:
            self._check_kicks("force_gradient", self.gradient_kicks, self.force_gradient)
        if self.curvature_kicks is not None:
            self._check_kicks("curvature", self.curvature_kicks, self.curvature)
            if self.gradient_kicks is not None and not set(self.curvature_kicks) <= set(self.gradient_kicks):
                raise ValueError(
                    f"`curvature` {self.curvature_kicks!r} names kicks without force gradients: name some of "
                    f"{self.gradient_kicks!r}."
                )

    def _check_kicks(self, name: str, kicks: tuple[int, ...], has: bool) -> None:
        n = self.kernel.count("kick")
        if not kicks or not has or list(kicks) != sorted(set(kicks) & set(range(n))):
            raise ValueError(
                f"`{name}` {kicks!r} does not name kicks from 0 to {n - 1}, each once and in order: name some, "
                "or take True for all, False for none."
            )
        if self.palindromic and kicks != tuple(n - 1 - i for i in reversed(kicks)):
            raise ValueError(
                f"`{name}` {kicks!r} is not the same from either end of {n} kicks: name their mirror images "
                "too, or take palindromic=False."
            )

    @property
    def kernel(self) -> tuple[Kind, ...]:
        """The kinds of the maps of K."""
        return _alternating(self.first, self.maps)

    @property
    def outer(self) -> tuple[Kind, ...]:
        """The kinds of the maps of χ."""
        return _alternating(self.first, 2 * self.processor + 1 if self.processor else 0)

    def columns(self, sequence: Sequence[Kind], dt: float, total: float | None, **like: Any) -> Columns:
        """Return untrained columns of the numbers of K, whose kicks and drifts have a `total` of 1, or of χ."""
        if not sequence:
            return Columns()
        powers, mirrored = range(0, self.degree, 2 if self.palindromic else 1), self.palindromic and total is not None

        def column(kind: Kind, power: int, total: float | None = None, **more: Any) -> Coefficients:
            return Coefficients(sequence.count(kind), tuple(powers), dt, power, mirrored, total, **more, **like)

        having, curved = (None, None) if total is None else (self.gradient_kicks, self.curvature_kicks)
        curved = having if curved is None else curved

        return Columns(
            column("kick", 1, total),
            column("drift", 1, total, always=self.timed and total is not None),
            column("kick", 3, present=having) if self.force_gradient else None,
            column("kick", 5, present=curved) if self.curvature else None,
            nn.ModuleList(column("kick", 3) for _ in self.monomials) if self.monomials else None,
        )

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return {
            "first": self.first,
            "maps": self.maps,
            "degree": self.degree,
            "palindromic": self.palindromic,
            "force_gradient": self.force_gradient,
            "processor": self.processor,
            "curvature": self.curvature,
            **({"monomials": [list(m) for m in self.monomials]} if self.monomials else {}),
            **({"timed": True} if self.timed else {}),
            **({} if self.gradient_kicks is None else {"gradient_kicks": list(self.gradient_kicks)}),
            **({} if self.curvature_kicks is None else {"curvature_kicks": list(self.curvature_kicks)}),
        }

    @classmethod
    def from_dict(cls, plan: Any, ndof: int) -> Self:
        """Return the shape that a file describes, all of which is checked.

        Raises
        ------
        Refused, ValueError
        """
        if not isinstance(plan, dict) or plan.get("first") not in ("kick", "drift"):
            raise Refused("its plan of a primed flow is missing")
        flags: dict[str, Any] = {name: plan.get(name) for name in ("palindromic", "force_gradient")}
        flags |= {name: plan.get(name, False) for name in ("curvature", "timed")}
        for name, value in flags.items():
            if not isinstance(value, bool):
                raise Refused(f"its {name} is neither true nor false")
        maps = checked_integer(plan.get("maps"), "number of maps", MAX_LAYERS)
        degree = checked_integer(plan.get("degree"), "degree", MAX_DEGREE)
        processor = plan.get("processor", 0)
        if processor != 0 or isinstance(processor, bool):
            processor = checked_integer(processor, "processor", MAX_LAYERS)
        flags |= {name: _checked_kicks(plan.get(name)) for name in ("gradient_kicks", "curvature_kicks")}
        exponents = _checked_monomials(plan.get("monomials", []), ndof)
        return cls(plan["first"], maps, degree, processor=processor, monomials=exponents, **flags)


def _alternating(first: Kind, n: int) -> tuple[Kind, ...]:
    """Return the kinds of n maps."""
    other: Kind = "drift" if first == "kick" else "kick"
    return tuple(first if i % 2 == 0 else other for i in range(n))


def _checked_kicks(plan: Any) -> tuple[int, ...] | None:
    if plan is None:
        return None
    if not isinstance(plan, list) or not all(isinstance(i, int) and not isinstance(i, bool) for i in plan):
        raise Refused("its kicks with force gradients or curvature terms are not a list of integers")
    return tuple(plan)


def _checked_monomials(plan: Any, ndof: int) -> Monomials:
    if not isinstance(plan, list) or len(plan) > MOST_MONOMIALS:
        raise Refused(f"its monomials are not a list of at most {MOST_MONOMIALS}")
    for m in plan:
        if not isinstance(m, list) or len(m) != ndof:
            raise Refused(f"its monomials do not have {ndof} exponents each")
        if not all(isinstance(e, int) and not isinstance(e, bool) and 0 <= e <= MAX_DEGREE for e in m):
            raise Refused(f"its monomials have exponents that are not integers from 0 to {MAX_DEGREE}")
    exponents = tuple(tuple(m) for m in plan)
    if len(set(exponents)) < len(exponents) or (0,) * ndof in exponents:
        raise Refused("its monomials are not different ones that vary with q")
    return exponents


class Columns(NamedTuple):
    """The columns of a sequence of maps; all None if it is empty."""

    kicks: Any = None
    drifts: Any = None
    gradients: Any = None
    curvatures: Any = None
    polynomials: Any = None


@dataclass(frozen=True)
class Substep:
    """A kick or a drift of the flow: its coefficient, and those of a kick's other terms.

    These are a force gradient and a curvature, or one for each monomial of a polynomial.
    """

    kind: Kind
    weight: Entry
    more: tuple[Entry, ...] = ()

    @property
    def entries(self) -> tuple[Entry, ...]:
        return self.weight, *self.more


def substeps_of(sequence: Sequence[Kind], columns: Columns, sign: int) -> list[Substep]:
    """Return the maps of a sequence, with their places in the columns."""
    kicks, drifts, gradients, curvatures, polynomials = columns
    more = [c for c in (gradients, curvatures) if c is not None] if polynomials is None else polynomials
    made = []
    for i, kind in enumerate(sequence):
        one, *others = [kicks, *more] if kind == "kick" else [drifts]
        made.append(Substep(kind, Entry(one, i // 2, sign), tuple(Entry(c, i // 2, sign) for c in others)))
    return made


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

    def __init__(self, substeps: Sequence[Substep], outer: int, dt: float, monomials: Monomials = ()) -> None:
        last = len(substeps) - outer
        self._parts = {"primed": substeps, "primed kernel": substeps[outer:last], "primed processor": substeps[last:]}
        self.dt, self.processed = dt, outer > 0
        self.kernel: PrimedFlowKernel | None = None  # the compiled loops that were made of these last
        self.carried: Any = None  # the flow of another shape of a lattice that was made of these last
        self.monomials = monomials
        self.level = POLYNOMIAL_LEVEL if monomials else max(len(s.more) for s in substeps)
        numbers = [c.table for c in columns_of(substeps)]
        self.placements = {(c.dtype, c.device) for c in numbers}
        exponents = columns_of(substeps)[0].exponents
        self._coefficients = {id(c): to_numpy(c.table).astype(float) for c in columns_of(substeps)}
        self._exponents = np.array(exponents, dtype=float)
        self._even = exponents[1:2] != (1,)
        self._kept: dict[Any, Any] = {}

    def kept(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return what `make` gives, made once for each key."""
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

    def polynomials(self, back: bool) -> StageTable:
        """The stages of ψ̄_t or of its inverse for all t, as coefficients of polynomials (m, K).

        Kicks and drifts are divided by t, gradients and polynomials in q by t³, curvatures by t⁵. They multiply the
        powers 0 … K−1 of `variable`; K is at least 3, by zeros if need be.
        """

        from sympflow.kernels.stages import StageTable

        def make() -> StageTable:
            parts, sign = self._parts["primed"], -1 if back else 1
            substeps = reversed(parts) if back else parts
            stages = self._stages((s.kind, _numbers(s, self._coefficients, sign)) for s in substeps)
            numbers = np.array(stages, dtype=float)  # (m, columns, K)
            numbers = np.pad(numbers, ((0, 0), (0, 0), (0, max(0, 3 - numbers.shape[2]))))
            kicks, gradients, curvatures = (numbers[:, i] for i in range(3))
            return StageTable(self.level, kicks, numbers[:, -1], gradients, curvatures, numbers[:, 3:-1])

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
        """Count forces, force gradients and curvature terms of a run: `FlowMap.evaluations`."""

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
        more: dict[str, Any] = {"curvatures": curvatures} if self.level == CURVATURE_LEVEL else {}
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


def columns_of(substeps: Sequence[Substep]) -> list[Coefficients]:
    """Return the distinct columns that the substeps take their numbers from."""
    entries = [entry for s in substeps for entry in s.entries]
    return list({id(entry.column): entry.column for entry in entries}.values())


def _numbers(s: Substep, values: dict[int, np.ndarray], sign: int) -> list[Any]:
    """Return the coefficients of a substep, out of those of the columns."""
    return [sign * e.sign * values[id(e.column)][e.row] for e in s.entries]


class PrimedFlow(SympFlow):
    """A SympFlow of kicks and drifts, in turn, that are primed with V and T; made by `SympFlow.primed`.

    A palindromic one has even polynomials b, γ, c, a, and its kernel reads the same backwards, which makes K
    time-reversible: continued to negative t by its formulas, K_{−t} = K_t⁻¹. With a processor ψ̄ is conjugate to it.

    Parameters
    ----------
    ndof : int
    shape : PrimedShape
    dt : float
        Δt.
    system : HamiltonianSystem, optional
        Without it the flow has a `scheme`, but no values.
    dtype, device
        Of the parameters.

    Attributes
    ----------
    kicks, drifts : Coefficients
        b and a of the kernel.
    gradients, curvatures : Coefficients or None
        γ and c, one for each kick.
    polynomials : ModuleList of Coefficients, or None
        e_m, one column for each monomial.
    processor_kicks, processor_drifts, processor_gradients, processor_curvatures, processor_polynomials
        Those of χ, or None.
    substeps : tuple of Substep
        The maps in the order in which they are executed: χ⁻¹, K, χ.
    """

    takes_friction = takes_driving = True

    def __init__(
        self,
        ndof: int,
        shape: PrimedShape,
        dt: float = 1.0,
        system: HamiltonianSystem | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        FlowMap.__init__(self, ndof, dt)
        self.shape = shape
        like: dict[str, Any] = {"dtype": checked_dtype(dtype), "device": checked_device(device)}
        inside = shape.columns(shape.kernel, self.dt, 1.0, **like)
        outside = shape.columns(shape.outer, self.dt, None, **like)
        self.kicks, self.drifts, self.gradients, self.curvatures, self.polynomials = inside
        self.processor_kicks, self.processor_drifts, self.processor_gradients = outside[:3]
        self.processor_curvatures, self.processor_polynomials = outside[3:]
        inner = substeps_of(shape.kernel, inside, 1)
        outer = {sign: substeps_of(shape.outer, outside, sign) for sign in (1, -1)}
        self.substeps: tuple[Substep, ...] = (*reversed(outer[-1]), *inner, *outer[1])
        self._tables: Kept[Tables] = Kept(column._parameters for column in columns_of(self.substeps))
        self._binding = Binding(system)
        # A tuple, not a ModuleList: the layers own no parameters, they share the columns.
        self.layers = tuple(map(self._layer, range(len(self.substeps))))  # type: ignore[assignment]
        if system is not None:
            self.identify(system)

    @classmethod
    def untrained(
        cls,
        system: HamiltonianSystem,
        *,
        stages: int | None,
        dt: float,
        palindromic: bool,
        scheme: Scheme | str | None,
        degree: int | None,
        force_gradient: bool | Sequence[int] | None,
        processor: int,
        curvature: bool | Sequence[int],
        polynomial: int | None,
        first: str,
        dtype: torch.dtype,
        device: torch.device | str | None,
    ) -> Self:
        """Return a flow that is, at every t, equal leapfrog steps or the given scheme: see `SympFlow.primed`."""
        stages, palindromic, scheme, degree = map(plain, (stages, palindromic, scheme, degree))
        processor, polynomial = map(plain, (processor, polynomial))
        some = None
        if force_gradient is not None:
            force_gradient, some = _kicks_of("force_gradient", force_gradient)
        curvature, curved = _kicks_of("curvature", curvature)
        check_system(system)
        check_for_flows(system, cls.takes_friction, cls.takes_driving)
        check_flag("palindromic", palindromic)
        if not system.separable:
            raise ValueError(f"`system` {system.name!r} is not separable, so it has no V and T: use SympFlow(ndof).")
        if system.kinetic_timed:
            raise ValueError(
                f"`system` {system.name!r} has a kinetic energy that depends on t, and flows are primed with V(q, t) "
                "alone: use a splitting method such as 'kahan_li8'."
            )
        if system.friction is not None and not system.quadratic_kinetic:
            raise ValueError(
                f"`system` {system.name!r} has friction, which drifts hold where the kinetic energy is ½ pᵀM⁻¹p: use a "
                "Runge–Kutta method such as 'dop853'."
            )
        exponents = _monomials_of(system, polynomial, force_gradient, curvature)
        force_gradient = _force_gradient_of(system, False if exponents else force_gradient, curvature)
        _check_counts(stages, processor)
        scheme = _starting_scheme(system, scheme, stages, first)
        if palindromic and not scheme.symmetric:
            raise ValueError(f"`scheme` {scheme.name!r} is not symmetric: take another, or palindromic=False.")
        if any(scheme.gradients) and exponents:
            raise ValueError(
                f"`polynomial` stands in place of force gradients, as {scheme.name!r} has them: take another."
            )
        if some is not None and any(s.three for i, s in enumerate(_kicks(scheme)) if i not in some):
            raise ValueError(
                f"`force_gradient` {some!r} leaves out kicks of {scheme.name!r} that have force gradients: name these "
                "too, or leave it out."
            )
        if any(scheme.gradients) and not force_gradient:
            raise ValueError(f"`force_gradient` is False but {scheme.name!r} has force gradients: leave it out.")
        substeps = scheme.substeps
        shape = PrimedShape(
            first="kick" if substeps[0].kind == "kick" else "drift",
            maps=len(substeps),
            degree=degree if degree is not None else 5 if processor else 7,
            palindromic=palindromic,
            force_gradient=force_gradient,
            processor=processor,
            curvature=curvature,
            monomials=exponents,
            timed=_is_timed(system),
            gradient_kicks=some,
            curvature_kicks=curved,
        )
        flow = cls(system.ndof, shape, dt, system, dtype, device)
        kicks, drifts = _kicks(scheme), [s for s in substeps if s.kind == "drift"]
        flow.kicks.set_constant([s.one for s in kicks])
        flow.drifts.set_constant([s.one for s in drifts])
        if flow.gradients is not None:
            flow.gradients.set_constant([s.three for s in kicks])
        if flow.curvatures is not None:
            flow.curvatures.set_constant([s.five for s in kicks])
        return flow

    @classmethod
    def from_architecture(cls, ndof: int, plan: dict[str, Any], dt: float, dtype: torch.dtype) -> Self:
        """Return a flow that has no system yet: `bind` will give it one."""
        return cls(ndof, PrimedShape.from_dict(plan["primed"], ndof), dt, dtype=dtype)

    def architecture(self) -> dict[str, Any]:
        return {"ndof": self.kept_ndof, "primed": self.shape.to_dict()}

    @property
    def palindromic(self) -> bool:
        return self.shape.palindromic

    @property
    def processor(self) -> int:
        return self.shape.processor

    @property
    def monomials(self) -> Monomials:
        return self.shape.monomials

    @property
    def dtype(self) -> torch.dtype:
        return self._number().dtype

    @property
    def device(self) -> torch.device:
        return self._number().device

    def _number(self) -> Tensor:
        """One of its parameters, found without the detours of a module's attributes."""
        return self._modules["kicks"]._parameters["free"]  # type: ignore[union-attr, return-value]

    @cached_property
    def sequence(self) -> tuple[Kind, ...]:
        """The kinds of the substeps."""
        return tuple(substep.kind for substep in self.substeps)

    def columns(self) -> Iterator[tuple[str, Coefficients]]:
        """The columns of its table by name; those of a polynomial, one for each monomial, as in "polynomials.0"."""
        return ((name, column) for name, column in self.named_modules() if isinstance(column, Coefficients))

    @property
    def terms(self) -> int:
        """The number of terms that a kick has beside V."""
        return len(self.monomials) or sum(c is not None for c in (self.gradients, self.curvatures))

    def _layer(self, i: int) -> Kick | Drift:
        substep = self.substeps[i]
        if substep.kind == "drift":
            return PrimedDrift(self.ndof, self._binding, substep.weight)
        passed = Sum(tuple(s.weight for s in self.substeps[:i] if s.kind == "drift"))
        terms: list[tuple[Term, Entry]] = [(POTENTIAL, substep.weight)]
        polynomial = PolynomialTerm(self.monomials, substep.more) if self.monomials else None
        if polynomial is None:
            terms += zip((FORCE_GRADIENT, CURVATURE), substep.more, strict=False)
        return Kick(PrimedPotential(self.ndof, self._binding, terms, polynomial, passed))

    # the frozen tables --------------------------------------------------------------------------------------

    @property
    def tables(self) -> Tables:
        """The tables of the numbers that the flow has now."""
        return self._tables.current(self._frozen)

    def _frozen(self) -> Tables:
        return Tables(self.substeps, len(self.shape.outer), self.dt, self.monomials)

    def scheme(self, t: float | None = None) -> Scheme:
        """ψ̄_t as a splitting scheme of step t, for t ∈ (0, Δt]; the default is Δt.

        Its coefficients depend on t, and so it has no classical order.
        """
        return self.tables.scheme("primed", self._time_of_scheme(t))

    def kernel_scheme(self, t: float | None = None) -> Scheme:
        """K_t, likewise: ψ̄_t where there is no processor."""
        return self.tables.scheme("primed kernel", self._time_of_scheme(t))

    def processor_scheme(self, t: float | None = None) -> Scheme:
        """χ_t, likewise."""
        if not self.processor:
            raise ValueError("`flow` has no processor: see its `scheme`.")
        return self.tables.scheme("primed processor", self._time_of_scheme(t))

    def _time_of_scheme(self, t: float | None) -> float | None:
        try:
            return None if t is None else float(t)
        except (TypeError, ValueError):
            raise TypeError(
                f"`t` must be a number in (0, dt] = (0, {self.dt:g}]; got {t!r}: leave it out for dt."
            ) from None

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        return self.tables.evaluations(n_steps, n_saved, n_extra, backend)

    def kernel_for(self, system: HamiltonianSystem, compensated: bool = False) -> PrimedFlowKernel:
        tables = self.tables
        if tables.kernel is not None and tables.kernel.system is system and not compensated:
            return tables.kernel
        from sympflow.kernels.flow_loops import PrimedFlowKernel

        for placement in tables.placements:
            check_compilable(*placement)
        if compensated:
            return PrimedFlowKernel(tables, system, compensated=True)
        tables.kernel = PrimedFlowKernel(tables, system, step=self._step_of_arrays)
        return tables.kernel

    @torch.no_grad()
    def _step_of_arrays(self, h: np.ndarray, y: np.ndarray, t: Any = 0.0) -> np.ndarray:
        """ψ̄_h of rows y (N, 2d) at times t, for h < 0 the inverse of ψ̄_|h|, each with its own h (N,)."""
        out = self.lift(torch.from_numpy(np.array(y)), torch.from_numpy(np.array(t, dtype=float)))
        for rows, back in ((h > 0, False), (h < 0, True)):
            if rows.any():
                out[rows] = self._psi(torch.from_numpy(np.abs(h[rows])), out[rows], back)
        return self.project(out).numpy()

    # kernel and processor as maps ---------------------------------------------------------------------------

    def prepare(self, t: float | Tensor, x: Tensor) -> Tensor:
        return self._partly(t, x, slice(0, len(self.shape.outer)))

    def finish(self, t: float | Tensor, x: Tensor) -> Tensor:
        return self._partly(t, x, slice(len(self.substeps) - len(self.shape.outer), None))

    def kernel_step(self, t: float | Tensor, x: Tensor, back: bool = False) -> Tensor:
        outer = len(self.shape.outer)
        return self._partly(t, x, slice(outer, len(self.substeps) - outer), back)

    def _partly(self, t: Time, x: Tensor, part: slice, back: bool = False) -> Tensor:
        t, y, batch = self._columns(t, x)
        q, p = y.chunk(2)
        for layer in reversed(self.layers[part]) if back else self.layers[part]:
            q, p = layer.inverse(t, q, p) if back else layer(t, q, p)  # type: ignore[operator]
        return self._states(torch.cat([q, p]), batch)

    # its system ---------------------------------------------------------------------------------------------

    @property
    def system(self) -> HamiltonianSystem | None:
        """The system whose V and T the flow uses, None for one loaded without it."""
        return self._binding.system if self._binding.known else None

    def known_by(self, system: HamiltonianSystem) -> HamiltonianSystem:
        of_one_size = self.monomials or (self.fingerprint is not None and not self.lattice_terms)
        return system if of_one_size else system.few_sites

    @property
    def kept_ndof(self) -> int:
        return self.ndof if self.system is None else self.known_by(self.system).ndof

    def bind(self, system: HamiltonianSystem) -> Self:
        """Give a flow that was loaded from a file the V and T of its system; itself.

        The flow of a lattice or of like bodies takes the size of the one that it is given.

        Raises
        ------
        ValueError
            If it is not the system that the flow was made for.
        """
        self.check_system(system)
        self._binding.bind(system)
        if system.ndof != self.ndof:
            self.ndof = system.ndof
            self.layers = tuple(map(self._layer, range(len(self.substeps))))  # type: ignore[assignment]
        if isinstance(self.domain, LocalStates):
            self.domain = self.domain.of(system)
        return self

    def transferred(self, system: HamiltonianSystem) -> Self:
        """Return an untrained flow of another system, with the numbers of this one.

        They are a start for ``train(system, flow=flow.transferred(system))``. As they are they need not be near the
        exact flow of that system, with friction for instance. The numbers know the potential and dt, not the size: of a
        lattice, or of like bodies, they serve any other one of the same terms: `solve` takes the flow as it is.

        Raises
        ------
        ValueError
            If the system has not as many degrees of freedom and is no lattice of the same terms, or has no such flow.
        """
        check_system(system)
        check_for_flows(system, self.takes_friction, self.takes_driving)
        if system.ndof != self.ndof:
            if system.local is None:
                raise ValueError(
                    f"`system` has {system.ndof} degrees of freedom, the flow {self.ndof}: give one of those."
                )
            self.check_system(system)
        if not system.separable or (self.terms and not (system.quadratic_kinetic and system.has_hessian_vector)):
            raise ValueError(
                f"`system` {system.name!r} has no kicks and drifts such as the flow's: it must be H = ½ pᵀM⁻¹p + V(q), "
                "with `hessian_vector` where V is a function."
            )
        return self._of(system, replace(self.shape, timed=_is_timed(system)))

    def of_any_size(self, system: HamiltonianSystem) -> Self:
        """Return the flow of a system with the numbers of this one, of a piece of it by its coordinates."""
        return self._of(system, self.shape).requires_grad_(False)

    def on_extended(self, extended: HamiltonianSystem) -> Self:
        monomials = tuple((*m, *[0] * (extended.ndof - self.ndof)) for m in self.monomials)
        return self._of(extended, replace(self.shape, monomials=monomials)).requires_grad_(False)

    def _of(self, system: HamiltonianSystem, shape: PrimedShape) -> Self:
        """A flow of a system with the numbers of this one."""
        other = type(self)(system.ndof, shape, self.dt, system, self.dtype, self.device)
        mine = dict(self.columns())
        for name, column in other.columns():
            column.set(to_numpy(mine[name].table))
        return other

    def bound(self, system: HamiltonianSystem) -> Self:
        if not self._binding.known:
            return self.bind(system)
        mine, theirs = self._binding.system.local, system.local
        if mine is theirs or mine is None or theirs is None or _size(mine) == _size(theirs):
            return self
        tables = self.tables
        if tables.carried is None or tables.carried.system is not system:
            tables.carried = self._carried(system)
        return tables.carried

    def check_ends(self, system: HamiltonianSystem) -> None:
        if system.local is None:
            return
        ring = self.figures.get("ends_periodic")
        for end in dict.fromkeys(system.local.ends):
            error = self.figures.get(f"ends_{end}")
            if ring is None or error is None or error <= WORSE * ring:
                continue
            raise ValueError(
                f"`system` {system.name!r} has {end} ends, at which bonds are missing and the numbers of this "
                f"flow hold less: a relative energy error of {error:.1e} was measured on a few sites with such "
                f"ends, {ring:.1e} on a ring. Fit one by sympflow.train(system)."
            )

    def _carried(self, system: HamiltonianSystem) -> Self:
        """This flow, of another size of its system, with what is known of it."""
        other = self._of(system, self.shape).requires_grad_(False)
        other.describe(self.description)
        if isinstance(self.domain, LocalStates):
            other.domain = self.domain.of(system)
        elif self.domain is not None:
            assert self.system is not None
            other.domain = states_of(self.system, self.domain.sample(DRAWN)).of(system)
        return other

    @property
    def driven(self) -> bool:
        return self._binding.known and not self._binding.system.autonomous

    @property
    def period(self) -> float | None:
        return self._binding.system.period if self._binding.known else None

    def initial_velocity(self, x: Tensor, t0: Any = None) -> Tensor:
        """d/dt ψ̄_t(x) at t = 0: that of its system, as the coefficients of V and T sum up to 1."""
        return super().initial_velocity(x, t0) if self.system is None else self.system.vector_field(x, t0)


def _size(local: LocalHamiltonian) -> tuple[Any, ...]:
    return local.shape, local.ends, local.ndof


def _is_timed(system: HamiltonianSystem) -> bool:
    """Return True if the drifts of a kernel must add up to t."""
    return system.friction is not None or not system.autonomous


def _check_counts(stages: Any, processor: Any) -> None:
    """Raise ValueError where there are more maps than a file may hold."""
    for name, value in (("stages", stages), ("processor", processor)):
        if isinstance(value, int) and 2 * value + 1 > MAX_LAYERS:
            most = (MAX_LAYERS - 1) // 2
            raise ValueError(f"`{name}` must be at most {most}, as many as a file may hold; got {value!r}.")


def _starting_scheme(system: HamiltonianSystem, scheme: Any, stages: Any, first: str) -> Scheme:
    """Return the scheme that an untrained flow is: the given one, or so many equal steps."""
    if scheme is None:
        stages = 6 if stages is None else stages
        if isinstance(stages, bool) or not isinstance(stages, int) or stages < 1:
            raise ValueError(f"`stages` must be a positive integer, the number of kicks; got {stages!r}: 3 is usual.")
        scheme = _equal_steps(stages, first)
    elif stages is not None or first != "drift":
        given = "stages" if stages is not None else "first"
        raise ValueError(f"`{given}` and `scheme` were both given: leave out `{given}`, the scheme has its own.")
    if isinstance(scheme, str):
        scheme = scheme_named(scheme)
    if not isinstance(scheme, Scheme):
        raise TypeError(
            f"`scheme` must be a Scheme or the name of one; got {scheme!r}: choose one of {', '.join(SCHEMES)}."
        )
    if (scheme.nystrom or any(scheme.gradients)) and not system.quadratic_kinetic:
        raise ValueError(f"`scheme` {scheme.name!r} needs a kinetic energy ½ pᵀM⁻¹p: take 'kahan_li8', for instance.")
    return scheme


def _kicks(scheme: Scheme) -> list[Any]:
    return [s for s in scheme.substeps if s.kind == "kick"]


def _kicks_of(name: str, asked: Any) -> tuple[bool, tuple[int, ...] | None]:
    """Return True where a term of kicks is asked for, with the kicks that have it where not all do."""
    asked = plain(asked)
    if isinstance(asked, Sequence) and not isinstance(asked, str):
        kicks = tuple(map(plain, asked))
        if all(isinstance(i, int) and not isinstance(i, bool) for i in kicks):
            return True, kicks
    if not isinstance(asked, bool):
        raise TypeError(f"`{name}` must be True or False; got {asked!r}: or name kicks, as a list of integers from 0.")
    return asked, None


def _force_gradient_of(system: HamiltonianSystem, asked: bool | None, curvature: bool) -> bool:
    """Return True if the kicks have force gradients: if asked for, or by default where T is quadratic."""
    if asked is None:
        asked = system.quadratic_kinetic and system.has_hessian_vector
    elif asked and not system.quadratic_kinetic:
        raise ValueError("`force_gradient` needs a kinetic energy ½ pᵀM⁻¹p: leave it out.")
    known = system.symbols is not None or system.local is not None
    if curvature and not (asked and known):
        remedy = "leave it out"
        if not known:
            remedy += ", or define the system with HamiltonianSystem.from_sympy"
        elif system.quadratic_kinetic:
            remedy = "leave out `force_gradient`, or `curvature`"
        raise ValueError(
            f"`curvature` goes with force gradients of a symbolic system or a lattice, H = ½ pᵀM⁻¹p + V(q): {remedy}."
        )
    return asked


def _equal_steps(n: int, first: str) -> Scheme:
    if first == "drift":
        return compose("leapfrog", 2, (1 / n,) * n, "equal leapfrog steps")
    if first != "kick":
        raise ValueError(f"`first` must be 'drift' or 'kick', which a step begins with; got {first!r}.")
    kicks = 0.5 / n, *(1 / n,) * (n - 1), 0.5 / n
    return Scheme("verlet", 2, kicks, (*(1 / n,) * n, 0.0), (0.0,) * (n + 1), "equal Verlet steps")


def _monomials_of(
    system: HamiltonianSystem, polynomial: int | None, force_gradient: bool | None, curvature: bool
) -> Monomials:
    """Return the exponents that `polynomial` asks for."""
    if polynomial is None:
        return ()
    if isinstance(polynomial, bool) or not isinstance(polynomial, int) or polynomial < 1:
        raise ValueError(f"`polynomial` must be a positive integer, its degree; got {polynomial!r}: 6 is usual.")
    if force_gradient or curvature:
        raise ValueError("`polynomial` stands in place of `force_gradient` and `curvature`: leave these out.")
    if system.symbols is None or not system.quadratic_kinetic:
        raise ValueError(
            "`polynomial` is for symbolic systems, H = ½ pᵀM⁻¹p + V(q): leave it out, or define the system with "
            "HamiltonianSystem.from_sympy."
        )
    return monomials(system.symbols, polynomial)
