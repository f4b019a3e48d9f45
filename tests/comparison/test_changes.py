"""Two campaigns compared: nothing changes from itself, a changed gear is named."""

from __future__ import annotations

import datetime
import json
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from msgspec import structs
from support.varying_gears import perfect_rig

from tvsbayes.comparison.changes import compare
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.report.command_text import changes_text
from tvsbayes.twin.simulated_campaign import simulate


def test_a_calibration_has_not_changed_from_itself(mixed_fit):
    same = compare(mixed_fit, mixed_fit)
    assert same.shared_cameras and same.verdict == "no significant change" and same.days is None
    # At one pose, not along the lines through either campaign's looks; JSON keeps its names.
    local = np.asarray(mixed_fit.mode.local_deg_per_step)
    np.testing.assert_allclose([c.first for c in same.changes[:4]], local, rtol=1e-12)
    assert [c.quantity for c in same.changes[:2]] == ["effective_deg_per_step.left", "effective_deg_per_step.right"]
    assert "local_deg_per_step.left" in changes_text(same) and "effective" not in changes_text(same)
    # The largest u may hide most: here that of the second ratio, ten times as large.
    worst = structs.replace(same.changes[1], u=10 * same.changes[1].u)
    less = structs.replace(same, changes=(same.changes[0], worst, *same.changes[2:]))
    assert f"may have changed by up to {100 * same.limit * worst.u / worst.first:.2g} % undetected" in changes_text(
        less
    )
    for change in same.changes:
        assert change.difference == 0.0 and change.normalised == 0.0 and change.u > 0
    # A second pair of cameras: nothing is shared, every u grows.
    stereo = replace(
        mixed_fit.campaign.stereo, parameter_covariance=mixed_fit.campaign.stereo.parameter_covariance * 1.01
    )
    apart = compare(mixed_fit, replace(mixed_fit, campaign=replace(mixed_fit.campaign, stereo=stereo)))
    assert not apart.shared_cameras
    for one, other in zip(same.changes[:4], apart.changes[:4], strict=True):
        assert other.u > 1.05 * one.u


def test_what_both_hold_fixed_is_compared_as_stated(mixed_fit):
    """A backlash fixed in both fits has no u: equal statements are no change, others are one; JSON takes both."""
    row = list(mixed_fit.names).index("backlash_deg.tilt")
    fits = []
    for value in (0.1, 0.1, 0.2):
        stated, u, kind = (np.array(x) for x in (mixed_fit.space.value, mixed_fit.space.u, mixed_fit.space.kind))
        stated[row], u[row], kind[row] = value, 0.0, 0
        with jax.enable_x64(True):
            space = replace(mixed_fit.space, value=jnp.asarray(stated), u=jnp.asarray(u), kind=jnp.asarray(kind))
        physical = [np.array(part.physical) for part in (mixed_fit.mode, mixed_fit.draws)]
        for values in physical:
            values[..., row] = value
        mode = eqx.tree_at(lambda d: d.physical, mixed_fit.mode, physical[0])
        draws = eqx.tree_at(lambda d: d.physical, mixed_fit.draws, physical[1])
        fits.append(replace(mixed_fit, space=space, mode=mode, draws=draws))
    same, other = (compare(fits[0], second).changes[-1] for second in fits[1:])
    assert (same.normalised, same.significant) == (None, False)
    assert (other.normalised, other.significant) == (None, True)
    json.dumps(compare(fits[0], fits[2]).as_json(), allow_nan=False)


@pytest.mark.thorough
def test_a_changed_gear_is_named(mounted_rig):
    """The same rig with 2 % more degrees per pan step, measured again 30 days later; gears known to be perfect."""
    mounted_rig = perfect_rig(mounted_rig)
    protocol = four_point_protocol(repeats=6, steps=(100, 200))
    first = simulate(mounted_rig, protocol, seed=3)
    parameters = dict(first.truth.parameters)
    parameters["degrees_per_step.pan"] *= 1.02
    second = simulate(mounted_rig, protocol, seed=4, truth=replace(first.truth, parameters=parameters)).campaign
    created = datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)
    dated = [
        replace(campaign, header={**campaign.header, "created": created + datetime.timedelta(days=30 * k)})
        for k, campaign in enumerate((first.campaign, second))
    ]
    comparison = compare(*map(fit, dated))
    moved = {c.quantity for c in comparison.changes if c.significant}
    assert moved == {"effective_deg_per_step.left", "effective_deg_per_step.right"}
    assert comparison.days == 30.0 and comparison.verdict.startswith("changed: local_deg_per_step.left by +")
    for change in comparison.changes[:2]:
        assert change.difference == pytest.approx(0.02 * change.first, abs=4 * change.u)
