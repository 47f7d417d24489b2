"""The methods by name: triples of a scheme, a splitting and a clock, and the classes of the others.

A new method of a known scheme, splitting and clock is a row of `TRIPLES`.
"""

from __future__ import annotations

from dataclasses import dataclass

from sympflow.integrators.tableaux import ADAPTIVE, FIXED, MULTISTEP
from sympflow.schemes import SCHEMES


@dataclass(frozen=True)
class Triple:
    """A method as a scheme × a splitting × a clock, by their names, and its source."""

    scheme: str
    splitting: str = "kinetic"
    clock: str = "physical"
    source: str = ""


_IMPULSE = (
    "H. Grubmüller, H. Heller, A. Windemuth and K. Schulten, Generalized Verlet algorithm for efficient molecular "
    "dynamics simulations with long-range interactions, Mol. Sim. 6 (1991) 121–142; M. Tuckerman, B. J. Berne and "
    "G. J. Martyna, J. Chem. Phys. 97 (1992) 1990–2001; as a trigonometric integrator P. Deuflhard, Z. angew. Math. "
    "Phys. 30 (1979) 177–189, φ = 1"
)
_MOLLIFIED = (
    "B. García-Archilla, J. M. Sanz-Serna and R. D. Skeel, Long-time-step methods for oscillatory differential "
    "equations, SIAM J. Sci. Comput. 20 (1998) 930–963, φ = sinc"
)
_LINEAR = (
    "R. I. McLachlan and G. R. W. Quispel, Splitting methods, Acta Numerica 11 (2002) 341–434, for Nyström schemes on "
    "parts that are quadratic"
)
_MIDPOINT = (
    "A. Stern and E. Grinspun, Implicit-explicit variational integration of highly oscillatory problems, Multiscale "
    "Model. Simul. 7 (2009) 1779–1794; R. I. McLachlan and A. Stern, Modified trigonometric integrators, SIAM J. "
    "Numer. Anal. 52 (2014) 1378–1397"
)
_COPIES = (
    "; on two coupled copies of phase space, for any H: M. Tao, Phys. Rev. E 94 (2016) 043303; P. Pihajoki, Celest. "
    "Mech. Dyn. Astron. 121 (2015) 211–231"
)
_KEPLER = (
    "J. Wisdom and M. Holman, Symplectic maps for the n-body problem, Astron. J. 102 (1991) 1528–1538; H. Rein, D. "
    "Tamayo and G. Brown, High-order symplectic integrators for planetary dynamics and their implementation in "
    "REBOUND, Mon. Not. R. Astron. Soc. 489 (2019) 4632–4640"
)
_LOGARITHMIC = (
    "S. Mikkola and K. Tanikawa, Celest. Mech. Dyn. Astron. 74 (1999) 287–295; M. Preto and S. Tremaine, Astron. J. "
    "118 (1999) 2532–2541"
)


def _of(name: str, addition: str) -> str:
    return SCHEMES[name].source + addition


LINEAR = (
    *("srkn6b", "srkn11b", "srkn14a", "omelyan4", "aba104", "aba864", "aba1064"),
    *("blanes_moan4", "kahan_li6", "kahan_li8"),
)
"""The schemes that have a name with the exact linear flow."""

TRIPLES: dict[str, Triple] = {
    **{name: Triple(name, source=scheme.source) for name, scheme in SCHEMES.items()},
    "impulse": Triple("verlet", "linear", source=_IMPULSE),
    "mollified_impulse": Triple("verlet", "mollified", source=_MOLLIFIED),
    "implicit_explicit": Triple("verlet", "midpoint", source=_MIDPOINT),
    **{
        f"linear_{name}": Triple(name, "linear", source=_of(name, f", with the exact linear flow; {_LINEAR}"))
        for name in LINEAR
    },
    "wisdom_holman": Triple("leapfrog", "kepler", source=_KEPLER),
    **{
        f"kepler_{name}": Triple(name, "kepler", source=_of(name, f", on Kepler's motion | interaction; {_KEPLER}"))
        for name in ("takahashi_imada", "aba104", "aba864", "aba1064")
    },
    "strang_parts": Triple(
        "verlet", "parts", source="G. Strang, SIAM J. Numer. Anal. 5 (1968) 506–517, for any number of parts"
    ),
    **{
        f"{name}_parts": Triple(name, "parts", source=_of(name, "; of Strang steps over any number of parts"))
        for name in ("suzuki4", "kahan_li6", "kahan_li8")
    },
    **{
        f"tao{order}": Triple(name, "copies", source=_of(name, _COPIES))
        for order, name in ((2, "verlet"), (4, "suzuki4"), (6, "kahan_li6"), (8, "kahan_li8"))
    },
    **{
        f"log_{name}": Triple(name, clock="logarithmic", source=f"{_of(name, '')}; {_LOGARITHMIC}")
        for name in ("leapfrog", "blanes_moan4", "kahan_li8")
    },
}
"""The splitting methods. `wisdom_holman` and `kepler_*` are for planets, `linear_*` have the exact linear flow,
`*_parts` any number of parts, `tao*` are for any H, on two copies of phase space, `log_*` have steps that are equal on
the logarithmic Hamiltonian."""
CLASSES: dict[str, str] = {
    "rk45": "scipy_methods:RK45",
    "dop853": "scipy_methods:DOP853",
    "sympflow": "flows:SympFlowIntegrator",
    "mlp": "flows:MLPIntegrator",
    "implicit_midpoint": "implicit:ImplicitMidpoint",
    "gauss_legendre4": "implicit:GaussLegendre4",
    "gauss_legendre6": "implicit:GaussLegendre6",
    "gauss_legendre8": "implicit:GaussLegendre8",
}
"""The other methods: module and class."""
UNLISTED = {"log_sympflow": "flows:LogSympFlow", "projected": "projected:Projected"}
"""Classes that stand on others: what "sympflow" resolves to for a flow in another time, and the steps of another method
on a doubled system, projected."""
TORCHDIFFEQ = (*ADAPTIVE, *FIXED, *MULTISTEP)
NAMES = frozenset((*TRIPLES, *CLASSES, *TORCHDIFFEQ))
"""The names of all built-in methods."""
