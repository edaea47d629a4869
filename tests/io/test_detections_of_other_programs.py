"""Detections as MediaPipe's, DeepLabCut's, SLEAP's, YOLO's and others write them: the same people
in all.
"""

import json
import os
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import SKELETONS
from shapepose_fg.io.detections import read_detections
from shapepose_fg.io.lenses import lenses_of

COCO = SKELETONS["COCO_17"]
FRAMES = 6
NAMES: tuple[str, ...] = tuple(
    (
        "nose left_eye right_eye left_ear right_ear left_shoulder right_shoulder left_elbow "
        "right_elbow left_wrist right_wrist left_hip right_hip left_knee right_knee left_ankle "
        "right_ankle"
    ).split()
)


@pytest.fixture
def rig(five_cameras) -> Rig:
    return five_cameras.only(five_cameras.names[:2])


def random_people(seed: int, size: tuple[int, int]) -> np.ndarray:
    """(V, T, 2, 17, 3) two people before each camera; nobody in frame 2, one person in frame 3, a
    joint unseen.
    """
    rng, (width, height) = np.random.default_rng(seed), size
    xy = rng.uniform([100, 100], [width - 100, height - 100], (2, FRAMES, 2, 17, 2)).round(1)
    found = np.concatenate([xy, rng.uniform(0.6, 1.0, (*xy.shape[:-1], 1)).round(2)], axis=-1)
    found[:, 2] = np.nan
    found[:, 3, 1] = np.nan
    found[:, :, 0, 9] = np.nan
    return found


@pytest.fixture
def people(rig) -> np.ndarray:
    return random_people(0, rig.cameras[0].image_size)


def person_lists(people: np.ndarray) -> list[list[np.ndarray]]:
    """(T,) the people that are there, unseen joints 0 0 0."""
    return [[np.nan_to_num(one) for one in frame if np.isfinite(one).any()] for frame in people]


def openpifpaf(folder: Path, name: str, people: np.ndarray, _: object) -> None:
    (folder / name).mkdir()
    for t, frame in enumerate(person_lists(people)):
        content = [
            {
                "keypoints": one.ravel().tolist(),
                "bbox": [0, 0, 9, 9],
                "score": 0.9,
                "category_id": 1,
            }
            for one in frame
        ]
        (folder / name / f"img_{t:05d}.jpg.predictions.json").write_text(json.dumps(content))


def openpifpaf_video(folder: Path, name: str, people: np.ndarray, _: object) -> None:
    lines = [
        json.dumps(
            {
                "frame": t,
                "predictions": [{"keypoints": one.ravel().tolist(), "score": 0.9} for one in frame],
            }
        )
        for t, frame in enumerate(person_lists(people))
    ]
    (folder / f"{name}.json").write_text("\n".join(lines) + "\n")


def ultralytics_json(folder: Path, name: str, people: np.ndarray, _: object) -> None:
    (folder / name).mkdir()
    for t, frame in enumerate(person_lists(people)):
        content = [
            {
                "name": "person",
                "class": 0,
                "confidence": 0.9,
                "box": {"x1": 0.0, "y1": 0.0, "x2": 9.0, "y2": 9.0},
                "keypoints": dict(zip(("x", "y", "visible"), one.T.tolist(), strict=True)),
            }
            for one in frame
        ]
        (folder / name / f"{t}.json").write_text(json.dumps(content))


def yolo(folder: Path, name: str, people: np.ndarray, size: tuple[int, int]) -> None:
    """With the box's confidence and a track's number; frames without people have no file."""
    (folder / name / "labels").mkdir(parents=True)
    for t, frame in enumerate(person_lists(people)):
        rows = [
            " ".join(
                f"{number:g}"
                for number in (0, 0.5, 0.5, 0.2, 0.2, *(one / (*size, 1)).ravel().round(7), 0.9, 3)
            )
            for one in frame
        ]
        if rows:
            (folder / name / "labels" / f"clip_{t}.txt").write_text("\n".join(rows) + "\n")


