"""Unrecorded homing directions as variants of a campaign."""

from dataclasses import replace

from support.small_campaign import small_campaign
from support.written_rows import move_row

from tvsbayes.instrument.campaign import Move
from tvsbayes.instrument.homing import ANYWHERE, homed, unrecorded
from tvsbayes.instrument.parameters import Prior
from tvsbayes.instrument.rig import RigTable


def moves(*first: tuple[str, str]) -> tuple[Move, ...]:
    """A segment of two moves for every pair of approaches."""
    rows = []
    for segment, (pan, tilt) in enumerate(first):
        rows.append(move_row(2 * segment, segment, 0.0, 0, 0, pan, tilt))
        rows.append(move_row(2 * segment + 1, segment, 0.0, 100, 0))
    return tuple(rows)


def test_no_way_of_homing_is_weighed_of_an_absolute_encoder_or_without_play():
    unknown, none = moves(("unknown", "unknown")), Prior(0.0, 0.0, "half-normal")
    assert unrecorded(unknown, RigTable()) == ("pan", "tilt")
    assert unrecorded(unknown, RigTable(absolute=("pan",))) == ("tilt",)
    tight = dict.fromkeys(("backlash_deg.tilt", "play_variation_deg.tilt"), none)
    assert unrecorded(unknown, RigTable(tight)) == ("pan",)


def test_only_unknown_approaches_are_replaced():
    campaign = replace(small_campaign(), moves=moves(("unknown", "up"), ("left", "unknown")))
    rows = homed(campaign, {"pan": "right", "tilt": ANYWHERE}).moves
    assert [m.pan_approach for m in rows] == ["right", "", "left", ""]
    assert [m.tilt_approach for m in rows] == ["up", "", "unknown", ""]
    assert homed(campaign, {"pan": ANYWHERE}) is campaign
