"""Flows that `train(system)` with nothing else gives on systems that are not built in, beside splitting schemes.

    python benchmarks/own_systems.py              all of them, each 15 s of training and a minute of comparison
    python benchmarks/own_systems.py mass         one of them
    python benchmarks/own_systems.py --kept own   with flows and steps kept in a folder, and taken from there
    python benchmarks/own_systems.py --quick      the same in miniature

At the flow's own median energy error over 20 held-out states up to T = 1000, each scheme gets the longest step, to 2 %,
that is as good; then all run through `solve`, in turn, on one thread: the least processor time of nine runs of one
trajectory to T = 1e5, of one with 1000 outputs up to T = 1000, ten times, and of a batch of 1000 to T = 100, where the
calls themselves are half of the time of some, and to T = 1000.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

import numpy as np
from measuring import fragments

from sympflow import Box, EnergySublevel, HamiltonianSystem, get, load, max_energy_error, solve, train

RIVALS = ("blanes_moan4", "omelyan4", "omelyan6", "chin4a", "srkn6b", "srkn11b", "srkn14a", "kahan_li8")


def box(*widths: float) -> Box:
    """|x_i| ≤ width_i."""
    return Box([-w for w in widths], list(widths))


SYSTEMS = {
    "duffing": HamiltonianSystem.from_sympy(
        "p**2/2 + q**2/2 + q**4/8", domain=EnergySublevel(1.0, box(1.3, 1.5)), y0=[1.0, 0.0]
    ),
    "morse": HamiltonianSystem.from_sympy(
        "(p1**2 + p2**2)/2 + (1 - exp(-q1))**2 + (1 - exp(-q2))**2 + (1 - exp(-q1))*(1 - exp(-q2))/5",
        domain=EnergySublevel(0.4, Box([-0.6, -0.6, -0.9, -0.9], [1.2, 1.2, 0.9, 0.9])),
        y0=[0.3, -0.2, 0.2, 0.3],
    ),
    "mass": HamiltonianSystem.from_sympy(  # a full mass matrix, ∂⁴V ≠ 0
        "p1**2/4 + p2**2 + 2*p1*p2/5 + (q1**2 + q2**2)/2 + 3*q1**2*q2/10 + (q1**4 + q2**4)/5",
        domain=EnergySublevel(0.6, box(1.6, 1.6, 2.0, 1.2)),
        y0=[0.3, 0.2, 0.1, 0.1],
    ),
    "singular": HamiltonianSystem.from_sympy(
        "(p1**2 + p2**2)/2 + (q1**2 + q2**2)/2 + 1/(2*(q1 - q2)**2) + q1**4/20",
        domain=EnergySublevel(2.0, Box([-2.3, -1.0, -2.0, -2.0], [1.0, 2.3, 2.0, 2.0])),
        y0=[-0.7, 0.7, 0.1, 0.1],
    ),
    "three": HamiltonianSystem.from_sympy(
        "(p1**2 + p2**2 + p3**2 + q1**2 + q2**2 + q3**2)/2 + (q1**2 + q3**2)*q2**2/2 + 3*q3*q1**2/10 + q3**4/10",
        domain=EnergySublevel(0.5, box(1.3, 1.3, 1.3, 1.1, 1.1, 1.1)),
        y0=[0.3, 0.2, 0.1, 0.1, 0.2, 0.3],
    ),
    "wells": HamiltonianSystem.from_sympy(  # two coupled double wells
        "(p1**2 + p2**2)/2 + (q1**2 - 1)**2/4 + (q2**2 - 1)**2/4 + q1*q2/10",
        domain=EnergySublevel(0.8, box(2.0, 2.0, 2.0, 2.0)),
        y0=[0.9, 0.5, 0.1, 0.1],
    ),
    "bonds": HamiltonianSystem.from_sympy(  # two Morse bonds, one after the other
        "(p1**2 + p2**2)/2 + (1 - exp(-q1))**2 + (1 - exp(-(q2 - q1)))**2",
        domain=EnergySublevel(0.3, Box([-0.6, -0.8, -0.8, -0.8], [1.0, 1.6, 0.8, 0.8])),
        y0=[0.1, 0.2, 0.2, 0.1],
    ),
    "ring": HamiltonianSystem.from_sympy(  # three sites of a Toda lattice, held
        "(p1**2 + p2**2 + p3**2)/2 + exp(q1 - q2) + exp(q2 - q3) + exp(q3 - q1) - 3 + (q1**2 + q2**2 + q3**2)/10",
        domain=EnergySublevel(0.8, box(1.2, 1.2, 1.2, 1.3, 1.3, 1.3)),
        y0=[0.3, 0.1, -0.1, 0.2, 0.1, -0.2],
    ),
}


def energy_error(system: HamiltonianSystem, method: object, states: np.ndarray, t_end: float) -> float:
    """The largest relative energy error up to t_end, the median over the states."""
    t = np.linspace(0.0, t_end, 501)
    with np.errstate(all="ignore"):
        errors = max_energy_error(solve(system, method, (0.0, t_end), y0=states, t_eval=t, on_domain_exit="ignore"))
    return float(np.median(errors))


def longest_step(system: HamiltonianSystem, name: str, target: float, states: np.ndarray, t_end: float) -> float:
    """The longest step of a scheme with which its energy error is at most the target; 0 if that of 0.002 is not."""
    short, long = 2e-3, 3.0
    if not energy_error(system, get(name)(dt=short), states, t_end) <= target:
        return 0.0
    while long > 1.02 * short:
        middle = (short * long) ** 0.5
        good = energy_error(system, get(name)(dt=middle), states, t_end) <= target
        short, long = (middle, long) if good else (short, middle)
    return short


def trained(name: str, system: HamiltonianSystem, quick: bool, kept: Path | None) -> Any:
    """The flow that `train` gives, or that of the folder."""
    path = None if kept is None else kept / f"{name}.safetensors"
    if path is not None and path.exists():
        return load(path, system=system)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # the end of the time budget
        flow = train(system, **({"restarts": 2, "steps": 10, "points": 40} if quick else {}))
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        flow.save(path)
    return flow


def compared(name: str, system: HamiltonianSystem, flow: Any, quick: bool, kept: Path | None) -> dict[str, Any]:
    """The flow's energy error, and for each scheme the step with which it has that; kept in the folder."""
    path = None if kept is None else kept / f"{name}.json"
    if path is not None and path.exists():
        return dict(json.loads(path.read_text(encoding="utf-8")))
    assert system.domain is not None
    states, t_end = system.domain.sample(20, 777), 10.0 if quick else 1000.0
    target = energy_error(system, flow, states, t_end)
    rivals = RIVALS[-2:] if quick else RIVALS
    steps = {rival: step for rival in rivals if (step := longest_step(system, rival, target, states, t_end))}
    found = {"error": target, "steps": steps}
    if path is not None:
        path.write_text(json.dumps(found), encoding="utf-8")
    return found


