"""The quadratic part of H: read off, given by hand, or refused with the reason; its modes and its exact flow."""

import numpy as np
import pytest
import torch
from scipy.linalg import expm

from sympflow import HamiltonianSystem, SympFlow, solve
from sympflow.hamiltonian.linear_part import LinearPart
from sympflow.hamiltonian.parts import ExactParts, SubFlow, exact_parts
from sympflow.systems import fput, harmonic_oscillator, henon_heiles, spring_pendulum, toda_lattice

made = HamiltonianSystem.from_sympy


def test_fput_is_read_off():
    part = fput(omega=50.0).linear_part
    assert np.array_equal(part.stiffness_matrix, np.diag([0, 0, 0, 2500, 2500, 2500]))
    assert part.kinds == ("free",) * 3 + ("oscillator",) * 3
    assert np.allclose(part.frequencies, [0, 0, 0, 50, 50, 50])
    assert part.stiffness == pytest.approx(50 * 200)
    assert part.n_classes == 2


def test_the_parts_add_up_to_the_hamiltonian():
    for system in (fput(omega=3.0), henon_heiles(), spring_pendulum(100.0, coordinates="polar")):
        parts = exact_parts(system)
        y = system.domain.sample(20, 0)
        X, Y = parts.to_modes(y)
        H = sum(parts.value(k, X, Y, None) for k in range(1, len(parts.rest) + 1)) + parts.linear_energies(X, Y).sum(-1)
        difference = H - system.hamiltonian(y)
        assert np.ptp(difference) < 1e-12 * np.abs(H).max()


def test_by_hand_it_is_the_same_as_read_off():
    K = np.diag([0.0, 400.0])
    U = "q1**4/4 + (q1 - q2)**4/4"
    symbolic = made(f"(p1**2 + p2**2)/2 + 200*q2**2 + {U}", y0=[1, 0.01, 0.3, 0.2])
    by_hand = HamiltonianSystem(
        lambda q: 200 * q[..., 1] ** 2 + q[..., 0] ** 4 / 4 + (q[..., 0] - q[..., 1]) ** 4 / 4,
        ndof=2,
        stiffness_matrix=K,
        y0=[1, 0.01, 0.3, 0.2],
    )
    one, other = (solve(s, "linear_srkn6b", (0, 2), dt=0.1) for s in (symbolic, by_hand))
    assert one.stats["backend"] == "compiled"
    assert other.stats["backend"].startswith("numpy: `system` has parts that are not formulas")
    assert np.abs(one.y - other.y).max() < 1e-11


def coupled(seed):
    """B positive definite, K of rank d with a negative eigenvalue and a zero one."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((4, 4))
    Q = np.linalg.qr(rng.standard_normal((4, 4)))[0]
    return LinearPart(A @ A.T + np.eye(4), Q @ np.diag([900.0, 4.0, 0.0, -1.0]) @ Q.T, rng.standard_normal(4))


@pytest.mark.parametrize("seed", range(4))
def test_the_flow_is_the_matrix_exponential(seed):
    part = coupled(seed)
    assert sorted(part.kinds) == ["free", "hyperbolic", "oscillator", "oscillator"]
    parts = ExactParts(part, [], 4)
    B, K, t = part.inverse_mass, part.stiffness_matrix, 0.37
    y = np.random.default_rng(9).standard_normal((5, 8))
    generator = np.block([[np.zeros((4, 4)), B], [-K, np.zeros((4, 4))]])
    centered = y - np.concatenate([part.center, np.zeros(4)])
    exact = centered @ expm(t * generator).T + np.concatenate([part.center, np.zeros(4)])
    maps = [SubFlow(0, np.full(part.n_classes, t))]
    for x in (y, torch.as_tensor(y)):
        z = np.asarray(parts.from_modes(*parts.apply(maps, *parts.to_modes(x))))
        assert np.abs(z - exact).max() < 1e-11 * np.abs(exact).max()


@pytest.mark.parametrize("z", [1.0, np.pi, np.pi / 2, 20.0, 1e3])
def test_the_compiled_rotation_does_not_drift(z):
    """Rounding moves the energy as a random walk, √n ε, even at the poles of tan."""
    steps = 200_000
    sol = solve(harmonic_oscillator(), "impulse", (0.0, z * steps), dt=z, save_every=1000)
    assert sol.stats["backend"] == "compiled"
    assert np.abs(sol.energy_error()).max() < 8 * np.sqrt(steps) * np.finfo(float).eps
    turned = np.array([np.cos(z * 1000), -np.sin(z * 1000)])
    assert np.abs(sol.y[:, 1] - turned).max() < 1e-12 * (1 + z) * 10


def test_hyperbolic_and_free_modes_compiled():
    system = made("(p1**2 + p2**2 + p3**2)/2 + 2*q1**2 - q2**2/2", y0=[1, 0.5, 0.2, 0, 0.3, 1])
    sol = solve(system, "impulse", (0, 3), dt=1.0)
    t = sol.t
    expected = np.array([np.cos(2 * t), 0.5 * np.cosh(t) + 0.3 * np.sinh(t), 0.2 + t])
    assert np.abs(sol.q - expected).max() < 1e-13 * np.cosh(3) * 10


def test_an_exponential_is_no_monomial():
    morse = made("(p1**2 + p2**2)/2 + (1 - exp(-q1))**2 + 200*q2**2", y0=[0.3, 0.01, 0, 0])
    part = morse.linear_part
    assert part.stiffness_matrix.tolist() == [[0, 0], [0, 400]]
    sol = solve(morse, "linear_srkn6b", (0, 5), dt=0.05)
    assert np.abs(sol.energy_error()).max() < 1e-4
    toda = toda_lattice(5)
    with pytest.raises(ValueError, match=r"has no linear part"):
        _ = toda.linear_part
    sol = solve(toda, "strang_parts", (0, 5), dt=0.05, backend="array")
    assert np.abs(sol.energy_error()).max() < 1e-2
    assert SympFlow.split(toda, 2, dt=0.05).sequence == (1, 2, 1, 2, 1)


def test_terms_linear_in_q_move_the_center():
    part = made("p**2/4 + 8*(q - 3)**2 + cos(q)").linear_part
    assert part.center == pytest.approx([3.0])
    assert part.frequencies == pytest.approx([np.sqrt(8)])


@pytest.mark.parametrize("unit", [1e-16, 1e-8, 1.0, 1e8])
def test_the_quadratic_part_is_the_same_in_any_unit_of_length(unit):
    """H with a linear term, whose centre is taken out, in multiples of a unit."""
    H = f"p**2/2 + q**2/2 + 0.1*q**3/({unit!r}) - 0.3*({unit!r})*q"
    system = made(H, y0=[0.2 * unit, 0.0], t_span=(0, 10), dt=0.1)
    ends = [solve(system, method).y[0, -1] / unit for method in ("linear_srkn11b", "kahan_li8")]
    assert ends == pytest.approx([0.2910658290115, 0.2910658290115], rel=1e-10)
