"""The commands of `sympflow`. They parse, call the library, and print; nothing is computed here."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from typer import Option
from typer.core import TyperCommand

from sympflow._version import __version__
from sympflow.commands import learning, listings, running, studying
from sympflow.commands.console import out, reporting

PARAMETERS = {"allow_extra_args": True, "ignore_unknown_options": True}
"""Options that are unknown to a command may be parameters of a system: --omega 100."""


class Command(TyperCommand):
    """A command that reports its errors, and refuses an option given twice, instead of taking the last value."""

    def invoke(self, ctx: Any) -> Any:
        with reporting(ctx):
            return super().invoke(ctx)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        order: list[Any] = self.make_parser(ctx).parse_args(args=[*args])[2]
        for param in [p for p in order if order.count(p) > 1 and not (p.multiple or p.is_flag)][:1]:
            several = ", its values separated by commas" if param.name == "method_names" else ""
            raise typer.BadParameter(f"it is given {order.count(param)} times: give it once{several}.", ctx, param)
        return super().parse_args(ctx, args)


app = typer.Typer(no_args_is_help=True, rich_markup_mode="rich", pretty_exceptions_enable=False)
app.command(cls=Command, context_settings=PARAMETERS)(listings.systems)
app.command(cls=Command)(listings.methods)
app.command(cls=Command, context_settings=PARAMETERS)(listings.flows)
app.command(cls=Command, context_settings=PARAMETERS)(running.solve)
app.command(cls=Command, context_settings=PARAMETERS)(studying.compare)
app.command(cls=Command, context_settings=PARAMETERS)(studying.bench)
app.command(cls=Command, context_settings=PARAMETERS)(studying.stability)
app.command(cls=Command, context_settings=PARAMETERS)(studying.section)
app.command(cls=Command, context_settings=PARAMETERS)(running.train)
app.command(cls=Command, context_settings=PARAMETERS)(running.certificate)
app.command(cls=Command)(learning.learn)


@app.callback(invoke_without_command=True)
def _sympflow(version: Annotated[bool, Option("--version", help="Print the version and leave.")] = False) -> None:
    """Structure-preserving integration of Hamiltonian systems, classical and learned."""
    if version:
        out.print(__version__)
        raise typer.Exit
