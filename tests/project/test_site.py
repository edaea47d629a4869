"""The site that `make docs` builds: without a warning, and every address in it leads somewhere."""

import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

ROOT = Path(__file__).parents[2]


class Page(HTMLParser):
    """Addresses and anchors of an HTML page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.loaded: list[str] = []
        self.anchors = {""}
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.anchors.update(value for name in ("id", "name") if (value := found.get(name)))
        self.addresses += [value for name in ("href", "src") if (value := found.get(name))]
        if tag in ("script", "img", "iframe", "source", "link"):
            self.loaded += [value for name in ("href", "src") if (value := found.get(name))]


def pages_below(folder: Path) -> dict[Path, Page]:
    """The HTML pages below a folder."""
    return {path: Page(path.read_text(encoding="utf-8")) for path in folder.rglob("*.html")}


def broken(pages: dict[Path, Page]) -> list[str]:
    """Addresses on pages that lead to no file, or to no anchor of one of them."""
    found = []
    for path, page in pages.items():
        for address in page.addresses:
            parts = urlsplit(address)
            if not parts.scheme and not parts.netloc:
                there = (path.parent / unquote(parts.path)).resolve() if parts.path else path
                anchors = pages[there].anchors if there in pages else {"", unquote(parts.fragment)}
                if not there.is_file() or unquote(parts.fragment) not in anchors:
                    found.append(f"{path.name}: {address}")
    return found


@pytest.mark.slow
def test_the_site_is_complete_and_needs_no_network(tmp_path):
    for module in ("sphinx", "myst_parser", "furo"):
        pytest.importorskip(module, reason="needs the extra docs")
    site = tmp_path / "site"
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html"]
    command += ["-d", str(tmp_path / "read"), "-c", "docs", ".", str(site)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    pages = pages_below(site)
    assert broken(pages) == []
    for path, page in pages.items():
        assert [each for each in page.loaded if urlsplit(each).netloc] == [], path
    moving = (site / "docs/moving_cameras.html").read_text(encoding="utf-8")
    assert "of 95\n%. They contain" in moving, "a line that begins with % is no comment"
    start = (site / "index.html").read_text(encoding="utf-8")
    for guide in ("biomechanics", "research", "robots", "phones"):
        assert f'href="docs/guides/{guide}.html"' in start
    commands = (site / "docs/reference/commands.html").read_text(encoding="utf-8")
    assert "shapepose-fg reconstruct" in commands and "--calibration" in commands
    api = pages[site / "docs/reference/api.html"].anchors
    assert {"shapepose_fg.reconstruct", "factors.projection_factors"} <= api


def test_an_address_that_leads_nowhere_is_noticed(tmp_path):
    (tmp_path / "a.html").write_text('<p id="x"></p><a href="b.html#y"></a><a href="#x"></a>')
    (tmp_path / "b.html").write_text('<a href="a.html#z"></a><img src="no.png"><b id="y"></b>')
    assert sorted(broken(pages_below(tmp_path))) == ["b.html: a.html#z", "b.html: no.png"]
