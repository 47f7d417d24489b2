"""`sympflow systems`, `sympflow methods` and `sympflow flows`."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Annotated

import typer

from sympflow.commands import completion
from sympflow.commands.console import Quiet, out, print_table
from sympflow.commands.words import Own, Systems, made, one_scene, parameters, scene_names, shown

if TYPE_CHECKING:
    from sympflow.integrators.contract import Integrator


def systems(system: Systems = None, own: Own = None, quiet: Quiet = False) -> None:
    """List the systems, those of plug-ins too, their parameters and the flows that ship for them, or show one.

    Examples:

      sympflow systems

      sympflow systems henon-heiles
    """
    from sympflow.flow.shipped import shipped_flows

    if system or own:
        scene = one_scene(system, own).system
        ships = ", ".join(flow.name for flow in shipped_flows(scene)) or "none"
        out.print(scene.card().plain(), f"  trained flows: {ships}", sep="\n", markup=False)
        return
    rows = []
    for name in scene_names():
        try:
            scene = made(name)
        except Exception as error:  # of a plug-in, which must not take all others with it
            rows.append((name, str(error), "", "", "", ""))
            continue
        flows = shipped_flows(scene)
        primed = sum(f.stages is not None for f in flows)
        trained = [f"{f.kind} (Δt = {f.dt:g})" for f in flows if f.stages is None]
        trained += [f"{primed} primed"] if primed else []
        formula = textwrap.shorten(str(scene.symbols.H), 72, placeholder=" …") if scene.symbols else ""
        params = ", ".join(f"{k} = {shown(v)}" for k, v in parameters(name).items()) or "–"
        span = f"{scene.t_span[0]:g} … {scene.t_span[1]:g}"
        rows.append((name, formula, params, span, f"{scene.dt:g}", ", ".join(trained) or "–"))
    print_table(("name", "H", "parameters", "interval", "step", "trained flows"), rows)


def flows(system: Systems = None, own: Own = None, quiet: Quiet = False) -> None:
    """List the flows that ship, all or those of one system, the cheapest of a system first, with what each achieves.

    The cost is given in force evaluations for a unit of time.

    The energy error is relative, the largest up to T: the 95 % quantile over held-out states.

    `sympflow solve SYSTEM --tol 1e-6` takes the cheapest that meets it.
    """
    from sympflow.flow.shipped import HEADINGS, shipped_flows

    scene = one_scene(system, own).system if system or own else None
    rows = list(shipped_flows(scene).rows())
    if not rows and scene is not None:
        out.print(f"No flow ships for {scene.title}. `sympflow train` makes one.", markup=False)
        return
    print_table(HEADINGS, rows)


def methods(
    name: Annotated[
        str | None,
        typer.Argument(help="A method: show all its properties.", autocompletion=completion.one_method),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """List the methods with their orders, costs and sources, or show one with its options.

    Examples:

      sympflow methods

      sympflow methods srkn11b
    """
    from sympflow.integrators.registry import available, get

    if name is not None:
        cls = get(name)
        known = [*zip(TITLES, _cells(cls), strict=True), ("options", ", ".join(cls.options()))]
        lines = [(title, textwrap.wrap(cell, LISTED - 18) or [""]) for title, cell in known]
        rows = [(title * (k == 0), line) for title, cell in lines for k, line in enumerate(cell)]
        print_table((cls.name, ""), rows)
        return
    listed: list[tuple[str, ...]] = []
    for each in available():
        try:
            cls = get(each)
        except ImportError as error:
            listed.append((each, "", "", "", str(error)))
            continue
        listed.append((each, *_cells(cls)))
    print_table(("name", *TITLES), listed, width=LISTED)


TITLES = ("order", "symplectic", "forces a step", "source")
LISTED = 100  # columns of the list of methods, where the terminal has no more


def _cells(cls: type[Integrator]) -> tuple[str, ...]:
    order = "trained" if cls.trained else str(cls.order or "–")
    return order, "yes" if cls.symplectic else "no", cls.forces_a_step(), cls.summary()
