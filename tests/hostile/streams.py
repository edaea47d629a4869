"""Networks, photos, MCAP, and lines and states of `live`, whose content is to be changed
(`readers.py`).
"""

import json
import os
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.detection2d.onnx_file import read_onnx
from shapepose_fg.detection2d.onnx_network import OnnxNetwork
from shapepose_fg.io.lenses import lenses_of
from shapepose_fg.io.ros.mcap_files import read_views
from shapepose_fg.io.trajectories import read_trajectory
from shapepose_fg.live.inputs import feed
from shapepose_fg.live.online import OnlineReconstructor
from shapepose_fg.live.outputs import line_of
from tests.estimation.test_windows import NobodyFitter
from tests.hostile.trying import Prepare

Read = Callable[[], object]
FRAMES = 4


def network_file(folder: Path, seed: int) -> Read:
    """A network of which only its file is read."""
    network(folder, seed)
    return lambda: read_onnx(folder / "n.onnx")


def network(folder: Path, seed: int) -> Read:
    """A convolution, whose weights are in the file, run by OpenCV; beside it the file "canary", not
    to be read.
    """
    from tests.detection2d.conftest import onnx_file

    onnx_file(
        folder / "n.onnx", np.random.default_rng(seed).normal(size=(3, 3, 2, 2)).astype(np.float32)
    )
    if Path("files").is_dir() and not Path("canary").exists():  # the folder of fuzz.py
        os.mkfifo("canary")  # who opens it waits for ever

    def read() -> None:
        made = OnnxNetwork.open(folder / "n.onnx", "opencv")
        made.run(np.ones((1, 3, 8, 8), dtype=np.float32))

    return read


def photo(kind: str) -> Prepare:
    """A photo with EXIF."""

    def prepare(folder: Path, seed: int) -> Read:
        from PIL import Image

        told = Image.Exif()
        told[0x8769] = {0xA405: 28}
        name = {"JPEG": "a.jpg", "PNG": "a.png", "TIFF": "a.tif"}[kind]
        Image.new("RGB", (8, 6), (seed % 256, 2, 3)).save(folder / name, kind, exif=told.tobytes())
        (folder / "detections" / "c").mkdir(parents=True)

        def read() -> None:
            (camera,) = lenses_of(folder / "detections", [str(folder / name)], (16, 12)).cameras
            assert np.isfinite(camera.K).all()

        return read

    return prepare


@cache
def scene(seed: int):
    """Two people before three cameras, four frames, and what an OpenPose would give of each."""
    from shapepose_fg.simulation import built_in_scene, simulate

    made = built_in_scene(seed=1 + seed % 2, people=2, cameras=3, frames=FRAMES)
    return made, simulate(made, seed=seed)


def lines(seed: int) -> list[dict]:
    """What cameras see, as `live` takes it."""
    made, recording = scene(seed)
    found = []
    for frame in range(FRAMES):
        for view, name in enumerate(made.rig.names):
            seen = recording[frame].only(recording[frame].view == view)
            flat = np.zeros((2, 25, 3))
            for joint in range(25):
                of = np.flatnonzero(seen.joint == joint)[:2]
                flat[: len(of), joint, :2] = np.round(seen.xy[of], 1)
                flat[: len(of), joint, 2] = np.round(seen.confidence[of], 2)
            people = [{"pose_keypoints_2d": each.ravel().tolist()} for each in flat]
            found.append({"camera": name, "time_s": frame / 25, "people": people})
    return found


