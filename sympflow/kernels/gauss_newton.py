"""Compiled linear algebra of Gauss–Newton steps: see the text `gauss_newton`."""

from __future__ import annotations

from functools import cache
from types import ModuleType

from sympflow.kernels.modules import OPTIONS, load_module, template

__all__ = ["gauss_newton_loops"]


@cache
def gauss_newton_loops() -> ModuleType:
    """The functions ``factored``, ``damped`` and ``bent``; sums may be reordered, so that they become vector sums."""
    options = OPTIONS | {"cache": True, "fastmath": {"contract", "reassoc"}}
    return load_module(f"OPTIONS = {options}\n\n\n{template('gauss_newton')}")
