"""Estimates the poses of cameras with known lenses from walking people only.

The steps are pairs of cameras (`relative`), all cameras (`arrangement`), alternating association
and bundle adjustment (`adjustment`), and last scale, up and the floor (`levelling`). An
undetermined result is rejected.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np

from shapepose_fg.cameras.bundle import (
    FILM,
    Adjusted,
    Freedom,
    Steps,
    Undetermined,
    differences,
    grown,
    halves,
    settle,
)
from shapepose_fg.cameras.calibrate.arrangement import Edge, arranged, parts
from shapepose_fg.cameras.calibrate.levelling import (
    CONTRADICTS,
    Measured,
    World,
    levelled,
    people_at_once,
    scale_of,
    sigma_of_scale,
)
from shapepose_fg.cameras.parameters import FOCAL, MOVE, TURN
from shapepose_fg.cameras.people import LEAST_PEOPLE, Footage, missed_px
from shapepose_fg.cameras.relative_pose import Relative, relative
from shapepose_fg.cameras.sightings import Sightings
from shapepose_fg.cameras.stature import ADULT_M
from shapepose_fg.cameras.tracks import CameraTracks, OneClock, seen_at
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.decompositions import rigid
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.frame_times import FrameTimes

_BURST_S, _BURSTS = 10.0, 6
"""Duration of the intervals in which people are tracked, s, and their number, spread over the
recording."""
_FEW, _ROUGH, _ROUNDS, _HALF_ROUNDS = 30, 6, 6, 2
"""Number of frames in the first rounds of association and adjustment, number of these rounds,
number of rounds with all frames, and number of rounds with each half of the frames."""
_LEAST_SCORE, _LEAST_S = 0.15, 3.0
"""Minimum score of a pair of cameras, and minimum common person-seconds."""
_MOST_SIGMA_DEG, _MOST_APART_DEG = 1.0, 2.0
"""Maximum standard deviation of a rotation, and maximum difference between halves of the recording,
degrees."""
KNOWN_LENS = Freedom()
"""Lenses that are not adjusted."""


@dataclass(frozen=True)
class Calibrated:
    """Estimated cameras with their uncertainty."""

    adjusted: Adjusted
    """The cameras, people's positions and covariances, in metres; z is up, the floor at 0."""
    world: World
    """Scale, up and floor of the rig."""
    apart_deg: Array
    """(V,) difference of rotations between halves of the recording, each estimated separately,
    degrees."""
    apart_m: Array
    """(V,) distance between the positions of each camera estimated from halves of the recording,
    metres."""
    held_out_px: float
    """Median distance of a joint from its prediction by the other cameras, on held-out halves,
    pixels."""
    counts: Index
    """(V,) number of people, one per frame, from which each camera was estimated."""
    explained: Array
    """(V,) share of the people seen by each camera that another camera sees too."""
    missed_px: Array
    """(N, V) distances of joints from their predictions by the other cameras, on held-out halves,
    pixels; NaN if unknown."""
    notes: tuple[str, ...] = field(default=())
    """Notes on what is weakly observed, a sentence each."""

    @property
    def rig(self) -> Rig:
        """The cameras."""
        return self.adjusted.rig

    def as_dict(self) -> dict[str, Any]:
        """All figures as plain values."""
        sigmas = {
            "turn_deg": np.degrees(self.adjusted.sigma(TURN)),
            "move_mm": 1e3 * self.adjusted.sigma(MOVE),
        }
        sigmas |= {"focal_percent": 100 * self.adjusted.sigma(FOCAL)}
        cameras = [
            {
                "camera": camera.name,
                "people": int(self.counts[view]),
                "shared": round(float(self.explained[view]), 3),
                "centre_m": np.round(camera.centre, 4).tolist(),
                "focal_px": round(float(camera.K[0, 0]), 2),
                **{f"sigma_{name}": round(float(each[view]), 4) for name, each in sigmas.items()},
                "halves_turn_deg": round(float(self.apart_deg[view]), 3),
                "halves_move_mm": round(1e3 * float(self.apart_m[view]), 1),
            }
            for view, camera in enumerate(self.rig.cameras)
        ]
        floor = self.world.floor
        about = {
            "held_out_px": round(self.held_out_px, 3),
            "sigma_scale": round(self.world.sigma_scale, 4),
        }
        about |= {
            "stature_m": round(self.world.stature_m, 3),
            "people_at_once": self.world.persons,
            "upright": round(self.world.upright, 3),
        }
        return {
            "cameras": cameras,
            **about,
            "floor_found": floor is not None,
            "notes": list(self.notes),
        }


