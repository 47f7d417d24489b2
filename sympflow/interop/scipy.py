"""Our methods inside `scipy.integrate.solve_ivp`, through SciPy's public `OdeSolver` and `DenseOutput`."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from scipy.integrate import DenseOutput, OdeSolver

from sympflow.arguments import as_float, warn
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep, Problem
from sympflow.integrators.grid import Grid, no_event, open_end
from sympflow.integrators.impulses import landings, spans
from sympflow.integrators.registry import check_applies, naming_plugin
from sympflow.integrators.steppers import Stepper
from sympflow.interop.matching import Comparison, fixed_step
from sympflow.lazy import Made

if TYPE_CHECKING:
    from sympflow.flow.flow_map import FlowMap

LOOK_AHEAD = 64
REMEDY = "Pass one system twice: solve_ivp(system, ..., method=as_scipy(name, system)), or as_scipy(name) alone."


def as_scipy(method: Any, system: HamiltonianSystem | None = None, **options: Any) -> type[FlowSolver]:
    """An `OdeSolver` class for ``solve_ivp(fun, t_span, y0, method=...)`` that runs one of our methods.

    The steps, the dense output (ψ̄ at the fractional time, no interpolation), `t_eval`, events, `args`, empty and
    backward intervals are those of `solve`. `max_step` samples the flow within its steps, so that events between them
    are seen; the steps themselves stay on the grid t0 + k·dt, since shorter ones would be another map.

    Parameters
    ----------
    method : trained flow, str or Integrator
        A flow, a name such as "verlet" or "sympflow" (the shipped flow), or a configured integrator.
    system : HamiltonianSystem, optional
        What is solved. A flow has its own; otherwise it may only be left out if `fun` is a HamiltonianSystem.
    **options
        Options of the method, such as `dt`.

    Raises
    ------
    TypeError, ValueError
        If the method does not apply to the system, is adaptive, or has no such option. Within `solve_ivp` it is a
        ValueError if `fun` is another system than that of the method, or depends on the time: this is tested at several
        states and times, before the run and along it.

    Examples
    --------
    >>> from scipy.integrate import solve_ivp
    >>> import sympflow
    >>> system = sympflow.systems.henon_heiles()
    >>> Verlet = as_scipy("verlet", system, dt=0.1)
    >>> solve_ivp(system, (0, 10), system.y0, method=Verlet).y.shape
    (4, 101)
    """
    return _solver_class(fixed_step(method, options, "SciPy", *([] if system is None else [system])), system)


def _solver_class(integrator: FixedStep, system: HamiltonianSystem | None) -> type[FlowSolver]:
    name = f"{integrator.name.title().replace('_', '')}Solver"
    made_of = _solver_class, (integrator, system)
    namespace = {"integrator": integrator, "system": system, "__doc__": FlowSolver.__doc__, "made_of": made_of}
    return Made(name, (FlowSolver,), namespace)  # type: ignore[return-value]


class FlowSolver(OdeSolver, metaclass=Made):
    """A fixed-step method of sympflow as a SciPy solver, on the grid t0 + k·dt. Made by `as_scipy`.

    Parameters
    ----------
    fun, t0, y0, t_bound, vectorized
        As for every `OdeSolver`. Where `fun` is not the system of the method itself, it is evaluated at a dozen states
        and times before the run, and along it, about once in 60 steps.
    max_step : float
        Longest time between two reported states; they are samples of the flow within its steps.

    Attributes
    ----------
    nfev : int
        Evaluations of `fun` and of the forces: those of the steps, of outputs and events within steps, and of the
        comparison of `fun` with the method's own velocity.
    """

    integrator: ClassVar[FixedStep]
    system: ClassVar[HamiltonianSystem | None]
    t: Any
    y: Any

    def __init__(
        self,
        fun: Callable[..., Any],
        t0: float,
        y0: Any,
        t_bound: float,
        vectorized: bool = False,
        max_step: float = math.inf,
        **extraneous: Any,
    ) -> None:
        if math.isnan(t0) or math.isnan(t_bound) or math.isinf(t0):
            raise ValueError(f"`t_span` must start at a finite time and end at one or ±inf; got ({t0}, {t_bound}).")
        first_step = extraneous.get("first_step")  # refused as SciPy's own solvers refuse it, though steps are our own
        if first_step is not None and not as_float(first_step) > 0:
            raise ValueError(f"`first_step` must be positive; got {first_step!r}. Leave it out.")
        if first_step is not None and first_step > (length := abs(t_bound - t0)):
            raise ValueError(f"`first_step` {first_step:g} exceeds the interval, of length {length:g}. Leave it out.")
        if extraneous:
            own = sorted(set(extraneous) & set(self.integrator.options()))
            remedy = f"leave them out; {', '.join(own)} is an option of as_scipy" if own else "leave them out"
            warn(
                f"The options {', '.join(sorted(extraneous))} have no effect on a fixed-step method: {remedy}.",
            )
        if not as_float(max_step) > 0:
            raise ValueError(f"`max_step` must be positive; got {max_step!r}.")
        self._counts = _Counts()
        super().__init__(fun, t0, y0, t_bound, vectorized)
        self._check(fun)
        system = self._solved
        dt = self.integrator.step_length(system)
        jumps: list[float] = []
        if system is not None and math.isfinite(t_bound):
            system.check_times(t0, t_bound)
            told, jumps = landings(self.integrator, system, t0, t_bound)
            if told:
                warn(told, RuntimeWarning)
        end = open_end(t0, t_bound, dt)
        self._pieces, self._length = spans(float(t0), float(end), [], jumps)[::-1], dt
        self._stepper = self._counts.stepper = self.integrator.stepper(Problem(system, t0, end, self.y))
        self._parts = max(1, math.ceil(dt / max_step * (1 - 1e-12)))
        self._part = 0  # the sample after the grid point before the state
        self._anchor = self.y
        self._begin()
        self._ahead: deque[np.ndarray] = deque()
        self._block = 1

    def _check(self, fun: Callable[..., Any]) -> None:
        integrator = self.integrator
        given = integrator.given_flow
        self._solved: Any = self.system or (None if given is None else given.system)
        if self._solved is None and isinstance(fun, HamiltonianSystem):
            self._solved = fun
        if (self._solved is None and not integrator.trained) or (integrator.trained and self._flow() is None):
            raise TypeError(
                f"`system` is needed for method {integrator.name!r}: as_scipy({integrator.name!r}, system), or pass a "
                "HamiltonianSystem as `fun`."
            )
        flow = self._flow()
        size = 2 * (self._solved if flow is None else flow).ndof
        if self.n != size:
            raise ValueError(f"`y0` must have length {size}, [q, p]; got {self.n}.")
        if not np.isfinite(self.y).all():
            raise ValueError("`y0` must be finite; it holds NaN or infinity.")
        if self._solved is not None and self._solved is not self.system:
            check_applies(integrator, self._solved)
        self.y = self.y.astype(float)
        self._comparison = Comparison("fun", integrator, self._solved, REMEDY, fun)
        with np.errstate(all="ignore"):
            slope = np.asarray(self.fun(self.t, self.y), dtype=float)
        if slope.shape != self.y.shape:
            raise ValueError(f"`fun` must return shape {self.y.shape}, as `y0`; got {slope.shape}.")
        self._comparison.with_flow(self.y, self.t)
        if self._comparison.given is not None:
            self._comparison.at_start(self._slope, self.y, (self.t, self.t_bound))
        self._count_compared()

    def _begin(self) -> None:
        """Begin the next piece between jumps of H in t, from the state."""
        start, end, self._stop = self._pieces.pop()
        self._grid, self._k = Grid(start, end, self._length), 0  # the grid, and the point of it before the state
        self._t_anchor, self._next_anchor = start, (start, self.y)

    def _slope(self, t: float, y: np.ndarray) -> np.ndarray:
        """`fun` in the precision in which it answers."""
        self._counts.others += 1
        return np.asarray(self._comparison.given(t, y.copy()))

    def _count_compared(self) -> None:
        """Count the evaluations of the method's own velocity."""
        n, self._comparison.states_compared = self._comparison.states_compared, 0
        flow = self._comparison.flow if self._solved is None else None
        self._counts.others += n if flow is None else n * flow.evaluations(0, 0, 1, "array")["force_evaluations"]

    @property
    def nfev(self) -> int:
        return self._counts.total()

    @nfev.setter
    def nfev(self, value: int) -> None:
        self._counts.others += value - self._counts.total()

    def _flow(self) -> FlowMap | None:
        """The flow; None for a classical method, or if it cannot be known without a system."""
        return self.integrator.given_flow if self._solved is None else self.integrator.flow_for(self._solved)

    def _step_impl(self) -> tuple[bool, str | None]:
        grid = self._grid
        if self._part == 0:
            if self._k == grid.n_steps + bool(grid.remainder):
                if not self._pieces:
                    return False, no_event(self._k, self.t)
                self._begin()
                grid = self._grid
            self._t_anchor, self._anchor = self._next_anchor
            whole = self._k < grid.n_steps
            self._h = grid.h if whole else grid.remainder
            self._end = grid.time(self._k + 1) if whole else grid.t1
            if self._solved is not None and math.isinf(self.t_bound):
                try:
                    self._solved.check_times(self._t_anchor, self._end)
                except ValueError as error:
                    return False, str(error)
            y_end = self._whole_step() if whole else self._shorter(self._h)
            if not np.isfinite(y_end).all():
                return False, (
                    f"The solution became non-finite after t = {self.t:.15g} (step {self._k + 1}). Reduce `dt`, or end "
                    "`t_span` earlier."
                )
            self._next_anchor = (self._end, y_end)
        if self._parts > 1 and abs(self._h) < 10 * self._parts * math.ulp(self.t):
            return False, f"{self.TOO_SMALL_STEP} Raise `max_step`, or start nearer to t = 0."
        self._part += 1
        if self._part == self._parts:
            self._k, self._part = self._k + 1, 0
            self.t, self.y = self._next_anchor
            if self._k == grid.n_steps + bool(grid.remainder):
                self.t = self._stop
            last = self.t == self.t_bound
            if self._comparison.given is not None and (last or self._comparison.is_due(self._k)):
                self._comparison.at(self.t, self.y, self._slope(self.t, self.y), self._slope, grid.t0)
                self._count_compared()
                if last:
                    self._comparison.remember()
        else:
            h = self._h * self._part / self._parts
            self.t, self.y = self._t_anchor + h, self._shorter(h)
        return True, None

    def _whole_step(self) -> np.ndarray:
        """The state at the next grid point. Steps are computed a few ahead, where a compiled loop is cheap."""
        if not self._ahead:
            n = min(self._block, self._grid.n_steps - self._k)
            self._block = min(2 * self._block, LOOK_AHEAD)
            with naming_plugin(self.integrator):
                states, _ = self._stepper.rollout(self._anchor, self._grid.h, n, np.arange(1, n + 1), self._t_anchor)
            self._counts.pieces[n] += 1
            self._ahead.extend(states)
        return self._ahead.popleft()

    def _shorter(self, h: float) -> np.ndarray:
        with naming_plugin(self.integrator), np.errstate(all="ignore"):
            y = self._stepper.shorter(self._anchor, h, self._t_anchor)
        self._counts.shorter += 1
        return y

    def _dense_output_impl(self) -> DenseOutput:
        return FlowOutput(self, self._t_anchor, self._anchor)


