"""Reconstructions of simulated scenes against the truth: the tables of people over time, and their cases."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from shapepose_fg.evaluation.experiments.experiment import Case, Column, Experiment, Figures
from shapepose_fg.evaluation.experiments.stretches import QUICK_FRAMES, Scale, Stretch
from shapepose_fg.evaluation.tracking import score_tracks
from shapepose_fg.pipeline.pipeline import PipelineConfig
from shapepose_fg.simulation.foreign import PEOPLE
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.sequences import SEQUENCES
from shapepose_fg.simulation.training.motions import split_of

OVER_TIME = PipelineConfig()
FRAME_BY_FRAME = replace(OVER_TIME, temporal=False)
MODES = {"over time": OVER_TIME, "frame by frame": FRAME_BY_FRAME}

PEOPLE_FOUND = (
    Column("F1", "f1"),
    Column("recall", "recall"),
    Column("IDF1", "idf1"),
    Column("MPJPE", "mpjpe_mm"),
    Column("false positives", "false_positives", 0),
    Column("missed", "people_missed", 0),
)
COLUMNS = (
    *PEOPLE_FOUND,
    Column("accel", "acceleration_error"),
    Column("switches", "switches", 0),
    Column("wrist", "fast_wrist_error_mm"),
    Column("body", "body_mpjpe_mm"),
    Column("b accel", "body_acceleration_error"),
    Column("twists", "twist_jumps", 0),
    Column("stature", "stature_spread_cm"),
    Column("50 %", "seen_inside_50"),
    Column("95 %", "seen_inside_95"),
    Column("u", "joints_unseen", 0),
    Column("u 50 %", "unseen_inside_50"),
    Column("u 95 %", "unseen_inside_95"),
    Column("v", "velocity_error", 2),
    Column("v 95 %", "velocity_inside_95"),
    Column("ms", "cpu_ms", 0),
)
"""mm, m/s², cm, m/s; `u`: joints unseen for ten frames; ms: the processor's, a frame. Means over stretches."""
FOREIGN_COLUMNS = (
    *(Column("F1, %", "f1"), Column("MPJPE, mm", "mpjpe_mm"), Column("body: MPJPE, mm", "body_mpjpe_mm")),
    Column("two views: inside 95 %, %", "seen_inside_95"),
    Column("one view", "one_view_inside_95"),
    Column("none", "no_view_inside_95"),
)
CLASSES = {"seen": "2 views", "one_view": "1", "no_view": "0", "unseen": "0 for ten frames"}
THERE_COLUMNS = (
    *(Column("F1, mean", "f1", 2), Column("least", "f1", 2, "least")),
    *(Column("IDF1, mean", "idf1", 2), Column("least", "idf1", 2, "least")),
    *(Column("missed", "people_missed", 0, "sum"), Column("of", "people", 0, "sum")),
    Column("false positives", "false_positives", 0, "sum"),
    Column("longest", "longest_false_positive", 0, "most"),
    Column("ms", "cpu_ms", 0),
    *(
        column
        for name, words in CLASSES.items()
        for column in (
            Column(f"{words}: inside 50 %", f"{name}_inside_50", 0),
            Column("95 %", f"{name}_inside_95", 0),
            Column("log score", f"{name}_log_score", 2),
            Column("joints", f"joints_{name}", 0, "sum"),
        )
    ),
)

FOREIGN = {
    "the body that is fitted": (PEOPLE[0], False),
    "every bone of its own length, +-5 %": ("own bones", False),
    "arms 15 % longer": ("long arms", False),
    "children of 1.2 m": ("children", False),
    "joints of the detector's own, 18 to 46 mm off": (PEOPLE[0], True),
    "all of these": ("all of these", True),
}
"""Other people than those of the body that is fitted, and whether the detector has joints of its own."""
HELD_BACK_SEED = 1001
HELD_BACK = {"salsa": range(0, 300), "crossing": range(108, 408), "crowd": range(0, 300)}
"""The first 300 frames of each without a cut."""
SECONDS, RATES, CAMERAS = 4.0, (10, 15, 20, 30, 60), (2, 3, 4, 6)
"""Of the recordings of `who is there`."""


def measure(stretch: Stretch, config: PipelineConfig) -> Figures:
    """`TrackingScore.as_dict` of a stretch, how many people there are over all frames, and `cpu_ms` a frame."""
    detections = stretch.detections
    began = time.process_time()
    people = stretch.reconstruct(config)
    cpu_ms = 1e3 * (time.process_time() - began) / len(detections)
    found = score_tracks(people, stretch.truth, stretch.scene.fps, identities=config.temporal)
    return found.as_dict() | {"cpu_ms": cpu_ms, "people": found.joints.people_true}


def case(name: str, stretch: Stretch, config: PipelineConfig = OVER_TIME) -> Case:
    """A stretch that is reconstructed and scored."""
    return Case(name, partial(measure, stretch, config))


