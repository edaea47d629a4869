"""How well the quick visibility agrees with the whole mesh at full resolution, and how long it takes.

python scripts/measure_visibility.py: the figures of docs/simulation.md, on frames of two built-in scenes.
"""

import time

import numpy as np

from shapepose_fg.simulation import Scene, built_in_scene, simulate
from shapepose_fg.simulation.visibility import BORDER, ITSELF, NOBODY, Skin, Visibility, VisibilityConfig, see
from shapepose_fg.skeleton import BODY_25

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


def main() -> None:
    scenes = [(built_in_scene(seed), range(3 * seed, 60, 6)) for seed in (0, 1)]
    exact = np.stack([view.hidden_by for each in scenes for view in look(*each, EXACT)[0]])
    print(f"{exact.size} joints: {np.mean(exact == NOBODY):.1%} visible, {np.mean(exact == ITSELF):.1%} hidden by")
    print(
        f"the body itself, {np.mean(exact >= 0):.1%} by others, {np.mean(exact == BORDER):.1%} outside the image"
    )
    for name in ("MidHip", "RHip", "Neck", "RShoulder", "RWrist", "RKnee", "Nose"):
        views = (exact[..., BODY_25.index(name)] == NOBODY).sum(axis=1).mean()
        print(f"  {name} is seen in {views:.2f} of {exact.shape[1]} views")
    for cell_m in (0.02, 0.03, 0.04, 0.05):
        config = VisibilityConfig(cell_m=cell_m)
        found = [look(*each, config) for each in scenes]
        quick = np.stack([view.hidden_by for views, _ in found for view in views])
        differs, other = np.mean((quick == NOBODY) != (exact == NOBODY)), np.mean(quick != exact)
        print(
            f"cells of {cell_m} m: {np.mean([ms for _, ms in found]):.1f} ms a frame; visible or not differs for"
            f" {differs:.1%}, who hides for {other:.1%}; {np.mean(quick == NOBODY):.1%} visible"
        )
    scene = scenes[0][0]
    start = time.process_time()
    simulate(scene)
    print(
        f"simulate, with surfaces and detector: {1e3 * (time.process_time() - start) / len(scene):.1f} ms a frame"
    )


if __name__ == "__main__":
    main()
