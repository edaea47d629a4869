"""Stage I (e): every person's own 2D observations, in every view."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.proposal.association import associate
from shapepose_fg.proposal.candidates import CandidateConfig, triangulate_pairs, vote
from shapepose_fg.proposal.proposals import ProposalConfig, propose

UP = np.array([0.0, 0.0, 1.0])
HIP, WRIST, KNEE = (BODY_25.index(name) for name in ("MidHip", "RWrist", "LKnee"))


def observe(
    detections: Detections, rig: Rig, truth: NDArray[np.float64], **settings
) -> Observations:
    """Stage I, its people put into the order of the truth (each true person found exactly once)."""
    config = CandidateConfig()
    candidates = vote(triangulate_pairs(detections, rig, config), detections, len(rig), config)
    proposals = propose(candidates, detections, BODY_25, UP, ProposalConfig())
    found, _ = associate(
        proposals, candidates, detections, rig, BODY_25, ProposalConfig(**settings)
    )
    if len(truth) == 0:
        return found
    distance = np.nanmean(np.linalg.norm(found.initial[:, None] - truth[None], axis=-1), axis=-1)
    order = distance.argmin(axis=0)
    assert sorted(order) == list(range(len(found))), f"{len(found)} people found, of {len(truth)}"
    return Observations(found.xy[order], found.confidence[order], found.initial[order])


def owners_of(detections: Detections, rig: Rig, truth: NDArray[np.float64]) -> NDArray[np.intp]:
    """(P, J, V) the detection that lies exactly on each joint's projection; -1 where there is
    none.
    """
    xy, _ = rig.project(truth)
    distance = np.linalg.norm(
        xy[detections.view, :, detections.joint] - detections.xy[:, None], axis=-1
    )
    row, person = np.nonzero(distance < 1e-6)
    owners = np.full((len(truth), len(BODY_25), len(rig)), -1)
    # Written backwards: of a detection that is listed twice, the first counts.
    owners[person[::-1], detections.joint[row[::-1]], detections.view[row[::-1]]] = row[::-1]
    return owners


def assert_each_has_its_own(
    seen: Observations, detections: Detections, owners: NDArray[np.intp]
) -> None:
    """The observations are the very numbers of the detections; where there is none they are
    zero.
    """
    there = owners >= 0
    np.testing.assert_array_equal(seen.seen, there)
    np.testing.assert_array_equal(seen.xy, np.where(there[..., None], detections.xy[owners], 0.0))
    np.testing.assert_array_equal(
        seen.confidence, np.where(there, detections.confidence[owners], 0.0)
    )


def add(detections: Detections, view, joint, xy, confidence: float) -> Detections:
    """More candidates, with no affinity to anything."""
    return Detections(
        np.append(detections.view, view),
        np.append(detections.joint, joint),
        np.vstack([detections.xy, xy]),
        np.append(detections.confidence, np.full(len(xy), confidence)),
        detections.pairs,
        detections.affinity,
    )


def test_every_detection_goes_to_its_owner(five_cameras, two_people, seen_exactly):
    exact = seen_exactly(five_cameras, two_people)
    # Different confidences, so that a swap shows in them too.
    exact = replace(exact, confidence=np.random.default_rng(0).uniform(0.5, 0.9, len(exact)))
    seen = observe(exact, five_cameras, two_people)
    owners = owners_of(exact, five_cameras, two_people)
    assert sorted(owners.ravel()) == list(range(len(exact)))
    assert_each_has_its_own(seen, exact, owners)
    np.testing.assert_allclose(seen.initial, two_people, atol=0.005)


def test_outliers_are_nobody_s(five_cameras, two_people, seen_exactly):
    """In every view each joint has a false candidate half a metre beside the first person's true
    one.
    """
    exact = seen_exactly(five_cameras, two_people)
    xy, depth = five_cameras.project(two_people[0])
    angle = np.random.default_rng(0).uniform(0, 2 * np.pi, xy.shape[:2])
    aside = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * 0.5 / depth[..., None]
    view, joint = (index.ravel() for index in np.indices(xy.shape[:2]))
    false = (xy + aside * five_cameras.focal_px[:, None, None]).reshape(-1, 2)
    detections = add(exact, view, joint, false, 0.6)
    seen = observe(detections, five_cameras, two_people)
    owners = owners_of(exact, five_cameras, two_people)
    taken = seen.seen
    right = np.all(seen.xy == exact.xy[owners], axis=-1)
    # By chance a false candidate lands on the other person's joint; almost all are the own ones.
    assert (taken & right).mean() > 0.98
    assert not (taken & ~right)[0].any(), (
        "none of the candidates half a metre off is the first person's"
    )


def test_a_missing_view_and_a_view_without_people(five_cameras, two_people, seen_exactly):
    exact = seen_exactly(five_cameras, two_people)
    xy, _ = five_cameras.project(two_people)
    first = np.linalg.norm(exact.xy - xy[exact.view, 0, exact.joint], axis=1) < 1e-6
    detections = exact.only((exact.view != 3) & ~(first & (exact.view == 1)))
    seen = observe(detections, five_cameras, two_people)
    assert_each_has_its_own(seen, detections, owners_of(detections, five_cameras, two_people))
    assert (
        not seen.seen[:, :, 3].any() and not seen.seen[0, :, 1].any() and seen.seen[1, :, 1].all()
    )


def test_a_duplicate_detection_is_used_once(five_cameras, two_people, seen_exactly):
    """The detector reports the first person's wrist twice in view 2, the second time 4 px off and
    unlinked.
    """
    exact = seen_exactly(five_cameras, two_people)
    xy, _ = five_cameras.project(two_people[0])
    detections = add(exact, [2], [WRIST], [xy[2, WRIST] + [4.0, 0.0]], 0.7)
    seen = observe(detections, five_cameras, two_people)
    assert_each_has_its_own(seen, detections, owners_of(detections, five_cameras, two_people))


@pytest.mark.parametrize("views", [1, 2])
@pytest.mark.parametrize("joint", ["RWrist", "LKnee", "Nose"])
def test_a_joint_that_few_views_see_is_observed_all_the_same(
    five_cameras, two_people, seen_exactly, views, joint
):
    """Two views are one pair of rays, which is no cluster; one view is no pair. Both must reach
    stage II.
    """
    joint = BODY_25.index(joint)
    exact = seen_exactly(five_cameras, two_people)
    detections = exact.only((exact.joint != joint) | (exact.view < views))
    seen = observe(detections, five_cameras, two_people)
    assert seen.seen[:, joint].sum(axis=-1).tolist() == [views, views]
    owners = owners_of(detections, five_cameras, two_people)
    np.testing.assert_array_equal(seen.seen[:, joint], owners[:, joint] >= 0)
    np.testing.assert_array_equal(
        seen.xy[:, joint, :views], detections.xy[owners[:, joint, :views]]
    )
    if views == 1:
        assert np.isnan(seen.initial[:, joint]).all(), "one view does not say where the joint is"


def test_a_lone_candidate_without_affinity_is_not_taken(five_cameras, two_people, seen_exactly):
    """A wrist that one view reports and no limb supports is anybody's."""
    exact = seen_exactly(five_cameras, two_people)
    detections = exact.only(exact.joint != WRIST)
    xy, _ = five_cameras.project(two_people[0])
    detections = add(detections, [2], [WRIST], [xy[2, WRIST]], 0.9)
    seen = observe(detections, five_cameras, two_people)
    assert not seen.seen[:, WRIST].any()


