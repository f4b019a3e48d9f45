"""A run as its page sees it, whatever runs it."""

from __future__ import annotations

from typing import Any, Protocol

SAFER = ("pause", "laser off")
"""What every browser with the link may ask for: it only makes a run safer."""


class Watched(Protocol):
    """What a page reads of a run and asks of it; called by the server's thread, so no call may wait for the run."""

    def told(self) -> dict[str, Any]:
        """The newest snapshot, as JSON holds it."""

    def picture(self, spot: int, camera: str, kind: str) -> bytes | None:
        """JPEG of the last look: "whole", or "spot" for its surroundings; None where there is none."""

    def ask(self, what: str) -> bool:
        """Puts a request in the queue; False once the run has ended.

        Raises:
            ValueError: nothing that can be asked for.
        """

    def control_passed(self) -> None:
        """Another browser controls the run from now on."""
