"""Measure calibration with phones: simulated rooms, filmed by phones that were started by hand.

    python scripts/check_phones.py --rooms 0:6

Three layouts (four landscape phones in the corners, four portrait phones, three phones on one side)
with one and two people who walk for a minute, recorded walks from `--data FOLDER` (or
SHAPEPOSE_DATA). Each phone has a start, a clock, a rate (29.97, 30 or variable), a rolling shutter
of 20 to 30 ms, a distortion, a stabilisation and a lens of its own; the method is told 65 degrees,
--focal and one distance. A further phone is carried by hand, with an odometry that drifts and
starts anywhere. docs/evaluation.md has the results. About three minutes per room on one core.
"""

import argparse
import contextlib
import io
import json
import os
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parent.parent))

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.cli.main import main as command
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.decompositions import nearest_rotation, rigid
from shapepose_fg.core.detections import Detections, Recording
from shapepose_fg.core.rig_file import write_trajectory
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.core.trajectory import Trajectory
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.recording import read_recording
from shapepose_fg.io.timestamps import write_timestamps
from shapepose_fg.io.write_detections import write_association
from shapepose_fg.pipeline.pipeline import refine_trajectories
from shapepose_fg.simulation.bystanders import walk_along, walking_clips, way_through
from shapepose_fg.simulation.detector import Detector, DetectorConfig
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.performance import together
from shapepose_fg.simulation.scene import UP, Scene
from shapepose_fg.simulation.visibility import Skin, see
from shapepose_fg.viz.rendering import look_at

SECONDS, FPS, REFINED = 60.0, 60.0, 400
"""Duration of a recording, s, rate of the simulated motion, Hz, and number of frames in which the
carried phone is refined."""
LAYOUTS = {
    "corners, landscape": ([40, 130, 220, 310], False),
    "around, portrait": ([20, 95, 170, 275], True),
    "one side, landscape": ([30, 85, 150], False),
}
"""Directions of the phones from the centre of the room, degrees, and whether they are upright."""


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
    (angles, upright), walkers = list(LAYOUTS.values())[room // 2 % 3], 1 + room % 2
    scene = _walkers(walkers, mocap, rng)
    phones = [
        _phone(f"phone{n + 1}", np.radians(angle + rng.uniform(-8, 8)), upright, rng)
        for n, angle in enumerate(angles)
    ]
    phones.append(_carried(f"phone{len(phones) + 1}", rng))
    skin = Skin.of(scene.body, DetectorConfig().visibility.cell_m)
    seen = [_seen(each, scene, skin, int(rng.integers(1 << 30))) for each in phones]
    frames = []
    for parts in zip(*seen, strict=True):
        begin = np.cumsum([0, *map(len, parts)])[:-1]
        columns = [
            np.concatenate([getattr(each, name) for each in parts])
            for name in ("joint", "xy", "confidence")
        ]
        view = np.repeat(np.arange(len(parts)), list(map(len, parts)))
        pairs = np.concatenate([each.pairs + at for each, at in zip(parts, begin, strict=True)])
        affinity = np.concatenate([each.affinity for each in parts])
        frames.append(Detections(view, *columns, pairs, affinity))
    return phones, Recording(BODY_25, frames)


def _walkers(count: int, mocap: Mocap, rng: np.random.Generator) -> Scene:
    body, frames = BodyModel.default(), round((SECONDS + 12) * FPS)
    betas = np.clip(rng.normal(0, 1, (count, 10)), -1.8, 1.8)
    walks = list[object]()
    others = np.zeros((frames, 0, 2))
    for each in betas:
        clip = mocap.clip(int(rng.choice(walking_clips(mocap, without=frozenset()))))
        path, heading = way_through(
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
    size = (long, short)
    if upright:
        centre, size = centre[::-1], size[::-1]
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


def _seen(phone: Phone, scene: Scene, skin: Skin, seed: int) -> list[Detections]:
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


def measure(room: int, mocap: Mocap, folder: Path) -> dict[str, object]:
    """Film a room, type the commands, and compare the result with the truth."""
    phones, recording = film(room, mocap)
    rng, fixed = np.random.default_rng([room, 46]), phones[:-1]
    names, truth = [each.camera.name for each in phones], Rig(tuple(p.camera for p in fixed), "z")
    write_association(recording, Rig(tuple(each.camera for each in phones), "z"), folder)
    own = np.column_stack([each.time_s - each.time_s[0] for each in phones])
    write_timestamps(folder / "detection" / "times.csv", names, own)
    write_trajectory(odometry(phones[-1], rng), folder / "log.tum")
    far = np.linalg.norm(truth.centres[0] - truth.centres[1]) + rng.normal(0, 0.01)
    words = ["--detections", folder / "detection", "--field-of-view", "65", "--focal", "--json"]
    words += ["--image-size", "{}x{}".format(*fixed[0].camera.image_size)]
    words += ["--distance", f"phone1,phone2={far:.2f}", "--times", folder / "times.csv"]
    words += ["--trajectory", f"{names[-1]}={folder / 'log.tum'}"]
    said, rig_file = io.StringIO(), folder / "calibration.json"
    with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
        command(["calibrate", *map(str, words), "--output", str(rig_file)])
    found: dict[str, object] = {"room": room, "people": 1 + room % 2}
    if not rig_file.exists():
        return found | {"refused": True}
    rig, cameras = read_rig(rig_file), json.loads(said.getvalue())["cameras"]
    by = similarity(rig.only(names[:-1]), truth)
    turn, move = errors(rig.wTc[:-1], truth.wTc, by)
    sigma = np.array([each["sigma_turn_deg"] for each in cameras]) / np.sqrt(3)
    found |= {"deg": turn.round(2).tolist(), "mm": move.round().tolist()}
    found |= {"inside": int((turn < np.sqrt(7.815) * sigma).sum()), "scale": round(by[2], 4)}
    recording, times = read_recording(
        folder / "detection", rig, None, folder / "kept", timestamps=folder / "times.csv"
    )
    span = range(len(recording) // 3, len(recording) // 3 + REFINED)
    begin, end = times.frame_s[[span.start, span.stop]]
    frame_s = np.genfromtxt(folder / "times.csv", delimiter=",", skip_header=1)[:, -1]
    used = (frame_s > begin) & (frame_s < end)
    refined = refine_trajectories(recording, rig, frames=span, times=times)
    for name, each in (("start", rig), ("refined", refined)):
        poses = each.trajectories[0].at(frame_s[used]) @ each.cameras[-1].bTc
        figures = errors(poses, phones[-1].wTc[used], by)
        found[name] = [round(float(np.sqrt((figure**2).mean())), 2) for figure in figures]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    given = os.environ.get("SHAPEPOSE_DATA", Path(__file__).parents[2] / "shared")
    parser.add_argument("--rooms", default="0:6", help="which rooms, first:stop")
    parser.add_argument("--data", type=Path, default=given)
    arguments = parser.parse_args()
    mocap = Mocap.load(arguments.data / "data" / "cmu_mocap" / "cmu_smpl24.npz")
    for room in range(*map(int, arguments.rooms.split(":"))):
        with tempfile.TemporaryDirectory() as folder:
            print(json.dumps(measure(room, mocap, Path(folder))), flush=True)


if __name__ == "__main__":
    main()
