"""A solved window: joints, covariances and bodies, and a graph of each person."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import gtsam
import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.fitter import BodyFit, JointTargets
from shapepose_fg.core.arrays import Array, Index, Mask, Whole
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.errors import NotDetermined
from shapepose_fg.core.notes import Problem
from shapepose_fg.core.observation_table import Gate, ObservationTable
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.reconstruction import BODY, Known, Reconstruction, Status
from shapepose_fg.core.rows import Rows
from shapepose_fg.estimation.asynchronous_views import carried_to_frames
from shapepose_fg.estimation.camera_pose_uncertainty import carried_covariance
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.gated_views import ViewEvidence, inverses, mean_confidence
from shapepose_fg.estimation.in_time import near_in_time
from shapepose_fg.estimation.minimise import undetermined_key
from shapepose_fg.estimation.mirrored_sides import DOUBTED, mirrored_spread
from shapepose_fg.estimation.user_factors import PersonWindow, factors_of

RECENT_S = 0.25
"""Time since a view last detected a joint, s, within which its motion determines it."""
RUNAWAY_M = 1.0
"""Distance of a joint with a user factor from its solution without, or from X_0, at which it has
diverged, m."""
WEAK_SCORE = 0.3
"""Score below which a detection is weak: in simulated crowds one in 18 is not the person's, of
others one in 60."""
WEAK_PROBABILITY = 0.5
"""Probability below which a detection is weak."""


@dataclass(frozen=True)
class WindowSolution(Rows):
    """Results of stage II for N rows of a window, in the order of the observations."""

    observations: Observations
    """Track, frame and final detections of each row."""
    joints: Array
    """(N, J, 3) X, metres in the world; NaN if unknown."""
    covariance: Array
    """(N, J, 3, 3) covariance of each joint, including correlated errors, m²; NaN if unknown."""
    velocity: Array
    """(N, J, 3) velocities, m/s; NaN if unknown, and for single frames."""
    velocity_covariance: Array
    """(N, J, 3, 3) covariance of the velocity, m²/s²; NaN like the velocity."""
    confidence: Array
    """(N, J) w_i of Eq. 4, mean confidence over all views of the used observations."""
    inlier: Mask
    """(N, J, V) delta_ij of Eq. 2: the used observations."""
    contradicts: Mask
    """(N, J) joints with views that contradict the body."""
    residual_px: Array
    """(N, J, V, 2) projection of the joint minus observation; NaN if unseen or unknown."""
    known: NDArray[np.uint8]
    """(N, J) code of `Known` for each joint."""
    fit: BodyFit
    """Theta: the bodies, N rows."""
    status: NDArray[np.str_]
    """(N,) `Status` of each row."""
    problems: tuple[Problem, ...] = ()
    """Problems by joint; rows with one have the status `not solved`."""
    people: "tuple[PersonGraph, ...]" = ()
    """Graphs of the people; empty after selecting rows."""
    factors: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Number of factors by user function, and how many of them were inactive at the end, because a
    joint had no position."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Computing time by stage, s."""

    def rows(self, index: Index) -> "WindowSolution":
        """Some of the rows, without graphs: plain data that can be sent to another process."""
        place = {row: n for n, row in enumerate(index.tolist())}
        problems = tuple(
            replace(each, row=place[each.row]) for each in self.problems if each.row in place
        )
        observations = self.observations.rows(index)
        return replace(super().rows(index), observations=observations, problems=problems, people=())

    def result(self, place: Whole, rig: Rig, joint_names: Sequence[str]) -> Reconstruction:
        """The rows as those of a result, with NaN for bodies that were not fitted.

        `place` (N, J, V) is the index of each detection among those of its view in the recording.
        """
        rows = self.observations
        body = {name: getattr(self.fit, name).copy() for name in BODY}
        for values in body.values():
            values[~self.fit.ok] = np.nan
        dropped = np.where(self.contradicts[..., None], Gate.CONTRADICTS_BODY, Gate.TOO_FAR)
        gate = np.where(self.inlier, Gate.USED, dropped)
        views = Views.of(rig, rows.time_s)
        carried = carried_to_frames(rows, self.joints, np.nan_to_num(self.velocity), views)
        names = (
            "joints",
            "covariance",
            "velocity",
            "velocity_covariance",
            "known",
            "confidence",
            "status",
        )
        return Reconstruction(
            frame=rows.frame,
            person=rows.track,
            time_s=rows.time_s.mean(axis=1),
            joint_names=np.array(joint_names),
            observations=ObservationTable.of(
                rows, place, self.joints, gate, rig, joint_names, carried
            ),
            **{name: getattr(self, name) for name in names},
            **body,
        )


