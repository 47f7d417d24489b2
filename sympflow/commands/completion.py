"""Completion in the shell: of systems, methods, files, and of the words of an option."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

MOST_FILES = 50


def of(words: Sequence[str]) -> Callable[[str], list[str]]:
    """The completion of an option that takes one of some words."""
    return lambda incomplete: [word for word in words if word.startswith(incomplete)]


def several(words: Sequence[str]) -> Callable[[str], list[str]]:
    """The completion of an option that takes some of some words, separated by commas."""
    return lambda incomplete: _last(incomplete, of(words))


def one_method(incomplete: str) -> list[str]:
    """Names of methods, and files of flows."""
    from sympflow.integrators.registry import available

    return [*of(available())(incomplete), *files(incomplete, (".safetensors",))]


def methods(incomplete: str) -> list[str]:
    """Names of methods, separated by commas: of the last one."""
    return _last(incomplete, one_method)


def metrics(incomplete: str) -> list[str]:
    """Metrics of a comparison, separated by commas: of the last one."""
    from sympflow.studies.comparison import METRICS

    return several(METRICS)(incomplete)


def flows(incomplete: str) -> list[str]:
    """Names of the flows that ship, and files of flows."""
    from sympflow.flow.shipped import shipped_flows

    return [*of([flow.name for flow in shipped_flows()])(incomplete), *files(incomplete, (".safetensors",))]


def files(incomplete: str, endings: Iterable[str]) -> list[str]:
    """Files of some endings that begin so, and folders."""
    folder, _, start = incomplete.rpartition("/")
    place = Path(f"{folder}/" if incomplete.startswith("/") or folder else ".")
    try:
        entries = sorted(place.iterdir())
    except OSError:
        return []
    found = [e for e in entries if e.name.startswith(start) and (start or not e.name.startswith("."))]
    before = f"{folder}/" if "/" in incomplete else ""
    folders = [f"{before}{e.name}/" for e in found if e.is_dir()] if before or start else []
    named = [f"{before}{e.name}" for e in found if e.suffix in tuple(endings) and e.is_file()]
    return [*named, *folders][:MOST_FILES]


def _last(incomplete: str, complete: Callable[[str], list[str]]) -> list[str]:
    before, comma, last = incomplete.rpartition(",")
    return [f"{before}{comma}{word}" for word in complete(last)]
