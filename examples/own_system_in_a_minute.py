"""A system that is not built in: train a flow for it in less than a minute, and see what it saves.

The flow is compared with splitting schemes at equal energy error: each gets the fewest steps with which it is as good,
over held-out states; then all run a long orbit, in the same compiled loops, in turn.

    python examples/own_system_in_a_minute.py             # one or two minutes
    python examples/own_system_in_a_minute.py --quick     # a shorter search and shorter runs
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

from sympflow import Box, EnergySublevel, HamiltonianSystem, get, max_energy_error, solve, train

# Two coupled Morse oscillators, the bonds of a molecule, well below dissociation: one symbolic definition. The domain
# says where the flow is trained and where its figures hold; an energy sublevel keeps its orbits.
system = HamiltonianSystem.from_sympy(
    "(p1**2 + p2**2)/2 + (1 - exp(-q1))**2 + (1 - exp(-q2))**2 + c*(1 - exp(-q1))*(1 - exp(-q2))",
    params={"c": 0.2},
    name="coupled_morse",
    domain=EnergySublevel(0.4, Box([-0.6, -0.6, -0.9, -0.9], [1.2, 1.2, 0.9, 0.9])),
    y0=[0.3, -0.2, 0.2, 0.3],
    t_span=(0.0, 1000.0),
)
RIVALS = ("kahan_li8", "blanes_moan4", "srkn6b", "srkn11b", "srkn14a", "chin4a", "omelyan4", "omelyan6")


def energy_error(method: object, states: np.ndarray, t_end: float) -> float:
    """The largest relative energy error up to t_end, the median over the states."""
    t = np.linspace(0.0, t_end, 501)
    # errors are measured, however large: without warnings of steps that are too long
    given = {"y0": states, "t_eval": t, "on_domain_exit": "ignore", "diagnose": False}
    with np.errstate(all="ignore"):
        errors = max_energy_error(solve(system, method, (0.0, t_end), **given))
    return float(np.median(errors))


def longest_step(name: str, target: float, states: np.ndarray, t_end: float) -> float:
    """The longest step, to 2 %, with which a scheme's energy error is at most the target."""
    short, long = 1e-3, 2.0
    while long > 1.02 * short:
        middle = (short * long) ** 0.5
        good = energy_error(get(name)(dt=middle), states, t_end) <= target
        short, long = (middle, long) if good else (short, middle)
    return short


def run_times(calls: list[Callable[[], object]], repeats: int) -> list[float]:
    """The shortest time of each call; they are timed in turn, so that they see the same machine."""
    times = []
    for _ in range(repeats):
        for call in calls:
            start = time.perf_counter()
            call()
            times.append(time.perf_counter() - start)
    return np.reshape(times, (repeats, -1)).min(0).tolist()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="a shorter search, shorter runs, fewer schemes")
    quick = parser.parse_args().quick
    start = time.perf_counter()
    flow = train(system, **({"restarts": 2, "steps": 30, "points": 60} if quick else {}))
    print(f"{flow}: trained in {time.perf_counter() - start:.0f} s")
    print(flow.certificate(system, **({"states": 200, "held_out": 20, "t_end": 100.0} if quick else {})), "\n")

    assert system.domain is not None
    states, t_end, far = system.domain.sample(20, 20_261), 100.0 if quick else 1000.0, 1e3 if quick else 1e5
    target = energy_error(flow, states, t_end)
    print(f"relative energy error up to t = {t_end:g}, the median of 20 held-out states: {target:.1e}")
    names = RIVALS[:2] if quick else RIVALS
    methods = {"the flow": flow} | {n: get(n)(dt=longest_step(n, target, states, t_end)) for n in names}
    calls = [lambda m=m: solve(system, m, (0.0, far), t_eval=[far], on_domain_exit="ignore") for m in methods.values()]
    times = run_times(calls, 3 if quick else 9)
    print(f"\n{'method':14}{'step':>9}{'time to t = ' + format(far, 'g'):>22}{'against the flow':>19}")
    for (name, method), seconds in sorted(zip(methods.items(), times, strict=True), key=lambda pair: pair[1]):
        print(f"{name:14}{method.dt:9.4f}{1e3 * seconds:19.2f} ms{seconds / times[0]:18.2f}×")


if __name__ == "__main__":
    main()
