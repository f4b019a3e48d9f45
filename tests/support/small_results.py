"""A small summary, its draws and its record, made by hand: what a fit of two axes hardly moved would leave."""

from __future__ import annotations

import numpy as np
from msgspec import structs
from support.small_campaign import small_campaign

from tvsbayes.instrument.campaign import input_hashes
from tvsbayes.report.result_tables import KEY_PARAMETERS, MORE_PARAMETERS
from tvsbayes.results.estimates import Estimate, FitSummary, Leverage, WeakDirection, fit_noise
from tvsbayes.results.fit_record import FitRecord, covariance_of_draws, provenance
from tvsbayes.results.stored_draws import ResultDraws, StoredMode


def estimate(value: float, sd: float, contraction: float | None = 0.9) -> Estimate:
    return Estimate(value, sd, (value - 1.96 * sd, value + 1.96 * sd), 10 * sd, contraction)


def small_summary() -> FitSummary:
    """A fit in which the pan axis never moved right and the tilt axis never moved."""
    parameters = {name: estimate(1.0, 0.1) for name in (*KEY_PARAMETERS, *MORE_PARAMETERS)}
    parameters["mirror_offset_mm"] = estimate(30.0, 5.0, 0.001)
    parameters["stop_sd_deg.up"] = Estimate(0.05, 0.0, (0.05, 0.05), 0.0, None)
    return FitSummary(
        estimator="laplace",
        converged=True,
        problems=(),
        effective={"left": estimate(0.0621, 0.0001), "right": None, "up": None, "down": None},
        contrasts={"pan": None, "tilt": None},
        reference_pose_deg={"pan": 6.0, "tilt": 0.5},
        jacobian=((1.0, 0.0), (0.0, 1.0)),
        parameters=parameters,
        noise=fit_noise(31.0, 30.5, parameters),
        weak_directions=(WeakDirection("the tilt axis was never moved", {"degrees_per_step.tilt": 1.0}),),
        leverage=(Leverage(0, (3, 4), "effective left", None, "without move 0 it is lost"),),
        classic_predicted=dict.fromkeys(("left", "right", "up", "down")),
        excluded_spots=(17,),
        suspect_spots=tuple(range(30)),
        prior_conflicts=(),
        prior_sensitivity=(),
        sampling=None,
        curves=None,
    )


NAMES = ("backlash_deg.pan", "not estimated", "pixel_scale")


def whole_summary() -> FitSummary:
    """With every parameter that the schema requires."""
    summary = small_summary()
    names = ("degrees_per_step.pan", "degrees_per_step.tilt")
    return structs.replace(summary, parameters={**summary.parameters, **{name: estimate(0.06, 1e-4) for name in names}})


def small_draws() -> ResultDraws:
    """Fifty draws of three parameters."""
    physical = np.random.default_rng(3).normal(size=(50, 3))
    ratios, pose = np.full((50, 4), 0.06), np.array([0.1, 0.0])
    return ResultDraws(NAMES, physical, ratios, pose, ("effective_mirror_offset_mm",), 30 + physical[:, :1])


def small_mode() -> StoredMode:
    """Where the fit behind them ended."""
    return StoredMode(NAMES, np.zeros(3), np.eye(3), -1.0, np.ones((2, 3)), np.ones(6), np.ones(6))


def small_record(summary: FitSummary | None = None, seed: int = 0) -> FitRecord:
    """The record of a summary, by default the small one, for the small campaign."""
    summary, draws = summary or small_summary(), small_draws()
    covariance = covariance_of_draws(draws.names, draws.physical, summary.parameters)
    return FitRecord(summary, covariance, None, provenance(input_hashes(small_campaign()), seed))
