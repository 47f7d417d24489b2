"""Scheme: a splitting method as a table of numbers.

A separable Hamiltonian H(q, p) = T(p) + V(q) is the sum of two that are solved exactly: the *drift*
q += a h ∇T(p) and the *kick* p −= b h ∇V(q).  A splitting scheme is a list of kicks and drifts, and this module depends
on nothing else: no system, no array library.

When T is quadratic, T = ½ pᵀM⁻¹p, the kick may carry a *force gradient*: stage i is the exact flow over h of

    b_i V(q) − g_i h² ½ |∇V(q)|²_{M⁻¹},       p += b_i h F(q) + g_i h³ ∇²V(q) M⁻¹∇V(q),      F = −∇V,

that is exp(h b_i B + ½ h³ g_i [B, [A, B]]) with the Lie derivatives A and B along T and V.  (Chin's
V + (h²/48)[V, [T, V]] in a kick of weight b is g = b/24, a χ of Omelyan, Mryglod and Folk is g = 2χ.)
It may further carry the next commutator that depends on q alone, the *curvature* of V along the acceleration
v = M⁻¹∇V (Blanes, Casas and Ros, Appl. Numer. Math. 39 (2001) 245):

    + c_i h⁴ ½ v·∇²V(q) v,       p −= c_i h⁵ (∇²V M⁻¹∇²V v + ½ ∇³V(v, v)).

In place of these two a kick may carry a polynomial in q, which has no order condition: trained flows have them.

    + h² Σ_m e_im q^m,           p −= h³ Σ_m e_im ∇q^m.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache, cached_property
from itertools import pairwise
from math import comb, factorial, fsum, isfinite, sqrt
from typing import TYPE_CHECKING, Any, NamedTuple

from sympflow.lazy import announced, distribution, load_announced

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

__all__ = [
    "CURVATURE",
    "FORCE_GRADIENT",
    "GROUP",
    "POLYNOMIAL",
    "SCHEMES",
    "Scheme",
    "Substep",
    "announced_schemes",
    "checked_scheme",
    "compose",
    "register_scheme",
    "scheme_evaluations",
    "scheme_named",
]

GROUP = "sympflow.schemes"
"""The entry-point group in which a distribution announces its schemes: `name = "package.module:SCHEME"`."""
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


_COUNTED: dict[str, Callable[[Substep], bool]] = {
    "force_evaluations": lambda kick: True,
    "hessian_evaluations": lambda kick: kick.three != 0 or kick.five != 0,
    "curvature_evaluations": lambda kick: kick.five != 0,
}
"""Evaluations, and the kicks that make them."""


@dataclass(frozen=True)
class Scheme:
    """A splitting method: stage i kicks by ``kicks[i]`` and ``gradients[i]``, then drifts by ``drifts[i]``.

    Attributes
    ----------
    name : str
        The method's name, the key in `SCHEMES`.
    order : int or None
        Classical order of convergence; None for a table without one, such as a trained one.
    kicks, drifts, gradients : tuple of float
        Coefficients b, a and g of the stages in their order of execution; zeros cost nothing. Without g all are zero.
        Other sequences of numbers become tuples.
    curvatures : tuple of float
        Coefficients c; empty if all are zero.
    polynomials : tuple of tuple of float
        Coefficients e of each stage; empty if there are none. With them there are neither g nor c.
    monomials : tuple of tuple of int
        The exponents m of the monomials of the polynomials.
    source : str
        Where the coefficients come from.
    nystrom : bool
        True if the order holds only for a kinetic energy quadratic in p, where [B, [B, [B, A]]] = 0
        (the Nyström condition).

    Raises
    ------
    ValueError
        If the tuples differ in length or are empty.

    Examples
    --------
    >>> ruth3 = Scheme("ruth3", 3, kicks=(7 / 24, 3 / 4, -1 / 24), drifts=(2 / 3, -2 / 3, 1.0))
    >>> ruth3.force_evaluations, ruth3.symmetric
    (3, False)
    """

    name: str
    order: int | None
    kicks: tuple[float, ...]
    drifts: tuple[float, ...]
    gradients: tuple[float, ...] = ()
    source: str = ""
    nystrom: bool = False
    curvatures: tuple[float, ...] = ()
    polynomials: tuple[tuple[float, ...], ...] = ()
    monomials: tuple[tuple[int, ...], ...] = ()

    def __post_init__(self) -> None:
        for column in ("kicks", "drifts", "gradients", "curvatures"):
            if type(getattr(self, column)) is not tuple:
                object.__setattr__(self, column, tuple(map(float, getattr(self, column))))
        if not self.gradients:
            object.__setattr__(self, "gradients", (0.0,) * len(self.kicks))
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
        """The maps that are executed: without zeros, and neighbours of the same kind merged."""
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
    def substep_times(self) -> tuple[float, ...]:
        """The time at which each substep begins, in units of the step: time moves with the drifts."""
        times, t = [], 0.0
        for substep in self.substeps:
            times.append(t)
            t += substep.one if substep.kind == "drift" else 0.0
        return tuple(times)

    @cached_property
    def symmetric(self) -> bool:
        """True if the step is its own adjoint, Φ(−h) = Φ(h)⁻¹ (the coefficients read the same backwards)."""
        forwards, backwards = self.substeps, self.substeps[::-1]
        return len(forwards) > 0 and all(
            one.kind == other.kind
            and sum(abs(a - b) for a, b in zip(one.numbers(), other.numbers(), strict=True)) < 1e-13
            for one, other in zip(forwards, backwards, strict=True)
        )

    @cached_property
    def first_same_as_last(self) -> bool:
        """True if a step ends with the kind of map that it begins with, so that successive steps share it."""
        return len(self.substeps) > 1 and self.substeps[0][0] == self.substeps[-1][0]

    @cached_property
    def level(self) -> int:
        """The terms of kicks: 0 for the force alone, `FORCE_GRADIENT`, `CURVATURE` terms as well, or a `POLYNOMIAL`."""
        if self.polynomials:
            return POLYNOMIAL
        return CURVATURE if any(self.curvatures) else FORCE_GRADIENT if any(self.gradients) else 0

    @cached_property
    def force_evaluations(self) -> int:
        """Forces per step in a long run, the last kick merged with the next step's first one."""
        return self.counts["force_evaluations"][0]

    @cached_property
    def hessian_evaluations(self) -> int:
        """Force gradients (Hessian–vector products) per step, counted like `force_evaluations`."""
        return self.counts["hessian_evaluations"][0]

    @cached_property
    def curvature_evaluations(self) -> int:
        """Curvature terms (third derivatives of V) per step, likewise."""
        return self.counts.get("curvature_evaluations", (0,))[0]

    @cached_property
    def counts(self) -> dict[str, tuple[int, int, int]]:
        """Evaluations of a step in a long run, of a single step, and of the last kick if the next step shares it."""
        kicks = [s for s in self.substeps if s.kind == "kick"]
        shared = self.first_same_as_last and self.substeps[0].kind == "kick"
        found: dict[str, tuple[int, int, int]] = {}
        for name, has in _COUNTED.items():
            of = [has(kick) for kick in kicks]
            if name != "curvature_evaluations" or any(of):
                found[name] = (
                    sum(of[shared : len(of) - shared]) + (shared and (of[0] or of[-1])),
                    sum(of),
                    shared and of[-1],
                )
        return found

    @cached_property
    def strang_weights(self) -> tuple[float, ...] | None:
        """The lengths of the Strang steps of which the scheme is composed; None if it is not a composition of these."""
        kinds = [s.kind for s in self.substeps]
        inner = kinds[1] if len(kinds) > 2 and len(kinds) % 2 else ""
        weights = tuple(s.one for s in self.substeps if s.kind == inner)
        padded = (0.0, *weights, 0.0)
        halves = [0.5 * (one + other) for one, other in pairwise(padded)]
        outer = [s.one for s in self.substeps if s.kind != inner]
        composed = self.level == 0 and weights and all(abs(a - b) < 1e-15 for a, b in zip(halves, outer, strict=True))
        return weights if composed else None

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


