"""Stiff systems: the FPUT chain and the spring pendulum, by every method and by the shipped flows.

    python benchmarks/stiff.py --out docs/measured     both frequencies of FPUT, the pendulum, the oscillator
    python benchmarks/stiff.py --only fput --omega 50

FPUT runs over T = 200 from y0; energy errors are the largest of 1000 instants, |I − 1| of 20,000. Of the splitting
schemes with the exact linear flow (every table of the package, with the drift replaced) the cheapest is sought that has
an error of at most 1e-4, and the cheapest that is as good as the flow;
they are then timed against it in turn, on one thread, by processor time:
of a whole call of `solve` with 1000 outputs, which for a flow checks its domain as well, and of the compiled loops.
Radau and DOP853 are SciPy's, over the interval stated.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

import numpy as np
from measuring import fragments
from measuring.compiled import flow_loops, method_loops
from measuring.fragments import table
from scipy.integrate import solve_ivp

from sympflow import HamiltonianSystem, SympFlow, get, solve, systems
from sympflow.flow.shipped import shipped
from sympflow.schemes import SCHEMES
from sympflow.systems import oscillatory_energies

T_END, INSTANTS = 200.0, 1000
DENSE = 20_000  # instants at which I is compared: it oscillates fast, and a thousand miss its largest values
GOAL = 1e-4
PHASES = 23  # at which the flow is looked at between its steps
IMPLICIT_TIME = {50.0: 200.0, 1000.0: 2.0}  # what SciPy's methods can be waited for


@dataclass(frozen=True)
class Run:
    """A method with its step: its cost and its errors; `call` runs it once more."""

    name: str
    turn: float | None  # h ω
    forces: int
    hessians: int
    energy_error: float
    invariant_error: float
    call: Callable[[], Any] | None = None
    loops: Callable[[], Any] | None = None
    seconds: float = float("nan")
    note: str = ""


def cpu_seconds(calls: list[Callable[[], Any]], repeats: int) -> list[float]:
    """Median processor time of each call on this thread, the repeats interleaved: others' work does not count."""
    seconds = np.empty((repeats, len(calls)))
    for r in range(repeats):
        for i, call in enumerate(calls):
            begin = time.thread_time()
            call()
            seconds[r, i] = time.thread_time() - begin
    return np.median(seconds, axis=0).tolist()


def errors(system: HamiltonianSystem, y: np.ndarray) -> tuple[float, float]:
    """The largest relative energy error of states (n, 2d), and |I − 1|."""
    with np.errstate(all="ignore"):
        H = system.hamiltonian(y)
        I = oscillatory_energies(system, y).sum(-1)  # noqa: E741
        energy, invariant = np.abs(H / H[0] - 1).max(), np.abs(I - 1).max()
    return tuple(float(v) if np.isfinite(v) else np.inf for v in (energy, invariant))  # type: ignore[return-value]


def dense_invariant(r: Run) -> float:
    """The largest |I − 1| of 20,000 instants, between steps too."""
    if not isinstance(r.call, partial):
        return r.invariant_error
    system = r.call.args[0]
    sol = r.call.func(*r.call.args, t_eval=np.linspace(0, T_END, DENSE + 1), on_domain_exit="ignore")
    return errors(system, sol.y.T)[1] if len(sol.t) > DENSE else np.inf


def run_scheme(system: HamiltonianSystem, method: Any, n: int) -> Run:
    """n steps over T, 1000 outputs on the grid."""
    save = np.linspace(0, n, INSTANTS + 1).round().astype(np.int64)
    loops = partial(method_loops(system, method), T_END / n, system.y0, n, save)
    call = partial(solve, system, replace(method, dt=T_END / n), t_eval=np.minimum(T_END / n * save, T_END))
    scheme = method.scheme
    forces, hessians = n * scheme.force_evaluations, n * scheme.hessian_evaluations
    turn = T_END / n * system.params["omega"]
    return Run(method.name, turn, forces, hessians, *errors(system, loops()[0]), call, loops)


def run_flow(system: HamiltonianSystem, flow: Any) -> Run:
    n = round(T_END / flow.dt)
    save = np.linspace(0, n, INSTANTS + 1).round().astype(np.int64)
    loops = partial(flow_loops(system, flow).one, flow.dt, system.y0, n, save)
    call = partial(solve, system, flow, t_eval=np.minimum(flow.dt * save, T_END))
    counts = flow.evaluations(n, 0, 0, "compiled")
    turn = flow.dt * system.params["omega"]
    cost = counts["force_evaluations"], counts["hessian_evaluations"]
    return Run(f"**SympFlow** ({cost[0] // n} stages)", turn, *cost, *errors(system, loops()[0]), call, loops)


def candidates(system: HamiltonianSystem) -> list[Run]:
    """Every scheme at many steps, and those that the goal or less needs."""
    omega, runs = system.params["omega"], []
    for name in SCHEMES:
        method = get(name)(splitting="linear")
        for turn in np.geomspace(1.2, 6.0, 15) if omega <= 50 else np.geomspace(1.5, 14.0, 18):
            n = INSTANTS * max(1, round(T_END * omega / turn / INSTANTS))
            runs.append(run_scheme(system, method, n))
    return runs


