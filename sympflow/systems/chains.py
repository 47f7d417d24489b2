"""Chains and clusters: stiff and soft springs (Fermi–Pasta–Ulam–Tsingou), the Toda lattice, Lennard-Jones argon."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from sympflow.arguments import check_positive, checked_count
from sympflow.arrays import Array, to_numpy
from sympflow.hamiltonian.domain import Ball, Box, Tube
from sympflow.hamiltonian.system import HamiltonianSystem

SPRINGS = 50  # stiff springs: H, its gradient and its Hessian are written out symbolically


def fput(omega: float = 50.0, m: int = 3) -> HamiltonianSystem:
    """2m unit masses in a row, joined by m stiff linear springs and m + 1 soft quartic ones.

    H = ½ Σ(p_i² + p_{m+i}²) + ½ω² Σ q_{m+i}²
        + ¼[(q₁ − q_{m+1})⁴ + Σ(q_{i+1} − q_{m+i+1} − q_i − q_{m+i})⁴ + (q_m + q_{2m})⁴]

    in the scaled positions of the stiff springs' middles, q_i, and their elongations, q_{m+i}, i = 1 … m.

    Parameters
    ----------
    omega : float
        Angular frequency of the stiff springs, positive.
    m : int
        Number of stiff springs, from 1 to 50: H is written out symbolically.

    Notes
    -----
    Known truths: with ω = 50 and m = 3 the energy from y0 is 2.00120008. The energies I_j of the stiff springs
    (`oscillatory_energies`) are exchanged on the time scale ω, while their sum I stays near its initial value 1, within
    O(1/ω), for very long times. The quadratic part has the constant stiffness matrix diag(0, ω²).

    The domain is a box around the orbit. The default interval is (0, 200), the default step 0.05/ω.

    References
    ----------
    .. [1] E. Hairer, C. Lubich, G. Wanner, "Geometric Numerical Integration", 2nd ed., Springer 2006, I.5.1.
    """
    check_positive("omega", omega)
    m = checked_count("m", m, 1, SPRINGS, f"a positive integer, at most {SPRINGS}, the number of stiff springs")
    slow, fast = [f"q{i}" for i in range(1, m + 1)], [f"q{m + i}" for i in range(1, m + 1)]
    soft = [f"({slow[0]} - {fast[0]})**4", f"({slow[-1]} + {fast[-1]})**4"]
    soft += [f"({slow[i + 1]} - {fast[i + 1]} - {slow[i]} - {fast[i]})**4" for i in range(m - 1)]
    kinetic = " + ".join(f"p{i}**2" for i in range(1, 2 * m + 1))
    stiff = " + ".join(f"{q}**2" for q in fast)
    y0 = np.zeros(4 * m)
    y0[[0, m, 2 * m, 3 * m]] = 1.0, 1 / omega, 1.0, 1.0
    high = np.repeat([1.7, 1.7 / omega, 1.7, 1.7], m)
    return HamiltonianSystem.from_sympy(
        f"({kinetic})/2 + omega**2*({stiff})/2 + ({' + '.join(soft)})/4",
        params={"omega": omega},
        name="fput",
        domain=Box(-high, high),
        y0=y0,
        t_span=(0.0, 200.0),
        dt=0.05 / omega,
    )


def oscillatory_energies(system: HamiltonianSystem, y: Array) -> Array:
    """Energies I_j = (p_{m+j}² + ω²q_{m+j}²)/2 of the stiff springs of `fput`: (..., 4m) to (..., m).

    Their sum over the last axis is the adiabatic invariant I. For a solution, y is ``sol.states``.

    Raises
    ------
    ValueError
        If the system is not `fput`.
    """
    if system.name != "fput":
        raise ValueError(f"`system` must be fput(...), whose stiff springs are known; got {system.name!r}.")
    m, omega = system.ndof // 2, system.params["omega"]
    return (y[..., 3 * m :] ** 2 + (omega * y[..., m : 2 * m]) ** 2) / 2


PARTICLES = 100  # particles: H, its gradient and its Hessian are written out symbolically


def toda_lattice(n: int = 3) -> HamiltonianSystem:
    """H = ½ Σ p_i² + Σ exp(q_i − q_{i+1}) − n over a ring of n unit masses, q_{n+1} = q₁.

    Parameters
    ----------
    n : int
        Number of particles, from 2 to 100: H is written out symbolically.

    Notes
    -----
    Known truths: the n eigenvalues of Lax's matrix (`lax_eigenvalues`) are constant; their sum is half the momentum,
    which is 0 in y0, and the sum of their squares (H + n)/2 for n > 2. In y0, the rest position, one particle has p = 1
    and the others share p = −1, so that H = n/(2(n − 1)). The domain is the ball of radius 2 about the rest position;
    the orbit stays in it. For n = 3 the lattice, expanded to third order about its rest position, is the Hénon–Heiles
    system.

    References
    ----------
    .. [1] M. Toda, "Vibration of a chain with nonlinear interaction", J. Phys. Soc. Japan 22 (1967) 431–436.
    .. [2] H. Flaschka, "The Toda lattice. II. Existence of integrals", Phys. Rev. B 9 (1974) 1924–1925.
    .. [3] M. Hénon, "Integrals of the Toda lattice", Phys. Rev. B 9 (1974) 1921–1923.
    """
    n = checked_count("n", n, 2, PARTICLES, f"an integer from 2 to {PARTICLES}, the number of particles")
    kinetic = " + ".join(f"p{i}**2" for i in range(1, n + 1))
    springs = " + ".join(f"exp(q{i} - q{j})" for i, j in pairwise([*range(1, n + 1), 1]))
    y0 = np.zeros(2 * n)
    y0[n], y0[n + 1 :] = 1.0, -1 / (n - 1)
    return HamiltonianSystem.from_sympy(
        f"({kinetic})/2 + {springs} - {n}",
        name="toda_lattice",
        domain=Ball(np.zeros(2 * n), 2.0),
        y0=y0,
        dt=0.05,
    )


def lax_eigenvalues(y: Array) -> np.ndarray:
    """The eigenvalues of Flaschka's matrix of the periodic Toda lattice, ascending: (..., 2n) to (..., n).

    L has p_i/2 on the diagonal and exp((q_i − q_{i+1})/2)/2 beside it and in the corners. An orbit keeps them.
    """
    q, p = np.split(to_numpy(y), 2, axis=-1)
    n = q.shape[-1]
    a = np.exp((q - np.roll(q, -1, axis=-1)) / 2) / 2
    to_next = a[..., None] * np.roll(np.eye(n), 1, axis=1)
    return np.linalg.eigvalsh(p[..., None] / 2 * np.eye(n) + to_next + to_next.swapaxes(-1, -2))


EPSILON = 119.8
"""Depth of the potential in kelvin (times Boltzmann's constant)."""

SIGMA = 0.341
"""Distance at which the potential is zero, in nanometres."""

MASS = 66.34e-27 / 1.380658e-23
"""The mass of an atom, in K·ns²/nm²: kilograms over Boltzmann's constant, 1 nm/ns being 1 m/s."""

POSITIONS = np.array(
    [[0.0, 0.0], [0.02, 0.39], [0.34, 0.17], [0.36, -0.21], [-0.02, -0.40], [-0.35, -0.16], [-0.31, 0.21]]
)
"""In nanometres: one atom in the middle, six around it."""

VELOCITIES = np.array(
    [[-30.0, -20.0], [50.0, -90.0], [-70.0, -60.0], [90.0, 40.0], [80.0, 90.0], [-40.0, 100.0], [-80.0, -60.0]]
)
"""In nanometres per nanosecond."""


def lennard_jones() -> HamiltonianSystem:
    """H = Σ|p_i|²/(2m) + Σ_{i<j} 4ε[(σ/r_ij)¹² − (σ/r_ij)⁶], d = 14: seven argon atoms in a plane, nearly frozen.

    Lengths are in nanometres, times in nanoseconds, energies in kelvin (divided by Boltzmann's constant); q and p list
    the atoms' two coordinates one atom after the other.

    Notes
    -----
    Known truths: H(y0) = −1260.2 K; total momentum and angular momentum are constant, the first is 0.

    The domain is an ellipsoid about the crystal at rest, with half-axes of 0.15 nm and 3.5 K·ns/nm: the crystal turns,
    and so leaves it, but H does not change with its direction. The default interval is the book's, 0.2 ns, the default
    step its smallest for the Störmer–Verlet method, 40 fs.

    References
    ----------
    .. [1] E. Hairer, C. Lubich, G. Wanner, "Geometric Numerical Integration", 2nd ed., Springer 2006, I.4.2.
    .. [2] J. J. Biesiadecki, R. D. Skeel, "Dangers of multiple time step methods", J. Comput. Phys. 109 (1993) 318–328.
    """
    y0 = np.concatenate([POSITIONS.ravel(), MASS * VELOCITIES.ravel()])
    rest = np.concatenate([POSITIONS.ravel(), np.zeros(14)])
    return HamiltonianSystem.pairs(
        "4*epsilon*((sigma/r)**12 - (sigma/r)**6)",
        masses=np.full(7, MASS),
        dim=2,
        params={"epsilon": EPSILON, "sigma": SIGMA},
        name="lennard_jones",
        domain=Tube([rest, rest], np.repeat([0.15, 3.5], 14)),
        y0=y0,
        t_span=(0.0, 0.2),
        dt=4e-5,
    )
