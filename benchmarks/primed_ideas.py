"""Ways on from a primed flow: other kicks, a weight of the energy, an orbit's tube, a small network, more kicks.

    python benchmarks/primed_ideas.py             all of them: half an hour on one core
    python benchmarks/primed_ideas.py --quick     tiny fits
    python benchmarks/primed_ideas.py --idea tube

*Curvature.* The same flow fitted with and without curvature terms, on four systems; the cost is the processor time of a
compiled step, of Δt each.

*Polynomials.* The same, for polynomials in place of force gradients: once the search begins at the flow that has these,
once it has starts of its own.

*Energy.* The same flow fitted with several weights of the energy.

*Tube.* On Hénon–Heiles, a flow of 3 kicks, a processor of 6 and Δt = 1 is fitted to the tube of radius 0.03 around one
orbit in place of the whole well, for three orbits, and its largest energy error over T = 1000 along that orbit stands
beside that of the same flow fitted to the well, with as many starts.

*Network.* To that flow of the well, whose numbers stay, a kick and a drift with small MLP potentials are appended,
which start as the identity and are trained by Gauss–Newton on labels. The one-step error over held-out states, and the
median energy error over T = 1000, stand beside those without them. The cost is the processor time of a compiled step of
the kernel, plus that of the same kick and drift alone: too little, as such a composition has no processor that
telescopes.

*Spacing.* On the FPUT-β chain flows of several kicks, all with force gradients, and a processor of 12 are fitted at the
same time between two kicks. Their energy errors are medians over 20 states of 256 sites up to T = 100.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

import numpy as np
import torch
from measuring import fragments

from sympflow import HamiltonianSystem, LatticeStates, SympFlow, Tube, max_energy_error, solve, systems, train
from sympflow.flow.layers import Drift, Kick
from sympflow.flow.potentials import MLPPotential
from sympflow.flow.primed import PrimedFlow
from sympflow.training.fits import PrimedFit
from sympflow.training.shipped.judges import one_step_errors

IDEAS = ("curvature", "polynomial", "energy", "tube", "network", "spacing")
DT, STAGES, PROCESSOR = 1.0, 3, 6
RADIUS, T_END = 0.03, 1000.0
ORBITS = {
    "near the periodic orbit along q1": [0.0, 0.1, 0.35, 0.0],
    "regular": [0.1, -0.2, 0.2, 0.3],
    "chaotic, the scene's own": [0.3, -0.3, 0.3, 0.15],
}
CURVATURE = {  # kicks, processor, Δt and, if it is not leapfrog, the scheme to start from
    "henon_heiles": (3, 6, 1.2, None),
    "pendulum": (3, 6, 1.5, None),
    "quartic": (3, 6, 0.6, None),
    "quartic, from srkn6b": (6, 8, 0.6, "srkn6b"),
    "kepler": (3, 6, 0.15, None),
}
POLYNOMIALS = {  # kicks, processor, Δt, what a step begins with, and the degree
    "quartic": (3, 6, 0.6, "drift", 6),
    "quartic, 4 kicks": (4, 8, 0.6, "kick", 6),
    "henon_heiles": (3, 6, 1.0, "drift", 4),
}
WEIGHTS = (0.0, 10.0, 1000.0)
WEIGHTED = {"henon_heiles": (3, 6, 1.0), "pendulum": (3, 6, 1.0), "quartic": (3, 6, 0.6)}  # kicks, processor, Δt
SPACINGS, KICKS, LARGE = (0.25, 0.3, 0.35), (2, 3, 4), 12
HELD_OUT, SEED = 100, 20_261_121
FULL = {"restarts": 8}
QUICK = {"restarts": 1, "steps": 5, "points": 40, "reference_states": 10}


def fitted(system: HamiltonianSystem, domain: Any = None, **options: Any) -> PrimedFlow:
    start = SympFlow.primed(system, STAGES, dt=DT, processor=PROCESSOR)
    return train(system, flow=start, domain=domain, progress=False, **options)


def energy_error(system: HamiltonianSystem, flow: SympFlow, y0: Any, t_end: float) -> float:
    """The median over the states of the largest relative one."""
    steps = round(t_end / flow.dt)
    sol = solve(system, flow, (0.0, steps * flow.dt), np.asarray(y0, float), save_every=1, on_domain_exit="ignore")
    return float(np.median(max_energy_error(sol)))


def curvature(t_end: float, scenes: Any, **options: Any) -> str:
    """The gain by the term in t⁵, and its cost."""
    lines = [
        "| system | Δt, kicks + processor | curvature | error at Δt / at fractional t | energy error | µs a step |",
        "|---|---|---|---|---|---|",
    ]
    for name in scenes:
        stages, processor, dt, scheme = CURVATURE[name]
        system = getattr(systems, name.partition(",")[0])()
        for terms in (False, True):
            first = {"stages": stages} if scheme is None else {"scheme": scheme}
            start = SympFlow.primed(system, **first, dt=dt, processor=processor, curvature=terms)
            flow = train(system, flow=start, progress=False, **options)
            lines.append(row(system, flow, t_end, name, f"{dt:g}, {stages} + {processor}", "yes" if terms else "no"))
    return "\n".join(lines)


def row(system: HamiltonianSystem, flow: PrimedFlow, t_end: float, *cells: str) -> str:
    """A line of a table, which is printed: the cells, then how near the flow comes, and what a step costs."""
    f, error = flow.figures, energy_error(system, flow, system.domain.sample(20, SEED), t_end)  # type: ignore[union-attr]
    found = f"{f['one_step_error']:.1e} / {f['fractional_error']:.1e} | {error:.1e} | {microseconds(system, flow):.4f}"
    print(line := f"| {' | '.join(cells)} | {found} |", flush=True)
    return line


def polynomial(t_end: float, scenes: Any, **options: Any) -> str:
    """The gain by polynomials in place of force gradients, and their cost."""
    lines = [
        "| system | Δt, kicks + processor | kicks | error at Δt / at fractional t | energy error | µs a step |",
        "|---|---|---|---|---|---|",
    ]
    for name in scenes:
        stages, processor, dt, first, degree = POLYNOMIALS[name]
        system = getattr(systems, name.partition(",")[0])()
        shape = f"{dt:g}, {stages} + {processor}"
        start = PrimedFit(dt, stages=stages, processor=processor, first=first)
        fit: dict[str, Any] = {"restarts": 12, "progress": False, **options}
        plain = train(system, flow=start.flow(system), **fit)
        bent = replace(start, polynomial=degree)
        kinds = {
            "force gradients": plain,
            f"degree {degree}, from these": train(
                system, flow=bent.flow(system, earlier=plain), **(fit | {"restarts": 1})
            ),
            f"degree {degree}": train(system, flow=bent.flow(system), **fit),
        }
        lines += [row(system, flow, t_end, name, shape, kind) for kind, flow in kinds.items()]
    return "\n".join(lines)


def energy(t_end: float, scenes: Any, **options: Any) -> str:
    """The gain by a weight of the energy."""
    lines = [
        "| system | Δt, kicks + processor | weight | error at Δt / at fractional t | energy error | µs a step |",
        "|---|---|---|---|---|---|",
    ]
    for name in scenes:
        stages, processor, dt = WEIGHTED[name]
        system = getattr(systems, name)()
        for weight in WEIGHTS:
            start = SympFlow.primed(system, stages, dt=dt, processor=processor)
            flow = train(system, flow=start, progress=False, energy_weight=weight, **options)
            lines.append(row(system, flow, t_end, name, f"{dt:g}, {stages} + {processor}", f"{weight:g}"))
    return "\n".join(lines)


def tube(system: HamiltonianSystem, well: PrimedFlow, t_end: float, **options: Any) -> str:
    """The gain along one orbit by a fit to its surroundings."""
    lines = ["| orbit | fitted to the well | fitted to its tube | times less |", "|---|---|---|---|"]
    for name, y0 in ORBITS.items():
        orbit = solve(system, "kahan_li8", (0.0, t_end), y0, dt=0.02, save_every=5).states
        own = fitted(system, Tube(orbit[:5000], RADIUS), **options)
        errors = [energy_error(system, flow, y0, t_end) for flow in (well, own)]
        lines.append(f"| {name} | {errors[0]:.1e} | {errors[1]:.1e} | {errors[0] / errors[1]:.1f} |")
        print(lines[-1], flush=True)
    return "\n".join(lines)


def with_network(well: PrimedFlow, hidden: tuple[int, ...]) -> SympFlow:
    """ψ̄ of the well, then a kick and a drift with MLP potentials that are 0; only their weights are trained."""
    generator = torch.Generator().manual_seed(0)
    potentials = [MLPPotential(well.ndof, hidden, tau=well.dt, generator=generator) for _ in range(2)]
    with torch.no_grad():
        for potential in potentials:
            potential.weight_out.mul_(1e-6)
    flow = SympFlow.from_layers([*well.layers, Kick(potentials[0]), Drift(potentials[1])], well.dt)
    flow.fingerprint, flow.system_name = well.fingerprint, well.system_name
    return flow


def microseconds(system: HamiltonianSystem, flow: SympFlow) -> float:
    """Processor time of a compiled step."""
    n = 20_000
    solve(system, flow, (0.0, 10 * flow.dt), save_every=10)
    begin = time.process_time()
    solve(system, flow, (0.0, n * flow.dt), save_every=n, on_domain_exit="ignore")
    return 1e6 * (time.process_time() - begin) / n


def network(system: HamiltonianSystem, well: PrimedFlow, t_end: float, sizes: Any, **options: Any) -> str:
    """The gain by a kick and a drift with MLP potentials, and their cost."""
    assert system.domain is not None
    x = system.domain.sample(HELD_OUT, SEED)
    alone = microseconds(system, well)
    at_dt, between = one_step_errors(well, system, x)
    error = energy_error(system, well, x[:20], t_end)
    lines = [
        "| on top | weights | error at Δt / at fractional t | energy error | µs a step |",
        "|---|---|---|---|---|",
        f"| nothing | 0 | {at_dt:.1e} / {between:.1e} | {error:.1e} | {alone:.2f} |",
    ]
    print(lines[-1], flush=True)
    for hidden in sizes:
        flow = train(system, flow=with_network(well, hidden), progress=False, **options)
        at_dt, between = one_step_errors(flow, system, x)
        bare = SympFlow(system.ndof, 1, hidden, dt=well.dt)  # the same kick and drift, compiled
        cost = alone + microseconds(system, bare)
        lines.append(
            f"| a kick and a drift, {hidden} | {flow.n_parameters} | {at_dt:.1e} / {between:.1e} | "
            f"{energy_error(system, flow, x[:20], t_end):.1e} | {cost:.2f} |"
        )
        print(lines[-1], flush=True)
    return "\n".join(lines)


def spacing(t_end: float, spacings: Sequence[float], kicks: Sequence[int], n: int = 256, **options: Any) -> str:
    """How the error goes with the time between two kicks, whatever their number in a step."""
    system = HamiltonianSystem.lattice(bond="r**2/2 + r**4/4", shape=n, domain=LatticeStates((0.02, 0.2)))
    assert system.domain is not None
    y0 = system.domain.sample(20, SEED)
    lines = [f"| kicks | {' | '.join(f'{h:g}' for h in spacings)} |", "|---|" + "---|" * len(spacings)]
    for stages in kicks:
        errors = []
        for h in spacings:
            start = SympFlow.primed(system, stages, dt=h * stages, processor=LARGE)
            flow = train(system, flow=start, progress=False, energy_weight=300.0, **options)
            errors.append(f"{energy_error(system, flow, y0, t_end):.1e}")
        lines.append(f"| {stages} | {' | '.join(errors)} |")
        print(lines[-1], flush=True)
    return "\n".join(lines)


def run(ideas: list[str], quick: bool) -> dict[str, str]:
    """The tables by their ideas."""
    system = systems.henon_heiles()
    options = QUICK if quick else FULL
    t_end = 20.0 if quick else T_END
    tables = {}
    if "curvature" in ideas:
        tables["curvature"] = curvature(t_end, ("pendulum",) if quick else CURVATURE, **options)
    if "polynomial" in ideas:
        tables["polynomial"] = polynomial(t_end, ("quartic",) if quick else POLYNOMIALS, **options)
    if "energy" in ideas:
        tables["energy"] = energy(t_end, ("pendulum",) if quick else WEIGHTED, **options)
    if "spacing" in ideas:
        tables["spacing"] = spacing(
            min(t_end, 100.0), SPACINGS[:1] if quick else SPACINGS, KICKS[: 1 if quick else None], **options
        )
    if not {"tube", "network"} & set(ideas):
        return tables
    well = fitted(system, **options)
    if "tube" in ideas:
        tables["tube"] = tube(system, well, t_end, **options)
    if "network" in ideas:
        gauss_newton: dict[str, Any] = {"optimizer": "gauss-newton", "loss": "labels"}
        gauss_newton |= {"steps": 3, "points": 40} if quick else {"steps": 100, "points": 200}
        tables["network"] = network(system, well, t_end, ((4,),) if quick else ((5,), (10,), (10, 10)), **gauss_newton)
    return tables


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--idea", action="append", choices=IDEAS, help="all if none is named")
    parser.add_argument("--quick", action="store_true", help="tiny fits, short runs")
    fragments.add_out(parser)
    options = parser.parse_args()
    torch.set_num_threads(1)
    for idea, table in run(options.idea or list(IDEAS), options.quick).items():
        print("\n" + table)
        fragments.write(options.out, f"ideas-{idea}", table, f"--idea {idea}")


if __name__ == "__main__":
    main()
