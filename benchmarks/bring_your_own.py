"""H as a user has it: a Python function, beside the same H by text, and beside the libraries that take functions.

    python benchmarks/bring_your_own.py                          all rows
    python benchmarks/bring_your_own.py function                 one of them
    python benchmarks/bring_your_own.py --out docs/measured      with the fragments of the pages

Each row is a process of its own, on one thread, and times are processor times, the least of repeated runs.
A library that is not installed is a line that says so.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from measuring.machine import least, pin_to_one_thread

pin_to_one_thread()

import numpy as np
from measuring import fragments

from sympflow import HamiltonianSystem, solve

Y0 = np.array([0.1, 0.2, 0.3, 0.4])
STEPS, DT, REPEATS = 10_000, 0.01, 9


def henon_heiles(q: Any) -> Any:
    return (q**2).sum(-1) / 2 + q[..., 0] ** 2 * q[..., 1] - q[..., 1] ** 3 / 3


def pendulums(q: Any) -> Any:
    return -np.cos(q).sum(-1) - 0.5 * np.cos(q[..., 0] - q[..., 1])


def bodies(q: Any) -> Any:
    x = q.reshape((*q.shape[:-1], 3, 2))
    d = x[..., (0, 0, 1), :] - x[..., (1, 2, 2), :]
    return -(1 / np.sqrt((d**2).sum(-1) + 0.01)).sum(-1)


def geodesic(q: Any, p: Any) -> Any:
    return (p**2).sum(-1) / 2 * (1 + q[..., 0] ** 2) + (q**4).sum(-1) / 4


DISTANCES = " + ".join(
    f"1/sqrt((q{a} - q{b})**2 + (q{a + 1} - q{b + 1})**2 + 1/100)" for a, b in ((1, 3), (1, 5), (3, 5))
)
FUNCTIONS: dict[str, tuple[dict[str, Any], str, str]] = {
    "Hénon–Heiles": (
        {"potential": henon_heiles, "ndof": 2},
        "(p1**2 + p2**2 + q1**2 + q2**2)/2 + q1**2*q2 - q2**3/3",
        "srkn11b",
    ),
    "two pendulums": (
        {"potential": pendulums, "ndof": 2},
        "(p1**2 + p2**2)/2 - cos(q1) - cos(q2) - cos(q1 - q2)/2",
        "srkn11b",
    ),
    "three bodies in a plane": (
        {"potential": bodies, "ndof": 6},
        "(p1**2 + p2**2 + p3**2 + p4**2 + p5**2 + p6**2)/2 - (" + DISTANCES + ")",
        "verlet",
    ),
    "a geodesic": ({"hamiltonian": geodesic, "ndof": 2}, "(p1**2 + p2**2)/2*(1 + q1**2) + (q1**4 + q2**4)/4", "rk4"),
    "a geodesic, implicit": (
        {"hamiltonian": geodesic, "ndof": 2},
        "(p1**2 + p2**2)/2*(1 + q1**2) + (q1**4 + q2**4)/4",
        "gauss_legendre4",
    ),
}


def of_functions() -> list[list[Any]]:
    """A traced function beside the same H by text, in turn in one process."""
    rows = []
    for name, (given, text, method) in FUNCTIONS.items():
        y0 = np.linspace(0.1, 0.4, 2 * given["ndof"])
        start = time.process_time()
        function = HamiltonianSystem(**given)
        function.check_functions(y0)
        assert function.form is not None
        traced = time.process_time() - start
        systems = function, HamiltonianSystem.from_sympy(text)

        def run(system: HamiltonianSystem, y0: np.ndarray = y0, method: str = method) -> Any:
            return solve(system, method, (0.0, STEPS * DT), y0, t_eval=[STEPS * DT], dt=DT)

        start = time.process_time()
        run(function)
        first = time.process_time() - start
        ends = [run(system) for system in systems]
        assert all(end.stats["backend"] == "compiled" for end in ends)
        np.testing.assert_allclose(ends[0].y, ends[1].y, rtol=1e-6)
        times = np.array([[least(partial(run, s), 1)[0] for s in systems] for _ in range(REPEATS)]).min(0)
        rows.append([name, method, traced * 1e3, first * 1e3, *(times / STEPS * 1e9), times[0] / times[1]])
    return rows


def of_peers() -> list[list[Any]]:
    """10,000 steps of Hénon–Heiles, about as accurate or of the same method, by libraries that take functions."""
    rows = []
    for name, make in PEERS.items():
        try:
            run = make()
        except ImportError as error:
            rows.append([name, None, str(error)])
            continue
        run()
        rows.append([name, 1e3 * least(run, 3)[0], ""])
    return rows


def ours() -> Callable[[], Any]:
    system = HamiltonianSystem(henon_heiles, ndof=2)
    return lambda: solve(system, "verlet", (0.0, STEPS * DT), Y0, t_eval=[STEPS * DT], dt=DT)


def field(t: float, y: np.ndarray) -> np.ndarray:
    x, z = y[0], y[1]
    return np.array([y[2], y[3], -x - 2 * x * z, -z - x * x + z * z])


def by_scipy() -> Callable[[], Any]:
    from scipy.integrate import solve_ivp

    return lambda: solve_ivp(field, (0.0, STEPS * DT), Y0, method="DOP853", rtol=1e-9, atol=1e-9)


def by_torchdiffeq() -> Callable[[], Any]:
    import torch
    from torchdiffeq import odeint

    def moved(t: Any, y: Any) -> Any:
        x, z = y[0], y[1]
        return torch.stack([y[2], y[3], -x - 2 * x * z, -z - x * x + z * z])

    times = torch.tensor([0.0, STEPS * DT], dtype=torch.float64)
    return lambda: odeint(moved, torch.tensor(Y0), times, method="rk4", options={"step_size": DT})


def by_scan() -> Callable[[], Any]:
    import jax

    jax.config.update("jax_enable_x64", True)
    slope = jax.grad(henon_heiles)

    def step(state: Any, _: Any) -> Any:
        q, p = state
        p = p - DT / 2 * slope(q)
        q = q + DT * p
        return (q, p - DT / 2 * slope(q)), None

    run = jax.jit(lambda q, p: jax.lax.scan(step, (q, p), None, STEPS)[0])
    return lambda: jax.block_until_ready(run(Y0[:2], Y0[2:]))


def by_diffrax() -> Callable[[], Any]:
    import diffrax
    import jax

    jax.config.update("jax_enable_x64", True)
    slope = jax.grad(henon_heiles)
    terms = diffrax.ODETerm(lambda t, p, _: p), diffrax.ODETerm(lambda t, q, _: -slope(q))

    def run(q: Any, p: Any) -> Any:
        solver = diffrax.SemiImplicitEuler()
        return diffrax.diffeqsolve(terms, solver, 0.0, STEPS * DT, DT, (q, p), max_steps=2 * STEPS).ys

    jitted = jax.jit(run)
    return lambda: jax.block_until_ready(jitted(Y0[:2], Y0[2:]))


PEERS = {
    "sympflow, `verlet`": ours,
    "SciPy, DOP853 to 1e-9": by_scipy,
    "torchdiffeq, `rk4`": by_torchdiffeq,
    "`jax.lax.scan`, Verlet by hand": by_scan,
    "diffrax, semi-implicit Euler": by_diffrax,
}


def shown_functions(rows: list[list[Any]]) -> str:
    titles = ["H", "method", "traced and compared, ms", "first run, ms", "a step, ns", "by text, ns", "ratio"]
    cells = [[n, f"`{m}`", f"{a:.1f}", f"{b:.0f}", f"{c:.0f}", f"{d:.0f}", f"{e:.2f}"] for n, m, a, b, c, d, e in rows]
    return fragments.table(titles, cells)


def shown_peers(rows: list[list[Any]]) -> str:
    ours = rows[0][1]
    cells = [[n, f"{t:.2f}" if t else why, f"{t / ours:.0f}" if t else ""] for n, t, why in rows]
    return fragments.table(["10,000 steps of Hénon–Heiles", "ms", "of ours"], cells)


ROWS: dict[str, tuple[Callable[[], list[list[Any]]], Callable[[list[list[Any]]], str]]] = {
    "function": (of_functions, shown_functions),
    "libraries": (of_peers, shown_peers),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", metavar="ROW", help=f"of {', '.join(ROWS)}; all without one")
    parser.add_argument("--here", action="store_true", help="measure one row in this process, as JSON")
    fragments.add_out(parser)
    arguments = parser.parse_args()
    if arguments.here:
        print(json.dumps(ROWS[arguments.rows[0]][0]()))
        return
    for name in arguments.rows or ROWS:
        done = subprocess.run([sys.executable, __file__, name, "--here"], capture_output=True, text=True, check=True)
        body = ROWS[name][1](json.loads(done.stdout.splitlines()[-1]))
        print(f"\n{name}\n{body}")
        fragments.write(arguments.out, f"bring-{name}", body, name)


if __name__ == "__main__":
    main()
