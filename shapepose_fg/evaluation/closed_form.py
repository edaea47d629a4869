"""A body from 3D joints in one pass, without iterations: bone lengths, then one rotation after the other.

Shape follows from bone lengths by ridge regression. Then trunk, head, limbs and feet are turned in the order of
the kinematic tree, each to where the joints that hang on it are seen,

    W = argmax tr(Wᵀ M),   M = sum_k w_k (z_k - p) a_kᵀ + W_parent R_mean / (2 s²),

with a_k the arm of joint k from the pivot in the T-pose, z_k its target, p the pivot's place, w_k an inverse
variance, and s the pose prior's sigma of that rotation: Kabsch with the mean pose as one more witness,
so that a single direction turns a bone without twisting it, and a limb that nobody sees hangs as it does on
average. Elbows and knees are hinges, bent as the triangle of their limb says. Good to some centimetres: a start
for other fitters, and what they must beat.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from shapepose_fg.body.fitting.person_frame import PersonFrame
from shapepose_fg.body.fitting.pose_prior import PosePrior
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.body.model.rotation import exp_so3, log_so3
from shapepose_fg.body.model.target_skeletons import slots
from shapepose_fg.core.skeleton import BODY_25, SMPL_24
from shapepose_fg.evaluation.bone_lengths import BoneLengths

_SPINE = ("spine1", "spine2", "spine3")
_NECK = ("neck", "head")
_HIPS = ("RHip", "LHip")
_CHEST = ("Neck", "RShoulder", "LShoulder")
_FACE = ("Nose", "REye", "LEye", "REar", "LEar")
_STRAIGHTEST_RAD = -0.2
"""A hinge that is measured to be bent the wrong way by more is noise."""


@dataclass(frozen=True)
class Limb:
    """An arm or a leg: a ball joint, a hinge, and the foot of a leg."""

    keypoints: tuple[str, str, str]
    """BODY_25 joints at the ball joint, at the hinge and at the end."""
    ball: str
    """SMPL's ball joint."""
    hinge: str
    """SMPL's hinge."""
    axis: tuple[float, float, float]
    """The hinge flexes about it, in the T-pose."""
    collar: str = ""
    """SMPL's joint between chest and ball joint; empty for a leg."""
    foot: str = ""
    """SMPL's joint of the foot; empty for an arm."""
    toes: tuple[str, ...] = ()
    """BODY_25 joints of the foot."""


def _arm(side: str, letter: str, sign: float) -> Limb:
    ends = (f"{letter}Shoulder", f"{letter}Elbow", f"{letter}Wrist")
    return Limb(ends, f"{side}_shoulder", f"{side}_elbow", (0.0, sign, 0.0), collar=f"{side}_collar")


def _leg(side: str, letter: str) -> Limb:
    ends = (f"{letter}Hip", f"{letter}Knee", f"{letter}Ankle")
    toes = (f"{letter}BigToe", f"{letter}SmallToe", f"{letter}Heel")
    return Limb(ends, f"{side}_hip", f"{side}_knee", (1.0, 0.0, 0.0), foot=f"{side}_ankle", toes=toes)


LIMBS = (_arm("left", "L", -1.0), _arm("right", "R", 1.0), _leg("left", "L"), _leg("right", "R"))


