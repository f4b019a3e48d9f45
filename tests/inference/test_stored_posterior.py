"""Draws of `results/`, read back without a model: of a scanner, of an axis, or refused."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from msgspec import structs
from support.axes import drawn, runs
from support.small_results import small_draws, small_record, whole_summary
from support.stored_fits import edit_fit

from tvsbayes.errors import InputError, NotConverged
from tvsbayes.pipeline import load_posterior
from tvsbayes.results.stored_draws import write_results
from tvsbayes.single_axis.axis_campaign import read_axis, write_axis
from tvsbayes.single_axis.axis_fit import fit_axis
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.axis_record import keep_fit, summarise_axis

ROUNDING = 1e-12
"""Of sums over a thousand draws, relative."""


def scanner(folder, answer="accepted", **changes):
    """A folder with results of fifty draws, the first of which stands there three times."""
    draws = small_draws()
    repeated = np.r_[0, 0, np.arange(50)]
    draws = type(draws)(
        draws.names,
        draws.physical[repeated],
        draws.effective_deg_per_step[repeated],
        draws.reference_pose_rad,
        draws.derived_names,
        draws.derived[repeated],
    )
    summary = structs.replace(whole_summary(), answer=answer, estimator="posterior", **changes)
    write_results(folder / "results", small_record(summary), draws)
    return draws


@pytest.fixture(scope="module")
def axis(tmp_path_factory):
    """A folder with the accepted fit of an axis, and that fit."""
    folder = tmp_path_factory.mktemp("axis") / "a"
    write_axis(drawn(4, runs(2), backlash=AxisPrior(0.0, 0.1)).campaign, folder)
    fit = fit_axis(read_axis(folder), tier="importance")
    keep_fit(fit, summarise_axis(fit), folder / "results")
    assert fit.answer == "accepted"
    return folder, fit


@pytest.mark.parametrize("place", ["", "results"])
def test_a_scanners_draws_and_what_is_carried(tmp_path, place):
    """A draw that stands there three times has three times the weight; moments are those of all rows."""
    draws = scanner(tmp_path)
    loaded = load_posterior(tmp_path / place)
    assert set(loaded.by_name) == {*draws.names, *draws.derived_names}
    assert len(loaded.weights) == 50 and loaded.weights[0] == pytest.approx(3 / 52) and loaded.answer == "accepted"
    assert loaded.weights.sum() == pytest.approx(1.0)
    product = loaded.propagate(lambda p: p["backlash_deg.pan"] * p["effective_mirror_offset_mm"])
    rows = draws.physical[:, 0] * draws.derived[:, 0]
    assert product.mean == pytest.approx(rows.mean(), rel=ROUNDING)
    assert product.sd == pytest.approx(rows.std(), rel=ROUNDING)
    assert product.draws.shape == product.weights.shape == (1, 50)
    assert np.all(product.interval95[0] < product.mean) and product.mcse_mean > 0
    with pytest.raises(ValueError, match="50 draws it was given"):
        loaded.propagate(lambda p: p["pixel_scale"].mean())
    with pytest.raises(TypeError):
        loaded.by_name["pixel_scale"] = None


def test_an_axis_draws_are_those_of_its_fit(axis):
    folder, fit = axis
    loaded = load_posterior(folder)
    assert set(loaded.by_name) == set(fit.draws) and {"per_command.forward", "backlash"} <= set(fit.draws)
    lost = loaded.propagate(lambda p: np.minimum(100 * p["per_command.forward"], p["backlash"]))
    expected = np.minimum(100 * fit.draws["per_command.forward"], fit.draws["backlash"])
    assert lost.mean == pytest.approx(expected.mean(), rel=ROUNDING)
    assert lost.sd == pytest.approx(expected.std(), rel=ROUNDING)
    assert loaded.to_dataframe().shape == (len(loaded.weights), len(fit.draws) + 1)
    assert str(loaded).startswith(f"Posterior of {len(loaded.weights)} stored draws, accepted")


@pytest.mark.parametrize("answer", ["rough", "laplace"])
def test_an_answer_that_is_not_accepted_is_refused_unless_requested(tmp_path, answer):
    scanner(tmp_path, answer)
    with pytest.raises(NotConverged, match="not accepted") as refused:
        load_posterior(tmp_path)
    assert "anyway=True" in refused.value.remedy
    assert load_posterior(tmp_path, anyway=True).answer == answer


def test_results_of_before_answers_count_by_what_made_them(tmp_path):
    """0.2.0 wrote none: a posterior that had converged was accepted."""
    scanner(tmp_path, None)
    assert load_posterior(tmp_path).answer == "accepted"
    scanner(tmp_path, "laplace", converged=False)
    with pytest.raises(NotConverged, match="not converged"):
        load_posterior(tmp_path, anyway=True)


def test_refusals_say_what_to_do(tmp_path):
    with pytest.raises(InputError, match="there are no results/ yet") as refused:
        load_posterior(tmp_path)
    assert "tvsbayes fit" in refused.value.remedy
    scanner(tmp_path)
    edit_fit(tmp_path / "results", format="tvsbayes-fit/9")
    with pytest.raises(InputError, match="tvsbayes-fit/9") as refused:
        load_posterior(tmp_path)
    assert "the tvsbayes that wrote it" in refused.value.remedy
    edit_fit(tmp_path / "results", format="tvsbayes-plan/1")
    with pytest.raises(InputError, match="tvsbayes-plan/1"):
        load_posterior(tmp_path)
    scanner(tmp_path)
    whole = (tmp_path / "results" / "draws.npz").read_bytes()
    (tmp_path / "results" / "draws.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"draws\.npz"):
        load_posterior(tmp_path)
    (tmp_path / "results" / "draws.npz").unlink()
    with pytest.raises(InputError, match=r"results/ lack draws\.npz"):
        load_posterior(tmp_path)


def test_neither_jax_nor_arviz_nor_scipy_is_loaded(axis):
    code = (
        "import sys, tvsbayes; p = tvsbayes.load_posterior(sys.argv[1]); p.propagate(lambda q: q['backlash']);"
        "print([n for n in ('jax', 'arviz', 'arviz_stats', 'scipy', 'pandas', 'jsonschema') if n in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code, axis[0]], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
