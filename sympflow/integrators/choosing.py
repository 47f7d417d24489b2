"""The choice of a method for a system, and of the step for a tolerance."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from sympflow.arguments import as_float, check_t_span
from sympflow.arrays import Array, readable, to_numpy
from sympflow.hamiltonian.scales import (
    MOST_DENSE,
    default_step,
    known_scale,
    size_of_terms,
    smallest_size,
    started,
    weights,
)
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep
from sympflow.integrators.contract import Integrator, Problem
from sympflow.integrators.impulses import landings, run_in_pieces
from sympflow.integrators.problems import check_y0
from sympflow.integrators.registry import build, check_applies, get
from sympflow.lazy import lately_kept
from sympflow.systems.given import GivenSystem, given_system

TRIAL_STEPS, TRIAL_LENGTH, MOST_TRIAL_STEPS = 4096, 400, 1_000_000
"""Steps of a trial run; where it is compiled, so many of `system.dt`, at most the last number; or the run itself."""
AT_ROUNDING = 1e-8  # errors that may be rounding: below it, steps that are shorter and no better end the search
FINEST_SINGLE = 2e-6  # the smallest tolerance of runs in single precision, 16 units in the last place
KEPT = 1e-12  # errors of the energy that are round-off, whatever the step
TRIALS = 12
MOST_STATES = 16  # of a batch in trials
LOOKED_AT = 64  # states of a trial at which the size of the terms of H is taken
BALANCED = 16
"""Parts of a run with friction or a drive, in each of which its energy is compared with that of half steps from its own
state. What they differ by, added up, is the error of the balance of energy and work: the orbits may be chaotic."""
SAFETY = 0.5  # of the tolerance, at which a step is aimed
ENOUGH, MOST = 0.2, 0.7  # of the tolerance: errors with which a step is taken
NEAR_POLE = tuple(10.0**-k for k in range(1, 7))
LOGARITHMIC = 0.9  # ratio of differences of V at these distances from a pole, at least: of a logarithm 1
NEWTON_STEPS, MOST_CENTERS = 8, 12  # of places that are looked for, and coordinates of the motion
Candidate = tuple[str, str]  # the name of a method, and why it is chosen
CHOSEN_WITH = {"wisdom_holman": {"corrector": 17}}  # options of methods that are chosen
RTOL = 1e-9  # of an adaptive method that is chosen


def choose_method(
    system: HamiltonianSystem,
    y0: Array,
    options: dict[str, Any],
    tol: float | None = None,
    plain: bool = True,
    flows: bool = True,
) -> tuple[Integrator, str]:
    """Return the method that suits a system, and the reason in words."""
    refused: Exception | None = None
    between = system.between_impulses
    for name, reason in _candidates(between, y0, options, tol, plain, flows):
        try:
            given = {**CHOSEN_WITH.get(name, {}), **options}
            if name == "dop853" and readable(y0) and not {"rtol", "atol"} & {*options}:
                given |= {"rtol": RTOL, "atol": 1e-3 * RTOL * smallest_size(between, to_numpy(y0))}
            integrator = build(name, given if name != "sympflow" or tol is None else {**given, "tol": tol})
            check_applies(integrator, between, y0)
        except (ValueError, TypeError) as error:
            refused = refused or error
            continue
        return integrator, reason
    raise refused or ValueError(f"`system` {system.name!r} has no method that applies: pass `method`.")


def _candidates(
    system: HamiltonianSystem, y0: Array, options: dict[str, Any], tol: float | None, plain: bool, flows: bool
) -> Iterator[Candidate]:
    if "rtol" in options or "atol" in options:
        yield "dop853", "`rtol` and `atol` are given"
        return
    if system.local is not None and system.local.frame is not None and system.local.frame.crossing() is None:
        yield "wisdom_holman", "planets move about a star"
    if flows and "dt" not in options and _flow_holds(system, y0, tol):
        yield "sympflow", "a trained flow ships for this system, and y0 is in its domain"
    place, steep = "", False
    if plain and y0.dtype == np.float64 and system.separable and system.keeps_energy:
        place, steep = _attractive_pole(system, y0.reshape(-1, y0.shape[-1])[:MOST_STATES].tobytes())
    if place and (steep or tol is None):
        name = "log_kahan_li8" if steep else "dop853"
        yield name, f"V falls without bound at {place}, where its steps become shorter"
    if system.separable and system.quadratic_kinetic:
        yield "srkn11b", "the kinetic energy is ½ pᵀM⁻¹p"
    if system.separable:
        yield "kahan_li8", "H is separable"
    if system.ndof > MOST_DENSE:
        yield "kahan_li6_parts", "H is a sum of parts that are solved exactly"
    yield "gauss_legendre6", "H is not separable" if not system.separable else "an implicit method applies"
    yield "dop853", "no symplectic method applies"


def _flow_holds(system: HamiltonianSystem, y0: Array, tol: float | None) -> bool:
    """True if a flow ships for the system, meets `tol`, and has all of y0 in its domain."""
    from sympflow.flow.shipped import choose, shipped_flows

    if not len(shipped_flows(system, "sympflow")) or not readable(y0):
        return False
    try:
        flow = choose(system, "sympflow", tol).known(system)
    except ValueError:
        return False
    domain = flow.domain_for(system)
    return domain is None or bool(np.all(np.asarray(domain.contains(y0))))


@lately_kept
def _attractive_pole(system: HamiltonianSystem, states: bytes) -> tuple[str, bool]:
    """A place towards which V falls without bound from all positions, in words; True if like a power where V < 0."""
    if not system.definition.poles or (system.local is not None and system.written is None):
        return "", False
    q = np.frombuffer(states).reshape(-1, 2 * system.ndof)[:, : system.ndof]
    scales = np.array([100.0, 10.0, 1.0, *NEAR_POLE])[:, None, None]
    for name, center in _centers(system, q):
        with np.errstate(all="ignore"):
            V = np.asarray(system.potential(center + scales * (q - center)))
            falls = -np.diff(V[2:], axis=0)
        if np.isfinite(V).all() and (falls > 0).all() and (falls[1:] > LOGARITHMIC * falls[:-1]).all():
            return name, bool((V < 0).all() and (np.diff(V, axis=0) < 0).all() and (V[-1] < 100 * V[2]).all())
    return "", False


def _centers(system: HamiltonianSystem, q: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Names and positions (n, d) of the zeros that are next to positions q of what vanishes where H is infinite."""
    yield "q = 0" if system.local is None else "r = 0", np.zeros_like(q)
    poles, d = system.definition.poles and system.definition.poles.exact, system.ndof
    if poles is None:
        return

    def sizes(x: np.ndarray) -> np.ndarray:
        return poles.sizes(np.concatenate([x, 0 * x], axis=-1), np.zeros(x.shape[:-1]))

    small = 1e-6 * np.abs(q).max(initial=0.0) * np.eye(d)
    for column in range(min(sizes(q).shape[-1], MOST_CENTERS) if small.any() and d <= MOST_CENTERS else 0):
        x = q
        with np.errstate(all="ignore"):
            for _ in range(NEWTON_STEPS):  # for a double zero, as that of r²
                g = sizes(x)[..., column, None]
                ends = [sizes(x[:, None] + sign * small)[..., column] for sign in (1, -1)]
                slope = (ends[0] - ends[1]) / (2 * small.max())
                x = x - np.where(g == 0, 0.0, 2 * g * slope / (slope**2).sum(-1, keepdims=True))
        if np.isfinite(x).all():
            yield poles.name(column), x


