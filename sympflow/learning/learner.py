"""learn(): from trajectories to a flow, and to the H behind them."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from sympflow.arguments import check_flag, floats, plain
from sympflow.flow.flow_map import FlowMap
from sympflow.hamiltonian import matrices
from sympflow.hamiltonian.domain import Box, EnergySublevel
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.learning.families import FAMILIES, Candidate, Said, families, pruned, with_unit_mass
from sympflow.learning.fitting import Fitted, Held, Setting, fitted, gains, judged
from sympflow.learning.trajectories import Trajectories
from sympflow.training.session import Path, Session
from sympflow.training.trainer import train
from sympflow.workers import Crew

HELD_OUT = 0.2  # of the trajectories
TABLE_SECONDS = 10.0  # for the numbers of the flow, of a fit of which nothing else is said
TABLE_SHARE = 0.3  # of a time budget, likewise
HORIZONS = (1, 10, 100)  # in Δt, of the held-out errors
MARGIN = 0.05  # of the spread of the states, by which Ω exceeds them
HUBER = 1.5  # σ
LOSSES = ("squares", "huber")
OVER_TIMES = 5  # between 0 and Δt, at which 𝓗 is averaged


def learn(
    trajectories: Any,
    ndof: int | None = None,
    *,
    dt: float | None = None,
    noise: float | ArrayLike | None = None,
    separable: bool | None = None,
    mass: float | ArrayLike | None = None,
    damping: bool | str = False,
    family: str | None = None,
    loss: str = "squares",
    seed: int = 0,
    name: str = "learned",
    checkpoint: Path | None = None,
    resume: Path | None = None,
    time_budget: float | None = None,
    progress: bool | None = None,
    callback: Callable[[int, dict[str, float]], None] | None = None,
    workers: Any = 1,
) -> Any:
    """Learn a flow map from trajectories of a system whose H is not known.

    First H is learned: models of several families, from simple to rich, are fitted by shooting, with the initial state
    of every trajectory, and trajectories that were held out choose among them. Then a flow of that H is trained. All
    noise is taken for independent and normal, of one size for each coordinate.

    Parameters
    ----------
    trajectories
        A list of (t, y), t (n,) and y (2d, n), each with its own times; a pair of arrays t (n,) and y (N, 2d, n); or
        any data that `sympflow.learning.trajectories.Trajectories.read` takes. NaN is what is missing. At least two
        trajectories: a fifth of them is held out.
    ndof : int, optional
        Degrees of freedom d.
    dt : float, optional
        Δt of the flow; the default suits the frequencies of the H that was learned.
    noise : float or array_like of shape (2d,), optional
        Standard deviation of the observations; estimated if not given.
    separable : bool, optional
        True if H = T(p) + V(q) is known, False if it is known not to be; by default the data decide.
    mass : float or array_like of shape (d,) or (d, d), optional
        M of T = ½ pᵀM⁻¹p; learned if not given.
    damping : {False, True, "each"}
        True to learn one rate γ of friction, p' = −∂H/∂q − γp; "each" for one rate for each p.
    family : str, optional
        The only family to be tried, see `sympflow.learning.families.FAMILIES`.
    loss : {"squares", "huber"}
        "huber" for data with outliers.
    seed : int
        Which trajectories are held out, and random starts.
    name : str
        Of the learned system.
    checkpoint, resume, time_budget, progress, callback, workers
        As for `sympflow.train`. A checkpoint is written after each model.

    Returns
    -------
    SympFlow
        With `flow.system`, the H that was learned as an ordinary HamiltonianSystem; `flow.figures`, the errors on held-
        out trajectories and the noise; `flow.recipe["learned"]`, the model and why it was chosen; `flow.history`, a
        record for each model.

    Raises
    ------
    ValueError, TypeError
        If the trajectories are not as they should be, there is only one, they hold fewer numbers than the simplest
        model has, or an argument is not admissible.
    """
    data = Trajectories.read(trajectories, ndof)
    said = _said(data, separable, mass, damping)
    if loss not in LOSSES:
        raise ValueError(f"`loss` must be one of {', '.join(LOSSES)}; got {loss!r}.")
    dt = plain(dt)
    if dt is not None and (isinstance(dt, bool) or not isinstance(dt, int | float) or not 0 < dt < math.inf):
        raise ValueError(f"`dt` must be a positive finite number; got {dt!r}: leave it out for the default.")
    session = Session(checkpoint, resume, plain(time_budget), progress, callback, Crew(workers))
    setting = Setting(_noise(noise, data), HUBER if loss == "huber" else None)
    chosen = families(said, family)
    ours, held = data.split(HELD_OUT, seed)
    search = Search(data, ours, held, said, setting, seed)
    with session.interruption, session.crew:
        search.run(chosen, session)
        return search.flow(dt, name, session)


def _said(data: Trajectories, separable: Any, mass: Any, damping: Any) -> Said:
    if separable is not None:
        check_flag("separable", separable)
    if damping not in (False, True, "each"):
        raise ValueError(
            f'`damping` must be True for one rate that is learned, "each" for one of each p, or False; got {damping!r}.'
        )
    d = data.ndof
    inverse = None
    if mass is not None:
        found = matrices.inverse_mass(mass, d)
        inverse = np.eye(d) if found is None else np.diag(found) if found.ndim == 1 else found
    return Said(data.scales, separable, inverse, 0 if damping is False else 1 if damping is True else d)


def _noise(noise: Any, data: Trajectories) -> np.ndarray | None:
    if noise is None:
        return None
    sigma = floats("noise", noise)
    if sigma.shape not in ((), (2 * data.ndof,)) or not ((sigma >= 0) & (sigma < np.inf)).all():
        raise ValueError(
            f"`noise` must be a standard deviation, 0 or more, or one for each of the {2 * data.ndof} coordinates; got "
            f"{noise!r}: leave it out where it is not known."
        )
    return np.broadcast_to(sigma, 2 * data.ndof).astype(float)


Chosen = tuple[Candidate, Fitted, Held]


@dataclass
class Search:
    """The models that were fitted so far, and the best of them."""

    all: Trajectories
    data: Trajectories
    held: Trajectories
    said: Said
    setting: Setting
    seed: int
    history: list[dict[str, Any]] = field(default_factory=list)
    best: Chosen | None = None
    final: Fitted = field(init=False)
    """The chosen model, fitted to all trajectories."""

    @property
    def winner(self) -> Chosen:
        """The chosen model, as it was fitted without the held-out trajectories."""
        assert self.best is not None
        return self.best

    @property
    def reason(self) -> str:
        """Why this model."""
        held = self.winner[2]
        others = len({record["model"] for record in self.history}) - 1
        because = (
            "its residuals on held-out trajectories are no more than rounding"
            if held.exact
            else "it explains held-out trajectories best, and its residuals are noise: one tells nothing of the next"
            if held.explained
            else f"it explains held-out trajectories best; but its residuals are not noise, for the correlation of one "
            f"with the next is {held.correlation:.2f}"
        )
        return f"{because} (of {others + 1} models)"

    def run(self, names: list[str], session: Session) -> None:
        """Fit models of these families until one explains the held-out trajectories, or no richer one does better."""
        deadline = session.deadline.part(1 - TABLE_SHARE) if session.time_budget is not None else session.deadline
        setting = Setting(self.setting.noise, self.setting.huber, deadline.over)
        for name in names:
            if self.best is None or not (self.best[2].explained or deadline.over()):
                self._climb(name, setting, session)
        if self.best is None:
            raise ValueError(
                f"`trajectories` have {self.data.n_values} numbers, fewer than the simplest model and the initial "
                "states have: give longer trajectories, or more of them."
            )
        if not deadline.over():
            candidate, found, _ = self.winner
            precision = found.fit.normal.precision()
            self._simplify(pruned(candidate, found.theta, precision, self.data.n_values), setting, session)
        if not deadline.over():
            self._simplify(with_unit_mass(self.winner[0], self.said), setting, session)
        candidate, self.final, _ = self.winner
        if not deadline.over():
            self.final = fitted(candidate.model, self.all, setting, self.final.theta)

    def _climb(self, name: str, setting: Setting, session: Session) -> None:
        """Fit the models of a family, until two that follow each other are no better than one before."""
        worse = 0
        for candidate in FAMILIES[name].models(self.said):
            over = self.best is not None and (self.best[2].exact or setting.stop())
            if over or worse == 2 or not self._affords(candidate):
                return
            worse = 0 if self._try(candidate, setting, session) else worse + 1

    def _affords(self, candidate: Candidate) -> bool:
        """True if there are more numbers than the model and the initial states have."""
        return self.data.n_values > candidate.model.n + 2 * self.data.ndof * len(self.data.runs)

    def _fit(self, candidate: Candidate, setting: Setting, session: Session) -> Chosen:
        found = fitted(candidate.model, self.data, setting, seed=self.seed)
        held = judged(found, self.held, self.setting)
        figures = {
            "parameters": candidate.model.n,
            "training_chi2": found.costs[-1],
            "held_out_loss": held.loss,
            "correlation": held.correlation,
            "noise": float(np.mean(found.sigma / self.data.scales)),
        }
        self.history.append({"model": candidate.name, **figures})
        if session.callback is not None:
            session.callback(len(self.history), figures)
        return candidate, found, held

    def _try(self, candidate: Candidate, setting: Setting, session: Session) -> bool:
        """Fit a model; True if it is the best so far."""
        made = self._fit(candidate, setting, session)
        if self.best is None or gains(self.best[2], made[2]):
            self.best = made
            return True
        return False

    def _simplify(self, candidate: Candidate | None, setting: Setting, session: Session) -> None:
        """Fit the best model with fewer numbers, and take that unless what it explains less is worth them."""
        if candidate is None:
            return
        rich, simple = self.winner, self._fit(candidate, setting, session)
        fewer = rich[0].model.n - candidate.model.n
        lost = 2 * (simple[1].loss(rich[1].sigma) - rich[1].loss(rich[1].sigma))
        if simple[2].exact or lost < fewer * math.log(self.data.n_values):
            self.best = simple

    # the flow ---------------------------------------------------------------------------------------------------------

    def system(self, name: str) -> HamiltonianSystem:
        """The H that was learned."""
        found = self.final
        model, states = found.model, found.states
        low, high = states.min(axis=0), states.max(axis=0)
        wider = MARGIN * (high - low)
        box = Box(low - wider, high + wider)
        energies = model.hamiltonian(found.theta, states.T)
        top = float(energies.max())
        rates = found.theta[model.n - model.rates :]
        return HamiltonianSystem.from_sympy(
            model.expression(found.theta),
            damping=None if not model.rates else float(rates[0]) if model.rates == 1 else rates,
            name=name,
            domain=EnergySublevel(top + MARGIN * (top - float(energies.min())), box),
            y0=states[0],
            t_span=(0.0, max(run.span for run in self.data.runs)),
            dt=self.data.time_scale,
        )

    def flow(self, dt: float | None, name: str, session: Session) -> Any:
        """A flow of the H that was learned."""
        system = self.system(name)
        seconds = TABLE_SECONDS if session.time_budget is None else max(session.deadline.left, 1.0)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Training", category=RuntimeWarning)
            flow = train(system, dt, time_budget=seconds, progress=session.progress, seed=self.seed)
        flow.figures = {**flow.figures, **self.figures(flow.dt), "energy_scatter": self.energy_scatter(flow)}
        flow.history = self.history
        learned = {"model": self.winner[0].name, "reason": self.reason, "models": self.history}
        damping = None if system.friction is None else system.friction.damping.tolist()
        flow.recipe = {**flow.recipe, "learned": {**learned, "damping": damping}}
        flow.take_learned(system)
        return flow

    def figures(self, dt: float) -> dict[str, float]:
        """The figures of the chosen model on the held-out trajectories, before its last fit to all of them."""
        _, found, held = self.winner
        made = {
            "held_out_loss": held.loss,
            "held_out_trajectories": len(self.held.runs),
            "residual_correlation": held.correlation,
            "noise": float(np.sqrt(np.mean(found.sigma**2))),
        }
        made |= {f"noise_{name}": float(s) for name, s in zip(self.data.names, found.sigma, strict=True)}
        passed = np.concatenate([run.t - run.t[0] for run in held.pieces])
        squares = np.nanmean(np.concatenate(held.fit.residuals, axis=1) ** 2, axis=0)
        for k in HORIZONS:
            near = np.abs(passed - k * dt) <= 0.5 * dt * max(1, k / 10)
            if near.any():
                made[f"held_out_error_{k}"] = float(np.sqrt(squares[near].mean()))
        return made

    def energy_scatter(self, flow: FlowMap) -> float | None:
        """The standard deviation of 𝓗 along a held-out trajectory, in their mean; None where no state is whole."""
        runs = [run.y[:, np.isfinite(run.y).all(axis=0)] for run in self.held.runs]
        energies = self._energy(flow, np.concatenate(runs, axis=1).T)
        along = np.split(energies, np.cumsum([y.shape[1] for y in runs])[:-1])
        scatter = [float(np.std(values)) for values in along if len(values) > 1]
        return float(np.mean(scatter)) if scatter else None

    @staticmethod
    def _energy(flow: FlowMap, states: np.ndarray) -> np.ndarray:
        """𝓗 of the flow at states (n, 2d), averaged over [0, Δt]."""
        x = torch.as_tensor(states)
        times = flow.dt * np.arange(OVER_TIMES) / (OVER_TIMES - 1)
        return np.mean([flow.hamiltonian(float(t), x).numpy() for t in times], axis=0)
