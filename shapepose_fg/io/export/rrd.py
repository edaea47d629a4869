"""RRD, a recording for the rerun viewer: the recording's own axes, metres; what is missing is not drawn."""

import shutil
import tempfile
from pathlib import Path

from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.io.export.job import Job, Written
from shapepose_fg.io.export.rerun_scene import body_if_there, layout, log_take, new_stream


def write_rrd(job: Job) -> Written:
    """`people.rrd`; without bodies where the body model is not there any more."""
    written, take = Written(), job.take
    stream = new_stream()
    arrays, note = body_if_there(job)
    written.notes += [] if note is None else [f"rrd: {note}"]
    if take.rig is None:
        written.notes.append("rrd: no cameras, for there is no cameras.json")
    path = job.folder / "people.rrd"
    with tempfile.TemporaryDirectory() as folder:  # rerun writes to a path only
        draft = Path(folder) / "people.rrd"
        stream.save(draft, default_blueprint=layout(take))
        log_take(stream, take, arrays)
        stream.flush()
        stream.disconnect()
        with draft.open("rb") as source:
            write_atomically(path, lambda target: shutil.copyfileobj(source, target))
    written.files.append(path)
    return written
