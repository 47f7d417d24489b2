"""Checks of the functions that define H: derivatives against differences, batches against single states, repetition.

They run once for a system, at a few states, and cost milliseconds. A function passes unless it is certainly wrong:
next to a kink or a singularity, or where rounding hides the answer, they stay silent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sympflow.arrays import Array, like, one_lane
from sympflow.hamiltonian.domain import Domain

SPREAD = 0.05  # the distance of the probes about a given state from it, relative to its size
FEW = 4
EVERY_COMPONENT = 64  # most components that are tested one by one; of more, as many random directions as DIRECTIONS
DIRECTIONS = 8
STEPS = {np.dtype(np.float64): (1e-5, 1e-4), np.dtype(np.float32): (3e-3, 1e-2)}
"""Steps of the differences, relative to the size of the state: a derivative is wrong if both say so."""
FINER = [10.0**-k for k in range(1, 10)]
"""Fractions of the smaller step that are tried before a derivative is refused: a function may vary within the step."""
FARTHER = 0.25  # a run is tested where it left the states tested before by this share of their extent
REMEDY = "if the function is correct, pass check=False to HamiltonianSystem."


def probe_states(given: np.ndarray | None, domain: Domain | None, width: int) -> np.ndarray:
    """States (n, width) at which functions are tested: the given ones, near these, and some of the domain.

    Without any they are random numbers of size 1.
    """
    rng = np.random.Generator(np.random.PCG64(20260102))
    found = []
    if given is not None:
        rows = np.asarray(given, dtype=float).reshape(-1, width)
        rows = rows[np.isfinite(rows).all(1)][:FEW]
        halves = rows.reshape(len(rows), 2, -1)
        size = np.abs(halves).max(-1, keepdims=True, initial=0.0)
        noise = rng.standard_normal((2, *halves.shape)) * SPREAD * np.where(size > 0, size, 1.0)
        found += [rows, *(halves + noise).reshape(2, *rows.shape)]
    if domain is not None:
        found.append(np.asarray(domain.sample(FEW, seed=20260102)))
    if not found:
        found.append(rng.standard_normal((FEW, width)))
    return np.concatenate(found)


def reach(states: np.ndarray, parts: int) -> np.ndarray:
    """The least and the largest components (2, width) that a run may have without another test, by states tested."""
    low, high = states.min(0), states.max(0)
    with np.errstate(over="ignore"):
        lengths = (high - low).reshape(parts, -1)
        margin = FARTHER * np.maximum(lengths, 0.1 * lengths.max(-1, keepdims=True)).ravel()
        return np.stack([low - margin, high + margin])


def farther_states(y: np.ndarray, reached: np.ndarray) -> np.ndarray:
    """States of a run (N, width), a few, that lie farthest beyond what `reach` gave, in its first components."""
    low, high = reached
    seen = y[:, : len(low)]
    if not len(y) or ((seen.min(0) >= low).all() and (seen.max(0) <= high).all()):
        return y[:0]
    y = y[np.isfinite(y).all(-1)]
    if not len(y):
        return y
    seen = y[:, : len(low)]
    rows = np.concatenate([seen.argmin(0), seen.argmax(0)])
    with np.errstate(over="ignore"):
        beyond = np.concatenate([low - seen.min(0), seen.max(0) - high])
        order = np.argsort(-beyond / np.tile(np.where(high > low, high - low, 1.0), 2))
    return y[list(dict.fromkeys(rows[order[beyond[order] > 0]].tolist()))[:FEW]]


@dataclass(frozen=True)
class Tested:
    """A function of states x (..., n), its gradient, and its Hessian times a vector where that was given."""

    names: tuple[str, str, str]  # of the functions, and of the state, in messages
    value: Callable[[Array], Array]
    gradient: Any  # None of an exact one, of a function that was traced
    hessian_vector: Any = None
    automatic: bool = False  # the gradient is an automatic one
    parts: int = 1  # 2 if x is [q, p], two halves of sizes of their own
    result_types: Callable[[Array], list[tuple[str, Any]]] | None = None  # in which the user's own functions answer
    time: float | None = None


def test(functions: Tested, states: np.ndarray, example: Array, n_given: int) -> None:
    """Test the functions at states (N, n), in the library and dtype of `example`; `n_given` must be in their domain."""
    with np.errstate(all="ignore"):
        kept = _evaluated(functions, like(states, example), n_given)
        if kept is None:
            return
        x, V, g = kept
        _check_types(functions, x)
        _check_values(functions, x, V, g)
        if functions.gradient is not None:
            _check_gradient(functions, x, V, g)
        if functions.hessian_vector is not None:
            _check_hessian_vector(functions, x, g)


def _precision(x: Array) -> np.dtype:
    return np.dtype(str(x.dtype).removeprefix("torch."))


def _numbers(value: Array) -> np.ndarray:
    return one_lane(value).astype(float)


def _evaluated(functions: Tested, x: Array, n_given: int) -> tuple[Array, np.ndarray, np.ndarray] | None:
    """The states at which both functions are finite, and their values there, one state at a time."""
    rows, values, slopes = [], [], []
    for i in range(len(x)):
        try:
            V = functions.value(x[i])
            g = functions.gradient(x[i]) if functions.gradient is not None else V
        except Exception:
            if i < n_given:
                raise
            continue
        if np.isfinite(_numbers(V)) and np.isfinite(_numbers(g)).all():
            rows.append(i)
            values.append(_numbers(V))
            slopes.append(_numbers(g))
    return (x[rows], np.stack(values), np.stack(slopes)) if rows else None


def _check_types(functions: Tested, x: Array) -> None:
    """Refuse answers of less precision than the states have, which would be taken for exact."""
    if functions.result_types is None:
        return
    mine = _precision(x)
    for name, dtype in functions.result_types(x[0]):
        kind = str(dtype).removeprefix("torch.")
        if kind in ("float16", "bfloat16", "float32") and (kind != "float32" or mine == np.float64):
            raise TypeError(
                f"`{name}` returns {kind} for a state in {mine}, whose digits it loses: compute in the type of the "
                f"argument, or solve in {kind}; {REMEDY}"
            )


def _check_values(functions: Tested, x: Array, V: np.ndarray, g: np.ndarray) -> None:
    """Compare the value and the gradient, where it is one to be tested, with themselves, again and in a batch."""
    n = x.shape[-1]
    rows = np.arange(n if 2 <= n <= EVERY_COMPONENT else 3) % len(x)  # of a square one a transposed result would fit
    given = [*zip(functions.names, (functions.value, functions.gradient), (V, g), strict=False)]
    for name, function, (before, *_) in given:
        again = before if function is None else _numbers(function(x[0]))
        if not np.allclose(again, before, rtol=1e-6, atol=1e-12 * np.abs(before).max(), equal_nan=True):
            raise ValueError(
                f"`{name}` gives another value each time: at {_shown(functions, x[0])} {_short(before)}, then "
                f"{_short(again)}. A Hamiltonian is a function of the state alone; {REMEDY}"
            )
    for name, function, single in given:
        if function is not None:
            _check_batch(functions, name, x[rows], single[rows], _numbers(function(x[rows])))


def _check_batch(functions: Tested, name: str, x: Array, single: np.ndarray, batch: np.ndarray) -> None:
    """Refuse values for a batch of states that are not those for each of them."""
    if batch.shape != single.shape:
        raise ValueError(
            f"`{name}` must return shape {single.shape} for a batch of shape {tuple(x.shape)}; got {batch.shape}. "
            f"Write it for states on the last axis, q[..., 0] in place of q[0]; {REMEDY}"
        )
    size = np.abs(single).max(axis=tuple(range(1, single.ndim)), keepdims=True)
    tolerance = (1e-7 if _precision(x) == np.float64 else 1e-3) * size + 1e-300
    wrong = ~(np.abs(batch - single) <= tolerance) & np.isfinite(single)
    if wrong.any():
        i = tuple(np.argwhere(wrong)[0].tolist())
        part = f"component {i[1]} of its result" if len(i) == 2 else "its result"
        raise ValueError(
            f"`{name}` gives a batch other values than single states: {part} at {_shown(functions, x[i[0]])} is "
            f"{single[i]:g} alone, {batch[i]:g} in a batch of shape {tuple(x.shape)}. Write it for states on the last "
            f"axis, q[..., 0] in place of q[0]; {REMEDY}"
        )


def _directions(x: np.ndarray, chosen: Sequence[int] | None, parts: int, own: bool = False) -> np.ndarray:
    """Directions (N, m, n) at states (N, n), of the size of these: those of chosen components, or random ones.

    A small component is moved by a tenth of the largest, or, if it is not 0, by its `own` size.
    """
    groups = np.abs(x).reshape(len(x), parts, -1)
    largest = groups.max(-1, keepdims=True)
    size = np.maximum(groups, 0.1 * np.where(largest > 0, largest, 1.0))
    if own:
        size = np.where(groups > 0, groups, size)
    size = size.reshape(x.shape)
    if chosen is not None:
        return size[:, None, :] * np.eye(x.shape[-1])[list(chosen)]
    rng = np.random.Generator(np.random.PCG64(20260103))
    return size[:, None, :] * rng.uniform(-1, 1, (DIRECTIONS, x.shape[-1]))


def _values(function: Callable[[Array], Array], states: Array) -> np.ndarray:
    """A function at states (N, n), NaN where it fails, as beyond the end of its domain."""
    try:
        return _numbers(function(states))
    except Exception:  # whatever a user's function raises
        found: list[np.ndarray | None] = []
        for state in states:
            try:
                found.append(_numbers(function(state)))
            except Exception:
                found.append(None)
    nothing = np.full(next((v.shape for v in found if v is not None), ()), np.nan)
    return np.stack([nothing if v is None else v for v in found])


def _differences(
    function: Callable[[Array], Array], x: Array, w: np.ndarray, h: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Central differences of a function along w (N, m, n) at x (N, n): (N, m, …), and by what they may be off.

    That is the difference of the slopes on both sides, and rounding, which is seen in the values at states a few units
    in the last place away.
    """
    eps = np.finfo(_precision(x)).eps
    at = _numbers(x)[:, None, :]
    lengths = np.array([h, -h, 2 * eps, -2 * eps, 4 * eps, 0.0]).reshape(-1, 1, 1, 1)
    states = at + lengths * w
    values = _values(function, like(states.reshape(-1, x.shape[-1]), x))
    values = values.reshape(*states.shape[:-1], *values.shape[1:])
    up, down, *near, here = values
    rounding = np.max([np.abs(v - here) for v in near], axis=0) + 4 * eps * np.abs(here)
    ahead, behind = (up - here) / h, (here - down) / h
    return (ahead + behind) / 2, np.abs(ahead - behind), 16 * rounding / h


