"""Many orbits at once: `solve` beside the hand-written loop, a thousand values of a parameter beside one, and peers.

    python benchmarks/sweeps.py                     10⁵ orbits of Hénon–Heiles to T = 100, a minute
    python benchmarks/sweeps.py --orbits 1000000    a million
    python benchmarks/sweeps.py --peers             heyoka's ensembles and diffrax under vmap, with a 50th of the orbits

Final states, on all cores of the machine unless a row says one; the least wall time of five runs, in turn. The loop by
hand is that of `benchmarks/contenders/loops.py`, blocks of 64 orbits in vector instructions, on as many threads. Peers
run at a tolerance of 1e-9, and `solve` by a scheme and a step whose largest energy error is at most theirs: that of the
final states, the only ones that all of them have.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
from contenders.loops import LANES, OPTIONS, verlet_batch
from measuring import fragments
from numba import njit

from sympflow import HamiltonianSystem, solve
from sympflow.systems import henon_heiles

T, DT, TIMES, VALUES, TOLERANCE = 100.0, 0.1, 5, 1000, 1e-9
H = "(p1**2 + p2**2)/2 + (q1**2 + q2**2)/2 + lam*(q1**2*q2 - q2**3/3)"
by_hand = njit(**OPTIONS, nogil=True)(verlet_batch.py_func)
Run = Callable[[], np.ndarray]


def cores() -> int:
    return len(os.sched_getaffinity(0))


def threaded(y0: np.ndarray, n_steps: int) -> np.ndarray:
    """The loop by hand on a thread for each core."""
    parts = np.array_split(y0.reshape(-1, LANES, 4), cores())
    with ThreadPoolExecutor(len(parts)) as pool:
        pieces = pool.map(lambda part: by_hand(part.reshape(-1, 4), T / n_steps, n_steps), parts)
        return np.concatenate(list(pieces))


def on_one_core(run: Run) -> np.ndarray:
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        return run()
    finally:
        os.sched_setaffinity(0, allowed)


def least(runs: dict[str, Run], times: int = TIMES) -> dict[str, float]:
    """The least wall time of each, run in turn after a first run that compiles."""
    seconds = dict.fromkeys(runs, np.inf)
    for turn in range(times + 1):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            if turn:
                seconds[name] = min(seconds[name], time.perf_counter() - start)
    return seconds


def orbits(n: int) -> np.ndarray:
    """Bound orbits: n states [q, p] with |y_i| below 0.15, whose energies are below 1/6."""
    return np.random.default_rng(0).uniform(-0.15, 0.15, size=(n // LANES * LANES, 4))


def final(
    system: HamiltonianSystem, y0: np.ndarray, method: str = "verlet", dt: float = DT, **more: object
) -> np.ndarray:
    return solve(system, method, (0.0, T), y0, dt=dt, t_eval=[T], **more).y[..., -1]  # type: ignore[arg-type]


def ours(n: int) -> list[list[object]]:
    """Rows of one system and of a parameter."""
    y0, system = orbits(n), henon_heiles()
    swept = HamiltonianSystem.from_sympy(H, params={"lam": 0.9})
    grid = np.repeat(np.linspace(0.5, 0.95, VALUES), -(-len(y0) // VALUES))[: len(y0)]
    difference = np.abs(final(system, y0) - threaded(y0, round(T / DT))).max()
    assert difference < 1e-9, difference
    runs: dict[str, Run] = {
        "hand": partial(threaded, y0, round(T / DT)),
        "solve": partial(final, system, y0),
        "one": partial(on_one_core, partial(final, system, y0)),
        "value": partial(final, swept, y0),
        "values": partial(final, swept, y0, params={"lam": grid}),
        "value 8": partial(final, swept, y0, "kahan_li8", 2 * DT),
        "values 8": partial(final, swept, y0, "kahan_li8", 2 * DT, params={"lam": grid}),
    }
    s = least(runs)
    return [
        [f"`verlet`, loop by hand, {cores()} cores", s["hand"], 1.0],
        ["`verlet`, `solve`, to the loop by hand", s["solve"], s["solve"] / s["hand"]],
        [f"the same on one core, to {cores()}", s["one"], s["one"] / s["solve"]],
        [f"`verlet`, {VALUES} values of λ, to one", s["values"], s["values"] / s["value"]],
        [f"`kahan_li8`, {VALUES} values of λ, to one", s["values 8"], s["values 8"] / s["value 8"]],
    ]


def peers(n: int) -> list[list[object]]:
    """Rows of peers, each with the energy error of all orbits' ends."""
    import heyoka as hy

    y0, system = orbits(n), henon_heiles()
    H0 = system.hamiltonian(y0)
    q1, q2, p1, p2 = hy.make_vars("q1", "q2", "p1", "p2")
    field = [(q1, p1), (q2, p2), (p1, -q1 - 2 * q1 * q2), (p2, -q2 - q1 * q1 + q2 * q2)]
    taylor = hy.taylor_adaptive(field, [0.0] * 4, tol=TOLERANCE)

    def start(integrator: object, i: int) -> object:
        integrator.time, integrator.state[:] = 0.0, y0[i]  # type: ignore[attr-defined]
        return integrator

    def ensemble() -> np.ndarray:
        ended = hy.ensemble_propagate_until(taylor, T, len(y0), start, max_workers=cores())
        return np.array([row[0].state for row in ended])

    def in_turn() -> np.ndarray:
        states = np.empty_like(y0)
        for i in range(len(y0)):
            start(taylor, i)
            taylor.propagate_until(T)
            states[i] = taylor.state
        return states

    def error(states: np.ndarray) -> float:
        return float(np.abs(system.hamiltonian(states) - H0).max())

    runs: dict[str, Run] = {
        "heyoka's ensemble, a copy of its integrator for each orbit": ensemble,
        "heyoka, one integrator, one orbit after the other": in_turn,
        "diffrax, vmap": _diffrax(y0),
    }
    errors = {name: error(run()) for name, run in runs.items()}
    worst = min(errors.values())
    dt = next(h for h in 0.8 * 0.9 ** np.arange(60) if error(final(system, y0, "srkn14a", h)) <= worst)
    name = f"`srkn14a`, dt = {dt:.3g}, `solve`"
    runs[name] = partial(final, system, y0, "srkn14a", dt)
    errors[name] = error(runs[name]())
    s = least(runs, 3)
    return [[row, seconds, seconds / s[name], errors[row]] for row, seconds in s.items()]


