"""A system in other units is the same system: the fit of its flow finds the same, up to rounding."""

from dataclasses import replace

import numpy as np
import pytest

from sympflow import Box, EnergySublevel, HamiltonianSystem, SympFlow, train
from sympflow.training import trials
from sympflow.training.table_fit import Table

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


@pytest.mark.parametrize("dt", [1e-13, 1e-6, 1.0, 8e5, 5e14])
@pytest.mark.parametrize("options", [{"curvature": True}, {"polynomial": 6, "first": "kick"}], ids=["curved", "poly"])
def test_the_parameters_of_a_table_are_found_at_every_step_length(dt, options):
    """Its numbers are of size Δt, Δt³ and Δt⁵: powers of τ, in which the parameters are all of size one, tell them."""
    flow = SympFlow.primed(oscillator(1.0, 1.0, 1.0), 4, dt=dt, processor=3, **options)
    table = Table(flow)
    offset, design = table.frozen(dt)
    theta = np.random.default_rng(0).normal(size=design.shape[-1])
    np.testing.assert_allclose(table.frozen_parameters(offset[0] + design[0] @ theta), theta, rtol=1e-14)


@pytest.mark.parametrize("options", [{"curvature": True}, {"polynomial": 6, "first": "kick"}], ids=["curved", "poly"])
def test_flows_are_alike_in_all_units(options):
    """Among them lengths so long, and masses so small, that Ω is far larger in positions than in momenta or less."""
    errors = []
    for unit, period in zip(UNITS, PERIODS, strict=True):
        system, (L, E, m) = oscillator(*unit), unit
        flow = SympFlow.primed(system, 3, dt=0.8 * period, processor=2, **options)
        flow = train(system, flow=flow, restarts=2, steps=20, points=40, reference_states=20, progress=False)
        errors.append(flow.figures["one_step_error"] / np.hypot(L, np.sqrt(m * E)))
    assert max(errors) < 3 * min(errors)
    assert max(errors) < 1e-3
