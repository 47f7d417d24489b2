"""torchdiffeq's `odeint` and its siblings with our methods: identical signatures, change the import or nothing.

`method="sympflow"` and all our fixed-step methods are run here; everything else is handed on to torchdiffeq. Their
options go into `options`: `flow`, `dt` (or `step_size`), and `system` where `func` is not a HamiltonianSystem.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable
from importlib import import_module
from typing import Any

import numpy as np
import torch
import torchdiffeq
from torch import Tensor

from sympflow.arguments import check_not_traced, did_you_mean, warn
from sympflow.arrays import differentiable, finite_states, one_lane, readable, transformed, unfollowed
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep, Integrator
from sympflow.integrators.registry import available, check_applies
from sympflow.integrators.tableaux import ADAPTIVE, FIXED
from sympflow.interop.matching import Comparison, fixed_step
from sympflow.interop.path import AdjointPath, BeforeStep, DensePath, Path, numbers
from sympflow.interop.systems import leaves

State = Tensor | tuple[Tensor, ...]
_THEIRS = {*ADAPTIVE, *FIXED, "explicit_adams", "implicit_adams", "fixed_adams", "scipy_solver"}
_RTOL, _ATOL = 1e-7, 1e-9
_CALLBACKS = (  # callbacks of torchdiffeq for adaptive steps and its adjoint equation, which our methods have not
    *("callback_accept_step", "callback_reject_step", "callback_step_adjoint"),
    *("callback_accept_step_adjoint", "callback_reject_step_adjoint"),
)
_LATE = 1000.0  # time after the start in which an event is expected
_CHECKPOINTS = 5  # outputs of a run at which another right-hand side is compared
_REMEDY = "Pass one system: odeint(system, ...), without options['system'] and without another function."


def odeint(
    func: Callable[[Tensor, Any], Any],
    y0: State,
    t: Tensor,
    *,
    rtol: float = _RTOL,
    atol: float = _ATOL,
    method: Any = None,
    options: dict[str, Any] | None = None,
    event_fn: Callable[[Tensor, Any], Tensor] | None = None,
) -> Any:
    """`torchdiffeq.odeint` with our methods as well.

    Parameters
    ----------
    func : callable
        func(t, y). With our classical methods it must be a HamiltonianSystem, or `options["system"]` one. If it is not
        that system, it is called at several states and times, to refuse it where it differs.
    y0 : tensor of shape (..., 2d), or tuple (q, p) of tensors of shape (..., d)
    t : tensor of shape (n,)
        Increasing or decreasing; t[0] is the time of y0, and the grid t[0] + k·dt is anchored there.
    rtol, atol
        For torchdiffeq's methods.
    method : str, trained flow or Integrator, optional
        One of `sympflow.available()` that has fixed steps, or any of torchdiffeq's; "dopri5" by default.
    options : dict, optional
        Of the method: `dt` (or torchdiffeq's name `step_size`), `flow`, `system`, …
    event_fn : callable, optional
        event_fn(t, y). The solution ends where its smallest entry, signed to be positive at the start, vanishes.

    Returns
    -------
    y : tensor (n, ..., 2d), or tuple of tensors (n, ..., d)
        With `event_fn`: (event time, [y0, state at the event]). Gradients reach y0, t and the weights of the flow, the
        event time by the implicit function theorem; they are those of the map that was executed.

    Raises
    ------
    ValueError
        If `func` is another system than that of our method, or depends on the time: this is tested at several states
        and times, at the start and along the run.
    """
    if not _is_ours(method, func, options):
        asked = {"rtol": rtol, "atol": atol, "method": method, "options": options, "event_fn": event_fn}
        return _theirs(torchdiffeq.odeint, func, y0, t, over=t, endless=event_fn is not None, **asked)
    return _integrated(Path, func, y0, t, rtol, atol, method, options, event_fn)


def _integrated(
    make_path: Callable[..., Path],
    func: Any,
    y0: State,
    t: Tensor,
    rtol: Any,
    atol: Any,
    method: Any,
    options: dict[str, Any] | None,
    event_fn: Any,
) -> Any:
    """`odeint` by one of our methods, along a path."""
    if (rtol, atol) != (_RTOL, _ATOL):
        warn(f"`rtol` and `atol` have no effect on the fixed-step method {_name(method)!r}: leave them out.")
    direction = _direction(t)
    integrator, system = _build(func, method, options)
    y, pack = _joined(y0)
    _check_state(y, system, integrator)
    compared = _Compared(func, y0, t, integrator, system)
    if event_fn is None:
        announced = _announced(func, y, t, pack, integrator)
        return pack(compared.run(make_path(integrator, system, y, direction, t[0], before_step=announced), t))
    if len(t) != 2:
        raise ValueError(f"`t` must have 2 entries with `event_fn`, the start and a direction; got {len(t)}.")
    found, states = _until_event(make_path(integrator, system, y, direction, t[0]), t[0], event_fn, pack)
    compared.along(found[None], states[1:])
    return found, pack(states)


def odeint_dense(
    func: Callable[[Tensor, Any], Any],
    y0: Tensor,
    t0: Any,
    t1: Any,
    *,
    rtol: float = _RTOL,
    atol: float = _ATOL,
    method: Any = None,
    options: dict[str, Any] | None = None,
) -> Callable[[Tensor], Tensor]:
    """`torchdiffeq.odeint_dense` with our methods as well: the solution as a function of t.

    Parameters
    ----------
    func, y0, rtol, atol, method, options
        As for `odeint`; torchdiffeq itself has "dopri5" only.
    t0, t1 : float tensor () or number
        Start and end.

    Returns
    -------
    callable
        Of a time () or times (n,) between t0 and t1 to states (..., 2d) or (n, ..., 2d): a shorter step from the last
        grid point before t. The states on the grid are computed once. Gradients reach y0, t and weights.

    Raises
    ------
    ValueError
        From the result, for a t that is not between t0 and t1.
    """
    if not _is_ours(method, func, options):
        if method not in (None, "dopri5"):
            raise ValueError(f"`method` {method!r} has no dense output in torchdiffeq: use 'dopri5', or ours.")
        asked = {"rtol": rtol, "atol": atol, "method": method, "options": options}
        return _theirs(torchdiffeq.odeint_dense, func, y0, t0, t1, over=torch.tensor([float(t0), float(t1)]), **asked)
    if not isinstance(y0, Tensor):
        raise TypeError(f"`y0` must be a tensor [q, p], as in torchdiffeq's odeint_dense; got {type(y0).__name__}.")
    times = torch.stack(
        [t if isinstance(t, Tensor) else torch.tensor(t, dtype=y0.dtype, device=y0.device) for t in (t0, t1)]
    )
    _integrated(Path, func, y0, times[:1], rtol, atol, method, options, None)  # checks all arguments
    integrator, system = _build(func, method, options)
    path = DensePath(integrator, system, y0, _direction(times), times)
    compared = _Compared(func, y0, times, integrator, system)
    if compared.func is not None:
        compared.run(path, times)

    def solution(t: Tensor) -> Tensor:
        if not (isinstance(t, Tensor) and t.ndim < 2 and t.is_floating_point()):
            raise TypeError("`t` must be a floating-point tensor, a time or a list of times: use torch.tensor(1.0).")
        states = path(t.reshape(-1) - times[0])
        return states if t.ndim else states[0]

    return solution


def odeint_event(
    func: Callable[[Tensor, Any], Any],
    y0: State,
    t0: Tensor,
    *,
    event_fn: Callable[[Tensor, Any], Tensor],
    reverse_time: bool = False,
    odeint_interface: Callable[..., Any] = odeint,
    **kwargs: Any,
) -> Any:
    """`torchdiffeq.odeint_event` with our methods as well: the event time, and [y0, state at the event].

    Arguments as there; with our methods `odeint_interface` is `odeint` or `odeint_adjoint`, theirs or ours, which are
    the same then. Gradients reach y0, t0 and all weights, those of the time by the implicit function theorem.
    """
    if not _is_ours(kwargs.get("method"), func, kwargs.get("options")):
        theirs = torchdiffeq.odeint if odeint_interface is odeint else odeint_interface
        begin = float(one_lane(t0).reshape(-1)[0])
        interval = torch.tensor([begin, begin + (-1.0 if reverse_time else 1.0)], dtype=torch.float64)
        kwargs |= {"event_fn": event_fn, "reverse_time": reverse_time, "odeint_interface": theirs}
        return _theirs(torchdiffeq.odeint_event, func, y0, t0, over=interval, endless=True, **kwargs)
    adjoint = odeint_interface in (odeint_adjoint, torchdiffeq.odeint_adjoint)
    if not (adjoint or odeint_interface in (odeint, torchdiffeq.odeint)):
        raise ValueError("`odeint_interface` must be odeint or odeint_adjoint, of torchdiffeq or of this module.")
    if not (isinstance(t0, Tensor) and t0.numel() == 1 and t0.is_floating_point()):
        raise TypeError("`t0` must be a floating-point tensor with one time: use torch.tensor(0.0).")
    start = t0.reshape(-1)
    t = torch.cat([start, start.detach() + (-1.0 if reverse_time else 1.0)])
    return (odeint_adjoint if adjoint else odeint)(func, y0, t, event_fn=event_fn, **kwargs)


def odeint_adjoint(
    func: Callable[[Tensor, Any], Any],
    y0: State,
    t: Tensor,
    *,
    rtol: float = _RTOL,
    atol: float = _ATOL,
    method: Any = None,
    options: dict[str, Any] | None = None,
    event_fn: Callable[[Tensor, Any], Tensor] | None = None,
    adjoint_rtol: Any = None,
    adjoint_atol: Any = None,
    adjoint_method: Any = None,
    adjoint_options: dict[str, Any] | None = None,
    adjoint_params: Iterable[Tensor] | None = None,
) -> Any:
    """`torchdiffeq.odeint_adjoint` with our methods as well: gradients in memory that does not grow with the steps.

    With our methods these are the gradients of the map that was executed, those of `odeint`: the run is stepped back
    by the map's own inverse, and the cotangent is pulled back a step at a time. Only the states at `t` are kept.
    Rounding of the inverse is magnified by an unstable orbit, from one output to the one before. A map without an
    inverse, such as "mlp", is run again from the outputs, with √n states kept of n steps between two of them.

    Parameters
    ----------
    func, y0, t, rtol, atol, method, options, event_fn
        As for `odeint`.
    adjoint_params : iterable of tensors, optional
        Tensors within H that get gradients; the weights of a flow always do. The default with our methods is the
        parameters of `func`, if it is a module, and all leaves on which the vector field at y0 depends.
    adjoint_rtol, adjoint_atol, adjoint_method, adjoint_options
        For torchdiffeq's methods. With ours no second equation is solved; `adjoint_method` must be `method`.

    Raises
    ------
    TypeError
        With our methods, where torch follows y0, t, a parameter or a number of H in forward mode or in a transform of
        `torch.func`: this is for reverse mode, `backward` and `torch.autograd.grad`.
    """
    if not _is_ours(method, func, options):
        asked: dict[str, Any] = {"rtol": rtol, "atol": atol, "method": method, "options": options, "event_fn": event_fn}
        asked |= {"adjoint_rtol": adjoint_rtol, "adjoint_atol": adjoint_atol, "adjoint_method": adjoint_method}
        asked |= {"adjoint_options": adjoint_options, "adjoint_params": adjoint_params}
        return _theirs(torchdiffeq.odeint_adjoint, func, y0, t, over=t, endless=event_fn is not None, **asked)
    if adjoint_method is not None and _name(adjoint_method) != _name(method):
        raise ValueError(
            f"`adjoint_method` is {_name(adjoint_method)!r}, but the gradients of {_name(method)!r} are those of its "
            "own steps: leave it out."
        )
    if not (adjoint_rtol is None and adjoint_atol is None and adjoint_options is None):
        warn(
            f"`adjoint_rtol`, `adjoint_atol` and `adjoint_options` have no effect on the fixed-step method "
            f"{_name(method)!r}, whose gradients are exact: leave them out.",
        )
    given = None if adjoint_params is None else tuple(adjoint_params)
    if given is None and isinstance(func, torch.nn.Module):
        given = tuple(func.parameters())

    def make_path(integrator: FixedStep, system: HamiltonianSystem | None, y: Tensor, *more: Any, **named: Any) -> Path:
        start = float(one_lane(t)[0])
        learns = system is not None and system.learns(y)
        field = [system.vector_field(unfollowed(y), start)] if system is not None and learns else []
        parameters = (*(given or ()), *(leaf for slope in field if adjoint_params is None for leaf in leaves(slope)))
        flow = integrator.flow_for(system)  # type: ignore[arg-type]
        if transformed(y, t, *field, *parameters, *(() if flow is None else flow.parameters())):
            raise TypeError(
                "`odeint_adjoint` is for reverse mode, backward() and torch.autograd.grad: in forward mode, and inside "
                "torch.func, use odeint."
            )
        return AdjointPath(integrator, system, y, *more, parameters=parameters, **named)

    return _integrated(make_path, func, y0, t, rtol, atol, method, options, event_fn)


def register(method: str) -> None:
    """Add one of our methods to torchdiffeq's own table, for code whose calls of `odeint` cannot be changed.

    That table is private to torchdiffeq, so this is never done unasked, and may break with a release of it. A name that
    it has already, such as its own "implicit_midpoint" of some release, is left alone, with a warning.

    Raises
    ------
    ValueError, TypeError
        If there is no such method, it is torchdiffeq's own, or it has no fixed steps.
    """
    if not isinstance(method, str):
        raise TypeError(f"`method` must be the name of a method, such as 'verlet'; got {type(method).__name__}.")
    if method in _THEIRS:
        raise ValueError(f"`method` {method!r} is torchdiffeq's own already: register one of ours, such as 'verlet'.")
    fixed_step(method, {}, "torchdiffeq")
    table = _their_table()
    if method in table and not issubclass(table[method], _Solver):
        warn(
            f"`method` {method!r} is torchdiffeq's own in this release, and stays so in its table: for ours call "
            "sympflow.interop.torchdiffeq.odeint.",
        )
        return
    table[method] = type(f"{method.title()}Solver", (_Solver,), {"method": method})


def _theirs(run: Any, func: Any, y0: Any, *where: Any, over: Any, endless: bool = False, **asked: Any) -> Any:
    """A run by torchdiffeq's own method over some times; a name that neither has is answered with ours as well."""
    asked["options"] = _landing(func, over, asked.get("method"), asked.get("options"), endless)
    try:
        return run(_of_pairs(func, y0), y0, *where, **asked)
    except ValueError as error:
        if not str(error).startswith("Invalid method"):
            raise
        name = str(error).split('"')[1]
        known = sorted({*available(), *_THEIRS})
        hint = did_you_mean(name.lower(), known)
        raise ValueError(f"`method` {name!r} is unknown.{hint} Choose one of {', '.join(known)}.") from None


def _their_table() -> dict[str, Any]:
    """torchdiffeq's solvers by name, which is private to it."""
    return import_module("torchdiffeq._impl.odeint").SOLVERS


def _is_ours(method: Any, func: Any, options: Any) -> bool:
    """True if `method` is one of ours; a name that both have is theirs for a `func` of which we know no system."""
    if method is not None and method not in _THEIRS:
        check_not_traced("odeint")
    if not isinstance(method, str):
        return method is not None
    if method in _THEIRS or method not in available():
        return False
    ours = isinstance(func, HamiltonianSystem) or (isinstance(options, dict) and {"system", "flow"} & set(options))
    found = _their_table().get(method)
    return bool(ours) or found is None or issubclass(found, _Solver)


def _landing(
    func: Any, t: Any, method: Any, options: dict[str, Any] | None, endless: bool = False
) -> dict[str, Any] | None:
    """Options with which a method of torchdiffeq ends steps where a HamiltonianSystem jumps in t."""
    known, name = dict(options or {}), method or "dopri5"
    if not isinstance(func, HamiltonianSystem) or not isinstance(t, Tensor) or not t.numel():
        return options
    if {"jump_t", "grid_constructor"} & known.keys():
        return options
    first, last = numbers(t).flat[0], numbers(t).flat[-1]
    if endless:
        last = first + math.copysign(max(_LATE, abs(func.t_span[1] - func.t_span[0])), last - first)
    low, high, step = min(first, last), max(first, last), func.dt / 4
    kinks = name in FIXED and FIXED[name].order > 2 and not endless  # adaptive steps shorten there by themselves
    found = func.jump_times(low, high, step, kinks)
    if name in ADAPTIVE and not endless and func.definition.may_jump and "step_t" not in known:
        known["step_t"] = torch.as_tensor([last], dtype=torch.float64)  # a longer step may meet a jump beyond
    if not len(found):
        return known or options
    if name in ADAPTIVE:
        known["jump_t"] = torch.as_tensor(found, dtype=torch.float64)
        if func.shortest_piece < math.inf:
            known.setdefault("max_step", func.shortest_piece)
    elif name in FIXED and not endless:
        length = known.pop("step_size", None)
        known |= {"grid_constructor": lambda _, y0, s: _with_jumps(s, length, found), "perturb": True}
    if known == (options or {}) or len(func.jump_times(found.max(), high, step, kinks)):
        more = " after that too" if "jump_t" in known else ""
        warn(
            f"`func` {func.name!r} jumps in t, at t = {found.max() if more else found.min():.6g}{more}, where "
            f"{name!r} of torchdiffeq ends no step: it is of first order there, or jumps over a pulse. Take a "
            "Runge–Kutta method over fewer jumps, or one of ours by sympflow.solve.",
            RuntimeWarning,
        )
    return known


def _with_jumps(t: Tensor, length: float | None, jumps: np.ndarray) -> Tensor:
    """The grid of a fixed-step method of torchdiffeq with outputs t (n,), and the times of jumps in it."""
    grid = t
    if length is not None:
        n_steps = math.ceil(float(abs(t[-1] - t[0])) / length)
        grid = torch.cat([t[0] + torch.arange(n_steps).to(t) * torch.sign(t[-1] - t[0]) * length, t[-1:]])
    at = torch.as_tensor(jumps).to(t)
    near = 1e-9 * (grid[1:] - grid[:-1]).abs().min()
    apart = ((grid[1:-1, None] - at).abs() > near).all(-1)
    return torch.cat([grid[:1], torch.cat([grid[1:-1][apart], at]).sort(descending=bool(t[-1] < t[0]))[0], grid[-1:]])


def _name(method: Any) -> str:
    return method if isinstance(method, str) else getattr(method, "name", type(method).__name__)


def _build(func: Any, method: Any, options: dict[str, Any] | None) -> tuple[FixedStep, HamiltonianSystem | None]:
    """The integrator and the system that a call means."""
    if not (options is None or isinstance(options, dict)):
        raise TypeError(f"`options` must be a dict, such as {{'dt': 0.1}}; got {type(options).__name__}.")
    options = dict(options or {})
    options.pop("norm", None)  # torchdiffeq adds its own
    system = options.pop("system", func if isinstance(func, HamiltonianSystem) else None)
    if not (system is None or isinstance(system, HamiltonianSystem)):
        raise TypeError(f"`options` has a 'system' that is not a HamiltonianSystem: {type(system).__name__}. Pass one.")
    if "step_size" in options and "dt" in options:
        raise TypeError("`options` has both 'step_size' and 'dt', two names of the step length: give one of them.")
    if "step_size" in options:
        options["dt"] = float(options.pop("step_size"))
    integrator = fixed_step(method, options, "torchdiffeq")
    if system is None and integrator.given_flow is not None:
        system = integrator.given_flow.system
    if system is None and not (integrator.trained and integrator.flow is not None):  # type: ignore[attr-defined]
        raise TypeError(
            f"`func` must be a HamiltonianSystem for method {integrator.name!r}; got {type(func).__name__}. Pass one, "
            "or options={'system': system}; sympflow.interop.systems converts a module."
        )
    if system is not None:
        check_applies(integrator, system)
    return integrator, system


def _direction(t: Any) -> int:
    """The direction of the times, 1 or −1, which are checked; under `torch.func.vmap` all lanes must have the same."""
    if not (isinstance(t, Tensor) and t.ndim == 1 and len(t) and t.is_floating_point()):
        raise TypeError("`t` must be a one-dimensional floating-point tensor of times: use torch.tensor([...]).")
    found = numbers(t)
    steps = np.diff(found)
    if not np.isfinite(found).all() or not ((steps > 0).all() or (steps < 0).all()):
        raise ValueError("`t` must be finite and strictly increasing or decreasing: sort it and drop repeats.")
    return -1 if steps.size and steps.flat[0] < 0 else 1


def _announced(
    func: Any, y0: Tensor, t: Tensor, pack: Callable[[Tensor], Any], integrator: FixedStep
) -> BeforeStep | None:
    """torchdiffeq's `callback_step`, if `func` has it: called before each step with its time, state and length."""
    others = {name for name in _CALLBACKS if getattr(func, name, None) is not None}
    if others:
        warn(
            f"Method {integrator.name!r} does not support the callbacks {sorted(others)}: only callback_step.",
        )
    callback = getattr(func, "callback_step", None)
    if callback is None:
        return None
    if not (readable(y0) and readable(t)):
        raise TypeError(
            "`callback_step` is called with one state and time, which do not exist inside torch.func.vmap: remove it."
        )
    start = t[0].detach()

    def before_step(s: float, y: Tensor, h: float) -> None:
        callback(start + s, pack(y), torch.tensor(abs(h), dtype=start.dtype, device=start.device))

    return before_step


def _joined(y0: Any) -> tuple[Tensor, Callable[[Tensor], Any]]:
    """The state [q, p] as one tensor, and how to give states back in the form of `y0`."""
    if isinstance(y0, Tensor):
        return y0, lambda y: y
    if not (isinstance(y0, tuple) and len(y0) == 2 and all(isinstance(part, Tensor) for part in y0)):
        raise TypeError(f"`y0` must be a tensor [q, p] or a tuple (q, p) of tensors; got {type(y0).__name__}.")
    if y0[0].shape != y0[1].shape or y0[0].ndim == 0:
        raise ValueError(f"`y0` (q, p) must have equal shapes (..., d); got {[tuple(part.shape) for part in y0]}.")
    return torch.cat(y0, dim=-1), lambda y: tuple(y.chunk(2, dim=-1))


def _check_state(y: Tensor, system: HamiltonianSystem | None, integrator: Integrator) -> None:
    size = 2 * (system.ndof if system is not None else integrator.flow.ndof)  # type: ignore[attr-defined]
    if not y.is_floating_point():
        raise TypeError(f"`y0` must be real floating-point; got {y.dtype}. Use y0.double().")
    if y.ndim == 0 or y.shape[-1] != size:
        raise ValueError(f"`y0` must have shape (..., {size}), [q, p]; got {tuple(y.shape)}.")
    if not finite_states(y).all():
        raise ValueError("`y0` must be finite; it holds NaN or infinity. Remove these states.")


class _Compared:
    """Compares `func`, where it is not the system itself, with what the method solves: see `matching.Comparison`."""

    def __init__(
        self, func: Any, y0: State, t: Tensor, integrator: FixedStep, system: HamiltonianSystem | None
    ) -> None:
        flow = integrator.given_flow
        self.comparison = comparison = Comparison("func", integrator, system, _REMEDY, func)
        y, self.pack = _joined(y0)
        start = one_lane(y).reshape(-1, y.shape[-1])[0]
        training = flow is not None and any(w.requires_grad or differentiable(w) for w in flow.parameters())
        if flow is not None and not training:
            comparison.with_flow(start.astype(float), float(one_lane(t)[0]))
        self.func: Any = None if func is system else _of_pairs(func, y0)
        if self.func is None:
            return
        self.like, self.times, self.t0 = y, t, float(one_lane(t)[0])
        span = self.t0, float(one_lane(t)[-1])
        comparison.at_start(self._slope, one_lane(y), span, readable(y) and readable(t))

    def _slope(self, t: float, y: np.ndarray) -> np.ndarray:
        """`func` at states like y0, in their precision and form."""
        with torch.no_grad():
            state = torch.tensor(y, dtype=self.like.dtype, device=self.like.device)
            return one_lane(_joined(self.func(self.times.new_tensor(t), self.pack(state)))[0])

    def run(self, path: Path, t: Tensor) -> Tensor:
        """The states (n, ..., 2d) at the times t (n,), compared at some of them, and between where these are few."""
        elapsed = t[1:] - t[0]
        if not len(elapsed):
            return path.y0[None]
        if self.func is None:
            return torch.cat([path.y0[None], path(elapsed)])
        if self.comparison.known:
            states = path(elapsed)
            self.along(t[-1:], states[-1:])
            return torch.cat([path.y0[None], states])
        n_steps = int(float(one_lane(elapsed)[-1]) / path.h) if readable(t) else 0
        n_more = min(_CHECKPOINTS - 1, n_steps) if len(elapsed) < _CHECKPOINTS else 0
        count = np.unique(n_steps * (np.arange(n_more) + 0.38) / max(n_more, 1) // 1)
        more = elapsed.new_tensor(count * path.h)
        states = path(torch.cat([more, elapsed]))
        self.along(t[0] + more, states[: len(more)])
        outputs = states[len(more) :]
        some = np.unique(np.linspace(0, len(elapsed) - 1, _CHECKPOINTS).astype(int)).tolist()
        self.along(t[1:][some], outputs[some])
        self.comparison.remember()
        return torch.cat([path.y0[None], outputs])

    def along(self, t: Tensor, states: Tensor) -> None:
        """Compare at states (n, ..., 2d) of the run, at the times t (n,)."""
        if self.func is None:
            return
        for s, y in zip(one_lane(t).tolist(), one_lane(states), strict=True):
            if np.isfinite(y).all():
                self.comparison.at(s, y, self._slope(s, y), self._slope, self.t0)


def _until_event(path: Path, t0: Tensor, event_fn: Any, pack: Callable[[Tensor], Any]) -> tuple[Tensor, Tensor]:
    with torch.no_grad():
        signs = torch.sign(event_fn(t0, pack(path.y0)))

    def g(s: Tensor, y: Tensor) -> Tensor:
        return torch.min(event_fn((t0 + s).to(t0.dtype), pack(y)) * signs)

    s, y = path.first_zero(g)
    return (t0 + s).to(t0.dtype), torch.stack([path.y0, y])


def _of_pairs(func: Any, y0: Any) -> Any:
    """A HamiltonianSystem as a function of (q, p), where `y0` is such a tuple; anything else as it is."""
    if not (isinstance(func, HamiltonianSystem) and isinstance(y0, tuple)):
        return func
    _joined(y0)

    def of_pair(t: Any, y: Any) -> Any:
        return tuple(func(t, torch.cat(y, dim=-1)).chunk(2, dim=-1))

    for name in ("callback_step", *_CALLBACKS):
        if getattr(func, name, None) is not None:
            setattr(of_pair, name, getattr(func, name))
    return of_pair


# our methods in torchdiffeq's own, private table: only by `register` ----------------------------------------


def _within_adjoint() -> bool:
    """True if torchdiffeq's `odeint_adjoint` is among the callers: it hands its solvers no other sign of itself."""
    frame = sys._getframe()
    while frame is not None:
        if frame.f_globals.get("__name__") == "torchdiffeq._impl.adjoint":
            return True
        frame = frame.f_back  # type: ignore[assignment]
    return False


class _Solver:
    """A solver as torchdiffeq asks for it: times come increasing, states flat; `func` knows what they were."""

    method: str

    def __init__(self, func: Any, y0: Tensor, rtol: Any, atol: Any, **options: Any) -> None:
        if _within_adjoint():
            raise ValueError(
                f"`method` {self.method!r} cannot be used with torchdiffeq's own odeint_adjoint, which integrates the "
                "derivative of `func` backward: that is not the derivative of the map that was run, and gives a "
                "flow's weights no gradient. Use odeint_adjoint of sympflow.interop.torchdiffeq, whose gradients are "
                "those of the "
                "map."
            )
        self.direction, shapes, announced = 1, None, func
        while type(func).__module__.startswith("torchdiffeq"):
            self.direction = -1 if type(func).__name__ == "_ReverseFunc" else self.direction
            shapes = getattr(func, "shapes", shapes)
            func = func.base_func
        integrator, system = _build(func, self.method, options)
        self.y0, self.shapes, self.func = y0, shapes, func
        self.integrator, self.system = integrator, system
        y, _ = _joined(self._given(y0))
        _check_state(y, system, integrator)
        self.joined = y
        self.announced = None if getattr(func, "callback_step", None) is None else announced

    @classmethod
    def valid_callbacks(cls) -> set[str]:
        return {"callback_step"}

    def integrate(self, t: Tensor) -> Tensor:
        path = self._path(t[0])
        if self.announced is not None:
            start, callback = t[0].detach(), self.announced.callback_step

            def before_step(s: float, y: Tensor, h: float) -> None:
                callback(start + abs(s), self._flat(y[None])[0], torch.tensor(abs(h)).to(start))

            path.before_step = before_step
        return self._flat(self._compared(t).run(path, self.direction * t))

    def integrate_until_event(self, t0: Tensor, event_fn: Callable[[Tensor, Tensor], Tensor]) -> tuple[Tensor, Tensor]:
        def g(s: Tensor, y: Tensor) -> Tensor:
            return event_fn((t0 + self.direction * s).to(t0), self._flat(y[None])[0])

        self._compared(torch.stack([t0, t0 + self.direction]))
        path = self._path(t0)
        s, y = path.first_zero(g)
        return t0 + self.direction * s, self._flat(torch.stack([path.y0, y]))

    def _path(self, t0: Tensor) -> Path:
        """The path from a time of torchdiffeq's, which increases."""
        return Path(self.integrator, self.system, self.joined, self.direction, self.direction * t0)

    def _compared(self, t: Tensor) -> _Compared:
        return _Compared(self.func, self._given(self.y0), self.direction * t, self.integrator, self.system)

    def _given(self, y: Tensor) -> Any:
        """The state as the user gave it: torchdiffeq flattens tuples."""
        if self.shapes is None:
            return y
        sizes = [shape.numel() for shape in self.shapes]
        return tuple(part.reshape(shape) for part, shape in zip(y.split(sizes), self.shapes, strict=True))

    def _flat(self, y: Tensor) -> Tensor:
        """States (n, ..., 2d) in the flat form that torchdiffeq hands over, if it did."""
        if self.shapes is None:
            return y
        return torch.cat([part.reshape(len(y), -1) for part in y.chunk(2, dim=-1)], dim=-1)
