"""Splittings: the ways to cut a vector field into exactly solvable parts, and a scheme composed of their flows.

A composition is a scheme × a splitting on one system: `step`, `inverse`, compiled loops, counts. A splitting is a class
here and a row of `SPLITTINGS`.
"""

from __future__ import annotations

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sympflow.arrays import Array, as_array, concatenate, library, like, per_state, to_numpy
from sympflow.compiler import NotCompiled
from sympflow.hamiltonian.monomials import Monomials, gradient
from sympflow.hamiltonian.scales import natural_scale
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.hamiltonian.times import stage_time
from sympflow.integrators.contract import Failure
from sympflow.integrators.steppers import ArraySteps, rollout
from sympflow.lazy import kept
from sympflow.schemes import (
    FORCE_GRADIENT,
    Scheme,
    Substep,
    Substeps,
    corrector_maps,
    paired,
    reversed_substeps,
    scheme_evaluations,
)

if TYPE_CHECKING:
    from sympflow.hamiltonian.parts import ExactParts, SubFlow
    from sympflow.hamiltonian.planets import Frame
    from sympflow.kernels.kepler import KeplerKernel
    from sympflow.kernels.protocol import Kernel, RunCheckpoint
    from sympflow.kernels.splitting_loops import SplittingLoops
    from sympflow.kernels.tangents import TangentKernel


@kept
def _exact_parts(system: HamiltonianSystem, parts: Any) -> ExactParts:
    from sympflow.hamiltonian.parts import exact_parts

    return exact_parts(system, parts)


class Composition(ABC, ArraySteps):
    """A scheme composed of the exact flows of the parts of one system; `method` is its name in messages.

    A subclass may take options of its own: `parts`, `omega` or `corrector` of `Splitting`. A ValueError says where the
    splitting, or the scheme with it, does not apply to the system.
    """

    compensates: ClassVar[bool] = False  # True if there are compensated sums
    keeps: ClassVar[str] = ""
    """Name of what a run keeps from step to step beside the state, where steps are made on an extended phase space."""
    counts_as_scheme: ClassVar[bool] = True
    """True if a step evaluates as many forces as the scheme says, whatever the system."""
    takes_values: ClassVar[bool] = False
    """True if compiled loops may take the values of parameters as numbers, other ones for each trajectory."""
    takes_friction: ClassVar[bool] = False  # True if one of the parts holds the friction of a damped system
    takes_driving: ClassVar[bool] = False
    """True if the time moves with one of the parts, of a system that depends on it."""
    breakdown: ClassVar[Failure | None] = None
    """The reason for which runs end that cannot go on; None for that of all methods."""
    doubts: ClassVar[bool] = False  # True if there may be a warning of a step that is long for the system
    takes_extended: ClassVar[bool] = False
    """True if the parts stay as they are with E, the momentum of the time, as one more momentum."""

    def __init__(self, method: str, scheme: Scheme, system: HamiltonianSystem) -> None:
        self.method, self.scheme = method, scheme

    def check_system(self, dt: float) -> None:
        """Raise a ValueError where the friction or the drive of the system needs shorter steps, or has no flow."""

    def longest_step(self) -> float:
        """The longest step that is recommended for the method."""
        return math.inf

    def doubt(self, dt: float) -> str:
        """A warning of the system with steps dt, or nothing."""
        return ""

    @abstractmethod
    def force_times(self) -> list[float]:
        """The times, in steps, at which a step takes the parts of H that depend on t."""

    def lift(self, y: Array) -> Array:
        """The states on which steps are made, of states y (..., 2d); y itself where the phase space is not extended."""
        return y

    def project(self, x: Array) -> Array:
        """The states (..., 2d) of those on which steps are made."""
        return x

    def distance(self, x: Array) -> Array:
        """Distance of those states from ones that `lift` gives, and their size: (..., 2)."""
        return 0 * x[..., :2]

    @abstractmethod
    def inverse(self, y: Array, h: Any, t: Any = 0.0) -> Array:
        """The states from which `step`, with the same h and t, leads to y."""

    def tangent(self, y: Array, h: Array, t: Any = 0.0) -> tuple[np.ndarray, np.ndarray] | None:
        """The step and its Jacobian (..., 2d, 2d); None where `step` itself is to be differentiated."""
        return None

    def jvp(self, y: Array, h: Array, W: np.ndarray, t: Any = 0.0) -> tuple[np.ndarray, np.ndarray] | None:
        """The step and the vectors W (..., 2d, k) moved by its derivative; None likewise."""
        return None

    @abstractmethod
    def kernel(self, compensated: bool) -> Kernel:
        """The compiled loops; a ValueError says why there are none."""

    def tangent_kernel(self, vectors: int) -> TangentKernel:
        """The compiled loops with k deviation vectors; a ValueError says why there are none."""
        raise NotCompiled(
            f"`method` {self.method!r} has compiled deviation vectors on the splittings 'kinetic' and 'kepler' only: "
            "use backend='auto'."
        )

    def kernel_by(self, compensated: bool, names: tuple[str, ...]) -> Kernel:
        """The same with the parameters of these names as numbers by which runs are differentiated."""
        raise NotCompiled(f"`method` {self.method!r} has no compiled derivatives by parameters.")


