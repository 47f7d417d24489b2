"""Sun and eight planets: energy error and time of each method, beside REBOUND where it is installed.

    python benchmarks/planets.py                                   1,000 years, a minute
    python benchmarks/planets.py --years 1e5                       the comparison at length
    python benchmarks/planets.py --long                            states after 100,000 years, and trained flows
    python benchmarks/planets.py --asteroids                       bodies without mass, on all cores
    python benchmarks/planets.py --secular                         secular frequencies from 20 million years, minutes
    python benchmarks/planets.py --billion outer.store             a billion years of the outer planets, ten minutes
    python benchmarks/planets.py --rounding                        energy errors of single planets, a minute
    python benchmarks/planets.py --figure docs/figures/planets.png eccentricities over 200,000 years
    python benchmarks/planets.py --belt docs/figures/belt.png      asteroids over 100,000 years, four minutes

The energy error is the largest of 40 outputs, relative to |H(y0)|; times are processor times of whole calls of `solve`,
the least of the repeats, on one thread. REBOUND runs from the same state, without safe mode, alternating with ours.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from measuring.machine import least, pin_to_one_thread

if "--asteroids" not in sys.argv:
    pin_to_one_thread()

import numpy as np
from measuring import fragments

from sympflow import HamiltonianSystem, angular_momentum, elements, frequencies, shipped_flows, solve
from sympflow.show.style import dress, new_figure
from sympflow.systems import solar_system
from sympflow.systems.planets import UNITS

YEAR, TURN = 365.25, (0.0, 2 * np.pi)
OUTER = "Jupiter", "Saturn", "Uranus", "Neptune"
JUPITER, MARS = 5.2026, 1.67  # Jupiter's semi-major axis and Mars' aphelion, in AU
OUTPUTS = 40
METHODS = {
    "wisdom_holman": ("wisdom_holman", {}, ("whfast", {})),
    "wisdom_holman, corrector 17": ("wisdom_holman", {"corrector": 17}, ("whfast", {"corrector": 17})),
    "kepler_aba864": ("kepler_aba864", {}, ("saba", {"type": "8_6_4"})),
    "kepler_aba1064": ("kepler_aba1064", {}, ("saba", {"type": "10_6_4"})),
    "kepler_takahashi_imada, corrector 17": ("kepler_takahashi_imada", {"corrector": 17}, ("whckl", {})),
    "srkn11b": ("srkn11b", {}, ("whfast512", {"corrector": 17})),
}
"""Ours, with options, and an integrator of REBOUND, of the same scheme where there is one, with attributes."""
TARGETS = 1e-9, 1e-11


def ours(system: Any, name: str, days: float, years: float, repeats: int) -> tuple[float, float]:
    """Energy error, and microseconds a step."""
    method, options, _ = METHODS[name]
    n = OUTPUTS * round(years * YEAR / days / OUTPUTS)
    given = {"t_span": (0.0, n * days), "dt": days, "save_every": n // OUTPUTS, "on_domain_exit": "ignore", **options}
    solve(system, method, **{**given, "t_span": (0.0, OUTPUTS * days), "save_every": 1})  # compiled
    seconds, sol = least(lambda: solve(system, method, **given), repeats)
    return float(np.abs(sol.energy_error()).max()), 1e6 * seconds / n


def rebounds(system: Any, name: str, days: float, years: float, repeats: int) -> tuple[float, float] | None:
    """The same of REBOUND; None where it is not installed or has no such scheme."""
    try:
        import rebound
    except ImportError:
        return None
    peer, options = METHODS[name][2]

    def simulation() -> Any:
        sim = simulated(rebound, system, days, peer)
        for option, value in options.items():
            setattr(sim.integrator, option, value)
        return sim

    def run(sim: Any) -> float:
        E, worst = sim.energy(), 0.0
        for t in np.linspace(0, years * YEAR * system.params["G"] ** 0.5, OUTPUTS + 1)[1:]:
            sim.integrate(t, exact_finish_time=0)
            sim.synchronize()
            worst = max(worst, abs(sim.energy() / E - 1))
        return worst

    try:
        seconds, worst = least(lambda: run(simulation()), repeats)
    except RuntimeError:  # of a processor without AVX-512
        return None
    return worst, 1e6 * seconds / (years * YEAR / days)


def simulated(rebound: Any, system: Any, days: float, peer: str) -> Any:
    """The simulation of REBOUND that begins with the state of a system, with a unit of time for which G is 1."""
    sim, unit = rebound.Simulation(), system.params["G"] ** 0.5
    sim.dt, sim.integrator = days * unit, peer
    masses = system.local.masses
    for m, q, p in zip(masses, *system.y0.reshape(2, -1, 3), strict=True):
        v = p / (m or 1.0) / unit
        sim.add(m=m, x=q[0], y=q[1], z=q[2], vx=v[0], vy=v[1], vz=v[2])
    if peer == "whfast512":
        sim.integrator.concatenate_steps = 100
    else:
        sim.N_active, sim.integrator.safe_mode = int((masses > 0).sum()), 0
    return sim


def table(years: float, steps: list[float], repeats: int) -> str:
    """The comparison as Markdown, with the best of each at the targets."""
    system, lines, found = solar_system(), [], []
    for name in METHODS:
        for days in steps:
            error, each = ours(system, name, days, years, repeats)
            peer = rebounds(system, name, days, years, repeats)
            own = [f"{days:g} d", f"{error:.1e}", f"{each:.3f} µs", f"{each / days:.4f} µs"]
            other = (
                ["", "", ""] if peer is None else [METHODS[name][2][0], f"{peer[0]:.1e}", f"{peer[1] / days:.4f} µs"]
            )
            lines.append(
                [
                    f"`{name.replace(', corrector ', '`, corrector ')}" + ("`" if "corr" not in name else ""),
                    *own,
                    *other,
                ]
            )
            group = "WHFast512" if METHODS[name][2][0] == "whfast512" else "REBOUND"
            found.append((group, ((error, each / days), (9.0, 9.0) if peer is None else (peer[0], peer[1] / days))))
            print(*lines[-1], flush=True)
    titles = [
        "method",
        "step",
        "energy error",
        "time of a step",
        "of a simulated day",
        "REBOUND",
        "its error",
        "of a day",
    ]
    if not any(line[-1] for line in lines):
        return fragments.table(titles[:-3], [line[:-3] for line in lines])
    best = []
    for target in TARGETS:
        each = {name: [9.0] for name in ("ours", "REBOUND", "WHFast512")}
        for name, (mine, theirs) in found:
            for key, (error, cost) in (("ours", mine), (name, theirs)):
                each[key] += [cost] if error <= target else []
        costs = ", ".join(f"{key} {min(costs):.4f} µs" for key, costs in each.items() if len(costs) > 1)
        best.append(f"A simulated day at {target:g}: {costs}.")
        print(best[-1])
    return "\n\n".join([fragments.table(titles, lines), *best])


def belt(n: int, seed: int = 0) -> HamiltonianSystem:
    """Asteroids without mass among the four outer planets."""
    rng, planets = np.random.default_rng(seed), solar_system(OUTER)
    orbits = {key: value[0] for key, value in elements(planets.y0[None], planets)._asdict().items()}
    ranges = {"a": (2.0, 3.6), "e": (0.0, 0.1), "inc": (0.0, 0.05), "node": TURN, "peri": TURN, "M": TURN}
    orbits = {key: np.append(orbits[key], rng.uniform(*ranges[key], n)) for key in ranges}
    masses = np.append(planets.local.masses, np.zeros(n))
    return HamiltonianSystem.planets(masses, elements=orbits, units=UNITS, encounter=None)


def asteroids(n: int = 100_000, days: float = 40.0) -> str:
    """The time of a step of a body without mass."""
    system = belt(n)

    def run(steps: int) -> float:
        return shortest(lambda: solve(system, "wisdom_holman", (0.0, steps * days), dt=days, save_every=steps))

    mine = (run(150) - run(50)) / 100
    cores = len(os.sched_getaffinity(0)) if "--asteroids" in sys.argv else 1
    what = f"{n:,} asteroids among four planets, on {cores} core{'s' * (cores > 1)}"
    text = f"{what}: {1e9 * mine / n:.1f} ns a step and asteroid"
    try:
        import rebound
    except ImportError:
        return f"{text}."
    sim = simulated(rebound, system, days, "whfast")
    sim.integrate(sim.dt, exact_finish_time=0)
    theirs = shortest(lambda: sim.integrate(sim.t + 10 * sim.dt, exact_finish_time=0), 2) / 10
    return f"{text}, REBOUND on one core {1e9 * theirs / n:.1f} ns."


def shortest(run: Callable[[], Any], repeats: int = 5) -> float:
    """The least time in seconds of several runs, as a clock shows it."""
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        run()
        times.append(time.perf_counter() - begun)
    return min(times)


def belt_figure(path: Path, n: int = 8000, years: float = 100_000.0) -> None:
    """The largest eccentricities of asteroids by their semi-major axes: resonances with Jupiter stand out."""
    system, days = belt(n), 50.0
    steps = 200 * round(years * YEAR / days / 200)
    sol = solve(system, "wisdom_holman", (0.0, steps * days), dt=days, save_every=steps // 200)
    orbits = elements(sol)
    start, largest = orbits.a[4:, 0], orbits.e[4:].max(-1)
    crossed = (orbits.a[4:] * (1 - orbits.e[4:])).min(-1) < MARS
    fig = new_figure(7, 4.6)
    upper, lower = fig.subplots(2, 1, sharex=True)
    for those, color, label in ((~crossed, "#0072B2", "outside of Mars' orbit"), (crossed, "#D55E00", "crosses it")):
        upper.plot(start[those], largest[those], ".", ms=2, mew=0, color=color, label=label)
    upper.set(ylim=(0, 0.7), xlim=(2.0, 3.6))
    bins = np.linspace(2.0, 3.6, 81)
    share = np.histogram(start[crossed], bins)[0] / np.maximum(1, np.histogram(start, bins)[0])
    lower.stairs(100 * share, bins, fill=True, color="#D55E00")
    dress(upper, "", "largest eccentricity")
    dress(lower, "semi-major axis at the start [AU]", "cross Mars' orbit [%]")
    for p, q in ((4, 1), (3, 1), (5, 2), (7, 3), (2, 1), (7, 4)):
        place = JUPITER * (q / p) ** (2 / 3)
        for axis in (upper, lower):
            axis.axvline(place, color="0.7", lw=0.8, zorder=0)
        upper.annotate(
            f"{p}:{q}",
            (place, 1),
            (0, 2),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            ha="center",
            fontsize=8,
        )
    fig.legend(loc="outside upper center", ncols=2, frameon=False, fontsize=9, markerscale=4)
    fig.savefig(path, dpi=110, metadata={"Software": None})
    print(f"{path}: {int(crossed.sum())} of {n} crossed the orbit of Mars")


def batch(systems: int = 1000, steps: int = 2000) -> str:
    """The time of a step and system in a batch."""
    system = solar_system()
    y0 = system.y0 * (1 + 1e-6 * np.random.default_rng(0).standard_normal((systems, 1)))
    given = {"dt": 4.0, "t_span": (0.0, 4.0 * steps), "save_every": steps, "on_domain_exit": "ignore"}
    seconds, _ = least(lambda: solve(system, "wisdom_holman", y0=y0, **given), 2)
    return f"{systems} systems at once: {1e6 * seconds / systems / steps:.3f} µs a step and system."


LONG_DAYS = 36_528_000.0  # 100,000 years, so many whole steps of each length between outputs
LONG = {"wisdom_holman, corrector 17": 6.0, "kepler_aba1064": 8.0}
"""Methods and steps of the long comparison."""


def phases(y: np.ndarray, right: np.ndarray) -> float:
    """The largest angle between a planet of one state and that of another, as seen from the Sun."""
    one, other = (q[1:] - q[:1] for q in (x[: x.size // 2].reshape(-1, 3) for x in (y, right)))
    size = np.linalg.norm(one, axis=-1) * np.linalg.norm(other, axis=-1)
    return float((np.linalg.norm(np.cross(one, other), axis=-1) / size).max())


def long_runs(days: float = LONG_DAYS) -> str:
    """Energy errors and phases after 100,000 years, beside REBOUND's."""
    system, lines = solar_system(), []
    given = {"t_span": (0.0, days), "on_domain_exit": "ignore"}
    right = solve(system, "kepler_aba1064", dt=4.0, compensated=True, t_eval=[days], **given).y[:, -1]
    for name, step in LONG.items():
        method, options, (peer, more) = METHODS[name]
        n = round(days / step)
        mine = {"dt": step, "save_every": n // OUTPUTS, **options, **given}
        seconds, sol = least(lambda m=method, mine=mine: solve(system, m, **mine), 1)
        rows = [[f"`{name}`", sol.y[:, -1], float(np.abs(sol.energy_error()).max()), seconds]]
        try:
            import rebound

            sim = simulated(rebound, system, step, peer)
            for option, value in more.items():
                setattr(sim.integrator, option, value)
            seconds, (y, worst) = least(lambda s=sim, k=n: _stepped(s, k), 1)
            rows.append([f"REBOUND, {peer}", y, worst, seconds])
        except ImportError:
            pass
        lines += [
            [name, f"{step:g} d", f"{error:.1e}", f"{phases(y, right):.1e}", f"{seconds:.2f} s"]
            for name, y, error, seconds in rows
        ]
        print(*lines[-len(rows) :], sep="\n", flush=True)
    return fragments.table(["method", "step", "energy error", "error of a phase", "time"], lines)


def _stepped(sim: Any, n: int) -> tuple[np.ndarray, float]:
    """The places of bodies after n steps of REBOUND, and the largest energy error of the outputs."""
    E, worst = sim.energy(), 0.0
    for _ in range(OUTPUTS):
        sim.steps(n // OUTPUTS)
        sim.synchronize()
        worst = max(worst, abs(sim.energy() / E - 1))
    q = np.array([p.xyz for p in sim.particles])
    return np.concatenate([q.ravel(), q.ravel()]), worst


TRAINED = {1e-8: "outer_planets-kepler-276.3", 1e-9: "outer_planets-kepler-160"}
"""The flows that ship, by what is asked of them."""
STEPS = np.geomspace(400.0, 60.0, 96)  # days between kicks of the methods that these are compared with


def trained(years: float = 1e5) -> str:
    """The outer planets: a simulated day by trained flows and by other methods, each with its longest step."""
    system, lines = solar_system(OUTER), []
    others = {"wisdom_holman": {"corrector": 17}, "kepler_takahashi_imada": {"corrector": 17}, "kepler_aba1064": {}}

    def error(method: Any, dt: float, options: dict[str, Any]) -> float:
        n = 1000 * round(years * YEAR / dt / 1000)
        given = {"dt": dt, "save_every": n // 1000, "on_domain_exit": "ignore"}
        return float(np.abs(solve(system, method, (0.0, n * dt), **given, **options).energy_error()).max())

    def cost(method: Any, dt: float, options: dict[str, Any], n: int = 200_000) -> float:
        given = {"dt": dt, "save_every": n, "on_domain_exit": "ignore"}
        return least(lambda: solve(system, method, (0.0, n * dt), **given, **options), 3)[0] / (n * dt) * 1e9

    for target, file in TRAINED.items():
        rows = []
        for name, options in others.items():
            steps = 8 * STEPS if name == "kepler_aba1064" else STEPS
            dt = next(h for h in steps.tolist() if error(name, h, options) <= target)
            rows.append((f"`{name}`" + ", corrector 17" * bool(options), name, dt, options))
        flow = next(f for f in shipped_flows(system) if f.name == file)
        rows.append((f"trained, over {flow.reach} steps to either side", flow.load(system), flow.dt, {}))
        for title, *given in rows:
            found = error(*given), cost(*given)
            lines.append([f"{target:g}", title, f"{given[1]:.0f} d", f"{found[0]:.1e}", f"{found[1]:.2f} ns"])
            print(*lines[-1], flush=True)
    return fragments.table(["asked", "method", "step", "energy error", "a simulated day"], lines)


SECULAR = {"g5": 4.2575, "g6": 28.2449, "g7": 3.0879, "g8": 0.6730, "s6": -26.3478, "s7": -2.9925, "s8": -0.6917}
"""Arc seconds a year: J. Laskar and others, Astron. Astrophys. 428 (2004) 261–285."""
RELATIVITY = {"extra": "-3*(G*m/(c*r))**2", "params": {"c": 173.1446}}


def secular(planets: Any, years: float = 20e6) -> np.ndarray:
    """Frequencies g5 to g8 of perihelia and s6 to s8 of nodes over the invariable plane, in arc seconds a year."""
    scene = solar_system(planets)
    masses, axes = scene.local.masses, np.eye(3)
    z = angular_momentum(scene.y0, scene)
    axes = np.array([a / np.linalg.norm(a) for a in (np.cross(axes[1], z), np.cross(z, np.cross(axes[1], z)), z)])
    turned = (scene.y0.reshape(-1, 3) @ axes.T).ravel()
    system = HamiltonianSystem.planets(masses, y0=turned, units=UNITS, **RELATIVITY)

    def signal(y: np.ndarray) -> np.ndarray:
        found = elements(np.moveaxis(y, -2, -1), system, about="jacobi")
        perihelia = found.e * np.exp(1j * (found.node + found.peri))
        nodes = np.sin(found.inc / 2) * np.exp(1j * found.node)
        return np.moveaxis(np.concatenate([perihelia[..., -4:], nodes[..., -3:]], axis=-1), -1, -2)

    dt = float(system.local.frame.periods.min()) / 25 if len(masses) < 9 else 11.0
    given = {"dt": dt, "corrector": 17, "signal": signal, "n": 6, "samples": 50_000}
    rows = frequencies(system, "wisdom_holman", (0.0, years * YEAR), **given).frequencies
    seconds = rows * YEAR * np.degrees(1) * 3600
    return np.array([row[np.argmin(np.abs(row - w))] for row, w in zip(seconds, SECULAR.values(), strict=True)])


def secular_table() -> str:
    """The frequencies of the four outer planets alone and of all eight."""
    columns = [secular(planets) for planets in (OUTER, 8)]
    rows = [
        [name, *(f"{x:.4f}″ ({abs(x / right - 1):.0e})" for x in values), f"{right:.4f}″"]
        for (name, right), *values in zip(SECULAR.items(), *columns, strict=True)
    ]
    return fragments.table(["", "four outer planets", "all eight", "Laskar"], rows)


SPANS = 1e6, 1e7, 1e8, 1e9  # years


def billion(store: Path, dt: float = 200.0) -> str:
    """Errors of the outer planets over a billion years, compensated, and over the first tenth of it in plain numbers.

    The scheme keeps the angular momentum exactly, so that its error is that of rounding.
    """
    system, lines = solar_system(OUTER), []
    for title, spans, options in (
        ("plain", SPANS[:-1], {}),
        ("compensated", SPANS, {"compensated": True, "store": store}),
    ):
        every = 1000 * round(1e6 * YEAR / dt / 1000) // 10
        n = round(spans[-1] / 1e5) * every
        given = {"dt": dt, "corrector": 17, "save_every": every, "on_domain_exit": "ignore", **options}
        seconds, sol = least(lambda given=given, n=n: solve(system, "wisdom_holman", (0.0, n * dt), **given), 1)
        momentum = angular_momentum(sol.y.T, system)
        turned = np.linalg.norm(momentum - momentum[0], axis=-1) / np.linalg.norm(momentum[0])
        energy = np.abs(sol.energy_error())
        for years in spans:
            part = slice(1, 1 + round(years / 1e5))
            worst, spread = energy[part].max(), np.sqrt(np.mean(turned[part] ** 2))
            lines.append([title, f"{years:.0e}", f"{worst:.1e}", f"{spread:.1e}"])
            print(*lines[-1], flush=True)
        print(f"{title}: {seconds:.0f} s, {1e6 * seconds / n:.3f} µs a step, ends with status {sol.status}")
        lines[-1].append(f"{seconds:.0f} s")
    lines = [row + [""] * (5 - len(row)) for row in lines]
    return fragments.table(
        ["positions and velocities", "years", "energy error", "angular momentum, rms", "time"], lines
    )


def rounding(years: float = 1e6) -> str:
    """The energy error of one planet about a star, whose motion is solved exactly, by its orbit and its step."""
    lines = []
    for e in (0.2, 0.5, 0.7):
        elements = {"a": 1.0, "e": e, "inc": 0.3, "node": 1.0, "peri": 0.7, "M": 0.1}
        system = HamiltonianSystem.planets([1.0, 1e-3], elements=elements)
        for steps in (20.37, 81.37):  # in a period
            n, dt = round(years * steps / 1000) * 1000, 2 * np.pi / steps
            given = {"dt": dt, "save_every": n // 1000, "compensated": True}
            energy = solve(system, "wisdom_holman", (0.0, n * dt), **given).energy_error()
            spread = [f"{np.sqrt(np.mean(energy[1 : 1 + k] ** 2)):.1e}" for k in (10, 100, 1000)]
            lines.append([f"{e:g}", f"{steps:.0f}", f"{n:.0e}", *spread])
            print(*lines[-1], flush=True)
    spans = ["energy error, rms, after a hundredth of them", "a tenth", "all"]
    return fragments.table(["eccentricity", "steps a period", "steps", *spans], lines)


def figure(path: Path) -> None:
    """Eccentricities of the outer planets over 200,000 years."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    system = solar_system(OUTER)
    sol = solve(system, t_span=(0.0, 200_000 * YEAR), save_every=500, on_domain_exit="ignore")
    orbits = elements(sol, about="jacobi")
    fig, axes = plt.subplots(2, 1, figsize=(7, 4.4), sharex=True, layout="constrained")
    for k, name in enumerate(OUTER):
        for axis, y in zip(axes, (orbits.e[k], np.degrees(orbits.inc[k])), strict=True):
            axis.plot(sol.t / YEAR / 1000, y, label=name, lw=0.8)
    axes[0].set_ylabel("eccentricity")
    axes[1].set_ylabel("inclination / °")
    axes[1].set_xlabel("time / 1000 years")
    fig.legend(*axes[0].get_legend_handles_labels(), ncols=4, fontsize=8, loc="outside upper center")
    fig.savefig(path, dpi=110, metadata={"Software": None})
    print(f"{path}: relative energy error {np.abs(sol.energy_error()).max():.1e}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--years", type=float, default=1000.0)
    parser.add_argument("--steps", type=float, nargs="+", default=[4.0, 6.0, 8.0, 12.0, 20.0])
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--asteroids", action="store_true", help="measure bodies without mass on all cores")
    parser.add_argument("--long", action="store_true", help="compare states after 100,000 years, and trained flows")
    parser.add_argument("--secular", action="store_true", help="find the secular frequencies of the outer planets")
    parser.add_argument("--billion", type=Path, metavar="STORE", help="run the outer planets over 1e9 years")
    parser.add_argument("--rounding", action="store_true", help="measure the rounding of single planets, a minute")
    parser.add_argument("--figure", type=Path, help="draw this picture, and nothing else")
    parser.add_argument("--belt", type=Path, help="draw that of asteroids, and nothing else")
    fragments.add_out(parser)
    given = parser.parse_args()
    warnings.filterwarnings("ignore", "`dt` .* is long for method")
    if given.asteroids:
        text = asteroids()
        print(text)
        fragments.write(given.out, "planets-asteroids", text)
        return
    if given.secular:
        text = secular_table()
        print(text)
        fragments.write(given.out, "planets-secular", text)
        return
    if given.billion:
        fragments.write(given.out, "planets-billion", billion(given.billion))
        return
    if given.rounding:
        fragments.write(given.out, "planets-rounding", rounding())
        return
    if given.long:
        fragments.write(given.out, "planets-trained", trained())
        fragments.write(given.out, "planets-long", long_runs())
        return
    if given.figure:
        figure(given.figure)
        return
    if given.belt:
        belt_figure(given.belt)
        return
    parts = [table(given.years, given.steps, given.repeats), batch(), asteroids()]
    print(*parts[1:], sep="\n")
    fragments.write(given.out, "planets", "\n\n".join(parts))


if __name__ == "__main__":
    main()
