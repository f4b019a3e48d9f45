"""The joint estimator: finds the truth with its uncertainty, names the right spot, compiles once (formulation 4.2)."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.special import ndtri
from support.waits import check_forward, doings

from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.estimators.joint_fit import DIAGNOSING, NEWTON, fit
from tvsbayes.estimators.likelihood import evaluate, no_draw
from tvsbayes.estimators.mode_search import SEARCHING
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.campaign import Campaign, ordered_spots
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.model_choice import ModelChoice
from tvsbayes.instrument.parameters import GEAR_ERROR_NAMES, HARMONIC_NAMES, Prior, names_of
from tvsbayes.instrument.plan import read_plan
from tvsbayes.instrument.protocols import grid_protocol
from tvsbayes.instrument.rig import read_rig
from tvsbayes.model.compiled import Compiled
from tvsbayes.statistics.chances import binomial_bounds
from tvsbayes.statistics.least_squares import laplace_draws
from tvsbayes.twin.physics import effective_mirror_offset_mm
from tvsbayes.twin.simulated_campaign import SimulatedCampaign, simulate

SD = 1.0
"""One posterior standard deviation."""
FAR = 5 * SD
"""A true value lies farther than this from a right estimate in 6 of 10 million cases."""


def with_priors(campaign: Campaign, **priors: Prior) -> Campaign:
    named = {name.replace("__", "."): prior for name, prior in priors.items()}
    return replace(campaign, rig=replace(campaign.rig, priors={**campaign.rig.priors, **named}))


def test_a_fit_reports_what_it_does(mixed_fit, mixed_waits):
    check_forward(mixed_waits)
    assert doings(mixed_waits)[-3:] == [SEARCHING, NEWTON, DIAGNOSING]


def test_truth_is_found_within_its_uncertainty(mixed_run, mixed_fit):
    """Ratios, play, optics, the noise of pixels and stops."""
    assert mixed_fit.converged, mixed_fit.problems
    pose = tuple(np.degrees(mixed_fit.reference_pose_rad))
    true = mixed_run.truth.parameters
    ratios = mixed_run.truth.effective_deg_per_step(mixed_run.campaign)
    sd = mixed_fit.draws.effective_deg_per_step.std(axis=0)
    z = (mixed_fit.mode.effective_deg_per_step - [ratios[d] for d in ("left", "right", "up", "down")]) / sd
    assert np.all(np.abs(z) < FAR)
    for name in ("backlash_deg.pan", "backlash_deg.tilt", "mirror_offset_mm", "extrinsics.rotation_rad.z"):
        index = TWO_MIRROR.index[name]
        error = mixed_fit.mode.physical[index] - true.get(name, np.nan)
        assert abs(error) < FAR * mixed_fit.draws.physical[:, index].std(), name
    for name in ("pixel_scale", *names_of("stop_sd_deg")):
        index = TWO_MIRROR.index[name]
        spread = np.log(mixed_fit.draws.physical[:, index]).std()
        assert abs(np.log(mixed_fit.mode.physical[index] / true[name])) < FAR * spread, name
    offset = effective_mirror_offset_mm(true, pose)
    spread = mixed_fit.draws["effective_mirror_offset_mm"].std()
    assert abs(mixed_fit.mode["effective_mirror_offset_mm"] - offset) < FAR * spread


@pytest.mark.thorough
def test_a_far_start_is_annealed_to_the_same_mode(mixed_run, mixed_fit):
    # The nominal rig states its mounting to 0.5 rad and 100 mm; the true one stands 0.32 rad and 100 mm away.
    wide = {f"extrinsics.rotation_rad.{a}": Prior(0.0, 0.5) for a in "xyz"}
    wide |= {f"extrinsics.translation_mm.{a}": Prior(0.0, 100.0) for a in "xyz"}
    campaign = mixed_run.campaign
    campaign = replace(campaign, rig=replace(campaign.rig, priors={**campaign.rig.priors, **wide}))
    far = fit(campaign)
    assert far.converged, far.problems
    sd = far.draws.effective_deg_per_step.std(axis=0)
    # The mounted prior adds information of its own, so the modes differ by less than a standard deviation.
    difference = far.mode.effective_deg_per_step - mixed_fit.mode.effective_deg_per_step
    assert np.all(np.abs(difference) < SD * sd)
    assert far.chi2 == pytest.approx(mixed_fit.chi2, rel=0.05)


@pytest.mark.thorough
def test_a_second_campaign_of_another_size_compiles_nothing(mixed_run, mixed_fit, mounted_rig, monkeypatch):
    """Other numbers of spots and of counters: every argument of a compiled function keeps its shape."""
    compiled, first = [], Compiled._made

    def counted(self, *arguments):
        compiled.append(self.plain.__name__)
        return first(self, *arguments)

    monkeypatch.setattr(Compiled, "_made", counted)
    plan = grid_protocol(pan_steps=(0, 60, 120, 180), tilt_steps=(-90, -30, 30, 90))
    grid = simulate(mounted_rig, plan, seed=22).campaign
    again = fit(replace(grid, spots=grid.spots[: len(mixed_run.campaign.spots) - 7]))
    assert again.converged and again.arrays.gears.filled > mixed_fit.arrays.gears.filled and compiled == []


@pytest.mark.thorough
def test_an_outlier_is_assigned_to_the_right_spot_of_its_stop(mixed_run, mixed_fit):
    spots = ordered_spots(mixed_run.campaign)
    # The first of two spots taken at one stop, away from the ends of the campaign.
    first = next(a for a, b in pairwise(spots[20:]) if a.move == b.move)
    moved = replace(first, u_left_px=first.u_left_px + 4.0, u_right_px=first.u_right_px + 4.0)
    campaign = mixed_run.campaign
    spoiled = tuple(moved if s.spot == first.spot else s for s in campaign.spots)
    robust = fit(replace(campaign, spots=spoiled), model=ModelChoice(robust=True))
    assert robust.converged, robust.problems
    assert robust.excluded_spots == (first.spot,)
    sd = mixed_fit.draws.effective_deg_per_step.std(axis=0)
    difference = robust.mode.effective_deg_per_step - mixed_fit.mode.effective_deg_per_step
    # One spot less of 64 moves an estimate by an eighth of its sd, Huber weights of the clean ones by a fraction (95 %
    # efficiency).
    assert np.all(np.abs(difference) < 0.5 * SD * sd)


@pytest.mark.thorough
def test_the_plain_fit_names_the_outlier_as_suspect(mixed_run):
    campaign = mixed_run.campaign
    victim = ordered_spots(campaign)[30]
    moved = replace(victim, v_left_px=victim.v_left_px + 3.0)
    spoiled = tuple(moved if s.spot == victim.spot else s for s in campaign.spots)
    result = fit(replace(campaign, spots=spoiled))
    assert victim.spot in result.suspect_spots
    assert result.excluded_spots == ()


@pytest.mark.thorough
def test_robust_on_clean_data_excludes_nothing(mixed_run, mixed_fit):
    robust = fit(mixed_run.campaign, model=ModelChoice(robust=True))
    assert robust.excluded_spots == ()
    sd = mixed_fit.draws.effective_deg_per_step.std(axis=0)
    difference = robust.mode.effective_deg_per_step - mixed_fit.mode.effective_deg_per_step
    assert np.all(np.abs(difference) < 0.5 * SD * sd)


PAN_ERROR_DEG = {"harmonic_deg.pan.1.cos": 0.06, "harmonic_deg.pan.1.sin": 0.08}
"""An amplitude of 0.1 deg, twice the rig's median stop error."""


