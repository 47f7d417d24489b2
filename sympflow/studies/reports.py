"""Reports: rows of measurements as text, CSV, JSON and a figure, the same for every study."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import unicodedata
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sympflow.arguments import naming_path, writable
from sympflow.show.cards import Answering, Card
from sympflow.storage.layout import imported

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

    from sympflow.hamiltonian.system import HamiltonianSystem


class Report(Answering):
    """The result of a study. A subclass gives its rows, settings, table and figure."""

    _OTHER_NAMES: ClassVar[Mapping[str, str]] = {
        **dict.fromkeys(("data", "results", "records"), "`rows`, or `to_dataframe()`"),
        **dict.fromkeys(("save", "to_text", "summary"), "`table()`, `to_csv(path)` or `to_json(path)`"),
        **dict.fromkeys(("to_pandas", "df"), "`to_dataframe()`"),
    }

    columns: ClassVar[tuple[str, ...]]  # the fields of the rows that files hold, in this order

    if TYPE_CHECKING:  # a field of some reports, a property of others

        @property
        def rows(self) -> tuple[Any, ...]:
            """The measurements, dataclasses of one kind."""

    @abstractmethod
    def table(self) -> str:
        """The rows as text."""

    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """The problem and the options of the study, in JSON's types."""

    @abstractmethod
    def figure(self) -> Figure:
        """The rows as a matplotlib figure."""

    def card(self) -> Card:
        return Card("", text=self.table())

    def preview(self) -> Figure | None:
        return self.figure()

    def __getitem__(self, key: Any) -> Any:
        raise TypeError(f"{type(self).__name__} has no item {key!r}: take `rows`, as in report.rows[0].")

    def to_dataframe(self) -> pandas.DataFrame:
        """The rows as a `pandas.DataFrame`; an ImportError if pandas is not installed."""
        return imported("pandas", "to_dataframe()").DataFrame(records(self.rows, self.columns))

    def to_csv(self, path: str | os.PathLike[str]) -> Path:
        """Write the rows to a CSV file, every figure to full precision."""
        return write_csv(self.rows, path, self.columns)

    def to_json(self, path: str | os.PathLike[str]) -> Path:
        """Write the rows and the settings to a JSON file."""
        return write_json(self.to_dict(), path)

    def to_dict(self) -> dict[str, Any]:
        """The settings, and the rows as dictionaries."""
        return {**self.settings(), "rows": records(self.rows, self.columns)}


def described(system: HamiltonianSystem) -> dict[str, Any]:
    """A system in the settings of a report."""
    return {
        "name": system.name,
        "params": {k: v if isinstance(v, int | float) else str(v) for k, v in system.params.items()},
    }


@dataclass(frozen=True)
class Column:
    """A column of a text table: its title, and its cells as strings."""

    title: str
    cells: Sequence[str]
    left: bool = False


def text_table(columns: Sequence[Column]) -> str:
    """Columns side by side, aligned, under their titles and a rule; columns without any content are left out."""
    columns = [c for c in columns if any(c.cells)]
    widths = [max(_width(text) for text in (c.title, *c.cells)) for c in columns]
    lines = [[c.title for c in columns], ["─" * w for w in widths]]
    lines += [list(cells) for cells in zip(*(c.cells for c in columns), strict=True)]
    padded = (
        "  ".join(
            text + " " * (w - _width(text)) if c.left else " " * (w - _width(text)) + text
            for c, text, w in zip(columns, line, widths, strict=True)
        )
        for line in lines
    )
    return "\n".join(line.rstrip() for line in padded)


def _width(text: str) -> int:
    return sum(not unicodedata.combining(c) for c in text)


def number(x: float | None, digits: int = 2) -> str:
    """A measured number in scientific notation: 3.1e-04; empty for None."""
    if x is None:
        return ""
    return f"{x:.{digits - 1}e}" if math.isfinite(x) else str(float(x))


def plain(x: float | None) -> str:
    """A chosen number, as it was chosen: 0.05; empty for None."""
    return "" if x is None else f"{x:.4g}"


def seconds(x: float | None) -> str:
    """A duration with its unit: 1.23 ms; empty for None."""
    if x is None:
        return ""
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if x >= size:
            return f"{x / size:.3g} {unit}" if x / size < 1000 else f"{x / size:.0f} {unit}"
    return f"{x * 1e9:.3g} ns"


def write_csv(rows: Sequence[Any], path: str | os.PathLike[str], columns: Sequence[str]) -> Path:
    """Write these fields of rows to a CSV file: a line for each, None as an empty cell, numbers to full precision."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in records(rows, columns):
        writer.writerow(["" if value is None else value for value in row.values()])
    return write_text(text.getvalue(), path)


def write_json(content: dict[str, Any], path: str | os.PathLike[str]) -> Path:
    """Write strict JSON; infinities and NaN, which JSON lacks, become the strings "inf", "-inf" and "nan"."""
    return write_text(json.dumps(_strict(content), indent=2, ensure_ascii=False, allow_nan=False) + "\n", path)


def records(rows: Sequence[Any], columns: Sequence[str]) -> list[dict[str, Any]]:
    """Rows as dictionaries of these fields."""
    return [{name: getattr(row, name) for name in columns} for row in rows]


def _strict(x: Any) -> Any:
    if isinstance(x, dict):
        return {str(k): _strict(v) for k, v in x.items()}
    if isinstance(x, list | tuple):
        return [_strict(v) for v in x]
    if isinstance(x, np.generic | np.ndarray):
        return _strict(x.tolist())
    if isinstance(x, float) and not math.isfinite(x):
        return str(float(x))
    return x


def write_text(text: str, path: str | os.PathLike[str]) -> Path:
    """Write a file whole or not at all, making its folder; errors as `writable`."""
    path = writable(path)
    partial = path.with_name(path.name + ".partial")
    with naming_path(path):
        partial.write_text(text, encoding="utf-8")
        partial.replace(path)
    return path
