"""Calibrations of other programs: real files, files written here in their way, and a malformed one
of each.
"""

import json
import pickle
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.io.calibration import read_rig, write_pose2sim, write_rig

DATA = Path(__file__).parent / "data"
NAMES = ("alpha", "beta", "gamma")
FIVE = (-0.2, 0.05, 0.001, -0.002, 0.01)


def camera(
    name: str, turn: tuple[float, float, float], distortion=FIVE, lens="perspective"
) -> Camera:
    R, _ = cv2.Rodrigues(np.array(turn))
    K = np.array([[900.5, 0, 640.25], [0, 905.0, 360.5], [0, 0, 1]])
    return Camera.from_camera_from_world(
        name, K, np.column_stack([R, [0.1, -0.2, 3.5]]), (1280, 720), distortion, lens
    )


TURNS = ((1.2, 0.3, -0.4), (0.9, 1.4, -1.1), (1.0, -1.5, 0.8))
TRUTH = Rig(tuple(camera(name, turn) for name, turn in zip(NAMES, TURNS, strict=True)), "z")
PINHOLE = Rig(tuple(camera(name, turn, ()) for name, turn in zip(NAMES, TURNS, strict=True)), "z")


def assert_same(rig: Rig, truth: Rig, *, atol: float = 1e-9) -> None:
    """The same cameras, in metres and pixels."""
    assert rig.names == truth.names
    np.testing.assert_allclose(rig.cTw, truth.cTw, atol=atol)
    np.testing.assert_allclose(rig.K, truth.K, atol=atol)
    np.testing.assert_array_equal(rig.image_sizes, truth.image_sizes)
    for one, other in zip(rig.cameras, truth.cameras, strict=True):
        assert one.lens == other.lens
        np.testing.assert_allclose(one.distortion, other.distortion, atol=atol)


def refuses(path: Path, *parts: str, **wishes) -> None:
    """Reading `path` gives one line that names it and holds `parts`."""
    with pytest.raises(InputError) as caught:
        read_rig(path, **wishes)
    message = str(caught.value)
    assert message.startswith(str(path)) and "\n" not in message
    for part in parts:
        assert part in message


# Files as each program writes them.


def caliscope(folder: Path) -> Path:
    text = ""
    for number, each in enumerate(TRUTH.cameras):
        text += (
            f"[cameras.{number}]\ncam_id = {number}\nignore = false\nsize = [1280, 720]\n"
            f"matrix = {each.K.tolist()}\ndistortions = {list(FIVE)}\n"
            f"translation = {each.cTw[:, 3].tolist()}\nrotation = {each.cTw[:, :3].tolist()}\n\n"
        )
    return written(folder / "camera_array.toml", text)


def rotation_vector_tables(unit: float, extra: str, metadata: str) -> str:
    text = ""
    for number, each in enumerate(TRUTH.cameras):
        text += (
            f'[cam_{number}]\nname = "{each.name}"\nsize = [ 1280, 720,]\n'
            f"matrix = {each.K.tolist()}\n"
            f"distortions = {list(FIVE)}\n"
            f"rotation = {cv2.Rodrigues(each.cTw[:, :3])[0].ravel().tolist()}\n"
            f"translation = {(each.cTw[:, 3] / unit).tolist()}\n{extra}\n"
        )
    return text + f"[metadata]\n{metadata}\n"


def pose2sim(folder: Path) -> Path:
    text = rotation_vector_tables(1, "fisheye = false\n", "adjusted = false\nerror = 0.0")
    return written(folder / "Calib.toml", text)


def anipose(folder: Path) -> Path:
    return written(
        folder / "calibration.toml",
        rotation_vector_tables(1e-3, "", "adjusted = false\nerror = 0.4"),
    )


def freemocap(folder: Path) -> Path:
    text = rotation_vector_tables(1e-3, "", "charuco_square_size = 58.0")
    return written(folder / "camera_calibration.toml", text)


