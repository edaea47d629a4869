"""A result written in several formats."""

from collections.abc import Sequence
from pathlib import Path

from shapepose_fg.core.camera import Axis
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.io.export.job import Job, Written
from shapepose_fg.io.export.markers import MarkerSet
from shapepose_fg.io.export.reading import body_file, chosen_rows, read_take
from shapepose_fg.io.export.registry import Format


def export_result(
    results: Path,
    formats: Sequence[Format],
    folder: Path,
    *,
    up: Axis | None = None,
    fps: float | None = None,
    seen_only: bool = False,
    frames: range | None = None,
    persons: tuple[int, ...] | None = None,
    markers: MarkerSet = MarkerSet.OPENSIM,
    fill_gaps_s: float = 0.2,
    body: Path | None = None,
) -> dict[str, Written]:
    """What was written of each format into `folder`, by its name; InputError where a result does not allow it.

    The options are those of `read_take` and `Job`; `body` is where the body model's file is now. Files that are
    there already are replaced. A format of which no file came out is an InputError too.
    """
    job: Job | None = None
    if not all(each.rows for each in formats):
        take = read_take(
            results,
            up=up,
            fps=fps,
            seen_only=seen_only,
            frames=frames,
            persons=persons,
            identities=any(each.identities for each in formats),
            observations=any(each.observations for each in formats),
        )
        job = Job(take, folder, body_file(take, body), markers, fill_gaps_s)
    done = {}
    for each in formats:
        if each.rows or job is None:
            with Reconstruction.open(results) as opened:
                rows = chosen_rows(opened, results, frames, persons)
                done[each.name] = each.write_rows(opened, rows, folder)
        else:
            done[each.name] = each.write(job)
        if len(done[each.name].files) == 0:
            raise InputError(f"{results}: {'; '.join(done[each.name].notes)}; leave out {each.name}")
    return done