def calibrate(
    detections: DetectionSequence | OneClock,
    rig: Rig,
    times: FrameTimes,
    frames: range,
    lens: Freedom | Sequence[Freedom] = KNOWN_LENS,
    measured: Measured | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    start: Rig | None = None,
) -> Calibrated:
    """Estimate the poses of the cameras of `rig`, ignoring its own poses, from the people in
    `detections`.

    `lens` has the prior standard deviations of the lens parameters, for all cameras or for each;
    those of the poses are ignored. The scale comes from `measured` distances, or from the stature
    of adults. `start` are approximate cameras, which replace the search. Raises Undetermined if
    cameras share too few people, or motion does not determine them; InputError if measured
    distances contradict each other.
    """
    measured = measured or Measured()
    views = len(rig)
    steps = Steps(progress, views * (views - 1) // 2 + _ROUGH + _ROUNDS + 2 * _HALF_ROUNDS)
    footage = Footage.of(detections, rig, times, frames)
    lenses = [lens] * views if isinstance(lens, Freedom) else lens
    freedom = tuple(replace(each, turn_deg=20.0, move_m=1.0) for each in lenses)
    taken = np.unique(footage.sightings.frame)
    scale = partial(scale_of, skeleton=detections.skeleton, stature_m=measured.stature_m)
    fit = partial(settle, given=rig, times=times, freedom=freedom, advance=steps, scale=scale)
    if start is None:
        pairs = _pairs(detections, rig, times, frames, steps)
        if len(connected := parts(pairs, views)) > 1:
            raise Undetermined(tuple(_apart(rig, connected)))
        edges = {pair: _edge(each, scale) for pair, each in pairs.items()}
        sample = footage.at(taken[np.unique(np.linspace(0, len(taken) - 1, _FEW).astype(np.intp))])
        start = fit(sample, rig.at_poses(arranged(edges, views)), _ROUGH).rig
    adjusted = fit(footage, start, _ROUNDS)
    both = halves(footage, partial(fit, now=adjusted.rig, rounds=_HALF_ROUNDS))
    missed = np.concatenate([missed_px(people, rig).reshape(-1, views) for rig, people in both])
    if measured.distances:
        factor, sigma = measured.size_of(adjusted)
        adjusted = grown(adjusted, factor)
    else:
        sigma = sigma_of_scale(people_at_once(adjusted.people), measured.stature_m is not None)
    new, world = levelled(adjusted.rig, adjusted.people, detections.skeleton, sigma)
    moved = new.cameras[0].wTc @ np.linalg.inv(adjusted.rig.cameras[0].wTc)
    people = replace(
        adjusted.people, points=adjusted.people.points @ moved[:3, :3].T + moved[:3, 3]
    )
    found = _judged(
        replace(adjusted, rig=new, people=people), world, [rig for rig, _ in both], missed, footage
    )
    if not measured.distances:
        return found
    notes, tall = measured.better(adjusted, sigma), np.log(world.stature_m / ADULT_M)
    if abs(tall) >= CONTRADICTS * sigma_of_scale(world.persons, False):
        what = f"the median stature of people is {world.stature_m:.2f} m"
        notes += (f"{what}; if they are adults, measure the distance of the cameras again",)
    return replace(found, notes=notes)


def _pairs(
    detections: DetectionSequence | OneClock,
    rig: Rig,
    times: FrameTimes,
    frames: range,
    advance: Callable[[], None],
) -> dict[tuple[int, int], Relative]:
    """Relative poses of pairs of cameras with sufficient evidence."""
    taken = times.frame_s[frames.start : frames.stop]
    lasts = float(taken[-1] - taken[0])
    fps = (len(taken) - 1) / max(lasts, 1e-6)
    after = taken[:, None] - taken[0] - np.linspace(0.0, max(lasts - _BURST_S, 0.0), _BURSTS)
    wanted = frames.start + np.flatnonzero(((after >= 0) & (after <= _BURST_S)).any(axis=1))
    tracks = own_tracks(seen_at(detections, wanted.tolist()), rig, fps)
    found = dict[tuple[int, int], Relative]()
    for a, b in combinations(range(len(rig)), 2):
        each = relative(tracks[a], tracks[b], fps)
        advance()
        if each is not None and each.score >= _LEAST_SCORE and each.seconds >= _LEAST_S:
            found[a, b] = each
    return found


def own_tracks(sightings: Sightings, rig: Rig, fps: float) -> list[CameraTracks]:
    """The tracks of each camera, in its own frame; raises Undetermined if one sees too
    few people.
    """
    seen_s = np.bincount(sightings.view, minlength=len(rig)) / fps
    if len(lacking := np.flatnonzero(seen_s < _LEAST_S)) > 0:
        figures = ", ".join(f"{each:.1f}" for each in seen_s[lacking])
        least = f"at least {_LEAST_S:g} s of a person are needed, but only {figures} s are seen"
        others = ""
        if len(rig) - len(lacking) >= 2:
            without = ",".join(rig.names[view] for view in lacking)
            others = f"; or calibrate the other cameras only (--without {without})"
        raise Undetermined((f"{_named(rig, lacking)}: {least}; {FILM}{others}",))
    still = Views(rig.K, np.tile(np.eye(3, 4), (len(rig), 1, 1)))
    return [CameraTracks.of(sightings, still, view, fps) for view in range(len(rig))]


def _apart(rig: Rig, connected: list[list[int]]) -> list[str]:
    """Cameras that share too little with the others, in words."""
    most = " ".join(rig.names[view] for view in connected[0])
    return [
        f"{_named(rig, part)}: too few people are seen there and by {most} at the same times, or "
        f"cameras are not synchronised; {FILM}, where views overlap"
        for part in connected[1:]
    ]


def _named(rig: Rig, views: Iterable[int]) -> str:
    """Names of some cameras, in words."""
    names = [rig.names[view] for view in views]
    return f"camera{'s' if len(names) > 1 else ''} {' '.join(names)}"


def _edge(pair: Relative, scale: Callable[[Array], float]) -> Edge:
    metres = scale(pair.points)
    return Edge(rigid(pair.R, (metres if np.isfinite(metres) else 3.0) * pair.t), pair.score)


def _judged(
    adjusted: Adjusted, world: World, rigs: list[Rig], missed: Array, footage: Footage
) -> Calibrated:
    """The validated result; raises Undetermined with the problems."""
    rig, people = adjusted.rig, adjusted.people
    apart_deg, apart_m = differences(*rigs)
    counts = people.seen.any(axis=1).sum(axis=0)
    seen = np.bincount(footage.sightings.view, minlength=len(rig))
    held = float(np.nanmedian(missed)) if np.isfinite(missed).any() else np.nan
    found = Calibrated(
        adjusted, world, apart_deg, apart_m, held, counts, counts / np.maximum(seen, 1), missed
    )
    sigma = np.degrees(adjusted.sigma(TURN))
    too_few, uncertain = counts < LEAST_PEOPLE, sigma > _MOST_SIGMA_DEG
    inconsistent = apart_deg > _MOST_APART_DEG
    kinds = (
        (
            too_few,
            counts,
            (
                f"only {{}} people are seen by another camera, too, but at least {LEAST_PEOPLE} "
                "are needed"
            ),
        ),
        (
            ~too_few & uncertain,
            sigma.round(1),
            "the motion of the people determines the rotation to {} degrees only",
        ),
        (
            ~too_few & ~uncertain & inconsistent,
            apart_deg.round(1),
            "the two halves of the recording are {} degrees apart",
        ),
    )
    problems = [
        f"{_named(rig, views)}: {words.format(', '.join(map(str, amounts[views])))}; {FILM}"
        for wrong, amounts, words in kinds
        if len(views := np.flatnonzero(wrong)) > 0
    ]
    if problems:
        raise Undetermined(tuple(problems), found)
    return found
