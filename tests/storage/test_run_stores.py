"""Runs in stores: the bits of a run in memory, after kills, interruptions and to later ends too; what is refused."""

import errno
import os
import pickle
import signal
import subprocess
import sys

import numpy as np
import pytest

from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators import grid_runs, progress
from sympflow.integrators.contract import Interrupted
from sympflow.solver import solve
from sympflow.storage import store as storage
from sympflow.storage.runs import RunStore
from sympflow.storage.store import Store, StoreError
from sympflow.systems import henon_heiles

SYSTEM = henon_heiles()
DRIVEN = HamiltonianSystem.from_sympy(
    "p**2/2 - cos(q)*(1 + a*cos(w*t))", time="t", params={"a": 0.3, "w": 1.7}, y0=[1.0, 0.3], dt=0.05
)
BATCH = SYSTEM.y0 + 0.02 * np.random.default_rng(0).standard_normal((3, 4))
END, LATER = 20.02, 31.7
TIMES = np.array([0.0, 0.05, 3.3, 3.31, 12.345, 12.345, 19.9, 20.01])
CASES = {
    "one": (SYSTEM, "verlet", {}),
    "thinned": (SYSTEM, "verlet", {"save_every": 7}),
    "on the grid": (SYSTEM, "verlet", {"dt": END / 200}),
    "batch at times": (SYSTEM, "verlet", {"y0": BATCH, "t_eval": TIMES}),
    "compensated": (SYSTEM, "kahan_li8", {"compensated": True, "t_eval": TIMES}),
    "arrays": (SYSTEM, "verlet", {"backend": "array", "save_every": 3}),
    "float32": (SYSTEM, "verlet", {"y0": BATCH, "dtype": "float32"}),
    "driven": (DRIVEN, "verlet", {"backend": "array"}),
    "copies": (SYSTEM, "tao4", {"backend": "array", "save_every": 5}),
    "implicit": (DRIVEN, "gauss_legendre4", {"backend": "array", "save_every": 5}),
    "lost": (SYSTEM, "verlet", {"y0": np.array([BATCH[0], [0.0, 1.5, 1.0, 1.0]])}),
}


@pytest.fixture(autouse=True)
def short_windows(monkeypatch):
    monkeypatch.setattr(grid_runs, "ONE", 100)
    monkeypatch.setattr(grid_runs, "ARRAY_STEPS", 30)
    monkeypatch.setattr(grid_runs.Pace, "took", lambda self, n: None)
    monkeypatch.setattr(progress, "BETWEEN", 0.0)


def ctrl_c_at(t):
    def told(done, total):
        if t <= done < total:
            raise KeyboardInterrupt

    return told


def assert_same(sol, whole):
    np.testing.assert_array_equal(sol.t, whole.t)
    np.testing.assert_array_equal(sol.y, whole.y)
    np.testing.assert_array_equal(sol.status, whole.status)
    assert sol.message == whole.message
    np.testing.assert_equal(dict(sol.stats, wall_time=0), dict(whole.stats, wall_time=0))


@pytest.mark.parametrize("case", CASES)
def test_a_stored_run_is_the_run(tmp_path, case):
    """In one go, after interruptions, and asked for once more when it has ended."""
    system, method, options = CASES[case]
    whole = solve(system, method, (0, END), **options)
    assert_same(solve(system, method, (0, END), store=tmp_path / "a", **options), whole)
    for t in (3, 11, 17):
        with pytest.raises(Interrupted) as caught:
            solve(system, method, (0, END), store=tmp_path / "b", resume=True, progress=ctrl_c_at(t), **options)
        part = caught.value.solution
        assert np.all(np.asarray(part.status) == -1)
        np.testing.assert_array_equal(part.y, whole.y[..., : len(part.t)])
    assert_same(solve(system, method, (0, END), store=tmp_path / "b", resume=True, **options), whole)
    assert_same(solve(system, method, (0, END), store=tmp_path / "b", resume=True, **options), whole)


