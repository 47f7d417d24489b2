"""The outer solar system over 1e5 years: the shipped flows against every splitting scheme, at equal energy error.

    python benchmarks/solar_system.py             1e5 years, to 1e-7: a few minutes
    python benchmarks/solar_system.py --quick     a thousand years, two schemes

From the book's initial data (Hairer, Lubich, Wanner, I.2.4), one trajectory of which 1000 states are kept. The energy
error is the largest of these, relative to |H(y0)|. For each scheme the longest step, to 1 %, is sought that meets the
target, and for each flow the longest up to its Δt. All runs are whole calls of `solve`, compiled, on one thread; they
are timed in turn, by processor time, and the least of the repeats counts.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass
from functools import partial
from typing import Any

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

import numpy as np
from measuring import fragments
from measuring.race import MOST_FORCES, SHORTEST, fewest_steps

import sympflow
from sympflow import HamiltonianSystem, Solution, solve
from sympflow.flow.primed import PrimedFlow
from sympflow.schemes import SCHEMES
from sympflow.systems import outer_solar_system

YEAR = 365.25  # days
OUTPUTS = 1000
TARGET = 1e-7
NEAR = 1.5  # schemes with so many times the fewest forces are not timed, Kahan–Li 8 aside
QUICK = ("kahan_li8", "srkn11b")


@dataclass(frozen=True)
class Racer:
    """A flow or a scheme."""

    name: str
    method: Any
    forces: int
    hessians: int
    longest: float = math.inf

    def run(self, system: HamiltonianSystem, years: float, n: int) -> Solution:
        """n steps, at most `OUTPUTS` of them kept."""
        t_span = (0.0, years * YEAR)
        save_every = max(1, math.ceil(n / OUTPUTS))
        quietly: dict[str, Any] = {
            "on_domain_exit": "ignore",
            "diagnose": False,
        }  # steps that are too long are tried too
        return solve(system, self.method, t_span, dt=t_span[1] / n, save_every=save_every, **quietly)

    def error(self, system: HamiltonianSystem, years: float, n: int) -> float:
        with np.errstate(all="ignore"):
            error = float(np.abs(self.run(system, years, n).energy_error()).max())
        return error if math.isfinite(error) else math.inf


def flows(system: HamiltonianSystem) -> list[Racer]:
    """The flows that ship."""
    racers = []
    for entry in sympflow.shipped_flows(system):
        flow = sympflow.load(entry.path, system=system)
        if isinstance(flow, PrimedFlow):
            kernel = flow.kernel_scheme()
            work = kernel.force_evaluations, kernel.hessian_evaluations
            racers.append(Racer(f"flow, Δt = {flow.dt:g} d, {work[0]} + {flow.processor} kicks", flow, *work, flow.dt))
    return racers


def schemes(names: tuple[str, ...] | None = None) -> list[Racer]:
    """Every splitting scheme of the package, or those named."""
    return [
        Racer(name, name, s.force_evaluations, s.hessian_evaluations)
        for name, s in SCHEMES.items()
        if names is None or name in names
    ]


def steps_of(racer: Racer, system: HamiltonianSystem, years: float, target: float) -> int | None:
    """The fewest that meet the target."""
    span = years * YEAR
    least = 1 if math.isinf(racer.longest) else math.ceil(span / racer.longest * (1 - 1e-12))
    most = SHORTEST * least if least > 1 else max(1, round(MOST_FORCES * years / 1e5 / racer.forces) * 4)
    guess = max(least, round(span / (40.0 * racer.forces)))
    return fewest_steps(partial(racer.error, system, years), target, guess, least, most)


def timed(racers: dict[Racer, int], system: HamiltonianSystem, years: float, repeats: int) -> dict[Racer, float]:
    """The least processor time of several runs, taken in turn."""
    best = dict.fromkeys(racers, math.inf)
    for _ in range(repeats):
        for racer, n in racers.items():
            begin = time.process_time()
            racer.run(system, years, n)
            best[racer] = min(best[racer], time.process_time() - begin)
    return best


def run(years: float = 1e5, target: float = TARGET, repeats: int = 5, names: tuple[str, ...] | None = None) -> str:
    """The table."""
    system = outer_solar_system()
    steps: dict[Racer, int] = {}
    for racer in [*flows(system), *schemes(names)]:
        n = steps_of(racer, system, years, target)
        if n is None:
            print(f"{racer.name}: misses {target:g} within the most forces that are allowed", flush=True)
            continue
        steps[racer] = n
        print(f"{racer.name}: {n} steps of {years * YEAR / n:.1f} d, {n * racer.forces} forces", flush=True)
    work = {r: n * (r.forces + 0.6 * r.hessians) for r, n in steps.items()}
    fewest = min((w for r, w in work.items() if math.isinf(r.longest)), default=math.inf)
    racing = {
        r: n for r, n in steps.items() if r.name == "kahan_li8" or r.longest < math.inf or work[r] <= NEAR * fewest
    }
    seconds = timed(racing, system, years, repeats)
    own = [r for r in racing if r.longest < math.inf]
    if not own:
        raise RuntimeError("No flow that ships for the outer solar system meets the target.")
    best = min(own, key=lambda r: seconds[r])
    lines = []
    for r in sorted(racing, key=lambda r: seconds[r]):
        n = racing[r]
        work = [
            f"{years * YEAR / n:.3g} d",
            f"{r.error(system, years, n):.1e}",
            f"{n * r.forces:,}",
            f"{n * r.hessians:,}",
        ]
        lines.append([r.name, *work, f"{seconds[r]:.2f} s", f"{seconds[r] / seconds[best]:.2f}"])
    titles = ["method", "step", "energy error", "forces", "force gradients", "run time", "of the best"]
    return fragments.table(titles, lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a thousand years, two schemes")
    parser.add_argument("--years", type=float)
    parser.add_argument("--target", type=float, default=TARGET)
    parser.add_argument("--repeats", type=int, default=5)
    fragments.add_out(parser)
    options = parser.parse_args()
    years = options.years or (1e3 if options.quick else 1e5)
    found = run(years, options.target, options.repeats, QUICK if options.quick else None)
    print("\n" + found)
    fragments.write(options.out, "solar-system", found)


if __name__ == "__main__":
    main()
