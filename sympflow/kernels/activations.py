"""Activations σ of networks: each with its slope, written with numbers of any kind; from these all that is compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sympflow.compiler.functions import COMPOSED, apply, fma
from sympflow.compiler.program import Program, gradient, traced

__all__ = ["SLOPES", "bent"]


def _logistic(a: Any) -> Any:
    """1 / (1 + exp(−a))."""
    return fma(0.5, apply("tanh", 0.5 * a), 0.5)


def _tanh(a: Any) -> tuple[Any, Any]:
    h = apply("tanh", a)
    return h, fma(-h, h, 1.0)


def _sigmoid(a: Any) -> tuple[Any, Any]:
    h = _logistic(a)
    return h, h * (1.0 - h)


def _swish(a: Any) -> tuple[Any, Any]:
    s = _logistic(a)
    h = a * s
    return h, fma(h, 1.0 - s, s)


SLOPES: dict[str, Callable[[Any], tuple[Any, Any]]] = {
    "tanh": _tanh,
    "sin": lambda a: (apply("sin", a), apply("cos", a)),
    "sigmoid": _sigmoid,
    "softplus": lambda a: (COMPOSED["softplus"].value(a), _logistic(a)),
    "logcosh": lambda a: (COMPOSED["logcosh"].value(a), apply("tanh", a)),
    "swish": _swish,
}
"""The activations by name: functions of a number a that return σ(a) and σ'(a)."""


def bent(name: str, orders: int) -> Program:
    """Return the program of σ(a), σ'(a), σ''(a) …, so many derivatives."""
    program = traced(SLOPES[name], "a")
    found = list(program.outputs)
    while len(found) <= orders:
        found += gradient(found[-1], program.inputs)
    return Program(program.inputs, found)
