"""RTMPose's kind: made ONNX networks that give known numbers, or see painted people, through
`detect`.
"""

import json
import re
import shlex
import sys
from importlib.metadata import distributions, requires
from pathlib import Path

import cv2
import numpy as np
import pytest

from shapepose_fg.cli.main import main
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25, COCO_17, HALPE_26
from shapepose_fg.detection2d.boxes import BoxForm, BoxNetwork
from shapepose_fg.detection2d.onnx_network import OnnxNetwork
from shapepose_fg.detection2d.opening import open_network, read_form
from shapepose_fg.detection2d.top_down import KeypointForm
from shapepose_fg.io.calibration import write_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.simulation import built_in_scene
from tests.detection2d.conftest import node, onnx_model, rtmpose_file, yolox_file

pytest.importorskip("onnxruntime", reason="onnxruntime is an extra: shapepose-fg[detect]")


def constant_file(path: Path, size: tuple[int, int], **gives: np.ndarray) -> Path:
    """A network that gives the same arrays of every picture."""
    weights = {f"{name}_kept": array for name, array in gives.items()}
    nodes = [node("Identity", f"{name}_kept", name) for name in gives]
    return onnx_model(
        path, nodes, weights, (1, 3, size[1], size[0]), {n: a.shape for n, a in gives.items()}
    )


