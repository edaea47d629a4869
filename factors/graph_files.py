"""Saves a graph and its values as JSON records, loads them as the same native factors, and draws
graphs.

GTSAM's own `serialize` refuses graphs with `TriangulationFactor`, `WnoaMotionFactor` or
`WnoaInterpFactor`, and its archives are not safe for untrusted files. Here a factor is a record of
numbers, in JSON:

    {"kind": "projection", "keys": [5], "data": [uv, K, wTc], "noise": R, "kernel": ["huber", 1.5]}

`noise` is the upper triangular R that whitens the residual, R r; `data` are the arrays that
`_KINDS` lists.
"""

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import gtsam
import numpy as np
from gtsam import noiseModel
from numpy.typing import NDArray

from factors.camera_of import camera_of
from factors.keys import format_key
from factors.linear import linear_factor
from factors.noise import ESTIMATORS, robust
from factors.projection import make_calibration, make_camera

Array = NDArray[np.float64]

FORMAT = "shapepose-fg graph 1"
_CURE = "give a file that factors.save_graph wrote"


def save_graph(file: str | Path, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
    """Write the factors and values to `file`, JSON. ValueError, naming the factor or variable, for
    types that are not supported: Python functions, linearised factors on poses, constraints.
    """
    writer = _Writer(values)
    factors = [
        writer.record(n, graph.at(n)) for n in range(graph.size()) if graph.at(n) is not None
    ]
    lines = ",\n".join(map(json.dumps, factors))
    text = (
        f'{{"format": "{FORMAT}",\n"factors": [\n{lines}],\n"values": '
        f"{json.dumps(writer.values())}}}\n"
    )
    Path(file).write_text(text, encoding="utf-8")


def load_graph(file: str | Path) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Read a file written by `save_graph`. Files may be untrusted: numbers become factors, and
    nothing is executed. ValueError, one sentence, for any other content.
    """
    try:
        content = json.loads(Path(file).read_text(encoding="utf-8"), parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file}: cannot be read as JSON ({str(error)[:80]}); {_CURE}") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(f'{file}: this is not a file of the format "{FORMAT}"; {_CURE}')
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    place = "values"
    try:
        for name, (shape, insert) in _VALUES.items():
            for key, numbers in content["values"].get(name, []):
                insert(values, _key(key), _array(numbers, shape))
        for n, record in enumerate(content["factors"]):
            place = f"factor {n}"
            graph.push_back(_factor(record))
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RuntimeError) as error:
        problem = (
            f"{error} is missing"
            if isinstance(error, KeyError)
            else str(error).strip().splitlines()[0]
        )
        raise ValueError(f"{file}: {place}: {problem[:120]}; {_CURE}") from None
    return graph, values


def draw_graph(
    graph: gtsam.NonlinearFactorGraph, formatter: Callable[[int], str] = format_key
) -> str:
    """The graph in the language of Graphviz, for `dot -Tsvg`: variables are ellipses; factors are
    boxes, labelled with their kind.
    """
    lines = ["graph {", "  overlap=false; node [fontsize=10];"]
    lines += [f'  v{key} [label="{_quoted(formatter(key))}"];' for key in sorted(graph.keyVector())]
    for n in range(graph.size()):
        factor = graph.at(n)
        if factor is not None:
            name = _name(factor) or type(factor).__name__
            lines.append(
                f'  f{n} [shape=box, style=filled, fillcolor=gray90, label="{_quoted(name)}"];'
            )
            lines += [f"  v{key} -- f{n};" for key in factor.keys()]  # noqa: SIM118
    return "\n".join([*lines, "}\n"])


def _quoted(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"')


@dataclass(frozen=True)
class _Kind:
    """How the factors of one class are written and constructed."""

    of: type
    """The class."""
    keys: int
    """Number of variables of a factor."""
    rows: int
    """Dimension of the residual."""
    data: dict[str, tuple[int, ...]]
    """Name and shape of each data array."""
    make: Callable[..., gtsam.NonlinearFactor]
    """Constructs a factor from keys, arrays and noise model."""


def _triangulation(
    keys: list[int], uv: Array, K: Array, wTc: Array, noise: Any
) -> gtsam.NonlinearFactor:
    return gtsam.TriangulationFactorCal3_S2(make_camera(K, _pose(wTc).matrix()), uv, noise, keys[0])


def _posed(keys: list[int], uv: Array, K: Array, bTc: Array, noise: Any) -> gtsam.NonlinearFactor:
    pose, joint = keys
    return gtsam.GenericProjectionFactorCal3_S2(
        uv, noise, pose, joint, make_calibration(K), _pose(bTc)
    )


def _motion(keys: list[int], dt: Array, density: Array, noise: Any) -> gtsam.NonlinearFactor:
    del noise  # noise follows from the other arguments
    if not (dt > 0 and (density > 0).all()):
        raise ValueError("time and densities must be positive")
    x, v, x_after, v_after = keys
    before, after = gtsam.StateData(x, v, 0.0), gtsam.StateData(x_after, v_after, float(dt))
    return gtsam.WnoaMotionFactorPoint3(before, after, density)


def _plain(of: Any) -> Callable[..., gtsam.NonlinearFactor]:
    """Constructor of factors with a single measurement: a number, a point or a pose."""

    def make(keys: list[int], measured: Array, noise: Any) -> gtsam.NonlinearFactor:
        value: Any = _pose(measured) if measured.shape == (4, 4) else measured
        return of(*keys, float(value) if measured.ndim == 0 else value, noise)

    return make


_SEEN = {"uv": (2,), "K": (3, 3), "pose": (4, 4)}
_KINDS = {
    "projection": _Kind(gtsam.TriangulationFactorCal3_S2, 1, 2, _SEEN, _triangulation),
    "posed projection": _Kind(gtsam.GenericProjectionFactorCal3_S2, 2, 2, _SEEN, _posed),
    "motion": _Kind(gtsam.WnoaMotionFactorPoint3, 4, 6, {"dt": (), "density": (3,)}, _motion),
} | {
    name: _Kind(of, keys, rows, {"measured": shape}, _plain(of))
    for name, of, keys, rows, shape in (
        ("prior point", gtsam.PriorFactorPoint3, 1, 3, (3,)),
        ("prior pose", gtsam.PriorFactorPose3, 1, 6, (4, 4)),
        ("between points", gtsam.BetweenFactorPoint3, 2, 3, (3,)),
        ("between poses", gtsam.BetweenFactorPose3, 2, 6, (4, 4)),
        ("range", gtsam.RangeFactor3, 2, 1, ()),
    )
}
_LINEAR = "linear"
"""Kind of a `LinearContainerFactor` on points and vectors. `data` are A and b of |A x - b|², for
any number of keys and rows; `sizes` are those of the variables where they are not all points."""
_LARGEST_VECTOR = 1000
_VALUES: dict[str, tuple[tuple[int, ...], Callable[[gtsam.Values, int, Array], None]]] = {
    "point": ((3,), lambda values, key, x: values.insert(key, x)),
    "pose": ((4, 4), lambda values, key, T: values.insert(key, _pose(T))),
    "vector": ((-1,), lambda values, key, x: values.insert(key, x)),
}


def _name(factor: Any) -> str | None:
    """Kind of the factor; None if it is not supported."""
    if type(factor) is gtsam.LinearContainerFactor:
        return _LINEAR
    return next((name for name, kind in _KINDS.items() if type(factor) is kind.of), None)


class _Writer:
    """Makes the records of a graph's factors."""

    def __init__(self, values: gtsam.Values) -> None:
        self._values, self._cameras = values, list[gtsam.PinholeCameraCal3_S2]()

    def record(self, number: int, factor: Any) -> dict[str, Any]:
        name = _name(factor)
        try:
            if not all(map(self._values.exists, factor.keys())):
                raise ValueError("has a variable that is not among the values")
            if name is None:
                raise ValueError(
                    "is of a class that cannot be saved; linearise it (gtsam.LinearContainerFactor)"
                )
            found: dict[str, Any] = {"kind": name, "keys": list(factor.keys())}
            if name == _LINEAR:
                return found | _linear_data(factor, self._values)
            found["data"] = [each.tolist() for each in self._data(name, factor)]
            if name != "motion":
                found |= _noise_data(factor.noiseModel())
            for written, read_back in zip(
                *(each.linearize(self._values).jacobian() for each in (factor, _factor(found))),
                strict=True,
            ):
                if not np.abs(written - read_back).max() <= 1e-9 * max(np.abs(written).max(), 1.0):
                    raise ValueError("a file cannot hold it exactly")
        except (ValueError, RuntimeError) as error:
            raise ValueError(f"factor {number}, {type(factor).__name__}: {error}") from None
        return found

    def values(self) -> dict[str, list[Any]]:
        """All variables, grouped by type."""
        found: dict[str, list[Any]] = {name: [] for name in _VALUES}
        for key in self._values.keys():  # noqa: SIM118
            for name, get in (
                ("point", self._values.atPoint3),
                ("pose", self._values.atPose3),
                ("vector", self._values.atVector),
            ):
                try:
                    value: Any = get(key)
                except RuntimeError:
                    continue
                found[name].append([key, (value.matrix() if name == "pose" else value).tolist()])
                break
            else:
                raise ValueError(
                    f"variable {format_key(key)} is no Point3, Pose3 or vector: leave it out"
                )
        return found

    def _data(self, name: str, factor: Any) -> Iterable[Array]:
        if name in ("projection", "posed projection"):
            camera = self._camera(factor, posed=name != "projection")
            return factor.measured(), camera.calibration().K(), camera.pose().matrix()
        if name == "motion":
            at = gtsam.Values()
            for key, x in zip(factor.keys(), (0.0, 1.0, 0.0, 0.0), strict=True):
                at.insert(key, np.full(3, x))
            dt = -np.asarray(factor.unwhitenedError(at))[0]  # r = [x' - x - dt v, v' - v] at v = 1
            return np.array(dt), np.diag(factor.noiseModel().covariance())[3:] / dt
        value = factor.prior() if name.startswith("prior") else factor.measured()
        return [np.asarray(value.matrix() if isinstance(value, gtsam.Pose3) else value)]

    def _camera(self, factor: Any, *, posed: bool) -> gtsam.PinholeCameraCal3_S2:
        """Camera of a projection factor; for a posed one, relative to the pose variable (as if that
        were the identity).
        """
        *pose, key = factor.keys()
        at, uv = gtsam.Values(), factor.measured()
        near = self._values.atPoint3(key)
        if posed:
            at.insert(pose[0], gtsam.Pose3())
            near = self._values.atPose3(pose[0]).transformTo(near)
        at.insert(key, near)

        def pixel(point: Array) -> Array | None:
            at.update(key, point)
            off = np.asarray(factor.unwhitenedError(at))
            return (
                None if off[0] == off[1] else off + uv
            )  # behind the camera the residual is (2 fx, 2 fx)

        points = near + np.array(
            [[0.0, 0, 0], [0.3, 0.1, -0.2], [-0.2, 0.4, 0.1], [0.1, -0.3, 0.5]]
        )
        pixels = [pixel(each) for each in points]
        for n, camera in enumerate(self._cameras):
            if all(
                uv is not None and np.abs(uv - camera.project(each)).max() < 1e-9
                for each, uv in zip(points, pixels, strict=True)
            ):
                self._cameras.insert(0, self._cameras.pop(n))
                return camera
        found = camera_of(pixel, near)
        if found is None:
            raise ValueError("its camera could not be found")
        self._cameras.insert(0, found)
        return found


def _noise_data(model: Any) -> dict[str, Any]:
    """R and kernel of a noise model, for its record."""
    kernel, base = None, model
    if isinstance(model, noiseModel.Robust):
        kernel, base = _kernel_data(model.robust()), cast(Any, model.noise())
    if base is None or base.isConstrained():
        raise ValueError("a constraint has no noise: give it a small sigma")
    return {"noise": base.R().tolist()} | ({"kernel": kernel} if kernel is not None else {})


def _kernel_data(kernel: Any) -> list[Any]:
    """Name and width of a robust kernel. GTSAM exposes the width only in its serialised text, among
    other numbers.
    """
    for name, made in ESTIMATORS.items():
        if type(kernel) is made:
            for word in kernel.serialize().split():
                if "." in word and all(
                    made.Create(float(word)).weight(r) == kernel.weight(r) for r in (0.7, 3, 30)
                ):
                    return [name, float(word)]
    raise ValueError(f"a kernel must be one of {', '.join(ESTIMATORS)}")


def _linear_data(factor: gtsam.LinearContainerFactor, values: gtsam.Values) -> dict[str, Any]:
    """Data of a linear factor on points and vectors, whitened. It is linearised at zero: the result
    is the same at any point.
    """
    origin, keys, sizes = gtsam.Values(), factor.keys(), list[int]()
    for key in keys:
        try:
            sizes.append(len(values.atVector(key)))
        except RuntimeError:  # a point, or what is refused below
            sizes.append(3)
        origin.insert(key, np.zeros(sizes[-1]))
    linear = factor.linearize(origin) if factor.isJacobian() else None
    A, b = (
        linear.jacobian()
        if isinstance(linear, gtsam.JacobianFactor)
        else (np.zeros((0, 0)), np.zeros(0))
    )
    if A.shape[1] != sum(sizes):
        raise ValueError(
            "a linear factor must be a Jacobian on points, because rotations change its point of "
            "linearisation"
        )
    off = factor.error(origin) - (b @ b) / 2
    if abs(off) > 1e-9 * max(b @ b, 1.0):
        raise ValueError(
            "has no point of linearisation, and so no error: create it with factors.linear_factor"
        )
    found: dict[str, Any] = {"data": [A.tolist(), b.tolist()]}
    return found if set(sizes) <= {3} else found | {"sizes": sizes}


def _factor(record: Any) -> gtsam.NonlinearFactor:
    """Make a factor from its record; ValueError, KeyError or TypeError if the record is invalid."""
    kind, keys = _KINDS.get(record["kind"]), [_key(key) for key in record["keys"]]
    if record["kind"] == _LINEAR:
        A, b = record["data"]
        return _linear(keys, A, b, record.get("sizes", [3] * len(keys)))
    if kind is None:
        raise ValueError(
            f"kind must be one of {', '.join(_KINDS)}, {_LINEAR}, got {str(record['kind'])[:40]!r}"
        )
    if len(keys) != kind.keys or len(record["data"]) != len(kind.data):
        raise ValueError(
            f"needs {kind.keys} keys and {len(kind.data)} arrays: {', '.join(kind.data)}"
        )
    arrays = [
        _array(each, shape) for each, shape in zip(record["data"], kind.data.values(), strict=True)
    ]
    noise = None
    if record["kind"] != "motion":
        R = _array(record["noise"], (kind.rows, kind.rows))
        if not (np.diag(R) > 0).all() or np.tril(R, -1).any():
            raise ValueError("noise must be upper triangular with a positive diagonal")
        noise = noiseModel.Gaussian.SqrtInformation(R)
        if "kernel" in record:
            name, width = record["kernel"]
            if name not in ESTIMATORS or not 0 < float(width) < np.inf:
                raise ValueError(
                    f"kernel must be one of {', '.join(ESTIMATORS)}, with a positive width"
                )
            noise = robust(noise, ESTIMATORS[name].Create(float(width)))
    return kind.make(keys, *arrays, noise)


def _linear(keys: list[int], A: Any, b: Any, sizes: Any) -> gtsam.NonlinearFactor:
    rows = len(b)
    if not (rows and keys) or len(set(keys)) < len(keys):
        raise ValueError("must have one row or more, and distinct keys")
    if len(sizes) != len(keys) or not all(
        type(each) is int and 0 < each <= _LARGEST_VECTOR for each in sizes
    ):
        raise ValueError(f"sizes must be one of 1 to {_LARGEST_VECTOR} for each key")
    blocks = np.split(_array(A, (rows, sum(sizes))), np.cumsum(sizes)[:-1], axis=1)
    return linear_factor(keys, blocks, _array(b, (rows,)))


def _key(number: Any) -> int:
    if type(number) is not int or not 0 <= number < 2**64:
        raise ValueError(f"a key must be a whole number of 64 bits, got {str(number)[:40]}")
    return number


def _array(numbers: Any, shape: tuple[int, ...]) -> Array:
    found = np.array(numbers, dtype=np.float64)
    if shape == (-1,):
        shape = (min(found.size, _LARGEST_VECTOR),)
    # Maximum absolute value of a number in a file.
    if found.shape != shape or not (np.abs(found) <= 1e15).all():
        raise ValueError(
            f"numbers must be finite and have the shape {shape}, got the shape {found.shape}"
        )
    return found


def _pose(matrix: Array) -> gtsam.Pose3:
    R = matrix[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or not np.array_equal(matrix[3], [0, 0, 0, 1]):
        raise ValueError("a pose must be a rotation and a translation, with a last row 0 0 0 1")
    return gtsam.Pose3(matrix)


def _refuse(text: str) -> Iterator[None]:
    raise ValueError(f"{text} is not a number")
