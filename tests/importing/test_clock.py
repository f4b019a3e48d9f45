"""Clocks of strangers' tables: how times are written, and clocks that pass midnight or are set back."""

from __future__ import annotations

import pytest

from tvsbayes.errors import InputError, Question
from tvsbayes.importing.cells import FieldCells
from tvsbayes.importing.clock import date_time, seconds_of, stamp_of, time_of_day
from tvsbayes.importing.table import table_of


def seconds(*texts: str, name: str = "time") -> tuple[list[float] | None, str]:
    """Seconds of a column, and what is said of it."""
    table, said = table_of("log.csv", "CSV", {name: texts}, range(2, len(texts) + 2)), list[str]()
    return seconds_of(FieldCells(table, {"time_s": name}, assumed=said)), "; ".join(said)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        *[("9:05", 32700.0), ("9:05:12.25", 32712.25), ("9:05:12,25", 32712.25), ("9:05:12 PM", 75912.0)],
        *[("12:00:00 am", 0.0), ("12:00:00 pm", 43200.0), ("24:00", None), ("9:60", None), ("9.05", None), ("", None)],
    ],
)
def test_times_of_day(text, expected):
    assert time_of_day(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        *("2026-01-05T23:00:07", "5.1.2026 23:00:07", "05.01.2026, 23:00:07", "2026/1/5 23:00:07"),
        *("2026/01/05 11:00:07 PM", "5-Jan-2026 23:00:07", "Jan 5, 2026 23:00:07", "2026-01-06T01:00:07+02:00"),
    ],
)
def test_dates_in_all_orders_that_are_sure(text):
    at, stamp = date_time(text), stamp_of(text)
    assert at is not None and (at.timestamp(), at.second) == (1767654007.0, 7)
    assert stamp is not None and (stamp.tzinfo is None) == ("+" not in text)


@pytest.mark.parametrize("text", ["1/5/2026 23:00:07", "05.01.26", "2026-13-01", "12", "5.1.2026.3", "x"])
def test_dates_that_could_be_others_are_none(text):
    assert date_time(text) is None


@pytest.mark.parametrize(
    ("texts", "expected", "said"),
    [
        (("5", "6.5"), [5.0, 6.5], ""),
        (("1700000000123456789", "1700000000623456789"), [0.0, 0.5], "counted in 1e-09 s since 1970"),
        (("1700000000123", "1700000001123"), [0.0, 1.0], "counted in 0.001 s since 1970"),
        (("23:59:58", "00:00:01", "00:00:02"), [0.0, 3.0, 4.0], "seconds since the first row"),
        (("2026-01-05 23:59:58", "00:00:01"), [0.0, 3.0], "seconds since the first row"),
        # Minutes and seconds look the same, so it is said.
        (("00:00", "00:01"), [0.0, 60.0], "hours and minutes, so seconds since"),
        (("46024.5", "46024.6"), [46024.5, 46024.6], "spreadsheets count days by such numbers"),
        (("46024.5", "46024.515625"), [0.0, 1350.0], "days, as of a Julian date or a spreadsheet"),
    ],
)
def test_seconds_of_a_column(texts, expected, said):
    found, text = seconds(*texts)
    assert found == pytest.approx(expected, abs=1e-9) and said in text and bool(said) == bool(text)


def test_the_end_of_summer_time_is_an_hour_less_the_usual_step():
    local = tuple(f"2026-10-25T02:{clock}" for clock in ("56:30", "58:00", "59:00", "00:00", "01:00"))
    found, said = seconds(*local)
    assert found == [0.0, 90.0, 150.0, 210.0, 270.0]
    assert "back by 3540 s in line 5, as at the end of summer time" in said
    for others in (
        # Twenty minutes are no hour; a clock with a zone is not set; an hour is lost once; numbers are no clock.
        ("2026-10-25T02:58:00", "2026-10-25T02:59:00", "2026-10-25T02:39:00"),
        tuple(f"{text}+02:00" for text in local),
        (*local, "2026-10-25T01:02:00"),
        ("3600", "3660", "120"),
    ):
        with pytest.raises(Question, match="step back by"):
            seconds(*others)


@pytest.mark.parametrize("cell", ["tomorrow", "9" * 400, "nan"])
def test_a_cell_that_is_no_time_is_refused(cell):
    with pytest.raises(InputError, match="line 3, time"):
        seconds("1", cell)
