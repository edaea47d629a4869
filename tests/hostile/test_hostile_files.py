"""Files made to do harm: each is refused in one sentence, at once, in little memory."""

import io
import json
import os
import pickle
import struct
import subprocess
import sys
import time
import zipfile
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.body.fitting.weights import FitterWeights
from shapepose_fg.body.model.smpl_file import read_smpl_file
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.storage.files import read_json, read_text, read_toml
from shapepose_fg.core.storage.npz import read_npz
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.config import read_config
from shapepose_fg.io.detections import read_detections
from shapepose_fg.io.timestamps import read_timestamps
from shapepose_fg.pipeline.pipeline import PipelineConfig
from shapepose_fg.simulation.scene import ring_of_cameras
from tests.hostile.readers import READERS, tiny_body
from tests.marks import slow


def refused(read, *arguments) -> str:
    with pytest.raises(InputError) as caught:
        read(*arguments)
    return str(caught.value)


def in_little_memory(code: str, *arguments: object, before: str = "") -> str:
    """What a process prints that may take 300 MB more than it has after its imports."""
    limit = (
        "import resource\n"
        "used = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()\n"
        "resource.setrlimit(resource.RLIMIT_AS, (used + 300 * 2**20,) * 2)\n"
    )
    begin = (
        "import sys\nfrom pathlib import Path\nfrom shapepose_fg.core.errors import InputError\n"
        "from shapepose_fg.body.model.smpl_file import read_smpl_file\n"
        "from shapepose_fg.core.storage.npz import read_npz\n"
    )
    end = f"try:\n    {code}\n    print('read')\nexcept InputError as error:\n    print(error)\n"
    command = [sys.executable, "-c", begin + before + limit + end, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs a system with pipes in folders")
def test_what_is_no_regular_file_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path, what in (
        (tmp_path / "pipe", "a pipe or a device"),
        (Path("/dev/zero"), "a device"),
        (tmp_path, "a folder"),
    ):
        assert what in refused(read_text, path)
        assert what in refused(lambda path=path: read_npz(path, ("a",), "no cure"))
        if path != tmp_path:
            assert what in refused(read_rig, path)
    os.mkfifo(tmp_path / "body.npz")
    assert "a pipe" in refused(read_smpl_file, tmp_path / "body.npz")


def test_a_file_has_bounds(tmp_path):
    with (tmp_path / "settings.toml").open("wb") as stream:
        stream.truncate(2**31)  # takes no room on the disk
    assert "the file is over 1 MiB" in refused(read_toml, tmp_path / "settings.toml")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("deep.json", "[" * 100_000),
        ("deep.json", "[" * 900 + "]" * 900),
        ("deep.json", '{"a": ' * 900 + "1" + "}" * 900),
        ("digits.json", '{"K": [' + "9" * 5000 + "]}"),
        ("digits.json", '{"K": [' + "9" * 400 + "]}"),
        ("deep.toml", "a = " + "[" * 5000 + "]" * 5000),
        ("dots.toml", "a." * 200_000 + "a = 1"),
        ("digits.toml", "a = " + "9" * 5000),
        ("digits.toml", "a = 0x" + "f" * 5000),
        ("deep.yml", "a: " + "[" * 100_000),
        ("deep.yml", "a: " + "[" * 500 + "]" * 500),
        ("lists.yml",
         "a: &a [1, 1]\n" + "".join(f"{b}: &{b} [*{a}, *{a}]\n" for a,
                                    b in pairwise("abcdefghijk"))),
        ("sixty.yml", "a: " + "1:" * 200_000 + "1"),
        ("twice.yml", "a: 1\na: 2"),
        ("deep.xml", "<a>" * 5000 + "</a>" * 5000),
        ("entities.xml", '<!DOCTYPE a [<!ENTITY b "b">]><a>&b;</a>'),
        ("line.toml", "[" + "a" * 200_000),
    ],
)  # fmt: skip
def test_text_that_is_deep_long_or_repeats_itself(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    refused(read_rig, tmp_path / name)
    if name.endswith(".toml"):
        refused(lambda: read_config(tmp_path / name, PipelineConfig))
    if name.endswith(".json"):
        refused(read_json, tmp_path / name)


def test_a_name_twice_among_many_is_found_at_once(tmp_path):
    names = [f"camera{number}" for number in range(200_000)]
    members = "".join(f'"{name}": 1, ' for name in names)
    (tmp_path / "a.json").write_text(f'{{{members}"last": 1, "last": 2}}')
    (tmp_path / "times.csv").write_text(" ".join([*names, "last", "last"]))
    start = time.process_time()
    assert 'key "last" occurs twice' in refused(read_json, tmp_path / "a.json")
    rig = ring_of_cameras(2, np.random.default_rng(0))
    assert "column last occurs twice" in refused(read_timestamps, tmp_path / "times.csv", rig, 3)
    assert time.process_time() - start < 5


def test_a_number_too_long_is_named(tmp_path):
    (tmp_path / "a.json").write_text('{"people": [{"x": 1}, {"x": [2, ' + "9" * 30 + "]}]}")
    assert "people[1].x[1] is a whole number of over 18 digits" in refused(
        read_json, tmp_path / "a.json"
    )


def zipped(**changes: object) -> bytes:
    """An archive with the array `a`; changes of the zip's entry are written into its central
    directory.
    """
    stream = io.BytesIO()
    np.savez(stream, a=np.arange(9.0))
    content = bytearray(stream.getvalue())
    at = content.rindex(b"PK\x01\x02")
    for field, (offset, form) in {
        "flags": (8, "<H"),
        "method": (10, "<H"),
        "size": (24, "<I"),
    }.items():
        if field in changes:
            struct.pack_into(form, content, at + offset, changes[field])
            if field != "size":
                struct.pack_into(
                    form, content, content.index(b"PK\x03\x04") + offset - 2, changes[field]
                )
    return bytes(content)


def npy(header: str) -> bytes:
    """An array's header, and no numbers."""
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header) + 1) + header.encode() + b"\n"


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"flags": 1}, "encrypted"),
        ({"method": 14}, "has a compression"),
        ({"size": 2**32 - 2}, "times the file"),
    ],
)
def test_archives_that_are_not_numpy_s(tmp_path, changes, sentence):
    (tmp_path / "a.npz").write_bytes(zipped(**changes))
    assert sentence in refused(read_npz, tmp_path / "a.npz", ("a",), "no cure")


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000, 10000000), }",
        "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }",
    ],
)
def test_arrays_that_claim_what_they_do_not_hold(tmp_path, header):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", npy(header) + bytes(8))
    refused(read_npz, tmp_path / "a.npz", ("a",), "no cure")


