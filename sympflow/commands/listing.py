"""`sympflow systems` and `sympflow methods`."""

from __future__ import annotations

import contextlib
import textwrap

from sympflow.commands.arguments import SCENES, parameters, shown
from sympflow.commands.output import print_table, reporting


def systems() -> None:
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
                    textwrap.shorten(str(system.symbols.H), 72, placeholder=" …") if system.symbols else "",
                    ", ".join(f"{k} = {shown(v)}" for k, v in parameters(name).items()) or "–",
                    f"{system.t_span[0]:g} … {system.t_span[1]:g}",
                    f"{system.dt:g}",
                    ", ".join(flows) or "–",
                )
            )
        print_table(("name", "H", "parameters", "interval", "step", "trained flows"), rows)


def methods() -> None:
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
