"""ψ_s(y0) as a differentiable function of the elapsed time s, of y0 and of a flow's weights; and its first zero."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from scipy.optimize import brentq
from torch import Tensor

from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep, Problem
from sympflow.integrators.grid import Grid
from sympflow.integrators.registry import naming_plugin

MAX_EVENT_STEPS = 1_000_000
_EPS = 4 * float(np.finfo(float).eps)


class Path:
    """The trajectory of an integrator from y0, on the grid k·dt of elapsed times, in one direction of time.

    Parameters
    ----------
    integrator : FixedStep
    system : HamiltonianSystem or None
        None for a flow that needs none.
    y0 : tensor of shape (..., 2d)
    direction : 1 or -1
    """

    def __init__(self, integrator: FixedStep, system: HamiltonianSystem | None, y0: Tensor, direction: int) -> None:
        self.integrator, self.y0, self.eager = integrator, y0, False
        self.system: HamiltonianSystem = system  # type: ignore[assignment]
        self.h = math.copysign(integrator.step_length(self.system), direction)

    def __call__(self, s: Tensor) -> Tensor:
        """ψ_s(y0), (n, ..., 2d), for elapsed times s (n,), each 0 or with the sign of the direction.

        Differentiable in s (where an s is a whole number of steps: in the step that begins or ends there).
        """
        times = s.detach().cpu().to(torch.float64).numpy()
        reach = float(times[np.argmax(np.abs(times))]) if len(times) else 0.0
        count, remainder = Grid(0.0, reach or self.h, abs(self.h)).locate(times)
        states = self._rollout(count)
        grid_times = torch.as_tensor(count * self.h, dtype=torch.float64, device=s.device)
        r = (s.to(torch.float64) - grid_times).to(self.y0.dtype)
        r = torch.where(torch.as_tensor(remainder == 0, device=r.device), r - r.detach(), r)
        if not (s.requires_grad or np.any(remainder)):
            return states
        h = r.reshape(-1, *[1] * (states.ndim - 2)).expand(states.shape[:-1])
        return self._step(states, h)

    def _rollout(self, count: np.ndarray) -> Tensor:
        """The states after the steps `count`: compiled where nothing is to be differentiated."""
        save, n_steps = np.unique(count), int(count.max(initial=0))
        y0: Tensor | np.ndarray = self.y0
        plain = self._plain()
        if plain:
            y0 = self.y0.detach().numpy()
        with naming_plugin(self.integrator):
            stepper = self.integrator.stepper(Problem(self.system, 0.0, n_steps * self.h, y0))
            states, _ = stepper.rollout(y0, self.h, n_steps, save)
        if plain:
            states = torch.from_numpy(np.ascontiguousarray(states))
        return states[torch.as_tensor(np.searchsorted(save, count), device=self.y0.device)]

    def _step(self, y: Tensor, h: float | Tensor) -> Tensor:
        """A step of length h, by NumPy (a flow's: compiled) where nothing is to be differentiated."""
        moving = y.requires_grad or (isinstance(h, Tensor) and h.requires_grad)
        with naming_plugin(self.integrator):
            if moving or not self._plain():
                return self.integrator.step(self.system, 0.0, y, h)
            length = h.numpy() if isinstance(h, Tensor) else h
            stepped = self.integrator.step(self.system, 0.0, y.numpy(), length)
        return torch.from_numpy(np.ascontiguousarray(stepped))

    def _plain(self) -> bool:
        return not (self.eager or self._differentiable()) and self.y0.device.type == "cpu"

    def _differentiable(self) -> bool:
        return torch.is_grad_enabled() and (self.y0.requires_grad or self._learns())

    def _learns(self) -> bool:
        """True if the flow has weights that require gradients."""
        flow = self.integrator.flow_for(self.system)
        return flow is not None and any(w.requires_grad for w in flow.parameters())

    def first_zero(self, g: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """The elapsed time s at which g(s, ψ_s(y0)), a number, first vanishes.

        g is tested at every step, and every `system.dt` within longer ones, such as those of a flow.

        Its derivatives are those of the implicit function: ds = −dg / (dg/ds).

        Raises
        ------
        RuntimeError
            If there is none within a million steps, or the state became non-finite before.
        """
        with torch.no_grad():
            value = self._bracket(g)
        s = torch.tensor(value, dtype=torch.float64, device=self.y0.device)
        c = g(s, self(s[None])[0])
        if not c.requires_grad:
            return s
        moving = s.clone().requires_grad_(True)
        (slope,) = torch.autograd.grad(g(moving, self(moving[None])[0]), moving)
        return s - (c - c.detach()) / slope

    def _bracket(self, g: Callable[[Tensor, Tensor], Tensor]) -> float:
        def value(s: float, y: Tensor) -> float:
            return float(g(torch.tensor(s, dtype=torch.float64, device=y.device), y))

        before = value(0.0, self.y0.detach())
        if before == 0:
            return 0.0
        k, chunk, y = 0, 8, self.y0.detach()
        eager = self._learns()  # the map whose derivatives follow, not a compiled copy of its weights
        while k < MAX_EVENT_STEPS:
            ahead = Path(self.integrator, self.system, y, 1 if self.h > 0 else -1)
            ahead.eager = eager
            states = ahead._rollout(np.arange(chunk + 1))
            inner = self._samples(states[:-1])
            parts = inner.shape[1] + 1
            for j in range(chunk):
                a = start = (k + j) * self.h
                for i in range(1, parts + 1):
                    b, y_b = start + self.h * i / parts, inner[j, i - 1] if i < parts else states[j + 1]
                    after = value(b, y_b)
                    if np.sign(before) * np.sign(after) <= 0:  # the product itself may underflow
                        return self._locate(value, start, states[j], (a, before), (b, after))
                    if not math.isfinite(after):
                        raise RuntimeError(
                            f"`event_fn` found no zero: the solution became non-finite after an elapsed time of "
                            f"{a:.6g}. Check y0, or use a smaller dt."
                        )
                    a, before = b, after
            k, y, chunk = k + chunk, states[-1], min(2 * chunk, 1024)
        raise RuntimeError(f"`event_fn` found no zero within {MAX_EVENT_STEPS:,} steps: check that there is one.")

    def _samples(self, states: Tensor) -> Tensor:
        """States (n, parts − 1, ..., 2d) that divide the steps from `states` (n, ..., 2d) into equal parts."""
        longest = abs(self.h) if self.system is None else self.system.dt
        parts = max(1, math.ceil(abs(self.h) / longest * (1 - _EPS)))
        repeated = states[:, None].expand(-1, parts - 1, *states.shape[1:])
        fractions = torch.arange(1, parts, dtype=states.dtype, device=states.device) / parts
        h = (self.h * fractions).reshape(-1, *[1] * (states.ndim - 2)).expand(repeated.shape[:-1])
        return repeated if parts == 1 else self._step(repeated, h)

    def _locate(
        self,
        value: Callable[[float, Tensor], float],
        start: float,
        y: Tensor,
        left: tuple[float, float],
        right: tuple[float, float],
    ) -> float:
        """The zero between two (s, g), in the step from y at `start`."""
        (a, g_a), (b, g_b) = left, right
        known = {a: g_a, b: g_b}
        # a power of two, exact: Brent's own products shall not underflow, either
        unit = math.ldexp(1.0, min(-math.frexp(max(abs(g_a), abs(g_b)))[1], 1000))

        def f(s: float) -> float:
            if s in known:
                return known[s] * unit
            return value(s, self._step(y, s - start)) * unit

        return b if g_b == 0 else float(brentq(f, a, b, xtol=_EPS, rtol=_EPS))
