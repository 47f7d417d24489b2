"""Stores from strangers: nothing outside is written, read or deleted, no more memory is taken than a run needs."""

import io
import json
import os
import re
import resource
import shutil
import zipfile
import zlib

import numpy as np
import pytest

import sympflow
from sympflow.storage.store import METADATA, StoreError, read_arrays

SYSTEM = sympflow.systems.henon_heiles()
STATES = SYSTEM.y0 + np.zeros((3, 1))


def run(path, **how):
    return sympflow.solve(SYSTEM, "verlet", (0, 5), dt=0.1, store=path, **how)


def ensemble(path, **how):
    return sympflow.ensemble(SYSTEM, "verlet", (0, 1), STATES, dt=0.1, store=path, reduce="final", **how)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    run(folder / "run")
    ensemble(folder / "ensemble")
    return folder


def described(change):
    """A change of the metadata."""

    def spoil(path):
        content = json.loads((path / METADATA).read_text())
        change(content["metadata"])
        (path / METADATA).write_text(json.dumps(content))

    return spoil


def renamed(name):
    def change(found):
        for part in (".zarray", ".zattrs"):
            found[f"{name}/{part}"] = found[f"q/{part}"]

    return described(change)


def told(**changes):
    return described(lambda found: found[".zattrs"].update(changes))


def array(name, **changes):
    return described(lambda found: found[f"{name}/.zarray"].update(changes))


def chunk(name, content):
    def spoil(path):
        (file,) = (path / name).glob("0*")
        file.write_bytes(content)

    return spoil


def linked(name):
    def spoil(path):
        shutil.rmtree(path / name)
        (path / name).symlink_to(path.parent / "victim")

    return spoil


def state(change, packed=False):
    """Another state to go on from."""

    def spoil(path):
        (file,) = path.glob(".state-*.npz")
        arrays = read_arrays(file, 2**20)
        change(arrays)
        (np.savez_compressed if packed else np.savez)(file, **arrays)

    return spoil


def of_objects(arrays):
    arrays["running"] = np.array([print], dtype=object)


def longer(path):
    """An array that tells of more numbers than it has."""
    (file,) = path.glob(".state-*.npz")
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"shape": (10**11,), "fortran_order": False, "descr": "<f8"})
    members["running.npy"] = header.getvalue() + bytes(80)
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def endless(path):
    """A state of more bytes than such a run keeps."""
    (file,) = path.glob(".state-*.npz")
    os.truncate(file, 2**27)


