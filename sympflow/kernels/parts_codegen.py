"""From the parts of a symbolic system to the source of their flows, on tuples of normal modes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import sympy as sp
from sympy.printing.codeprinter import PrintMethodNotImplementedError

from sympflow.kernels.codegen import _KernelPrinter, tuple_algebra
from sympflow.parts import LINEAR, ExactParts, PartFunctions
from sympflow.symbolic import printable

__all__ = ["IDLE", "WITH_GRADIENT", "parts_source", "row_width"]

IDLE = -1  # code of no map
WITH_GRADIENT = 100  # added to the code of a part that carries a force gradient


def row_width(parts: ExactParts) -> int:
    """Numbers that a map may need: four for each frequency, or a weight, a force gradient and the filters of modes."""
    return max(4 * parts.n_classes, 2 + parts.ndof)


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
    lines = ["@njit(**OPTIONS)", "def apply_map(x, y, code, table, j):"]
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
    """Rotations by three shears after a half turn or none (a sign), hyperbolic ones likewise, drifts."""
    assert parts.linear is not None
    d = parts.ndof
    lines = ["@njit(**OPTIONS)", "def linear(x, y, c):", *_unpacked(d)]
    for j, (kind, f) in enumerate(zip(parts.linear.kinds, parts.linear.classes.tolist(), strict=True)):
        t, s, sign, signed_t = (f"c[{4 * f + i}]" for i in range(4))
        if kind == "free":
            lines.append(f"    x_{j} += {t} * y_{j}")
        elif kind != "idle":
            lines += [
                f"    x_{j} = {sign} * x_{j} + {signed_t} * y_{j}",
                f"    y_{j} = {sign} * y_{j} - {s} * x_{j}",
                f"    x_{j} += {t} * y_{j}",
            ]
    return "\n".join([*lines, _returned(d)])


def _part(parts: ExactParts, part: PartFunctions, name: str, filters: bool, gradient: bool = False) -> str:
    """x + b J∇H_k(x), and with a force gradient g ∇²U M⁻¹∇U added to y."""
    d, q, p = parts.ndof, part.q, part.p
    lines = ["@njit(**OPTIONS)", f"def {name}(x, y, c):", *_unpacked(d)]
    phi = [f"c[{2 + j}]" if filters else "" for j in range(d)]
    C = np.eye(d) if filters and parts.diagonal else parts.C  # diagonal ones are in the filters
    active = {int(j) for i in range(d) if part.H.has(q[i]) for j in np.flatnonzero(C[i])}
    for j in sorted(active):
        lines.append(f"    u_{j} = {phi[j]} * x_{j}" if filters else f"    u_{j} = x_{j}")
    for i in range(d):
        if part.H.has(q[i]):
            offset = [_literal(parts.center[i])] if parts.center[i] else []
            lines.append(f"    {q[i]} = {_sum(C[i], 'u_{}', offset)}")
        if part.H.has(p[i]):
            lines.append(f"    {p[i]} = {_sum(parts.inverse_C[:, i], 'y_{}')}")
    by_q, by_p = ([sp.diff(part.H, s) for s in symbols] for symbols in (q, p))
    z = sp.symbols(f"z_0:{d}", real=True)
    products = _hessian_vector(part.H, q, z) if gradient else []
    names = [f"{letter}_{i}" for letter in "gvm"[: 2 + gradient] for i in range(d)]
    expressions = [printable(f) for f in (*by_q, *by_p, *products)]
    shared, reduced = sp.cse(expressions, symbols=sp.numbered_symbols("s_", real=True), list=True)
    late, early_lines, late_lines = set(z), [], []  # late is what holds the direction z, known after the slopes
    for target, f in [*((s.name, f) for s, f in shared), *zip(names, reduced, strict=True)]:
        if f.free_symbols & late:
            late.add(sp.Symbol(target, real=True))
            late_lines.append((target, f))
        elif f != 0 or target.startswith("m_"):
            early_lines.append((target, f))
    lines += _assignments(early_lines)
    moved = [i for i in range(d) if by_q[i] != 0]
    for j in range(d):
        slope = _sum([C[i, j] if i in moved else 0.0 for i in range(d)], "g_{}")
        if slope:
            lines.append(f"    G_{j} = {phi[j]} * ({slope})" if filters else f"    G_{j} = {slope}")
            lines.append(f"    y_{j} -= c[0] * G_{j}")
        velocity = _sum([parts.inverse_C[j, i] if by_p[i] != 0 else 0.0 for i in range(d)], "v_{}")
        if velocity:
            lines.append(f"    x_{j} += c[0] * ({velocity})")
    if gradient:
        lines += _direction(C, parts.linear.rates if parts.linear else C[0], moved, phi)
        lines += _assignments(late_lines)
        for j in range(d):
            product = _sum([C[i, j] if i in moved else 0.0 for i in range(d)], "m_{}")
            if product:
                factor = f" * {phi[j]}" if phi[j] else ""
                lines.append(f"    y_{j} += c[1]{factor} * ({product})")
    return "\n".join([*lines, _returned(d)])


def _hessian_vector(H: sp.Expr, q: Sequence[sp.Symbol], z: Sequence[sp.Symbol]) -> list[sp.Expr]:
    """∇²H z, as the slope of the derivative of H along z: that keeps powers of sums together."""
    eps = sp.Symbol("eps_", real=True)
    moved = H.xreplace({x: x + eps * v for x, v in zip(q, z, strict=True) if H.has(x)})
    along = sp.diff(moved, eps).subs(eps, 0)
    return [sp.diff(along, x) for x in q]


def _direction(C: np.ndarray, w: np.ndarray, moved: list[int], phi: list[str]) -> list[str]:
    """z = C φ M⁻¹ φ Cᵀ∇U, along which the Hessian acts; w is the diagonal M⁻¹ of the modes."""
    d, lines = len(C), []
    reached = [j for j in range(d) if any(C[i, j] for i in moved) and w[j]]
    for j in reached:
        factor = f"{phi[j]} * " if phi[j] else ""
        lines.append(f"    w_{j} = {factor}{_literal(w[j])} * G_{j}")
    for i in moved:
        lines.append(f"    z_{i} = {_sum([C[i, j] if j in reached else 0.0 for j in range(d)], 'w_{}')}")
    return lines


def _assignments(pairs: Sequence[tuple[str, sp.Expr]]) -> list[str]:
    printer = _KernelPrinter({"fully_qualified_modules": True, "human": True})
    lines = []
    for name, expression in pairs:
        try:
            lines.append(f"    {name} = {printer.doprint(expression)}")
        except PrintMethodNotImplementedError:
            raise ValueError(
                f"`system` has the term {expression}, for which there is no compiled function: use backend='array'."
            ) from None
    return lines


def _sum(coefficients: Sequence[float] | np.ndarray, name: str, terms: Sequence[str] = ()) -> str:
    """Σ c_i name_i without idle terms, '' if there are none."""
    products = [
        name.format(i) if c == 1.0 else f"{_literal(c)} * {name.format(i)}" for i, c in enumerate(coefficients) if c
    ]
    return " + ".join([*terms, *products])


def _literal(value: float) -> str:
    return repr(float(value)) if value >= 0 else f"({float(value)!r})"


def _unpacked(d: int) -> list[str]:
    return [f"    {', '.join(f'{v}_{j}' for j in range(d))}, = {v}" for v in "xy"]


def _returned(d: int) -> str:
    return "    return " + ", ".join("(" + "".join(f"{v}_{j}, " for j in range(d)) + ")" for v in "xy")
