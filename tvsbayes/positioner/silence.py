"""Why a device does not answer: the bytes received instead, and the remedy.

The received bytes distinguish most causes and are quoted. The module has no input or output.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from tvsbayes.errors import escaped
from tvsbayes.positioner.protocol import FrameError, parse_answer

HEARD_BYTES_MAX = 400
"""Number of received bytes kept from the beginning, where greetings and first errors stand."""
QUOTED_CHARS_MAX = 80
UNREADABLE_SHARE = 0.3
"""Share of non-text bytes above which the baud rate counts as wrong; boards send text only."""
Cause = Literal["silence", "grbl", "marlin", "cr-lf", "nak", "unreadable", "other"]
_GRBL = re.compile(rb"Grbl |ALARM:\d|error:\d|\[MSG:|<(?:Idle|Alarm|Run|Home|Hold|Door|Check|Sleep)[|,]")
_MARLIN = re.compile(rb"Marlin|echo:|Unknown command|^start\r?$|\bT:\d", re.MULTILINE)
_BOARDS: tuple[tuple[Cause, re.Pattern[bytes], str, str], ...] = (
    (
        "grbl",
        _GRBL,
        "a GRBL board",
        'write driver = "grbl" into [positioner], or flash the firmware shipped with tvsbayes',
    ),
    (
        "marlin",
        _MARLIN,
        "a Marlin board (a 3D printer?)",
        "correct [positioner] port, or flash the firmware shipped with tvsbayes",
    ),
)
"""Known boards: cause, pattern of their output, name, remedy."""


@dataclass(frozen=True)
class Heard:
    """Explanation of bytes received instead of an answer.

    Attributes:
        cause: the cause, in one word.
        found: description, with the quotation.
        remedy: the remedy.
    """

    cause: Cause
    found: str
    remedy: str


def explained(heard: bytes) -> Heard:
    """Determine the cause from the bytes that arrived before the time-out; lines may be incomplete."""
    quote = _quoted(heard)
    if not heard:
        remedy = "check the device's supply, the cable and [positioner] port; flash the firmware if it is a new board"
        return Heard("silence", "nothing was heard", remedy)
    for cause, pattern, name, remedy in _BOARDS:
        if pattern.search(heard):
            return Heard(cause, f"{name} answered: {quote}", remedy)
    lines = heard.split(b"\n")
    if any(_is_message(line[:-1]) for line in lines if line.endswith(b"\r")):
        remedy = (
            "let the firmware end its lines in LF only: Serial.write of the line as it is, no println; or flash ours"
        )
        return Heard("cr-lf", f"this protocol, but with lines that end in CR LF: {quote}", remedy)
    if any(_is_message(line) for line in lines):
        remedy = "another program may drive the device: close it; else look for noise on the cable and unplug it once"
        return Heard("nak", f"messages of this protocol, none of them the answer: {quote}", remedy)
    unreadable = sum(byte not in b"\t\r\n" and not 32 <= byte < 127 for byte in heard)
    if unreadable > UNREADABLE_SHARE * len(heard):
        remedy = "set [positioner] baud to the device's speed (115200 for ours); then look for noise on the cable"
        return Heard("unreadable", f"unreadable bytes, as at a wrong baud rate: {quote}", remedy)
    remedy = "correct [positioner] port: another device is there; or flash the firmware shipped with tvsbayes"
    return Heard("other", f"something that does not speak this protocol: {quote}", remedy)


def _is_message(line: bytes) -> bool:
    try:
        parse_answer(line)
    except FrameError:
        return False
    return True


def _quoted(heard: bytes) -> str:
    """The first bytes received, printable."""
    text = heard[:QUOTED_CHARS_MAX].decode("latin-1")
    printable = text.encode("unicode_escape").decode() if not text.isascii() else escaped(text, QUOTED_CHARS_MAX)
    return f'"{printable}{"..." if len(heard) > QUOTED_CHARS_MAX else ""}" ({len(heard)} bytes)'
