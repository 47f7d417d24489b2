"""Is the right-hand side that a peer was given the system that our method solves?"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any
from weakref import WeakKeyDictionary, ref

import numpy as np

from sympflow.arrays import to_numpy
from sympflow.hamiltonian.domain import Domain, EnergySublevel
from sympflow.hamiltonian.fingerprint import same_system
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep

RightHandSide = Callable[[float, np.ndarray], Any]
"""The slopes (..., 2d) that the peer's function gives at a time and states (..., 2d)."""

TOLERANCE = 1e-6  # of a component, and of its usual size: a formula may be written in another order
OF_A_FLOW = (1e-3, 0.1)  # of the largest velocity, at best and at worst: a flow was trained to a residual
NEAR = (0.02, 0.1, 0.3, 0.6, 1.0)  # distances from the start, in sizes of q and of p
N_WITHIN = 6  # states of the domain
MOST_ROWS = 256  # of a batch, whose velocities are compared
SHOWN = 4  # numbers of a state, in messages
FIRST_LOOK, LONGEST_GAP = 13, 64  # steps of a run before it is compared again

MOST_FUNCTIONS = 64  # right-hand sides that a system remembers

_WITHIN: WeakKeyDictionary[HamiltonianSystem, np.ndarray] = WeakKeyDictionary()  # drawn once for each system
_COMPARED: WeakKeyDictionary[HamiltonianSystem, dict[int, tuple[ref[Any], np.ndarray]]] = WeakKeyDictionary()
"""For each system the right-hand sides that whole runs found to be it, by their ids; the bounds of [t, q, p] there."""


