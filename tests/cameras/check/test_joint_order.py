"""Joints that are called by other joints' names: cameras agree on them, and bodies do not."""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.cameras.check.evidence import SetupHypothesis, gather
from shapepose_fg.cameras.check.findings import Kind
from shapepose_fg.cameras.check.joint_order import order_of_joints
from shapepose_fg.cameras.check.report import check_setup
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Recording
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections
from tests.cameras.check.spoiled_setups import biased, lasting

SIDES = [(joint, "L" + joint[1:]) for joint in BODY_25.joints if joint[0] == "R"]
LEGS = ("Hip", "Knee", "Ankle")


def called_otherwise(recording, pairs) -> Recording:
    """The recording with each pair of joints exchanged."""
    name = np.arange(len(recording.skeleton))
    for one, other in pairs:
        i, j = (recording.skeleton.index(each) for each in (one, other))
        name[[i, j]] = name[[j, i]]
    return Recording(
        recording.skeleton, [replace(frame, joint=name[frame.joint]) for frame in recording]
    )


def both(*parts: str) -> list[tuple[str, str]]:
    return [("R" + part, "L" + part) for part in parts]


def order_findings(recording, rig) -> list[str]:
    report = check_setup(recording, rig)
    said = [
        words
        for each, words in zip(report.findings, report.warnings, strict=True)
        if each.kind == Kind.JOINT_ORDER
    ]
    if said:  # what others than these joints would say of unit and up is not said
        assert not {Kind.UNIT, Kind.UP} & {each.kind for each in report.findings}
    return said


WRONG = {
    "everything": (SIDES, "left and right appear to be exchanged"),
    "legs": (both(*LEGS), "left and right hip, knee and ankle appear to be exchanged"),
    "elbow and wrist": ([("RElbow", "RWrist")], "RElbow and RWrist appear to be exchanged"),
    "neck and nose": ([("Neck", "Nose")], "Neck and Nose appear to be exchanged"),
    "many": (
        [
            ("RElbow", "LKnee"),
            ("LWrist", "RHip"),
            ("Nose", "LAnkle"),
            ("RShoulder", "LHip"),
            ("RWrist", "LElbow"),
        ],
        "the joints are in another order",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("wrong", WRONG)
def test_other_names_are_found_from_how_bodies_look(dance, wrong):
    pairs, said = WRONG[wrong]
    seen = Recording(BODY_25, dance.recording.frames[:20])
    (words,) = order_findings(called_otherwise(seen, pairs), dance.scene.rig)
    assert said.lower() in words.lower() and "--skeleton" in words


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_any_other_order_is_neither_a_unit_nor_an_axis(dance, seed):
    """Of all joints, so that no layout comes near: the stature is then anything."""
    seen = Recording(BODY_25, dance.recording.frames[:20])
    order = np.random.default_rng(seed).permutation(len(BODY_25.joints))
    frames = [replace(frame, joint=order[frame.joint]) for frame in seen]
    report = check_setup(Recording(BODY_25, frames), dance.scene.rig)
    kinds = {each.kind for each in report.findings}
    assert Kind.JOINT_ORDER in kinds and not kinds & {Kind.UNIT, Kind.UP}


def test_nothing_is_said_of_the_right_names(dance):
    assert order_findings(dance.recording, dance.scene.rig) == []


@pytest.mark.slow
@pytest.mark.parametrize("frames", [range(44, 90), range(89, 134)])
@pytest.mark.parametrize("views", [(0, 1, 3), (0, 1, 2, 3)])
def test_one_pose_of_one_person_proves_no_other_order(shared_cases, views, frames):
    """A second and a half of somebody who hardly moves: such arms may fit a body better with elbows
    and wrists exchanged.
    """
    case = shared_cases / "caliscope_person"
    rig = read_rig(case / "camera_array_aniposelib_4cam.toml", up="x")
    detections = read_detections(case / "detections", rig)
    seen = [
        replace(each, view=np.searchsorted(views, each.view))
        for each in (detections[n].only(np.isin(detections[n].view, views)) for n in frames)
    ]
    rig = Rig(tuple(rig.cameras[view] for view in views), rig.up)
    assert check_setup(Recording(detections.skeleton, seen), rig).findings == ()


@pytest.mark.slow
def test_a_known_layout_that_fits_is_named(shared_cases):
    rig = read_rig(shared_cases / "body25b" / "Calib_qca.toml")
    detections = read_detections(shared_cases / "body25b" / "detections", rig, "BODY_25")
    (words,) = order_findings(detections, rig)
    assert "in that of BODY_25B; give --skeleton BODY_25B" in words
    detections = read_detections(
        shared_cases / "h36m_coco" / "detections_end_to_end", rig, "COCO_17"
    )
    (words,) = order_findings(detections, rig)
    assert (
        "do not look like a body in the joint order of COCO_17, but do in that of H36M_17" in words
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cameras", "detections"),
    [
        ("data/shelf/calibration.json", "data/shelf/detection"),
        ("data/mvor/rig.json", "data/mvor/alphapose"),
        ("cases/body25b/Calib_qca.toml", "cases/body25b/detections"),
        ("cases/jumpkick/rig.json", "cases/jumpkick/openpose"),
    ],
)
def test_nothing_is_said_of_sound_recordings(shared_data, shared_cases, cameras, detections):
    rig = read_rig(shared_data.parent / cameras)
    assert order_findings(read_detections(shared_data.parent / detections, rig), rig) == []


@pytest.mark.slow
def test_a_biased_detector_is_no_other_order(room, people, look_at):
    """One person, whose joints are seen up to an eighth of the size beside where they are."""
    one = people[:, :1]
    for seed in range(8):
        bias = lasting(np.random.default_rng(seed), 0.02, 0.12, 1, 25, len(room))
        seen = biased(look_at(room, one), room, one, bias)
        setup = SetupHypothesis.given(gather(seen, range(len(seen)), len(room)), room)
        assert order_of_joints(seen, setup) == []
