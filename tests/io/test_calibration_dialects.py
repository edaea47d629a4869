"""Files that resemble each other are told apart by their own marks, and what a file does not say is
asked for.
"""

from pathlib import Path

import cv2
import numpy as np
import pytest

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.io.calibration import read_rig, write_like, write_rig
from shapepose_fg.simulation import built_in_scene

CAMERA = """[cam_{n}]
name = "{name}"
size = [{width}, {height}]
matrix = [[900.0, 0.0, 640.0], [0.0, 900.0, 360.0], [0.0, 0.0, 1.0]]
{before}distortions = [0.0, 0.0, 0.0, 0.0, 0.0]
rotation = [0.0, {n}.0, 0.0]
translation = [{n}.0, 0.0, 3.0]
{after}
"""
PLAIN = {"name": "cam_{n}", "width": "1280", "height": "720", "before": "", "after": ""}
POSE2SIM = {"width": "1280.0", "height": "720.0", "after": "fisheye = false\n"}
CALISCOPE = "[metadata]\nadjusted = false\nerror = 0.0\n"


def toml(folder: Path, metadata: str, **parts: str) -> Path:
    texts = []
    for n in range(2):
        values = {name: text.format(n=n) for name, text in (PLAIN | parts).items()}
        texts.append(CAMERA.format(n=n, **values))
    file = folder / "cameras.toml"
    file.write_text("".join(texts) + metadata)
    return file


def missing(path: Path, **how) -> set[str]:
    """What is asked for of a file; nothing where it is read."""
    try:
        read_rig(path, **how)
    except InputError as error:
        words = str(error).partition("missing")[0].partition("where")[2]
        return {word for word in ("unit", "up", "image_size") if word in words.split()}
    return set()


@pytest.mark.parametrize(
    ("parts", "metadata", "asked"),
    [
        (POSE2SIM, CALISCOPE, set()),
        (POSE2SIM | {"name": "int_cam{n}_img"}, CALISCOPE, set()),
        ({"before": "fisheye = false\n"}, CALISCOPE, {"up"}),  # Caliscope's for AniPose
        ({}, CALISCOPE, {"up"}),  # and a newer one
        ({}, "[metadata]\n", {"unit", "up"}),  # AniPose
        ({"after": "exposure = 1\n"}, "[metadata]\nadjusted = true\nerror = 0.7\n", {"unit", "up"}),
        (
            {"before": "fisheye = false\n", "name": "left-{n}"},
            CALISCOPE,
            {"unit", "up"},
        ),  # nobody's
        ({"after": "port = {n}\n"}, "", {"up"}),  # Caliscope's own
        ({}, "[metadata]\ncharuco_square_size = 58.0\n", {"unit", "up"}),  # FreeMoCap 1
        ({}, "[metadata]\ncharuco_square_size = 58.0\ngroundplane_calibration = true\n", {"unit"}),
        (
            {},
            "[metadata]\ngroundplane_applied = true\n[metadata.board]\nsquare_length_mm = 58.0\n",
            set(),
        ),
        (
            {},
            "[metadata]\ngroundplane_applied = false\n[metadata.board]\nsquare_length_mm = 58.0\n",
            {"up"},
        ),
    ],
)
def test_whose_toml_it_is(tmp_path, parts, metadata, asked):
    file = toml(tmp_path, metadata, **parts)
    assert missing(file) == asked
    told = {name: value for name, value in (("unit", "m"), ("up", "z")) if name in asked}
    assert len(read_rig(file, **told)) == 2


def test_cameras_without_a_pose_are_named(tmp_path):
    file = toml(tmp_path, CALISCOPE, **POSE2SIM)
    extra = CAMERA.format(n=2, **{k: v.format(n=2) for k, v in (PLAIN | POSE2SIM).items()})
    lines = [
        line for line in extra.splitlines() if not line.startswith(("rotation", "translation"))
    ]
    file.write_text("\n".join(lines) + "\n" + file.read_text())
    rig = read_rig(file)
    assert rig.names == ("cam_0", "cam_1") and rig.notes == (
        f"{file}: camera cam_2 is left out: it has no pose",
    )
    form, there = write_like(file, rig, tmp_path / "new.toml")
    assert (
        form == "Pose2Sim's TOML"
        and read_rig(there).names == rig.names
        and "[cam_2]" in there.read_text()
    )


