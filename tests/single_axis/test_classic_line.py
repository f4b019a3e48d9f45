"""The least-squares line of an axis, by hand."""

from __future__ import annotations

import numpy as np
import pytest
from support.axes import campaign, runs

from tvsbayes.report.axis_document import classic_text
from tvsbayes.single_axis.axis_campaign import AxisMove
from tvsbayes.single_axis.axis_rows import AxisRows, rows_of
from tvsbayes.single_axis.classic_line import classic_axis


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
