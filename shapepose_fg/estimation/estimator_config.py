"""Settings of stage II."""

from dataclasses import dataclass, field
from typing import Annotated

from annotated_types import Interval

from factors import CONSTANT_VELOCITY, Motion
from shapepose_fg.core.bounds import Factor, Metres, MetresOrNone, Repeats, Settings, Share
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.gated_views import ObservationConfig
from shapepose_fg.estimation.motion_densities import MotionConfig
from shapepose_fg.estimation.noise_law import NoiseLaw


@dataclass(frozen=True)
class WindowGraphConfig(Settings):
    """Settings of a person's graph."""

    rho_3d: Share = 1.0
    """rho_3D of Eq. 4: joints with at most this mean confidence over all views are constrained by
    the body."""
    weight_2d: Factor = 1.0
    """w_2D of Eq. 5, multiplies the squared reprojection errors. With correct sigmas both weights
    are 1."""
    weight_shape: Factor = 1.0
    """w_shape of Eq. 5, multiplies the squared distances to the body model."""
    shape_sigma_m: MetresOrNone = 0.0
    """Positive: common standard deviation of the body's constraint on all joints, as in Eq. 3 with
    its single weight, m. 0: the body's own covariance, which differs by joint and direction."""
    max_iterations: Annotated[int, Interval(ge=1, le=1000)] = 20
    """Maximum number of Levenberg-Marquardt steps."""
    tolerance: Factor = 1e-4
    """Relative change of the error at which Levenberg-Marquardt stops."""

    @classmethod
    def paper(cls) -> "WindowGraphConfig":
        """The settings of Eqs. 3 to 5. The paper does not give its weights; this one is the best of
        1, 3 and 10 cm on `tune`.
        """
        return cls(rho_3d=0.25, shape_sigma_m=0.03)


@dataclass(frozen=True)
class RefineConfig(Settings):
    """Whether bodies and joints alternate (Algorithm 1), and when that ends."""

    alternations: Repeats = 3
    """N of Algorithm 1: maximum number of body fits and joint solutions."""
    settled_m: MetresOrNone = 0.002
    """Motion of joints in a round below which the alternation ends, m; 0: it makes all rounds."""
    max_sigma_m: Metres = 0.5
    """Maximum standard deviation of a joint determined by its views, in the worst direction, m."""
    with_body: bool = True
    """Whether joints and bodies are solved as one problem (`body_window.BodyWindow`), from an
    initial estimate X_0 of all joints. In the paper bodies and joints are solved in turn, and
    joints that stage I does not find are missing until the body gives them a position."""

    @classmethod
    def paper(cls) -> "RefineConfig":
        """Algorithm 1 as written, with N = 10."""
        return cls(alternations=10, settled_m=0.0, with_body=False)


@dataclass(frozen=True)
class EstimatorConfig:
    """All settings of stage II."""

    observations: ObservationConfig = field(default_factory=ObservationConfig)
    """Noise model of 2D observations."""
    graph: WindowGraphConfig = field(default_factory=WindowGraphConfig)
    """Settings of the factor graph of a person."""
    refine: RefineConfig = field(default_factory=RefineConfig)
    """How bodies and joints are solved together."""
    motion: MotionConfig = field(default_factory=MotionConfig)
    """Settings of the links between frames."""
    law: Motion = CONSTANT_VELOCITY
    """Motion model of the joints."""
    joints: tuple[str, ...] = BODY_25.joints
    """Names of the detector's joints, for motion, sigmas and limbs."""
    noise: NoiseLaw = field(default_factory=NoiseLaw.shipped)
    """The detector's noise law, by which the standard deviations of `observations` are multiplied,
    except in Algorithm 1."""
