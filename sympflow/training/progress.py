"""Progress of a training run, on a terminal only."""

from __future__ import annotations

import sys
from typing import Any


class Silent:
    """Shows nothing."""

    def __enter__(self) -> Silent:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def advance(self, step: int, loss: float) -> None:
        pass

    def validated(self, step: int, figures: dict[str, float]) -> None:
        pass

    def tries(self, done: int, what: str) -> None:
        pass


class Lines(Silent):
    """One line for each validation: the fallback where rich is not installed."""

    def __init__(self, total: int, label: str) -> None:
        self.total, self.label = total, label

    def validated(self, step: int, figures: dict[str, float]) -> None:
        print(f"{self.label} {step}/{self.total}  {_text(figures)}", file=sys.stderr, flush=True)

    def tries(self, done: int, what: str) -> None:
        print(f"{self.label} {done}/{self.total}  {what}", file=sys.stderr, flush=True)


class Bar(Silent):
    """A bar with the losses, the one-step error and the time left."""

    def __init__(self, total: int, label: str, start: int) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        self.bar = Progress(
            TextColumn("[bold]{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[figures]}"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
        )
        self.task = self.bar.add_task(label, total=total, completed=start, figures="")
        self.figures = ""

    def __enter__(self) -> Bar:
        self.bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.stop()

    def advance(self, step: int, loss: float) -> None:
        if step % 10 == 0:
            self.bar.update(self.task, completed=step, figures=f"loss {loss:.1e}  {self.figures}")

    def validated(self, step: int, figures: dict[str, float]) -> None:
        self.figures = _text(figures)
        self.bar.update(self.task, completed=step, figures=self.figures)

    def tries(self, done: int, what: str) -> None:
        self.bar.update(self.task, completed=done, figures=what)


def progress(show: bool | None, total: int, label: str, start: int = 0) -> Any:
    """What shows the run: `show` None means on a terminal only."""
    if not (sys.stderr.isatty() if show is None else show):
        return Silent()
    try:
        return Bar(total, label, start)
    except ImportError:
        return Lines(total, label)


def _text(figures: dict[str, float]) -> str:
    names = {"loss": "held-out", "residual_loss": "L1", "matching_loss": "L2", "one_step_error": "one-step"}
    return "  ".join(f"{short} {figures[name]:.1e}" for name, short in names.items() if name in figures)