def cheapest(runs: list[Run], goal: float) -> Run | None:
    """The fastest of the runs that reach the goal: the few with least evaluations are timed."""
    good = sorted((r for r in runs if r.energy_error <= goal), key=lambda r: r.forces + r.hessians)[:6]
    if not good:
        return None
    return good[int(np.argmin(cpu_seconds([r.call for r in good], 9)))]  # type: ignore[misc]


def adaptive(system: HamiltonianSystem, name: str, t_end: float) -> Run:
    """SciPy's Radau and DOP853 at rtol = 1e-6."""
    t = np.linspace(0, t_end, DENSE + 1)
    begin = time.thread_time()
    sol = solve_ivp(system, (0.0, t_end), system.y0, name, t_eval=t, rtol=1e-6, atol=1e-9)
    seconds = time.thread_time() - begin
    note = "" if t_end == T_END else f"T = {t_end:g}"
    return Run(f"SciPy {name}", None, sol.nfev, 0, *errors(system, sol.y.T), seconds=seconds, note=note)


def verlet(system: HamiltonianSystem, turn: float) -> Run:
    h = turn / system.params["omega"]
    n = INSTANTS * round(T_END / h / INSTANTS)
    call = partial(solve, system, get("verlet")(dt=T_END / n), t_eval=np.linspace(0, T_END, INSTANTS + 1))
    sol = call()
    found = errors(system, sol.y.T) if len(sol.t) > INSTANTS else (np.inf, np.inf)
    return Run("verlet", T_END / n * system.params["omega"], n, 0, *found, call)


def fput_section(omega: float, repeats: int) -> dict[str, str]:
    """The table of all methods, that of the flow against the fastest, and what else a flow costs and errs."""
    system = systems.fput(omega=omega)
    flow = shipped(system)
    ours = run_flow(system, flow)
    n_flow = round(T_END / flow.dt)
    tried = candidates(system)
    rows = [adaptive(system, name, IMPLICIT_TIME.get(omega, 2.0)) for name in ("Radau", "DOP853")]
    rows += [verlet(system, turn) for turn in (0.05, 1.0)]
    for label in (
        "impulse",
        "mollified_impulse",
        "implicit_explicit",
        "linear_srkn6b",
        "linear_srkn11b",
        "linear_srkn14a",
    ):
        n = n_flow if omega > 50 else 2 * n_flow
        rows.append(replace(run_scheme(system, get(label)(), n), name=label))
    best = [(goal, cheapest(tried, goal)) for goal in (GOAL, max(ours.energy_error, 1e-12))]
    labels = ("fastest untrained of all, to 1e-4", "fastest untrained of all, as good as the flow")
    for label, (_, run) in zip(labels, best, strict=True):
        if run is not None:
            rows.append(replace(run, name=f"{label}: linear {run.name}"))
    rows.append(ours)
    timed = [r for r in rows if r.call is not None]
    medians = cpu_seconds([r.call for r in timed], repeats)  # type: ignore[misc]
    seconds = {id(r): s for r, s in zip(timed, medians, strict=True)}
    looped = [r for r in rows if r.loops is not None]
    bare = {id(r): s for r, s in zip(looped, cpu_seconds([r.loops for r in looped], repeats), strict=True)}  # type: ignore[misc]
    lines = []
    for r in rows:
        spent = seconds.get(id(r), r.seconds)
        turn = "adaptive" if r.turn is None else f"{r.turn:.3g}"
        ratio = "" if r.note else f"{spent / seconds[id(ours)]:.3g}"
        loops = [f"{bare[id(r)] * 1e3:.3g}", f"{bare[id(r)] / bare[id(ours)]:.3g}"] if id(r) in bare else ["", ""]
        name = f"{r.name}, {r.note}" if r.note else r.name
        work = [turn, f"{r.forces:,}", f"{r.hessians:,}", f"{spent * 1e3:.3g}", ratio, *loops]
        lines.append([name, *work, _error(r.energy_error), _error(dense_invariant(r))])
    against = [["the flow", f"{ours.forces + ours.hessians:,}", "1", "1"]]
    for label, (_, run) in zip(labels, best, strict=True):
        if run is not None:
            r = next(r for r in rows if r.call is run.call)
            ratios = [f"{of[id(r)] / of[id(ours)]:.2f}" for of in (seconds, bare)]
            against.append([f"{label}: linear {run.name}", f"{run.forces + run.hessians:,}", *ratios])
    unchecked, checked = cpu_seconds([partial(_without_domain, ours), ours.call], repeats)
    share = 1 - unchecked / checked
    beside = [
        ["share of a call that the check of its domain takes", f"{100 * share:.0f} %" if share > 0.03 else "< 3 %"],
        [f"largest energy error between the steps, at {PHASES} phases", f"{between_steps(system, flow):.2g}"],
    ]
    timings = ["`solve`, ms", "over the flow's", "loops alone, ms", "over the flow's"]
    errors_of = ["energy error", "\\|I − 1\\|"]
    name = f"stiff-fput-{omega:g}"
    return {
        name: table(["method", "hω", "forces", "force gradients", *timings, *errors_of], lines),
        f"{name}-against": table(["method", "evaluations", "`solve`, over the flow's", "loops"], against),
        f"{name}-flow": table(["the flow", ""], beside),
    }


