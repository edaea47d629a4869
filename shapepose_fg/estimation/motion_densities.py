"""Motion of joints: measured values, read from a file."""

from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import ClassVar

import numpy as np

from factors import CONSTANT_VELOCITY, MEASURED_S, Motion
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.bounds import Factor, Settings
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import read_json
from shapepose_fg.estimation.in_time import motion_of

FORMAT = "shapepose-fg motion model 1"


@dataclass(frozen=True)
class MotionConfig(Settings):
    """Settings of the motion model, and of the constraints of feet and floor."""

    model: str = ""
    """File of the motion model, with the entries of `estimation/data/motion.json`; empty: that
    one."""
    psd_scale: Factor = 1.0
    """Factor on the power spectral densities of the joints' accelerations: larger values follow
    faster and smooth less."""
    contact: bool = True
    """Whether standing feet are constrained to stay in place between frames
    (`estimation.contact`)."""
    floor: bool = True
    """Whether to search for a floor under standing feet; bodies over time then stay above it."""

    replaced: ClassVar[dict[str, str]] = {
        name: "was removed: over time bodies and joints are one problem"
        for name in ("around_s", "keep_limbs")
    }
    """Settings of earlier versions, and their replacements."""


@dataclass(frozen=True)
class MotionModel:
    """Parameters of the motion of J joints."""

    psd_still: Array
    """(J,) power spectral density of the acceleration of a joint nearly at rest, m²/s³,
    per axis."""
    psd_speed: Array
    """(J,) increase of the power spectral density per (m/s)² of the joint's speed: fast joints also
    accelerate more."""
    psd_lost: Array
    """(J,) minimum of the power spectral density while a joint is lost. Its speed is then unknown,
    so the minimum is the mean over all speeds."""
    law: Motion = CONSTANT_VELOCITY
    """Motion model of the states."""

    def density(
        self, speed_m_s: Array, within_s: float = MEASURED_S, turning: Array | float = 0.0
    ) -> Array:
        """Density (..., J) of the motion noise of joints with speed (..., J), m/s, and a power
        spectral density of accelerations of at least `turning` (..., J), m²/s³; see
        `Motion.density`.
        """
        return self.law.density(np.maximum(self.acceleration(speed_m_s), turning), within_s)

    def acceleration(self, speed_m_s: Array) -> Array:
        """Power spectral density (..., J) of the accelerations of joints with this speed (..., J),
        m²/s³.
        """
        return self.psd_still + self.psd_speed * np.asarray(speed_m_s) ** 2

    def faster(self, points: Array, variance: Array, times_s: Array) -> Array:
        """(T - 1, J) ratio of the power spectral density of the accelerations of points (T, J, 3),
        metres, in each step to its mean over all speeds, at least 1; arguments as
        `in_time.motion_of`.
        """
        speed, turning = motion_of(points, variance, times_s)
        return np.maximum(np.maximum(self.acceleration(speed), turning) / self.psd_lost, 1.0)

    @classmethod
    def load(
        cls,
        joints: tuple[str, ...],
        config: MotionConfig | None = None,
        law: Motion = CONSTANT_VELOCITY,
    ) -> "MotionModel":
        """Read the parameters from the configuration's file for the `joints` of a detector and the
        motion model `law`.

        Joints missing from the file get the mean of the others. Raises InputError if the file is
        not a motion model.
        """
        config = MotionConfig() if config is None else config
        if config.model:
            return cls._read(Path(config.model), joints, config, law)
        with as_file(files("shapepose_fg.estimation") / "data" / "motion.json") as path:
            return cls._read(path, joints, config, law)

    @classmethod
    def _read(
        cls, path: Path, joints: tuple[str, ...], config: MotionConfig, law: Motion
    ) -> "MotionModel":
        data = read_json(path)
        try:
            if data["format"] != FORMAT:
                raise KeyError("format")
            known = {name: tuple(map(float, numbers)) for name, numbers in data["joints"].items()}
            if any(len(numbers) != 3 for numbers in known.values()):
                raise ValueError("a joint must have 3 densities")
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise InputError(
                f"{path}: this is not a motion model ({error}); give the entries of "
                "estimation/data/motion.json"
            ) from None
        table = np.array(list(known.values())).reshape(-1, 3)
        if len(table) == 0 or not (
            np.isfinite(table).all() and (table[:, 0] > 0).all() and (table >= 0).all()
        ):
            raise InputError(
                f"{path}: densities must be positive; give the entries of "
                "estimation/data/motion.json"
            )
        chosen = config.psd_scale * np.array(
            [known.get(name, tuple(table.mean(axis=0))) for name in joints]
        )
        still, speed, lost = np.ascontiguousarray(chosen.T)
        return cls(still, speed, lost, law)
