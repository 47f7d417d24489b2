"""Splitting methods on lattices of any size: the code of one site and of one bond, over traced numbers.

An axis is cut into slabs, one for each lane of the registers: a place in memory holds the sites at one place of all
slabs, so that what is beside a site lies in the same lane, at the place beside. Only the planes before and behind the
slabs, their ghosts, are taken from other lanes. A stage is one pass over the places: each bond is computed once, and
what it does to the site at its other end is kept until that is reached. With a force gradient the accelerations are
made some places ahead of the kicks. What is made of a site is the same in all lanes, pieces and threads, to the bit.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np

from sympflow.compiler.arrange import ALWAYS, Arrangement
from sympflow.compiler.control import INT, Sweep, Type, Value
from sympflow.compiler.functions import FUNCTIONS, added, is_zero, times
from sympflow.compiler.machine import address
from sympflow.compiler.program import Program, Traced, derivatives, gradient, reached, tangent, traced
from sympflow.hamiltonian.formulas import evaluator
from sympflow.hamiltonian.lattice import LatticeHamiltonian
from sympflow.hamiltonian.monomials import Monomials
from sympflow.kernels.protocol import Kernel, Task
from sympflow.kernels.reverse import Chained
from sympflow.kernels.rollouts import aligned, zeros
from sympflow.kernels.runs import Numbers, Room
from sympflow.kernels.teams import Member, SharedMemory, SharedRollouts, meet
from sympflow.lazy import kept
from sympflow.schemes import CURVATURE

__all__ = ["LatticeCode"]

Key = Any
"""A number of a site: its kind, and which one of these."""


@dataclass(frozen=True)
class Form:
    """All that the code of a lattice depends on: not its size, nor the values of parameters.

    The terms are T ("kinetic"), U ("site") and V by their distances, with their symbols; `directions` those of v and w,
    `arrays` those of c with a value at each site. The boundary is that of each axis, of the lanes last. With friction
    −γp (`damped`) a column has two more numbers. `even` slabs are alike.
    """

    terms: tuple[tuple[Any, tuple[Any, tuple[Any, ...]]], ...]
    directions: tuple[Any, ...]
    c: tuple[Any, ...]
    arrays: frozenset[Any]
    unit_masses: bool
    boundary: tuple[str, ...]
    level: int
    compensated: bool
    damped: bool
    width: int
    even: bool

    @classmethod
    def of(
        cls,
        lattice: LatticeHamiltonian,
        order: Sequence[int],
        level: int,
        compensated: bool,
        damped: bool,
        width: int,
        even: bool,
    ) -> Form:
        """The form of a lattice whose axes are taken in an order."""
        terms: dict[Any, Any] = {"kinetic": (lattice.T, lattice.p)}
        if lattice.U != 0:
            terms["site"] = lattice.U, lattice.x
        terms |= {k: (lattice.bonds[k], lattice.r) for k in sorted(lattice.bonds)}
        values = zip(lattice.c, lattice.params.values(), strict=True)
        arrays = frozenset(s for s, value in values if isinstance(value, np.ndarray))
        unit_masses = lattice.quadratic_kinetic and lattice.inverse_mass is None
        given = tuple(terms.items()), (*lattice.v, *lattice.w), lattice.c, arrays, unit_masses
        boundary = tuple(lattice.boundary[axis] for axis in order)
        return cls(*given, boundary, level, compensated, damped, width, even)

    @property
    def fields(self) -> int:
        return len(self.directions) // 2

    @property
    def distances(self) -> list[int]:
        """The ends of bonds, as distances in sites."""
        return [k for k, _ in self.terms if isinstance(k, int)]

    @property
    def column(self) -> tuple[str, ...]:
        """The names of the numbers of a column."""
        return ("a", "b", "g", "c")[: 2 + self.level] + (("mean", "decay") if self.damped else ())

    @property
    def reach(self) -> int:
        """The longest distance of two ends of a bond."""
        return max(self.distances, default=0)

    def before(self, passes: int) -> int:
        """How far before the first place, or plane, a stage of so many passes begins."""
        return (2 * passes - 1) * self.reach


# the calculations of one site and of one bond -----------------------------------------------------------------------


class Law:
    """A calculation at a site or a bond, from numbers by keys to outputs by theirs; `numbers` are of parameters."""

    def __init__(self, form: Form, keys: Sequence[Key], outputs: Callable[..., dict[Key, Any]]) -> None:
        states = [(f"{kind}{i}", ALWAYS if kind == "column" else 0) for kind, i in keys]
        made = Arrangement(states, [s.name for s in form.c])
        found = outputs(made, dict(zip(keys, made.states, strict=True)), made.constants)
        self._keys, self.results = keys, list(found)
        self.table, self._body = made.finish(list(found.values()))
        self.operations = sum(FUNCTIONS[x.name].cost // 3 for x in self._body.operations)
        used = {x.order for x in reached(self._body.outputs)}
        self._reads = [x.order in used for x in self._body.inputs]
        self.numbers = [_formula(x) for x in self.table.outputs]

    def __call__(self, get: Callable[[Key], Any]) -> Iterator[tuple[Key, Any]]:
        keys = [*self._keys, *(("number", name) for name in self.numbers)]
        values = [get(key) if reads else 0.0 for key, reads in zip(keys, self._reads, strict=True)]
        return zip(self.results, self._body(*values), strict=True)


def _formula(x: Any) -> str:
    if not isinstance(x, Traced):
        return repr(x)
    return f"{x.name}({', '.join(map(_formula, x.args))})" if x.name != "input" else str(x.args[0])


def _is_costly(x: Traced) -> bool:
    if x.name == "pow" and isinstance(x.args[1], float) and x.args[1] % 1 == 0:
        return False
    return x.name in FUNCTIONS and FUNCTIONS[x.name].cost >= FUNCTIONS["div"].cost


class Potential:
    """A term f(x) of a site or bond, with ∇f (`slopes`), ∇²f row by row (`hessian`), ∇²f w + ½ ∇³f(v, v) (`third`)."""

    def __init__(self, form: Form, f: Any, x: Sequence[Any]) -> None:
        n = self.n = len(x)
        symbols = (*x, *form.directions, *form.c)
        program = traced(
            lambda *numbers: [evaluator(dict(zip(symbols, numbers, strict=True)))(f)], *(s.name for s in symbols)
        )
        given, (y,) = program.inputs, program.outputs
        self.x, v, w = given[:n], given[n : 2 * n], given[2 * n : 3 * n]
        slopes, hessian, third = gradient(y, self.x), list[Any](), list[Any]()
        if form.level:
            hessian = [a for row in derivatives(slopes, self.x) for a in row]
        if form.level == CURVATURE:
            twice = tangent(tangent(slopes, self.x, v), self.x, v)
            third = [a + 0.5 * b for a, b in zip(tangent(slopes, self.x, w), twice, strict=True)]
        self.slopes, self.hessian, self.third = (Program(given, values) for values in (slopes, hessian, third))

    def kept(self, costly: bool) -> list[int]:
        """The second derivatives that are not constant, of those that are alike the first; or the costly ones alone."""
        found: dict[int, int] = {}
        for k, f in enumerate(self.hessian.outputs):
            needs = reached([f])
            if {x.order for x in self.x} & {x.order for x in needs} and (not costly or any(map(_is_costly, needs))):
                found.setdefault(f.order, k)
        return list(found.values())

    def product(self, made: Arrangement, hessian: Sequence[Any], v: Sequence[Any]) -> list[Any]:
        """∇²f v; kept second derivatives are symbols."""
        rows = (hessian[i * self.n : (i + 1) * self.n] for i in range(self.n))
        return [sum((times(a, b) for a, b in zip(row, v, strict=True)), made.number(0.0)) for row in rows]


KICK, OPEN, TURN, MIDDLE, LAST = "kick", "open", "turn", "middle", "last"
"""Passes: a kick without force gradient; accelerations; a kick with force gradient; the same, and the direction that
curvature terms need; these. All but the second and the fourth end with a drift."""
KINDS = (KICK,), (OPEN, TURN), (OPEN, MIDDLE, LAST)
"""The passes of each kind of stage."""


class Pass:
    """A pass over sites: laws of bonds, by their distance, with ("flux", f) and what is kept, and that of a site."""

    def __init__(self, form: Form, name: str, terms: dict[Any, Potential]) -> None:
        self.form, self.name, self._terms, self._fields = form, name, terms, range(form.fields)
        ranks = [("r", "q"), ("dv", "v"), ("dw", "w")][: {KICK: 1, OPEN: 1, TURN: 2, MIDDLE: 2, LAST: 3}[name]]
        self._vectors = [vector for _, vector in ranks]
        self.differences = dict(ranks)
        keeps_all = len(form.boundary) == 1
        self._kept = {k: f.kept(k == "site" or not keeps_all) for k, f in terms.items()}
        self.bonds = {k: self._bond(k) for k in form.distances}
        self.site = self._site()

    def _law(self, kinds: Sequence[str], more: Sequence[Key], outputs: Callable[..., dict[Key, Any]]) -> Law:
        return Law(self.form, [*((kind, f) for kind in kinds for f in self._fields), *more], outputs)

    def _gradient(self, term: Any, kind: str, made: Any, get: dict[Key, Any], c: Sequence[Any]) -> dict[Key, Any]:
        """The parts of a term that this pass takes: ("flux", f), and ("kept", (term, k))."""
        potential, fields = self._terms.get(term), self._fields
        if potential is None:
            return {("flux", f): made.number(0.0) for f in fields}
        vectors = ("r", "dv", "dw") if term != "site" else ("q", "v", "w")
        x, v, w = ([get.get((vector, f), 0.0) for f in fields] for vector in vectors)
        kept = self._kept[term]
        if self.name in (KICK, OPEN):
            slopes = potential.slopes(*x, *v, *w, *c)
        elif self.name == LAST:
            slopes = potential.third(*x, *v, *w, *c)
        else:
            wanted = [f if k not in self._alike(term) else 0.0 for k, f in enumerate(potential.hessian.outputs)]
            hessian = Program(potential.hessian.inputs, wanted)(*x, *v, *w, *c)
            hessian = [
                get["kept", (term, self._alike(term)[k])] if k in self._alike(term) else made.number(f)
                for k, f in enumerate(hessian)
            ]
            slopes = potential.product(made, hessian, v)
        found: dict[Key, Any] = {("flux", f): made.number(y) for f, y in enumerate(slopes)}
        if self.name == OPEN and self.form.level:
            hessian = Program(potential.hessian.inputs, [potential.hessian.outputs[k] for k in kept])(*x, *v, *w, *c)
            found |= {("kept", (term, k)): made.number(y) for k, y in zip(kept, hessian, strict=True)}
        return found

    def _alike(self, term: Any) -> dict[int, int]:
        """Each kept second derivative, and those that equal it, by the one that is kept."""
        outputs = self._terms[term].hessian.outputs
        of = {outputs[k].order: k for k in self._kept[term]}
        return {k: of[f.order] for k, f in enumerate(outputs) if isinstance(f, Traced) and f.order in of}

    def _of_kept(self, term: Any) -> list[Key]:
        if term not in self._terms or self.name not in (TURN, MIDDLE):
            return []
        return [("kept", (term, k)) for k in self._kept[term]]

    def _bond(self, k: int) -> Law:
        def outputs(made: Any, get: dict[Key, Any], c: Sequence[Any]) -> dict[Key, Any]:
            return {key: made.written(x) for key, x in self._gradient(k, "bond", made, get, c).items()}

        return self._law(list(self.differences), self._of_kept(k), outputs)

    def _site(self) -> Law:
        momentum = "turned" if self.name == LAST else "p"
        kinds = ["q", *self._vectors[1:], "flux", *([self._slope] if self.name in (TURN, MIDDLE) else []), momentum]
        kinds += [f"{momentum}_error", "q_error"] if self.form.compensated else []
        more = [*self._of_kept("site"), *(("column", name) for name in self.form.column)]
        return self._law(list(dict.fromkeys(kinds)), more, self._moved)

    @property
    def _slope(self) -> str:
        """∇V, which is the acceleration where masses are 1."""
        return "v" if self.form.unit_masses else "slope"

    def _moved(self, made: Any, get: dict[Key, Any], c: Sequence[Any]) -> dict[Key, Any]:
        """The numbers of a site after the pass."""
        fields, name = self._fields, self.name
        terms = self._gradient("site", "site", made, get, c)
        total = [terms.pop(("flux", f)) + get["flux", f] for f in fields]
        found = {key: made.written(x) for key, x in terms.items()}
        if name == OPEN:
            slopes = [made.written(x) for x in total]
            found |= {(self._slope, f): x for f, x in enumerate(slopes)}
            return found | {("v", f): x for f, x in enumerate(self._velocity(made, slopes, c))}
        kick, *more = (get["column", x] for x in self.form.column[1 : 2 + self.form.level])
        if name == KICK:
            changes = [-times(kick, x) for x in total]
        elif name == LAST:
            changes = [-times(more[1], x) for x in total]
        else:
            products = [made.letter(made.written(x)) for x in total] if name == MIDDLE else total
            slopes = [get[self._slope, f] for f in fields]
            changes = [times(more[0], x) - times(kick, s) for x, s in zip(products, slopes, strict=True)]
            if name == MIDDLE:
                nodes = [made.node(x) for x in products]
                found |= {("w", f): x for f, x in enumerate(self._velocity(made, nodes, c))}
        momenta, errors = self._added(made, get, "turned" if name == LAST else "p", changes)
        if name == MIDDLE:
            found |= {("turned", f): x for f, x in enumerate(momenta)}
            return found | {("turned_error", f): x for f, x in enumerate(errors)}
        found |= {("p_error", f): x for f, x in enumerate(errors)}
        drift = get["column", "mean" if self.form.damped else "a"]
        moves = [made.number(times(drift, made.letter(x))) for x in self._velocity(made, momenta, c)]
        positions, errors = self._added(made, get, "q", moves)
        found |= {("q", f): x for f, x in enumerate(positions)} | {("q_error", f): x for f, x in enumerate(errors)}
        if self.form.damped:
            momenta = [made.written(times(get["column", "decay"], made.letter(x))) for x in momenta]
        return found | {("p", f): x for f, x in enumerate(momenta)}

    def _velocity(self, made: Any, momenta: Sequence[Any], c: Sequence[Any]) -> list[Any]:
        """∇T of momenta, numbers of the body."""
        nothing = [0.0] * (2 * len(momenta))
        slopes = self._terms["kinetic"].slopes(*(made.letter(x) for x in momenta), *nothing, *c)
        return [made.written(made.number(x)) for x in slopes]

    def _added(
        self, made: Any, get: dict[Key, Any], vector: str, changes: Sequence[Any]
    ) -> tuple[list[Any], list[Any]]:
        """A vector with changes, and the errors of compensated sums."""
        x = [get[vector, f] for f in self._fields]
        if not self.form.compensated:
            return [made.written(a + b) for a, b in zip(x, changes, strict=True)], []
        corrected = [made.written(change - get[f"{vector}_error", f]) for f, change in enumerate(changes)]
        pairs = [added(value, c, made.operation) for value, c in zip(map(made.node, x), corrected, strict=True)]
        return [total for total, _ in pairs], [error for _, error in pairs]


# the code of a stage ------------------------------------------------------------------------------------------------

SIZES = ("planes", "rows", "places", "vector", "plane", "row", "low")
"""Numbers of a context: planes, rows of a plane, places of a row; how many numbers vectors, planes and rows take, and
those of a vector before the first site."""
SITES = ("sites", "first", "site_of_plane", "site_of_row", "site_of_place")
"""How many sites there are, where in a row [q, p] the first one is, and how far apart those of neighbouring planes,
rows and places are."""
ADDRESSES = ("starts", "sizes", "full", "follows", "inside_0", "inside_1", "inside_2", "arrays", "values", "helpers")
"""Arrays: of each slab its first site and how many are its own; slabs of which all places are their own, and those that
follow one; and, along each axis, where sites are."""
SHARED = ("left", "right", "left_size", "member", "members", "meeting", "stop", "found")
"""Addresses of the states before and behind this piece, 0 where there are none, and the sites of the last slab before
it; the number of this thread and of all, where they meet, what ends them, and whether the piece of each is finite."""
CONTEXT = ("own", "longest", *SIZES, *SITES, *ADDRESSES, *SHARED)


class LatticeStages:
    """The code of stages that change a state in memory: vectors of each field of q, p and, compensated, of errors."""

    def __init__(self, form: Form) -> None:
        self.form, self.fields = form, form.fields
        self.functions: dict[Any, Callable[..., None]] = {}
        self.lock = threading.RLock()
        terms = {key: Potential(form, f, x) for key, (f, x) in form.terms}
        names = dict.fromkeys(name for kind in KINDS[: 1 + form.level] for name in kind)
        self.passes = {name: Pass(form, name, terms) for name in names}
        self.sets = ("q", "p", "q_error", "p_error")[: 4 if form.compensated else 2]
        self.vectors = [(kind, f) for kind in self.sets for f in range(self.fields)]
        laws = [law for one in self.passes.values() for law in (one.site, *one.bonds.values())]
        arrays = {s.name for s in form.arrays}
        self._operations = len(form.boundary) * sum(law.operations for law in laws)
        self._made = {name: (law, i) for law in laws for i, name in enumerate(law.numbers)}
        self.arrays, self.values = list[str](), list[str]()
        for name, (law, i) in self._made.items():
            needs = {x.args[0] for x in reached([law.table.outputs[i]]) if x.name == "input"}
            (self.arrays if needs & arrays else self.values).append(name)
        self.helpers, self.buffers = self._helpers()

    def _helpers(self) -> tuple[dict[Any, int], dict[Any, int]]:
        """Where planes begin that passes keep, and rows, of lattices of several axes; how many there are by None."""
        axes, helpers, rows = range(len(self.form.boundary)), {}, {}
        planes = count = 0
        if len(axes) > 1:
            for one in self.passes.values():
                kept = [key for key in one.site.results if key not in self.vectors]
                kept += [
                    (key, a) for law in one.bonds.values() for key in law.results if key[0] == "kept" for a in axes
                ]
                for key in kept:
                    helpers[key], planes = planes, planes + self.slots
                for k in one.bonds:
                    for f in range(self.fields):
                        helpers[one.name, 0, k, f], planes = planes, planes + k
                        rows[one.name, 1, k, f], count = count, count + k
        return {**helpers, None: planes}, {**rows, None: count if len(axes) > 2 else 0}

    @property
    def slots(self) -> int:
        """Planes of a number that passes keep."""
        return self.form.level * self.form.reach + 1

    def numbers(self, lattice: LatticeHamiltonian) -> tuple[list[float], list[np.ndarray]]:
        """The numbers of all sites and those of each, of a lattice of this form."""
        given = list(lattice.params.values())
        with np.errstate(all="ignore"):
            found = {name: law.table(*given)[i] for name, (law, i) in self._made.items()}
        return [float(found[name]) for name in self.values], [np.asarray(found[name]) for name in self.arrays]

    def stage(self, room: Room, numbers: Callable[[int], Value], kind: Value) -> None:
        """Change a state by a kick of a kind, without force gradient up to 1, and a drift."""
        given = [numbers(i) for i in range(len(self.form.column))]
        if self._operations < INLINE:
            self._stage(room.place, room.places, kind, *given)
        else:
            room.code.outlined("stage", (room.place, room.places, kind, *given), self._stage)

    def _stage(self, state: Value, context: Value, kind: Value, *numbers: Value) -> None:
        code, scene = state.code, _Scene(self, state, context, numbers)
        for k, names in enumerate(KINDS[: 1 + self.form.level]):
            with code.given(code.apply("eq", (kind, k + 1)) if k else kind <= 1):
                scene.refresh(len(names) * self.form.reach)
                scene.sweep([self.passes[name] for name in names])


class LatticeInMemory(SharedMemory):
    """A state as vectors of the sites in slabs; each thread has its own piece."""

    def __init__(self, stages: LatticeStages, *arguments: Any, **options: Any) -> None:
        super().__init__(len(stages.sets), *arguments, **options)
        self._stages = stages

    def block(self, every: int) -> Value:
        return self.code.load(self._context, CONTEXT.index("longest"), INT)

    def finite(self) -> Value:
        """True where the pieces of all threads are finite."""
        scene, code = _Scene(self._stages, self._end.place, self._context), self.code
        good = code.variable(super().finite())
        with code.given(scene.number("members") > 1):
            found = scene.address("found")
            code.store(code.convert("zext", good.value, "i64"), found, scene.number("member"))
            scene.meet()
            with code.over(scene.number("members")) as k:
                good.value = good.value & code.apply("eq", (code.load(found, k, INT), 1))
            scene.meet()
        return good.value

    def copied(self, room: Room, rows: Value, row: Value, sets: int, loads: bool) -> None:
        n = sets * self._stages.fields
        scene, code, width = _Scene(self._stages, room.place, self._context), self.code, self._stages.form.width
        at, starts, sizes = scene.numbers, scene.address("starts"), scene.address("sizes")
        rows = code.at(rows, row * (at["sites"] * n))
        for v, key in enumerate(self._stages.vectors[:n]):
            x, first = scene.vectors[key], at["first"] + at["sites"] * v
            with code.over(at["planes"]) as i, code.over(at["rows"]) as r, code.over(width) as lane:
                start = first + i * at["site_of_plane"] + r * at["site_of_row"]
                site, place = code.load(starts, lane, INT) + start, i * at["plane"] + r * at["row"] + lane
                with code.over(at["places"] if loads else code.load(sizes, lane, INT)) as j:
                    in_row, in_state = site + j * at["site_of_place"], place + j * width
                    if loads:
                        code.store(code.load(rows, in_row), x, in_state)
                    else:
                        code.store(code.load(x, in_state), rows, in_row)


INLINE = 100
"""Instructions up to which the code of a stage stands in the loop over stages, and not in a function of its own."""


class _Scene:
    """The code of one stage: the numbers and arrays that it reads, and loops over sites.

    `vectors` are addresses of the first site in vectors of the state and in arrays, `values` the same at all sites.
    """

    def __init__(self, stages: LatticeStages, state: Value, context: Value, column: Sequence[Value] = ()) -> None:
        self.stages, self.form, self.code, self._context = stages, stages.form, state.code, context
        self.n_axes, self.reach, self.width = len(self.form.boundary), self.form.reach, self.form.width
        self.type, self.bits = Type("double", self.width), Type("i64", self.width)
        code, width = self.code, self.width
        self.numbers = {name: self.number(name) for name in (*SIZES, *SITES)}
        vector, low = self.numbers["vector"], self.numbers["low"]
        self.vectors: dict[Key, Value] = {key: code.at(state, vector * i + low) for i, key in enumerate(stages.vectors)}
        if not column:
            return
        arrays, values = self.address("arrays"), self.address("values")
        self.vectors |= {("array", x): code.at(arrays, vector * i + low) for i, x in enumerate(stages.arrays)}
        of_column = {("column", name): x for name, x in zip(self.form.column, column, strict=True)}
        of_all = {("number", name): code.load(values, i) for i, name in enumerate(stages.values)}
        self.values = {key: code.splat(x, width) for key, x in (of_column | of_all).items()}
        self.helpers = self.address("helpers")
        self._distance = code.convert("ptrtoint", state, "i64") - self.number("own")

    def number(self, name: str) -> Value:
        return self.code.load(self._context, CONTEXT.index(name), INT)

    def address(self, name: str) -> Value:
        return self.code.address(self.number(name))

    # ghosts ---------------------------------------------------------------------------------------------------------

    def refresh(self, depth: int) -> None:
        """Take what stands before and behind slabs and planes of q from where these are."""
        if not depth:
            return
        code, at = self.code, self.numbers
        self.meet()
        for f in range(self.stages.fields):
            x = self.vectors["q", f]
            if self.n_axes == 1:
                self._ghosts(x, depth)
                with code.given(self.number("members") > 1):
                    self._ghosts_of_pieces(f, depth)
                continue
            length = at["plane"] * depth
            with self._piece("left", f) as beside:
                self._copy(
                    code.at(beside, (self.number("left_size") - depth) * at["plane"]), code.at(x, -length), length
                )
            with self._piece("right", f) as beside:
                self._copy(beside, code.at(x, at["planes"] * at["plane"]), length)
            with code.over(at["planes"] + 2 * depth) as i:
                self.around(code.at(x, (i - depth) * at["plane"]))
        self.meet()

    def around(self, x: Value) -> None:
        """The surroundings of a plane."""
        code, (rows, row) = self.code, (self.numbers[name] for name in ("rows", "row"))
        if self.n_axes == 2:
            self._ghosts(x, self.reach)
            return
        if self.form.boundary[1] == "periodic":
            length = row * self.reach
            self._copy(code.at(x, (rows - self.reach) * row), code.at(x, -length), length)
            self._copy(x, code.at(x, rows * row), length)
        with code.over(rows) as r:
            self._ghosts(code.at(x, r * row), self.reach)

    def _copy(self, source: Value, target: Value, length: Value) -> None:
        with self.code.over(self.code.op("sdiv", INT, length, self.code.constant(self.width, INT))) as k:
            self.code.store(self.code.load(source, k * self.width, self.type), target, k * self.width)

    def _ghosts(self, x: Value, depth: int) -> None:
        """Places before and behind the slabs of a row, taken from the lanes beside."""
        code, places, W = self.code, self.numbers["places"], self.width

        def chosen(name: str, yes: Value, no: Value) -> Value:
            return code.select(code.load(self.address(name), 0, self.bits) < 0, yes, no)

        def ends(k: Value) -> None:
            for name, yes, no, order, at in (
                ("full", places - 1 - k, places - 2 - k, [W - 1, *range(W - 1)], code.constant(-1, INT) - k),
                ("follows", k, k + 1, [*range(1, W), 0], places + k),
            ):
                ghost = code.load(x, yes * W, self.type)
                if not self.form.even:
                    ghost = chosen(name, ghost, code.load(x, no * W, self.type))
                ghost = code.shuffle(ghost, ghost, order)
                if self.form.boundary[-1] == "fixed":
                    ghost = self.within(ghost, code.load(self.inside(self.n_axes - 1), at * W, self.bits))
                code.store(ghost, x, at * W)

        if depth <= FEW:
            for i in range(depth):
                ends(code.constant(i, INT))
        else:
            with code.over(depth) as k:
                ends(k)

    def _ghosts_of_pieces(self, f: int, depth: int) -> None:
        """The same of the first slab and the last one, taken from other pieces."""
        code, places, W, x = self.code, self.numbers["places"], self.width, self.vectors["q", f]
        own_size = code.load(self.address("sizes"), W - 1, INT)
        for side, first, other, lane, at in (
            ("left", self.number("left_size") - 1, -1, W - 1, code.constant(-1, INT)),
            ("right", places - own_size, 1, 0, places),
        ):
            with self._piece(side, f) as beside, code.over(depth) as k:
                number = code.load(beside, (first + k * other) * W + lane)
                code.store(number, x, (at + k * other) * W + (W - 1 - lane))

    @contextmanager
    def _piece(self, side: str, f: int) -> Iterator[Value]:
        """Execute what is written inside if there is a piece beside, with the first site of field f of q there."""
        code, room = self.code, self.number(side)
        with code.given(~code.apply("eq", (room, 0))):
            yield code.at(code.address(room + self._distance), self.numbers["vector"] * f + self.numbers["low"])

    def meet(self) -> None:
        """Wait for the other threads."""
        with self.code.given(self.number("members") > 1):
            meet(*(self.number(name) for name in ("meeting", "members", "stop")))

    # places in memory -----------------------------------------------------------------------------------------------

    def inside(self, axis: int, k: int = 0) -> Value:
        """The address at the first site of what tells where sites are along an axis, or where bonds begin."""
        start = self.address(f"inside_{axis}")
        if k == 0:
            return start
        numbers = self.numbers["row"]
        if axis < self.n_axes - 1:
            ghosts = (self.form.level + 1 if axis == 0 else 1) * self.reach
            numbers = self.numbers["planes" if axis == 0 else "rows"] + 2 * ghosts
        return self.code.at(start, numbers * (1 + self.form.distances.index(k)), "i64")

    def within(self, x: Value, mask: Value) -> Value:
        """A number where there are sites, else 0."""
        return (x.bits & mask).real

    def place_of(self, key: Any, plane: Value, row: Value) -> Value:
        """The address of the first place of a row, of a number that is in memory."""
        at = self.numbers
        if key in self.vectors:
            return self.code.at(self.vectors[key], plane * at["plane"] + row * at["row"])
        return self.code.at(self.kept(key, self.stages.slots, plane), row * at["row"])

    def kept(self, key: Any, slots: int, plane: Value) -> Value:
        """The address of a plane of a number that passes keep, so many planes at a time."""
        slot = self._slot(plane, slots) + self.stages.helpers[key]
        inner = self.numbers["row"] * self.reach if self.n_axes > 2 else 0
        return self.code.at(self.helpers, slot * self.numbers["plane"] + (self.reach * self.width + inner))

    def kept_row(self, key: Any, slots: int, row: Value) -> Value:
        """The address of a row of such a number."""
        slot = self._slot(row, slots) + self.stages.buffers[key]
        start = self.numbers["plane"] * self.stages.helpers[None] + slot * self.numbers["row"]
        return self.code.at(self.helpers, start + self.reach * self.width)

    def _slot(self, i: Value, slots: int) -> Value:
        before = slots * (self.stages.slots + 1) * self.reach
        return self.code.op("urem", INT, i + before, self.code.constant(slots, INT))

    # passes ---------------------------------------------------------------------------------------------------------

    def sweep(self, passes: Sequence[Pass]) -> None:
        """Execute passes one after the other at each plane, each so far behind the one before that it can be."""
        code, R, m, at = self.code, self.reach, len(passes), self.numbers
        first, lags = -self.form.before(m), [(m - 1 - k) * R for k in range(m)]
        if self.n_axes == 1:
            with code.sweep(code.constant(first, INT), at["places"], self._at_place) as sweep:
                for one, lag in zip(passes, lags, strict=True):
                    _Place(self, one, sweep, lag).execute()
            return
        steps = [-self.form.before(m - k) for k in range(m)]
        for k, step in enumerate(steps):  # those that are behind begin later
            own = list(zip(passes[: k + 1], lags, strict=False))
            last = steps[k + 1] if k + 1 < m else at["planes"]
            with code.over(last - step) as i:
                plane = i + step
                if self.n_axes > 2:
                    with code.over(at["rows"] + R) as r:
                        self._row(own, plane, r - R)
                else:
                    self._row(own, plane, code.constant(0, INT))
                for one, lag in own:
                    for key in one.site.results:
                        if key[0] in ("v", "w"):
                            self.around(self.kept(key, self.stages.slots, plane + lag))

    def _row(self, passes: Sequence[tuple[Pass, int]], plane: Value, row: Value) -> None:
        own = _Row(self, plane, row)
        with self.code.sweep(self.code.constant(-self.reach, INT), self.numbers["places"], own.read) as own.sweep:
            for one, lag in passes:
                _RowPlace(own, one, lag).execute()

    def _at_place(self, key: Key, i: Value) -> Value:
        """Read a number of a lattice of one axis."""
        if key[0] == INSIDE:
            return self.code.load(self.inside(0, key[1]), i * self.width, self.bits)
        return self.code.load(self.vectors[key], i * self.width, self.type)


INSIDE = "inside"
FEW = 4  # ghosts that are written out


class _Place:
    """A site of a lattice of one axis, at which a pass is executed: at the place `lag` places further on."""

    def __init__(self, scene: _Scene, one: Pass, sweep: Sweep, lag: int) -> None:
        self.scene, self.one, self.code, self.sweep, self.lag = scene, one, scene.code, sweep, lag
        self.first = self.code.constant(0, INT)

    def execute(self) -> None:
        """Write the calculations of the bonds that begin at a site, and of the site."""
        total: dict[int, Value] = {}
        for axis in range(self.scene.n_axes):
            for k, law in self.one.bonds.items():
                for key, x in law(partial(self._of_bond, axis, k)):
                    if key[0] == "kept":
                        self.keep((key, axis), x)
                    elif not is_zero(x):
                        ahead = self.code.operand(x, self.scene.type)
                        if self.scene.form.boundary[axis] == "free":  # 0 where a free end leaves a bond out
                            ahead = self.scene.within(ahead, self.inside(axis, k))
                        change = self.behind(axis, k, key[1], ahead) - ahead
                        total[key[1]] = total[key[1]] + change if key[1] in total else change
        if self.one.name in (OPEN, MIDDLE):
            self._site(total)
            return
        with self.code.given(self.first <= self.sweep.k):
            self._site(total)

    def _site(self, total: dict[int, Value]) -> None:
        for key, value in self.one.site(partial(self._of_site, total)):
            x = self.code.operand(value, self.scene.type)
            if key in self.scene.stages.vectors:
                self.move(key, x)
            else:
                self.keep(key, x)

    def _of_bond(self, axis: int, k: int, key: Key) -> Any:
        kind, i = key
        if kind in self.one.differences:
            vector = self.one.differences[kind], i
            return self.get(vector, axis, k) - self.get(vector)
        return self.get((key, axis)) if kind == "kept" else self._of_site({}, key)

    def _of_site(self, total: dict[int, Value], key: Key) -> Any:
        if key[0] == "flux":
            return total.get(key[1], 0.0)
        found = self.scene.values.get(key)
        return found if found is not None else self.get(("array", key[1]) if key[0] == "number" else key)

    def at_wall(self, key: Key, x: Value) -> Value:
        """Velocities, 0 beyond walls."""
        for axis in range(max(1, self.scene.n_axes - 1)) if key[0] in ("v", "w") else ():
            if self.scene.form.boundary[axis] == "fixed":
                x = self.scene.within(x, self.inside(axis, 0))
        return x

    def get(self, key: Any, axis: int = 0, k: int = 0) -> Value:
        """A number of this site, or of the one so far along an axis."""
        return self.sweep.get(key, self.lag + k, self.scene.type)

    def inside(self, axis: int, k: int) -> Value:
        """True where there is a site, or the bond of length k that begins there."""
        return self.sweep.get((INSIDE, k), self.lag, self.scene.bits)

    def behind(self, axis: int, k: int, f: int, x: Value) -> Value:
        """Keep what a bond does for the site at its end, and return what the one that ends here does."""
        key = "flux", self.one.name, k, f
        self.sweep.put(key, self.lag, x)
        return self.sweep.get(key, self.lag - k, x.type)

    def move(self, key: Key, x: Value) -> None:
        self.code.store(x, self.scene.vectors[key], self.sweep.k * self.scene.width)

    def keep(self, key: Any, x: Value) -> None:
        self.sweep.put(key, self.lag, self.at_wall(key, x))


class _Row:
    """A row of a lattice of several axes, and rows beside it, at which passes are executed together."""

    sweep: Sweep

    def __init__(self, scene: _Scene, plane: Value, row: Value) -> None:
        self.scene, self.code, self.plane, self.row = scene, scene.code, plane, row
        self.fresh: dict[Any, Value] = {}
        self._known: dict[Any, Value] = {}
        zero, places = self.code.constant(0, INT), scene.numbers["places"]
        self.first = self.code.select((zero <= row) & (zero <= plane), zero, places)

    def before(self, key: Any, make: Callable[[], Value]) -> Value:
        """A value that is the same at all places of the row."""
        if key not in self._known:
            with self.sweep.before():
                self._known[key] = make()
        return self._known[key]

    def start(self, key: Any, plane: int = 0, row: int = 0) -> Value:
        """The address of a number at the first place of a row so far from this one."""
        return self.before((key, plane, row), lambda: self.scene.place_of(key, self.plane + plane, self.row + row))

    def read(self, key: Any, j: Value) -> Value:
        code, scene = self.code, self.scene
        if key[0] == INSIDE:
            return code.load(scene.inside(scene.n_axes - 1, key[1]), j * scene.width, scene.bits)
        return code.load(self.start(*key), j * scene.width, scene.type)


class _RowPlace(_Place):
    """A site of a row that is `lag` planes further on."""

    def __init__(self, own: _Row, one: Pass, lag: int) -> None:
        super().__init__(own.scene, one, own.sweep, lag)
        self._own, self.first, self._last = own, own.first, own.scene.n_axes - 1

    def get(self, key: Any, axis: int = 0, k: int = 0) -> Value:
        if axis == self._last and k:
            return self.sweep.get((key, self.lag), k, self.scene.type)
        place = (key, self.lag + k) if axis == 0 else (key, self.lag, k) if k else (key, self.lag)
        fresh = self._own.fresh.get(place)
        return self.sweep.get(place, 0, self.scene.type) if fresh is None else fresh

    def inside(self, axis: int, k: int) -> Value:
        code, scene, own = self.code, self.scene, self._own
        if axis == self._last:
            return self.sweep.get((INSIDE, k), 0, scene.bits)

        def mask() -> Value:
            place = own.plane + self.lag if axis == 0 else own.row
            return code.splat(code.load(scene.inside(axis, k), place, INT), scene.width)

        return own.before((INSIDE, axis, k, self.lag), mask)

    def behind(self, axis: int, k: int, f: int, x: Value) -> Value:
        scene, own, name = self.scene, self._own, (self.one.name, axis, k, f)
        if axis == self._last:
            self.sweep.put(name, 0, x)
            return self.sweep.get(name, -k, x.type)

        def kept() -> Value:
            if axis:
                return scene.kept_row(name, k, own.row)
            return self.code.at(scene.kept(name, k, own.plane + self.lag), own.row * scene.numbers["row"])

        start, place = own.before(name, kept), self.sweep.k * scene.width
        behind = self.code.load(start, place, x.type)
        self.code.store(x, start, place)
        return behind

    def move(self, key: Key, x: Value) -> None:
        self.code.store(x, self._own.start(key, self.lag), self.sweep.k * self.scene.width)

    def keep(self, key: Any, x: Value) -> None:
        x = self._own.fresh[key, self.lag] = self.at_wall(key, x)
        self.code.store(x, self._own.start(key, self.lag), self.sweep.k * self.scene.width)


# the places of a lattice --------------------------------------------------------------------------------------------

PAGE, NEAR = 512, 64  # numbers


class Slabs:
    """The memory of a lattice in pieces of some planes or slabs; `order` has the axis of slabs last."""

    def __init__(self, lattice: LatticeHamiltonian, stages: LatticeStages, order: Sequence[int], pieces: int) -> None:
        form, W, R, one_axis = stages.form, stages.form.width, stages.form.reach, len(order) == 1
        steps = [int(np.prod(lattice.shape[k + 1 :], dtype=np.int64)) for k in range(len(order))]
        shape, strides = ([sizes[a] for a in order] for sizes in (lattice.shape, steps))
        slabs = np.arange(W * (pieces if one_axis else 1) + 1) * shape[-1] // (W * (pieces if one_axis else 1))
        starts, sizes = slabs[:-1].reshape(-1, W), np.diff(slabs).reshape(-1, W)
        bounds = np.zeros(2, dtype=int) if one_axis else np.arange(pieces + 1) * shape[0] // pieces
        places, depth, outer = int(sizes.max()), (form.level + 1) * R, shape[:-1]
        ends = (form.before(form.level + 1), depth) if one_axis else (R, R)
        row = (ends[0] + places + ends[1]) * W
        plane = row * (shape[1] + 2 * R) if len(order) > 2 else row
        planes = int(np.diff(bounds).max()) + 2 * depth if outer else 1
        vector = -(-planes * plane // 8) * 8
        if vector > PAGE and min(vector % PAGE, -vector % PAGE) < NEAR:  # two streams so far apart evict each other
            vector += (NEAR - vector) % PAGE
        self.size = vector * len(stages.vectors)
        self.helpers = stages.helpers[None] * plane + stages.buffers[None] * row
        low = ends[0] * W + (R * row if len(order) > 2 else 0) + (depth * plane if outer else 0)
        full, periodic = sizes == places, [b == "periodic" for b in form.boundary]
        follows = np.roll(full.ravel(), 1).reshape(full.shape)
        values, arrays = stages.numbers(lattice)
        self._values = np.array([*values, 0.0])
        distances = [strides[0] if outer else 0, strides[1] if len(order) > 2 else 0, strides[-1]]
        self._pieces, self._closed = list[_Piece](), periodic[0] and not (one_axis and pieces == 1)
        for k in range(pieces):
            mine = k if one_axis else 0
            first, n_planes = int(bounds[k if outer else 0]), int(bounds[k + 1] - bounds[k]) if outer else 1
            sites = [np.arange(-d, n + d) for d, n in zip((depth, R), (n_planes, *shape[1:-1]), strict=False)][
                : len(outer)
            ]
            if outer:
                sites[0] = sites[0] + first
            sites.append(starts[mine] + np.arange(-ends[0], places + ends[1])[:, None])
            lengths = 0, *form.distances
            inside = [
                _mask(np.stack([p | (i >= 0) & (i + k < n) for k in lengths]))
                for i, n, p in zip(sites, shape, periodic, strict=True)
            ]
            index = [i % n if p else i.clip(0, n - 1) for i, n, p in zip(sites, shape, periodic, strict=True)]
            own = zeros(len(arrays) * vector).reshape(len(arrays), vector)
            for x, array in zip(own, arrays, strict=True):
                found = np.broadcast_to(array, lattice.shape).transpose(order)
                for axis, i in enumerate(index):
                    found = found.take(i, axis)
                x[: found.size] = found.ravel()
            masks = [_mask(x[mine]) for x in (full, follows)]
            offsets = [*[depth, R][: len(outer)], ends[0] * W]
            numbers = [n_planes, shape[1] if len(order) > 2 else 1, places, vector, plane, row, low]
            numbers += [lattice.sites, first * distances[0], *distances]
            size = n_planes if outer else int(sizes[mine, -1])
            self._pieces.append(
                _Piece(numbers, [starts[mine] * strides[-1], sizes[mine], *masks], inside, offsets, own, size)
            )

    def contexts(self, rooms: Sequence[int], helpers: Sequence[int], longest: int, shared: Sequence[int]) -> np.ndarray:
        """The numbers of `CONTEXT` of each piece: of the addresses of their states and helpers, and others."""
        found = []
        for k, (piece, room) in enumerate(zip(self._pieces, rooms, strict=True)):
            before, behind = k > 0 or self._closed, k + 1 < len(rooms) or self._closed
            places = [x.ctypes.data + 8 * offset for x, offset in zip(piece.inside, piece.offsets, strict=True)]
            places += [0] * (3 - len(places))
            numbers = [room, longest, *piece.numbers, *(x.ctypes.data for x in piece.arrays), *places]
            numbers += [piece.sites.ctypes.data, self._values.ctypes.data, helpers[k]]
            numbers += [rooms[k - 1] if before else 0, rooms[(k + 1) % len(rooms)] if behind else 0]
            found.append([*numbers, self._pieces[k - 1].size, k, len(rooms), *shared])
        return np.array(found, dtype=np.int64)


@dataclass(frozen=True)
class _Piece:
    """The context of a piece."""

    numbers: list[int]
    arrays: list[np.ndarray]
    inside: list[np.ndarray]
    offsets: list[int]
    sites: np.ndarray
    size: int


def _mask(x: np.ndarray) -> np.ndarray:
    """Numbers all bits of which are as these."""
    bits = zeros(x.size).view(np.int64)
    bits[:] = -x.ravel().astype(np.int64)
    return bits


class LatticeCode(SharedRollouts):
    """The compiled functions of schemes on one lattice, `damped` by −γp: its form alone is part of the code."""

    def __init__(
        self, lattice: LatticeHamiltonian, damped: bool, level: int, compensated: bool, monomials: Monomials = ()
    ) -> None:
        super().__init__(2 * lattice.ndof * (1 + compensated), 2 * lattice.ndof)
        self._given = lattice, damped, level, compensated
        self._order, width = arrangement(lattice)
        n, one_axis = lattice.shape[self._order[-1]], len(lattice.shape) == 1
        depth = max(1, max(lattice.bonds, default=0) * (1 + level))
        planes = n // width if one_axis else lattice.shape[self._order[0]]
        self.pieces = max(1, min(lattice.ndof // WORTH_A_PIECE, planes // (2 * depth)))
        even = n % width == 0 and (self.pieces == 1 or not one_axis)
        self._stages = _stages(Form.of(lattice, self._order, level, compensated, damped, width, even))
        self._functions, self._lock = self._stages.functions, self._stages.lock
        self.memory = partial(LatticeInMemory, self._stages)
        self.work, self.terms = lattice.ndof, 1 + level

    @cached_property
    def size(self) -> int:
        return len(self._stages.form.column)

    @kept
    def _slabs(self, threads: int) -> Slabs:
        return Slabs(self._given[0], self._stages, self._order, threads)

    def stage(self, room: Any, numbers: Numbers, kind: Value, step: Value) -> Any:
        self._stages.stage(room, numbers, kind)

    def check_reverse(self) -> None:
        if self._given[1]:
            super().check_reverse()

    def chained(self, kernel: Kernel, task: Task, table: np.ndarray) -> Chained:
        """The run with its reverse: of the symplectic map A of tangent vectors Aᵀ = ΩA⁻¹Ωᵀ, by the inverse step."""
        n, stages = self.n_out // 2, np.delete(table, -2, axis=1)  # without the link of two steps
        inverse = np.zeros((len(table), stages.shape[1] + 1))
        inverse[0, :-1], inverse[1:, 1:] = -stages[0, ::-1], -stages[1:, ::-1]

        def pull(states: np.ndarray, cotangents: np.ndarray) -> np.ndarray:
            vectors = np.concatenate([-cotangents[:, n:], cotangents[:, :n]], axis=1)
            rows = np.concatenate([states[:, :n], vectors, states[:, n:]], axis=1)
            self._along.mapped(inverse, rows, rows)
            return np.concatenate([rows[:, 2 * n : 3 * n], -rows[:, n : 2 * n]], axis=1)

        return Chained(kernel, task, pull)

    @cached_property
    def _along(self) -> LatticeCode:
        """The same of states with tangent vectors."""
        lattice, _, level, _ = self._given
        return LatticeCode(lattice.along_vectors(), False, level, False)

    def members(self, meeting: np.ndarray, stop: np.ndarray, threads: int, block: int) -> Callable[[int], Member]:
        slabs = self._slabs(threads)
        rooms = [aligned(3 * slabs.size) for _ in range(threads)]
        helpers = [zeros(slabs.helpers) for _ in range(threads)]
        found = np.zeros(threads, dtype=np.int64)
        shared = [address(x) for x in (meeting, stop, found)]
        contexts = slabs.contexts([*map(address, rooms)], [*map(address, helpers)], block, shared)
        return lambda k: Member(rooms[k], contexts[k], (slabs, helpers, found))


WORTH_A_PIECE = 16_384
"""Degrees of freedom from which another thread pays: threads wait for each other twice a stage."""


@lru_cache(maxsize=64)
def _stages(form: Form) -> LatticeStages:
    return LatticeStages(form)


def arrangement(lattice: LatticeHamiltonian) -> tuple[list[int], int]:
    """The axes of a lattice, that which is cut into slabs last, and how many slabs: with the least done in vain."""
    reach, one_axis = max(1, max(lattice.bonds, default=0)), len(lattice.shape) == 1
    best: tuple[float, list[int], int] | None = None
    for axis in reversed(range(len(lattice.shape))):
        n = lattice.shape[axis]
        for width in (8, 4, 2, 1):
            places = -(-n // width)
            if n // width < (4 if one_axis else 2) * reach and width > 1:
                continue
            others = [a for a in range(len(lattice.shape)) if a != axis]
            cost = width * (places + 2 * reach) / n * (8 / width) * (1.25 if places > LONG and others else 1.0)
            if best is None or cost < best[0]:
                best = cost, [*others, axis], width
    assert best is not None
    return best[1:]


LONG = 256
"""Places of a row from which the rows around a site leave the fastest cache."""
