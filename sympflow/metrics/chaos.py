"""Chaos of orbits by deviation vectors: the largest Lyapunov exponent, SALI and GALI.

A deviation vector w is moved by the exact linearisation of each step that is made, the tangent map of the method, not
by a separate integration of the variational equations, which has other errors [1]_.

References
----------
.. [1] C. Skokos, E. Gerlach, "Numerical integration of variational equations", Phys. Rev. E 82 (2010) 036704.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import as_float, check_counts, check_one_of, check_t_eval, floats, warn
from sympflow.hamiltonian.scales import weights
from sympflow.integrators.contract import FINISHED
from sympflow.integrators.diagnosis import try_steps
from sympflow.integrators.grid import Grid
from sympflow.integrators.impulses import landings
from sympflow.integrators.loops import compiled_loops
from sympflow.integrators.registry import naming_plugin
from sympflow.metrics.orbits import OfOrbits, Orbits, checked_orbits, of_many
from sympflow.show.cards import Card
from sympflow.show.pictures import curves_figure
from sympflow.systems.given import GivenSystem, given_system

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ALIGNED = 1e-12
"""Below this SALI and GALI an orbit is chaotic for sure, and ends: what is left is rounding."""
NONE, ALIGNMENT, VOLUME = 0, 1, 2
"""Kinds of spread of deviation vectors: none, min(|u + v|, |u − v|) of two unit vectors, the volume that they span."""
BACKENDS = ("auto", "compiled", "array")
LOG_2 = float(np.log(2.0))


@dataclass(frozen=True, repr=False)
class Indicator(OfOrbits):
    """A chaos indicator of each orbit, at its end and at the times of `t_eval`.

    Attributes
    ----------
    value : float, or ndarray of shape (...) of a batch
        At `t_end`; NaN of an orbit that failed.
    t_end : float or ndarray of shape (...)
        The end of the orbit: the last whole step of `t_span`, or where the indicator fell below its threshold.
    status : int or ndarray of shape (...)
        0 where the end of `t_span` was reached, 1 where the indicator fell below its threshold before, and −1 where
        the orbit or its deviation vectors ceased to be finite; `t_end` is then the last time at which all was known
        to be.
    message : str
        In words, with the remedy.
    t : ndarray of shape (n,)
        The times of `t_eval`.
    history : ndarray of shape (..., n)
        The indicator after the last step that ends at or before each of them; NaN after the end of an orbit.
    """

    caption: ClassVar[str] = "Indicator of chaos"
    facts: ClassVar[tuple[str, ...]] = ("value", "t_end", "status")
    value: Any
    t_end: Any
    status: Any
    message: str
    t: np.ndarray = field(repr=False)
    history: np.ndarray = field(repr=False)
    measure: str = field(default="indicator", repr=False)

    def card(self) -> Card:
        return replace(super().card(), caption=self.measure)

    def drawn(self) -> Figure:
        if len(self.t):
            curves = self.history.reshape(-1, len(self.t))
            return curves_figure(self.t, curves, ("t", self.measure), self.message)
        return of_many(self.measure, self.value, "give `t_eval` to see it over time")


def lyapunov(
    system: GivenSystem,
    method: Any = None,
    t_span: tuple[float, float] | None = None,
    y0: ArrayLike | None = None,
    *,
    t_eval: ArrayLike | None = None,
    deviations: ArrayLike | None = None,
    seed: int = 0,
    backend: str = "auto",
    **options: Any,
) -> Indicator:
    """The largest Lyapunov exponent of each orbit: ln(|w(t)|/|w(0)|)/|t − t0|, of a deviation vector w.

    Lengths are those of (s δq, δp/s), where s = √(mω) makes q and p comparable in any units; it is 1 for unit masses
    and frequencies, as in the Hénon–Heiles system.

    As t grows it tends to the exponent of the orbit, for almost all initial vectors [1]_ [2]_: to a positive number on
    a chaotic one, and like ln(t)/t to 0 on a regular one, so that a value of that size at the end of the run does not
    distinguish the two (`sali` does). With friction the exponent of an orbit that comes to rest is negative.

    Parameters
    ----------
    system : HamiltonianSystem
    method : str, Integrator or trained flow, optional
        By default one that suits the system, as for `solve`. Splitting methods run compiled on symbolic systems; in
        other cases each step is differentiated, which takes longer.
    t_span : (float, float), optional
        The default is the system's. With fixed steps the run ends with the last full step.
    y0 : array_like of shape (..., 2d), optional
        One state, or a batch of them. The default is the system's.
    t_eval : array_like of shape (n,), optional
        Times at which the average so far is reported in `history`.
    deviations : array_like of shape (2d,), optional
        w(0). The default is a random direction of (s δq, δp/s), the same for all orbits.
    seed : int
        Seed of this direction.
    backend : "auto", "compiled" or "array"
        As for `solve`.
    **options
        Options of the method, such as `dt`.

    Returns
    -------
    Indicator

    Raises
    ------
    ValueError, TypeError
        For bad arguments, at once; and for methods whose steps cannot be differentiated in y at a fixed t.

    References
    ----------
    .. [1] G. Benettin, L. Galgani, A. Giorgilli, J.-M. Strelcyn, Meccanica 15 (1980) 9–30.
    .. [2] V. I. Oseledec, Trans. Moscow Math. Soc. 19 (1968) 197–231.

    Examples
    --------
    >>> import sympflow
    >>> system = sympflow.systems.henon_heiles()
    >>> exponent = lyapunov(system, "verlet", (0, 1000), [0.0, -0.25, 0.42081, 0.0], dt=0.05)
    >>> bool(0.03 < exponent.value < 0.06)
    True
    """
    orbits = checked_orbits(system, method, t_span, y0, options, "deviation vectors are followed on")
    return indicator(orbits, 1, NONE, 0.0, t_eval, deviations, seed, backend)


def sali(
    system: GivenSystem,
    method: Any = None,
    t_span: tuple[float, float] | None = None,
    y0: ArrayLike | None = None,
    *,
    below: float = ALIGNED,
    t_eval: ArrayLike | None = None,
    deviations: ArrayLike | None = None,
    seed: int = 0,
    backend: str = "auto",
    **options: Any,
) -> Indicator:
    """The smaller alignment index of each orbit: min(|u + v|, |u − v|) of two normalised deviation vectors.

    On a chaotic orbit it falls like exp(−(λ₁ − λ₂)t), λ the two largest Lyapunov exponents, to the last bit; on a
    regular one in two or more degrees of freedom it stays between constants [1]_. In one degree of freedom, where all
    vectors turn into the direction of the flow, it falls like 1/t².

    Parameters
    ----------
    system, method, t_span, y0, t_eval, seed, backend, **options
        As for `lyapunov`.
    below : float
        An orbit ends, as chaotic, when its index falls below this number; 0 to go on to the end.
    deviations : array_like of shape (2, 2d), optional
        The vectors at the start. The default is two random orthogonal directions.

    Returns
    -------
    Indicator

    Raises
    ------
    ValueError, TypeError
        As `lyapunov`.

    References
    ----------
    .. [1] C. Skokos, J. Phys. A: Math. Gen. 34 (2001) 10029–10043.

    Examples
    --------
    >>> import sympflow
    >>> system = sympflow.systems.henon_heiles()
    >>> index = sali(system, "verlet", (0, 2000), [[0.0, -0.25, 0.42081, 0.0], [0.0, 0.55, 0.2417, 0.0]], dt=0.05)
    >>> index.value < 1e-8
    array([ True, False])
    """
    orbits = checked_orbits(system, method, t_span, y0, options, "deviation vectors are followed on")
    return indicator(orbits, 2, ALIGNMENT, checked_threshold(below), t_eval, deviations, seed, backend)


def gali(
    system: GivenSystem,
    method: Any = None,
    t_span: tuple[float, float] | None = None,
    y0: ArrayLike | None = None,
    *,
    k: int = 2,
    below: float = ALIGNED,
    t_eval: ArrayLike | None = None,
    deviations: ArrayLike | None = None,
    seed: int = 0,
    backend: str = "auto",
    **options: Any,
) -> Indicator:
    """The generalised alignment index of order k: the volume that k normalised deviation vectors span.

    On a chaotic orbit it falls like exp(−Σ_{j=2..k} (λ₁ − λ_j) t); on a regular one it stays near a constant for k up
    to the dimension of its torus, d as a rule, and falls like t^{−2(k − d)} for more vectors [1]_.

    Parameters
    ----------
    system, method, t_span, y0, t_eval, seed, backend, **options
        As for `lyapunov`.
    k : int
        From 2 to 2d.
    below : float
        An orbit ends when its index falls below this number; 0 to go on to the end.
    deviations : array_like of shape (k, 2d), optional
        The vectors at the start. The default is random orthogonal directions, for which the index is 1.

    Returns
    -------
    Indicator

    Raises
    ------
    ValueError, TypeError
        As `lyapunov`.

    Notes
    -----
    The volume |w₁ ∧ … ∧ w_k| is computed by Gram–Schmidt orthogonalisation.

    References
    ----------
    .. [1] C. Skokos, T. Bountis, C. Antonopoulos, Physica D 231 (2007) 30–54.
    """
    system = given_system(system)
    orbits = checked_orbits(system, method, t_span, y0, options, "deviation vectors are followed on")
    check_counts(k=k)
    if not 2 <= k <= 2 * system.ndof:
        raise ValueError(
            f"`k` must be from 2 to {2 * system.ndof}, the dimension of the phase space of {system.name!r}; got {k}."
        )
    return indicator(orbits, int(k), VOLUME, checked_threshold(below), t_eval, deviations, seed, backend)


def checked_threshold(below: float) -> float:
    """`below` as a float; a ValueError unless it is a threshold."""
    value = as_float(below)
    if not 0 <= value < 1:
        raise ValueError(f"`below` must be a number from 0, to go on to the end, up to 1; got {below!r}.")
    return value


# runs with deviation vectors ----------------------------------------------------------------------


@dataclass
class _Run:
    """Logarithms of lengths (N, k, n + 1), spreads and times (N, n + 1), the last at the end; and the status (N,)."""

    growth: np.ndarray
    spread: np.ndarray
    elapsed: np.ndarray
    status: np.ndarray


def check_followed(orbits: Orbits) -> None:
    """Raise a ValueError with the reason where deviation vectors of states, or H at these times, are not known."""
    integrator, system = orbits.integrator, orbits.system
    system.check_times(*orbits.t_span)
    if held := integrator.keeps or integrator.tangent_holds:
        what = f"keeps {held}" if integrator.keeps else f"is differentiated with {held} held"
        raise ValueError(
            f"`method` {integrator.name!r} {what}, so that deviation vectors of states are not known: use a splitting "
            "method such as 'kahan_li8', or an implicit one such as 'gauss_legendre6'."
        )
    if orbits.batch and not integrator.on_grid:
        system.check_autonomous(
            f"and the steps of a batch `y0` by method {integrator.name!r} begin at times of their own",
            "pass one state at a time, or use a method of fixed steps",
        )


def indicator(
    orbits: Orbits,
    vectors: int,
    kind: int,
    below: float,
    t_eval: ArrayLike | None = None,
    deviations: ArrayLike | None = None,
    seed: int = 0,
    backend: str = "auto",
) -> Indicator:
    """An indicator of checked orbits, by so many vectors and a kind of their spread; that of growth is 0."""
    integrator, system = orbits.integrator, orbits.system
    check_followed(orbits)
    check_one_of("backend", backend, BACKENDS)
    t0, t1 = orbits.t_span
    times = np.empty(0) if t_eval is None else check_t_eval(t_eval, t0, t1)
    scale = weights(system)
    w0 = _deviations(deviations, vectors, scale, seed)
    length = integrator.step_length(system) if integrator.on_grid else None
    told, jumps = landings(integrator, system, t0, t1, backend != "compiled", kinks=False)
    if told:
        warn(told, RuntimeWarning)
    if length is not None:
        grid = Grid(t0, t1, length)
        if grid.n_steps == 0:
            raise ValueError(f"`t_span` is shorter than one step of {abs(grid.h):g}: end it later, or reduce `dt`.")
        orbits = orbits._replace(t_span=(t0, grid.time(grid.n_steps)))
        if not jumps:
            kernel = compiled_loops(lambda: integrator.tangent_kernel(system, vectors), orbits.y0, backend)
            if kernel is not None:
                run = _compiled(kernel, grid, orbits, w0, scale, times, kind, below)
                return _reported(run, orbits, times, kind, below)
    elif backend == "compiled":
        raise ValueError(f"`backend` 'compiled' does not apply to method {integrator.name!r}: use 'auto'.")
    with naming_plugin(integrator):
        run = _by_arrays(orbits, w0, scale, times, kind, below)
    return _reported(run, orbits, times, kind, below)


def _deviations(given: ArrayLike | None, vectors: int, scale: np.ndarray, seed: int) -> np.ndarray:
    """The vectors at the start, (k, 2d), of length 1 in the variables scale·y."""
    width = len(scale)
    if given is None:
        random = np.random.default_rng(seed).standard_normal((width, vectors))
        return np.ascontiguousarray(np.linalg.qr(random)[0].T) / scale
    shape = (width,) if vectors == 1 else (vectors, width)
    w0 = floats("deviations", given)
    if w0.shape != shape:
        raise ValueError(f"`deviations` must have shape {shape}; got {w0.shape}.")
    lengths = np.linalg.norm(scale * w0.reshape(vectors, width), axis=-1)
    if not (np.isfinite(lengths) & (lengths > 0)).all():
        raise ValueError("`deviations` must be finite and not 0: remove NaN and infinity.")
    return w0.reshape(vectors, width) / lengths[:, None]


def _compiled(
    kernel: Any,
    grid: Grid,
    orbits: Orbits,
    w0: np.ndarray,
    scale: np.ndarray,
    times: np.ndarray,
    kind: int,
    below: float,
) -> _Run:
    counts = np.array([grid.place(t)[0] for t in times], dtype=np.int64)
    save, where = np.unique(counts[counts > 0], return_inverse=True)
    spread_of = None if kind == NONE else partial(_spread, kind=kind)
    found = kernel.run(grid.h, orbits.rows, w0, grid.n_steps, save, spread_of, below, scale)
    start, N = int((counts == 0).sum()), len(orbits.rows)
    growth, spread = np.zeros((N, len(w0), len(times) + 1)), np.empty((N, len(times) + 1))
    spread[:] = _spread((scale * w0).T[None], kind)[0]
    growth[..., start:-1], growth[..., -1] = found.growth[..., where], found.growth[..., -1]
    spread[..., start:-1], spread[..., -1] = found.spread[..., where], found.spread[..., -1]
    elapsed = np.empty((N, len(times) + 1))
    elapsed[:, :-1], elapsed[:, -1] = counts * grid.h, found.n_steps * grid.h
    status = np.where(found.whole, np.where(found.n_steps < grid.n_steps, 1, 0), -1)
    return _Run(growth, spread, elapsed, status)


def _by_arrays(orbits: Orbits, w0: np.ndarray, scale: np.ndarray, times: np.ndarray, kind: int, below: float) -> _Run:
    """The same by the differentiated steps of the run, executed as a stream."""
    t0, t1 = orbits.t_span
    N, n = len(orbits.rows), len(times)
    sign = 1.0 if t1 >= t0 else -1.0
    W = np.broadcast_to(w0.T, (N, *w0.T.shape)).copy()
    exponents = np.zeros((N, len(w0)))
    growth, spread = np.full((N, len(w0), n + 1), np.nan), np.full((N, n + 1), np.nan)
    run = _Run(growth, spread, np.zeros((N, n + 1)), np.zeros(N, dtype=int))
    position = np.zeros(N, dtype=int)
    running = np.ones(N, dtype=bool)
    elapsed = np.zeros(N)

    def scaled(vectors: np.ndarray) -> np.ndarray:
        return scale[:, None] * vectors

    def note(rows: np.ndarray, column: np.ndarray) -> None:
        run.growth[rows, :, column] = LOG_2 * exponents[rows] + np.log(np.linalg.norm(scaled(W[rows]), axis=1))
        run.spread[rows, column] = _spread(scaled(W[rows]), kind)
        run.elapsed[rows, column] = elapsed[rows]

    for t, h, move in orbits.integrator.jvp_steps(orbits.system, orbits.t_span, orbits.rows):
        ends = t + h - t0
        if n:
            due = running & (position < n)
            while due.any():
                due &= sign * ends > sign * (times[np.minimum(position, n - 1)] - t0) + 1e-12 * np.abs(ends)
                note(np.flatnonzero(due), position[due])
                position[due] += 1
                due &= position < n
        with np.errstate(all="ignore"):
            moved = move(W)
            finite = np.isfinite(np.square(scaled(moved)).sum(axis=1)).all(axis=-1)
        run.status[running & ~finite] = -1
        running &= finite
        W = np.where(running[:, None, None], moved, W)
        elapsed = np.where(running, ends, elapsed)
        lengths = np.linalg.norm(scaled(W), axis=1)
        powers = np.where(running[:, None] & (lengths > 0), np.frexp(lengths)[1], 0)
        W, exponents = np.ldexp(W, -powers[:, None, :]), exponents + powers
        if below > 0:
            aligned = running & (_spread(scaled(W), kind) < below)
            run.status[aligned] = 1
            running &= ~aligned
        if not running.any():
            break
    run.status[running & (np.abs(elapsed) < (1 - 1e-9) * abs(t1 - t0))] = -1  # the stream of steps ended before
    running &= run.status == 0
    run.elapsed[:, -1] = elapsed
    done = np.flatnonzero(run.status >= 0)
    note(done, np.full(len(done), n))
    reached = np.flatnonzero(running)
    for column in range(n):
        late = reached[position[reached] <= column]
        note(late, np.full(len(late), column))
    return run


def _spread(W: np.ndarray, kind: int) -> np.ndarray:
    """Spread (N,) of vectors (N, 2d, k), of a kind."""
    if kind == NONE:
        return np.full(len(W), np.nan)
    unit = W / np.linalg.norm(W, axis=1, keepdims=True)
    if kind == VOLUME:
        return _volume(np.moveaxis(unit, -1, 0))
    u, v = unit[..., 0], unit[..., 1]
    return np.minimum(np.linalg.norm(u + v, axis=-1), np.linalg.norm(u - v, axis=-1))


def _volume(vectors: np.ndarray) -> np.ndarray:
    """Volume (N,) of the parallelepiped of vectors (k, N, 2d), which are made orthogonal one by one, each twice."""
    total = np.ones(vectors.shape[1])
    basis: list[np.ndarray] = []
    for vector in vectors:
        w = vector
        for u in 2 * basis:
            w = w - np.einsum("ni,ni->n", u, w)[:, None] * u
        length = np.linalg.norm(w, axis=1)
        total *= length
        basis.append(w / np.where(length > 0, length, 1.0)[:, None])
    return total


def _reported(run: _Run, orbits: Orbits, times: np.ndarray, kind: int, below: float) -> Indicator:
    try_steps(orbits.integrator, orbits.system, orbits.t_span, orbits.rows)
    values = run.spread
    if kind == NONE:
        with np.errstate(all="ignore"):
            values = run.growth[:, 0] / np.abs(run.elapsed)
        values = np.where(np.isfinite(values), values, np.nan)
    n_failed, n_aligned = int((run.status < 0).sum()), int((run.status == 1).sum())
    message = FINISHED
    if n_failed:
        first = int(np.argmax(run.status < 0))
        message = (
            f"{n_failed} of {len(values)} orbits ceased to be finite, the first of them (index {first}) after t = "
            f"{orbits.t_span[0] + run.elapsed[first, -1]:.15g}. Reduce `dt`, or end `t_span` earlier."
        )
    elif n_aligned:
        message = f"{n_aligned} of {len(values)} orbits ended early: the index fell below {below:g}."

    def shaped(x: np.ndarray) -> Any:
        return x.reshape(orbits.batch + x.shape[1:])[()]

    t_end = orbits.t_span[0] + run.elapsed[:, -1]
    value, end, status, history = map(shaped, (values[:, -1], t_end, run.status, values[:, :-1]))
    measure = "Lyapunov exponent" if kind == NONE else "GALI" if kind == VOLUME else "SALI"
    return Indicator(value, end, status, message, times, np.asarray(history), measure)
