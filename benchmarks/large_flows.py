"""Flows of lattices, fitted on a few sites, against every splitting scheme of the package at equal energy error.

    python benchmarks/large_flows.py [--out docs/measured]
    python benchmarks/large_flows.py --only fput_beta,toda      some of the lattices
    python benchmarks/large_flows.py --fit --flows folder       flows that are fitted first, and kept in a folder
    python benchmarks/large_flows.py --sites 8192               another size of chains and, squared, of sheets

Lattices of 1024 sites at energy densities of 0.02 to 0.2 above rest. The flows are those that ship, or of a folder;
`--fit` fits them by the seeded recipes below, each on 6 or 4 × 4 sites. The error is the largest of the energy up to
T = 100, relative to the energy above rest, the median over a few held-out states of the lattice. For each target every
scheme, and every flow with steps of a quarter of its Δt and longer, gets the fewest steps that meet it. Then they run
in turn over T = 1000, one thread, one state of which the end is kept: the least process time of several.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import json
import math
import time
from functools import partial
from pathlib import Path
from typing import Any

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

import numpy as np
from measuring import fragments
from measuring.compiled import last
from measuring.race import SHORTEST, Runner, fewest_steps, schemes

import sympflow
from sympflow import HamiltonianSystem, LatticeStates, train
from sympflow.flow.primed import PrimedFlow
from sympflow.training.starts import Primed

TARGETS = (1e-4, 1e-6, 1e-8)
T, OUTPUTS, STATES, SEED = 100.0, 100, 3, 20_261_121
LONGER = 10  # times T, of a run that is timed
DENSITY = 0.02, 0.2
NEAR = 1.7  # schemes with so many times the fewest forces are not timed
MOST = 20_000  # forces of a scheme that is in the race
SHIPPED = Path(sympflow.__file__).parent / "pretrained"
LATTICES: dict[str, tuple[str, dict[str, Any], int, float]] = {
    "fput_beta": ("FPUT-β", {"bond": "r**2/2 + r**4/4"}, 1, 1.0),
    "phi4": ("φ⁴", {"onsite": "(q**2 - 1)**2/4", "bond": "r**2/2"}, 1, 1.0),
    "phi4_sheet": ("φ⁴, two axes", {"onsite": "(q**2 - 1)**2/4", "bond": "r**2/2"}, 2, 0.75),
    "toda_chain": ("Toda", {"bond": "exp(-r) + r - 1"}, 1, 1.0),
    "sine_gordon": ("sine-Gordon", {"onsite": "1 - cos(q)", "bond": "r**2/2"}, 1, 1.0),
}
"""Title, terms, number of axes, and Δt of the flows over `STEPS`."""
STEPS = (1.2, 0.7, 0.28)
KICKS, PROCESSOR = 4, 12
FIT: dict[str, Any] = {"restarts": 20, "energy_weight": 300.0, "frozen_weight": 1000.0, "label_times": 5}
"""Δt of a ladder of flows, where the fastest frequency is about 2.2."""


def lattice(name: str, sites: int) -> HamiltonianSystem:
    _, terms, axes, _ = LATTICES[name]
    n = sites if axes == 1 else round(sites ** (1 / axes))
    return HamiltonianSystem.lattice(**terms, shape=(n,) * axes, name=name, domain=LatticeStates(DENSITY))


def flows_of(system: HamiltonianSystem, folder: Path, fit: bool, steps: tuple[float, ...]) -> list[PrimedFlow]:
    """The flows of a lattice in a folder, fitted first if asked."""
    if fit:
        folder.mkdir(parents=True, exist_ok=True)
        for dt in steps:
            start = Primed(round(dt * LATTICES[system.name][3], 2), KICKS, PROCESSOR)
            path = folder / f"{system.name}-primed-{start.stages}-{start.dt:g}.safetensors"
            if not path.exists():
                begun = time.process_time()
                flow = train(system, flow=start.flow(system), progress=False, **FIT)
                flow.save(path)
                print(f"{path.stem}: {time.process_time() - begun:.0f} s of a processor", flush=True)
    found = [sympflow.load(path) for path in sorted(folder.glob(f"{system.name}-*.safetensors"))]
    return [flow.bound(system) for flow in found if isinstance(flow, PrimedFlow) and flow.matches(system)]


def error(system: HamiltonianSystem, y0: np.ndarray, runner: Runner, n: int) -> float:
    """The largest relative energy error in n steps, the median over states."""
    save = np.unique(np.linspace(0, n, OUTPUTS + 1).round().astype(np.int64))
    with np.errstate(all="ignore"):
        H = system.hamiltonian(runner.many(T / n, y0, n, save)[0])
        largest = np.abs(H - H[:, :1]).max(1) / H[:, 0]
    return float(np.median(np.where(np.isnan(largest), np.inf, largest)))


def race(
    name: str, sites: int, folder: Path, fit: bool, lengths: tuple[float, ...], rounds: int
) -> list[dict[str, Any]]:
    """A row for each target."""
    system = lattice(name, sites)
    assert system.domain is not None
    flows = flows_of(system, folder, fit, lengths)
    own = {Runner.of_flow(flow, system): flow for flow in flows}
    y0 = system.domain.sample(STATES, SEED)
    rows = []
    for target in TARGETS:
        steps: dict[Runner, int] = {}
        for runner in [*own, *schemes(system)]:
            least = max(1, math.ceil(T / runner.longest * (1 - 1e-12)))
            most = SHORTEST * least if runner in own else MOST // runner.forces
            guess = max(least, round(1000 / runner.forces))
            found = fewest_steps(partial(error, system, y0, runner), target, min(guess, most), least, most)
            if found is not None:
                steps[runner] = found
        if not any(r in own for r in steps):
            print(f"{name}: no flow reaches {target:g}", flush=True)
            continue
        work = {r: n * (r.forces + r.hessians / 2) for r, n in steps.items()}
        sides = [[r for r in steps if (r in own) == mine] for mine in (True, False)]
        near = [r for side in sides for r in side if work[r] <= NEAR * min(work[s] for s in side)]
        seconds = dict.fromkeys(near, math.inf)
        for r in near:
            r.one(T / steps[r], y0[0], 1, last(1))
        for _ in range(rounds):
            for r in near:
                begun = time.process_time()
                r.one(T / steps[r], y0[0], LONGER * steps[r], last(LONGER * steps[r]))
                seconds[r] = min(seconds[r], time.process_time() - begun)
        flow = min((r for r in near if r in own), key=seconds.__getitem__)
        rival = min((r for r in near if r not in own), key=seconds.__getitem__)
        fewest = min(steps[r] * r.forces for r in steps if r not in own)
        rows.append(
            {
                "lattice": name,
                "sites": system.ndof,
                "target": target,
                "flow": flow.name,
                "dt": T / steps[flow],
                "seconds": seconds[flow],
                "rival": rival.name,
                "faster": seconds[rival] / seconds[flow],
                "forces_saved": fewest / (steps[flow] * flow.forces),
            }
        )
        print(rows[-1], flush=True)
    return rows


def fragment(rows: list[dict[str, Any]]) -> str:
    titles = ["lattice, energy error", "sites", "flow: Δt, kicks + processor", "its step", "forces saved", "run time"]
    return fragments.table(
        titles,
        [
            [
                f"{LATTICES[r['lattice']][0]}, {r['target']:.0e}".replace("e-0", "e-"),
                f"{r['sites']:,}",
                r["flow"].removeprefix("Δt = "),
                f"{r['dt']:.3g}",
                f"{r['forces_saved']:.1f}",
                f"{r['faster']:.2f} {r['rival']}",
            ]
            for r in rows
        ],
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", help=f"some of {', '.join(LATTICES)}, with commas")
    parser.add_argument("--flows", type=Path, default=SHIPPED, help="folder of the flows; the package's if left out")
    parser.add_argument("--fit", action="store_true", help="fit the flows that are not there, and keep them")
    parser.add_argument("--steps", help="with --fit: some of the steps Δt, with commas")
    parser.add_argument("--sites", type=int, default=1024)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--json", type=Path, help="file for the rows")
    fragments.add_out(parser)
    options = parser.parse_args()
    names = list(LATTICES) if options.only is None else options.only.split(",")
    lengths = STEPS if options.steps is None else tuple(map(float, options.steps.split(",")))
    common = (options.sites, options.flows, options.fit, lengths, options.rounds)
    rows = [row for name in names for row in race(name, *common)]
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    fragments.write(options.out, "large-flows", fragment(rows))
    print(fragment(rows))


if __name__ == "__main__":
    main()
