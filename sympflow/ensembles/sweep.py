"""ensemble(): very many orbits of one system, over parameters too, on one machine or many."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import (
    MAX_ASKED_VALUES,
    check_counts,
    check_t_eval,
    check_t_span,
    floats,
)
from sympflow.arrays import is_tensor
from sympflow.ensembles.chunks import MOST_VALUES, Chunk
from sympflow.ensembles.reductions import Fields, Reduction, reduction
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.contract import Integrator
from sympflow.integrators.registry import build, check_applies
from sympflow.kernels.modules import at_most
from sympflow.solver import BACKENDS, check_y0
from sympflow.workers import LostWorkers, Unpicklable, checked_workers, mapped

DRAWN = 4096
"""States that a sampler draws at a time, from a seed and their number, so that no state depends on the chunks."""
MOST_WORK = 50_000_000
"""Steps times degrees of freedom of a chunk, of about a quarter of a second."""
LONGEST_CHUNK, SHORTEST_CHUNK = 65536, 64
PIECES = 16  # chunks, or more, of which a large ensemble is made


def ensemble(
    system: HamiltonianSystem,
    method: Any = "sympflow",
    t_span: tuple[float, float] | None = None,
    y0: Any = None,
    *,
    n: int | None = None,
    seed: int = 0,
    params: Mapping[str, ArrayLike] | None = None,
    t_eval: ArrayLike | None = None,
    reduce: Any = None,
    workers: Any = 1,
    chunk: int | None = None,
    progress: bool | Callable[[int, int], Any] = False,
    backend: str = "auto",
    **options: Any,
) -> Ensemble:
    """Solve for many initial states, and for many values of parameters.

    The result of each orbit is the same to the last bit whatever the workers, the chunks and their order.

    Parameters
    ----------
    system : HamiltonianSystem
    method : str, Integrator, or trained flow
        As for `solve`.
    t_span : (float, float), optional
        The default is the system's.
    y0 : array_like of shape (N, 2d) or (2d,), Domain, or callable, optional
        The initial states; or a domain from which `n` are drawn; or a sampler ``y0(rng, n)`` that returns n states
        (n, 2d), drawn with a `numpy.random.Generator`. It is called for 4096 states at a time, each time with a
        generator of its own. The default is the system's state.
    n : int, optional
        States to draw.
    seed : int
        For drawing.
    params : mapping of str to array_like of shape (k,) or (), optional
        Values of parameters of the system. Arrays span a grid, with an axis for each in front of that of the orbits; a
        number replaces the system's value.
    t_eval : array_like of shape (m,), optional
        Times to report, or that `reduce` sees. The default is every step.
    reduce : str, Reduction, or callable, optional
        What is kept of each orbit instead of its states: a name of `sympflow.ensembles.reductions.REDUCTIONS`, such as
        "final"; or a function of (t, y), the times (m,) and states (2d, m) of one orbit, that returns a number, an
        array, or a dict of such.
    workers : int, object with .map, or callable
        A number of threads, or of processes where Python code has to run for each orbit or step, −1 for as many as
        there are cores; a `concurrent.futures.Executor`, a `dask.distributed.Client`, or anything else with `.map`;
        a function such as `map`; or a `joblib.Parallel`.
    chunk : int, optional
        Orbits that a worker is given at a time.
    progress : bool or callable
        True prints how far the ensemble is; a callable is called with the numbers of orbits done and in all.
    backend : "auto", "compiled" or "array"
        As for `solve`.
    **options
        Options of the method.

    Returns
    -------
    Ensemble
        An orbit that fails has status −1 and a message; the others go on.

    Raises
    ------
    ValueError, TypeError
        For bad arguments, at once.
    RuntimeError
        If workers die again and again.

    Examples
    --------
    >>> import sympflow
    >>> system = sympflow.systems.henon_heiles()
    >>> result = sympflow.ensemble(system, "verlet", (0, 10), system.domain, n=100, dt=0.1, reduce="final")
    >>> result.final.shape
    (100, 4)
    """
    if not isinstance(system, HamiltonianSystem):
        raise TypeError(f"`system` must be a HamiltonianSystem; got {type(system).__name__}.")
    integrator = build(method, options)
    t0, t1 = check_t_span(system.t_span if t_span is None else t_span)
    times = None if t_eval is None else check_t_eval(t_eval, t0, t1)
    if not isinstance(backend, str) or backend not in BACKENDS:
        raise ValueError(f"`backend` must be one of {', '.join(map(repr, BACKENDS))}; got {backend!r}.")
    workers = checked_workers(workers)
    kept = reduction(reduce)
    orbits = _orbits(system, y0, n, seed)
    fixed, axes = _axes(system, params)
    if fixed:
        changed: Any = system
        system = changed.with_params(**fixed)
    first = orbits.states(0, min(len(orbits), SHORTEST_CHUNK))
    integrator = integrator.resolved(system, first, abs(t1 - t0))
    check_applies(integrator, system, first)
    task = Task(system, integrator, (t0, t1), times, axes, kept, backend)
    problem = task.problem(first)
    with at_most(1):
        fields = kept.fields(problem)
    shape = (*(len(values) for values in axes.values()), len(orbits))
    size = sum(math.prod(s) for s, _ in fields.values())
    if math.prod(shape) * size > MAX_ASKED_VALUES:
        raise ValueError(
            f"`reduce` keeps {size} numbers of each of {' × '.join(map(str, shape))} = {math.prod(shape):,} orbits, "
            f"{math.prod(shape) * size * 8 / 2**30:.3g} GiB in all, more than {MAX_ASKED_VALUES:.0e} numbers: keep "
            "less, by `t_eval` or `reduce`."
        )
    if chunk is None:
        chunk = default_chunk(problem, size, math.prod(shape))
    check_counts(chunk=chunk)
    pieces = blocks(shape, int(chunk))
    parallel = kept.in_python or not problem.compiled

    result = Ensemble(problem.t_eval, dict(fields), orbits, axes, shape, system, integrator, (t0, t1))
    report = _reporter(progress, math.prod(shape))
    items = ((piece, orbits.sent(*piece.ranges[-1])) for piece in pieces)
    start = time.perf_counter()
    try:
        for index, done in mapped(run_piece, task, items, workers, processes=parallel):
            result.place(pieces[index], done)
            report(pieces[index].size)
    except Unpicklable as error:
        raise _unpicklable(task, orbits, error) from error
    except LostWorkers as error:
        raise RuntimeError(f"{error} Nothing is kept of this run.") from error
    result.wall_time = time.perf_counter() - start
    return result


# the orbits ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Given:
    """Initial states that were given."""

    y0: np.ndarray

    def __len__(self) -> int:
        return len(self.y0)

    def states(self, start: int, stop: int) -> np.ndarray:
        return self.y0[start:stop]

    def sent(self, start: int, stop: int) -> Given:
        """What a worker needs for the states start … stop: these, numbered from 0."""
        return Given(self.y0[start:stop])


@dataclass(frozen=True)
class Drawn:
    """Initial states that a sampler draws where they are needed, `DRAWN` at a time."""

    sampler: Any
    n: int
    seed: int
    width: int
    start: int = 0

    def __len__(self) -> int:
        return self.n

    def states(self, start: int, stop: int) -> np.ndarray:
        start, stop = self.start + start, self.start + stop
        out = np.empty((stop - start, self.width))
        for block in range(start // DRAWN, -(-stop // DRAWN)):
            low, high = max(start, block * DRAWN), min(stop, (block + 1) * DRAWN)
            out[low - start : high - start] = self._block(block)[low - block * DRAWN : high - block * DRAWN]
        return out

    def _block(self, block: int) -> np.ndarray:
        seeds = np.random.SeedSequence([self.seed, block])
        if isinstance(self.sampler, Domain):
            return self.sampler.sample(DRAWN, int(seeds.generate_state(1)[0]))
        states = np.asarray(self.sampler(np.random.default_rng(seeds), DRAWN))
        if states.shape != (DRAWN, self.width) or states.dtype.kind not in "fiu":
            raise ValueError(
                f"`y0` must draw real states of shape ({DRAWN}, {self.width}) when called with (rng, {DRAWN}); got "
                f"{states.dtype} of shape {states.shape}."
            )
        if not np.isfinite(states).all():
            raise ValueError("`y0` draws states that are not finite: mend the sampler.")
        return states

    def sent(self, start: int, stop: int) -> Drawn:
        """What a worker needs for the states start … stop: the sampler, and where to begin."""
        return Drawn(self.sampler, stop - start, self.seed, self.width, self.start + start)


def _orbits(system: HamiltonianSystem, y0: Any, n: int | None, seed: int) -> Given | Drawn:
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"`seed` must be an integer, 0 or more; got {seed!r}.")
    samples = isinstance(y0, Domain) or (callable(y0) and not isinstance(y0, type))
    if samples:
        if n is None:
            raise ValueError("`n` is needed: the number of states to draw from `y0`.")
        check_counts(n=n)
        drawn = Drawn(y0, int(n), int(seed), 2 * system.ndof)
        if isinstance(y0, Domain) and y0.sample(1).shape != (1, drawn.width):
            raise ValueError(
                f"`y0` is a domain of states of another length than {drawn.width}, that of {system.name!r}."
            )
        return drawn
    if n is not None:
        raise ValueError("`n` is for drawing states from a domain or a sampler: leave it out, or pass one as `y0`.")
    if is_tensor(y0):
        raise TypeError("`y0` is a tensor, which an ensemble does not take: pass y0.numpy().")
    given = check_y0(system, system.y0 if y0 is None else y0, None)
    if given.ndim > 2:
        raise ValueError(f"`y0` must have shape (N, {given.shape[-1]}); got {given.shape}: reshape it.")
    return Given(np.atleast_2d(given))


def _axes(
    system: HamiltonianSystem, params: Mapping[str, ArrayLike] | None
) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """The parameters that are numbers, and those that are axes."""
    if params is None:
        return {}, {}
    if not isinstance(params, Mapping):
        raise TypeError(f"`params` must map names of parameters to values; got {type(params).__name__}.")
    fixed: dict[str, float] = {}
    axes: dict[str, np.ndarray] = {}
    for name, given in params.items():
        if name not in system.params:
            names = ", ".join(system.params) or "none"
            raise ValueError(
                f"`params` has {name!r}, which the system {system.name!r} has not: its parameters are {names}."
            )
        values = floats("params", given)
        if values.ndim > 1 or values.size == 0 or not np.isfinite(values).all():
            raise ValueError(
                f"`params` must give {name!r} a finite number, or a list of them; got shape {values.shape}. For "
                "parameters that vary together call `solve` with arrays of the length of the batch."
            )
        if values.ndim:
            axes[name] = values
        else:
            fixed[name] = float(values)
    return fixed, axes


# chunks --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Block:
    """A block of the grid of parameters and orbits: its ranges, one an axis; in C order its orbits are consecutive."""

    ranges: tuple[tuple[int, int], ...]
    first: int

    @property
    def size(self) -> int:
        return math.prod(stop - start for start, stop in self.ranges)

    @property
    def index(self) -> tuple[slice, ...]:
        return tuple(slice(*ends) for ends in self.ranges)

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(stop - start for start, stop in self.ranges)


def chunk_shape(shape: tuple[int, ...], chunk: int) -> tuple[int, ...]:
    """The shape of a block of at most `chunk` orbits: whole axes at the end, a part of one before them."""
    lengths, left = [], chunk
    for length in reversed(shape):
        lengths.append(min(length, max(1, left)))
        left = left // length
    return tuple(reversed(lengths))


def blocks(shape: tuple[int, ...], chunk: int) -> list[Block]:
    """The blocks of a grid, in C order."""
    sizes = chunk_shape(shape, chunk)
    axes = [[(i, min(i + k, n)) for i in range(0, n, k)] for n, k in zip(shape, sizes, strict=True)]
    return [
        Block(ranges, int(np.ravel_multi_index([start for start, _ in ranges], shape)))
        for ranges in itertools.product(*axes)
    ]


def default_chunk(problem: Chunk, size: int, total: int) -> int:
    """Orbits of a chunk: for a quarter of a second of compiled steps, and no more than memory that is soon filled."""
    t0, t1 = problem.t_span
    length = problem.integrator.step_length(problem.system) or problem.system.dt
    work = max(1, int(abs(t1 - t0) / length)) * problem.system.ndof
    most = min(MOST_WORK // work, MOST_VALUES // max(size, 2 * problem.system.ndof), LONGEST_CHUNK, total // PIECES)
    return SHORTEST_CHUNK * max(1, most // SHORTEST_CHUNK)


@dataclass(frozen=True)
class Task:
    """What all chunks of an ensemble have in common: a definition that is small when pickled."""

    system: HamiltonianSystem
    integrator: Integrator
    t_span: tuple[float, float]
    t_eval: np.ndarray | None
    axes: dict[str, np.ndarray]
    reduction: Reduction
    backend: str

    def problem(self, y0: np.ndarray) -> Chunk:
        """The chunk of some first orbits, at the first values of the parameters."""
        return self.chunk({name: values[0] for name, values in self.axes.items()}, y0, 0)

    def chunk(self, values: Mapping[str, float], y0: np.ndarray, first: int) -> Chunk:
        """A chunk of orbits with the same parameters."""
        system: Any = self.system
        system = system.with_params(**values) if values else system
        return Chunk(system, self.integrator, self.t_span, self.t_eval, y0, backend=self.backend, first=first)


@dataclass(frozen=True)
class Done:
    """The fields (n, ...) of the orbits of a block, their statuses (n,), and the messages of those that failed."""

    fields: dict[str, np.ndarray]
    status: np.ndarray
    messages: dict[int, str]


def run_piece(task: Task, item: tuple[Block, Given | Drawn]) -> Done:
    """Run the orbits of a block, on this thread alone."""
    block, orbits = item
    y0 = orbits.states(0, len(orbits))
    grid = [values[slice(*ends)] for values, ends in zip(task.axes.values(), block.ranges[:-1], strict=True)]
    parts: list[Done] = []
    with at_most(1):
        for i, values in enumerate(itertools.product(*grid)):
            named = dict(zip(task.axes, map(float, values), strict=True))
            chunk = task.chunk(named, y0, block.first + i * len(y0))
            fields = task.reduction.reduce(chunk)
            parts.append(Done(fields, chunk.status, {i * len(y0) + k: text for k, text in chunk.messages.items()}))
    if len(parts) == 1:
        return parts[0]
    fields = {name: np.concatenate([part.fields[name] for part in parts]) for name in parts[0].fields}
    messages = {row: text for part in parts for row, text in part.messages.items()}
    return Done(fields, np.concatenate([part.status for part in parts]), messages)


def _unpicklable(task: Task, orbits: Given | Drawn, error: Exception) -> TypeError:
    """The error that names which argument cannot be sent to processes."""
    from sympflow.workers import Parcel

    parts = {"system": task.system, "method": task.integrator, "reduce": task.reduction, "y0": orbits.sent(0, 1)}
    for name, part in parts.items():
        try:
            Parcel(part).pack()
        except Unpicklable as why:
            return TypeError(
                f"`{name}` cannot be sent to the processes of `workers` ({why}): define its functions in a module, or "
                "use workers=1."
            )
    return TypeError(f"`workers` cannot be sent their work ({error}): use workers=1.")


# the result ----------------------------------------------------------------------------------------------------------


@dataclass
class Ensemble:
    """The result of `ensemble`.

    Attributes
    ----------
    t : ndarray of shape (m,) or None
        The times of `t_eval`.
    y : ndarray of shape (..., N, 2d, m)
        The states, where nothing was reduced; an axis in front for each of `params` that is an array.
    fields : dict of str to ndarray of shape (..., N, ...)
        What was kept of each orbit, by name; each is an attribute too.
    status : ndarray of shape (..., N), of int8
        0, or −1 for an orbit that failed, whose row is NaN.
    messages : dict of tuple of int to str
        Messages of the orbits that failed, by their indices.
    params : dict of str to ndarray
        The axes of the grid of parameters.
    y0 : ndarray of shape (N, 2d)
    wall_time : float
        Seconds.
    """

    t: np.ndarray | None
    layout: Fields = field(repr=False)
    orbits: Given | Drawn = field(repr=False)
    params: dict[str, np.ndarray]
    shape: tuple[int, ...]
    system: HamiltonianSystem = field(repr=False)
    integrator: Integrator
    t_span: tuple[float, float]
    wall_time: float = 0.0
    fields: dict[str, np.ndarray] = field(init=False, repr=False)
    status: np.ndarray = field(init=False, repr=False)
    messages: dict[tuple[int, ...], str] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        self.fields = {name: np.empty((*self.shape, *shape), dtype) for name, (shape, dtype) in self.layout.items()}
        self.status = np.zeros(self.shape, dtype=np.int8)

    def place(self, block: Block, done: Done) -> None:
        """Put the orbits of a block where they belong."""
        for name, values in done.fields.items():
            self.fields[name][block.index] = values.reshape(*block.shape, *values.shape[1:])
        self.status[block.index] = done.status.reshape(block.shape)
        for row, text in done.messages.items():
            index = np.unravel_index(block.first + row, self.shape)
            self.messages[tuple(map(int, index))] = text

    def __getattr__(self, name: str) -> Any:
        fields = self.__dict__.get("fields", {})
        if name in fields:
            return fields[name]
        raise AttributeError(f"the ensemble has no {name!r}: of each orbit it has {', '.join(fields) or 'nothing'}.")

    @property
    def y0(self) -> np.ndarray:
        """The initial states (N, 2d)."""
        return self.orbits.states(0, len(self.orbits))

    @property
    def success(self) -> bool:
        """True if no orbit failed."""
        return not self.status.any()

    @property
    def message(self) -> str:
        """What became of the orbits, in words."""
        failed = int(np.count_nonzero(self.status))
        if not failed:
            return f"All {self.status.size:,} orbits reached the end."
        index, text = min(self.messages.items())
        return f"{failed:,} of {self.status.size:,} orbits failed, the first of them {list(index)}: {text}"


def _reporter(progress: bool | Callable[[int, int], Any], total: int) -> Callable[[int], None]:
    if not (isinstance(progress, bool) or callable(progress)):
        raise TypeError(f"`progress` must be True, False, or a function of (done, total); got {progress!r}.")
    done = 0

    def report(more: int) -> None:
        nonlocal done
        done += more
        if callable(progress):
            progress(done, total)
        elif progress:
            print(f"\r{done:,} of {total:,} orbits", end="" if done < total else "\n", flush=True)

    return report
