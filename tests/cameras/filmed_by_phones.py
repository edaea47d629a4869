"""Simulated rooms with people, filmed by phones that were started by hand; one phone is carried.

Three layouts (four landscape phones in the corners, four upright phones, three on one side) with
one or two people who walk and raise their arms. Each phone has a start, a clock, a rate (29.97, 30
or variable), a rolling shutter of 20 to 30 ms, a distortion, a stabilisation and a lens of its own.
The odometry of the carried phone drifts and starts anywhere.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.decompositions import nearest_rotation, rigid
from shapepose_fg.core.detections import Detections, Recording
from shapepose_fg.core.rendering import look_at
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.core.trajectory import Trajectory
from shapepose_fg.simulation.bystanders import path_through, walk_along, walking_clips
from shapepose_fg.simulation.detector import Detector, DetectorConfig
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.performance import Performance, together
from shapepose_fg.simulation.scene import UP, Scene
from shapepose_fg.simulation.visibility import OccludingSurface, see

SECONDS, FPS = 60.0, 60.0
"""Duration of a recording, s, and rate of the simulated motion, Hz."""
LAYOUTS = ([40, 130, 220, 310], [20, 95, 170, 275], [30, 85, 150])
"""Directions of the phones from the centre of the room, degrees; the second ones are upright."""


@dataclass(frozen=True)
class Phone:
    """A simulated phone."""

    camera: Camera
    """The true lens; the true pose, of a phone that stands still."""
    time_s: Array
    """(F,) true times of the first row of each frame, s."""
    readout_s: float
    """Time between the first and the last row, s."""
    wTc: Array
    """(F, 4, 4) true pose of each frame at its first row, stabilisation included."""


def film(room: int, mocap: Mocap) -> tuple[list[Phone], Recording]:
    """The phones of a room, the last one carried, and the detections in each phone's frames."""
    rng = np.random.default_rng([room, 45])
    layout, walkers = room // 2 % 3, 1 + room % 2
    scene = _walkers(walkers, mocap, rng)
    phones = [
        _phone(f"phone{n + 1}", np.radians(angle + rng.uniform(-8, 8)), layout == 1, rng)
        for n, angle in enumerate(LAYOUTS[layout])
    ]
    phones.append(_carried(f"phone{len(phones) + 1}", rng))
    skin = OccludingSurface.of(scene.body, DetectorConfig().visibility.cell_m)
    seen = [_seen(each, scene, skin, int(rng.integers(1 << 30))) for each in phones]
    frames = []
    for parts in zip(*seen, strict=True):
        begin = np.cumsum([0, *map(len, parts)])[:-1]
        joint, xy, confidence = (
            np.concatenate([getattr(each, name) for each in parts])
            for name in ("joint", "xy", "confidence")
        )
        view = np.repeat(np.arange(len(parts)), list(map(len, parts)))
        pairs = np.concatenate([each.pairs + at for each, at in zip(parts, begin, strict=True)])
        affinity = np.concatenate([each.affinity for each in parts])
        frames.append(Detections(view, joint, xy, confidence, pairs, affinity))
    return phones, Recording(BODY_25, frames)


def _walkers(count: int, mocap: Mocap, rng: np.random.Generator) -> Scene:
    body, frames = BodyModel.default(), round((SECONDS + 12) * FPS)
    betas = np.clip(rng.normal(0, 1, (count, 10)), -1.8, 1.8)
    walks = list[Performance]()
    others = np.zeros((frames, 0, 2))
    for each in betas:
        clip = mocap.clip(int(rng.choice(walking_clips(mocap, without=frozenset()))))
        path, heading = path_through(
            others,
            frames,
            rng,
            fps=FPS,
            speed_mps=rng.uniform(0.8, 1.3),
            distance_m=np.full(others.shape[1], 0.6),
            half_room_m=1.6,
        )
        others = np.concatenate([others, path[:, None]], axis=1)
        walks.append(walk_along(body, each, clip, path, heading, fps=FPS))
    rig = Rig((Camera("none", np.eye(3), np.eye(4), (2, 2)),), "z")
    motion = together(betas, walks, frames)
    # Arms are raised, each at times of its own, as the instructions ask.
    arms = gaussian_filter1d(rng.normal(size=(frames, count, 2)), 0.4 * FPS, axis=0)
    raised = 2.0 * np.clip(arms / arms.std() - 0.3, 0.0, 1.0)[..., None] * [0, 0, 1.0]
    pose = Rotation.from_rotvec(motion.body_pose[:, :, 15:17].reshape(-1, 3))
    raised[:, :, 1] *= -1
    pose = Rotation.from_rotvec(raised.reshape(-1, 3)) * pose
    motion.body_pose[:, :, 15:17] = pose.as_rotvec().reshape(frames, count, 2, 3)
    return Scene(rig, body, motion, FPS)


