"""Stores: whole chunks or none, one commit, and what xarray and zarr read of them."""

import errno
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from sympflow.storage import store as module
from sympflow.storage.store import Appender, Field, Store, StoreError, difference

FIELDS = {
    "time": Field(("time",), (0,), float, (4,)),
    "q": Field(("dof", "time"), (2, 0), float, (2, 4), {"long_name": "positions"}),
    "dof": Field(("dof",), (2,), int),
}


def made(path):
    store = Store.create(path, FIELDS, {"version": "1", "nested": {"a": [1, 2.5, None]}})
    store.write("dof", (0,), np.array([1, 2]))
    return store


def records(start, n):
    t = np.arange(start, start + n, dtype=float)
    return {"time": t, "q": np.stack([t, -t])}


def test_what_is_appended_is_read_here_and_by_xarray_and_by_zarr(tmp_path):
    xarray, zarr = pytest.importorskip("xarray"), pytest.importorskip("zarr")
    path = tmp_path / "run.zarr"
    appender = Appender(made(path), "time")
    for start, n in ((0, 3), (3, 6), (9, 1)):
        appender.append(records(start, n))
        appender.commit({"reached": start + n}, {"y": np.full(3, start)})
    again = Store.open(path)
    np.testing.assert_array_equal(again.read("q"), records(0, 10)["q"])
    assert again.attributes["reached"] == 10
    np.testing.assert_array_equal(again.state()["y"], np.full(3, 9))
    with xarray.open_zarr(path) as data:
        np.testing.assert_array_equal(data.q.sel(dof=2), -np.arange(10.0))
        assert data.q.dims == ("dof", "time")
        assert data.dof.dtype.kind == "i"
        assert data.attrs["nested"] == {"a": [1, 2.5, None]}
        assert data.q.long_name == "positions"
    for consolidated in (True, False):
        group = zarr.open_group(path, mode="r", use_consolidated=consolidated)
        np.testing.assert_array_equal(group["time"][:], np.arange(10.0))


def test_an_appender_goes_on_in_the_last_chunk(tmp_path):
    path = tmp_path / "run.zarr"
    appender = Appender(made(path), "time")
    appender.append(records(0, 6))
    appender.commit()
    appender.append({"time": np.full(5, np.nan), "q": np.full((2, 5), np.nan)})  # never committed, as by a killed run
    Appender(Store.open(path), "time").commit()
    appender = Appender(Store.open(path), "time")
    appender.append(records(6, 5))
    appender.commit()
    np.testing.assert_array_equal(Store.open(path).read("time"), np.arange(11.0))


def test_a_full_disk_loses_nothing(tmp_path, monkeypatch):
    path = tmp_path / "run.zarr"
    appender = Appender(made(path), "time")
    appender.append(records(0, 6))
    appender.commit({"reached": 6})

    def full(*arguments):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(module.os, "fsync", full)
    with pytest.raises(StoreError, match=r"`store` '.*run.zarr' cannot be written \(No space left.*resume"):
        appender.append(records(6, 2))
        appender.commit({"reached": 8})
    monkeypatch.undo()
    again = Store.open(path)
    assert again.attributes["reached"] == 6
    np.testing.assert_array_equal(again.read("time"), np.arange(6.0))
    assert not list(path.rglob(".new-*"))


def test_what_differs_is_told_where_it_does():
    other = difference({"a": "x" * 300 + "1", "old": "kept"}, {"new": "of a later version", "a": "x" * 300 + "2"})
    assert other == f"its `a` is ...{'x' * 45}1, not ...{'x' * 45}2"
    assert difference({"a": "1"}, {"a": "1"}) == ""


def test_places_that_are_no_store(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"`store` .* does not exist"):
        Store.open(tmp_path / "none.zarr")
    for contents in ("", "{}", '{"metadata": []}'):
        Path(tmp_path / ".zmetadata").write_text(contents)
        with pytest.raises(ValueError, match=r"`store` .* is not a store of sympflow"):
            Store.open(tmp_path)
    with pytest.raises(ValueError, match="is not a store"):
        Store.open(tmp_path / ".zmetadata")
    with pytest.raises(FileExistsError, match=r"`store` .* exists"):
        Store.create(tmp_path, FIELDS, {})
    with pytest.raises(StoreError, match=r"`store` .* cannot be written"):
        Store.create("/dev/null/run.zarr", FIELDS, {})


def test_one_writer_at_a_time(tmp_path):
    store = made(tmp_path / "run.zarr")
    refused = pytest.raises(StoreError, match="is being written by another process")
    with store.locked(), refused, Store.open(store.path).locked():
        pass
    with store.locked():
        pass


def test_damage_is_told(tmp_path):
    store = made(tmp_path / "run.zarr")
    chunk = tmp_path / "run.zarr" / "dof" / "0"
    data = bytearray(chunk.read_bytes())
    data[9] ^= 1
    chunk.write_bytes(bytes(data))
    with pytest.raises(StoreError, match="is damaged: 0 of 'dof'"):
        store.read("dof")
    chunk.write_bytes(b"")
    with pytest.raises(StoreError, match="is damaged"):
        store.read("dof")
    chunk.unlink()
    with pytest.raises(StoreError, match="is damaged: 0 of 'dof' is missing"):
        store.committed("dof", (0,))
    store.commit(state={"place": np.ones(3)})
    (state,) = (tmp_path / "run.zarr").glob(".state-*")
    state.write_bytes(state.read_bytes()[:40])
    with pytest.raises(StoreError, match="is damaged: its state"):
        store.state()


def test_of_two_that_make_a_store_at_once_one_does(tmp_path, monkeypatch):
    rename = module.os.rename

    def late(made_by_us, place):
        shutil.copytree(made_by_us, place)
        rename(made_by_us, place)

    monkeypatch.setattr(module.os, "rename", late)
    with pytest.raises(FileExistsError, match=r"`store` '.*run.zarr' exists"):
        made(tmp_path / "run.zarr")
    assert [path.name for path in tmp_path.iterdir()] == ["run.zarr"]
    assert set(Store.open(tmp_path / "run.zarr").fields) == set(FIELDS)