@pytest.fixture(scope="module")
def wobbling(mounted_rig) -> SimulatedCampaign:
    """A pinion of 6 deg per turn under a grid of 15 pan angles, 1.2 deg apart, over three turns."""
    stop_sds = {f"stop_sd_deg.{d}": Prior(0.02, 0.0, "log-normal") for d in ("left", "right", "up", "down")}
    errors = {name: Prior(value, 0.0) for name, value in PAN_ERROR_DEG.items()}
    errors |= {name: Prior(0.0, 0.0, "half-normal") for name in GEAR_ERROR_NAMES if "length" not in name}
    rig = replace(
        mounted_rig,
        table=replace(mounted_rig.table, harmonic_period_deg={"pan": (6.0,)}),
        truth={**mounted_rig.truth, **stop_sds, **errors},
    )
    plan = grid_protocol(targets=("d1", "d3"), pan_steps=range(-40, 81, 20), tilt_steps=(-60, 60))
    return simulate(rig, plan, seed=5)


@pytest.mark.thorough
def test_a_pinions_error_is_found_and_without_it_the_stops_scatter(wobbling):
    plain = fit(wobbling.campaign, model=ModelChoice(perfect_gears=True))
    freed = fit(wobbling.campaign, model=ModelChoice(perfect_gears=True, harmonics=True))
    assert plain.converged and freed.converged, (plain.problems, freed.problems)
    for name in HARMONIC_NAMES:
        index = TWO_MIRROR.index[name]
        assert freed.free[index] == (".pan." in name) and not plain.free[index], name
        error = freed.mode.physical[index] - PAN_ERROR_DEG.get(name, 0.0)
        assert abs(error) <= 4 * SD * freed.draws.physical[:, index].std(), name
    amplitude_sd = freed.draws.physical[:, TWO_MIRROR.index["harmonic_deg.pan.1.sin"]].std()
    assert amplitude_sd < 0.1 * PAN_ERROR_DEG["harmonic_deg.pan.1.sin"], "the campaign knows it to a tenth"
    pan = [TWO_MIRROR.index["stop_sd_deg.left"], TWO_MIRROR.index["stop_sd_deg.right"]]
    # What the plain model must call chance: 0.1 deg / sqrt(2) beside 0.02 deg.
    np.testing.assert_allclose(freed.mode.physical[pan], 0.02, rtol=0.4)
    np.testing.assert_allclose(plain.mode.physical[pan], 0.074, rtol=0.4)
    assert freed.log_density - plain.log_density > 50
    # 1e-4 bounds by the normal approximation of chi-square; residuals less some fifty parameters.
    dof = 3 * len(wobbling.campaign.spots) - 50
    assert abs(freed.chi2 / dof - 1) < 4 * np.sqrt(2 / dof)


