"""Explains the estimate of a joint: contributions of views, body and motion, and contradictions."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factors import kernel_weight
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.decompositions import raise_eigenvalues
from shapepose_fg.core.detections import Detections, DetectionSequence
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.joint_names import mirrored
from shapepose_fg.core.observation_table import Gate, ObservationTable
from shapepose_fg.core.reconstruction import Known, Reconstruction, sigma_m
from shapepose_fg.core.run_summary import RunEntries, entries_of
from shapepose_fg.estimation.factor_shares import FactorEvidence, factor_evidence
from shapepose_fg.estimation.gated_views import inverses, observation_sigmas
from shapepose_fg.estimation.user_factors import ExtraFactors, functions_of, name_of
from shapepose_fg.estimation.window_solution import PersonGraph
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.results.explanation import (
    GATES,
    Cause,
    Explanation,
    FactorReason,
    Finding,
    ViewReason,
)
from shapepose_fg.results.solve_again import Solver, solved_around
from shapepose_fg.tracking.view_assignment import FARTHEST_M

OFF_SIGMA = 3.0
"""Distance of a detection from the prediction by all else, in standard deviations, above which it
is reported: one in 90 exceeds it by chance."""
_APART = 0.5
"""Ratio of the distances from another person's joint and this one's below which a detection is the
other's."""


def explain(
    people: Reconstruction,
    rig: Rig,
    *,
    person: int,
    joint: str,
    frame: int | None = None,
    time_s: float | None = None,
    detections: DetectionSequence | None = None,
    extra_factors: ExtraFactors | None = None,
) -> Explanation:
    """Explain the estimate of a joint in a result, in a `frame`, or in the person's frame nearest
    to `time_s`, seconds.

    The person's window is solved again, from its detections in `people.observations` and with the
    cameras `rig`; joints, covariances and gates are those of the result. If the recording's
    `detections` are given, the findings include detections that have affinities to the person's but
    were not assigned to the person. `extra_factors` are those with which the result was solved, if
    any; their `window.track` is the result's person. Raises InputError if the person, the joint or
    the frame is not in the result, or if the result has no observations.
    """
    row, table = _row_of(people, person, frame, time_s), people.observations
    if table is None:
        raise InputError(
            "the result has no observations.npz, which contains its detections; reconstruct again"
        )
    if tuple(table.view_names.tolist()) != rig.names:
        raise InputError(
            "the cameras are not those of observations.npz; give the cameras of the reconstruction"
        )
    entries = entries_of(people.run)
    names, frame = people.joint_names.tolist(), int(people.frame[row])
    if joint not in names:
        raise InputError(
            f"joint {joint}: the result has no joint of this name; it has {' '.join(names)}"
        )
    number = names.index(joint)
    solver = Solver.of(people, rig)
    graph = solved_around(people, solver, person, frame, extra_factors)
    in_frame = people.frame == frame
    around, at = (
        _Detections.of(people.rows(in_frame), rig, solver.config),
        int(in_frame[:row].sum()),
    )
    views, factors, shares = _view_reasons(around, graph, at, number, solver.config)
    place, known = people.joints[row, number], np.isfinite(people.joints[row, number]).all()
    sigma, when = float(sigma_m(people.covariance[row, number])), float(people.time_s[row])
    refused = _refused(around, at, number, detections)
    findings = _findings(people, entries, row, number, views, factors, shares, refused)
    given = {name_of(function) for function in functions_of(extra_factors)}
    missing = tuple(name for name in entries.extra_factors if name not in given)
    return Explanation(
        person, joint, frame, round(when, 6) if np.isfinite(when) else None,
        tuple(place.tolist()) if known else None, sigma if known and np.isfinite(sigma) else None,
        Known(people.known[row, number]).name.lower(), str(people.status[row]), views, *shares,
        findings, factors, missing,
    )  # fmt: skip


