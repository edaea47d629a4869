"""Shared fixtures: where the real recordings are, if they are."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings (`SHAPEPOSE_DATA`, else ../shared); skips where there is none."""
    root = Path(os.environ.get("SHAPEPOSE_DATA", Path(__file__).parents[2] / "shared"))
    if not (root / "data").is_dir():
        pytest.skip(f"no real recordings at {root}: set SHAPEPOSE_DATA to their folder to run this test")
    return root / "data"
