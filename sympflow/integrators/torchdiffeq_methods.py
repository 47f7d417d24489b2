"""torchdiffeq's solvers as integrators, by name: batches in one tensor, gradients by backpropagation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np

from sympflow.arrays import Array, all_finite, is_tensor, to_numpy
from sympflow.integrators.base import FixedStep, Integrator, Problem
from sympflow.integrators.runge_kutta import ExplicitStep
from sympflow.integrators.tableaux import ADAPTIVE, FIXED, MULTISTEP, Tableau
from sympflow.integrators.torchdiffeq_adams import Adams
from sympflow.integrators.torchdiffeq_adaptive import Adaptive


@cache
def torchdiffeq_method(name: str) -> type[Integrator]:
    """The integrator class of torchdiffeq's solver of that name."""
    if name in MULTISTEP:
        return _named(name, Adams, {"order": MULTISTEP[name], "__doc__": f"torchdiffeq's `{name}`: {Adams.__doc__}"})
    tableau = (ADAPTIVE | FIXED)[name]
    base: type[Integrator] = Adaptive if name in ADAPTIVE else FixedGrid
    return _named(
        name,
        base,
        {
            "order": tableau.order,
            "tableau": tableau,
            "A": tableau.A,
            "B": tableau.B,
            "__doc__": f"torchdiffeq's `{name}`, order {tableau.order}: {tableau.source}\n\n{base.__doc__}",
        },
    )


def _named(name: str, base: type[Integrator], namespace: dict[str, Any]) -> type[Integrator]:
    namespace |= {"name": name, "__module__": __name__}
    return dataclass(frozen=True)(type(_class_name(name), (base,), namespace))


def _class_name(method: str) -> str:
    return method.title().replace("_", "")


def __getattr__(name: str) -> type[Integrator]:
    """The integrator classes as attributes of the module, where pickle looks for them."""
    for method in (*ADAPTIVE, *FIXED, *MULTISTEP):
        if name == _class_name(method):
            return torchdiffeq_method(method)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


@dataclass(frozen=True)
class FixedGrid(ExplicitStep, FixedStep):
    """A fixed-step Runge–Kutta method of torchdiffeq.

    Parameters
    ----------
    dt : float, optional
        Step length; the default is `system.dt`.
    """

    tableau: ClassVar[Tableau]

    def rollout(self, problem: Problem, h: float, n_steps: int, save: np.ndarray) -> tuple[Array, np.ndarray, str]:
        """Calls of `odeint` for 64 steps each, in the time s = (t − t0)/h, where h is exact."""
        import torch
        from torchdiffeq import odeint

        tensor = is_tensor(problem.y0)
        y = problem.y0 if tensor else torch.from_numpy(np.ascontiguousarray(problem.y0))
        states, k, last = [y] * int((save == 0).sum()), 0, int(save[-1]) if len(save) else 0
        finite = np.full(y.shape[:-1], n_steps)

        def scaled(s: Any, y: Any) -> Any:
            return h * problem.system.vector_field(y)

        with torch.set_grad_enabled(tensor and torch.is_grad_enabled()):
            while k < last:
                n = min(last - k, 64)
                wanted = save[(save > k) & (save <= k + n)] - k
                if (finite == n_steps).any():
                    block = odeint(scaled, y, torch.arange(n + 1, dtype=y.dtype, device=y.device), method=self.name)
                    ok = to_numpy(all_finite(block))
                    finite = np.where((finite == n_steps) & ~ok[-1], k + np.argmin(ok, axis=0) - 1, finite)
                    y = block[-1]
                    states += [block[i] for i in wanted.tolist()]
                else:
                    states += [y] * len(wanted)
                k += n
        out = torch.stack(states) if states else y[None][:0]
        return (out if tensor else out.numpy()), finite, "torchdiffeq"

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        return {"force_evaluations": len(self.B) * (n_steps + n_extra), "hessian_evaluations": 0}