@pytest.mark.slow
def test_what_nobody_asked_for_takes_no_memory(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("asked", "other"):
            with archive.open(f"{name}.npy", "w") as stream:
                count = 9 if name == "asked" else 2**26
                np.lib.format.write_array_header_1_0(
                    stream, {"descr": "<f8", "fortran_order": False, "shape": (count,)}
                )
                for start in range(0, count, 2**20):
                    stream.write(bytes(8 * min(2**20, count - start)))
    assert (tmp_path / "a.npz").stat().st_size < 2**20
    assert (
        in_little_memory("read_npz(Path(sys.argv[1]), ('asked',), 'cure')", tmp_path / "a.npz")
        == "read\n"
    )
    said = in_little_memory("read_npz(Path(sys.argv[1]), ('other',), 'cure')", tmp_path / "a.npz")
    assert "512 MiB large" in said


PICKLES = {
    "a large memory": b"\x80\x02Nr\xff\xff\xff\xff.",
    "a large frame": b"\x80\x04\x95\xff\xff\xff\xff\xff\xff\xff\x7f.",
    "bytes that are not there": b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\xff\x7f.",
    "tuples in tuples": b"\x80\x02)" + b"q\x002h\x00\x86" * 100_000 + b".",
    "doubled for ever": b"\x80\x02}(" + b")" + b"q\x00h\x00\x86" * 60 + b"K\x01u.",
    "a long number": b"\x80\x02\x8b\xff\xff\xff\x7f.",
    "another's memory": b"\x80\x02h\x05.",
    "a class that is changed": b"\x80\x02cnumpy\nndarray\n}X\x05\x00\x00\x00stateK\x01sb.",
    "an object of the system": (
        b"\x80\x02}X\x01\x00\x00\x00acos\nsystem\nX\x02\x00\x00\x00ls\x85Rs."
    ),
    "an instance": b"(ios\nsystem\n.",
    "a name by number": b"\x80\x02\x82\x01.",
    "a name of its own": b"\x80\x02Pabc\n.",
    "nothing on the stack": b"\x80\x02.",
    "an open mark": b"\x80\x02((((.",
    "lists of themselves": b"\x80\x02]q\x00h\x00a" * 50 + b".",
}


def test_pickles_take_no_memory(tmp_path):
    for number, content in enumerate(PICKLES.values()):
        (tmp_path / f"{number}.pkl").write_bytes(content)
    code = (
        "[told for told in map(tell, sorted(Path(sys.argv[1]).iterdir())) if print(told) is None]"
    )
    tell = (
        "def tell(path):\n    try:\n        read_smpl_file(path)\n"
        "    except InputError as error:\n        return error\n"
    )
    said = in_little_memory(code, tmp_path, before=tell).splitlines()
    assert sum(".pkl: " in line for line in said) == len(PICKLES)


@pytest.mark.parametrize("name", PICKLES)
def test_pickles_that_do_harm(tmp_path, name):
    (tmp_path / "body.pkl").write_bytes(PICKLES[name])
    refused(read_smpl_file, tmp_path / "body.pkl")
    # And the next one is read as if there had been none.
    (tmp_path / "good.pkl").write_bytes(pickle.dumps(tiny_body(0), protocol=2))
    np.testing.assert_array_equal(
        read_smpl_file(tmp_path / "good.pkl").template, tiny_body(0)["v_template"]
    )


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda body: {"v_template": 1000 * body["v_template"]}, "high along y: give it in metres"),
        (lambda body: {"v_template": body["v_template"][:, [0, 2, 1]]}, "high along y"),
        (
            lambda body: {"J_regressor": 0 * body["J_regressor"]},
            "J_regressor has rows that do not sum to 1",
        ),
        (
            lambda body: {"keypoint_regressor": 0 * body["keypoint_regressor"]},
            "keypoint_regressor has rows",
        ),
        (
            lambda body: {"J_regressor": body["J_regressor"][[0, 2, 1, *range(3, 24)]]},
            "puts left_hip to the right",
        ),
        (lambda body: {"J_regressor": body["J_regressor"][::-1]}, "J_regressor puts"),
        (
            lambda body: {"keypoint_regressor": body["keypoint_regressor"][::-1]},
            "keypoint_regressor puts",
        ),
        (lambda body: {"v_template": body["v_template"] * (-1, 1, 1)}, "the body's left is"),
        (lambda body: {"f": np.array([[0, 1, -1]])}, "outside 0"),
    ],
)
def test_bodies_that_are_nobody_s(tmp_path, change, sentence):
    body = tiny_body(0)
    np.savez(tmp_path / "body.npz", **body)
    read_smpl_file(tmp_path / "body.npz")
    np.savez(tmp_path / "body.npz", **{**body, **change(body)})
    assert sentence in refused(read_smpl_file, tmp_path / "body.npz")


