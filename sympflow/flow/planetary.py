"""SympFlows of planets: Kepler's motion | interaction, one kick a step, in other coordinates that were trained.

    ψ̄_Δt = χ ∘ K ∘ χ⁻¹,    K = drift ½, kick 1, drift ½,    χ = K^{−M} ∘ (kicks β_j, after steps of K) ∘ K^{−M}

A kick b moves the planets' velocities by b Δt times the accelerations of the interaction, a drift a moves each planet
on its orbit for a Δt. χ has kicks β_j at τ = j/2 of a step of K and −β_j at −j/2, j = 1 … 2M, with force gradients γ_j
besides at the first of them. To first order in the masses the error of K is a sum of periodic terms of the orbits. A
kick at τ turns one of frequency ω by e^{iωτΔt}, so that a sum of kicks removes those that are further than 1/MΔt from a
multiple of 2π/Δt, where no coordinates do. Between two steps the χ cancel: a step costs one kick and one drift.

At times before Δt the flow is another scheme, `kepler_aba1064`, far more accurate there than ψ̄_Δt.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sympflow.arrays import differentiable, to_numpy
from sympflow.flow.flow_map import to_values
from sympflow.flow.layers import OwnLayer
from sympflow.flow.potentials import Time, by_time
from sympflow.flow.records import Refused, checked_integer
from sympflow.flow.sympflow import SystemFlow
from sympflow.flow.weights import Kept, doubles
from sympflow.hamiltonian.planets import Frame, frame_of
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.protocol import Kernel
from sympflow.schemes import SCHEMES, Substeps, paired, reversed_substeps

STEP: Substeps = [(0.0, 0.5, 0.0), (1.0, 0.5, 0.0)]
BETWEEN = paired([(s.kind, s.one, s.three) for s in SCHEMES["aba1064"].substeps])
MOST_REACH = 1000
SAME_ORBITS = 1e-3  # relative differences of periods for which the numbers hold
AT_DT = 1e-12  # relative difference of a time from Δt that is rounding
BEFORE, STEPS, AFTER = slice(0, 1), slice(1, 2), slice(2, 3)


def at_dt(dt: float, t: Any) -> Any:
    """Return True for times that are Δt, or −Δt."""
    return abs(abs(t) - dt) <= AT_DT * dt


def processor_of(kicks: Sequence[float], gradients: Sequence[float]) -> Substeps:
    """χ of kicks β_j and force gradients γ_j, in units of a step."""
    reach = len(kicks) // 2
    back = [(0.0, -0.5, 0.0), *[(-1.0, -1.0, 0.0)] * (reach - 1), (-1.0, -0.5, 0.0)]
    there = []
    for k in range(-2 * reach, 2 * reach + 1):
        j, sign = abs(k) - 1, float(np.sign(k))
        own = sign * kicks[j] if k else 0.0
        third = sign * gradients[j] if 0 <= j < len(gradients) else 0.0
        there.append((own + k % 2, 0.5 if k < 2 * reach else 0.0, third))
    return [*back, *there, *back]


class PlanetLayer(OwnLayer):
    """A kick or a drift of the scheme that the flow is before Δt, of this part of its time."""

    def __init__(self, flow: KeplerFlow, kick: float, drift: float) -> None:
        super().__init__(flow)
        self.substep = kick, drift, 0.0

    def moved(self, t: Time, y: Tensor, back: bool) -> Tensor:
        substeps, time = reversed_substeps([self.substep]) if back else [self.substep], t + 0 * y[:, 0]
        return self.flow.frame.moved(y, sum(a for _, a, _ in substeps) * time, (substeps, time))

    def pull_back(self, t: Time, q: Tensor, p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        q, p = self.inverse(t, q, p)
        y, (kick, drift, _) = torch.cat([q, p]).T, self.substep
        kepler = self.flow.frame.kepler_energy(y)
        return q, p, kick * (self.flow.system.hamiltonian(y) - kepler) if kick else drift * kepler


class KeplerFlow(SystemFlow):
    """A flow of planets about a star with trained coordinates; made by `sympflow.train` of a system of planets.

    `reach` is M, in steps, `n_gradients` is 0 to 2M, and `periods` those of the planets, for whose orbits alone the
    numbers `kicks`, β (2M,), and `gradients`, γ, hold. The system is one of `HamiltonianSystem.planets`, in Jacobi's
    coordinates; without it the flow has no values.
    """

    kicks: Tensor
    gradients: Tensor

    PLAN = "kepler"
    MADE = "made of Kepler's motion and the interaction of planets"

    def __init__(
        self,
        ndof: int,
        reach: int = 64,
        n_gradients: int = 0,
        dt: float = 1.0,
        periods: Sequence[float] | None = None,
        system: HamiltonianSystem | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__(ndof, dt, dtype, device)
        self.register_buffer("kicks", torch.zeros(2 * reach, **self._like))
        self.register_buffer("gradients", torch.zeros(n_gradients, **self._like))
        self.periods = None if periods is None else tuple(map(float, periods))
        self._kept: Kept[tuple[Substeps, Substeps]] = Kept([self._buffers])
        # A tuple, not a ModuleList: the layers own no numbers.
        self.layers = tuple(PlanetLayer(self, *m) for b, a, _ in BETWEEN for m in ((b, 0.0), (0.0, a)) if any(m))
        self._made_of(system)

    @property
    def frame(self) -> Frame:
        return self._binding.parts

    def check_system(self, system: HamiltonianSystem) -> None:
        super().check_system(system)
        self._frame_of(system)

    def _take(self, system: HamiltonianSystem) -> None:
        frame = self._frame_of(system)
        self.periods = tuple(frame.periods.tolist()) if self.periods is None else self.periods
        self._binding.bind(system, frame)

    def _frame_of(self, system: HamiltonianSystem) -> Frame:
        """The frame of a system, whose planets are on the orbits for which the numbers hold."""
        frame = frame_of(system)
        if frame is None or not frame.jacobi:
            raise ValueError(
                f"`system` {system.name!r} has no planets in Jacobi's coordinates, which the flow needs: make it by "
                "HamiltonianSystem.planets."
            )
        frame.check("sympflow")
        periods = np.array(frame.periods if self.periods is None else self.periods)
        off = np.abs(periods / frame.periods - 1)
        if off.max() > SAME_ORBITS:
            i = int(np.argmax(off))
            raise ValueError(
                f"`system` {system.name!r} has body {i + 1} on another orbit, of period {frame.periods[i]:g}, than the "
                f"flow was trained for, {periods[i]:g}: train one by sympflow.train(system)."
            )
        return frame

    def _number(self) -> Tensor:
        return self.kicks

    # the map --------------------------------------------------------------------------------------------------

    def prepare(self, t: float | Tensor, x: Tensor) -> Tensor:
        return self._moved(t, x, BEFORE)

    def kernel_step(self, t: float | Tensor, x: Tensor, back: bool = False) -> Tensor:
        return self._moved(-t if back else t, x, STEPS)

    def finish(self, t: float | Tensor, x: Tensor) -> Tensor:
        return self._moved(t, x, AFTER)

    def _map(self, t: float | Tensor, y: Tensor) -> Tensor:
        if differentiable(y) or differentiable(t) or self.dtype != torch.float64 or self.device.type != "cpu":
            return self._moved(t, y.T, slice(None)).T
        rows = np.ascontiguousarray(to_numpy(y).T)
        lengths = np.broadcast_to(to_numpy(t) if isinstance(t, Tensor) else t, len(rows))
        return torch.from_numpy(self.kernel_for(self._binding.system).step(lengths, rows).states).T

    def _map_inverse(self, t: float | Tensor, y: Tensor) -> Tensor:
        return self._map(-t, y)

    def _map_tangent(self, t: float | Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        def between(s: Tensor) -> Tensor:
            time = t + s + 0 * y[0]
            return self.frame.moved(y.T, time, (BETWEEN, time)).T

        return self._map(t, y), by_time(between, y)[1]

    def _moved(self, t: float | Tensor, x: Tensor, parts: slice) -> Tensor:
        """States after some of χ⁻¹, K and χ, or of the scheme before Δt, for t < 0 of its inverse."""
        time = torch.as_tensor(t, dtype=x.dtype, device=x.device).expand(x.shape[:-1])
        (processor, inverse), whole = self._kept.current(self._frozen), at_dt(self.dt, to_values(time))
        passed = time if parts not in (BEFORE, AFTER) else 0 * time
        ends: list[Tensor] = []
        for is_trained, pieces in ((True, (inverse, STEP, processor)), (False, ([], BETWEEN, []))):
            if (whole == is_trained).any():
                timed = [*zip(pieces, (time.abs(), time, time.abs()), strict=True)]
                ends.append(self.frame.moved(x, passed, *timed[parts]))
        if len(ends) < 2:
            return ends[0] if ends else x
        return torch.where(torch.as_tensor(whole, device=x.device)[..., None], ends[0], ends[1])

    # its runs -------------------------------------------------------------------------------------------------

    def _frozen(self) -> tuple[Substeps, Substeps]:
        """χ and its inverse, of the numbers now."""
        processor = processor_of(*(doubles(x).tolist() for x in (self.kicks, self.gradients)))
        return processor, reversed_substeps(processor)

    def kernel_for(self, system: HamiltonianSystem, compensated: bool = False) -> Kernel:
        return self._loops_for(system, compensated)

    def _compiled_for(self, system: HamiltonianSystem, compensated: bool) -> Kernel:
        from sympflow.kernels.kepler import KeplerFlowKernel, KeplerKernel, kepler_loops

        (processor, inverse), loops = self._kept.current(self._frozen), kepler_loops(self.frame)
        trained = KeplerKernel(loops, STEP, inverse, processor, compensated)
        return KeplerFlowKernel(partial(at_dt, self.dt), trained, KeplerKernel(loops, BETWEEN, compensated=compensated))

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        kicks = sum(kick != 0 for kick, *_ in self._kept.current(self._frozen)[0])
        forces = n_steps + kicks * (1 + n_saved) + sum(kick != 0 for kick, *_ in BETWEEN) * n_extra
        return {"force_evaluations": forces, "hessian_evaluations": 2 * len(self.gradients) * (1 + n_saved)}

    def plan(self) -> dict[str, Any]:
        return {"reach": len(self.kicks) // 2, "gradients": len(self.gradients), "periods": list(self.periods or ())}

    @classmethod
    def checked_plan(cls, plan: dict[str, Any], ndof: int) -> dict[str, Any]:
        reach = checked_integer(plan.get("reach"), "reach", MOST_REACH)
        gradients, periods = plan.get("gradients"), plan.get("periods", ())
        if gradients != 0:
            gradients = checked_integer(gradients, "number of force gradients", 2 * reach)
        known = isinstance(periods, list) and all(isinstance(p, float) and 0 < p < math.inf for p in periods)
        if not known or len(periods) != ndof // 3 - 1:
            raise Refused("its periods are not those of its planets")
        return {"reach": reach, "n_gradients": gradients, "periods": periods}
