"""Splitting methods on the logarithmic Hamiltonian, in the physical time.

The steps are equal in the new time s; the physical time t is a coordinate of the transformed system, whose value at
the end of a step is what the method makes it. A state at a time that is asked for is a shorter step from the last
state before it, of the length σ that solves t(σ) = t, to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar
from weakref import WeakKeyDictionary

import numpy as np

from sympflow.arguments import check_flag
from sympflow.arrays import Array, is_tensor, to_numpy
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.hamiltonian.time_transformation import (
    checked_shift,
    default_shift,
    lifted,
    projected,
    time_scale,
    time_transformed,
)
from sympflow.integrators.base import FixedStep, Outcome, Problem, Steps
from sympflow.integrators.physical_time import PhysicalRun
from sympflow.integrators.splitting import splitting
from sympflow.integrators.time_search import reach
from sympflow.integrators.timed_pass import timed_pass
from sympflow.schemes import SCHEMES

SCHEME_NAMES = ("leapfrog", "blanes_moan4", "kahan_li8")
_TRANSFORMED: WeakKeyDictionary[HamiltonianSystem, dict[float, HamiltonianSystem]] = WeakKeyDictionary()


@dataclass(frozen=True)
class Logarithmic(FixedStep):
    """Equal steps in s on the logarithmic Hamiltonian (`sympflow.time_transformed`), for close encounters.

    It is symplectic, for the transformed system: in [q, t, p, B], and in [q, p] at a fixed step in s and a fixed B,
    which is how a step is differentiated. The map from a state to that a fixed physical time later is so only up to the
    method's error.

    Parameters
    ----------
    dt : float, optional
        The physical length of a step where the kinetic energy is B = c − E, at the energy E of the system's y0; for
        Newtonian attraction the mean along the orbit. Elsewhere a step is dt·2B/(c − V(q)). Default: `system.dt`.
    shift : float, optional
        c, above the energy; default E + |E|, which is 0 for a bound system. See `sympflow.time_transformed`.
    """

    shift: float | None = None

    symplectic: ClassVar[bool] = True
    compiles: ClassVar[bool] = True
    finds_events: ClassVar[bool] = False  # they are sought on the dense output
    on_grid: ClassVar[bool] = False
    tangent_holds: ClassVar[str] = "the realised step in s, and B,"
    breakdown: ClassVar[tuple[str, str]] = (
        "T + B or c − V ceased to be positive and finite",
        "Reduce `dt`, or raise `shift` above the energy",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shift is not None:
            checked_shift(self.shift)

    def inner(self, system: HamiltonianSystem) -> FixedStep:
        """The method that is applied to the transformed system."""
        raise NotImplementedError

    def transformed(self, system: HamiltonianSystem) -> HamiltonianSystem:
        """The transformed system, made once for each c."""
        c = default_shift(system) if self.shift is None else float(self.shift)
        made = _TRANSFORMED.setdefault(system, {})
        if c not in made:
            made[c] = time_transformed(system, c)
        return made[c]

    def check(self, system: HamiltonianSystem) -> None:
        self.inner(system).check(self.transformed(system))

    def new_step(self, system: HamiltonianSystem) -> float:
        """The step in s."""
        return self.step_length(system) * time_scale(system, self.transformed(system).params["shift"])

    # one step -------------------------------------------------------------------------------------

    def step(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        """One step of the physical length h, with B = c − H(y)."""
        rows, lengths = _rows(y, h)
        c = self.transformed(system).params["shift"]
        return projected(self._reached(system, lifted(system, rows, c), lengths)[0]).reshape(y.shape)

    def inverse(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        rows, lengths = _rows(y, h)
        c = self.transformed(system).params["shift"]
        x, B = rows, c - system.hamiltonian(rows)
        for _ in range(100):  # B belongs to the state that is sought: a contraction, for the step changes H little
            x = projected(self._reached(system, lifted(system, rows, c, B), -lengths)[0])
            before, B = B, c - system.hamiltonian(x)
            if not (np.abs(B - before) > 2 * np.finfo(rows.dtype).eps * (np.abs(B) + np.abs(c - B))).any():
                break
        return x.reshape(y.shape)

    def tangent(self, system: HamiltonianSystem, t: float, y: Array, h: Array) -> tuple[np.ndarray, np.ndarray]:
        """The step and its Jacobian in [q, p], the realised step in s and B held fixed."""
        rows, lengths = _rows(to_numpy(y), h)
        transformed = self.transformed(system)
        start = lifted(system, rows, transformed.params["shift"])
        end, sigma = self._reached(system, start, lengths)
        _, A = self.inner(system).tangent(transformed, 0.0, start, sigma)
        d = system.ndof
        keep = np.r_[0:d, d + 1 : 2 * d + 1]
        return projected(end).reshape(y.shape), A[:, keep][:, :, keep].reshape(*y.shape, 2 * d)

    def _reached(self, system: HamiltonianSystem, start: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The states a physical time h after `start` by one step each, and its length σ in s."""
        transformed, inner = self.transformed(system), self.inner(system)

        def step(sigma: np.ndarray) -> np.ndarray:
            return np.asarray(inner.step(transformed, 0.0, start, sigma))

        d = system.ndof
        with np.errstate(all="ignore"):
            speed = transformed.params["shift"] - to_numpy(system.potential(start[:, :d]))
            longest = h * speed
            for _ in range(60):  # a length beyond the one that is sought
                short = (step(longest)[:, d] - h) * np.sign(h) < 0
                if not short.any():
                    break
                longest = np.where(short, 2 * longest, longest)
            return reach(step, start, longest, h, h * speed)

    # a run ----------------------------------------------------------------------------------------

    def run(self, problem: Problem) -> Outcome:
        if is_tensor(problem.y0):
            raise TypeError(
                f"`y0` is a tensor, but method {self.name!r} finds its outputs by root-finding on NumPy arrays: pass "
                "y0.numpy(), or solve time_transformed(system), which takes tensors."
            )
        return timed_pass(self, problem) or PhysicalRun(self, problem).outcome()

    def reach_times(
        self,
        transformed: HamiltonianSystem,
        h: float,
        start: np.ndarray,
        times: np.ndarray,
        stride: int,
        expected: float,
        backend: str,
    ) -> Any:
        """`kernels.timed.reach_times` of the method; None where it has no such loops."""
        found = getattr(self.inner(transformed), "reach_times", None)
        return None if found is None else found(transformed, h, start, times, stride, expected, backend)

    def compiled_evaluations(self, system: HamiltonianSystem, n_steps: int, n_extra: int) -> dict[str, int]:
        """Evaluations of the forces in `reach_times`, n_extra of whose steps were shorter ones."""
        return self.inner(system).evaluations(n_steps, n_steps, n_extra, "compiled")

    def steps(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array) -> Steps:
        """The steps of the run, their physical lengths; in a batch one that has ended waits with length 0."""
        run = PhysicalRun(self, Problem(system, *t_span, y0))
        sign, batch = run.sign, y0.shape[:-1]
        for states, last in run.chunks():
            t = run.sign * states[..., system.ndof]
            t = np.minimum(t, abs(t_span[1] - t_span[0]))
            n = int(last.max())
            index = np.minimum(np.arange(n + 1), last[:, None])
            t, x = np.take_along_axis(t, index, 1), np.take_along_axis(states, index[..., None], 1)
            shape = (n, *batch)
            y = projected(x[:, :-1]).swapaxes(0, 1).reshape(*shape, -1)
            yield t_span[0] + sign * t[:, :-1].T.reshape(shape), y, sign * np.diff(t, axis=1).T.reshape(shape)


