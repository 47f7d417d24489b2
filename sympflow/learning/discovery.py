"""`discover`: the Hamiltonian behind trajectories, or behind a trained flow, as a sparse sum of terms.

A first model is a regression of smoothed derivatives. From there terms are added and dropped one at a time. Each model
on the way is refined by shooting from latent initial states (`shooting`), so that the noise of the states does not bias
the coefficients; the linearized problem gives the gain by each missing term at once. The extended Bayesian criterion
decides, which counts how many terms there were to choose from.
"""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from sympflow.arguments import check_positive, checked_count, checked_number, plain, warn
from sympflow.flow.flow_map import FlowMap
from sympflow.hamiltonian.domain import Box, Domain, EnergySublevel
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.learning.diagnosis import Reading, best_by_increments, hint
from sympflow.learning.fitting import FORGOTTEN, LAG, SMOOTHED, STEP_ERROR, correlation_of, limit_of, noise_of
from sympflow.learning.library import Library, library_for
from sympflow.learning.orbits import Method
from sympflow.learning.shooting import Fit, Problem, chosen_method, minimized
from sympflow.learning.smoothing import Smooth
from sympflow.learning.trajectories import POINTS, Trajectories, periods_of
from sympflow.learning.unseen import remark_on, tube, unseen
from sympflow.show.cards import cut
from sympflow.show.style import new_figure
from sympflow.training.session import OutOfTime, Session

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RADIANS = 6.0  # Length of the pieces that are shot through, in the mean angular rate of the data: about one period
FLOOR = 1e-6  # least noise, over the spread of a coordinate: below it a formula would explain the errors of the scheme
STEP = 0.1  # Step of the system that is made, in the mean angular rate of the data
STEP_SHARE = 0.02  # Error of the scheme from one point to the next, over the noise
STEPS = 40  # Most steps of a fit
SETTLED = 0.05  # Change of the noise, relative, that ends its estimation
CONVERGED = 1e-7  # Decrease of the squares, relative, at which a fit ends
UNEXPLAINED = 1.3  # Residual over the noise from which a model does not explain the data
QUIET = 0.5  # Residual over the noise that was given, below which that is too large
LOUD = 1.5  # Residual over the noise that is seen without a model, up to which that may be all
BEYOND = 2  # Terms by which the path goes on beyond the model that is chosen
WORTH = 0.5  # Gain of a term by the linear model, over its penalty, from which it is tried
DOUBTED = 8  # Most terms of the only model that is fitted where no H explains the data
SKETCHED = 8  # Steps of the fits of models on the path with fewer terms than the one that was chosen
HOPELESS = 10.0
"""Criterion for each value, above that of the chosen model, at which the path ends: a residual 150 times as large."""
MOST_VALUES = 20_000  # Values to which models are fitted on the way; the one that is chosen is fitted to all
COMPARED = 2000  # States over which terms are compared, and of a flow's Hamiltonian
STARTS = 4  # Regressions from which the search begins at most
HIGHEST = 30  # Degree of polynomials, at most
CORRELATED = 4  # Smoothed slopes that count as one, for their errors are correlated
OF_A_FLOW = 5.0
"""Factor by which the last term of a flow's Hamiltonian lowers the residual at least: a flow's errors are not noise."""


