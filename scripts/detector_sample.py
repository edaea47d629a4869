"""A recording's detections set beside where its other views and its bodies expect them.

For `measure_detector.py` and `detector_figures.py`, which treat real and simulated recordings alike: each view is
judged by the others, and nothing here knows an annotation or the truth of a simulation.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting.baseline import LevenbergMarquardtFitter
from shapepose_fg.body.fitting.fitter import BodyFit
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.camera import Rig, Views
from shapepose_fg.detections import Detections, DetectionSequence
from shapepose_fg.estimation.alternation import EstimatorConfig
from shapepose_fg.estimation.estimator import Estimator
from shapepose_fg.estimation.linearisation import linearise, observation_sigmas, triangulate
from shapepose_fg.observations import Observations
from shapepose_fg.pipeline import PipelineConfig, find_people
from shapepose_fg.proposal.assignment import match_best_first
from shapepose_fg.simulation.facing import seen_from_the_front
from shapepose_fg.simulation.motion import Motion
from shapepose_fg.simulation.scene import Scene
from shapepose_fg.simulation.visibility import Skin, Visibility, VisibilityConfig, see
from shapepose_fg.skeleton import BODY_25

GATE_M = 0.25
"""A candidate farther than this from a joint, as a length at its depth, is not that joint's."""
OTHERS = 3
"""Other views that must agree on a joint before it is used to judge a view."""
BATCH = 64
"""Frames whose bodies are fitted together."""
TRACK_M = 0.4
"""A person's trunk moves less than this from one frame to the next."""
STRANGER_JOINTS = 5
"""Unowned candidates that affinities join in groups of so many are people whom nobody reconstructed."""
STRANGER_PX = 150
"""Single candidates in the background that are this near to such people are theirs."""
NEAR_M = 0.5
"""A false candidate this near to some joint of a person has to do with the person."""
SMOOTH_FRAMES = 3.0
"""Sigma of the smoothing of a twin's motions."""
LIMBS = np.array(BODY_25.limbs)
MIRROR = np.array(BODY_25.mirror)


RAMP = np.array([(-0.9, -0.5), (-0.7, 0.0), (-0.7, 0.0), (-0.8, -0.1), (-0.8, -0.1)])
"""Cosines between which nose, eyes and ears come into sight: where misses fell from 90 to 10 % on Shelf."""


@dataclass(frozen=True)
class People:
    """Whom a recording shows: N rows, one per person and frame."""

    frame: NDArray[np.intp]
    """(N,)"""
    observations: Observations
    """What the views saw of them."""
    joints: NDArray[np.float64]
    """(N, J, 3) metres."""
    track: NDArray[np.intp]
    """(N,) who it is, over time."""
    fit: BodyFit
    """Their bodies, N rows."""
    visibility: Visibility
    """Of those bodies, (V, N, J)."""


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


def find(detections: DetectionSequence, rig: Rig, config: PipelineConfig) -> People:
    """Everybody in the recording, with bodies."""
    parts, frames, joints, fits = [], [], [], []
    fitter = LevenbergMarquardtFitter(config=config.body.plain)
    for start in range(0, len(detections), BATCH):
        numbers = range(start, min(start + BATCH, len(detections)))
        found = [find_people(detections[t], rig, BODY_25, config) for t in numbers]
        frame = np.repeat(np.array(numbers), [len(people) for people in found])
        observations = replace(Observations.concatenate(found), track=np.arange(len(frame)), frame=frame)
        settings = EstimatorConfig(config.observations, config.window_graph, config.refine, config.motion)
        refined = Estimator(rig, fitter, BODY_25.joints, settings).estimate(observations)
        parts.append(observations)
        frames.append(frame)
        joints.append(refined.joints)
        fits.append(refined.fit)
    frame, xyz = np.concatenate(frames), np.concatenate(joints)
    fit = BodyFit(**{name: np.concatenate([getattr(part, name) for part in fits]) for name in vars(fits[0])})
    visibility = visible(rig, frame, fit)
    return People(frame, Observations.concatenate(parts), xyz, tracks(frame, xyz), fit, visibility)


def visible(rig: Rig, frame: NDArray[np.intp], fit: BodyFit) -> Visibility:
    """What each view sees of fitted bodies (N rows); who has no body is seen wholly and hides nobody."""
    body, config = BodyModel.default(), VisibilityConfig()
    rows = (len(rig), len(frame), len(BODY_25))
    seen, inside, hidden_by = np.ones(rows), np.ones(rows, dtype=bool), np.full(rows, -1)
    skin = Skin.of(body, config.cell_m)
    for number in np.unique(frame):
        of_frame = np.flatnonzero((frame == number) & fit.ok)
        motion = Motion(
            fit.betas[of_frame],
            *(getattr(fit, name)[of_frame][None] for name in ("global_orient", "body_pose", "transl")),
        )
        scene = Scene(rig, body, motion, 1.0)
        joints = scene.truth_at(0)
        found = see(rig, joints, scene.vertices_at(0, skin.vertices), skin, config)
        seen[:, of_frame] = seen_from_the_front(found.seen, joints, rig.centres, RAMP)
        inside[:, of_frame] = found.in_image
        who = found.hidden_by
        hidden_by[:, of_frame] = np.where(who >= 0, np.append(of_frame, -1)[np.maximum(who, -1)], who)
    return Visibility(seen, inside, hidden_by)


