"""torchdiffeq's `odeint` and `odeint_event` with our methods: identical signatures, change the import or nothing.

`method="sympflow"` and all our fixed-step methods are run here; everything else is handed on to torchdiffeq. Their
options go into `options`: `flow`, `dt` (or `step_size`), and `system` where `func` is not a HamiltonianSystem.
"""

from __future__ import annotations

import difflib
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import numpy as np
import torch
import torchdiffeq
from torch import Tensor

from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep, Integrator
from sympflow.integrators.registry import available, check_applies
from sympflow.integrators.tableaux import ADAPTIVE, FIXED
from sympflow.interop.matching import Comparison, fixed_step
from sympflow.interop.path import Path

State = Tensor | tuple[Tensor, ...]
_THEIRS = {*ADAPTIVE, *FIXED, "explicit_adams", "implicit_adams", "fixed_adams", "scipy_solver"}
_RTOL, _ATOL = 1e-7, 1e-9
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
        If `func` is another system than the one that our method solves, or depends on the time, as far as several
        states and times tell, at the start and along the run.
    """
    if not _is_ours(method):
        with _names_of_both():
            return torchdiffeq.odeint(
                _of_pairs(func, y0), y0, t, rtol=rtol, atol=atol, method=method, options=options, event_fn=event_fn
            )
    if (rtol, atol) != (_RTOL, _ATOL):
        warnings.warn(
            f"`rtol` and `atol` have no effect on the fixed-step method {_name(method)!r}: leave them out.",
            UserWarning,
            stacklevel=2,
        )
    _check_times(t)
    integrator, system = _build(func, method, options)
    y, pack = _joined(y0)
    _check_state(y, system, integrator)
    compared = _Compared(func, y0, t, integrator, system)
    path = Path(integrator, system, y, -1 if len(t) > 1 and t[0] > t[1] else 1)
    if event_fn is None:
        return pack(compared.run(path, t))
    if len(t) != 2:
        raise ValueError(f"`t` must have 2 entries with `event_fn`, the start and a direction; got {len(t)}.")
    found, states = _until_event(path, t[0], event_fn, pack)
    compared.along(found[None], states[1:])
    return found, pack(states)


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

    Arguments as there; with our methods `odeint_interface` is torchdiffeq's `odeint` or ours, which are the same then.
    Gradients reach y0, t0 and the weights.
    """
    if not _is_ours(kwargs.get("method")):
        theirs = torchdiffeq.odeint if odeint_interface is odeint else odeint_interface
        arguments = {"event_fn": event_fn, "reverse_time": reverse_time, "odeint_interface": theirs, **kwargs}
        with _names_of_both():
            return torchdiffeq.odeint_event(_of_pairs(func, y0), y0, t0, **arguments)
    if odeint_interface not in (odeint, torchdiffeq.odeint):
        raise _no_adjoint(kwargs["method"])
    if not (isinstance(t0, Tensor) and t0.numel() == 1 and t0.is_floating_point()):
        raise TypeError("`t0` must be a floating-point tensor with one time: use torch.tensor(0.0).")
    start = t0.reshape(-1)
    t = torch.cat([start, start.detach() + (-1.0 if reverse_time else 1.0)])
    return odeint(func, y0, t, event_fn=event_fn, **kwargs)


def odeint_adjoint(func: Any, y0: State, t: Tensor, *, method: Any = None, **kwargs: Any) -> Any:
    """`torchdiffeq.odeint_adjoint`, which is refused for our methods.

    Raises
    ------
    ValueError
        For our methods: the adjoint method integrates the derivative of `func`, not that of the map that was run.
    """
    if _is_ours(method):
        raise _no_adjoint(method)
    with _names_of_both():
        return torchdiffeq.odeint_adjoint(func, y0, t, method=method, **kwargs)


