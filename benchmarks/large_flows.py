"""Flows of lattices, fitted on a few sites, against every splitting scheme of the package at equal energy error.

    python benchmarks/large_flows.py [--out docs/measured]
    python benchmarks/large_flows.py --only fput_beta,toda_chain  some of the lattices
    python benchmarks/large_flows.py --flows folder             with the flows of a folder beside those that ship
    python benchmarks/large_flows.py --json found.json --search   numbers of steps alone, to be timed when all is quiet
    python benchmarks/large_flows.py --sites 10000 --states 4   another size of chains and, squared, of sheets

Lattices of 1024 sites at energy densities of 0.02 to 0.2 above rest. The flows are those that ship, fitted on 6 or
4 × 4 sites by the recipes in the files that ship, whose Δt were chosen on other states. The error is
the largest of the energy up to T = 100, relative to the energy above rest, the median over twenty held-out states of
the lattice. For each target every scheme, and every flow with steps of a quarter of its Δt and longer, gets the fewest
steps that meet it. Then they run in turn over T = 5000, one thread, one state of which the end is kept: the least
process time of several. The error of a coordinate at t = 10, of the flow and of the scheme with these steps, stands
beside: it is not what they were made equal in.

A second table says how much longer a kick takes that has a force gradient.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
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
from sympflow import HamiltonianSystem, LatticeStates
from sympflow.flow.primed import PrimedFlow

TARGETS = (1e-4, 1e-6, 1e-8)
SITES = 1024
T, OUTPUTS, STATES, SEED = 100.0, 100, 20, 20_261_126
LONGER = 50  # times T, of a run that is timed: of a shorter one the fixed costs of a call are several per cent
SHORT, FINE = 0.1, ("srkn14a", 4000)  # of T, after which states are compared with a scheme's that takes so many in T
DENSITY = 0.02, 0.2
STEP, STEPS = 0.05, 20_000  # of a run that shows what a force gradient costs
NEAR = 1.7  # schemes with so many times the fewest forces are not timed
MOST = 5000  # forces up to T of a scheme that is in the race
SHIPPED = Path(sympflow.__file__).parent / "pretrained"


PHI4 = {"onsite": "(q**2 - 1)**2/4", "bond": "r**2/2"}
LATTICES: dict[str, tuple[str, dict[str, Any], int]] = {
    "fput_beta": ("FPUT-β", {"bond": "r**2/2 + r**4/4"}, 1),
    "phi4": ("φ⁴", PHI4, 1),
    "phi4_sheet": ("φ⁴, two axes", PHI4, 2),
    "toda_chain": ("Toda", {"bond": "exp(-r) + r - 1"}, 1),
    "sine_gordon": ("sine-Gordon", {"onsite": "1 - cos(q)", "bond": "r**2/2"}, 1),
}
"""Title, terms and number of axes. The fastest frequency is 2 to 3.2."""


def lattice(name: str, sites: int) -> HamiltonianSystem:
    _, terms, axes = LATTICES[name]
    n = sites if axes == 1 else round(sites ** (1 / axes))
    return HamiltonianSystem.lattice(**terms, shape=(n,) * axes, name=name, domain=LatticeStates(DENSITY))


def flows_of(system: HamiltonianSystem, folder: Path) -> list[PrimedFlow]:
    """The flows of a system that ship or are in a folder."""
    paths = {path.name: path for place in (SHIPPED, folder) for path in place.glob(f"{system.name}-*.safetensors")}
    found = [sympflow.load(paths[name]) for name in sorted(paths)]
    return [flow.bound(system) for flow in found if isinstance(flow, PrimedFlow) and flow.matches(system)]


@dataclass
class Race:
    """The flows and schemes of a system up to `t_end`, timed up to `longer` times that; `rest` is H at rest."""

    system: HamiltonianSystem
    flows: list[Runner]
    schemes: list[Runner]
    t_end: float = T
    outputs: int = OUTPUTS
    states: int = STATES
    rest: float = 0.0
    longer: int = LONGER
    _fine: np.ndarray | None = None

    @classmethod
    def of(cls, system: HamiltonianSystem, folder: Path, **more: Any) -> Race:
        flows = [Runner.of_flow(flow, system) for flow in flows_of(system, folder)]
        return cls(system, flows, schemes(system), **more)

    def error(self, y0: np.ndarray, runner: Runner, n: int) -> float:
        """The largest energy error in n steps, relative to the energy above rest, the median over states."""
        save = np.unique(np.linspace(0, n, self.outputs + 1).round().astype(np.int64))
        with np.errstate(all="ignore"):
            H = self.system.hamiltonian(runner.many(self.t_end / n, y0, n, save)[0])
            largest = np.abs(H - H[:, :1]).max(1) / (H[:, 0] - self.rest)
        return float(np.median(np.where(np.isnan(largest), np.inf, largest)))

    def state_error(self, runner: Runner, n: int) -> float:
        """The error of a coordinate or momentum after a tenth of T, where a run has n steps: the median over states."""
        if self._fine is None:
            self._fine = self._after(Runner.of_scheme(FINE[0], self.system), FINE[1])
        difference = self._after(runner, n) - self._fine
        return float(np.median(np.sqrt((difference**2).mean(-1))))

    def _after(self, runner: Runner, n: int) -> np.ndarray:
        n = math.ceil(SHORT * n)
        return runner.many(SHORT * self.t_end / n, self.y0(), n, last(n))[0][:, -1]

    def y0(self) -> np.ndarray:
        assert self.system.domain is not None
        return self.system.domain.sample(self.states, SEED)

    def steps(self, target: float) -> dict[str, int]:
        """The fewest steps up to T of each that meets a target."""
        y0, steps = self.y0(), {}
        for runner in [*self.flows, *self.schemes]:
            least = max(1, math.ceil(self.t_end / runner.longest * (1 - 1e-12)))
            most = SHORTEST * least if runner in self.flows else MOST // runner.forces
            guess = max(least, round(1000 / runner.forces))
            found = fewest_steps(partial(self.error, y0, runner), target, min(guess, most), least, most)
            if found is not None:
                steps[runner.name] = found
        return steps

    def row(self, target: float, steps: dict[str, int], rounds: int) -> dict[str, Any] | None:
        """The fastest flow and the fastest scheme, each with so many steps; none if no flow meets the target."""
        y0 = self.y0()[0]
        sides = [[r for r in side if r.name in steps] for side in (self.flows, self.schemes)]
        if not sides[0]:
            print(f"{self.system.name}: no flow reaches {target:g}", flush=True)
            return None
        work = {r: steps[r.name] * (r.forces + r.hessians / 2) for side in sides for r in side}
        near = [r for side in sides for r in side if work[r] <= NEAR * min(work[s] for s in side)]
        seconds = dict.fromkeys(near, math.inf)
        for r in near:
            r.one(self.t_end / steps[r.name], y0, 1, last(1))
        held: list[np.ndarray] = []
        for _ in range(rounds):
            elsewhere(held)
            for r in near:
                n = self.longer * steps[r.name]
                begun = time.process_time()
                r.one(self.longer * self.t_end / n, y0, n, last(n))
                seconds[r] = min(seconds[r], time.process_time() - begun)
        flow, rival = (min((r for r in side if r in seconds), key=seconds.__getitem__) for side in sides)
        fewest = min(steps[r.name] * r.forces for r in sides[1])
        off = [self.state_error(r, steps[r.name]) for r in (flow, rival)]
        return {
            "lattice": self.system.name,
            "sites": self.system.ndof,
            "target": target,
            "flow": flow.name,
            "dt": self.t_end / steps[flow.name],
            "seconds": seconds[flow],
            "rival": rival.name,
            "faster": seconds[rival] / seconds[flow],
            "forces_saved": fewest / (steps[flow.name] * flow.forces),
            "state_errors": off,
        }


def elsewhere(held: list[np.ndarray]) -> None:
    """Take some memory, so that working arrays lie elsewhere in the next round, on which their loops' times depend."""
    held.append(np.empty(2_000 + 600 * len(held)))


