"""A system in other units is the same system: the fit of its flow finds the same, up to rounding."""

from dataclasses import replace

import numpy as np
import pytest

from sympflow import Box, EnergySublevel, HamiltonianSystem
from sympflow.training import trials

QUICK = {"PHASES": (1.5,), "STARTS": 2, "STEPS": 20, "FINAL_STEPS": 40, "POINTS": 40, "LENGTH": 50}
QUICK |= {"SHAPES": (("222", 9, 1.0), ("121", 6, 1.0))}  # of more some are as good as each other but for rounding
UNITS = [(1.0, 1.0, 1.0), (1e11, 1e30, 1e20), (1e11, 1.0, 1e-22), (1e-10, 1e-19, 1e-26)]  # of length, energy and mass
PERIODS = [1.0, 1e6, 1.0, 10**-13.5]  # L √(m/E)


def oscillator(L, E, m):
    """The same anharmonic oscillator in any units."""
    P = np.sqrt(m * E)
    return HamiltonianSystem.from_sympy(
        "p**2/(2*m) + E*((q/L)**2/2 + (q/L)**3/5 + (q/L)**4/4)",
        params={"L": L, "E": E, "m": m},
        domain=EnergySublevel(0.5 * E, Box([-1.5 * L, -1.2 * P], [1.5 * L, 1.2 * P])),
    )


def test_trials_and_the_choice_by_them_are_alike_in_all_units(monkeypatch):
    """The order of sums differs in rounding alone, which some tens of steps along a valley enlarge."""
    for name, value in QUICK.items():
        monkeypatch.setattr(trials, name, value)
    found, trial = [], trials.trial

    def noted(*arguments):
        found.append(trial(*arguments))
        return found[-1]

    monkeypatch.setattr(trials, "trial", noted)
    monkeypatch.setattr(trials, "NEAREST", 1)  # what is timed is not alike
    systems = [oscillator(*unit) for unit in UNITS[:2]]
    chosen = [trials.chosen_trial(system, system.domain).start for system in systems]
    assert all(start.curvature for start in chosen)
    first, second = (replace(start, dt=start.dt / T) for start, T in zip(chosen, PERIODS, strict=False))
    assert first == replace(second, dt=first.dt)
    assert first.dt == pytest.approx(second.dt, rel=1e-12)
    np.testing.assert_allclose(*np.log10([one.error for one in found]).reshape(2, -1), atol=0.5)
