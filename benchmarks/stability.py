"""Every method where things break: the fragments of docs/stability.md and its figures.

python benchmarks/stability.py --out docs/measured                          ten minutes or so, on one thread
python benchmarks/stability.py --out docs/measured --only kepler,round_off  the named sections alone
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

import numpy as np
from measuring.fragments import add_out, number, table, write

import sympflow
from sympflow import HamiltonianSystem, energy_growth, get, max_energy_error, solve, stability, systems
from sympflow.integrators.flows import LogSympFlow
from sympflow.metrics.linear_stability import linear_stability
from sympflow.schemes import SCHEMES
from sympflow.studies.attempts import Row
from sympflow.studies.step_stability import StabilityReport
from sympflow.systems import oscillatory_energies

CLASSICAL = ("verlet", "leapfrog", "blanes_moan4", "srkn11b", "kahan_li8", "implicit_midpoint", "gauss_legendre4")
LINEAR = ("impulse", "mollified_impulse", "implicit_explicit", "linear_srkn14a")
ADAPTIVE = ("rk45", "dop853")
PYTHAGOREAN = [6.933464, 20.261804, -2.003006, -6.872463, -2.557673, -6.659112]
SINGULARITY = 5.450984210235402

Fragments = dict[str, str]
"""The tables of a section by their names."""

Section = Callable[[Path], Fragments]
"""Measures a section; its figures go into the folder that it is given."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help=f"comma-separated sections to measure, of {', '.join(SECTIONS)}")
    add_out(parser)
    arguments = parser.parse_args()
    chosen = arguments.only.split(",") if arguments.only else list(SECTIONS)
    if unknown := set(chosen) - set(SECTIONS):
        parser.error(f"no section {', '.join(sorted(unknown))}: choose of {', '.join(SECTIONS)}")
    with tempfile.TemporaryDirectory() as folder:
        figures = Path(folder) if arguments.out is None else arguments.out.parent / "figures"
        for section in chosen:
            start = time.perf_counter()
            for name, body in SECTIONS[section](figures).items():
                print(f"\n{name}\n\n{body}", flush=True)
                write(arguments.out, f"stability-{name}", body, f"--only {section}")
            print(f"\n{section}: {time.perf_counter() - start:.0f} s", flush=True)


# scenes ---------------------------------------------------------------------------------------------------


def flows(system: HamiltonianSystem) -> list[Any]:
    """The flows that ship for a system: the cheapest and the most accurate."""
    found = list(sympflow.shipped_flows(system, "sympflow"))
    ends = found if len(found) < 3 else [found[0], found[-1]]
    loaded = [flow.load(system) for flow in ends]
    return [(f"sympflow, Δt = {flow.dt:g}{f' #{i}' if i > 1 else ''}", flow) for i, flow in enumerate(loaded, 1)]


def scene(
    system: HamiltonianSystem, methods: Sequence[Any], factors: Sequence[float] = (1.0, 4.0, 16.0), **options: Any
) -> str:
    """The table of one scene: its trained flows and the methods, at multiples of the system's step."""
    steps = [system.dt * f for f in factors]
    own = flows(system)
    reports = [stability(system, methods, steps=steps, metrics=("energy", "drift", "domain"), **options)]
    if own:
        reports.append(stability(system, own, metrics=("energy", "drift", "domain"), **options))
    rows = [row for report in reports for row in lines(report)]
    titles = ["method", "longest stable step", "step", "steps", "energy error", "drift per unit t", "what happens"]
    missing = [(r.label, r.reason) for report in reports for r in report.rows if r.status == "not applicable"]
    notes = "".join(f"\n\n`{label}` does not apply: {reason}" for label, reason in dict(missing).items())
    return table(titles, rows) + notes


def lines(report: StabilityReport) -> list[list[str]]:
    limits = {(x.label, x.dtype): x for x in report.limits}
    seen: set[str] = set()
    found = []
    for row in report.rows:
        if row.status == "not applicable":
            continue
        limit = limits.get((row.label, row.dtype))
        longest = ""
        if limit is not None and row.label not in seen:
            longest = limit.reached if limit.reached.startswith("none") else ""
            longest = longest or ("none found" if limit.stable is None else f"{limit.stable:.4g}")
            longest += f" ({limit.reached})" if limit.reached.startswith("all") else ""
        seen.add(row.label)
        drift = "" if row.energy_drift is None else f"{number(row.energy_drift)} ± {number(row.energy_drift_error, 0)}"
        step = "adaptive" if row.dt is None else f"{row.dt:.4g}"
        found.append(
            [row.label, longest, step, f"{row.n_steps or 0:,}", number(row.energy_error), drift, happening(row)]
        )
    return found