class Regression:
    """y ≈ X θ for few of the columns of X (n, K), of whose n errors some count as independent."""

    def __init__(self, X: np.ndarray, y: np.ndarray, independent: float) -> None:
        self.lengths = np.linalg.norm(X, axis=0)
        self.lengths[self.lengths == 0] = 1.0
        X = X / self.lengths
        self.G, self.b, self.yy = X.T @ X, X.T @ y, float(y @ y)
        self.n = independent
        self.count = len(y)

    @classmethod
    def of_slopes(cls, library: Library, smooth: Smooth, scales: np.ndarray) -> Regression:
        """ẋ ≈ Σ θ_k J∇f_k(x) at smoothed states, each coordinate in its spread."""
        X, y = library.fields(smooth.points) / scales[:, None], (smooth.slopes / scales).ravel()
        return cls(X.reshape(len(y), -1), y, len(y) / CORRELATED)

    @classmethod
    def of_values(cls, library: Library, x: np.ndarray, values: np.ndarray) -> Regression:
        """H ≈ Σ θ_k f_k + const at states x."""
        X = library.values(x)
        return cls(X - X.mean(0), values - values.mean(), len(values))

    def _solve(self, active: list[int]) -> tuple[np.ndarray, float]:
        theta = np.linalg.lstsq(self.G[np.ix_(active, active)], self.b[active], rcond=1e-13)[0]
        left = self.yy - 2 * theta @ self.b[active] + theta @ self.G[np.ix_(active, active)] @ theta
        return theta, max(float(left), 1e-16 * self.yy)

    def coefficients(self, active: list[int]) -> np.ndarray:
        return self._solve(active)[0] / self.lengths[active]

    def errors(self, active: list[int]) -> np.ndarray:
        """Standard errors of the coefficients."""
        variance = self._solve(active)[1] / max(self.n - len(active), 1)
        return np.sqrt(variance * np.diag(np.linalg.pinv(self.G[np.ix_(active, active)]))) / self.lengths[active]

    def misfit(self, active: list[int]) -> float:
        """Root mean square of the residuals."""
        return math.sqrt(self._solve(active)[1] / self.count)

    def criterion(self, active: list[int]) -> float:
        penalty = math.log(max(self.n, 3)) + 2 * math.log(len(self.b))
        return self.n * math.log(self._solve(active)[1] / self.yy) + len(active) * penalty

    def forward(self, most: int, among: Sequence[int] | None = None) -> list[int]:
        """Terms added one at a time, each the one that leaves least, and dropped again while the criterion falls."""
        active: list[int] = []
        usable = range(len(self.b)) if among is None else among
        for _ in range(min(most, len(usable))):
            wider = min(([*active, k] for k in usable if k not in active), key=lambda a: self._solve(a)[1])
            if active and self.criterion(wider) >= self.criterion(active):
                break
            active = wider
            while len(active) > 1:
                fewer = self._fewer(active)
                if self.criterion(fewer) >= self.criterion(active):
                    break
                active = fewer
        return active

    def backward(self, most: int, among: Sequence[int] | None = None) -> list[int]:
        """Terms dropped one at a time from all of them, while the criterion falls or there are more than `most`."""
        active = [*range(len(self.b))] if among is None else [*among]
        while len(active) > 1:
            fewer = self._fewer(active)
            if len(active) <= most and self.criterion(fewer) >= self.criterion(active):
                break
            active = fewer
        return active

    def _fewer(self, active: list[int]) -> list[int]:
        """The model without the term that is missed least."""
        inverse = np.linalg.pinv(self.G[np.ix_(active, active)], rcond=1e-13)
        least = int(np.argmin(self._solve(active)[0] ** 2 / np.maximum(np.diag(inverse), 1e-300)))
        return active[:least] + active[least + 1 :]

    def nested(self, active: list[int]) -> list[list[int]]:
        """Models of one term to all, each with one dropped from the next."""
        path = [active]
        while len(path[0]) > 1:
            path.insert(0, self._fewer(path[0]))
        return path


@dataclass(frozen=True)
class Model:
    """One model of the path.

    Attributes
    ----------
    terms : tuple of sympy.Expr
    coefficients, errors : tuple of float
        θ, and its standard errors.
    residual : float
        Root mean square of the residuals over the noise, of the trajectories that it was fitted to.
    criterion : float
        The extended Bayesian criterion: less is better.
    held_out : float or None
        The same residual of trajectories that no model was fitted to; None where there was no time for it.
    """

    terms: tuple[sp.Expr, ...]
    coefficients: tuple[float, ...]
    errors: tuple[float, ...]
    residual: float
    criterion: float
    held_out: float | None = None


@dataclass(frozen=True)
class Discovery:
    """How a system was discovered: `system.discovery`.

    Attributes
    ----------
    terms : tuple of sympy.Expr
    coefficients, errors : ndarray of shape (k,)
        Their coefficients and standard errors.
    noise : ndarray of shape (2d,)
        The noise of each coordinate: the root mean square of what the model leaves. Of a flow (1,), in units of H.
    expected_noise : ndarray of shape (2d,)
        The noise as it was given, or seen in the data without a model; 0 where this is not possible.
    explains : bool
        False if the model leaves more than noise, or the data do not distinguish it from others: see `unseen`.
    remark : str
        What the data say where no model explains them or many do, or where the noise that was given is too large.
    path : tuple of Model
        The best model of each number of terms.
    library : tuple of sympy.Expr
        The terms there were to choose from.
    superfluous : tuple of sympy.Expr
        The terms of the library that others make up on the data, or that are not finite there.
    unseen : tuple of sympy.Expr
        Functions that are the same at all points of the data, to the noise, so that H is not told along them.
    """

    terms: tuple[sp.Expr, ...]
    coefficients: np.ndarray
    errors: np.ndarray
    noise: np.ndarray
    expected_noise: np.ndarray
    explains: bool
    remark: str
    path: tuple[Model, ...]
    library: tuple[sp.Expr, ...]
    superfluous: tuple[sp.Expr, ...] = field(repr=False)
    unseen: tuple[sp.Expr, ...] = ()

    def formula(self) -> str:
        """H with its coefficients, rounded to their standard errors."""
        parts: list[str] = []
        for f, c, error in zip(self.terms, self.coefficients, self.errors, strict=True):
            sign = "- " if c < 0 else "+ " if parts else ""
            parts.append(f"{sign}{rounded(abs(c), error)}*{f'({f})' if f.is_Add else f}")
        return " ".join(parts)

    def table(self) -> str:
        """The terms with their coefficients and errors, then the path, as text."""
        width = max(len(str(f)) for f in self.terms)
        lines = [f"H = {self.formula()}", "", f"{'term':<{width}}  coefficient   standard error"]
        for f, c, error in zip(self.terms, self.coefficients, self.errors, strict=True):
            lines.append(f"{f!s:<{width}}  {c:< 12.6g}  {error:.2g}")
        lines += ["", "terms  residual/noise  held out  criterion"]
        for model in self.path:
            held = "" if model.held_out is None else f"{model.held_out:.4g}"
            chosen = "  <- chosen" if len(model.terms) == len(self.terms) else ""
            lines.append(f"{len(model.terms):>5}  {model.residual:<14.4g}  {held:<8}  {model.criterion:.6g}{chosen}")
        return "\n".join([*lines, *([self.remark] if self.remark else [])])

    def figure(self) -> Figure:
        """The path of models: the residual over the noise against the number of terms."""
        figure = new_figure(6.4, 3.6)
        ax = figure.add_subplot()
        counts = [len(model.terms) for model in self.path]
        ax.plot(counts, [model.residual for model in self.path], "o-", color="#0072B2", label="fitted trajectories")
        held = [math.nan if model.held_out is None else model.held_out for model in self.path]
        if not np.isnan(held).any():
            ax.plot(counts, held, "s--", color="#D55E00", label="held out")
        ax.axvline(len(self.terms), color="#333333", lw=0.8, ls=":")
        chosen = next(model for model in self.path if len(model.terms) == len(self.terms))
        ax.annotate(
            f"chosen: {len(self.terms)} terms", (len(self.terms), chosen.residual), (6, 18), textcoords="offset points"
        )
        ax.axhline(1.0, color="#999999", lw=0.8)
        ax.set(xlabel="number of terms", ylabel="residual / noise", yscale="log")
        ax.set_xticks(counts)
        ax.grid(alpha=0.3, which="both")
        ax.legend(frameon=False)
        return figure