def _kick_first(kicks: tuple[float, ...], drifts: tuple[float, ...]) -> tuple[tuple[float, ...], ...]:
    return kicks, (*drifts, 0.0)


def _drift_first(drifts: tuple[float, ...], kicks: tuple[float, ...]) -> tuple[tuple[float, ...], ...]:
    return (0.0, *kicks), drifts


def _palindrome(half: tuple[float, ...]) -> tuple[float, ...]:
    """Coefficients w₁ … w_m, w₀, w_m … w₁ with the middle one making the sum 1."""
    return (*half, 1.0 - 2.0 * sum(half), *reversed(half))


def _even_palindrome(half: tuple[float, ...]) -> tuple[float, ...]:
    """Coefficients w₁ … w_m, w_m … w₁ with sum 1, the given ones completed by w_m."""
    half = (*half, 0.5 - sum(half))
    return (*half, *reversed(half))


def compose(name: str, order: int | None, weights: tuple[float, ...], source: str) -> Scheme:
    """Leapfrog (drift–kick–drift) steps of lengths ``weights[i] h`` in a row, neighbouring drifts merged."""
    padded = (0.0, *weights, 0.0)
    drifts = tuple(0.5 * (one + other) for one, other in pairwise(padded))
    return _scheme(name, order, _drift_first(drifts, weights), source)


