"""Arguments and options that several commands take."""

from __future__ import annotations

from typing import Annotated

import typer

Systems = Annotated[
    list[str],
    typer.Argument(metavar="SYSTEM...", help="See `sympflow systems`; parameters as --omega 100 or name:omega=100."),
]
TEnd = Annotated[float | None, typer.Option(help="End of the interval, which starts at 0. Default: the system's.")]
State = Annotated[str | None, typer.Option("--y0", help="Initial state q,p: 0.3,-0.3,0.3,0.15. Default: the system's.")]
Step = Annotated[float | None, typer.Option(help="Step of fixed-step methods. Default: the system's, the flow's Δt.")]
Backend = Annotated[str, typer.Option(help="auto, compiled or array.")]