def sleap(
    folder: Path, name: str, people: np.ndarray, _: object, *, standard: bool = False
) -> None:
    h5py = pytest.importorskip("h5py", reason="an extra")
    with h5py.File(folder / f"{name}.analysis.h5", "w") as file:
        xy, score = people[..., :2], people[..., 2]
        # (frames, tracks, nodes, 2), or what MATLAB reads so.
        tracks = file.create_dataset(
            "tracks", data=xy if standard else xy.transpose(1, 3, 2, 0), compression="gzip"
        )
        scores = file.create_dataset(
            "point_scores", data=score if standard else score.transpose(1, 2, 0)
        )
        if standard:
            tracks.attrs["dims"] = json.dumps(["frame", "track", "node", "xy"])
            scores.attrs["dims"] = json.dumps(["frame", "track", "node"])
        file.create_dataset("node_names", data=[each.encode() for each in NAMES])
        file.create_dataset("track_occupancy", data=np.isfinite(xy).any(axis=(2, 3)))
        file.create_dataset("track_names", data=[b"a", b"b"])


def sleap_standard(folder: Path, name: str, people: np.ndarray, size: object) -> None:
    sleap(folder, name, people, size, standard=True)


def deeplabcut(folder: Path, name: str, people: np.ndarray, _: object) -> None:
    """Several animals, and parts of the cage."""
    heads = [["scorer"], ["individuals"], ["bodyparts"], ["coords"]]
    for one in ("one", "two"):
        for part in NAMES:
            for axis in ("x", "y", "likelihood"):
                for head, word in zip(heads, ("DLC_resnet50", one, part, axis), strict=True):
                    head.append(word)
    for axis in ("x", "y", "likelihood"):
        for head, word in zip(heads, ("DLC_resnet50", "single", "corner", axis), strict=True):
            head.append(word)
    rows = [
        [str(t), *("" if np.isnan(each) else f"{each:g}" for each in frame.ravel()), "5", "5", "1"]
        for t, frame in enumerate(people)
    ]
    text = "\n".join(",".join(row) for row in [*heads, *rows]) + "\n"
    (folder / f"walk_{name}DLC_resnet50_walkMay3shuffle1_100000.csv").write_text(text)


def deeplabcut_hdf5(folder: Path, name: str, people: np.ndarray, _: object) -> None:
    """As pandas writes a table: names of columns as a pickle, a part of the cage in a block of its
    own.
    """
    h5py = pytest.importorskip("h5py", reason="an extra")
    axes = ("x", "y", "likelihood")
    columns = [
        ("DLC_resnet50", one, part, axis)
        for one in ("one", "two")
        for part in NAMES
        for axis in axes
    ]
    kind = [
        ("index", "<i8"),
        ("values_block_0", "<f8", (len(columns),)),
        ("values_block_1", "<i8", (1,)),
    ]
    rows = np.zeros(len(people), dtype=kind)
    rows["index"], rows["values_block_0"] = np.arange(len(people)), people.reshape(len(people), -1)
    with h5py.File(folder / f"walk_{name}DLC_resnet50_walkMay3shuffle1_100000.h5", "w") as file:
        table = file.create_dataset("df_with_missing/table", data=rows, chunks=(4,))
        for block, own in enumerate((columns, [("DLC_resnet50", "single", "corner", "x")])):
            table.attrs[f"values_block_{block}_kind"] = np.bytes_(pickle.dumps(own, 0))


PEOPLE = [
    openpifpaf,
    openpifpaf_video,
    ultralytics_json,
    yolo,
    sleap,
    sleap_standard,
    deeplabcut,
    deeplabcut_hdf5,
]
"""Write several people of one camera."""


def alphapose_people(people: np.ndarray) -> np.ndarray:
    """COCO's 17 in OpenPose's order of 18, as AlphaPose makes it: the neck in the middle of the
    shoulders.
    """
    order = [0, 17, 6, 8, 10, 5, 7, 9, 12, 14, 16, 11, 13, 15, 2, 1, 4, 3]
    neck = people[..., [5, 6], :].mean(axis=-2, keepdims=True)
    return np.concatenate([people, neck], axis=-2)[..., order, :]


