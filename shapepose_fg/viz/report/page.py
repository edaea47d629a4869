"""The page of a report: head, key figures, scene, sections; one text with everything in it."""

import base64
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass

from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.tracking.listing import TrackSummary
from shapepose_fg.viz.report.elements import Element, asset, asset_element, element, html
from shapepose_fg.viz.report.figures import CameraFigures
from shapepose_fg.viz.report.overview import header, key_figures, over_time, warnings
from shapepose_fg.viz.report.run_section import run_section
from shapepose_fg.viz.report.scene import Scene
from shapepose_fg.viz.report.sections import cameras_section, joints_section, people_section, unused_section

_SCRIPTS = ("geometry.js", "skin.js", "drawing.js", "page.js")
"""In the order in which they are loaded."""


@dataclass(frozen=True)
class Content:
    """Everything that a page says."""

    title: str
    """Name of the result."""
    people: Reconstruction
    """The result."""
    tracks: Sequence[TrackSummary]
    """Its identities."""
    cameras: Sequence[CameraFigures]
    """What became of each camera's detections; none where that is not recorded."""
    scene: Scene | None
    """What is drawn; None where there are no people."""
    remarks: Sequence[str] = ()
    """What the page lacks, a sentence each."""


def page_text(content: Content) -> str:
    """The page as HTML: self-contained, with no address of anything else in it.

    Texts of the input are escaped, and the page's own policy forbids every script but those that are part of it.
    """
    scripts = [asset(name) for name in _SCRIPTS] if content.scene is not None else []
    hashes = " ".join(f"'sha256-{_sha256(text)}'" for text in scripts) or "'none'"
    policy = f"default-src 'none'; style-src 'unsafe-inline'; script-src {hashes}; img-src data:"
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=policy),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("meta", name="referrer", content="no-referrer"),
        element("title", f"{content.title} – shapepose-fg report"),
        element("style", asset("report.css")),
    )
    main = element(
        "main",
        warnings(content.people),
        key_figures(content.people),
        None if content.scene is None else _scene_section(content.scene),
        people_section(content.people, content.tracks, over_time(content.people)),
        cameras_section(content.cameras),
        joints_section(content.people),
        unused_section(content.people, content.cameras),
        run_section(content.people, content.remarks),
    )
    body = element("body", header(content.title, content.people, len(content.cameras)), main)
    if content.scene is not None:
        body.append(element("script", _json(content.scene.data), type="application/json", id="scene-data"))
    for text in scripts:
        body.append(element("script", text))
    return "<!DOCTYPE html>\n" + html(element("html", head, body, lang="en")) + "\n"


def _scene_section(scene: Scene) -> Element:
    """The canvas with what moves it, as the page's script fills it."""
    root = asset_element("scene.html")
    tools = next(each for each in root if each.get("class") == "tools")
    cameras = scene.data["cameras"]
    absent = {"show-bodies": "mesh" not in scene.data, "show-cameras": len(cameras) == 0, "through": not cameras}
    for each in [*tools]:
        name = each.get("id") or next((within.get("id") for within in each), None)
        if name is not None and absent.get(name):
            tools.remove(each)
    for menu in tools.findall("select"):
        menu.extend(
            element("option", f"camera {camera['name']}", value=str(n)) for n, camera in enumerate(cameras)
        )
    root.find(".//input[@id='frame']").set("max", str(max(scene.kept - 1, 0)))  # type: ignore[union-attr]
    if scene.every > 1:
        words = (
            f"Drawn here is one frame in {scene.every} ({scene.kept} of {scene.frames}), so that the page stays"
            " small; all figures below are of every frame."
        )
        root.append(element("p", words, class_="lead"))
    return root


def _sha256(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")


def _json(value: object) -> str:
    """JSON that no name in it can end."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
