"""`sympflow stability`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sympflow.commands.arguments import SCENES, interval, methods, parameters, scenes, state
from sympflow.commands.options import State, Systems, TEnd
from sympflow.commands.output import out, progress, ready_folder, reporting


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
                family = [SCENES[scene.key](**{name: value}) for value in values]
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
    if key not in SCENES:
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
