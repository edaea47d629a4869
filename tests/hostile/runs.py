"""Runs, finished and not, whose files are to be changed (`readers.py`)."""

import json
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache
from hashlib import sha256
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open

from shapepose_fg.body.fitting.fitter import BodyFitter
from shapepose_fg.body.fitting.fitters import make_fitter
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.shapes import recognise
from shapepose_fg.core.errors import InputError, naming
from shapepose_fg.core.notes import Notebook
from shapepose_fg.core.reconstruction import Reconstruction, Status
from shapepose_fg.core.repeated_pictures import WithoutRepeats
from shapepose_fg.core.shapes import SubjectShapes
from shapepose_fg.core.skeleton import COCO_17
from shapepose_fg.core.storage.kept_arrays import ANEW, InFolder
from shapepose_fg.estimation.detector_offsets import OffsetConfig
from shapepose_fg.io.calibration import write_rig
from shapepose_fg.io.detection_table import DetectionTable
from shapepose_fg.io.detections import read_detections
from shapepose_fg.io.export.registry import FORMATS, export_result
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.pipeline.execution import Execution
from shapepose_fg.pipeline.offsets import Sample, kept_offsets
from shapepose_fg.pipeline.pipeline import Task, reconstruct_parts
from shapepose_fg.pipeline.runs import manifest
from shapepose_fg.pipeline.runs.assembly import Assembly
from shapepose_fg.pipeline.runs.manifest import open_run
from shapepose_fg.pipeline.runs.parts import Parts
from shapepose_fg.pipeline.setup import Setup
from shapepose_fg.pipeline.solved_windows import SolvedWindows
from shapepose_fg.pipeline.windows import WindowConfig
from shapepose_fg.proposal.thinning import ThinnedFrames
from shapepose_fg.results.corrections import CORRECTIONS, correct, read_corrections, take_back
from shapepose_fg.results.edits import Action, Edit
from shapepose_fg.simulation import built_in_scene, simulate
from shapepose_fg.tracking import identities
from shapepose_fg.tracking.identities import FollowingConfig
from tests.core import test_reconstruction as results
from tests.estimation.test_windows import NobodyFitter
from tests.hostile.trying import Prepare, only_in
from tests.io import test_people_formats as people

CONFIG = PipelineConfig(
    batch_frames=6,
    following=FollowingConfig(look_ahead_s=0.15),
    windows=WindowConfig(overlap_s=0.1),
    offsets=OffsetConfig(frames=4),
)
"""Windows of so few frames that a run of a second has several."""
BEGUN = {"frames": [0, 24], "inputs": {}}
"""What the manifest says."""


class Ended(BaseException):
    """A run is stopped from outside."""


class Stopping(InFolder):
    """Parts in a folder; the run is stopped behind so many writes."""

    writes = 6

    def keep(self, name, arrays, about=None) -> None:
        super().keep(name, arrays, about)
        self.writes -= 1
        if self.writes == 0:
            raise Ended


@contextmanager
def short_blocks() -> Iterator[None]:
    """So that following stands between two windows in the middle of a stretch, too."""
    before, identities.BLOCK_S = identities.BLOCK_S, 0.2
    try:
        yield
    finally:
        identities.BLOCK_S = before


@cache
def task(seed: int = 1, frames: int = 24, people: int = 2, *, bodies: bool = True) -> Task:
    """People before three cameras, for less than a second; without `bodies` it is soon done."""
    scene = built_in_scene(seed=seed, people=people, cameras=3, frames=frames)
    recording = simulate(scene, seed=seed)
    fitter: BodyFitter = NobodyFitter()
    if bodies:
        model = BodyModel.default().with_keypoints(recording.skeleton.joints)
        fitter = make_fitter(CONFIG.body, model)
    return Task(recording, scene.rig, CONFIG, fitter=fitter)


@cache
def _files(
    seed: int, writes: int, chunk_frames: int | None, *, bodies: bool
) -> tuple[Task, dict[str, bytes]]:
    """A run, and its parts when it had written so many times."""
    made = task(seed, 12 if bodies else 24, 1 if bodies else 2, bodies=bodies)
    with tempfile.TemporaryDirectory() as name, short_blocks():
        out, how = Path(name), Execution(chunk_frames=chunk_frames)
        open_run(out, BEGUN)
        kept = Stopping(out / "parts", open_run(out, BEGUN, resume=True).run)
        kept.writes = writes
        with suppress(Ended):
            reconstruct_parts(kept, made, how)
        return made, {file.name: file.read_bytes() for file in (out / "parts").iterdir()}


