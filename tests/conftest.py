"""Fixtures shared by several test modules."""

import importlib.util
import os
from pathlib import Path

import pytest

# before NumPy and torch are imported: on arrays as small as these their threads cost four times what they save, for
# those of two workers wait for each other, spinning
os.environ.setdefault("OMP_NUM_THREADS", "1")

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
