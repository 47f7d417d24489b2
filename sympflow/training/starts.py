"""The default primed flow, and checks of domains and steps that are not suitable."""

from __future__ import annotations

import math

import numpy as np
from scipy.integrate import DOP853

from sympflow.arguments import warn
from sympflow.flow.scaling import Scaling
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.training.fits import PrimedFit
from sympflow.training.points import Stream, box_without, start_times, states
from sympflow.training.table_step import forces_of

SCALING_SAMPLES = 4096
SAMPLES, SEED = 1000, 0
QUANTILE = 0.99
PHASE = 1.0  # ω Δt of the default flow: energy errors of 1e-8 to 1e-5, where its gain in time is the largest
KICK_PHASE = 0.25  # ω Δt for each kick of the kernel
MOST_STAGES = 24
MOST_PERIODS = 30  # of most states, that Δt may hold
FASTER, SEVERAL_SAMPLES = 20.0, 400  # times the rate at half of so many states, beyond which a domain is too large
NARROWED = 10  # times at most
ORBITS, ORBIT_STEPS, ORBIT_TOLERANCE = 12, 150, 1e-5  # by which is seen where orbits of a part of the domain come
CROSSINGS = 4.0  # of the domain, by such an orbit
ENERGIES = (0.9, 0.75, 0.5)  # shares of the states, with less energy than the others
DENSE = 16  # degrees of freedom up to which eigenvalues of ∇²V are taken
ITERATIONS, FEWER_SAMPLES = 40, 100  # of the power method, beyond them


def default_primed(
    system: HamiltonianSystem, domain: Domain | None = None, dt: float | None = None, phase: float = PHASE
) -> PrimedFit:
    """Three kicks and a processor of six, with ω Δt about 1; for a given Δt as many kicks as it needs."""
    omega = frequency(system, system.domain if domain is None else domain)
    if dt is None:
        return PrimedFit(_rounded(phase / omega), stages=3, processor=6)
    stages = min(max(2, math.ceil(omega * dt / KICK_PHASE - 1e-9)), MOST_STAGES)
    return PrimedFit(float(dt), stages=stages, processor=6)


@np.errstate(all="ignore")  # of states at which H is not defined
def frequency(system: HamiltonianSystem, domain: Domain | None) -> float:
    """The fastest linearized frequency that 99 % of the states of the domain stay below, and at least the drive's."""
    if domain is None:
        raise ValueError(f"`domain` is not known for the system {system.name!r}: pass one.")
    d, large = system.ndof, system.ndof > DENSE and system.quadratic_kinetic
    y = domain.sample(FEWER_SAMPLES if large else SAMPLES, SEED)
    q, p = y[:, :d], y[:, d:]
    t = start_times(system, 0.0, len(y), SEED, Stream.SCALING)
    if large:
        squares = _largest_eigenvalues(system, q, t)
    else:
        squares = np.linalg.eigvals(system.kinetic_hessian(p) @ potential_hessian(system, q, t)).real.max(-1)
    squares = squares[np.isfinite(squares)]
    omega = math.sqrt(max(float(np.quantile(squares, QUANTILE)), 0.0)) if len(squares) else 0.0
    if system.period is not None:
        omega = max(omega, 2 * math.pi / system.period)
    if omega == 0.0:  # nowhere bound: what a state needs to cross the domain
        speed = np.linalg.norm(system.velocity(p), axis=-1)
        omega = float(np.quantile(speed, QUANTILE) / max(float(q.std(0).max()), np.finfo(float).tiny)) or 1.0
    return omega


def potential_hessian(system: HamiltonianSystem, q: np.ndarray, t: np.ndarray | None = None) -> np.ndarray:
    """∇²V (n, d, d), of a driven system at times t (n,), from differences of ∇V where it is not known."""
    if system.has_hessian_vector:
        return system.potential_hessian(q, t)
    d, x = system.ndof, _with_times(q, t).T
    basis = np.broadcast_to(np.eye(len(x))[..., None], (len(x), *x.shape))
    return np.moveaxis(-forces_of(system, 0).along(x, basis)[1][0][:d, :d], -1, 0)


