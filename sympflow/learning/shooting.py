"""Shooting: the numbers θ of a vector field, and the initial states of trajectories, that explain noisy observations.

Every trajectory, or piece of one, has a latent initial state x_i. Its orbit is followed by a symplectic scheme of high
order together with its exact derivatives by x_i and θ, and least squares are solved by Levenberg–Marquardt steps. The
normal equations have the shape of an arrow, a block for each x_i and one for θ; the x_i are eliminated first.

Arrays of orbits are columns: states (2d, N), derivatives (2d, 2d + n, N).

References
----------
.. [1] H. G. Bock, Recent advances in parameter identification techniques for O.D.E., in: Numerical Treatment of Inverse
   Problems in Differential and Integral Equations (1983), for multiple shooting.
.. [2] E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration (2006), sections II.1 and VI.6, for the schemes.
.. [3] P. J. Huber, Robust Statistics (1981), sections 6.4 and 7.7, for the robust loss and σ ("proposal 2").
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from sympflow.learning.orbits import Batch, Field, Method, batches, first_states, integrals, steppers
from sympflow.learning.reading import Run
from sympflow.learning.trajectories import Trajectories
from sympflow.training.least_squares import Damping, LinearModel, Stop, descend, never
from sympflow.training.session import OutOfTime

LEAST_DAMPING = 1e-15
TRIES = 12
STATES = 400  # by which the step of a scheme is chosen
FINEST = 1e-13  # of an observation, relative to the spread of the coordinate


# normal equations -----------------------------------------------------------------------------------------------------


@dataclass
class Normal:
    """JᵀJ and Jᵀr with the shape of an arrow, and the cost |r|²."""

    A: np.ndarray  # (N, m, m): Blocks of the initial states, of them with θ, and of θ
    B: np.ndarray  # (N, m, n)
    C: np.ndarray  # (n, n)
    a: np.ndarray  # (N, m): −Jᵀr
    c: np.ndarray  # (n,)
    cost: float
    scales: np.ndarray  # (m,): of the states

    def solved(self, damping: float, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray, float] | None:
        """The steps of θ and of the initial states, and the decrease that they promise; None if it cannot be solved."""
        N, m, n = self.B.shape
        diagonal = np.einsum("nii->ni", self.A)
        floor = np.finfo(float).tiny + LEAST_DAMPING * (diagonal * self.scales**2).max(axis=1, keepdims=True)
        damped = self.A + np.eye(m) * (damping * diagonal + floor / self.scales**2)[:, None, :]
        try:
            found = np.linalg.solve(damped, np.concatenate([self.B, self.a[..., None]], axis=2))
        except np.linalg.LinAlgError:
            return None
        Q, x = found[..., :n], found[..., n]
        theta = np.zeros(n)
        if n:
            flat = self.B.reshape(N * m, n)
            S = self.C - flat.T @ Q.reshape(N * m, n)
            D = np.sqrt(np.where(scale > 0, scale, 1.0))
            try:
                factor = cho_factor(S / np.outer(D, D) + damping * np.eye(n), check_finite=False)
            except np.linalg.LinAlgError:
                return None
            theta = cho_solve(factor, (self.c - flat.T @ x.reshape(-1)) / D, check_finite=False) / D
            x = x - Q @ theta
        model = 2 * (self.c @ theta + np.sum(self.a * x)) - theta @ self.C @ theta
        model -= np.einsum("ni,nij,nj->", x, self.A, x, optimize=True) + 2 * np.sum(x * (self.B @ theta))
        return theta, x, float(model)

    def reduced(self) -> tuple[np.ndarray, np.ndarray]:
        """JᵀJ (n, n) and −Jᵀr (n,) of θ when the initial states are eliminated."""
        n = self.C.shape[0]
        flat = self.B.reshape(-1, n)
        inverse = np.linalg.pinv(self.A, hermitian=True)
        x = (inverse @ self.a[..., None])[..., 0]
        return self.C - flat.T @ (inverse @ self.B).reshape(-1, n), self.c - flat.T @ x.reshape(-1)

    def precision(self) -> np.ndarray:
        """The matrix of θ when the initial states are eliminated, (n, n): its inverse is their covariance."""
        return self.reduced()[0]

    def gains(self, fitted: np.ndarray) -> np.ndarray:
        """Decrease of |r|² (n,) by the linear model, when one number joins those that were fitted; 0 of these."""
        S, g = self.reduced()
        found = np.linalg.solve(S[np.ix_(fitted, fitted)], np.column_stack([S[fitted], g[fitted]]))
        curvature = np.diag(S) - np.einsum("ak,ak->k", S[fitted], found[:, :-1])
        slope = g - S[:, fitted] @ found[:, -1]
        usable = ~fitted & (curvature > 1e-10 * np.diag(S))
        return np.where(usable, slope**2 / np.where(usable, curvature, 1.0), 0.0)


def rho(r: np.ndarray, huber: float | None) -> np.ndarray:
    """Huber's ρ of residuals in σ; their squares without a limit."""
    inside = r if huber is None else np.clip(r, -huber, huber)
    return inside * (2 * r - inside)


