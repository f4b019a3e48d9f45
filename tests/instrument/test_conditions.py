"""Minutes since power-on and temperature at every move; the shifts of the zeros that moves determine."""

from __future__ import annotations

import datetime
from dataclasses import replace

import numpy as np
import pytest

from tvsbayes.errors import InputError
from tvsbayes.files.documents import parse_toml
from tvsbayes.instrument.campaign import MOVES, Move, parse_moves
from tvsbayes.instrument.campaign_header import parse_header
from tvsbayes.instrument.conditions import (
    interpolated,
    kelvin,
    pause_s,
    powered_on_s,
    temperature_doubts,
    unseen_shifts,
    warm_minutes,
)
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import CREEP_NAMES, ZERO_SHIFT_NAMES, Prior, names_of

HEAD = 'format = "tvsbayes-campaign/1"\n'
CREATED = "created = 2026-01-15T10:00:00Z\n"


def moves_at(times_s: list[float], degC: list[float | None] | None = None) -> list[Move]:
    """Moves of zero steps at these times."""
    rows = [Move(move=k, segment=0, time_s=t, pan_steps=0, tilt_steps=0) for k, t in enumerate(times_s)]
    return rows if degC is None else [replace(m, temperature_degC=t) for m, t in zip(rows, degC, strict=True)]


def header(text: str) -> dict[str, object]:
    return parse_header(parse_toml((HEAD + text).encode(), "campaign.toml"))


def test_minutes_since_the_first_move_or_since_switching_on():
    moves = moves_at([120.0, 180.0, 3720.0])
    np.testing.assert_array_equal(warm_minutes(moves), [0.0, 1.0, 60.0])
    entries = header(CREATED + "powered_on = 2026-01-15T09:30:00Z\n")
    assert entries["powered_on"] == datetime.datetime(2026, 1, 15, 9, 30, tzinfo=datetime.UTC)
    np.testing.assert_array_equal(warm_minutes(moves, powered_on_s(entries)), [32.0, 33.0, 92.0])
    assert powered_on_s(header(CREATED)) is None


@pytest.mark.parametrize("times_s", [[5.0, 5.0, 5.0], [0.0, 1.0, 2.0]])
def test_moves_without_times_have_no_warm_up(times_s):
    """Equal times, or those counted by an import; then a creep is not determined."""
    moves = moves_at(times_s)
    assert not warm_minutes(moves).any()
    assert set(unseen_shifts(moves, TWO_MIRROR.priors)) == set(ZERO_SHIFT_NAMES)


@pytest.mark.parametrize(
    "text",
    [
        "powered_on = 2026-01-15T09:30:00Z\n",
        CREATED + "powered_on = 2026-01-15T10:30:00Z\n",
        CREATED + "powered_on = 2026-01-15T09:30:00\n",
        CREATED + "powered_on = 2026-01-15\n",
    ],
    ids=["no clock", "later", "no zone", "a day"],
)
def test_an_impossible_time_of_switching_on_is_refused(text):
    with pytest.raises(InputError, match=r"powered_on.*`created`"):
        header(text)


def test_temperatures_are_interpolated_in_time_and_counted():
    moves = moves_at([0.0, 10.0, 40.0, 50.0], [None, 20.0, None, 24.0])
    np.testing.assert_allclose(kelvin(moves), [0.0, 0.0, 3.0, 4.0], rtol=1e-12)
    assert interpolated(moves) == 2 and interpolated(moves_at([0.0, 1.0])) == 0
    np.testing.assert_allclose(kelvin(moves_at([0.0, 0.0, 0.0], [20.0, None, 22.0])), [0.0, 1.0, 2.0], rtol=1e-12)
    assert not kelvin(moves_at([0.0, 9.0], [20.0, None])).any()


def test_codes_of_a_sensor_are_doubted_where_neighbours_are_far():
    """85 and -127 are what a DS18B20 gives when it did not measure; a kiln at 85 degC is one."""
    times = [10.0 * k for k in range(7)]
    power_on, disconnected = temperature_doubts(moves_at(times, [85.0, 21.0, None, -127.0, -127.0, 22.5, 85.0]))
    assert "moves 0, 6 is 85" in power_on and "others are 21 to 22.5" in power_on
    assert "moves 3, 4 is -127" in disconnected and "interpolated" in disconnected
    assert temperature_doubts(moves_at(times, [80.0, 83.0, 85.0, 85.0, 86.0, None, 84.0])) == []
    assert temperature_doubts(moves_at(times)) == []
    # Never another value: nothing was measured at all.
    assert len(temperature_doubts(moves_at(times, [-127.0] * 7))) == 1


@pytest.mark.parametrize("degC", ["-273.16", "-300", "nan"])
def test_below_absolute_zero_is_refused(degC):
    moves = [replace(moves_at([0.0])[0], temperature_degC=-273.15, pan_approach="left", tilt_approach="up")]
    data = MOVES.content(moves)
    assert list(parse_moves(data)) == moves
    with pytest.raises(InputError, match="temperature_degC"):
        parse_moves(data.replace(b"-273.15", degC.encode()))


def test_shifts_determined_by_the_moves():
    warm, both = moves_at([0.0, 7.0]), moves_at([0.0, 7.0], [20.0, 21.0])
    still = {**TWO_MIRROR.priors, **dict.fromkeys(names_of("creep_deg"), Prior(0.0, 0.0))}
    assert unseen_shifts(warm, TWO_MIRROR.priors) == names_of("thermal_deg_per_K")
    assert unseen_shifts(both, TWO_MIRROR.priors) == ()
    assert unseen_shifts(both, still) == ("creep_minutes",)
    assert CREEP_NAMES == (*names_of("creep_deg"), "creep_minutes")


def test_the_pause_between_two_campaigns_is_by_their_dates():
    one, naive = datetime.datetime(2026, 3, 1, 20, 0, tzinfo=datetime.UTC), datetime.datetime(2026, 3, 2, 20, 0)
    later = {"created": one + datetime.timedelta(days=1)}
    assert pause_s({"created": one}, later, 3600.0) == 82800.0
    assert pause_s(later, {"created": one}, 3600.0) == pause_s({}, later, 0.0) == 0.0
    assert pause_s({"created": one}, {"created": naive}, 0.0) == 0.0
