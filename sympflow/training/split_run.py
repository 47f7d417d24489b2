"""Gauss–Newton training of split flows: their weights, filters and angles, fitted to the exact flow of a system.

First the maps frozen at Δt, a dozen numbers, from many random starts. Then numbers are followed from equal steps at a
small t up to Δt, each fit starting where the last ended (or down from the best at Δt, if those are much better);
polynomials in t are put through them, and these are fitted to labels at all times together.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from sympflow.flow.split import SplitFlow
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.training.levenberg_marquardt import Minimum
from sympflow.training.search import SearchRun, Stop
from sympflow.training.search_config import SplitConfig
from sympflow.training.split_fit import SplitFit


@dataclass
class SplitRun(SearchRun):
    """The state of a fit of a split flow, and what acts on it."""

    flow: SplitFlow
    config: SplitConfig
    fit: SplitFit

    @classmethod
    def start(cls, flow: SplitFlow, system: HamiltonianSystem, domain: Domain, config: SplitConfig) -> SplitRun:
        """A run of a flow that is bound to its system.

        Raises
        ------
        ValueError
            If the system cannot be compiled, or no solution from the domain exists up to Δt.
        """
        return cls(flow, system, domain, config, None, SplitFit(flow, system, domain, config))

    def next_minimum(self, stop: Stop) -> Minimum:
        """At Δt, its x the numbers u: from the flow as it is, then from random ones."""
        fit, restart, last = self.fit, len(self.minima), len(self.fit.t) - 1
        u = fit.random(restart) if restart else fit.current(fit.t[last])
        return fit.minimize(u, last, self.config.steps, stop)

    def found(self, minimum: Minimum) -> dict[str, float]:
        self.history.append({"step": len(self.minima), "loss": minimum.cost, "iterations": minimum.iterations})
        return self.history[-1]

    def complete(self, spent: Callable[..., bool]) -> None:
        u = self.fit.current(self.fit.t[-1])  # if there was no time for a start
        if self.minima:
            best = min(self.minima, key=lambda m: m.cost)
            if not math.isfinite(best.cost):
                raise FloatingPointError("The residuals are not finite from any start: shrink `domain` or `dt`.")
            u = best.x
        whole = self.fit.whole(u, spent)
        last = {"step": len(self.minima), "loss": whole.cost, "iterations": whole.iterations}
        self.history.append(last | self.fit.errors())
