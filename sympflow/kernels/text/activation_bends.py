"""Activations σ with three derivatives, each (σ(a), σ'(a), σ''(a), σ'''(a)). Source text, pasted after `elementary`."""
# ruff: noqa: F821
# mypy: ignore-errors

import math

from numba import njit


@njit(**OPTIONS)
def logistic(a):
    """1 / (1 + exp(−a)) and its derivatives."""
    g = 0.5 + 0.5 * fast_tanh(0.5 * a)
    slope = g * (1.0 - g)
    bend = slope * (1.0 - 2.0 * g)
    return g, slope, bend, bend * (1.0 - 2.0 * g) - 2.0 * slope * slope


@njit(**OPTIONS)
def tanh(a):
    h = fast_tanh(a)
    slope = 1.0 - h * h
    bend = -2.0 * h * slope
    return h, slope, bend, -2.0 * (slope * slope + h * bend)


@njit(**OPTIONS)
def sin(a):
    h, slope = fast_sin(a), fast_cos(a)
    return h, slope, -h, -slope


@njit(**OPTIONS)
def sigmoid(a):
    return logistic(a)


@njit(**OPTIONS)
def softplus(a):
    g, slope, bend, _ = logistic(a)
    return max(a, 0.0) + math.log1p(math.exp(-abs(a))), g, slope, bend


@njit(**OPTIONS)
def logcosh(a):
    h, slope, bend, _ = tanh(a)
    return abs(a) + math.log1p(math.exp(-2.0 * abs(a))) - math.log(2.0), h, slope, bend


@njit(**OPTIONS)
def swish(a):
    g, slope, bend, twist = logistic(a)
    return a * g, g + a * slope, 2.0 * slope + a * bend, 3.0 * bend + a * twist