def happening(row: Row) -> str:
    parts = []
    if row.blow_up is not None:
        parts.append(f"{'singular' if row.singular else 'ends'} at t = {row.blow_up:.6g}")
    elif row.status == "unstable":
        parts.append("energy lost")
    if row.domain_exit is not None:
        parts.append(f"leaves Ω at t = {row.domain_exit:.4g}")
    return ", ".join(parts)


# sections -------------------------------------------------------------------------------------------------


def linear_limit(figures: Path) -> Fragments:
    """Verlet's and leapfrog's bounds over 1e5 steps, and the limits that `stability` finds."""
    rows = []
    for method in ("verlet", "leapfrog"):
        for omega in (1.0, 1e3, 1e6):
            system = systems.harmonic_oscillator(omega)
            (limit,) = stability(system, [method], steps=[1 / omega, 3 / omega], metrics=("energy",)).limits
            cells = []
            for z in (0.1, 1.0, 1.9, 1.99):
                error = max_energy_error(solve(system, method, (0.0, 1e5 * z / omega), dt=z / omega))
                bound = z**2 / 4 if method == "verlet" else z**2 / 4 / (1 - z**2 / 4)
                cells.append(f"{error:.7g} / {bound:.7g}")
            assert limit.stable is not None
            rows.append([method, f"{omega:g}", *cells, f"{limit.stable * omega:.4f}"])
    titles = ["method", "ω", "z = 0.1: error / bound", "z = 1", "z = 1.9", "z = 1.99", "longest stable z found"]
    return {"linear-limit": table(titles, rows), "linear-windows": _linear_windows()}


def _linear_windows() -> str:
    """Windows in z = dt·ω where each scheme is unstable on the oscillator."""
    rows = []
    for name, scheme in SCHEMES.items():
        found = linear_stability(scheme)
        windows = [
            f"{w.start:.5g} to {w.stop:.5g} (×{w.growth:.5g})" if math.isfinite(w.stop) else f"from {w.start:.5g}"
            for w in found.windows
        ]
        forces = scheme.force_evaluations + scheme.hessian_evaluations
        rows.append([name, str(scheme.order), f"{found.limit:.5g}", f"{found.limit / forces:.3g}", ", ".join(windows)])
    return table(["scheme", "order", "first exit", "per force or Hessian", "unstable z (largest growth a step)"], rows)


def maps(figures: Path) -> Fragments:
    """Maps of step against stiffness."""
    families: dict[str, tuple[list[HamiltonianSystem], Sequence[str], np.ndarray]] = {
        "harmonic_oscillator": (
            [systems.harmonic_oscillator(w) for w in np.geomspace(1.0, 1e6, 7)],
            ("verlet", "leapfrog", "kahan_li8", "implicit_midpoint", "impulse"),
            np.geomspace(1e-7, 10.0, 17),
        ),
        "fput": (
            [systems.fput(float(w)) for w in (10, 30, 100, 300, 1000)],
            ("verlet", "implicit_midpoint", "implicit_explicit", "impulse", "mollified_impulse", "linear_srkn14a"),
            np.geomspace(1e-3, 1.0, 13),
        ),
        "spring_pendulum": (
            [systems.spring_pendulum(k) for k in (1e2, 1e3, 1e4, 1e5, 1e6)],
            ("verlet", "kahan_li8", "implicit_midpoint", "gauss_legendre4"),
            np.geomspace(1e-4, 0.3, 13),
        ),
    }
    for name, (family, methods, steps) in families.items():
        span = {"harmonic_oscillator": (0.0, 1e-6), "fput": (0.0, 20.0), "spring_pendulum": (0.0, 20.0)}[name]
        report = stability(
            family, methods, steps=steps.tolist(), t_span=span, metrics=("energy",), limits=False, max_steps=20_000
        )
        report.plot(figures / f"stability_{name}.png")
    return {}


