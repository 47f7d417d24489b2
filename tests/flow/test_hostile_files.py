"""Files of weights that are no such files, or claim what is not so: refused at once, in words, without being read."""

import json
import os
import pickle
import struct

import pytest
from watchdog import watched

from sympflow import SympFlow, Tube, load
from sympflow.flow.records import text_checksum


def with_header(header, rest=b""):
    """The bytes of a safetensors file of that header."""
    header = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(header)) + header + rest


def parts(content):
    """The header and the tensors of a sound file."""
    (n,) = struct.unpack("<Q", content[:8])
    return json.loads(content[8 : 8 + n]), content[8 + n :]


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    path = tmp_path_factory.mktemp("flows") / "sound.safetensors"
    SympFlow(1).save(path)
    return path.read_bytes()


def edited(content, **entries):
    """The file with other entries of one tensor's header."""
    header, rest = parts(content)
    name = next(key for key in header if key != "__metadata__")
    header[name].update(entries)
    return with_header(header, rest)


def described(content, **record):
    """The file with another record."""
    header, rest = parts(content)
    text = json.dumps({**json.loads(header["__metadata__"]["sympflow"]), **record})
    header["__metadata__"] = {"sympflow": text, "sympflow_checksum": text_checksum(text)}
    return with_header(header, rest)


def recorded(text):
    return with_header({"__metadata__": {"sympflow": text}})


def tube(**fields):
    return {"kind": "Tube", "orbit": [[0.0, 0.0], [1.0, 1.0]], "radius": 1.0, **fields}


def of_planets(period):
    shape = {"reach": 1, "gradients": 0, "periods": [period]}
    return lambda f: described(f, architecture={"ndof": 6, "kepler": shape})


INADMISSIBLE = "its domain is not admissible"
BOX = {"kind": "Box", "low": [0.0, 0.0], "high": [1.0, 1.0]}

