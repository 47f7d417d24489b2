"""The flows that ship with the package, and the command that makes them again.

python -m sympflow.training.pretrained                                  all of them
python -m sympflow.training.pretrained henon_heiles --kind sympflow     one
python -m sympflow.training.pretrained kepler --rung primed-3-0.08      one rung of a ladder of primed flows
python -m sympflow.training.pretrained --measure                        their figures, without training
python -m sympflow.training.pretrained --measure --keep                 and put them into the files
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sympflow.domain import Box, EnergySublevel
from sympflow.flow.io import load
from sympflow.system import HamiltonianSystem
from sympflow.systems import harmonic_oscillator, henon_heiles, pendulum
from sympflow.training.figures import measure, one_step_errors
from sympflow.training.ladder import certify, ladders
from sympflow.training.trainer import train

KINDS = ("sympflow", "mlp")


@dataclass(frozen=True)
class Recipe:
    """How a scene's networks are trained, the same for both architectures: by Gauss–Newton, in two stages.

    Parameters
    ----------
    system : HamiltonianSystem
    initial : callable
        The 100 initial states of the figures, drawn with seed 0.
    dt : float
        Δt.
    omega : float
        The frequency in whose units the figures are (see `measure`).
    points, steps : (int, int)
        Collocation points and steps of the stages.
    margin : float
        How much wider than the system's the domain is that is trained on, in energy: what a network does beyond its
        domain is arbitrary, and orbits at the edge come there.
    """

    system: HamiltonianSystem
    initial: Callable[[], np.ndarray]
    dt: float = 1.0
    omega: float = 1.0
    points: tuple[int, int] = (1000, 2500)
    steps: tuple[int, int] = (150, 100)
    margin: float = 1.0

    def train(self, kind: str, **options: Any) -> Any:
        """The flow, with its figures, and a certificate if it is symplectic."""
        first, second = zip(self.points, self.steps, strict=True)
        newton: dict[str, Any] = {"optimizer": "gauss-newton", "domain": self.domain, **options}
        before = time.process_time()
        flow = train(self.system, self.dt, kind=kind, points=first[0], steps=first[1], **newton)
        flow = train(self.system, flow=flow, points=second[0], steps=second[1], seed=1, **newton)
        flow.figures["training_cpu_seconds"] = round(time.process_time() - before, 3)
        self.judge(flow)
        return flow

    def judge(self, flow: Any) -> dict[str, Any]:
        """Its figures, measured (again), with a certificate if it is symplectic."""
        flow.figures |= self.measure(flow)
        at_end, between = one_step_errors(flow, self.system, self.initial(), omega=self.omega)
        flow.figures |= {"error_at_dt": at_end, "fractional_error": between}
        if flow.kind == "sympflow":
            certify(flow, self.system)
        return flow.figures

    @property
    def domain(self) -> EnergySublevel:
        """The domain that is trained on."""
        own = self.system.domain
        assert isinstance(own, EnergySublevel)
        low, high = np.array(own.box.low), np.array(own.box.high)
        middle, half = (low + high) / 2, (high - low) / 2 * max(1.0, self.margin)
        box = Box(middle - half, middle + half) if self.margin != 1.0 else own.box
        return EnergySublevel(self.margin * own.energy, box).attach(self.system.hamiltonian)

    def measure(self, flow: Any, steps: int = 1000) -> dict[str, Any]:
        """`measure` from the initial states of the recipe."""
        return measure(flow, self.system, self.initial(), steps=steps, omega=self.omega)


def _square(omega: float) -> np.ndarray:
    """(q, p/ω) uniform in [−1.2, 1.2]²."""
    return np.random.default_rng(0).uniform(-1.2, 1.2, (100, 2)) * np.array([1.0, omega])


def _well(energy: float) -> np.ndarray:
    """Uniform in the Hénon–Heiles well below an energy."""
    system = henon_heiles()
    assert isinstance(system.domain, EnergySublevel)
    return EnergySublevel(energy, system.domain.box).attach(system.hamiltonian).sample(100, 0)


def recipes() -> dict[str, Recipe]:
    """The recipes, by the name of the scene."""
    swing = pendulum()
    assert swing.domain is not None
    return {
        "henon_heiles": Recipe(henon_heiles(), lambda: _well(1 / 8), points=(1000, 4000)),
        "harmonic_oscillator": Recipe(harmonic_oscillator(), lambda: _square(1.0), margin=1.1),
        "pendulum": Recipe(swing, lambda: swing.domain.sample(100, 0), margin=1.03),  # type: ignore[union-attr]
        "harmonic_oscillator_100": Recipe(
            harmonic_oscillator(100.0), lambda: _square(100.0), dt=0.01, omega=100.0, margin=1.1
        ),
    }


def path(name: str, kind: str, folder: Path | None = None) -> Path:
    """The file of a scene's flow, in the package if no folder is given; a primed one's kind is primed-STAGES-DT."""
    folder = Path(str(resources.files("sympflow"))) / "pretrained" if folder is None else folder
    return folder / f"{name}-{kind}.safetensors"


def scenes() -> list[str]:
    """The names of all that ships, networks and ladders."""
    return list(dict.fromkeys([*recipes(), *ladders()]))


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="python -m sympflow.training.pretrained", description="Train the shipped flows."
    )
    parser.add_argument("scenes", nargs="*", metavar="scene", help=f"of {', '.join(scenes())}; all if none is named")
    parser.add_argument("--kind", choices=(*KINDS, "primed"), help="one architecture only")
    parser.add_argument("--rung", help="one rung only of a ladder of primed flows: primed-STAGES-DT")
    parser.add_argument("--out", type=Path, help="folder to write to (default: the package)")
    parser.add_argument("--measure", action="store_true", help="only measure the files that are there")
    parser.add_argument("--keep", action="store_true", help="with --measure: put the figures into the files")
    options = parser.parse_args(arguments)
    unknown = sorted(set(options.scenes) - set(scenes()))
    if unknown:
        parser.error(f"unknown scene {', '.join(unknown)}: choose from {', '.join(scenes())}")
    torch.set_num_threads(1)  # the arrays are small, and one thread is reproducible
    kinds = (options.kind,) if options.kind else ("primed",) if options.rung else (*KINDS, "primed")
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
        for rung, flow in ladder.flows(options.rung):
            flow.save(file := path(name, rung.name, options.out))
            yield file, flow.figures
    elif name in recipes():
        recipe, file = recipes()[name], path(name, kind, options.out)
        if options.measure:
            yield _measured(file, recipe.judge, options.keep)
        else:
            flow = recipe.train(kind)
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
