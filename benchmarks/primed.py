"""Primed SympFlows against every splitting scheme of the package, and heyoka, at equal error.

    python benchmarks/primed.py                        four scenes: energy error over T = 1000, state error at T = 100
    python benchmarks/primed.py --system pendulum      one of them
    python benchmarks/primed.py --fit --flows folder   flows that are fitted first, and kept in a folder
    python benchmarks/primed.py --driven               driven systems
    python benchmarks/primed.py --ablation             what of a flow and its training pays, on Hénon–Heiles
    python benchmarks/primed.py --quick                the same in miniature
    python benchmarks/primed.py --out docs/measured    with the fragments of docs/primed.md

The flows are those that the package ships, or those in `--flows`. For each target each of them, and each scheme, gets
the fewest steps (for a flow, of at most its Δt and at least a quarter of it) with which the median error over 20
held-out states is no larger; the flow that is then the fastest is the row. In each column the fastest flow is compared
with the fastest scheme. Everything runs in the same compiled loops, in turn, on one thread: one trajectory of which the
end is kept; one of which 1000 outputs are kept, with the processor executed at each; and a batch of 1000. On Kepler's
problem the logarithmic methods (log_leapfrog, log_blanes_moan4, log_kahan_li8) and the flow with a trained clock race
as well, through `solve`, with steps of at most 0.5; the exact linear flows of `linear_*` do not.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import importlib.util
import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

from measuring import fragments
from measuring.race import HELD_OUT_SEED, MOST_FORCES, Measure, Row, Runner, fewest_steps, race, schemes

import sympflow
from sympflow import HamiltonianSystem, SympFlow, systems, time_transformed, train
from sympflow.flow.clocked import ClockedFlow
from sympflow.flow.primed import PrimedFlow
from sympflow.hamiltonian.fingerprint import same_system
from sympflow.training.fits import PrimedFit

TARGETS = (1e-4, 1e-6, 1e-8)
SHIPPED = Path(sympflow.__file__).parent / "pretrained"


@dataclass(frozen=True)
class Scene:
    """A system in the race.

    Attributes
    ----------
    make : callable
    starts : tuple of (PrimedFit, int)
        Starts of trainings, and how many tables their searches begin from.
    """

    make: Callable[[], HamiltonianSystem]
    starts: tuple[tuple[PrimedFit, int], ...]


def primed(dt: float, stages: int, processor: int = 6) -> PrimedFit:
    return PrimedFit(dt, stages=stages, processor=processor)


def driven_starts(*steps: float) -> tuple[tuple[PrimedFit, int], ...]:
    """Starts of a driven system at these Δt."""
    return tuple((PrimedFit(dt, stages=6, processor=8, curvature=True, first="kick"), 8) for dt in steps)


MEASURES = {"energy": 1000.0, "state": 100.0}
FLOWS = {
    "henon_heiles": Scene(
        systems.henon_heiles,
        (
            (primed(1.1, 2), 24),
            (primed(0.65, 2), 24),
            (primed(0.9, 3), 24),
            (primed(0.55, 3), 48),
        ),
    ),
    "pendulum": Scene(
        systems.pendulum,
        (
            (primed(0.8, 1), 24),
            (primed(1.2, 2, 4), 24),
            (primed(0.5, 2), 24),
            (primed(0.5, 3), 48),
        ),
    ),
    "quartic": Scene(
        systems.quartic,
        ((primed(0.8, 2), 24), (primed(0.5, 3), 24), (primed(0.3, 3), 48)),
    ),
    "kepler": Scene(
        systems.kepler,
        ((primed(0.15, 2), 24), (primed(0.1, 3), 24), (primed(0.045, 3), 48)),
    ),
}
DRIVEN = {
    "driven_pendulum": Scene(systems.driven_pendulum, driven_starts(2.0, 1.5, 1.0, 0.8, 0.5, 0.4)),
    "duffing": Scene(
        partial(systems.duffing, damping=0.0, force=0.1, frequency=2.7, alpha=1.0),
        driven_starts(1.5, 1.0, 0.8, 0.5, 0.4),
    ),
}


def fitted(system: HamiltonianSystem, start: PrimedFit, tables: int, folder: Path, **options: Any) -> PrimedFlow:
    """The flow that comes of a start, from the folder if it is there."""
    path = folder / f"{system.name}-{start.dt:g}-{start.stages}-{start.processor}.safetensors"
    if path.exists():
        return sympflow.load(path, system=system)
    flow = train(system, flow=start.flow(system), progress=False, **({"restarts": tables} | options))
    folder.mkdir(parents=True, exist_ok=True)
    flow.save(path)
    return flow


def stored(system: HamiltonianSystem, folder: Path) -> list[PrimedFlow | ClockedFlow]:
    """The primed flows of the system in a folder, and those on its logarithmic Hamiltonian."""
    flows: list[PrimedFlow | ClockedFlow] = []
    for path in sorted(folder.glob(f"{system.name}*.safetensors")):
        flow = sympflow.load(path)
        if isinstance(flow, PrimedFlow) and same_system(flow.fingerprint, system.fingerprint):
            flows.append(flow.bind(system))
        elif isinstance(flow, ClockedFlow) and same_system(
            flow.recipe["transforms"]["fingerprint"], system.fingerprint
        ):
            flows.append(flow.bind(time_transformed(system, flow.recipe["transforms"]["shift"])))
    return flows


def taylor_of(system: HamiltonianSystem) -> Any:
    """heyoka's integrators of the system, None where it is not installed."""
    if importlib.util.find_spec("heyoka") is None:
        return None
    from contenders.heyoka_taylor import Taylor

    return Taylor.of_system(system)


