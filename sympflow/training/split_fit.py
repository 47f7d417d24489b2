"""The fit of a split flow: its weights, filters and angles, fitted to the exact flow of a system by Gauss–Newton.

First the maps frozen at Δt, a dozen numbers, from many random starts. Then numbers are followed from equal steps at a
small t up to Δt, each fit starting where the last ended (or down from the best at Δt, if those are much better);
polynomials in t are put through them, and these are fitted to labels at all times together.

Derivatives of a step by a number of its table are central differences of the compiled step, exact to 1e-10, which
Gauss–Newton steps do not see.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from scipy.linalg import block_diag

from sympflow.flow.coefficients import Column
from sympflow.flow.split import SplitFlow
from sympflow.hamiltonian.parts import SubFlow
from sympflow.kernels.parts_loops import PartsLoops, parts_loops
from sympflow.training.least_squares import Check, Minimum, Problem, put_weights
from sympflow.training.points import Labels, Stream, shares_missed, step_errors, stream_seed
from sympflow.training.runs import LABEL_SHARE, SearchRun
from sympflow.training.session import Deadline, Session

DIFFERENCE = 1e-5  # of a coefficient, relative to its unit
SPREAD = 0.3  # of random weights about those of equal steps
FOLLOWING = 40  # iterations at each time, on the way from one to the next
WORSE = 30.0  # times the best error at Δt that numbers followed up from 0 may have there
PULL = 0.3  # towards equal steps, as a share of the error: it chooses among coefficients that do as well
ROUGHNESS = 1e-6  # how reluctantly polynomials are made to vary with t


class SplitRun(SearchRun):
    """The state of a fit of a split flow that is bound to its system, and what acts on it."""

    flow: SplitFlow

    def prepare(self, deadline: Deadline) -> None:
        self.problem = SplitProblem(self, deadline)

    def searched(self) -> SplitProblem:
        return self.problem

    def start_of(self, restart: int) -> np.ndarray:
        """Numbers u at Δt: those of the flow as it is, then random ones."""
        return self.problem.random(restart) if restart else self.problem.current(self.problem.t[-1])

    def found(self, minimum: Minimum) -> dict[str, float]:
        self.history.append({"step": len(self.minima), "loss": minimum.cost, "iterations": minimum.iterations})
        return self.history[-1]

    def complete(self, session: Session) -> None:
        u = self.problem.current(self.problem.t[-1])  # if there was no time for a start
        if self.minima:
            best = min(self.minima, key=lambda m: m.cost)
            if not math.isfinite(best.cost):
                raise FloatingPointError("The residuals are not finite from any start: shrink `domain` or `dt`.")
            u = best.x
        whole = self.problem.whole(u, self.whole_end)
        last = {"step": len(self.minima), "loss": whole.cost, "iterations": whole.iterations}
        self.history.append(last | self.problem.errors())

    def missed(self) -> tuple[float, float]:
        return self.problem.missed()


class Pulled(Problem):
    """Weighted residuals at some of the times, of numbers affine in θ, and a pull of these towards equal steps."""

    def __init__(
        self,
        problem: SplitProblem,
        at: Sequence[int],
        offsets: np.ndarray,
        designs: np.ndarray,
        weights: np.ndarray,
        pulls: np.ndarray,
    ) -> None:
        self.problem, self.offsets, self.designs = problem, offsets, designs
        self.times = list(zip(weights, at, strict=True))
        self.equal = np.array([problem.equal(problem.t[j]) for j in at])
        self.pulled = (weights * pulls)[:, None] / np.array([problem.units(problem.t[j]) for j in at])

    def residuals(self, theta: np.ndarray, check: Check = lambda: None) -> np.ndarray:
        u = self.offsets + self.designs @ theta
        data = [w * self.problem.errors_at(v, j) for (w, j), v in zip(self.times, u, strict=True)]
        return np.concatenate([*data, *(self.pulled * (u - self.equal))])

    def linearized(self, theta: np.ndarray, check: Check = lambda: None) -> tuple[np.ndarray, np.ndarray]:
        u = self.offsets + self.designs @ theta
        each = zip(self.times, u, self.designs, strict=True)
        data = [w * self.problem.jacobian(v, j) @ design for (w, j), v, design in each]
        return self.residuals(theta), np.concatenate([*data, *(self.pulled[..., None] * self.designs)])


def _phases(share: np.ndarray) -> np.ndarray:
    """Chebyshev's points of even polynomials on (0, 1]."""
    return np.where(share == 1, 1.0, np.sin(np.pi / 2 * share))


