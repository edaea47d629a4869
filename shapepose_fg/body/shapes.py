"""Known people's body shapes, kept from one recording for the next: means, how sure they are, on which body."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from shapepose_fg.body.model.smpl_file import SmplArrays, read_smpl_file
from shapepose_fg.core.columns import checked
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.core.storage.npz_reader import read_npz
from shapepose_fg.core.storage.npz_writer import write_npz

_OPEN_BODY = Path(__file__).with_name("data") / "open_body.npz"
_COLUMNS = ("names", "betas", "information", "body")
_CURE = "give a file that `--shapes` has written"


@dataclass(frozen=True)
class SubjectShapes:
    """The shapes of G people: a Gaussian each over the betas of one body model."""

    names: NDArray[np.str_]
    """(G,) who they are, each once: identities of a recording as text, or names of your own."""
    betas: NDArray[np.float64]
    """(G, 10) mean shape, standard deviations."""
    information: NDArray[np.float64]
    """(G, 10, 10) inverse covariance of that shape, the prior over adults included."""
    body: str
    """Fingerprint of the body model that the betas are of (`body.fitting.weights.fingerprint`)."""

    def __post_init__(self) -> None:
        """Check every shape and type; that names differ; that betas are finite and information is definite."""
        G = np.size(self.names)
        shapes = {"names": ((G,), np.str_), "betas": ((G, 10), np.float64)}
        shapes |= {"information": ((G, 10, 10), np.float64)}
        for name, (shape, dtype) in shapes.items():
            object.__setattr__(self, name, checked(name, getattr(self, name), shape, dtype))
        names = self.names.tolist()
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"names must differ, {twice!r} occurs twice")
        finite = np.isfinite(self.betas).all(axis=1) & np.isfinite(self.information).all(axis=(1, 2))
        if not finite.all():
            raise ValueError(
                f"betas and information must be finite, those of {names[np.argmin(finite)]!r} are not"
            )
        largest = float(np.abs(self.information).max(initial=0.0))
        symmetric = np.allclose(self.information, self.information.mT, rtol=0.0, atol=1e-5 * largest)
        if not symmetric or (G > 0 and (np.linalg.eigvalsh(self.information) <= 0).any()):
            raise ValueError("information must be symmetric and positive definite, for each of the people")

    def __len__(self) -> int:
        return len(self.names)

    @classmethod
    def empty(cls, body: str) -> "SubjectShapes":
        """Nobody is known yet."""
        return cls(np.zeros(0, dtype="U1"), np.zeros((0, 10)), np.zeros((0, 10, 10)), body)

    @property
    def covariance(self) -> NDArray[np.float64]:
        """(G, 10, 10) how uncertain each shape is."""
        return np.linalg.inv(self.information).astype(np.float64, copy=False)

    def rows(self, index: NDArray[Any]) -> "SubjectShapes":
        """Some of the people: a mask (G,) or row numbers."""
        return replace(self, names=self.names[index], betas=self.betas[index], information=self.information[index])

    def named(self, names: Sequence[str]) -> "SubjectShapes":
        """The same people with other names."""
        return replace(self, names=np.array(list(names), dtype=str))

    def updated(self, other: "SubjectShapes") -> "SubjectShapes":
        """These people and those of `other`, whose shapes take the place of older ones of the same name.

        A shape that was estimated with an older one as its prior holds that already: the two are not added up.
        ValueError where `other` is of another body.
        """
        if other.body != self.body:
            raise ValueError("shapes must be of the same body model")
        kept = self.rows(~np.isin(self.names, other.names))
        return SubjectShapes(
            names=np.concatenate([kept.names, other.names]),
            betas=np.concatenate([kept.betas, other.betas]),
            information=np.concatenate([kept.information, other.information]),
            body=self.body,
        )

    def save(self, file: str | Path) -> None:
        """Write the shapes as `.npz`, whole or not at all (docs/conventions.md)."""
        write_atomically(Path(file), self.write)

    def write(self, stream: BinaryIO) -> None:
        """Write the contents of that file."""
        write_npz(stream, {name: np.asarray(getattr(self, name)) for name in _COLUMNS})

    @classmethod
    def load(cls, file: str | Path, body: str) -> "SubjectShapes":
        """Read what `save` wrote, of the model with the fingerprint `body`; InputError on anything else."""
        file = Path(file)
        columns = read_npz(file, _COLUMNS, _CURE)
        for name in _COLUMNS:
            if name not in columns:
                raise InputError(f"{file}: column {name} is missing; {_CURE}")
        whose = columns["body"]
        if whose.shape != () or whose.dtype.kind != "U" or str(whose) != body:
            raise InputError(
                f"{file}: these are shapes of another body model, their betas mean something else on this one;"
                " give --body the model that they were made with, or another file"
            )
        try:
            return cls(columns["names"], columns["betas"], columns["information"], body)
        except ValueError as error:
            raise InputError(f"{file}: {error}; {_CURE}") from None


def recognise(found: SubjectShapes, known: SubjectShapes, ratio: float = 10.0) -> NDArray[np.intp]:
    """(G,) which of the `known` people each of the `found` ones is, by shape alone; -1 for a stranger.

    `found` were estimated from the adults' prior N(0, I). Somebody is recognised where what was seen is
    `ratio` times as likely of a known shape as of any adult's (Bayes factor): by Markov's inequality, at
    most one stranger in ten passes for a given person. Stature is most of what is seen of a shape: on the
    built-in scene, joints known to 3 mm, the factors of the right people were 40 to 410, of wrong ones
    below 1e-4. Two people who are taken for each other differ little in shape. Everybody is one person at
    the most, so that the product of all factors is largest. ValueError where the two are of different
    bodies.
    """
    if found.body != known.body:
        raise ValueError("shapes must be of the same body model")
    whose = np.full(len(found), -1, dtype=np.intp)
    if len(found) == 0 or len(known) == 0:
        return whose
    eye = np.eye(found.betas.shape[1])
    seen = found.information - eye  # what the recording added to the prior
    gradient = np.einsum("gij,gj->gi", found.information, found.betas)
    factor = _log_evidence(seen, gradient, known.betas, known.information)
    factor -= _log_evidence(seen, gradient, np.zeros((1, len(eye))), eye[None])
    gain = np.maximum(factor - np.log(ratio), 0.0)
    rows, columns = linear_sum_assignment(gain, maximize=True)
    kept = gain[rows, columns] > 0
    whose[rows[kept]] = columns[kept]
    return whose


def _log_evidence(
    seen: NDArray[np.float64],
    gradient: NDArray[np.float64],
    mean: NDArray[np.float64],
    information: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(G, K) log of how likely observations are under each of K priors, up to a constant of each observation.

    `seen` (G, 10, 10) and `gradient` (G, 10) are information and information times mean of what was seen alone,
    which may be singular; the priors are `mean` (K, 10), `information` (K, 10, 10).
    """
    total = seen[:, None] + information[None]
    pulled = np.einsum("kij,kj->ki", information, mean)
    right = gradient[:, None] + pulled[None]
    fitted = np.einsum("gki,gki->gk", right, np.linalg.solve(total, right[..., None])[..., 0])
    volume = np.linalg.slogdet(information)[1] - np.linalg.slogdet(total)[1]
    return 0.5 * (volume - np.einsum("ki,ki->k", pulled, mean) + fitted)


def statures_m(betas: NDArray[np.float64], body: SmplArrays) -> NDArray[np.float64]:
    """(G,) how tall bodies with `betas` (G, 10) are in T-pose, metres: from the lowest vertex to the highest."""
    up = body.template[:, 1]
    # No shape within three standard deviations moves a vertex past another that is 10 cm higher.
    ends = np.flatnonzero((up < up.min() + 0.1) | (up > up.max() - 0.1))
    return np.ptp(up[ends] + betas @ body.shapes[ends, 1].T, axis=1)


def read_body(file: Path | None = None) -> SmplArrays:
    """The arrays of a body model's file, by default of the open body that ships; loads no torch."""
    return read_smpl_file(_OPEN_BODY if file is None else file)
