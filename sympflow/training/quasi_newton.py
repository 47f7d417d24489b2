"""Quasi-Newton methods: self-scaled BFGS with a dense inverse Hessian, and L-BFGS for what is too large for that."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from sympflow.flow.flow_map import FlowMap
from sympflow.training.config import TrainingConfig
from sympflow.training.line_search import Trial, strong_wolfe
from sympflow.training.weight_vector import put_weights, weight_vector

MAX_PARAMETERS = 8000
ITERATIONS = 20
MEMORY = 30


class QuasiNewton:
    """Steps of 20 quasi-Newton iterations each, on the points of the step.

    Duties of a subclass
    --------------------
    1. `_times(g)`: B g, B the inverse Hessian, or None while nothing is known of it.
    2. `_update(s, y, sBs)`: make B satisfy B y = s; sBs is sᵀB⁻¹s, which the step direction gives without B⁻¹.
    3. `_forget()`: B is not known any more.
    4. `state_dict`, `load_state_dict`.
    """

    def __init__(self, flow: FlowMap, config: TrainingConfig) -> None:
        self.parameters = list(flow.parameters())

    def _times(self, g: Tensor) -> Tensor | None:
        raise NotImplementedError

    def _update(self, s: Tensor, y: Tensor, sBs: float) -> None:
        raise NotImplementedError

    def _forget(self) -> None:
        raise NotImplementedError

    def step(self, index: int, loss: Callable[[], Tensor]) -> float:
        """Iterate; the loss before the first iteration."""
        x = weight_vector(self.parameters)
        value, g = self._evaluate(loss, x)
        first = value
        for _ in range(ITERATIONS if math.isfinite(first) else 0):
            Bg = self._times(g)
            p = -g if Bg is None else -Bg

            def along(a: float, x: Tensor = x, p: Tensor = p) -> Trial:
                value, g = self._evaluate(loss, x + a * p)
                return Trial(a, value, float(g @ p), g)

            start = Trial(0.0, value, float(g @ p), g)
            guess = 1 / max(1.0, float(g.abs().sum())) if Bg is None else 1.0
            found = strong_wolfe(along, start, guess) if start.slope < 0 else None
            if found is None:
                if Bg is None:
                    break  # not even along the gradient does it descend: a minimum to rounding
                self._forget()
                continue
            s, y = found.length * p, found.gradient - g
            if float(y @ s) > 0:
                self._update(s, y, -found.length * float(s @ g))
            x, value, g = x + s, found.loss, found.gradient
        put_weights(self.parameters, x)
        return first

    def _evaluate(self, loss: Callable[[], Tensor], x: Tensor) -> tuple[float, Tensor]:
        put_weights(self.parameters, x)
        for w in self.parameters:
            w.grad = None
        value = loss()
        value.backward()
        gradients = [torch.zeros_like(w) if w.grad is None else w.grad for w in self.parameters]
        return float(value.detach()), torch.cat([g.reshape(-1) for g in gradients])


class BFGS(QuasiNewton):
    """BFGS with Oren and Luenberger's self-scaling, limited to growth of the inverse Hessian B.

    A B that has learnt the curvature far from the minimum is soon forgotten. On residual losses of small networks it
    gets orders of magnitude further than limited-memory BFGS [2]_.

    References
    ----------
    .. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2006, chapter 6.
    .. [2] J. F. Urbán, P. Stefanou, J. A. Pons, Unveiling the optimization process of physics informed neural
       networks, J. Comput. Phys. 523 (2025) 113656.
    """

    def __init__(self, flow: FlowMap, config: TrainingConfig) -> None:
        if flow.n_parameters > MAX_PARAMETERS:
            raise ValueError(
                f"`optimizer` 'bfgs' keeps a dense matrix and takes at most {MAX_PARAMETERS} parameters; the flow has "
                f"{flow.n_parameters}: use 'lbfgs' or 'adam'."
            )
        super().__init__(flow, config)
        self.B: Tensor | None = None

    def state_dict(self) -> dict[str, Any]:
        return {"inverse_hessian": self.B}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        B = state["inverse_hessian"]
        n = sum(w.numel() for w in self.parameters)
        if B is not None and B.shape != (n, n):
            raise ValueError(f"`state` has an inverse Hessian of shape {tuple(B.shape)}, not {(n, n)}: start afresh.")
        self.B = None if B is None else B.to(self.parameters[0])

    def _times(self, g: Tensor) -> Tensor | None:
        return None if self.B is None else self.B @ g

    def _forget(self) -> None:
        self.B = None

    def _update(self, s: Tensor, y: Tensor, sBs: float) -> None:
        ys = float(y @ s)
        if self.B is None:
            self.B = torch.eye(len(s), dtype=s.dtype, device=s.device) * (ys / float(y @ y))
            sBs = ys
        By = self.B @ y
        yBy = float(y @ By)
        v = s / ys - By / yBy
        self.B.addr_(By, By, alpha=-1 / yBy).addr_(v, v, alpha=yBy).div_(min(1.0, ys / sBs))
        self.B.addr_(s, s, alpha=1 / ys)


class LBFGS(QuasiNewton):
    """L-BFGS: B from the last 30 pairs (s, y) by the two-loop recursion; memory and work are linear in the parameters.

    References
    ----------
    .. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2006, algorithm 7.4.
    """

    def __init__(self, flow: FlowMap, config: TrainingConfig) -> None:
        super().__init__(flow, config)
        self.pairs: list[tuple[Tensor, Tensor]] = []

    def state_dict(self) -> dict[str, Any]:
        return {"pairs": [list(pair) for pair in self.pairs]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        n, like = sum(w.numel() for w in self.parameters), self.parameters[0]
        if any(v.shape != (n,) for pair in state["pairs"] for v in pair):
            raise ValueError(f"`state` has steps that are not of length {n}: start afresh.")
        self.pairs = [(s.to(like), y.to(like)) for s, y in state["pairs"]]

    def _times(self, g: Tensor) -> Tensor | None:
        if not self.pairs:
            return None
        v, shares = g.clone(), []
        for s, y in reversed(self.pairs):
            share = float(s @ v) / float(y @ s)
            v = v - share * y
            shares.append(share)
        s, y = self.pairs[-1]
        v = v * (float(y @ s) / float(y @ y))
        for (s, y), share in zip(self.pairs, reversed(shares), strict=True):
            v = v + (share - float(y @ v) / float(y @ s)) * s
        return v

    def _forget(self) -> None:
        self.pairs = []

    def _update(self, s: Tensor, y: Tensor, sBs: float) -> None:
        self.pairs = [*self.pairs, (s, y)][-MEMORY:]
