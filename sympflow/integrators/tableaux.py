"""The explicit Runge–Kutta tableaux of torchdiffeq's solvers, as data: stages A, weights B, order and source.

The tests compare a step of each with the step that torchdiffeq takes.
"""

from __future__ import annotations

from dataclasses import dataclass

Row = tuple[float, ...]


@dataclass(frozen=True)
class Tableau:
    """Stages K_i = f(y + h Σ_j A_ij K_j) and the step y + h Σ_i B_i K_i.

    Attributes
    ----------
    middle : tuple of float
        Weights of the state at the middle of the step, y + h Σ_i middle_i K_i, from which the dense output is
        interpolated; the last stage is the slope that torchdiffeq carries to the next step. Empty for fixed steps.
    carries_slope : bool
        torchdiffeq begins the next step with the slope of the last stage, which here is not the slope at y₁: the run is
        then not the iteration of a one-step map.
    """

    A: tuple[Row, ...]
    B: Row
    order: int
    source: str
    carries_slope: bool = False
    middle: Row = ()


FIXED = {
    "euler": Tableau(((),), (1.0,), 1, "L. Euler (1768)"),
    "midpoint": Tableau(((), (1 / 2,)), (0.0, 1.0), 2, "C. Runge, Math. Ann. 46 (1895) 167–178; the explicit one"),
    "heun2": Tableau(((), (1.0,)), (1 / 2, 1 / 2), 2, "K. Heun, Z. Math. Phys. 45 (1900) 23–38"),
    "heun3": Tableau(((), (1 / 3,), (0.0, 2 / 3)), (1 / 4, 0.0, 3 / 4), 3, "K. Heun, Z. Math. Phys. 45 (1900) 23–38"),
    "rk4": Tableau(
        ((), (1 / 3,), (-1 / 3, 1.0), (1.0, -1.0, 1.0)),
        (1 / 8, 3 / 8, 3 / 8, 1 / 8),
        4,
        "W. Kutta, Z. Math. Phys. 46 (1901) 435–453, the 3/8 rule",
    ),
}

_DOPRI8_A = (
    (),
    (1 / 18,),
    (1 / 48, 1 / 16),
    (1 / 32, 0, 3 / 32),
    (5 / 16, 0, -75 / 64, 75 / 64),
    (3 / 80, 0, 0, 3 / 16, 3 / 20),
    (29443841 / 614563906, 0, 0, 77736538 / 692538347, -28693883 / 1125000000, 23124283 / 1800000000),
    (
        *(16016141 / 946692911, 0, 0, 61564180 / 158732637, 22789713 / 633445777),
        *(545815736 / 2771057229, -180193667 / 1043307555),
    ),
    (
        *(39632708 / 573591083, 0, 0, -433636366 / 683701615, -421739975 / 2616292301),
        *(100302831 / 723423059, 790204164 / 839813087, 800635310 / 3783071287),
    ),
    (
        *(246121993 / 1340847787, 0, 0, -37695042795 / 15268766246, -309121744 / 1061227803),
        *(-12992083 / 490766935, 6005943493 / 2108947869, 393006217 / 1396673457, 123872331 / 1001029789),
    ),
    (
        *(-1028468189 / 846180014, 0, 0, 8478235783 / 508512852, 1311729495 / 1432422823),
        *(-10304129995 / 1701304382, -48777925059 / 3047939560, 15336726248 / 1032824649),
        *(-45442868181 / 3398467696, 3065993473 / 597172653),
    ),
    (
        *(185892177 / 718116043, 0, 0, -3185094517 / 667107341, -477755414 / 1098053517),
        *(-703635378 / 230739211, 5731566787 / 1027545527, 5232866602 / 850066563),
        *(-4093664535 / 808688257, 3962137247 / 1805957418, 65686358 / 487910083),
    ),
    (
        *(403863854 / 491063109, 0, 0, -5068492393 / 434740067, -411421997 / 543043805),
        *(652783627 / 914296604, 11173962825 / 925320556, -13158990841 / 6184727034),
        *(3936647629 / 1978049680, -160528059 / 685178525, 248638103 / 1413531060, 0),
    ),
)
_DOPRI8_B = (
    *(14005451 / 335480064, 0, 0, 0, 0, -59238493 / 1068277825, 181606767 / 758867731, 561292985 / 797845732),
    *(-1041891430 / 1371343529, 760417239 / 1151165299, 118820643 / 751138087, -528747749 / 2220607170, 1 / 4),
)
# torchdiffeq's interpolation; for "dopri5" Shampine's, Math. Comp. 46 (1986) 135–150
_DOPRI8_MIDDLE = (
    *(0.04103130360739393, 0, 0, 0, 0, 0.05100562801991382, 0.2388930677412202, 0.3096870143996103),
    *(-0.2172325471755352, 0.07833405679331928, -0.0018614369715579948, 0.007072844202678841),
    *(0.00690847373200576, -0.013838404349047373),
)

ADAPTIVE = {
    "dopri5": Tableau(
        (
            (),
            (1 / 5,),
            (3 / 40, 9 / 40),
            (44 / 45, -56 / 15, 32 / 9),
            (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
            (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
        ),
        (35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
        5,
        "J. R. Dormand, P. J. Prince, J. Comput. Appl. Math. 6 (1980) 19–26",
        middle=(
            *(6025192743 / 60171106304, 0, 51252292925 / 130801643196, -2691868925 / 90256659456),
            *(187940372067 / 3189068634112, -1776094331 / 39487288512, 11237099 / 470086768),
        ),
    ),
    "dopri8": Tableau(
        _DOPRI8_A,
        _DOPRI8_B,
        8,
        "P. J. Prince, J. R. Dormand, J. Comput. Appl. Math. 7 (1981) 67–75",
        middle=_DOPRI8_MIDDLE,
    ),
    "bosh3": Tableau(
        ((), (1 / 2,), (0.0, 3 / 4)),
        (2 / 9, 1 / 3, 4 / 9),
        3,
        "P. Bogacki, L. F. Shampine, Appl. Math. Lett. 2 (1989) 321–325",
        middle=(0.0, 1 / 2, 0.0, 0.0),
    ),
    "fehlberg2": Tableau(
        ((), (1 / 2,), (1 / 256, 255 / 256)),
        (1 / 512, 255 / 256, 1 / 512),
        2,
        "E. Fehlberg, NASA Technical Report R-315 (1969)",
        carries_slope=True,
        middle=(0.0, 1 / 2, 0.0),
    ),
    "adaptive_heun": Tableau(
        ((), (1.0,)),
        (1 / 2, 1 / 2),
        2,
        "K. Heun, Z. Math. Phys. 45 (1900) 23–38",
        carries_slope=True,
        middle=(1 / 2, 0.0),
    ),
}

MULTISTEP = {"explicit_adams": 3, "implicit_adams": 4}
"""Orders with `max_order` 4, the default: Adams–Bashforth then uses three slopes, Adams–Moulton four."""
