"""The recipes of the flows that ship, a row each.

Ladders of primed flows, from a few kicks to many, so that there is a cheap one for every accuracy; SympFlows of the
exact flows of their parts, for stiff systems; SympFlows with MLP potentials, and unconstrained baselines of as many
parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sympflow.flow.flow_map import FlowMap
from sympflow.hamiltonian.domain import Box, Domain, EnergySublevel
from sympflow.hamiltonian.lattice_states import LatticeStates
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.solver import solve
from sympflow.systems import (
    SYSTEMS,
    duffing,
    fput,
    harmonic_oscillator,
    henon_heiles,
    pendulum,
    phi4,
    sine_gordon,
    spring_pendulum,
)
from sympflow.training.clock_fit import train_clock
from sympflow.training.options import NewFit
from sympflow.training.shipped.judges import AsPublished, ByBalance, ByCertificate, ByClock, ByRuns, OfStiff
from sympflow.training.shipped.recipe import Judge, Recipe
from sympflow.training.starts import Network, Primed, Split

YEAR = 365.25  # days


def recipes() -> list[Recipe]:
    """All recipes, those of a scene one after another; each comes after that from which it starts."""
    return [*networks(), *ladders(), *stiff()]


# ladders ------------------------------------------------------------------------------------------------------------


def rung(
    scene: str,
    stages: int,
    dt: float,
    processor: int = 6,
    fit: NewFit | None = None,
    *,
    curvature: bool | tuple[int, ...] = False,
    force_gradient: bool | tuple[int, ...] | None = None,
    polynomial: int | None = None,
    first: str = "drift",
    after: str | None = None,
    judge: Judge | None = None,
) -> Recipe:
    """A primed flow of a ladder; its search has 12 starts if nothing else is said.

    Parameters
    ----------
    scene, after, judge
        See `Recipe`; it is judged by its certificate over T = 1000 by default.
    stages, dt, processor, curvature, force_gradient, polynomial, first
        See `sympflow.training.starts.Primed`.
    fit : NewFit, optional
        The options of `train`.
    """
    fit = NewFit() if fit is None else fit
    fit = replace(fit, restarts=12) if fit.restarts is None else fit
    name = f"{'primed' if polynomial is None else 'polynomial'}-{stages}-{dt:g}"
    start = Primed(dt, stages, processor, curvature, polynomial, first, force_gradient=force_gradient)
    judge = ByCertificate() if judge is None else judge
    return Recipe(scene.replace("-", "_"), name, SYSTEMS[scene], start, judge, (fit,), after=after)


@dataclass(frozen=True)
class Clock:
    """A flow on the logarithmic Hamiltonian, its clock trained (`sympflow.flow.clocked`).

    `step` is the physical length of its longest step.
    """

    step: float
    kind: str = "primed"  # it is one of a ladder

    def flow(self, system: HamiltonianSystem, domain: Domain | None = None, earlier: FlowMap | None = None) -> FlowMap:
        return train_clock(system, self.step)


def ladders() -> list[Recipe]:
    """The rungs of the ladders."""
    plain = NewFit(energy_weight=0.0)
    hh, swing, quartic, kepler, planets = "henon-heiles", "pendulum", "quartic", "kepler", "outer-solar-system"
    # Many numbers: most of what they can do at Δt they would give up for the times before it.
    followed = NewFit(steps=300, frozen_weight=10.0)
    of_state = replace(followed, energy_weight=0.0)
    in_powers = partial(rung, quartic, polynomial=6, first="kick")
    # d = 18: starts are dear, few and short, and the gain of more is small
    short = NewFit(restarts=2, energy_weight=0.0, points=40, label_times=5, reference_states=20, steps=200)
    along = ByRuns(along_the_orbit, 1e5 * YEAR, 100 * YEAR)
    return [
        # Of six seeds the one whose energy error over a long time is the lowest: the fit looks at single steps.
        rung(hh, 1, 0.82, fit=NewFit(seed=4, energy_weight=1000.0)),
        *(rung(hh, 3, dt, curvature=True) for dt in (1.6, 1.4, 1.0, 0.8, 0.6, 0.4)),
        rung(hh, 3, 1.75, 12, NewFit(restarts=24), curvature=True),
        # a force gradient in the kick that steps share, a curvature term besides in the one between
        rung(hh, 2, 1.12, 12, NewFit(restarts=60), curvature=(1,), first="kick"),
        rung(hh, 2, 0.77, 12, NewFit(restarts=24), curvature=(1,), first="kick"),
        rung(swing, 2, 1.5, fit=plain),
        *(rung(swing, 3, dt, fit=plain, curvature=True) for dt in (2.0, 1.5)),
        *(rung(swing, 3, dt, curvature=True) for dt in (1.0, 0.8, 0.6, 0.4)),
        rung(quartic, 1, 0.5),
        *(rung(quartic, 3, dt) for dt in (0.75, 0.6, 0.5, 0.4)),
        rung(quartic, 4, 0.83, 9, NewFit(restarts=40), force_gradient=(1, 3), first="kick"),
        # Beside the first for the energy, those for the state; T = 100 and 1000 are whole numbers of their Δt.
        in_powers(8, 1.0, 8, replace(followed, restarts=40, steps=400, seed=1)),
        *(in_powers(6, dt, 8, replace(of_state, restarts=24, seed=1)) for dt in (100 / 62, 100 / 96)),
        in_powers(8, 0.625, 8, replace(of_state, restarts=1), after="polynomial-8-1"),
        in_powers(8, 0.5, 8, replace(of_state, restarts=1), after="polynomial-8-0.625"),
        *(rung(kepler, 2, dt, fit=plain) for dt in (0.25, 0.15)),
        *(rung(kepler, 3, dt, fit=plain) for dt in (0.2, 0.15, 0.1, 0.08, 0.06, 0.045, 0.03)),
        Recipe("kepler", "log-1", SYSTEMS[kepler], Clock(1.0), ByClock()),
        *(rung(planets, 3, dt, fit=short, judge=along) for dt in (300.0, 200.0, 100.0)),
        lattice_rung(SYSTEMS["toda-chain"], 0.94, fit=LONG_RUNS, stages=2, first="kick"),
        *(lattice_rung(SYSTEMS["toda-chain"], dt) for dt in (1.2, 0.7, 0.2)),
        lattice_rung(SYSTEMS["toda-chain"], 0.5, fit=LONG_RUNS, stages=6, force_gradient=(1, 4)),
        lattice_rung(SYSTEMS["toda-chain"], 0.48, fit=LONG_RUNS, stages=6),
        lattice_rung(SYSTEMS["fput-beta"], 0.96, 6, LONG_RUNS, stages=3),
        lattice_rung(SYSTEMS["fput-beta"], 0.68, 10, LONG_RUNS, stages=5, force_gradient=(1, 3)),
        lattice_rung(SYSTEMS["fput-beta"], 0.39, 12, LONG_RUNS, stages=6, force_gradient=(1, 4)),
        *(lattice_rung(SYSTEMS["fput-beta"], dt, 6) for dt in (0.8, 0.55, 0.15)),
        lattice_rung(coupled_pendulums, 1.25, fit=FEWER_RUNS, stages=2, first="kick"),
        *(lattice_rung(coupled_pendulums, dt, fit=FEWER_RUNS) for dt in (2.1, 1.08, 0.43)),
        *of_double_wells(double_wells, 0.9, 0.9, 0.5),
        *of_double_wells(double_wells_in_a_plane, 0.82, 0.77, 0.43),
        *(driven_rung(SYSTEMS["driven-pendulum"], 6, dt) for dt in (2.0, 1.5, 1.0, 0.8, 0.4)),
        driven_rung(SYSTEMS["driven-pendulum"], 7, 100 / 51, 9),  # of T = 100
        driven_rung(SYSTEMS["driven-pendulum"], 6, 0.5, 10, seed=2),
        driven_rung(SYSTEMS["driven-pendulum"], 8, 0.5, 10, restarts=100),
        *(driven_rung(weak_duffing, 3, dt, 9, first="drift") for dt in (1.08, 1.0)),
        *(driven_rung(weak_duffing, 6, dt) for dt in (1.5, 1.0, 0.8, 0.5, 0.4)),
        driven_rung(weak_duffing, 8, 0.5, 10, restarts=100),
    ]


def driven_rung(
    system: Callable[[], HamiltonianSystem],
    stages: int,
    dt: float,
    processor: int = 8,
    restarts: int = 150,
    seed: int = 1,
    first: str = "kick",
) -> Recipe:
    """A primed flow of a driven system, judged by its energy balance; its minima are many, and starts are cheap.

    So many that the rounding of other compiled code ends a search in another one: a fit again gives the same errors
    within a few percent, not the same numbers.
    """
    start = Primed(dt, stages, processor, curvature=True, first=first)
    fit = NewFit(restarts=restarts, seed=seed, energy_weight=1.0)
    return Recipe(system().name, f"primed-{stages}-{dt:g}", system, start, ByBalance(), (fit,))


def weak_duffing() -> HamiltonianSystem:
    """Duffing's oscillator in one well, without friction and weakly driven: its orbits are regular."""
    return duffing(damping=0.0, force=0.1, frequency=2.7, alpha=1.0)


