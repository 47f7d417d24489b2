"""The weights of a flow as one vector, which optimizers move."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def weight_vector(parameters: Sequence[Tensor]) -> Tensor:
    """A copy of the parameters, one after another: (n,)."""
    return torch.cat([w.detach().reshape(-1) for w in parameters])


@torch.no_grad()
def put_weights(parameters: Sequence[Tensor], x: Tensor) -> None:
    """Give the parameters the values x (n,)."""
    for w, part in zip(parameters, x.split([w.numel() for w in parameters]), strict=True):
        w.copy_(part.view_as(w))
