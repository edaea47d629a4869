"""README.md, docs/using.md and docs/extending.md, typed as a reader would type them; and links that
lead on.
"""

import pickle
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer

from factors import MOTIONS
from shapepose_fg import reconstruct
from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.cli.main import app, main
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections, Recording
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.core.trajectory import Trajectory
from shapepose_fg.evaluation.metrics import joint_metrics
from shapepose_fg.io.calibration import write_rig
from shapepose_fg.io.config import toml_text
from shapepose_fg.io.export.registry import chosen, export_result
from shapepose_fg.pipeline.pipeline import PipelineConfig
from shapepose_fg.simulation import Scene, built_in_scene, simulate
from shapepose_fg.simulation.files import truth_of

ROOT = Path(__file__).parents[2]
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(page: Path, language: str) -> list[str]:
    """The code of one language on a page."""
    return re.findall(
        rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL
    )


def commands_in(block: str) -> list[str]:
    """The program's commands in a shell block, without comments and redirections."""
    lines = re.sub(r"\\\n\s*", " ", block).splitlines()
    found = [re.sub(r"\s+(#|[<>|&;]).*", "", line) for line in lines]
    return [line for line in found if line.startswith("shapepose-fg")]


def simulating(page: Path) -> list[str]:
    """The shell blocks of a page that need no files, as they begin with a simulated recording."""
    return [
        block
        for block in blocks(page, "bash")
        if "".join(commands_in(block)[:1]).startswith("shapepose-fg simulate")
    ]


def run(*pages: Path, names: dict | None = None) -> dict:
    """Run all Python of the pages, one block after the other; returns the names that it leaves,
    beside the given ones.
    """
    names = {} if names is None else names
    for page in pages:
        for block in blocks(page, "python"):
            exec(compile(block, str(page), "exec"), names)
    return names


def association_text(recording: Recording, view: int, image_size: tuple[int, int]) -> str:
    """What one view saw, in 4D Association's text format."""
    last = np.array(image_size) - 1.0
    lines = [f"4 {len(recording)}"]
    for frame in recording:
        rows = [
            np.flatnonzero((frame.view == view) & (frame.joint == joint)) for joint in range(25)
        ]
        for row in rows:
            columns = (*(frame.xy[row] / last).T, frame.confidence[row])
            lines.append(
                " ".join(
                    [str(len(row)), *(f"{value:.6f}" for column in columns for value in column)]
                )
            )
        lines += [matrix_text(frame, rows[first], rows[second]) for first, second in BODY_25.limbs]
    return "\n".join(lines) + "\n"


def matrix_text(frame: Detections, first: np.ndarray, second: np.ndarray) -> str:
    """The affinities between the candidates `first` and `second`, row by row."""
    matrix = np.zeros((len(frame), len(frame)))
    matrix[tuple(frame.pairs.T)] = frame.affinity
    return " ".join(f"{value:.4f}" for value in matrix[np.ix_(first, second)].ravel())


@pytest.fixture(scope="module")
def six_frames(tmp_path_factory) -> tuple[Scene, Path]:
    """Six frames of the scene, and their reader's folder."""
    scene, folder = built_in_scene(frames=6), tmp_path_factory.mktemp("reader")
    a_reader_s_folder(scene, folder)
    return scene, folder


@pytest.fixture
def recording(six_frames, tmp_path, monkeypatch) -> Scene:
    """The working directory is a copy of the reader's folder with six frames of the scene."""
    scene, folder = six_frames
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return scene


def a_reader_s_folder(scene: Scene, folder: Path) -> None:
    """Write calibration.json, detections/ and settings.toml into a folder."""
    (folder / "settings.toml").write_text(toml_text(PipelineConfig()))
    seen = simulate(scene)
    write_rig(scene.rig, folder / "calibration.json")
    (folder / "detections").mkdir()
    for view, camera in enumerate(scene.rig.cameras):
        text = association_text(seen, view, camera.image_size)
        (folder / "detections" / f"{camera.name}.txt").write_text(text)


