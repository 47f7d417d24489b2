"""Systems of a peer as HamiltonianSystem: a callable H(q, p), or a torch module that gives the right-hand side."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from sympflow.system import HamiltonianSystem

N_NODES = 16  # Gauss–Legendre nodes of the line integral: exact for fields of degree 31
TOLERANCE = 1e-8
TIMES = (0.0, 0.3719, 1.0, 3.14159265)  # at which a field must be the same to count as autonomous


def from_hamiltonian(H: Callable[[Tensor, Tensor], Tensor], ndof: int, **scene: Any) -> HamiltonianSystem:
    """The system of a callable H(q, p), written with torch functions on (..., d).

    Where H turns out to be ½ pᵀM⁻¹p + V(q), as far as eight random states near y0 can tell, it is made a separable
    system, to which the splitting methods apply.

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
        raise ValueError(
            f"`H` must map q, p of shape (..., {ndof}) to (...), with torch functions; for (8, {ndof}) it gave "
            f"{tuple(getattr(values, 'shape', ()))}. Sum over the last axis."
        )
    hessian = torch.func.vmap(torch.func.hessian(lambda y: H(y[:ndof], y[ndof:])))(probes)
    velocity = torch.func.grad(lambda p: H(probes[:, :ndof], p).sum())(probes[:, ndof:])
    M_inverse = _inverse_mass(hessian[:, :ndof, ndof:], hessian[:, ndof:, ndof:], probes[:, ndof:], velocity)
    if M_inverse is None:
        return HamiltonianSystem(hamiltonian=H, ndof=ndof, **scene)
    return HamiltonianSystem(lambda q: H(q, torch.zeros_like(q)), ndof=ndof, mass=np.linalg.inv(M_inverse), **scene)


def from_module(module: Callable[[Any, Tensor], Tensor], ndof: int, **scene: Any) -> HamiltonianSystem:
    """The system of a right-hand side `module(t, y)` with y = [q, p] on the last axis, as torchdiffeq uses them.

    H is recovered from the field f = J∇H as the line integral H(y) = ∫₀¹ (−J f(s y))·y ds from the origin, by
    Gauss–Legendre quadrature, after it has been tested at random states that f is the field of some autonomous H.

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
    if not all(torch.allclose(f, g, rtol=1e-10, atol=1e-12) for g in later):
        raise ValueError("`module` depends on t, which is not supported: freeze the time, or extend the phase space.")

    zero = torch.zeros((), dtype=probes.dtype)

    def minus_J_f(y: Tensor) -> Tensor:
        velocity, force = module(zero.to(y), y).chunk(2, dim=-1)
        return torch.cat([-force, velocity], dim=-1)

    jacobian = torch.func.vmap(torch.func.jacrev(minus_J_f))(probes)
    asymmetry = float((jacobian - jacobian.mT).abs().max() / jacobian.abs().max().clamp(min=1e-300))
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
    if not torch.allclose(slope, minus_J_f(probes).detach(), rtol=TOLERANCE, atol=TOLERANCE):
        raise ValueError(
            "`module` is not smooth on the straight lines from the origin to the states, along which H is integrated "
            "(a singularity lies on them): give H itself, with from_hamiltonian or HamiltonianSystem."
        )
    M_inverse = _inverse_mass(jacobian[:, :ndof, ndof:], jacobian[:, ndof:, ndof:], probes[:, ndof:], f[:, :ndof])
    if M_inverse is None:
        return HamiltonianSystem(hamiltonian=H, ndof=ndof, **scene)

    def gradient(q: Tensor) -> Tensor:
        return minus_J_f(torch.cat([q, torch.zeros_like(q)], dim=-1))[..., :ndof]

    mass = np.linalg.inv(M_inverse)
    potential = _for_arrays(lambda q: H(q, torch.zeros_like(q)))
    return HamiltonianSystem(potential, ndof=ndof, mass=mass, gradient=_for_arrays(gradient), **scene)


def _for_arrays(function: Callable[[Tensor], Tensor]) -> Callable[[Any], Any]:
    """A function of tensors that takes NumPy arrays as well."""

    def either(x: Any) -> Any:
        if isinstance(x, Tensor):
            return function(x)
        with torch.no_grad():
            return function(torch.from_numpy(np.ascontiguousarray(x))).numpy()

    return either


def _probes(ndof: int, y0: ArrayLike | None) -> Tensor:
    """Eight states near y0, or near the origin."""
    if isinstance(ndof, bool) or not isinstance(ndof, int) or ndof < 1:
        raise ValueError(f"`ndof` must be a positive integer, the degrees of freedom; got {ndof!r}.")
    center = np.zeros(2 * ndof) if y0 is None else np.asarray(y0, dtype=float)
    spread = 0.25 * np.maximum(np.abs(center).max(initial=0.0), 1.0)
    noise = np.random.default_rng(20260101).uniform(-1, 1, (8, 2 * ndof))
    return torch.from_numpy(center + spread * noise)


def _inverse_mass(mixed: Tensor, kinetic: Tensor, p: Tensor, velocity: Tensor) -> np.ndarray | None:
    """M⁻¹ if ∂²H/∂q∂p vanishes, ∂²H/∂p² is one positive definite matrix and ∂H/∂p = M⁻¹p at all probes."""
    scale = float(kinetic.abs().max().detach())
    constant = float((kinetic - kinetic[0]).abs().max().detach())
    if scale == 0 or max(float(mixed.abs().max().detach()), constant) > TOLERANCE * scale:
        return None
    M = kinetic.mean(0).detach().numpy()
    M = (M + M.T) / 2
    M[np.abs(M) < TOLERANCE * scale] = 0.0
    rounded = np.round(M, 12)
    linear = np.allclose(velocity.detach().numpy(), p.numpy() @ rounded, rtol=TOLERANCE, atol=TOLERANCE * scale)
    return rounded if linear and np.linalg.eigvalsh(rounded)[0] > 0 else None
