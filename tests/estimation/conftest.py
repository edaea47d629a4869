"""What tests of stage II share."""

import pytest

from shapepose_fg.estimation import plain_view


@pytest.fixture
def out_of_sight(monkeypatch):
    """Joints without detections are hidden by something that nobody knows of, not missed in plain view."""
    monkeypatch.setattr(plain_view, "LEAST_VIEWS", 99)
