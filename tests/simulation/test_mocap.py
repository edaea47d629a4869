"""Recorded motions: what is read, and that a body of any shape does what was recorded, on the
floor.
"""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.core.errors import InputError
from shapepose_fg.simulation.bystanders import endless, stand, walk_along
from shapepose_fg.simulation.mocap import Clip, Mocap, shoulder_rhythm
from shapepose_fg.simulation.performance import Figure, Performance, hold_hands, perform, together
from shapepose_fg.simulation.scene import Scene, keypoints_of, parameters_of, ring_of_cameras

SHAPES = np.clip(np.random.default_rng(0).normal(0.0, 0.8, (4, 10)), -1.8, 1.8)
Z_UP = Rotation.from_rotvec([np.pi / 2, 0.0, 0.0]).as_matrix()
UPPER_ARMS = ((0, 3, 6, 9, 13, 16), (0, 3, 6, 9, 14, 17))


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return BodyModel.default()


def chained(rotations: NDArray[np.float64], chain: tuple[int, ...]) -> NDArray[np.float64]:
    turned = rotations[:, chain[0]]
    for joint in chain[1:]:
        turned = turned @ rotations[:, joint]
    return turned


def lowest(
    body: BodyModel, betas: NDArray[np.float64], performed: Performance, every: int
) -> NDArray[np.float64]:
    """Lowest vertex of some frames: of the whole mesh, which the code itself never looks at."""
    motion = together(betas[None], [performed], len(performed))
    scene = Scene(ring_of_cameras(2, np.random.default_rng(0)), body, motion, 30.0)
    return np.array(
        [scene.vertices_at(frame)[0, :, 2].min() for frame in range(0, len(performed), every)]
    )


def test_a_file_is_read(tiny_mocap: Mocap):
    assert len(tiny_mocap) == 6 and tiny_mocap.pairs == ((0, 1), (2, 3))
    clip = tiny_mocap.clip(4)
    assert (clip.name, clip.subject, clip.action, len(clip), clip.fps) == (
        "05_01",
        "05",
        "walk",
        80,
        30.0,
    )
    np.testing.assert_allclose(clip.pelvis[30], [0.0, 0.95, 1.3], atol=1e-5)
    np.testing.assert_allclose(
        Rotation.from_matrix(clip.rotations[:, 1]).as_rotvec()[0], [-0.1, 0, 0], atol=1e-3
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"poses": None}, "poses is missing"),
        ({"poses": np.zeros((510, 23, 3))}, "poses must be"),
        ({"leg_m": np.zeros(6)}, "leg_m must be at least 0.1"),
        ({"trans": np.full((510, 3), np.nan)}, "trans must be finite"),
        ({"seq_len": np.full(6, 200)}, "beyond the last frame"),
        ({"pairs": np.array([[0, 7]])}, "pairs must name"),
        ({"pairs": np.array([[0, 2]])}, "pairs must name"),
        ({"parents": np.arange(24) - 1}, "not SMPL's tree"),
        ({"names": np.array([{}] * 6, dtype=object)}, "cannot be read"),
    ],
)
def test_wrong_files_are_refused(
    tiny_arrays: dict[str, NDArray], tmp_path: Path, change: dict, message: str
):
    arrays = {name: value for name, value in (tiny_arrays | change).items() if value is not None}
    assert len(tiny_arrays["poses"]) == 510
    path = tmp_path / "wrong.npz"
    np.savez(path, **arrays)
    with pytest.raises(InputError, match=message):
        Mocap.load(path)


def test_what_is_no_archive_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="no such file"):
        Mocap.load(tmp_path / "none.npz")
    for name, content in (
        ("text.npz", b"hello"),
        ("cut.npz", b"PK\x03\x04 cut short"),
        ("empty.npz", b""),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match="cannot be read"):
            Mocap.load(tmp_path / name)
    np.save(tmp_path / "array.npy", np.zeros(3))
    with pytest.raises(InputError, match="cannot be read"):
        Mocap.load(tmp_path / "array.npy")


