"""The command `demo`: reconstructs the built-in scene and compares the result with the truth."""

from pathlib import Path

from shapepose_fg.cli.evaluate import show_scores
from shapepose_fg.cli.options import RESULT, grouped, option
from shapepose_fg.cli.terminal import progress as progress_bar
from shapepose_fg.core.storage.output_folder import prepare_output

SCENE = """\
Built-in scene: 4 people in close motion, 6 cameras, 60 frames. The people are
reconstructed from 2D detections that are simulated with noise, misses, false
candidates and occlusion, and compared with the truth."""
_FILES = {
    "people.npz": "joints, covariances and bodies",
    "run.json": "settings and times",
    "observations.npz": "detections assigned to each joint",
    "cameras.json": "the cameras",
}


@grouped
def demo(
    output: Path = option(RESULT, "Folder for the result.", Path("demo")),
    report: bool = option(
        RESULT, "Write report.html, a page for the browser.", True, "--report/--no-report"
    ),
) -> None:
    """Reconstruct a built-in scene of four people and compare it with the truth."""
    prepare_output(output)
    print(SCENE, flush=True)
    from shapepose_fg.core.frame_times import FrameTimes
    from shapepose_fg.evaluation.score import score
    from shapepose_fg.evaluation.truth import people_of
    from shapepose_fg.pipeline.execution import Execution
    from shapepose_fg.pipeline.pipeline import reconstruct
    from shapepose_fg.simulation import built_in_scene, simulate
    from shapepose_fg.simulation.files import truth_of
    from shapepose_fg.viz.report.writing import REPORT, write_report

    scene = built_in_scene()
    detections, times = simulate(scene), FrameTimes.from_fps(scene.fps, len(scene))
    with progress_bar("reconstructing") as progress:
        execution = Execution(progress=progress)
        people = reconstruct(detections, scene.rig, times=times, execution=execution)
    show_scores({"demo": score(people_of(people), people_of(truth_of(scene)))})
    people.save(output)
    files = {output / name: content for name, content in _FILES.items()}
    if report:
        files[write_report(output, people, scene.rig)] = "open it in a browser"
    else:
        (output / REPORT).unlink(missing_ok=True)
    width = max(len(str(file)) for file in files)
    print("", *(f"{file!s:<{width}}  {content}" for file, content in files.items()), sep="\n")
