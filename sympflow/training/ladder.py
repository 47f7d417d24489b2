"""The ladders of primed flows that ship: from a few kicks to many, so that there is a cheap one for every accuracy."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from sympflow.flow.certificate import upper_limit
from sympflow.flow.clocked import ClockedFlow
from sympflow.flow.primed import PrimedFlow
from sympflow.flow.split import SplitFlow
from sympflow.flow.sympflow import SympFlow
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.metrics.energy import max_energy_error
from sympflow.solver import solve
from sympflow.systems import SYSTEMS
from sympflow.training.clock_fit import energy_errors, train_clock
from sympflow.training.table_fit import force_gradient_in
from sympflow.training.trainer import train

OF_A_GRADIENT, OF_A_CURVATURE, OF_A_MONOMIAL, OF_A_PARAMETER = 0.3, 0.4, 0.05, 0.4  # forces
OF_A_LOGARITHM = 2.0  # forces: a kick and a drift of the logarithmic Hamiltonian, a division in each
CLOCK_SEED = 1_000_003  # of the held-out states of flows without a certificate
HELD_OUT = 1000  # states of the certificate
OUTPUTS = 1000  # at which an energy error is looked at, where it is not the certificate that does
YEAR = 365.25  # days


@dataclass(frozen=True)
class Rung:
    """A flow of a ladder.

    Parameters
    ----------
    stages, dt, processor
        See `SympFlow.primed`.
    restarts : int
        Starts of the search.
    scheme : str, optional
        Of `stages` kicks, from which the search starts in place of equal leapfrog steps: one of a high order leads to
        valleys that random tables, most of whose numbers are positive, do not lie near.
    curvature, polynomial, first : bool, int, str
        See `SympFlow.primed`.
    after : str, optional
        The name of the rung with the same kicks and the same processor whose table, continued to this Δt, is where the
        search starts: deep valleys are found at a long Δt, and followed to a short one; and found without polynomials,
        and followed with them.
    options : dict
        Other options of `train`.
    """

    stages: int
    dt: float
    processor: int = 6
    restarts: int = 12
    scheme: str | None = None
    after: str | None = None
    curvature: bool = False
    polynomial: int | None = None
    first: str = "drift"
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Of its file, after that of the scene."""
        return f"{'primed' if self.polynomial is None else 'polynomial'}-{self.stages}-{self.dt:g}"

    def train(self, system: HamiltonianSystem, longer: PrimedFlow | None = None, **options: Any) -> PrimedFlow:
        """The flow, without a certificate; `longer` is that of the rung `after` which it comes."""
        before = time.process_time()
        shape: dict[str, Any] = {"stages": self.stages, "first": self.first}
        if self.scheme is not None:
            shape = {"scheme": self.scheme}
        shape |= {"processor": self.processor, "curvature": self.curvature, "polynomial": self.polynomial}
        start = SympFlow.primed(system, dt=self.dt, **shape)
        if longer is not None:
            _restrict(start, longer)
        flow = train(system, flow=start, **{"restarts": self.restarts, **self.options, **options})
        flow.figures["training_cpu_seconds"] = round(time.process_time() - before, 3)
        return flow


@dataclass(frozen=True)
class ClockRung:
    """A flow of a ladder that is one on the logarithmic Hamiltonian, its clock trained (`sympflow.flow.clocked`).

    Parameters
    ----------
    dt : float
        The physical length of its longest step.
    """

    dt: float

    @property
    def name(self) -> str:
        """Of its file, after that of the scene."""
        return f"log-{self.dt:g}"

    def train(self, system: HamiltonianSystem, longer: PrimedFlow | None = None, **options: Any) -> ClockedFlow:
        """The flow, without the energy errors; neither a longer one nor the `options` of `train` say anything to it."""
        return train_clock(system, self.dt)


