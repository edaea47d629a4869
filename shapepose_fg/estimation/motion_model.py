"""How joints move, and how long the errors of what is known of them last: measured numbers, read from a file."""

from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np

from factors import CONSTANT_VELOCITY, MEASURED_S, Motion
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.bounds import Factor, Seconds, Settings
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import read_json

FORMAT = "shapepose-fg motion model 1"
GAP_S = 0.4
"""Length of the gaps across which densities of hidden joints were measured, seconds."""
LOST_M = 0.1
"""A joint whose views leave it less certain than this in some direction, metres, is lost from sight."""


@dataclass(frozen=True)
class MotionConfig(Settings):
    """How the frames of a person are solved together."""

    model: str = ""
    """File of the motion model, with the entries of `estimation/data/motion.json`; empty: that one."""
    psd_scale: Factor = 1.0
    """Multiplies the power spectral densities of the joints' accelerations: more follows faster and smooths
    less."""
    around_s: Seconds = 0.5
    """In frames where a joint is lost from sight (`LOST_M`), and so far around them, seconds, the difference
    between joint and body is followed (`factors.motion`)."""
    contact: bool = True
    """Whether feet that stand stay where they are from frame to frame (`estimation.contact`)."""
    floor: bool = True
    """Whether a floor is sought under the feet that stand; where one is found, bodies over time stay above it."""
    keep_limbs: bool = True
    """Whether joints that no view saw go to where a body can have them, and limbs with an open end get the body's
    length: motion carries each joint by itself."""


@dataclass(frozen=True)
class Lasting:
    """How the error of a message about a joint goes on from frame to frame."""

    white_share: float
    """Share of its variance that is new in every frame, between 0 and 1."""
    correlation_s: float
    """The rest has the autocorrelation exp(-t / this)."""
    kept: float = 0.0
    """How much of the first share motion leaves in, because it lasts for a few frames after all, 0 to 1."""

    @property
    def possible(self) -> bool:
        """Whether these numbers are within their bounds, and finite."""
        return 0 < self.white_share < 1 and 0 < self.correlation_s < np.inf and 0 <= self.kept <= 1


@dataclass(frozen=True)
class MotionModel:
    """The numbers of a window's motion factors for J joints."""

    psd_still: Array
    """(J,) power spectral density of the acceleration of a joint that hardly moves, m²/s³, per axis."""
    psd_speed: Array
    """(J,) what is added to it for each (m/s)² of the joint's speed: fast joints turn faster, too."""
    psd_lost: Array
    """(J,) what it is at least while a joint is lost from sight, and its speed unknown: the mean over all
    speeds."""
    views: Lasting
    """What the views of one frame say of a joint, taken together."""
    body: Lasting
    """What the body says of a joint without the joint's own views."""
    around_s: float = 0.5
    """How long before and after a joint is lost from sight the difference between joint and body is followed."""
    law: Motion = CONSTANT_VELOCITY
    """How a state goes on."""

    def density(self, speed_m_s: Array, within_s: float = MEASURED_S, turning: Array | float = 0.0) -> Array:
        """Density (..., J) of the noise in the motion of joints of this speed (..., J), m/s, whose accelerations
        have a power spectral density of at least `turning` (..., J), m²/s³; see `Motion.density`.
        """
        return self.law.density(np.maximum(self.acceleration(speed_m_s), turning), within_s)

    def acceleration(self, speed_m_s: Array) -> Array:
        """Power spectral density (..., J) of the accelerations of joints of this speed (..., J), m²/s³."""
        return self.psd_still + self.psd_speed * np.asarray(speed_m_s) ** 2

    def density_lost(self, speed_m_s: Array) -> Array:
        """Density (..., J) while joints are lost from sight, and their speed is a guess."""
        return np.maximum(self.density(speed_m_s, GAP_S), self.law.density(self.psd_lost, GAP_S))

    @classmethod
    def load(
        cls, joints: tuple[str, ...], config: MotionConfig | None = None, law: Motion = CONSTANT_VELOCITY
    ) -> "MotionModel":
        """The numbers of the configuration's file for the `joints` of a detector, as the `law` has them.

        A joint that the file does not name moves as the mean of those that it does. InputError for a file that is
        not a motion model.
        """
        config = MotionConfig() if config is None else config
        if config.model:
            return cls._read(Path(config.model), joints, config, law)
        with as_file(files("shapepose_fg.estimation") / "data" / "motion.json") as path:
            return cls._read(path, joints, config, law)

    @classmethod
    def _read(cls, path: Path, joints: tuple[str, ...], config: MotionConfig, law: Motion) -> "MotionModel":
        data = read_json(path)
        try:
            if data["format"] != FORMAT:
                raise KeyError("format")
            known = {name: tuple(map(float, numbers)) for name, numbers in data["joints"].items()}
            if any(len(numbers) != 3 for numbers in known.values()):
                raise ValueError("a joint must have 3 densities")
            views, body = (
                Lasting(*(float(data[name][key]) for key in ("white_share", "correlation_s", "kept")))
                for name in ("views", "body")
            )
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise InputError(
                f"{path}: this is not a motion model ({error}); give the entries of estimation/data/motion.json"
            ) from None
        table = np.array(list(known.values())).reshape(-1, 3)
        if len(table) == 0 or not (np.isfinite(table).all() and (table[:, 0] > 0).all() and (table >= 0).all()):
            raise InputError(
                f"{path}: densities must be positive; give the entries of estimation/data/motion.json"
            )
        if not (views.possible and body.possible):
            raise InputError(
                f"{path}: for views and body, white_share must be between 0 and 1, correlation_s positive and"
                " kept 0 to 1; give the entries of estimation/data/motion.json"
            )
        chosen = config.psd_scale * np.array([known.get(name, tuple(table.mean(axis=0))) for name in joints])
        still, speed, lost = np.ascontiguousarray(chosen.T)
        return cls(still, speed, lost, views, body, config.around_s, law)
