"""The optimizers of losses: one small class each; Gauss–Newton, which needs residuals, is in `least_squares`."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import numpy as np
import torch
from scipy.optimize import line_search
from torch import Tensor

from sympflow.flow.flow_map import FlowMap
from sympflow.training import fits
from sympflow.training.least_squares import GaussNewtonSteps, check_parameters, put_weights, weight_vector
from sympflow.training.session import OutOfTime

ITERATIONS = 20  # of quasi-Newton methods, in a step
MEMORY = 30


class _TorchSteps:
    """Steps of a method of torch."""

    finished: str | None = None
    needs_residuals: ClassVar[bool] = False
    method: Any

    def state_dict(self) -> dict[str, Any]:
        return self.method.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.method.load_state_dict(state)


class AdamSteps(_TorchSteps):
    """Adam (Kingma & Ba 2015) with a schedule and gradient clipping."""

    def __init__(self, flow: FlowMap, options: fits.Adam) -> None:
        self.options = options
        self.parameters = list(flow.parameters())
        self.method = torch.optim.Adam(self.parameters, lr=options.learning_rate, fused=True)

    def step(self, index: int, loss: Callable[[], Tensor]) -> float:
        """Take a step; the loss before it."""
        self.method.zero_grad(set_to_none=True)
        value = loss()
        value.backward()
        if self.options.clip is not None:
            torch.nn.utils.clip_grad_norm_(self.parameters, self.options.clip)
        self.method.param_groups[0]["lr"] = self.options.rate(index)
        self.method.step()
        return float(value.detach())


class LBFGSSteps(_TorchSteps):
    """L-BFGS by torch, its memory 30 pairs: 20 iterations a step, on the points of the step."""

    def __init__(self, flow: FlowMap) -> None:
        self.parameters = list(flow.parameters())
        self.method = torch.optim.LBFGS(
            self.parameters,
            max_iter=ITERATIONS,
            history_size=MEMORY,
            tolerance_grad=0.0,
            tolerance_change=0.0,
            line_search_fn="strong_wolfe",
        )

    def step(self, index: int, loss: Callable[[], Tensor]) -> float:
        """Iterate; the loss before the first iteration. An OutOfTime of the loss leaves the best weights there were."""
        best, x = math.inf, weight_vector(self.parameters)

        def closure() -> Tensor:
            nonlocal best, x
            self.method.zero_grad()
            value = loss()
            if float(value.detach()) < best:
                best, x = float(value.detach()), weight_vector(self.parameters)
            value.backward()
            return value.detach()

        try:
            return float(self.method.step(closure))
        except OutOfTime:
            put_weights(self.parameters, x)
            raise


class BFGSSteps:
    """BFGS with Oren and Luenberger's self-scaling, limited to growth of the inverse Hessian B: 20 iterations a step.

    A B that has learnt the curvature far from the minimum is soon forgotten, so that on small networks it gets orders
    of magnitude further than limited-memory BFGS [1]_. The line search is SciPy's, for the strong Wolfe conditions.

    .. [1] J. F. Urbán, P. Stefanou, J. A. Pons, J. Comput. Phys. 523 (2025) 113656.
    """

    finished: str | None = None
    needs_residuals: ClassVar[bool] = False

    def __init__(self, flow: FlowMap) -> None:
        check_parameters(flow, "'bfgs' keeps a dense matrix")
        self.parameters = list(flow.parameters())
        self.B: Tensor | None = None

    def state_dict(self) -> dict[str, Any]:
        return {"inverse_hessian": self.B}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        B = state["inverse_hessian"]
        n = sum(w.numel() for w in self.parameters)
        if B is not None and B.shape != (n, n):
            raise ValueError(
                f"`state` has an inverse Hessian of shape {tuple(B.shape)}, not {(n, n)}: start a new run."
            )
        self.B = None if B is None else B.to(self.parameters[0])

    def step(self, index: int, loss: Callable[[], Tensor]) -> float:
        """Iterate; the loss before the first iteration. An OutOfTime of the loss leaves the weights that it got to."""
        x = weight_vector(self.parameters)
        try:
            value, g = self._evaluate(loss, x)
            for reached in self._iterates(loss, x, value, g):
                x = reached
        finally:
            put_weights(self.parameters, x)
        return value

    def _iterates(self, loss: Callable[[], Tensor], x: Tensor, value: float, g: Tensor) -> Iterator[Tensor]:
        """The weights after each iteration."""
        first = value
        for _ in range(ITERATIONS if math.isfinite(first) else 0):
            p = -g / max(1.0, float(g.abs().sum())) if self.B is None else -(self.B @ g)
            found = self._along(loss, x, p, value, float(g @ p))
            if found is None:
                if self.B is None:
                    break  # not even along the gradient does it descend: a minimum to rounding
                self.B = None
                continue
            length, value, after = found
            s, y = length * p, after - g
            if float(y @ s) > 0:
                self._update(s, y, -length * float(s @ g))
            x, g = x + s, after
            yield x

    def _along(
        self, loss: Callable[[], Tensor], x: Tensor, p: Tensor, value: float, slope: float
    ) -> tuple[float, float, Tensor] | None:
        """A step along p by the strong Wolfe conditions: its length, the loss and the gradient there."""
        trials: dict[float, tuple[float, Tensor]] = {}

        def trial(a: np.ndarray) -> tuple[float, Tensor]:
            length = float(a[0])
            if length not in trials:
                trials[length] = self._evaluate(loss, x + length * p)
            return trials[length]

        def loss_at(a: np.ndarray) -> float:
            found = trial(a)[0]
            return found if math.isfinite(found) else math.inf

        def slope_at(a: np.ndarray) -> np.ndarray:
            return np.array([float(trial(a)[1] @ p)])

        if not slope < 0:
            return None
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")  # of a search that ends without the second condition
            length = line_search(loss_at, slope_at, np.zeros(1), np.ones(1), np.array([slope]), value, maxiter=25)[0]
        if length is None or length not in trials or not trials[length][0] < value:
            return None
        return length, *trials[length]

    def _update(self, s: Tensor, y: Tensor, sBs: float) -> None:
        """Make B satisfy B y = s; sBs is sᵀB⁻¹s, which the step direction gives without B⁻¹."""
        ys = float(y @ s)
        if self.B is None:
            self.B = torch.eye(len(s), dtype=s.dtype, device=s.device) * (ys / float(y @ y))
            sBs = ys
        By = self.B @ y
        yBy = float(y @ By)
        v = s / ys - By / yBy
        self.B.addr_(By, By, alpha=-1 / yBy).addr_(v, v, alpha=yBy).div_(min(1.0, ys / sBs))
        self.B.addr_(s, s, alpha=1 / ys)

    def _evaluate(self, loss: Callable[[], Tensor], x: Tensor) -> tuple[float, Tensor]:
        put_weights(self.parameters, x)
        for w in self.parameters:
            w.grad = None
        value = loss()
        value.backward()
        gradients = [torch.zeros_like(w) if w.grad is None else w.grad for w in self.parameters]
        return float(value.detach()), torch.cat([g.reshape(-1) for g in gradients])


Optimizer = AdamSteps | LBFGSSteps | BFGSSteps | GaussNewtonSteps
"""A method whose `step` lowers an objective of the flow that it was made for, and returns the loss before it."""


STEPS: dict[str, Callable[[FlowMap, Any], Optimizer]] = {
    "adam": AdamSteps,
    "bfgs": lambda flow, options: BFGSSteps(flow),
    "lbfgs": lambda flow, options: LBFGSSteps(flow),
    "gauss-newton": lambda flow, options: GaussNewtonSteps(flow),
}
"""The optimizers of a flow by the names of the solvers that describe them."""
