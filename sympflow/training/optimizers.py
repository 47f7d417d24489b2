"""What turns a loss into a step: one small class an optimizer, registered by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from sympflow.flow.flow_map import FlowMap
from sympflow.training.config import TrainingConfig
from sympflow.training.marquardt import GaussNewton
from sympflow.training.quasi_newton import BFGS, LBFGS


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

    def state_dict(self) -> dict[str, Any]:
        return self.method.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.method.load_state_dict(state)


def optimizer(flow: FlowMap, config: TrainingConfig) -> Any:
    """The optimizer that the configuration names."""
    named = {"adam": Adam, "bfgs": BFGS, "lbfgs": LBFGS, "gauss-newton": GaussNewton}
    return named[config.optimizer](flow, config)