def gradient_cost(name: str, sites: int, rounds: int) -> float:
    """Times that a kick with a force gradient and the drift after it take as long as they do without.

    A step of leapfrog has one without, and one of `chin4a` one of each.
    """
    system = lattice(name, sites)
    assert system.domain is not None
    y0 = system.domain.sample(1, SEED)[0]
    runners = [Runner.of_scheme(scheme, system) for scheme in ("leapfrog", "chin4a")]
    seconds = [math.inf, math.inf]
    for r in runners:
        r.one(STEP, y0, 1, last(1))
    held: list[np.ndarray] = []
    for _ in range(rounds):
        elsewhere(held)
        for i, r in enumerate(runners):
            begun = time.process_time()
            r.one(STEP, y0, STEPS, last(STEPS))
            seconds[i] = min(seconds[i], time.process_time() - begun)
    return seconds[1] / seconds[0] - 1


def gradients_fragment(costs: dict[str, float]) -> str:
    return fragments.table(
        ["lattice", "kick with force gradient"], [[LATTICES[name][0], f"{cost:.2f}"] for name, cost in costs.items()]
    )


def fragment(rows: list[dict[str, Any]], titles: Mapping[str, str], parts: str = "sites") -> str:
    """The table of a race; titles by the names of systems, and of what they are made."""
    columns = ["system, energy error", parts, "flow: Δt, kicks + processor", "its step", "forces saved", "run time"]
    columns.append("state error")
    return fragments.table(
        columns,
        [
            [
                f"{titles[r['lattice']]}, {r['target']:.0e}".replace("e-0", "e-"),
                f"{r['sites']:,}",
                r["flow"].removeprefix("Δt = "),
                f"{r['dt']:.3g}",
                f"{r['forces_saved']:.1f}",
                f"{r['faster']:.2f} {r['rival']}",
                " / ".join(f"{error:.0e}" for error in r["state_errors"]),
            ]
            for r in rows
        ],
    )