def behind(two_people: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.float64]:
    """The second one stands behind the first one as seen from `centre`, knee behind knee, 0.4 to
    0.5 m off.
    """
    people = two_people.copy()
    people[1] += centre + (people[0, KNEE] - centre) * 1.12 - people[1, KNEE]
    return people


def test_where_two_people_overlap_one_detection_serves_both(five_cameras, two_people, seen_exactly):
    """In view 0 the second one's knee lies on the line through the first one's: the detector sees
    one joint.

    It is linked to both people's hips and ankles, as the part affinities of two overlapping legs
    are.
    """
    people = behind(two_people, five_cameras.cameras[0].centre)
    exact = seen_exactly(five_cameras, people)
    owners = owners_of(exact, five_cameras, people)
    merged = exact.joint == KNEE
    rows = np.flatnonzero(merged & (exact.view == 0))
    assert len(rows) == 2 and np.linalg.norm(np.diff(exact.xy[rows], axis=0)) < 1e-6
    stays, goes = rows
    joined = replace(exact, pairs=np.where(exact.pairs == goes, stays, exact.pairs))
    detections = joined.only(np.arange(len(exact)) != goes)
    seen = observe(detections, five_cameras, people)
    assert seen.seen.all()
    np.testing.assert_array_equal(seen.xy[0, KNEE, 0], seen.xy[1, KNEE, 0])
    np.testing.assert_allclose(seen.xy[0, KNEE, 0], exact.xy[stays], atol=1e-6)
    assert (owners[:, KNEE, 1:] >= 0).all() and not np.allclose(
        seen.xy[0, KNEE, 1], seen.xy[1, KNEE, 1]
    )


def test_close_people_who_do_not_overlap_share_nothing(five_cameras, two_people, seen_exactly):
    """One detection is missing where two knees are 8 cm apart: it is not lent to the other."""
    people = behind(two_people, five_cameras.cameras[0].centre)
    people[1, :, 2] += 0.08
    exact = seen_exactly(five_cameras, people)
    owners = owners_of(exact, five_cameras, people)
    detections = exact.only(np.arange(len(exact)) != owners[1, KNEE, 0])
    seen = observe(detections, five_cameras, people)
    assert_each_has_its_own(seen, detections, owners_of(detections, five_cameras, people))
    assert seen.seen[0, KNEE, 0] and not seen.seen[1, KNEE, 0]


def test_noise_of_a_detector_changes_no_owner(five_cameras, two_people, seen_exactly):
    """4 px at 3 to 4 m are 1.5 cm, a tenth of the width of a trunk."""
    exact = seen_exactly(five_cameras, two_people)
    noisy = replace(exact, xy=exact.xy + np.random.default_rng(0).normal(0, 4.0, exact.xy.shape))
    seen = observe(noisy, five_cameras, two_people)
    owners = owners_of(exact, five_cameras, two_people)
    assert np.all(seen.xy == noisy.xy[owners], axis=-1).mean() > 0.99


def test_nobody_has_no_observations(five_cameras):
    empty = Detections.empty()
    seen = observe(empty, five_cameras, np.zeros((0, 25, 3)))
    assert len(seen) == 0 and seen.xy.shape == (0, 25, 5, 2) and seen.initial.shape == (0, 25, 3)


def test_refuses_settings_that_make_no_sense():
    with pytest.raises(ValueError, match="min_observed_parts"):
        ProposalConfig(min_observed_parts=-0.1)
