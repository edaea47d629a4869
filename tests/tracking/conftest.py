"""People with known motion before five cameras, and a tracker for them."""

from functools import partial

import numpy as np
import pytest

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections, Input
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.pipeline.config import PeopleConfig
from shapepose_fg.pipeline.pipeline import PipelineConfig, find_people
from shapepose_fg.tracking.identities import FollowingConfig, FollowState, finish, follow
from shapepose_fg.tracking.tracker import BodyScale, Tracker, TrackingConfig, Tracks

FPS = 30.0


@pytest.fixture(scope="session")
def tracker() -> Tracker:
    """Stage I as the pipeline makes it, bones of 0.7 m at most."""
    config, likely = PipelineConfig(), PipelineConfig(people=PeopleConfig(min_probability=0.15))
    find = [partial(find_people, skeleton=BODY_25, config=each) for each in (config, likely)]
    scale = BodyScale(np.full(25, 0.7), np.full(25, 10.0))
    return Tracker(BODY_25, scale, find, TrackingConfig(), config.observations)


@pytest.fixture(scope="session")
def followed(tracker):
    """A function (rig, frames of Detections, times) -> rows of all frames, one `Observations`."""

    def run(rig: Rig, frames, times=None, following=FollowingConfig(), tracker=tracker):
        from shapepose_fg.core.observations import Observations

        times = np.arange(len(frames)) / FPS if times is None else times
        state, decided = FollowState(Tracks.none(BODY_25)), []
        for number, (detections, time) in enumerate(zip(frames, times, strict=True)):
            state, more = follow(
                tracker, state, Input(number, np.full(len(rig), time), detections, rig), following
            )
            decided += more
        _, more = finish(tracker, state)
        decided += more
        assert [frame.frame for frame, _ in decided] == list(range(len(frames)))
        return Observations.concatenate([rows for _, rows in decided])

    return run


@pytest.fixture(scope="session")
def walking(five_cameras, two_people, seen_exactly):
    """Two people walk past each other at 0.35 m: (frames of Detections, (T, 2, 25, 3) truth); 45
    frames.
    """
    steps = np.linspace(-0.9, 0.9, 45)
    first = two_people[0] - two_people[0].mean(axis=0) * [1, 1, 0]
    second = two_people[1] - two_people[1].mean(axis=0) * [1, 1, 0]
    truth = np.stack(
        [np.stack([np.add(first, (s, -0.18, 0)), np.add(second, (-s, 0.17, 0))]) for s in steps]
    )
    return [seen_exactly(five_cameras, people) for people in truth], truth


@pytest.fixture(scope="session")
def nobody() -> Detections:
    return Detections.empty()
