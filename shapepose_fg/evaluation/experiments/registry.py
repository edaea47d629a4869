"""Every experiment there is, in the order of the documents."""

from collections.abc import Iterator
from pathlib import Path

from shapepose_fg.evaluation import (
    fitter_tables,
    scene_tables,
    sequence_difficulty,
    shelf_tables,
    visibility_agreement,
)
from shapepose_fg.evaluation.experiments import body_fitters, box, crowd, footage, over_time, who_is_there
from shapepose_fg.evaluation.experiments.ablation import ablation
from shapepose_fg.evaluation.experiments.detector_joints import detector_joints, detector_joints_shelf
from shapepose_fg.evaluation.experiments.experiment import Experiment, whole
from shapepose_fg.evaluation.experiments.foreign_bodies import foreign
from shapepose_fg.evaluation.experiments.graph_solver import graph_solver
from shapepose_fg.evaluation.experiments.held_back import held_back
from shapepose_fg.evaluation.experiments.interactions import interactions
from shapepose_fg.evaluation.experiments.iterations import iterations
from shapepose_fg.evaluation.experiments.prior_confidence import prior_confidence
from shapepose_fg.evaluation.experiments.proposals import hip_views, proposals
from shapepose_fg.evaluation.experiments.scale import QUICK_FRAMES, Scale
from shapepose_fg.evaluation.experiments.shelf_others import shelf_others
from shapepose_fg.evaluation.experiments.smpl_only import smpl_only
from shapepose_fg.evaluation.experiments.sweeps import sweeps


def experiments(scale: Scale, images: Path | None = None, others: Path | None = None) -> Iterator[Experiment]:
    """Those whose data are there; figures are drawn into the folder `images`, or not at all.

    Results of other systems are read from the folder `others` (scripts/run_pose2sim.py).
    """
    yield from _shelf(scale)
    yield from _scenes(scale)
    if scale.has_scenes:
        yield over_time.experiment(scale, temporal=True)
        yield over_time.experiment(scale, temporal=False)
    yield from _there(held_back(scale))
    yield from _there(who_is_there.experiment(scale))
    yield crowd.experiment(scale)
    yield box.experiment(scale)
    for make in (footage.shelf_events, footage.held_out_views, footage.single_person, footage.alone_beside_time):
        yield from _there(make(scale))
    yield from _paper(scale, images, others)
    yield detector_joints(scale)
    yield from _there(detector_joints_shelf(scale))
    if not scale.quick and scale.mocap is not None:
        for name, table in fitter_tables.tables(scale.mocap, scale.shelf, images).items():
            yield whole(name, table, "pipeline" if name == "fitter alternation" else "bodies")
    for make in (body_fitters.left_out, body_fitters.over_time):
        yield from _there(make(scale))
    if not scale.quick:
        yield from _simulation(scale)


def _paper(scale: Scale, images: Path | None, others: Path | None) -> Iterator[Experiment]:
    """The paper's experiments, and what goes beyond them."""
    yield from _there(shelf_others(scale, others))
    yield from _there(interactions(scale, others))
    for draws in (hip_views, prior_confidence, iterations):
        yield from _there(draws(scale, images))
    for make in (proposals, smpl_only, graph_solver, sweeps, foreign, ablation):
        yield from _there(make(scale))


def _there(found: Experiment | None) -> Iterator[Experiment]:
    """The experiment, if its data are there."""
    if found is not None:
        yield found


def _shelf(scale: Scale) -> Iterator[Experiment]:
    folder = scale.shelf
    if folder is None or scale.quick:
        return
    yield whole("shelf", lambda: shelf_tables.shelf_table(shelf_tables.shelf_steps(folder)))
    yield whole("shelf limbs", lambda: shelf_tables.limb_table(shelf_tables.shelf_steps(folder)))
    yield whole("contradictions", lambda: shelf_tables.contradiction_table(folder))
    yield whole("sigma", lambda: shelf_tables.sigma_table(folder))


def _scenes(scale: Scale) -> Iterator[Experiment]:
    """The built-in scene, every frame by itself."""
    every = (scene_tables.DEMO, *scene_tables.SEEDS)
    seeds, frames = (every[:2], QUICK_FRAMES) if scale.quick else (every, 60)
    trials = [scene_tables.Trial(seed, frames=frames) for seed in seeds]
    yield whole("scenes", lambda: scene_tables.scene_table(trials))
    yield whole("alternation", lambda: scene_tables.alternation_table(trials))
    yield whole("covariances", lambda: scene_tables.covariance_table(trials))
    yield whole("cameras", lambda: scene_tables.camera_table(trials[1]))


def _simulation(scale: Scale) -> Iterator[Experiment]:
    """The simulator itself."""
    mocap = scale.mocap
    if mocap is not None:
        yield whole("difficulty", lambda: sequence_difficulty.table(mocap, ("tune", "report"), 20))
    yield whole("visibility", visibility_agreement.table, "detector")
