"""The settings of body fitting."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, get_args

from annotated_types import Interval

from shapepose_fg.core.bounds import Factor, Metres, RepeatsOrNone, Seconds, Settings

Method = Literal["auto", "learned", "plain"]
_ONE_TABLE = (
    "is one with [body] now, which has model_sigma_m, kernel_scale, polish_steps, unfinished, gap_s and"
    " correlation_s (lasting_s before); its other settings are constants"
)


@dataclass(frozen=True)
class BodyConfig(Settings):
    """How bodies are fitted."""

    method: str = "auto"
    """"learned": learned gradient descent; "plain": Levenberg-Marquardt; "auto": learned where the weights are for
    the body at hand, plain on any other body."""
    weights: str = ""
    """File of the network's weights (scripts/train_fitter.py); empty: those that come with the package."""
    model_sigma_m: Metres = 0.02
    """How far the detector's joints lie from the body's, metres: added to every target's covariance."""
    kernel_scale: Factor = 6.0
    """Mahalanobis distance at which the Geman-McClure kernel has cut a joint's weight to a quarter."""
    polish_steps: RepeatsOrNone = 1
    """Gauss-Newton steps after the network's, held by the pose prior around where the network arrived. On
    validation subjects the first takes clean joints from 5.2 to 2.6 mm; a second changes nothing."""
    unfinished: Factor = 30.0
    """Rows that the network leaves so that another step would lower their energy by more are fitted by the plain
    optimiser: some in a hundred whose joints contradict each other, such as those of two people."""
    gap_s: Seconds = 1.0
    """Bodies over time: rows of a person that are farther apart are not linked."""
    correlation_s: Annotated[float, Interval(gt=0, le=3600)] = 1.5
    """Bodies over time: how long errors of targets stay correlated, seconds; rows within that time tell of the
    shape as one. On real detections of a static camera the correlation is 0.83 after 0.04 s, 0.63 after 0.2 s and
    0.40 after 1 s."""

    replaced: ClassVar[dict[str, str]] = {"learned": _ONE_TABLE, "plain": _ONE_TABLE}
    """Settings of before, and what took their place."""

    @classmethod
    def paper(cls) -> "BodyConfig":
        """As written in Eq. 6: the network's steps, and nothing after them."""
        return cls(polish_steps=0, unfinished=1e6)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.method not in get_args(Method):
            raise ValueError(f"method must be one of {' '.join(get_args(Method))}, got {self.method!r}")