def coupled_pendulums(n: int) -> HamiltonianSystem:
    """The sine-Gordon equation on sites one apart: Σ p²/2 + 1 − cos q + r²/2, pendulums coupled by springs."""
    return sine_gordon(n=n, length=float(n), accuracy=2)


def double_wells(n: int) -> HamiltonianSystem:
    """The equation of φ⁴ on sites one apart: Σ p²/2 + (q² − 1)²/4 + r²/2, with free ends."""
    return phi4(n=n, length=float(n), accuracy=2)


def double_wells_in_a_plane(n: int) -> HamiltonianSystem:
    """The same on a square of n sites in all, with periodic ends."""
    side = math.isqrt(n)
    return HamiltonianSystem.lattice(onsite="(q**2 - 1)**2/4", bond="r**2/2", shape=(side, side), name="phi4_sheet")


LABELS_ALONE = NewFit(restarts=20, energy_weight=300.0, frozen_weight=1000.0, label_times=5)
LONG_RUNS = NewFit(restarts=24, energy_weight=300.0, steps=300, runs=48)
FEWER_RUNS = replace(LONG_RUNS, restarts=12)
"""Fits of flows of lattices: to labels of a few sites, and further to the energy errors of runs of a ring."""


def lattice_rung(
    system: Callable[..., HamiltonianSystem],
    dt: float,
    processor: int = 12,
    fit: NewFit = LABELS_ALONE,
    *,
    stages: int = 4,
    force_gradient: tuple[int, ...] | None = None,
    first: str = "drift",
    density: tuple[float, float] = (0.02, 0.2),
) -> Recipe:
    """A primed flow of a lattice of any n, fitted on a few sites, and judged on 256 at these energy densities.

    Force gradients of a polynomial bond are polynomials of a higher degree: those of a processor of 12, one after the
    other, spoil the rare states with much energy in a few sites, where Δt is long.
    """
    many = partial(system, n=256)
    return Recipe(
        many().name,
        f"primed-{stages}-{dt:g}",
        many,
        Primed(dt, stages, processor, force_gradient=force_gradient, first=first),
        ByCertificate(200.0, states=100, times=9, held_out=100),
        (fit,),
        partial(_at_density, density=density),
    )


