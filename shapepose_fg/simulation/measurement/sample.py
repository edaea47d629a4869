"""A recording's detections set beside where its other views and its bodies expect them.

Each view is judged by the others, and nothing here knows an annotation or the truth of a simulation.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.pipeline.pipeline import PipelineConfig
from shapepose_fg.proposal.assignment import match_best_first
from shapepose_fg.simulation.measurement.people import People, left_out
from shapepose_fg.simulation.measurement.sample_tables import (
    candidate_table,
    captured_table,
    expected_table,
    pair_table,
)

GATE_M = 0.25
"""A candidate farther than this from a joint, as a length at its depth, is not that joint's."""


@dataclass(frozen=True)
class Sample:
    """Everything that is counted: joints with a prediction, candidates, pairs of candidates."""

    expected: dict[str, NDArray]
    """Joints that other views place in an image: frame, person (row), track, view, joint, seen, hidden_by (row or
    -1), buried (share of the person's joints that others hide there), hit, residual_m (2), spread_m (of the
    prediction, one sigma per axis), confidence, mirror_m, swapped (found under the mirror's name), double_m and
    double_confidence (of that candidate, from the joint's own, where both are there)."""
    candidates: dict[str, NDArray]
    """All candidates: frame, view, joint, confidence, owner (row or -1), stranger, and how near the
    person's joints are: nearest_m (the same joint), mirrored_m (its mirror), any_joint_m."""
    pairs: dict[str, NDArray]
    """Pairs of candidates that a limb may join and that belong to people: right, affinity, confidence (the lower),
    detour (how far a wrong end is from the right one, in limb lengths), length_m."""
    captured: dict[str, NDArray]
    """Joints behind another person that have no candidate: taken (by affinity), gap_m to that person's joint."""
    neighbours: dict[str, NDArray]
    """Two people's same joint, visible in one view: gap_px between the two places, hits (0 to 2)."""
    people_in_views: int
    """Sum over frames and views of the people whose middle is in the image."""


def take_sample(detections: DetectionSequence, rig: Rig, people: People, config: PipelineConfig) -> Sample:
    """Match candidates with where the other views expect them, frame by frame and view by view."""
    expected, candidates, pairs, captured = [], [], [], []
    predictions = [left_out(people, rig, view, config) for view in range(len(rig))]
    full_xy, full_depth = rig.project(people.joints)
    for number in range(len(detections)):
        found = detections[number]
        rows = np.flatnonzero(people.frame == number)
        owner = np.full(len(found), -1)
        parts = []
        for view in range(len(rig)):
            xy, spread_m, known = (value[rows] for value in predictions[view])
            scale = full_depth[view, rows] / rig.focal_px[view]  # metres a pixel
            at = np.where(known[..., None], xy, full_xy[view, rows])
            mine = np.flatnonzero(found.view == view)
            joint = found.joint[mine]
            offset = (found.xy[mine] - at[:, joint]) * scale[:, joint, None]  # (P, D, 2)
            distance = np.nan_to_num(np.linalg.norm(offset, axis=-1), nan=np.inf)
            a, b = np.nonzero(distance < GATE_M)
            picked = match_best_first(a * 25 + joint[b], b, -distance[a, b])
            a, b = a[picked], b[picked]
            owner[mine[b]] = rows[a]
            hit = np.full((len(rows), 25), -1)
            hit[a, joint[b]] = b
            parts.append((view, rows, mine, hit, offset, distance, at, scale, known, spread_m))
        for part in parts:
            expected.append(expected_table(number, part, found, rig, people))
            candidates.append(candidate_table(number, part, found, owner))
        pairs.append(pair_table(found, owner, rows, full_xy))
        captured.append(captured_table(found, owner, rows, people, full_xy, full_depth, rig))
    table = lambda parts: {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}  # noqa: E731
    joints = table(expected)
    middle = full_xy[:, :, BODY_25.root]
    inside = ((middle >= 0) & (middle < rig.image_sizes[:, None])).all(axis=-1)
    return Sample(
        joints, table(candidates), table(pairs), table(captured), _neighbours(joints, full_xy), int(inside.sum())
    )


def _neighbours(expected: dict[str, NDArray], full_xy: NDArray) -> dict[str, NDArray]:
    """Pairs of people whose same joint is visible in the same view, within 120 px."""
    order = np.flatnonzero(expected["seen"] > 0.6)
    label = (expected["frame"][order] * len(full_xy) + expected["view"][order]) * 25 + expected["joint"][order]
    order = order[np.argsort(label, kind="stable")]
    label = np.sort(label)
    gaps, hits = [np.zeros(0)], [np.zeros(0, dtype=int)]
    for step in range(1, 8):  # people of one label stand next to each other
        a, b = order[:-step], order[step:]
        same = label[:-step] == label[step:]
        a, b = a[same], b[same]
        view, joint = expected["view"][a], expected["joint"][a]
        gap = full_xy[view, expected["person"][a], joint] - full_xy[view, expected["person"][b], joint]
        gaps.append(np.linalg.norm(gap, axis=-1))
        hits.append(expected["hit"][a].astype(int) + expected["hit"][b])
    gap, hit = np.concatenate(gaps), np.concatenate(hits)
    return {"gap_px": gap[gap < 120], "hits": hit[gap < 120]}


def pool(samples: Sequence[Sample]) -> Sample:
    """Several recordings as one: frames, people and tracks numbered on."""
    tables: dict[str, list[dict[str, NDArray]]] = {}
    frames = rows = identities = 0
    for sample in samples:
        shifts = {"frame": frames, "person": rows, "track": identities, "owner": rows}
        for name in ("expected", "candidates", "pairs", "captured", "neighbours"):
            table = {
                key: value + shifts[key] if key in shifts else value
                for key, value in getattr(sample, name).items()
            }
            if name == "candidates":
                table["owner"] = np.where(sample.candidates["owner"] < 0, -1, table["owner"])
            tables.setdefault(name, []).append(table)
        frames += int(sample.candidates["frame"].max(initial=-1)) + 1
        rows += int(sample.expected["person"].max(initial=-1)) + 1
        identities += int(sample.expected["track"].max(initial=-1)) + 1
    joined = {
        name: {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
        for name, parts in tables.items()
    }
    return Sample(**joined, people_in_views=sum(sample.people_in_views for sample in samples))
