"""Who is there, by evidence: small accounts that can be worked out by hand.

A hypothesis is a list of frames, each with the detections that are its (of at most four places), or
None where it is not followed.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.proposal.nearby import FrameArrays
from shapepose_fg.tracking.global_hypotheses import lasting
from shapepose_fg.tracking.track_selection import (
    EvidenceTable,
    SelectedTracks,
    own_evidence,
    probability,
    weighed,
)

PLACES = 4
PRICE = 0.15
STEP_S = 0.1


def account_of(
    rows: Sequence[Sequence[list[int] | None]], times: int | None = None, step_s: float = STEP_S
) -> EvidenceTable:
    """Of people's detections in each frame, numbers in the frame, at most 8. Each place costs
    `PRICE` unseen.
    """
    T = times or len(rows[0])
    candidate = np.full((len(rows), T, PLACES, 1), -1)
    there = np.zeros((len(rows), T), dtype=bool)
    for h, frames in enumerate(rows):
        for t, own in enumerate(frames):
            there[h, t] = own is not None
            if own:
                candidate[h, t, : len(own), 0] = own
    weight, price = np.full(candidate.shape, (1 + PRICE) / PLACES), np.full((len(rows), T), PRICE)
    return EvidenceTable.of(candidate, weight, price, there, np.full(T, 8), np.full(T, step_s))


def evidence_of(
    *rows: tuple[Sequence[list[int] | None], int],
    times: int | None = None,
    step_s: float = STEP_S,
    on_trial: bool = False,
    left: bool = False,
) -> SelectedTracks:
    """Choose among (detections in each frame, world). With `left` those whom the chosen leave
    over.
    """
    account = account_of([frames for frames, _ in rows], times, step_s)
    chosen = account.ways(np.array([world for _, world in rows]), on_trial=on_trial)[0]
    return account.left_over(chosen) if left else chosen


def stretches(chosen: SelectedTracks) -> list[tuple[int, int, int]]:
    columns = (chosen.hypothesis.tolist(), chosen.start.tolist(), chosen.stop.tolist())
    return sorted(zip(*columns, strict=True))


ANNA, BERT, NONE = [0, 1, 2, 3], [4, 5, 6, 7], []


def test_evidence_is_in_seconds_in_which_all_is_seen():
    """All of one, half of the other: 1.15 of the share, less 0.15, of each of 2 s."""
    chosen = evidence_of(([ANNA] * 20, 0), ([BERT[:2]] * 20, 0))
    assert stretches(chosen) == [(0, 0, 20), (1, 0, 20)]
    np.testing.assert_allclose(chosen.evidence_s, [2.0, 2 * (1.15 / 2 - 0.15)], rtol=1e-6)


def test_a_detection_is_evidence_of_one_person_only():
    """The second has three of the first's four detections and one of its own: a quarter of its
    places, for which 1.15 / 4 - 0.15 = 0.14 s a second; the third has nothing of its own.
    """
    chosen = evidence_of(([ANNA] * 20, 0), ([[0, 1, 2, 4]] * 20, 1), ([[0, 1, 2]] * 20, 2))
    assert stretches(chosen) == [(0, 0, 20), (1, 0, 20)]
    np.testing.assert_allclose(chosen.evidence_s, [2.0, 2 * (1.15 / 4 - 0.15)], rtol=1e-6)
    assert stretches(evidence_of(([ANNA] * 20, 0), ([ANNA] * 20, 1))) == [(0, 0, 20)]


def test_whoever_is_there_too_briefly_is_left_over():
    """0.3 s in the middle are worth 0.3 s, but for what appearing and vanishing cost, 0.25 s: under
    the least.
    """
    brief = ([NONE] * 8 + [BERT] * 3 + [NONE] * 9, 0)
    assert stretches(evidence_of(([ANNA] * 20, 0), brief)) == [(0, 0, 20)]
    left = evidence_of(([ANNA] * 20, 0), brief, ([ANNA] * 20, 1), left=True)
    assert stretches(left) == [(1, 8, 11)], "not who has Anna's detections"
    np.testing.assert_allclose(left.evidence_s, [3 * STEP_S], rtol=1e-6)


def test_evidence_of_one_s_own_in_a_frame():
    """All of four places; a half, of which one is another's, too; with a weight of 0.5; nothing."""
    candidate = np.array([[0, 1, 2, 3], [4, 5, -1, -1], [5, 6, -1, -1], [-1] * 4])[..., None]
    weight = np.where(candidate == 6, 0.5, 1.0)
    found = own_evidence(candidate, weight * (1 + PRICE) / 4, np.full(4, PRICE))
    np.testing.assert_allclose(found, (1 + PRICE) * np.array([1, 0.25, 0.125, 0]) - PRICE)