def tracks(frame: NDArray[np.intp], joints: NDArray[np.float64]) -> NDArray[np.intp]:
    """Link people of successive frames whose trunks are nearest: an identity (N,) that ends where it is lost."""
    trunk = np.nanmean(joints[:, [1, 8, 9, 12]], axis=1)
    track = np.full(len(frame), -1, dtype=np.intp)
    count = 0
    for number in np.unique(frame):
        now, before = np.flatnonzero(frame == number), np.flatnonzero(frame == number - 1)
        distance = np.linalg.norm(trunk[now][:, None] - trunk[before], axis=-1)
        a, b = np.nonzero(distance < TRACK_M)
        picked = match_best_first(a, b, -distance[a, b])
        track[now[a[picked]]] = track[before[b[picked]]]
        new = now[track[now] < 0]
        track[new] = count + np.arange(len(new))
        count += len(new)
    return track


def twin(people: People, rig: Rig, fps: float) -> Scene:
    """A scene in which the reconstructed people are the truth: the same poses before the same cameras.

    Who is followed for a second or more takes part; in frames without a body they are far out of every image.
    Motions are smoothed over time: bodies that were fitted frame by frame tremble, people do not.
    """
    names, counts = np.unique(people.track[people.fit.ok], return_counts=True)
    kept = names[counts >= fps]
    frames = int(people.frame.max()) + 1
    shapes = {"global_orient": (3,), "body_pose": (23, 3), "transl": (3,)}
    motion = {name: np.zeros((frames, len(kept), *shape)) for name, shape in shapes.items()}
    motion["transl"][:] = 1000.0 * rig.up_vector
    betas = np.zeros((len(kept), people.fit.betas.shape[1]))
    for index, track in enumerate(kept):
        rows = np.flatnonzero((people.track == track) & people.fit.ok)
        betas[index] = np.median(people.fit.betas[rows], axis=0)
        for run in np.split(rows, np.flatnonzero(np.diff(people.frame[rows]) > 1) + 1):
            for name, values in motion.items():
                smooth = _smooth_places if name == "transl" else _smooth_turns
                values[people.frame[run], index] = smooth(getattr(people.fit, name)[run])
    return Scene(rig, BodyModel.default(), Motion(betas, **motion), fps)


def _smooth_places(places: NDArray) -> NDArray:
    return gaussian_filter1d(places, SMOOTH_FRAMES, axis=0, mode="nearest")


def _smooth_turns(turns: NDArray) -> NDArray:
    """Rotation vectors (T, ..., 3), smoothed as matrices and made rotations again."""
    matrices = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(*turns.shape, 3)
    U, _, Vt = np.linalg.svd(gaussian_filter1d(matrices, SMOOTH_FRAMES, axis=0, mode="nearest"))
    return Rotation.from_matrix((U @ Vt).reshape(-1, 3, 3)).as_rotvec().reshape(turns.shape)


def left_out(people: People, rig: Rig, view: int, config: PipelineConfig) -> tuple[NDArray, NDArray, NDArray]:
    """Where the other views put each joint in `view`: pixels (N, J, 2), sigma (N, J) m, whether known (N, J)."""
    confidence = people.observations.confidence.copy()
    confidence[..., view] = 0.0
    others = Observations(people.observations.xy, confidence, people.joints)
    views = Views.of(rig)
    sigmas = observation_sigmas(others, people.joints, views, config.observations)
    points = triangulate(others, views, config.observations)
    evidence = linearise(others, sigmas, points, views, config.observations)
    for _ in range(4):
        evidence = linearise(others, sigmas, points, views, config.observations)
        points = evidence.target
    known = evidence.inlier.sum(axis=-1) >= OTHERS
    values, vectors = np.linalg.eigh(evidence.information)
    variance = 1.0 / np.maximum(values, 1e-6)
    # Across the ray of the view, the mean of the two axes: the trace less the part along the ray.
    ray = points - rig.centres[view]
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    along = np.einsum("...ji,...j->...i", vectors, np.nan_to_num(ray)) ** 2
    spread_m = np.sqrt((variance.sum(axis=-1) - (variance * along).sum(axis=-1)) / 2)
    known &= spread_m < 0.03
    xy, depth = rig.project(points)
    return xy[view], np.where(known, spread_m, np.nan), known & (depth[view] > 0.5)


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
            expected.append(_expected(number, part, found, rig, people))
            candidates.append(_candidates(number, part, found, owner))
        pairs.append(_pairs(found, owner, rows, full_xy))
        captured.append(_captured(found, owner, rows, people, full_xy, full_depth, rig))
    table = lambda parts: {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}  # noqa: E731
    joints = table(expected)
    middle = full_xy[:, :, BODY_25.root]
    inside = ((middle >= 0) & (middle < rig.image_sizes[:, None])).all(axis=-1)
    return Sample(
        joints, table(candidates), table(pairs), table(captured), _neighbours(joints, full_xy), int(inside.sum())
    )


