"""People who leave and come back, and people who only look like it."""

import tracemalloc

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.tracking.stitching import Ends, StitchingConfig, Trace
from shapepose_fg.tracking.stitching import stitch as stitch_traces


def stitch(track, time_s, joints, skeleton, config, cuts_s=()):
    """The identity of each row."""
    traces = (
        Trace.of(n, time_s[track == n], joints[track == n], skeleton)
        for n in np.unique(track).tolist()
    )
    names = stitch_traces(Ends.of(traces), config, cuts_s)
    return np.array([names[each] for each in track.tolist()], dtype=int)


@pytest.fixture
def rows(two_people):
    """A function of (track, size, first frame, x) tuples -> track, time_s, joints; 20 rows each.

    Each joint has an error of `error_m` that lasts, and one of half of it that does not. Lengths of
    bones may differ by 15 mm in a track: errors of 5 mm hide nobody who is the same, in no draw.
    """

    def make(*parts, error_m=0.005):
        rng = np.random.default_rng(0)
        track, time_s, joints = [], [], []
        for name, size, first, x in parts:
            body = two_people[0] * size + [x, 0, 0]
            lasting = rng.normal(0, error_m, body.shape)
            track += [name] * 20
            time_s += ((first + np.arange(20)) / 30).tolist()
            joints += [body + lasting + rng.normal(0, error_m / 2, body.shape) for _ in range(20)]
        return np.array(track), np.array(time_s), np.array(joints)

    return make


def test_who_comes_back_two_seconds_later_is_the_same(rows):
    track, time_s, joints = rows((3, 1.0, 0, 0.0), (7, 1.0, 80, 1.0), (5, 1.0, 0, 4.0))
    named = stitch(track, time_s, joints, BODY_25, StitchingConfig())
    assert np.unique(named[track == 7]).tolist() == [3] and np.unique(
        named[track == 5]
    ).tolist() == [5]


def test_two_who_pass_each_other_out_of_sight_keep_their_names(rows):
    """At 1.2 m/s towards each other: 0.6 s later each is nearer to where the other one vanished."""
    track, time_s, joints = rows((1, 1.0, 0, 0), (2, 1.0, 0, 1), (3, 1.0, 38, 0), (4, 1.0, 38, 1))
    start = np.array([0.0, 1.5, 0.0, 1.5])[track - 1]
    joints[..., 0] += (start + np.where(track % 2 == 1, 1.2, -1.2) * time_s)[:, None]
    joints[..., 0] -= np.where(track % 2 == 1, 0, 1)[:, None]
    named = stitch(track, time_s, joints, BODY_25, StitchingConfig())
    np.testing.assert_array_equal(named, np.where(track % 2 == 1, 1, 2))


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
    track, time_s, joints = rows(
        (1, 1.0, 0, 0.0), (2, 1.15, 0, 1.0), (3, 1.15, 60, 0.0), (4, 1.0, 60, 1.0)
    )
    named = stitch(track, time_s, joints, BODY_25, StitchingConfig())
    assert np.unique(named[track == 3]).tolist() == [2] and np.unique(
        named[track == 4]
    ).tolist() == [1]


@pytest.mark.parametrize("first", [(60, 60), (60, 75), (75, 60)])
def test_of_two_who_leave_and_two_who_come_build_decides_and_then_place(rows, first):
    """Builds 4 % apart may both be either's, and so may all places, up to a metre away, whoever
    comes first.

    Where builds are equal the places decide, by half of a squared standard deviation: errors of a
    millimetre in 14 bones are worth a fourteenth of that.
    """
    parts = (1, 1.0, 0, 0.0), (2, 1.04, 0, 1.0), (3, 1.04, first[0], 0.3), (4, 1.0, first[1], 0.7)
    track, time_s, joints = rows(*parts, error_m=0.001)
    named = stitch(track, time_s, joints, BODY_25, StitchingConfig())
    assert np.unique(named[track == 3]).tolist() == [2] and np.unique(
        named[track == 4]
    ).tolist() == [1]
    track, time_s, joints = rows(
        *((name, 1.0, start, x) for name, _, start, x in parts), error_m=0.001
    )
    named = stitch(track, time_s, joints, BODY_25, StitchingConfig())
    assert np.unique(named[track == 3]).tolist() == [1] and np.unique(
        named[track == 4]
    ).tolist() == [2]


def test_nobody_is_nobody():
    none = np.zeros(0)
    named = stitch(none.astype(int), none, np.zeros((0, 25, 3)), BODY_25, StitchingConfig())
    assert len(named) == 0


