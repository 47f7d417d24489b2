"""A SympFlow of the doubled damped oscillator, q'' = −q − λq', at the cases of the paper's authors: λ = 0.1, 0.5 and 1.

    python benchmarks/doubled.py [--out docs/measured]

Δt = 1. For each λ a network SympFlow is trained by Gauss–Newton on labels at t = Δt: states of the doubled system, and
where it takes them, by Gauss–Legendre 8. It is judged in the physical limit against the formula, over states with
q² + p² < 1: the largest error after one step, after 10, and after 100, with and without projection of every step.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import time
import warnings

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

import numpy as np
from measuring import fragments
from scipy.linalg import expm

import sympflow
from sympflow import Ball, Box, doubled, solve, systems, train

DT = 1.0
RATES = (0.1, 0.5, 1.0)
NETWORK = {"pairs": 4, "hidden": (10,)}
STATES = Ball([0.0, 0.0], 1.0)


def trained(
    rate: float, labels: int, steps: int
) -> tuple[sympflow.hamiltonian.doubling.DoubledSystem, sympflow.SympFlow]:
    """The doubled oscillator and a flow of it on [0, Δt], whose labels are all at Δt."""
    domain = Box([-1.5, -0.5, -0.5, -1.5], [1.5, 0.5, 0.5, 1.5])
    system = doubled(systems.harmonic_oscillator(), "-rate*p", params={"rate": rate}, domain=domain)
    x = domain.sample(labels, 1)
    ends = solve(system, "gauss_legendre8", (0.0, DT), x, dt=DT / 20, t_eval=[DT]).y[..., 0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # at other times than Δt the flow is not meant to hold
        flow = train(
            system,
            DT,
            kind="sympflow",
            optimizer="gauss-newton",
            loss="labels",
            data=(np.full(labels, DT), x, ends),
            steps=steps,
            seed=0,
            progress=False,
            **NETWORK,
        )
    return system, flow


def errors(system, flow, rate: float, counts: tuple[int, ...], projected: bool) -> list[float]:
    """The largest error of the physical states after so many steps."""
    y0 = STATES.sample(200, 2)
    times = DT * np.array(counts)
    method, options = ("projected", {"of": flow}) if projected else (flow, {})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # without projection the difference grows: that is measured
        sol = solve(system, method, (0.0, times[-1]), y0, t_eval=times, on_domain_exit="ignore", **options).physical()
    A = np.array([[0.0, 1.0], [-1.0, -rate]])
    exact = np.stack([y0 @ expm(A * t).T for t in times], axis=-1)
    return np.linalg.norm(sol.y - exact, axis=-2).max(0).tolist()


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--labels", type=int, default=150)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--rates", type=float, nargs="*", default=list(RATES))
    fragments.add_out(parser)
    asked = parser.parse_args(arguments)
    lines = [
        "| λ | parameters | training | Δt | 10 Δt | 100 Δt | projected: Δt | 10 Δt | 100 Δt |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for rate in asked.rates:
        start = time.process_time()
        system, flow = trained(rate, asked.labels, asked.steps)
        seconds = time.process_time() - start
        found = [e for projected in (False, True) for e in errors(system, flow, rate, (1, 10, 100), projected)]
        cells = (f"{rate:g}", str(flow.n_parameters), f"{seconds:.0f} s", *(f"{e:.1e}" for e in found))
        lines.append(f"| {' | '.join(cells)} |")
        print(lines[-1], flush=True)
    fragments.write(asked.out, "doubled", "\n".join(lines))


if __name__ == "__main__":
    main()
