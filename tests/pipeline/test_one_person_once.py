"""A person is one person: found twice in a view, or cut off by its picture, they are where they are, once."""

from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.core.detections import Detections, Recording
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.metrics import joint_metrics
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct
from shapepose_fg.simulation import built_in_scene, simulate
from tests.marks import slow


@pytest.fixture(scope="module")
def scene():
    return built_in_scene(people=2, cameras=4, frames=24)


def twice(found: Detections, again: np.ndarray) -> Detections:
    """The detections, and those in `again` (D,) once more, 5 px away and a little less certain."""
    more, angle = found.only(again), np.random.default_rng(len(found)).uniform(0, 2 * np.pi)
    away = 5.0 * np.array([np.cos(angle), np.sin(angle)])
    return Detections(
        np.concatenate([found.view, more.view]),
        np.concatenate([found.joint, more.joint]),
        np.concatenate([found.xy, more.xy + away]),
        np.concatenate([found.confidence, 0.9 * more.confidence]),
        np.concatenate([found.pairs, more.pairs + len(found)]),
        np.concatenate([found.affinity, more.affinity]),
    )


@pytest.mark.parametrize("temporal", [True, False], ids=["over time", "frame by frame"])
@pytest.mark.parametrize("how", ["in all views", *slow("in some views", "in some frames", "at random")])
def test_people_whom_a_detector_finds_twice_are_there_once(scene, how, temporal):
    rng, frames = np.random.default_rng(0), list[Detections]()
    for number, found in enumerate(simulate(scene)):
        views = {
            "in all views": np.ones(4, dtype=bool),
            "in some views": np.arange(4) < 2,
            "in some frames": np.full(4, number % 8 < 4),
            "at random": rng.random(4) < 0.5,
        }[how]
        frames.append(twice(found, views[found.view]))
    recording = Recording(BODY_25, frames)
    times = FrameTimes.from_fps(scene.fps, len(scene))
    found = reconstruct(recording, scene.rig, PipelineConfig(temporal=temporal), times=times)
    assert len(found) <= 2 * len(scene)
    assert joint_metrics(found, scene.keypoints).f1 > 0.97
    if temporal:
        assert len(np.unique(found.person)) == 2


def case(shared_data: Path, name: str):
    """Rig, detections, and the truth of one of the cases: frames (N,), joints (N, J, 3) and their names."""
    folder = shared_data.parent / "cases" / name
    if not folder.is_dir():
        pytest.skip(f"no {folder}: the case is not part of every copy of the data")
    rig = read_rig(folder / "rig.json")
    with np.load(folder / "truth" / "people.npz") as truth:
        columns = {key: truth[key] for key in ("frame", "joints", "joint_names")}
    joints = columns["joints"].reshape(len(np.unique(columns["frame"])), -1, *columns["joints"].shape[1:])
    return rig, read_detections(folder / "openpose", rig), joints, columns["joint_names"].tolist()


def solved(shared_data: Path, name: str, config: PipelineConfig):
    """People of a case, and their figures."""
    rig, recording, truth, names = case(shared_data, name)
    found = reconstruct(recording, rig, config, times=FrameTimes.from_fps(30.0, len(recording)))
    order = [names.index(each) for each in found.joint_names.tolist()]
    return found, joint_metrics(found, truth[:, :, order])


@pytest.mark.parametrize("temporal", [True, *slow(False)])
def test_a_detector_without_suppression_of_doubles(shared_data, temporal):
    found, figures = solved(shared_data, "duplicates", PipelineConfig(temporal=temporal))
    assert len(found) == 240
    assert figures.f1 > 0.99
    if temporal:
        assert len(np.unique(found.person)) == 2


def test_legs_that_the_picture_cuts_off(shared_data):
    """The detector puts them on the border of two of four pictures: no worse than if it had said nothing."""
    found, figures = solved(shared_data, "border", PipelineConfig())
    assert len(found) == 240
    assert figures.mpjpe_mm < 26
