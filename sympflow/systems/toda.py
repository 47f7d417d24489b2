"""The periodic Toda lattice: integrable, with as many integrals as particles."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from sympflow.arrays import Array, to_numpy
from sympflow.domain import Ball
from sympflow.system import HamiltonianSystem

LARGEST = 100  # particles: H, its gradient and its Hessian are written out symbolically


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
    whole = not isinstance(n, bool) and isinstance(n, int | float | np.integer) and 2 <= n <= LARGEST and int(n) == n
    if not whole:
        raise ValueError(f"`n` must be an integer from 2 to {LARGEST}, the number of particles; got {n!r}.")
    n = int(n)
    kinetic = " + ".join(f"p{i}**2" for i in range(1, n + 1))
    springs = " + ".join(f"exp(q{i} - q{j})" for i, j in pairwise([*range(1, n + 1), 1]))
    y0 = np.zeros(2 * n)
    y0[n], y0[n + 1 :] = 1.0, -1 / (n - 1)
    return HamiltonianSystem.from_sympy(
        f"({kinetic})/2 + {springs} - {n}",
        name="toda_lattice",
        domain=Ball(np.zeros(2 * n), 2.0),
        y0=y0,
        t_span=(0.0, 100.0),
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