def fput(figures: Path) -> Fragments:
    rows = []
    for omega, lengths in ((50.0, (0.05, 0.5, 1.5, 2.05, 5.0)), (1000.0, (20.0,))):
        system = systems.fput(omega)
        for method in ("verlet", "implicit_midpoint", *LINEAR):
            for z in lengths:
                if (method == "verlet" and z > 2.05) or (method != "verlet" and z < 0.5):
                    continue
                rows.append(_fput_row(system, method, get(method)(dt=z / omega), z))
        for label, flow in flows(system):
            rows.append(_fput_row(system, label, sympflow.get("sympflow")(flow=flow), flow.dt * omega))
        if omega == 50.0:
            rows += [_fput_row(system, method, get(method)(rtol=1e-6, atol=1e-9), None) for method in ADAPTIVE]
            rows.append(_radau_row(system))
    return {
        "fput": table(["ω", "method", "hω", "force evaluations", "energy error", "largest ∣I − 1∣", "max I₂"], rows)
    }


def _fput_row(system: HamiltonianSystem, label: str, integrator: Any, z: float | None) -> list[str]:
    every = {} if z is None else {"save_every": max(1, int(200 / (z / system.params["omega"]) / 20_000))}
    sol = solve(system, integrator, (0.0, 200.0), on_domain_exit="ignore", **every)
    omega = f"{system.params['omega']:g}"
    work = f"{sol.nfev:,}" + (
        f" + {sol.stats['hessian_evaluations']:,} Hessians" if sol.stats["hessian_evaluations"] else ""
    )
    if not sol.success:
        return [omega, label, "" if z is None else f"{z:g}", work, "∞", "", f"ends at t = {sol.t[-1]:.4g}"]
    energies = oscillatory_energies(system, sol.states)
    return [
        omega,
        label,
        "adaptive, rtol 1e-6" if z is None else f"{z:g}",
        work,
        number(float(max_energy_error(sol))),
        f"{np.abs(energies.sum(-1) - 1).max():.3g}",
        f"{energies[:, 1].max():.3g}",
    ]


def _radau_row(system: HamiltonianSystem) -> list[str]:
    """SciPy's stiff solver, with the exact Jacobian."""
    from scipy.integrate import solve_ivp

    d = system.ndof

    def jacobian(t: float, y: np.ndarray) -> np.ndarray:
        S = system.hessian(y)
        return np.concatenate([S[d:], -S[:d]])

    times = np.linspace(0.0, 200.0, 20_001)
    run = solve_ivp(system, (0.0, 200.0), system.y0, "Radau", t_eval=times, rtol=1e-4, atol=1e-7, jac=jacobian)
    H = system.hamiltonian(run.y.T)
    energies = oscillatory_energies(system, run.y.T)
    cells = [number(float(np.abs(H / H[0] - 1).max())), f"{np.abs(energies.sum(-1) - 1).max():.3g}"]
    work = f"{run.nfev:,} + {run.njev:,} Jacobians"
    return ["50", "SciPy Radau", "adaptive, rtol 1e-4", work, *cells, f"{energies[:, 1].max():.3g}"]


def spring(figures: Path) -> Fragments:
    rows = []
    for energy, kind in ((0.0, "slow manifold"), (0.5, "fast mode excited")):
        cartesian = systems.spring_pendulum(1e6, radial_energy=energy)
        polar = systems.spring_pendulum(1e6, "polar", radial_energy=energy)
        cases = [
            (polar, "strang_parts", 10.0),
            (polar, "suzuki4_parts", 10.0),
            (polar, "implicit_midpoint", 10.0),
            (cartesian, "implicit_midpoint", 10.0),
            (cartesian, "implicit_midpoint", 0.1),
            (cartesian, "verlet", 0.1),
            (cartesian, "verlet", 2.1),
        ]
        for system, method, z in cases:
            name = "polar" if system is polar else "Cartesian"
            rows.append([kind, name, method, f"{z:g}", *_spring_cells(system, get(method)(dt=z / 1e3))])
        for system, name in ((polar, "polar"), (cartesian, "Cartesian")):
            for label, flow in flows(system):
                cells = _spring_cells(system, sympflow.get("sympflow")(flow=flow))
                rows.append([kind, name, label, f"{flow.dt * 1e3:g}", *cells])
    return {"spring": table(["start", "coordinates", "method", "h√k", "steps", "energy error", "what happens"], rows)}