def _without_domain(run: Run) -> Any:
    call = run.call
    assert isinstance(call, partial)
    return call.func(*call.args, **call.keywords, on_domain_exit="ignore")


def between_steps(system: HamiltonianSystem, flow: Any) -> float:
    """The largest relative energy error of outputs between the steps."""
    worst = 0.0
    for phase in (np.arange(PHASES) + 0.9) / PHASES:
        sol = solve(system, flow, (0.0, T_END), t_eval=flow.dt * (np.arange(round(T_END / flow.dt)) + phase))
        worst = max(worst, errors(system, np.concatenate([system.y0[None], sol.y.T]))[0])
    return worst


def _error(value: float) -> str:
    return f"{value:.2g}" if np.isfinite(value) else "not finite"


def pendulum_section() -> dict[str, str]:
    """Energy errors of the spring pendulum, k = 1e6, T = 20, relative to |H(y0)|."""
    lines = []
    k = 1e6
    cases = [("verlet", "cartesian", 0.1), ("implicit_midpoint", "cartesian", 10.0)]
    cases += [(m, "polar", 10.0) for m in ("strang_parts", "suzuki4_parts", "kahan_li6_parts", "sympflow")]
    for method, coordinates, turn in cases:
        found = []
        for radial in (0.0, 0.5):
            system = systems.spring_pendulum(k, coordinates, radial_energy=radial)
            sol = solve(system, method, (0.0, 20.0), dt=turn / np.sqrt(k), on_domain_exit="ignore")
            H = sol.energy()
            found.append(_error(float(np.abs(H / H[0] - 1).max())) if sol.success else f"status −1: {sol.message[:40]}")
        lines.append([method, coordinates, f"{turn:g}", *found])
    titles = ["method", "coordinates", "h√k", "slow manifold", "fast mode excited"]
    return {"stiff-pendulum": table(titles, lines)}


TURNS = {
    "20": 20.0,
    "1000": 1e3,
    "π": np.pi,
    "π/2": np.pi / 2,
    "π/3": np.pi / 3,
    "2π/5": 2 * np.pi / 5,
    "π/4": np.pi / 4,
    "π/6": np.pi / 6,
    "π/2 + 1e-6": np.pi / 2 + 1e-6,
    "π/3 + 1e-6": np.pi / 3 + 1e-6,
}


def oscillator_section() -> dict[str, str]:
    """Energy errors of a linear layer over a million steps, and the change a step that is left after many."""
    lines = []
    for omega in (1.0, 1e3, 1e6):
        for turn in (20.0, 1e3):
            system = systems.harmonic_oscillator(omega)
            flow = SympFlow.split(system, 1, dt=turn / omega)
            sol = solve(system, flow, (0.0, 1e6 * flow.dt), save_every=100)
            lines.append([f"{omega:g}", f"{turn:g}", f"{np.abs(sol.energy_error()).max():.1e}"])
    changes = []
    y0 = np.random.default_rng(1).normal(size=(8, 2))
    for name, turn in TURNS.items():
        cells = []
        for n, backend in ((10**7, "compiled"), (10**5, "array")):
            system = systems.harmonic_oscillator()
            sol = solve(system, "impulse", (0.0, n * turn), y0, dt=turn, t_eval=[n * turn], backend=backend)
            cells.append(f"{np.abs(sol.energy_error()).max() / n:.1e}")
        changes.append([name, *cells])
    return {
        "stiff-oscillator": table(["ω", "hω", "largest relative energy error"], lines),
        "stiff-oscillator-change": table(["hω", "compiled, 1e7 steps", "arrays, 1e5 steps"], changes),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="Stiff systems")
    parser.add_argument("--only", choices=("fput", "pendulum", "oscillator"))
    parser.add_argument("--omega", type=float, action="append")
    parser.add_argument("--repeats", type=int, default=15)
    fragments.add_out(parser)
    options = parser.parse_args()
    measured: list[tuple[str, Callable[[], dict[str, str]]]] = []
    if options.only in (None, "fput"):
        for omega in options.omega or (50.0, 1000.0):
            measured.append((f"fput --omega {omega:g}", partial(fput_section, omega, options.repeats)))
    if options.only in (None, "pendulum"):
        measured.append(("pendulum", pendulum_section))
    if options.only in (None, "oscillator"):
        measured.append(("oscillator", oscillator_section))
    for section, measure in measured:
        for name, body in measure().items():
            print(f"\n{name}\n\n{body}", flush=True)
            fragments.write(options.out, name, body, f"--only {section}")


if __name__ == "__main__":
    main()
