"""Our methods as torchode step methods: batches in which every sample has its own times, and gradients.

torchode drives with a fixed step per sample::

    register("verlet", system)
    controller = torchode.FixedStepController()
    torchode.solve_ivp(system, y0, t_eval, method="verlet", controller=controller, dt0=torch.full((len(y0),), 0.1))

A sample that runs backward needs a negative `dt0`: torchode itself would step away from its end for ever.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

try:
    from torchode.interface import register_method
    from torchode.single_step_methods import SingleStepMethod
    from torchode.single_step_methods.base import StepResult
except ImportError as error:  # pragma: no cover
    raise ImportError("sympflow.interop.torchode needs torchode: pip install torchode.") from error

from sympflow.arrays import to_numpy
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep
from sympflow.integrators.registry import naming_plugin
from sympflow.interop.matching import Comparison, fixed_step

_REMEDY = "Register the system of the term: register(name, system), and solve_ivp(system, ...)."


def register(name: str, system: HamiltonianSystem, method: Any = None, **options: Any) -> None:
    """Make one of our methods known to torchode, through its public `register_method`, under `name`.

    Parameters
    ----------
    name : str
        What `torchode.solve_ivp(method=name)` will say; also the method, if that is not given.
    system : HamiltonianSystem
        The system that is solved. torchode's term, if it is not this system, is compared with it at several states and
        times of a run; another one is a ValueError.
    method : str, trained flow or Integrator, optional
    **options
        Options of the method. The step length is torchode's `dt0`, so `dt` is not one of them.

    Raises
    ------
    TypeError, ValueError
        If the method does not apply to the system, chooses its own steps, or has no such option.
    """
    made = step_method(name if method is None else method, system, **options)
    register_method(name, lambda term: made)


def step_method(method: Any, system: HamiltonianSystem, **options: Any) -> SymplecticStep:
    """One of our methods as a torchode `SingleStepMethod`; arguments as for `register`."""
    if "dt" in options:
        raise TypeError("`dt` is not an option here: the step length is torchode's `dt0`, one for each sample.")
    return SymplecticStep(fixed_step(method, options, "torchode", system), system)


class Beginning(NamedTuple):
    """Beginning of a step: the states within it are computed from there."""

    t0: Tensor
    y0: Tensor


class Run:
    """One run: the end of each sample, and what its term is compared with."""

    def __init__(self, term: Any, problem: Any, method: SymplecticStep, stats: dict[str, Any], args: Any) -> None:
        self.ends: Tensor = problem.t_end.detach()
        self._term, self._stats, self._args = term, stats, args
        self._starts, self._y0 = problem.t_start.detach(), problem.y0.detach()
        self._n_steps = 0
        self._comparison = Comparison("term", method.integrator, method.system, _REMEDY, term.f)
        if self._comparison.given is not None:
            span = float(self._starts[0]), float(self.ends[0])
            self._comparison.at_start(self._at_fraction, to_numpy(self._y0), span, remembers=False)

    def _at_fraction(self, t: float, y: np.ndarray) -> np.ndarray:
        """The slopes of the term at t in the first sample, and as far on their way in the others."""
        t0, t1 = self._starts[0], self.ends[0]
        part = (t - t0) / (t1 - t0) if t1 != t0 else 0.0
        return self._slopes(self._starts + part * (self.ends - self._starts), self._y0.new_tensor(y))

    def _slopes(self, t: Tensor, y: Tensor) -> np.ndarray:
        with torch.no_grad():
            return to_numpy(self._term.vf(t, y, self._stats, self._args))

    def compare(self, t: Tensor, y: Tensor, last: bool) -> None:
        """Compare the term at the states y at t, if a comparison is due or the steps from there are the last."""
        self._n_steps += 1
        if self._comparison.given is not None and (self._comparison.is_due(self._n_steps) or last):
            t, y = t.detach(), y.detach()
            self._comparison.at(to_numpy(t), to_numpy(y), self._slopes(t, y), self._at_fraction, float(self._starts[0]))


class SymplecticStep(SingleStepMethod):
    """A fixed-step method of sympflow as a torchode step; dense output by a shorter step, without interpolation."""

    def __init__(self, integrator: FixedStep, system: HamiltonianSystem) -> None:
        super().__init__()
        self.integrator, self.system = integrator, system
        # the longest step that a flow was trained for; the state's own module, so that its weights are parameters
        self.flow = integrator.flow_for(system)

    def init(self, term: Any, problem: Any, f0: Tensor | None, *, stats: dict[str, Any], args: Any) -> Run:
        """The state of the method: its run."""
        if problem.n_features != 2 * self.system.ndof:
            raise ValueError(
                f"`y0` must have shape (batch, {2 * self.system.ndof}), [q, p]; got {problem.n_features} features."
            )
        times = to_numpy(torch.stack([problem.t_start, problem.t_end]).detach())
        self.system.check_times(times.min(), times.max())
        return Run(term, problem, self, stats, args)

    def step(
        self,
        term: Any,
        running: Tensor,
        y0: Tensor,
        t0: Tensor,
        dt: Tensor,
        state: Run,
        *,
        stats: dict[str, Any],
        args: Any,
    ) -> tuple[StepResult, Beginning, Run, None]:
        left = state.ends - t0.detach()
        # torchode cuts a step away from the end to one of length 0, and would go on for ever
        if ((dt.detach() * left <= 0) & (left.abs() > 1e-9 * (1 + state.ends.abs()))).any():
            raise ValueError(
                "`dt0` must have the sign of the direction in which its sample runs: make it negative "
                "for samples that run backward."
            )
        if self.flow is not None and (dt.detach().abs() > self.flow.dt * (1 + 1e-12)).any():
            raise ValueError(
                f"`dt0` must be at most the flow's Δt = {self.flow.dt:g}; got {float(dt.detach().abs().max()):g}. "
                "Drive it with torchode.FixedStepController and a smaller dt0."
            )
        state.compare(t0, y0, last=bool((left.abs() <= dt.detach().abs() * (1 + 1e-12)).all()))
        return StepResult(self._advance(t0, y0, dt), None), Beginning(t0, y0), state, None

    def _advance(self, t: Tensor, y: Tensor, h: Tensor) -> Tensor:
        with naming_plugin(self.integrator):
            return self.integrator.step(self.system, t, y, h.to(y.dtype))  # type: ignore[arg-type]

    def merge_states(self, accept: Tensor, current: Run, previous: Run) -> Run:
        return current

    def convergence_order(self) -> int:
        return self.integrator.order or 1

    def build_interpolation(self, data: Beginning) -> Within:
        return Within(self, data)


class Within:
    """The states inside a step: shorter steps from its beginning."""

    def __init__(self, method: SymplecticStep, data: Beginning) -> None:
        self.method, self.data = method, data

    def evaluate(self, t: Tensor, idx: Tensor) -> Tensor:
        t0 = self.data.t0[idx]
        return self.method._advance(t0, self.data.y0[idx], t - t0)
