"""The cache of compiled modules: threads that compile at once, and files that were cut."""

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


def told(folder, method="gauss_legendre4"):
    """The output of a process with its own cache folder."""
    env = os.environ | {"SYMPFLOW_CACHE_DIR": str(folder), "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    ended = subprocess.run(
        [sys.executable, "-c", AT_ONCE, method], capture_output=True, text=True, check=False, env=env
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def test_threads_that_compile_at_once_and_files_that_were_cut(tmp_path):
    """Eight threads call `solve` first at once; then each file of the cache is cut, empty, or another text."""
    first = told(tmp_path)
    assert first.startswith("8 [0."), first
    assert first.count("[") == 1
    for ending in ("nbi", "nbc", "py"):
        files = sorted(tmp_path.rglob(f"*.{ending}"))
        assert files
        for i, file in enumerate(files):
            content = file.read_bytes()
            file.write_bytes((content[: len(content) // 2], b"", b"text")[i % 3])
        assert told(tmp_path) == first
    kept = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.nbc")}
    assert told(tmp_path) == first
    assert {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.nbc")} == kept  # compiled once


def test_threads_that_trace_at_once(tmp_path):
    """Eight threads call `solve` first at once with a method over traced numbers: one file is made."""
    found = told(tmp_path, "verlet")
    assert found.startswith("8 [0."), found
    assert found.count("[") == 1
    assert len([*tmp_path.rglob("*.o")]) == 1


@pytest.mark.parametrize("locale", [{"PYTHONIOENCODING": "ascii"}, {"LC_ALL": "C", "PYTHONUTF8": "0"}], ids=str)
def test_the_command_line_writes_utf_8(locale, tmp_path):
    env = os.environ | {"PYTHONCOERCECLOCALE": "0", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))} | locale
    words = ["compare", "pendulum", "--methods", "verlet", "--t-end", "1", "--out", str(tmp_path)]
    for call in (words, ["compare", "--help"], ["methods"]):
        ended = subprocess.run([sys.executable, "-m", "sympflow.cli", *call], capture_output=True, check=False, env=env)
        assert ended.returncode == 0, ended.stderr
        text = ended.stdout.decode("utf-8")
        assert not text.isascii() or call[0] == "methods"
    assert (tmp_path / "pendulum.csv").read_text(encoding="utf-8").startswith("system,")
