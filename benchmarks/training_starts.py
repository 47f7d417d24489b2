"""Starts of the search for a primed flow, in a second: as they are, and beside an older commit on the same machine.

    git worktree add ../before 23c1e20
    python benchmarks/training_starts.py --before ../before

A start is a random table at Δt, followed by at most 60 Gauss–Newton iterations on the labels that `train` makes by
default. The time is that of the processor, on one thread, without labels and compilation; the two commits take turns,
and the least of the rounds counts. Both find the same minima: the median cost of the starts is shown.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

from measuring import fragments
from own_systems import SYSTEMS

from sympflow.training.fits import PrimedFit
from sympflow.training.session import Session
from sympflow.training.starts import scaling_of
from sympflow.training.table_fit import SEARCH_STEPS, TableRun

STEPS = {"duffing": 0.6, "morse": 0.5, "mass": 0.6, "singular": 0.12, "three": 0.5}


def measured(name: str, curvature: bool, starts: int) -> dict[str, float]:
    """Seconds and iterations of so many starts, and their median cost."""
    system = SYSTEMS[name]
    assert system.domain is not None
    flow = PrimedFit(STEPS[name], curvature=curvature).flow(system)
    scaling = scaling_of(system.domain, flow.dt, 0)
    made = getattr(TableRun, "start", TableRun)  # the constructor of older commits
    run = made(flow, system, system.domain, scaling, PrimedFit(reference_states=5))
    fit, deadline = run.frozen, Session().deadline
    assert fit is not None
    fit.minimize(run.start_of(0), 2, deadline)  # what is compiled
    begin = time.process_time()
    minima = [fit.minimize(run.start_of(k), SEARCH_STEPS, deadline) for k in range(1, 1 + starts)]
    seconds = time.process_time() - begin
    iterations = sum(m.iterations for m in minima)
    return {"seconds": seconds, "iterations": iterations, "cost": statistics.median(m.cost for m in minima)}


def in_tree(tree: Path, arguments: list[str]) -> dict[str, Any]:
    """The rows of this script with the package of a working tree."""
    command = [sys.executable, __file__, "--rows", *arguments]
    environment = os.environ | {"PYTHONPATH": str(tree.resolve())}
    return json.loads(subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout)


def main(given: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("systems", nargs="*", metavar="system", help=f"of {', '.join(SYSTEMS)}")
    parser.add_argument("--before", type=Path, help="a working tree of an older commit")
    parser.add_argument("--starts", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--quick", action="store_true", help="does it run?")
    parser.add_argument("--rows", action="store_true", help="print the measured numbers of this tree as JSON")
    fragments.add_out(parser)
    options = parser.parse_args(given)
    unknown = set(options.systems) - set(SYSTEMS)
    if unknown:
        parser.error(f"no system {', '.join(sorted(unknown))}: choose of {', '.join(SYSTEMS)}")
    if options.before is not None and not (options.before / "sympflow" / "__init__.py").is_file():
        parser.error(f"--before {options.before} has no package: git worktree add {options.before} 23c1e20")
    names = options.systems or (["duffing"] if options.quick else [*SYSTEMS])
    starts = 1 if options.quick else options.starts
    cases = [(name, curvature) for name in names for curvature in (False, True)]
    if options.rows:
        print(json.dumps({f"{name} {curvature}": measured(name, curvature, starts) for name, curvature in cases}))
        return
    trees = {"now": Path(__file__).parents[1]} | ({} if options.before is None else {"before": options.before})
    rounds = 1 if options.quick else options.rounds
    found = [
        {label: in_tree(tree, [*names, "--starts", str(starts)]) for label, tree in trees.items()}
        for _ in range(rounds)
    ]
    rows = []
    for name, curvature in cases:
        case = f"{name} {curvature}"
        least = {label: min((each[label][case] for each in found), key=lambda row: row["seconds"]) for label in trees}
        now, before = least["now"], least.get("before")
        rows.append(
            (
                name,
                "yes" if curvature else "no",
                "" if before is None else f"{starts / before['seconds']:.2f}",
                f"{starts / now['seconds']:.1f}",
                "" if before is None else f"{before['seconds'] / now['seconds']:.0f}",
                f"{1e6 * now['seconds'] / now['iterations']:.0f}",
                "" if before is None else f"{before['cost']:.1e}",
                f"{now['cost']:.1e}",
            )
        )
    titles = (
        *("system", "curvature terms", "starts a second before", "now", "times as many"),
        *("µs an iteration now", "median cost before", "now"),
    )
    print(fragments.table(titles, rows))
    fragments.write(options.out, "training-starts", fragments.table(titles, rows))


if __name__ == "__main__":
    main()