def qualisys(folder: Path) -> Path:
    rows = ""
    for each in TRUTH.cameras:
        M = np.diag([1, -1, -1]) @ each.cTw[:, :3]
        turn = " ".join(f'r{i + 1}{j + 1}="{float(M[i, j])}"' for i in range(3) for j in range(3))
        x, y, z = (1000 * each.centre).tolist()
        k1, k2, p1, p2, k3 = FIVE
        # The recorded part of the sensor begins 8 pixels from the left and 4 from the top.
        u, v = 64 * (each.K[0, 2] + 8), 64 * (each.K[1, 2] + 4)
        rows += (
            f'<camera active="1" model="Miqus Video" serial="{each.name}"><fov_video left="8" '
            f'top="4" right="1287" bottom="723"/><transform {turn} x="{x}" y="{y}" z="{z}"/>'
            f'<intrinsic focalLengthU="{64 * each.K[0, 0]}" focalLengthV="{64 * each.K[1, 1]}" '
            f'centerPointU="{u}" centerPointV="{v}" radialDistortion1="{k1}" '
            f'radialDistortion2="{k2}" radialDistortion3="{k3}" tangentalDistortion1="{p1}" '
            f'tangentalDistortion2="{p2}"/></camera>\n'
        )
    rows += '<camera active="1" model="Miqus M3" serial="marker"/>'
    return written(
        folder / "Calib.qca.txt",
        f"<?xml version='1.0'?>\n<calibration>\n<cameras>\n{rows}</cameras>\n</calibration>\n",
    )


def quaternion(R: np.ndarray) -> tuple[float, float, float, float]:
    """x y z w of a rotation matrix."""
    turn = cv2.Rodrigues(R)[0].ravel()
    angle = float(np.linalg.norm(turn))
    x, y, z = (np.sin(angle / 2) * turn / angle).tolist()
    return x, y, z, float(np.cos(angle / 2))


def vicon(folder: Path) -> Path:
    rows = ""
    for each in TRUTH.cameras:
        x, y, z = (1000 * each.centre).tolist()
        aspect = float(each.K[0, 0] / each.K[1, 1])
        rows += (
            f'<Camera DEVICEID="{each.name}" SENSOR_SIZE="1280 720" PIXEL_ASPECT_RATIO="{aspect}"'
            ' TYPE="VideoInputDevice:Blackmagic"><KeyFrames><KeyFrame '
            f'FOCAL_LENGTH="{each.K[0, 0]}" '
            f'ORIENTATION="{" ".join(map(repr, quaternion(each.cTw[:, :3])))}" POSITION="{x} {y} '
            f'{z}" PRINCIPAL_POINT="{each.K[0, 2]} {each.K[1, 2]}" VICON_RADIAL="0 0" '
            'VICON_RADIAL2="ViconRadial2 640 360 -0.2 0.05 0.01"/></KeyFrames></Camera>\n'
        )
    rows += '<Camera DEVICEID="marker" SENSOR_SIZE="9 9" TYPE="Vero"/>'
    return written(
        folder / "take.xcp", f'<?xml version="1.0"?>\n<Cameras VERSION="1.4">{rows}</Cameras>\n'
    )


RADIAL = Rig(
    tuple(
        camera(name, turn, (-0.2, 0.05, 0, 0, 0.01))
        for name, turn in zip(NAMES, TURNS, strict=True)
    ),
    "z",
)


def panoptic(folder: Path) -> Path:
    cameras = [
        {
            "name": each.name,
            "type": "hd",
            "resolution": [1280, 720],
            "panel": 0,
            "node": number,
            "K": each.K.tolist(),
            "distCoef": list(FIVE),
            "R": each.cTw[:, :3].tolist(),
            "t": (100 * each.cTw[:, 3:]).tolist(),
        }
        for number, each in enumerate(TRUTH.cameras)
    ]
    return written(
        folder / "calibration_160422.json", json.dumps({"calibDataSource": "x", "cameras": cameras})
    )


def voxelpose(folder: Path) -> Path:
    k1, k2, p1, p2, k3 = FIVE
    cameras = {
        each.name: {
            "R": each.cTw[:, :3].tolist(),
            "T": (1000 * each.centre[:, None]).tolist(),
            **dict(
                zip(
                    ("fx", "fy", "cx", "cy"),
                    each.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(),
                    strict=True,
                )
            ),
            "k": [[k1], [k2], [k3]],
            "p": [[p1], [p2]],
        }
        for each in TRUTH.cameras
    }
    return written(folder / "calibration.json", json.dumps(cameras))


def easymocap(folder: Path, *, sized: bool = True) -> Path:
    intri, extri = (
        cv2.FileStorage(str(folder / f"{half}.yml"), cv2.FILE_STORAGE_WRITE)
        for half in ("intri", "extri")
    )
    for storage in (intri, extri):
        storage.startWriteStruct("names", cv2.FileNode_SEQ)
        for each in TRUTH.cameras:
            storage.write("", each.name)
        storage.endWriteStruct()
    for each in TRUTH.cameras:
        intri.write(f"K_{each.name}", each.K)
        intri.write(f"dist_{each.name}", each.distortion[None])
        if sized:
            intri.write(f"H_{each.name}", 720)
            intri.write(f"W_{each.name}", 1280)
        extri.write(f"R_{each.name}", cv2.Rodrigues(each.cTw[:, :3])[0])
        extri.write(f"Rot_{each.name}", each.cTw[:, :3])
        extri.write(f"T_{each.name}", each.cTw[:, 3:])
    intri.release()
    extri.release()
    return folder


