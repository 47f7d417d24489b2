"""H, its structure and its derivatives."""

from typing import Any


def __getattr__(name: str) -> Any:
    if name == "Hamiltonian":
        from sympflow.hamiltonian.hamiltonian import Hamiltonian

        return Hamiltonian
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