class SplitProblem(Problem):
    """Labels in modes, and the flow's coefficients as numbers u, of the first half of the palindrome: fitted at Δt."""

    def __init__(self, run: SplitRun, deadline: Deadline) -> None:
        flow, system, domain, fit = run.flow, run.system, run.domain, run.fit
        self.flow, self.fit, self.solver = flow, fit, run.solver
        self.parts, self.columns = flow.parts, flow.columns()
        ends = np.cumsum([(c.n + 1) // 2 for c in self.columns])
        self.slices = [slice(int(end) - (c.n + 1) // 2, int(end)) for c, end in zip(self.columns, ends, strict=True)]
        self.n = int(ends[-1]) if len(ends) else 0
        t = flow.dt * _phases(np.arange(1, fit.label_times + 1) / fit.label_times)
        drawn = system, domain, fit.points, fit.seed, Stream.RESIDUAL, t, deadline.part(LABEL_SHARE)
        labels = Labels.drawn(*drawn)
        self.t, self.z, self.labels = t, self._modes(labels.x), [self._modes(y) for y in labels.y]
        self.unit = self._unit(float(np.std(system.hamiltonian(labels.x))))
        t = flow.dt * _phases((np.arange(2 * fit.label_times) + 1) / (2 * fit.label_times))
        unseen = system, domain, fit.reference_states, fit.seed, Stream.REFERENCE, t
        self.held_out = Labels.drawn(*unseen, deadline.part(LABEL_SHARE), needed=False)

    @property
    def kernel(self) -> PartsLoops:
        return parts_loops(self.parts)

    def _modes(self, y: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(np.concatenate(self.parts.to_modes(y), axis=-1))

    def _unit(self, energy: float) -> np.ndarray:
        """The units of the errors: the spread over Ω, but for an oscillator what changes its energy as H varies."""
        spread = self.z.std(0)
        unit = np.where(spread > 0, spread, 1.0)
        linear, d = self.parts.linear, self.parts.ndof
        for j in range(d if linear is not None else 0):
            if linear.kinds[j] == "oscillator" and energy > 0:
                unit[[j, d + j]] = math.sqrt(energy / linear.rates[j])
        return unit

    def _joined(self, half: Callable[[Column, int], Any]) -> np.ndarray:
        """The values of a function of each column and the length of its first half, one after another: (n,)."""
        return np.concatenate([np.broadcast_to(half(c, m := (c.n + 1) // 2), m) for c in self.columns])

    def units(self, t: float) -> np.ndarray:
        """The units of the coefficients: t^m / n for weights and angles, 1 for filters."""
        return self._joined(lambda c, m: t**c.power / (c.n**c.power if c.power else 1))

    def maps(self, u: np.ndarray) -> list[SubFlow]:
        """The maps with the numbers u of the first half."""
        entries = {}
        for c, part in zip(self.columns, self.slices, strict=True):
            half = u[part]
            entries[c] = np.concatenate([half, half[: c.n // 2][::-1]])
        return self.flow._assemble(entries.__getitem__, lambda values: np.stack(values, axis=-1))

    def errors_at(self, u: np.ndarray, j: int) -> np.ndarray:
        """The residuals of the numbers u at the j-th time."""
        with np.errstate(all="ignore"):
            error = (self.kernel.step_modes(self.maps(u), self.z) - self.labels[j]) / self.unit
        return error.ravel() / math.sqrt(len(self.z))

    def jacobian(self, u: np.ndarray, j: int) -> np.ndarray:
        steps, columns = DIFFERENCE * self.units(self.t[j]), []
        for e, step in enumerate(steps):
            change = np.zeros(self.n)
            change[e] = step
            columns.append((self.errors_at(u + change, j) - self.errors_at(u - change, j)) / (2 * step))
        return np.stack(columns, axis=-1)

    # frozen at one time -------------------------------------------------------------------------------------

    def frozen(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Offset (n,) and design (n, f) of numbers that are bound by Σ s = t alone, in their units."""
        bare = [Column(c.n, (0,), c.power, total="always" if c.total == "always" else None, dt=t) for c in self.columns]
        affine = [c.affine(np.array([t])) for c in bare]
        offset = np.concatenate([own[0, : (c.n + 1) // 2] for c, (own, _) in zip(bare, affine, strict=True)])
        blocks = [d[0, : (c.n + 1) // 2] / t**c.power for c, (_, d) in zip(bare, affine, strict=True)]
        return offset, self.units(t)[:, None] * block_diag(*blocks)

    def minimize(self, theta: np.ndarray, iterations: int, deadline: Deadline, thorough: bool = False) -> Minimum:
        return self.fitted(theta, len(self.t) - 1, iterations, deadline)

    def fitted(self, u: np.ndarray, j: int, iterations: int, deadline: Deadline, pull: float = 0.0) -> Minimum:
        """The numbers at the j-th time that fit the labels best, pulled towards equal steps."""
        offset, design = self.frozen(self.t[j])
        unit, one = self.units(self.t[j]), np.ones(1)
        theta = np.linalg.lstsq(design / unit[:, None], (u - offset) / unit, rcond=None)[0]
        fit = Pulled(self, [j], offset[None], design[None], one, pull * one)
        m = fit.minimize(theta, iterations, deadline)
        return Minimum(offset + design @ m.x, m.cost, m.iterations, m.reason)

    def pull(self, u: np.ndarray, j: int) -> float:
        """A pull that costs little beside the error there is."""
        return PULL * float(np.linalg.norm(self.errors_at(u, j))) / math.sqrt(self.n)

    def equal(self, t: float) -> np.ndarray:
        """The numbers of equal steps without filters and force gradients."""
        return self.units(t) * self._joined(lambda c, m: c.power <= 1)

    def current(self, t: float) -> np.ndarray:
        """The numbers of the flow as it is."""
        return self._joined(lambda c, m: c.at(np.array(t))[:m])

    def random(self, restart: int) -> np.ndarray:
        rng = np.random.default_rng([stream_seed(self.fit.seed, Stream.RESTARTS), restart])
        dt = self.flow.dt

        def half(c: Column, m: int) -> Any:
            if c.power == 1:
                w = rng.normal(1, SPREAD, m)
                return dt * w / np.concatenate([w, w[: c.n // 2]]).sum()
            return rng.uniform(0.2, 1.2, m) if c.power == 0 else rng.choice([0.0, 1 / 12]) * (dt / c.n) ** 3

        return self._joined(half)

    # all times ----------------------------------------------------------------------------------------------

    def whole(self, u: np.ndarray, deadline: Deadline) -> Minimum:
        """The polynomials, put through numbers followed from time to time, then fitted to all labels."""
        last = len(self.t) - 1
        followed = self.follow(self.equal(self.t[0]), range(last + 1), deadline)
        if np.linalg.norm(self.errors_at(followed[last], last)) > WORSE * np.linalg.norm(self.errors_at(u, last)):
            followed = self.follow(u, range(last, -1, -1), deadline)[::-1]
        pulls = np.array([self.pull(v, j) for j, v in enumerate(followed)])
        offsets, designs = self.polynomials()
        scale = np.array([self.units(t) for t in self.t])
        A = (designs / scale[:, :, None]).reshape(-1, designs.shape[-1])
        b = ((np.array(followed) - offsets) / scale).ravel()
        A = np.concatenate([A, ROUGHNESS * np.eye(A.shape[1])])
        theta = np.linalg.lstsq(A, np.concatenate([b, np.zeros(A.shape[1])]), rcond=None)[0]
        weight = np.where(np.arange(len(self.t)) == len(self.t) - 1, self.fit.frozen_weight, 1.0)
        fit = Pulled(self, range(len(self.t)), offsets, designs, weight / math.sqrt(len(self.t)), pulls)
        m = fit.minimize(theta, self.solver.steps, deadline)
        self.assign(m.x)
        return m

    def follow(self, u: np.ndarray, order: range, deadline: Deadline) -> list[np.ndarray]:
        """The numbers at the times in order, each from those at the time before, the first from u."""
        followed: list[np.ndarray] = []
        for j in order:
            if followed:
                before = j - order.step
                u = followed[-1] * self.units(self.t[j]) / self.units(self.t[before])
            for _ in range(2):  # the second time with the pull that suits the error reached
                u = self.fitted(u, j, FOLLOWING, deadline, self.pull(u, j)).x
            followed.append(u)
        return followed

    def polynomials(self) -> tuple[np.ndarray, np.ndarray]:
        """Offsets (J, n) and designs (J, n, f) of the numbers at the label times by the flow's parameters."""
        halves = [tuple(part[:, : (c.n + 1) // 2] for part in c.affine(self.t)) for c in self.columns]
        offsets, designs = np.concatenate([offset for offset, _ in halves], axis=1), [design for _, design in halves]
        return offsets, np.stack([block_diag(*(design[j] for design in designs)) for j in range(len(self.t))])

    def assign(self, theta: np.ndarray) -> None:
        """Put the parameters into the flow."""
        put_weights([c.free for c in self.columns], torch.as_tensor(theta))

    def differences(self, j: int) -> np.ndarray:
        """ψ̄_t(x) − φ_H,t(x) in modes, at the held-out states and the j-th of their times: (N, 2d)."""
        t, z = self.held_out.t, self._modes(self.held_out.x)
        return self.kernel.step_modes(self.flow.frozen().maps(float(t[j])), z) - self._modes(self.held_out.y[j])

    def missed(self) -> tuple[float, float]:
        """See `shares_missed`: at the last of the held-out times, which is next to Δt."""
        of = self.held_out
        modes = Labels(of.t[-1:], self._modes(of.x), self._modes(of.y[-1])[None])
        return shares_missed(self.differences(-1), modes, self.unit)

    def errors(self) -> dict[str, float]:
        """Figures of ψ̄_t(x) − φ_H,t(x) of held-out states, in the units of the modes."""
        return step_errors(np.stack([self.differences(j) for j in range(len(self.held_out.t))]) / self.unit)
