"""ensemble(): very many orbits of one system, over parameters too, on one machine or many."""

from __future__ import annotations

import itertools
import math
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import MAX_ASKED_VALUES, check_counts, check_flag, check_t_eval, check_t_span, floats
from sympflow.ensembles.chunks import FAILED, LONGEST_MESSAGE, MOST_VALUES, Chunk
from sympflow.ensembles.orbits import Drawn, Given, initial_states
from sympflow.ensembles.reductions import Fields, Reduction, reduction
from sympflow.ensembles.results import Block, Done, Ensemble, Keeper, Layout, Memory, blocks, chunk_shape
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.choosing import integrator_for, with_start
from sympflow.integrators.contract import Integrator, Problem
from sympflow.integrators.diagnosis import try_steps
from sympflow.integrators.problems import check_backend, check_own_parameters
from sympflow.integrators.provenance import provenance
from sympflow.integrators.registry import check_applies
from sympflow.kernels.threads import at_most
from sympflow.systems.given import GivenSystem, given_system
from sympflow.workers import LostWorkers, PickledTask, Unpicklable, checked_workers, mapped

if TYPE_CHECKING:
    from sympflow.ensembles.stores import EnsembleStore

MOST_WORK = 50_000_000  # steps times degrees of freedom of a chunk, of about a quarter of a second
LONGEST_CHUNK, SHORTEST_CHUNK = 65536, 64
PIECES = 16  # chunks, or more, of which a large ensemble is made
MOST_PIECES = 10_000_000
_preparing = threading.Lock()


