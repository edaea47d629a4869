"""Rerun's statistics of use, which its viewer sends to its makers unless they are switched off."""

import json
import subprocess

from shapepose_fg.core.errors import InputError

_PATIENCE_S = 30


def switch_off(viewer: str) -> bool:
    """Switch them off with the program `viewer`, as its manual says, for this and all later uses of rerun.

    True where they were on. InputError where they cannot be switched off: nothing is sent unasked.
    """
    try:
        if not _on(viewer):
            return False
        _said_by(viewer, "disable")
        if not _on(viewer):
            return True
        problem = "they are still on"
    except (OSError, ValueError, AttributeError, subprocess.SubprocessError) as error:
        problem = " ".join(str(error).split())
    raise InputError(
        f"rerun's statistics of use cannot be switched off ({problem}); run `rerun analytics disable`, "
        "or give --statistics if they may be sent"
    )


def _on(viewer: str) -> bool:
    """Whether they are sent; where the variable CI is set, rerun has none and prints `null`."""
    settings = json.loads(_said_by(viewer, "config"))
    return settings is not None and settings.get("analytics_enabled", True)


def _said_by(viewer: str, command: str) -> str:
    """What `rerun analytics COMMAND` prints."""
    words = [viewer, "analytics", command]
    done = subprocess.run(words, capture_output=True, text=True, timeout=_PATIENCE_S, check=True)
    return done.stdout
