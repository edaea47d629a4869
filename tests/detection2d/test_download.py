"""Networks fetched from a server on this machine."""

import hashlib
import io
import threading
import zipfile
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import user_cache
from shapepose_fg.detection2d import download
from shapepose_fg.detection2d.download import BASES, named_file, named_networks

NETWORK = bytes(range(256)) * 400
NAME, FILE = "rtmpose-m", named_networks()["rtmpose-m"].file


def archive(*files: tuple[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as opened:
        for name, content in files:
            opened.writestr(name, content)
    return stream.getvalue()


@pytest.fixture
def server(monkeypatch, tmp_path):
    """A server with pages that a test fills: bytes, a place to go on to, or None that never
    ends.
    """
    pages: dict[str, bytes | str | None] = {}
    asked: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            page = pages.get(self.path, 404)
            if page == 404:
                self.send_error(404)
                return
            self.send_response(302 if isinstance(page, str) else 200)
            if isinstance(page, str):
                self.send_header("Location", page)
            self.end_headers()
            try:
                for _ in range(10_000 if page is None else 1):
                    self.wfile.write(
                        NETWORK if page is None else page if isinstance(page, bytes) else b""
                    )
            except OSError:
                pass  # the other side has had enough

        def log_message(self, *arguments):
            pass

    served = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=served.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    address = f"http://127.0.0.1:{served.server_port}"
    monkeypatch.setattr(download, "BASES", (f"{address}/first", f"{address}/mirror"))
    yield pages, asked
    served.shutdown()
    thread.join()
    served.server_close()


def test_a_network_is_fetched_once_when_asked_and_is_the_same_ever_after(server):
    pages, asked = server
    pages[f"/first/{FILE}"] = archive(
        ("2023/pose/end2end.onnx", NETWORK), ("2023/pose/detail.json", b"{}")
    )
    with pytest.raises(
        InputError,
        match="rtmpose-m: this network has not been downloaded yet; give --download rtmpose-m",
    ):
        named_file(NAME)
    assert asked == [] and not user_cache("networks").exists()
    said, told = [], []
    file = named_file(
        NAME, fetch=True, say=said.append, progress=lambda done, total: told.append((done, total))
    )
    assert file.read_bytes() == NETWORK and told[-1][0] == len(pages[f"/first/{FILE}"])
    digest = hashlib.sha256(NETWORK).hexdigest()
    assert said == [
        f"rtmpose-m: sha256 {digest} is pinned in {user_cache('networks') / 'rtmpose-m.sha256'}"
    ]
    assert (
        named_file(NAME, say=said.append) == named_file(NAME, fetch=True, say=said.append) == file
    )
    assert len(said) == 1 and asked == [f"/first/{FILE}"]
    # A file that was changed, and another that comes in its place.
    file.write_bytes(b"damaged")
    with pytest.raises(
        InputError, match=rf"the sha256 of the file is .*, but {digest} was pinned at first use"
    ):
        named_file(NAME)
    file.unlink()
    pages[f"/first/{FILE}"] = archive(("end2end.onnx", NETWORK[::-1]))
    with pytest.raises(
        InputError, match=r"the sha256 of the download is .* was pinned at first use; if the"
    ):
        named_file(NAME, fetch=True)
    assert not file.exists()
    (user_cache("networks") / "rtmpose-m.sha256").unlink()
    assert named_file(NAME, fetch=True).read_bytes() == NETWORK[::-1]


def test_the_mirror_is_asked_where_the_first_address_fails(server):
    server[0][f"/mirror/{FILE}"] = archive(("end2end.onnx", NETWORK))
    assert named_file(NAME, fetch=True).read_bytes() == NETWORK
    assert [path.split("/")[1] for path in server[1]] == ["first", "mirror"]


@pytest.mark.parametrize("page, problem", [
    (b"<html>", "File is not a zip file"),
    (archive(("end2end.onnx", NETWORK))[:-30], "File is not a zip file"),
    (archive(("other.onnx", NETWORK)), "it holds 0 files end2end.onnx"),
    (archive(("a/end2end.onnx", NETWORK), ("../../end2end.onnx", NETWORK)),
     "it holds 2 files end2end.onnx"),
    (archive(("end2end.onnx", bytes(10_000_000))), "its end2end.onnx has over 1000000 bytes"),
    (None, "the download is too long"),
    ("http://127.0.0.1:9/elsewhere",
     "redirects to http://127.0.0.1:9/elsewhere, which is not https"),
    ("file:///etc/passwd", "302"),
])  # fmt: skip
def test_what_is_not_a_network_is_not_kept(server, monkeypatch, page, problem):
    monkeypatch.setattr(download, "MOST_BYTES", 1_000_000)
    server[0][f"/first/{FILE}"] = server[0][f"/mirror/{FILE}"] = page
    with pytest.raises(
        InputError, match=f"cannot be downloaded from .*{problem}.*; download it by hand"
    ):
        named_file(NAME, fetch=True)
    assert not user_cache("networks").exists()


def test_the_named_networks_are_rtmlib_s():
    assert all(base.startswith("https://") for base in BASES)
    for network in named_networks().values():
        assert network.file.endswith(".zip") and "/" not in network.file
        assert network.boxes is None or named_networks()[network.boxes].boxes is None
