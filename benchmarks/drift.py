"""No drift: the energy error of every shipped symplectic flow over a million steps, along a bounded regular orbit.

    python benchmarks/drift.py                    every file, four minutes or so on one core
    python benchmarks/drift.py --quick            20,000 steps of the flows of the pendulum
    python benchmarks/drift.py --system kepler

The slope of the relative energy error is fitted to the means over 20 blocks of the run, and its standard error to their
scatter (`sympflow.energy_drift`). A flow passes if |slope|·T ≤ max(3 standard errors · T, 10 ε √N), N steps of Δt in T,
with ε the rounding unit. The orbit starts at the `y0` of the scene, but for Hénon–Heiles, whose y0 is chaotic: there it
is near the periodic orbit along q1; and for lattices, whose solitons leave the domain or whose waves are unstable:
there it is another wave. A thousand states count, at equal times. A flow that fails does not pass.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

import numpy as np
from measuring import fragments

import sympflow
from sympflow import HamiltonianSystem, energy_drift, solve, systems
from sympflow.flow.shipped import ShippedFlow

STEPS, OUTPUTS, BLOCKS = 1_000_000, 1000, 20
QUICK_STEPS = 20_000
EPS = float(np.finfo(float).eps)
REGULAR = {
    "henon_heiles": [0.0, 0.1, 0.35, 0.0],  # E = 0.0659: near the periodic orbit in the q1 direction
    "toda_chain": [*np.zeros(128), *0.45 * np.sin(2 * np.pi * np.arange(128) / 16)],  # not one soliton: a wave
    "fput_beta": [*np.zeros(64), *0.45 * np.sin(2 * np.pi * np.arange(64) / 16)],  # its y0 is unstable
    "phi4": [*np.ones(16), *0.1 * np.cos(2 * np.pi * (np.arange(16) + 0.5) / 16)],  # in one well
    "phi4_sheet": [*np.ones(64), *np.repeat(0.2 * np.cos(2 * np.pi * np.arange(8) / 8), 8)],
    "sine_gordon": [*np.zeros(16), *0.3 * np.sin(2 * np.pi * np.arange(16) / 16)],  # as long as the ring: stable
}


def scenes() -> list[HamiltonianSystem]:
    """The systems that flows ship for."""
    return [
        systems.harmonic_oscillator(),
        systems.harmonic_oscillator(100.0),
        systems.pendulum(),
        systems.quartic(),
        systems.henon_heiles(),
        systems.kepler(),
        systems.outer_solar_system(),
        systems.solar_system(),
        systems.solar_system(("Jupiter", "Saturn", "Uranus", "Neptune")),
        systems.fput(50.0),
        systems.fput(1000.0),
        systems.spring_pendulum(1e6, coordinates="polar"),
        systems.toda_chain(),
        systems.fput_beta(),
        systems.sine_gordon(n=16, length=16.0, accuracy=2),
        systems.phi4(n=16, length=16.0, accuracy=2),
        HamiltonianSystem.lattice(onsite="(q**2 - 1)**2/4", bond="r**2/2", shape=(8, 8), name="phi4_sheet"),
    ]


@dataclass(frozen=True)
class Drift:
    """The energy of a flow over N steps."""

    flow: str
    steps: int
    largest: float
    change: float  # |slope|·T
    three_errors: float
    rounding: float  # 10 ε √N
    seconds: float
    left: float | None  # when the orbit left the domain

    @property
    def passed(self) -> bool:
        return self.change <= max(self.three_errors, self.rounding)


def drift_of(entry: ShippedFlow, system: HamiltonianSystem, steps: int) -> Drift:
    """The drift of a shipped flow."""
    flow = entry.load(system)
    y0 = np.asarray(REGULAR.get(system.name, system.y0), dtype=float)
    T, every = steps * flow.dt, max(1, steps // OUTPUTS)
    begin = time.process_time()
    sol = solve(system, flow, (0.0, T), y0=y0, save_every=every)
    seconds = time.process_time() - begin
    fitted = energy_drift(sol, BLOCKS)
    slope, error = float(fitted.slope), float(fitted.standard_error)
    largest = float(sympflow.max_energy_error(sol))
    rounding = 10 * EPS * math.sqrt(steps)
    exit_time = sol.stats.get("domain_exit")
    left = None if exit_time is None else float(np.min(exit_time))
    return Drift(entry.name, steps, largest, abs(slope) * T, 3 * error * T, rounding, seconds, left)


def run(steps: int, named: list[str] | None = None) -> list[Drift]:
    """The drift of each flow, printed as a row of a table."""
    print("| flow | largest energy error | change by the slope | 3 standard errors | 10 ε √N | verdict |")
    print("|---|---|---|---|---|---|")
    entries = sympflow.shipped_flows(kind="sympflow")
    found: list[Drift] = []
    for system in scenes():
        if named and system.name not in named:
            continue
        for entry in entries:
            if not entry.is_of(system):
                continue
            d = drift_of(entry, system, steps)
            found.append(d)
            verdict = "no drift" if d.passed else "**drifts**"
            if d.left is not None:
                verdict += f", leaves Ω at t = {d.left:.3g}"
            cells = [f"{x:.1e}" for x in (d.largest, d.change, d.three_errors, d.rounding)]
            print(fragments.row([d.flow, *cells, verdict]), f"({d.seconds:.0f} s)", flush=True)
    return found


def failures(found: list[Drift]) -> str:
    """The table of the flows that drift, and how many do not."""
    passed = sum(d.passed for d in found)
    rows = [
        (f"{passed} of {len(found)} flows", "no drift", "", "", f"{10 * EPS * math.sqrt(found[0].steps):.1e}"),
        *(
            (d.flow, f"{d.change:.1e}", f"{d.three_errors:.1e}", f"{d.largest:.1e}", f"{d.rounding:.1e}")
            for d in found
            if not d.passed
        ),
    ]
    return fragments.table(("flow", "change", "3 standard errors", "largest error", "10 ε √N"), rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="20,000 steps of the flows of the pendulum")
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--system", action="append", help="name of a system; all if none is named")
    fragments.add_out(parser)
    options = parser.parse_args()
    steps = QUICK_STEPS if options.quick else options.steps
    found = run(steps, options.system or (["pendulum"] if options.quick else None))
    print(f"\n{sum(d.passed for d in found)} of {len(found)} flows show no drift over {steps:,} steps.")
    fragments.write(options.out, "drift", failures(found))


if __name__ == "__main__":
    main()