class DiscoveredSystem(HamiltonianSystem):
    """A HamiltonianSystem that was found by `discover`; `discovery` is the record of it."""

    discovery: Discovery

    def __repr__(self) -> str:
        return f"{super().__repr__()[:-1]}, H = {cut(str(self.expression))}>"


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # models that cannot be right diverge
def discover(
    data: Any,
    terms: str | sp.Expr | Sequence[str | sp.Expr] | None = None,
    *,
    ndof: int | None = None,
    degree: int = 4,
    noise: float | ArrayLike | None = None,
    held_out: float = 0.2,
    piece: float | None = None,
    loss: str = "squares",
    most_terms: int = 40,
    domain: Domain | None = None,
    seed: int = 0,
    name: str = "discovered",
    time_budget: float | None = None,
    progress: bool | Callable[[str], None] | None = None,
    **reading: Any,
) -> DiscoveredSystem:
    """Find a sparse H(q, p) = Σ θ_k f_k(q, p) behind trajectories, or behind a trained flow.

    H has no constant term. It is in the units of the data.

    Parameters
    ----------
    data : FlowMap, or anything that `Trajectories.read` takes
        For a flow its Hamiltonian 𝓗(ψ̄)(t, x) is used, averaged over t ∈ [0, Δt].
    terms : str, sympy.Expr or sequence of these, optional
        The library: expressions in q1 … qd, p1 … pd, and the names "polynomials", "trigonometric", "distances"; all
        three by default. For three or more degrees of freedom polynomials depend on one or two of these.
    ndof : int, optional
    degree : int
        The highest degree of polynomials.
    noise : float or array_like of shape (2d,), optional
        The standard deviation of the noise of each coordinate; by default it is estimated.
    held_out : float
        Share of trajectories that are held out of the fits until a model is chosen; 0 for none.
    piece : float, optional
        The longest time of a shooting segment, integrated from one latent state: for chaotic data one or two Lyapunov
        times. The default is about one period.
    loss : {"squares", "huber"}
        "huber" for data with outliers.
    most_terms : int
        The most terms of a model.
    domain : Domain, optional
        For a flow: where its Hamiltonian is evaluated; the default is its own domain. For data: the domain of the
        system that is returned; the default is a box around the data, or a tube around one trajectory where the data
        determine H only near it.
    seed : int
        Seed of the choice of the held-out trajectories.
    name : str
        Of the system.
    time_budget : float, optional
        Seconds, after which the best model so far is taken; Ctrl-C ends the search likewise.
    progress : bool or callable, optional
        True to print each model that is tried, as by default on a terminal; or a function that is called with each
        line.
    **reading
        Options of `Trajectories.read`, such as `units` and `order`.

    Returns
    -------
    DiscoveredSystem
        An ordinary system, to be solved and trained on; `system.discovery` has the coefficients with their standard
        errors, the noise, and the models that were tried, with a figure.

    Warns
    -----
    UserWarning
        If the residuals of all models are larger than the noise: the message says by how much, and the likely reason,
        such as friction, velocities in place of momenta, or columns in another order. If a function of the coordinates
        is constant on the data, as on circular orbits of one radius: any function of it may be added to H. If the given
        noise is much larger than the residuals. If the time budget ended the search.

    Raises
    ------
    ValueError
        If there are fewer values than terms, or data or terms cannot be read.

    References
    ----------
    .. [1] S. L. Brunton, J. L. Proctor, J. N. Kutz, Discovering governing equations from data by sparse identification
       of nonlinear dynamical systems, PNAS 113 (2016) 3932–3937, for the first regression.
    .. [2] J. Chen, Z. Chen, Extended Bayesian information criteria for model selection with large model spaces,
       Biometrika 95 (2008) 759–771.
    """
    shown = None if callable(progress) else plain(progress)
    if not (shown is None or isinstance(shown, bool)):
        raise TypeError(f"`progress` must be True, False or a function of a line of text; got {progress!r}.")
    session = Session(time_budget=plain(time_budget), progress=False if callable(progress) else shown)
    if isinstance(data, FlowMap):
        if reading or noise is not None:
            raise TypeError(f"`{next(iter(reading), 'noise')}` is of trajectories, and `data` is a flow: leave it out.")
        return _of_flow(data, terms, degree, most_terms, domain, seed, name)
    trajectories = Trajectories.read(data, ndof, **reading)
    if trajectories.velocities:
        raise ValueError('`observed` must be "qp" for `discover`: pass `velocity_mass`, or find the masses by `learn`.')
    trajectories.check_moving()
    period = reading.get("period")
    trajectories.check_angles(None if period is None else np.isinf(periods_of(period, trajectories.ndof)))
    checked_number("held_out", held_out, "at least 0 and less than 1, as 0.2", lambda share: 0 <= share < 1)
    if piece is not None:
        check_positive("piece", piece)
    degree = checked_count("degree", plain(degree), 1, HIGHEST, f"an integer from 1 to {HIGHEST}")
    most_terms = checked_count("most_terms", plain(most_terms), 1, sys.maxsize, "an integer, 1 or more")
    seed = checked_count("seed", plain(seed), 0, sys.maxsize, "an integer, 0 or more")
    huber = limit_of(loss)
    options = terms, degree, noise, held_out, piece, huber, most_terms, seed
    with session.interruption, session.bar(None, "Models") as bar:
        models = itertools.count(1)
        say = progress if callable(progress) else lambda line: bar.tries(next(models), cut(line))
        search = _Search(trajectories, *options, session, say)
        discovery = search.run()
    box = np.array([trajectories.states.min(0), trajectories.states.max(0)])
    first = max(trajectories.runs, key=lambda run: run.span)
    around = search.tube or Box(box[0].tolist(), box[1].tolist())
    scene = {"domain": domain or around, "y0": trajectories.states[0]}
    system = _system(discovery, trajectories.ndof, name=name, t_span=(0.0, first.span), dt=STEP / search.rate, **scene)
    if discovery.remark:
        warn(discovery.remark)
    return system