def _rows(y: Array, h: Any) -> tuple[np.ndarray, np.ndarray]:
    """States as rows, and a length for each."""
    if is_tensor(y):
        raise TypeError("`y` is a tensor: the logarithmic methods step NumPy arrays; pass y.numpy().")
    rows = np.asarray(y).reshape(-1, y.shape[-1])
    return rows, np.broadcast_to(np.asarray(h, dtype=rows.dtype), y.shape[:-1]).reshape(-1)


@dataclass(frozen=True)
class LogSplitting(Logarithmic):
    """A splitting scheme on the logarithmic Hamiltonian.

    Parameters
    ----------
    dt, shift
        As for `Logarithmic`.
    compensated : bool
        Whether to sum with Kahan's compensation. Compiled only.

    References
    ----------
    .. [1] S. Mikkola, K. Tanikawa, Celest. Mech. Dyn. Astron. 74 (1999) 287–295.
    .. [2] M. Preto, S. Tremaine, Astron. J. 118 (1999) 2532–2541.
    """

    compensated: bool = False

    scheme_name: ClassVar[str]

    def __post_init__(self) -> None:
        super().__post_init__()
        check_flag("compensated", self.compensated)

    def inner(self, system: HamiltonianSystem) -> FixedStep:
        return _inner(self.scheme_name, bool(self.compensated))


@cache
def _inner(scheme_name: str, compensated: bool) -> FixedStep:
    return splitting(scheme_name)(compensated=compensated)


@cache
def log_splitting(name: str) -> type[LogSplitting]:
    """The integrator class "log_<scheme>"."""
    scheme = SCHEMES[name.removeprefix("log_")]
    namespace = {
        "name": name,
        "order": scheme.order,
        "scheme_name": scheme.name,
        "__doc__": f"{name}: {scheme.name} on the logarithmic Hamiltonian, order {scheme.order}; Mikkola and Tanikawa "
        f"(1999), Preto and Tremaine (1999).\n\n{LogSplitting.__doc__}",
        "__module__": __name__,
    }
    return dataclass(frozen=True)(type(name, (LogSplitting,), namespace))


def __getattr__(name: str) -> type[LogSplitting]:
    """The integrator classes as attributes of the module, where pickle looks for them."""
    if name.startswith("log_") and name.removeprefix("log_") in SCHEME_NAMES:
        return log_splitting(name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
