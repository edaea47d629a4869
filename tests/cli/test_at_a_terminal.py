"""What a real terminal gets: a pseudo-terminal under the commands, and an emulator that obeys what
they write.
"""

import os
import pty
import re
import subprocess
import sys
import termios
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

import shapepose_fg
from shapepose_fg.cli.terminal import printable
from tests.marks import slow

pyte = pytest.importorskip("pyte", reason='needs pip install "shapepose-fg[dev]"')

ROOT = Path(shapepose_fg.__file__).parents[1]
_OURS = re.compile(r"\x1b\[(?:[0-9;]*[mAK]|2K|1A|\?25[hl])|\r(?=\n|\x1b\[2K|\x1b\[1A|$)")
"""Colours, lines taken away again, the cursor hidden and shown, ends of lines."""
_HALF = re.compile(r"(?<!\x1b)\[(?:\d+(?:;\d+)+m|[0-9]?[mK]|\?25|1A|2K)")
"""The rest of a control sequence that has lost its first letter."""

ESCAPES = "\x1b]0;title\x07\x1b[31mcam\x1b[2J\x9b2J\x08\u202e"
"""A name that would take the terminal over."""


@dataclass(frozen=True)
class Seen:
    """What a program wrote to the terminal, and how it ended."""

    raw: str
    lines: list[str]
    """What is on the screen at the end."""
    cursor_is_hidden: bool
    code: int

    def rubbish(self) -> list[str]:
        """What a terminal would obey and is not ours, and what is to be read of a control sequence
        of ours.
        """
        rest = _OURS.sub("", self.raw).replace("\n", "")
        foreign = [letter for letter in rest if letter < " " or "\x7f" <= letter <= "\x9f"]
        cursor = ["the cursor is hidden"] if self.cursor_is_hidden else []
        return foreign + _HALF.findall(self.raw.replace(printable(ESCAPES), "")) + cursor


def at_terminal(
    *command: object,
    columns: int = 100,
    stop_at: str | None = None,
    cwd: Path | None = None,
    **variables: str,
) -> Seen:
    """Run a command at a terminal of its own; Ctrl-C is pressed as soon as `stop_at` is written."""
    ours, its = pty.openpty()
    termios.tcsetwinsize(its, (50, columns))
    environment = {
        name: each
        for name, each in os.environ.items()
        if name not in ("NO_COLOR", "FORCE_COLOR", "COLUMNS")
    }
    environment |= {
        "TERM": "xterm-256color",
        "PYTHONPATH": str(ROOT),
        "OMP_NUM_THREADS": "1",
    } | variables
    start = (
        "import fcntl, os, sys, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); "
        "os.execv(sys.argv[1], sys.argv[1:])"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", start, *map(str, command)],
        stdin=its,
        stdout=its,
        stderr=its,
        cwd=cwd,
        env=environment,
        start_new_session=True,
    )
    os.close(its)
    written = b""
    try:
        while piece := os.read(ours, 65536):
            written += piece
            if stop_at is not None and stop_at.encode() in written:
                os.write(ours, b"\x03")
                stop_at = None
    except OSError:  # the last process has closed it
        pass
    os.close(ours)
    screen = pyte.Screen(columns, 50)
    stream = pyte.Stream(screen)
    raw = written.decode()
    stream.feed(raw)
    lines = [line.rstrip() for line in screen.display]
    return Seen(
        raw, [line for line in lines if line], screen.cursor.hidden, process.wait(timeout=60)
    )


WORK = f"""
import sys, time, warnings
from shapepose_fg.cli import main, stopping
from shapepose_fg.cli.terminal import bars, note, progress, show, table, use_any_streams
from shapepose_fg.core.errors import InputError

def work(*_, **__):
    with progress("reading cam " + {ESCAPES!r}) as tell:
        for i in range(40):
            tell(i, 40)
            time.sleep(0.02)
            if i == 15:
                note("meanwhile " + {ESCAPES!r})
                sys.stderr.write("from a library " + {ESCAPES!r} + "\\n")
                if "stopped" in sys.argv:
                    time.sleep(60)
            if i == 30 and "error" in sys.argv:
                raise InputError("frame 30 of " + {ESCAPES!r} + " cannot be read")
    show(table(["camera"], [[{ESCAPES!r}]]))
    print("done", {ESCAPES!r})

main.app = work
main.main(["anything"])
"""


@pytest.fixture(scope="module")
def work(tmp_path_factory) -> Path:
    """A program that works with a bar, and is told names that would take the terminal over."""
    file = tmp_path_factory.mktemp("work") / "work.py"
    file.write_text(WORK, encoding="utf-8")
    return file


