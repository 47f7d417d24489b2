"""Hamiltonians of any size that are symbolic in one site and bond, or in one pair; vectors stay arrays.

A subclass states these terms as expressions in a few symbols, and adds their values up over the system by array
operations. Nothing that it holds, but what depends on sites, is as long as the system.
"""

from __future__ import annotations

import math
import os
import reprlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from types import MappingProxyType
from typing import Any, Self

import numpy as np
import sympy as sp

from sympflow.arguments import as_float, check_kept, plain, real_array, real_number
from sympflow.arrays import Array, is_tensor, like
from sympflow.hamiltonian.definition import Definition, bare_copy
from sympflow.hamiltonian.expression import complex_part, stated
from sympflow.hamiltonian.symbolic import SymbolicHamiltonian, generate, printable

MOST_SPELLED = 128  # degrees of freedom
MOST_DENSE = 50_000_000  # entries of matrices ∇²V that are made at a time
VECTORS_OF_A_RUN = 12
"""Vectors of d numbers that a run holds: its state, the next one, copies to look for what is not finite, forces."""


class LocalHamiltonian(Definition, ABC):
    """H = T(p) + V(q) as a sum over sites and bonds, or over pairs, by one expression for each kind of term.

    A subclass defines `potential`, `potential_gradient`, `hessian_vector`, `third_derivative` and, unless T is
    quadratic, `kinetic` and its derivatives; all of arrays and tensors (..., d), at the cost of O(d).
    """

    separable = True
    has_third_derivative = True
    shape: tuple[int, ...] = ()  # sites along the axes of a lattice
    ends: tuple[str, ...] = ()  # how each axis of a lattice ends
    noun: str = "system"  # in messages
    has_subsystem: bool = False  # True if a few parts behave as those of a large system do
    uniform: bool = False  # True if all sites or bodies are alike
    apart: float = 1.0  # a distance at which the terms differ from others, if positions drawn about 0 do not tell
    terms: Mapping[str, str] = MappingProxyType({})  # by name, as texts, for messages
    felt: np.ndarray | None = None
    """1 of the momenta that count in H, 0 of those of bodies without mass (d,); None where all do."""
    frame: Any = None
    """The coordinates of planets about a star, of a system that knows its star: see `sympflow.hamiltonian.planets`."""
    arrays_only: str = ""  # the part of the system without compiled kicks; "" if all has them
    in_terms: bool = False  # True where compiled kicks are made of all terms of H
    written: SymbolicHamiltonian | None = None
    """H in symbols, of a system so small that it is written out when symbols are asked for."""
    loops: str
    inverse_mass: np.ndarray | None  # (d,), of T = ½ pᵀM⁻¹p; None for the identity
    quadratic_kinetic: bool
    params: Mapping[str, Any]

    def with_params(self, values: Mapping[str, Any]) -> Self:
        """Return the definition with other values of some parameters."""
        self.check_names(values)
        other = bare_copy(self)
        other._take({**self.params, **values})
        return other

    def number_columns(self, params: Mapping[str, Any]) -> dict[str, Any]:
        """Values of parameters, each with one for each trajectory at most."""
        return dict(params)

    def parameter_values(self, numbers: Mapping[str, Any]) -> dict[str, Any] | None:
        """The numbers of compiled code through which gradients flow to `numbers` of parameters, if they do."""
        return None

    @abstractmethod
    def _take(self, params: Mapping[str, Any]) -> None:
        """Take values of all parameters, and what follows from them."""

    def check_names(self, names: Iterable[str]) -> None:
        """Refuse names other than those of parameters, which the message lists."""
        for name in names:
            if name not in self.params:
                raise ValueError(
                    f"`params` has {name!r}, and those of the system are {', '.join(self.params) or 'none'}: name one "
                    "of these."
                )

    def check_numbers(self, names: Iterable[str]) -> None:
        """Refuse names other than those of parameters, and arrays: trajectories share them."""
        names = list(names)
        self.check_names(names)
        for name in names:
            if isinstance(self.params.get(name), np.ndarray):
                raise TypeError(
                    f"`params` has {name!r}, an array of the sites, and trajectories have numbers of their own: make a "
                    "system for each array, by system.with_params."
                )

    def linear_and_rest(self, interval: float) -> tuple[Any, list[Any]]:
        """The quadratic part of H, in its normal modes, and the part that remains, if there is one."""
        raise ValueError(
            f"`system` is made of {self.loops}, which have no known linear part: take a method that splits into T and "
            "V, such as 'srkn6b'."
        )

    def subsystem(self, sites: Any = None, boundary: Any = "periodic") -> Self:
        """Return the definition with the same terms on a few sites: see `HamiltonianSystem.subsystem`."""
        raise TypeError(
            f"`system` is not a lattice, and only lattices have subsystems of a few sites: make a smaller one "
            f"by HamiltonianSystem.{self.loops}."
        )

    def judged(self) -> tuple[Any, ...]:
        """Arguments of `subsystem` for a system that is large, and small enough to judge a flow on; () for itself."""
        return ()

    def many(self) -> tuple[Any, ...]:
        """Arguments of `subsystem` for one that is large enough to change as slowly as larger ones, of cheap runs."""
        return ()

    @property
    def work(self) -> int:
        """About how many nanoseconds a force takes in compiled loops: threads are set to work where that pays."""
        return self.ndof

    @property
    def numbers(self) -> int:
        """Numbers that a force by array operations handles."""
        return 2 * self.ndof

    @cached_property
    def spelled(self) -> SymbolicHamiltonian | None:
        """H in symbols, all terms one by one, for loops that are made of these; None where there are too many."""
        return None if self.timed or self.arrays_only or self.ndof > MOST_SPELLED else self.in_symbols()

    def in_symbols(self) -> SymbolicHamiltonian | None:
        """H in symbols; None where that is not known."""
        return None

    def written_out(self) -> sp.Expr | None:
        """H by its coordinates one by one, in q1 … qd, p1 … pd, with the values of the parameters."""
        return None

    def potential_hessian(self, q: Array, *t: Array) -> Array:
        """∇²V(q), dense: (..., d) to (..., d, d)."""
        d = self.ndof
        self.check_dense(np.prod(q.shape, dtype=float) * d, "∇²V")
        columns = self.hessian_vector(q[..., None, :], like(np.eye(d), q) + 0 * q[..., None, :], *t)
        return columns.swapaxes(-1, -2)  # not symmetric where bodies without mass feel others

    def check_dense(self, entries: float, what: str) -> None:
        """Refuse a matrix with more than 5e7 entries: ∇²V, or that of the equations of an implicit step."""
        if entries > MOST_DENSE:
            raise ValueError(
                f"`system` has {self.ndof:,} degrees of freedom, and {what} is dense, with {entries:.3g} entries: "
                "take a splitting method such as 'srkn6b', which needs no matrix, or a subsystem."
            )

    def energy_density(self, y: Array, *t: Array) -> Array:
        """H at each site or body, which add up to H: (..., 2d) to (..., n)."""
        raise NotImplementedError(f"{type(self).__name__} must define energy_density().")

    def _values(
        self, key: str, expressions: Callable[[], Sequence[sp.Expr]], variables: Sequence[sp.Symbol], *arrays: Array
    ) -> list[Array]:
        """The values of expressions in some variables, by functions generated for NumPy or torch when first called."""
        name = "torch" if any(map(is_tensor, arrays)) else "numpy"
        function = self._functions.get((key, name))
        if function is None:
            code = [printable(f) for f in expressions()]
            function = self._functions[key, name] = generate(code, variables, name)
        try:
            return function(*arrays)
        except (NameError, AttributeError, TypeError) as error:
            raise TypeError(
                f"`{key.partition(' ')[0]}` cannot be evaluated with {name} ({error}): write it with functions that "
                f"{name} has."
            ) from error

    @cached_property
    def _functions(self) -> dict[tuple[str, str], Callable[..., list[Any]]]:
        return {}


