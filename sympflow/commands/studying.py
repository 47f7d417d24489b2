"""`sympflow compare`, `sympflow bench` and `sympflow stability`: several methods, and a folder of figures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sympflow.commands.console import out, progress, ready_folder, reporting, write_comparisons
from sympflow.commands.words import (
    Backend,
    State,
    Step,
    Systems,
    TEnd,
    interval,
    made,
    methods,
    parameters,
    scene_names,
    scenes,
    state,
)


def compare(
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
        from sympflow.studies.comparison import combined_table
        from sympflow.studies.comparison import compare as compare_methods

        chosen, found = methods(method_names), scenes(systems)
        start = state(y0)
        if to is not None:
            ready_folder(to)
        with progress() as say:
            comparisons = [
                compare_methods(
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


def bench(
    systems: Systems,
    method_names: Annotated[
        str, typer.Option("--methods", help="As for compare; a bare name is swept over steps or tolerances.")
    ] = "verlet,leapfrog,blanes_moan4,srkn11b,kahan_li8,rk45,dop853,sympflow,mlp",
    t_end: TEnd = None,
    y0: State = None,
    batch: Annotated[int, typer.Option(help="Also a batch of this many states of the domain; 0 for none.")] = 1000,
    n_outputs: Annotated[int, typer.Option(help="Number of instants at which errors are measured.")] = 100,
    repeats: Annotated[int, typer.Option(help="Timed runs of each point, interleaved.")] = 5,
    budget: Annotated[float, typer.Option(help="Seconds that the repeats of one point may take.")] = 20.0,
    backend: Backend = "auto",
    to: Annotated[Path | None, typer.Option("--out", help="Folder for the figures, CSV and JSON.")] = None,
) -> None:
    """Work and precision: error against run time and evaluations, over a sweep of steps and tolerances.

    Examples:

      sympflow bench henon-heiles --t-end 1000 --out out/

      sympflow bench pendulum --methods verlet,kahan_li8,dop853 --batch 0 --t-end 50
    """
    with reporting():
        from sympflow.studies.figure_style import save
        from sympflow.studies.precision import work_precision

        chosen, found, start = methods(method_names), scenes(systems), state(y0)
        if to is not None:
            ready_folder(to)
        for scene in found:
            with progress() as say:
                report = work_precision(
                    scene.system,
                    chosen,
                    t_span=interval(scene, t_end),
                    y0=start,
                    batch=batch or None,
                    n_outputs=n_outputs,
                    repeats=repeats,
                    budget=budget,
                    backend=backend,
                    progress=say,
                )
            print(report.table())
            if to is not None:
                name = f"{scene.key}-work-precision"
                written = [report.to_csv(to / f"{name}.csv"), report.to_json(to / f"{name}.json")]
                figures = {to / f"{name}.png": "energy_error", to / f"{name}-state.png": "error"}
                written += [save(report.figure(measure), path) for path, measure in figures.items()]
                out.print(f"\nWritten to {to}: {', '.join(p.name for p in written)}")


def stability(
    systems: Systems,
    method_names: Annotated[
        str, typer.Option("--methods", help="As for compare.")
    ] = "sympflow,verlet,leapfrog,kahan_li8,implicit_midpoint,rk4,rk45",
    vary: Annotated[
        str | None, typer.Option(help="A parameter and its values, for a stability map: omega=1,10,100.")
    ] = None,
    steps: Annotated[
        str | None, typer.Option(help="Steps, separated by commas. Default: from half the system's to 64 times it.")
    ] = None,
    t_end: TEnd = None,
    y0: State = None,
    dtypes: Annotated[str, typer.Option(help="float64, float32 or both, separated by a comma.")] = "float64",
    metrics: Annotated[
        str, typer.Option(help="Any of energy,drift,volume,symplecticity,domain.")
    ] = "energy,drift,volume,symplecticity,domain",
    bound: Annotated[float, typer.Option(help="Relative energy error above which a run counts as unstable.")] = 1e3,
    limits: Annotated[bool, typer.Option(help="Find the longest stable step by bisection.")] = True,
    to: Annotated[Path | None, typer.Option("--out", help="Folder for the figures and CSV.")] = None,
) -> None:
    """The longest stable step of each method, its errors at a range of steps, and how it fails beyond.

    Examples:

      sympflow stability harmonic-oscillator --vary omega=1,1000,1000000 --methods verlet,leapfrog,implicit_midpoint

      sympflow stability henon-heiles-escape --out out/
    """
    with reporting():
        from sympflow.studies.step_stability import stability as find_stability

        chosen, found = methods(method_names), scenes(systems)
        lengths = None if steps is None else [_number("--steps", word) for word in steps.split(",")]
        if to is not None:
            ready_folder(to)
        for scene in found:
            family = [scene.system]
            if vary is not None:
                name, values = _varied(scene.key, vary)
                family = [made(scene.key, **{name: value}) for value in values]
            span = None if scene.t_end is None and t_end is None else interval(scene, t_end)
            with progress() as say:
                report = find_stability(
                    family,
                    chosen,
                    steps=lengths,
                    t_span=span,
                    y0=state(y0),
                    dtypes=[word.strip() for word in dtypes.split(",") if word.strip()],
                    metrics=[word.strip() for word in metrics.split(",") if word.strip()],
                    bound=bound,
                    limits=limits,
                    progress=say,
                )
            print(report.table())
            if to is not None:
                written = [report.to_csv(to / f"{scene.key}-stability.csv")]
                report.plot(to / f"{scene.key}-stability.png")
                out.print(f"\nWritten to {to}: {written[0].name}, {scene.key}-stability.png")


def _varied(key: str, words: str) -> tuple[str, list[float]]:
    """The parameter and its values in ``omega=1,10,100``."""
    name, equals, values = words.partition("=")
    if not (equals and values):
        raise ValueError(f"`--vary` must be a parameter and its values, such as omega=1,10,100; got {words!r}.")
    if key not in scene_names():
        raise ValueError(f"`--vary` goes with a scene without parameters of its own; got {key}: leave those out.")
    if name not in parameters(key):
        takes = ", ".join(parameters(key)) or "none"
        raise ValueError(f"`--vary` names {name!r}, which is not a parameter of {key}; it has {takes}.")
    return name, [_number("--vary", word) for word in values.split(",")]


def _number(option: str, word: str) -> float:
    try:
        return float(word)
    except ValueError as error:
        raise ValueError(f"`{option}` must hold numbers separated by commas; got {word!r}.") from error
