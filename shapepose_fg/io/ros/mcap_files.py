"""MCAP files of ROS 2 messages: writes people and reads detections, without a ROS installation."""

import math
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import IO, Any

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.errors import InputError, naming, optional
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.core.storage.files import open_regular
from shapepose_fg.core.trajectory import LONGEST_GAP_S, Trajectory
from shapepose_fg.io.camera_names import listing
from shapepose_fg.io.detections.lines import view_of
from shapepose_fg.io.ros.definitions import check_definition, definition, type_name
from shapepose_fg.io.ros.messages import NS, Message, header, nanoseconds, optical, ros_name
from shapepose_fg.io.ros.poses import KINDS, Frames, frame_of, stamp_ns
from shapepose_fg.io.ros.topics import PeopleTopics

_DETECTIONS = "shapepose_msgs/Detections"
_CHUNK = 2**26
"""Maximum size of a decompressed chunk, bytes; ROS 2 writes chunks of one million bytes."""
_WINDOW, _MOST_RECORDS = 2**27, 2**19
"""Maximum window size of zstd, bytes (the default of its command-line program); and maximum number
of records of a chunk, which are all in memory."""
_CURE = f"give MCAP with ROS 2 messages {type_name(_DETECTIONS)}"
_CURE_POSES = "give MCAP with ROS 2 messages of /tf, odometry or poses"
View = tuple[str, Detections, float, Array | None, Array | None]
"""The arguments of `OnlineReconstructor.push_view`."""


class McapWriter(AbstractContextManager["McapWriter"]):
    """Writes people frame by frame. A context manager; the file's index is written at its end."""

    def __init__(self, stream: IO[bytes], rig: Rig | None, covariances: str = "all") -> None:
        self._file = optional("mcap_ros2.writer", "ros").Writer(stream)
        self._schemas: dict[str, Any] = {}
        self._topics, self._begun = PeopleTopics(rig, covariances), False

    def __exit__(self, *_error: object) -> None:
        self._file.finish()

    def frame(self, rows: Reconstruction, time_s: float, kind: str = "settled") -> None:
        """Write the people of one frame; before the first frame also cameras and /tf_static."""
        # A body frame has one pose at a time: the refined one, if both are written.
        published = self._topics.frame(rows, time_s, kind, kind != "now")
        if not self._begun:
            published = chain(self._topics.fixed(time_s), published)
        self._begun = True
        for topic, name, message in published:
            self._message(topic, name, message, time_s)

    def detections(self, camera: str, seen: list[list[float]], time_s: float, rig: Rig) -> None:
        """Write one camera's detections: for each person, x, y and score of each keypoint, pixels
        of the picture.
        """
        which = rig.cameras[rig.names.index(camera)]
        people = [{"pose_keypoints_2d": each} for each in seen]
        message = {"header": header(optical(which), time_s), "camera": camera, "people": people}
        self._message(f"/{ros_name(camera)}/detections", _DETECTIONS, message, time_s)

    def _message(self, topic: str, kind: str, message: Message, time_s: float) -> None:
        if kind not in self._schemas:
            self._schemas[kind] = self._file.register_msgdef(type_name(kind), definition(kind))
        self._file.write_message(topic, self._schemas[kind], message, log_time=nanoseconds(time_s))


def view_of_message(
    message: Any, place: str, rig: Rig, skeleton: Skeleton
) -> tuple[str, Detections, float]:
    """Camera, detections and time in seconds of a shapepose_msgs/Detections. InputError naming
    `place` if it is invalid.
    """
    people = [list(map(float, each.pose_keypoints_2d)) for each in message.people]
    time_s = stamp_ns(message.header) / NS
    return view_of(message.camera, time_s, people, place, rig, skeleton)