def test_harmonics_need_a_period_to_be_freed(mixed_run):
    with pytest.raises(InputError, match="no axis states the period") as caught:
        fit(mixed_run.campaign, model=ModelChoice(harmonics=True))
    assert '"harmonic_period_deg.pan" = { value = 360.0, u = 0.0 }' in caught.value.remedy


@pytest.mark.thorough
def test_gears_without_play_put_it_into_the_stops(mixed_run, mixed_fit):
    result = fit(mixed_run.campaign, model=ModelChoice(no_backlash=True))
    assert result.converged, result.problems
    for axis in ("pan", "tilt"):
        index = TWO_MIRROR.index[f"backlash_deg.{axis}"]
        assert not result.free[index]
        assert np.all(result.draws.physical[:, index] == 0.0) and result.mode.physical[index] == 0.0
    assert np.all(np.isfinite(result.covariance)) and np.isfinite(result.chi2)
    assert result.log_density < mixed_fit.log_density - 10
    sds = [TWO_MIRROR.index[name] for name in names_of("stop_sd_deg")]
    assert np.max(result.mode.physical[sds] / mixed_fit.mode.physical[sds]) > 2


@pytest.mark.thorough
def test_a_fixed_parameter_stays_and_the_rest_follows(mixed_run, mixed_fit):
    campaign = with_priors(mixed_run.campaign, mirror_offset_mm=Prior(35.0, 0.0))
    result = fit(campaign)
    assert np.all(result.draws.physical[:, TWO_MIRROR.index["mirror_offset_mm"]] == 35.0)
    # The translation along y takes over what the mirror offset may not say.
    y = TWO_MIRROR.index["extrinsics.translation_mm.y"]
    assert result.draws.physical[:, y].std() < mixed_fit.draws.physical[:, y].std()


