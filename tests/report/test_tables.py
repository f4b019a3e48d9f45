"""Numbers with their uncertainty, `value(u)`, and tables as text."""

from __future__ import annotations

import math

import pytest

from tvsbayes.display import concise
from tvsbayes.report.tables import TableView, chance_text, interval_text, two_digits


@pytest.mark.parametrize(
    ("value", "sd", "expected"),
    [
        (0.0593944, 0.0008082, "0.05939(81)"),
        (-12.3456, 0.0123, "-12.346(12)"),
        # Rounding the sd to two digits carries into the next decade: 10, never 100.
        (0.0593944, 0.0000994, "0.059394(99)"),
        (0.0593944, 0.0000995, "0.05939(10)"),
        (21.34, 0.996, "21.3(1.0)"),
        (21.34, 9.96, "21(10)"),
        (1234.5, 123.0, "1234(120)"),
        (200.0, 0.0, "200"),
        (0.2, math.nan, "0.2"),
        (0.2, math.inf, "0.2"),
        (0.0, 1e-12, "0.0000000000000(10)"),
        (1.1000000000000003, 1.2e-15, "1.1"),
    ],
)
def test_concise_shows_two_digits_of_the_uncertainty(value, sd, expected):
    assert concise(value, sd) == expected


@pytest.mark.parametrize(
    ("u", "expected"),
    [
        (0.1, "0.10"),
        (0.000996, "0.0010"),
        (2.04, "2.0"),
        (9.96, "10"),
        (123.4, "120"),
        (1e-7, "0.00000010"),
        (0.0, "0"),
        (math.inf, "inf"),
    ],
)
def test_uncertainties_have_two_digits_zeros_included(u, expected):
    assert two_digits(u) == expected


@pytest.mark.parametrize("mantissa", [1.0, 1.049, 1.05, 4.44, 9.4999, 9.5, 9.949, 9.95, 9.96, 9.999])
def test_concise_rounds_the_uncertainty_within_five_percent(mantissa):
    """Read back: two digits leave at most half a unit of 1.0, 5 %; value and digits end at the same place."""
    for exponent in range(-9, 3):
        sd = mantissa * 10.0**exponent
        number, digits = concise(math.pi, sd).rstrip(")").split("(")
        places = len(number.partition(".")[2])
        shown = float(digits) if "." in digits or not places else int(digits) * 10.0**-places
        assert len(digits.replace(".", "").rstrip("0") or "0") <= 2
        assert shown == pytest.approx(sd, rel=0.0501)
        assert abs(float(number) - math.pi) <= 0.5 * 10.0**-places


@pytest.mark.parametrize(
    ("low", "high", "sd", "expected"),
    [
        (0.061926, 0.0622781, 0.00009, "[0.061926, 0.062278]"),
        (-0.5, 0.5, 0.25, "[-0.50, 0.50]"),
        (18.3, 24.3, 1.54, "[18.3, 24.3]"),
        (-0.25, 0.25, 0.0996, "[-0.25, 0.25]"),
        (-100.0, 300.0, 123.0, "[-100, 300]"),
        (0.2, 0.2, 0.0, ""),
    ],
)
def test_interval_ends_have_the_digits_of_the_uncertainty(low, high, sd, expected):
    assert interval_text(low, high, sd) == expected


def test_a_table_wider_than_a_terminal_is_printed_in_parts_below_each_other():
    names = ("left", "right", "up", "down")
    text = TableView("title", ["", *names], [["a label of 20 letters", *(f"{name:>15}" for name in names)]]).text()
    lines = text.splitlines()
    assert [line.split() for line in lines[1::2]] == [["left", "right"], ["up", "down"]]
    assert [line.split()[-2:] for line in lines[2::2]] == [["left", "right"], ["up", "down"]]
    assert max(map(len, lines)) <= 80


LONG_LABELS = TableView(
    "title",
    ["quantity", "value(u)", "95 % interval", "set by"],
    [["scatter of stops", "0.0052(16)", "[0.0016, 0.0084]", "data"], ["never moved", "", "", ""]],
)


def test_a_row_too_long_for_its_label_takes_two_lines(monkeypatch):
    """Where columns do not split evenly: a last column alone, far below, is hard to read beside its row."""
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    for columns in ("40", "48"):
        monkeypatch.setenv("COLUMNS", columns)
        assert LONG_LABELS.text().splitlines() == [
            "title",
            "quantity",
            "    value(u)     95 % interval  set by",
            "scatter of stops",
            "  0.0052(16)  [0.0016, 0.0084]    data",
            "never moved",
        ]
    for columns in ("56", "200"):
        monkeypatch.setenv("COLUMNS", columns)
        assert LONG_LABELS.text().splitlines()[2].endswith("data") and len(LONG_LABELS.text().splitlines()) == 4


def test_a_narrow_terminal_splits_a_table_that_fits_80_columns(monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    table = TableView("a caption of more than forty columns of text", ["", "a", "b"], [["row", "1" * 30, "2" * 30]])
    assert len(table.text().splitlines()) == 3, "a file or a pipe has no columns"
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    lines = table.text().splitlines()
    assert len(lines) == 6 and max(map(len, lines)) <= 40


def test_tables_are_plain_text_on_every_terminal(monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "20")
    text = TableView("title", ["name", "95 %"], [["[bold]a[/bold]", "1.25"], ["longer name", "[1, 2]"]]).text()
    assert text.splitlines() == [
        "title",
        "name              95 %",
        "[bold]a[/bold]    1.25",
        "longer name     [1, 2]",
    ]


@pytest.mark.parametrize(
    ("probability", "text", "bound"),
    [
        (1.0, "above 0.999", "above 0.999"),
        (0.9996, "above 0.999", "above 0.999"),
        (0.9994, "0.999", "at least 0.999"),
        (0.955, "0.955", "at least 0.955"),
        (0.0004, "below 0.001", "below 0.001"),
        (0.0, "below 0.001", "below 0.001"),
    ],
)
def test_no_share_of_draws_is_printed_as_certain(probability, text, bound):
    assert chance_text(probability) == text and chance_text(probability, "at least ") == bound
