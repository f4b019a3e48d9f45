"""A head whose tilt never moves: what its sightings say is said, what they do not say is named, nothing else moves."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from support.commands import assert_error

from tvsbayes.errors import NothingToEstimate
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.estimators.plausibility import check_campaign
from tvsbayes.head.pointing_model import pointing_model
from tvsbayes.instrument.campaign import Campaign, Move, write_campaign
from tvsbayes.instrument.mechanisms import SIGHTING_HEAD
from tvsbayes.instrument.plan import read_plan
from tvsbayes.instrument.rig import RigTable
from tvsbayes.instrument.sightings import Sighting
from tvsbayes.pipeline import calibrate
from tvsbayes.report.head_document import pointing_table

RATIO, PLAY, SD = 0.06, 0.1, 0.004
COUNTERS = (-400, 100, 350, -150, 220, -300, 0, 300, -50, 150, -250, 50)


def head(seed: int = 3, moving: str = "pan") -> Campaign:
    """Sightings of a plain head, two rounds through the counters of one axis."""
    rng, moves, sightings, seen = np.random.default_rng(seed), [], [], None
    for k, counter in enumerate((0, *COUNTERS, *COUNTERS[::-1])):
        angle = RATIO * counter
        seen = angle - PLAY / 2 if seen is None else float(np.clip(seen, angle - PLAY / 2, angle + PLAY / 2))
        at = {"pan_steps": counter if moving == "pan" else 0, "tilt_steps": counter if moving == "tilt" else 0}
        came = {"pan_approach": "left", "tilt_approach": "up"} if not k else {}
        moves.append(Move(move=k, segment=0, time_s=20.0 * k, **at, **came))
        still = -PLAY / 2
        azimuth, elevation = (seen, still) if moving == "pan" else (still, seen)
        off = SD * rng.standard_normal(2)
        sighting = Sighting(
            sighting=k, move=k, azimuth_deg=azimuth + off[0], elevation_deg=elevation + off[1], u_deg=SD
        )
        sightings.append(sighting)
    return Campaign(tuple(moves), tuple(sightings), None, RigTable(mechanism=SIGHTING_HEAD))


@pytest.mark.parametrize("moving", ["pan", "tilt"])
def test_least_squares_hold_what_one_axis_does_not_determine(moving):
    model = pointing_model(head(moving=moving))
    still = "tilt" if moving == "pan" else "pan"
    assert f"degrees_per_step.{still}" in model.undetermined and np.all(np.isfinite(model.standard_error))
    ratio = model.value[model.names.index(f"degrees_per_step.{moving}")]
    # Errors of half a play either way turn a line by at most 1.5 plays over the travel (steps at its middle).
    assert ratio == pytest.approx(RATIO, abs=1.5 * PLAY / 750)
    assert model.rms_deg < PLAY
    document = json.loads(json.dumps(model.as_json(), allow_nan=False))
    assert document["undetermined"].keys() == set(model.undetermined) and not document["terms"].keys() & set(
        model.undetermined
    )
    assert "not determined" in pointing_table(model).text()


def test_two_axes_determine_every_term():
    """The same rule drops nothing that sightings over both axes tell apart."""
    both = head()
    moves = tuple(replace(m, tilt_steps=37 * (m.move % 5)) for m in both.moves)
    sightings = tuple(replace(s, elevation_deg=s.elevation_deg + RATIO * moves[s.move].tilt_steps) for s in both.spots)
    assert pointing_model(replace(both, moves=moves, spots=sightings)).undetermined == ()


def test_check_and_fit_speak_of_sightings():
    few = replace(head(), spots=head().spots[:3])
    with pytest.raises(NothingToEstimate, match=r"sightings\.csv: 3 sightings can be used") as refused:
        fit(few)
    assert refused.value.file == "sightings.csv" and "detect" not in (refused.value.remedy or "")
    assert any("the tilt axis was seen at one counter only" in text for text in check_campaign(head()).warnings)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """Folder of such a head with accepted results."""
    folder = tmp_path_factory.mktemp("unmoved") / "head"
    campaign = head()
    write_campaign(campaign, folder)
    results = calibrate(replace(campaign, path=folder), folder / "results", tier="importance")
    assert results.record.summary.answer == "accepted"
    assert results.record.summary.effective["up"] is None
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("purpose", [["--verify"], ["--watch", "--minutes", 1]])
def test_plans_leave_the_unmoved_axis_where_it_is(ask, fitted, tmp_path, purpose):
    code, _ = ask("plan", fitted, *purpose, "-o", tmp_path / "looks.csv")
    assert code == 0
    steps = read_plan(tmp_path / "looks.csv", SIGHTING_HEAD)
    assert {step.tilt_steps for step in steps if step.action in ("home", "move")} == {0}
    assert len({step.pan_steps for step in steps if step.action == "move"}) >= 2


@pytest.mark.slow
def test_every_command_answers(ask, fitted, tmp_path):
    write_campaign(head(seed=9), tmp_path / "fresh")
    assert ask("report", fitted)[0] == 0
    code, document = ask("compare", fitted)
    assert code == 0 and "degrees_per_step.tilt" in document["undetermined"]
    code, document = ask("verify", fitted, tmp_path / "fresh")
    assert (code, document["verdict"]) == (0, "KEPT")
    # Of the tilt's ratio nothing is known: the looks cannot tell whether it changed.
    code, document = ask("watch", fitted, tmp_path / "fresh")
    assert code == 3 and {c["what"]: c["power"] for c in document["changes"]}["ratio: tilt"] < 0.1


@pytest.mark.slow
def test_looks_of_the_campaign_confirm_nothing(ask, fitted, tmp_path):
    """Neither the folder itself nor a part of it under another name."""
    write_campaign(replace(head(), spots=head().spots[4:]), tmp_path / "part")
    for command in ("watch", "compare", "verify"):
        for looks in (fitted, tmp_path / "part"):
            code, document = ask(command, fitted, looks)
            assert code == 2, command
            assert_error(document, "same-looks")
