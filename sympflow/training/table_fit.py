"""The fit of a primed flow's table to labels, as a least-squares problem."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from sympflow.flow.coefficients import Coefficients
from sympflow.flow.primed import PrimedFlow
from sympflow.hamiltonian.monomials import in_monomials
from sympflow.training.labels import Labels
from sympflow.training.levenberg_marquardt import Minimum, levenberg_marquardt
from sympflow.training.losses import Objective
from sympflow.training.table_jacobian import TableStep
from sympflow.training.weight_vector import put_weights

SPREAD = 0.25  # of random coefficients about those of equal steps
WIDE_SPREAD = 2.0  # without force gradients, where an order above 2 needs negative ones
PROCESSOR_SPREAD = 0.1
STIFFNESS = 1e-3  # how reluctantly a table is made to vary with t where that is not called for


class Fit:
    """Residuals of parameters θ whose sum of squares is to be small."""

    def residuals(self, theta: np.ndarray) -> np.ndarray:
        """(m,)."""
        raise NotImplementedError

    def linearized(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The residuals and their Jacobian, (m, f)."""
        raise NotImplementedError

    def minimize(self, theta: np.ndarray, iterations: int, stop: Callable[[], bool], thorough: bool = False) -> Minimum:
        """Least squares from θ; a thorough one goes on where little is gained, as along a narrow curved valley."""
        patience, gain = (20, 1e-3) if thorough else (10, 1e-2)
        limits: dict[str, Any] = {"iterations": iterations, "patience": patience, "gain": gain, "stop": stop}
        return levenberg_marquardt(self.residuals, self.linearized, theta, **limits)


