"""Networks fetched from a server on this machine."""

import hashlib
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.detection2d import download
from shapepose_fg.detection2d.download import cache_folder, find_network
from shapepose_fg.detection2d.networks import KnownNetwork, known_networks

CONTENT = bytes(range(256)) * 400


@pytest.fixture
def server():
    """The address of a server: /right, /wrong, /endless, and nothing else; `asked` counts."""
    asked: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            if self.path not in ("/right", "/wrong", "/endless"):
                self.send_error(404)
                return
            self.send_response(200)
            self.end_headers()
            try:
                for _ in range(10_000 if self.path == "/endless" else 1):
                    self.wfile.write(CONTENT if self.path != "/wrong" else CONTENT[::-1])
            except OSError:
                pass  # the other side has had enough

        def log_message(self, *arguments):
            pass

    served = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=served.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield f"http://127.0.0.1:{served.server_port}", asked
    served.shutdown()
    thread.join()
    served.server_close()


@pytest.fixture(autouse=True)
def known(monkeypatch, tmp_path, server) -> None:
    """Two networks of ours, kept in a cache of this test's own; no proxy on the way to this machine."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    digest = hashlib.sha256(CONTENT).hexdigest()
    networks = {
        "open": KnownNetwork("open", "a test's", "tf-pose", digest, len(CONTENT), f"{server[0]}/right"),
        "homeless": KnownNetwork("homeless", "a test's", "tf-pose", digest, len(CONTENT), None),
    }
    monkeypatch.setattr(download, "known_networks", lambda: networks)


def test_a_network_is_fetched_once_and_only_when_asked(server):
    asked = server[1]
    with pytest.raises(InputError, match=r"has not been fetched yet; add --download to fetch 0\.1 MB once"):
        find_network("open")
    assert asked == [] and not cache_folder().exists()
    told = []
    file = find_network("open", download=True, progress=lambda done, total: told.append((done, total)))
    assert file.read_bytes() == CONTENT
    assert told[-1] == (len(CONTENT), len(CONTENT))
    assert find_network("open") == find_network("open", download=True) == file
    assert asked == ["/right"]
    file.write_bytes(b"damaged")
    with pytest.raises(InputError, match="add --download"):
        find_network("open")


def test_a_file_is_taken_as_it_is(tmp_path, server):
    file = tmp_path / "my.onnx"
    file.write_bytes(b"mine")
    assert find_network(str(file), download=True) == file
    assert server[1] == []


@pytest.mark.parametrize("path, problem", [
    ("/wrong", r"what came \(102400 bytes\) is not the network open, its checksum differs; nothing was kept"),
    ("/endless", r"what came \(more than 102400 bytes\) is not the network open"),
    ("/nothing", "cannot be fetched .*404"),
])  # fmt: skip
def test_what_is_not_the_network_is_not_kept(server, path, problem):
    with pytest.raises(InputError, match=problem):
        find_network("open", download=True, address=server[0] + path)
    assert not cache_folder().exists()


def test_an_address_may_be_named_where_none_is_known(server):
    with pytest.raises(InputError, match="no public address of this file is known; name one"):
        find_network("homeless", download=True)
    assert find_network("homeless", download=True, address=f"{server[0]}/right").read_bytes() == CONTENT


@pytest.mark.parametrize("address", ["file:///etc/passwd", "ftp://127.0.0.1/x", "right", "http://127.0.0.1:1/x"])
def test_other_addresses_are_refused(address):
    with pytest.raises(InputError, match=r"must be an address that begins with https|cannot be fetched"):
        find_network("open", download=True, address=address)


def test_names_that_are_not_known_are_listed():
    with pytest.raises(InputError, match="there is no such file, and no network of this name; named networks are"):
        find_network("clever")


def test_the_networks_that_ship_have_checksums_and_layouts():
    for network in known_networks().values():
        assert len(bytes.fromhex(network.sha256)) == 32
        assert network.bytes > 1000
        assert network.address is None or network.address.startswith("https://")
