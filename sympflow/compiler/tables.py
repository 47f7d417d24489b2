"""Tables: rows of numbers that a program reads, such as the coefficients of a spline.

Two functions of the table of functions read them: `entry`, the number at a place, and `interval`, the place of a number
among others. Both are constant between two places, so that their derivatives are 0. Compiled code does not contain the
numbers of a table: it finds them by a symbol, made from their digest.
"""

from __future__ import annotations

import hashlib
from functools import cached_property
from typing import Any

import numpy as np

__all__ = ["TABLES", "Table", "entry_of", "interval_of"]

SYMBOL = "sympflow_table_"  # begins the names of tables in code
TABLES: dict[str, Table] = {}
"""The tables that compiled code of this process reads, by their symbols: kept as long as that."""


class Table:
    """Numbers in a row, known by their values; an argument of operations, but not a number itself."""

    def __init__(self, values: Any) -> None:
        self.values = np.array(values, dtype=np.float64).reshape(-1)
        self.values.flags.writeable = False

    @cached_property
    def symbol(self) -> str:
        return SYMBOL + hashlib.sha256(self.values.tobytes()).hexdigest()[:32]

    @property
    def constant(self) -> Table:
        """The table: it depends on no state."""
        return self

    @cached_property
    def spacing(self) -> float:
        """The distance of numbers that are equally far from each other, up to rounding; else 0."""
        apart = np.diff(self.values)
        width = float(self.values[-1] - self.values[0]) / len(apart)
        size = float(np.abs(self.values).max())
        return width if bool((np.abs(apart - width) <= 8 * np.finfo(float).eps * size).all()) else 0.0

    def __len__(self) -> int:
        return len(self.values)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Table) and self.symbol == other.symbol

    def __hash__(self) -> int:
        return hash(self.symbol)

    def __repr__(self) -> str:
        return f"<{len(self)} numbers {self.symbol.removeprefix(SYMBOL)}>"

    def __reduce__(self) -> tuple[Any, ...]:
        return Table, (np.array(self.values),)


def entry_of(table: Table, i: Any, offset: float) -> Any:
    """Return the numbers at the places i + offset, whole numbers as floats: of arrays or tensors."""
    if isinstance(i, np.ndarray | float | np.generic):
        return table.values[np.asarray(np.add(i, offset), dtype=np.int64)]
    import torch

    return torch.as_tensor(table.values.copy(), dtype=i.dtype, device=i.device)[(i + offset).long()]


def interval_of(table: Table, x: Any) -> Any:
    """Return the place of the last number that is not above x, of all but the last number; else 0."""
    if isinstance(x, np.ndarray | float | np.generic):
        return np.searchsorted(table.values[1:-1], x, "right").astype(float)
    import torch

    inner = torch.as_tensor(table.values[1:-1].copy(), dtype=x.dtype, device=x.device)
    return torch.searchsorted(inner, x.detach().contiguous(), right=True).to(x.dtype)
