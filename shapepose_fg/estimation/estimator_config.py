"""The settings of stage II."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from annotated_types import Interval

from factors import CONSTANT_VELOCITY, Motion
from shapepose_fg.core.bounds import Factor, Metres, MetresOrNone, Repeats, Settings, Share
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.linearisation import ObservationConfig
from shapepose_fg.estimation.motion_model import MotionConfig
from shapepose_fg.estimation.noise_law import NoiseLaw


@dataclass(frozen=True)
class WindowGraphConfig(Settings):
    """What goes into a person's graph."""

    rho_3d: Share = 1.0
    """rho_3D of Eq. 4: joints whose mean confidence over all views is at most this are pulled by the body."""
    weight_2d: Factor = 1.0
    """w_2D of Eq. 5, multiplies the squared reprojection errors. With sigmas that are true, both weights are 1."""
    weight_shape: Factor = 1.0
    """w_shape of Eq. 5, multiplies the squared distances to the body model."""
    shape_sigma_m: MetresOrNone = 0.0
    """Positive: the body pulls all joints alike, with this sigma, as in Eq. 3, which has one weight for all. 0:
    with its own covariance, which differs from joint to joint and with direction."""
    max_iterations: Annotated[int, Interval(ge=1, le=1000)] = 20
    """Levenberg-Marquardt steps at the most."""
    tolerance: Factor = 1e-4
    """Relative change of the error at which Levenberg-Marquardt stops."""

    @classmethod
    def paper(cls) -> "WindowGraphConfig":
        """As written in Eqs. 3 to 5. The paper does not say its weights; this one is the best of 1, 3 and 10 cm on
        `tune`.
        """
        return cls(rho_3d=0.25, shape_sigma_m=0.03)


@dataclass(frozen=True)
class RefineConfig(Settings):
    """How the alternation runs."""

    alternations: Repeats = 3
    """N of Algorithm 1: how often the body is fitted and the joints are solved, at the most."""
    window_alternations: Repeats = 1
    """N of Algorithm 1 for windows of several frames, which start from a draft of all joints (`draft`). Windows
    with factors of the user's own take as many as frames alone: these may say what is far from what the views
    said."""
    settled_m: MetresOrNone = 0.002
    """A window whose joints all moved less in a round is done: most frames are after one or two. 0: none is."""
    max_sigma_m: Metres = 0.5
    """A joint whose views leave it less certain than this in some direction is not determined by them."""
    disagreement: Annotated[float, Interval(ge=0, le=1e6)] = 6.0
    """A joint that its views put this many standard deviations from where the body can have it is seen wrongly:
    its gates are decided anew from the body's place, and the body is fitted again. 4 threw away more joints that
    were right than wrong ones, in simulated crowds. 0: nothing is thrown away, as in the paper."""
    complete_start: bool = True
    """Whether frame by frame joints that two views saw and stage I did not place are triangulated for X_0. In the
    paper they are missing until the body puts them somewhere."""
    body_from_views: bool = True
    """Whether the body is fitted to what the views alone say of each joint, and what it says of a joint comes from
    a fit without that joint's own views. In Algorithm 1 it is fitted to X_n, and its joints are the prior."""

    @classmethod
    def paper(cls) -> "RefineConfig":
        """Algorithm 1 as written, with N = 10."""
        return cls(alternations=10, settled_m=0.0, disagreement=0.0, complete_start=False, body_from_views=False)

    @property
    def contradiction(self) -> float:
        """Standard deviations from which on views and body contradict each other; infinite where none do."""
        return self.disagreement if self.disagreement > 0 else np.inf


@dataclass(frozen=True)
class EstimatorConfig:
    """The settings of stage II."""

    observations: ObservationConfig = field(default_factory=ObservationConfig)
    """How far a 2D observation is trusted."""
    graph: WindowGraphConfig = field(default_factory=WindowGraphConfig)
    """What goes into the factor graph of a person."""
    refine: RefineConfig = field(default_factory=RefineConfig)
    """How joints and bodies alternate."""
    motion: MotionConfig = field(default_factory=MotionConfig)
    """How frames hang together."""
    law: Motion = CONSTANT_VELOCITY
    """How joints move."""
    joints: tuple[str, ...] = BODY_25.joints
    """What the detector calls its joints: motion, sigmas and limbs go by them."""
    noise: NoiseLaw = field(default_factory=NoiseLaw.shipped)
    """How far the detector's joints lie from the true ones, for covariances; weights are `observations`'."""
