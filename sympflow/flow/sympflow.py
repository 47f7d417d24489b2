"""SympFlow: a symplectic flow map composed of exact flows of simple time-dependent Hamiltonians."""

from __future__ import annotations

import copy
import math
import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self

import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from sympflow.arguments import plain, real_number
from sympflow.compiler import arrays_only
from sympflow.flow.families import family
from sympflow.flow.flow_map import FlowMap
from sympflow.flow.layers import LAYERS, Binding, Drift, Kick, Layer, PotentialLayer
from sympflow.flow.potentials import (
    MLPPotential,
    Potential,
    Unregistered,
    count_weights,
    hidden_widths,
    module_weights,
    potential_named,
)
from sympflow.flow.records import MAX_DEGREE, MAX_LAYERS, MAX_PARAMETERS, Refused, checked_widths, count_parameters
from sympflow.flow.scaling import Scaling
from sympflow.flow.weights import Kept, check_compilable, check_memory, checked_device, checked_dtype
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.protocol import Kernel
from sympflow.schemes import Scheme

if TYPE_CHECKING:  # a flow needs it only to be compiled
    from sympflow.kernels.network_tangents import NetworkTangents
    from sympflow.kernels.networks import MLPFlowKernel


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
            if not (real_number(self.period) and 0 < self.period < math.inf):
                raise ValueError(f"`period` must be a positive finite number; got {self.period!r}.")
            return
        low, high = (math.nan, math.nan) if self.times is None else self.times
        if not (real_number(low) and real_number(high) and -math.inf < low < high < math.inf):
            raise ValueError(
                f"`times` of a drive without a period must be an interval; got {self.times!r}: give the system its "
                "`period`, or a longer `t_span`."
            )

    @classmethod
    def of(cls, system: HamiltonianSystem, harmonics: int = 2) -> Drive | None:
        """The drive of a system: its period, or its `t_span`; None where H does not depend on t."""
        if system.autonomous:
            return None
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