def multiview(folder: Path) -> Path:
    """As OpenCV's samples/python/multiview_calibration.py saves: one fisheye among rational
    lenses.
    """
    storage = cv2.FileStorage(str(folder / "rig.yaml"), cv2.FILE_STORAGE_WRITE)
    storage.write("Rs", np.stack([each.cTw[:, :3] for each in MIXED.cameras]))
    storage.write("distortions", np.concatenate([each.distortion for each in MIXED.cameras]))
    storage.write("Ks", MIXED.K)
    storage.write("Ts", np.stack([each.cTw[:, 3:] for each in MIXED.cameras]))
    storage.write("models", np.array([0, 1, 0], dtype=np.int32))
    storage.write("image_sizes", np.array([[1280, 720]] * 3, dtype=np.int32))
    storage.write("cam_ids", ",".join(NAMES))
    storage.release()
    return folder / "rig.yaml"


RATIONAL = (0.1, 0.02, 0.001, 0.002, 0.01, 0.2, 0.03, 0.001)
MIXED = Rig(
    (
        camera("alpha", TURNS[0], RATIONAL),
        camera("beta", TURNS[1], (0.05, -0.01, 0.003, -0.001), "fisheye"),
        camera("gamma", TURNS[2], RATIONAL),
    ),
    "z",
)


def nodes(folder: Path, suffix: str = "xml") -> Path:
    """A node per camera with its pose in the world, as MC-Calib writes it."""
    path = folder / f"calibrated_cameras_data.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("nb_camera", 3)
    for each in TRUTH.cameras:
        storage.startWriteStruct(each.name, cv2.FileNode_MAP)
        storage.write("camera_matrix", each.K)
        storage.write("distortion_vector", each.distortion[None])
        storage.write("distortion_type", 0)
        storage.write("img_width", 1280)
        storage.write("img_height", 720)
        storage.write("camera_pose_matrix", each.wTc)
        storage.endWriteStruct()
    storage.release()
    return path


def files_of_opencv(folder: Path) -> Path:
    """A file per camera, by the names of OpenCV's own calibration sample."""
    for each in TRUTH.cameras:
        storage = cv2.FileStorage(str(folder / f"{each.name}.yml"), cv2.FILE_STORAGE_WRITE)
        storage.write("image_width", 1280)
        storage.write("image_height", 720)
        storage.write("camera_matrix", each.K)
        storage.write("distortion_coefficients", each.distortion[None])
        storage.write("rvec", cv2.Rodrigues(each.cTw[:, :3])[0])
        storage.write("tvec", each.cTw[:, 3:])
        storage.release()
    return folder


def ros(folder: Path) -> Path:
    for each in TRUTH.cameras:
        values = {"rows": 3, "cols": 3, "data": each.K.ravel().tolist()}
        info = (
            "image_width: 1280\nimage_height: 720\ncamera_name: narrow_stereo\ncamera_matrix: "
            f"{json.dumps(values)}\ndistortion_model: plumb_bob\ndistortion_coefficients:\n  "
            f"rows: 1\n  cols: 5\n  data: {list(FIVE)}\n"
        )
        (folder / f"{each.name}.yaml").write_text(info)
        x, y, z, w = quaternion(each.wTc[:3, :3])
        a, b, c = each.centre.tolist()
        stamped = (
            "---\nheader:\n  frame_id: world\nchild_frame_id: "
            f"{each.name}_optical_frame\ntransform:\n  translation:\n    x: {a}\n    y: {b}\n    "
            f"z: {c}\n  rotation: {{x: {x}, y: {y}, z: {z}, w: {w}}}\n---\n"
        )
        (folder / f"{each.name}_pose.yaml").write_text(stamped)
    return folder


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