class _Counts:
    """Steps, shorter steps and other evaluations so far; those of the dense outputs of a solver too."""

    def __init__(self) -> None:
        self.pieces: Counter[int] = Counter()  # runs of so many steps, each with its own beginning and saved states
        self.shorter = self.others = 0
        self.stepper: Stepper | None = None

    def total(self) -> int:
        """Evaluations of the force."""
        if self.stepper is None:
            return self.others
        runs = [(0, 0, self.shorter, 1)]
        if not self.stepper.counts_itself:
            runs += [(n, n, 0, times) for n, times in self.pieces.items()]
        return self.others + sum(times * self.stepper.evaluations(*run)["force_evaluations"] for *run, times in runs)


class FlowOutput(DenseOutput):
    """The state between two outputs: a shorter step from the grid point before."""

    def __init__(self, solver: Any, t_anchor: float, anchor: np.ndarray) -> None:
        super().__init__(solver.t_old, solver.t)
        self._integrator, self._stepper, self._counts = solver.integrator, solver._stepper, solver._counts
        self._t_anchor, self._anchor, self._y = t_anchor, anchor, solver.y

    def _call_impl(self, t: np.ndarray) -> np.ndarray:
        times = np.atleast_1d(t).astype(float)
        states = np.repeat(self._anchor[None], len(times), axis=0)
        h = times - self._t_anchor
        moving = (h != 0) & (times != self.t)
        states[times == self.t] = self._y
        if moving.any():
            with naming_plugin(self._integrator), np.errstate(all="ignore"):
                states[moving] = self._stepper.shorter(states[moving], h[moving], self._t_anchor)
            self._counts.shorter += int(np.count_nonzero(moving))
        return states.T if t.ndim else states[0]