def numbered(kind: str, names: Sequence[str]) -> tuple[sp.Symbol, ...]:
    """Real symbols kind_0, kind_1, … for things of these names."""
    return tuple(sp.Symbol(f"{kind}_{i}", real=True) for i in range(len(names)))


def parsed(argument: str, expression: str | sp.Expr, symbols: Mapping[str, sp.Symbol], example: str) -> sp.Expr:
    """Return an expression, the argument of this name, in the symbols that its names stand for; refuse all others."""
    if isinstance(expression, bool) or not isinstance(expression, str | sp.Basic | sp.MatrixBase | int | float):
        raise TypeError(
            f"`{argument}` must be a string or a SymPy expression such as {example!r}; got {type(expression).__name__}."
        )
    f = stated(argument, expression, symbols, f"Write it as {example!r}")
    unknown = sorted(s.name for s in f.free_symbols if s.name not in symbols)
    if "t" in unknown:
        raise ValueError(
            f"`{argument}` holds t, and such systems do not depend on the time: give t a value in `params`, or "
            "write H out by from_sympy(..., time='t')."
        )
    if unknown:
        raise ValueError(
            f"`{argument}` holds {', '.join(unknown)}, and its names are {', '.join(symbols)}: give all others a value "
            "in `params`."
        )
    if f.has(sp.zoo, sp.nan, sp.oo) or complex_part(f) is not None:
        raise ValueError(f"`{argument}` must be a real, finite expression such as {example!r}; got {f}.")
    return f.xreplace({s: symbols[s.name] for s in f.free_symbols})


