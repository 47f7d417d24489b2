"""Waves: a breather over a thousand periods, the norm of a soliton, nearly integrable fields, and a peer.

    python benchmarks/large_waves.py [--out docs/measured]
    python benchmarks/large_waves.py --only large-breather,large-soliton,large-nearly-integrable
    python benchmarks/large_waves.py --only large-amangkurat

Float64, one thread, process time of `solve` as a user calls it, the least of several runs; compiled before.
In `large-amangkurat` both codes run the sine-Gordon breather for ten periods, with grids and steps of their own from a
list; its error is against the wave on the line, at the sites. amangkurat (spectral, Verlet) is installed beside the
package. Its progress bar and messages are off, and so is its adaptive step.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from collections.abc import Callable
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from measuring import fragments

from sympflow import HamiltonianSystem, max_energy_error, solve, systems

FREQUENCY = 0.6
PERIOD = 2 * math.pi / FREQUENCY


def timed(call: Callable[[], Any], rounds: int) -> float:
    """The least process time of a call, in seconds."""
    least = math.inf
    for _ in range(rounds):
        start = time.process_time()
        call()
        least = min(least, time.process_time() - start)
    return least


def breather(rounds: int) -> str:
    """A thousand periods: the energy at 2,378 moments of all phases."""
    rows = []
    system = systems.sine_gordon("breather", frequency=FREQUENCY)
    t_end = 1000 * PERIOD
    moments = np.linspace(0.0, t_end, 2378)  # of every phase
    for method, steps in (("srkn11b", 52), ("srkn14a", 42), ("kahan_li6", 75), ("verlet", 200)):
        dt = PERIOD / steps

        def run(method: str = method, dt: float = dt) -> Any:
            return solve(system, method, (0.0, t_end), dt=dt, t_eval=moments)

        sol = run()
        seconds = timed(run, rounds)
        rows.append([f"`{method}`", f"{dt:.3f}", f"{max_energy_error(sol):.1e}", f"{seconds:.2f}"])
    return fragments.table(["method", "step", "energy error", "s"], rows)


def soliton(rounds: int) -> str:
    """The soliton of the Schrödinger equation: norm, energy and wave after it has passed 10 lengths of its own."""
    rows = []
    system = systems.nonlinear_schroedinger(n=256, length=60.0, velocity=0.1)
    t_end = 100.0
    for method, dt in (("impulse", 0.01), ("linear_blanes_moan4", 0.05), ("linear_kahan_li6", 0.05)):

        def run(method: str = method, dt: float = dt) -> Any:
            return solve(system, method, (0.0, t_end), dt=dt, t_eval=np.linspace(0.0, t_end, 101))

        sol = run()
        norms = (sol.y**2).sum(0)
        error = abs(sol.y[:, -1] - system.exact(t_end)).max()
        norm = abs(norms / norms[0] - 1).max()
        figures = [f"{norm:.1e}", f"{max_energy_error(sol):.1e}", f"{error:.1e}", f"{timed(run, rounds):.2f}"]
        rows.append([f"`{method}`", f"{dt:g}", f"{round(t_end / dt):,}", *figures])
    return fragments.table(["method", "step", "steps", "norm", "energy error", "error of ψ", "s"], rows)


def nearly_integrable(rounds: int) -> str:
    """Work and precision at 1,024 sites: a weak nonlinearity, the least time within each energy error."""
    system = HamiltonianSystem.schroedinger("e*rho**2/2", shape=1024, length=100.0, params={"e": 0.01})
    x = (np.arange(1024) - 511.5) * 100 / 1024
    psi = np.exp(-((x / 10) ** 2) + 0.5j * x)
    y0 = math.sqrt(2) * np.concatenate([psi.real, psi.imag])
    bounds, t_end = (1e-8, 1e-10, 1e-12), 50.0
    methods = ("impulse", "linear_blanes_moan4", "linear_kahan_li6", "linear_kahan_li8")
    rows = []
    for method in (*methods, "linear_aba104", "linear_aba864", "linear_aba1064"):
        found: list[tuple[float, float]] = []
        for n in (4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512, 1024, 2048):

            def run(method: str = method, n: int = n) -> Any:
                return solve(system, method, (0.0, t_end), y0, dt=t_end / n, t_eval=np.linspace(0.0, t_end, 5))

            error = max_energy_error(run())
            found.append((float(error), timed(run, rounds)))
            if error < min(bounds):
                break
        best = [min((s for error, s in found if error <= bound), default=math.nan) for bound in bounds]
        rows.append([f"`{method}`", *(f"{1e3 * s:.1f}" if math.isfinite(s) else "–" for s in best)])
    return fragments.table(["method", *(f"{bound:.0e}: ms" for bound in bounds)], rows)


def amangkurat(rounds: int) -> str:
    """The breather at equal error: the least time of each code within the errors that the other one reaches."""
    from amangkurat.core.solver import KGSolver

    t_end = 10 * PERIOD
    theirs: list[tuple[float, float, str]] = []
    for n in (128, 192, 256, 384):
        peer = KGSolver(nx=n, x_min=-30.0, x_max=30.0, verbose=False, n_cores=1, adaptive_dt=False)
        line = systems.sine_gordon("breather", frequency=FREQUENCY, n=n, length=60.0)
        wave = line.exact.func(line.exact.args[0], peer.x, 0.0)  # type: ignore[union-attr]
        for dt in (peer.dt_max, math.sqrt(peer.dt_min * peer.dt_max), peer.dt_min):

            def run(peer: Any = peer, wave: np.ndarray = wave, dt: float = dt, n: int = n) -> Any:
                return peer.solve(wave[:n], wave[n:], dt, t_end, potential="sine_gordon", n_snapshots=2)

            out = run()
            t, u = out["t"][-1], out["phi"][-1]
            error = abs(u - line.exact.func(line.exact.args[0], peer.x, t)[:n]).max()  # type: ignore[union-attr]
            theirs.append((float(error), timed(run, 1), f"{n} sites, dt {dt:.4f}"))
    ours: list[tuple[float, float, str]] = []
    for n in (128, 192, 256, 384, 512):
        system = systems.sine_gordon("breather", frequency=FREQUENCY, n=n, length=60.0, accuracy=6)
        for method in ("srkn6b", "srkn11b"):
            for steps in (12, 16, 24, 32, 48):

                def call(system: Any = system, method: str = method, steps: int = steps) -> Any:
                    return solve(system, method, (0.0, t_end), dt=PERIOD / steps, t_eval=[t_end])

                sol = call()
                if sol.success:
                    error = float(abs(sol.y[:n, -1] - system.exact(t_end)[:n]).max())
                    ours.append((error, timed(call, rounds), f"{n} sites, `{method}`, {steps} steps a period"))
    rows = []
    for bound in (1e-1, 3e-2, 1e-2, 5e-3):
        pair = [
            min((run for run in runs if run[0] <= bound), key=lambda r: r[1], default=None) for runs in (theirs, ours)
        ]
        if pair[0] is not None and pair[1] is not None:
            (_, s, a), (_, own, b) = pair
            rows.append([f"{bound:.0e}", f"{1e3 * s:.0f} ({a})", f"{1e3 * own:.1f} ({b})", f"{s / own:.0f}"])
    return fragments.table(["error of u", "amangkurat, ms", "sympflow, ms", "ratio"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    fragments.add_out(parser)
    parser.add_argument("--only", default="large-breather,large-soliton,large-nearly-integrable")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    parts: dict[str, Callable[[], str]] = {
        "large-breather": lambda: breather(arguments.rounds),
        "large-soliton": lambda: soliton(arguments.rounds),
        "large-nearly-integrable": lambda: nearly_integrable(arguments.rounds),
        "large-amangkurat": lambda: amangkurat(arguments.rounds),
    }
    for name in arguments.only.split(","):
        body = parts[name]()
        print(body, flush=True)
        fragments.write(arguments.out, name, body)


if __name__ == "__main__":
    main()
