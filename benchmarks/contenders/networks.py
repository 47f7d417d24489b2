"""Networks that learn a vector field from states and their derivatives by Adam, as published: MLP, HNN, D-HNN.

References
----------
.. [1] S. Greydanus, M. Dzamba, J. Yosinski, Hamiltonian Neural Networks, NeurIPS 2019.
.. [2] A. Sosanya, S. Greydanus, Dissipative Hamiltonian Neural Networks, arXiv 2201.10085.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from scipy.integrate import solve_ivp

VectorField = Callable[[np.ndarray], np.ndarray]
KINDS = ("MLP", "HNN", "D-HNN")
WIDTH, RATE, BATCH = 200, 1e-3, 500


def _layers(inputs: int, outputs: int) -> torch.nn.Sequential:
    hidden = [torch.nn.Linear(inputs, WIDTH), torch.nn.Tanh(), torch.nn.Linear(WIDTH, WIDTH), torch.nn.Tanh()]
    return torch.nn.Sequential(*hidden, torch.nn.Linear(WIDTH, outputs))


def learned_field(kind: str, x: np.ndarray, v: np.ndarray, steps: int, seed: int = 0) -> VectorField:
    """A network of two hidden layers of 200 for ẋ = v, after so many steps of Adam on batches of 500.

    Parameters
    ----------
    kind : {"MLP", "HNN", "D-HNN"}
        A vector field itself; J∇H of a network H; J∇H + ∇D of two.
    x, v : ndarray of shape (n, 2d)
        States, noisy ones too, and their derivatives.
    """
    torch.manual_seed(seed)
    m = x.shape[1]
    networks = [_layers(m, m if kind == "MLP" else 1) for _ in range(2 if kind == "D-HNN" else 1)]

    def field(z: torch.Tensor, graph: bool) -> torch.Tensor:
        if kind == "MLP":
            return networks[0](z)
        z = z.requires_grad_()
        slopes = [torch.autograd.grad(one(z).sum(), z, create_graph=graph)[0] for one in networks]
        moved = torch.cat([slopes[0][:, m // 2 :], -slopes[0][:, : m // 2]], dim=1)
        return moved if len(slopes) == 1 else moved + slopes[1]

    numbers = [weight for one in networks for weight in one.parameters()]
    optimizer = torch.optim.Adam(numbers, RATE)
    inputs, targets = (torch.tensor(a, dtype=torch.float32) for a in (x, v))
    for _ in range(steps):
        i = torch.randperm(len(inputs))[:BATCH]
        optimizer.zero_grad()
        ((field(inputs[i], True) - targets[i]) ** 2).mean().backward()
        optimizer.step()

    def found(z: np.ndarray) -> np.ndarray:
        return field(torch.tensor(z, dtype=torch.float32), False).detach().numpy()

    return found


def followed(field: VectorField, y0: np.ndarray, t: np.ndarray) -> np.ndarray:
    """States (N, 2d, n) from y0 (N, 2d) at times t, NaN from where a solution cannot be followed."""
    sol = solve_ivp(
        lambda _, z: field(z.reshape(y0.shape)).ravel(), (t[0], t[-1]), y0.ravel(), t_eval=t, rtol=1e-6, atol=1e-8
    )
    made = np.full((*y0.shape, len(t)), np.nan)
    made[..., : len(sol.t)] = sol.y.reshape(*y0.shape, -1)
    return made
