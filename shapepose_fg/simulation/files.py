"""Scenes by name, their ground truth as a result, and simulated recordings as files in common
formats.
"""

import os
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.provenance import versions
from shapepose_fg.core.reconstruction import Reconstruction, Status
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.io.calibration import write_rig
from shapepose_fg.io.write_detections import refuse_leftovers, write_association, write_openpose
from shapepose_fg.simulation import Scene, built_in_scene
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.sequences import SEQUENCES, Split, sequence

Format = Literal["association", "openpose"]
"""Formats of simulated detections."""

NAMES = ("demo", *SEQUENCES)
"""Names of scenes: the built-in one, and the interaction sequences from recorded motions."""

_OPENPOSE = "openpose"
"""Folder of the detections in OpenPose's format."""
_MOCAP = Path("data") / "cmu_mocap" / "cmu_smpl24.npz"
"""Path of the recorded motions inside the folder of real recordings."""


def named_scene(
    name: str,
    *,
    split: str = "tune",
    cameras: int = 6,
    people: int | None = None,
    frames: int = 0,
    seed: int = 0,
    mocap: Path | None = None,
) -> Scene:
    """The scene called `name`. Raises InputError if an option is wrong or the motions are missing.

    `people` and `seed` apply to the built-in scene, which has 60 frames, or `frames` if that is
    more. `frames` limits a sequence to its first frames (0: all), without generating later
    segments.
    """
    if name not in NAMES:
        raise InputError(f"{name}: must be one of {' '.join(NAMES)}")
    if not 2 <= cameras <= 12:
        raise InputError(f"--cameras {cameras}: must be 2 to 12")
    if name == "demo":
        people = 4 if people is None else people
        if not 0 <= people <= 12:
            raise InputError(f"--people {people}: must be 0 to 12")
        return built_in_scene(seed, people=people, cameras=cameras, frames=max(60, frames))
    if split not in get_args(Split):
        raise InputError(f"--split {split}: must be {' or '.join(get_args(Split))}")
    if people is not None:
        raise InputError(
            f"--people {people}: {name} has {SEQUENCES[name].people} people; leave it out, or "
            "use demo"
        )
    until = frames if frames > 0 else None
    motions = Mocap.load(_motions(mocap))
    return sequence(name, split, motions, cameras=cameras, until=until)  # type: ignore[arg-type]


def truth_of(scene: Scene) -> Reconstruction:
    """Ground truth of all people in all frames of `scene`; `person` 0 to P - 1, sorted by frame.

    Joints and bodies are exact: covariances are zero and confidences one. Velocities, and how
    joints are known, are missing, because the scene has no visibility.
    """
    T, P = scene.motion.transl.shape[:2]
    N = T * P
    return Reconstruction(
        frame=np.repeat(np.arange(T), P),
        person=np.tile(np.arange(P), T),
        time_s=np.repeat(np.arange(T) / scene.fps, P),
        joint_names=np.array(BODY_25.joints),
        joints=scene.keypoints.reshape(N, len(BODY_25), 3),
        covariance=np.zeros((N, len(BODY_25), 3, 3)),
        confidence=np.ones((N, len(BODY_25))),
        betas=np.tile(scene.motion.betas, (T, 1)),
        global_orient=scene.motion.global_orient.reshape(N, 3),
        body_pose=scene.motion.body_pose.reshape(N, 23, 3),
        transl=scene.motion.transl.reshape(N, 3),
        status=np.full(N, str(Status.OK)),
    )


def check_output(scene: Scene, folder: Path, format: Format) -> None:
    """Raise InputError, before any work, if `write_simulated` could not write into `folder`."""
    if format == "openpose":
        refuse_leftovers(scene.rig, folder / _OPENPOSE)


def write_simulated(
    scene: Scene, detections: DetectionSequence, folder: Path, format: Format, **run: Any
) -> dict[str, Path]:
    """Write cameras, detections and ground truth of a simulated recording into `folder`; returns
    the paths by content.

    `rig.json`; `calibration.json` and `detection/<camera>.txt`, or `openpose/<camera>/`; and
    `truth/people.npz`, in a separate folder so that a reconstruction saved to `folder` does not
    replace it. `truth/run.json` has `run`, the frame rate, and the cuts: first frames after each.
    """
    write_rig(scene.rig, folder / "rig.json")
    if format == "association":
        write_association(detections, scene.rig, folder)
        place = folder / "detection"
    else:
        place = folder / _OPENPOSE
        write_openpose(detections, scene.rig, place)
    about = {
        "fps": scene.fps,
        "frames": len(scene),
        "people": scene.people,
        "cameras": len(scene.rig),
    }
    about |= {"cuts": list(scene.cuts), **run}
    truth_of(scene).with_run(simulated=about, versions=versions()).save(folder / "truth")
    return {
        "cameras": folder / "rig.json",
        "detections": place,
        "truth": folder / "truth" / "people.npz",
    }


def _motions(path: Path | None) -> Path:
    """The file of recorded motions: `path`, or its usual location. Raises InputError if it is
    missing.
    """
    if path is not None:
        return path
    path = Path(os.environ.get("SHAPEPOSE_DATA", Path("..") / "shared")) / _MOCAP
    if not path.is_file():
        raise InputError(
            f"{path}: the recorded motions are missing; give their file with --mocap, set "
            "SHAPEPOSE_DATA to the folder that holds data/cmu_mocap, or simulate demo, which "
            "needs none"
        )
    return path
