"""Primed SympFlows: every potential is the system's own V or T times a trained function of t.

    kick    V_p(t, q) = t b(τ) V(q) − t³ γ(τ) ½|∇V(q)|²_{M⁻¹}        drift    V_m(t, p) = t a(τ) T(p)        τ = t/Δt

Frozen at any t such a flow is a splitting scheme, kicks b, force gradients γ and drifts a in the convention of
`sympflow.integrators.schemes`: a SympFlow of this kind is a table of numbers that varies smoothly with t.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch

from sympflow.flow.base import FlowMap
from sympflow.flow.coefficients import Coefficients
from sympflow.flow.layers import Drift, Kick
from sympflow.flow.placement import checked_device, checked_dtype
from sympflow.flow.primed_potentials import FORCE_GRADIENT, KINETIC, POTENTIAL, Binding, PrimedPotential, Term
from sympflow.flow.sympflow import SympFlow
from sympflow.integrators.schemes import SCHEMES, Scheme, compose

if TYPE_CHECKING:
    from sympflow.system import HamiltonianSystem

Kind = Literal["kick", "drift"]


class PrimedFlow(SympFlow):
    """A SympFlow of kicks and drifts, in turn, that are primed with V and T; made by `SympFlow.primed`.

    A palindromic one has even polynomials b, γ, a and reads the same backwards, so that it is time-reversible:
    continued to negative t by its formulas, ψ̄_{−t} = (ψ̄_t)⁻¹.

    Parameters
    ----------
    ndof : int
    first : {"kick", "drift"}
        The map that comes first.
    maps : int
        How many kicks and drifts there are together.
    degree : int
        Degree in t of t b(t/Δt) and t a(t/Δt).
    palindromic, force_gradient : bool
    dt : float
        Δt.
    system : HamiltonianSystem, optional
        Without it the flow has a `scheme`, but no values.
    dtype, device
        Of the parameters.

    Attributes
    ----------
    kicks, drifts : Coefficients
        b and a.
    gradients : Coefficients or None
        γ, one for each kick.
    """

    def __init__(
        self,
        ndof: int,
        first: Kind,
        maps: int,
        degree: int,
        palindromic: bool,
        force_gradient: bool,
        dt: float = 1.0,
        system: HamiltonianSystem | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        FlowMap.__init__(self, ndof, dt)
        for name, value in (("maps", maps), ("degree", degree)):
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"`{name}` must be a positive integer; got {value!r}.")
        if maps < 2 or (palindromic and maps % 2 == 0):
            raise ValueError(f"`maps` must be at least 2, and odd for a palindrome; got {maps}: add a kick or a drift.")
        other: Kind = "drift" if first == "kick" else "kick"
        self.sequence: tuple[Kind, ...] = tuple(first if i % 2 == 0 else other for i in range(maps))
        self.degree, self.palindromic = degree, palindromic
        exponents = tuple(range(0, degree, 2 if palindromic else 1))
        like: dict[str, Any] = {"dtype": checked_dtype(dtype), "device": checked_device(device)}
        n_kicks, n_drifts = self.sequence.count("kick"), self.sequence.count("drift")
        self.kicks = Coefficients(n_kicks, exponents, self.dt, 1, palindromic, 1.0, **like)
        self.drifts = Coefficients(n_drifts, exponents, self.dt, 1, palindromic, 1.0, **like)
        self.gradients = Coefficients(n_kicks, exponents, self.dt, 3, palindromic, **like) if force_gradient else None
        self._binding = Binding(system)
        # A tuple, not a ModuleList: the layers own no parameters, they share the three columns.
        self.layers = tuple(self._layer(kind, i // 2) for i, kind in enumerate(self.sequence))  # type: ignore[assignment]
        if system is not None:
            self.fingerprint, self.system_name = system.fingerprint, system.name

    def _layer(self, kind: Kind, i: int) -> Kick | Drift:
        if kind == "drift":
            return Drift(PrimedPotential(self.ndof, self._binding, [(KINETIC, self.drifts, i)]))
        terms: list[tuple[Term, Coefficients, int]] = [(POTENTIAL, self.kicks, i)]
        if self.gradients is not None:
            terms.append((FORCE_GRADIENT, self.gradients, i))
        return Kick(PrimedPotential(self.ndof, self._binding, terms))

    @classmethod
    def from_scheme(
        cls,
        system: HamiltonianSystem,
        scheme: Scheme,
        dt: float,
        degree: int,
        palindromic: bool,
        force_gradient: bool,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> PrimedFlow:
        """The flow that is, at every t, the given scheme."""
        if palindromic and not scheme.symmetric:
            raise ValueError(f"`scheme` {scheme.name!r} is not symmetric: take another, or palindromic=False.")
        if any(scheme.gradients) and not force_gradient:
            raise ValueError(f"`force_gradient` is False but {scheme.name!r} has force gradients: leave it out.")
        substeps = scheme.substeps
        first: Kind = "kick" if substeps[0][0] == "kick" else "drift"
        flow = cls(system.ndof, first, len(substeps), degree, palindromic, force_gradient, dt, system, dtype, device)
        for column, kind, entry in ((flow.kicks, "kick", 1), (flow.drifts, "drift", 1), (flow.gradients, "kick", 2)):
            if column is not None:
                table = np.zeros(tuple(column.offset.shape))
                table[:, 0] = [float(substep[entry]) for substep in substeps if substep[0] == kind]
                column.set(table)
        return flow

    # the frozen table ---------------------------------------------------------------------------------------

    def scheme(self, t: float | None = None) -> Scheme:
        """ψ̄_t as a splitting scheme of step t, for t ∈ (0, Δt]; the default is Δt.

        Its coefficients depend on t, and so it has no classical order.
        """
        t = self.dt if t is None else float(t)
        if not 0 < t <= self.dt * (1 + 1e-12):
            raise ValueError(f"`t` must lie in (0, dt] = (0, {self.dt:g}]; got {t!r}.")
        tau = t / self.dt
        kicks, drifts = self.kicks.at(tau).tolist(), self.drifts.at(tau).tolist()
        gradients = [0.0] * len(kicks) if self.gradients is None else self.gradients.at(tau).tolist()
        if self.sequence[0] == "drift":
            kicks, gradients = [0.0, *kicks], [0.0, *gradients]
        if self.sequence[-1] == "kick":
            drifts = [*drifts, 0.0]
        source = f"a SympFlow primed with {self.system_name}, Δt = {self.dt:g}, frozen at t = {t:g}"
        return Scheme("primed", None, tuple(kicks), tuple(drifts), tuple(gradients), source, self.gradients is not None)

    # its system ---------------------------------------------------------------------------------------------

    @property
    def system(self) -> HamiltonianSystem | None:
        """The system whose V and T the flow uses, None for one loaded without it."""
        return self._binding.system if self._binding.known else None

    def bind(self, system: HamiltonianSystem) -> PrimedFlow:
        """Give a flow that was loaded from a file the V and T of its system; itself.

        Raises
        ------
        ValueError
            If it is not the system that the flow was made for.
        """
        self.check_system(system)
        self._binding.bind(system)
        return self

    def bound(self, system: HamiltonianSystem) -> PrimedFlow:
        """This flow, bound to `system` if it was loaded without one."""
        return self if self._binding.known else self.bind(system)

    def architecture(self) -> dict[str, Any]:
        return {
            "ndof": self.ndof,
            "primed": {
                "first": self.sequence[0],
                "maps": len(self.sequence),
                "degree": self.degree,
                "palindromic": self.palindromic,
                "force_gradient": self.gradients is not None,
            },
        }


def primed(
    system: HamiltonianSystem,
    stages: int | None,
    dt: float,
    palindromic: bool,
    scheme: Scheme | str | None,
    degree: int,
    force_gradient: bool | None,
    dtype: torch.dtype,
    device: torch.device | str | None,
) -> PrimedFlow:
    """`SympFlow.primed`."""
    if not system.separable:
        raise ValueError(f"`system` {system.name!r} is not separable, so it has no V and T: use SympFlow(ndof).")
    if force_gradient is None:
        force_gradient = system.quadratic_kinetic
    elif force_gradient and not system.quadratic_kinetic:
        raise ValueError("`force_gradient` needs a kinetic energy ½ pᵀM⁻¹p: leave it out.")
    if scheme is None:
        stages = 6 if stages is None else stages
        if isinstance(stages, bool) or not isinstance(stages, int) or stages < 1:
            raise ValueError(f"`stages` must be a positive integer, the number of kicks; got {stages!r}.")
        scheme = compose("leapfrog", 2, (1 / stages,) * stages, "equal leapfrog steps")
    elif stages is not None:
        raise ValueError("`stages` and `scheme` were both given: leave out `stages`, the scheme has its own.")
    if isinstance(scheme, str):
        if scheme not in SCHEMES:
            raise ValueError(f"`scheme` {scheme!r} is unknown: choose one of {', '.join(SCHEMES)}.")
        scheme = SCHEMES[scheme]
    if (scheme.nystrom or any(scheme.gradients)) and not system.quadratic_kinetic:
        raise ValueError(f"`scheme` {scheme.name!r} needs a kinetic energy ½ pᵀM⁻¹p: take 'kahan_li8', for instance.")
    return PrimedFlow.from_scheme(system, scheme, dt, degree, palindromic, force_gradient, dtype, device)
