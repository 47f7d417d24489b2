"""The fragments of docs/benchmarks.md and its figure, from the measured rows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from measuring.fragments import duration, table, three

from contenders.measurement import Results, Row, find, goals
from contenders.ours import FLOW

LISTED = (1e-3, 1e-6, 1e-9, 1e-12)
SETTINGS = {"dt": "dt", "tol": "tol", "flow": "Δt"}


def fragments(results: Results) -> dict[str, str]:
    """All fragments by their names: the tables of one trajectory and of the batch, the targets, who is ahead."""
    found = {"peers-run": run_table(results), "peers-targets": goal_table(results), "peers-steps": step_table(results)}
    for n in sorted({row.trajectories for row in results.rows}):
        name = "one" if n == 1 else "batch"
        found |= {f"peers-{name}": run_time_table(results, n), f"peers-{name}-work": work_table(results, n)}
    found |= {"peers-fastest": fastest_table(results)}
    return found | {"peers-order": order_table(results), "peers-left-out": left_out(results)}


def run_table(results: Results) -> str:
    """The conditions of the run."""
    e = results.environment
    spreads = sorted(row.spread / row.seconds for row in results.rows)
    middle, most = spreads[len(spreads) // 2], spreads[-1]
    rows = [
        ("load average, at the start and at the end", f"{e['load']:.1f}, {e['load_after']:.1f}"),
        ("interleaved rounds", e["repeats"]),
        ("minutes", f"{e['minutes']:.1f}"),
        ("interquartile range over the rounds, of the time: the median row, the largest", f"{middle:.1%}, {most:.0%}"),
        ("versions", ", ".join(f"{name} {version}" for name, version in e["versions"].items())),
    ]
    return table(("the run", ""), rows)


def goal_table(results: Results) -> str:
    lines = [
        (
            goal.text,
            "—" if goal.ratio is None else three(goal.ratio),
            f"{'≥' if goal.at_least else '≤'} {goal.limit:g}",
            goal.verdict,
        )
        for goal in goals(results)
    ]
    return table(("ratio of run times", "measured", "target", "verdict"), lines)


def step_table(results: Results) -> str:
    """Nanoseconds for a step of one trajectory, ours and by hand."""
    names = {"verlet": "Verlet", "kahan_li8": "Kahan–Li 8"}
    times: dict[tuple[str, str], dict[str, float]] = {}
    for name, seconds in results.step_seconds.items():
        method, n, whose = name.split()
        times.setdefault((names[method], n), {})[whose] = 1e9 * seconds
    lines = [(method, n, three(t["hand-written"]), three(t["sympflow"])) for (method, n), t in times.items()]
    return table(("method", "trajectories", "by hand, ns a step and trajectory", "through `solve`"), lines)


def run_time_table(results: Results, n: int) -> str:
    targets = present_targets(results, n)
    unit = {r.target: r.seconds for r in results.rows if r.package == "Numba" and r.trajectories == 1}
    header = ["method", "package"]
    for target in targets:
        header += [f"{power(target)}: time", "xV"]
    lines = []
    for (package, label), rows in grouped(results, n):
        cells = [label, package]
        for target in targets:
            row = rows.get(target)
            mark = "~" if row and row.part < 1 else ""
            cells.append(f"{mark}{duration(row.seconds)}" if row else "—")
            cells.append(three(row.seconds / unit[target]) if row and target in unit else "—")
        lines.append(cells)
    return table(header, lines)


def work_table(results: Results, n: int) -> str:
    header = ("method", "package", "error", "step or tolerance", "steps", "F", "G", "energy error", "state error")
    lines = [
        (
            label,
            package,
            power(target),
            f"{SETTINGS[row.control]} {row.value:.2g}",
            f"{row.steps:,}",
            "—" if row.force_evaluations is None else f"{row.force_evaluations:,}",
            "—" if row.hessian_evaluations is None else f"{row.hessian_evaluations:,}",
            f"{row.energy_error:.1e}",
            "—" if row.state_error is None else f"{row.state_error:.1e}",
        )
        for (package, label), rows in grouped(results, n)
        if not same_steps(package, label)
        for target, row in rows.items()
    ]
    return table(header, lines)


def same_steps(package: str, label: str) -> bool:
    """True if the steps are those of another row: our Verlet's, or SciPy's with the other right-hand side."""
    if package == "SciPy":
        return "scalar" in label
    return package in ("Numba", "NumPy", "torch") or label.startswith("leapfrog, jit")


def left_out(results: Results) -> str:
    """Packages that are not there, and targets that were not reached."""
    rows = [(skip.package, "all", skip.reason) for skip in results.skipped]
    rows += [
        (package, f"{label}, {n} trajector{'y' if n == 1 else 'ies'}", f"no setting reached {power(target)}")
        for label, package, n, target in results.unreached
    ]
    return table(("package", "method", "left out because"), rows or [("none", "", "")])


def fastest_table(results: Results) -> str:
    """Our fastest scheme and flow, the fastest other package, and diffrax's leapfrog over our Verlet."""
    packages = sorted({row.package for row in results.rows} - {"sympflow", "Numba"})
    rows = []
    for n in sorted({row.trajectories for row in results.rows}):
        for target in LISTED:
            mine, peer = fastest(results, n, target, ["sympflow"], but=FLOW), fastest(results, n, target, packages)
            if not (mine and peer):
                continue
            flow, same = pick(results, "sympflow", FLOW, n, target), leapfrog_ratio(results, n, target)
            faster = f"{mine.seconds / flow.seconds:.2f}" if flow else ""
            cells = [mine.label, faster, f"{peer.package}: {peer.label}", f"{peer.seconds / mine.seconds:.2f}"]
            rows.append(["one" if n == 1 else n, power(target), *cells, "" if same is None else f"{same:.2f}"])
    titles = (
        "trajectories",
        "error",
        "our fastest scheme",
        "the trained flow is faster, times",
        "fastest of the others",
        "takes longer than our scheme, times",
        "diffrax's Verlet over ours",
    )
    return table(titles, rows)


