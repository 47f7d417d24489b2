"""Flows of a Lennard-Jones cluster, fitted on 13 bodies, against every splitting scheme at equal energy error.

    python benchmarks/cluster_flows.py [--out docs/measured]
    python benchmarks/cluster_flows.py --json found.json --search   steps alone, to be timed when all is quiet

The flows are fitted first by seeded recipes, some twenty-five minutes of one core, and kept in a folder. The race is
that of `large_flows.py` on 147 bodies with energies of 0.02 to 0.2 above the minimum of V, each, up to T = 10, some
forty periods of the fastest vibration: the largest energy error, relative to the energy above the minimum, the median
over twenty held-out states. Then all run in turn over ten times that, one thread, one state of which the end is kept.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import json
from pathlib import Path

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

import numpy as np
from large_flows import FIT, TARGETS, Race, flows_of, found_before, fragment
from measuring import fragments
from measuring.race import Runner, schemes

from sympflow import ClusterStates, HamiltonianSystem
from sympflow.training.starts import Primed

DENSITY = 0.02, 0.2
NAME, T, OUTPUTS, LONGER = "lennard_jones", 10.0, 20, 10
FOLDER = Path(__file__).parents[1] / "out" / "cluster_flows"
LADDER: dict[Primed, dict[str, int]] = {
    Primed(0.075, 3, 8, force_gradient=(1,)): {"restarts": 8, "label_times": 2},
    Primed(0.05, 4, 8, first="kick", force_gradient=(1, 3)): {"restarts": 6},
    Primed(0.05, 5, 8, force_gradient=(1, 3)): {"restarts": 6},
    Primed(0.036, 8, 8, force_gradient=(1, 6)): {"restarts": 4},
}
"""The flows, and options of their fits. The fastest frequency is 26."""
QUICK = {**FIT, "steps": 150, "points": 16, "reference_states": 10, "frozen_weight": 1000.0, "runs": 32}


def cluster(bodies: int) -> HamiltonianSystem:
    masses, domain = np.ones(bodies), ClusterStates(DENSITY)
    return HamiltonianSystem.pairs("4*(r**-12 - r**-6)", masses=masses, domain=domain, name=NAME)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flows", type=Path, default=FOLDER, help="folder of the flows")
    parser.add_argument("--bodies", type=int, default=147)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", type=Path, help="file for what is found; what is in it is not measured again")
    parser.add_argument("--search", action="store_true", help="leave the times to a later call with this file")
    fragments.add_out(parser)
    options = parser.parse_args()
    found = found_before(options.json).get(NAME, {})
    system = cluster(options.bodies)
    assert system.domain is not None
    rest = float(system.hamiltonian(system.domain.at_rest))
    for start, fit in LADDER.items():
        flows_of(system, options.flows, [start], {**QUICK, **fit})
    flows = [Runner.of_flow(flow, system) for flow in flows_of(system, options.flows, [])]
    race = Race(system, flows, schemes(system), T, OUTPUTS, rest, LONGER)
    if "steps" not in found:
        found["steps"] = [race.steps(target) for target in TARGETS]
    if not options.search and "rows" not in found:
        steps = zip(TARGETS, found["steps"], strict=True)
        found["rows"] = [race.row(target, least, options.rounds) for target, least in steps]
    if options.json:
        options.json.write_text(json.dumps({NAME: found}, indent=1), encoding="utf-8")
    if not options.search:
        rows = [{**row, "sites": options.bodies} for row in found["rows"] if row is not None]
        body = fragment(rows, {NAME: "Lennard-Jones"}, "bodies")
        fragments.write(options.out, "large-clusters", body)
        print(body)


if __name__ == "__main__":
    main()