def _expected(number: int, part: tuple, found: Detections, rig: Rig, people: People) -> dict[str, NDArray]:
    view, rows, mine, hit, offset, _, at, scale, known, spread_m = part
    size = rig.image_sizes[view]
    margin = 0.05 / scale[..., None]
    inside = ((at > margin) & (at < size - 1 - margin)).all(axis=-1)
    person, joint = np.nonzero(known & inside)
    which = hit[person, joint]
    found_it = which >= 0
    residual = np.full((len(which), 2), np.nan)
    residual[found_it] = offset[person[found_it], which[found_it]]
    confidence = np.full(len(which), np.nan)
    confidence[found_it] = found.confidence[mine[which[found_it]]]
    mirror = MIRROR[joint]
    apart = np.linalg.norm(at[person, joint] - at[person, mirror], axis=-1) * scale[person, joint]
    row = rows[person]
    # The candidates of the mirrored joint that lie where this joint is, nearer than to its own place.
    swapped = np.zeros(len(which), dtype=bool)
    double_m, double_confidence = np.full((2, len(which)), np.nan)
    labels = found.joint[mine]
    for index in np.flatnonzero((mirror != joint) & (apart > 0.12)):
        p, j, m = person[index], joint[index], mirror[index]
        other = mine[labels == m]
        gap = np.linalg.norm(found.xy[other] - at[p, j], axis=-1) * scale[p, j]
        home = np.linalg.norm(found.xy[other] - at[p, m], axis=-1) * scale[p, j]
        there = (gap < 0.06) & (gap < 0.4 * home)
        swapped[index] = bool(there.any())
        if there.any() and found_it[index]:
            twice = other[there][gap[there].argmin()]
            own = found.xy[mine[which[index]]]
            double_m[index] = np.linalg.norm(found.xy[twice] - own) * scale[p, j]
            double_confidence[index] = found.confidence[twice]
    behind = (people.visibility.hidden_by[view] >= 0) & (people.visibility.seen[view] < 0.5)
    return {
        "frame": np.full(len(which), number),
        "person": row,
        "track": people.track[row],
        "view": np.full(len(which), view),
        "joint": joint,
        "seen": people.visibility.seen[view, row, joint],
        "hidden_by": people.visibility.hidden_by[view, row, joint],
        "buried": behind.mean(axis=-1)[row],
        "hit": found_it,
        "residual_m": residual,
        "spread_m": spread_m[person, joint],
        "confidence": confidence,
        "mirror_m": np.where(mirror != joint, apart, np.nan),
        "swapped": swapped,
        "double_m": double_m,
        "double_confidence": double_confidence,
        "px_a_metre": 1.0 / scale[person, joint],
    }


def _candidates(number: int, part: tuple, found: Detections, owner: NDArray) -> dict[str, NDArray]:
    view, rows, mine, _, _, distance, at, scale, _, _ = part
    joint = found.joint[mine]
    group = _group_sizes(found, owner)
    nobody = np.full(len(mine), np.inf)
    if len(rows) == 0:
        nearest = mirrored = any_joint = nobody
    else:
        nearest = distance.min(axis=0, initial=np.inf)
        offset = np.linalg.norm(found.xy[mine][None] - at[:, MIRROR[joint]], axis=-1) * scale[:, joint]
        mirrored = np.nan_to_num(offset, nan=np.inf).min(axis=0)
        every = np.linalg.norm(found.xy[mine][None, :, None] - at[:, None], axis=-1) * scale[:, None]
        any_joint = np.nan_to_num(every, nan=np.inf).min(axis=(0, 2))
    return {
        "frame": np.full(len(mine), number),
        "view": np.full(len(mine), view),
        "joint": joint,
        "confidence": found.confidence[mine],
        "xy": found.xy[mine],
        "owner": owner[mine],
        "nearest_m": nearest,
        "mirrored_m": mirrored,
        "any_joint_m": any_joint,
        "stranger": _stranger(found.xy[mine], group[mine], any_joint),
    }


