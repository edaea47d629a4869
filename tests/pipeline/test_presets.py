"""The paper's method as settings: that they read back, and that each does what the paper says."""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, FitStatus
from shapepose_fg.cli.main import main
from shapepose_fg.cli.options import Preset
from shapepose_fg.cli.reconstruct.request import Request, prepare
from shapepose_fg.core.camera import Views
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.alternation import JOINT_SIGMA_M
from shapepose_fg.estimation.gated_views import linearise, observation_sigmas
from shapepose_fg.io.config import read_config
from shapepose_fg.pipeline.pipeline import PipelineConfig, find_people
from shapepose_fg.pipeline.solve_window import solve_window
from shapepose_fg.proposal.candidates import triangulate_pairs, vote

PAPER = PipelineConfig.paper()
STAGE_II = PAPER.estimator
WRIST, KNEE = BODY_25.index("RWrist"), BODY_25.index("LKnee")


class OneBody(BodyFitter):
    """Fits the same body to everything."""

    def __init__(self, joints, sigma_m=0.1):
        self.joints, self.sigma_m, self.targets = joints, sigma_m, []

    def fit(self, targets, initial=None) -> BodyFit:
        self.targets.append(targets)
        N, J = targets.xyz.shape[:2]
        covariance = np.tile(self.sigma_m**2 * np.eye(3), (N, J, 1, 1))
        return replace(
            BodyFit.failed(np.full(N, FitStatus.OK), J),
            joints=self.joints,
            covariance=covariance,
        )


def seen(rig, people, confidence=0.8) -> Observations:
    xy = np.moveaxis(rig.project(people)[0], 0, 2)
    return Observations(xy, np.full(xy.shape[:3], confidence), people.copy())


@pytest.mark.parametrize(
    ("name", "settings"),
    [("paper", PAPER), ("accurate", PipelineConfig()), ("fast", PipelineConfig.fast())],
)
def test_presets_read_back(name, settings, tmp_path, capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["config", "--preset", name])
    (tmp_path / "settings.toml").write_text(capsys.readouterr().out)
    assert read_config(tmp_path / "settings.toml", PipelineConfig) == settings


def test_a_detection_weighs_its_confidence_in_pixels(five_cameras, two_people):
    """Eq. 1: w_ij is the confidence, d_2D in pixels, whatever depth and joint; no kernel: a far one
    counts too.

    Twice the distance from the cameras halves a length in the pictures, and leaves these sigmas
    alone.
    """
    people = np.concatenate([two_people[:1], two_people[:1] * [2.0, 2.0, 1.0]])
    views, observations = Views.of(five_cameras), seen(five_cameras, people, 1.0)
    confidence = np.broadcast_to(np.linspace(0.1, 1.0, 25)[:, None], observations.confidence.shape)
    observations = replace(observations, confidence=confidence)
    sigmas = observation_sigmas(observations, people, views, PAPER.observations, BODY_25.joints)
    weight = 1 / sigmas**2
    np.testing.assert_allclose(weight, confidence * weight[:, -1:, :], rtol=1e-9)
    np.testing.assert_allclose(sigmas[0], sigmas[1], rtol=1e-9)
    ours = observation_sigmas(
        observations, people, views, PipelineConfig().observations, BODY_25.joints
    )
    assert np.abs(ours[0] / ours[1] - 1).max() > 0.1
    # Eq. 2, and no kernel: the information is J^T J over sigma² wherever the distance is under
    # rho_2D.
    moved = replace(observations, xy=observations.xy + np.array([8.0, 0.0]))
    there = linearise(moved, sigmas, people, views, PAPER.observations)
    at = linearise(observations, sigmas, people, views, PAPER.observations)
    assert there.inlier.all()
    np.testing.assert_allclose(there.information, at.information, rtol=1e-9)


