"""Flows of a Lennard-Jones cluster, fitted on 13 bodies, against every splitting scheme at equal energy error.

    python benchmarks/cluster_flows.py [--out docs/measured]
    python benchmarks/cluster_flows.py --fit --flows folder        flows that are fitted first, and kept in a folder
    python benchmarks/cluster_flows.py --json found.json --search   numbers of steps alone, to be timed when all is quiet

343 bodies with energies of 0.02 to 0.2 above the minimum of V, each. The race is that of `large_flows.py`, up to
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
from large_flows import FIT, TARGETS, Race, flows_of
from measuring import fragments
from measuring.race import Runner, schemes

from sympflow import ClusterStates, HamiltonianSystem
from sympflow.training.starts import Primed

DENSITY = 0.02, 0.2
T = 10.0
LADDER: tuple[Primed, ...] = ()
"""The flows that `--fit` fits. The fastest frequency is 26."""


def cluster(bodies: int) -> HamiltonianSystem:
    scene = {"name": "lennard_jones", "domain": ClusterStates(DENSITY)}
    return HamiltonianSystem.pairs("4*(r**-12 - r**-6)", masses=np.ones(bodies), **scene)
