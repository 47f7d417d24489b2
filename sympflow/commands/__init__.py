"""The commands of `sympflow`. They parse, call the library, and print; nothing is computed here."""

from __future__ import annotations

from typing import Annotated

import typer

from sympflow._version import __version__
from sympflow.commands import learning, listings, running, studying
from sympflow.commands.console import out

PARAMETERS = {"allow_extra_args": True, "ignore_unknown_options": True}
"""Options that are unknown to a command may be parameters of a system: --omega 100."""

app = typer.Typer(no_args_is_help=True, rich_markup_mode="rich", pretty_exceptions_enable=False)
app.command()(listings.systems)
app.command()(listings.methods)
app.command(context_settings=PARAMETERS)(listings.flows)
app.command(context_settings=PARAMETERS)(running.solve)
app.command(context_settings=PARAMETERS)(studying.compare)
app.command(context_settings=PARAMETERS)(studying.bench)
app.command(context_settings=PARAMETERS)(studying.stability)
app.command(context_settings=PARAMETERS)(studying.section)
app.command(context_settings=PARAMETERS)(running.train)
app.command(context_settings=PARAMETERS)(running.certificate)
app.command()(learning.learn)


@app.callback(invoke_without_command=True)
def _sympflow(version: Annotated[bool, typer.Option("--version", help="Print the version and leave.")] = False) -> None:
    """Structure-preserving integration of Hamiltonian systems, classical and learned."""
    if version:
        out.print(__version__)
        raise typer.Exit
