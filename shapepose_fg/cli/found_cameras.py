"""What `calibrate`, `refine-calibration` and `synchronise` say alike: clocks that were found."""

import math
from typing import TYPE_CHECKING, Any

from shapepose_fg.cli.options import RESULT, option
from shapepose_fg.cli.terminal import show, table
from shapepose_fg.core.errors import InputError

if TYPE_CHECKING:
    from shapepose_fg.calibration.synchronisation import Synchronised
    from shapepose_fg.core.camera import Rig


def report_option() -> Any:
    """A page with pictures."""
    return option(RESULT, "Page with the cameras in 3D and people over them, for the browser: FILE.html.")


def check_most(most: float) -> None:
    """Refuse a largest offset that makes no sense."""
    if not 0 < most <= 600:
        raise InputError(f"--most {most:g}: must be above 0, up to 600 seconds")


def show_clocks(found: "Synchronised", rig: "Rig") -> None:
    """The offsets."""
    rows = []
    for name, offset, sigma, sure in zip(rig.names, found.offset_s, found.sigma_s, found.sure, strict=True):
        known = "-" if sigma == 0 else f"{1e3 * sigma:.1f}" if math.isfinite(sigma) else "unknown"
        rows.append((name, f"{offset:+.4f}", known, f"{sure:.1f}"))
    caption = "began: its frame 0, on the first camera's clock; stands out: the offset of all others"
    show(table(("camera", "began, s", "± ms", "stands out"), rows, caption=caption))
