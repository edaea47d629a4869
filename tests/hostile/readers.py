"""Every reader of files from others, with valid files to be changed: for property tests and
fuzz.py.
"""

import json
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.body.model.smpl_file import SMPL_PARENTS, read_smpl_file
from shapepose_fg.body.shapes import SubjectShapes
from shapepose_fg.cli.batch.status import BatchStatus, RecordingStatus, read_status
from shapepose_fg.cli.batch.table import read_table
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.observation_table import ObservationTable
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.rig_file import POSE
from shapepose_fg.core.skeleton import BODY_25, COCO_17
from shapepose_fg.detection2d.opening import read_form
from shapepose_fg.estimation.motion_densities import MotionConfig, MotionModel
from shapepose_fg.evaluation.shelf import read_shelf_ground_truth
from shapepose_fg.evaluation.truth import read_people
from shapepose_fg.io.calibration import read_rig, write_rig
from shapepose_fg.io.calibration.reading import cameras_of
from shapepose_fg.io.config import read_config, toml_text
from shapepose_fg.io.detections import read_detections
from shapepose_fg.io.export.registry import FORMATS
from shapepose_fg.io.footage.placement import read_used_footage
from shapepose_fg.io.pose2sim_project import read_pose2sim_project
from shapepose_fg.io.recording import read_moments, write_moments
from shapepose_fg.io.skeleton_file import read_skeleton
from shapepose_fg.io.timestamps import read_timestamps
from shapepose_fg.io.trajectories import read_trajectory
from shapepose_fg.pipeline.pipeline import PipelineConfig
from shapepose_fg.results.corrections import correct, read_corrections, take_back
from shapepose_fg.results.edits import Action, Edit
from shapepose_fg.results.explain import explain
from shapepose_fg.results.solve_again import Solver
from shapepose_fg.results.track_summary import list_saved_tracks
from shapepose_fg.viz.report.writing import report_of
from tests.conftest import read_body
from tests.core import test_reconstruction as results
from tests.hostile import runs, streams
from tests.hostile.trying import Prepare
from tests.io import test_calibration_formats as rigs
from tests.io import test_detections_of_other_programs as others
from tests.io import test_people_formats as people

Read = Callable[[], object]
"""Reads the files; raises InputError, or returns."""


def _calibration(program: str) -> Prepare:
    def prepare(folder: Path, seed: int) -> Read:
        write, wishes, _ = rigs.WRITERS[program]
        path = write(folder)
        return lambda: read_rig(path, **wishes)

    return prepare


def _rig_file(folder: Path, seed: int) -> Read:
    write_rig(_rig(seed), folder / "rig.json")
    return lambda: read_rig(folder / "rig.json")


def _association(folder: Path, seed: int) -> Read:
    cameras = {
        camera.name: {
            "K": camera.K.ravel().tolist(),
            "RT": camera.cTw.ravel().tolist(),
            "imgSize": list(camera.image_size),
            "distCoeff": [0.1, 0, 0, 0, 0],
        }
        for camera in _rig(seed).cameras
    }
    (folder / "calibration.json").write_text(json.dumps(cameras))
    return lambda: read_rig(folder / "calibration.json")


def _colmap(folder: Path, seed: int) -> Read:
    shutil.copytree(rigs.DATA / "colmap", folder / "colmap")
    return lambda: read_rig(folder / "colmap", unit="m", up="z")


def _people(program: str) -> Prepare:
    def prepare(folder: Path, seed: int) -> Read:
        people.WRITERS[program](folder, people.people_of(BODY_25 if seed % 2 else COCO_17))
        rig = people.two_cameras("left", "right")
        return lambda: read_detections(folder, rig)

    return prepare


def _others(program: str) -> Prepare:
    def prepare(folder: Path, seed: int) -> Read:
        rig, found = people.two_cameras("cam_0", "cam_1"), others.random_people(seed, (640, 480))
        others.WRITERS[program](folder, rig, found)
        return lambda: read_detections(folder, rig)

    return prepare