def _scheme(
    name: str,
    order: int | None,
    kicks_and_drifts: tuple[tuple[float, ...], ...],
    source: str,
    *,
    gradients: dict[int, float] | None = None,
    nystrom: bool = False,
) -> Scheme:
    kicks, drifts = kicks_and_drifts
    g = tuple((gradients or {}).get(i, 0.0) for i in range(len(kicks)))
    return Scheme(name, order, kicks, drifts, g, source, nystrom or gradients is not None)


def _adjoint_composition(alphas: tuple[float, ...]) -> tuple[tuple[float, ...], ...]:
    """Φ(α_s h) Φ*(β_s h) … Φ(α₁h) Φ*(β₁h), β_i = α_{s+1−i}; Φ is kick then drift, Φ* drift then kick."""
    betas = alphas[::-1]
    kicks = tuple(a + b for a, b in zip(alphas, betas, strict=True))
    inner = tuple(a + b for a, b in zip(alphas[:-1], betas[1:], strict=True))
    return _drift_first((betas[0], *inner, alphas[-1]), kicks)


_YOSHIDA = "H. Yoshida, Construction of higher order symplectic integrators, Phys. Lett. A 150 (1990) 262–268"
_KAHAN_LI = (
    "W. Kahan and R.-C. Li, Composition constants for raising the orders of unconventional schemes for "
    "ordinary differential equations, Math. Comp. 66 (1997) 1089–1099"
)
_BLANES_MOAN = (
    "S. Blanes and P. C. Moan, Practical symplectic partitioned Runge–Kutta and Runge–Kutta–Nyström methods, "
    "J. Comput. Appl. Math. 142 (2002) 313–330"
)
_CHIN = "S. A. Chin, Symplectic integrators from composite operator factorizations, Phys. Lett. A 226 (1997) 344–348"
_OMELYAN = (
    "I. P. Omelyan, I. M. Mryglod and R. Folk, Construction of high-order force-gradient algorithms for "
    "integration of motion in classical and quantum systems, Phys. Rev. E 66 (2002) 026701"
)
_NEARLY_INTEGRABLE = (
    "S. Blanes, F. Casas, A. Farrés, J. Laskar, J. Makazaga and A. Murua, New families of symplectic splitting methods "
    "for numerical integration in dynamical astronomy, Appl. Numer. Math. 68 (2013) 58–72"
)
_YOSHIDA4_WEIGHT = 1.0 / (2.0 - 2.0 ** (1.0 / 3.0))
_SUZUKI4_WEIGHT = 1.0 / (4.0 - 4.0 ** (1.0 / 3.0))
_ROOT19 = sqrt(19.0)
_MCLACHLAN4_ALPHAS = (
    (146.0 + 5.0 * _ROOT19) / 540.0,
    (-2.0 + 10.0 * _ROOT19) / 135.0,
    1.0 / 5.0,
    (-23.0 - 20.0 * _ROOT19) / 270.0,
    (14.0 - _ROOT19) / 108.0,
)
_OMELYAN4_LAMBDA = 0.2470939580390842
_OMELYAN4_THETA = 0.5 - 1.0 / sqrt(24.0 * _OMELYAN4_LAMBDA)
_OMELYAN4_CHI = (1.0 - sqrt(6.0 * _OMELYAN4_LAMBDA) * (1.0 - _OMELYAN4_LAMBDA)) / 12.0

