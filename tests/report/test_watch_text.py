"""What `watch` prints of what moved."""

from __future__ import annotations

import pytest

from tvsbayes.report.watch_text import watch_text
from tvsbayes.results.watch_record import MOVED, MovedPart, Watch


@pytest.mark.parametrize(
    ("value", "unit", "rough"),
    [(-12.0, "mm", True), (9.0, "mm", False), (1.5, "deg", True), (0.4, "deg", False), (0.3, "%", False)],
)
def test_sizes_beyond_the_linear_are_called_rough(value, unit, rough):
    """Their u is that of the linear law: of a positioner that fell over it would be believed."""
    moved = (MovedPart("positioner: shift along y", value, 0.1, unit),)
    text = watch_text(Watch(MOVED, 0.0, 0.01, 0.5, moved, (), 16, True), 0.8)
    assert f"moved: {moved[0].what}" in text and ("are rough" in text) == rough
