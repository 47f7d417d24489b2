"""From the parts of a symbolic system to the source of their flows, on tuples of normal modes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import sympy as sp

from sympflow.kernels.codegen import printed, tuple_algebra
from sympflow.kernels.scheduling import FUSED, Schedule
from sympflow.parts import LINEAR, ExactParts, PartFunctions
from sympflow.symbolic import printable

__all__ = ["IDLE", "WITH_GRADIENT", "parts_source", "row_width"]

IDLE = -1  # code of no map
TURN_WIDTH = 6  # numbers that turn a frequency
WITH_GRADIENT = 100  # added to the code of a part that carries a force gradient


def row_width(parts: ExactParts) -> int:
    """Numbers that a map may need: six for each frequency, or a weight, a force gradient and the filters of modes."""
    return max(TURN_WIDTH * parts.n_classes, 2 + parts.ndof)


def parts_source(parts: ExactParts, filters: bool, gradients: bool) -> str:
    """The functions that `parts_loops` asks for.

    Raises
    ------
    ValueError
        If a function in H has no counterpart in compiled code.
    """
    d = parts.ndof
    functions = [f"NDOF = {d}", tuple_algebra(d)]
    calls: list[tuple[int, str]] = []
    if parts.linear is not None:
        functions.append(_linear(parts))
        calls.append((LINEAR, "linear"))
    for k, part in enumerate(parts.rest, 1):
        functions.append(_part(parts, part, f"part_{k}", filters))
        calls.append((k, f"part_{k}"))
        if gradients and part.of_positions:
            functions.append(_part(parts, part, f"gradient_{k}", filters, gradient=True))
            calls.append((WITH_GRADIENT + k, f"gradient_{k}"))
    width = row_width(parts)
    row = "(" + "".join(f"table[j, {i}], " for i in range(width)) + ")"
    functions += [_dispatch(calls, row), _dispatch_lanes(calls, row)]
    return "\n\n\n".join(functions) + "\n"


def _dispatch(calls: Sequence[tuple[int, str]], row: str) -> str:
    lines = ["@njit(**OPTIONS, forceinline=True)", "def apply_map(x, y, code, table, j):"]
    for code, name in calls:
        lines += [f"    if code == {code}:", f"        return {name}(x, y, {row})"]
    return "\n".join([*lines, "    return x, y"])


def _dispatch_lanes(calls: Sequence[tuple[int, str]], row: str) -> str:
    lines = ["@njit(**OPTIONS, inline='always')", "def apply_map_lanes(Z, width, code, table, j):"]
    for number, (code, name) in enumerate(calls):
        lines += [
            f"    {'elif' if number else 'if'} code == {code}:",
            f"        c = {row}",
            "        for lane in range(width):",
            "            x, y = unpack_lane(Z, lane)",
            f"            x, y = {name}(x, y, c)",
            "            pack_lane(x, y, Z, lane)",
        ]
    return "\n".join(lines)


def _linear(parts: ExactParts) -> str:
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
                f"    x_{j} = {a} * x_{j} + {b} * y_{j}",
                f"    y_{j} = turned_{j} - {s} * x_{j}",
                f"    x_{j} += {t} * y_{j}",
            ]
    return "\n".join([*lines, _returned(d)])


def _part(parts: ExactParts, part: PartFunctions, name: str, filters: bool, gradient: bool = False) -> str:
    """x + b J∇H_k(x), and with a force gradient g ∇²U M⁻¹∇U added to y; c = [b, g, φ …]."""
    d, q, p = parts.ndof, part.q, part.p
    x, y, z = (sp.symbols(f"{letter}_0:{d}", real=True) for letter in "xyz")
    b, g = sp.symbols("b_ g_", real=True)
    phi = sp.symbols(f"phi_0:{d}", real=True) if filters else (sp.S.One,) * d
    C = np.eye(d) if filters and parts.diagonal else parts.C  # diagonal ones are in the filters
    # Of the map before, momenta are known before positions.
    schedule = Schedule({**dict.fromkeys(x, 0.0), **dict.fromkeys(y, -FUSED)}, printed, "s_")
    at = {
        q[i]: sp.Add(_number(parts.center[i]), *(_number(C[i, j]) * phi[j] * x[j] for j in range(d))) for i in range(d)
    } | {p[i]: sp.Add(*(_number(parts.inverse_C[j, i]) * y[j] for j in range(d))) for i in range(d)}
    by_q, by_p = ([sp.diff(part.H, s) for s in symbols] for symbols in (q, p))
    products = [sp.factor_terms(f) for f in _hessian_vector(part.H, q, z)] if gradient else []
    shared, reduced = sp.cse(
        [printable(f).xreplace(at) for f in (*by_q, *by_p, *products)],
        symbols=sp.numbered_symbols("common_", real=True),
        list=True,
        order="none",
    )
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
    body = [*schedule.early, *schedule.lines]
    lines = ["@njit(**OPTIONS, forceinline=True)", f"def {name}(x, y, c):", *_unpacked(d)]
    lines += ["    b_, g_, = c[0], c[1]", *(f"    phi_{j} = c[{2 + j}]" for j in range(d) if filters)]
    lines += [f"    {line}" for line in body]
    lines.append("    return " + ", ".join(f"({''.join(f'{value}, ' for value in values)})" for values in results))
    return "\n".join(lines)


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
