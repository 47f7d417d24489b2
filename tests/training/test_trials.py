"""The flow that `train` fits to a system of which nothing else is said: the cost of kicks, and short trials."""

import time
from dataclasses import replace

import numpy as np
import pytest

from sympflow import max_energy_error, solve, systems, train
from sympflow.kernels.splitting_loops import splitting_loops
from sympflow.training import trials
from sympflow.training.least_squares import Minimum
from sympflow.training.points import Stream, states
from sympflow.training.session import Session
from sympflow.training.starts import SEED, default_primed
from sympflow.training.table_fit import TableFit, TableRun

HH, PENDULUM = systems.henon_heiles(), systems.pendulum()


@pytest.mark.parametrize("seconds", [0.0, 0.02], ids=["none", "some"])
def test_trials_that_the_time_ended_are_warned_of(monkeypatch, clock, seconds):
    monkeypatch.setattr("sympflow.training.session.LEAST_PART", 3.5 * seconds)
    clock.tick = 1e-4

    def trial(start, *_):
        clock.now += seconds
        return trials.Trial(start, 1e-8)

    monkeypatch.setattr(trials, "trial", trial)
    with pytest.warns(RuntimeWarning, match="longer `time_budget`"):
        trials.chosen_trial(HH, HH.domain, Session(time_budget=1e-3))
    monkeypatch.setattr(trials, "SHAPES", trials.SHAPES[:1])
    trials.chosen_trial(HH, HH.domain, Session(time_budget=100.0))  # warnings are errors


def law(monkeypatch, error):
    """Trials whose errors are those of a law, error(ω Δt, curvature)."""
    omega = 1.0 / default_primed(HH).dt
    monkeypatch.setattr(trials, "SHAPES", ())
    monkeypatch.setattr(
        trials, "trial", lambda start, *_: trials.Trial(start, error(start.dt * omega, start.curvature))
    )
    return trials.chosen_trial(HH, HH.domain).start


def test_the_order_of_the_error_decides_between_short_and_long_steps(monkeypatch):
    """Work e^(1/6) is Δt⁻¹ e^(1/6): an error of order 6 gains as much at every Δt, a lower one at the longest."""
    first, *_, last = trials.tried_starts(HH, HH.domain, curvature=False)
    assert first.dt < last.dt
    assert law(monkeypatch, lambda x, c: 1e-9 * x**4) == last
    assert law(monkeypatch, lambda x, c: 1e-9 * x**12) == first


def test_where_all_miss_the_goal_the_least_error_is_taken(monkeypatch):
    """The longest step wins among errors that are alike; curvature terms where they alone meet the goal."""
    first, *_, last = trials.tried_starts(HH, HH.domain, curvature=False)
    assert law(monkeypatch, lambda x, c: 1e-3 if x == 1.0 else 2.1e-3) == first
    assert law(monkeypatch, lambda x, c: 1e-3 if x == 1.0 else 1.9e-3) == last
    assert law(monkeypatch, lambda x, c: 1e-6 if c else 1.0) == replace(last, curvature=True)
    assert law(monkeypatch, lambda x, c: np.inf) == first


def test_a_map_that_keeps_the_energy_alone_is_no_candidate(monkeypatch):
    """The identity keeps it exactly, and misses all of what a step moves a state."""
    monkeypatch.setattr(TableFit, "coefficients", lambda self, theta: np.zeros((1, self.design.shape[1])))
    monkeypatch.setattr(TableFit, "minimize", lambda self, theta, *_, **__: Minimum(theta, 0.0, 0, ""))
    assert trials.trial(default_primed(PENDULUM), PENDULUM, PENDULUM.domain).error == np.inf
    monkeypatch.setattr(trials, "USELESS", 1.1)
    assert trials.trial(default_primed(PENDULUM), PENDULUM, PENDULUM.domain).error == 0.0


