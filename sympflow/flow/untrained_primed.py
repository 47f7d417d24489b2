"""Primed flows before training: equal leapfrog steps, or a scheme from the literature, at every t."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from sympflow.arguments import check_flag
from sympflow.flow.arguments import check_system
from sympflow.flow.frozen import Kind
from sympflow.flow.primed import PrimedFlow
from sympflow.hamiltonian.monomials import Monomials, monomials
from sympflow.schemes import SCHEMES, Scheme, compose

if TYPE_CHECKING:
    from sympflow.hamiltonian.system import HamiltonianSystem


def primed(
    system: HamiltonianSystem,
    stages: int | None,
    dt: float,
    palindromic: bool,
    scheme: Scheme | str | None,
    degree: int | None,
    force_gradient: bool | None,
    processor: int,
    curvature: bool,
    polynomial: int | None,
    first: str,
    dtype: torch.dtype,
    device: torch.device | str | None,
) -> PrimedFlow:
    """`SympFlow.primed`."""
    check_system(system)
    check_flag("palindromic", palindromic)
    check_flag("curvature", curvature)
    if force_gradient is not None:
        check_flag("force_gradient", force_gradient)
    if not system.separable:
        raise ValueError(f"`system` {system.name!r} is not separable, so it has no V and T: use SympFlow(ndof).")
    of_kicks = _monomials(system, polynomial, force_gradient, curvature)
    if of_kicks:
        force_gradient = False
    if force_gradient is None:
        functions = system.numba_functions
        force_gradient = system.quadratic_kinetic and (functions is None or functions[2] is not None)
    elif force_gradient and not system.quadratic_kinetic:
        raise ValueError("`force_gradient` needs a kinetic energy ½ pᵀM⁻¹p: leave it out.")
    if curvature and not (force_gradient and system.symbols is not None):
        remedy = "leave it out"
        if system.symbols is None:
            remedy += ", or define the system with HamiltonianSystem.from_sympy"
        elif system.quadratic_kinetic:
            remedy = "leave out `force_gradient`, or `curvature`"
        raise ValueError(f"`curvature` goes with force gradients of a symbolic system, H = ½ pᵀM⁻¹p + V(q): {remedy}.")
    if degree is None:
        degree = 5 if processor else 7
    if scheme is None:
        stages = 6 if stages is None else stages
        if isinstance(stages, bool) or not isinstance(stages, int) or stages < 1:
            raise ValueError(f"`stages` must be a positive integer, the number of kicks; got {stages!r}: 3 is usual.")
        scheme = _equal_steps(stages, first)
    elif stages is not None or first != "drift":
        given = "stages" if stages is not None else "first"
        raise ValueError(f"`{given}` and `scheme` were both given: leave out `{given}`, the scheme has its own.")
    if isinstance(scheme, str):
        if scheme not in SCHEMES:
            raise ValueError(f"`scheme` {scheme!r} is unknown: choose one of {', '.join(SCHEMES)}.")
        scheme = SCHEMES[scheme]
    if not isinstance(scheme, Scheme):
        raise TypeError(
            f"`scheme` must be a Scheme or the name of one; got {scheme!r}: choose one of {', '.join(SCHEMES)}."
        )
    if (scheme.nystrom or any(scheme.gradients)) and not system.quadratic_kinetic:
        raise ValueError(f"`scheme` {scheme.name!r} needs a kinetic energy ½ pᵀM⁻¹p: take 'kahan_li8', for instance.")
    extra = (processor, curvature, of_kicks, dtype, device)
    return _from_scheme(system, scheme, dt, degree, palindromic, force_gradient, *extra)


def _equal_steps(n: int, first: str) -> Scheme:
    if first == "drift":
        return compose("leapfrog", 2, (1 / n,) * n, "equal leapfrog steps")
    if first != "kick":
        raise ValueError(f"`first` must be 'drift' or 'kick', which a step begins with; got {first!r}.")
    kicks = 0.5 / n, *(1 / n,) * (n - 1), 0.5 / n
    return Scheme("verlet", 2, kicks, (*(1 / n,) * n, 0.0), (0.0,) * (n + 1), "equal Verlet steps")


def _monomials(
    system: HamiltonianSystem, polynomial: int | None, force_gradient: bool | None, curvature: bool
) -> Monomials:
    """Those that `polynomial` asks for."""
    if polynomial is None:
        return ()
    if isinstance(polynomial, bool) or not isinstance(polynomial, int) or polynomial < 1:
        raise ValueError(f"`polynomial` must be a positive integer, its degree; got {polynomial!r}: 6 is usual.")
    if force_gradient or curvature:
        raise ValueError("`polynomial` stands in place of `force_gradient` and `curvature`: leave these out.")
    if system.symbols is None or not system.quadratic_kinetic:
        raise ValueError(
            "`polynomial` is for symbolic systems, H = ½ pᵀM⁻¹p + V(q): leave it out, or define the system with "
            "HamiltonianSystem.from_sympy."
        )
    return monomials(system.symbols, polynomial)


def _from_scheme(
    system: HamiltonianSystem,
    scheme: Scheme,
    dt: float,
    degree: int,
    palindromic: bool,
    force_gradient: bool,
    processor: int,
    curvature: bool,
    of_kicks: Monomials,
    dtype: torch.dtype,
    device: torch.device | str | None,
) -> PrimedFlow:
    """The flow that is, at every t, the given scheme; its processor is the identity."""
    if palindromic and not scheme.symmetric:
        raise ValueError(f"`scheme` {scheme.name!r} is not symmetric: take another, or palindromic=False.")
    if any(scheme.gradients) and of_kicks:
        raise ValueError(f"`polynomial` stands in place of force gradients, as {scheme.name!r} has them: take another.")
    if any(scheme.gradients) and not force_gradient:
        raise ValueError(f"`force_gradient` is False but {scheme.name!r} has force gradients: leave it out.")
    substeps = scheme.substeps
    first: Kind = "kick" if substeps[0][0] == "kick" else "drift"
    shape = (degree, palindromic, force_gradient, dt, system, processor, curvature, of_kicks, dtype, device)
    flow = PrimedFlow(system.ndof, first, len(substeps), *shape)
    columns: Any = (flow.kicks, "kick", "one"), (flow.drifts, "drift", "one"), (flow.gradients, "kick", "three")
    for column, kind, number in (*columns, (flow.curvatures, "kick", "five")):
        if column is not None:
            table = np.zeros(tuple(column.offset.shape))
            table[:, 0] = [float(getattr(substep, number)) for substep in substeps if substep.kind == kind]
            column.set(table)
    return flow
