"""The fragments of docs/benchmarks.md and its figure, from the measured rows."""

from __future__ import annotations

from pathlib import Path

from measuring.fragments import duration, table, three

from contenders.measurement import Results, Row, find, goals

LISTED = (1e-3, 1e-6, 1e-9, 1e-12)
COLOURS = {
    "Numba": "#000000",
    "heyoka": "#c0392b",
    "diffrax": "#e08e0b",
    "SciPy": "#2e8b57",
    "torchdiffeq": "#8e44ad",
    "torch": "#b07aa1",
    "NumPy": "#7f7f7f",
}
MARKERS = "osD^vP*X"


def fragments(results: Results) -> dict[str, str]:
    """All fragments by their names: the tables of one trajectory and of the batch, the targets, who is ahead."""
    found = {"peers-run": run_table(results), "peers-targets": goal_table(results), "peers-steps": step_table(results)}
    for n in sorted({row.trajectories for row in results.rows}):
        name = "one" if n == 1 else "batch"
        found |= {f"peers-{name}": run_time_table(results, n), f"peers-{name}-work": work_table(results, n)}
    found |= {"peers-first-calls": first_call_table(results), "peers-fastest": fastest_table(results)}
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
            f"{'dt' if row.control == 'dt' else 'tol'} {row.value:.2g}",
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
    return package in ("Numba", "NumPy", "torch") or label.startswith("leapfrog")


def first_call_table(results: Results) -> str:
    lines = [
        (call.label, call.package, str(call.trajectories), duration(call.seconds))
        for call in results.first_calls
        if call.seconds > 0.005
    ]
    return table(("method", "package", "trajectories", "first call, less the second"), lines)


def left_out(results: Results) -> str:
    """Packages that are not there, and targets that were not reached."""
    rows = [(skip.package, "all", skip.reason) for skip in results.skipped]
    rows += [
        (package, f"{label}, {n} trajector{'y' if n == 1 else 'ies'}", f"no setting reached {power(target)}")
        for label, package, n, target in results.unreached
    ]
    return table(("package", "method", "left out because"), rows or [("none", "", "")])


def fastest_table(results: Results) -> str:
    """Our fastest scheme, the time of the fastest other package over its, and diffrax's leapfrog over our Verlet."""
    packages = sorted({row.package for row in results.rows} - {"sympflow", "Numba"})
    rows = []
    for n in sorted({row.trajectories for row in results.rows}):
        for target in LISTED:
            mine, peer = fastest(results, n, target, ["sympflow"]), fastest(results, n, target, packages)
            if not (mine and peer):
                continue
            same = leapfrog_ratio(results, n, target)
            cells = [mine.label, f"{peer.package}: {peer.label}", f"{peer.seconds / mine.seconds:.2f}"]
            rows.append(["one" if n == 1 else n, power(target), *cells, "" if same is None else f"{same:.2f}"])
    titles = (
        "trajectories",
        "error",
        "our fastest",
        "fastest of the others",
        "takes, times",
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
        verlet, best = pick(results, "sympflow", "verlet", 1, target), fastest(results, 1, target, ["sympflow"])
        if verlet and best:
            rows.append((power(target), best.label, three(verlet.seconds / best.seconds)))
    return table(("error", "our fastest", "times faster than our Verlet"), rows)


def pick(results: Results, package: str, label: str, n: int, target: float) -> Row | None:
    key = (package, label, n, target)
    return find(results, lambda r: (r.package, r.label, r.trajectories, r.target) == key)


def fastest(results: Results, n: int, target: float, packages: list[str]) -> Row | None:
    rows = [r for r in results.rows if r.trajectories == n and r.target == target and r.package in packages]
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


def draw(results: Results, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import LogLocator

    counts = sorted({row.trajectories for row in results.rows})
    figure, panels = plt.subplots(
        1, len(counts), figsize=(6.6 * len(counts), 6.4), squeeze=False, sharey=True, layout="constrained"
    )
    for axes, n in zip(panels[0], counts, strict=True):
        seen: dict[str, int] = {}
        curves: dict[tuple[str, str], list[tuple[float, float]]] = {}
        for row in results.rows:
            if row.trajectories == n:
                curves.setdefault((row.package, row.label), []).append((row.seconds, row.energy_error))
        for (package, label), points in curves.items():
            marker = MARKERS[seen.setdefault(package, 0) % len(MARKERS)]
            seen[package] += 1
            x, y = zip(*points, strict=True)
            ours = package == "sympflow"
            shade = plt.get_cmap("winter")(seen[package] / 8) if ours else COLOURS.get(package)
            axes.loglog(
                x,
                y,
                marker=marker,
                markersize=5,
                color=shade,
                linewidth=1.6 if ours else 1.1,
                linestyle="-" if ours else "--",
                zorder=3 if ours else 2,
                label=f"{label} ({package})",
            )
        axes.set_xlabel("run time of a trajectory, s")
        axes.set_title("one trajectory" if n == 1 else f"batch of {n}")
        axes.yaxis.set_major_locator(LogLocator(numticks=15))
        axes.grid(True, which="major", alpha=0.3)
        axes.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.11), ncols=2, frameon=False)
    panels[0][0].set_ylabel("largest relative energy error")
    figure.suptitle("Hénon–Heiles to T = 1000: lower left is better", fontsize=11)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    plt.close(figure)
