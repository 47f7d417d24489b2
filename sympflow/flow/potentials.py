"""Potentials V(t, x) with closed-form derivatives: the Hamiltonians that a SympFlow is composed of.

Arrays here are feature-major: points x have shape (d, N), hidden features (h, N), one column a point. Products with
the small weight matrices are several times faster that way round. A time t is a float or a tensor of shape () or (N,).

A potential must be C² (Canizares et al. 2024, section 2.1), so every activation σ is smooth. Each is given by what the
sweeps through a network need of it, which shares more than separate derivatives would.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property, partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Generic, Self, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from sympflow.arguments import plain
from sympflow.arrays import jvp
from sympflow.compiler import arrays_only
from sympflow.flow.weights import check_memory, checked_device, checked_dtype
from sympflow.lazy import announced, distribution, load_announced

if TYPE_CHECKING:  # a flow needs it only to be compiled
    from importlib.metadata import EntryPoint

    from sympflow.kernels.network_tangents import TrainedNetwork
    from sympflow.kernels.networks import NetworkLayer

Time = float | Tensor
T = TypeVar("T")

ACTIVATION_GROUP, POTENTIAL_GROUP = "sympflow.activations", "sympflow.potentials"
"""The entry-point groups in which a distribution announces its activations and potentials: files name them."""


class Unregistered(ValueError):
    """A name of an activation or a potential that nothing is registered under; `what` and `remedy` are for messages."""

    def __init__(self, kind: str, name: Any, known: Iterable[str]) -> None:
        self.what = f"{kind} {_short(name)}"
        self.remedy = f"register it by sympflow.flow.potentials.register_{kind}"
        super().__init__(f"`{kind}` {_short(name)} is unknown: choose one of {', '.join(known)}, or {self.remedy}.")


class Activation:
    """σ, and its derivatives as the sweeps need them."""

    compiled: Any = None
    """For compiled loops, if they do not know σ by name: a function of a number a, of Python or Numba, that returns
    σ(a) and σ'(a)."""

    def value(self, a: Tensor) -> Tensor:
        """σ(a)."""
        return self.slope(a)[0]

    def slope(self, a: Tensor) -> tuple[Tensor, Tensor]:
        """σ(a) and σ'(a)."""
        raise NotImplementedError

    def tangent(self, a: Tensor, da: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """σ(a) and σ'(a), then their derivatives σ'(a) ȧ and σ''(a) ȧ along ȧ."""
        raise NotImplementedError


class _Closed(Activation):
    """σ in closed form: σ(a), σ'(a) by a and σ(a), and σ''(a) ȧ by these, ȧ and σ'(a) ȧ."""

    def __init__(self, name: str, value: Any, slope: Any, second: Any) -> None:
        self.name, self._value, self._slope, self._second = name, value, slope, second

    def value(self, a: Tensor) -> Tensor:
        return self._value(a)

    def slope(self, a: Tensor) -> tuple[Tensor, Tensor]:
        h = self._value(a)
        return h, self._slope(a, h)

    def tangent(self, a: Tensor, da: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        h, slope = self.slope(a)
        dh = slope * da
        return h, slope, dh, self._second(a, h, slope, da, dh)

    def __reduce__(self) -> Any:
        return activation_named, (self.name,)


class FunctionActivation(Activation):
    """A function of tensors, whose derivatives are found by forward-mode differentiation.

    Parameters
    ----------
    name : str
        By which it is registered, and pickled.
    function : callable
        σ, elementwise.
    compiled : callable, optional
        See `Activation`.
    """

    def __init__(self, name: str, function: Callable[[Tensor], Tensor], compiled: Any = None) -> None:
        self.name, self.function, self.compiled = name, function, compiled

    def value(self, a: Tensor) -> Tensor:
        return self.function(a)

    def slope(self, a: Tensor) -> tuple[Tensor, Tensor]:
        return jvp(self.function, a, torch.ones_like(a))

    def tangent(self, a: Tensor, da: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        (h, slope), (dh, dslope) = jvp(self.slope, a, da)
        return h, slope, dh, dslope

    def __reduce__(self) -> Any:
        return activation_named, (self.name,)


def _second_of_swish(a: Tensor, h: Tensor, slope: Tensor, da: Tensor, dh: Tensor) -> Tensor:
    s = torch.sigmoid(a)
    return s * (1 - s) * (2 + a * (1 - 2 * s)) * da


_FORMS: dict[str, tuple[Any, Any, Any]] = {
    "tanh": (torch.tanh, lambda a, h: 1 - h * h, lambda a, h, s, da, dh: -2 * h * dh),
    "sin": (torch.sin, lambda a, h: torch.cos(a), lambda a, h, s, da, dh: -h * da),
    "sigmoid": (torch.sigmoid, lambda a, h: h * (1 - h), lambda a, h, s, da, dh: (1 - 2 * h) * dh),
    "softplus": (
        lambda a: torch.logaddexp(a, torch.zeros_like(a)),
        lambda a, h: torch.sigmoid(a),
        lambda a, h, s, da, dh: (1 - s) * dh,
    ),
    "logcosh": (
        lambda a: torch.logaddexp(a, -a) - math.log(2),
        lambda a, h: torch.tanh(a),
        lambda a, h, s, da, dh: (1 - s * s) * da,
    ),
    "swish": (lambda a: a * torch.sigmoid(a), lambda a, h: torch.sigmoid(a) * (1 + a - h), _second_of_swish),
}

ACTIVATIONS: dict[str, Activation] = {name: _Closed(name, *forms) for name, forms in _FORMS.items()}
"""The built-in activations: tanh a, sin a, 1/(1 + exp(−a)), log(1 + exp a), log cosh a, and a/(1 + exp(−a))."""


class Register(Generic[T]):
    """Things that files name: built-in, registered in this process, or announced by a plug-in."""

    def __init__(self, kind: str, group: str, built_in: Mapping[str, T], checked: Callable[[str, Any], T]) -> None:
        self.kind, self.group, self.built_in, self.checked = kind, group, dict(built_in), checked
        self.added: dict[str, T] = {}

    @property
    def known(self) -> dict[str, T]:
        return self.built_in | self.added

    @cached_property
    def announced(self) -> dict[str, EntryPoint]:
        return announced(self.group, self.kind, self.built_in)

    def named(self, name: Any) -> T:
        """The registered object of that name; a ValueError if there is none, an ImportError if a plug-in is broken."""
        if isinstance(name, str) and name in self.known:
            return self.known[name]
        if not isinstance(name, str) or name not in self.announced:
            raise Unregistered(self.kind, name, [*self.known, *self.announced])
        point = self.announced[name]
        try:
            self.added[name] = self.checked(name, load_announced(point, self.kind))
        except (TypeError, ValueError) as error:
            raise ImportError(
                f"`{self.kind}` {name!r} of the plug-in {distribution(point)} is not valid ({error}): report this to "
                "its author."
            ) from error
        return self.added[name]

    def check_name(self, name: Any) -> None:
        """Raise TypeError or ValueError unless something may be registered under a name."""
        mine = f"'my_{self.kind}'"
        if not isinstance(name, str):
            raise TypeError(f"`name` must be a string, such as {mine}; got {type(name).__name__}.")
        if not name.strip() or name in self.built_in:
            taken = "is empty" if not name.strip() else f"is a built-in {self.kind}, which cannot be replaced"
            raise ValueError(f"`name` {name!r} {taken}: choose another one, such as {mine}.")


def activation_named(name: str) -> Activation:
    """Return the activation of that name: built-in, registered or a plug-in's; else a ValueError."""
    return activations.named(name)


def register_activation(
    name: str, activation: Activation | Callable[[Tensor], Tensor], compiled: Callable[[float], Any] | None = None
) -> None:
    """Make an activation known by name in this process: to new networks, and to files of flows that have it.

    Parameters
    ----------
    name : str
    activation : Activation or callable
        An elementwise function σ of tensors, C² (a torch.nn.Module for instance), whose derivatives are found by
        forward-mode differentiation; or an `Activation`, which has them in closed form.
    compiled : callable, optional
        A function of a number a that returns σ(a) and σ'(a), by operators; one with branches or functions of a module
        is compiled by Numba (the extra `numba`), or is one of Numba. With it flows run compiled, else by arrays.

    Raises
    ------
    ValueError
        If the name is empty or that of a built-in activation, or if a derivative is wrong.
    TypeError
        If `name` is not a string, or `activation` or `compiled` not callable.

    Examples
    --------
    >>> def and_slope(a):
    ...     return a**3, 3 * a**2
    >>> register_activation("cube", lambda a: a**3, and_slope)
    """
    activations.check_name(name)
    activations.added[name] = _checked_activation(name, activation, compiled)


def _checked_activation(name: str, activation: Any, compiled: Any = None) -> Activation:
    """Return an activation whose values and derivatives agree at samples."""
    if not isinstance(activation, Activation):
        if not callable(activation):
            raise TypeError(f"`activation` must be a function of tensors or an Activation; got {activation!r}.")
        activation = FunctionActivation(name, activation, compiled)
    elif compiled is not None:
        activation.compiled = compiled
    a = torch.linspace(-3.1, 3.1, 62, dtype=torch.float64).reshape(2, 31)  # not at 0, where one may have a special case
    da = torch.cos(3 * a)
    x = a.clone().requires_grad_()
    value = activation.value(x)
    if not isinstance(value, Tensor) or value.shape != a.shape or value.dtype != a.dtype or not value.requires_grad:
        raise TypeError(f"`activation` {name!r} must be an elementwise function of tensors that torch differentiates.")
    (slope,) = torch.autograd.grad(value.sum(), x, create_graph=True)
    second = torch.autograd.grad(slope.sum(), x)[0] if slope.requires_grad else torch.zeros_like(a)
    slope = slope.detach()
    expected = {"value": value.detach(), "slope": slope, "dvalue": slope * da, "dslope": second * da}
    for what, found in zip(expected, activation.tangent(a, da), strict=True):
        if not torch.allclose(found, expected[what], rtol=1e-9, atol=1e-9):
            raise ValueError(f"`activation` {name!r} has a tangent() whose {what} is not that of value(): correct it.")
    for found, of in zip(activation.slope(a), ("value", "slope"), strict=True):
        if not torch.allclose(found, expected[of], rtol=1e-9, atol=1e-9):
            raise ValueError(f"`activation` {name!r} has a slope() that is not the derivative of value(): correct it.")
    if activation.compiled is not None:
        if not callable(activation.compiled):
            raise TypeError(f"`compiled` must be a function of a number; got {activation.compiled!r}.")
        function = getattr(activation.compiled, "py_func", activation.compiled)  # Numba's, not compiled for this
        pairs = torch.tensor([tuple(function(number)) for number in a.reshape(-1).tolist()], dtype=torch.float64)
        if not torch.allclose(pairs, torch.stack([expected["value"], slope], -1).reshape(-1, 2), rtol=1e-9, atol=1e-9):
            raise ValueError(f"`compiled` does not return the value and the slope of activation {name!r}: correct it.")
    return activation


activations = Register("activation", ACTIVATION_GROUP, ACTIVATIONS, _checked_activation)


def _short(name: Any) -> str:
    """A name as it is shown in a message, which may be from a file."""
    text = repr(name)
    return text if len(text) < 60 else f"{text[:50]} …"


def by_time(f: Callable[[Tensor], Tensor], like: Tensor) -> tuple[Tensor, Tensor]:
    """f(0) and f'(0) of a function of a time ()."""
    return jvp(f, like.new_zeros(()), like.new_ones(()))


class Potential(nn.Module):
    """V(t, x). Layers need three combinations of it; a new kind of potential provides these.

    Duties
    ------
    1. `value(t, x)`: V(t, x), up to a constant, shape (N,).
    2. `impulse(t, x)`: ∇V(t, x) − ∇V(0, x), shape (d, N).
    3. `to_dict()`: its architecture, JSON-able. For files it has a "type", the name by which the class is registered
       with `register_potential`, and
    4. `from_dict(ndof, plan, dtype)`, a class method, builds it again from that, untrained. The file is not to be
       trusted: it checks the plan before it allocates anything.

    `impulse_and_rate` and `impulse_and_tangent` differentiate the first two by forward mode; a class with a faster way
    overrides them.
    """

    ndof: int

    def value(self, t: Time, x: Tensor) -> Tensor:
        raise NotImplementedError

    def impulse(self, t: Time, x: Tensor) -> Tensor:
        raise NotImplementedError

    def impulse_and_rate(self, t: Time, x: Tensor) -> tuple[Tensor, Tensor]:
        """The impulse, and ∂_tV(t, x), shape (N,)."""
        return self.impulse(t, x), by_time(lambda s: self.value(t + s, x), x)[1]

    def impulse_and_tangent(self, t: Time, x: Tensor, dx: Tensor) -> tuple[Tensor, Tensor]:
        """The impulse, and its derivative along a curve x(t) with velocity dx."""
        return by_time(lambda s: self.impulse(t + s, x + s * dx), x)

    def to_dict(self) -> dict[str, Any]:
        raise NotImplementedError

    @classmethod
    def from_dict(cls, ndof: int, plan: Mapping[str, Any], dtype: torch.dtype) -> Self:
        """Return the untrained potential of an architecture that a file describes."""
        raise NotImplementedError(f"{cls.__name__} must define from_dict(), which reads files.")


class MLPPotential(Potential):
    """V(t, x) = c · N(t/τ, x/s), N a multilayer perceptron of any depth whose input is x with t appended.

    N(t, x) = w · σ(W_n σ(… σ(K x + k t + b_1) …) + b_n). It has no output bias: a constant in V moves nothing.
    Its derivatives come from one forward and one reverse sweep through the layers, ∂_t∇V from carrying a tangent along
    both, and the evaluations at t and at 0 share K x.

    Parameters
    ----------
    ndof : int
        d, the size of x.
    hidden : sequence of int
        Widths of the hidden layers; the published architecture is (10, 10).
    activation : str
        σ, a name in `sympflow.flow.potentials.ACTIVATIONS`.
    scale, center : sequence of d floats, optional
        s, and the mean of x that the initial biases allow for.
    tau, gain : float
        τ and c.
    features : int
        m, of further inputs that a step keeps as they are, the last rows of x (d + m, N), as the time of a drive; the
        gradients by them are left out, as 0.
    generator : torch.Generator, optional
        Source of the initial weights, uniform in ±1/√(fan in).

    Attributes
    ----------
    weight_x : (h_1, d), weight_t : (h_1,), biases : n × (h_l,), weights : (n−1) × (h_{l+1}, h_l), weight_out : (h_n,)
        The parameters K, k, b, W, w.
    scale : (d,), tau : (), gain : ()
        The buffers s, τ, c. `folded()` gives the weights with these multiplied in.

    References
    ----------
    .. [1] P. Canizares, D. Murari, C.-B. Schönlieb, F. Sherry, Z. Shumaylov, Hamiltonian matching for symplectic
       neural integrators, 2024, section 2.1.
    """

    weight_x: nn.Parameter
    weight_t: nn.Parameter
    weight_out: nn.Parameter
    scale: Tensor
    tau: Tensor
    gain: Tensor

    def __init__(
        self,
        ndof: int,
        hidden: Sequence[int] = (10, 10),
        activation: str = "tanh",
        *,
        scale: Sequence[float] | None = None,
        center: Sequence[float] | None = None,
        tau: float = 1.0,
        gain: float = 1.0,
        features: int = 0,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        hidden, dtype, device = hidden_widths(hidden), checked_dtype(dtype), checked_device(device)
        inputs = int(ndof) + features
        check_memory(f"`hidden` {hidden!r}", count_weights(inputs, hidden), "take narrower layers")
        self.ndof, self.features, self.hidden, self.activation = int(ndof), features, hidden, activation
        self._sigma = activation_named(activation)

        uniform = partial(uniform_weights, generator=generator, dtype=dtype, device=device)
        constant = partial(torch.as_tensor, dtype=dtype, device=device)
        self.weight_x = uniform(hidden[0], inputs, fan_in=inputs + 1)
        self.weight_t = uniform(hidden[0], fan_in=inputs + 1)
        fans = (inputs + 1, *hidden[:-1])
        self.biases = nn.ParameterList(uniform(h, fan_in=fan) for h, fan in zip(hidden, fans, strict=True))
        self.weights = nn.ParameterList(uniform(h, fan, fan_in=fan) for fan, h in pairwise(hidden))
        self.weight_out = uniform(hidden[-1], fan_in=hidden[-1])
        units = [*([1.0] * ndof if scale is None else scale), *[1.0] * features]
        for name, unit in (("scale", units), ("tau", tau), ("gain", gain)):
            self.register_buffer(name, constant(unit))
        if center is not None:
            with torch.no_grad():
                self.biases[0] -= self.weight_x @ (constant([*center, *[0.0] * features]) / self.scale)

    def to_dict(self) -> dict[str, Any]:
        plan = {"type": "mlp", "hidden": list(self.hidden), "activation": self.activation}
        return plan | ({"features": self.features} if self.features else {})

    @classmethod
    def from_dict(cls, ndof: int, plan: Mapping[str, Any], dtype: torch.dtype) -> Self:
        return cls(ndof, plan["hidden"], plan.get("activation"), features=plan.get("features", 0), dtype=dtype)  # type: ignore[arg-type]

    @classmethod
    def from_weights(
        cls,
        weights: Sequence[Any],
        biases: Sequence[Any],
        activation: str = "tanh",
        *,
        time: str = "last",
        dtype: torch.dtype | None = None,
    ) -> Self:
        """Return the potential V(t, x) = w · σ(W_n σ(… σ(W_1 [x, t] + b_1) …) + b_n) of given numbers.

        Parameters
        ----------
        weights : sequence of array_like
            W_1 of shape (h_1, d + 1), W_l of shape (h_l, h_{l−1}), and w of shape (h_n,) or (1, h_n): those of
            `torch.nn.Linear`.
        biases : sequence of array_like
            b_l of shape (h_l,). One of the output, of shape () or (1,), may follow: it moves nothing and is left out.
        activation : str
        time : {"last", "first"}
            The place of t in the input of W_1.
        dtype : torch.dtype, optional
            The default is that of the numbers.

        Raises
        ------
        ValueError
            If shapes do not fit, a number is not finite, or there is no such activation.
        TypeError
            If the numbers are not of one of the dtypes float32 and float64.
        """
        W, b = _tensors("weights", weights, dtype), _tensors("biases", biases, dtype)
        if len({x.dtype for x in (*W, *b)}) != 1:
            raise TypeError(
                "`weights` and `biases` must be of one dtype, float32 or float64: pass dtype=torch.float64."
            )
        if time not in ("last", "first"):
            raise ValueError(f"`time` must be 'last' or 'first', the place of t in the input; got {time!r}.")
        n = len(W) - 1
        if n < 1 or len(b) not in (n, n + 1):
            raise ValueError(
                f"`weights` must be those of one or more hidden layers and of the output, and `biases` one for each "
                f"hidden layer, with or without the output's; got {len(W)} and {len(b)}."
            )
        out = W[-1].reshape(-1) if W[-1].ndim == 2 and len(W[-1]) == 1 else W[-1]
        widths = [len(x) if x.ndim else 0 for x in b[:n]]
        ndof = W[0].shape[-1] - 1 if W[0].ndim == 2 else 0
        fits = ndof > 0 and min(widths) > 0 and tuple(out.shape) == (widths[-1],)
        fits = fits and all(tuple(x.shape) == (h,) for x, h in zip(b[:n], widths, strict=True))
        shapes = zip(W[:-1], widths, (ndof + 1, *widths[:-1]), strict=True)
        if not fits or any(tuple(x.shape) != (h, k) for x, h, k in shapes) or any(x.numel() != 1 for x in b[n:]):
            shown = [tuple(x.shape) for x in W], [tuple(x.shape) for x in b]
            raise ValueError(
                "`weights` must have shapes (h_1, d + 1), (h_2, h_1), …, (1, h_n), and `biases` (h_1,), …, (h_n,); got "
                f"{shown[0]} and {shown[1]}: check their order, or transpose them."
            )
        self = cls(ndof, widths, activation, dtype=W[0].dtype, generator=torch.Generator())
        first = W[0].roll(-1, 1) if time == "first" else W[0]
        with torch.no_grad():
            self.weight_x.copy_(first[:, :ndof])
            self.weight_t.copy_(first[:, ndof])
            self.weight_out.copy_(out)
            for mine, given in zip((*self.weights, *self.biases), (*W[1:-1], *b[:n]), strict=True):
                mine.copy_(given)
        return self

    def to_weights(self) -> dict[str, Any]:
        """Return the arguments of `from_weights` for this potential, as arrays: its units are multiplied in."""
        K, k, b, W, w = self.folded()
        matrices = [torch.cat([K, k[:, None]], 1), *W, w[None]]
        return {
            "weights": [x.detach().cpu().numpy().copy() for x in matrices],
            "biases": [x.detach().cpu().numpy().copy() for x in b],
            "activation": self.activation,
            "time": "last",
        }

    def folded(self) -> tuple[Tensor, Tensor, list[Tensor], list[Tensor], Tensor]:
        """The weights (K/s, k/τ, [b_l], [W_l], c·w): V(t, x) = c·w · σ(… σ((K/s) x + (k/τ) t + b_1) …)."""
        K, k, w = self.weight_x / self.scale, self.weight_t / self.tau, self.gain * self.weight_out
        return K, k, list(self.biases), list(self.weights), w

    def network(self, is_kick: bool) -> NetworkLayer:
        """Return the weights of a kick or drift of it for compiled loops; NotCompiled if these cannot be."""
        from sympflow.kernels.networks import NetworkLayer

        if self.features:
            raise arrays_only("`flow` has networks that take the time of the state, and these have no compiled form")
        K, k, b, W, w = self.folded()

        def array(weight: Tensor) -> np.ndarray:
            return weight.detach().cpu().numpy()

        biases, weights = [*map(array, b)], [*map(array, W)]
        first = is_kick, self.activation, array(K), array(k)
        return NetworkLayer(*first, biases, weights, array(w), self._sigma.compiled)

    def trained(self) -> TrainedNetwork | None:
        """Return the network for compiled derivatives by its parameters; None if there are none."""
        from sympflow.kernels.activations import SIGMAS
        from sympflow.kernels.network_tangents import TrainedNetwork

        if self.activation not in SIGMAS or self.weight_x.dtype != torch.float64 or self.weight_x.device.type != "cpu":
            return None
        inner = [*self.biases, *self.weights]
        units = [1 / self.scale.expand_as(self.weight_x), 1 / self.tau.expand_as(self.weight_t)]
        units += [self.gain.expand_as(self.weight_out), *(torch.ones_like(w) for w in inner)]
        flat = torch.cat([u.detach().reshape(-1) for u in units]).numpy()
        return TrainedNetwork(self.ndof + self.features, self.hidden, self.activation, flat)

    # V, and the combinations that the layers use: t and 0 in one sweep --------------------------------------

    def value(self, t: Time, x: Tensor) -> Tensor:
        """V(t, x): (N,)."""
        K, k, b, W, w = self.folded()
        h = self._sigma.value(K @ x + outer(k, t) + b[0][:, None])
        for W_l, b_l in zip(W, b[1:], strict=True):
            h = self._sigma.value(W_l @ h + b_l[:, None])
        return w @ h

    def _by_x(self, gradient: Tensor) -> Tensor:
        """The gradient with 0 in the rows of the features."""
        d = self.ndof
        return torch.cat([gradient[:d], torch.zeros_like(gradient[d:])]) if self.features else gradient

    def impulse(self, t: Time, x: Tensor) -> Tensor:
        return self._swept(t, x)[0]

    def impulse_and_rate(self, t: Time, x: Tensor) -> tuple[Tensor, Tensor]:
        impulse, k, r_t = self._swept(t, x)
        return impulse, k @ r_t

    def _swept(self, t: Time, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The impulse, k/τ, and ∂V/∂a at t (h_1, N)."""
        K, k, b, W, w = self.folded()
        r_t, r_0 = self._sweeps(_both_times(t, K @ x + b[0][:, None], k), b, W, w).chunk(2, 1)
        return self._by_x(K.T @ (r_t - r_0)), k, r_t

    def impulse_and_tangent(self, t: Time, x: Tensor, dx: Tensor) -> tuple[Tensor, Tensor]:
        K, k, b, W, w = self.folded()
        a, da = _both_times(t, K @ x + b[0][:, None], k), K @ dx
        r, dr = self._sweeps_tangent(a, torch.cat([da + k[:, None], da], 1), b, W, w)
        (r_t, r_0), (dr_t, dr_0) = r.chunk(2, 1), dr.chunk(2, 1)
        return self._by_x(K.T @ (r_t - r_0)), self._by_x(K.T @ (dr_t - dr_0))

    def _sweeps(self, a: Tensor, b: list[Tensor], W: list[Tensor], w: Tensor) -> Tensor:
        """∂V/∂a (h_1, N), by a sweep forward through the layers and one back."""
        h, slope = self._sigma.slope(a)
        slopes = [slope]
        for W_l, b_l in zip(W, b[1:], strict=True):
            h, slope = self._sigma.slope(torch.addmm(b_l[:, None], W_l, h))
            slopes.append(slope)
        r = slopes[-1] if W else w[:, None] * slopes[-1]
        for W_l, slope in zip(_backward_weights(W, w), reversed(slopes[:-1]), strict=True):
            r = slope * (W_l.T @ r)
        return r

    def _sweeps_tangent(
        self, a: Tensor, da: Tensor, b: list[Tensor], W: list[Tensor], w: Tensor
    ) -> tuple[Tensor, Tensor]:
        """∂V/∂a and its derivative along da, both (h_1, N): the same two sweeps with a tangent beside."""
        h, slope, dh, dslope = self._sigma.tangent(a, da)
        slopes = [(slope, dslope)]
        for W_l, b_l in zip(W, b[1:], strict=True):
            h, slope, dh, dslope = self._sigma.tangent(torch.addmm(b_l[:, None], W_l, h), W_l @ dh)
            slopes.append((slope, dslope))
        r, dr = slopes[-1] if W else (w[:, None] * slope, w[:, None] * dslope)
        for W_l, (slope, dslope) in zip(_backward_weights(W, w), reversed(slopes[:-1]), strict=True):
            r, dr = W_l.T @ r, W_l.T @ dr
            r, dr = slope * r, torch.addcmul(dslope * r, slope, dr)
        return r, dr


def _both_times(t: Time, a: Tensor, k: Tensor) -> Tensor:
    """Pre-activations at t beside those at 0: (h_1, 2N)."""
    return torch.cat([a + outer(k, t), a], 1)


def _backward_weights(W: list[Tensor], w: Tensor) -> list[Tensor]:
    """The weights as the reverse sweep meets them, w multiplied into the first: cheaper than into the features."""
    return [w[:, None] * W[-1], *reversed(W[:-1])] if W else []


def uniform_weights(
    *shape: int, fan_in: int, generator: torch.Generator | None, dtype: Any, device: Any
) -> nn.Parameter:
    """Weights uniform in ±1/√(fan in), drawn in float64 on the CPU: a seed means the same flow everywhere."""
    w = (2 * torch.rand(*shape, dtype=torch.float64, generator=generator) - 1) / fan_in**0.5
    return nn.Parameter(w.to(dtype=dtype, device=device))


def outer(k: Tensor, t: Time) -> Tensor:
    """k t: (h, 1) for one time, (h, N) for a time for each point."""
    return k[:, None] * t


def count_weights(inputs: int, hidden: Sequence[int]) -> int:
    """The number of weights of a network of these widths with one output, with those of the time."""
    fans = (inputs + 1, *hidden[:-1])
    return sum(h * fan + h for h, fan in zip(hidden, fans, strict=True)) + hidden[-1]


def hidden_widths(hidden: Sequence[int]) -> tuple[int, ...]:
    """Return `hidden`, checked."""
    widths = tuple(map(plain, hidden)) if isinstance(hidden, Sequence) else ()
    if not widths or any(isinstance(h, bool) or not isinstance(h, int) or h < 1 for h in widths):
        raise ValueError(f"`hidden` must be the widths of one or more hidden layers, such as (10, 10); got {hidden!r}.")
    return widths


# numbers and modules of others ------------------------------------------------------------------------


def module_weights(module: nn.Module) -> dict[str, Any]:
    """Return the arguments of `MLPPotential.from_weights` for a `torch.nn.Sequential` of the input [x, t].

    Its activations are recognised by their values. A TypeError says that it is not a Sequential of Linear layers and
    activations in turn, the output linear, a ValueError that an activation is unknown, or that they differ.
    """
    layers = list(module) if isinstance(module, nn.Sequential) else []
    linear, between = layers[::2], layers[1::2]
    if len(linear) != len(between) + 1 or len(linear) < 2 or not all(isinstance(each, nn.Linear) for each in linear):
        raise TypeError(
            "`potentials` must be torch.nn.Sequential of Linear, activation, …, Linear; got "
            f"{_short(module)}: give weights and biases instead."
        )
    names = {_activation_of(each) for each in between}
    if len(names) != 1:
        raise ValueError(f"`potentials` must have one activation in a network; got {', '.join(sorted(names))}.")
    return {
        "weights": [each.weight for each in linear],
        "biases": [each.bias if each.bias is not None else each.weight.new_zeros(len(each.weight)) for each in linear],
        "activation": names.pop(),
    }


def _activation_of(module: nn.Module) -> str:
    """Return the name of the known activation that has the values of a module."""
    a = torch.linspace(-4.0, 4.0, 41, dtype=torch.float64)
    known = activations.known
    with torch.no_grad():
        for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 1e-6)):
            try:
                values = module(a.to(dtype))
            except (RuntimeError, TypeError, ValueError):  # not of this dtype, or not elementwise
                continue
            for name, sigma in known.items():
                if values.shape == a.shape and bool((values.to(a) - sigma.value(a)).abs().max() < 5 * tolerance):
                    return name
    raise ValueError(
        f"`potentials` have an activation {_short(module)} that is not one of {', '.join(known)}: register it by "
        "sympflow.flow.potentials.register_activation(name, activation)."
    )


def _tensors(name: str, arrays: Any, dtype: torch.dtype | None) -> list[Tensor]:
    if isinstance(arrays, str) or not isinstance(arrays, Sequence):
        raise TypeError(f"`{name}` must be a list of arrays, one for each layer; got {type(arrays).__name__}.")
    found = []
    for array in arrays:
        try:
            x = torch.as_tensor(array.detach() if isinstance(array, Tensor) else np.asarray(array), device="cpu")
        except (TypeError, ValueError) as error:
            raise TypeError(f"`{name}` must be arrays of numbers; got one that is not ({error}).") from None
        x = x.to(torch.float64) if not x.is_floating_point() and not x.is_complex() else x
        if x.dtype not in (torch.float32, torch.float64):
            raise TypeError(f"`{name}` must be of float32 or float64; got {x.dtype}: convert them first.")
        if not torch.isfinite(x).all():
            raise ValueError(f"`{name}` must be finite; they hold NaN or infinity. Check where they are from.")
        found.append(x if dtype is None else x.to(checked_dtype(dtype)))
    return found


# potentials by name -------------------------------------------------------------------------------------


def _checked_potential(name: str, potential: Any) -> type[Potential]:
    """Return a class of potentials that files can name."""
    if not (isinstance(potential, type) and issubclass(potential, Potential)):
        raise TypeError(f"`potential` must be a subclass of Potential; got {potential!r}.")
    if potential.from_dict.__func__ is Potential.from_dict.__func__:  # type: ignore[attr-defined]
        raise TypeError(f"`potential` {potential.__name__} has no from_dict(), which reads files: define it.")
    return potential


potentials: Register[type[Potential]] = Register(
    "potential", POTENTIAL_GROUP, {"mlp": MLPPotential}, _checked_potential
)


def potential_named(name: str) -> type[Potential]:
    """Return the class of potentials of that name; a ValueError says that there is none."""
    return potentials.named(name)


def register_potential(name: str, potential: type[Potential]) -> None:
    """Make a class of potentials known by name in this process, so that files of flows with them can be read.

    Parameters
    ----------
    name : str
        The "type" in its `to_dict()`.
    potential : subclass of Potential
        With `from_dict`.

    Raises
    ------
    ValueError
        If the name is empty or "mlp".
    TypeError
        If `name` is not a string, or `potential` no class of potentials with `from_dict`.
    """
    potentials.check_name(name)
    potentials.added[name] = _checked_potential(name, potential)