def ensemble(
    system: GivenSystem,
    method: Any = None,
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
    store: str | os.PathLike[str] | None = None,
    resume: bool = False,
    same: bool = False,
    progress: bool | Callable[[int, int], Any] = False,
    backend: str = "auto",
    **options: Any,
) -> Ensemble:
    """Solve for many initial states, and for many values of parameters.

    The result of each orbit does not depend on the workers, the chunks or their order, to the last bit.

    Parameters
    ----------
    system : HamiltonianSystem
    method : str, Integrator, or trained flow, optional
        As for `solve`: by default one that suits the system.
    t_span : (float, float), optional
        The default is the system's.
    y0 : array_like of shape (N, 2d) or (2d,), Domain, or callable, optional
        The initial states; or a domain from which `n` are drawn; or a sampler ``y0(rng, n)`` that returns n states
        (n, 2d), drawn with a `numpy.random.Generator`. It is called for 4096 states at a time, each time with a
        generator of its own. The default is the system's state.
    n : int, optional
        Number of states to draw.
    seed : int
        Seed of the drawn states.
    params : mapping of str to array_like of shape (k,) or (), optional
        Values of parameters of the system. Arrays span a grid, with an axis for each in front of that of the orbits; a
        number replaces the system's value.
    t_eval : array_like of shape (m,), optional
        Times to report, or at which `reduce` is given states. The default is every step.
    reduce : str, Reduction, or callable, optional
        The result of each orbit instead of its states: a name of `sympflow.ensembles.reductions.REDUCTIONS`, such as
        "final"; or a function of (t, y), the times (m,) and states (2d, m) of one orbit, that returns a number, an
        array, or a dict of such.
    workers : int, object with .map, or callable
        A number of threads, or of processes where Python code runs for each orbit or step, −1 for as many as
        there are cores; a `concurrent.futures.Executor`, a `dask.distributed.Client`, or anything else with `.map`;
        a function such as `map`; or a `joblib.Parallel`.
    chunk : int, optional
        Number of orbits in one task of a worker; an existing store keeps its own.
    store : path, optional
        A folder, in zarr's format, into which the workers write each chunk of results when it is done, so that no
        results stay in memory. `xarray.open_zarr` reads it; workers on other machines must see it by the same path.
    resume : bool
        Continue with the store of the same ensemble, if there is one: finished chunks are not computed again. Ensembles
        are compared by everything that defines them, functions and classes by their code and the values that they use.
    same : bool
        With `resume`, assume that functions and Python objects are those of the store. Use it where they cannot be
        compared, such as results of a compiled library, or where code was rewritten with the same meaning.
    progress : bool or callable
        True prints the progress; a callable is called with the number of finished orbits and of all.
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
        If workers die again and again. What is in the store is kept.
    OSError
        If the store cannot be written, as on a full disk. What is in it is kept.

    Examples
    --------
    >>> import sympflow
    >>> system = sympflow.systems.henon_heiles()
    >>> result = sympflow.ensemble(system, "verlet", (0, 10), system.domain, n=100, dt=0.1, reduce="final")
    >>> result.final.shape
    (100, 4)
    """
    system = given_system(system)
    t0, t1 = check_t_span(system.t_span if t_span is None else t_span)
    times = None if t_eval is None else check_t_eval(t_eval, t0, t1)
    workers = checked_workers(workers)
    check_flag("resume", resume)
    check_flag("same", same)
    if (resume or same) and store is None:
        raise ValueError(f"`{'resume' if resume else 'same'}` goes on with a `store`: name one.")
    kept = reduction(reduce)
    orbits = initial_states(system, y0, n, seed)
    fixed, axes = _axes(system, params)
    first = orbits.states(0, min(len(orbits), SHORTEST_CHUNK))
    integrator = integrator_for(system, method, options, (t0, t1), first, flows=not (fixed or axes))
    check_backend(backend, integrator)
    check_own_parameters(system, {**fixed, **axes}, integrator)
    if fixed:
        system = system.with_params(**fixed)
    system = with_start(integrator, system, first)
    integrator = integrator.resolved(system, first, abs(t1 - t0), 0 if times is None else len(times))
    check_applies(integrator, system if kept.own_loops else system.between_impulses, first)
    for system_of in _telling(system, axes):
        kept.check(system_of)
    varied = kept.takes_params and _runs_together(system, integrator, (t0, t1), axes, first, backend)
    task = Task(system, integrator, (t0, t1), times, axes, kept, backend, varied=varied)
    problem = task.problem(first)
    report = _reporter(progress, math.prod(map(len, axes.values())) * len(orbits))
    start = time.perf_counter()
    with at_most(1):
        fields = kept.fields(problem)
    task = replace(task, fields=fields)
    layout = Layout(axes, len(orbits), system.ndof, problem.times if kept.state == "y" else times, fields, kept.state)
    sizes = _chunk_shape(layout, problem, chunk, store is None, orbits.together)
    attributes = partial(provenance, system, integrator, (t0, t1))
    keeper: Keeper = Memory(layout, orbits, attributes)
    if store is not None:
        from sympflow.ensembles.stores import EnsembleStore, identity

        known = identity(system, integrator, (t0, t1), times, orbits, axes, kept, backend)
        keeper = made = EnsembleStore.at(store, layout, sizes, attributes(), known, bool(resume), bool(same))
        sizes, task = made.sizes, replace(task, store=made)
    pieces = blocks(layout.shape, sizes)
    left = [piece for piece in pieces if not keeper.is_done(piece)]
    report(sum(piece.size for piece in pieces) - sum(piece.size for piece in left))
    if left:
        try_steps(integrator, problem.system, problem.t_span, first)
    if left and workers != 1:  # what is compiled here is loaded by workers on this machine
        task.prepare(first)
    items = ((piece, orbits.sent(*piece.ranges[-1])) for piece in left)
    done = len(pieces) - len(left)
    try:
        for index, answer in mapped(run_piece, task, items, workers, processes=kept.in_python or not problem.compiled):
            keeper.place(left[index], answer)
            done += 1
            report(left[index].size)
    except Unpicklable as error:
        raise _unpicklable(task, orbits, error) from error
    except LostWorkers as error:
        whatever = "Nothing was kept: name a `store` to keep finished chunks."
        if store is not None:
            whatever = f"{done} of {len(pieces)} chunks are in `store` {str(store)!r}: call again with resume=True."
        raise RuntimeError(f"{error} {whatever}") from error
    keeper.finish()
    seconds = time.perf_counter() - start
    return Ensemble(layout.times, axes, system, integrator, (t0, t1), orbits, keeper, seconds)


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
        system.check_parameters([name])
        values = floats("params", given)
        if not np.isfinite(values).all():
            where = int(np.flatnonzero(~np.isfinite(np.ravel(values)))[0])
            raise ValueError(
                f"`params` has {name} = {np.ravel(values)[where]} at {where}: give finite numbers, or leave it out."
            )
        if values.ndim > 1 or values.size == 0:
            raise ValueError(
                f"`params` must give {name!r} a number, or a list of them; got shape {values.shape}. For "
                "parameters that vary together call `solve` with arrays of the length of the batch."
            )
        if values.ndim:
            axes[name] = values
        else:
            fixed[name] = float(values)
    return fixed, axes


