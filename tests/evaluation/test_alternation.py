"""Before and after stage II: worked out by hand, and row by row the same people."""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.evaluation.alternation import BeforeRefinement, alternation_errors, before_refinement
from shapepose_fg.pipeline import reconstruct
from shapepose_fg.reconstruction import Reconstruction
from shapepose_fg.simulation import DetectorConfig, built_in_scene, simulate


def one_person(joints: np.ndarray) -> Reconstruction:
    """A reconstruction of one person in frame 0 with `joints` (25, 3)."""
    nobody = Reconstruction.empty()
    columns = {name: getattr(nobody, name) for name in Reconstruction.ROWS}
    rows = {name: np.zeros((1, *column.shape[1:]), column.dtype) for name, column in columns.items()}
    rows |= {"status": np.array(["ok"])}
    return replace(nobody, **rows | {"joints": joints[None]})


def test_errors_and_groups_by_hand():
    truth = np.random.default_rng(0).normal(size=(1, 1, 25, 3))
    first, last, confidence = truth[0, 0].copy(), truth[0, 0].copy(), np.full((1, 25), 0.5)
    first[3] += [0.3, 0.0, 0.4]  # 500 mm off, seen badly, nearer afterwards
    last[3] += [0.0, 0.1, 0.0]
    confidence[0, 3] = 0.1
    first[7] = np.nan  # filled in, 20 mm off; its confidence does not matter
    last[7] += [0.0, 0.0, 0.02]
    errors = alternation_errors(BeforeRefinement(first[None], confidence), one_person(last), truth)
    groups = errors.groups(rho_3d=0.25)
    assert [int(mask.sum()) for mask in groups.values()] == [23, 1, 1]
    well, badly, unseen = groups.values()
    np.testing.assert_allclose(errors.before_mm[badly], 500)
    np.testing.assert_allclose(errors.after_mm[badly], 100)
    np.testing.assert_allclose(errors.after_mm[unseen], 20)
    assert np.isnan(errors.before_mm[unseen]).all()
    assert errors.after_mm[well].max() == 0


def test_refuses_another_recording():
    person = one_person(np.zeros((25, 3)))
    two = BeforeRefinement(np.zeros((2, 25, 3)), np.zeros((2, 25)))
    with pytest.raises(ValueError, match="one recording and one configuration"):
        alternation_errors(two, person, np.zeros((1, 1, 25, 3)))


def test_stage_two_helps_whom_the_views_see_badly():
    """What the project promises; misses are frequent here, so that few frames hold enough doubtful joints."""
    scene = built_in_scene(1000, frames=10)
    detections = simulate(scene, DetectorConfig(misses=3.0), seed=1000)
    before, people = before_refinement(detections, scene.rig), reconstruct(detections, scene.rig)
    # Row by row the same people: most joints hardly move.
    assert before.joints.shape == people.joints.shape
    assert np.nanmedian(np.linalg.norm(before.joints - people.joints, axis=-1)) < 0.02
    errors = alternation_errors(before, people, scene.keypoints)
    well, badly, _ = errors.groups(rho_3d=0.25).values()
    assert badly.sum() >= 20
    assert errors.after_mm[badly].mean() < 0.8 * errors.before_mm[badly].mean()
    assert errors.after_mm[well].mean() < errors.before_mm[well].mean()
