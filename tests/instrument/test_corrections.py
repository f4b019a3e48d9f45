"""Corrections of whole tables: signs, rows, cameras, pixels, steps; the rest is unchanged."""

from __future__ import annotations

from dataclasses import replace

import pytest

from experiments.robustness.mistakes import relative
from tvsbayes.errors import InputError
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.campaign import Campaign, read_campaign
from tvsbayes.instrument.corrections import Correction, Shift, corrected, flipped_axis, shift_of


@pytest.fixture(scope="module")
def twin() -> Campaign:
    return read_campaign(shipped_data() / "twins" / "grid_twin")


def test_a_flip_changes_one_counter_and_leaves_the_approach(twin):
    result = corrected(twin.moves, twin.spots, Correction(flipped=("tilt",)))
    assert [m.tilt_steps for m in result.moves] == [-m.tilt_steps for m in twin.moves]
    assert tuple(replace(m, tilt_steps=-m.tilt_steps) for m in result.moves) == twin.moves
    assert result.spots == twin.spots and result.moves[0].tilt_approach == twin.moves[0].tilt_approach != ""
    assert "approaches stay" in result.changes[0]


def test_relative_steps_are_summed_again(twin):
    steps = relative(twin, None)
    assert corrected(steps.moves, steps.spots, Correction(relative=True)).moves == twin.moves
    second = replace(twin.moves[1], segment=1, pan_steps=7)
    first = replace(twin.moves[0], pan_steps=5)
    assert corrected((first, second), (), Correction(relative=True)).moves[1].pan_steps == 7


def test_looks_are_shifted_from_a_spot_on_and_none_is_lost(twin):
    result = corrected(twin.moves, twin.spots, Correction(shifts=(Shift(1, twin.spots[62].spot),)))
    assert [b.move - a.move for a, b in zip(twin.spots, result.spots, strict=True)] == [0] * 62 + [1] * 81 + [0]
    # There is no move after the last one.
    last = result.spots[-1]
    assert last.status == f"refused: move {len(twin.moves)} is not listed" and last.u_left_px is not None
    assert "1 left out" in result.changes[0]
    alone = corrected(None, twin.spots, Correction(shifts=(Shift(-1),)), count=len(twin.moves))
    assert alone.moves is None and [s.move for s in alone.spots] == [s.move - 1 for s in twin.spots]


def test_cameras_are_exchanged_with_their_sds_and_correlations(twin):
    spot = replace(twin.spots[0], su_left_px=0.3, ruv_right=0.5)
    once = corrected(None, (spot,), Correction(swapped=True)).spots
    assert (once[0].u_left_px, once[0].v_right_px) == (spot.u_right_px, spot.v_left_px)
    assert (once[0].su_right_px, once[0].ruv_left) == (0.3, 0.5)
    assert corrected(None, once, Correction(swapped=True)).spots == (spot,)


def test_pixels_are_counted_from_zero_and_empty_ones_stay_empty(twin):
    empty = replace(twin.spots[1], u_left_px=None, status="undetected")
    spots = corrected(None, (twin.spots[0], empty), Correction(pixels_from=1)).spots
    assert spots[0].u_left_px == twin.spots[0].u_left_px - 1 and spots[1].u_left_px is None


@pytest.mark.parametrize("text", ["pan", "pan_step", "TILT_STEPS", ""])
def test_other_counters_are_refused(text):
    with pytest.raises(InputError, match="allowed: pan_steps, tilt_steps"):
        flipped_axis(text)


def test_shifts_are_read(twin):
    assert [shift_of(text) for text in ("1", "-1@60", "+2")] == [Shift(1), Shift(-1, 60), Shift(2)]
    for text in ("0", "x", "1@", "1.5", "@3"):
        with pytest.raises(InputError, match="allowed: N or N@SPOT"):
            shift_of(text)
    with pytest.raises(InputError, match="no such spot"):
        corrected(twin.moves, twin.spots, Correction(shifts=(Shift(1, 10_000),)))


def test_a_table_without_the_columns_to_change_is_refused(twin):
    for correction in (Correction(flipped=("pan",)), Correction(relative=True)):
        with pytest.raises(InputError, match="no counters"):
            corrected(None, twin.spots, correction)
    for correction in (Correction(swapped=True), Correction(shifts=(Shift(1),)), Correction(pixels_from=1)):
        with pytest.raises(InputError, match="no looks"):
            corrected(twin.moves, None, correction)
