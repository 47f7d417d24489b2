"""Collocated flows: steps of Gauss's methods with a system's own H, separable or not; nothing in them is trained.

    K_i = s f(x + Σ_j a_ij K_j),   χ_s(x) = x + Σ_i b_i K_i,   f = J∇H,      ψ̄_t = (χ_{t/m})^m

Every χ_s is symplectic, and χ_{−s} its inverse. Its generating function is the action of the collocation polynomial,
which is stationary in the stages, so that the derivative by s is the explicit one: χ is the exact flow of

    𝓗(s, χ_s(x)) = Σ_i b_i H(Y_i),   Y_i = x + Σ_j a_ij K_j,

the mean of H over the stages, and ψ̄ of the mean over those of all m steps.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from sympflow.arguments import checked_count, floats, plain
from sympflow.arrays import per_state
from sympflow.flow.flow_map import check_system
from sympflow.flow.layers import OwnLayer
from sympflow.flow.potentials import Time
from sympflow.flow.records import checked_integer
from sympflow.flow.sympflow import SystemFlow
from sympflow.hamiltonian import collocation
from sympflow.hamiltonian.fingerprint import check_for_flows
from sympflow.hamiltonian.system import HamiltonianSystem

if TYPE_CHECKING:  # a flow needs it only to be compiled
    from sympflow.flow.loops import CollocatedFlowKernel

MOST_STAGES, MOST_STEPS = 8, 200
SAMPLED = 100
"""States of Ω by which the number of steps is chosen."""
QUANTILE = 0.99
TOLERANCE = 1e-10
"""Error of ψ̄_Δt that 99 % of the states stay below, in units of their spread, 1 where they have none."""


class CollocationLayer(OwnLayer):
    """One step χ_{t/m} of a Gauss method."""

    def moved(self, t: Time, y: Tensor, back: bool) -> Tensor:
        h = (-t if back else t) / self.flow.steps
        return self.flow.ended(y, self.flow.stages_of(y, h)[0], h)

    def pull_back(self, t: Time, q: Tensor, p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        flow, y, h = self.flow, torch.cat([q, p]).T, -t / self.flow.steps
        flow.bound_system.check_conservative("so `flow` has no Hamiltonian", "use the H of its system")
        K, _ = flow.stages_of(y, h)  # of the way back, whose stages are those of the step
        A = torch.as_tensor(flow.tableau[0], dtype=y.dtype, device=y.device)
        mean = (flow.weights * flow.bound_system.hamiltonian(y[:, None, :] + A @ K)).sum(-1)
        q, p = flow.ended(y, K, h).T.chunk(2)
        return q, p, mean / flow.steps


class CollocatedFlow(SystemFlow):
    """The SympFlow of m equal steps of a Gauss method, for any H; made by `SympFlow.collocated`.

    Nothing in it is trained: its error is that of the method, which more steps make as small as one likes. It is
    symplectic to the rounding of Newton's iteration, and time-reversible, ψ̄_{−t} = (ψ̄_t)⁻¹. With friction it is
    conformally symplectic, and has no 𝓗.

    Parameters
    ----------
    ndof : int
    stages : int
        s, of the method of order 2s.
    steps : int
        m.
    dt : float
        Δt.
    system : HamiltonianSystem, optional
        Without it the flow has no values.
    dtype, device
        Of the states. A file holds no number of the flow, and is read as one in float64.

    Attributes
    ----------
    tableau : tuple
        See `sympflow.hamiltonian.collocation.Tableau`.

    References
    ----------
    .. [1] E. Hairer, C. Lubich, G. Wanner, *Geometric Numerical Integration*, 2nd ed. (Springer 2006): II.1.3, and VI.5
       for the action.
    """

    takes_friction = True
    PLAN = "collocated"
    MADE = "made of steps with the H of a system"

    def __init__(
        self,
        ndof: int,
        stages: int = 4,
        steps: int = 1,
        dt: float = 1.0,
        system: HamiltonianSystem | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__(ndof, dt, dtype, device)
        self.stages = checked_count("stages", plain(stages), 1, MOST_STAGES, f"an integer from 1 to {MOST_STAGES}")
        self.steps = checked_count("steps", plain(steps), 1, MOST_STEPS, f"an integer from 1 to {MOST_STEPS}")
        self.tableau = collocation.gauss_legendre(self.stages)
        _, B, scale = self.tableau
        weights = [b * unit for b, unit in zip(B, scale, strict=True)] if self.stages > 2 else list(B)
        self.register_buffer("weights", torch.tensor(weights, **self._like), persistent=False)
        # A tuple, not a ModuleList: the layers own nothing.
        self.layers = tuple(CollocationLayer(self) for _ in range(self.steps))
        self._made_of(system)

    @classmethod
    def of(
        cls, system: HamiltonianSystem, *, stages: int, steps: int | None, states: ArrayLike | None, **like: Any
    ) -> Self:
        """Return a flow with as many steps as the system needs: see `SympFlow.collocated`."""
        check_system(system)
        check_for_flows(system, cls.takes_friction, cls.takes_driving)
        # all arguments are checked before the work of choosing the steps
        flow = cls(system.ndof, stages, 1 if steps is None else steps, like["dt"])
        if steps is None:
            if states is None and system.domain is not None:
                states = system.domain.sample(SAMPLED, 0)
            if states is None:
                raise ValueError(
                    "`steps` is needed, because the system has no domain over which errors could be compared: give "
                    "it, or "
                    "`states`."
                )
            x, width = floats("states", states), 2 * system.ndof
            if x.ndim != 2 or x.shape[1] != width or not len(x) or not np.isfinite(x).all():
                raise ValueError(
                    f"`states` must be finite and of shape (n, {width}); got {x.shape}: give some, or `steps`."
                )
            steps = enough_steps(system, flow.tableau, flow.dt, x)
        made = cls(system.ndof, stages, steps, system=system, **like)
        made.domain = system.domain
        if system.domain is not None:
            made.identify(system, system.domain)
        return made

    @classmethod
    def checked_plan(cls, plan: dict[str, Any], ndof: int) -> dict[str, Any]:
        most = {"stages": MOST_STAGES, "steps": MOST_STEPS}
        return {name: checked_integer(plan.get(name), f"number of {name}", m) for name, m in most.items()}

    def plan(self) -> dict[str, Any]:
        return {"stages": self.stages, "steps": self.steps}

    # the maps -----------------------------------------------------------------------------------------------

    def stages_of(self, y: Tensor, h: Time) -> tuple[Tensor, int]:
        """The increments K (N, s, 2d) of a step of length h from states y (N, 2d), and Newton's iterations."""
        return collocation.stages(self.bound_system, self.tableau, y, per_state(h, y), None)

    def ended(self, y: Tensor, K: Tensor, h: Time) -> Tensor:
        """The states (N, 2d) at the end of that step."""
        return collocation.advanced(self.bound_system, self.tableau, y, K, per_state(h, y))

    def _compiled_for(self, system: HamiltonianSystem, compensated: bool) -> CollocatedFlowKernel:
        from sympflow.flow.loops import CollocatedFlowKernel

        return CollocatedFlowKernel(system, self.tableau, self.steps)

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        """Count those of one iteration of Newton's method in each step, the least that there can be."""
        n = self.iterated * self.steps * (n_steps + n_extra)
        return {"force_evaluations": n, "hessian_evaluations": n}

    @property
    def iterated(self) -> int:  # type: ignore[override]
        return self.stages

    # its system ---------------------------------------------------------------------------------------------

    @property
    def bound_system(self) -> HamiltonianSystem:
        """The system whose H the flow uses."""
        return self._binding.system


@np.errstate(all="ignore")  # of steps that are too long
def enough_steps(system: HamiltonianSystem, tableau: collocation.Tableau, dt: float, x: np.ndarray) -> int:
    """The number of equal steps of a Gauss method with which ψ̄_Δt of states (n, 2d) errs by less than `TOLERANCE`."""
    spread, order = x.std(axis=0), 2 * len(tableau[1])
    unit = np.where(spread > 0, spread, 1.0)

    def stepped(m: int) -> np.ndarray:
        y = x
        for _ in range(m):
            y, _ = collocation.counted_step(system, tableau, 0.0, y, dt / m)
        return y

    steps = 1
    while steps <= MOST_STEPS:
        error = np.abs((stepped(steps) - stepped(2 * steps)) / unit).max(axis=1)
        found = float(np.quantile(np.where(np.isfinite(error), error, np.inf), QUANTILE))
        if found <= TOLERANCE:
            return steps
        more = (found / TOLERANCE) ** (1 / order) if found < 1 else 2.0
        steps = max(steps + 1, math.ceil(steps * more))
    raise ValueError(
        f"`dt` = {dt:g} is so long for the system {system.name!r} that it takes more than {MOST_STEPS} steps: give a "
        "shorter one."
    )
