"""A picture of a calibrated camera to detections in the camera's calibrated pixels."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Camera
from shapepose_fg.detection2d.decoding import Candidates
from shapepose_fg.detection2d.heat_maps import HeatMapNetwork
from shapepose_fg.detection2d.top_down import People, TopDownNetwork
from shapepose_fg.detection2d.upright import UprightView, roll_of
from shapepose_fg.io.footage.placement import Placement

Network = HeatMapNetwork | TopDownNetwork
"""What finds joints in upright pictures. Each says what it is shown of a picture (`view`), what it finds in that
(`detect`), how a file says it (`suffix`, `head`, `text`, `tail`), and what it depends on (`settings`)."""


@dataclass(frozen=True)
class CameraDetector:
    """The detector for the pictures of one camera."""

    network: Network
    """What detects."""
    placement: Placement
    """Where calibrated pixels lie in the pictures."""
    roll_deg: float
    """By how much pictures are turned clockwise to stand upright, degrees."""
    view: UprightView
    """What the network is shown."""

    @classmethod
    def of(cls, camera: Camera, up: Array, placement: Placement, network: Network) -> "CameraDetector":
        """The detector for `camera` in a world where `up` (3,) points up."""
        roll_deg = roll_of(camera, up)
        return cls(network, placement, roll_deg, network.view(placement.region, roll_deg))

    def detect(self, picture: NDArray[np.uint8]) -> Candidates | People:
        """What is in a `picture` (H, W, 3), blue green red, in calibrated pixels, as the lens gives them."""
        found = self.network.detect(self.view.input_of(picture))
        xy = self.view.picture_from_input(found.xy)
        # In the corners beside a turned picture there is nothing to see.
        return found.moved(self.placement.to_calibrated(xy), self.view.inside(xy))