def _with_times(q: np.ndarray, t: np.ndarray | None) -> np.ndarray:
    """Positions (n, d) as `forces_of` takes them, with t and s of a driven system."""
    return q if t is None else np.concatenate([q, t[:, None], 0 * t[:, None]], axis=1)


def _largest_eigenvalues(system: HamiltonianSystem, q: np.ndarray, t: np.ndarray | None = None) -> np.ndarray:
    """The eigenvalue of M⁻¹∇²V of largest size, by the power method: (n, d) to (n,)."""
    forces, d = forces_of(system, 0), system.ndof
    v = np.random.default_rng(SEED).standard_normal(q.shape)
    size, still = np.ones(len(q)), None if t is None else 0 * t
    with np.errstate(all="ignore"):
        for _ in range(ITERATIONS):
            along = _with_times(v / size[:, None], still)
            v = system.velocity(-forces.along(_with_times(q, t).T, along.T[None])[1][0][0, :d].T)
            size = np.linalg.norm(v, axis=-1)
    return size


def check_step(system: HamiltonianSystem, domain: Domain, dt: float) -> None:
    """Raise ValueError where Δt is far beyond the periods of the system, or what changes it, at half of the states."""
    rates = _rates(system, domain.sample(FEWER_SAMPLES, SEED))
    rates = rates[np.isfinite(rates)]
    rate = float(np.median(rates)) if len(rates) else 0.0
    periods = rate * dt / (2 * math.pi)
    if periods > MOST_PERIODS:
        raise ValueError(
            f"`dt` = {dt:g} is far beyond the periods of the system {system.name!r}, {periods:.2g} of them at half of "
            f"the states of `domain`: no flow takes that in one step. Leave `dt` out, or take "
            f"dt={_rounded(PHASE / rate)}."
        )


def step_of(rates: np.ndarray) -> float:
    """Δt such that the fastest rate of the linearized motion, at 99 % of states, times it is about 1."""
    rates = rates[np.isfinite(rates)]
    rate = float(np.quantile(rates, QUANTILE)) if len(rates) else 0.0
    return _rounded(PHASE / rate) if rate > 0 else 1.0


@np.errstate(all="ignore")
def _rates(system: HamiltonianSystem, y: np.ndarray) -> np.ndarray:
    """The fastest rate of the linearized motion at each of the states (n, 2d): (n,), NaN where it is not finite."""
    d, t = system.ndof, start_times(system, 0.0, len(y), SEED, Stream.SCALING)
    if system.separable and system.quadratic_kinetic and d > DENSE:
        return np.sqrt(_largest_eigenvalues(system, y[:, :d], t))
    if system.separable:
        squares = system.kinetic_hessian(y[:, d:], t) @ potential_hessian(system, y[:, :d], t)
        return np.sqrt(_sizes(squares))
    second = system.hessian(y, t)
    return _sizes(np.concatenate([second[:, d:], -second[:, :d]], axis=1))


def warn_of_domain(system: HamiltonianSystem, domain: Domain) -> None:
    """Warn of a domain where H is not defined in part of it, or the motion far faster than at half of its states."""
    y = domain.sample(SEVERAL_SAMPLES, SEED)
    with np.errstate(all="ignore"):
        defined = np.isfinite(system.hamiltonian(y, start_times(system, 0.0, len(y), SEED, Stream.SCALING)))
    if not defined.all():
        corners = box_without(y[defined], y[~defined])
        remedy = "Shrink `domain`." if corners is None else f"Take Box({corners[0]}, {corners[1]}), without them."
        warn(
            f"H of the system {system.name!r} is not finite at {(~defined).sum()} of {len(y)} states of `domain`, "
            f"where a flow means nothing. {remedy}"
        )
        y = y[defined]
        if not len(y):
            return
    rates = _rates(system, y)
    known = rates[np.isfinite(rates)]
    if not len(known) or not np.quantile(known, QUANTILE) > FASTER * np.median(known) > 0:
        return
    every, rate_of = y, rates
    low, high = y.min(0).tolist(), y.max(0).tolist()
    for _ in range(NARROWED):
        slow = rates <= 0.5 * FASTER * np.median(rates[np.isfinite(rates)])
        box = box_without(y[slow], y[~slow])
        if box is None:
            break
        low, high = box
        inside = ((y >= low) & (y <= high)).all(1)
        y, rates = y[inside], rates[inside]
    q, half = np.quantile(known, QUANTILE), np.median(known)
    words = f"`domain` has states at which the motion is {q / half:.1e} times faster than at half of them, and "
    met = _fastest_met(system, y[np.isfinite(rates)])
    if np.median(met) > 0.5 * FASTER * half:
        words += (
            f"orbits that begin elsewhere come there, as to a wall, so that no smaller box holds them. The Δt of a "
            f"flow suits these states, about {PHASE / q:.1e}{_less_energy(system, every, rate_of)}."
        )
    else:
        words += (
            f"the Δt of a flow for all of it suits these, about {PHASE / q:.1e}, where most others could have "
            f"{PHASE / half:.1e}. Without them the domain is about Box({low}, {high}): take that, or a smaller one "
            "that holds your orbits, or give `dt`."
        )
    warn(words)