BOARD = {"up": "z", "unit": "m"}
WRITERS = {
    "Caliscope": (caliscope, {"up": "z"}, TRUTH),
    "Pose2Sim": (pose2sim, {}, TRUTH),
    "AniPose": (anipose, {"up": "z", "unit": "mm"}, TRUTH),
    "FreeMoCap": (freemocap, {"up": "z", "unit": "mm"}, TRUTH),
    "Qualisys": (qualisys, {}, TRUTH),
    "Vicon": (vicon, {}, RADIAL),
    "CMU Panoptic": (panoptic, {}, TRUTH),
    "VoxelPose": (voxelpose, {"image_size": (1280, 720)}, TRUTH),
    "EasyMocap": (easymocap, {}, TRUTH),
    "OpenCV's multi-view": (multiview, BOARD, MIXED),
    "a node per camera": (nodes, BOARD, TRUTH),
    "a file per camera": (files_of_opencv, BOARD, TRUTH),
    "ROS": (ros, {}, TRUTH),
}
UP = {"CMU Panoptic": "-y"}
ASKED = {
    "Caliscope": ("up is missing", "--up"),
    "AniPose": ("unit and up are missing", "the unit of the board's squares"),
    "FreeMoCap": ("unit and up are missing", "FreeMoCap works in mm"),
    "VoxelPose": ("image_size is missing", "--image-size WIDTHxHEIGHT"),
    "OpenCV's multi-view": ("unit and up are missing", "--unit", "--up"),
    "a node per camera": ("unit and up are missing",),
}


@pytest.mark.parametrize("program", WRITERS)
def test_what_a_program_writes_is_read(tmp_path, program):
    write, wishes, truth = WRITERS[program]
    rig = read_rig(write(tmp_path), **wishes)
    if program == "Caliscope":  # its cameras have numbers only
        assert rig.names == ("cam_0", "cam_1", "cam_2")
        rig = renamed(rig, truth.names)
    assert_same(rig, truth)
    assert rig.up == UP.get(program, "z")
    # And it goes through our own rig file to the last digit.
    write_rig(rig, tmp_path / "rig.json")
    assert_same(read_rig(tmp_path / "rig.json"), rig, atol=0)


@pytest.mark.parametrize("program", ASKED)
def test_what_a_format_does_not_say_is_asked_for(tmp_path, program):
    refuses(WRITERS[program][0](tmp_path), "recognised as", *ASKED[program])


def renamed(rig: Rig, names: tuple[str, ...]) -> Rig:
    def named(each: Camera, name: str) -> Camera:
        return Camera(name, each.K, each.wTc, each.image_size, each.distortion, each.lens)

    return Rig(
        tuple(named(each, name) for each, name in zip(rig.cameras, names, strict=True)), rig.up
    )


MALFORMED = {
    "Caliscope": (
        "translation",
        "verschiebung",
        'camera "0": translation is missing; calibrate the extrinsics',
    ),
    "Pose2Sim": (
        "matrix = [[",
        "matrix = [[1.0, ",
        'camera "cam_0": matrix must have rows of equal length; write',
    ),
    "AniPose": ("rotation = [", "rotation = [[", "cannot be read as TOML"),
    "FreeMoCap": (
        "distortions = [-0.2",
        "distortions = [nan",
        "distortions[0] must be a finite number, got NaN",
    ),
    "Qualisys": ('x="', 'x="one', 'camera 0 "alpha": <transform>: x must be a number, got text'),
    "Vicon": (
        'POSITION="',
        'POSITION="one ',
        'camera 0 "alpha": POSITION must hold 3 numbers, got',
    ),
    "CMU Panoptic": ('"distCoef"', '"distCoef2"', None),
    "VoxelPose": ('"fx": 9', '"fx": -9', "camera alpha: K must have positive focal lengths"),
    "OpenCV's multi-view": ("Ts:", "Qs:", None),
    "a node per camera": ("</camera_matrix>", "</kamera_matrix>", "is not XML; correct it"),
}


