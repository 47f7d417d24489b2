"""Compiled linear algebra of Gauss–Newton steps: small dense matrices, on one thread.

The Jacobian comes by columns. It is factored in chunks of rows that stay in the cache: Householder reflections fold one
chunk after the other into the triangle above it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np

from sympflow.compiler.control import DOUBLE, INT, POINTER, Code, Type, Value
from sympflow.compiler.functions import apply, fma
from sympflow.compiler.machine import address
from sympflow.kernels.runs import begun, finished

__all__ = ["damped", "factored", "geodesic_acceleration"]

WIDTHS = 32, 8, 1  # numbers that are added up together: as many as there are left
CHUNK = 128  # rows that are folded together


def factored(
    columns: np.ndarray, blocks: np.ndarray, r: np.ndarray, scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangle R (n + 1, n + 1) of [J r], and the larger of `scale` (n,) and the norms of the columns of J.

    J is given by columns (n, m); or in as many blocks of rows as `blocks` (B, k, n) are, each the rows of the columns
    (k, m) times its block: then it is these that are factored first, where k is less than n.
    """
    if len(blocks):
        each, _ = _triangles(columns, r, len(blocks))
        rows = np.concatenate([each[:, :, :-1] @ blocks, each[:, :, -1:]], axis=2).reshape(-1, blocks.shape[2] + 1).T
        columns, r = np.ascontiguousarray(rows[:-1]), np.ascontiguousarray(rows[-1])
    R, norms = _triangles(columns, r, 1)
    return R[0], np.maximum(scale, norms)


def _triangles(columns: np.ndarray, r: np.ndarray, n_blocks: int) -> tuple[np.ndarray, np.ndarray]:
    """The triangles (B, k + 1, k + 1) of equal blocks of rows of [J r], and the norms of the last one's columns."""
    k, m = columns.shape
    R, norms, memory = np.zeros((n_blocks, k + 1, k + 1)), np.empty(k), np.empty((k + 1, CHUNK))
    _function("fold")(*map(address, (columns, r, R, norms, memory)), k, m, n_blocks)
    return R, norms


