"""∇³V without symbols: exact by automatic differentiation, and by differences that no origin and no dtype spoils."""

import numpy as np
import pytest
import torch

import sympflow
from sympflow import HamiltonianSystem, SympFlow, systems

SHAPES = {  # V', V'', V''' of u = q − origin
    "cosh": (np.sinh, np.cosh, np.sinh),
    "sinh": (np.cosh, np.sinh, np.cosh),
    "cos": (np.sin, np.cos, lambda u: -np.sin(u)),
    "harmonic": (lambda u: u, lambda u: 1 + 0 * u, lambda u: 0 * u),
    "linear": (lambda u: 1 + 0 * u, lambda u: 0 * u, lambda u: 0 * u),
    "flat": (lambda u: 0 * u, lambda u: 0 * u, lambda u: 0 * u),
    "quartic": (lambda u: u**3, lambda u: 3 * u**2, lambda u: 6 * u),
}
PLACES = [[0.0], [0.1], [0.7], [1.5], [-2.0], [np.pi]]  # equilibria and inflexions among them


def by_functions(shape, origin):
    """A system whose functions are given up to ∇²V·v."""
    force, stiffness, _ = SHAPES[shape]
    return HamiltonianSystem(
        potential=lambda q: 0 * q[..., 0],
        gradient=lambda q: force(q - origin),
        hessian_vector=lambda q, v: stiffness(q - origin) * v,
        ndof=1,
    )


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("origin", [0.0, 3.0, 1e3])
@pytest.mark.parametrize("shape", SHAPES)
def test_differences_are_as_good_as_the_dtype_and_the_origin_allow(shape, origin, dtype):
    """(ε |q|/ℓ)^⅘, ten times: with ℓ ≈ 1 here."""
    q = (np.array(PLACES) + origin).astype(dtype)
    g, A, T = (f((q - dtype(origin)).astype(float)) for f in SHAPES[shape])
    expected = A**2 * g + T * g**2 / 2
    found = by_functions(shape, origin).curvature_gradient(q)
    assert found.dtype == dtype
    accuracy = 10 * (np.finfo(dtype).eps * (1 + origin)) ** 0.8
    np.testing.assert_allclose(found, expected, rtol=accuracy, atol=accuracy * np.abs(A**2 * g).max())


def test_automatic_differentiation_does_not_mind_the_origin():
    system = HamiltonianSystem(potential=lambda q: torch.cosh(q[..., 0] - 1e6), ndof=1)
    q = np.array([[1e6 + 0.7]])
    u = q - 1e6
    expected = np.cosh(u) ** 2 * np.sinh(u) + np.sinh(u) ** 3 / 2
    np.testing.assert_allclose(system.curvature_gradient(q), expected, rtol=1e-14)
    single = HamiltonianSystem(potential=lambda q: torch.cosh(q[..., 0]), ndof=1)
    np.testing.assert_allclose(single.curvature_gradient(u.astype(np.float32)), expected, rtol=1e-6)


def test_positions_of_another_shape_are_refused():
    system = systems.henon_heiles()
    functions = (system.potential, system.force, system.potential_hessian, system.curvature, system.curvature_gradient)
    for method in functions:
        with pytest.raises(ValueError, match=r"^`q` must have shape \(\.\.\., 2\), .* got \(3,\)"):
            method(np.array([0.1, 0.2, 9.0]))


@pytest.mark.parametrize("curvature", [False, True])
def test_the_velocity_of_a_flow_of_numba_functions(curvature, tmp_path):
    """A step h = (1000 ε)^⅕ divides the rounding of what is differenced: of q, or of a difference already."""
    from numba import njit

    @njit
    def potential(q):
        return -np.cos(q[0] - 1000)

    @njit
    def gradient(q, out):
        out[0] = np.sin(q[0] - 1000)

    @njit
    def product(q, v, out):
        out[0] = np.cos(q[0] - 1000) * v[0]

    symbolic = HamiltonianSystem.from_sympy("p**2/2 - cos(q - 1000)")
    compiled = HamiltonianSystem(potential=potential, gradient=gradient, hessian_vector=product, ndof=1)
    flow = SympFlow.primed(symbolic, 2, dt=1.0, processor=1, curvature=curvature)
    for parameter in flow.parameters():
        parameter.data += 0.1 * torch.linspace(-1, 1, parameter.numel(), dtype=torch.float64).reshape(parameter.shape)
    flow.save(tmp_path / "flow.safetensors")
    same = sympflow.load(tmp_path / "flow.safetensors", system=compiled)
    x = torch.tensor([[1000.0, 0.3], [1000.7, 0.2], [1001.57, 0.4], [1000.0, 0.0]], dtype=torch.float64)
    accuracy = 10 * (np.finfo(float).eps * 1000) ** (0.6 if curvature else 0.8)
    assert (same.velocity(0.6, x) - flow.velocity(0.6, x)).abs().max() < accuracy