@dataclass(frozen=True)
class Sources:
    """Sources of the information about a joint, for explaining its estimate."""

    place: Array
    """(3,) the joint, metres."""
    whole: Array
    """(3, 3) all information on the joint, 1/m²."""
    of_body: Array
    """(3, 3) information from the body in the same frame, without the joint's own views."""
    widen: float
    """Ratio of the detections' variance in the graph to that of their noise model."""


@dataclass(frozen=True, kw_only=True)
class PersonGraph:
    """Solved graph of one person in T frames. The marginal covariances of `keys` are the reported
    ones, and their values the joints.
    """

    window: PersonWindow
    """The person's variables and user factors; its graph is the solver's."""
    joints: Array
    """(T, J, 3) reported joints, metres in the world; NaN if unknown."""
    covariance: Array
    """(T, J, 3, 3) reported covariance, m²; NaN if unknown."""
    bodies: BodyFit
    """The bodies, T rows."""
    together: "list[PersonGraph]" = field(default_factory=list, repr=False)
    """People coupled by user factors, including this one (`tied`); empty if none."""

    @property
    def person(self) -> int:
        """Person number, as in all keys."""
        return self.window.track

    @property
    def frames(self) -> Whole:
        """(T,) frame of each row."""
        return self.window.frames

    @property
    def rows(self) -> Index:
        """(T,) rows of the solution, ascending frames."""
        return self.window.rows

    @property
    def keys(self) -> NDArray[np.int64]:
        """(T, J) keys of the positions, `Point3`, metres; unknown joints (NaN) are not in the
        graph.
        """
        return self.window.keys

    @property
    def velocity_keys(self) -> NDArray[np.int64]:
        """(T, J) keys of the velocities, `Point3`, m/s; in the graph where a user factor is on
        them.
        """
        return self.window.velocity_keys

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """All factors: projections, bodies, motion, user factors. Coupled people (`together`) are
        one graph, with the keys of all of them.
        """
        return self.window.graph

    @property
    def values(self) -> gtsam.Values:
        """The solution."""
        return self.window.values

    def coupled(self, one: tuple[int, int, int], other: tuple[int, int, int]) -> bool:
        """Whether to take the correlation of two joints (person, joint, frame) from the graph:
        where both are in one frame, or user factors couple them. Over time, a
        detector's errors are more correlated than the graph assumes.
        """
        return one[2] == other[2] or any({one[:2], other[:2]} <= p for p in self.window.ties.parts)

    def sources(self, t: int, joint: int) -> Sources | None:
        """Sources of the information about a joint in row `t`; None if its position is unknown."""
        if not np.isfinite(self.covariance[t, joint]).all():
            return None
        whole = np.asarray(np.linalg.inv(self.covariance[t, joint]), dtype=np.float64)
        of_body = self.window.of_body(t, joint)
        return Sources(self.joints[t, joint], whole, of_body, self.window.widen)

    def not_determined(self, error: RuntimeError, joint_names: list[str]) -> NotDetermined | None:
        """The joint, time and missing evidence for GTSAM's `error`, if this graph, or one that
        includes it, has no solution. None if the error concerns another variable.
        """
        key = undetermined_key(error)
        body = np.broadcast_to(self.window.body_keys[:, None, None], (*self.keys.shape, 1))
        keys = np.concatenate([self.window.state_keys, body], axis=-1)
        found = np.argwhere(keys == key)
        if key is None or key < 0 or len(found) == 0:
            return None
        t, joint, kind = found[0].tolist()
        frame, time_s = int(self.frames[t]), float(self.window.times_s[t])
        if kind == keys.shape[-1] - 1:
            missing = "the joints of the frame do not determine it"
            return NotDetermined(self.person, "body", frame, time_s, missing)
        views = int(self.window.seen[t, joint].sum())
        saw = {0: "no camera saw it", 1: "only one camera saw it"}.get(
            views, f"{views} cameras saw it"
        )
        says = "constrains" if self.window.of_body(t, joint).any() else "does not constrain"
        missing = f"{saw}, and the body {says} it"
        return NotDetermined(self.person, str(joint_names[joint]), frame, time_s, missing)


