"""The surfaces of a result's bodies."""

from typing import TYPE_CHECKING

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Real, Whole
from shapepose_fg.core.reconstruction import BODY, Reconstruction, Status, with_body

if TYPE_CHECKING:
    from shapepose_fg.body.model.body_model import BodyModel


def surfaces(people: Reconstruction, body: "BodyModel") -> tuple[Array, Index]:
    """Vertices (P, Nv, 3), metres, of the rows with a body, and the indices (P,) of these rows."""
    from shapepose_fg.body.model.body_model import BodyParameters

    columns = [getattr(people, name) for name in BODY]
    rows = np.flatnonzero((people.status == str(Status.OK)) & with_body(*columns))
    if len(rows) == 0:
        return np.zeros((0, body.num_vertices, 3)), rows
    return body.vertices(BodyParameters(*(column[rows] for column in columns))), rows


def joined(vertices: Real, faces: Whole) -> tuple[Array, Index]:
    """Merge bodies (P, Nv, 3) with common `faces` (F, 3) to one mesh: vertices (P Nv, 3) and faces
    (P F, 3).
    """
    people, count = vertices.shape[:2]
    every = faces[None] + count * np.arange(people)[:, None, None]
    return vertices.reshape(people * count, 3).astype(np.float64), every.reshape(
        people * len(faces), 3
    )
