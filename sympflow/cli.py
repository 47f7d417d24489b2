"""The command line, `sympflow`: see `sympflow --help`. The commands themselves are in `sympflow.commands`."""

from __future__ import annotations

import io
import sys

from sympflow.lazy import needed


def main() -> None:
    """Entry point. Exit status: 0 fine, 1 something failed, 2 wrong usage, 130 interrupted."""
    try:
        import rich  # noqa: F401
        import typer  # noqa: F401
    except ImportError as error:
        sys.exit(f"The command line needs {error.name}: {needed(str(error.name), 'cli')}.")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # tables hold Δ and ψ, whatever the locale
            stream.reconfigure(encoding="utf-8")
    from sympflow.commands import app

    app()


if __name__ == "__main__":
    main()
