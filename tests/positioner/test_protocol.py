"""Frames, CRC, requests and replies: published values, what is no message; settings of a rig file."""

from __future__ import annotations

from tvsbayes.positioner.protocol import (
    REPLY_CHARS_MAX,
    SEQUENCE_MAX,
    DeviceState,
    Reply,
    crc16,
    device_settings,
    frame,
    parse_answer,
    request,
    state_text,
    unframe,
)


def test_crc_and_frames_have_the_published_values():
    assert crc16(b"123456789") == 0x29B1
    assert frame(">1 ID") == b">1 ID*B1C5\n"
    assert request(12, "MA", 200, -40) == b">12 MA 200 -40*BAE5\n"
    assert unframe(b">1 ID*B1C5") == ">1 ID"


def test_longest_replies_fit_and_are_read_back():
    """Numbers of full length everywhere: the core's buffers, and what the driver takes for a line."""
    highest, lowest = 2**32 - 1, -(2**31)
    state = DeviceState(highest, "unhomed", *[lowest] * 4, SEQUENCE_MAX, False, *[lowest] * 2, "watchdog", 3, 3)
    text = state_text(state)
    for body in (
        f"<0 ok {text} fw=1.1.0 proto=2 q={SEQUENCE_MAX}",
        f"<{SEQUENCE_MAX} err argument {text} v=-100000000",
    ):
        line = frame(body)
        assert len(line) - 1 <= REPLY_CHARS_MAX
        reply = parse_answer(line[:-1])
        assert isinstance(reply, Reply) and reply.state == state


def test_settings_of_a_rig_file():
    table = {"driver": "serial", "pan_min_steps": -400, "tilt_max_steps": 10, "speed_steps_per_s": 1e6}
    assert device_settings(table) == {"pmin": -400, "tmax": 10, "vmax": 20_000}
    home = {"pan_home_steps": -900, "tilt_home_steps": 300}
    ramp = {"acceleration_steps_per_s2": 2500.0, "laser_watchdog_s": 1.5}
    assert device_settings({**home, **ramp}) == {"hp": -900, "ht": 300, "amax": 2_500, "wd": 1_500}