def integrator_for(
    system: HamiltonianSystem,
    method: Any,
    options: Mapping[str, Any],
    t_span: tuple[float, float],
    y0: np.ndarray,
    flows: bool = True,
) -> Integrator:
    """The integrator of functions that follow orbits: a method with its options, else the one that suits the system.

    Its steps are equal in t. With `tol` among the options it is chosen, or has the step, for that energy error.
    """
    given = dict(options)
    tol = given.pop("tol", None)
    if tol is not None:
        check_tolerance(tol, "energy")
    if method is None:
        integrator, _ = choose_method(system, y0, given, tol, False, flows)
    else:
        takes_tol = isinstance(method, str) and "tol" in get(method).options()
        integrator = build(method, dict(options) if takes_tol else given)
    if tol is not None and "tol" not in integrator.options():
        problem = Problem(system, *t_span, y0)
        return replace(integrator, dt=step_for(integrator, problem, tol)[0])  # type: ignore[type-var]
    return with_step(integrator, system, y0)


def with_start(integrator: Integrator, system: HamiltonianSystem, y0: Array) -> HamiltonianSystem:
    """The system; where it has no initial state, and the method takes a scale from that, with one of the states y0."""
    if system.y0 is not None or not (integrator.in_another_time or integrator.keeps) or not readable(y0):
        return system
    return started(system, to_numpy(y0))


def with_step(integrator: Integrator, system: HamiltonianSystem, y0: np.ndarray) -> Integrator:
    """The integrator, with a step chosen at the states y0 where neither it nor the system has one."""
    if not (system.step_is_open and isinstance(integrator, FixedStep)) or integrator.trained or integrator.dt:
        return integrator
    return replace(integrator, dt=default_step(system, y0))


