"""Compiled runs, in the physical time, of methods whose steps are equal in another time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from types import ModuleType
from weakref import WeakKeyDictionary

import numpy as np

from sympflow.hamiltonian.symbolic import SymbolicHamiltonian
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.codegen import algebra_source, statements
from sympflow.kernels.loop_functions import symbolic_module
from sympflow.kernels.modules import load_algebra
from sympflow.kernels.stages import run_table, step_table
from sympflow.kernels.terms import is_large
from sympflow.kernels.threads import run_one, run_rows
from sympflow.schemes import Scheme

__all__ = ["lifted_rows", "reach_times"]

FEWEST, MANY = 1000, 8.0  # steps after which a run is given up: these, and so many times the expected ones
_LOOPS: WeakKeyDictionary[SymbolicHamiltonian, ModuleType] = WeakKeyDictionary()
_LIFTS: WeakKeyDictionary[SymbolicHamiltonian, Callable[..., bool]] = WeakKeyDictionary()


def reach_times(
    system: HamiltonianSystem,
    scheme: Scheme,
    h: float,
    y0: np.ndarray,
    times: np.ndarray,
    stride: int,
    expected: float,
    clock: Sequence[float] = (),
) -> tuple[np.ndarray, np.ndarray] | None:
    """The states at elapsed times of a scheme with equal steps on a logarithmic Hamiltonian, each by a shorter step.

    Parameters
    ----------
    system : HamiltonianSystem
        The transformed one, symbolic, with states [q, t, p, B].
    scheme : Scheme
        Without force gradients.
    h : float
        Step in the other time, negative to go back.
    y0 : ndarray of shape (N, 2d + 2)
        With t = 0.
    times : ndarray of shape (n,)
        Elapsed ones, increasing, positive for every sign of h.
    stride : int
        Steps between two looks at the time.
    expected : float
        Steps that a run takes, roughly; after many more it is given up.
    clock : sequence of float
        Of a trained clock: the numbers c_k of what it adds to t in a step s, Σ_k c_k s^(3+2k) B^k, the last one first.

    Returns
    -------
    Y : ndarray of shape (n, N, 2d)
        [q, p].
    counts : ndarray of int64, shape (N, 2)
        The steps taken, and those tried to meet the times.

    None where a trajectory does not reach its times: because a state is not finite, time turns, or steps run out.
    """
    loops = _loops(system)
    run, step = run_table(scheme, h).packed, _step(scheme)
    n_rows = len(y0)
    out = np.empty((len(times), n_rows, y0.shape[1] - 2))
    counts = np.zeros((n_rows, 2), dtype=np.int64)
    most_steps, work = int(FEWEST + MANY * expected), int(expected * run.shape[1] * system.ndof)
    numbers = _numbers(tuple(clock))
    if n_rows == 1:
        reached = run_one(
            lambda stop: loops.reach_times(run, step, h, numbers, y0, times, stride, most_steps, out, counts, stop),
            work,
        )
        return (out, counts) if reached else None
    done = []

    def rows(i: slice, stop: np.ndarray) -> None:
        done.append(
            loops.reach_times_lanes(
                run, step, h, numbers, y0, i.start, i.stop, times, stride, most_steps, out, counts, stop
            )
        )

    run_rows(rows, n_rows, work, None)
    return (out, counts) if all(done) else None


def lifted_rows(system: HamiltonianSystem, y: np.ndarray, c: float) -> np.ndarray | None:
    """States [q, t, p, B] (N, 2d + 2) with t = 0 and B = c − H of rows of `y` (N, 2d) of a symbolic system.

    None unless c exceeds V at all of them, or where H has no compiled form or is too large for states that are tuples.
    """
    symbols = system.symbols
    assert symbols is not None
    if is_large(symbols):
        return None
    lift = _LIFTS.get(symbols)
    if lift is None:
        lift = _LIFTS[symbols] = _compiled_lift(symbols)
    out = np.empty((len(y), y.shape[1] + 2))
    return out if lift(np.ascontiguousarray(y), c, out) else None


def _compiled_lift(symbols: SymbolicHamiltonian) -> Callable[..., bool]:
    d = symbols.ndof
    try:
        energies = statements(["V", "T"], [symbols.V, symbols.T])
    except ValueError:  # a function in H has no compiled form
        return lambda y, c, out: False
    lines = [f"{v} = y[n, {i}]" for i, v in enumerate(symbols.q + symbols.p)]
    lines += [*energies, "fine &= V < c", f"out[n, {d}], out[n, {2 * d + 1}] = 0.0, c - (T + V)"]
    lines += [f"out[n, {i + (i >= d)}] = {v}" for i, v in enumerate(symbols.q + symbols.p)]
    body = "\n        ".join(lines)
    return load_algebra(f"""@njit(**OPTIONS)
def lift(y, c, out):
    fine = True
    for n in range(y.shape[0]):
        {body}
    return fine
""").lift


def _loops(system: HamiltonianSystem) -> ModuleType:
    symbols = system.symbols
    assert symbols is not None
    loops = _LOOPS.get(symbols)
    if loops is None:
        after = ("loops", "lanes", "elapsed_times")
        loops = _LOOPS[symbols] = symbolic_module(symbols, algebra_source(symbols), 0, False, after)
    return loops


@lru_cache(maxsize=256)
def _step(scheme: Scheme) -> np.ndarray:
    """The table of one step for h = 1, (2, m)."""
    return np.ascontiguousarray(step_table(scheme).packed[..., 0])


@lru_cache(maxsize=64)
def _numbers(clock: tuple[float, ...]) -> np.ndarray:
    return np.array(clock, dtype=float)
