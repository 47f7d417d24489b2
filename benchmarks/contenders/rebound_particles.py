"""REBOUND: its particles without gravity, in an outer potential whose force is compiled and called from its C loops."""

from __future__ import annotations

import ctypes
from functools import cache, partial
from typing import Any

import numpy as np
import rebound
from numba import carray, cfunc, types
from numba.extending import intrinsic
from rebound.simulation import AFF

from contenders.contender import Contender, Outputs, Scene, Work, whole_steps

PARTICLE = ctypes.sizeof(rebound.Particle) // 8  # x y z vx vy vz ax ay az …
X, V, A = 0, 3, 6
COUNT, PARTICLES = rebound.Simulation.N.offset // 8, rebound.Simulation._particles.offset // 8


@intrinsic
def doubles_at(typing_context, address):
    """A pointer to doubles from an address."""

    def generate(context, builder, signature, arguments):
        return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

    return types.CPointer(types.float64)(address), generate


@cache
def force() -> Any:
    """−∇V of all particles, as a function that REBOUND calls with its simulation."""

    @cfunc(types.void(types.CPointer(types.int64)))
    def add(simulation):
        head = carray(simulation, PARTICLES + 1)
        p = carray(doubles_at(head[PARTICLES]), (head[COUNT], PARTICLE))
        for i in range(head[COUNT]):
            x, y = p[i, X], p[i, X + 1]
            p[i, A] += -x - 2 * x * y
            p[i, A + 1] += -y - x * x + y * y

    return add


def simulation(y0: np.ndarray, integrator: str) -> rebound.Simulation:
    """The states (4,) or (N, 4) as particles."""
    sim = rebound.Simulation()
    sim.integrator = integrator
    sim.gravity = "none"
    for q1, q2, p1, p2 in np.atleast_2d(y0):
        sim.add(m=0, x=q1, y=q2, vx=p1, vy=p2)
    # `sim.additional_forces` would wrap a compiled function into one that Python calls
    sim._additional_forces = AFF(force().address)
    return sim


def states(sim: rebound.Simulation, like: np.ndarray) -> np.ndarray:
    """Positions and velocities in the plane, in the shape of `like`."""
    both = np.zeros((sim.N, 3)), np.zeros((sim.N, 3))
    sim.serialize_particle_data(xyz=both[0], vxvyvz=both[1])
    return np.concatenate([both[0][:, :2], both[1][:, :2]], axis=1).reshape(like.shape)


def leapfrog(y0: np.ndarray, h: float) -> rebound.Simulation:
    sim = simulation(y0, "leapfrog")
    sim.integrator.order = 8
    sim.dt = h
    return sim


def run_leapfrog(scene: Scene, trajectories: int, dt: float, t_end: float) -> np.ndarray:
    n, y0 = whole_steps(t_end, dt), scene.start(trajectories)
    sim = leapfrog(y0, t_end / n)
    sim.steps(n)
    sim.synchronize()
    return states(sim, y0)


def leapfrog_outputs(scene: Scene, trajectories: int, dt: float, t_end: float) -> Outputs:
    n, y0 = whole_steps(t_end, dt), scene.sample(trajectories)
    sim = leapfrog(y0, t_end / n)
    at = np.ceil(scene.instants(t_end) / (t_end / n) - 1e-9).astype(int)
    found = []
    for steps in np.diff(at, prepend=0):
        sim.steps(int(steps))
        sim.synchronize()
        found.append(states(sim, y0))
    return Outputs(np.array(found), found[-1], Work(n, STAGES * n))


STAGES = 17  # forces of a step of order 8


def ias15(y0: np.ndarray, tol: float) -> rebound.Simulation:
    sim = simulation(y0, "ias15")
    sim.integrator.epsilon = tol
    return sim


def run_ias15(scene: Scene, tol: float, t_end: float) -> np.ndarray:
    sim = ias15(scene.y0, tol)
    sim.integrate(t_end)
    return states(sim, scene.y0)


def ias15_outputs(scene: Scene, tol: float, t_end: float) -> Outputs:
    sim = ias15(scene.y0, tol)
    found = []
    for t in scene.instants(t_end):
        sim.integrate(t, exact_finish_time=0)
        found.append(states(sim, scene.y0))
    return Outputs(np.array(found), run_ias15(scene, tol, t_end), Work(sim.steps_done, None))


def contenders(scene: Scene) -> list[Contender]:
    """LEAPFROG alone in the batch: IAS15 takes the steps that the worst of all particles needs."""
    dts, tolerances = {1e-3: 1.35, 1e-6: 0.7, 1e-9: 0.31, 1e-12: 0.13}, {1e-3: 9e-2, 1e-6: 5e-3, 1e-9: 9e-4}
    rows = [
        Contender(
            "LEAPFROG of order 8",
            "REBOUND",
            n,
            "dt",
            partial(run_leapfrog, scene, n),
            partial(leapfrog_outputs, scene, n),
            guesses=dts,
            order=8.0,
            window=0.5,
        )
        for n in (1, scene.trajectories)
    ]
    single = partial(run_ias15, scene), partial(ias15_outputs, scene)
    return [*rows, Contender("IAS15", "REBOUND", 1, "tol", *single, guesses=tolerances, window=0.1)]