def test_weights_that_lie(tmp_path):
    READERS["weights"](tmp_path, 0)
    path = tmp_path / "weights.safetensors"
    length = struct.unpack("<Q", path.read_bytes()[:8])[0]
    content = path.read_bytes()
    for old, new in (
        (b'\\"blocks\\": 1', b'\\"blocks\\":%d' % 9),
        (b'\\"width\\": 2', b'\\"width\\":%d' % 9),
    ):
        assert old in content[: length + 8]
        path.write_bytes(content.replace(old, new))
        assert "train" in refused(FitterWeights.load, path)
    large = content[8 : length + 8].replace(b'\\"blocks\\": 1', b'\\"blocks\\": 1000000000')
    path.write_bytes(struct.pack("<Q", len(large)) + large + content[length + 8 :])
    assert "blocks must be at most 64" in refused(FitterWeights.load, path)
    tensor = {"dtype": "F8_E4M3", "shape": [3], "data_offsets": [0, 3]}
    header = json.dumps({"__metadata__": {"format": "shapepose-fg fitter 1"}, "a": tensor}).encode()
    path.write_bytes(struct.pack("<Q", len(header)) + header + bytes(3))
    assert "a holds F8_E4M3, not numbers of F32" in refused(FitterWeights.load, path)


@pytest.mark.parametrize(
    "text",
    [
        "[body]\npolish_steps = 100000",
        "[people]\ngate_m = 1e308",
        "batch_frames = 0",
    ],
)
def test_settings_have_bounds(tmp_path, text):
    (tmp_path / "settings.toml").write_text(text)
    said = refused(lambda: read_config(tmp_path / "settings.toml", PipelineConfig))
    assert (
        "must be at most" in said or "must be at least 1" in said
    ) and "shapepose-fg config" in said


@pytest.mark.parametrize(
    ("key", "value", "sentence"),
    [
        ("image_size", [10**19, 720], "whole number of over 18 digits"),
        ("image_size", [10**8, 720], "image_size must be positive and at most"),
        ("K", [[1e300, 0, 1], [0, 1e300, 1], [0, 0, 1]], "K must be at most"),
        ("distortion", [1e200, 0, 0, 0, 0], "distortion must be at most"),
        ("name", "../secret", "must not contain a path"),
        ("name", "/etc/passwd", "must not contain a path"),
        ("name", "a\nb", "in one line"),
    ],
)
def test_cameras_have_bounds(tmp_path, key, value, sentence):
    READERS["cameras in our rig file"](tmp_path, 0)
    content = json.loads((tmp_path / "rig.json").read_text())
    content["cameras"][0][key] = value
    (tmp_path / "rig.json").write_text(json.dumps(content))
    assert sentence in refused(read_rig, tmp_path / "rig.json")


