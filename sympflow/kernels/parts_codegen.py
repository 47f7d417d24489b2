"""The flows of the exactly solvable parts of a symbolic system as source, on tuples of normal modes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import sympy as sp

from sympflow.hamiltonian.parts import LINEAR, ExactParts, PartFunctions
from sympflow.hamiltonian.symbolic import printable
from sympflow.kernels.codegen import printed, statements
from sympflow.kernels.scheduling import FUSED, Schedule
from sympflow.kernels.stage_times import in_code, letters_of_time, sampled_sources

__all__ = ["IDLE", "TURN_WIDTH", "WITH_GRADIENT", "parts_source"]

IDLE = -1  # code of no map
WITH_GRADIENT = 100  # added to the code of a part that carries a force gradient
TURN_WIDTH = 6  # numbers that turn a frequency
PRODUCT = "fused_multiply_add"  # of `elementary`


def parts_source(parts: ExactParts, filters: bool, gradients: bool) -> str:
    """The functions that `parts_loops` asks for.

    A row of the table has `ROW_WIDTH` numbers: six for each frequency; or a weight, a force gradient and the filters
    of the modes, and then products of these, which ``fill_rows`` computes. Where H depends on t three more follow: the
    time of the map after the beginning of a step, that of the run, and the step.

    Raises
    ------
    ValueError
        If a function in H has no counterpart in compiled code.
    """
    d = parts.ndof
    flows = []
    if parts.linear is not None:
        flows.append(_linear_flow(parts))
    letters = []
    for k, part in enumerate(parts.rest, 1):
        letters += _letters_source(part, k)
        flows.append(_part_flow(parts, part, k, f"part_{k}", filters))
        if gradients and part.of_positions:
            flows.append(_part_flow(parts, part, WITH_GRADIENT + k, f"gradient_{k}", filters, gradient=True))
    width = max([2 + d, TURN_WIDTH * parts.n_classes, *(flow.width for flow in flows)])
    constants = f"ROW_WIDTH = {width}\nN_CLASSES = {parts.n_classes}\nFILTERS = {filters}"
    functions = [constants, *_between_modes(parts), *letters, *(flow.source for flow in flows)]
    functions += [_dispatch(flows), _dispatch_lanes(flows), _fill(flows), _dispatch_each(flows), _turns_each(parts)]
    functions.append(_filters_each(parts))
    return "\n\n\n".join(functions) + "\n"


@dataclass(frozen=True)
class PartFlow:
    """The flow of a part as code: its name, what it reads of a row of the table, and what it stores there before.

    Attributes
    ----------
    letters : sequence of str
        Names of what depends on t alone, computed once for all lanes by the function of the part that `timed_by` names.
    """

    code: int
    name: str
    source: str
    row: Sequence[int]
    stored: list[str] = field(default_factory=list)
    width: int = 0
    letters: Sequence[str] = ()
    timed_by: str = ""

    @property
    def arguments(self) -> str:
        return "(" + "".join(f"{value}, " for value in (*(f"table[j, {i}]" for i in self.row), *self.letters)) + ")"

    def drawn(self, indent: str) -> list[str]:
        """The line that computes the letters for row j of step k, if there are some."""
        if not self.letters:
            return []
        time = "table[j, ROW_WIDTH + 1] + (k * table[j, ROW_WIDTH + 2] + table[j, ROW_WIDTH])"
        return [f"{indent}{', '.join(self.letters)}, = {self.timed_by}({time})"]


def _lettered(part: PartFunctions, code: int) -> tuple[sp.Expr, dict[sp.Expr, sp.Symbol]]:
    """H_k with letters for what depends on t alone, and these."""
    found: dict[sp.Expr, sp.Symbol] = {}
    if not part.timed:
        return part.H, found
    assert part.time is not None
    return letters_of_time(part.H, part.time, set(), found, f"letter_{code}"), found


def _letters_source(part: PartFunctions, code: int) -> list[str]:
    """``letters_k(time)`` of part k, with the functions of samples that it calls."""
    _, letters = _lettered(part, code)
    if not letters:
        return []
    assert part.time is not None
    names = [s.name for s in letters.values()]
    lines = statements(names, [in_code(f, part.time, "time") for f in letters])
    head = ["@njit(**OPTIONS)", f"def letters_{code}(time):"]
    body = [f"    {line}" for line in lines]
    return [
        *sampled_sources([*letters], part.samples),
        "\n".join([*head, *body, f"    return ({''.join(f'{name}, ' for name in names)})"]),
    ]


def _linear_flow(parts: ExactParts) -> PartFlow:
    """Rotations by three shears after exact quarter turns, hyperbolic ones by shears alone, drifts."""
    assert parts.linear is not None
    d = parts.ndof
    lines = ["@njit(**OPTIONS, forceinline=True)", "def linear(x, y, c):", *_unpacked(d)]
    for j, (kind, f) in enumerate(zip(parts.linear.kinds, parts.linear.classes.tolist(), strict=True)):
        t, s, c, d_, a, b = (f"c[{TURN_WIDTH * f + i}]" for i in range(TURN_WIDTH))
        if kind == "free":
            lines.append(f"    x_{j} += 2.0 * {t} * y_{j}")
        elif kind == "hyperbolic":
            lines += [f"    x_{j} += {t} * y_{j}", f"    y_{j} -= {s} * x_{j}", f"    x_{j} += {t} * y_{j}"]
        elif kind == "oscillator":  # of each pair of products that are added first, one is 0 and the other exact
            lines += [
                f"    turned_{j} = {c} * y_{j} - {d_} * x_{j}",
                f"    x_{j} = {PRODUCT}({b}, y_{j}, {a} * x_{j})",  # y comes from a kick, later than x
                f"    y_{j} = turned_{j} - {s} * x_{j}",
                f"    x_{j} += {t} * y_{j}",
            ]
    return PartFlow(LINEAR, "linear", "\n".join([*lines, _returned(d)]), range(TURN_WIDTH * parts.n_classes))


def _known(parts: ExactParts) -> tuple[list[float], list[float]]:
    """When positions and momenta of the modes are known, in cycles, after a linear map that follows a kick."""
    kinds = ("idle",) * parts.ndof if parts.linear is None else parts.linear.kinds
    turns = [kind in ("oscillator", "hyperbolic") for kind in kinds]
    return [FUSED * (3 if t else kind == "free") for t, kind in zip(turns, kinds, strict=True)], [
        FUSED * (2 if t else 0) for t in turns
    ]


def _part_flow(
    parts: ExactParts, part: PartFunctions, code: int, name: str, filters: bool, gradient: bool = False
) -> PartFlow:
    """x + b J∇H_k(x), and with a force gradient g ∇²U M⁻¹∇U added to y, of a row b, g, φ …"""
    d, q, p = parts.ndof, part.q, part.p
    number = code % WITH_GRADIENT
    H, of_time = _lettered(part, number)
    letters = list(of_time.values())
    x, y, z = (sp.symbols(f"{letter}_0:{d}", real=True) for letter in "xyz")
    b, g = sp.symbols("b_ g_", real=True)
    phi = sp.symbols(f"phi_0:{d}", real=True) if filters else (sp.S.One,) * d
    C = np.eye(d) if filters and parts.diagonal else parts.C  # diagonal ones are in the filters
    positions, momenta = _known(parts)
    known = dict(zip((*x, *y), positions + momenta, strict=True)) | dict.fromkeys(letters, 0.0)
    schedule = Schedule(known, printed, "s_", PRODUCT)
    at = {
        q[i]: sp.Add(_number(parts.center[i]), *(_number(C[i, j]) * phi[j] * x[j] for j in range(d))) for i in range(d)
    } | {p[i]: sp.Add(*(_number(parts.inverse_C[j, i]) * y[j] for j in range(d))) for i in range(d)}
    by_q, by_p = ([sp.diff(H, s) for s in symbols] for symbols in (q, p))
    products = [sp.factor_terms(f) for f in _hessian_vector(H, q, z)] if gradient else []
    shared, reduced = sp.cse(
        [printable(f).xreplace(at) for f in (*by_q, *by_p, *products)],
        symbols=sp.numbered_symbols("common_", real=True),
        list=True,
        order="none",
    )
    shared, reduced = _with_products(shared, reduced, {*x, *y, *z})
    late: set[sp.Symbol] = set(z)  # what holds the direction z, known after the slopes
    waiting: list[tuple[sp.Symbol, sp.Expr]] = []
    for symbol, f in shared:
        if f.free_symbols & late:
            late.add(symbol)
            waiting.append((symbol, f))
        else:
            schedule.define(symbol, f)
    slope, velocity, product = reduced[:d], reduced[d : 2 * d], reduced[2 * d :]
    force = [sp.Add(*(_number(C[i, j]) * slope[i] for i in range(d))) for j in range(d)]
    moved = [sp.Add(*(_number(parts.inverse_C[j, i]) * velocity[i] for i in range(d))) for j in range(d)]
    new_x = [x[j] + sp.Mul(b, moved[j], evaluate=False) if moved[j] != 0 else x[j] for j in range(d)]
    new_y = [y[j] + sp.Mul(-b * phi[j], force[j], evaluate=False) if force[j] != 0 else y[j] for j in range(d)]
    if gradient:
        rates = parts.linear.rates if parts.linear else C[0]
        direction = [sp.Mul(_number(rates[j]) * phi[j] ** 2, force[j], evaluate=False) for j in range(d)]
        for i in range(d):
            schedule.define(z[i], sp.Add(*(sp.Mul(_number(C[i, j]), direction[j], evaluate=False) for j in range(d))))
        for symbol, f in waiting:
            schedule.define(symbol, f)
        for j in range(d):
            bent = sp.Add(*(_number(C[i, j]) * product[i] for i in range(d)))
            if bent != 0:
                new_y[j] = sp.Add(new_y[j], sp.Mul(g * phi[j], bent, evaluate=False), evaluate=False)
    results = [[schedule.value(f)[1] for f in values] for values in (new_x, new_y)]
    raw = ["b_", "g_", *(f"phi_{j}" for j in range(d) if filters)]
    body = [f"    {line}" for line in schedule.lines]
    body.append("    return " + ", ".join(f"({''.join(f'{value}, ' for value in values)})" for values in results))
    used = set(re.findall(r"\w+", "\n".join(body)))
    stored = [line.partition(" = ")[0] for line in schedule.early]
    stored = [name for name in stored if name in used]
    place = {name: i for i, name in enumerate([*raw, *stored])}
    row = [n for n in place if n in used]
    lines = ["@njit(**OPTIONS, forceinline=True)", f"def {name}(x, y, c):", *_unpacked(d)]
    lines += [f"    {n} = c[{i}]" for i, n in enumerate([*row, *(s.name for s in letters)])]
    fill = [f"{n} = row[{i}]" for i, n in enumerate(raw)] + schedule.early
    fill += [f"row[{place[n]}] = {n}" for n in stored]
    source = "\n".join([*lines, *body])
    names = [s.name for s in letters]
    columns = [place[n] for n in row]
    return PartFlow(code, name, source, columns, fill if stored else [], len(place), names, f"letters_{number}")


def _with_products(
    shared: Sequence[tuple[sp.Symbol, sp.Expr]], reduced: Sequence[sp.Expr], variables: set[sp.Symbol]
) -> tuple[list[tuple[sp.Symbol, sp.Expr]], list[sp.Expr]]:
    """Common subexpressions without those that are one variable times numbers: fused, they cost nothing where used."""
    known: set[sp.Symbol] = set()
    inlined: dict[sp.Symbol, sp.Expr] = {}
    kept = []
    for symbol, f in shared:
        value = f.xreplace(inlined)
        numbers = [v for v in value.free_symbols if v not in variables and v not in known]
        if value.is_Mul and len(numbers) == len(value.free_symbols) - 1 and value.free_symbols & variables:
            inlined[symbol] = value
        else:
            known.add(symbol)
            kept.append((symbol, value))
    return kept, [f.xreplace(inlined) for f in reduced]


def _hessian_vector(H: sp.Expr, q: Sequence[sp.Symbol], z: Sequence[sp.Symbol]) -> list[sp.Expr]:
    """∇²H z, as the slope of the derivative of H along z: that keeps powers of sums together."""
    eps = sp.Symbol("eps_", real=True)
    moved = H.xreplace({x: x + eps * v for x, v in zip(q, z, strict=True) if H.has(x)})
    along = sp.diff(moved, eps).subs(eps, 0)
    return [sp.diff(along, x) for x in q]


def _number(value: float) -> sp.Expr:
    return sp.Integer(int(value)) if value == int(value) else sp.Float(value)


def _unpacked(d: int) -> list[str]:
    return [f"    {', '.join(f'{v}_{j}' for j in range(d))}, = {v}" for v in "xy"]


def _returned(d: int) -> str:
    return "    return " + ", ".join("(" + "".join(f"{v}_{j}, " for j in range(d)) + ")" for v in "xy")


# the functions that apply them ------------------------------------------------------------------------------------


def _dispatch(flows: Sequence[PartFlow]) -> str:
    lines = ["@njit(**OPTIONS, forceinline=True)", "def apply_map(x, y, code, table, j, k):"]
    for flow in flows:
        lines += [f"    if code == {flow.code}:", *flow.drawn("        ")]
        lines.append(f"        return {flow.name}(x, y, {flow.arguments})")
    return "\n".join([*lines, "    return x, y"])


def _dispatch_lanes(flows: Sequence[PartFlow]) -> str:
    lines = ["@njit(**OPTIONS, inline='always')", "def apply_map_lanes(Z, width, code, table, j, k):"]
    for number, flow in enumerate(flows):
        lines += [
            f"    {'elif' if number else 'if'} code == {flow.code}:",
            *flow.drawn("        "),
            f"        c = {flow.arguments}",
            "        for lane in range(width):",
            "            x, y = unpack_lane(Z, lane)",
            f"            x, y = {flow.name}(x, y, c)",
            "            pack_lane(x, y, Z, lane)",
        ]
    return "\n".join(lines)


def _dispatch_each(flows: Sequence[PartFlow]) -> str:
    """The same where each lane has a row of its own, in the lines of Z from `TABLE` on; products are made here.

    There is none of parts that depend on t, whose maps no flow has as functions of its time.
    """
    lines = ["@njit(**OPTIONS, inline='always')", "def apply_map_each(Z, width, code):"]
    if any(flow.letters for flow in flows):
        return "\n".join([*lines, "    raise ValueError('a part depends on t')"])
    for number, flow in enumerate(flows):
        lines += [f"    {'elif' if number else 'if'} code == {flow.code}:", "        for lane in range(width):"]
        lines += ["            " + re.sub(r"row\[(\d+)\]", r"Z[TABLE + \1, lane]", line) for line in flow.stored]
        arguments = "".join(f"Z[TABLE + {i}, lane], " for i in flow.row)
        lines += [
            "            x, y = unpack_lane(Z, lane)",
            f"            x, y = {flow.name}(x, y, ({arguments}))",
            "            pack_lane(x, y, Z, lane)",
        ]
    return "\n".join(lines)


def _turns_each(parts: ExactParts) -> str:
    """Six numbers that turn each frequency by Ω s, as `PartsLoops.table` has them, s in the lines from `NUMBERS` on.

    θ = Ω s is reduced with the rounding of the product added again, tan(r/2) is sin r/(1 + cos r).
    """
    lines = ["@njit(**OPTIONS, inline='always')", "def fill_turns(Z, width):"]
    linear = parts.linear
    for f, j in enumerate([] if linear is None else linear.representatives.tolist()):
        assert linear is not None
        kind, rate, row = linear.kinds[j], float(linear.rates[j]), f"TABLE + {TURN_WIDTH * f}"
        lines += ["    for lane in range(width):", f"        s = Z[NUMBERS + {f}, lane]"]
        if kind == "free":
            lines += [f"        Z[{row}, lane] = s / 2.0"]
        elif kind == "hyperbolic":
            lines += [
                f"        Z[{row}, lane] = math.tanh({rate!r} * s / 2.0)",
                f"        Z[{row} + 1, lane] = -math.sinh({rate!r} * s)",
            ]
        elif kind == "oscillator":
            lines += [
                f"        theta = {rate!r} * s",
                "        r, n = reduced(theta)",
                f"        r += {PRODUCT}({rate!r}, s, -theta)",
                f"        r = 0.0 if abs(r) <= {4 * np.finfo(float).eps!r} * abs(theta) else r",
                "        sine, cosine = sin_of_quadrant(r, 0), sin_of_quadrant(r, 1)",
                "        tangent, quarter = sine / (1.0 + cosine), n & 3",
                "        c = 1.0 if quarter == 0 else (-1.0 if quarter == 2 else 0.0)",
                "        d = 1.0 if quarter == 1 else (-1.0 if quarter == 3 else 0.0)",
                f"        Z[{row}, lane], Z[{row} + 1, lane] = tangent, sine",
                f"        Z[{row} + 2, lane], Z[{row} + 3, lane] = c, d",
                f"        Z[{row} + 4, lane], Z[{row} + 5, lane] = c - tangent * d, d + tangent * c",
            ]
    return "\n".join([*lines, "    return"])


def _filters_each(parts: ExactParts) -> str:
    """φ of the modes, times their C where each is a coordinate, from those of the frequencies."""
    scale = np.diag(parts.C).tolist() if parts.diagonal else [1.0] * parts.ndof
    lines = ["@njit(**OPTIONS, inline='always')", "def fill_filters(Z, width):", "    for lane in range(width):"]
    for j, (f, factor) in enumerate(zip(parts.classes.tolist(), scale, strict=True)):
        lines.append(f"        Z[TABLE + {2 + j}, lane] = {factor!r} * Z[NUMBERS + {2 + f}, lane]")
    return "\n".join(lines)


def _fill(flows: Sequence[PartFlow]) -> str:
    """The products of weights, force gradients and filters, which no state waits for, computed once for a run."""
    lines = ["@njit(**OPTIONS)", "def fill_rows(codes, tables):", "    for i in range(tables.shape[0]):"]
    lines.append("        for j in range(len(codes)):")
    for flow in flows:
        if flow.stored:
            lines += [f"            if codes[j] == {flow.code}:", "                row = tables[i, j]"]
            lines += [f"                {line}" for line in flow.stored]
    return "\n".join([*lines, "            pass"])


def _between_modes(parts: ExactParts) -> list[str]:
    """``to_modes`` and ``from_modes``; where modes are mixed nothing, as they are transformed outside the loops."""

    def function(name: str, values: Sequence[str], others: Sequence[str]) -> str:
        lines = ["@njit(**OPTIONS, forceinline=True)", f"def {name}(x, y):", *_unpacked(parts.ndof)]
        results = ["".join(f"{value}, " for value in group) for group in (values, others)]
        return "\n".join([*lines, f"    return ({results[0]}), ({results[1]})"])

    if not parts.diagonal:
        kept = [[f"{v}_{j}" for j in range(parts.ndof)] for v in "xy"]
        return [function("to_modes", *kept), function("from_modes", *kept)]
    center, C, inverse_C = (a.tolist() for a in (parts.center, np.diag(parts.C), np.diag(parts.inverse_C)))

    def scaled(value: str, factor: float) -> str:
        return value if factor == 1 else f"{value}*{factor!r}"

    moved = [f"x_{j}" if c == 0 else f"(x_{j} - {c!r})" for j, c in enumerate(center)]
    back = [scaled(f"x_{j}", s) for j, s in enumerate(C)]
    return [
        function("to_modes", [*map(scaled, moved, inverse_C)], [scaled(f"y_{j}", s) for j, s in enumerate(C)]),
        function(
            "from_modes",
            [x if c == 0 else f"{x} + {c!r}" for x, c in zip(back, center, strict=True)],
            [scaled(f"y_{j}", s) for j, s in enumerate(inverse_C)],
        ),
    ]