@pytest.mark.parametrize(
    "program", [name for name, case in MALFORMED.items() if case[2] is not None]
)
def test_a_malformed_file_is_one_sentence(tmp_path, program):
    old, new, expected = MALFORMED[program]
    write, wishes, _ = WRITERS[program]
    path = write(tmp_path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    refuses(path, expected, **wishes)


@pytest.mark.parametrize(
    ("program", "keys"), [("CMU Panoptic", "K R t distCoef"), ("VoxelPose", "R T k p")]
)
def test_columns_that_are_ragged_are_named(tmp_path, program, keys):
    """`"t": [[0], [0], 0]`: as many numbers as it takes, in no matrix."""
    write, wishes, _ = WRITERS[program]
    text = write(tmp_path).read_text()
    for key in keys.split():
        content = json.loads(text)
        cameras = content["cameras"] if "cameras" in content else list(content.values())
        flat = np.ravel(cameras[0][key]).tolist()
        cameras[0][key] = [*([each] for each in flat[:-1]), flat[-1]]
        (tmp_path / "ragged.json").write_text(json.dumps(content))
        refuses(tmp_path / "ragged.json", f"{key} must have rows of equal length", **wishes)


def test_malformed_panoptic(tmp_path):
    content = json.loads(panoptic(tmp_path).read_text())
    content["cameras"][1]["R"][0][0] += 0.5
    path = written(tmp_path / "c.json", json.dumps(content))
    refuses(path, 'camera "1": the rotation of R is not orthonormal')


def test_malformed_multiview(tmp_path):
    path = multiview(tmp_path)
    path.write_text(path.read_text().replace("image_sizes:", "bild_sizes:"))
    refuses(path, "image_sizes is missing; save it with", **BOARD)


def test_easymocap_is_known_by_either_half_and_by_the_folder(tmp_path):
    easymocap(tmp_path)
    for path in (tmp_path, tmp_path / "intri.yml", tmp_path / "extri.yml"):
        assert_same(read_rig(path), TRUTH)
    (tmp_path / "extri.yml").unlink()
    with pytest.raises(
        InputError, match=r"extri\.yml: this file of EasyMocap's calibration is missing"
    ):
        read_rig(tmp_path / "intri.yml")


def test_easymocap_without_sizes_and_malformed(tmp_path):
    easymocap(tmp_path, sized=False)
    refuses(tmp_path, "image_size is missing; pass --image-size")
    assert_same(read_rig(tmp_path, image_size=(1280, 720)), TRUTH)
    intri = tmp_path / "intri.yml"
    intri.write_text(intri.read_text().replace("K_beta", "K_other"))
    with pytest.raises(InputError, match=r"intri\.yml: K_beta is missing; write it with EasyMocap"):
        read_rig(tmp_path)
    intri.write_text(intri.read_text()[:300])
    with pytest.raises(InputError, match=r"intri\.yml: .*"):
        read_rig(tmp_path)


def test_a_picture_size_that_the_file_knows_itself(tmp_path):
    refuses(
        pose2sim(tmp_path),
        "contains the picture sizes; leave out --image-size",
        image_size=(3, 3),
    )


def test_colmap_as_pycolmap_wrote_it():
    """Against pycolmap's own projections of three points; its first pixel's centre is (0.5,
    0.5).
    """
    points = np.array([[0, 0, 1.0], [0.5, 0.2, 1.2], [-0.4, 0.3, 0.4]])
    seen = [
        [[471.5976608901799, 188.53263125152594], [435.3870275347477, 250.47532086506044],
         [525.5493290757003, 277.35611425609676]],
        [[577.1169867426155, 258.6719445152573], [558.588702471141, 281.02032938417403],
         [595.2733715454231, 316.7901876408392]],
        [[557.9094003638634, 129.3979166916502], [521.0311607074431, 157.29699507296036],
         [576.3546853417291, 269.94584108518524]],
    ]  # fmt: skip
    for path in (DATA / "colmap", DATA / "colmap" / "images.txt", DATA / "colmap" / "cameras.txt"):
        rig = read_rig(path, unit="m", up="-y")
        assert rig.names == ("cam01", "cam02", "cam03")
        for each, expected in zip(rig.cameras, seen, strict=True):
            np.testing.assert_allclose(
                each.distort(each.project(points)[0]) + 0.5, expected, atol=1e-6
            )
    refuses(DATA / "colmap", "unit and up are missing", "no scale until colmap model_aligner")


@pytest.mark.parametrize(
    "line", ["1 1 0 0 0 0 0 0 1", "1 1 0 0 0 0 0 0", "1 1 0 0 0 0 0 0 7 a.jpg"]
)
def test_colmap_s_pictures_have_ten_words_and_a_camera_that_is_there(tmp_path, line):
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 100 80 90 90 50 40\n")
    (tmp_path / "images.txt").write_text(f"# pictures\n{line}\n\n")
    with pytest.raises(
        InputError, match=r"images\.txt: line 2: must hold id, quaternion, translation, camera id"
    ):
        read_rig(tmp_path, unit="m", up="z")


def test_colmap_s_pictures_are_followed_by_their_points(tmp_path):
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 100 80 90 90 50 40\n")
    images = [f"{n} 1 0 0 0 {n} 0 0 1 {name}.jpg" for n, name in enumerate(("a", "b", "c"), 1)]
    file = tmp_path / "images.txt"
    for points in ("", "1.5 2.5 -1 3 4 17"):
        file.write_text("# pictures\n\n" + "".join(f"{image}\n{points}\n" for image in images))
        assert read_rig(tmp_path, unit="m", up="z").names == ("a", "b", "c")
    file.write_text("# pictures\n" + "\n".join(images))
    refuses(
        tmp_path,
        "images.txt: line 3: must hold the points of the image in the line before",
        unit="m",
        up="z",
    )
    file.write_text(f"{images[0]}\n1 2\n{images[1]}\n\n")
    refuses(
        tmp_path,
        "images.txt: line 2: must hold the points of the image in the line before",
        unit="m",
        up="z",
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("distortion_coefficients: [-0.2, 0.05, 0.001, -0.002, 0.01]", FIVE),
        ("unknown: 1", (0.0,) * 5),
        (
            "dist: !!opencv-matrix\n  rows: 1\n  cols: 5\n  dt: d\n  data: [1, 2, x]",
            "dist[0] must be a finite number",
        ),
        ("distortion_coefficients: none", "distortion_coefficients must hold at most 14 numbers"),
        ("D: [[0.1, 0.2], [0.3]]", "D must have rows of equal length"),
    ],
)
def test_distortion_of_a_file_per_camera(tmp_path, text, expected):
    for path in files_of_opencv(tmp_path).iterdir():
        before, after = path.read_text().split("distortion_coefficients:")
        path.write_text(before + text + after[after.index("\nrvec") :])
    if isinstance(expected, str):
        refuses(tmp_path, f'camera "alpha": {expected}', **BOARD)
    else:
        for each in read_rig(tmp_path, **BOARD).cameras:
            np.testing.assert_allclose(each.distortion, expected)