def _text(folder: Path, seed: int) -> Read:
    """4D Association's: two hips, three necks and a wrist; nobody; a nose, hips and knees."""
    rng = np.random.default_rng(seed)
    for name in ("left", "right"):
        lines = ["4 3"]
        for count in ({8: 2, 1: 3, 4: 1}, {}, {0: 1, 9: 2, 10: 2}):
            for joint in range(25):
                lines += [
                    str(count.get(joint, 0)),
                    *(_row(rng, count.get(joint, 0)) for _ in range(3)),
                ]
            lines += [_row(rng, count.get(a, 0) * count.get(b, 0)) for a, b in BODY_25.limbs]
        (folder / f"{name}.txt").write_text("\n".join(lines))
    rig = people.two_cameras("left", "right")
    return lambda: read_detections(folder, rig)


def _row(rng: np.random.Generator, count: int) -> str:
    return " ".join(f"{value:.3f}" for value in rng.uniform(0.1, 0.9, count))


def _skeleton(folder: Path, seed: int) -> Read:
    (folder / "ours.toml").write_text(people.USER)
    return lambda: read_skeleton(folder / "ours.toml")


def _settings(folder: Path, seed: int) -> Read:
    (folder / "settings.toml").write_text(toml_text(PipelineConfig()))
    return lambda: read_config(folder / "settings.toml", PipelineConfig)


def _times(folder: Path, seed: int) -> Read:
    (folder / "times.csv").write_text(
        "frame, cam0, cam1\n" + "".join(f"{t}, {t / 25}, {t / 25}\n" for t in range(9))
    )
    rig = _rig(seed, 2)
    return lambda: read_timestamps(folder / "times.csv", rig, 9)


def _moments(folder: Path, seed: int) -> Read:
    write_moments(folder / "moments.csv", _rig(seed, 2), np.array([[4, 0], [5, -1], [6, 2]]))
    return lambda: read_moments(folder / "moments.csv")


def _trajectory(folder: Path, seed: int) -> Read:
    rng, count = np.random.default_rng(seed), 9
    turn = rng.normal(size=(count, 4))
    pose = np.column_stack(
        [
            np.arange(count) / 25,
            rng.normal(size=(count, 3)),
            turn / np.linalg.norm(turn, axis=1)[:, None],
        ]
    )
    names = [*POSE, *(f"{each}_{each}" for each in ("rx", "ry", "rz", "x", "y", "z"))]
    lines = [" ".join(names), *(" ".join(map(repr, [*row, *[0.01] * 6])) for row in pose.tolist())]
    (folder / "robot.csv").write_text("\n".join(lines) + "\n")
    return lambda: read_trajectory(folder / "robot.csv")


def _project(folder: Path, seed: int) -> Read:
    rig = _rig(seed, 2)
    (folder / "calibration").mkdir()
    write_rig(rig, folder / "calibration" / "rig.json")
    for name in rig.names:
        (folder / "pose" / f"{name}_json").mkdir(parents=True)
        (folder / "pose" / f"{name}_json" / f"{name}_000003.json").write_text(
            '{"version": 1.3, "people": []}'
        )
    text = (
        "[project]\nmulti_person = false\nframe_rate = 50\nframe_range = [3, "
        "4]\n[pose]\npose_model = 'Body'\n"
    )
    (folder / "Config.toml").write_text(text)
    return lambda: read_pose2sim_project(folder)


def _recordings(folder: Path, seed: int) -> Read:
    text = '[defaults]\nfps = 25\ncalibration = "cameras.toml"\n'
    text += '[recordings.walk]\ndetections = "walk"\ncuts = [300, 600]\nskeleton = "COCO_17"\n'
    text += '[recordings.dance-2]\nproject = "/data/dance"\nframes = "0:100"\nshapes = "who.npz"\n'
    (folder / "recordings.toml").write_text(text)
    return lambda: read_table(folder / "recordings.toml")


