"""What tests of stage II share."""

import pytest

from shapepose_fg.estimation import missed_detections


@pytest.fixture
def out_of_sight(monkeypatch):
    """Joints without detections are hidden by something that nobody knows of, not missed in plain
    view.
    """
    monkeypatch.setattr(missed_detections, "LEAST_VIEWS", 99)
