"""The instrument: protocol, firmware, driver, journal, engine; its cameras, real or rendered, and what they see."""

from importlib import resources
from pathlib import Path


def firmware_folder() -> Path:
    """Where the firmware's sources and its README with flashing instructions lie."""
    return Path(str(resources.files("tvsbayes.device") / "firmware"))
