"""desolver: two splitting schemes of Nielsen that step in NumPy; every step is kept."""

from __future__ import annotations

from functools import partial
from typing import Any

import desolver
import numpy as np

from contenders.contender import Contender, Outputs, Scene, Work, whole_steps
from contenders.runge_kutta import first_after

METHODS = {"ABAs5o6H": ("ABAS5O6H", 11), "BABs9o7H": ("BABS9O7H", 19)}
"""The package's names, and the calls of the right-hand side in a step."""


def rhs(t: float, y: np.ndarray) -> np.ndarray:
    q1, q2, p1, p2 = y
    return np.array([p1, p2, -q1 - 2 * q1 * q2, -q2 - q1 * q1 + q2 * q2])


def run(scene: Scene, method: str, dt: float, t_end: float) -> Any:
    h = t_end / whole_steps(t_end, dt)
    system = desolver.OdeSystem(rhs, scene.y0, t=(0.0, t_end), dt=h)
    system.method = METHODS[method][0]
    system.integrate()
    return system.y[-1]


def outputs(scene: Scene, method: str, dt: float, t_end: float) -> Outputs:
    h = t_end / whole_steps(t_end, dt)
    system = desolver.OdeSystem(rhs, scene.y0, t=(0.0, t_end), dt=h)
    system.method = METHODS[method][0]
    system.integrate()
    n = len(system.t) - 1
    return Outputs(
        system.y[first_after(system.t, scene.instants(t_end))], system.y[-1], Work(n, n * METHODS[method][1])
    )


def contenders(scene: Scene) -> list[Contender]:
    guesses = {"ABAs5o6H": {1e-3: 0.75, 1e-6: 0.145}, "BABs9o7H": {1e-3: 1.8, 1e-6: 0.82, 1e-9: 0.28}}
    return [
        Contender(
            method,
            "desolver",
            1,
            "dt",
            partial(run, scene, method),
            partial(outputs, scene, method),
            guesses=guesses[method],
            order=4.0,
            window=0.4,
        )
        for method in guesses
    ]
