"""Long runs: windows give the bits of one piece, Ctrl-C keeps what was computed, and progress is told."""

import numpy as np
import pytest

import sympflow
from sympflow.integrators import clocks, grid_runs, progress
from sympflow.integrators.contract import Interrupted
from sympflow.solver import solve
from sympflow.systems import henon_heiles

SYSTEM = henon_heiles()
BATCH = SYSTEM.y0 + 0.02 * np.random.default_rng(0).standard_normal((3, 4))
SPAN, DT = (0.0, 40.0), 0.05
TIMES = np.array([0.0, 0.05, 3.3, 3.31, 12.345, 12.345, 39.9, 40.0])


@pytest.fixture
def short_windows(monkeypatch):
    monkeypatch.setattr(grid_runs, "ONE", 100)
    monkeypatch.setattr(grid_runs, "MANY", 300)
    monkeypatch.setattr(grid_runs, "ARRAY_STEPS", 30)
    monkeypatch.setattr(grid_runs.Pace, "took", lambda self, n: None)


class Told(list):
    """A progress function that keeps what it is told, and that Ctrl-C interrupts once so much is done."""

    def __init__(self, until=np.inf):
        self.until = until

    def __call__(self, done, total):
        self.append((done, total))
        if done >= self.until:
            raise KeyboardInterrupt


def test_a_bar_is_drawn_on_stderr(short_windows, capsys):
    solve(SYSTEM, "verlet", SPAN, dt=DT, progress=True)
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.rstrip().startswith("\r[####")
    assert "100 %  t = 40 of 40" in shown.err
    with pytest.raises(TypeError, match=r"`progress` must be True, False, or a function of \(done, total\); got 'yes'"):
        solve(SYSTEM, "verlet", SPAN, dt=DT, progress="yes")


@pytest.mark.parametrize(
    ("y0", "options"),
    [
        (SYSTEM.y0, {}),
        (SYSTEM.y0, {"t_eval": TIMES}),
        (SYSTEM.y0, {"dense_output": True}),
        (SYSTEM.y0, {"backend": "array"}),
        (SYSTEM.y0, {"events": lambda t, y: y[0]}),
        (BATCH, {"save_every": 7}),
    ],
    ids=["steps", "times", "dense", "array", "events", "batch"],
)
def test_what_was_computed_before_ctrl_c_is_kept(short_windows, monkeypatch, y0, options):
    monkeypatch.setattr(progress, "BETWEEN", 0.0)
    whole = solve(SYSTEM, "verlet", SPAN, y0, dt=DT, **options)
    with pytest.raises(KeyboardInterrupt) as caught:
        solve(SYSTEM, "verlet", SPAN, y0, dt=DT, progress=Told(10.0), **options)
    assert type(caught.value) is sympflow.Interrupted is Interrupted
    sol = caught.value.solution
    until = sol.stats["interrupted_at"]
    n = len(sol.t)
    assert 10 <= until < 40
    assert np.all(np.asarray(sol.status) == -1)
    assert sol.message == str(caught.value)
    assert sol.message.startswith(f"The run was interrupted after t = {until:.15g}")
    np.testing.assert_array_equal(sol.t, whole.t[:n])
    np.testing.assert_array_equal(sol.y, whole.y[..., :n])
    assert n == np.count_nonzero(whole.t < until + DT / 2) or "events" in options
    if sol.sol:
        np.testing.assert_array_equal(sol.sol(3.3), whole.sol(3.3))
    if sol.t_events is not None:
        np.testing.assert_array_equal(sol.t_events[0], whole.t_events[0][whole.t_events[0] <= until])


def test_groups_of_parameters_are_kept_up_to_where_they_were(short_windows, monkeypatch):
    """The first values have ended, the second ones are interrupted, the last ones have not begun."""
    monkeypatch.setattr(progress, "BETWEEN", 0.0)
    system = sympflow.HamiltonianSystem.from_sympy("p**2/2 + k*q**2/2", params={"k": 1.0}, y0=[1.0, 0.0], dt=0.1)
    options = {"params": {"k": [1.0, 2.0, 3.0]}, "backend": "array"}
    whole, seen = solve(system, "verlet", (0, 20), **options), []

    def told(done, total):
        seen.append(done)
        if seen.count(seen[0]) == 2 and done > 10:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as caught:
        solve(system, "verlet", (0, 20), progress=told, **options)
    sol = caught.value.solution
    known = np.isfinite(sol.y).all(1)
    assert sol.y.shape == whole.y.shape
    assert known[0].all()
    assert 100 < known[1].sum() < 150
    assert not known[2].any()
    assert sol.status.tolist() == [0, -1, -1]
    assert sol.message.startswith("The run was interrupted")
    np.testing.assert_array_equal(sol.y[:2][..., known[1]], whole.y[:2][..., known[1]])


@pytest.mark.parametrize(
    ("options", "batch"),
    [({}, False), ({"dense_output": True}, True), ({"backend": "array"}, True), ({"events": lambda t, y: y[0]}, False)],
    ids=["steps", "dense", "batch", "events"],
)
def test_ctrl_c_and_progress_on_the_logarithmic_clock(monkeypatch, options, batch):
    monkeypatch.setattr(progress, "BETWEEN", 0.0)
    monkeypatch.setattr(clocks, "FIRST_CHUNK", 20)
    monkeypatch.setattr(clocks, "LARGEST_CHUNK", 600)
    system = sympflow.systems.kepler()
    y0 = np.array([system.y0, 1.05 * system.y0]) if batch else system.y0
    whole, told = solve(system, "log_leapfrog", (0, 20), y0, **options), Told()
    solve(system, "log_leapfrog", (0, 20), y0, progress=told, **options)
    done = [part for part, _ in told]
    assert len(done) > 3
    assert done == sorted(done)
    assert told[-1] == (20.0, 20.0)
    with pytest.raises(Interrupted) as caught:
        solve(system, "log_leapfrog", (0, 20), y0, progress=Told(10.0), **options)
    sol = caught.value.solution
    n, until = len(sol.t), sol.stats["interrupted_at"]
    assert 10 <= until < 20
    assert n > 1
    known = sol.t <= until
    np.testing.assert_array_equal(sol.t[known], whole.t[:n][known])
    np.testing.assert_array_equal(sol.y[..., known], whole.y[..., :n][..., known])


def test_a_run_that_fails_in_a_window_ends_as_in_one_piece(short_windows):
    y0 = np.array([BATCH[0], [0.0, 1.5, 1.0, 1.0], BATCH[1]])
    for start in (y0, y0[1]):
        whole = solve(SYSTEM, "verlet", SPAN, start, dt=DT)
        cut = solve(SYSTEM, "verlet", SPAN, start, dt=DT, progress=Told())
        np.testing.assert_array_equal(cut.y, whole.y)
        np.testing.assert_array_equal(cut.status, whole.status)
        np.testing.assert_array_equal(cut.stats["failed_at"], whole.stats["failed_at"])
        assert cut.message == whole.message
