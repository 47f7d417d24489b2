"""Learn a pendulum from noisy trajectories at irregular times: its flow, its formula, and how certain they are.

python examples/learn_pendulum.py [--quick] [--out learn_pendulum.png]
"""

import argparse

import numpy as np

import sympflow
from sympflow.learning.figures import held_out_figure
from sympflow.learning.trajectories import Trajectories

NOISE = 0.02


def measured(n: int, points: int, span: float = 4.0, seed: int = 0) -> Trajectories:
    """Trajectories of a pendulum as an instrument might give them: with noise, each at its own times."""
    rng = np.random.default_rng(seed)
    system = sympflow.systems.pendulum()
    runs = []
    for y0 in rng.uniform(-1.5, 1.5, (n, 2)):
        t = np.sort(rng.uniform(0, span, points))
        y = sympflow.solve(system, "kahan_li8", (0, span), y0, dt=0.05, t_eval=t).y
        runs.append((t, y + NOISE * rng.standard_normal(y.shape)))
    return Trajectories.read(runs)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="less data and less time")
    parser.add_argument("--out", help="file for a figure")
    options = parser.parse_args()
    data = measured(8, 25) if options.quick else measured(30, 40)
    flow = sympflow.learn(data, period=2 * np.pi, dt=0.5, replicas=4 if options.quick else 20, time_budget=40)
    print(f"H = {flow.system.expression}")
    print(f"chosen: {flow.recipe['learned']['model']}, for {flow.recipe['learned']['reason']}")
    print(f"noise: {flow.figures['noise']:.3g} (true: {NOISE})")
    t = np.linspace(0, 20, 41)
    low, high = flow.replicas.bands([1.0, 0.0], t)
    sol = sympflow.solve(flow.system, flow, (0, 20), [1.0, 0.0], t_eval=t)
    print(f"q(20) = {sol.y[0, -1]:.4f}, between {low[0, -1]:.4f} and {high[0, -1]:.4f}")
    if options.out:
        held_out_figure(flow, data.split()[1]).savefig(options.out, dpi=110)


if __name__ == "__main__":
    main()