# what a sound file is made into, and the reason for which it is refused
FILES = {
    "empty": (lambda f: b"", "it is truncated"),
    "cut in its first number": (lambda f: f[:5], "it is truncated"),
    "cut in its header": (lambda f: f[:100], "it is truncated"),
    "cut in its weights": (lambda f: f[:-5], "it is truncated or damaged: it has"),
    "longer than its weights": (lambda f: f + b"\0" * 100, "it is truncated or damaged: it has"),
    "a header of 1e18 bytes": (lambda f: struct.pack("<Q", 10**18) + f[8:], "its header is oversized"),
    "a header of 2**64 - 1 bytes": (lambda f: b"\xff" * 8 + f[8:], "its header is oversized"),
    "a header of 1 MB of JSON": (lambda f: with_header(b'{"a": "%s"}' % (b"x" * 2**20)), "its header is oversized"),
    "a pickle": (lambda f: pickle.dumps({"weights": [1.0]}), "it is not a safetensors file"),
    "a zip": (lambda f: b"PK\x03\x04" + f, "it is not a safetensors file"),
    "deeply nested lists": (lambda f: with_header(b"[" * 900_000), "its header is not valid JSON"),
    "deeply nested objects": (lambda f: with_header(b'{"a":' * 150_000), "its header is not valid JSON"),
    "a deeply nested record": (lambda f: recorded("[" * 900_000), "its record is not valid JSON"),
    "a number of 5000 digits": (lambda f: with_header(b'{"a": %s}' % (b"9" * 5000)), "its header is not valid JSON"),
    "not in UTF-8": (lambda f: with_header(b"\xff\xfe{}"), "its header is not valid JSON"),
    "NaN in its record": (lambda f: recorded('{"dt": NaN}'), "its record is not valid JSON"),
    "a record that is a list": (lambda f: recorded("[]"), "its record is not a JSON object"),
    "no record": (lambda f: with_header({}), "it holds no record"),
    "a tensor of 1e18 bytes": (lambda f: edited(f, data_offsets=[0, 10**18]), "it is truncated or damaged"),
    "a tensor before the file": (lambda f: edited(f, data_offsets=[-8, 0]), "it is truncated or damaged"),
    "a tensor without place": (lambda f: edited(f, data_offsets=None), "its header has a tensor without offsets"),
    "a tensor of 2**64 numbers": (lambda f: edited(f, shape=[2**62, 4]), "has shape"),
    "a shape that is a word": (lambda f: edited(f, shape="ab"), "has shape"),
    "weights of 8 bits": (lambda f: edited(f, dtype="F8_E4M3"), "its tensors must all be F32 or all F64"),
    "an architecture of 1e12 degrees of freedom": (
        lambda f: described(f, architecture={"type": "mlp", "ndof": 10**12, "layers": []}),
        "ndof 1000000000000",
    ),
    "a planet of an endless period": (of_planets(10**400), "its periods are not those of its planets"),
    "a planet without a period": (of_planets(0.0), "its periods are not those of its planets"),
    "a tube of another width": (
        lambda f: described(f, domain=tube(orbit=[[0.0] * 4] * 2)),
        "states of length 4, not 2",
    ),
    "a ragged tube": (lambda f: described(f, domain=tube(orbit=[[0.0, 0.0], [1.0]])), INADMISSIBLE),
    "a tube of deep lists": (lambda f: described(f, domain=tube(orbit=[[[0.0, 0.0]]])), INADMISSIBLE),
    "a tube of words": (lambda f: described(f, domain=tube(orbit="ab")), INADMISSIBLE),
    "a tube of half indices": (lambda f: described(f, domain=tube(groups=[[0.5], [1]])), INADMISSIBLE),
    "a tube without radius": (lambda f: described(f, domain=tube(radius=0.0)), INADMISSIBLE),
    "a shell that is none": (
        lambda f: described(f, domain={"kind": "EnergySublevel", "energy": 1.0, "box": BOX, "above": 2.0}),
        INADMISSIBLE,
    ),
    "a shell in one dimension": (
        lambda f: described(
            f, domain={"kind": "EnergySublevel", "energy": 1.0, "box": BOX, "angular_momentum": [0, 1]}
        ),
        INADMISSIBLE,
    ),
}


@pytest.mark.parametrize("row", FILES)
def test_files(row, sound, tmp_path):
    make, reason = FILES[row]
    path = tmp_path / "hostile.safetensors"
    path.write_bytes(make(sound))
    with watched(), pytest.raises(ValueError, match=r"^`path` .* is not a usable flow") as raised:
        load(path)
    assert reason in str(raised.value)
    assert str(raised.value).endswith("Save it again with flow.save(path).")


def test_the_sound_file_is_read(sound, tmp_path):
    """So that the rows above are refused for their reason alone."""
    path = tmp_path / "sound.safetensors"
    path.write_bytes(sound)
    assert load(path).n_parameters == SympFlow(1).n_parameters
    path.write_bytes(described(sound, domain=tube()))
    assert load(path).domain == Tube([[0.0, 0.0], [1.0, 1.0]], 1.0)


@pytest.mark.parametrize("size", [2**28, 10 * 2**30])
def test_a_huge_file_is_refused_unread(size, sound, tmp_path, monkeypatch):
    """A sparse one, so that it takes no space. No more of it is read than its header claims."""
    path = tmp_path / "sparse.safetensors"
    path.write_bytes(sound)
    os.truncate(path, size)
    with watched(), pytest.raises(ValueError, match=r"more than any flow|truncated or damaged"):
        load(path)


def test_places_that_hold_no_file(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for path in (tmp_path, tmp_path / "pipe", tmp_path / "loop", "/dev/zero", "a\0b", "x" * 5000, ""):
        with watched(), pytest.raises(ValueError, match=r"^`path` .* is not a file"):
            load(path)
    for path in (3, None, b"flow", ["flow"]):
        with pytest.raises(TypeError, match=r"^`path` must be the path of a file"):
            load(path)