def _batch(folder: Path, seed: int) -> Read:
    status = BatchStatus(
        folder / "batch.json",
        "recordings.toml",
        {"walk": RecordingStatus({"fps": 25.0, "cuts": [3]})},
    )
    status.set("dance", RecordingStatus({}).failed("no", 1.5, 1))
    return lambda: read_status(folder / "batch.json")


def _network(folder: Path, seed: int) -> Read:
    """A network's TOML file; of the ONNX files that it names nothing is read yet."""
    lines = [
        'network = "pose.onnx"',
        'skeleton = "COCO_17"',
        'decoding = "heat map"',
        "size = [192, 256]",
    ]
    lines += [
        'joints = ["Nose", "", "LHip"]',
        "mean = [0.0, 1, 2]",
        "std = [58.4, 57.1, 57.4]",
        "[boxes]",
    ]
    (folder / "n.toml").write_text(
        "\n".join([*lines, 'network = "boxes.onnx"', "min_score = 0.5", ""])
    )
    return lambda: read_form(folder / "n.toml")


def _corrections(folder: Path, seed: int) -> Read:
    edits = [
        {"action": "split", "person": 1, "other": 7, "frame": 4},
        {"action": "drop", "person": 2},
    ]
    content = {"format": "shapepose-fg corrections 1", "people": "0" * 64, "edits": edits}
    (folder / "corrections.json").write_text(json.dumps(content))
    (folder / "people.npz").write_bytes(b"others")
    return lambda: read_corrections(folder)


def _footage(folder: Path, seed: int) -> Read:
    camera = {"name": "c", "path": "c.mp4", "placement": "letterbox", "picture_size": [960, 512]}
    camera |= {"calibrated_size": [1920, 1080], "pictures": [3, 4, -1, 6]}
    content = {"format": "shapepose-fg footage 1", "network": {}, "cameras": [camera]}
    (folder / "footage.json").write_text(json.dumps(content))
    return lambda: read_used_footage(folder / "footage.json")


def _offsets(folder: Path, seed: int) -> Read:
    KeypointOffsets.identity().save(folder / "offsets.json")
    return lambda: KeypointOffsets.load(folder / "offsets.json")


def _motion(folder: Path, seed: int) -> Read:
    from importlib.resources import files

    (folder / "motion.json").write_text(
        (files("shapepose_fg.estimation") / "data" / "motion.json").read_text()
    )
    config = MotionConfig(model=str(folder / "motion.json"))
    return lambda: MotionModel.load(BODY_25.joints, config)


def _result(folder: Path, seed: int) -> Read:
    results.people([0, 0, 3], seed).save(folder)
    runs.unpack(folder / "people.npz")
    return lambda: Reconstruction.load(folder)


def _listed(folder: Path) -> None:
    with Reconstruction.open(folder) as opened:
        list_saved_tracks(opened, read_body())


def _explained(folder: Path) -> None:
    """Every tenth joint of everybody, in the first frame in which each is."""
    people, rig = Reconstruction.load(folder), cameras_of(folder)
    for person in np.unique(people.person).tolist()[:2]:
        frame = int(people.frame[people.person == person][0])
        for joint in people.joint_names.tolist()[::10]:
            found = explain(people, rig, person=person, joint=joint, frame=frame)
            json.dumps(found.as_dict(), allow_nan=False)


def _settings_of(folder: Path) -> None:
    Solver.read(folder, Reconstruction.load(folder))


def _merged(folder: Path) -> None:
    with Reconstruction.open(folder) as opened:
        found, frame = np.unique(opened.person).tolist(), int(opened.frame[-1])
    if len(found) > 1:
        correct(folder, Edit(Action.SWAP, found[0], found[1], frame=frame))
    else:
        correct(folder, Edit(Action.SPLIT, found[0], found[0] + 1, frame=frame))
    take_back(folder)


def _observations(folder: Path, seed: int) -> Read:
    from tests.core import test_observation_table as tables

    tables.table().save(folder / "observations.npz")
    runs.unpack(folder / "observations.npz")
    return lambda: ObservationTable.load(folder / "observations.npz")


