"""Activations σ with their slopes σ', each (σ(a), σ'(a)). Source text, pasted after `elementary`."""
# ruff: noqa: F821
# mypy: ignore-errors

import math

from numba import njit


@njit(**OPTIONS)
def tanh(a):
    value = fast_tanh(a)
    return value, 1.0 - value * value


@njit(**OPTIONS)
def sin(a):
    return fast_sin(a), fast_cos(a)


@njit(**OPTIONS)
def sigmoid(a):
    value = 0.5 + 0.5 * fast_tanh(0.5 * a)
    return value, value * (1.0 - value)


@njit(**OPTIONS)
def softplus(a):
    return max(a, 0.0) + math.log1p(math.exp(-abs(a))), 0.5 + 0.5 * fast_tanh(0.5 * a)


@njit(**OPTIONS)
def logcosh(a):
    return abs(a) + math.log1p(math.exp(-2.0 * abs(a))) - math.log(2.0), fast_tanh(a)


@njit(**OPTIONS)
def swish(a):
    sigmoid_a = 0.5 + 0.5 * fast_tanh(0.5 * a)
    value = a * sigmoid_a
    return value, sigmoid_a + value * (1.0 - sigmoid_a)