def _lens(name: str, wTc: Array, upright: bool, rng: np.random.Generator) -> Camera:
    long, short = 1920, 1080
    f = long / 2 / np.tan(np.radians(rng.uniform(62, 70)) / 2)
    centre = np.array([long - 1, short - 1]) / 2 + rng.normal(0, 12, 2)
    size = (short, long) if upright else (long, short)
    centre = centre[::-1] if upright else centre
    K = np.array([[f, 0, centre[0]], [0, f, centre[1]], [0, 0, 1.0]])
    k1 = rng.normal(0, 0.02)
    return Camera(name, K, wTc, size, distortion=np.array([k1, -k1 / 2, 0, 0, 0]))


def _clock(rng: np.random.Generator) -> Array:
    """Own times of the frames: two fixed rates, or intervals that vary, with a clock of its own."""
    kind, count = rng.integers(3), round(SECONDS * 30)
    step = np.full(count, (1001 / 30000, 1 / 30, 1 / 30)[kind])
    if kind == 2:
        step = step * rng.choice([1.0, 1.0, 1.0, 0.98, 1.02], count)
    return np.cumsum(step) * (1 + rng.normal(0, 2e-5))


def _phone(name: str, angle: float, upright: bool, rng: np.random.Generator) -> Phone:
    far, height = rng.uniform(3.3, 4.2) + 0.6 * upright, rng.uniform(1.0, 1.7)
    eye = np.array([far * np.cos(angle), far * np.sin(angle), height])
    wTc = look_at(eye, np.array([*rng.uniform(-0.3, 0.3, 2), 0.95]), UP)
    roll = Rotation.from_euler("z", rng.normal(0, 2), degrees=True).as_matrix()
    wTc[:3, :3] = wTc[:3, :3] @ roll
    time = rng.uniform(0, 10) + _clock(rng)
    sway = gaussian_filter1d(rng.normal(size=(len(time), 3)), 45, axis=0) * np.sqrt(2 * 45 * 1.77)
    turns = Rotation.from_rotvec(np.radians(0.04) * sway).as_matrix()
    poses = np.tile(wTc, (len(time), 1, 1))
    poses[:, :3, :3] = poses[:, :3, :3] @ turns
    return Phone(_lens(name, wTc, upright, rng), time, rng.uniform(0.02, 0.03), poses)


def _carried(name: str, rng: np.random.Generator) -> Phone:
    """A phone in the hand of somebody who walks about outside and films the people."""
    time = rng.uniform(0, 10) + _clock(rng)
    smooth = [
        gaussian_filter1d(rng.normal(size=(len(time), 3)), w, axis=0) * np.sqrt(2 * w * 1.77)
        for w in (6, 90)
    ]
    turn = rng.uniform(0, 2 * np.pi) + rng.choice([-1, 1]) * 1.2 * np.sin(
        2 * np.pi * time / rng.uniform(25, 50)
    )
    far = 3.2 + 0.25 * smooth[1][:, 0]
    eyes = np.stack([far * np.cos(turn), far * np.sin(turn), 1.5 + 0.06 * smooth[1][:, 1]], axis=-1)
    eyes += 0.006 * smooth[0]
    targets = 0.15 * smooth[1] + 0.01 * smooth[0] + [0, 0, 0.95]
    poses = np.array([look_at(e, t, UP) for e, t in zip(eyes, targets, strict=True)])
    return Phone(_lens(name, poses[0], False, rng), time, rng.uniform(0.02, 0.03), poses)


