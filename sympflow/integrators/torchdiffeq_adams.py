"""torchdiffeq's multistep methods."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from sympflow.arguments import check_dt
from sympflow.arrays import Array
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import Problem, Steps
from sympflow.integrators.grid import Grid
from sympflow.integrators.interpolants import hermite
from sympflow.integrators.torchdiffeq_driver import Trace, Visit, Watched


@dataclass(frozen=True)
class Adams(Watched):
    """A multistep method on the grid t0 + k·dt, begun with Runge–Kutta steps; cubic interpolation in between.

    It has no one-step map: there is no bare step, and no volume to measure.

    Parameters
    ----------
    dt : float, optional
        Step length; the default is `system.dt`.
    max_order : int
        Highest order that is built up, at least 4; torchdiffeq's own default of 12 is unstable for dt of ordinary size.
    """

    dt: float | None = None
    max_order: int = 4

    symplectic: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_dt(self.dt)
        if not isinstance(self.max_order, int | np.integer) or self.max_order not in range(4, 13):
            raise ValueError(f"`max_order` must be an integer from 4 to 12; got {self.max_order!r}.")

    def step_length(self, system: HamiltonianSystem) -> float:
        return float(self.dt if self.dt is not None else system.dt)

    def steps(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array) -> Steps:
        raise TypeError(
            f"`method` {self.name!r} is a multistep method, with no bare step to repeat or differentiate: use a "
            "one-step method."
        )

    def outputs(self, problem: Problem) -> tuple[np.ndarray, dict[str, Any]]:
        dt = self.step_length(problem.system)
        return Grid(problem.t0, problem.t1, dt).outputs(problem.t_eval, problem.save_every)[0], {"dt": dt}

    def make_trace(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array, visit: Visit) -> Trace:
        return _Nodes(self.step_length(system), system, t_span, y0, visit)

    def integrate(self, trace: Trace, y: Any, length: float) -> None:
        import torch
        from torchdiffeq import odeint

        assert isinstance(trace, _Nodes)
        nodes = torch.as_tensor(np.abs(np.array(trace.times) - trace.times[0]), device=y.device)
        options = {"grid_constructor": lambda f, y0, t: nodes, "max_order": self.max_order}
        with warnings.catch_warnings(record=True) as raised:
            warnings.simplefilter("always")
            states = odeint(trace, y, nodes[[0, -1]], method=self.name, rtol=1e-7, atol=1e-9, options=options)
        for warning in raised:
            if str(warning.message).startswith("Functional iteration did not converge"):
                trace.note = " Its functional iteration did not converge in every step: reduce `dt`."
            else:
                warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
        trace.callback_step(None, None, None)
        trace(None, states[-1])


class _Nodes(Trace):
    """Follows the grid: the first slope that is asked for in a step is that at its beginning."""

    def __init__(self, dt: float, system: HamiltonianSystem, t_span: tuple[float, float], *arguments: Any) -> None:
        super().__init__(system, t_span, *arguments)
        grid = Grid(*t_span, dt)
        self.times = [grid.t0 + k * grid.h for k in range(grid.n_steps + bool(grid.remainder))] + [grid.t1]
        self.before: tuple[Array, Array] | None = None
        self.begins = False

    def callback_step(self, s: Any, y: Any, dt: Any) -> None:
        self.begins = True

    def evaluated(self, y: Any, f: Any) -> None:
        if not self.begins:
            return
        self.begins = False
        if not (y.isfinite().all() and f.isfinite().all()):
            raise AssertionError("the state is not finite; reduce `dt`")
        y, f = self.array(y), self.array(f)
        before, self.before = self.before, (y, f)
        if before is not None:
            k = self.n_steps
            self.announce(hermite(self.times[k], self.times[k + 1], before[0], y, before[1], f))
