"""Primed SympFlows: every potential is the system's own V or T times a trained function of t.

    kick    V_p(t, q) = t b(τ) V(q) − t³ γ(τ) ½|∇V(q)|²_{M⁻¹} + t⁵ c(τ) ½ v·∇²V(q) v,   v = M⁻¹∇V(q)
    drift   V_m(t, p) = t a(τ) T(p)                                                         τ = t/Δt

In place of the last two terms a kick may have a trained polynomial, t³ Σ_m e_m(τ) q^m.

Frozen at any t such a flow is a splitting scheme, kicks b, force gradients γ, curvatures c and drifts a in the
convention of `sympflow.integrators.scheme`: a SympFlow of this kind is a table of numbers that varies smoothly with t.

With a processor it is ψ̄_t = χ_t ∘ K_t ∘ χ_t⁻¹, the kernel K and the processor χ being such tables: over many steps
of Δt only K is executed, as the χ between two steps cancel.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from sympflow.flow.base import FlowMap
from sympflow.flow.coefficients import Coefficients, Entry
from sympflow.flow.frozen import KeptTables, Kind, Substep, Tables
from sympflow.flow.layers import Drift, Kick
from sympflow.flow.placement import checked_device, checked_dtype
from sympflow.flow.primed_potentials import (
    CURVATURE,
    FORCE_GRADIENT,
    KINETIC,
    POTENTIAL,
    Binding,
    PolynomialTerm,
    PrimedPotential,
    Term,
)
from sympflow.flow.sequences import Terms, alternating, columns_of, substeps_of
from sympflow.flow.sympflow import SympFlow
from sympflow.hamiltonian.monomials import Monomials
from sympflow.schemes import Scheme

if TYPE_CHECKING:
    from sympflow.flow.potentials import Time
    from sympflow.hamiltonian.system import HamiltonianSystem
    from sympflow.kernels.primed_flow import PrimedFlowKernel


class PrimedFlow(SympFlow):
    """A SympFlow of kicks and drifts, in turn, that are primed with V and T; made by `SympFlow.primed`.

    A palindromic one has even polynomials b, γ, c, a, and its kernel reads the same backwards, which makes K
    time-reversible: continued to negative t by its formulas, K_{−t} = K_t⁻¹. With a processor ψ̄ is conjugate to it.

    Parameters
    ----------
    ndof : int
    first : {"kick", "drift"}
        The map that comes first, in the kernel and in the processor.
    maps : int
        How many kicks and drifts the kernel has.
    degree : int
        Degree in t of t b(t/Δt) and t a(t/Δt).
    palindromic, force_gradient : bool
    dt : float
        Δt.
    system : HamiltonianSystem, optional
        Without it the flow has a `scheme`, but no values.
    processor : int
        Number C of pairs of χ, 2C + 1 maps; 0 for none.
    curvature : bool
        Whether kicks with force gradients have curvature terms too, for symbolic systems.
    monomials : tuple of tuple of int
        The exponents m of polynomials that stand in place of both, for symbolic systems; none for none.
    dtype, device
        Of the parameters.

    Attributes
    ----------
    kicks, drifts : Coefficients
        b and a of the kernel.
    gradients, curvatures : Coefficients or None
        γ and c, one for each kick.
    polynomials : ModuleList of Coefficients, or None
        e_m, one column for each monomial.
    processor_kicks, processor_drifts, processor_gradients, processor_curvatures, processor_polynomials
        Those of χ, or None.
    substeps : tuple of Substep
        What is executed, in this order: χ⁻¹, K, χ.
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
        processor: int = 0,
        curvature: bool = False,
        monomials: Monomials = (),
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        FlowMap.__init__(self, ndof, dt)
        for name, value, least in (("maps", maps, 1), ("degree", degree, 1), ("processor", processor, 0)):
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                kind = "positive" if least else "non-negative"
                remedy = "give 1 or more" if least else "0 is for none"
                raise ValueError(f"`{name}` must be a {kind} integer; got {value!r}: {remedy}.")
        if maps < 2 or (palindromic and maps % 2 == 0):
            raise ValueError(f"`maps` must be at least 2, and odd for a palindrome; got {maps}: add a kick or a drift.")
        if processor and degree < 2:
            raise ValueError(
                f"`degree` must be at least 2 with a processor, whose lowest power of t is t²; got {degree}."
            )
        if curvature and not force_gradient:
            raise ValueError("`curvature` goes with force gradients: leave it out.")
        if monomials and force_gradient:
            raise ValueError("`monomials` stand in place of force gradients: leave these out.")
        self.degree, self.palindromic, self.processor, self.monomials = degree, palindromic, processor, monomials
        like: dict[str, Any] = {"dtype": checked_dtype(dtype), "device": checked_device(device)}
        kernel, chi = alternating(first, maps), alternating(first, 2 * processor + 1 if processor else 0)
        stride, terms = 2 if palindromic else 1, Terms(force_gradient, curvature, len(monomials))
        inside = columns_of(kernel, degree, stride, self.dt, palindromic, 1.0, terms, **like)
        outside = columns_of(chi, degree, stride, self.dt, False, None, terms, **like)
        self.kicks, self.drifts, self.gradients, self.curvatures, self.polynomials = inside
        self.processor_kicks, self.processor_drifts, self.processor_gradients = outside[:3]
        self.processor_curvatures, self.processor_polynomials = outside[3:]
        inner = substeps_of(kernel, inside, 1)
        outer = {sign: substeps_of(chi, outside, sign) for sign in (1, -1)}
        self.substeps: tuple[Substep, ...] = (*reversed(outer[-1]), *inner, *outer[1])
        self._n_outer = len(chi)
        self._tables = KeptTables(self.substeps, self._n_outer, self.dt, monomials)
        self._binding = Binding(system)
        # A tuple, not a ModuleList: the layers own no parameters, they share the columns.
        self.layers = tuple(self._layer(substep) for substep in self.substeps)  # type: ignore[assignment]
        if system is not None:
            self.fingerprint, self.system_name = system.fingerprint, system.name

    @property
    def dtype(self) -> torch.dtype:
        return self._number().dtype

    @property
    def device(self) -> torch.device:
        return self._number().device

    def _number(self) -> Tensor:
        """One of its parameters, found without the detours of a module's attributes."""
        return self._modules["kicks"]._parameters["free"]  # type: ignore[union-attr, return-value]

    @cached_property
    def sequence(self) -> tuple[Kind, ...]:
        """The kinds of the substeps."""
        return tuple(substep.kind for substep in self.substeps)

    def columns(self) -> Iterator[tuple[str, Coefficients]]:
        """The columns of its table by name; those of a polynomial, one for each monomial, as in "polynomials.0"."""
        return ((name, column) for name, column in self.named_modules() if isinstance(column, Coefficients))

    @property
    def terms(self) -> int:
        """How many terms a kick has beside V."""
        return len(self.monomials) or sum(c is not None for c in (self.gradients, self.curvatures))

    def _layer(self, substep: Substep) -> Kick | Drift:
        if substep.kind == "drift":
            return Drift(PrimedPotential(self.ndof, self._binding, [(KINETIC, substep.weight)]))
        terms: list[tuple[Term, Entry]] = [(POTENTIAL, substep.weight)]
        if self.monomials:
            return Kick(PrimedPotential(self.ndof, self._binding, terms, PolynomialTerm(self.monomials, substep.more)))
        terms += zip((FORCE_GRADIENT, CURVATURE), substep.more, strict=False)
        return Kick(PrimedPotential(self.ndof, self._binding, terms))

    # the frozen tables --------------------------------------------------------------------------------------

    @property
    def tables(self) -> Tables:
        """Those of the numbers that the flow has now."""
        return self._tables.current()

    def scheme(self, t: float | None = None) -> Scheme:
        """ψ̄_t as a splitting scheme of step t, for t ∈ (0, Δt]; the default is Δt.

        Its coefficients depend on t, and so it has no classical order.
        """
        return self.tables.scheme("primed", self._time_of_scheme(t))

    def kernel_scheme(self, t: float | None = None) -> Scheme:
        """K_t, likewise: ψ̄_t where there is no processor."""
        return self.tables.scheme("primed kernel", self._time_of_scheme(t))

    def processor_scheme(self, t: float | None = None) -> Scheme:
        """χ_t, likewise."""
        if not self.processor:
            raise ValueError("`flow` has no processor: see its `scheme`.")
        return self.tables.scheme("primed processor", self._time_of_scheme(t))

    def _time_of_scheme(self, t: float | None) -> float | None:
        try:
            return None if t is None else float(t)
        except (TypeError, ValueError):
            raise TypeError(
                f"`t` must be a number in (0, dt] = (0, {self.dt:g}]; got {t!r}: leave it out for dt."
            ) from None

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        """Force and force-gradient evaluations of a run, as `FixedStep.evaluations`."""
        return self.tables.evaluations(n_steps, n_saved, n_extra, backend)

    def kernel_for(self, system: HamiltonianSystem) -> PrimedFlowKernel:
        """The compiled loops of this flow, the same while no number of it changes."""
        tables = self.tables
        if tables.kernel is None or tables.kernel.system is not system:
            from sympflow.kernels.primed_flow import PrimedFlowKernel

            tables.kernel = PrimedFlowKernel(self, system)
        return tables.kernel

    # kernel and processor as maps ---------------------------------------------------------------------------

    def prepare(self, t: float | Tensor, x: Tensor) -> Tensor:
        """χ_t⁻¹(x), unchecked: where a run of kernel steps starts."""
        return self._partly(t, x, slice(0, self._n_outer))

    def finish(self, t: float | Tensor, x: Tensor) -> Tensor:
        """χ_t(x), unchecked: what such a run gives as its output."""
        return self._partly(t, x, slice(len(self.substeps) - self._n_outer, None))

    def kernel_step(self, t: float | Tensor, x: Tensor, back: bool = False) -> Tensor:
        """K_t(x), or its inverse, unchecked."""
        return self._partly(t, x, slice(self._n_outer, len(self.substeps) - self._n_outer), back)

    def _partly(self, t: Time, x: Tensor, part: slice, back: bool = False) -> Tensor:
        t, y, batch = self._columns(t, x)
        q, p = y.chunk(2)
        for layer in reversed(self.layers[part]) if back else self.layers[part]:
            q, p = layer.inverse(t, q, p) if back else layer(t, q, p)  # type: ignore[operator]
        return self._states(torch.cat([q, p]), batch)

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
                "maps": len(self.sequence) - 2 * self._n_outer,
                "degree": self.degree,
                "palindromic": self.palindromic,
                "force_gradient": self.gradients is not None,
                "processor": self.processor,
                "curvature": self.curvatures is not None,
                **({"monomials": [list(m) for m in self.monomials]} if self.monomials else {}),
            },
        }
