"""The work–precision figure: energy error against run time, one trajectory and a batch."""

from __future__ import annotations

from pathlib import Path

from contenders.measurement import Results

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
