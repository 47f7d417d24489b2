"""diffrax: leapfrog as its semi-implicit Euler between two half kicks, and Dormand–Prince 8; both jitted, float64."""

from __future__ import annotations

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from contenders.contender import Contender, Outputs, Scene, Work, whole_steps
from contenders.runge_kutta import first_after

jax.config.update("jax_enable_x64", True)
MAX_STEPS = 60_000


def force(q: jax.Array) -> jax.Array:
    q1, q2 = q
    return jnp.stack([-q1 - 2 * q1 * q2, -q2 - q1 * q1 + q2 * q2])


DRIFT = diffrax.ODETerm(lambda t, p, args: p)
KICK = diffrax.ODETerm(lambda t, q, args: force(q))
FIELD = diffrax.ODETerm(lambda t, y, args: jnp.concatenate([y[2:], force(y[:2])]))


def leapfrog(y0: jax.Array, h: jax.Array, t_end: jax.Array) -> jax.Array:
    """Drift h with p, then kick h: shifting p by half a kick before and after makes it kick–drift–kick Verlet."""
    q, p = y0[:2], y0[2:]
    p = p + 0.5 * h * force(q)
    solution = diffrax.diffeqsolve(
        (DRIFT, KICK), diffrax.SemiImplicitEuler(), 0.0, t_end, h, (q, p), max_steps=None, throw=False
    )
    q, p = solution.ys[0][-1], solution.ys[1][-1]
    return jnp.concatenate([q, p - 0.5 * h * force(q)])


single = jax.jit(leapfrog)
batch = jax.jit(jax.vmap(leapfrog, in_axes=(0, None, None)))


def run_leapfrog(scene: Scene, trajectories: int, dt: float, t_end: float) -> np.ndarray:
    h = t_end / whole_steps(t_end, dt)
    loop = single if trajectories == 1 else batch
    return np.asarray(loop(scene.start(trajectories), h, t_end))


def solve_dopri8(y0: jax.Array, tol: jax.Array, t_end: jax.Array, saveat: diffrax.SaveAt, max_steps: int | None):
    controller = diffrax.PIDController(rtol=tol, atol=tol)
    return diffrax.diffeqsolve(
        FIELD,
        diffrax.Dopri8(),
        0.0,
        t_end,
        1e-2,
        y0,
        stepsize_controller=controller,
        saveat=saveat,
        max_steps=max_steps,
        throw=False,
    )


@jax.jit
def dopri8(y0: jax.Array, tol: jax.Array, t_end: jax.Array) -> jax.Array:
    return solve_dopri8(y0, tol, t_end, diffrax.SaveAt(t1=True), None).ys[-1]


@jax.jit
def dopri8_steps(y0: jax.Array, tol: jax.Array, t_end: jax.Array):
    solution = solve_dopri8(y0, tol, t_end, diffrax.SaveAt(steps=True), MAX_STEPS)
    return solution.ts, solution.ys, solution.stats["num_steps"]


def run_dopri8(scene: Scene, tol: float, t_end: float) -> np.ndarray:
    return np.asarray(dopri8(scene.y0, tol, t_end))


def dopri8_outputs(scene: Scene, tol: float, t_end: float) -> Outputs:
    times, states, n_steps = (np.asarray(x) for x in dopri8_steps(scene.y0, tol, t_end))
    taken = np.isfinite(times)
    at = first_after(times[taken], scene.instants(t_end))
    stages = diffrax.Dopri8().tableau.num_stages - 1  # its last stage is the first of the next step
    return Outputs(states[taken][at], states[taken][-1], Work(int(n_steps), int(n_steps) * stages + 1))


def contenders(scene: Scene) -> list[Contender]:
    rows = [
        Contender(
            "leapfrog, jit" if n == 1 else "leapfrog, jit and vmap",
            "diffrax",
            n,
            "dt",
            partial(run_leapfrog, scene, n),
            same_steps_as="verlet",
        )
        for n in (1, scene.trajectories)
    ]
    rows.append(
        Contender(
            "Dopri8, jit",
            "diffrax",
            1,
            "tol",
            partial(run_dopri8, scene),
            partial(dopri8_outputs, scene),
            guesses={1e-3: 1e-6, 1e-6: 1e-9, 1e-9: 1e-12},
            window=0.7,
        )
    )
    return rows
