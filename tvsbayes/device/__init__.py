"""The instrument itself: serial protocol, firmware, driver, cameras, journal, and the engine that runs a plan."""

from importlib import resources
from pathlib import Path


def firmware_folder() -> Path:
    """Where the firmware's sources and its README with flashing instructions lie."""
    return Path(str(resources.files("tvsbayes.device") / "firmware"))
