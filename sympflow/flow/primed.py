"""Primed SympFlows: every potential is the system's own V or T times a trained function of t.

    kick    V_p(t, q) = t b(τ) V(q) − t³ γ(τ) ½|∇V(q)|²_{M⁻¹} + t⁵ c(τ) ½ v·∇²V(q) v,   v = M⁻¹∇V(q)
    drift   V_m(t, p) = t a(τ) T(p)                                                         τ = t/Δt

In place of the last two terms a kick may have a trained polynomial, t³ Σ_m e_m(τ) q^m.

Frozen at any t such a flow is a splitting scheme, kicks b, force gradients γ, curvatures c and drifts a in the
convention of `sympflow.schemes`: a SympFlow of this kind is a table of numbers that varies smoothly with t.

With a processor it is ψ̄_t = χ_t ∘ K_t ∘ χ_t⁻¹, the kernel K and the processor χ being such tables: over many steps
of Δt only K is executed, as the χ between two steps cancel.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor, nn

from sympflow.arguments import check_flag, plain
from sympflow.arrays import to_numpy
from sympflow.flow.coefficients import Coefficients
from sympflow.flow.flow_map import check_system
from sympflow.flow.frozen import PrimedKnown
from sympflow.flow.layers import Drift, Kick
from sympflow.flow.potentials import Time
from sympflow.flow.primed_potentials import CURVATURE, FORCE_GRADIENT, POTENTIAL, PrimedDrift, PrimedPotential, Term
from sympflow.flow.records import MAX_LAYERS
from sympflow.flow.sympflow import SystemFlow
from sympflow.flow.tables import Columns, Entry, Kind, PrimedShape, Tables, columns_of
from sympflow.flow.weights import Kept, check_compilable, doubles
from sympflow.hamiltonian.fingerprint import check_for_flows
from sympflow.hamiltonian.lattice_states import LatticeStates
from sympflow.hamiltonian.monomials import Monomials, in_monomials, monomials
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.schemes import SCHEMES, Scheme, compose, scheme_named


class PrimedFlow(PrimedKnown, SystemFlow):
    """A SympFlow of kicks and drifts, in turn, that are primed with V and T; made by `SympFlow.primed`.

    A palindromic one has even polynomials b, γ, c, a, and its kernel reads the same backwards, which makes K
    time-reversible: continued to negative t by its formulas, K_{−t} = K_t⁻¹. With a processor ψ̄ is conjugate to it.
    Without a system the flow has a `scheme`, but no values. `kicks`, `drifts`, `gradients` and `curvatures` are the
    `Coefficients` b, a, γ and c of the kernel, or None, `polynomials` the e_m, and `processor_kicks`, … those of χ;
    `substeps` are the maps in the order in which they are executed: χ⁻¹, K, χ.
    """

    PLAN = "primed"

    def __init__(
        self,
        ndof: int,
        shape: PrimedShape,
        dt: float = 1.0,
        system: HamiltonianSystem | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__(ndof, dt, dtype, device)
        self.shape = shape

        def columns(inside: bool) -> Columns:
            made = shape.columns(inside, lambda name, *given: Coefficients(*given, dt=self.dt, **self._like))
            return made if made.polynomials is None else made._replace(polynomials=nn.ModuleList(made.polynomials))

        inside, outside = columns(True), columns(False)
        self.kicks, self.drifts, self.gradients, self.curvatures, self.polynomials = inside
        self.processor_kicks, self.processor_drifts, self.processor_gradients = outside[:3]
        self.processor_curvatures, self.processor_polynomials = outside[3:]
        self.substeps = shape.substeps(inside, outside)
        self._tables: Kept[Tables] = Kept(column._parameters for column in columns_of(self.substeps))
        # A tuple, not a ModuleList: the layers own no parameters, they share the columns.
        self.layers = tuple(map(self._layer, range(len(self.substeps))))
        self._made_of(system)

    @classmethod
    def untrained(cls, system: HamiltonianSystem, *, dt: float, dtype: Any, device: Any, **given: Any) -> Self:
        """Return a flow that is, at every t, equal leapfrog steps or the given scheme: see `SympFlow.primed`."""
        stages, palindromic, scheme, degree, processor, polynomial = (
            plain(given[name]) for name in ("stages", "palindromic", "scheme", "degree", "processor", "polynomial")
        )
        force_gradient, curvature, first = given["force_gradient"], given["curvature"], given["first"]
        some = None
        if force_gradient is not None:
            force_gradient, some = _kicks_of("force_gradient", force_gradient)
        curvature, curved = _kicks_of("curvature", curvature)
        check_system(system)
        check_for_flows(system, cls.takes_friction, cls.takes_driving)
        check_flag("palindromic", palindromic)
        if not system.separable:
            raise ValueError(f"`system` {system.name!r} is not separable, so it has no V and T: use SympFlow(ndof).")
        if system.kinetic_timed:
            raise ValueError(
                f"`system` {system.name!r} has a kinetic energy that depends on t, and flows are primed with V(q, t) "
                "alone: use a splitting method such as 'kahan_li8'."
            )
        system.check_damped_drifts()
        exponents = _monomials_of(system, polynomial, force_gradient, curvature)
        force_gradient = _force_gradient_of(system, False if exponents else force_gradient, curvature)
        for name, value in (("stages", stages), ("processor", processor)):
            if isinstance(value, int) and 2 * value + 1 > MAX_LAYERS:
                most = (MAX_LAYERS - 1) // 2
                raise ValueError(f"`{name}` must be at most {most}, as many as a file may hold; got {value!r}.")
        scheme = _starting_scheme(system, scheme, stages, first)
        if palindromic and not scheme.symmetric:
            raise ValueError(f"`scheme` {scheme.name!r} is not symmetric: take another, or palindromic=False.")
        if any(scheme.gradients) and exponents:
            raise ValueError(
                f"`polynomial` stands in place of force gradients, as {scheme.name!r} has them: take another."
            )
        if some is not None and any(s.three for i, s in enumerate(_kicks(scheme)) if i not in some):
            raise ValueError(
                f"`force_gradient` {some!r} leaves out kicks of {scheme.name!r} that have force gradients: name these "
                "too, or leave it out."
            )
        if any(scheme.gradients) and not force_gradient:
            raise ValueError(f"`force_gradient` is False but {scheme.name!r} has force gradients: leave it out.")
        substeps = scheme.substeps
        shape = PrimedShape(
            first="kick" if substeps[0].kind == "kick" else "drift",
            maps=len(substeps),
            degree=degree if degree is not None else 5 if processor else 7,
            palindromic=palindromic,
            force_gradient=force_gradient,
            processor=processor,
            curvature=curvature,
            monomials=exponents,
            timed=not system.keeps_energy,
            gradient_kicks=some,
            curvature_kicks=curved,
        )
        flow = cls(system.ndof, shape, dt, system, dtype=dtype, device=device)
        kicks, drifts = _kicks(scheme), [s for s in substeps if s.kind == "drift"]
        flow.kicks.set_constant([s.one for s in kicks])
        flow.drifts.set_constant([s.one for s in drifts])
        if flow.gradients is not None:
            flow.gradients.set_constant([s.three for s in kicks])
        if flow.curvatures is not None:
            flow.curvatures.set_constant([s.five for s in kicks])
        return flow

    @classmethod
    def checked_plan(cls, plan: dict[str, Any], ndof: int) -> dict[str, Any]:
        return {"shape": PrimedShape.from_dict(plan, ndof)}

    def plan(self) -> dict[str, Any]:
        return self.shape.to_dict()

    @property
    def palindromic(self) -> bool:
        return self.shape.palindromic

    @property
    def processor(self) -> int:
        return self.shape.processor

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
        """The number of terms of a kick in addition to V."""
        return len(self.monomials) or sum(c is not None for c in (self.gradients, self.curvatures))

    def _layer(self, i: int) -> Kick | Drift:
        substep = self.substeps[i]
        if substep.kind == "drift":
            return PrimedDrift(self.ndof, self._binding, substep.weight)
        passed = [s.weight for s in self.substeps[:i] if s.kind == "drift"]
        terms: list[tuple[Term, Entry]] = [(POTENTIAL, substep.weight)]
        if not self.monomials:
            terms += zip((FORCE_GRADIENT, CURVATURE), substep.more, strict=False)
        return Kick(PrimedPotential(self.ndof, self._binding, terms, self.monomials, substep.more, passed))

    # the frozen tables --------------------------------------------------------------------------------------

    @property
    def tables(self) -> Tables:
        """The tables of the numbers that the flow has now."""
        return self._tables.current(self._frozen)

    def _frozen(self) -> Tables:
        return Tables(self.substeps, len(self.shape.outer), self.dt, self.monomials)

    def scheme(self, t: float | None = None) -> Scheme:
        """ψ̄_t as a splitting scheme of step t ∈ (0, Δt], by default Δt; it has no classical order."""
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

    def check_compilable(self) -> None:
        for placement in {(column.free.dtype, column.free.device) for _, column in self.columns()}:
            check_compilable(*placement)

    # kernel and processor as maps ---------------------------------------------------------------------------

    def prepare(self, t: float | Tensor, x: Tensor) -> Tensor:
        return self._partly(t, x, slice(0, len(self.shape.outer)))

    def finish(self, t: float | Tensor, x: Tensor) -> Tensor:
        return self._partly(t, x, slice(len(self.substeps) - len(self.shape.outer), None))

    def kernel_step(self, t: float | Tensor, x: Tensor, back: bool = False) -> Tensor:
        outer = len(self.shape.outer)
        return self._partly(t, x, slice(outer, len(self.substeps) - outer), back)

    def _partly(self, t: Time, x: Tensor, part: slice, back: bool = False) -> Tensor:
        t, y, batch = self._columns(t, x)
        return self._states(self._applied(self.layers[part], t, y, back), batch)

    # its system ---------------------------------------------------------------------------------------------

    def _take(self, system: HamiltonianSystem) -> None:
        """Take V and T; the flow of a lattice takes the size of the one that it is given."""
        super()._take(system)
        if system.ndof != self.ndof:
            self.ndof = system.ndof
            self.layers = tuple(map(self._layer, range(len(self.substeps))))
        if isinstance(self.domain, LatticeStates):
            self.domain = self.domain.of(system)

    def transferred(self, system: HamiltonianSystem) -> Self:
        """Return an untrained flow of another system with the numbers of this one, to start `train` from.

        They need not be near the exact flow of that system, with friction for instance. The numbers know the potential
        and dt, not the size: of a lattice they serve any other one of the same terms: `solve` takes the flow as it is.
        A ValueError if the system has other degrees of freedom, and is not a lattice of the same terms, or has no such
        flow.
        """
        check_system(system)
        check_for_flows(system, self.takes_friction, self.takes_driving)
        if system.ndof != self.ndof:
            if system.local is None:
                raise ValueError(
                    f"`system` has {system.ndof} degrees of freedom, the flow {self.ndof}: give one of those."
                )
            self.check_system(system)
        if not system.separable or (self.terms and not (system.quadratic_kinetic and system.has_hessian_vector)):
            raise ValueError(
                f"`system` {system.name!r} has no kicks and drifts such as the flow's: it must be H = ½ pᵀM⁻¹p + V(q), "
                "with `hessian_vector` where V is a function."
            )
        return self._of(system, replace(self.shape, timed=not system.keeps_energy))

    def of_any_size(self, system: HamiltonianSystem) -> Self:
        """Return the flow of a system, or of a subsystem by its coordinates, with the numbers of this one."""
        return self._of(system, self.shape).requires_grad_(False)

    def on_extended(self, extended: HamiltonianSystem) -> Self:
        monomials = tuple((*m, *[0] * (extended.ndof - self.ndof)) for m in self.monomials)
        return self._of(extended, replace(self.shape, monomials=monomials)).requires_grad_(False)

    def _of(self, system: HamiltonianSystem, shape: PrimedShape) -> Self:
        """A flow of a system with the numbers of this one."""
        other = type(self)(system.ndof, shape, self.dt, system, dtype=self.dtype, device=self.device)
        mine = dict(self.columns())
        for name, column in other.columns():
            column.set(to_numpy(mine[name].table))
        return other

    def bound(self, system: HamiltonianSystem) -> Self:
        return self.of_size(system) if self._binding.known else self.bind(system)

    def carried(self, system: HamiltonianSystem) -> Self:
        """This flow for another size of its system, with its records."""
        other = self._of(system, self.shape).requires_grad_(False)
        other.provenance = self.provenance_for(system)
        return other

    def force_gradient_coefficients(self) -> np.ndarray:
        """−½|∇V|²_{M⁻¹} by the monomials of the kicks (M,); 0 where it is not such a polynomial."""
        system = self.system
        assert system is not None
        assert system.symbols is not None
        e = in_monomials(system.symbols.force_gradient, system.symbols, self.monomials)
        return np.zeros(len(self.monomials)) if e is None else e

    @torch.no_grad()
    def take_over(self, other: PrimedFlow) -> None:
        """Take the numbers of a flow with as many kicks, of a longer Δt as they are at this one's."""
        shorter = min(self.dt / other.dt, 1.0)
        theirs = {
            name: doubles(column.table) * shorter ** np.array(column.exponents, float)
            for name, column in other.columns()
        }
        mine = dict(self.columns())
        for name in mine.keys() & theirs.keys():
            mine[name].set(theirs[name])
        if self.polynomials is not None and other.gradients is not None:
            for m, e_m in enumerate(self.force_gradient_coefficients()):
                for part in ("", "processor_"):
                    mine[f"{part}polynomials.{m}"].set(e_m * theirs[f"{part}gradients"])

    def initial_velocity(self, x: Tensor, t0: Any = None) -> Tensor:
        """d/dt ψ̄_t(x) at t = 0: that of its system, as the coefficients of V and T sum up to 1."""
        return super().initial_velocity(x, t0) if self.system is None else self.system.vector_field(x, t0)