def yolox_of(path: Path, proposals: list, classes: int = 2) -> BoxNetwork:
    """YOLOX for 416 x 416: nothing, but in some cells (stride, column, row) x, y, w, h, sureness,
    classes.
    """
    found = np.full((1, 52 * 52 + 26 * 26 + 13 * 13, 5 + classes), -9.0)
    found[..., 4:] = 0.0
    for stride, column, row, *numbers in proposals:
        start = {8: 0, 16: 52 * 52, 32: 52 * 52 + 26 * 26}[stride]
        found[0, start + row * (416 // stride) + column] = numbers
    return BoxNetwork(
        OnnxNetwork.open(constant_file(path, (416, 416), dets=found)), BoxForm(size=(416, 416))
    )


def test_boxes_are_where_the_grids_say_once_each_and_people_s(tmp_path):
    """A picture of 832 x 416 is shown at half its size: a cell of 16 is one of 32."""
    log = np.log
    find = yolox_of(tmp_path / "yolox.onnx", [
        (16, 10, 3, 0.5, 0.25, log(4), log(6), 0.9, 0.95, 0.0),
        (16, 11, 3, -0.4, 0.25, log(4), log(6), 0.9, 0.9, 0.0),  # the same person, less sure
        (8, 40, 12, 0.0, 0.0, log(3), log(5), 1.0, 0.8, 0.0),
        (32, 2, 2, 0.5, 0.5, 1.0, 1.0, 0.9, 0.1, 0.99),  # a bicycle
        (32, 9, 2, 0.5, 0.5, 1.0, 1.0, 0.8, 0.8, 0.0),  # 0.64 is not enough
        (8, 3, 3, np.nan, 0.5, 1.0, 1.0, 1.0, 1.0, 0.0),
    ]).find  # fmt: skip
    boxes = find(np.zeros((416, 832, 3), np.uint8))
    middles, sides = [[336, 104], [640, 192]], [[128, 192], [48, 80]]
    expected = np.hstack(
        [np.subtract(middles, np.divide(sides, 2)), np.add(middles, np.divide(sides, 2))]
    )
    np.testing.assert_allclose(boxes, expected, atol=1e-3)


def test_boxes_that_the_network_suppressed_itself_are_taken_as_they_are(tmp_path):
    dets = np.array(
        [[[10, 20, 60, 120, 0.4], [12, 22, 62, 122, 0.9], [1, 1, 9, 9, 0.2], [5, 5, 50, 50, 0.9]]]
    )
    labels = np.array([[0, 0, 0, 17]])
    network = OnnxNetwork.open(
        constant_file(tmp_path / "n.onnx", (416, 416), dets=dets, labels=labels)
    )
    boxes = BoxNetwork(network, BoxForm(size=(416, 416))).find(np.zeros((208, 208, 3), np.uint8))
    np.testing.assert_allclose(boxes, [[6, 11, 31, 61], [5, 10, 30, 60]], atol=1e-5)


BOX = np.array([100.0, 50, 148, 146])
"""A person in a picture of 208 x 208. With padding 1.5 and the shape of the input: from 88 to 160,
26 to 170."""


def detected(folder: Path, lines: list[str], **gives: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions and scores of BOX's keypoints by a network of 96 x 192 that gives these arrays."""
    constant_file(folder / "pose.onnx", (96, 192), **gives)
    constant_file(folder / "yolox.onnx", (208, 208), dets=np.array([[[*BOX, 0.9]]]))
    boxes = ["[boxes]", 'network = "yolox.onnx"']
    (folder / "n.toml").write_text(
        "\n".join(['network = "pose.onnx"', "padding = 1.5", *lines, *boxes])
    )
    found = open_network(str(folder / "n.toml"), None, Path).detect(
        np.zeros((208, 208, 3), np.uint8)
    )
    return found.xy, found.score


def test_simcc_is_read_at_its_own_resolution(tmp_path):
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 192, 26), rng.integers(0, 384, 26)
    curves = [np.full((1, 26, count), 0.1) for count in (192, 384)]
    for curve, best, height in zip(curves, (x, y), (0.9, 0.7), strict=True):
        curve[0, np.arange(26), best] = height
    xy, score = detected(tmp_path, [], simcc_x=curves[0], simcc_y=curves[1])
    # 72 x 144 pixels of the picture are 192 x 384 places of the curves.
    np.testing.assert_allclose(
        xy[0], np.column_stack([88 + x * 72 / 192, 26 + y * 144 / 384]), atol=1e-4
    )
    np.testing.assert_allclose(score, 0.8, atol=1e-6)


@pytest.mark.parametrize("cells", ["corners", "edges"])
def test_heat_maps_are_read_between_their_cells(tmp_path, cells):
    rng = np.random.default_rng(1)
    true = rng.uniform([10, 10], [85, 180], (26, 2))  # pixels of the input
    size, shape = np.array([96, 192]), np.array([24, 48])
    cell = (
        true * (shape - 1) / (size - 1) if cells == "corners" else (true + 0.5) * shape / size - 0.5
    )
    columns, rows = np.meshgrid(np.arange(24), np.arange(48))
    maps = np.exp(
        -((columns - cell[:, 0, None, None]) ** 2 + (rows - cell[:, 1, None, None]) ** 2) / 4.5
    )
    lines = ['decoding = "heat map"', f'cells = "{cells}"', 'outputs = ["maps"]']
    xy, score = detected(tmp_path, lines, other=np.zeros((1, 3)), maps=maps[None])
    np.testing.assert_allclose(xy[0], [88, 26] + true * 72 / 96, atol=0.02)
    np.testing.assert_allclose(score, 1, atol=0.02)


def test_coordinates_go_to_the_joints_that_the_file_names(tmp_path):
    given = np.array([[[0.5, 0.25, 0.9], [0.25, 0.75, 0.8], [0.1, 0.1, 0.7], [np.inf, 0.5, 0.9]]])
    lines = [
        'decoding = "coordinates"',
        "scale = [96.0, 192.0]",
        'skeleton = "COCO_17"',
        'input = "x"',
    ]
    lines += ['joints = ["LHip", "Nose", "", "RHip"]']
    xy, score = detected(tmp_path, lines, out=given)
    names, keypoints = COCO_17.joints, list(COCO_17.keypoints or ())
    place = {name: keypoints.index(names.index(name)) for name in ("LHip", "Nose", "RHip")}
    assert xy.shape == (1, 17, 2)
    np.testing.assert_allclose(xy[0, place["LHip"]], [88 + 36, 26 + 36], atol=1e-4)
    np.testing.assert_allclose(xy[0, place["Nose"]], [88 + 18, 26 + 108], atol=1e-4)
    assert np.flatnonzero(score[0]).tolist() == sorted([place["LHip"], place["Nose"]])


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e38])
def test_what_is_no_number_or_no_place_is_nobody(tmp_path, value):
    box = constant_file(
        tmp_path / "yolox.onnx", (208, 208), dets=np.array([[[0, 0, value, 100, 0.9]]])
    )
    pose = rtmpose_file(tmp_path / "pose.onnx", 26, (96, 192), 0)
    assert (
        len(open_network(str(pose), str(box), Path).detect(np.zeros((208, 208, 3), np.uint8)).xy)
        == 0
    )
    flat, x, y = (np.full((1, 26, *shape), value) for shape in ((24, 12), (192,), (384,)))
    for how, gives in (
        (['decoding = "heat map"'], {"maps": flat}),
        ([], {"simcc_x": x, "simcc_y": y}),
    ):
        xy, score = detected(tmp_path, how, **gives)
        assert np.isfinite(xy).all() and np.isfinite(score).all()
        assert value == 1e38 or (score == 0).all()


