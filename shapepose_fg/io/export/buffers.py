"""glTF's binary part: arrays one after the other, each described by an accessor."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.io.export.job import optional

_ARRAY, _ELEMENTS = 34962, 34963
"""glTF's targets: what vertices have, and which vertices make triangles."""
_COMPONENTS = {"uint8": 5121, "uint16": 5123, "uint32": 5125, "float32": 5126}
_TYPES = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}


class Buffers:
    """Collects arrays; `accessors`, `views` and `data` go into the file."""

    def __init__(self) -> None:
        self._gltf = optional("pygltflib", "export")
        self.accessors: list[Any] = []
        self.views: list[Any] = []
        self._parts: list[bytes] = []
        self._length = 0

    def vertices(self, values: NDArray[Any], *, bounds: bool = False) -> int:
        """Number of the accessor of a vertex attribute; `bounds` are asked for of positions."""
        return self._add(values, _ARRAY, bounds)

    def indices(self, values: NDArray[Any]) -> int:
        """Number of the accessor of triangles' vertices, flat."""
        return self._add(values, _ELEMENTS, False)

    def values(self, values: NDArray[Any], *, bounds: bool = False) -> int:
        """Number of the accessor of anything else; `bounds` are asked for of an animation's times."""
        return self._add(values, None, bounds)

    @property
    def data(self) -> bytes:
        """All arrays."""
        return b"".join(self._parts)

    def _add(self, values: NDArray[Any], target: int | None, bounds: bool) -> int:
        flat = np.ascontiguousarray(values.mT if values.ndim == 3 else values)  # matrices go column by column
        content = flat.tobytes()
        self.views.append(
            self._gltf.BufferView(buffer=0, byteOffset=self._length, byteLength=len(content), target=target)
        )
        limits = {"min": np.atleast_1d(flat.min(0)).tolist(), "max": np.atleast_1d(flat.max(0)).tolist()}
        self.accessors.append(
            self._gltf.Accessor(
                bufferView=len(self.views) - 1,
                componentType=_COMPONENTS[flat.dtype.name],
                count=len(flat),
                type=_TYPES[values.shape[1:]],
                **(limits if bounds else {}),
            )
        )
        padding = -len(content) % 4  # each array begins at a multiple of 4 bytes
        self._parts.append(content + bytes(padding))
        self._length += len(content) + padding
        return len(self.accessors) - 1