# fmt: off
_TABLE = (
    _scheme("verlet", 2, _kick_first((0.5, 0.5), (1.0,)),
        "L. Verlet, Phys. Rev. 159 (1967) 98–103; kick–drift–kick form (velocity Verlet)"),
    _scheme("leapfrog", 2, _drift_first((0.5, 0.5), (1.0,)),
        "Störmer–Verlet in drift–kick–drift form; E. Hairer, C. Lubich and G. Wanner, Geometric numerical "
        "integration illustrated by the Störmer–Verlet method, Acta Numerica 12 (2003) 399–450"),
    compose("yoshida4", 4, _palindrome((_YOSHIDA4_WEIGHT,)),
        f"{_YOSHIDA}, eq. (2.11); E. Forest and R. D. Ruth (1990)"),
    compose("yoshida6", 6, _palindrome((0.78451361047755726381949763, 0.23557321335935813368479318,
        -1.17767998417887100694641568)), f"{_YOSHIDA}, solution A of table 1"),
    compose("suzuki4", 4, _palindrome((_SUZUKI4_WEIGHT, _SUZUKI4_WEIGHT)),
        "M. Suzuki, Fractal decomposition of exponential operators, Phys. Lett. A 146 (1990) 319–323"),
    _scheme("mclachlan4", 4, _adjoint_composition(_MCLACHLAN4_ALPHAS),
        "R. I. McLachlan, On the numerical integration of ordinary differential equations by symmetric "
        "composition methods, SIAM J. Sci. Comput. 16 (1995) 151–168, five stages and their adjoints"),
    _scheme("blanes_moan4", 4, _kick_first(_palindrome((0.0792036964311957, 0.353172906049774, -0.0420650803577195)),
        _even_palindrome((0.209515106613362, -0.143851773179818))), f"{_BLANES_MOAN}, table 2, S6 of order 4"),
    compose("kahan_li6", 6, _palindrome((0.39216144400731413927925056, 0.33259913678935943859974864,
        -0.70624617255763935980996482, 0.08221359629355080023149045)), f"{_KAHAN_LI}, s9odr6a"),
    compose("kahan_li8", 8, _palindrome((0.13020248308889008087881763, 0.56116298177510838456196441,
        -0.38947496264484728640807860, 0.15884190655515560089621075, -0.39590389413323757733623154,
        0.18453964097831570709183254, 0.25837438768632204729397911, 0.29501172360931029887096624)),
        f"{_KAHAN_LI}, s17odr8a"),
    # tuned for a quadratic T; being symmetric, of order 4 for any
    _scheme("srkn6b", 4, _kick_first(_palindrome((0.0829844064174052, 0.396309801498368, -0.0390563049223486)),
        _even_palindrome((0.245298957184271, 0.604872665711080))), f"{_BLANES_MOAN}, table 3, SRKN 6b"),
    _scheme("srkn11b", 6, _kick_first(
        _even_palindrome((0.0414649985182624, 0.198128671918067, -0.0400061921041533, 0.0752539843015807,
        -0.0115113874206879)),
        _palindrome((0.123229775946271, 0.290553797799558, -0.127049212625417, -0.246331761062075,
        0.357208872795928))), f"{_BLANES_MOAN}, table 3, SRKN 11b",
        nystrom=True),
    _scheme("srkn14a", 6, _drift_first(_palindrome((0.0378593198406116, 0.102635633102435, -0.0258678882665587,
        0.314241403071447, -0.130144459517415, 0.106417700369543, -0.00879424312851058)),
        _even_palindrome((0.09171915262446165, 0.183983170005006, -0.05653436583288827, 0.004914688774712854,
        0.143761127168358, 0.328567693746804))), f"{_BLANES_MOAN}, table 3, SRKN 14a", nystrom=True),
    _scheme("aba104", 4, _drift_first(_even_palindrome((0.04706710064597250612947887637243678556564,
        0.1847569354170881069247376193702560968574, 0.2827060056798362053243616565541452479160)),
        _palindrome((0.1188819173681970199453503950853885936957, 0.2410504605515015657441667865901651105675,
        -0.2732866667053238060543113981664559460630))),
        f"{_NEARLY_INTEGRABLE}, ABA (10, 4): errors of order εh¹⁰ + ε²h⁴ where kicks are small, of order ε"),
    _scheme("aba864", 4, _drift_first(_even_palindrome((0.0711334264982231177779387300061549964174,
        0.241153427956640098736487795326289649618, 0.521411761772814789212136078067994229991)),
        _palindrome((0.183083687472197221961703757166430291072, 0.310782859898574869507522291054262796375,
        -0.0265646185119588006972121379164987592663))),
        f"{_NEARLY_INTEGRABLE}, ABA (8, 6, 4): errors of order εh⁸ + ε²h⁶ + ε³h⁴ where kicks are small, of order ε"),
    _scheme("aba1064", 4, _drift_first(_palindrome((0.03809449742241219545697532230863756534060,
        0.1452987161169137492940200726606637497442, 0.2076276957255412507162056113249882065158,
        0.4359097036515261592231548624010651844006)), _even_palindrome((0.09585888083707521061077150377145884776921,
        0.2044461531429987806805077839164344779763, 0.2170703479789911017143385924306336714532))),
        f"{_NEARLY_INTEGRABLE}, ABA (10, 6, 4): errors of order εh¹⁰ + ε²h⁶ + ε³h⁴ where kicks are small, of order ε"),
    _scheme("takahashi_imada", 2, _drift_first((0.5, 0.5), (1.0,)),
        "M. Takahashi and M. Imada, Monte Carlo calculation of quantum systems, II: higher order correction, J. Phys. "
        "Soc. Japan 53 (1984) 3765–3769; of order 4 in other coordinates: G. Rowlands, A numerical algorithm for "
        "Hamiltonian systems, J. Comput. Phys. 97 (1991) 235–239", gradients={1: 1.0 / 12.0}),
    _scheme("chin4a", 4, _kick_first((1.0 / 6.0, 2.0 / 3.0, 1.0 / 6.0), (0.5, 0.5)), f"{_CHIN}, scheme A",
        gradients={1: 1.0 / 36.0}),
    _scheme("chin4c", 4, _drift_first((1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0), (3.0 / 8.0, 1.0 / 4.0, 3.0 / 8.0)),
        f"{_CHIN}, scheme C", gradients={2: 1.0 / 96.0}),
    _scheme("omelyan4", 4, _drift_first(_even_palindrome((_OMELYAN4_THETA,)), _palindrome((_OMELYAN4_LAMBDA,))),
        f"{_OMELYAN}, eqs. (38)–(42), three forces and one force gradient", gradients={2: 2.0 * _OMELYAN4_CHI}),
    _scheme("omelyan6", 6, _drift_first(_even_palindrome((0.1097059723948682, 0.4140632267310831)),
        _palindrome((0.2693315848935301, 1.1319803486515564))),
        f"{_OMELYAN}, eqs. (50)–(51), five forces and three force gradients",
        gradients={1: 2.0 * 0.0008642161339706166, 3: -2.0 * 0.01324638643416052, 5: 2.0 * 0.0008642161339706166}),
)
# fmt: on

