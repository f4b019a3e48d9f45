"""Results: complete, and reused by the commands that need them."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from msgspec import structs
from support.small_results import small_draws, small_record, whole_summary
from support.waits import check_forward, doings

import tvsbayes
from tvsbayes.cli.app import report_line
from tvsbayes.errors import InputError
from tvsbayes.estimators import joint_fit
from tvsbayes.instrument.campaign import input_hashes, read_campaign
from tvsbayes.instrument.model_choice import ModelChoice
from tvsbayes.model.compiled import Traces
from tvsbayes.pipeline import FITTING, SUMMARISING, StoredOrFitted, calibrate, compile_for
from tvsbayes.results.stored_draws import write_results

pytestmark = pytest.mark.usefixtures("own_compilation_cache", "each_fitted_once")


@pytest.mark.thorough
def test_stored_results_are_reused(grid_folder, monkeypatch):
    """`compare` and `plan --given` start from results/: the same model, mode and draws, no second fit."""
    campaign = read_campaign(grid_folder)
    assert StoredOrFitted(campaign).stored_fit is None
    results = tvsbayes.calibrate(campaign, grid_folder / "results", model=ModelChoice(per_axis=True), sampled=False)
    fresh = results.fit
    back = StoredOrFitted(campaign).stored_fit
    for name in ("z", "covariance", "draws_z", "free", "reference_pose_rad"):
        np.testing.assert_array_equal(getattr(back, name), getattr(fresh, name))
    np.testing.assert_array_equal(back.draws.effective_deg_per_step, fresh.draws.effective_deg_per_step)
    assert (back.converged, back.log_density, back.chi2) == (True, fresh.log_density, fresh.chi2)
    monkeypatch.setattr("tvsbayes.estimators.joint_fit.fit", None)
    monkeypatch.setattr("tvsbayes.studies.study_job.fit", None)
    assert StoredOrFitted(campaign, report_line).fit.converged
    (grid_folder / "moves.csv").write_bytes((grid_folder / "moves.csv").read_bytes() + b"\n")
    # A blank line changes nothing that was measured.
    assert StoredOrFitted(read_campaign(grid_folder)).stored_fit is not None
    spots = (grid_folder / "spots.csv").read_text().replace("d2", "d3")
    (grid_folder / "spots.csv").write_text(spots)
    assert StoredOrFitted(read_campaign(grid_folder)).stored_fit is None


def test_the_reason_for_a_new_fit_is_printed(grid_folder, monkeypatch):
    """A changed version is distinguished from changed data."""
    messages = []
    monkeypatch.setattr("tvsbayes.pipeline.compile_for", lambda _: None)
    monkeypatch.setattr("tvsbayes.estimators.joint_fit.fit", lambda *_, **__: SimpleNamespace(converged=True))

    def why() -> str:
        messages.clear()
        _ = StoredOrFitted(read_campaign(grid_folder), messages.append).fit
        return messages[0].removesuffix(": fitting first (Laplace approximation) ...")

    assert why() == "there are no results/ yet"
    (grid_folder / "results").mkdir()
    (grid_folder / "results" / "chain.npz").touch()
    assert why() == "results/ hold only an interrupted chain (`tvsbayes fit --resume`)"
    (grid_folder / "results" / "chain.npz").unlink()
    path, campaign = grid_folder / "results" / "fit.json", read_campaign(grid_folder)
    record = small_record(whole_summary(), seed=3)

    def keep(converged: bool, version: str, **others: str) -> None:
        provenance = structs.replace(record.provenance, inputs=input_hashes(campaign) | others)
        provenance = structs.replace(provenance, versions=provenance.versions | {"tvsbayes": version})
        summary = structs.replace(whole_summary(), converged=converged)
        write_results(path.parent, replace(record, summary=summary, provenance=provenance), small_draws())

    now = record.provenance.versions["tvsbayes"]
    for case, reason in (
        ((True, now, {"moves": "0" * 64, "rig": "0" * 64}), "results/ are of other moves.csv, [rig]"),
        ((True, now, {"rig": "0" * 64}), "results/ are of other [rig]"),
        (
            (True, "0.0.9", {"rig": "0" * 64}),
            "results/ are of tvsbayes 0.0.9, with another model of the rig, or of another [rig]",
        ),
        ((False, now, {}), "results/ are of a fit that did not converge"),
        ((True, "0.0.9", {}), "results/ are of tvsbayes 0.0.9, with another model of the rig"),
        ((True, now, {}), "results/ lack what this command needs"),
    ):
        keep(case[0], case[1], **case[2])
        assert why() == reason
    (path.parent / "draws.npz").unlink()
    assert why() == "results/ lack draws.npz"


def test_the_first_compilation_is_announced(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("TVSBAYES_CACHE", str(tmp_path))
    monkeypatch.setattr(Traces, "used", None)
    monkeypatch.setattr(jax.config, "update", lambda *_: None)
    monkeypatch.setattr("tvsbayes.pipeline._SHOWN_LINES", set())
    compile_for(report_line)
    assert capsys.readouterr().err == "", "progress is for terminals"
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    compile_for(report_line)
    assert "first run" in capsys.readouterr().err
    compile_for(report_line)
    assert capsys.readouterr().err == "", "several steps of a command ask for the cache"
    monkeypatch.setattr("tvsbayes.pipeline._SHOWN_LINES", set())
    (tmp_path / "compiled" / "jit_fit").touch()
    compile_for(report_line)
    assert capsys.readouterr().err == ""


def test_results_from_python_are_those_of_the_command(ask, grid_folder, tmp_path, monkeypatch):
    """Document and draws are equal except for the command; without a folder nothing is written.

    The fit is that of another seed, which other tests share; the seed that it is asked for is looked at.
    """
    fit, seeds = joint_fit.fit, []
    monkeypatch.setattr(joint_fit, "fit", lambda *args, seed, **rest: seeds.append(seed) or fit(*args, seed=0, **rest))
    assert ask("fit", grid_folder, "--no-sample", "--seed", 4)[0] == 0
    campaign = read_campaign(grid_folder)
    states = []
    results = tvsbayes.calibrate(campaign, str(tmp_path / "mine"), sampled=False, seed=4, progress=states.append)
    check_forward(states)
    assert doings(states) == [FITTING, SUMMARISING]
    assert set(results.files) == {"draws", "fit"} and results.error is None
    by_command, mine = (tvsbayes.read_fit(f / "fit.json") for f in (grid_folder / "results", tmp_path / "mine"))
    assert {**by_command.as_json(), "command": ""} == {**mine.as_json(), "command": ""}
    assert mine.as_json() == json.loads(json.dumps(results.record.as_json()))
    assert mine.evidence.budgets and mine.evidence.positioning and mine.digest == by_command.digest
    with np.load(grid_folder / "results" / "draws.npz") as one, np.load(tmp_path / "mine" / "draws.npz") as other:
        assert sorted(one) == sorted(other)
        for name in one:
            np.testing.assert_array_equal(one[name], other[name])
    assert tvsbayes.calibrate(campaign, sampled=False, seed=4).files == {} and seeds == [4, 4, 4]
    assert mine.provenance.seed == 4


@pytest.mark.parametrize(
    "call",
    [lambda c: calibrate(c, c.path / "results"), lambda c: StoredOrFitted(c).reported],
    ids=["calibrate", "record"],
)
def test_an_unwritable_results_folder_is_refused_before_the_fit(grid_folder, monkeypatch, call):
    """As for an immutable folder or a read-only disk."""
    monkeypatch.setattr("tvsbayes.estimators.joint_fit.fit", None)
    (grid_folder / "results").touch()
    with pytest.raises(InputError) as refused:
        call(read_campaign(grid_folder))
    assert refused.value.code == "write"
