"""Versions and checksums: what run.json says about where a result comes from."""

import hashlib
import platform

import numpy as np
import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.provenance import ReadInputs, checksums, program_digest, versions


def test_versions_are_those_that_run():
    found = versions()
    assert found["python"] == platform.python_version()
    assert found["numpy"] == np.__version__
    assert set(found) == {"python", "shapepose-fg", "numpy", "scipy", "gtsam", "numba", "opencv"}
    assert "not installed" not in found.values()


def test_a_file_has_its_sha256(tmp_path):
    (tmp_path / "rig.json").write_bytes(b"{}")
    path = str(tmp_path / "rig.json")
    assert checksums([path]) == {path: hashlib.sha256(b"{}").hexdigest()}


def test_a_folder_changes_with_the_names_and_contents_of_its_files(tmp_path):
    def digest() -> str:
        return checksums([tmp_path])[str(tmp_path)]

    (tmp_path / "a.json").write_text("1")
    first = digest()
    (tmp_path / "notes.md").write_text("not an input")
    assert digest() == first
    (tmp_path / "a.json").rename(tmp_path / "b.json")
    assert digest() != first
    (tmp_path / "b.json").rename(tmp_path / "a.json")
    assert digest() == first
    (tmp_path / "a.json").write_text("2")
    assert digest() != first


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match="nothing: there is no such file"):
        checksums([tmp_path / "nothing"])


def test_what_changes_while_it_is_read_is_refused_and_afterwards_is_not_looked_at(tmp_path):
    camera, folder = tmp_path / "a.json", tmp_path / "pose"
    folder.mkdir()
    camera.write_text("1")
    (folder / "000.json").write_text("1")
    reading = ReadInputs([camera, folder, None, tmp_path / "not there"])
    (tmp_path / "results").mkdir()
    found = reading.checksums([camera, None, folder])
    assert list(found) == [str(camera), str(folder)] and found == checksums([camera, folder])
    (folder / "000.json").write_text("12")
    with pytest.raises(InputError, match=r"000\.json: this file changed while it was read"):
        reading.checksums([folder])
    camera.unlink()
    with pytest.raises(InputError, match=r"a\.json: there is no such file"):
        reading.checksums([camera])


def test_folders_that_are_links_are_looked_into_once(tmp_path):
    """Detections of each camera may lie on another disk; a link may lead back to where it is."""
    disk, folder = tmp_path / "disk" / "cam1", tmp_path / "pose"
    disk.mkdir(parents=True)
    folder.mkdir()
    (disk / "000.json").write_text("1")
    (folder / "cam1").symlink_to(disk)
    (disk / "back").symlink_to(folder)
    reading = ReadInputs([folder])
    before = reading.checksums([folder, folder / "cam1"])
    assert before == checksums([folder, folder / "cam1"])
    (disk / "000.json").write_text("2")
    assert checksums([folder])[str(folder)] != before[str(folder)]
    with pytest.raises(InputError, match=r"000\.json: this file changed while it was read"):
        reading.checksums([folder])


def test_the_program_is_the_same_as_long_as_its_files_are():
    assert program_digest() == program_digest() and len(program_digest()) == 64