class Comparison:
    """Compares the right-hand side that a peer was given with the velocity of the motion that a method computes.

    That is J∇H of the system; of a flow that was given without one, ∂_tψ̄ at t = 0.

    Parameters
    ----------
    argument : str
        The peer's name of its right-hand side.
    integrator : FixedStep
    system : HamiltonianSystem or None
        None for a flow that was given without a system.
    remedy : str
        The way to pass the same system twice.
    given : callable
        The right-hand side; a system is compared by its fingerprint at once, and another one is a ValueError.

    Attributes
    ----------
    given : callable or None
        None for the system itself, which needs no comparison.
    states_compared : int
        States at which the method's own velocity was evaluated so far.
    known : bool
        True if an earlier run compared this very right-hand side, so that its start and end are enough.
    """

    def __init__(
        self, argument: str, integrator: FixedStep, system: HamiltonianSystem | None, remedy: str, given: Any
    ) -> None:
        self.argument, self.integrator, self.system, self.remedy = argument, integrator, system, remedy
        self.flow: Any = integrator.given_flow if system is None else integrator.flow_for(system)
        self.states_compared, self.known = 0, False
        self._next, self._gap = FIRST_LOOK, FIRST_LOOK
        self.given: Any = None if given is system else given
        if system is None or given is system or not isinstance(given, HamiltonianSystem):
            return
        if system.ndof != given.ndof or not same_system(system.fingerprint, given.fingerprint):
            raise ValueError(
                f"`{argument}` is not the system that method {integrator.name!r} solves: their Hamiltonians differ "
                f"({given!r} and {system!r}). {remedy}"
            )

    def with_flow(self, y: np.ndarray, t: float) -> None:
        """Compare the velocity of a flow without a system with that of the system to be solved.

        Raises
        ------
        ValueError
            If they differ at y (2d,) or in the domain of the flow; of a driven system at the time t.
        """
        if self.flow is None or self.system is None or self.flow.fingerprint is not None:
            return
        states = np.concatenate([y[None], _drawn(self.flow.domain_for(self.system), y.size)])
        times = np.full(len(states), t)
        self._close_to_flow(times, states, self.system.vector_field(states, times))

    def at_start(self, fun: RightHandSide, y0: np.ndarray, t_span: tuple[float, float], remembers: bool = True) -> None:
        """Compare at several states and times: y0 (..., 2d), states around it, and states of the domain.

        At y0 alone, if the function of the user is remembered from a run with such states and times.

        Raises
        ------
        ValueError
            If the right-hand side is another system's, or depends on the time.
        """
        t0 = t_span[0]
        self.at(t0, y0, fun(t0, y0), fun)
        self.known = remembers and self._remembers(_bounds(t_span, [y0]))
        if self.known:
            return
        probes = self._probes(y0)
        self._bounds = _bounds(t_span, [y0, *probes]) if remembers else None
        for t, y in zip(_times(t_span, 16), probes, strict=False):
            slope = _quietly(fun, t, y)
            if slope is None:
                continue
            if self.system is not None:
                self.at(t, y, slope, fun, t0)
                continue
            before = _quietly(fun, t0, y)
            if before is not None and not _agree(slope, before).all():
                self._refuse_time(t0, t, y, before, slope)
            if self._ground() is not None:
                states = y.reshape(-1, y.shape[-1])
                self._close_to_flow(np.full(len(states), t), states, slope.reshape(states.shape))

    def remember(self) -> None:
        """Remember the right-hand side, weakly, once all comparisons of a run have found it to be the system."""
        if self.system is None or self.known or self._bounds is None:
            return
        try:
            given = ref(self.given)
        except TypeError:
            return
        known, key, bounds = _COMPARED.setdefault(self.system, {}), id(self.given), self._bounds
        if key in known and known[key][0]() is self.given:
            before = known[key][1]
            bounds = np.stack([np.minimum(before[0], bounds[0]), np.maximum(before[1], bounds[1])])
        if key not in known and len(known) >= MOST_FUNCTIONS:
            for dead in [k for k, (function, _) in known.items() if function() is None] or list(known):
                del known[dead]
        known[key] = given, bounds

    def _remembers(self, bounds: np.ndarray) -> bool:
        """True if the right-hand side was compared where these bounds of [t, q, p] lie within."""
        if self.system is None or self.system not in _COMPARED:
            return False
        function, known = _COMPARED[self.system].get(id(self.given), (None, bounds))
        if function is None or function() is not self.given:
            return False
        return bool((known[0] <= bounds[0]).all() and (known[1] >= bounds[1]).all())

    def _probes(self, y0: np.ndarray) -> list[np.ndarray]:
        """States like y0 (..., 2d): each of its rows moves to each distance, and to each state of the domain, in turn.

        As few of them as a batch has rows enough, but three at least.
        """
        rows = y0.reshape(-1, y0.shape[-1])
        d = rows.shape[-1] // 2
        size = np.repeat([np.abs(rows[:, part]).max() or 1.0 for part in (slice(0, d), slice(d, None))], d)
        noise = np.random.Generator(np.random.PCG64(20260101)).uniform(-1, 1, (len(NEAR), 2 * d))
        moves, within = size * noise * np.array(NEAR)[:, None], self._within()
        kinds = len(moves) + len(within)
        probes = []
        for k in range(max(3, -(-kinds // len(rows)))):
            kind = (np.arange(len(rows)) + k * len(rows)) % kinds
            states = rows + moves[np.minimum(kind, len(moves) - 1)]
            inside = kind >= len(moves)
            states[inside] = within[kind[inside] - len(moves)]
            probes.append(states.reshape(y0.shape))
        return probes

    def _within(self) -> np.ndarray:
        """States of the domain (n, 2d), n = 0 without one."""
        system = self.system
        if system is None:
            ground = self._ground()
            return _drawn(ground if ground is self.flow.domain else None, 2 * self.flow.ndof)
        if system not in _WITHIN:
            _WITHIN[system] = _drawn(system.domain, 2 * system.ndof)
        return _WITHIN[system]

    def _ground(self) -> Domain | None:
        """The domain of a flow that was given alone, or a box about it, if its H is not known."""
        domain = self.flow.domain
        return domain.box if isinstance(domain, EnergySublevel) and domain.hamiltonian is None else domain

    def is_due(self, n_steps: int) -> bool:
        """Return True if the run is to be compared again after so many steps: more and more seldom, never in rhythm."""
        if n_steps < self._next:
            return False
        self._gap = min(2 * self._gap, LONGEST_GAP)
        self._next = n_steps + self._gap - 7 * n_steps % 11
        return True

    def at(self, t: Any, y: np.ndarray, slope: Any, fun: RightHandSide, t0: float | None = None) -> None:
        """Compare at states y (..., 2d) of the run, where `fun` gives `slope`, at a time or a time for each.

        Raises
        ------
        ValueError
            If the right-hand side is another system's, or, where t0 is given, depends on the time.
        """
        width = y.shape[-1]
        states, slope = y.reshape(-1, width)[:MOST_ROWS], np.asarray(slope).reshape(-1, width)[:MOST_ROWS]
        times = np.broadcast_to(t, y.shape[:-1]).reshape(-1)
        if self.system is None:
            self._close_to_flow(times, states, slope)
            return
        self.states_compared += len(states)
        with np.errstate(all="ignore"):
            velocity = self.system.vector_field(states.astype(float), times[: len(states)].astype(float))
        agree = _agree(slope, velocity)
        if agree.all():
            return
        i = int(np.argmin(agree))
        if t0 not in (None, times[i]) and (before := _quietly(fun, t0, y)) is not None:
            before = before.reshape(-1, width)[:MOST_ROWS]
            if _agree(before, velocity)[i]:
                self._refuse_time(t0, times[i], states[i], before[i], slope[i])
        self._refuse(times[i], states[i], slope[i], velocity[i])

    def _close_to_flow(self, times: np.ndarray, states: np.ndarray, slope: np.ndarray) -> None:
        import torch

        states = states.astype(float)
        if (ground := self._ground()) is not None:  # elsewhere it was trained for nothing
            inside = np.asarray(ground.contains(states))
            times, states, slope = times[: len(inside)][inside], states[inside], slope[inside]
        if not len(states):
            return
        self.states_compared += len(states)
        with torch.no_grad():
            x = torch.from_numpy(states.copy()).to(self.flow.dtype)
            velocity = to_numpy(self.flow.initial_velocity(x, torch.from_numpy(times.copy())))
        largest = np.maximum(np.abs(slope).max(-1), np.abs(velocity).max(-1))
        best, worst = OF_A_FLOW
        measured = self.flow.figures.get("one_step_error")
        allowed = worst if measured is None else min(max(1000 * float(measured), best), worst)
        with np.errstate(invalid="ignore"):
            bad = np.abs(velocity - slope).max(-1) > allowed * np.maximum(largest, 1e-3)
        if bad.any():
            i = int(np.argmax(bad))
            self._refuse(times[i], states[i], slope[i], velocity[i])

    def _refuse(self, t: float, y: np.ndarray, slope: np.ndarray, velocity: np.ndarray) -> None:
        what = "its flow moves it" if self.system is None else f"{self.system.name!r} moves it"
        apart = np.abs(slope - velocity).ravel()
        i = int(np.argmax(np.where(np.isnan(apart), np.inf, apart)))
        where = ""
        if i >= SHOWN:
            where = f" The entry {i} differs most: {slope.ravel()[i]:.6g} and {velocity.ravel()[i]:.6g}."
        raise ValueError(
            f"`{self.argument}` is not the system that method {self.integrator.name!r} solves: at t = {t:.6g} it moves "
            f"the state {_short(y)} with velocity {_short(slope)}, and {what} with {_short(velocity)}.{where} "
            f"{self.remedy}"
        )

    def _refuse_time(self, t0: float, t: float, y: np.ndarray, before: np.ndarray, after: np.ndarray) -> None:
        raise ValueError(
            f"`{self.argument}` depends on the time: it moves the state {_short(y)} with velocity {_short(before)} at "
            f"t = {t0:.6g}, and with {_short(after)} at t = {t:.6g}; method {self.integrator.name!r} solves an "
            "autonomous system. Use a method of the peer's own, or take t and its momentum into the state."
        )


def _agree(slope: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """True for each of the states whose slopes (..., 2d) agree to rounding, or are not finite both."""
    rounding = float(np.finfo(slope.dtype).eps) if slope.dtype.kind == "f" else 0.0
    tolerance = max(TOLERANCE, 2000 * rounding)
    with np.errstate(all="ignore"):
        if (np.abs(slope - velocity) <= tolerance * np.abs(velocity)).all():  # nearly always
            return np.ones(slope.shape[:-1], dtype=bool)
        size = np.maximum(np.abs(slope), np.abs(velocity))
        typical = np.median(np.where(np.isfinite(size), size, 0.0).reshape(-1, size.shape[-1]), axis=0)
        halves = size.reshape(*size.shape[:-1], 2, -1).max(-1, keepdims=True)
        floor = np.broadcast_to(halves, (*size.shape[:-1], 2, size.shape[-1] // 2)).reshape(size.shape)
        allowed = tolerance * (size + typical) + max(1e-13, 1000 * rounding) * floor
        return ~(np.abs(slope - velocity) > allowed).any(-1)


def _quietly(fun: RightHandSide, t: float, y: np.ndarray) -> np.ndarray | None:
    """The slopes at states that are not on the run, where the user's function may fail: None then."""
    try:
        with np.errstate(all="ignore"):
            slope = np.asarray(fun(t, y))
    except Exception:
        return None
    return slope if slope.shape == y.shape else None


def _bounds(t_span: tuple[float, float], states: Sequence[np.ndarray]) -> np.ndarray:
    """The least and the largest time, and value of each component of the states (..., 2d): (2, 1 + 2d)."""
    rows = np.concatenate([y.reshape(-1, y.shape[-1]) for y in states])
    return np.array([[min(t_span), *rows.min(0)], [max(t_span), *rows.max(0)]])


def _times(t_span: tuple[float, float], n: int) -> list[float]:
    """Times within an interval that may have no end, in no rhythm."""
    t0, t1 = t_span
    if math.isinf(t1):
        return [t0 + math.copysign(0.61803398875 * 1.7**k, t1) for k in range(n)]
    return [t0 + (t1 - t0) * ((k + 1) * 0.61803398875 % 1) for k in range(n)]


def _drawn(domain: Domain | None, width: int) -> np.ndarray:
    return np.empty((0, width)) if domain is None else domain.sample(N_WITHIN, 20260101)


def fixed_step(method: Any, options: dict[str, Any], peer: str, *systems: Any) -> FixedStep:
    """The fixed-step integrator that `method` and `options` mean; a TypeError where the peer cannot drive it."""
    from sympflow.integrators.registry import build, check_applies

    for what in (type(x).__name__ for x in systems if not isinstance(x, HamiltonianSystem)):
        raise TypeError(f"`system` must be a HamiltonianSystem; got {what}. See sympflow.interop.systems.")
    integrator = build(method, options)
    if not isinstance(integrator, FixedStep):
        raise TypeError(
            f"`method` {integrator.name!r} is not a fixed-step map, and {peer} takes nothing else: use a "
            f"splitting method or a trained flow, or {peer}'s own method."
        )
    if integrator.in_another_time and integrator.given_flow is not None:
        raise TypeError(
            f"`flow` runs in another time, so that its steps are not equal in t, which {peer} cannot drive: use "
            "solve(), or a flow in the system's own time (sympflow.shipped_flows() lists them, `shift` is None)."
        )
    if integrator.keeps:
        raise TypeError(
            f"`method` {integrator.name!r} keeps {integrator.keeps} from step to step, which {peer} cannot hand on: "
            "use solve(), or another method."
        )
    if not integrator.on_grid:
        raise TypeError(
            f"`method` {integrator.name!r} takes steps that are not equal in t, which {peer} cannot drive: use "
            "solve(), or another method."
        )
    for system in systems:
        check_applies(integrator, system)
    return integrator


def _short(v: np.ndarray) -> str:
    shown = ", ".join(f"{x:.6g}" for x in v.ravel()[:SHOWN])
    return f"({shown}{', …' if v.size > SHOWN else ''})"
