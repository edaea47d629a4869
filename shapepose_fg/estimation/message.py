"""What is said of joints, as Gaussians: by the views, and by the body."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Message:
    """What somebody says of the joints of T frames (or of N rows), as Gaussians."""

    xyz: NDArray[np.float64]
    """(T, J, 3) where they are, metres; anything where the information is zero."""
    information: NDArray[np.float64]
    """(T, J, 3, 3) 1/m², positive semi-definite; zero where nothing is said."""

    @property
    def known(self) -> NDArray[np.bool_]:
        """(T, J) of which joints anything is said."""
        return np.asarray(self.information.any(axis=(2, 3)))

    def rows(self, index: NDArray[np.intp]) -> "Message":
        """Some of the rows."""
        return Message(self.xyz[index], self.information[index])


def symmetric_roots(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Symmetric square roots (D, 3, 3) of positive semi-definite matrices."""
    values, vectors = np.linalg.eigh(information)
    return np.einsum("dik,dk,djk->dij", vectors, np.sqrt(np.maximum(values, 0.0)), vectors)
