"""Splitting methods: a scheme × a splitting × a clock, as one integrator class."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from functools import cache, partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sympflow.arguments import check_flag, check_one_of, check_positive, warn
from sympflow.arrays import Array, to_numpy, values
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.hamiltonian.time_transformation import checked_shift
from sympflow.integrators.base import FixedStep
from sympflow.integrators.clocks import ARRAYS_ONLY, LogarithmicClock, scale_of, transformed_system
from sympflow.integrators.compositions import SPLITTINGS, Composition
from sympflow.integrators.contract import (
    Failure,
    Interrupted,
    Outcome,
    Problem,
    Steps,
    forward_tangent,
    method_class,
)
from sympflow.integrators.interpolants import Mapped
from sympflow.integrators.loops import compiled_loops, stepper_of
from sympflow.integrators.methods import NAMES, TRIPLES
from sympflow.integrators.steppers import Stepper
from sympflow.lazy import Made
from sympflow.schemes import CORRECTORS, POLYNOMIAL, SCHEMES, Scheme, checked_scheme, scheme_evaluations, scheme_named

if TYPE_CHECKING:
    from sympflow.kernels.protocol import Kernel
    from sympflow.kernels.tangents import TangentKernel
    from sympflow.storage.runs import RunStore


END = 1e-9
"""Distance from its ends, in steps, within which a force counts as taken there."""


@dataclass(frozen=True)
class Clock:
    """A time in which steps are equal, with the traits of the contract that depend on it.

    `on` makes of a method and a system the method on the clock; None for the physical time, which needs none.
    """

    on: Callable[[Splitting, HamiltonianSystem], LogarithmicClock] | None = None
    finds_events: bool = True
    in_another_time: bool = False
    arrays_only: str = ""
    tangent_holds: str = ""
    breakdown: Failure = Failure.NON_FINITE


@cache
def _on_the_physical_clock(cls: type[Splitting], compensated: bool) -> Splitting:
    """The scheme of a method with the splitting and the clock that need none."""
    return cls(compensated=compensated, splitting="kinetic", clock="physical")


def _logarithmic(method: Splitting, system: HamiltonianSystem) -> LogarithmicClock:
    """The method on the logarithmic Hamiltonian of a system, whose two parts have exact flows."""
    if method.splitting != "kinetic":
        raise ValueError(
            f"`clock` 'logarithmic' needs the splitting 'kinetic', as log(T + B) − log(c − V) has exact flows; "
            f"method {method.name!r} has {method.splitting!r}: leave one of them out."
        )
    if system.separable and (method.scheme.nystrom or method.scheme.level):
        raise ValueError(
            f"`clock` 'logarithmic' needs a scheme for any separable system, which that of method {method.name!r} is "
            "not: use 'kahan_li8'."
        )
    transformed, dt = transformed_system(system, method.shift), method.step_length(system)
    new_step = dt * scale_of(system, transformed.params["shift"])
    return LogarithmicClock(method, system, transformed, dt, new_step)


CLOCKS = {
    "physical": Clock(),
    "logarithmic": Clock(
        _logarithmic,
        finds_events=False,  # they are sought on the dense output
        in_another_time=True,
        arrays_only=ARRAYS_ONLY,
        tangent_holds="the realised step in s, and B,",
        breakdown=Failure.CLOCK,
    ),
}
"""The clocks by the name that the option `clock` takes."""


class Trait:
    """A trait of the contract that depends on the splitting and the clock of the method."""

    def __init__(self, of: Callable[[type[Composition], Clock], Any]) -> None:
        self.of = of

    def __get__(self, method: Splitting | None, cls: type[Splitting]) -> Any:
        triple = cls if method is None else method
        return self.of(SPLITTINGS[triple.splitting], CLOCKS[triple.clock])


@dataclass(frozen=True, repr=False)
class Splitting(FixedStep):
    """A scheme, a table of numbers, composed of the exact flows of the parts of H.

    Parameters
    ----------
    dt : float, optional
        Step length; the default is `system.dt`. On the logarithmic clock the physical length of a step where the
        kinetic energy is B = c − E, at the energy E of the system's y0; for Newtonian attraction the mean along the
        orbit. Away from there a step is dt·2B/(c − V(q)).
    compensated : bool
        True to sum with Kahan's compensation, which slows the growth of round-off over many steps. Compiled only, for
        the splittings "kinetic" and "kepler". The sums begin anew with each piece of a run that is executed in pieces:
        within SciPy's `solve_ivp`, and where the metrics execute it again.
    splitting : str
        The parts: "kinetic" | potential; "linear" | rest, the exact flow of the quadratic part of H in place of the
        drifts, with the kicks filtered ("mollified") or the implicit midpoint rule's angles ("midpoint"); "kepler", the
        exact motion of each planet about a star | their interaction; any solvable
        "parts" of H; or, for any H, two coupled "copies" of phase space, H(q, y) + H(x, p) + ω(|q − x|² + |p − y|²)/2.
        The last two are for schemes that are compositions of Strang steps.
    clock : str
        The time in which the steps are equal: "physical", or "logarithmic", that of the logarithmic Hamiltonian
        (`sympflow.time_transformed`), for close encounters. There a method is symplectic for the transformed system,
        in [q, t, p, B], and in [q, p] at a fixed step in s and a fixed B, which is how a step is differentiated.
    parts : sequence of str, optional
        For the splitting "parts": expressions that add up to H, in their order, the last innermost. The default is
        found in the terms of H: as few as possible, potentials first and the linear part last.
    omega : float, optional
        For the splitting "copies": ω, a rate; the copies are bound by ω Σ (s²(q − x)² + (p − y)²/s²)/2, where s makes q
        and p comparable. The default is the largest |λ| of J∇²H at the system's y0. With a smaller ω the two copies may
        diverge; a RuntimeWarning reports it. With a larger one the steps must be shorter. States are the means of the
        copies; a run keeps both, and is symplectic in their phase space [3]_.
    corrector : int, optional
        For the splitting "kepler" and drift–kick–drift steps, as of "wisdom_holman": the order of a symplectic
        corrector, 3, 5, … 17, which is applied at the start, and its inverse to each output. It removes errors of
        first order in the masses of the planets, with "kepler_takahashi_imada" of second order too, and costs nothing
        in between.
    shift : float, optional
        For the logarithmic clock: c, above the energy; default E + |E|, which is 0 for a bound system.

    Raises
    ------
    ValueError
        From `check`, where the splitting, or the scheme with it, has no meaning for the system.

    References
    ----------
    .. [1] S. Mikkola, K. Tanikawa, Celest. Mech. Dyn. Astron. 74 (1999) 287–295.
    .. [2] M. Preto, S. Tremaine, Astron. J. 118 (1999) 2532–2541.
    .. [3] M. Tao, Phys. Rev. E 94 (2016) 043303; P. Pihajoki, Celest. Mech. Dyn. Astron. 121 (2015) 211–231.
    """

    compensated: bool = False
    splitting: str = "kinetic"
    clock: str = "physical"
    parts: tuple[str, ...] | None = None
    shift: float | None = None
    omega: float | None = None
    corrector: int | None = None
    scheme: ClassVar[Scheme]
    symplectic: ClassVar[bool] = True
    compiles: ClassVar[bool] = True
    finds_events: ClassVar[Any] = Trait(lambda splitting, clock: clock.finds_events)
    on_grid: ClassVar[Any] = Trait(lambda splitting, clock: not (clock.in_another_time or splitting.keeps))
    keeps: ClassVar[Any] = Trait(lambda splitting, clock: splitting.keeps)
    in_another_time: ClassVar[Any] = Trait(lambda splitting, clock: clock.in_another_time)
    arrays_only: ClassVar[Any] = Trait(lambda splitting, clock: clock.arrays_only)
    tangent_holds: ClassVar[Any] = Trait(lambda splitting, clock: clock.tangent_holds)
    breakdown: ClassVar[Any] = Trait(lambda splitting, clock: splitting.breakdown or clock.breakdown)
    follows: ClassVar[Any] = Trait(lambda splitting, clock: clock.on is None)
    takes_friction: ClassVar[Any] = Trait(lambda splitting, clock: splitting.takes_friction and clock.on is None)
    takes_driving: ClassVar[Any] = Trait(lambda splitting, clock: splitting.takes_driving and clock.on is None)

    def __post_init__(self) -> None:
        super().__post_init__()
        cls = type(self)
        if (
            self.compensated is False
            and self.splitting is cls.splitting
            and self.clock is cls.clock
            and (self.parts is None and self.shift is None and self.omega is None and self.corrector is None)
        ):
            return
        check_flag("compensated", self.compensated)
        for name, known in (("splitting", SPLITTINGS), ("clock", CLOCKS)):
            value = getattr(self, name)
            check_one_of(name, value, known)
        if self.compensated and not SPLITTINGS[self.splitting].compensates:
            raise ValueError("`compensated` sums are for the splittings 'kinetic' and 'kepler': leave it out.")
        for name, (of, its, check) in OWN_OPTIONS.items():
            if getattr(self, name) is None:
                continue
            check(getattr(self, name))
            if getattr(self, of) != its:
                raise ValueError(f"`{name}` is for the {of} {its!r}: leave it out.")
        if self.parts is not None:
            object.__setattr__(self, "parts", tuple(self.parts))

    def __repr__(self) -> str:
        changed = (f for f in fields(self) if getattr(self, f.name) != f.default)
        return f"{type(self).__name__}({', '.join(f'{f.name}={getattr(self, f.name)!r}' for f in changed)})"

    def composed(self, system: HamiltonianSystem) -> Composition:
        """Return the scheme × the splitting on a system."""
        options: dict[str, Any] = {}
        if not self.parts is self.omega is self.corrector is None:
            options = {n: value for n in ("parts", "omega", "corrector") if (value := getattr(self, n)) is not None}
        return SPLITTINGS[self.splitting](self.name, self.scheme, system, **options)

    def on_clock(self, system: HamiltonianSystem) -> LogarithmicClock | None:
        """Return the method on its clock, where that is not the physical one."""
        on = CLOCKS[self.clock].on
        return None if on is None else on(self, system)

    @property
    def inner(self) -> Splitting:
        """The scheme with the splitting and the clock that need none: on the logarithmic clock that is what runs."""
        return _on_the_physical_clock(type(self), bool(self.compensated))  # type: ignore[arg-type]

    @property
    def kicks_and_drifts(self) -> Scheme | None:
        plain = self.splitting == "kinetic" and self.clock == "physical" and not self.overrides("step")
        return self.scheme if plain else None

    def oscillation_error(self, z: np.ndarray) -> np.ndarray:
        scheme = self.kicks_and_drifts
        if scheme is None or scheme.level == POLYNOMIAL:
            return super().oscillation_error(z)
        q, p, x = np.array([1 + 0 * z, 0 * z]), np.array([0 * z, 1 + 0 * z]), z**2  # q and hp of two orbits
        for kind, b, g, c, *_ in scheme.substeps:
            if kind == "drift":
                q = q + b * p
            else:
                p = p - (b * x - g * x**2 + c * x**3) * q
        half_trace = (q[0] + p[1]) / 2
        root = np.emath.sqrt(half_trace**2 - 1)
        multiplier = half_trace + np.where(np.sin(z) < 0, -root, root)
        # A step keeps an ellipse in (zq, hp), on which the energy, half the squared radius, changes.
        mean, half_change = (z * q[1] - p[0] / z) / 2, np.hypot(z * q[1] + p[0] / z, p[1] - q[0]) / 2
        swing = np.where(mean > half_change, 2 * half_change / (mean - half_change), np.inf)
        return np.maximum(np.abs(multiplier - np.exp(1j * z)) / z, swing)

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        """Count those of a scheme of kicks and drifts; a stepper counts those of other parts too."""
        return scheme_evaluations(self.scheme, n_steps, n_saved, n_extra, backend)

    @classmethod
    def forces_a_step(cls) -> str:
        if not SPLITTINGS[cls.splitting].counts_as_scheme or cls.clock != "physical":
            return ""
        hessians = cls.scheme.hessian_evaluations
        return f"{cls.scheme.force_evaluations}{f' + {hessians} Hessian' if hessians else ''}"

    @property
    def label(self) -> str:
        cls = type(self)
        other = [mine for mine, own in ((self.splitting, cls.splitting), (self.clock, cls.clock)) if mine != own]
        return f"{self.name} ({', '.join(other)})" if other else self.name

    def on_extended(self, system: HamiltonianSystem, extended: HamiltonianSystem) -> Splitting | None:
        return self if SPLITTINGS[self.splitting].takes_extended else None

    def takes_parameter_values(self, problem: Problem) -> bool:
        composition = self.composed(problem.system)
        asked = map(self.overrides, ("step", "rollout", "evaluations"))
        if self.clock != "physical" or any(asked) or not composition.takes_values:
            return False
        kernel = compiled_loops(
            lambda: composition.kernel(bool(self.compensated)), problem.y0, problem.backend, self.compensated
        )
        return kernel is not None and bool(kernel.loops.values)

    def longest_step(self, system: HamiltonianSystem) -> float:
        return self.composed(system).longest_step() if self.clock == "physical" else super().longest_step(system)

    def doubt(self, system: HamiltonianSystem) -> str:
        doubts = SPLITTINGS[self.splitting].doubts and self.clock == "physical"
        return self.composed(system).doubt(self.step_length(system)) if doubts else ""

    def check(self, system: HamiltonianSystem) -> None:
        if self.clock != "physical":
            self.on_clock(system)
            return
        composition = self.composed(system)
        composition.check_system(self.step_length(system))
        system.friction.check_sums(self.compensated)

    def forces_at_ends(self, system: HamiltonianSystem) -> bool:
        return any(not END < c < 1 - END for c in self._force_times(system))

    def forces_beyond(self, system: HamiltonianSystem) -> bool:
        return any(not -END < c < 1 + END for c in self._force_times(system))

    def _force_times(self, system: HamiltonianSystem) -> list[float]:
        """The times of the forces in a step of length 1, of a driven system."""
        return [] if self.clock != "physical" else self.composed(system).force_times()

    def _placed(self, system: HamiltonianSystem) -> LogarithmicClock | Composition:
        """The method on its clock, or on the physical one its composition."""
        return self.on_clock(system) or self.composed(system)

    def step(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        if not self.keeps:
            return self._placed(system).step(y, h, t)
        composition = self.composed(system)
        return composition.project(composition.step(composition.lift(y), h, t))

    def inverse(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        if self.keeps:
            raise TypeError(f"`method` {self.name!r} keeps {self.keeps}, without which a step cannot be undone.")
        return self._placed(system).inverse(y, h, t)

    def tangent(self, system: HamiltonianSystem, t: float, y: Array, h: Array) -> tuple[np.ndarray, np.ndarray]:
        known = None if self.keeps else self._placed(system).tangent(y, h, t)
        return super().tangent(system, t, y, h) if known is None else known

    def jvp(self, system: HamiltonianSystem, t: Any, y: Array, h: Array, W: np.ndarray) -> np.ndarray:
        if self.keeps or self.on_clock(system) is not None:
            return super().jvp(system, t, y, h, W)
        known = self.composed(system).jvp(y, h, W, t)
        return known[1] if known else forward_tangent(lambda x, s: self.step(system, t, x, s), y, h, W)[1]

    def jvp_steps(
        self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array
    ) -> Iterator[tuple[np.ndarray, np.ndarray, Callable[[np.ndarray], np.ndarray]]]:
        """The same, of a system by one piece, which may be large, without Jacobians."""
        if system.local is None:
            yield from super().jvp_steps(system, t_span, y0)
            return
        for times, states, lengths in self.steps(system, t_span, y0):
            for t, y, h in zip(times, to_numpy(states), lengths, strict=True):
                at, length = (np.broadcast_to(x, y.shape[:-1]) for x in (t, h))
                yield at, length, partial(self.jvp, system, at, y, length.astype(y.dtype))

    def tangent_kernel(self, system: HamiltonianSystem, vectors: int) -> TangentKernel:
        if self.clock != "physical" or self.overrides("step") or self.compensated:
            raise ValueError(
                f"`method` {self.name!r} has compiled deviation vectors on the clock 'physical' only, without "
                "compensated sums: use backend='auto'."
            )
        return self.composed(system).tangent_kernel(vectors)

    def jacobian(self, system: HamiltonianSystem, t: float, y: Array, h: Array) -> np.ndarray:
        if not self.keeps:
            return super().jacobian(system, t, y, h)
        composition = self.composed(system)
        lifted = y if y.shape[-1] > 2 * system.ndof else composition.lift(y)
        return forward_tangent(lambda x, lengths: composition.step(x, lengths, t), lifted, h)[1]

    def own_steps(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array) -> Steps:
        return super().steps(system, t_span, self.composed(system).lift(y0) if self.keeps else y0)

    def own_stepper(self, problem: Problem) -> Stepper:
        composition, compensated = self.composed(problem.system), bool(self.compensated)

        def make(names: tuple[str, ...] = ()) -> Kernel:
            return composition.kernel_by(compensated, names) if names else composition.kernel(compensated)

        return stepper_of(self, problem, composition, make, compensated)

    def run(self, problem: Problem) -> Outcome:
        if not self.keeps:
            return super().run(problem)
        return _extended_run(super().run, self.composed(problem.system), problem)

    def steps(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array) -> Steps:
        if not self.keeps:
            return self.own_steps(system, t_span, y0)
        project = self.composed(system).project
        return ((times, project(states), lengths) for times, states, lengths in self.own_steps(system, t_span, y0))


# runs on an extended phase space -----------------------------------------------------------------

APART = 0.1  # distance of two copies, over the size of the states of the run, beyond which these mean little


def _extended_run(run: Callable[[Problem], Outcome], extension: Composition, problem: Problem) -> Outcome:
    """The outcome of a problem that is run on an extended phase space."""
    search, store = problem.events, problem.store
    if search is not None:
        search.project = extension.project
    if store is not None:
        store.project = lambda x: _noted(store, extension, x)
    stopped = None
    try:
        outcome = run(replace(problem, y0=extension.lift(problem.y0)))
    except Interrupted as stop:
        outcome, stopped = stop.outcome, stop
    x = outcome.y
    outcome.y = extension.project(x)
    if outcome.sol is not None:
        outcome.sol = Mapped(outcome.sol, extension.project)
    found = None
    if store is not None and "copy_distance" in store.noted:
        found = np.array([store.noted[name] for name in ("copy_distance", "size")])
    elif len(x) and (seen := values(x)) is not None:  # under vmap those of all lanes, which come first
        with np.errstate(all="ignore"):
            found = np.asarray(extension.distance(seen)).max(seen.ndim - x.ndim)
    if found is not None:
        _note_distance(extension, found, outcome)
    if stopped is not None:
        raise stopped
    return outcome


def _noted(store: RunStore, extension: Composition, x: np.ndarray) -> np.ndarray:
    """The states of those of the extended space; a store keeps how far these are from ones that stand for a state."""
    with np.errstate(all="ignore"):
        found = np.asarray(extension.distance(x)).reshape(-1, 2)
    if not np.isnan(found).all():
        apart, size = np.nanmax(found, axis=0).tolist()
        store.note(copy_distance=apart, size=size)
    return np.asarray(extension.project(x))


def _note_distance(extension: Composition, found: np.ndarray, outcome: Outcome) -> None:
    """Note the largest distances of copies, beside the sizes of states, (..., 2); warn of large ones."""
    apart, size, held = found[..., 0], found[..., 1], np.asarray(outcome.status) >= 0  # what has failed says more
    ratio = np.where(apart == 0, 0.0, apart / np.where(size == 0, 1.0, size))
    outcome.stats["copy_distance"] = largest = float(np.fmax.reduce(ratio, axis=None))
    lost = (ratio > APART) & (held if ratio.ndim else held.all())
    if lost.any():
        which = "" if lost.ndim == 0 else f" of {np.count_nonzero(lost)} of {lost.size} trajectories"
        warn(
            f"The two copies{which} that method {extension.method!r} keeps differ by up to {largest:.3g} of the size "
            "of the states, which makes the result unreliable. Reduce `dt`, or change `omega`, the strength that "
            "binds the copies.",
            RuntimeWarning,
        )


def _check_parts(parts: Any) -> None:
    sequence = isinstance(parts, list | tuple)
    if not sequence or not all(isinstance(part, str) for part in parts) or not parts:
        raise TypeError(f"`parts` must be a sequence of expressions; got {parts!r}: pass a list of strings.")


def _check_corrector(corrector: Any) -> None:
    if isinstance(corrector, bool) or corrector not in CORRECTORS:
        raise ValueError(f"`corrector` must be an order, 3, 5, … 17; got {corrector!r}: take 17.")


OWN_OPTIONS: dict[str, tuple[str, str, Callable[[Any], Any]]] = {
    "shift": ("clock", "logarithmic", checked_shift),
    "omega": ("splitting", "copies", partial(check_positive, "omega")),
    "corrector": ("splitting", "kepler", _check_corrector),
    "parts": ("splitting", "parts", _check_parts),
}
"""The options of one splitting, or clock, and their checks."""


# classes of triples -------------------------------------------------------------------------------


def splitting_method(
    scheme: Scheme | str, splitting: str = "kinetic", clock: str = "physical", *, name: str | None = None
) -> type[Splitting]:
    """Return the integrator class of a scheme × a splitting × a clock; it runs compiled as the built-in ones do.

    Parameters
    ----------
    scheme : Scheme or str
        A table of your own, or the name of a known one.
    splitting, clock : str
        The defaults of the options of these names: see `Splitting`.
    name : str, optional
        The name of the method in reports. By default that of a built-in triple, else that of the scheme, followed by
        the splitting and the clock if these are not "kinetic" and "physical".

    Returns
    -------
    type
        The same class for the same arguments. Call it with options to get an integrator, or give it to
        `sympflow.register`. It pickles by its table.

    Raises
    ------
    TypeError
        If `scheme` is not a `Scheme`, or `name` not a string.
    ValueError
        If there is no such scheme, splitting or clock; if the scheme is not consistent; or if the name is that of
        another, built-in method.

    Examples
    --------
    >>> from sympflow.systems import pendulum
    >>> Ruth3 = splitting_method(Scheme("ruth3", 3, kicks=(7 / 24, 3 / 4, -1 / 24), drifts=(2 / 3, -2 / 3, 1.0)))
    >>> method = Ruth3(dt=0.05)
    >>> method, method.order
    (ruth3(dt=0.05), 3)
    """
    table = checked_scheme(scheme_named(scheme) if isinstance(scheme, str) else scheme)
    for argument, value, known in (("splitting", splitting, SPLITTINGS), ("clock", clock, CLOCKS)):
        check_one_of(argument, value, known)
    if name is None:
        triple = (table.name, splitting, clock)
        rows = [name for name, row in TRIPLES.items() if (row.scheme, row.splitting, row.clock) == triple]
        if rows and SCHEMES.get(table.name) == table:
            return method_of_row(rows[0])
        name = "_".join([table.name, *(part for part in (splitting, clock) if part not in ("kinetic", "physical"))])
    elif not isinstance(name, str):
        raise TypeError(f"`name` must be a string, such as 'my_method'; got {type(name).__name__}.")
    if not name.strip() or name in NAMES:
        taken = "is a built-in method of another table" if name in NAMES else "is empty"
        raise ValueError(f"`name` {name!r} {taken}: choose another one, as by name='my_method'.")
    return _method_of(name, table, splitting, clock)


@cache
def method_of_row(name: str) -> type[Splitting]:
    """Return the integrator class of a row of `TRIPLES`."""
    row = TRIPLES[name]
    return _new_class(type, name, SCHEMES[row.scheme], row.splitting, row.clock, row.source)


@cache
def _method_of(name: str, scheme: Scheme, splitting: str, clock: str) -> type[Splitting]:
    cls = _new_class(Made, name, scheme, splitting, clock, scheme.source)
    cls.made_of = _method_of, (name, scheme, splitting, clock)  # type: ignore[attr-defined]
    return cls


def _new_class(kind: type[type], name: str, scheme: Scheme, splitting: str, clock: str, source: str) -> type[Splitting]:
    own: dict[str, Any] = {
        "__annotations__": {"splitting": str, "clock": str},
        "__doc__": f"{name}: order {scheme.order}, {source}\n\n{Splitting.__doc__}",
    }
    own |= {"name": name, "order": scheme.order, "scheme": scheme, "source": source}
    return method_class(Splitting, name, __name__, kind, splitting=splitting, clock=clock, **own)


def __getattr__(name: str) -> type[Splitting]:
    """The integrator classes as attributes of the module, where pickle looks for them."""
    if name in TRIPLES:
        return method_of_row(name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
