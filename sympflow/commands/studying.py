"""`sympflow compare`, `bench`, `stability` and `section`: methods on systems, and a folder of figures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from typer import Option

from sympflow.arguments import check_counts
from sympflow.commands import completion, console, words
from sympflow.commands.console import Quiet, asked, out, progress, ready_folder, show
from sympflow.commands.words import Count, File, Number, OneMethod, Own, State, Step, Systems, TEnd, Text, TStart

Methods = Annotated[
    str,
    Option(
        "--methods",
        "--method",
        help="Separated by commas; options as rk45:rtol=1e-8; also .safetensors files.",
        autocompletion=completion.methods,
    ),
]
Folder = Annotated[File, Option("--out", help="Folder for the figures, CSV and JSON.")]
DIRECTIONS = {"up": 1, "down": -1, "both": 0}


def compare(
    ctx: typer.Context,
    systems: Systems = None,
    own: Own = None,
    method_names: Methods = "sympflow, mlp, verlet, leapfrog, rk45",
    t_start: TStart = None,
    t_end: TEnd = None,
    y0: State = None,
    dt: Step = None,
    metrics: Annotated[
        Text,
        Option(
            help="Any of error, energy, drift, volume, symplecticity, reversal; of driven systems balance, of damped "
            "ones conformal. Default: all that apply, but reversal.",
            autocompletion=completion.metrics,
        ),
    ] = None,
    n_outputs: Annotated[int, Option(help="Number of instants at which every method is measured.")] = 1000,
    repeats: Annotated[int, Option(help="Timed runs of each method, interleaved.")] = 5,
    match: Annotated[
        Text,
        Option(
            help="Tune the methods to the first in: time, evaluations or energy_error.",
            autocompletion=completion.of(("time", "evaluations", "energy_error")),
        ),
    ] = None,
    backend: words.Backend = "auto",
    to: Folder = None,
    quiet: Quiet = False,
) -> None:
    """Compare methods on one or more systems: a table, figures, CSV and JSON.

    Examples:

      sympflow compare henon-heiles --methods sympflow,mlp,verlet,leapfrog,rk45 --t-end 1000 --out out/

      sympflow compare harmonic-oscillator henon-heiles stiff-oscillator --out out/

      sympflow compare pendulum --methods verlet,kahan_li8:dt=0.5,rk45:rtol=1e-8 --match evaluations
    """
    from sympflow.studies.comparison import combined_table
    from sympflow.studies.comparison import compare as compare_methods

    chosen = words.methods(method_names)
    found = words.scenes(systems, own)
    options = asked(ctx, "dt n_outputs repeats match backend") | {"y0": words.state(y0)}
    measured = None if metrics is None else words.listed(metrics)
    ready_folder(to)
    with progress() as say:
        options["progress"] = say
        spans = [words.interval(scene, t_start, t_end) for scene in found]
        comparisons = [
            compare_methods(scene.system, chosen, measured, t_span=span, **options)
            for scene, span in zip(found, spans, strict=True)
        ]
    show(combined_table(comparisons, out.width if out.is_terminal else None))
    if to is not None:
        with progress() as say:
            written = console.write_comparisons(comparisons, found, to, say)
        console.tell(to, written)
    if not any(row.status == "ok" for c in comparisons for row in c.rows):
        raise typer.Exit(1)


def bench(
    ctx: typer.Context,
    systems: Systems = None,
    own: Own = None,
    method_names: Methods = "verlet, leapfrog, blanes_moan4, srkn11b, kahan_li8, rk45, dop853, sympflow, mlp",
    t_start: TStart = None,
    t_end: TEnd = None,
    y0: State = None,
    batch: Annotated[
        Count,
        Option(help="Also a batch of this many states of the domain; 0 for none. Default: 1000 if there is a domain."),
    ] = None,
    n_outputs: Annotated[int, Option(help="Number of instants at which errors are measured.")] = 100,
    repeats: Annotated[int, Option(help="Timed runs of each point, interleaved.")] = 5,
    budget: Annotated[float, Option(help="Seconds that the repeats of one point may take.")] = 20.0,
    backend: words.Backend = "auto",
    to: Folder = None,
    quiet: Quiet = False,
) -> None:
    """Work and precision: error against run time and evaluations, over a sweep of steps and tolerances.

    Examples:

      sympflow bench henon-heiles --t-end 1000 --out out/

      sympflow bench pendulum --methods verlet,kahan_li8,dop853 --batch 0 --t-end 50
    """
    from sympflow.show.style import save
    from sympflow.studies.precision import work_precision

    chosen = words.methods(method_names)
    found = words.scenes(systems, own)
    options = asked(ctx, "n_outputs repeats budget backend") | {"y0": words.state(y0)}
    ready_folder(to)
    for scene in found:
        many = (1000 if batch is None and scene.system.domain is not None else batch) or None
        span = words.interval(scene, t_start, t_end)
        with progress() as say:
            report = work_precision(scene.system, chosen, t_span=span, batch=many, progress=say, **options)
        show(report.table())
        if to is not None:
            name = f"{scene.key}-work-precision"
            written = [report.to_csv(to / f"{name}.csv"), report.to_json(to / f"{name}.json")]
            figures = {to / f"{name}.png": report.measure, to / f"{name}-state.png": "error"}
            console.tell(to, written + [save(report.figure(measure), path) for path, measure in figures.items()])


def stability(
    ctx: typer.Context,
    systems: Systems = None,
    own: Own = None,
    method_names: Methods = "sympflow, verlet, leapfrog, kahan_li8, implicit_midpoint, rk4, rk45",
    vary: Annotated[Text, Option(help="A parameter and its values, for a stability map: omega=1,10,100.")] = None,
    steps: Annotated[
        Text, Option(help="Steps, separated by commas. Default: from half the system's to 64 times it.")
    ] = None,
    t_start: TStart = None,
    t_end: TEnd = None,
    y0: State = None,
    dtypes: Annotated[str, Option(help="float64, float32 or both, separated by a comma.")] = "float64",
    metrics: Annotated[
        str,
        Option(
            help="Any of energy, drift, volume, symplecticity, domain.",
            autocompletion=completion.several(("energy", "drift", "volume", "symplecticity", "domain")),
        ),
    ] = "energy, drift, volume, symplecticity, domain",
    bound: Annotated[float, Option(help="Relative energy error above which a run counts as unstable.")] = 1e3,
    limits: Annotated[bool, Option(help="Find the longest stable step by bisection.")] = True,
    to: Folder = None,
    quiet: Quiet = False,
) -> None:
    """The longest stable step of each method, its errors at a range of steps, and how it fails beyond.

    Examples:

      sympflow stability harmonic-oscillator --vary omega=1,1000,1000000 --methods verlet,leapfrog,implicit_midpoint

      sympflow stability henon-heiles-escape --out out/
    """
    from sympflow.studies.step_stability import stability as find_stability

    chosen = words.methods(method_names)
    found = words.scenes(systems, own)
    options = asked(ctx, "bound limits") | {"dtypes": words.listed(dtypes), "metrics": words.listed(metrics)}
    options["steps"] = words.parsed("--steps", steps, words.numbers, "numbers separated by commas")
    ready_folder(to)
    for scene in found:
        family = [scene.system]
        if vary is not None:
            name, values = words.varied(scene, vary)
            family = [scene.factory(**(scene.params | {name: value})) for value in values]
        span = None if (scene.t_end, t_start, t_end) == (None,) * 3 else words.interval(scene, t_start, t_end)
        with progress() as say:
            report = find_stability(family, chosen, t_span=span, y0=words.state(y0), progress=say, **options)
        show(report.table())
        if to is not None:
            written = report.to_csv(to / f"{scene.key}-stability.csv")
            picture = to / f"{scene.key}-stability.png"
            report.plot(picture)
            console.tell(to, [written, picture])


def section(
    ctx: typer.Context,
    system: Systems = None,
    own: Own = None,
    method_name: OneMethod = None,
    t_start: TStart = None,
    t_end: TEnd = None,
    y0: Annotated[
        list[str] | None,
        Option("--y0", help="Initial state q,p; repeat it for several orbits. Default: the system's."),
    ] = None,
    energy: Annotated[
        Number, Option(help="Instead: states of this energy on the plane, 16 or as many as --orbits.")
    ] = None,
    orbits: Annotated[Count, Option(help="Instead: so many initial states drawn from the domain.")] = None,
    seed: Annotated[int, Option(help="Of the states that are drawn.")] = 0,
    dt: Step = None,
    tol: Annotated[Number, Option(help="Choose the step, or the shipped flow, for this relative energy error.")] = None,
    coordinate: Annotated[
        Text, Option(help="The coordinate that is constant on the plane: q1, p2. Default: the first.")
    ] = None,
    level: Annotated[Number, Option(help="Its value there. Default: 0.")] = None,
    direction: Annotated[
        Text, Option(help="Crossings up, down or both. Default: up.", autocompletion=completion.of(tuple(DIRECTIONS)))
    ] = None,
    sample: Annotated[
        Number, Option(help="Longest time between two looks at the plane. Default: the system's step.")
    ] = None,
    period: Annotated[
        Number, Option(help="Instead of a plane: the states after each period. Default: that of a driven system.")
    ] = None,
    since: Annotated[Number, Option(help="Leave out what is before this time.")] = None,
    axes: Annotated[Text, Option(help="Coordinates of the figure, as q2,p2. Default: the first other pair.")] = None,
    turn: Annotated[
        Number, Option(help="Length of a turn of the first of them, such as 6.283185307 of an angle.")
    ] = None,
    limit: Annotated[int, Option(help="Crossings in the table; the files have all.")] = 20,
    to: Folder = None,
    quiet: Quiet = False,
) -> None:
    """A Poincaré section: the states in which orbits cross a plane of phase space, or those after each period.

    Examples:

      sympflow section henon-heiles --method kahan_li8 --t-end 1000 --out out/

      sympflow section henon-heiles --energy 0.125 --orbits 20 --t-end 2000 --out out/

      sympflow section own.py:spring --y0 0.1,0,0,0.4 --y0 0.2,0,0,0.3 --axes q2,p2 --out out/

      sympflow section duffing --method kahan_li8 --orbits 100 --t-end 2000 --since 200 --out out/
    """
    from sympflow.show.style import save
    from sympflow.studies.poincare import names, poincare_section

    scene = words.one_scene(system, own)
    chosen = None if method_name is None else words.configured(method_name)
    span = words.interval(scene, t_start, t_end)
    start = None if energy is not None and not y0 else _starts(scene, y0, orbits, seed)
    if direction is not None and direction not in DIRECTIONS:
        raise ValueError(f"`--direction` must be one of {', '.join(DIRECTIONS)}; got {direction!r}.")
    pair = [word.strip() for word in axes.split(",")] if axes is not None else [None, None]
    if len(pair) != 2 or not {*pair} <= {None, *names(scene.system.ndof)}:
        known = ", ".join(names(scene.system.ndof))
        raise ValueError(f"`--axes` must be two of {known}, separated by a comma; got {axes!r}.")
    check_counts(limit=limit)
    ready_folder(to)
    options = asked(ctx, "dt tol coordinate level sample period energy")
    if direction is not None:
        options["direction"] = DIRECTIONS[direction]
    if energy is not None:
        options |= {"n": orbits, "seed": seed}
    with progress() as say:
        say(f"{scene.key}: {method_name or 'section'}")
        found = poincare_section(scene.system, chosen, span, start, **options)
    if since is not None:
        found = found.since(since)
    show(found.table(limit))
    if to is not None:
        name = to / f"{scene.key}-section"
        figure = found.figure(pair[0], pair[1], turn)
        files = [found.to_csv(f"{name}.csv"), found.to_json(f"{name}.json"), save(figure, Path(f"{name}.png"))]
        console.tell(to, files)
    if not found.success:
        raise typer.Exit(1)


def _starts(scene: words.NamedSystem, y0: list[str] | None, orbits: int | None, seed: int) -> np.ndarray | None:
    """The initial states of several orbits: those given, or so many of the domain."""
    if orbits is None:
        states = [words.state(text) for text in y0 or ()]
        if len({row.size for row in states}) > 1:
            raise ValueError("`--y0` must have the same number of components each time it is given.")
        return None if not states else states[0] if len(states) == 1 else np.array(states)
    if y0:
        raise ValueError("`--orbits` and `--y0` both choose the initial states: give one of them.")
    check_counts(orbits=orbits)
    if scene.system.domain is None:
        raise ValueError(f"`--orbits` draws from the domain, and {scene.key} has none: give `--y0`, or a domain.")
    if seed < 0:
        raise ValueError(f"`--seed` must be a whole number from 0 on; got {seed}.")
    return scene.system.domain.sample(orbits, seed=seed)
