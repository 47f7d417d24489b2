"""The flows of the parts of a symbolic system as source, on tuples of normal modes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import sympy as sp

from sympflow.hamiltonian.parts import LINEAR, ExactParts, PartFunctions
from sympflow.hamiltonian.symbolic import printable
from sympflow.kernels.codegen import printed
from sympflow.kernels.scheduling import FUSED, Schedule

__all__ = ["PRODUCT", "TURN_WIDTH", "PartFlow", "linear_flow", "part_flow", "unpacked"]

TURN_WIDTH = 6  # numbers that turn a frequency
PRODUCT = "fused_multiply_add"  # of `elementary`


@dataclass(frozen=True)
class PartFlow:
    """The flow of a part as code: its name, what it reads of a row of the table, and what it stores there before."""

    code: int
    name: str
    source: str
    row: Sequence[int]
    stored: list[str] = field(default_factory=list)
    width: int = 0

    @property
    def arguments(self) -> str:
        return "(" + "".join(f"table[j, {i}], " for i in self.row) + ")"


def linear_flow(parts: ExactParts) -> PartFlow:
    """Rotations by three shears after exact quarter turns, hyperbolic ones by shears alone, drifts."""
    assert parts.linear is not None
    d = parts.ndof
    lines = ["@njit(**OPTIONS, forceinline=True)", "def linear(x, y, c):", *unpacked(d)]
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


def part_flow(
    parts: ExactParts, part: PartFunctions, code: int, name: str, filters: bool, gradient: bool = False
) -> PartFlow:
    """x + b J∇H_k(x), and with a force gradient g ∇²U M⁻¹∇U added to y, of a row b, g, φ …"""
    d, q, p = parts.ndof, part.q, part.p
    x, y, z = (sp.symbols(f"{letter}_0:{d}", real=True) for letter in "xyz")
    b, g = sp.symbols("b_ g_", real=True)
    phi = sp.symbols(f"phi_0:{d}", real=True) if filters else (sp.S.One,) * d
    C = np.eye(d) if filters and parts.diagonal else parts.C  # diagonal ones are in the filters
    positions, momenta = _known(parts)
    schedule = Schedule(dict(zip((*x, *y), positions + momenta, strict=True)), printed, "s_", PRODUCT)
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
    lines = ["@njit(**OPTIONS, forceinline=True)", f"def {name}(x, y, c):", *unpacked(d)]
    lines += [f"    {n} = c[{i}]" for i, n in enumerate(row)]
    fill = [f"{n} = row[{i}]" for i, n in enumerate(raw)] + schedule.early
    fill += [f"row[{place[n]}] = {n}" for n in stored]
    source = "\n".join([*lines, *body])
    return PartFlow(code, name, source, [place[n] for n in row], fill if stored else [], len(place))


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


def unpacked(d: int) -> list[str]:
    return [f"    {', '.join(f'{v}_{j}' for j in range(d))}, = {v}" for v in "xy"]


def _returned(d: int) -> str:
    return "    return " + ", ".join("(" + "".join(f"{v}_{j}, " for j in range(d)) + ")" for v in "xy")