def test_how_probable_people_were_in_simulated_recordings():
    """Of so many people with this evidence in the mean so many were there, within 2 sigma."""
    for evidence, people, there in (
        (0.123, 23, 18),
        (0.212, 71, 67),
        (0.298, 167, 161),
        (0.503, 585, 585),
    ):
        said = probability(evidence)
        assert there / people == pytest.approx(said, abs=2 * np.sqrt(said * (1 - said) / people))


def test_a_phantom_of_two_people_s_parts_is_not_chosen():
    parts = [[0, 1, 4, 5]] * 20
    assert stretches(evidence_of((parts, 0), ([ANNA] * 20, 1), ([BERT] * 20, 1))) == [
        (1, 0, 20),
        (2, 0, 20),
    ]


def test_whoever_goes_over_from_one_person_to_another_does_not_win_against_both():
    """Each is seen well in one half only, three places against two; the one that goes over has the
    best of both, 1.425 s against 1.137. What is left is two halves with two detections each.
    """
    anna, bert = [ANNA[:3]] * 10 + [ANNA[:2]] * 10, [BERT[:2]] * 10 + [BERT[:3]] * 10
    over = [ANNA[:3]] * 10 + [BERT[:3]] * 10
    chosen = evidence_of((over, 0), (anna, 1), (bert, 1))
    assert stretches(chosen) == [(1, 0, 20), (2, 0, 20)]
    np.testing.assert_allclose(chosen.evidence_s, 2 * (1.15 * 5 / 8 - 0.15), rtol=1e-6)


@pytest.mark.parametrize("gap", [1, 8, 15])
def test_a_stretch_ends_where_evidence_ends_and_not_at_a_gap(gap):
    """A gap costs 0.15 of its time; to vanish and appear again costs 0.25 s: the same after 1.67
    s.
    """
    frames = [ANNA] * 10 + [NONE] * gap + [ANNA] * 10 + [NONE] * 15
    assert stretches(evidence_of((frames, 0))) == [(0, 0, 20 + gap)]


def test_what_comes_after_a_long_gap_must_be_worth_it():
    """Two frames are 0.2 s, 1.8 s without evidence cost 0.27; either end costs the same."""
    frames = [ANNA] * 10 + [NONE] * 18 + [ANNA] * 2 + [None] * 5
    assert stretches(evidence_of((frames, 0))) == [(0, 0, 10)]


def test_nobody_is_there_in_frames_in_which_nobody_is_followed():
    frames = [None] * 3 + [ANNA] * 10 + [None] * 2 + [ANNA] * 10
    chosen = evidence_of((frames, 0))
    assert stretches(chosen) == [(0, 3, 13), (0, 15, 25)]
    assert [chosen.during(t).sum() for t in (2, 3, 12, 13, 14, 15, 24)] == [0, 1, 1, 0, 0, 1, 1]


@pytest.mark.parametrize("step_s", [1 / 60, 1 / 10])
@pytest.mark.parametrize(("seconds", "there"), [(0.2, False), (0.3, True)])
def test_how_long_somebody_must_be_seen_is_a_matter_of_seconds(step_s, seconds, there):
    """Two ends cost 0.25 s, less than 0.1 s of evidence is nobody: 0.35 s of all places; at the
    recording's start one end costs nothing: 0.225 s.
    """
    n, T = round(seconds / step_s), round(2 / step_s)
    frames = [ANNA] * n + [None] * (T - n)
    assert (len(evidence_of((frames, 0), step_s=step_s)) == 1) == there


