"""Settings of the pipeline, and those of the paper; constants of the steps are next to
their code.
"""

from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Literal, TypeVar

from annotated_types import Interval

from factors import MOTIONS, Motion
from shapepose_fg.body.fitting.fitters import BodyConfig
from shapepose_fg.core.bounds import (
    Count,
    Factor,
    Metres,
    Repeats,
    RepeatsOrNone,
    Seconds,
    Settings,
    Share,
)
from shapepose_fg.estimation.detector_offsets import OffsetConfig
from shapepose_fg.estimation.estimator_config import (
    EstimatorConfig,
    RefineConfig,
    WindowGraphConfig,
)
from shapepose_fg.estimation.gated_views import ObservationConfig
from shapepose_fg.estimation.motion_densities import MotionConfig
from shapepose_fg.proposal.candidates import CandidateConfig
from shapepose_fg.proposal.proposals import ProposalConfig
from shapepose_fg.tracking.identities import FollowingConfig
from shapepose_fg.tracking.stitching import StitchingConfig
from shapepose_fg.tracking.tracker import TrackingConfig


@dataclass(frozen=True)
class PeopleConfig(Settings):
    """Settings of the search for people, and of the time for which a person is tracked without
    detections.
    """

    gate_m: Metres = 0.07
    """Largest reprojection error of a point of two views, as a length at its depth, m: over three
    times the 2 cm of a detector's error. Increase it if calibration errors exceed a pixel or
    two."""
    most_pairs: Annotated[int, Interval(ge=1000, le=1_000_000)] = 150_000
    """Maximum number of pairs of detections of one joint in a frame; beyond it, each view keeps its
    most confident detections (18 a view for 30 cameras, 47 for 12, 122 for 5). Increase it for
    denser crowds, decrease it for detectors with many false positives: time and memory grow with
    it."""
    min_probability: Share = 0.3
    """Minimum probability of a new person. A lower value finds people who are hardly visible, a
    higher one leaves out more false positives; over time, 0.5 and 0.3 gave F1 95.2 and 95.7 with
    three and four cameras."""
    min_new_joints: Count = 4
    """Minimum number of core joints (trunk, arms, legs) that two views must see for a new person
    over time; decrease it where furniture hides people. Frame by frame three are enough, because
    evidence decides."""
    patience_s: Seconds = 0.5
    """Time without evidence after which a track ends, s. Increase it for people who are often
    hidden; a person who comes back later is re-identified by `stitching`."""


@dataclass(frozen=True)
class WindowConfig(Settings):
    """How frames are divided into windows."""

    overlap_s: Annotated[float, Interval(ge=0, le=60)] = 0.4
    """Duration of the frames before and after a window that are solved with it but not returned, s;
    smoothing reaches a few frames. Windows of other lengths move joints by under 2 mm in the median
    (tests/pipeline/test_windows.py)."""
    keyframe_s: Annotated[float, Interval(ge=0, le=0.5)] = 0.0
    """Maximum time between keyframes, s; 0: every frame is one. People are tracked and solved in
    keyframes, and interpolated by the motion model between them, where detections are used only if
    a joint deviates from its curve by 3 cm. Errors of detectors last longer than a frame, so that
    little is lost. New people are searched for in keyframes that are 0.3 s or more apart."""
    again_over_time: RepeatsOrNone = 8
    """Rounds of reassociation around the initial estimate of a window, at most; they end when
    hardly any detection changes. Fewer rounds are faster; with 3, crowds with three cameras lose
    one to two points of F1."""
    again_alone: RepeatsOrNone = 5
    """Rounds of reassociation of a single frame, at most; 0 for none, as in the paper. Each round
    demands a higher probability of people (`LEAST_PROBABILITY`): those that are removed leave their
    detections to others, so the least probable is removed first. Fewer rounds are faster."""

    @property
    def shared_s(self) -> float:
        """Overlap of windows, s; at least the interval between keyframes."""
        return max(self.overlap_s, self.keyframe_s)