@pytest.mark.parametrize("write", PEOPLE, ids=lambda each: each.__name__)
def test_the_same_people_come_of_every_program(write, rig, people, tmp_path):
    for name, own, camera in zip(rig.names, people, rig.cameras, strict=True):
        write(tmp_path, name, own, camera.image_size)
    table = read_detections(tmp_path, rig)
    assert {*COCO.joints} <= {*table.skeleton.joints}, "names of joints, or their number"
    assert len(table) == FRAMES
    for t in range(FRAMES):
        for view, camera in enumerate(rig.cameras):
            there = [one for one in people[view, t] if np.isfinite(one).any()]
            for joint, name in enumerate(COCO.joints[:17]):
                own = (table[t].view == view) & (
                    table[t].joint == table.skeleton.joints.index(name)
                )
                expected = [one[joint] for one in there if np.isfinite(one[joint]).all()]
                assert own.sum() == len(expected), (t, view, name)
                if expected:
                    xy = camera.undistort(np.array(expected)[:, :2])
                    gap = np.linalg.norm(table[t].xy[own][:, None] - xy[None], axis=2)
                    assert gap.min(axis=0).max() < 0.01
                    np.testing.assert_allclose(
                        np.sort(table[t].confidence[own]),
                        np.sort(np.array(expected)[:, 2]),
                        atol=1e-6,
                    )


def alphapose(
    folder: Path, rig: Rig, people: np.ndarray, key: str = "bodies", *, separate: bool = False
) -> None:
    """By `--format open` (people) or cmu (bodies): one file, and one for each picture."""
    inner = "pose_keypoints_2d" if key == "people" else "joints"
    for name, own in zip(rig.names, people, strict=True):
        frames = {
            f"{t:04d}.jpg": {
                "version": "AlphaPose v0.3",
                key: [{inner: alphapose_people(one).ravel().tolist()} for one in frame],
            }
            for t, frame in enumerate(person_lists(own))
            if len(frame) > 0
        }
        place = folder / name
        place.mkdir()
        (place / "alphapose-results.json").write_text(json.dumps(frames))
        if separate:
            (place / "sep-json").mkdir()
            for picture, frame in frames.items():
                (place / "sep-json" / f"{picture[:-4]}.json").write_text(json.dumps(frame))


@pytest.mark.parametrize("key", ["people", "bodies"])
@pytest.mark.parametrize("separate", [True, False])
def test_alphapose_s_other_formats(key, separate, rig, people, tmp_path):
    alphapose(tmp_path, rig, people, key, separate=separate)
    table = read_detections(tmp_path, rig)
    assert table.skeleton.name == "COCO_18" and len(table) == FRAMES
    left = table.skeleton.joints.index("LElbow")
    found = table[0].xy[(table[0].view == 0) & (table[0].joint == left)]
    xy = rig.cameras[0].undistort(people[0, 0, :, NAMES.index("left_elbow"), :2])
    assert np.linalg.norm(found[:, None] - xy[None], axis=2).min(axis=0).max() < 0.01


def mediapipe(people: np.ndarray, points: int) -> np.ndarray:
    """(V, T, points, 2) the first person's joints where MediaPipe has them, the others at 50 50."""
    place = [0, 2, 5, 7, 8, 11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28]
    found = np.full((2, FRAMES, points, 2), 50.0)
    found[:, :, place] = people[:, :, 0, :, :2]
    found[np.isnan(people[:, :, 0, :, :2]).all(axis=(2, 3))] = np.nan
    return found


def same_as_mediapipe(table, people: np.ndarray, rig: Rig) -> None:
    assert len(table) == FRAMES and table.skeleton.name == "BLAZEPOSE_33"
    for t in (0, 1, 4):
        for view, camera in enumerate(rig.cameras):
            for name, joint in (
                ("Nose", "nose"),
                ("LKnee", "left_knee"),
                ("RWrist", "right_wrist"),
            ):
                own = (table[t].view == view) & (
                    table[t].joint == table.skeleton.joints.index(name)
                )
                xy = camera.undistort(people[view, t, :1, NAMES.index(joint), :2])
                np.testing.assert_allclose(table[t].xy[own], xy, atol=0.01)
    assert len(table[2]) == 0


@pytest.mark.parametrize(("points", "depth"), [(33, False), (553, True)])
def test_freemocap_s_array_of_all_cameras(points, depth, rig, people, tmp_path):
    """Hands and face follow the body; a third number is MediaPipe's depth, which is no score."""
    found = mediapipe(people, points)
    if depth:
        found = np.concatenate(
            [found, np.random.default_rng(1).normal(0, 200, (*found.shape[:3], 1))], axis=3
        )
    file = tmp_path / "mediapipe_2dData_numCams_numFrames_numTrackedPoints_pixelXY.npy"
    np.save(file, found)
    for place in (tmp_path, file):
        table = read_detections(place, rig)
        same_as_mediapipe(table, people, rig)
    assert (table[0].confidence == 1).all()


