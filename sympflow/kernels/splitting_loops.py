"""Compiled loops of splitting schemes: any scheme on one system."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from typing import TYPE_CHECKING, Any, cast
from weakref import ref

import numpy as np
from numpy.typing import ArrayLike

from sympflow.compiler import NotCompiled, arrays_only
from sympflow.hamiltonian.formulas import TracedDriving, TracedHamiltonian
from sympflow.hamiltonian.monomials import Monomials
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.one_steps import check_size
from sympflow.kernels.protocol import Kernel, Run, Steps, Task, run_states
from sympflow.kernels.stages import StageTable, check_damping, run_table, step_table
from sympflow.kernels.threads import given
from sympflow.lazy import kept
from sympflow.schemes import CURVATURE, FORCE_GRADIENT, POLYNOMIAL, Scheme

if TYPE_CHECKING:
    from sympflow.kernels.approximations import Ranges
    from sympflow.kernels.reverse import Chained, Recorded
    from sympflow.kernels.rollouts import SplittingRollouts
    from sympflow.kernels.splittings import Splitting
    from sympflow.kernels.stage_times import Driving


@kept
def splitting_loops(system: HamiltonianSystem, names: tuple[str, ...] = ()) -> SplittingLoops:
    """The compiled loops on a separable system, whose `values` may be those of `names`; or NotCompiled."""
    return SplittingLoops(system, names)


def _traced_form(system: HamiltonianSystem, names: tuple[str, ...]) -> Any:
    """The program of functions, with parameters of these names, or numbers that torch follows as such."""
    form = system.form if system.numbered is None or not names else system.numbered
    if form is not system.form and system.friction:
        raise arrays_only(f"`system` {system.name!r} has friction, and numbers that torch follows")
    return form.named(names) if names and form is not None else form


LANES_OF_SUMS, LANES = 16.0, 2.0
"""By how much less a kick takes in a batch than `SplittingLoops.work`: of sums and products alone, and of functions."""


class SplittingLoops:
    """Compiled loops that run any `Scheme` on one separable system; states are [q, p], float64.

    Of what depends on parameters of H alone `values` are arguments of the loops, so that systems which differ in them
    share these; with friction and force gradients they are part of the code, unless H depends on t or trajectories have
    their own. A kick takes about `work` nanoseconds, by `abreast` less in a batch, whose lanes run side by side.
    """

    def __init__(self, system: HamiltonianSystem, names: tuple[str, ...] = ()) -> None:
        symbols: Any = None if isinstance(system.form, TracedHamiltonian) else system.form
        if names and symbols is not None:
            symbols = symbols.named(names)
        if system.local is not None and system.local.in_terms and not system.local.arrays_only:
            symbols = system.local.spelled
        self.ndof, self.friction = system.ndof, system.friction
        self.values: tuple[float, ...] = ()
        self.work = system.ndof if system.local is None else system.local.work
        self._has_ranges = self.traced = self._large = False
        self._form: Any = system.form if symbols is None else symbols
        self._driving: Driving | TracedDriving | None = None
        self._written: Callable[..., Splitting] | None = None
        self._compile: Callable[..., SplittingRollouts]
        self._damped_numbers: tuple[Any, np.ndarray] = None, np.empty(0)  # of the latest steps that are all alike
        self.tensors: Sequence[Any] = ()
        self.abreast = 1.0
        self.driven = not system.autonomous
        if not (system.separable if symbols is None else symbols.separable):
            raise NotCompiled("`system` is not separable, so no splitting method applies: use 'gauss_legendre6'.")
        if symbols is not None:
            from sympflow.hamiltonian.recorded import check_recorded  # SymPy, which Numba functions do without
            from sympflow.kernels.terms import is_large

            self._has_force_gradient = system.quadratic_kinetic
            self._large = is_large(symbols.structure)
            check_damping(system, self._large)
            if self.driven:
                from sympflow.kernels.stage_times import driven_form

                self._driving = driven_form(symbols if self._large else symbols.parametric)
                if self._large and self._driving.means:
                    raise arrays_only("`system` has many terms and a kinetic energy that depends on t")
                self._driving.check()
                self._form = self._driving.form
                self.values, self.traced = self._form.values, True
                self.abreast = LANES
            else:
                V = symbols.structure.V
                check_recorded(V)
                check_recorded(symbols.structure.T)
                self.values = symbols.parametric.values
                self._has_ranges, self.traced = not self._large, True
                sums = V is not None and not self._large and V.is_polynomial(*symbols.q)
                self.abreast = LANES_OF_SUMS if sums else LANES
        elif isinstance(form := _traced_form(system, names), TracedHamiltonian) and system.layered is None:
            check_size(form)
            check_damping(system, False)
            self._has_force_gradient = self.traced = True
            self._form, self.values, V = form, form.parametric.values, form.V
            self.abreast = LANES_OF_SUMS if V is not None and V.is_polynomial() and not self.driven else LANES
            self._has_ranges = form.text is not None and self.ndof == 1 and not form.V.is_polynomial()
            if self.driven:
                driving = self._driving = form.parametric.driving
                self._form = driving.form
        elif system.numba_functions is not None:
            _, gradient, hessian_vector = system.numba_functions
            self._has_force_gradient = hessian_vector is not None
            check_damping(system, True)
            from sympflow.kernels.array_splittings import function_code

            given = gradient, hessian_vector, system.inverse_mass, self.driven
            ndim = None if system.damping is None else system.damping.ndim
            self._compile = partial(function_code, system.ndof, *given, ndim)
        elif system.local is not None:
            local: Any = system.local  # of the class that `loops` names
            if system.damping is not None and system.damping.ndim:
                raise arrays_only(f"`system` {system.name!r} has friction, and its loops take one rate for all momenta")
            if local.arrays_only:
                raise arrays_only(f"`system` has {local.arrays_only}, whose kicks are array operations")
            if local.loops == "pairs":
                from sympflow.kernels.pairs import PairCode, few

                self._written, self.values = few(local)
                self._compile = partial(PairCode, local, bool(system.friction))
            else:
                from sympflow.kernels.lattices import LatticeCode

                self._compile = partial(LatticeCode, local, bool(system.friction))
            self._has_force_gradient = system.quadratic_kinetic
            self.traced = self._written is not None
        elif system.layered is not None:
            if system.friction:
                raise arrays_only(f"`system` {system.name!r} has friction, and weights that torch follows")
            self._has_force_gradient, self.tensors = False, system.layered.tensors
            self.work = system.layered.n_weights
            from sympflow.kernels.layered_splittings import LayeredCode

            self._compile = partial(LayeredCode, system.layered)
        else:
            raise NotCompiled(
                f"`system` cannot be compiled, because its functions could not be traced: {system.untraced}. Change "
                "them, "
                "or define it with HamiltonianSystem.from_sympy, or use backend='array'."
            )
        self._system: ref[HamiltonianSystem] | None = ref(system)  # which keeps these loops
        others = FORCE_GRADIENT if system.local is None else CURVATURE
        self._highest = others if system.form is None else POLYNOMIAL
        self._variants: dict[tuple[int, bool, Monomials, bool, Ranges | None], SplittingRollouts] = {}

    def __getstate__(self) -> dict[str, Any]:
        """The attributes, with the ranges, for which the system would be asked."""
        return vars(self) | {"_ranges": self._ranges, "_system": None}

    def kernel(self, scheme: Scheme, compensated: bool = False, ranges: Ranges | None = None) -> SplittingKernel:
        """The loops of one scheme, with Kahan's `compensated` sums; for `ranges` of positions see `functions`."""
        return SplittingKernel(self, scheme, compensated, ranges)

    def takes_values(self, level: int, ranges: Ranges | None = None, varied: bool = False) -> bool:
        """True if the values of the system's parameters are numbers of the kicks of a level, not of their code."""
        return bool(self.values) and not ranges and (varied or not self._long(level))

    def functions(
        self,
        level: int,
        compensated: bool,
        monomials: Monomials = (),
        varied: bool = False,
        ranges: Ranges | None = None,
    ) -> SplittingRollouts:
        """The compiled functions for kicks of a level, `varied` with own values, in `ranges` by polynomials."""
        variant = (level, compensated, monomials, varied, ranges)
        if variant in self._variants:
            return self._variants[variant]
        if level in (FORCE_GRADIENT, CURVATURE) and not self._has_force_gradient:
            raise NotCompiled(
                "`scheme` has force gradients, which need a kinetic energy quadratic in p and, for a system of Numba "
                "functions, `hessian_vector`: take a scheme without them, for instance 'kahan_li8'."
            )
        if level > self._highest:
            what = "curvature terms" if level == CURVATURE else "polynomials"
            raise NotCompiled(f"`scheme` has {what}, which need a symbolic system: take one without them.")
        made: SplittingRollouts
        if not self.traced:
            made = self._compile(level, compensated, monomials)
        elif not varied and self._long(level):
            from sympflow.kernels.array_splittings import term_code

            made = term_code(self.splitting(level, monomials, compensated, parametric=False))
        else:
            from sympflow.kernels.rollouts import shared
            from sympflow.kernels.splittings import SplittingCode

            splitting = self.splitting(level, monomials, compensated, ranges or ())
            made = shared(splitting.key, lambda: SplittingCode(splitting))
        self._variants[variant] = made
        return made

    def _long(self, level: int) -> bool:
        """True of stages that are loops over the terms of H."""
        if not self._large or not self.traced:
            return False
        from sympflow.kernels.terms import is_long

        return is_long(self._form, level)

    def splitting(
        self,
        level: int,
        monomials: Monomials = (),
        compensated: bool = False,
        ranges: Ranges = (),
        parametric: bool = True,
    ) -> Splitting:
        """The kicks and drifts of a level, of a system whose loops are made of traced numbers."""
        from sympflow.kernels.splittings import Splitting

        ndim, driving = self.friction.kind, self._driving
        if self._written is not None:
            return self._written(level, monomials, compensated, ndim)
        form = self._form
        symbols = form.parametric if parametric and driving is None and not ranges else form
        return Splitting(symbols, level, monomials, compensated, ndim, driving, ranges)

    def kick_cycles(self, level: int, ranges: Ranges = ()) -> float:
        """About how long a single trajectory takes for a kick of a level and a drift, in cycles."""
        if self._long(level):
            return float(self._form.V.count_ops() * (1 + level))
        return self.splitting(level, ranges=ranges).cycles

    def ranges(self, level: int, compensated: bool) -> Ranges | None:
        """The positions of the system's domain, for `functions` of a flow: none where they would change nothing."""
        if compensated or not self._has_ranges:
            return None
        return self._ranges if level in (FORCE_GRADIENT, CURVATURE) else ()

    @cached_property
    def _ranges(self) -> Ranges:
        system = None if self._system is None else self._system()
        if not self._has_ranges or system is None or system.domain is None:
            return ()
        from sympflow.kernels.approximations import position_ranges

        return position_ranges(system.form, system.domain)

    def rows(
        self, table: StageTable, h: float = 1.0, t0: float = 0.0, varied: bool = False, ranges: Ranges | None = None
    ) -> np.ndarray:
        """The numbers of a table that the loops read, with values, maps of friction, the times of a driven system."""
        if self.friction:
            table = _damped(table, self.friction)
        if self.driven:
            return table.timed_rows(self.values, h, t0)
        return table.rows(self.values if varied or self.takes_values(table.level, ranges) else ())

    def step_rows(
        self,
        table: StageTable,
        x: np.ndarray,
        h: np.ndarray,
        y: np.ndarray,
        monomials: Monomials = (),
        t: ArrayLike = 0.0,
        varied: bool = False,
        ranges: Ranges | None = None,
        rows: np.ndarray | None = None,
    ) -> np.ndarray:
        """One step from each row of `y` (N, 2d), each of its own length `h` (N,), at times t, and by its own numbers.

        These are, for h = 1, polynomials Σ_k table[:, k] x[i]^k; in a batch K is 1 or at least 3. If `varied`, values
        of parameters follow each state in its row. `rows` are those of the table, where the caller keeps them.
        """
        y, x, h = given(y), given(x), given(h)
        functions = self.functions(table.level, False, monomials, varied, ranges)
        if self.friction:
            return self._damped_rows(functions, table, x, h, y, np.broadcast_to(t, h.shape), varied)
        out = np.empty((len(y), 2 * self.ndof))
        t = given(np.broadcast_to(t, h.shape)) if self.driven else h
        rows = self.rows(table, varied=varied, ranges=ranges) if rows is None else rows
        functions.step_rows(rows, x, h, t, y, out)
        return out

    def _damped_rows(
        self,
        functions: SplittingRollouts,
        table: StageTable,
        x: np.ndarray,
        h: np.ndarray,
        y: np.ndarray,
        t: np.ndarray,
        varied: bool,
    ) -> np.ndarray:
        """`step_rows` with friction, whose numbers are not polynomials: by one table, or one for each row."""
        alike = len(y) > 0 and not varied and bool((h == h[0]).all() and (t == t[0]).all())
        rows, key = slice(0, 1 if alike else len(y)), (table, x[0], h[0], t[0]) if alike else None
        known, numbers = self._damped_numbers
        if key is None or key != known:
            numbers = self._damped_table(table, x[rows], h[rows], y, t[rows], varied)
        if key is None:
            return functions.own_steps(numbers, y[:, : 2 * self.ndof])
        self._damped_numbers = key, numbers
        out = np.empty_like(y)
        functions.mapped(numbers, y, out)
        return out

    def _damped_table(
        self, table: StageTable, x: np.ndarray, h: np.ndarray, y: np.ndarray, t: np.ndarray, varied: bool
    ) -> np.ndarray:
        """The numbers of steps with friction, of each stage those of all rows."""
        own, m = table.valued(x, h).damped(self.friction), len(table.drifts)
        values: Sequence[Any] = [*np.tile(y[:, 2 * self.ndof :].T, m)] if varied else self.values
        if self.driven:
            return own.timed_rows(values, np.tile(h, m), np.tile(t, m))
        return own.with_constants(values if varied or self.takes_values(table.level) else ())


