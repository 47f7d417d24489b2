"""The targets of the comparison, each with what was measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from contenders.measurement import Results, Row

LEVEL = 1.05
"""A ratio of run times up to which two methods count as level: the scatter of the medians."""


@dataclass(frozen=True)
class Goal:
    """A ratio, its limit, and the side of the limit that it should be on. The ratio is None if a peer is missing."""

    text: str
    ratio: float | None
    limit: float
    at_least: bool = False

    @property
    def verdict(self) -> str:
        if self.ratio is None:
            return "not measured"
        return "pass" if (self.ratio >= self.limit if self.at_least else self.ratio <= self.limit) else "miss"


def goals(results: Results) -> list[Goal]:
    batch = max((row.trajectories for row in results.rows), default=1)
    found = []
    for n, limit in ((1, 1.2), (batch, 1.3)):
        for method, name in (("verlet", "Verlet"), ("kahan_li8", "Kahan–Li 8")):
            ratio = results.step_seconds[f"{method} {n} sympflow"] / results.step_seconds[f"{method} {n} hand-written"]
            steps = "one trajectory, 1e6 steps" if n == 1 else f"batch of {n}"
            found.append(Goal(f"{name} through `solve` against the hand-written loop, {steps}", ratio, limit))
    for package in ("diffrax", "NumPy", "torch"):
        for n in (1, batch):
            kind = "one trajectory" if n == 1 else f"batch of {n}"
            text = f"verlet against the same scheme in {package}, {kind}, the worst of the targets"
            found.append(Goal(text, worst_ratio(results, package, n), LEVEL))
    ours = find(results, lambda r: r.label == "kahan_li8" and r.trajectories == batch and r.target == 1e-6)
    theirs = find(results, lambda r: r.package == "heyoka" and r.trajectories == batch and r.target == 1e-6)
    times_faster = theirs.seconds / ours.seconds if ours and theirs else None
    text = f"heyoka's SIMD batch against kahan_li8, batch of {batch}, energy error 1e-6"
    return [*found, Goal(text, times_faster, 5.0, at_least=True)]


def worst_ratio(results: Results, package: str, trajectories: int) -> float | None:
    """The largest of our Verlet's time over the package's, over the targets that both have."""
    mine = {r.target: r.seconds for r in results.rows if r.label == "verlet" and r.trajectories == trajectories}
    theirs = {
        r.target: r.seconds
        for r in results.rows
        if r.package == package and r.control == "dt" and r.trajectories == trajectories
    }
    return max((mine[t] / theirs[t] for t in mine.keys() & theirs.keys()), default=None)


def find(results: Results, matches: Callable[[Row], bool]) -> Row | None:
    return next((row for row in results.rows if matches(row)), None)
