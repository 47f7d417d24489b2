"""Complex fields on a periodic grid, i ψ' = ω(−i∇)ψ + f'(|ψ|²)ψ, as Hamiltonian systems of their two parts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp

from sympflow.arguments import real_number
from sympflow.arrays import Array, concatenate, library, like
from sympflow.hamiltonian.jumps import check_continuous
from sympflow.hamiltonian.lattice import checked_shape
from sympflow.hamiltonian.linear_part import SpectralPart, Transform
from sympflow.hamiltonian.local import MOST_DENSE, LocalHamiltonian, check_memory, checked_params, numbered, parsed


class WaveFunctionHamiltonian(LocalHamiltonian):
    """H = ½ Σ_k ω(k)(Q_k² + P_k²) + Σ_sites f(ρ), ρ = (q² + p²)/2, see `HamiltonianSystem.schroedinger`."""

    loops = "schroedinger"
    separable = False
    has_third_derivative = False
    quadratic_kinetic = False
    inverse_mass = None
    instead = "a method with the exact linear flow, such as 'impulse' or 'linear_kahan_li6'"

    def __init__(self, onsite: Any, dispersion: Any, shape: Any, length: Any, params: Any) -> None:
        self.grid = checked_shape(shape)
        self.ndof = math.prod(self.grid)
        check_memory(float(self.ndof), "`shape`")
        self.length = _checked_length(length, self.grid)
        self.params = checked_params(params, self.grid)
        self.c = numbered("c", tuple(self.params))
        self.rho, self.k = (sp.Symbol(name, real=True) for name in ("rho", "k"))
        values = dict(zip(self.params, self.c, strict=True))
        for name in ("rho", "k"):
            if name in values:
                raise ValueError(f"`params` gives a value to {name!r}, which is a variable: rename the parameter.")
        self.f = sp.S.Zero
        if onsite is not None:
            self.f = parsed("onsite", onsite, {"rho": self.rho, **values}, "-rho**2/2")
        numbers = {name: s for name, s in values.items() if not isinstance(self.params[name], np.ndarray)}
        self.w = parsed("dispersion", dispersion, {"k": self.k, **numbers}, "k**2/2")
        used = self.f.free_symbols | self.w.free_symbols
        if unused := [name for name, s in values.items() if s not in used]:
            raise ValueError(f"`params` has {unused[0]!r}, which no expression uses: remove it.")
        self._check_continuous()
        self._set_rates()

    def _set_rates(self) -> None:
        self.transform = Transform(self.grid, ("periodic",) * len(self.grid))
        values = {s: v for s, v in zip(self.c, self.params.values(), strict=True) if not isinstance(v, np.ndarray)}
        w = sp.lambdify(self.k, self.w.xreplace(values), np)
        waves = []
        for axis, (n, length) in enumerate(zip(self.grid, self.length, strict=True)):
            k = self.transform.angles(axis) * (n / length)
            with np.errstate(all="ignore"):
                of_axis, other = w(k), w(-k)
            size = float(np.max(np.abs(of_axis), initial=0.0, where=np.isfinite(of_axis)))
            if not np.allclose(of_axis, other, rtol=1e-12, atol=1e-12 * size, equal_nan=True):
                raise ValueError(
                    f"`dispersion` {self.w} must be an even function of k, such as 'k**2/2' or '1 - cos(k)': waves to "
                    "both sides are taken together."
                )
            waves.append(np.broadcast_to(np.asarray(of_axis, dtype=float), (n,)))
        self.rates = np.ascontiguousarray(self.transform.total(waves))
        if not np.isfinite(self.rates).all():
            raise ValueError("`dispersion` must be finite at all wave numbers k of the grid, 0 among them; it is not.")

    def identity_parts(self) -> Any:
        return [self.grid, self.length, self.f, self.w, list(self.params.items())]

    def _take(self, params: Mapping[str, Any]) -> None:
        self.params = checked_params(params, self.grid)
        self._check_continuous()
        self._set_rates()

    def _check_continuous(self) -> None:
        """Refuse f and ω that jump."""
        given = dict(zip(self.c, self.params.values(), strict=True))
        for argument, f in (("onsite", self.f), ("dispersion", self.w)):
            check_continuous(argument, f, [self.rho], given, dict(zip(self.c, self.params, strict=True)))

    def hamiltonian(self, y: Array) -> Array:
        return self.energy_density(y).sum(tuple(range(-len(self.grid), 0)))

    def energy_density(self, y: Array, *t: Array) -> Array:
        q, p = self._fields(y)
        return (q * self._linear(q) + p * self._linear(p)) / 2 + self._of_density(0, q, p)

    def gradient(self, y: Array) -> Array:
        q, p = self._fields(y)
        slope = self._of_density(1, q, p)
        flat = [(self._linear(x) + slope * x).reshape(*y.shape[:-1], self.ndof) for x in (q, p)]
        return concatenate(flat)

    def hessian(self, y: Array) -> Array:
        """∇²H, dense: (..., 2d) to (..., 2d, 2d)."""
        d = self.ndof
        if np.prod(y.shape, dtype=float) * 2 * d > MOST_DENSE:
            raise ValueError(
                f"`system` has {d:,} sites, and its dense ∇²H has {4.0 * d * d:.3g} entries for each state: take a "
                "method with the exact linear flow, such as 'linear_kahan_li6', or fewer sites."
            )
        q, p = self._fields(y)
        slope, bend = (self._of_density(k, q, p).reshape(*y.shape[:-1], d) for k in (1, 2))
        q, p = y[..., :d], y[..., d:]
        basis = like(np.eye(d), y)
        L = self._linear(basis.reshape(d, *self.grid)).reshape(d, d)
        diagonals = [[slope + bend * q * q, bend * q * p], [bend * q * p, slope + bend * p * p]]
        rows = [
            concatenate([x[..., None] * basis + (L if i == j else 0 * L) for j, x in enumerate(row)])
            for i, row in enumerate(diagonals)
        ]
        return concatenate(rows, -2)

    def linear_and_rest(self, interval: float) -> tuple[SpectralPart, list[Any]]:
        kinds = np.where(self.rates != 0, "oscillator", "idle")
        linear = SpectralPart(self.transform, self.rates[None], kinds[None], None, interval)
        return linear, [PhaseTurn(self)] if self.f != 0 else []

    def turned(self, y: Array, s: Any) -> Array:
        """The flow of Σ f(ρ) over a time s, (..., 1) or one for all: ψ turns by f'(ρ)s at each site."""
        q, p = self._fields(y)
        angle, xp = self._of_density(1, q, p).reshape(*y.shape[:-1], self.ndof) * s, library(y)
        half_turns = xp.round(angle / math.pi)
        t = xp.tan((angle - math.pi * half_turns) / 2)
        sign = 1 - 2 * (half_turns - 2 * xp.floor(half_turns / 2))
        q, p = sign * y[..., : self.ndof], sign * y[..., self.ndof :]
        q = q + t * p
        p = p - 2 * t / (1 + t * t) * q
        return concatenate([q + t * p, p])

    def _fields(self, y: Array) -> tuple[Array, Array]:
        shape = (*y.shape[:-1], *self.grid)
        return y[..., : self.ndof].reshape(shape), y[..., self.ndof :].reshape(shape)

    def _linear(self, x: Array) -> Array:
        """ω(−i∇)x: (..., *shape)."""
        return self.transform.back(like(self.rates, x) * self.transform.forth(x))

    def _of_density(self, order: int, q: Array, p: Array) -> Array:
        """The derivative of f of that order at each site."""
        rho = (q * q + p * p) / 2
        if order not in self._derivatives:
            self._derivatives[order] = sp.diff(self.f, self.rho, order)
        f = self._derivatives[order]
        constants = [like(np.asarray(c, dtype=float), q) for c in self.params.values()]
        return 0 * rho + self._values(f"onsite {order}", lambda: [f], (self.rho, *self.c), rho, *constants)[0]

    @cached_property
    def _derivatives(self) -> dict[int, sp.Expr]:
        return {}


class PhaseTurn:
    """Σ f(ρ) as a part of H with a known flow: see `sympflow.hamiltonian.parts`."""

    of_positions, turns, timed = False, True, False

    def __init__(self, definition: WaveFunctionHamiltonian) -> None:
        self.turned = definition.turned


def _checked_length(length: Any, shape: tuple[int, ...]) -> tuple[float, ...]:
    """The length of each axis; by default one for each site."""
    if length is None:
        return tuple(map(float, shape))
    lengths = tuple(length) if isinstance(length, list | tuple | np.ndarray) else (length,) * len(shape)
    if len(lengths) != len(shape) or not all(real_number(a) and 0 < a < 1e100 for a in lengths):
        raise ValueError(
            f"`length` must be positive and finite, or one such number for each of the {len(shape)} axes; got "
            f"{length!r}."
        )
    return tuple(map(float, lengths))
