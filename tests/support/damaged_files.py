"""Files with damages, by Hypothesis: what readers must refuse or read, and never end in another error."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

WORDS = (
    *("nan", "inf", "-inf", "1e308", "-1e308", "5e-324", "0", "-1", "1e400", "99999999999999999999", '""', "null"),
    *("true", "[]", "{}", '"a"', "\u0665", "\x00", "0x10", "1_0", "-", "", "1e", "1:2:3", "9" * 400, "[[[", "<a>"),
)
NUMBER, WORD = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?"), re.compile(rb"[A-Za-z_]{2,}")


def few(examples: int) -> Callable[[Any], Any]:
    """The same examples in every run."""
    checks = list(HealthCheck)
    return settings(max_examples=examples, derandomize=True, deadline=None, database=None, suppress_health_check=checks)


@st.composite
def damaged(draw: st.DrawFn, samples: dict[str, bytes]) -> tuple[str, bytes]:
    """One of some files by name with one to three edits: a number, a byte, a line, the end, or a word."""
    name = draw(st.sampled_from(list(samples)))
    data = samples[name]
    for _ in range(draw(st.integers(1, 3))):
        numbers, words = list(NUMBER.finditer(data)), list(WORD.finditer(data))
        kind = draw(st.sampled_from(("number", "number", "number", "byte", "line", "end", "word")))
        at = draw(st.integers(0, max(len(data) - 1, 0)))
        if kind == "number" and numbers:
            old = numbers[at % len(numbers)]
            data = data[: old.start()] + draw(st.sampled_from(WORDS)).encode() + data[old.end() :]
        elif kind == "word" and words:
            old, new = words[at % len(words)], words[draw(st.integers(0, len(words) - 1))]
            data = data[: old.start()] + new.group() + data[old.end() :]
        elif kind == "line":
            lines = data.split(b"\n")
            lines.insert(at % len(lines), lines.pop(draw(st.integers(0, len(lines) - 1))))
            data = b"\n".join(lines[draw(st.integers(0, 1)) :])
        else:
            data = data[:at] + (bytes([draw(st.integers(0, 255))]) + data[at + 1 :] if kind == "byte" else b"")
    return name, data