def _row_of(people: Reconstruction, person: int, frame: int | None, time_s: float | None) -> int:
    """Index of the row of a person in a frame, or nearest to a time; raises InputError if there is
    none.
    """
    rows = np.flatnonzero(people.person == person)
    if len(rows) == 0:
        known = " ".join(map(str, np.unique(people.person).tolist()[:20]))
        raise InputError(f"person {person}: not in the result; there are {known or 'none'}")
    if (frame is None) == (time_s is None):
        raise InputError("give either a frame or a time")
    if time_s is not None:
        lag_s = np.abs(people.time_s[rows] - time_s)
        if not np.isfinite(lag_s).any():
            raise InputError("the result has no times; give a frame")
        return int(rows[np.nanargmin(lag_s)])
    row = rows[people.frame[rows] == frame]
    if len(row) == 0:
        first, last = people.frame[rows].min(), people.frame[rows].max()
        raise InputError(
            f"person {person} is not in frame {frame}, only in some frames from {first} to {last}"
        )
    return int(row[0])


@dataclass(frozen=True)
class _Detections:
    """Detections of all people in a frame, N rows."""

    people: Reconstruction
    table: ObservationTable
    views: Views
    sigmas_px: Array
    """(N, J, V) standard deviations of the detections, pixels; 0 without one."""

    @classmethod
    def of(cls, people: Reconstruction, rig: Rig, config: PipelineConfig) -> "_Detections":
        table = people.observations
        assert table is not None
        rows = table.observations(people.joints, np.nan_to_num(people.time_s))
        views, names = Views.of(rig, rows.time_s), people.joint_names.tolist()
        sigmas = observation_sigmas(
            rows, people.joints, views, config.estimator.observations, names
        )
        return cls(people, table, views, sigmas)


def _owner(seen: Detections, table: ObservationTable, rows: Index) -> Index:
    """(D,) index, among some `rows` of one frame, of the row that each detection is assigned to; -1
    for none.
    """
    given = table.candidate[rows]
    n, joint, view = np.nonzero(given >= 0)
    most = max(seen.place.max(initial=0), given.max(initial=0))
    at = np.full((len(table.view_names), most + 1), len(seen))
    at[seen.view, seen.place] = np.arange(len(seen))
    owner = np.full(len(seen) + 1, -1)  # the last is for detections not in the recording
    owner[at[view, given[n, joint, view]]] = n
    return owner[:-1]