def caliscope(folder: Path, rig: Rig, people: np.ndarray) -> None:
    """One person's body, and a point of a hand."""
    found = mediapipe(people, 33)
    lines = [
        "sync_index,port,frame_index,frame_time,point_id,img_loc_x,img_loc_y,obj_loc_x,obj_loc_y"
    ]
    for view in range(2):
        for t in range(FRAMES):
            if np.isfinite(found[view, t]).any():
                lines += [
                    f"{t},{view},{t},{100 + t / 30},{point},{x},{y},,"
                    for point, (x, y) in enumerate(
                        np.where(np.isnan(found[view, t]), 50, found[view, t]).tolist()
                    )
                ]
                lines.append(f"{t},{view},{t},{100 + t / 30},201,7,7,,")
    (folder / "xy_POSE.csv").write_text("\n".join(lines) + "\n")


def test_caliscope_s_points_of_all_cameras(rig, people, tmp_path):
    caliscope(tmp_path, rig, people)
    named = Rig(
        tuple(replace(camera, name=f"cam_{n}") for n, camera in enumerate(rig.cameras)), "z"
    )
    same_as_mediapipe(read_detections(tmp_path, named), people, named)


def freemocap(folder: Path, rig: Rig, people: np.ndarray) -> None:
    np.save(folder / "mediaPipeData_2d.npy", mediapipe(people, 33))


def _each(write):
    def all_cameras(folder: Path, rig: Rig, people: np.ndarray) -> None:
        for name, own, camera in zip(rig.names, people, rig.cameras, strict=True):
            write(folder, name, own, camera.image_size)

    return all_cameras


WRITERS = {each.__name__: _each(each) for each in PEOPLE} | {
    each.__name__: each for each in (alphapose, freemocap, caliscope)
}
"""Write all people of a recording, for other tests."""


@pytest.mark.parametrize("program", WRITERS)
def test_cameras_without_a_calibration_are_found_by_their_files(program, rig, people, tmp_path):
    WRITERS[program](tmp_path, rig, people)
    found = lenses_of(tmp_path, ["65"], rig.cameras[0].image_size)
    table = read_detections(tmp_path, found)
    assert [len(np.unique(each.view)) for each in (table[0], table[2])] == [2, 0]


REFUSED = [
    ("a.npz", b"PK\x03\x04", "a NumPy archive, which has no standard layout; convert"),
    ("a.mat", b"MATLAB 5.0", "a MATLAB file, which has no standard layout; convert"),
    ("a.pkl", b"\x80\x04", "a Python pickle, which could run code and is not opened; convert"),
    (
        "a.slp",
        b"\x89HDF\r\n\x1a\n",
        r"a SLEAP project; export the analysis HDF5: sio export FILE\.slp",
    ),
    ("mediapipe_body_3d_xyz.csv", b"frame,x,y,z\n", "FreeMoCap's table of 3D points.*pixelXY"),
    ("a.npy", b"\x93NUMPY", "a NumPy array, of which only FreeMoCap's"),
]


@pytest.mark.parametrize(("name", "content", "says"), REFUSED)
def test_what_cannot_be_read_is_named_with_the_way_to_bring_it(name, content, says, rig, tmp_path):
    (tmp_path / name).write_bytes(content)
    for place in (tmp_path, tmp_path / name):
        with pytest.raises(InputError, match=says):
            read_detections(place, rig)


