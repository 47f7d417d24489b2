"""The system that an argument means: one, the name of a scene, one in a file, or H as a formula."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

from sympflow.arguments import did_you_mean
from sympflow.arrays import to_numpy
from sympflow.hamiltonian.system import HamiltonianSystem

if TYPE_CHECKING:
    import sympy as sp

GivenSystem: TypeAlias = "HamiltonianSystem | str | sp.Basic"
"""A system, the name of a scene, own.py:name or own.toml, or H as a formula, in text or symbols."""

FILE = re.compile(r"(?P<path>.+?\.(?:py|toml))(?::(?P<rest>.*))?", re.DOTALL)
"""A system in a file: file.toml, file.py:name, and on the command line parameters behind them."""
NAME = re.compile(r"[A-Za-z][A-Za-z0-9]*([-_][A-Za-z0-9]+)*")


def given_system(system: Any, params: Mapping[str, Any] | None = None) -> HamiltonianSystem:
    """Return the system that an argument means: one, the name of a scene, one in a file, or H as `from_sympy` takes it.

    The first values of `params` are those of the symbols of H.
    """
    if isinstance(system, HamiltonianSystem):
        return system
    if isinstance(system, str):
        from sympflow.systems import available, get

        if NAME.fullmatch(system) and system not in ("q", "p", "q1", "p1"):
            key = system.replace("_", "-").lower()
            if key in available():
                return get(key)()
            hint = did_you_mean(key, available(), 0.5)
            names = (
                ""
                if hint
                else f" There are {', '.join(available())}; a formula such as 'p**2/2 + q**2/2' is a system too."
            )
            raise ValueError(f"`system` {system!r} is not the name of a scene.{hint}{names}")
        if file := FILE.fullmatch(system):
            from sympflow.systems.user_files import factory

            return factory(file["path"], file["rest"] or None)()
        return HamiltonianSystem.from_sympy(system, params=_first(params))
    sympy = sys.modules.get("sympy")
    if sympy is not None and isinstance(system, sympy.Basic | sympy.MatrixBase):
        return HamiltonianSystem.from_sympy(system, params=_first(params))
    what, remedy = type(system).__name__, "take a scene of sympflow.systems, or H as text, 'p**2/2 + q**2/2'"
    if isinstance(getattr(system, "system", None), HamiltonianSystem):
        remedy = "pass its `system`, and its `y0`"
    if callable(system):
        of_scene = getattr(system, "__module__", "").startswith("sympflow.systems")
        what = f"the function {getattr(system, '__name__', what)!r}"
        remedy = (
            f"call it, {system.__name__}()"
            if of_scene
            else "make a system of it by HamiltonianSystem(hamiltonian=f, ndof=d), f(q, p), or "
            "HamiltonianSystem(potential=V, ndof=d) for H = ½|p|² + V(q)"
        )
    raise TypeError(f"`system` must be a HamiltonianSystem; got {what}: {remedy}.")


def _first(params: Mapping[str, Any] | None) -> dict[str, float] | None:
    """The first value of each of some parameters, which may be arrays or tensors."""
    if not isinstance(params, Mapping):
        return None
    rows = {name: to_numpy(x).ravel() for name, x in params.items()}
    return {name: row[0] for name, row in rows.items() if row.size}
