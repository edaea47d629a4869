"""Solved rows become rows of a result: every column of the same row."""

import numpy as np

from factors import project_with_jacobian
from shapepose_fg.body.fitting.fitter import BodyFit, FitStatus
from shapepose_fg.core.observation_table import Gate
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.reconstruction import Known, Status
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.window_solution import WindowSolution

N, J, V = 4, 25, 5


def test_every_column_is_of_the_same_row(five_cameras, two_people):
    rng = np.random.default_rng(0)
    joints = two_people[[0, 1, 0, 1]] + rng.normal(0, 0.1, (N, J, 3))
    joints[3, 7] = np.nan

    def spread(*shape: int) -> np.ndarray:
        found = rng.normal(size=(N, *shape, 3, 3))
        return found @ found.swapaxes(-1, -2) + 1e-3 * np.eye(3)

    seen, inlier, contradicts = (
        rng.random(shape) < 0.6 for shape in ((N, J, V), (N, J, V), (N, J))
    )
    fit = BodyFit(
        rng.normal(size=(N, 10)), rng.normal(size=(N, 3)), rng.normal(size=(N, 23, 3)),
        rng.normal(size=(N, 3)), joints, spread(J), rng.random(N),
        np.array([FitStatus.OK, FitStatus.TOO_FEW_JOINTS, FitStatus.OK, FitStatus.OK]),
    )  # fmt: skip
    known = rng.choice([Known.SEEN, Known.WEAK, Known.BODY, Known.MOTION], (N, J)).astype(np.uint8)
    status = np.array([Status.OK, Status.BODY_UNDETERMINED, Status.NOT_SOLVED, Status.OK])
    observations = Observations(
        xy=rng.uniform(0, 900, (N, J, V, 2)),
        confidence=np.where(seen, rng.uniform(0.1, 1, seen.shape), 0),
        initial=joints,
        track=np.array([5, 6, 5, 6]),
        frame=np.array([7, 7, 8, 8]),
        time_s=np.array([0.7, 0.7, 0.8, 0.8])[:, None] + 0.01 * np.arange(V),
        probability=rng.random((N, J, V)),
    )
    solution = WindowSolution(
        observations, joints, spread(J), rng.normal(size=(N, J, 3)), spread(J), rng.random((N, J)),
        inlier & seen, contradicts, rng.normal(size=(N, J, V, 2)), known, fit, status,
    )  # fmt: skip
    place = rng.integers(0, 9, (N, J, V))
    rows = solution.result(place, five_cameras, BODY_25.joints)

    assert rows.frame.tolist() == [7, 7, 8, 8] and rows.person.tolist() == [5, 6, 5, 6]
    np.testing.assert_allclose(rows.time_s, [0.72, 0.72, 0.82, 0.82])
    for name in (
        "joints",
        "covariance",
        "velocity",
        "velocity_covariance",
        "known",
        "confidence",
        "status",
    ):
        np.testing.assert_array_equal(getattr(rows, name), getattr(solution, name), err_msg=name)
    for name in ("betas", "global_orient", "body_pose", "transl"):
        found, expected = getattr(rows, name), getattr(fit, name)
        np.testing.assert_array_equal(found[[0, 2, 3]], expected[[0, 2, 3]], err_msg=name)
        assert np.isnan(found[1]).all() and np.isfinite(expected[1]).all(), (
            "no body was fitted there"
        )

    table = rows.observations
    assert (
        table.frame.tolist() == rows.frame.tolist()
        and table.person.tolist() == rows.person.tolist()
    )
    np.testing.assert_array_equal(table.used, solution.inlier)
    np.testing.assert_array_equal(table.gate == Gate.NOT_SEEN, ~seen)
    out, placed = seen & ~solution.inlier, np.isfinite(joints).all(axis=2)[..., None]
    np.testing.assert_array_equal(
        table.gate == Gate.CONTRADICTS_BODY, out & placed & contradicts[..., None]
    )
    np.testing.assert_array_equal(
        table.gate == Gate.TOO_FAR, out & placed & ~contradicts[..., None]
    )
    np.testing.assert_array_equal(table.gate == Gate.NOT_PLACED, out & ~placed)
    np.testing.assert_array_equal(table.candidate, np.where(seen, place, -1))
    np.testing.assert_allclose(table.xy[seen], observations.xy[seen], rtol=1e-6)
    np.testing.assert_allclose(table.confidence, observations.confidence, rtol=1e-6)
    there = seen & placed
    moved = joints[:, :, None] + 0.01 * (np.arange(V) - 2)[:, None] * solution.velocity[:, :, None]
    then, _, _ = project_with_jacobian(moved, five_cameras.K, five_cameras.cTw)
    there &= np.isfinite(then).all(axis=-1)
    np.testing.assert_allclose(
        table.residual_px[there], (then - observations.xy)[there], rtol=1e-4, atol=1e-3
    )
    np.testing.assert_allclose(table.lead_s, np.tile(0.01 * (np.arange(V) - 2), (N, 1)), atol=1e-6)
    again = table.observations(joints, rows.time_s)
    np.testing.assert_allclose(again.time_s, observations.time_s, atol=1e-6)