def damped(R: np.ndarray, D: np.ndarray, damping: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the triangle S of [R; √λ D], the s that minimizes ‖J s + r‖² + λ‖D s‖², and the decrease of ‖J s + r‖²."""
    n = len(D)
    S, columns, step = R.copy(), np.zeros((n + 1, n)), np.empty(n + 1)
    _function("damp")(*map(address, (R, D, S, columns, step)), damping, n)
    return S, step[:n], float(step[n])


def geodesic_acceleration(
    columns: np.ndarray,
    blocks: np.ndarray,
    r: np.ndarray,
    probed: np.ndarray,
    probe: float,
    step: np.ndarray,
    S: np.ndarray,
    D: np.ndarray,
    curved: float,
) -> np.ndarray:
    """Return the geodesic acceleration, from the errors `probed` a share `probe` of the step away; 0 if too large."""
    (k, m), n = columns.shape, len(D)
    curvature, acceleration = probed - r, np.zeros(n)
    arrays = columns, blocks, curvature, step, S, D, acceleration
    _function("acceleration")(*map(address, arrays), probe, curved, k, m, len(blocks), n)
    return acceleration


# code ---------------------------------------------------------------------------------------------------------------


def _pieces(code: Code, n: Value) -> Any:
    """Where pieces of a vector begin, of each width, and how many there are."""
    begin = code.constant(0, INT)
    for width in WIDTHS:
        count = code.op("sdiv", INT, n - begin, code.constant(width, INT))
        yield Type("double", width), begin, count
        begin = begin + count * width


def _dot(x: Value, y: Value, n: Value) -> Value:
    def body(x: Value, y: Value, n: Value) -> Value:
        code = x.code
        total = code.constant(0.0)
        for type, begin, count in _pieces(code, n):
            sums = code.variable(code.constant(0.0, type))
            with code.over(count) as i:
                at = begin + i * type.width
                sums.value = fma(code.load(x, at, type), code.load(y, at, type), sums.value)
            total = total + code.total(sums.value)
        return total

    return x.code.outlined("dot", [x, y, n], body, DOUBLE)


def _add(y: Value, factor: Value, x: Value, n: Value) -> None:
    """y += factor x."""

    def body(y: Value, factor: Value, x: Value, n: Value) -> None:
        code = y.code
        for type, begin, count in _pieces(code, n):
            with code.over(count) as i:
                at = begin + i * type.width
                code.store(fma(code.operand(factor, type), code.load(x, at, type), code.load(y, at, type)), y, at)

    y.code.outlined("add", [y, factor, x, n], body)


def _fold(R: Value, columns: Value, stride: Value, count: Value, length: Value, triangular: bool) -> None:
    """Let R be the triangle of the factors of [R; A] for the columns of A, which are lost; A may be `triangular`."""
    code = R.code
    with code.over(count) as k:
        end = code.apply("min", (length, k + 1)) if triangular else length
        x, diagonal = code.at(columns, k * stride), k * (count + 1)
        square = _dot(x, x, end)
        with code.given(square > 0.0):
            above = code.load(R, diagonal)
            norm = apply("sqrt", fma(above, above, square))
            norm = code.select(above > 0.0, -norm, norm)
            head = above - norm
            code.store(norm, R, diagonal)
            inverse = 1.0 / (norm * head)
            with code.over(count - 1 - k) as j:
                y, at = code.at(columns, (k + 1 + j) * stride), diagonal + 1 + j
                product = fma(head, code.load(R, at), _dot(x, y, end)) * inverse
                code.store(fma(product, head, code.load(R, at)), R, at)
                _add(y, product, x, end)


def _folded(code: Code) -> None:
    """Triangles of blocks of rows: see `_triangles`."""
    columns, r, R, norms, memory, k, m, n_blocks = code.arguments
    size, chunk = code.op("sdiv", INT, m, n_blocks), code.constant(CHUNK, INT)
    with code.over(n_blocks) as b:
        triangle = code.at(R, b * ((k + 1) * (k + 1)))
        with code.over(code.op("sdiv", INT, size + (CHUNK - 1), chunk)) as c:
            length = code.apply("min", (chunk, size - c * CHUNK))
            begin = b * size + c * CHUNK
            with code.over(length) as i:
                code.store(code.load(r, begin + i), memory, k * CHUNK + i)
            with code.over(k) as j:
                column, target = code.at(columns, j * m + begin), code.at(memory, j * CHUNK)
                for type, first, count in _pieces(code, length):
                    with code.over(count) as i:
                        at = first + i * type.width
                        code.store(code.load(column, at, type), target, at)
            _fold(triangle, memory, chunk, k + 1, length, False)
    last = code.at(R, (n_blocks - 1) * ((k + 1) * (k + 1)))
    with code.over(k) as i:
        square = code.variable(code.constant(0.0))
        with code.over(i + 1) as j:
            x = code.load(last, j * (k + 1) + i)
            square.value = fma(x, x, square.value)
        code.store(apply("sqrt", square.value), norms, i)


def _damped(code: Code) -> None:
    """See `damped`; the decrease follows the step."""
    R, D, S, columns, step, damping, n = code.arguments
    root = apply("sqrt", damping)
    with code.over(n) as i:
        code.store(root * code.load(D, i), columns, i * (n + 1))
    _fold(S, columns, n, n + 1, n, True)
    with code.over(n) as i:
        code.store(-code.load(S, i * (n + 1) + n), step, i)
    _solve(S, step, n)
    total = code.variable(code.constant(0.0))
    with code.over(n) as i:
        row, right = code.at(R, i * (n + 2)), code.load(R, i * (n + 1) + n)
        linear = right + _dot(row, code.at(step, i), n - i)
        total.value = total.value + (right * right - linear * linear)
    code.store(total.value, step, n)


def _solve(S: Value, x: Value, n: Value) -> None:
    """x becomes S⁻¹x, of a triangle S whose last column is not used."""
    code = S.code
    with code.over(n) as k:
        i = n - 1 - k
        row = code.at(S, i * (n + 2))
        known = _dot(code.at(row, 1), code.at(x, i + 1), k)
        code.store((code.load(x, i) - known) / code.load(row), x, i)


def _acceleration(code: Code) -> None:
    """−(SᵀS)⁻¹ of the derivative along J of the curvature of the errors, which are lost."""
    columns, blocks, curvature, step, S, D, acceleration, probe, curved, k, m, n_blocks, n = code.arguments
    whole = code.apply("eq", (n_blocks, 0))
    parts = code.select(whole, code.constant(1, INT), n_blocks)
    size, square = code.op("sdiv", INT, m, parts), probe * probe
    with code.over(parts) as b:
        part = code.at(curvature, b * size)
        with code.over(k) as i:
            inner = code.variable(code.load(step, i))
            with code.given(~whole):
                inner.value = _dot(code.at(blocks, (b * k + i) * n), step, n)
            _add(part, -probe * inner.value, code.at(columns, i * m + b * size), size)
        with code.over(k) as i:
            along = -_dot(code.at(columns, i * m + b * size), part, size) / square
            with code.given(whole):
                code.store(along, acceleration, i)
            with code.given(~whole):
                _add(acceleration, along, code.at(blocks, (b * k + i) * n), n)
    with code.over(n) as i:
        row = code.at(S, i * (n + 2))
        x = code.load(acceleration, i) / code.load(row)
        code.store(x, acceleration, i)
        _add(code.at(acceleration, i + 1), -x, code.at(row, 1), n - 1 - i)
    _solve(S, acceleration, n)

    def more(i: Value, squares: Sequence[Value]) -> list[Value]:
        scaled = [code.load(D, i) * code.load(x, i) for x in (acceleration, step)]
        return [fma(x, x, square) for x, square in zip(scaled, squares, strict=True)]

    of_bend, of_step = code.loop(n, [code.constant(0.0)] * 2, more)
    small = 2.0 * apply("sqrt", of_bend) <= curved * apply("sqrt", of_step)  # NaN is not small
    with code.given(~small), code.over(n) as i:
        code.store(code.constant(0.0), acceleration, i)


_FUNCTIONS: dict[str, tuple[Callable[[Code], None], list[Type]]] = {
    "fold": (_folded, [*[POINTER] * 5, INT, INT, INT]),
    "damp": (_damped, [*[POINTER] * 5, DOUBLE, INT]),
    "acceleration": (_acceleration, [*[POINTER] * 7, DOUBLE, DOUBLE, INT, INT, INT, INT]),
}


@cache
def _function(name: str) -> Callable[..., None]:
    write, types = _FUNCTIONS[name]
    code = begun(name, types)
    write(code)
    return finished(code)
