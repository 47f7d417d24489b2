"""Files of flows, and the flows that ship with the package: see `sympflow.flow.files` and `sympflow.flow.shipped`."""

from __future__ import annotations

import os

from sympflow.flow.files import load
from sympflow.flow.flow_map import FlowMap
from sympflow.flow.records import FORMAT, KEY
from sympflow.flow.shipped import shipped

__all__ = ["FORMAT", "KEY", "load", "save", "shipped"]


def save(flow: FlowMap, path: str | os.PathLike[str]) -> None:
    """Write a flow to a safetensors file, atomically: `FlowMap.save`."""
    flow.save(path)
