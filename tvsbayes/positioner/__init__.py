"""The motors: the serial protocol, its driver and the firmware on the other end."""

from importlib import resources
from pathlib import Path


def firmware_folder() -> Path:
    """Where the firmware's sources and its README with flashing instructions lie."""
    return Path(str(resources.files("tvsbayes.positioner") / "firmware"))