def two_tracks(gap_s, apart_m, longer_m=0.0, rows=20, known=14) -> Ends:
    """Two tracks of one second each; of 14 bones some are `known`, the second person's are
    `longer_m` longer.
    """
    time_s = np.concatenate([np.linspace(0, 1, rows), np.linspace(0, 1, rows) + 1 + gap_s])
    track = np.repeat([3, 7], rows)
    centre = np.zeros((2 * rows, 3))
    centre[: rows // 2, 0] = -2.0  # the last row's place counts, and the first of the other
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
        ({"rows": 9, "gap_s": 0.9}, True),  # a brief gap needs no build
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
    np.testing.assert_allclose(
        trace.centre, [joints[0, core].mean(axis=0), joints[1, core[4:]].mean(axis=0)]
    )
    lengths = [
        np.linalg.norm(joints[0, j] - joints[0, BODY_25.parents[j]])
        for j in core
        if BODY_25.parents[j] in core
    ]
    np.testing.assert_allclose(np.sort(trace.bones[0]), np.sort(lengths))


def many_tracks(count: int, seconds: float, people: int, seed: int = 0) -> Ends:
    """Tracks of up to 2 s of people of a few builds in a room, at any time of the recording."""
    rng = np.random.default_rng(seed)
    begin_s = rng.uniform(0, seconds, count)
    time_s = np.stack([begin_s, begin_s + rng.uniform(0, 2, count)], axis=1)
    builds = rng.normal(0.4, 0.03, (people, 14))
    bones = builds[rng.integers(people, size=count)] + rng.normal(0, 0.01, (count, 14))
    bones[rng.random((count, 14)) < 0.2] = np.nan
    places, still = rng.uniform(-3, 3, (count, 2, 3)), np.zeros((count, 3))
    return Ends(rng.permutation(count), time_s, places, bones, still)


def joined_all_at_once(ends: Ends, config: StitchingConfig, cuts_s: list[float]) -> dict[int, int]:
    """Every track compared with every other, and one assignment for all."""
    G, alone = len(ends.track), 1e6
    cost = np.full((G, G), alone)
    for a in range(G):
        for b in range(G):
            (_, end), (begin, _) = ends.time_s[a], ends.time_s[b]
            gap, apart = begin - end, np.linalg.norm(ends.place[b, 0] - ends.place[a, 1])
            squared = (ends.bones[a] - ends.bones[b]) ** 2 / (2 * 0.015**2)
            known = np.isfinite(squared)
            unlike = squared[known].mean() if known.sum() >= 7 else 1.0 if gap <= 1 else np.inf
            cut = any(end < at <= begin for at in cuts_s)
            near = 0 < gap <= config.longest_gap_s and apart <= 0.5 + 1.5 * gap
            if unlike <= 2.0 and near and not cut:
                # -2 log of a Gaussian on the floor, two sigmas of which are in reach, and of the 14
                # bones.
                sigma = (0.5 + 1.5 * gap) / 2
                cost[a, b] = apart**2 / sigma**2 + 2 * np.log(sigma**2) + 14 * unlike
    pairs = zip(*linear_sum_assignment(cost), strict=True)
    before = {b: a for a, b in pairs if cost[a, b] < alone}
    names: dict[int, int] = {}
    for at in np.argsort(ends.time_s[:, 0]).tolist():
        names[at] = int(ends.track[at]) if at not in before else names[before[at]]
    return {int(ends.track[at]): name for at, name in names.items()}


@pytest.mark.parametrize(
    ("seed", "seconds", "cuts_s"), [(0, 30.0, []), (1, 100.0, [20.0, 50.0]), (2, 400.0, [])]
)
def test_groups_of_tracks_are_joined_as_all_at_once_would_be(seed, seconds, cuts_s):
    ends = many_tracks(70, seconds, people=4, seed=seed)
    found = stitch_traces(ends, StitchingConfig(), cuts_s)
    expected = joined_all_at_once(ends, StitchingConfig(), cuts_s)
    assert len(set(found.values())) < 65, "some are joined"
    assert found == expected


def test_memory_grows_with_tracks_and_not_with_their_square():
    """Twenty times the recording, with as many people at a time."""
    peaks = []
    for count in (500, 10000):
        ends = many_tracks(count, 4.0 * count, people=8)
        tracemalloc.start()
        names = stitch_traces(ends, StitchingConfig())
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert len(names) == count > len(set(names.values()))
    assert peaks[1] < 30 * peaks[0] < 60e6
