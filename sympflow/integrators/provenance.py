"""The provenance of a result: flat attributes that describe how it was made."""

from __future__ import annotations

import json
from dataclasses import fields
from typing import Any

from sympflow._version import __version__
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.contract import Integrator, Problem
from sympflow.integrators.registry import name_of
from sympflow.storage.identity import Known
from sympflow.storage.layout import UNITS

LONGEST_EXPRESSION = 10_000  # characters of H beyond which its text is left out


def option_text(integrator: Integrator) -> str:
    """Return the options of a method, but for its flow, as a text."""
    own = [f.name for f in fields(integrator) if f.name != "flow"]  # type: ignore[arg-type]
    return ", ".join(f"{name}={getattr(integrator, name)!r}" for name in own)


def flow_checksum(integrator: Integrator, system: HamiltonianSystem) -> str | None:
    """Return the checksum of the weights of the flow that a method uses for a system; None if it uses none."""
    flow = integrator.flow_for(system)
    if flow is None:
        return None
    from sympflow.flow.weights import checksum

    return checksum(flow.state_dict())


def provenance(
    system: HamiltonianSystem, integrator: Integrator, t_span: tuple[float, float]
) -> dict[str, str | float | list[float]]:
    """Return the attributes of a result of a method on a system: texts, numbers and lists, for JSON and NetCDF."""
    told: dict[str, Any] = {"sympflow_version": __version__, "system": system.name}
    if system.symbols is not None and len(system.symbols.text) <= LONGEST_EXPRESSION:
        told["hamiltonian"] = str(system.symbols.written[0])
    plain = {name: x if isinstance(x, int | float) else str(x) for name, x in system.params.items()}
    told["params"] = json.dumps(plain)
    if system.damping is not None:
        told["damping"] = json.dumps(system.damping.tolist())
    told |= {"method": name_of(integrator), "options": option_text(integrator), "t_span": list(t_span)}
    step = integrator.step_length(system)
    if step is not None:
        told["dt"] = float(step)
    checksum = flow_checksum(integrator, system)
    if checksum is not None:
        told["flow_checksum"] = checksum
    return told | {"units": UNITS}


def known_by(system: HamiltonianSystem, integrator: Integrator, backend: str) -> Known:
    """Return the identity of a stored call: the version, the system and the method, by all their parts."""
    known = Known({"version": __version__, "backend": backend})
    known.add("system", system.name, system)
    options = f"{name_of(integrator)}, {option_text(integrator)}, flow={flow_checksum(integrator, system)}"
    known.add("method", options, integrator, integrator.flow_for(system))
    return known


def run_identity(problem: Problem, integrator: Integrator, dt: float | None) -> Known:
    """Return the identity of a stored run: all but its end and the times of `t_eval`."""
    known, y0 = known_by(problem.system, integrator, problem.backend), problem.y0
    known.texts |= {
        "dt": f"{dt!r}{', backwards' if problem.t1 < problem.t0 else ''}",
        "t0": repr(problem.t0),
        "outputs": f"every {problem.save_every}-th step" if problem.t_eval is None else "t_eval",
    }
    known.add("y0", f"{y0.dtype} of shape {y0.shape}", y0)
    return known