def test_e_shape_has_one_weight(five_cameras, two_people):
    """Eqs. 3 to 5: a doubtful joint is where w_2D E_2D + w_shape E_shape is least, others where
    views are.
    """
    observations = seen(five_cameras, two_people)
    observations.confidence[:, WRIST] = 0.2  # under rho_3D
    observations = replace(observations, xy=observations.xy + np.array([3.0, -2.0]))
    body = OneBody(two_people + np.array([0.0, 0.06, 0.0]))
    config = replace(STAGE_II, refine=replace(STAGE_II.refine, alternations=1))
    config = replace(config, graph=replace(config.graph, max_iterations=100, tolerance=1e-12))
    found = solve_window(observations, Views.of(five_cameras), body, config)
    views = Views.of(five_cameras)
    sigmas = observation_sigmas(
        observations, two_people, views, config.observations, BODY_25.joints
    )
    at = linearise(observations, sigmas, found.joints, views, config.observations)
    pull = (body.joints - found.joints) / config.graph.shape_sigma_m**2
    # The gradient of the whole energy is zero: of 1/cm where each of its halves has hundreds.
    np.testing.assert_allclose(at.gradient[:, WRIST], pull[:, WRIST], atol=1.0)
    assert np.abs(pull[:, WRIST]).max() > 20.0
    np.testing.assert_allclose(at.gradient[:, KNEE], 0.0, atol=1.0)


def test_the_body_is_fitted_to_x(five_cameras, two_people):
    """Algorithm 1: E_shape(X_n, Theta) over all joints alike; a joint that is not there is
    missing.
    """
    observations = seen(five_cameras, two_people)
    observations.initial[1, KNEE] = np.nan
    body = OneBody(two_people)
    config = replace(STAGE_II, refine=replace(STAGE_II.refine, alternations=1))
    solve_window(observations, Views.of(five_cameras), body, config)
    (targets,) = body.targets
    known = np.isfinite(observations.initial).all(axis=-1)
    np.testing.assert_array_equal(targets.xyz[known], observations.initial[known])
    np.testing.assert_array_equal(
        targets.information[known], np.broadcast_to(np.eye(3) / JOINT_SIGMA_M**2, (49, 3, 3))
    )
    assert not targets.information[1, KNEE].any()


def test_the_paper_makes_n_rounds_and_starts_from_stage_i_alone(five_cameras, two_people):
    """N = 10; a joint that stage I did not place is missing from the first body, then where that
    body has it.
    """
    observations = seen(five_cameras, two_people)
    observations.initial[1, KNEE] = np.nan
    observations.confidence[:, KNEE] = 0.1
    body = OneBody(two_people)
    found = solve_window(observations, Views.of(five_cameras), body, STAGE_II)
    assert len(body.targets) == 10
    known = [targets.information[1, KNEE].any() for targets in body.targets]
    assert known == [False] + 9 * [True]
    # Its views are exact and so is the body: to a millimetre whichever tells.
    np.testing.assert_allclose(found.joints, two_people, atol=1e-3)


@pytest.mark.parametrize(
    ("part", "value"),
    [
        ("refine", {"settled_m": -1.0}),
        ("window_graph", {"shape_sigma_m": -1}),
    ],
)
def test_off_is_zero_and_not_less(part, value):
    with pytest.raises(ValueError, match="must not be negative"):
        replace(getattr(PAPER, part), **value)


def unseen(detections: Detections, joints: tuple[int, ...], views: tuple[int, ...]) -> Detections:
    """The same without these joints in these views."""
    return detections.only(~(np.isin(detections.joint, joints) & np.isin(detections.view, views)))


