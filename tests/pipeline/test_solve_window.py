"""Stage II of one window: detections are given out again where something changes."""

import numpy as np

from shapepose_fg.body.fitting.fitters import BodyConfig, make_fitter
from shapepose_fg.core.camera import Views
from shapepose_fg.core.detections import Detections, Input
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.pipeline.solve_window import Assigning, solve_window
from shapepose_fg.simulation import built_in_scene

T, ARM = 60, [BODY_25.joints.index(name) for name in ("RElbow", "RWrist")]
WRONG = range(40, 44)


def test_wrong_detections_are_exchanged():
    """A person before five cameras for two seconds, with an arm's detections 30 cm off in four
    frames, beside the true ones.
    """
    scene = built_in_scene(people=1, cameras=5, frames=T)
    truth, rng = scene.keypoints[:, 0], np.random.default_rng(0)
    frames, parts = [], []
    for t in range(T):
        joints = truth[t] + rng.normal(0, 5e-3, truth[t].shape)
        aside = joints + np.array([0.3, 0.0, 0.0])
        xy = np.concatenate([scene.rig.project(each)[0] for each in (joints, aside[ARM])], axis=1)
        joint = np.concatenate([np.arange(25), ARM])
        view, index = (each.ravel() for each in np.indices(xy.shape[:2]))
        score, pairs = np.full(xy[..., 0].size, 0.8), np.zeros((0, 2), dtype=int)
        found = Detections(view, joint[index], xy.reshape(-1, 2), score, pairs, np.zeros(0))
        time_s = np.full(5, t / scene.fps)
        frames.append(Input(t, time_s, found, scene.rig))
        candidate = np.arange(25)[:, None] + xy.shape[1] * np.arange(5)
        if t in WRONG:
            candidate[ARM] = np.arange(25, 27)[:, None] + xy.shape[1] * np.arange(5)
        when = {"frame": np.array([t]), "time_s": time_s[None], "track": np.array([0])}
        parts.append(Observations.of(candidate[None], found, truth[t][None], **when))
    rows = Observations.concatenate(parts)
    asked = Assigning(frames, BODY_25, 8, over_time=True)
    fitter, views = make_fitter(BodyConfig()), Views.of(scene.rig)
    found = solve_window(rows, views, fitter, EstimatorConfig(), assigning=asked).observations
    np.testing.assert_array_equal(found.frame, rows.frame)
    given = found.candidate >= 0
    assert given.mean() > 0.95
    is_wrong = given & (found.candidate % 27 >= 25)
    assert is_wrong.sum() < (rows.candidate % 27 >= 25).sum() / 2
    assert not is_wrong[~np.isin(found.frame, WRONG)].any()


def test_people_without_detections_keep_their_rows():
    """A window in which nobody is seen, of a recording in which cameras are covered for a while."""
    scene = built_in_scene(people=1, cameras=3, frames=4)
    frames = [Input(t, np.full(3, t / scene.fps), Detections.empty(), scene.rig) for t in range(4)]
    rows = Observations.concatenate(
        [
            Observations.of(
                np.full((1, 25, 3), -1), each.detections, scene.keypoints[each.frame],
                frame=np.array([each.frame]), time_s=each.time_s[None], track=np.array([0]),
            )
            for each in frames
        ]
    )  # fmt: skip
    asked = Assigning(frames, BODY_25, 8, over_time=True)
    fitter, views = make_fitter(BodyConfig()), Views.of(scene.rig)
    found = solve_window(rows, views, fitter, EstimatorConfig(), assigning=asked).observations
    np.testing.assert_array_equal(found.frame, rows.frame)
    assert not found.seen.any()