def _spring_cells(system: HamiltonianSystem, integrator: Any) -> list[str]:
    try:
        sol = solve(system, integrator, (0.0, 20.0), save_every=5, on_domain_exit="ignore")
    except ValueError as error:
        return ["", "", str(error)]
    error = float(max_energy_error(sol))
    return [f"{sol.stats['n_steps']:,}", number(error), "" if sol.success else f"ends at t = {sol.t[-1]:.4g}"]


def kepler(figures: Path) -> Fragments:
    rows = []
    for e in (0.6, 0.9, 0.99, 0.999):
        system = systems.kepler(e)
        for method in ("verlet", "kahan_li8", "implicit_midpoint", "log_leapfrog", "log_blanes_moan4", "log_kahan_li8"):
            sol = solve(system, method)
            rows.append([f"{e:g}", method, f"{sol.stats['n_steps']:,}", *_kepler_cells(system, method, sol)])
        for label, flow in flows(system):
            sol = solve(system, flow, on_domain_exit="ignore")
            rows.append([f"{e:g}", label, f"{sol.stats['n_steps']:,}", *_kepler_cells(system, flow, sol)])
        sol = solve(system, "rk45")
        rows.append([f"{e:g}", "rk45", f"{sol.stats['n_steps']:,}", *_kepler_cells(system, "rk45", sol)])
    return {
        "kepler": table(["e", "method", "steps", "energy error", "state error after 100 periods", "what happens"], rows)
    }


def _kepler_cells(system: HamiltonianSystem, method: Any, sol: Any) -> list[str]:
    ends = "" if sol.success else f"status −1 at t = {sol.t[-1]:.4g}"
    state = "" if not sol.success else number(float(np.abs(sol.y[:, -1] - system.y0).max()))
    return [number(float(max_energy_error(sol))), state, ends]


def log_flow(figures: Path) -> Fragments:
    """A flow trained on the logarithmic Hamiltonian, 50 steps a period, against schemes at as many forces."""
    period = 2 * math.pi
    system, ds = systems.kepler(0.9), period / 50
    orbit = solve(sympflow.time_transformed(system), "kahan_li8", (0.0, period), dt=period / 400).states
    tube = sympflow.Tube(orbit, 1e-3 * np.maximum(1e-3, np.abs(orbit).max(0)))
    transformed = sympflow.time_transformed(system, domain=tube)
    start = sympflow.SympFlow.primed(transformed, scheme="blanes_moan4", dt=ds)
    points = {"points": 200, "validation_points": 200, "reference_states": 20}
    trained = sympflow.train(transformed, flow=start, optimizer="bfgs", steps=12, seed=0, **points)
    times = period * np.arange(100) + 0.01  # just after the pericentre
    rows = []
    for label, integrator in (
        ("log_blanes_moan4, untrained", LogSympFlow(flow=start)),
        ("log SympFlow, trained from it", LogSympFlow(flow=trained)),
        ("log_kahan_li8", get("log_kahan_li8")(dt=period / 24)),
        ("log_leapfrog", get("log_leapfrog")(dt=period / 400)),
    ):
        sol = solve(system, integrator, t_eval=times, on_domain_exit="ignore")
        state = np.abs(sol.y - sol.y[:, :1]).max()
        rows.append([label, f"{sol.nfev:,}", number(float(max_energy_error(sol))), number(float(state))])
    return {"log-flow": table(["method, e = 0.9", "force evaluations", "energy error", "state error"], rows)}


