"""Who is in a result: figures worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.body.shapes import statures_m
from shapepose_fg.core.reconstruction import Known, Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.results.track_summary import list_tracks
from tests.conftest import read_body


def walkers(sigma_m: float = 0.01) -> Reconstruction:
    """At 30 Hz for 10 s: 4 stands, 9 walks 1 m/s along x but is not there in seconds 3 to 5; with
    noise.
    """
    rng = np.random.default_rng(0)
    there = np.array([frame for frame in range(300) if not 90 <= frame < 150])
    frame = np.concatenate([np.arange(300), there])
    person = np.repeat([4, 9], [300, 240])
    N = len(frame)
    joints = rng.normal(0, sigma_m, (N, 25, 3)) + rng.normal(size=(25, 3))
    joints[person == 9, :, 0] += there[:, None] / 30
    known = np.full((N, 25), Known.SEEN)
    known[person == 9, :5] = Known.BODY
    joints[person == 4, 24] = np.nan
    known[person == 4, 24] = Known.UNKNOWN
    return Reconstruction(
        frame=frame,
        person=person,
        joint_names=np.array(BODY_25.joints),
        joints=joints,
        covariance=np.tile(np.eye(3), (N, 25, 1, 1)),
        confidence=np.where(person == 4, 0.5, 0.75)[:, None] * np.ones(25),
        betas=np.where((person == 4)[:, None], 1.0, np.nan) * np.ones(10),
        global_orient=np.zeros((N, 3)),
        body_pose=np.zeros((N, 23, 3)),
        transl=np.zeros((N, 3)),
        status=np.where(person == 4, "ok", "body undetermined"),
        time_s=frame / 30,
        known=known,
    )


def test_figures_by_hand():
    still, walks = list_tracks(walkers(), read_body())
    assert (still.person, still.first, still.last, still.rows, still.gaps) == (4, 0, 299, 300, 0)
    assert (walks.person, walks.first, walks.last, walks.rows, walks.gaps) == (9, 0, 299, 240, 1)
    assert still.stature_m == pytest.approx(statures_m(np.ones((1, 10)), read_body())[0])
    assert np.isnan(walks.stature_m)
    assert still.confidence == pytest.approx(0.5) and walks.confidence == pytest.approx(0.75)
    assert still.seen == 1.0 and walks.seen == pytest.approx(0.8)
    # 10 s at 1 m/s, from the middle of the first half second to that of the last, straight through
    # the gap.
    assert walks.walked_m == pytest.approx(9.5, abs=0.05)
    assert still.walked_m == 0.0  # noise of 1 cm a joint is no walk


def test_without_a_body_or_anybody():
    assert all(np.isnan(track.stature_m) for track in list_tracks(walkers()))
    assert list_tracks(Reconstruction.empty(), read_body()) == []


def test_rows_without_any_joint_are_no_step():
    people = walkers()
    lost = people.joints.copy()
    lost[(people.person == 9) & (people.frame % 7 == 3)] = np.nan
    walked = list_tracks(replace(people, joints=lost))[1].walked_m
    assert walked == pytest.approx(list_tracks(people)[1].walked_m, abs=0.1)


def test_without_times_30_frames_a_second_are_assumed():
    people = walkers()
    untimed = Reconstruction(
        **{
            name: getattr(people, name)
            for name in (*Reconstruction.ROWS, "joint_names")
            if name != "time_s"
        }
    )
    assert list_tracks(untimed)[1].walked_m == pytest.approx(list_tracks(people)[1].walked_m)