def leapfrog_ratio(results: Results, n: int, target: float) -> float | None:
    """The time of diffrax's leapfrog over that of our `verlet` at the same step, None where one is missing."""
    verlet = pick(results, "sympflow", "verlet", n, target)
    key = ("diffrax", "dt", n, target)
    leapfrog = find(results, lambda r: (r.package, r.control, r.trajectories, r.target) == key)
    return leapfrog.seconds / verlet.seconds if verlet and leapfrog else None


def order_table(results: Results) -> str:
    """Ratio of the times of our Verlet and our fastest scheme, one trajectory."""
    rows = []
    for target in LISTED:
        verlet, best = (
            pick(results, "sympflow", "verlet", 1, target),
            fastest(results, 1, target, ["sympflow"], but=FLOW),
        )
        if verlet and best:
            rows.append((power(target), best.label, three(verlet.seconds / best.seconds)))
    return table(("error", "our fastest scheme", "times faster than our Verlet"), rows)


def pick(results: Results, package: str, label: str, n: int, target: float) -> Row | None:
    key = (package, label, n, target)
    return find(results, lambda r: (r.package, r.label, r.trajectories, r.target) == key)


def fastest(results: Results, n: int, target: float, packages: list[str], but: str = "") -> Row | None:
    rows = [r for r in results.rows if r.trajectories == n and r.target == target and r.package in packages]
    rows = [r for r in rows if r.label != but]
    return min(rows, key=lambda r: r.seconds, default=None)


def power(target: float) -> str:
    """1e-6 for 1e-06."""
    return f"{target:.0e}".replace("e-0", "e-")


def present_targets(results: Results, n: int) -> list[float]:
    return [t for t in LISTED if any(row.target == t and row.trajectories == n for row in results.rows)]


def grouped(results: Results, n: int) -> list[tuple[tuple[str, str], dict[float, Row]]]:
    """Rows by (package, label), each by target, in the order of the run."""
    groups: dict[tuple[str, str], dict[float, Row]] = {}
    for row in results.rows:
        if row.trajectories == n:
            groups.setdefault((row.package, row.label), {})[row.target] = row
    return list(groups.items())


SHOWN = {
    "trained flow (sympflow)": ("#d62728", "o", "-"),
    "best splitting scheme (sympflow)": ("#1f77b4", "s", "-"),
    "Verlet (sympflow)": ("#17becf", "D", "-"),
    "Verlet, hand-written in Numba": ("#808080", "D", ":"),
    "heyoka": ("#9467bd", "^", "--"),
    "REBOUND": ("#2ca02c", "v", "--"),
    "diffrax": ("#e08e0b", "P", "--"),
    "pyhamsys": ("#8c564b", "X", "--"),
    "desolver": ("#e377c2", "<", "--"),
    "SciPy": ("#bcbd22", ">", "--"),
    "torchdiffeq": ("#7f7f7f", "*", "--"),
}
"""The curves of the figure: colour, marker, line. Of a package its fastest method at each target."""


def curve_of(row: Row) -> str | None:
    """The curve that a row may be on."""
    if row.package == "sympflow":
        return {FLOW: "trained flow (sympflow)", "verlet": "Verlet (sympflow)"}.get(
            row.label, "best splitting scheme (sympflow)"
        )
    if row.package == "Numba":
        return "Verlet, hand-written in Numba"
    return row.package if row.package in SHOWN else None


def draw(results: Results, path: Path) -> None:
    """Error against run time, a panel for one trajectory and one for the batch; legible on white as on black."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import LogLocator

    grey = "#808890"
    counts = sorted({row.trajectories for row in results.rows})
    names = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color")
    with plt.rc_context(dict.fromkeys(names, grey)):
        figure, panels = plt.subplots(
            1, len(counts), figsize=(5.2 * len(counts), 5.0), squeeze=False, sharey=True, layout="constrained"
        )
        handles: dict[str, Any] = {}
        for axes, n in zip(panels[0], counts, strict=True):
            best: dict[str, dict[float, Row]] = {}
            for row in results.rows:
                name = curve_of(row)
                if name and row.trajectories == n:
                    fastest_yet = best.setdefault(name, {}).get(row.target)
                    if fastest_yet is None or row.seconds < fastest_yet.seconds:
                        best[name][row.target] = row
            for name, (colour, marker, line) in SHOWN.items():
                rows = sorted(best.get(name, {}).values(), key=lambda row: row.energy_error)
                if rows:
                    thick = 2.4 if name.endswith("(sympflow)") else 1.3
                    x, y = [row.seconds for row in rows], [row.energy_error for row in rows]
                    (handles[name],) = axes.loglog(x, y, line, marker=marker, color=colour, lw=thick, ms=6)
            axes.set_xlabel("run time of a trajectory, s")
            axes.set_title("one trajectory" if n == 1 else f"batch of {n}")
            axes.yaxis.set_major_locator(LogLocator(numticks=15))
            axes.grid(True, which="major", alpha=0.3)
            axes.spines[["top", "right"]].set_visible(False)
        panels[0][0].set_ylabel("largest relative energy error")
        order = [name for name in SHOWN if name in handles]
        figure.legend(
            [handles[name] for name in order], order, loc="outside lower center", ncols=4, fontsize=9, frameon=False
        )
        figure.suptitle("Hénon–Heiles to T = 1000: further left is faster, further down more accurate", fontsize=11)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=130, transparent=True)
        plt.close(figure)