def _certainly_wrong(
    function: Callable[[Array], Array], x: Array, w: np.ndarray, claimed: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mask of the claimed derivatives along w (N, m, …) that are wrong, and the differences."""
    small, large = STEPS[_precision(x)]
    floor = 10 * small if _precision(x) == np.float64 else 3 * small
    wrong = np.ones(claimed.shape, dtype=bool)
    for h in (large, small):
        found, bend, rounding = _differences(function, x, w, h)
        beside = floor * np.maximum(np.abs(found), np.abs(claimed))
        wrong &= np.abs(found - claimed) > beside + 2 * bend + rounding  # False where one of them is not finite
    for fraction in FINER:
        if not wrong.any():
            break
        finer, _, rounding = _differences(function, x, w, fraction * small)
        apart = 0.1 * np.abs(found - claimed)
        wrong &= ~((np.abs(finer - claimed) < apart) & (rounding < apart))
    return wrong, found


def _check_gradient(functions: Tested, x: Array, V: np.ndarray, g: np.ndarray) -> None:
    n = x.shape[-1]
    at = _numbers(x)
    if n > EVERY_COMPONENT:
        w = _directions(at, None, functions.parts)
        wrong, _ = _certainly_wrong(functions.value, x, w, (w * g[:, None]).sum(-1))
        if not wrong.any():
            return
        worst = int(np.argwhere(wrong)[0][0])
        x, at, g = x[worst : worst + 1], at[worst : worst + 1], g[worst : worst + 1]
    for start in range(0, n, EVERY_COMPONENT):
        chosen = range(start, min(start + EVERY_COMPONENT, n))
        wrong, found = _wrong_slopes(functions, x, g, chosen, own=False)
        if wrong.any():  # a small component may have a scale of its own
            again, found = _wrong_slopes(functions, x, g, chosen, own=True)
            wrong &= again
        if wrong.any():
            i, k = np.argwhere(wrong)[0].tolist()
            _refuse(functions, x[i], chosen[k], g[i, chosen[k]], found[i, k], g)


def _wrong_slopes(
    functions: Tested, x: Array, g: np.ndarray, chosen: Sequence[int], own: bool
) -> tuple[np.ndarray, np.ndarray]:
    """True where chosen components of the gradient are certainly wrong, (N, m), and the differences there."""
    w = _directions(_numbers(x), chosen, functions.parts, own)
    size = w.sum(-1)
    wrong, found = _certainly_wrong(functions.value, x, w, size * g[:, list(chosen)])
    return wrong, found / size


def _refuse(functions: Tested, state: Array, k: int, given: float, found: float, g: np.ndarray) -> None:
    value, gradient, _ = functions.names
    if not functions.automatic:
        raise ValueError(
            f"`{gradient}` is not that of `{value}`: at {_shown(functions, state)} its component {k} is {given:g}, "
            f"but `{value}` grows by {found:g} a unit, by differences. Correct one of them; {REMEDY}"
        )
    cut = "is" if not g[:, k].any() else "is in part"
    raise ValueError(
        f"`{value}` {cut} cut off from automatic differentiation: at {_shown(functions, state)} component {k} of its "
        f"gradient is {given:g}, but it grows by {found:g} a unit, by differences. Write it with torch functions "
        f"throughout, without detach(), item() or NumPy, or pass `gradient` as well; {REMEDY}"
    )


def _check_hessian_vector(functions: Tested, x: Array, g: np.ndarray) -> None:
    name = "hessian_vector"
    v, claimed = _products(functions, x, own=False)
    if claimed.shape != g.shape:
        raise ValueError(
            f"`{name}` must return shape {g.shape[1:]}, that of its arguments; got {claimed.shape[1:]}. Write it for "
            f"states on the last axis; {REMEDY}"
        )
    _check_batch(functions, name, x, claimed, _numbers(functions.hessian_vector(x, like(v, x))))
    wrong, found = _certainly_wrong(functions.gradient, x, v[:, None], claimed[:, None])
    if wrong.any():  # a small component may have a scale of its own
        v, claimed = _products(functions, x, own=True)
        still, found = _certainly_wrong(functions.gradient, x, v[:, None], claimed[:, None])
        wrong &= still
    if wrong.any():
        i, _, k = np.argwhere(wrong)[0].tolist()
        raise ValueError(
            f"`{name}` is not the derivative of `{functions.names[1]}`: at {_shown(functions, x[i])}, along v = "
            f"{_short(v[i])}, its component {k} is {claimed[i, k]:g}, but the gradient grows by "
            f"{found[i, 0, k]:g}, by differences. Correct one of them; {REMEDY}"
        )


def _products(functions: Tested, x: Array, own: bool) -> tuple[np.ndarray, np.ndarray]:
    """One random direction at each state, and the given products of the Hessian with them, (N, n) each."""
    v = _directions(_numbers(x), None, 1, own)[:, 0]
    vectors = like(v, x)
    return v, np.stack([_numbers(functions.hessian_vector(x[i], vectors[i])) for i in range(len(x))])


def check_writes(name: str, function: Callable[..., Any], *states: np.ndarray) -> None:
    """Refuse a Numba function (x, …, out) that writes into x, or does not set every number of `out`."""
    found = []
    for fill in (7.0, -3.0):
        out = np.full(states[0].shape, fill)
        copies = [x.copy() for x in states]
        function(*copies, out)
        if not all(np.array_equal(a, b, equal_nan=True) for a, b in zip(copies, states, strict=True)):
            raise ValueError(
                f"`{name}` writes into its argument, the state of the run: it may write into `out` only; {REMEDY}"
            )
        found.append(out)
    apart = np.flatnonzero((found[0] != found[1]) & ~(np.isnan(found[0]) & np.isnan(found[1])))
    if apart.size:
        raise ValueError(
            f"`{name}` does not set out[{apart[0]}] at {_short(states[0])}: it leaves what was there, or adds to it. "
            f"Assign every component, 0.0 where it vanishes; {REMEDY}"
        )


def _shown(functions: Tested, state: Array) -> str:
    at = "" if functions.time is None else f"t = {functions.time:g}, "
    return f"{at}{functions.names[2]} = {_short(_numbers(state))}"


def _short(v: np.ndarray) -> str:
    if v.ndim == 0:
        return f"{float(v):g}"
    shown = ", ".join(f"{x:.6g}" for x in v.ravel()[:8])
    return f"({shown}{', …' if v.size > 8 else ''})"