@dataclass(frozen=True)
class SolvingConfig(Settings):
    """The weight of the body, the motion model, and how bodies and joints alternate where they do
    (Algorithm 1).
    """

    alternations: Repeats = 3
    """N of Algorithm 1: maximum number of times that the body is fitted and the joints are solved.
    Used by the paper's preset, where it is 10, and by fitters without a body model."""
    weight_shape: Factor = 1.0
    """w_shape of Eq. 5, a factor on the squared distances to the body model: decrease it for people
    whom the model does not fit, in wide clothes or with a load."""
    motion: str = "constant velocity"
    """Motion model of joints, a name in `factors.MOTIONS`: "constant velocity" (white noise on
    acceleration), or "constant acceleration" (on jerk)."""

    replaced: ClassVar[dict[str, str]] = {
        "window_alternations": "was removed: over time bodies and joints are one problem"
    }
    """Settings of earlier versions, and their replacements."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.motion not in MOTIONS:
            raise ValueError(f"motion must be one of {', '.join(MOTIONS)}, got {self.motion}")


Rules = TypeVar("Rules", CandidateConfig, ProposalConfig, WindowGraphConfig, RefineConfig)
_CONSTANT = "is not a table any more: its settings are constants now"


@dataclass(frozen=True)
class PipelineConfig(Settings):
    """The settings of every step, and the size of batches."""

    method: Literal["default", "paper"] = "default"
    """"paper": the steps of section 3 of the paper. `PipelineConfig.paper()` and `config --preset
    paper` also set its parameters."""
    people: PeopleConfig = field(default_factory=PeopleConfig)
    """Stage I and tracking: the search for people."""
    observations: ObservationConfig = field(default_factory=ObservationConfig)
    """Accuracy of 2D observations, as measured for OpenPose: for a detector with twice its errors
    double `sigma_m`."""
    following: FollowingConfig = field(default_factory=FollowingConfig)
    """Tracking: how long tracks live."""
    stitching: StitchingConfig = field(default_factory=StitchingConfig)
    """Tracking: re-identification after a longer time out of sight."""
    windows: WindowConfig = field(default_factory=WindowConfig)
    """Windows of frames, and rounds of reassociation."""
    solving: SolvingConfig = field(default_factory=SolvingConfig)
    """Stage II: bodies and joints."""
    motion: MotionConfig = field(default_factory=MotionConfig)
    """Stage II: motion between frames."""
    body: BodyConfig = field(default_factory=BodyConfig)
    """Stage II: how bodies are fitted."""
    offsets: OffsetConfig = field(default_factory=OffsetConfig)
    """Stage II: offsets of the detector's joints from the body's, and the detector's errors."""
    temporal: bool = True
    """Whether people are tracked over time: identities, motion, one shape a person. If not, every
    frame is independent."""
    batch_frames: Annotated[int, Interval(ge=1, le=10000)] = 128
    """Number of frames that are solved together and returned: bodies are fitted fastest by the
    hundred. Fewer need less memory."""

    replaced: ClassVar[dict[str, str]] = {
        "threads": "was removed: bodies are fitted by one thread",
        "candidates": f"{_CONSTANT}; gate_m and most_pairs are in [people]",
        "proposals": (
            f"{_CONSTANT}; min_probability is in [people], and method chooses between evidence "
            "and hips"
        ),
        "association": _CONSTANT,
        "tracking": f"{_CONSTANT}; min_new_joints and patience_s are in [people]",
        "window_graph": f"{_CONSTANT}; weight_shape is in [solving]",
        "refine": f"{_CONSTANT}; alternations is in [solving]",
    }
    """Tables of earlier versions, and their replacements."""

    @classmethod
    def paper(cls) -> "PipelineConfig":
        """The method as section 3 of the paper describes it, without our changes."""
        return cls(
            method="paper",
            people=PeopleConfig(gate_m=CandidateConfig.paper().gate_m, min_new_joints=1),
            observations=ObservationConfig.paper(),
            windows=WindowConfig(again_alone=0),
            solving=SolvingConfig(alternations=RefineConfig.paper().alternations),
            body=BodyConfig.paper(),
            offsets=OffsetConfig(source="none"),
            temporal=False,
        )

    @classmethod
    def fast(cls) -> "PipelineConfig":
        """Keyframes only, eight to ten a second: 0.6 of the time (docs/evaluation/speed.md,
        "Presets").
        """
        return cls(
            windows=WindowConfig(keyframe_s=0.12),
            offsets=OffsetConfig(frames=10),
            batch_frames=288,
        )

    def _rules(self, kind: type[Rules]) -> Rules:
        """The constants of a step: ours, or those of the paper."""
        return kind.paper() if self.method == "paper" else kind()

    @property
    def law(self) -> Motion:
        """The motion model of joints and bodies over time."""
        return MOTIONS[self.solving.motion]

    @property
    def candidates(self) -> CandidateConfig:
        """Settings of stage I (b, c): 3D joint candidates from pairs of views."""
        own = self.people
        return replace(self._rules(CandidateConfig), gate_m=own.gate_m, most_pairs=own.most_pairs)

    @property
    def proposals(self) -> ProposalConfig:
        """Settings of stage I (d, e): people from candidates, and their 2D observations."""
        return replace(self._rules(ProposalConfig), min_probability=self.people.min_probability)

    @property
    def tracking(self) -> TrackingConfig:
        """Settings of tracking from frame to frame."""
        return TrackingConfig(self.people.min_new_joints, self.people.patience_s)

    @property
    def window_graph(self) -> WindowGraphConfig:
        """Settings of the factor graph of a person."""
        return replace(self._rules(WindowGraphConfig), weight_shape=self.solving.weight_shape)

    @property
    def refine(self) -> RefineConfig:
        """Settings of the joint solution of bodies and joints."""
        return replace(self._rules(RefineConfig), alternations=self.solving.alternations)

    @property
    def estimator(self) -> EstimatorConfig:
        """All settings of stage II."""
        return EstimatorConfig(
            self.observations, self.window_graph, self.refine, self.motion, self.law
        )
