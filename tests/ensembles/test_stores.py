"""Stores of ensembles: what is read is what is returned, runs go on where they ended, nothing is lost."""

import errno
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

import sympflow
from sympflow.ensembles import results
from sympflow.storage import store as storage

SYSTEM = sympflow.systems.henon_heiles()
STATES = SYSTEM.domain.sample(300, 1)
STATES[5] = 60.0  # which fails
TIMES = [0.0, 0.5, 1.0]


def run(**how):
    given = {"dt": 0.1, "t_eval": TIMES, "chunk": 64} | how
    return sympflow.ensemble(SYSTEM, "verlet", (0, 1), STATES, **given)


@pytest.mark.parametrize("reduce", [None, "final"])
def test_a_store_holds_the_result(tmp_path, reduce):
    xr = pytest.importorskip("xarray")
    expected, result = run(reduce=reduce), run(reduce=reduce, store=tmp_path / "a.zarr", workers=2)
    (name,) = result.fields
    assert np.array_equal(result.fields[name], expected.fields[name], equal_nan=True)
    assert np.array_equal(result.status, expected.status)
    assert result.messages == expected.messages
    assert result.message == expected.message
    with xr.open_zarr(tmp_path / "a.zarr") as data:
        assert data.equals(expected.to_xarray())
        assert data.q.dims == ("orbit", "dof", "time")[: data.q.ndim]
        assert np.array_equal(np.concatenate([data.q0, data.p0], axis=1), STATES)
        assert data.attrs["method"] == "verlet"


def test_a_run_goes_on_where_it_ended(tmp_path, monkeypatch):
    path, written = tmp_path / "a.zarr", storage.put_file
    left = 2

    def full(place, data, durable=True):
        nonlocal left
        left -= place.parent.name == "status" and place.name.isdigit()
        if left < 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        written(place, data, durable)

    monkeypatch.setattr(storage, "put_file", full)
    with pytest.raises(OSError, match=r"`store` .* cannot be written \(No space left on device\)"):
        run(store=path)
    monkeypatch.setattr(storage, "put_file", written)
    done = {file.name: file.stat().st_mtime_ns for file in (path / "status").iterdir() if file.name[0] != "."}
    assert len(done) == 1
    waiting = np.arange(len(STATES)) >= 64
    assert np.array_equal(storage.Store.open(path).read("status") == results.NOT_RUN, waiting)
    with pytest.importorskip("xarray").open_zarr(path) as data:
        assert np.array_equal(np.isnan(data.status), waiting)
    assert np.array_equal(run(store=path, resume=True, chunk=7).y, run().y, equal_nan=True)
    assert all((path / "status" / name).stat().st_mtime_ns == when for name, when in done.items())
    assert len(os.listdir(path / "q")) > len(done)
    os.remove(path / "p" / "1.0.0")  # lost by the disk: the chunk is run again
    assert np.array_equal(run(store=path, resume=True).y, run().y, equal_nan=True)


def test_two_programs_share_a_store(tmp_path):
    path, others = tmp_path / "a.zarr", []

    def other(done, total):
        if not others and done:  # the whole ensemble, while the first is in its midst
            others.append(None)
            others[0] = run(store=path, resume=True, workers=2).y

    result = run(store=path, progress=other)
    for y in (result.y, others[0], run(store=path, resume=True).y):
        assert np.array_equal(y, run().y, equal_nan=True)


def test_a_store_that_is_there_or_of_another_ensemble(tmp_path):
    path = tmp_path / "a.zarr"
    run(store=path)
    with pytest.raises(ValueError, match=r"`store` .* exists: pass resume=True"):
        run(store=path)
    for other, part in ({"dt": 0.2}, "method"), ({"t_eval": [1.0]}, "t_eval"), ({"reduce": "final"}, "reduce"):
        with pytest.raises(ValueError, match=f"is of another ensemble: its `{part}` is"):
            run(store=path, resume=True, **other)
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="is not a store of sympflow"):
        run(store=tmp_path / "b", resume=True)
    with pytest.raises(ValueError, match="`resume` goes on with a `store`"):
        run(resume=True)
    with pytest.raises(TypeError, match="`store` must be the path of a folder"):
        run(store=3)


def scaled(factor):
    return lambda t, y: factor * y[0].max()


def test_a_store_is_of_one_step_and_one_function(tmp_path):
    def stored(name, dt=0.1, factor=1.0, resume=False):
        system = sympflow.systems.henon_heiles().with_scene(dt=dt)
        how = {"t_eval": TIMES, "reduce": scaled(factor), "store": tmp_path / name, "resume": resume}
        return sympflow.ensemble(system, "verlet", (0, 1), STATES[:3], **how)

    expected = stored("expected.zarr")
    stored("a.zarr")
    for other, part in ({"dt": 0.2}, "dt"), ({"factor": 2.0}, "reduce"):
        with pytest.raises(ValueError, match=f"is of another ensemble: its `{part}` is"):
            stored("a.zarr", resume=True, **other)
    for file in (tmp_path / "a.zarr").glob("*/0"):
        file.unlink()  # as if it had been killed when it had just been made
    (tmp_path / "a.zarr" / "messages").rmdir()
    again = stored("a.zarr", resume=True)
    (name,) = again.fields
    assert np.array_equal(again.fields[name], expected.fields[name])
    assert (tmp_path / "a.zarr" / "dof" / "0").exists()


KILLED = """
import os, signal, sys
import numpy as np
import sympflow

system = sympflow.systems.henon_heiles()
states = np.load(sys.argv[1])

def stop(done, total):
    if done >= 130:
        os.kill(os.getpid(), signal.SIGKILL)

sympflow.ensemble(system, "verlet", (0, 1), states, dt=0.1, t_eval=[0.0, 0.5, 1.0], chunk=64,
                  store=sys.argv[2], progress=stop)
"""


@pytest.mark.slow
def test_a_killed_program_goes_on(tmp_path):
    np.save(tmp_path / "states.npy", STATES)
    words = [sys.executable, "-c", KILLED, str(tmp_path / "states.npy"), str(tmp_path / "a.zarr")]
    assert subprocess.run(words, check=False, capture_output=True).returncode == -signal.SIGKILL
    told = []
    result = run(store=tmp_path / "a.zarr", resume=True, progress=lambda done, total: told.append(done))
    assert told[0] >= 128
    assert np.array_equal(result.y, run().y, equal_nan=True)
