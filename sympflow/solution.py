"""Solution: what `solve` returns."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sympflow.arguments import check_flag, warn
from sympflow.arrays import Array, concatenate, is_tensor, to_numpy
from sympflow.hamiltonian.scales import known_scale, size_of_terms, weights
from sympflow.integrators.contract import method_text
from sympflow.integrators.interpolants import Mapped
from sympflow.show.cards import Answering, Card
from sympflow.show.pictures import KINDS, trajectory_figure
from sympflow.show.style import saved

if TYPE_CHECKING:
    import os

    import pandas
    import xarray
    from matplotlib.figure import Figure
    from scipy.optimize import OptimizeResult

    from sympflow.hamiltonian.parameter_rows import ParameterRows
    from sympflow.hamiltonian.system import HamiltonianSystem
    from sympflow.integrators.contract import Integrator
    from sympflow.storage.runs import RunStore


LARGE = 2_000_000  # numbers of a solution beyond which its card has no energy error
LOOKED_AT = 64  # outputs at which the terms of H are looked at


@dataclass(repr=False)
class Solution(Answering):
    """The solution of an initial value problem, with SciPy's fields.

    Attributes
    ----------
    t : ndarray of shape (n,)
        Output times.
    y : ndarray or tensor of shape (..., 2d, n)
        States [q, p], time last, as in SciPy.
    sol : callable or None
        Dense output: sol(t) has shape (..., 2d) for a number t, (..., 2d, n) for an array.
    t_events, y_events : list of ndarray or None
        For each event its times (n,) and states (n, 2d), without gradients (see `interop.torchdiffeq.odeint_event`);
        None without `events`.
    nfev : int
        Force (right-hand side) evaluations.
    status : int, or ndarray of the batch's shape
        0: the end was reached, or the last time of `t_eval`. −1: the solution became non-finite, an implicit step could
        not be solved, the step size underflowed, or there were too many steps. 1: an event ended the run.
    message : str
        The status in words, with the time and the remedy.
    stats : dict
        n_steps, force_evaluations, hessian_evaluations, wall_time (seconds), backend, and dt for fixed steps; where
        a run failed, failed_at, the time of its last finite state, and where its solution becomes infinite
        blow_up_time, an estimate (in a batch arrays, NaN for the others;
        with `params`, of the first 16 sets of values that fail); newton_iterations of implicit methods.
    system, integrator, t_span, y0
        The problem that was solved, and its method: metrics execute the run again from these.
    rows : ParameterRows or None
        The parameters of each trajectory, where `solve` was given `params`: see `params` and `by_parameters`. `system`
        is then the argument of `solve`, unless all values are numbers.
    """

    _OTHER_NAMES: ClassVar[Mapping[str, str]] = {
        **dict.fromkeys(("times", "time", "ts"), "`t`, the times of outputs"),
        **dict.fromkeys(("q1", "q2", "p1", "p2"), "`q[..., i, :]` and `p[..., i, :]`, from i = 0"),
        **dict.fromkeys(("x", "ys", "u", "trajectory"), "`y`, of shape (..., 2d, n), or `q` and `p`"),
        **dict.fromkeys(("positions", "momenta", "v", "velocities"), "`q` and `p`, of shape (..., d, n)"),
        **dict.fromkeys(("q0", "p0"), "`y0`, the initial state [q, p]"),
        **dict.fromkeys(("H", "E", "energies"), "`energy()`, along the solution"),
        **dict.fromkeys(("error", "errors"), "`energy_error()`, or sympflow.reference_error(sol)"),
        **dict.fromkeys(("dt", "n_steps", "wall_time"), "`stats`, a dictionary that has it"),
        **dict.fromkeys(("method", "solver"), "`integrator`"),
        **dict.fromkeys(
            ("save", "to_csv", "to_pandas", "to_numpy"),
            "`t` and `y`, `to_dataframe()`, `to_xarray()` or `to_netcdf(path)`",
        ),
    }
    t: np.ndarray
    y: Array
    status: int | np.ndarray
    message: str
    stats: dict[str, Any]
    system: HamiltonianSystem
    integrator: Integrator
    t_span: tuple[float, float]
    y0: Array
    sol: Callable[[Any], Array] | None = None
    t_events: list[np.ndarray] | None = None
    y_events: list[np.ndarray] | None = None
    rows: ParameterRows | None = None

    def __getitem__(self, key: Any) -> Any:
        raise TypeError(
            f"`sol` has no item {key!r}: take `sol.t`, `sol.y`, `sol.q` or `sol.p`, as in t, y = sol.t, sol.y."
        )

    @property
    def nfev(self) -> int:
        return int(self.stats["force_evaluations"])

    @property
    def success(self) -> bool:
        """True if every trajectory reached the end (or an event that ends it)."""
        return bool(np.all(np.asarray(self.status) >= 0))

    @property
    def q(self) -> Array:
        """Positions (..., d, n)."""
        return self.y[..., : self.system.ndof, :]

    @property
    def p(self) -> Array:
        """Momenta (..., d, n)."""
        return self.y[..., self.system.ndof :, :]

    @property
    def states(self) -> Array:
        """The states with [q, p] last: (..., n, 2d)."""
        return self.y.swapaxes(-1, -2)

    @property
    def params(self) -> dict[str, Any]:
        """The values of the parameters by name: numbers, and arrays (...) for those given to `solve`."""
        return {**self.system.params, **({} if self.rows is None else self.rows.values)}

    @property
    def varied(self) -> bool:
        """True if trajectories have parameters of their own."""
        return self.rows is not None and not self.rows.uniform

    def by_parameters(self) -> Iterator[tuple[np.ndarray, Solution]]:
        """The trajectories by the values of their parameters, each group as a solution of its own system.

        Yields
        ------
        index : ndarray of int, shape (k,)
            Places in the flattened batch.
        sol : Solution
            Of k trajectories.
        """
        assert self.rows is not None
        for index, system, _ in self.rows.distinct():
            status = np.broadcast_to(self.status, self.rows.shape).reshape(-1)[index]
            stats = {name: _taken(value, index, self.rows.shape) for name, value in self.stats.items()}
            yield (
                index,
                replace(
                    self,
                    y=self.y.reshape(-1, *self.y.shape[-2:])[index],
                    status=status,
                    stats=stats,
                    system=system,
                    y0=self.y0.reshape(-1, self.y0.shape[-1])[index],
                    sol=None,
                    rows=None,
                ),
            )

    def physical(self) -> Solution:
        """The solution of the physical system, from that of a doubled one (`sympflow.doubled`).

        Its states are [q₊, p₊], its system the one with friction and the external force, and `stats["difference"]` is
        the largest |q₋| or |p₋| of the run, 0 in the physical limit. Metrics of quantities that are not conserved
        refuse it.

        Raises
        ------
        ValueError
            If the system is not doubled.

        Warns
        -----
        RuntimeWarning
            If the difference has grown beyond 1e-6 of the states.
        """
        return physical_solution(self)

    def energy(self) -> Array:
        """H along the solution: (..., n); for a driven system at the times of the states."""
        with np.errstate(all="ignore"):
            if self.varied and not is_tensor(self.y):
                return _energy(self, self.states, self.t)
            if self.varied:
                return gathered(self, lambda part: part.energy())
            return self.system.hamiltonian(self.states, np.broadcast_to(self.t, self.states.shape[:-1]))

    def energy_error(self) -> np.ndarray:
        """Relative energy error over time, (..., n), with its sign; inf where H overflows.

        See `sympflow.energy_error`; the largest magnitude is `sympflow.max_energy_error(sol)`.
        """
        return energy_change(self)

    def energy_scale(self) -> np.ndarray:
        """The scale of the energy errors of each trajectory, (...); see `sympflow.metrics.energy.energy_scale`."""
        few, y0 = slice(None, None, -(-max(1, len(self.t)) // LOOKED_AT)), to_numpy(self.y0)[..., None, :]
        y, t = y0, np.array(self.t_span[:1])
        if self.system.energy_scale is None:
            y, t = np.concatenate([y0, to_numpy(self.states)[..., few, :]], axis=-2), np.append(t, self.t[few])
        H, y, t = _energy(self, y, t), y.astype(float), np.broadcast_to(t, y.shape[:-1])
        with np.errstate(all="ignore"):
            if self.rows is None or self.rows.uniform:
                sizes = size_of_terms(self.system, y, t)
            else:
                sizes = self.rows.sizes_of_terms(y, t)
        return known_scale(self.system, np.moveaxis(H, -1, 0), np.moveaxis(sizes, -1, 0))

    def card(self) -> Card:
        t, stats = self.t, self.stats
        counts = f"{stats.get('n_steps', 0):,} steps, {self.nfev:,} force evaluations, {stats.get('backend', '')}"
        facts = {
            "method": method_text(self.integrator, stats.get("dt")),
            "t": f"{len(t):,} times" + (f", {t[0]:.6g} … {t[-1]:.6g}" if len(t) else ""),
            "y": f"shape {tuple(self.y.shape)}, {self.y.dtype}",
            "largest energy error": self._energy_text(),
            "run": f"{counts}, {stats.get('wall_time', 0):.3g} s",
            "events": ", ".join(map(str, map(len, self.t_events or ()))),
        }
        return Card(f"Solution of {self.system.title}", facts, self.message)

    def _energy_text(self) -> str:
        """The largest relative energy error in words; empty where there is none, or it takes long."""
        large = isinstance(self, StoredSolution) or math.prod(self.y.shape) > LARGE or not len(self.t)
        if large or not self.system.shows_energy:
            return ""
        with warnings.catch_warnings(action="ignore"), suppress(ArithmeticError, ValueError, TypeError, RuntimeError):
            return f"{np.abs(energy_change(self)).max():.1e}, relative"
        return ""

    def preview(self) -> Figure | None:
        return self.plot() if len(self.t) and not isinstance(self, StoredSolution) else None

    def plot(self, kinds: Sequence[str] = KINDS, path: str | os.PathLike[str] | None = None) -> Figure:
        """Draw the orbit, the phase plane and the energy error over time, of 16 trajectories of a batch at most.

        With a `path` (.png, .pdf or .svg) the figure is saved too; matplotlib is needed.

        Parameters
        ----------
        kinds : sequence of str
            Of "orbit", q₁ against q₂ (q over t of one degree of freedom, a map of all q of many), "phase", q₁ against
            p₁, for bodies their orbits and x against pₓ/m, and "energy", which is left out where energy is not
            conserved.
        """
        from sympflow.hamiltonian.bodies import PairsHamiltonian

        shown = self if self.system.shows_energy is self.system.keeps_energy else self.physical()
        y, kinds = to_numpy(shown.y), (kinds,) if isinstance(kinds, str) else kinds
        error = None
        if self.system.shows_energy:
            with warnings.catch_warnings(action="ignore"):
                error = energy_change(self).reshape(-1, len(self.t))
        rates, local, states = None, self.system.local, to_numpy(shown.states)
        if not self.varied and states.size < LARGE:
            with np.errstate(all="ignore"):
                field = shown.system.vector_field(states, np.broadcast_to(self.t, states.shape[:-1]))
            rates = np.asarray(field).swapaxes(-1, -2).reshape(-1, *y.shape[-2:])
        masses = local.masses if isinstance(local, PairsHamiltonian) else None
        heading = f"{self.system.title}, {method_text(self.integrator, self.stats.get('dt'))}"
        return saved(
            trajectory_figure(self.t, y.reshape(-1, *y.shape[-2:]), error, heading, kinds, "", rates, masses), path
        )

    def to_scipy(self) -> OptimizeResult:
        """The `OdeResult` that `scipy.integrate.solve_ivp` would have returned; for a single trajectory.

        Raises
        ------
        ValueError
            For a batch.
        """
        from scipy.integrate._ivp.ivp import OdeResult

        if self.y.ndim != 2:
            raise ValueError(
                "`solution` is a batch, which SciPy's result cannot hold: convert one trajectory at a time."
            )
        return OdeResult(
            t=self.t,
            y=to_numpy(self.y),
            sol=self.sol,
            t_events=self.t_events,
            y_events=self.y_events,
            nfev=self.nfev,
            njev=0,
            nlu=0,
            status=self.status,
            message=self.message,
            success=self.success,
        )

    def to_xarray(self, energy: bool = True) -> xarray.Dataset:
        """The solution as an `xarray.Dataset`; its `to_netcdf` and `to_zarr` write files.

        Variables are `q` and `p` with the dimensions (..., dof, time), `energy` (..., time), the initial states `q0`
        and `p0` (..., dof), `status` (...), and of each event i its times `t_event_i` and states. A batch has the
        dimension `orbit`, or of more axes orbit_0, orbit_1, ...; parameters that were given for each trajectory are
        coordinates along it. The attributes describe how the data were made: the version of sympflow, the system, its H
        and params, the method, its options, the checksum of its flow, counts of the run, and the message.

        Parameters
        ----------
        energy : bool
            False leaves `energy` out, which costs an evaluation of H at each state.

        Raises
        ------
        ImportError
            If xarray is not installed.
        """
        return dataset(self, energy)

    def to_dataframe(self, energy: bool = True) -> pandas.DataFrame:
        """The solution as a `pandas.DataFrame` with a row for each time of each trajectory.

        Columns are the place in the batch (`orbit`), `time`, q1 … qd, p1 … pd, `energy`, and for a batch `status` and
        the parameters that were given for each trajectory. `attrs` has the attributes of `to_xarray`.

        Parameters
        ----------
        energy : bool
            False leaves `energy` out.

        Raises
        ------
        ImportError
            If pandas or xarray is not installed.
        """
        from sympflow.storage.layout import TIME, batch_dims, imported, table

        imported("pandas", "to_dataframe()")
        return table(dataset(self, energy, "to_dataframe()"), (*batch_dims(self.y0.shape[:-1]), TIME))

    def to_netcdf(self, path: str | os.PathLike[str], energy: bool = True) -> None:
        """Write `to_xarray(energy)` as a NetCDF file, which `xarray.open_dataset(path)` reads.

        Raises
        ------
        ImportError
            If xarray is not installed.
        """
        dataset(self, energy, "to_netcdf()").to_netcdf(path)

    def raise_for_status(self) -> Solution:
        """Raise a RuntimeError with the message unless the run succeeded; else return the solution."""
        if not self.success:
            raise RuntimeError(self.message)
        return self


def _stored(name: str, read: Callable[[RunStore], Any]) -> property:
    """A field, kept under a name, that is read from the store unless it is set."""

    def get(sol: StoredSolution) -> Any:
        known = getattr(sol, name)
        return read(sol.store) if sol.store is not None and known is None else known

    return property(get, lambda sol, value: setattr(sol, name, value))


class StoredSolution(Solution):
    """A solution whose outputs are in a store, from which `t` and `y` are read at each access."""

    store: RunStore | None = None
    t = _stored("_t", lambda store: store.times())
    y = _stored("_y", lambda store: store.states())


COUNTS = ("backend", "dt", "n_steps", "force_evaluations", "hessian_evaluations", "newton_iterations", "difference")
"""Statistics of a run that are attributes of its Dataset: all that do not differ from run to run."""


def dataset(sol: Solution, energy: bool = True, asked: str = "to_xarray()") -> xarray.Dataset:
    """The Dataset of a solution: see `Solution.to_xarray`; `asked` is the name of the call that needs it."""
    from sympflow.integrators.provenance import provenance
    from sympflow.storage.layout import DOF, TIME, axis_name, batch_dims, described, dofs, halves, imported

    check_flag("energy", energy)
    xr = imported("xarray", asked)
    y, y0, d = to_numpy(sol.y), to_numpy(sol.y0), sol.system.ndof
    batch = batch_dims(y0.shape[:-1])
    arrays: dict[str, tuple[Any, ...]] = {}
    for letter, rows in halves(d):
        arrays[letter] = ((*batch, DOF, TIME), y[..., rows, :])
        arrays[f"{letter}0"] = ((*batch, DOF), y0[..., rows])
    if energy:
        arrays["energy"] = ((*batch, TIME), to_numpy(sol.energy()))
    arrays["status"] = (batch, np.broadcast_to(np.asarray(sol.status, dtype=np.int8), y0.shape[:-1]))
    for i, (times, states) in enumerate(zip(sol.t_events or (), sol.y_events or (), strict=True)):
        arrays[f"t_event_{i}"] = ((f"event_{i}",), to_numpy(times))
        for letter, rows in halves(d):
            arrays[f"{letter}_event_{i}"] = (
                (DOF, f"event_{i}"),
                to_numpy(states).reshape(len(times), 2 * d)[:, rows].T,
            )
    coords: dict[str, tuple[Any, ...]] = {DOF: (DOF, dofs(d)), TIME: (TIME, to_numpy(sol.t))}
    if sol.rows is not None:
        coords |= {axis_name(name): (batch, values) for name, values in sol.rows.values.items()}
    counts = {
        name: value for name, value in sol.stats.items() if name in COUNTS and isinstance(value, int | float | str)
    }
    attributes = provenance(sol.system, sol.integrator, sol.t_span) | counts | {"message": sol.message}
    return xr.Dataset(described(arrays), coords=described(coords), attrs=attributes)


LARGEST_DIFFERENCE = 1e-6
"""Difference of the two copies, over the size of the states, beyond which a physical solution warns."""


def physical_solution(sol: Solution) -> Solution:
    """The physical part of a solution of a doubled system: see `Solution.physical`."""
    doubled = sol.system.as_doubled()
    with np.errstate(all="ignore"):
        both, scale = (doubled.difference(sol.states), doubled.physical_limit(sol.states)), weights(doubled.physical)
        apart = abs(to_numpy(both[0])).max(initial=0.0)
        scaled_apart, size = (abs(scale * to_numpy(y)).max(initial=0.0) for y in both)
    if scaled_apart > LARGEST_DIFFERENCE * size:
        warn(
            f"The doubled variables q₋, p₋ have grown to {apart:.3g}: the run has left the physical limit. Reduce "
            "`dt`, or project every step, solve(system, 'projected', of=method).",
            RuntimeWarning,
        )
    limit = doubled.physical_limit
    return replace(
        sol,
        y=limit(sol.states).swapaxes(-1, -2),
        system=doubled.physical,
        y0=limit(sol.y0),
        stats={**sol.stats, "difference": float(apart)},
        sol=sol.sol and Mapped(sol.sol, limit),
        y_events=None if sol.y_events is None else [limit(y) for y in sol.y_events],
    )


def check_solution(sol: object, name: str = "sol") -> None:
    """Raise a TypeError unless `sol` is a Solution."""
    if not isinstance(sol, Solution):
        raise TypeError(f"`{name}` must be a Solution; got {type(sol).__name__}. Pass what solve() returns.")


def energy_change(sol: Solution, relative: bool = True) -> np.ndarray:
    """H(y(t)) − H(y0) in float64, (..., n): the metric `sympflow.energy_error`, where it is documented."""
    sol.system.check_conservative(
        "so a loss of energy is not an error",
        "use sympflow.conformal_defect(sol), which is 0 for the exact flow, or sympflow.reference_error(sol)",
    )
    sol.system.check_autonomous(
        "so its energy is not conserved and has no error", "use sympflow.energy_balance_error(sol)"
    )
    with np.errstate(all="ignore"):
        states, t0 = to_numpy(sol.states), sol.t_span[0]
        error = _energy(sol, states, t0) - _energy(sol, sol.y0, t0)[..., None]
        if np.isnan(error).any():
            error = np.where(np.isnan(error) & np.isfinite(states).all(-1), np.inf, error)
        if not relative:
            return error
        scale = sol.energy_scale()
        if (absolute := np.isnan(scale)).any():
            warn(
                "The energy error is absolute where all terms of H are 0: give the system an `energy_scale`.",
                RuntimeWarning,
            )
        compared = error / np.where(absolute, 1.0, scale)[..., None]
        return np.where(np.isinf(error), error, compared)  # H(y0) may be infinite itself: inf/inf


def _energy(sol: Solution, y: Array, t: Any) -> np.ndarray:
    """H in float64, whatever the precision of the run, of each trajectory at its states (..., k, 2d) or (..., 2d)."""
    states = to_numpy(y).astype(float)
    with np.errstate(all="ignore"):
        if sol.rows is not None and not sol.rows.uniform:
            return sol.rows.hamiltonian(states, t)
        return np.asarray(sol.system.hamiltonian(states, np.broadcast_to(t, states.shape[:-1])))


# trajectories with parameters of their own -----------------------------------------------------------------------


def gathered(sol: Solution, measure: Callable[[Solution], Any]) -> Any:
    """The results (...) of a measure of each group of trajectories (k, ...) that have the same parameters."""
    assert sol.rows is not None
    pieces = [(index, measure(part)) for index, part in sol.by_parameters()]
    return _scattered(pieces, sol.rows.shape)


def joined(
    pieces: Sequence[tuple[np.ndarray, Solution]], system: HamiltonianSystem, y0: Array, rows: ParameterRows
) -> Solution:
    """One solution of solutions (k, 2d, n) of some trajectories each, by their places in the flattened batch."""
    first = pieces[0][1]
    for _, part in pieces[1:]:
        if not np.array_equal(part.t, first.t):
            raise ValueError(
                f"`t_eval` is needed: method {first.integrator.name!r} chooses its steps for each value of the "
                "parameters, so that their outputs are at other times."
            )
    dense = first.sol and Joined([(i, part.sol) for i, part in pieces if part.sol], rows.shape)
    status = _scattered([(i, np.asarray(part.status)) for i, part in pieces], rows.shape)
    bad = [(i[np.asarray(part.status) < 0], part) for i, part in pieces if not part.success]
    message = first.message
    if bad:
        index, part = min(bad, key=lambda piece: int(piece[0][0]))
        where = ", ".join(map(str, np.unravel_index(int(index[0]), rows.shape)))
        values = ", ".join(f"{name} = {value.reshape(-1)[index[0]]:.9g}" for name, value in rows.values.items())
        failed = sum(len(i) for i, _ in bad)
        message = f"{failed} of {status.size} trajectories failed, the first at {where} ({values}). {part.message}"
    return replace(
        first,
        y=_scattered([(i, part.y) for i, part in pieces], rows.shape),
        status=status,
        message=message,
        stats=_joined_stats([(i, part.stats) for i, part in pieces], rows.shape),
        system=system,
        y0=y0,
        sol=dense,
        rows=rows,
    )


class Joined:
    """Dense output of a batch whose trajectories were solved in groups: sol(t) is (..., 2d), or (..., 2d, n)."""

    def __init__(self, pieces: Sequence[tuple[np.ndarray, Callable[[Any], Array]]], shape: tuple[int, ...]) -> None:
        self.pieces, self.shape = pieces, shape

    def __call__(self, t: Any) -> Array:
        return _scattered([(index, sol(t)) for index, sol in self.pieces], self.shape)


def _scattered(pieces: Sequence[tuple[np.ndarray, Any]], shape: tuple[int, ...]) -> Any:
    """Arrays (k, ...) of some trajectories each as one, (*shape, ...)."""
    whole: Any
    order = np.concatenate([index for index, _ in pieces])
    if len(pieces) == 1 and (order == np.arange(len(order))).all():
        whole = pieces[0][1]
    else:
        whole = concatenate([values for _, values in pieces], 0)[np.argsort(order)]
    return whole.reshape(*shape, *whole.shape[1:])


def _joined_stats(pieces: Sequence[tuple[np.ndarray, dict[str, Any]]], shape: tuple[int, ...]) -> dict[str, Any]:
    """Times are added, counts are the largest, arrays (k,) one array with NaN where some have none."""
    stats: dict[str, Any] = {}
    for name in dict.fromkeys(name for _, own in pieces for name in own):
        values = [own[name] for _, own in pieces if name in own]
        if any(isinstance(value, np.ndarray) for value in values):
            full = [(i, np.broadcast_to(own.get(name, np.nan), i.shape)) for i, own in pieces]
            stats[name] = _scattered(full, shape)
        elif name == "wall_time":
            stats[name] = sum(values)
        elif isinstance(values[0], int | float):
            stats[name] = max(values)
        else:
            stats[name] = values[0]
    return stats


def _taken(value: Any, index: np.ndarray, shape: tuple[int, ...]) -> Any:
    """The part of an array of the batch's shape; other values as they are."""
    if isinstance(value, np.ndarray) and value.shape[: len(shape)] == shape:
        return value.reshape(-1, *value.shape[len(shape) :])[index]
    return value
