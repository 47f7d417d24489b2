"""The compiled loops of flows that were tried, run: the time that they take, and their energy error in long runs."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

import numpy as np

from sympflow.flow.primed import PrimedFlow
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.training.points import Stream, states
from sympflow.training.starts import SEED

TIMED, TIMES = 20_000, 9  # kicks, and how often, of which the least time counts
ORBITS, LENGTH, SAVED = 20, 2048, 100  # of long runs: held-out orbits, steps of the longest Δt, states of each


def kick_seconds(flows: Sequence[PrimedFlow], system: HamiltonianSystem, domain: Domain) -> list[float]:
    """The processor time that a kick of each flow and its share of all else take; 0 where it cannot be told.

    They run in turn, each alone on this thread, and the least of nine times counts, so that other work on the machine
    hardly matters. Compiling them is not lost: it is kept for the first run of such a flow.
    """
    y0, least = states(domain, 1, SEED, Stream.REFERENCE)[0], [math.inf] * len(flows)
    kicks = [flow.kernel_scheme().force_evaluations for flow in flows]
    for turn in range(1 + TIMES):  # the first compiles
        for i, flow in enumerate(flows):
            n = TIMED // kicks[i]
            kernel, save = flow.kernel_for(system), np.array([n])
            began = time.thread_time()
            whole = kernel.run(flow.dt, y0, n, save).n_finite == n
            if turn or not whole:
                least[i] = min(least[i], (time.thread_time() - began) / (n * kicks[i])) if whole else 0.0
    return least


def long_errors(flows: Sequence[PrimedFlow], system: HamiltonianSystem, domain: Domain) -> list[float]:
    """The relative energy error of each flow in long runs, the median over held-out orbits; ∞ where one ends early.

    All runs are of one length, 2048 times the longest Δt.
    """
    orbits, errors = states(domain, ORBITS, SEED, Stream.REFERENCE), []
    H = system.hamiltonian(orbits)
    scale = np.abs(H) if system.energy_scale is None else system.energy_scale
    for flow in flows:
        n = round(LENGTH * max(other.dt for other in flows) / flow.dt)
        save = np.linspace(0, n, SAVED + 1).astype(int)[1:]
        kernel = flow.kernel_for(system)
        with np.errstate(all="ignore"):
            energies = [system.hamiltonian(kernel.run(flow.dt, y, n, save).states) for y in orbits]
            worst = np.abs(np.array(energies) - H[:, None]).max(1) / scale
        errors.append(float(np.median(np.where(np.isnan(worst), np.inf, worst))))
    return errors
