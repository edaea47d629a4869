"""Calibration files: what is read is what was written, and each bad file gives the sentence
promised.
"""

import copy
import json
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.io.calibration import RIG_FORMAT, read_rig, write_rig

# A camera at (0, -4, 1) that looks along +y, in a world with z up: x right, -z down, y forward.
LOOKS_ALONG_Y = [1.0, 0, 0, 0, 0, 0, -1, 1, 0, 1, 0, 4]
# The same, at (4, 0, 1), looking along -x: y right, -z down, -x forward.
LOOKS_ALONG_MINUS_X = [0.0, 1, 0, 0, 0, 0, -1, 1, -1, 0, 0, 4]
K = [1000.0, 0, 960, 0, 1000, 540, 0, 0, 1]


def association() -> dict:
    cameras = {"a": LOOKS_ALONG_Y, "b": LOOKS_ALONG_MINUS_X}
    return {
        name: {"K": list(K), "RT": list(RT), "imgSize": [1920, 1080]}
        for name, RT in cameras.items()
    }


def own() -> dict:
    def camera(name: str, RT: list) -> dict:
        return {
            "name": name,
            "image_size": [1920, 1080],
            "K": np.reshape(K, (3, 3)).tolist(),
            "distortion": [-0.1, 0.01],
            "cTw": np.reshape(RT, (3, 4)).tolist(),
        }

    cameras = [camera("a", LOOKS_ALONG_Y), camera("b", LOOKS_ALONG_MINUS_X)]
    return {"format": RIG_FORMAT, "unit": "m", "up": "z", "cameras": cameras}


def write(folder: Path, content: object) -> Path:
    path = folder / "calibration.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def change(content: dict, where: tuple, value: object) -> dict:
    """A copy of `content` with one value changed, or removed if `value` is the word 'remove'."""
    changed = copy.deepcopy(content)
    node = changed
    for key in where[:-1]:
        node = node[key]
    if value == "remove":
        del node[where[-1]]
    else:
        node[where[-1]] = value
    return changed


def test_association_is_metres_z_up_camera_from_world(tmp_path):
    rig = read_rig(write(tmp_path, association()))
    assert rig.names == ("a", "b")
    assert rig.up == "z"
    np.testing.assert_allclose(rig.centres, [[0, -4, 1], [4, 0, 1]], atol=1e-12)
    # A point 1 m above the first camera's axis, 4 m away: 1000 / 4 = 250 pixels above the centre.
    xy, depth = rig.cameras[0].project(np.array([0.0, 0.0, 2.0]))
    np.testing.assert_allclose(xy, [960, 540 - 250], atol=1e-9)
    assert depth == pytest.approx(4)


def test_user_overrules_unit_and_up(tmp_path):
    rig = read_rig(write(tmp_path, association()), up="-y", unit="mm")
    assert rig.up == "-y"
    np.testing.assert_allclose(rig.centres, [[0, -0.004, 0.001], [0.004, 0, 0.001]], atol=1e-15)


def test_association_with_separate_rotation_and_distortion(tmp_path):
    content = association()
    for camera in content.values():
        matrix = np.reshape(camera.pop("RT"), (3, 4))
        camera["R"], camera["T"] = matrix[:, :3].ravel().tolist(), matrix[:, 3].tolist()
        camera["distCoeff"] = [-0.2, 0.03, 0.001, 0.002]
    rig = read_rig(write(tmp_path, content))
    np.testing.assert_allclose(rig.centres, [[0, -4, 1], [4, 0, 1]], atol=1e-12)
    np.testing.assert_array_equal(rig.cameras[1].distortion, [-0.2, 0.03, 0.001, 0.002, 0])


def test_own_format_comes_back_to_the_last_digit(tmp_path):
    rng = np.random.default_rng(0)
    cameras = []
    for name in ("left", "right", "top"):
        R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        R *= np.linalg.det(R)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = R, rng.normal(size=3)
        intrinsics = np.array([[900 + rng.random(), 0, 500.1], [0, 901, 400.7], [0, 0, 1]])
        shutter_s = 0.0171 if name == "top" else 0.0
        bend = rng.normal(size=5) / 10
        cameras.append(Camera(name, intrinsics, pose, (1000, 800), bend, readout_s=shutter_s))
    rig = Rig(tuple(cameras), "-y")
    write_rig(rig, tmp_path / "rig.json")
    back = read_rig(tmp_path / "rig.json")
    assert back.up == "-y"
    assert back.names == rig.names
    for camera, same in zip(rig.cameras, back.cameras, strict=True):
        np.testing.assert_array_equal(same.wTc, camera.wTc)
        np.testing.assert_array_equal(same.K, camera.K)
        np.testing.assert_array_equal(same.distortion, camera.distortion)
        assert same.image_size == camera.image_size and same.readout_s == camera.readout_s


