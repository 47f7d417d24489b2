"""The contract between `solve` and an integrator.

An integrator is a frozen dataclass whose fields are its options (`dt`, `rtol`, …): the immutable choice of a method.
Its duties:

1. `step(system, t, y, h)` maps states y (..., 2d) over a step h, negative or not, of shape () or y.shape[:-1]; so is t.
2. `order` (None if trained), `symplectic`, `trained` and `source` are class attributes, and correct.
3. `check(system)` raises a ValueError with the reason where the method does not apply.
4. `run(problem)` produces the requested states, and no others, as an `Outcome`.
5. `steps(system, t_span, y0)` executes the same run again as a stream of the steps that it takes, and
6. `tangent(system, t, y, h)` differentiates such a step, so that metrics judge the map that was really executed; where
   that acts on more than y, `jacobian` and `executed` differentiate it where it acts.
7. `inverse(system, t, y, h)` undoes `step(system, t, y, h)` exactly, or raises a TypeError.
8. `finds_events` is False, and `solve` seeks events on the dense output afterwards; or `run` hands every step to
   `problem.events`, if there are any, and ends where that requires.

9. `arrays_only` is set, if `step` and `run` take NumPy arrays only.
10. `takes_friction` is False, and a damped system is refused; or the method takes the
   friction −Γp into account, as one that steps by `system.vector_field` does. `takes_forces` says the same of a force
   that does not come from H and that only `vector_field` has.
11. `takes_driving` is False, and a driven system, H(t, q, p), is refused; or the method
   takes H and its derivatives at the times of its stages, t + c·h, as `system.vector_field(y, t + c * h)` does. Where
   c is 0 or 1, `forces_at_ends(system)` is True, and a run is cut at the jumps of H; where c lies outside [0, 1],
   `forces_beyond(system)` is True, and jumps cause a warning.

`FixedStep`, in `sympflow.integrators.base`, does 4, 5, 6 and 8 for any integrator that has a step: a new one needs
duties 1 to 3 only, and its forces are counted. Whatever a run changes, such as its kernel and its counts, belongs to a
`Stepper`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import Field, dataclass, field, fields
from enum import Enum
from functools import cache, partial
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from sympflow.arguments import MAX_ASKED_VALUES
from sympflow.arrays import Array, as_tensor, is_tensor, jacobian, like, to_numpy
from sympflow.compiler import NotCompiled
from sympflow.events import EventSearch
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.progress import Progress
from sympflow.show.cards import cut

if TYPE_CHECKING:
    from sympflow.flow.flow_map import FlowMap
    from sympflow.flow.known import KnownFlow
    from sympflow.hamiltonian.fingerprint import Identity
    from sympflow.kernels.tangents import TangentKernel
    from sympflow.schemes import Scheme
    from sympflow.storage.runs import RunStore

M = TypeVar("M", bound="Integrator")
Steps = Iterator[tuple[np.ndarray, Array, np.ndarray]]
"""Chunks of executed steps: times (n,), states at their beginnings (n, ..., 2d), signed lengths (n,) or (n, ...)."""
MOST_ENTRIES = 20_000_000
"""Entries of the Jacobians that are held at a time."""
FINISHED = "The solver successfully reached the end of the integration interval."
ENDED = "A termination event occurred."
INTERRUPTED = "The run was interrupted after t = {t:.15g}; what was computed until then is kept."


def interrupted(outcome: Outcome, t: float) -> Interrupted:
    """Return the error of a run that Ctrl-C ended after time t, with its outcome, which is marked as failed."""
    outcome.status = np.full(outcome.y.shape[1:-1], -1) if outcome.y.ndim > 2 else -1
    outcome.message, outcome.stats["interrupted_at"] = INTERRUPTED.format(t=t), t
    return Interrupted(outcome)


def finished(problem: Problem) -> str:
    """Return the message of a run up to the last output time, which may be before the end."""
    times = problem.t_eval
    if times is None or problem.dense_output or problem.events is not None:
        return FINISHED
    if not len(times):
        return "`t_eval` is empty, so no step was made: give the times to report, or leave it out."
    last = float(times[-1])
    if abs(last - problem.t1) <= 8 * math.ulp(problem.t1):
        return FINISHED
    return (
        f"The run ended at t = {last:.15g}, the last time of `t_eval`, before the end of `t_span`, t = "
        f"{problem.t1:.15g}: nothing later was asked for. To go on, add the end to `t_eval`."
    )


class Failure(Enum):
    """The reasons why a run of steps cannot go on. Each is its message: what happened, and the remedy."""

    NON_FINITE = "The solution became non-finite", "Reduce `dt`"
    UNSOLVED = "The implicit step could not be solved: Newton's iteration did not converge", "Reduce `dt`"
    CLOCK = "T + B or c − V ceased to be positive and finite", "Reduce `dt`, or raise `shift` above the energy"
    ENCOUNTER = (
        "Two planets came closer to each other than `encounter` Hill radii, where they are no longer on orbits about "
        "the star",
        "Follow the encounter with the splitting 'kinetic', such as method 'dop853' or 'srkn11b' with short steps",
    )
    STALLED = ("After {n_steps} steps time hardly advances any more, as before a collision", "Raise `dt`")


class Interrupted(KeyboardInterrupt):
    """Ctrl-C during a long run, with the outputs computed until then.

    Attributes
    ----------
    solution : Solution
        The outputs up to the interruption, with status −1, and its time in the message and in
        `stats["interrupted_at"]`.
    """

    def __init__(self, outcome: Outcome, solution: Any = None) -> None:
        super().__init__(outcome.message)
        self.outcome, self.solution = outcome, solution


@dataclass(frozen=True)
class Problem:
    """A validated initial value problem, and the outputs that `solve` wants of an integrator."""

    system: HamiltonianSystem
    t0: float
    t1: float
    y0: Array
    t_eval: np.ndarray | None = None
    save_every: int = 1
    dense_output: bool = False
    backend: str = "auto"
    events: EventSearch | None = None
    parameter_values: np.ndarray | None = None
    """For each trajectory the values (k, N) of the parameters of `system.symbols.parametric`; None: the system's."""
    followed: Mapping[str, Any] = field(default_factory=dict)
    """Tensors that broadcast with the batch, by the names of parameters: `parameter_values` then are their values."""
    progress: Progress | None = None
    """Told how much of the time from t0 to t1 is done."""
    store: RunStore | None = None
    """The store that takes the outputs, and from which the run goes on; the outcome then has none."""
    diagnosed: bool = True
    """True to look at the run when it is over: see `diagnosis.diagnose`."""


