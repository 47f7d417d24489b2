"""The public API: every name with its signature, as `api.txt` lists it; `python tests/test_api.py` writes the list."""

import inspect
from pathlib import Path

import sympflow
from sympflow.hamiltonian.system import SHOWN_NAMES

LIST = Path(__file__).with_name("api.txt")


def signature(function):
    """Names, kinds and defaults of parameters, without annotations, which are for readers."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return ""
    bare = [p.replace(annotation=p.empty) for p in parameters if p.name not in ("self", "cls")]
    return str(inspect.Signature(bare))


def members(name):
    """The methods and properties that users meet, of the classes that they work with."""
    cls = getattr(sympflow, name)
    if name == "HamiltonianSystem":
        return SHOWN_NAMES
    if name in ("Solution", "Trajectories"):
        return [m for base in cls.__mro__ if base.__module__.startswith("sympflow") for m in vars(base) if m[0] != "_"]
    return []


def listed():
    lines = []
    for name in sorted(sympflow.__all__):
        value = getattr(sympflow, name)
        if inspect.ismodule(value) or not callable(value):
            lines.append(name)
            continue
        lines.append(f"{name}{signature(value)}")
        for member in sorted({*members(name)}):
            function = getattr(value, member, None)
            lines.append(f"    .{member}{signature(function) if inspect.isroutine(function) else ''}")
    return "\n".join(lines) + "\n"


def test_the_public_api_is_as_listed():
    assert listed() == LIST.read_text(encoding="utf-8"), "run `python tests/test_api.py`, and look at the difference"


if __name__ == "__main__":
    LIST.write_text(listed(), encoding="utf-8")