MOST_GROWTH = 1.0
"""The largest γΣ|a|dt over the drifts of a step that go back in time: momenta grow by at most e within a step."""


class KineticPotential(Composition):
    """H = T(p) + V(q): drifts q += a h ∇T(p) and kicks p −= b h ∇V(q)."""

    compensates: ClassVar[bool] = True
    takes_values: ClassVar[bool] = True
    takes_friction: ClassVar[bool] = True
    takes_driving: ClassVar[bool] = True
    takes_extended: ClassVar[bool] = True

    def __init__(self, method: str, scheme: Scheme, system: HamiltonianSystem) -> None:
        self.method, self.scheme, self.system = method, scheme, system
        if not system.separable:
            raise ValueError(
                f"`method` {method!r} needs a separable system, H = T(p) + V(q), and {system.name!r} is not: use "
                f"{system.definition.instead}."
            )
        if (scheme.nystrom or scheme.level) and not system.quadratic_kinetic:
            raise ValueError(
                f"`method` {method!r} needs a kinetic energy ½ pᵀM⁻¹p, which {system.name!r} does not have: use a "
                "scheme for any separable system, such as 'kahan_li8'."
            )
        system.check_damped_drifts()

    def check_system(self, dt: float) -> None:
        damping = self.system.friction.largest
        back = -sum(s.one for s in self.scheme.substeps if s.kind == "drift" and s.one < 0)
        if damping * back * dt > MOST_GROWTH:
            raise ValueError(
                f"`dt` {dt:.6g} is too long for method {self.method!r} with a damping of {damping:.6g}: its drifts of "
                f"{back:.3g} of a step go back in time, where friction lets momenta grow by a factor "
                f"exp({damping * back * dt:.3g}). Use a `dt` of at most {MOST_GROWTH / (damping * back):.3g}, or a "
                "scheme without such drifts, as 'verlet' or 'chin4c'."
            )
        if self.system.kinetic_timed:
            self.system.drift(np.zeros(self.system.ndof), 0.0, 0.0)

    def force_times(self) -> list[float]:
        scheme = self.scheme
        return [c for s, c in zip(scheme.substeps, scheme.substep_times, strict=True) if s.kind == "kick"]

    def _times(self, t: Any, h: Any) -> list[Any]:
        """The time at which each substep begins."""
        return [stage_time(t, c, h) for c in self.scheme.substep_times]

    def step(self, y: Array, h: Any, t: Any = 0.0) -> Array:
        return self._moved(y, h, t, 1)

    def inverse(self, y: Array, h: Any, t: Any = 0.0) -> Array:
        return self._moved(y, h, t, -1)

    def _moved(self, y: Array, h: Any, t: Any, sign: int) -> Array:
        """The substeps in their order, or with the sign −1 undone in the other one."""
        system, substeps = self.system, self.scheme.substeps
        q, p = y[..., : system.ndof], y[..., system.ndof :]
        times, h = self._times(t, h), per_state(h, y)
        for substep, at in zip(substeps[::sign], times[::sign], strict=True):
            if substep.kind == "drift":
                q, p = system.drifted(q, p, at, substep.one * h, sign)
            else:
                change = _kick(system, q, substep, h, self.scheme.monomials, at)
                p = p + change if sign > 0 else p - change
        return concatenate([q, p])

    def tangent(self, y: Array, h: Array, t: Any = 0.0) -> tuple[np.ndarray, np.ndarray] | None:
        y = to_numpy(y)
        n = y.shape[-1]
        if y.dtype == np.float64 and self.system.form is not None and y.size:
            from sympflow.kernels.stages import step_table
            from sympflow.kernels.tangents import step_tangents

            lengths = np.broadcast_to(h, y.shape[:-1]).astype(float).ravel()
            table, rows = step_table(self.scheme), np.ascontiguousarray(y.reshape(-1, n))
            found = step_tangents(self.system, table, lengths, lengths, rows, self.scheme.monomials)
            if found is not None:
                return found[0].reshape(y.shape), found[1].reshape(*y.shape, n)
        if not self._pushes:
            return None
        if not self.system.has_hessian_vector:
            self.system.potential_hessian(y[..., : self.system.ndof], t)  # which says so, before anything large is made
        return self.jvp(y, h, np.broadcast_to(np.eye(n, dtype=y.dtype), (*y.shape, n)).copy(), t)

    @property
    def _pushes(self) -> bool:
        """True if the step is differentiated by second derivatives of V, or by third ones known as products."""
        return self.scheme.level <= (0 if self.system.local is None else FORCE_GRADIENT)

    def jvp(self, y: Array, h: Array, W: np.ndarray, t: Any = 0.0) -> tuple[np.ndarray, np.ndarray] | None:
        if not self._pushes:
            return None
        system, d = self.system, self.system.ndof
        y = to_numpy(y)
        times = self._times(t, np.broadcast_to(h, y.shape[:-1]))
        q, p, h = y[..., :d], y[..., d:], np.asarray(h, dtype=y.dtype)[..., None]
        U, P = W[..., :d, :], W[..., d:, :]
        for substep, at in zip(self.scheme.substeps, times, strict=True):
            c = substep.one
            if substep.kind == "drift":
                if system.kinetic_timed:
                    U = U + system.drift_jacobian(p, at, c * h[..., 0]) @ P
                else:
                    mean, end = system.friction.drift(P.swapaxes(-1, -2), c * h[..., None])
                    U = U + _velocities(system, p, mean.swapaxes(-1, -2))
                    P = end.swapaxes(-1, -2)
                q, p = system.drifted(q, p, at, c * h)
            else:
                if system.local is None:
                    products = system.potential_hessian(q, at) @ U
                else:  # without the matrix
                    products = system.hessian_vector(q[..., None, :], U.swapaxes(-1, -2), at).swapaxes(-1, -2)
                change = (c * h)[..., None] * products
                if substep.three:
                    x, along = q[..., None, :], U.swapaxes(-1, -2)
                    v = system.velocity(system.force(q, at))[..., None, :]
                    G = system.third_derivative(x, v + 0 * along, along, at)
                    G = G - system.hessian_vector(x, system.velocity(system.hessian_vector(x, along, at)), at)
                    change = change + (substep.three * h**3)[..., None] * G.swapaxes(-1, -2)
                P = P - change
                p = p + _kick(system, q, substep, h, self.scheme.monomials, at)
        return np.concatenate([q, p], axis=-1), np.concatenate([U, P], axis=-2)

    def kernel_by(self, compensated: bool, names: tuple[str, ...]) -> Kernel:
        if self.system.kinetic_timed:
            raise NotCompiled(f"`system` {self.system.name!r} has a kinetic energy that depends on t.")
        return _splitting_loops()(self.system, names).kernel(self.scheme, compensated)

    def kernel(self, compensated: bool) -> Kernel:
        return _splitting_loops()(self.system).kernel(self.scheme, compensated)

    def tangent_kernel(self, vectors: int) -> TangentKernel:
        from sympflow.kernels.tangents import tangent_kernel

        return tangent_kernel(self.system, self.scheme, vectors)

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        return scheme_evaluations(self.scheme, n_steps, n_saved, n_extra, backend)


