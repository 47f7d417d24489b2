"""A symbolic system together with vectors that its linearised flow moves, as one state: names and drifts of all."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import sympy as sp

from sympflow.hamiltonian.symbolic import SymbolicHamiltonian

__all__ = ["Variations"]


@dataclass(frozen=True, eq=False)
class Variations:
    """An orbit of H = T(p) + V(q) and k deviation vectors, w' = J∇²H w, as a state of (1 + k) d positions and momenta.

    It has the names and the derivatives by which code of kicks and drifts is generated, as `SymbolicHamiltonian` has
    them: the orbit comes first, then vector after vector.

    Parameters
    ----------
    symbols : SymbolicHamiltonian
        Separable.
    vectors : int
        k.
    """

    symbols: SymbolicHamiltonian
    vectors: int

    @property
    def ndof(self) -> int:
        return (1 + self.vectors) * self.symbols.ndof

    @property
    def parameters(self) -> tuple[sp.Symbol, ...]:
        return self.symbols.parameters

    @property
    def T(self) -> sp.Expr:
        return self.symbols.T

    @cached_property
    def q(self) -> tuple[sp.Symbol, ...]:
        return self._names(self.symbols.q)

    @cached_property
    def p(self) -> tuple[sp.Symbol, ...]:
        return self._names(self.symbols.p)

    @cached_property
    def inverse_mass(self) -> sp.Matrix | None:
        M = self.symbols.inverse_mass
        return None if M is None else sp.diag(*[M] * (1 + self.vectors))

    @cached_property
    def velocity(self) -> tuple[sp.Expr, ...]:
        """∇T, and ∇²T w_p of each vector."""
        x = self.symbols.p
        velocity = [sp.diff(self.symbols.T, s) for s in x]
        products = [_along(f, x, w) for _, w in self.pairs() for f in velocity]
        return (*velocity, *products)

    def pairs(self) -> Iterator[tuple[tuple[sp.Symbol, ...], tuple[sp.Symbol, ...]]]:
        """The vectors, each as (w_q, w_p)."""
        d = self.symbols.ndof
        for k in range(1, 1 + self.vectors):
            yield self.q[k * d : (k + 1) * d], self.p[k * d : (k + 1) * d]

    def _names(self, x: Sequence[sp.Symbol]) -> tuple[sp.Symbol, ...]:
        vectors = [sp.Symbol(f"{s.name}_{k}", real=True) for k in range(1, 1 + self.vectors) for s in x]
        return (*x, *vectors)


def _along(f: sp.Expr, x: Sequence[sp.Symbol], w: Sequence[sp.Symbol]) -> sp.Expr:
    """The derivative of f(x) along w."""
    return sp.Add(*[sp.diff(f, s) * v for s, v in zip(x, w, strict=True)])