def test_the_paper_proposes_by_three_votes_and_nine_parts_in_ten(
    five_cameras, two_people, seen_exactly
):
    """Section 3.1: what two views see makes no candidate; who lacks more than a tenth of the parts
    is nobody.
    """
    exact = seen_exactly(five_cameras, two_people[:1])
    twice = unseen(exact, (WRIST,), (0, 1, 2))
    ours, theirs = (
        find_people(twice, five_cameras, BODY_25, config) for config in (PipelineConfig(), PAPER)
    )
    np.testing.assert_allclose(ours.initial[0], two_people[0], atol=0.005)
    assert np.isnan(theirs.initial[0, WRIST]).all()
    others = np.delete(np.arange(25), WRIST)
    np.testing.assert_allclose(theirs.initial[0, others], two_people[0, others], atol=0.005)
    forearm = unseen(exact, (WRIST, WRIST - 1), (0, 1, 2, 3, 4))
    count = [
        len(find_people(forearm, five_cameras, BODY_25, config))
        for config in (PipelineConfig(), PAPER)
    ]
    assert count == [1, 0]


def test_the_paper_s_candidate_is_the_mean_of_its_points(five_cameras, two_people, seen_exactly):
    exact = seen_exactly(five_cameras, two_people[:1])
    rng = np.random.default_rng(0)
    noisy = replace(
        exact,
        xy=exact.xy + rng.normal(0, 3.0, exact.xy.shape),
        confidence=rng.uniform(0.2, 1.0, len(exact)),
    )
    points = triangulate_pairs(noisy, five_cameras, PAPER.candidates)
    assert len(points.xyz) == 25 * 10  # whatever the angle and the gap of the rays
    means = vote(points, noisy, 5, PAPER.candidates)
    weighted = vote(points, noisy, 5, replace(PAPER.candidates, weighted_centre=True))
    for joint in (WRIST, KNEE):
        own = points.joint == joint
        largest = np.flatnonzero(means.joint == joint)[means.votes[means.joint == joint].argmax()]
        if means.votes[largest] == own.sum():  # no point is an outlier
            np.testing.assert_allclose(means.xyz[largest], points.xyz[own].mean(axis=0), atol=1e-9)
            assert np.abs(means.xyz[largest] - weighted.xyz[largest]).max() > 1e-4


def test_stage_one_s_settings_of_the_paper():
    """Section 3.1: three votes, 90 % of the parts; what it does not have is off. Chosen on `tune`:
    6 and 60 cm.
    """
    c, p = PAPER.candidates, PAPER.proposals
    assert (c.min_votes, c.vote_radius_m, c.weak, c.weighted_centre) == (3, 0.06, False, False)
    assert c.gate_m >= 10 and c.min_angle_deg < 0.01 and c.min_view_fraction < 0.01
    assert (p.min_parts, p.separation_m, p.min_grown_parts, p.min_observed_parts) == (
        0.9,
        0.6,
        0.0,
        0.0,
    )
    assert (p.weak_anchors, p.growth.bridge_m) == (False, 0.0)


def test_stage_two_s_settings_of_the_paper():
    """Section 3.2: N = 10, rho_3D 0.25; X_0 as stage I has it, the body fitted to X, nothing left
    out of it.
    """
    r, w, o = PAPER.refine, PAPER.window_graph, PAPER.observations
    assert (r.alternations, w.rho_3d, o.confidence_power, o.kernel) == (10, 0.25, 1.0, "none")
    assert (r.with_body, r.settled_m) == (False, 0.0)
    assert not PAPER.temporal and PAPER.offsets.source == "none"


def test_a_preset_stands_for_itself(tmp_path):
    """Beside a file of settings nobody could say which of the two counts."""
    request = Request(calibration=tmp_path, detections=tmp_path, preset=Preset.PAPER)
    assert prepare(request, tmp_path).settings() == PAPER != PipelineConfig()
    assert prepare(replace(request, preset=None), tmp_path).settings() == PipelineConfig()
    both = prepare(replace(request, config=tmp_path / "mine.toml"), tmp_path)
    with pytest.raises(
        InputError,
        match=r"--preset paper and --config .*mine.toml: settings come from one of"
        r" them; `shapepose-fg config",
    ):
        both.settings()
