"""Pinhole cameras in the world, rigs of cameras, and their views over time."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import PurePath

import numpy as np

from factors.pinhole import project_with_jacobian, to_pixels
from shapepose_fg.core.arrays import Array, Index, Real
from shapepose_fg.core.bounds import Axis as Axis
from shapepose_fg.core.decompositions import is_rotation, nearest_rotation, rigid
from shapepose_fg.core.lens import COEFFICIENTS, Lens, distorted, padded_distortion, undistorted
from shapepose_fg.core.trajectory import MOST_METRES, Carried, Trajectory

_MOST_PIXELS, _MOST_DISTORTION, _LONGEST_NAME = 1_000_000, 1e6, 200
"""Upper bounds of the size of a picture, pixels, of distortion coefficients, and of the length of a
name. Real values are smaller; larger ones would cause overflows."""
HALF_PIXEL = 0.5
"""Distance of a pixel's centre from its edge, px: pixel coordinates are 0 at the centre of the
first pixel, in some formats at its corner."""
LONGEST_READOUT_S = 0.1
"""Longest readout time that is accepted, s: rolling shutters take 5 to 30 ms."""


@dataclass(frozen=True)
class Camera:
    """A calibrated pinhole camera: OpenCV's convention, x right, y down, z forward."""

    name: str
    """The camera's name in the calibration and in the detection files."""
    K: Array
    """(3, 3) intrinsic matrix, pixels."""
    wTc: Array
    """(4, 4) world-from-camera pose, metres."""
    image_size: tuple[int, int]
    """Width and height of the picture, pixels."""
    distortion: Array = field(default_factory=lambda: np.zeros(5))
    """Coefficients in OpenCV's order, zero for a camera without distortion. Perspective: (5,) k1 k2
    p1 p2 k3, or (8,) with k4 k5 k6 of the rational model, (12,) with s1 to s4, (14,) with a tilt.
    Fisheye: (4,) k1 to k4."""
    lens: Lens = "perspective"
    """Lens model of OpenCV to which the coefficients belong."""
    readout_s: float = 0.0
    """Time that a rolling shutter takes from the first row of a picture to the last, s; a picture's
    time is that of its middle row."""
    carrier: str = ""
    """The name of the trajectory that carries the camera; empty for a fixed camera."""
    bTc: Array = field(default_factory=lambda: np.eye(4))
    """(4, 4) carrier-from-camera pose, metres; `wTc` is the pose at the start of the trajectory."""

    def __post_init__(self) -> None:
        def refuse(problem: str) -> ValueError:
            return ValueError(f"camera {self.name}: {problem}")

        if self.lens not in COEFFICIENTS:
            raise refuse(f"lens must be perspective or fisheye, got {self.lens!r}")
        lengths = [(count,) for count in COEFFICIENTS[self.lens]]
        arrays = {"K": ([(3, 3)], _MOST_PIXELS)} | dict.fromkeys(
            ("wTc", "bTc"), ([(4, 4)], MOST_METRES)
        )
        for name, (shapes, most) in (arrays | {"distortion": (lengths, _MOST_DISTORTION)}).items():
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape not in shapes:
                raise refuse(f"{name} must be {' or '.join(map(str, shapes))}, got {value.shape}")
            if not np.isfinite(value).all():
                raise refuse(f"{name} holds a value that is not finite")
            if np.abs(value).max(initial=0.0) > most:
                raise refuse(f"{name} must be at most {most:g}, got {np.abs(value).max():.3g}")
            object.__setattr__(self, name, value)
        if self.K[0, 0] <= 0 or self.K[1, 1] <= 0 or np.any(np.abs(self.K[2] - (0, 0, 1)) > 1e-9):
            raise refuse("K must have positive focal lengths and a last row 0 0 1")
        for name, R in (("wTc", self.wTc[:3, :3]), ("bTc", self.bTc[:3, :3])):
            if not is_rotation(R):
                raise refuse(f"the rotation of {name} must be orthonormal with determinant 1")
        width, height = self.image_size
        if not 0 < min(width, height) <= max(width, height) <= _MOST_PIXELS:
            raise refuse(
                f"image_size must be positive and at most {_MOST_PIXELS}, got {self.image_size}"
            )
        if not 0 <= self.readout_s <= LONGEST_READOUT_S:
            raise refuse(
                f"readout_s must be 0 to {LONGEST_READOUT_S:g} seconds, got {self.readout_s}"
            )
        if not self.name or len(self.name) > _LONGEST_NAME or not self.name.isprintable():
            raise ValueError(
                f"camera {self.name[:40]!r}: names must be 1 to {_LONGEST_NAME} letters, in one "
                "line"
            )
        way = PurePath(self.name)
        if way.is_absolute() or len(way.parts) == 0 or ".." in way.parts:
            raise refuse("the name must not contain a path, because files are named after it")
        object.__setattr__(self, "image_size", (int(width), int(height)))

    @classmethod
    def from_camera_from_world(
        cls,
        name: str,
        K: Array,
        cTw: Array,
        image_size: tuple[int, int],
        distortion: Sequence[float] = (),
        lens: Lens = "perspective",
    ) -> "Camera":
        """Make a camera from a camera-from-world matrix `cTw` (3, 4) or (4, 4): [R | t], metres.

        The rotation is replaced by the nearest orthonormal one, so that rounding in a calibration
        file does not act as a scale. Trailing coefficients may be missing in `distortion`.
        """
        cTw = np.asarray(cTw, dtype=np.float64)
        R = np.asarray(cTw[:3, :3])
        if not (np.isfinite(cTw).all() and is_rotation(R)):
            raise ValueError(
                f"camera {name}: the rotation must be orthonormal with determinant 1, and finite"
            )
        R, coefficients = nearest_rotation(R).T, padded_distortion(distortion, lens)
        wTc = rigid(R, -R @ cTw[:3, 3])
        return cls(name, np.asarray(K, dtype=np.float64), wTc, image_size, coefficients, lens)

    @cached_property
    def cTw(self) -> Array:
        """(3, 4) camera-from-world, [R | t]."""
        R = self.wTc[:3, :3].T
        return np.hstack([R, -R @ self.wTc[:3, 3:]])

    @property
    def centre(self) -> Array:
        """(3,) optical centre in the world, metres."""
        return self.wTc[:3, 3]

    def project(self, points_world: Array) -> tuple[Array, Array]:
        """Project `points_world` (..., 3) to *undistorted* pixels (..., 2) and depths (...,) in
        metres.

        A point that is not in front of the camera (depth <= 0) gets NaN pixels.
        """
        points_camera = points_world @ self.cTw[:, :3].T + self.cTw[:, 3]
        return to_pixels(points_camera, self.K)

    def undistort(self, xy: Array) -> Array:
        """Map measured pixels (N, 2) to the pixels of the same camera without distortion.

        NaN if there is no such pixel: beyond the range in which the distortion polynomial can be
        inverted, or 90 degrees and more from the axis of a fisheye.
        """
        return undistorted(np.asarray(xy, dtype=np.float64), self.K, self.distortion, self.lens)

    def distort(self, xy: Array) -> Array:
        """Map undistorted pixels (N, 2) to distorted pixels, as in the original pictures (inverse
        of `undistort`).
        """
        return distorted(np.asarray(xy, dtype=np.float64), self.K, self.distortion, self.lens)


