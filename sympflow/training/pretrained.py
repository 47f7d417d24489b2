"""The command that makes the flows that ship again, each by the recipe in its file, and measures their figures.

python -m sympflow.training.pretrained                                  all of them
python -m sympflow.training.pretrained henon_heiles --kind sympflow     one
python -m sympflow.training.pretrained kepler --rung primed-3-0.08      one rung of a ladder of primed flows
python -m sympflow.training.pretrained kepler --workers 2                the ladder of a scene, by two processes
python -m sympflow.training.pretrained --measure                        their figures, without training
python -m sympflow.training.pretrained --measure --keep                 and put them into the files
python -m sympflow.training.pretrained --identify                       put the H that flows know into the files

A new one is trained by `sympflow.train`, saved in the folder as scene-name.safetensors, and measured with --keep.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import torch

from sympflow.training.shipped.recipe import Recipe, made

KINDS = ("sympflow", "mlp", "primed", "split", "kepler")


def package_folder() -> Path:
    """The folder of the files that ship."""
    return Path(str(resources.files("sympflow"))) / "pretrained"


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="python -m sympflow.training.pretrained", description="Train the shipped flows."
    )
    parser.add_argument("scenes", nargs="*", metavar="scene", help="the first word of the files' names; all if none")
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
    files = sorted(package_folder().glob("*.safetensors"))
    known = list(dict.fromkeys(file.stem.partition("-")[0] for file in files))
    rungs = [file.stem.partition("-")[2] for file in files]
    if unknown := sorted(set(options.scenes) - set(known)):
        parser.error(f"unknown scene {', '.join(unknown)}: choose from {', '.join(known)}")
    if options.rung is not None and options.rung not in rungs:
        parser.error(f"unknown rung {options.rung}: choose from {', '.join(dict.fromkeys(rungs))}")
    torch.set_num_threads(1)  # as in the workers, which do the same as one
    only_measured = options.out is not None and (options.identify or options.measure)
    wanted = [
        Recipe.of(options.out / file.name if only_measured else file)
        for file in files
        if (not options.scenes or file.stem.partition("-")[0] in options.scenes)
        and options.rung in (None, file.stem.partition("-")[2])
    ]
    wanted = [recipe for recipe in wanted if options.kind in (None, recipe.kind)]
    for name, figures in _figures(wanted, options):
        values = "  ".join(f"{k} {'diverges' if v is None else f'{v:.2e}'}" for k, v in figures.items())
        print(f"{name}: {values}", flush=True)


def _figures(recipes: list[Recipe], options: argparse.Namespace) -> Iterator[tuple[str, dict[str, Any]]]:
    """The names of flows, as they are written or only measured, and their figures."""
    if not (options.identify or options.measure):
        for recipe, flow in made(recipes, workers=options.workers):
            flow.save((recipe.path.parent if options.out is None else options.out) / recipe.path.name)
            yield recipe.name, flow.figures
        return
    for recipe in recipes:
        if options.identify:
            recipe.identify()
        else:
            recipe.measure()
        if options.identify or options.keep:
            recipe.flow.save(recipe.path)
        yield recipe.name, {} if options.identify else recipe.flow.figures


if __name__ == "__main__":
    main()
