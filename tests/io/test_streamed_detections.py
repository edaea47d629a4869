"""Recordings larger than memory: read block by block, kept as files, the same as when they are read
at once.
"""

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.core.detections import Recording
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage import files
from shapepose_fg.core.storage.kept_arrays import InFolder
from shapepose_fg.io.detection_table import BLOCK_FRAMES
from shapepose_fg.io.detections import read_detections
from shapepose_fg.io.detections.association_text import NumberStream
from shapepose_fg.io.detections.json_people import read_one_file
from shapepose_fg.io.write_detections import write_association, write_openpose
from shapepose_fg.simulation import Scene, built_in_scene, simulate

COLUMNS = ("view", "joint", "xy", "confidence", "pairs", "affinity")
FRAMES = 2 * BLOCK_FRAMES + 40


@pytest.fixture(scope="module")
def scene() -> Scene:
    return built_in_scene(people=2, cameras=2, frames=12)


@pytest.fixture(scope="module")
def once(scene) -> Recording:
    return simulate(scene)


def repeated(once: Recording, count: int) -> Recording:
    """The frames over and over, but for the last, in which nobody is."""
    frames = [once[frame % len(once)] for frame in range(count - 1)]
    return Recording(once.skeleton, [*frames, once[0].only(np.zeros(len(once[0]), dtype=bool))])


@pytest.fixture(scope="module")
def text(scene, once, tmp_path_factory) -> Path:
    """Three blocks of frames as text."""
    folder = tmp_path_factory.mktemp("text")
    write_association(repeated(once, FRAMES), scene.rig, folder)
    return folder


def same(one, other) -> None:
    assert len(one) == len(other)
    for frame in range(len(one)):
        for name in COLUMNS:
            found, expected = getattr(one[frame], name), getattr(other[frame], name)
            assert found.dtype == expected.dtype
            np.testing.assert_array_equal(found, expected)


def test_pieces_of_any_length_and_files_give_the_same(text, scene, once, tmp_path, monkeypatch):
    whole = read_detections(text, scene.rig)
    assert len(whole) == FRAMES and len(whole[FRAMES - 1]) == 0
    # But for their order and the digits written, frames are those that were written, whichever
    # block they are in.
    for frame in (0, BLOCK_FRAMES - 1, BLOCK_FRAMES, 2 * BLOCK_FRAMES + 3):
        given = once[frame % len(once)]
        np.testing.assert_allclose(
            np.sort(whole[frame].xy[:, 0]), np.sort(given.xy[:, 0]), atol=2e-3
        )
        np.testing.assert_allclose(
            np.sort(whole[frame].affinity), np.sort(given.affinity), atol=1e-6
        )
    monkeypatch.setattr(files, "PIECE", 777)
    kept = read_detections(text, scene.rig, kept=InFolder(tmp_path / "kept"))
    same(kept, whole)
    assert sorted(file.name for file in (tmp_path / "kept").iterdir()) == [
        f"seen-{n:07d}.safetensors" for n in range(3)
    ]
    backwards = [kept[frame].xy.sum() for frame in range(FRAMES - 1, -1, -1)]
    assert backwards[::-1] == [whole[frame].xy.sum() for frame in range(FRAMES)]


@pytest.mark.slow
def test_people_in_files_give_the_same_and_scores_are_judged_over_all(rig, tmp_path):
    """A JSON file per frame and per camera; scores of the last block alone say that they are per
    cent.
    """
    rng = np.random.default_rng(0)
    for name in ("left", "right"):
        (tmp_path / "frames" / name).mkdir(parents=True)
        results = []
        for frame in range(FRAMES):
            score = 100.0 if frame > 2 * BLOCK_FRAMES else 0.9
            people = [
                np.column_stack([rng.uniform(300, 700, (25, 2)), np.full(25, score)])
                .ravel()
                .tolist()
                for _ in range((frame + 1) % 3)
            ]
            content = {"people": [{"pose_keypoints_2d": each} for each in people]}
            (tmp_path / "frames" / name / f"v_{frame:012d}_keypoints.json").write_text(
                json.dumps(content)
            )
            results += [{"image_id": frame, "keypoints": each} for each in people]
        (tmp_path / "files").mkdir(exist_ok=True)
        (tmp_path / "files" / f"{name}.json").write_text(json.dumps(results))
    frames = read_detections(tmp_path / "frames", rig)
    same(read_detections(tmp_path / "frames", rig, kept=InFolder(tmp_path / "a")), frames)
    files = read_detections(tmp_path / "files", rig, kept=InFolder(tmp_path / "b"))
    same(files, frames)
    assert "scores reach 100" in frames.notes[0] and "divided by 100" in frames.notes[0]
    assert (
        frames[0].confidence.max() == pytest.approx(0.009)
        and frames[FRAMES - 2].confidence.max() == 1
    )
    # People are not kept beside their candidates.
    assert {file.name.split("-")[0] for file in (tmp_path / "a").iterdir()} == {"seen"}


@pytest.mark.slow
def test_a_file_of_all_frames_takes_the_memory_of_its_numbers(tmp_path):
    """5,000 people of COCO, in any order: 2 MB as arrays, 3 MB of text, and 20 as Python's
    objects.
    """
    rng = np.random.default_rng(0)
    frames, keypoints = rng.permutation(5_000) // 2, rng.uniform(1, 900, (5_000, 17, 3)).round(2)
    people = zip(frames.tolist(), keypoints.reshape(-1, 51).tolist(), strict=True)
    file = tmp_path / "camera.json"
    file.write_text(json.dumps([{"image_id": frame, "keypoints": each} for frame, each in people]))
    tracemalloc.start()
    try:
        blocks = read_one_file(file).blocks
        first = next(blocks)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # Beside the arrays: 1,024 people as objects, and up to two pieces of text with what is decoded.
    assert peak < keypoints.nbytes + 10e6
    every = [first, *blocks]
    order = np.argsort(frames, kind="stable")
    np.testing.assert_array_equal(np.concatenate([each.frame for each in every]), frames[order])
    np.testing.assert_array_equal(
        np.concatenate([each.keypoints for each in every]), keypoints[order]
    )
    assert all(np.ptp(each.frame) < BLOCK_FRAMES for each in every)