@cache
def _splitting_loops() -> Callable[..., SplittingLoops]:
    """The maker of compiled loops, imported once."""
    from sympflow.kernels.splitting_loops import splitting_loops

    return splitting_loops


def _kick(system: HamiltonianSystem, q: Array, kick: Substep, h: Any, monomials: Monomials, t: Any = None) -> Array:
    """The change of p by a kick, where the scheme has it the force gradient, the curvature or the polynomial too."""
    force = system.force(q, t)
    change = (kick.one * h) * force
    if kick.three:
        change = change - (kick.three * h**3) * system.hessian_vector(q, system.velocity(force), t)
    if kick.five:
        change = change - (kick.five * h**5) * system.curvature_gradient(q, t)
    if kick.polynomial:
        change = change - h**3 * gradient(monomials, kick.polynomial, q)
    return change


def _velocities(system: HamiltonianSystem, p: Array, P: np.ndarray) -> np.ndarray:
    """∇²T(p)·P of vectors (..., d, k)."""
    if not system.quadratic_kinetic:
        return system.kinetic_hessian(p) @ P
    return system.velocity(P.swapaxes(-1, -2)).swapaxes(-1, -2)


# exact flows of parts ------------------------------------------------------------------------------


class ExactMaps(Composition):
    """A step that is a list of exact flows of the parts of H; a subclass defines the list."""

    takes_driving: ClassVar[bool] = True
    parts: ExactParts

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ExactMaps) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> tuple[Any, ...]:
        return type(self), self.scheme, self.parts

    def force_times(self) -> list[float]:
        return [m.at for m in maps_of_step(self, 1.0) if self.parts.timed(m.part)]

    @abstractmethod
    def maps(self, h: Any) -> list[SubFlow]:
        """The maps of a step of length h, a number or an array (...)."""

    def step(self, y: Array, h: Any, t: Any = 0.0) -> Array:
        return self._moved(self.maps(h), y, h, t)

    def inverse(self, y: Array, h: Any, t: Any = 0.0) -> Array:
        return self._moved([m.inverse() for m in reversed(self.maps(h))], y, h, t)

    def _moved(self, maps: Sequence[SubFlow], y: Array, h: Any, t: Any) -> Array:
        parts = self.parts
        return parts.from_modes(*parts.apply(maps, *parts.to_modes(y), t, h))

    def jvp(self, y: Array, h: Array, W: np.ndarray, t: Any = 0.0) -> tuple[np.ndarray, np.ndarray] | None:
        parts, linear, d = self.parts, self.parts.linear, self.parts.ndof
        if linear is None:
            return None
        y, w = to_numpy(y), W.swapaxes(-1, -2)
        vectors = linear.coordinates(w[..., :d]), linear.slopes(w[..., d:])
        found = parts.jvp(self.maps(np.asarray(h)), parts.to_modes(y), vectors, t, h)
        if found is None:
            return None
        U, P = found[1]
        moved = np.concatenate([linear.positions(U), linear.momenta(P)], axis=-1)
        return parts.from_modes(*found[0]), moved.swapaxes(-1, -2)

    def rollout(
        self, y0: Array, h: float, n_steps: int, save: np.ndarray, t0: float = 0.0, carry: RunCheckpoint | None = None
    ) -> tuple[Array, np.ndarray]:
        """See `Stepper.rollout`: in the modes from beginning to end."""
        parts, d = self.parts, self.parts.ndof
        start = parts.to_modes(y0)
        known = parts.prepared(self.maps(h), start[0])

        def step(k: int, z: Array) -> Array:
            return concatenate(parts.apply(known, z[..., :d], z[..., d:], t0 + k * h, h))

        modes, finite = rollout(step, concatenate(start), n_steps, save, carry=carry)
        states = parts.from_modes(modes[..., :d], modes[..., d:])
        if not (len(save) and save[0] == 0):
            return states, finite
        return concatenate([y0[None], states[1:]], 0), finite

    def kernel(self, compensated: bool) -> Kernel:
        from sympflow.kernels.parts_loops import parts_loops

        return parts_loops(self.parts).kernel(lambda h: maps_of_step(self, float(h)) if h.ndim == 0 else self.maps(h))

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        from sympflow.hamiltonian.parts import map_evaluations  # SymPy, which other splittings do without

        return map_evaluations(maps_of_step(self, 1.0), n_steps, n_saved, n_extra, backend)


