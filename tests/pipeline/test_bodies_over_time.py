"""People recognised from one recording to the next, by shape: their names, and what is known of
them.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.body.fitting.fitter import Shapes
from shapepose_fg.body.fitting.fitters import SmplFitter, make_fitter
from shapepose_fg.body.fitting.weights import fingerprint
from shapepose_fg.body.model.body_model import BodyParameters
from shapepose_fg.body.shapes import SubjectShapes
from shapepose_fg.core.reconstruction import Reconstruction, Status
from shapepose_fg.core.storage.kept_arrays import InMemory
from shapepose_fg.estimation.floor import Floor
from shapepose_fg.pipeline.bodies_over_time import (
    SEGMENT_ROWS,
    BodiesOverTime,
    Person,
    fit_everybody,
    with_bodies_over_time,
)
from shapepose_fg.simulation import Scene, built_in_scene
from shapepose_fg.simulation.files import truth_of

SIGMA_M = 0.003
"""Joints known so well tell shapes apart in two dozen frames."""


def seen(scene: Scene, frames: slice, seed: int) -> Reconstruction:
    """The scene's people in these frames, taken 2 s apart (each tells of the shape anew), joints
    with noise.
    """
    truth = truth_of(scene)
    people = truth.rows(np.isin(truth.frame, np.arange(len(scene))[frames]))
    noise = np.random.default_rng(seed).normal(0, SIGMA_M, people.joints.shape)
    covariance = np.broadcast_to(SIGMA_M**2 * np.eye(3), people.covariance.shape)
    return replace(
        people, time_s=2.0 * people.frame, joints=people.joints + noise, covariance=covariance
    )


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
    first = with_bodies_over_time(seen(scene, slice(0, 24), 0), fitter).shapes
    assert first.names.tolist() == ["0", "1", "2"]
    # In the next recording they have other numbers, and one of them was not in the first.
    people = seen(scene, slice(24, 48), 1)
    people = people.relabelled(np.array([7, 0, 1])[people.person])
    known = first.rows(np.array([0, 1])).named(["Ann", "1"])
    alone = with_bodies_over_time(people, fitter)
    second = with_bodies_over_time(people, fitter, known)
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


def test_nobody_and_no_file(scene, fitter):
    people = seen(scene, slice(0, 4), 0)
    assert with_bodies_over_time(people.rows(np.zeros(0, int)), fitter).shapes is None
    other = SubjectShapes.empty("another body")
    with pytest.raises(ValueError, match="same body model"):
        with_bodies_over_time(people, fitter, other)


def test_bodies_stand_on_the_floor_that_was_found(scene, fitter):
    """A floor 20 cm above the scene's own: whoever stands there is lifted out of it."""
    people, floor = (
        seen(scene, slice(0, 4), 0),
        Floor(np.array([0.0, 0.0, 1.0]), 0.2, 0.01, 100, 1.0),
    )
    lowest = []
    for each in (None, floor):
        found = with_bodies_over_time(people, fitter, floor=each)
        columns = (found.betas, found.global_orient, found.body_pose, found.transl)
        points = fitter.model.vertices(BodyParameters(*columns))
        lowest.append(points[..., 2].min().item())
    assert lowest[0] < 0.1 and lowest[1] > 0.17


def test_every_row_gets_its_own_body():
    """Person 3 has five rows in two segments, person 8 three in one; windows of four rows each,
    people mixed.
    """
    names = {3: {"a": range(0, 3), "b": range(3, 5)}, 8: {"c": range(3)}}
    kept, number = InMemory(), {"a": [30, 31, 32], "b": [33, 34], "c": [80, 81, 82]}
    for name, values in number.items():
        ok = np.array(values) != 81
        kept.keep(name, {"ok": ok, "transl": np.array(values)[:, None] + np.zeros(3)})
    bodies = BodiesOverTime(kept, names, SubjectShapes.empty("b" * 64))
    statuses = np.array(
        [Status.OK, Status.BODY_UNDETERMINED, Status.BODY_UNDETERMINED, Status.NOT_SOLVED]
    )
    for person, before, expected in (
        ([8, 3, 3, 8], {}, [80, 30, 31, -1]),
        ([3, 8, 3, 3], {3: 2, 8: 2}, [32, 82, 33, 34]),
    ):
        whose, found = np.array(person), np.full((4, 3), -1.0)
        assert bodies.filled("transl", found, whose, before)[:, 0].tolist() == expected
        assert (found == -1).all(), "what was given stays as it was"
        status = bodies.filled("status", statuses, whose, before)
        assert status.tolist() == [Status.OK, Status.OK, Status.OK, Status.NOT_SOLVED]
        undetermined = np.full(4, Status.BODY_UNDETERMINED)
        has_body = bodies.filled("status", undetermined, whose, before) == Status.OK
        assert has_body.tolist() == [each >= 0 for each in expected]
        assert bodies.filled("joints", found, whose, before) is found


