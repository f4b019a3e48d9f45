"""Limits of the counters: stated ones and defaults."""

from __future__ import annotations

from tvsbayes.instrument.counter_limits import CounterLimits


def test_limits_are_those_that_are_stated():
    limits = CounterLimits.of({"pan_min_steps": -10, "tilt_max_steps": 90, "port": "/dev/ttyACM0"})
    assert limits.unstated == ("pan_max_steps", "tilt_min_steps")
    assert limits.within({"pan": (-1, 1), "tilt": (-2, 2)}) == {"pan": (-10, 1), "tilt": (-2, 90)}
    assert limits.allow("pan", 10**6) and limits.allow("pan", -10) and not limits.allow("pan", -11)
    assert limits.allow("tilt", -(10**6)) and limits.allow("tilt", 90) and not limits.allow("tilt", 91)
    assert (limits.words("pan"), limits.words("tilt")) == ("-10 and more", "up to 90")
    assert CounterLimits.of({"pan_min_steps": 0, "pan_max_steps": 5}).words("pan") == "0 to 5"
