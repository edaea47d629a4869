"""Body shapes of people: means and covariances, for one body model."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.errors import InputError, naming
from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.core.storage.npz import read_npz, write_npz
from shapepose_fg.core.storage.schema import Column, Table

_COLUMNS = ("names", "betas", "information", "body")
_LEAST, _MOST = 1e-6, 1e12
"""Smallest and largest eigenvalue of the information about a shape; the prior over adults has 1."""
_CURE = "give a file that `--shapes` has written"


@dataclass(frozen=True)
class SubjectShapes(Table):
    """Body shapes of G people: for each, a Gaussian over the betas of one body model."""

    names: Annotated[NDArray[np.str_], Column("N", np.str_)]
    """(G,) unique names: identities of a recording as text, or names given by the user."""
    betas: Annotated[Array, Column("N 10")]
    """(G, 10) mean shape, standard deviations."""
    information: Annotated[Array, Column("N 10 10")]
    """(G, 10, 10) inverse covariance of the shape, including the prior over adults."""
    body: str
    """Fingerprint of the body model to which the betas belong
    (`body.fitting.weights.fingerprint`)."""

    def __post_init__(self) -> None:
        """Check shapes and types, that names are unique, betas finite, and information matrices
        positive definite.
        """
        super().__post_init__()
        names = self.names.tolist()
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"names must differ, but {name!r} occurs twice")
        finite = np.isfinite(self.betas).all(axis=1) & np.isfinite(self.information).all(
            axis=(1, 2)
        )
        if not finite.all():
            wrong = names[np.argmin(finite)]
            raise ValueError(
                f"betas and information must be finite, but those of {wrong!r} are not"
            )
        largest = float(np.abs(self.information).max(initial=0.0))
        symmetric = np.allclose(
            self.information, self.information.mT, rtol=0.0, atol=1e-5 * largest
        )
        if not symmetric or (
            len(self) > 0 and (np.linalg.eigvalsh(self.information) < _LEAST).any()
        ):
            raise ValueError(
                "information must be symmetric and positive definite, for each of the people"
            )
        if max(largest, np.abs(self.betas).max(initial=0.0)) > _MOST:
            raise ValueError(f"betas and information must be at most {_MOST:g}")

    @classmethod
    def empty(cls, body: str) -> "SubjectShapes":
        """Shapes of no people."""
        return cls(np.zeros(0, dtype="U1"), np.zeros((0, 10)), np.zeros((0, 10, 10)), body)

    @property
    def covariance(self) -> Array:
        """(G, 10, 10) covariance of each shape."""
        return np.linalg.inv(self.information).astype(np.float64, copy=False)

    def named(self, names: Sequence[str]) -> "SubjectShapes":
        """Return these shapes with other names."""
        return replace(self, names=np.array(list(names), dtype=str))

    def updated(self, other: "SubjectShapes") -> "SubjectShapes":
        """Merge with the shapes in `other`, which replace older ones of the same name.

        Shapes of the same name are not combined, because the newer one was estimated with the older
        one as its prior. ValueError if `other` is of another body model.
        """
        if other.body != self.body:
            raise ValueError("shapes must be of the same body model")
        return SubjectShapes.concatenate([self.rows(~np.isin(self.names, other.names)), other])

    def save(self, file: str | Path) -> None:
        """Write the shapes as `.npz`, atomically (docs/project_files.md)."""
        write_atomically(Path(file), self.write)

    def write(self, stream: BinaryIO) -> None:
        """Write the content of the `.npz` file to a stream."""
        write_npz(stream, {name: np.asarray(getattr(self, name)) for name in _COLUMNS})

    @classmethod
    def load(cls, file: str | Path, body: str) -> "SubjectShapes":
        """Read a file written by `save` for the body model with the fingerprint `body`; InputError
        for any other content.
        """
        file = Path(file)
        columns: Any = read_npz(file, _COLUMNS, _CURE)
        stored_body = columns.get("body", np.zeros(0))
        if stored_body.shape != () or stored_body.dtype.kind != "U" or str(stored_body) != body:
            raise InputError(
                f"{file}: these are shapes of another body model, and betas of one model do not "
                "fit another; give their model with --body, or another file"
            )
        with naming(file, _CURE):
            return cls(columns.get("names"), columns.get("betas"), columns.get("information"), body)
