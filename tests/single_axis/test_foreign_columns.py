"""Contents of the columns of an axis table, beyond their names."""

from __future__ import annotations

import pytest

from tvsbayes.errors import InputError
from tvsbayes.files.foreign_table import table_of
from tvsbayes.single_axis.foreign_columns import (
    deviation_columns,
    long_table,
    refuse_small,
    run_columns,
)


def table(**columns):
    names = {name.replace("_", " "): cells for name, cells in columns.items()}
    return table_of("t.csv", "CSV", names, range(2, 2 + len(next(iter(names.values())))))


@pytest.mark.parametrize(
    ("names", "runs"),
    [
        (("Position", "Forward 1", "Backward 1", "Forward 2"), [(1, 1), (1, -1), (2, 1)]),
        (("Soll", "Vorw\u00e4rts 1", "R\u00fcckw\u00e4rts 1"), [(1, 1), (1, -1)]),
        (("mm", "Run 1 \u2191", "Run 1 \u2193"), [(1, 1), (1, -1)]),
        (("mm", "fwd", "rev"), [(1, 1), (1, -1)]),
        (("mm", "fwd"), []),
        (("steps", "reading"), []),
    ],
)
def test_columns_of_runs(names, runs):
    assert list(run_columns(dict.fromkeys(names, ("1.0",))).values()) == runs


def test_runs_in_columns_are_joined_in_order():
    """Forward up, backward down, whatever the order of the rows; lines are those of the file."""
    wide = table(
        **{"Position": ("10", "0"), "Backward 1 (mm)": ("b10", "b0"), "Forward 1 (mm)": ("1", "2")},
        **{"Forward 2 (mm)": ("3", "4")},
    )
    wide.columns["Backward 1 (mm)"] = ("5", "6")
    rows = long_table(wide, {})
    joined, (remark,) = rows.table, rows.remarks
    assert joined.columns["reading (mm)"] == ("2", "1", "5", "6", "4", "3")
    assert joined.columns["Position"] == ("0", "10", "10", "0", "0", "10")
    assert joined.columns["direction"] == ("forward",) * 2 + ("backward",) * 2 + ("forward",) * 2
    assert joined.lines == (3, 2, 2, 3, 3, 2) and "3 columns" in remark
    assert rows.stated == {"command": "Position"}
    assert long_table(wide, {"value": "Forward 1 (mm)"}).table is wide


def test_runs_in_two_units_or_without_positions_are_refused():
    with pytest.raises(InputError, match="runs in mm, um"):
        long_table(table(**{"p": ("1",), "Forward 1 (mm)": ("1",), "Forward 2 (um)": ("1",)}), {})
    with pytest.raises(InputError, match="no column that is surely their position"):
        long_table(table(p=("1",), q=("2",), Forward_1=("1",), Backward_1=("1",)), {})


COLUMNS = {"command": "target mm", "value": "actual mm"}


@pytest.mark.parametrize(
    ("name", "cells", "text"),
    [
        ("error mm", ("0.01", "0.03", "-0.02"), "actual mm - target mm"),
        ("error mm", ("-0.01", "-0.03", "0.02"), "target mm - actual mm"),
        ("deviation um", ("10", "30", "-20"), "actual mm - target mm"),
        ("Fehler", ("0.01", "0.03", "0.02"), "|actual mm - target mm|"),
        ("error mm", ("0.01", "0.03", "0.02"), "|actual mm - target mm|"),
        ("error mm", ("0.01", "0.03", "-0.03"), None),
        ("error mm", ("0.01", "0.01", "0.01"), None),
        ("humidity", ("0.01", "0.03", "-0.02"), None),
    ],
)
def test_a_column_that_is_actual_less_target_is_no_uncertainty(name, cells, text):
    known = table(target_mm=("0", "1", "2"), actual_mm=("0.01", "1.03", "1.98"), **{name: cells})
    assert deviation_columns(known, COLUMNS) == ({} if text is None else {name: text})


def test_readings_that_are_deviations_are_asked_for():
    """Readings of a gear of 1 to 100 lie on a line and are accepted."""
    commands = [str(k) for k in range(0, 100, 10)]
    loose = table(target_mm=commands, actual_mm=[str(0.001 * (k * 7 % 10)) for k in range(10)])
    with pytest.raises(InputError, match="--deviations"):
        refuse_small(loose, COLUMNS)
    refuse_small(table(target_mm=commands, actual_mm=[str(0.1 * k) for k in range(10)]), COLUMNS)
    refuse_small(
        table(target=commands, actual=[str(0.001 * (k * 7 % 10)) for k in range(10)]),
        {"command": "target", "value": "actual"},
    )