def test_arrays_that_could_run_code_or_read_elsewhere_are_not_opened(rig, tmp_path):
    h5py = pytest.importorskip("h5py", reason="an extra")
    file = tmp_path / "mediaPipeData_2d.npy"
    np.save(file, np.array([[[[print]]]], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="holds Python objects"):
        read_detections(file, rig)
    np.save(file, np.zeros((3, 4, 33, 2)))
    with pytest.raises(InputError, match="has 3 cameras, but 2 are expected"):
        read_detections(file, rig)
    content = file.read_bytes()
    file.write_bytes(content.replace(b"(3, 4, 33, 2)", b"(2, 9, 99, 2)"))
    with pytest.raises(InputError, match="ends too early"):
        read_detections(file, rig)
    file.unlink()
    for name in rig.names:
        with h5py.File(tmp_path / "secret.hdf", "w") as secret:
            secret["tracks"] = np.zeros((1, 2, 17, 3))
        with h5py.File(tmp_path / f"{name}.h5", "w") as damaged:
            damaged["tracks"] = h5py.ExternalLink(str(tmp_path / "secret.hdf"), "tracks")
            damaged["node_names"] = [each.encode() for each in NAMES]
    with pytest.raises(
        InputError, match="only SLEAP's analysis files and DeepLabCut's tables are supported"
    ):
        read_detections(tmp_path, rig)
    for name in rig.names:
        (tmp_path / f"{name}.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(range(256)) * 8)
    with pytest.raises(InputError, match="damaged HDF5"):
        read_detections(tmp_path, rig)
    for name in rig.names:
        with h5py.File(tmp_path / f"{name}.h5", "w") as huge:
            huge.create_dataset(
                "tracks", shape=(10**5, 2, 17, 10**5), dtype="f8", chunks=(1, 2, 17, 100)
            )
            huge["node_names"] = [each.encode() for each in NAMES]
    with pytest.raises(InputError, match="are too large"):
        read_detections(tmp_path, rig)


class Harmful:
    def __reduce__(self):
        return os.mkdir, ("harm",)


def test_names_of_columns_are_read_without_carrying_out_their_pickle(
    rig, people, tmp_path, monkeypatch
):
    h5py = pytest.importorskip("h5py", reason="an extra")
    monkeypatch.chdir(tmp_path)
    for kind, says in (
        (pickle.dumps([Harmful()], 0), "is not a list of names: GLOBAL"),
        (pickle.dumps([("s", "nose", "x")], 4), "is not a list of names"),
        (b"(lp0\nVa\n", "damaged HDF5"),
        (b"g7\n.", "damaged HDF5"),
        (b"(l(Va\nta.", "only SLEAP's analysis files and"),
        (
            pickle.dumps([("s", "nose", "x"), ("s", "nose", "y")], 0),
            "its columns do not match their names",
        ),
    ):
        for name, own in zip(rig.names, people, strict=True):
            deeplabcut_hdf5(tmp_path, name, own, None)
        for file in tmp_path.glob("*.h5"):
            with h5py.File(file, "r+") as opened:
                opened["df_with_missing/table"].attrs["values_block_0_kind"] = np.bytes_(kind)
        with pytest.raises(InputError, match=says):
            read_detections(tmp_path, rig)
    assert not (tmp_path / "harm").exists()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("scorer,a,a\nbodyparts,nose,nose\n", "no rows bodyparts and coords"),
        (
            "scorer,a,a\nbodyparts,nose,nose\ncoords,x,likelihood\n0,1,2\n",
            "must have the columns x and y",
        ),
        ("scorer,a,a\nbodyparts,nose,nose\ncoords,x,y\n0,1\n", "line 4 must hold 3 fields, got 2"),
        (
            "scorer,a,a\nbodyparts,nose,nose\ncoords,x,y\n0,1,b\n",
            "line 4 must hold numbers, got 'b'",
        ),
        (
            "scorer,a,a\nbodyparts,nose,nose\ncoords,x,y\n1,1,2\n1,1,2\n",
            "line 5: frame numbers must increase",
        ),
        ("scorer,a,a\nbodyparts,nose,nose\ncoords,x,y\n", "no frames"),
    ],
)
def test_damaged_csv_is_named_by_its_line(text, says, rig, tmp_path):
    for name in rig.names:
        (tmp_path / f"{name}.csv").write_text(text)
    with pytest.raises(InputError, match=says):
        read_detections(tmp_path, rig)


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("0 0.5 0.5 0.2 0.2", "has a box but no keypoints"),
        ("0 0.5 0.5 0.2 0.2 " + "512 0.5 0.9 " * 17, "fractions of the picture"),
        ("0 0.5 0.5 0.2 0.2 " + "a b c " * 17, "must hold numbers"),
    ],
)
def test_labels_that_are_no_poses(line, says, rig, tmp_path):
    for name in rig.names:
        (tmp_path / name / "labels").mkdir(parents=True)
        (tmp_path / name / "labels" / "clip_1.txt").write_text(line + "\n")
    with pytest.raises(InputError, match=says):
        read_detections(tmp_path, rig)
