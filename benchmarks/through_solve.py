"""What a user of `solve` pays: a shipped primed flow beside a Nyström scheme at about the same energy error.

    python benchmarks/through_solve.py

`primed.py` times the compiled loops. Here whole calls of `solve` are timed on Hénon–Heiles, with their checks, tables
and outputs: one trajectory over intervals of several lengths, one with 1000 outputs, and a batch, in turn, on one
thread. The flow is the one that `tol=1e-6` chooses, the scheme srkn11b at dt = 0.625; the median energy errors of
both, over 200 states and T = 1000, are printed first.
"""

# ruff: noqa: E402

from __future__ import annotations

from functools import partial

from contenders.environment import pin_to_one_thread

pin_to_one_thread()

import numpy as np

from sympflow import Solution, solve, systems
from sympflow.timing import interleaved

SYSTEM = systems.henon_heiles()
REPEATS, BATCH = 9, 1000
flow = partial(solve, SYSTEM, "sympflow", tol=1e-6)
scheme = partial(solve, SYSTEM, "srkn11b", dt=0.625)


def median_energy_error(run: partial[Solution]) -> float:
    """Of the largest relative error of each of 200 states."""
    y0 = SYSTEM.domain.sample(200, 3)  # type: ignore[union-attr]
    sol = run((0, 1000), y0, t_eval=np.linspace(0, 1000, 500))
    H0 = SYSTEM.hamiltonian(y0)[:, None]
    return float(np.median(np.abs(sol.energy() / H0 - 1).max(1)))


def main() -> None:
    print(f"median energy error: flow {median_energy_error(flow):.1e}, srkn11b {median_energy_error(scheme):.1e}")
    many = SYSTEM.domain.sample(BATCH, 3)  # type: ignore[union-attr]
    cases = {
        "T = 1e3, the end": ((0, 1e3), None, [1e3]),
        "T = 1e4, the end": ((0, 1e4), None, [1e4]),
        "T = 1e5, the end": ((0, 1e5), None, [1e5]),
        "T = 1e3, 1000 outputs": ((0, 1e3), None, np.linspace(0, 1e3, 1001)),
        f"T = 1e3, {BATCH} trajectories": ((0, 1e3), many, [1e3]),
    }
    for name, (t_span, y0, t_eval) in cases.items():
        calls = [partial(run, t_span, y0, t_eval=t_eval) for run in (flow, scheme)]
        for call in calls:
            call()
        mine, theirs = (time.median * 1e3 for time in interleaved(calls, REPEATS))
        print(f"{name:28} flow {mine:8.3f} ms   srkn11b {theirs:8.3f} ms   {theirs / mine:5.2f} times faster")


if __name__ == "__main__":
    main()
