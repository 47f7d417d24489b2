"""The machine that measures: one thread of it, and what it is in words that mean something elsewhere."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = (
    "numpy",
    "scipy",
    "numba",
    "torch",
    "torchdiffeq",
    "jax",
    "diffrax",
    "heyoka",
    "rebound",
    "pyhamsys",
    "desolver",
)
VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


def pin_to_one_thread() -> None:
    """Keep the process, and every thread that a library starts, on one core. Before the libraries are imported.

    Only where a command of this folder runs: tests that import one keep the cores that they have.
    """
    if Path(sys.argv[0]).resolve().parent != ROOT / "benchmarks":
        return
    for variable in VARIABLES:
        os.environ[variable] = "1"
    os.environ["JAX_PLATFORMS"] = "cpu"
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    if sys.platform == "linux":
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})

    import torch

    torch.set_num_threads(1)


def in_words() -> str:
    """The machine: "one thread of AMD EPYC, 2 cores, Linux x86_64"."""
    return f"one thread of {processor()}, {os.cpu_count()} cores, {platform.system()} {platform.machine()}"


def versions() -> dict[str, str]:
    """The versions of Python and of the packages that are there."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def describe() -> dict[str, Any]:
    """The machine in words, its load, and the versions of the packages."""
    return {"machine": in_words(), "load": load(), "versions": versions()}


def load() -> float:
    """The load average of the last minute, NaN where the system has none."""
    return os.getloadavg()[0] if sys.platform != "win32" else float("nan")


def commit() -> str:
    """The commit of the working tree, marked where files differ from it; "unknown" outside a repository."""
    try:
        name = _git("rev-parse", "--short", "HEAD")
        return f"{name} with changes" if _git("status", "--porcelain", "--untracked-files=no", "sympflow") else name
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


def processor() -> str:
    """The name of the processor."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return " ".join(line.partition(":")[2].split())
    return platform.processor() or "unknown"


def least(run: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """The least processor time of a call in seconds, and its result."""
    best, result = float("inf"), None
    for _ in range(repeats):
        begin = time.process_time()
        result = run()
        best = min(best, time.process_time() - begin)
    return best, result
