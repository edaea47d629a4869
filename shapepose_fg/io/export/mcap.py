"""Exports a result as an MCAP file of ROS 2 messages."""

import numpy as np

from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.io.export.registry import Job, Written
from shapepose_fg.io.ros.mcap_files import McapWriter


def write_mcap(job: Job) -> Written:
    """Write `people.mcap`: one message of each type per frame, empty in frames without people."""
    take, written, path = job.take, Written(), job.folder / "people.mcap"

    def write(stream) -> None:
        with McapWriter(stream, take.rig) as file:
            for place, time_s in enumerate(take.times_s.tolist()):
                rows = take.rows[:, place]
                file.frame(take.people.rows(np.sort(rows[rows >= 0])), time_s)

    write_atomically(path, write)
    written.files.append(path)
    return written
