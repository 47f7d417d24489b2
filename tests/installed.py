"""Installs a wheel as a user would, without constraints, for each Python that is found, and tries what it promises.

python tests/installed.py dist          # every interpreter python3.11 … python3.14 on the path, or of pyenv
python tests/installed.py dist 3.12     # one of them
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

VERSIONS = ("3.11", "3.12", "3.13", "3.14")

TRIED = """
import importlib.resources, numpy as np, sympflow
assert importlib.resources.files("sympflow").joinpath("py.typed").is_file()
system = sympflow.HamiltonianSystem.from_sympy("p**2/2 + k*q**4/4", params={"k": 2.0}, y0=[1.0, 0.0])
sol = sympflow.solve(system, "verlet", (0, 10), dt=0.01)
assert sol.success and sol.stats["backend"] == "compiled", sol
assert np.abs(sol.energy_error()).max() < 1e-4
chosen = sympflow.solve("henon-heiles", t_span=(0, 1000))
assert chosen.integrator.name == "sympflow" and np.abs(chosen.energy_error()).max() < 1e-6, chosen
for name in sympflow.__all__:
    getattr(sympflow, name)
print(sympflow.__version__)
"""

TYPED = """
import numpy as np
import sympflow

system = sympflow.HamiltonianSystem.from_sympy("p**2/2 + q**4/4", y0=[1.0, 0.0])
sol: sympflow.Solution = sympflow.solve(system, "verlet", (0.0, 1.0), dt=0.1)
energies: np.ndarray = np.asarray(sol.energy())
step: float = sympflow.choose_step(system, "srkn11b", 1e-6)
report = sympflow.compare("henon-heiles", ["verlet"], t_span=(0.0, 1.0))
named = sympflow.solve("henon-heiles", t_span=(0.0, 1.0))
print(report.table(), energies.max(), step, sol.q.shape)
"""
"""A script of a user that `mypy --strict` must accept."""


def interpreter(version: str) -> str | None:
    """The path of a Python of that version, which runs."""
    pyenv = sorted((Path.home() / ".pyenv" / "versions").glob(f"{version}.*/bin/python"), reverse=True)
    for path in (shutil.which(f"python{version}"), *map(str, pyenv)):
        if path and subprocess.run([path, "-m", "venv", "--help"], capture_output=True, check=False).returncode == 0:
            return path
    return None


def tried(python: str, wheel: Path) -> str:
    """The version that an empty environment with the wheel reports; raises where something fails."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([python, "-m", "venv", folder], check=True)
        bin = Path(folder) / ("Scripts" if sys.platform == "win32" else "bin")
        subprocess.run([bin / "python", "-m", "pip", "install", "--quiet", f"{wheel}[plot,cli]", "mypy"], check=True)

        def run(*command: str | Path) -> str:
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
            if done.returncode:
                raise SystemExit(f"{' '.join(map(str, command))} failed:\n{done.stdout}\n{done.stderr}")
            return done.stdout

        version = run(bin / "python", "-W", "error", "-c", TRIED).strip()
        told = run(bin / "sympflow", "solve", "p**2/2 + q**4/4", "--y0", "1,0", "--t-end", "5", "--tol", "1e-9")
        assert "srkn11b" in told, told
        run(bin / "sympflow", "section", "henon-heiles", "--energy", "0.125", "--t-end", "20", "--out", "figures")
        script = Path(folder) / "script.py"
        script.write_text(TYPED)
        run(bin / "python", "-m", "mypy", "--strict", "script.py")
        return version


def main() -> None:
    """Try the wheel in a folder for each Python, or for those that are named."""
    (wheel,) = Path(sys.argv[1]).resolve().glob("*.whl")
    named = sys.argv[2:]
    for version in named or VERSIONS:
        python = interpreter(version)
        if python is None:
            if named:
                raise SystemExit(f"Python {version} is not found.")
            print(f"Python {version}: not here, not tried")
            continue
        print(f"Python {version}: sympflow {tried(python, wheel)} works", flush=True)


if __name__ == "__main__":
    main()