def least_times(calls: list[Callable[[], Any]], runs: int) -> np.ndarray:
    """The least processor time of each call, made in turn."""
    times = []
    for _ in range(1 + runs):
        for call in calls:
            begin = time.process_time()
            call()
            times.append(time.process_time() - begin)
    return np.reshape(times, (-1, len(calls)))[1:].min(0)


def row(name: str, system: HamiltonianSystem, quick: bool, kept: Path | None = None) -> str:
    """The line of a system in the table."""
    flow = trained(name, system, quick, kept)
    found = compared(name, system, flow, quick, kept)
    assert system.domain is not None
    methods = [flow, *(get(rival)(dt=step) for rival, step in found["steps"].items())]
    y0, many = system.domain.sample(20, 777)[0], system.domain.sample(1000, 778)
    far, outputs, short, long = (100.0, 10, 1.0, 2.0) if quick else (1e5, 1000, 100.0, 1000.0)

    def run(method: Any, y: np.ndarray, t_eval: np.ndarray, times: int = 1) -> None:
        for _ in range(times):
            solve(system, method, (0.0, float(t_eval[-1])), y0=y, t_eval=t_eval, on_domain_exit="ignore")

    kinds = (
        (y0, np.array([far]), 1),
        (y0, np.linspace(0.0, far / 100, outputs + 1), 10),
        (many, np.array([short]), 1),
        (many, np.array([long]), 1),
    )
    columns, versus = [], 0.0
    for i, kind in enumerate(kinds):
        least = least_times([partial(run, method, *kind) for method in methods], 1 if quick else 9)
        ratios = dict(zip(found["steps"], least[1:] / least[0], strict=True))
        best = min(ratios, key=ratios.__getitem__)
        columns.append(f"{ratios[best]:.2f} {best}")
        versus = ratios["kahan_li8"] if i == 0 else versus
    kicks = f"{flow.kernel_scheme().force_evaluations} + {flow.processor}{', c' * (flow.curvatures is not None)}"
    start = f"{name} | {flow.dt:g}, {kicks} | {flow.figures['training_seconds']:.0f} s | {found['error']:.1e}"
    return f"| {start} | {' | '.join(columns)} | {versus:.2f} |"


def main(given: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("systems", nargs="*", metavar="system", help=f"of {', '.join(SYSTEMS)}")
    parser.add_argument("--quick", action="store_true", help="does it run?")
    parser.add_argument("--kept", type=Path, help="folder of flows and steps, for those that are there and new ones")
    fragments.add_out(parser)
    arguments = parser.parse_args(given)
    unknown = set(arguments.systems) - set(SYSTEMS)
    if unknown:
        parser.error(f"no system {', '.join(sorted(unknown))}: choose of {', '.join(SYSTEMS)}")
    lines = [
        "| system | flow: Δt, kicks + processor | training | energy error, T = 1000 "
        "| one trajectory: best scheme takes | 1000 outputs "
        "| batch of 1000, T = 100 | batch of 1000, T = 1000 | Kahan–Li 8 takes |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    print(*lines, sep="\n")
    for name in arguments.systems or SYSTEMS:
        lines.append(row(name, SYSTEMS[name], arguments.quick, arguments.kept))
        print(lines[-1], flush=True)
    fragments.write(arguments.out, "own-systems", "\n".join(lines))


if __name__ == "__main__":
    main()
