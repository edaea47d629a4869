"""MCAP with ROS 2 messages, read back by readers that are not ours."""

import tracemalloc
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Known, Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.core.trajectory import Trajectory
from shapepose_fg.io.ros.mcap_files import McapWriter, read_views
from shapepose_fg.io.ros.messages import fixed_transforms
from tests.conftest import STANDING

pytest.importorskip("mcap_ros2", reason='needs pip install "shapepose-fg[ros]"')
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

T, START_S = 5, 1_700_000_000.25


@pytest.fixture(scope="module")
def people() -> Reconstruction:
    """Two people in five frames, of a clock since 1970; one joint is unknown, and one body."""
    rng, N = np.random.default_rng(0), 2 * T
    joints = STANDING + rng.normal(0, 1, (N, 1, 3))
    joints[3, 4] = np.nan
    orient = rng.normal(0, 1, (N, 3))
    orient[5] = np.nan
    known = np.full((N, 25), Known.SEEN, dtype=np.uint8)
    known[3, 4] = Known.UNKNOWN
    return Reconstruction(
        frame=np.repeat(np.arange(T), 2), person=np.tile([3, 12], T),
        joint_names=np.array(BODY_25.joints), joints=joints,
        covariance=np.tile(np.eye(3) * 1e-4, (N, 25, 1, 1)), confidence=np.ones((N, 25)),
        status=np.full(N, "ok"), time_s=START_S + np.repeat(np.arange(T), 2) / 30,
        velocity=rng.normal(0, 1, (N, 25, 3)),
        velocity_covariance=np.tile(np.eye(3), (N, 25, 1, 1)), known=known,
        betas=rng.normal(size=(N, 10)), global_orient=orient, body_pose=rng.normal(size=(N, 23, 3)),
        transl=rng.normal(size=(N, 3)),
    )  # fmt: skip


@pytest.fixture
def rig(five_cameras) -> Rig:
    """One of the cameras goes with a robot, and one has a name that is none of a topic."""
    robot = Trajectory("robot.tum", START_S + np.array([-1.0, 1.0]), np.tile(np.eye(4), (2, 1, 1)))
    first, second, *others = five_cameras.cameras
    carried = replace(first, carrier="robot.tum", bTc=first.wTc)
    return Rig((carried, replace(second, name="2-left"), *others), "-y", trajectories=(robot,))


@pytest.fixture
def file(tmp_path, people, rig):
    with (tmp_path / "people.mcap").open("wb") as stream, McapWriter(stream, rig) as writer:
        for frame in range(T):
            here = people.rows(people.frame == frame)
            writer.frame(here, float(here.time_s[0]))
    return tmp_path / "people.mcap"


def by_topic(file) -> dict[str, list]:
    found: dict[str, list] = {}
    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, logged, message in reader.iter_decoded_messages():
            stamped = getattr(message, "header", None)
            if stamped is not None:
                assert logged.log_time == stamped.stamp.sec * 10**9 + stamped.stamp.nanosec
            found.setdefault(channel.topic, []).append(message)
    return found


def matrix(transform) -> np.ndarray:
    t, q = transform.transform.translation, transform.transform.rotation
    return gtsam.Pose3(
        gtsam.Rot3.Quaternion(q.w, q.x, q.y, q.z), np.array([t.x, t.y, t.z])
    ).matrix()


def test_people_are_read_back_as_they_were_written(file, people):
    messages = by_topic(file)["/people/settled"]
    assert len(messages) == T
    for frame, message in enumerate(messages):
        rows = people.rows(people.frame == frame)
        stamp = message.header.stamp
        # A double holds a time since 1970 to a quarter of a microsecond.
        assert stamp.sec + 1e-9 * stamp.nanosec == pytest.approx(START_S + frame / 30, abs=1e-6)
        assert message.header.frame_id == "world" and list(message.joint_names) == list(
            BODY_25.joints
        )
        assert [each.person for each in message.people] == [3, 12]
        for row, each in enumerate(message.people):
            assert each.status == "ok"
            for name in (
                "joints covariance velocity velocity_covariance known betas body_pose transl"
            ).split():
                np.testing.assert_array_equal(
                    np.array(list(getattr(each, name))), getattr(rows, name)[row].ravel()
                )


def test_bodies_face_along_x_with_the_head_along_z(file, people):
    messages = by_topic(file)["/tf"]
    seen = [each for message in messages for each in message.transforms]
    bodies = [each for each in seen if each.child_frame_id.startswith("body_")]
    assert len(bodies) == 2 * T - 1  # one body is not known
    in_world = {each.child_frame_id for each in seen if each.header.frame_id == "world"}
    assert in_world == {"body_p3", "body_p12", "robot_tum"}
    R = gtsam.Rot3.Rodrigues(people.global_orient[0]).matrix()
    np.testing.assert_allclose(matrix(bodies[0])[:3, 0], R[:, 2], atol=1e-12)  # SMPL faces +z
    np.testing.assert_allclose(
        matrix(bodies[0])[:3, 2], R[:, 1], atol=1e-12
    )  # and its head is at +y
    np.testing.assert_allclose(
        matrix(bodies[0])[:3, 3], people.joints[0, BODY_25.index("MidHip")], atol=1e-12
    )


