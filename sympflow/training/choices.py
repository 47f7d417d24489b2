"""What the choices of a run may be: checks whose messages name the choice."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

from sympflow.arguments import plain


def to_plain_numbers(config: Any) -> None:
    """Of a frozen dataclass whose fields may have been given as numbers of NumPy's."""
    for field in fields(config):
        object.__setattr__(config, field.name, plain(getattr(config, field.name)))


def is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def check_counts(**values: Any) -> None:
    """Positive integers, or None where a choice is left open."""
    for name, value in values.items():
        if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < 1):
            raise ValueError(f"`{name}` must be a positive integer; got {value!r}: give 1 or more, or leave it out.")


def check_seed(seed: Any) -> None:
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise ValueError(f"`seed` must be a non-negative integer; got {seed!r}: give 0 or more.")


def check_positive(**values: Any) -> None:
    """Positive finite numbers, or None where a choice is left open."""
    for name, value in values.items():
        if value is not None and not (is_number(value) and 0 < value < math.inf):
            raise ValueError(f"`{name}` must be positive and finite; got {value!r}: leave it out for the default.")


def check_weights(**weights: Any) -> None:
    """Those of the losses, of which some may be 0, but not all."""
    for name, value in weights.items():
        if not (is_number(value) and 0 <= value < math.inf):
            raise ValueError(f"`{name}` must be finite and at least 0; got {value!r}: 0 leaves the loss out.")
    if not any(weights.values()):
        *most, last = (f"`{name}`" for name in weights)
        raise ValueError(f"{', '.join(most)} and {last} are all 0: give one of them a positive value.")
