"""People in single frames: rows of a batch, their graphs, and how sure they are."""

import gtsam
import numpy as np
import pytest

from factors import CONSTANT_VELOCITY
from shapepose_fg.core.reconstruction import Status
from shapepose_fg.estimation import body_solution
from shapepose_fg.estimation.body_frames import BodyFrames
from shapepose_fg.estimation.body_window import BodyState, BodyWindow
from shapepose_fg.estimation.condensed_graph import gtsam_step
from shapepose_fg.estimation.motion_densities import MotionModel
from shapepose_fg.estimation.person_graph import BodyGraph
from shapepose_fg.estimation.reported_covariances import (
    AssociationUncertainty,
    association_features,
    covariance_factors,
)
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.pipeline.pipeline import reconstruct
from shapepose_fg.simulation import built_in_scene, simulate
from tests.estimation.test_body_window import T, _person

WRIST = 4


def frames(kind=BodyFrames, rows=slice(None), hidden=0.2):
    """Frames of one person, each by itself, their truth and a start near it."""
    window, truth, start = _person(5, hidden)
    own = np.arange(T)[rows]
    alone = kind(
        window.observations.rows(own), window.sigmas_px[own], window.views,
        window.energy.model, window.config,
        MotionModel.load(tuple(window.energy.model.keypoint_names)), CONSTANT_VELOCITY,
    )  # fmt: skip
    return alone, truth[own], start[own]


def solved(window: BodyWindow, start: np.ndarray) -> BodyState:
    state = window.solve(start)
    return window.take(state, *gtsam_step(window, state))


def test_rows_of_a_batch_are_what_they_are_by_themselves() -> None:
    window, truth, start = frames()
    state = solved(window, start)
    joints, covariance = window.joints(state), window.covariances(state).joints()
    assert np.linalg.norm(joints - truth, axis=-1).mean() < 0.03
    for row in (0, 7):
        one, _, begin = frames(rows=slice(row, row + 1))
        alone = solved(one, begin)
        np.testing.assert_allclose(one.joints(alone)[0], joints[row], atol=1e-6)
        found = one.covariances(alone).joints()[0]
        np.testing.assert_allclose(found, covariance[row], rtol=1e-4, atol=1e-10)


def test_a_row_is_a_window_of_one_frame(monkeypatch) -> None:
    monkeypatch.setattr(BodyFrames, "deviation_m", BodyWindow.deviation_m)
    window, _, start = frames()
    state = solved(window, start)
    one, _, begin = frames(BodyWindow, slice(3, 4))
    alone = solved(one, begin)
    np.testing.assert_allclose(one.joints(alone)[0], window.joints(state)[3], atol=3e-3)
    np.testing.assert_allclose(
        one.covariances(alone).joints()[0], window.covariances(state).joints()[3], rtol=0.1
    )


def test_marginals_are_those_of_each_row_s_graph() -> None:
    window, _, start = frames()
    state = solved(window, start)
    marginals = window.covariances(state)
    for at, one in window.split(marginals)[::5]:
        built = BodyGraph(one.window, one.state, widen=2.0).build()
        found = gtsam.Marginals(built.graph, built.values)
        for joint in range(0, 25, 6):
            theirs = found.marginalCovariance(int(built.keys[0, joint]))
            np.testing.assert_allclose(
                theirs, 2.0 * marginals.joints()[at[0], joint], rtol=0.02, atol=1e-9
            )
            np.testing.assert_allclose(
                built.values.atPoint3(int(built.keys[0, joint])),
                window.joints(state)[at[0], joint],
                atol=1e-6,
            )


def test_a_person_some_of_whose_detections_are_rejected_is_less_sure() -> None:
    window, _, start = frames(hidden=0.0)
    window.observations.xy[4, :8, 0] += 400.0  # another person's arms and head in one view
    state = solved(window, start)
    marginals = window.covariances(state)
    sigma_m, told, used = association_features(marginals)
    rejected = 1 - used / told
    others = np.arange(T) != 4
    assert rejected[4] > 0.05 and (rejected[others] < 0.01).all()
    factor = covariance_factors(marginals, 1.0)
    assert factor[4] > 1.3 * factor[others].max()
    np.testing.assert_allclose(
        factor, AssociationUncertainty.measured().in_frames(sigma_m, rejected)
    )


@pytest.mark.parametrize("less_sure", ["sigma", "rejected"])
def test_doubt_only_grows(less_sure) -> None:
    sigma_m, rejected = np.full(5, 0.02), np.full(5, 0.1)
    signs = {"sigma": sigma_m, "rejected": rejected}
    signs[less_sure] = signs[less_sure] * np.arange(1, 6)
    factors = AssociationUncertainty.measured().in_frames(signs["sigma"], signs["rejected"])
    assert (np.diff(factors) > 0).all() and factors[0] > 0


def test_a_body_that_counts_less_leaves_joints_to_their_views() -> None:
    away = []
    for weight in (1.0, 0.01):
        window, _, start = frames(hidden=0.0)
        window.variance /= weight
        window.observations.xy[:, WRIST] += 8.0
        away.append(np.linalg.norm(solved(window, start).deviation[:, WRIST], axis=-1).mean())
    assert away[1] > 1.5 * away[0]


def test_a_batch_that_cannot_be_solved_is_solved_row_by_row(monkeypatch) -> None:
    """A singular system of one row takes nobody else's body away."""
    scene = built_in_scene(2, people=2, frames=3, cameras=4)
    detections = simulate(scene)

    def reconstructed():
        return reconstruct(detections, scene.rig, PipelineConfig(temporal=False))

    usual = reconstructed()

    def one_at_a_time(window, state):
        if len(window) > 1:
            raise np.linalg.LinAlgError("singular")
        return gtsam_step(window, state)

    monkeypatch.setattr(body_solution, "gtsam_step", one_at_a_time)
    found = reconstructed()
    assert (found.status == usual.status).all() and (found.status == Status.OK).all()
    np.testing.assert_allclose(found.joints, usual.joints, atol=1e-4)
