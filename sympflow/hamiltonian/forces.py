"""Forces by symbols, and the Hamiltonian in twice the variables that has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy as sp

from sympflow.arrays import Array, concatenate
from sympflow.hamiltonian.expression import COORDINATE, complex_part, stated
from sympflow.hamiltonian.jumps import refuse_deltas
from sympflow.hamiltonian.symbolic import checked_params, exact, printable

if TYPE_CHECKING:
    from sympflow.hamiltonian.system import HamiltonianSystem


class SymbolicForce:
    """F(q, p) by expressions, one for each momentum."""

    def __init__(self, system: HamiltonianSystem, force: Any, params: Mapping[str, float] | None) -> None:
        symbols = system.symbols
        self.q, self.p, self.time = symbols.q, symbols.p, symbols.time
        self.form = symbols.like(symbols.H)  # with functions of its own
        d = system.ndof
        several = isinstance(force, Sequence | np.ndarray | sp.MatrixBase) and not isinstance(force, str)
        written = list(force) if several else [force]
        if len(written) != d:
            raise ValueError(
                f"`force` must have {d} components, one for each momentum of {system.name!r}; got {len(written)}."
            )
        values = {**system.params, **checked_params(params)}
        read_ones = [stated("force", each, values) for each in written]
        if any(complex_part(f) is not None for f in read_ones):
            raise TypeError("`force` must be real expressions, texts or SymPy's, or a function F(q, p).")
        for name in params or {}:
            if not any(sp.Symbol(name, real=True) in f.free_symbols for f in read_ones):
                raise ValueError(f"`params` has {name!r}, which the force does not use: remove it.")
        self.expressions = [self._valued(f, values) for f in read_ones]
        for f in self.expressions:
            refuse_deltas("force", f)

    def _valued(self, f: sp.Expr, values: Mapping[str, float]) -> sp.Expr:
        """The expression in the system's coordinates, its parameters replaced by their values."""
        d = len(self.q)
        known: dict[sp.Symbol, sp.Expr] = {sp.Symbol(name, real=True): exact(value) for name, value in values.items()}
        if d == 1:
            known |= {sp.Symbol("q", real=True): self.q[0], sp.Symbol("p", real=True): self.p[0]}
        f = f.xreplace(known)
        unknown = sorted(s.name for s in f.free_symbols - {*self.q, *self.p, self.time})
        beyond = [name for name in unknown if COORDINATE.fullmatch(name)]
        if beyond:
            raise ValueError(
                f"`force` holds {', '.join(beyond)}, but the system has the coordinates {self.q[0]} … {self.p[-1]}: "
                "write it in these."
            )
        if "t" in unknown:
            raise ValueError(
                "`force` depends on the time t, but the system does not: leave t out, or name the time of the system."
            )
        if unknown:
            raise ValueError(f"`force` holds {', '.join(unknown)} without a value: give it in `params`.")
        return f

    def __call__(self, q: Array, p: Array, *t: Any) -> Array:
        return self.form.evaluated("force", self.expressions)(concatenate([q, p]), *t)

    def jacobian(self, q: Array, p: Array, *t: Any) -> Array:
        x = (*self.q, *self.p)
        slopes = [sp.diff(f, s) for f in self.expressions for s in x]
        return self.form.evaluated("force 1", slopes)(concatenate([q, p]), *t).reshape(*p.shape, len(x))

    @property
    def has_potential(self) -> bool:
        """True if F is −∇U(q)."""
        F, q = self.expressions, self.q
        if any(f.free_symbols & {*self.p} for f in F):
            return False
        return all(sp.expand(sp.diff(F[i], q[j]) - sp.diff(F[j], q[i])) == 0 for i in range(len(q)) for j in range(i))


def doubled_hamiltonian(system: HamiltonianSystem, force: SymbolicForce) -> sp.Expr:
    """p₋·∂H/∂p + q₋·(∂H/∂q + Γp − F) in q1 … q2d, p1 … p2d, which are q₊, q₋ and p₋, p₊."""
    symbols = system.symbols
    d = system.ndof
    q, p = (sp.symbols(f"{letter}1:{2 * d + 1}", real=True) for letter in "qp")
    G = system.friction.matrix(d)
    mean = dict(zip((*symbols.q, *symbols.p), (*q[:d], *p[d:]), strict=True))
    terms = []
    for i, F in enumerate(force.expressions):
        drag = sp.Add(*[exact(g) * s for g, s in zip(G[i], symbols.p, strict=True) if g])
        terms.append(p[i] * sp.diff(symbols.H, symbols.p[i]).xreplace(mean))
        terms.append(q[d + i] * (sp.diff(symbols.H, symbols.q[i]) + drag - F).xreplace(mean))
    return printable(sp.Add(*terms))