@pytest.mark.slow
def test_readme_and_using_in_python(recording, tmp_path):
    names = run(ROOT / "README.md", ROOT / "docs" / "using.md")
    saved = Reconstruction.load(tmp_path / "results")
    metrics = joint_metrics(saved, recording.keypoints)
    assert metrics.people_missed == metrics.false_positives == 0
    assert metrics.mpjpe_mm < 30
    # Four people in the first frame: each surface is that of one true person, to a few centimetres.
    assert names["vertices"].shape[0] == len(saved) == 24
    found, true = names["vertices"][:4], recording.vertices_at(0)
    apart = np.linalg.norm(found[:, None] - true[None], axis=-1).mean(axis=-1)
    assert sorted(apart.argmin(axis=1).tolist()) == [0, 1, 2, 3]
    assert apart.min(axis=1).max() < 0.05
    assert wrists_apart(names["people"]) < wrists_apart(saved) - 0.1
    assert np.unique(names["part"].frame).tolist() == [0, 1, 2, 3] and names["part"].run[
        "cuts"
    ] == [2]


def wrists_apart(people: Reconstruction) -> float:
    """Median over people of the distance between the wrists, metres."""
    ends = people.joints[:, [BODY_25.index("RWrist"), BODY_25.index("LWrist")]]
    return float(np.median(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)))


def moving(scene: Scene) -> dict:
    """The names of docs/moving_cameras.md: the first camera is on a carrier, which stands still."""
    first, *others = scene.rig.cameras
    time_s = np.arange(-0.5, 1.0, 0.1)
    poses = Trajectory("robot", time_s, np.tile(first.wTc, (len(time_s), 1, 1)))
    rig = Rig((replace(first, carrier="robot"), *others), scene.rig.up, trajectories=(poses,))
    times = FrameTimes.from_fps(scene.fps, len(scene))
    return {"detections": simulate(scene), "rig": rig, "times": times}


def measured(scene: Scene) -> dict:
    """The names of docs/body_fitting.md: four people in six frames, whose ears are hidden."""
    rows = {
        "xyz": scene.keypoints.reshape(-1, 25, 3),
        "person": np.tile(np.arange(4), len(scene)),
        "time_s": np.repeat(np.arange(len(scene)) / scene.fps, 4),
    }
    hidden = np.zeros(rows["xyz"].shape[:2], dtype=bool)
    hidden[:, 17:19] = True
    targets = JointTargets(rows["xyz"], np.tile(np.eye(3) / 0.02**2, (*hidden.shape, 1, 1)))
    again = {"targets": targets, "others": targets, "person_2": rows["person"]}
    return {**rows, "hidden": hidden, **again, "time_2_s": rows["time_s"]}


def two_pickled_cameras(scene: Scene) -> dict:
    """What docs/calibration_files.md reads: the pickles of two cameras."""
    for camera in scene.rig.cameras[:2]:
        cTw = np.linalg.inv(camera.wTc)
        values = {
            "rotation": cTw[:3, :3],
            "translation": 1000 * cTw[:3, 3:],
            "intrinsicMat": camera.K,
        }
        values |= {"imageSize": np.array([[720], [1280]]), "distortion": np.zeros((1, 5))}
        folder = Path("Videos", f"Cam{camera.name}")
        folder.mkdir(parents=True)
        (folder / "cameraIntrinsicsExtrinsics.pickle").write_bytes(pickle.dumps(values))
    return {}


def exported(scene: Scene) -> dict:
    """What docs/export.md reads: a Parquet table."""
    people = reconstruct(simulate(scene), scene.rig)
    people.save("results")
    export_result(Path("results"), chosen(["parquet"]), Path("results/export"))
    return {}


def known_truth(scene: Scene) -> dict:
    """What docs/evaluation/angles.md reads: a result, and its truth."""
    reconstruct(simulate(scene), scene.rig).save("results")
    truth_of(scene).save("truth")
    return {}


