"""The canvas of a report with what moves it: layers, view, play, slider, and who is there when."""

from typing import Any

from shapepose_fg.viz.report.elements import Child, Element, element
from shapepose_fg.viz.report.scene import Scene

_LAYERS = {
    "bodies": ("Bodies", "The fitted bodies, with a vertex per 5 cm of skin"),
    "bones": ("Skeletons", "The joints and what joins them; rings are joints that no camera saw in this frame"),
    "sigma": (
        "Uncertainty",
        "Spheres that hold a joint's true place with 95 % probability, by the mean of its sigmas",
    ),
    "trails": ("Paths", "Where people walked in the last two seconds"),
    "cameras": ("Cameras", "Where cameras stand and look"),
}
_OFF = ("sigma",)
"""Layers that are not drawn at first."""
_SPEEDS = (0.25, 0.5, 1, 2, 4)


def scene_section(scene: Scene) -> Element:
    """The scene as the page's script fills it."""
    every, kept = scene.every, scene.kept
    parts: list[Child] = [
        element("h2", "Scene", class_="visually-hidden", id="scene-title"),
        element("noscript", element("p", "The scene needs JavaScript, which is switched off here.")),
        _tools(scene.data),
        _stage(),
        _controls(kept),
        element("canvas", "Who is there when.", id="strip", role="img", aria_label="Who is there when"),
        element(
            "p",
            "One row a person: how high it is filled says how many joints are seen. Click to go there.",
            class_="lead strip-words",
        ),
    ]
    if every > 1:
        words = (
            f"Drawn here is one frame in {every} ({kept} of {scene.frames}), so that the page stays small;"
            " all figures below are of every frame."
        )
        parts.append(element("p", words, class_="lead"))
    return element("section", *parts, id="scene", aria_labelledby="scene-title")


def _tools(scene: dict[str, Any]) -> Element:
    """What is drawn, and from where."""
    there = {**dict.fromkeys(_LAYERS, True), "bodies": "mesh" in scene, "cameras": len(scene["cameras"]) > 0}
    boxes = [
        element("label", _checkbox(name), words, title=meaning)
        for name, (words, meaning) in _LAYERS.items()
        if there[name]
    ]
    views = [element("option", "free view", value="")]
    for index, camera in enumerate(scene["cameras"]):
        views.append(element("option", f"camera {camera['name']}", value=str(index)))
    through = element("select", *views, id="through", aria_label="Look from") if len(views) > 1 else None
    reset = element("button", "Reset view", id="reset", type="button")
    return element("div", *boxes, element("span", class_="space"), through, reset, class_="tools")


def _checkbox(name: str) -> Element:
    on = None if name in _OFF else "checked"
    return element("input", type="checkbox", id=f"show-{name}", checked=on)


def _stage() -> Element:
    canvas = element(
        "canvas",
        "The people in 3D.",
        id="canvas",
        tabindex="0",
        role="img",
        aria_label="People in 3D, with the cameras. Arrow keys turn the view, plus and minus zoom, space plays.",
    )
    hint = element("span", "Drag to turn · right button or two fingers to move · wheel to zoom", class_="hint")
    under = element("div", element("span", id="key"), hint, class_="under")
    return element("div", element("div", canvas, class_="stage"), under)


def _controls(frames: int) -> Element:
    """Play, slider, clock and speed."""
    last = str(max(frames - 1, 0))
    speeds = [
        element("option", f"{speed:g}×", value=f"{speed:g}", selected="selected" if speed == 1 else None)
        for speed in _SPEEDS
    ]
    speed = element("select", *speeds, id="speed", aria_label="Speed")
    return element(
        "div",
        element("button", "Play", id="play", type="button", aria_label="Play"),
        element("input", type="range", id="frame", min="0", max=last, value="0", step="1", aria_label="Frame"),
        element("output", id="clock", for_="frame"),
        element("label", element("span", "speed ", class_="word"), speed, class_="speed"),
        class_="controls",
    )
