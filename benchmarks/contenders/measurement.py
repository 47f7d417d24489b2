"""One run of the whole comparison: first calls, calibration, and interleaved timing."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import numpy as np

from contenders import compiled_loops, ours
from contenders.calibration import Judged, calibrate
from contenders.contender import Contender, Skipped
from contenders.scene import Scene
from sympflow.studies.attempts import interleaved

PROBE = 0.01  # part of the interval that a run's duration is estimated from
LEAST_PART = {"dt": 0.001, "tol": 0.05}  # adaptive steps differ along the orbit, so their average needs more of it
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


@dataclass(frozen=True)
class FirstCall:
    """Seconds that the first call of a method took beyond the second: compiling, loading, building."""

    label: str
    package: str
    trajectories: int
    seconds: float


@dataclass
class Results:
    """Everything that the page says."""

    rows: list[Row] = field(default_factory=list)
    first_calls: list[FirstCall] = field(default_factory=list)
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
            [FirstCall(**call) for call in content["first_calls"]],
            content["step_seconds"],
            [Skipped(**skip) for skip in content["skipped"]],
            [tuple(entry) for entry in content["unreached"]],
            content["environment"],
        )


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
        control = leader.guesses[max(leader.guesses)]
        first, second = (seconds_of(partial(contender.run, control, PROBE * scene.t_end)) for _ in range(2))
        results.first_calls.append(
            FirstCall(contender.label, contender.package, contender.trajectories, first - second)
        )
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
    """Whether a loop takes the very steps of the method that it is compared with."""
    t_end = PROBE * scene.t_end
    difference = np.abs(np.asarray(contender.run(dt, t_end)) - np.asarray(leader.run(dt, t_end))).max()
    if not difference < AGREEMENT:
        raise RuntimeError(f"{contender.package} {contender.label} differs from {leader.label} by {difference:.1e}.")


def step_loops(scene: Scene, counts: tuple[int, int], dt: float = 0.01) -> dict[str, Timed]:
    """Verlet and Kahan–Li 8 of equal step, ours and hand-written; scaled to seconds a step and trajectory."""
    loops = {"verlet": compiled_loops.run_verlet, "kahan_li8": compiled_loops.run_kahan_li8}
    timed = {}
    for n, count in zip((1, scene.trajectories), counts, strict=True):
        for method, loop in loops.items():
            t_end, scale = count * dt, 1.0 / (count * n)
            by_hand = partial(loop, scene, n, dt, t_end)
            mine = partial(ours.run, scene, method, n, dt, t_end)
            by_hand(), mine()
            timed[f"{method} {n} hand-written"] = Timed(by_hand, scale)
            timed[f"{method} {n} sympflow"] = Timed(mine, scale)
    return timed
