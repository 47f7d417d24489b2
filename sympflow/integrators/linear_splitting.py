"""Splittings with the exact flow of the quadratic part of H, and splittings into any exactly solvable parts."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any, ClassVar, Self
from weakref import WeakKeyDictionary

import numpy as np

from sympflow.arrays import Array, concatenate, is_tensor
from sympflow.decomposition import exact_parts, linear_and_rest
from sympflow.integrators.base import FixedStep, Outcome, Problem, rollout
from sympflow.integrators.schemes import SCHEMES, Scheme
from sympflow.parts import LINEAR, ExactParts, Map, like
from sympflow.system import HamiltonianSystem

if TYPE_CHECKING:
    from sympflow.kernels.parts import PartsKernel


class MapsStepper(FixedStep):
    """A fixed-step method whose step is a list of exact flows of the parts of H; a subclass defines these."""

    symplectic: ClassVar[bool] = True
    compiles: ClassVar[bool] = True
    saves_finite: ClassVar[bool] = True
    counted_maps: ClassVar[Sequence[Map]] = ()

    def parts_of(self, system: HamiltonianSystem) -> ExactParts:
        """The parts of the system that the method takes."""
        raise NotImplementedError

    def maps(self, parts: ExactParts, h: Any) -> list[Map]:
        """The maps of a step of length h, a number or an array (...)."""
        raise NotImplementedError

    def check(self, system: HamiltonianSystem) -> None:
        self.parts_of(system)

    def run(self, problem: Problem) -> Outcome:
        return super(MapsStepper, self.counting(problem.system)).run(problem)

    def counting(self, system: HamiltonianSystem) -> Self:
        counted = copy.copy(self)  # one that knows the maps whose evaluations it counts
        object.__setattr__(counted, "counted_maps", known_maps(self, self.parts_of(system), 1.0))
        return counted

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        return map_evaluations(self.counted_maps, n_steps, n_saved, n_extra, backend)

    def step(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        parts = self.parts_of(system)
        return parts.from_modes(*parts.apply(self.maps(parts, h), *parts.to_modes(y)))

    def inverse(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        parts = self.parts_of(system)
        back = [m.inverse() for m in reversed(self.maps(parts, h))]
        return parts.from_modes(*parts.apply(back, *parts.to_modes(y)))

    def rollout(self, problem: Problem, h: float, n_steps: int, save: np.ndarray) -> tuple[Array, np.ndarray, str]:
        parts, y0 = self.parts_of(problem.system), problem.y0
        kernel = parts_kernel(parts, problem)
        if kernel is None:
            states, finite = rollout_in_modes(parts, self.maps(parts, h), y0, n_steps, save)
            return states, finite, "torch" if is_tensor(y0) else "numpy"

        def maps(length: np.ndarray) -> Sequence[Map]:
            return known_maps(self, parts, float(length))

        if y0.ndim == 1:
            states, last = kernel.run(maps, h, y0, n_steps, save)
            return states, np.asarray(last), "compiled"
        rows = y0.reshape(-1, y0.shape[-1])
        states, finite = kernel.run_batch(maps, h, rows, n_steps, save)
        return states.swapaxes(0, 1).reshape(len(save), *y0.shape), finite.reshape(y0.shape[:-1]), "compiled"

    def substep(self, system: HamiltonianSystem, y: Array, h: Any, backend: str) -> Array:
        if backend != "compiled":
            return self.step(system, 0.0, y, h)
        from sympflow.kernels.parts import PartsKernel

        parts = self.parts_of(system)
        rows = np.ascontiguousarray(y).reshape(-1, y.shape[-1])
        lengths = np.broadcast_to(h, y.shape[:-1]).reshape(-1)
        kernel = kernel_of(parts, PartsKernel)
        return kernel.step(lambda length: self.maps(parts, length), lengths, rows).reshape(y.shape)


@lru_cache(maxsize=64)
def known_maps(method: MapsStepper, parts: ExactParts, h: float) -> Sequence[Map]:
    """The maps of a step, the same object for the same step, whose table the kernel then knows."""
    return method.maps(parts, h)


_KERNELS: WeakKeyDictionary[ExactParts, Any] = WeakKeyDictionary()


def kernel_of(parts: ExactParts, make: Callable[[ExactParts], Any]) -> Any:
    """The compiled loops of the parts, made once."""
    if parts not in _KERNELS:
        _KERNELS[parts] = make(parts)
    return _KERNELS[parts]


def parts_kernel(parts: ExactParts, problem: Problem) -> PartsKernel | None:
    """The compiled loops for a problem, or None where it needs, or asks for, array operations."""
    y0 = problem.y0
    try:
        if problem.backend == "array":
            return None
        if is_tensor(y0):
            raise ValueError("`y0` is a tensor: pass a NumPy array, or use backend='array'.")
        if y0.dtype != np.float64:
            raise ValueError(f"`y0` is {y0.dtype}: use float64, or backend='array'.")
        from sympflow.kernels.parts import PartsKernel

        kernel = kernel_of(parts, PartsKernel)
        kernel.source()
        return kernel
    except ValueError as reason:
        if problem.backend == "compiled":
            raise ValueError(f"`backend` 'compiled' does not apply. {reason}") from None
        return None


def rollout_in_modes(
    parts: ExactParts, maps: Sequence[Map], y0: Array, n_steps: int, save: np.ndarray
) -> tuple[Array, np.ndarray]:
    """`rollout` by array operations, in the modes from beginning to end."""
    d = parts.ndof
    start = parts.to_modes(y0)
    known = parts.prepared(maps, start[0])

    def step(k: int, z: Array) -> Array:
        return concatenate(parts.apply(known, z[..., :d], z[..., d:]))

    modes, finite = rollout(step, concatenate(start), n_steps, save)
    states = parts.from_modes(modes[..., :d], modes[..., d:])
    if len(save) and save[0] == 0:
        states = concatenate_first(y0, states)
    return states, finite


def concatenate_first(y0: Array, states: Array) -> Array:
    """`states` with y0 itself in place of the first."""
    if is_tensor(states):
        import torch

        return torch.cat([y0[None], states[1:]])
    return np.concatenate([y0[None], states[1:]])


def map_evaluations(maps: Sequence[Map], n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
    """Evaluations of slopes and force gradients, as `FixedStep.evaluations`; linear flows cost none."""
    counts = [sum(m.part != LINEAR for m in maps), sum(_has_gradient(m) for m in maps)]
    counts = [count * (n_steps + n_extra) for count in counts]
    if backend == "compiled" and len(maps) > 1 and maps[0].part == maps[-1].part:
        last = maps[-1].part != LINEAR, _has_gradient(maps[-1])  # it is the next step's first one
        counts = [count - (n_steps - n_saved) * one for count, one in zip(counts, last, strict=True)]
    return {"force_evaluations": int(counts[0]), "hessian_evaluations": int(counts[1])}


def _has_gradient(m: Map) -> bool:
    return m.gradient != 0.0 if isinstance(m.gradient, float) else bool(np.any(m.gradient))


_LINEAR_AND_REST: WeakKeyDictionary[HamiltonianSystem, ExactParts] = WeakKeyDictionary()


@dataclass(frozen=True)
class LinearSplitting(MapsStepper):
    """A splitting scheme for H = ½ pᵀM⁻¹p + ½ qᵀKq + U(q): kicks by U, and drifts replaced by the exact linear flow.

    Its step is limited by U and by resonances of the linear frequencies with the step, not by the largest of them.
    The system must have a `linear_part`.

    Parameters
    ----------
    dt : float, optional
        Step length; the default is `system.dt`.
    """

    scheme: ClassVar[Scheme]
    mollified: ClassVar[bool] = False
    midpoint: ClassVar[bool] = False

    def parts_of(self, system: HamiltonianSystem) -> ExactParts:
        if system not in _LINEAR_AND_REST:
            _LINEAR_AND_REST[system] = linear_and_rest(system)
        parts = _LINEAR_AND_REST[system]
        if any(self.scheme.gradients) and not parts.has_force_gradient:
            raise ValueError(f"`method` {self.name!r} needs a kinetic energy ½ pᵀM⁻¹p: use 'linear_srkn6b'.")
        return parts

    def maps(self, parts: ExactParts, h: Any) -> list[Map]:
        filters = _sinc(parts, h) if self.mollified else None
        maps = []
        for kind, c, c3, _ in self.scheme.substeps:
            if kind == "drift":
                maps.append(Map(LINEAR, self._times(parts, c * h)))
            elif parts.rest:
                maps.append(Map(1, c * h, c3 * h**3 if c3 else 0.0, filters))
        return maps

    def _times(self, parts: ExactParts, s: Any) -> Any:
        """How long each frequency is to turn: (..., F)."""
        assert parts.linear is not None
        times = _each_class(s, parts)
        if not self.midpoint:
            return times
        kinds = [parts.linear.kinds[j] for j in parts.linear.representatives]
        rates = like(parts.linear.rates[parts.linear.representatives], times)
        oscillates = like(np.array([kind == "oscillator" for kind in kinds]), times) != 0
        module = _module(times)
        angle = 2 * module.arctan(rates * times / 2)  # what the implicit midpoint rule turns an oscillator by
        return module.where(oscillates, angle / module.where(oscillates, rates, 1 + 0 * rates), times)


def _each_class(s: Any, parts: ExactParts) -> Any:
    """A time (...) for all F frequencies: (..., F)."""
    if is_tensor(s):
        return s[..., None] * s.new_ones(parts.n_classes)
    return np.asarray(s)[..., None] * np.ones(parts.n_classes, dtype=getattr(s, "dtype", float))


def _sinc(parts: ExactParts, h: Any) -> Any:
    """φ = sin(hω)/(hω) of each frequency, 1 where nothing oscillates: (..., F)."""
    assert parts.linear is not None
    representatives = parts.linear.representatives
    times = _each_class(h, parts)
    return _module(times).sinc(like(parts.linear.frequencies[representatives], times) * times / np.pi)


def _module(x: Any) -> Any:
    if is_tensor(x):
        import torch

        return torch
    return np


_IMPULSE = (
    "H. Grubmüller, H. Heller, A. Windemuth and K. Schulten, Generalized Verlet algorithm for efficient molecular "
    "dynamics simulations with long-range interactions, Mol. Sim. 6 (1991) 121–142; M. Tuckerman, B. J. Berne and "
    "G. J. Martyna, J. Chem. Phys. 97 (1992) 1990–2001; as a trigonometric integrator P. Deuflhard, Z. angew. Math. "
    "Phys. 30 (1979) 177–189, φ = 1"
)
_MOLLIFIED = (
    "B. García-Archilla, J. M. Sanz-Serna and R. D. Skeel, Long-time-step methods for oscillatory differential "
    "equations, SIAM J. Sci. Comput. 20 (1998) 930–963, φ = sinc"
)
_MIDPOINT = (
    "A. Stern and E. Grinspun, Implicit-explicit variational integration of highly oscillatory problems, Multiscale "
    "Model. Simul. 7 (2009) 1779–1794; R. I. McLachlan and A. Stern, Modified trigonometric integrators, SIAM J. "
    "Numer. Anal. 52 (2014) 1378–1397"
)
LINEAR_SPLITTINGS: dict[str, dict[str, Any]] = {
    "impulse": {"scheme": SCHEMES["verlet"], "source": _IMPULSE},
    "mollified_impulse": {"scheme": SCHEMES["verlet"], "mollified": True, "source": _MOLLIFIED},
    "implicit_explicit": {"scheme": SCHEMES["verlet"], "midpoint": True, "source": _MIDPOINT},
    **{
        f"linear_{name}": {"scheme": SCHEMES[name], "source": SCHEMES[name].source + ", with the exact linear flow"}
        for name in ("srkn6b", "srkn11b", "srkn14a", "omelyan4")
    },
}
"""Methods with the exact linear flow (the implicit–explicit one, with the midpoint rule's), and their sources."""


@dataclass(frozen=True)
class PartsSplitting(MapsStepper):
    """A symmetric composition of Strang steps over any number of parts of H that are solved exactly.

    A Strang step of length h is φ₁(h/2) ∘ … ∘ φ_n(h) ∘ … ∘ φ₁(h/2).

    Parameters
    ----------
    dt : float, optional
        Step length; the default is `system.dt`.
    parts : sequence of str, optional
        The parts, expressions that add up to H, in their order, the last innermost. The default is found in the terms
        of H: as few as possible, potentials first and the linear part last.
    """

    parts: tuple[str, ...] | None = None

    weights: ClassVar[tuple[float, ...]]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.parts is None:
            return
        sequence = isinstance(self.parts, list | tuple)
        if not sequence or not all(isinstance(part, str) for part in self.parts) or not self.parts:
            raise TypeError(f"`parts` must be a sequence of expressions; got {self.parts!r}: pass a list of strings.")
        object.__setattr__(self, "parts", tuple(self.parts))

    def parts_of(self, system: HamiltonianSystem) -> ExactParts:
        return _parts_of(system, self.parts)

    def maps(self, parts: ExactParts, h: Any) -> list[Map]:
        maps: list[Map] = []
        for weight in self.weights:
            outer = [self._map(parts, k, weight * h / 2) for k in parts.sequence[:-1]]
            inner = self._map(parts, parts.sequence[-1], weight * h)
            for m in (*outer, inner, *reversed(outer)):
                if maps and maps[-1].part == m.part:
                    m = Map(m.part, maps.pop().length + m.length)  # noqa: PLW2901
                maps.append(m)
        return maps

    @staticmethod
    def _map(parts: ExactParts, k: int, h: Any) -> Map:
        return Map(k, _each_class(h, parts) if k == LINEAR else h)


_PARTS: WeakKeyDictionary[HamiltonianSystem, dict[Any, ExactParts]] = WeakKeyDictionary()


def _parts_of(system: HamiltonianSystem, expressions: tuple[str, ...] | None) -> ExactParts:
    known = _PARTS.setdefault(system, {})
    if expressions not in known:
        known[expressions] = exact_parts(system, expressions)
    return known[expressions]


PARTS_SPLITTINGS: dict[str, tuple[int, tuple[float, ...], str]] = {
    "strang_parts": (2, (1.0,), "G. Strang, SIAM J. Numer. Anal. 5 (1968) 506–517, for any number of parts"),
    **{
        f"{name}_parts": (
            int(SCHEMES[name].order or 0),
            tuple(b for b in SCHEMES[name].kicks if b),
            f"{SCHEMES[name].source}; of Strang steps over any number of parts",
        )
        for name in ("suzuki4", "kahan_li6", "kahan_li8")
    },
}
"""Compositions for any number of parts: order, weights, source."""


def __getattr__(name: str) -> type[MapsStepper]:
    """The integrator classes as attributes of the module, where pickle looks for them."""
    if name in LINEAR_SPLITTINGS or name in PARTS_SPLITTINGS:
        return maps_stepper(name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


@cache
def maps_stepper(name: str) -> type[MapsStepper]:
    """The integrator class of that name."""
    if name in LINEAR_SPLITTINGS:
        namespace: dict[str, Any] = dict(LINEAR_SPLITTINGS[name])
        base: type[MapsStepper] = LinearSplitting
        order, source = namespace["scheme"].order, namespace.pop("source")
    else:
        base = PartsSplitting
        order, weights, source = PARTS_SPLITTINGS[name]
        namespace = {"weights": weights}
    namespace |= {
        "name": name,
        "order": order,
        "__doc__": f"{name}: order {order}, {source}\n\n{base.__doc__}",
        "__module__": __name__,
    }
    return dataclass(frozen=True)(type(name, (base,), namespace))
