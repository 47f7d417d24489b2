"""Reference solutions, each with an estimate of its own error."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field

import numpy as np

from sympflow.arrays import to_numpy
from sympflow.hamiltonian.scales import distance, smallest_size, started
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.solver import solve

_HALVINGS = 7
_ROUNDING = 1e-14
_USELESS = 1e-2


@dataclass(frozen=True)
class Reference:
    """States to measure errors against.

    Attributes
    ----------
    t : ndarray (n,)
    y : ndarray (..., 2d, n)
    method : str
        In words.
    accuracy : float or None
        Estimate of the largest `reference_error`, in units of q; of a batch the median over its trajectories. None
        if it is unknown.
    """

    t: np.ndarray
    y: np.ndarray = field(repr=False)
    method: str
    accuracy: float | None

    def described(self) -> str:
        """The method and its accuracy in words."""
        known = "of unknown accuracy" if self.accuracy is None else f"good to {self.accuracy:.1e}"
        return f"{self.method}, {known}"

    def summary(self) -> dict[str, str | float | None]:
        """The method and its accuracy, as reports hold them."""
        return {"method": self.method, "accuracy": self.accuracy}


def reference(
    system: HamiltonianSystem, t_span: tuple[float, float], y0: np.ndarray, t: np.ndarray, target: float = 0.0
) -> Reference:
    """The solution from y0 (..., 2d) at the times t (n,), as accurately as is cheap.

    A quadratic H is solved exactly. A separable one by Kahan–Li 8 with a step that is halved until the last two runs
    agree to `target`, or to rounding, or no better than the two before, in comparable units of q and p; their
    difference is the accuracy. Any other by DOP853 at rtol 1e-13, whose accuracy is the difference from a run at 1e-12;
    so is one with friction, or driven.

    Parameters
    ----------
    target : float
        Accuracy that is enough.
    """
    y0 = to_numpy(y0).astype(float)
    system = started(system, y0)
    if not system.keeps_energy:
        return _dop853(system, t_span, y0, t, target)
    exact = _linear_flow(system, t - t_span[0], y0)
    if exact is not None:
        upper, lower = np.split(np.asarray(system.hessian(np.zeros(2 * system.ndof))), 2)
        rates = np.abs(np.linalg.eigvals(np.concatenate([lower, -upper])))
        phase = np.abs(t - t_span[0]).max(initial=0.0) * rates.max()
        size = distance(system, exact, axis=-2).max(initial=0.0)
        return Reference(t, exact, "exact (linear flow)", float(np.finfo(float).eps * size * (4 + phase)))
    run = _kahan_li if system.separable else _dop853
    return run(system, t_span, y0, t, target)


def _kahan_li(
    system: HamiltonianSystem, t_span: tuple[float, float], y0: np.ndarray, t: np.ndarray, target: float
) -> Reference:
    dt = 4 * system.dt
    previous, best, apart = None, None, math.inf
    for _ in range(_HALVINGS):
        with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # of steps that are too long at first
            sol = solve(system, "kahan_li8", t_span, y0, t_eval=t, dt=dt)
        y = to_numpy(sol.y) if sol.y.shape[-1] == len(t) else None
        if y is not None and previous is not None:
            size = distance(system, np.where(np.isfinite(y), y, 0.0), axis=-2).max(initial=0.0)
            before = apart
            apart = _distance(system, y - previous) / (float(size) or 1.0)
            if best is not None and not apart < before:
                apart = before
                break
            best = Reference(t, y, f"Kahan–Li 8, dt = {dt:.3g}", accuracy := _distance(system, y - previous))
            if accuracy <= target or apart <= _ROUNDING:
                break
        previous = y
        dt /= 2
    if best is None or not apart < _USELESS:
        raise ValueError(
            f"`t_span` reaches beyond where {system.name!r} can be solved from `y0` (a singularity or chaos), and "
            "no reference converges there. End it earlier, or pass your own `reference`."
        )
    return best


def _dop853(
    system: HamiltonianSystem, t_span: tuple[float, float], y0: np.ndarray, t: np.ndarray, target: float
) -> Reference:
    smallest = smallest_size(system, y0)
    fine, coarse = (
        solve(system, "dop853", t_span, y0, t_eval=t, rtol=rtol, atol=rtol * smallest).raise_for_status()
        for rtol in (1e-13, 1e-12)
    )
    y = to_numpy(fine.y)
    return Reference(t, y, "DOP853, rtol = 1e-13", _distance(system, y - to_numpy(coarse.y)))


def _distance(system: HamiltonianSystem, change: np.ndarray) -> float:
    """The largest `distance` over time, inf where it is NaN; the median over a batch."""
    with np.errstate(all="ignore"):
        largest = distance(system, change, axis=-2).max(axis=-1, initial=0.0)
    return float(np.median(np.where(np.isnan(largest), np.inf, largest)))


def _linear_flow(system: HamiltonianSystem, t: np.ndarray, y0: np.ndarray) -> np.ndarray | None:
    """The exact solution for H = ½ xᵀSx with S positive definite, which symbols tell; else None.

    With S = LLᵀ the variables z = Lᵀx rotate, z' = LᵀJL z, so the error is that of the phase alone: ε·ω·t.
    """
    if system.written is None:
        return None
    import sympy

    variables, H = [*system.written.q, *system.written.p], system.written.H
    if not H.is_polynomial(*variables) or any(sum(m) not in (0, 2) for m in sympy.Poly(H, *variables).monoms()):
        return None
    S = np.asarray(system.hessian(np.zeros(len(variables))))
    try:
        L = np.linalg.cholesky(S)
    except np.linalg.LinAlgError:
        return None
    d = system.ndof
    J = np.block([[np.zeros((d, d)), np.eye(d)], [-np.eye(d), np.zeros((d, d))]])
    frequency, U = np.linalg.eigh(-1j * (L.T @ J @ L))  # z(t) = U exp(i ω t) U* z(0)
    z0 = (y0 @ L) @ U.conj()
    z = z0[..., None, :] * np.exp(1j * t[:, None] * frequency)
    return np.moveaxis(np.real(z @ U.T) @ np.linalg.inv(L), -2, -1)
