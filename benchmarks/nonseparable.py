"""Methods where H does not split into T(p) + V(q): run time at a given error, on four scenes.

    python benchmarks/nonseparable.py                                five minutes, two and a half of them of training
    python benchmarks/nonseparable.py --systems schwarzschild        one scene
    python benchmarks/nonseparable.py --seconds 0                    without a network
    python benchmarks/nonseparable.py --long                         a million steps of tao4, nothing else
    python benchmarks/nonseparable.py --networks                     a network for each scene, nothing else

Each method runs from the scene's y0 to T, compiled, with as few steps as meet a target, found by doubling and
bisection; for dop853 it is the tolerance that is searched. The targets are errors of 1e-4 and 1e-8 over 100 outputs:
of the energy, the largest relative one, and of the state, the largest of a coordinate or momentum against
gauss_legendre8 with short steps. The run time is that of a call of `solve` with the final state as the only output, the
shortest of several in processor time. A network SympFlow, trained for so many seconds by Gauss–Newton on states of the
double pendulum, stands with the errors that it has. With `--networks` one is trained by Gauss–Newton on labels for each
scene, and beside it stands the fastest of the methods with steps so short that both of its errors are met. Long runs
tell whether the energy drifts and the copies part.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import math
import time
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

import numpy as np
from measuring import fragments
from measuring.race import fewest_steps

from sympflow import HamiltonianSystem, max_energy_error, solve, systems, train
from sympflow.flow.flow_map import FlowMap

METHODS = (
    "implicit_midpoint",
    *(f"gauss_legendre{order}" for order in (4, 6, 8)),
    *(f"tao{order}" for order in (2, 4, 6, 8)),
    "dop853",
)
TARGETS = (1e-4, 1e-8)
MEASURES = ("energy", "state")
OUTPUTS, REPEATS, MOST_STEPS = 100, 7, 2**21
REFERENCE_STEPS = 10_000


COURSES = {
    "nonseparable-double-pendulum": (systems.double_pendulum, 100.0),
    "nonseparable-schwarzschild": (systems.schwarzschild, 2000.0),
    "nonseparable-charged-particle": (systems.charged_particle, 20.0),
    "nonseparable-textbook": (systems.nonseparable, 20.0),
}
"""The scene and the time T of each fragment."""
LONG = ((systems.double_pendulum, 0.1), (systems.schwarzschild, 1.0), (systems.charged_particle, 0.01))
LONG_STEPS = 1_000_000
NETWORKS = {"nonseparable": 0.1, "double_pendulum": 0.5, "schwarzschild": 20.0, "charged_particle": 0.1}
"""Δt of a network for each scene."""
NETWORK_STEPS = 100
SCENES = [make.__name__ for make, _ in COURSES.values()]


@dataclass
class Runs:
    """Runs of one method on a scene by their fineness: steps, or for dop853 1/rtol."""

    system: HamiltonianSystem
    T: float
    exact: np.ndarray
    method: str
    known: dict[int, dict[str, float]] = field(default_factory=dict)

    def chosen(self, n: int) -> dict[str, Any]:
        """The options of `solve`."""
        return {"rtol": 1 / n, "atol": 1e-3 / n} if self.method == "dop853" else {"dt": self.T / n}

    def error(self, n: int, measure: str) -> float:
        """The largest error of the energy or the state; ∞ where the run failed."""
        if n not in self.known:
            times = np.linspace(0.0, self.T, self.exact.shape[1])
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # of steps that are too long
                try:
                    sol = solve(self.system, self.method, (0.0, self.T), t_eval=times, **self.chosen(n))
                    self.known[n] = errors(sol, self.exact)
                except ValueError:
                    self.known[n] = dict.fromkeys(MEASURES, math.inf)
        return self.known[n][measure]

    def fewest(self, target: float, measure: str) -> int | None:
        """The least fineness that meets the target; None if that takes too many steps."""
        first, most = (100, 10**13) if self.method == "dop853" else (16, MOST_STEPS)
        return fewest_steps(lambda n: self.error(n, measure), target, first, first, most)


def errors(sol: Any, exact: np.ndarray) -> dict[str, float]:
    """The largest errors of a run; ∞ where it failed."""
    if not sol.success:
        return dict.fromkeys(MEASURES, math.inf)
    return {"energy": float(max_energy_error(sol)), "state": float(np.abs(sol.y - exact).max())}


def run_time(system: HamiltonianSystem, T: float, method: Any, chosen: dict[str, Any]) -> float:
    """The least processor time of a call."""
    seconds = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        for _ in range(REPEATS):
            begin = time.process_time()
            solve(system, method, (0.0, T), t_eval=[T], **chosen)
            seconds.append(time.process_time() - begin)
            if sum(seconds) > 10:
                break
    return min(seconds)


def trained(system: HamiltonianSystem, seconds: float) -> FlowMap:
    """A network that was trained for so long."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # the budget is over: that is the plan
        return train(
            system, 0.2, kind="sympflow", optimizer="gauss-newton", points=1000, steps=100_000, time_budget=seconds
        )


