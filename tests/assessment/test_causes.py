"""Causes of uncertainty are what refitting a linear campaign shows, and add up."""

from __future__ import annotations

import copy
import json
import math
from dataclasses import replace

import equinox as eqx
import numpy as np
import pytest
from support.drawn_quantities import drawn_quantities
from support.linear_fit import ROWS, fit_of, linear_problem, refitted, slope_of
from support.written_rows import move_row

from tvsbayes.assessment.causes import causes_of, headline_budget, headline_causes
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.rig import RigTable
from tvsbayes.metrology.budget_tables import CORRELATIONS
from tvsbayes.results.estimates import Estimate
from tvsbayes.statistics.least_squares import laplace_draws


@pytest.fixture(scope="module")
def linear_fit(mounted_rig):
    """A linear campaign with headlines that are linear in its coordinates: (fit, gradient, Jacobian, load)."""
    jacobian, load = linear_problem()
    # What the rig fixes moves no spot.
    jacobian[:, [TWO_MIRROR.index[name] for name in TWO_MIRROR.rig_names if mounted_rig.table.priors[name].u == 0]] = (
        0.0
    )
    fit = fit_of(jacobian, load, mounted_rig)
    covariance = np.linalg.inv(fit.information.fisher + np.eye(len(TWO_MIRROR.names)))
    rng = np.random.default_rng(12)
    draws_z = laplace_draws(fit.z, covariance, 1)
    gradient = rng.normal(size=(6, len(TWO_MIRROR.names))) * 1e-3
    # Nothing depends on a coordinate that is fixed, and noise scales carry no headline.
    gradient[:, : len(TWO_MIRROR.rig_names)][:, np.asarray(fit.space.u) == 0] = 0.0
    physical = np.full((len(draws_z), len(TWO_MIRROR.names)), 0.5)
    values = draws_z @ gradient.T
    physical[:, TWO_MIRROR.index["backlash_deg.pan"]], physical[:, TWO_MIRROR.index["backlash_deg.tilt"]] = (
        values[:, 4],
        values[:, 5],
    )
    for k, name in enumerate(("stop_sd_deg.left", "stop_sd_deg.right", "pixel_scale")):
        physical[:, TWO_MIRROR.index[name]] = np.exp((0.1, 0.2, 0.05)[k] * rng.standard_normal(len(draws_z)))
    rows = ((0, 0, 0.0, 0, 0, "left", "up"), (1, 0, 1.0, 9, 0), (2, 0, 2.0, 0, 0), (3, 0, 3.0, 0, 9))
    moves = tuple(move_row(*row) for row in rows)
    draws = drawn_quantities(len(physical), physical=physical, effective_deg_per_step=values[:, :4])
    for name, value in (("draws_z", draws_z), ("covariance", covariance), ("draws", draws)):
        object.__setattr__(fit, name, value)
    object.__setattr__(fit, "campaign", replace(fit.campaign, moves=moves))
    return fit, gradient, jacobian, load


def test_headline_causes_are_what_refitting_shows(linear_fit):
    fit, gradient, jacobian, load = linear_fit
    causes = headline_causes(fit)
    # Down was never moved.
    assert causes.quantities == (
        *(f"effective_deg_per_step.{d}" for d in ("left", "right", "up")),
        *("backlash_deg.pan", "backlash_deg.tilt"),
    )
    gradient = gradient[[0, 1, 2, 4, 5]]
    by_datum, by_prior = refitted(jacobian, load)
    pixels, stops = gradient @ by_datum, gradient @ by_datum @ load
    scale = np.abs(causes.contribution).max()
    sd_by = {name: causes.contribution[:, k] for k, name in enumerate(causes.names)}
    np.testing.assert_allclose(sd_by["pixel noise"], np.linalg.norm(pixels, axis=1), rtol=1e-6)
    np.testing.assert_allclose(sd_by["stop errors of the campaign"], np.linalg.norm(stops, axis=1), rtol=1e-6)
    cameras = gradient @ by_prior[:, len(TWO_MIRROR.rig_names) :]
    np.testing.assert_allclose(sd_by["stereo calibration"], np.linalg.norm(cameras, axis=1), rtol=1e-6)
    for name in ("mirror_offset_mm", "laser_tilt_deg.y", "focal_scale", "backlash_deg.pan"):
        np.testing.assert_allclose(
            sd_by[name], gradient @ by_prior[:, TWO_MIRROR.index[name]], atol=1e-6 * scale, rtol=1e-6
        )
    # They add up to the variance: each is counted once.
    total = np.einsum("qi,ij,qj->q", gradient, fit.covariance, gradient)
    np.testing.assert_allclose((causes.contribution**2).sum(axis=1), total, rtol=1e-6)


