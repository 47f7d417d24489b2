"""Train a SympFlow on a system that is not built in, check it on fresh states, and compare it with Verlet.

python examples/own_system.py            # about two minutes on two cores
python examples/own_system.py --steps 50 # a quick look, not a good flow
"""

from __future__ import annotations

import argparse

from sympflow import Box, EnergySublevel, HamiltonianSystem, compare, train

# A quartic oscillator: one symbolic definition; the domain says where the flow is trained and where its figures hold.
system = HamiltonianSystem.from_sympy(
    "p**2/2 + q**2/2 + lam*q**4/4",
    params={"lam": 0.5},
    name="quartic_oscillator",
    domain=EnergySublevel(1.0, Box([-1.3, -1.5], [1.3, 1.5])),
    y0=[1.0, 0.0],
    t_span=(0.0, 500.0),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--steps", type=int, default=10_000, help="steps of Adam")
    arguments = parser.parse_args()
    flow = train(system, dt=1.0, steps=arguments.steps, seed=0)
    print(flow.figures)
    print(compare(system, [("SympFlow", flow), "verlet", "rk45"], metrics=("energy", "volume", "error")).table())


if __name__ == "__main__":
    main()