def _shapes(folder: Path, seed: int) -> Read:
    runs.shapes(seed).save(folder / "shapes.npz")
    runs.unpack(folder / "shapes.npz")
    return lambda: SubjectShapes.load(folder / "shapes.npz", "body")


def _body(pickled: bool) -> Prepare:
    def prepare(folder: Path, seed: int) -> Read:
        arrays = tiny_body(seed)
        if pickled:
            arrays["J_regressor"] = scipy.sparse.csc_matrix(arrays["J_regressor"])
            (folder / "body.pkl").write_bytes(pickle.dumps(arrays, protocol=2 + seed % 3))
            return lambda: read_smpl_file(folder / "body.pkl")
        np.savez(folder / "body.npz", **arrays)
        return lambda: read_smpl_file(folder / "body.npz")

    return prepare


def tiny_body(seed: int) -> dict[str, np.ndarray]:
    """A body in SMPL's format with two vertices at each joint and keypoint of the shipped one, and
    no more.
    """
    from tests.conftest import read_body

    body, rng = read_body(), np.random.default_rng(seed)
    points = np.concatenate([body.joint_regressor, body.keypoint_regressor]) @ body.template
    apart = rng.normal(0, 0.01, points.shape)
    count = 2 * len(points)
    pairs = np.kron(np.eye(len(points)), [[0.5, 0.5]])
    weights = np.repeat(np.eye(len(points))[:, :24] + 1e-3, 2, axis=0)
    return {
        "v_template": np.stack([points + apart, points - apart], axis=1).reshape(-1, 3),
        "shapedirs": rng.normal(0, 0.01, (count, 3, 10)),
        "J_regressor": pairs[:24],
        "keypoint_regressor": pairs[24:],
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "kintree_table": np.array([(2**32 - 1, *SMPL_PARENTS[1:]), range(24)], dtype=np.uint32),
        "f": rng.integers(0, count, (20, 3)).astype(np.uint32),
    }


def _weights(folder: Path, seed: int) -> Read:
    from shapepose_fg.body.fitting.network import NetworkConfig, UpdateNetwork, layer_shapes
    from shapepose_fg.body.fitting.weights import FitterWeights

    config = NetworkConfig(width=2, blocks=1)
    network = UpdateNetwork(
        config, {name: np.zeros(shape) for name, shape in layer_shapes(config).items()}
    )
    shipped = FitterWeights.default()
    FitterWeights(network, shipped.frame, "body", shipped.spread, {}).save(
        folder / "weights.safetensors"
    )
    return lambda: FitterWeights.load(folder / "weights.safetensors")


def _rig(seed: int, cameras: int = 3) -> Rig:
    from shapepose_fg.simulation.scene import ring_of_cameras

    return ring_of_cameras(cameras, np.random.default_rng(seed))


