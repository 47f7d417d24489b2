"""TimedSympFlow: a SympFlow of networks for a driven system, whose potentials take the time of the state as well."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Self

import torch
from torch import Tensor

from sympflow.arguments import plain
from sympflow.flow.flow_map import FlowMap
from sympflow.flow.potentials import MLPPotential, Potential, Time, hidden_widths
from sympflow.flow.records import MAX_DEGREE, MAX_LAYERS, MAX_PARAMETERS, Refused, checked_integer, checked_widths
from sympflow.flow.records import count_parameters as parameters_of
from sympflow.flow.scaling import Scaling
from sympflow.flow.sympflow import SympFlow, pairs_of_layers
from sympflow.hamiltonian.system import HamiltonianSystem

if TYPE_CHECKING:  # a flow needs it only to be compiled
    from sympflow.kernels.network_tangents import TrainedNetwork
    from sympflow.kernels.networks import NetworkLayer


@dataclass(frozen=True)
class Drive:
    """The time t0 as networks take it: by cos(k ω t0) and sin(k ω t0), or from −1 to 1 where there is no period.

    Parameters
    ----------
    period : float or None
        2π/ω.
    times : (float, float) or None
        Without a period: the interval of t0 + t that is mapped to [−1, 1].
    harmonics : int
        The largest k.

    Raises
    ------
    ValueError
        If a number is not admissible.
    """

    period: float | None
    times: tuple[float, float] | None
    harmonics: int = 2

    def __post_init__(self) -> None:
        m = self.harmonics
        if isinstance(m, bool) or not isinstance(m, int) or not 1 <= m <= MAX_DEGREE:
            raise ValueError(
                f"`harmonics` must be an integer from 1 to {MAX_DEGREE}, of the drive's frequency; got {m!r}."
            )
        if self.period is not None:
            if not (_is_real(self.period) and 0 < self.period < math.inf):
                raise ValueError(f"`period` must be a positive finite number; got {self.period!r}.")
            return
        low, high = (math.nan, math.nan) if self.times is None else self.times
        if not (_is_real(low) and _is_real(high) and -math.inf < low < high < math.inf):
            raise ValueError(
                f"`times` of a drive without a period must be an interval; got {self.times!r}: give the system its "
                "`period`, or a longer `t_span`."
            )

    @classmethod
    def of(cls, system: HamiltonianSystem, harmonics: int = 2) -> Drive:
        """The drive of a system: its period, or its `t_span`."""
        span = (float(min(system.t_span)), float(max(system.t_span))) if system.period is None else None
        return cls(system.period, span, harmonics)

    @property
    def size(self) -> int:
        """The number of features."""
        return 1 if self.period is None else 2 * self.harmonics

    def features(self, t0: Tensor) -> Tensor:
        """The features (size, N) of times (1, N)."""
        if self.period is None:
            assert self.times is not None
            low, high = self.times
            return (2 * t0 - (low + high)) / (high - low)
        turn = (t0 / self.period) % 1.0
        k = torch.arange(1, self.harmonics + 1, dtype=t0.dtype, device=t0.device)[:, None]
        angles = 2 * math.pi * k * turn
        return torch.cat([torch.cos(angles), torch.sin(angles)])


def _is_real(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


class TimedPotential(Potential):
    """V(t0, t, x) = N(t, [x, f(t0)]), N an `MLPPotential`; f(t0) are m constants of a step.

    Points are (d + m, N), the features f(t0) being the last rows. Gradients are those by x, and 0 in these rows, so
    that kicks and drifts leave them as they are.

    Parameters
    ----------
    ndof, features : int
        d and m.
    hidden, activation, scale, center
        As for `MLPPotential`, the last two of x.
    more
        Other arguments of `MLPPotential`.
    """

    def __init__(
        self,
        ndof: int,
        features: int,
        hidden: Sequence[int],
        activation: str,
        *,
        scale: Sequence[float],
        center: Sequence[float],
        **more: Any,
    ) -> None:
        super().__init__()
        self.ndof = ndof
        scale, center = (*scale, *(1.0,) * features), (*center, *(0.0,) * features)
        self.mlp = MLPPotential(ndof + features, hidden, activation, scale=scale, center=center, **more)

    def _by_x(self, gradient: Tensor) -> Tensor:
        return torch.cat([gradient[: self.ndof], torch.zeros_like(gradient[self.ndof :])])

    def impulse(self, t: Time, x: Tensor) -> Tensor:
        return self._by_x(self.mlp.impulse(t, x))

    def impulse_and_rate(self, t: Time, x: Tensor) -> tuple[Tensor, Tensor]:
        impulse, rate = self.mlp.impulse_and_rate(t, x)
        return self._by_x(impulse), rate

    def impulse_and_tangent(self, t: Time, x: Tensor, dx: Tensor) -> tuple[Tensor, Tensor]:
        impulse, tangent = self.mlp.impulse_and_tangent(t, x, dx)
        return self._by_x(impulse), self._by_x(tangent)

    def network(self, is_kick: bool) -> NetworkLayer:
        raise ValueError(
            "`flow` has networks that take the time of the state, and these have no compiled form: use backend='array'."
        )

    def trained(self) -> TrainedNetwork | None:
        return self.mlp.trained()

    def to_dict(self) -> dict[str, Any]:
        return {**self.mlp.to_dict(), "type": "timed"}


class TimedSympFlow(SympFlow):
    """ψ̄_{t0,t}, a SympFlow whose potentials V(t0, t, x) take the time t0 of the state; periodic in t0 if H is.

    For each t0 it is a SympFlow in t: the identity at t = 0, symplectic, with an exact inverse, and the exact flow of a
    Hamiltonian. `SympFlow.timed` makes one for a system.

    Parameters
    ----------
    ndof : int
    drive : Drive
    pairs, hidden, activation, dt, dtype, device, seed, scale
        As for `SympFlow`.
    """

    takes_driving = True

    def __init__(
        self,
        ndof: int,
        drive: Drive,
        pairs: int = 3,
        hidden: Sequence[int] = (10, 10),
        activation: str = "tanh",
        dt: float = 1.0,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
        seed: int = 0,
        scale: Scaling | None = None,
    ) -> None:
        FlowMap.__init__(self, ndof, dt)
        self.drive = drive
        self._plan = {"pairs": plain(pairs), "hidden": list(hidden_widths(hidden)), "activation": activation}
        scale = Scaling.unit(self.ndof, self.dt) if scale is None else scale
        units: dict[str, Any] = {"tau": scale.t, "gain": scale.action, "dtype": dtype, "device": device}
        generator = torch.Generator().manual_seed(plain(seed))

        def potential(unit: tuple[float, ...], center: tuple[float, ...]) -> TimedPotential:
            shape = self.ndof, drive.size, hidden, activation
            return TimedPotential(*shape, scale=unit, center=center, generator=generator, **units)

        self.layers = pairs_of_layers(self.ndof, pairs, hidden, scale, potential, drive.size)

    @classmethod
    def untrained(cls, system: HamiltonianSystem, pairs: int, harmonics: int, **more: Any) -> Self:
        """Return a new one for a driven system, see `SympFlow.timed`.

        Raises
        ------
        ValueError
            If H does not depend on t, or an argument is not admissible.
        """
        if system.autonomous:
            raise ValueError(
                f"`system` {system.name!r} is not driven, its H does not depend on t: use SympFlow, without t0."
            )
        return cls(system.ndof, Drive.of(system, plain(harmonics)), pairs, **more)

    def architecture(self) -> dict[str, Any]:
        return {"ndof": self.ndof, "timed": {**self._plan, **asdict(self.drive)}}

    @classmethod
    def from_architecture(cls, ndof: int, plan: dict[str, Any], dt: float, dtype: torch.dtype) -> Self:
        told = plan["timed"]
        if not isinstance(told, dict):
            raise Refused("its architecture is not a table")
        times = told.get("times")
        if times is not None and not (isinstance(times, list) and len(times) == 2):
            raise Refused("the times of its drive are not an interval")
        drive = Drive(told.get("period"), None if times is None else tuple(times), told.get("harmonics"))  # type: ignore[arg-type]
        pairs = checked_integer(told.get("pairs"), "number of pairs", MAX_LAYERS // 2)
        inputs = ndof + drive.size
        widths = checked_widths(told.get("hidden"), inputs)
        if 2 * pairs * parameters_of(widths, inputs) > MAX_PARAMETERS:
            raise Refused("its architecture is absurdly large")
        return cls(ndof, drive, pairs, widths, told.get("activation"), dt, dtype)  # type: ignore[arg-type]

    @property
    def driven(self) -> bool:
        return True

    @property
    def period(self) -> float | None:
        return self.drive.period

    def transferred(self, system: HamiltonianSystem) -> Self:
        """Return an untrained flow of another driven system, with the numbers of this one, to start from in `train`.

        Raises
        ------
        ValueError
            If the system has other degrees of freedom, or a period where this one has none.
        """
        drive = Drive.of(system, self.drive.harmonics)
        if system.ndof != self.ndof or drive.size != self.drive.size or system.autonomous:
            raise ValueError(
                f"`system` {system.name!r} must be driven, with {self.ndof} degrees of freedom and "
                f"{'a' if self.period else 'no'} period, as that of the flow: train a new one by train(system)."
            )
        other = type(self)(self.ndof, drive, dt=self.dt, dtype=self.dtype, device=self.device, **self._plan)
        other.load_state_dict(self.state_dict())
        return other

    def check_system(self, system: HamiltonianSystem) -> None:
        super().check_system(system)
        if self.fingerprint is None and (system.autonomous or system.period != self.period):
            raise ValueError(
                f"`system` {system.name!r} has {'no drive' if system.autonomous else f'the period {system.period}'}, "
                f"and the flow was made for one of period {self.period}: make one by SympFlow.timed(system)."
            )

    def _opened(self, y: Tensor, passed: float | Tensor) -> tuple[Tensor, Tensor]:
        d = self.ndof
        features = self.drive.features(y[d : d + 1] - passed)
        return torch.cat([y[:d], features]), torch.cat([y[d + 1 :], features])

    def _closed(self, q: Tensor, p: Tensor, time: Tensor) -> Tensor:
        return torch.cat([q[: self.ndof], time, p[: self.ndof]])

    def _map(self, t: float | Tensor, y: Tensor) -> Tensor:
        return self._closed(*self._forwards(t, *self._opened(y, 0.0)), y[self.ndof : self.ndof + 1] + t)

    def _map_inverse(self, t: float | Tensor, y: Tensor) -> Tensor:
        return self._closed(*self._backwards(t, *self._opened(y, t)), y[self.ndof : self.ndof + 1] - t)

    def _map_tangent(self, t: float | Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        time = y[self.ndof : self.ndof + 1]
        q, p, dq, dp = self._tangents(t, *self._opened(y, 0.0))
        return self._closed(q, p, time + t), self._closed(dq, dp, torch.ones_like(time))