def register(method: str) -> None:
    """Add one of our methods to torchdiffeq's own table, for code whose calls of `odeint` cannot be changed.

    That table is private to torchdiffeq, so this is never done unasked, and may break with a release of it.

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
    table = import_module("torchdiffeq._impl.odeint").SOLVERS
    table[method] = type(f"{method.title()}Solver", (_Solver,), {"method": method})


@contextmanager
def _names_of_both() -> Iterator[None]:
    """torchdiffeq knows its own methods only: a name that neither has is answered with ours as well."""
    try:
        yield
    except ValueError as error:
        if not str(error).startswith("Invalid method"):
            raise
        name = str(error).split('"')[1]
        known = sorted({*available(), *_THEIRS})
        close = difflib.get_close_matches(name.lower(), known, n=1)
        hint = f" Did you mean {close[0]!r}?" if close else ""
        raise ValueError(f"`method` {name!r} is unknown.{hint} Choose one of {', '.join(known)}.") from None


def _is_ours(method: Any) -> bool:
    if isinstance(method, str):
        return method not in _THEIRS and method in available()
    return method is not None


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
        raise TypeError(f"`options` has a 'system' that is no HamiltonianSystem: {type(system).__name__}. Pass one.")
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


def _check_times(t: Any) -> None:
    if not (isinstance(t, Tensor) and t.ndim == 1 and len(t) and t.is_floating_point()):
        raise TypeError("`t` must be a one-dimensional floating-point tensor of times: use torch.tensor([...]).")
    steps = torch.diff(t.detach())
    if not torch.isfinite(t).all() or not ((steps > 0).all() or (steps < 0).all()):
        raise ValueError("`t` must be finite and strictly increasing or decreasing: sort it and drop repeats.")


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
    if not torch.isfinite(y).all():
        raise ValueError("`y0` must be finite; it holds NaN or infinity. Remove these states.")


class _Compared:
    """Compares `func`, where it is not the system itself, with what the method solves: see `matching.Comparison`."""

    def __init__(
        self, func: Any, y0: State, t: Tensor, integrator: FixedStep, system: HamiltonianSystem | None
    ) -> None:
        flow = integrator.given_flow
        self.comparison = comparison = Comparison("func", integrator, system, _REMEDY)
        y, self.pack = _joined(y0)
        start = _numpy(y).reshape(-1, y.shape[-1])[0]
        if flow is not None and not any(w.requires_grad for w in flow.parameters()):  # it may be in training
            comparison.with_flow(start.astype(float))
        self.func: Any = None if func is system else _of_pairs(func, y0)
        if self.func is None:
            return
        if isinstance(func, HamiltonianSystem):
            comparison.with_system(func)
        self.like, self.t0 = y, t[0]
        comparison.at_start(self._slope, _numpy(y), (float(t[0]), float(t[-1])))

    def _slope(self, t: float, y: np.ndarray) -> np.ndarray:
        """`func` at states like y0, in their precision and form."""
        with torch.no_grad():
            state = torch.tensor(y, dtype=self.like.dtype, device=self.like.device)
            return _numpy(_joined(self.func(self.t0.new_tensor(t), self.pack(state)))[0])

    def run(self, path: Path, t: Tensor) -> Tensor:
        """The states (n, ..., 2d) at the times t (n,), compared at some of them, and between where these are few."""
        elapsed = t[1:] - t[0]
        if not len(elapsed):
            return path.y0[None]
        if self.func is None:
            return torch.cat([path.y0[None], path(elapsed)])
        n_steps = int(float(elapsed[-1]) / path.h)
        n_more = min(_CHECKPOINTS - 1, n_steps) if len(elapsed) < _CHECKPOINTS else 0
        count = np.unique(n_steps * (np.arange(n_more) + 0.38) / max(n_more, 1) // 1)
        more = elapsed.new_tensor(count * path.h)
        states = path(torch.cat([more, elapsed]))
        self.along(t[0] + more, states[: len(more)])
        outputs = states[len(more) :]
        some = np.unique(np.linspace(0, len(elapsed) - 1, _CHECKPOINTS).astype(int)).tolist()
        self.along(t[1:][some], outputs[some])
        return torch.cat([path.y0[None], outputs])

    def along(self, t: Tensor, states: Tensor) -> None:
        """Compare at states (n, ..., 2d) of the run, at the times t (n,)."""
        if self.func is None:
            return
        for s, y in zip(t.tolist(), _numpy(states), strict=True):
            if np.isfinite(y).all():
                self.comparison.at(s, y, self._slope(s, y), self._slope, float(self.t0))


def _numpy(x: Tensor) -> np.ndarray:
    return x.detach().cpu().numpy()


def _until_event(path: Path, t0: Tensor, event_fn: Any, pack: Callable[[Tensor], Any]) -> tuple[Tensor, Tensor]:
    with torch.no_grad():
        signs = torch.sign(event_fn(t0, pack(path.y0)))

    def g(s: Tensor, y: Tensor) -> Tensor:
        return torch.min(event_fn((t0 + s).to(t0.dtype), pack(y)) * signs)

    s = path.first_zero(g)
    y = path(s[None])[0]
    return (t0 + s).to(t0.dtype), torch.stack([path.y0, y])


def _of_pairs(func: Any, y0: Any) -> Any:
    """A HamiltonianSystem as a function of (q, p), where `y0` is such a tuple; anything else as it is."""
    if not (isinstance(func, HamiltonianSystem) and isinstance(y0, tuple)):
        return func
    _joined(y0)
    return lambda t, y: tuple(func(t, torch.cat(y, dim=-1)).chunk(2, dim=-1))


def _no_adjoint(method: Any) -> ValueError:
    return ValueError(
        f"`method` {_name(method)!r} cannot be used with odeint_adjoint: the adjoint integrates the derivative of "
        "`func` backward, which is not the derivative of the map that was run, and never sees a flow's weights; the "
        "gradients would be wrong without notice. Use odeint, which differentiates the map itself."
    )


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
            raise _no_adjoint(self.method)
        self.direction, shapes = 1, None
        while type(func).__module__.startswith("torchdiffeq"):
            self.direction = -1 if type(func).__name__ == "_ReverseFunc" else self.direction
            shapes = getattr(func, "shapes", shapes)
            func = func.base_func
        integrator, system = _build(func, self.method, options)
        self.y0, self.shapes, self.func = y0, shapes, func
        self.integrator, self.system = integrator, system
        y, _ = _joined(self._given(y0))
        _check_state(y, system, integrator)
        self.path = Path(integrator, system, y, self.direction)

    @classmethod
    def valid_callbacks(cls) -> set[str]:
        return set()

    def integrate(self, t: Tensor) -> Tensor:
        return self._flat(self._compared(t).run(self.path, self.direction * t))

    def integrate_until_event(self, t0: Tensor, event_fn: Callable[[Tensor, Tensor], Tensor]) -> tuple[Tensor, Tensor]:
        def g(s: Tensor, y: Tensor) -> Tensor:
            return event_fn((t0 + self.direction * s).to(t0), self._flat(y[None])[0])

        self._compared(torch.stack([t0, t0 + self.direction]))
        s = self.path.first_zero(g)
        y = torch.stack([self.path.y0, self.path(s[None])[0]])
        return t0 + self.direction * s, self._flat(y)

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