def test_the_scatter_of_looks_has_its_share_of_their_noise(linear_fit):
    """Of unit noise the part b diag(v) b^T, b the slopes: what refitting shows of it, and pixels have the rest."""
    fit, gradient, jacobian, load = linear_fit
    slope = np.asarray(fit.linearised.slope)
    variance = 0.3 * np.random.default_rng(13).uniform(size=slope.shape[::2]) / np.sum(slope**2, axis=1)
    shaking = copy.copy(fit)
    object.__setattr__(shaking, "linearised", eqx.tree_at(lambda x: x.scatter_variance, fit.linearised, variance))
    plain, parts = (
        dict(zip(causes.names, causes.contribution.T, strict=True)) for causes in map(headline_causes, (fit, shaking))
    )
    by_datum = (gradient[[0, 1, 2, 4, 5]] @ refitted(jacobian, load)[0]).reshape(5, *slope.shape[:2])
    scattered = np.einsum("qni,nia->qna", by_datum, slope * np.sqrt(variance)[:, None])
    expected = np.sqrt(np.sum(scattered**2, axis=(1, 2)))
    np.testing.assert_allclose(parts["scatter of the campaign's looks"], expected, rtol=1e-6)
    both = np.hypot(parts["pixel noise"], parts["scatter of the campaign's looks"])
    np.testing.assert_allclose(both, plain["pixel noise"], rtol=1e-9)
    assert "scatter of the campaign's looks" not in plain


def test_degrees_of_freedom_follow_from_how_well_the_noise_is_known(linear_fit):
    causes = headline_causes(linear_fit[0])
    dof = dict(zip(causes.names, causes.dof.T, strict=True))
    # nu = 1/(2 var(ln s)): ln s has sd 0.05 for pixels, 0.2 for the worse of left and right (GUM eq. G.3); 2048 draws.
    count = 2048
    tolerance = 4 * np.sqrt(2 / count)
    np.testing.assert_allclose(dof["pixel noise"], 0.5 / 0.05**2, rtol=tolerance)
    np.testing.assert_allclose(dof["stop errors of the campaign"][[0, 1, 3]], 0.5 / 0.2**2, rtol=tolerance)
    # The stop scatter of the tilt axis was held fixed here.
    assert np.all(np.isinf(dof["stop errors of the campaign"][[2, 4]]))
    assert np.all(np.isinf(dof["stereo calibration"]))


def test_headline_budget_is_a_gum_table(linear_fit):
    fit, gradient, _, _ = linear_fit
    causes = headline_causes(fit)
    sd = float(np.sqrt(gradient[1] @ fit.covariance @ gradient[1]))
    table = headline_budget(causes, "effective_deg_per_step.right", Estimate(0.06, sd, (0.05, 0.07), 1.0, 0.9))
    rows = {row.quantity: row for row in table.rows}
    assert (table.unit, table.estimate, table.u) == ("deg/step", 0.06, sd)
    assert rows["pixel noise"].kind == "A" and rows["pixel noise"].unit == "deg/step"
    assert rows["stereo calibration"].kind == "B"
    # Errors that the gears repeat are known by their prior, as the cameras are by theirs.
    for name in ("transmission error", "play variation"):
        renamed = replace(causes, names=tuple(name if n == "stereo calibration" else n for n in causes.names))
        corrected = headline_budget(renamed, "effective_deg_per_step.right", Estimate(0.06, sd, (0.05, 0.07), 1.0, 0.9))
        assert {row.quantity: row.kind for row in corrected.rows}[name] == "B"
    assert abs(rows[CORRELATIONS].share) < 1e-6
    prior = next(row for row in table.rows if row.quantity.startswith("prior of ") and row.distribution == "normal")
    assert prior.kind == "B" and prior.contribution == pytest.approx(prior.sensitivity * prior.u)
    assert sum(row.share for row in table.rows) == pytest.approx(1.0, abs=1e-12)
    json.dumps(table.as_json(), allow_nan=False)


