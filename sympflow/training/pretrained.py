"""The flows that ship with the package, and the command that makes them again.

python -m sympflow.training.pretrained                                  all of them
python -m sympflow.training.pretrained henon_heiles --kind sympflow     one
python -m sympflow.training.pretrained --measure                        their figures, without training
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sympflow.domain import EnergySublevel
from sympflow.flow.io import load
from sympflow.system import HamiltonianSystem
from sympflow.systems import harmonic_oscillator, henon_heiles, pendulum
from sympflow.training.figures import measure
from sympflow.training.trainer import train

KINDS = ("sympflow", "mlp")


@dataclass(frozen=True)
class Recipe:
    """How a scene's flows are trained, the same for both architectures: Adam first, then BFGS.

    Parameters
    ----------
    system : HamiltonianSystem
    initial : callable
        The 100 initial states of the figures, drawn with seed 0.
    dt : float
        Δt.
    omega : float
        The frequency in whose units the figures are (see `measure`).
    adam, bfgs : int
        Steps of the two stages; one of BFGS is 20 iterations.
    points : int
        Collocation points of the second stage.
    """

    system: HamiltonianSystem
    initial: Callable[[], np.ndarray]
    dt: float = 1.0
    omega: float = 1.0
    adam: int = 3000
    bfgs: int = 200
    points: int = 2000

    def train(self, kind: str, **options: Any) -> Any:
        """The flow, with its figures."""
        flow = train(
            self.system,
            self.dt,
            kind=kind,
            steps=self.adam,
            learning_rate=1e-2,
            matching_weight=0.0,
            **options,
        )
        flow = train(
            self.system,
            flow=flow,
            optimizer="bfgs",
            steps=self.bfgs,
            points=self.points,
            refresh=50,
            matching_weight=0.0,
            validate_every=10,
            seed=1,
            **options,
        )
        flow.figures |= self.measure(flow)
        return flow

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
        "henon_heiles": Recipe(henon_heiles(), lambda: _well(1 / 8), bfgs=400, points=4000),
        "harmonic_oscillator": Recipe(harmonic_oscillator(), lambda: _square(1.0)),
        "pendulum": Recipe(swing, lambda: swing.domain.sample(100, 0)),  # type: ignore[union-attr]
        "harmonic_oscillator_100": Recipe(harmonic_oscillator(100.0), lambda: _square(100.0), dt=0.01, omega=100.0),
    }


def path(name: str, kind: str, folder: Path | None = None) -> Path:
    """The file of a scene's flow, in the package if no folder is given."""
    folder = Path(str(resources.files("sympflow"))) / "pretrained" if folder is None else folder
    return folder / f"{name}-{kind}.safetensors"


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="python -m sympflow.training.pretrained", description="Train the shipped flows."
    )
    parser.add_argument("scenes", nargs="*", metavar="scene", help=f"of {', '.join(recipes())}; all if none is named")
    parser.add_argument("--kind", choices=KINDS, help="one architecture only")
    parser.add_argument("--out", type=Path, help="folder to write to (default: the package)")
    parser.add_argument("--measure", action="store_true", help="only measure the files that are there")
    options = parser.parse_args(arguments)
    unknown = sorted(set(options.scenes) - set(recipes()))
    if unknown:
        parser.error(f"unknown scene {', '.join(unknown)}: choose from {', '.join(recipes())}")
    torch.set_num_threads(1)  # the arrays are small, and one thread is reproducible
    for name in options.scenes or recipes():
        recipe = recipes()[name]
        for kind in (options.kind,) if options.kind else KINDS:
            file = path(name, kind, options.out)
            if options.measure:
                figures = recipe.measure(load(file))
            else:
                flow = recipe.train(kind)
                flow.save(file)
                figures = flow.figures
            values = "  ".join(f"{k} {'diverges' if v is None else f'{v:.2e}'}" for k, v in figures.items())
            print(f"{name} {kind}: {values}", flush=True)


if __name__ == "__main__":
    main()
