"""Primed SympFlows against every splitting scheme of the package, at equal energy error.

    python benchmarks/primed.py                                            Hénon–Heiles, Δt = 1, 4, 6 and 8 kicks
    python benchmarks/primed.py --system pendulum --stages 3,6 --dt 1

A flow is fitted (its time is stated), then run over T = 1000 from 20 held-out states; its energy error is the largest
|H − H0|/|H0| over 1000 instants, the median over the states. Each scheme gets the fewest steps with which that median
is as small. Then all run one trajectory, and 1000 of them, in the same compiled loops, in turn, on one thread; what is
stated is how much longer than the flow the best scheme takes. The flow is one that holds for all t: its mean error
over 50 fractional times stands beside that at Δt.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from contenders.environment import pin_to_one_thread

pin_to_one_thread()

import numpy as np

from sympflow import HamiltonianSystem, SympFlow, systems, train
from sympflow.integrators.schemes import SCHEMES, Scheme
from sympflow.kernels.splitting import SplittingKernel, splitting_kernel
from sympflow.timing import interleaved

T_END, INSTANTS = 1000.0, 1000
HELD_OUT, HELD_OUT_SEED = 20, 20_261_121  # a seed that no training uses
BATCH = 1000
MOST_STEPS = 10_000_000
CLOSENESS = 1.01  # of the fewest steps, as a ratio


@dataclass(frozen=True)
class Row:
    """A flow and the scheme that comes nearest."""

    system: str
    dt: float
    stages: int
    parameters: int
    fit_seconds: float
    one_step_error: float
    fractional_error: float
    energy_error: float
    energy_error_worst: float
    kicks: int
    rival: str
    rival_kicks: int
    evaluations_saved: float
    times_faster: float
    batch_rival: str
    batch_times_faster: float


def energy_errors(system: HamiltonianSystem, kernel: SplittingKernel, scheme: Scheme, n: int) -> np.ndarray:
    """The largest relative energy error of each held-out state in n steps over T."""
    assert system.domain is not None
    y0 = system.domain.sample(HELD_OUT, HELD_OUT_SEED)
    save = np.unique(np.linspace(0, n, INSTANTS + 1).round().astype(np.int64))
    with np.errstate(all="ignore"):  # too few steps overflow
        H = system.hamiltonian(kernel.run_batch(scheme, T_END / n, y0, n, save)[0])
        error = np.abs(H - H[:, :1]).max(1) / np.abs(H[:, 0])
    return np.where(np.isnan(error), np.inf, error)


def fewest_steps(error: Callable[[int], float], target: float, guess: int) -> int | None:
    """The smallest n, to 1 %, with error(n) ≤ target, if there is one below `MOST_STEPS`."""
    high = guess
    while error(high) > target:
        high *= 2
        if high > MOST_STEPS:
            return None
    low = high // 2
    while low > 1 and error(low) <= target:
        low, high = low // 2, low
    while high > CLOSENESS * low + 1:
        middle = round((low * high) ** 0.5)
        low, high = (low, middle) if error(middle) <= target else (middle, high)
    return high


def measure(
    system: HamiltonianSystem, stages: int, dt: float, degree: int, repeats: int, force_gradient: bool = True
) -> Row:
    start = SympFlow.primed(system, stages, dt=dt, degree=degree, force_gradient=force_gradient)
    flow = train(system, flow=start, optimizer="gauss-newton")
    kernel, n = splitting_kernel(system), round(T_END / dt)
    errors = energy_errors(system, kernel, flow.scheme(), n)
    target = float(np.median(errors))
    contenders: dict[str, tuple[Scheme, int]] = {}
    for name, scheme in SCHEMES.items():
        if (scheme.nystrom or any(scheme.gradients)) and not system.quadratic_kinetic:
            continue
        guess = max(1, n * stages // scheme.force_evaluations)
        steps = fewest_steps(lambda k, s=scheme: float(np.median(energy_errors(system, kernel, s, k))), target, guess)
        if steps is not None:
            contenders[name] = (scheme, steps)
    everyone = {"the flow": (flow.scheme(), n), **contenders}
    assert system.domain is not None
    y0 = system.domain.sample(BATCH, 0)
    one = [partial(kernel.run, s, T_END / k, y0[0], k, np.array([k])) for s, k in everyone.values()]
    many = [partial(kernel.run_batch, s, T_END / k, y0, k, np.array([k]), threads=1) for s, k in everyone.values()]
    times = {}
    for label, calls, count in (("one", one, 5 * repeats), ("many", many, repeats)):
        for call in calls:
            call()
        medians = [time.median for time in interleaved(calls, count)]
        times[label] = dict(zip(everyone, medians, strict=True))
    best = {label: min(contenders, key=lambda name, label=label: times[label][name]) for label in times}
    rival, steps = contenders[best["one"]]
    return Row(
        system=system.name,
        dt=dt,
        stages=stages,
        parameters=flow.n_parameters,
        fit_seconds=flow.figures["training_seconds"],
        one_step_error=flow.figures["one_step_error"],
        fractional_error=flow.figures["fractional_error"],
        energy_error=target,
        energy_error_worst=float(errors.max()),
        kicks=n * stages,
        rival=best["one"],
        rival_kicks=steps * rival.force_evaluations,
        evaluations_saved=steps * rival.force_evaluations / (n * stages),
        times_faster=times["one"][best["one"]] / times["one"]["the flow"],
        batch_rival=best["many"],
        batch_times_faster=times["many"][best["many"]] / times["many"]["the flow"],
    )


def table(rows: list[Row]) -> str:
    lines = [
        "| system, Δt, kicks | fit | one-step error at Δt / at fractional t | energy error, T = 1000: median (largest) "
        "| best scheme, forces to forces | times faster | batch of 1000 |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        lines.append(
            f"| {r.system}, {r.dt:g}, {r.stages} | {r.fit_seconds:.1f} s, {r.parameters} numbers | "
            f"{r.one_step_error:.1e} / {r.fractional_error:.1e} | {r.energy_error:.1e} ({r.energy_error_worst:.1e}) | "
            f"{r.rival}, {r.evaluations_saved:.1f}× | {r.times_faster:.2f} | "
            f"{r.batch_times_faster:.2f} ({r.batch_rival}) |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description="Primed SympFlows against splitting schemes at equal energy error.")
    parser.add_argument("--system", default="henon_heiles", choices=[s.__name__ for s in systems.SYSTEMS.values()])
    parser.add_argument("--dt", type=float, default=1.0)
    parser.add_argument("--stages", default="4,6,8", help="numbers of kicks, separated by commas")
    parser.add_argument("--degree", type=int, default=7)
    parser.add_argument("--no-force-gradient", action="store_true")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", type=Path, help="file for the rows")
    options = parser.parse_args()
    system = getattr(systems, options.system)()
    rows = []
    for stages in map(int, options.stages.split(",")):
        gradient = not options.no_force_gradient
        rows.append(measure(system, stages, options.dt, options.degree, options.repeats, gradient))
        print(table(rows[-1:]).splitlines()[-1], flush=True)
    print("\n" + table(rows))
    if options.json:
        options.json.write_text(json.dumps([asdict(row) for row in rows], indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
