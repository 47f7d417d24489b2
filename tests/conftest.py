"""Fixtures shared by several test modules."""

import gc
import importlib.util
import json
import os
import struct
from pathlib import Path

import pytest

# Where colorama is installed, Numba puts sys.stdout of its first message back after each: that of a command under test
# would be lost whenever something is compiled meanwhile.
os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")

# A compiler makes many objects that live on: looking through all of them for circles takes a sixth of its time.
gc.set_threshold(50_000, 20, 50)


def pytest_collection_finish():
    """Let no search for circles go through what was imported: tests that force one wait for it."""
    gc.collect()
    gc.freeze()


TESTS = Path(__file__).parent
EXAMPLES = TESTS.parent / "examples"
LOW_ORDER = {"adaptive_heun", "bosh3", "fehlberg2"}
"""Methods that choose thousands of steps where `dopri5`, of the same kind, needs ten."""


COLLECTED = pytest.StashKey[set[str]]()
"""Names of all tests and rows that there are, whether they run or not."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Mark as slow LOW_ORDER, and what long.txt lists.

    These are rows of some seconds whose kind a shorter row shows, and without brackets a few tests that take several.
    """
    config.stash[COLLECTED] = {item.nodeid for item in items}
    listed = set((TESTS / "long.txt").read_text("utf-8").splitlines())
    for item in items:
        row = item.callspec.params.values() if hasattr(item, "callspec") else ()
        if item.nodeid in listed or any(isinstance(value, str) and value in LOW_ORDER for value in row):
            item.add_marker(pytest.mark.slow)


KINDS = (
    *("verlet", "leapfrog", "srkn6b", "chin4a"),  # begins with a kick, a drift; for quadratic T; with force gradients
    *("gauss_legendre4", "log_leapfrog"),
    *("impulse", "mollified_impulse", "implicit_explicit", "linear_omelyan4", "strang_parts", "kahan_li6_parts"),
    *("euler", "rk4", "explicit_adams", "implicit_adams"),
    *("rk45", "dop853", "dopri5"),
    *("sympflow", "mlp"),
)
"""A method of each kind: for tests of what methods of one kind share. That each alone is sound, `test_checks` shows."""

FULL_MASS_MATRIX = "p1**2/4 + p1*p2/5 + p2**2 + q1**4/4 + q1*q2/3 + q2**2/2"
RELATIVISTIC = "sqrt(1 + p**2) + q**2/2 + q**4/4"
"""Hamiltonians that several modules compile: the same text is compiled once for all of them."""


def load_example(name):
    """The module examples/<name>.py."""
    spec = importlib.util.spec_from_file_location(f"examples_{name}", EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def rotation():
    """The exact flow of the harmonic oscillator, Δt = 1."""
    return load_example("exact_rotation").rotation()


class Clock:
    """Time that passes with every evaluation of something."""

    def __init__(self, monkeypatch):
        from sympflow.training import session as sessions

        self.now, self.tick = 0.0, 0.0
        self.patch = monkeypatch
        monkeypatch.setattr(sessions, "time", self)

    def perf_counter(self):
        self.now += self.tick
        return self.now

    time = perf_counter

    def costs_seconds(self, owner, name, seconds):
        """Let a method take so long."""
        whole = getattr(owner, name)

        def slow(*arguments, **options):
            self.now += seconds
            return whole(*arguments, **options)

        self.patch.setattr(owner, name, slow)


@pytest.fixture
def clock(monkeypatch):
    """A clock that a test of budgets sets, in place of that of the machine."""
    return Clock(monkeypatch)


def record(path):
    """The record in the file of a flow."""
    content = path.read_bytes()
    (length,) = struct.unpack("<Q", content[:8])
    return json.loads(json.loads(content[8 : 8 + length])["__metadata__"]["sympflow"])


def tampered(
    path, change_record=lambda record: None, change_tensors=lambda tensors: None, *, rechecked=True, altered=False
):
    """The file with another record or other tensors, and with checksums that fit them unless it is said otherwise."""
    from safetensors.torch import load_file, save_file

    from sympflow.flow.records import KEY, SUM, text_checksum
    from sympflow.flow.weights import checksum

    notes, tensors = record(path), load_file(path)
    change_record(notes)
    change_tensors(tensors)
    if "checksum" in notes:
        notes["checksum"] = checksum(tensors) if rechecked else notes["checksum"]
    text, kept = json.dumps(notes), json.dumps(record(path), separators=(",", ":"))
    save_file(tensors, path, {KEY: text, SUM: text_checksum(kept if altered else text)})
    return path


def refusals(*rows, ids=None):
    """A test that each call raises its error: rows of (call, error, pattern of the message), or (call, pattern)."""
    named = [(call, *(error or [ValueError]), message) for call, *error, message in rows]

    @pytest.mark.parametrize(("call", "error", "message"), named, ids=ids)
    def test(call, error, message):
        with pytest.raises(error, match=message):
            call()

    return test
