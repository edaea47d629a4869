"""A page in headless Chromium, through chromedriver's own interface (W3C WebDriver, JSON over
HTTP).
"""

import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

import pytest


class Browser:
    """One window."""

    def __init__(self, session: str) -> None:
        self.session = session

    def ask(self, path: str, body: dict[str, Any] | None = None) -> Any:
        return _ask(f"{self.session}/{path}", body)

    def open(self, page: Path, fragment: str = "") -> None:
        self.ask("url", {"url": "about:blank"})
        self.ask("url", {"url": f"{page.resolve().as_uri()}{fragment}"})

    def run(self, script: str, *arguments: Any) -> Any:
        """What the page's own function returns; `arguments` are in it."""
        return self.ask("execute/sync", {"script": script, "args": list(arguments)})

    def wait(self) -> None:
        """Until two frames have been drawn."""
        script = (
            "const done = arguments[0]; requestAnimationFrame(() => requestAnimationFrame(() => "
            "done()));"
        )
        self.ask("execute/async", {"script": script, "args": []})

    def resize(self, width: int, height: int) -> None:
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.ask(
            "goog/cdp/execute", {"cmd": "Emulation.setDeviceMetricsOverride", "params": metrics}
        )

    def complaints(self) -> list[str]:
        """What the console holds: errors of scripts, and of what was refused or not found."""
        return [entry["message"] for entry in self.ask("se/log", {"type": "browser"})]


def _ask(url: str, body: dict[str, Any] | None, method: str | None = None) -> Any:
    data = None if body is None else json.dumps(body).encode()
    request = Request(url, data, {"Content-Type": "application/json"}, method=method)
    try:
        with urlopen(request, timeout=60) as answer:
            return json.load(answer)["value"]
    except HTTPError as error:
        raise AssertionError(error.read().decode()) from None


@contextmanager
def chromium() -> Iterator[Browser]:
    """A window of headless Chromium; skips the test where it is not installed."""
    driver = shutil.which("chromedriver")
    program = (
        shutil.which("chromium")
        or shutil.which("chromium-browser")
        or shutil.which("google-chrome")
    )
    if driver is None or program is None:
        pytest.skip(
            "chromium and chromedriver are not installed (Debian: chromium, chromium-driver)"
        )
    process = subprocess.Popen(
        [driver, "--port=0"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        assert process.stdout is not None
        line = next(line for line in process.stdout if "successfully on port" in line)
        port = int(line.strip().rstrip(".").split()[-1])
        server = f"http://127.0.0.1:{port}"
        _until_ready(server)
        arguments = ["--headless=new", "--disable-gpu", "--window-size=1280,1000", "--no-first-run"]
        # Chromium refuses its sandbox to root, and in containers.
        arguments += ["--no-sandbox", "--disable-dev-shm-usage"] if os.geteuid() == 0 else []
        wanted = {"goog:chromeOptions": {"binary": program, "args": arguments}}
        wanted |= {"browserName": "chrome", "goog:loggingPrefs": {"browser": "ALL"}}
        opened = _ask(f"{server}/session", {"capabilities": {"alwaysMatch": wanted}})
        session = f"{server}/session/{opened['sessionId']}"
        try:
            yield Browser(session)
        finally:
            _ask(session, None, "DELETE")
    finally:
        process.terminate()
        process.wait(timeout=20)


def _until_ready(server: str) -> None:
    for _ in range(100):
        try:
            if _ask(f"{server}/status", None)["ready"]:
                return
        except URLError:
            pass
        time.sleep(0.1)
    raise AssertionError("chromedriver does not answer")
