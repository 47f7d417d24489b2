"""Cards: objects shown as a caption, a table of labels and values, and a text, in a terminal and in a notebook."""

from __future__ import annotations

import html
import io
import re
import sys
import unicodedata
from abc import ABC, abstractmethod
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sympflow.arguments import told_of_all

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LONGEST = 100
"""Characters of a value before it is cut."""


@dataclass(frozen=True)
class Card:
    """Caption, facts and text of an object. Values are cut to `LONGEST` characters; empty ones are left out."""

    caption: str
    facts: Mapping[str, str] = field(default_factory=dict)
    text: str = ""
    formula: str = ""
    """LaTeX, shown in notebooks."""

    def plain(self) -> str:
        """The card as text."""
        rows = {label: cut(value) for label, value in self.facts.items() if value}
        width = max(map(len, rows), default=0)
        lines = [self.caption, *(f"  {label:{width}}  {value}" for label, value in rows.items()), self.text]
        return "\n".join(filter(None, lines))

    def html(self, figure: Figure | None = None) -> str:
        """The card as HTML, with a figure below."""
        cell = '<td style="text-align:left">'
        rows = "".join(
            f"<tr>{cell}<b>{html.escape(label)}</b></td>{cell}{html.escape(cut(value))}</td></tr>"
            for label, value in self.facts.items()
            if value and not (self.formula and label == "H")
        )
        parts = [
            f"<b>{html.escape(self.caption)}</b>" if self.caption else "",
            f"$\\displaystyle {html.escape(self.formula)}$" if self.formula else "",
            f"<table>{rows}</table>" if rows else "",
            f"<pre>{html.escape(self.text)}</pre>" if self.text else "",
            _picture(figure),
        ]
        return "<div>" + "".join(f"<div>{part}</div>" for part in parts if part) + "</div>"


class Shown(ABC):
    """An object that has a card; with a `preview`, drawn in notebooks once matplotlib is loaded."""

    @abstractmethod
    def card(self) -> Card:
        """Return the card of the object."""

    def preview(self) -> Figure | None:
        """Return the figure that a notebook shows with it; None if there is none."""
        return None

    def __repr__(self) -> str:
        return self.card().plain()

    def __str__(self) -> str:
        return legible(repr(self))

    def _repr_html_(self) -> str:
        figure = None
        if "matplotlib" in sys.modules:
            with suppress(Exception), np.errstate(all="ignore"):  # the table is shown without it
                figure = self.preview()
        return self.card().html(figure)


class Answering(Shown):
    """An object that says where it has what users look for under other names, and how its methods are called."""

    _OTHER_NAMES: ClassVar[Mapping[str, str]] = {}
    """These names, and what to take."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        told_of_all(cls)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            if name not in self._OTHER_NAMES:
                return object.__getattribute__(self, name)  # which says what is wrong
            raise AttributeError(
                f"{type(self).__name__} has no attribute {name!r}: take {self._OTHER_NAMES[name]}.", name="", obj=None
            )


def _picture(figure: Figure | None) -> str:
    if figure is None:
        return ""
    import base64

    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=80)
    return f'<img src="data:image/png;base64,{base64.b64encode(data.getvalue()).decode()}">'


def legible(text: str) -> str:
    """A text in characters that can be printed, in the encoding of the terminal."""
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    with suppress(UnicodeEncodeError):
        text.encode(encoding)
        return text
    return "".join(SPELLED.get(c) or _spelled(c) for c in text).encode(encoding, "replace").decode(encoding)


SPELLED = {"…": "...", "µ": "u", "±": "+-", "×": "x", "·": "*", "∞": "inf", "≤": "<=", "≥": ">=", "→": "->"}
SPELLED |= dict.fromkeys("─–—−", "-")


def _spelled(character: str) -> str:
    """A letter without its accent, a Greek one by its name."""
    if "α" <= character <= "ω":
        return unicodedata.name(character).rpartition(" ")[2].lower()
    return "".join(c for c in unicodedata.normalize("NFKD", character) if not unicodedata.combining(c))


def cut(text: str, longest: int = LONGEST) -> str:
    """A text in one line, cut at its end."""
    line = " ".join(text.split())
    return line if len(line) <= longest else f"{line[: longest - 2]} …"


def brief(text: str) -> str:
    """A text whose numbers have six digits at most."""
    return re.sub(r"\d+\.\d{6,}(e[-+]?\d+)?", lambda found: f"{float(found[0]):.6g}", text)


def numbers(values: Any, most: int = 8) -> str:
    """An array in a row, to six digits; the shape of one with many entries."""
    array = np.asarray(values)
    if array.size > most:
        return f"array of shape {array.shape}"
    return f"{array:.6g}" if array.ndim == 0 else "[" + ", ".join(f"{x:.6g}" for x in array.reshape(-1)) + "]"
