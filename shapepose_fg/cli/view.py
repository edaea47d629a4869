"""The command `view`: shows a result in the rerun viewer."""

from pathlib import Path
from typing import TYPE_CHECKING

from shapepose_fg.cli.options import RUN, TakeOptions, grouped, option
from shapepose_fg.cli.pictures import PictureOptions
from shapepose_fg.cli.terminal import note, progress
from shapepose_fg.core.errors import InputError

if TYPE_CHECKING:
    from shapepose_fg.io.export.take import Take
    from shapepose_fg.io.footage.footage import Footage
    from shapepose_fg.io.footage.placement import CameraFootage


@grouped
def view(
    part: TakeOptions,
    pictures: PictureOptions,
    connect: str | None = option(
        RUN, "Address of a running viewer: rerun+http://HOST:9876/proxy.", metavar="URL"
    ),
    statistics: bool = option(
        RUN, "Keep rerun's setting of usage statistics.", False, "--statistics"
    ),
) -> None:
    """Show a result in the rerun viewer: people, cameras, and used and unused detections, on a
    timeline. `export RESULTS rrd` writes the same into a file.
    """
    from shapepose_fg.io.export import rerun_app
    from shapepose_fg.io.export.registry import Job, read_take
    from shapepose_fg.io.export.rerun_log import log_pictures, log_take

    take = read_take(part.results, identities=False, **part.how())
    pairs = _pictures(part.results, take, pictures) if pictures.videos else []
    if connect is None and not statistics:
        note(*rerun_app.quiet_viewer())
    arrays, missing = rerun_app.body_if_there(Job(take, part.results, part.body))
    note(*missing)
    with rerun_app.shown(rerun_app.layout_of(take), connect) as stream:
        log_take(stream, take, arrays)
        if len(pairs) > 0:
            with progress("showing pictures", "pictures") as done:
                log_pictures(stream, take, pairs, done)


def _pictures(
    results: Path, take: "Take", pictures: PictureOptions
) -> "list[tuple[CameraFootage, Footage]]":
    """The cameras' videos or pictures: of all cameras, or of those that are given individually."""
    if take.rig is None:
        raise InputError(
            "--videos: cameras.json is missing beside the result, and pictures need it"
        )
    return pictures.of_result(results, take.people.run, take.rig, pictures.named(take.rig))
