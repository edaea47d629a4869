"""What `shapepose-fg reconstruct` makes of a finished run beside its results: check, report, TRC and C3D."""

from dataclasses import dataclass
from pathlib import Path

from rich.table import Table

from shapepose_fg.cli.reconstruct.summary import summary_table
from shapepose_fg.cli.terminal import note
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.io.detection_table import DetectionTable
from shapepose_fg.io.export.marker_files import write_pose2sim_files
from shapepose_fg.io.pose2sim_project import Pose2SimProject
from shapepose_fg.pipeline.runs.assembly import Assembly
from shapepose_fg.setup_check.diagnosis import diagnose
from shapepose_fg.setup_check.in_result import ResultCheck, result_check
from shapepose_fg.setup_check.pictures import other_sizes
from shapepose_fg.setup_check.report import report_of
from shapepose_fg.viz.report.writing import MOST_ROWS, REPORT, th, write_report


@dataclass(frozen=True)
class Ending:
    """What is wanted of a run beside its results."""

    calibration: Path
    """The file of the cameras."""
    project: Pose2SimProject | None
    """Where TRC and C3D go."""
    videos: Path | None
    """Folder of videos whose sizes are compared with the calibration's."""
    report: bool
    """Whether report.html is."""
    check: bool
    """Whether the set-up is checked."""

    def looked_at(self, result: Assembly) -> Reconstruction:
        """The rows that fit in memory beside everything else."""
        every = _every(result)
        if every > 1:
            note(f"check and report are made of every {th(every)} frame: the result has {len(result)} rows")
        return result.reconstruction(every=every)

    def checked(
        self, recording: DetectionTable, rig: Rig, frames: range, people: Reconstruction
    ) -> ResultCheck | None:
        """Whether cameras, detections and, where there are any, videos fit."""
        if not self.check:
            return None
        sizes = ()
        if self.videos is not None and self.videos.is_dir():
            try:
                sizes = other_sizes([str(self.videos)], rig)
            except InputError as error:  # the result does not need them
                note(f"{error}; their sizes are not checked")
        report = report_of(diagnose(recording, rig, frames), rig, sizes)
        return result_check(report, people, recording, rig, frames)

    def written(
        self, result: Assembly, people: Reconstruction, rig: Rig, frames: range, seconds: float, output: Path
    ) -> Table:
        """Leave report and files for other programs; returns what is to be said of the run."""
        summary = summary_table(result, people, frames, len(rig), seconds, output)
        if self.report:
            page = write_report(output, people, rig, every=_every(result))
            summary.add_row("", f"{page}  to look at, in a browser")
        else:  # that of an earlier result would say what is no longer true
            (output / REPORT).unlink(missing_ok=True)
        if self.project is not None:
            whole = people if len(people) == len(result) else result.reconstruction()
            written = write_pose2sim_files(whole, rig.up, self.project)
            for path in written.files:
                summary.add_row("", str(path))
            for each in written.notes:
                note(each)
        return summary


def _every(result: Assembly) -> int:
    """Which frames check and report look at: every so many."""
    return max(1, -(-len(result) // MOST_ROWS))
