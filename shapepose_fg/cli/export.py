"""The command `export`: writes a result in the formats of other programs."""

from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Interval

from shapepose_fg.cli.options import RESULT, TakeOptions, argument, grouped, option
from shapepose_fg.cli.terminal import note
from shapepose_fg.core.result_files import results_folder
from shapepose_fg.core.storage.files import inside


@grouped
def export(
    take: TakeOptions,
    formats: list[str] = argument(
        "FORMAT...", "Formats: amass trc c3d bvh glb angles opensim csv parquet mcap rrd, or all."
    ),
    output: Path | None = option(RESULT, "Folder for the files; by default RESULTS/export."),
    markers: Literal["opensim", "joints", "body"] = option(
        RESULT,
        "Marker set of trc and c3d: opensim (as Pose2Sim), joints (of the result), body (of SMPL).",
        "opensim",
    ),
    fill_gaps: Annotated[float, Interval(ge=0, le=3600)] = option(
        RESULT, "Longest gap that is filled in amass and bvh, seconds.", 0.2, metavar="SECONDS"
    ),
) -> None:
    """Write a result in formats of other programs: shapepose-fg export RESULTS amass trc c3d bvh
    glb angles opensim csv parquet mcap rrd.
    """
    from shapepose_fg.io.export.markers import MarkerSet
    from shapepose_fg.io.export.registry import FORMATS, chosen, export_result

    how = take.how()
    wanted = list(FORMATS.values()) if "all" in formats else chosen(formats)
    output = inside(results_folder(take.results), "export") if output is None else output
    more = {"markers": MarkerSet(markers), "fill_gaps_s": fill_gaps, "body": take.body}
    done = export_result(take.results, wanted, output, **how, **more)
    for file in dict.fromkeys(file for written in done.values() for file in written.files):
        print(file)
    note(*dict.fromkeys(message for written in done.values() for message in written.notes))
