"""Corrections of commands: by side, between lines, beyond the ends, rounded."""

from __future__ import annotations

import numpy as np

from tvsbayes.compensation.correction import Correction, cycles
from tvsbayes.single_axis.axis_campaign import AxisMove

COARSE = Correction(np.array([0.0, 10.0]), np.array([0.2, 0.4]), np.array([-0.2, 0.0]))


def test_both_sides_are_linear_between_lines_and_constant_beyond():
    command, side = np.array([5.0, 5.0, 5.0, -3.0, 12.0]), np.array([1, -1, 0, 1, -1])
    # Exact in binary up to rounding of a few sums.
    np.testing.assert_allclose(COARSE.sent(command, side), [5.3, 4.9, 5.1, -2.8, 12.0], atol=1e-12)


def test_factors_of_the_common_part_and_of_the_play():
    command, side = np.array([5.0, 5.0]), np.array([1, -1])
    np.testing.assert_allclose(COARSE.sent(command, side, 0.0, 0.0), [5.0, 5.0], atol=1e-12)
    np.testing.assert_allclose(COARSE.sent(command, side, 2.0, 2.0), [5.6, 4.8], atol=1e-12)
    np.testing.assert_allclose(COARSE.sent(command, side, 1.0, -1.0), [4.9, 5.3], atol=1e-12)


def test_commands_are_rounded_to_the_resolution():
    rounded = Correction(COARSE.command, COARSE.forward, COARSE.backward, 0.25)
    np.testing.assert_allclose(rounded.sent(np.array([5.0]), np.array([1])), [5.25], atol=1e-12)


def test_moves_get_the_correction_of_their_direction():
    moves = [AxisMove(0, 0, 0.0, 0.0, "forward"), AxisMove(1, 0, 1.0, 10.0), AxisMove(2, 0, 2.0, 0.0)]
    assert np.allclose([m.command for m in COARSE.moved(moves)], [0.2, 10.4, -0.2], atol=1e-12)


def test_every_command_is_read_once_from_each_side():
    run = cycles(np.array([0.0, 1.0, 2.0]), 0.5, 2.0, 2)
    assert sorted(zip(run.index.tolist(), run.side.tolist(), strict=True)) == [
        (k, s) for k in range(3) for s in (-1, 1)
    ]
    at = [run.moves[k].command for k in run.read]
    assert at == [[0.0, 1.0, 2.0][k] for k in run.index]
    # From the stated side, and twice over the whole travel within the time.
    steps = np.diff([m.command for m in run.moves])
    assert all(np.sign(steps[k - 1]) == side for k, side in zip(run.read, run.side, strict=True))
    assert run.moves[-1].time_s == 7200.0 and max(at) == 2.0
