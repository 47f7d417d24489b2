"""How long a loop takes on a core that works on several operations at once: each waits for its operands and a unit."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

__all__ = ["Operation", "cycles_per_turn"]

UNITS = 2  # that start a multiplication each cycle, and as many for additions, on current x86-64 cores
TURNS, SETTLED = 24, 8  # simulated, and left out at the beginning


class Operation(NamedTuple):
    """A value that is computed: from which others, how many cycles after them, on which units and for how long."""

    name: str
    operands: tuple[str, ...]
    latency: float
    unit: str
    occupied: int = 1


def cycles_per_turn(operations: Sequence[Operation], carried: Mapping[str, str]) -> float:
    """Cycles from one turn of a loop to the next, once they repeat.

    Parameters
    ----------
    operations : sequence of Operation
        Of one turn, as the program has them: of two that could start, the one that comes first does.
    carried : mapping
        Of the arguments of a turn, the names of the values of the turn before that they take. Whatever is neither an
        argument nor computed is known always.
    """
    known = dict.fromkeys(carried, 0.0)
    busy: dict[str, Counter[int]] = {}
    ends = []
    for _ in range(TURNS):
        values = dict(known)
        for name, operands, latency, unit, occupied in operations:
            start = int(max((values[x] for x in operands if x in values), default=0))
            taken = busy.setdefault(unit, Counter())
            while taken[start] >= UNITS:
                start += 1
            for cycle in range(start, start + occupied):
                taken[cycle] += 1
            values[name] = start + latency
        known = {argument: values.get(name, 0.0) for argument, name in carried.items()}
        ends.append(max(known.values()))
    return (ends[-1] - ends[SETTLED - 1]) / (TURNS - SETTLED)