def test_a_network_of_whole_pictures_may_find_several_people(tmp_path):
    people = np.random.default_rng(2).uniform(20, 90, (1, 3, 17, 3))
    constant_file(tmp_path / "pose.onnx", (100, 200), out=people)
    (tmp_path / "n.toml").write_text('network = "pose.onnx"\ndecoding = "coordinates"\n')
    found = open_network(str(tmp_path / "n.toml"), None, Path).detect(
        np.zeros((100, 200, 3), np.uint8)
    )
    # 200 x 100 pixels lie in the middle of 200 x 400, which are shown at half their size.
    np.testing.assert_allclose(found.xy, people[0, ..., :2] * 2 - [0, 150], atol=1e-4)


@pytest.mark.parametrize("lines, problem", [
    (['decoding = "guess"'],
     "decoding must be 'simcc', 'heat map' or 'coordinates', got text 'guess'; docs/det"),
    (["outputs = ['a', 'b']"], "the network has no 'a', but simcc_x simcc_y; name one of these"),
    (["input = 'picture'"], "the network has no 'picture', but x; name one of these"),
    (['decoding = "heat map"'], "is 1 x 26 x 192 and 1 x 26 x 384, which is not a heat map"),
    (['skeleton = "COCO_17"'], "the network has 26 joints, but 17 are named (COCO_17)"),
    (['joints = ["Nose", "Nose"]'],
     "joints has 'Nose', which must be a keypoint of HALPE_26 without repetition"
        " (Nose LEye"),
    (['joints = ["Tail"]'],
     "joints has 'Tail', which must be a keypoint of HALPE_26 without repetition"),
    (["padding = 0.5"], "padding is not valid"),
    (["colour = 'rgb'"], "colour is not a known key"),
    (["skeleton = '../mine.toml'"], "skeleton '../mine.toml' must be a file in the same folder"),
])  # fmt: skip
def test_what_a_file_says_of_another_network_is_refused_in_a_sentence(tmp_path, lines, problem):
    rtmpose_file(tmp_path / "pose.onnx", 26, (96, 192), 0)
    (tmp_path / "n.toml").write_text("\n".join(['network = "pose.onnx"', *lines]))
    with pytest.raises(InputError, match=re.escape(problem)):
        open_network(str(tmp_path / "n.toml"), None, Path)


def test_the_file_that_the_page_shows_is_read(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "detection.md").read_text(encoding="utf-8")
    (tmp_path / "other.toml").write_text(re.findall("```toml\n(.*?)```", page, re.DOTALL)[0])
    form = read_form(tmp_path / "other.toml")
    assert form.model_fields_set == set(KeypointForm.model_fields) and form.decoding == "heat map"
    assert form.boxes is not None and form.boxes.model_fields_set >= {
        "network",
        "min_score",
        "max_overlap",
    }


def test_networks_in_each_other_s_place_are_refused(tmp_path):
    pose = str(rtmpose_file(tmp_path / "pose.onnx", 26, (192, 256), 0))
    yolox = str(yolox_file(tmp_path / "yolox.onnx", (416, 416), 0))
    with pytest.raises(InputError, match=r"--boxes"):
        open_network(pose, None, Path)
    with pytest.raises(
        InputError, match=r"pose.onnx: .* YOLOX has an output of 1 x 1008 x 6 or more.*--boxes"
    ):
        open_network(pose, pose, Path)
    with pytest.raises(
        InputError,
        match=(
            "the output of the network is 1 x 3549 x 6, which is not a simcc; describe the "
            "network in a TOML"
        ),
    ):
        open_network(yolox, yolox, Path)
    with pytest.raises(
        InputError, match="--long-side is for networks such as OpenPose; leave it out"
    ):
        open_network(pose, yolox, Path, long_side=656)
    with pytest.raises(InputError, match="--device cuda: the installed onnxruntime supports cpu"):
        open_network(pose, yolox, Path, "cuda")
    five = str(rtmpose_file(tmp_path / "five.onnx", 5, (192, 256), 0))
    with pytest.raises(
        InputError,
        match="no known skeleton has 5 joints; describe the network in a TOML file",
    ):
        open_network(five, yolox, Path)


