"""Normal modes of lattices by fast Fourier, sine and cosine transforms: exact linear flows at O(d log d)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from scipy import fft, fftpack

from sympflow.arrays import Array, is_tensor, like, moveaxis
from sympflow.hamiltonian.linear_part import ZERO, NormalModes


class Transform:
    """The orthonormal transform W of fields on a lattice to its plane or standing waves, axis by axis."""

    def __init__(self, shape: tuple[int, ...], boundary: tuple[str, ...]) -> None:
        self.shape, self.boundary = shape, boundary

    def angles(self, axis: int) -> np.ndarray:
        """θ of the waves along an axis, the phase from one site to the next: (n,), in 0 … π."""
        n = self.shape[axis]
        k = np.arange(n)
        return {
            "periodic": 2 * np.pi * ((k + 1) // 2) / n,
            "fixed": np.pi * (k + 1) / (n + 1),
            "free": np.pi * k / n,
        }[self.boundary[axis]]

    def total(self, per_axis: Sequence[np.ndarray]) -> np.ndarray:
        """The sum of values by the waves of each axis, (n, …) each: (*shape, …)."""
        total: Any = 0.0
        for axis, values in enumerate(per_axis):
            places = [-1 if a == axis else 1 for a in range(len(self.shape))]
            total = total + values.reshape(*places, *values.shape[1:])
        return np.broadcast_to(total, (*self.shape, *per_axis[0].shape[1:]))

    def forth(self, x: Array) -> Array:
        """W x: (..., *shape), each."""
        for axis, kind in enumerate(self.boundary):
            x = self._one(x, axis, kind, False)
        return x

    def back(self, x: Array) -> Array:
        """Wᵀx: (..., *shape), each."""
        for axis, kind in enumerate(self.boundary):
            x = self._one(x, axis, kind, True)
        return x

    def _one(self, x: Array, axis: int, kind: str, back: bool) -> Array:
        at = axis - len(self.shape)
        if is_tensor(x):
            x = x.movedim(at, -1)
            return (_backwards if back else _forwards)(x, kind).movedim(-1, at)
        if kind == "fixed":
            return fft.dst(x, 1, axis=at, norm="ortho")
        if kind == "free":
            return (fft.idct if back else fft.dct)(x, 2, axis=at, norm="ortho")
        scale = self._scales[axis].astype(x.dtype, copy=False)
        return fftpack.irfft(x / scale, axis=at) if back else fftpack.rfft(x, axis=at) * scale

    @cached_property
    def _scales(self) -> list[np.ndarray]:
        """The norms that `fftpack.rfft` leaves out, for each axis."""
        scales = []
        for axis, n in enumerate(self.shape):
            scale = np.full(n, math.sqrt(2 / n))
            scale[0] = math.sqrt(1 / n)
            if n % 2 == 0:
                scale[-1] = math.sqrt(1 / n)
            scales.append(scale.reshape([-1] + [1] * (len(self.shape) - 1 - axis)))
        return scales


def _forwards(x: Any, kind: str) -> Any:
    """W along the last axis of a tensor."""
    import torch

    n = x.shape[-1]
    if kind == "fixed":
        nothing = x.new_zeros((*x.shape[:-1], 1))
        odd = torch.cat([nothing, x, nothing, -x.flip(-1)], -1)
        return -torch.fft.rfft(odd).imag[..., 1 : n + 1] * math.sqrt(1 / (2 * (n + 1)))
    if kind == "free":
        even = torch.fft.rfft(torch.cat([x, x.flip(-1)], -1))[..., :n]
        return (even * _half_shift(x, -1)).real * _cosine_norms(x) / 2
    F = torch.fft.rfft(x)
    pairs = torch.view_as_real(F[..., 1 : (n + 1) // 2]).flatten(-2) * math.sqrt(2 / n)
    last = [F[..., n // 2 :].real * math.sqrt(1 / n)] if n % 2 == 0 else []
    return torch.cat([F[..., :1].real * math.sqrt(1 / n), pairs, *last], -1)


def _backwards(x: Any, kind: str) -> Any:
    """Wᵀ along the last axis of a tensor."""
    import torch

    n = x.shape[-1]
    if kind == "fixed":
        return _forwards(x, kind)
    if kind == "free":
        F = 2 * (x / _cosine_norms(x)) * _half_shift(x, 1)
        return torch.fft.irfft(torch.cat([F, 0 * F[..., :1]], -1), n=2 * n)[..., :n]
    pairs = x[..., 1 : 1 + 2 * ((n - 1) // 2)] * math.sqrt(n / 2)
    F = torch.view_as_complex(pairs.unflatten(-1, (-1, 2)).contiguous())
    ends = [x[..., n - 1 :] * math.sqrt(n)] if n % 2 == 0 else []
    return torch.fft.irfft(torch.cat([x[..., :1] * math.sqrt(n) + 0j, F, *(e + 0j for e in ends)], -1), n=n)


def _half_shift(x: Any, sign: int) -> Any:
    """e^{±iθ/2} of standing waves between free ends."""
    import torch

    n = x.shape[-1]
    return torch.exp(0.5j * sign * math.pi / n * torch.arange(n, dtype=x.dtype, device=x.device))


def _cosine_norms(x: Any) -> Any:
    n = x.shape[-1]
    norms = x.new_full((n,), math.sqrt(2 / n))
    norms[0] = math.sqrt(1 / n)
    return norms


class SpectralPart(NormalModes):
    """A quadratic H of fields on a lattice, diagonal by a `Transform` and a small matrix for each wave."""

    dense = diagonal = False

    def __init__(
        self,
        transform: Transform,
        rates: np.ndarray,
        kinds: np.ndarray,
        matrices: np.ndarray | None = None,
        interval: float = 0.0,
    ) -> None:
        self.transform, self.interval = transform, interval
        self.fields = len(rates)
        self.rates, self.kinds = rates.ravel(), kinds.ravel()
        self.ndof = self.rates.size
        self.center = np.zeros(self.ndof)
        self._matrices = matrices
        self._inverses = None if matrices is None else np.linalg.inv(matrices)

    @classmethod
    def of_matrices(
        cls, transform: Transform, inverse_mass: np.ndarray, stiffness: np.ndarray, interval: float = 0.0
    ) -> SpectralPart:
        """The part ½ pᵀBp + ½ qᵀKq."""
        L = np.sqrt(inverse_mass)
        squares, V = np.linalg.eigh(L[:, None] * stiffness * L)
        squares[abs(squares) <= ZERO * abs(squares).max(initial=0.0)] = 0.0
        unit = np.where(squares != 0, abs(squares) ** 0.25, 1.0)
        kinds = np.where(squares > 0, "oscillator", np.where(squares < 0, "hyperbolic", "free"))
        rates = np.where(squares != 0, np.sqrt(abs(squares)), 1.0)
        matrices = L[:, None] * V / unit[..., None, :]
        return cls(transform, np.moveaxis(rates, -1, 0), np.moveaxis(kinds, -1, 0), matrices, interval)

    @cached_property
    def modes(self) -> np.ndarray:
        """C, dense: (d, d)."""
        return self.positions(np.eye(self.ndof)).T

    @cached_property
    def inverse_modes(self) -> np.ndarray:
        """C⁻¹, dense: (d, d)."""
        return self.coordinates(np.eye(self.ndof)).T

    @cached_property
    def classes(self) -> np.ndarray:  # type: ignore[override]
        """To which of the distinct frequencies a mode belongs: (d,) int."""
        keys = np.rec.fromarrays([self.kinds, self.rates])
        return np.unique(keys, return_inverse=True)[1].reshape(-1)

    # C and its inverse, on (..., d)

    def positions(self, X: Array) -> Array:
        """C X."""
        return self._flat(self.transform.back(self._mixed(self._matrices, self._on_waves(X), False)))

    def coordinates(self, x: Array) -> Array:
        """C⁻¹x."""
        return self._flat(self._mixed(self._inverses, self.transform.forth(self._on_waves(x)), False))

    def momenta(self, Y: Array) -> Array:
        """C⁻ᵀY."""
        return self._flat(self.transform.back(self._mixed(self._inverses, self._on_waves(Y), True)))

    def slopes(self, g: Array) -> Array:
        """Cᵀg."""
        return self._flat(self._mixed(self._matrices, self.transform.forth(self._on_waves(g)), True))

    def _on_waves(self, x: Array) -> Array:
        return x.reshape(*x.shape[:-1], self.fields, *self.transform.shape)

    def _flat(self, x: Array) -> Array:
        return x.reshape(*x.shape[: x.ndim - 1 - len(self.transform.shape)], self.ndof)

    def _mixed(self, matrices: np.ndarray | None, x: Array, transposed: bool) -> Array:
        """The matrix of each wave times the fields (..., F, *shape)."""
        if matrices is None:
            return x
        A = like(matrices.swapaxes(-1, -2) if transposed else matrices, x)
        if self.fields == 1:
            return x * A[..., 0, 0]
        axis = -1 - len(self.transform.shape)
        return moveaxis((A @ moveaxis(x, axis, -1)[..., None])[..., 0], -1, axis)


def dispersion(couplings: Mapping[int, np.ndarray], angles: np.ndarray) -> np.ndarray:
    """Σ_k κ_k (2 − 2 cos kθ), of bonds ½ rᵀκ_k r over k sites: (n,) to (n, F, F)."""
    total: Any = 0.0
    for k, kappa in couplings.items():
        total = total + (4 * np.sin(k * angles / 2) ** 2)[:, None, None] * kappa
    return total
