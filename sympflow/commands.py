"""The commands of `sympflow`. They parse, call the library, and print; nothing is computed here."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from sympflow import __version__
from sympflow.command_arguments import SCENES, interval, method, methods, one_scene, parameters, scenes, state, widths
from sympflow.command_output import out, print_table, progress, reporting, write_comparisons, write_solution

EXTRA = {"allow_extra_args": True, "ignore_unknown_options": True}
app = typer.Typer(no_args_is_help=True, add_completion=False, rich_markup_mode="rich", pretty_exceptions_enable=False)

Systems = Annotated[
    list[str],
    typer.Argument(metavar="SYSTEM...", help="See `sympflow systems`; parameters as --omega 100 or name:omega=100."),
]
TEnd = Annotated[float | None, typer.Option(help="End of the interval, which starts at 0. Default: the system's.")]
State = Annotated[str | None, typer.Option("--y0", help="Initial state q,p: 0.3,-0.3,0.3,0.15. Default: the system's.")]
Step = Annotated[float | None, typer.Option(help="Step of fixed-step methods. Default: the system's, the flow's Δt.")]
Backend = Annotated[str, typer.Option(help="auto, compiled or array.")]


@app.callback(invoke_without_command=True)
def _sympflow(version: Annotated[bool, typer.Option("--version", help="Print the version and leave.")] = False) -> None:
    """Structure-preserving integration of Hamiltonian systems, classical and learned."""
    if version:
        out.print(__version__)
        raise typer.Exit


@app.command("systems")
def systems_command() -> None:
    """List the built-in systems, their parameters and the flows that ship for them."""
    with reporting():
        from sympflow.flow.io import shipped

        rows = []
        for name, factory in SCENES.items():
            system = factory()
            flows = []
            for kind in ("sympflow", "mlp"):
                with contextlib.suppress(ValueError):
                    flows.append(f"{kind} (Δt = {shipped(system, kind).dt:g})")
            rows.append(
                (
                    name,
                    str(system.symbols.H) if system.symbols else "",
                    ", ".join(f"{k} = {v:g}" for k, v in parameters(name).items()) or "–",
                    f"{system.t_span[0]:g} … {system.t_span[1]:g}",
                    f"{system.dt:g}",
                    ", ".join(flows) or "–",
                )
            )
        print_table(("name", "H", "parameters", "interval", "step", "trained flows"), rows)


@app.command("methods")
def methods_command() -> None:
    """List the methods, their orders, costs and options."""
    with reporting():
        from sympflow.integrators.registry import available, get

        rows = []
        for name in available():
            try:
                cls = get(name)
            except ImportError as error:
                rows.append((name, "", "", "", "", str(error)))
                continue
            scheme = getattr(cls, "scheme", None)
            forces = "" if scheme is None else str(scheme.force_evaluations)
            if scheme is not None and scheme.hessian_evaluations:
                forces += f" + {scheme.hessian_evaluations} Hessian"
            source = scheme.source if scheme is not None else (cls.__doc__ or "").partition("\n")[0]
            order = "trained" if cls.trained else str(cls.order or "–")
            rows.append((name, order, "yes" if cls.symplectic else "no", forces, ", ".join(cls.options()), source))
        print_table(("name", "order", "symplectic", "forces a step", "options", "source"), rows)


@app.command("solve", context_settings=EXTRA)
def solve_command(
    ctx: typer.Context,
    system: Annotated[str, typer.Argument(help="See `sympflow systems`; its parameters as --omega 100.")],
    method_name: Annotated[str, typer.Option("--method", help="A name, name:option=number, or a .safetensors file.")],
    t_end: TEnd = None,
    y0: State = None,
    dt: Step = None,
    n_outputs: Annotated[
        int | None, typer.Option(help="Number of equal intervals between outputs. Default: every step.")
    ] = None,
    backend: Backend = "auto",
    to: Annotated[Path | None, typer.Option("--out", help="File for the solution: .csv or .npz.")] = None,
) -> None:
    """Solve one system by one method.

    Examples:

      sympflow solve henon-heiles --method verlet --t-end 1000 --dt 0.01 --out orbit.csv

      sympflow solve harmonic-oscillator --omega 100 --method sympflow --out orbit.npz

      sympflow solve pendulum --method rk45:rtol=1e-8 --y0 1.5,0
    """
    with reporting():
        from sympflow.metrics.energy import max_energy_error
        from sympflow.solver import solve

        if to is not None and to.suffix not in (".csv", ".npz"):
            raise ValueError(f"`--out` must end in .csv or .npz; got {str(to)!r}.")
        scene = one_scene([system, *ctx.args])
        chosen = method(method_name)
        chosen = chosen[1] if isinstance(chosen, tuple) else chosen
        span = interval(scene, t_end)
        times = None if n_outputs is None else np.linspace(*span, n_outputs + 1)
        options: dict[str, Any] = {} if dt is None else {"dt": dt}
        sol = solve(scene.system, chosen, span, state(y0), t_eval=times, backend=backend, **options)
        if to is not None:
            write_solution(sol, to)
        worst = max_energy_error(sol) if len(sol.t) else np.nan
        out.print(sol.message)
        out.print(f"{len(sol.t)} outputs, largest energy error {worst:.2e}")
        out.print(", ".join(f"{k} = {v:.4g}" if isinstance(v, float) else f"{k} = {v}" for k, v in sol.stats.items()))
        if len(sol.t):
            print(f"y({sol.t[-1]:g}) = [{', '.join(f'{x:.12g}' for x in sol.y[:, -1])}]")
        if to is not None:
            out.print(f"Written: {to}")
        if not sol.success:
            raise typer.Exit(1)


@app.command("compare", context_settings=EXTRA)
def compare_command(
    systems: Systems,
    method_names: Annotated[
        str,
        typer.Option("--methods", help="Separated by commas; options as rk45:rtol=1e-8; also .safetensors files."),
    ] = "sympflow,mlp,verlet,leapfrog,rk45",
    t_end: TEnd = None,
    y0: State = None,
    dt: Step = None,
    metrics: Annotated[
        str, typer.Option(help="Any of error,energy,drift,volume,symplecticity,reversal.")
    ] = "error,energy,drift,volume,symplecticity",
    n_outputs: Annotated[int, typer.Option(help="Number of instants at which every method is measured.")] = 1000,
    repeats: Annotated[int, typer.Option(help="Timed runs of each method, interleaved.")] = 5,
    match: Annotated[
        str | None, typer.Option(help="Tune the methods to the first in: time, evaluations or energy_error.")
    ] = None,
    backend: Backend = "auto",
    to: Annotated[Path | None, typer.Option("--out", help="Folder for the figures, CSV and JSON.")] = None,
) -> None:
    """Compare methods on one or more systems: a table, figures, CSV and JSON.

    Examples:

      sympflow compare henon-heiles --methods sympflow,mlp,verlet,leapfrog,rk45 --t-end 1000 --out out/

      sympflow compare harmonic-oscillator henon-heiles stiff-oscillator --out out/

      sympflow compare pendulum --methods verlet,kahan_li8:dt=0.5,rk45:rtol=1e-8 --match evaluations
    """
    with reporting():
        from sympflow.comparison import compare
        from sympflow.comparison_report import combined_table

        chosen, found = methods(method_names), scenes(systems)
        start = state(y0)
        with progress() as say:
            comparisons = [
                compare(
                    scene.system,
                    chosen,
                    [m.strip() for m in metrics.split(",") if m.strip()],
                    t_span=interval(scene, t_end),
                    y0=start,
                    dt=dt,
                    n_outputs=n_outputs,
                    repeats=repeats,
                    match=match,
                    backend=backend,
                    progress=say,
                )
                for scene in found
            ]
        print(combined_table(comparisons, out.width if out.is_terminal else None))
        if to is not None:
            with progress() as say:
                written = write_comparisons(comparisons, found, to, say)
            out.print(f"\nWritten to {to}: {', '.join(p.name for p in written)}")
        if not any(row.status == "ok" for c in comparisons for row in c.rows):
            raise typer.Exit(1)


@app.command("train", context_settings=EXTRA)
def train_command(
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
        from sympflow.training.trainer import train

        scene = one_scene([system, *ctx.args])
        to = to or Path(f"{scene.key}-{kind}.safetensors")
        if to.suffix != ".safetensors":
            raise ValueError(f"`--out` must end in .safetensors; got {str(to)!r}.")
        to.parent.mkdir(parents=True, exist_ok=True)
        flow = train(
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
