"""Photos made to do harm: their EXIF is read, nothing is unpacked, nothing is waited for."""

import os
import struct
import subprocess
import sys
import zlib

import cv2
import numpy as np
import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.io.footage.footage import open_footage
from shapepose_fg.io.lenses import lenses_of

pytest.importorskip("PIL", reason='needs pip install "shapepose-fg[photos]"')
from PIL import Image


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def bomb(side: int, exif: bytes = b"") -> bytes:
    """A grey PNG of zeros; its EXIF before the picture."""
    packing, row = zlib.compressobj(1), bytes(1 + side)
    data = b"".join(packing.compress(row) for _ in range(side)) + packing.flush()
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0))
    told = chunk(b"eXIf", exif) if exif else b""
    return b"\x89PNG\r\n\x1a\n" + head + told + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def exif(focal: object) -> bytes:
    found = Image.Exif()
    found[0x8769] = {0xA405: focal}
    return found.tobytes()


def degrees(tmp_path, name: str) -> float:
    """The field of view that a camera gets from a photo."""
    (tmp_path / "detections" / "a").mkdir(parents=True, exist_ok=True)
    (camera,) = lenses_of(tmp_path / "detections", [str(tmp_path / name)], (1600, 1200)).cameras
    return float(np.degrees(2 * np.arctan(800 / camera.K[0, 0])))


@pytest.mark.slow
def test_a_large_picture_in_a_small_file_is_not_unpacked(tmp_path):
    (tmp_path / "a.png").write_bytes(bomb(13_000))
    (tmp_path / "b.png").write_bytes(bomb(13_000, exif(28)))
    code = (
        "import sys, resource, PIL.Image\nfrom pathlib import Path\nfrom shapepose_fg.io.lenses "
        "import lenses_of\nbefore = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\nfor name "
        "in ('a.png', 'b.png'):\n    try: print(lenses_of(Path('detections'), [name], (16, "
        "12)).cameras[0].K[0, 0])\n    except ValueError as error: print(error)\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)\n"
    )
    (tmp_path / "detections" / "a").mkdir(parents=True)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
    )
    first, second, kib = done.stdout.splitlines()
    assert (
        "its EXIF data have no" in first
        and float(second) > 0
        and int(kib) < 100_000
        and done.stderr == ""
    )


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs a system with pipes in folders")
def test_pipes_are_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "a.jpg")
    with pytest.raises(InputError, match="a pipe"):
        degrees(tmp_path, "a.jpg")
    with pytest.raises(InputError, match="a pipe"):
        open_footage(tmp_path / "a.jpg")
    (tmp_path / "taken").mkdir()
    os.mkfifo(tmp_path / "taken" / "2.png")
    for name in ("1.png", "3.png"):
        cv2.imwrite(str(tmp_path / "taken" / name), np.full((8, 8, 3), 7, dtype=np.uint8))
    taken = open_footage(tmp_path / "taken")
    pictures = [taken.at(place) for place in range(3)]
    assert pictures[1] is None and pictures[0] is not None and pictures[2] is not None


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF"])
def test_damaged_photos_are_refused_or_read(tmp_path, kind):
    name = {"JPEG": "a.jpg", "PNG": "a.png", "TIFF": "a.tif"}[kind]
    Image.new("RGB", (64, 48)).save(tmp_path / name, kind, exif=exif(28))
    assert degrees(tmp_path, name) == pytest.approx(
        63.4, abs=0.1
    )  # 43.27 / 28 of the diagonal, of 4 : 3
    content, rng, refused = (tmp_path / name).read_bytes(), np.random.default_rng(0), 0
    for _ in range(300):
        changed = bytearray(content[: rng.integers(4, len(content) + 1)])
        for place in rng.integers(0, len(changed), 3).tolist():
            changed[place] = rng.integers(0, 256)
        (tmp_path / name).write_bytes(changed)
        try:
            assert 0 < degrees(tmp_path, name) < 180
        except InputError as error:
            refused += 1
            assert name in str(error)
    assert refused > 5


def test_other_formats_under_these_names_are_not_tried(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n")
    with pytest.raises(InputError, match=r"a\.jpg: cannot be read as a photo"):
        degrees(tmp_path, "a.jpg")
