"""HamiltonianSystem: H, from symbols or functions, with the scene it is usually solved in."""

from __future__ import annotations

import copy
import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from types import FunctionType, MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, NoReturn, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import advice, check_flag, check_positive, checked_count, floats, real_number, warn
from sympflow.arrays import Array, learnable, one_lane, to_numpy
from sympflow.hamiltonian.definition import bare_copy
from sympflow.hamiltonian.domain import Domain, domain_of
from sympflow.hamiltonian.fingerprint import fingerprint
from sympflow.hamiltonian.friction import Friction
from sympflow.hamiltonian.hamiltonian import Hamiltonian
from sympflow.hamiltonian.linear_part import checked_damping, checked_inverse_mass, checked_stiffness, numeric
from sympflow.hamiltonian.parameters import checked_params
from sympflow.hamiltonian.times import check_period, probe_times
from sympflow.hamiltonian.written import WrittenHamiltonian, written
from sympflow.show.cards import Answering, Card, brief, numbers

if TYPE_CHECKING:
    import sympy

    from sympflow.hamiltonian.lattice_states import LatticeStates
    from sympflow.hamiltonian.linear_part import LinearPart
    from sympflow.hamiltonian.local import LocalHamiltonian
    from sympflow.hamiltonian.symbolic import Kick, SymbolicHamiltonian

MOST_DEGREES = 1_000_000
TYPESET = 400  # characters of an H that notebooks typeset
GREEK = {"omega": "ω", "mu": "μ", "epsilon": "ε", "alpha": "α", "beta": "β"}
PROPER = {"henon_heiles": "Hénon–Heiles"}
SHOWN_NAMES = (
    *("autonomous", "conservative", "damping", "domain", "dt", "energy_scale", "exact", "expression", "force"),
    *("from_sympy", "gradient", "hamiltonian", "hessian", "kinetic", "lattice", "linear_part", "name", "ndof", "pairs"),
    *("params", "period", "planets", "potential", "program", "schroedinger", "separable", "symbols", "t_span"),
    *("vector_field", "velocity"),
    *("with_force", "with_params", "with_scene", "y0"),
)
"""The attributes that `dir` lists: those that users need. All others are for methods and studies."""
MOST_WRITTEN_OUT = 400
"""Coordinates of an expression before a warning: 512 of a chain take 2 s to define, and a step 14 times as long."""
MEANT = {
    **dict.fromkeys(
        ("dim", "dimension", "dimensions"),
        "degrees of freedom are `ndof` of functions, `dim` of pairs, and read from a formula.",
    ),
    "mass": "masses are in T(p), or `masses` of pairs.",
    **dict.fromkeys(
        ("site", "sites", "n_sites"), "the number of sites of a lattice is `shape`, their potential `onsite`."
    ),
    **dict.fromkeys(
        ("V", "U"), "a potential is `potential`, a function of q, or is a part of H as text, by from_sympy."
    ),
    **dict.fromkeys(("H", "energy"), "H is `hamiltonian`, a function of q and p, or text, by from_sympy."),
    **dict.fromkeys(("k", "m", "g", "constants"), "values of symbols are `params`, as params={'k': 1.0}."),
    "names": "the bodies have numbers, from 0, in the order of `masses`.",
}
"""Remedies for arguments that other packages have."""


class SceneOptions(TypedDict, total=False):
    """The arguments of a scene, as every constructor of a system takes them."""

    name: str
    domain: Domain | None
    y0: ArrayLike | None
    t_span: tuple[float, float]
    dt: float | None
    energy_scale: float | None
    exact: Callable[[Any], Array] | None


SCENE = (*SceneOptions.__annotations__,)


@dataclass(frozen=True)
class Scene:
    """The defaults with which a system is solved: see `HamiltonianSystem`."""

    name: str = ""
    domain: Domain | None = None
    y0: Any = None
    t_span: tuple[float, float] = (0.0, 100.0)
    dt: float | None = None
    energy_scale: float | None = None
    exact: Callable[[Any], Array] | None = None

    def __post_init__(self) -> None:
        if self.exact is not None and not callable(self.exact):
            raise TypeError(f"`exact` must be a function of the time; got {type(self.exact).__name__}.")
        if self.dt is not None and not (real_number(self.dt) and 0 < self.dt < 1e100):
            raise ValueError(f"`dt` must be positive and finite; got {self.dt!r}.")
        try:
            t0, t1 = (float(t) for t in self.t_span)
        except (TypeError, ValueError, OverflowError):
            t0 = t1 = math.nan
        if not math.isfinite(t1 - t0):
            raise ValueError(f"`t_span` must be two finite numbers, start and end; got {self.t_span!r}.")
        scale = self.energy_scale
        if scale is not None and not (real_number(scale) and 0 < scale <= sys.float_info.max):
            raise ValueError(f"`energy_scale` must be positive and finite; got {scale!r}.")
        if self.domain is not None and not isinstance(self.domain, Domain):
            kind = type(self.domain).__name__
            raise TypeError(f"`domain` must be a domain such as sympflow.Box(low, high); got {kind}.")
        object.__setattr__(self, "t_span", (t0, t1))
        object.__setattr__(self, "dt", None if self.dt is None else float(self.dt))

    @classmethod
    def given(cls, options: Mapping[str, Any], **defaults: Any) -> Scene:
        """Return the scene of the options of a constructor, over its defaults."""
        options = {name: value for name, value in options.items() if name != "time" or value is not None}
        if "time" in options:
            raise TypeError(
                "`time` is for systems that are written out, and lattices and pairs do not depend on it: leave it out, "
                "or write H out by HamiltonianSystem.from_sympy(..., time='t')."
            )
        for name in options:
            if name not in SCENE:
                remedy = MEANT.get(name) or advice(name, (*SCENE, "params")) or "remove it."
                raise TypeError(
                    f"`{name}` is not an argument of this system, nor of its scene, {', '.join(SCENE)}: {remedy}"
                )
        return cls(**{**defaults, **options})

    def state(self, ndof: int) -> np.ndarray | None:
        """Return y0, checked to be a state of so many degrees of freedom: a copy of floats."""
        if self.y0 is None:
            return None
        try:
            state = floats("y0", self.y0)
        except OverflowError:
            raise ValueError("`y0` must be finite: it has an integer too large for a float.") from None
        if state.shape != (2 * ndof,):
            raise ValueError(f"`y0` must have shape ({2 * ndof},), [q, p]; got {state.shape}.")
        return state


