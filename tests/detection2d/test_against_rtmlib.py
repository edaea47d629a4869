"""Boxes and joints against `rtmlib` 0.0.16 on the same made ONNX files and pictures.

rtmlib is no dependency, as it asks for two other OpenCVs: to run this, `pip install --no-deps
--target DIR rtmlib tqdm` and add DIR to PYTHONPATH. Of 1905 made people boxes were equal, joints to
1e-12 pixels.
"""

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest

from shapepose_fg.detection2d.opening import open_network
from shapepose_fg.detection2d.top_down import TopDownNetwork
from tests.detection2d.conftest import rtmpose_file, yolox_file

rtmlib = pytest.importorskip(
    "rtmlib", reason="rtmlib is the reference of a development-only environment"
)
pytest.importorskip("onnxruntime", reason="onnxruntime is an extra: shapepose-fg[detect]")

SIZES = ((640, 480), (1920, 1080), (1080, 1920), (640, 640))


@pytest.mark.slow
@pytest.mark.parametrize("suppressed", [False, True])
@pytest.mark.parametrize("shown, boxed", [((192, 256), (416, 416)), ((288, 384), (640, 640))])
def test_boxes_and_joints_are_rtmlib_s(tmp_path: Path, monkeypatch, shown, boxed, suppressed):
    monkeypatch.setattr(
        "shapepose_fg.detection2d.boxes._MOST_PEOPLE", 1000
    )  # rtmlib has no such bound
    rng, people, off = np.random.default_rng(0), 0, []
    for seed, (width, height) in itertools.product(range(2), SIZES):
        pose = rtmpose_file(tmp_path / f"pose{seed}.onnx", 26, shown, seed)
        yolox = yolox_file(tmp_path / f"yolox{seed}.onnx", boxed, seed, 1, suppressed)
        network = open_network(str(pose), str(yolox), Path)
        assert isinstance(network, TopDownNetwork) and network.boxes is not None
        coarse = rng.integers(0, 256, (height // 20, width // 20, 3), dtype=np.uint8)
        picture = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        boxes = rtmlib.YOLOX(str(yolox), model_input_size=boxed[::-1])(picture).reshape(-1, 4)
        joints, scores = rtmlib.RTMPose(str(pose), model_input_size=shown)(picture, bboxes=boxes)
        mine, found = network.boxes.find(picture), network.detect(picture)
        assert len(mine) == len(boxes) > 0
        # rtmlib does not sort boxes that the network has suppressed itself.
        order, others = np.lexsort(mine.round(2).T), np.lexsort(boxes.round(2).T)
        seen = scores[others] > 0
        off.append([
            np.abs(mine[order] - boxes[others]).max(),
            np.abs(found.xy[order] - joints[others])[seen].max(),
            np.abs(found.score[order] - scores[others]).max(),
        ])  # fmt: skip
        people += len(boxes)
    worst = np.max(off, axis=0)
    print(
        f"{people} people: boxes {worst[0]:.1e} px, joints {worst[1]:.1e} px, scores {worst[2]:.1e}"
    )
    assert worst[0] < 0.01 and worst[1] < 0.01 and worst[2] < 1e-4
