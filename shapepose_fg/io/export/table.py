"""CSV, one line per person, frame and joint, for notebooks and spreadsheets: the recording's own axes, metres."""

import csv
import io

import numpy as np

from shapepose_fg.core.reconstruction import Known
from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.core.storage.schema import code_names
from shapepose_fg.io.export.job import Job, Written
from shapepose_fg.io.export.markers import sigma_m
from shapepose_fg.io.export.take import Take

COLUMNS = (
    "frame time_s person joint x_m y_m z_m sigma_m sigma_x_m sigma_y_m sigma_z_m vx_m_s vy_m_s vz_m_s"
    " known confidence"
).split()
"""The first line."""


def write_csv(job: Job) -> Written:
    """`joints.csv`."""
    path, text = job.folder / "joints.csv", csv_text(job.take)
    write_atomically(path, lambda stream: stream.write(text.encode()))
    return Written([path])


def csv_text(take: Take) -> str:
    """All joints that are placed: a joint that is not known has no line. What else is not known is empty."""
    people = take.people
    row, joint = np.nonzero(np.isfinite(people.joints).all(axis=2))
    order = np.lexsort((joint, people.person[row], people.frame[row]))
    row, joint = row[order], joint[order]
    times = take.times_s[np.searchsorted(take.frames, people.frame)]
    covariance = people.covariance[row, joint]
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    with np.errstate(invalid="ignore"):
        axes = np.sqrt(np.where(variance >= 0, variance, np.nan))
    columns = [
        people.frame[row].tolist(),
        _words(times[row]),
        people.person[row].tolist(),
        people.joint_names[joint].tolist(),
        *map(_words, people.joints[row, joint].T),
        _words(sigma_m(covariance)),
        *map(_words, axes.T),
        *map(_words, people.velocity[row, joint].T),
        code_names(Known)[people.known[row, joint]].tolist(),
        _words(people.confidence[row, joint], "%.4f"),
    ]
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(zip(*columns, strict=True))
    return stream.getvalue()


def _words(values: np.ndarray, digits: str = "%.6f") -> list[str]:
    """Numbers as text; empty where they are not known."""
    return np.where(np.isfinite(values), np.char.mod(digits, values), "").tolist()
