"""sympflow inside other libraries: `interop.scipy`, `.torchdiffeq`, `.torchode`, and `.systems` for conversion.

Each is imported when it is first used.
"""

from importlib import import_module
from types import ModuleType

__all__ = ["scipy", "systems", "torchdiffeq", "torchode"]


def __getattr__(name: str) -> ModuleType:
    if name in __all__:
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
