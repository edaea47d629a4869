"""The command line: reconstruct a recording, evaluate a reconstruction, see a demo."""

import json
import os
import re
import sys
import time
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from shapepose_fg.cli.batch.command import batch
from shapepose_fg.cli.detect import detect
from shapepose_fg.cli.export import export
from shapepose_fg.cli.options import FramesOption, check_workers, frame_range
from shapepose_fg.cli.overlay import overlay
from shapepose_fg.cli.reconstruct.command import reconstruct
from shapepose_fg.cli.report import report as report_command
from shapepose_fg.cli.setup import check_calibration
from shapepose_fg.cli.stopping import Stopped, stoppable
from shapepose_fg.cli.terminal import progress as progress_bar
from shapepose_fg.cli.terminal import show, use_any_streams
from shapepose_fg.cli.tracks import tracks
from shapepose_fg.cli.view import view
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.output_folder import prepare_output

if TYPE_CHECKING:
    from shapepose_fg.simulation.files import Format

# Everything else is imported inside the commands: `--help` must not wait for torch.

app = typer.Typer(
    name="shapepose-fg",
    help="Every person in the room in 3D, with a body, from several calibrated cameras.",
    add_completion=False,
    pretty_exceptions_enable=False,
)
evaluate = typer.Typer(help="Score a reconstruction against an annotation.")
app.add_typer(evaluate, name="evaluate")
app.add_typer(tracks, name="tracks")
app.command()(reconstruct)
app.command()(batch)
app.command()(detect)
app.command("check-calibration")(check_calibration)
app.command()(overlay)
app.command()(export)
app.command("report")(report_command)
app.command()(view)

_UsageProblem = cast("type[Exception]", typer.BadParameter.__mro__[2])
"""What typer raises for a wrong command line; older and newer versions keep the class in different places."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line. An error is one sentence on stderr and exit code 2."""
    use_any_streams()
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with stoppable():
            code = app(arguments or ["--help"], standalone_mode=False)
            sys.stdout.flush()
    except _UsageProblem as error:
        code = _fail(f"{cast(Any, error).format_message().rstrip('.')}; see shapepose-fg --help")
    except InputError as error:
        code = _fail(str(error))
    except BrokenPipeError:  # the reader of our output, such as `head`, has had enough
        # Or Python would complain at exit that it cannot flush.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    except OSError as error:
        place = f"{error.filename}: " if error.filename is not None else ""
        code = _fail(f"{place}{error.strerror or error}; check the path, its permissions and the space left")
    except Stopped as stop:
        _say("stopped", stop.message or "nothing is left half written", "bold yellow")
        code = stop.exit_code
    except (typer.Abort, KeyboardInterrupt):
        code = 130
    sys.exit(code if isinstance(code, int) else 0)