def test_what_is_missing_is_said_before_a_network_is_downloaded(monkeypatch):
    with pytest.raises(InputError, match="--layout is for networks such as OpenPose"):
        open_network("rtmpose-m", None, pytest.fail, layout="tf-pose")
    with pytest.raises(InputError, match="--device cuda"):
        open_network("rtmpose-m", None, pytest.fail, "cuda")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(InputError, match=r"onnxruntime is not installed; pip install .*detect"):
        open_network("rtmpose-m", None, pytest.fail)


def test_people_are_the_same_one_by_one_and_many_at_once(tmp_path):
    """Of 300 boxes and more, in blocks, and by a file that takes one picture at a time."""
    picture = cv2.resize(
        np.random.default_rng(0).integers(0, 256, (24, 32, 3), dtype=np.uint8), (640, 480)
    )
    yolox = str(yolox_file(tmp_path / "yolox.onnx", (416, 416), 0, 1, True))
    found = [
        open_network(
            str(rtmpose_file(tmp_path / f"{n}.onnx", 26, (96, 128), 3, batch)), yolox, Path
        ).detect(picture)
        for n, batch in enumerate(("batch", 1))
    ]
    assert len(found[0].xy) > 32
    np.testing.assert_allclose(found[0].xy, found[1].xy, atol=1e-9)
    np.testing.assert_allclose(found[0].score, found[1].score, atol=1e-5)


def test_one_opencv_is_asked_for_and_installed():
    """Two would overwrite each other's cv2: rtmlib, which brings two more, is no dependency."""
    asked = [re.split(r"[^\w-]", each)[0].lower() for each in requires("shapepose-fg") or ()]
    assert [each for each in asked if "opencv" in each] == [
        "opencv-python-headless"
    ] and "rtmlib" not in asked
    installed = {each.name.lower() for each in distributions() if each.name}
    assert {each for each in installed if each.startswith("opencv")} == {"opencv-python-headless"}


def test_a_skeleton_of_one_s_own_goes_on_to_reconstruct(rolled_rig, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_rig(rolled_rig, "calibration.json")
    Path("shots").mkdir()
    for camera in rolled_rig.cameras:
        cv2.imwrite(f"shots/{camera.name}.png", np.zeros((480, 640, 3), np.uint8))
    Path("mine.toml").write_text(
        'name = "mine"\nkeypoints = ["RHip", "LHip", "RKnee", "LKnee", "Neck"]\nanchor = '
        '["RHip", "LHip"]\nlimbs = [["RHip", "RKnee"], ["LHip", "LKnee"], ["MidHip", "Neck"]]\n'
        'mirror = [["RHip", "LHip"], ["RKnee", "LKnee"]]\n'
    )
    constant_file(
        Path("pose.onnx"),
        (96, 192),
        out=np.array(
            [[[40, 95, 0.9], [55, 95, 0.9], [40, 120, 0.9], [55, 120, 0.9], [48, 70, 0.9]]]
        ),
    )
    Path("n.toml").write_text(
        'network = "pose.onnx"\nskeleton = "mine.toml"\ndecoding = "coordinates"\n'
    )
    words = "detect --calibration calibration.json --images shots --network n.toml --output found"
    with pytest.raises(SystemExit) as end:
        main(words.split())
    assert not end.value.code
    assert f"--skeleton {tmp_path}/mine.toml" in capsys.readouterr().out
    table = read_detections("found", rolled_rig, skeleton=tmp_path / "mine.toml")
    assert table.skeleton.name == "mine" and len(table[0]) > 0


def colours(count: int) -> np.ndarray:
    """(count, 3) colours in all directions from grey, none near another."""
    n = np.arange(count) + 0.5
    z, turn = 1 - 2 * n / count, np.pi * (1 + 5**0.5) * n
    return np.column_stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z])


