"""Coefficients of a palindromic splitting that are functions of t, over ranges of t in which fast modes turn often."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from sympflow.flow.coefficients import FreeTable
from sympflow.flow.potentials import Time


class Column(FreeTable):
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
    """

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
        bound = terms if total == "always" else int(total == "start")
        super().__init__(n, terms, True, bound, None if total is None else 1.0, dtype, device)
        self.n, self.terms, self.dt, self.power, self.total = n, terms, dt, power, total

    def values(self, t: Time) -> Tensor:
        """t^m c_i(t/Δt): (n, …), the shape of t behind."""
        c = self.table
        t = torch.as_tensor(t, dtype=c.dtype, device=c.device)
        return t**self.power * torch.tensordot(c, torch.stack(self._functions(t / self.dt)), dims=1)

    def at(self, t: np.ndarray) -> np.ndarray:
        """`values` of an array of times: (…, n)."""
        c = self.table.detach().cpu().double().numpy()
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
