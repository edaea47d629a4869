"""report.html in headless Chromium: it draws, plays, turns, and runs nothing but its own
scripts.
"""

import base64

import cv2
import numpy as np
import pytest

from shapepose_fg.core.drawing import thinned
from shapepose_fg.viz.report.scene import CELL_M
from tests.io.export.conftest import BARE, FIRST, FPS, FRAMES

from .browser import Browser, chromium

PIXELS = "return document.getElementById('canvas').toDataURL('image/png').split(',')[1]"
MADE = "const r = new Recording(JSON.parse(document.getElementById('scene-data').textContent));"


@pytest.fixture(scope="module")
def browser():
    with chromium() as window:
        window.resize(1280, 1000)
        yield window


@pytest.fixture
def shown(browser, page) -> Browser:
    browser.open(page)
    browser.wait()
    return browser


def picture(browser: Browser) -> np.ndarray:
    """The canvas: (pixels, 4)."""
    browser.wait()
    png = np.frombuffer(base64.b64decode(browser.run(PIXELS)), dtype=np.uint8)
    read = cv2.imdecode(png, cv2.IMREAD_UNCHANGED)
    assert read is not None
    return read.reshape(-1, 4)


def slide(browser: Browser, frame: int) -> None:
    """What a hand on the slider does."""
    script = (
        "const s = document.getElementById('frame'); s.value = arguments[0]; s.dispatchEvent(new "
        "Event('input'));"
    )
    browser.run(script, frame)


def test_opens_without_a_complaint_and_draws(shown):
    drawn = picture(shown)
    assert shown.complaints() == []
    colours = np.unique(drawn.view(np.uint32))
    # Two bodies in 24 shades each, the floor, lines.
    assert len(colours) > 100
    assert (drawn[:, 3] > 0).mean() > 0.2
    assert shown.run("return performance.getEntriesByType('resource').length") == 0


def test_the_slider_moves_people(shown):
    slide(shown, 0)
    before = picture(shown)
    slide(shown, FRAMES - 1)
    after = picture(shown)
    # Two people who step move in a hundredth of the picture at least.
    assert (before != after).any(axis=1).mean() > 0.01
    clock = shown.run("return document.getElementById('clock').textContent")
    assert clock == f"frame {FIRST + FRAMES - 1} · {(FRAMES - 1) / FPS:.2f} s"
    slide(shown, 0)
    assert (picture(shown) == before).all()


def test_plays_to_the_end_and_stops(shown):
    slide(shown, 0)
    done = shown.ask(
        "execute/async",
        {
            "script": """
const done = arguments[0], play = document.getElementById('play');
play.click();
const during = play.textContent;
setTimeout(() => done([during, play.textContent, document.getElementById('frame').value]), 2200);
""",
            "args": [],
        },
    )
    # 24 frames at 25 a second.
    assert done == ["Pause", "Play", str(FRAMES - 1)]


def test_layers_can_be_switched_off(shown):
    slide(shown, FRAMES - 1)
    # Cameras stand around the room, outside of the first view.
    zoom = (
        "document.getElementById('canvas').dispatchEvent(new KeyboardEvent('keydown', {key: '-'}))"
    )
    for _ in range(8):
        shown.run(zoom)
    before = picture(shown)
    for name in ("bodies", "bones", "cameras", "trails", "sigma"):
        shown.run("document.getElementById(`show-${arguments[0]}`).click()", name)
        after = picture(shown)
        assert (before != after).any(), name
        before = after


def test_dragging_turns_the_view_and_reset_turns_it_back(shown):
    before = picture(shown)
    pointer = [
        {"type": "pointerMove", "x": 500, "y": 500},
        {"type": "pointerDown", "button": 0},
        {"type": "pointerMove", "duration": 50, "x": 640, "y": 520},
        {"type": "pointerUp", "button": 0},
    ]
    shown.ask("actions", {"actions": [{"type": "pointer", "id": "mouse", "actions": pointer}]})
    assert (picture(shown) != before).any(axis=1).mean() > 0.05
    shown.run("document.getElementById('reset').click()")
    assert (picture(shown) == before).all()