def networks(options: argparse.Namespace) -> None:
    """A network of three pairs for each scene, and the fastest of the methods at the errors that it has."""
    rows = []
    for make, T in COURSES.values():
        if make.__name__ not in options.systems:
            continue
        system = make()
        times = np.linspace(0.0, T, OUTPUTS + 1)
        exact = solve(system, "gauss_legendre8", (0.0, T), t_eval=times, dt=T / REFERENCE_STEPS).y
        begin = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that it is far from the exact flow is shown
            flow = train(
                system,
                NETWORKS[make.__name__],
                kind="sympflow",
                optimizer="gauss-newton",
                loss="labels",
                hidden=(8, 8),
                points=800,
                steps=NETWORK_STEPS,
                progress=False,
            )
        trained_in = time.process_time() - begin
        got = errors(solve(system, flow, (0.0, T), t_eval=times), exact)
        seconds = run_time(system, T, flow, {})
        fastest, name = math.inf, "—"
        for method in METHODS[:-1]:
            runs = Runs(system, T, exact, method)
            needed = [runs.fewest(got[measure], measure) for measure in MEASURES]
            if None not in needed:
                taken = run_time(system, T, method, runs.chosen(max(needed)))
                fastest, name = min((fastest, name), (taken, f"`{method}` (dt {T / max(needed):.2g})"))
        rows.append(
            (
                f"`{system.name}`, Δt = {flow.dt:g}",
                f"{flow.n_parameters}, {trained_in:.0f} s",
                f"{flow.figures['one_step_error']:.1e}",
                f"{got['energy']:.1e}",
                f"{got['state']:.1e}",
                fragments.duration(seconds),
                f"{name}, {fragments.duration(fastest)}",
                f"{fastest / seconds:.2g}",
            )
        )
        print(fragments.row(rows[-1]), flush=True)
    titles = (
        *("scene", "parameters, training", "error of a step", "energy", "state", "network"),
        *("fastest method at both errors", "times as fast"),
    )
    asked = "--networks" if options.systems == SCENES else f"--networks --systems {' '.join(options.systems)}"
    fragments.write(options.out, "nonseparable-networks", fragments.table(titles, rows), asked)


def long_runs(folder: Path | None) -> None:
    """The energy error and the distance of the copies over a million steps of tao4."""
    rows = []
    for make, dt in LONG:
        sol = solve(make(), "tao4", (0.0, LONG_STEPS * dt), dt=dt, save_every=100)
        error = np.abs(sol.energy_error())
        tenth = len(error) // 10
        largest = (f"{part.max():.3e}" for part in (error[:tenth], error[-tenth:]))
        rows.append((f"`{make.__name__}`", f"{dt:g}", *largest, f"{sol.stats['copy_distance']:.1e}"))
        print(fragments.row(rows[-1]), flush=True)
    titles = ("scene", "dt", "energy error, first tenth", "last tenth", "largest distance of the copies")
    fragments.write(folder, "nonseparable-long", fragments.table(titles, rows), "--long")


def cell(runs: Runs, measure: str, target: float) -> tuple[float, str]:
    """The run time at a target, and that with its step in words."""
    n = runs.fewest(target, measure)
    if n is None:
        return math.inf, "—"
    seconds = run_time(runs.system, runs.T, runs.method, runs.chosen(n))
    step = f"rtol {1 / n:.0e}" if runs.method == "dop853" else f"dt {runs.T / n:.2g}"
    return seconds, f"{fragments.duration(seconds)} ({step})"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--systems", nargs="*", choices=SCENES, default=SCENES, metavar="scene")
    parser.add_argument("--seconds", type=float, default=150.0, help="of training; 0 for none")
    parser.add_argument("--long", action="store_true", help="long runs alone")
    parser.add_argument("--networks", action="store_true", help="networks alone")
    fragments.add_out(parser)
    options = parser.parse_args()
    if options.networks:
        networks(options)
        return
    if not options.long:
        race(options)
    if options.long or options.systems == SCENES:
        long_runs(options.out)


def race(options: argparse.Namespace) -> None:
    """The run times of all methods at the targets, on each scene."""
    columns = [(measure, target) for measure in MEASURES for target in TARGETS]
    winners = []
    for fragment, (make, T) in COURSES.items():
        name = make.__name__
        if name not in options.systems:
            continue
        system = make()
        times = np.linspace(0.0, T, OUTPUTS + 1)
        exact = solve(system, "gauss_legendre8", (0.0, T), t_eval=times, dt=T / REFERENCE_STEPS).y
        rows, cells = [], {}
        print(f"\n{name}, T = {T:g}")
        for method in METHODS:
            runs = Runs(system, T, exact, method)
            cells[method] = [cell(runs, measure, target) for measure, target in columns]
            rows.append((f"`{method}`", *(text for _, text in cells[method])))
            print(fragments.row(rows[-1]), flush=True)
        best = [min(METHODS, key=lambda m, k=k: cells[m][k][0]) for k in range(len(columns))]
        for k, method in enumerate(best):
            at = METHODS.index(method)
            rows[at] = tuple(f"**{x}**" if i == k + 1 else x for i, x in enumerate(rows[at]))
        winners.append((f"`{name}`", *(f"`{m}`, {fragments.duration(cells[m][k][0])}" for k, m in enumerate(best))))
        titles = ("method", *(f"{measure} {target:.0e}" for measure, target in columns))
        body = fragments.table(titles, rows)
        if name == "double_pendulum" and options.seconds:
            flow = trained(system, options.seconds)
            got = errors(solve(system, flow, (0.0, T), t_eval=times), exact)
            line = (
                f"A SympFlow after {options.seconds:.0f} s of training, Δt = {flow.dt:g}: "
                f"{fragments.duration(run_time(system, T, flow, {}))}, with errors of "
                f"{got['energy']:.1e} in the energy and {got['state']:.1e} in the state."
            )
            print(line, flush=True)
            body = f"{body}\n\n{line}"
        fragments.write(options.out, fragment, body, f"--systems {name}")
    titles = ("scene", *(f"{measure} {target:.0e}" for measure, target in columns))
    if options.systems == SCENES:
        fragments.write(options.out, "nonseparable", fragments.table(titles, winners))


if __name__ == "__main__":
    main()
