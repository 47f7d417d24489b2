"""Structure-preserving integration of Hamiltonian systems, classical and learned, behind one interface.

The public names are loaded when first used (PEP 562): importing sympflow loads neither torch, SciPy nor matplotlib.
"""

from importlib import import_module
from types import FunctionType
from typing import Any

from sympflow._version import __version__
from sympflow.lazy import whole_import

_STUB = __loader__.get_data(f"{__file__}i").decode()  # where type checkers read the public names, and this module too
_LINES = [line.split() for line in _STUB.splitlines() if line.startswith("from .")]
_HOME = {name: path[1:] for _, path, _, name, *_ in _LINES if path not in (".", "._version")}
_MODULES = ("systems", "interop")
_ROOMS = (
    "ensembles",
    "flow",
    "hamiltonian",
    "integrators",
    "learning",
    "metrics",
    "schemes",
    "storage",
    "studies",
    "testing",
    "training",
)

__all__ = ["__version__", *_HOME, *_MODULES]  # noqa: PLE0604

_OF_INTEROP = {"as_scipy": "scipy", "from_hamiltonian": "systems", "from_module": "systems"} | dict.fromkeys(
    ("odeint", "odeint_adjoint", "odeint_dense", "odeint_event"), "torchdiffeq"
)

_ELSEWHERE = {
    **dict.fromkeys(("plot", "plotting", "visualization"), "plots are methods of results, such as solve(…).plot()"),
    **dict.fromkeys(("chaos", "analysis"), "take lyapunov, sali, frequencies or poincare_section, all in `sympflow`"),
    **dict.fromkeys(("methods", "solvers"), "take available(), which lists them, or get(name)"),
}


def __getattr__(name: str) -> Any:
    if name in (*_MODULES, *_ROOMS):
        return import_module(f"sympflow.{name}")
    if name not in _HOME:
        from difflib import get_close_matches

        close = [] if name.startswith("_") else get_close_matches(name, (*_HOME, *_MODULES, *_ROOMS), 1)
        hint = f". Did you mean {close[0]!r}?" if close else ""
        if not name.startswith("_") and name in whole_import("sympflow.systems").__all__:
            hint = f". It is `sympflow.systems.{name}`"
        if name in _ELSEWHERE:
            hint = f": {_ELSEWHERE[name]}"
        if name in _OF_INTEROP:
            hint = f". It is `sympflow.interop.{_OF_INTEROP[name]}.{name}`"
        raise AttributeError(f"module 'sympflow' has no attribute {name!r}{hint}")
    value = getattr(whole_import(f"sympflow.{_HOME[name]}"), name)
    if isinstance(value, FunctionType):
        from sympflow.arguments import told

        value = told(value)
        value.__module__ = __name__  # where pickles find it
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
