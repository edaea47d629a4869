from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.experiments.footage import single_footage
from shapepose_fg.evaluation.single_person import (
    ANNOTATION,
    ARMS,
    SIGMA_PX,
    WRONG_M,
    man_of,
    measure_arms,
    read_annotated_arms,
)
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.simulation import built_in_scene
from shapepose_fg.simulation.files import truth_of

JOINTS = [BODY_25.index(name) for name in ARMS]


@pytest.fixture(scope="module")
def scene():
    return built_in_scene(people=1, frames=40, cameras=4)


@pytest.fixture(scope="module")
def truth(scene):
    people = truth_of(scene)
    return replace(people, covariance=np.tile(0.02**2 * np.eye(3), (*people.joints.shape[:2], 1, 1)))


@pytest.fixture
def marks(scene, truth, tmp_path):
    """Marks of a scene's truth in every second frame, as a file; `move` (V, 2) pixels shifts a view's."""

    def write(move=np.zeros((4, 2)), flag=lambda frame, view: "clear"):
        lines = ["# by a test", "frame,view,joint,x,y,flag"]
        for frame in range(0, 40, 2):
            xy, _ = scene.rig.project(truth.joints[truth.frame == frame][0, JOINTS])
            for view, camera in enumerate(scene.rig.cameras):
                seen = camera.distort(xy[view]) + move[view]
                name, how = camera.name, flag(frame, view)
                lines += [
                    f"{frame},{name},{j},{x:.3f},{y:.3f},{how}" for j, (x, y) in zip(ARMS, seen, strict=True)
                ]
        (tmp_path / "arms.csv").write_text("\n".join(lines))
        return read_annotated_arms(tmp_path / "arms.csv", scene.rig)

    return write


def test_exact_marks_give_the_joints_back(truth, marks):
    arms = marks()
    assert len(arms) == 80
    found = measure_arms(truth, arms)
    assert found.error_m.max() < 1e-4  # marks are written to a thousandth of a pixel
    assert found.as_dict()["arms_inside_50"] == 100
    assert len(measure_arms(truth, arms.only(range(10))).error_m) == 20


def test_only_clear_marks_count_and_one_far_off_is_left_out(truth, marks):
    guessed = marks(
        np.array([[0, 0], [0, 0], [0, 0], [300, 0]]), lambda frame, view: "guess" if view == 3 else "clear"
    )
    assert measure_arms(truth, guessed).error_m.max() < 1e-4
    wrong = marks(np.array([[0, 0], [0, 0], [0, 0], [300, 0]]))
    assert measure_arms(truth, wrong).error_m.max() < 1e-4
    assert np.isnan(wrong.residual_px[:, 3]).all()
    alone = marks(flag=lambda frame, view: "clear" if view == 0 or frame >= 20 else "guess")
    assert set(alone.frame.tolist()) == set(range(20, 40, 2))


def test_the_covariance_is_that_of_noisy_marks(scene, truth, marks):
    """Marks with `SIGMA_PX` of noise lie as far from the truth as their covariance says."""
    rng = np.random.default_rng(0)
    squared = []
    for _ in range(12):  # the noise is a view's, the same in all frames and joints: 12 draws
        arms = marks(rng.normal(0.0, SIGMA_PX, (4, 2)))
        squared.append(measure_arms(replace(truth, covariance=truth.covariance * 1e-6), arms).squared)
    assert np.mean(squared) == pytest.approx(3.0, abs=1.2)  # chi-squared with 3 degrees; 12 draws scatter by 0.7


def test_errors_misses_and_ellipsoids(truth, marks):
    arms = marks()
    moved = truth.joints.copy()
    moved[truth.frame < 20, BODY_25.index("LWrist")] += [0.0, 0.3, 0.0]
    found = measure_arms(replace(truth, joints=moved), arms)
    assert found.error_m[arms.joint == ARMS.index("LWrist")][:10] == pytest.approx(0.3, abs=1e-3)
    assert found.as_dict()["arms_wrong"] == pytest.approx(100 * 10 / 80)
    assert found.as_dict()["arms_inside_95"] == pytest.approx(100 * 70 / 80)
    wide = replace(truth, joints=moved, covariance=truth.covariance * 100)  # 20 cm: 0.3 m is inside 95 %
    assert measure_arms(wide, arms).as_dict()["arms_inside_95"] == 100
    missing = measure_arms(truth.rows(truth.frame != 4), arms)
    assert np.isinf(missing.error_m).sum() == 4
    assert missing.as_dict()["arms_wrong"] == pytest.approx(100 * 4 / 80)
    moved[truth.frame == 6, BODY_25.index("RElbow")] = np.nan
    gone = measure_arms(replace(truth, joints=moved), arms)
    assert np.isinf(gone.error_m[gone.joint == ARMS.index("RElbow")]).sum() == 1


def test_a_file_that_is_no_annotation(scene, tmp_path):
    with pytest.raises(InputError, match="no annotation of arms"):
        read_annotated_arms(tmp_path / "none.csv", scene.rig)
    (tmp_path / "other.csv").write_text("frame,view,joint,x,y,flag\n1,elsewhere,RElbow,1,2,clear\n")
    with pytest.raises(InputError, match="no annotation of arms"):
        read_annotated_arms(tmp_path / "other.csv", scene.rig)


def test_the_recording(shared_data):
    """Every annotated joint has a place, forearms keep their length, and marks agree as the rig lets them."""
    folder = shared_data / "pose2sim_single"
    if not folder.is_dir():
        pytest.skip("no pose2sim_single among the recordings")
    arms = read_annotated_arms(ANNOTATION, read_rig(folder / "rig.json"))
    assert len(arms) == 80
    assert set(arms.frame.tolist()) == set(range(2, 100, 5))
    assert np.nanmedian(arms.residual_px) < SIGMA_PX
    forearm = np.linalg.norm(np.diff(arms.xyz.reshape(-1, 2, 3), axis=1), axis=-1)  # elbow, wrist in turn
    assert np.median(forearm) == pytest.approx(0.26, abs=0.01)
    assert forearm.std() < 0.03
    single = single_footage(folder)
    errors = measure_arms(single.reconstruct(frames=range(8)), arms.only(range(8)))
    assert np.median(errors.error_m) < WRONG_M / 4  # four views see both arms hang


def test_the_man_is_in_the_middle_and_missing_frames_are_missing(scene, truth):
    middle = scene.rig.centres.mean(axis=0) * [1, 1, 0]
    joints = truth.joints - truth.joints.mean(axis=1, keepdims=True) * [1, 1, 0] + middle
    his = replace(truth, joints=joints)
    far = replace(truth, joints=joints + np.array([4.0, 0, 0]))
    both = type(truth).concatenate([far, his.rows(truth.frame != 7)])
    assert (both.joints[man_of(both, scene.rig)] == his.rows(truth.frame != 7).joints).all()
    assert len(man_of(truth.rows(truth.frame < 0), scene.rig)) == 0


def test_a_man_without_joints_is_nobody(scene, truth):
    nothing = replace(truth, joints=np.full_like(truth.joints, np.nan))
    assert len(man_of(nothing, scene.rig)) == 0
