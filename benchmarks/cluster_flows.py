"""Flows of a Lennard-Jones cluster, fitted on 13 bodies, against every splitting scheme at equal energy error.

    python benchmarks/cluster_flows.py --flows folder [--out docs/measured]
    python benchmarks/cluster_flows.py --flows folder --fit        flows that are fitted first, and kept in the folder
    python benchmarks/cluster_flows.py --flows folder --json found.json --search   steps alone, to be timed when quiet

147 bodies with energies of 0.02 to 0.2 above the minimum of V, each. The race is that of `large_flows.py`, up to
T = 10, some forty periods of the fastest vibration: the largest energy error, relative to the energy above the minimum,
the median over a few held-out states. Then all run in turn over ten times that, one thread, one state of which the end
is kept.
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
NAME, T, OUTPUTS = "lennard_jones", 10.0, 20
LADDER = Primed(0.03, 1, 8, force_gradient=True), Primed(0.04, 6, 8, force_gradient=False)
"""The flows that `--fit` fits, a force gradient taking as long as a force. The fastest frequency is 26."""
QUICK = {**FIT, "restarts": 6, "steps": 150, "points": 16, "label_times": 3, "reference_states": 40}


def cluster(bodies: int) -> HamiltonianSystem:
    masses, domain = np.ones(bodies), ClusterStates(DENSITY)
    return HamiltonianSystem.pairs("4*(r**-12 - r**-6)", masses=masses, domain=domain, name=NAME)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flows", type=Path, required=True, help="folder of the flows")
    parser.add_argument("--fit", action="store_true", help="fit the flows that are not there, and keep them")
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
    flows = flows_of(system, options.flows, LADDER if options.fit else (), QUICK)
    entrants = [Runner.of_flow(flow, system) for flow in flows]
    race = Race(system, entrants, schemes(system), T, OUTPUTS, rest)
    found.setdefault("steps", [race.steps(target) for target in TARGETS])
    if not options.search:
        steps = zip(TARGETS, found["steps"], strict=True)
        found.setdefault("rows", [race.row(target, least, options.rounds) for target, least in steps])
    if options.json:
        options.json.write_text(json.dumps({NAME: found}, indent=1), encoding="utf-8")
    if not options.search:
        body = fragment([row for row in found["rows"] if row is not None], {NAME: "Lennard-Jones"})
        fragments.write(options.out, "large-clusters", body)
        print(body)


if __name__ == "__main__":
    main()
