"""What turns a loss into a step: one small class an optimizer, registered by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from sympflow.flow.base import FlowMap
from sympflow.training.config import TrainingConfig


class Adam:
    """Adam (Kingma & Ba 2015) with a schedule and gradient clipping."""

    def __init__(self, flow: FlowMap, config: TrainingConfig) -> None:
        self.config = config
        self.parameters = list(flow.parameters())
        self.method = torch.optim.Adam(self.parameters, lr=config.learning_rate, fused=True)

    def step(self, index: int, loss: Callable[[], Tensor]) -> float:
        """Take a step; the loss before it."""
        self.method.zero_grad(set_to_none=True)
        value = loss()
        value.backward()
        if self.config.clip is not None:
            torch.nn.utils.clip_grad_norm_(self.parameters, self.config.clip)
        self.method.param_groups[0]["lr"] = self.config.rate(index)
        self.method.step()
        return float(value.detach())


class LBFGS:
    """L-BFGS (Nocedal & Wright, Numerical Optimization, ch. 7) with a strong-Wolfe search, 20 iterations a step."""

    # torch discards curvature pairs with yᵀs < 1e-10, which would end the progress at losses of about 1e-7.
    MAGNIFICATION = 1e8

    def __init__(self, flow: FlowMap, config: TrainingConfig) -> None:
        self.method = torch.optim.LBFGS(
            list(flow.parameters()),
            lr=1.0,
            max_iter=20,
            history_size=100,
            tolerance_grad=0.0,
            tolerance_change=0.0,
            line_search_fn="strong_wolfe",
        )

    def step(self, index: int, loss: Callable[[], Tensor]) -> float:
        """Take a step; the loss before it."""

        def closure() -> Tensor:
            self.method.zero_grad(set_to_none=True)
            value = loss() * self.MAGNIFICATION
            value.backward()
            return value

        return float(self.method.step(closure).detach()) / self.MAGNIFICATION


def optimizer(flow: FlowMap, config: TrainingConfig) -> Any:
    """The optimizer that the configuration names."""
    return {"adam": Adam, "lbfgs": LBFGS}[config.optimizer](flow, config)