def read_views(
    file: Path, rig: Rig, skeleton: Skeleton, note: Callable[[str], None]
) -> Iterator[View]:
    """Yield the arguments of `OnlineReconstructor.push_view` in the order of the log: camera,
    detections, time stamp in seconds, and for a moving camera its interpolated pose with
    covariance.

    A picture is yielded only after the next pose has been read. `note` receives messages about
    cameras without poses. InputError, one sentence, for an invalid file or one without detections.
    """
    number, frames, unplaced, begun_s, tidied_s = (
        0,
        Frames(),
        Counter[tuple[str, str]](),
        math.inf,
        -math.inf,
    )
    looked_s, left = -math.inf, 0
    waiting = deque[tuple[tuple[str, Detections, float], str]]()
    carrier = {each.name: each.carrier for each in rig.cameras}

    def placed(now_s: float) -> Iterator[View]:
        while waiting:
            (camera, seen, time_s), frame = waiting[0]
            with naming(file, _CURE_POSES):
                (pose,), (covariances,), (known,) = frames.at(frame, np.array([time_s]))
            stands = not (carrier[camera] or frames.moves(frame))
            if now_s < (begun_s if stands else time_s) + LONGEST_GAP_S and not known:
                return
            waiting.popleft()
            if known or stands:
                yield (
                    camera,
                    seen,
                    time_s,
                    None if stands else pose,
                    None if stands else covariances,
                )
            else:
                unplaced[camera, frame] += 1

    with open_regular(file, _CURE) as stream:
        for topic, kind, logged_s, message in _decoded(
            stream, file, {type_name(_DETECTIONS), *KINDS}, _CURE
        ):
            begun_s = min(begun_s, logged_s)
            if kind != type_name(_DETECTIONS):
                with _whole(file, _CURE):
                    frames.add(topic, kind, message, f"{file}: topic {topic}")
            else:
                number += 1
                with _whole(file, _CURE):
                    if message.camera in rig.unwanted:
                        continue
                    view = view_of_message(message, f"{file}, message {number}", rig, skeleton)
                    goes = carrier[message.camera]
                    waiting.append(
                        (view, frame_of(goes) if goes else message.header.frame_id.lstrip("/"))
                    )
            # Interval between searches for the poses of waiting pictures, s of log time; each
            # search reads all poses.
            if abs(logged_s - looked_s) >= 0.1 or len(waiting) > 2 * left + 64:
                yield from placed(logged_s)
                looked_s, left = logged_s, len(waiting)
            if logged_s > tidied_s + 1.0:
                # Time for which poses are kept, s, for detections that are
                # logged later than their poses.
                frames.forget(logged_s - 3.0)
                tidied_s = logged_s
    yield from placed(math.inf)
    for (camera, frame), count in unplaced.items():
        what = f"frame {frame} has no pose within {LONGEST_GAP_S:g} s"
        note(f"{file}: {count} pictures of {camera} are left out: {what}")
    if number == 0:
        raise InputError(f"{file}: there are no detections in it; {_CURE}")


def read_frame(file: Path, frame: str, name: str) -> Trajectory:
    """The trajectory of a coordinate frame, or of a topic of poses; without `frame`, of the only
    one that moves. InputError if there is none.
    """
    frames = Frames()
    with open_regular(file, _CURE_POSES) as stream:
        for topic, kind, _, message in _decoded(stream, file, set(KINDS), _CURE_POSES):
            with _whole(file, _CURE_POSES):
                frames.add(topic, kind, message, f"{file}: topic {topic}")
    known, wanted = frames.moving, frame.lstrip("/")
    if (not wanted and len(known) != 1) or (wanted and not frames.moves(wanted)):
        which = listing(known) if known else "none"
        raise InputError(
            f"{file}: the moving frames in it are {which}; choose one with {file.name}#FRAME"
        )
    with naming(f"{file}: frame {wanted or known[0]}", "record more"):
        return frames.trajectory(wanted or known[0], name)


def _whole(file: Path, cure: str) -> AbstractContextManager[None]:
    """Context manager: InputError if a message lacks a field, or has a value of another kind there.
    The library may parse a damaged definition differently from `check_definition`.
    """
    words = "a message does not fit its definition ({})"
    return naming(file, cure, words, AttributeError, TypeError)