def _annotation(folder: Path, seed: int) -> Read:
    path, rng = folder / "gt.txt", np.random.default_rng(seed)
    lines = ["15\t2"]
    for count in (2, 1):
        lines.append(str(count))
        for person in range(count):
            rows = np.concatenate([rng.normal(0, 1, (3, 15)), np.ones((1, 15))])
            lines += [str(person), *(" ".join(f"{value:10.6g}" for value in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return lambda: read_shelf_ground_truth(path)


def _actors(folder: Path, seed: int) -> Read:
    from scipy.io import savemat

    actors, rng = np.empty((1, 2), dtype=object), np.random.default_rng(seed)
    for n in range(2):
        actors[0, n] = np.empty((2, 1), dtype=object)
        for frame in range(2):
            actors[0, n][frame, 0] = rng.normal(0, 0.4, (14, 3))
    savemat(folder / "actorsGT.mat", {"actor3D": actors}, do_compression=seed % 2 == 0)
    return lambda: read_people(folder / "actorsGT.mat")


def _panoptic(folder: Path, seed: int) -> Read:
    rng = np.random.default_rng(seed)
    for frame in range(2):
        bodies = [{"id": n, "joints19": rng.normal(0, 40, 76).tolist()} for n in range(2)]
        text = json.dumps({"version": 0.7, "bodies": bodies})
        (folder / f"body3DScene_{frame:08d}.json").write_text(text)
    return lambda: read_people(folder)


def _joints(folder: Path, seed: int) -> Read:
    joints = np.random.default_rng(seed).normal(0, 0.4, (3, 2, 17, 3))
    np.savez(folder / "truth.npz", joints=joints, layout="H36M_17", frames=np.arange(3))
    return lambda: read_people(folder / "truth.npz")


def _amass(folder: Path, seed: int) -> Read:
    rng, path = np.random.default_rng(seed), folder / "person_1.npz"
    more = {"betas": rng.normal(0, 1, 16), "mocap_framerate": np.array(50.0)}
    poses, trans = rng.normal(0, 0.3, (4, 156)), rng.normal(0, 1, (4, 3))
    np.savez(path, poses=poses, trans=trans, body=np.array("shapepose-fg open body"), **more)
    return lambda: read_people(path, up="z", fps=25.0)


PARTS: dict[str, tuple[int, dict[str, Any]]] = {
    "parts on the way": (2, {}),
    "parts in chunks": (2, {"chunk_frames": 6}),
    "parts before the end": (99, {"bodies": True}),
}
"""Where a run was stopped: behind so many writes."""
READERS: dict[str, Prepare] = {
    **{f"cameras of {program}": _calibration(program) for program in rigs.WRITERS},
    **{f"detections of {program}": _people(program) for program in people.WRITERS},
    **{f"detections of {program}": _others(program) for program in others.WRITERS},
    "cameras of COLMAP": _colmap,
    "cameras of 4D Association": _association,
    "cameras in our rig file": _rig_file,
    "detections of 4D Association": _text,
    "skeleton": _skeleton,
    "settings": _settings,
    "times": _times,
    "moments": _moments,
    "trajectory": _trajectory,
    "project of Pose2Sim": _project,
    "recordings": _recordings,
    "batch": _batch,
    "ONNX": streams.network,
    "ONNX's file": streams.network_file,
    "photo, JPEG": streams.photo("JPEG"),
    "photo, PNG": streams.photo("PNG"),
    "photo, TIFF": streams.photo("TIFF"),
    "MCAP of poses": streams.mcap("poses"),
    "MCAP of detections": streams.mcap("detections"),
    "lines of live": streams.live_lines,
    "state of live": streams.live_state,
    "network": _network,
    "corrections": _corrections,
    "footage": _footage,
    "offsets": _offsets,
    "motion": _motion,
    "result": _result,
    **{f"result as {name}": runs.finished(runs.exported(name)) for name in FORMATS},
    "result for its report": runs.finished(report_of),
    "result to be explained": runs.finished(_explained),
    "result for its tracks": runs.finished(_listed),
    "result for corrections": runs.finished(_merged),
    "result and its settings": runs.finished(_settings_of),
    **{
        f"{what}, {'with digests' if sealed else 'as they are'}": runs.parts_of(
            writes, sealed=sealed, **options
        )
        for what, (writes, options) in PARTS.items()
        for sealed in (False, True)
    },
    "run on its way": runs.unfinished(2),
    "run in chunks": runs.unfinished(2, chunk_frames=6),
    "run before its bodies": runs.unfinished(4, bodies=True),
    "run before its end": runs.unfinished(99, bodies=True),
    "result that was corrected": runs.corrected,
    "run with known people": runs.known_people,
    "detections of a run": runs.detections_kept,
    "observations": _observations,
    "shapes": _shapes,
    "body": _body(False),
    "pickled body": _body(True),
    "weights": _weights,
    "Shelf's annotation": _annotation,
    "actors of Shelf and Campus": _actors,
    "people of Panoptic": _panoptic,
    "joints of a data set": _joints,
    "motion of AMASS": _amass,
}
"""Every reader, by what it reads."""