@pytest.mark.parametrize("where", ["distinct", "finite_states", "append", "pieces"])
@pytest.mark.parametrize("case", ["batch at times", "thinned"])
def test_ctrl_c_between_the_steps_and_their_outputs(tmp_path, monkeypatch, case, where):
    """The steps of a window are made and its outputs not stored, or stored and not yet noted."""
    system, method, options = CASES[case]
    whole = solve(system, method, (0, END), **options)
    methods = {"append": (RunStore, "append"), "pieces": (grid_runs.GridRun, "advance")}
    owner, name = methods.get(where, (grid_runs, where))
    done, calls = getattr(owner, name), []

    def struck(*given):
        answer = done(*given)
        calls.append(name)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return answer

    monkeypatch.setattr(owner, name, struck)
    for _ in range(2):
        calls.clear()
        try:
            solve(system, method, (0, END), store=tmp_path / "a", resume=True, checkpoint_every=1e-9, **options)
        except Interrupted as stop:
            np.testing.assert_array_equal(stop.solution.y, whole.y[..., : len(stop.solution.t)])
    calls.extend([name] * 4)
    assert_same(solve(system, method, (0, END), store=tmp_path / "a", resume=True, **options), whole)


@pytest.mark.parametrize("case", CASES)
def test_a_run_that_goes_on_to_a_later_end_is_the_longer_run(tmp_path, case):
    """The last output of the shorter run, which may be none of the longer one, is left out."""
    system, method, options = CASES[case]
    solve(system, method, (0, END), store=tmp_path / "a", **options)
    if "t_eval" in options:
        options = options | {"t_eval": np.append(TIMES, [20.015, 20.02, LATER])}
    whole = solve(system, method, (0, LATER), **options)
    longer = solve(system, method, (0, LATER), store=tmp_path / "a", resume=True, **options)
    np.testing.assert_array_equal(longer.t, whole.t)
    np.testing.assert_array_equal(longer.y, whole.y)
    assert longer.stats["n_steps"] == whole.stats["n_steps"]
    assert Store.open(tmp_path / "a").attributes["t_span"] == [0.0, LATER]


KILLED = """
import os, signal, sys
from sympflow.integrators import grid_runs, progress
from sympflow.solver import solve
from sympflow.systems import henon_heiles

grid_runs.ONE, progress.BETWEEN, grid_runs.Pace.took = 100, 0.0, lambda self, n: None

def kill(done, total):
    if done >= 12:
        os.kill(os.getpid(), signal.SIGKILL)

solve(henon_heiles(), "verlet", (0, 20.02), store=sys.argv[1], resume=True, checkpoint_every=1e-9, progress=kill)
"""


def test_a_killed_run_goes_on_with_the_same_bits(tmp_path):
    path = tmp_path / "run.zarr"
    ended = subprocess.run([sys.executable, "-c", KILLED, path], capture_output=True, check=False)
    assert ended.returncode == -signal.SIGKILL, ended.stderr.decode()
    kept = Store.open(path)
    assert 100 < kept.fields["time"].shape[0] < 300
    assert kept.attributes["message"].startswith("The run had reached t = ")
    assert_same(solve(SYSTEM, "verlet", (0, END), store=path, resume=True), solve(SYSTEM, "verlet", (0, END)))


@pytest.mark.parametrize("n_writes", [0, 1, 5, 9, 14, 23])
def test_what_was_committed_before_the_disk_was_full_is_kept(tmp_path, monkeypatch, n_writes):
    path, write, left = tmp_path / "run.zarr", storage.put_file, [n_writes]

    def full(*arguments, **options):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(*arguments, **options)

    whole = solve(SYSTEM, "verlet", (0, END))
    monkeypatch.setattr(storage, "put_file", full)
    with pytest.raises(StoreError, match=r"cannot be written .No space left on device.: what was committed is kept"):
        solve(SYSTEM, "verlet", (0, END), store=path, checkpoint_every=1e-9)
    monkeypatch.setattr(storage, "put_file", write)
    if path.exists():
        n = Store.open(path).fields["time"].shape[0]
        np.testing.assert_array_equal(Store.open(path).read("q")[..., :n], whole.q[:, :n])
    assert_same(solve(SYSTEM, "verlet", (0, END), store=path, resume=True), whole)


def test_the_outputs_are_read_from_the_store_and_by_xarray(tmp_path):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("zarr")
    path = tmp_path / "run.zarr"
    sol = solve(SYSTEM, "verlet", (0, END), BATCH, store=path)
    assert sol.y is not sol.y
    assert len(pickle.dumps(sol)) < 100_000
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(sol)).y, sol.y)
    with xarray.open_zarr(path) as data, sol.to_xarray() as own:
        assert data.q.dims == ("orbit", "dof", "time")
        assert data.attrs["method"] == "verlet"
        assert data.attrs["message"] == sol.message
        for name in ("q", "p", "q0", "p0", "status"):
            np.testing.assert_array_equal(data[name], own[name])
            assert data[name].dims == own[name].dims
        np.testing.assert_array_equal(data.time, own.time)


