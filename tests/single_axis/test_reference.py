"""Errors that all readings of a reference share: in every u, never rescaled; budgets that sum to the stated u."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.axes import drawn, random_moves, runs
from support.refusals import refusal

from tvsbayes.files.documents import StatedValue
from tvsbayes.single_axis.axis_budget import _variances, axis_budgets
from tvsbayes.single_axis.axis_campaign import (
    AxisCampaign,
    AxisMove,
    Reading,
    Reference,
    axis_bytes,
    read_axis,
    write_axis,
)
from tvsbayes.single_axis.axis_density import HEADLINE_DRAWS, headline_functionals
from tvsbayes.single_axis.axis_fit import fit_axis, model_of
from tvsbayes.single_axis.axis_record import AxisSummary, summarise_axis
from tvsbayes.single_axis.axis_rows import rows_of
from tvsbayes.single_axis.classic_line import classic_axis
from tvsbayes.single_axis.predicted_stops import PredictedAxis

PLACES = np.linspace(0.0, 400.0, 6)


NOTHING = Reference()


def screw(reference: Reference = NOTHING, u: float = 0.0, scale: float = 1.0) -> AxisCampaign:
    """A screw in mm; reading i has u (0.2 um + 0.4 um/m) x `scale`, or a constant one."""
    moves = runs(3, PLACES.tolist(), beyond=5.0)
    rng, command = np.random.default_rng(3), np.array([m.command for m in moves])
    side = np.r_[-1.0, np.sign(np.diff(command))]
    value = command * (1 + 2e-5) - 0.003 * side + 0.002 * np.sin(command / 60) + rng.normal(0, 0.001, len(moves))
    read = [k for k, c in enumerate(command) if 0 <= c <= 400]
    readings = [Reading(n, k, float(value[k]), u or scale * (2e-4 + 4e-7 * command[k])) for n, k in enumerate(read)]
    return AxisCampaign("mm", moves, tuple(readings), command_unit="mm", reference=reference)


def summary_of(campaign: AxisCampaign) -> AxisSummary:
    return summarise_axis(fit_axis(campaign, sampled=False))


def test_ten_times_the_uncertainty_of_the_reference_is_in_the_u_of_the_line():
    """By GUM the u of the scale, 4e-7, adds in quadrature; the readings' scatter is the same, and rescales nothing."""
    u = {}
    for scale in (1e-6, 1.0, 10.0):
        summary = summary_of(screw(Reference(u_is="common"), scale=scale))
        line, classic = summary.effective_per_command["forward"].sd, summary.classic.u_per_command
        u[scale] = np.array([line, classic])
        assert "reading_scale" not in summary.parameters
    for scale in (1.0, 10.0):
        np.testing.assert_allclose(u[scale], np.hypot(u[1e-6], scale * 4e-7), rtol=0.01)
    assert u[10.0][1] / u[1.0][1] > 2


@pytest.mark.parametrize("reference", [Reference(u_per_unit=3e-6), Reference(u=0.004, u_per_unit=3e-6)])
def test_the_scale_of_the_reference_is_in_line_figures_and_budget(reference):
    plain, summary = (summary_of(screw(each, u=3e-4)) for each in (Reference(), reference))
    before, after = (s.effective_per_command["forward"] for s in (plain, summary))
    assert after.sd == pytest.approx(np.hypot(before.sd, 3e-6), rel=0.01)
    # An error of the scale is no error by position off the line, and no offset of the readings is one.
    np.testing.assert_allclose([d.sd for d in summary.deviations], [d.sd for d in plain.deviations], rtol=0.02)
    figures, u, noise = summary.classic.iso230, summary.classic.iso230_u, plain.classic.iso230_u
    # 2e-5 of 400 mm is most of E: both ends are its ends.
    assert u["systematic"] == pytest.approx(np.hypot(noise["systematic"], 3e-6 * 400.0), rel=1e-3)
    assert u["reversal"] == pytest.approx(noise["reversal"], rel=1e-3) and figures["systematic"] > 0.008
    line = next(budget for budget in summary.budgets if budget.quantity == "effective_per_command")
    row = next(row for row in line.rows if row.quantity == "reference, u_per_unit")
    assert (row.kind, row.dof, row.u) == ("B", None, 3e-6)
    assert row.contribution == pytest.approx(3e-6, rel=0.01)
    accuracy = next(budget for budget in summary.budgets if budget.quantity == "ISO 230-2 A")
    assert accuracy.u == u["accuracy"] and accuracy.estimate == figures["accuracy"]


def test_budgets_sum_to_the_stated_u():
    summary = summary_of(screw(Reference(u_per_unit=1e-6), u=3e-4))
    named = {budget.quantity: budget for budget in summary.budgets}
    assert set(named) == {"effective_per_command", "effective_backlash", "ISO 230-2 E", "ISO 230-2 A"}
    assert named["effective_backlash"].u == summary.effective_backlash.sd
    for budget in summary.budgets:
        # The last row is what is left.
        assert abs(budget.rows[-1].share) < 0.005, budget.quantity
        assert np.sqrt(sum(row.share for row in budget.rows[:-1])) * budget.u == pytest.approx(budget.u, rel=0.005)
        assert {row.kind for row in budget.rows[:-1]} <= {"A", "B", "A, B"}


