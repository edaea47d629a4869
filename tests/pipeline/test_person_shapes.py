"""One shape per person: combined from what every row says, with bodies whose joints stay; people
recognised from one recording to the next by shape, and what is known of them.
"""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.body.fitting.fitters import SmplFitter, make_fitter
from shapepose_fg.body.model.body_model import BodyParameters
from shapepose_fg.body.shapes import SubjectShapes
from shapepose_fg.core.reconstruction import BODY, Reconstruction
from shapepose_fg.estimation.floor import Floor
from shapepose_fg.pipeline.person_shapes import with_person_shapes
from shapepose_fg.simulation import Scene, built_in_scene
from shapepose_fg.simulation.files import truth_of

SIGMA_M = 0.003
"""Joints known so well tell shapes apart in two dozen frames."""


def seen(scene: Scene, frames: slice, seed: int, apart_s: float = 2.0) -> Reconstruction:
    """The scene's people in these frames, with noise on joints, and in every row the body, with a
    shape of its own, that fits these joints; `apart_s` seconds apart: after two of them, each row
    tells of the shape anew.
    """
    truth = truth_of(scene)
    people = truth.rows(np.isin(truth.frame, np.arange(len(scene))[frames]))
    joints = people.joints + np.random.default_rng(seed).normal(0, SIGMA_M, people.joints.shape)
    covariance = np.broadcast_to(SIGMA_M**2 * np.eye(3), people.covariance.shape)
    fit = make_fitter().fit(JointTargets.solved(joints, covariance))
    assert fit.ok.all()
    bodies = {name: getattr(fit, name) for name in BODY}
    time_s = apart_s * people.frame
    return replace(people, time_s=time_s, joints=joints, covariance=covariance, **bodies)


def keypoints(people: Reconstruction) -> np.ndarray:
    """(R, J, 3) joints of the bodies, metres."""
    return make_fitter().model.keypoints(BodyParameters(*(getattr(people, name) for name in BODY)))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return built_in_scene(people=3, frames=48)


@pytest.fixture(scope="module")
def fitter() -> SmplFitter:
    made = make_fitter()
    assert made.weights is not None
    return made


def of_unlike_people() -> Scene:
    """Two people whose first number of the shape, mostly stature, is far from the mean, and one far
    from both.

    Average people cannot be recognised: that number is known to 0.2, and many adults are like them.
    """
    for seed in range(1000):
        first = built_in_scene(seed, people=3, frames=0).motion.betas[:, 0]
        if np.abs(first[:2]).min() > 1.4 and np.abs(first[2] - first[:2]).min() > 1:
            return built_in_scene(seed, people=3, frames=48)
    raise AssertionError("none of 1,000 scenes has such people")


@pytest.mark.slow
def test_people_keep_their_names_and_strangers_get_free_ones(fitter):
    scene = of_unlike_people()
    first = with_person_shapes(seen(scene, slice(0, 24), 0), fitter.model).shapes
    assert first.names.tolist() == ["0", "1", "2"]
    # In the next recording they have other numbers, and one of them was not in the first.
    people = seen(scene, slice(24, 48), 1)
    people = people.relabelled(np.array([7, 0, 1])[people.person])
    known = first.rows(np.array([0, 1])).named(["Ann", "1"])
    alone = with_person_shapes(people, fitter.model)
    second = with_person_shapes(people, fitter.model, known)
    assert second.shapes.names.tolist() == [
        "1",
        "2",
        "Ann",
    ]  # of persons 0, 1, 7: "1" is somebody else's name
    # What was known counts: shapes of the known are surer than from this recording alone, the
    # stranger's is not.
    gain = (
        np.linalg.slogdet(second.shapes.information)[1]
        - np.linalg.slogdet(alone.shapes.information)[1]
    )
    assert gain[[0, 2]].min() > 1 and abs(gain[1]) < 0.5
    both = known.updated(second.shapes)
    assert sorted(both.names.tolist()) == ["1", "2", "Ann"]


def test_a_person_has_one_shape_and_joints_of_bodies_stay(scene, fitter):
    people, truth = seen(scene, slice(0, 24), 0), truth_of(scene).rows(np.arange(72))
    found = with_person_shapes(people, fitter.model)
    for place, number in enumerate((0, 1, 2)):
        assert (found.betas[found.person == number] == found.shapes.betas[place]).all()
        # As near to the true shape as it says.
        apart = found.shapes.betas[place] - truth.betas[truth.person == number][0]
        assert apart @ found.shapes.information[place] @ apart < 23.2  # 99 % of chi-squared of 10
    # Shapes changed by several millimetres of every bone.
    assert np.linalg.norm(found.betas - people.betas, axis=1).min() > 0.1
    moved = 1e3 * np.linalg.norm(keypoints(found) - keypoints(people), axis=-1)
    assert np.median(moved) < 2 and moved.max() < 20
    error, usual = (
        1e3 * np.linalg.norm(keypoints(each) - truth.joints, axis=-1).mean()
        for each in (found, people)
    )
    assert error < 1.1 * usual


def test_more_frames_in_the_same_time_tell_no_more_of_a_shape(scene, fitter):
    """Errors of joints last: thirty frames of one second are one measurement, not thirty."""
    people = seen(scene, slice(0, 30), 0, apart_s=1 / 30)
    told = [
        np.linalg.eigvalsh(
            with_person_shapes(rows, fitter.model).shapes.information - np.eye(10)
        ).max(axis=1)
        for rows in (people, people.rows(people.frame % 3 == 0))
    ]
    np.testing.assert_allclose(told[0], told[1], rtol=0.2)


def test_rows_without_a_body_stay_so(scene, fitter):
    people = seen(scene, slice(0, 6), 0)
    gone = (people.person == 1) | (people.frame == 3)
    bodies = {
        name: np.where(
            gone.reshape(-1, *[1] * (getattr(people, name).ndim - 1)), np.nan, getattr(people, name)
        )
        for name in BODY
    }
    found = with_person_shapes(replace(people, **bodies), fitter.model)
    np.testing.assert_array_equal(np.isnan(found.betas).any(axis=1), gone)
    np.testing.assert_array_equal(found.shapes.betas[1], 0)  # an adult of whom nothing is known
    np.testing.assert_array_equal(found.shapes.information[1], np.eye(10))


def test_nobody_and_no_file(scene, fitter):
    people = seen(scene, slice(0, 4), 0)
    assert with_person_shapes(people.rows(np.zeros(0, int)), fitter.model).shapes is None
    other = SubjectShapes.empty("another body")
    with pytest.raises(ValueError, match="same body model"):
        with_person_shapes(people, fitter.model, other)


def test_bodies_stand_on_the_floor_that_was_found(scene, fitter):
    """A floor 20 cm above the scene's own: whoever stands there is lifted out of it."""
    people, floor = (
        seen(scene, slice(0, 4), 0),
        Floor(np.array([0.0, 0.0, 1.0]), 0.2, 0.01, 100, 1.0),
    )
    lowest = []
    for each in (None, floor):
        found = with_person_shapes(people, fitter.model, floor=each)
        columns = (found.betas, found.global_orient, found.body_pose, found.transl)
        points = fitter.model.vertices(BodyParameters(*columns))
        lowest.append(points[..., 2].min().item())
    assert lowest[0] < 0.1 and lowest[1] > 0.17
