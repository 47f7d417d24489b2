"""Domains Ω of phase space: where a flow is trained, and where its figures hold."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import check_number, check_positive, checked_states, floats, sample_count, told_of_all, vector
from sympflow.arrays import Array, to_numpy
from sympflow.hamiltonian.lattice_states import LatticeStates

if TYPE_CHECKING:
    from sympflow.hamiltonian.hamiltonian import Hamiltonian


@runtime_checkable
class Domain(Protocol):
    """A set Ω of states [q, p] that can be sampled and tested."""

    def sample(self, n: int, seed: int = 0) -> np.ndarray:
        """Draw `n` states uniformly: (n, 2d)."""

    def contains(self, x: Array, slack: float = 0.0) -> np.ndarray:
        """Return True for each state x (..., 2d) that lies in Ω: (...) booleans. `slack` widens an energy bound."""

    def to_dict(self) -> dict[str, Any]:
        """A description that `domain_from_dict` turns back into the domain."""


@told_of_all
@dataclass(frozen=True)
class Ball:
    """The states within Euclidean distance `radius` of `center`.

    Parameters
    ----------
    center : array_like, shape (2d,)
    radius : float
    """

    center: ArrayLike
    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", vector("center", self.center))
        check_number("radius", self.radius)
        check_positive("radius", self.radius)

    @property
    def width(self) -> int:
        return np.size(self.center)

    def sample(self, n: int, seed: int = 0) -> np.ndarray:
        rng = np.random.default_rng(seed)
        center = np.asarray(self.center)
        direction = rng.standard_normal((sample_count(n), center.size))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return center + self.radius * direction * rng.random((n, 1)) ** (1 / center.size)

    def contains(self, x: Array, slack: float = 0.0) -> np.ndarray:
        center = np.asarray(self.center)
        return np.linalg.norm(checked_states(x, center.size) - center, axis=-1) <= self.radius

    def to_dict(self) -> dict[str, Any]:
        return {"kind": "Ball", **asdict(self)}


@told_of_all
@dataclass(frozen=True)
class Box:
    """The states with low ≤ x ≤ high, componentwise.

    Parameters
    ----------
    low, high : array_like, shape (2d,)
    """

    low: ArrayLike
    high: ArrayLike

    def __post_init__(self) -> None:
        object.__setattr__(self, "low", vector("low", self.low))
        object.__setattr__(self, "high", vector("high", self.high))
        if np.shape(self.low) != np.shape(self.high):
            raise ValueError(f"`high` must have the length of `low`; got {np.size(self.high)} and {np.size(self.low)}.")
        if not np.all(np.less(self.low, self.high)):
            raise ValueError(f"`low` must be below `high` in every component; got {self.low!r}, {self.high!r}.")

    @property
    def width(self) -> int:
        return np.size(self.low)

    def sample(self, n: int, seed: int = 0) -> np.ndarray:
        rng = np.random.default_rng(seed)
        low, high = np.asarray(self.low), np.asarray(self.high)
        return rng.uniform(low, high, (sample_count(n), low.size))

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """`low` and `high` as read-only arrays."""
        low, high = np.asarray(self.low), np.asarray(self.high)
        low.setflags(write=False)
        high.setflags(write=False)
        return low, high

    def contains(self, x: Array, slack: float = 0.0) -> np.ndarray:
        low, high = self.bounds
        x = checked_states(x, low.size)
        return ((x >= low) & (x <= high)).all(-1)

    def to_dict(self) -> dict[str, Any]:
        return {"kind": "Box", **asdict(self)}


@told_of_all
@dataclass(frozen=True)
class EnergySublevel:
    """The states of a box whose energy is below a bound: {x ∈ box : H(x) < energy}.

    The box selects the component: inside its box, the Hénon–Heiles set H < 1/6 is the bounded well only. Two more
    bounds make it a shell that the exact flow does not leave: a lower bound of the energy, and, for motion in a plane
    under a central force, bounds of the angular momentum.

    Parameters
    ----------
    energy : float
        The bound, in the units of H.
    box : Box
        A box that contains the wanted component.
    hamiltonian : callable, optional
        H(x), x of shape (..., 2d). A `HamiltonianSystem` sets it to its own.
    above : float, optional
        Lower bound of the energy.
    angular_momentum : (float, float), optional
        Bounds of |q₁p₂ − q₂p₁|; only for d = 2.
    """

    energy: float
    box: Box
    hamiltonian: Callable[[Array], Array] | None = field(default=None, repr=False, compare=False)
    above: float | None = None
    angular_momentum: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        check_number("energy", self.energy)
        if not abs(self.energy) <= sys.float_info.max:
            raise ValueError(f"`energy` must be finite; got {self.energy!r}.")
        if not isinstance(self.box, Box):
            raise TypeError(f"`box` must be a Box; got {type(self.box).__name__}.")
        if self.above is not None:
            check_number("above", self.above)
        if self.above is not None and not self.above < self.energy:
            raise ValueError(f"`above` must be below `energy`; got {self.above!r} and {self.energy!r}.")
        if self.angular_momentum is None:
            return
        if np.size(self.box.low) != 4:
            raise ValueError("`angular_momentum` only bounds motion in a plane, d = 2: leave it out.")
        try:
            low, high = (float(bound) for bound in self.angular_momentum)
        except (TypeError, ValueError) as error:
            raise ValueError(f"`angular_momentum` must be two numbers; got {self.angular_momentum!r}.") from error
        if not 0 <= low < high:
            raise ValueError(f"`angular_momentum` must be 0 ≤ low < high; got {self.angular_momentum!r}.")
        object.__setattr__(self, "angular_momentum", (low, high))

    @cached_property
    def _limits(self) -> dict[float, tuple[np.ndarray, np.ndarray]]:
        return {}

    def limits(self, slack: float) -> tuple[np.ndarray, np.ndarray]:
        """Lower bounds of the state, of H and of |L|, and the upper ones: (2d + 2,) each."""
        if slack not in self._limits:
            low, high = self.bounds(slack)
            least = -np.inf if self.above is None else self.above - slack
            slowest, fastest = self.angular_momentum or (0.0, np.inf)
            self._limits[slack] = np.array([*low, least, slowest]), np.array([*high, self.energy + slack, fastest])
        return self._limits[slack]

    def attach(self, hamiltonian: Callable[[Array], Array]) -> EnergySublevel:
        """The same domain with the H of a system."""
        return replace(self, hamiltonian=hamiltonian)

    def of(self, system: Hamiltonian) -> EnergySublevel:
        """The same domain, of a system."""
        system.check_autonomous("so that no energy bounds a set of states", "take a Box or a Ball as `domain`")
        return self.attach(system.hamiltonian)

    def _within(self, x: np.ndarray, slack: float) -> np.ndarray:
        """True where the energy, and the angular momentum if it is bounded, are within their bounds."""
        if self.hamiltonian is None:
            raise ValueError(
                "`hamiltonian` is not known to this EnergySublevel: pass the domain to a HamiltonianSystem, "
                "or give it hamiltonian=."
            )
        H = to_numpy(self.hamiltonian(x))
        inside = self.energy + slack > H
        if self.above is not None:
            inside = inside & (self.above - slack < H)
        if self.angular_momentum is not None:
            low, high = self.angular_momentum
            L = abs(x[..., 0] * x[..., 3] - x[..., 1] * x[..., 2])
            inside = inside & (low <= L) & (high >= L)
        return inside

    @property
    def width(self) -> int:
        return self.box.width

    def sample(self, n: int, seed: int = 0) -> np.ndarray:
        sample_count(n)
        rng = np.random.default_rng(seed)
        low, high = np.asarray(self.box.low), np.asarray(self.box.high)
        accepted: list[np.ndarray] = []
        found = drawn = 0
        while found < n:
            x = rng.uniform(low, high, (max(4 * n, 1024), low.size))
            with np.errstate(all="ignore"):
                x = x[self._within(x, 0.0)]
            accepted.append(x)
            found += len(x)
            drawn += max(4 * n, 1024)
            if drawn > 1e7 and found < drawn * 1e-5:
                raise ValueError(
                    f"`box` holds almost no state with energy below {self.energy:g} ({found} of {drawn} drawn): "
                    f"{'raise `energy`, because the sublevel seems to be empty, or ' if not found else ''}"
                    "make it fit the energy sublevel more closely."
                )
        return np.concatenate(accepted)[:n]

    def contains(self, x: Array, slack: float = 0.0) -> np.ndarray:
        low, high = self.bounds(slack)
        x = checked_states(x, low.size)
        with np.errstate(all="ignore"):
            return ((x >= low) & (x <= high)).all(-1) & self._within(x, slack)

    def bounds(self, slack: float) -> tuple[np.ndarray, np.ndarray]:
        """The box, enlarged by the tolerance, so that a state on its face does not leave it by rounding."""
        low, high = self.box.bounds
        if slack == 0.0:
            return low, high
        margin = (high - low) * (slack / max(abs(self.energy), 1e-300))
        return low - margin, high + margin

    def to_dict(self) -> dict[str, Any]:
        description = {"kind": "EnergySublevel", "energy": self.energy, "box": self.box.to_dict()}
        more = {"above": self.above, "angular_momentum": self.angular_momentum}
        return description | {name: bound for name, bound in more.items() if bound is not None}


def domain_of(domain: Domain, system: Hamiltonian) -> Domain:
    """The domain of a system, ready for sampling: one that depends on H gets that of the system."""
    return domain.of(system) if isinstance(domain, EnergySublevel | LatticeStates) else domain


def remedy_for(system: Hamiltonian) -> str:
    """Domains for a system without one, as code."""
    local = system.local
    own = ["LatticeStates(density)"] if local is not None and local.has_subsystem else []
    names = [*own, "Box(low, high)", "Ball(center, radius)", "EnergySublevel(energy, box)"]
    return ", ".join(f"sympflow.{name}" for name in names[:-1]) + f" or sympflow.{names[-1]}"


def domain_from_dict(description: dict[str, Any]) -> Ball | Box | EnergySublevel | LatticeStates | Tube:
    """The domain that `to_dict` described; a ValueError if it is not one of a known kind."""
    kinds: dict[str, Any] = {kind.__name__: kind for kind in (Ball, Box, EnergySublevel, LatticeStates, Tube)}
    try:
        fields = {k: v for k, v in description.items() if k not in ("kind", "box")}
        box = {"box": domain_from_dict(description["box"])} if "box" in description else {}
        if (kind := description["kind"]) in kinds:
            return kinds[kind](**box, **_numbers(fields))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"`description` is not a domain: {error}.") from error
    raise ValueError(f"`description` is of an unknown kind of domain: {kind!r}.")


def _numbers(fields: dict[str, Any]) -> dict[str, Any]:
    """`fields`, checked to be numbers, lists of numbers, and lists of such lists."""
    for name, value in fields.items():
        rows = value if isinstance(value, list | tuple) else (value,)
        for v in (v for row in rows for v in (row if isinstance(row, list | tuple) else (row,))):
            if isinstance(v, bool) or not isinstance(v, int | float):
                raise TypeError(f"{name} {value!r} is not made of numbers")
    return fields


_AT_ONCE = 2**20  # numbers in one block of distances


@told_of_all
@dataclass(frozen=True, eq=False)
class Tube:
    """The states near an orbit: within `radius` of the broken line through its states.

    Parameters
    ----------
    orbit : array_like, shape (n, 2d)
        States along the orbit, n ≥ 2: of a `Solution`, ``sol.states``. They should lie closer to each other than the
        radius, so that the broken line follows the orbit.
    radius : float or array_like of shape (2d,)
        Positive. Distances are Euclidean in the coordinates divided by it: one number where [q, p] are of one scale,
        else one for each coordinate.
    groups : sequence of sequences of int, optional
        Coordinates that are near the orbit together; the default is all of them. Several groups give the product of
        tubes, each about the orbit's projection: for planets, say, each near its own ellipse, at any relative phase.
        Each of 0 … 2d−1 must occur in them once.

    Notes
    -----
    A sample is a state of the broken line, drawn uniformly in the orbit's own time, plus a uniform draw from the
    ellipsoid about it; with several groups the times are drawn independently.
    """

    orbit: ArrayLike
    radius: float | ArrayLike
    groups: Sequence[Sequence[int]] | None = None

    def __post_init__(self) -> None:
        orbit = floats("orbit", self.orbit)
        if orbit.ndim != 2 or len(orbit) < 2 or orbit.shape[1] == 0 or orbit.shape[1] % 2:
            raise ValueError(f"`orbit` must have shape (n, 2d), n ≥ 2 states [q, p]; got {orbit.shape}.")
        if not np.isfinite(orbit).all():
            raise ValueError("`orbit` must be finite; it holds NaN or infinity: end it before the blow-up.")
        width = orbit.shape[1]
        radius = floats("radius", self.radius)
        if radius.shape not in ((), (width,)):
            raise ValueError(f"`radius` must be a number or have shape ({width},); got {radius.shape}.")
        if not ((radius > 0) & (radius < np.inf)).all():
            raise ValueError(f"`radius` must be positive and finite; got {self.radius!r}.")
        try:
            groups = [list(range(width))] if self.groups is None else [[*group] for group in self.groups]
        except TypeError:
            groups = []
        whole = all(isinstance(i, int | np.integer) and not isinstance(i, bool) for group in groups for i in group)
        groups = [[int(i) for i in group] for group in groups] if whole else []
        if sorted(i for group in groups for i in group) != list(range(width)):
            raise ValueError(f"`groups` must hold each of 0 … {width - 1} once; got {self.groups!r}.")
        orbit.setflags(write=False)
        radius.setflags(write=False)
        object.__setattr__(self, "orbit", orbit)
        object.__setattr__(self, "radius", radius)
        object.__setattr__(self, "groups", tuple(tuple(group) for group in groups))

    def __repr__(self) -> str:
        n, width = np.shape(self.orbit)
        return f"Tube(orbit of {n} states of length {width}, radius={np.asarray(self.radius).tolist()})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Tube) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash((np.asarray(self.orbit).tobytes(), np.asarray(self.radius).tobytes(), self.groups))

    def _parts(self) -> list[tuple[list[int], np.ndarray, np.ndarray]]:
        """For each group its indices, and the orbit and radii of these coordinates."""
        orbit = np.asarray(self.orbit)
        radius = np.broadcast_to(np.asarray(self.radius), orbit.shape[1:])
        assert self.groups is not None
        return [(list(group), orbit[:, list(group)], radius[list(group)]) for group in self.groups]

    @property
    def width(self) -> int:
        return np.shape(self.orbit)[1]

    def sample(self, n: int, seed: int = 0) -> np.ndarray:
        rng = np.random.default_rng(seed)
        x = np.empty((sample_count(n), np.shape(self.orbit)[1]))
        for indices, orbit, radius in self._parts():
            time = rng.random(n) * (len(orbit) - 1)
            k = time.astype(int)
            centre = orbit[k] + (time - k)[:, None] * (orbit[k + 1] - orbit[k])
            direction = rng.standard_normal((n, len(indices)))
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
            # a hair inside, so that rounding never puts a sample outside
            x[:, indices] = centre + radius * direction * (1 - 1e-12) * rng.random((n, 1)) ** (1 / len(indices))
        return x

    def contains(self, x: Array, slack: float = 0.0) -> np.ndarray:
        x = checked_states(x, np.shape(self.orbit)[1])
        flat = x.reshape(-1, x.shape[-1]).astype(float)
        inside = np.isfinite(flat).all(1)
        for indices, orbit, radius in self._parts():
            block = max(1, _AT_ONCE // orbit.size)
            for start in range(0, len(flat), block):
                rows = slice(start, start + block)
                inside[rows] &= _distance(flat[rows][:, indices] / radius, orbit / radius) <= 1
        return inside.reshape(x.shape[:-1])

    def to_dict(self) -> dict[str, Any]:
        return {
            "kind": "Tube",
            "orbit": np.asarray(self.orbit).tolist(),
            "radius": np.asarray(self.radius).tolist(),
            "groups": [list(group) for group in self.groups or ()],
        }


def _distance(x: np.ndarray, orbit: np.ndarray) -> np.ndarray:
    """Distance of the points x (m, k) to the broken line through orbit (n, k): (m,)."""
    start, along = orbit[:-1], np.diff(orbit, axis=0)
    length = (along**2).sum(1)
    away = x[:, None, :] - start
    with np.errstate(all="ignore"):
        position = (away * along).sum(-1) / np.where(length > 0, length, 1)
        away = away - position.clip(0, 1)[..., None] * along
        return np.sqrt((away**2).sum(-1).min(1))
