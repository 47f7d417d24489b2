"""One run of the whole comparison: first calls, calibration, interleaved timing, and the targets set for it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from contenders import loops, ours
from contenders.contender import Contender, Scene, Skipped, Work
from sympflow.studies.attempts import interleaved

SHORT = 0.1  # part of the interval over which a `short` calibration runs
PROBE = 0.01  # part of the interval that a run's duration is estimated from
LEAST_PART = {
    "dt": 0.001,
    "flow": 0.001,
    "tol": 0.05,
}  # adaptive steps differ along the orbit, so their average needs more of it
AGREEMENT = 1e-10  # of two implementations of one scheme, over a short run: far above rounding, far below any error


@dataclass(frozen=True)
class Row:
    """One method at one target. Times are seconds for a trajectory over the whole interval."""

    label: str
    package: str
    trajectories: int
    target: float
    control: str
    value: float
    energy_error: float
    state_error: float | None
    steps: int
    force_evaluations: int | None
    hessian_evaluations: int | None
    seconds: float
    spread: float
    part: float


@dataclass
class Results:
    """Everything that the page says."""

    rows: list[Row] = field(default_factory=list)
    step_seconds: dict[str, float] = field(default_factory=dict)
    skipped: list[Skipped] = field(default_factory=list)
    unreached: list[tuple[str, str, int, float]] = field(default_factory=list)
    environment: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> Results:
        return cls(
            [Row(**row) for row in content["rows"]],
            content["step_seconds"],
            [Skipped(**skip) for skip in content["skipped"]],
            [tuple(entry) for entry in content["unreached"]],
            content["environment"],
        )


# the step or tolerance that reaches an energy error ------------------------------------------------


@dataclass(frozen=True)
class Judged:
    """A method at one setting of its step or tolerance."""

    control: float
    energy_error: float
    state_error: float | None
    work: Work


def largest_control(
    judge: Callable[[float], Judged], target: float, guess: float, order: float, window: float, attempts: int = 14
) -> Judged | None:
    """The largest step or tolerance whose energy error meets the target, by bracketing on the logarithms.

    The next trial is where the error would be just below the target if it went as control^order; once there is a
    bracket, a trial outside it is replaced by its geometric middle. None if no trial met the target.
    """
    best: Judged | None = None
    low, high = 0.0, math.inf  # the largest control known to meet the target, the smallest known not to
    control = guess
    for _ in range(attempts):
        trial = judge(control)
        if trial.energy_error <= target:
            if best is None or control > best.control:
                best, low = trial, control
            if trial.energy_error >= window * target:
                break
        else:
            high = min(high, control)
        if low >= high or high / max(low, 1e-300) < 1.005:
            break
        excess = trial.energy_error / (math.sqrt(window) * target)
        factor = 0.5 if not math.isfinite(excess) else float(np.clip(excess ** (-1 / order), 1 / 16, 16))
        control *= factor
        if not low < control < high:
            control = math.sqrt(low * high)
    return best


def calibrate(scene: Scene, contender: Contender, target: float) -> Judged | None:
    """`largest_control` of a contender; errors are those at the end of the whole interval."""
    assert contender.outputs is not None
    outputs, n = contender.outputs, contender.trajectories
    short = target in contender.short
    part = SHORT if short else 1.0

    def judge(control: float) -> Judged:
        result = outputs(control, part * scene.t_end)
        energy_error = scene.energy_error(result.states, scene.sample(n)) / part
        state_error = None if short else scene.state_error(result.final, n)
        work = result.work
        if short:
            forces = work.force_evaluations
            work = replace(
                work, steps=round(work.steps / part), force_evaluations=None if forces is None else round(forces / part)
            )
        return Judged(control, energy_error, state_error, work)

    if contender.choices:
        good = [found for found in map(judge, contender.choices) if found.energy_error <= target]
        runs = {found: partial(contender.run, found.control, scene.t_end) for found in good}
        return min(good, key=lambda found: min(seconds_of(runs[found]) for _ in range(5)), default=None)
    return largest_control(judge, target, contender.guesses[target], contender.order, contender.window)


# timing --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Timed:
    """A call, and what its duration is multiplied by."""

    call: Callable[[], object]
    scale: float
    part: float = 1.0


def seconds_of(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def prepare(scene: Scene, contender: Contender, control: float, cap: float) -> Timed:
    """A call of about 10 ms or more: a short run several times, a very long one over a part of the interval."""
    probe = min(seconds_of(partial(contender.run, control, PROBE * scene.t_end)) for _ in range(3)) / PROBE
    part = min(1.0, max(cap / probe, LEAST_PART[contender.control]))
    if probe < 2 * cap:
        probe = min(seconds_of(partial(contender.run, control, scene.t_end)) for _ in range(2))
        part = min(1.0, cap / probe)
    calls = max(1, round(0.01 / probe))

    def call() -> None:
        for _ in range(calls):
            contender.run(control, part * scene.t_end)

    return Timed(call, 1.0 / (part * calls * contender.trajectories), part)


def measure(
    scene: Scene,
    contenders: Sequence[Contender],
    targets: Sequence[float],
    repeats: int = 7,
    cap: float = 0.3,
    step_counts: tuple[int, int] = (1_000_000, 20_000),
    note: Callable[[str], None] = print,
) -> Results:
    """Calibrate and time every contender at every target that it has a guess for.

    Parameters
    ----------
    cap : float
        Seconds above which a run is timed over a part of the interval only.
    step_counts : (int, int)
        Over how many steps our loops and the hand-written ones are compared: of one trajectory, of the batch.
    note : callable
        Told what is going on.
    """
    results = Results()
    steppers = {(c.label, c.trajectories): c for c in contenders if c.outputs}
    for contender in contenders:
        leader = steppers[contender.same_steps_as or contender.label, contender.trajectories]
        control = (leader.choices or [leader.guesses[max(leader.guesses)]])[0]
        contender.run(control, PROBE * scene.t_end)  # compiles, before anything is timed
        if contender.same_steps_as:
            check_agreement(scene, contender, leader, control)

    found: dict[tuple[str, int, float], Judged] = {}
    plan: list[tuple[Contender, float, Judged]] = []
    for contender in sorted(contenders, key=lambda c: c.outputs is None):  # leaders before those that follow them
        for target in targets:
            key = (contender.same_steps_as or contender.label, contender.trajectories, target)
            if contender.outputs and target in contender.guesses:
                start = time.perf_counter()
                judged = calibrate(scene, contender, target)
                note(f"{contender.package} {contender.label} {target:g}: {judged} {time.perf_counter() - start:.1f} s")
                if judged is None:
                    results.unreached.append((contender.label, contender.package, contender.trajectories, target))
                else:
                    found[key] = judged
            if key in found:
                plan.append((contender, target, found[key]))

    timed = [prepare(scene, contender, judged.control, cap) for contender, _, judged in plan]
    steps = step_loops(scene, step_counts)
    note(f"timing {len(timed)} runs, {repeats} rounds")
    times = interleaved([t.call for t in timed], repeats)
    step_times = interleaved([t.call for t in steps.values()], 3 * repeats)
    for (contender, target, judged), t, run_time in zip(plan, timed, times, strict=True):
        results.rows.append(
            Row(
                contender.label,
                contender.package,
                contender.trajectories,
                target,
                contender.control,
                judged.control,
                judged.energy_error,
                judged.state_error,
                judged.work.steps,
                judged.work.force_evaluations,
                judged.work.hessian_evaluations,
                run_time.median * t.scale,
                run_time.spread * t.scale,
                t.part,
            )
        )
    for (name, t), run_time in zip(steps.items(), step_times, strict=True):
        results.step_seconds[name] = run_time.median * t.scale
    return results


def check_agreement(scene: Scene, contender: Contender, leader: Contender, dt: float) -> None:
    """True of a loop that takes the very steps of the method that it is compared with."""
    t_end = PROBE * scene.t_end
    difference = np.abs(np.asarray(contender.run(dt, t_end)) - np.asarray(leader.run(dt, t_end))).max()
    if not difference < AGREEMENT:
        raise RuntimeError(f"{contender.package} {contender.label} differs from {leader.label} by {difference:.1e}.")


def step_loops(scene: Scene, counts: tuple[int, int], dt: float = 0.01) -> dict[str, Timed]:
    """Verlet and Kahan–Li 8 of equal step, ours and hand-written; scaled to seconds a step and trajectory."""
    by_name = {"verlet": loops.run_verlet, "kahan_li8": loops.run_kahan_li8}
    timed = {}
    for n, count in zip((1, scene.trajectories), counts, strict=True):
        for method, loop in by_name.items():
            t_end, scale = count * dt, 1.0 / (count * n)
            by_hand = partial(loop, scene, n, dt, t_end)
            mine = partial(ours.run, scene, method, n, dt, t_end)
            by_hand(), mine()
            timed[f"{method} {n} hand-written"] = Timed(by_hand, scale)
            timed[f"{method} {n} sympflow"] = Timed(mine, scale)
    return timed


# targets -------------------------------------------------------------------------------------------

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
