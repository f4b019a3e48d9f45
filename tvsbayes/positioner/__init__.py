"""The motors: the serial protocol, its driver, and the device's firmware."""

from importlib import resources
from pathlib import Path


def firmware_folder() -> Path:
    """The folder of the firmware's sources and its README with flashing instructions."""
    return Path(str(resources.files("tvsbayes.positioner") / "firmware"))
