"""The console: errors as one line and in the words of the command line, progress, tables, and the files of `--out`."""

from __future__ import annotations

import contextlib
import os
import re
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from typer import Option

from sympflow.commands.words import OF_METHODS, NamedSystem, Usage
from sympflow.show.cards import cut
from sympflow.studies.reports import Column, text_table

out = Console(soft_wrap=True, highlight=False)
err = Console(stderr=True, soft_wrap=True, highlight=False)


OPTIONS = {  # arguments of the library that commands have by other names: the first one counts that the command has
    "t_span": ("t_end",),
    "t_eval": ("n_outputs",),
    "method": ("method_name", "method_names"),
    "methods": ("method_names",),
    "flow": ("flow_name",),
    "path": ("flow_name", "method_name", "method_names"),
    "n": ("batch", "orbits"),
    "dtype": ("dtypes",),
}
COMMANDS = {"poincare_section": "section", "work_precision": "bench", "available": "methods", "shipped_flows": "flows"}
"""Functions of the library that are commands by other names."""
PHRASES: dict[str, str | Callable[[re.Match[str]], str]] = {
    r"train one by flow = sympflow\.train\(system\) and pass flow=flow": "train one by `sympflow train` and "
    "name its file, or take a method that needs none, such as gauss_legendre6",
    r"train a flow and pass flow=flow": "train one by `sympflow train`, and name its file",
    r"pass the path of a flow saved with flow\.save\(path\)": "name a file that `sympflow train` wrote",
    r"flows from other files are read by sympflow\.load": "flows from other files are named by their path",
    r"pass the states to train on, as by domain=sympflow\.Box.*?\(energy, box\)": "define the system with one, under "
    "[domain] of a .toml file for instance",
    r"Join q and p along the last axis, np\.concatenate\(\[q, p\], axis=-1\)": "Give all q and then all p, with commas",
    r"Pass the states themselves": "Give --batch 0",
    r"give the mass matrix as `velocity_mass`, by which p = M v, or columns p1 …; or pass observed=\"qv\" to `learn`, "
    r"which finds M|pass velocity_mass=\[…\], by which p = M v": 'pass observed="qv", by which masses are found',
    r"flow\.certificate\(system\)": "`sympflow certificate`",
    r'damping="quadratic"': "`--drag`",
    r"period=2\*np\.pi": "period=6.283185307179586",
    r"period=np\.inf": "`--period inf`",
    r"sympflow\.systems\.available\(\)": "`sympflow systems`",
    r"\bsympflow\.(solve|train|compare|stability|learn|poincare_section|work_precision|available|shipped_flows)\b"
    r"(\([^)]*\))?|\b(poincare_section|work_precision)\b": lambda m: f"`sympflow {COMMANDS.get(m[1] or m[3], m[1])}`",
    r"(by |with )?(sympflow\.)?HamiltonianSystem(\.\w+(\([^)]*\))?|\([^)]*\))": "as a formula",
    r",? or (pass|use) a SymPy expression": "",
    r"\[('[\w-]+'(?:, '[\w-]+')*)\]": lambda m: m[1].replace("'", "").replace(", ", ","),
}
"""Remedies in Python, as patterns, and what they are on the command line."""


def in_options(message: str, context: typer.Context) -> str:
    """A message of the library in the options of the command that runs: `t_span` is `--t-end`, backend='array' too.

    Arguments that the command has no option for stay as they are.
    """
    parameters = context.command.params
    named = {str(p.name): max(p.opts, key=lambda w: (w.startswith("--"), -p.opts.index(w))) for p in parameters}
    options = {name: option for name, option in named.items() if option.startswith("-")}
    for name, others in OPTIONS.items():
        option = next((options[other] for other in others if other in options), None)
        if option is not None:
            options.setdefault(name, option)
    method = str(context.params.get("method_name") or "NAME").split(":")[0]
    for name in OF_METHODS if "method" in options else ():
        options.setdefault(name, f"{method}:{name}=")
    message = re.sub(r"`(\w+)`", lambda m: f"`{options.get(m[1], m[1])}`", in_words(message)).replace("=`", "=…`")
    given = re.compile(r"`?(?<![\w:.-])(?P<name>\w+)=(?P<value>'[^']*'|\"[^\"]*\"|True|[\d.eE+-]*\d|(?=\W|$))`?")

    def as_option(found: re.Match[str]) -> str:
        option, value = options.get(found["name"]), found["value"].strip("'\"")
        if option is None:
            return found[0]
        return f"`{option}`" if value in ("", "True") else f"`{option} {value}`".replace("= ", "=")

    return given.sub(as_option, message)


def in_words(message: str) -> str:
    """A message with its remedies in Python as those on the command line."""
    for pattern, here in PHRASES.items():
        message = re.sub(pattern, here, message)
    return message


