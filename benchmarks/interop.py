"""Cost of our methods inside SciPy and torchdiffeq, against the methods that are at home there.

    python benchmarks/interop.py                 # a table; about a minute on two cores
    python benchmarks/interop.py --json out.json # the same as JSON

1. The time of a step inside `solve_ivp`: the default Hénon–Heiles flow (Δt = 1.4) and the network (Δt = 1) against
   SciPy's RK45 on the system object, and on a right-hand side written in plain NumPy.
2. Batched `odeint` of 1000 Hénon–Heiles trajectories to T = 20: ours against dopri5 at the same median error of the
   state, dopri5's tolerance being bisected until its error is that of ours. Without gradients ours run compiled; with
   gradients (forward and backward) both are eager torch.
3. The zeros of cos t on [0, 200] as events of the exact three-shear flow.

Each time is the best of three runs, methods in turn; the first call, which compiles, is not counted. One thread.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from measuring import fragments
from scipy.integrate import RK45

from sympflow import get, solve, systems
from sympflow.flow.shipped import named
from sympflow.interop.scipy import as_scipy
from sympflow.interop.torchdiffeq import odeint
from sympflow.studies.reports import Column, number, seconds, text_table

HH = systems.henon_heiles()
N, T_END = 1000, 20.0
NETWORK = "henon_heiles-sympflow"


def plain(t: float, y: np.ndarray) -> np.ndarray:
    """The right-hand side of Hénon–Heiles as a user of SciPy writes it."""
    q1, q2, p1, p2 = y
    return np.array([p1, p2, -q1 - 2 * q1 * q2, -q2 - q1 * q1 + q2 * q2])


def best(run: Callable[[], Any], repeats: int = 3) -> float:
    """The shortest of some run times, after a first call that is not counted."""
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times)


def step_costs(n: int = 1000) -> list[dict[str, Any]]:
    """Seconds for each step of `solve_ivp`'s solvers, without and with the dense output that events need."""
    solvers = {
        "sympflow": (as_scipy("sympflow", HH), HH),
        "sympflow, network (Δt = 1)": (as_scipy("sympflow", HH, flow=NETWORK), HH),
        "verlet": (as_scipy("verlet", HH), HH),
        "RK45 of SciPy, plain NumPy": (RK45, plain),
        "RK45 of SciPy": (RK45, HH),
    }

    def steps(solver: Any, function: Any, dense: bool) -> None:
        s = solver(function, 0.0, HH.y0, 1e5)
        for _ in range(n):
            s.step()
            if dense:
                s.dense_output()(0.5 * (s.t_old + s.t))

    rows = []
    for name, pair in solvers.items():
        bare, dense = (best(lambda d=d, p=pair: steps(*p, d)) / n for d in (False, True))
        rows.append({"solver": name, "step": bare, "step_and_dense": dense})
    return rows


def error(y: torch.Tensor, reference: np.ndarray) -> float:
    return float(np.median(np.abs(y.detach().numpy()[-1] - reference).max(-1)))


def equal_errors() -> list[dict[str, Any]]:
    """Run times of ours and of dopri5 at equal median error."""
    y0 = torch.from_numpy(HH.domain.sample(N, 0))  # type: ignore[union-attr]
    t = torch.tensor([0.0, T_END], dtype=torch.float64)
    reference = solve(HH, "kahan_li8", (0, T_END), y0=y0.numpy(), t_eval=[T_END], dt=0.01).y[..., 0]

    def dopri5(tolerance: float, y: torch.Tensor = y0) -> torch.Tensor:
        return odeint(HH, y, t, method="dopri5", rtol=tolerance, atol=tolerance)

    rows = []
    for method, options in (
        ("sympflow", {}),
        ("sympflow", {"flow": named(NETWORK).load(HH)}),
        ("srkn6b", {"dt": 0.5}),
        ("srkn11b", {"dt": 0.5}),
        ("kahan_li8", {"dt": 0.25}),
    ):

        def ours(y: torch.Tensor = y0, method: str = method, options: Any = options) -> torch.Tensor:
            return odeint(HH, y, t, method=method, options=options)

        target = error(ours(), reference)
        low, high = -13.0, -1.0  # exponents of the tolerance: the error of `low` is below the target
        for _ in range(7):
            middle = (low + high) / 2
            low, high = (middle, high) if error(dopri5(10**middle), reference) < target else (low, middle)
        tolerance = 10**low
        row = {
            "method": f"{method}, network" if "flow" in options else method,
            "error": target,
            "dopri5_tolerance": tolerance,
        }
        row["dopri5_error"] = error(dopri5(tolerance), reference)
        graph = y0.clone().requires_grad_(True)
        row |= {"time": best(ours), "dopri5_time": best(lambda e=tolerance: dopri5(e), 1)}
        row |= {
            "time_with_gradient": best(lambda f=ours, g=graph: f(g).sum().backward(), 1),
            "dopri5_time_with_gradient": best(lambda e=tolerance, g=graph: dopri5(e, g).sum().backward(), 1),
        }
        rows.append(row)
    return rows


