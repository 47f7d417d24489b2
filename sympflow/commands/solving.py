"""`sympflow solve`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from sympflow.commands.arguments import interval, method, one_scene, state
from sympflow.commands.options import Backend, State, Step, TEnd
from sympflow.commands.output import out, ready_file, reporting, write_solution


def solve(
    ctx: typer.Context,
    system: Annotated[str, typer.Argument(help="See `sympflow systems`; its parameters as --omega 100.")],
    method_name: Annotated[
        str, typer.Option("--method", help="A name, name:option=number, or a .safetensors file.")
    ] = "sympflow",
    t_end: TEnd = None,
    y0: State = None,
    dt: Step = None,
    tol: Annotated[
        float | None, typer.Option(help="Take the cheapest shipped flow with so small a relative energy error.")
    ] = None,
    n_outputs: Annotated[
        int | None, typer.Option(help="Number of equal intervals between outputs. Default: every step.")
    ] = None,
    backend: Backend = "auto",
    to: Annotated[Path | None, typer.Option("--out", help="File for the solution: .csv or .npz.")] = None,
) -> None:
    """Solve one system by one method.

    Examples:

      sympflow solve henon-heiles

      sympflow solve henon-heiles --method verlet --t-end 1000 --dt 0.01 --out orbit.csv

      sympflow solve harmonic-oscillator --omega 100 --out orbit.npz

      sympflow solve kepler --tol 1e-6

      sympflow solve pendulum --method rk45:rtol=1e-8 --y0 1.5,0
    """
    with reporting():
        from sympflow.metrics.energy import max_energy_error
        from sympflow.solver import solve as solve_system

        if to is not None and to.suffix not in (".csv", ".npz"):
            raise ValueError(f"`--out` must end in .csv or .npz; got {str(to)!r}.")
        scene = one_scene([system, *ctx.args])
        chosen = method(method_name)
        chosen = chosen[1] if isinstance(chosen, tuple) else chosen
        span = interval(scene, t_end)
        times = None if n_outputs is None else np.linspace(*span, n_outputs + 1)
        if to is not None:
            ready_file(to)
        options: dict[str, Any] = {name: value for name, value in (("dt", dt), ("tol", tol)) if value is not None}
        sol = solve_system(scene.system, chosen, span, state(y0), t_eval=times, backend=backend, **options)
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
