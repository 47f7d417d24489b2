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
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

__all__ = ["CURVATURE", "FORCE_GRADIENT", "Scheme"]

FORCE_GRADIENT, CURVATURE = 1, 2  # levels of a scheme, or of a flow: what its kicks have beside the force


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

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        """Made once: tables are looked up by their scheme in every run."""
        return hash((self.name, self.kicks, self.drifts, self.gradients, self.curvatures))

    @cached_property
    def substeps(self) -> tuple[tuple[str, float, float, float], ...]:
        """The maps really executed, ('kick', b, g, c) or ('drift', a, 0, 0): no zeros, like neighbours merged."""
        merged: list[tuple[str, float, float, float]] = []
        curvatures = self.curvatures or (0.0,) * len(self.kicks)
        for b, g, c, a in zip(self.kicks, self.gradients, curvatures, self.drifts, strict=True):
            for kind, one, three, five in (("kick", b, g, c), ("drift", a, 0.0, 0.0)):
                if one == three == five == 0.0:
                    continue
                if merged and merged[-1][0] == kind:
                    _, before, before3, before5 = merged.pop()
                    one, three, five = one + before, three + before3, five + before5  # noqa: PLW2901
                merged.append((kind, one, three, five))
        return tuple(merged)

    @cached_property
    def symmetric(self) -> bool:
        """Whether the step is its own adjoint, Φ(−h) = Φ(h)⁻¹ (the coefficients read the same backwards)."""
        forwards, backwards = self.substeps, self.substeps[::-1]
        return len(forwards) > 0 and all(
            one[0] == other[0] and sum(abs(a - b) for a, b in zip(one[1:], other[1:], strict=True)) < 1e-13
            for one, other in zip(forwards, backwards, strict=True)
        )

    @cached_property
    def first_same_as_last(self) -> bool:
        """Whether a step ends with the kind of map that it begins with, so that successive steps share it."""
        return len(self.substeps) > 1 and self.substeps[0][0] == self.substeps[-1][0]

    @cached_property
    def level(self) -> int:
        """What the kicks have: 0 the force alone, `FORCE_GRADIENT`, or `CURVATURE` terms as well."""
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
        with_it = [has(g, c) for kind, _, g, c in self.substeps if kind == "kick"]
        shared = self.first_same_as_last and self.substeps[0][0] == "kick"
        return sum(with_it[1:-1] if shared else with_it) + (shared and (with_it[0] or with_it[-1]))

    def inverse(self) -> Scheme:
        """The scheme Ψ with Ψ(h) ∘ Φ(h) = identity: the stages backwards, with opposite signs."""
        columns = [
            (0.0, *(-c for c in reversed(column))) for column in (self.kicks, self.gradients, self.curvatures) if column
        ]
        drifts = (*(-a for a in reversed(self.drifts)), 0.0)
        if drifts[0] == 0.0:
            columns, drifts = [column[1:] for column in columns], drifts[1:]
        elif not any(column[-1] for column in columns):
            columns, drifts = [column[:-1] for column in columns], drifts[:-1]
        name, source = f"{self.name}⁻¹", f"the inverse of {self.name}"
        return Scheme(name, self.order, columns[0], drifts, columns[1], source, self.nystrom, *columns[2:])