BOMB = zlib.compress(bytes(3 * 10**8), 9)
STRANGE = {
    "path up": (renamed("../victim"), "../victim"),
    "absolute path": (renamed("/victim"), "/victim"),
    "Windows' path": (renamed("..\\victim"), "victim"),
    "NUL": (renamed("q\0"), "q"),
    "hidden": (renamed(".lock"), ".lock"),
    "empty name": (renamed(""), "not a store of sympflow"),
    "another's state": (told(sympflow_state="../other/.state-1.npz"), "../other"),
    "state that is no text": (told(sympflow_state=3), "not a store of sympflow"),
    "one array too many": (renamed("mine"), "its array 'mine' is not one that the call makes"),
    "huge shape": (array("q", shape=[2, 10**15]), "its array 'q' is not one that the call makes"),
    "huge chunk": (array("q", chunks=[2, 10**12]), "its array 'q' is not one that the call makes"),
    "negative shape": (array("q", shape=[2, -1]), "not a store of sympflow"),
    "objects": (array("q", dtype="|O"), "not a store of sympflow"),
    "another order": (array("q", order="F"), "not a store of sympflow"),
    "filter": (array("q", filters=[{"id": "pickle"}]), "not a store of sympflow"),
    "no metadata": (lambda path: (path / METADATA).unlink(), r"has no .zmetadata, .*consolidate_metadata"),
    "bomb": (chunk("q", BOMB), r"damaged: .* of 'q'"),
    "no zlib": (chunk("q", b"text"), r"damaged: .* of 'q'"),
    "lost p0": (lambda path: shutil.rmtree(path / "p0"), "'p0' is missing"),
    "lost q": (lambda path: shutil.rmtree(path / "q"), "'q' is missing"),
    "link": (linked("q"), "'q' is a link to elsewhere"),
    "nested": (lambda path: (path / METADATA).write_text("[" * 10**5), "not a store of sympflow"),
}
OF_RUNS = {
    "lost chunk of p0": (lambda path: (path / "p0" / "0").unlink(), "0 of 'p0' is missing"),
    "lost chunk of q": (lambda path: (path / "q" / "0.0").unlink(), r"0\.0 of 'q' is missing"),
    "lost status": (lambda path: (path / "status" / "0").unlink(), "0 of 'status' is missing"),
    "lost state": (lambda path: next(path.glob(".state*")).unlink(), "its state cannot be read"),
    "endless state": (endless, r"its state cannot be read \(more than"),
    "packed state": (state(lambda arrays: None, packed=True), "its state cannot be read .*is packed"),
    "pickles": (state(of_objects), "its state cannot be read"),
    "state longer than its file": (longer, "its state cannot be read .*has another length"),
    "state of another size": (state(lambda a: a.update(state=np.zeros((7, 4)))), "its state is not that of a run"),
    "running state cut": (state(lambda a: a.update(running=a["running"][:1], steps=3)), "is damaged"),
    "no finite": (state(lambda arrays: arrays.pop("finite")), "its state is not that of a run"),
    "no counts": (state(lambda arrays: arrays.update(counts=np.array("[]"))), "its state is not that of a run"),
    "no message": (described(lambda found: found[".zattrs"].pop("message")), "its message is missing"),
    "more outputs": (
        described(lambda f: [f[f"{n}/.zarray"]["shape"].__setitem__(-1, 10**12) for n in ("q", "p", "time")]),
        "of .time. is missing|it tells of 1,000,000,000,000 outputs",
    ),
}
OF_ENSEMBLES = {
    "shape of chunks": (told(chunk_shape=[10**12]), "its chunk_shape .* does not fit"),
    "no shape of chunks": (told(chunk_shape="all"), "its chunk_shape is missing"),
    "messages linked": (linked("messages"), "'messages' is a link to elsewhere"),
}
CASES = [
    (call, spoil, said)
    for calls, cases in (((run, ensemble), STRANGE), ((run,), OF_RUNS), ((ensemble,), OF_ENSEMBLES))
    for spoil, said in cases.values()
    for call in calls
]
NAMES = [
    f"{name} of {call}"
    for calls, cases in ((("a run", "an ensemble"), STRANGE), (("a run",), OF_RUNS), (("an ensemble",), OF_ENSEMBLES))
    for name in cases
    for call in calls
]


def tree(folder):
    return {f: f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file() and f.name != ".lock"}


@pytest.mark.parametrize(("call", "spoil", "said"), CASES, ids=NAMES)
def test_a_strange_store_is_refused_in_words_and_nothing_else_is_touched(made, tmp_path, call, spoil, said):
    shutil.copytree(made / call.__name__, tmp_path / "store")
    for other in ("victim", "other"):
        (tmp_path / other).mkdir()
        (tmp_path / other / ".state-1.npz").write_bytes(b"mine")
    spoil(tmp_path / "store")
    before = tree(tmp_path)
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises((ValueError, StoreError), match=r"`store` .*") as caught:
        kept = call(tmp_path / "store", resume=True)
        kept.y if call is run else kept.final  # noqa: B018
    words = f"{caught.value} {caught.value.__cause__}"
    assert re.search(said, words), words
    assert tree(tmp_path) == before
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - most < 200_000  # kB


def test_a_lock_that_is_a_link_is_not_followed(made, tmp_path):
    shutil.copytree(made / "run", tmp_path / "store")
    (tmp_path / "store" / ".lock").unlink(missing_ok=True)
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "store" / ".lock").symlink_to(tmp_path / "mine")
    with pytest.raises(StoreError, match="cannot be written"):
        run(tmp_path / "store", resume=True)
    assert (tmp_path / "mine").read_text() == "mine"


def test_what_is_lost_after_a_run_is_said_when_it_is_read(tmp_path):
    result = ensemble(tmp_path / "a")
    (tmp_path / "a" / "p" / "0.0").unlink()
    with pytest.raises(StoreError, match="a chunk of 'p' is missing, and is run again by the same call"):
        result.final  # noqa: B018
    assert np.isfinite(ensemble(tmp_path / "a", resume=True).final).all()
    (tmp_path / "a" / "p0" / "0.0").unlink()
    ensemble(tmp_path / "a", resume=True)
    assert (tmp_path / "a" / "p0" / "0.0").exists()