def of_double_wells(system: Callable[..., HamiltonianSystem], two: float, five: float, six: float) -> list[Recipe]:
    """Rungs of two, five and six kicks with these Δt: all have force gradients, or two of them."""
    return [
        lattice_rung(system, two, fit=LONG_RUNS, stages=2, first="kick"),
        lattice_rung(system, five, fit=LONG_RUNS, stages=5, force_gradient=(1, 3)),
        lattice_rung(system, six, fit=LONG_RUNS, stages=6, force_gradient=(1, 4)),
    ]


def _at_density(system: HamiltonianSystem, density: tuple[float, float]) -> Domain:
    return LatticeStates(density).of(system)


def along_the_orbit(system: HamiltonianSystem, n: int = 10, span: float = 1e5 * YEAR, seed: int = 0) -> np.ndarray:
    """States of the outer solar system at n random times in 1e5 years of its own orbit: (n, 2d).

    Its domain holds each body near its own path at any phase, and an orbit from most of these states soon leaves it:
    so energy errors over a long time are measured from where the planets will really be.
    """
    t = np.sort(np.random.default_rng(seed).uniform(0, span, n))
    return solve(system, "kahan_li8", (0.0, float(t[-1])), dt=200.0, t_eval=t).states


# stiff systems ------------------------------------------------------------------------------------------------------


