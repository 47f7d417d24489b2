"""Many steps with array operations, and what a step must return."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sympflow.arrays import Array, all_finite, full_of_nan, is_tensor, stack, to_numpy

__all__ = ["checked_state", "rollout"]


def rollout(
    step: Callable[[int, Array], Array], y: Array, n_steps: int, save: np.ndarray, block: int = 64
) -> tuple[Array, np.ndarray]:
    """Apply `step(k, y)` n_steps times; the states at the counts `save`, and the last finite count of each trajectory.

    Finiteness is tested once a block; a block that ends non-finite is run again to find where. The run stops when no
    trajectory is finite any more; later states are NaN.
    """
    tensor = is_tensor(y)
    out: Any = [] if tensor else np.full((len(save), *y.shape), np.nan, dtype=y.dtype)
    wanted = save.tolist()
    position = 0
    finite = np.where(to_numpy(all_finite(y)), n_steps, -1)
    if wanted and wanted[0] == 0:
        out.append(y) if tensor else out.__setitem__(0, y)
        position = 1
    k = 0
    with np.errstate(all="ignore"):
        while k < n_steps and (finite == n_steps).any():
            start, y_start = k, y
            for k in range(start, min(start + block, n_steps)):
                y = checked_state(step(k, y), y)
                if position < len(wanted) and wanted[position] == k + 1:
                    if tensor:
                        out.append(y)
                    else:
                        out[position] = y
                    position += 1
            k += 1
            failed = (finite == n_steps) & ~to_numpy(all_finite(y))
            if failed.any():
                z = y_start
                for j in range(start, k):
                    z = step(j, z)
                    first = failed & (finite == n_steps) & ~to_numpy(all_finite(z))
                    finite = np.where(first, j, finite)
    if tensor:
        out += [full_of_nan(y)] * (len(wanted) - len(out))
        out = stack(out, axis=0) if out else y[None][:0]
    return out, np.asarray(finite)


def checked_state(y_next: Any, y: Array) -> Array:
    """The result of a step from y, of the same kind, shape and dtype: a step may be that of a plug-in."""
    shape = getattr(y_next, "shape", None)
    if shape == y.shape and y_next.dtype == y.dtype and is_tensor(y_next) == is_tensor(y):
        return y_next
    what = "" if shape is None else f" of {y_next.dtype} and shape {tuple(shape)}"
    raise TypeError(
        f"`step` must return states as those that it is given, of {y.dtype} and shape {tuple(y.shape)}; got "
        f"{type(y_next).__name__}{what}. Mend the integrator: check_integrator tests it."
    )