def test_colmap_that_cannot_be_read(tmp_path):
    (tmp_path / "cameras.bin").write_bytes(b"\x01")
    with pytest.raises(
        InputError, match="binary format: convert it with colmap model_converter --output_type TXT"
    ):
        read_rig(tmp_path)
    (tmp_path / "cameras.txt").write_text("1 FOV 10 10 1 1 1 1 1\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.jpg\n\n")
    with pytest.raises(
        InputError,
        match=r"cameras\.txt: line 1: camera model FOV is not supported; use one of SIMPLE_PIN",
    ):
        read_rig(tmp_path)
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 10 10 1 1 1 1\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 2 a.jpg\n\n")
    with pytest.raises(InputError, match=r"images\.txt: line 1: must hold id, quaternion"):
        read_rig(tmp_path)


def test_ros_refuses_intrinsics_alone_and_frames_that_are_not_optical(tmp_path):
    ros(tmp_path)
    refuses(tmp_path / "alpha.yaml", "the intrinsics of one camera of ROS only; give the folder")
    refuses(tmp_path / "alpha_pose.yaml", "the pose of one camera of ROS only; give the folder")
    pose = tmp_path / "beta_pose.yaml"
    good = pose.read_text()
    pose.write_text(good.replace("beta_optical_frame", "beta_link"))
    with pytest.raises(
        InputError, match=r"beta_pose\.yaml: child_frame_id beta_link is not an optical frame"
    ):
        read_rig(tmp_path)
    pose.write_text(good.replace("w: ", "q: "))
    with pytest.raises(
        InputError, match=r"beta_pose\.yaml: rotation: w is missing; write <camera>_pose"
    ):
        read_rig(tmp_path)
    pose.unlink()
    with pytest.raises(
        InputError, match=r'beta_pose\.yaml: the pose of camera "beta" is missing; write'
    ):
        read_rig(tmp_path)


def test_nothing_that_runs_code(tmp_path):
    refuses(
        written_bytes(tmp_path / "cam.pickle", b"\x80\x04\x95rest"),
        "this is a Python pickle (as OpenCap",
        "docs/",
    )
    bomb = (
        '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "c">]><calibration><cameras/></calibration>'
    )
    refuses(
        written(tmp_path / "a.qca.txt", bomb),
        "XML with a document type or entities is not accepted",
    )
    code = "image_width: !!python/object/apply:os.system ['true']\n"
    refuses(written(tmp_path / "a.yaml", code), "is not YAML")


