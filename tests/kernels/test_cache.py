"""The cache of machine code: threads and processes that compile at once, and files that were damaged."""

import os
import subprocess
import sys

import pytest

AT_ONCE = """
import sys, threading
import sympflow
METHOD = sys.argv[1]

sys.setswitchinterval(1e-5)
system = sympflow.HamiltonianSystem.from_sympy("p**2/2 + q**2/2 + q**4/7", y0=[1.0, 0.0], dt=0.1)
start, found = threading.Barrier(8), []

def run():
    start.wait()
    try:
        found.append(repr(sympflow.solve(system, METHOD, (0, 1)).y[:, -1].tolist()))
    except BaseException as error:
        found.append(repr(error))

threads = [threading.Thread(target=run) for _ in range(8)]
for step in (threading.Thread.start, threading.Thread.join):
    for thread in threads:
        step(thread)
print(len(found), *set(found))
"""

SCRIPT = """
import numpy as np
from sympflow.kernels.splitting_loops import splitting_loops
from sympflow.schemes import SCHEMES
from sympflow.systems import pendulum

Y, n, _ = splitting_loops(pendulum()).kernel(SCHEMES["verlet"]).run(0.1, np.array([1.0, 0.0]), 10, np.array([10]))
print(repr(Y.tolist()))
"""


def started(folder, *words):
    """A process with its own cache folder."""
    env = os.environ | {"SYMPFLOW_CACHE_DIR": str(folder), "HOME": str(folder), "XDG_CACHE_HOME": str(folder)}
    return subprocess.Popen([sys.executable, "-c", *words], stdout=subprocess.PIPE, text=True, env=env)


def told(folder, *words):
    """The output of such a process."""
    process = started(folder, *words)
    text, _ = process.communicate()
    assert process.returncode == 0
    return text


@pytest.mark.parametrize("method", ["gauss_legendre4", "verlet"])
def test_threads_that_compile_at_once(method, tmp_path):
    """Eight threads call `solve` first at once: every text is compiled once."""
    found = told(tmp_path, AT_ONCE, method)
    assert found.startswith("8 [0."), found
    assert found.count("[") == 1
    assert len([*tmp_path.rglob("*.o")]) == 1
    assert not [*tmp_path.rglob("*.part")]


def test_a_fresh_process_finds_the_machine_code_and_makes_what_is_damaged_again(tmp_path):
    first = told(tmp_path, SCRIPT)
    (file,) = (tmp_path / "code").iterdir()
    made, whole = file.stat().st_mtime_ns, file.read_bytes()
    assert told(tmp_path, SCRIPT) == first
    assert [*(tmp_path / "code").iterdir()] == [file]
    assert file.stat().st_mtime_ns == made
    for damaged in (whole[: len(whole) // 2], whole[:-9] + bytes([whole[-9] ^ 1]) + whole[-8:], b""):
        file.write_bytes(damaged)
        assert told(tmp_path, SCRIPT) == first
        assert file.read_bytes() == whole


def test_a_folder_that_cannot_be_written_is_no_obstacle(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    assert told(tmp_path / "file" / "cache", SCRIPT).startswith("[[")


@pytest.mark.slow
def test_processes_that_compile_at_once(tmp_path):
    """Each finds or makes the same file, and none reads what another one is about to write."""
    processes = [started(tmp_path, SCRIPT) for _ in range(4)]
    first, *others = [process.communicate()[0] for process in processes]
    assert first.startswith("[[")
    assert others == [first] * 3
    assert [file.suffix for file in (tmp_path / "code").iterdir()] == [".o"]
