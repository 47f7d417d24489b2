"""Learners of a vector field from states and their derivatives, as published: MLP, HNN, D-HNN by Adam, and SINDy.

References
----------
.. [1] S. Greydanus, M. Dzamba, J. Yosinski, Hamiltonian Neural Networks, NeurIPS 2019.
.. [2] A. Sosanya, S. Greydanus, Dissipative Hamiltonian Neural Networks, arXiv 2201.10085.
.. [3] S. L. Brunton, J. L. Proctor, J. N. Kutz, Discovering governing equations from data by sparse identification of
   nonlinear dynamical systems, PNAS 113 (2016) 3932–3937.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations_with_replacement

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


def sparse_field(x: np.ndarray, v: np.ndarray, angles: bool, held_out: float = 0.2) -> VectorField:
    """SINDy: ẋ = v as sparse sums of cubic polynomials, of angles of sines and cosines too.

    Coefficients below a threshold are left out in turn, ten times; the last states, not fitted to, choose it.
    """
    m, n = x.shape[1], round((1 - held_out) * len(x))
    d = m // 2

    def library(z: np.ndarray) -> np.ndarray:
        """The terms at states (n, m): (n, K)."""
        columns = [np.ones(len(z))]
        for degree in (1, 2, 3):
            columns += [np.prod(z[:, list(some)], axis=1) for some in combinations_with_replacement(range(m), degree)]
        if angles:
            turned = [z[:, i] for i in range(d)] + [z[:, i] - z[:, j] for i in range(d) for j in range(i)]
            columns += [f(angle) * other for angle in turned for f in (np.sin, np.cos) for other in (1.0, *z[:, d:].T)]
        return np.stack(columns, axis=1)

    terms, units = library(x), np.linalg.norm(library(x[:n]), axis=0) / np.sqrt(n)
    best, least = np.zeros((terms.shape[1], m)), np.inf
    for threshold in np.geomspace(1e-3, 1.0, 13):
        found = np.linalg.lstsq(terms[:n] / units, v[:n], rcond=None)[0]
        for _ in range(10):
            kept = np.abs(found) >= threshold * np.std(v[:n], axis=0)
            found = np.where(kept, found, 0.0)
            for i in range(m):
                found[kept[:, i], i] = np.linalg.lstsq((terms[:n] / units)[:, kept[:, i]], v[:n, i], rcond=None)[0]
        error = float(np.sum(((terms[n:] / units) @ found - v[n:]) ** 2))
        if error < least:
            best, least = found / units[:, None], error
    return lambda z: library(z) @ best


def followed(field: VectorField, y0: np.ndarray, t: np.ndarray) -> np.ndarray:
    """States (N, 2d, n) from y0 (N, 2d) at times t, NaN from where a solution cannot be followed."""
    sol = solve_ivp(
        lambda _, z: field(z.reshape(y0.shape)).ravel(), (t[0], t[-1]), y0.ravel(), t_eval=t, rtol=1e-6, atol=1e-8
    )
    made = np.full((*y0.shape, len(t)), np.nan)
    made[..., : len(sol.t)] = sol.y.reshape(*y0.shape, -1)
    return made
