"""`shapepose-fg export`: several formats in one call, and one sentence for what does not fit."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.cli.main import main
from shapepose_fg.core.drawing import bones_of, thinned
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import BODY, Status
from shapepose_fg.core.skeleton import BODY_25, COCO_17
from shapepose_fg.io.export.registry import FORMATS
from shapepose_fg.io.export.rerun_app import switch_off, viewer_file

from .conftest import AWAY, FIRST, FRAMES


def run(*arguments: object) -> int:
    """Exit code of a command line."""
    with pytest.raises(SystemExit) as caught:
        main([str(word) for word in arguments])
    return int(caught.value.code or 0)


@pytest.fixture
def copied(saved, tmp_path):
    return shutil.copytree(saved, tmp_path / "results")


def test_several_formats_in_one_call(copied, capsys):
    assert run("export", copied, "trc", "csv", "trc", "amass") == 0
    printed = capsys.readouterr()
    files = [line.rsplit(os.sep, 1)[1] for line in printed.out.splitlines()]
    assert files[:3] == ["person_3.trc", "person_7.trc", "joints.csv"] and len(files) == 6
    assert sorted(path.name for path in (copied / "export").iterdir()) == sorted(files)
    assert "note: amass: betas are those of the built-in body" in printed.err


def test_options(copied, tmp_path, capsys):
    options = "--person 3 --frames 104:110 --fps 50 --markers joints --seen-only".split()
    assert (
        run("export", copied / "people.npz", "trc", "--output", tmp_path / "elsewhere", *options)
        == 0
    )
    (path,) = (tmp_path / "elsewhere").iterdir()
    lines = path.read_text().splitlines()
    assert lines[2].split("\t")[:3] == ["50", "50", "6"]
    assert "MidHip" in lines[3] and lines[5].startswith("104\t2.080000\t")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["fbx"],
            "format fbx: must be one of amass trc c3d bvh glb angles opensim csv parquet mcap rrd",
        ),
        (["trc", "--markers", "skin"], "'skin' is not one of 'opensim', 'joints', 'body'"),
        (["trc", "--frames", "9:3"], "--frames 9:3: must be A:B"),
        (
            ["trc", "--frames", "500:600"],
            "no people in these frames; people are in frames 100 to 123",
        ),
        (
            ["parquet", "--frames", "500:600"],
            "no people in these frames; people are in frames 100 to 123",
        ),
        (["trc", "--person", "4"], "has no such person; it has 3 7"),
        (["trc", "--fps", "0"], "--fps 0: must be at least 0.001"),
        (["bvh", "--fill-gaps", "-1"], "--fill-gaps -1: must not be negative"),
        (["glb", "--body", "gone.npz"], "gone.npz"),
    ],
)
def test_what_does_not_fit_is_one_sentence(copied, capsys, words, message):
    assert run("export", copied, *words) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (copied / "export").exists()


def test_results_that_are_missing_or_damaged(tmp_path, capsys):
    assert run("export", tmp_path / "nowhere", "trc") == 2
    assert "there is no such file" in capsys.readouterr().err
    (tmp_path / "people.npz").write_bytes(b"PK\x03\x04 half a file")
    assert run("export", tmp_path, "trc") == 2
    assert "cannot be read as an .npz file" in capsys.readouterr().err


def test_people_without_a_body_have_no_skeleton_to_export(result, copied, capsys):
    bodies = {name: getattr(result, name) * np.nan for name in BODY}
    bare = replace(
        result, **bodies, status=np.full(len(result), Status.BODY_UNDETERMINED, result.status.dtype)
    )
    bare.save(copied)
    assert run("export", copied, "bvh") == 2
    assert "bvh: person 3 has no body in any frame" in capsys.readouterr().err
    assert run("export", copied, "trc", "csv") == 0


def test_frames_that_stand_alone_go_into_tables_only(result, copied, capsys):
    replace(result, run=result.run | {"configuration": {"temporal": False}}).save(copied)
    assert run("export", copied, "csv", "trc") == 2
    assert (
        "frame and has no identities; reconstruct with --temporal, or export csv or rrd"
        in capsys.readouterr().err
    )
    assert run("export", copied, "csv") == 0


def test_help_names_every_format(capsys):
    assert run("export", "--help") == 0
    words = capsys.readouterr().out
    assert all(name in words for name in FORMATS)


@pytest.mark.slow
def test_a_recording_for_rerun_read_back(copied, result, capfd):
    rerun = pytest.importorskip("rerun")
    assert run("export", copied, "rrd", "--frames", f"{FIRST}:{FIRST + FRAMES}") == 0
    assert "WARN" not in capfd.readouterr().err
    path = copied / "export" / "people.rrd"
    chunks = [chunk for chunk in rerun.chunk.RrdReader(path).stream()]
    paths = {chunk.entity_path for chunk in chunks}
    assert {
        f"/world/people/{who}/{part}"
        for who in (3, 7)
        for part in ("joints", "bones", "uncertainty", "body/pelvis", "body/left_hand")
    } < paths
    assert {
        "/world/cameras/cam0",
        "/world/cameras/cam0/seen/not_used",
        "/plots/residual/cam0",
    } < paths
    tables = [
        chunk.to_record_batch() for chunk in chunks if chunk.entity_path == "/world/people/7/joints"
    ]
    rows = [row for table in tables for row in table.to_pylist()]
    frames = sorted(row["frame"] for row in rows)
    assert frames == [frame for frame in range(FIRST, FIRST + FRAMES) if frame not in AWAY]
    first = next(row for row in rows if row["frame"] == FIRST)
    truly = result.rows((result.frame == FIRST) & (result.person == 7)).joints[0]
    np.testing.assert_allclose(first["Points3D:positions"], truly, atol=1e-6)


def test_bones_bridge_joints_that_a_detector_lacks():
    without_neck = tuple(name for name in BODY_25.joints if name != "Neck")
    pairs = {(without_neck[a], without_neck[b]) for a, b in bones_of(without_neck).tolist()}
    assert ("MidHip", "RShoulder") in pairs and ("RShoulder", "RElbow") in pairs
    assert len(bones_of(COCO_17.joints)) == len(COCO_17) - 1


def test_a_thinned_skin_is_the_same_body(arrays):
    kept, faces, _ = thinned(arrays.template, arrays.faces)
    assert len(kept) < 0.4 * len(arrays.template)
    assert faces.max() == len(kept) - 1 and len(np.unique(kept)) == len(kept)

    def area(vertices: np.ndarray, triangles: np.ndarray) -> float:
        a, b, c = (vertices[triangles[:, k]] for k in range(3))
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)

    # Cells of 2 cm flatten fingers and ears, no more.
    assert area(arrays.template[kept], faces) == pytest.approx(
        area(arrays.template, arrays.faces), rel=0.08
    )


@pytest.mark.slow
def test_view_without_a_viewer_is_one_sentence(copied, capfd):
    pytest.importorskip("rerun")
    assert run("view", copied, "--connect", "nonsense") == 2
    assert "the rerun viewer cannot be reached at nonsense" in capfd.readouterr().err


@pytest.mark.skipif(sys.platform != "linux", reason="other systems always have a display")
def test_view_without_a_display_names_another_way(copied, capfd, monkeypatch):
    pytest.importorskip("rerun")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    assert run("view", copied, "--statistics") == 2
    assert "there is no display; write a file" in capfd.readouterr().err


def test_rerun_sends_no_statistics(tmp_path, monkeypatch):
    """On a machine where rerun was never used they are on; `rerun analytics disable` is what its
    manual says.
    """
    pytest.importorskip("rerun")
    for name in ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME"):
        monkeypatch.setenv(name, str(tmp_path / name))
    viewer = viewer_file()
    assert viewer is not None
    monkeypatch.setenv("CI", "true")
    assert not switch_off(viewer), "rerun sends none from there"
    monkeypatch.delenv("CI")
    assert switch_off(viewer)
    told = subprocess.run(
        [viewer, "analytics", "config"], capture_output=True, text=True, check=True
    ).stdout
    assert json.loads(told)["analytics_enabled"] is False
    assert not switch_off(viewer)


@pytest.mark.parametrize("says", ["exit 1", "echo no JSON", "echo '{\"analytics_enabled\": true}'"])
def test_statistics_that_cannot_be_switched_off_are_said(tmp_path, says):
    viewer = tmp_path / "rerun"
    viewer.write_text(f"#!/bin/sh\n{says}\n")
    viewer.chmod(0o755)
    with pytest.raises(InputError, match=r"cannot be switched off .* --statistics"):
        switch_off(str(viewer))


def test_view_without_rerun_names_the_command(copied, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert run("view", copied) == 2
    assert 'rerun is not installed; pip install "shapepose-fg[view]"' in capsys.readouterr().err


def test_mcap_has_a_message_of_each_frame_and_every_person(copied, result):
    reader = pytest.importorskip("mcap.reader")
    decoder = pytest.importorskip(
        "mcap_ros2.decoder", reason='needs pip install "shapepose-fg[ros]"'
    )
    assert run("export", copied, "mcap") == 0
    with (copied / "export" / "people.mcap").open("rb") as stream:
        opened = reader.make_reader(stream, decoder_factories=[decoder.DecoderFactory()])
        found = [each for *_, each in opened.iter_decoded_messages(topics=["/people/settled"])]
    assert len(found) == FRAMES
    for place, message in enumerate(found):
        rows = result.rows(result.frame == FIRST + place)
        assert [each.person for each in message.people] == rows.person.tolist()
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == round(
            rows.time_s[0] * 1e9
        )
        for row, each in enumerate(message.people):
            assert list(each.joints) == pytest.approx(
                rows.joints[row].ravel().tolist(), abs=0, nan_ok=True
            )
            assert list(each.covariance) == pytest.approx(
                rows.covariance[row].ravel().tolist(), abs=0, nan_ok=True
            )