@lru_cache(maxsize=64)
def maps_of_step(composition: ExactMaps, h: float) -> Sequence[SubFlow]:
    """The maps of a step, the same object for the same step, whose table the kernel then knows."""
    return composition.maps(h)


class LinearRest(ExactMaps):
    """H = ½ pᵀM⁻¹p + ½ qᵀKq + U(q): kicks by U, and drifts replaced by the exact linear flow."""

    label: ClassVar[str] = "linear"

    def __init__(self, method: str, scheme: Scheme, system: HamiltonianSystem) -> None:
        from sympflow.hamiltonian.parts import linear_and_rest

        super().__init__(method, scheme, system)
        self.parts = linear_and_rest(system)
        if scheme.nystrom and any(part.turns for part in self.parts.rest):
            raise ValueError(
                f"`method` {method!r} has a Nyström scheme, which needs a rest of H that is a potential U(q), and that "
                f"of {system.name!r} depends on p too: use 'linear_kahan_li6', 'linear_aba864' or 'impulse'."
            )
        if scheme.level > FORCE_GRADIENT:
            raise ValueError(
                f"`splitting` {self.label!r} has no curvature terms, which the scheme of method {method!r} needs: use "
                "another scheme."
            )
        if any(scheme.gradients) and not self.parts.has_force_gradient:
            raise ValueError(f"`method` {method!r} needs a kinetic energy ½ pᵀM⁻¹p: use 'linear_srkn6b'.")

    def maps(self, h: Any) -> list[SubFlow]:
        from sympflow.hamiltonian.parts import LINEAR, SubFlow

        filters = self.filters(h)
        maps = []
        for (kind, c, c3, *_), at in zip(self.scheme.substeps, self.scheme.substep_times, strict=True):
            if kind == "drift":
                maps.append(SubFlow(LINEAR, self.times(c * h)))
            elif self.parts.rest:
                maps.append(SubFlow(1, c * h, c3 * h**3 if c3 else 0.0, filters, at))
        return maps

    def filters(self, h: Any) -> Any:
        """The factors of the kicks in a step of length h, (..., F); None for none."""
        return None

    def times(self, s: Any) -> Any:
        """The time that each frequency turns in a drift of length s: (..., F)."""
        return _each_class(s, self.parts)


