"""Systems of a peer as HamiltonianSystem: a callable H(q, p), or a torch module that gives the right-hand side."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from sympflow.hamiltonian.system import HamiltonianSystem

N_NODES = 16  # Gauss–Legendre nodes of the line integral: exact for fields of degree 31
TOLERANCE = 1e-8
EXACT = 1e-12  # what is smaller by this, in any units, is rounding
TIMES = (0.0, 0.3719, 1.0, 3.14159265, 5.6, 13.7, -2.3, 51.3, 407.0, 1e4)  # where an autonomous field is the same


def from_hamiltonian(H: Callable[[Tensor, Tensor], Tensor], ndof: int, **scene: Any) -> HamiltonianSystem:
    """The system of a callable H(q, p), written with torch functions on (..., d).

    Where H turns out to be ½ pᵀM⁻¹p + V(q) at eight random states near y0, it is made a separable
    system, to which the splitting methods apply. M is fixed then: where ∂H/∂p depends on tensors that require
    gradients, such as a mass that is trained, the system stays H(q, p), which gives them gradients. A run is refused
    where ∂H/∂p has changed since, as by a number that H reads from elsewhere.

    Parameters
    ----------
    H : callable
        H(q, p), (..., d), (..., d) to (...).
    ndof : int
        d.
    **scene
        `name`, `domain`, `y0`, `t_span`, `dt`, `energy_scale`, as for HamiltonianSystem.

    Raises
    ------
    TypeError, ValueError
        If H does not give one number for each state, or depends on the time.
    """
    probes = _probes(ndof, scene.get("y0"))
    try:
        values = H(probes[:, :ndof], probes[:, ndof:])
    except TypeError as error:
        raise TypeError(
            f"`H` must be a function H(q, p); calling it failed: {error}. An H(t, q, p) is not supported."
        ) from error
    except RuntimeError as error:
        raise TypeError(f"`H` failed on float64 states ({error}): if it is a module, call its .double().") from error
    if not (isinstance(values, Tensor) and values.shape == probes.shape[:-1]):
        gave = "a NumPy array" if isinstance(values, np.ndarray) else tuple(getattr(values, "shape", ()))
        raise ValueError(
            f"`H` must map q, p of shape (..., {ndof}) to (...), with torch functions; for (8, {ndof}) it gave {gave}. "
            "Sum over the last axis."
        )
    try:
        hessian = torch.func.vmap(torch.func.hessian(lambda y: H(y[:ndof], y[ndof:])))(probes)
    except RuntimeError as error:
        raise TypeError(f"`H` cannot be differentiated ({error}): write it with torch functions throughout.") from error

    def gradient(y: Tensor) -> Tensor:
        return torch.func.grad(lambda y: H(y[:, :ndof], y[:, ndof:]).sum())(y)

    mass = _mass(hessian, gradient, probes)
    if mass is None:
        return HamiltonianSystem(hamiltonian=H, ndof=ndof, **scene)
    system = HamiltonianSystem(lambda q: H(q, torch.zeros_like(q)), ndof=ndof, mass=mass, **scene)
    return _guarded(system, "H", gradient, probes)


def from_module(module: Callable[[Any, Tensor], Tensor], ndof: int, **scene: Any) -> HamiltonianSystem:
    """The system of a right-hand side `module(t, y)` with y = [q, p] on the last axis, as torchdiffeq uses them.

    H is recovered from the field f = J∇H as the line integral H(y) = ∫₀¹ (−J f(s y))·y ds from the origin, by
    Gauss–Legendre quadrature, after it has been tested at random states that f is the field of some autonomous H.

    That the field does not depend on t is tested at ten times only (`TIMES`): one that changes between them passes for
    autonomous, and is solved as it is at t = 0. It is made separable under the same conditions as by
    `from_hamiltonian`.

    Parameters
    ----------
    module : torch.nn.Module or callable
        forward(t, y): (..., 2d) to (..., 2d), smooth on the straight lines to the origin.
    ndof : int
        d.
    **scene
        `name`, `domain`, `y0`, `t_span`, `dt`, `energy_scale`, as for HamiltonianSystem.

    Raises
    ------
    ValueError
        If the field is not Hamiltonian, depends on t, or has another shape.
    """
    if not callable(module):
        raise TypeError(f"`module` must be a function module(t, y) or a torch module; got {type(module).__name__}.")
    probes = _probes(ndof, scene.get("y0"))
    try:
        with torch.no_grad():
            f, *later = (module(torch.tensor(t, dtype=probes.dtype), probes) for t in TIMES)
    except RuntimeError as error:
        raise TypeError(f"`module` failed on float64 states ({error}): call module.double() first.") from error
    if f.shape != probes.shape:
        raise ValueError(f"`module` must map (..., {2 * ndof}) to the same shape, [q', p']; got {tuple(f.shape)}.")
    if not all(_close(g, f, 1e-10) for g in later):
        raise ValueError("`module` depends on t, which is not supported: freeze the time, or extend the phase space.")

    zero = torch.zeros((), dtype=probes.dtype)

    def minus_J_f(y: Tensor) -> Tensor:
        velocity, force = module(zero.to(y), y).chunk(2, dim=-1)
        return torch.cat([-force, velocity], dim=-1)

    jacobian = torch.func.vmap(torch.func.jacrev(minus_J_f))(probes)
    A = jacobian.detach().numpy()
    beside = np.maximum(np.maximum(np.abs(A), np.abs(A.swapaxes(-1, -2))), _size(A))  # what an entry is compared with
    rounding = 16 * np.finfo(float).eps * np.abs(A).max()
    asymmetry = float((np.abs(A - A.swapaxes(-1, -2)) / (beside + rounding / TOLERANCE + 1e-300)).max())
    if asymmetry > TOLERANCE:
        raise ValueError(
            f"`module` is not a Hamiltonian field in y = [q, p]: −J·f' is asymmetric by {asymmetry:.1e}. Check the "
            "order of the variables, or train a Hamiltonian model."
        )
    nodes, weights = np.polynomial.legendre.leggauss(N_NODES)

    def H(q: Tensor, p: Tensor) -> Tensor:
        y = torch.cat([q, p], dim=-1)
        s = torch.as_tensor((1 + nodes) / 2, dtype=y.dtype, device=y.device).reshape(-1, *[1] * y.ndim)
        w = torch.as_tensor(weights / 2, dtype=y.dtype, device=y.device).reshape(-1, *[1] * (y.ndim - 1))
        return (w * (minus_J_f(s * y) * y).sum(-1)).sum(0)

    slope = torch.func.grad(lambda y: H(y[:, :ndof], y[:, ndof:]).sum())(probes)
    if not _close(slope, minus_J_f(probes), TOLERANCE):
        raise ValueError(
            "`module` is not smooth on the straight lines from the origin to the states, along which H is integrated "
            "(a singularity lies on them): give H itself, with from_hamiltonian or HamiltonianSystem."
        )
    mass = _mass(jacobian, minus_J_f, probes)
    if mass is None:
        return HamiltonianSystem(hamiltonian=H, ndof=ndof, **scene)

    def gradient(q: Tensor) -> Tensor:
        return minus_J_f(torch.cat([q, torch.zeros_like(q)], dim=-1))[..., :ndof]

    potential = _for_arrays(lambda q: H(q, torch.zeros_like(q)))
    system = HamiltonianSystem(potential, ndof=ndof, mass=mass, gradient=_for_arrays(gradient), **scene)
    return _guarded(system, "module", minus_J_f, probes)


def _guarded(
    system: HamiltonianSystem, argument: str, gradient: Callable[[Tensor], Tensor], probes: Tensor
) -> HamiltonianSystem:
    """The system, which compares M⁻¹p with ∂H/∂p at one state whenever it is used."""
    d, state = system.ndof, probes[:1]
    expected = system.velocity(state[:, d:])

    def check() -> None:
        velocity = gradient(state)[:, d:]
        if not _close(velocity, expected, TOLERANCE):
            why = "has another ∂H/∂p than when the system was made: it reads something that has changed since"
        elif _trained(velocity):
            why = "depends in ∂H/∂p on tensors that require gradients, which they did not when the system was made"
        else:
            return
        raise ValueError(f"`{argument}` {why}. Make a new system of it, by the same function.")

    system.definition.guard = check
    return system


def _for_arrays(function: Callable[[Tensor], Tensor]) -> Callable[[Any], Any]:
    """A function of tensors that takes NumPy arrays as well."""

    def either(x: Any) -> Any:
        if isinstance(x, Tensor):
            return function(x)
        with torch.no_grad():
            return function(torch.from_numpy(np.array(x))).numpy()  # a copy: what is read only makes no tensor

    return either


def _probes(ndof: int, y0: ArrayLike | None) -> Tensor:
    """Eight states near y0, or near the origin."""
    if isinstance(ndof, bool) or not isinstance(ndof, int) or ndof < 1:
        raise ValueError(f"`ndof` must be a positive integer, the degrees of freedom; got {ndof!r}.")
    center = np.zeros(2 * ndof) if y0 is None else np.asarray(y0, dtype=float)
    if center.shape != (2 * ndof,) or not np.isfinite(center).all():
        what = f"shape {center.shape}" if center.shape != (2 * ndof,) else "NaN or infinity"
        raise ValueError(f"`y0` must be {2 * ndof} finite numbers, [q, p] for ndof = {ndof}; got {what}. Correct it.")
    spread = 0.25 * np.maximum(np.abs(center).max(initial=0.0), 1.0)
    return torch.from_numpy(center + spread * np.random.default_rng(20260101).uniform(-1, 1, (8, 2 * ndof)))


def _mass(hessian: Tensor, gradient: Callable[[Tensor], Tensor], probes: Tensor) -> np.ndarray | None:
    """M if H is ½ pᵀM⁻¹p + V(q) at all probes, judged by what does not depend on the units of q, p and H.

    Entry (i, j) of ∂²H is small if it is small beside √(∂²H/∂y_i² · ∂²H/∂y_j²), the only product of such units.
    """
    d, A = probes.shape[-1] // 2, hessian.detach().numpy()
    size, K = _size(A), A[:, d:, d:]
    units = size[d:, d:]
    if not np.isfinite(A).all() or (K.diagonal(axis1=1, axis2=2) <= 0).any():
        return None
    if (np.abs(A[:, :d, d:]) > EXACT * size[:d, d:]).any() or (np.abs(K - K[0]) > EXACT * units).any():
        return None
    M_inverse = _clean((K[0] + K[0].T) / 2, units)
    p, at_rest = probes[:, d:].numpy(), probes.clone()
    at_rest[:, d:] = 0.0
    slopes = gradient(probes)
    if _trained(slopes[:, d:]):
        return None
    slope, rest = slopes.detach().numpy(), gradient(at_rest).detach().numpy()
    span = np.ptp((slope[:, :d] * probes[:, :d].numpy()).sum(-1)) * M_inverse.diagonal()
    linear = np.abs(slope[:, d:] - p @ M_inverse) <= TOLERANCE * (np.abs(p) @ np.abs(M_inverse))
    if not linear.all() or (rest[:, d:] ** 2 > EXACT**2 * span).any():
        return None
    scaled = M_inverse / units
    if np.linalg.eigvalsh(scaled)[0] <= 0:
        return None
    mass = np.linalg.inv(scaled) / units
    return _clean(mass, np.sqrt(np.outer(mass.diagonal(), mass.diagonal())))


def _trained(values: Tensor) -> bool:
    """True if values depend on tensors that require gradients: a part of a graph that gives no slope is none."""
    if not values.requires_grad:
        return False
    weights = torch.rand(values.shape, dtype=values.dtype, generator=torch.Generator().manual_seed(0))
    slopes = torch.autograd.grad((weights * values).sum(), leaves(values), allow_unused=True)
    return any(slope is not None and bool((slope != 0).any()) for slope in slopes)


def leaves(values: Tensor) -> list[Tensor]:
    """The leaves of the graph on which values depend, such as a network's weights."""
    found: list[Tensor] = []
    waiting: list[Any] = [values.grad_fn]
    met: set[Any] = set()
    while waiting:
        if (node := waiting.pop()) is not None and node not in met:
            met.add(node)
            found += [node.variable] if node.name().endswith("AccumulateGrad") else []
            waiting += [parent for parent, _ in node.next_functions]
    return found


def _size(A: np.ndarray) -> np.ndarray:
    """√(|A_ii| |A_jj|), from the largest of symmetric matrices A (n, 2d, 2d)."""
    root = np.sqrt(np.abs(A.diagonal(axis1=1, axis2=2)).max(0))
    return np.outer(root, root)


def _clean(M: np.ndarray, units: np.ndarray) -> np.ndarray:
    """M without the last bits of rounding: entries of no size are 0, and those next to a short number are that."""
    M = np.where(np.abs(M) < EXACT * units, 0.0, M)
    short = np.array([float(f"{x:.12g}") for x in M.ravel()]).reshape(M.shape)
    return np.where(np.abs(short - M) <= 4 * np.finfo(float).eps * np.abs(M), short, M)


def _close(a: Tensor, b: Tensor, tolerance: float) -> bool:
    """True if a is b (n, 2d) within the tolerance, relative to the largest of each component."""
    return bool(((a - b).abs() <= tolerance * b.abs().amax(0, keepdim=True)).all())