@dataclass
class Outcome:
    """The answer of an integrator. `y` has time first: (n, ..., 2d)."""

    t: np.ndarray
    y: Array
    status: int | np.ndarray
    message: str
    stats: dict[str, Any]
    sol: Callable[[Any], Array] | None = None
    finite: bool = False
    """True if `y` has been looked at and is finite all over; `solve` looks again where this is not said."""


class Integrator:
    """Base class of all integrators. See the module's docstring for the contract."""

    name: ClassVar[str]
    order: ClassVar[int | None]
    symplectic: ClassVar[bool]
    trained: ClassVar[bool] = False
    scheme: ClassVar[Scheme | None] = None
    """The scheme of a splitting method."""
    source: ClassVar[str] = ""
    """The citation, or a line on the method, as lists of methods print it."""
    compiles: ClassVar[bool] = False
    finds_events: ClassVar[bool] = False
    takes_infinite_end: ClassVar[bool] = False
    """True if `run` takes an infinite t1, where a terminal event is to end it, and bounds its steps itself."""
    one_by_one: ClassVar[bool] = False
    """True if the trajectories of a batch are run one after another, at the cost of as many single runs."""
    on_grid: ClassVar[bool] = False
    """True if the steps are those of the grid t0 + k·dt, as a peer that drives them presumes."""
    in_another_time: ClassVar[bool] = False
    """True if the steps are equal in a time that is not t."""
    arrays_only: ClassVar[str] = ""
    """Why the method takes NumPy arrays only, and what to do: "runs on NumPy arrays: pass y0.numpy()"; "" if it takes
    tensors too."""
    tangent_holds: ClassVar[str] = ""
    """The quantity that `tangent` holds fixed though a step from a neighbouring state would change it."""
    takes_friction: ClassVar[bool] = False
    """True if every step holds the friction −Γp of a damped system; where it does not, the system is refused."""
    takes_driving: ClassVar[bool] = False
    """True if every step takes H at its times, of a driven system H(t, q, p); where not, the system is refused."""
    takes_forces: ClassVar[bool] = False
    """True if every step holds any force beside −∂H/∂q, as one by `system.vector_field` does."""
    keeps: ClassVar[str] = ""
    """Name of what a run keeps from step to step beside the state y, so that `step` from y alone does not know it."""

    @classmethod
    @cache
    def options(cls) -> tuple[str, ...]:
        """The names of the options that this method takes."""
        return tuple(f.name for f in fields(cls))  # type: ignore[arg-type]

    @property
    def label(self) -> str:
        """The name in rows and legends, which distinguishes methods that differ in options."""
        return self.name

    @property
    def kicks_and_drifts(self) -> Scheme | None:
        """The table of a method whose steps are kicks by −∇V and drifts by ∇T in the physical time; else None."""
        return None

    @classmethod
    def forces_a_step(cls) -> str:
        """Return the evaluations of a step, for tables of methods; "" where they depend on the system or the run."""
        return ""

    @classmethod
    def summary(cls) -> str:
        """Return the `source`, or the first line of the docstring of a method that gives none."""
        return cls.source or (cls.__doc__ or "").partition("\n")[0]

    def takes_parameter_values(self, problem: Problem) -> bool:
        """True if a run takes values of parameters for each trajectory, as numbers of one compiled run."""
        return False

    def check_followed(self, problem: Problem) -> None:
        """Raise a ValueError where gradients do not flow to parameters."""
        raise ValueError(
            f"`params` has {', '.join(problem.followed)}, but no gradient flows to parameters through method "
            f"{self.name!r}: use a splitting method on the splitting 'kinetic', such as 'kahan_li8', a Gauss method, "
            "or detach them."
        )

    def forces_at_ends(self, system: HamiltonianSystem) -> bool:
        """Return True if a step takes a force at its end or beyond it, of first order where H jumps there in t."""
        return False

    def forces_beyond(self, system: HamiltonianSystem) -> bool:
        """Return True if a step takes a force at a time outside of it, so that it meets jumps beyond its ends."""
        return False

    def check(self, system: HamiltonianSystem) -> None:
        """Raise a ValueError with the reason if the method does not apply to the system."""

    def check_store(self) -> None:
        """Raise a ValueError with the reason where a run cannot go on from a store with the same bits."""
        raise ValueError(
            f"`store` keeps runs on a grid of equal steps in t, and method {self.name!r} chooses its steps: use a "
            "fixed-step method, such as 'kahan_li8' or 'gauss_legendre6', or leave `store` out."
        )

    def check_library(self, y0: Array) -> None:
        """Raise a TypeError with the reason if y0 is a tensor and the method takes NumPy arrays only."""
        if is_tensor(y0) and self.arrays_only:
            raise TypeError(f"`y0` is a tensor, but method {self.name!r} {self.arrays_only}.")

    def resolved(self, system: HamiltonianSystem, y0: Array, length: float, n_times: int = 0) -> Integrator:
        """Return the integrator that runs from y0 over a time `length`, where the method leaves a choice.

        `n_times` is the number of given output times.
        """
        return self

    @property
    def given_flow(self) -> FlowMap | None:
        """The trained flow that was given as an option."""
        return None

    def flow_for(self, system: HamiltonianSystem) -> FlowMap | None:
        """Return the trained flow that is used for a system, one in the system's own time; None if there is none."""
        return None

    def known_flow(self, system: HamiltonianSystem) -> KnownFlow | None:
        """Return what is known of that flow, which compiled runs need and no torch."""
        return self.flow_for(system)

    def on_extended(self, system: HamiltonianSystem, extended: HamiltonianSystem) -> Integrator | None:
        """Return the same method on a driven system with the time and its momentum E; None where there is none."""
        return None if self.trained else self

    def identity_for(self, system: HamiltonianSystem) -> Identity | None:
        """Return the H that the trained flow for a system was made for; None without a flow, or where it is unknown."""
        flow = self.known_flow(system)
        return None if flow is None else flow.identity

    def figures(self, system: HamiltonianSystem) -> Mapping[str, Any]:
        """Return the figures of the trained flow that runs, such as `training_seconds`; {} without a flow."""
        flow = self.known_flow(system)
        return {} if flow is None else flow.figures

    def step_length(self, system: HamiltonianSystem) -> float | None:
        """Return the step that is used for a system; None where the method chooses its steps."""
        return None

    def output_step(self, problem: Problem) -> float | None:
        """Return the time between two outputs where no `t_eval` is given; None where that is each step's own."""
        return self.step_length(problem.system)

    def step(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        """One step of signed length h from the states y (..., 2d)."""
        raise TypeError(f"`method` {self.name!r} cannot be stepped by itself: use solve().")

    def inverse(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        """The state from which `step(system, t, ·, h)` leads to y."""
        raise TypeError(f"`method` {self.name!r} has no exact inverse: use a symplectic method.")

    def tangent(self, system: HamiltonianSystem, t: float, y: Array, h: Array) -> tuple[np.ndarray, np.ndarray]:
        """The step from y (..., 2d) and its Jacobian A (..., 2d, 2d), by forward-mode differentiation of `step`."""
        if self.arrays_only:
            raise TypeError(
                f"`method` {self.name!r} {self.arrays_only}; so its step cannot be differentiated: write it with the "
                "functions of sympflow.arrays, or define tangent()."
            )
        times = as_tensor(np.array(t)) if np.ndim(t) else t
        return forward_tangent(lambda x, lengths: self.step(system, times, x, lengths), y, h)

    def tangent_kernel(self, system: HamiltonianSystem, vectors: int) -> TangentKernel:
        """The compiled loops of steps with this number of deviation vectors; a ValueError says why there are none."""
        raise NotCompiled(f"`method` {self.name!r} has no compiled deviation vectors: use backend='auto'.")

    def jacobian(self, system: HamiltonianSystem, t: float, y: Array, h: Array) -> np.ndarray:
        """The Jacobian (..., n, n) of a step from y in the phase space where steps are made; n = 2d but if extended."""
        return self.tangent(system, t, y, h)[1]

    def jvp(self, system: HamiltonianSystem, t: Any, y: Array, h: Array, W: np.ndarray) -> np.ndarray:
        """Vectors W (..., 2d, k) moved by the derivative of the step from y (..., 2d)."""
        return self.tangent(system, t, y, h)[1] @ W

    def jvp_steps(
        self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array
    ) -> Iterator[tuple[np.ndarray, np.ndarray, Callable[[np.ndarray], np.ndarray]]]:
        """The steps of the run, one by one: times and lengths (...), and what moves vectors W (..., 2d, k)."""
        for times, lengths, jacobians in self.executed(system, t_span, y0):
            yield from ((t, h, A.__matmul__) for t, h, A in zip(times, lengths, jacobians, strict=True))

    def executed(
        self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array
    ) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """The steps of the run, differentiated where they were made: times and lengths (n, ...), Jacobians as above."""
        for times, states, lengths in in_blocks(self.own_steps(system, t_span, y0)):
            yield differentiated(partial(self.jacobian, system), times, states, lengths)

    def run(self, problem: Problem) -> Outcome:
        """Solve the problem."""
        raise NotImplementedError(f"{type(self).__name__} must define run().")

    def steps(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array) -> Steps:
        """Execute the run again as a stream of its steps."""
        raise NotImplementedError(f"{type(self).__name__} must define steps().")

    def own_steps(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array) -> Steps:
        """The same in the phase space where steps are made."""
        return self.steps(system, t_span, y0)


class ByVectorField(Integrator):
    """An integrator whose steps evaluate `system.vector_field` at its times, and take all that this holds."""

    takes_friction: ClassVar[bool] = True
    takes_driving: ClassVar[bool] = True
    takes_forces: ClassVar[bool] = True


def in_blocks(steps: Steps) -> Steps:
    """The chunks of a stream of steps, divided so that the Jacobians of each fit into the memory."""
    for times, states, lengths in steps:
        rows, k = math.prod(states.shape[1:-1]), states.shape[-1]
        if rows * k**2 > MAX_ASKED_VALUES:
            raise ValueError(
                f"`sol` has {rows} trajectories of {k} variables, so that the Jacobians of one step have "
                f"{rows * k**2:.3g} entries, more than {MAX_ASKED_VALUES:.0e}: solve fewer, or smaller ones."
            )
        n = max(1, MOST_ENTRIES // (rows * k**2))
        for i in range(0, len(times), n):
            yield times[i : i + n], states[i : i + n], lengths[i : i + n]


def forward_tangent(
    step: Callable[[Any, Any], Any], y: Array, h: Array, W: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """step(y, h) and its Jacobian in y, (..., n) and (..., n, n), by forward-mode differentiation of tensors.

    Of given vectors W (..., n, k) their images, the product with the Jacobian.
    """
    x = as_tensor(to_numpy(y))
    lengths, directions = (None if each is None else like(each, x) for each in (h, W))
    y_next, J = jacobian(lambda z: step(z, lengths), x, directions)
    return to_numpy(y_next), to_numpy(J)


def differentiated(
    jacobian: Callable[[Any, np.ndarray, np.ndarray], np.ndarray], times: np.ndarray, states: Array, lengths: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A chunk of `steps` as times and lengths (n, ...) and Jacobians (n, ..., k, k).

    `jacobian` is given the times (n, ...), the states and the lengths. Each step is differentiated in the precision in
    which it was executed, so its Jacobian holds the rounding of that precision; it is returned as float64.
    """
    y = to_numpy(states)
    batch = y.shape[:-1]
    t, h = (np.broadcast_to(x.reshape(*x.shape, *[1] * (len(batch) - x.ndim)), batch) for x in (times, lengths))
    with np.errstate(all="ignore"):
        return t, h, jacobian(t, y, h.astype(y.dtype)).astype(float)


def method_class(base: type[M], class_name: str, module: str, kind: type[type] = type, **own: Any) -> type[M]:
    """Return the integrator class of a row of a table: a base with attributes of its own, by which it is documented."""
    own = {"__doc__": f"{own['source']}\n\n{base.__doc__}", "__module__": module, **own}
    return dataclass(frozen=True, repr="__repr__" not in vars(base))(kind(class_name, (base,), own))


def method_text(integrator: Integrator, dt: float | None = None) -> str:
    """A method and its options in words: those that differ from the defaults, and the step."""
    known: tuple[Field[Any], ...] = fields(integrator)  # type: ignore[arg-type]
    given = {f.name: (getattr(integrator, f.name), f.default) for f in known if f.init and f.repr}
    options = {name: value for name, (value, default) in given.items() if value is not None and value != default}
    if dt is not None:
        options["dt"] = dt
    shown = (f"{name} = {v:.6g}" if isinstance(v, float) else f"{name} = {v}" for name, v in options.items())
    return ", ".join([integrator.label, *(cut(text, 40) for text in shown)])