PREPARED = {
    "docs/body_fitting.md": measured,
    "docs/body_model.md": lambda scene: {"detections": simulate(scene), "rig": scene.rig},
    "docs/evaluation/angles.md": known_truth,
    "docs/calibration_files.md": two_pickled_cameras,
    "docs/conventions.md": lambda scene: {},
    "docs/export.md": exported,
    "docs/live.md": lambda scene: {},
    "docs/joints.md": lambda scene: {},
    "docs/moving_cameras.md": moving,
    "docs/results.md": known_truth,
    "docs/simulation.md": lambda scene: {},
}
"""Functions that prepare what the code of a page expects, and return names that it does not make,
by page."""
ELSEWHERE = {"README.md", "docs/using.md", "docs/extending.md", "docs/factors.md", "docs/ros.md"}
"""Pages whose code other tests run; that of ros.md needs an installation of ROS."""
GUIDES = [page for page in PAGES if page.parent.name == "guides"]


def test_the_code_of_every_page_is_run():
    with_code = {page.relative_to(ROOT).as_posix() for page in PAGES if blocks(page, "python")}
    guides = {page.relative_to(ROOT).as_posix() for page in GUIDES}
    assert with_code - guides == PREPARED.keys() | ELSEWHERE


@pytest.mark.slow
@pytest.mark.parametrize("page", PREPARED)
def test_the_python_of_a_page_runs(page, recording):
    if page == "docs/export.md":
        pytest.importorskip("pyarrow", reason="needs the extra archive")
    run(ROOT / page, names=PREPARED[page](recording))


@pytest.mark.slow
@pytest.mark.parametrize("page", GUIDES, ids=lambda page: page.name)
def test_a_guide_is_typed_in_an_empty_folder(page, tmp_path, monkeypatch, capsys):
    """In the order of the page: its Python, and the commands that need no files of the reader."""
    text = page.read_text(encoding="utf-8")
    if "to_frame(" in text:
        pytest.importorskip("pandas", reason="tables of results are pandas's")
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for language, block in re.findall(r"```(python|bash)\n(.*?)```", text, flags=re.DOTALL):
        if language == "python":
            exec(compile(block, str(page), "exec"), names)
        elif "simulated" in block:
            type_commands(block, capsys)


FRAMES = 16
"""Frames of recordings that pages simulate, here: all commands take them as they take more."""


def type_commands(block: str, capsys) -> None:
    """Run the program's commands in a shell block; each must end well."""
    for command in commands_in(
        re.sub(r"(shapepose-fg simulate .*--frames) :\d+", rf"\1 :{FRAMES}", block)
    ):
        with pytest.raises(SystemExit) as end:
            main(shlex.split(command)[1:])
        assert end.value.code in (0, None), f"{command}: {capsys.readouterr()}"


@pytest.mark.slow
@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if simulating(page) and page not in GUIDES],
    ids=lambda page: page.name,
)
def test_blocks_that_simulate_their_recording_run(page, tmp_path, monkeypatch, capsys):
    """Typed one after the other into an empty folder, each command ends well."""
    monkeypatch.chdir(tmp_path)
    for block in simulating(page):
        type_commands(block, capsys)


OF_THE_READER = ("...", "calibration.toml", "mcap", "--resume", "shelf", "theirs", "SMPL_NEUTRAL")
"""Words in commands that need more than the recording of a reader's folder, or an extra."""


@pytest.mark.slow
def test_commands_of_pages_run_in_a_reader_s_folder(tmp_path, monkeypatch, capsys):
    """The README's, then those of all other pages that need a recording, its result or its truth;
    those that reconstruct it in another way last.
    """
    monkeypatch.chdir(tmp_path)
    scene = built_in_scene(frames=20)
    a_reader_s_folder(scene, tmp_path)
    truth_of(scene).save("truth")
    known = ("reconstruct", "report", "explain", "tracks", "evaluate", "export")

    def commands(page: Path) -> list[str]:
        shell = [block for block in blocks(page, "bash") if block not in simulating(page)]
        return [
            command
            for command in commands_in("".join(shell))
            if command.split()[1] in known and not any(word in command for word in OF_THE_READER)
        ]

    readme = commands(ROOT / "README.md")
    assert [command.split()[1] for command in readme] == ["reconstruct", "export"]
    type_commands("\n".join(readme), capsys)
    found = joint_metrics(Reconstruction.load("results"), scene.keypoints)
    assert found.people_missed == found.false_positives == 0
    kinds = {path.suffix for path in Path("results", "export").iterdir()}
    assert kinds == {".npz", ".trc", ".c3d", ".bvh", ".glb", ".csv", ".parquet"}

    pages = [page for page in PAGES if page not in GUIDES and page != ROOT / "README.md"]
    others = dict.fromkeys(command for page in pages for command in commands(page))
    assert {command.split()[1] for command in others} == set(known)
    for command in sorted(others, key=lambda each: " reconstruct " in each):
        type_commands(command + " --overwrite" * (" reconstruct " in command), capsys)


