"""The order of operations: programs written anew, with short chains of few operations.

A compiler keeps the order of additions and products, so that it is ours to choose. Numbers are collected as polynomials
in *letters*: the inputs, and the values of functions other than polynomials. What depends on no state is computed once
for a run and stands in a table. Each polynomial is then nested, m·A + B, by letters and products of two of them, so
that its longest chain of operations is short: the chains of one trajectory take its time. One shape serves a single
trajectory and the lanes of registers, so that their bits agree.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

from sympflow.compiler.functions import FUNCTIONS, apply
from sympflow.compiler.numbers import Number
from sympflow.compiler.program import Program, Recording, Traced
from sympflow.compiler.tables import Table

__all__ = ["Arranged", "Arrangement"]

MOST_TERMS = 64  # of a product that is multiplied out
MOST_SPREAD = 16  # terms of a sum over which a product of letters is spread: sums of sums would grow with each product
MOST_TRIED = 10  # terms of a polynomial for which all ways to nest it are compared
MOST_SEARCHED = 1000  # polynomials, and parts of these, for which they are

Monomial = tuple[tuple[int, int], ...]
"""Letters, by their order in the recording, with their exponents; sorted."""
Terms = dict[Monomial, Any]
"""Coefficients of monomials: floats, or numbers of the table's recording."""


class Arranged(NamedTuple):
    """A program in two parts: `table`, of the constants of a run, and `body`, of states and what the table gives."""

    table: Program
    body: Program


class Polynomial(Number):
    """A sum of products of letters, each with a coefficient."""

    __slots__ = ("owner", "terms")

    def __init__(self, owner: Arrangement, terms: Terms) -> None:
        self.owner, self.terms = owner, terms

    def apply(self, name: str, args: Sequence[Any]) -> Any:
        return self.owner.apply(name, [self.owner.number(x) for x in args])

    @property
    def constant(self) -> Any:
        """The value of a polynomial without letters, else None."""
        if not self.terms:
            return 0.0
        return self.terms.get(()) if len(self.terms) == 1 else None


class _Body(Recording):
    """Recorded operations on states; of each number, when its value is known, in cycles."""

    def __init__(self) -> None:
        super().__init__()
        self.known: dict[int, int] = {}

    def _number(self, name: str, args: tuple[Any, ...]) -> Traced:
        value = super()._number(name, args)
        if name != "input" and value.order not in self.known:
            self.known[value.order] = max(map(self.depth, args)) + FUNCTIONS[name].cost
        return value

    def depth(self, x: Any) -> int:
        return self.known.get(x.order, ALWAYS) if isinstance(x, Traced) else ALWAYS


class Plan(NamedTuple):
    """A way to compute a polynomial: when it is known, in cycles, how many operations it takes, and what writes it."""

    depth: int
    operations: int
    write: Callable[[], Any]

    @property
    def cost(self) -> tuple[int, int]:
        """A single trajectory waits for the chain, lanes side by side for the operations: both count."""
        return 2 * self.depth + 3 * self.operations, self.operations