@evaluate.command("shelf")
def evaluate_shelf_command(
    people: Annotated[
        Path, typer.Option(help="people.npz, or its folder; 4D Association's text; TRC, or a folder of it.")
    ],
    ground_truth: Annotated[Path, typer.Option(help="Annotation of the Shelf recording, as text.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """PCP per limb and actor, MPJPE and recall on the Shelf recording."""
    from shapepose_fg.evaluation.other_results.reading import read_people
    from shapepose_fg.evaluation.shelf import evaluate_shelf, read_shelf_ground_truth

    score = evaluate_shelf(read_people(people), read_shelf_ground_truth(ground_truth))
    if as_json:
        print(json.dumps(score.as_dict(), indent=2, allow_nan=False))
    else:
        show(score.table())


_DEMO = """\
Built-in scene: 4 people in close motion, 6 cameras, 60 frames. A simulated
detector sees them with noise, misses, false candidates and occlusion; from what
it saw the people are reconstructed, over time."""


@app.command()
def demo(
    output: Annotated[Path, typer.Option(help="Folder for the result and the picture.")] = Path("demo"),
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="Leave report.html, the result as a page to look at.")
    ] = True,
) -> None:
    """Reconstruct a built-in scene of four people, compare it with the truth, and draw it."""
    prepare_output(output)
    print(_DEMO, flush=True)
    from shapepose_fg.cli.demo import run_demo

    with progress_bar("reconstructing") as progress:
        result = run_demo(progress)
    show(result.tables())
    print()
    for line in result.save(output, report=report):
        print(line)


@app.command()
def simulate(
    name: Annotated[str, typer.Argument(help="demo, or an interaction sequence: salsa, crossing or crowd.")],
    output: Annotated[Path, typer.Option(help="Folder for cameras, detections and truth.")],
    split: Annotated[str, typer.Option(help="Takes of a sequence: tune, to choose settings by; report.")] = "tune",
    frames: FramesOption = None,
    cameras: Annotated[int, typer.Option(help="Cameras around the room, 2 to 12.")] = 6,
    people: Annotated[int | None, typer.Option(help="People in demo, 0 to 12; a sequence has its own.")] = None,
    seed: Annotated[int, typer.Option(help="Fixes the detector's errors, and the people of demo.")] = 0,
    mocap: Annotated[Path | None, typer.Option(help="Recorded motions (.npz) that sequences are made of.")] = None,
    format: Annotated[str, typer.Option(help="Detections as association (4D Association) or openpose.")] = (
        "association"
    ),
    workers: Annotated[
        int | None, typer.Option(help="Processes that look at the frames; by default one a core. No byte changes.")
    ] = None,
) -> None:
    """Simulate a recording with known truth: cameras, 2D detections, and people.npz to compare with."""
    if format not in ("association", "openpose"):
        raise InputError(f"--format {format}: must be association or openpose")
    if seed < 0:
        raise InputError(f"--seed {seed}: must be 0 or more")
    check_workers(workers)
    prepare_output(output)
    from shapepose_fg.pipeline.workers import suitable_workers
    from shapepose_fg.simulation import DetectorConfig
    from shapepose_fg.simulation import simulate as run_detector
    from shapepose_fg.simulation.files import check_output, cut, cuts_of, named_scene, write_simulated
    from shapepose_fg.simulation.visibility import FRAMES_WORTH_A_WORKER

    last = re.search(r":\s*(\d{1,6})\s*$", frames or "")
    scene = named_scene(
        name,
        split=split,
        cameras=cameras,
        people=people,
        frames=int(last[1]) if last is not None else 0,
        seed=seed,
        mocap=mocap,
    )
    span = frame_range(frames, len(scene))
    part = cut(scene, span)
    check_output(part, output, cast("Format", format))
    workers = suitable_workers(len(span), FRAMES_WORTH_A_WORKER) if workers is None else workers
    start = time.perf_counter()
    with progress_bar("simulating") as progress:
        detections = run_detector(part, DetectorConfig(), seed, workers=workers, progress=progress)
    seconds = time.perf_counter() - start
    about = {"name": name, "seed": seed, "first_frame": span.start, "detector": DetectorConfig().as_dict()}
    about |= {} if name == "demo" else {"split": split}
    written = write_simulated(part, detections, output, cast("Format", format), **about)
    print(
        f"{len(span)} frames of {scene.people} people before {cameras} cameras,"
        f" {1e3 * seconds / len(span):.0f} ms a frame"
    )
    for what, path in written.items():
        print(f"{what:<12}{path}")
    timing = f"--fps {part.fps:g}" + (f" --cuts {','.join(map(str, cuts_of(part)))}" if cuts_of(part) else "")
    print(
        f"try: shapepose-fg reconstruct --calibration {written['cameras']} --detections {written['detections']}"
        f" {timing} --output {output / 'results'}"
    )


class Preset(StrEnum):
    """Settings that hang together."""

    DEFAULT = "default"
    PAPER = "paper"


@app.command("config")
def print_config(
    preset: Annotated[
        Preset,
        typer.Option(help="paper: the method as it is written, without what is settled differently here."),
    ] = Preset.DEFAULT,
) -> None:
    """Print every setting with its value, as TOML."""
    from shapepose_fg.io.config import toml_text
    from shapepose_fg.pipeline.pipeline import PipelineConfig

    print(toml_text(PipelineConfig.paper() if preset is Preset.PAPER else PipelineConfig()), end="")


@app.command()
def version() -> None:
    """Print the versions of this program and of what it stands on."""
    from shapepose_fg.core.provenance import versions

    for name, number in versions().items():
        print(name, number)


def _fail(message: str) -> int:
    """Say what went wrong, in one line on stderr."""
    _say("error", message, "bold red")
    return 2


def _say(what: str, message: str, style: str) -> None:
    from rich.console import Console
    from rich.text import Text

    line = Text.assemble((f"{what}: ", style), " ".join(message.split()))
    Console(stderr=True).print(line, soft_wrap=True)


if __name__ == "__main__":
    main()