def test_shoulders_keep_the_upper_arm_where_it_was():
    rng = np.random.default_rng(0)
    local = Rotation.random(200 * 24, random_state=rng).as_matrix().reshape(200, 24, 3, 3)
    local[:, [13, 14]] = np.eye(3)
    adapted = shoulder_rhythm(local)
    for chain in UPPER_ARMS:
        np.testing.assert_allclose(chained(adapted, chain), chained(local, chain), atol=1e-12)
    others = [joint for joint in range(24) if joint not in (13, 14, 16, 17)]
    np.testing.assert_array_equal(adapted[:, others], local[:, others])


def test_collars_rise_with_the_arm_after_the_first_thirty_degrees():
    def collar(elevation_deg: float, side: int) -> NDArray[np.float64]:
        """Where the collar's outer end goes, from that of the hanging arm; the arm is in the
        frontal plane.
        """
        local = np.tile(np.eye(3), (2, 24, 1, 1))
        for row, angle in enumerate((0.0, elevation_deg)):
            turn = np.radians(angle - 90.0) * (1, -1)[side]
            local[row, (16, 17)[side]] = Rotation.from_rotvec([0, 0, turn]).as_matrix()
        outward = shoulder_rhythm(local)[:, (13, 14)[side], :, 0] * (1, -1)[side]
        return np.degrees(np.arcsin(outward[1, 1]) - np.arcsin(outward[0, 1]))

    for side in (0, 1):
        assert abs(collar(20.0, side)) < 0.5  # the dead zone, whose corner is rounded
        # A fifth of the rest: half of the third that is not the shoulder's own (the rest turns in
        # place).
        assert collar(90.0, side) == pytest.approx(12.0, abs=1.0)
        assert collar(170.0, side) == pytest.approx(28.0, abs=2.0)


def test_arms_point_in_the_room_as_they_did_in_the_recording(tiny_mocap: Mocap, body: BodyModel):
    clip = tiny_mocap.clip(5)
    performed = perform(body, SHAPES[0], clip).moved(np.zeros(2), 0.7)
    turn = Rotation.from_rotvec([0, 0, 0.7]).as_matrix() @ Z_UP
    for chain in UPPER_ARMS:
        np.testing.assert_allclose(
            chained(performed.rotations, chain), turn @ chained(clip.rotations, chain), atol=1e-9
        )
    # And with them the joints: the arm's bone has the recorded direction but for the rest pose's
    # own slope.
    bone = performed.joints[:, 19] - performed.joints[:, 17]
    rest = performed.rest[19] - performed.rest[17]
    expected = np.einsum("tij,j->ti", turn @ chained(clip.rotations, UPPER_ARMS[1]), rest)
    np.testing.assert_allclose(bone, expected, atol=1e-9)


def test_parameters_pose_the_body_that_was_planned(tiny_mocap: Mocap, body: BodyModel):
    """SMPL's `transl` is not the pelvis: the joints of the parameters are those of the
    performance.
    """
    double = BodyModel(body.arrays)
    performed = perform(double, SHAPES[1], tiny_mocap.clip(0)).moved(np.array([0.4, -0.3]), 1.1)
    motion = together(SHAPES[1:2], [performed], len(performed))
    joints = double.joints(parameters_of(motion))
    np.testing.assert_allclose(joints, performed.joints, atol=1e-9)


def test_ways_are_longer_by_the_ratio_of_the_legs(tiny_mocap: Mocap, body: BodyModel):
    clip = tiny_mocap.clip(4)
    performed = perform(body, SHAPES[0], clip)
    # +z of the recording is -y of the room.
    way = performed.joints[40, 0, :2] - performed.joints[10, 0, :2]
    ratio = Figure(body, SHAPES[0]).leg_m / clip.leg_m
    np.testing.assert_allclose(way, [0.0, -1.3 * ratio], atol=1e-5)
    turned = performed.moved(np.array([0.5, -1.0]), np.pi / 2)
    way = turned.joints[40, 0, :2] - turned.joints[10, 0, :2]
    np.testing.assert_allclose(way, [1.3 * ratio, 0.0], atol=1e-5)


