"""Files of version 0.1.0 (tests/data/of-0.1.0): read unchanged, or refused with a remedy."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from support.refusals import refusal

import tvsbayes
from tvsbayes.acquisition.journal_check import verify
from tvsbayes.instrument.campaign import input_hashes, read_campaign
from tvsbayes.pipeline import StoredOrFitted
from tvsbayes.posterior.chain import stored_chain
from tvsbayes.results.comparison_record import stored_hold_out
from tvsbayes.results.fit_record import read_fit
from tvsbayes.twin.true_rig import read_truth

OLD = Path(__file__).resolve().parents[1] / "data" / "of-0.1.0"
AS_PRINTED = 1e-12
"""Relative, of numbers that passed through fifteen digits or a hundred operations."""
XYZ_MM, VARIANCES_MM2 = (472.08922526253093, 72.1765596120374, 10.956845780522247), (1.46394, 0.747207, 30.2042)
"""What 0.1.0 said of counters 20 and 5 and a reading of 70 deg; variances to six digits."""


def test_an_old_campaign_is_read_unchanged():
    """Hashes included: digests of 0.1.0 stay those of the same moves, looks and cameras."""
    campaign = read_campaign(OLD / "campaign")
    provenance = read_fit(OLD / "campaign" / "results" / "fit.json").provenance
    now = input_hashes(campaign)
    assert (len(campaign.moves), len(campaign.spots)) == (18, 28)
    assert {name for name in now if provenance.inputs[name] == now[name]} == {"moves", "spots", "stereo"}
    assert provenance.versions["tvsbayes"] == "0.1.0"
    truth = read_truth(OLD / "campaign" / "truth.json", campaign.stereo)
    assert truth.parameters["backlash_deg.pan"] > 0


@pytest.mark.parametrize("name", ["campaign", "calibration.json"])
def test_an_old_calibration_gives_the_same_points(name):
    calibration = tvsbayes.load_calibration(OLD / name)
    point = calibration.locate(20, 5, 70.0)
    np.testing.assert_allclose(point.xyz_mm, XYZ_MM, rtol=AS_PRINTED)
    np.testing.assert_allclose(np.diag(point.covariance_mm2), VARIANCES_MM2, rtol=1e-5)
    steps = calibration.steps_for([600.0, 60.0, 10.0])
    assert (steps.pan_steps, steps.tilt_steps, steps.via_pan_steps, steps.via_tilt_steps) == (1, 0, -13, -19)
    assert not calibration.gears.size, "0.1.0 knew no errors of the gears"


def test_old_results_are_read_and_the_reason_of_a_new_fit_is_given(monkeypatch):
    monkeypatch.setattr("tvsbayes.results.store.version_of", lambda _: "0.2.0")
    monkeypatch.setattr("tvsbayes.pipeline.compile_for", lambda _: None)
    monkeypatch.setattr("tvsbayes.estimators.joint_fit.fit", lambda *_, **__: SimpleNamespace(converged=True))
    messages: list[str] = []
    assert StoredOrFitted(read_campaign(OLD / "campaign"), messages.append).fit.converged
    assert "results/ are of tvsbayes 0.1.0, with another model of the rig" in messages[0]
    record = read_fit(OLD / "campaign" / "results" / "fit.json")
    assert record.summary.converged and record.summary.effective["left"].value == pytest.approx(0.0642, abs=1e-4)


def test_a_comparison_belongs_to_its_fit():
    campaign = read_campaign(OLD / "campaign")
    inputs = read_fit(OLD / "campaign" / "results" / "fit.json").provenance.inputs
    assert stored_hold_out(campaign, inputs) is not None
    assert stored_hold_out(campaign, input_hashes(campaign)) is None


def test_a_chain_is_refused_by_its_format():
    error = refusal(lambda: stored_chain(OLD / "chain.npz", None, 1))
    assert "another version of tvsbayes: tvsbayes-chain/4" in error.message and "run without --resume" in error.remedy


def test_an_interrupted_old_run_is_resumed(tmp_path, say):
    """The journal of 0.1.0 identifies its rig by one SHA-256 of a text without the errors of the gears."""
    run = shutil.copytree(OLD / "run", tmp_path / "run")
    verification = verify(run)
    assert verification.records == 61 and verification.stopped is None
    options = ("--simulate", "--seed", "3", "--centroids", "--resume")
    code, _, err = say("acquire", OLD / "rig.toml", OLD / "plan.csv", run, *options)
    assert code == 0, err
    assert len(read_campaign(run).spots) >= 28
    shutil.copytree(OLD / "run", tmp_path / "other")
    other = (OLD / "rig.toml").read_text().replace("baseline_mm = { value = 200.0", "baseline_mm = { value = 201.0")
    (tmp_path / "rig.toml").write_text(other)
    shutil.copy(OLD / "stereo.json", tmp_path)
    code, _, err = say("acquire", tmp_path / "rig.toml", OLD / "plan.csv", tmp_path / "other", *options)
    assert code == 2 and "another rig" in err