def with_mean(cases: Sequence[Case], label: str = "**mean**") -> dict[str, list[Case]]:
    """A row for each case, and one for all."""
    return {case.name: [case] for case in cases} | {label: list(cases)}


def in_time(scale: Scale) -> Experiment:
    """All stretches, over time."""
    return Experiment("time", with_mean([case(each.label, each) for each in scale.stretches]), COLUMNS)


def frame_by_frame(scale: Scale) -> Experiment:
    """All stretches, frame by frame."""
    cases = [case(each.label, each, FRAME_BY_FRAME) for each in scale.stretches]
    return Experiment("time off", with_mean(cases), COLUMNS)


def scenes(scale: Scale) -> Experiment:
    """The built-in scene frame by frame: of the demo, and of seeds not looked at while the pipeline was made."""
    frames = range(QUICK_FRAMES if scale.quick else 60)
    seeds = (0,) if scale.quick else (0, *range(2000, 2005))
    cases = [case(f"seed {seed}", Stretch("demo", frames, seed=seed), FRAME_BY_FRAME) for seed in seeds]
    return Experiment("scenes", with_mean(cases), COLUMNS)


def held_back(scale: Scale) -> Experiment:
    """Held-out people, in sequences that were made when every setting had been chosen.

    The dancers are the same takes as in the reported stretches, which nothing is trained on; who stands and walks
    around them is of test subjects only; places, bodies, cameras and the detector's errors are drawn anew.
    """
    rows = dict[str, list[Case]]()
    stretches = () if scale.mocap is None or scale.quick else held_back_stretches(scale.mocap)
    for name, config in MODES.items():
        cases = [case(f"{each.label} {name}", each, config) for each in stretches]
        rows |= with_mean(cases, f"**mean, {name}**")
    return Experiment("held back", rows, COLUMNS)


def held_back_stretches(mocap: Path) -> list[Stretch]:
    """Those of `held_back`, of the recorded motions in a file."""
    learnt_from = frozenset(subject for subject in Mocap.load(mocap).subjects if split_of(subject) != "test")
    return [
        Stretch(
            name,
            span,
            seed=HELD_BACK_SEED,
            made=replace(SEQUENCES[name], seed=HELD_BACK_SEED, without=learnt_from),
            mocap=mocap,
        )
        for name, span in HELD_BACK.items()
    ]


def foreign(scale: Scale) -> Experiment:
    """Truths with other bodies than the one that is fitted, and a detector with another skeleton."""
    rows = dict[str, list[Case]]()
    for label, (bodies, own_joints) in FOREIGN.items():
        if not scale.quick or label == "all of these":
            rows[label] = [
                case(f"{label} {each.label}", replace(each, bodies=bodies, own_joints=own_joints))
                for each in scale.one_each(100)
            ]
    return Experiment("foreign", rows, FOREIGN_COLUMNS)


def who_is_there(scale: Scale) -> Experiment:
    """Crowds of eight and crossings of seven before 2 to 8 cameras, at 10 to 60 frames a second; two people.

    A row for each kind of recording, over its seeds, and for each number of cameras. Eight cameras, two people and
    frames by themselves are measured at 30 frames a second only: a frame alone knows no rate.
    """
    rows, of_cameras = dict[str, list[Case]](), dict[str, list[Case]]()
    for (name, cameras, rate), drawn in _crowds(scale).items():
        for mode, config in MODES.items():
            if mode == "frame by frame" and rate != 30:
                continue
            kind = f"{cameras} cameras {rate} Hz" + (", frame by frame" if mode == "frame by frame" else "")
            cases = [case(f"{name} {seed} {kind}", stretch, config) for seed, stretch in drawn.items()]
            rows[f"{name}, {kind}"] = cases
            if mode == "over time":
                of_cameras.setdefault(f"**all, {cameras} cameras**", []).extend(cases)
    return Experiment("who is there", rows | of_cameras, THERE_COLUMNS)


def _crowds(scale: Scale) -> Mapping[tuple[str, int, int], Mapping[int, Stretch]]:
    """Recordings by name, cameras and frames a second, and by seed."""
    frames = range(QUICK_FRAMES if scale.quick else round(SECONDS * 30))
    seeds = scale.seeds[:1] if scale.quick else scale.seeds
    found: dict[tuple[str, int, int], dict[int, Stretch]] = {}
    if not scale.quick and scale.mocap is not None:
        kinds = [*((cameras, rate) for cameras in CAMERAS for rate in RATES), (8, 30)]
        for name in ("crowd", "crossing"):
            for cameras, rate in kinds:
                base = Stretch(
                    name, range(round(SECONDS * rate)), scale.split, cameras, fps=rate, mocap=scale.mocap
                )
                found[name, cameras, rate] = {
                    seed: replace(base, seed=seed, made=replace(SEQUENCES[name], seed=seed)) for seed in seeds
                }
    two = Stretch("demo", frames, cameras=2, people=2, fps=30)
    return found | {("two people", 2, 30): {seed: replace(two, seed=seed) for seed in seeds}}