def _stranger(xy: NDArray, group: NDArray, any_joint_m: NDArray) -> NDArray[np.bool_]:
    """(D,) which candidates of a view belong to people whom nobody reconstructed, or lie among theirs.

    Far from everybody two that are joined will do: a limb in the background is somebody's.
    """
    far = (group > 0) & (any_joint_m > NEAR_M)
    stranger = (group >= STRANGER_JOINTS) | (far & (group >= 2))
    if not stranger.any():
        return stranger
    gap_px = np.linalg.norm(xy[:, None] - xy[stranger], axis=-1).min(axis=1)
    return stranger | (far & (gap_px < STRANGER_PX))


def _group_sizes(found: Detections, owner: NDArray) -> NDArray[np.intp]:
    """(D,) with how many others, itself included, an unowned candidate hangs together by affinities; owned: 0."""
    label = np.arange(len(found))
    first, second = found.pairs.T
    strong = (owner[first] < 0) & (owner[second] < 0) & (found.affinity > 0.3)
    first, second = first[strong], second[strong]
    for _ in range(25):
        low = np.minimum(label[first], label[second])
        np.minimum.at(label, first, low)
        np.minimum.at(label, second, low)
    return np.where(owner < 0, np.bincount(label, minlength=len(label))[label], 0)


def _pairs(found: Detections, owner: NDArray, rows: NDArray, full_xy: NDArray) -> dict[str, NDArray]:
    joined = np.full((25, 25), -1)
    joined[LIMBS[:, 0], LIMBS[:, 1]] = np.arange(len(LIMBS))
    limb = np.where(found.view[:, None] == found.view, joined[found.joint[:, None], found.joint], -1)
    a, b = np.nonzero(limb >= 0)
    score = np.zeros((len(found), len(found)))
    score[tuple(found.pairs.T)] = found.affinity
    strangers = _group_sizes(found, owner) >= STRANGER_JOINTS
    known = ((owner[a] >= 0) | (owner[b] >= 0)) & ~strangers[a] & ~strangers[b]
    a, b = a[known], b[known]
    if len(rows) == 0:
        a, b = a[:0], b[:0]
    view, first, second = found.view[a], found.joint[a], found.joint[b]
    expected_b = full_xy[view, owner[a], second]
    expected_a = full_xy[view, owner[b], first]
    length = np.linalg.norm(expected_b - full_xy[view, owner[a], first], axis=-1)
    length_b = np.linalg.norm(expected_a - full_xy[view, owner[b], second], axis=-1)
    by_a = np.linalg.norm(found.xy[b] - expected_b, axis=-1) / np.maximum(length, 8.0)
    by_b = np.linalg.norm(found.xy[a] - expected_a, axis=-1) / np.maximum(length_b, 8.0)
    detour = np.fmin(np.where(owner[a] >= 0, by_a, np.nan), np.where(owner[b] >= 0, by_b, np.nan))
    return {
        "right": owner[a] == owner[b],
        "nobody": (owner[a] < 0) | (owner[b] < 0),
        "limb": limb[a, b],
        "affinity": score[a, b],
        "confidence": np.minimum(found.confidence[a], found.confidence[b]),
        "detour": np.nan_to_num(detour, nan=99.0),
        "length_px": np.linalg.norm(found.xy[a] - found.xy[b], axis=-1),
    }


def _captured(
    found: Detections, owner: NDArray, rows: NDArray, people: People, full_xy: NDArray, depth: NDArray, rig: Rig
) -> dict[str, NDArray]:
    """Hidden joints without a candidate of their own: does a neighbour's affinity reach the front person's?"""
    adjacency = BODY_25.adjacency.astype(bool)
    at = np.full((len(rig), int(rows.max(initial=0)) + 1, 25), -1)
    mine = np.flatnonzero(owner >= 0)
    at[found.view[mine], owner[mine], found.joint[mine]] = mine
    score = np.zeros((len(found) + 1, len(found) + 1))
    first, second = found.pairs.T
    score[first, second] = score[second, first] = found.affinity
    taken, gap_m = [], []
    hidden = people.visibility.hidden_by[:, rows]
    for view, p, joint in np.argwhere((hidden >= 0) & (people.visibility.seen[:, rows] < 0.5)):
        row, front = rows[p], hidden[view, p, joint]
        if at[view, row, joint] >= 0 or at[view, front, joint] < 0:
            continue
        neighbours = at[view, row, adjacency[joint]]
        if (neighbours < 0).all():
            continue
        taken.append(score[neighbours[neighbours >= 0], at[view, front, joint]].max() > 0.3)
        gap = np.linalg.norm(full_xy[view, row, joint] - full_xy[view, front, joint])
        gap_m.append(gap * depth[view, row, joint] / rig.focal_px[view])
    return {"taken": np.array(taken, dtype=bool), "gap_m": np.array(gap_m, dtype=float)}


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