@pytest.mark.slow
def test_a_long_track_is_fitted_in_stretches_that_fit_together(fitter):
    """240 frames at 25 a second in three stretches against one: the same person, without a step at
    the borders.
    """
    scene = built_in_scene(people=1, frames=240)
    people = seen(scene, slice(0, 240), 0)
    people = replace(people, time_s=people.frame / 25)
    given = []

    def person(number: int, parts: Sequence[range]) -> Person:
        given.append([*parts])
        mine = np.concatenate(parts)
        return Person.of(number, people.joints[mine], people.covariance[mine], people.time_s[mine])

    def fitted(stretch_rows: int) -> tuple[BodiesOverTime, BodyParameters]:
        nobody = SubjectShapes.empty(fingerprint(fitter.model))
        bodies = fit_everybody(
            {0: 240}, person, lambda jobs: (job.fitted(fitter) for job in jobs), InMemory(), nobody,
            (stretch_rows, 20),
        )  # fmt: skip
        columns = ("betas", "global_orient", "body_pose", "transl")
        parts = [bodies.filled(name, getattr(people, name), people.person, {}) for name in columns]
        return bodies, BodyParameters(*parts)

    whole, expected = fitted(SEGMENT_ROWS)
    assert given == [[range(240)]]
    given.clear()
    cut, found = fitted(80)
    assert [*cut.places[0].values()] == [range(0, 80), range(80, 160), range(160, 240)]
    # The shape is that of pieces from end to end; stretches have 32 rows of their neighbours.
    assert given[0] == [range(0, 20), range(73, 93), range(147, 167), range(220, 240)]
    assert given[1:] == [[range(0, 112)], [range(48, 192)], [range(128, 240)]]
    # One shape, and that of the whole track as far as it is known: ten numbers, one each by chance.
    assert np.ptp(found.betas, axis=0).max() == 0
    apart = (cut.shapes.betas - whole.shapes.betas)[0]
    assert apart @ cut.shapes.information[0] @ apart < 10
    # A third of the rows know less, and say so.
    gain = (
        np.linalg.slogdet(whole.shapes.information[0])[1]
        - np.linalg.slogdet(cut.shapes.information[0])[1]
    )
    assert gain > 1
    # What 80 rows, three looks, leave open of the shape.
    joints, usual = (fitter.model.keypoints(each) for each in (found, expected))
    assert 1e3 * np.linalg.norm(joints - usual, axis=-1).max() < 4
    # With that shape it is the uncut track's bodies, and nothing jumps at a border.
    known = Shapes(cut.shapes.betas, cut.shapes.information)
    uncut = replace(person(0, [range(240)]), shapes=known, fixed_shapes=True).fitted(fitter)
    pose = (uncut[name] for name in ("betas", "global_orient", "body_pose", "transl"))
    same = fitter.model.keypoints(BodyParameters(*pose))
    off_mm = 1e3 * np.linalg.norm(joints - same, axis=-1)
    assert np.median(off_mm) < 0.1 and off_mm.max() < 8
    # With 8 rows of the neighbours half the joints jump by 0.15 mm or more, with 2 one by 7 mm or
    # more.
    apart_mm = 1e3 * np.linalg.norm(np.diff(joints, axis=0) - np.diff(same, axis=0), axis=-1)
    assert np.median(apart_mm[[79, 159]]) < 0.1 and apart_mm[[79, 159]].max() < 2


@pytest.mark.slow
def test_a_long_track_of_somebody_known(fitter):
    """Who is recognised is fitted with what was known before, in a track of several stretches as in
    one of one.
    """
    scene = built_in_scene(people=2, frames=96)
    people = seen(scene, slice(0, 96), 0)
    first = people.rows(people.frame < 48)
    known = with_bodies_over_time(first, fitter).shapes.named(["Ann", "Bob"])
    second = people.rows(people.frame >= 48)
    numbers, counts = np.unique(second.person, return_counts=True)
    assert counts.tolist() == [48, 48]

    def person(number: int, parts: Sequence[range]) -> Person:
        mine = np.flatnonzero(second.person == number)[np.concatenate(parts)]
        return Person.of(number, second.joints[mine], second.covariance[mine], second.time_s[mine])

    def fitted(known: SubjectShapes) -> SubjectShapes:
        everybody = dict.fromkeys(numbers.tolist(), 48)
        jobs = InMemory()
        return fit_everybody(
            everybody,
            person,
            lambda jobs: (job.fitted(fitter) for job in jobs),
            jobs,
            known,
            (24, 8),
        ).shapes

    alone, again = fitted(SubjectShapes.empty(known.body)), fitted(known)
    assert again.names.tolist() == ["Ann", "Bob"]
    gain = np.linalg.slogdet(again.information)[1] - np.linalg.slogdet(alone.information)[1]
    assert gain.min() > 1
