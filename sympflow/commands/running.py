"""`sympflow solve`, `sympflow train` and `sympflow certificate`: one system, and a file of the result."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from typer import Option

from sympflow.arguments import MAX_ASKED_VALUES, check_counts
from sympflow.commands import completion, console, words
from sympflow.commands.console import Quiet, asked, out, print_table, ready_file, show
from sympflow.commands.words import Count, File, Number, OneMethod, Own, State, Step, Systems, TEnd, Text, TStart


def solve(
    ctx: typer.Context,
    system: Systems = None,
    own: Own = None,
    method_name: OneMethod = None,
    t_start: TStart = None,
    t_end: TEnd = None,
    y0: State = None,
    dt: Step = None,
    tol: Annotated[Number, Option(help="Choose the step, or the shipped flow, for this relative energy error.")] = None,
    tol_of: Annotated[Text, Option(help="What --tol is the error of: energy or state. Default: energy.")] = None,
    n_outputs: Annotated[Count, Option(help="Number of equal intervals between outputs. Default: every step.")] = None,
    save_every: Annotated[Count, Option(help="Only every so many-th step is an output.")] = None,
    backend: words.Backend = "auto",
    to: Annotated[File, Option("--out", help="File for the solution: .csv or .npz.")] = None,
    store: Annotated[File, Option(help="Folder that takes the outputs as they come, a zarr store.")] = None,
    resume: Annotated[bool, Option("--resume", help="Go on with the run in --store, given the same options.")] = False,
    checkpoint_every: Annotated[Number, Option(help="Seconds of work that a kill loses at most. Default: 10.")] = None,
    progress: Annotated[bool, Option("--progress", help="Show a bar on stderr.")] = False,
    quiet: Quiet = False,
) -> None:
    """Solve one system by one method.

    Examples:

      sympflow solve henon-heiles

      sympflow solve henon-heiles --method verlet --t-end 1000 --dt 0.01 --out orbit.csv

      sympflow solve harmonic-oscillator --omega 100 --out orbit.npz

      sympflow solve kepler --tol 1e-6

      sympflow solve pendulum --method rk45:rtol=1e-8 --y0 1.5,0

      sympflow solve "p**2/2 + q**4/4" --y0 1,0 --tol 1e-9

      sympflow solve own.py:spring --stiffness 4 --method kahan_li8

      sympflow solve --system quartic.toml --method gauss_legendre6 --out orbit.csv

      sympflow solve kepler --method kahan_li8 --t-end 1e6 --save-every 1000 --store kepler.zarr --resume --progress
    """
    from sympflow.metrics.energy import max_energy_error
    from sympflow.solver import solve as solve_system

    if to is not None and to.suffix not in (".csv", ".npz"):
        raise ValueError(f"`--out` must end in .csv or .npz; got {str(to)!r}.")
    scene = words.one_scene(system, own)
    chosen = None if method_name is None else words.configured(method_name)
    span = words.interval(scene, t_start, t_end)
    times = None if n_outputs is None else _instants(*span, n_outputs)
    ready_file(to)
    options = asked(ctx, "dt tol tol_of save_every store checkpoint_every backend resume")
    options["progress"] = progress and not quiet
    sol = solve_system(scene.system, chosen, span, words.state(y0), t_eval=times, **options)
    if to is not None:
        console.write_solution(sol, to)
    worst = "" if store is None else f" in {store}"
    if store is None and scene.system.shows_energy:
        worst = f", largest energy error {max_energy_error(sol) if len(sol.t) else np.nan:.2e}"
    out.print(console.in_options(sol.message, ctx), markup=False)
    out.print(f"{len(sol.t)} outputs{worst}")
    out.print(", ".join(f"{k} = {v:.4g}" if isinstance(v, float) else f"{k} = {v}" for k, v in sol.stats.items()))
    if store is None and len(sol.t):
        show(f"y({sol.t[-1]:g}) = [{', '.join(f'{x:.12g}' for x in sol.y[:, -1])}]")
    if to is not None:
        out.print(f"Written: {to}")
    if not sol.success:
        raise typer.Exit(1)


def _instants(start: float, end: float, n_outputs: int) -> np.ndarray:
    """The ends of so many equal intervals."""
    check_counts(n_outputs=n_outputs)
    if n_outputs >= MAX_ASKED_VALUES:
        raise ValueError(f"`n_outputs` must be less than {MAX_ASKED_VALUES:.0e}; got {n_outputs:.3g}: choose fewer.")
    return np.linspace(start, end, n_outputs + 1)


def train(
    ctx: typer.Context,
    system: Systems = None,
    own: Own = None,
    dt: Annotated[Number, Option(help="Δt, the longest time of the map. Default: what suits it.")] = None,
    kind: Annotated[
        Text,
        Option(
            help="primed (with V and T), sympflow (a network), or mlp (the baseline). Default: the best.",
            autocompletion=completion.of(("primed", "sympflow", "mlp")),
        ),
    ] = None,
    stages: Annotated[Count, Option(help="Kicks of a primed flow.")] = None,
    processor: Annotated[Count, Option(help="Kicks of a primed flow's processor; 0 for none.")] = None,
    pairs: Annotated[Count, Option(help="Pairs of kick and drift of a network. Default: 3.")] = None,
    hidden: Annotated[
        Text, Option(help="Widths of the hidden layers of each potential of a network. Default: 10,10.")
    ] = None,
    activation: Annotated[Text, Option(help="Activation function of a network. Default: tanh.")] = None,
    optimizer: Annotated[
        Text,
        Option(
            help="gauss-newton, adam, lbfgs or bfgs. Default: gauss-newton for primed flows, else adam.",
            autocompletion=completion.of(("gauss-newton", "adam", "lbfgs", "bfgs")),
        ),
    ] = None,
    steps: Annotated[Count, Option("--steps", "--epochs", help="Training steps. Default: the optimizer's.")] = None,
    points: Annotated[Count, Option(help="Collocation points a step. Default: the optimizer's.")] = None,
    learning_rate: Annotated[Number, Option(help="Largest learning rate of adam. Default: 0.005.")] = None,
    residual_weight: Annotated[Number, Option(help="Weight of the residual loss.")] = None,
    matching_weight: Annotated[Number, Option(help="Weight of Hamiltonian matching.")] = None,
    label_weight: Annotated[Number, Option(help="Weight of labels, the exact flow of states.")] = None,
    restarts: Annotated[Count, Option(help="Starts of the search for a primed flow.")] = None,
    time_budget: Annotated[Number, Option(help="Stop after so many seconds. Default: as long as it takes.")] = None,
    workers: Annotated[Count, Option(help="Processes that share the starts of a search; -1 for all cores.")] = None,
    seed: Annotated[int, Option(help="Of points and initial weights.")] = 0,
    to: Annotated[File, Option("--out", help="File for the flow. Default: SYSTEM-KIND.safetensors.")] = None,
    checkpoint: Annotated[File, Option(help="File for the state of the run, written at intervals.")] = None,
    resume: Annotated[File, Option(help="Go on from this checkpoint, given the same options.")] = None,
    quiet: Quiet = False,
) -> None:
    """Train a flow for a system and save it.

    By default a system with separable H gets a flow primed with its own V and T, in a minute at most.

    Any other, or where an option is one of networks, gets a SympFlow with neural potentials.

    Examples:

      sympflow train henon-heiles --out mine.safetensors

      sympflow train kepler --stages 4 --dt 0.2 --processor 0

      sympflow train pendulum --dt 0.5 --pairs 5 --epochs 50000 --checkpoint run.pt

      sympflow train harmonic-oscillator --omega 100 --dt 0.01 --kind mlp

      sympflow train quartic.toml --out quartic.safetensors
    """
    from sympflow.training.trainer import train as train_flow

    scene = words.one_scene(system, own)
    options = asked(ctx, "kind stages processor pairs activation optimizer steps points learning_rate restarts")
    options |= asked(ctx, "residual_weight matching_weight label_weight time_budget workers seed checkpoint resume")
    if hidden is not None:
        whole = "whole numbers separated by commas"
        options["hidden"] = tuple(words.parsed("--hidden", hidden, lambda text: words.numbers(text, int), whole))
    to = to or Path(f"{scene.key}-{kind or 'sympflow'}.safetensors")
    if to.suffix != ".safetensors":
        raise ValueError(f"`--out` must end in .safetensors; got {str(to)!r}.")
    ready_file(to)
    ready_file(checkpoint, "--checkpoint")
    flow = train_flow(scene.system, dt, **options)
    flow.save(to)
    rows = [(k.replace("_", " "), f"{v:.3g}" if isinstance(v, float) else str(v)) for k, v in flow.figures.items()]
    print_table(("figure", "value"), rows)
    out.print(f"Written: {to}. Use it with: sympflow compare {(system or own or [''])[0]} --methods {to},verlet")


def certificate(
    ctx: typer.Context,
    system: Systems = None,
    own: Own = None,
    flow_name: Annotated[
        Text,
        Option(
            "--flow",
            help="A flow that ships, or a .safetensors file. Default: the one that solve takes.",
            autocompletion=completion.flows,
        ),
    ] = None,
    t_end: Annotated[float, Option(help="How far the held-out orbits are followed.")] = 1000.0,
    states: Annotated[int, Option(help="States of the domain in the sample.")] = 2000,
    times: Annotated[int, Option(help="Times of a step in the sample.")] = 33,
    held_out: Annotated[int, Option(help="Orbits that are measured.")] = 100,
    seed: Annotated[int, Option(help="Of the sample and the orbits.")] = 0,
    to: Annotated[
        File, Option("--out", help="File: .json for the figures, .safetensors for the flow with them.")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Compute the certificate of a flow: estimates of its energy error from its Hamiltonian.

    Examples:

      sympflow certificate henon-heiles

      sympflow certificate pendulum --flow pendulum-sympflow --out pendulum.json

      sympflow certificate quartic.toml --flow quartic.safetensors --out certified.safetensors
    """
    from sympflow.flow.files import load
    from sympflow.flow.shipped import choose, named
    from sympflow.studies.reports import write_json

    if to is not None and to.suffix not in (".json", ".safetensors"):
        raise ValueError(f"`--out` must end in .json or .safetensors; got {str(to)!r}.")
    scene = words.one_scene(system, own)
    if flow_name is None:
        flow = choose(scene.system).load(scene.system)
    elif flow_name.endswith(".safetensors"):
        flow = load(flow_name, system=scene.system)
    else:
        flow = named(flow_name).load(scene.system)
    ready_file(to)
    end = t_end if scene.t_end is None else scene.t_end
    found = flow.certificate(scene.system, t_end=end, **asked(ctx, "states times held_out seed"))
    show(str(found))
    if to is not None:
        if to.suffix == ".json":
            write_json(found.to_dict(), to)
        else:
            flow.save(to)
        out.print(f"Written: {to}")