class StackedFit(Fit):
    """Several fits of the same parameters, with a weight each."""

    def __init__(self, *parts: tuple[float, Fit]) -> None:
        self.parts = parts

    def residuals(self, theta: np.ndarray) -> np.ndarray:
        return np.concatenate([math.sqrt(weight) * fit.residuals(theta) for weight, fit in self.parts])

    def linearized(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pieces = [(math.sqrt(weight), *fit.linearized(theta)) for weight, fit in self.parts]
        return np.concatenate([w * r for w, r, _ in pieces]), np.concatenate([w * J for w, _, J in pieces])


class LossFit(Fit):
    """The residuals of a `Loss` (the flow's residual, Hamiltonian matching, labels at any times) at given points."""

    def __init__(self, table: Table, objective: Objective) -> None:
        self.table, self.objective = table, objective

    def residuals(self, theta: np.ndarray) -> np.ndarray:
        self.table.assign(theta)
        return self.objective.residuals().numpy()

    def linearized(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.table.assign(theta)
        r, J = self.objective.linearized()
        return r.detach().numpy(), J.detach().numpy()


class TableFit(Fit):
    """The labels' residuals as a function of parameters on which the table at each time depends affinely.

    Parameters
    ----------
    step : TableStep
    labels : Labels
    offset, design : (J, n), (J, n, f)
        The coefficients at the label times are offset + design · θ.
    unit : (2d,)
        Residuals are divided by it.
    weight : (J,)
    slope : (J, N, 2d), optional
        Of the energy, in such units that an error δ counts by slope·δ besides.
    """

    def __init__(
        self,
        step: TableStep,
        labels: Labels,
        offset: np.ndarray,
        design: np.ndarray,
        unit: np.ndarray,
        weight: np.ndarray,
        slope: np.ndarray | None = None,
    ) -> None:
        self.step, self.offset, self.design = step, offset, design
        self.times, self.count = len(labels.t), len(labels.x)
        self._x = np.tile(labels.x.T, (1, self.times))
        self._y = np.ascontiguousarray(labels.y.reshape(-1, labels.x.shape[1]).T)
        # The sum of squares is a mean over states and times.
        each = np.repeat(weight, self.count) / math.sqrt(self.times * self.count)
        self._scale = each / unit[:, None]
        self._slope = None if slope is None else each * slope.reshape(-1, slope.shape[-1]).T

    def coefficients(self, theta: np.ndarray) -> np.ndarray:
        """(n, P), P = J N."""
        return np.repeat((self.offset + self.design @ theta).T, self.count, axis=1)

    def residuals(self, theta: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            y = self.step(self.coefficients(theta), self._x)
            return self._rows(self._errors(y - self._y)).ravel()

    @np.errstate(all="ignore")  # as in the residuals: what is not finite is rejected
    def linearized(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        y, J = self.step.with_jacobian(self.coefficients(theta), self._x)
        by_table = self._rows(self._errors(J))  # (J, (2d + 1) N, n)
        J = (by_table @ self.design).reshape(-1, self.design.shape[-1])
        return self._rows(self._errors(y - self._y)).ravel(), J

    def _errors(self, change: np.ndarray) -> np.ndarray:
        """Of each coordinate and, with a slope, of the energy: (..., 2d + 1, P), without one (..., 2d, P)."""
        scaled = change * self._scale
        if self._slope is None:
            return scaled
        return np.concatenate([scaled, (change * self._slope).sum(-2, keepdims=True)], axis=-2)

    def _rows(self, values: np.ndarray) -> np.ndarray:
        """(..., 2d + 1, P) with times first: (J, (2d + 1) N, ...)."""
        split = values.reshape(*values.shape[:-1], self.times, self.count)
        rows = np.moveaxis(split, -2, 0)  # (J, ..., 2d + 1, N)
        rows = rows.reshape(self.times, *rows.shape[1:-2], -1)
        return np.moveaxis(rows, -1, 1)


class Table:
    """A primed flow's parameters θ as one vector, and its table at any t as an affine function of them.

    The coefficients are those of `TableStep`: of each map in order, then the force gradients of the kicks, then their
    curvatures, or of each monomial in turn. One of the processor stands in two places, χ and with the opposite sign
    χ⁻¹.
    """

    def __init__(self, flow: PrimedFlow) -> None:
        self.dt, self.flow = flow.dt, flow
        kicks = [i for i, kind in enumerate(flow.sequence) if kind == "kick"]
        n = len(flow.sequence)
        self.n = n + flow.terms * len(kicks)
        named = [flow.kicks, flow.drifts, flow.gradients, flow.curvatures, *(flow.polynomials or ())]
        outside = [flow.processor_kicks, flow.processor_drifts, flow.processor_gradients, flow.processor_curvatures]
        outside += flow.processor_polynomials or ()
        self.columns = [c for c in (*named, *outside) if c is not None]
        self._kernel = len([c for c in named if c is not None])
        self._places = [np.zeros((self.n, c.offset.shape[0])) for c in self.columns]
        index = {id(c): place for c, place in zip(self.columns, self._places, strict=True)}
        for i, substep in enumerate(flow.substeps):
            for term, entry in enumerate(substep.entries):
                row = n + (term - 1) * len(kicks) + kicks.index(i) if term else i
                index[id(entry.column)][row, entry.row] = entry.sign

    def polynomial(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Offset (J, n) and design (J, n, f) of the coefficients at the times t by the flow's parameters."""
        return self._assembled(self.columns, t)

    def frozen(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """The same for a table at one time that is bound by nothing but the palindrome."""
        return self._assembled(self._unbound(), np.array([t]))

    def frozen_parameters(self, coefficients: np.ndarray) -> np.ndarray:
        """The parameters of `frozen` at Δt by which the table is the given one (n,), or nearest to it.

        Each column by itself and in powers of τ: beside Δt, coefficients in Δt⁵ are lost in rounding in SI units.
        """
        return np.concatenate(
            [
                np.linalg.lstsq(
                    _array(c.basis)[:, 0], self._column(coefficients, place) / self.dt**c.power, rcond=None
                )[0]
                for c, place in zip(self._unbound(), self._places, strict=True)
            ]
        )

    def _unbound(self) -> list[Coefficients]:
        """The columns of `frozen`."""
        return [
            Coefficients(c.offset.shape[0], (0,), self.dt, c.power, self.flow.palindromic and j < self._kernel)
            for j, c in enumerate(self.columns)
        ]

    def _assembled(self, columns: list[Coefficients], t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        offset, blocks = np.zeros((len(t), self.n)), []
        for c, place in zip(columns, self._places, strict=True):
            powers = t[:, None] ** c.power * (t[:, None] / self.dt) ** np.array(c.exponents)
            blocks.append(np.einsum("mn,nkf,jk->jmf", place, _array(c.basis), powers, optimize=True))
            offset += powers @ _array(c.offset).T @ place.T
        return offset, np.concatenate(blocks, axis=-1)

    def continued(self, coefficients: np.ndarray) -> np.ndarray:
        """The parameters for which the table at Δt is the given one (n,), and varies with t as little as may be."""
        parts = []
        for c, place in zip(self.columns, self._places, strict=True):
            basis, offset = _array(c.basis), _array(c.offset)
            A = np.concatenate([basis.sum(1), *np.moveaxis(STIFFNESS * basis[:, 1:], 1, 0)])
            b = np.zeros(len(A))
            b[: len(offset)] = self._column(coefficients, place) / self.dt**c.power - offset.sum(1)
            parts.append(np.linalg.lstsq(A, b, rcond=None)[0])
        return np.concatenate(parts)

    @staticmethod
    def _column(coefficients: np.ndarray, place: np.ndarray) -> np.ndarray:
        """The entries of a column in a table."""
        return place.T @ coefficients / np.abs(place).sum(0)

    def parameters(self) -> np.ndarray:
        return np.concatenate([_array(c.free) for c in self.columns])

    def assign(self, theta: np.ndarray) -> None:
        """Put the parameters into the flow."""
        put_weights([c.free for c in self.columns], torch.as_tensor(theta))

    def random(self, rng: np.random.Generator) -> np.ndarray:
        """A frozen table about that of equal steps, with or without the force gradients of Takahashi and Imada."""
        flow = self.flow
        spread = SPREAD if flow.terms else WIDE_SPREAD
        table, kicks = np.zeros(self.n), np.zeros(0)
        for c, place in zip(self.columns[:2], self._places[:2], strict=True):
            values = rng.normal(1, spread, c.offset.shape[0])
            values = values + values[::-1] if flow.palindromic else values
            values = self.dt * values / values.sum()
            kicks = values if c is flow.kicks else kicks
            table += place @ values
        if flow.gradients is not None:
            table += self._places[2] @ (rng.choice([0.0, 1 / 12]) * np.abs(kicks) ** 3)
        elif flow.polynomials is not None:
            size = rng.choice([0.0, 1 / 12]) * np.abs(kicks) ** 3
            for place, e in zip(self._places[2 : self._kernel], force_gradient_in(flow), strict=True):
                table += place @ (size * e)
        for c, place in zip(self.columns[self._kernel :], self._places[self._kernel :], strict=True):
            if c.power == 1:
                table += place @ rng.normal(0, PROCESSOR_SPREAD * self.dt, c.offset.shape[0])
        return table


def force_gradient_in(flow: PrimedFlow) -> np.ndarray:
    """−½|∇V|²_{M⁻¹} by the monomials of the flow's kicks (M,); 0 where it is no such polynomial."""
    system = flow.system
    assert system is not None
    assert system.symbols is not None
    e = in_monomials(system.symbols.force_gradient, system.symbols, flow.monomials)
    return np.zeros(len(flow.monomials)) if e is None else e


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().double().numpy()
