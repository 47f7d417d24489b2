"""Fixtures shared by several test modules."""

import importlib.util
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parent.parent / "examples"


def load_example(name):
    """The module examples/<name>.py."""
    spec = importlib.util.spec_from_file_location(f"examples_{name}", EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def rotation():
    """The exact flow of the harmonic oscillator, Δt = 1."""
    return load_example("exact_rotation").rotation()