@contextlib.contextmanager
def reporting(context: typer.Context) -> Iterator[None]:
    """Errors as one line and an exit status: 2 for arguments, 1 for what failed, 130 for Ctrl-C; warnings as a line."""
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *where, **more: err.print(
                f"Warning: {in_options(str(message), context)}", style="yellow", markup=False
            )
            yield
    except typer.Exit:
        raise
    except (ValueError, TypeError) as error:
        said = in_words(str(error)) if isinstance(error, Usage) else in_options(str(error), context)
        err.print(f"Error: {said}", style="red", markup=False)
        raise typer.Exit(2) from error
    except (RuntimeError, ImportError, OSError, ArithmeticError) as error:
        err.print(f"Failed: {in_options(str(error), context)}", style="red", markup=False)
        raise typer.Exit(1) from error
    except MemoryError as error:
        err.print(f"Failed: out of memory ({error}): ask for fewer outputs or states.", style="red", markup=False)
        raise typer.Exit(1) from error
    except KeyboardInterrupt as error:
        err.print(f"Interrupted. {error}".strip(), style="red", markup=False)
        raise typer.Exit(130) from error


def _set_quiet(quiet: bool) -> bool:
    out.quiet = quiet
    return quiet


Quiet = Annotated[
    bool,
    Option(
        "--quiet",
        "-q",
        callback=_set_quiet,
        is_eager=True,
        help="Print only errors and warnings; files are written as usual.",
    ),
]


def asked(context: typer.Context, names: str) -> dict[str, Any]:
    """The options of these names that were given, for a function of the library that takes them by the same names."""
    return {name: context.params[name] for name in names.split() if context.params[name] is not None}


@contextlib.contextmanager
def progress() -> Iterator[Callable[[str], None]]:
    """A line on the terminal on the work in progress; nothing where there is no terminal, or with --quiet."""
    if not err.is_terminal or out.quiet:
        yield lambda text: None
        return
    with err.status("Starting") as status:
        yield status.update


def show(text: str) -> None:
    """Print a text as it is, unless --quiet is on."""
    if not out.quiet:
        print(text)


def print_table(titles: Sequence[str], rows: Sequence[Sequence[str]], width: int | None = None) -> None:
    """A table of strings, aligned left; with a width the last column is cut so that it fits, or fits the terminal."""
    if width is not None:
        others = sum(2 + max(len(row[i]) for row in (titles, *rows)) for i in range(len(titles) - 1))
        left = max(width, out.width if out.is_terminal else 0) - others
        rows = [(*row[:-1], cut(row[-1], left)) for row in rows]
    columns = [Column(title, cells, left=True) for title, *cells in zip(titles, *rows, strict=True)]
    out.print(text_table(columns), markup=False)


def ready_folder(folder: Path | None) -> None:
    """Make the folder of `--out`, and be sure that files and figures can be written, before anything is computed."""
    from sympflow.show.style import new_figure

    if folder is not None:
        new_figure(1, 1)
        _ready(folder, folder, "a folder")


def ready_file(path: Path | None, option: str = "--out") -> None:
    """Make the folder of an option's file, and be sure that it can be written, before anything is computed."""
    if path is None:
        return
    if path.is_dir():
        raise ValueError(f"`{option}` {str(path)!r} is a folder: name a file in it.")
    _ready(path.parent, path, "a file", option)
    if path.exists() and not os.access(path, os.W_OK):
        raise ValueError(f"`{option}` {str(path)!r} is write-protected: name another file.")


def _ready(folder: Path, asked: Path, what: str, option: str = "--out") -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ValueError(
            f"`{option}` {str(asked)!r} cannot be written ({error.strerror}): name {what} that can be."
        ) from error


def write_solution(sol: Any, path: Path) -> None:
    """Columns t, q…, p… as text, or arrays t and y."""
    if path.suffix == ".npz":
        np.savez(path, t=sol.t, y=sol.y, system=sol.system.name, method=sol.integrator.name)
        return
    d = sol.system.ndof
    names = ["t", *(f"{v}{i}" if d > 1 else v for v in "qp" for i in range(1, d + 1))]
    np.savetxt(path, np.column_stack([sol.t, sol.y.T]), delimiter=",", header=",".join(names), comments="", fmt="%.17g")


def tell(folder: Path, written: list[Path]) -> None:
    """Say which files were written to a folder."""
    out.print(f"\nWritten to {folder}: {', '.join(path.name for path in written)}")


def write_comparisons(
    comparisons: list[Any], found: list[NamedSystem], folder: Path, say: Callable[[str], None]
) -> list[Path]:
    """For each system its CSV, JSON and figures; for several also one CSV and one figure of all."""
    from sympflow.show.style import save
    from sympflow.studies.figures import overview, save_comparison
    from sympflow.studies.reports import write_csv

    written: list[Path] = []
    for comparison, scene in zip(comparisons, found, strict=True):
        say(f"{scene.key}: figures")
        written += [comparison.to_csv(folder / f"{scene.key}.csv"), comparison.to_json(folder / f"{scene.key}.json")]
        written += save_comparison(comparison, folder, prefix=f"{scene.key}-")
    drawable = [c for c in comparisons if {"error", "energy", "balance", "volume"} & set(c.metrics)]
    if drawable:
        written.append(save(overview(drawable), folder / "comparison.png"))
    if len(comparisons) > 1:
        rows = [row for c in comparisons for row in c.rows]
        written.append(write_csv(rows, folder / "comparison.csv", comparisons[0].columns))
    return written