@dataclass(frozen=True)
class Problem:
    """Least squares of θ and the initial states of pieces of trajectories."""

    model: Field
    data: Trajectories  # Its runs are the pieces
    method: Method
    sigma: np.ndarray  # (2d,): The noise of each coordinate, by which residuals are divided
    frozen: bool = False  # True if θ is not to change
    huber: float | None = None  # Residuals of more than so many σ count by their size, not its square

    @cached_property
    def batches(self) -> list[Batch]:
        return batches(self.data.runs, 2 * self.model.ndof + (0 if self.frozen else self.model.n))

    def _orbits(
        self, batch: Batch, theta: np.ndarray, states: np.ndarray, derivatives: bool, stop: Stop = never
    ) -> Iterator[tuple[int, np.ndarray, np.ndarray | None]]:
        """States and derivatives at each point of a batch, until the time is up."""
        m = 2 * self.model.ndof
        x, X = np.ascontiguousarray(states[batch.index].T), None
        if derivatives:
            X = np.zeros((m, m + (0 if self.frozen else self.model.n), x.shape[1]))
            X[np.arange(m), np.arange(m)] = 1.0
        orbit = self.method.orbit(self.model, theta, x, X, batch.gaps, batch.starts)
        for k, (x, X) in enumerate(orbit):
            if stop():
                raise OutOfTime
            yield k, x, X

    def _weighted(self, batch: Batch, k: int, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals in σ (2d, N) of predictions x, and their weights."""
        r = (batch.y[k] - x) / self.sigma[:, None] * batch.seen[k]
        if self.huber is None:
            return r, batch.seen[k]
        return r, batch.seen[k] * np.minimum(1.0, self.huber / np.maximum(np.abs(r), self.huber))

    def _cost(self, r: np.ndarray) -> float:
        return float(np.sum(rho(r, self.huber)))

    def _unlikely(self, theta: np.ndarray) -> float:
        return 0.0 if self.frozen else float(np.sum((self.model.prior * theta) ** 2))

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def cost(self, theta: np.ndarray, states: np.ndarray, stop: Stop = never) -> float:
        """Σ ρ(r), and what numbers of an unlikely size cost; not finite where an orbit is not."""
        total = self._unlikely(theta)
        for batch in self.batches:
            for k, x, _ in self._orbits(batch, theta, states, False, stop):
                seen, _ = self.model.observed(theta, x, None)
                total += self._cost(self._weighted(batch, k, seen)[0])
                if not math.isfinite(total):
                    return math.inf
        return total

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def orbits(self, theta: np.ndarray, states: np.ndarray) -> list[np.ndarray]:
        """The orbit of each piece at its times, (2d, k)."""
        made: list[Any] = [None] * len(self.data.runs)
        for batch in self.batches:
            orbit = np.stack([x.copy() for _, x, _ in self._orbits(batch, theta, states, False)])
            for column, i in enumerate(batch.index):
                made[i] = orbit[: self.data.runs[i].n_points, :, column].T
        return made

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def growth(self, theta: np.ndarray, states: np.ndarray, scales: np.ndarray, limit: float) -> np.ndarray:
        """The times (N,) after which an error of the initial state has grown by a limit; infinite where it has not."""
        made, m = np.full(len(states), np.inf), len(scales)
        for batch in self.batches:
            for k, _, X in self._orbits(batch, theta, states, True):
                assert X is not None
                size = np.abs(X[:, :m] * (scales / scales[:, None])[..., None]).max(axis=(0, 1))
                passed = batch.gaps[: k + 1].sum(axis=0)
                grown = ~(size <= limit) & np.isinf(made[batch.index])
                made[batch.index[grown]] = passed[grown]
        return made

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def normal(self, theta: np.ndarray, states: np.ndarray, stop: Stop = never) -> Normal:
        """The normal equations at a point, as far as its orbits are finite."""
        N, m, n = len(states), 2 * self.model.ndof, 0 if self.frozen else self.model.n
        A, B, C, a, c = (np.zeros(shape) for shape in ((N, m, m), (N, m, n), (n, n), (N, m), (n,)))
        made = Normal(A, B, C, a, c, 0.0, self.data.scales)
        for batch in self.batches:
            size = len(batch.index)
            A, B, a = np.zeros((m, m, size)), np.zeros((m, n, size)), np.zeros((m, size))
            for k, x, X in self._orbits(batch, theta, states, True, stop):
                seen, by = self.model.observed(theta, x, X)
                r, weight = self._weighted(batch, k, seen)
                made.cost += self._cost(r)
                if not math.isfinite(made.cost):
                    made.cost = math.inf
                    return made
                for i in range(m):
                    J = by[i] * (np.sqrt(weight[i]) / self.sigma[i])
                    rest = np.sqrt(weight[i]) * r[i]
                    by_state = J[:m]
                    by_theta = J[m:]
                    a += by_state * rest
                    for j in range(m):
                        A[j] += by_state[j] * by_state
                        B[j] += by_state[j] * by_theta
                    if n:
                        made.C += by_theta @ by_theta.T
                        made.c += by_theta @ rest
            made.A[batch.index], made.B[batch.index] = A.transpose(2, 0, 1), B.transpose(2, 0, 1)
            made.a[batch.index] = a.T
        if n:
            made.cost += self._unlikely(theta)
            made.C[np.diag_indices(n)] += self.model.prior**2
            made.c -= self.model.prior**2 * theta
        return made


# the search -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Fit:
    """A minimum."""

    problem: Problem
    theta: np.ndarray  # (n,)
    states: np.ndarray  # (N, 2d): The latent initial state of each piece
    cost: float  # Σ ρ(r) at the σ of the problem
    normal: Normal  # The normal equations there
    costs: list[float] = field(default_factory=list)  # After each step
    reason: str = ""  # Why the search ended

    @cached_property
    def orbits(self) -> list[np.ndarray]:
        """The orbit of each piece at its times, (2d, k)."""
        return self.problem.orbits(self.theta, self.states)

    def _seen(self, orbits: list[np.ndarray]) -> list[np.ndarray]:
        """The observed values along orbits."""
        return [self.problem.model.observed(self.theta, orbit, None)[0] for orbit in orbits]

    @property
    def residuals(self) -> list[np.ndarray]:
        """Observation less orbit of each piece, (2d, k), NaN where nothing was observed."""
        return [run.y - seen for run, seen in zip(self.problem.data.runs, self._seen(self.orbits), strict=True)]

    @cached_property
    def variances(self) -> np.ndarray:
        """Mean squares of the residuals of each coordinate (2d,), of outliers limited where the loss is robust."""
        r = np.concatenate(self.residuals, axis=1)
        unseen = self.counts == 0  # as loud as the data are wide
        r[unseen] = self.problem.data.scales[unseen, None]
        return np.nanmean(r * r, axis=1) if self.problem.huber is None else _robust_variances(r, self.problem.huber)

    @cached_property
    def counts(self) -> np.ndarray:
        """How many values of each coordinate were observed, (2d,)."""
        return np.isfinite(np.concatenate([run.y for run in self.problem.data.runs], axis=1)).sum(axis=1)

    def noise(self) -> np.ndarray:
        """σ of each coordinate (2d,) by the residuals, with the share that the fit took of them given back."""
        fitted = self.states.size + len(self.theta)
        return np.sqrt(self.variances / max(1 - fitted / self.counts.sum(), 0.1))

    def step_error(self, sigma: np.ndarray) -> float:
        """Largest change of an orbit, in σ (2d,), when the steps of the scheme are halved."""
        method = self.problem.method
        if method.stepper.longest is not None:
            return 0.0
        finer = replace(self.problem, method=replace(method, longest=method.longest / 2))
        pairs = zip(self._seen(finer.orbits(self.theta, self.states)), self._seen(self.orbits), strict=True)
        return max(float((np.abs(a - b) / sigma[:, None]).max(initial=0.0)) for a, b in pairs)

    def covariance(self) -> np.ndarray:
        """The covariance of θ (n, n), where σ is the noise."""
        return np.linalg.pinv(self.normal.precision(), hermitian=True)

    def without(self, dropped: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """θ (n,) of the minimum where some numbers are 0, by the quadratic approximation about a minimum."""
        S = self.covariance()
        inner = np.linalg.pinv(S[np.ix_(dropped, dropped)])
        return np.where(dropped, 0.0, theta - S[:, dropped] @ inner @ theta[dropped])


def _robust_variances(r: np.ndarray, huber: float) -> np.ndarray:
    """σ² of rows (2d, n) by Huber's proposal 2: the mean of min(r², k²σ²) is that of normal residuals."""
    density, inside = math.exp(-huber * huber / 2) / math.sqrt(2 * math.pi), math.erf(huber / math.sqrt(2))
    # the mean of min(z², k²) of a normal z
    expected = inside - 2 * huber * density + huber * huber * (1 - inside)
    made = np.empty(len(r))
    for i, row in enumerate(r):
        squares = row[np.isfinite(row)] ** 2
        variance = float(np.median(squares)) / 0.4549 if len(squares) else 0.0
        for _ in range(30):
            before, variance = variance, float(np.minimum(squares, huber**2 * variance).mean()) / expected
            if abs(variance - before) <= 1e-6 * before:
                break
        made[i] = variance
    return made


def minimized(
    problem: Problem,
    theta: np.ndarray,
    states: np.ndarray,
    *,
    iterations: int = 50,
    gain: float = 1e-3,
    patience: int = 3,
    stop: Stop = never,
) -> Fit:
    """Levenberg–Marquardt steps until `patience` of them together gain less than this share of the cost."""
    start = theta, states
    try:
        first = problem.normal(theta, states, stop)
    except OutOfTime:
        first = problem.normal(theta, np.full_like(states, np.nan))  # which ends at once
    known: dict[str, Any] = {"here": (start, first), "tried": (None, None)}

    def normal_at(x: Any) -> Normal:
        found = next((normal for point, normal in known.values() if point is x and normal is not None), None)
        return problem.normal(x[0], x[1], stop) if found is None else found

    def model_at(x: Any) -> _Arrow:
        known["here"] = x, normal_at(x)
        np.maximum(scale, np.diagonal(known["here"][1].C), out=scale)
        return _Arrow(x, known["here"][1], scale, problem.frozen)

    def cost(x: Any, attempt: int) -> float:
        known["tried"] = x, None if attempt else problem.normal(x[0], x[1], stop)  # the first is mostly taken
        return problem.cost(x[0], x[1], stop) if attempt else known["tried"][1].cost

    scale, costs = np.diagonal(normal_at(start).C).copy(), [normal_at(start).cost]
    if not math.isfinite(costs[0]):
        reason = "it was stopped" if stop() else "the orbits are not finite at the start"
        return Fit(problem, theta, states, costs[0], first, costs, reason)
    options: Any = {"tries": TRIES, "iterations": iterations, "patience": patience, "gain": gain, "stop": stop}
    end, reason = descend(start, costs, model_at, cost, damping=Damping(least=LEAST_DAMPING), **options)
    try:
        normal = normal_at(end)
    except OutOfTime:  # the point before is known
        end, normal = known["here"]
        costs.append(normal.cost)
    return Fit(problem, end[0], end[1], costs[-1], normal, costs, reason)


@dataclass(frozen=True)
class _Arrow(LinearModel):
    """The linear model at θ and the initial states, which are eliminated."""

    x: tuple[np.ndarray, np.ndarray]
    normal: Normal
    scale: np.ndarray
    frozen: bool

    def trial(self, damping: float) -> Any:
        solved = self.normal.solved(damping, self.scale)
        if solved is None:
            return None
        step, moved, promised = solved
        theta, states = self.x
        return (theta if self.frozen else theta + step, states + moved), promised


# starts and methods ---------------------------------------------------------------------------------------------------


def chosen_method(
    model: Field, theta: np.ndarray, data: Trajectories, tolerance: np.ndarray, halvings: int = 12, stop: Stop = never
) -> Method:
    """The cheapest scheme and step whose error over the gaps between points is below a tolerance (2d,).

    The error is that over single gaps, from observed states, against half the step. The step is the widest gap, halved
    so many times at most.
    """
    if model.stepper is not None:
        return Method(model.stepper, model.stepper.longest)
    starts, gaps, times = _gaps(data)
    starts, widest = model.states(theta, starts), float(gaps.max())
    best: tuple[float, Method] | None = None

    def cost(method: Method) -> float:
        return method.stepper.cost * float(np.mean([method.steps(gap[None]) for gap in gaps]))

    for stepper in reversed(steppers(model)):  # those of a high order first: others are left when they cost more
        method = Method(stepper.within(tolerance), widest)
        end, before = _ends(model, theta, method, starts, gaps, times), math.inf
        for _ in range(halvings):
            if stop() or (best is not None and cost(method) > best[0]):
                break
            finer = replace(method, longest=method.longest / 2)
            after = _ends(model, theta, finer, starts, gaps, times)
            with np.errstate(invalid="ignore", over="ignore"):
                error = np.nanquantile(np.abs(end - after) / tolerance[:, None], 0.99) if len(gaps) else 0.0
            if error <= 1 or (error > before / 2 and error < 1e3):  # rounding
                break
            method, end, before = finer, after, error
        if best is None or cost(method) <= best[0]:
            best = cost(method), method
    assert best is not None
    return best[1]


def _gaps(data: Trajectories) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Some states (2d, N) with the times to the next points (N,), the widest among them, and their own times."""
    found = [
        (run.y[:, k], run.t[k + 1] - run.t[k], run.t[k])
        for run in data.runs
        for k in range(run.n_points - 1)
        if np.isfinite(run.y[:, k]).all()
    ]
    if not found:  # never a whole state
        firsts = zip(first_states(data), data.runs, strict=True)
        found = [(x, float(np.diff(run.t).max()), run.t[0]) for x, run in firsts]
    gaps, times = np.array([one[1:] for one in found]).T
    spread = np.linspace(0, len(gaps) - 1, min(STATES, len(gaps))).astype(int)
    chosen = np.unique(np.concatenate([np.argsort(gaps)[-STATES // 4 :], spread]))
    return np.stack([found[i][0] for i in chosen], axis=1), gaps[chosen], times[chosen]


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def _ends(
    model: Field, theta: np.ndarray, method: Method, x: np.ndarray, gaps: np.ndarray, t: np.ndarray
) -> np.ndarray:
    return model.observed(theta, method.over(model, theta, x.copy(), None, gaps, t)[0], None)[0]


def matched(
    model: Field, theta: np.ndarray, data: Trajectories, weights: np.ndarray, steps: int = 1, stop: Stop = never
) -> np.ndarray:
    """θ by which the observed increments are the integrals of the field along the observed states, by least squares.

    No orbit is computed: y(t) − ∫ f_θ(y) dt is compared with a constant for each piece. That is linear where f is
    linear in θ, and one step solves it.
    """
    pieces = [run for run in map(_whole, data.runs) if run.n_points > 1]
    if not pieces:
        return theta
    level = Damping(1e-10 if steps == 1 else 1e-3)
    r, J = _increments(model, theta, pieces, weights)
    prior = model.prior * np.sqrt(r @ r / len(r))
    for done in range(steps):
        if done and stop():
            break
        scale = np.sqrt(np.sum(J * J, axis=0))
        D = np.where(scale > 0, scale, 1.0)
        normal = (J / D).T @ (J / D) + np.diag((prior / D) ** 2)
        for _ in range(TRIES):
            step = np.linalg.solve(normal + level.value * np.eye(len(D)), ((J / D).T @ r - prior**2 * theta / D)) / D
            after, K = _increments(model, theta + step, pieces, weights)
            if after @ after + np.sum((prior * (theta + step)) ** 2) < r @ r + np.sum((prior * theta) ** 2):
                level.accepted(0.9)
                theta, r, J = theta + step, after, K
                break
            level.rejected()
        else:
            break
    return theta


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def increments_left(model: Field, theta: np.ndarray, data: Trajectories, weights: np.ndarray) -> float:
    """The squares of y(t) − ∫ f_θ(y) dt less a constant for each piece, weighted (2d,): 0 of the field of the data."""
    pieces = [run for run in map(_whole, data.runs) if run.n_points > 1]
    if not pieces:
        return 0.0
    x = model.states(theta, np.concatenate([run.y for run in pieces], axis=1))
    here = model.at(np.concatenate([run.t for run in pieces]))
    rates = model.observed(theta, x, here.field(theta, x, False, False).value[:, None])[1][:, 0]
    parts = np.split(rates, np.cumsum([run.n_points for run in pieces])[:-1], axis=1)
    rests = [run.y - integrals(run.t, part) for run, part in zip(pieces, parts, strict=True)]
    return float(sum((((rest.T - rest.mean(axis=1)) * weights) ** 2).sum() for rest in rests))


def _whole(run: Run) -> Run:
    """The points at which all is observed."""
    kept = np.isfinite(run.y).all(axis=0)
    return Run(run.t[kept], run.y[:, kept])


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def _increments(
    model: Field, theta: np.ndarray, pieces: Sequence[Run], weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The increments less the integrals of the field, and minus their derivative by θ."""
    here = model.at(np.concatenate([run.t for run in pieces]))
    f = here.field(theta, np.concatenate([run.y for run in pieces], axis=1), False, True)
    at, rests, columns = 0, [], []
    for run in pieces:
        here = slice(at, at + run.n_points)
        at += run.n_points
        rates = np.concatenate([f.value[:, None, here], f.by_parameters[:, :, here]], axis=1)  # (m, 1 + n, k)
        moved = integrals(run.t, rates)
        rest = run.y - moved[:, 0]
        rests.append(((rest - rest.mean(axis=-1, keepdims=True)) * weights[:, None]).ravel())
        J = (moved[:, 1:] - moved[:, 1:].mean(axis=-1, keepdims=True)) * weights[:, None, None]
        columns.append(J.transpose(0, 2, 1).reshape(-1, model.n))
    return np.concatenate(rests), np.concatenate(columns)
