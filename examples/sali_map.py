"""Order and chaos in the phase plane of Hénon and Heiles: SALI of 500 × 500 orbits at the energy 1/8.

Each pixel is an orbit that starts at q₁ = 0 with p₁ > 0 from its energy. Where SALI has fallen to 1e-12 by the end the
orbit is chaotic, and was run no further; the colour tells when. Regular orbits keep a SALI of order one.

    python examples/sali_map.py [--quick] [--out docs/figures/sali_henon_heiles.png]
"""

from __future__ import annotations

import argparse
import time

import numpy as np

import sympflow

ENERGY = 1 / 8
SIDES = (-0.45, 0.7, -0.52, 0.52)  # of the (q₂, p₂) plane


def plane(n: int) -> tuple[np.ndarray, np.ndarray]:
    """The initial states (N, 4) of the pixels that the energy allows, and which of the n × n pixels these are."""
    q2, p2 = np.meshgrid(np.linspace(*SIDES[:2], n), np.linspace(*SIDES[2:], n))
    square = 2 * ENERGY - q2**2 + 2 * q2**3 / 3 - p2**2  # of p₁
    allowed = square >= 0
    zero = np.zeros(allowed.sum())
    return np.stack([zero, q2[allowed], np.sqrt(square[allowed]), p2[allowed]], axis=1), allowed


def sali_map(n: int, t_end: float, workers: int) -> tuple[np.ndarray, np.ndarray, float]:
    """SALI and its time (n, n), NaN where no orbit starts, and the seconds that it took."""
    y0, allowed = plane(n)
    start = time.perf_counter()
    result = sympflow.ensemble(
        sympflow.systems.henon_heiles(), "verlet", (0, t_end), y0, dt=0.05, reduce="sali", workers=workers
    )
    seconds = time.perf_counter() - start
    index, ended = np.full((2, n, n), np.nan)
    index[allowed], ended[allowed] = result.sali, result.sali_time
    return index, ended, seconds


def draw(index: np.ndarray, ended: np.ndarray, t_end: float, path: str) -> None:
    """The picture: chaotic orbits by the time at which SALI fell to 1e-12, regular ones by SALI at the end."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.2, 6.4), layout="constrained", facecolor="white")
    axes = figure.add_subplot()
    chaotic = ended < t_end
    regular = np.where(chaotic, np.nan, np.log10(np.maximum(index, 1e-12)))
    low = axes.imshow(regular, origin="lower", extent=SIDES, cmap="Blues_r", vmin=-4, vmax=0.5, aspect="auto")
    late = axes.imshow(
        np.where(chaotic, ended, np.nan), origin="lower", extent=SIDES, cmap="autumn", vmin=0, vmax=t_end, aspect="auto"
    )
    figure.colorbar(low, ax=axes, label="log₁₀ SALI at the end", shrink=0.8, extend="min")
    figure.colorbar(late, ax=axes, label="time at which SALI fell to 1e-12", shrink=0.8)
    axes.set(xlabel="q₂", ylabel="p₂", title=f"Hénon–Heiles, E = 1/8, q₁ = 0: SALI up to t = {t_end:g}")
    figure.savefig(path, dpi=110)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="40 × 40 orbits, up to t = 300")
    parser.add_argument("--out", default="sali_henon_heiles.png")
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args(arguments)
    n, t_end = (40, 300.0) if given.quick else (500, 2000.0)
    index, ended, seconds = sali_map(n, t_end, given.workers)
    orbits, chaotic = int(np.isfinite(index).sum()), int((ended < t_end).sum())
    print(f"{orbits:,} orbits up to t = {t_end:g}, {chaotic / orbits:.1%} of them chaotic: {seconds:.1f} s")
    draw(index, ended, t_end, given.out)


if __name__ == "__main__":
    main()