def test_own_format_in_millimetres_camera_from_world(tmp_path):
    rig = read_rig(write(tmp_path, change(own(), ("unit",), "mm")))
    np.testing.assert_allclose(rig.centres, [[0, -0.004, 0.001], [0.004, 0, 0.001]], atol=1e-15)
    np.testing.assert_array_equal(rig.cameras[0].distortion, [-0.1, 0.01, 0, 0, 0])


def test_printed_digits_do_not_become_a_scale(tmp_path):
    content = change(association(), ("a", "RT"), [0.9999, *LOOKS_ALONG_Y[1:]])
    R = read_rig(write(tmp_path, content)).cTw[0, :, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


MIRRORED = [-1.0, *LOOKS_ALONG_Y[1:]]
BAD_ASSOCIATION = [
    (
        ("b", "RT"),
        LOOKS_ALONG_Y[:11],
        'camera "b": RT must hold 12 numbers, got 11; write the 3x4 camera-from-world',
    ),
    (("b", "RT"), "remove", 'camera "b": RT is missing; write the 3x4'),
    (("a", "K"), "remove", 'camera "a": K is missing; write the 3x3'),
    (("a", "K"), K[:8], 'camera "a": K must hold 9 numbers, got 8; write the 3x3'),
    (("a", "K"), "1000", "camera \"a\": K must hold 9 numbers, got text '1000'"),
    (("a", "K", 4), "1000", "camera \"a\": K[4] must be a number, got text '1000'"),
    (("a", "K", 4), None, 'camera "a": K[4] must be a number, got null'),
    (("a", "K", 4), True, 'camera "a": K[4] must be a number, got true'),
    (("a", "K", 0), -1000.0, "camera a: K must have positive focal lengths"),
    (("a", "K", 8), 2.0, "camera a: K must have positive focal lengths and a last row 0 0 1"),
    (
        ("a", "RT", 3),
        float("nan"),
        'camera "a": RT[3] must be a finite number, got NaN; write the 3x4',
    ),
    (("a", "RT", 0), float("inf"), 'camera "a": RT[0] must be a finite number, got Infinity'),
    (
        ("a", "RT", 0),
        1.1,
        (
            'camera "a": the rotation of RT is not orthonormal (R Rᵀ is off by 0.21); give a pure '
            "rotation"
        ),
    ),
    (
        ("a", "RT"),
        MIRRORED,
        'camera "a": the rotation of RT is a reflection (determinant -1); use a right-handed world',
    ),
    (
        ("a", "imgSize"),
        [1920],
        'camera "a": imgSize must hold 2 numbers, got 1; write width and height',
    ),
    (
        ("a", "imgSize", 0),
        0,
        "camera a: image_size must be positive and at most 1000000, got (0, 1080)",
    ),
    (
        ("a", "distCoeff"),
        [0.1] * 8,
        'camera "a": distCoeff must hold at most 5 numbers, got 8; write at most k1 k2 p1 p2 k3',
    ),
]


@pytest.mark.parametrize(("where", "value", "sentence"), BAD_ASSOCIATION)
def test_bad_association(tmp_path, where, value, sentence):
    path = write(tmp_path, change(association(), where, value))
    refuses(path, sentence)


BAD_OWN = [
    (
        ("up",),
        "remove",
        'up is missing; write the axis that points up, such as "up": "z", or pass --up z',
    ),
    (
        ("unit",),
        "remove",
        'unit is missing; write the unit of lengths, such as "unit": "m", or pass --unit m',
    ),
    (("unit",), "inch", "unit must be 'm', 'cm' or 'mm', got text 'inch'"),
    (("format",), "shapepose-fg rig 2", 'format must be "shapepose-fg rig 1", got text'),
    (("cameras", 1, "name"), "a", "camera names must differ, got ['a', 'a']"),
    (("cameras", 1, "name"), 1, "cameras[1].name must be text, got 1"),
    (("cameras", 1, "focal"), 1, "cameras[1].focal is not a known key"),
    (
        ("cameras", 1, "K"),
        [[1, 0, 0], [0, 1], [0, 0, 1]],
        'camera "b": K must have rows of equal length; write the 3x3',
    ),
    (("cameras", 1, "cTw"), "remove", 'camera "b": give exactly one of wTc and cTw'),
    (("cameras", 1, "cTw", 0, 0), 0.5, 'camera "b": the rotation of cTw is not orthonormal'),
    (("cameras",), {}, "cameras must be a list, got an object"),
    (("cameras",), [], "a rig must have at least one camera"),
]


@pytest.mark.parametrize(("where", "value", "sentence"), BAD_OWN)
def test_bad_own(tmp_path, where, value, sentence):
    path = write(tmp_path, change(own(), where, value))
    refuses(path, sentence)


BAD_TEXT = [
    ("", "the file is empty"),
    (" \n", "the file is empty"),
    (json.dumps(association(), indent=1)[:300], "is not JSON: "),
    ('{"a": {"K": [1,\n 2,, 3]}}', "line 2 column 4 is not JSON"),
    (
        '{"a": {"K": []}, "a": {"K": []}}',
        'key "a" occurs twice in one object; give each its own name',
    ),
    (
        "[1, 2]",
        "recognised as JSON (a list of 2), but this is not a known calibration format; give one of",
    ),
    ("3", "this is not a known calibration format"),
    ("{}", "this is not a known calibration format"),
    ('{"a": {"fx": 3}}', "this is not a known calibration format"),
    ('{"a": ' * 100_000, "cannot be read as JSON"),
    ('{"a": {"K": [' + "1" * 5000 + "]}}", "cannot be read as JSON"),
    ('{"a": {"K": [' + "1" * 400 + ",0,0,0,1,0,0,0,1]}}", "a.K[0] is a whole number"),
]


@pytest.mark.parametrize(("text", "sentence"), BAD_TEXT)
def test_bad_text(tmp_path, text, sentence):
    refuses(write(tmp_path, text), sentence)


def test_cut_file_names_its_last_line(tmp_path):
    whole = json.dumps(association() | {"yes": True, "no": -1.5e-7, "none": None}, indent=1)
    for end in (*range(290, 310), *range(len(whole) - 50, len(whole) - 1)):
        text = whole[:end].rstrip()
        refuses(
            write(tmp_path, text),
            f"line {len(text.splitlines())} column",
            "the file ends too early",
        )


def test_missing_file_folder_and_pictures(tmp_path):
    refuses(tmp_path / "nothing.json", "there is no such file; check the path")
    refuses(tmp_path, "this is a folder; give the file inside it")
    picture = tmp_path / "picture.json"
    picture.write_bytes(b"\x89PNG\r\n\x1a\n\x00\xff")
    refuses(picture, "is not UTF-8 text")


def test_bad_wishes(tmp_path):
    path = write(tmp_path, association())
    with pytest.raises(InputError, match="up must be one of x -x y -y z -z, got 'up'"):
        read_rig(path, up="up")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="unit must be one of m cm mm, got 'inch'"):
        read_rig(path, unit="inch")  # type: ignore[arg-type]


def test_wishes_fill_what_our_own_file_does_not_say(tmp_path):
    content = change(change(own(), ("up",), "remove"), ("unit",), "remove")
    rig = read_rig(write(tmp_path, content), up="y", unit="cm")
    assert rig.up == "y"
    np.testing.assert_allclose(rig.centres[0], [0, -0.04, 0.01], atol=1e-15)


def test_shelf(shared_data):
    rig = read_rig(shared_data / "shelf" / "calibration.json")
    assert rig.names == ("0", "1", "2", "3", "4")
    # Cameras hang between 0.9 and 2.7 m high around a room of some 8 m.
    assert np.all((rig.centres[:, 2] > 0.9) & (rig.centres[:, 2] < 2.8))
    assert np.all(np.abs(rig.centres) < 4)


def refuses(path: Path, *parts: str) -> None:
    """Reading `path` gives one line that names the file and holds `parts`."""
    with pytest.raises(InputError) as caught:
        read_rig(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    for part in parts:
        assert part in message