@dataclass(frozen=True)
class Estimates:
    """Current estimates of N rows while they are solved."""

    joints: Array
    """(N, J, 3) joints, metres; NaN if unknown."""
    covariance: Array
    """(N, J, 3, 3) covariances of the joints, m²; NaN if unknown."""
    velocity: Array
    """(N, J, 3) velocities, m/s; NaN if unknown."""
    velocity_covariance: Array
    """(N, J, 3, 3) covariances of the velocities, m²/s²; NaN if unknown."""
    evidence: ViewEvidence
    """The detections at the joints, with those that were used."""
    fit: BodyFit
    """The bodies."""

    @classmethod
    def of(cls, joints: Array, covariance: Array, evidence: ViewEvidence, fit: BodyFit) -> Self:
        """Estimates without velocities."""
        unknown = np.full_like(joints, np.nan), np.full_like(covariance, np.nan)
        return cls(joints, covariance, *unknown, evidence, fit)

    def add_other_errors(
        self,
        rows: Observations,
        sigmas: Array,
        views: Views,
        config: EstimatorConfig,
        *,
        held: bool,
    ) -> None:
        """Add errors that the graphs do not contain to the covariances: those of poses of moving
        cameras, and of exchanged sides. With `held`, bodies reduce the former.
        """
        if views.carried is not None:
            of_body = np.zeros(self.covariance.shape)
            if held:
                of_body = inverses(self.fit.covariance + np.eye(3) * 1e-6)
            bodies, gates = JointTargets(self.joints, of_body), config.observations
            self.covariance[:] += carried_covariance(self.evidence, bodies, sigmas, views, gates)
        self.covariance[:] += mirrored_spread(self.joints, rows.mirrored, config.joints)

    def solution(
        self,
        rows: Observations,
        people: Sequence[PersonWindow],
        problems: tuple[Problem, ...],
        enough: Mask,
        contradicts: Mask,
    ) -> WindowSolution:
        """The solution, with codes, statuses and the graphs of `people`. `enough` (N,) are rows
        whose views determine a body.
        """
        inlier = self.evidence.inlier
        recent = np.asarray(inlier.any(axis=-1))
        for each in people:
            recent[each.rows] = near_in_time(recent[each.rows], each.times_s, RECENT_S)
        known = np.where(recent, Known.MOTION, Known.BODY)
        known = np.where(inlier.any(axis=-1), Known.WEAK, known)
        known = np.where(strong_detections(rows, inlier).sum(axis=-1) >= 2, Known.SEEN, known)
        known = np.where(np.isfinite(self.joints).all(axis=-1), known, Known.UNKNOWN)
        graphs = [
            PersonGraph(
                window=each,
                joints=self.joints[each.rows],
                covariance=self.covariance[each.rows],
                bodies=self.fit.rows(each.rows),
            )
            for each in people
        ]
        return WindowSolution(
            observations=rows,
            joints=self.joints,
            covariance=self.covariance,
            velocity=self.velocity,
            velocity_covariance=self.velocity_covariance,
            confidence=mean_confidence(rows, inlier),
            inlier=inlier,
            contradicts=contradicts,
            residual_px=self.evidence.residual_px,
            known=known.astype(np.uint8),
            fit=self.fit,
            status=statuses(rows, self.fit.ok, enough, problems),
            problems=problems,
            people=tied(graphs),
            factors=factors_of(people),
        )


def tied(people: Sequence[PersonGraph]) -> tuple[PersonGraph, ...]:
    """Return the people, each with those coupled to it by user factors."""
    together, found = dict[int, list[PersonGraph]](), list[PersonGraph]()
    for person in people:
        group = together.setdefault(id(person.window.ties), [])
        uncoupled = len(person.window.ties.people) == 1
        found.append(person if uncoupled else replace(person, together=group))
        group.append(found[-1])
    return tuple(found)


def statuses(
    rows: Observations, ok: Mask, enough: Mask, problems: Sequence[Problem]
) -> NDArray[np.str_]:
    """(N,) status of each row: whether it has a body, `ok` (N,), whether its views determine one,
    `enough` (N,), whether sides may be exchanged, and whether it could not be solved.
    """
    doubted = np.median(rows.mirrored.max(axis=2, initial=0.0), axis=1) > DOUBTED
    sided = np.where(doubted, Status.CONTRADICTED, Status.OK)
    failed = np.where(enough, Status.BODY_UNDETERMINED, Status.TOO_FEW_VIEWS)
    status = np.where(ok, sided, failed)
    status[[problem.row for problem in problems]] = Status.NOT_SOLVED
    return status


def strong_detections(rows: Observations, inlier: Mask) -> Mask:
    """(N, J, V) the used detections, `inlier`, that are not weak."""
    strong = (rows.confidence >= WEAK_SCORE) & (rows.probability > WEAK_PROBABILITY)
    return inlier & strong