def test_freemocap_and_caliscope_of_several_versions(shared_cases):
    rig = read_rig(shared_cases / "freemocap" / "freemocap_v2.toml")
    assert rig.up == "z" and len(rig) == 3 and 1 < np.abs(rig.centres).max() < 5
    for name in ("aligned_v2", "freemocap_test_data_camera_calibration", "previous_calibration"):
        assert missing(shared_cases / "freemocap" / f"{name}.toml") == {"unit", "up"}
    file = shared_cases / "caliscope_aniposelib" / "camera_array_aniposelib_4cam.toml"
    assert missing(file) == {"up"} and len(read_rig(file, up="-y")) == 4


def test_a_list_of_cameras_that_is_not_cmu_s(tmp_path):
    """K, R and t are common names: only CMU's own keys say centimetres and y down."""
    one = (
        '{"name": "%s", "resolution": [1280, 720], "K": [[900, 0, 640], [0, 900, 360], [0, 0, 1]], '
    )
    pose = '"distCoef": [], '
    pose += '"R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "t": [[0], [0], [0]]%s}'
    file = tmp_path / "cameras.json"
    for own, asked in (("", {"unit", "up"}), (', "type": "hd", "panel": 0', set())):
        listed = ", ".join((one + pose) % (name, own) for name in "ab")
        file.write_text('{"cameras": [' + listed + "]}")
        assert missing(file) == asked


def test_easymocap_s_gaps_between_cameras(shared_cases):
    rig = read_rig(shared_cases / "easymocap_none", image_size=(1920, 1080))
    assert len(rig) == 23 and rig.names[0] == "Camera_B12"


def test_qualisys_cases(shared_cases):
    for name in ("hybrid", "na", "plus"):
        rig = read_rig(shared_cases / "qualisys" / f"{name}.qca.txt")
        assert len(rig) == 4 and rig.cameras[0].image_size == (1088, 1920)
        np.testing.assert_allclose(rig.focal_px, 1681, atol=10)


def stereo(folder: Path, keys: dict[str, str], together: bool) -> Path:
    """What OpenCV's stereo_calib writes, under the names `keys` of M1, D1, M2, D2, R and T."""
    M, D = (
        np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]]),
        np.array([[-0.28, 0.03, 0.001, 0, 0.09]]),
    )
    R, T = np.asarray(cv2.Rodrigues(np.array([0.0, 0.2, 0.0]))[0]), np.array([[-300.0], [10], [5]])
    values = {"M1": M, "D1": D, "M2": M + np.diag([5.0, 5, 0]), "D2": D, "R": R, "T": T}
    files = {"intrinsics.yml": ("M1", "D1", "M2", "D2"), "extrinsics.yml": ("R", "T")}
    for name, inside in {"stereo.yml": tuple(values)}.items() if together else files.items():
        storage = cv2.FileStorage(str(folder / name), cv2.FILE_STORAGE_WRITE)
        for key in inside:
            storage.write(keys.get(key, key), values[key])
        storage.release()
    return folder / "stereo.yml" if together else folder


@pytest.mark.parametrize("together", [True, False])
@pytest.mark.parametrize(
    "keys",
    [
        {},
        {"M1": "K1", "M2": "K2"},
        {"M1": "cameraMatrix1", "D1": "distCoeffs1", "M2": "cameraMatrix2", "D2": "distCoeffs2"},
        {
            "M1": "camera_matrix_left",
            "D1": "dist_left",
            "M2": "camera_matrix_right",
            "D2": "dist_right",
        },
        {"M1": "left_K", "D1": "left_D", "M2": "right_K", "D2": "right_D"},
    ],
)
def test_opencv_s_stereo_pair(tmp_path, keys, together):
    path = stereo(tmp_path, keys, together)
    assert missing(path) == {"unit", "up", "image_size"}
    rig = read_rig(path, unit="mm", up="-y", image_size=(640, 480))
    R = np.asarray(cv2.Rodrigues(np.array([0.0, 0.2, 0.0]))[0])
    np.testing.assert_array_equal(rig.cameras[0].wTc, np.eye(4))
    np.testing.assert_allclose(rig.cTw[1, :, :3], R, atol=1e-12)
    np.testing.assert_allclose(rig.cTw[1, :, 3], [-0.3, 0.01, 0.005], atol=1e-12)
    assert rig.K[1, 0, 0] == 505 and rig.cameras[0].distortion[0] == -0.28
    assert ("left" in rig.names) == ("left" in str(keys)) and "cameras are named" in rig.notes[0]