@pytest.mark.parametrize(
    ("place", "word", "sentence"),
    [
        (-60, "x1", "'x1' is not a finite number"),
        (-60, "nan", "'nan' is not a finite number"),
        (-60, "", "the file ends in frame"),
        (0, "4 1", "numbers after the last of the 1 frames"),
    ],
)
def test_the_line_of_a_mistake_is_told_wherever_it_is(
    text, scene, tmp_path, monkeypatch, place, word, sentence
):
    """In the last block, whose pieces are read when the lines before are forgotten."""
    detections = tmp_path / "detection"
    detections.mkdir()
    for name in scene.rig.names:
        (detections / f"{name}.txt").write_text((text / "detection" / f"{name}.txt").read_text())
    file = detections / f"{scene.rig.names[0]}.txt"
    lines = file.read_text().splitlines()
    lines[place] = word
    line = len(lines) + 1 + place
    file.write_text("\n".join(lines) + "\n")
    said = []
    for piece in (2**20, 501):
        monkeypatch.setattr(files, "PIECE", piece)
        with pytest.raises(InputError) as caught:
            read_detections(tmp_path, scene.rig)
        said.append(str(caught.value))
    assert said[0] == said[1] and sentence in said[0] and said[0].startswith(f"{file}: line ")
    if "finite" in sentence:
        assert f": line {line}: " in said[0]


def test_text_is_utf_8_and_may_have_a_mark_and_other_ends_of_lines(
    text, scene, tmp_path, monkeypatch
):
    name = scene.rig.names[0]
    content = (text / "detection" / f"{name}.txt").read_bytes()
    for each in scene.rig.names:
        (tmp_path / f"{each}.txt").write_bytes((text / "detection" / f"{each}.txt").read_bytes())
    monkeypatch.setattr(files, "PIECE", 4096)
    (tmp_path / f"{name}.txt").write_bytes(b"\xef\xbb\xbf" + content.replace(b"\n", b"\r\n"))
    same(read_detections(tmp_path, scene.rig), read_detections(text, scene.rig))
    (tmp_path / f"{name}.txt").write_bytes(content[:100_000] + b"\xff" + content[100_000:])
    with pytest.raises(InputError, match=r"byte 100000 is not UTF-8 text"):
        read_detections(tmp_path, scene.rig)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_recording(scene, once, tmp_path, monkeypatch):
    """More than twice the frames in as much memory."""
    monkeypatch.setattr(files, "PIECE", 2**15)  # a tenth of a block
    peaks = []
    for blocks in (2, 5):
        folder = tmp_path / str(blocks)
        write_association(repeated(once, blocks * BLOCK_FRAMES), scene.rig, folder)
        tracemalloc.start()
        table = read_detections(folder, scene.rig, kept=InFolder(folder / "kept"))
        assert [len(table[n * BLOCK_FRAMES]) > 0 for n in range(blocks)] == blocks * [True]
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0]


@pytest.mark.parametrize(
    "other", ["", "1e-07", "+3", "1234567890123456789", "0.1234567890123456789"]
)
def test_numbers_are_read_as_python_reads_them(other, tmp_path):
    rng = np.random.default_rng(0)
    words = [f"{value:.{digits}f}" for digits in range(13) for value in rng.normal(0, 9, 200)]
    words += [
        "-0",
        "5.",
        ".5",
        "-.25",
        "0000.10",
        "999999999999999",
        "0.00000000000001",
        *other.split(),
    ]
    file = tmp_path / "numbers.txt"
    file.write_bytes(" \n\t\r\n".join(words).encode())
    stream = NumberStream(file)
    assert stream.reaches(len(words)) and not stream.reaches(len(words) + 1)
    expected = np.array([float(word) for word in words])
    assert stream.values.tobytes() == expected.tobytes()  # to the last bit, and the sign of zero


@pytest.mark.slow
@pytest.mark.parametrize(("lead", "end"), [(1, 3), (BLOCK_FRAMES + 7, 0)])
def test_files_of_which_some_frames_are_common(scene, once, tmp_path, lead, end):
    """Camera 1 has `lead` frames less at the beginning and `end` less at the end: by number, block
    by block.
    """
    whole = repeated(once, FRAMES)
    write_openpose(whole, scene.rig, tmp_path / "whole")
    everything = read_detections(tmp_path / "whole", scene.rig)
    folder = tmp_path / "whole" / scene.rig.names[1]
    files = sorted(
        folder.iterdir() if folder.is_dir() else folder.with_name(f"{folder.name}_json").iterdir()
    )
    for file in [*files[:lead], *files[FRAMES - end :]]:
        file.unlink()
    table = read_detections(tmp_path / "whole", scene.rig)
    assert len(table) == FRAMES - lead - end
    for frame in range(len(table)):
        for name in COLUMNS:
            np.testing.assert_array_equal(
                getattr(table[frame], name), getattr(everything[lead + frame], name)
            )
    every = read_detections(tmp_path / "whole", scene.rig, own_frames=True)
    assert len(every) == FRAMES
    for frame in range(FRAMES):
        one = everything[frame]
        there = one if lead <= frame < FRAMES - end else one.only(one.view == 0)
        for name in COLUMNS:
            np.testing.assert_array_equal(getattr(every[frame], name), getattr(there, name))
