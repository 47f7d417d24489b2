"""A thousand years of the solar system: the planets' orbits, and what is conserved.

python examples/planets.py
"""

from __future__ import annotations

import numpy as np

import sympflow
from sympflow.systems.planets import PLANETS

YEAR = 365.25


def main(years: float = 1000.0) -> None:
    system = sympflow.systems.solar_system()
    sol = sympflow.solve(system, t_span=(0, years * YEAR), save_every=100)
    orbits = sympflow.elements(sol)
    print(f"{'':10}{'a / AU':>10}{'e':>20}{'inclination / °':>20}")
    for name, a, e, tilt in zip(PLANETS, orbits.a, orbits.e, np.degrees(orbits.inc), strict=True):
        print(f"{name:10}{a.mean():10.5f}{e.min():10.5f} –{e.max():8.5f}{tilt.min():10.4f} –{tilt.max():8.4f}")
    L = sympflow.angular_momentum(sol)
    lost = np.linalg.norm(L - L[:, :1], axis=0).max() / np.linalg.norm(L[:, 0])
    print(f"relative energy error {np.abs(sol.energy_error()).max():.1e}, angular momentum {lost:.1e}")


if __name__ == "__main__":
    main()
