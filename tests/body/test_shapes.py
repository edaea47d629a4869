"""Known people's shapes: kept to the last digit, refused on another body, and how tall they are."""

import numpy as np
import pytest

from shapepose_fg.body.fitting.weights import fingerprint
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.body.shapes import SubjectShapes, recognise, statures_m
from shapepose_fg.core.errors import InputError
from tests.conftest import read_body


def two_shapes(body: str = "a body") -> SubjectShapes:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(2, 10, 10))
    return SubjectShapes(
        np.array(["Ann", "3"]),
        rng.normal(size=(2, 10)),
        root @ root.swapaxes(-1, -2) + np.eye(10),
        body,
    )


def test_saved_and_loaded_is_the_same(tmp_path):
    two_shapes().save(tmp_path / "subjects.npz")
    loaded = SubjectShapes.load(tmp_path / "subjects.npz", "a body")
    assert loaded.names.tolist() == ["Ann", "3"]
    np.testing.assert_array_equal(loaded.betas, two_shapes().betas)
    np.testing.assert_array_equal(loaded.information, two_shapes().information)
    np.testing.assert_allclose(
        loaded.covariance @ loaded.information, np.tile(np.eye(10), (2, 1, 1)), atol=1e-9
    )
    SubjectShapes.empty("a body").save(tmp_path / "nobody.npz")
    assert len(SubjectShapes.load(tmp_path / "nobody.npz", "a body")) == 0


def test_shapes_of_another_body_are_refused(tmp_path):
    two_shapes("their body").save(tmp_path / "subjects.npz")
    with pytest.raises(
        InputError, match=r"subjects.npz: these are shapes of another body model, .* with --body"
    ):
        SubjectShapes.load(tmp_path / "subjects.npz", fingerprint(BodyModel.default()))
    with pytest.raises(ValueError, match="same body model"):
        two_shapes().updated(two_shapes("their body"))


def test_a_newer_shape_takes_the_place_of_the_older():
    newer = SubjectShapes(
        np.array(["3", "Bob"]), np.ones((2, 10)), np.tile(5 * np.eye(10), (2, 1, 1)), "a body"
    )
    both = two_shapes().updated(newer)
    assert both.names.tolist() == ["Ann", "3", "Bob"]
    np.testing.assert_array_equal(both.betas[0], two_shapes().betas[0])
    np.testing.assert_array_equal(both.betas[1:], 1)
    np.testing.assert_array_equal(both.information[1], 5 * np.eye(10))


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"names": np.array(["Ann", "Ann"])}, "names must differ, but 'Ann' occurs twice"),
        (
            {"betas": np.full((2, 10), np.nan)},
            "betas and information must be finite, but those of 'Ann' are not",
        ),
        ({"betas": np.zeros((2, 11))}, "betas must be (2, 10), got (2, 11)"),
        (
            {"information": np.tile(-np.eye(10), (2, 1, 1))},
            "information must be symmetric and positive definite",
        ),
        (
            {"information": np.tile(1e-9 * np.eye(10), (2, 1, 1))},
            "information must be symmetric and positive",
        ),
        (
            {"information": np.tile(1e150 * np.eye(10), (2, 1, 1))},
            "betas and information must be at most 1e+12",
        ),
        (
            {"information": np.tile(np.triu(np.ones((10, 10))), (2, 1, 1))},
            "information must be symmetric",
        ),
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
        BodyParameters(betas, pose.global_orient, pose.body_pose, pose.transl)
    )
    tall = np.ptp(vertices[..., 1], axis=1)
    found = statures_m(betas, read_body())
    np.testing.assert_allclose(found, tall, atol=1e-5)  # the mesh is float32
    assert found.min() > 1.3 and found.max() < 2.2


def drawn(seed: int, people: int, sigma: float) -> tuple[SubjectShapes, SubjectShapes]:
    """What two recordings told of adults' betas: as of betas that were seen with an error of
    `sigma`.
    """
    rng = np.random.default_rng(seed)
    betas = rng.normal(size=(people, 10))
    information = np.tile((1 + sigma**-2) * np.eye(10), (people, 1, 1))
    names = np.array([f"p{person}" for person in range(people)])
    recordings = []
    for _ in range(2):
        seen = betas + sigma * rng.normal(size=betas.shape)
        # The prior over adults pulls the estimate to 0.
        recordings.append(
            SubjectShapes(names, seen * sigma**-2 / (1 + sigma**-2), information, "a body")
        )
    first, second = recordings
    return first, second


def test_who_was_there_before_is_recognised_and_strangers_are_not():
    first, second = drawn(0, people=8, sigma=0.3)
    order = np.array([5, 2, 7, 0])
    whose = recognise(second.rows(order), first.rows(np.arange(6)))  # 7 is new, 1 3 4 are not there
    assert whose.tolist() == [5, 2, -1, 0]
    assert recognise(second, SubjectShapes.empty("a body")).tolist() == [-1] * 8
    assert recognise(SubjectShapes.empty("a body"), first).tolist() == []
    with pytest.raises(ValueError, match="same body model"):
        recognise(second, two_shapes("their body"))


def test_the_evidence_is_that_of_gaussians():
    """One known person, worked out: N(m; b, S1 + S2) against N(m; 0, S1 + 1)."""
    from scipy.stats import multivariate_normal

    first, second = drawn(1, people=1, sigma=0.5)
    measured = second.betas[0] * (1 + 0.5**-2) / 0.5**-2  # without the prior
    same = multivariate_normal(first.betas[0], 0.5**2 * np.eye(10) + first.covariance[0]).logpdf(
        measured
    )
    stranger = multivariate_normal(np.zeros(10), (0.5**2 + 1) * np.eye(10)).logpdf(measured)
    threshold = np.exp(same - stranger)
    assert recognise(second, first, ratio=0.99 * threshold).tolist() == [0]
    assert recognise(second, first, ratio=1.01 * threshold).tolist() == [-1]


def test_where_nothing_was_seen_nobody_is_recognised():
    """No information beyond the prior: everybody is as likely as any adult, and exactly so."""
    first, _ = drawn(2, people=3, sigma=0.3)
    unseen = SubjectShapes(np.array(["0"]), np.zeros((1, 10)), np.eye(10)[None], "a body")
    assert recognise(unseen, first).tolist() == [-1]
    assert recognise(unseen, first, ratio=1.0).tolist() == [-1]


def test_how_often_people_are_confused():
    """40 rooms of six people and three strangers, shapes known to 0.3 sigma: nobody is taken for
    another.
    """
    wrong = missed = 0
    for seed in range(40):
        first, second = drawn(seed, people=9, sigma=0.3)
        whose = recognise(second, first.rows(np.arange(6)))
        truth = np.array([0, 1, 2, 3, 4, 5, -1, -1, -1])
        wrong += int(((whose >= 0) & (whose != truth)).sum())
        missed += int(((whose < 0) & (truth >= 0)).sum())
    assert wrong <= 2 and missed <= 4  # of 240