@pytest.mark.parametrize(
    "settings",
    [
        {},
        *slow(
            {"columns": 24, "NO_COLOR": "1"},
            {"TERM": "dumb"},
            {"TERM": "xterm", "PYTHONIOENCODING": "ascii"},
        ),
    ],
    ids=["colours", "narrow, without colours", "dumb", "few colours, ascii"],
)
def test_a_bar_is_drawn_and_taken_away(work, settings):
    seen = at_terminal(sys.executable, work, **settings)
    assert seen.code == 0 and seen.rubbish() == []
    assert ("\x1b[2K" in seen.raw) == (settings.get("TERM") != "dumb"), "a bar was drawn over"
    if "TERM" in settings and settings["TERM"] == "dumb":
        assert "\x1b" not in seen.raw
    words = " ".join(" ".join(seen.lines).split())
    assert "note: meanwhile" in words and "from a library" in words and "done" in words
    assert "reading cam" not in words and "0/40" not in words, "the bar is taken away"


@pytest.mark.slow
def test_a_bar_is_taken_away_where_an_error_ends_the_work(work):
    seen = at_terminal(sys.executable, work, "error")
    assert seen.code == 2 and seen.rubbish() == []
    assert "reading cam" not in "".join(seen.lines) and seen.lines[-1].startswith("error: frame 30")


@pytest.mark.slow
def test_a_bar_is_taken_away_where_it_is_stopped(work):
    seen = at_terminal(sys.executable, work, "stopped", stop_at="from a library")
    assert seen.code == 130 and seen.rubbish() == []
    assert "reading cam" not in "".join(seen.lines) and "stopped: " in seen.lines[-1]


@pytest.mark.slow
def test_a_log_has_lines_now_and_then(work, tmp_path):
    often = WORK.replace(
        "import sys,", "from shapepose_fg.cli import terminal; terminal._EVERY_S = 0.3\nimport sys,"
    )
    command = [sys.executable, "-c", often]
    environment = {name: each for name, each in os.environ.items() if name != "FORCE_COLOR"}
    environment |= {"PYTHONPATH": str(ROOT), "TERM": "xterm"}
    start_s = time.monotonic()
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    most = 1 + (time.monotonic() - start_s) / 0.3
    told = [line for line in done.stderr.splitlines() if line.startswith("reading cam")]
    assert 1 <= len(told) <= most and re.search(r"\d+ of 40 frames, \d+ s left", told[0])
    assert "\x1b" not in done.stderr + done.stdout


def commands(page: Path) -> list[list[str]]:
    """The commands of a page, without those that wait for somebody, fetch something, load torch, or
    leave words out.
    """
    lines = re.findall(
        r"^shapepose-fg (.+?)(?: +#.*)?$", page.read_text(encoding="utf-8"), re.MULTILINE
    )
    return [
        line.split()
        for line in lines
        if not re.search(r"^live|^train|--download|--cluster|\.\.\.", line)
    ]


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMANDS = sorted(
    {" ".join(each) for page in PAGES for each in commands(page) if each[0] != "simulate"}
)


ALL = """
import sys
from shapepose_fg.cli.main import main
for line in sys.argv[1:]:
    try:
        main(line.split())
    except SystemExit as end:
        print("code", end.code, "of", line)
"""
"""Runs commands one after the other, in one process: to import all takes each seconds."""


def outcomes(lines: list[str], folder: Path) -> list[tuple[str, str]]:
    """What each command writes to the terminal, and its exit code."""
    seen = at_terminal(sys.executable, "-c", ALL, *lines, columns=1000, cwd=folder)
    assert seen.code == 0 and seen.rubbish() == [] and "Traceback" not in seen.raw
    said = re.split(r"code (\S+) of (.*?)\r*\n", seen.raw)
    assert said[2::3] == lines
    return list(zip(said[:-1:3], said[1::3], strict=True))


@pytest.mark.skipif(not PAGES[0].exists(), reason="installed without the documents")
def test_a_command_in_an_empty_folder_says_what_is_missing(tmp_path):
    seen = at_terminal(sys.executable, "-m", "shapepose_fg", *COMMANDS[0].split(), cwd=tmp_path)
    assert seen.code == 2 and seen.rubbish() == []
    assert any(line.startswith("error: ") for line in seen.lines) and "Traceback" not in seen.raw


@pytest.mark.slow
@pytest.mark.skipif(not PAGES[0].exists(), reason="installed without the documents")
def test_commands_of_the_documents_in_an_empty_folder_say_what_is_missing(tmp_path):
    for command, (words, code) in zip(COMMANDS, outcomes(COMMANDS, tmp_path), strict=True):
        assert code == "2" and "error: " in words, (command, words)


@pytest.mark.slow
def test_the_readme_s_commands(tmp_path):
    """On files of the names that README has; the first lines are those that make them."""
    first = [
        "simulate demo --people 1 --cameras 3 --frames :8 --output detections",
        "--help",
        "reconstruct --help",
    ]
    (tmp_path / "calibration.json").symlink_to(tmp_path / "detections" / "calibration.json")
    lines = [*first, *(" ".join(each) for each in commands(PAGES[0]))]
    for line, (words, code) in zip(lines, outcomes(lines, tmp_path), strict=True):
        assert code == "0", (line, words)
    assert (tmp_path / "results" / "export").is_dir()
