"""heyoka: adaptive Taylor series, compiled just in time; one trajectory, or as many as fit a vector register."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import heyoka as hy
import numpy as np
import sympy as sp

from contenders.contender import Contender, Outputs, Scene, Work
from sympflow import HamiltonianSystem

WIDTH = 2 * hy.recommended_simd_size()  # faster here than the recommended width, or than four times it


class Taylor:
    """The Taylor integrators of a vector field [(variable, derivative), …], compiled once for each tolerance."""

    def __init__(self, field: list[tuple[Any, Any]]) -> None:
        self.field, self.size = field, len(field)
        self.scalar, self.lanes = cache(self._scalar), cache(self._lanes)

    @classmethod
    def of_system(cls, system: HamiltonianSystem) -> Taylor:
        """Return the Taylor solver of a symbolic system."""
        symbols = system.symbols
        if symbols is None:
            raise ValueError(f"`system` {system.name!r} has no symbols: leave heyoka out.")
        states = (*symbols.q, *symbols.p)
        variables = hy.make_vars(*[s.name for s in states])
        table = dict(zip(states, variables, strict=True))
        right = [symbols.H.diff(s) for s in symbols.p] + [-symbols.H.diff(s) for s in symbols.q]
        return cls([(x, hy.from_sympy(_binary(f), table)) for x, f in zip(variables, right, strict=True)])

    def _scalar(self, tol: float) -> Any:
        return hy.taylor_adaptive(self.field, np.zeros(self.size), tol=tol)

    def _lanes(self, tol: float) -> Any:
        return hy.taylor_adaptive_batch(self.field, np.zeros((self.size, WIDTH)), tol=tol)

    def _from(self, tol: float, y0: np.ndarray) -> Any:
        integrator = self.scalar(tol)
        integrator.time = 0.0
        integrator.state[:] = y0
        return integrator

    def run(self, tol: float, y0: np.ndarray, t_end: float) -> np.ndarray:
        """The state at t_end from one state."""
        integrator = self._from(tol, y0)
        integrator.propagate_until(t_end)
        return integrator.state.copy()

    def grid(self, tol: float, y0: np.ndarray, times: np.ndarray) -> np.ndarray:
        """The states (n, 2d) at the times, the first of which is 0."""
        return self.steps_and_grid(tol, y0, times)[1]

    def steps_and_grid(self, tol: float, y0: np.ndarray, times: np.ndarray) -> tuple[int, np.ndarray]:
        """The number of steps, and `grid`."""
        *_, n_steps, _, states = self._from(tol, y0).propagate_grid(times)
        return n_steps, states

    def run_lanes(self, tol: float, y0: np.ndarray, t_end: float) -> np.ndarray:
        """The states at t_end from many, WIDTH at a time."""
        integrator = self.lanes(tol)
        columns = whole_lanes(y0).T
        final = np.empty_like(columns)
        for start in range(0, columns.shape[1], WIDTH):
            integrator.set_time(0.0)
            integrator.state[:] = columns[:, start : start + WIDTH]
            integrator.propagate_until(t_end)
            final[:, start : start + WIDTH] = integrator.state
        return final.T[: len(y0)]

    def lanes_grid(self, tol: float, y0: np.ndarray, times: np.ndarray) -> tuple[int, np.ndarray]:
        """The median number of steps, and the states (n, N, 2d) at the times, the first of which is 0."""
        integrator = self.lanes(tol)
        columns, grid = whole_lanes(y0).T, np.repeat(times[:, None], WIDTH, axis=1)
        blocks, steps = [], []
        for start in range(0, columns.shape[1], WIDTH):
            integrator.set_time(0.0)
            integrator.state[:] = columns[:, start : start + WIDTH]
            blocks.append(integrator.propagate_grid(grid)[-1])
            steps += [n for *_, n in integrator.propagate_res]
        return round(float(np.median(steps))), np.concatenate(blocks, axis=2)[:, :, : len(y0)].swapaxes(1, 2)


def _binary(f: sp.Expr) -> sp.Expr:
    """f with floating-point numbers for the fractions that heyoka does not take: those of no power of 2."""
    fractions = {r for r in f.atoms(sp.Rational) if int(r.q) & (int(r.q) - 1)}
    return f.xreplace({r: sp.Float(float(r), precision=53) for r in fractions})


def whole_lanes(y0: np.ndarray) -> np.ndarray:
    """The states, the last one repeated up to a whole number of vectors."""
    return np.concatenate([y0, np.repeat(y0[-1:], -len(y0) % WIDTH, axis=0)])


# Hénon–Heiles, written by hand -----------------------------------------------------------------------------


@cache
def henon_heiles() -> Taylor:
    """The integrators of the scene."""
    q1, q2, p1, p2 = hy.make_vars("q1", "q2", "p1", "p2")
    return Taylor([(q1, p1), (q2, p2), (p1, -q1 - 2 * q1 * q2), (p2, -q2 - q1 * q1 + q2 * q2)])


def run_scalar(scene: Scene, tol: float, t_end: float) -> np.ndarray:
    return henon_heiles().run(tol, scene.y0, t_end)


def run_lanes(scene: Scene, tol: float, t_end: float) -> np.ndarray:
    return henon_heiles().run_lanes(tol, scene.batch, t_end)


def scalar_outputs(scene: Scene, tol: float, t_end: float) -> Outputs:
    n_steps, states = henon_heiles().steps_and_grid(tol, scene.y0, np.append(0.0, scene.instants(t_end)))
    return Outputs(states[1:], states[-1], Work(n_steps, None, None))


def lanes_outputs(scene: Scene, tol: float, t_end: float) -> Outputs:
    sample = scene.sample(scene.trajectories)
    n_steps, states = henon_heiles().lanes_grid(tol, sample, np.append(0.0, scene.instants(t_end)))
    return Outputs(states[1:], states[-1], Work(n_steps, None, None))


def contenders(scene: Scene) -> list[Contender]:
    guesses = {1e-3: 3e-4, 1e-6: 1e-7, 1e-9: 1e-10, 1e-12: 1e-13}
    kinds = [
        ("Taylor, scalar", 1, run_scalar, scalar_outputs),
        (f"Taylor, SIMD batch of {WIDTH}", scene.trajectories, run_lanes, lanes_outputs),
    ]
    return [
        Contender(label, "heyoka", n, "tol", partial(run, scene), partial(outputs, scene), guesses=guesses)
        for label, n, run, outputs in kinds
    ]