def _view_reasons(
    all_of_it: _Detections,
    graph: PersonGraph | None,
    row: int,
    joint: int,
    config: PipelineConfig,
) -> tuple[tuple[ViewReason, ...], tuple[FactorReason, ...], tuple[float, float]]:
    """Contributions of each camera and each of the user's factors to a joint, and the shares of the
    body and of motion.

    The solver's information about the joint is divided into that of each detection, that of the
    body, and the rest, which comes from other frames. The share of a part is trace(part
    inverse(whole)) / 3. A detection is compared with the joint predicted without it, by one
    Gauss-Newton step.
    """
    people, table = all_of_it.people, all_of_it.table
    rows, gates = all_of_it.views.rows(np.array([row])), table.gate[row, joint]
    sigma, seen = all_of_it.sigmas_px[row, joint], gates != Gate.NOT_SEEN
    place, evidence = people.joints[row, joint], list[FactorEvidence]()
    solved = [] if graph is None else np.flatnonzero(graph.frames == people.frame[row]).tolist()
    known = None if graph is None or not solved else graph.sources(solved[0], joint)
    if graph is not None and known is not None:
        place, evidence = known.place, factor_evidence(graph.window, solved[0], joint)
    xy, _, slope = (each[0, 0] for each in rows.project(place[None, None]))
    residual = xy - table.xy[row, joint]
    information, gradient = np.zeros((len(gates), 3, 3)), np.zeros((len(gates), 3))
    used = (gates == Gate.USED) & np.isfinite(residual).all(axis=-1) & (sigma > 0)
    observed = config.estimator.observations
    for v in np.flatnonzero(used).tolist():
        weight = (
            kernel_weight(observed.robust_kernel, np.linalg.norm(residual[v]) / sigma[v])
            / sigma[v] ** 2
        )
        information[v], gradient[v] = (
            weight * slope[v].T @ slope[v],
            weight * slope[v].T @ residual[v],
        )
    whole, of_body = information.sum(axis=0) + np.eye(3), np.zeros((3, 3))
    if known is not None:
        whole, of_body = known.whole, known.of_body
        information, gradient = information / known.widen, gradient / known.widen
    of_factors = [each.information for each in evidence]
    rest = np.trace(whole - information.sum(axis=0) - of_body - sum(of_factors))
    parts = [*information, *of_factors, of_body]
    shares = [float(np.trace(np.linalg.solve(whole, part))) / 3 for part in parts]
    shares.append(max(1.0 - sum(shares), 0.0) if rest > 0 else 0.0)
    shares = [each / max(sum(shares), 1e-9) for each in shares]
    reasons = []
    for v, name in enumerate(table.view_names.tolist()):
        off_px = off_sigma = None
        words = ""
        if seen[v] and np.isfinite(residual[v]).all() and sigma[v] > 0:
            least = np.eye(3)  # weak prior of 1 m
            without = inverses(raise_eigenvalues(whole - information[v], 0.0) + least)
            residual_px = residual[v] + slope[v] @ without @ gradient[v]
            spread = sigma[v] ** 2 * np.eye(2) + slope[v] @ without @ slope[v].T
            off_px = float(np.linalg.norm(residual_px))
            off_sigma = float(np.sqrt(residual_px @ np.linalg.solve(spread, residual_px)))
            if off_sigma > OFF_SIGMA:
                words = _looks_like(
                    all_of_it, row, joint, v, table.xy[row, joint, v], float(sigma[v]), off_px
                )
        reason = ViewReason(
            camera=name,
            gate=GATES[Gate(gates[v])],
            detection_px=_pair(table.xy[row, joint, v]),
            score=float(table.confidence[row, joint, v]),
            probability=float(table.probability[row, joint, v]),
            sigma_px=float(sigma[v]) if seen[v] else None,
            residual_px=_pair(table.residual_px[row, joint, v]),
            off_px=off_px,
            off_sigma=off_sigma,
            share=shares[v],
            looks_like=words,
        )
        reasons.append(reason)
    factor_shares = dict[tuple[str, tuple[str, ...]], float]()
    for each, share in zip(evidence, shares[len(gates) :], strict=False):
        tied = (
            (joint_person, people.joint_names[number]) for joint_person, number, _ in each.others
        )
        own_person = int(people.person[row])
        others = tuple(
            dict.fromkeys(
                str(name) if joint_person == own_person else f"person {joint_person}'s {name}"
                for joint_person, name in tied
            )
        )
        factor_shares[each.name, others] = factor_shares.get((each.name, others), 0.0) + share
    factors = tuple(FactorReason(*which, share) for which, share in factor_shares.items())
    return tuple(reasons), factors, (shares[-2], shares[-1])


def _looks_like(
    all_of_it: _Detections, row: int, joint: int, view: int, at: Array, sigma: float, off: float
) -> str:
    """The joint that a detection more likely belongs to, in words: another person's of the same
    name, or the person's own on the other side. The detection is at `at`, with standard deviation
    `sigma` and distance `off` from its joint, pixels.
    """
    people, names = all_of_it.people, all_of_it.people.joint_names.tolist()
    rows = np.flatnonzero(people.frame == people.frame[row])
    same_kind = np.array(
        [j for j, name in enumerate(names) if name in (names[joint], mirrored(names[joint]))]
    )
    points, covariance = people.joints[rows][:, same_kind], people.covariance[rows][:, same_kind]
    xy, _, slope = (each[:, :, view] for each in all_of_it.views.rows(rows).project(points))
    offset_px, spread = (xy - at)[..., None], sigma**2 * np.eye(2) + slope @ covariance @ slope.mT
    known = np.isfinite(offset_px).all(axis=(-1, -2)) & np.isfinite(spread).all(axis=(-1, -2))
    known &= ~((rows == row)[:, None] & (same_kind == joint))
    squared = np.full(known.shape, np.inf)
    squared[known] = (offset_px[known].mT @ np.linalg.solve(spread[known], offset_px[known]))[
        ..., 0, 0
    ]
    squared[np.linalg.norm(offset_px[..., 0], axis=-1) >= _APART * off] = np.inf
    n, j = np.unravel_index(squared.argmin(), squared.shape)
    return (
        f"person {people.person[rows[n]]}'s {names[same_kind[j]]}"
        if squared[n, j] < OFF_SIGMA**2
        else ""
    )


