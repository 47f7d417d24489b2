"""Split flows before training: equal Strang steps of the parts of H."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch

from sympflow.arguments import check_flag
from sympflow.flow.arguments import check_system
from sympflow.flow.split import SplitFlow, class_kinds, part_kinds
from sympflow.hamiltonian.parts import LINEAR, exact_parts

if TYPE_CHECKING:
    from sympflow.hamiltonian.system import HamiltonianSystem


def split(
    system: HamiltonianSystem,
    stages: int,
    dt: float,
    terms: int,
    filters: bool,
    force_gradient: bool | Sequence[int] | None,
    expressions: Sequence[str] | None,
    linear_outside: bool,
    dtype: torch.dtype,
    device: torch.device | str | None,
) -> SplitFlow:
    """`SympFlow.split`."""
    check_system(system)
    check_flag("filters", filters)
    check_flag("linear_outside", linear_outside)
    if isinstance(stages, bool) or not isinstance(stages, int) or not 1 <= stages <= 1000:
        raise ValueError(f"`stages` must be a positive integer, at most 1000; got {stages!r}: 4 is usual.")
    parts = exact_parts(system, expressions)
    if force_gradient is None:
        force_gradient = parts.has_force_gradient
    order = parts.sequence
    if linear_outside and order[-1] == LINEAR:
        order = (LINEAR, *order[:-1])
    one = (*order, *order[-2::-1])
    sequence = one + (stages - 1) * one[1:]
    kicks: Sequence[int] = range(sequence.count(1)) if isinstance(force_gradient, bool) else force_gradient
    shape = (sequence, part_kinds(parts), class_kinds(parts), terms, filters, () if force_gradient is False else kicks)
    return SplitFlow(system.ndof, *shape, dt, expressions, system, dtype, device)
