"""Coefficients of a palindromic splitting that are functions of t, over ranges of t in which fast modes turn often."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from sympflow.flow.potentials import Time


class Column(nn.Module):
    """c_i(τ) = c_i0 + τ² Σ_k c_ik T_{k−1}(2τ² − 1), i = 1 … n, c_i = c_{n+1−i}; it enters as t^m c_i(t/Δt).

    Even polynomials in τ, so that a palindrome of such maps is time-reversible; Chebyshev's T_k keep them well
    conditioned at the degrees that a filter needs whose argument runs over several periods.

    Parameters
    ----------
    n : int
        Number of maps.
    terms : int
        Number of basis functions, at least 1.
    dt : float
        Δt.
    power : int
        m.
    total : {"always", "start", None}
        Whether Σ c_i(τ) = 1 for every τ, or Σ c_i(0) = 1, whatever the parameters.

    Attributes
    ----------
    free : (f,)
        The free c_ik, i slowest.
    basis, offset : (n, K, f), (n, K)
        c = offset + basis · free.
    """

    basis: Tensor
    offset: Tensor

    def __init__(
        self,
        n: int,
        terms: int,
        dt: float,
        power: int,
        total: str | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        self.n, self.terms, self.dt, self.power, self.total = n, terms, dt, power, total
        representative = np.minimum(np.arange(n), np.arange(n)[::-1])
        count = np.bincount(representative)
        last = len(count) - 1
        bound = range(terms) if total == "always" else range(total == "start")
        self._free = [(i, k) for i in range(last + 1) for k in range(terms) if i != last or k not in bound]
        basis, offset = np.zeros((n, terms, len(self._free))), np.zeros((n, terms))
        for column, (i, k) in enumerate(self._free):
            basis[representative == i, k, column] = 1.0
            if k in bound:
                basis[representative == last, k, column] = -count[i] / count[last]
        if total is not None:
            offset[representative == last, 0] = 1.0 / count[last]
        like: dict[str, Any] = {"dtype": dtype, "device": device}
        self.register_buffer("basis", torch.as_tensor(basis, **like), persistent=False)
        self.register_buffer("offset", torch.as_tensor(offset, **like), persistent=False)
        self.free = nn.Parameter(torch.zeros(len(self._free), **like))

    @torch.no_grad()
    def set(self, table: np.ndarray) -> None:
        """Take the free c_ik from a table (n, K)."""
        self.free.copy_(torch.as_tensor([float(table[i, k]) for i, k in self._free]))

    def values(self, t: Time) -> Tensor:
        """t^m c_i(t/Δt): (n, …), the shape of t behind."""
        c = self.offset + self.basis @ self.free
        t = torch.as_tensor(t, dtype=c.dtype, device=c.device)
        return t**self.power * torch.tensordot(c, torch.stack(self._functions(t / self.dt)), dims=1)

    def at(self, t: np.ndarray) -> np.ndarray:
        """`values` of an array of times: (…, n)."""
        c = (self.offset + self.basis @ self.free).detach().cpu().double().numpy()
        return np.asarray(t)[..., None] ** self.power * (self.functions(t) @ c.T)

    def functions(self, t: np.ndarray) -> np.ndarray:
        """The basis functions at times t: (…, K)."""
        return np.stack(self._functions(np.asarray(t, dtype=float) / self.dt), axis=-1)

    def affine(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`at` as a function of the parameters: offset (J, n) and design (J, n, f)."""
        basis, offset = (a.cpu().double().numpy() for a in (self.basis, self.offset))
        weights = np.asarray(t)[:, None] ** self.power * self.functions(t)
        return weights @ offset.T, np.einsum("nkf,jk->jnf", basis, weights)

    def _functions(self, tau: Any) -> list[Any]:
        functions = [1 + 0 * tau]
        if self.terms > 1:
            x, square = 2 * tau**2 - 1, tau**2
            chebyshev = [1 + 0 * tau, x]
            while len(chebyshev) < self.terms - 1:
                chebyshev.append(2 * x * chebyshev[-1] - chebyshev[-2])
            functions += [square * T for T in chebyshev[: self.terms - 1]]
        return functions