def three_body(figures: Path) -> Fragments:
    system, rows = systems.three_body(), []
    cases = [
        ("verlet", {"dt": 1e-4}),
        ("kahan_li8", {"dt": 1e-3}),
        ("kahan_li8", {"dt": 1e-4}),
        ("log_leapfrog", {"dt": 1e-3}),
        ("log_leapfrog", {"dt": 1e-4}),
        ("log_blanes_moan4", {"dt": 1e-3}),
        ("log_blanes_moan4", {"dt": 1e-4, "compensated": True}),
        ("log_kahan_li8", {"dt": 3e-3}),
        ("log_kahan_li8", {"dt": 1e-3, "compensated": True}),
        ("rk45", {"rtol": 1e-9, "atol": 1e-9}),
        ("dop853", {"rtol": 1e-13, "atol": 1e-15}),
    ]
    times = np.linspace(0.0, 70.0, 20_001)
    for method, options in cases:
        solve(system, method, (0.0, 0.1), **options)  # compiles
        sol = solve(system, method, t_eval=times, **options)
        told = ", ".join(
            f"{key} = {value if isinstance(value, bool) else f'{value:g}'}" for key, value in options.items()
        )
        if not sol.success:
            rows.append([method, told, f"{sol.nfev:,}", "∞", "", "", f"ends at t = {sol.t[-1]:.6g}"])
            continue
        error = np.abs(sol.energy_error())
        state = float(np.abs(sol.q[:, -1] - PYTHAGOREAN).max())
        cells = [number(float(error.max())), number(float(error[-1])), number(state)]
        rows.append([method, told, f"{sol.nfev:,}", *cells, f"{sol.stats['wall_time']:.2g} s"])
    titles = [
        "method",
        "options",
        "force evaluations",
        "energy error, largest",
        "at t = 70",
        "state error at t = 70",
        "time",
    ]
    return {"three-body": table(titles, rows)}


def escape(figures: Path) -> Fragments:
    system, rows = systems.henon_heiles_escape(), []
    for method in ("verlet", "kahan_li8", "implicit_midpoint", "gauss_legendre4", "rk4"):
        for dt in (0.1, 0.01):
            sol = solve(system, method, (0.0, 100.0), dt=dt)
            rows.append([method, f"{dt:g}", str(sol.status), *_escape_cells(sol)])
    for method in (*ADAPTIVE, "dopri5", "bosh3"):
        sol = solve(system, method, (0.0, 100.0))
        rows.append([method, "adaptive", str(sol.status), *_escape_cells(sol)])
    first = table(["method", "step", "status", "last finite state at t", "`blow_up_time`", "off by"], rows)
    near = []
    for energy in (0.16567, 1 / 6 + 1e-3):
        scene_ = systems.henon_heiles_escape(energy)
        for label, method in [("verlet, dt = 0.1", get("verlet")(dt=0.1)), *flows(scene_)]:
            sol = solve(scene_, method, (0.0, 1e4), save_every=10)
            error = "∞" if not sol.success else number(float(max_energy_error(sol)))
            domain = sol.stats.get("domain_exit")
            left = "" if domain is None else f"leaves Ω at t = {domain:.4g}"
            ends = "" if sol.success else f"ends at t = {sol.stats['failed_at']:.5g}"
            near.append([f"{energy:.5f}", label, str(sol.status), error, ", ".join(x for x in (left, ends) if x)])
    energies = table(["energy", "method", "status", "energy error", "what happens"], near)
    return {"escape": first, "escape-energies": energies}


def _escape_cells(sol: Any) -> list[str]:
    time = sol.stats.get("blow_up_time", math.nan)
    return [f"{sol.stats['failed_at']:.6g}", f"{time:.8g}", number(abs(time - SINGULARITY))]


def precision(figures: Path) -> Fragments:
    rows = []
    for system in (systems.henon_heiles(), systems.kepler(0.6)):
        report = stability(
            system,
            ["verlet", "kahan_li8", "gauss_legendre4", *["sympflow"] * bool(flows(system))],
            steps=[system.dt],
            dtypes=("float64", "float32"),
            limits=False,
        )
        for r in report.rows:
            if r.status == "not applicable":
                rows.append([r.system, r.label, r.dtype, "", "", "", r.reason.partition(":")[0]])
                continue
            cells = [number(r.energy_error), number(r.volume_error), number(r.symplecticity_defect)]
            rows.append([r.system, r.label, r.dtype, *cells, happening(r)])
    titles = ["system", "method", "precision", "energy error", "volume error", "symplecticity defect", "what happens"]
    return {"precision": table(titles, rows)}