def _general(axes: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Values of the parameters of which none makes its part of H vanish, or simpler, if there are such."""
    return {name: float(values[np.argmax(~np.isin(values, (0, 1, -1)))]) for name, values in axes.items()}


def _telling(system: HamiltonianSystem, axes: Mapping[str, np.ndarray]) -> Iterator[HamiltonianSystem]:
    """The systems that tell at once what a reduction is not for: with the first values, and with general ones."""
    if not axes:
        yield system
        return
    for values in ({name: float(values[0]) for name, values in axes.items()}, _general(axes)):
        try:
            yield system.with_params(**values)
        except (ValueError, TypeError):  # orbits of values without a system are rows that fail
            continue


def _runs_together(
    system: HamiltonianSystem,
    integrator: Integrator,
    t_span: tuple[float, float],
    axes: Mapping[str, np.ndarray],
    y0: np.ndarray,
    backend: str,
) -> bool:
    """True if one compiled run takes orbits with different parameters; else each value has runs of its own.

    It does not depend on the chunk, so that each orbit is run alike in any of them: a value that leaves its part of H
    as it is, other than 0, 1 and −1, tells for all.
    """
    from sympflow.hamiltonian.parameter_rows import ParameterRows

    if not axes or not system.definition.symbolic:
        return False
    general = {name: np.array([value]) for name, value in _general(axes).items()}
    try:
        (rows,) = ParameterRows(system, general).by_form()
    except ValueError:
        return False
    problem = Problem(rows.system, *t_span, y0[:1], backend=backend, parameter_values=rows.parameter_values)
    return rows.parameter_values is not None and integrator.takes_parameter_values(problem)


def _chunk_shape(layout: Layout, problem: Chunk, chunk: int | None, in_memory: bool, multiple: int) -> tuple[int, ...]:
    """The shape of a chunk; a ValueError says how large an ensemble is that does not fit."""
    size, total = sum(math.prod(s) for s, _ in layout.fields.values()), math.prod(layout.shape)
    grid = f"{' × '.join(f'{n:,}' for n in layout.shape)} orbits"
    if in_memory and total * size > MAX_ASKED_VALUES:
        raise ValueError(
            f"`store` is needed: {size:,} numbers of each of {grid} are {total * size * 8 / 2**30:.3g} GiB, more than "
            f"{MAX_ASKED_VALUES:.0e} numbers. Name one, or keep less by `t_eval` or `reduce`."
        )
    if chunk is None:
        t0, t1 = problem.t_span
        length = problem.integrator.step_length(problem.system) or problem.system.dt
        work = max(1, int(abs(t1 - t0) / length)) * problem.system.ndof
        most = min(MOST_WORK // work, MOST_VALUES // max(size, 2 * problem.system.ndof), LONGEST_CHUNK, total // PIECES)
        multiple = multiple if most >= multiple else SHORTEST_CHUNK
        chunk = multiple * max(1, most // multiple)
    check_counts(chunk=chunk)
    sizes = chunk_shape(layout.shape, int(chunk))
    values = math.prod(sizes) * size
    if values > MAX_ASKED_VALUES:
        raise ValueError(
            f"`chunk` of {math.prod(sizes):,} orbits with {size:,} numbers each is {values * 8 / 2**30:.3g} GiB, more "
            f"than {MAX_ASKED_VALUES:.0e} numbers: choose at most {max(1, MAX_ASKED_VALUES // size):,}."
        )
    pieces = math.prod(-(-n // k) for n, k in zip(layout.shape, sizes, strict=True))
    if pieces > MOST_PIECES:
        raise ValueError(
            f"`chunk` of {math.prod(sizes):,} cuts {grid} into {pieces:,} chunks, more than {MOST_PIECES:.0e}: choose "
            "a larger one, or a smaller grid."
        )
    return sizes


@dataclass(frozen=True)
class Task:
    """The common part of all chunks of an ensemble: a definition that is small when pickled."""

    system: HamiltonianSystem
    integrator: Integrator
    t_span: tuple[float, float]
    t_eval: np.ndarray | None
    axes: dict[str, np.ndarray]
    reduction: Reduction
    backend: str
    store: EnsembleStore | None = None
    fields: Fields = field(default_factory=dict)
    varied: bool = False
    """True if the orbits of a chunk run together whatever their parameters, in loops that take those of each."""
    ready: set[int] = field(default_factory=set)  # processes in which the method is compiled

    def prepare(self, y0: np.ndarray) -> None:
        """Compile the method, or load it, once in each process, by a few steps from some first orbits (n, 2d)."""
        if os.getpid() in self.ready:
            return
        with _preparing:
            if os.getpid() not in self.ready:
                self._few_steps(self.problem(y0[:2]))
                if self.varied:
                    ends = {name: values[[0, -1]] for name, values in self.axes.items()}
                    self._few_steps(replace(self.problem(y0[[0, 0]]), system=self.system, params=ends))
                self.ready.add(os.getpid())

    def _few_steps(self, problem: Chunk) -> None:
        length = problem.integrator.step_length(problem.system)
        if not problem.compiled or length is None:
            return
        t0, t1 = self.t_span
        end = t0 + math.copysign(min(abs(t1 - t0), 2.5 * length), t1 - t0)
        replace(problem, t_span=(t0, end)).states(np.linspace(t0, end, 12))

    def problem(self, y0: np.ndarray) -> Chunk:
        """The chunk of some first orbits, at the first values of the parameters."""
        return self.chunk({name: values[0] for name, values in self.axes.items()}, y0, 0)

    def whole(self, block: Block, y0: np.ndarray) -> Chunk:
        """The chunk of a block, each orbit with its own parameters."""
        grid = np.meshgrid(*(np.arange(*ends) for ends in block.ranges), indexing="ij")
        where = [index.ravel() for index in grid]
        params = {name: values[i] for (name, values), i in zip(self.axes.items(), where, strict=False)}
        states = y0[where[-1] - block.ranges[-1][0]]
        return Chunk(self.system, self.integrator, self.t_span, self.t_eval, states, params, self.backend, block.first)

    def chunk(self, values: Mapping[str, float], y0: np.ndarray, first: int) -> Chunk:
        """A chunk of orbits with the same parameters, which are its system's."""
        system = self.system.with_params(**values) if values else self.system
        return Chunk(system, self.integrator, self.t_span, self.t_eval, y0, backend=self.backend, first=first)


def run_piece(task: Task, item: tuple[Block, Given | Drawn]) -> Done:
    """Run the orbits of a block, on this thread alone, and write them into the store, if there is one."""
    block, orbits = item
    y0 = orbits.states(0, len(orbits))
    parts: list[Done] = []
    with at_most(1):
        task.prepare(y0)
        if task.varied:
            parts.append(_reduced(task, task.whole(block, y0), 0))
        else:
            grid = [values[slice(*ends)] for values, ends in zip(task.axes.values(), block.ranges[:-1], strict=True)]
            for i, values in enumerate(itertools.product(*grid)):
                named, start = dict(zip(task.axes, map(float, values), strict=True)), i * len(y0)
                try:
                    chunk = task.chunk(named, y0, block.first + start)
                    task.reduction.check(chunk.system)
                except (ValueError, TypeError) as error:
                    parts.append(_without_a_system(task, len(y0), start, named, error))
                else:
                    parts.append(_reduced(task, chunk, start))
    done = parts[0] if len(parts) == 1 else _joined(parts)
    if task.store is None:
        return done
    task.store.write(block, done, y0)
    return Done({}, done.status[:0], {})


def _reduced(task: Task, chunk: Chunk, start: int) -> Done:
    fields = task.reduction.reduce(chunk)
    for name, (_, dtype) in task.fields.items():
        found = np.asarray(fields[name]).dtype
        if not np.can_cast(found, dtype, "same_kind"):
            raise TypeError(f"`reduce` returns {name} as {found}, but its `fields` declare {dtype}: make them agree.")
    return Done(fields, chunk.status, {start + k: text for k, text in chunk.messages.items()})


def _without_a_system(task: Task, n: int, start: int, values: Mapping[str, float], error: Exception) -> Done:
    """The orbits of values of the parameters for which there is no system, or no such reduction: all failed."""
    unknown = {name: np.nan if dtype.kind in "fc" else 0 for name, (_, dtype) in task.fields.items()}
    fields = {name: np.full((n, *shape), unknown[name], dtype) for name, (shape, dtype) in task.fields.items()}
    shown = ", ".join(f"{name} = {value:.9g}" for name, value in values.items())
    text = f"`params` has {shown}: {error}"[:LONGEST_MESSAGE]
    return Done(fields, np.full(n, FAILED, dtype=np.int8), dict.fromkeys(range(start, start + n), text))


def _joined(parts: list[Done]) -> Done:
    fields = {name: np.concatenate([part.fields[name] for part in parts]) for name in parts[0].fields}
    messages = {row: text for part in parts for row, text in part.messages.items()}
    return Done(fields, np.concatenate([part.status for part in parts]), messages)


def _unpicklable(task: Task, orbits: Given | Drawn, error: Exception) -> TypeError:
    """The error that names which argument cannot be sent to processes."""
    parts = {"system": task.system, "method": task.integrator, "reduce": task.reduction, "y0": orbits.sent(0, 1)}
    for name, part in parts.items():
        try:
            PickledTask(part).pack()
        except Unpicklable as why:
            return TypeError(
                f"`{name}` cannot be sent to the processes of `workers` ({why}): define its functions in a module, or "
                "use workers=1."
            )
    return TypeError(f"`workers` cannot be sent their work ({error}): use workers=1.")


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