def mcap(kind: str) -> Prepare:
    """Poses, or detections before cameras that move and stand."""

    def prepare(folder: Path, seed: int) -> Read:
        import gtsam

        from tests.io import test_ros_poses as ros

        rng, messages = np.random.default_rng(seed), []
        made, _ = scene(seed)
        pose = gtsam.Pose3.Expmap(rng.normal(size=6) / 4)
        for n in range(6):
            time_s = n / 25
            turn = gtsam.Pose3.Expmap(np.full(6, 0.01 * n))
            messages.append(("/tf", time_s, ros.transform("odom", "base", time_s, turn)))
            messages.append(("/odom", time_s, ros.odometry(time_s, turn, np.eye(6) * 1e-4)))
            way, about = ros.parts(turn)
            alone = {
                "header": ros.header("map", time_s),
                "pose": {"position": way, "orientation": about},
            }
            messages.append(("/slam", time_s, alone))
        for name in made.rig.names:
            messages.append(
                ("/tf_static", 0.0, ros.transform("base", f"{name}_optical", 0.0, pose))
            )
        for each in lines(seed):
            head = ros.header(f"{each['camera']}_optical", each["time_s"])
            messages.append(("/detections", each["time_s"], {"header": head} | each))
            messages[-1][2].pop("time_s")
        ros.write(folder / "log.mcap", sorted(messages, key=lambda each: each[1]))
        (folder / "log.mcap").write_bytes(_without_chunks(folder / "log.mcap"))

        def read() -> None:
            if kind == "poses":
                found = read_trajectory(f"{folder}/log.mcap#base")
                assert np.isfinite(found.wTb).all()
                return
            for _, seen, time_s, where, surely in read_views(
                folder / "log.mcap", made.rig, BODY_25, lambda _: None
            ):
                known = [each for each in (where, surely) if each is not None]
                assert all(np.isfinite(each).all() for each in (seen.xy, np.array(time_s), *known))

        return read

    return prepare


def _without_chunks(file: Path) -> bytes:
    """The same file with chunks that are not packed, so that changed bytes are changed numbers."""
    import io

    from mcap.reader import make_reader
    from mcap.writer import CompressionType, Writer

    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=4000, compression=CompressionType.NONE)
    writer.start("ros2", "x")
    schemas, channels = {}, {}
    with file.open("rb") as source:
        for schema, channel, message in make_reader(source).iter_messages():
            assert schema is not None
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    channel.topic, "cdr", schemas[schema.id]
                )
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.log_time
            )
    writer.finish()
    return stream.getvalue()


def _started(seed: int) -> OnlineReconstructor:
    made, _ = scene(seed)
    return OnlineReconstructor(made.rig, workers=1, fitter=NobodyFitter())


def _told(people: Reconstruction, kind: str) -> None:
    """As the command writes them: a number that is none is a ValueError."""
    for time_s in np.unique(people.time_s).tolist():
        line_of(kind, people.rows(people.time_s == time_s), time_s)


def live_lines(folder: Path, seed: int) -> Read:
    """A file of lines, and all that comes of it."""
    (folder / "in.jsonl").write_text("\n".join(map(json.dumps, lines(seed))) + "\n")
    made, _ = scene(seed)

    def read() -> None:
        with _started(seed) as live:

            def push(*view: object) -> None:
                live.push_view(*view)  # pyright: ignore
                _told(live.people(), "now")

            feed(str(folder / "in.jsonl"), made.rig, BODY_25, lambda _: None, push)
            _told(live.finish(), "settled")

    return read


def live_state(folder: Path, seed: int) -> Read:
    """A state, from which it goes on for two frames."""
    made, _ = scene(seed)
    given = lines(seed)
    with _started(seed) as live:
        _push(live, given[:-4])
        live.save(folder / "state")

    def read() -> None:
        other = OnlineReconstructor.load(
            folder / "state", made.rig, workers=1, fitter=NobodyFitter()
        )
        with other:
            _told(other.people(), "now")
            _push(other, given[-4:])
            _told(other.people(), "now")
            _told(other.finish(), "settled")

    return read


def _push(live: OnlineReconstructor, given: list[dict]) -> None:
    from shapepose_fg.io.detections.lines import read_view_line

    for each in given:
        with suppress(InputError):
            live.push_view(*read_view_line(json.dumps(each), "a line", live.rig, BODY_25))
