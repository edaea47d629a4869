"""The whole way, from detections to a result: windows, processes, chunks, resuming."""

from importlib import import_module
from typing import Any


def __getattr__(name: str) -> Any:
    """What was in this module when it was one file (PEP 562)."""
    if name.startswith("__"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.pipeline"), name)
