"""scripts/train_fitter.py: a short run from a folder of motions to weights that fit."""

import importlib.util
import json
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open

from shapepose_fg.body.fitting.fitter import BodyConfig, JointTargets
from shapepose_fg.body.fitting.fitters import SmplFitter
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.fitting.weights import FitterWeights
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.core.errors import InputError

SCRIPT = Path(__file__).parents[3] / "scripts" / "train_fitter.py"


@pytest.fixture
def script(monkeypatch):
    """The script as a module, with fewer people to validate and to calibrate on."""
    spec = importlib.util.spec_from_file_location("train_fitter", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "train_fitter", module)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "VALIDATION_PEOPLE", 32)
    monkeypatch.setattr(module, "calibrated", partial(module.calibrated, count=32))
    before = torch.get_num_threads()
    yield partial(module.main, batch=16, validate_every=2)
    torch.set_num_threads(before)


def write_motions(folder: Path, subjects: tuple[str, ...]) -> Path:
    """A folder of AMASS files, one of 40 frames for each subject."""
    rng = np.random.default_rng(0)
    for subject in subjects:
        poses = np.zeros((40, 156))
        poses[:, 0] = np.pi / 2  # z up
        poses[:, 3:66] = PosePrior.default().sample(rng, 40)[:, :21].reshape(40, 63)
        (folder / subject).mkdir(parents=True)
        np.savez(folder / subject / "stand_poses.npz", poses=poses, mocap_framerate=30.0)
    return folder


def tensors(path: Path) -> dict[str, np.ndarray]:
    with safe_open(path, framework="pt") as file:
        return {name: file.get_tensor(name).numpy() for name in file.keys()}  # noqa: SIM118


@pytest.mark.slow
def test_a_run_writes_weights_that_fit_and_the_same_each_time(script, tmp_path):
    motions = write_motions(tmp_path / "motions", ("01", "05", "06", "60"))
    whole, part = tmp_path / "whole.safetensors", tmp_path / "part.safetensors"
    script(motions, whole, iterations=4)
    script(motions, part, iterations=4)
    expected = tensors(whole)
    for name, value in tensors(part).items():
        np.testing.assert_array_equal(value, expected[name], err_msg=name)
    for path in (whole, part):
        lines = [json.loads(line) for line in path.with_suffix(".log").read_text().splitlines()]
        assert [line["iteration"] for line in lines] == [2, 4]
        assert all(20 < error < 400 for line in lines for error in line["validation_mm"])  # millimetres

    weights = FitterWeights.load(whole)
    card = weights.card
    assert "80 frames of 2 subjects for training" in card["data"]
    assert "60 61" in card["not seen"] and "mocap.cs.cmu.edu" in card["acknowledgement"]
    assert str(tmp_path) not in " ".join(card.values())  # nobody's folders
    body = BodyModel.default().keypoints(BodyParameters.zeros(1)).double().numpy()
    information = np.broadcast_to(np.eye(3) / 0.01**2, (1, 25, 3, 3))
    polished = BodyConfig(polish_steps=12)  # four iterations teach nothing
    fit = SmplFitter(weights=weights, config=polished).fit(JointTargets(body, information))
    assert fit.ok.all() and np.linalg.norm(fit.joints - body, axis=-1).mean() < 0.1


@pytest.mark.parametrize(("subjects", "missing"), [(("01",), "validation"), (("06", "60"), "train")])
def test_motions_without_one_of_the_parts_are_refused_at_once(script, tmp_path, subjects, missing):
    motions = write_motions(tmp_path / "motions", subjects)
    with pytest.raises(InputError, match=f"no {missing} subjects"):
        script(motions, tmp_path / "fitter.safetensors", iterations=2)
    assert not (tmp_path / "fitter.log").exists()
