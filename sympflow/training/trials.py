"""Short fits by which `train` chooses the flow to fit to a system of which nothing else is said."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sympflow.flow.scaling import Scaling
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.schemes import CURVATURE, FORCE_GRADIENT
from sympflow.training.collocation import Stream, states
from sympflow.training.gauss_newton import GaussNewtonRun
from sympflow.training.recipes import PHASE, PrimedRecipe, default_recipe
from sympflow.training.search_config import TableConfig
from sympflow.training.table_errors import USELESS, shares_missed
from sympflow.training.watch import Watch

PHASES = (PHASE, 1.25, 1.5)  # ω Δt of the flows that are tried
STARTS, STEPS, FINAL_STEPS, POINTS = 6, 40, 160, 80  # of a trial's search, and what follows the best start
ORBITS, LENGTH = 20, 256  # held-out orbits of a trial, and their steps
ORDER = 8  # with which the errors of classical schemes fall where these flows are used
MOST_NDOF = 3  # beyond which trials take too long
DEAREST = 2.0  # times the cycles of a kick without them, beyond which curvature terms are not tried
GOAL = 1e-5  # the energy error of a trial that a default flow shall not exceed, if one of those tried does not
ALIKE = 2.0  # energy errors above that which differ by no more are the same


def chosen_recipe(system: HamiltonianSystem, domain: Domain, watch: Watch | None = None) -> PrimedRecipe:
    """The recipe of the flow that gains most: that of `default_recipe`, or one with a longer Δt or curvature terms.

    Of each the table at Δt is fitted for a few seconds, and followed along held-out orbits. Where its energy error is
    e, the work of a classical scheme of order p is in proportion to e^(−1/p); so the flow gains most whose kicks take
    the fewest cycles in a unit of time, times e^(1/p), p = 8. Curvature terms are tried with the best Δt, unless they
    make kicks twice as dear. Where all errors are above 1e-5 it is the flow with the smallest, or of those with up to
    twice that the one that gains most. The choice depends on the system and Ω alone, not on the machine.

    Parameters
    ----------
    system : HamiltonianSystem
        Separable, symbolic, T = ½ pᵀM⁻¹p.
    domain : Domain
    watch : Watch, optional
        It shows the trials, keeps their flows, and may end them: then it is the best so far.
    """
    from sympflow.kernels.kicks import kick_cycles

    assert system.symbols is not None
    recipes = tried_recipes(system, domain, curvature=False)
    try:
        cycles = [kick_cycles(system.symbols, level) for level in (FORCE_GRADIENT, CURVATURE)]
    except ValueError:  # H has no compiled form
        return recipes[0]
    watch, errors = Watch() if watch is None else watch, dict[PrimedRecipe, float]()

    def best(tried: list[PrimedRecipe]) -> PrimedRecipe:
        least = min(errors[recipe] for recipe in tried)
        worst = GOAL if least <= GOAL else ALIKE * least
        work = {
            r: cycles[r.curvature] * r.stages / r.dt * errors[r] ** (1 / ORDER) for r in tried if errors[r] <= worst
        }
        return min(work, key=work.__getitem__)

    bends = cycles[1] <= DEAREST * cycles[0]
    with watch.bar(len(recipes) + bends, f"{system.name} trials") as bar:

        def tried(recipe: PrimedRecipe) -> bool:
            bar.tries(len(errors), f"Δt = {recipe.dt:g}{', with curvature terms' * recipe.curvature}")
            error = trial_error(recipe, system, domain, watch)
            if not watch.stopped():
                errors[recipe] = error
                watch.arm()
            return recipe in errors

        plain = best([recipe for recipe in recipes if not watch.stopped() and tried(recipe)])
        bent = replace(plain, curvature=True)
        return best([plain, bent]) if bends and not watch.stopped() and tried(bent) else plain


def tried_recipes(system: HamiltonianSystem, domain: Domain, curvature: bool = True) -> list[PrimedRecipe]:
    """Those that may be chosen, from the shortest Δt to the longest; with `curvature` those with such terms too."""
    plain = list(dict.fromkeys(default_recipe(system, domain, phase=phase) for phase in PHASES))
    return plain + [replace(recipe, curvature=True) for recipe in plain if curvature]


def trial_error(recipe: PrimedRecipe, system: HamiltonianSystem, domain: Domain, watch: Watch | None = None) -> float:
    """The relative energy error of a short fit of the flow at its Δt, the median over held-out orbits.

    Infinite if there are no orbits, or the fit leads nowhere: where in the median it misses a tenth of what a step
    moves a state. The energy alone would be kept best by the identity.
    """
    watch = Watch() if watch is None else watch
    config = TableConfig(
        points=POINTS, label_times=1, restarts=STARTS, steps=STEPS, reference_states=ORBITS, seed=recipe.seed
    )
    scaling = Scaling.of_samples(states(domain, 1000, recipe.seed, Stream.SCALING), recipe.dt)
    try:
        run = GaussNewtonRun.start(recipe.flow(system), system, domain, scaling, config)
    except ValueError:  # of no state of Ω the solution exists up to Δt
        return math.inf
    fit = run.frozen
    assert fit is not None
    for _ in range(STARTS):
        run.minima.append(run.next_minimum(watch.stopped))
    best = min(run.minima, key=lambda m: m.cost)
    for final in filter(None, (fit, run.weighted)):
        best = final.minimize(best.x, FINAL_STEPS, watch.stopped, thorough=True)
    table = fit.coefficients(best.x)[:, :1]
    y = states(domain, ORBITS, recipe.seed, Stream.REFERENCE)
    H, worst, y = system.hamiltonian(y), np.zeros(len(y)), y.T
    labels = run.held_out
    with np.errstate(all="ignore"):
        missed = run.step(table, labels.x.T).T - labels.y[-1]
        if not shares_missed(missed, labels, np.array(scaling.x))[1] < USELESS:
            return math.inf
        for _ in range(LENGTH):
            y = run.step(table, y)
            worst = np.maximum(worst, np.abs(system.hamiltonian(y.T) - H))
        worst /= np.abs(H) if system.energy_scale is None else system.energy_scale
    error = float(np.median(np.where(np.isnan(worst), np.inf, worst)))
    if math.isfinite(error) and not watch.stopped():
        run.table.assign(run.table.continued(table[:, 0]))
        watch.flows[recipe] = run.flow
    return error
