"""`sympflow learn`: from a file of trajectories to a file of a flow, with a report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Option

from sympflow.commands.console import Quiet, asked, out, print_table, ready_file, show
from sympflow.commands.words import File, Number, Text, Usage, numbers, one_scene, parsed

if TYPE_CHECKING:
    from sympflow.hamiltonian.system import HamiltonianSystem


def learn(
    ctx: typer.Context,
    data: Annotated[Path, typer.Argument(help="A CSV, Parquet, npz, NetCDF or zarr file: t, q1 …, p1 …, the orbit.")],
    ndof: Annotated[int | None, Option(help="Degrees of freedom, where columns have other names.")] = None,
    dt: Annotated[Number, Option(help="Δt of the flow. Default: what suits its frequencies.")] = None,
    noise: Annotated[Number, Option(help="Standard deviation of the data. Default: estimated.")] = None,
    period: Annotated[Number, Option(help="Of all q, if these are angles.")] = None,
    damping: Annotated[bool, Option("--damping", help="Learn a rate of friction as well.")] = False,
    drag: Annotated[bool, Option("--drag", help="Learn quadratic drag instead.")] = False,
    drive: Annotated[Text, Option(help="Learn a drive as well: its angular frequency, about, or find.")] = None,
    separable: Annotated[
        bool | None,
        Option("--separable/--not-separable", help="H = T(p) + V(q), or known not to be. Default: by the data."),
    ] = None,
    mass: Annotated[Text, Option(help="M of T = p²/2M, one number or d of them, as 1,2.5.")] = None,
    known: Annotated[
        Text, Option(help="A system that is a part of H, as own.toml or pendulum; the rest is learned.")
    ] = None,
    family: Annotated[
        Text, Option(help="The only family of models, as polynomial, network or sympflow. Default: all.")
    ] = None,
    order: Annotated[
        str, Option(help="Of columns without the names q1 …: halves, q1 q2 p1 p2, or pairs, q1 p1 q2 p2.")
    ] = "halves",
    observed: Annotated[
        str, Option(help="qp, states; qv, positions and velocities, of a mass that is not known; q, positions alone.")
    ] = "qp",
    loss: Annotated[str, Option(help="squares, or huber for data with outliers.")] = "squares",
    unit: Annotated[
        list[str] | None, Option("--unit", help="Units of columns, as t=ms, q=deg, p=deg/ms; may be repeated.")
    ] = None,
    seed: Annotated[int, Option(help="Which trajectories are held out.")] = 0,
    time_budget: Annotated[float, Option(help="Time limit in seconds.")] = 60.0,
    checkpoint: Annotated[File, Option(help="File to keep the state of the run in.")] = None,
    resume: Annotated[File, Option(help="Checkpoint to go on from.")] = None,
    to: Annotated[Path, Option("--out", help="File for the flow.")] = Path("flow.safetensors"),
    plot: Annotated[File, Option(help="File for a figure: predictions and energies, held out.")] = None,
    quiet: Quiet = False,
) -> None:
    """Learn a flow, and the H behind it, from trajectories.

    Examples:

      sympflow learn data.csv --ndof 2 --out flow.safetensors

      sympflow learn pendulum.csv --period 360 --unit t=ms --plot report.png

      sympflow learn spring.parquet --damping --time-budget 60

      sympflow learn camera.csv --observed q --ndof 2

      sympflow learn orbits.csv --mass 1,2.5 --known own.toml --family polynomial
    """
    from sympflow.learning.learner import learn as learn_flow
    from sympflow.learning.trajectories import Trajectories

    if damping and drag:
        raise ValueError("`--drag` is learned in place of `--damping`: leave out one of them.")
    ready_file(to)
    ready_file(plot, "--plot")
    runs = Trajectories.read(data, ndof, units=_units(unit), order=order, period=period, observed=observed)
    out.print(f"{len(runs.runs)} trajectories, {runs.n_points} points, {runs.ndof} degree(s) of freedom")
    options = asked(ctx, "dt noise period separable family loss seed time_budget checkpoint resume")
    options["damping"] = "quadratic" if drag else damping
    found = drive in (None, "find")
    options["drive"] = bool(drive) if found else parsed("--drive", drive, float, "an angular frequency, or find")
    masses = parsed("--mass", mass, numbers, "a number, or numbers with commas, as 1,2.5")
    options["mass"] = masses[0] if masses and len(masses) == 1 else masses
    flow = learn_flow(runs, known=_known(known), progress=not quiet, **options)
    flow.save(to)
    cells = "{model} {parameters} {held_out_loss:.4g} {correlation:.2f}"
    titles = ("model", "numbers", "held-out loss", "correlation")
    print_table(titles, [[form.format(**h) for form in cells.split()] for h in flow.history])
    learned = flow.recipe["learned"]
    out.print(f"Chosen: {learned['model']}, because {learned['reason']}", markup=False)
    formula = learned.get("physical")
    show("H is the flow's own, not a formula." if formula is None else f"H = {formula}")
    if learned.get("drag"):
        show(f"drag = {', '.join(learned['drag'])}")
    if flow.system.friction:
        show(f"damping = {flow.system.friction.damping.tolist()}")
    shown = {k: v for k, v in flow.figures.items() if k.startswith(("held_out_error", "noise", "energy_scatter"))}
    out.print(", ".join(f"{k} = {v:.3g}" for k, v in shown.items() if v is not None))
    out.print(f"Written: {to}")
    if plot is not None:
        from sympflow.learning.figures import held_out_figure

        held_out_figure(flow, runs.split(seed=seed)[1]).savefig(plot, dpi=110)
        out.print(f"Written: {plot}")


def _units(given: list[str] | None) -> dict[str, str]:
    """The units of columns by their names."""
    made = {}
    for one in given or []:
        name, sign, unit = one.partition("=")
        if not sign:
            raise ValueError(f"`--unit` must be a column and its unit, as t=ms; got {one!r}.")
        made[name] = unit
    return made


def _known(word: str | None) -> HamiltonianSystem | None:
    """The part of H that is known."""
    try:
        return None if word is None else one_scene([word]).system
    except ValueError as error:
        raise Usage(str(error).replace("`system`", "`--known`")) from error