def _system(discovery: Discovery, ndof: int, **scene: Any) -> DiscoveredSystem:
    H = Library(discovery.terms, ndof).hamiltonian(discovery.coefficients)
    system = cast(DiscoveredSystem, DiscoveredSystem.from_sympy(H, **scene))
    system.discovery = discovery
    return system


# from trajectories ----------------------------------------------------------------------------------------------------


class _Search:
    """The search for a model of trajectories."""

    def __init__(
        self,
        data: Trajectories,
        terms: Any,
        degree: int,
        noise: Any,
        held_out: float,
        piece: float | None,
        huber: float | None,
        most_terms: int,
        seed: int,
        session: Session,
        say: Callable[[str], None],
    ) -> None:
        self.session, self.over, self.say = session, session.deadline.over, say
        self.doubt: Reading | None = None
        self.tube: Domain | None = None
        self.data, self.most_terms, self.huber = data, most_terms, huber
        self.known = noise_of(noise, data.ndof)
        n = len(data.runs)
        drawn = np.random.default_rng(seed).permutation(n).tolist()
        count = min(round(held_out * n), n - 1) if n > 4 else 0
        self.held, rest = sorted(drawn[:count]), drawn[count:]
        values = np.cumsum([data.runs[i].y.size for i in rest])
        self.fitted = sorted(rest[: max(int(np.searchsorted(values, MOST_VALUES)), 1)])
        self.smooth = data.smooth
        self.expected = self.smooth.sigma if self.known is None else self.known
        points = self.smooth.points
        if not len(points):
            raise ValueError("`data` has no two successive points with all values: discover needs whole states.")
        self.shown = points[np.random.default_rng(seed).permutation(len(points))[:COMPARED]]
        library, self.superfluous = library_for(terms, data.ndof, degree, self.shown)
        self.library = library.by_kind()
        K = len(self.library)
        if not K:
            raise ValueError("`terms` has no term that changes over the data: give others.")
        equations = data.n_values - 2 * data.ndof * n
        asked = K + len(self.superfluous)
        if equations < asked:
            raise ValueError(
                f"`data` has {data.n_values} values, {equations} beside the initial states, and the library {asked} "
                "terms: give more data, or fewer `terms`, as by `degree=2` or a list of your own."
            )
        self.floor = FLOOR * data.scales
        self.penalty = math.log(max(data.n_values, 3)) + 2 * math.log(K)
        self.rate = float(np.sqrt(np.mean((self.smooth.slopes / data.scales) ** 2)))
        self.rate = max(self.rate, 1e-3 / max(run.span for run in data.runs))
        self.piece = RADIANS / self.rate if piece is None else piece
        self.refined = 0
        self._begin()

    def _begin(self) -> None:
        """Cut the trajectories into pieces, and forget all fits."""
        self.pieces, self.starts = self._cut(self.fitted)
        self.methods: dict[bool, Method] = {}
        self.fits: dict[frozenset[int], Fit | None] = {}

    def _cut(self, index: Sequence[int]) -> tuple[Trajectories, np.ndarray]:
        """Pieces of some trajectories, and the smoothed states (P, 2d) at their starts."""
        pieces = self.data.subset(index).pieces(span=self.piece)
        states = np.concatenate([self.smooth.states[i] for i in index], axis=1)
        return pieces, states[:, pieces.begins].T

    def run(self) -> Discovery:
        sigma = self.known if self.known is not None else np.maximum(self.smooth.sigma, 1e-2 * self.data.scales)
        self.sigma = np.maximum(sigma, self.floor)
        self.doubt = self._doubted()
        if self.doubt is not None:
            chosen = self._first(DOUBTED, SKETCHED)
            record = self._record(chosen, [chosen])
            if not (record.explains or record.unseen):
                return record
            self.doubt = None
            self._begin()
        chosen = self._steps(self._first(self.most_terms, STEPS))
        for _ in range(3):  # steps short enough for the model that was found
            fit = self._known(chosen)
            if fit.step_error(fit.problem.sigma) <= STEP_ERROR or self.over():
                break
            self.refined += 1
            self.guess = dict(zip(chosen, fit.theta, strict=True))
            self._begin()
            chosen = self._steps(chosen)
        return self._record(chosen, self._path(chosen))

    def _doubted(self) -> Reading | None:
        """Another explanation of the data, that leaves much less of increments than all terms; None for none."""
        whole = self.data if len(self.data.runs) > 1 else self.data.pieces(POINTS)
        if len(whole.runs) < 2:
            return None
        common, _ = library_for(None, self.data.ndof, 4, self.shown)
        models = [self.library.model(), common.by_kind().model()]
        found = best_by_increments(*whole.split(), models, stop=self.over)
        return None if found is None else found[1]

    def _first(self, most: int, steps: int) -> list[int]:
        """The best model of several regressions whose predictions do not diverge; pieces are shortened until it is so.

        Where terms are nearly alike, as cosines, powers and distances, adding them one at a time ends elsewhere than
        dropping them, and than the same among a part of the library. The best of the regressions are fitted.
        """
        regression = Regression.of_slopes(self.library, self.smooth, self.data.scales)
        most = min(most, self.most_terms)
        found = [regression.forward(most)]
        for part in self._parts():
            found += [way(most, part) for way in (regression.forward, regression.backward) if not self.over()]
        different = [[*way] for way in {tuple(sorted(active)) for active in found}]
        ways = sorted(different, key=regression.criterion)[:STARTS]
        for _ in range(8):
            possible = []
            for active in ways:
                self.guess = dict(zip(active, regression.coefficients(active), strict=True))
                if self._fit(active, steps=steps) is not None:
                    possible.append(active)
            if possible:
                return min(possible, key=self._criterion)
            self.piece /= 2
            self._begin()
        raise ValueError(
            "`data` cannot be followed by any model of the library, however short the pieces: give other `terms`, or "
            "look whether the columns are q1 … qd, p1 … pd."
        )

    def _parts(self) -> list[list[int]]:
        """Parts of the library: powers, waves and others in turn, with any kinetic energy and with ½ pᵀM⁻¹p."""
        terms = self.library.expressions
        degree = np.array([sp.Poly(f).total_degree() if f.is_polynomial() else 0 for f in terms])
        kind = np.array(self.library.kinds)
        power, wave = degree > 0, np.array([f.has(sp.cos, sp.sin) for f in terms])
        square = power & (degree <= 2)
        shapes = np.stack([power | True, power, ~wave, square | ~(power | wave), square | wave, square])
        parts = np.unique(np.concatenate([shapes, shapes & ((kind == "q") | (kind == "p") & square)]), axis=0)
        return [np.flatnonzero(part).tolist() for part in parts if part.any()]

    def _known(self, active: Sequence[int]) -> Fit:
        """The fit of a model that was fitted, and did not diverge."""
        fit = self.fits[frozenset(active)]
        assert fit is not None
        return fit

    def _problem(self, active: Sequence[int], theta: np.ndarray, sigma: np.ndarray) -> Problem:
        """Shooting for some of the terms; the scheme and its step are chosen once for separable H, once for others."""
        model = self.library.subset(active).model()
        if model.separable not in self.methods:
            noise = np.maximum(self.expected, self.floor)
            method = chosen_method(model, theta, self.pieces, STEP_SHARE * noise, stop=self._stop)
            self.methods[model.separable] = replace(method, longest=method.longest / 2**self.refined)
        return Problem(model, self.pieces, self.methods[model.separable], sigma, huber=self.huber)

    def _minimized(self, problem: Problem, theta: np.ndarray, states: np.ndarray, steps: int = STEPS) -> Fit | None:
        """The minimum, where the noise is estimated unless it is known; None if orbits diverge."""
        for _ in range(1 if self.known is not None else 5 if steps == STEPS else 2):
            fit = minimized(problem, theta, states, iterations=steps, gain=CONVERGED, patience=1, stop=self._stop)
            if not math.isfinite(fit.cost):
                return None
            found = np.maximum(fit.noise(), self.floor)
            settled = np.abs(np.log(found / problem.sigma)).max() < SETTLED
            problem, theta, states = replace(problem, sigma=found), fit.theta, fit.states
            if settled or self._stop():
                break
        return fit

    def _stop(self) -> bool:
        """True if the time is up and there is a model."""
        return any(fit is not None for fit in self.fits.values()) and self.over()

    def _fit(self, active: Sequence[int], origin: Sequence[int] | None = None, steps: int = STEPS) -> Fit | None:
        """The fit of the terms, in ascending order, from that of others if these are given; None if it diverges."""
        key = frozenset(active)
        if key not in self.fits:
            self.fits[key] = self._fitted(active, origin, steps)
            self._tell(active)
        return self.fits[key]

    def _fitted(self, active: Sequence[int], origin: Sequence[int] | None, steps: int) -> Fit | None:
        if origin is None:
            theta = np.array([self.guess.get(k, 0.0) for k in active])
            return self._minimized(self._problem(active, theta, self.sigma), theta, self.starts, steps)
        before = self._known(origin)
        theta = self._carried(active, origin, before)
        problem = self._problem(active, theta, before.problem.sigma)
        fits = (self._minimized(problem, theta, states, steps) for states in (before.states, self.starts))
        return next(filter(None, fits), None)

    def _tell(self, active: Sequence[int]) -> None:
        fit = self.fits[frozenset(active)]
        if fit is not None:
            said = " ".join(f"{c:+.4g}*{self.library.expressions[k]}" for k, c in zip(active, fit.theta, strict=True))
            self.say(f"{len(active)} terms, criterion {self._criterion(active):.6g}: {said}")

    @staticmethod
    def _carried(active: Sequence[int], origin: Sequence[int], before: Fit) -> np.ndarray:
        """θ of some terms where the squares of a model with others are least, by their quadratic approximation."""
        dropped = np.array([k not in active for k in origin])
        kept = dict(zip(origin, before.without(dropped, before.theta), strict=True))
        return np.array([kept.get(k, 0.0) for k in active])

    def _criterion(self, active: Sequence[int]) -> float:
        fit = self.fits[frozenset(active)]
        if fit is None:
            return math.inf
        if self.known is not None:
            misfit = fit.cost
        else:
            counts = np.maximum(fit.counts - len(self.starts), 1)  # less the latent states
            shares = fit.counts / counts * fit.variances
            misfit = float((counts * np.log(np.maximum(shares, self.floor**2) / self.data.scales**2)).sum())
        return misfit + len(active) * self.penalty

    def _steps(self, active: list[int]) -> list[int]:
        """Terms added and dropped while the criterion falls."""
        self._fit(active)
        for _ in range(4 * self.most_terms):
            if self.over():
                break
            dropped = self._without_least(active)
            if dropped is not None and self._criterion(dropped) < self._criterion(active):
                active = dropped
                continue
            added = self._with_best(active)
            if added is None or self._criterion(added) >= self._criterion(active):
                return active
            active = added
        return active

    def _without_least(self, active: list[int], steps: int = STEPS) -> list[int] | None:
        """The model without its least significant term."""
        fit = self.fits[frozenset(active)]
        if fit is None or len(active) < 2:
            return None
        significance = fit.theta**2 / np.maximum(np.diag(fit.covariance()), 1e-300)
        for weakest in np.argsort(significance)[:2]:
            rest = [k for i, k in enumerate(active) if i != weakest]
            known = frozenset(rest) in self.fits
            made = self._fit(rest, active, steps)
            promised = self._criterion(active) - self.penalty + significance[weakest]
            worse = self._criterion(rest) > promised + WORTH * self.penalty
            if known and worse and significance[weakest] < self.penalty:
                made = self._again(rest, active, steps)  # a former fit from elsewhere ended too early, or elsewhere
            if made is not None:
                return rest
        return None

    def _again(self, active: Sequence[int], origin: Sequence[int], steps: int) -> Fit | None:
        """The better of the former fit of the terms and one from that of others."""
        key, former = frozenset(active), self._criterion(active)
        kept = self.fits[key]
        self.fits[key] = self._fitted(active, origin, steps)
        if not self._criterion(active) < former:
            self.fits[key] = kept
        self._tell(active)
        return self.fits[key]

    def _with_best(self, active: list[int], anyhow: bool = False) -> list[int] | None:
        """The model with the term that gains most by the linearized problem; None if none is worth it."""
        fit = self.fits[frozenset(active)]
        others = [k for k in range(len(self.library)) if k not in active]
        if fit is None or not others or len(active) >= self.most_terms:
            return None
        gains = self._gains(active, fit)
        least = 0.0 if anyhow else WORTH * self.penalty
        best = [int(k) for k in np.argsort(gains)[::-1][: 1 if anyhow else 3] if gains[k] > least]
        found: list[int] | None = None
        for k in best:
            wider = sorted([*active, k])
            made = self._fit(wider, active)
            if made is not None and (found is None or self._criterion(wider) < self._criterion(found)):
                found = wider
            if found is not None and self._criterion(found) < self._criterion(active):
                break
        return found

    def _gains(self, active: list[int], fit: Fit) -> np.ndarray:
        """The decrease of the squares by each term of the library beside those of a model, by the linear problem."""
        K = len(self.library)
        theta, fitted = np.zeros(K), np.isin(np.arange(K), active)
        theta[fitted] = fit.theta
        whole = self._problem(range(K), theta, fit.problem.sigma)
        try:
            return whole.normal(theta, fit.states, self._stop).gains(fitted)
        except (np.linalg.LinAlgError, OutOfTime):
            return np.zeros(K)

    # the path, and the record -----------------------------------------------------------------------------------

    def _path(self, chosen: list[int]) -> list[list[int]]:
        """The best models of each number of terms, after those on the way from the chosen one were fitted."""
        active = chosen
        while not self.over() and (rest := self._without_least(active, SKETCHED)) is not None:
            active = rest
            if self._criterion(active) > self._criterion(chosen) + HOPELESS * self.pieces.n_values:
                break
        active = chosen
        for _ in range(BEYOND):
            wider = None if self.over() else self._with_best(active, anyhow=True)
            if wider is None:
                break
            active = wider
        return self._met(chosen)

    def _met(self, chosen: list[int]) -> list[list[int]]:
        """The best model of each number of terms among those that were fitted."""
        best: dict[int, list[int]] = {len(chosen): chosen}
        for key, fit in self.fits.items():
            if fit is None or len(key) > len(chosen) + BEYOND or len(key) == len(chosen):
                continue
            if len(key) not in best or self._criterion([*key]) < self._criterion(best[len(key)]):
                best[len(key)] = sorted(key)
        return [best[n] for n in sorted(best)]

    def _record(self, chosen: list[int], path: list[list[int]]) -> Discovery:
        best = self._known(chosen)
        sigma = np.maximum(best.noise(), self.floor) if self.known is None else best.problem.sigma
        held_out = self._cut(self.held) if self.held else None
        models = tuple(self._model(active, sigma, held_out) for active in path)
        fit = self._chosen_fit(chosen)
        noise = np.maximum(fit.noise(), self.floor)
        excess = noise / np.maximum(self.expected, self.floor)
        windows = self.data.n_points / len(self.data.runs) >= 6
        told = (self.expected > 0) & (windows or self.known is not None)
        limit = UNEXPLAINED + 4 / math.sqrt(max(self.data.n_points, 1))
        explains = not (told & (excess > limit)).any()
        explains &= bool((noise < 0.5 * self.data.scales).all())
        same = self._unseen(chosen, fit) if explains else ()
        explains &= not same
        remark = remark_on(same) if same else self._too_loud(noise) if explains else self._remark(fit, noise, excess)
        if self.session.cut:
            remark = f"{remark} The time budget, or Ctrl-C, ended the search: give it more.".strip()
        found = Discovery(
            terms=self.library.subset(chosen).expressions,
            coefficients=fit.theta,
            errors=np.sqrt(np.diag(fit.covariance())),
            noise=noise,
            expected_noise=self.expected,
            explains=explains,
            remark=remark,
            path=models,
            library=self.library.expressions,
            superfluous=self.superfluous,
            unseen=same,
        )
        return _in_order(found)

    def _unseen(self, chosen: list[int], fit: Fit) -> tuple[sp.Expr, ...]:
        """Functions that are the same along all orbits: of q alone and of p alone where H is separable."""
        d = self.data.ndof
        states = np.concatenate(fit.orbits, axis=1).T
        errors = fit.noise() * math.sqrt(fit.states.size / fit.counts.sum())
        separable = all(self.library.kinds[k] != "y" for k in chosen)
        groups = [range(d), range(d, 2 * d)] if separable else [range(2 * d)]
        found = tuple(g for columns in groups for g in unseen(states, errors, columns))
        if found:
            index = self.fitted if fit is self._known(chosen) else range(len(self.data.runs))
            self.tube = tube(states, [self.data.runs[i] for i in index], self.data.scales)
        return found

    def _chosen_fit(self, chosen: list[int]) -> Fit:
        """The chosen model, fitted to all trajectories."""
        fit = self._known(chosen)
        if len(self.fitted) == len(self.data.runs):
            return fit
        pieces, states = self._cut(range(len(self.data.runs)))
        return self._minimized(replace(fit.problem, data=pieces), fit.theta, states) or fit

    def _model(self, active: list[int], sigma: np.ndarray, held_out: tuple[Trajectories, np.ndarray] | None) -> Model:
        fit = self._known(active)
        problem = replace(fit.problem, sigma=sigma)
        held = None
        if held_out is not None and not self.over():
            pieces, states = held_out
            frozen = replace(problem, data=pieces, frozen=True)
            followed = minimized(frozen, fit.theta, states, gain=CONVERGED, stop=self.over)
            held = None if self.over() else _residual(followed.cost, pieces.n_values - states.size)
        return Model(
            self.library.subset(active).expressions,
            tuple(fit.theta.tolist()),
            tuple(np.sqrt(np.diag(fit.covariance())).tolist()),
            _residual(problem.cost(fit.theta, fit.states), self.pieces.n_values - fit.states.size - len(active)),
            self._criterion(active),
            held,
        )

    def _too_loud(self, noise: np.ndarray) -> str:
        """The remark that the noise which was given is too large, if it is."""
        if self.known is None or not (noise < QUIET * self.known).all():
            return ""
        return (
            f"The model leaves {float((noise / self.known).max()):.2g} of the `noise` that was given, or less: leave "
            "that out, or give what is left, `discovery.noise`; small terms may be missing."
        )

    def _remark(self, fit: Fit, noise: np.ndarray, excess: np.ndarray) -> str:
        worst = int(np.argmax(excess))
        otherwise = "Give other `terms`, a higher `degree`, or the `noise` if it is larger than it looks."
        if self.known is not None and noise[worst] < LOUD * self.smooth.sigma[worst]:
            otherwise = (
                f"But without any model the data show noise of up to {self.smooth.sigma[worst]:.2g} there: leave "
                "`noise` out, or give that."
            )
        runs, lag = fit.problem.data.runs, LAG / self.rate
        near, later = (correlation_of(runs, fit.residuals, noise, after)[0] for after in (0.0, lag))
        if near > SMOOTHED and abs(later) < FORGOTTEN:
            otherwise = (
                f"What it leaves is alike from one point to the next, by a correlation of {near:.2f}, and forgotten "
                f"{lag:.2g} later, as noise of data that were smoothed: give the data as they were measured, or what "
                "is left as `noise`."
            )
        found = hint(self.library, self.smooth, self.data)
        if found is None and self.doubt is not None:
            said, share = self.doubt.cause.said, self.doubt.share
            found = f"Of increments of trajectories {said} leaves {share:.1e} of the squares."
            if self.doubt.theta is not None and self.doubt.possible(self.doubt.theta):
                found = f"{found} {self.doubt.remedy(self.doubt.theta)}".strip()
        return (
            f"No sparse Hamiltonian of the library's {len(self.library)} terms explains the data: of "
            f"{self.data.names[worst]} it leaves {noise[worst]:.3g}, {excess[worst]:.1f} times the noise. "
            f"{found or otherwise} The best model and the path to it are in `system.discovery`."
        )


