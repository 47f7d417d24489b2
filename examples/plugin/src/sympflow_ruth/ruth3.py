"""Ruth's symplectic integrator of order three."""

from dataclasses import dataclass
from typing import Any, ClassVar

from sympflow.arrays import Array, concatenate, per_state
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep

KICKS = (7 / 24, 3 / 4, -1 / 24)
DRIFTS = (2 / 3, -2 / 3, 1.0)


@dataclass(frozen=True)
class Ruth3(FixedStep):
    """Three pairs of a kick p += b h F(q) and a drift q += a h ∇T(p).

    Parameters
    ----------
    dt : float, optional
        Step length; the default is `system.dt`.

    References
    ----------
    .. [1] R. D. Ruth, "A canonical integration technique", IEEE Trans. Nucl. Sci. 30 (1983) 2669–2671.
    """

    name: ClassVar[str] = "ruth3"
    order: ClassVar[int | None] = 3
    symplectic: ClassVar[bool] = True

    def check(self, system: HamiltonianSystem) -> None:
        if not system.separable:
            raise ValueError(f"`method` 'ruth3' needs a separable system; {system.name!r} is not: use 'dop853'.")

    def step(self, system: HamiltonianSystem, t: float, y: Array, h: Any) -> Array:
        q, p, h = y[..., : system.ndof], y[..., system.ndof :], per_state(h, y)
        for b, a in zip(KICKS, DRIFTS, strict=True):
            p = p + b * h * system.force(q)
            q = q + a * h * system.velocity(p)
        return concatenate([q, p])

    def inverse(self, system: HamiltonianSystem, t: float, y: Array, h: Any) -> Array:
        q, p, h = y[..., : system.ndof], y[..., system.ndof :], per_state(h, y)
        for b, a in zip(reversed(KICKS), reversed(DRIFTS), strict=True):
            q = q - a * h * system.velocity(p)
            p = p - b * h * system.force(q)
        return concatenate([q, p])

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        return {"force_evaluations": len(KICKS) * (n_steps + n_extra), "hessian_evaluations": 0}