def _starting_scheme(system: HamiltonianSystem, scheme: Any, stages: Any, first: str) -> Scheme:
    """Return the scheme that an untrained flow is: the given one, or so many equal steps."""
    if scheme is None:
        stages = 6 if stages is None else stages
        if isinstance(stages, bool) or not isinstance(stages, int) or stages < 1:
            raise ValueError(f"`stages` must be a positive integer, the number of kicks; got {stages!r}: 3 is usual.")
        scheme = _equal_steps(stages, first)
    elif stages is not None or first != "drift":
        given = "stages" if stages is not None else "first"
        raise ValueError(f"`{given}` and `scheme` were both given: leave out `{given}`, the scheme has its own.")
    if isinstance(scheme, str):
        scheme = scheme_named(scheme)
    if not isinstance(scheme, Scheme):
        raise TypeError(
            f"`scheme` must be a Scheme or the name of one; got {scheme!r}: choose one of {', '.join(SCHEMES)}."
        )
    if (scheme.nystrom or any(scheme.gradients)) and not system.quadratic_kinetic:
        raise ValueError(f"`scheme` {scheme.name!r} needs a kinetic energy ½ pᵀM⁻¹p: take 'kahan_li8', for instance.")
    return scheme


def _kicks(scheme: Scheme) -> list[Any]:
    return [s for s in scheme.substeps if s.kind == "kick"]