@pytest.mark.parametrize("step_s", [1 / 60, 1 / 10])
@pytest.mark.parametrize("length_s", [0.2, 0.4, 2.0])
def test_in_a_short_recording_little_evidence_is_enough(step_s, length_s):
    """A person seen in one place of four has 0.14 s of evidence a second and is probably there (79
    %), however short the recording; one seen so in every other frame has none.
    """
    T = round(length_s / step_s)
    chosen = evidence_of(([ANNA] * T, 0), ([BERT[:1]] * T, 0), step_s=step_s)
    assert stretches(chosen) == [(0, 0, T), (1, 0, T)]
    seldom = [BERT[:1] if t % 2 == 0 else NONE for t in range(T)]
    assert stretches(evidence_of(([ANNA] * T, 0), (seldom, 0), step_s=step_s)) == [(0, 0, T)]


def test_on_trial_a_quarter_of_what_is_asked_for_is_enough():
    """0.2 s of all places, less two ends at 0.03 s each; six frames later, a frame that is half
    seen is nobody.
    """
    frames = [None] * 5 + [ANNA] * 2 + [None] * 6 + [ANNA[:2]] + [None] * 6
    assert stretches(evidence_of((frames, 0), on_trial=True)) == [(0, 5, 7)]
    assert len(evidence_of((frames, 0))) == 0


def test_a_frame_alone_stands_for_a_second_and_others_up_to_halfway_to_their_neighbours():
    np.testing.assert_allclose(lasting(np.array([3.0])), [1.0])
    np.testing.assert_allclose(lasting(np.array([0.0, 0.1, 0.4, 0.5])), [0.1, 0.2, 0.2, 0.1])
    assert len(evidence_of(([ANNA[:2]], 0), step_s=1.0)) == 1


def test_the_order_of_hypotheses_changes_nothing():
    rng = np.random.default_rng(0)
    rows = [
        (
            [rng.permutation(8)[: rng.integers(1, 5)].tolist() for _ in range(12)],
            int(rng.integers(3)),
        )
        for _ in range(7)
    ]
    order = rng.permutation(7)
    chosen, other = evidence_of(*rows), evidence_of(*(rows[n] for n in order))
    again = [(int(order[h]), start, stop) for h, start, stop in stretches(other)]
    assert sorted(again) == stretches(chosen) and len(chosen) > 0


def test_nobody_among_nobody():
    assert len(evidence_of(times=5)) == 0


def test_detections_count_by_the_affinity_to_the_same_person_s(
    five_cameras, two_people, seen_exactly
):
    """Exact detections have affinities of 0.9 to the same person's, and 0 to the other's: one wrist
    that is the other's counts nothing, one elbow without neighbours a half.
    """
    detections = seen_exactly(five_cameras, two_people)
    xy, _ = five_cameras.project(two_people)
    own = np.full((2, 25, 5), -1)
    for n in range(len(detections)):
        view, joint = detections.view[n], detections.joint[n]
        person = np.linalg.norm(xy[view, :, joint] - detections.xy[n], axis=-1).argmin()
        own[person, joint, view] = n
    wrist, elbow = BODY_25.index("RWrist"), BODY_25.index("RElbow")
    candidate = own.copy()
    candidate[0, wrist, 1] = own[1, wrist, 1]
    candidate[1, :, 2] = -1
    candidate[1, elbow, 2] = own[1, elbow, 2]
    weight, _ = weighed(
        candidate,
        two_people,
        FrameArrays.of(detections, five_cameras, BODY_25),
        BODY_25,
        np.arange(2),
    )
    whole = weight[0, wrist, 0]
    assert weight[0, wrist, 1] == 0.0 and weight[1, elbow, 2] == whole / 2
    assert weight[1, :, 2].sum() == whole / 2, "what nobody has counts nothing"
    assert (weight[0, :, [0, 2, 3, 4]] == whole).all() and (
        weight[1, :, [0, 1, 3, 4]] == whole
    ).all()


def test_who_is_seen_wholly_has_a_second_of_evidence_in_a_second(
    five_cameras, two_people, seen_exactly
):
    """Whatever hides them: a place that is seen costs nothing. Unseen in plain view they cost
    0.4.
    """
    detections = seen_exactly(five_cameras, two_people[:1])
    own = np.full((1, 25, 5), -1)
    own[0, detections.joint, detections.view] = np.arange(len(detections))
    beside = np.concatenate([two_people[:1], two_people[:1] + 0.3])
    arrays = FrameArrays.of(detections, five_cameras, BODY_25)
    for places, candidate in (
        (two_people[:1], own),
        (beside, np.concatenate([own, np.full_like(own, -1)])),
    ):
        weight, price = weighed(candidate, places, arrays, BODY_25, np.zeros(len(places), int))
        np.testing.assert_allclose(weight[0].sum() - price[0], 1.0)
    none = np.full_like(own, -1), two_people[:1], arrays, BODY_25, np.zeros(1, int)
    assert weighed(*none)[1] == pytest.approx(0.4)


