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


# gradients ---------------------------------------------------------------------------------------------------------

TEXT = "(p1**2 + p2**2)/2 + k*(q1**2 + q2**2)/2 + g*(q1**2*q2 - q2**3/3)"
PARAMS = {"k": 1.1, "g": 0.9}


def of_gradients() -> list[list[Any]]:
    """Σy at the end of Verlet steps of Hénon–Heiles, and its derivatives by y0 and two parameters."""
    rows = []
    for n in (1_000, STEPS):
        for name, make in GRADIENTS.items():
            try:
                run = make(n)
            except ImportError as error:
                rows.append([n, name, None, str(error)])
                continue
            run()
            rows.append([n, name, 1e3 * least(run, 9 if "sympflow" in name else 3)[0], ""])
    return rows


def ours_alone(n: int) -> Callable[[], Any]:
    system = HamiltonianSystem.from_sympy(TEXT, params=PARAMS)
    return lambda: solve(system, "verlet", (0.0, n * DT), Y0, t_eval=[n * DT], dt=DT)


def ours_with_gradient(n: int) -> Callable[[], Any]:
    import torch

    system = HamiltonianSystem.from_sympy(TEXT, params=PARAMS)

    def run() -> Any:
        y0, k, g = (torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (Y0, *PARAMS.values()))
        sol = solve(system, "verlet", (0.0, n * DT), y0, t_eval=[n * DT], dt=DT, params={"k": k, "g": g})
        return torch.autograd.grad(sol.y.sum(), (y0, k, g))

    return run


def slopes(x: Any, k: Any, g: Any) -> tuple[Any, Any]:
    return k * x[0] + 2 * g * x[0] * x[1], k * x[1] + g * (x[0] ** 2 - x[1] ** 2)


def by_eager_torch(n: int) -> Callable[[], Any]:
    import torch

    def run() -> Any:
        y0, k, g = (torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (Y0, *PARAMS.values()))
        q, p = y0[:2], y0[2:]
        for _ in range(n):
            p = p - DT / 2 * torch.stack(slopes(q, k, g))
            q = q + DT * p
            p = p - DT / 2 * torch.stack(slopes(q, k, g))
        return torch.autograd.grad(q.sum() + p.sum(), (y0, k, g))

    return run


def by_torchdiffeq_gradient(n: int) -> Callable[[], Any]:
    import torch
    from torchdiffeq import odeint

    times = torch.tensor([0.0, n * DT], dtype=torch.float64)

    def run() -> Any:
        y0, k, g = (torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (Y0, *PARAMS.values()))

        def moved(t: Any, y: Any) -> Any:
            return torch.cat([y[2:], -torch.stack(slopes(y[:2], k, g))])

        end = odeint(moved, y0, times, method="midpoint", options={"step_size": DT})[-1]
        return torch.autograd.grad(end.sum(), (y0, k, g))

    return run


def by_scan_gradient(n: int) -> Callable[[], Any]:
    import jax

    jax.config.update("jax_enable_x64", True)

    def end(y0: Any, k: Any, g: Any) -> Any:
        def step(state: Any, _: Any) -> Any:
            q, p = state
            p = p - DT / 2 * jax.numpy.stack(slopes(q, k, g))
            q = q + DT * p
            return (q, p - DT / 2 * jax.numpy.stack(slopes(q, k, g))), None

        q, p = jax.lax.scan(step, (y0[:2], y0[2:]), None, n)[0]
        return q.sum() + p.sum()

    run = jax.jit(jax.value_and_grad(end, (0, 1, 2)))
    return lambda: jax.block_until_ready(run(Y0, *PARAMS.values()))


def by_diffrax_gradient(n: int) -> Callable[[], Any]:
    import diffrax
    import jax

    jax.config.update("jax_enable_x64", True)

    def end(y0: Any, k: Any, g: Any) -> Any:
        terms = (
            diffrax.ODETerm(lambda t, p, _: p),
            diffrax.ODETerm(lambda t, q, _: -jax.numpy.stack(slopes(q, k, g))),
        )
        start, solver = (y0[:2], y0[2:]), diffrax.SemiImplicitEuler()
        q, p = diffrax.diffeqsolve(terms, solver, 0.0, n * DT, DT, start, max_steps=2 * n).ys
        return q.sum() + p.sum()

    run = jax.jit(jax.value_and_grad(end, (0, 1, 2)))
    return lambda: jax.block_until_ready(run(Y0, *PARAMS.values()))