def test_the_mode_is_a_stationary_maximum(mixed_fit):
    """By differences of the density that fits descend, along the axes of the covariance."""
    root = np.linalg.cholesky(mixed_fit.covariance)
    # Scales of repeating errors are where the density is highest with everything else integrated out.
    free = mixed_fit.free & ~np.isin(TWO_MIRROR.names, GEAR_ERROR_NAMES)
    columns = root.T[free]

    def density(points):
        still = no_draw(len(points), mixed_fit.arrays)
        return evaluate(points, still, mixed_fit.space, mixed_fit.arrays).log_density

    value = density(mixed_fit.z[None])[0]
    assert value == pytest.approx(mixed_fit.log_density)
    # Of a hundredth of an sd: third derivatives leave 1e-5 of a slope.
    ahead, behind = (density(mixed_fit.z + sign * 0.01 * columns) for sign in (1, -1))
    # Squared length of the remaining Newton step in sds: the fit stops at 1e-8.
    assert np.sum(((ahead - behind) / 0.02) ** 2) < 1e-6 * SD**2
    for sign in (-1, 1):
        fallen = value - density(mixed_fit.z + sign * 0.5 * columns[::7])
        # One half sd away a Gaussian falls by 1/8; half or twice that bounds its non-Gaussian shape.
        assert np.all((fallen > 1 / 16) & (fallen < 1 / 4))


def test_laplace_draws_have_exactly_their_moments():
    rng = np.random.default_rng(5)
    z, factor = (
        rng.standard_normal(len(TWO_MIRROR.names)),
        rng.standard_normal((len(TWO_MIRROR.names), len(TWO_MIRROR.names))),
    )
    covariance = factor @ factor.T + np.eye(len(TWO_MIRROR.names))
    draws = laplace_draws(z, covariance, seed=1)
    rounding = 1e-10 * np.abs(covariance).max()
    np.testing.assert_allclose(draws.mean(axis=0), z, atol=rounding)
    np.testing.assert_allclose(np.cov(draws, rowvar=False, ddof=0), covariance, atol=rounding)
    np.testing.assert_array_equal(draws, laplace_draws(z, covariance, seed=1))


def test_too_few_spots_are_refused_by_number(mixed_run):
    campaign = replace(mixed_run.campaign, spots=mixed_run.campaign.spots[:5])
    with pytest.raises(NothingToEstimate, match="5 spots can be used") as caught:
        fit(campaign)
    assert caught.value.exit_code == 3


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["paper", "mixed", "grid"])
def test_coverage_of_forty_rigs(protocol, mounted_rig):
    """A short form of `experiments/intervals/laplace_coverage.py`; bounds of the full study stand there.

    Shares inside, not squares: few reversals make the posterior of the play skew, and the tails of Laplace's z heavier
    than a normal's.
    """
    plan = read_plan(shipped_data() / "rigs" / "mounted" / f"{protocol}.csv")
    rig = read_rig(shipped_data() / "rigs" / "mounted" / "rig.toml")
    z = []
    for seed in range(1000, 1040):
        simulated = simulate(rig, plan, seed, aperture=protocol == "grid")
        result = fit(simulated.campaign)
        assert result.converged
        true = simulated.truth.effective_deg_per_step(simulated.campaign)
        sd = result.draws.effective_deg_per_step.std(axis=0)
        z.append((result.mode.effective_deg_per_step - list(true.values())) / sd)
    for share in (0.5, 0.8, 0.95):
        inside = np.mean(np.abs(z) < ndtri((1 + share) / 2), axis=0)
        low, high = binomial_bounds(len(z), share)
        assert np.all((inside >= low) & (inside <= high)), (share, inside)
