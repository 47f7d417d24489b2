"""Driven systems: the cost of a compiled step, the energy balance in the long run, Mathieu's boundary, and heyoka.

    python benchmarks/driven.py [--out docs/measured]
    python benchmarks/driven.py --only cost,balance,mathieu,heyoka

Float64, one thread, process time. In `cost` the runs of a row are timed in turn, in rounds, and the least of each
counts. In `heyoka` every candidate, flows that ship among them, is timed at the longest step, or the largest tolerance,
with which its error at the end of 1000 periods is at most 1e-9; the reference is a run of Gauss–Legendre 8 with
compensated sums.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Callable, Sequence
from functools import partial
from math import pi
from pathlib import Path
from typing import Any

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

import numpy as np
from measuring import fragments

import sympflow
from sympflow import HamiltonianSystem, energy_balance_error, floquet_multipliers, solve, systems
from sympflow.compiler.control import INT, POINTER, Module
from sympflow.compiler.functions import apply
from sympflow.compiler.machine import address, host
from sympflow.kernels.runs import finished
from sympflow.kernels.splitting_loops import splitting_loops
from sympflow.schemes import SCHEMES

W = 2.7
PENDULUM = HamiltonianSystem.from_sympy("p**2/2 - b*cos(q)", params={"b": 1.1}, y0=[0.5, 0.1])
DRIVEN = HamiltonianSystem.from_sympy(
    "p**2/2 - cos(q)*(1 + a*cos(w*t))", time="t", params={"a": 0.1, "w": W}, period=2 * pi / W, y0=[0.5, 0.1]
)
START = np.array([0.5, 0.1])
"""The state from which heyoka, the schemes and the flows that ship are compared, on the systems of these flows."""
TARGET, PERIODS = 1e-9, 1000
CANDIDATES = ("kahan_li6", "kahan_li8", "srkn11b", "srkn14a", "omelyan6", "chin4c")


def least(calls: Sequence[Callable[[], Any]], rounds: int) -> list[float]:
    """The least process time of each call, the calls made in turn."""
    times = np.full((rounds, len(calls)), np.inf)
    for call in calls:
        call()
    for i in range(rounds):
        for j, call in enumerate(calls):
            start = time.process_time()
            call()
            times[i, j] = time.process_time() - start
    return times.min(0).tolist()


def cosines_alone() -> Callable[[float, float, int], float]:
    """The sum of cos(w·k·h), k = 0 … n − 1, compiled: of w, h, n."""
    types = [POINTER, INT]
    code = Module(host().fused).function("cosines", types)
    numbers, n = code.arguments
    total, step = code.variable(code.constant(0.0)), code.load(numbers, 0)
    with code.over(n) as k:
        total.value = total.value + apply("cos", step * code.convert("sitofp", k, "double"))
    code.store(total.value, numbers, 1)
    function = finished(code)

    def cosines(w: float, h: float, n: int) -> float:
        numbers = np.array([w * h, 0.0])
        function(address(numbers), n)
        return float(numbers[1])

    return cosines


def cost(rounds: int) -> list[tuple[str, ...]]:
    """A step of the driven pendulum against one of the pendulum plus the cosines of its kicks."""
    cosines = cosines_alone()
    rows: list[tuple[str, ...]] = [("method", "pendulum, ns a step", "cosines", "driven pendulum", "ratio")]
    n, h, save = 200_000, 0.05, np.array([200_000])
    for name in ("verlet", "kahan_li8", "srkn14a", "chin4c"):
        kicks = SCHEMES[name].force_evaluations
        kernels = [splitting_loops(system).kernel(SCHEMES[name]) for system in (PENDULUM, DRIVEN)]
        calls: list[Callable[[], Any]] = [partial(k.run, h, PENDULUM.y0, n, save) for k in kernels]
        plain, driven, alone = least([*calls, partial(cosines, W, h / kicks, n * kicks)], rounds)
        figures = [1e9 * t / n for t in (plain, alone, driven)]
        rows.append((name, *(f"{t:.1f}" for t in figures), f"{driven / (plain + alone):.2f}"))
    return rows


def balance(periods: int) -> list[tuple[str, ...]]:
    """The largest energy balance error within each decade of periods."""
    edges = [10**k for k in range(2, round(np.log10(periods)) + 1)]
    rows: list[tuple[str, ...]] = [("method", *(f"up to 1e{round(np.log10(n))} periods" for n in edges))]
    for name, steps in (("verlet", 20), ("kahan_li8", 12)):
        dt, every = DRIVEN.period / steps, steps * max(1, periods // 20_000) + 1
        sol = solve(DRIVEN, name, (0.0, periods * DRIVEN.period), dt=dt, save_every=every)
        error, passed = energy_balance_error(sol), sol.t / DRIVEN.period
        rows.append((f"{name}, {steps} steps a period", *(f"{error[passed <= n].max():.1e}" for n in edges)))
    return rows


def mathieu() -> list[tuple[str, ...]]:
    """The largest q of a Paul trap with a = 0 whose Floquet multipliers are not larger than 1."""
    low, high = 0.5, 1.2
    while high - low > 1e-12:
        middle = (low + high) / 2
        stable = floquet_multipliers(systems.paul_trap(0.0, middle), np.zeros(4)).stable
        low, high = (middle, high) if stable else (low, middle)
    return [("boundary q at a = 0", "known"), (f"{low:.9f}", "0.908046334")]


def cheapest(error: Callable[[float], float], first: float, factor: float, most: int = 30) -> float | None:
    """The first of first, first·factor, … , so many, with which the error is at most the target; None for none."""
    for k in range(most):
        if error(first * factor**k) <= TARGET:
            return first * factor**k
    return None


def ours(system: HamiltonianSystem, exact: np.ndarray, t_end: float) -> list[tuple[str, Callable[[], Any]]]:
    found = []
    for name in CANDIDATES:
        kernel = splitting_loops(system).kernel(SCHEMES[name])

        def end(n: float, kernel: Any = kernel) -> np.ndarray:
            n = round(n)
            return kernel.run(t_end / n, START, n, np.array([n])).states[-1]

        n = cheapest(lambda n: float(np.abs(end(n) - exact).max()), PERIODS * 4.0, 1.1)
        if n is not None:
            found.append((f"{name}, {n / PERIODS:.0f} steps a period", partial(end, n)))
    return found


def shipped(system: HamiltonianSystem, exact: np.ndarray, t_end: float) -> list[tuple[str, Callable[[], Any]]]:
    """The shipped flows of the system at the longest steps, of at most their Δt, that reach the target."""
    found = []
    for entry in sympflow.shipped_flows(system):
        flow = sympflow.load(entry.path, system=system)
        kernel = flow.kernel_for(system)

        def end(n: float, kernel: Any = kernel) -> np.ndarray:
            n = round(n)
            return kernel.run(t_end / n, START, n, np.array([n])).states[-1]

        least = float(np.ceil(t_end / flow.dt))
        n = cheapest(lambda n: float(np.abs(end(n) - exact).max()), least, 1.05, 20)
        if n is not None:
            label = f"{entry.name}, {round(n) / PERIODS:.1f} steps a period"
            found.append((label, partial(end, n)))
    return found


def heyokas(system: HamiltonianSystem, exact: np.ndarray, t_end: float) -> list[tuple[str, Callable[[], Any]]]:
    import heyoka as hy

    symbols = system.symbols
    q, p = hy.make_vars("q1", "p1")
    table = {symbols.q[0]: q, symbols.p[0]: p, symbols.time: hy.time}
    slope = hy.from_sympy(-symbols.H.diff(symbols.q[0]), table)

    def run(tolerance: float) -> np.ndarray:
        integrator = made[tolerance]
        integrator.time = 0.0
        integrator.state[:] = START
        integrator.propagate_until(t_end)
        return integrator.state.copy()

    made: dict[float, Any] = {}

    def error(tolerance: float) -> float:
        made[tolerance] = hy.taylor_adaptive([(q, p), (p, slope)], START.copy(), tol=tolerance)
        return float(np.abs(run(tolerance) - exact).max())

    tolerance = cheapest(error, 1e-9, 1 / 4)
    return [] if tolerance is None else [(f"heyoka, tolerance {tolerance:.0e}", partial(run, tolerance))]


def peers(rounds: int) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [("system", "method", "ms", "error")]
    duffing = systems.duffing(damping=0.0, force=0.1, frequency=W, alpha=1.0)
    for name, system in (("driven pendulum", systems.driven_pendulum()), ("Duffing oscillator, δ = 0", duffing)):
        t_end = PERIODS * system.period
        options: dict[str, Any] = {"dt": system.period / 64, "compensated": True, "t_eval": [t_end]}
        exact = solve(system, "gauss_legendre8", (0.0, t_end), START, **options).y[:, -1]
        runs = [*ours(system, exact, t_end), *shipped(system, exact, t_end)]
        if importlib.util.find_spec("heyoka"):
            runs += heyokas(system, exact, t_end)
        times = least([run for _, run in runs], rounds)
        for (label, run), seconds in sorted(zip(runs, times, strict=True), key=lambda row: row[1]):
            rows.append((name, label, f"{1e3 * seconds:.2f}", f"{np.abs(run() - exact).max():.1e}"))
    return rows


def table(rows: Sequence[Sequence[str]]) -> str:
    head, *body = rows
    return "\n".join("| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *body)) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="folder of the fragments")
    parser.add_argument("--only", default="cost,balance,mathieu,heyoka")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--periods", type=int, default=1_000_000)
    arguments = parser.parse_args()
    parts: dict[str, Callable[[], list[tuple[str, ...]]]] = {
        "cost": partial(cost, arguments.rounds),
        "balance": partial(balance, arguments.periods),
        "mathieu": mathieu,
        "heyoka": partial(peers, arguments.rounds),
    }
    for name in arguments.only.split(","):
        body = table(parts[name]())
        print(body)
        if arguments.out:
            fragments.write(arguments.out, f"driven-{name}", body)


if __name__ == "__main__":
    main()
