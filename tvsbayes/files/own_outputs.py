"""Files that a command may replace: those whose first lines say that tvsbayes wrote them, as this kind.

Anything else at the place of an output may be somebody's only copy.
"""

from __future__ import annotations

import re
from pathlib import Path

from tvsbayes.errors import InputError, escaped, shown

PDF_MARK = b"\n% report by tvsbayes\n"
"""Last line of a printed report: a PDF is read from its end, where it may be followed by remarks."""
KINDS = {
    # The names of its columns are those of no other table.
    "plan": rb"\Astep,(?:action,[a-z0-9_]+_steps,|command,direction,read\r?\n)",
    "compensation": rb"compensation by tvsbayes ",
    "model of a head": rb'<xacro:property name="head_corrects"|made by tvsbayes ',
    "calibration in C": rb"\A/\* Laser positioner calibration, written by tvsbayes ",
    "calibration": rb'\A\{\s*"format": "tvsbayes-calibration/',
    "page of view": rb"<title>tvsbayes view</title>",
    "report": rb'<meta name="generator" content="tvsbayes [^>]*>\s*<title>Calibration report ',
    "printed report": rb"% report by tvsbayes\n\Z",
    "certificate": rb'<dcc:dccSoftware>\s*<dcc:software>\s*<dcc:name><dcc:content lang="en">tvsbayes<',
}
"""What shows each kind, in the first or last lines: LinuxCNC reads no remark before its table, and a PDF is no text."""
LINES_BYTES = 4096


def require_own(path: Path, kind: str) -> None:
    """Refuse to replace a file that is not of a kind in `KINDS`; an empty file has nothing to lose.

    Raises:
        InputError: there is another file, a folder, a pipe or a device.
    """
    if not path.exists():
        return
    found = "a folder, pipe or device"
    if path.is_file():
        try:
            with path.open("rb") as file:
                first = file.read(LINES_BYTES)
                file.seek(max(0, path.stat().st_size - LINES_BYTES))
                last = file.read()
        except OSError as error:
            found = escaped(error.strerror or str(error))
        else:
            if not first or any(re.search(KINDS[kind], part) for part in (first, last)):
                return
            found = f"a file that begins with {shown(first.decode('utf-8', errors='replace').split(chr(10))[0])}"
    name, allowed = escaped(str(path), 200), f"a new file, or a {kind} that tvsbayes wrote"
    message = f"{name} would be replaced: {found}; allowed is {allowed}"
    remedy = "name another file, or add --force"
    raise InputError("occupied", message, file=name, found=found, allowed=allowed, remedy=remedy)
