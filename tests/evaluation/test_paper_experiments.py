"""The experiments about the paper's method: that each measures what its table says."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.body.fitting.fitter import BodyFit, FitStatus
from shapepose_fg.core.camera import Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.linearisation import observation_sigmas
from shapepose_fg.evaluation.experiments import ablation, graph_solver, iterations, prior_confidence
from shapepose_fg.evaluation.experiments.scale import Scale
from shapepose_fg.evaluation.gradient_x_step import GradientStep, GraphStep, alternate_with
from shapepose_fg.pipeline.pipeline import PipelineConfig

PAPER = PipelineConfig.paper()
STAGE_II = EstimatorConfig(
    PAPER.observations,
    replace(PAPER.window_graph, max_iterations=100, tolerance=1e-12),
    PAPER.refine,
    PAPER.motion,
)
WRIST = BODY_25.index("RWrist")


class Still:
    """The same body, whatever it is fitted to."""

    def __init__(self, joints):
        self.joints = joints

    def fit(self, targets, initial=None, groups=None) -> BodyFit:
        covariance = np.tile(1e-2 * np.eye(3), (*targets.xyz.shape[:2], 1, 1))
        failed = BodyFit.failed(np.full(len(targets), FitStatus.OK), targets.xyz.shape[1])
        return replace(failed, joints=self.joints, covariance=covariance)


@pytest.fixture
def doubted(five_cameras, two_people):
    """Two people seen with 3 px of noise, from 2 cm off; the first one's wrist is doubtful."""
    rng = np.random.default_rng(0)
    xy = np.moveaxis(five_cameras.project(two_people)[0], 0, 2)
    confidence = np.full(xy.shape[:3], 0.8)
    confidence[0, WRIST] = 0.1
    observations = Observations(
        xy + rng.normal(0, 3.0, xy.shape), confidence, two_people + rng.normal(0, 0.02, two_people.shape)
    )
    sigmas = observation_sigmas(
        observations, two_people, Views.of(five_cameras), STAGE_II.observations, BODY_25.joints
    )
    return observations, sigmas


def test_every_setting_that_differs_from_the_paper_has_its_switch():
    switched = {name for names in ablation.SWITCHES.values() for name in names}
    assert switched | {"temporal"} == set(ablation.differing(PAPER, PipelineConfig()))


def test_all_switches_together_lead_from_one_to_the_other():
    everything = [name for names in ablation.SWITCHES.values() for name in names]
    assert ablation.with_settings_of(PAPER, ablation.OURS, everything) == ablation.OURS
    one = ablation.with_settings_of(ablation.OURS, PAPER, ["proposals.growth.bridge_m"])
    assert ablation.differing(one, ablation.OURS) == ["proposals.growth.bridge_m"]


def test_the_gradient_is_that_of_the_energy(five_cameras, two_people, doubted):
    """Against differences of E over 2 µm: third derivatives are nothing there."""
    observations, sigmas = doubted
    body = Still(two_people + 0.03)
    run = alternate_with(
        observations,
        sigmas,
        Views.of(five_cameras),
        body,
        STAGE_II,
        GraphStep(observations, sigmas, five_cameras, STAGE_II),
        1,
    )
    X = observations.initial
    gradient = run.energy.gradient(X)
    for joint in (WRIST, 0):
        for axis in range(3):
            step = np.zeros(X.shape)
            step[0, joint, axis] = 1e-6
            slope = (run.energy.value(X + step) - run.energy.value(X - step)) / 2e-6
            np.testing.assert_allclose(gradient[0, joint, axis], slope, rtol=1e-4)


