"""First results: what a call takes in a fresh process, without a cache and with the one that it left.

    python benchmarks/first_results.py [--out docs/measured]

Processor time of fresh processes, the least of a few. `imports` are those of the packages and of what a scene needs,
`first call` is without a cache, `cached` in the next process, `again` the same call once more.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import subprocess
import sys
import tempfile

from measuring import fragments

SOLVE = "from sympflow import solve, systems, HamiltonianSystem\nimport numpy as np\n"
SCIPY = """import numpy as np
from scipy.integrate import solve_ivp
def field(t, y):
    q1, q2, p1, p2 = y
    return np.array([p1, p2, -q1 - 2*q1*q2, -q2 - q1**2 + q2**2])
"""
LOOP = """import numpy as np
from numba import njit
@njit(cache=True)
def steps(y, h, n):
    q1, q2, p1, p2 = y
    for _ in range(n):
        q1 += h/2*p1; q2 += h/2*p2
        p1 -= h*(q1 + 2*q1*q2); p2 -= h*(q2 + q1**2 - q2**2)
        q1 += h/2*p1; q2 += h/2*p2
    return q1, q2, p1, p2
y = np.array([0.1, 0.1, 0.2, 0.1])
"""
HEYOKA = """import heyoka as hy
q1, q2, p1, p2 = hy.make_vars("q1", "q2", "p1", "p2")
"""
TAYLOR = """ta = hy.taylor_adaptive([(q1, p1), (q2, p2), (p1, -q1 - 2*q1*q2), (p2, -q2 - q1**2 + q2**2)],
                        [0.1, 0.1, 0.2, 0.1])
ta.propagate_until(10.0)"""
DIFFRAX = """import jax, jax.numpy as jnp, diffrax
jax.config.update("jax_enable_x64", True)
def field(t, y, _):
    q1, q2, p1, p2 = y
    return jnp.array([p1, p2, -q1 - 2*q1*q2, -q2 - q1**2 + q2**2])
"""
DOPRI = """diffrax.diffeqsolve(diffrax.ODETerm(field), diffrax.Dopri8(), 0.0, 10.0, 0.1,
                    jnp.array([0.1, 0.1, 0.2, 0.1])).ys.block_until_ready()"""
CHAIN = """T = "+".join(f"p{i}**2/2" for i in range(1, 65))
V = "+".join(f"(q{i + 1}-q{i})**2/2 + (q{i + 1}-q{i})**4/4" for i in range(1, 64))
system = HamiltonianSystem.from_sympy(f"{T} + {V}", y0=[*np.linspace(0, 1, 64), *np.zeros(64)])"""
BODIES = """y0 = [1, 0, -1, 0, 0, 0.5, 0, 0.4, 0, -0.4, 0.3, 0.0]
system = HamiltonianSystem.pairs("-1/r", y0=y0, masses=[1, 1, 1], dim=2)"""
BATCH = "y0=system.y0 + 0.01*np.random.default_rng(0).normal(size=(1000, 4))"

CASES = {
    "Hénon–Heiles, `verlet`": (
        "sympflow",
        SOLVE + "system = systems.henon_heiles()",
        "solve(system, 'verlet', (0, 10))",
    ),
    "the same, 1000 trajectories": (
        "sympflow",
        SOLVE + "system = systems.henon_heiles()",
        f"solve(system, 'verlet', (0, 10), {BATCH})",
    ),
    "pendulum, `srkn11b`": ("sympflow", SOLVE + "system = systems.pendulum()", "solve(system, 'srkn11b', (0, 10))"),
    "driven pendulum, `verlet`": (
        "sympflow",
        SOLVE + "system = systems.driven_pendulum()",
        "solve(system, 'verlet', (0, 10))",
    ),
    "a flow that ships, Hénon–Heiles": (
        "sympflow",
        SOLVE + "system = systems.henon_heiles()",
        "solve(system, t_span=(0, 10))",
    ),
    "Hénon–Heiles, `gauss_legendre4`": (
        "sympflow",
        SOLVE + "system = systems.henon_heiles()",
        "solve(system, 'gauss_legendre4', (0, 10))",
    ),
    "`lyapunov`, Hénon–Heiles": (
        "sympflow",
        SOLVE + "from sympflow import lyapunov\nsystem = systems.henon_heiles()",
        "lyapunov(system, 'verlet', t_span=(0, 100))",
    ),
    "three bodies by `pairs`": (
        "sympflow",
        SOLVE + BODIES,
        "solve(system, 'verlet', (0, 1), dt=0.01)",
    ),
    "a lattice of 256 sites": (
        "sympflow",
        SOLVE + "system = systems.fput_beta(256)",
        "solve(system, 'verlet', (0, 10), dt=0.05)",
    ),
    "64 degrees of freedom as text": ("sympflow", SOLVE + CHAIN, "solve(system, 'verlet', (0, 10), dt=0.05)"),
    "Hénon–Heiles, DOP853": ("scipy", SCIPY, "solve_ivp(field, (0, 10), [0.1, 0.1, 0.2, 0.1], method='DOP853')"),
    "Hénon–Heiles, a Verlet loop": ("numba", LOOP, "steps(y, 0.05, 200)"),
    "Hénon–Heiles, Taylor": ("heyoka", HEYOKA, TAYLOR),
    "Hénon–Heiles, Dopri8": ("diffrax", DIFFRAX, DOPRI),
}

SCRIPT = """import time, warnings
warnings.simplefilter("ignore")
{setup}
a = time.process_time()
{call}
b = time.process_time()
{call}
print("times", a, b - a, time.process_time() - b)
"""


def times(setup: str, call: str, cache: str) -> list[float]:
    """Seconds of the imports, the first call and the second one, in a fresh process."""
    environment = os.environ | {"SYMPFLOW_CACHE_DIR": cache, "NUMBA_CACHE_DIR": cache, "OMP_NUM_THREADS": "1"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # modules themselves are compiled by Python once
    script = os.path.join(cache, "case.py")
    with open(script, "w", encoding="utf-8") as file:
        file.write(SCRIPT.format(setup=setup, call=call))
    result = subprocess.run([sys.executable, script], env=environment, capture_output=True, text=True, check=True)
    return [float(x) for x in result.stdout.rpartition("times")[2].split()]


def measured(repeats: int) -> list[list[str]]:
    rows = []
    for name, (package, setup, call) in CASES.items():
        if importlib.util.find_spec(package) is None:
            continue
        fresh, cached = [], []
        for _ in range(repeats):
            with tempfile.TemporaryDirectory() as cache:
                fresh.append(times(setup, call, cache))
                cached.append(times(setup, call, cache))
        least = [min(column) for column in zip(*fresh, strict=True)]
        known, first, again = least
        later = min(x[1] for x in cached)
        rows.append([name, package, *(f"{x:.2f} s" for x in (known, first, later)), f"{1e3 * again:.2f} ms"])
        print(*rows[-1], sep="  ", flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    fragments.add_out(parser)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    titles = ["", "package", "imports", "first call", "cached", "again"]
    fragments.write(arguments.out, "first-results", fragments.table(titles, measured(arguments.repeats)))


if __name__ == "__main__":
    main()