SCHEMES: dict[str, Scheme] = {scheme.name: scheme for scheme in _TABLE}
_registered: dict[str, Scheme] = {}


def scheme_named(name: str) -> Scheme:
    """Return the scheme of that name: of `SCHEMES`, one that was registered, or that of an installed plug-in.

    A ValueError if there is none; an ImportError if the plug-in cannot be loaded, or announces something else.
    """
    if name in SCHEMES:
        return SCHEMES[name]
    if name in _registered:
        return _registered[name]
    point = announced_schemes().get(name)
    if point is None:
        known = sorted({*SCHEMES, *_registered, *announced_schemes()})
        raise ValueError(f"`scheme` {name!r} is unknown: choose one of {', '.join(known)}.")
    scheme = load_announced(point, "scheme")
    try:
        return checked_scheme(scheme)
    except (TypeError, ValueError) as error:
        raise ImportError(
            f"`scheme` {name!r} of the plug-in {distribution(point)} is not a usable scheme ({error}): report this to "
            "its author."
        ) from error


def register_scheme(name: str, scheme: Scheme) -> None:
    """Make a scheme known by name in this process; `sympflow.register` does so, and makes it a method."""
    _registered[name] = checked_scheme(scheme)


@cache
def announced_schemes() -> dict[str, EntryPoint]:
    """Return the entry points of the schemes of installed plug-ins, by name."""
    return announced(GROUP, "scheme", SCHEMES)