class _OfScene:
    """An attribute of a system that its scene holds."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, system: Any, owner: type | None = None) -> Any:
        return self if system is None else getattr(system._scene, self.name)

    def __set__(self, system: Any, value: Any) -> None:
        raise AttributeError(self.name)  # see `HamiltonianSystem.__setattr__`


class Parameters(dict[str, Any]):
    """The parameters of a system: a dictionary that cannot be changed, for the code of H holds their values."""

    def _refuse(self, *args: Any, **kwargs: Any) -> NoReturn:
        raise TypeError(
            "`params` of a system are read-only, because its forces would not change: make a system with other "
            "parameters, by its scene's function or by HamiltonianSystem.from_sympy(..., params=...)."
        )

    __setitem__ = __delitem__ = __ior__ = _refuse
    update = setdefault = pop = popitem = clear = _refuse

    def __reduce__(self) -> tuple[Any, ...]:
        return Parameters, (dict(self),)


class HamiltonianSystem(Hamiltonian, Answering):
    """A Hamiltonian system x' = J∇H(x), x = [q, p]; with `time` H(t, x); with `damping` p' = −∂H/∂q − Γp.

    Parameters
    ----------
    potential : callable, optional
        V(q), q of shape (..., d), returning (...), written with NumPy or torch. Then H = ½ pᵀM⁻¹p + V(q) is separable.
        It is traced once, differentiated exactly and compiled; `program` is the result. A function that cannot be
        traced, such as one that branches on a value, runs as it is, and `repr` shows the reason: then it must be
        written with torch, or have a `gradient`. With Numba functions (`potential`, `gradient` and `hessian_vector`)
        the system runs compiled. A function that writes into q is a ValueError; so is a gradient that is not that of V:
        see `check_functions`.
    hamiltonian : callable, optional
        H(q, p). Give this or `potential`. Where H is traced and found to be T(p) + V(q), the system is separable.
    ndof : int
        Degrees of freedom d.
    mass : float or array_like of shape (d,) or (d, d), optional
        M, symmetric positive definite; the default is 1. Only with `potential`. Gradients flow to a tensor that
        requires them.
    gradient : callable, optional
        ∇V(q), (..., d) to (..., d); as a Numba function: gradient(q, out).
    hessian_vector : callable, optional
        ∇²V(q)·v, (..., d), (..., d) to (..., d); as a Numba function: hessian_vector(q, v, out).
    stiffness_matrix : array_like of shape (d, d), optional
        A symmetric K: methods with an exact linear flow take ½ qᵀKq, a part of the potential, as their `linear_part`.
        Only with `potential`; for a symbolic system it follows from H.
    time : bool
        True for a driven system: the first argument of every function is the time t, a number: V(t, q),
        gradient(t, q), hessian_vector(t, q, v), H(t, q, p); as Numba functions gradient(t, q, out) and
        hessian_vector(t, q, v, out). Functions of the system then take the time after the states.
    period : float, optional
        The period of H in t, for a driven system; a wrong value is a ValueError. It is the default of sections and
        multipliers.
    damping : float or array_like of shape (d,) or (d, d), optional
        Γ: one rate, one for each p, or a symmetric positive semi-definite matrix; 0 for none. Splitting
        methods on the splitting "kinetic", Gauss and Runge–Kutta methods solve it; all others refuse it, with the
        reason.
    name : str
    domain : Domain, optional
        Ω, the states on which flows are trained. Classical methods do not need it.
    y0 : array_like of shape (2d,), optional
        Default initial state.
    t_span : (float, float)
        Default interval.
    dt : float, optional
        Default step of the fixed-step classical methods. Without it, `system.dt` is 0.05/ω, to two digits, with the
        largest frequency or rate ω of the linearised motion at `y0`, or over the domain; 0.05 where there is none. For
        a system without both of these, `solve` takes ω at its `y0`.
    energy_scale : float, optional
        The scale of relative energy errors; the default is |H(y0)|.
    exact : callable, optional
        The exact solution from `y0` at the beginning of `t_span`, if it is known: exact(t), times (...) to states (...,
        2d). It is for comparison only; no method uses it.
    check : bool
        False omits the test of the functions at the first use of the system, see `check_functions`.

    Attributes
    ----------
    separable : bool
        Whether H = T(p) + V(q).
    quadratic_kinetic : bool
        Whether T = ½ pᵀM⁻¹p.
    inverse_mass : None or ndarray of shape (d,) or (d, d)
        M⁻¹, None when it is the identity or T is not quadratic.
    symbols : SymbolicHamiltonian or None
        The symbolic definition, if there is one.
    autonomous : bool
        False if H depends on t.
    exact : callable or None
        The exact solution, of scenes that have one.

    Examples
    --------
    >>> system = HamiltonianSystem.from_sympy("p**2/2 + 1 - cos(q)")
    >>> system.force(np.array([0.0]))
    array([-0.])
    """

    _OTHER_NAMES: ClassVar[Mapping[str, str]] = {
        **dict.fromkeys(("solve", "integrate", "run", "simulate"), "sympflow.solve(system, method, t_span, y0)"),
        **{
            name: f"sympflow.{name}(system)"
            for name in ("train", "lyapunov", "ensemble", "compare", "poincare_section")
        },
        **dict.fromkeys(("plot", "animate"), "`plot()` of a solution, solve(system, t_span=(0, 100)).plot()"),
        **dict.fromkeys(("H", "energy"), "`hamiltonian(y)` for its values, `expression` for the formula"),
        **dict.fromkeys(("V", "U", "potential_energy"), "`potential(q)`"),
        **dict.fromkeys(("T", "K", "kinetic_energy"), "`kinetic(p)`"),
        **dict.fromkeys(("dim", "dimension", "n", "d", "dof"), "`ndof`"),
        **dict.fromkeys(("rhs", "f", "fun"), "`vector_field(y)`"),
        **dict.fromkeys(("grad", "jac", "jacobian"), "`gradient(y)`, or `hessian(y)`"),
        **dict.fromkeys(("parameters", "G", "constants"), "`params`"),
        **dict.fromkeys(("mass", "masses"), "`local.masses` of bodies, or T of the formula, `expression`"),
    }
    _period: float | None = None
    _former_period: float | None = None
    _continuous = True  # False of systems that are made of others, whose H may jump where solutions do not feel it
    y0, domain, t_span, energy_scale, exact = _OfScene(), _OfScene(), _OfScene(), _OfScene(), _OfScene()

    def __init__(
        self,
        potential: Callable[..., Array] | None = None,
        *,
        hamiltonian: Callable[..., Array] | None = None,
        ndof: int | None = None,
        mass: float | ArrayLike | None = None,
        gradient: Callable[..., Any] | None = None,
        hessian_vector: Callable[..., Any] | None = None,
        stiffness_matrix: ArrayLike | None = None,
        time: bool = False,
        period: float | None = None,
        damping: float | ArrayLike | None = None,
        check: bool = True,
        **scene: Unpack[SceneOptions],
    ) -> None:
        from sympflow.hamiltonian.callables import CallableHamiltonian

        settled = Scene.given(scene)
        for argument, H in (("potential", potential), ("hamiltonian", hamiltonian)):
            if isinstance(H, str):
                raise TypeError(
                    f"`{argument}` must be a function; got the text {H!r}: HamiltonianSystem.from_sympy takes it."
                )
        what = (
            f"a positive integer, at most {MOST_DEGREES:,}, the degrees of freedom, as in HamiltonianSystem(V, ndof=2)"
        )
        d = checked_count("ndof", ndof, 1, MOST_DEGREES, what)
        if isinstance(time, str):
            raise TypeError(f"`time` must be True for functions with t first; got {time!r}: names are for from_sympy.")
        check_flag("time", time)
        definition = CallableHamiltonian(d, potential, hamiltonian, gradient, hessian_vector, check, bool(time))
        for argument, value in (("mass", mass), ("stiffness_matrix", stiffness_matrix)):
            if value is not None and not definition.separable:
                raise TypeError(f"`{argument}` only goes with `potential`: leave it out, it is part of `hamiltonian`.")
        M: Any = mass
        followed = M if learnable(M) else None
        M = M if followed is None else to_numpy(M)
        inverse_mass, quadratic = checked_inverse_mass(M, d) if definition.separable else None, definition.separable
        K = None if stiffness_matrix is None else checked_stiffness(stiffness_matrix, d)
        if hamiltonian is not None:
            domain = settled.domain if isinstance(settled.domain, Domain) else None
            definition.place(settled.state(d), domain, None, settled.t_span)
            definition, inverse_mass, quadratic = definition.as_sum() or (bare_copy(definition), None, False)
        self.followed_mass = followed
        self._make(definition, inverse_mass, quadratic, {}, settled, damping, period, K)

    @classmethod
    def from_sympy(
        cls,
        expression: str | sympy.Expr,
        *,
        q: Sequence[Any] | None = None,
        p: Sequence[Any] | None = None,
        params: Mapping[str, Any] | None = None,
        time: str | sympy.Symbol | None = None,
        period: float | None = None,
        damping: float | ArrayLike | None = None,
        **scene: Unpack[SceneOptions],
    ) -> HamiltonianSystem:
        """A system from one symbolic definition of H in q1 … qd, p1 … pd (or q, p).

        NumPy, torch and Numba functions for H, its gradients and Hessians are generated from it.

        Parameters
        ----------
        expression : str or sympy.Expr
            In a text `pi` is a constant, and every other name is a symbol or a function: `E` and `I` are symbols;
            Euler's number is exp(1).
        q, p : sequence of str, sympy.Symbol or functions of the time, optional
            The names that coordinates and momenta have in the expression, such as ``q=["x", "y"], p=["px", "py"]`` or
            `dynamicsymbols`; in the system they are q1 … qd and p1 … pd.
        params : mapping of str to float, optional
            Values of the other symbols: finite real numbers. A name that is given here is a symbol, also if it is that
            of a constant or a function. `system.params` holds them, read-only. A spline of SciPy, such as
            `CubicSpline(t, a)` or `make_interp_spline(t, a)`, is a function of t; runs beyond its samples are refused,
            unless it is periodic.
        time : str or sympy.Symbol, optional
            The symbol of the time, such as "t", of a driven system H(t, q, p).
        period : float, optional
            The period of H in t; a wrong value is a ValueError.
        damping, name, domain, y0, t_span, dt, energy_scale, exact
            As for the class.

        Raises
        ------
        ValueError, TypeError
            If the expression cannot be parsed, has symbols without a value, or depends on a time that `time` does not
            name; if H does not depend on `time`, or has another period; if H jumps in q or p, or holds delta functions
            other than impulses DiracDelta(t − a)·W(q), which are kicks p −= ∇W(q) at the time a; if `damping` is not
            symmetric, has negative rates, or another shape.
        """
        plain = isinstance(expression, str) and q is None and p is None and time in (None, "t")
        checked = checked_params(params) if plain else {}
        if plain and (found := written(expression, checked, time is not None)) is not None:
            return cls._defined(found, found.inverse_mass, checked, Scene.given(scene), damping, period)
        from sympflow.hamiltonian.symbolic import SymbolicHamiltonian, renamed

        if q is not None or p is not None:
            expression = renamed(expression, q, p)
        params, settled = checked_params(params), Scene.given(scene)
        symbols = SymbolicHamiltonian(expression, params, time)
        if cls._continuous:
            symbols.check_continuous()
        if symbols.ndof > MOST_WRITTEN_OUT:
            warn(
                f"`expression` has {symbols.ndof} coordinates: written out, H takes seconds to define, and a step ten "
                "times as long as by HamiltonianSystem.lattice, from one site and one bond, or by "
                "HamiltonianSystem.pairs, from one pair. Use one of these."
            )
        return cls._defined(symbols, symbols.inverse_mass, params, settled, damping, period)

    @classmethod
    def _defined(
        cls,
        definition: SymbolicHamiltonian | WrittenHamiltonian,
        M: Any,
        params: Mapping[str, Any],
        scene: Scene,
        damping: float | ArrayLike | None,
        period: float | None = None,
    ) -> HamiltonianSystem:
        self = cls.__new__(cls)
        if isinstance(definition, WrittenHamiltonian):
            self._make(definition, M, True, params, scene, damping, period)
        else:
            self._make(definition, None if M is None else numeric(M), M is not None, params, scene, damping, period)
        return self

    @classmethod
    def lattice(
        cls,
        *,
        shape: int | Sequence[int],
        onsite: str | sympy.Expr | None = None,
        bond: str | sympy.Expr | Mapping[int, str | sympy.Expr] | None = None,
        boundary: str | Sequence[str] = "periodic",
        kinetic: str | sympy.Expr | None = None,
        fields: str | Sequence[str] = "q",
        params: Mapping[str, Any] | None = None,
        damping: float | ArrayLike | None = None,
        **scene: Unpack[SceneOptions],
    ) -> HamiltonianSystem:
        """A lattice of any size, H = Σ_sites [T(p) + U(q)] + Σ_bonds V(r), by expressions for one site and one bond.

        r is the difference along a bond, that of the site with the higher index along its axis less that of the lower:
        r = q[i + k] − q[i], around the end of a periodic axis too. V need not be even. Compiled loops
        over sites are generated, whose code does not depend on the size.

        Parameters
        ----------
        shape : int or sequence of up to three ints
            Sites along each axis. A state is y = [q, p]; q are the fields one after the other, each of this shape:
            ``q.reshape(len(fields), *shape)``.
        onsite : str or sympy.Expr, optional
            U of one site in its fields, such as "(q**2 - 1)**2/4".
        bond : str or sympy.Expr, or mapping of int to these, optional
            V of one bond in `r`, such as "r**2/2 + r**4/4", or of r_u, r_v of fields u and v; a mapping gives one for
            each distance of its ends, {1: "r**2/2", 2: "b*r**2"}. Bonds lie along every axis.
        boundary : {"periodic", "fixed", "free"}, or one for each axis
            "periodic": the last site is followed by the first. "fixed": beyond both ends all fields are 0, with bonds
            to these walls. "free": no bond reaches beyond an end.
        kinetic : str or sympy.Expr, optional
            T of one site in `p`, or p_u, p_v; the default is p**2/2 for each field.
        fields : str or sequence of str
            Names of the fields at a site.
        params : mapping of str to float or array of the lattice's shape, optional
            Values of the other symbols; an array has one for each site; a bond takes the value of its lower end, or of
            the first site where the lower end is a wall.
        damping, name, domain, y0, t_span, dt, energy_scale, exact
            As for the class.

        Raises
        ------
        ValueError, TypeError
            If an expression cannot be read or holds other names; if the shape, the boundary or the parameters do not
            fit each other; or if a run would need more memory than the machine has.

        Examples
        --------
        >>> system = HamiltonianSystem.lattice(bond="r**2/2 + r**4/4", shape=1024)
        >>> system.ndof
        1024
        """
        from sympflow.hamiltonian.lattice import LatticeHamiltonian

        local = LatticeHamiltonian(onsite, bond, shape, boundary, kinetic, fields, params)
        return cls._of_local(local, damping, Scene.given(scene, name="lattice"))

    @classmethod
    def pairs(
        cls,
        potential: str | sympy.Expr,
        *,
        masses: ArrayLike,
        dim: int = 3,
        box: float | Sequence[float] | None = None,
        cutoff: float | None = None,
        softening: float | None = None,
        params: Mapping[str, float] | None = None,
        bodies: Mapping[str, ArrayLike] | None = None,
        damping: float | ArrayLike | None = None,
        **scene: Unpack[SceneOptions],
    ) -> HamiltonianSystem:
        """Bodies that interact in pairs, any number of them: H = Σ_i |p_i|²/(2 m_i) + Σ_{i<j} V(r_ij).

        Both bodies of a pair get the same force, with opposite signs, along the line between them, so that the methods
        that conserve linear and angular momentum do so up to rounding. Without a cut-off a force costs O(n²), with one
        O(n). Compiled loops over pairs are generated, whose code depends neither on the number of bodies nor on any
        value.

        Parameters
        ----------
        potential : str or sympy.Expr
            V of one pair in its distance `r`, in the masses m1 and m2 of both, and in names of `params` and `bodies`,
            such as "-G*m1*m2/r". It must be the same with both bodies exchanged.
        masses : array_like of shape (n,)
        dim : int
            Coordinates of a body, 1 to 3. A state is y = [q, p]; ``q.reshape(n, dim)`` are the places of the bodies.
        box : float or sequence of `dim` floats, optional
            Lengths of a periodic box: r is the distance to the nearest image.
        cutoff : float, optional
            Distance beyond which bodies do not interact, at most half of the box. To keep H smooth, V is replaced by
            V(r) − V(c) − (r² − c²) V′(c)/(2c).
        softening : float, optional
            ε: r is √(|q_i − q_j|² + ε²), which is never 0.
        params : mapping of str to float, optional
            Values of names in V that are the same for all pairs.
        bodies : mapping of str to array_like of shape (n,), optional
            Values that differ from body to body: in V the values of "c" of the two bodies are c1 and c2.
        damping, name, domain, y0, t_span, dt, energy_scale, exact
            As for the class.

        Raises
        ------
        ValueError, TypeError
            If V cannot be read, holds other names, or is not symmetric; if masses are not positive; if arrays do not
            have one value for each body; if the cut-off is longer than half the box; or if a run would need more memory
            than the machine has.

        Examples
        --------
        >>> system = HamiltonianSystem.pairs("-m1*m2/r", masses=[1.0, 1e-3, 1e-4])
        >>> system.ndof
        9
        """
        from sympflow.hamiltonian.bodies import PairsHamiltonian

        local = PairsHamiltonian(potential, masses, dim, box, cutoff, softening, params, bodies)
        return cls._of_local(local, damping, Scene.given(scene, name="pairs", t_span=(0.0, 1.0)))

    @classmethod
    def planets(
        cls,
        masses: ArrayLike,
        *,
        elements: Mapping[str, ArrayLike] | ArrayLike | None = None,
        G: float | None = None,
        units: str | Sequence[str] | None = None,
        coordinates: str = "jacobi",
        encounter: float | None = 1.0,
        extra: str | sympy.Expr | None = None,
        params: Mapping[str, float] | None = None,
        **scene: Unpack[SceneOptions],
    ) -> HamiltonianSystem:
        """Planets about a star: H = Σ_i |p_i|²/(2 m_i) − G Σ_{i<j} m_i m_j/r_ij, for methods of the splitting "kepler".

        States are inertial, y = [q, p]; ``q.reshape(n, 3)`` are the places of the bodies, the star first. The methods
        "wisdom_holman" and "kepler_aba864" use other coordinates, but only inside a run. All other methods treat the
        system as one of `pairs`.

        Parameters
        ----------
        masses : array_like of shape (n,)
            The star, which is the heaviest, first. Bodies of mass 0 feel the others and exert no force; their momenta
            are per unit mass and do not enter H.
        elements : mapping of str to array_like of shape (n − 1,), or array_like of shape (n − 1, 6)
            Heliocentric orbital elements of the planets: "a", "e", "inc", "node" (ascending), "peri" (the argument of
            the pericentre) and "M" (the mean anomaly), in radians; all but a are 0 by default. Hyperbolas have e > 1
            and a < 0. The centre of mass is at rest at the origin. Give them or `y0`.
        G : float, optional
            The gravitational constant, by default 1.
        units : str or sequence of 3 str, optional
            In place of G: "SI", or names of a length ("AU", "km", "m"), a time ("day", "year", "s") and a mass
            ("solar mass", "Jupiter mass", "Earth mass", "kg"), such as "AU, day, solar mass".
        coordinates : {"jacobi", "democratic"}
            Coordinates inside a run: each planet relative to the centre of mass of all bodies inside its orbit
            (Jacobi), or relative to the star (democratic heliocentric), where the kicks include the motion of the star
            and are less accurate.
        encounter : float or None
            A run of the splitting "kepler" ends with status −1, the numbers of the planets and the time when two
            planets come closer to each other than this number of Hill radii. None to go on.
        extra : str or sympy.Expr, optional
            Φ, a further potential per unit mass of each body, Σ_i m_i Φ(q_i − q_0) in H, an expression in x, y, z and
            r, the position of a body relative to the star, m, the star's mass, G, and the names of `params`.
            ``"-3*(G*m/(c*r))**2"`` gives the precession of general relativity, and with z along the axis of the star
            ``"J2*G*m*R**2*(3*z**2/r**2 - 1)/(2*r**3)"`` is its flattening. The reaction acts on the star.
        params : mapping of str to float, optional
            Values of other names in `extra`.
        name, domain, y0, t_span, dt, energy_scale, exact
            As for the class; `t_span` is by default a thousand of the longest periods, `dt` a twentieth of the
            shortest; of planets that are bound to each other the step is chosen as for any system.

        Raises
        ------
        ValueError, TypeError
            If an argument is wrong, or the star is not the heaviest body.

        Examples
        --------
        >>> system = HamiltonianSystem.planets([1.0, 1e-3, 3e-4], elements={"a": [5.2, 9.6], "e": 0.05})
        >>> system.ndof
        9
        """
        from sympflow.hamiltonian.planets import PlanetsHamiltonian, checked_planets

        masses, G, y0 = checked_planets(masses, elements, scene.get("y0"), G, units)
        local = PlanetsHamiltonian(masses, G, y0, coordinates, encounter, extra, params)
        span = (0.0, 1000 * float(local.frame.periods.max()))
        with suppress(ValueError):  # of moons, whose step is left to the choice of the method
            local.frame.check("kepler")
            scene["dt"] = scene.get("dt") or local.frame.longest_step
        given = {name: value for name, value in scene.items() if value is not None} | {"y0": y0}
        return cls._of_local(local, None, Scene.given(given, name="planets", t_span=span))

    def subsystem(
        self, sites: int | Sequence[int] | None = None, boundary: str | Sequence[str] = "periodic"
    ) -> HamiltonianSystem:
        """A lattice of a few sites with the same terms, to which flows for large lattices are fitted.

        A ring has as many bonds per site as the inside of a large lattice with any ends.

        Parameters
        ----------
        sites : int or sequence of ints, optional
            Sites along each axis; the default is 6 of a lattice of one axis, 4 by 4 of one of two and 3 by 3 by 3 of
            one of three, more where bonds reach farther.
        boundary : str, or one for each axis
            As in `lattice`.

        Returns
        -------
        HamiltonianSystem
            Its domain is `sympflow.LatticeStates` of the same energy density, if the system has a domain or a `y0`.
            Arrays in `params` are cut to the first sites.

        Raises
        ------
        TypeError, ValueError
            If the system is not a lattice or has a rate of friction for each site, or the shape does not fit its bonds.

        Examples
        --------
        >>> HamiltonianSystem.lattice(bond="r**2/2 + r**4/4", shape=1024).subsystem(8).ndof
        8
        """
        if self.local is None:
            raise TypeError(
                f"`system` {self.name!r} is not a lattice, and only lattices have subsystems of a few sites: define it "
                "by HamiltonianSystem.lattice."
            )
        local = self.local.subsystem(sites, boundary)
        if self.damping is not None and self.damping.ndim:
            raise ValueError(
                f"`damping` of {self.name!r} differs from site to site, and a subsystem needs sites that are alike: "
                "give one rate."
            )
        domain = None
        with suppress(ValueError):  # of states at rest none follow
            domain = self.local_states()
        return HamiltonianSystem._of_local(local, self.damping, self._subsystem_scene(domain))

    def _subsystem_scene(self, domain: Domain | None) -> Scene:
        """The scene of a few of the sites or bodies."""
        return Scene(self.name, domain, None, self.t_span, self.dt)

    def local_states(self) -> LatticeStates | None:
        """The states at the energy density of the domain, or else of `y0`, for any size; None without both."""
        domain = self.domain
        if domain is None and self.y0 is None:
            return None
        from sympflow.hamiltonian.lattice_states import DRAWN, LatticeStates

        if isinstance(domain, LatticeStates):
            return domain
        states: Any = self.y0 if domain is None else domain.sample(DRAWN)
        return LatticeStates.of_states(self, states)

    @cached_property
    def _few_sites(self) -> HamiltonianSystem:
        assert self.local is not None
        return HamiltonianSystem._of_local(self.local.subsystem(), self.damping, self._subsystem_scene(None))

    @property
    def few_sites(self) -> HamiltonianSystem:
        local = self.local
        alike = local is not None and local.uniform and local.has_subsystem
        return self._few_sites if alike and (self.damping is None or not self.damping.ndim) else self

    @classmethod
    def schroedinger(
        cls,
        onsite: str | sympy.Expr | None = "-rho**2/2",
        *,
        shape: int | Sequence[int],
        length: float | Sequence[float] | None = None,
        dispersion: str | sympy.Expr = "k**2/2",
        params: Mapping[str, Any] | None = None,
        **scene: Unpack[SceneOptions],
    ) -> HamiltonianSystem:
        """A complex field on a periodic grid of any size, i ∂ψ/∂t = ω(−i∇)ψ + f'(|ψ|²)ψ: Schrödinger equations.

        A state is y = [q, p] with ψ = (q + ip)/√2, each of the grid's shape, so that ρ = |ψ|² = (q² + p²)/2 and

            H = Σ [ψ̄ ω(−i∇)ψ + f(ρ)]

        over the sites: the energy divided by the volume of a cell. Derivatives are spectral. The methods with the exact
        linear flow (`impulse`, `linear_kahan_li6`, `linear_aba864`, …) turn the phases of waves by ω, by fast Fourier
        transforms, and those of sites by f': both parts keep the norm Σ ρ to rounding. Runs are made by arrays.

        Parameters
        ----------
        onsite : str or sympy.Expr, optional
            f in `rho`, such as "-rho**2/2", the focusing cubic equation, or "V*rho + g*rho**2/2"; None for the free
            field.
        shape : int or sequence of up to three ints
            Sites along each axis.
        length : float or sequence of floats, optional
            Length of each axis; by default 1 per site.
        dispersion : str or sympy.Expr
            ω of a wave number `k`, an even function, added up over the axes: "k**2/2", or "1 - cos(k)" for a chain
            whose neighbours are coupled.
        params : mapping of str to float or array of the grid's shape, optional
            Values of the other names; arrays in `onsite`, such as a potential V or disorder.
        name, domain, y0, t_span, dt, energy_scale, exact
            As for the class.

        Raises
        ------
        ValueError, TypeError
            If an expression cannot be read, holds other names or is not finite; if shapes do not fit each other; or if
            a run would need more memory than the machine has.

        Examples
        --------
        >>> system = HamiltonianSystem.schroedinger("-rho**2/2", shape=256, length=40.0)
        >>> system.separable
        False
        """
        from sympflow.hamiltonian.wave_functions import WaveFunctionHamiltonian

        local = WaveFunctionHamiltonian(onsite, dispersion, shape, length, params)
        return cls._of_local(local, None, Scene.given(scene, name="schroedinger"))

    @classmethod
    def _of_local(cls, local: LocalHamiltonian, damping: float | ArrayLike | None, scene: Scene) -> HamiltonianSystem:
        """A system by a definition of one site or pair."""
        self = cls.__new__(cls)
        self._make(local, local.inverse_mass, local.quadratic_kinetic, local.params, scene, damping)
        return self

    def _make(
        self,
        definition: Any,
        inverse_mass: np.ndarray | None,
        quadratic_kinetic: bool,
        params: Mapping[str, Any],
        scene: Scene,
        damping: float | ArrayLike | None = None,
        period: float | None = None,
        stiffness_matrix: np.ndarray | None = None,
    ) -> None:
        """Make the system of a definition, in a scene."""
        Hamiltonian.__init__(self, scene.name, definition, inverse_mass, quadratic_kinetic)
        self.stiffness_matrix = stiffness_matrix
        self._arguments = self.ndof if self.separable else 2 * self.ndof  # components of a state that functions take
        if stiffness_matrix is not None:
            stiffness_matrix.setflags(write=False)
        self.friction = Friction(checked_damping(damping, self.ndof))
        self._set_scene(params, scene)
        self._set_period(period)

    def _set_period(self, period: float | None) -> None:
        if period is None:
            return
        if self.autonomous:
            raise TypeError("`period` only goes with `time`, for H that depends on t: leave it out.")
        check_positive("period", period, most=1e100)
        known = self.definition.has_period(float(period))
        if known is False:
            raise ValueError(
                f"`period` {period!r} is not a period of H, which differs one period later: give the period of the "
                "drive, such as 2*pi/w."
            )
        if known is None:
            check_period(self.hamiltonian, self.ndof, self.y0, float(period))
        self._period = float(period)

    @property
    def period(self) -> float | None:  # type: ignore[override]
        """The period of H in t, if one was given; kept for other values of the parameters where it still holds."""
        if self._period is None and self._former_period is not None:
            try:
                self._set_period(self._former_period)
            except ValueError:
                self._former_period = None
            except TypeError:  # of values with which H is constant in time: others may make it periodic again
                pass
        return self._period

    def _set_scene(self, params: Mapping[str, Any], scene: Scene) -> None:
        self._params = Parameters(params)
        domain = None if scene.domain is None else domain_of(scene.domain, self)
        self._scene = replace(scene, domain=domain, y0=scene.state(self.ndof))
        if self.domain is not None and self.domain.sample(1).shape != (1, 2 * self.ndof):
            raise ValueError(f"`domain` must be a set of states [q, p] of length {2 * self.ndof}.")
        self.definition.place(self.y0, self.domain, self.inverse_mass, self.t_span)

    @property
    def scene(self) -> Scene:
        """The scene for other values of the parameters: without the `exact` solution, which holds for the old ones."""
        dt = None if self.step_is_open else self.dt
        return replace(self._scene, name=self._name, dt=dt, exact=None)

    def with_scene(self, **scene: Unpack[SceneOptions]) -> HamiltonianSystem:
        """The same system with other defaults: of `name`, `domain`, `y0`, `t_span`, `dt`, `energy_scale` and `exact`.

        A step that was not given is chosen again, and `exact` is dropped with another `y0` or `t_span`.

        Examples
        --------
        >>> system = HamiltonianSystem.from_sympy("p**2/2 + q**2/2", y0=[1, 0])
        >>> system.with_scene(y0=[0, 2], t_span=(0, 10)).y0
        array([0., 2.])
        """
        other = bare_copy(self)
        known = {**vars(self._scene), "name": self._name}
        if {"y0", "t_span"} & {*scene}:
            known["exact"] = None
        settled = Scene.given({**known, **scene})
        other._name = settled.name
        other._set_scene(self._params, settled)
        return other

    def __setattr__(self, name: str, value: Any) -> None:
        if not isinstance(getattr(type(self), name, None), property | cached_property | FunctionType | _OfScene):
            super().__setattr__(name, value)
            return
        remedy = "make a system with it."
        if name in SCENE:
            of_run = "pass it to solve(), or " if name in ("y0", "t_span", "dt") else ""
            remedy = f"{of_run}take system.with_scene({name}=…)."
        if name == "params":
            remedy = "take system.with_params(name=…), or pass it to solve()."
        raise AttributeError(f"`{name}` of a system cannot be set: {remedy}", name=name, obj=self)

    @property
    def dt(self) -> float:
        """The default step of the fixed-step classical methods: as given, or chosen by the fastest motion."""
        given = self._scene.dt
        return self._chosen_step if given is None else given

    @cached_property
    def _chosen_step(self) -> float:
        from sympflow.hamiltonian.scales import STEP, default_step

        return STEP if self.step_is_open else default_step(self)  # a run chooses it at its own states

    @property
    def step_is_open(self) -> bool:
        """True if `dt` was not given, and the system has no states from which it could be chosen."""
        return self._scene.dt is None and self.y0 is None and self.domain is None

    @property
    def params(self) -> Mapping[str, float]:
        """The values of the parameters, read-only, because code is generated from them.

        For other values use `with_params`.
        """
        return self._params

    def check_parameters(self, names: Iterable[str]) -> None:
        """Raise a ValueError for names that are not parameters of H; it lists the known ones.

        A TypeError if the system is given by functions, or a parameter is an array of a lattice's sites.
        """
        if self.local is not None:
            self.local.check_numbers(names)
            return
        if not self.definition.symbolic:
            raise TypeError(
                f"`params` are for symbolic systems, and {self.name!r} is given by functions, which hold their values: "
                "make a system for each, or define it with HamiltonianSystem.from_sympy(..., params=...)."
            )
        if self.external_force is not None:
            raise ValueError(
                f"`params` of {self.name!r} are those of H and not of its external force: make a system for each value."
            )
        known = [*self.params]
        for name in names:
            if name not in known:
                has = f"which has {', '.join(known)}" if known else "which has none: write H with symbols for them"
                if name == "damping" and self.damping is not None:
                    has += "; `damping` is not one: make a system for each value"
                raise ValueError(f"`params` has {name!r}, which is not a parameter of {self.name!r}, {has}.")

    def with_params(self, **values: float) -> HamiltonianSystem:
        """The same system with other values of some parameters. Most methods reuse the compiled code.

        The scene stays as it is: `y0`, `t_span`, `dt`, the domain and the friction; of a driven system the `period`
        where H still has it.

        Parameters
        ----------
        **values : float
            By the names in `params`; the others keep theirs.

        Raises
        ------
        ValueError, TypeError
            If the system has no such parameter or is given by functions, or H has no meaning for a value.

        Examples
        --------
        >>> system = HamiltonianSystem.from_sympy("p**2/2 + k*q**2/2", params={"k": 1.5})
        >>> system.with_params(k=2.5).params
        {'k': 2.5}
        """
        if self.local is not None:
            return HamiltonianSystem._of_local(self.local.with_params(values), self.damping, self.scene)
        self.check_parameters(values)
        definition, params = self.definition, {**self.params, **values}
        checked = checked_params(params)
        if (found := definition.revalued(checked)) is not None:
            made = HamiltonianSystem._defined(found, found.inverse_mass, checked, self.scene, self.damping)
        else:
            given: dict[str, Any] = {"params": params, "time": definition.named_time, "damping": self.damping}
            made = HamiltonianSystem.from_sympy(definition.source, **given, **vars(self.scene))
        # Values of the drive may have changed the period: it is tested where it is asked for.
        made._former_period = self.period or self._former_period
        return made

    def check_functions(self, y0: Array | None = None) -> None:
        """Test once that the functions of a user agree with each other; `solve`, `train` and others call it.

        At a few states, y0 (the system's if it is None), near these and of the domain, the gradient, given or
        automatic, is compared with differences of H, and `hessian_vector` with those of the gradient; a batch with
        single states; a value with itself. States where H is not finite, or next to a kink, are left out. It takes
        milliseconds; `check=False` of the system omits it.

        Parameters
        ----------
        y0 : array or tensor of shape (..., 2d), optional
            Its library and dtype are those in which the functions are called.

        Raises
        ------
        ValueError, TypeError
            If a function is wrong: the message names it, the component, the state and both values.
        """
        if not self.functions_given:
            return
        like = np.empty(0) if y0 is None else y0
        kind = type(like), like.dtype
        self.definition.check_unchanged()
        if kind in self._tested:
            return
        from sympflow.hamiltonian.function_checks import FEW, probe_states, reach

        given = one_lane(like) if math.prod(like.shape) else self.y0
        probes = probe_states(given, self.domain, 2 * self.ndof)
        n_given = min(FEW, math.prod(like.shape) // (2 * self.ndof))
        self.definition.check(probes, like, n_given, self.probe_times())
        self._tested = self._tested | {kind: reach(probes[:, : self._arguments], self._arguments // self.ndof)}

    def check_functions_along(self, y: Array) -> bool:
        """Test the functions of a user where a run went far beyond the tested states; `solve` calls it.

        If `check_functions` fails at the farthest of the states y, a RuntimeWarning says why, and True is returned.

        Parameters
        ----------
        y : array or tensor of shape (..., 2d)
        """
        kind = type(y), y.dtype
        reached = self._tested.get(kind)
        if reached is None:
            return False
        from sympflow.hamiltonian.function_checks import farther_states, reach

        far = farther_states(one_lane(y).reshape(-1, 2 * self.ndof), reached).astype(float)
        if not len(far):
            return False
        try:
            self.definition.check(far, y, 0, self.probe_times())
        except (ValueError, TypeError) as error:
            warn(f"On this run, far from its start: {error}", RuntimeWarning)
            return True
        seen = np.concatenate([reached, far[:, : self._arguments]])
        self._tested = self._tested | {kind: reach(seen, self._arguments // self.ndof)}
        return False

    def probe_times(self, length: float | None = None) -> list[float]:
        """The times at which functions of the system are tested: the first one, and for a driven system later ones."""
        t0, t1 = self.t_span
        return [t0] if self.autonomous else probe_times(t0, t1 if length is None else t0 + length).tolist()

    def kicks(self, t0: float, t1: float) -> list[Kick]:
        """Return the impulses of H between two times, in order; each has a time `t` and is a map of states.

        A term DiracDelta(t − a)·W(q, t) of H is an impulse at the time a: p −= ∇W(q, a).

        Examples
        --------
        >>> system = HamiltonianSystem.from_sympy("p**2/2 - q*DiracDelta(t - 1)", time="t")
        >>> [(kick.t, kick(np.array([0.0, 0.5]))) for kick in system.kicks(0, 2)]
        [(1.0, array([0. , 1.5]))]
        """
        return self.definition.kicks(t0, t1, self.dt / 4)

    @cached_property
    def linear_part(self) -> LinearPart:
        """The quadratic part of H: K, its frequencies, the remaining potential U, and the `stiffness`.

        A ValueError if there is no such part, or its stiff directions rotate.
        """
        from sympflow.hamiltonian.linear_part import linear_part

        return linear_part(self)

    @cached_property
    def fingerprint(self) -> tuple[float, ...]:
        """H at 8 fixed states less H at a ninth, then Γ: a trained flow recognises its system by them."""
        return fingerprint(self)

    def __repr__(self) -> str:
        params = parameters_text(self.params)
        kind = "separable" if self.separable else "not separable"
        if self.damping is not None:
            kind += f", damping {np.array2string(self.damping, threshold=9, precision=6).replace(chr(10), '')}"
        if not self.autonomous:
            kind += ", driven" if self.period is None else f", driven with period {self.period:g}"
        if self.definition.given_functions:
            kind += f", arrays: it could not be traced, because {self.untraced}" if self.form is None else ", traced"
        degrees = f"{self.ndof:,} degree{'s' * (self.ndof > 1)} of freedom"
        named = f"{self.name}({params})" if self._name else self.title
        return f"<HamiltonianSystem {named}: {degrees}, {kind}>"

    @property
    def title(self) -> str:
        """The name and the parameters as printed; H where there is no name."""
        params = parameters_text(self.params, GREEK, " = ")
        name = PROPER.get(self.name, self.name.replace("_", " ") if self._name else self.name)
        return name + (f", {params}" if params else "")

    def card(self) -> Card:
        H, formula = "" if self.symbols is None else str(self.symbols.H), ""
        if 0 < len(H) <= TYPESET:
            import sympy

            formula = "H = " + sympy.latex(self.symbols.H)
        facts = {
            "H": H,
            "parameters": parameters_text(self.params, GREEK, " = "),
            "degrees of freedom": f"{self.ndof:,}",
            "structure": repr(self).rsplit("freedom, ", 1)[-1].rstrip(">"),
            "y0": "" if self.y0 is None else numbers(self.y0),
            "t_span": f"{self.t_span[0]:g} … {self.t_span[1]:g}",
            "dt": "" if self._scene.dt is None else f"{self._scene.dt:g}",
            "domain": "" if self.domain is None else brief(repr(self.domain)),
        }
        return Card(self.title, facts, formula=formula)

    def __dir__(self) -> list[str]:
        made_of_parts = {"lattice", "pairs", "planets", "schroedinger"}  # constructors, which a system has no use for
        return [name for name in SHOWN_NAMES if name not in made_of_parts]


def parameters_text(
    params: Mapping[str, Any], names: Mapping[str, str] = MappingProxyType({}), equals: str = "="
) -> str:
    """Parameters in a row, name=value, by other names where there are some; samples by their description."""

    def text(value: Any) -> str:
        if isinstance(value, np.ndarray):
            return f"array of shape {value.shape}"
        return f"{value:g}" if isinstance(value, int | float) else str(value)

    shown = {k: text(v) for k, v in params.items()}
    return ", ".join(f"{names.get(k, k)}{equals}{v}" for k, v in shown.items())


# a view that counts -------------------------------------------------------------------------------

COUNTED = {
    "force": "force_evaluations",
    "gradient": "force_evaluations",
    "vector_field": "force_evaluations",
    "potential_hessian": "hessian_evaluations",
    "hessian_vector": "hessian_evaluations",
    "hessian": "hessian_evaluations",
    "field_jacobian": "hessian_evaluations",
    "third_derivative": "curvature_evaluations",
    "curvature_gradient": "curvature_evaluations",
}
"""The functions of a system that are counted, and as what."""


class counting_view:
    """A view of a system that calls `count` for each evaluation of a force or a derivative of it, except inner ones."""

    def __init__(self, system: HamiltonianSystem, count: Callable[[str, Array], None]) -> None:
        self._system, self._count = system, count

    @property  # type: ignore[misc]
    def __class__(self) -> Any:
        return type(self._system)

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._system, name)
        if name not in COUNTED:
            return self if found is self._system else found  # as between impulses, where there are none

        def evaluate(x: Array, *more: Array, **named: Array) -> Array:
            value = found(x, *more, **named)
            self._count(COUNTED[name], x)
            return value

        return evaluate

    def __call__(self, t: Any, y: Array) -> Array:
        value = self._system(t, y)
        self._count(COUNTED["vector_field"], y)
        return value

    def __hash__(self) -> int:
        return hash(self._system)

    def __eq__(self, other: object) -> bool:
        return other is self or other is self._system

    def __reduce__(self) -> tuple[Any, ...]:
        return copy.copy, (self._system,)