def _decoded(
    stream: IO[bytes], file: Path, wanted: set[str], cure: str
) -> Iterator[tuple[str, str, float, Any]]:
    """Topic, type, log time and content of the messages; InputError for damaged files."""
    factory, decoders = optional("mcap_ros2.decoder", "ros").DecoderFactory(), dict[int, Any]()
    try:
        for schema, channel, message in _messages(stream):
            if schema is not None and schema.name in wanted:
                if id(schema) not in decoders:
                    check_definition(schema.name.replace("/msg/", "/"), schema.data.decode())
                    # A schema is kept together with its decoder, so that another schema with the
                    # same number replaces neither.
                    own = replace(schema, id=len(decoders) + 1)
                    decoders[id(schema)] = (
                        schema,
                        factory.decoder_for(channel.message_encoding, own),
                    )
                decode = decoders[id(schema)][1]
                if decode is None:
                    raise ValueError(
                        f"its encoding is {channel.message_encoding}, {schema.encoding}"
                    )
                yield channel.topic, schema.name, message.log_time / NS, decode(message.data)
    except (
        Exception
    ) as error:  # of damaged files the library raises anything: struct.error, KeyError, zstd's own
        problem = f"{type(error).__name__}: {str(error).strip()[:80]}"
        raise InputError(f"{file}: cannot be read ({problem}); {cure}") from None


def _messages(stream: IO[bytes]) -> Iterator[tuple[Any, Any, Any]]:
    """Schema, channel and record of each message, chunk by chunk (one is in memory at a time),
    sorted by log time within a chunk. ValueError for a chunk of more than `_CHUNK` bytes, which is
    not decompressed further.
    """
    reading = optional("mcap.stream_reader", "ros")
    schemas, channels = {}, {}
    most = stream.seek(0, 2)
    stream.seek(0)
    for record in reading.StreamReader(stream, emit_chunks=True, record_size_limit=most).records:
        inside = [record]
        if isinstance(record, reading.Chunk):
            plain = replace(record, compression="", data=_unpacked(record))
            inside = sorted(
                reading.breakup_chunk(plain), key=lambda each: getattr(each, "log_time", -1)
            )
        for each in inside:
            if isinstance(each, reading.Schema):
                schemas[each.id] = each
            elif isinstance(each, reading.Channel):
                channels[each.id] = each
            elif isinstance(each, reading.Message):
                channel = channels[each.channel_id]
                yield schemas.get(channel.schema_id), channel, each


def _unpacked(chunk: Any) -> bytes:
    """The records of a chunk. ValueError for more than `_CHUNK` bytes (not decompressed further),
    for more than `_MOST_RECORDS` records, and for records that extend beyond the chunk.
    """
    lz4, zstd = optional("lz4.frame", "ros"), optional("zstandard", "ros")
    claims = {
        "zstd": zstd.frame_content_size,
        "lz4": lambda packed: lz4.get_frame_info(packed)["content_size"],
    }
    claim = max(claims.get(chunk.compression, len)(chunk.data), chunk.uncompressed_size)
    if claim > _CHUNK:
        raise ValueError(f"a chunk claims {claim} bytes, over {_CHUNK}")
    # The sizes stated in the compressed data and in the chunk's header may be wrong or missing.
    if chunk.compression == "lz4":
        data = lz4.LZ4FrameDecompressor().decompress(chunk.data, max_length=_CHUNK + 1)
    elif chunk.compression == "zstd":
        data = (
            zstd.ZstdDecompressor(max_window_size=_WINDOW)
            .stream_reader(chunk.data)
            .read(_CHUNK + 1)
        )
    else:
        data = chunk.data
    if len(data) > _CHUNK:
        raise ValueError(f"a chunk has over {_CHUNK} bytes")
    at = count = 0
    while at < len(data):
        at, count = at + 9 + int.from_bytes(data[at + 1 : at + 9], "little"), count + 1
        if at > len(data) or count > _MOST_RECORDS:
            raise ValueError(
                "a record ends beyond its chunk"
                if at > len(data)
                else "a chunk has too many records"
            )
    return data
