"""KnownFlow: a flow's system, its domain, its figures, and where these hold, apart from its map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from sympflow.arguments import warn
from sympflow.arrays import values
from sympflow.compiler import NotCompiled
from sympflow.flow.records import Provenance
from sympflow.hamiltonian.domain import Domain, EnergySublevel
from sympflow.hamiltonian.fingerprint import PROBES, Identity, check_for_flows, recognised, without_friction
from sympflow.hamiltonian.lattice_states import LatticeStates
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.protocol import Kernel

UNCOMPENSATED = (
    "`compensated` sums need the compiled loops of a primed flow, on NumPy float64 states: leave it out, or take a "
    "flow of SympFlow.primed."
)


@dataclass(frozen=True)
class Origin:
    """The system in the physical time that a flow in another time is for: see `sympflow.time_transformed`."""

    system: str
    fingerprint: tuple[float, ...]
    shift: float
    identity: Identity | None = None

    def is_of(self, system: HamiltonianSystem) -> bool:
        """Return True for that system, which is recognised by its H."""
        return recognised(self.fingerprint, self.identity, system)


class _Told:
    """An attribute of a flow that its provenance holds."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, flow: Any, owner: type | None = None) -> Any:
        return self if flow is None else getattr(flow.provenance, self.name)

    def __set__(self, flow: Any, value: Any) -> None:
        setattr(flow.provenance, self.name, value)