def disc_file(path: Path, joints: int, size: tuple[int, int]) -> Path:
    """A network with RTMPose's input and outputs that sees discs of `colours` on grey."""
    mean, std = np.array([123.675, 116.28, 103.53]), np.array([58.395, 57.12, 57.375])
    towards = colours(joints) / 127.5
    own = towards @ (mean - 127.5)
    weights = {
        "w": np.tile(towards * std, (2, 1))[:, :, None, None],
        "b": np.concatenate([own - 0.85, own - 1.1]),
        # As much as the colour is the joint's own; what is beside the picture is too dark.
        "both": np.hstack([7 * np.eye(joints), -40 * np.eye(joints)])[:, :, None, None],
    }
    nodes = [
        node("Conv", "x w b", "near", kernel_shape=[1, 1]),
        node("Relu", "near", "bright"),
        node("Conv", "bright both", "like", kernel_shape=[1, 1]),
        node("Relu", "like", "disc"),
        node("AveragePool", "disc", "smooth", kernel_shape=[5, 5], pads=[2, 2, 2, 2]),
        node("AveragePool", "smooth", "maps", kernel_shape=[5, 5], pads=[2, 2, 2, 2]),
        node("ReduceMax", "maps", "simcc_x", axes=[2], keepdims=0),
        node("ReduceMax", "maps", "simcc_y", axes=[3], keepdims=0),
    ]
    gives = {"simcc_x": ("n", joints, size[0]), "simcc_y": ("n", joints, size[1])}
    return onnx_model(path, nodes, weights, ("n", 3, size[1], size[0]), gives)


@pytest.mark.slow
def test_detected_feet_are_reconstructed_feet(rolled_rig, tmp_path, capsys, monkeypatch):
    """A man of the built-in scene, painted for three cameras, one of them rolled: HALPE-26 in and
    out.
    """
    monkeypatch.chdir(tmp_path)
    frames, scene = 4, built_in_scene(frames=4)
    truth = np.stack([scene.truth_at(frame)[0] for frame in range(frames)])
    truth[..., :2] -= truth[:, BODY_25.index("MidHip"), None, :2].mean(axis=0)
    named = {name: truth[:, BODY_25.index(name)] for name in BODY_25.joints}
    named["Head"] = named["Nose"] + [0, 0, 0.15]
    joints = np.stack([named[name] for name in HALPE_26.joints], axis=1)
    paints = np.round(127.5 * (1 + colours(26))).astype(int).tolist()
    write_rig(rolled_rig, "calibration.json")
    for camera in rolled_rig.cameras:
        (Path("shots") / camera.name).mkdir(parents=True)
        for frame in range(frames):
            picture = np.full((480, 640, 3), 127, np.uint8)
            for (x, y), paint in zip(
                camera.distort(camera.project(joints[frame])[0]), paints, strict=True
            ):
                cv2.circle(
                    picture, (round(16 * x), round(16 * y)), 5 * 16, paint, -1, cv2.LINE_AA, 4
                )
            cv2.imwrite(f"shots/{camera.name}/{frame:02d}.png", picture)
    disc_file(Path("pose.onnx"), 26, (640, 480))
    constant_file(Path("yolox.onnx"), (416, 416), dets=np.array([[[0.0, 0, 416, 416, 0.9]]]))
    words = (
        "--calibration calibration.json --images shots --network pose.onnx --boxes yolox.onnx "
        "--fps 25"
    )
    for line in (f"detect {words} --output found", None):
        if line is None:
            line = re.findall("next: shapepose-fg (.*)", capsys.readouterr().out)[0]
        with pytest.raises(SystemExit) as end:
            main(shlex.split(line))
        assert not end.value.code
    written = json.loads(Path("found/a.json").read_text())
    seen = written["instance_info"]
    assert written["meta_info"] == {"dataset_name": "HALPE_26"}
    assert [frame["frame_id"] for frame in seen] == list(range(frames))
    assert np.shape(seen[0]["instances"][0]["keypoints"]) == (26, 2)
    people = Reconstruction.load(tmp_path / "results")
    assert people.joints.shape == (frames, 26, 3) and tuple(people.joint_names) == HALPE_26.joints
    feet = [
        HALPE_26.index(f"{side}{part}")
        for side in "LR"
        for part in ("BigToe", "SmallToe", "Heel", "Ankle")
    ]
    off = np.linalg.norm(people.joints[:, feet] - joints[:, feet], axis=2)
    assert off.mean() < 0.01 and off.max() < 0.03, (off.mean(), off.max())
