"""The Fermi–Pasta–Ulam–Tsingou chain with alternating stiff and soft springs."""

from __future__ import annotations

import math

import numpy as np

from sympflow.arrays import Array
from sympflow.domain import Box
from sympflow.system import HamiltonianSystem

LARGEST = 50  # stiff springs: H, its gradient and its Hessian are written out symbolically


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
    if not (isinstance(omega, int | float) and 0 < omega < math.inf):
        raise ValueError(f"`omega` must be positive and finite; got {omega!r}.")
    whole = not isinstance(m, bool) and isinstance(m, int | float | np.integer) and 1 <= m <= LARGEST and int(m) == m
    if not whole:
        raise ValueError(f"`m` must be a positive integer, at most {LARGEST}, the number of stiff springs; got {m!r}.")
    m = int(m)
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