class SympFlow(FlowMap):
    """ψ̄_t = φ_m^L ∘ φ_p^L ∘ … ∘ φ_m^1 ∘ φ_p^1, of L pairs of a kick and a drift with MLP potentials.

    Symplectic for every t and every value of its parameters, with an exact inverse, and the exact flow of a
    Hamiltonian that can be written down. `from_layers` takes any list of layers instead.

    Parameters
    ----------
    ndof : int
        Degrees of freedom d.
    pairs : int
        L.
    hidden, activation
        Of each potential, see `MLPPotential`.
    dt : float
        Δt.
    dtype, device
        Of the parameters.
    seed : int
        Of the initial parameters.
    scale : Scaling, optional
        Units of q, p and t; `train` takes them from the domain. The default is 1 for q and p, and Δt for t.
    drive : Drive, optional
        For a driven system: the potentials V(t0, t, x) take the time t0 of the state too, see `SympFlow.timed`.
    layers : iterable of Layer, optional
        A list of layers, in place of all arguments between `ndof` and `dt`.

    References
    ----------
    .. [1] P. Canizares, D. Murari, C.-B. Schönlieb, F. Sherry, Z. Shumaylov, Hamiltonian matching for symplectic
       neural integrators, 2024, eqs. (3)–(5).

    Examples
    --------
    >>> flow = SympFlow(ndof=2, pairs=3, dt=1.0)
    >>> x = torch.zeros(100, 4, dtype=torch.float64)
    >>> flow(2.5, x).shape, flow.inverse(2.5, x).shape, flow.hamiltonian(0.5, x).shape
    (torch.Size([100, 4]), torch.Size([100, 4]), torch.Size([100]))
    """

    kind = "sympflow"
    symplectic = True
    _network: Kept[Any] | None = None

    def __init__(
        self,
        ndof: int,
        pairs: int = 3,
        hidden: Sequence[int] = (10, 10),
        activation: str = "tanh",
        dt: float = 1.0,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
        seed: int = 0,
        scale: Scaling | None = None,
        drive: Drive | None = None,
        layers: Iterable[Layer] | None = None,
    ) -> None:
        super().__init__(ndof, dt)
        self.drive, self.takes_driving = drive, self.takes_driving or drive is not None
        if layers is not None:
            self.layers = layers if isinstance(layers, tuple) else nn.ModuleList(layers)
            return
        scale = Scaling.unit(self.ndof, self.dt) if scale is None else scale
        generator = torch.Generator().manual_seed(plain(seed))
        features = 0 if drive is None else drive.size
        pairs, widths = plain(pairs), hidden_widths(hidden)
        if isinstance(pairs, bool) or not isinstance(pairs, int) or pairs < 1:
            raise ValueError(f"`pairs` must be a positive integer, the number of kick–drift pairs; got {pairs!r}.")
        if len(scale.q) != ndof:
            raise ValueError(f"`scale` is for {len(scale.q)} degrees of freedom, not {ndof}: give one entry for each.")
        if 2 * pairs > MAX_LAYERS:
            raise ValueError(f"`pairs` must be at most {MAX_LAYERS // 2}, as many as a file may hold; got {pairs!r}.")
        weights = 2 * pairs * count_weights(self.ndof + features, widths)
        check_memory(f"`hidden` {widths!r} with `pairs` {pairs}", weights, "take narrower layers, or fewer pairs")
        like: dict[str, Any] = {"tau": scale.t, "gain": scale.action, "features": features, "generator": generator}
        like |= {"dtype": dtype, "device": device}
        units = {Kick: (scale.q, scale.q_center), Drift: (scale.p, scale.p_center)}
        self.layers = nn.ModuleList(
            layer(MLPPotential(self.ndof, widths, activation, scale=unit, center=center, **like))
            for _ in range(pairs)
            for layer, (unit, center) in units.items()
        )

    @classmethod
    def from_layers(cls, layers: Iterable[Layer], dt: float, drive: Drive | None = None) -> Self:
        """Return the composition of `layers`, the first applied first, for t ∈ [0, dt].

        Raises
        ------
        ValueError
            If there are no layers or their degrees of freedom differ.
        """
        layers = list(layers)
        if not layers or len({layer.ndof for layer in layers}) != 1:
            raise ValueError("`layers` must be one or more layers with the same ndof: check the list.")
        return cls(layers[0].ndof, dt=dt, drive=drive, layers=layers)

    @classmethod
    def from_potentials(cls, potentials: Iterable[Any], dt: float, *, dtype: torch.dtype | None = None) -> Self:
        """Return the SympFlow of networks that were trained elsewhere; `to_potentials` is the reverse.

        Each potential V(t, x) = w · σ(W_n σ(… σ(W_1 [x, t] + b_1) …) + b_n) is one of a kick,
        p −= ∇V(t, q) − ∇V(0, q), or of a drift, q += ∇V(t, p) − ∇V(0, p), in the order in which they are applied: in
        the architecture of [1]_ kick, drift, kick, drift, ….

        Parameters
        ----------
        potentials : iterable of mapping, or of (str, torch.nn.Sequential)
            A mapping has the entry "kind", "kick" (V of q) or "drift" (V of p), and the arguments of
            `MLPPotential.from_weights`: "weights", those of `torch.nn.Linear`, (h_1, d + 1), …, (1, h_n); "biases",
            (h_1,), …, (h_n,), that of the output being optional, because it has no effect; "activation", a name, "tanh"
            if there is none; and "time", the place of t in the input, "last" if there is none. A pair has the kind and
            a module of Linear layers and activations in turn, whose last input is t.
        dt : float
            Δt, the longest time that they were trained for.
        dtype : torch.dtype, optional
            The default is that of the numbers.

        Returns
        -------
        SympFlow
            With parameters that do not require gradients, on the CPU, in the units of the numbers.

        Raises
        ------
        ValueError, TypeError
            If there are none, their sizes differ or do not fit, or a number or an activation is not admissible: the
            message begins with the number of the potential.

        Examples
        --------
        >>> net = torch.nn.Sequential(torch.nn.Linear(2, 5), torch.nn.SiLU(), torch.nn.Linear(5, 1))
        >>> flow = SympFlow.from_potentials([("kick", net), ("drift", net)], dt=1.0)
        >>> flow.ndof, flow.dtype, flow.layers[0].potential.activation
        (1, torch.float32, 'swish')
        """
        layers = []
        for i, entry in enumerate(_listed(potentials)):
            try:
                layers.append(_layer_of(entry, dtype))
            except (ValueError, TypeError) as error:
                kind = TypeError if isinstance(error, TypeError) else ValueError
                raise kind(f"`potentials[{i}]` cannot be taken: {error}") from error
        if not layers or len({(layer.ndof, layer.potential.weight_x.dtype) for layer in layers}) != 1:
            raise ValueError(
                "`potentials` must be one or more of the same degrees of freedom and dtype; got "
                f"{[layer.ndof for layer in layers]}: check the list, or pass dtype=torch.float64."
            )
        return cls.from_layers(layers, dt).requires_grad_(False)

    def to_potentials(self) -> list[dict[str, Any]]:
        """Return its networks in the layout of `from_potentials`, as NumPy arrays, its units multiplied in.

        Raises
        ------
        TypeError
            If a layer is not a kick or drift with an MLP potential.
        """
        found = []
        for layer in self.layers:
            if type(layer) not in LAYERS.values() or not isinstance(layer.potential, MLPPotential):
                raise TypeError(
                    "`flow` has layers other than kicks and drifts with MLP potentials, whose numbers have no such "
                    "layout: save it by flow.save(path)."
                )
            found.append({"kind": layer.kind, **layer.potential.to_weights()})
        return found

    @staticmethod
    def primed(
        system: HamiltonianSystem,
        stages: int | None = None,
        *,
        dt: float = 1.0,
        palindromic: bool = True,
        scheme: Scheme | str | None = None,
        degree: int | None = None,
        force_gradient: bool | Sequence[int] | None = None,
        processor: int = 0,
        curvature: bool | Sequence[int] = False,
        polynomial: int | None = None,
        first: str = "drift",
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> Any:
        """Return a `PrimedFlow`: its potentials are the system's own V and T times polynomials in t.

        Untrained it is a classical splitting scheme; `train(system, flow=flow)` fits it to the system and its domain.
        Frozen at any t it is a splitting scheme again, `flow.scheme(t)`, and as fast as one.

        Parameters
        ----------
        system : HamiltonianSystem
            Separable.
        stages : int, optional
            Number of kicks, 6 by default: the untrained flow is this number of equal leapfrog or Verlet steps, see
            `first`.
        dt : float
            Δt.
        palindromic : bool
            True for a time-reversible flow, with half the parameters.
        scheme : Scheme or str, optional
            A table, or its name as `sympflow.schemes.scheme_named` knows it, to start from in place of leapfrog.
        degree : int, optional
            Of the polynomials that multiply V and T; 7 by default, 5 with a processor, which has more of them.
        force_gradient : bool or sequence of int, optional
            True for a term in ½|∇V|²_{M⁻¹} in the kicks, which is the default where T is quadratic; or the numbers of
            the kicks of the kernel that have it, counted from 0: ``[1, 3]`` of five. Where a force gradient takes as
            long as a force, as on lattices of polynomials, more kicks with fewer force gradients are more efficient; in
            few degrees of freedom two or three kicks with one of them.
        processor : int
            Number of kicks of χ in ψ̄_t = χ_t ∘ K_t ∘ χ_t⁻¹, 0 for none. A run executes χ⁻¹ once, the kernel K of
            `stages` kicks in every step, and χ for every output.
        curvature : bool or sequence of int
            True for a further term in ½ v·∇²V v, v = M⁻¹∇V, which takes third derivatives of V: for symbolic systems.
            Or the numbers of the kicks that have it, of those with force gradients. A trained kick with it is tens of
            times more accurate, and takes 1.1 to 1.5 times as long.
        polynomial : int, optional
            In place of force gradients and curvatures every kick has a trained polynomial in q of this total degree,
            t³ Σ_m e_m(t) q^m: for symbolic systems in few degrees of freedom. Its monomials are those of V and of what
            products of gradients make from it, ∇VᵀM⁻¹∇V first, where V is a polynomial, else those with the symmetry of
            V. For a polynomial V of degree n, 2n − 2 is a good choice.
        first : {"drift", "kick"}
            The map that begins and ends a step. The last kick of a step and the first of the next are merged: with an
            even number of kicks, each with a polynomial or a curvature, "kick" gives a palindrome more numbers at no
            cost.
        dtype, device
            Of the parameters.

        Raises
        ------
        ValueError
            If the system is not separable, or an argument is not admissible.
        """
        given = dict(locals())
        return family("primed").untrained(**given)

    @staticmethod
    def split(
        system: HamiltonianSystem,
        stages: int = 4,
        *,
        dt: float = 1.0,
        terms: int = 8,
        filters: bool = True,
        force_gradient: bool | Sequence[int] | None = None,
        parts: Sequence[str] | None = None,
        linear_outside: bool = True,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> Any:
        """Return a `SplitFlow`, for stiff systems: of exact flows of the parts of H, the linear one among them.

        Untrained it is `stages` equal Strang steps; `train(system, flow=flow)` fits it to the system and its domain.

        Parameters
        ----------
        system : HamiltonianSystem
            One with parts that are solved exactly: `sympflow.hamiltonian.parts.exact_parts`.
        stages : int
            Number of Strang steps; the flow is a palindrome.
        dt : float
            Δt.
        terms : int
            Number of even polynomials in t of each coefficient.
        filters : bool
            True if the parts see the fast modes through trained filters.
        force_gradient : bool or sequence of int, optional
            True for a term in ½|∇U|²_{M⁻¹} in the kicks, or the numbers of those that have it, counted from 0,
            symmetric about the middle; by default all have it where H = ½ pᵀM⁻¹p + ½ qᵀKq + U(q).
        parts : sequence of str, optional
            The parts, as for the method "strang_parts".
        linear_outside : bool
            True if the linear part begins and ends the flow; else it is innermost in each Strang step.
        dtype, device
            Of the parameters.

        Raises
        ------
        ValueError
            If the system has no such parts, or an argument is not admissible.
        """
        given = dict(locals())
        return family("split").untrained(**given)

    @staticmethod
    def collocated(
        system: HamiltonianSystem,
        *,
        dt: float = 1.0,
        stages: int = 4,
        steps: int | None = None,
        states: ArrayLike | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> Any:
        """Return a `CollocatedFlow`, of steps of a Gauss method with the system's own H, separable or not.

        Nothing in it is trained. It is the flow of a Hamiltonian that is not separable and known, or was learned: exact
        to the error of the method, at the cost of Newton's iteration in every step.

        Parameters
        ----------
        system : HamiltonianSystem
            Of any form, with friction too; not driven.
        dt : float
            Δt.
        stages : int
            s, of the method of order 2s.
        steps : int, optional
            Number of equal steps in Δt; by default the least for which the error of ψ̄_Δt is below 1e-10 of the spread
            of the states at 99 % of some states.
        states : array_like of shape (n, 2d), optional
            The states at which that is measured; by default some of the domain of the system.
        dtype, device
            Of the states.

        Raises
        ------
        ValueError
            If the system is driven or has another force than friction, `dt` is so long that it takes more than
            two hundred steps, or an argument is not admissible.

        Examples
        --------
        >>> flow = SympFlow.collocated(sympflow.systems.double_pendulum(), dt=0.1)
        >>> flow.hamiltonian(0.1, torch.zeros(5, 4, dtype=torch.float64)).shape
        torch.Size([5])
        """
        given = dict(locals())
        return family("collocated").of(**given)

    @staticmethod
    def timed(
        system: HamiltonianSystem,
        pairs: int = 3,
        *,
        hidden: Sequence[int] = (10, 10),
        activation: str = "tanh",
        dt: float = 1.0,
        harmonics: int = 2,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
        seed: int = 0,
        scale: Scaling | None = None,
    ) -> Any:
        """Return a SympFlow of networks for a driven system, whose potentials take the time of the state too.

        The time t0 enters by cos(2πk t0/T) and sin(2πk t0/T) where H has a period T; else by its place in `t_span`. For
        each t0 it is a SympFlow in t, and periodic in t0 if H is.

        Parameters
        ----------
        system : HamiltonianSystem
            Driven, of any form.
        harmonics : int
            The largest k.
        pairs, hidden, activation, dt, dtype, device, seed, scale
            As for `SympFlow`.

        Raises
        ------
        ValueError
            If H does not depend on t, or an argument is not admissible.
        """
        drive = Drive.of(system, plain(harmonics))
        if drive is None:
            raise ValueError(
                f"`system` {system.name!r} is not driven, its H does not depend on t: use SympFlow, without t0."
            )
        return SympFlow(system.ndof, pairs, hidden, activation, dt, dtype, device, seed, scale, drive)

    @property
    def driven(self) -> bool:
        return self.drive is not None

    @property
    def period(self) -> float | None:
        return None if self.drive is None else self.drive.period

    def transferred(self, system: HamiltonianSystem) -> Self:
        """Return an untrained flow of another driven system, with the numbers of this one, as a start for `train`.

        Raises
        ------
        ValueError
            If this is not a flow of networks of a driven system, or the system has other degrees of freedom, or only
            one of them has a period.
        """
        mine = self.drive
        drive = None if mine is None else Drive.of(system, mine.harmonics)
        if mine is None or drive is None or (system.ndof, drive.size) != (self.ndof, mine.size):
            raise ValueError(
                f"`system` {system.name!r} must be driven, with {self.ndof} degrees of freedom and "
                f"{'a' if self.period else 'no'} period, as that of the flow: train a new one by train(system)."
            )
        return type(self).from_layers(copy.deepcopy(self.layers), self.dt, drive)  # type: ignore[arg-type]

    def check_system(self, system: HamiltonianSystem) -> None:
        super().check_system(system)
        theirs = Drive.of(system)
        own = theirs is not None and theirs.period == self.period
        if self.drive is not None and self.fingerprint is None and not own:
            raise ValueError(
                f"`system` {system.name!r} has {'no drive' if theirs is None else f'the period {theirs.period}'}, "
                f"and the flow was made for one of period {self.period}: make one by SympFlow.timed(system)."
            )

    def architecture(self) -> dict[str, Any]:
        plan = {"ndof": self.ndof, "layers": [layer.to_dict() for layer in self.layers]}  # type: ignore[operator]
        return plan if self.drive is None else plan | {"drive": asdict(self.drive)}

    @classmethod
    def from_architecture(cls, ndof: int, plan: dict[str, Any], dt: float, dtype: torch.dtype) -> Self:
        layers = plan.get("layers")
        if not isinstance(layers, list) or not 1 <= len(layers) <= MAX_LAYERS:
            raise Refused("its list of layers is missing or too long")
        # All sizes first: nothing is allocated for a file that asks for too much.
        drive = _drive_of(plan.get("drive"))
        potentials = [_potential_of(layer) for layer in layers]
        inputs = ndof + (0 if drive is None else drive.size)
        widths = [checked_widths(plan.get("hidden"), inputs) for plan in potentials if plan["type"] == "mlp"]
        if any(p.get("features", 0) != inputs - ndof for p in potentials if p["type"] == "mlp"):
            raise Refused("its potentials do not take the time of its drive")
        if sum(count_parameters(w, inputs) for w in widths) > MAX_PARAMETERS:
            raise Refused("its architecture is too large")
        built = [_built(potential, ndof, dtype) for potential in potentials]
        made = (LAYERS[layer["kind"]](potential) for layer, potential in zip(layers, built, strict=True))
        return cls.from_layers(made, dt, drive)

    def save(self, path: str | os.PathLike[str]) -> None:
        if "layers" in self.architecture():  # the plans of special families describe no layers one by one
            for layer in self.layers:
                _check_storable(layer)
        super().save(path)

    @property
    def _kept_kernels(self) -> Kept[Any]:
        """The compiled loops of the numbers that the flow has now."""
        if self._network is None:
            self._network = Kept(self._kept_tensors())
        return self._network

    def _kept_tensors(self) -> Iterable[Mapping[str, Tensor | None]]:
        """The tensors that compiled loops are made of; each run compares them with those of the run before."""
        return (d for m in self.modules() for d in (m._parameters, m._buffers))

    def _loops_for(self, system: HamiltonianSystem) -> Kernel:
        return self._kept_kernels.current(self._compiled)

    def _compiled(self) -> MLPFlowKernel:
        from sympflow.kernels.networks import MLPFlowKernel

        if not (potentials := self._potentials()):
            raise arrays_only("`flow` has layers other than kicks and drifts with MLP potentials")
        networks = [V.network(is_kick) for is_kick, V in potentials]
        check_compilable(self.dtype, self.device)
        return MLPFlowKernel(self.ndof, networks)

    def tangents(self) -> NetworkTangents | None:
        from sympflow.kernels.network_tangents import NetworkTangents

        potentials = self._potentials()
        networks = [network for _, V in potentials if (network := V.trained()) is not None]
        alike = len({(n.inputs, n.widths, n.activation) for n in networks}) == 1
        if not alike or len(networks) < len(potentials):
            return None
        return NetworkTangents(self.ndof, [is_kick for is_kick, _ in potentials], networks)

    def _potentials(self) -> list[tuple[bool, MLPPotential]]:
        """The potentials of its kicks, with True, and drifts; none where a layer is of another kind."""
        layers: list[Any] = list(self.layers)
        if not all(isinstance(x, PotentialLayer) and isinstance(x.potential, MLPPotential) for x in layers):
            return []
        return [(layer.kind == "kick", layer.potential) for layer in layers]

    def step_constants(self, x: Tensor, *t0: Tensor) -> Tensor:
        """Inputs of the networks of a step from states (N, 2d), besides the states and t: (m, N)."""
        return self._opened(self._columns(0.0, self.lift(x, *t0))[1], 0.0)[0][self.ndof :]

    def hamiltonian_unchecked(self, t: float | Tensor, x: Tensor, t0: Any = None) -> Tensor:
        t, y, batch = self._columns(t, self.lift(x, t0, t))
        q, p = self._opened(y, t)
        H = torch.zeros_like(y[0])
        for layer in reversed(self.layers):
            q, p, rate = layer.pull_back(t, q, p)
            H = H + rate
        return H.reshape(batch)

    def _opened(self, y: Tensor, passed: float | Tensor) -> tuple[Tensor, Tensor]:
        """The q and p that the layers take, of columns y at a time `passed` after t0."""
        if self.drive is None:
            q, p = y.chunk(2)
            return q, p
        d = self.ndof
        features = self.drive.features(y[d : d + 1] - passed)
        return torch.cat([y[:d], features]), torch.cat([y[d + 1 :], features])

    def _closed(self, q: Tensor, p: Tensor, y: Tensor, passed: float | Tensor) -> Tensor:
        """The columns of the q and p that the layers give, the time that of y and what has passed."""
        d = self.ndof
        return torch.cat([q, p] if self.drive is None else [q[:d], y[d : d + 1] + passed, p[:d]])

    def _map(self, t: float | Tensor, y: Tensor) -> Tensor:
        return self._applied(self.layers, t, y)

    def _map_inverse(self, t: float | Tensor, y: Tensor) -> Tensor:
        return self._applied(self.layers, t, y, back=True)

    def _applied(self, layers: Any, t: float | Tensor, y: Tensor, back: bool = False) -> Tensor:
        """Columns after some layers in turn, or after their inverses, the last first."""
        q, p = self._opened(y, t if back else 0.0)
        for layer in reversed(layers) if back else layers:
            q, p = layer.inverse(t, q, p) if back else layer(t, q, p)
        return self._closed(q, p, y, -t if back else t)

    def _map_tangent(self, t: float | Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        q, p = self._opened(y, 0.0)
        dq, dp = torch.zeros_like(q), torch.zeros_like(p)
        for layer in self.layers:
            q, p, dq, dp = layer.tangent(t, q, p, dq, dp)  # type: ignore[operator]
        return self._closed(q, p, y, t), self._closed(dq, dp, torch.zeros_like(y), 1.0)


class SystemFlow(SympFlow, ABC):
    """A SympFlow whose maps are made of a system's own functions, which its file does not hold."""

    PLAN: ClassVar[str]
    """The name of its plan in a file: `plan` writes the plan, `checked_plan` reads it."""
    MADE: ClassVar[str] = "primed with the V and T of a system"

    def __init__(
        self,
        ndof: int,
        dt: float,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__(ndof, dt=dt, layers=())
        self._like: dict[str, Any] = {"dtype": checked_dtype(dtype), "device": checked_device(device)}
        self._binding = Binding(None, self.MADE)

    @abstractmethod
    def plan(self) -> dict[str, Any]:
        """The numbers that describe the flow, JSON-able."""

    @classmethod
    @abstractmethod
    def checked_plan(cls, plan: dict[str, Any], ndof: int) -> dict[str, Any]:
        """Return the arguments of the class that a file describes, after a check of each, which raises `Refused`."""

    def architecture(self) -> dict[str, Any]:
        return {"ndof": self.kept_ndof, self.PLAN: self.plan()}

    @classmethod
    def from_architecture(cls, ndof: int, plan: dict[str, Any], dt: float, dtype: torch.dtype) -> Self:
        described = plan[cls.PLAN]
        if not isinstance(described, dict):
            raise Refused(f"its plan of a {cls.PLAN} flow is missing")
        made: Any = cls
        return made(ndof, dt=dt, dtype=dtype, **cls.checked_plan(described, ndof))

    def _made_of(self, system: HamiltonianSystem | None) -> None:
        """Become the flow of a system, where there is one."""
        if system is not None:
            self._take(system)
            self.identify(system)

    @property
    def system(self) -> HamiltonianSystem | None:
        """The system whose functions the flow uses, None for one loaded without it."""
        return self._binding.system if self._binding.known else None

    def bind(self, system: HamiltonianSystem) -> Self:
        """Give a flow that was loaded from a file its system; a ValueError if it was made for another one."""
        self.check_system(system)
        self._take(system)
        return self

    def _take(self, system: HamiltonianSystem) -> None:
        """Take the functions of a system that was checked."""
        self._binding.bind(system)

    def bound(self, system: HamiltonianSystem) -> Self:
        return self if self._binding.known else self.bind(system)

    def _kept_tensors(self) -> Iterable[Mapping[str, Tensor | None]]:
        # Without the buffers of its columns: those are bases of polynomials, which never change.
        return (self._buffers, *(m._parameters for m in self.modules()))

    def _loops_for(self, system: HamiltonianSystem, compensated: bool = False) -> Kernel:
        flow = self.bound(system)
        kernels = flow._kept_kernels.current(dict)
        if compensated not in kernels or kernels[compensated][0] is not system:
            check_compilable(flow.dtype, flow.device)
            kernels[compensated] = system, flow._compiled_for(system, compensated)
        return kernels[compensated][1]

    def _compiled_for(self, system: HamiltonianSystem, compensated: bool) -> Kernel:
        """The compiled loops of the flow on a system; a `NotCompiled` if there are none, as here."""
        raise arrays_only(f"`flow` of kind {self.PLAN!r} has no compiled loops")


def _drive_of(told: Any) -> Drive | None:
    """Return the drive of a description."""
    if told is None:
        return None
    if not isinstance(told, dict):
        raise Refused("its drive is not a table")
    times = told.get("times")
    if times is not None and not (isinstance(times, list) and len(times) == 2):
        raise Refused("the times of its drive are not an interval")
    return Drive(told.get("period"), None if times is None else tuple(times), told.get("harmonics"))  # type: ignore[arg-type]


def _potential_of(layer: Any) -> dict[str, Any]:
    """Return the potential of a layer's description."""
    if not isinstance(layer, dict) or str(layer.get("kind")) not in LAYERS:
        raise Refused("it has a layer of unknown kind")
    potential = layer.get("potential")
    if not isinstance(potential, dict) or not isinstance(potential.get("type"), str):
        raise Refused("it has a potential of unknown type")
    return potential


def _built(plan: dict[str, Any], ndof: int, dtype: torch.dtype) -> Potential:
    """Return the untrained potential of a description; its class may be a user's."""
    cls = potential_named(plan["type"])
    if cls is MLPPotential:
        return cls.from_dict(ndof, plan, dtype)
    try:
        potential = cls.from_dict(ndof, plan, dtype)
    except Exception as error:
        raise Refused(f"its potential {plan['type']!r} cannot be built ({type(error).__name__}: {error})") from error
    if not isinstance(potential, Potential) or potential.ndof != ndof:
        raise Refused(f"its potential {plan['type']!r} is not one of {ndof} degrees of freedom")
    return potential


def _check_storable(layer: Any) -> None:
    """Raise a ValueError if a file of the layer could not be read again."""
    if type(layer) not in LAYERS.values():
        raise ValueError(
            f"`flow` has a layer {type(layer).__name__}, and files hold kicks and drifts only: write it as these."
        )
    plan = layer.potential.to_dict()
    name = plan.get("type")
    try:
        known = potential_named(name)
    except Unregistered:
        known = None
    if known is not type(layer.potential):
        raise ValueError(
            f"`flow` has a potential {type(layer.potential).__name__} that no file can name: register the class by "
            "sympflow.flow.potentials.register_potential(name, cls), with that name as the 'type' in its to_dict()."
        )


def _listed(potentials: Any) -> list[Any]:
    if isinstance(potentials, str | Mapping | nn.Sequential) or not isinstance(potentials, Iterable):
        raise TypeError(f"`potentials` must be a list, in the order of the layers; got {type(potentials).__name__}.")
    return list(potentials)


def _layer_of(entry: Any, dtype: torch.dtype | None) -> Any:
    """Return the kick or drift of an entry of `from_potentials`."""
    if isinstance(entry, Mapping):
        given = dict(entry)
        kind = given.pop("kind", None)
        unknown = given.keys() - {"weights", "biases", "activation", "time"}
        if unknown or not given.keys() >= {"weights", "biases"}:
            raise ValueError(
                f"it must have kind, weights and biases, and may have activation and time; got {sorted(entry)}."
            )
    elif isinstance(entry, Sequence) and len(entry) == 2 and isinstance(entry[1], nn.Module):
        kind, given = entry[0], module_weights(entry[1])
    else:
        raise TypeError(f"it must be a mapping, or a pair of a kind and a torch.nn.Sequential; got {entry!r:.60}.")
    if not isinstance(kind, str) or kind not in LAYERS:
        raise ValueError(f"its kind must be 'kick', V of q, or 'drift', V of p; got {kind!r}.")
    return LAYERS[kind](MLPPotential.from_weights(**given, dtype=dtype))