def choose_step(
    system: GivenSystem,
    method: Any,
    tol: float,
    *,
    y0: Any = None,
    t_span: tuple[float, float] | None = None,
    tol_of: str = "energy",
) -> float:
    """Return the longest step, within a factor of about two, for which a fixed-step method meets a tolerance.

    It is found by a few short runs from the given states: of 4096 steps and at least 400 times `system.dt`, or of the
    whole of `t_span` where that is shorter.

    Parameters
    ----------
    system : HamiltonianSystem
    method : str or Integrator, or None
        A method of fixed steps, such as "srkn11b"; None for the one that suits the system, as for `solve`.
    tol : float
        The largest error: |H − H₀| relative to the `energy_scale` of `sympflow.metrics.energy`. Where H is not
        conserved, with friction or a drive, the error of the balance of energy and work takes its place: the sum of
        the differences of H from short runs with half of the step, each from a state of the run. Where H is conserved
        for every step, as by Gauss methods on a quadratic H, for the methods on the logarithmic clock, and for a driven
        H that jumps in t, the error is that of the states.
    y0 : array_like of shape (..., 2d), optional
        Initial states, by default the system's.
    t_span : (float, float), optional
        By default the system's.
    tol_of : {"energy", "state"}
        With "state" the error is the difference of states from those of a run with half of the step, relative to their
        size, q and p in comparable units.

    Returns
    -------
    float

    Raises
    ------
    ValueError, TypeError
        If an argument is wrong, the method has no fixed steps, or `tol` is below what rounding allows.

    Examples
    --------
    >>> dt = sympflow.choose_step(sympflow.systems.henon_heiles(), "srkn11b", 1e-9)
    """
    system = given_system(system)
    y = check_y0(system, system.y0 if y0 is None else to_numpy(y0), None)
    integrator = build(method, {}) if method is not None else choose_method(system, y, {}, flows=False)[0]
    t0, t1 = check_t_span(system.t_span if t_span is None else t_span, False)
    return step_for(integrator, Problem(system, t0, t1, y), tol, tol_of)[0]


def check_tolerance(tol: Any, tol_of: Any) -> None:
    """Refuse anything but a tolerance."""
    if not 0 < as_float(tol) < 1:
        raise ValueError(f"`tol` must be a positive number below 1, a relative error; got {tol!r}: take 1e-6.")
    if tol_of not in ("energy", "state"):
        raise ValueError(f"`tol_of` must be 'energy' or 'state'; got {tol_of!r}.")


def step_for(integrator: Integrator, problem: Problem, tol: float, tol_of: str = "energy") -> tuple[float, str]:
    """The step of `choose_step` for a problem, and the kind of its error: "energy" or "state"."""
    check_tolerance(tol, tol_of)
    if not isinstance(integrator, FixedStep) or integrator.trained:
        own = "a flow has its own: leave `tol` out"
        if not integrator.trained:
            own = f"{integrator.label!r} chooses its own: give it `rtol` and `atol`, as rtol={tol:g} and atol={tol:g}"
        raise TypeError(f"`tol` chooses the step of a method with fixed steps, such as 'srkn11b', and {own}.")
    if integrator.dt is not None:
        raise ValueError(f"`tol` chooses the step, but `dt` is given, {integrator.dt:g}: leave out one of them.")
    if tol < FINEST_SINGLE and problem.y0.dtype.itemsize < 8:
        raise ValueError(f"`tol` {tol:g} is below the rounding of single precision: compute in float64, or raise it.")
    states = to_numpy(problem.y0).astype(float)
    if states.ndim > 1:
        states = states.reshape(-1, states.shape[-1])[:MOST_STATES]
    system = with_start(integrator, problem.system.between_impulses, states)
    length = abs(problem.t1 - problem.t0)
    step = float(with_step(integrator, system, states).step_length(system) or system.dt)
    trial = replace(problem, system=system, y0=states, events=None)
    uneven = system.definition.may_jump and not system.keeps_energy  # no energy is compared across jumps
    if uneven or system.keeps_energy is not system.shows_energy or integrator.in_another_time:
        tol_of = "state"  # on a clock H is kept where time is wrong
    error = _error(integrator, trial, tol_of, TRIAL_LENGTH * step)
    check_applies(integrator, system, states)
    most = min(length, integrator.longest_step(system), system.definition.shortest_piece)
    h = min(step, most)
    good, bad, least = 0.0, math.inf, math.inf
    kept = math.inf  # the shortest step with which H is kept to rounding
    for _ in range(TRIALS):
        e = error(h)
        if tol_of == "energy" and e <= KEPT:
            if h > kept and h >= min(32 * kept, most):  # as by Gauss methods where H is quadratic
                return step_for(integrator, problem, tol, "state")
            kept = min(kept, h)
        if e > tol and h < bad and least <= e <= AT_ROUNDING:
            break
        least = min(least, e)
        if e <= MOST * tol:
            good = max(good, h)
            if e >= ENOUGH * tol or h >= most:
                break
        else:
            bad = min(bad, h)
        factor = (SAFETY * tol / e) ** (1 / (integrator.order or 2)) if 0 < e < math.inf else 4.0 if e == 0 else 0.25
        following = h * min(max(factor, 1 / 16), 8.0)
        if good and following >= bad:
            following = math.sqrt(good * bad)
        if good and (following <= 1.1 * good or bad <= 1.2 * good):
            break
        h = min(following, most)
    if not good:
        limit = "near rounding" if least <= AT_ROUNDING else f"with steps down to {min(bad, h):.2g}"
        raise ValueError(
            f"`tol` {tol:g} is not met by method {integrator.label!r}: the smallest error of the trial runs is "
            f"{least:.1e}, {limit}. Raise it, or pass `dt`."
        )
    return _rounded(good, length), tol_of