@dataclass(frozen=True)
class Rig:
    """Cameras in a fixed order, in a common world with a known up axis; metres."""

    cameras: tuple[Camera, ...]
    """The V cameras; a view is an index into them."""
    up: Axis
    """Which axis of the world points up."""
    excluded: tuple[int, ...] = ()
    """Views without a used picture in the frame for which the rig was made; no detections are
    expected there."""
    doubted: tuple[int, ...] = ()
    """Views that contradict each other in the frame for which the rig was made; it is unknown which
    is wrong."""
    trajectories: tuple[Trajectory, ...] = ()
    """Trajectories of the carriers of moving cameras; two cameras on one robot share its
    trajectory."""
    notes: tuple[str, ...] = field(default=(), compare=False)
    """Notes of the reader, a sentence each, on ignored parts of the calibration file and on
    assumptions."""
    unwanted: tuple[str, ...] = field(default=(), compare=False)
    """Names of cameras that `only` left out: their detections are ignored, whereas detections of an
    unknown camera are an error."""

    def __post_init__(self) -> None:
        names = [camera.name for camera in self.cameras]
        if len(names) == 0:
            raise ValueError("a rig must have at least one camera")
        if len(set(names)) != len(names):
            raise ValueError(f"camera names must differ, got {names}")
        if self.up not in ("x", "-x", "y", "-y", "z", "-z"):
            raise ValueError(f"up must be one of x -x y -y z -z, got {self.up!r}")
        known = [each.name for each in self.trajectories]
        for camera in self.cameras:
            if camera.carrier and camera.carrier not in known:
                raise ValueError(
                    f"camera {camera.name}: there is no trajectory {camera.carrier!r}, got {known}"
                )

    def __len__(self) -> int:
        return len(self.cameras)

    def only(self, names: Iterable[str]) -> "Rig":
        """A rig with the cameras of these names, in this rig's order.

        Trajectories that carry none of these cameras are left out. ValueError for an unknown name.
        """
        names = choose(self.names, only=list(names))
        views = [view for view, name in enumerate(self.names) if name in names]
        cameras = tuple(self.cameras[view] for view in views)
        excluded, doubted = (
            tuple(views.index(view) for view in given if view in views)
            for given in (self.excluded, self.doubted)
        )
        carriers = {camera.carrier for camera in cameras}
        trajectories = tuple(each for each in self.trajectories if each.name in carriers)
        unwanted = (*self.unwanted, *(name for name in self.names if name not in names))
        return replace(
            self,
            cameras=cameras,
            excluded=excluded,
            doubted=doubted,
            trajectories=trajectories,
            unwanted=unwanted,
        )

    def at_poses(self, wTc: Array) -> "Rig":
        """The rig with its cameras at world-from-camera poses (V, 4, 4)."""
        cameras = (
            replace(camera, wTc=each) for camera, each in zip(self.cameras, wTc, strict=True)
        )
        return replace(self, cameras=tuple(cameras))

    def without(self, names: Iterable[str]) -> "Rig":
        """A rig with all cameras but those of these names; ValueError for an unknown name."""
        return self.only(choose(self.names, without=list(names)))

    @property
    def moves(self) -> bool:
        """Whether any camera moves, so that poses depend on time (`at`)."""
        return any(camera.carrier for camera in self.cameras)

    @cached_property
    def carrier(self) -> Index:
        """(V,) index of the trajectory of each view; -1 for a fixed camera."""
        known = [each.name for each in self.trajectories]
        return np.array(
            [known.index(each.carrier) if each.carrier else -1 for each in self.cameras], np.intp
        )

    def poses(self, time_s: Array) -> Array:
        """(..., V, 4, 4) world from camera at times (..., V), seconds; outside of a trajectory, its
        nearest pose.
        """
        wTc = np.empty((*time_s.shape, 4, 4))
        for view, (camera, number) in enumerate(
            zip(self.cameras, self.carrier.tolist(), strict=True)
        ):
            still = number < 0
            wTc[..., view, :, :] = (
                camera.wTc
                if still
                else self.trajectories[number].at(time_s[..., view]) @ camera.bTc
            )
        return wTc

    def at(self, time_s: Array) -> "Rig":
        """The rig at times `time_s` (V,), seconds; a rig of fixed cameras is returned unchanged."""
        if not self.moves:
            return self
        cameras = [
            replace(camera, wTc=wTc, carrier="", bTc=np.eye(4)) if camera.carrier else camera
            for camera, wTc in zip(self.cameras, self.poses(time_s), strict=True)
        ]
        return replace(self, cameras=tuple(cameras), trajectories=())

    @property
    def names(self) -> tuple[str, ...]:
        """The cameras' names, in order."""
        return tuple(camera.name for camera in self.cameras)

    @property
    def up_vector(self) -> Array:
        """(3,) unit vector that points up in the world."""
        return np.eye(3)["xyz".index(self.up[-1])] * (-1.0 if self.up.startswith("-") else 1.0)

    @cached_property
    def K(self) -> Array:
        """(V, 3, 3) intrinsic matrices."""
        return np.stack([camera.K for camera in self.cameras])

    @cached_property
    def cTw(self) -> Array:
        """(V, 3, 4) camera-from-world matrices."""
        # This memory order is also that of a copy in another process, so that rounding errors are
        # equal.
        return np.ascontiguousarray(np.stack([camera.cTw for camera in self.cameras]))

    @property
    def wTc(self) -> Array:
        """(V, 4, 4) poses of the cameras, world from camera; a copy."""
        return np.stack([camera.wTc for camera in self.cameras])

    @cached_property
    def centres(self) -> Array:
        """(V, 3) optical centres in the world, metres."""
        return np.stack([camera.centre for camera in self.cameras])

    @cached_property
    def image_sizes(self) -> Array:
        """(V, 2) width and height, pixels; 0 for a view without a picture."""
        sizes = np.array([camera.image_size for camera in self.cameras], dtype=np.float64)
        sizes[list(self.excluded)] = 0.0
        return sizes

    @cached_property
    def focal_px(self) -> Array:
        """(V,) mean of the two focal lengths, pixels."""
        return self.K[:, [0, 1], [0, 1]].mean(axis=1)

    def project(self, points_world: Array) -> tuple[Array, Array]:
        """Project `points_world` (..., 3) into every view: undistorted pixels (V, ..., 2), depths
        (V, ...).

        Pixels are NaN if the depth is not positive.
        """
        shape = points_world.shape[:-1]
        flat = points_world.reshape(-1, 3)
        points_camera = flat @ self.cTw[:, :, :3].transpose(0, 2, 1) + self.cTw[:, None, :, 3]
        xy, depth = to_pixels(points_camera, self.K[:, None])
        return xy.reshape(len(self), *shape, 2), depth.reshape(len(self), *shape)

    def rays(self, view: Index, xy: Array) -> Array:
        """(D, 3) directions of length one, in the world, of undistorted pixels `xy` (D, 2) in views
        `view`.
        """
        camera = np.concatenate([self.normalise(view, xy), np.ones((len(xy), 1))], axis=1)
        world = np.einsum("dji,dj->di", self.cTw[view, :, :3], camera)
        return world / np.linalg.norm(world, axis=1, keepdims=True)

    def normalise(self, view: Index, xy: Array) -> Array:
        """Normalised image coordinates (D, 2) of undistorted pixels `xy` (D, 2) seen in `view`
        (D,).
        """
        K_inverse = np.linalg.inv(self.K)[view]
        return np.einsum("dij,dj->di", K_inverse[:, :2, :2], xy) + K_inverse[:, :2, 2]


