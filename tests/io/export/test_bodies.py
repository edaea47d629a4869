"""Bodies in AMASS npz, BVH and GLB: what the files say, put together anew, is the body model's to 1
mm.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.core.skeleton import SMPL_24
from shapepose_fg.core.world_axes import y_up
from shapepose_fg.io.export.glb import influences, write_glb
from shapepose_fg.io.export.motion_files import write_amass, write_bvh
from shapepose_fg.io.export.registry import Job, read_take
from shapepose_fg.io.export.rerun_app import write_rrd
from shapepose_fg.io.export.skinned import motion_of
from shapepose_fg.io.export.take import Take

from .conftest import AWAY, BARE, FIRST, FPS, FRAMES

MM = 1e-3


@pytest.fixture(scope="module")
def job(saved, tmp_path_factory) -> Job:
    return Job(read_take(saved), tmp_path_factory.mktemp("bodies"))


# AMASS


def test_amass_posed_by_the_body_model_stands_where_it_stood(job, true_bodies):
    written = write_amass(job)
    names = [path.name.removesuffix("_amass.npz") for path in written.files]
    # The hole of one frame without a body is filled, the eight frames out of sight are not.
    assert names == [
        "person_3_frames_100-123",
        "person_7_frames_100-107",
        "person_7_frames_116-123",
    ]
    assert any("betas are those of the built-in body" in note for note in written.notes)
    body = BodyModel.default()
    for path in written.files:
        with np.load(path, allow_pickle=False) as file:
            data = {name: file[name] for name in file.files}
        T = len(data["trans"])
        assert data["poses"].shape == (T, 156) and data["betas"].shape == (16,)
        assert data["mocap_framerate"] == data["mocap_frame_rate"] == FPS
        assert str(data["gender"]) == "neutral" and str(data["body"]) == "shapepose-fg open body"
        np.testing.assert_array_equal(data["poses"][:, :66], data["poses_smpl"][:, :66])
        assert not data["poses"][:, 66:].any()
        pose = data["poses_smpl"].reshape(T, 24, 3)
        parts = (np.tile(data["betas"][:10], (T, 1)), pose[:, 0], pose[:, 1:], data["trans"])
        joints = body.joints(BodyParameters(*(part.copy() for part in parts)))
        for index, frame in enumerate(data["frames"].tolist()):
            assert bool(data["filled"][index]) == (frame == BARE and "person_7" in path.name)
            if not data["filled"][index]:
                truly, _ = true_bodies(int(path.name[7]), frame)
                np.testing.assert_allclose(joints[index], truly, atol=1e-6)
        np.testing.assert_allclose(data["times"], data["frames"] / FPS)


def test_amass_is_z_up_whatever_the_world_is(result, tmp_path, true_bodies):
    """The same people in a world whose y points down: heads are above feet along z."""
    written = write_amass(Job(Take.of(result, "-y"), tmp_path))
    body = BodyModel.default()
    with np.load(written.files[0]) as file:
        pose = file["poses_smpl"][:1].reshape(1, 24, 3)
        parts = (file["betas"][None, :10], pose[:, 0], pose[:, 1:], file["trans"][:1])
    joints = body.joints(BodyParameters(*(part.copy() for part in parts)))[0]
    truly, _ = true_bodies(3, FIRST)
    np.testing.assert_allclose(
        joints, np.stack([truly[:, 0], truly[:, 2], -truly[:, 1]], axis=1), atol=1e-6
    )


@pytest.mark.parametrize("seconds", [0.0, 1.0])
def test_how_long_holes_are_filled_is_an_option(saved, tmp_path, seconds):
    written = write_amass(Job(read_take(saved, persons=(7,)), tmp_path, fill_gaps_s=seconds))
    spans = [path.name.split("_")[3] for path in written.files]
    assert spans == (["100-123"] if seconds else ["100-102", "104-107", "116-123"])


# BVH


def read_bvh(path):
    """A BVH file: joints with parent, offset and channels; end sites; frames (F, C); frame time."""
    words = iter(path.read_text().split())
    joints, ends, stack = [], [], []
    for word in words:
        if word in ("ROOT", "JOINT"):
            joints.append({"name": next(words), "parent": stack[-1] if stack else None})
            assert next(words) == "{"
            stack.append(len(joints) - 1)
        elif word == "End":
            assert [next(words) for _ in range(3)] == ["Site", "{", "OFFSET"]
            ends.append((stack[-1], [float(next(words)) for _ in range(3)]))
            assert next(words) == "}"
        elif word == "OFFSET":
            joints[stack[-1]]["offset"] = np.array([float(next(words)) for _ in range(3)])
        elif word == "CHANNELS":
            joints[stack[-1]]["channels"] = [next(words) for _ in range(int(next(words)))]
        elif word == "}":
            stack.pop()
        elif word == "MOTION":
            break
    assert [next(words) for _ in range(1)] == ["Frames:"]
    count = int(next(words))
    assert [next(words), next(words)] == ["Frame", "Time:"]
    step = float(next(words))
    return joints, ends, np.array(list(words), dtype=float).reshape(count, -1), step


def bvh_places(joints, frames) -> dict[str, np.ndarray]:
    """(F, 3) of each joint: rotations about the channels' axes, one after the other, and
    offsets.
    """
    at, turns, places = 0, [], []
    for joint in joints:
        values = dict(
            zip(joint["channels"], frames[:, at : at + len(joint["channels"])].T, strict=True)
        )
        at += len(joint["channels"])
        order = [name for name in joint["channels"] if name.endswith("rotation")]
        angles = np.stack([values[name] for name in order], axis=1)
        turn = Rotation.from_euler("".join(name[0] for name in order), angles, degrees=True)
        move = [values.get(f"{axis}position", np.zeros(len(frames))) for axis in "XYZ"]
        place = joint["offset"] + np.stack(move, axis=1)
        if joint["parent"] is not None:
            place = places[joint["parent"]] + turns[joint["parent"]].apply(place)
            turn = turns[joint["parent"]] * turn
        turns.append(turn)
        places.append(place)
    assert at == frames.shape[1]
    return {joint["name"]: place for joint, place in zip(joints, places, strict=True)}


def test_bvh_put_together_is_the_body(job, true_bodies):
    written = write_bvh(job)
    assert [path.stem for path in written.files] == [
        "person_3_frames_100-123", "person_7_frames_100-107", "person_7_frames_116-123",
    ]  # fmt: skip
    for path in written.files:
        joints, ends, frames, step = read_bvh(path)
        assert step == pytest.approx(1 / FPS)
        assert {joint["name"] for joint in joints} == set(SMPL_24) and len(ends) == 5
        assert joints[0]["offset"].tolist() == [0, 0, 0]  # programs differ in whether they add it
        places = bvh_places(joints, frames)
        first = int(path.stem.split("_")[3].split("-")[0])
        for index in range(len(frames)):
            if (path.stem[7], first + index) == ("7", BARE):
                continue
            truly, _ = true_bodies(int(path.stem[7]), first + index)
            got = np.stack([places[name][index] for name in SMPL_24])
            assert np.abs(got - truly @ y_up("z").T).max() < 0.1 * MM


def test_bones_end_where_the_body_ends(job, arrays):
    """The tip of the head is its top; those of hands and feet lie in them."""
    _, ends, _, _ = read_bvh(write_bvh(job).files[0])
    lengths = sorted(float(np.linalg.norm(offset)) for _, offset in ends)
    assert lengths[-1] == pytest.approx(0.19, abs=0.06)
    assert lengths[0] > 0.02


def test_angles_do_not_jump_by_full_turns(result, tmp_path):
    """A person who spins: 40 degrees a frame about the vertical axis, through 180 and 360."""
    alone = result.rows(result.person == 3)
    turn = Rotation.from_rotvec(np.arange(FRAMES)[:, None] * np.radians(40) * np.array([0, 0, 1.0]))
    spinning = replace(
        alone, global_orient=(turn * Rotation.from_euler("x", 90, degrees=True)).as_rotvec()
    )
    _, _, frames, _ = read_bvh(write_bvh(Job(Take.of(spinning, "z"), tmp_path)).files[0])
    assert np.abs(np.diff(frames[:, 3:6], axis=0)).max() < 41


# GLB


class Glb:
    """A GLB file as a program that follows the specification draws it."""

    def __init__(self, path):
        pygltflib = pytest.importorskip("pygltflib")
        self.file = pygltflib.GLTF2().load_binary(str(path))
        self.blob = self.file.binary_blob()

    def array(self, number: int) -> np.ndarray:
        accessor = self.file.accessors[number]
        view = self.file.bufferViews[accessor.bufferView]
        kind = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}[
            accessor.componentType
        ]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor.type]
        flat = np.frombuffer(self.blob, kind, accessor.count * width, view.byteOffset)
        if accessor.type == "MAT4":
            return flat.reshape(-1, 4, 4).swapaxes(1, 2)
        return flat.reshape(-1, width) if width > 1 else flat

    def node(self, name: str) -> int:
        return next(index for index, node in enumerate(self.file.nodes) if node.name == name)

    def posed(self, time: float) -> list[np.ndarray]:
        """(4, 4) world from node, of all nodes."""
        still = {"translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]}
        values = {
            index: {name: getattr(node, name) or none for name, none in still.items()}
            for index, node in enumerate(self.file.nodes)
        }
        (animation,) = self.file.animations
        for channel in animation.channels:
            sampler = animation.samplers[channel.sampler]
            times, output = self.array(sampler.input), self.array(sampler.output)
            key = int(
                np.clip(np.searchsorted(times, time + 1e-4, side="right") - 1, 0, len(times) - 1)
            )
            values[channel.target.node][channel.target.path] = output[key]
        local = []
        for value in values.values():
            matrix = np.eye(4)
            matrix[:3, :3] = Rotation.from_quat(value["rotation"]).as_matrix() * np.array(
                value["scale"]
            )
            matrix[:3, 3] = value["translation"]
            local.append(matrix)
        world = list(local)
        for index, node in enumerate(self.file.nodes):  # parents come first
            for child in node.children or []:
                world[child] = world[index] @ local[child]
        return world

    def skin(self, person: str, time: float, sets: int = 2) -> np.ndarray:
        """(Nv, 3) the skin of a person."""
        node = self.file.nodes[self.node(f"{person}_skin")]
        skin = self.file.skins[node.skin]
        attributes = self.file.meshes[node.mesh].primitives[0].attributes
        world = self.posed(time)
        bones = np.stack([world[joint] for joint in skin.joints]) @ self.array(
            skin.inverseBindMatrices
        )
        rest = np.c_[self.array(attributes.POSITION), np.ones(len(self.array(attributes.POSITION)))]
        total = np.zeros((len(rest), 4))
        sum_of_weights = np.zeros((len(rest), 1))
        for number in range(sets):
            joints, weights = (
                self.array(getattr(attributes, f"{name}_{number}"))
                for name in ("JOINTS", "WEIGHTS")
            )
            total += np.einsum("vi,vixy,vy->vx", weights, bones[joints], rest)
            sum_of_weights += weights.sum(axis=1, keepdims=True)
        return (total / sum_of_weights)[:, :3]


@pytest.fixture(scope="module")
def glb(job) -> Glb:
    written = write_glb(job)
    assert [path.name for path in written.files] == ["people.glb"]
    return Glb(written.files[0])


@pytest.mark.parametrize(("person", "frame"), [(3, 100), (3, 111), (3, 123), (7, 102), (7, 123)])
def test_glb_drawn_by_the_specification_is_the_body(glb, true_bodies, person, frame):
    joints, vertices = true_bodies(person, frame)
    time = (frame - FIRST) / FPS
    world = glb.posed(time)
    names = [f"person_{person}_{name}" for name in SMPL_24]
    places = np.stack([world[glb.node(name)][:3, 3] for name in names])
    np.testing.assert_allclose(places, joints @ y_up("z").T, atol=0.01 * MM)
    np.testing.assert_allclose(
        glb.skin(f"person_{person}", time), vertices @ y_up("z").T, atol=0.01 * MM
    )


def test_glb_keeps_millimetres_far_from_the_origin(job, true_bodies, tmp_path):
    place = np.array([400_000.0, -150_000.25, 1200.5])
    people = job.take.people
    away = replace(people, joints=people.joints + place, transl=people.transl + place)
    written = write_glb(replace(job, take=replace(job.take, people=away), folder=tmp_path))
    (note,) = [each for each in written.notes if "coordinates are relative to" in each]
    far = Glb(written.files[0])
    origin = np.array(far.file.scenes[0].extras["origin_m"])
    assert " ".join(f"{each:.0f}" for each in origin) in note
    _, vertices = true_bodies(3, FIRST + 4)
    truth = (vertices + place) @ y_up("z").T
    np.testing.assert_allclose(far.skin("person_3", 4 / FPS) + origin, truth, atol=0.1 * MM)


def test_programs_that_read_four_bones_a_vertex_draw_nearly_the_same(glb, true_bodies):
    """What README of the format says: 1 in 100 vertices is off by more than 1 mm, none by more than
    2 cm.
    """
    _, vertices = true_bodies(3, 111)
    apart = np.linalg.norm(glb.skin("person_3", 11 / FPS, sets=1) - vertices @ y_up("z").T, axis=1)
    assert np.mean(apart > MM) < 0.015
    assert apart.max() < 20 * MM


def test_who_is_not_there_has_no_size(glb):
    def size(frame: int) -> float:
        return float(np.ptp(glb.skin("person_7", (frame - FIRST) / FPS), axis=0).max())

    assert size(107) > 1 and size(116) > 1
    assert max(size(frame) for frame in (*AWAY, BARE)) == 0
    assert not any(
        c.target.path == "scale" and c.target.node == glb.node("person_3")
        for c in glb.file.animations[0].channels
    )


def test_glb_is_well_formed(glb, arrays):
    file = glb.file
    assert file.asset.version == "2.0" and len(file.skins) == 2
    for number, accessor in enumerate(file.accessors):
        view = file.bufferViews[accessor.bufferView]
        assert view.byteOffset % 4 == 0 and view.byteOffset + view.byteLength <= len(glb.blob)
        if accessor.min:
            np.testing.assert_allclose(glb.array(number).min(axis=0), np.squeeze(accessor.min))
    attributes = file.meshes[0].primitives[0].attributes
    total = glb.array(attributes.WEIGHTS_0).sum(1) + glb.array(attributes.WEIGHTS_1).sum(1)
    np.testing.assert_allclose(total, 1, atol=1e-6)
    normals = glb.array(attributes.NORMAL)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    faces = glb.array(file.meshes[0].primitives[0].indices).reshape(-1, 3)
    np.testing.assert_array_equal(faces, arrays.faces)


def test_influences_of_a_body_with_four_bones_a_vertex_are_one_set():
    weights = np.zeros((3, 24))
    weights[:, :4] = (0.4, 0.3, 0.2, 0.1)
    ((joints, values),) = influences(weights)
    assert joints.tolist() == [[0, 1, 2, 3]] * 3
    np.testing.assert_allclose(values, weights[:, :4], atol=1e-7)


# Bodies themselves


def test_several_shapes_become_one_and_it_is_said_how_far_that_is_off(result, arrays, tmp_path):
    """Two halves of a recording, one standard deviation of stature apart, have one body in a
    file.
    """
    alone = result.rows(result.person == 3)
    betas = alone.betas + np.where(alone.frame[:, None] > 110, 1.0, 0.0) * np.eye(10)[0]
    take = Take.of(replace(alone, betas=betas), "z")
    motion = motion_of(take, 0, arrays, np.eye(3))
    assert motion is not None
    assert 0.01 < motion.spread_m < 0.1
    same = motion_of(Take.of(alone, "z"), 0, arrays, np.eye(3))
    assert same is not None and same.spread_m < 1e-9
    said = (
        "several body shapes; the file has their mean, which moves joints by up to "
        f"{1e3 * motion.spread_m:.0f} mm"
    )
    for write in (write_amass, write_bvh, write_glb):
        assert any(said in note for note in write(Job(take, tmp_path)).notes)
        assert not any(
            "several shapes" in note for note in write(Job(Take.of(alone, "z"), tmp_path)).notes
        )


# rerun


def test_bodies_for_rerun_are_parts_that_stay_near_the_surface(job, true_bodies):
    """Each part has been shaped before, and moved since; who is away has no shape."""
    rerun = pytest.importorskip("rerun")
    (path,) = write_rrd(job).files
    shapes, poses, cleared = {}, {}, set()
    for chunk in rerun.chunk.RrdReader(path).stream():
        for row in chunk.to_record_batch().to_pylist():
            place = chunk.entity_path
            if row.get("Clear:is_recursive") and place == "/world/people/7/body":
                cleared.add(row["frame"])
            if row.get("Mesh3D:vertex_positions") is not None:
                shapes.setdefault(place, {})[row["frame"]] = row["Mesh3D:vertex_positions"]
            if row.get("Transform3D:quaternion") is not None:
                turn, way = row["Transform3D:quaternion"], row["Transform3D:translation"]
                poses.setdefault(place, {})[row["frame"]] = turn[0], way[0]
    parts = [place for place in shapes if place.startswith("/world/people/7/body/")]
    assert len(parts) == len(SMPL_24) and set(parts) <= poses.keys()
    assert AWAY[0] in cleared and BARE in cleared
    for frame in (FIRST, AWAY[0] - 1, AWAY[-1] + 1, BARE + 1, FIRST + FRAMES - 1):
        _, surface = true_bodies(7, frame)
        apart = []
        for place in parts:
            before = max(each for each in shapes[place] if each <= frame)
            assert not any(before < each < frame for each in cleared)
            turn, way = poses[place][frame]
            points = Rotation.from_quat(turn).apply(np.array(shapes[place][before])) + way
            apart.append(cKDTree(surface).query(points)[0])
        assert np.quantile(np.concatenate(apart), 0.9) < 10 * MM
        assert np.concatenate(apart).max() < 60 * MM
    vertices = sum(len(next(iter(shapes[place].values()))) for place in parts)
    logged = sum(len(each) for place in parts for each in shapes[place].values())
    assert logged < 0.8 * vertices * (FRAMES - len(AWAY))
