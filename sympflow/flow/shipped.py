"""The flows that ship with the package: their catalogue, and the choice among them by system and accuracy.

Only the headers of the files are read, once in a process: a flow's weights when it is wanted.
"""

from __future__ import annotations

import difflib
import json
import math
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sympflow.arguments import real_number
from sympflow.hamiltonian.fingerprint import Identity, recognised, without_friction

if TYPE_CHECKING:
    from sympflow.flow.known import KnownFlow
    from sympflow.hamiltonian.system import HamiltonianSystem
    from sympflow.systems.given import GivenSystem

DEFAULT_TOL = 1e-6
"""The relative energy error that the default flow of a system meets, if one does."""


@dataclass(frozen=True)
class ShippedFlow:
    """A flow in the package, as the header of its file describes it.

    Attributes
    ----------
    name : str
        Of the file, without its ending.
    kind : {"sympflow", "mlp"}
    system : str
    dt : float
        Δt.
    stages : int or None
        Number of kicks in a step of a primed flow, two in a row counted as one; None for a network.
    processor : int
        Number of pairs of its processor.
    polynomial : int
        Degree of the polynomials of its kicks, 0 for none.
    reach : int
        Steps to either side over which the processor of a flow of planets goes; 0 for other flows.
    cost : float or None
        Of a unit of time, in force evaluations, see `cost_of` in `sympflow.training.shipped.judges`. Outputs are
        not counted.
    energy_error : float or None
        Largest relative energy error up to `t_end`, that 95 % of the states of Ω stay below: an upper 99 % confidence
        limit of the quantile, from 1000 held-out states.
    t_end : float or None
    one_step_error, fractional_error : float or None
        Means over held-out states: at Δt, and over 50 times before it.
    training_seconds : float or None
    shift : float or None
        Of a flow on the logarithmic Hamiltonian of `system`, see `sympflow.time_transformed`; `dt` is then the physical
        length of its step, and its errors are those in the physical time. None for a flow of the system itself.
    path : Path
    """

    name: str
    kind: str
    system: str
    dt: float
    stages: int | None
    processor: int
    polynomial: int
    reach: int
    cost: float | None
    energy_error: float | None
    t_end: float | None
    one_step_error: float | None
    fractional_error: float | None
    training_seconds: float | None
    shift: float | None
    path: Path = field(repr=False)
    fingerprint: tuple[float, ...] = field(repr=False)
    identity: Identity | None = field(repr=False, default=None)

    @classmethod
    def of(cls, path: Path) -> ShippedFlow:
        """Return the description in the header of a file."""
        record = _record(path)
        figures, plan = record["figures"], record["architecture"]
        primed = plan.get("primed")
        origin = record["recipe"].get("transforms")  # of a flow in another time, the system that it is for
        of, ndof = (record, plan["ndof"]) if origin is None else (origin, plan["ndof"] - 1)
        kept = of.get("identity")
        return cls(
            name=path.stem,
            kind=record["kind"],
            system=of["system"],
            dt=record["dt"] if origin is None else figures["step"],
            stages=None if primed is None else primed["maps"] // 2,
            processor=0 if primed is None else primed.get("processor", 0),
            polynomial=0 if primed is None else max(map(sum, primed.get("monomials", ())), default=0),
            reach=plan.get("kepler", {}).get("reach", 0),
            energy_error=figures.get("energy_error_95"),
            cost=figures.get("cost"),
            t_end=figures.get("t_end"),
            one_step_error=figures.get("one_step_error"),
            fractional_error=figures.get("fractional_error"),
            training_seconds=figures.get("training_seconds"),
            shift=None if origin is None else origin["shift"],
            path=path,
            fingerprint=tuple(math.nan if v is None else v for v in of["fingerprint"]),
            identity=None if kept is None else Identity.from_dict(kept, ndof),
        )

    def is_of(self, system: HamiltonianSystem) -> bool:
        """Return True for a flow of that system, in whatever time, which is recognised by its H."""
        return recognised(self.fingerprint, self.identity, self._known_by(system))

    def _known_by(self, system: HamiltonianSystem) -> HamiltonianSystem:
        """The system by which a flow of this kind knows a system: see `FlowMap.known_by`."""
        return system.few_sites if self.stages is not None and not self.polynomial else system

    def is_without_friction_of(self, system: HamiltonianSystem) -> bool:
        """Return True for a flow of a damped system without its friction."""
        return without_friction(self.fingerprint, self.identity, self._known_by(system))

    def load(self, system: HamiltonianSystem | None = None) -> Any:
        """The flow itself; see `sympflow.load`."""
        from sympflow.flow.files import load  # torch, which a list of flows does not need

        if system is None or self.shift is None:
            return load(self.path, system=system)
        from sympflow.hamiltonian.time_transformation import time_transformed

        return load(self.path, system=time_transformed(system, self.shift))

    def known(self, system: HamiltonianSystem) -> KnownFlow:
        """The flow of a system for compiled runs: of one of numbers or of networks these, without torch."""
        if self.shift is not None or self.kind != "sympflow":
            return self.load(system)
        from sympflow.flow.frozen import FrozenFlow, FrozenNetwork

        if self.stages is not None:
            return FrozenFlow.of_file(self.path, system)
        return FrozenNetwork.of_file(self.path, system) or self.load(system)