def test_small_gradient_steps_arrive_where_the_solver_is(five_cameras, two_people, doubted):
    """The same energy has the same minimum, to a micrometre after 1200 steps; steps that are too large diverge."""
    observations, sigmas = doubted
    body, views = Still(two_people + 0.03), Views.of(five_cameras)
    solver = GraphStep(observations, sigmas, five_cameras, STAGE_II)
    best = alternate_with(observations, sigmas, views, body, STAGE_II, solver, 3)
    gradient = best.energy.gradient(best.joints)
    assert np.abs(gradient).max() < 0.1  # where it starts they are thousands
    assert np.abs(best.energy.gradient(observations.initial)).max() > 1000
    largest = 1 / np.linalg.eigvalsh(_information(best, views)).max()
    far = alternate_with(observations, sigmas, views, body, STAGE_II, GradientStep(largest, 400), 3)
    apart = np.linalg.norm(far.joints - best.joints, axis=-1)
    assert apart.max() < 1e-6
    once = alternate_with(observations, sigmas, views, body, STAGE_II, GradientStep(largest), 1)
    energy = [best.energy.value(X) for X in (best.joints, once.joints, observations.initial)]
    assert energy[0] < 0.99 * energy[1] < 0.9 * energy[2]
    wild = alternate_with(observations, sigmas, views, body, STAGE_II, GradientStep(3 * largest, 30), 1)
    assert np.linalg.norm(wild.joints - best.joints, axis=-1).max() > 0.1


def _information(run, views):
    from shapepose_fg.estimation.linearisation import linearise

    energy = run.energy
    seen = linearise(energy.observations, energy.sigmas, run.joints, views, energy.ungated).information
    return seen + energy.body.information


def test_where_two_curves_cross():
    """The middles of the first bins are 0.05, 0.15 and 0.225: a gain of 10 mm, then of -10, crosses half way."""
    before = np.full(len(prior_confidence.BINS) - 1, 30.0)
    after = np.array([20.0, 40.0, *before[2:]])
    assert prior_confidence.crosses(before, after) == pytest.approx(0.1)
    assert prior_confidence.crosses(before, before - 1) is None
    assert prior_confidence.crosses(before, before + 1) == 0.0
    assert prior_confidence.crosses(before, np.where(np.arange(len(before)) == 0, np.nan, after)) == 0.0


def test_without_recordings_there_is_nothing_to_measure():
    for make in (ablation.ablation, prior_confidence.prior_confidence, iterations.iterations):
        assert make(Scale(data=None)) is None
    assert graph_solver.graph_solver(Scale(data=None)) is None


def test_errors_by_confidence_are_means_over_cases_with_a_picture(tmp_path: Path):
    """Two stretches with one and three joints of confidence 0.1 to 0.2 in them; nothing in other bins."""

    def figures(before_mm: float, after_mm: float, count: int, names: tuple[str, str]) -> dict:
        nothing = [[0.0, 0]] * (len(prior_confidence.BINS) - 2)
        sums = {names[0]: [before_mm * count, count], names[1]: [after_mm * count, count]}
        return {name: [nothing[0], one, *nothing[1:]] for name, one in sums.items()}

    found = {
        f"{setting}, {world}, {label}": figures(40.0 if world == "own" else 10.0, after, count, names)
        for setting, names in prior_confidence.CURVES.items()
        for world in prior_confidence.WORLDS
        for label, after, count in (("first", 10.0, 1), ("second", 30.0, 3))
    }
    curves = prior_confidence.curves(found)
    before, after = curves["own", "paper"].values()
    assert (before[1], after[1]) == (40.0, 25.0) and np.isnan(np.delete(after, 1)).all()
    experiment = prior_confidence.prior_confidence(Scale(quick=True), tmp_path)
    assert experiment is not None
    rows = experiment.table(found)
    assert rows[3] == "| 0.1 to 0.2 | 40 | 25 | 40 | 25 | 10 | 25 | 10 | 25 |"
    assert rows[-1].endswith("|  | always better |  | always better |  | 0.00 |  | 0.00 |")
    assert (tmp_path / "prior_confidence.png").stat().st_size > 5000


def test_iterations_are_means_over_stretches_with_a_picture(tmp_path: Path):
    experiment = iterations.iterations(Scale(quick=True), tmp_path)
    assert experiment is not None
    found = {
        case.name: {"precision": 0.5 + n / 10, "f1": 0.75, "mpjpe_mm": 30.0 - n}
        for n, case in enumerate(experiment.cases)
    }
    rows = experiment.table(found)
    assert rows[2] == "| 0 | 50.0 | 75.0 | 30.0 | 80.0 | 75.0 | 27.0 | 83.7 |"
    assert (tmp_path / "iterations.png").stat().st_size > 5000