def _kicks_of(name: str, asked: Any) -> tuple[bool, tuple[int, ...] | None]:
    """Return True where a term of kicks is asked for, with the kicks that have it where not all do."""
    asked = plain(asked)
    if isinstance(asked, Sequence) and not isinstance(asked, str):
        kicks = tuple(map(plain, asked))
        if all(isinstance(i, int) and not isinstance(i, bool) for i in kicks):
            return True, kicks
    if not isinstance(asked, bool):
        raise TypeError(f"`{name}` must be True or False; got {asked!r}: or name kicks, as a list of integers from 0.")
    return asked, None


def _force_gradient_of(system: HamiltonianSystem, asked: bool | None, curvature: bool) -> bool:
    """Return True if the kicks have force gradients: if asked for, or by default where T is quadratic."""
    if asked is None:
        asked = system.quadratic_kinetic and system.has_hessian_vector
    elif asked and not system.quadratic_kinetic:
        raise ValueError("`force_gradient` needs a kinetic energy ½ pᵀM⁻¹p: leave it out.")
    known = system.definition.symbolic or system.local is not None
    if curvature and not (asked and known):
        remedy = "leave it out"
        if not known:
            remedy += ", or define the system with HamiltonianSystem.from_sympy"
        elif system.quadratic_kinetic:
            remedy = "leave out `force_gradient`, or `curvature`"
        raise ValueError(
            f"`curvature` goes with force gradients of a symbolic system or a lattice, H = ½ pᵀM⁻¹p + V(q): {remedy}."
        )
    return asked


