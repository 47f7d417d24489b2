"""Round-off: Brouwer's law for compiled splittings, and less with compensated sums; drifts are seen."""

from dataclasses import replace

import numpy as np
import pytest

from sympflow import energy_growth, get, solve, systems


@pytest.fixture(scope="module")
def runs():
    system, n = systems.henon_heiles(), 1_000_000
    y0 = system.domain.sample(8, 3)
    return {
        compensated: solve(system, "kahan_li8", (0, 0.05 * n), y0, dt=0.05, compensated=compensated, save_every=100)
        for compensated in (False, True)
    }


def test_rounding_grows_like_a_random_walk_without_drift(runs):
    growth = energy_growth(runs[False])
    assert 0.3 < growth.exponent < 0.7  # ½ by Brouwer's law; a systematic error would give 1
    assert abs(growth.drift) < 4 * growth.drift_error
    assert growth.rms[-1] < 1e-12


def test_compensated_sums_lower_it(runs):
    plain, compensated = (energy_growth(runs[c]) for c in (False, True))
    assert compensated.rms[-1] < plain.rms[-1] / 5


def test_a_drift_and_a_truncation_error_have_their_exponents(runs):
    sol = runs[False]
    truncated = solve(sol.system, "verlet", sol.t_span, sol.y0, dt=0.05, save_every=1000)
    assert abs(energy_growth(truncated).exponent) < 0.05
    growth = energy_growth(replace(sol, y=sol.y * (1 + 1e-12 * np.arange(len(sol.t)))))
    assert growth.exponent == pytest.approx(1, abs=0.05)
    assert growth.drift > 10 * growth.drift_error > 0


def test_one_trajectory_tells_no_drift(runs):
    system = runs[False].system
    one = solve(system, "kahan_li8", (0, 5e3), system.y0, save_every=10)
    assert energy_growth(one).drift_error == np.inf


def test_what_it_needs_is_said(runs):
    system = runs[False].system
    with pytest.raises(ValueError, match=r"^`sol` has no fixed step"):
        energy_growth(solve(system, "rk45", (0, 10)))
    with pytest.raises(ValueError, match=r"^`sol` must have at least 10000 steps"):
        energy_growth(solve(system, "verlet", (0, 10)))
    with pytest.raises(ValueError, match=r"^`sol` has failed"):
        energy_growth(solve(systems.harmonic_oscillator(), get("verlet")(dt=3.0), (0, 1e5)))
    with pytest.raises(TypeError, match=r"^`solution`|^`sol`"):
        energy_growth(1)
    few = solve(systems.pendulum(), "verlet", (0, 1000), t_eval=[0, 500, 1000])
    with pytest.raises(ValueError, match=r"^`sol` has outputs in 1 of .* windows between"):
        energy_growth(few)


def test_a_primed_flow_sums_with_compensation_too():
    import torch

    from sympflow import SympFlow

    system, n = systems.henon_heiles(), 300_000
    flow = SympFlow.primed(system, scheme="kahan_li8", dt=0.05)
    y0 = system.domain.sample(8, 3)
    rms = [
        energy_growth(
            solve(system, "sympflow", (0, 0.05 * n), y0, flow=flow, compensated=compensated, save_every=100)
        ).rms[-1]
        for compensated in (False, True)
    ]
    assert rms[1] < rms[0] / 4
    with pytest.raises(ValueError, match=r"^`compensated` sums need the compiled loops of a primed flow"):
        solve(system, "sympflow", (0, 1), torch.from_numpy(y0), flow=flow, compensated=True)