class KnownFlow:
    """A flow of a system, as far as it is known without its map."""

    kind: ClassVar[str]
    """The method of `solve` that runs it."""
    symplectic: ClassVar[bool] = False
    """True if ψ_t is the flow of a Hamiltonian, with an exact inverse; with friction conformally symplectic."""
    takes_friction: ClassVar[bool] = False
    """True if the maps of the family hold the friction of a damped system that they are made for."""
    takes_driving: bool = False
    """True if the maps of the family take the time, of a driven system that they are made for."""
    iterated: int = 0
    """Evaluations of ∇H and ∇²H in each of Newton's iterations, of a flow whose steps are found by these."""
    ndof: int
    dt: float
    provenance: Provenance
    _origin: tuple[dict[str, Any], Origin] | None = None

    domain, system_name, fingerprint, identity, lattice_terms = _Told(), _Told(), _Told(), _Told(), _Told()
    recipe, figures, certified, unfitted, drive_times = _Told(), _Told(), _Told(), _Told(), _Told()

    # its system -----------------------------------------------------------------------------------------------

    @property
    def origin(self) -> Origin | None:
        """The system in the physical time, for a flow in another time; None for a flow in its system's own time."""
        made = (self.recipe or {}).get("transforms")
        if made is None:
            return None
        if self._origin is None or self._origin[0] is not made:
            kept = made.get("identity")
            identity = None if kept is None else Identity.from_dict(kept, self.ndof - 1)
            self._origin = made, Origin(made["system"], tuple(made["fingerprint"]), made["shift"], identity)
        return self._origin[1]

    def identify(self, system: HamiltonianSystem, domain: Domain | None = None) -> None:
        """Make this the flow of a system, which it will know again: by its fingerprint, and by its H over a domain."""
        check_for_flows(system, self.takes_friction, self.takes_driving)
        self.lattice_terms = {} if system.local is None else dict(system.local.terms)
        small = self.known_by(system)
        self.fingerprint, self.system_name = small.fingerprint, system.name
        in_common_units = domain is not None or np.isfinite(small.fingerprint).all()
        self.identity = Identity.of(small, domain if in_common_units else small.domain)

    def known_by(self, system: HamiltonianSystem) -> HamiltonianSystem:
        """The system whose H the flow keeps to know another: a few sites of a lattice, else that system itself."""
        return system

    @property
    def kept_ndof(self) -> int:
        """The degrees of freedom of the system that identifies the flow, as in its file."""
        return self.ndof

    def matches(self, system: HamiltonianSystem) -> bool:
        """Return True if the flow is of this system, and in its time; a bare flow fits any of its size."""
        mine = self.fingerprint
        if mine is None:
            return system.ndof == self.ndof
        small = self.known_by(system)
        if small.ndof != self.kept_ndof:
            return False
        return recognised(mine, self.identity, small)

    def check_ends(self, system: HamiltonianSystem) -> None:
        """Refuse a lattice with ends of a kind for which the flow is not accurate."""

    def check_system(self, system: HamiltonianSystem) -> None:
        """Raise ValueError if `system` is not the one this flow was trained for (a bare flow fits any)."""
        self.check_functions(system)
        check_for_flows(system, self.takes_friction, self.takes_driving)
        any_size = system.few_sites is not system
        if self.fingerprint is not None and self.matches(system) and (any_size or system.ndof == self.ndof):
            self.check_ends(system)
            return
        origin = self.origin
        if origin is not None and origin.is_of(system):
            raise ValueError(
                f"`system` {system.name!r} is the one of this flow, but in another time: pass time_transformed(system, "
                f"{origin.shift:g}) here; solve(system, 'sympflow', flow=flow) runs it in the physical time."
            )
        remedy = "pass the flow of this system, or train one with sympflow.train(system)."
        if self.is_without_friction_of(system):
            raise ValueError(
                f"`system` {system.name!r} has friction, and the flow was trained without: its numbers cancel the "
                "errors of the conservative field alone, and with friction it would be tens to hundreds of times less "
                "accurate. Fit one to the damped system by sympflow.train(system), or from these numbers by "
                "sympflow.train(system, flow=flow.transferred(system))."
            )
        if system.local is not None and system.local.has_subsystem and self.lattice_terms:
            reason = _difference(self.lattice_terms, system.local.terms)
            damped = system.damping is not None or len(self.fingerprint or ()) > PROBES
            reason = reason or " (its friction is another)" * damped
            raise ValueError(
                f"`system` {system.name!r} is another {system.local.noun} than that of this flow{reason}: its numbers "
                f"cancel the errors of its own terms only. {remedy[0].upper()}{remedy[1:]}"
            )
        if system.local is not None and self.lattice_terms:
            raise ValueError(
                f"`system` {system.name!r} differs in kind from that of this flow: its parts differ, or it has "
                f"other forces or a box. {remedy[0].upper()}{remedy[1:]}"
            )
        if system.ndof != self.ndof:
            raise ValueError(
                f"`system` {system.name!r} has {system.ndof} degrees of freedom but the flow {self.ndof}: {remedy}"
            )
        if not self.matches(system):
            system.check_autonomous(
                f"and the flow was trained with another drive or none, for {self.system_name!r}: its amplitude, its "
                "frequency or another parameter differs",
                "pass the flow of this system, or train one with sympflow.train(system), from these numbers by "
                "sympflow.train(system, flow=flow.transferred(system))",
            )
            raise ValueError(
                f"`system` {system.name!r} is not the one that this flow was trained for ({self.system_name!r}, or its "
                f"parameters differ): {remedy}"
            )

    def is_without_friction_of(self, system: HamiltonianSystem) -> bool:
        """Return True if the flow is that of a damped system without its friction."""
        small = self.known_by(system)
        if self.fingerprint is None or small.ndof != self.kept_ndof:
            return False
        return without_friction(self.fingerprint, self.identity, small)

    def bound(self, system: HamiltonianSystem) -> Self:
        """Return this flow, ready to be used on `system`: one that is made of the system's functions takes them."""
        return self

    def domain_for(self, system: HamiltonianSystem) -> Domain | None:
        """Return Ω of the flow, or else of its system, ready for sampling; None if neither has one."""
        domain = self.domain or system.domain
        if isinstance(domain, LatticeStates):
            return domain.of(system)
        if isinstance(domain, EnergySublevel) and domain.hamiltonian is None:
            return system.domain if domain == system.domain else domain.attach(system.hamiltonian)
        return domain

    @property
    def driven(self) -> bool:
        """True for the flow of a driven system, whose maps take and give states [q, t, p] with their time."""
        return False

    @property
    def period(self) -> float | None:
        """The period in t0 of the flow of a driven system, where there is one."""
        return None

    def warn_of_times(self, t: Any) -> None:
        """Warn where a time, or one of several, is k·Δt + r with an r in an interval without labels."""
        if not self.unfitted:
            return
        seen = values(t)
        if seen is None:  # in a graph that torch.compile traces
            return
        times = np.abs(seen.astype(float)).reshape(-1)
        slack = 1e-9 * self.dt
        for low, high in self.unfitted:
            r = times % self.dt  # a multiple of Δt, up to rounding, is at one end or the other
            inside = (r > low + slack) & (r < high - slack) & (r > slack) & (r < self.dt - slack)
            if inside.any():
                warn(
                    f"The flow was fitted to labels, none of them at a time between {low:g} and {high:g}: its "
                    "values there were not compared. Ask for results at multiples of its "  # one text for all t
                    f"Δt = {self.dt:g}, or train it with labels at more times, or by loss='labels+residual'."
                )
                return

    def warn_of_drive(self, t0: Any, passed: Any) -> None:
        """Warn where a run over `passed` from t0 leaves the times for which a drive without a period was fitted."""
        if self.drive_times is None or t0 is None:
            return
        start, length = map(values, (t0, passed))
        if start is None or length is None:  # in a graph that torch.compile traces
            return
        if not (start.size and length.size and start.dtype.kind in "fiu"):
            return  # refused where it is used
        low, high = self.drive_times
        slack = 1e-9 * (high - low)
        first = float(start.min() + min(length.min(), 0.0))
        last = float(start.max() + max(length.max(), 0.0))
        if first < low - slack or last > high + slack:
            warn(
                f"The flow was fitted to a drive without a period for t from {low:g} to {high:g}, its system's "
                "`t_span`, and the run leaves these times: its figures do not hold there. Train it for a system with "
                "a longer `t_span`, give the system the `period` of its drive, or use a scheme such as 'kahan_li8'."
            )

    def clock_numbers(self) -> tuple[float, ...]:
        """Return the numbers of a trained clock, see `sympflow.flow.clocked`; () for a flow without one."""
        return ()

    # its runs -------------------------------------------------------------------------------------------------

    def kernel_for(self, system: HamiltonianSystem, compensated: bool = False) -> Kernel:
        """Return the compiled loops of the flow with its present weights, the same while these do not change."""
        if compensated:
            raise NotCompiled(UNCOMPENSATED)
        return self._loops_for(system)

    def _loops_for(self, system: HamiltonianSystem) -> Kernel:
        """The compiled loops without compensated sums."""
        raise NotCompiled(f"`method` {self.kind!r} has no compiled form: use backend='array'.")

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        """Count the evaluations of the system's own functions in a run; a network has none."""
        return {"force_evaluations": 0, "hessian_evaluations": 0}

    @property
    def system(self) -> HamiltonianSystem | None:
        """The system whose functions the flow evaluates; None where it is not known."""
        return None

    @property
    def thawed(self) -> Any:
        """The flow itself, a module of torch."""
        return self

    def check_functions(self, system: HamiltonianSystem) -> None:
        """Test the functions of a user's system, as the flow will call them."""
        system.check_functions(None)


def _difference(mine: Mapping[str, str], theirs: Mapping[str, str]) -> str:
    """The first term in which the system of a flow and another differ, as a clause; nothing where the texts agree."""
    for name in [*mine, *theirs]:
        if mine.get(name) != theirs.get(name):
            return f" (its {name} is {theirs.get(name, 'none')}, and not {mine.get(name, 'none')})"
    return ""
