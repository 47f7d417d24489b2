"""The cost of friction: compiled runs of damped systems against the same without damping.

    python benchmarks/friction.py [--out docs/measured]
    python benchmarks/friction.py --taken-over         errors of flows of the systems without friction, combined with it
    python benchmarks/friction.py --trained            flows fitted to damped systems against every splitting scheme

Float64, one thread, process time. The two runs of a row are timed in turn, in rounds, and the median of the ratios
counts. A run is `--steps` steps of one trajectory, or a tenth of it of 256 trajectories. The rates are so low that
nothing comes to rest: numbers below 1e-308 are denormal, which processors compute ten times as slowly.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import time
from functools import partial

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

import numpy as np
from measuring import fragments
from measuring.race import Measure, race

import sympflow
from sympflow import HamiltonianSystem, SympFlow, solve, systems
from sympflow.flow.primed import PrimedFlow
from sympflow.systems import damped_pendulum, henon_heiles, pendulum

TRAJECTORIES = 256
H = henon_heiles()
DAMPED = {
    "pendulum, γ": (pendulum(), damped_pendulum(1e-4)),
    "Hénon–Heiles, γ": (H, HamiltonianSystem.from_sympy(H.symbols.H, damping=1e-4, y0=H.y0)),
    "Hénon–Heiles, one γ for each p": (H, HamiltonianSystem.from_sympy(H.symbols.H, damping=[1e-4, 2e-4], y0=H.y0)),
    "Hénon–Heiles, a matrix Γ": (
        H,
        HamiltonianSystem.from_sympy(H.symbols.H, damping=[[2e-4, 1e-4], [1e-4, 2e-4]], y0=H.y0),
    ),
}


def ratio(
    plain: HamiltonianSystem, damped: HamiltonianSystem, method: str, n_steps: int, batch: int, rounds: int
) -> tuple[float, float]:
    """The median of the ratios of process times, and the time of a step without friction in nanoseconds."""
    y0 = plain.y0 if batch == 1 else np.linspace(0.5, 1.0, batch)[:, None] * plain.y0

    def timed(system: HamiltonianSystem) -> float:
        start = time.process_time()
        solve(system, method, (0.0, 0.05 * n_steps), y0, dt=0.05, save_every=n_steps)
        return time.process_time() - start

    timed(plain), timed(damped)  # compiled
    times = np.array([(timed(plain), timed(damped)) for _ in range(rounds)])
    return float(np.median(times[:, 1] / times[:, 0])), float(np.median(times[:, 0])) / n_steps / batch * 1e9


# trained flows -----------------------------------------------------------------------------------------------


def with_friction(plain: HamiltonianSystem, rate: float) -> HamiltonianSystem:
    return HamiltonianSystem.from_sympy(
        plain.symbols.H, name=f"{plain.name}_{rate:g}", damping=rate, y0=plain.y0, domain=plain.domain
    )


def taken_over(names: tuple[str, ...] = ("pendulum-primed-3-0.8", "henon_heiles-primed-3-0.8")) -> str:
    """The state error at T = 8 of flows that ship, of the system without friction and combined with it in two ways."""
    lines = [
        "| flow | γ | without friction | friction in the drifts | half a step of friction before and after |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name in names:
        shipped = next(f for f in sympflow.shipped_flows() if f.name == name)
        plain = getattr(systems, shipped.system)()
        flow, d = shipped.load(plain), plain.ndof
        y0 = plain.domain.sample(20, seed=3)

        def error(system: HamiltonianSystem, y: np.ndarray, y0: np.ndarray = y0) -> float:
            truth = solve(system, "dop853", (0.0, 8.0), y0, t_eval=[8.0], rtol=1e-13, atol=1e-14).y[..., -1]
            return float(np.median(np.linalg.norm(y - truth, axis=-1)))

        def end(system: HamiltonianSystem, flow: PrimedFlow, y0: np.ndarray, span: float) -> np.ndarray:
            return solve(system, flow, (0.0, span), y0, t_eval=[span], on_domain_exit="ignore").y[..., -1]

        alone = error(plain, end(plain, flow, y0, 8.0))
        for rate in (0.01, 0.1, 1.0):
            damped, y = with_friction(plain, rate), y0.copy()
            decay = np.concatenate([np.ones(d), np.full(d, np.exp(-rate * flow.dt / 2))])
            for _ in range(round(8.0 / flow.dt)):
                y = decay * end(plain, flow, decay * y, flow.dt)
            drifts = error(damped, end(damped, flow.transferred(damped), y0, 8.0))
            lines.append(f"| `{name}` | {rate:g} | {alone:.1e} | {drifts:.1e} | {error(damped, y):.1e} |")
            print(lines[-1], flush=True)
    return "\n".join(lines)


STARTS = {"pendulum": ((1.0, 3), (0.5, 3)), "henon_heiles": ((1.4, 3), (0.8, 3))}
"""Δt and kicks of the flows that are fitted with friction; all have a processor of six and curvature terms."""


def trained(rate: float, quick: bool) -> str:
    """Flows that are fitted to damped systems against every splitting scheme, at equal error of the state at T = 20."""
    lines = [
        "| scene, target | flow | fit | conformal defect | forces saved | one trajectory | 1000 outputs | batch |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    options = {"restarts": 2, "steps": 20} if quick else {"time_budget": 45.0}
    for name, starts in STARTS.items():
        system = with_friction(getattr(systems, name)(), rate)
        flows = [
            sympflow.train(
                system,
                flow=SympFlow.primed(system, stages, dt=dt, processor=6, curvature=True),
                progress=False,
                **options,
            )
            for dt, stages in starts[: 1 if quick else None]
        ]
        for target in (1e-2,) if quick else (1e-4, 1e-6, 1e-8):
            row = race(Measure(system, "state", 20.0), target, flows, None, 25, 1000, span=100.0 / rate)
            if row is None:
                print(f"{name}: no flow reaches {target:g}", flush=True)
                continue
            flow = next(f for f in flows if row.flow.startswith(f"Δt = {f.dt:g},"))
            defect = sympflow.conformal_defect(solve(system, flow, (0.0, 20.0)))
            cells = [f"{row.faster[kind]:.2f} `{row.rival[kind]}`" for kind in ("one", "outputs", "batch")]
            cells = [f"{row.fit_seconds:.0f} s", f"{defect:.0e}", f"{row.evaluations_saved:.1f}×", *cells]
            lines.append(f"| {name}, γ = {rate:g}, {target:.0e} | {row.flow} | {' | '.join(cells)} |")
            print(lines[-1], flush=True)
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--methods", nargs="*", default=["verlet", "kahan_li8", "chin4c"])
    parser.add_argument("--trained", action="store_true", help="flows that are fitted to damped systems")
    parser.add_argument("--taken-over", action="store_true", help="flows of the systems without friction")
    parser.add_argument("--rate", type=float, default=0.1, help="γ of --trained")
    parser.add_argument("--quick", action="store_true", help="one small fit")
    fragments.add_out(parser)
    asked = parser.parse_args(arguments)
    if asked.taken_over or asked.trained:
        name, table = ("friction-taken-over", taken_over) if asked.taken_over else ("friction-trained", trained)
        table = table if asked.taken_over else partial(trained, asked.rate, asked.quick)
        fragments.write(asked.out, name, table())
        return
    lines = [
        "| system | method | one trajectory, with friction / without | 256 trajectories |",
        "| --- | --- | --- | --- |",
    ]
    for name, (plain, damped) in DAMPED.items():
        for method in asked.methods:
            figures = [
                ratio(plain, damped, method, max(1, asked.steps // (1 if batch == 1 else 10)), batch, asked.rounds)
                for batch in (1, TRAJECTORIES)
            ]
            cells = (f"{r:.2f} (of {ns:.3g} ns a step)" for r, ns in figures)
            lines.append(f"| {name} | `{method}` | {' | '.join(cells)} |")
            print(lines[-1], flush=True)
    fragments.write(asked.out, "friction", "\n".join(lines))


if __name__ == "__main__":
    main()