def _equal_steps(n: int, first: str) -> Scheme:
    if first == "drift":
        return compose("leapfrog", 2, (1 / n,) * n, "equal leapfrog steps")
    if first != "kick":
        raise ValueError(f"`first` must be 'drift' or 'kick', which a step begins with; got {first!r}.")
    kicks = 0.5 / n, *(1 / n,) * (n - 1), 0.5 / n
    return Scheme("verlet", 2, kicks, (*(1 / n,) * n, 0.0), (0.0,) * (n + 1), "equal Verlet steps")


def _monomials_of(
    system: HamiltonianSystem, polynomial: int | None, force_gradient: bool | None, curvature: bool
) -> Monomials:
    """Return the exponents that `polynomial` asks for."""
    if polynomial is None:
        return ()
    if isinstance(polynomial, bool) or not isinstance(polynomial, int) or polynomial < 1:
        raise ValueError(f"`polynomial` must be a positive integer, its degree; got {polynomial!r}: 6 is usual.")
    if force_gradient or curvature:
        raise ValueError("`polynomial` stands in place of `force_gradient` and `curvature`: leave these out.")
    if not system.definition.symbolic or not system.quadratic_kinetic:
        raise ValueError(
            "`polynomial` is for symbolic systems, H = ½ pᵀM⁻¹p + V(q): leave it out, or define the system with "
            "HamiltonianSystem.from_sympy."
        )
    return monomials(system.symbols, polynomial)
