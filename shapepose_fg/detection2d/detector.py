"""A picture of a calibrated camera to joint candidates in the camera's calibrated pixels."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Camera
from shapepose_fg.detection2d.decoding import Candidates, decode
from shapepose_fg.detection2d.network import HeatMapNetwork
from shapepose_fg.detection2d.upright import UprightView, roll_of
from shapepose_fg.io.footage.placement import Placement


@dataclass(frozen=True)
class CameraDetector:
    """The detector for the pictures of one camera."""

    network: HeatMapNetwork
    """What makes heat maps."""
    placement: Placement
    """Where calibrated pixels lie in the pictures."""
    roll_deg: float
    """By how much pictures are turned clockwise to stand upright, degrees."""
    view: UprightView
    """What the network is shown."""
    long_side: int
    """The longer side of the network's input, pixels: more finds smaller people, and takes longer."""

    @classmethod
    def of(
        cls, camera: Camera, up: NDArray[np.float64], placement: Placement, network: HeatMapNetwork, long_side: int
    ) -> "CameraDetector":
        """The detector for `camera` in a world where `up` (3,) points up."""
        roll_deg = roll_of(camera, up)
        view = UprightView.of(placement.region, roll_deg, long_side, network.layout, network.only_size)
        return cls(network, placement, roll_deg, view, long_side)

    def detect(self, picture: NDArray[np.uint8]) -> Candidates:
        """Candidates in a `picture` (H, W, 3), blue green red, in calibrated pixels, as the lens gives them."""
        output = self.network.run(self.view.input_of(picture))
        found = decode(output, self.network.layout)
        xy = self.view.picture_from_cells(found.xy)
        found = replace(found, xy=self.placement.to_calibrated(xy))
        # In the corners beside a turned picture there is nothing to see.
        return found.only(self.view.inside(xy))