def unfinished(writes: int, *, bodies: bool = False, chunk_frames: int | None = None) -> Prepare:
    """A run that was stopped behind so many writes and goes on, for a window or to its end.

    The digests of a changed file are made right before that, as by somebody who knows how: the
    result can be read.
    """

    def prepare(folder: Path, seed: int) -> Callable[[], object]:
        own, parts = _files(1 + seed % 2, writes, chunk_frames, bodies=bodies)
        for name, content in parts.items():
            (folder / name).write_bytes(content)

        def read() -> None:
            with in_a_copy(folder, "parts") as out:
                kept = open_run(out, BEGUN, resume=True)
                seal(kept, parts)
                kept = Stopping(kept.folder, kept.run)
                kept.writes = 1
                # As the command does it.
                with naming(kept.folder, ANEW), short_blocks(), suppress(Ended):
                    reconstruct_parts(kept, own, Execution(chunk_frames=chunk_frames)).save(out)
                    check_result(Reconstruction.load(out))

        return read

    return prepare


def parts_of(
    writes: int, *, sealed: bool, bodies: bool = False, chunk_frames: int | None = None
) -> Prepare:
    """What `reconstruct` reads of such a run before it goes on; as it was written, but where it is
    `sealed`.
    """

    def prepare(folder: Path, seed: int) -> Callable[[], object]:
        own, valid = _files(1 + seed % 2, writes, chunk_frames, bodies=bodies)
        (folder / "parts").mkdir()
        for name, content in valid.items():
            (folder / "parts" / name).write_bytes(content)
        joints, (frames, times, cuts) = own.detections.skeleton.joints, own.whole()
        assert own.fitter is not None
        setup = Setup(own.rig, own.detections.skeleton, own.config, own.fitter)
        pictures = WithoutRepeats(own.detections, len(own.rig))
        detections = ThinnedFrames(pictures, own.rig, own.config.candidates)
        windows = SolvedWindows(
            setup, detections, pictures, times, frames, cuts, np.arange(len(times)), Notebook()
        )
        nobody = setup.engine(Notebook()).tracker.nobody()

        def result() -> Reconstruction:
            kept = open_run(folder, BEGUN, resume=True)
            if sealed:
                seal(kept, valid)
            parts = Parts(kept)
            parts.check(joints, own.rig.names, frames, times.frame_s)
            parts.checkpoint(windows.read, frames, nobody, setup.skeleton)
            if "bodies-000000.safetensors" in valid:
                kept_offsets(kept, Sample(setup, detections, times), Notebook())
            return Assembly(parts, joints, own.rig.names).reconstruction()

        expected = result()

        def read() -> None:
            found = result()
            check_result(found)
            for name in () if sealed else ("joints", "transl"):
                if not np.array_equal(
                    getattr(found, name), getattr(expected, name), equal_nan=True
                ):
                    raise AssertionError(f"{name} are others than were written")

        return read

    return prepare


def check_result(people: Reconstruction) -> None:
    """AssertionError where a row that is well has no number."""
    if np.isnan(people.joints[people.status == Status.OK]).all(axis=(1, 2)).any():
        raise AssertionError("rows that are well without a number")


def seal(kept: InFolder, valid: dict[str, bytes]) -> None:
    """Give changed sets, if they can be read, the digests that they would have, had the run written
    them.
    """
    for name, content in valid.items():
        file = kept.folder / name
        if file.suffix != ".safetensors" or file.read_bytes() == content:
            continue
        try:
            with safe_open(file, framework="numpy") as opened:
                arrays = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
                about = json.loads(opened.metadata()["about"])
            kept.keep(file.stem, arrays, about)
        except (OSError, SafetensorError, KeyError, TypeError, ValueError, RecursionError):
            continue


def known_people(folder: Path, seed: int) -> Callable[[], object]:
    """Who was known when a run began, and what it wrote of them."""
    subjects = shapes(seed)
    subjects.save(folder / "shapes.npz")
    kept = manifest.open_run(folder, BEGUN)
    manifest.people_at_start(kept, folder / "shapes.npz", lambda: subjects)
    manifest.write_people(kept, folder / "shapes.npz", subjects)
    valid = {file.name: file.read_bytes() for file in kept.folder.iterdir()}

    def read() -> None:
        with in_a_copy(folder) as out:
            file = out / "shapes.npz"
            again = manifest.open_run(out, BEGUN, resume=True)
            with suppress(InputError):  # as a copy that was damaged
                manifest.people_at_start(again, file, lambda: SubjectShapes.load(file, "body"))
            # As by somebody who knows how: with the digests of what is there now.
            seal(again, valid)
            if isinstance(about := again.about("known-people"), dict):
                arrays = {
                    name: again.array("known-people", name) for name in again.keys("known-people")
                }
                again.keep(
                    "known-people",
                    arrays,
                    about | {"sha256": sha256(file.read_bytes()).hexdigest()},
                )
            known = manifest.people_at_start(again, file, lambda: SubjectShapes.load(file, "body"))
            before = SubjectShapes.load(file, "body")
            with naming(again.folder, ANEW):  # as the command does where a run goes on
                recognise(subjects, known)
            if not np.isfinite(known.covariance).all():
                raise AssertionError("shapes that are no numbers")
            manifest.write_people(again, file, before.updated(known))
            SubjectShapes.load(file, "body")

    return read


