"""Fragments of the pages: what a benchmark measured, as Markdown that a page includes.

A fragment is one file in docs/measured: a table (or a list), and below it the command, the machine, the commit and the
date. The words around it stand in the page, which includes it by `--8<-- "measured/NAME.md"`.
"""

from __future__ import annotations

import argparse
import datetime
import math
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from measuring import machine

FOLDER = "docs/measured"
FILES = ("--out", "--json", "--results")


def add_out(parser: argparse.ArgumentParser) -> None:
    """The option `--out` of a benchmark."""
    parser.add_argument("--out", type=Path, help=f"folder of the fragments, {FOLDER} for the pages; none without it")


def write(folder: Path | None, name: str, body: str, section: str = "") -> None:
    """Write a fragment into `folder`, if there is one.

    Parameters
    ----------
    name : str
        Of the file, without its ending.
    body : str
        Markdown, a table as a rule. Headings belong to the page.
    section : str
        Options that measure this fragment alone, for a command that measures several.
    """
    if folder is None:
        return
    folder.mkdir(parents=True, exist_ok=True)
    today = datetime.date.today().isoformat()
    text = with_source(body, command_line(section), machine.in_words(), machine.commit(), today)
    (folder / f"{name}.md").write_text(text, encoding="utf-8")


def command_line(section: str = "") -> str:
    """The command that runs, without the files that it writes; with `section` where it runs several."""
    script, *given = sys.argv
    words = [word for before, word in zip(["", *given], given, strict=False) if not {before, word} & set(FILES)]
    if section and section.split(maxsplit=1)[0] not in words:
        words.append(section)
    return " ".join(["python", f"benchmarks/{Path(script).name}", *words])


def with_source(body: str, command: str, machine_in_words: str, commit: str, date: str) -> str:
    """The text of a fragment, with the line that says where it is from."""
    source = f"`{command}` · {machine_in_words} · commit {commit} · {date}"
    return f"{body.strip()}\n\n<small>{source}</small>\n"


def table(titles: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A Markdown table."""
    return "\n".join([row(titles), row(["---"] * len(titles)), *map(row, rows)])


def row(cells: Sequence[Any]) -> str:
    """A line of a Markdown table."""
    return f"| {' | '.join(str(cell) for cell in cells)} |"


def number(x: float | None, digits: int = 1) -> str:
    """x with an exponent; ∞ if it is not finite, nothing if there is none."""
    if x is None:
        return ""
    return f"{x:.{digits}e}" if math.isfinite(x) else "∞"


def three(x: float) -> str:
    """Three significant digits, without an exponent."""
    if x >= 100:
        return f"{float(f'{x:.3g}'):,.0f}"
    return f"{x:#.3g}"


def duration(seconds: float) -> str:
    """Three significant digits of a time, in the unit that suits it."""
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if seconds >= size:
            return f"{three(seconds / size)} {unit}"
    return f"{three(seconds / 1e-9)} ns"
