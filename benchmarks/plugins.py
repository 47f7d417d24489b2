"""Cost of a third party's method: Ruth's, as a scheme and written as a step, with and without a batch.

    python benchmarks/plugins.py                      # a table; seconds on one core
    python benchmarks/plugins.py --out docs/measured

The two forms are those of `examples/plugin`: a `Scheme`, which runs compiled by `splitting_method`, and a
`FixedStep` with a `step`, which runs by array operations. Hénon–Heiles, whole calls of `solve` that report the end
only: one trajectory over 2000 steps, and 1000 trajectories over 200. The best of five calls each, in turn, after a
first one that compiles and is not counted. One thread.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

import numpy as np
from measuring import fragments

from sympflow import solve, splitting_method, systems
from sympflow.studies.reports import seconds

sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "plugin" / "src"))
from sympflow_ruth.by_steps import Ruth3BySteps
from sympflow_ruth.schemes import RUTH3

REPEATS = 5


def calls(n_steps: int, trajectories: int) -> tuple[Callable[[], Any], Callable[[], Any]]:
    """The scheme and the step over so many steps, checked to give the same states."""
    system = systems.henon_heiles()
    y0 = system.y0 if trajectories == 1 else system.domain.sample(trajectories, 1)  # type: ignore[union-attr]
    end = 0.05 * n_steps

    def call(method: Any) -> Callable[[], Any]:
        return lambda: solve(system, method, (0.0, end), y0, t_eval=[end])

    scheme, step = call(splitting_method(RUTH3)(dt=0.05)), call(Ruth3BySteps(dt=0.05))
    np.testing.assert_allclose(scheme().y, step().y, rtol=0, atol=1e-9)
    return scheme, step


def best(both: tuple[Callable[[], Any], ...], repeats: int) -> list[float]:
    """The shortest time of each, in turn."""
    found = [float("inf")] * len(both)
    for _ in range(repeats):
        for i, call in enumerate(both):
            start = time.perf_counter()
            call()
            found[i] = min(found[i], time.perf_counter() - start)
    return found


def rows(scale: int = 1, repeats: int = REPEATS) -> list[tuple[str, float, float]]:
    """Label of a run, and the times of the scheme and of the step; with fewer steps by the factor `scale`."""
    found = []
    for n_steps, trajectories in ((2000 // scale, 1), (200 // scale, 1000 // scale)):
        name = f"{trajectories} {'trajectory' if trajectories == 1 else 'trajectories'}, {n_steps} steps"
        found.append((name, *best(calls(n_steps, trajectories), repeats)))
    return found


def table(found: list[tuple[str, float, float]]) -> str:
    """The table of the pages."""
    return fragments.table(
        ("run", "a `Scheme`", "a `FixedStep`", "ratio"),
        [(name, seconds(scheme), seconds(step), f"{step / scheme:.0f}") for name, scheme, step in found],
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    fragments.add_out(parser)
    arguments = parser.parse_args()
    text = table(rows())
    print(text)
    fragments.write(arguments.out, "plugins", text)


if __name__ == "__main__":
    main()