GRADIENTS = {
    "sympflow, the run alone": ours_alone,
    "sympflow, value and gradient": ours_with_gradient,
    "`jax.lax.scan`, by hand": by_scan_gradient,
    "diffrax, semi-implicit Euler, recursive checkpoint": by_diffrax_gradient,
    "torch, by hand": by_eager_torch,
    "torchdiffeq, `midpoint`": by_torchdiffeq_gradient,
}

BATCH, UNROLLED = 256, 20


def of_networks() -> list[list[Any]]:
    """An iteration of training V_θ, two layers of 32, through 20 steps of Verlet: value and gradient by the weights."""
    import torch

    torch.manual_seed(0)
    linear, tanh = torch.nn.Linear, torch.nn.Tanh
    net = torch.nn.Sequential(linear(2, 32), tanh(), linear(32, 32), tanh(), linear(32, 1, bias=False)).double()
    y0 = torch.randn(BATCH, 4, dtype=torch.float64) * 0.3
    system = HamiltonianSystem(lambda q: net(q)[..., 0], ndof=2)

    def by_solve() -> Any:
        sol = solve(system, "verlet", (0.0, 2.0), y0, t_eval=[2.0], dt=0.1)
        return torch.autograd.grad((sol.y**2).mean(), list(net.parameters()))

    def force(q: Any) -> Any:
        q = q if q.requires_grad else q.detach().requires_grad_()
        return torch.autograd.grad(net(q).sum(), q, create_graph=True)[0]

    def by_hand() -> Any:
        q, p = y0[:, :2], y0[:, 2:]
        f = force(q)
        for _ in range(UNROLLED):
            p = p - 0.05 * f
            q = q + 0.1 * p
            f = force(q)
            p = p - 0.05 * f
        return torch.autograd.grad((torch.cat([q, p], -1) ** 2).mean(), list(net.parameters()))

    for found, expected in zip(by_solve(), by_hand(), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-13)
    named = {"sympflow, `verlet`": by_solve, "torch, by hand": by_hand}
    return [[name, 1e3 * least(run, REPEATS)[0]] for name, run in named.items()]


def shown_functions(rows: list[list[Any]]) -> str:
    titles = ["H", "method", "traced and compared, ms", "first run, ms", "a step, ns", "by text, ns", "ratio"]
    cells = [[n, f"`{m}`", f"{a:.1f}", f"{b:.0f}", f"{c:.0f}", f"{d:.0f}", f"{e:.2f}"] for n, m, a, b, c, d, e in rows]
    return fragments.table(titles, cells)


def shown_peers(rows: list[list[Any]]) -> str:
    ours = rows[0][1]
    cells = [[n, f"{t:.2f}" if t else why, f"{t / ours:.0f}" if t else ""] for n, t, why in rows]
    return fragments.table(["10,000 steps of Hénon–Heiles", "ms", "of ours"], cells)


def shown_gradients(rows: list[list[Any]]) -> str:
    alone = {n: t for n, name, t, _ in rows if name.endswith("alone")}
    cells = [[f"{n:,}", k, f"{t:.3f}" if t else why, f"{t / alone[n]:.1f}" if t else ""] for n, k, t, why in rows]
    return fragments.table(["steps", "value and gradient", "ms", "of the run"], cells)


def shown_networks(rows: list[list[Any]]) -> str:
    cells = [[name, f"{t:.1f}", f"{t / rows[0][1]:.1f}"] for name, t in rows]
    return fragments.table(["an iteration, a batch of 256", "ms", "of ours"], cells)


ROWS: dict[str, tuple[Callable[[], list[list[Any]]], Callable[[list[list[Any]]], str]]] = {
    "function": (of_functions, shown_functions),
    "libraries": (of_peers, shown_peers),
    "gradients": (of_gradients, shown_gradients),
    "networks": (of_networks, shown_networks),
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