@np.errstate(all="ignore")
def _fastest_met(system: HamiltonianSystem, y: np.ndarray) -> np.ndarray:
    """The fastest rate that the orbits of a few of the states meet while they cross these several times."""
    y, d = y[:: max(1, len(y) // ORBITS)][:ORBITS], system.ndof
    speeds = np.abs(system.vector_field(y, np.zeros(len(y)))[:, :d])
    span = CROSSINGS * float(np.max(np.ptp(y[:, :d], axis=0) / np.maximum(np.median(speeds, axis=0), 1e-300)))

    def slope(t: float, x: np.ndarray) -> np.ndarray:
        return np.asarray(system.vector_field(x, t))

    met = []
    for start in y:
        orbit = DOP853(slope, 0.0, start, span, rtol=ORBIT_TOLERANCE, atol=ORBIT_TOLERANCE)
        passed = [start]
        while orbit.status == "running" and len(passed) < ORBIT_STEPS:
            orbit.step()
            passed.append(orbit.y)
        rates = _rates(system, np.array(passed))
        met.append(np.max(rates[np.isfinite(rates)], initial=0.0))
    return np.array(met)


@np.errstate(all="ignore")
def _less_energy(system: HamiltonianSystem, y: np.ndarray, rates: np.ndarray) -> str:
    """A sublevel of the energy where the motion is half as fast or less, in words that go on; none if there is none."""
    t = start_times(system, 0.0, len(y), SEED, Stream.SCALING)
    energies = system.hamiltonian(y, t)
    fastest = np.quantile(rates[np.isfinite(rates)], QUANTILE)
    for share in ENERGIES if t is None else ():
        below = energies <= np.quantile(energies, share)
        if 2 * (rate := np.quantile(rates[below & np.isfinite(rates)], QUANTILE)) <= fastest:
            low, high = ([float(f"{v:.2g}") for v in corner] for corner in (y[below].min(0), y[below].max(0)))
            return (
                f"; with less energy it is longer: {PHASE / rate:.1e} in EnergySublevel("
                f"{energies[below].max():.3g}, Box({low}, {high}))"
            )
    return ""


def _sizes(matrices: np.ndarray) -> np.ndarray:
    """The largest size of an eigenvalue of each of n matrices, NaN where it is not finite."""
    finite = np.isfinite(matrices).all((-1, -2))
    sizes = np.abs(np.linalg.eigvals(np.where(finite[:, None, None], matrices, 0.0))).max(-1)
    return np.where(finite, sizes, np.nan)


def _rounded(dt: float) -> float:
    """The largest of 1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6 and 8 times a power of ten that is no longer, to 2 %."""
    unit = 10.0 ** math.floor(math.log10(dt * 1.02))
    return float(f"{max(m for m in (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8) if m * unit <= dt * 1.02) * unit:.3g}")


def scaling_of(domain: Domain, dt: float, seed: int) -> Scaling:
    """The units of x and t, from samples of the domain."""
    x = states(domain, SCALING_SAMPLES, seed, Stream.SCALING)
    if not np.abs(x).max() < math.sqrt(np.finfo(float).max) / SCALING_SAMPLES:
        raise ValueError(f"`domain` has states as large as {np.abs(x).max():.1e}, whose squares overflow: shrink it.")
    return Scaling.of_samples(x, dt)
