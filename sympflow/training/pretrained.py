"""The command that makes the flows that ship: networks, ladders of primed flows, flows of stiff systems.

python -m sympflow.training.pretrained                                  all of them
python -m sympflow.training.pretrained henon_heiles --kind sympflow     one
python -m sympflow.training.pretrained kepler --rung primed-3-0.08      one rung of a ladder of primed flows
python -m sympflow.training.pretrained kepler --workers 2                the ladder of a scene, by two processes
python -m sympflow.training.pretrained fput_50                          one of a stiff system
python -m sympflow.training.pretrained --measure                        their figures, without training
python -m sympflow.training.pretrained --measure --keep                 and put them into the files
python -m sympflow.training.pretrained --identify                       put the H that flows know into the files
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import torch

from sympflow.flow.files import load
from sympflow.flow.flow_map import FlowMap
from sympflow.training.shipped import rows
from sympflow.training.shipped.recipe import Recipe, file_of, made, scenes

KINDS = ("sympflow", "mlp", "primed", "split")


def package_folder() -> Path:
    """The folder of the files that ship."""
    return Path(str(resources.files("sympflow"))) / "pretrained"


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    recipes = rows.recipes()
    known, rungs = scenes(recipes), [recipe.name for recipe in recipes if recipe.kind == "primed"]
    parser = argparse.ArgumentParser(
        prog="python -m sympflow.training.pretrained", description="Train the shipped flows."
    )
    parser.add_argument("scenes", nargs="*", metavar="scene", help=f"of {', '.join(known)}; all if none is named")
    parser.add_argument("--kind", choices=KINDS, help="one architecture only")
    parser.add_argument("--rung", help="one rung only of a ladder of primed flows, for instance primed-3-0.08")
    parser.add_argument("--workers", type=int, default=1, help="processes that share the flows (default: 1)")
    parser.add_argument("--out", type=Path, help="folder to write to (default: the package)")
    parser.add_argument("--measure", action="store_true", help="only measure the files that are there")
    parser.add_argument("--keep", action="store_true", help="with --measure: put the figures into the files")
    parser.add_argument(
        "--identify", action="store_true", help="only put the H by which flows know their system into the files"
    )
    options = parser.parse_args(arguments)
    unknown = sorted(set(options.scenes) - set(known))
    if unknown:
        parser.error(f"unknown scene {', '.join(unknown)}: choose from {', '.join(known)}")
    if options.rung is not None and options.rung not in rungs:
        parser.error(f"unknown rung {options.rung}: choose from {', '.join(dict.fromkeys(rungs))}")
    torch.set_num_threads(1)  # as in the workers, which do the same as one
    wanted = [
        recipe
        for scene in options.scenes or known
        for recipe in recipes
        if recipe.scene == scene
        and options.kind in (None, recipe.kind)
        and (options.rung is None or (recipe.kind == "primed" and recipe.name == options.rung))
    ]
    for file, figures in _figures(wanted, options):
        values = "  ".join(f"{k} {'diverges' if v is None else f'{v:.2e}'}" for k, v in figures.items())
        print(f"{file.stem}: {values}", flush=True)


def _figures(recipes: list[Recipe], options: argparse.Namespace) -> Iterator[tuple[Path, dict[str, Any]]]:
    """The files of the recipes, as they are written or only measured, and their figures."""
    folder = package_folder() if options.out is None else options.out
    for recipe in recipes if options.identify or options.measure else ():
        path, figures = file_of(recipe, folder), {}
        flow = load(path)
        if options.identify:
            recipe.identify(flow)
        else:
            figures = recipe.measure(flow)
        if options.identify or options.keep:
            flow.save(path)
        yield path, figures
    if options.identify or options.measure:
        return

    def earlier(recipe: Recipe, name: str) -> FlowMap:
        return load(folder / f"{recipe.scene}-{name}.safetensors")

    for recipe, flow in made(recipes, earlier, workers=options.workers):
        flow.save(file_of(recipe, folder))
        yield file_of(recipe, folder), flow.figures


if __name__ == "__main__":
    main()