def named_values(argument: str, given: Any, of: str = "numbers") -> dict[str, Any]:
    """The values of an argument that is a mapping of names, those of one number as such."""
    if not isinstance(given, Mapping | None):
        raise TypeError(f"`{argument}` must be a mapping of names to {of}; got {type(given).__name__}: pass a dict.")
    for name, value in (given or {}).items():
        if not isinstance(name, str) or not name.isidentifier():
            raise ValueError(f"`{argument}` must have names as keys; got {name!r}.")
        check_kept(f"{argument}[{name!r}]", value)
    return {name: plain(value) for name, value in (given or {}).items()}


def checked_params(params: Any, shape: tuple[int, ...] = (), remedy: str = "") -> dict[str, Any]:
    """The values of parameters: finite numbers, or one for each site of a lattice of this shape."""
    checked: dict[str, Any] = {}
    for name, value in named_values("params", params, "numbers or arrays" if shape else "numbers").items():
        if real_number(value) or not shape:
            if not math.isfinite(as_float(value)):
                shown = reprlib.repr(value)
                raise ValueError(f"`params` has {name} = {shown}: give a finite real number{remedy}.")
            checked[name] = value
            continue
        array = real_array(f"params[{name!r}]", value)
        if array.shape != shape:
            raise ValueError(
                f"`params` has {name} of shape {array.shape}, and that of the lattice is {shape}: give one value for "
                "each site, or a number for all."
            )
        if not np.isfinite(array).all():
            raise ValueError(f"`params` has {name} with a value that is not finite: give finite real numbers.")
        array.setflags(write=False)
        checked[name] = array
    return checked


def check_memory(ndof: float, what: str) -> None:
    """Refuse a system whose runs do not fit into the memory of the machine, before anything is allocated."""
    needed = 8.0 * VECTORS_OF_A_RUN * ndof
    try:
        available = float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # Windows
        available = 2.0**40
    if needed > available:
        raise ValueError(
            f"{what} has {ndof:.3g} degrees of freedom, so that a run holds about {needed / 1e9:.3g} GB in its "
            f"vectors, and this machine has {available / 1e9:.3g} GB: take a smaller one."
        )