class ShippedFlows(Sequence[ShippedFlow]):
    """Some of the flows that ship, which print as a table."""

    def __init__(self, flows: Sequence[ShippedFlow]) -> None:
        self._flows = tuple(flows)

    def __len__(self) -> int:
        return len(self._flows)

    def __getitem__(self, index: Any) -> Any:
        return ShippedFlows(self._flows[index]) if isinstance(index, slice) else self._flows[index]

    def rows(self) -> Iterator[tuple[str, ...]]:
        """A row of text for each: see `HEADINGS`."""
        for f in self._flows:
            architecture = f.kind if f.stages is None else f"primed, {f.stages} kicks"
            architecture = architecture if f.shift is None else "logarithmic, with a clock"
            architecture += f" of degree {f.polynomial}" if f.polynomial else ""
            architecture += f", processor {f.processor}" if f.processor else ""
            architecture = f"planets, reach {f.reach}" if f.reach else architecture
            until = "" if f.t_end is None else f" (T = {f.t_end:g})"
            yield (
                f.name,
                f.system,
                architecture,
                f"{f.dt:g}",
                *(_brief(v) for v in (f.cost, f.one_step_error, f.fractional_error)),
                _brief(f.energy_error) + until,
                "–" if f.training_seconds is None else f"{f.training_seconds:.3g} s",
            )

    def table(self) -> str:
        """A Markdown table."""
        lines = [HEADINGS, tuple("---" for _ in HEADINGS), *self.rows()]
        return "\n".join("| " + " | ".join(line) + " |" for line in lines)

    def __repr__(self) -> str:
        return self.table()


HEADINGS = (
    "flow",
    "system",
    "architecture",
    "Δt",
    "cost",
    "one-step error",
    "fractional t",
    "energy error, 95 %",
    "training",
)


def shipped_flows(system: GivenSystem | None = None, kind: str | None = None) -> ShippedFlows:
    """The flows that ship, the cheapest first: all, or those of a system, which is recognised by its H.

    Parameters
    ----------
    system : HamiltonianSystem, optional
    kind : {"sympflow", "mlp"}, optional

    Returns
    -------
    ShippedFlows
        A sequence that prints as a table. `flow.load(system)` reads one of them.

    Examples
    --------
    >>> sympflow.shipped_flows(sympflow.systems.pendulum())
    """
    if system is not None:
        from sympflow.systems.given import given_system

        system = given_system(system)
    if kind not in (None, "sympflow", "mlp"):
        raise ValueError(f"`kind` {kind!r} is unknown: choose 'sympflow' or 'mlp', or leave it out.")
    found = [f for f in _catalogue() if kind in (None, f.kind)]
    if system is not None:
        found = [f for f in found if f.is_of(system)]
    return ShippedFlows(sorted(found, key=lambda f: (f.system, math.inf if f.cost is None else f.cost)))


def check_tol(tol: Any) -> None:
    if tol is not None and not (real_number(tol) and 0 < tol < math.inf):
        raise ValueError(
            f"`tol` must be a positive number, a relative energy error; got {tol!r}: take 1e-6, for instance."
        )


