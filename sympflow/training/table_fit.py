"""The fit of a primed flow's table to labels, as a least-squares problem."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch

from sympflow.flow.coefficients import Coefficients
from sympflow.flow.primed import PrimedFlow
from sympflow.training.labels import Labels
from sympflow.training.levenberg_marquardt import Minimum, levenberg_marquardt
from sympflow.training.table_jacobian import TableStep

SPREAD = 0.25  # of random coefficients about those of equal steps
WIDE_SPREAD = 2.0  # without force gradients, where an order above 2 needs negative ones
STIFFNESS = 1e-3  # how reluctantly a table is made to vary with t where that is not called for


class TableFit:
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
    """

    def __init__(
        self,
        step: TableStep,
        labels: Labels,
        offset: np.ndarray,
        design: np.ndarray,
        unit: np.ndarray,
        weight: np.ndarray,
    ) -> None:
        self.step, self.offset, self.design = step, offset, design
        self.times, self.count = len(labels.t), len(labels.x)
        self._x = np.tile(labels.x.T, (1, self.times))
        self._y = np.ascontiguousarray(labels.y.reshape(-1, labels.x.shape[1]).T)
        # The sum of squares is a mean over states and times.
        self._scale = np.repeat(weight, self.count) / unit[:, None] / math.sqrt(self.times * self.count)

    def coefficients(self, theta: np.ndarray) -> np.ndarray:
        """(n, P), P = J N."""
        return np.repeat((self.offset + self.design @ theta).T, self.count, axis=1)

    def residuals(self, theta: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            y = self.step(self.coefficients(theta), self._x)
            return self._rows((y - self._y) * self._scale).ravel()

    def linearized(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        y, J = self.step.with_jacobian(self.coefficients(theta), self._x)
        by_table = self._rows(J * self._scale)  # (J, 2d N, n)
        J = (by_table @ self.design).reshape(-1, self.design.shape[-1])
        return self._rows((y - self._y) * self._scale).ravel(), J

    def _rows(self, values: np.ndarray) -> np.ndarray:
        """(..., 2d, P) with times first: (J, 2d N, ...)."""
        split = values.reshape(*values.shape[:-1], self.times, self.count)
        rows = np.moveaxis(split, -2, 0)  # (J, ..., 2d, N)
        rows = rows.reshape(self.times, *rows.shape[1:-2], -1)
        return np.moveaxis(rows, -1, 1)

    def minimize(self, theta: np.ndarray, iterations: int, stop: Callable[[], bool]) -> Minimum:
        return levenberg_marquardt(self.residuals, self.linearized, theta, iterations=iterations, stop=stop)


class Table:
    """The three columns of a primed flow as one vector of coefficients, in the order of `TableStep`."""

    def __init__(self, flow: PrimedFlow) -> None:
        kicks = [i for i, kind in enumerate(flow.sequence) if kind == "kick"]
        drifts = [i for i, kind in enumerate(flow.sequence) if kind == "drift"]
        n, self.columns = len(flow.sequence), [(flow.kicks, kicks), (flow.drifts, drifts)]
        if flow.gradients is not None:
            self.columns.append((flow.gradients, [n + j for j in range(len(kicks))]))
        self.n = max(max(rows) for _, rows in self.columns) + 1
        self.dt, self.flow = flow.dt, flow

    def polynomial(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Offset (J, n) and design (J, n, f) of the coefficients at the times t by the flow's parameters."""
        return self._assembled([c for c, _ in self.columns], t)

    def frozen(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """The same for a table at one time that is bound by nothing but the palindrome."""
        columns = [Coefficients(len(rows), (0,), self.dt, c.power, self.flow.palindromic) for c, rows in self.columns]
        return self._assembled(columns, np.array([t]))

    def _assembled(self, columns: list[Coefficients], t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        offset, blocks = np.zeros((len(t), self.n)), []
        for c, (_, rows) in zip(columns, self.columns, strict=True):
            powers = t[:, None] ** c.power * (t[:, None] / self.dt) ** np.array(c.exponents)
            block = np.zeros((len(t), self.n, c.free.numel()))
            block[:, rows] = np.einsum("nkf,jk->jnf", c.basis.cpu().double().numpy(), powers)
            offset[:, rows] = powers @ c.offset.cpu().double().numpy().T
            blocks.append(block)
        return offset, np.concatenate(blocks, axis=-1)

    def continued(self, coefficients: np.ndarray) -> np.ndarray:
        """The parameters for which the table at Δt is the given one (n,), and varies with t as little as may be."""
        parts = []
        for c, rows in self.columns:
            basis, offset = (a.cpu().double().numpy() for a in (c.basis, c.offset))
            A = np.concatenate([basis.sum(1), *np.moveaxis(STIFFNESS * basis[:, 1:], 1, 0)])
            b = np.zeros(len(A))
            b[: len(rows)] = coefficients[rows] / self.dt**c.power - offset.sum(1)
            parts.append(np.linalg.lstsq(A, b, rcond=None)[0])
        return np.concatenate(parts)

    def parameters(self) -> np.ndarray:
        return np.concatenate([c.free.detach().cpu().double().numpy() for c, _ in self.columns])

    @torch.no_grad()
    def assign(self, theta: np.ndarray) -> None:
        """Put the parameters into the flow."""
        for c, _ in self.columns:
            part, theta = theta[: c.free.numel()], theta[c.free.numel() :]
            c.free.copy_(torch.as_tensor(part))

    def random(self, rng: np.random.Generator) -> np.ndarray:
        """A frozen table about that of equal steps, with or without the force gradients of Takahashi and Imada."""
        spread = SPREAD if self.flow.gradients is not None else WIDE_SPREAD
        table = np.zeros(self.n)
        for _, rows in self.columns[:2]:
            values = rng.normal(1, spread, len(rows))
            values = values + values[::-1] if self.flow.palindromic else values
            table[rows] = self.dt * values / values.sum()
        for c, rows in self.columns[2:]:
            kicks = table[self.columns[0][1]]
            table[rows] = rng.choice([0.0, 1 / 12]) * np.abs(kicks) ** c.power
        return table
