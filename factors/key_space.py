"""Key ranges for people in a graph of yours: you choose which keys people may use, and no others
are used.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.keys import JointKey

_KINDS = _POSITION, _VELOCITY, _REPORTED = 0, 1, 2
_NAMES = ("position", "velocity", "reported position")


@dataclass(frozen=True)
class KeySpace:
    """Range of keys for people: those of a symbol's character, or a range of integers.

        key = first + ((frame * people + person) * joints + joint) * 3 + kind

    with the kind 0 for a position, 1 for a velocity and 2 for a reported position. Identities are
    increasing numbers; keys use them modulo `people`, which must be at least the number of people
    at one time.
    """

    space: str | range
    """A character, as in `gtsam.symbol("p", 0)`; or a range of integers with step 1."""
    people: int = 1000
    """Largest number of identities with distinct keys."""
    joints: int = 200
    """Largest number of joints of a person."""

    def __post_init__(self) -> None:
        if isinstance(self.space, str):
            if len(self.space) != 1 or not self.space.isascii() or not self.space.isprintable():
                raise ValueError(
                    "space must be one ASCII character, such as 'p', or a range, got "
                    f"{self.space!r}"
                )
        elif self.space.step != 1 or not 0 <= self.space.start <= self.space.stop <= 2**63:
            raise ValueError(
                "space must be a character, or a range of step 1 within 0 to 2^63, got "
                f"{self.space}"
            )
        if self.people < 1 or self.joints < 1:
            raise ValueError(
                f"people and joints must be 1 or more, got {self.people} and {self.joints}"
            )
        if self.frames < 1:
            raise ValueError(
                f"space {self.space} is too small for one frame: give {self._per_frame} keys, or "
                "fewer people or joints"
            )

    @property
    def keys(self) -> range:
        """All keys of the key space."""
        if isinstance(self.space, range):
            return self.space
        first = int(gtsam.symbol(self.space, 0))
        # Number of indices of a symbol's character.
        return range(first, first + 2**56)

    @property
    def frames(self) -> int:
        """Number of frames that have keys: frame numbers are 0 to `frames` - 1."""
        return (self.keys.stop - self.keys.start) // self._per_frame

    def positions(self, person: int, joints: ArrayLike, frames: ArrayLike) -> NDArray[np.int64]:
        """Keys (...) of positions (`Point3`, metres, world); `joints` and `frames` broadcast.
        ValueError for a number out of range.
        """
        return self._pack(_POSITION, person, joints, frames)

    def velocities(self, person: int, joints: ArrayLike, frames: ArrayLike) -> NDArray[np.int64]:
        """Keys (...) of velocities (`Point3`, metres per second, world)."""
        return self._pack(_VELOCITY, person, joints, frames)

    def reported(self, person: int, joints: ArrayLike, frames: ArrayLike) -> NDArray[np.int64]:
        """Keys (...) of reported positions (`Point3`, metres, world), see
        `factors.reported_factor`.
        """
        return self._pack(_REPORTED, person, joints, frames)

    def split(self, key: int) -> JointKey:
        """Decode a key to person, joint, frame and kind; ValueError for a key outside of this key
        space.
        """
        rest, _ = divmod(int(key) - self.keys.start, len(_KINDS))
        if key not in self.keys or rest >= self.frames * self.people * self.joints:
            raise ValueError(
                f"{gtsam.DefaultKeyFormatter(int(key))} is not a key of the space {self.space}"
            )
        rest, joint = divmod(rest, self.joints)
        frame, person = divmod(rest, self.people)
        return JointKey(person, joint, frame)

    def format(self, key: int) -> str:
        """Readable name of any key, for GTSAM's `keyFormatter` arguments."""
        try:
            person, joint, frame = self.split(key)
        except ValueError:
            return gtsam.DefaultKeyFormatter(int(key))
        kind = _NAMES[(int(key) - self.keys.start) % len(_KINDS)]
        return f"{kind}(person {person}, joint {joint}, frame {frame})"

    @property
    def _per_frame(self) -> int:
        return len(_KINDS) * self.people * self.joints

    def _pack(
        self, kind: int, person: int, joints: ArrayLike, frames: ArrayLike
    ) -> NDArray[np.int64]:
        joint, frame = (np.asarray(each, dtype=np.int64) for each in (joints, frames))
        for name, value, count in (("joint", joint, self.joints), ("frame", frame, self.frames)):
            if value.size and not (value.min() >= 0 and value.max() < count):
                raise ValueError(
                    f"{name} must be 0 to {count - 1} in this space, got {value.min()} to "
                    f"{value.max()}; give a larger space"
                )
        row = (frame * self.people + int(person) % self.people) * self.joints + joint
        return self.keys.start + row * len(_KINDS) + kind