class Arrangement:
    """States, constants, and what is made of them, as numbers to be calculated with.

    Of `states` names are given, and when each is known, in cycles. Without `expand`, products of sums (`times`) stay
    so.
    """

    def __init__(self, states: Sequence[tuple[str, int]], constants: Sequence[str] = (), expand: bool = True) -> None:
        self._expand = expand
        self._table, self._body = Recording(), _Body()
        self._constants = [self._table.input(name) for name in constants]
        self._known = self._body.known
        self._nodes: dict[int, Traced] = {}
        self._entries: dict[int, Traced] = {}
        self._from_table: list[Traced] = []
        self._plans: dict[Any, Plan] = {}
        self._powers: dict[int, tuple[int, int]] = {}
        self._searched = 0
        self._states: list[Traced] = []
        for name, ready in states:
            node = self._body.input(name)
            self._known[node.order] = ready
            self._states.append(node)
        self.states = [self.letter(node) for node in self._states]
        self.constants = [Polynomial(self, {(): x}) for x in self._constants]

    def finish(self, outputs: Sequence[Any]) -> Arranged:
        """Return the programs of outputs: numbers of `body`, see `written`."""
        body = Program([*self._states, *self._entries.values()], outputs)
        return Arranged(Program(self._constants, self._from_table), body)

    # polynomials --------------------------------------------------------------------------------------------------

    def number(self, x: Any) -> Any:
        return x if isinstance(x, Polynomial | Table) else Polynomial(self, {(): float(x)} if x != 0 else {})

    def letter(self, node: Any) -> Polynomial:
        """A number of the body as a polynomial."""
        if not isinstance(node, Traced):
            return self.number(node)
        self._nodes[node.order] = node
        return Polynomial(self, {((node.order, 1),): 1.0})

    def apply(self, name: str, args: Sequence[Polynomial]) -> Polynomial:
        constants = [x.constant for x in args]
        if all(c is not None for c in constants):
            value = apply(name, *constants)
            return Polynomial(self, {} if isinstance(value, float) and value == 0 else {(): value})
        if name in ("add", "sub", "neg"):
            *first, last = args
            return self._sum(first[0] if first else None, last, 1.0 if name == "add" else -1.0)
        if name in ("mul", "times"):
            return self._product(args[0], args[1], self._expand and name == "times")
        if name == "fma":
            return self._sum(self._product(args[0], args[1]), args[2], 1.0)
        if name == "pow" and constants[1] is not None and isinstance(constants[1], float):
            return self._power(args[0], constants[1])
        if name == "div":
            if constants[1] is not None:
                return self._product(args[0], Polynomial(self, {(): 1.0 / constants[1]}))
            if constants[0] is None or constants[0] != 1.0:
                return self._product(args[0], self.apply("div", [self.number(1.0), args[1]]))
            if (inverse := self._inverse(args[1])) is not None:
                return inverse
        node = self.operation(name, *[self.written(x) for x in args])
        if name in ("sqrt", "div") and isinstance(node, Traced) and isinstance(base := node.args[-1], Traced):
            self._nodes[base.order] = base
            self._powers |= {base.order: (base.order, 2), node.order: (base.order, 1 if name == "sqrt" else -2)}
        return self.letter(node)

    def _inverse(self, x: Polynomial) -> Polynomial | None:
        """1/x where x is a product of roots and reciprocals: the same of other powers."""
        if len(x.terms) != 1:
            return None
        ((m, c),) = x.terms.items()
        if not all(y in self._powers and self._powers[y][1] != 2 for y, _ in m):
            return None
        halves = {self._powers[y][0]: 0 for y, _ in m}
        for y, e in m:
            base, power = self._powers[y]
            halves[base] -= power * e
        return Polynomial(self, {self._of_halves(halves): 1.0 if c == 1.0 else 1.0 / c})

    def _reduced(self, m: Monomial) -> Monomial:
        """A product of letters in which a base, its root and its reciprocal do not cancel."""
        known = [(y, e) for y, e in m if y in self._powers]
        bases = [self._powers[y][0] for y, _ in known]
        if len(set(bases)) == len(bases) and not any(self._powers[y][1] == 1 and e > 1 for y, e in known):
            return m
        halves = dict.fromkeys(bases, 0)
        for y, e in known:
            base, power = self._powers[y]
            halves[base] += power * e
        return tuple(sorted([*((y, e) for y, e in m if y not in self._powers), *self._of_halves(halves)]))

    def _of_halves(self, halves: dict[int, int]) -> Monomial:
        """The product of bases to these powers, in halves: of the base, its root and its reciprocal."""
        made: list[tuple[int, int]] = []
        for base, n in halves.items():
            whole, root = (n // 2, n % 2)
            if root:
                made.append((self._made("sqrt", base), 1))
            if whole:
                made.append((base, whole) if whole > 0 else (self._made("div", base), -whole))
        return tuple(sorted(made))

    def _made(self, name: str, base: int) -> int:
        """The letter of the root or the reciprocal of a base."""
        args = [self._nodes[base]] if name == "sqrt" else [1.0, self._nodes[base]]
        node = self.operation(name, *args)
        self._nodes[node.order], self._powers[node.order] = node, (base, 1 if name == "sqrt" else -2)
        return node.order

    def _sum(self, a: Polynomial | None, b: Polynomial, sign: float) -> Polynomial:
        terms = dict(a.terms) if a is not None else {}
        for monomial, c in b.terms.items():
            total = terms.get(monomial, 0.0) + c if sign > 0 else terms.get(monomial, 0.0) - c
            if isinstance(total, float) and total == 0:
                terms.pop(monomial, None)
            else:
                terms[monomial] = total
        return Polynomial(self, terms)

    def _product(self, a: Polynomial, b: Polynomial, expand: bool = False) -> Polynomial:
        sums = (len(a.terms) > 1) + (len(b.terms) > 1)
        most = MOST_TERMS * expand if sums > 1 else MOST_SPREAD
        if len(a.terms) * len(b.terms) > most and a.constant is None and b.constant is None:
            a, b = (self.letter(self.written(x)) if len(x.terms) > 1 else x for x in (a, b))
        terms: Terms = {}
        for m, c in a.terms.items():
            for n, d in b.terms.items():
                key = self._reduced(_times(m, n))
                total = terms.get(key, 0.0) + c * d
                terms[key] = total
        return Polynomial(self, {m: c for m, c in terms.items() if not (isinstance(c, float) and c == 0)})

    def _power(self, a: Polynomial, n: float) -> Polynomial:
        if n % 1 or n < 0:
            return self.letter(self.operation("pow", self.written(a), n))
        if len(a.terms) > 1:
            a = self.letter(self.written(a))
        ((m, c),) = a.terms.items()
        return Polynomial(self, {self._reduced(tuple((x, int(e * n)) for x, e in m if n)): 1.0 if c == 1.0 else c**n})

    # the body -----------------------------------------------------------------------------------------------------

    def operation(self, name: str, *args: Any) -> Any:
        """An operation of the body."""
        return self._body.record(name, args)

    def depth(self, x: Any) -> int:
        """When a number of the body is known, in cycles; constants always were."""
        return self._body.depth(x)

    def coefficient(self, c: Any) -> Any:
        """A coefficient as a number of the body."""
        if not isinstance(c, Traced):
            return float(c)
        if c.order not in self._entries:
            self._entries[c.order] = self._body.input(f"c{len(self._entries)}")
            self._known[self._entries[c.order].order] = ALWAYS
            self._from_table.append(c)
        return self._entries[c.order]

    def node(self, x: Polynomial) -> Any:
        """The number of the body that a single letter stands for."""
        (((order, _),),) = x.terms
        return self._nodes[order]

    def written(self, x: Polynomial | Table | float) -> Any:
        """Write a polynomial into the body, with a short chain, and return its number; that of a constant is itself."""
        return x if isinstance(x, float | Table) else self._plan(x.terms).write()

    def moved(self, base: Any, factor: Any, x: Any) -> Any:
        """base + factor·x, of numbers of the body, with the shortest chain.

        Where x is u·v + w, it is (factor·u)·v + (base + factor·w) as well, which does not wait for x. Constants alone
        are not multiplied by the factor before: their product would be rounded alike in each step.
        """
        return self._moved(base, factor, x).write()

    def _moved(self, base: Any, factor: Any, x: Any, level: int = 4) -> Plan:
        ready = max(self.depth(base), self.depth(factor), self.depth(x)) + FUSED
        plain = Plan(ready, 1, lambda: self.operation("fma", factor, x, base))
        if not level or not isinstance(x, Traced) or x.name not in ("fma", "add"):
            return plain
        if x.name == "add":
            first, last = sorted(x.args, key=self.depth)
            rest = self._moved(base, factor, first, level - 1)
            depth = max(self.depth(last), rest.depth) + FUSED
            joined = Plan(depth, rest.operations + 1, lambda: self.operation("fma", factor, last, rest.write()))
        else:
            u, v = sorted(x.args[:2], key=self.depth)
            if self.depth(u) <= ALWAYS:
                return plain
            rest = self._moved(base, factor, x.args[2], level - 1)
            depth = max(self.depth(u) + PRODUCT + FUSED, self.depth(v) + FUSED, rest.depth + FUSED)

            def write() -> Any:
                return self.operation("fma", self.operation("mul", factor, u), v, rest.write())

            joined = Plan(depth, rest.operations + 2, write)
        return min(plain, joined, key=lambda plan: plan.cost)

    # nesting ------------------------------------------------------------------------------------------------------

    def _plan(self, terms: Terms) -> Plan:
        key = frozenset((m, c if isinstance(c, float) else (c.order,)) for m, c in terms.items())
        plan = self._plans.get(key)
        if plan is None:
            plan = self._plans[key] = self._best(terms)
        return plan

    def _best(self, terms: Terms) -> Plan:
        if not terms:
            return Plan(ALWAYS, 0, lambda: 0.0)
        if len(terms) == 1:
            ((m, c),) = terms.items()
            return self._one(m, c)
        few = len(terms) <= MOST_TRIED and self._searched < MOST_SEARCHED
        self._searched += few
        plans = (plan for m in self._factors(terms, few) for plan in self._nested(terms, m))
        return min(plans, key=lambda plan: plan.cost if few else plan.cost[::-1])

    def _factors(self, terms: Terms, few: bool) -> list[Monomial]:
        """Products of letters to take out: those that terms share, and the last known of a term that shares none."""
        single = _powers_of_one(terms)
        if single is not None:
            x, powers = single
            step = math.gcd(*powers)
            if powers[0] > 0 or step == powers[-1]:
                return [((x, powers[0] or step),)]
            doubled: list[Monomial] = [((x, step * 2**k),) for k in range((powers[-1] // step).bit_length())]
            return doubled if few else doubled[-1:]
        counts: dict[Monomial, int] = {}
        for m in terms:
            for i, (x, e) in enumerate(m):
                for power in range(1, min(e, 2) + 1):
                    counts[(x, power),] = counts.get(((x, power),), 0) + 1
                if few:
                    for y, _ in m[i + 1 :]:
                        counts[(x, 1), (y, 1)] = counts.get(((x, 1), (y, 1)), 0) + 1
        if few:
            shared = [m for m, n in counts.items() if n > 1]
            alone = [m for m in terms if m and not any(_divides(factor, m) for factor in shared)]
            last = max(((self._known[x], x) for m in alone for x, _ in m), default=None)
            return [*shared, *([] if last is None else [((last[1], 1),)])]
        return sorted((m for m in counts if m[0][1] == 1), key=lambda m: -counts[m])[:1]

    def _nested(self, terms: Terms, factor: Monomial) -> Iterator[Plan]:
        """factor·A + B, in one operation or in two, whose last one may wait less."""
        inside = {_without(m, factor): c for m, c in terms.items() if _divides(factor, m)}
        outside = {m: c for m, c in terms.items() if not _divides(factor, m)}
        x, A, B = self._one(factor, 1.0), self._plan(inside), self._plan(outside)
        if len(factor) == 1 and factor[0][1] > 2:  # powers of a polynomial in one letter, which others share
            x = x._replace(operations=0)
        both, operations = max(x.depth, A.depth), x.operations + A.operations + B.operations

        def product() -> Any:
            return self.operation("mul", x.write(), A.write())

        if not outside:
            yield Plan(both + PRODUCT, operations + 1, product)
        elif len(inside) == 1 and _is_one(inside.get(())):
            yield Plan(max(x.depth, B.depth) + SUM, operations + 1, lambda: self.operation("add", x.write(), B.write()))
        else:
            yield Plan(
                max(both, B.depth) + FUSED,
                operations + 1,
                lambda: self.operation("fma", x.write(), A.write(), B.write()),
            )
            yield Plan(
                max(both + PRODUCT, B.depth) + SUM, operations + 2, lambda: self.operation("add", product(), B.write())
            )

    def _one(self, m: Monomial, c: Any) -> Plan:
        """A coefficient times letters: two numbers that are known first are multiplied first."""
        factors = [(self._known[x], (x, 1)) for x, e in m for _ in range(e)]
        if not factors:
            return Plan(ALWAYS, 0, lambda: self.coefficient(c))
        depth, operations = _folded([d for d, _ in factors] + ([] if _is_one(c) else [ALWAYS]))

        def write() -> Any:
            items = [(d, i, self._nodes[x]) for i, (d, (x, _)) in enumerate(sorted(factors))]
            if not _is_one(c):
                items.append((ALWAYS, -1, self.coefficient(c)))
            while len(items) > 1:
                items.sort(key=lambda item: item[:2])
                (d, i, a), (e, _, b) = items[:2]
                items[:2] = [(max(d, e) + PRODUCT, i, self.operation("mul", a, b))]
            return items[0][2]

        return Plan(depth, operations, write)


ALWAYS = -1000  # when constants are known
SUM, PRODUCT, FUSED = (FUNCTIONS[name].cost for name in ("add", "mul", "fma"))


def _folded(depths: list[int]) -> tuple[int, int]:
    """When the product of numbers is known that are known at these depths, and its operations."""
    depths, operations = sorted(depths), 0
    while len(depths) > 1:
        depths = sorted([max(depths[:2]) + PRODUCT, *depths[2:]])
        operations += 1
    return depths[0], operations


def _times(m: Monomial, n: Monomial) -> Monomial:
    powers = dict(m)
    for x, e in n:
        powers[x] = powers.get(x, 0) + e
    return tuple(sorted(powers.items()))


def _powers_of_one(terms: Terms) -> tuple[int, list[int]] | None:
    """The letter of a polynomial in one, and its powers in order; None where there are more letters."""
    letters = {x for m in terms for x, _ in m}
    if len(letters) != 1:
        return None
    return letters.pop(), sorted(m[0][1] if m else 0 for m in terms)


def _divides(factor: Monomial, m: Monomial) -> bool:
    powers = dict(m)
    return all(powers.get(x, 0) >= e for x, e in factor)


def _without(m: Monomial, factor: Monomial) -> Monomial:
    powers = dict(m)
    for x, e in factor:
        powers[x] -= e
    return tuple((x, e) for x, e in powers.items() if e)


def _is_one(c: Any) -> bool:
    return isinstance(c, float) and c == 1.0