@pytest.mark.slow
def test_openpose_with_a_key_twice(tmp_path):
    read = READERS["detections of OpenPose"](tmp_path, 1)
    read()
    file = next(tmp_path.rglob("*_keypoints.json"))
    file.write_text(file.read_text().replace('"people":', '"people": [], "people":', 1))
    assert 'key "people" occurs twice' in refused(read)


@pytest.mark.parametrize("score", ["0", "1e-200", "9e-7"])
def test_scores_of_nothing_are_nothing(tmp_path, score):
    from tests.io import test_people_formats as people

    rig = people.two_cameras("left", "right")
    for name in rig.names:
        lines = ["4 1", "1", "0.5", "0.5", score, *["0"] * 24]
        (tmp_path / f"{name}.txt").write_text("\n".join(lines))
    assert len(read_detections(tmp_path, rig)[0]) == 0


@pytest.mark.parametrize(
    ("column", "value", "sentence"),
    [
        ("joints", np.inf, "joints must be at most 1e+06 or unknown (NaN), got inf"),
        ("joints", -1e200, "joints must be at most 1e+06 or unknown (NaN), got 1e+200"),
        ("betas", 1e200, "betas must be at most 1000"),
        ("body_pose", 1e300, "body_pose must be at most 1000"),
        ("transl", 2e6, "transl must be at most 1e+06"),
        ("frame", -1, "frame must not be negative"),
        ("frame", 2**62, "frame must be at most 9.0072e+15"),
        ("person", 2**53, "person must be at most 9.0072e+15"),
    ],
)
def test_results_that_no_reconstruction_gives(tmp_path, column, value, sentence):
    read = READERS["result"](tmp_path, 0)
    with np.load(tmp_path / "people.npz") as archive:
        columns = dict(archive)
    columns[column].flat[0] = value
    np.savez(tmp_path / "people.npz", **columns)
    assert sentence in refused(read)
    assert sentence in refused(Reconstruction.load, tmp_path)


@pytest.mark.parametrize("column", ["frame", "person"])
def test_numbers_by_which_rows_are_chosen_are_numbers(tmp_path, column):
    READERS["result"](tmp_path, 0)
    with np.load(tmp_path / "people.npz") as archive:
        columns = dict(archive)
    for value, sentence in (
        (np.array(["a", "b", "c"]), f"{column} must hold int64 values, got <U1"),
        (np.zeros((3, 2), dtype=int), f"{column} must be (3,), got (3, 2)"),
        (np.array([0, 0, 2**60]), f"{column} must be at most"),
        (np.array(7), "must have an entry for each row"),
    ):
        np.savez(tmp_path / "people.npz", **(columns | {column: value}))
        assert sentence in refused(Reconstruction.open, tmp_path)


@pytest.mark.skipif(
    not Path("/dev/full").exists(), reason="needs Linux's device that is always full"
)
@pytest.mark.parametrize(
    ("streams", "code"), [(">/dev/full", 2), *slow((">&-", 0), (">&- 2>&-", 0), ("| true", 1))]
)
def test_any_stdout(streams, code):
    command = f"set -o pipefail; {sys.executable} -m shapepose_fg.cli.main --help {streams}"
    done = subprocess.run(
        ["bash", "-c", command], capture_output=True, text=True, timeout=60, check=False
    )
    # Whether `true` ends before anything is written is chance.
    assert done.returncode in {code, 0 if streams == "| true" else code}
    assert "Traceback" not in done.stderr and done.stderr.count("\n") <= 1


@pytest.mark.slow
def test_a_path_that_the_terminal_cannot_write(tmp_path):
    name = os.fsdecode(b"caf\xe9\xff")
    environment = os.environ | {"PYTHONIOENCODING": "ascii"}
    command = [
        sys.executable,
        "-m",
        "shapepose_fg.cli.main",
        "check-calibration",
        "--calibration",
        tmp_path / name,
    ]
    command += ["--detections", tmp_path]
    done = subprocess.run(command, capture_output=True, timeout=60, check=False, env=environment)
    assert (
        done.returncode == 2
        and b"there is no such file" in done.stderr
        and b"Traceback" not in done.stderr
    )


@pytest.mark.parametrize("number", ["1e999", "-1e999", "NaN", "Infinity"])
def test_numbers_in_run_json_that_could_not_be_written_again(tmp_path, number):
    """`tracks merge` found out when it had solved everybody anew, in a traceback."""
    READERS["result"](tmp_path, 0)
    file = tmp_path / "run.json"
    content = json.loads(file.read_text())
    file.write_text(
        json.dumps(content | {"more": {"said": [1.0, "ENDLESS"]}}).replace('"ENDLESS"', number)
    )
    assert "run.json: a number in it is not finite, or too large; restore it" in refused(
        Reconstruction.open, tmp_path
    )
