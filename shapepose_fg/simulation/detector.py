"""A simulated detector with realistic errors: 2D joint candidates and part affinities from true
joints.

Its distributions were measured on real detections (`detector_statistics.py`, docs/simulation.md). A
joint has a temporally correlated quality: at the low end it is missed; otherwise the quality gives
the confidence, and the error is drawn with the size measured for this confidence.
"""

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri

from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections, Recording
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.simulation.candidates import (
    Candidates,
    FalseCandidateProcess,
    FalseCandidates,
    NoiseProcess,
    affinities,
)
from shapepose_fg.simulation.detector_statistics import JOINT_GROUP, DetectorStatistics, measured
from shapepose_fg.simulation.scene import Scene
from shapepose_fg.simulation.visibility import (
    OccludingSurface,
    Visibility,
    VisibilityConfig,
    VisibilityWorker,
    seen_from_the_front,
)

_MIRROR = np.array(BODY_25.mirror)

_HIDDEN, _SEEN = 0.3, 0.7
"""Visible fraction below (above) which a joint counts as occluded (visible); linear in between."""
_HALF_LOST, _WHOLLY_LOST = 1.96, 2.80
"""Increases in the probit of a miss that raise the miss rate from 1 in 40 to one half, and to four
fifths."""


@dataclass(frozen=True)
class DetectorConfig:
    """Levels of the detector's errors: 1 as measured, 0 none, 2 double."""

    noise: float = 1.0
    """Level of position errors."""
    misses: float = 1.0
    """Level of the share of missed joints."""
    doubt: float = 1.0
    """Level of the deviation from 1 of confidences, and of affinities of correct pairs."""
    false_candidates: float = 1.0
    """Level of the number of false candidates."""
    swaps: float = 1.0
    """Level of the share of left-right swapped joints."""
    captures: float = 1.0
    """Level of the share of missed, occluded joints whose neighbours are linked to the occluding
    person's joint."""
    merging: float = 1.0
    """Level of the distance at which the same joint of two people becomes one candidate."""
    wrong_affinities: float = 1.0
    """Level of the share of wrong pairs with an affinity."""
    offsets: KeypointOffsets | None = None
    """Offsets of the detector's joints from those of the body; None: no offsets."""
    statistics: DetectorStatistics = field(default_factory=measured, repr=False)
    """The measured distributions."""
    visibility: VisibilityConfig = field(default_factory=VisibilityConfig)
    """Settings of the visibility test."""

    def __post_init__(self) -> None:
        for name in _KNOBS:
            value = getattr(self, name)
            if not 0 <= value < np.inf:
                raise ValueError(f"{name} must be 0 (none), 1 (as measured) or more, got {value}")
            if value > 1 and name in ("doubt", "captures", "wrong_affinities"):
                raise ValueError(f"{name} must not be more than 1 (as measured), got {value}")

    @classmethod
    def perfect(cls) -> "DetectorConfig":
        """A detector that reports every joint in the image at its true position, with confidence 1,
        and nothing else.
        """
        return cls(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def as_dict(self) -> dict[str, Any]:
        """The settings as plain values, for run.json; the statistics by their provenance."""
        knobs = {name: getattr(self, name) for name in _KNOBS}
        knobs |= {"offsets": None if self.offsets is None else self.offsets.as_dict()}
        return knobs | {
            "statistics": self.statistics.provenance,
            "visibility": asdict(self.visibility),
        }


_KNOBS = "noise misses doubt false_candidates swaps captures merging wrong_affinities".split()


def simulate(
    scene: Scene,
    config: DetectorConfig | None = None,
    seed: int = 0,
    *,
    frames: Sequence[int] | None = None,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Recording:
    """Detect all people in `scene`; equal seeds give equal bytes.

    `frames` selects ascending frame numbers, by default all. As errors are temporally correlated,
    the detector also runs through skipped frames, without visibility, so that every frame is the
    same as in the whole recording. After a cut the errors are redrawn from their stationary
    distribution. `workers` processes compute visibility, which is most of the work (1: this
    process), without changing the result. `progress` is called with the number of finished frames,
    and of all.
    """
    config = DetectorConfig() if config is None else config
    scene = scene if config.offsets is None else scene.with_keypoint_offsets(config.offsets)
    frames = range(len(scene)) if frames is None else frames
    skin = OccludingSurface.of(scene.body, config.visibility.cell_m)
    detector = Detector(scene.rig, scene.people, scene.fps, config, seed)
    rigs = [scene.rig.at(np.full(len(scene.rig), frame / scene.fps)) for frame in frames]
    people = (
        (scene.truth_at(frame), scene.vertices_at(frame, skin.vertices), rig)
        for frame, rig in zip(frames, rigs, strict=True)
    )
    found = []
    worker = VisibilityWorker(scene.rig, skin, config.visibility)
    watched = worker.all(people, min(workers, max(len(frames), 1)))
    with closing(watched):
        for frame, rig, seen in zip(frames, rigs, watched, strict=True):
            detector.skip_to(frame)
            found.append(detector.detect(scene.truth_at(frame), seen, rig))
            if progress is not None:
                progress(len(found), len(frames))
    return Recording(BODY_25, found)


class Detector:
    """A detector for one recording, frame after frame; its errors are correlated over time."""

    def __init__(
        self, rig: Rig, people: int, fps: float, config: DetectorConfig, seed: int = 0
    ) -> None:
        """A detector for `people` people seen by the cameras of `rig` at `fps` frames
        per second.
        """
        self._rig, self._config, self._table, self._seed = rig, config, config.statistics, seed
        given = (len(rig), people, fps, config.statistics, seed)
        self._noise, self._false = (
            NoiseProcess(*given),
            FalseCandidateProcess(*given, config.false_candidates),
        )
        self._frame = 0

    def skip_to(self, frame: int) -> None:
        """Simulate the errors until `frame` is next; raises ValueError if it has passed."""
        if frame < self._frame:
            raise ValueError(
                f"frames must be requested in order: frame {frame} was requested, but "
                f"{self._frame} is next"
            )
        while self._frame < frame:
            self._noise.next(self._frame)
            self._false.next(self._frame)
            self._frame += 1

    def detect(self, joints: Array, visibility: Visibility, rig: Rig | None = None) -> Detections:
        """The candidates of the next frame: BODY_25 `joints` (P, 25, 3) with `visibility`.

        `rig` are the cameras at that time, if they move.
        """
        config, self._rig = self._config, self._rig if rig is None else rig
        noise, false = self._noise.next(self._frame), self._false.next(self._frame)
        rng = np.random.default_rng([self._seed, self._frame, 2])
        self._frame += 1
        true_xy, depth = self._rig.project(joints)
        px_a_metre = self._rig.focal_px[:, None, None] / depth
        found, reported = self._reported(joints, true_xy, px_a_metre, visibility, noise, rng)
        metres_a_px = depth / self._rig.focal_px[:, None, None]
        captors = self._captors(reported, true_xy, metres_a_px, visibility, noise)
        found = _merge(Candidates.concatenate([found, self._invented(false, true_xy, depth)]))
        found = found.rows(rng.permutation(len(found.view)))
        pairs, affinity = affinities(
            found,
            true_xy,
            captors,
            self._table,
            doubt=config.doubt,
            wrong=config.wrong_affinities,
            rng=rng,
        )
        return Detections(found.view, found.joint, found.xy, found.confidence, pairs, affinity)

    def _reported(
        self,
        joints: Array,
        true_xy: Array,
        px_a_metre: Array,
        visibility: Visibility,
        noise: Array,
        rng: np.random.Generator,
    ) -> tuple[Candidates, Mask]:
        """The reported joints of people with their errors, and their mask (V, P, 25)."""
        table, config, sizes = self._table, self._config, self._rig.image_sizes
        seen = seen_from_the_front(visibility.seen, joints, self._rig.centres, table.facing)
        seen = np.clip((seen - _HIDDEN) / (_SEEN - _HIDDEN), 0.0, 1.0)
        hidden_as = np.where(visibility.hidden_by >= 0, 2, 1)
        worse = self._worse(visibility, seen, noise)
        quality = ndtr(noise[NoiseProcess.CONFIDENCE] - worse)
        miss = ndtri(_between(table.miss[JOINT_GROUP, hidden_as], table.miss[JOINT_GROUP, 0], seen))
        miss = ndtr(ndtri(np.minimum(config.misses * ndtr(miss + worse), 1.0)) - worse)
        reported = visibility.in_image & (quality >= miss) & (miss < 1)
        view, person, joint = np.nonzero(reported)
        seen, hidden_as, group = seen[reported], hidden_as[reported], JOINT_GROUP[joint]
        rank = (quality[reported] - miss[reported]) / (1.0 - miss[reported])
        rows = _between(table.confidence[group, hidden_as].T, table.confidence[group, 0].T, seen).T
        confidence, px_a_metre = table.quantile(rows, rank), px_a_metre[reported]
        sigma_px = self._sigma_px(
            confidence, seen, hidden_as, px_a_metre, noise[NoiseProcess.SCALE, reported]
        )
        error = noise[:2, reported].T * sigma_px[:, None] * table.joint_scale[group]
        # Maximum measured error, m; larger ones count as a miss and a false candidate.
        limit = 0.25 * px_a_metre / np.maximum(np.linalg.norm(error, axis=1), 1e-9)
        owner = np.zeros((len(view), len(joints)), dtype=bool)
        owner[np.arange(len(view)), person] = True
        gap_px = np.linalg.norm(
            true_xy[view, person, joint] - true_xy[view, person, _MIRROR[joint]], axis=-1
        )
        # Minimum distance between left and right joint, projected, for a swap, m.
        visibly_apart = gap_px > 0.12 * px_a_metre
        swap_rank = np.where(visibly_apart, ndtr(noise[NoiseProcess.SWAP, reported]), 1.0)
        swapped = swap_rank < config.swaps * table.swap
        owner[swapped] = False
        found = Candidates(
            view=view,
            joint=np.where(swapped, _MIRROR[joint], joint),
            xy=true_xy[reported] + config.noise * error * np.minimum(limit, 1.0)[:, None],
            confidence=1.0 - config.doubt * (1.0 - confidence),
            owner=owner,
            reach_px=self._reach_px(ndtr(noise[NoiseProcess.SCALE, reported]), sizes[view, 1]),
        )
        in_sight = np.where(
            seen >= 0.5, swap_rank, 1.0
        )  # the measured share refers to visible joints
        found = Candidates.concatenate([found, self._duplicates(found, in_sight, px_a_metre, rng)])
        inside = np.all((found.xy >= 0) & (found.xy <= sizes[found.view] - 1), axis=1)
        return found.rows(inside), reported

    def _duplicates(
        self, found: Candidates, swap_rank: Array, px_a_metre: Array, rng: np.random.Generator
    ) -> Candidates:
        """False duplicates of detected joints, reported as the mirrored joint."""
        table, swaps = self._table, self._config.swaps
        low, high = swaps * table.swap, swaps * (table.swap + table.double)
        those = (swap_rank >= low) & (swap_rank < high)
        first = found.rows(those)
        rank = (swap_rank[those] - low) / max(high - low, 1e-9)
        shift_px = rng.normal(0.0, table.double_m, first.xy.shape) * px_a_metre[those, None]
        return Candidates(
            view=first.view,
            joint=_MIRROR[first.joint],
            xy=first.xy + shift_px,
            confidence=table.quantile(table.double_confidence, rank),
            owner=np.zeros_like(first.owner),
            reach_px=np.zeros(len(rank)),
        )

    def _worse(self, visibility: Visibility, seen: Array, noise: Array) -> Array:
        """Increase (V, P, 25) of the probit of a miss for people who are largely
        occluded, or lost.
        """
        # Self-occluded joints are not affected by other people's occlusions.
        table, behind = self._table, visibility.hidden_by >= 0
        share = (behind & (visibility.seen < 0.5)).mean(axis=-1, keepdims=True)
        buried = np.interp(share, table.buried_share, table.buried) * np.where(behind, 1.0, seen)
        if table.lost[1] <= 0:
            return buried
        half, wholly = -ndtri(table.lost)
        slope = (_WHOLLY_LOST - _HALF_LOST) / (wholly - half)
        return buried + np.maximum(_HALF_LOST + slope * (noise[NoiseProcess.LOST] - half), 0.0)

    def _sigma_px(
        self, confidence: Array, seen: Array, hidden_as: Index, px_a_metre: Array, scale: Array
    ) -> Array:
        """Standard deviations (D,) of the errors of reported joints, px; `scale` (D,), normal,
        gives heavier tails.
        """
        table = self._table
        floor_m = table.floor_px / table.size_px_a_metre
        # The measured sigma includes the grid's contribution, which is replaced for people of other
        # sizes.
        own_m = np.sqrt(np.maximum(table.sigma_m**2 - floor_m**2, (0.3 * table.sigma_m) ** 2))
        log_sigma, tail = (
            np.stack([np.interp(confidence, table.knots, row) for row in rows])
            for rows in (np.log(own_m), table.tail)
        )
        which = hidden_as, np.arange(len(confidence))
        sigma_px = np.hypot(
            np.exp(_between(log_sigma[which], log_sigma[0], seen)) * px_a_metre, table.floor_px
        )
        return sigma_px * np.exp(_between(tail[which], tail[0], seen) * scale)

    def _captors(
        self,
        reported: Mask,
        true_xy: Array,
        metres_a_px: Array,
        visibility: Visibility,
        noise: Array,
    ) -> Index:
        """(2, V, P, 25) person in front of a missed joint who captured it (`affinities`), or did
        not; -1 for none.
        """
        table = self._table
        view, person, joint = np.nonzero(
            (visibility.hidden_by >= 0) & visibility.in_image & ~reported
        )
        front = visibility.hidden_by[view, person, joint]
        gap_px = np.linalg.norm(true_xy[view, person, joint] - true_xy[view, front, joint], axis=-1)
        gap_m = np.nan_to_num(gap_px, nan=np.inf) * metres_a_px[view, person, joint]
        kind = np.searchsorted(table.capture_gap_m, gap_m, side="right") - 1
        captured = self._config.captures * table.capture[kind]
        taken = ndtr(noise[NoiseProcess.CAPTURE, view, person, joint]) < captured
        captors = np.full((2, *reported.shape), -1)
        captors[np.where(taken, 0, 1), view, person, joint] = front
        return captors

    def _invented(self, false: FalseCandidates, true_xy: Array, depth: Array) -> Candidates:
        """The false candidates of this frame at their current positions."""
        table, focal_px = self._table, self._rig.focal_px
        near = false.person >= 0
        size = self._rig.image_sizes[false.view]
        xy = false.offset * (size - 1)
        at = false.view[near], false.person[near], false.anchor[near]
        xy[near] = true_xy[at] + false.offset[near] * (focal_px[at[0]] / depth[at])[:, None]
        inside = np.all((xy >= 0) & (xy <= size - 1), axis=1)  # false for NaN behind a camera
        # Static ones are in the background: people in front of them occlude them.
        gap_px = np.linalg.norm(true_xy[false.view] - xy[:, None, None], axis=-1)
        gap_m = (gap_px * depth[false.view]).min(
            axis=(1, 2), initial=np.inf, where=np.isfinite(gap_px)
        )
        # Distance from a person's joint within which false candidates were counted as
        # that person's, m.
        inside &= near | (gap_m > 0.5 * focal_px[false.view])
        quantiles = np.where(near[:, None], table.false_near_confidence, table.false_far_confidence)
        found = Candidates(
            view=false.view,
            joint=false.joint,
            xy=xy,
            confidence=table.quantile(quantiles, false.rank),
            owner=np.zeros((len(xy), true_xy.shape[1]), dtype=bool),
            reach_px=self._reach_px(false.rank, size[:, 1]),
        )
        return found.rows(inside)

    def _reach_px(self, probability: Array, height_px: Array) -> Array:
        """Distance (D,), px, to a better candidate within which one is suppressed: logistic,
        relative to the image's size.
        """
        table, drawn = self._table, np.clip(probability, 1e-6, 1 - 1e-6)
        reach = table.merge_px + table.merge_width_px * np.log(drawn / (1 - drawn))
        return self._config.merging * np.maximum(reach, 0.0) * height_px / table.merge_height_px


def _merge(found: Candidates) -> Candidates:
    """Keep the most confident of near candidates of a joint and view; it then belongs to the owners
    of all.
    """
    if len(found.view) == 0 or found.reach_px.max() <= 0:
        return found
    label = found.view * len(BODY_25) + found.joint
    order = np.lexsort((-found.confidence, label))
    found, label = found.rows(order), label[order]
    winner = np.full(len(label), -1)
    # Candidates of a label are adjacent, best first: compare each with the one before it, two
    # before it, ...
    for step in range(1, int(np.bincount(label).max())):
        better, worse = np.arange(len(label) - step), np.arange(step, len(label))
        near = np.linalg.norm(found.xy[better] - found.xy[worse], axis=1) < found.reach_px[worse]
        near &= label[better] == label[worse]
        winner[worse[near]] = better[near]
    lost = winner >= 0
    owner = found.owner.copy()
    for index in np.flatnonzero(lost)[::-1]:  # few; worst first, so that owners propagate
        owner[winner[index]] |= owner[index]
    return replace(found, owner=owner).rows(~lost)


def _between(hidden: Array, visible: Array, seen: Array) -> Array:
    """Interpolate from the value of a hidden joint to that of a visible one, by the visible
    share.
    """
    return hidden + (visible - hidden) * seen
