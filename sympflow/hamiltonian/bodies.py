"""Bodies that interact in pairs, any number of them, by the potential of one pair."""

from __future__ import annotations

import copy
import math
import reprlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Self

import numpy as np
import sympy as sp

from sympflow.arguments import plain, real_number
from sympflow.arrays import Array, is_tensor, to_numpy
from sympflow.hamiltonian.local import LocalHamiltonian, check_memory, letters, parsed

MOST_AXES = 3
MOST_NEAR = 300
"""About how many bodies each is compared with where there are cells."""
MOST_PAIRS = 1_000_000
"""Pairs whose values stand in memory at a time."""


class PairsHamiltonian(LocalHamiltonian):
    """H = Σ_i |p_i|²/2m_i + Σ_{i<j} V(r_ij), see `HamiltonianSystem.pairs`.

    Positions (..., d) are [q_1, …, q_n], `dim` coordinates each.

    Attributes
    ----------
    n_bodies, dim : int
    masses : ndarray of shape (n,)
    box : ndarray of shape (dim,) or None
    cutoff : float or None
    softening : float
    V : Expr
        In the letters `s` = r², `first`, `second` and `c`.
    columns : ndarray of shape (k, n)
        The quantities of bodies that V depends on.
    first, second : tuple of Symbol
        Their letters, of the two bodies of a pair.
    c : tuple of Symbol
        Letters of the parameters, whose values are `constants`.
    """

    loops = "pairs"
    quadratic_kinetic = True

    def __init__(
        self,
        potential: str | sp.Expr,
        masses: Any,
        dim: Any,
        box: Any,
        cutoff: Any,
        softening: Any,
        params: Mapping[str, Any] | None,
        bodies: Mapping[str, Any] | None,
    ) -> None:
        self.dim = _checked_dim(dim)
        self.masses = _checked_column("masses", masses)
        if not (self.masses > 0).all():
            i = int(np.argmin(self.masses))
            raise ValueError(f"`masses` must be positive; that of body {i} is {self.masses[i]:g}: change it.")
        self.n_bodies = len(self.masses)
        if self.n_bodies < 2:
            raise ValueError("`masses` must be those of two bodies or more, an array (n,).")
        check_memory(float(self.n_bodies) * self.dim, "`masses`")
        self.ndof = self.n_bodies * self.dim
        self.box, self.cutoff = _checked_box(box, self.dim), _checked_length("cutoff", cutoff)
        self.softening = _checked_length("softening", softening) or 0.0
        if self.cutoff is not None and self.box is not None and self.cutoff > self.box.min() / 2:
            raise ValueError(
                f"`cutoff` {self.cutoff:g} is longer than half the box, {self.box.min() / 2:g}: a body would meet "
                "another and its image. Take a shorter one, or a larger `box`."
            )
        self.params = _checked_params(params)
        self._read(potential, {"m": self.masses, **self._checked_bodies(bodies)})
        mass = np.repeat(1 / self.masses, self.dim)
        self.inverse_mass = None if (mass == 1).all() else mass

    def _checked_bodies(self, bodies: Any) -> dict[str, np.ndarray]:
        if not isinstance(bodies, Mapping | None):
            raise TypeError(f"`bodies` must be a mapping of names to arrays; got {type(bodies).__name__}: pass a dict.")
        columns = {}
        for name, given in (bodies or {}).items():
            if not isinstance(name, str) or not name.isidentifier():
                raise ValueError(f"`bodies` must have names as keys; got {name!r}.")
            columns[name] = _checked_column(f"bodies[{name!r}]", given)
            if columns[name].shape != self.masses.shape:
                raise ValueError(
                    f"`bodies` has {name} of {columns[name].size} values, and there are {self.n_bodies} `masses`: give "
                    "one for each body."
                )
            if name == "m" and not np.array_equal(columns[name], self.masses):
                raise ValueError("`bodies` has m, which stands for the `masses`: rename it.")
        return columns

    def _read(self, potential: Any, columns: Mapping[str, np.ndarray]) -> None:
        r, self.s = sp.Symbol("r", positive=True), sp.Symbol("s", positive=True)
        first, second = letters("a", tuple(columns)), letters("b", tuple(columns))
        c = letters("c", tuple(self.params))
        names: dict[str, sp.Symbol] = {"r": r}
        for name, a, b in zip(columns, first, second, strict=True):
            names |= {f"{name}1": a, f"{name}2": b}
        for name, letter in zip(self.params, c, strict=True):
            if name in names:
                raise ValueError(f"`params` gives a value to {name!r}, which is of bodies or pairs: rename it.")
            names[name] = letter
        V = parsed("potential", potential, names, "-G*m1*m2/r")
        if r not in V.free_symbols:
            raise ValueError(f"`potential` must depend on r, the distance of two bodies; got {V}.")
        for name, letter in zip(self.params, c, strict=True):
            if letter not in V.free_symbols:
                raise ValueError(f"`params` has {name!r}, which the potential does not use: remove it.")
        used = [bool({a, b} & V.free_symbols) for a, b in zip(first, second, strict=True)]
        for name, is_used in zip(columns, used, strict=True):
            if name != "m" and not is_used:
                raise ValueError(f"`bodies` has {name!r}, and V uses neither {name}1 nor {name}2: remove it.")
        exchanged = V.xreplace(dict(zip((*first, *second), (*second, *first), strict=True)))
        if sp.simplify(V - exchanged) != 0:
            raise ValueError(
                "`potential` must be the same with the two bodies exchanged, those of 1 for those of 2; got "
                f"{potential}. Take a sum or a product of both."
            )
        self.first = tuple(a for a, is_used in zip(first, used, strict=True) if is_used)
        self.second = tuple(b for b, is_used in zip(second, used, strict=True) if is_used)
        self.columns = np.array([x for x, is_used in zip(columns.values(), used, strict=True) if is_used])
        self.columns = self.columns.reshape(-1, self.n_bodies)
        self.c, self.constants = c, tuple(self.params.values())
        V = V.subs(r, sp.sqrt(self.s))
        if self.cutoff is not None:
            end = sp.Symbol("end", positive=True)
            slope = sp.diff(V, self.s).subs(self.s, end)
            V = V - V.subs(self.s, end) - (self.s - end) * slope
            self.c, self.constants = (*self.c, end), (*self.constants, self.cutoff**2 + self.softening**2)
        self.V = V

    def with_params(self, values: Mapping[str, Any]) -> Self:
        self.check_names(values)
        other = copy.copy(self)
        other.params = _checked_params({**self.params, **values})
        other.constants = (*other.params.values(), *self.constants[len(self.params) :])
        return other

    @property
    def work(self) -> int:
        pairs = self.n_bodies * (self.n_bodies - 1) // 2
        return 2 * (pairs if self.cutoff is None else min(pairs, MOST_NEAR * self.n_bodies))

    @property
    def slopes(self) -> list[sp.Expr]:
        """V, 2V′, 4V″ and 8V‴, derivatives by s."""
        return [2**k * sp.diff(self.V, self.s, k) if k else self.V for k in range(4)]

    # array functions, positions (..., d) ------------------------------------------------------------------------------

    def potential(self, q: Array) -> Array:
        total: Any = 0 * q[..., 0]
        for pairs in self._pairs(q):
            total = total + pairs.values(0).sum(-1)
        return total

    def potential_gradient(self, q: Array) -> Array:
        return self._forces(lambda pairs: pairs.values(1)[..., None] * pairs.x[0], q)

    def hessian_vector(self, q: Array, v: Array, *t: Array) -> Array:
        def product(pairs: Pairs) -> Array:
            x, w = pairs.x
            return pairs.values(1)[..., None] * w + (pairs.values(2) * (x * w).sum(-1))[..., None] * x

        return self._forces(product, q, v)

    def third_derivative(self, q: Array, v: Array, w: Array, *t: Array) -> Array:
        def product(pairs: Pairs) -> Array:
            x, a, b = pairs.x
            xa, xb, ab = ((y * z).sum(-1) for y, z in ((x, a), (x, b), (a, b)))
            two, three = pairs.values(2), pairs.values(3)
            along = (three * xa * xb + two * ab)[..., None] * x
            return along + (two * xa)[..., None] * b + (two * xb)[..., None] * a

        return self._forces(product, q, v, w)

    def energy_density(self, y: Array, *t: Array) -> Array:
        q, p = y[..., : self.ndof], self._of_bodies(y[..., self.ndof :])
        masses = self._like(self.masses, y)
        density = (p * p).sum(-1, keepdims=True) / (2 * masses[:, None])
        for pairs in self._pairs(q):
            half = pairs.values(0)[..., None] / 2
            density = _added(_added(density, pairs.i, half), pairs.j, half)
        return density[..., 0]

    def remark(self, q: np.ndarray) -> str:
        from scipy.spatial import cKDTree

        x = self._in_box(q.reshape(self.n_bodies, self.dim))
        distances, neighbours = cKDTree(x, boxsize=self.box).query(x, 2)
        i = int(np.argmin(distances[:, 1]))
        i, j = sorted({i, *neighbours[i].tolist()})[:2]
        apart = distances[:, 1].min()
        if apart > 0:
            return f"the nearest bodies, {i} and {j}, are {apart:.3g} apart: take shorter steps, or `softening`."
        return f"the bodies {i} and {j} are at one place, r = 0: pass `softening`, or another `y0`."

    def _in_box(self, x: np.ndarray) -> np.ndarray:
        """Places (n, dim) inside of the box."""
        if self.box is None:
            return x
        x = np.mod(x, self.box)
        return np.where(x >= self.box, 0.0, x)  # of a rounding

    # how pairs are met ------------------------------------------------------------------------------------------------

    def _of_bodies(self, q: Array) -> Array:
        return q.reshape(*q.shape[:-1], self.n_bodies, self.dim)

    def _like(self, values: Any, like: Array) -> Any:
        if not is_tensor(like):
            return np.asarray(values, dtype=like.dtype)
        import torch

        return torch.as_tensor(values, dtype=like.dtype, device=like.device)

    def _forces(self, value: Callable[[Pairs], Array], *arrays: Array) -> Array:
        """The sum over the pairs of each body of values (..., P, dim), those of its second ends with the other sign."""
        q = arrays[0]
        out: Any = 0 * self._of_bodies(sum(arrays[1:], q))
        for pairs in self._pairs(*arrays):
            f = value(pairs)
            out = _added(_added(out, pairs.i, f), pairs.j, -f)
        return out.reshape(*out.shape[:-2], self.ndof)

    def _pairs(self, *arrays: Array) -> Iterator[Pairs]:
        """The pairs that interact, in pieces that fit into memory; with a cut-off those of any state of a batch."""
        shape = np.broadcast_shapes(*(x.shape for x in arrays))
        bodies = [self._of_bodies(x) for x in arrays]
        most = max(1, MOST_PAIRS // max(1, math.prod(shape[:-1])))
        for i, j in self._ends(to_numpy(bodies[0]), most):
            yield Pairs(self, i, j, [self._between(x, i, j, k == 0) for k, x in enumerate(bodies)])

    def _between(self, x: Array, i: np.ndarray, j: np.ndarray, positions: bool) -> Array:
        difference = x[..., i, :] - x[..., j, :]
        if positions and self.box is not None:
            box = self._like(self.box, x)
            difference = difference - box * (difference / box).round()
        return difference

    def _ends(self, q: np.ndarray, most: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Indices i < j of pairs, `most` at a time, of all states q (..., n, dim) together."""
        n = self.n_bodies
        if self.cutoff is not None:
            near = self._within_cutoff(q.reshape(-1, n, self.dim))
            for start in range(0, len(near), most):
                yield near[start : start + most, 0], near[start : start + most, 1]
            return
        rows = max(1, most // n)
        for start in range(0, n - 1, rows):
            i, j = np.triu_indices(min(rows, n - 1 - start), 1, n - start)
            yield i + start, j + start

    def _within_cutoff(self, states: np.ndarray) -> np.ndarray:
        """The pairs (P, 2) that are nearer than the cut-off in one of the states (N, n, dim) at least."""
        from scipy.spatial import cKDTree

        found = []
        for x in np.where(np.isfinite(states), states, 0.0):
            found.append(cKDTree(self._in_box(x), boxsize=self.box).query_pairs(self.cutoff, output_type="ndarray"))
        return found[0] if len(found) == 1 else np.unique(np.concatenate(found), axis=0)


class Pairs:
    """Pairs of bodies, with the differences x of several arrays, the first of positions, between their ends."""

    def __init__(self, local: PairsHamiltonian, i: np.ndarray, j: np.ndarray, x: list[Array]) -> None:
        self.local, self.i, self.j, self.x = local, i, j, x
        self.s = (x[0] * x[0]).sum(-1) + local.softening**2

    def values(self, k: int) -> Array:
        """2ᵏ times the k-th derivative of V by s, 0 beyond the cut-off: (..., P)."""
        local, s = self.local, self.s
        columns = [column[ends] for ends in (self.i, self.j) for column in local.columns]
        given = [local._like(x, s) for x in (*columns, *local.constants)]
        variables = (local.s, *local.first, *local.second, *local.c)
        with np.errstate(all="ignore"):  # bodies at one place
            value = local._values(f"potential {k}", lambda: [local.slopes[k]], variables, s, *given)[0] + 0 * s
        if local.cutoff is None:
            return value
        outside = s >= local.cutoff**2 + local.softening**2
        return value.masked_fill(outside, 0.0) if is_tensor(s) else np.where(outside, 0.0, value)


def _added(out: Array, ends: np.ndarray, values: Array) -> Array:
    """`out` (..., n, k) with values (..., P, k) added at the bodies `ends` (P,)."""
    if is_tensor(out):
        import torch

        return out.index_add(-2, torch.as_tensor(ends, device=out.device), values.expand(*out.shape[:-2], -1, -1))
    *lead, n, k = out.shape
    many = math.prod(lead)
    values = np.broadcast_to(values, (*lead, len(ends), k))
    places = np.add.outer(np.add.outer(n * k * np.arange(many), k * ends), np.arange(k))
    sums = np.bincount(places.ravel(), weights=values.ravel(), minlength=many * n * k)
    return out + sums.reshape(out.shape).astype(out.dtype)


def _checked_dim(dim: Any) -> int:
    dim = plain(dim)
    if not isinstance(dim, int) or isinstance(dim, bool) or not 1 <= dim <= MOST_AXES:
        raise ValueError(f"`dim` must be 1, 2 or 3, the coordinates of a body; got {dim!r}.")
    return dim


def _checked_column(name: str, values: Any) -> np.ndarray:
    check_memory(float(np.size(values)), f"`{name}`")
    try:
        array = np.array(plain(values), dtype=float)
    except (TypeError, ValueError):
        raise TypeError(f"`{name}` must be an array (n,) of numbers; got {reprlib.repr(values)}.") from None
    if array.ndim != 1:
        raise ValueError(f"`{name}` must have shape (n,), one number for each body; got {array.shape}.")
    if not np.isfinite(array).all():
        raise ValueError(f"`{name}` must be finite; that of body {int(np.argmin(np.isfinite(array)))} is not.")
    array.setflags(write=False)
    return array


def _checked_length(name: str, value: Any) -> float | None:
    if value is None:
        return None
    value = plain(value)
    if not real_number(value) or not 0 <= value < math.inf or (name == "cutoff" and value == 0):
        raise ValueError(f"`{name}` must be a positive, finite length; got {value!r}.")
    return float(value)


def _checked_box(box: Any, dim: int) -> np.ndarray | None:
    if box is None:
        return None
    try:
        lengths = np.array(plain(box), dtype=float)
        lengths = np.broadcast_to(lengths, (dim,)).copy()
    except (TypeError, ValueError):
        raise ValueError(f"`box` must be a length, or {dim} of them, one along each axis; got {box!r}.") from None
    if not (np.isfinite(lengths) & (lengths > 0)).all():
        raise ValueError(f"`box` must have positive, finite lengths; got {box!r}.")
    return lengths


def _checked_params(params: Any) -> dict[str, float]:
    if not isinstance(params, Mapping | None):
        raise TypeError(f"`params` must be a mapping of names to numbers; got {type(params).__name__}: pass a dict.")
    checked = {}
    for name, given in (params or {}).items():
        if not isinstance(name, str) or not name.isidentifier():
            raise ValueError(f"`params` must have names as keys; got {name!r}.")
        value = plain(given)
        if not real_number(value) or not math.isfinite(value):
            raise ValueError(
                f"`params` has {name} = {reprlib.repr(given)}: give a finite real number; what differs from body to "
                "body goes to `bodies`."
            )
        checked[name] = float(value)
    return checked
