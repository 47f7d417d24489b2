"""Scheme: a splitting method as a table of numbers.

A separable Hamiltonian H(q, p) = T(p) + V(q) is the sum of two that are solved exactly: the *drift*
q += a h ∇T(p) and the *kick* p −= b h ∇V(q).  A splitting scheme is a list of kicks and drifts, and this
module knows nothing else: no system, no array library.

When T is quadratic, T = ½ pᵀM⁻¹p, the kick may carry a *force gradient*: stage i is the exact flow over h of

    b_i V(q) − g_i h² ½ |∇V(q)|²_{M⁻¹},       p += b_i h F(q) + g_i h³ ∇²V(q) M⁻¹∇V(q),      F = −∇V,

that is exp(h b_i B + ½ h³ g_i [B, [A, B]]) with the Lie derivatives A and B along T and V.  (Chin's
V + (h²/48)[V, [T, V]] in a kick of weight b is g = b/24, a χ of Omelyan, Mryglod and Folk is g = 2χ.)
It may further carry the next commutator that depends on q alone, the *curvature* of V along the acceleration
v = M⁻¹∇V (Blanes, Casas and Ros, Appl. Numer. Math. 39 (2001) 245):

    + c_i h⁴ ½ v·∇²V(q) v,       p −= c_i h⁵ (∇²V M⁻¹∇²V v + ½ ∇³V(v, v)).

In place of these two a kick may carry a polynomial in q, which no order condition knows: trained flows have them.

    + h² Σ_m e_im q^m,           p −= h³ Σ_m e_im ∇q^m.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

__all__ = ["CURVATURE", "FORCE_GRADIENT", "POLYNOMIAL", "Scheme", "Substep"]

FORCE_GRADIENT, CURVATURE, POLYNOMIAL = 1, 2, 3  # levels of a scheme, or of a flow: what its kicks have beside V


class Substep(NamedTuple):
    """A kick by b, g, c and the coefficients e of a polynomial, or a drift by a = `one`."""

    kind: str
    one: float
    three: float = 0.0
    five: float = 0.0
    polynomial: tuple[float, ...] = ()

    @property
    def idle(self) -> bool:
        return not (self.one or self.three or self.five or any(self.polynomial))

    def numbers(self) -> tuple[float, ...]:
        return (self.one, self.three, self.five, *self.polynomial)

    def merged(self, other: Substep) -> Substep:
        """Both in turn, of one kind."""
        e = tuple(map(float.__add__, self.polynomial, other.polynomial))
        return Substep(self.kind, self.one + other.one, self.three + other.three, self.five + other.five, e)


@dataclass(frozen=True)
class Scheme:
    """A splitting method: stage i kicks by ``kicks[i]`` and ``gradients[i]``, then drifts by ``drifts[i]``.

    Attributes
    ----------
    name : str
        The method's name, the key in `SCHEMES`.
    order : int or None
        Classical order of convergence; None where nothing is claimed (a trained table).
    kicks, drifts, gradients : tuple of float
        Coefficients b, a and g of the stages in their order of execution; zeros cost nothing.
    curvatures : tuple of float
        Coefficients c, none for none.
    polynomials : tuple of tuple of float
        Coefficients e of each stage, none for none; then there are neither g nor c.
    monomials : tuple of tuple of int
        The exponents m of these.
    source : str
        Where the coefficients come from.
    nystrom : bool
        True if the order holds only for a kinetic energy quadratic in p, where [B, [B, [B, A]]] = 0
        (the Nyström condition).

    Raises
    ------
    ValueError
        If the tuples differ in length or are empty.
    """

    name: str
    order: int | None
    kicks: tuple[float, ...]
    drifts: tuple[float, ...]
    gradients: tuple[float, ...]
    source: str
    nystrom: bool = False
    curvatures: tuple[float, ...] = ()
    polynomials: tuple[tuple[float, ...], ...] = ()
    monomials: tuple[tuple[int, ...], ...] = ()

    def __post_init__(self) -> None:
        if not len(self.kicks) == len(self.drifts) == len(self.gradients) > 0:
            raise ValueError(
                f"`kicks`, `drifts` and `gradients` must have one coefficient per stage, got "
                f"{len(self.kicks)}, {len(self.drifts)} and {len(self.gradients)}: pad with zeros."
            )
        if len(self.curvatures) not in (0, len(self.kicks)):
            raise ValueError(
                f"`curvatures` must have one coefficient per stage, {len(self.kicks)}, or none; got "
                f"{len(self.curvatures)}: pad with zeros."
            )
        if len(self.polynomials) not in (0, len(self.kicks)) or any(
            len(e) != len(self.monomials) for e in self.polynomials
        ):
            raise ValueError(
                f"`polynomials` must have {len(self.monomials)} coefficients per stage, one for each of `monomials`, "
                "or there must be none: pad with zeros."
            )
        if self.polynomials and (any(self.gradients) or any(self.curvatures)):
            raise ValueError("`polynomials` stand in place of `gradients` and `curvatures`: leave these out.")

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        """Made once: tables are looked up by their scheme in every run."""
        return hash((self.name, self.kicks, self.drifts, self.gradients, self.curvatures))

    @cached_property
    def substeps(self) -> tuple[Substep, ...]:
        """The maps really executed: no zeros, like neighbours merged."""
        merged: list[Substep] = []
        n = len(self.kicks)
        columns = self.curvatures or (0.0,) * n, self.polynomials or ((),) * n
        for b, g, c, e, a in zip(self.kicks, self.gradients, *columns, self.drifts, strict=True):
            for substep in (Substep("kick", b, g, c, e), Substep("drift", a)):
                if substep.idle:
                    continue
                merged.append(merged.pop().merged(substep) if merged and merged[-1].kind == substep.kind else substep)
        return tuple(merged)

    @cached_property
    def symmetric(self) -> bool:
        """Whether the step is its own adjoint, Φ(−h) = Φ(h)⁻¹ (the coefficients read the same backwards)."""
        forwards, backwards = self.substeps, self.substeps[::-1]
        return len(forwards) > 0 and all(
            one.kind == other.kind
            and sum(abs(a - b) for a, b in zip(one.numbers(), other.numbers(), strict=True)) < 1e-13
            for one, other in zip(forwards, backwards, strict=True)
        )

    @cached_property
    def first_same_as_last(self) -> bool:
        """Whether a step ends with the kind of map that it begins with, so that successive steps share it."""
        return len(self.substeps) > 1 and self.substeps[0][0] == self.substeps[-1][0]

    @cached_property
    def level(self) -> int:
        """What the kicks have: 0 the force alone, `FORCE_GRADIENT`, or `CURVATURE` terms as well, or a `POLYNOMIAL`."""
        if self.polynomials:
            return POLYNOMIAL
        return CURVATURE if any(self.curvatures) else FORCE_GRADIENT if any(self.gradients) else 0

    @cached_property
    def force_evaluations(self) -> int:
        """Forces per step in a long run, the last kick merged with the next step's first one."""
        kinds = [kind for kind, *_ in self.substeps]
        return kinds.count("kick") - (self.first_same_as_last and kinds[0] == "kick")

    @cached_property
    def hessian_evaluations(self) -> int:
        """Force gradients (Hessian–vector products) per step, counted like `force_evaluations`."""
        return self._kicks_with(lambda g, c: g != 0.0 or c != 0.0)

    @cached_property
    def curvature_evaluations(self) -> int:
        """Curvature terms (third derivatives of V) per step, likewise."""
        return self._kicks_with(lambda g, c: c != 0.0)

    def _kicks_with(self, has: Callable[[float, float], bool]) -> int:
        with_it = [has(s.three, s.five) for s in self.substeps if s.kind == "kick"]
        shared = self.first_same_as_last and self.substeps[0][0] == "kick"
        return sum(with_it[1:-1] if shared else with_it) + (shared and (with_it[0] or with_it[-1]))

    def inverse(self) -> Scheme:
        """The scheme Ψ with Ψ(h) ∘ Φ(h) = identity: the stages backwards, with opposite signs."""
        nothing: Any = [(0.0,), (0.0,), (0.0,), ((0.0,) * len(self.monomials),)]
        columns: Any = self.kicks, self.gradients, self.curvatures, self.polynomials
        # kick and drift change places: an idle kick comes before, an idle drift after, unless that was there already
        kicks = [zero + tuple(map(_opposite, reversed(column))) for zero, column in zip(nothing, columns, strict=True)]
        drifts = (*(-a for a in reversed(self.drifts)), 0.0)
        part = slice(None)
        if drifts[0] == 0.0:
            part = slice(1, None)
        elif not any(_any(column[-1]) for column, was in zip(kicks, columns, strict=True) if was):
            part = slice(-1)
        b, g, c, e = (column[part] if was else () for column, was in zip(kicks, columns, strict=True))
        name, source = f"{self.name}⁻¹", f"the inverse of {self.name}"
        return Scheme(name, self.order, b, drifts[part], g, source, self.nystrom, c, e, self.monomials)


def _any(number: Any) -> bool:
    return any(number) if isinstance(number, tuple) else number != 0.0


def _opposite(number: Any) -> Any:
    return tuple(-e for e in number) if isinstance(number, tuple) else -number
