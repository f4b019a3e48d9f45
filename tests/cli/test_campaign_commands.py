"""`check`, `simulate`, `new`, `demo`: documents and exit codes."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.commands import (
    DATA,
    MOUNTED,
    PAPER_TWIN,
    assert_error,
    two_sheets,
)

from tvsbayes.cli import campaign_commands
from tvsbayes.cli.campaign_commands import _sampled
from tvsbayes.cli.main import run
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import read_campaign, write_campaign
from tvsbayes.instrument.plan import write_plan

pytestmark = pytest.mark.usefixtures("own_compilation_cache")


def test_check_names_a_file_given_in_place_of_a_rig(ask, say, tmp_path):
    plan = MOUNTED / "grid.csv"
    assert ask("new", tmp_path / "axis", "--axis")[0] == 0
    for other, words, remedy in (
        (tmp_path / "axis", "is an axis folder", f"leave out PLAN: tvsbayes check {tmp_path / 'axis'}"),
        (MOUNTED, "is a folder", f"name the rig file in it: {MOUNTED / 'rig.toml'}"),
        (PAPER_TWIN, "is a folder", "name a rig file, or leave out PLAN"),
        (plan, "is no .toml file", "give the rig file first, then the plan"),
        (tmp_path / "nowhere", "found no such file", "create it"),
    ):
        code, _, log = say("check", other, plan)
        printed = " ".join(log.split())
        assert code == 2 and words in printed and remedy in printed, printed


def test_upper_case_endings_are_recognised(ask, tmp_path):
    for name, copied in (("rig.toml", "RIG.TOML"), ("stereo.json", "stereo.json"), ("paper.csv", "PAPER.CSV")):
        (tmp_path / copied).write_bytes((MOUNTED / name).read_bytes())
    assert ask("check", tmp_path / "RIG.TOML")[1]["kind"] == "rig"
    assert ask("check", tmp_path / "PAPER.CSV")[1]["kind"] == "plan"


def test_check_warns_without_failing(ask, say, grid_campaign, tmp_path):
    """Weak directions alone are exit 0."""
    stereo = replace(grid_campaign.stereo, parameter_covariance=np.zeros((24, 24)))
    write_campaign(replace(grid_campaign, stereo=stereo), tmp_path / "exact")
    code, document = ask("check", tmp_path / "exact")
    assert code == 0
    assert len(document["warnings"]) == 1
    assert "covariance is zero" in document["warnings"][0]
    assert "warning: the stereo covariance is zero" in say("check", tmp_path / "exact")[1]


def test_simulate_writes_a_campaign_reproducibly(ask, tmp_path):
    plan = tmp_path / "plan.csv"
    write_plan(two_sheets((100, 30)), plan)
    documents = []
    for name, seed in (("a", 7), ("b", 7), ("c", 8)):
        code, document = ask("simulate", MOUNTED / "rig.toml", plan, tmp_path / name, "--aperture", "--seed", seed)
        assert code == 0
        documents.append(document)
    assert documents[0] == {"campaign": str(tmp_path / "a"), "moves": 2, "spots": 8, "ok": 8, "seed": 7}
    names = {"campaign.toml", "stereo.json", "moves.csv", "spots.csv", "truth.json"}
    assert {path.name for path in (tmp_path / "a").iterdir()} == names
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert (tmp_path / "a" / "spots.csv").read_bytes() != (tmp_path / "c" / "spots.csv").read_bytes()
    assert all(spot.aperture_deg is not None for spot in read_campaign(tmp_path / "a").spots)
    code, document = ask("simulate", MOUNTED / "rig.toml", plan, tmp_path / "a")
    assert code == 2
    assert_error(document, "occupied")


def test_simulate_can_leave_out_the_homing_sides(ask, tmp_path):
    """The campaign has no sides; truth.json has them, the errors of the gears and both kinds of ratios."""
    plan = tmp_path / "plan.csv"
    write_plan(two_sheets((100, 30)), plan)
    assert ask("simulate", MOUNTED / "rig.toml", plan, tmp_path / "a", "--unrecorded-sides", "--seed", 7)[0] == 0
    assert {(m.pan_approach, m.tilt_approach) for m in read_campaign(tmp_path / "a").moves[:1]} == {("unknown",) * 2}
    truth = json.loads((tmp_path / "a" / "truth.json").read_text())
    assert truth["homing_side"]["pan"] in ("left", "right", "unknown")
    assert {axis: table["steps"] for axis, table in truth["gear_error"].items()} == {"pan": [0, 100], "tilt": [0, 30]}
    # Through two counters 1.8 deg apart the line has the difference of two errors in it, 0.05 deg of scale: five sds.
    assert truth["effective_deg_per_step"] == pytest.approx(truth["local_deg_per_step"], rel=5 * 0.05 * 2**0.5 / 1.8)


@pytest.fixture(scope="module")
def demonstrated(own_compilation_cache) -> SimpleNamespace:
    """Results of `demo`: its document, its text, and the summary of its fit."""
    fitted, ended = [], []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(campaign_commands, "_sampled", lambda *args: fitted.append(_sampled(*args)) or fitted[0])
        patch.setattr(campaign_commands, "finish", lambda *args: ended.append(args))
        assert run(["demo"]) == 0
    ((document, text, as_json, error),) = ended
    assert not as_json and error is None
    return SimpleNamespace(document=json.loads(json.dumps(document)), text=text, summary=fitted[0])


@pytest.mark.thorough
def test_demo_shows_classic_and_joint_beside_the_truth(demonstrated):
    document = demonstrated.document
    assert set(document) == {"classic", "fit", "truth"}
    fit, truth = document["fit"], document["truth"]
    intervals = {d: fit["effective_deg_per_step"][d]["interval95"] for d in DIRECTIONS}
    names = ("backlash_deg.pan", "backlash_deg.tilt", "effective_mirror_offset_mm")
    intervals |= {name: fit["parameters"][name]["interval95"] for name in names}
    assert set(truth) == set(intervals)
    for name, (low, high) in intervals.items():
        assert low < truth[name] < high, name
    # The claim of the demo: type A intervals of the classic estimator miss the truth.
    for direction, result in document["classic"]["directions"].items():
        low, high = result["interval95_type_a"]
        assert not low < truth[direction] < high
    # The joint model predicts the result of the classic estimator within five sds of both.
    for direction, result in document["classic"]["directions"].items():
        predicted = fit["classic_predicted_deg_per_step"][direction]
        sd = np.hypot(predicted["sd"], result["u_type_a_deg_per_step"])
        assert abs(predicted["value"] - result["mean_deg_per_step"]) < 5 * sd


@pytest.mark.thorough
def test_readme_shows_the_output_of_the_demo(demonstrated):
    """Same lines; each number within a tenth of its uncertainty (another processor rounds differently)."""
    readme = DATA.parent / "README.md"
    if not readme.is_file():
        pytest.skip("the README is not part of an installed package")
    shown = readme.read_text(encoding="utf-8").split("```text\n")[1].split("```")[0]
    out = demonstrated.text
    number = re.compile(r"(-?\d+\.\d+)(?:\((\d+\.?\d*)\))?")
    assert [re.sub(r" +", " ", number.sub("#", line)) for line in out.splitlines()] == [
        re.sub(r" +", " ", number.sub("#", line)) for line in shown.splitlines()
    ]
    pairs = list(zip(number.finditer(out), number.finditer(shown), strict=True))
    assert len(pairs) == 4 * 3 + 3 * 2
    for (value, digits), (value_shown, digits_shown) in ((a.groups(), b.groups()) for a, b in pairs):
        unit = 10.0 ** -len(value.partition(".")[2])
        u = unit if digits is None else float(digits) * (1.0 if "." in digits else unit)
        assert abs(float(value) - float(value_shown)) <= max(0.1 * u, 1.01 * unit)
        assert (digits is None) == (digits_shown is None)
