"""The fit of one model to trajectories, from short segments to whole orbits, and its held-out errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sympflow.arguments import floats
from sympflow.learning.lagrangian import lagrangian_start
from sympflow.learning.models import Model
from sympflow.learning.orbits import Field, Method, first_states, steppers
from sympflow.learning.reading import Run
from sympflow.learning.shooting import FINEST, Fit, Problem, chosen_method, matched, minimized, rho
from sympflow.learning.trajectories import Trajectories
from sympflow.training.least_squares import Stop, never

FIRST_POINTS = 10  # of the pieces that a fit begins with
MATCHED_POINTS = 24  # of those whose increments give its start
MATCHED_STEPS = 60
ROUNDS = 4  # of longer pieces, or of another noise
HALVINGS, FIRST_HALVINGS = 12, 6  # of the widest gap between points, at most; a start that needs more is a poor one
SETTLED = 0.05  # change of the noise, relative, that ends them
GROWTH = 1e3  # most that an error of an initial state may grow along a piece
LEAST_GROWTH = 10.0
PER_NOISE = 0.3  # of the spread of the data, that such an error may reach
HOPELESS = 1.5  # noise over that of the best model, from which a model is given up
COARSE, FINE = 1e-2, 1e-4  # gain of three steps at which a fit ends: the first or a poor one, and others
STEPS, OWN_STEPS = 50, 100  # most of a fit of an H, and of a map of its own, whose valleys are longer
STEP_ERROR = 0.1  # of the noise, to which the scheme's steps may change an orbit
EXACT = 1e-9  # residuals, relative to the spread of the data, that need no explanation
LOUDER = 2.0  # root mean square of held-out residuals, in σ, above which there are too few data, or another system
SILENT = 0.5  # of the spread of the data, that noise leaves at most where a model explains anything
HUBER = 1.5  # σ
LOSSES = {"squares": None, "huber": HUBER}
CORRELATED = 0.1  # correlation of one residual with the next that chance is allowed to make, beside 3/√n
LAG = 0.6  # of the time in which states move by their spread, after which noise of smoothed data is another
SMOOTHED = 0.5  # correlation of neighbours from which the noise is that of data that were smoothed
FORGOTTEN = 0.25  # correlation with residuals a lag later, up to which they are such noise
FEWEST_PAIRS = 30  # of residuals that count as independent, to tell such noise from what a model leaves


def limit_of(loss: str) -> float | None:
    """The size of residuals, in σ, above which the loss is not quadratic; None if there is none."""
    if loss not in LOSSES:
        raise ValueError(f"`loss` must be one of {', '.join(LOSSES)}; got {loss!r}.")
    return LOSSES[loss]


def noise_of(noise: Any, ndof: int) -> np.ndarray | None:
    """σ of each coordinate (2d,) as it was given; None if it was not."""
    if noise is None:
        return None
    sigma = floats("noise", noise)
    if sigma.shape not in ((), (2 * ndof,)) or not ((sigma >= 0) & (sigma < np.inf)).all():
        raise ValueError(
            f"`noise` must be a standard deviation, 0 or more, or one for each of the {2 * ndof} coordinates; got "
            f"{noise!r}: leave it out where it is not known."
        )
    return np.broadcast_to(sigma, 2 * ndof).astype(float)


@dataclass(frozen=True)
class Setting:
    """How a model is fitted."""

    noise: np.ndarray | None = None  # (2d,): σ of each coordinate; None for estimated
    huber: float | None = None  # Residuals of more than so many σ count by their size
    stop: Stop = never  # Asked between steps
    seen: np.ndarray | None = None  # (2d,): The noise as it is seen without a model, at most: 0 where it is not
    # The time after which residuals are compared, if points are closer: what a model leaves is there still, while the
    # noise of data that were smoothed is another
    lag: float = 0.0
    # (2d,): The noise that the best model so far leaves of whole orbits: one that leaves much more of a few points is
    # given up
    rival: np.ndarray | None = None

    def plausible(self, noise: np.ndarray) -> bool:
        """True unless a model leaves so much (2d,) that it is rejected whatever its last digits are."""
        if self.seen is None or not (self.seen > 0).any():
            return True
        return bool((noise < LOUDER * self.seen)[self.seen > 0].all())

    def hopeless(self, noise: np.ndarray) -> bool:
        """True if a model that leaves this noise (2d,) of a few points is not worth longer orbits."""
        return self.rival is not None and float(np.mean(np.log(noise / self.rival))) > math.log(HOPELESS)

    def turned(self, rows: Sequence[int]) -> Setting:
        """The same for coordinates in another order."""
        noise, seen = (None if sigma is None else sigma[[*rows]] for sigma in (self.noise, self.seen))
        return replace(self, noise=noise, seen=seen, rival=None)


@dataclass(frozen=True)
class Fitted:
    """A model with its numbers."""

    model: Field
    theta: np.ndarray
    sigma: np.ndarray  # (2d,): The noise, by the residuals or as it was given
    fit: Fit  # Of whole trajectories, or of pieces no longer than `span`; of a few points if that is 0
    span: float
    costs: list[float]  # χ² over the number of values after each step

    @property
    def method(self) -> Method:
        return self.fit.problem.method

    def loss(self, sigma: np.ndarray) -> float:
        """Minus the log-likelihood of what it was fitted to, but for a constant, for noise σ (2d,)."""
        r = np.concatenate(self.fit.residuals, axis=1)
        return float(0.5 * np.nansum(rho(r / sigma[:, None], self.fit.problem.huber)))

    @property
    def states(self) -> np.ndarray:
        """States of all orbits, (n, 2d)."""
        return np.concatenate(self.fit.orbits, axis=1).T


def fitted(
    model: Field, data: Trajectories, setting: Setting, theta: np.ndarray | None = None, seed: int = 0
) -> Fitted:
    """Fit a model from θ: to increments, to orbits of a few points, to orbits as long as their errors stay small."""
    scales = data.scales
    if theta is None:
        theta, moved = model.start(np.random.default_rng(seed)), data
        if model.lagrangian or model.velocities:
            assert isinstance(model, Model)
            theta, moved = lagrangian_start(model, data, theta)
        if model.stepper is None:
            steps = 1 if model.linear else MATCHED_STEPS
            theta = matched(model, theta, moved.pieces(MATCHED_POINTS), 1 / moved.scales, steps, setting.stop)
    given = None if setting.noise is None else np.maximum(setting.noise, FINEST * scales)
    sigma = 1e-2 * scales if given is None else given
    span = 0.0 if model.stepper is None else model.stepper.longest  # a map of its own is fitted over all of a step
    pieces = _pieces(data, span)
    states = first_states(pieces, model, theta)
    costs: list[float] = []
    made, finer = None, 1.0
    for attempt in range(1 + ROUNDS):
        reached = span
        tolerance = np.clip(0.02 * finer * sigma, 1e-12 * scales, 1e-4 * scales)
        halvings = HALVINGS if attempt else FIRST_HALVINGS
        method = chosen_method(model, theta, pieces, tolerance, halvings, setting.stop)
        problem = Problem(model, pieces, method, sigma, huber=setting.huber)
        gain = FINE if attempt and setting.plausible(sigma) else COARSE
        fit = minimized(problem, theta, states, iterations=_most(model), gain=gain, stop=setting.stop)
        if made is not None and setting.stop() and not math.isfinite(fit.cost):
            return made
        theta, before = fit.theta, sigma
        costs += [cost / data.n_values for cost in fit.costs]
        if given is None:
            sigma = np.maximum(fit.noise(), FINEST * scales)
        made = Fitted(model, theta, sigma, fit, reached, costs)
        if not math.isfinite(fit.cost) or setting.stop() or setting.hopeless(np.maximum(fit.noise(), FINEST * scales)):
            break
        orbits = np.concatenate(fit.orbits, axis=1)
        coarse = fit.step_error(np.maximum(sigma, EXACT * scales)) > STEP_ERROR
        finer = finer / 10 if coarse else finer
        spread = orbits.std(axis=1) if model.velocities else scales
        longer = _span(made, data, orbits[:, data.begins].T, spread)
        settled = np.allclose(sigma, before, rtol=SETTLED, atol=EXACT * scales.min())
        if longer <= 1.5 * span and settled and not coarse:
            break
        if longer > 1.5 * span:
            span, pieces = longer, _pieces(data, longer)
        states = orbits[:, pieces.begins].T
    assert made is not None
    return made


def refitted(found: Fitted, data: Trajectories, setting: Setting, longer: bool = False) -> Fitted:
    """The fit of the same model to other trajectories, by the same scheme: along pieces as long, or longer ones."""
    scales, span = data.scales, found.span
    sigma = np.maximum(found.sigma, FINEST * scales)
    if longer and span:
        starts = _states(found, data, data, sigma, setting)
        span = max(span, _span(found, data, starts, found.states.std(axis=0) if found.model.velocities else scales))
    pieces = _pieces(data, span)
    problem = Problem(found.model, pieces, found.method, sigma, huber=setting.huber)
    states = _states(found, data, pieces, sigma, setting)
    most = _most(found.model)
    fit = minimized(problem, found.theta, states, iterations=most, gain=FINE, patience=1, stop=setting.stop)
    sigma = sigma if setting.noise is not None else np.maximum(fit.noise(), FINEST * scales)
    return Fitted(found.model, fit.theta, sigma, fit, span, [cost / data.n_values for cost in fit.costs])


def _pieces(data: Trajectories, span: float) -> Trajectories:
    """Pieces of trajectories no longer than a time, of a few points if it is 0."""
    return data.pieces(span=span) if span else data.pieces(FIRST_POINTS)


def _most(model: Field) -> int:
    """The most steps of a fit."""
    return STEPS if model.stepper is None else OWN_STEPS


def kept(found: Fitted) -> dict[str, Any]:
    """The numbers of a fit, from which `restored` makes it again."""
    method = found.method
    place = steppers(found.model).index(method.stepper)
    numbers = {"theta": found.theta, "sigma": found.sigma, "of": found.fit.problem.sigma, "states": found.fit.states}
    return {**numbers, "span": found.span, "costs": found.costs, "stepper": place, "longest": method.longest}


def restored(model: Field, data: Trajectories, numbers: dict[str, Any], setting: Setting) -> Fitted:
    """The fit with these numbers, without another minimization."""
    method = Method(steppers(model)[numbers["stepper"]], numbers["longest"])
    theta, sigma, of, states = (np.asarray(numbers[name]) for name in ("theta", "sigma", "of", "states"))
    span = float(numbers["span"])
    pieces = _pieces(data, span)
    problem = Problem(model, pieces, method, of, huber=setting.huber)
    fit = minimized(problem, theta, states, iterations=0)
    return Fitted(model, theta, sigma, fit, span, list(numbers["costs"]))


def _states(found: Fitted, data: Trajectories, pieces: Trajectories, sigma: np.ndarray, setting: Setting) -> np.ndarray:
    """The initial states (N, 2d) of pieces, by a few points each: the first observation alone leads far astray."""
    few = data.pieces(FIRST_POINTS)
    short = Problem(found.model, few, found.method, sigma, frozen=True, huber=setting.huber)
    starts = first_states(few, found.model, found.theta)
    orbits = minimized(short, found.theta, starts, iterations=20, patience=1, stop=setting.stop).orbits
    return np.concatenate(orbits, axis=1)[:, pieces.begins].T


def _span(found: Fitted, data: Trajectories, states: np.ndarray, spread: np.ndarray) -> float:
    """The longest time over which orbits are followed: whole trajectories, unless their errors grow too fast."""
    limit = float(np.clip(PER_NOISE * np.min(data.scales / found.sigma), LEAST_GROWTH, GROWTH))
    frozen = Problem(found.model, data, found.method, found.sigma, frozen=True)
    times = frozen.growth(found.theta, states, spread, limit)
    soonest = float(np.quantile(times, 0.1, method="lower"))
    return soonest if math.isfinite(soonest) else max(run.span for run in data.runs)


@dataclass(frozen=True)
class Held:
    """How well a model explains trajectories that it was not fitted to; only their initial states are fitted."""

    pieces: tuple[Run, ...]  # The pieces of trajectories, each followed as one orbit
    residuals: tuple[np.ndarray, ...]  # Of each piece, (2d, k); where the loss is robust outliers are limited
    losses: np.ndarray  # (N,): Minus the log-likelihood of each trajectory
    values: int  # Numbers observed
    correlation: float  # Of one residual with the next, or with one a lag later; NaN where there are none
    pairs: int  # How many of them count as independent
    exact: bool  # True if residuals are no more than rounding and the scheme leave
    # Their root mean square in σ, of the noise on the trajectories that the model was fitted to; outliers are limited
    # where the loss is robust
    loudness: float
    # The noise that the model leaves of a coordinate, over that which is seen without a model; the largest
    excess: float = 0.0
    lag: float = 0.0

    @property
    def later(self) -> str:
        """The residual that one is compared with."""
        return f"another {self.lag:.2g} later" if self.lag else "the next"

    @property
    def loss(self) -> float:
        """Minus the log-likelihood of a number."""
        return float(self.losses.sum() / self.values)

    @property
    def complaint(self) -> str:
        """The reason why they are not noise."""
        if not math.isfinite(self.loudness):
            return "there was no time to follow them"
        if self.excess >= LOUDER:
            return f"they are {self.excess:.1f} times the noise that is seen without a model"
        if self.loudness >= LOUDER:
            return (
                f"they are {self.loudness:.1f} times the noise, as given, or as found in the trajectories that the "
                "model was fitted to"
            )
        return f"the correlation of one with {self.later} is {self.correlation:.2f}"

    def squares(self, scales: np.ndarray) -> float:
        """The mean square of the residuals in units of the scales (2d,)."""
        return float(np.nanmean((np.concatenate(self.residuals, axis=1) / scales[:, None]) ** 2))

    @property
    def explained(self) -> bool:
        """True if the residuals are noise: at the level of rounding, or of the size of the noise and uncorrelated."""
        silent = abs(self.correlation) < CORRELATED + 3 / math.sqrt(max(self.pairs, 1))
        return self.exact or (silent and self.loudness < LOUDER and self.excess < LOUDER)


def judged(found: Fitted, held: Trajectories, setting: Setting) -> Held:
    """The likelihood of held-out trajectories."""
    scales, pieces = held.scales, _pieces(held, found.span)
    sigma = np.maximum(found.sigma, EXACT * scales)
    problem = Problem(found.model, pieces, found.method, sigma, frozen=True, huber=setting.huber)
    states = _states(found, held, pieces, sigma, setting)
    fit = minimized(problem, found.theta, states, iterations=20, patience=1, stop=setting.stop)
    residuals = fit.residuals
    ends = np.cumsum([run.n_points for run in held.runs])
    owner = np.searchsorted(ends, pieces.begins, side="right")
    losses = np.zeros(len(held.runs))
    values = int(sum(np.isfinite(left).sum() for left in residuals))
    for i, left in zip(owner, residuals, strict=True):
        r = left / sigma[:, None]
        losses[i] += 0.5 * np.nansum(rho(r, setting.huber))
        losses[i] += (np.isfinite(r) * np.log(sigma * math.sqrt(2 * math.pi))[:, None]).sum()
    exact = bool(all((np.abs(r)[np.isfinite(r)] < 100 * EXACT * scales.max()).all() for r in residuals))
    limits = None if setting.huber is None else setting.huber * sigma[:, None]
    residuals = [left if limits is None else np.clip(left, -limits, limits) for left in residuals]
    near, beside = correlation_of(pieces.runs, residuals, sigma, 0.0)
    far, pairs = correlation_of(pieces.runs, residuals, sigma, setting.lag)
    some = int(pairs * (1 - near) / (1 + near)) if near > SMOOTHED else 0
    lagged = setting.lag > held.time_scale and some >= FEWEST_PAIRS and abs(far) < FORGOTTEN
    correlation, pairs = (far, some) if lagged else (near, beside)
    losses = np.where(np.isfinite(losses), losses, np.inf)
    loudness = math.sqrt(fit.counts @ (fit.variances / sigma**2) / values)
    excess = 0.0
    if setting.seen is not None and (setting.seen > 0).any() and not lagged:  # else it is not seen
        excess = float(np.max(found.sigma[setting.seen > 0] / setting.seen[setting.seen > 0]))
    lag = setting.lag if lagged else 0.0
    return Held(pieces.runs, tuple(residuals), losses, values, correlation, pairs, exact, loudness, excess, lag)


def correlation_of(
    runs: Sequence[Run], residuals: Sequence[np.ndarray], sigma: np.ndarray, lag: float
) -> tuple[float, int]:
    """The correlation of residuals with those a lag later, the next at least, NaN without any; and their number."""
    same = size = 0.0
    pairs = 0
    for run, left in zip(runs, residuals, strict=True):
        r = left / sigma[:, None]
        later = np.maximum(np.searchsorted(run.t, run.t + lag), np.arange(1, run.n_points + 1))
        first = np.flatnonzero(later < run.n_points)
        product = r[:, later[first]] * r[:, first]
        both = int(np.isfinite(product).sum())
        same += float(np.nansum(product))
        size += float(np.nansum(r * r) * both / max(np.isfinite(r).sum(), 1))
        pairs += both
    return (same / size if size > 0 else math.nan), pairs


def left_out(found: Fitted, folds: Sequence[tuple[Trajectories, Trajectories]], setting: Setting) -> Held:
    """The likelihood of held-out trajectories; of several divisions, each by a fit to the others from this one."""
    if len(folds) == 1:
        return judged(found, folds[0][1], setting)
    parts = [judged(refitted(found, data, setting), held, setting) for data, held in folds]
    values, pairs = np.array([part.values for part in parts]), np.array([part.pairs for part in parts])
    share = np.average([part.correlation if part.pairs else 0.0 for part in parts], weights=pairs + 1e-300)
    loudness = math.sqrt(np.average([part.loudness**2 for part in parts], weights=values))
    return Held(
        tuple(piece for part in parts for piece in part.pieces),
        tuple(r for part in parts for r in part.residuals),
        np.concatenate([part.losses for part in parts]),
        int(values.sum()),
        float(share) if pairs.any() else math.nan,
        int(pairs.sum()),
        all(part.exact for part in parts),
        loudness,
        max(part.excess for part in parts),
        max(part.lag for part in parts),
    )


def gains(simple: Held, rich: Held) -> bool:
    """Return True if the richer of two models explains the held-out trajectories better than chance would have it."""
    difference = simple.losses - rich.losses
    with np.errstate(invalid="ignore"):
        mean = float(np.mean(difference))
    if not np.isfinite(simple.losses).all():
        return bool(np.isfinite(rich.losses).all())
    if not math.isfinite(mean):
        return False
    error = float(np.std(difference, ddof=1) / math.sqrt(len(difference))) if len(difference) > 1 else 1.0
    return mean > max(error, 1e-6 * abs(simple.losses.mean()))