def _diffrax(y0: np.ndarray) -> Run:
    import diffrax
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)

    def field(t: object, y: jax.Array, args: object) -> jax.Array:
        q1, q2, p1, p2 = y
        return jnp.stack([p1, p2, -q1 - 2 * q1 * q2, -q2 - q1 * q1 + q2 * q2])

    def one(y: jax.Array) -> jax.Array:
        control = diffrax.PIDController(rtol=TOLERANCE, atol=TOLERANCE)
        term = diffrax.ODETerm(field)
        return diffrax.diffeqsolve(
            term, diffrax.Dopri8(), 0.0, T, None, y, stepsize_controller=control, max_steps=100_000
        ).ys[-1]

    batch = jax.jit(jax.vmap(one))
    return lambda: np.asarray(batch(y0).block_until_ready())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--orbits", type=int, default=100_000)
    parser.add_argument("--peers", action="store_true", help="the peers instead")
    fragments.add_out(parser)
    given = parser.parse_args()
    if given.peers:
        rows = [[name, fragments.duration(s), f"{r:.1f}", f"{e:.1e}"] for name, s, r, e in peers(given.orbits // 50)]
        body = fragments.table(["", "time", "ratio", "largest energy error at the end"], rows)
    else:
        rows = [[name, fragments.duration(s), f"{r:.2f}"] for name, s, r in ours(given.orbits)]
        body = fragments.table(["", "time", "ratio"], rows)
    print(body)
    fragments.write(given.out, "sweeps_peers" if given.peers else "sweeps", body)


if __name__ == "__main__":
    main()
