"""The lines that `live` writes."""

import json
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.io.ros.messages import COVARIANCES
from shapepose_fg.live.notes import SparingNotes
from shapepose_fg.live.outputs import line_of, published


@pytest.fixture
def people(dance):
    return dance.people.rows(np.arange(2))


@pytest.mark.parametrize("level", COVARIANCES)
def test_a_line_has_the_covariances_that_were_asked_for(people, level):
    line = json.loads(line_of("now", people, 1.5, level))
    found = {name for name in line["people"][0] if "covariance" in name}
    assert found == set(COVARIANCES[level])
    assert len(line_of("now", people, 1.5, "none")) < 0.6 * len(line_of("now", people, 1.5))


def test_covariances_stay_positive_definite_and_far_places_exact(people):
    """Six digits of a place in a map, 500 km from its origin, are a metre."""
    far = replace(people, joints=people.joints + 5e5)
    line = json.loads(line_of("settled", far, 1.5, "all"))
    for n, each in enumerate(line["people"]):
        known = np.isfinite(far.joints[n]).all(axis=1)
        for joint in np.flatnonzero(known):
            np.testing.assert_allclose(
                each["joints"][joint], far.joints[n, joint], atol=6e-5, rtol=0
            )
            assert (np.linalg.eigvalsh(each["covariance"][joint]) > 0).all()


@pytest.mark.parametrize("said", [[], ["a"], ["a", "b"]])
def test_a_viewer_is_started_with_any_number_of_notes(dance, monkeypatch, said):
    pytest.importorskip("rerun")
    from shapepose_fg.io.export import rerun_app

    monkeypatch.setattr(rerun_app, "quiet_viewer", lambda: said)
    monkeypatch.setattr(rerun_app, "shown", lambda *_: nullcontext(rerun_app.new_stream()))
    notes = list[str]()
    with SparingNotes(notes.append) as note, published(["rerun"], dance.scene.rig, note):
        assert notes == said
