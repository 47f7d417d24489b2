"""learn(): from trajectories to a flow, and to the H behind them."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import check_dt, check_flag, checked_count, floats, plain
from sympflow.hamiltonian.linear_part import checked_inverse_mass
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.learning.families import Constraints, families
from sympflow.learning.fitting import LAG, Setting, limit_of, noise_of
from sympflow.learning.library import Library, Terms, coordinates_of
from sympflow.learning.models import drags, friction, frictions
from sympflow.learning.parts import Fixed
from sympflow.learning.search import Search, frequencies_of
from sympflow.learning.trajectories import FEW, Trajectories, periods_of
from sympflow.storage.identity import digest
from sympflow.training.session import Path, Session
from sympflow.workers import WorkerPool

HELD_OUT = 0.2  # of the trajectories
TIME_BUDGET = 60.0  # seconds
WIDE = 32  # trajectories from which orbits side by side cost no more than their steps; of fewer long ones are cut
LONG_POINTS, LONG = 100, 12.0  # points, and times in which states move by their spread, that the pieces have at least
ALONE = 24  # points of the pieces of a trajectory that is the only one, at least
MOST_VALUES = 40_000  # numbers observed by which models are chosen; the chosen one is fitted to all
ROUGH = 60  # points from which the roughness of the data tells their noise to a fifth
DAMPINGS: dict[Any, Any] = {False: None, True: friction, "each": frictions, "quadratic": drags}


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # models that cannot be right diverge
def learn(
    trajectories: Any,
    ndof: int | None = None,
    *,
    dt: float | None = None,
    noise: float | ArrayLike | None = None,
    separable: bool | None = None,
    mass: float | ArrayLike | None = None,
    damping: bool | str = False,
    drive: bool | float | Sequence[float] = False,
    period: float | ArrayLike | None = None,
    known: HamiltonianSystem | None = None,
    family: str | None = None,
    loss: str = "squares",
    replicas: int = 0,
    seed: int = 0,
    name: str = "learned",
    checkpoint: Path | None = None,
    resume: Path | None = None,
    time_budget: float | None = TIME_BUDGET,
    progress: bool | None = None,
    callback: Callable[[int, dict[str, float]], None] | None = None,
    workers: Any = 1,
    **reading: Any,
) -> Any:
    """Learn a flow map from trajectories of a system whose H is not known.

    First H is learned: models of several families, from simple to rich, are fitted by shooting, together with the
    initial state of every trajectory, and the best on held-out trajectories is chosen. Then a flow of that H is
    trained. The noise is assumed to be independent and normal, with one standard deviation for each coordinate.

    Parameters
    ----------
    trajectories
        A list of (t, y), t (n,) and y (2d, n), each with its own times; a pair of arrays t (n,) and y (N, 2d, n); or
        any data that `sympflow.learning.trajectories.Trajectories.read` takes. NaN marks missing values. A fifth of the
        trajectories is held out, at least three; with fewer than eight, cross-validation is used. A single trajectory
        is cut into pieces, and some of these are held out.
    ndof : int, optional
        Degrees of freedom d.
    dt : float, optional
        Δt of the flow; by default it follows from the frequencies of the learned H.
    noise : float or array_like of shape (2d,), optional
        Standard deviation of the observations; estimated if not given.
    separable : bool, optional
        True if H = T(p) + V(q) is known, False if it is known not to be; by default the data decide.
    mass : float or array_like of shape (d,) or (d, d), optional
        M of T = ½ pᵀM⁻¹p; learned if not given.
    damping : {False, True, "each", "quadratic"}
        True to learn one rate γ of friction, p' = −∂H/∂q − γp; "each" for one rate for each p; "quadratic" for drag,
        p_i' = −∂H/∂q_i − c_i|p_i|p_i, and `flow.system` is then made by `sympflow.doubled`.
    drive : bool, float or sequence of float
        True to learn forces and stiffnesses a cos ωt + b sin ωt, and ω, in the time of the data, with one or two
        frequencies; or approximate values of ω in radians per unit of that time. Then `flow.system` is an H(q, p, t) =
        ½ pᵀM⁻¹p + V(q, t), of period 2π/ω for a single ω. Can be combined with friction, not with drag.
    period : float or array_like of shape (d,), optional
        The period of H in each q that is an angle: 2π, or 360 for degrees; infinite or NaN for the other coordinates.
        Wrapped angles are made continuous. Without `period`, angles in radians or degrees are tried too.
    known : HamiltonianSystem, optional
        A known part of H, symbolic; the rest is learned. If it has a kinetic energy, no other is learned.
    family : str, optional
        The only family to be tried, see `sympflow.learning.families.FAMILIES`.
    loss : {"squares", "huber"}
        "huber" for data with outliers.
    replicas : int
        Number of bootstrap replicas: fits of the chosen model to trajectories drawn with repetition. They give
        `flow.replicas`, whose `bands(y0, t)` are error bands of predictions.
    seed : int
        Seed of the choice of held-out trajectories and of random starts.
    name : str
        Of the learned system.
    checkpoint, resume, time_budget, progress, callback, workers
        As for `sympflow.train`; by default the search ends by itself. A checkpoint is written after each model;
        `workers` compute the replicas.
    **reading
        Options of `Trajectories.read`, such as `units`, `order` and `velocity_mass`. With observed="qv" the data have
        velocities with an unknown mass, with "q" positions only: then H is learned up to a factor, which is fixed by
        (M⁻¹)₁₁ = 1, or by M₁₁ = 1 in the middle of q where M depends on q. `flow.system.momenta(q, v)` are the momenta.

    Returns
    -------
    SympFlow
        With `flow.system`, the learned H as an ordinary HamiltonianSystem; `flow.figures`, the errors on held-
        out trajectories and the noise; `flow.recipe["learned"]`, the model and why it was chosen; `flow.history`, a
        record for each model.

    Raises
    ------
    ValueError, TypeError
        If the trajectories are not valid, a single one is too short to be cut, they have fewer values than the simplest
        model has parameters, or an argument is not admissible.

    Warns
    -----
    UserWarning
        If the residuals of the best model are not noise. The message gives the residuals of a vector field that need
        not be Hamiltonian, and the likeliest reason.

    References
    ----------
    .. [1] H. G. Bock, Recent advances in parameter identification techniques for O.D.E., in: Numerical Treatment of
       Inverse Problems in Differential and Integral Equations (1983) 95–121, for the shooting.
    .. [2] G. Schwarz, Estimating the dimension of a model, Ann. Statist. 6 (1978) 461–464, for the choice of the terms.
    """
    data = Trajectories.read(trajectories, ndof, period=period, **reading)
    data.check_moving()
    data.check_angles(None if period is None else np.isinf(periods_of(period, data.ndof)))
    damping, drive, dt, count = plain(damping), plain(drive), plain(dt), "an integer, 0 or more"
    seed = checked_count("seed", plain(seed), 0, sys.maxsize, count)
    replicas = checked_count("replicas", plain(replicas), 0, sys.maxsize, count)
    if replicas == 1:
        raise ValueError("`replicas` must be 0, or 2 or more; got 1: 20 give useful bands.")
    constraints = constraints_of(data, separable, mass, damping, period, known)
    frequencies = () if isinstance(drive, bool) else tuple(floats("drive", drive).ravel().tolist())
    if not all(0 < frequency < math.inf for frequency in frequencies):
        raise ValueError(
            f"`drive` must be True, for frequencies that are found, a positive one or several, or False; got {drive!r}."
        )
    huber = limit_of(loss)
    check_dt(dt)
    session = Session(checkpoint, resume, plain(time_budget), progress, callback, WorkerPool(workers))
    smooth = data.smooth
    rate = float(np.sqrt(np.mean((smooth.slopes / data.scales) ** 2))) if len(smooth.slopes) else 0.0
    seen = smooth.sigma if data.n_points >= ROUGH else None
    setting = Setting(noise_of(noise, data.ndof), huber, seen=seen, lag=LAG / rate if rate > 0 else 0.0)
    constraints = replace(
        constraints,
        frequencies=frequencies_of(constraints, smooth) if drive is True else frequencies,
        flow_scaling=data.scaling._replace(t=_step(data, rate) if dt is None else float(dt)),
    )
    chosen = families(constraints, family)
    folds = [(_cut(one, rate), _cut(others, rate)) for one, others in _divided(data, seed)]
    if len(folds) == 1:
        folds = [(_few(folds[0][0], seed), _few(folds[0][1], seed))]
    options: dict[str, Any] = {"family": family, "loss": loss, "seed": seed, "damping": damping, "separable": separable}
    options["drive"] = constraints.frequencies
    identity = _identity(data, constraints, setting, options)
    search = Search(_cut(data, rate), folds, constraints, setting, seed, identity=identity, whole=data)
    if resume is not None:
        search.resume(resume)
    with session.interruption, session.pool:
        search.run(chosen, session)
        search.diagnose(session)
        flow = search.flow(dt, name, session)
        if replicas:
            flow.replicas = search.bootstrap(replicas, session)
        return flow


def _step(data: Trajectories, rate: float) -> float:
    """Δt of a flow that is fitted itself: in which states move by about their spread, but no longer than the data."""
    longest = max(run.span for run in data.runs)
    step = min(1 / rate, longest) if rate > 0 else longest
    return float(f"{step:.1g}")


def _divided(data: Trajectories, seed: int) -> list[tuple[Trajectories, Trajectories]]:
    """Divisions of the trajectories, or of pieces of the only one."""
    pieces = min(FEW, data.n_points // ALONE)
    if len(data.runs) > 1 or pieces < 2:
        return data.folds(HELD_OUT, seed)
    return data.pieces(math.ceil(data.n_points / pieces)).folds(HELD_OUT, seed)


def _cut(data: Trajectories, rate: float) -> Trajectories:
    """The same where there are many trajectories; of few, long ones in pieces, which are followed side by side."""
    points = LONG_POINTS if rate == 0 else max(LONG_POINTS, math.ceil(LONG / rate / data.time_scale))
    return data if len(data.runs) >= WIDE else data.pieces(points)


def _few(data: Trajectories, seed: int) -> Trajectories:
    """So many trajectories, drawn at random, that they hold no more numbers than are needed; all if they do not."""
    if data.n_values <= MOST_VALUES:
        return data
    drawn = np.random.default_rng(seed).permutation(len(data.runs))
    numbers = np.cumsum([np.isfinite(data.runs[i].y).sum() for i in drawn])
    return data.subset(sorted(drawn[: max(1, int(np.searchsorted(numbers, MOST_VALUES, side="right")))]))


def constraints_of(data: Trajectories, separable: Any, mass: Any, damping: Any, period: Any, known: Any) -> Constraints:
    if separable is not None:
        check_flag("separable", separable)
    if not isinstance(damping, bool | str) or damping not in DAMPINGS:
        raise ValueError(
            f'`damping` must be True for one rate that is learned, "each" for one of each p, "quadratic" for drag, or '
            f"False; got {damping!r}."
        )
    d = data.ndof
    inverse = None
    if mass is not None:
        found = checked_inverse_mass(mass, d)
        inverse = np.eye(d) if found is None else np.diag(found) if found.ndim == 1 else found
    parts = () if known is None else _formulas(known, d)
    if inverse is not None and any(part.of != "q" for part in parts):
        raise ValueError("`known` has a kinetic energy, and so has `mass`: leave out one of them.")
    momenta = None if data.velocities else _covariance(data)
    middle = np.nanmean(np.concatenate([run.y[:d] for run in data.runs], axis=1), axis=1)
    of_data: dict[str, Any] = {"momenta": momenta, "velocities": data.velocities, "middle": middle}
    of_data["angles_known"] = period is not None
    periods = np.full(2 * d, np.inf)
    if period is not None:
        periods[:d] = periods_of(period, d)
    return Constraints(data.scales, separable, inverse, DAMPINGS[damping], periods, parts, **of_data)


def _covariance(data: Trajectories) -> np.ndarray:
    """The covariance (d, d) of the momenta along a trajectory, in the mean over all points."""
    p = [run.y[data.ndof :, np.isfinite(run.y).all(axis=0)] for run in data.runs]
    rest = np.concatenate([one - one.mean(axis=1, keepdims=True) for one in p if one.size], axis=1)
    return rest @ rest.T / max(rest.shape[1], 1)


def _formulas(known: Any, d: int) -> tuple[Fixed, ...]:
    """The parts of a system that is a part of H."""
    if not isinstance(known, HamiltonianSystem):
        raise TypeError(f"`known` must be a HamiltonianSystem, a part of H; got {known!r}.")
    symbols = known.symbols
    if symbols is None or known.ndof != d or not known.keeps_energy:
        raise ValueError(
            f"`known` must be a symbolic system of {d} degrees of freedom that depends on no time and has no friction: "
            "define it by HamiltonianSystem.from_sympy."
        )
    parts = [("y", symbols.H)]
    if symbols.V is not None and symbols.T is not None:
        parts = [("q", symbols.V), ("p", symbols.T)]
    values = {v: known.params[v.name] for v in symbols.H.free_symbols if v.name in known.params}
    values |= dict(zip((*symbols.q, *symbols.p), coordinates_of("y", d), strict=True))
    written = ((of, f.subs(values, simultaneous=True)) for of, f in parts)
    moving = ((of, Library([f], d)) for of, f in written if f.free_symbols & {*coordinates_of(of, d)})
    return tuple(Fixed(Terms(library, of), np.ones(1)) for of, library in moving)


def _identity(
    data: Trajectories, constraints: Constraints, setting: Setting, options: dict[str, Any]
) -> dict[str, Any]:
    """The description that a search must share with the one that it goes on with."""
    known = [str(part.expression(part.theta, coordinates_of(part.of, data.ndof))) for part in constraints.known]
    of_data = digest([data, constraints.inverse_mass, constraints.periods, setting.noise])
    return {"config": json.dumps(options), "architecture": json.dumps(known), "system": of_data}
