"""Before and after stage II: worked out by hand, and on a scene."""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.evaluation.alternation import BeforeRefinement, alternation_errors, before_refinement
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct
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
    errors = alternation_errors(
        BeforeRefinement(np.zeros(1, int), first[None], confidence), one_person(last), truth
    )
    groups = errors.groups(rho_3d=0.25)
    assert [int(mask.sum()) for mask in groups.values()] == [23, 1, 1]
    well, badly, unseen = groups.values()
    np.testing.assert_allclose(errors.before_mm[badly], 500)
    np.testing.assert_allclose(errors.after_mm[badly], 100)
    np.testing.assert_allclose(errors.after_mm[unseen], 20)
    assert np.isnan(errors.before_mm[unseen]).all()
    assert errors.after_mm[well].max() == 0


def test_people_are_those_who_are_found_both_times():
    """Two people 2 m apart: stage I has both, in the other order, the result only the second, 10 mm off."""
    truth = np.random.default_rng(0).normal(0, 0.3, size=(1, 2, 25, 3))
    truth[0, 1] += [2.0, 0, 0]
    before = BeforeRefinement(np.zeros(2, int), truth[0, ::-1] + [0, 0.03, 0], np.full((2, 25), 0.5))
    errors = alternation_errors(before, one_person(truth[0, 1] + [0, 0, 0.01]), truth)
    assert errors.before_mm.shape == (25,)
    np.testing.assert_allclose(errors.before_mm, 30)
    np.testing.assert_allclose(errors.after_mm, 10)
    nobody = BeforeRefinement(np.zeros(0, int), np.zeros((0, 25, 3)), np.zeros((0, 25)))
    assert len(alternation_errors(nobody, one_person(truth[0, 1]), truth).after_mm) == 0


@pytest.mark.slow
def test_stage_two_helps_whom_the_views_see_badly():
    """What the project promises; misses are frequent here, so that few frames hold enough doubtful joints."""
    scene = built_in_scene(1000, frames=10)
    detections = simulate(scene, DetectorConfig(misses=3.0), seed=1000)
    alone = replace(PipelineConfig(), temporal=False)
    before, people = before_refinement(detections, scene.rig), reconstruct(detections, scene.rig, alone)
    errors = alternation_errors(before, people, scene.keypoints)
    well, badly, _ = errors.groups(rho_3d=0.25).values()
    assert badly.sum() >= 20
    assert errors.after_mm[badly].mean() < 0.8 * errors.before_mm[badly].mean()
    assert errors.after_mm[well].mean() < errors.before_mm[well].mean()
