"""Commands that are angles of encoders: what `--encoders` writes, and what is said without it."""

from __future__ import annotations

import pytest

from tvsbayes.instrument.campaign import read_campaign
from tvsbayes.single_axis.axis_campaign import read_axis

ANGLES = [(0.0, 10.0), (40.0, 20.0), (80.0, 35.0), (120.0, 50.0), (80.0, 35.0), (40.0, 20.0)]


@pytest.fixture
def night(tmp_path):
    rows = "".join(f"{a},{e},{a + 0.01:.4f},{e - 0.02:.4f}\n" for a, e in ANGLES)
    (tmp_path / "night.csv").write_text(f"Encoder az (deg),Encoder el (deg),az (deg),el (deg)\n{rows}")
    return tmp_path / "night.csv"


@pytest.mark.parametrize(
    ("kind", "absolute", "plays"), [("output", ("pan", "tilt"), False), ("motor", ("pan", "tilt"), True)]
)
def test_absolute_encoders_of_a_head(ask, say, tmp_path, night, kind, absolute, plays):
    code, _ = ask("import", night, "--sightings", "--to", tmp_path / "head", "--encoders", kind, "--yes")
    rig = read_campaign(tmp_path / "head").rig
    assert code == 0 and tuple(rig.absolute) == absolute
    zero = {name: rig.priors[name].u == 0 for name in ("backlash_deg.pan", "play_variation_deg.tilt")}
    assert set(zero.values()) == {not plays}
    assert say("check", tmp_path / "head")[0] == 0


def test_counters_have_no_encoders(ask, tmp_path):
    rows = "".join(f"{round(100 * a)},{round(100 * e)},{a},{e}\n" for a, e in ANGLES)
    (tmp_path / "log.csv").write_text(f"pan steps,tilt steps,az (deg),el (deg)\n{rows}")
    stated = ("--sightings", "--to", tmp_path / "head", "--encoders", "motor", "--yes")
    code, document = ask("import", tmp_path / "log.csv", *stated)
    assert code == 2 and "leave --encoders out" in document["error"]["remedy"]


@pytest.mark.parametrize(("kind", "entries"), [("motor", set()), ("output", {"backlash", "play_variation"})])
def test_absolute_encoder_of_an_axis(ask, tmp_path, kind, entries):
    rows = "".join(f"{a},{2 * a + 0.01 * k}\n" for k, (a, _) in enumerate(ANGLES))
    (tmp_path / "log.csv").write_text(f"Target (deg),Measured (deg)\n{rows}")
    out = tmp_path / "axis"
    code, _ = ask("import", tmp_path / "log.csv", "--axis", "--to", out, "--encoders", kind, "--yes")
    campaign = read_axis(out)
    assert code == 0 and campaign.absolute
    assert {name for name, prior in campaign.stated.items() if prior.u == 0} >= entries
    assert bool(campaign.stated) == bool(entries)
