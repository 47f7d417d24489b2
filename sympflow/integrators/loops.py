"""The compiled loops of a run, or the reason why a call has none."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.arrays import Array, differentiable, is_tensor, to_numpy, transformed
from sympflow.compiler import NotCompiled
from sympflow.integrators.contract import Problem
from sympflow.integrators.steppers import ArraySteps, Stepper

if TYPE_CHECKING:
    from sympflow.kernels.protocol import Kernel


def stepper_of(
    integrator: Any, problem: Problem, arrays: ArraySteps, make: Callable[..., Any], compensated: bool = False
) -> Stepper:
    """Return the stepper of the loops that `make` gives, for names of parameters where gradients flow to these."""
    if problem.followed:
        return with_loops(integrator, problem, arrays, _followed_loops(make, problem))
    if is_tensor(problem.y0) and problem.system.followed_mass is not None:
        try:
            by_mass = _by_mass(problem)
            return with_loops(integrator, by_mass, arrays, _loops_by_values(make, by_mass, problem.system.definition))
        except NotCompiled:
            pass
    if problem.backend != "array" and (followed := _followed_numbers(make, problem)) is not None:
        return with_loops(integrator, problem, arrays, followed)
    told: list[str] = []
    kernel = compiled_loops(make, problem.y0, problem.backend, compensated, told, problem.system)
    if problem.parameter_values is not None:
        kernel = kernel.varied(problem.parameter_values)
    return with_loops(integrator, problem, arrays, kernel, told)


def with_loops(
    integrator: Any, problem: Problem, arrays: ArraySteps, kernel: Kernel | None, told: Sequence[str] = ()
) -> Stepper:
    """Return the stepper of compiled loops, where there are some: one of tensors for tensors."""
    if kernel is None or not is_tensor(problem.y0):
        return Stepper(integrator, problem, arrays, kernel, told)
    from sympflow.integrators.tensors import TensorStepper

    return TensorStepper(integrator, problem, arrays, kernel, told)


def compiled_loops(
    make: Callable[[], Any],
    y0: Array,
    backend: str,
    compensated: bool = False,
    told: list[str] | None = None,
    system: Any = None,
) -> Any:
    """Return the compiled loops that `make` gives, or None where array operations are needed or chosen.

    Tensors need these, except on the CPU where the `system` is given.
    """
    reason = None
    if backend == "array":
        reason = "`backend` is 'array': choose 'auto'."
    elif is_tensor(y0):
        reason = _no_loops_for(y0, system)
    elif y0.dtype != np.float64:
        reason = f"`y0` is {y0.dtype}: use float64, or backend='array'."
    asked = reason is None
    if reason is None:
        try:
            loops = make()
            if differentiable(y0):
                loops.check_reverse()
            return loops
        except NotCompiled as error:
            reason = str(error)
    if backend == "compiled":
        raise ValueError(f"`backend` {backend!r} does not apply. {reason}") from None
    if compensated:
        needed = "" if reason.startswith("`compensated`") else "`compensated` sums need compiled loops. "
        raise ValueError(needed + reason) from None
    if told is not None and backend == "auto" and asked:
        told.append(reason)
    return None


def _followed_loops(make: Callable[[tuple[str, ...]], Any], problem: Problem) -> Any:
    """The compiled loops, that `make` gives for names, of a run through which gradients flow to parameters."""
    local = problem.system.local
    try:
        if not problem.system.definition.symbolic and (local is None or local.parameter_values({}) is None):
            raise NotCompiled(f"`system` {problem.system.name!r} is not symbolic.")
        return _loops_by_values(make, problem, problem.system)
    except NotCompiled as error:
        what = ", ".join(problem.followed) if local is None else "tensors that require gradients"
        raise ValueError(
            f"`params` has {what}, but no gradient flows to parameters here: {error} Detach them."
        ) from error


def _loops_by_values(make: Callable[[tuple[str, ...]], Any], problem: Problem, H: Any) -> Any:
    """The compiled loops with values of what is followed, or NotCompiled."""
    array = problem.backend == "array"
    if reason := "`backend` is 'array'." if array else _no_loops_for(problem.y0, H):
        raise NotCompiled(reason)
    loops = make(tuple(problem.followed))
    loops.check_reverse()
    return loops.varied(problem.parameter_values)


def _followed_numbers(make: Callable[[tuple[str, ...]], Any], problem: Problem) -> Any:
    """The compiled loops of functions with tensors that torch follows, whose numbers are arguments; None without."""
    system, y0 = problem.system, problem.y0
    if system.form is not None or system.followed_mass is not None or system.layered is not None:
        return None
    found = system.definition.followed
    able = not is_tensor(y0) or (y0.device.type == "cpu" and not transformed(y0, *found.tensors)) if found else False
    if not able or str(y0.dtype) not in ("float64", "torch.float64", "torch.float32"):
        return None
    try:
        loops = make(tuple(s.name for s in found.form.parameters))
        if differentiable(y0, *found.tensors) and is_tensor(y0):
            loops.check_reverse()
    except NotCompiled:
        return None
    loops = loops.varied(found.values(math.prod(y0.shape[:-1])))
    loops.tensors = found.tensors
    return loops


def _by_mass(problem: Problem) -> Problem:
    """The problem of a system whose mass torch follows, with the entries of M⁻¹ as parameters that are followed."""
    import torch

    mass, n = problem.system.followed_mass, math.prod(problem.y0.shape[:-1])
    of_form = problem.system.autonomous and problem.system.definition.form is not None
    if transformed(mass) or mass.device.type != "cpu" or not of_form:
        raise NotCompiled("`mass` is followed by other means than a graph, or stands beside functions as they are.")
    mass = mass.double()
    inverse = (1 / mass).expand(problem.system.ndof) if mass.ndim < 2 else torch.linalg.inv(mass).reshape(-1)
    followed = {f"inverse_mass_{i}": entry for i, entry in enumerate(inverse.unbind())}
    return replace(problem, followed=followed, parameter_values=np.repeat(to_numpy(inverse)[:, None], n, axis=1))


def _no_loops_for(y0: Array, system: Any) -> str | None:
    """Why a tensor needs array operations, if it does."""
    if system is None:
        return "`y0` is a tensor: pass a NumPy array, or use backend='array'."
    if y0.device.type != "cpu":
        return f"`y0` is on {y0.device}: move it to the CPU, or use backend='array'."
    if transformed(y0):
        return "`y0` is followed by torch.func, forward mode or torch.compile: use backend='array'."
    if system.layered is None and system.learns(y0):
        return "`system` has numbers that torch follows: use backend='array'."
    return None
