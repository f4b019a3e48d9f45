"""Counters against the motion of the spots: what is certain, what a plan cannot show, and which command mends it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from experiments.robustness.mistakes import MISTAKES, cut, cuts_of, sound_campaign, sound_rigs, turned
from tvsbayes.estimators.counter_pattern import hidden_deg
from tvsbayes.estimators.plausibility import implausible
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.campaign import Campaign, read_campaign
from tvsbayes.instrument.parameters import Prior
from tvsbayes.instrument.plan import PlanBuilder
from tvsbayes.instrument.rig import RigTable
from tvsbayes.twin.simulated_campaign import simulate

RNG = np.random.default_rng(4)


@pytest.fixture(scope="module")
def grid_twin() -> Campaign:
    return read_campaign(shipped_data() / "twins" / "grid_twin")


def with_prior(campaign: Campaign, **changed: Prior) -> Campaign:
    priors = {**campaign.rig.priors, **{name.replace("__", "."): prior for name, prior in changed.items()}}
    return replace(campaign, rig=replace(campaign.rig, priors=priors))


def test_sound_campaigns_have_no_finding_whole_or_cut():
    """One of each rig, from every protocol and plan; 500 in experiments/robustness/mistakes.md."""
    drawn = sound_rigs()
    for number in range(len(drawn)):
        name, campaign = sound_campaign(number, drawn)
        for looks in cuts_of(campaign, np.random.default_rng(number))[::4]:
            assert implausible(cut(campaign, looks)) == (), (name, number, looks)


def to_and_fro(mounted_rig, first: int, second: int, looks: int = 40):
    """Looks at two pan counters in turn, on one sheet; the axis comes to each from the other."""
    plan = PlanBuilder()
    plan.home()
    plan.place("d1")
    for number in range(looks):
        plan.move(pan=(first, second)[number % 2])
        plan.look()
    return simulate(mounted_rig, plan.steps, seed=5, home_approach=("left", "up"))


def test_counters_of_the_size_of_the_play_are_not_expected_to_show(mounted_rig):
    """38 steps are 2.3 deg, of which the stated play (0.5 deg, up to three of them) may take more than half.

    A play of 2.2 deg leaves hardly a motion: the spots follow nothing, and nothing is wrong.
    """
    loose = replace(mounted_rig, truth={**mounted_rig.truth, "backlash_deg.pan": Prior(2.2, 0.0, "half-normal")})
    near, far = to_and_fro(loose, 0, 38).campaign, to_and_fro(mounted_rig, 0, 200).campaign
    assert implausible(near) == ()
    assert implausible(far) == ()
    # Twelve degrees are expected to show: where nothing moved, something is wrong.
    stuck = to_and_fro(mounted_rig, 100, 101).campaign
    moved = tuple(replace(m, pan_steps=200 * (m.pan_steps > 100)) for m in stuck.moves)
    (finding,) = implausible(replace(stuck, moves=moved))
    assert (finding.code, finding.certain) == ("counter-lost", False)


@pytest.mark.parametrize(("axis", "words"), [("pan", "spots move right"), ("tilt", "spots move down")])
def test_a_wrong_sign_is_certain_and_mended_by_a_command(grid_twin, axis, words):
    (finding,) = implausible(turned(axis)(grid_twin, RNG))
    assert (finding.code, finding.certain, finding.file) == ("counter-sign", True, "moves.csv")
    assert finding.message.startswith(words) and "deg" in finding.message
    assert f"--flip {axis}_steps --yes`" in finding.remedy and "extrinsics" not in finding.remedy
    # Line 1 holds the names, move 0 stands in line 2; the message names both looks.
    move = grid_twin.moves[(finding.line or 0) - 2]
    assert f"at {-getattr(move, f'{axis}_steps')}:" in finding.message


def test_both_signs_may_be_cameras_upside_down(grid_twin):
    (finding,) = implausible(turned("tilt")(turned("pan")(grid_twin, RNG), RNG))
    assert finding.certain and "--flip pan_steps --flip tilt_steps" in finding.remedy
    assert "extrinsics.rotation_rad" in finding.remedy


def test_cameras_of_unknown_mounting_accuse_no_sign(grid_twin):
    """Three u of 0.6 rad are more than a quarter of a turn: the cameras may hang upside down."""
    wrong = turned("pan")(grid_twin, RNG)
    unknown = Prior(0.0, 0.6)
    assert implausible(with_prior(wrong, extrinsics__rotation_rad__x=unknown)) == ()


def test_few_stops_are_never_certain(grid_twin):
    wrong = turned("tilt")(turned("pan")(grid_twin, RNG), RNG)
    findings = {looks: [(f.code, f.certain) for f in implausible(cut(wrong, looks))] for looks in (7, 8, 10, 40)}
    assert findings[40] == [("counter-sign", True)] and findings[7] == []
    assert all(not certain for looks in (8, 10) for _, certain in findings[looks])


def test_a_sign_that_shifted_rows_would_show_too_names_both(mounted_rig):
    """Looks to and fro between two counters: the row before has the other counter."""
    campaign = to_and_fro(mounted_rig, 0, 200).campaign
    (finding,) = implausible(turned("pan")(campaign, RNG))
    assert (finding.code, finding.certain) == ("counter-sign", True)
    assert "--flip pan_steps" in finding.remedy and "--shift-moves 1" in finding.remedy


def test_shifted_rows_are_certain_and_mended_by_a_command(grid_twin):
    (early,) = implausible(MISTAKES["spots one move early"][0](grid_twin, RNG))
    assert (early.code, early.certain, early.file) == ("rows-shifted", True, "spots.csv")
    assert "--shift-moves 1 --yes`" in early.remedy
    (later,) = implausible(MISTAKES["a row of the log missing halfway"][0](grid_twin, RNG))
    assert later.certain and "--shift-moves -1@" in later.remedy
    spot = int(later.remedy.split("--shift-moves -1@")[1].split()[0])
    assert later.line == 2 + [s.spot for s in grid_twin.spots].index(spot)


def test_steps_of_each_move_are_certain(grid_twin):
    (finding,) = implausible(MISTAKES["relative counters"][0](grid_twin, RNG))
    assert finding.certain and "sum of pan_steps and tilt_steps" in finding.message and "--relative" in finding.remedy


def test_a_sheet_that_stands_askew_hides_no_motion(grid_twin):
    """Its depth grows with the counter: a column of depths would take the motion for its own."""
    one_sheet = tuple(s for s in grid_twin.spots if s.target == "d1")
    askew = replace(grid_twin, spots=one_sheet)
    assert implausible(askew) == ()
    (finding,) = implausible(turned("pan")(askew, RNG))
    assert finding.code == "counter-sign"


def test_what_play_and_scatter_hide_follows_the_priors():
    """Half of three scales of play (0.5 deg), three of gear errors (0.05 deg), scatter 0.04 exp(1.5) deg."""
    priors = RigTable().priors
    expected = np.linalg.norm([1.5 / 2, 0.15, 0.04 * np.exp(1.5)])
    assert hidden_deg(priors, "pan") == pytest.approx(expected, rel=1e-12)
    tight = {**priors, "backlash_deg.pan": Prior(0.0, 0.1, "half-normal")}
    assert hidden_deg(tight, "pan") < hidden_deg(tight, "tilt") == hidden_deg(priors, "tilt")