def test_opencv_s_stereo_folder(shared_cases, tmp_path):
    rig = read_rig(shared_cases / "opencv_stereo_folder", unit="m", up="-y", image_size=(640, 480))
    np.testing.assert_allclose(rig.centres[1], [3.3, 0, 0], atol=1e-12)
    for name, other in (("intrinsics.yml", "extrinsics.yml"),) * 2:
        (tmp_path / name).write_text((shared_cases / "opencv_stereo_folder" / name).read_text())
        with pytest.raises(
            InputError, match=rf"only one file of OpenCV's stereo calibration; put {other}"
        ):
            read_rig(tmp_path / name)


def test_one_camera_s_lens_is_named_as_what_it_is(tmp_path):
    storage = cv2.FileStorage(str(tmp_path / "out.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", np.eye(3))
    storage.write("distortion_coefficients", np.zeros((5, 1)))
    storage.release()
    with pytest.raises(InputError, match="this file has the intrinsics of one camera"):
        read_rig(tmp_path / "out.yml")


@pytest.fixture
def rig_file(tmp_path) -> tuple[Rig, Path]:
    rig = built_in_scene(frames=1).rig
    write_rig(rig, tmp_path / "rig.json")
    return rig, tmp_path / "rig.json"


def test_some_of_the_cameras(rig_file):
    rig, file = rig_file
    first, second, *others = rig.names
    assert (
        read_rig(file, cameras=[second, first]).names
        == (first, second)
        == rig.only([second, first]).names
    )
    assert read_rig(file, without=[first]).names == rig.without([first]).names == (second, *others)
    for call in (lambda: read_rig(file, cameras=["nobody"]), lambda: rig.without(["nobody"])):
        with pytest.raises(
            ValueError, match=rf"there is no camera 'nobody'; there are {first} {second}"
        ):
            call()
    with pytest.raises(InputError, match="no camera is selected"):
        read_rig(file, without=rig.names)


def test_a_camera_that_is_not_wanted_may_be_faulty(rig_file):
    rig, file = rig_file
    text = file.read_text().replace('"K": [[', '"K": [[-', 1)
    file.write_text(text.replace('"K": [\n    [\n     ', '"K": [\n    [\n     -', 1))
    with pytest.raises(InputError, match="focal lengths"):
        read_rig(file)
    assert read_rig(file, without=rig.names[:1]).names == rig.names[1:]


def test_a_file_is_never_written_under_another_format_s_name(tmp_path, rig_file):
    """A part of the cameras cannot be written as QTM does: then our own format gets its own
    name.
    """
    rig, file = rig_file
    with pytest.raises(InputError, match=r"new\.qca\.txt: cameras read as rig file .*FILE\.json"):
        write_like(file, rig, tmp_path / "new.qca.txt")
    source = toml(tmp_path, CALISCOPE, **POSE2SIM)
    part = read_rig(source, cameras=["cam_1"])
    (tmp_path / "new.json").write_text("somebody else's")
    form, there = write_like(source, part, tmp_path / "new.toml")
    assert form == "rig file" and there == tmp_path / "new-1.json"
    assert read_rig(there).names == ("cam_1",) and not (tmp_path / "new.toml").exists()
    assert (tmp_path / "new.json").read_text() == "somebody else's"


def test_cameras_that_are_not_wanted_are_named(rig_file):
    rig, file = rig_file
    (note,) = read_rig(file, without=rig.names[:2]).notes
    assert note == f"{file}: cameras {rig.names[0]} {rig.names[1]} are left out as requested"
    assert read_rig(file).notes == ()