class ClosedFormStart:
    """Bodies from BODY_25 joints in closed form, in the model's floating point type and without gradients.

    Rows are independent. A row needs one usable joint at the very least: refuse others first (`evidence.weigh`).
    """

    def __init__(self, model: BodyModel, prior: PosePrior):
        self.model, self.dtype = model, model.dtype
        self._frame = PersonFrame.of_angles(model, prior.mean, prior.covariance)
        self._lengths = BoneLengths(model, prior)
        self._rest, self._rest_shapes = (part.to(self.dtype) for part in _rest_points(model))
        self._mean = exp_so3(torch.from_numpy(prior.mean).view(23, 3)).to(self.dtype)
        self._variance = np.diag(prior.covariance).reshape(23, 3).mean(axis=1)

    @torch.no_grad()
    def __call__(self, xyz: Tensor, variance_m2: Tensor) -> BodyParameters:
        """The bodies of targets `xyz` (B, 25, 3), metres, finite.

        `variance_m2` (B, 25) is the mean variance of each over the axes; infinite where it is not to be used.
        """
        betas = self._lengths.betas(xyz, variance_m2)
        figure = _Figure(
            xyz, 1 / variance_m2, (self._rest.flatten() + betas @ self._rest_shapes).unflatten(1, (-1, 3))
        )
        rotation, pelvis = self._frame.place(xyz.double(), variance_m2.double(), slots(BODY_25.joints))
        root, pelvis = rotation.to(self.dtype), pelvis.to(self.dtype)
        local = self._mean.repeat(len(xyz), 1, 1, 1)
        root, chest = self._turn_trunk(figure, local, root, pelvis)
        self._turn_head(figure, local, chest)
        for limb in LIMBS:
            self._turn_limb(figure, local, limb, chest if limb.collar else root)
        return self._move(figure, BodyParameters(betas, log_so3(root), log_so3(local), torch.zeros_like(pelvis)))

    def _turn_trunk(self, figure: "_Figure", local: Tensor, root: Tensor, pelvis: Tensor) -> tuple[Tensor, Tensor]:
        """World rotations (B, 3, 3) of pelvis and chest, the bend between them shared by the joints of the spine.

        `root` (B, 3, 3) and `pelvis` (B, 3) are where the mean body lies best: a guess for what is hidden.
        """
        figure.guess("pelvis", pelvis, ("MidHip", *_HIPS), root)
        mean, pull = self._mean_chain(_SPINE), self._pull(_SPINE)
        root = figure.turn("MidHip", _HIPS, root, pull)
        figure.guess("MidHip", figure.places["MidHip"], ("spine2", *_HIPS), root)
        chest = figure.turn("spine2", _CHEST, root @ mean, pull)
        figure.guess("spine2", figure.places["spine2"], _CHEST, chest)
        self._share(local, _SPINE, root.mT @ chest)
        return root, chest

    def _turn_head(self, figure: "_Figure", local: Tensor, chest: Tensor) -> None:
        """Neck and head."""
        figure.guess("Neck", figure.places["Neck"], ("neck",), chest)
        head = figure.turn("neck", _FACE, chest @ self._mean_chain(_NECK), self._pull(_NECK))
        self._share(local, _NECK, chest.mT @ head)

    def _turn_limb(self, figure: "_Figure", local: Tensor, limb: Limb, parent: Tensor) -> None:
        """Ball joint, hinge and foot of a limb that hangs on a bone with world rotation `parent` (B, 3, 3)."""
        if limb.collar:
            parent = parent @ self._mean_chain((limb.collar,))
        start, middle, end = limb.keypoints
        hinge = self._bend(figure, limb)
        upper = figure.arm(start, middle)
        whole = upper + (hinge @ figure.arm(middle, end)[..., None]).squeeze(-1)
        world = figure.align(
            start,
            ((middle, upper), (end, whole)),
            parent @ self._mean_chain((limb.ball,)),
            self._pull((limb.ball,)),
        )
        self._share(local, (limb.ball,), parent.mT @ world)
        self._share(local, (limb.hinge,), hinge)
        if limb.foot:
            shank = world @ hinge
            figure.note(end, figure.places[start] + (world @ whole[..., None]).squeeze(-1))
            foot = figure.turn(end, limb.toes, shank @ self._mean_chain((limb.foot,)), self._pull((limb.foot,)))
            self._share(local, (limb.foot,), shank.mT @ foot)

    def _bend(self, figure: "_Figure", limb: Limb) -> Tensor:
        """Rotation (B, 3, 3) of the hinge: from its angle, else from how far its ends are apart, else the mean.

        Solves upper . R(angle) lower = a + b cos(angle) + c sin(angle) for the flexed one of two solutions.
        """
        start, middle, end = limb.keypoints
        upper, lower = figure.arm(start, middle), figure.arm(middle, end)
        axis = upper.new_tensor(limb.axis)
        product = upper.norm(dim=-1) * lower.norm(dim=-1)
        first, second = figure.xyz_of(middle) - figure.places[start], figure.xyz_of(end) - figure.xyz_of(middle)
        apart = (figure.xyz_of(end) - figure.places[start]).square().sum(-1)
        by_length = (apart - upper.square().sum(-1) - lower.square().sum(-1)) / 2
        by_angle = torch.cosine_similarity(first, second, dim=-1) * product
        scalar = torch.where(figure.seen(middle), by_angle, by_length)
        a = (upper @ axis) * (lower @ axis)
        b = (upper * lower).sum(-1) - a
        c = (upper * torch.linalg.cross(axis.expand_as(lower), lower)).sum(-1)
        angle = torch.atan2(c, b) + torch.arccos(((scalar - a) / torch.hypot(b, c)).clamp(-1, 1))
        bent = exp_so3(angle.clamp_min(_STRAIGHTEST_RAD)[:, None] * axis)
        return torch.where(figure.seen(end)[:, None, None], bent, self._mean_chain((limb.hinge,)))

    def _move(self, figure: "_Figure", posed: BodyParameters) -> BodyParameters:
        """The posed body, turned and shifted as a whole onto its targets."""
        points, weight = self.model.keypoints(posed), figure.weight[..., None]
        share = weight / weight.sum(1, keepdim=True)
        centre, goal = ((share * x).sum(1, keepdim=True) for x in (points, figure.xyz))
        moment = (weight * (figure.xyz - goal)).mT @ (points - centre)
        turn = _nearest_rotation(moment + torch.eye(3, dtype=self.dtype))
        # The root turns about the pelvis, which is at the same place in every pose.
        pelvis = figure.rest[:, _POINTS["pelvis"], None]
        transl = (pelvis - centre) @ turn.mT + goal - pelvis
        orient = log_so3(turn @ exp_so3(posed.global_orient))
        return BodyParameters(posed.betas, orient, posed.body_pose, transl.squeeze(1))

    def _mean_chain(self, joints: tuple[str, ...]) -> Tensor:
        """(3, 3) the mean rotation of the last of SMPL's joints against the parent of the first."""
        rotation = torch.eye(3, dtype=self.dtype)
        for name in joints:
            rotation = rotation @ self._mean[SMPL_24.index(name) - 1]
        return rotation

    def _pull(self, joints: tuple[str, ...]) -> float:
        """1 / (2 s²): how strongly a rotation is drawn to its mean."""
        return float(1 / (2 * sum(self._variance[SMPL_24.index(name) - 1] for name in joints)))

    @staticmethod
    def _share(local: Tensor, joints: tuple[str, ...], rotation: Tensor) -> None:
        """Give each of a chain of joints its part of `rotation` (B, 3, 3)."""
        part = rotation if len(joints) == 1 else exp_so3(log_so3(rotation) / len(joints))
        for name in joints:
            local[:, SMPL_24.index(name) - 1] = part