def test_a_camera_s_view_is_its_picture(shown, scene, result):
    """Joints land where the camera's own projection puts them, scaled to the canvas."""
    row = int(np.flatnonzero((result.frame == FIRST) & (result.person == 3))[0])
    for view, camera in enumerate(scene.rig.cameras):
        script = f"""{MADE}
const eye = new Eye(r.view, r.cameras);
eye.resize(800, 500);
eye.through = arguments[0];
eye.settle();
const at = (_, j) => eye.project(r.joint(r.rowOf(0, 0), j)).slice(0, 2);
return [eye.frameBox, Array.from({{length: 25}}, at)];"""
        (x, y, wide, tall), drawn = shown.run(script, view)
        xy, _ = camera.project(result.joints[row])
        width, height = camera.image_size
        assert wide / width == pytest.approx(tall / height)
        # Places are rounded to a millimetre: a third of a pixel from 3 m away.
        np.testing.assert_allclose(np.array(drawn), [x, y] + xy * wide / width, atol=0.5)


def test_bodies_are_those_of_the_body_model(shown, true_bodies, arrays_kept):
    script = f"""{MADE}
const row = r.rowOf(arguments[0], arguments[1]);
const at = r.skins.vertices(row, arguments[1]);
return at && Array.from(at);"""
    for frame, person, who in ((0, 0, 3), (17, 1, 7)):
        drawn = np.array(shown.run(script, frame, person)).reshape(-1, 3)
        _, vertices = true_bodies(who, FIRST + frame)
        away = np.linalg.norm(drawn - vertices[arrays_kept], axis=1)
        # Rounded to millimetres; one vertex in a hundred has more than four bones.
        assert np.median(away) < 1.5e-3
        assert away.max() < 15e-3
    # A row without a body is drawn without.
    assert shown.run(script, BARE - FIRST, 1) is None


@pytest.fixture(scope="module")
def arrays_kept():
    from tests.conftest import read_body

    arrays = read_body()
    return thinned(arrays.template, arrays.faces, CELL_M)[0]


def test_names_run_nothing(browser, hostile_page):
    browser.open(hostile_page)
    browser.wait()
    assert browser.complaints() == []
    assert "taken" not in browser.run("return document.title")[:5]
    assert browser.run("return document.images.length") == 0
    options = browser.run(
        "return [...document.querySelectorAll('#through option')].map((o) => o.textContent)"
    )
    assert "onerror" in options[1]


def test_fits_a_telephone(browser, page):
    browser.resize(390, 844)
    try:
        browser.open(page)
        browser.wait()
        assert browser.run("return document.documentElement.scrollWidth") <= 390
        assert len(np.unique(picture(browser).view(np.uint32))) > 100
        assert browser.complaints() == []
    finally:
        browser.resize(1280, 1000)


def test_dark_where_the_reader_s_screen_is(browser, page):
    grey = (
        "return getComputedStyle(document.body).backgroundColor.match(/\\d+/g).reduce((s, v) => "
        "s + Number(v), 0)"
    )
    light = {"features": [{"name": "prefers-color-scheme", "value": "light"}]}
    dark = {"features": [{"name": "prefers-color-scheme", "value": "dark"}]}
    browser.ask("goog/cdp/execute", {"cmd": "Emulation.setEmulatedMedia", "params": light})
    browser.open(page)
    assert browser.run(grey) > 600
    before = picture(browser)
    browser.ask("goog/cdp/execute", {"cmd": "Emulation.setEmulatedMedia", "params": dark})
    assert browser.run(grey) < 150
    assert (picture(browser) != before).any(axis=1).mean() > 0.2
    browser.ask(
        "goog/cdp/execute", {"cmd": "Emulation.setEmulatedMedia", "params": {"features": []}}
    )


def test_opens_at_the_frame_in_the_address(browser, page):
    browser.open(page, f"#frame={FIRST + 5}")
    browser.wait()
    assert browser.run("return document.getElementById('clock').textContent").startswith(
        f"frame {FIRST + 5} "
    )
