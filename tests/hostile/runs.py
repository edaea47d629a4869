"""Runs, finished and not, whose files are to be changed: for `readers.py`, and for the kills of `scripts/fuzz.py`."""

import json
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open

from shapepose_fg.body.fitting.fitters import make_fitter
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.storage.kept_arrays import InFolder
from shapepose_fg.estimation.detector_offsets import OffsetConfig
from shapepose_fg.io.calibration import write_rig
from shapepose_fg.io.export.registry import FORMATS, export_result
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.pipeline.pipeline import Task, reconstruct_parts
from shapepose_fg.pipeline.runs.manifest import open_run
from shapepose_fg.pipeline.windows import WindowConfig
from shapepose_fg.simulation import built_in_scene, simulate
from shapepose_fg.tracking import following
from shapepose_fg.tracking.following import FollowingConfig

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

    writes = 5

    def keep(self, name, arrays, about=None) -> None:
        super().keep(name, arrays, about)
        self.writes -= 1
        if self.writes == 0:
            raise Ended


@contextmanager
def short_blocks() -> Iterator[None]:
    """So that following stands between two windows in the middle of a stretch, too."""
    before, following.BLOCK_S = following.BLOCK_S, 0.2
    try:
        yield
    finally:
        following.BLOCK_S = before


@cache
def task(seed: int = 1, frames: int = 24) -> Task:
    """Two people before three cameras, for less than a second."""
    scene = built_in_scene(seed=seed, people=2, cameras=3, frames=frames)
    recording = simulate(scene, seed=seed)
    fitter = make_fitter(CONFIG.body, BodyModel.default().with_keypoints(recording.skeleton.joints), CONFIG.law)
    return Task(recording, scene.rig, CONFIG, fitter=fitter)


@cache
def _files(seed: int, writes: int) -> tuple[dict[str, bytes], bytes]:
    """A run's parts when it had written so many times, and people.npz of the run that nobody stopped."""
    with tempfile.TemporaryDirectory() as name, short_blocks():
        out = Path(name)
        open_run(out, BEGUN)
        kept = Stopping(out / "parts", open_run(out, BEGUN, resume=True).run)
        kept.writes = writes
        result = None
        try:
            result = reconstruct_parts(kept, task(seed))
        except Ended:
            pass
        parts = {file.name: file.read_bytes() for file in (out / "parts").iterdir()}
        result = reconstruct_parts(InFolder(out / "parts", kept.run), task(seed)) if result is None else result
        result.save(out)
        return parts, (out / "people.npz").read_bytes()


def unfinished(writes: int, *, sealed: bool) -> Callable[[Path, int], Callable[[], object]]:
    """A run that was stopped behind so many writes and goes on: to the same bytes, or to a sentence.

    With `sealed` digests are made right before that, as by somebody who knows how: then the result can be read.
    """

    def prepare(folder: Path, seed: int) -> Callable[[], object]:
        seed = 1 + seed % 2
        parts, expected = _files(seed, writes)
        (folder / "parts").mkdir()
        for name, content in parts.items():
            (folder / "parts" / name).write_bytes(content)

        def read() -> None:
            with in_a_copy(folder) as out:
                kept = open_run(out, BEGUN, resume=True)
                if sealed:
                    seal(kept)
                with short_blocks():
                    reconstruct_parts(kept, task(seed)).save(out)
                Reconstruction.load(out)
                if not sealed and (out / "people.npz").read_bytes() != expected:
                    raise AssertionError("other bytes than without the change")

        return read

    return prepare


def seal(kept: InFolder) -> None:
    """Give what can be read of the parts the digests that it would have, had the run written it."""
    for file in kept.folder.glob("*.safetensors"):
        try:
            with safe_open(file, framework="numpy") as opened:
                arrays = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
                about = json.loads(opened.metadata()["about"])
            kept.keep(file.stem, arrays, about)
        except (OSError, SafetensorError, KeyError, TypeError, ValueError, RecursionError):
            continue


def finished(use: Callable[[Path], object]) -> Callable[[Path, int], Callable[[], object]]:
    """A result with all of its files, of which `use` is made in a copy."""

    def prepare(folder: Path, seed: int) -> Callable[[], object]:
        with short_blocks(), tempfile.TemporaryDirectory() as name:
            run = replace(task(1 + seed % 2), frames=range(6))
            reconstruct_parts(InFolder(Path(name)), run).save(folder)
        write_rig(run.rig, folder / "cameras.json")
        for file in folder.glob("*.npz"):  # without compression, so that changed bytes are changed numbers
            with np.load(file) as archive:
                columns = dict(archive)
            np.savez(file, **columns)

        def read() -> None:
            with in_a_copy(folder) as out:
                use(out)

        return read

    return prepare


def exported(folder: Path) -> None:
    """In all formats; no number of theirs may be none."""
    export_result(folder, list(FORMATS.values()), folder / "export")
    for file in (folder / "export").iterdir():
        if file.suffix in (".csv", ".bvh", ".trc") and b"nan" in file.read_bytes().lower():
            raise AssertionError(f"{file.name} holds NaN")


@contextmanager
def in_a_copy(folder: Path) -> Iterator[Path]:
    """A copy of the folder, beside which nothing may be written."""
    with tempfile.TemporaryDirectory() as name:
        yield Path(shutil.copytree(folder, Path(name) / "out"))
        beside = [file.name for file in Path(name).iterdir()]
        if beside != ["out"]:
            raise AssertionError(f"written outside of the folder: {beside}")
