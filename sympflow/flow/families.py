"""The families of flow maps by name; their modules are imported when one is wanted.

A family is one module and one line here. The class builds itself from the description in a file:
`from_architecture(ndof, plan, dt, dtype)`, the reverse of `architecture()`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sympflow.lazy import whole_import

FAMILIES = {
    "split": "sympflow.flow.split:SplitFlow",
    "clocked": "sympflow.flow.clocked:ClockedFlow",
    "kepler": "sympflow.flow.planetary:KeplerFlow",
    "collocated": "sympflow.flow.collocated:CollocatedFlow",
    "primed": "sympflow.flow.primed:PrimedFlow",
    "sympflow": "sympflow.flow.sympflow:SympFlow",
    "mlp": "sympflow.flow.mlp:MLPFlow",
}
"""The module and the class of each. A file is of the first family that its plan names, and else of its kind."""

KINDS = ("sympflow", "mlp")
"""The kinds that files name, which are the methods that run the flows: SympFlows, and their baseline."""


def family(name: str) -> Any:
    """Return the class of a family."""
    module, _, attribute = FAMILIES[name].partition(":")
    return getattr(whole_import(module), attribute)


def family_of(kind: str, plan: Mapping[str, Any]) -> Any:
    """Return the class of a flow of this kind and architecture."""
    return family(kind if kind == "mlp" else next((name for name in FAMILIES if name in plan), "sympflow"))
