"""`sympflow train`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sympflow.commands.arguments import one_scene, widths
from sympflow.commands.output import out, print_table, ready_file, reporting


def train(
    ctx: typer.Context,
    system: Annotated[str, typer.Argument(help="See `sympflow systems`; its parameters as --omega 100.")],
    dt: Annotated[float, typer.Option(help="Δt, the longest time of the map.")] = 1.0,
    kind: Annotated[str, typer.Option(help="sympflow, or mlp for the unconstrained baseline.")] = "sympflow",
    pairs: Annotated[int, typer.Option(help="Pairs of kick and drift.")] = 3,
    hidden: Annotated[str, typer.Option(help="Widths of the hidden layers of each potential.")] = "10,10",
    activation: Annotated[str, typer.Option(help="Activation function.")] = "tanh",
    optimizer: Annotated[str, typer.Option(help="adam or bfgs.")] = "adam",
    steps: Annotated[
        int | None, typer.Option("--steps", "--epochs", help="Training steps. Default: the optimizer's.")
    ] = None,
    points: Annotated[int | None, typer.Option(help="Collocation points a step. Default: the optimizer's.")] = None,
    learning_rate: Annotated[float, typer.Option(help="Largest learning rate.")] = 5e-3,
    residual_weight: Annotated[float, typer.Option(help="Weight of the residual loss.")] = 1.0,
    matching_weight: Annotated[float | None, typer.Option(help="Weight of Hamiltonian matching.")] = None,
    seed: Annotated[int, typer.Option(help="Of points and initial weights.")] = 0,
    to: Annotated[
        Path | None, typer.Option("--out", help="File for the flow. Default: SYSTEM-KIND.safetensors.")
    ] = None,
    checkpoint: Annotated[
        Path | None, typer.Option(help="File for the state of the run, written at intervals.")
    ] = None,
    resume: Annotated[Path | None, typer.Option(help="Go on from this checkpoint, given the same options.")] = None,
) -> None:
    """Train a flow for a system and save it.

    Examples:

      sympflow train henon-heiles --out mine.safetensors

      sympflow train pendulum --dt 0.5 --pairs 5 --epochs 50000 --checkpoint run.pt

      sympflow train harmonic-oscillator --omega 100 --dt 0.01 --kind mlp
    """
    with reporting():
        from sympflow.training.trainer import train as train_flow

        scene = one_scene([system, *ctx.args])
        to = to or Path(f"{scene.key}-{kind}.safetensors")
        if to.suffix != ".safetensors":
            raise ValueError(f"`--out` must end in .safetensors; got {str(to)!r}.")
        ready_file(to)
        flow = train_flow(
            scene.system,
            dt,
            kind=kind,
            pairs=pairs,
            hidden=widths(hidden),
            activation=activation,
            optimizer=optimizer,
            steps=steps,
            points=points,
            learning_rate=learning_rate,
            residual_weight=residual_weight,
            matching_weight=matching_weight,
            seed=seed,
            checkpoint=checkpoint,
            resume=resume,
        )
        flow.save(to)
        figures = [
            (k.replace("_", " "), f"{v:.3g}" if isinstance(v, float) else str(v)) for k, v in flow.figures.items()
        ]
        print_table(("figure", "value"), figures)
        out.print(f"Written: {to}. Use it with: sympflow compare {system} --methods {to},verlet")


def _brief(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