def _rounded(h: float, length: float) -> float:
    """A step at most h, to three digits, or one that ends the run exactly where that has few steps."""
    if length / h < 100:
        return length / math.ceil(length / h * (1 - 1e-12))
    digits = 2 - math.floor(math.log10(h))
    return math.floor(h * 10.0**digits * (1 + 1e-12)) / 10.0**digits


def _error(integrator: FixedStep, problem: Problem, tol_of: str, trial: float) -> Callable[[float], float]:
    """The error of a trial run over a time, as a function of the step."""
    system, y0 = problem.system, problem.y0
    sign, length = math.copysign(1.0, problem.t1 - problem.t0), abs(problem.t1 - problem.t0)
    compiled, of_states = False, tol_of == "state"

    def run(h: float, t: np.ndarray, start: np.ndarray) -> np.ndarray:
        """The states at times t, by steps h from the first one."""
        with np.errstate(all="ignore"):
            stepped = replace(integrator, dt=h)
            piece = replace(problem, t0=float(t[0]), y0=start, t1=float(t[-1]), t_eval=t, diagnosed=False)
            _, jumps = landings(stepped, system, piece.t0, piece.t1)
            outcome = run_in_pieces(lambda *given: (given[0].run(given[1]), given[1]), stepped, piece, jumps)[0]
        nonlocal compiled
        compiled = outcome.stats.get("backend") == "compiled"
        full = np.full((len(t), *y0.shape), np.nan)
        full[: len(outcome.y)] = outcome.y
        return full

    def error(h: float) -> float:
        n = max(TRIAL_STEPS, min(math.ceil(trial / h), MOST_TRIAL_STEPS) if compiled else 0)
        n = max(1, math.ceil(min(n, length / h)))
        end, n = min(n * h, length), -(-n // -(-n // TRIAL_STEPS))
        t = problem.t0 + sign * np.linspace(0.0, end, n + 1)
        y = run(h, t, y0)
        times = np.broadcast_to(t.reshape(-1, *[1] * (y0.ndim - 1)), y.shape[:-1])
        few = slice(None, None, -(-n // LOOKED_AT))  # with the start
        with np.errstate(all="ignore"):
            H = np.asarray(system.hamiltonian(y, times))
            scale = known_scale(system, H[few], size_of_terms(system, y[few], times[few]))
            scale = np.where(np.isnan(scale), 1.0, scale)
            if of_states:
                found = state_error(system, y0, y - run(h / 2, t, y0))
            elif system.keeps_energy:
                found = np.abs(H - H[0]) / scale
            elif not np.isfinite(H).all():
                return math.inf
            else:
                off = np.zeros(H.shape)
                bounds = np.linspace(0, n, min(BALANCED, n) + 1).astype(int)
                for first, last in itertools.pairwise(bounds):
                    part = slice(first, last + 1)
                    fine = np.asarray(system.hamiltonian(run(h / 2, t[part], y[first]), times[part]))
                    off[part] = off[first] + H[part] - fine
                found = np.abs(off) / scale
        worst = float(np.max(found))
        return worst if math.isfinite(worst) else math.inf

    return error


def state_error(system: HamiltonianSystem, y0: np.ndarray, change: np.ndarray) -> np.ndarray:
    """The size of differences (..., 2d) of states relative to that of the states y0, q and p in comparable units."""
    factors = weights(system)
    return np.abs(factors * change).max(-1) / (factors.max() * smallest_size(system, y0))
