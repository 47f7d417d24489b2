"""sympflow's splitting methods and shipped flows, through `solve`: all that a user's call costs is in the time."""

from __future__ import annotations

import math
from functools import cache, partial

import numpy as np

import sympflow
from contenders.contender import Contender, Outputs, Scene, Work, whole_steps
from sympflow.flow.primed import PrimedFlow
from sympflow.schemes import SCHEMES

GUESSES = {  # method: steps for energy errors of 1e-3, 1e-6, 1e-9 and 1e-12 over T = 1000
    "verlet": (12_500, 395_000, 12_500_000),
    "suzuki4": (1_900, 10_500, 58_700),
    "srkn6b": (950, 2_300, 12_000),
    "kahan_li6": (1_210, 3_650, 11_500, 36_000),
    "srkn11b": (700, 1_230, 3_100, 9_800),
    "srkn14a": (700, 1_200, 2_500, 7_900),
    "kahan_li8": (690, 1_360, 3_150, 7_500),
}
TARGETS = (1e-3, 1e-6, 1e-9, 1e-12)


def run(scene: Scene, method: str, trajectories: int, dt: float, t_end: float) -> np.ndarray:
    """The state at t_end, in a whole number of steps."""
    h = t_end / whole_steps(t_end, dt)
    y0 = scene.start(trajectories)
    return sympflow.solve(scene.system, method, (0.0, t_end), y0, dt=h, t_eval=[t_end]).y[..., 0]


def outputs(scene: Scene, method: str, trajectories: int, dt: float, t_end: float) -> Outputs:
    n = whole_steps(t_end, dt)
    times, y0 = scene.instants(t_end), scene.sample(trajectories)
    sol = sympflow.solve(scene.system, method, (0.0, t_end), y0, dt=t_end / n, t_eval=times)
    states = np.full((len(times), *y0.shape), np.nan)
    states[: len(sol.t)] = np.moveaxis(sol.y, -1, 0)
    scheme = SCHEMES[method]
    return Outputs(states, states[-1], Work(n, n * scheme.force_evaluations, n * scheme.hessian_evaluations))


FLOW = "trained flow"


@cache
def ladder(scene: Scene) -> dict[float, PrimedFlow]:
    """The primed flows that ship, by their Δt."""
    loaded = (entry.load(scene.system) for entry in sympflow.shipped_flows(scene.system))
    return {flow.dt: flow for flow in loaded if isinstance(flow, PrimedFlow)}


def run_flow(scene: Scene, trajectories: int, dt: float, t_end: float) -> np.ndarray:
    """The state at t_end, in steps of the flow's own Δt."""
    flow, y0 = ladder(scene)[dt], scene.start(trajectories)
    return sympflow.solve(scene.system, flow, (0.0, t_end), y0, t_eval=[t_end]).y[..., 0]


def flow_outputs(scene: Scene, trajectories: int, dt: float, t_end: float) -> Outputs:
    flow, y0, times = ladder(scene)[dt], scene.sample(trajectories), scene.instants(t_end)
    sol = sympflow.solve(scene.system, flow, (0.0, t_end), y0, t_eval=times)
    alone = sympflow.solve(scene.system, flow, (0.0, t_end), scene.y0, t_eval=[t_end]).stats
    n = round(t_end / dt)
    kernel = flow.kernel_scheme()
    work = Work(n, alone["force_evaluations"], n * kernel.hessian_evaluations)
    return Outputs(np.moveaxis(sol.y, -1, 0), sol.y[..., -1], work)


def contenders(scene: Scene) -> list[Contender]:
    """Schemes, and the ladder of flows as one method, whose setting is the flow."""
    flows = [
        Contender(
            FLOW,
            "sympflow",
            n,
            "flow",
            partial(run_flow, scene, n),
            partial(flow_outputs, scene, n),
            guesses=dict.fromkeys(TARGETS, math.nan),
            choices=tuple(ladder(scene)),
        )
        for n in (1, scene.trajectories)
    ]
    return flows + [
        Contender(
            method,
            "sympflow",
            n,
            "dt",
            partial(run, scene, method, n),
            partial(outputs, scene, method, n),
            guesses={target: 1000.0 / steps for target, steps in zip(TARGETS, GUESSES[method], strict=False)},
            order=SCHEMES[method].order or 1,
            window=0.97,
        )
        for n in (1, scene.trajectories)
        for method in GUESSES
    ]