def checked_scheme(scheme: Any) -> Scheme:
    """Return the scheme, if it is one of finite numbers that is consistent where it declares an order.

    A TypeError for anything but a Scheme of numbers; a ValueError if a number is not finite, the order is not a
    positive integer, or kicks or drifts do not add up to 1.
    """
    if not isinstance(scheme, Scheme):
        raise TypeError(
            f"`scheme` must be a sympflow.Scheme or the name of one; got {type(scheme).__name__}: make one with "
            "Scheme(name, order, kicks, drifts)."
        )
    numbers = (*scheme.kicks, *scheme.drifts, *scheme.gradients, *scheme.curvatures)
    if not all(isinstance(x, int | float) for x in numbers):
        raise TypeError(f"`scheme` {scheme.name!r} must have coefficients that are numbers; got {numbers}.")
    if not all(map(isfinite, numbers)):
        raise ValueError(f"`scheme` {scheme.name!r} must have finite coefficients; got {numbers}.")
    order = scheme.order
    if order is None:
        return scheme
    if not isinstance(order, int) or isinstance(order, bool) or order < 1:
        raise ValueError(f"`scheme` {scheme.name!r} must have a positive integer or None as `order`; got {order!r}.")
    for column in ("kicks", "drifts"):
        total = fsum(getattr(scheme, column))
        if abs(total - 1) > 1e-12:
            raise ValueError(
                f"`scheme` {scheme.name!r} has {column} that add up to {total!r}, and order {order} needs 1: correct "
                "the table, or declare order=None."
            )
    return scheme


