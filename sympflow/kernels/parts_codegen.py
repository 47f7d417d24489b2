"""From the parts of a symbolic system to the source of their flows, on tuples of normal modes."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from sympflow.hamiltonian.parts import ExactParts
from sympflow.kernels.codegen import tuple_algebra
from sympflow.kernels.part_flows import PRODUCT, TURN_WIDTH, PartFlow, linear_flow, part_flow, unpacked

__all__ = ["IDLE", "WITH_GRADIENT", "parts_source"]

IDLE = -1  # code of no map
WITH_GRADIENT = 100  # added to the code of a part that carries a force gradient


def parts_source(parts: ExactParts, filters: bool, gradients: bool) -> str:
    """The functions that `parts_loops` asks for.

    A row of the table has `ROW_WIDTH` numbers: six for each frequency; or a weight, a force gradient and the filters
    of the modes, and then products of these, which ``fill_rows`` computes.

    Raises
    ------
    ValueError
        If a function in H has no counterpart in compiled code.
    """
    d = parts.ndof
    flows = []
    if parts.linear is not None:
        flows.append(linear_flow(parts))
    for k, part in enumerate(parts.rest, 1):
        flows.append(part_flow(parts, part, k, f"part_{k}", filters))
        if gradients and part.of_positions:
            flows.append(part_flow(parts, part, WITH_GRADIENT + k, f"gradient_{k}", filters, gradient=True))
    width = max([2 + d, TURN_WIDTH * parts.n_classes, *(flow.width for flow in flows)])
    constants = f"NDOF = {d}\nROW_WIDTH = {width}\nN_CLASSES = {parts.n_classes}\nFILTERS = {filters}"
    functions = [constants, tuple_algebra(d), *_between_modes(parts), *(flow.source for flow in flows)]
    functions += [_dispatch(flows), _dispatch_lanes(flows), _fill(flows), _dispatch_each(flows), _turns_each(parts)]
    functions.append(_filters_each(parts))
    return "\n\n\n".join(functions) + "\n"


def _dispatch(flows: Sequence[PartFlow]) -> str:
    lines = ["@njit(**OPTIONS, forceinline=True)", "def apply_map(x, y, code, table, j):"]
    for flow in flows:
        lines += [f"    if code == {flow.code}:", f"        return {flow.name}(x, y, {flow.arguments})"]
    return "\n".join([*lines, "    return x, y"])


def _dispatch_lanes(flows: Sequence[PartFlow]) -> str:
    lines = ["@njit(**OPTIONS, inline='always')", "def apply_map_lanes(Z, width, code, table, j):"]
    for number, flow in enumerate(flows):
        lines += [
            f"    {'elif' if number else 'if'} code == {flow.code}:",
            f"        c = {flow.arguments}",
            "        for lane in range(width):",
            "            x, y = unpack_lane(Z, lane)",
            f"            x, y = {flow.name}(x, y, c)",
            "            pack_lane(x, y, Z, lane)",
        ]
    return "\n".join(lines)


def _dispatch_each(flows: Sequence[PartFlow]) -> str:
    """The same where each lane has a row of its own, in the lines of Z from `TABLE` on; products are made here."""
    lines = ["@njit(**OPTIONS, inline='always')", "def apply_map_each(Z, width, code):"]
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
    """What turns each frequency by Ω s, as `shears` and the kernel's tables have it, s in the lines from `NUMBERS` on.

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
        lines = ["@njit(**OPTIONS, forceinline=True)", f"def {name}(x, y):", *unpacked(parts.ndof)]
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