def test_the_map_has_z_up_and_cameras_look_along_z(file, rig):
    found = by_topic(file)
    (static,) = found["/tf_static"]
    world, *cameras = static.transforms
    assert (world.header.frame_id, world.child_frame_id) == ("map", "world")
    np.testing.assert_allclose(matrix(world)[:3, :3] @ rig.up_vector, [0, 0, 1], atol=1e-12)
    assert [each.header.frame_id for each in cameras] == [
        "robot_tum",
        "world",
        "world",
        "world",
        "world",
    ]
    for transform, camera in zip(cameras, rig.cameras, strict=True):
        np.testing.assert_allclose(matrix(transform), camera.wTc, atol=1e-9)
    (info,) = found["/_2_left/camera_info"]
    assert (
        info.header.frame_id == "_2_left_optical"
        and (info.width, info.height) == rig.cameras[1].image_size
    )
    np.testing.assert_array_equal(np.array(list(info.k)).reshape(3, 3), rig.cameras[1].K)
    assert info.distortion_model == "plumb_bob" and len(info.d) == 5


@pytest.mark.parametrize("up", ["x", "-x", "y", "-y", "z", "-z"])
def test_any_axis_may_be_up(five_cameras, up):
    rig = replace(five_cameras, up=up)
    turn = fixed_transforms(rig, 0.0)["transforms"][0]["transform"]["rotation"]
    R = gtsam.Rot3.Quaternion(*(turn[axis] for axis in "wxyz")).matrix()
    np.testing.assert_allclose(R @ rig.up_vector, [0, 0, 1], atol=1e-12)


def test_markers_draw_what_is_placed(file):
    shown = by_topic(file)["/people/settled/markers"]
    joints, bones = shown[1].markers[2:]
    assert (joints.ns, joints.id, joints.type, len(joints.points)) == ("joints", 12, 7, 24)
    # 24 bones are drawn; that of the wrist which is not placed is left out.
    assert (bones.type, len(bones.points)) == (5, 2 * 23)


def test_detections_are_read_as_lines_are(tmp_path, five_cameras):
    flat = np.concatenate([np.full((25, 2), 300.0), np.full((25, 1), 0.8)], axis=1).ravel().tolist()
    name = five_cameras.names[1]
    with (tmp_path / "seen.mcap").open("wb") as stream, McapWriter(stream, None) as writer:
        writer.detections(name, [flat], 12.5, five_cameras)
        writer.detections(name, [], 12.6, five_cameras)
    first, second = read_views(tmp_path / "seen.mcap", five_cameras, BODY_25, print)
    assert (first[0], first[2]) == (name, 12.5) and len(first[1]) == 25 and len(second[1]) == 0


def test_a_damaged_file_is_refused_in_one_sentence(tmp_path, file, five_cameras):
    whole = file.read_bytes()
    with pytest.raises(InputError, match="there are no detections in it"):
        list(read_views(file, five_cameras, BODY_25, print))
    rng, damaged = np.random.default_rng(0), tmp_path / "damaged.mcap"
    for _ in range(60):
        spoiled = bytearray(whole[: rng.integers(0, len(whole))])
        for place in rng.integers(0, max(len(spoiled), 1), 5).tolist():
            spoiled[place : place + 1] = bytes([rng.integers(0, 256)])
        damaged.write_bytes(bytes(spoiled))
        with pytest.raises(InputError, match=r"damaged\.mcap: "):
            list(read_views(damaged, five_cameras, BODY_25, print))


@pytest.mark.parametrize("how", ["zstd", "lz4", ""])
def test_a_chunk_that_claims_more_memory_than_it_may_is_not_unpacked(tmp_path, five_cameras, how):
    """The frame itself says its size, and a chunk says it beside: either is refused; 80 MB of zeros
    are 8 kB.
    """
    import lz4.frame
    import zstandard
    from mcap.data_stream import RecordBuilder
    from mcap.records import Chunk

    zeros = bytes(80 * 2**20)
    packed = {"zstd": zstandard.compress, "lz4": lz4.frame.compress}.get(
        how, lambda data: data[:100]
    )(zeros)
    for claimed in (100, len(zeros)):
        if how == "" and claimed == 100:
            continue  # it is as long as it says
        records = RecordBuilder()
        Chunk(how, packed, 0, 0, 0, claimed).write(records)
        (tmp_path / "bomb.mcap").write_bytes(b"\x89MCAP0\r\n" + records.end())
        tracemalloc.start()
        with pytest.raises(
            InputError, match=r"bomb\.mcap: cannot be read \(ValueError: a chunk claims 83886080 "
        ):
            list(read_views(tmp_path / "bomb.mcap", five_cameras, BODY_25, print))
        assert tracemalloc.get_traced_memory()[1] < 2**24
        tracemalloc.stop()


def test_a_second_reader_with_definitions_of_its_own_agrees(file, people):
    """`rosbags` has ROS's own message files and its own decoder; those of others are the file's."""
    reading = pytest.importorskip("rosbags.highlevel", reason="needs pip install rosbags")
    with reading.AnyReader([file]) as reader:
        counts: dict[str, int] = {}
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            counts[connection.msgtype] = counts.get(connection.msgtype, 0) + 1
            if (
                connection.msgtype == "shapepose_msgs/msg/People"
                and counts[connection.msgtype] == 1
            ):
                np.testing.assert_array_equal(
                    message.people[1].covariance, people.covariance[1].ravel()
                )
            if connection.msgtype == "visualization_msgs/msg/MarkerArray":
                assert message.markers[0].mesh_use_embedded_materials is False
            if connection.topic == "/humans/bodies/tracked":
                assert set(message.ids) <= {"p3", "p12"}
        assert (
            counts["tf2_msgs/msg/TFMessage"] == T + 1 and counts["sensor_msgs/msg/CameraInfo"] == 5
        )
        assert counts["hri_msgs/msg/IdsList"] == T
        assert counts["sensor_msgs/msg/JointState"] == 2 * T - 1  # one body is not known
