"""The splitting schemes by name: tables of numbers, each with its order and its source.

Coefficients are in the convention of `sympflow.integrators.scheme`.
"""

from __future__ import annotations

from itertools import pairwise
from math import sqrt

from sympflow.integrators.scheme import Scheme

__all__ = ["SCHEMES", "compose"]


def _kick_first(kicks: tuple[float, ...], drifts: tuple[float, ...]) -> tuple[tuple[float, ...], ...]:
    return kicks, (*drifts, 0.0)


def _drift_first(drifts: tuple[float, ...], kicks: tuple[float, ...]) -> tuple[tuple[float, ...], ...]:
    return (0.0, *kicks), drifts


def _palindrome(half: tuple[float, ...], total: float = 1.0) -> tuple[float, ...]:
    """Coefficients w₁ … w_m, w₀, w_m … w₁ with the middle one making the sum `total`."""
    return (*half, total - 2.0 * sum(half), *reversed(half))


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

_TABLE = (
    _scheme(
        "verlet",
        2,
        _kick_first((0.5, 0.5), (1.0,)),
        "L. Verlet, Phys. Rev. 159 (1967) 98–103; kick–drift–kick form (velocity Verlet)",
    ),
    _scheme(
        "leapfrog",
        2,
        _drift_first((0.5, 0.5), (1.0,)),
        "Störmer–Verlet in drift–kick–drift form; E. Hairer, C. Lubich and G. Wanner, Geometric numerical "
        "integration illustrated by the Störmer–Verlet method, Acta Numerica 12 (2003) 399–450",
    ),
    compose(
        "yoshida4",
        4,
        _palindrome((_YOSHIDA4_WEIGHT,)),
        f"{_YOSHIDA}, eq. (2.11); E. Forest and R. D. Ruth (1990)",
    ),
    compose(
        "yoshida6",
        6,
        _palindrome((0.78451361047755726381949763, 0.23557321335935813368479318, -1.17767998417887100694641568)),
        f"{_YOSHIDA}, solution A of table 1",
    ),
    compose(
        "suzuki4",
        4,
        _palindrome((_SUZUKI4_WEIGHT, _SUZUKI4_WEIGHT)),
        "M. Suzuki, Fractal decomposition of exponential operators, Phys. Lett. A 146 (1990) 319–323",
    ),
    _scheme(
        "mclachlan4",
        4,
        _adjoint_composition(_MCLACHLAN4_ALPHAS),
        "R. I. McLachlan, On the numerical integration of ordinary differential equations by symmetric "
        "composition methods, SIAM J. Sci. Comput. 16 (1995) 151–168, five stages and their adjoints",
    ),
    _scheme(
        "blanes_moan4",
        4,
        _kick_first(
            _palindrome((0.0792036964311957, 0.353172906049774, -0.0420650803577195)),
            _even_palindrome((0.209515106613362, -0.143851773179818)),
        ),
        f"{_BLANES_MOAN}, table 2, S6 of order 4",
    ),
    compose(
        "kahan_li6",
        6,
        _palindrome(
            (
                0.39216144400731413927925056,
                0.33259913678935943859974864,
                -0.70624617255763935980996482,
                0.08221359629355080023149045,
            )
        ),
        f"{_KAHAN_LI}, s9odr6a",
    ),
    compose(
        "kahan_li8",
        8,
        _palindrome(
            (
                0.13020248308889008087881763,
                0.56116298177510838456196441,
                -0.38947496264484728640807860,
                0.15884190655515560089621075,
                -0.39590389413323757733623154,
                0.18453964097831570709183254,
                0.25837438768632204729397911,
                0.29501172360931029887096624,
            )
        ),
        f"{_KAHAN_LI}, s17odr8a",
    ),
    _scheme(
        "srkn6b",
        4,
        _kick_first(
            _palindrome((0.0829844064174052, 0.396309801498368, -0.0390563049223486)),
            _even_palindrome((0.245298957184271, 0.604872665711080)),
        ),
        f"{_BLANES_MOAN}, table 3, SRKN 6b",  # tuned for a quadratic T; being symmetric, of order 4 for any
    ),
    _scheme(
        "srkn11b",
        6,
        _kick_first(
            _even_palindrome(
                (
                    0.0414649985182624,
                    0.198128671918067,
                    -0.0400061921041533,
                    0.0752539843015807,
                    -0.0115113874206879,
                )
            ),
            _palindrome(
                (
                    0.123229775946271,
                    0.290553797799558,
                    -0.127049212625417,
                    -0.246331761062075,
                    0.357208872795928,
                )
            ),
        ),
        f"{_BLANES_MOAN}, table 3, SRKN 11b",
        nystrom=True,
    ),
    _scheme(
        "srkn14a",
        6,
        _drift_first(
            _palindrome(
                (
                    0.0378593198406116,
                    0.102635633102435,
                    -0.0258678882665587,
                    0.314241403071447,
                    -0.130144459517415,
                    0.106417700369543,
                    -0.00879424312851058,
                )
            ),
            _even_palindrome(
                (
                    0.09171915262446165,
                    0.183983170005006,
                    -0.05653436583288827,
                    0.004914688774712854,
                    0.143761127168358,
                    0.328567693746804,
                )
            ),
        ),
        f"{_BLANES_MOAN}, table 3, SRKN 14a",
        nystrom=True,
    ),
    _scheme(
        "chin4a",
        4,
        _kick_first((1.0 / 6.0, 2.0 / 3.0, 1.0 / 6.0), (0.5, 0.5)),
        f"{_CHIN}, scheme A",
        gradients={1: 1.0 / 36.0},
    ),
    _scheme(
        "chin4c",
        4,
        _drift_first((1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0), (3.0 / 8.0, 1.0 / 4.0, 3.0 / 8.0)),
        f"{_CHIN}, scheme C",
        gradients={2: 1.0 / 96.0},
    ),
    _scheme(
        "omelyan4",
        4,
        _drift_first(
            _even_palindrome((_OMELYAN4_THETA,)),
            _palindrome((_OMELYAN4_LAMBDA,)),
        ),
        f"{_OMELYAN}, eqs. (38)–(42), three forces and one force gradient",
        gradients={2: 2.0 * _OMELYAN4_CHI},
    ),
    _scheme(
        "omelyan6",
        6,
        _drift_first(
            _even_palindrome((0.1097059723948682, 0.4140632267310831)),
            _palindrome((0.2693315848935301, 1.1319803486515564)),
        ),
        f"{_OMELYAN}, eqs. (50)–(51), five forces and three force gradients",
        gradients={
            1: 2.0 * 0.0008642161339706166,
            3: -2.0 * 0.01324638643416052,
            5: 2.0 * 0.0008642161339706166,
        },
    ),
)

SCHEMES: dict[str, Scheme] = {scheme.name: scheme for scheme in _TABLE}
