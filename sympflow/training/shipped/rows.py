"""The recipes of the flows that ship, a row each.

Ladders of primed flows, from a few kicks to many, so that there is a cheap one for every accuracy; SympFlows of the
exact flows of their parts, for stiff systems; SympFlows with MLP potentials, and unconstrained baselines of as many
parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

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
from sympflow.training.fits import ClockedFit, GaussNewton, LossFit, NetworkFit, PrimedFit, SplitFit
from sympflow.training.shipped.judges import AsPublished, ByBalance, ByCertificate, ByClock, ByRuns, OfStiff
from sympflow.training.shipped.recipe import Recipe

YEAR = 365.25  # days


def recipes() -> list[Recipe]:
    """All recipes, those of a scene one after another; each comes after that from which it starts."""
    return [*networks(), *ladders(), *stiff()]


# ladders ------------------------------------------------------------------------------------------------------------


def rung(
    scene: str,
    fit: PrimedFit,
    restarts: int = 12,
    steps: int | None = None,
    after: str | None = None,
    judge: Any = None,
) -> Recipe:
    """A primed flow of a ladder; it is judged by its certificate over T = 1000 if nothing else is said."""
    name = f"{'primed' if fit.polynomial is None else 'polynomial'}-{fit.stages}-{fit.dt:g}"
    judge, solver = ByCertificate() if judge is None else judge, GaussNewton(steps, restarts)
    return Recipe(scene.replace("-", "_"), name, SYSTEMS[scene], fit, judge, solver, after=after)


def ladders() -> list[Recipe]:
    """The rungs of the ladders."""
    hh, swing, quartic, kepler, planets = "henon-heiles", "pendulum", "quartic", "kepler", "outer-solar-system"
    made = partial(PrimedFit, processor=6)
    plain, curved = partial(made, energy_weight=0.0), partial(made, curvature=True)
    # Many numbers: most of what they can do at Δt they would give up for the times before it.
    in_powers = partial(made, polynomial=6, first="kick", frozen_weight=10.0, processor=8)
    of_state = partial(in_powers, energy_weight=0.0)
    # d = 18: starts are dear, few and short, and the gain of more is small
    short = partial(plain, points=40, label_times=5, reference_states=20)
    along = ByRuns(along_the_orbit, 1e5 * YEAR, 100 * YEAR)
    shared = partial(curved, curvature=(1,), first="kick", processor=12)
    return [
        # Of six seeds the one whose energy error over a long time is the lowest: the fit looks at single steps.
        rung(hh, made(0.82, stages=1, seed=4, energy_weight=1000.0)),
        *(rung(hh, curved(dt, stages=3)) for dt in (1.6, 1.4, 1.0, 0.8, 0.6, 0.4)),
        rung(hh, curved(1.75, stages=3, processor=12), 24),
        # a force gradient in the kick that steps share, a curvature term besides in the one between
        rung(hh, shared(1.12, stages=2), 60),
        rung(hh, shared(0.77, stages=2), 24),
        rung(swing, plain(1.5, stages=2)),
        *(rung(swing, plain(dt, stages=3, curvature=True)) for dt in (2.0, 1.5)),
        *(rung(swing, curved(dt, stages=3)) for dt in (1.0, 0.8, 0.6, 0.4)),
        rung(quartic, made(0.5, stages=1)),
        *(rung(quartic, made(dt, stages=3)) for dt in (0.75, 0.6, 0.5, 0.4)),
        rung(quartic, made(0.83, stages=4, processor=9, force_gradient=(1, 3), first="kick"), 40),
        # Beside the first for the energy, those for the state; T = 100 and 1000 are whole numbers of their Δt.
        rung(quartic, in_powers(1.0, stages=8, seed=1), 40, 400),
        *(rung(quartic, of_state(dt, stages=6, seed=1), 24, 300) for dt in (100 / 62, 100 / 96)),
        rung(quartic, of_state(0.625, stages=8), 1, 300, after="polynomial-8-1"),
        rung(quartic, of_state(0.5, stages=8), 1, 300, after="polynomial-8-0.625"),
        *(rung(kepler, plain(dt, stages=2)) for dt in (0.25, 0.15)),
        *(rung(kepler, plain(dt, stages=3)) for dt in (0.2, 0.15, 0.1, 0.08, 0.06, 0.045, 0.03)),
        Recipe("kepler", "log-1", SYSTEMS[kepler], ClockedFit(1.0), ByClock()),
        *(rung(planets, short(dt, stages=3), 2, 200, judge=along) for dt in (300.0, 200.0, 100.0)),
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
    """A primed flow of a driven system, judged by its energy balance; its minima are many, and starts are cheap."""
    shape = {"stages": stages, "processor": processor, "first": first}
    fit = PrimedFit(dt, **shape, curvature=True, seed=seed, energy_weight=1.0)  # type: ignore[arg-type]
    return Recipe(system().name, f"primed-{stages}-{dt:g}", system, fit, ByBalance(), GaussNewton(restarts=restarts))


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


LABELS_ALONE = PrimedFit(energy_weight=300.0, frozen_weight=1000.0, label_times=5), GaussNewton(restarts=20)
LONG_RUNS = PrimedFit(energy_weight=300.0, runs=48), GaussNewton(300, 24)
FEWER_RUNS = LONG_RUNS[0], GaussNewton(300, 12)
"""Fits of flows of lattices: to labels of a few sites, and further to the energy errors of runs of a ring."""


def lattice_rung(
    system: Callable[..., HamiltonianSystem],
    dt: float,
    processor: int = 12,
    fit: tuple[PrimedFit, GaussNewton] = LABELS_ALONE,
    *,
    stages: int = 4,
    force_gradient: tuple[int, ...] | None = None,
    first: str = "drift",
    density: tuple[float, float] = (0.02, 0.2),
) -> Recipe:
    """A primed flow of a lattice of any n, fitted on a few sites, and judged on 256 at these energy densities."""
    many, name = partial(system, n=256), f"primed-{stages}-{dt:g}"
    shape = {"dt": dt, "stages": stages, "processor": processor, "first": first, "force_gradient": force_gradient}
    judge = ByCertificate(200.0, states=100, times=9, held_out=100)
    whole = replace(fit[0], **shape)  # type: ignore[arg-type]
    return Recipe(many().name, name, many, whole, judge, fit[1], domain=partial(_at_density, density=density))


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
    """States of the outer solar system at n random times in 1e5 years of its own orbit, which stays in Ω."""
    t = np.sort(np.random.default_rng(seed).uniform(0, span, n))
    return solve(system, "kahan_li8", (0.0, float(t[-1])), dt=200.0, t_eval=t).states


# stiff systems ------------------------------------------------------------------------------------------------------


def stiff() -> list[Recipe]:
    """SympFlows of the exact flows of the parts of stiff systems."""
    polar = partial(spring_pendulum, 1e6, coordinates="polar")
    fit = partial(SplitFit, frozen_weight=3.0)
    fifty = fit(turn=10.0, stages=6, terms=10, force_gradient=(0, 5), label_times=24)
    thousand = fit(turn=20.0, stages=4, terms=16, force_gradient=False, label_times=40)
    return [
        _stiff("fput_50", partial(fput, omega=50.0), fifty, partial(low_energies, omega=50.0)),
        _stiff("fput_1000", partial(fput, omega=1000.0), thousand, partial(low_energies, omega=1000.0)),
        _stiff("spring_pendulum_1e6", polar, fit(turn=10.0, stages=1, terms=8, label_times=20), own_domain),
    ]


def _stiff(
    scene: str,
    system: Callable[[], HamiltonianSystem],
    fit: SplitFit,
    domain: Callable[[HamiltonianSystem], Domain],
) -> Recipe:
    return Recipe(scene, "sympflow", system, fit, OfStiff(domain), domain=domain)


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
    judge, domain = AsPublished(initial, omega), partial(widened, margin=margin)
    second = LossFit(points=points[1], seed=1), GaussNewton(steps[1])
    return [
        Recipe(scene, kind, system, first, judge, GaussNewton(steps[0]), (second,), domain)
        for kind in ("sympflow", "mlp")
        for first in [NetworkFit(dt, points=points[0], baseline=kind == "mlp")]
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
