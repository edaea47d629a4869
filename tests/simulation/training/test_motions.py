"""Motions for learning: who is in which part, what files are read as, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import SMPL_24
from shapepose_fg.simulation.training.motions import (
    SPLITS,
    SUBJECT_CAP,
    TEST_SUBJECTS,
    VALIDATION_SUBJECTS,
    WALK_CAP,
    Motions,
    frame_weights,
    load_motions,
    split_of,
)

Z_UP = Rotation.from_rotvec([np.pi / 2, 0.0, 0.0])


def write_amass(
    path: Path, frames: int = 12, columns: int = 156, fps: float = 60.0, **change
) -> np.ndarray:
    """A motion as AMASS writes it; returns its `poses`."""
    poses = np.random.default_rng(0).normal(0, 0.3, (frames, columns))
    arrays = {
        "poses": poses,
        "betas": np.zeros(16),
        "trans": np.zeros((frames, 3)),
        "mocap_framerate": fps,
    }
    arrays = {name: value for name, value in (arrays | change).items() if value is not None}
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **arrays)
    return poses


@pytest.fixture(scope="module")
def cmu(shared_data) -> Motions:
    return load_motions(shared_data / "cmu_mocap" / "cmu_smpl24.npz")


def test_the_split_is_the_one_that_is_written_down():
    assert [split_of(subject) for subject in ("60", "61", "02", "139")] == ["test"] * 4
    assert [split_of(subject) for subject in ("06", "12", "127", "140")] == ["validation"] * 4
    assert [split_of(subject) for subject in ("01", "05", "?", "135")] == ["train"] * 4
    assert not set(TEST_SUBJECTS) & set(VALIDATION_SUBJECTS)


def test_other_subjects_are_hashed_eight_to_one_to_one_and_stay_where_they_are():
    names = [f"rub{number:03}" for number in range(2000)]
    count = [sum(split_of(name) == split for name in names) / len(names) for split in SPLITS]
    # 2,000 names: sigma of a share of 0.1 is 0.7 %; 256 values of a byte are 26, 26, ..., 25 in
    # tenths.
    np.testing.assert_allclose(count, [0.8, 0.1, 0.1], atol=0.03)
    parts = [split_of(name) for name in ("rub001", "s1", "317", "3", "rub002", "s5")]
    assert parts == ["train", "train", "train", "validation", "validation", "test"]


@pytest.mark.slow
def test_parts_are_of_different_people_and_leave_nobody_out(cmu):
    parts = [cmu.of(split) for split in SPLITS]
    assert sum(map(len, parts)) == len(cmu) == 90242
    assert set(parts[1].subject) == set(VALIDATION_SUBJECTS) and set(parts[2].subject) == set(
        TEST_SUBJECTS
    )
    assert not set(parts[0].subject) & {*VALIDATION_SUBJECTS, *TEST_SUBJECTS}


@pytest.mark.slow
def test_nobody_weighs_more_than_the_caps_allow(cmu):
    for split in SPLITS:
        part = cmu.of(split)
        total = {
            subject: part.weight[part.subject == subject].sum()
            for subject in np.unique(part.subject)
        }
        assert max(total.values()) <= SUBJECT_CAP + 1e-6
    assert cmu.weight.min() > 0 and cmu.weight.max() <= 1


def test_walking_is_capped_in_each_part_by_itself():
    length, subject = np.array([200, 200, 100, 200]), np.array(["01", "01", "03", "02"])
    weight = frame_weights(length, subject, np.array([True, True, False, True]))
    total = weight * length
    assert total[:2].sum() == pytest.approx(WALK_CAP * total[:3].sum())
    assert total[3] == 200  # nothing but walking in its part: nothing to be drowned


@pytest.mark.slow
def test_poses_of_cmu_are_the_recorded_ones_with_collars_that_follow_the_arms(cmu, shared_data):
    with np.load(shared_data / "cmu_mocap" / "cmu_smpl24.npz", allow_pickle=False) as data:
        recorded = data["poses"][:500].astype(np.float64)
    ours = cmu.poses[:500].astype(np.float64)
    legs_and_trunk = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 12, 15, 18, 19]
    turned = Rotation.from_rotvec(
        ours[:, legs_and_trunk].reshape(-1, 3)
    ).inv() * Rotation.from_rotvec(recorded[:, legs_and_trunk].reshape(-1, 3))
    # Exact but for half precision in the file, and for the few frames where a marker jumped and is
    # bridged.
    assert np.quantile(turned.magnitude(), 0.97) < 1e-6
    for collar, shoulder in ((13, 16), (14, 17)):
        arm = Rotation.from_rotvec(ours[:, collar]) * Rotation.from_rotvec(ours[:, shoulder])
        turned = arm.inv() * Rotation.from_rotvec(recorded[:, shoulder])
        assert np.quantile(turned.magnitude(), 0.97) < 1e-6  # single precision here
    assert np.linalg.norm(ours[:, 13], axis=1).max() > 0.05  # they do move
    assert not cmu.poses[:, 22:].any()


def test_a_folder_of_amass_is_read_thinned_and_turned_upright(tmp_path):
    poses = write_amass(tmp_path / "KIT" / "s1" / "jump_poses.npz", 120, 156, 120.0)
    write_amass(
        tmp_path / "KIT" / "s2" / "walk_poses.npz",
        10,
        165,
        0.0,
        mocap_framerate=None,
        mocap_frame_rate=30.0,
    )
    write_amass(tmp_path / "KIT" / "s2" / "shape.npz", poses=None)  # lies beside the motions
    motions = load_motions(tmp_path)
    assert len(motions) == 40
    assert set(motions.subject[:30]) == {"s1"} and set(motions.subject[30:]) == {"s2"}
    np.testing.assert_allclose(
        motions.poses[:30, 1:22], poses[::4, 3:66].reshape(-1, 21, 3), atol=1e-6
    )
    assert not motions.poses[:, 22:].any()
    upright = Rotation.from_rotvec(motions.poses[:30, 0].astype(float))
    assert ((Z_UP * upright).inv() * Rotation.from_rotvec(poses[::4, :3])).magnitude().max() < 1e-6


def test_cmu_subjects_keep_their_part_in_amass(tmp_path):
    for subject in ("60", "06", "01"):
        write_amass(tmp_path / "CMU" / subject / "trial_poses.npz", 4)
    motions = load_motions(tmp_path)
    assert [set(motions.of(split).subject) for split in SPLITS] == [{"01"}, {"06"}, {"60"}]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"poses": None}, "poses is missing"),
        ({"mocap_framerate": None}, "mocap_framerate must be one positive number"),
        ({"poses": np.zeros((12, 63))}, r"poses must be \(F, 66 or more\)"),
        ({"poses": np.zeros((0, 156)), "trans": np.zeros((0, 3))}, "poses must be"),
        ({"poses": np.full((12, 66), np.nan)}, "poses must be finite"),
        ({"mocap_framerate": 0.0}, "one positive number"),
        ({"poses": np.array([{}, {}])}, "cannot be read"),  # pickled objects
    ],
)
def test_bad_files_are_refused_in_one_sentence_that_names_them(tmp_path, change, message):
    write_amass(tmp_path / "s1" / "bad.npz", **change)
    with pytest.raises(InputError, match=message) as error:
        load_motions(tmp_path)
    assert str(tmp_path / "s1" / "bad.npz") in str(error.value) and "\n" not in str(error.value)


def test_what_is_no_npz_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"no \.npz"):
        load_motions(tmp_path)
    (tmp_path / "bad.npz").write_bytes(b"PK\x03\x04 not an archive")
    with pytest.raises(InputError, match="cannot be read"):
        load_motions(tmp_path)
    with pytest.raises(InputError, match="no such file"):
        load_motions(tmp_path / "nothing.npz")


@pytest.mark.slow
def test_shapes_are_checked_and_frames_must_be_finite(cmu):
    some = cmu.rows(np.arange(5))
    fields = vars(some)
    with pytest.raises(ValueError, match=r"weight must be \(5,\)"):
        Motions(**(fields | {"weight": some.weight[:3]}))
    with pytest.raises(ValueError, match="finite"):
        Motions(**(fields | {"poses": some.poses * np.float32(np.nan)}))
    with pytest.raises(ValueError, match="split must be one of"):
        some.of("dev")  # type: ignore[arg-type]


@pytest.mark.slow
def test_the_prior_predicts_hidden_joints_of_people_it_never_saw(cmu):
    prior, motions = PosePrior.default(), cmu.of("test")
    motions = motions.rows(
        ~np.isin(motions.subject, ["60", "61"])
    )  # salsa would be three frames in four
    poses = motions.poses[::10, 1:].reshape(-1, 69).astype(float)
    for joint, gain in (("left_knee", 0.75), ("right_elbow", 0.9)):
        asked = 3 * (SMPL_24.index(joint) - 1) + np.arange(3)
        given = np.setdiff1d(np.arange(69), asked)
        guess = (
            prior.mean[asked]
            + (poses[:, given] - prior.mean[given]) @ prior.regression(given, asked).T
        )
        by_rest = np.linalg.norm(poses[:, asked] - guess, axis=1).mean()
        by_mean = np.linalg.norm(poses[:, asked] - prior.mean[asked], axis=1).mean()
        assert by_rest < gain * by_mean