def steps(result: Reconstruction, feet: np.ndarray) -> np.ndarray:
    """How far each joint of a foot moves from frame to frame, metres."""
    places = [result.joints[result.person == who][:, feet] for who in np.unique(result.person)]
    return np.linalg.norm(np.concatenate([np.diff(place, axis=0) for place in places]), axis=-1)


@pytest.mark.slow
def test_extending(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(MOTIONS, "damped", None)  # the page's own, which leaves with the test
    names = run(ROOT / "docs" / "extending.md")
    truth = names["scene"].keypoints
    # The factor: 40 cm with a sigma of 1 cm, against views with sigmas of a few centimetres.
    assert names["width"].shape == (24,)
    assert abs(np.median(names["width"]) - 0.40) < 0.03
    assert wrists_apart(names["people"]) > 0.6
    # Between two people.
    tied = [names["together"].rows(names["together"].person == who) for who in (0, 1)]
    ends = tied[0].joints[:, names["RIGHT"]], tied[1].joints[:, names["LEFT"]]
    assert abs(np.median(np.linalg.norm(ends[0] - ends[1], axis=1)) - 1.5) < 0.02
    assert names["together"].run["extra_factors"] == {"carry_a_board": {"made": 6, "inactive": 0}}
    # Over time: standing feet hardly move, and those that step are where they were.
    before = np.quantile(steps(names["loose"], names["FEET"]), [0.2, 0.9])
    for each, less in (("standing", 0.5), ("people", 0.8)):
        after = np.quantile(steps(names[each], names["FEET"]), [0.2, 0.9])
        assert after[0] < less * before[0] and after[1] > 0.8 * before[1]
        assert (
            joint_metrics(names[each], truth).mpjpe_mm
            < 1.05 * joint_metrics(names["loose"], truth).mpjpe_mm
        )
    # The model of motion: as near to the truth as the one that ships, and not the same.
    by_default, damped = (joint_metrics(names[each], truth) for each in ("people", "damped"))
    assert damped.people_missed == damped.false_positives == 0
    assert damped.mpjpe_mm < 1.1 * by_default.mpjpe_mm
    assert np.abs(names["damped"].velocity - names["people"].velocity).max() > 1e-3
    # The detector: perfect but for feet, which it does not have; the rest within its sigma of 2 cm.
    perfect = joint_metrics(names["from_perfect"], truth)
    assert perfect.people_missed == perfect.false_positives == 0
    from_coco = joint_metrics(
        [names["from_perfect"].at(t).joints[:, :19] for t in range(6)], truth[:, :, :19]
    )
    assert from_coco.mpjpe_mm < 5
    # The body: children are small, so betas strain towards tall.
    assert names["as_children"].betas[:, 0].mean() > names["people"].betas[:, 0].mean() + 3
    # The fitter: no bodies, but joints.
    assert np.isnan(names["views_alone"].betas).all()
    assert joint_metrics(names["views_alone"], truth).recall > 0.98
    # The skeleton.
    assert names["skeletons"].joints.shape == (24, 15, 3)
    assert joint_metrics(names["skeletons"], truth[:, :, :15]).recall > 0.98


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_on_a_page_is_one_that_the_program_takes(page):
    """Names of commands and options, required ones too, and values of the right kind."""
    group = typer.main.get_command(app)
    for command in (
        each
        for kind in ("bash", "sh")
        for block in blocks(page, kind)
        for each in commands_in(block)
    ):
        words = shlex.split(command)[1:]
        assert words[0] in group.commands, f"{command}: there is no such command"
        if "..." not in words:
            parse(group, words, command)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_options_of_commands_in_a_sentence_exist(page):
    """In a sentence a command may lack its other arguments, so only options are compared."""
    group = typer.main.get_command(app)
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for span in re.findall(r"`(?:shapepose-fg )?([^`]+)`", text):
        command = group.commands.get(span.split()[0])
        if command is not None and page.name != "CHANGELOG.md":
            given = set(re.findall(r"(?<=[ /])--[a-z][\w-]*", span))
            assert given <= options(command) | {"--help"}, span


def options(command) -> set[str]:
    """The options of a command and of the commands below it."""
    own = {each for given in command.params for each in (*given.opts, *given.secondary_opts)}
    return own.union(*map(options, getattr(command, "commands", {}).values()))


def parse(command, words: list[str], whole: str) -> None:
    """Parse the words of a command as the program does, without running it."""
    commands = getattr(command, "commands", {})
    at = next((at for at, word in enumerate(words) if word in commands), len(words))
    try:
        if not commands or at > 0:
            command.make_context(None, words[:at])
    except typer.Exit:  # of --help
        return
    except Exception as error:
        reason = error.format_message() if hasattr(error, "format_message") else error
        pytest.fail(f"{whole}: {reason}")
    if at < len(words):
        parse(commands[words[at]], words[at + 1 :], whole)


@pytest.mark.parametrize(
    "command",
    ["shapepose-fg recontruct", "shapepose-fg report", "shapepose-fg demo --outptu x"],
)
def test_a_command_that_the_program_does_not_take_is_noticed(command, tmp_path):
    (tmp_path / "page.md").write_text(f"```bash\n{command}  # so\n```\n")
    with pytest.raises((AssertionError, pytest.fail.Exception), match=command.split()[1]):
        test_every_command_on_a_page_is_one_that_the_program_takes(tmp_path / "page.md")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files_and_headings(page):
    links = re.findall(r"\]\(([^)#\s]*)#?([^)\s]*)\)", page.read_text(encoding="utf-8"))
    missing = []
    for target, heading in links:
        there = page.parent / target if target != "" else page
        if "://" not in target and (
            not there.exists() or (heading != "" and heading not in headings(there))
        ):
            missing.append(f"{target}#{heading}")
    assert missing == []


def headings(page: Path) -> list[str]:
    """The headings of a page, as GitHub's links name them."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    titles = re.findall(r"^#+ (.+)$", text, flags=re.MULTILINE)
    return [re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles]


GENERATED = "reference"
"""Folder of pages that are completed while the site is built."""


@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if page.parent != ROOT and page.parent.name != GENERATED],
    ids=lambda page: page.name,
)
def test_a_page_begins_with_what_it_is_for_and_an_example(page):
    """One title, and code, a table or a list among the first lines; nowhere a commit or the random
    seed of a measurement.
    """
    text = page.read_text(encoding="utf-8")
    outside = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    assert re.findall(r"^# (.+)$", outside, flags=re.MULTILINE) == [text.splitlines()[0][2:]]
    first = text.splitlines()[:20]
    assert any(line.startswith(("```", "| ", "- ", "1. ")) for line in first)
    assert re.findall(r"\b(?=[a-f]*\d)(?=\d*[a-f])[0-9a-f]{7,40}\b", outside) == []
    assert re.findall(r"\bseeds? \d+", outside) == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_that_are_named_exist(page):
    """Names in backticks such as `body/fitter.py` are the ends of paths in the repository."""
    named = set(
        re.findall(r"`((?:[\w.]+/)*\w+\.(?:py|md|toml))`", page.read_text(encoding="utf-8"))
    )
    folders = (ROOT / name for name in ("shapepose_fg", "factors", "scripts", "tests", "docs"))
    there = [f"/{path.relative_to(ROOT)}" for folder in folders for path in folder.rglob("*.*")]
    missing = {name for name in named if not any(path.endswith(f"/{name}") for path in there)}
    assert missing <= {"settings.toml"}