def round_off(figures: Path) -> Fragments:
    system = systems.henon_heiles()
    y0 = system.domain.sample(8, 3)  # type: ignore[union-attr]
    kahan_li = sympflow.SympFlow.primed(system, scheme="kahan_li8", dt=0.05)
    cases: list[tuple[str, Any, dict[str, Any], int]] = [
        ("kahan_li8, dt = 0.05", "kahan_li8", {"dt": 0.05}, 10**8),
        ("the same, compensated", "kahan_li8", {"dt": 0.05, "compensated": True}, 10**8),
        ("gauss_legendre4, dt = 0.002", "gauss_legendre4", {"dt": 0.002}, 10**6),
        ("the same, compensated", "gauss_legendre4", {"dt": 0.002, "compensated": True}, 10**6),
        ("SympFlow primed as kahan_li8, dt = 0.05", "sympflow", {"flow": kahan_li}, 10**7),
        ("the same, compensated", "sympflow", {"flow": kahan_li, "compensated": True}, 10**7),
    ]
    cases += [(label, "sympflow", {"flow": flow}, 10**6) for label, flow in flows(system)]
    rows, curves = [], []
    for label, method, options, n in cases:
        dt = options.get("dt") or options["flow"].dt
        sol = solve(system, method, (0.0, n * dt), y0, save_every=n // 20_000, on_domain_exit="ignore", **options)
        g = energy_growth(sol)
        curves.append((label, g))
        ends = f"{number(g.rms[0])} → {number(g.rms[-1])}"
        drift = f"{number(g.drift)} ± {number(g.drift_error, 0)}"
        rows.append([label, f"{n:.0e}", ends, f"{g.exponent:.2f} ± {g.exponent_error:.2f}", drift])
    _round_off_figure(curves, figures / "stability_round_off.png")
    return {"round-off": table(["method", "steps", "rms energy error", "exponent", "drift per step"], rows)}


def _round_off_figure(curves: list[tuple[str, Any]], path: Path) -> None:
    from sympflow.show.style import dress, method_styles, new_figure, save

    figure = new_figure(6.4, 4.2)
    ax = figure.subplots()
    names = [f"{label} {i}" if label.startswith("the same") else label for i, (label, _) in enumerate(curves)]
    styles = method_styles([(name, name) for name in names])
    for (label, g), name in zip(curves, names, strict=True):
        dashed = label.startswith("the same")
        colour, marker = styles[names[names.index(name) - 1]] if dashed else styles[name]
        line = "--" if dashed else "-"
        ax.loglog(g.steps, g.rms, line, color=colour, marker=marker, ms=4, lw=1.2, label=None if dashed else label)
    n = np.geomspace(1e3, 1e8, 2)
    ax.loglog(n, 3e-16 * np.sqrt(n), ":", color="#999999", lw=1.0, label="√n")
    dress(ax, "steps", "rms energy error, relative (dashed: compensated)")
    ax.legend(frameon=False, fontsize=8)
    save(figure, path)


def _scene(name: str, make: Callable[[], HamiltonianSystem], methods: Sequence[Any], **options: Any) -> Section:
    return lambda figures: {name: scene(make(), methods, **options)}


SECTIONS: dict[str, Section] = {
    "linear_limit": linear_limit,
    "maps": maps,
    "fput": fput,
    "spring": spring,
    "kepler": kepler,
    "log_flow": log_flow,
    "three_body": three_body,
    "escape": escape,
    "henon_heiles": _scene("henon-heiles", systems.henon_heiles, (*CLASSICAL, "rk4", *ADAPTIVE)),
    "double_well": _scene("double-well", systems.double_well, ("verlet", "kahan_li8", "gauss_legendre4", "rk45")),
    "pendulum_separatrix": _scene(
        "pendulum-separatrix", systems.pendulum_separatrix, ("verlet", "kahan_li8", "gauss_legendre4", "rk45")
    ),
    "toda": _scene("toda", systems.toda_lattice, ("verlet", "srkn11b", "kahan_li8", "gauss_legendre4", "rk45")),
    "nonseparable": _scene(
        "nonseparable", systems.nonseparable, ("verlet", "implicit_midpoint", "gauss_legendre4", "rk4", "rk45")
    ),
    "lennard_jones": _scene(
        "lennard-jones",
        systems.lennard_jones,
        ("verlet", "srkn11b", "kahan_li8"),
        factors=(1.0, 2.0, 4.0),
        max_steps=50_000,
    ),
    "precision": precision,
    "round_off": round_off,
}


if __name__ == "__main__":
    main()
