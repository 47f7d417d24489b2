"""The command that makes the flows that ship: networks, ladders of primed flows, flows of stiff systems.

python -m sympflow.training.pretrained                                  all of them
python -m sympflow.training.pretrained henon_heiles --kind sympflow     one
python -m sympflow.training.pretrained kepler --rung primed-3-0.08      one rung of a ladder of primed flows
python -m sympflow.training.pretrained fput_50                          one of a stiff system
python -m sympflow.training.pretrained --measure                        their figures, without training
python -m sympflow.training.pretrained --measure --keep                 and put them into the files
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import torch

from sympflow.flow.io import load
from sympflow.training import networks, stiff
from sympflow.training.ladder import ladders

KINDS = (*networks.KINDS, "primed", "split")


def path(name: str, kind: str, folder: Path | None = None) -> Path:
    """The file of a scene's flow, in the package if no folder is given; the kind of a rung is its name."""
    folder = Path(str(resources.files("sympflow"))) / "pretrained" if folder is None else folder
    return folder / f"{name}-{kind}.safetensors"


def scenes() -> list[str]:
    """The names of all that ships."""
    return list(dict.fromkeys([*networks.recipes(), *ladders(), *stiff.recipes()]))


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="python -m sympflow.training.pretrained", description="Train the shipped flows."
    )
    parser.add_argument("scenes", nargs="*", metavar="scene", help=f"of {', '.join(scenes())}; all if none is named")
    parser.add_argument("--kind", choices=KINDS, help="one architecture only")
    parser.add_argument("--rung", help="one rung only of a ladder of primed flows, for instance primed-3-0.08")
    parser.add_argument("--out", type=Path, help="folder to write to (default: the package)")
    parser.add_argument("--measure", action="store_true", help="only measure the files that are there")
    parser.add_argument("--keep", action="store_true", help="with --measure: put the figures into the files")
    options = parser.parse_args(arguments)
    unknown = sorted(set(options.scenes) - set(scenes()))
    if unknown:
        parser.error(f"unknown scene {', '.join(unknown)}: choose from {', '.join(scenes())}")
    rungs = [rung.name for ladder in ladders().values() for rung in ladder.rungs]
    if options.rung is not None and options.rung not in rungs:
        parser.error(f"unknown rung {options.rung}: choose from {', '.join(dict.fromkeys(rungs))}")
    torch.set_num_threads(1)  # the arrays are small, and one thread is reproducible
    kinds = (options.kind,) if options.kind else ("primed",) if options.rung else KINDS
    for name in options.scenes or scenes():
        for kind in kinds:
            for file, figures in _made(name, kind, options):
                values = "  ".join(f"{k} {'diverges' if v is None else f'{v:.2e}'}" for k, v in figures.items())
                print(f"{file.stem}: {values}", flush=True)


def _made(name: str, kind: str, options: argparse.Namespace) -> Iterator[tuple[Path, dict[str, Any]]]:
    """The files of a scene, as they are written or only measured, and their figures."""
    if kind == "primed":
        if name not in ladders():
            return
        ladder = ladders()[name]
        if options.measure:
            for rung in ladder.rungs:
                if options.rung in (None, rung.name):
                    yield _measured(path(name, rung.name, options.out), ladder.measure, options.keep)
            return
        for rung, flow in ladder.flows(options.rung, lambda other: load(path(name, other, options.out))):
            flow.save(file := path(name, rung.name, options.out))
            yield file, flow.figures
        return
    recipe: Any
    if kind == "split" and name in stiff.recipes():
        recipe, file = stiff.recipes()[name](), path(name, "sympflow", options.out)
        judge = recipe.measure
    elif kind in networks.KINDS and name in networks.recipes():
        recipe, file = networks.recipes()[name], path(name, kind, options.out)
        judge = recipe.judge
    else:
        return
    if options.measure:
        yield _measured(file, judge, options.keep)
    else:
        flow = recipe.train() if kind == "split" else recipe.train(kind)
        flow.save(file)
        yield file, flow.figures


def _measured(file: Path, judge: Callable[[Any], dict[str, Any]], keep: bool) -> tuple[Path, dict[str, Any]]:
    """A file and its figures, measured again, and kept in it if so wished."""
    flow = load(file)
    figures = judge(flow)
    if keep:
        flow.save(file)
    return file, figures


if __name__ == "__main__":
    main()
