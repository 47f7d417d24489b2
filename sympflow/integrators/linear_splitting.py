"""Splittings with the exact flow of the quadratic part of H, and splittings into any exactly solvable parts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar
from weakref import WeakKeyDictionary

import numpy as np

from sympflow.arrays import is_tensor
from sympflow.hamiltonian.parts import LINEAR, ExactParts, Map, exact_parts, like, linear_and_rest
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.exact_maps import MapsStepper
from sympflow.schemes import SCHEMES, Scheme

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
        for kind, c, c3, *_ in self.scheme.substeps:
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