def _in_order(found: Discovery) -> Discovery:
    """The same with its terms in the order of their names."""
    order = np.argsort([str(f) for f in found.terms])
    terms = tuple(found.terms[i] for i in order)
    return replace(found, terms=terms, coefficients=found.coefficients[order], errors=found.errors[order])


def _residual(cost: float, freedom: int) -> float:
    """The root mean square of the residuals over the noise."""
    return math.sqrt(cost / max(freedom, 1))


def rounded(value: float, error: float) -> str:
    """A number to two digits of its error, at most six in all."""
    if not (error > 0 and math.isfinite(error)) or value == 0:
        return f"{value:.6g}"
    digits = min(max(math.floor(math.log10(value)) - math.floor(math.log10(error)) + 2, 1), 8)
    return f"{value:.{digits}g}"


# from a flow ----------------------------------------------------------------------------------------------------------


def _of_flow(
    flow: FlowMap, terms: Any, degree: int, most_terms: int, domain: Domain | None, seed: int, name: str
) -> DiscoveredSystem:
    import torch

    found = domain or (flow.domain_for(flow.system) if flow.system is not None else flow.domain)
    if found is None:
        raise ValueError("`domain` is needed, because the flow has none: give a Box of the states it was trained on.")
    if isinstance(found, EnergySublevel) and found.hamiltonian is None:
        raise ValueError(
            "`domain` is needed, because the flow's own is defined by the energy of its system: pass system.domain."
        )
    x = found.sample(COMPARED, seed)
    nodes, weights = np.polynomial.legendre.leggauss(5)
    with torch.no_grad():
        at = torch.as_tensor(x, dtype=flow.dtype, device=flow.device)
        values = sum(
            w / 2 * flow.hamiltonian((1 + u) / 2 * flow.dt, at).double().cpu().numpy()
            for u, w in zip(nodes.tolist(), weights.tolist(), strict=True)
        )
    library, superfluous = library_for(terms, flow.ndof, degree, x)
    regression = Regression.of_values(library, x, np.asarray(values))
    path = regression.nested(regression.forward(most_terms))
    misfits = [regression.misfit(active) for active in path]
    chosen = max((i for i in range(1, len(path)) if misfits[i - 1] > OF_A_FLOW * misfits[i]), default=len(path) - 1)

    models = tuple(
        Model(
            library.subset(active).expressions,
            tuple(regression.coefficients(active).tolist()),
            tuple(regression.errors(active).tolist()),
            r / max(misfits[chosen], 1e-300),
            regression.criterion(active),
        )
        for active, r in zip(path, misfits, strict=True)
    )
    best = models[chosen]
    spread = float(np.std(values))
    explains = misfits[chosen] < 0.05 * spread
    remark = "" if explains else (
        f"No sparse sum of the library's {len(library)} terms is the flow's Hamiltonian: {misfits[chosen]:.3g} is left "
        f"of its spread {spread:.3g}. Give other `terms`, or a smaller `domain`."
    )  # fmt: skip
    record = Discovery(
        terms=best.terms,
        coefficients=np.array(best.coefficients),
        errors=np.array(best.errors),
        noise=np.array([misfits[chosen]]),
        expected_noise=np.zeros(1),
        explains=explains,
        remark=remark,
        path=models,
        library=library.expressions,
        superfluous=superfluous,
    )
    discovery = _in_order(record)
    system = _system(discovery, flow.ndof, name=name, domain=found, y0=x[0], dt=flow.dt / 10)
    if not explains:
        warn(remark)
    return system
