"""The command `simulate`: writes a simulated recording with known truth."""

import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Interval

from shapepose_fg.cli.options import (
    INPUT,
    REQUIRED,
    RESULT,
    Workers,
    argument,
    frame_range,
    frames_option,
    grouped,
    next_reconstruct,
    option,
    workers_option,
)
from shapepose_fg.cli.terminal import progress as progress_bar
from shapepose_fg.core.storage.output_folder import prepare_output


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """Options of the simulated scene."""

    name: str = argument(
        "NAME", "Scene: demo, or an interaction sequence (salsa, crossing or crowd)."
    )
    split: str = option(
        INPUT, "Part of a sequence: tune (for choosing settings) or report (for results).", "tune"
    )
    cameras: int = option(INPUT, "Number of cameras around the room, 2 to 12.", 6)
    people: int | None = option(INPUT, "Number of people in demo, 0 to 12.")
    seed: Annotated[int, Interval(ge=0, le=2**32 - 1)] = option(
        INPUT, "Random seed of the detector's errors, and of the people of demo.", 0
    )
    mocap: Path | None = option(INPUT, "File of the recorded motions (.npz) for the sequences.")


@grouped
def simulate(
    scene: SceneOptions,
    output: Path = option(RESULT, "Folder for cameras, detections and truth.", REQUIRED),
    frames: str | None = frames_option(),
    format: Literal["association", "openpose"] = option(
        RESULT, "Format of the detections: association (4D Association) or openpose.", "association"
    ),
    workers: Workers | None = workers_option(),
) -> None:
    """Simulate a recording with known truth: cameras, 2D detections, and the true people as
    people.npz.
    """
    prepare_output(output)
    from shapepose_fg.pipeline.workers import suitable_workers
    from shapepose_fg.simulation import DetectorConfig
    from shapepose_fg.simulation import simulate as run_detector
    from shapepose_fg.simulation.files import check_output, named_scene, write_simulated
    from shapepose_fg.simulation.visibility import FRAMES_A_WORKER

    last = re.search(r":\s*(\d{1,6})\s*$", frames or "")
    made = named_scene(
        scene.name,
        split=scene.split,
        cameras=scene.cameras,
        people=scene.people,
        frames=int(last[1]) if last is not None else 0,
        seed=scene.seed,
        mocap=scene.mocap,
    )
    span = frame_range(frames, len(made))
    part = made.part(span)
    check_output(part, output, format)
    workers = suitable_workers(len(span), FRAMES_A_WORKER) if workers is None else workers
    start = time.perf_counter()
    with progress_bar("simulating") as progress:
        detections = run_detector(
            part, DetectorConfig(), scene.seed, workers=workers, progress=progress
        )
    seconds = time.perf_counter() - start
    about = {"name": scene.name, "seed": scene.seed, "first_frame": span.start}
    about |= {"detector": DetectorConfig().as_dict()} | (
        {} if scene.name == "demo" else {"split": scene.split}
    )
    written = write_simulated(part, detections, output, format, **about)
    print(
        f"{len(span)} frames of {made.people} people, {scene.cameras} cameras,"
        f" {1e3 * seconds / len(span):.0f} ms a frame"
    )
    for what, path in written.items():
        print(f"{what:<12}{path}")
    options = {
        "--calibration": written["cameras"],
        "--detections": written["detections"],
        "--fps": float(part.fps),
        "--cuts": ",".join(map(str, part.cuts)) or None,
        "--output": output / "results",
    }
    print(next_reconstruct(options))
