"""Functions of the time that are given by samples, in compiled code."""

from __future__ import annotations

import numpy as np

from sympflow.compiler import NotCompiled
from sympflow.compiler.control import DOUBLE, INT, Code, Value
from sympflow.compiler.functions import apply, where
from sympflow.hamiltonian.driving import Samples

__all__ = ["check_samples", "sampled_value"]

MOST_SAMPLED = 200_000
"""Numbers of samples that compiled code holds."""
UNIFORM = 1e-9
"""Relative deviation of equal intervals."""


def check_samples(samples: Samples) -> None:
    """Raise a ValueError if there are more than compiled code holds."""
    c = samples.c
    if c.size > MOST_SAMPLED:
        raise NotCompiled(
            f"`params` has samples of {len(samples.x)} times, more than compiled code holds: give fewer than "
            f"{MOST_SAMPLED // len(c)}, or use backend='array'."
        )


def sampled_value(samples: Samples, order: int, t: Value) -> Value:
    """A derivative of samples, of order −1 the antiderivative, at times t, each lane at its own."""
    name = f"sampled_{samples.digest}_{order}".replace("-", "m")

    def one(t: Value) -> Value:
        return t.code.outlined(name, [t], lambda t: _polynomial(samples, order, name, t), DOUBLE, rare=False)

    return t.code.lanes(one, [t], t.type)


def _polynomial(samples: Samples, order: int, name: str, t: Value) -> Value:
    """The polynomial of the interval of t, found at once where all are equal, else by bisection."""
    code, c, x = t.code, samples.polynomials(order), samples.x
    n, first, last = len(x) - 1, float(x[0]), float(x[-1])
    times, coefficients = code.array(f"{name}_times", x), code.array(f"{name}_c", c.T.ravel())
    turns = None
    if samples.periodic:
        turns = apply("floor", (t - first) / (last - first))
        t = t - turns * (last - first)
    width = (last - first) / n
    if np.all(np.abs(np.diff(x) - width) <= UNIFORM * width):
        place = apply("floor", (t - first) * (1 / width))
        place = where(place > 0.0, where(place < n - 1.0, place, n - 1.0), 0.0)  # NaN too is in the first
        i = code.convert("fptosi", place, "i64")
    else:
        i = _bisected(code, times, n, t)
    s, k = t - code.load(times, i), len(c)
    total = code.load(coefficients, i * k)
    for j in range(1, k):
        total = total * s + code.load(coefficients, i * k + j)
    if turns is not None and order < 0:
        total = total + turns * float(np.polyval(c[:, -1], last - float(x[-2])))
    return total


def _bisected(code: Code, times: Value, n: int, t: Value) -> Value:
    """The last of the first n times that is at most t, the first one if none is."""

    def halved(_: Value, values: list[Value]) -> list[Value]:
        low, high = values
        middle = (low + high) >> 1
        below = code.load(times, middle) <= t
        return [code.select(below, middle, low), code.select(below, high, middle)]

    low, high = code.constant(0, INT), code.constant(n, INT)
    return code.loop(max(n - 1, 1).bit_length(), [low, high], halved)[0]
