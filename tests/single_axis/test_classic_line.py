"""The least-squares line of an axis and its ISO 230-2 table, by hand."""

from __future__ import annotations

import numpy as np
import pytest
from support.axes import campaign, runs

from tvsbayes.metrology.iso230 import figures_of
from tvsbayes.report.axis_document import classic_text
from tvsbayes.single_axis.axis_campaign import AxisMove
from tvsbayes.single_axis.axis_rows import AxisRows, rows_of
from tvsbayes.single_axis.classic_line import classic_axis, fit_line, position_runs, positioning_of


def rows_with(seed: int, places: tuple[float, ...] = (0.0, 500.0, 1400.0), cycles: int = 3) -> AxisRows:
    """Stops of 0.02 deg scatter, a reversal of 0.4 deg."""
    moves = runs(cycles, places)
    command = np.array([m.command for m in moves])
    side = np.array([-1.0, *np.sign(np.diff(command))])
    noise = np.random.default_rng(seed).normal(0.0, 0.02, len(moves))
    return rows_of(campaign(moves, 0.01 * command - 0.2 * side + 5.0 + noise))


def test_the_line_is_that_of_least_squares():
    rows = rows_with(1)
    design = np.column_stack([np.ones(len(rows.value)), rows.command, -0.5 * rows.side])
    solved, square, _, _ = np.linalg.lstsq(design, rows.value, rcond=None)
    scatter = float(np.sqrt(square[0] / (len(rows.value) - 3)))
    u = scatter * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    classic = classic_axis(rows)
    stated = [classic.per_command, classic.u_per_command, classic.backlash, classic.u_backlash, classic.residual_sd]
    np.testing.assert_allclose(stated, [solved[1], u[1], solved[2], u[2], scatter], rtol=1e-9)


def test_as_many_stops_as_unknowns_leave_u_and_scatter_open():
    """Both sides have three unknowns, one side has two."""
    commands, values = (0.0, 1.0, 2.0, 1.0), [0.0, 1.0, 2.1, 1.3]
    moves = [AxisMove(k, 0, 0.0, c, "" if k else "forward") for k, c in enumerate(commands)]
    for count in (3, 4):
        line = classic_axis(rows_of(campaign(moves[:count], values[:count])))
        assert line.degrees_of_freedom == 1 and line.u_per_command > 0 and line.residual_sd > 0
    turned = [moves[0], moves[1], AxisMove(2, 0, 0.0, 0.5, "")]
    line = classic_axis(rows_of(campaign(turned, [0.0, 1.0, 0.6])))
    assert line.per_command == pytest.approx(1.0) and line.backlash == pytest.approx(0.1)
    assert line.degrees_of_freedom == 0
    assert line.u_per_command is line.u_backlash is line.residual_sd is None
    text = classic_text(line, "deg")
    assert text.startswith("1 deg per command\nbacklash 0.1 deg\n") and "not determined" in text


def test_rows_of_one_side_give_zero_reversal():
    rows = rows_with(2)
    forward = fit_line(rows, rows.side > 0)
    slope, offset = np.polyfit((rows.command - rows.command.mean())[rows.side > 0], rows.value[rows.side > 0], 1)
    np.testing.assert_allclose(forward.solution, [offset, slope, 0.0], rtol=1e-9, atol=1e-12)
    assert not forward.covariance[2].any() and np.all(np.diag(forward.covariance)[:2] > 0)
    moves = [AxisMove(k, 0, 0.0, c, "" if k else "forward") for k, c in enumerate((0.0, 1.0, 2.0, 4.0))]
    alone = classic_axis(rows_of(campaign(moves, [0.0, 1.1, 1.9, 4.0])))
    assert alone.backlash is alone.u_backlash is alone.iso230 is None


def test_runs_are_deviations_from_the_line_by_position_and_side():
    """Both ends are read from one side; missing runs are NaN."""
    rows = rows_with(3)
    left_out = np.zeros(len(rows.value), dtype=bool)
    left_out[np.flatnonzero((rows.command == 500.0) & (rows.side > 0))[0]] = True
    rows = rows.without(left_out)
    off = rows.value - (rows.line.offset + rows.line.slope * rows.command)
    deviations = position_runs(rows)
    assert deviations.position.tolist() == [0.0, 500.0, 1400.0]
    assert deviations.forward.shape == deviations.backward.shape == (3, 3)
    for row, position in enumerate(deviations.position):
        for table, side in ((deviations.forward, 1), (deviations.backward, -1)):
            wanted = off[(rows.command == position) & (rows.side == side)]
            np.testing.assert_allclose(table[row][~np.isnan(table[row])], wanted, atol=1e-12)
    assert np.isnan(deviations.forward).sum() == 1 and not np.isnan(deviations.backward).any()
    figures = positioning_of(rows)
    assert figures is not None
    assert figures.accuracy_deg == pytest.approx(figures_of(deviations.forward, deviations.backward).accuracy_deg)


def test_two_runs_from_either_side_are_enough_and_one_is_not():
    assert positioning_of(rows_with(4, cycles=2)) is not None
    assert positioning_of(rows_with(4, cycles=1)) is None
