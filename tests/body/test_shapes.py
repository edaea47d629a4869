"""Known people's shapes: kept to the last digit, refused on another body, and how tall they are."""

import numpy as np
import pytest
import torch

from shapepose_fg.body.fitting.weights import fingerprint
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.body.shapes import SubjectShapes, read_body, statures_m
from shapepose_fg.errors import InputError


def two_shapes(body: str = "a body") -> SubjectShapes:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(2, 10, 10))
    return SubjectShapes(np.array(["Ann", "3"]), rng.normal(size=(2, 10)), root @ root.mT + np.eye(10), body)


def test_saved_and_loaded_is_the_same(tmp_path):
    two_shapes().save(tmp_path / "subjects.npz")
    loaded = SubjectShapes.load(tmp_path / "subjects.npz", "a body")
    assert loaded.names.tolist() == ["Ann", "3"]
    np.testing.assert_array_equal(loaded.betas, two_shapes().betas)
    np.testing.assert_array_equal(loaded.information, two_shapes().information)
    np.testing.assert_allclose(loaded.covariance @ loaded.information, np.tile(np.eye(10), (2, 1, 1)), atol=1e-9)
    SubjectShapes.empty("a body").save(tmp_path / "nobody.npz")
    assert len(SubjectShapes.load(tmp_path / "nobody.npz", "a body")) == 0


def test_shapes_of_another_body_are_refused(tmp_path):
    two_shapes("their body").save(tmp_path / "subjects.npz")
    with pytest.raises(InputError, match=r"subjects.npz: these are shapes of another body model, .* give --body"):
        SubjectShapes.load(tmp_path / "subjects.npz", fingerprint(BodyModel.default()))
    with pytest.raises(ValueError, match="same body model"):
        two_shapes().updated(two_shapes("their body"))


def test_a_newer_shape_takes_the_place_of_the_older():
    newer = SubjectShapes(np.array(["3", "Bob"]), np.ones((2, 10)), np.tile(5 * np.eye(10), (2, 1, 1)), "a body")
    both = two_shapes().updated(newer)
    assert both.names.tolist() == ["Ann", "3", "Bob"]
    np.testing.assert_array_equal(both.betas[0], two_shapes().betas[0])
    np.testing.assert_array_equal(both.betas[1:], 1)
    np.testing.assert_array_equal(both.information[1], 5 * np.eye(10))


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"names": np.array(["Ann", "Ann"])}, "names must differ, 'Ann' occurs twice"),
        ({"betas": np.full((2, 10), np.nan)}, "betas and information must be finite, those of 'Ann' are not"),
        ({"betas": np.zeros((2, 11))}, "betas must be (2, 10), got (2, 11)"),
        ({"information": np.tile(-np.eye(10), (2, 1, 1))}, "information must be symmetric and positive definite"),
        ({"information": np.tile(np.triu(np.ones((10, 10))), (2, 1, 1))}, "information must be symmetric"),
        ({"body": np.zeros(3)}, "these are shapes of another body model"),
        ({"information": None}, "column information is missing"),
    ],
)
def test_bad_files(tmp_path, changed, sentence):
    file = tmp_path / "subjects.npz"
    two_shapes().save(file)
    with np.load(file) as archive:
        columns = dict(archive) | changed
    np.savez(file, **{name: column for name, column in columns.items() if column is not None})
    with pytest.raises(InputError) as caught:
        SubjectShapes.load(file, "a body")
    assert str(caught.value).startswith(f"{file}: ") and sentence in str(caught.value)


def test_damaged_files_are_one_sentence_or_none(tmp_path):
    file, rng = tmp_path / "subjects.npz", np.random.default_rng(0)
    two_shapes().save(file)
    whole, refused = file.read_bytes(), 0
    for _ in range(200):
        damaged = bytearray(whole)
        damaged[int(rng.integers(len(whole)))] ^= int(rng.integers(1, 256))
        file.write_bytes(bytes(damaged))
        try:
            SubjectShapes.load(file, "a body")
        except InputError as error:
            refused += 1
            assert str(error).startswith(f"{file}: ") and "\n" not in str(error)
    assert refused > 150


def test_stature_is_that_of_the_mesh():
    model, betas = BodyModel.default(), np.random.default_rng(0).normal(size=(4, 10))
    pose = BodyParameters.zeros(4)
    vertices = model.vertices(
        BodyParameters(torch.from_numpy(betas).float(), pose.global_orient, pose.body_pose, pose.transl)
    )
    tall = np.ptp(vertices[..., 1].numpy(), axis=1)
    found = statures_m(betas, read_body())
    np.testing.assert_allclose(found, tall, atol=1e-5)  # the mesh is float32
    assert found.min() > 1.3 and found.max() < 2.2