def found_before(path: Path | None) -> dict[str, dict[str, Any]]:
    """Rows that an earlier call kept."""
    return json.loads(path.read_text("utf-8")) if path is not None and path.exists() else {}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", help=f"some of {', '.join(LATTICES)}, with commas")
    parser.add_argument("--flows", type=Path, default=SHIPPED, help="folder of flows beside those that ship")
    parser.add_argument("--sites", type=int, default=SITES)
    parser.add_argument("--states", type=int, default=STATES)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--json", type=Path, help="file for what is found; what is in it is not measured again")
    parser.add_argument("--search", action="store_true", help="leave the times to a later call with this file")
    fragments.add_out(parser)
    options = parser.parse_args()
    names = list(LATTICES) if options.only is None else options.only.split(",")
    found = found_before(options.json)
    for name in names:
        mine = found.setdefault(name, {})
        if "rows" not in mine:
            entrants = Race.of(lattice(name, options.sites), options.flows, states=options.states)
            if "steps" not in mine:
                mine["steps"] = [entrants.steps(target) for target in TARGETS]
            if not options.search:
                of_targets = zip(TARGETS, mine["steps"], strict=True)
                mine["rows"] = [entrants.row(target, steps, options.rounds) for target, steps in of_targets]
                mine["gradient"] = gradient_cost(name, options.sites, options.rounds)
        if options.json:
            options.json.write_text(json.dumps(found, indent=1), encoding="utf-8")
    if options.search:
        return
    rows = [row for name in names for row in found[name]["rows"] if row is not None]
    costs = {name: found[name]["gradient"] for name in names}
    size = "" if options.sites == SITES else f"-{options.sites}"
    titles = {name: lattice[0] for name, lattice in LATTICES.items()}
    bodies = {f"large-flows{size}": fragment(rows, titles)}
    if not size:
        bodies["large-gradients"] = gradients_fragment(costs)
    for name, body in bodies.items():
        fragments.write(options.out, name, body)
        print(body)


if __name__ == "__main__":
    main()