def _refused(
    all_of_it: _Detections, row: int, joint: int, detections: DetectionSequence | None
) -> list[Finding]:
    """Detections of a joint in cameras where the person has none, near the joint or with affinities
    to the person's: assigned to another person, or unassigned.
    """
    people, table = all_of_it.people, all_of_it.table
    frame = int(people.frame[row])
    if detections is None or not 0 <= frame < len(detections):
        return []
    seen, rows = detections[frame], np.flatnonzero(people.frame == frame)
    owner, me = _owner(seen, table, rows), int((rows < row).sum())
    views = all_of_it.views.rows(np.array([row]))
    xy, depth = (each[0, 0] for each in views.pixels(people.joints[row, joint][None, None]))
    begin, other, affinity = seen.ties
    joined, beside = list[Finding](), list[tuple[float, Finding]]()
    missed = table.gate[row, joint, seen.view] == Gate.NOT_SEEN
    for k in np.flatnonzero((seen.joint == joint) & (owner != me) & missed).tolist():
        view, ends = int(seen.view[k]), slice(begin[k], begin[k + 1])
        name, off = str(table.view_names[view]), float(np.linalg.norm(seen.xy[k] - xy[view]))
        own_affinity, others = (
            affinity[ends][owner[other[ends]] == n].sum() for n in (me, owner[k])
        )
        owner_words = f"person {people.person[rows[owner[k]]]}'s"
        if owner[k] < 0:
            sigmas, others = all_of_it.sigmas_px[:, joint, view], 0.0
            usual = sigmas.sum() / max((sigmas > 0).sum(), 1)
            owner_words = _looks_like(all_of_it, row, joint, view, seen.xy[k], usual, off)
        cause = Cause.FOREIGN if owner_words else Cause.GATED
        if own_affinity > others:
            words = (
                f"connects a detection with this person's that is {owner_words or 'unassigned'}, "
                f"{off:.0f} px off. It was not used."
            )
            joined.append(Finding(cause, (name,), f"Camera {name} {words}"))
        elif not owner_words and off * depth[view] < FARTHEST_M * views.focal[0, view]:
            words = f"Camera {name} has an unassigned detection {off:.0f} px off."
            beside.append((off, Finding(cause, (name,), words)))
    return joined + [each for _, each in sorted(beside, key=lambda one: one[0])]


