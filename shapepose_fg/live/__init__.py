"""People as detections come: the newest moment at once, and the same refined within a fixed lag."""
