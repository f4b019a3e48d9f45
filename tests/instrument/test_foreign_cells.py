"""Notations of numbers in cells of a foreign table."""

from __future__ import annotations

import pytest

from tvsbayes.instrument.foreign_cells import plain_column


@pytest.mark.parametrize(
    ("cells", "plain", "unit"),
    [
        (("1.5", "-2"), (1.5, -2.0), None),
        (("12\u00b034'30\"", "-0\u00b030'00\"", "0\u00b0 15' 18.0\""), (12.575, -0.5, 0.255), "deg"),
        (("12:34:30", "-0:30:00"), (12.575, -0.5), "deg"),
        (("-1d 12m 0s", "3 6 9"), (-1.2, 3.1025), "deg"),
        (('1 3/8"', "2", "-1/4", "1-1/2"), (1.375, 2.0, -0.25, 1.5), None),
        (("1.5 mm", "-2 mm"), (1.5, -2.0), "mm"),
        (('1.002"', '2.0"'), (1.002, 2.0), "inch"),
        (("90\u00b0", "91\u00b0"), (90.0, 91.0), "deg"),
    ],
)
def test_notations_of_numbers(cells, plain, unit):
    """The sign of an angle of less than a degree is kept; a minute has 60 seconds."""
    column = plain_column("x", cells)
    assert [float(cell) for cell in column.cells] == pytest.approx(plain, rel=1e-12)
    assert column.unit == unit and bool(column.remark) == (column.cells != cells)


@pytest.mark.parametrize("cells", [("1.5 mm", "2 deg"), ("12:61:00", "1:2:3"), ("slipped", "1"), ("1/0", "1/2")])
def test_cells_of_mixed_notation_are_unchanged(cells):
    assert plain_column("x", cells).cells == cells
