"""Simulated recordings as files: what `shapepose-fg simulate` makes, for this program and for any other."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.provenance import versions
from shapepose_fg.io.calibration import write_rig
from shapepose_fg.io.write_detections import refuse_leftovers, write_association, write_openpose
from shapepose_fg.simulation import Scene, built_in_scene
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.room import SequenceConfig
from shapepose_fg.simulation.sequences import SEQUENCES, Sequence, Split, sequence
from shapepose_fg.simulation.truth import truth_of

Format = Literal["association", "openpose"]
"""What detections are written as."""

NAMES = ("demo", *SEQUENCES)
"""The built-in scene, and the interaction sequences that are made of recorded motions."""

_OPENPOSE = "openpose"
"""The folder of OpenPose's folders."""
_MOCAP = Path("data") / "cmu_mocap" / "cmu_smpl24.npz"
"""Where the recorded motions are inside the folder of real recordings."""


def named_scene(
    name: str,
    *,
    split: str = "tune",
    cameras: int = 6,
    people: int | None = None,
    frames: int = 0,
    seed: int = 0,
    mocap: Path | None = None,
    config: SequenceConfig | None = None,
    fps: float | None = None,
) -> Scene:
    """The scene called `name`; InputError, one sentence, where an option is wrong or the motions are not there.

    `people` and `seed` are the built-in scene's, which has 60 frames, or `frames` if that is more. A sequence
    is what it is, or what `config` says; where only its first `frames` are wanted (0: all) the later segments are
    not made. `fps` are frames a second, by default 25 of the built-in scene and 30 of a sequence.
    """
    if name not in NAMES:
        raise InputError(f"{name}: there is no such scene; give one of {' '.join(NAMES)}")
    if not 2 <= cameras <= 12:
        raise InputError(f"--cameras {cameras}: must be 2 to 12")
    rate: dict[str, Any] = {} if fps is None else {"fps": fps}
    if name == "demo":
        people = 4 if people is None else people
        if not 0 <= people <= 12:
            raise InputError(f"--people {people}: must be 0 to 12")
        return built_in_scene(seed, people=people, cameras=cameras, frames=max(60, frames), **rate)
    if split not in get_args(Split):
        raise InputError(f"--split {split}: must be {' or '.join(get_args(Split))}")
    if people is not None:
        raise InputError(
            f"--people {people}: {name} has {SEQUENCES[name].people} people; leave it out, or take demo"
        )
    until = frames if frames > 0 else None
    motions = Mocap.load(_motions(mocap))
    return sequence(name, split, motions, cameras=cameras, until=until, config=config, **rate)  # type: ignore[arg-type]


def cut(scene: Scene, span: range) -> Scene:
    """Some consecutive frames of `scene`."""
    part = scene.motion[span.start : span.stop]
    if not isinstance(scene, Sequence):
        return replace(scene, motion=part)
    # Segments that reach into the span, each from its cut (the first from frame 0) to the next.
    segments = zip((0, *scene.cuts), (*scene.cuts, len(scene)), scene.clips, strict=False)
    clips = tuple(names for start, stop, names in segments if start < span.stop and stop > span.start)
    cuts = tuple(first - span.start for first in scene.cuts if span.start < first < span.stop)
    return replace(scene, motion=part, cuts=cuts, clips=clips)


def cuts_of(scene: Scene) -> tuple[int, ...]:
    """First frames of what follows a cut in `scene`; a built-in scene has none."""
    return scene.cuts if isinstance(scene, Sequence) else ()


def check_output(scene: Scene, folder: Path, format: Format) -> None:
    """InputError where `write_simulated` could not write into `folder`: before the work, not after."""
    if format == "openpose":
        refuse_leftovers(scene.rig, folder / _OPENPOSE)


def write_simulated(
    scene: Scene, detections: DetectionSequence, folder: Path, format: Format, **run: Any
) -> dict[str, Path]:
    """Write cameras, detections and truth of a simulated recording into `folder`; returns what is where.

    `rig.json`; `calibration.json` and `detection/<camera>.txt`, or `openpose/<camera>/`; and `truth/people.npz`,
    apart so that a reconstruction that is saved into the same folder does not take its place. `run` goes into
    `truth/run.json`, with the frames a second and the cuts: first frames of what follows one.
    """
    write_rig(scene.rig, folder / "rig.json")
    if format == "association":
        write_association(detections, scene.rig, folder)
        place = folder / "detection"
    else:
        place = folder / _OPENPOSE
        write_openpose(detections, scene.rig, place)
    about = {"fps": scene.fps, "frames": len(scene), "people": scene.people, "cameras": len(scene.rig)}
    about |= {"cuts": list(cuts_of(scene)), **run}
    truth_of(scene).with_run(simulated=about, versions=versions()).save(folder / "truth")
    return {"cameras": folder / "rig.json", "detections": place, "truth": folder / "truth" / "people.npz"}


def _motions(path: Path | None) -> Path:
    """The file of recorded motions, if it is where it is said or usually is."""
    if path is not None:
        return path
    path = Path(os.environ.get("SHAPEPOSE_DATA", Path("..") / "shared")) / _MOCAP
    if not path.is_file():
        raise InputError(
            f"{path}: the recorded motions are not here; give their file with --mocap, set SHAPEPOSE_DATA to the"
            " folder that holds data/cmu_mocap, or simulate demo, which needs none"
        )
    return path
