"""Files of weights: read as written, refused where damaged or for another body; which fitter is
made of them.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file

from shapepose_fg.body.fitting.fitters import BodyConfig, SmplFitter, make_fitter
from shapepose_fg.body.fitting.network import NetworkConfig, UpdateNetwork, layer_shapes
from shapepose_fg.body.fitting.person_frame import PersonFrame
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.fitting.weights import FitterWeights, fingerprint
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.target_skeletons import BODY_POINTS
from shapepose_fg.core.errors import InputError
from shapepose_fg.io.config import read_config
from shapepose_fg.pipeline.config import PipelineConfig


@pytest.fixture(scope="module")
def weights() -> FitterWeights:
    """Untrained weights of a small network on the shipped body."""
    config, rng = NetworkConfig(width=16, blocks=1, steps=2), np.random.default_rng(0)
    network = UpdateNetwork(
        config, {name: rng.normal(size=shape) for name, shape in layer_shapes(config).items()}
    )
    model, prior = BodyModel.default(), PosePrior.default()
    poses = np.concatenate(
        (np.zeros((50, 1, 3)), prior.sample(np.random.default_rng(0), 50)), axis=1
    )
    frame = PersonFrame.of(model, poses, np.ones(50))
    spread = np.linspace(0.5, 2.0, len(BODY_POINTS))
    return FitterWeights(
        network, frame, fingerprint(model), spread, {"data": "none", "command": "python"}
    )


@pytest.fixture
def file(weights, tmp_path) -> Path:
    weights.save(tmp_path / "weights.safetensors")
    return tmp_path / "weights.safetensors"


@pytest.fixture
def tiny_body(make_smpl_arrays, tmp_path) -> BodyModel:
    np.savez(tmp_path / "tiny.npz", **make_smpl_arrays())
    return BodyModel.load(tmp_path / "tiny.npz")


def contents(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    with safe_open(path, framework="np") as file:
        return {name: file.get_tensor(name) for name in file.keys()}, file.metadata()  # noqa: SIM118


def assert_refused(path: Path, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        FitterWeights.load(path)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)
    assert "train" in str(error.value)  # the cure


def test_files_give_back_what_was_written(weights, file):
    again = FitterWeights.load(file)
    assert again.network.config == weights.network.config
    assert again.body == weights.body and again.card == weights.card
    np.testing.assert_allclose(again.spread, weights.spread, atol=1e-6)
    for name, value in vars(weights.frame).items():
        np.testing.assert_allclose(
            getattr(again.frame, name), value, atol=1e-6
        )  # in single precision
    inputs = np.ones((3, UpdateNetwork.num_inputs), np.float32)
    np.testing.assert_array_equal(again.network(inputs, 1), weights.network(inputs, 1))


def test_what_is_no_safetensors_file_is_refused(tmp_path, file):
    assert_refused(tmp_path / "nothing.safetensors", "there is no such file")
    for damage in (
        file.read_bytes()[:1000],
        file.read_bytes()[:-500],
        b"",
        b"PK\x03\x04 an archive",
        b"\xff" * 64,
    ):
        (tmp_path / "damaged.safetensors").write_bytes(damage)
        assert_refused(tmp_path / "damaged.safetensors", "cannot be read as safetensors")
    with pytest.raises(InputError, match="this is a folder"):
        FitterWeights.load(tmp_path)


@pytest.mark.parametrize(
    "metadata", [None, {}, {"format": "pt"}, {"format": "shapepose-fg fitter 0"}]
)
def test_other_safetensors_files_are_refused(file, metadata):
    tensors, _ = contents(file)
    save_file(tensors, file, metadata=metadata)
    assert_refused(
        file, r"not weights of the learned fitter; train some with shapepose-fg train-fitter"
    )


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["leave.weight", "spread", "frame.rest_xyz"])
def test_numbers_that_are_not_finite_are_refused(file, name, value):
    tensors, about = contents(file)
    tensors[name].reshape(-1)[3] = value
    save_file(tensors, file, metadata=about)
    assert_refused(file, "have values that are not finite")


@pytest.mark.parametrize(
    "damage", ["no spread", "no bias", "no frame", "half a frame", "odd size", "odd setting",
               "text", "no body",
               "list", "short spread", "short frame"]
)  # fmt: skip
def test_weights_of_another_version_are_refused(file, damage):
    tensors, about = contents(file)
    if damage.startswith("no ") and damage != "no body":
        wanted = {"no spread": "spread", "no bias": "leave.bias", "no frame": "frame."}[damage]
        tensors = {name: value for name, value in tensors.items() if not name.startswith(wanted)}
    elif damage == "half a frame":
        del tensors["frame.local"]
    elif damage == "odd size":
        tensors["enter.weight"] = tensors["enter.weight"][:, 1:].copy()
    elif damage == "odd setting":
        about["network"] = json.dumps(json.loads(about["network"]) | {"heads": 8})
    elif damage == "text":
        about["network"] = "{"
    elif damage == "list":
        about["network"] = "[1, 2]"
    elif damage == "no body":
        del about["body"]
    elif damage == "short spread":
        tensors["spread"] = tensors["spread"][:25].copy()
    else:
        tensors["frame.rest_xyz"] = tensors["frame.rest_xyz"][:25].copy()
    save_file(tensors, file, metadata=about)
    assert_refused(file, "another version of the fitter")


def test_weights_belong_to_one_body(weights, tiny_body, file):
    with pytest.raises(
        InputError, match=r"trained on another body model: train weights for yours .* --body"
    ):
        SmplFitter(tiny_body, weights=weights)
    with pytest.raises(InputError, match="another body model"):
        make_fitter(BodyConfig(method="learned", weights=str(file)), tiny_body)
    assert fingerprint(tiny_body) != fingerprint(BodyModel.default())
    # Neither precision nor keypoints make another body.
    assert fingerprint(tiny_body) == fingerprint(tiny_body.with_keypoints(("Nose", "Neck")))


def test_the_fitter_is_the_one_that_is_asked_for(weights, file, tiny_body, shipped_weights):
    assert make_fitter(model=tiny_body).weights is None  # whatever the default: it works
    assert make_fitter(BodyConfig(method="plain"), tiny_body).weights is None
    learned = make_fitter(BodyConfig(method="learned"))
    assert learned.weights is shipped_weights
    assert make_fitter(BodyConfig(method="auto")).weights is shipped_weights
    assert make_fitter(BodyConfig(method="auto"), tiny_body).weights is None
    own = make_fitter(BodyConfig(method="auto", weights=str(file)))
    assert own.weights is not None and own.weights.card == weights.card
    with pytest.raises(ValueError, match="method must be one of auto learned plain, got 'best'"):
        BodyConfig(method="best")
    with pytest.raises(InputError, match="nowhere"):
        make_fitter(BodyConfig(method="learned", weights="nowhere.safetensors"))


def test_the_shipped_weights_are_for_the_shipped_body_and_say_where_they_are_from(shipped_weights):
    shipped_weights.check(BodyModel.default())
    assert shipped_weights.card
    assert (
        shipped_weights.spread.shape == (len(BODY_POINTS),) and (shipped_weights.spread > 0).all()
    )


@pytest.mark.parametrize("table", ["learned", "plain"])
def test_settings_of_before_are_told_what_took_their_place(tmp_path, table):
    (tmp_path / "settings.toml").write_text(f"[body.{table}]\nkernel_scale = 5.0\n")
    with pytest.raises(
        InputError, match=rf"body\.{table} is part of \[body\] now, with model_sigma_m"
    ):
        read_config(tmp_path / "settings.toml", PipelineConfig)