class MollifiedLinearRest(LinearRest):
    """`LinearRest` with kicks filtered by φ = sin(hω)/(hω), 1 where nothing oscillates."""

    label = "mollified"

    def filters(self, h: Any) -> Any:
        for part in self.parts.rest:
            if part.turns:
                raise ValueError(
                    "`splitting` 'mollified' filters the positions at which a potential acts, and the rest of H "
                    "depends on momenta too: use the splitting 'linear'."
                )
        representatives = self.parts.linear.representatives
        times = _each_class(h, self.parts)
        return library(times).sinc(like(self.parts.linear.frequencies[representatives], times) * times / np.pi)


class MidpointLinearRest(LinearRest):
    """`LinearRest` with the angles by which the implicit midpoint rule turns an oscillator."""

    label = "midpoint"

    def times(self, s: Any) -> Any:
        parts = self.parts
        times = _each_class(s, parts)
        kinds = [parts.linear.kinds[j] for j in parts.linear.representatives]
        rates = like(parts.linear.rates[parts.linear.representatives], times)
        oscillates = like(np.array([kind == "oscillator" for kind in kinds]), times) != 0
        module = library(times)
        angle = 2 * module.arctan(rates * times / 2)
        return module.where(oscillates, angle / module.where(oscillates, rates, 1 + 0 * rates), times)


def _each_class(s: Any, parts: ExactParts) -> Any:
    """A time (...) for all F frequencies: (..., F)."""
    s = as_array(float(s) if isinstance(s, int) else s)
    return s[..., None] * like(np.ones(parts.n_classes), s)