@dataclass(frozen=True)
class Ladder:
    """The flows of a system.

    Parameters
    ----------
    make : callable
        The system.
    rungs : tuple of Rung or ClockRung
    t_end : float
        T of the energy errors, in the system's units of time.
    held_out : callable, optional
        The states (n, 2d) from which the energy errors are measured; by default it is the certificate that does.
    t_certified : float
        T of the certificate where these are given.
    """

    make: Callable[[], HamiltonianSystem]
    rungs: tuple[Rung | ClockRung, ...]
    t_end: float = 1000.0
    held_out: Callable[[HamiltonianSystem], np.ndarray] | None = None
    t_certified: float = 1000.0

    def flows(
        self, rung: str | None = None, made: Callable[[str], SympFlow] | None = None, **options: Any
    ) -> Iterator[tuple[Rung | ClockRung, SympFlow]]:
        """Each rung and its flow, as they are made; or one rung only, by its name.

        `made` gives, by the name of a rung, a flow that was made before, for those that start from another.
        """
        system = self.make()
        there: dict[str, SympFlow] = {}
        for each in self.rungs:
            if rung in (None, each.name):
                after = getattr(each, "after", None)
                if after is not None and after not in there:
                    if made is None:
                        raise ValueError(f"`rung` {rung!r} starts from {after!r}: make that first, or all of them.")
                    there[after] = made(after).bound(system)  # type: ignore[assignment]
                longer = None if after is None else there[after]
                assert longer is None or isinstance(longer, PrimedFlow)
                flow = each.train(system, longer, **options)
                self._judge(flow, system)
                there[each.name] = flow
                yield each, flow

    def measure(self, flow: SympFlow) -> dict[str, Any]:
        """The figures by which flows are chosen, measured again."""
        self._judge(flow, self.make())
        return flow.figures

    def _judge(self, flow: SympFlow, system: HamiltonianSystem) -> None:
        if isinstance(flow, ClockedFlow):
            assert system.domain is not None
            errors = energy_errors(flow, system, system.domain.sample(HELD_OUT, CLOCK_SEED), self.t_end, OUTPUTS)
            flow.figures |= {
                "energy_error_median": float(np.quantile(errors, 0.5, method="higher")),
                "energy_error_95": upper_limit(np.asarray(errors)),
                "t_end": self.t_end,
                "cost": round(OF_A_LOGARITHM * flow.scheme.force_evaluations / flow.figures["step"], 3),
            }
            return
        if self.held_out is None:
            certify(flow, system, self.t_end)
            return
        y0, times = self.held_out(system), np.linspace(0.0, self.t_end, OUTPUTS + 1)  # at steps and between them
        run = solve(system, flow, (0.0, self.t_end), y0, t_eval=times, on_domain_exit="ignore")
        errors = max_energy_error(run)
        flow.certificate(system, t_end=self.t_certified)
        flow.figures |= {
            "energy_error_median": float(np.quantile(errors, 0.5, method="higher")),
            "energy_error_95": upper_limit(np.asarray(errors)),
            "t_end": self.t_end,
            "cost": round(cost(flow), 8),
        }


@torch.no_grad()
def _restrict(flow: PrimedFlow, other: PrimedFlow) -> None:
    """Give a flow the numbers of another with as many kicks: those of a longer Δt as they are at its own.

    Polynomials take over force gradients.
    """
    shorter = min(flow.dt / other.dt, 1.0)
    mine, theirs = dict(flow.columns()), dict(other.columns())
    for name, column in mine.items():
        if name in theirs:
            column.set(theirs[name].table.cpu().double().numpy() * shorter ** np.array(theirs[name].exponents, float))
    if flow.polynomials is None or other.gradients is None:
        return
    e = force_gradient_in(flow)
    for part in ("", "processor_"):
        gradients = theirs[f"{part}gradients"]
        table = gradients.table.cpu().double().numpy() * shorter ** np.array(gradients.exponents, float)
        for m, e_m in enumerate(e):
            mine[f"{part}polynomials.{m}"].set(e_m * table)


def certify(flow: SympFlow, system: HamiltonianSystem, t_end: float = 1000.0) -> None:
    """Compute the certificate, and from it the figures by which flows are chosen.

    `energy_error_95` is an upper 99 % confidence limit of the 95 % quantile over Ω, so that a `tol` holds for other
    states than those that were measured. The one-step error has a heavy tail where orbits come close to a singularity:
    hence its median and its largest value beside the mean.
    """
    certificate = flow.certificate(system, t_end=t_end, held_out=HELD_OUT)
    flow.figures |= {
        "one_step_error_median": certificate.one_step_error.median,
        "one_step_error_max": certificate.one_step_error.largest,
        "energy_error_median": certificate.relative_energy_error.median,
        "energy_error_95": certificate.relative_limit,
        "t_end": t_end,
        "cost": round(cost(flow), 3),
    }