def odometry(phone: Phone, rng: np.random.Generator, drift: float = 0.01) -> Trajectory:
    """What the carried phone logs, on its own clock: y up, with any heading and origin.

    Scale, heading and position drift; gravity keeps the other two rotations.
    """
    steps = np.diff(phone.wTc[:, :3, 3], axis=0)
    root = np.sqrt(np.linalg.norm(steps, axis=1))
    steps = (
        steps * (1 + rng.normal(0, drift / 2)) + rng.normal(0, drift, steps.shape) * root[:, None]
    )
    heading = np.cumsum(np.append(0, np.radians(0.1) * rng.normal(size=len(root)) * root))
    turn = Rotation.from_euler("z", heading[:, None]).as_matrix()
    moved = np.cumsum(np.r_[np.zeros((1, 3)), np.einsum("fij,fj->fi", turn[1:], steps)], axis=0)
    own = rigid(turn @ phone.wTc[:, :3, :3], moved)
    R = Rotation.from_euler("y", rng.uniform(0, 360), degrees=True).as_matrix()
    oTw = rigid(R @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), rng.normal(0, 1, 3))
    return Trajectory(phone.camera.name, phone.time_s - phone.time_s[0], oTw @ own)


def _seen(phone: Phone, scene: Scene, skin: OccludingSurface, seed: int) -> list[Detections]:
    """The detections of a phone, frame by frame."""
    camera, H = phone.camera, phone.camera.image_size[1]
    ideal = replace(camera, distortion=np.zeros(5))
    detector = Detector(Rig((ideal,), "z"), scene.people, 30.0, DetectorConfig(), seed)
    found = []
    for time, wTc in zip(phone.time_s, phone.wTc, strict=True):
        rig = Rig((replace(ideal, wTc=wTc),), "z")
        at = time * FPS
        joints = _between(scene, np.full((scene.people, 25), at))
        row = np.nan_to_num(rig.project(joints)[0][0, ..., 1], nan=H / 2).clip(0, H) / H
        joints = _between(scene, at + phone.readout_s * FPS * row)
        surface = scene.vertices_at(min(round(at), len(scene) - 1), skin.vertices)
        visible = see(rig, joints, surface, skin, DetectorConfig().visibility)
        each = detector.detect(joints, visible, rig)
        found.append(replace(each, xy=camera.distort(each.xy)))
    return found


def _between(scene: Scene, at: Array) -> Array:
    """(P, 25, 3) keypoints, each at a time `at` (P, 25) of its own, frames."""
    low = at.astype(int).clip(0, len(scene) - 2)
    part = (at - low)[..., None]
    who, joint = np.indices(at.shape)
    points = scene.keypoints
    return (1 - part) * points[low, who, joint] + part * points[low + 1, who, joint]


def similarity(rig: Rig, truth: Rig) -> tuple[Array, Array, float]:
    """Rotation, translation and scale from a rig to the true one: R x / scale + t."""
    near, far = (np.stack([each.wTc[:3, :3] for each in one.cameras]) for one in (rig, truth))
    a, b = (one.centres - one.centres.mean(axis=0) for one in (rig, truth))
    scale = float(np.linalg.norm(a) / np.linalg.norm(b))
    R = nearest_rotation(
        b.T @ a / (scale * (b**2).sum() / len(rig)) + np.sum(far @ near.mT, axis=0)
    )
    return R, truth.centres.mean(axis=0) - R @ rig.centres.mean(axis=0) / scale, scale


def errors(poses: Array, true: Array, by: tuple[Array, Array, float]) -> tuple[Array, Array]:
    """Angles, degrees, and distances, mm, between poses (N, 4, 4) moved `by` a similarity, and true
    ones.
    """
    R, t, scale = by
    turn = Rotation.from_matrix((R @ poses[:, :3, :3]).mT @ true[:, :3, :3]).magnitude()
    away = poses[:, :3, 3] @ R.T / scale + t - true[:, :3, 3]
    return np.degrees(turn), 1e3 * np.linalg.norm(away, axis=1)
