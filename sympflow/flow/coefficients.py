"""Columns of a splitting table whose numbers are trained polynomials in t."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from sympflow.flow.potentials import Time
from sympflow.flow.tables import Total, free_numbers
from sympflow.flow.weights import doubles


class FreeTable(nn.Module):
    """c_i(τ) = Σ_k c_ik f_k(τ), i = 1 … n, which enter as t^power c_i(t/Δt); the free c_ik are a parameter.

    In a palindrome, c_i = c_{n+1−i}. With a `total`, Σ c_i is 1 for every value of the parameters: at τ = 0 ("start"),
    or at every τ ("always"). Only the c_i that are `present` are not always 0; by default all are.
    """

    basis: Tensor
    offset: Tensor

    def __init__(
        self,
        n: int,
        exponents: Sequence[int],
        power: int,
        palindromic: bool = True,
        total: Total = None,
        present: Sequence[int] | None = None,
        *,
        dt: float,
        **like: Any,
    ) -> None:
        super().__init__()
        self.n, self.exponents, self.power, self.dt = n, tuple(exponents), power, dt
        self.total, self.present = total, present
        self._free, basis, offset = free_numbers(n, len(self.exponents), palindromic, total, present)
        like = {"dtype": torch.float64, **like}
        self.register_buffer("basis", torch.as_tensor(basis, **like), persistent=False)
        self.register_buffer("offset", torch.as_tensor(offset, **like), persistent=False)
        self.free = nn.Parameter(torch.zeros(len(self._free), **like))

    @property
    def table(self) -> Tensor:
        """All c_ik: (n, K)."""
        return self.offset + self.basis @ self.free

    @property
    def numbers(self) -> np.ndarray:
        """All c_ik as an array of float64, the same bits wherever the parameter is."""
        basis, offset, free = map(doubles, (self.basis, self.offset, self.free))
        return offset + basis @ free

    def _functions(self, tau: Any) -> list[Any]:
        """The f_k(τ), K of them."""
        raise NotImplementedError

    def functions(self, t: np.ndarray) -> np.ndarray:
        """The f_k at times t: (…, K)."""
        return np.stack(self._functions(np.asarray(t, dtype=float) / self.dt), axis=-1)

    def affine(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """t^power c(t/Δt) as a function of the parameters: offset (J, n) and design (J, n, f)."""
        basis, offset = map(doubles, (self.basis, self.offset))
        weights = np.asarray(t)[:, None] ** self.power * self.functions(t)
        return weights @ offset.T, np.einsum("nkf,jk->jnf", basis, weights, optimize=True)

    @torch.no_grad()
    def set(self, table: np.ndarray) -> None:
        """Take the free c_ik from a table (n, K)."""
        self.free.copy_(torch.tensor([float(table[i, k]) for i, k in self._free], dtype=torch.float64))


class Coefficients(FreeTable):
    """c_i(τ) = Σ_k c_ik τ^(e_k), i = 1 … n: a column of a splitting table."""

    def set_constant(self, c: Sequence[Any]) -> None:
        """Let c_i(τ) be c_i at every τ."""
        table = np.zeros(tuple(self.offset.shape))
        table[:, 0] = [float(c_i) for c_i in c]
        self.set(table)

    def _functions(self, tau: Any) -> list[Any]:
        return [tau**e for e in self.exponents]

    def value(self, i: int, t: Time) -> Time:
        """t^m c_i(t/Δt)."""
        c = self.offset[i] + self.basis[i] @ self.free
        tau = t / self.dt
        return t**self.power * sum(c_k * tau**e for c_k, e in zip(c, self.exponents, strict=True))

    def rate(self, i: int, t: Time) -> Time:
        """Its time derivative."""
        c = self.offset[i] + self.basis[i] @ self.free
        tau, m = t / self.dt, self.power
        return t ** (m - 1) * sum((m + e) * c_k * tau**e for c_k, e in zip(c, self.exponents, strict=True))


class Column(FreeTable):
    """c_i(τ) = c_i0 + τ² Σ_k c_ik T_{k−1}(2τ² − 1), of a palindrome.

    Even polynomials make it time-reversible; Chebyshev's T_k keep the high degrees of filters well conditioned.
    """

    def values(self, t: Time) -> Tensor:
        """t^m c_i(t/Δt): (n, …), the shape of t behind."""
        c = self.table
        t = torch.as_tensor(t, dtype=c.dtype, device=c.device)
        return t**self.power * torch.tensordot(c, torch.stack(self._functions(t / self.dt)), dims=1)

    def at(self, t: np.ndarray) -> np.ndarray:
        """`values` of an array of times: (…, n)."""
        c = doubles(self.table)
        return np.asarray(t)[..., None] ** self.power * (self.functions(t) @ c.T)

    def _functions(self, tau: Any) -> list[Any]:
        functions, terms = [1 + 0 * tau], len(self.exponents)
        if terms > 1:
            x, square = 2 * tau**2 - 1, tau**2
            chebyshev = [1 + 0 * tau, x]
            while len(chebyshev) < terms - 1:
                chebyshev.append(2 * x * chebyshev[-1] - chebyshev[-2])
            functions += [square * T for T in chebyshev[: terms - 1]]
        return functions