class SolvableParts(ExactMaps):
    """A symmetric composition of Strang steps over any number of parts of H that are solved exactly."""

    label: ClassVar[str] = "parts"
    counts_as_scheme: ClassVar[bool] = False

    def __init__(
        self, method: str, scheme: Scheme, system: HamiltonianSystem, parts: tuple[str, ...] | None = None
    ) -> None:
        super().__init__(method, scheme, system)
        weights = scheme.strang_weights
        if weights is None:
            raise ValueError(
                f"`splitting` {self.label!r} composes Strang steps, which the scheme of method {method!r} is not made "
                "of: use 'kahan_li8', 'kahan_li6', 'suzuki4' or 'verlet'."
            )
        self.weights: tuple[float, ...] = weights
        self._moments = [*itertools.accumulate(weights[:-1], initial=0.0), 1.0]  # where Strang steps begin, and the end
        self.parts = self._parts(system, parts)

    def _parts(self, system: HamiltonianSystem, parts: Any) -> ExactParts:
        """The parts of a system."""
        return _exact_parts(system, parts)

    def maps(self, h: Any) -> list[SubFlow]:
        *others, innermost = self.parts.sequence
        maps: list[SubFlow] = []
        for weight, start, end in zip(self.weights, self._moments, self._moments[1:], strict=False):
            outer = [self._map(k, weight * h / 2, start) for k in others]
            if self.parts.timed(innermost):
                inner = [self._map(innermost, weight * h / 2, at) for at in (start, end)]
            else:
                inner = [self._map(innermost, weight * h, start)]
            for m in (*outer, *inner, *(replace(m, at=end) for m in reversed(outer))):
                if maps and maps[-1].part == m.part and not (maps[-1].at != m.at and self.parts.timed(m.part)):
                    m = replace(m, length=maps.pop().length + m.length)  # noqa: PLW2901
                maps.append(m)
        return maps

    def _map(self, k: int, h: Any, at: float) -> SubFlow:
        from sympflow.hamiltonian.parts import LINEAR, SubFlow

        return SubFlow(k, _each_class(h, self.parts) if k == LINEAR else h, at=at)


class TwoCopies(SolvableParts):
    """Strang steps over H(q, y), H(x, p) and the coupling of two copies of phase space, for any H: see `two_copies`."""

    label = "copies"
    keeps = "the second copy of phase space"

    def __init__(self, method: str, scheme: Scheme, system: HamiltonianSystem, omega: float | None = None) -> None:
        self.omega, self.ndof, self.scale = omega, system.ndof, natural_scale(system)
        super().__init__(method, scheme, system)

    def _parts(self, system: HamiltonianSystem, parts: Any) -> ExactParts:
        from sympflow.hamiltonian.parts import two_copies

        return two_copies(system, self.omega)

    def lift(self, y: Array) -> Array:
        from sympflow.hamiltonian.parts import both

        return both(y, self.ndof)

    def project(self, x: Array) -> Array:
        from sympflow.hamiltonian.parts import mean

        return mean(x, self.ndof)

    def distance(self, x: Array) -> Array:
        """The largest difference of the copies, and the size of their states: (..., 4d) to (..., 2)."""
        from sympflow.hamiltonian.parts import distance

        return distance(x, self.scale)


