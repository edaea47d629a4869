"""Real footage: Shelf's lost limbs as events, its cameras left out one by one, Pose2Sim's demo recording, and
frames alone beside the same frames over time.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

from shapepose_fg.evaluation.alone_beside_time import beside
from shapepose_fg.evaluation.annotated_arms import ANNOTATION, ARMS, measure_arms, read_annotated_arms
from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures
from shapepose_fg.evaluation.experiments.scale import Scale
from shapepose_fg.evaluation.footage import Footage, shelf_footage, single_footage
from shapepose_fg.evaluation.held_out_view import held_out
from shapepose_fg.evaluation.markdown import rule
from shapepose_fg.evaluation.shelf import evaluate_shelf, match_actors, read_shelf_ground_truth
from shapepose_fg.evaluation.shelf_events import identity_switches, lost_limbs, pcp_interval
from shapepose_fg.evaluation.single_person import man_of, measure_single_person
from shapepose_fg.evaluation.varied import varied
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct

QUICK = range(20)
"""Frames of a recording that a quick run takes."""
SINGLE = {
    "frames with the man, of all": lambda f: f"{f['man_found']} of {f['frames']}",
    "limbs over 1.25 times their own median": lambda f: str(f["torn_limbs"]),
    "forearm, standard deviation over mean: joints, %": lambda f: f"{f['forearm_spread']:.2f}",
    "the same of the bodies' points where the detector puts elbow and wrist, %": lambda f: (
        f"{f['body_forearm_spread']:.2f}"
    ),
    "the same of the bodies' bones, %": lambda f: f"{f['bone_forearm_spread']:.2f}",
    "wrists, mean acceleration, m/s²": lambda f: f"{f['wrist_acceleration']:.1f}",
    "wrists, largest acceleration, m/s²": lambda f: f"{f['largest_wrist_acceleration']:.0f}",
    "raised wrist under the shoulder, at the most, m": lambda f: f"{f['lowest_wrist_m']:.3f}",
    "arms to the nearest detection, median, px": lambda f: f"{f['residual_px']:.2f}",
    "bystander found, of the frames in which two views have five joints, %": lambda f: (
        f"{f['bystander_found']:.0f}"
    ),
}
"""What a row is called, and its words."""
ANNOTATED = {
    "annotated elbows and wrists: right elbow, right wrist, left elbow, left wrist, median error, mm": lambda f: (
        ", ".join("-" if f[f"{joint}_m"] is None else f"{1000 * f[f'{joint}_m']:.0f}" for joint in ARMS)
    ),
    "further than 20 cm, %": lambda f: f"{f['arms_wrong']:.1f} of {f['arms']}",
    "inside the 50 and 95 % ellipsoids, %": lambda f: f"{f['arms_inside_50']:.1f} / {f['arms_inside_95']:.1f}",
}
"""Rows about the joints that were annotated by hand."""


def shelf_events(scale: Scale) -> Experiment | None:
    """Avg PCP with an interval over blocks of frames, lost limbs as events, identities that change."""
    folder = scale.shelf
    if folder is None:
        return None
    cases = [Case(name, partial(_shelf, scale, temporal)) for name, temporal in _MODES.items()]
    return Experiment("shelf events", cases, _events_table)


def held_out_views(scale: Scale) -> Experiment | None:
    """Solve without each of Shelf's cameras: what it saw against the 95 % regions of the rest."""
    return (
        None if scale.shelf is None else Experiment("views", [Case("shelf", partial(_views, scale))], _view_table)
    )


def single_person(scale: Scale) -> Experiment | None:
    """Pose2Sim's demo recording, which has no truth."""
    folder = scale.pose2sim_single
    if folder is None:
        return None
    return Experiment(
        "single", [Case(name, partial(_single, scale, on)) for name, on in _MODES.items()], _single_table
    )


def alone_beside_time(scale: Scale) -> Experiment | None:
    """Frames alone beside time on both recordings, and what the kernel of drafts is worth there."""
    if scale.shelf is None or scale.pose2sim_single is None:
        return None
    return Experiment(
        "beside time", [Case(name, partial(_beside, scale, name)) for name in _FOOTAGE], _beside_table
    )


_MODES = {"with time": True, "without time": False}


def _shelf(scale: Scale, temporal: bool) -> Figures:
    shelf = shelf_footage(_there(scale.shelf))
    config = replace(PipelineConfig(), temporal=temporal)
    people = shelf.reconstruct(config, _frames(scale, shelf))
    truth = read_shelf_ground_truth(_there(scale.shelf) / "gt_dev.txt")
    matched = match_actors(people, truth)
    return {
        "average": evaluate_shelf(people, truth).pcp_average,
        "interval": list(pcp_interval(matched)),
        "switches": identity_switches(matched, people.person) if temporal else None,
        "lost": [str(event) for event in lost_limbs(matched)],
    }