def zeros() -> dict[str, Any]:
    """The largest error of the zeros of cos t found as events."""
    sys.path.insert(0, str(Path(__file__).parent.parent / "examples"))
    from exact_rotation import rotation

    oscillator = systems.harmonic_oscillator()
    flow = rotation()
    sol = solve(oscillator, flow, (0, 200), [1.0, 0.0], t_eval=[], events=lambda t, y: y[0], on_domain_exit="ignore")
    expected = math.pi * (np.arange(64) + 0.5)
    return {"found": len(sol.t_events[0]), "error": float(np.abs(sol.t_events[0] - expected).max())}  # type: ignore[index]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", type=Path)
    fragments.add_out(parser)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    get("sympflow")().check(HH)
    result = {"solve_ivp": step_costs(), "odeint": equal_errors(), "zeros_of_cos": zeros()}

    rk45 = result["solve_ivp"][-1]
    print("A step inside solve_ivp\n")
    print(
        text_table(
            [
                Column("solver", [row["solver"] for row in result["solve_ivp"]], left=True),
                Column("step", [seconds(row["step"]) for row in result["solve_ivp"]]),
                Column("of RK45's", [f"{row['step'] / rk45['step']:.2f}" for row in result["solve_ivp"]]),
                Column("with dense output", [seconds(row["step_and_dense"]) for row in result["solve_ivp"]]),
                Column(
                    "of RK45's",
                    [f"{row['step_and_dense'] / rk45['step_and_dense']:.2f}" for row in result["solve_ivp"]],
                ),
            ]
        )
    )
    rows = result["odeint"]
    print(f"\nodeint of {N} Hénon–Heiles trajectories to T = {T_END:g}, at equal median error\n")
    print(
        text_table(
            [
                Column("method", [row["method"] for row in rows], left=True),
                Column("error", [number(row["error"]) for row in rows]),
                Column("dopri5's", [number(row["dopri5_error"]) for row in rows]),
                Column("time", [seconds(row["time"]) for row in rows]),
                Column("times faster than dopri5", [f"{row['dopri5_time'] / row['time']:.1f}" for row in rows]),
                Column("with gradient", [seconds(row["time_with_gradient"]) for row in rows]),
                Column(
                    "times faster",
                    [f"{row['dopri5_time_with_gradient'] / row['time_with_gradient']:.1f}" for row in rows],
                ),
            ]
        )
    )
    steps = [
        (row["solver"], f"{row['step'] / rk45['step']:.2f}", f"{row['step_and_dense'] / rk45['step_and_dense']:.2f}")
        for row in result["solve_ivp"]
    ]
    titles = ("solver", "a step, of SciPy's RK45", "with a state within the step")
    fragments.write(arguments.out, "interop-steps", fragments.table(titles, steps))
    ratios = [
        (
            row["method"],
            f"{row['error']:.1e}",
            fragments.three(row["dopri5_time"] / row["time"]),
            fragments.three(row["dopri5_time_with_gradient"] / row["time_with_gradient"]),
        )
        for row in rows
    ]
    titles = ("method", "error", "times faster", "with gradients")
    fragments.write(arguments.out, "interop-odeint", fragments.table(titles, ratios))
    found = result["zeros_of_cos"]
    print(f"\n{found['found']} zeros of cos t found, the worst wrong by {found['error']:.1e}")
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