@pytest.mark.parametrize("shape", [0, 1, 2])
def test_synthetic_people_stand_on_the_floor(tiny_mocap: Mocap, body: BodyModel, shape: int):
    for index in (0, 4, 5):
        heights = lowest(
            body, SHAPES[shape], perform(body, SHAPES[shape], tiny_mocap.clip(index)), 7
        )
        assert (np.abs(heights) < 0.03).mean() > 0.9
        assert heights.min() > -0.06


def test_another_rate_is_the_same_motion(tiny_mocap: Mocap):
    clip = tiny_mocap.clip(4)
    fast = clip.resampled(60.0)
    assert len(fast) == 159
    np.testing.assert_allclose(fast.rotations[::2], clip.rotations, atol=1e-9)
    np.testing.assert_allclose(fast.pelvis[::2], clip.pelvis, atol=1e-9)
    # Half way between two frames: as far from the one as from the other.
    back = Rotation.from_matrix(
        np.swapaxes(fast.rotations[0:-2:2, 1], -1, -2) @ fast.rotations[1::2, 1]
    ).magnitude()
    on = Rotation.from_matrix(
        np.swapaxes(fast.rotations[1::2, 1], -1, -2) @ fast.rotations[2::2, 1]
    ).magnitude()
    np.testing.assert_allclose(back, on, atol=1e-7)
    slow = clip.resampled(25.0)
    assert len(slow) == 66 and slow.fps == 25.0
    np.testing.assert_allclose(slow.pelvis[5], clip.pelvis[6], atol=1e-9)


def test_a_marker_that_jumps_is_bridged(tiny_arrays: dict[str, NDArray], tmp_path: Path):
    arrays = dict(tiny_arrays)
    poses = arrays["poses"].copy()
    poses[40:43, 1, 0] += 1.5  # the hip turns by 86 degrees for three frames
    arrays["poses"] = poses
    np.savez(tmp_path / "jump.npz", **arrays)
    clip = Mocap.load(tmp_path / "jump.npz").clip(0)
    angle = Rotation.from_matrix(clip.rotations[:, 1]).magnitude()
    assert (
        angle.max() < 0.01
    )  # the dancer's hip does not turn; the first frames after the jump go with it


def test_a_clip_without_end_has_no_jump(tiny_mocap: Mocap, body: BodyModel):
    clip = tiny_mocap.clip(5)
    long = endless(clip, 400, start=30)
    assert len(long) == 400
    performed = perform(body, SHAPES[0], long)
    speed = np.linalg.norm(np.diff(performed.joints, axis=0), axis=-1).max() * 30
    own = np.linalg.norm(np.diff(perform(body, SHAPES[0], clip).joints, axis=0), axis=-1).max() * 30
    assert speed < 1.5 * own
    still = stand(body, SHAPES[0], clip, 250, 30.0)
    np.testing.assert_allclose(still.joints[:, 0, :2].mean(axis=0), 0.0, atol=1e-9)


def test_a_walk_follows_a_path(tiny_mocap: Mocap, body: BodyModel):
    time = np.linspace(0.0, 2 * np.pi, 240)
    path, heading = 1.4 * np.stack([np.cos(time), np.sin(time)], axis=1), time + np.pi / 2
    performed = walk_along(body, SHAPES[2], tiny_mocap.clip(4), path, heading, fps=30.0)
    assert (
        np.linalg.norm(performed.joints[:, 0, :2] - path, axis=1).max() < 0.05
    )  # but for the hips' swing
    forward = performed.rotations[:, 0, :2, 2]  # where the pelvis faces
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    assert (forward * ahead).sum(axis=1).min() > 0.95
    assert np.linalg.norm(np.diff(performed.joints, axis=0), axis=-1).max() * 30 < 8.0
    heights = lowest(body, SHAPES[2], performed, 9)
    assert np.abs(heights).max() < 0.06
    # Both legs take about as many steps as the way is long: 8.8 m at 1.3 m a double step of the
    # recorded leg.
    step = (performed.joints[:, 7] - performed.joints[:, 8])[:, :2]
    crossings = np.diff(np.sign((step * ahead).sum(axis=1))) != 0
    expected = 2 * 8.8 / (1.3 * Figure(body, SHAPES[2]).leg_m / 0.8)
    assert abs(crossings.sum() - expected) <= 2


