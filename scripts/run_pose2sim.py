"""Pose2Sim on the same grouped 2D detections as ours: python scripts/run_pose2sim.py --venv DIR --output others.

    python scripts/run_pose2sim.py --venv /tmp/pose2sim --output others                  # Shelf and six stretches
    python scripts/run_pose2sim.py --venv /tmp/pose2sim --output others --only shelf
    shapepose-fg evaluate shelf --people others/shelf/pose2sim --ground-truth shelf/gt_dev.txt

Makes the environment DIR where there is none, and installs Pose2Sim from PyPI into it; nothing of it is among our
dependencies. For every recording it writes a project as Pose2Sim wants it (cameras in TOML; people of each view,
grouped greedily by their affinities, as OpenPose's JSON), runs association, triangulation and filtering with the
settings of its own demo of several people (`Choice` says what is another on the stretches), and leaves a TRC file
per person in `OUTPUT/RECORDING/pose2sim` (gaps interpolated, outliers rejected, Butterworth) and in
`OUTPUT/RECORDING/pose2sim-raw` (neither). Recordings are Shelf and the stretches of the named sequences; they need
`--data FOLDER`, or SHAPEPOSE_DATA. What is there stays.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marked_tables import ROOT

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence, Recording
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.experiments.interactions import contacts
from shapepose_fg.evaluation.experiments.others import FILTERED, RAW, folder_name
from shapepose_fg.evaluation.experiments.scale import Scale
from shapepose_fg.evaluation.footage import SHELF_FPS, shelf_footage
from shapepose_fg.io.write_detections import write_openpose

VERSION = "0.10.49"
"""Of Pose2Sim: the settings below are those of its demo `Demo_MultiPerson`."""


@dataclass(frozen=True)
class Choice:
    """What is not left as it is in the demo."""

    error_m: float = 0.1
    """`reconstruction_error_threshold`: people whose rays miss each other by more are not the same."""
    smallest_person: int = 3
    """Groups of fewer joints in a picture are nobody; 3 as in OpenPose."""


SHELF = Choice()
"""Real detections: the demo's settings."""
STRETCHES = Choice(0.035, 9)
"""Chosen on split `tune` (40 frames of salsa): F1 80 %; the demo's settings give 39, either alone up to 52."""
KINDS = {RAW: ("personAssociation", "triangulation"), FILTERED: ("triangulation", "filtering")}
"""The results, and the steps of Pose2Sim that lead to them; who is who is found once."""
STEPS = """\
import json, sys
from pathlib import Path
from Pose2Sim import Pose2Sim
config = json.loads(Path("settings.json").read_text())
for step in sys.argv[1:]:
    getattr(Pose2Sim, step)(config)
"""
"""What runs in the other environment, in the folder of the project."""


