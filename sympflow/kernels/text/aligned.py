"""Working arrays that begin where a vector register's load may. Source text, pasted before what needs them."""
# ruff: noqa: F821
# mypy: ignore-errors

import numpy as np
from numba import njit


@njit(**OPTIONS)
def aligned_zeros(n):
    """n zeros, the first on a 64-byte boundary: vectors that straddle two cache lines cost up to 80 % more time."""
    buffer = np.zeros(n + 8)
    first = -(buffer.ctypes.data // 8) % 8
    return buffer[first : first + n]


@njit(**OPTIONS)
def copy_lanes(source, target):
    """target[:] = source, of the same shape. So written, the text of its error takes Numba seconds to compile."""
    for i in range(source.shape[0]):
        for lane in range(source.shape[1]):
            target[i, lane] = source[i, lane]
