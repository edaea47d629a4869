import re

import numpy as np
import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.detection2d import onnx_file as reading
from shapepose_fg.detection2d.heat_maps import HeatMapNetwork, layouts
from tests.detection2d.conftest import blob, onnx_file, varint


def means(channels: int, gain: float = 1.0) -> np.ndarray:
    """Weights that make channel c the mean of colour c % 3 of each cell."""
    weights = np.zeros((channels, 3, 8, 8), dtype=np.float32)
    weights[np.arange(channels), np.arange(channels) % 3] = gain / 64
    return weights


BACKENDS = ["opencv", "onnxruntime"]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", ["tf-pose", "openpose-body25"])
def test_runs_pictures_of_any_size_with_the_layout_s_colours(tmp_path, name, backend):
    if backend == "onnxruntime":
        pytest.importorskip("onnxruntime", reason="onnxruntime is an extra: shapepose-fg[detect]")
    layout = layouts()[name]
    network = HeatMapNetwork.load(
        onnx_file(tmp_path / "n.onnx", means(layout.channels)), name, backend
    )
    rng = np.random.default_rng(0)
    for height, width in ((16, 32), (48, 16)):
        picture = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
        cells = picture.reshape(height // 8, 8, width // 8, 8, 3).mean(axis=(1, 3))
        expected = cells * layout.scale + layout.offset
        output = network.run(picture)
        assert output.shape == (layout.channels, height // 8, width // 8)
        for channel in range(6):
            np.testing.assert_allclose(
                output[channel], expected[..., channel % 3], rtol=1e-3, atol=1e-3
            )


def test_body_25_is_told_by_its_channels_and_coco_must_be_named(tmp_path):
    network = HeatMapNetwork.load(onnx_file(tmp_path / "n.onnx", means(78)))
    assert network.layout.name == "openpose-body25"
    coco = onnx_file(tmp_path / "coco.onnx", means(57))
    with pytest.raises(
        InputError,
        match=r"output for pictures of 64 x 64 pixels is 1 x 57 x 8 x 8: .*--layout tf-pose or"
        r" openpose-coco",
    ):
        HeatMapNetwork.load(coco)
    assert HeatMapNetwork.load(coco, "openpose-coco").layout.offset == -0.5


def test_onnxruntime_keeps_to_the_size_that_the_file_fixes(tmp_path):
    pytest.importorskip("onnxruntime", reason="onnxruntime is an extra: shapepose-fg[detect]")
    file = onnx_file(tmp_path / "n.onnx", means(78), fixed=(32, 64))
    network = HeatMapNetwork.load(file, backend="onnxruntime")
    assert network.network.size == (64, 32)
    assert network.run(np.zeros((32, 64, 3), np.uint8)).shape == (78, 4, 8)


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS)
def test_what_is_no_such_network_is_said(tmp_path, backend):
    if backend == "onnxruntime":
        pytest.importorskip("onnxruntime", reason="onnxruntime is an extra: shapepose-fg[detect]")
    with pytest.raises(InputError, match="there is no such file"):
        HeatMapNetwork.load(tmp_path / "no.onnx", backend=backend)
    with pytest.raises(InputError, match="this is a folder"):
        HeatMapNetwork.load(tmp_path, backend=backend)
    cut = onnx_file(tmp_path / "cut.onnx", means(78))
    for content in (b"", b"not a network", cut.read_bytes()[:700]):
        cut.write_bytes(content)
        with pytest.raises(InputError, match=re.escape(str(cut))):
            HeatMapNetwork.load(cut, backend=backend)
    other = onnx_file(tmp_path / "other.onnx", means(7))
    with pytest.raises(
        InputError,
        match=r"output .* is 1 x 7 x 8 x 8: no known layout.*give another network, or --boxes",
    ):
        HeatMapNetwork.load(other, backend=backend)
    with pytest.raises(InputError, match=r"output .* is 1 x 7 x 8 x 8: no known layout"):
        HeatMapNetwork.load(other, "tf-pose", backend)
    with pytest.raises(InputError, match="--layout mine: must be one of tf-pose"):
        HeatMapNetwork.load(other, "mine", backend)


def test_a_file_that_is_too_large_is_not_read(tmp_path, monkeypatch):
    file = onnx_file(tmp_path / "n.onnx", means(78))
    monkeypatch.setattr(reading, "MOST_BYTES", file.stat().st_size)
    assert HeatMapNetwork.load(file).layout.channels == 78
    with file.open("ab") as stream:
        stream.truncate(2**40)  # a hole: takes no room on the disk
    monkeypatch.undo()
    with pytest.raises(InputError, match=r"the file is over 512 MiB"):
        HeatMapNetwork.load(file)


def test_weights_in_other_files_are_refused_wherever_they_stand(tmp_path):
    """In the graph, in a node's attribute, in a graph inside of it, in a function, in a sparse
    tensor.
    """
    place = blob(1, b"location") + blob(2, b"../../etc/passwd")
    tensor = varint(1, 3) + blob(13, place) + varint(14, 1)
    inside = blob(6, blob(15, blob(1, tensor)))
    models = [blob(7, blob(5, tensor)), blob(7, blob(1, blob(5, blob(5, tensor))))]
    models += [blob(7, blob(1, blob(5, inside))), blob(25, blob(7, blob(5, blob(10, tensor))))]
    file, whole = tmp_path / "n.onnx", onnx_file(tmp_path / "whole.onnx", means(78)).read_bytes()
    for model in models:
        file.write_bytes(whole + model)
        with pytest.raises(
            InputError, match="its weights are in another file; give a network that contains them"
        ):
            HeatMapNetwork.load(file)


def test_graphs_without_end_are_no_network(tmp_path):
    file, graph = tmp_path / "n.onnx", b""
    for _ in range(200):
        graph = blob(1, blob(5, blob(6, graph)))
    file.write_bytes(blob(7, graph))
    with pytest.raises(InputError, match="cannot be read as an ONNX network"):
        HeatMapNetwork.load(file)


def test_the_real_network_is_known_by_its_checksum(shared_data):
    file = shared_data.parent / "models" / "openpose_mobilenet_v2_small.onnx"
    if not file.is_file():
        pytest.skip(f"no network at {file}")
    network = HeatMapNetwork.load(file)
    assert network.layout.name == "tf-pose"
    assert network.run(np.zeros((48, 64, 3), np.uint8)).shape == (57, 6, 8)