def main() -> None:
    """Run it on every recording that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--venv", type=Path, required=True, help="environment of Pose2Sim; made if need be")
    parser.add_argument("--output", type=Path, required=True, help="folder for the TRC files")
    parser.add_argument(
        "--data", type=Path, default=Path(os.environ.get("SHAPEPOSE_DATA", ROOT.parent / "shared"))
    )
    parser.add_argument("--only", nargs="*", help="shelf, salsa, crossing, crowd; all by default")
    parser.add_argument("--split", choices=("tune", "report"), default="report", help="of the stretches")
    parser.add_argument("--frames", type=int, help="of each recording, the first so many")
    arguments = parser.parse_args()
    python = environment(arguments.venv)
    scale = Scale(data=arguments.data, split=arguments.split)
    wanted = arguments.only or ["shelf", "salsa", "crossing", "crowd"]
    if "shelf" in wanted and scale.shelf is not None:
        shelf, output = shelf_footage(scale.shelf), arguments.output / "shelf"
        run(python, shelf.detections, shelf.rig, SHELF_FPS, output, arguments.frames, SHELF)
    for stretch in contacts(scale) if scale.has_scenes else ():
        if stretch.name in wanted:
            output = arguments.output / folder_name(stretch)
            rig, fps = stretch.scene.rig, stretch.scene.fps
            run(python, stretch.detections, rig, fps, output, arguments.frames, STRETCHES)


def environment(folder: Path) -> Path:
    """The Python of an environment that has Pose2Sim."""
    python = folder / "bin" / "python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    has = subprocess.run([str(python), "-c", "import Pose2Sim"], capture_output=True, check=False)
    if has.returncode != 0:
        subprocess.run([str(python), "-m", "pip", "install", "-q", f"pose2sim=={VERSION}"], check=True)
    return python.absolute()


def run(
    python: Path,
    detections: DetectionSequence,
    rig: Rig,
    fps: float,
    output: Path,
    frames: int | None,
    choice: Choice,
) -> None:
    """Both results of one recording."""
    if all((output / kind).is_dir() for kind in (FILTERED, RAW)):
        print(f"{output}: is there already")
        return
    count = len(detections) if frames is None else min(frames, len(detections))
    part = Recording(detections.skeleton, [detections[frame] for frame in range(count)])
    with tempfile.TemporaryDirectory() as temporary:
        project = Path(temporary) / "project"
        write_project(project, part, rig, choice.smallest_person)
        for kind, steps in KINDS.items():
            config = settings(project, fps, count, choice.error_m, filtered=kind == FILTERED)
            (project / "settings.json").write_text(json.dumps(config))
            shutil.rmtree(project / "pose-3d", ignore_errors=True)
            _call(python, steps, project)
            made = sorted((project / "pose-3d").glob("*_filt_*.trc" if kind == FILTERED else "*.trc"))
            shutil.rmtree(output / kind, ignore_errors=True)
            (output / kind).mkdir(parents=True)
            for file in made:
                shutil.copy(file, output / kind)
            print(f"{output / kind}: {len(made)} people in {count} frames", flush=True)


def _call(python: Path, steps: tuple[str, ...], project: Path) -> None:
    """Run steps of Pose2Sim; what it says is shown where it fails."""
    surroundings = os.environ | {"MPLBACKEND": "Agg", "QT_QPA_PLATFORM": "offscreen"}
    surroundings.pop("PYTHONPATH", None)  # ours, not its
    done = subprocess.run(
        [str(python), "-c", STEPS, *steps],
        cwd=project,
        env=surroundings,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        raise SystemExit(f"Pose2Sim failed ({' '.join(steps)}):\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}")


def write_project(project: Path, detections: DetectionSequence, rig: Rig, smallest_person: int) -> None:
    """Cameras and people of each view, named so that Pose2Sim sorts both alike."""
    names = [f"cam{view:02d}" for view in range(1, len(rig) + 1)]
    (project / "calibration").mkdir(parents=True)
    (project / "calibration" / "Calib.toml").write_text(calibration(rig, names))
    (project / "Config.toml").write_text("")  # marks the project; settings come as a dict
    write_openpose(detections, rig, project / "pose", smallest_person=smallest_person)
    for camera, name in zip(rig.cameras, names, strict=True):
        (project / "pose" / camera.name).rename(project / "pose" / f"{name}_json")


def calibration(rig: Rig, names: list[str]) -> str:
    """The cameras as Pose2Sim's own converters write them: a table each, rotation vector, metres."""
    from scipy.spatial.transform import Rotation

    lines = []
    for camera, name in zip(rig.cameras, names, strict=True):
        if camera.lens != "perspective" or camera.distortion[5:].any():
            raise SystemExit(f"camera {camera.name}: Pose2Sim has five coefficients of distortion, not this lens")
        coefficients = [*camera.distortion[:5].tolist(), 0.0, 0.0, 0.0, 0.0, 0.0][:5]
        values = {
            "name": name,
            "size": [float(size) for size in camera.image_size],
            "matrix": camera.K.tolist(),
            "distortions": coefficients,
            "rotation": Rotation.from_matrix(camera.cTw[:, :3]).as_rotvec().tolist(),
            "translation": camera.cTw[:, 3].tolist(),
        }
        lines += [
            f"[{name}]",
            *(f"{key} = {json.dumps(value)}" for key, value in values.items()),
            "fisheye = false",
            "",
        ]
    return "\n".join([*lines, "[metadata]", "adjusted = false", "error = 0.0", ""])


def settings(project: Path, fps: float, frames: int, error_m: float, *, filtered: bool) -> dict[str, Any]:
    """Pose2Sim's settings: those of its demo of several people, without anything that is shown."""
    return {
        "project": {
            "project_dir": str(project),
            "multi_person": True,
            "frame_rate": round(fps),
            "frame_range": "all",
            "participant_height": 1.7,
            "participant_mass": 70.0,
            "exclude_from_batch": [],
        },
        "pose": {"pose_model": "CUSTOM", "CUSTOM": skeleton()},
        "personAssociation": {
            "single_person": {"likelihood_threshold_association": 0.3, "tracked_keypoint": "Neck"},
            "multi_person": {"reconstruction_error_threshold": error_m, "min_affinity": 0.2},
        },
        "triangulation": {
            "reproj_error_threshold_triangulation": 15,
            "likelihood_threshold_triangulation": 0.3,
            "min_cameras_for_triangulation": 2,
            "undistort_points": False,
            "handle_LR_swap": False,
            "predict_displacement": False,
            "match_by": "keypoints",
            "max_distance_m": 1.0,
            "max_unseen_frames": 100,
            "interp_if_gap_smaller_than": 20,
            "interpolation": "linear" if filtered else "none",
            "remove_incomplete_frames": False,
            "sections_to_keep": "all",
            "min_chunk_size": min(10, frames // 2),
            "fill_large_gaps_with": "last_value" if filtered else "nan",
            "show_interp_indices": False,
            "make_c3d": False,
        },
        "filtering": {
            "reject_outliers": True,
            "filter": True,
            "type": "butterworth",
            "display_figures": False,
            "save_filt_plots": False,
            "make_c3d": False,
            "butterworth": {"cut_off_frequency": 6, "order": 4},
        },
        "logging": {"use_custom_logging": False},
    }


def skeleton() -> dict[str, Any]:
    """BODY_25 as a tree: Pose2Sim's own leaves out eyes and ears, of which Shelf's head is made."""

    def node(joint: int) -> dict[str, Any]:
        children = [node(child) for child, parent in enumerate(BODY_25.parents) if parent == joint]
        name = "CHip" if joint == BODY_25.root else BODY_25.joints[joint]
        return {"name": name, "id": joint} | ({"children": children} if children else {})

    return node(BODY_25.root)


if __name__ == "__main__":
    main()