def stiff() -> list[Recipe]:
    """SympFlows of the exact flows of the parts of stiff systems."""
    polar = partial(spring_pendulum, 1e6, coordinates="polar")
    return [
        _stiff("fput_50", partial(fput, omega=50.0), Split(10.0, 6, 10, (0, 5)), 24, partial(low_energies, omega=50.0)),
        _stiff(
            "fput_1000", partial(fput, omega=1000.0), Split(20.0, 4, 16, False), 40, partial(low_energies, omega=1000.0)
        ),
        _stiff("spring_pendulum_1e6", polar, Split(10.0, 1, 8), 20, own_domain),
    ]


def _stiff(
    scene: str,
    system: Callable[[], HamiltonianSystem],
    start: Split,
    label_times: int,
    domain: Callable[[HamiltonianSystem], Domain],
) -> Recipe:
    fit = NewFit(label_times=label_times, frozen_weight=3.0)
    return Recipe(scene, "sympflow", system, start, OfStiff(domain), (fit,), domain)


def own_domain(system: HamiltonianSystem) -> Domain:
    """The domain of the system itself."""
    assert system.domain is not None
    return system.domain


def low_energies(system: HamiltonianSystem, omega: float, energy: float = 2.5) -> EnergySublevel:
    """The states of `fput` with H < 2.5 (y0 has 2.0012), in the smallest box that holds them."""
    p, root = math.sqrt(2 * energy), energy**0.25
    slow = [1.42 * root, 2 * root, 1.42 * root]  # where the four quartic springs alone have the energy
    high = np.array([*slow, *[p / omega] * 3, *[p] * 6]) * 1.001
    return EnergySublevel(energy, Box(-high, high)).attach(system.hamiltonian)


# networks -----------------------------------------------------------------------------------------------------------


def networks() -> list[Recipe]:
    """The same for both architectures: by Gauss–Newton, in two stages."""
    return [
        *_networks("henon_heiles", henon_heiles, _well, points=(1000, 4000)),
        *_networks("harmonic_oscillator", harmonic_oscillator, _square, margin=1.1),
        *_networks("pendulum", pendulum, _swing, steps=(40, 160), margin=1.03),
        *_networks(
            "harmonic_oscillator_100",
            partial(harmonic_oscillator, 100.0),
            partial(_square, 100.0),
            dt=0.01,
            omega=100.0,
            margin=1.1,
        ),
    ]


def _networks(
    scene: str,
    system: Callable[[], HamiltonianSystem],
    initial: Callable[[], np.ndarray],
    *,
    dt: float = 1.0,
    omega: float = 1.0,
    points: tuple[int, int] = (1000, 2500),
    steps: tuple[int, int] = (150, 100),
    margin: float = 1.0,
) -> list[Recipe]:
    first, second = (
        NewFit(optimizer="gauss-newton", points=n, steps=k, seed=stage)
        for stage, (n, k) in enumerate(zip(points, steps, strict=True))
    )
    judge, domain = AsPublished(initial, omega), partial(widened, margin=margin)
    return [
        Recipe(scene, kind, system, Network(kind, dt), judge, (first, second), domain) for kind in ("sympflow", "mlp")
    ]


def widened(system: HamiltonianSystem, margin: float) -> EnergySublevel:
    """The system's domain, wider in energy: what a network does beyond it is arbitrary, and orbits at the edge come
    there."""
    own = system.domain
    assert isinstance(own, EnergySublevel)
    low, high = np.array(own.box.low), np.array(own.box.high)
    middle, half = (low + high) / 2, (high - low) / 2 * max(1.0, margin)
    box = Box(middle - half, middle + half) if margin != 1.0 else own.box
    return EnergySublevel(margin * own.energy, box).attach(system.hamiltonian)


def _square(omega: float = 1.0) -> np.ndarray:
    """(q, p/ω) uniform in [−1.2, 1.2]²."""
    return np.random.default_rng(0).uniform(-1.2, 1.2, (100, 2)) * np.array([1.0, omega])


def _well() -> np.ndarray:
    """Uniform in the Hénon–Heiles well below H = 1/8."""
    system = henon_heiles()
    assert isinstance(system.domain, EnergySublevel)
    return EnergySublevel(1 / 8, system.domain.box).attach(system.hamiltonian).sample(100, 0)


def _swing() -> np.ndarray:
    """States of the pendulum's own domain."""
    return own_domain(pendulum()).sample(100, 0)
