"""Compiled runs of splitting schemes with deviation vectors, moved by the exact linearisation of each kick and drift.

The change of p by a kick and its derivative by q are one program, made once; then they serve all vectors: p' = p +
k(q), w_p' = w_p + ∇k w_q, and likewise of a drift. Vectors are scaled by powers of two only, which rounds nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from sympflow.compiler import NotCompiled
from sympflow.compiler.arrange import Arranged
from sympflow.compiler.control import INT, Value
from sympflow.compiler.functions import dot, summed
from sympflow.compiler.program import Program, derivatives, gradient, traced
from sympflow.hamiltonian.formulas import TracedHamiltonian, evaluator
from sympflow.hamiltonian.monomials import Monomials
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.protocol import Batch, RunCheckpoint, Task, run_states
from sympflow.kernels.rollouts import Rollouts, shared
from sympflow.kernels.runs import Room
from sympflow.kernels.splitting_loops import splitting_loops
from sympflow.kernels.splittings import Shape, Splitting, SplittingCode
from sympflow.kernels.stages import StageTable, run_table
from sympflow.kernels.threads import given
from sympflow.lazy import kept
from sympflow.schemes import FORCE_GRADIENT, Scheme

__all__ = ["TangentCode", "TangentKernel", "TangentRun", "step_tangents", "tangent_kernel"]

EVERY = 256  # steps after which vectors are rescaled
AT_ONCE = 1 << 20  # numbers of outputs
LOOKS = 1 << 14  # at all orbits, before those that have ended are left out
MOST_WRITTEN_OUT = 64  # products of all vectors in one stage; more are a loop over the vectors
LOG_2 = float(np.log(2.0))


class TangentRun(NamedTuple):
    """Deviation vectors along N orbits.

    `growth` (N, k, n + 1) are logarithms of lengths after the n counts of steps that were to be saved and at the end,
    NaN where the orbit has ended before; `spread` (N, n + 1) what a function tells of them; `n_steps` (N,) the steps
    made. `whole` (N,) is False where something was not finite any more; then `n_steps` is the last step after which all
    was.
    """

    growth: np.ndarray
    spread: np.ndarray
    n_steps: np.ndarray
    whole: np.ndarray


class Linearised(Shape):
    """A stage with its derivatives, which move vectors.

    Outputs are q', p', ∇k row by row to the diagonal, ∂q'/∂p after the kick and, with friction, ∂p'/∂p of these.
    """

    def linearised(self) -> Arranged:
        """The programs of the stage."""
        made, symbols, d, q = self.made, self.symbols, self.d, self.q
        found = self._by_kick(self.splitting.kick(self.terms, slopes=True))
        momenta = [made.written(x + y) for x, y in zip(self.p, found[:d], strict=True)]
        second = [made.written(made.number(x)) for x in found[d:]]
        kicked, after = momenta, [made.letter(x) for x in momenta]
        ends: list[Any] = []
        if self.splitting.friction is not None:
            mean, decay = map(self._friction, ("mean", "decay"))
            factors = self._mass_times(mean)
            ends = [made.written(made.number(x)) for row in decay for x in row]
            momenta = [made.written(made.number(dot(row, after))) for row in decay]
        elif symbols.inverse_mass is not None:
            factors = self._mass_times([[self.number["a"] if i == j else 0.0 for j in range(d)] for i in range(d)])
        else:
            slopes = self._drift()(*after, *self.values)
            moves = [self.number["a"] * x for x in slopes[:d]]
            factors = [[self.number["a"] * x for x in slopes[d * (i + 1) :][:d]] for i in range(d)]
        slants = [made.written(made.number(x)) for row in factors for x in row]
        if symbols.inverse_mass is None:
            positions = [made.written(x + y) for x, y in zip(q, moves, strict=True)]
        else:
            positions = self._displaced([slants[d * i :][:d] for i in range(d)], kicked)
        return made.finish([*positions, *momenta, *second, *slants, *ends])

    def _drift(self) -> Program:
        """∇T and ∇²T."""
        symbols, d = self.symbols, self.d

        def slopes(*numbers: Any) -> list[Any]:
            p = numbers[:d]
            known = evaluator(dict(zip((*symbols.p, *symbols.parameters), numbers, strict=True)))
            slope = gradient(known(symbols.T), p)
            return [*slope, *(x for row in derivatives(slope, p) for x in row)]

        return traced(slopes, *(s.name for s in (*symbols.p, *symbols.parameters)))

    def _mass_times(self, A: Sequence[Sequence[Any]]) -> list[list[Any]]:
        """M⁻¹A."""
        return [list(row) for row in zip(*(self._by_mass(column) for column in zip(*A, strict=True)), strict=True)]


def _vector_moved(
    d: int, derivatives: Sequence[Any], q: Sequence[Value], p: Sequence[Value]
) -> tuple[list[Any], list[Any]]:
    """A vector (q, p) after a stage, of the derivatives that its program gives after the state."""
    n = d * (d + 1) // 2
    second, slant, end = derivatives[:n], derivatives[n : n + d * d], derivatives[n + d * d :]
    rows = [[second[max(i, j) * (max(i, j) + 1) // 2 + min(i, j)] for j in range(d)] for i in range(d)]  # symmetric
    p = [summed(x, row, q) for x, row in zip(p, rows, strict=True)]
    q = [summed(q[i], slant[d * i : d * (i + 1)], p) for i in range(d)]
    return q, [summed(0.0, end[d * i : d * (i + 1)], p) for i in range(d)] if end else p


class TangentCode(SplittingCode):
    """The compiled functions with k vectors: states are [q, p, w₁ …], then the exponents of vectors if it `grows`."""

    def __init__(self, splitting: Splitting, vectors: int, grows: bool) -> None:
        super().__init__(splitting, chunked=False)
        self.vectors, self._grows, self._given = vectors, grows, (splitting, vectors, grows)
        self._d = d = splitting.symbols.ndof
        self.n_values = self.n_out = 2 * d * (1 + vectors) + (vectors if grows else 0)
        products = d * d + (d if splitting.symbols.inverse_mass is not None else d * d)
        self.room = 0 if vectors * products > MOST_WRITTEN_OUT else None
        self.every = EVERY if grows else None

    @cached_property
    def _kinds(self) -> list[Arranged]:
        return [Linearised(self._splitting, terms, True).linearised() for terms in self._splitting.terms]

    def _executed(self, kind: int, values: Any, column: Sequence[Value]) -> Any:
        d, width = self._d, 2 * self._d
        x = values if isinstance(values, Room) else [*values]
        found = self._kinds[kind].body(*(x[m] for m in range(width)), *column)
        for m in range(width):
            x[m] = found[m]
        for i, _ in self._vectors(values):
            w = [x[i + m] for m in range(width)]
            q, p = _vector_moved(d, found[width:], w[:d], w[d:])
            for m, y in enumerate([*q, *p]):
                x[i + m] = y
        return x

    def _vectors(self, values: Any) -> Iterator[tuple[Any, Any]]:
        """The places of each vector and of its exponent, in a loop where the state is in memory."""
        width = 2 * self._d
        if not isinstance(values, Room):
            yield from ((k * width, (self.vectors + 1) * width + k - 1) for k in range(1, 1 + self.vectors))
            return
        code = values.code
        count = code.op("sdiv", INT, values.size - width, code.constant(width + self._grows, INT))
        with code.over(count) as i:
            yield (i + 1) * width, (count + 1) * width + i

    def look(self, values: Any) -> Any:
        """Divide vectors by the power of two next to their lengths, whose exponents are added up."""
        x = values if isinstance(values, Room) else [*values]
        for i, last in self._vectors(values):
            w, x[last] = _rescaled([x[i + m] for m in range(2 * self._d)], x[last])
            for m, y in enumerate(w):
                x[i + m] = y
        return x


def _rescaled(w: Sequence[Value], exponent: Value) -> tuple[list[Value], Value]:
    """A vector divided by a power of two, and the sum of exponents."""
    length = abs(w[0])
    for x in w[1:]:
        length = length + abs(x)
    n, factor = exponent_of(length)
    return [x * factor for x in w], exponent + n


def exponent_of(length: Value) -> tuple[Value, Value]:
    """The exponent of the power of two next to a length, and 1 over that power."""
    n = (length.bits >> 52) - 1023
    return length.code.convert("sitofp", n, "double"), ((1023 - n) << 52).real


class TangentKernel:
    """Compiled loops of one scheme on one system with k deviation vectors: see `tangent_kernel`."""

    _code: Rollouts

    def __init__(self, system: HamiltonianSystem, scheme: Scheme, vectors: int) -> None:
        self.vectors, self._width = vectors, 2 * system.ndof
        self._loops, self._scheme = splitting_loops(system), scheme
        self._code = tangent_code(system, scheme.level, scheme.monomials, vectors, True)

    def _begun(self, y0: np.ndarray, w0: np.ndarray) -> np.ndarray:
        """The rows to begin with."""
        start = np.zeros((len(y0), self._code.n_out))
        start[:, : self._width], start[:, self._width : -self.vectors] = y0, w0.reshape(-1)
        return start

    def _rollout(self, h: float) -> tuple[Callable[[Batch], None], float]:
        """The runs of batches, and about how many nanoseconds a step takes."""
        table = self._loops.rows(run_table(self._scheme, h), h)
        return partial(self._code.run, table), table.shape[1] * self._code.n_out / 2

    def _vectors(self, states: np.ndarray, times: np.ndarray, w0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Vectors (N, m, k, 2d) of rows (N, m, ·) after times, and the exponents of two in their lengths."""
        k = self.vectors
        return states[..., self._width : -k].reshape(*states.shape[:2], k, self._width), states[..., -k:]

    def run(
        self,
        h: float,
        y0: np.ndarray,
        w0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        spread: Callable[[np.ndarray], np.ndarray] | None = None,
        limit: float = 0.0,
        scale: np.ndarray | None = None,
        threads: int | None = None,
    ) -> TangentRun:
        """`n_steps` steps of length h of every row of `y0` (N, 2d), with vectors `w0` (k, 2d) at the start of each.

        ``spread(W)`` is of vectors (M, 2d, k), times `scale` (2d,); an orbit ends where it is below the `limit`.
        """
        N, k, n = len(y0), self.vectors, self._code.n_out
        start, (rollout, work) = self._begun(y0, w0), self._rollout(h)
        looks = _looks(save, n_steps, limit)
        some = min(64, max(4, LOOKS // N)) if limit > 0 else len(looks)
        growth, spreads = (np.full((*shape, len(save) + 1), np.nan) for shape in ((N, k), (N,)))
        found = TangentRun(growth, spreads, np.full(N, n_steps), np.ones(N, dtype=bool))

        def follow(looks: np.ndarray, rows: np.ndarray, carry: RunCheckpoint) -> np.ndarray:
            """Follow orbits to the last of some looks, into the rows of `found`, and return which have ended (n,)."""
            task = Task(0.0, start[rows], int(looks[-1]), looks, carry, threads=threads)
            run = run_states(rollout, task, self._code.n_values, work)
            with np.errstate(all="ignore"):
                w, exponents = self._vectors(run.states, looks * h, w0)
                w = w if scale is None else w * scale
                growth = LOG_2 * exponents + 0.5 * np.log(np.einsum("nmki,nmki->nmk", w, w))
                W = w.swapaxes(-1, -2).reshape(-1, w.shape[-1], k)
                spreads = np.full(w.shape[:2], np.nan) if spread is None else spread(W).reshape(w.shape[:2])
            known = looks <= run.n_finite[:, None]
            below = known & (spreads < limit)
            last = np.where(below.any(1), below.argmax(1), len(looks) - 1)
            known &= np.arange(len(looks)) <= last[:, None]
            first, end = np.searchsorted(save, [looks[0], looks[-1] + 1])
            where, each = np.searchsorted(looks, save[first:end]), np.arange(len(rows))
            if len(where):
                columns = np.arange(first, end)
                found.growth[rows[:, None], :, columns] = np.where(known[:, where, None], growth[:, where], np.nan)
                found.spread[rows[:, None], columns] = np.where(known[:, where], spreads[:, where], np.nan)
            failed = ~below.any(1) & (run.n_finite < looks[-1])
            found.growth[rows, :, -1] = np.where(failed[:, None], np.nan, growth[each, last])
            found.spread[rows, -1] = np.where(failed, np.nan, spreads[each, last])
            found.n_steps[rows] = np.where(failed, run.n_finite, looks[last])
            found.whole[rows] = ~failed
            return failed | below.any(1)

        size = max(64, AT_ONCE // (n * some))
        for first in range(0, N, size):
            rows, carry = np.arange(first, min(first + size, N)), RunCheckpoint()
            for i in range(0, len(looks), some):
                ended = follow(looks[i : i + some], rows, carry)
                if ended.any():
                    rows, carry.running, carry.spare = rows[~ended], carry.running[~ended], None
                if not len(rows):
                    break
        return found


def _looks(save: np.ndarray, n_steps: int, limit: float) -> np.ndarray:
    """The steps after which orbits are looked at: those to be saved, the last, and where there is a limit others."""
    ends = save if len(save) and save[-1] == n_steps else np.append(save, n_steps)
    if limit <= 0:
        return ends
    return np.concatenate([[*range(a + EVERY, b, EVERY), b] for a, b in pairwise([0, *ends.tolist()])])


@kept
def tangent_code(system: HamiltonianSystem, level: int, monomials: Monomials, vectors: int, grows: bool) -> TangentCode:
    """The compiled functions of a system with k vectors, made once; raises NotCompiled if there are none."""
    lacks = _lacks(system)
    if lacks:
        raise NotCompiled(lacks)
    splitting = splitting_loops(system).splitting(level, monomials)
    code: TangentCode = shared((splitting.key, vectors, grows), lambda: TangentCode(splitting, vectors, grows))
    return code


@kept
def _lacks(system: HamiltonianSystem) -> str:
    """The reason why a system has no compiled vectors, "" if it has."""
    if system.form is None or isinstance(system.form, TracedHamiltonian):
        given = system.local is not None or system.form is not None
    else:
        from sympflow.kernels.terms import is_long

        given = not is_long(system.symbols, FORCE_GRADIENT)
    loops = splitting_loops(system) if given else None
    if loops is not None and loops.driven:
        return f"`system` {system.name!r} depends on t, for which vectors are moved by arrays."
    if loops is None or not loops.traced:
        return (
            f"`system` {system.name!r} has no compiled deviation vectors, which are made for symbolic systems of "
            "few terms: use backend='auto'."
        )
    return ""


def tangent_kernel(system: HamiltonianSystem, scheme: Scheme, vectors: int) -> TangentKernel:
    """The compiled loops of a scheme with k deviation vectors; a ValueError says why there are none."""
    return TangentKernel(system, scheme, vectors)


def step_tangents(
    system: HamiltonianSystem, table: StageTable, x: np.ndarray, h: np.ndarray, y: np.ndarray, monomials: Monomials = ()
) -> tuple[np.ndarray, np.ndarray] | None:
    """The steps from rows of `y` (N, 2d) and their Jacobians (N, 2d, 2d); None where they are not compiled."""
    if system.friction:
        return None
    n = y.shape[1]
    try:
        code = tangent_code(system, table.level, monomials, n, False)
    except NotCompiled:
        return None
    rows = np.empty((len(y), n * (1 + n)))
    rows[:, :n], rows[:, n:] = y, np.eye(n).reshape(-1)
    out = np.empty_like(rows)
    code.step_rows(splitting_loops(system).rows(table), given(x), given(h), given(h), rows, out)
    return out[:, :n], out[:, n:].reshape(-1, n, n).swapaxes(1, 2)