def _findings(
    people: Reconstruction,
    run: RunEntries,
    row: int,
    joint: int,
    views: Sequence[ViewReason],
    factors: Sequence[FactorReason],
    shares: tuple[float, float],
    refused: Sequence[Finding],
) -> tuple[Finding, ...]:
    """Problems of a joint, most serious first."""
    found, used = list[Finding](), [view for view in views if view.gate == GATES[Gate.USED]]
    problem = _problem(people, run, row, joint)
    if problem:
        found.append(Finding(Cause.NOT_SOLVED, (), f"It was not solved: {problem}."))
    checked = _checked(people, run, row)
    found += [each for each in checked if each.cause == Cause.WRONG_CAMERA]
    left = [view for view in views if view.gate not in (GATES[Gate.USED], GATES[Gate.NOT_SEEN])]
    suspects = [
        view
        for view in (*left, *used)
        if view.camera not in {n for each in found for n in each.cameras}
    ]
    for view in suspects:
        if view.looks_like:
            words = (
                f"Camera {view.camera}'s detection probably belongs to {view.looks_like}: it is "
                f"{_off(view)}. {_taken(view)}"
            )
            found.append(Finding(Cause.FOREIGN, (view.camera,), words))
    named = {name for each in found for name in each.cameras}
    suspects = [view for view in suspects if view.camera not in named]
    found += [each for each in checked if each.cause == Cause.CONTRADICTION]
    against = [view for view in suspects if view.gate == GATES[Gate.CONTRADICTS_BODY]]
    doubted = [view for view in suspects if view in used and (view.off_sigma or 0.0) > OFF_SIGMA]
    agree = [view for view in used if view not in doubted]
    if (
        len(against) + len(doubted) == 1 and len(agree) > 0
    ):  # a single one against all others is wrong
        single = [*against, *doubted]
    else:
        single = []
        for several, fate in ((against, "left out"), (doubted, "used, with less weight")):
            cameras = tuple(view.camera for view in several)
            words = (
                f"{_cameras(cameras)} and all other measurements place it differently"
                f" ({', '.join(map(_off, several))}): detections were {fate}."
            )
            if several:
                found.append(Finding(Cause.CONTRADICTION, cameras, words))
    single += [view for view in suspects if view.gate == GATES[Gate.TOO_FAR]]
    for view in sorted(single, key=lambda view: -(view.off_sigma or 0.0)):
        words = (
            f"Camera {view.camera}'s detection is {_off(view)} and matches no known person. "
            f"{_taken(view)}"
        )
        found.append(Finding(Cause.GATED, (view.camera,), words))
    found += [each for each in refused if each.cameras[0] not in named]
    if len(used) == 0:
        words = (
            f"No camera's detection was used: the body contributes {shares[0]:.0%},"
            f"{''.join(f' {each.name} {each.share:.0%},' for each in factors)} and motion from "
            "other frames the rest."
        )
        found.append(Finding(Cause.PRIOR_ONLY, (), words))
    if len(used) == 1:
        words = f"Only camera {used[0].camera} measures it: its depth comes from body and motion."
        found.append(Finding(Cause.ONE_VIEW, (used[0].camera,), words))
    return tuple(found)


def _problem(people: Reconstruction, entries: RunEntries, row: int, joint: int) -> str:
    """The problem with a joint as run.json states it; empty if there was none."""
    key = int(people.person[row]), int(people.frame[row]), str(people.joint_names[joint])
    problems = entries.people.problems
    return next(
        (each.reason for each in problems if (each.person, each.frame, each.joint) == key), ""
    )


def _checked(people: Reconstruction, entries: RunEntries, row: int) -> list[Finding]:
    """Cameras in which the set-up check found an error, according to run.json: excluded from a
    row's frame, doubted in it, or used nevertheless; in words.
    """
    found, frame = list[Finding](), people.frame[row]
    for spells, cause, fate in (
        (entries.setup.left_out, Cause.WRONG_CAMERA, "left out"),
        (entries.setup.doubted, Cause.CONTRADICTION, "doubted"),
    ):
        those = tuple(each.camera for each in spells if each.frames[0] <= frame < each.frames[1])
        says = "; ".join(each.says for each in entries.setup.findings if {*each.cameras} & {*those})
        if those:
            words = (
                f"In the set-up check, {_cameras(those)} "
                f"{'were' if len(those) > 1 else 'was'} {fate}: {says}."
            )
            found.append(Finding(cause, those, words))
    judged = {each.camera for each in (*entries.setup.left_out, *entries.setup.doubted)}
    assert people.observations is not None
    for each in entries.setup.findings:
        some = 0 < len(each.cameras) < len(people.observations.view_names)
        if some and not judged & {*each.cameras}:
            words = f"The set-up check says: {each.says}."
            found.append(Finding(Cause.WRONG_CAMERA, tuple(each.cameras), words))
    return found


def _taken(view: ViewReason) -> str:
    return "It was left out." if view.gate != GATES[Gate.USED] else "It was used, with less weight."


def _off(view: ViewReason) -> str:
    """Distance of a detection from the prediction by all else, in words."""
    if view.off_px is None or view.off_sigma is None:
        return "behind the camera"
    return f"{view.off_px:.0f} px or {view.off_sigma:.1f} sigmas off"


def _cameras(names: Sequence[str]) -> str:
    return f"Camera{'s' if len(names) > 1 else ''} {', '.join(names)}"


def _pair(values: Array) -> tuple[float, float] | None:
    return (float(values[0]), float(values[1])) if np.isfinite(values).all() else None