def corrected(folder: Path, seed: int) -> Callable[[], object]:
    """A result that was corrected twice; changed, its corrections are those of what is there
    now.
    """
    people = results.people([0, 0, 1, 1, 2, 3], seed)
    replace(people, person=np.array([0, 1, 0, 1, 0, 1])).save(folder)
    correct(folder, Edit(Action.SPLIT, 1, 7, frame=3))
    correct(folder, Edit(Action.SWAP, 0, 1, frame=1))
    for file in folder.rglob("*.npz"):
        unpack(file)

    def read() -> None:
        with in_a_copy(folder) as out:
            file = out / CORRECTIONS
            digest = sha256((out / "people.npz").read_bytes()).hexdigest()
            file.write_bytes(
                re.sub(rb'"[0-9a-f]{64}"', b'"%s"' % digest.encode(), file.read_bytes())
            )
            for _ in read_corrections(out):
                take_back(out)
            correct(out, Edit(Action.DROP, 0))

    return read


def shapes(seed: int) -> SubjectShapes:
    """Two people's."""
    betas, information = (
        np.random.default_rng(seed).normal(size=(2, 10)),
        np.tile(np.eye(10), (2, 1, 1)),
    )
    return SubjectShapes(np.array(["a", "b"]), betas, information, "body")


def detections_kept(folder: Path, seed: int) -> Callable[[], object]:
    """What the cameras saw, as `reconstruct` keeps it while it runs: as it was, or a sentence."""
    rig = people.two_cameras("left", "right")
    with tempfile.TemporaryDirectory() as name:
        people.WRITERS["COCO"](Path(name), people.people_of(COCO_17))
        recording = read_detections(Path(name), rig, None, InFolder(folder))
    expected = [recording[frame].xy for frame in range(len(recording))]

    def read() -> None:
        table = DetectionTable(recording.skeleton, InFolder(folder), len(recording))
        if not all(np.array_equal(table[frame].xy, each) for frame, each in enumerate(expected)):
            raise AssertionError("other detections than were kept")

    return read


def finished(use: Callable[[Path], object]) -> Prepare:
    """A result with all of its files, of which `use` is made in a copy."""

    def prepare(folder: Path, seed: int) -> Callable[[], object]:
        with short_blocks(), tempfile.TemporaryDirectory() as name:
            run = replace(task(1 + seed % 2), frames=range(2))
            reconstruct_parts(InFolder(Path(name)), run).save(folder)
        write_rig(run.rig, folder / "cameras.json")
        for file in folder.glob("*.npz"):
            unpack(file)

        def read() -> None:
            with in_a_copy(folder) as out:
                use(out)

        return read

    return prepare


def unpack(file: Path) -> None:
    """Save an archive without compression, so that changed bytes are changed numbers."""
    with np.load(file) as archive:
        columns = dict(archive)
    np.savez(file, **columns)


def exported(name: str) -> Callable[[Path], None]:
    """The use of a result that exports it in a format; no number of the files may be none."""

    def use(folder: Path) -> None:
        export_result(folder, [FORMATS[name]], folder / "export")
        for file in (folder / "export").iterdir():
            check_numbers(file)

    return use


def check_numbers(file: Path) -> None:
    """AssertionError where a file for other programs holds NaN or an infinity."""
    match file.suffix:
        case ".csv" | ".bvh" | ".trc":
            found = any(word in file.read_bytes().lower() for word in (b"nan", b"inf"))
        case ".npz":
            with np.load(file) as archive:
                found = any(
                    each.dtype.kind == "f" and not np.isfinite(each).all()
                    for each in archive.values()
                )
        case ".c3d":
            content = file.read_bytes()
            first = 512 * (int.from_bytes(content[16:18], "little") - 1)
            found = not np.isfinite(
                np.frombuffer(content[first : len(content) // 4 * 4], "<f4")
            ).all()
        case ".glb":
            content = file.read_bytes()
            length = int.from_bytes(content[12:16], "little")
            said, data = json.loads(content[20 : 20 + length]), content[28 + length :]
            found = False
            for each in (each for each in said["accessors"] if each["componentType"] == 5126):
                view = said["bufferViews"][each["bufferView"]]
                start = view.get("byteOffset", 0)
                found |= not np.isfinite(
                    np.frombuffer(data[start : start + view["byteLength"]], "<f4")
                ).all()
        case _:
            return
    if found:
        raise AssertionError(f"{file.name} holds numbers that are none")


@contextmanager
def in_a_copy(folder: Path, name: str = "") -> Iterator[Path]:
    """A folder into which that one is copied (as `name`), and beside which nothing may be
    written.
    """
    with tempfile.TemporaryDirectory() as beside:
        out = Path(beside) / "out"
        shutil.copytree(folder, out / name)
        before, tempfile.tempdir = tempfile.tempdir, str(Path(beside) / "temporary")
        Path(tempfile.tempdir).mkdir()
        try:
            with only_in(out, tempfile.tempdir):
                yield out
        finally:
            tempfile.tempdir = before