def test_the_error_of_long_runs_is_that_of_solve():
    flow = default_primed(PENDULUM).flow(PENDULUM)
    y0, n = states(PENDULUM.domain, trials.ORBITS, SEED, Stream.REFERENCE), trials.LONG
    t = flow.dt * np.linspace(0, n, trials.SAVED + 1).astype(int)
    sol = solve(PENDULUM, flow, (0.0, t[-1]), y0=y0, t_eval=t, on_domain_exit="ignore")
    expected = np.median(max_energy_error(sol))
    assert trials.long_errors([flow], PENDULUM, PENDULUM.domain) == pytest.approx([expected], rel=1e-6)


class Started(Exception):
    pass


def test_only_where_nothing_is_said_there_are_trials(monkeypatch, tmp_path):
    made = []

    def chosen(system, domain, session):
        made.append(system)
        return trials.Trial(replace(default_primed(system), dt=1.25, curvature=True), 1e-6)

    def start(self, *_):
        raise Started(self.flow)

    def flow_of(**options):
        with pytest.raises(Started) as started:
            train(HH, progress=False, **options)
        return started.value.args[0]

    monkeypatch.setattr(trials, "chosen_trial", chosen)
    monkeypatch.setattr(TableRun, "go", start)
    flow = flow_of(seed=3)
    assert (flow.dt, flow.curvatures is not None, made) == (1.25, True, [HH])
    for options in ({"dt": 1.0}, {"restarts": 2}, {"points": 60}, {"time_budget": 5.0}, {"stages": 2}):
        assert flow_of(**options).curvatures is None
    assert made == [HH]


@pytest.mark.slow
def test_the_choice_is_the_same_however_slow_the_machine_is(monkeypatch):
    """Clocks that run at another speed, now faster and now slower, change nothing: no time is measured."""
    chosen = trials.chosen_trial(PENDULUM, PENDULUM.domain).start
    random = np.random.default_rng(0)
    for name in ("perf_counter", "process_time", "thread_time"):
        clock = getattr(time, name)
        monkeypatch.setattr(time, name, lambda clock=clock: clock() + 1e4 * random.random())
    assert trials.chosen_trial(PENDULUM, PENDULUM.domain).start == chosen


QUICK = {"STARTS": 2, "STEPS": 20, "FINAL_STEPS": 20, "POINTS": 40, "LENGTH": 50}


def test_the_error_of_a_trial_is_that_of_its_orbits(monkeypatch):
    """A whole fit of the same flow is as near, or nearer by what a longer search finds."""
    for name, value in QUICK.items():
        monkeypatch.setattr(trials, name, value)
    start = replace(default_primed(PENDULUM), stages=2, processor=2)
    error = trials.trial(start, PENDULUM, PENDULUM.domain).error
    assert error == trials.trial(start, PENDULUM, PENDULUM.domain).error
    options = {"restarts": 2, "steps": 20, "points": 40, "label_times": 2, "reference_states": 1, "progress": False}
    flow = train(PENDULUM, flow=start.flow(PENDULUM), **options)
    y0, t_span = PENDULUM.domain.sample(20, 1), (0, trials.LENGTH * start.dt)
    sol = solve(PENDULUM, flow, t_span, y0=y0, on_domain_exit="ignore", backend="array")
    assert 0.1 < error / np.median(max_energy_error(sol)) < 10


@pytest.mark.parametrize("unit", [1e-15, 1.0, 1e4])
def test_steps_divide_round_times(unit):
    for dt in np.geomspace(0.01, 9.9, 40) * unit:
        steps = 100 * unit / trials.dividing(dt)
        assert steps == pytest.approx(round(steps), rel=1e-12)
        assert abs(np.log2(trials.dividing(dt) / dt)) <= 0.5 + 1e-12


@pytest.mark.parametrize("system", [HH, PENDULUM, systems.quartic()], ids=lambda s: s.name)
def test_each_term_makes_a_kick_dearer(system):
    cycles = [splitting_loops(system).kick_cycles(level) for level in range(3)]
    assert 0 < cycles[0] < cycles[1] < cycles[2]
