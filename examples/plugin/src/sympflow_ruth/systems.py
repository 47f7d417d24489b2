"""A system for the lists of sympflow."""

from sympflow import Box, HamiltonianSystem


def morse(depth: float = 1.0, width: float = 1.0) -> HamiltonianSystem:
    """The Morse oscillator, H = p²/2 + D (1 − exp(−q/w))², below its dissociation at H = D.

    Parameters
    ----------
    depth : float
        D.
    width : float
        w.
    """
    p = (0.6 * depth) ** 0.5
    return HamiltonianSystem.from_sympy(
        "p**2/2 + depth*(1 - exp(-q/width))**2",
        params={"depth": depth, "width": width},
        name="morse",
        domain=Box([-0.3 * width, -p], [0.6 * width, p]),
        y0=[0.5 * width, 0.0],
        dt=0.05 * width / depth**0.5,
    )