def test_half_normal_and_log_normal_priors_state_their_own_moments(linear_fit):
    fit, *_ = linear_fit
    causes = headline_causes(fit)
    k = causes.names.index("backlash_deg.pan")
    scale = float(np.asarray(fit.space.u)[list(RigTable().priors).index("backlash_deg.pan")])
    draws = np.abs(np.random.default_rng(0).normal(0.0, scale, 200_000))
    assert causes.distribution[k] == "half-normal"
    # 4 standard errors of mean and standard deviation.
    assert causes.centre[k] == pytest.approx(draws.mean(), abs=4 * draws.std() / np.sqrt(draws.size))
    assert causes.u[k] == pytest.approx(draws.std(), rel=4 / np.sqrt(draws.size))
    k = causes.names.index("pixel_scale")
    stated = RigTable().priors["pixel_scale"]
    assert (causes.distribution[k], causes.u[k]) == ("log-normal", stated.u)
    assert causes.centre[k] == pytest.approx(math.log(stated.value), abs=1e-12)


ALGEBRA = 1e-9
"""Relative, of solving 65 equations whose information spans six decades."""


DIFFERENCES = 1e-6
"""Relative, of central differences with a step of 1e-4 sd."""


@pytest.mark.parametrize("readings", [False, True])
def test_causes_are_what_refitting_shows(mounted_rig, readings):
    jacobian, load = linear_problem()
    fit = fit_of(jacobian, load, mounted_rig, readings)
    causes = causes_of(fit)
    by_datum, by_prior = refitted(jacobian, load)
    slope = slope_of(fit)
    pixels, stops = slope @ by_datum, slope @ by_datum @ load
    expected = {
        "pixel and aperture noise" if readings else "pixel noise": pixels @ pixels.T,
        "stop errors of the campaign": stops @ stops.T,
    }
    stereo = slope @ by_prior[:, len(TWO_MIRROR.rig_names) :]
    expected["stereo calibration"] = stereo @ stereo.T
    for stem in ("mirror_offset_mm", "laser_tilt_deg", "extrinsics", "focal_scale"):
        columns = [TWO_MIRROR.index[name] for name in TWO_MIRROR.rig_names if name.split(".")[0] == stem]
        moved = slope @ by_prior[:, columns]
        expected["focal scale" if stem == "focal_scale" else f"prior of {stem}"] = moved @ moved.T
    for name, part in expected.items():
        covariance = causes[name]
        scale = np.sqrt(np.outer(np.diag(part), np.diag(part))) + 1e-300
        assert np.abs((covariance - part) / scale).max() < 10 * DIFFERENCES, name


def test_causes_add_up_to_the_posterior(mounted_rig):
    jacobian, load = linear_problem()
    fit = fit_of(jacobian, load, mounted_rig)
    causes = causes_of(fit)
    inverse = np.linalg.inv(np.eye(ROWS) + load @ load.T)
    posterior = np.linalg.inv(jacobian.T @ inverse @ jacobian + np.eye(len(TWO_MIRROR.names)))
    slope = slope_of(fit)
    total = slope @ posterior @ slope.T
    scale = np.sqrt(np.outer(np.diag(total), np.diag(total)))
    scale[scale == 0] = 1.0
    assert np.abs((sum(causes.values()) - total) / scale).max() < 10 * DIFFERENCES
    for name, part in causes.items():
        unit = part / scale
        assert np.abs(unit - unit.T).max() < ALGEBRA, name
        assert np.linalg.eigvalsh(0.5 * (unit + unit.T)).min() > -ALGEBRA, name
        assert np.any(part != 0)
    # Fixed in the rig: no cause.
    assert not any("harmonic" in name for name in causes)
