"""Integrators by name: the built-in ones, those registered at run time, and those of installed plug-ins."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any, TypeVar

from sympflow.arguments import OF_RUNS, advice, did_you_mean
from sympflow.arrays import Array
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.contract import Integrator
from sympflow.integrators.methods import CLASSES, NAMES, TORCHDIFFEQ, TRIPLES, UNLISTED
from sympflow.lazy import announced, distribution, load_announced, whole_import
from sympflow.schemes import GROUP as SCHEME_GROUP
from sympflow.schemes import Scheme, announced_schemes, register_scheme, scheme_named

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

T = TypeVar("T")
GROUP = "sympflow.integrators"
"""The entry-point group in which a distribution announces its integrators: `name = "package.module:Class"`."""
_FIXED = {
    **dict.fromkeys(
        ("rtol", "atol", "reltol", "abstol"), "it has fixed steps: give `dt`, or `tol`, which chooses one."
    ),
    "max_step": "`dt` is the step, and `event_step` samples events within it.",
    "flow": "a flow is given in the place of a method.",
}
_ADAPTIVE = {"dt": "it chooses its own steps: give `rtol`, or `max_step` if it has one."}
SYNONYMS = {
    **dict.fromkeys(("velocity_verlet", "stormer_verlet", "störmer_verlet", "kdk"), "verlet"),
    **dict.fromkeys(("position_verlet", "drift_kick_drift", "dkd", "leap_frog"), "leapfrog"),
    **dict.fromkeys(("forest_ruth", "triple_jump"), "yoshida4"),
    **dict.fromkeys(("rkf45", "ode45", "runge_kutta"), "rk45"),
    **dict.fromkeys(("midpoint_implicit", "gauss2"), "implicit_midpoint"),
    "gauss4": "gauss_legendre4",
    "gauss6": "gauss_legendre6",
    "gauss8": "gauss_legendre8",
}
"""Other names of methods."""
_STIFF = "It is for stiff dissipative systems, and not symplectic: take 'gauss_legendre6', which is implicit too."
ABSENT = {
    **dict.fromkeys(("radau", "bdf", "lsoda", "radau5", "cvode"), _STIFF),
    "whfast": "Its name here is 'wisdom_holman', with `corrector` where it is to have one.",
    **dict.fromkeys(("mercurius", "trace"), "For close encounters take 'dop853' with `rtol`, 'wisdom_holman' else."),
    "ias15": "For close encounters take 'dop853' with `rtol`, or 'log_kahan_li8'.",
    "yoshida": "Did you mean 'yoshida4' or 'yoshida6'? 'kahan_li8' has smaller errors.",
    "ruth3": "Did you mean 'yoshida4'? A better one of few stages is 'omelyan4'.",
    "ruth4": "Did you mean 'yoshida4'?",
    "rk23": "Did you mean 'rk45', or 'bosh3'?",
    **dict.fromkeys(("odeint", "solve_ivp"), "It calls a method: did you mean 'dop853'?"),
    **dict.fromkeys(("tsit5", "vern7", "vern9", "bulirsch_stoer", "gbs"), "Did you mean 'dop853', with `rtol`?"),
    **dict.fromkeys(("symplectic", "splitting"), "Did you mean 'srkn11b', or 'kahan_li8'?"),
    "semi_implicit_euler": "Did you mean 'verlet', of order 2 at the same cost?",
    "symplectic_euler": "Did you mean 'verlet', of order 2 at the same cost?",
    "rk8": "Did you mean 'dop853'?",
}
"""Remedies for names of methods that are not there."""
KINDS = {
    "symplectic, T = ½ pᵀM⁻¹p, force gradients": ("srkn11b", "chin4a", "omelyan4"),
    "symplectic, separable H": ("verlet", "blanes_moan4", "kahan_li8"),
    "symplectic, any H": ("gauss_legendre6", "implicit_midpoint", "tao8"),
    "symplectic, steps that become shorter": ("log_leapfrog", "log_kahan_li8"),
    "trained": ("sympflow", "mlp"),
    "Runge–Kutta": ("rk4", "rk45", "dop853"),
}
PLAIN = {bool, int, float, str}
"""Types of options with which a method is made once."""
_registered: dict[str, type[Integrator]] = {}
_loaded: dict[type[Integrator], EntryPoint] = {}


def available() -> list[str]:
    """The names of all methods: built in, registered, and from plug-ins, which are not imported for that."""
    return sorted({*NAMES, *_registered, *_plugins()})


def get(method: str | type[Integrator]) -> type[Integrator]:
    """The integrator class with a name; call it with its options: ``get("verlet")(dt=0.05)``.

    Parameters
    ----------
    method : str or subclass of Integrator

    Raises
    ------
    ValueError
        If there is no such method.
    ImportError
        If the plug-in that provides it cannot be loaded.
    """
    if isinstance(method, type) and issubclass(method, Integrator):
        return method
    if not isinstance(method, str):
        hint = " Make one of it by sympflow.splitting_method(scheme)." if isinstance(method, Scheme) else ""
        hint = " The order is solve(system, method, t_span, y0)." if isinstance(method, tuple | list) else hint
        raise TypeError(f"`method` must be a name or an Integrator class; got {type(method).__name__}.{hint}")
    if method in TRIPLES or method in CLASSES or method in UNLISTED:
        return _built_in(method)
    if method in TORCHDIFFEQ:
        from sympflow.integrators.torchdiffeq_methods import torchdiffeq_method

        return torchdiffeq_method(method)
    if method in _registered:
        return _registered[method]
    if method in _plugins():
        return _load(_plugins()[method])
    name = re.sub(r"[\W_]+", "_", method.strip()).lower()
    if name != method and name in available():
        return get(name)
    if name in SYNONYMS:
        return get(SYNONYMS[name])
    if "," in method:
        raise ValueError(f"`method` {method!r} names several: one method runs at a time, and `compare` takes several.")
    instead = f" {ABSENT[name]}" if name in ABSENT else did_you_mean(name, [*available(), *SYNONYMS])
    rows = "".join(f"\n  {kind:42}{', '.join(map(repr, names))}" for kind, names in KINDS.items())
    raise ValueError(
        f"`method` {method!r} is unknown.{instead} There are, among others:{rows}\n"
        "All are listed by sympflow.available()."
    )


@cache
def _built_in(method: str) -> type[Integrator]:
    if method in TRIPLES:
        from sympflow.integrators.splitting import method_of_row

        return method_of_row(method)
    module, _, attribute = (CLASSES | UNLISTED)[method].partition(":")
    return getattr(whole_import(f"sympflow.integrators.{module}"), attribute)


def register(name: str, integrator: type[Integrator] | Scheme) -> None:
    """Make an integrator class, or a scheme, available under a name, in this process.

    Parameters
    ----------
    name : str
    integrator : subclass of Integrator, or Scheme
        A scheme becomes a method on the splitting "kinetic" and the physical clock, with the other splittings and
        clocks as its options: see `sympflow.splitting_method`.

    Raises
    ------
    ValueError
        If the name is empty, or that of a built-in method or of an installed plug-in; or if the scheme is not
        consistent.
    TypeError
        If `name` is not a string, or `integrator` neither a Scheme nor a subclass of Integrator that has a `name`.
    """
    if not isinstance(name, str):
        raise TypeError(f"`name` must be a string, such as 'my_method'; got {type(name).__name__}.")
    if not name.strip():
        raise ValueError(f"`name` must not be empty; got {name!r}. Choose one, such as 'my_method'.")
    if name in NAMES or name in UNLISTED:
        raise ValueError(f"`name` {name!r} is a built-in method, which cannot be replaced: choose another name.")
    scheme = integrator if isinstance(integrator, Scheme) else None
    if scheme is not None:
        from sympflow.integrators.splitting import splitting_method

        integrator = splitting_method(scheme, name=name)
    if not (isinstance(integrator, type) and issubclass(integrator, Integrator)):
        raise TypeError(
            f"`integrator` must be a subclass of sympflow.integrators.base.Integrator or a Scheme; got {integrator!r}."
        )
    if not named(integrator):
        raise TypeError(f"`integrator` {integrator.__name__} has no `name`: set that class attribute.")
    if name in _plugins():
        raise ValueError(
            f"`name` {name!r} belongs to the plug-in {distribution(_plugins()[name])}, which would be replaced: "
            "choose another name."
        )
    if scheme is not None:
        register_scheme(name, scheme)
    _registered[name] = integrator


def build(method: Any, options: dict[str, Any]) -> Integrator:
    """The integrator that `solve(method=..., **options)` means: a name, a class, an instance or a trained flow."""
    if not isinstance(method, str):
        if isinstance(method, Integrator):
            if options:
                raise TypeError(
                    f"`{next(iter(options))}` cannot be given with a configured integrator: set it when you build that "
                    "one."
                )
            return method
        if is_flow(method):
            if not options:
                return get(method.kind)(flow=method)  # type: ignore[call-arg]
            options = {"flow": method, **options}
            method = method.kind
    cls = get(method)
    own = isinstance(method, str) and method in NAMES
    known = cls.options() if own else _made(method, cls.options)
    unknown = [name for name in options if name not in known]
    if unknown:
        remedy = (_FIXED if "dt" in known else _ADAPTIVE).get(unknown[0])
        remedy = remedy or advice(unknown[0], (*known, *OF_RUNS)) or "remove it or choose another method."
        raise TypeError(
            f"`{unknown[0]}` is not an option of method {cls.name!r}, which takes {', '.join(known) or 'none'}: "
            f"{remedy}"
        )
    if not own:
        return _made(method, lambda: cls(**options))
    plain = PLAIN.issuperset(map(type, options.values()))
    return _configured(cls, **options) if plain else cls(**options)  # type: ignore[arg-type]


@lru_cache(maxsize=256, typed=True)
def _configured(cls: type[Integrator], **options: Any) -> Integrator:
    """A built-in method with plain options, made once."""
    return cls(**options)


def _made(method: Any, make: Callable[[], T]) -> T:
    """Return the result of `make`; a failure in the code of a plug-in names its distribution."""
    try:
        return make()
    except (Exception, SystemExit) as error:
        if not isinstance(method, str) or method in NAMES or method in UNLISTED or method in _registered:
            raise
        plugin = f"the plug-in {distribution(_plugins()[method])}"
        if isinstance(error, TypeError | ValueError):  # what its options were given, most likely
            kind = TypeError if isinstance(error, TypeError) else ValueError
            raise kind(f"{error} (Raised by {plugin}.)") from error
        raise RuntimeError(
            f"`method` {method!r} of {plugin} failed when it was made ({type(error).__name__}: {error}): report this "
            "to its author."
        ) from error


def is_flow(method: Any) -> bool:
    """True for a trained flow: there is none unless its module has been imported, with torch."""
    flows = sys.modules.get("sympflow.flow.flow_map")
    return flows is not None and isinstance(method, flows.FlowMap)


@cache
def _plugins() -> dict[str, EntryPoint]:
    return announced(GROUP, "integrator", NAMES, announced_schemes().values())


def _load(point: EntryPoint) -> type[Integrator]:
    if point.group == SCHEME_GROUP:
        from sympflow.integrators.splitting import splitting_method

        integrator: Any = splitting_method(scheme_named(point.name), name=point.name)
    else:
        integrator = load_announced(point, "method")
    if not (isinstance(integrator, type) and issubclass(integrator, Integrator)):
        raise ImportError(
            f"`method` {point.name!r} of the plug-in {distribution(point)} is not an Integrator class: report this to "
            "its author."
        )
    if not named(integrator):
        raise ImportError(
            f"`method` {point.name!r} of the plug-in {distribution(point)} is a class without `name`, which every "
            "integrator must have: report this to its author."
        )
    _loaded[integrator] = point
    return integrator


def named(integrator: Integrator | type[Integrator]) -> bool:
    """Return True if the class has the `name` that messages and reports call it by."""
    return isinstance(getattr(integrator, "name", None), str)


class naming_plugin:
    """Turn what fails inside into a RuntimeError that names the plug-in, if the integrator is one's.

    Errors of the kinds `passes` are left as they are: they are answers, not failures.
    """

    def __init__(self, integrator: Integrator, passes: tuple[type[Exception], ...] = ()) -> None:
        self._point, self._passes = _loaded.get(type(integrator)), passes

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: BaseException | None, traceback: Any) -> None:
        point = self._point
        if point is None or not isinstance(error, Exception | SystemExit) or isinstance(error, self._passes):
            return
        raise RuntimeError(
            f"`method` {point.name!r} of the plug-in {distribution(point)} failed ({type(error).__name__}: {error}): "
            "report this to its author, unless a function of your own, of the system or an event, raised it."
        ) from error


def check_applies(integrator: Integrator, system: HamiltonianSystem, y0: Array | None = None) -> None:
    """`integrator.check(system)`: a ValueError if the method does not apply; a plug-in that fails is named.

    The functions of a user's system are tested too, for states such as y0. Friction, forces that do not come from H,
    and an H that depends on t are refused here for every method that does not declare that it takes them.
    """
    system.check_impulses(
        "which are kicks between the steps of a method",
        "solve it by sympflow.solve or sympflow.ensemble; or use system.between_impulses from one of the times of "
        "system.kicks(t0, t1) to the next",
    )
    mro = type(integrator).__mro__
    if system.external_force is not None and not (integrator.takes_forces and _speaks_itself(mro, "takes_friction")):
        system.check_conservative(f"which method {integrator.name!r} does not take", "")
    if not (integrator.takes_friction and _speaks_itself(mro, "takes_friction")):
        what = "was trained without it" if integrator.trained else "does not take it"
        system.check_conservative(
            f"and method {integrator.name!r} {what}",
            "use a splitting method on the splitting 'kinetic', such as 'verlet' or 'kahan_li8', an implicit method "
            "such as 'gauss_legendre6', or a Runge–Kutta method such as 'dop853' or 'dopri5', or solve the system "
            "that sympflow.doubled makes of it",
        )
    if not (integrator.takes_driving and _speaks_itself(mro, "takes_driving")):
        what = "was trained for a system without t" if integrator.trained else "does not take the time into account"
        system.check_autonomous(
            f"and method {integrator.name!r} {what}",
            "use a splitting method on the splitting 'kinetic', such as 'verlet' or 'kahan_li8', an implicit method "
            "such as 'gauss_legendre6', or a Runge–Kutta method such as 'dop853' or 'dopri5'",
        )
    system.check_functions(y0)
    if type(integrator) not in _loaded:
        integrator.check(system)
        return
    with naming_plugin(integrator, passes=(ValueError,)):
        integrator.check(system)


@cache
def _speaks_itself(bases: tuple[type, ...], what: str) -> bool:
    """False for a class outside of the package that changes what a built-in class does, and inherits what that says."""
    says = next(i for i, base in enumerate(bases) if what in vars(base))
    others = (base for base in bases[:says] if not base.__module__.startswith("sympflow."))
    return not any(_DUTIES & vars(base).keys() for base in others)


_DUTIES = {"step", "inverse", "tangent", "run", "steps", "stepper", "own_stepper", "rollout", "composed"}
"""The methods of an integrator that make its steps."""


def name_of(integrator: Integrator) -> str:
    """Return the name by which `get` knows the class: plug-ins and registered classes may have another `name`."""
    cls = type(integrator)
    if cls in _loaded:
        return _loaded[cls].name
    if integrator.name in NAMES and get(integrator.name) is cls:
        return integrator.name
    return next((name for name, registered in _registered.items() if registered is cls), integrator.name)
