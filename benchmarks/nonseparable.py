"""A network, Gauss methods and explicit ones on two copies where H does not split: the double pendulum.

    python benchmarks/nonseparable.py                  two and a half minutes of training, on one core
    python benchmarks/nonseparable.py --seconds 10     a look

A SympFlow is trained on states below an energy for so many seconds, by Gauss–Newton. Then it, the Gauss methods and
Tao's, dop853 beside them, run to T = 100 from the same state, compiled where they compile. The state error is the
largest against gauss_legendre8 with dt = 0.01, the energy error the largest relative one, both over 1000 outputs. The
run time is that of a call of `solve` with the final state as the only output, the shortest of nine.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import time
import warnings

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

import numpy as np
from measuring import fragments

from sympflow import Box, EnergySublevel, HamiltonianSystem, max_energy_error, solve, train
from sympflow.flow.flow_map import FlowMap

DOUBLE_PENDULUM = "(p1**2 + 2*p2**2 - 2*p1*p2*cos(q1 - q2))/(2*(1 + sin(q1 - q2)**2)) - 2*cos(q1) - cos(q2)"
T, OUTPUTS, REPEATS = 100.0, 1000, 9
RUNS = (
    *(("implicit_midpoint", dt) for dt in (0.1, 0.01)),
    *(("gauss_legendre4", dt) for dt in (0.2, 0.1)),
    *(("gauss_legendre6", dt) for dt in (0.4, 0.2)),
    *(("gauss_legendre8", dt) for dt in (0.5, 0.25)),
    *(("tao4", dt) for dt in (0.1, 0.05)),
    *(("tao6", dt) for dt in (0.1, 0.05)),
    *(("tao8", dt) for dt in (0.2, 0.1)),
)


def double_pendulum() -> HamiltonianSystem:
    """Two unit masses on unit rods, g = 1, below an energy of 1 above rest."""
    box = Box(low=[-1.1, -1.65, -2.1, -1.5], high=[1.1, 1.65, 2.1, 1.5])
    return HamiltonianSystem.from_sympy(
        DOUBLE_PENDULUM,
        name="double_pendulum",
        domain=EnergySublevel(-2.0, box),
        y0=[0.6, 0.8, 0.0, 0.0],
        t_span=(0.0, T),
        dt=0.1,
    )


def trained(system: HamiltonianSystem, seconds: float) -> FlowMap:
    """A network that was trained for so long."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # the budget is over: that is the plan
        return train(
            system, 0.2, kind="sympflow", optimizer="gauss-newton", points=1000, steps=100_000, time_budget=seconds
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=150.0, help="of training")
    fragments.add_out(parser)
    options = parser.parse_args()
    system = double_pendulum()
    times = np.linspace(0.0, T, OUTPUTS + 1)
    exact = solve(system, "gauss_legendre8", t_eval=times, dt=0.01).y
    rows = []
    flow = trained(system, options.seconds)
    runs = [(f"SympFlow, {options.seconds:.0f} s of training", f"Δt = {flow.dt:g}", flow, {})]
    runs += [(name, f"dt = {dt:g}", name, {"dt": dt}) for name, dt in RUNS]
    runs += [("dop853", "rtol 1e-9", "dop853", {"rtol": 1e-9, "atol": 1e-12})]
    for label, step, method, chosen in runs:
        sol = solve(system, method, t_eval=times, **chosen)
        seconds = []
        for _ in range(REPEATS):
            begin = time.perf_counter()
            solve(system, method, t_eval=[T], **chosen)
            seconds.append(time.perf_counter() - begin)
        error = np.abs(sol.y - exact).max() if sol.success else np.inf
        figures = (f"{max_energy_error(sol):.1e}", f"{error:.1e}")
        rows.append((label, step, fragments.duration(min(seconds)), *figures))
        print(fragments.row(rows[-1]), flush=True)
    table = fragments.table(("method", "step", "run time", "energy error", "state error"), rows)
    fragments.write(options.out, "nonseparable", table)


if __name__ == "__main__":
    main()
