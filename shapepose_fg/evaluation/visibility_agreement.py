"""How well the quick visibility agrees with the whole mesh at full resolution, and how long it takes."""

import time

import numpy as np

from shapepose_fg.evaluation.markdown import rule
from shapepose_fg.simulation import Scene, built_in_scene
from shapepose_fg.simulation.visibility import BORDER, ITSELF, NOBODY, Skin, Visibility, VisibilityConfig, see

EXACT = VisibilityConfig(image_scale=1.0, cell_m=0.0, probe_m=0.0)
"""One ray to each joint, through the whole mesh."""


def look(scene: Scene, frames: range, config: VisibilityConfig) -> tuple[list[Visibility], float]:
    """What is seen in some frames, and milliseconds of processor time a frame."""
    skin = Skin.of(scene.body, config.cell_m)
    surfaces = [scene.vertices_at(frame, skin.vertices) for frame in frames]
    start = time.process_time()
    seen = [
        see(scene.rig, scene.truth_at(frame), surface, skin, config)
        for frame, surface in zip(frames, surfaces, strict=True)
    ]
    return seen, 1e3 * (time.process_time() - start) / len(frames)


def table() -> list[str]:
    """Shares of joints and views, and how often buffers of coarser bodies differ, as Markdown."""
    scenes = [(built_in_scene(seed), range(3 * seed, 60, 6)) for seed in (0, 1)]
    exact = np.stack([view.hidden_by for each in scenes for view in look(*each, EXACT)[0]])
    states = exact == NOBODY, exact == ITSELF, exact >= 0, exact == BORDER
    shares = " / ".join(f"{100 * state.mean():.1f}" for state in states)
    rows = [
        f"{exact.size:,} joints and views: visible / hidden by the body itself / by others / outside {shares} %.",
        "",
        "| cells | visible or not differs, % | who hides differs, % | visible, % | a frame, ms |",
        rule(5),
    ]
    for cell_m in (0.02, 0.03, 0.04, 0.05):
        found = [look(*each, VisibilityConfig(cell_m=cell_m)) for each in scenes]
        quick = np.stack([view.hidden_by for views, _ in found for view in views])
        parts = np.mean((quick == NOBODY) != (exact == NOBODY)), np.mean(quick != exact), np.mean(quick == NOBODY)
        cells = " | ".join(f"{100 * part:.1f}" for part in parts)
        default = " (default)" if cell_m == VisibilityConfig().cell_m else ""
        rows.append(f"| {100 * cell_m:.0f} cm{default} | {cells} | {np.mean([ms for _, ms in found]):.0f} |")
    return rows