class KeplerInteraction(Composition):
    """H of planets about a star: Kepler's motion of each, exactly | all else, their interaction.

    In Jacobi's coordinates the interaction is a potential, so that every scheme keeps its order. In democratic
    heliocentric ones it holds the motion of the star too, half before a kick and half after, which is of order 2.
    """

    compensates: ClassVar[bool] = True
    doubts: ClassVar[bool] = True
    breakdown: ClassVar[Failure | None] = Failure.ENCOUNTER

    def __init__(self, method: str, scheme: Scheme, system: HamiltonianSystem, corrector: int | None = None) -> None:
        super().__init__(method, scheme, system)
        if scheme.level > FORCE_GRADIENT:
            raise ValueError(
                f"`splitting` 'kepler' has kicks with force gradients, and the scheme of method {method!r} has more: "
                "use 'leapfrog', 'aba864' or 'chin4a'."
            )
        if system.friction:
            raise ValueError(f"`method` {method!r} does not take friction: use the splitting 'kinetic'.")
        from sympflow.hamiltonian.planets import frame_of

        frame = frame_of(system)
        if frame is None:
            raise ValueError(
                f"`method` {method!r} is for planets about a star, which {system.name!r} is not: make it by "
                "HamiltonianSystem.planets, or take the splitting 'kinetic', such as 'srkn11b'."
            )
        frame.check(method)
        self.frame: Frame = frame
        if scheme.level and not self.frame.jacobi:
            raise ValueError(
                f"`method` {method!r} has force gradients, which the interaction has in Jacobi's coordinates only: "
                "make the system with coordinates='jacobi'."
            )
        self.substeps = paired([(s.kind, s.one, s.three) for s in scheme.substeps])
        self.before: Substeps = ()
        self.after: Substeps = ()
        if corrector is not None:
            if [s[:2] for s in scheme.substeps] != [("drift", 0.5), ("kick", 1.0), ("drift", 0.5)]:
                raise ValueError(
                    "`corrector` goes with the steps of 'wisdom_holman' and 'kepler_takahashi_imada', and method "
                    f"{method!r} makes other ones: leave it out."
                )
            maps = (corrector_maps(corrector, sign, bool(scheme.level)) for sign in (1, -1))
            self.before, self.after = (paired([(*m, 0.0) for m in each]) for each in maps)

    def force_times(self) -> list[float]:
        return []

    def step(self, y: Array, h: Any, t: Any = 0.0) -> Array:
        return self._moved(y, h, self.substeps)

    def inverse(self, y: Array, h: Any, t: Any = 0.0) -> Array:
        return self._moved(y, h, reversed_substeps(self.substeps), -1.0)

    def _moved(self, y: Array, h: Any, substeps: Substeps, sign: float = 1.0) -> Array:
        """States after substeps in the coordinates of the processor, which are those of a step forwards."""
        h = like(np.asarray(h, dtype=float), y) if isinstance(h, int | float) else h
        pieces = (self.before, abs(h)), (substeps, h), (self.after, abs(h))
        return self.frame.moved(y, sign * h, *pieces)

    def tangent(self, y: Array, h: Array, t: Any = 0.0) -> tuple[np.ndarray, np.ndarray] | None:
        n = y.shape[-1]
        return self.jvp(y, h, np.broadcast_to(np.eye(n), (*y.shape, n)))

    def jvp(self, y: Array, h: Array, W: np.ndarray, t: Any = 0.0) -> tuple[np.ndarray, np.ndarray] | None:
        y = to_numpy(y)
        if y.dtype != np.float64 or not y.size:
            return None
        try:
            kernel = self.kernel(False)
            rows = y.reshape(-1, y.shape[-1])
            lengths = np.broadcast_to(h, y.shape[:-1]).astype(float).ravel()
            ends, vectors = kernel.jvp(lengths, rows, W.reshape(*rows.shape, -1))
        except NotCompiled:  # no compiled code, as of bodies without mass: `step` is differentiated
            return None
        return ends.reshape(y.shape), vectors.reshape(W.shape)

    def tangent_kernel(self, vectors: int) -> TangentKernel:
        from sympflow.kernels.kepler import KeplerTangents

        return KeplerTangents(self.kernel(False), vectors)

    def longest_step(self) -> float:
        kicks = sum(kick != 0 for kick, *_ in self.substeps)
        return self.frame.longest_step * max(kicks, 1)

    def doubt(self, dt: float) -> str:
        frame, crossing = self.frame, self.frame.crossing()
        if dt > self.longest_step() * (1 + 1e-9):
            body = 1 + int(np.argmin(frame.periods))
            return (
                f"`dt` {dt:g} is long for method {self.method!r}: its kicks are more than a twentieth of the period of "
                f"body {body}, {frame.periods.min():.4g}, apart, where steps may be in resonance with the orbit. Take "
                f"at most {self.longest_step():.3g}."
            )
        if crossing:
            return (
                f"`system` has orbits that cross, those of bodies {crossing[0]} and {crossing[1]}, where the splitting "
                "'kepler' is right only until they come close to each other. Take the splitting 'kinetic', such as "
                "'srkn11b', unless a resonance keeps them apart."
            )
        return ""

    def kernel(self, compensated: bool) -> KeplerKernel:
        from sympflow.kernels.kepler import KeplerKernel, kepler_loops

        return KeplerKernel(kepler_loops(self.frame), self.substeps, self.before, self.after, compensated)

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        counts = scheme_evaluations(self.scheme, n_steps, n_saved, n_extra, backend)
        processed = (n_saved if backend == "compiled" else 2 * n_steps) + 2 * n_extra
        counts["force_evaluations"] += sum(kick != 0 for kick, *_ in self.before) * processed
        return counts


SPLITTINGS: dict[str, type[Composition]] = {
    "kinetic": KineticPotential,
    "linear": LinearRest,
    "mollified": MollifiedLinearRest,
    "midpoint": MidpointLinearRest,
    "parts": SolvableParts,
    "copies": TwoCopies,
    "kepler": KeplerInteraction,
}
"""The splittings by the name that the option `splitting` takes."""
