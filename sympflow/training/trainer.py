"""train(): from a Hamiltonian system to a flow, without data."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from numpy.typing import ArrayLike

from sympflow.arguments import plain
from sympflow.flow.arguments import check_system
from sympflow.flow.base import FlowMap
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.training.architecture import check_flow, kind_of, new_primed
from sympflow.training.arguments import check_surroundings, domain_for, refuse_unknown
from sympflow.training.interruption import Interruption
from sympflow.training.recipes import BUDGET
from sympflow.training.run import Path
from sympflow.training.search import SearchRun
from sympflow.training.starts import check_fit, start


def train(
    system: HamiltonianSystem,
    dt: float | None = None,
    *,
    kind: str | None = None,
    flow: FlowMap | None = None,
    domain: Domain | None = None,
    pairs: int | None = None,
    hidden: Sequence[int] | None = None,
    activation: str | None = None,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
    stages: int | None = None,
    processor: int | None = None,
    optimizer: str | None = None,
    loss: str | None = None,
    steps: int | None = None,
    points: int | None = None,
    residual_weight: float = 1.0,
    matching_weight: float | None = None,
    label_weight: float | None = None,
    data: tuple[ArrayLike, ArrayLike, ArrayLike] | None = None,
    matching_times: int = 10,
    learning_rate: float = 5e-3,
    schedule: str = "one-cycle",
    clip: float | None = 1.0,
    refresh: int | None = None,
    seed: int = 0,
    validate_every: int | None = None,
    validation_points: int = 2000,
    reference_states: int = 100,
    restarts: int | None = None,
    label_times: int | None = None,
    frozen_weight: float | None = None,
    energy_weight: float | None = None,
    checkpoint: Path | None = None,
    checkpoint_every: int | None = None,
    resume: Path | None = None,
    time_budget: float | None = None,
    progress: bool | None = None,
    callback: Callable[[int, dict[str, float]], None] | None = None,
    **unknown: Any,
) -> Any:
    """Train a flow map of `system` on [0, dt]: with nothing else given, the best that is known for it.

    For a separable symbolic system with T = ½ pᵀM⁻¹p that is a primed flow (`SympFlow.primed`), whose few numbers are
    fitted to the exact flow in seconds. In up to three degrees of freedom short trials choose its Δt, and whether its
    kicks have curvature terms (`sympflow.training.trials`), unless an option says something of the flow or its fit. For
    any other system it is a SympFlow with MLP potentials, symplectic for every H, trained by Adam on its residual and
    by Hamiltonian matching, without data. A flow of any kind, one made by `SympFlow.primed` or `SympFlow.split` among
    them, is trained further as `flow`.

    Parameters
    ----------
    system : HamiltonianSystem
    dt : float, optional
        Δt, the longest time of the map; the default is that of `flow`, for a new primed flow what suits the system's
        frequencies on Ω (see `sympflow.training.recipes`) and gains most in trials, else 1.
    kind : {"primed", "sympflow", "mlp"}, optional
        The architecture: a SympFlow primed with the system's V and T; one with MLP potentials; or the unconstrained
        baseline with as many parameters as the SympFlow that `pairs` and `hidden` describe. The default is "primed"
        for the systems above, unless an option says that it is to be a network.
    flow : FlowMap, optional
        Train a copy of this flow further (a second stage, say, with another optimizer) in place of a new one.
    domain : Domain, optional
        Ω; the default is that of the system.
    stages, processor
        Of a new primed flow, see `SympFlow.primed`; the defaults are 3 kicks, or as many as a given `dt` needs, and a
        processor of 6.
    pairs, hidden, activation, dtype, device
        Of a new network, see `SympFlow`; the defaults are 3, (10, 10), "tanh" and float64 on the CPU.
    optimizer : {"gauss-newton", "adam", "bfgs", "lbfgs"}, optional
        The default is "gauss-newton" for primed and split flows, "adam" for networks, which "gauss-newton" trains far
        better.
    steps, points, residual_weight, matching_weight, label_weight, matching_times, learning_rate, schedule, clip,
    refresh, seed, validate_every, validation_points, reference_states, checkpoint_every
        See `TrainingConfig`. What is left out gets the optimizer's own default: 20,000 steps on 700 fresh points
        for Adam, at most 200 on 1500 fixed points for Gauss–Newton. A baseline has no Hamiltonian, so its matching
        weight is 0; Gauss–Newton leaves matching out as well, unless it is given a weight.
    data : (array (n,), array (n, 2d), array (n, 2d)), optional
        Labels of a network: times in [0, dt], states, and where the exact flow takes them; a tenth is held out.
        `label_weight` is then 1. Without data, labels are made where `label_weight` is given.
    loss : str, optional
        Some of "residual", "matching" and "labels", joined by "+": those that are left out get the weight 0. The
        default is "labels" for primed flows with optimizer="gauss-newton", else what the weights say.
    restarts, label_times, frozen_weight
        Of "gauss-newton" on a primed or a split flow, which takes of those above `steps`, `points`, `seed` and
        `reference_states`: see `search_config`. `label_times` counts for a network's `label_weight` too.
    energy_weight : float, optional
        Of "gauss-newton" on a primed flow: how much an error in the energy counts beside those of the coordinates. 10
        by default; 1000 for runs of which only the energy matters, 0 for none.
    checkpoint : path, optional
        Write the state of the run there every `checkpoint_every` steps, atomically; of a primed flow after each start
        of the search, and first as soon as there is a run: of one that is killed in the trials nothing is kept.
    resume : path, optional
        Go on from this checkpoint, given the same arguments otherwise; the weights end bit-identical to those of a
        run that was not interrupted.
    time_budget : float, optional
        Stop after so many seconds, trials and labels among them. The default for a new primed flow is 60, unless
        `restarts`, `steps` or `resume` is given: the search then takes fewer starts than it might, which the recipe
        records; else there is none.
    progress : bool, optional
        Show a progress bar; the default is on a terminal only.
    callback : callable, optional
        callback(step, figures) after each validation; `figures` has the held-out losses and one-step error.

    Returns
    -------
    SympFlow or MLPFlow
        In its best state by the held-out loss, its parameters without gradient; `recipe` and `figures` tell how it
        was made and what it achieves, `history` the held-out figures over the run. Ctrl-C, a used-up budget and a
        loss that is not finite also end the run with the best state so far, and a warning. Ctrl-C does so within
        seconds, once there is a state to return: in the trials from the end of the first. A second one raises.

    Warns
    -----
    UserWarning
        If a primed flow is far from the exact one: where its error in one step of Δt is, in the mean over held-out
        states, a tenth or more of what the step moves a state, coordinates in units of their spread over Ω.

    Raises
    ------
    ValueError
        If the system has no domain and none is given, or an argument is not admissible.
    TypeError
        If an option is not one of the optimizer's, or of no training at all.
    FloatingPointError
        If the loss is not finite from the start.
    KeyboardInterrupt
        On Ctrl-C before there is anything to return, or twice.
    """
    given, begin = {name: plain(value) for name, value in locals().items()}, time.perf_counter()
    refuse_unknown(given.pop("unknown"))
    check_system(system)
    check_surroundings(given)
    dt, time_budget = given["dt"], given["time_budget"]
    domain = domain_for(system, domain)
    hurried = flow is None and time_budget is None and restarts is None and steps is None and resume is None
    kind = kind_of(system, given)
    with Interruption() as interruption:
        tried = None
        if flow is not None:
            check_flow(flow, system, dt)
        elif kind == "primed":
            check_fit(given)
            flow, tried = new_primed(system, domain, given, interruption)
        run = start(system, domain, kind, flow, given)
        if resume is not None:
            run.load(resume)
        if isinstance(run, SearchRun):
            run.interruption, run.tried = interruption, tried
        hurried = hurried and isinstance(run, SearchRun)
        passed = time.perf_counter() - begin  # trials, labels and their compilation
        run.seconds += passed
        if (seconds := BUDGET if hurried else time_budget) is not None:
            time_budget = max(seconds - passed, min(seconds, 1.0))
        reason = run.go(checkpoint, time_budget, progress, callback)
    return run.finish(reason, expected=hurried)
