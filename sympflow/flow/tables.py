"""Tables of primed flows: the shape of a flow, and its numbers as schemes and as polynomials in t."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self

import numpy as np

from sympflow.flow.records import MAX_DEGREE, MAX_LAYERS, Refused, checked_integer
from sympflow.hamiltonian.monomials import MOST_MONOMIALS, Monomials
from sympflow.schemes import CURVATURE as CURVATURE_LEVEL
from sympflow.schemes import POLYNOMIAL as POLYNOMIAL_LEVEL
from sympflow.schemes import Scheme, scheme_evaluations

if TYPE_CHECKING:
    from sympflow.kernels.stages import StageTable

Kind = Literal["kick", "drift"]
MakeColumn = Callable[..., Any]
Total = Literal["start", "always"] | None
"""When the numbers of a column add up to 1."""

MOST_KEPT = 256  # a flow with a processor has five for each step length


@dataclass(frozen=True)
class PrimedShape:
    """The architecture of a primed flow."""

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

    def columns(self, inside: bool, make: MakeColumn) -> Columns:
        """Return columns of K or of χ: ``make(name, n, exponents, power, palindromic, total, present)``."""
        sequence = self.kernel if inside else self.outer
        if not sequence:
            return Columns()
        powers, mirrored = tuple(range(0, self.degree, 2 if self.palindromic else 1)), self.palindromic and inside

        def column(name: str, kind: Kind, power: int, total: Total = None, present: Any = None) -> Any:
            return make(name, sequence.count(kind), powers, power, mirrored, total, present)

        having, curved = (self.gradient_kicks, self.curvature_kicks) if inside else (None, None)
        curved = having if curved is None else curved
        return Columns(
            column("kicks", "kick", 1, "start" if inside else None),
            column("drifts", "drift", 1, ("always" if self.timed else "start") if inside else None),
            column("gradients", "kick", 3, None, having) if self.force_gradient else None,
            column("curvatures", "kick", 5, None, curved) if self.curvature else None,
            [column(f"polynomials.{i}", "kick", 3) for i in range(len(self.monomials))] if self.monomials else None,
        )

    def substeps(self, inside: Columns, outside: Columns) -> tuple[Substep, ...]:
        """Return χ⁻¹, K, χ by the columns of K and χ."""
        outer = {sign: substeps_of(self.outer, outside, sign) for sign in (1, -1)}
        return (*reversed(outer[-1]), *substeps_of(self.kernel, inside, 1), *outer[1])

    def to_dict(self) -> dict[str, Any]:
        """JSON-able, the later entries where they are not what they are by default."""
        told = asdict(self)
        later = {f.name: f.default for f in fields(self)[7:]}
        return {n: list(v) if isinstance(v, tuple) else v for n, v in told.items() if n not in later or v != later[n]}

    @classmethod
    def from_dict(cls, plan: Any, ndof: int) -> Self:
        """Return the shape that a file describes, after a check of all its entries."""
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
    """A kick or a drift: its coefficient, and those of a kick's other terms, γ and c or one for each monomial."""

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