REFUSED = [
    ({"store": 3}, TypeError, "`store` must be the path of a folder; got int"),
    ({"resume": "yes"}, TypeError, "`resume` must be True or False; got 'yes'"),
    ({"checkpoint_every": 0}, ValueError, "`checkpoint_every` must be a positive number of seconds; got 0"),
    ({"checkpoint_every": "often"}, ValueError, "`checkpoint_every` must be a positive number of seconds"),
    ({"store": None, "resume": True}, ValueError, "`resume` and `checkpoint_every` are for runs with a `store`"),
    ({"events": lambda t, y: y[0]}, ValueError, "`store` does not go with `events`"),
    ({"dense_output": True}, ValueError, "`store` does not go with `dense_output`"),
    ({"on_domain_exit": "stop"}, ValueError, "`store` takes no `on_domain_exit` 'stop'"),
    ({"method": "rk45"}, ValueError, "`store` keeps runs on a grid of equal steps in t, and method 'rk45' chooses"),
    ({"method": "log_kahan_li8"}, ValueError, "those of method 'log_kahan_li8' are equal in another time"),
]
OTHER = [
    ({"resume": False}, "exists: pass resume=True to go on with it"),
    ({"dt": 0.01}, "is of another run: its `method` is verlet, dt=None"),
    ({"method": "kahan_li8"}, "is of another run: its `method` is verlet"),
    ({"y0": BATCH}, "is of another run: its `y0` is float64 of shape"),
    ({"save_every": 2}, "is of another run: its `outputs` is every 1-th step, not every 2-th"),
    ({"t_eval": TIMES}, "is of another run: its `outputs` is every 1-th step, not t_eval"),
    ({"t_span": (0, -END)}, "is of another run: its `dt` is 0.05, not 0.05, backwards"),
    ({"t_span": (1, END)}, "is of another run: its `t0` is 0.0, not 1.0"),
    ({"t_span": (0, 10)}, "`t_span` ends at t = 10, and `store` .* has reached t = 20: give an end at that or later"),
    ({"backend": "array"}, "is of another run: its `backend` is auto, not array"),
]


@pytest.mark.parametrize(("options", "error", "message"), REFUSED, ids=[row[2][:40] for row in REFUSED])
def test_what_no_store_takes_is_refused_before_anything_is_written(tmp_path, options, error, message):
    path = tmp_path / "run.zarr"
    arguments = {"method": "verlet", "t_span": (0, END), "store": path, **options}
    with pytest.raises(error, match=message):
        solve(SYSTEM, **arguments)
    assert not any(tmp_path.iterdir())


def test_a_store_of_another_run_is_left_as_it_is(tmp_path):
    path = tmp_path / "run.zarr"
    whole = solve(SYSTEM, "verlet", (0, END), store=path)
    before = whole.y
    for options, message in OTHER:
        arguments = {"method": "verlet", "t_span": (0, END), "store": path, "resume": True, **options}
        with pytest.raises(ValueError, match=message):
            solve(SYSTEM, **arguments)
    for times in ([0.0, 10.0], [0.0, 5.0, 20.0]):
        other = tmp_path / "times.zarr"
        solve(SYSTEM, "verlet", (0, END), store=other, resume=True, t_eval=[0.0, 10.0, 20.0][: len(times) + 1])
        with pytest.raises(ValueError, match="`t_eval` does not begin with the 3 times that `store`"):
            solve(SYSTEM, "verlet", (0, END), store=other, resume=True, t_eval=times)
    torch = pytest.importorskip("torch")
    with pytest.raises(TypeError, match="`y0` is a tensor, but a `store`"):
        solve(SYSTEM, "verlet", (0, END), torch.tensor(SYSTEM.y0), store=path, resume=True)
    with Store.open(path).locked(), pytest.raises(StoreError, match="is being written by another process"):
        solve(SYSTEM, "verlet", (0, END), store=path, resume=True)
    (tmp_path / "notes").write_text("of mine")
    with pytest.raises(ValueError, match="is not a store of sympflow: give another place"):
        solve(SYSTEM, "verlet", (0, END), store=tmp_path / "notes", resume=True)
    np.testing.assert_array_equal(solve(SYSTEM, "verlet", (0, END), store=path, resume=True).y, before)
