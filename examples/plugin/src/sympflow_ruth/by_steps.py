"""The same method written as a step: the way for what is no scheme of kicks and drifts. It is far slower."""

from dataclasses import dataclass
from typing import Any, ClassVar

from sympflow.arrays import Array, concatenate, per_state
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep
from sympflow_ruth.schemes import RUTH3


@dataclass(frozen=True)
class Ruth3BySteps(FixedStep):
    """Three pairs of a kick p += b h F(q) and a drift q += a h ∇T(p).

    Parameters
    ----------
    dt : float, optional
        Step length; the default is `system.dt`.

    References
    ----------
    .. [1] R. D. Ruth, "A canonical integration technique", IEEE Trans. Nucl. Sci. 30 (1983) 2669–2671.
    """

    name: ClassVar[str] = "ruth3_by_steps"
    order: ClassVar[int | None] = 3
    symplectic: ClassVar[bool] = True

    def check(self, system: HamiltonianSystem) -> None:
        if not system.separable:
            raise ValueError(
                f"`method` 'ruth3_by_steps' needs a separable system; {system.name!r} is not: use 'dop853'."
            )

    def step(self, system: HamiltonianSystem, t: float, y: Array, h: Any) -> Array:
        q, p, h = y[..., : system.ndof], y[..., system.ndof :], per_state(h, y)
        for b, a in zip(RUTH3.kicks, RUTH3.drifts, strict=True):
            p = p + b * h * system.force(q)
            q = q + a * h * system.velocity(p)
        return concatenate([q, p])

    def inverse(self, system: HamiltonianSystem, t: float, y: Array, h: Any) -> Array:
        q, p, h = y[..., : system.ndof], y[..., system.ndof :], per_state(h, y)
        for b, a in zip(reversed(RUTH3.kicks), reversed(RUTH3.drifts), strict=True):
            q = q - a * h * system.velocity(p)
            p = p - b * h * system.force(q)
        return concatenate([q, p])
