"""Activations σ of networks, written with numbers of any kind; from these all that is compiled."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any

from sympflow.compiler.functions import apply, fma
from sympflow.compiler.program import Program, fused, gradient, traced

__all__ = ["SIGMAS", "activation_program"]


def _logistic(a: Any) -> Any:
    """1 / (1 + exp(−a))."""
    return fma(0.5, apply("tanh", 0.5 * a), 0.5)


SIGMAS: dict[str, Callable[[Any], Any]] = {
    **{name: partial(apply, name) for name in ("tanh", "sin", "softplus", "logcosh")},
    "sigmoid": _logistic,
    "swish": lambda a: a * _logistic(a),
}
"""The activations by name: functions of a number."""


@cache
def activation_program(name: str, orders: int) -> Program:
    """Return the program of σ(a), σ'(a), σ''(a) …, so many derivatives."""
    program = traced(lambda a: [SIGMAS[name](a)], "a")
    found = list(program.outputs)
    while len(found) <= orders:
        found += gradient(found[-1], program.inputs)
    return fused(Program(program.inputs, found))