class SplittingKernel(Kernel):
    """The compiled loops of one scheme on one system, a `Kernel`: see `SplittingLoops.kernel`.

    With `values` (k, N) the loops of batches of N trajectories with own values, or of several such batches in turn: the
    steps of a system with these, up to rounding where products of values are part of the code there.
    """

    def __init__(
        self,
        loops: SplittingLoops,
        scheme: Scheme,
        compensated: bool = False,
        ranges: Ranges | None = None,
        values: np.ndarray | None = None,
    ) -> None:
        self.loops, self.scheme, self.compensated, self._ranges = loops, scheme, compensated, ranges
        self._width, self.tensors = 2 * loops.ndof * (1 + compensated), loops.tensors
        self._values = None if values is None else np.ascontiguousarray(values.T, dtype=np.float64)
        self._of_kind: Any = {"varied": values is not None, "ranges": ranges}
        self._latest: np.ndarray | None = None
        self._code: Any = loops.functions(scheme.level, compensated, scheme.monomials, **self._of_kind)

    def table(self, h: float, t0: float = 0.0) -> np.ndarray:
        """The numbers of a run whose steps are h, as the loops read them; of a driven system from a time t0 on."""
        return self.loops.rows(run_table(self.scheme, h), h, t0, **self._of_kind)

    def runs(self, task: Task) -> Run:
        table, start = self.table(task.h, task.t0), self._rows(task)
        work = table.shape[1] * self.loops.work / (self.loops.abreast if len(task.y0) > 1 else 1.0)
        return run_states(partial(self._code.run, table), task, self._width, work, start)

    def step(self, h: ArrayLike, y: np.ndarray, t: ArrayLike = 0.0) -> Steps:
        """One step from each row of `y` (N, 2d), each of its own length `h` (N,): see `Kernel`."""
        h, rows = np.asarray(h, dtype=np.float64), self._with_values(y)
        h = h.repeat(len(y)) if h.ndim == 0 else h
        varied = self._values is not None
        return Steps(self.loops.step_rows(step_table(self.scheme), h, h, rows, self.scheme.monomials, t, varied))

    def check_reverse(self) -> None:
        self._code.check_reverse()

    def recorded(self, task: Task) -> Chained | Recorded:
        """`runs`, as a run whose cotangents can be pulled back: after `check_reverse`."""
        from sympflow.kernels.reverse import Recorded

        table, rows = self.table(task.h, task.t0), self._rows(task)
        if (own := self._code.chained(self, task, table)) is not None:
            return cast("Chained", own)
        work = table.shape[1] * self.loops.work / self.loops.abreast
        return Recorded(self._code, table, task.y0 if rows is None else rows, task.n_steps, task.save, work)

    @property
    def steps_tensors(self) -> bool:
        return not self.loops.friction

    def stepped(self, y: Any, h: Any, t: Any, values: Sequence[Any]) -> Any:
        """A step of tensors, with `values` of the parameters, by tensor operations: after `check_reverse`."""
        rows = self.loops.rows(replace(step_table(self.scheme), more=None))[..., 0]
        return self._code.stepped(rows, y, h, t, values)

    def varied(self, values: np.ndarray) -> SplittingKernel:
        """The loops of batches whose trajectories have these values (k, N) of `SplittingLoops.values`."""
        return SplittingKernel(self.loops, self.scheme, self.compensated, values=values)

    def _rows(self, task: Task) -> np.ndarray | None:
        """The states of a task as the loops read them, where they have more; a run that goes on reads none."""
        if self._values is None:
            return None
        if len(task.y0) % len(self._values):
            raise TypeError("`y0` must be a batch (N, 2d): trajectories have their own parameters.")
        latest = self._latest
        if latest is None or len(latest) != len(task.y0) or task.carry is None or task.carry.running is None:
            latest = self._latest = self._with_values(task.y0)
        return latest

    def _with_values(self, y: np.ndarray) -> np.ndarray:
        """States with the values of their trajectories behind them."""
        if self._values is None:
            return y
        values, times = self._values, len(y) // len(self._values)
        values = values if times == 1 else np.tile(values, (times, 1))
        return np.concatenate([y, values], axis=1, dtype=np.float64)


_damped = lru_cache(maxsize=256)(StageTable.damped)