def choose(
    system: HamiltonianSystem, kind: str = "sympflow", tol: float | None = None, transformed: bool = False
) -> ShippedFlow:
    """The flow that `solve` takes: with `tol` the cheapest whose energy error is at most that.

    Without `tol` it is the cheapest that reaches 1e-6, or else the most accurate of those whose error is known, or else
    the network. Flows in another time are among those only if `transformed`.

    Raises
    ------
    ValueError
        If there is none; the message lists those there are.
    """
    check_tol(tol)
    own = ShippedFlows([f for f in shipped_flows(system, kind) if transformed or f.shift is None])
    if not own:
        fits = [f for f in shipped_flows(kind=kind) if f.is_without_friction_of(system)]
        if fits:
            raise ValueError(
                f"`system` {system.name!r} has friction, and no {kind} flow that ships was trained with it; the "
                f"numbers of {fits[0].name} and others are for the system without. Train one with it by flow = "
                "sympflow.train(system) and pass flow=flow, or use a splitting method such as 'verlet' or 'kahan_li8'."
            )
        there = ", ".join(dict.fromkeys(f.system for f in shipped_flows(kind=kind)))
        raise ValueError(
            f"`system` {system.name!r} has no shipped {kind} flow (there are some for: {there or 'none'}): train one "
            "by "
            f"flow = sympflow.train(system{', kind=' + repr(kind) if kind != 'sympflow' else ''}) and pass flow=flow."
        )
    if tol is None:
        best = min(own, key=lambda f: (_error(f), f.stages is not None))
        return next((f for f in own if _error(f) <= DEFAULT_TOL), best)
    able = [f for f in own if _error(f) <= tol]
    if not able:
        there = ", ".join(f"{f.name} {_brief(f.energy_error)}" for f in own)
        others = [f.name for f in shipped_flows(system, kind) if f not in own and _error(f) <= tol]
        clock = (
            f"{', '.join(others)} meets it, but runs in another time, which only solve() can, on NumPy arrays of "
            "float64 and without `compensated`: pass these, or "
        )
        raise ValueError(
            f"`tol` {tol:g} is not met by any flow that ships for "
            f"{system.name!r}{' and can run here' if others else ''} (relative energy errors: {there}): "
            f"{clock if others else ''}raise it, or train a flow and pass flow=flow."
        )
    return able[0]


def shipped(system: HamiltonianSystem, kind: str = "sympflow", tol: float | None = None) -> Any:
    """Return the flow that the package ships for `system`, or a ValueError that lists those there are: see `choose`."""
    return choose(system, kind, tol).load(system)


def named(name: str) -> ShippedFlow:
    """The flow that ships under a name, that of its file; a ValueError says that there is none."""
    found = [f for f in _catalogue() if f.name == name]
    if not found:
        close = difflib.get_close_matches(name, [f.name for f in _catalogue()], n=3)
        hint = f"Is it {' or '.join(map(repr, close))}? " if close else ""
        raise ValueError(
            f"`flow` {name!r} does not name a flow that ships. {hint}`sympflow flows` lists them; flows from other "
            "files are read by sympflow.load."
        )
    return found[0]


def forces_saved(flow: ShippedFlow, system: HamiltonianSystem, tol: float) -> float:
    """Return how many forces a unit of time less a flow takes than the cheapest one in the system's own time."""
    try:
        plain = choose(system, flow.kind, tol)
    except ValueError:
        return math.inf
    return (plain.cost or 0.0) - (flow.cost or 0.0)


def _error(flow: ShippedFlow) -> float:
    return math.inf if flow.energy_error is None else flow.energy_error


def _brief(value: float | None) -> str:
    return "–" if value is None else f"{value:.1e}" if abs(value) < 0.01 or abs(value) >= 1e5 else f"{value:.3g}"


@cache
def _catalogue() -> tuple[ShippedFlow, ...]:
    folder = Path(str(resources.files("sympflow"))) / "pretrained"
    return tuple(ShippedFlow.of(path) for path in sorted(folder.glob("*.safetensors")))


def _record(path: Path) -> dict[str, Any]:
    """The record in the header of a file of our own; `flow.files` reads others, with suspicion."""
    with path.open("rb") as file:
        (length,) = struct.unpack("<Q", file.read(8))
        return json.loads(json.loads(file.read(length))["__metadata__"]["sympflow"])
