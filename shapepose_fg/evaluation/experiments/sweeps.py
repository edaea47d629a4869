"""What more and fewer cameras, people, frames a second and a worse detector do to the figures."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures
from shapepose_fg.evaluation.experiments.scale import Scale, Stretch, shorter
from shapepose_fg.evaluation.experiments.scene_scores import mean_of, solve_and_score
from shapepose_fg.evaluation.markdown import rule
from shapepose_fg.simulation import DetectorConfig, Scene, built_in_scene, simulate
from shapepose_fg.simulation.motion import Motion

CAMERAS = (2, 3, 4, 6, 8, 12)
PEOPLE = (1, 2, 4, 8, 12)
NOISE = (1, 2, 3)
RATES = (10, 20, 30, 60)
"""Frames a second."""
SEEDS = {"tune": 1900, "report": 2000}
"""Of the built-in scene."""
_BUILT_IN = "built-in"
_FRAMES, _RATED_S = 100, 5.0
"""Frames of other sweeps, and seconds that are seen at each rate."""
_RECORDED_HZ = 30
"""The rate of recorded motions: they are thinned to rates that divide it."""


@dataclass(frozen=True)
class Setting:
    """What one row of the table is measured in."""

    sweep: str
    """What is changed."""
    value: int
    """To what."""
    scene: str
    """`built-in`, or the sequence."""
    cameras: int = 6
    people: int = 4
    """Of the built-in scene: a sequence has its own."""
    noise: float = 1.0
    """`DetectorConfig.noise`."""
    fps: int | None = None
    """Frames a second; None: 25 of the built-in scene, 30 of a sequence."""


def sweeps(scale: Scale) -> Experiment | None:
    """Cameras and noise in the built-in scene and in the crowd, people and rates where they can be had."""
    if not scale.has_scenes:
        return None
    crowd = None if scale.quick else next(s for s in scale.one_each if s.name == "crowd")
    settings = _settings(scale.quick)
    names = {setting: f"{setting.sweep} {setting.value}, {setting.scene}" for setting in settings}

    def case(setting: Setting) -> Case:
        return Case(names[setting], lambda: _measure(setting, scale, crowd))

    def table(figures: Mapping[str, Figures]) -> list[str]:
        rows = [
            "| | scene | F1, % | MPJPE, mm | IDF1, % | rows of nobody | people missed | inside 95 %, % | ms |",
            rule(9),
        ]
        for setting in settings:
            found = figures[names[setting]]
            m = mean_of([found])
            rows.append(
                f"| {setting.sweep}: {setting.value} | {setting.scene}, {found['people']} people | {m['f1']:.1f} "
                f"| {m['error_mm']:.1f} | {m['idf1']:.1f} | {m['nobody']:.0f} "
                f"| {m['missed']:.0f} of {found['frames'] * found['people']} | {m['inside_95']:.1f} "
                f"| {m['ms']:.0f} |"
            )
        return rows

    return Experiment("sweeps", [case(setting) for setting in settings], table)


def thinned(scene: Scene, step: int) -> Scene:
    """Every so-many-th frame of `scene`, at so much lower a rate."""
    motion = scene.motion
    part = Motion(motion.betas, motion.global_orient[::step], motion.body_pose[::step], motion.transl[::step])
    return Scene(scene.rig, scene.body, part, scene.fps / step)


def _settings(quick: bool) -> list[Setting]:
    """The rows of the table; a few of the built-in scene where it must be quick."""
    if quick:
        return [
            Setting("cameras", 3, _BUILT_IN, cameras=3),
            Setting("people", 1, _BUILT_IN, people=1),
            Setting("detector's noise, times", 2, _BUILT_IN, noise=2.0),
            Setting("frames a second", 10, _BUILT_IN, fps=10),
        ]
    both = (_BUILT_IN, "crowd")
    rows = [Setting("cameras", count, scene, cameras=count) for scene in both for count in CAMERAS]
    rows += [Setting("people", count, _BUILT_IN, people=count) for count in PEOPLE]
    rows += [Setting("detector's noise, times", k, scene, noise=float(k)) for scene in both for k in NOISE]
    rows += [Setting("frames a second", fps, _BUILT_IN, fps=fps) for fps in RATES]
    return rows + [Setting("frames a second", fps, "crowd", fps=fps) for fps in RATES if _RECORDED_HZ % fps == 0]


def _measure(setting: Setting, scale: Scale, crowd: Stretch | None) -> Figures:
    """The scene of a setting, simulated and reconstructed over time."""
    seed = SEEDS[scale.split]
    scene = _built_in(setting, seed, scale.quick) if setting.scene == _BUILT_IN else _of_sequence(setting, crowd)
    detections = simulate(scene, DetectorConfig(noise=setting.noise), seed)
    return solve_and_score(scene, detections) | {"people": scene.people}


def _built_in(setting: Setting, seed: int, quick: bool) -> Scene:
    """The same people and motions for each number of cameras and each rate."""
    if setting.fps is None:
        frames, fps, step = _FRAMES, 25.0, 1
    else:
        fps, step = float(max(RATES)), max(RATES) // setting.fps
        frames = round(_RATED_S * fps)
    if quick:
        frames = 8 * step
    scene = built_in_scene(seed, people=setting.people, frames=frames, fps=fps)
    if setting.cameras != len(scene.rig):  # apart, for people are drawn after the cameras: others, for each count
        scene = replace(scene, rig=built_in_scene(seed, people=0, cameras=setting.cameras).rig)
    return thinned(scene, step)


def _of_sequence(setting: Setting, stretch: Stretch | None) -> Scene:
    """The people of a sequence before other cameras, or at a lower rate."""
    assert stretch is not None
    frames = _FRAMES if setting.fps is None else round(_RATED_S * _RECORDED_HZ)
    stretch = shorter(stretch, frames)
    scene = stretch.scene
    if setting.cameras != len(scene.rig):
        scene = replace(scene, rig=replace(stretch, cameras=setting.cameras, span=range(0, 1)).scene.rig)
    return scene if setting.fps is None else thinned(scene, _RECORDED_HZ // setting.fps)