@pytest.mark.parametrize(("metres", "hides"), [(0.6, True), (0.05, False), (-0.6, False)])
def test_a_joint_behind_somebody_else_costs_little_unseen(
    five_cameras, two_people, seen_exactly, metres, hides
):
    """Somebody else stands on the way to the camera, or so near that nobody is in front, or behind.
    Both are flat, and face the camera: no limb of theirs is in front of another. In other worlds
    nobody is in the way.
    """
    rig = replace(five_cameras, cameras=five_cameras.cameras[:1])
    person = two_people[:1]
    to_camera = -np.linalg.inv(rig.cTw[0, :, :3]) @ rig.cTw[0, :, 3] - person[0].mean(axis=0)
    towards = to_camera / np.linalg.norm(to_camera)
    person = person - ((person - person[0].mean(axis=0)) @ towards)[..., None] * towards
    places, none = np.concatenate([person, person + metres * towards]), np.full((2, 25, 1), -1)
    arrays = FrameArrays.of(seen_exactly(rig, person), rig, BODY_25)
    price = weighed(none, places, arrays, BODY_25, np.zeros(2, int))[1][0]
    assert price < 0.4 - 0.8 * 0.35 if hides else price == pytest.approx(0.4)
    apart = weighed(none, places, arrays, BODY_25, np.arange(2))[1]
    np.testing.assert_allclose(apart, 0.4)


def test_joints_outside_the_picture_cost_nothing_and_unknown_ones_little(
    five_cameras, two_people, seen_exactly
):
    """Nobody is expected behind a camera; of 25 joints 15 are unknown: 15 of 25 places at 0.05, 10
    at 0.4.
    """
    far = two_people[:1] + np.array([0.0, 0.0, 100.0])
    detections = seen_exactly(five_cameras, two_people)
    none, zero = np.full((1, 25, 5), -1), np.zeros(1, dtype=np.intp)
    assert weighed(none, far, FrameArrays.of(detections, five_cameras, BODY_25), BODY_25, zero)[
        1
    ].tolist() == [0]
    half = two_people[:1].copy()
    half[0, 10:] = np.nan
    price = weighed(none, half, FrameArrays.of(detections, five_cameras, BODY_25), BODY_25, zero)[1]
    np.testing.assert_allclose(price, (10 * 0.4 + 15 * 0.05) / 25)


def test_ways_agree_where_people_have_the_same_detections():
    """Two people, in either order, agree; those who change places halfway agree in half; one is
    half of two.
    """
    first, second = [[0, 1]] * 10, [[2, 3]] * 10
    account = account_of([first, second, first[:5] + second[:5], second[:5] + first[:5]])

    def way(*who: int) -> SelectedTracks:
        return SelectedTracks(
            np.array(who), np.zeros(len(who), int), np.full(len(who), 10), np.ones(len(who))
        )

    assert account.agreement(way(0, 1), way(1, 0)) == 1.0
    assert account.agreement(way(0, 1), way(2, 3)) == 0.5
    assert account.agreement(way(0, 1), way(1)) == 0.5
    assert account.agreement(way(), way()) == 1.0


def test_the_best_way_is_the_first():
    """Who goes over from one person to another comes first in one way, the two of one world in a
    better one.
    """
    first, second = [[0, 1, 2]] * 10, [[4, 5, 6]] * 10
    changed = [[0, 1, 2, 3]] * 5 + [[4, 5, 6, 7]] * 5
    account = account_of([first, second, changed])
    best, *others = account.ways(np.array([0, 0, 1]))
    assert {0, 1} <= set(best.hypothesis.tolist())
    explained_s = [float(each.evidence_s.sum()) for each in (best, *others)]
    assert explained_s == sorted(explained_s, reverse=True) and explained_s[0] > explained_s[-1]
    assert any(each.hypothesis[0] == 2 for each in others)