def _events_table(found: Mapping[str, Figures]) -> list[str]:
    rows = []
    for name, each in found.items():
        low, high = each["interval"]
        switches = "-" if each["switches"] is None else each["switches"]
        cells = f"{each['average']:.2f} | {low:.1f} to {high:.1f} | {len(each['lost'])} | {switches}"
        rows.append(f"| {name} | {cells} |")
    head = (
        "| Shelf | Avg PCP, % | 95 % interval over blocks of 15 frames | limbs lost, events | identity switches |"
    )
    lost = found.get("with time", {}).get("lost", [])
    return [head, rule(5), *rows, "", "With time: " + "; ".join(lost) + "."]


def _views(scale: Scale) -> Figures:
    shelf, config = shelf_footage(_there(scale.shelf)), PipelineConfig()
    solve: Callable = partial(reconstruct, config=config, frames=_frames(scale, shelf), times=shelf.times)
    people = solve(shelf.detections, shelf.rig)
    cameras = held_out(shelf.detections, shelf.rig, people, solve, config.observations)
    return {
        camera.name: {"inside": 100 * camera.inside, "of": len(camera.squared), "unmatched": camera.unmatched}
        for camera in cameras
    }


def _view_table(found: Mapping[str, Figures]) -> list[str]:
    rows = [
        f"| {name} | {each['inside']:.1f} | {each['of']} | {each['unmatched']} |"
        for name, each in found["shelf"].items()
    ]
    head = (
        "| camera left out | inside the 95 % region, % | of its candidates | joints that the others do not place |"
    )
    return [head, rule(4), *rows]


def _single(scale: Scale, temporal: bool) -> Figures:
    single = single_footage(_there(scale.pose2sim_single))
    frames = _frames(scale, single)
    people = single.reconstruct(replace(PipelineConfig(), temporal=temporal), frames)
    figures = measure_single_person(people, single.detections, single.rig).as_dict()
    if not ANNOTATION.is_file():  # it is not installed
        return figures
    arms = read_annotated_arms(ANNOTATION, single.rig).only(frames)
    return figures | measure_arms(people.rows(man_of(people, single.rig)), arms).as_dict()


def _single_table(found: Mapping[str, Figures]) -> list[str]:
    asked = SINGLE | (ANNOTATED if all("arms" in each for each in found.values()) else {})
    rows = [f"| {name} | {' | '.join(words(each) for each in found.values())} |" for name, words in asked.items()]
    return [f"| pose2sim_single | {' | '.join(found)} |", rule(1 + len(found)), *rows]


_FOOTAGE: dict[str, Callable[[Scale], Footage]] = {
    "Shelf": lambda scale: shelf_footage(_there(scale.shelf)),
    "pose2sim_single": lambda scale: single_footage(_there(scale.pose2sim_single)),
}
_REACHES_M = (PipelineConfig().refine.draft_reach_m, 0.0)
"""`refine.draft_reach_m`: ours, and drafts without it."""


def _beside(scale: Scale, name: str) -> Figures:
    footage = _FOOTAGE[name](scale)
    solve = partial(footage.reconstruct, frames=_frames(scale, footage))
    default, figures = PipelineConfig(), {}
    timed = solve(config=default)
    wrists = [footage.detections.skeleton.joints.index(joint) for joint in ("RWrist", "LWrist")]
    for reach_m in _REACHES_M:
        refine = replace(default.refine, draft_reach_m=reach_m)
        found = beside(solve(config=replace(varied(default), temporal=False, refine=refine)), timed)
        figures[f"{reach_m:g}"] = {
            "share": 100 * found.share,
            "wrists": 100 * float(found.apart[wrists].sum() / max(found.seen[wrists].sum(), 1)),
            "seen": int(found.seen.sum()),
            "missing": found.missing,
        }
    return figures


def _beside_table(found: Mapping[str, Figures]) -> list[str]:
    head = "joints elsewhere, % | wrists elsewhere, % | of joints | people missing"
    rows = [f"| frames alone beside time | {' | '.join(f'{name}: {head}' for name in found)} |"]
    rows.append(rule(1 + 4 * len(found)))
    words = ("**the kernel narrows to 5 cm**", "drafts without it")
    for reach_m, name in zip(_REACHES_M, words, strict=True):
        cells = []
        for each in (every[f"{reach_m:g}"] for every in found.values()):
            cells += [f"{each['share']:.2f}", f"{each['wrists']:.1f}", f"{each['seen']}", f"{each['missing']}"]
        rows.append(f"| {name} | {' | '.join(cells)} |")
    return rows


def _frames(scale: Scale, footage: Footage) -> range:
    count = len(footage.detections)
    return range(min(len(QUICK), count)) if scale.quick else range(count)


def _there(folder: Path | None) -> Path:
    if folder is None:
        raise ValueError("the recording is not there")
    return folder
