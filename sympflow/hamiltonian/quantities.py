"""Quantities of a Hamiltonian as programs of named variables: its parts, and what its parameters make."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from sympflow.compiler.program import Program, Traced, gradient

_POLYNOMIAL = {"add", "sub", "mul", "times", "neg", "fma"}


class Variable(NamedTuple):
    """A variable of a formula."""

    name: str


class Formula:
    """A function of variables, those of the inputs of a program of one output."""

    def __init__(self, program: Program, variables: Sequence[Variable]) -> None:
        self.program, self.variables = program, tuple(variables)

    @cached_property
    def _text(self) -> str:
        return str(self.program)

    def __str__(self) -> str:
        return self._text

    def __hash__(self) -> int:
        return hash(self._text)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Formula) and self._text == other._text

    def __len__(self) -> int:
        return len(self.program)

    def value(self, known: Mapping[Any, Any]) -> Any:
        """The value, of numbers for the variables."""
        return self.program(*(known[s] for s in self.variables))[0]

    def diff(self, variable: Variable) -> Formula:
        """The derivative by a variable."""
        program = self.program
        (slope,) = gradient(program.outputs[0], [program.inputs[self.variables.index(variable)]])
        return Formula(Program(program.inputs, [slope]), self.variables)

    def is_polynomial(self, *variables: Variable) -> bool:
        """True if the program has sums and products alone."""

        def is_simple(x: Traced) -> bool:
            if x.name == "pow":
                n = x.args[1]
                return isinstance(n, float) and n >= 0 and n % 1 == 0
            return x.name in _POLYNOMIAL or (x.name == "div" and isinstance(x.args[1], float))

        return all(map(is_simple, self.program.operations))


KINDS = (0.0, 1.0, -1.0)
"""Values of parts of H that depend on parameters alone with which H may have another structure."""


def values_of(parts: Sequence[Formula], params: Mapping[str, float]) -> list[float]:
    """Values of parts of H that depend on parameters alone, NaN where they are no numbers."""
    with np.errstate(all="ignore"):
        return [float(part.value({s: np.float64(params[s.name]) for s in part.variables})) for part in parts]


def revalued(
    parts: Sequence[Formula],
    replaced: set[str],
    letters: Sequence[Formula],
    before: Mapping[str, float],
    params: Mapping[str, float],
) -> tuple[float, ...] | None:
    """Values of the `letters` of H with others of its parameters; None where H may have another structure.

    `parts` are all that depend on parameters alone, those that are 0, 1 or −1 too; `replaced` are numbers in H.
    """
    changed = {name for name, value in before.items() if params[name] != value}
    lasting = [part for part in parts if part not in letters]
    if changed & replaced or any(s.name in changed for part in lasting for s in part.variables):
        return None
    numbers = tuple(values_of(letters, params))
    return numbers if all(math.isfinite(x) and x not in KINDS for x in numbers) else None
