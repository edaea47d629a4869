"""recordings.toml: defaults, own words over them, paths that stay inside, and a sentence for what
is wrong.
"""

from pathlib import Path

import pytest

from shapepose_fg.cli.batch.table import options_of, read_table
from shapepose_fg.core.errors import InputError


def read(folder: Path, text: str):
    file = folder / "recordings.toml"
    file.write_text(text)
    return read_table(file)


def test_defaults_hold_for_all_and_own_words_go_first(tmp_path):
    walk, dance, jump = read(
        tmp_path,
        """
        [defaults]
        calibration = "cameras.toml"
        fps = 25
        check = false
        [recordings.walk]
        detections = "walk"
        cuts = [300, 600]
        chunk_frames = 960
        [recordings.dance-2]
        detections = "/data/dance"
        timestamps = "dance/times.csv"
        check = true
        skeleton = "COCO_17"
        [recordings.jump]
        project = "jump"
        skeleton = "ours.toml"
        """,
    )
    assert [each.name for each in (walk, dance, jump)] == ["walk", "dance-2", "jump"]
    assert walk.request.calibration == dance.request.calibration == tmp_path / "cameras.toml"
    assert walk.request.detections == tmp_path / "walk" and dance.request.detections == Path(
        "/data/dance"
    )
    assert (
        walk.request.cuts == (300, 600)
        and walk.request.chunk_frames == 960
        and not walk.request.check
    )
    assert walk.request.fps == 25.0 and jump.request.fps == 25.0
    # One way to say when frames were taken: a recording's own stands in the place of both.
    assert (
        dance.request.fps is None and dance.request.timestamps == tmp_path / "dance" / "times.csv"
    )
    assert dance.request.check and dance.request.skeleton == "COCO_17"
    assert (
        jump.request.skeleton == str(tmp_path / "ours.toml")
        and jump.request.project == tmp_path / "jump"
    )
    assert options_of(walk.request) == {
        "calibration": str(tmp_path / "cameras.toml"),
        "detections": str(tmp_path / "walk"),
        "fps": 25.0,
        "cuts": [300, 600],
        "chunk_frames": 960,
        "check": False,
    }


def test_recordings_that_share_shapes_wait_for_each_other_in_the_table_s_order(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path)
    found = read(
        tmp_path,
        '[recordings.c]\nshapes = "who.npz"\n[recordings.a]\n[recordings.b]\nshapes = '
        '"link/who.npz"\n[recordings.d]\nshapes = "others.npz"\n[recordings.e]\nshapes = '
        '"who.npz"\n',
    )
    assert {each.name: each.after for each in found} == {
        "c": None,
        "a": None,
        "b": "c",
        "d": None,
        "e": "b",
    }


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the file is empty"),
        ("[defaults]\nfps = 25", "the table has 0 recordings; give 1 to 10000, each as"),
        (
            "[recording.a]",
            r"recording is not a known table; write \[defaults\] and \[recordings.NAME\]",
        ),
        ("recordings = 3", "recordings must be a table, got 3"),
        ("[recordings]\na = 3", r"recordings\.a must be a table, got 3; docs/batch\.md"),
        (
            "[recordings.a]\nimage-size = '1x1'",
            r"recordings\.a\.image-size .* did you mean recordings\.a\.image_size",
        ),
        (
            "[recordings.a]\nfps = '25'",
            r"recordings\.a\.fps must be a number, got text '25'; docs/batch\.md",
        ),
        ("[recordings.a]\nfps = nan", r"recordings\.a\.fps must be a"),
        (
            "[recordings.a]\ncuts = [1, 2.5]",
            r"recordings\.a\.cuts\[1\] must be a whole number, got 2\.5",
        ),
        ("[defaults]\nworkers = 2\n[recordings.a]", r"defaults\.workers is not a known key"),
        ("[recordings.a]\n[recordings.a]", "cannot be read as TOML .Cannot declare"),
        (
            "[recordings.a]\n[recordings.A]",
            r"recordings\.A: some file systems do not distinguish this name from"
            r" a; rename it",
        ),
        (
            "[recordings.'batch.json']",
            r"recordings\.batch\.json: some file systems do not distinguish this name"
            r" from batch\.json",
        ),
        (
            "[recordings.'../a']",
            r"recordings\.\.\./a: the name is also that of a folder, so it must have up to"
            r" 100 letters",
        ),
        ("[recordings.'.a']", "begin with a letter or digit"),
        (f"[recordings.{101 * 'a'}]", "the name is also that of a folder"),
        (
            "[recordings.a]\ndetections = '../b'",
            r"a\.detections: \.\./b is outside the table's folder; if this",
        ),
        (
            "[recordings.a]\nshapes = 'out/who.npz'",
            r"a\.shapes: out/who\.npz is outside the table's folder",
        ),
        ("[recordings.a]\nskeleton = '../s.toml'", r"a\.skeleton: \.\./s\.toml is outside"),
        (
            '[recordings.a]\nbody = "a\\u0000b"',
            r"recordings\.a\.body: 'a\\x00b' is not a valid file name",
        ),
        (
            '[recordings.a]\nproject = "/a\\u0000b"',
            r"recordings\.a\.project: .* is not a valid file name",
        ),
        (
            "[recordings.a]\nproject='p'\n[recordings.b]\nproject='p'",
            r"recordings\.b: .*p is also the project"
            r" of a",
        ),
    ],
)
def test_what_is_wrong_is_one_sentence(tmp_path, text, words):
    (tmp_path / "out").symlink_to(tmp_path.parent)
    with pytest.raises(InputError, match=words) as found:
        read(tmp_path, text)
    assert str(tmp_path / "recordings.toml") in str(found.value) and "\n" not in str(found.value)