def table(rows: list[Row]) -> str:
    lines = [
        "| system, target | Δt, kicks + processor | fit | error at Δt / at fractional t | forces saved "
        "| one trajectory | heyoka | with 1000 outputs | heyoka | batch of 1000 | heyoka |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        faster = {name: f"{value:.2f}" for name, value in r.faster.items()}
        versus = [
            f"{faster[kind]} ({r.rival[kind]}) | {faster.get(f'heyoka {kind}', '–')}"
            for kind in ("one", "outputs", "batch")
        ]
        lines.append(
            f"| {r.system}, {r.measure} {r.target:.0e} | {r.flow} at {r.dt:.3g} | {r.fit_seconds:.0f} s | "
            f"{r.one_step_error:.1e} / {r.fractional_error:.1e} | {r.evaluations_saved:.1f}× | {' | '.join(versus)} |"
        )
    return "\n".join(lines)


SCENES = {
    "henon_heiles": "Hénon–Heiles",
    "pendulum": "pendulum",
    "quartic": "quartic",
    "kepler": "Kepler, e = 0.6",
    "driven_pendulum": "driven pendulum",
    "duffing": "Duffing, δ = 0",
}


def fragment(rows: list[Row]) -> str:
    """The table of the page: what each scheme and heyoka takes, in times of the flow's time."""
    titles = ["scene, error", "flow: Δt, kicks + processor", "forces saved", "one trajectory: best scheme"]
    lines = []
    for r in rows:
        one, outputs, many = (f"{r.faster[kind]:.2f} {r.rival[kind]}" for kind in ("one", "outputs", "batch"))
        taylor = [r.faster.get(f"heyoka {kind}") for kind in ("one", "batch")]
        heyoka = " / ".join("–" if x is None else f"{x:.1f}" if x < 10 else f"{x:.0f}" for x in taylor)
        target = f"{SCENES[r.system]}, {r.measure} {r.target:.0e}".replace("e-0", "e-")
        scheme, _, dt = r.flow.rpartition("Δt = ")
        flow = f"{dt}, clock" if "clock" in scheme else dt
        lines.append([target, flow, f"{r.evaluations_saved:.1f}", one, outputs, many, heyoka])
    return fragments.table([*titles, "1000 outputs", "batch of 1000", "heyoka: one / batch"], lines)


# ablation ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Variant:
    """A flow and its training that differ from the base in one thing."""

    name: str
    stages: int = 3
    processor: int = 6
    flow: tuple[tuple[str, Any], ...] = ()
    training: tuple[tuple[str, Any], ...] = ()


ABLATION = (
    Variant("as recommended"),
    Variant("no processor", processor=0),
    Variant("a small processor", processor=3),
    Variant("a large processor", processor=9),
    Variant("not palindromic", flow=(("palindromic", False),)),
    Variant("with curvature terms", flow=(("curvature", True),)),
    Variant("no force gradients", flow=(("force_gradient", False),)),
    Variant("no force gradients, twice the kicks", stages=6, flow=(("force_gradient", False),)),
    Variant("labels + matching", training=(("loss", "labels+matching"), ("restarts", 4), ("steps", 30))),
    Variant("labels + residual", training=(("loss", "labels+residual"), ("restarts", 4), ("steps", 30))),
    Variant("residual", training=(("loss", "residual"), ("restarts", 4), ("steps", 30))),
    Variant("residual + matching", training=(("loss", "residual+matching"), ("restarts", 4), ("steps", 30))),
    Variant("energy not weighted", training=(("energy_weight", 0.0),)),
    Variant("Δt weighted 10 times", training=(("frozen_weight", 10.0),)),
)


def ablation(system: HamiltonianSystem, dt: float, variants: tuple[Variant, ...], **options: Any) -> str:
    """The error of each variant with the same Δt, and the forces that it saves at its own energy error."""
    lines = [
        "| variant | numbers | fit | error at Δt / at fractional t | energy error, T = 1000 | forces saved |",
        "|---|---|---|---|---|---|",
    ]
    measure = Measure(system, "energy", MEASURES["energy"])
    for v in variants:
        start = SympFlow.primed(system, v.stages, dt=dt, processor=v.processor, **dict(v.flow))
        flow = train(system, flow=start, progress=False, **(options | dict(v.training)))
        n, runner = round(measure.t_end / dt), Runner.of_flow(flow, system)
        error = measure.of(runner, n)
        needed = []
        for rival in schemes(system):
            most = MOST_FORCES // rival.forces
            steps = fewest_steps(partial(measure.of, rival), error, max(1, 3 * n // rival.forces), 1, most)
            needed += [] if steps is None else [steps * rival.forces]
        saved = f"{min(needed) / (n * runner.forces):.1f}×" if needed else "–"
        f = flow.figures
        lines.append(
            f"| {v.name} | {flow.n_parameters} | {f['training_seconds']:.0f} s | {f['one_step_error']:.1e} / "
            f"{f['fractional_error']:.1e} | {error:.1e} | {saved} |"
        )
        print(lines[-1], flush=True)
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = [*FLOWS, *DRIVEN]
    parser.add_argument("--system", action="append", choices=known, help="all four, or of --driven two, if not given")
    parser.add_argument("--driven", action="store_true", help="driven systems")
    parser.add_argument("--ablation", action="store_true")
    parser.add_argument("--quick", action="store_true", help="small fits, short intervals")
    parser.add_argument(
        "--flows", type=Path, default=SHIPPED, help="folder of the flows; the package's own if left out"
    )
    parser.add_argument("--fit", action="store_true", help="fit the flows that are not there, and keep them")
    parser.add_argument("--fit-seconds", type=float, help="time budget of a fit")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--batch", type=int, default=1000)
    parser.add_argument("--json", type=Path, help="file for the rows; those that are in it are not run")
    parser.add_argument("--seed", type=int, default=HELD_OUT_SEED, help="of the held-out states")
    fragments.add_out(parser)
    print(run(parser.parse_args()))


def rows_of(
    name: str, scene: Scene, options: argparse.Namespace, quick: dict[str, Any], done: list[Row]
) -> Iterator[Row]:
    """The rows of a system that are not done, by its flows that ship, or others."""
    system = scene.make().with_scene(name=name)
    if options.fit:
        starts = scene.starts[: 1 if options.quick else None]
        flows = [fitted(system, start, tables, options.flows, **quick) for start, tables in starts]
    else:
        flows = stored(system, options.flows)
    if not flows:
        print(f"{name}: no flows in the folder; fit some with --fit", flush=True)
        return
    taylor = taylor_of(system) if system.autonomous else None
    for measure, t_end in (MEASURES if not options.quick else {"energy": 20.0, "state": 5.0}).items():
        over = Measure(system, measure, t_end, options.seed)
        for target in TARGETS if not options.quick else (1e-2,):
            if any((row.system, row.measure, row.target) == (name, measure, target) for row in done):
                continue
            row = race(over, target, flows, taylor, options.repeats, options.batch)
            if row is None:
                print(f"{name}: no flow reaches {measure} {target:g}", flush=True)
                continue
            print(table([row]).splitlines()[-1], flush=True)
            yield row


def run(options: argparse.Namespace) -> str:
    quick: dict[str, Any] = {"restarts": 2, "steps": 10, "points": 60, "reference_states": 20} if options.quick else {}
    if options.fit_seconds:
        quick["time_budget"] = options.fit_seconds
    if options.ablation:
        system = getattr(systems, (options.system or ["henon_heiles"])[0])()
        found = ablation(system, 0.6, ABLATION[:3] if options.quick else ABLATION, **quick)
        fragments.write(options.out, "primed-ablation", found)
        return found
    scenes, name = (DRIVEN, "primed-driven") if options.driven else (FLOWS, "primed-race")
    kept = options.json is not None and options.json.exists()
    rows = [Row(**row) for row in json.loads(options.json.read_text(encoding="utf-8"))] if kept else []
    for system in options.system or scenes:
        for row in rows_of(system, scenes[system], options, quick, list(rows)):
            rows.append(row)
            if options.json:
                options.json.write_text(json.dumps([asdict(row) for row in rows], indent=1), encoding="utf-8")
    rows.sort(key=lambda row: [*scenes].index(row.system))
    clocked = [row for row in rows if row.system == "kepler"]
    others = [row for row in rows if row.system != "kepler"]
    for own, title, section in ((others, name, ""), (clocked, "primed-clock", "--system kepler")):
        if own:
            fragments.write(options.out, title, fragment(own), section)
    return "\n" + table(rows)


if __name__ == "__main__":
    main()
