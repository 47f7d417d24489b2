"""The search among models of an unknown H, and the flow of the best."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy import stats

from sympflow.arguments import floats, warn
from sympflow.flow.flow_map import FlowMap
from sympflow.flow.sympflow import SympFlow
from sympflow.hamiltonian.domain import Box, Domain, EnergySublevel, Tube
from sympflow.hamiltonian.doubling import DoubledSystem, doubled
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.learning import diagnosis, fitting
from sympflow.learning.diagnosis import Reading
from sympflow.learning.families import MOST_TERMS, Candidate, Constraints, Group, pruned, with_unit_mass
from sympflow.learning.fitting import Fitted, Held, Setting
from sympflow.learning.lagrangian import told
from sympflow.learning.library import library_for
from sympflow.learning.models import FreeField, Model, drags, frictions
from sympflow.learning.orbits import Field, Method
from sympflow.learning.parts import Distances, Drive, Part, Polynomial
from sympflow.learning.reading import Run
from sympflow.learning.smoothing import Smooth
from sympflow.learning.trajectories import Trajectories
from sympflow.learning.unseen import remark_on, tube, unseen
from sympflow.training import checkpoint as checkpoints
from sympflow.training.least_squares import never
from sympflow.training.session import Deadline, OutOfTime, Path, Session, Silent
from sympflow.training.starts import step_of
from sympflow.training.trainer import train

SHARE = 3  # of families that are still to be tried, whose time is given to the next
PRUNINGS = 3  # of a model by smooth curves; its numbers are fitted anew after each
HOPELESS = 2.0  # squares of increments, over those of the best model, from which a model is one of the last
TABLE_STARTS = 8  # of the fit of the flow's numbers: no seconds, for what is found is not to depend on other load
STEPPED = 100  # states by which the steps of a flow are chosen, where H is not separable
DOUBTFUL_SECONDS = 5.0  # for a flow of data that no symplectic map explains
TABLE_SECONDS = 2.5  # that a flow takes, which is no more than 60 % of a time budget
TABLE_SHARE = 0.3  # of a time budget, likewise
DIAGNOSIS_SHARE = 0.5  # of the time left after the search, by which it ends to look for what data hold beside H
HORIZONS = (1, 10, 100)  # in Δt, of the held-out errors
POOR = 1e-3  # one-step error of a flow, relative to the spread of the data, that is worth a warning
LEAST_SECONDS = 1.0  # for the flow, however late it is
LEAST_REPLICAS = 2  # that are fitted however late it is
MARGIN = 0.05  # of the spread of the states, by which Ω exceeds them
FREER = 0.5  # of the squares, that a field which is not Hamiltonian must leave at most to be worth a word
CERTAIN = 5.0  # standard errors that the factor of a force is worth a word
SYMPLECTIC = 1e-9  # defect of a field, up to which it is of an H
GROWS = 4.0  # standard errors below 0, from which a negative friction is more than chance
DRAG_STEPS = 20  # of a Gauss method in Δt, with a force that has a kink
SCATTERED, ALONG = 400, 20  # states at which 𝓗 is looked at, and trajectories of these at least
OVER_TIMES = 5  # between 0 and Δt, at which 𝓗 is averaged


def frequencies_of(constraints: Constraints, smooth: Smooth) -> tuple[float, ...]:
    """The angular frequencies of one drive or two, by slopes beside those of a library of terms and friction."""
    smooth = smooth.some(diagnosis.MOST_SLOPES)
    d, x = constraints.ndof, smooth.points
    if not len(x):
        raise ValueError("`drive` cannot be found without successive points that have all values: give its frequency.")
    fields = library_for(None, d, 4, x)[0].fields(x)
    X = np.concatenate([fields, diagnosis.fields_of(constraints.force or frictions, x)], axis=2)
    base = constraints.driven(1.0)
    found = diagnosis.driven(X, smooth, constraints.scales, base)[1]
    return tuple(found or [diagnosis.drive_frequency(X, smooth, constraints.scales, base)])


@dataclass(frozen=True)
class Replicas:
    """A model with numbers that were fitted to trajectories drawn anew: how much of them is chance.

    Attributes
    ----------
    theta : ndarray of shape (n,)
        The numbers of the flow.
    thetas : ndarray of shape (replicas, n)
    drawn : int
        The number of trajectories that are drawn.
    """

    model: Model
    method: Method
    theta: np.ndarray
    thetas: np.ndarray
    drawn: int

    def predictions(self, y0: ArrayLike, t: ArrayLike) -> np.ndarray:
        """The orbits (replicas, 2d, n) from y0 (2d,) at times t (n,), ascending from the time of y0, t[0]."""
        times = floats("t", t)
        if times.ndim != 1 or len(times) < 1 or (np.diff(times) < 0).any():
            raise ValueError(f"`t` must be ascending times (n,), the first that of y0; got {t!r}.")
        start, gaps = floats("y0", y0), np.diff(times, prepend=times[0])[:, None]
        if start.shape != (2 * self.model.ndof,) or not np.isfinite(start).all():
            raise ValueError(f"`y0` must be one finite state ({2 * self.model.ndof},); got {y0!r}.")
        orbits = []
        for theta in self.thetas:
            orbit = self.method.orbit(self.model, theta, start[:, None].copy(), None, gaps, times[:1])
            orbits.append(np.stack([state[:, 0].copy() for state, _ in orbit], axis=1))
        return np.stack(orbits)

    def bands(self, y0: ArrayLike, t: ArrayLike, level: float = 0.9) -> tuple[np.ndarray, np.ndarray]:
        """Bounds (2d, n) and (2d, n) between which the true orbit from y0 lies at each time with this probability.

        They lie t standard deviations of the replicas about the orbit of the flow, t by Student's distribution, because
        few replicas of few trajectories give only rough deviations. The family of models is taken for true.
        """
        if not 0 < level < 1:
            raise ValueError(f"`level` must lie between 0 and 1; got {level!r}: 0.9 is usual.")
        n = self.drawn
        deviation = self.predictions(y0, t).std(axis=0, ddof=1) * math.sqrt(n / (n - 1))  # of n that are drawn from n
        wide = deviation * stats.t.ppf((1 + level) / 2, min(n, len(self.thetas)) - 1)
        middle = replace(self, thetas=self.theta[None]).predictions(y0, t)[0]
        return middle - wide, middle + wide


def replica(common: tuple[Model, Trajectories, Setting, np.ndarray, int], number: int) -> np.ndarray:
    """The numbers of a model that is fitted to trajectories drawn with repetition: a task for a worker."""
    model, data, setting, theta, seed = common
    drawn = np.random.default_rng([seed, number]).integers(0, len(data.runs), len(data.runs))
    setting = setting if number >= LEAST_REPLICAS else replace(setting, stop=never)
    return fitting.fitted(model, data.subset(drawn), setting, theta).theta


def without_growth(found: Fitted, settled: bool = True) -> Fitted:
    """The fit with rates of friction that are not negative: those below 0 are 0, and other numbers the best beside.

    Of data without friction chance makes half of the rates negative. A significant one is reported, if the fit was
    completed.
    """
    model, theta = found.model, found.theta
    growing = np.arange(model.n) >= np.where(theta < 0, model.n - model.forces, model.n)
    if not growing.any():
        return found
    errors = np.sqrt(np.diag(found.fit.covariance()))
    worst = int(np.argmin(np.where(growing, theta / errors, np.inf)))
    if settled and theta[worst] < -GROWS * errors[worst]:
        warn(
            f"`damping` is {theta[worst]:.2g} ± {errors[worst]:.1g} by the data, whose energy grows: it is taken as 0. "
            "Look at the order of the times and the sign of the momenta, or leave `damping` out."
        )
    return replace(found, theta=found.fit.without(growing, theta))


def _made(make: Callable[[float | None], FlowMap], dt: float | None) -> FlowMap:
    """A flow of this Δt, or of its own where that is not given, or none can be made of it."""
    try:
        return make(dt)
    except ValueError as error:
        if dt is None:
            raise
        warn(f"{error} The flow that was made has its own.")
    return make(None)


Chosen = tuple[Candidate, Fitted, Held]


@dataclass(frozen=True)
class Freedom:
    """A vector field that need not be Hamiltonian, or another order of the coordinates, beside the best H."""

    said: str  # The field in words
    remedy: str  # What to do where it has a form that is known; empty where it has none
    share: float  # Of the squares of held-out residuals, that it leaves
    defect: float  # The size of LᵀJ + JL, over that of JL, L its Jacobian: 0 for a Hamiltonian
    rate: float  # At which volumes of phase space grow


def _certain(numbers: slice, fit: Fitted, held: Held) -> bool:
    """True if the factor of one of the forces is more than chance, which noise that is correlated makes larger."""
    repeated = min(max(held.correlation, 0.0), 0.99) if math.isfinite(held.correlation) else 0.99
    errors = np.sqrt(np.diag(fit.fit.covariance())[numbers] * (1 + repeated) / (1 - repeated))
    return bool((np.abs(fit.theta[numbers]) > CERTAIN * max(held.loudness, 1.0) * errors).any())


@dataclass
class Search:
    """The models that were fitted so far, and the best of them."""

    all: Trajectories
    folds: list[tuple[Trajectories, Trajectories]]
    """Divisions into trajectories that models are fitted to and held-out ones: one, or each trajectory in turn."""
    constraints: Constraints
    setting: Setting
    seed: int
    history: list[dict[str, Any]] = field(default_factory=list)
    best: Chosen | Any = (
        None  # The chosen model, as it was fitted without the held-out trajectories; None before there is one
    )
    identity: dict[str, Any] = field(default_factory=dict)
    done: dict[str, dict[str, Any]] = field(default_factory=dict)
    """The numbers of the models that were fitted, by their names."""
    cut: bool = False  # True if the time was up before the search came to its end
    bar: Silent = field(default_factory=Silent)
    reading: Reading | None = None  # Another explanation of the data, where increments make any H doubtful
    tested: list[Freedom | None] = field(default_factory=list)
    """The comparison with a vector field that need not be Hamiltonian, once it was made; None where H does as well."""
    whole: Trajectories | None = None  # The trajectories as they were before they were cut; None if they were not
    final: Fitted = field(init=False)  # The chosen model, fitted to all trajectories
    late: Callable[[], bool] = lambda: False  # True once there is no time for another model

    @property
    def data(self) -> Trajectories:
        """The trajectories that models are fitted to: of few all, whose fit is the start of those without one."""
        return self.folds[0][0] if len(self.folds) == 1 else self.all

    @property
    def held(self) -> Trajectories:
        """The held-out trajectories."""
        return self.folds[0][1] if len(self.folds) == 1 else self.all

    @property
    def numbers(self) -> int:
        """The numbers that the least of the fits has, beside the initial states."""
        return min(data.n_values - 2 * data.ndof * len(data.runs) for data, _ in self.folds)

    @property
    def reason(self) -> str:
        """Why this model."""
        held = self.best[2]
        others = len({record["model"] for record in self.history}) - 1
        because = (
            "its residuals on held-out trajectories are no more than rounding"
            if held.exact
            else "it explains held-out trajectories best, and its residuals are noise: one says nothing about "
            f"{held.later}"
            if held.explained
            else f"it explains held-out trajectories best; but its residuals are not noise: {held.complaint}"
        )
        ended = "; the time budget ended the search" if self.cut else ""
        return f"{because} (of {others + 1} models{ended})"

    def run(self, names: list[str], session: Session) -> None:
        """Fit models of these families until one explains the held-out trajectories, or no richer one does better."""
        deadline = session.deadline
        if session.time_budget is not None:
            deadline = deadline.part(1 - max(TABLE_SHARE, min(0.6, TABLE_SECONDS / session.time_budget)))
        self.late = deadline.over
        setting = replace(self.setting, stop=deadline.over)
        groups = sorted((g for name in names for g in self.constraints.groups(name)), key=lambda group: group.assumed)
        with session.bar(sum(len(group.models) for group in groups), "Models") as self.bar:
            queue = self._ask(groups, setting, session)
            if self.best is not None:
                self.final, self.cut = self.best[1], deadline.over()
                return
            for place, (linear, candidates) in enumerate(queue):
                if self.best is not None and (self.best[2].explained or deadline.over()):
                    break
                if self.best is not None and not linear and self.freedom(setting) is not None:
                    break
                own = deadline.part(min(SHARE / (len(queue) - place), 1.0))
                self._climb(candidates, replace(setting, stop=own.over), session)
        if self.best is None:
            raise ValueError(
                f"`trajectories` have {self.data.n_values} numbers, fewer than the simplest model and the initial "
                "states have: give longer trajectories, or more of them."
            )
        if not deadline.over():
            candidate, found, _ = self.best
            precision = found.fit.normal.precision()
            self._simplify(pruned(candidate, found.theta, precision, self.data.n_values), setting, session)
        if not deadline.over():
            self._simplify(with_unit_mass(self.best[0], self.constraints), setting, session)
        candidate, self.final, _ = self.best
        if not deadline.over():
            smooth = replace(setting, seen=None) if self.best[2].lag else setting
            found = fitting.refitted(self.final, self.whole or self.all, smooth, longer=True)
            shorter = found.span < self.final.span or not math.isfinite(found.fit.cost)
            self.final = self.final if setting.stop() and shorter else found
        self.cut = deadline.over()
        self.final = without_growth(self.final, settled=not self.cut)

    def _ask(self, groups: list[Group], setting: Setting, session: Session) -> list[tuple[bool, list[Candidate]]]:
        """Keep the best of the simple models if no H explains the data, which is known before any other is fitted.

        Where increments say so, orbits of that model are compared with those of another reading. The models of the
        families are returned in the order in which they are to be tried, with True for those that are linear: those
        that leave much more of increments than the best of all are the last.
        """
        smooth = self.folds[0][0].sample
        queue = [(g.family.linear, [c for one in g.models for c in self._sparse(one, smooth)]) for g in groups]
        linear = [c for _, candidates in queue for c in candidates if c.model.linear or c.model.lagrangian]
        drives: tuple[Drive, ...] = ()
        if not (self.constraints.frequencies or self.data.velocities or self.late()):
            drives = self._drives()
        models = [candidate.model for candidate in linear]
        found = diagnosis.best_by_increments(*self.folds[0], models, drives, setting.stop)
        if found is None:
            return queue
        place, self.reading, squares = found
        if self.reading is not None:
            chosen = linear[place], *self._first_fold(linear[place].model, setting)
            self.best = chosen
            if not chosen[2].explained and self.freedom(setting) is not None:
                self._note(chosen, session)
                return []
            self.best = self.reading = None
            self.tested.clear()
        hopeless = [id(linear[k]) for k in squares if squares[k] > HOPELESS * min(squares.values())]
        kept = [(kind, [c for c in some if id(c) not in hopeless]) for kind, some in queue]
        # H = T(p) + V(q) is tried first, unless functions H(q, p) alone explain increments; networks last
        separable = [group.family.separable for group in groups]
        apart = not any(of and kind and apart for (kind, of), apart in zip(kept, separable, strict=True))
        judged = [any(id(c) in map(id, linear) for c in of) for _, of in queue]
        order = sorted(range(len(groups)), key=lambda i: (not judged[i], apart and separable[i]))
        late = [(True, [c for c in some if id(c) in hopeless]) for _, some in queue]
        return [group for group in [*(kept[i] for i in order), *late] if group[1]]

    def _drives(self) -> tuple[Drive, ...]:
        """Drives of the likeliest frequencies; none where the data cannot tell them."""
        smooth = self.data.smooth
        if len(np.unique(smooth.owner)) < 2 or len(smooth.points) < 4 * self.constraints.driven(1.0).n:
            return ()
        return tuple(map(self.constraints.driven, frequencies_of(self.constraints, smooth)))

    def _first_fold(self, model: Model, setting: Setting) -> tuple[Fitted, Held]:
        """A model that is fitted to the first division of the trajectories, and what it leaves of the others there."""
        data, held = self.folds[0]
        if self.best is not None and self.best[0].model is model and (len(self.folds) == 1 or self.reading is not None):
            return self.best[1], self.best[2]
        found = fitting.fitted(model, data, setting, seed=self.seed)
        return found, fitting.judged(found, held, self.setting)

    def _climb(self, candidates: list[Candidate], setting: Setting, session: Session) -> None:
        """Fit the models of a family, until two that follow each other are no better than one of it before."""
        worse, best = 0, None
        for candidate in candidates:
            over = self.best is not None and (self.best[2].exact or setting.stop())
            if over or worse == 2 or self.numbers <= candidate.model.n:
                return
            made = self._try(candidate, setting, session)
            better = best is None or fitting.gains(best[2], made[2])
            worse, best = (0, made) if better else (worse + 1, best)

    def _sparse(self, candidate: Candidate, data: Trajectories) -> list[Candidate]:
        """A model by Lagrange's equations, before it the same without the terms that smooth curves do not ask for."""
        found = candidate
        for _ in range(PRUNINGS if candidate.model.lagrangian and diagnosis.affords(data, candidate.model) else 0):
            fewer = None if self.late() else pruned(found, *told(found.model, data), data.n_values)
            if fewer is None:
                break
            found = fewer
        return [candidate] if found is candidate else [found, candidate]

    def _fit(self, candidate: Candidate, setting: Setting, session: Session) -> Chosen:
        numbers = self.done.get(candidate.name)
        if numbers is None:
            found = fitting.fitted(candidate.model, self.data, setting, seed=self.seed)
            if not setting.stop():
                self.done[candidate.name] = fitting.kept(found)
                self.save(session)
        else:
            found = fitting.restored(candidate.model, self.data, numbers, setting)
        chosen = candidate, found, fitting.left_out(found, self.folds, replace(self.setting, stop=self.late))
        self._note(chosen, session)
        return chosen

    def _note(self, chosen: Chosen, session: Session) -> None:
        """The figures of a model, which join the history and are shown."""
        candidate, found, held = chosen
        figures = {
            "parameters": candidate.model.n,
            "training_chi2": found.costs[-1],
            "held_out_loss": held.loss,
            "correlation": held.correlation,
            "noise": float(np.mean((found.sigma / self.data.scales)[found.fit.counts > 0])),
        }
        self.history.append({"model": candidate.name, **figures})
        self.bar.tries(len(self.history), f"{candidate.name}: held-out loss {held.loss:.3g}")
        if session.callback is not None:
            session.callback(len(self.history), figures)

    def _try(self, candidate: Candidate, setting: Setting, session: Session) -> Chosen:
        """Fit a model, and keep it if it is the best so far, and was judged before the time was up."""
        rival = None if self.best is None else self.best[1].sigma
        made = self._fit(candidate, replace(setting, rival=rival), session)
        if self.best is None or (not self.late() and fitting.gains(self.best[2], made[2])):
            self.best = made
        return made

    def _simplify(self, candidate: Candidate | None, setting: Setting, session: Session) -> None:
        """Fit the best model with fewer numbers, and take that unless what it explains less is worth them."""
        if candidate is None:
            return
        rich = self.best
        simple = self._fit(candidate, setting, session)
        fewer = rich[0].model.n - candidate.model.n
        lost = 2 * (simple[1].loss(rich[1].sigma) - rich[1].loss(rich[1].sigma))
        if self.late():
            return
        if simple[2].exact or lost < fewer * math.log(self.data.n_values):
            self.best = simple

    def save(self, session: Session) -> None:
        """Write a checkpoint, if a path was given."""
        if session.checkpoint is not None:
            fits = {
                name: {key: torch.as_tensor(v) if isinstance(v, np.ndarray) else v for key, v in numbers.items()}
                for name, numbers in self.done.items()
            }
            state = {"step": len(fits), "flow": {}, "best": {}, "optimizer": fits, "history": [], "seconds": 0.0}
            checkpoints.write(session.checkpoint, self.identity | state)

    def resume(self, path: Path) -> None:
        """Take over the models of a checkpoint; a ValueError if it is one of other trajectories or options."""
        self.done = checkpoints.read_same(path, self.identity)["optimizer"]

    def diagnose(self, session: Session) -> None:
        """Warn where the residuals of the best model are not noise, with what may be the reason."""
        candidate, _, held = self.best
        if held.explained:
            share = float(np.min(self.best[1].sigma / self.data.scales))
            if share > fitting.SILENT:
                warn(
                    f"The best model, {candidate.name}, explains almost nothing: its residuals are "
                    f"{share:.0%} of the spread of every coordinate or more. The points may be out of order, of "
                    "different trajectories or too far apart; otherwise the data are noise."
                )
            elif self.unseen:
                warn(remark_on(self.unseen))
            return
        deadline = session.deadline.part(DIAGNOSIS_SHARE)
        if not math.isfinite(held.loudness):
            warn(
                f"The time budget ended before the best model, {candidate.name}, was compared with held-out "
                f"trajectories: give it more. {self._hint(deadline) or ''}".strip()
            )
            return
        said = (
            f"The best model, {candidate.name}, leaves residuals on held-out trajectories that are not noise: "
            f"{held.complaint}."
        )
        free = None

        def over() -> bool:
            deadline.check()  # raises OutOfTime
            return False

        with suppress(OutOfTime):
            over()
            free = self.freedom(replace(self.setting, stop=over))
        if free is not None:
            what = "H without the time" if free.defect < SYMPLECTIC else "symplectic map"
            said += f" No {what} explains these data: {free.said} leaves {free.share:.1e} of the sum of squares."
            if free.defect >= SYMPLECTIC:
                said += (
                    f" Its Jacobian L fails the test of symplecticity: LᵀJ + JL, which is 0 for a Hamiltonian, is "
                    f"{free.defect:.2g} of L; volumes change at a rate of {free.rate:.3g}."
                )
            if free.remedy:
                warn(f"{said} {free.remedy}")
                return
        otherwise = "Give more trajectories, say what is known of H, or give the `noise` if it is larger than it looks."
        if self.cut:
            otherwise = f"The time budget ended the search: give it more. {otherwise}"
        warn(f"{said} {self._hint(deadline) or otherwise}")

    def _hint(self, deadline: Deadline) -> str | None:
        """The likeliest reason why the best model does not explain the data, by slopes, if there is time to look."""
        if deadline.over():
            return None
        smooth = self._whole(self.data).smooth
        library = library_for(None, self.data.ndof, 4, smooth.points)[0]
        drives = [self.constraints.driven(w) for w in self.best[0].model.frequencies(self.best[1].theta)]
        return diagnosis.hint(library, smooth, self.data, self.constraints.force, drives)

    def freedom(self, setting: Setting) -> Freedom | None:
        """The comparison with a field that need not be Hamiltonian, where it explains much more than any H; else None.

        A field of polynomials has those of all H(q, p) one degree higher, which must leave as much as the best model:
        so that not only functions are missing.
        """
        if not self.tested:
            self.tested.append(self._freedom(setting))
        return self.tested[0]

    def _freedom(self, setting: Setting) -> Freedom | None:
        """The same by one division of the trajectories: a difference as large as is asked for needs no more."""
        if self.reading is not None:
            return self._beside(self.reading, setting)
        best, scales = self.best[0].model, self.data.scales
        damped = diagnosis.forced(best)[:1] if isinstance(best, Model) else []
        free = [r for r in (diagnosis.free_reading(scales, k) for k in (3, 2)) if self._affords_field(r.field)][:1]
        found = (self._beside(r, setting) for r in (*damped, *free) if self._affords_field(r.field))
        return next((one for one in found if one is not None), None)

    def _beside(self, reading: Reading, setting: Setting) -> Freedom | None:
        """A reading beside the best H; None if it does not explain much more."""
        data, others = self.folds[0]
        scales, rivals = data.scales, [self.best[0].model]
        if isinstance(reading.field, FreeField):
            rivals.append(self.constraints.whole(Polynomial.up_to(reading.field.degree + 1, "y", scales)))
        fit = fitting.fitted(reading.field, reading.of(data), setting.turned(reading.rows))
        if setting.stop():
            return None
        theirs = fitting.judged(fit, reading.of(others), self.setting.turned(reading.rows))
        left, share = theirs.squares(scales[[*reading.rows]]), 0.0
        if reading.numbers and not (_certain(reading.numbers, fit, theirs) and reading.possible(fit.theta)):
            return None
        for model in rivals:
            _, held = self._first_fold(model, setting)
            share = max(share, left / held.squares(scales))
            if not fitting.gains(held, theirs) or not share < (diagnosis.DAMPED if reading.numbers else FREER):
                return None
        return Freedom(
            reading.cause.said, reading.remedy(fit.theta), share, *reading.test(fit.theta, fit.states.T, scales)
        )

    def _affords_field(self, model: Field) -> bool:
        return model.n <= MOST_TERMS and self.numbers > 2 * model.n

    def bootstrap(self, n: int, session: Session) -> Replicas:
        """Fit the chosen model to trajectories that are drawn anew, n times, or two at least until the time is up."""
        setting = replace(self.setting, stop=session.deadline.over)
        model = self.best[0].model
        common = model, self.all, setting, self.final.theta, self.seed
        thetas: list[np.ndarray] = []
        for theta in session.each(replica, common, range(n), session.deadline):
            if len(thetas) >= LEAST_REPLICAS and session.deadline.over():  # this one was perhaps cut short
                break
            thetas.append(theta)
        if len(thetas) < n:
            warn(f"The time budget ended the bootstrap after {len(thetas)} of {n} replicas: bands are rough.")
        return Replicas(model, self.final.method, self.final.theta, np.stack(thetas), len(self.all.runs))

    # the flow ---------------------------------------------------------------------------------------------------------

    @cached_property
    def unseen(self) -> list[Any]:
        """Functions that are the same along all orbits, and that the chosen model could depend on in any way."""
        model, d, states = self.best[0].model, self.data.ndof, self.final.states
        if not np.isfinite(states).all() or (self.final.sigma > fitting.SILENT * self.data.scales).any():
            return []
        q, p = range(d), range(d, 2 * d)
        groups: list[tuple[range, Part | None]] = []
        parts = [part for part in model.parts if part.n] if isinstance(model, Model) else []
        if not parts or any(part.of == "y" and not part.inertial for part in parts):
            groups.append((range(2 * d), None))
        else:
            distances = next((part for part in parts if isinstance(part, Distances)), None)
            if distances is not None:
                groups.append((q, distances.squares()))
            elif any(part.of != "p" for part in parts):
                groups.append((q, None))
            if any(part.of != "q" for part in parts):
                groups.append((p, Polynomial.up_to(1, "p", self.data.scales[d:])))
        errors = self._wide(self.final.sigma) * math.sqrt(self.final.fit.states.size / self.data.n_values)
        return [g for columns, part in groups for g in unseen(states, errors, columns, part)]

    def _states(self) -> np.ndarray:
        """The states (n, 2d) of all orbits that do not diverge; those of the data where all do."""
        states = self.final.states
        finite = np.isfinite(states).all(axis=1)
        return states[finite] if finite.any() else self._whole(self.all).states

    def _wide(self, sizes: np.ndarray) -> np.ndarray:
        """Sizes (2d,) of observations as such of states, whose momenta may be wider or narrower than velocities."""
        if not self.data.velocities:
            return sizes
        return sizes * self.final.states.std(axis=0) / self.data.scales

    def _whole(self, data: Trajectories) -> Trajectories:
        """Trajectories of states, by the model that was learned where velocities were observed."""
        if not data.velocities:
            return data
        model, theta = self.best[0].model, self.best[1].theta
        runs = zip(data.runs, data.smooth.states, strict=True)
        return replace(data, runs=tuple(Run(run.t, model.states(theta, y)) for run, y in runs), velocities=False)

    def _domain(self) -> tuple[Box | Tube, np.ndarray]:
        """A box around the states (n, 2d) of all orbits, or a tube where they do not tell H beyond them; and these."""
        states = self._states()
        if self.unseen:
            fitted = next(data for data in (self.all, self.data) if data.n_points == len(states))
            return tube(states, fitted.runs, self._wide(self.all.scales)), states
        low, high = states.min(axis=0), states.max(axis=0)
        wider = MARGIN * (high - low)
        return Box(low - wider, high + wider), states

    def system(self, name: str) -> HamiltonianSystem:
        """The H that was learned."""
        found, model = self.final, self.best[0].model
        domain: Domain
        domain, states = self._domain()
        energies = model.hamiltonian(found.theta, states.T)
        start = 0.0
        options: dict[str, Any] = {}
        frequencies = model.frequencies(found.theta)
        if frequencies:
            period = 2 * math.pi / frequencies[0] if len(frequencies) == 1 else None
            start, options = float(self.all.runs[0].t[0]), {"time": "t", "period": period}
        elif isinstance(domain, Box) and np.isfinite(energies).all():
            top = float(energies.max())
            domain = EnergySublevel(top + MARGIN * (top - float(energies.min())), domain)
        rates, drag = found.theta[model.n - model.forces :], model.force is drags
        if model.forces and not drag:
            options["damping"] = float(rates[0]) if len(rates) == 1 else rates
        t_span = start, start + max(run.span for run in self.data.runs)
        options |= {"name": name, "domain": domain, "y0": states[0], "t_span": t_span, "dt": self.data.time_scale}
        system = HamiltonianSystem.from_sympy(model.expression(found.theta), **options)
        return doubled(system, self._drag, name=name) if drag else system

    @property
    def _drag(self) -> list[str] | None:
        """The forces of quadratic drag that were learned, in words; None without."""
        model, rates = self.best[0].model, self.final.theta
        if model.forces == 0 or model.force is not drags:
            return None
        p = [f"p{i + 1}" if model.ndof > 1 else "p" for i in range(model.ndof)]
        return [f"-{float(c)!r}*abs({x})*{x}" for c, x in zip(rates[-model.forces :], p, strict=True)]

    def flow(self, dt: float | None, name: str, session: Session) -> Any:
        """A flow of the H that was learned, or the flow that was fitted itself."""
        own = self.best[0].model.flow(self.final.theta)
        if own is not None:
            return self._own(own, name)
        system = self.system(name)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            flow = self._primed(system, dt, session) if system.separable else self._collocated(system, dt)
        still = system.autonomous
        if system.separable and still and self._is_worse(flow):
            flow, told = self._collocated(system, dt), []
        for warning in told:
            warn(str(warning.message), warning.category)
        flow.figures = {**flow.figures, **self.figures(flow.dt)}
        whole = still and not isinstance(system, DoubledSystem)
        flow.figures["energy_scatter"] = self.energy_scatter(flow) if whole and not session.deadline.over() else None
        if self._is_worse(flow):
            error, noise = flow.figures["one_step_error"], flow.figures["noise"]
            warn(
                f"The flow is worse than the H that was learned: its one-step error is {error:.1e}, the noise "
                f"{noise:.1e}. Give a longer `time_budget` or a shorter `dt`, or solve `flow.system` with a scheme."
            )
        flow.history = self.history
        physical = system.physical if isinstance(system, DoubledSystem) else system
        scene = {
            "damping": None if physical.damping is None else physical.damping.tolist(),
            "time": None if still else "t",
            "period": physical.period,
            "drag": self._drag,
            "physical": physical.expression,
        }
        flow.recipe = {**flow.recipe, "learned": {**self._learned, **scene}}
        flow.take_learned(system)
        return flow

    @property
    def _learned(self) -> dict[str, Any]:
        return {"model": self.best[0].name, "reason": self.reason, "models": self.history}

    def _own(self, flow: Any, name: str) -> Any:
        """The flow that was fitted itself, with the system of its own Hamiltonian."""
        domain, states = self._domain()
        flow.domain, flow.history = domain, self.history
        flow.recipe = {"learned": {**self._learned, "own_hamiltonian": True}}
        flow.figures = {**self.figures(flow.dt), "energy_scatter": self.energy_scatter(flow)}
        longest = max(run.span for run in self.data.runs)
        flow.take_learned(flow.mean_system(name=name, domain=domain, y0=states[0], t_span=(0.0, longest), dt=flow.dt))
        return flow

    def _primed(self, system: HamiltonianSystem, dt: float | None, session: Session) -> FlowMap:
        options: dict[str, Any] = {"restarts": TABLE_STARTS}
        if session.time_budget is not None:
            options["time_budget"] = max(session.deadline.left, LEAST_SECONDS)
        if self.tested and self.tested[0] is not None:
            options["time_budget"] = min(options.get("time_budget", math.inf), DOUBTFUL_SECONDS)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Training", category=RuntimeWarning)
            return _made(lambda own: train(system, own, progress=session.progress, seed=self.seed, **options), dt)

    def _collocated(self, system: HamiltonianSystem, dt: float | None) -> FlowMap:
        """Steps of a Gauss method, as many as they take where the data are: no fit comes near their accuracy."""
        states, model = self._states(), self.best[0].model
        states = states[np.random.default_rng(self.seed).permutation(len(states))[:STEPPED]]
        slopes = model.field(self.final.theta, states.T, True, False).slope
        rates = np.abs(np.linalg.eigvals(np.moveaxis(np.broadcast_to(slopes, (*slopes.shape[:2], len(states))), -1, 0)))
        step = min(step_of(rates.max(axis=1)), max(run.span for run in self.data.runs))
        if isinstance(system, DoubledSystem):
            return SympFlow.collocated(system, dt=dt or step, steps=DRAG_STEPS)
        return _made(lambda own: SympFlow.collocated(system, dt=own or step, states=states), dt)

    def _is_worse(self, flow: FlowMap) -> bool:
        """True of a flow that is worse than the H it was made of."""
        error, noise = flow.figures.get("one_step_error"), self.noise
        return error is not None and error > max(noise, POOR * float(self.data.scales.min()))

    @property
    def noise(self) -> float:
        """The noise of a value that was observed, in the root mean square of all coordinates."""
        found = self.best[1]
        return float(np.sqrt(np.mean(found.sigma[found.fit.counts > 0] ** 2)))

    def figures(self, dt: float) -> dict[str, float]:
        """The figures of the chosen model on the held-out trajectories, before its last fit to all of them."""
        _, found, held = self.best
        noise = {name: float(found.sigma[i]) for i, name in enumerate(self.data.names) if found.fit.counts[i]}
        made = {
            "held_out_loss": held.loss,
            "held_out_trajectories": len(self.held.runs),
            "residual_correlation": held.correlation,
            "noise": self.noise,
        }
        if self.tested and self.tested[0] is not None:
            made["unconstrained_share"] = self.tested[0].share
        made |= {f"noise_{name}": sigma for name, sigma in noise.items()}
        passed = np.concatenate([run.t - run.t[0] for run in held.pieces])
        residuals = np.concatenate(held.residuals, axis=1)
        seen = np.isfinite(residuals).any(axis=0)
        passed, squares = passed[seen], np.nanmean(residuals[:, seen] ** 2, axis=0)
        for k in HORIZONS:
            near = np.abs(passed - k * dt) <= 0.5 * dt * max(1, k / 10)
            if near.any():
                made[f"held_out_error_{k}"] = float(np.sqrt(squares[near].mean()))
        return made

    def energy_scatter(self, flow: FlowMap) -> float | None:
        """The standard deviation of 𝓗 along a held-out trajectory, in their mean; None where no state is whole."""
        most = len(self.held.runs)
        n = max(min(most, ALONG), SCATTERED * most // self.held.n_points)
        some = self._whole(self.held.subset(np.unique(np.linspace(0, most - 1, n).astype(int)).tolist()))
        runs = [run.y[:, np.isfinite(run.y).all(axis=0)][:, :: -(-some.n_points // SCATTERED)] for run in some.runs]
        energies = self._energy(flow, np.concatenate(runs, axis=1).T)
        along = np.split(energies, np.cumsum([y.shape[1] for y in runs])[:-1])
        scatter = [float(np.std(values)) for values in along if len(values) > 1]
        return float(np.mean(scatter)) if scatter else None

    @staticmethod
    def _energy(flow: FlowMap, states: np.ndarray) -> np.ndarray:
        """𝓗 of the flow at states (n, 2d), averaged over [0, Δt]; with friction H."""
        if flow.system is not None and flow.system.friction:  # the maps of a damped flow have no 𝓗
            return flow.system.hamiltonian(states)
        x = torch.as_tensor(states)
        times = flow.dt * np.arange(OVER_TIMES) / (OVER_TIMES - 1)
        return np.mean([flow.hamiltonian(float(t), x).numpy() for t in times], axis=0)
