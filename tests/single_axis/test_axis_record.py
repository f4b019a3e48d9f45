"""Results of an axis in its folder: reused, or refused with the name of the damaged part."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from support.axes import PLACES, drawn, runs
from support.stored_fits import npz

from tvsbayes.errors import InputError
from tvsbayes.single_axis.axis_campaign import read_axis, write_axis
from tvsbayes.single_axis.axis_fit import fit_axis
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.axis_record import (
    keep_fit,
    results_for,
    summarise_axis,
)


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A folder with the results of a Laplace fit, and that fit."""
    folder = tmp_path_factory.mktemp("axis") / "a"
    write_axis(drawn(4, runs(2), backlash=AxisPrior(0.0, 0.1)).campaign, folder)
    fit = fit_axis(read_axis(folder), sampled=False)
    keep_fit(fit, summarise_axis(fit), folder / "results")
    return folder, fit


def test_stored_results_of_an_axis_are_reused(kept):
    folder, fit = kept
    messages = []
    results = results_for(read_axis(folder), notify=messages.append)
    assert not messages and results.fit.seed == fit.seed
    np.testing.assert_array_equal(results.fit.w, fit.w)


@pytest.fixture
def copied(kept, tmp_path):
    """A copy of the folder that a test may spoil."""
    return shutil.copytree(kept[0], tmp_path / "a")


def rewrite(folder, change) -> None:
    """Write `fit.json` as `change` leaves its keys."""
    file = folder / "results" / "fit.json"
    keys = json.loads(file.read_bytes())
    change(keys)
    file.write_text(json.dumps(keys))


@pytest.mark.parametrize(("estimator", "answer"), [("posterior", "accepted"), ("laplace", "laplace")])
def test_a_sample_without_an_answer_was_accepted(copied, estimator, answer):
    """0.2.0 wrote no `answer`: a sampled fit that had converged was an accepted one."""
    rewrite(copied, lambda keys: (keys.pop("answer"), keys.update(estimator=estimator)))
    assert results_for(read_axis(copied)).summary.answer == answer


def test_results_that_modelled_less_are_fitted_again(kept, copied, monkeypatch):
    """0.2.0 had no creep: its draws have fewer coordinates, which is no damage."""
    fit, messages = kept[1], []
    rewrite(copied, lambda keys: keys["parameters"].pop(fit.model.coordinates.names[-1]))
    monkeypatch.setattr("tvsbayes.single_axis.axis_record.fit_axis", lambda *_, **__: fit)
    assert results_for(read_axis(copied), notify=messages.append).fit is fit
    assert messages == ["results/ are of a version with another model of the axis: fitting first (weighted draws) ..."]


@pytest.mark.parametrize(
    "change",
    [
        lambda data, w, tie: data[: len(data) // 2],
        lambda data, w, tie: b"",
        lambda data, w, tie: npz(draws=w, **tie),
        lambda data, w, tie: npz(w=w[:, 1:], **tie),
        lambda data, w, tie: npz(w=w[:1], **tie),
        lambda data, w, tie: npz(w=np.where(w == w.max(), np.inf, w), **tie),
        lambda data, w, tie: npz(w=w.astype(str), **tie),
    ],
    ids=["cut", "empty", "without w", "narrow", "one draw", "infinite", "text"],
)
def test_damaged_draws_are_refused(kept, copied, change):
    file = copied / "results" / "draws.npz"
    tie = {"fit_id": json.loads((copied / "results" / "fit.json").read_bytes())["fit_id"]}
    file.write_bytes(change(file.read_bytes(), kept[1].w, tie))
    with pytest.raises(InputError) as caught:
        results_for(read_axis(copied))
    assert (caught.value.code, caught.value.file) == ("damaged-results", "results/draws.npz")
    assert "tvsbayes fit" in caught.value.remedy


@pytest.mark.parametrize("seed", ["7", -1, 1.5, True, None])
def test_a_damaged_seed_is_refused(copied, seed):
    rewrite(copied, lambda keys: keys.update(seed=seed))
    with pytest.raises(InputError) as caught:
        results_for(read_axis(copied))
    assert (caught.value.code, caught.value.column) == ("schema", "seed") and caught.value.remedy


def test_the_mean_play_of_the_positions_read_covers_the_truth_with_a_smaller_u():
    """Twelve simulated axes whose play varies by position: in 99 % of cases the RMS of twelve z is 0.51 to 1.54."""
    z, ratio = [], []
    for seed in range(100, 112):
        axis = drawn(seed, runs(2))
        summary = summarise_axis(fit_axis(axis.campaign, sampled=False))
        mean, read = (
            summary.effective_backlash,
            {m.command for m in axis.campaign.moves if abs(m.command) <= PLACES[-1]},
        )
        at = np.isin(axis.truth.command, list(read))
        true = axis.truth.parameters["backlash"] + axis.truth.play_variation[at].mean()
        z.append((mean.value - true) / mean.sd)
        ratio.append(mean.sd / summary.parameters["backlash"].sd)
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.55 and np.median(ratio) < 0.9
