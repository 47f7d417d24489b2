"""The compiled kernels against loops written by hand for the one system, and against the limits set for them.

    python benchmarks/kernels.py

Hénon–Heiles, float64, one thread. What is compared is timed in turn, in rounds, and the median of the rounds counts.
The hand-written loops (`contenders.loops`) merge kicks and vectorise as ours do. Start-up times are of fresh
processes, with an empty cache folder and with a filled one, imports apart. The flow has L = 5 pairs of potentials with
two hidden layers of 10.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

import numpy as np
import torch
from contenders.loops import composition, composition_batch, composition_table, verlet, verlet_batch
from measuring import fragments
from measuring.compiled import flow_loops, last, scheme_loops
from training_step import autodiff_map, published_value

import sympflow
from sympflow import SympFlow
from sympflow.studies.attempts import interleaved
from sympflow.systems import henon_heiles

H = 0.05
TRAJECTORIES = 1024  # whole blocks, for the hand-written loops have no others
START_UP = """
import time
import numpy as np
import numba
from measuring.compiled import last, scheme_loops
from sympflow.systems import henon_heiles

system = henon_heiles()
start = time.perf_counter()
loops = scheme_loops(system, "verlet")
loops.one(0.05, system.y0, 10, last(10))
loops.many(0.05, system.y0[None], 10, last(10))
print(time.perf_counter() - start)
"""

Call = Callable[[], object]


@dataclass(frozen=True)
class Row:
    """One measurement, and the limit that it must not exceed (or, for a speed-up, must reach)."""

    what: str
    measured: float
    unit: str
    limit: float
    at_least: bool = False
    note: str = ""

    @property
    def verdict(self) -> str:
        met = self.measured >= self.limit if self.at_least else self.measured <= self.limit
        return f"{'≥' if self.at_least else '≤'} {self.limit:g} {'met' if met else 'MISSED'}"

    def __str__(self) -> str:
        return f"{self.what:<47}{self.measured:>8.3g} {self.unit:<18}{self.verdict:<15}{self.note}"


def ratio(what: str, ours: Call, theirs: Call, work: int, limit: float, repeats: int) -> Row:
    """Our run time over theirs; `work` steps in each."""
    ours(), theirs()
    mine, other = interleaved([ours, theirs], repeats)
    note = f"{1e9 * mine.median / work:.3g} against {1e9 * other.median / work:.3g} ns a step and trajectory"
    return Row(what, mine.median / other.median, "× hand-written", limit, note=note)


def splitting_rows(repeats: int, n_single: int, n_batch: int) -> list[Row]:
    system = henon_heiles()
    y0, batch = system.y0, np.tile(system.y0, (TRAJECTORIES, 1))
    kahan_li8 = composition_table("kahan_li8", H)
    hand_written: dict[str, tuple[Call, Call]] = {
        "verlet": (lambda: verlet(*y0, H, n_single), lambda: verlet_batch(batch, H, n_batch)),
        "kahan_li8": (
            lambda: composition(*y0, n_single // 10, *kahan_li8),
            lambda: composition_batch(batch, n_batch // 10, *kahan_li8),
        ),
    }
    rows = []
    for name, (one, many) in hand_written.items():
        n, m = (n_single, n_batch) if name == "verlet" else (n_single // 10, n_batch // 10)
        loops = scheme_loops(system, name)
        ours: dict[str, Call] = {
            "kernel": lambda loops=loops, n=n: loops.one(H, y0, n, last(n)),
            "solve": lambda name=name, n=n: sympflow.solve(
                system, method=name, t_span=(0.0, n * H), y0=y0, dt=H, t_eval=[n * H]
            ),
        }
        rows += [ratio(f"{name}, one trajectory, {what}", call, one, n, 1.2, repeats) for what, call in ours.items()]
        ours_many = lambda loops=loops, m=m: loops.many(H, batch, m, last(m))  # noqa: E731
        rows.append(ratio(f"{name}, batch of {TRAJECTORIES}", ours_many, many, m * TRAJECTORIES, 1.3, repeats))
    loops = scheme_loops(system, "verlet")
    one_step: Call = lambda: loops.one(H, y0, 1, last(1))  # noqa: E731
    solve: Call = lambda: sympflow.solve(system, method="verlet", t_span=(0.0, H), y0=y0, dt=H, t_eval=[H])  # noqa: E731
    calls = interleaved([one_step, solve], 50 * repeats)
    rows.append(Row("a call of the kernel", 1e6 * calls[0].median, "µs", 20))
    rows.append(Row("a call of solve", 1e6 * calls[1].median, "µs", 100))
    return rows


def start_up_rows() -> list[Row]:
    """The first single run and the first batch of a fresh process."""
    with tempfile.TemporaryDirectory() as folder:
        paths = [str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = os.environ | {"SYMPFLOW_CACHE_DIR": folder, "PYTHONPATH": os.pathsep.join(paths)}
        seconds = [
            float(
                subprocess.run(
                    [sys.executable, "-c", START_UP], env=environment, check=True, capture_output=True
                ).stdout
            )
            for _ in range(4)
        ]
    return [
        Row("first calls of a fresh process, no cache", seconds[0], "s", 15),
        Row("first calls of a fresh process, cached", float(np.median(seconds[1:])), "s", 1.5),
    ]


def flow_rows(repeats: int) -> list[Row]:
    flow, y0 = SympFlow(2, pairs=5), henon_heiles().y0
    loops, batch = flow_loops(henon_heiles(), flow), np.tile(y0, (1000, 1))
    x, t = torch.as_tensor(y0)[None].requires_grad_(), torch.ones(1, dtype=torch.float64)
    n, m = 1000, 20
    calls: list[Call] = [
        lambda: loops.one(1.0, y0, n, last(n)),
        lambda: loops.many(1.0, batch, m, last(m)),
        lambda: autodiff_map(flow, published_value, t, x),
        lambda: flow.psi(1.0, x.detach()),
    ]
    for call in calls:
        call()
    one, many, autodiff, closed_form = (run_time.median for run_time in interleaved(calls, repeats))
    speed_up = n * autodiff / one
    note = f"{1e3 * autodiff:.3g} ms a step; the closed form in eager torch {1e3 * closed_form:.3g} ms"
    return [
        Row("SympFlow, one state", 1e6 * one / n, "µs a step", 4),
        Row("SympFlow, batch of 1000", 1e6 * many / (m * len(batch)), "µs a step, state", 1.5),
        Row("SympFlow against double autodiff in torch", speed_up, "times faster", 500, at_least=True, note=note),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument(
        "--steps", type=int, default=1_000_000, help="of Verlet, one trajectory; a tenth for Kahan–Li 8"
    )
    fragments.add_out(parser)
    options = parser.parse_args()
    found: list[Row] = []
    for rows in (
        splitting_rows(options.repeats, options.steps, max(10, options.steps // 1000)),
        flow_rows(options.repeats),
        start_up_rows(),
    ):
        print(*rows, sep="\n")
        found += rows
    cells = [(r.what, f"{r.measured:.3g} {r.unit}", r.verdict, r.note) for r in found]
    fragments.write(options.out, "kernels", fragments.table(("what", "measured", "limit", "in detail"), cells))


if __name__ == "__main__":
    main()