class Memory:
    """Objects made of fixed numbers, each once for its key, up to so many."""

    def __init__(self, most: int) -> None:
        self._kept: dict[Any, Any] = {}
        self._most = most

    def kept(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return what `make` gives, made once for each key."""
        if key not in self._kept:
            if len(self._kept) >= self._most:
                self._kept.clear()
            self._kept[key] = make()
        return self._kept[key]


class Tables(Memory):
    """The numbers of kicks and drifts of ψ̄_t, K_t and χ_t: at one t as a `Scheme`, at all t as polynomials."""

    def __init__(self, substeps: Sequence[Substep], outer: int, dt: float, monomials: Monomials = ()) -> None:
        super().__init__(MOST_KEPT)
        last = len(substeps) - outer
        self._parts = {"primed": substeps, "primed kernel": substeps[outer:last], "primed processor": substeps[last:]}
        self.substeps, self.dt, self.processed = substeps, dt, outer > 0
        self.kernel: Any = None  # the compiled loops that were made of these last
        self.carried: Any = None  # the flow of another size of a lattice that was made of these last
        self.monomials = monomials
        self.level = POLYNOMIAL_LEVEL if monomials else max(len(s.more) for s in substeps)
        exponents = columns_of(substeps)[0].exponents
        self._coefficients = {id(c): c.numbers for c in columns_of(substeps)}
        self._exponents = np.array(exponents, dtype=float)
        self._even = exponents[1:2] != (1,)

    def scheme(self, part: str, t: float | None, back: bool = False) -> Scheme:
        """The part at t ∈ (0, Δt], the default Δt; `back` its inverse."""

        def make() -> Scheme:
            return self.scheme(part, t).inverse() if back else self._frozen(part, t)

        return self.kept((part, t, back), make)

    def polynomials(self, back: bool) -> StageTable:
        """The stages of ψ̄_t or of its inverse for all t, over their powers of t: coefficients (m, K) by `variable`."""

        from sympflow.kernels.stages import StageTable

        def make() -> StageTable:
            parts, sign = self._parts["primed"], -1 if back else 1
            substeps = reversed(parts) if back else parts
            stages = self._stages((s.kind, _numbers(s, self._coefficients, sign)) for s in substeps)
            numbers = np.array(stages, dtype=float)  # (m, columns, K)
            numbers = np.pad(numbers, ((0, 0), (0, 0), (0, max(0, 3 - numbers.shape[2]))))
            of_kick = range(3, numbers.shape[1] - 1) if self.level == POLYNOMIAL_LEVEL else (1, 2)
            return StageTable(self.level, numbers[:, [-1, 0, *of_kick]].swapaxes(0, 1))

        return self.kept(("polynomials", back), make)

    def variable(self, t: np.ndarray) -> np.ndarray:
        """t/Δt, or its square where all polynomials are even."""
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


def columns_of(substeps: Sequence[Substep]) -> list[Any]:
    """Return the distinct columns that the substeps take their numbers from."""
    entries = [entry for s in substeps for entry in s.entries]
    return list({id(entry.column): entry.column for entry in entries}.values())


def _numbers(s: Substep, values: dict[int, np.ndarray], sign: int) -> list[Any]:
    """Return the coefficients of a substep, out of those of the columns."""
    return [sign * e.sign * values[id(e.column)][e.row] for e in s.entries]


def free_numbers(
    n: int, terms: int, palindromic: bool, total: Total, present: Sequence[int] | None
) -> tuple[list[tuple[int, int]], np.ndarray, np.ndarray]:
    """Return the places (i, k) of the free numbers of a `FreeTable`, its basis (n, K, f) and its offset (n, K)."""
    representative = np.minimum(np.arange(n), np.arange(n)[::-1]) if palindromic else np.arange(n)
    count = np.bincount(representative)
    last = len(count) - 1
    kept = range(n) if present is None else present
    bound = terms if total == "always" else int(total == "start")
    free = [(i, k) for i in range(last + 1) if i in kept for k in range(terms) if i != last or k >= bound]
    basis, offset = np.zeros((n, terms, len(free))), np.zeros((n, terms))
    for column, (i, k) in enumerate(free):
        basis[representative == i, k, column] = 1.0
        if k < bound:
            basis[representative == last, k, column] = -count[i] / count[last]
    if total is not None:
        offset[representative == last, 0] = 1.0 / count[last]
    return free, basis, offset


@dataclass(frozen=True)
class Entry:
    """± t^m c_i(t/Δt): the place of one c_i in a flow, with its sign."""

    column: Any
    row: int
    sign: int = 1

    def value(self, t: Any) -> Any:
        return self.sign * self.column.value(self.row, t)

    def rate(self, t: Any) -> Any:
        """Its time derivative."""
        return self.sign * self.column.rate(self.row, t)
