"""The cost of `solve` to a user: shipped flows beside untrained schemes at about the same energy error.

    python benchmarks/through_solve.py
    python benchmarks/through_solve.py --quick      every case once, on short intervals: does it run?

`primed.py` times the compiled loops. Here whole calls of `solve` are timed, with their checks, tables and outputs, in
turn, on one thread, by processor time: the fastest tenth of many repeats, as others' work only ever adds. On
Hénon–Heiles the flow is the one that `tol=1e-6` chooses, the scheme srkn11b at dt = 0.625: one trajectory over
intervals of several lengths, one with 1000 outputs, which the flow's steps meet, and with as many between the steps of
both, and a batch. The call over T = 40 is nearly all overhead. On the FPUT chain over T = 200 with 1000 outputs it is
the shipped flow beside chin4a with the exact linear flow, which `stiff.py` finds to be the fastest untrained scheme to
1e-4. Median energy errors over 200 states, or that of the FPUT orbit, stand in the headings; behind the ratio of the
calls stands that of their compiled loops alone.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

import numpy as np
from measuring import fragments
from measuring.compiled import flow_loops, last, method_loops, scheme_loops

from sympflow import HamiltonianSystem, Solution, get, solve, systems
from sympflow.flow.shipped import shipped

DT = 0.625  # of srkn11b
TURN = {50.0: 1.43, 1000.0: 3.28}  # dt ω of chin4a, at which its energy error is below 1e-4
ENOUGH, FEWEST, SECONDS = 1000, 20, 3.0  # repeats of a pair of calls, and how long they may take


@dataclass(frozen=True)
class Pair:
    """A flow's call and a scheme's, and their compiled loops if these are timed as well."""

    name: str
    calls: tuple[Callable[[], Solution], Callable[[], Solution]]
    loops: tuple[Callable[[], Any], Callable[[], Any]] | None = None


def fastest(calls: tuple[Callable[[], Any], ...], quick: bool) -> list[float]:
    """Seconds of each call: the tenth percentile of interleaved repeats."""
    for call in calls:
        call()
    found: list[list[float]] = [[] for _ in calls]
    begin = time.perf_counter()
    while len(found[0]) < (1 if quick else FEWEST) or (
        not quick and len(found[0]) < ENOUGH and time.perf_counter() - begin < SECONDS
    ):
        for call, seconds in zip(calls, found, strict=True):
            start = time.process_time()
            call()
            seconds.append(time.process_time() - start)
    return [float(np.quantile(seconds, 0.1)) for seconds in found]


def median_energy_error(system: HamiltonianSystem, run: Callable[..., Solution], t_end: float) -> float:
    """Median of the largest relative error of each of 200 states."""
    y0 = system.domain.sample(200, 3)  # type: ignore[union-attr]
    sol = run((0, t_end), y0, t_eval=np.linspace(0, t_end, 500))
    H0 = system.hamiltonian(y0)[:, None]
    return float(np.median(np.abs(sol.energy() / H0 - 1).max(1)))


def henon_heiles(quick: bool) -> Iterator[Pair]:
    system = systems.henon_heiles()
    flow, scheme = partial(solve, system, "sympflow", tol=1e-6), partial(solve, system, "srkn11b", dt=DT)
    errors = [median_energy_error(system, run, 20.0 if quick else 1000.0) for run in (flow, scheme)]
    print(f"\nHénon–Heiles: energy error of the flow {errors[0]:.1e}, of srkn11b {errors[1]:.1e}\n")
    of_flow, of_scheme = flow_loops(system, shipped(system, tol=1e-6)), scheme_loops(system, "srkn11b")
    step = flow((0, 1)).stats["dt"]
    many = system.domain.sample(8 if quick else 1000, 3)  # type: ignore[union-attr]

    def pair(name: str, t_end: float, y0: np.ndarray | None = None, outputs: int = 1) -> Pair:
        t_eval = [t_end] if outputs == 1 else np.linspace(0, t_end, outputs + 1)
        calls = tuple(partial(run, (0, t_end), y0, t_eval=t_eval) for run in (flow, scheme))
        if outputs > 1:
            return Pair(name, calls)  # type: ignore[arg-type]
        n, m = round(t_end / step), round(t_end / DT)
        if y0 is None:
            loops: tuple[Any, Any] = (
                partial(of_flow.one, step, system.y0, n, last(n)),
                partial(of_scheme.one, DT, system.y0, m, last(m)),
            )
        else:
            loops = partial(of_flow.many, step, y0, n, last(n)), partial(of_scheme.many, DT, y0, m, last(m))
        return Pair(name, calls, loops)  # type: ignore[arg-type]

    yield pair("T = 40, the end", 40.0)
    yield pair("T = 1e3, the end", 20.0 if quick else 1e3)
    yield pair("T = 1e4, the end", 20.0 if quick else 1e4)
    yield pair("T = 1e5, the end", 20.0 if quick else 1e5)
    outputs = 20 if quick else 1000
    yield pair(f"T = {outputs * step:g}, {outputs} outputs", outputs * step, outputs=outputs)
    yield pair("T = 1e3, as many between steps", 20.0 if quick else 1e3, outputs=outputs - 1)
    yield pair(f"T = 1e3, {len(many)} trajectories", 20.0 if quick else 1e3, many)


def fput(omega: float, quick: bool) -> Iterator[Pair]:
    system = systems.fput(omega=omega)
    flow, t_end, outputs = shipped(system), 2.0 if quick else 200.0, 10 if quick else 1000
    n = outputs * round(t_end * omega / TURN[omega] / outputs)
    method = get("chin4a")(splitting="linear", dt=t_end / n)
    m = round(t_end / flow.dt)
    saves = [np.linspace(0, k, outputs + 1).round().astype(np.int64) for k in (m, n)]
    calls = (
        partial(solve, system, flow, (0, t_end), t_eval=flow.dt * saves[0]),
        partial(solve, system, method, (0, t_end), t_eval=t_end / n * saves[1]),
    )
    errors = [float(np.abs(sol.energy_error()).max()) for sol in (call() for call in calls)]
    print(f"\nFPUT, ω = {omega:g}: energy error of the flow {errors[0]:.1e}, of linear chin4a {errors[1]:.1e}\n")
    loops = (
        partial(flow_loops(system, flow).one, flow.dt, system.y0, m, saves[0]),
        partial(method_loops(system, method), t_end / n, system.y0, n, saves[1]),
    )
    yield Pair(f"T = {t_end:g}, {outputs} outputs", calls, loops)


def report(scene: str, pairs: Iterator[Pair], quick: bool) -> list[tuple[str, ...]]:
    """The rows of the table, which are printed as they are made."""
    rows = []
    for pair in pairs:
        mine, theirs = fastest(pair.calls, quick)
        line = f"{pair.name:28} flow {mine * 1e3:8.3f} ms   scheme {theirs * 1e3:8.3f} ms"
        line += f"   {theirs / mine:5.2f} times faster"
        alone = ""
        if pair.loops is not None:
            ours, others = fastest(pair.loops, quick)
            alone = f"{others / ours:.1f}"
            line += f"   (loops {others / ours:5.2f})"
        print(line, flush=True)
        times = (f"{1e3 * mine:.3g}", f"{1e3 * theirs:.3g}", f"{theirs / mine:.2f}", alone)
        rows.append((f"{scene}, {pair.name}", *times))
    return rows


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Whole calls of solve")
    parser.add_argument("--quick", action="store_true", help="every case once, on short intervals")
    fragments.add_out(parser)
    options = parser.parse_args(arguments)
    rows = report("Hénon–Heiles", henon_heiles(options.quick), options.quick)
    for omega in TURN:
        rows += report(f"FPUT, ω = {omega:g}", fput(omega, options.quick), options.quick)
    titles = ("call", "flow, ms", "scheme, ms", "times faster", "loops alone")
    fragments.write(options.out, "through-solve", fragments.table(titles, rows))


if __name__ == "__main__":
    main()