def written_bytes(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def test_the_way_out_of_opencap_s_pickles(tmp_path, monkeypatch):
    """The program in docs/calibration_files.md, on pickles like OpenCap's."""
    for each in TRUTH.cameras:
        folder = tmp_path / "Videos" / f"Cam_{each.name}"
        folder.mkdir(parents=True)
        content = {
            "intrinsicMat": each.K,
            "distortion": each.distortion[None],
            "imageSize": np.array([[720.0], [1280.0]]),
            "rotation": each.cTw[:, :3],
            "translation": 1000 * each.cTw[:, 3:],
        }
        (folder / "cameraIntrinsicsExtrinsics.pickle").write_bytes(pickle.dumps(content))
    page = (Path(__file__).parents[2] / "docs" / "calibration_files.md").read_text()
    (block,) = re.findall(r"```python\n(import pickle.*?)```", page, flags=re.DOTALL)
    monkeypatch.chdir(tmp_path)
    exec(compile(block, "docs/calibration_files.md", "exec"), {})
    rig = read_rig(tmp_path / "rig.json")
    assert rig.up == "-y" and rig.names == ("Cam_alpha", "Cam_beta", "Cam_gamma")
    assert_same(renamed(rig, NAMES), TRUTH)


def test_unknown_files_are_named_by_what_they_are(tmp_path):
    refuses(
        written(tmp_path / "a.toml", "[tool]\nx = 1\n"),
        "recognised as TOML (with tool), but",
        "Qualisys'",
    )
    refuses(written(tmp_path / "a.xml", "<svg/>"), "recognised as XML (<svg>), but")
    refuses(written(tmp_path / "a.csv", "1,2,3\n"), "recognised as text, but")
    refuses(written(tmp_path / "b.yaml", "a: 1\n"), "recognised as YAML (with a), but")


# Real files.


@pytest.mark.parametrize(("resolution", "scale"), [("1080p", 1), ("720p", 2 / 3), ("540p", 1 / 2)])
def test_qualisys_pictures_of_a_lower_resolution_are_resized(tmp_path, resolution, scale):
    file = qualisys(tmp_path)
    file.write_text(
        file.read_text().replace(
            'model="Miqus Video"', f'model="Miqus Video" video_resolution="{resolution}"'
        )
    )
    rig = read_rig(file)
    np.testing.assert_allclose(rig.cTw, TRUTH.cTw, atol=1e-9)
    for one, truth in zip(rig.cameras, TRUTH.cameras, strict=True):
        np.testing.assert_allclose(one.K[:2], scale * truth.K[:2])
        np.testing.assert_array_equal(one.distortion, truth.distortion)
        assert one.image_size == (round(1280 * scale), round(720 * scale))


@pytest.mark.parametrize("resolution", ["4K", "N/A", "none"])
def test_qualisys_resolutions_that_are_not_known_are_said(tmp_path, resolution):
    file = qualisys(tmp_path)
    file.write_text(
        file.read_text().replace(
            'model="Miqus Video"', f'model="Miqus Video" video_resolution="{resolution}"'
        )
    )
    rig = read_rig(file)
    assert_same(rig, TRUTH)
    assert f"video_resolution is '{resolution}' of camera alpha" in rig.notes[0]


@pytest.mark.parametrize(
    ("resolution", "window", "scale"),
    [
        ("1440p", (1919, 1439), 1.0),  # all of the sensor
        ("1440p", (1439, 1439), 1.0),  # a square in it
        ("1080p", (1919, 1079), 1.0),  # a window of so many lines
        ("1080p", (1919, 1439), 0.75),  # resized
        ("720p", (1919, 1439), 0.5),
    ],
)
def test_qualisys_sensors_of_more_lines(tmp_path, resolution, window, scale):
    """Miqus Video Plus has 1440 lines; pictures are resized only where there are more lines in the
    window.
    """
    file = qualisys(tmp_path)
    text = file.read_text().replace(
        'left="8" top="4" right="1287" bottom="723"',
        f'left="0" top="0" right="{window[0]}" bottom="{window[1]}"',
    )
    text = text.replace(
        "<transform", '<fov_video_max left="0" top="0" right="1919" bottom="1439"/><transform'
    )
    plus = f'model="Miqus Video Plus" video_resolution="{resolution}"'
    file.write_text(text.replace('model="Miqus Video"', plus))
    width, height = window[0] + 1, window[1] + 1
    first = read_rig(file, cameras=[NAMES[0]]).cameras[0]
    assert first.image_size == (round(width * scale), round(height * scale))
    np.testing.assert_allclose(first.K[0, 0], scale * TRUTH.K[0, 0, 0])


def test_qualisys_hybrid_cameras_are_video_cameras_and_others_are_named(tmp_path):
    file = qualisys(tmp_path)
    file.write_text(file.read_text().replace("Miqus Video", "Miqus Hybrid", 1))
    rig = read_rig(file)
    assert_same(rig, TRUTH)
    assert [note.split(": ", 1)[1] for note in rig.notes] == [
        "camera marker (Miqus M3) is left out: it does not record video"
    ]


def test_pose2sim_s_recording_in_three_formats(shared_data):
    """The Qualisys file, and what Pose2Sim made of it; Pose2Sim divides the distortion by 64."""
    single, formats = shared_data / "pose2sim_single", shared_data / "formats"
    truth = read_rig(single / "rig.json")
    assert_same(read_rig(single / "Calib.qca.txt"), truth)
    for path, wishes in (
        (formats / "pose2sim_Calib.toml", {}),
        (formats / "easymocap_intri.yml", {"image_size": (1088, 1920)}),
    ):
        rig = read_rig(path, **wishes)
        np.testing.assert_allclose(rig.cTw, truth.cTw, atol=1e-5)
        np.testing.assert_allclose(rig.K, truth.K, atol=1e-5)
        np.testing.assert_array_equal(rig.image_sizes, truth.image_sizes)
        for one, other in zip(rig.cameras, truth.cameras, strict=True):
            np.testing.assert_allclose(64 * one.distortion, other.distortion, atol=1e-9)


def test_caliscope_s_own_board_keeps_its_distances(shared_data):
    formats = shared_data / "formats"
    rig = read_rig(formats / "caliscope_camera_array.toml", up="-y")
    table = np.genfromtxt(formats / "caliscope_xy.csv", delimiter=",", names=True)
    rows: dict[tuple, list] = {}
    for row in table:
        rows.setdefault((row["sync_index"], row["keypoint_id"]), []).append(row)
    places: dict[float, list] = {}
    for (time, _), seen in rows.items():
        views = [rig.names.index(f"cam_{int(row['cam_id'])}") for row in seen]
        if len(set(views)) < 2:
            continue
        lines = []
        for view, row in zip(views, seen, strict=True):
            each = rig.cameras[view]
            (x, y), P = (
                each.undistort(np.array([[row["img_loc_x"], row["img_loc_y"]]]))[0],
                each.K @ each.cTw,
            )
            lines += [x * P[2] - P[0], y * P[2] - P[1]]
        X = np.linalg.svd(np.array(lines))[2][-1]
        places.setdefault(time, []).append(
            (X[:3] / X[3], (seen[0]["obj_loc_x"], seen[0]["obj_loc_y"]))
        )
    ratios = []
    for board in places.values():
        xyz, flat = (np.array(each) for each in zip(*board, strict=True))
        first, second = np.triu_indices(len(xyz), 1)
        ratios += (
            np.linalg.norm(xyz[first] - xyz[second], axis=1)
            / np.linalg.norm(flat[first] - flat[second], axis=1)
        ).tolist()
    assert sum(len(board) for board in places.values()) > 500
    assert abs(np.median(ratios) - 1) < 0.003


def test_freemocap_ros_and_panoptic(shared_data):
    rig = read_rig(shared_data / "formats" / "freemocap_calibration.toml", unit="mm", up="-y")
    np.testing.assert_array_equal(rig.centres[0], 0)
    # The second camera stands 2.7 m from the first.
    np.testing.assert_allclose(
        np.linalg.norm(rig.centres[1]), np.linalg.norm([2.512, 0.646, 0.739]), atol=1e-3
    )
    refuses(shared_data / "formats" / "ros_ost.yaml", "the intrinsics of one camera of ROS")
    rig = read_rig(shared_data / "panoptic_pizza" / "calibration.json", image_size=(1920, 1080))
    # Five cameras 1.5 to 3.4 m high look at the middle of the room, within a few metres.
    assert np.all((rig.centres[:, 2] > 1.5) & (rig.centres[:, 2] < 3.5))
    xy, depth = rig.project(np.array([[0.0, 0.0, 1.0]]))
    assert np.all((xy > 0) & (xy < (1920, 1080))) and np.all(depth > 0)


def test_voxelpose_s_rotations_are_matrices(tmp_path):
    content = json.loads(voxelpose(tmp_path).read_text())
    content["beta"]["R"] = [0.1, 0.2, 0.3]
    path = written(tmp_path / "calibration.json", json.dumps(content))
    refuses(path, 'camera "beta": R must hold 9 numbers, got 3; write it in VoxelPose\'s format')


def test_huge_numbers_are_refused_in_one_sentence(tmp_path):
    file = voxelpose(tmp_path)
    file.write_text(
        re.sub(r'"R": \[\[[^\]]*\]', '"R": [[1e200, 1e200, 1e200]', file.read_text(), count=1)
    )
    with pytest.raises(InputError, match=r"the rotation of R is not orthonormal"):
        read_rig(file)


def test_pose2sim_s_toml_is_written(tmp_path):
    write_pose2sim(PINHOLE, tmp_path / "Calib.toml")
    assert_same(read_rig(tmp_path / "Calib.toml"), PINHOLE)
    with pytest.raises(InputError, match="cannot hold the lens of alpha"):
        write_pose2sim(TRUTH, tmp_path / "Calib.toml")