@pytest.mark.parametrize("seed", [1, 2])
def test_variance_by_cause_is_exactly_that_of_the_posterior(seed):
    """Homings, held stops, creep and drift; of any line quantity, at any draw of the scales."""
    campaign = drawn(seed, random_moves(seed)).campaign
    campaign = replace(campaign, reference=Reference(u=0.01, u_per_unit=1e-3))
    model = model_of(campaign)
    w = np.random.default_rng(seed).normal(0, 0.5, (2, len(model.coordinates.names)))
    fit = replace(fit_axis(campaign, sampled=False), model=model, w=w)
    functionals = headline_functionals(model, w)
    for k in range(2):
        exact = model.linear(w[k : k + 1]).sd_of(functionals)[0]
        for name, functional, sd in zip(HEADLINE_DRAWS, functionals, exact, strict=True):
            parts = _variances(fit, functional[None], w[k : k + 1])
            assert np.sqrt(sum(parts.values())) == pytest.approx(sd, rel=1e-6), name
            assert min(parts.values()) >= 0
    assert axis_budgets(replace(fit, w=w[:0]), None, None, classic_axis(fit.rows)) == ()


def test_a_common_u_is_no_noise():
    rows = rows_of(screw(Reference(u_is="common")))
    assert not rows.variance.any() and rows.reference_causes == ("u of readings",)
    np.testing.assert_allclose(rows.reference[:, 0], 2e-4 + 4e-7 * rows.command, rtol=1e-12)
    left_out = rows.command > 100
    assert rows.without(left_out).reference.shape == ((~left_out).sum(), 1)
    assert rows_of(screw()).variance.all() and rows_of(screw()).reference_causes == ()


def warm(campaign: AxisCampaign, degC: float) -> AxisCampaign:
    return replace(campaign, moves=tuple(replace(m, temperature_degC=degC) for m in campaign.moves))


def test_the_expansion_of_the_reference_corrects_and_has_a_u():
    plain = screw(u=3e-4)
    hot = warm(replace(plain, reference=Reference(expansion_per_K=StatedValue(8e-6, 1e-6))), 26.0)
    before, after = rows_of(plain), rows_of(hot)
    np.testing.assert_allclose(after.value, before.value * (1 + 6 * 8e-6), rtol=1e-12)
    np.testing.assert_allclose(after.reference[:, 0], after.value * 6e-6, rtol=1e-12)
    assert classic_axis(after).per_command == pytest.approx(classic_axis(before).per_command * (1 + 4.8e-5), rel=1e-9)


@pytest.mark.parametrize(
    ("entry", "code"),
    [
        ("u = -1.0", "number"),
        ("u_is = 'mine'", "word"),
        ("uu = 1.0", "unknown-key"),
        ("expansion_per_K = 1e-5", "temperature"),
        ("expansion_per_K = { value = 1e-5 }", "quantity"),
        ("valid_until = 2027-01-15T10:00:00Z", "date"),
    ],
)
def test_entries_that_say_nothing_are_refused(tmp_path, entry, code):
    write_axis(screw(), tmp_path / "a")
    file = tmp_path / "a" / "campaign.toml"
    file.write_bytes(axis_bytes(screw())["campaign.toml"] + f"[reference]\n{entry}\n".encode())
    error = refusal(lambda: read_axis(tmp_path / "a"))
    assert error.code == code and "reference" in str(error)


def test_import_says_that_an_expanded_uncertainty_is_common(ask, tmp_path):
    rows = "".join(f"{c};{1.0001 * c + 0.001 * (k % 3):.4f};{4 + c / 100}\n" for k, c in enumerate((0, 50, 100) * 3))
    for name, common in (("U (k=2) (um)", True), ("u (um)", False)):
        file, out = tmp_path / "sheet.csv", tmp_path / f"out{common}"
        file.write_text(f"Target (mm);Measured (mm);{name}\n{rows}")
        code, document = ask("import", file, "--axis", "--to", out, "--yes")
        assert code == 0 and any("all readings share" in text for text in document["assumed"]) is common
        campaign = read_axis(out)
        assert campaign.reference.common is common and campaign.command_unit == "mm"
        assert campaign.readings[-1].u == pytest.approx((5.0 if not common else 2.5) * 1e-3)


def test_positions_hold_the_u_of_the_reference_and_its_own_readings_do_not():
    """Tables and promises are of positions; fresh readings of the same reference err as those of the fit did."""
    reference = Reference(u_per_unit=1e-5, certificate="K 1")
    campaign = screw(reference, u=3e-4)
    fit = fit_axis(campaign, sampled=False)
    machine = PredictedAxis(fit)
    at = np.array([0.0, 400.0])
    position = machine.expected(at, np.ones(2)).pooled()
    span = np.array([-1.0, 1.0])
    u = np.sqrt(span @ position.covariance @ span)
    assert u == pytest.approx(1e-5 * 400.0, rel=0.05)
    moves = (AxisMove(0, 0, 0.0, -5.0, "backward"), AxisMove(1, 0, 60.0, 0.0), AxisMove(2, 0, 120.0, 400.0))
    moves = (*moves, AxisMove(3, 0, 180.0, 405.0), AxisMove(4, 0, 240.0, 400.0))
    fresh = [Reading(k, k + 1, moves[k + 1].command, 3e-4) for k in range(2)]
    fresh.append(Reading(2, 4, 400.0, 3e-4))
    u_of = {}
    for certificate in ("K 1", "K 2"):
        new = AxisCampaign("mm", moves, tuple(fresh), reference=replace(reference, certificate=certificate))
        read = machine.read(new).pooled()
        u_of[certificate] = np.sqrt(span @ read.covariance[:2, :2] @ span)
    # Of another reference both errors count.
    assert u_of["K 1"] < 0.003 and u_of["K 2"] == pytest.approx(np.hypot(u_of["K 1"], 4e-3 * np.sqrt(2)), rel=0.1)