def scheme_evaluations(scheme: Scheme, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
    """Evaluations of the force, of force gradients and of curvature terms in a run, as `FixedStep.evaluations`."""
    counts = scheme.counts.items()
    if backend != "compiled":
        return {name: (n_steps + n_extra) * whole for name, (_, whole, _) in counts}
    # compiled, the last kick of a step is merged with the next step's first, except where a state is saved
    return {name: n_steps * run + n_saved * closing + n_extra * whole for name, (run, whole, closing) in counts}


# pairs of a kick and a drift -----------------------------------------------------------------------------------------

Substeps = Sequence[tuple[float, float, float]]
"""Kicks, the drifts after them, and the force gradients of the kicks, one after the other, of a step of length 1."""


def paired(maps: Sequence[tuple[str, float, float]]) -> Substeps:
    """Kicks, each with the drift after it, and its force gradient, of maps of these kinds."""
    pairs: list[tuple[float, float, float]] = []
    for kind, c, third in maps:
        if kind == "kick":
            pairs.append((c, 0.0, third))
        elif pairs and not pairs[-1][1]:
            pairs[-1] = pairs[-1][0], c, pairs[-1][2]
        else:
            pairs.append((0.0, c, 0.0))
    return pairs


def reversed_substeps(substeps: Substeps) -> Substeps:
    """The inverse of substeps, for steps of the same length."""
    kicks, drifts = [(-b, -c) for b, _, c in substeps[::-1]], [-a for _, a, _ in substeps[::-1]]
    return [(b, a, c) for (b, c), a in zip([(0.0, 0.0), *kicks], [*drifts, 0.0], strict=True)]


CORRECTORS = range(3, 18, 2)
"""The orders in dt to which correctors remove the errors of first order in a small kick."""
_SPACING = Fraction(7, 40)  # of the kicks, squared, in steps


@cache
def corrector_maps(order: int, sign: int = 1, symmetric: bool = False) -> tuple[tuple[str, float], ...]:
    """Return the processor of drift–kick–drift steps with small kicks: kicks and drifts in units of the step.

    Kicks bᵢ and −bᵢ at ±aᵢ, aᵢ = i√(7/40), with Σ 2bᵢ sinh(aᵢz) = ((z/2)/sinh(z/2) − 1)/z up to z^(order − 2), remove
    the errors ε dt² … ε dt^(order − 1) of the energy.

    Parameters
    ----------
    order : int
        Odd, from 3 to 17.
    sign : int
        1 for the map before the steps, −1 for its inverse, before an output.
    symmetric : bool
        True for a palindrome, twice as long, whose logarithm is odd in ε: as kicks with force gradients want it, whose
        errors ε² dt² are removed, where those of an asymmetric corrector would be ε² dt³.

    References
    ----------
    .. [1] J. Wisdom, M. Holman, J. Touma, "Symplectic correctors", Fields Inst. Commun. 10 (1996) 217–244.
    .. [2] J. Wisdom, "Symplectic correctors for canonical heliocentric n-body maps", Astron. J. 131 (2006) 2294–2298.
    """
    n = (order - 1) // 2
    squares = [_SPACING * i * i for i in range(1, n + 1)]
    rows = [[2 * s**r / factorial(2 * r + 1) for s in squares] for r in range(n)]
    values = [(Fraction(2) ** (1 - 2 * k) - 1) * _bernoulli(2 * k) / factorial(2 * k) for k in range(1, n + 1)]
    places = [sqrt(s) for s in squares]
    kicks = [float(x) / a for x, a in zip(_solved(rows, values), places, strict=True)]
    maps = [pair for a, b in zip(places, kicks, strict=True) for pair in ((a, b), (-a, -b))]
    if symmetric:
        half = [(a, b / 2) for a, b in maps[:-1]]
        maps = [*half, maps[-1], *half[::-1]]
    if sign < 0:
        maps = [(a, -b) for a, b in reversed(maps)]
    found, at = [], 0.0
    for a, b in maps:
        found += [("drift", a - at), ("kick", b)]
        at = a
    return (*found, ("drift", -at))


@cache
def _bernoulli(n: int) -> Fraction:
    return Fraction(1) if n == 0 else -sum(comb(n + 1, k) * _bernoulli(k) for k in range(n)) / Fraction(n + 1)


def _solved(rows: list[list[Fraction]], values: list[Fraction]) -> list[Fraction]:
    """The solution of linear equations, exactly."""
    table = [[*row, value] for row, value in zip(rows, values, strict=True)]
    for k in range(len(table)):
        table[k] = [x / table[k][k] for x in table[k]]
        for i in range(len(table)):
            if i != k:
                table[i] = [x - table[i][k] * y for x, y in zip(table[i], table[k], strict=True)]
    return [row[-1] for row in table]
