"""docs/benchmarks.md: tables from the measured rows, and what they mean."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from contenders.goals import goals
from contenders.measurement import Results, Row
from contenders.prose import HEAD, NOTES, discussion, power

LISTED = (1e-3, 1e-6, 1e-9, 1e-12)


def page(results: Results, figure: Path) -> str:
    """The whole page, in Markdown."""
    counts = sorted({row.trajectories for row in results.rows})
    sections = [HEAD, machine(results), "## The targets\n", goal_table(results), step_table(results)]
    for n in counts:
        title = "One trajectory" if n == 1 else f"A batch of {n}"
        work = work_table(results, n)
        sections += [f"## {title}\n", run_time_table(results, n)]
        sections += [f"<details><summary>What it took: steps, evaluations, errors</summary>\n\n{work}\n\n</details>"]
    sections += [f"![Energy error against run time]({figure.as_posix()})", NOTES, first_call_table(results)]
    sections += [discussion(results), left_out(results)]
    return "\n\n".join(section.strip("\n") for section in sections if section) + "\n"


def machine(results: Results) -> str:
    e = results.environment
    versions = ", ".join(f"{name} {version}" for name, version in e["versions"].items())
    spreads = sorted(row.spread / row.seconds for row in results.rows)
    middle, most = spreads[len(spreads) // 2], spreads[-1]
    load = f"load average {e['load']:.1f} at the start, {e['load_after']:.1f} at the end"
    return (
        f"Measured on one thread of {e['processor']} ({e['cores']} cores, {e['system']}; {load}), in {e['repeats']} "
        f"interleaved rounds and {e['minutes']:.1f} minutes. The interquartile range over the rounds is below "
        f"{middle:.1%} of the time for half of the rows and at most {most:.0%}. Versions: {versions}. Ratios carry "
        "over to other machines better than times."
    )


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
    """Whether the steps are those of another row: our Verlet's, or SciPy's with the other right-hand side."""
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
    lines = [f"- {skip.package}: {skip.reason}." for skip in results.skipped]
    lines += [
        f"- {package} {label}, {n} trajector{'y' if n == 1 else 'ies'}: no setting reached {power(target)}."
        for label, package, n, target in results.unreached
    ]
    return "## Left out of this run\n\n" + "\n".join(lines) if lines else ""


def present_targets(results: Results, n: int) -> list[float]:
    return [t for t in LISTED if any(row.target == t and row.trajectories == n for row in results.rows)]


def grouped(results: Results, n: int) -> list[tuple[tuple[str, str], dict[float, Row]]]:
    """Rows by (package, label), each by target, in the order of the run."""
    groups: dict[tuple[str, str], dict[float, Row]] = {}
    for row in results.rows:
        if row.trajectories == n:
            groups.setdefault((row.package, row.label), {})[row.target] = row
    return list(groups.items())


def table(header: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    rows = [list(header), ["---"] * len(header), *map(list, lines)]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def duration(seconds: float) -> str:
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if seconds >= size:
            return f"{three(seconds / size)} {unit}"
    return f"{three(seconds / 1e-9)} ns"


def three(x: float) -> str:
    """Three significant digits, without an exponent."""
    if x >= 100:
        return f"{float(f'{x:.3g}'):,.0f}"
    return f"{x:#.3g}"
