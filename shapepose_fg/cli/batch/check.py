"""What can be known of all recordings before the work on the first begins."""

import shutil
from collections.abc import Sequence
from pathlib import Path

from rich.filesize import decimal

from shapepose_fg.cli.batch.table import LOG, Entry
from shapepose_fg.cli.reconstruct.request import OUTPUTS, prepare
from shapepose_fg.cli.terminal import note
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import open_regular
from shapepose_fg.core.storage.output_folder import prepare_output
from shapepose_fg.io.corrections import refuse_corrected
from shapepose_fg.io.detections.reading import find_places
from shapepose_fg.io.skeleton_file import find_skeleton
from shapepose_fg.pipeline.runs.manifest import PARTS

_LEAST, _USUAL = 0.1, 2.0
"""Bytes of results for each byte of detections: many cameras whose files hold hands and faces, and others."""


def look_at_all(table: Path, entries: Sequence[Entry], output: Path, *, begun: bool) -> dict[str, int]:
    """Bytes of each recording's detections, whose cameras, settings and places are all there.

    `begun` says that runs which were stopped in their folders are meant to go on, or begin anew.
    InputError where something is missing, wrong or in the way, for the first such recording, and how many others
    there are; or where the disk of `output` has no room for what all of them will leave.
    """
    sizes, problems = {}, []
    for entry in entries:
        try:
            sizes[entry.name] = _look_at(entry, output / entry.name, begun)
        except InputError as error:
            problems.append(f"recording {entry.name}: {error}")
    if len(problems) > 0:
        others = [problem.split(":")[0].removeprefix("recording ") for problem in problems[1:]]
        listed = ", ".join(others[:5]) + (f" and {len(others) - 5} more" if len(others) > 5 else "")
        more = f" (and something is wrong with {listed}, too)" if len(others) > 0 else ""
        raise InputError(f"{table}: {problems[0]}{more}")
    whole, free = sum(sizes.values()), shutil.disk_usage(output).free
    if free < _LEAST * whole:
        raise InputError(
            f"{output}: at least {decimal(int(_LEAST * whole))} are needed for {len(entries)} recordings, and"
            f" {decimal(free)} are free; make room, give another --output, or split the table"
        )
    if free < _USUAL * whole:
        usual = decimal(int(_USUAL * whole))
        note(f"{output}: {decimal(free)} are free, and results of so much footage mostly take {usual}")
    return sizes


def _look_at(entry: Entry, folder: Path, begun: bool) -> int:
    """Bytes of a recording's detections."""
    known = prepare(entry.request, folder, tell=lambda _: None)
    asked = known.request
    places, _ = find_places(known.detections, asked.rig())
    find_skeleton(asked.skeleton)
    settings = known.settings()
    source = settings.offsets.source
    files = [asked.body, asked.timestamps, Path(source) if source not in ("recording", "none") else None]
    for file in files:
        if file is not None:
            open_regular(file).close()
    if asked.shapes is not None:
        prepare_output(asked.shapes.parent, [asked.shapes.name])
    prepare_output(folder, (*OUTPUTS, LOG))
    refuse_corrected(folder)
    if (folder / PARTS).exists() and not begun:
        raise InputError(
            f"{folder / PARTS}: a run was stopped here; go on with --resume, or begin anew with --restart"
        )
    return sum(_bytes(path) for path in places)


def _bytes(path: Path) -> int:
    """Of a file, or of all in a folder."""
    files = path.rglob("*") if path.is_dir() else (path,)
    return sum(file.stat().st_size for file in files if file.is_file())
