"""Our methods in torchdiffeq's own solver table. Private to torchdiffeq: only by `interop.torchdiffeq.register`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any

import torch
from torch import Tensor

from sympflow.interop.path import Path
from sympflow.interop.torchdiffeq import _build, _check_state, _joined, _no_adjoint


def add(method: str) -> None:
    """Put the method into the table, under its own name."""
    table = import_module("torchdiffeq._impl.odeint").SOLVERS
    table[method] = type(f"{method.title()}Solver", (_Solver,), {"method": method})


def _within_adjoint() -> bool:
    """Whether torchdiffeq's `odeint_adjoint` is among the callers: it hands its solvers no other sign of itself."""
    frame = sys._getframe()
    while frame is not None:
        if frame.f_globals.get("__name__") == "torchdiffeq._impl.adjoint":
            return True
        frame = frame.f_back  # type: ignore[assignment]
    return False


class _Solver:
    """What torchdiffeq asks of a solver: times come increasing, states flat; `func` knows what they were."""

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
        self.y0, self.shapes = y0, shapes
        y, _ = _joined(self._given(y0))
        _check_state(y, system, integrator)
        self.path = Path(integrator, system, y, self.direction)

    @classmethod
    def valid_callbacks(cls) -> set[str]:
        return set()

    def integrate(self, t: Tensor) -> Tensor:
        return self._flat(torch.cat([self.path.y0[None], self.path(self.direction * (t[1:] - t[0]))]))

    def integrate_until_event(self, t0: Tensor, event_fn: Callable[[Tensor, Tensor], Tensor]) -> tuple[Tensor, Tensor]:
        def g(s: Tensor, y: Tensor) -> Tensor:
            return event_fn((t0 + self.direction * s).to(t0), self._flat(y[None])[0])

        s = self.path.first_zero(g)
        y = torch.stack([self.path.y0, self.path(s[None])[0]])
        return t0 + self.direction * s, self._flat(y)

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
