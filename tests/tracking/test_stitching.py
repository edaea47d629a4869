"""People who leave and come back, and people who only look like it."""

import numpy as np
import pytest

from shapepose_fg.skeleton import BODY_25
from shapepose_fg.tracking.stitching import Ends, StitchingConfig, Trace
from shapepose_fg.tracking.stitching import stitch as stitch_traces


def stitch(track, time_s, joints, skeleton, config, cuts_s=()):
    """The identity of each row."""
    traces = (Trace.of(n, time_s[track == n], joints[track == n], skeleton) for n in np.unique(track).tolist())
    names = stitch_traces(Ends.of(traces), config, cuts_s)
    return np.array([names[each] for each in track.tolist()], dtype=int)


@pytest.fixture
def rows(two_people):
    """A function of (track, person, size, first frame, x) tuples -> track, time_s, joints; 20 rows each."""

    def make(*parts):
        rng = np.random.default_rng(0)
        track, time_s, joints = [], [], []
        for name, size, first, x in parts:
            body = two_people[0] * size + [x, 0, 0]
            # An error of 1 cm that lasts, and one of 5 mm that does not.
            lasting = rng.normal(0, 0.01, body.shape)
            track += [name] * 20
            time_s += ((first + np.arange(20)) / 30).tolist()
            joints += [body + lasting + rng.normal(0, 0.005, body.shape) for _ in range(20)]
        return np.array(track), np.array(time_s), np.array(joints)

    return make


def test_who_comes_back_two_seconds_later_is_the_same(rows):
    track, time_s, joints = rows((3, 1.0, 0, 0.0), (7, 1.0, 80, 1.0), (5, 1.0, 0, 4.0))
    named = stitch(track, time_s, joints, BODY_25, StitchingConfig())
    assert np.unique(named[track == 7]).tolist() == [3] and np.unique(named[track == 5]).tolist() == [5]


@pytest.mark.parametrize(
    ("size", "first", "x"),
    [
        (1.15, 80, 1.0),  # 15 % taller
        (1.0, 80, 5.0),  # 5 m in 2 s
        (1.0, 400, 1.0),  # 12 s later
        (1.0, 10, 1.0),  # both at once
    ],
)
def test_who_is_taller_too_far_away_too_late_or_there_at_the_same_time_is_not(rows, size, first, x):
    track, time_s, joints = rows((3, 1.0, 0, 0.0), (7, size, first, x))
    np.testing.assert_array_equal(stitch(track, time_s, joints, BODY_25, StitchingConfig()), track)


def test_a_chain_of_tracks_gets_one_name_and_a_cut_breaks_it(rows):
    track, time_s, joints = rows((4, 1.0, 0, 0.0), (6, 1.0, 60, 0.5), (9, 1.0, 120, 1.0))
    assert set(stitch(track, time_s, joints, BODY_25, StitchingConfig()).tolist()) == {4}
    cut = stitch(track, time_s, joints, BODY_25, StitchingConfig(), cuts_s=[100 / 30])
    assert np.unique(cut[track == 6]).tolist() == [4] and np.unique(cut[track == 9]).tolist() == [9]


def test_two_who_swap_places_out_of_sight_are_told_apart_by_their_build(rows):
    track, time_s, joints = rows((1, 1.0, 0, 0.0), (2, 1.15, 0, 1.0), (3, 1.15, 60, 0.0), (4, 1.0, 60, 1.0))
    named = stitch(track, time_s, joints, BODY_25, StitchingConfig())
    assert np.unique(named[track == 3]).tolist() == [2] and np.unique(named[track == 4]).tolist() == [1]


def test_nobody_is_nobody():
    none = np.zeros(0)
    named = stitch(none.astype(int), none, np.zeros((0, 25, 3)), BODY_25, StitchingConfig())
    assert len(named) == 0


def two_tracks(gap_s, apart_m, longer_m=0.0, rows=20, known=14) -> Ends:
    """Two tracks of one second each; of 14 bones some are `known`, the second person's are `longer_m` longer."""
    time_s = np.concatenate([np.linspace(0, 1, rows), np.linspace(0, 1, rows) + 1 + gap_s])
    track = np.repeat([3, 7], rows)
    centre = np.zeros((2 * rows, 3))
    centre[:rows, 0] = np.linspace(-2.0, 0.0, rows)  # the last row's place counts, and the first of the other
    centre[rows:, 0] = apart_m + np.linspace(0.0, 5.0, rows)
    bones = np.where(track[:, None] == 3, 0.4, 0.4 + longer_m) * np.ones(14)
    bones[:, known:] = np.nan
    parts = ((each, track == each) for each in (3, 7))
    return Ends.of(Trace(each, time_s[mine], centre[mine], bones[mine]) for each, mine in parts)


@pytest.mark.parametrize(
    ("change", "joined"),
    [
        ({}, True),
        ({"gap_s": 9.9, "apart_m": 0.0}, True),
        ({"gap_s": 10.1, "apart_m": 0.0}, False),
        ({"apart_m": 3.45}, True),  # 0.5 m and 1.5 m/s for 2 s
        ({"apart_m": 3.55}, False),
        ({"longer_m": 0.029}, True),  # d^2 / (2 x 0.015^2) is 2 at 3 cm
        ({"longer_m": 0.031}, False),
        ({"rows": 10}, True),
        ({"rows": 9}, False),
        ({"known": 7}, True),
        ({"known": 6}, False),
    ],
)
def test_how_long_how_far_and_how_alike(change, joined):
    ends = two_tracks(**{"gap_s": 2.0, "apart_m": 1.0} | change)
    assert stitch_traces(ends, StitchingConfig()) == {3: 3, 7: 3 if joined else 7}


def test_a_trace_is_the_centre_of_the_core_joints_that_are_known_and_the_core_bones(two_people):
    joints = np.stack([two_people[0], two_people[1]])
    core = list(BODY_25.core)
    joints[1, core[:4]] = np.nan
    trace = Trace.of(1, np.zeros(2), joints, BODY_25)
    np.testing.assert_allclose(trace.centre, [joints[0, core].mean(axis=0), joints[1, core[4:]].mean(axis=0)])
    lengths = [
        np.linalg.norm(joints[0, j] - joints[0, BODY_25.parents[j]]) for j in core if BODY_25.parents[j] in core
    ]
    np.testing.assert_allclose(np.sort(trace.bones[0]), np.sort(lengths))
