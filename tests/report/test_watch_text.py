"""Text of `watch` for detected motions."""

from __future__ import annotations

import pytest

from tvsbayes.report.command_text import watch_text
from tvsbayes.results.watch_record import MOVED, MovedPart, Watch


@pytest.mark.parametrize(
    ("value", "unit", "rough"),
    [(-12.0, "mm", True), (9.0, "mm", False), (1.5, "deg", True), (0.4, "deg", False), (0.3, "%", False)],
)
def test_sizes_outside_the_linear_range_are_called_rough(value, unit, rough):
    """Their u is that of the linear law, which does not hold for large motions."""
    moved = (MovedPart("positioner: shift along y", value, 0.1, unit),)
    text = watch_text(Watch(MOVED, 0.0, 0.01, moved, 16, 0.5, (), True), 0.8)
    assert f"moved: {moved[0].what}" in text and ("are inaccurate" in text) == rough


def test_a_remainder_of_the_best_explanation_is_no_separate_motion():
    """After a large motion of the cameras the linear law leaves a remainder that the positioner explains."""
    parts = tuple(MovedPart(f"{what}: shift along y", 3.0, 0.1, "mm") for what in ("cameras", "positioner"))
    text = watch_text(Watch(MOVED, 0.0, 0.01, parts, 16, 0.5, (), True), 0.8)
    assert "what to do: calibrate the cameras again" in text and "fasten it" not in text
    assert "positioner may show residuals of the first cause only" in text
    alone = watch_text(Watch(MOVED, 0.0, 0.01, parts[1:], 16, 0.5, (), True), 0.8)
    assert "fasten it" in alone and "takes what" not in alone