def held(lead: Performance, follow: Performance) -> NDArray[np.float64]:
    """(T,) distance of the nearest two hands of two people."""
    gap = lead.joints[:, [22, 23], None] - follow.joints[:, None, [22, 23]]
    return np.linalg.norm(gap, axis=-1).min(axis=(1, 2))


def test_hands_that_are_near_are_brought_together(body: BodyModel):
    """Two who face each other with bent arms, hands 8 to 13 cm apart: 7 cm afterwards."""
    poses = np.tile(np.eye(3), (60, 24, 1, 1))
    for shoulder, elbow, sign in ((16, 18, 1.0), (17, 19, -1.0)):
        poses[:, shoulder] = Rotation.from_rotvec([0, -0.8 * sign, 0]).as_matrix()
        poses[:, elbow] = Rotation.from_rotvec([0, -0.75 * sign, 0]).as_matrix()
    clip = Clip("a", "a", "", poses, np.tile([0.0, 0.95, 0.0], (60, 1)), 30.0, 0.8, 0.0, True, True)
    lead = perform(body, np.zeros(10), clip)
    reach = abs(lead.joints[0, 22, 1] - lead.joints[0, 0, 1])
    for spare in (0.08, 0.13):
        follow = lead.moved(np.array([0.0, -2 * reach - spare]), np.pi)
        together_ = hold_hands(lead, follow, 30.0)
        assert held(lead, follow).min() > spare - 0.02
        np.testing.assert_allclose(held(*together_), 0.07, atol=0.01)
        for before, after in zip((lead, follow), together_, strict=True):
            for first, second in ((16, 18), (18, 20), (17, 19), (19, 21)):
                bones = [
                    np.linalg.norm(p.joints[:, first] - p.joints[:, second], axis=1)
                    for p in (before, after)
                ]
                np.testing.assert_allclose(*bones, atol=1e-9)
            np.testing.assert_array_equal(after.joints[:, :16], before.joints[:, :16])
    away = lead.moved(np.array([0.0, -2 * reach - 0.5]), np.pi)
    np.testing.assert_allclose(hold_hands(lead, away, 30.0)[0].joints, lead.joints, atol=1e-9)


@pytest.mark.slow
def test_real_people_stand_on_the_floor(real_mocap: Mocap, body: BodyModel):
    for index, shape in ((237, 0), (262, 1), (118, 2), (202, 3), (253, 3), (278, 0)):
        performed = perform(body, SHAPES[shape], real_mocap.clip(index))
        heights = lowest(body, SHAPES[shape], performed, 23)
        assert (np.abs(heights) < 0.03).mean() > 0.85, real_mocap.names[index]
        assert heights.min() > -0.06, real_mocap.names[index]
        keypoints = keypoints_of(
            body, together(SHAPES[shape : shape + 1], [performed], len(performed))
        )
        assert np.linalg.norm(np.diff(keypoints, axis=0), axis=-1).max() * 30 < 12.0
        # No jitter from frame to frame that the recording does not have: accelerations of the
        # pelvis.
        height = performed.joints[:, 0, 2]
        assert (
            np.abs(np.diff(height, 2)).max() * 900 < 40.0
        )  # m/s^2: a stamp, not a jump of centimetres


@pytest.mark.slow
def test_real_pairs_hold_hands(real_mocap: Mocap, body: BodyModel):
    gaps, raw = [], []
    for lead, follow in real_mocap.pairs[4:10:2]:
        clips = [real_mocap.clip(index) for index in (lead, follow)]
        scale = float(np.mean([Figure(body, SHAPES[0]).leg_m / clip.leg_m for clip in clips]))
        two = [perform(body, SHAPES[0], clip, scale=scale) for clip in clips]
        near = np.linalg.norm((two[0].joints - two[1].joints)[:, 0, :2], axis=1) < 0.8
        raw.append(held(*two)[near])
        gaps.append(held(*hold_hands(two[0], two[1], 30.0))[near])
    assert np.median(np.concatenate(gaps)) < 0.09
    assert (
        np.median(np.concatenate(raw)) > 0.1
    )  # what the recordings' limbs leave between hands that touched