def cost(flow: SympFlow) -> float:
    """What a unit of time costs in force evaluations, by count: a figure that no other load on the machine disturbs.

    A force gradient counts as 0.3 of a force, a curvature term as 0.4 and each monomial of a polynomial as 0.05, as was
    measured in the compiled loops for polynomial potentials; exact linear flows count nothing; a network's parameters
    as many forces as make up for its multiplications.
    """
    if isinstance(flow, SplitFlow):
        one, two = (flow.evaluations(n, 0, 0, "compiled") for n in (1, 2))
        more = {name: two[name] - one[name] for name in one}
        return (more["force_evaluations"] + OF_A_GRADIENT * more["hessian_evaluations"]) / flow.dt
    if not isinstance(flow, PrimedFlow):
        return OF_A_PARAMETER * flow.n_parameters / flow.dt
    kernel = flow.kernel_scheme()
    beside = OF_A_GRADIENT * kernel.hessian_evaluations + OF_A_CURVATURE * kernel.curvature_evaluations
    beside += OF_A_MONOMIAL * len(kernel.monomials) * kernel.force_evaluations
    return (kernel.force_evaluations + beside) / flow.dt


def ladders() -> dict[str, Ladder]:
    """The ladders, by the name of the scene."""
    plain = {"energy_weight": 0.0}
    # Many numbers: most of what they can do at Δt they would give up for the times before it.
    followed = {"steps": 300, "frozen_weight": 10.0}
    rungs: dict[str, tuple[Rung | ClockRung, ...]] = {
        "henon-heiles": (
            # Of six seeds the one whose energy error over a long time is the lowest: the fit looks at single steps.
            Rung(1, 0.82, options={"seed": 4, "energy_weight": 1000.0}),
            *(Rung(3, dt, curvature=True) for dt in (1.6, 1.4, 1.0, 0.8, 0.6, 0.4)),
        ),
        "pendulum": (
            Rung(2, 1.5, options=plain),
            *(Rung(3, dt, curvature=True, options=plain) for dt in (2.0, 1.5)),
            *(Rung(3, dt, curvature=True) for dt in (1.0, 0.8, 0.6, 0.4)),
        ),
        "quartic": (
            Rung(1, 0.5),
            *(Rung(3, dt) for dt in (0.75, 0.6, 0.5, 0.4)),
            # Beside the first for the energy, those for the state; T = 100 and 1000 are whole numbers of their Δt.
            Rung(8, 1.0, 8, 40, polynomial=6, first="kick", options={**followed, "steps": 400, "seed": 1}),
            *(
                Rung(6, dt, 8, 24, polynomial=6, first="kick", options={**followed, **plain, "seed": 1})
                for dt in (100 / 62, 100 / 96)
            ),
            *(
                Rung(8, dt, 8, 1, None, f"polynomial-8-{after:g}", polynomial=6, first="kick", options=followed | plain)
                for after, dt in ((1.0, 0.625), (0.625, 0.5))
            ),
        ),
        "kepler": (
            *(Rung(2, dt, options=plain) for dt in (0.25, 0.15)),
            *(Rung(3, dt, options=plain) for dt in (0.2, 0.15, 0.1, 0.08, 0.06, 0.045, 0.03)),
            ClockRung(1.0),
        ),
    }
    # d = 18: starts are dear, few and short, and the gain of more is small
    short = {**plain, "points": 40, "label_times": 5, "reference_states": 20, "steps": 200}
    planets: tuple[Rung | ClockRung, ...] = tuple(
        Rung(3, dt, restarts=2, options=short) for dt in (300.0, 200.0, 100.0)
    )
    made = {scene.replace("-", "_"): Ladder(SYSTEMS[scene], each) for scene, each in rungs.items()}
    solar = Ladder(SYSTEMS["outer-solar-system"], planets, 1e5 * YEAR, along_the_orbit, 100 * YEAR)
    return {**made, "outer_solar_system": solar}


def along_the_orbit(system: HamiltonianSystem, n: int = 10, span: float = 1e5 * YEAR, seed: int = 0) -> np.ndarray:
    """States of the outer solar system at n random times in 1e5 years of its own orbit: (n, 2d).

    Its domain holds each body near its own path at any phase, and an orbit from most of these states soon leaves it:
    so energy errors over a long time are measured from where the planets will really be.
    """
    t = np.sort(np.random.default_rng(seed).uniform(0, span, n))
    return solve(system, "kahan_li8", (0.0, float(t[-1])), dt=200.0, t_eval=t).states