def choose(
    known: Sequence[str], only: Sequence[str] | None = None, without: Sequence[str] = ()
) -> list[str]:
    """Select names of cameras: those of `known` that are in `only` (None: all) and not in
    `without`.

    ValueError, which lists the known names, if a name is unknown or no camera remains.
    """
    for name in [*(only or []), *without]:
        if name not in known:
            listed = " ".join(known[:12]) + (
                f" and {len(known) - 12} more" if len(known) > 12 else ""
            )
            raise ValueError(f"there is no camera {name[:80]!r}; there are {listed}")
    chosen = [name for name in known if (only is None or name in only) and name not in without]
    if len(chosen) == 0 and len(known) > 0:
        raise ValueError(f"no camera is selected; give some of {' '.join(known[:12])}")
    return chosen


@dataclass(frozen=True)
class Views:
    """The cameras of N rows (people, frames or both); moving cameras have a pose for each row."""

    K: Array
    """(V, 3, 3) intrinsic matrices, pixels, if they are the same for all rows; otherwise (N, V, 3,
    3)."""
    cTw: Array
    """(V, 3, 4) camera from world, metres, for fixed cameras; otherwise (N, V, 3, 4)."""
    image_sizes: Array | float = np.inf
    """(V, 2) width and height, pixels; infinite if unknown."""
    readout_s: Array | float = 0.0
    """(V,) time from the first row of a picture to the last, seconds."""
    carried: Carried | None = None
    """Poses of the carriers of moving cameras, row by row; None if all cameras are fixed."""

    def __post_init__(self) -> None:
        K, cTw = self.K, self.cTw
        if (
            K.shape[-2:] != (3, 3)
            or cTw.shape[-2:] != (3, 4)
            or K.ndim not in (3, 4)
            or cTw.ndim not in (3, 4)
        ):
            raise ValueError(
                f"K must be ([N,] V, 3, 3) and cTw ([N,] V, 3, 4), got {K.shape} and {cTw.shape}"
            )
        if K.shape[-3] != cTw.shape[-3] or (K.ndim == cTw.ndim == 4 and len(K) != len(cTw)):
            raise ValueError(
                f"K and cTw must have the same rows and views, got {K.shape} and {cTw.shape}"
            )
        if not (np.isfinite(K).all() and np.isfinite(cTw).all()):
            raise ValueError("K or cTw holds a value that is not finite")

    @classmethod
    def of(cls, rig: Rig, time_s: Array | None = None) -> "Views":
        """The cameras of a rig; for moving cameras at `time_s` (N, V), seconds, the times of each
        row's views.

        ValueError if cameras move and no times are given.
        """
        readout_s = np.array([camera.readout_s for camera in rig.cameras])
        if not rig.moves:
            return cls(rig.K, rig.cTw, rig.image_sizes, readout_s)
        if time_s is None:
            raise ValueError("poses of moving cameras depend on time: give time_s, or use `Rig.at`")
        cTw = np.ascontiguousarray(np.linalg.inv(rig.poses(time_s))[..., :3, :], dtype=np.float64)
        carried = Carried.of(rig.trajectories, rig.carrier, time_s.mean(axis=1))
        return cls(rig.K, cTw, rig.image_sizes, readout_s, carried)

    def __len__(self) -> int:
        """V, the number of views."""
        return self.K.shape[-3]

    @property
    def rows_known(self) -> int | None:
        """N if cameras differ from row to row; None if all rows have the same cameras."""
        lengths = [len(array) for array in (self.K, self.cTw) if array.ndim == 4]
        return lengths[0] if lengths else None

    @property
    def focal_px(self) -> Array:
        """(V,) or (N, V) mean of the two focal lengths, pixels."""
        return (self.K[..., 0, 0] + self.K[..., 1, 1]) / 2

    @cached_property
    def projection(self) -> Array:
        """(1, V, 3, 4) or (N, V, 3, 4) projection matrices K [R | t]: they map points to (depth
        times pixels, depth).
        """
        both = self.K @ self.cTw
        return np.ascontiguousarray(both.reshape(-1, *both.shape[-3:]))

    @cached_property
    def focal(self) -> Array:
        """(1, V) or (N, V) focal lengths as in `focal_px`, with the same number of rows as
        `projection`.
        """
        return np.array(np.broadcast_to(self.focal_px, self.projection.shape[:2]), order="C")

    def rows(self, index: Index) -> "Views":
        """The cameras of some of the rows."""
        K, cTw = (array[index] if array.ndim == 4 else array for array in (self.K, self.cTw))
        carried = None if self.carried is None else self.carried.rows(index)
        return Views(K, cTw, self.image_sizes, self.readout_s, carried)

    def pixels(self, points: Array) -> tuple[Array, Array]:
        """Pixels (N, J, V, 2) and depths (N, J, V) of `points` (N, J, 3), as in `project`."""
        P = self.projection.reshape(-1, 3 * len(self), 4)
        ends = (points @ P[..., :3].mT + P[:, None, :, 3]).reshape(*points.shape[:2], len(self), 3)
        depth = ends[..., 2]
        return ends[..., :2] / np.where(depth > 0, depth, np.nan)[..., None], depth

    def project(self, points: Array) -> tuple[Array, Array, Array]:
        """Pixels (N, J, V, 2), depths (N, J, V) and derivatives (N, J, V, 2, 3) of `points` (N, J,
        3), metres.

        Pixels are undistorted. Pixels and derivatives are NaN if the depth is not positive.
        """
        return self.project_apart(points[:, :, None])

    def project_apart(self, points: Array) -> tuple[Array, Array, Array]:
        """Project `points` (N, J, V, 3), metres, with a different point for each view; returns the
        same as `project`.
        """
        K, cTw = (array[:, None] if array.ndim == 4 else array for array in (self.K, self.cTw))
        return project_with_jacobian(points, K, cTw)


def beside_segment(
    x: Real, y: Real, first: Sequence[Real], second: Sequence[Real]
) -> tuple[Real, Real]:
    """Squared distances of pixels (...) from segments (...), squared pixels, and depths of the
    segments' nearest points.

    `first` and `second` are x, y and depth of the segments' ends; all shapes broadcast.
    """
    (x0, y0, z0), (x1, y1, z1) = first, second
    to_x, to_y, dx, dy = x - x0, y - y0, x1 - x0, y1 - y0
    along = np.clip((to_x * dx + to_y * dy) / np.maximum(dx * dx + dy * dy, 1e-6), 0.0, 1.0)
    to_x, to_y = to_x - along * dx, to_y - along * dy
    return to_x * to_x + to_y * to_y, z0 + along * (z1 - z0)