_POINTS = {name: index for index, name in enumerate((*BODY_25.joints, *SMPL_24))}
"""Rows of a figure's rest points: BODY_25's joints, which are written large, then SMPL's, written small."""


class _Figure:
    """The targets of B people, their bodies in the T-pose, and where points are, as far as that is known yet."""

    def __init__(self, xyz: Tensor, weight: Tensor, rest: Tensor):
        self.xyz, self.weight = xyz, weight
        self.rest = rest
        """(B, 49, 3) points of the T-pose, metres."""
        self.places: dict[str, Tensor] = {}
        """(B, 3) each: the target where there is one, else a guess."""

    def xyz_of(self, name: str) -> Tensor:
        """(B, 3) target of a keypoint."""
        return self.xyz[:, _POINTS[name]]

    def seen(self, name: str) -> Tensor:
        """(B,) whether a keypoint has a target."""
        return self.weight[:, _POINTS[name]] > 0

    def arm(self, start: str, end: str) -> Tensor:
        """(B, 3) from one point to another in the T-pose."""
        return self.rest[:, _POINTS[end]] - self.rest[:, _POINTS[start]]

    def note(self, name: str, guess: Tensor) -> None:
        """Note where a point is: at its target, else at a guess (B, 3)."""
        keypoint = _POINTS[name] < len(BODY_25)
        self.places[name] = torch.where(self.seen(name)[:, None], self.xyz_of(name), guess) if keypoint else guess

    def guess(self, start: str, place: Tensor, names: tuple[str, ...], rotation: Tensor) -> None:
        """Note where points are that hang on a bone with world `rotation`, whose point `start` is at `place`."""
        for name in names:
            self.note(name, place + (rotation @ self.arm(start, name)[..., None]).squeeze(-1))

    def turn(self, pivot: str, names: tuple[str, ...], mean: Tensor, pull: float) -> Tensor:
        """World rotation (B, 3, 3) of a rigid part that turns about `pivot`."""
        return self.align(pivot, tuple((name, self.arm(pivot, name)) for name in names), mean, pull)

    def align(self, pivot: str, arms: tuple[tuple[str, Tensor], ...], mean: Tensor, pull: float) -> Tensor:
        """World rotation (B, 3, 3) that turns `arms` to where their keypoints are seen from the pivot.

        The pivot's own error counts as much as a target's, so that a difference has half the weight.
        """
        columns = torch.tensor([_POINTS[name] for name, _ in arms])
        seen = self.xyz[:, columns] - self.places[pivot][:, None]
        weight = self.weight[:, columns] / 2
        arm = torch.stack([arm for _, arm in arms], 1)
        return _nearest_rotation((weight[..., None] * seen).mT @ arm + pull * mean)


def _nearest_rotation(moment: Tensor) -> Tensor:
    """The rotations R (B, 3, 3) of largest tr(Rᵀ M)."""
    U, _, Vt = torch.linalg.svd(moment)
    flip = torch.ones_like(moment[:, 0])
    flip[:, 2] = torch.linalg.det(U @ Vt).sign()
    return (U * flip[:, None]) @ Vt


def _rest_points(model: BodyModel) -> tuple[Tensor, Tensor]:
    """(49, 3) BODY_25's and SMPL's joints in the T-pose, and what the betas add: (10, 49 x 3); float64."""
    model = model.to(torch.float64)
    rest = BodyParameters.zeros(1, torch.float64)
    keypoints, jacobian = model.keypoints_with_jacobian(rest)
    arrays = model.arrays
    joint_shapes = np.einsum("jv,vxn->jxn", arrays.joint_regressor, arrays.shapes, optimize=True)
    shapes = torch.cat((jacobian[0, ..., :10], torch.from_numpy(joint_shapes)))
    return torch.cat((keypoints[0], model.joints(rest)[0])), shapes.permute(2, 0, 1).flatten(1)
