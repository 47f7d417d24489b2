"""Scenes: the domain, the start, the interval and the step that a system brings along."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, TypedDict

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import advice, floats, real_number
from sympflow.arrays import Array
from sympflow.hamiltonian.domain import Domain

UNNAMED = "custom"
MEANT = {
    **dict.fromkeys(("dim", "dimension", "dimensions"), "degrees of freedom of a function are `ndof`, of pairs `dim`."),
    **dict.fromkeys(("mass",), "masses are in T(p), or `masses` of pairs."),
    **dict.fromkeys(
        ("site", "sites", "n_sites"), "the number of sites of a lattice is `shape`, their potential `onsite`."
    ),
    **dict.fromkeys(
        ("V", "U"), "a potential is `potential`, a function of q, or is a part of H as text, by from_sympy."
    ),
    **dict.fromkeys(("H", "energy"), "H is `hamiltonian`, a function of q and p, or text, by from_sympy."),
    **dict.fromkeys(("k", "m", "g", "constants"), "values of symbols are `params`, as params={'k': 1.0}."),
    "names": "the bodies have numbers, from 0, in the order of `masses`.",
}
"""Remedies for arguments that other packages have."""


class SceneOptions(TypedDict, total=False):
    """The arguments of a scene, as every constructor of a system takes them."""

    name: str
    domain: Domain | None
    y0: ArrayLike | None
    t_span: tuple[float, float]
    dt: float | None
    energy_scale: float | None
    exact: Callable[[Any], Array] | None


@dataclass(frozen=True)
class Scene:
    """The defaults with which a system is solved: see `HamiltonianSystem`."""

    name: str = UNNAMED
    domain: Domain | None = None
    y0: Any = None
    t_span: tuple[float, float] = (0.0, 100.0)
    dt: float | None = None
    energy_scale: float | None = None
    exact: Callable[[Any], Array] | None = None

    def __post_init__(self) -> None:
        if self.exact is not None and not callable(self.exact):
            raise TypeError(f"`exact` must be a function of the time; got {type(self.exact).__name__}.")
        if self.dt is not None and not (real_number(self.dt) and 0 < self.dt < 1e100):
            raise ValueError(f"`dt` must be positive and finite; got {self.dt!r}.")
        try:
            t0, t1 = (float(t) for t in self.t_span)
        except (TypeError, ValueError, OverflowError):
            t0 = t1 = math.nan
        if not math.isfinite(t1 - t0):
            raise ValueError(f"`t_span` must be two finite numbers, start and end; got {self.t_span!r}.")
        scale = self.energy_scale
        if scale is not None and not (real_number(scale) and 0 < scale <= sys.float_info.max):
            raise ValueError(f"`energy_scale` must be positive and finite; got {scale!r}.")
        if self.domain is not None and not isinstance(self.domain, Domain):
            kind = type(self.domain).__name__
            raise TypeError(f"`domain` must be a domain such as sympflow.Box(low, high); got {kind}.")
        object.__setattr__(self, "t_span", (t0, t1))
        object.__setattr__(self, "dt", None if self.dt is None else float(self.dt))

    @classmethod
    def given(cls, options: Mapping[str, Any], **defaults: Any) -> Scene:
        """Return the scene of the options of a constructor, over its defaults."""
        options = {name: value for name, value in options.items() if name != "time" or value is not None}
        known = [field.name for field in fields(cls)]
        if "time" in options:
            raise TypeError(
                "`time` is for systems that are written out, and those by one piece do not depend on it: leave it out, "
                "or write H out by HamiltonianSystem.from_sympy(..., time='t')."
            )
        for name in options:
            if name not in known:
                remedy = MEANT.get(name) or advice(name, (*known, "params")) or "remove it."
                raise TypeError(
                    f"`{name}` is not an argument of this system, nor of its scene, {', '.join(known)}: {remedy}"
                )
        return cls(**{**defaults, **options})

    def state(self, ndof: int) -> np.ndarray | None:
        """Return y0, checked to be a state of so many degrees of freedom: a copy of floats."""
        if self.y0 is None:
            return None
        try:
            state = floats("y0", self.y0)
        except OverflowError:
            raise ValueError("`y0` must be finite: it has an integer that no float is near.") from None
        if state.shape != (2 * ndof,):
            raise ValueError(f"`y0` must have shape ({2 * ndof},), [q, p]; got {state.shape}.")
        return state
