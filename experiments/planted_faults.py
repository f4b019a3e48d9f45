"""Does the test suite see a bug? One-line faults planted one at a time in a copy of the tree; a test has to fail.

    python experiments/planted_faults.py run                  # resumable; --only REGEX: of name, file and tests
    python experiments/planted_faults.py table > experiments/planted_faults.md
    python experiments/planted_faults.py check                # every entry still fits the source: under a second

`run` unpacks HEAD into a temporary folder, applies one fault there, never in the checkout, and runs
`python -m pytest -q -x -n 0` on the test files that are the likeliest to see it. Each selection of files has to pass
without a fault. A row is done again once the fault, its module or its test files have changed; `--again` runs all.
Tests marked slow take no part.
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import importlib
import io
import json
import os
import re
import signal
import subprocess
import sys
import tarfile
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ROWS = Path(__file__).parent / "output" / "planted_faults.jsonl"
LIMIT_S = 900
"""A run of tests that takes longer counts as failed: a loop that never ends is a fault that CI sees."""
ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    # An edited file may keep its size and, within a second, its time: no compiled module may outlive it.
    "PYTHONDONTWRITEBYTECODE": "1",
}


SHARED = (
    *("pytest", "numpy", "scipy.stats", "scipy.optimize", "scipy.special", "cv2", "xarray", "emcee", "beartype"),
    *("jax", "jax.numpy", "jax.scipy.special", "jaxtyping", "equinox", "lineax", "optimistix", "arviz_stats.base"),
)
"""What most test files import."""


@dataclass(frozen=True)
class Fault:
    """A bug of one line.

    Attributes:
        name: unique, in words.
        file: in `tvsbayes/`.
        old: text that stands in the file exactly once.
        new: what it becomes.
        harm: what a user would suffer.
        tests: the test files (or single tests) most likely to see it, as "package/module" or "package/module::test".
        survived: why no default test saw it before one was written for it, seen in a run or read off the tests; empty
            for the others.
    """

    name: str
    file: str
    old: str
    new: str
    harm: str
    tests: tuple[str, ...]
    survived: str = ""

    @property
    def path(self) -> str:
        """Relative to the root."""
        return f"tvsbayes/{self.file}"

    @property
    def selection(self) -> tuple[str, ...]:
        """Arguments of pytest."""
        found = []
        for one in self.tests:
            file, _, single = one.partition("::")
            package, _, module = file.partition("/")
            found.append(f"tests/{package}/test_{module}.py" + (f"::{single}" if single else ""))
        return tuple(found)


FAULTS = (
    # Gears, mirrors, cameras.
    Fault(
        "contrast of the ratios with the wrong sign",
        "model/laser_path.py",
        "jnp.where(positive, 0.5, -0.5)",
        "jnp.where(positive, -0.5, 0.5)",
        "left and right ratios change places",
        ("model/laser_path",),
    ),
    Fault(
        "backlash with the wrong sign",
        "model/laser_path.py",
        "jnp.where(approach < 0, q + half, q - half)",
        "jnp.where(approach > 0, q + half, q - half)",
        "the first reversal of every segment is read the wrong way round",
        ("model/laser_path",),
    ),
    Fault(
        "width of an unknown play three times too large",
        "model/laser_path.py",
        "UNIFORM_SD = 1 / 12**0.5",
        "UNIFORM_SD = 1 / 12 * 12**0.5 * 3**0.5",
        "a campaign that begins with an unknown approach tells too little",
        ("model/laser_path",),
    ),
    Fault(
        "degrees taken for radians",
        "model/parameter_space.py",
        "SCALE = np.array([np.pi / 180 if",
        "SCALE = np.array([1.0 if",
        "every angle is 57 times too large",
        ("model/parameter_space",),
    ),
    Fault(
        "ratios left in degrees",
        "model/parameter_space.py",
        'REGISTRY[name].unit.startswith("deg")',
        'REGISTRY[name].unit == "deg"',
        "one unit forgotten: ratios in deg/step where rad/step is meant",
        ("model/parameter_space",),
    ),
    Fault(
        "prior sd doubled",
        "model/parameter_space.py",
        "jnp.where(log, log_normal, self.value + self.u * rig_z)",
        "jnp.where(log, log_normal, self.value + 2 * self.u * rig_z)",
        "priors count a quarter of what the rig file states",
        ("model/parameter_space",),
    ),
    Fault(
        "half-normal prior from the wrong tail",
        "model/parameter_space.py",
        "return -functions.ndtri(0.5 * functions.ndtr(-z))",
        "return -functions.ndtri(0.5 * functions.ndtr(z))",
        "a large coordinate is a small backlash",
        ("model/parameter_space",),
    ),
    Fault(
        "stop sds of left and right exchanged",
        "model/parameter_space.py",
        'stop_sd_rad=jnp.reshape(block("stop_sd_deg"), (2, 2))[:, ::-1]',
        'stop_sd_rad=jnp.reshape(block("stop_sd_deg"), (2, 2))',
        "the scatter of a direction is reported for the other",
        ("model/parameter_space",),
    ),
    Fault(
        "k3 read where p1 stands",
        "model/parameter_space.py",
        '_camera_columns("k1", "k2", "k3")',
        '_camera_columns("k1", "k2", "p1")',
        "distortion with the wrong coefficient",
        ("model/parameter_space",),
    ),
    Fault(
        "receiver estimated only without readings",
        "model/parameter_space.py",
        "if not has_aperture:",
        "if has_aperture:",
        "aperture readings teach nothing about baseline and C0",
        ("model/parameter_space",),
    ),
    Fault(
        "mirror offset with the wrong sign",
        "model/laser_path.py",
        "offset = (d[1] * o[0] - d[0] * o[1])",
        "offset = (d[0] * o[1] - d[1] * o[0])",
        "the effective mirror offset is negative",
        ("model/laser_path",),
    ),
    Fault(
        "skew of the tilt axis with the wrong sign",
        "model/laser_path.py",
        "jnp.stack([zero, cos_skew, sin_skew])",
        "jnp.stack([zero, cos_skew, -sin_skew])",
        "axis and mirror 2 no longer stand at right angles",
        ("promises/conventions",),
    ),
    Fault(
        "p1 and p2 exchanged",
        "model/geometry.py",
        "q = per_camera(cameras.tangential[:, ::-1])",
        "q = per_camera(cameras.tangential)",
        "tangential distortion the wrong way round: tenths of a pixel at the border",
        ("model/cameras",),
    ),
    Fault(
        "T of the stereo pair with the wrong sign",
        "model/geometry.py",
        "transform(rotation_matrix(cameras.rotation_rad), left) + translation",
        "transform(rotation_matrix(cameras.rotation_rad), left) - translation",
        "the right camera stands on the left",
        ("model/cameras",),
    ),
    Fault(
        "cameras exchanged",
        "model/geometry.py",
        "points = materialise(jnp.stack([left, right]))",
        "points = materialise(jnp.stack([right, left]))",
        "each camera sees what the other should see",
        ("model/cameras",),
    ),
    Fault(
        "focal scale divides",
        "model/geometry.py",
        "per_camera(cameras.focal_px * cameras.focal_scale)",
        "per_camera(cameras.focal_px / cameras.focal_scale)",
        "0.5 % of focal scale are 1 % of error",
        ("model/cameras",),
    ),
    # Likelihood.
    Fault(
        "stop error per pose instead of per stop",
        "instrument/stops.py",
        "redraw = np.diff(came_by, axis=0, prepend=-1) != 0",
        "redraw = np.any(np.diff(came_by, axis=0, prepend=-1) != 0, axis=1, keepdims=True) | [False, False]",
        "spots taken while the other axis moves count as independent stops: ratios too sure",
        ("estimators/likelihood",),
    ),
    Fault(
        "four residuals per spot instead of three",
        "estimators/likelihood.py",
        "log_scale = 3 * jnp.log(pixel_noise)",
        "log_scale = 4 * jnp.log(pixel_noise)",
        "n for n - p: the pixel scale comes out too small",
        ("estimators/likelihood",),
    ),
    Fault(
        "Jacobian of the aperture's range dropped",
        "estimators/likelihood.py",
        "log_scale = 3 * jnp.log(pixel_noise) - 0.5 * jnp.log1p(aperture_part / pixel_part)",
        "log_scale = 3 * jnp.log(pixel_noise)",
        "the density is not flat in image displacement where the aperture reads",
        ("estimators/likelihood",),
    ),
    Fault(
        "log-determinant dropped",
        "estimators/likelihood.py",
        "jnp.sum(given.log_scale) - 0.5 * jnp.sum(log_variance) -",
        "jnp.sum(given.log_scale) -",
        "stop sds grow without limit",
        ("estimators/likelihood",),
    ),
    Fault(
        "correlation of the left camera used for the right",
        "estimators/campaign_arrays.py",
        "spot.ruv_right * su_r * sv_r",
        "spot.ruv_left * su_r * sv_r",
        "spots of the right camera are weighted wrongly",
        ("estimators/likelihood",),
    ),
    Fault(
        "extrinsic rotation transposed for the range",
        "estimators/likelihood.py",
        "transform(rotation_matrix(extrinsics.rotation_rad).T, from_origin)",
        "transform(rotation_matrix(extrinsics.rotation_rad), from_origin)",
        "spots are linearised at the wrong range",
        ("estimators/likelihood",),
    ),
    Fault(
        "log density of a left-out move with the wrong sign (ELPD)",
        "posterior/predictive.py",
        "log_density = log_scale - 0.5 * seen.log_variance - 0.5",
        "log_density = log_scale + 0.5 * seen.log_variance - 0.5",
        "`az.compare` prefers the worse model",
        ("estimators/linear_spots",),
    ),
    Fault(
        "constants of the log likelihood with the wrong sign",
        "estimators/campaign_arrays.py",
        "np.log(2 * np.pi) + np.linalg.slogdet",
        "np.log(2 * np.pi) - np.linalg.slogdet",
        "log likelihoods of campaigns with other stated sds cannot be compared",
        ("estimators/likelihood", "estimators/linear_spots"),
    ),
    # Fit and its summary.
    Fault(
        "effective ratio without the slope of the beam",
        "model/headlines.py",
        "jnp.stack([(ratio + half) * slope, (ratio - half) * slope], axis=1)",
        "jnp.stack([(ratio + half) + 0 * slope, (ratio - half) + 0 * slope], axis=1)",
        "the gear ratio is sold as the effective ratio: up to 1.7 % off for 1 deg of laser tilt",
        ("promises/twin_equals_model",),
    ),
    Fault(
        "prior sensitivity the wrong way round",
        "assessment/weaknesses.py",
        "changed[members, members] += factor**-2 - 1",
        "changed[members, members] += factor**2 - 1",
        "what a wider prior would do is said of a narrower one",
        ("assessment/summary::test_prior_sensitivity_is_what_a_refit_finds",),
    ),
    Fault(
        "degrees of freedom: n for n - p",
        "assessment/summary.py",
        "dof=observations - determined,",
        "dof=observations,",
        "chi2 over dof looks too good",
        ("assessment/summary::test_dof_counts_spots_less_what_they_determine",),
    ),
    Fault(
        "contraction of sds instead of variances",
        "assessment/summary.py",
        "contraction = float(1 - (sd / prior_sd) ** 2)",
        "contraction = float(1 - sd / prior_sd)",
        "informed parameters are called prior-limited",
        ("assessment/summary::test_contraction_tells_data_from_prior",),
    ),
    # Posterior.
    Fault(
        "log-Jacobian of the transport with the wrong sign",
        "posterior/proposal.py",
        "value - self.fit.log_density + found.log_jacobian",
        "value - self.fit.log_density - found.log_jacobian",
        "the sampled posterior is not the model's: noise scales are biased",
        ("posterior/draws",),
    ),
    Fault(
        "stop errors as if pixels were always as at the mode",
        "posterior/transport.py",
        "inner = weight * self.states",
        "inner = 1.0 * self.states",
        "campaigns with few stops are sampled many times slower",
        ("posterior/transport::test_the_precision_at_other_noise_scales_is_the_smoothers",),
    ),
    Fault(
        "log-Jacobian of the transport dropped",
        "posterior/proposal.py",
        "value - self.fit.log_density + found.log_jacobian",
        "value - self.fit.log_density",
        "the same, half as much",
        ("posterior/draws",),
    ),
    Fault(
        "log-Jacobian added twice to the stored density",
        "posterior/sampling.py",
        "+ fit.log_density - found.log_jacobian",
        "+ fit.log_density + found.log_jacobian",
        "`lp` of posterior.nc is not the density of its draws",
        ("posterior/draws",),
        survived="read: nothing compared the stored density with that of the stored draws.",
    ),
    Fault(
        "factor of the independence proposal reversed",
        "posterior/proposal.py",
        "return proposed, self.log_density(w) - self.log_density(proposed)",
        "return proposed, self.log_density(proposed) - self.log_density(w)",
        "sds come out at half their size without any sign of it",
        ("posterior/transport::test_the_proposal_density_and_draws_agree_in_many_dimensions",),
    ),
    Fault(
        "resume forgets the random state",
        "posterior/sampling.py",
        "log_prob=self.before.log_density[-1], random_state=self.before.random_state",
        "log_prob=self.before.log_density[-1]",
        "a resumed chain is not the unbroken one",
        ("posterior/sampling::test_a_seed_gives_one_chain_also_when_interrupted",),
    ),
    Fault(
        "no walker is stuck by its acceptance",
        "posterior/sampling.py",
        "stuck = acceptance < STUCK_ACCEPTANCE * np.median(acceptance)",
        "stuck = acceptance < 0",
        "a frozen walker passes",
        ("posterior/draws",),
    ),
    Fault(
        "no walker is stuck by its density",
        "posterior/sampling.py",
        "stuck |= deviation > max(",
        "stuck |= deviation > 1e9 * max(",
        "a walker in another mode passes",
        ("posterior/draws",),
        survived="read: the frozen walker of the test was found by its acceptance alone.",
    ),
    Fault(
        "R-hat up to 1.1 passes",
        "posterior/sampling.py",
        "RHAT_LIMIT = 1.01",
        "RHAT_LIMIT = 1.1",
        "intervals of chains that have not converged",
        ("posterior/draws",),
        survived="read: the tests set the limits themselves, or had chains of six steps.",
    ),
    Fault(
        "a hundred effective draws pass",
        "posterior/sampling.py",
        "ESS_LIMIT = 1000",
        "ESS_LIMIT = 100",
        "interval ends known to a third of an sd only",
        ("posterior/draws",),
        survived="read: as for R-hat.",
    ),
    Fault(
        "chains shorter than 50 autocorrelation times pass",
        "posterior/sampling.py",
        "if not len(kept) >= TAU_LIMIT * tau:",
        "if not TAU_LIMIT * len(kept) >= tau:",
        "R-hat and ESS of chains too short to estimate them",
        ("posterior/draws",),
        survived="read: as for R-hat.",
    ),
    Fault(
        "lost motion of a right move from the tilt axis",
        "posterior/draws.py",
        "axis, _ = DIRECTION_SIGNS[direction]",
        'axis = "pan" if direction in ("left",) else "tilt"',
        "lost motion of the wrong axis",
        ("posterior/draws",),
        survived="read: left and up only were tried.",
    ),
    Fault(
        "lost motion grows without end",
        "posterior/draws.py",
        "lambda p: np.minimum(",
        "lambda p: np.maximum(",
        "lost motion of k N instead of at most the backlash",
        ("posterior/draws",),
    ),
    Fault(
        "tails of intervals exchanged",
        "posterior/draws.py",
        "tails = (0.025, 0.975)",
        "tails = (0.975, 0.025)",
        "lower ends above upper ones",
        ("posterior/draws",),
    ),
    Fault(
        "90 % intervals called 95 %",
        "posterior/draws.py",
        "tails = (0.025, 0.975)",
        "tails = (0.05, 0.95)",
        "one interval in ten misses",
        ("posterior/draws",),
    ),
    Fault(
        "Monte Carlo errors of both interval ends exchanged",
        "posterior/draws.py",
        'method="quantile", prob=prob) for prob in tails]',
        'method="quantile", prob=prob) for prob in tails[::-1]]',
        "the longer tail is called the better known",
        ("posterior/draws",),
        survived="read: these errors were asked for of a constant only.",
    ),
    Fault(
        "Monte Carlo error of the mean without autocorrelation",
        "posterior/draws.py",
        'mcse_mean=each(array_stats.mcse, 0.0, method="mean")',
        "mcse_mean=values.std(axis=(0, 1)) / np.sqrt(values.shape[0] * values.shape[1])",
        "more digits than the chain has",
        ("posterior/draws",),
    ),
    Fault(
        "predicted looks scatter by the other direction's stop sd",
        "posterior/predictive.py",
        "sd_rad = np.radians(physical[:, STOP_COLUMNS])",
        "sd_rad = np.radians(physical[:, STOP_COLUMNS[:, ::-1]])",
        "predictive checks blame the wrong direction",
        ("posterior/predictive",),
        survived="read: nothing looked at the scatter of predicted looks but a coverage with a bound of 71 %.",
    ),
    Fault(
        "predicted looks without home offset",
        "posterior/predictive.py",
        "error = error + home[:, segment]",
        "error = error + 0 * home[:, segment]",
        "predictive checks call re-homed segments outliers",
        ("posterior/predictive",),
        survived="read: as for the other direction's stop sd.",
    ),
    # The classic estimator.
    Fault(
        "sd with n instead of n - 1",
        "estimators/four_point.py",
        "sd = float(np.std(ratios, ddof=1))",
        "sd = float(np.std(ratios, ddof=0))",
        "type A uncertainty too small",
        ("estimators/four_point",),
    ),
    Fault(
        "t with n degrees of freedom",
        "estimators/four_point.py",
        "interval95_type_a=_interval(average, type_a, n - 1)",
        "interval95_type_a=_interval(average, type_a, n)",
        "intervals too short for few repeats",
        ("estimators/four_point",),
    ),
    Fault(
        "homing taken for a leg",
        "instrument/stops.py",
        "if a.segment == b.segment and a.steps != b.steps",
        "if a.steps != b.steps",
        "one |N| is called several",
        ("instrument/stops::test_homing_is_no_leg",),
    ),
    Fault(
        "sd of one experiment for that of the mean",
        "estimators/four_point.py",
        "gum = float(np.hypot(type_a, type_b))",
        "gum = float(np.hypot(sd, type_b))",
        "repeats do not help the GUM uncertainty",
        ("estimators/four_point",),
    ),
    Fault(
        "focal part of the uncertainty doubled",
        "estimators/four_point.py",
        "0.1 * focal_scale_u) * focal_scale_u) ** 2",
        "0.1 * focal_scale_u) * 2 * focal_scale_u) ** 2",
        "type B uncertainty of the focal scale twice as large",
        ("estimators/four_point",),
    ),
    Fault(
        "effective degrees of freedom by the square",
        "statistics/intervals.py",
        "return float(u**4 / total)",
        "return float(u**2 / total)",
        "GUM intervals too wide",
        ("estimators/four_point",),
    ),
    Fault(
        "Y of frame S to the right",
        "instrument/stereo_pair.py",
        "np.column_stack((z, -x, -y))",
        "np.column_stack((z, x, -y))",
        "left and right change places",
        ("estimators/four_point",),
    ),
    Fault(
        "slope of points 3 and 4 with the wrong sign",
        "estimators/four_point.py",
        "(across[..., 2] - across[..., 3])",
        "(across[..., 3] - across[..., 2])",
        "theta_f mirrored",
        ("estimators/four_point",),
    ),
    # The digital twin.
    Fault(
        "twin: rotation of the stereo pair transposed",
        "twin/physics.py",
        "own = points_mm @ self.rotation.T +",
        "own = points_mm @ self.rotation +",
        "simulated campaigns of another stereo pair",
        ("twin/simulated_campaign", "estimators/four_point"),
    ),
    Fault(
        "twin: stop error per pose",
        "twin/physics.py",
        "elif counters[i] != counters[i - 1]:",
        "else:",
        "simulated stops are redrawn while the axis stands",
        ("twin/simulated_campaign",),
    ),
    Fault(
        "twin: homed from the wrong side",
        "twin/simulated_campaign.py",
        "side = {positive: -0.5, negative: 0.5}",
        "side = {positive: 0.5, negative: -0.5}",
        "play of the first move in the wrong direction",
        ("twin/simulated_campaign",),
        survived="run: `simulate`'s own choice of the side was read by no test, only the functions that it calls.",
    ),
    # Comparison.
    Fault(
        "log predictive density with the wrong sign",
        "comparison/scores.py",
        "log_density=float(np.mean(stats.t.logpdf(error, dof[name], scale=u)))",
        "log_density=-float(np.mean(stats.t.logpdf(error, dof[name], scale=u)))",
        "the worse predictor has the better score",
        ("comparison/gap::test_scores_of_predictions_by_hand",),
        survived="read: no test read this score.",
    ),
    Fault(
        "ratio of errors upside down",
        "comparison/scores.py",
        'ratio = scores["classic"].rms_block_deg / scores["joint"].rms_block_deg',
        'ratio = scores["joint"].rms_block_deg / scores["classic"].rms_block_deg',
        "the report says that the classic predicts better by the factor by which it is worse",
        ("comparison/gap::test_scores_of_predictions_by_hand",),
    ),
    Fault(
        "shared cameras counted twice instead of once",
        "comparison/changes.py",
        "variance = variance - 2 * np.sum(influence[0] * influence[1], axis=1)",
        "variance = variance + 2 * np.sum(influence[0] * influence[1], axis=1)",
        "a changed gear is not noticed",
        ("comparison/gap::test_a_calibration_has_not_changed_from_itself",),
    ),
    Fault(
        "distance of the error map by its largest coordinate",
        "coordinates/error_map.py",
        "np.linalg.norm(error, axis=0), np.inf)",
        "np.abs(error).max(axis=0), np.inf)",
        "a tolerance in mm is said to be met up to 1.7 times too far out",
        ("coordinates/error_map::test_bias_of_the_nominal_estimator_is_the_twins",),
        survived="read: only RMS and bias of the map were compared with the twin.",
    ),
    Fault(
        "one-sided tolerance",
        "report/evidence.py",
        "float(np.mean(np.abs(errors) <= limit))",
        "float(np.mean(errors <= limit))",
        "large negative errors meet every tolerance",
        ("comparison/gap::test_criterion_follows_its_rule",),
    ),
    Fault(
        "RMS of the error map over coordinates",
        "coordinates/error_map.py",
        "square = np.sum(kept**2, axis=(0, 1)) / count",
        "square = np.sum(kept**2, axis=(0, 1)) / count / 3",
        "errors in mm too small by a factor of 1.7",
        ("coordinates/error_map::test_bias_of_the_nominal_estimator_is_the_twins",),
    ),
    # Coordinates.
    Fault(
        "one-sided coverage factor",
        "statistics/intervals.py",
        "upper = 0.5 * (1 + probability)",
        "upper = probability",
        "k = 1.64 for 95 %",
        ("statistics/intervals::test_coverage_factor_of_infinitely_many_dof_is_normal",),
    ),
    Fault(
        "effective degrees of freedom without the fourth power",
        "statistics/intervals.py",
        "total = sum(c**4 / nu for c, nu in zip(contributions, dof, strict=True))",
        "total = sum(c**2 / nu for c, nu in zip(contributions, dof, strict=True))",
        "coverage factors of another quantity",
        ("statistics/intervals::test_effective_dof",),
    ),
    Fault(
        "coverage interval with twice its tails",
        "statistics/intervals.py",
        "tail = 0.5 * (1 - probability)",
        "tail = 1 - probability",
        "U95 of coordinates holds 90 %",
        ("statistics/intervals::test_symmetric_interval_of_normals",),
    ),
    Fault(
        "published y with the wrong sign",
        "coordinates/location.py",
        "y = baseline_mm * (0.5 - share)",
        "y = baseline_mm * (0.5 + share)",
        "points on the wrong side of the baseline's middle",
        ("coordinates/location",),
    ),
    Fault(
        "other root of the cone",
        "coordinates/beam_meeting.py",
        "ahead = cos_b * root - w[1] * direction[1]",
        "ahead = -cos_b * root - w[1] * direction[1]",
        "points behind the scanner",
        ("coordinates/location",),
    ),
    Fault(
        "stop sd of the other side in coordinates",
        "coordinates/beam_meeting.py",
        "jnp.where(side > 0, high, jnp.where(side < 0, low,",
        "jnp.where(side > 0, low, jnp.where(side < 0, high,",
        "U95 of the wrong approach",
        ("coordinates/location",),
    ),
    Fault(
        "unknown play as if it were normal of unit sd",
        "calibration/pointing.py",
        ": 1 / 12 for axis in AXES",
        ": 1.0 for axis in AXES",
        "coordinates of unknown approach 3.5 times too uncertain",
        ("coordinates/location", "calibration/pointing"),
    ),
    Fault(
        "zero of the aperture with the wrong sign",
        "coordinates/beam_meeting.py",
        "settings.aperture_rad - receiver.aperture_zero_rad",
        "settings.aperture_rad + receiver.aperture_zero_rad",
        "every reading is off by twice the zero",
        ("coordinates/location",),
    ),
    # What a robot loads.
    Fault(
        "steps for the other approach",
        "calibration/aiming.py",
        "at = output_deg(self.values, self.axis, steps, side,",
        "at = output_deg(self.values, self.axis, steps, -side,",
        "every target is missed by the backlash",
        ("calibration/pointing",),
    ),
    Fault(
        "run-up from the wrong side",
        "calibration/aiming.py",
        "first = steps - sign * ratio_sign * self.overshoot_steps",
        "first = steps + sign * ratio_sign * self.overshoot_steps",
        "the play is not taken up on the way",
        ("calibration/pointing",),
    ),
    Fault(
        "closed form of `locate`: the other root",
        "calibration/optics.py",
        "closing = cos_b * root - (",
        "closing = -cos_b * root - (",
        "the robot sees points behind itself",
        ("calibration/pointing",),
    ),
    Fault(
        "U95 with k = 1.64",
        "statistics/intervals.py",
        "NORMAL_95 = 1.959963984540054",
        "NORMAL_95 = 1.6448536269514722",
        "95 % regions hold 90 %",
        ("promises/conventions::test_95_percent_are_two_sided_and_normal",),
        survived="run: the tests of half widths took the factor from the package.",
    ),
    Fault(
        "variance of an unknown play four times too large",
        "calibration/pointing.py",
        "place = side if side else -2 * noise[2 + k]",
        "place = side if side else -4 * noise[2 + k]",
        "points of unknown approach twice as uncertain",
        ("calibration/pointing",),
    ),
    Fault(
        "C header with four digits",
        "calibration/calibration_file.py",
        'f"#define {macro[name]} {value!r}"',
        'f"#define {macro[name]} {value:.4g}"',
        "the microcontroller misses by millimetres at 1 m",
        ("calibration/pointing",),
    ),
    Fault(
        "aperture reading without its zero",
        "calibration/pointing.py",
        'return float(angle) + self.estimates["aperture_zero_deg"]',
        "return float(angle)",
        "the reading foretold for a target is off by the zero",
        ("calibration/pointing",),
    ),
    # Certificate.
    Fault(
        "ISO 230-2 A with one sd",
        "metrology/iso230.py",
        "low_up, high_up = mean_up - 2 * sd_up, mean_up + 2 * sd_up",
        "low_up, high_up = mean_up - sd_up, mean_up + sd_up",
        "accuracy better than the standard's",
        ("metrology/iso230::test_figures_of_the_published_readings",),
    ),
    Fault(
        "ISO 230-2 R with two sds",
        "metrology/iso230.py",
        "r_up, r_down = 4 * sd_up, 4 * sd_down",
        "r_up, r_down = 2 * sd_up, 2 * sd_down",
        "unidirectional repeatability half as large",
        ("metrology/iso230::test_figures_of_the_published_readings",),
    ),
    Fault(
        "ISO 230-2 E of the up side only",
        "metrology/iso230.py",
        "systematic_deg=span(np.maximum(mean_up, mean_down), np.minimum(mean_up, mean_down))",
        "systematic_deg=span(mean_up, mean_up)",
        "systematic deviation without reversal",
        ("metrology/iso230::test_figures_of_the_published_readings",),
    ),
    Fault(
        "ISO 230-2 M of sums",
        "metrology/iso230.py",
        "mean, reversal = 0.5 * (mean_up + mean_down), mean_up - mean_down",
        "mean, reversal = mean_up + mean_down, mean_up - mean_down",
        "M twice as large",
        ("metrology/iso230::test_figures_of_the_published_readings",),
    ),
    Fault(
        "ISO 230-2 B with the wrong sign",
        "metrology/iso230.py",
        "mean, reversal = 0.5 * (mean_up + mean_down), mean_up - mean_down",
        "mean, reversal = 0.5 * (mean_up + mean_down), mean_down - mean_up",
        "a compensation table of this sign doubles the reversal error",
        ("metrology/iso230::test_figures_of_the_published_readings",),
    ),
    Fault(
        "ISO 230-2 sd with n",
        "metrology/iso230.py",
        "np.nanstd(up, axis=-1, ddof=1)",
        "np.nanstd(up, axis=-1, ddof=0)",
        "repeatability too good by a tenth",
        ("metrology/iso230::test_figures_of_the_published_readings",),
    ),
    Fault(
        "simulated data called traceable",
        "metrology/dcc.py",
        'if campaign.header.get("synthetic"):\n        return Traceability',
        'if campaign.header.get("simulated"):\n        return Traceability',
        "a twin's report claims a length standard",
        ("report/page::test_traceability_is_what_the_certificate_says",),
    ),
    Fault(
        "a rest's looks against each other as if independent",
        "statistics/intervals.py",
        "np.sqrt(variances[i] + 1 / weight)",
        "np.sqrt(variances[i])",
        "clean campaigns are suspected of depth",
        ("comparison/gap::test_recursive_residuals_are_independent_and_standard",),
    ),
    Fault(
        "chance of a gross defect with the wrong sign",
        "statistics/intervals.py",
        "far = -x + np.log(",
        "far = x + np.log(",
        "the smaller of two gross defects is the cause",
        ("comparison/gap::test_the_larger_of_two_gross_defects_is_the_cause",),
    ),
    Fault(
        "ratios that follow a backlash the wrong way",
        "posterior/transport.py",
        "step[:, place + 1 :] += self._beyond_linear",
        "step[:, place + 1 :] -= self._beyond_linear",
        "the sampler leaves the ridge of ratio and backlash, and calls itself unconverged",
        ("posterior/draws::test_a_ratio_follows_the_degrees_of_a_backlash",),
    ),
    Fault(
        "robust distance by the weight alone",
        "estimators/linear_spots.py",
        "covariance + (weight[len(values)] - 1) * np.eye(4)",
        "covariance * weight[len(values)]",
        "stop errors shrink with the weight of a spot",
        ("estimators/linear_spots::test_leave_one_out_of_weighted_spots_is_that_of_full_weight",),
    ),
    Fault(
        "points that a third of the draws lose",
        "calibration/pointing.py",
        "least = DIVERGING_SDS *",
        "least = 0.4 *",
        "the robot is sent where no range can be told",
        ("calibration/pointing::test_points_that_too_many_draws_lose_are_refused_as_by_the_draws",),
    ),
    Fault(
        "contrast left out of the positioning figures",
        "pipeline.py",
        ", contrast_deg_per_step=contrast)",
        ")",
        "ISO 230-2 figures of gears that the fit does not see",
        ("report/page::test_axes_are_judged_with_the_fitted_contrast",),
    ),
    Fault(
        "DCC: degrees called radians",
        "metrology/dcc.py",
        '"deg": r"\\degree"',
        '"deg": r"\\radian"',
        "a machine reads the backlash 57 times too large",
        ("metrology/dcc",),
    ),
    Fault(
        "DCC: ratios in degrees",
        "metrology/dcc.py",
        '"deg/step": r"\\degree\\per\\one"',
        '"deg/step": r"\\degree"',
        "a ratio without its step",
        ("metrology/dcc",),
    ),
    Fault(
        "DCC: whole width as expanded uncertainty",
        "metrology/dcc.py",
        "expanded, middle = 0.5 * (high - low), 0.5 * (high + low)",
        "expanded, middle = high - low, 0.5 * (high + low)",
        "k = 3.92 in the certificate",
        ("metrology/dcc",),
    ),
    # Planning.
    Fault(
        "information of the last look dropped",
        "planning/expectation.py",
        "rows = np.asarray(found.rows)[..., :PARAMETERS].reshape(-1, PARAMETERS)",
        "rows = np.asarray(found.rows)[:-1, :, :PARAMETERS].reshape(-1, PARAMETERS)",
        "plans look slightly worse than they are",
        ("planning/planner::test_a_plans_information_is_the_fits_own",),
    ),
    Fault(
        "run-up checked on the wrong side",
        "planning/candidates.py",
        "start = positions.steps - np.array(side) * overshoot",
        "start = positions.steps + np.array(side) * overshoot",
        "plans run into the motor limits",
        ("planning/forecast",),
        survived="known: limits were tried with a grid that has no position near them on the side that matters.",
    ),
    Fault(
        "path of the contrast counted twice",
        "planning/candidates.py",
        "scale = np.asarray(space.u)[CONTRAST_COLUMNS] * np.pi / 360",
        "scale = np.asarray(space.u)[CONTRAST_COLUMNS] * np.pi / 180",
        "the contrast seems known twice as well",
        ("planning/planner::test_looks_add_up_to_the_plan_they_make",),
    ),
    Fault(
        "time model: placing a sheet as fast as a move",
        "instrument/plan.py",
        '"place": "placement_s"',
        '"place": "move_s"',
        "plans take longer than they say",
        ("twin/simulated_campaign",),
    ),
    Fault(
        "time model: seconds per hour",
        "planning/expectation.py",
        "plan_seconds(rig, steps) / 60",
        "plan_seconds(rig, steps) / 3600",
        "minutes are hours",
        ("planning/forecast",),
    ),
    Fault(
        "assurance off by one experiment",
        "planning/search.py",
        "while above - below > 1:",
        "while above - below > 2:",
        "n80 and n95 one too large",
        ("planning/forecast",),
        survived="read: the assurance at n80 and n95 was asked for, not that one less fails.",
    ),
    Fault(
        "U95 of a target with k = 1",
        "planning/target.py",
        '1.0 if match["kind"] == "u" else NORMAL_95',
        '1.0 if match["kind"] == "u" else 1.0',
        "targets of U95 are met by half as many experiments",
        ("planning/planner::test_targets_are_read",),
    ),
    Fault(
        "classic count with n degrees of freedom",
        "planning/forecast.py",
        "wanted = max(2, math.ceil((coverage_factor(n - 1)",
        "wanted = max(2, math.ceil((coverage_factor(n)",
        "a repeat too few",
        ("planning/planner::test_the_classics_count_is_the_first_that_suffices",),
    ),
    Fault(
        "scatter known as if no parameter were fitted",
        "planning/forecast.py",
        "left_over = max(0.0, 1 - determined / (2 * looks))",
        "left_over = 1.0",
        "n for n - p: assurance too high",
        ("planning/planner::test_what_the_geometry_takes_from_the_stops_is_not_left_for_their_scatter",),
    ),
    Fault(
        "next looks: a full turn away taken for here",
        "planning/limits.py",
        "(found.turned | (not turned))",
        "(~found.turned | (not turned))",
        "a full turn away is promised, looks nearby are ordered",
        ("planning/planner::test_next_looks_are_worth_what_they_say_here_and_a_full_turn_away",),
        survived="planted by a reviewer: only the order of the next looks was asked for.",
    ),
    Fault(
        "search after data: home variance for its inverse",
        "planning/search.py",
        "range(PARAMETERS, PARAMETERS + 2)] = 1 / HOME_VARIANCE_RAD2",
        "range(PARAMETERS, PARAMETERS + 2)] = HOME_VARIANCE_RAD2",
        "looks after a campaign are chosen as if homing told nothing",
        ("planning/planner::test_a_search_after_data_knows_no_home_offset",),
        survived="planted by a reviewer: any design of the search was good enough for its test.",
    ),
    Fault(
        "exchanged design kept where it is worse",
        "planning/search.py",
        "merit(other) > merit(plain) else",
        "merit(other) < merit(plain) else",
        "the plan is the worse of two",
        ("planning/planner::test_exchanges_are_kept_where_they_raise_assurance_or_lower_the_median",),
        survived="planted by a reviewer: no test compared the design with the one before its exchanges.",
    ),
    Fault(
        "shares of pixel noise and stop errors exchanged",
        "planning/limits.py",
        'parts["pixel noise"] = float(pull @ noise @ pull)',
        'parts["pixel noise"] = float(pull @ (data - noise) @ pull)',
        "better cameras are bought where stops are the trouble",
        ("planning/forecast::test_shares_of_two_parameters_by_hand",),
        survived="planted by a reviewer: shares were asked to add up, not to be right.",
    ),
    Fault(
        "needed uncertainty by the share for its square",
        "planning/limits.py",
        "+= share**-2 - 1",
        "+= share**-1 - 1",
        "an input is asked for far better than needed",
        ("planning/forecast::test_an_input_has_to_be_known_as_much_better_as_the_floor_is_too_high",),
        survived="planted by a reviewer: the words of the advice were asked for, not its number.",
    ),
    Fault(
        "stated uncertainty shown as the needed one",
        "planning/limits.py",
        "= {_at_most(share * u)} instead of",
        "= {_at_most(u)} instead of",
        "the cure of a floor is what is there already",
        ("planning/planner::test_a_target_below_the_floor_names_the_term_and_what_would_do",),
        survived="planted by a reviewer: the words of the advice were asked for, not its number.",
    ),
    Fault(
        "needed uncertainty rounded up",
        "planning/limits.py",
        "last * math.floor(value / last + 1e-9)",
        "last * math.ceil(value / last - 1e-9)",
        "what would do does not do",
        ("planning/forecast::test_what_is_needed_is_never_rounded_up",),
    ),
    Fault(
        "measuring stops at a hundredth of the value a minute",
        "planning/limits.py",
        "worth = STOP_SHARE_PER_MINUTE * now",
        "worth = 10 * STOP_SHARE_PER_MINUTE * now",
        "a campaign ends ten times too early",
        ("planning/forecast::test_measuring_stops_below_a_thousandth_of_the_value_a_minute",),
        survived="planted by a reviewer: the rule was tried far from its threshold only.",
    ),
    Fault(
        "classic answer: standard uncertainty for the half width",
        "planning/forecast.py",
        "half_width = target.limit * NORMAL_95 / target.factor",
        "half_width = target.limit / target.factor",
        "four times as many experiments are asked for",
        ("planning/forecast::test_the_classics_answer_before_data",),
        survived="planted by a reviewer: no test read the classic's answer.",
    ),
    Fault(
        "classic answer: ends of the chi-square interval exchanged",
        "planning/forecast.py",
        "for p in (0.975, 0.025))",
        "for p in (0.025, 0.975))",
        "the interval of s and of n is upside down",
        ("planning/forecast::test_the_classics_answer_after_data_has_the_interval_of_chi_square",),
        survived="planted by a reviewer: no test read the classic's answer.",
    ),
    Fault(
        "classic forecast: one stop of two",
        "planning/forecast.py",
        "pair = stops + stops[[1, 0, 3, 2]]",
        "pair = stops",
        "the classic method looks better than it is",
        ("planning/forecast::test_the_classics_forecast_is_what_its_experiments_do",),
        survived="planted by a reviewer: the classic's curve was asked to fall, not to be right.",
    ),
    Fault(
        "classic forecast: systematic error with the wrong sign",
        "planning/forecast.py",
        "errors.append(ratios[0] - true)",
        "errors.append(true - ratios[0])",
        "a correction goes the wrong way",
        ("planning/forecast::test_the_classics_forecast_is_what_its_experiments_do",),
        survived="planted by a reviewer: no test read the classic's answer.",
    ),
    Fault(
        "classic curve without the stereo calibration",
        "planning/forecast.py",
        "forecast.sd[:, rows] ** 2 / each + forecast.stereo_u[rows] ** 2",
        "forecast.sd[:, rows] ** 2 / each",
        "repeats seem to lower what is common to all of them",
        ("planning/forecast::test_the_classics_value_adds_stereo_to_the_mean_of_its_experiments",),
        survived="planted by a reviewer: the classic's curve was asked to fall, not to be right.",
    ),
    Fault(
        "tilt stop dropped at a target's point",
        "planning/target.py",
        "own[:, :2].sum(axis=1)",
        "own[:, :1].sum(axis=1)",
        "z of a point seems as sure as its calibration",
        ("planning/planner::test_stops_and_reading_at_a_point_are_those_of_the_twins_optics",),
        survived="planted by a reviewer: only x was tried, in which the tilt's stop is of second order.",
    ),
    Fault(
        "study: assurance of the fits that converged",
        "studies/study.py",
        "assurance=hits / len(rows),",
        "assurance=hits / n,",
        "fits that fail make a plan look better",
        ("studies/study::test_failures_count_against_the_assurance",),
    ),
    Fault(
        "study: coverage of one tail",
        "studies/study.py",
        "np.mean(np.abs(pit - 0.5) < level / 2)",
        "np.mean(np.abs(pit - 0.5) < level)",
        "every interval seems to hold the truth",
        ("studies/study::test_counts_of_a_perfect_estimator_are_within_bounds_and_of_a_boastful_one_outside",),
    ),
    # Files.
    Fault(
        "not-a-number accepted",
        "files/csv_table.py",
        "if not (isfinite(value) and low <= value <= high):",
        "if value < low or value > high:",
        "one empty or wrong cell makes every result not-a-number",
        ("files/documents",),
    ),
    Fault(
        "duplicate key accepted",
        "files/documents.py",
        "            if key not in values:\n",
        "            if True:\n",
        "the second of two values counts, silently",
        ("files/documents",),
    ),
    Fault(
        "written without a rename",
        "files/disk.py",
        "            os.replace(temporary, path)\n",
        "            path.write_bytes(data)\n",
        "a crash leaves half a file where a whole one was",
        ("files/documents",),
    ),
    Fault(
        "renamed before it is on the disk",
        "files/disk.py",
        "                os.fsync(stream.fileno())\n",
        "                pass\n",
        "after a power cut an empty file stands where a whole one was",
        ("files/documents",),
    ),
    Fault(
        "spot numbers twice",
        "instrument/campaign.py",
        'table.check_unique("spot", spots, "unique ids")',
        'table.check_unique("spot", [], "unique ids")',
        "two rows answer to one number",
        ("promises/hostile",),
    ),
    Fault(
        "moves out of order accepted",
        "instrument/campaign.py",
        "if row and times_s[row] < times_s[row - 1]:",
        "if row and times_s[row] < times_s[0]:",
        "shuffled moves make another campaign",
        ("promises/hostile",),
    ),
    Fault(
        "mirrored stereo rotation accepted",
        "instrument/stereo_pair.py",
        "deviation = max(np.abs(rotation @ rotation.T - np.eye(3)).max(), abs(np.linalg.det(rotation) - 1.0))",
        "deviation = np.abs(rotation @ rotation.T - np.eye(3)).max()",
        "a left-handed camera frame passes",
        ("instrument/rig",),
    ),
    # Device.
    Fault(
        "journal: CRC not compared",
        "acquisition/journal.py",
        "if zlib.crc32(line[9:]) != crc:",
        "if zlib.crc32(line[9:]) < 0:",
        "damaged lines count as events",
        ("acquisition/journal",),
    ),
    Fault(
        "journal: chain not compared",
        "acquisition/journal.py",
        "if found.previous != previous:",
        "if found.previous < 0:",
        "lines of another run count as events",
        ("acquisition/journal",),
    ),
    Fault(
        "frame: CRC not compared",
        "positioner/protocol.py",
        "if crc16(match[1]) != int(match[2], 16):",
        "if crc16(match[1]) < 0:",
        "a disturbed line moves the mirrors",
        ("positioner/protocol",),
    ),
    Fault(
        "driver: an older answer taken for this one",
        "positioner/driver.py",
        "if answer.sequence == sequence:",
        "if answer.sequence <= sequence:",
        "a move counts as done before it has begun",
        ("positioner/driver", "positioner/faults"),
    ),
    Fault(
        "driver: arrival not compared with the order",
        "positioner/driver.py",
        "if reached != wanted or (state.pan_target_steps, state.tilt_target_steps) != wanted:",
        "if False:",
        "a stop elsewhere counts as arrival",
        ("positioner/limits",),
        survived="run: no simulated device had said done at another place.",
    ),
    Fault(
        "driver: reset not noticed",
        "positioner/driver.py",
        "if state.boot != self._boot:",
        "if state.boot < 0:",
        "moves go on from lost counters",
        ("positioner/driver",),
    ),
    Fault(
        "device: a repeated request executed again",
        "positioner/firmware_model.py",
        "if sequence == self._last_sequence and line == self._last_request:",
        "if False:",
        "a retry is refused or moves twice",
        ("positioner/protocol",),
    ),
    Fault(
        "device: soft limit of tilt open upwards",
        "positioner/firmware_model.py",
        'limits["tmin"] <= tilt <= limits["tmax"]',
        'limits["tmin"] <= tilt',
        "tilt runs into the stop",
        ("positioner/limits",),
        survived="run: the lower limit of tilt and the upper one of pan were tried, no other.",
    ),
    Fault(
        "device: laser stays on in alarm",
        "positioner/firmware_model.py",
        'if argument == "1" and self._status == "alarm":',
        'if argument == "1" and self._status == "never":',
        "the laser can be switched on in alarm",
        ("positioner/protocol",),
    ),
    Fault(
        "laser stays on when a camera fails",
        "acquisition/observation.py",
        "            lit, on = self._lit(positioner, dark)\n        finally:\n            positioner.laser(False)",
        "            lit, on = self._lit(positioner, dark)\n        finally:\n            pass",
        "an exception leaves the laser on",
        ("acquisition/engine",),
    ),
    Fault(
        "homing called an arrival from below",
        "acquisition/engine.py",
        "name = names[0] if steps > 0 else names[1]",
        "name = names[0]",
        "the recorded approach of move 0 is wrong: every ratio hangs on it",
        ("acquisition/engine::test_approach_after_homing",),
    ),
    # Pictures.
    Fault(
        "neighbours of clipped pixels kept",
        "cameras/spot_fit.py",
        "usable = cv2.dilate(clipped, np.ones((3, 3), np.uint8)) == 0",
        "usable = clipped >= 0",
        "clipped cores pull the centre and widen the spot",
        ("cameras/detection",),
    ),
    Fault(
        "centres half a pixel off",
        "cameras/spot_fit.py",
        "centre = p[1:3] + step[1:3] + np.array(patch.corner)",
        "centre = p[1:3] + step[1:3] + np.array(patch.corner) + 0.5",
        "integer = corner instead of centre of a pixel: half a pixel everywhere",
        ("cameras/detection",),
    ),
    Fault(
        "covariance of a spot with the contrast, not its square",
        "cameras/spot_fit.py",
        "units = np.array([1.0, noise.gain_dn, noise.speckle_contrast**2])",
        "units = np.array([1.0, noise.gain_dn, noise.speckle_contrast])",
        "stated sds too large by the root of the contrast",
        ("cameras/detection",),
    ),
    Fault(
        "correlation of a spot doubled",
        "cameras/spot_fit.py",
        "mixed = (both - u - v) / 2",
        "mixed = both - u - v",
        "covariances that are none for turned spots",
        ("cameras/detection",),
    ),
    Fault(
        "epipolar gate open",
        "cameras/contour.py",
        "return ~(distance <= np.maximum(allowed, EPIPOLAR_FLOOR_PX))",
        "return ~(distance <= np.maximum(allowed, 1e3 * EPIPOLAR_FLOOR_PX))",
        "two different reflections count as one spot",
        ("cameras/detection",),
    ),
    Fault(
        "cameras exchanged in spots.csv",
        "cameras/detection.py",
        "for side, one in zip(SIDES, (left, right), strict=True):\n        good",
        "for side, one in zip(SIDES, (right, left), strict=True):\n        good",
        "the table holds left pixels under right",
        ("cameras/detection",),
    ),
    Fault(
        "rendered pixels half a pixel off",
        "twin/board_pictures.py",
        "offsets = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS - 0.5",
        "offsets = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS",
        "boards stand half a pixel off in rendered pictures",
        ("twin/spot_pictures",),
    ),
    Fault(
        "stereo calibration: n for n - p",
        "cameras/bundle_adjustment.py",
        "dof = int(kept.sum()) - int(free.sum()) - 6 * len(views)",
        "dof = int(kept.sum())",
        "the covariance of the cameras is too small",
        ("cameras/stereo_calibration::test_degrees_of_freedom_are_coordinates_less_unknowns",),
    ),
)


def stale(root: Path = ROOT, *, parse: bool = True) -> list[str]:
    """What is wrong with the list: texts that do not stand exactly once, changes that are none, names twice.

    Args:
        root: of the tree.
        parse: also see that every fault leaves a Python module, which takes seconds.
    """
    problems, names = [], set()
    texts = {path: (root / path).read_text(encoding="utf-8") for path in {fault.path for fault in FAULTS}}
    for fault in FAULTS:
        text = texts[fault.path]
        if text.count(fault.old) != 1:
            problems.append(f"{fault.name}: its text stands {text.count(fault.old)} times in {fault.path}")
        elif fault.new == fault.old:
            problems.append(f"{fault.name}: changes nothing")
        elif parse:
            try:
                compile(text.replace(fault.old, fault.new), fault.path, "exec")
            except SyntaxError as error:
                problems.append(f"{fault.name}: not Python any more: {error}")
        if fault.name in names:
            problems.append(f"{fault.name}: twice")
        names.add(fault.name)
        problems += [f"{fault.name}: no {t}" for t in fault.selection if not (root / t.split("::")[0]).is_file()]
    return problems


@contextmanager
def planted(root: Path, fault: Fault) -> Iterator[None]:
    """A copy of the tree with one fault in it, whole again afterwards.

    Raises:
        ValueError: the entry does not fit the file.
    """
    path = root / fault.path
    text = path.read_text(encoding="utf-8")
    if text.count(fault.old) != 1:
        raise ValueError(f"{fault.name}: its text stands {text.count(fault.old)} times in {fault.path}")
    path.write_text(text.replace(fault.old, fault.new), encoding="utf-8")
    try:
        yield
    finally:
        path.write_text(text, encoding="utf-8")


def git(*words: str) -> bytes:
    """What git says in the checkout."""
    return subprocess.run(["git", *words], cwd=ROOT, check=True, capture_output=True).stdout


def digest(revision: str, selection: Sequence[str], fault: Fault | None) -> str:
    """Of what an outcome hangs on first: the fault and its module (the whole package without one), and the tests."""
    paths = [fault.path if fault else "tvsbayes", "tests/conftest.py", *(t.split("::")[0] for t in selection)]
    hashes = git("rev-parse", *(f"{revision}:{path}" for path in paths)).decode()
    return hashlib.sha256(repr((hashes, selection, fault and astuple(fault)[1:4])).encode()).hexdigest()[:16]


def prepare(scratch: Path) -> None:
    """Load what every test file imports, for the children to share: most of a cheap test's time. Never the package."""
    os.environ |= ENVIRONMENT
    # What no fault touches is compiled once.
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(scratch / "jax")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.2"
    sys.dont_write_bytecode = True
    for name in SHARED:
        importlib.import_module(name)
    assert "tvsbayes" not in sys.modules


def tested(root: Path, selection: Sequence[str]) -> dict[str, object]:
    """Run tests on a copy in a child of this process: whether one failed, the first that did, and the seconds."""
    start, output = time.monotonic(), root.parent / "output.txt"
    command = ["-q", "-x", "-n", "0", "-rfE", "--tb=no", "-p", "no:cacheprovider"]
    # Pytest's plugins are among what is shared, their own assertions are not looked at here.
    command += ["-W", "ignore::pytest.PytestAssertRewriteWarning", *selection]
    with warnings.catch_warnings():
        # JAX warns of forks; nothing has been computed in this process, and no thread of its runs.
        warnings.simplefilter("ignore")
        child = os.fork()
    if child == 0:
        with output.open("wb") as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
        os.setsid()
        os.chdir(root)
        os.environ["PYTHONPATH"] = str(root)
        sys.path.insert(0, str(root))
        code = 3
        try:
            import pytest

            code = int(pytest.main(command))
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            sys.stdout.flush()
            os._exit(code)
    done, status = 0, 0
    while done == 0:
        time.sleep(0.05)
        done, status = os.waitpid(child, os.WNOHANG)
        if done == 0 and time.monotonic() - start > LIMIT_S:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return {"failed": True, "first": "(time over)", "seconds": float(LIMIT_S)}
    seconds, code = round(time.monotonic() - start, 1), os.waitstatus_to_exitcode(status)
    text = output.read_text(errors="replace")
    # 0: all passed, 1: a test failed; all else (no such test, no import) says nothing about the tests.
    if code not in (0, 1):
        raise RuntimeError(f"pytest ended with {code}:\n{text[-2000:]}")
    first = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", text, re.MULTILINE)
    return {"failed": code == 1, "first": first[1] if first else "", "seconds": seconds}


def read_rows(path: Path) -> dict[str, dict]:
    """Complete rows by digest; a torn last line is ignored."""
    rows = {}
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue
        rows[row["digest"]] = row
    return rows


def run(arguments: argparse.Namespace) -> int:
    """Append a row for every fault that has none; the number of survivors among those asked for."""
    if problems := stale():
        raise SystemExit("\n".join(["the list is stale:", *problems]))
    # One commit from beginning to end, whatever is committed meanwhile.
    commit = git("rev-parse", "--short", "HEAD").decode().strip()
    chosen = [f for f in FAULTS if re.search(arguments.only, " ".join((f.name, f.file, *f.selection)))]
    rows = {} if arguments.again else read_rows(arguments.rows)
    arguments.rows.parent.mkdir(parents=True, exist_ok=True)
    survivors = 0
    with tempfile.TemporaryDirectory(prefix="tvsbayes-faults-") as scratch, arguments.rows.open("a") as file:
        copy = Path(scratch) / "tree"
        prepare(Path(scratch))
        with tarfile.open(fileobj=io.BytesIO(git("archive", commit))) as archive:
            archive.extractall(copy, filter="data")

        def outcome(name: str, selection: tuple[str, ...], fault: Fault | None) -> dict:
            key = digest(commit, selection, fault)
            if key not in rows:
                found = tested(copy, selection)
                rows[key] = {"digest": key, "name": name, "commit": commit, **found}
                file.write(json.dumps(rows[key]) + "\n")
                file.flush()
            return rows[key]

        for fault in chosen:
            if digest(commit, fault.selection, fault) not in rows:
                clean = outcome("clean", fault.selection, None)
                if clean["failed"]:
                    raise SystemExit(f"{clean['first']} fails without any fault")
            with planted(copy, fault):
                row = outcome(fault.name, fault.selection, fault)
            survivors += not row["failed"]
            word = f"caught by {row['first']}" if row["failed"] else "SURVIVED"
            print(f"{fault.name}: {word} ({row['seconds']:.0f} s)", flush=True)
    print(f"{len(chosen) - survivors} of {len(chosen)} caught")
    return survivors


def table(arguments: argparse.Namespace) -> int:
    """The Markdown table of what was run at the present state of the package and its tests."""
    rows = read_rows(arguments.rows)
    found = {f.name: rows.get(digest("HEAD", f.selection, f)) for f in FAULTS}
    clean = [row for row in rows.values() if row["name"] == "clean"]
    done = [row for row in found.values() if row is not None]
    caught = sum(row["failed"] for row in done)
    minutes = sum(row["seconds"] for row in [*done, *clean]) / 60
    commits = sorted({row["commit"] for row in done})
    at_first = sum(bool(f.survived) for f in FAULTS)
    print("# Planted faults\n")
    print("Written by `python experiments/planted_faults.py table > experiments/planted_faults.md`", end=" ")
    print(f"on {datetime.date.today()} from runs at commit {', '.join(commits)}.\n")
    print(f"**{caught} of {len(FAULTS)} faults caught**", end="")
    print(f", {len(done) - caught} survive, {len(FAULTS) - len(done)} not run;", end=" ")
    print(f"{minutes:.0f} minutes on one core, {len(clean)} clean runs of the tests included.", end=" ")
    print(f"{at_first} of the faults got past the tests likely to see them, in a run or by reading:", end=" ")
    print("listed below; each has a test now.\n")
    print("| fault | file | harm | first failing test | s |\n|---|---|---|---|---|")
    for fault in FAULTS:
        row = found[fault.name]
        if row is None:
            verdict = ("not run", "")
        else:
            verdict = (f"`{Path(row['first']).name}`" if row["failed"] else "**SURVIVED**", f"{row['seconds']:.0f}")
        print(f"| {fault.name} | `{fault.file}` | {fault.harm} | {verdict[0]} | {verdict[1]} |")
    if at_first:
        print("\n## Survivors at first\n")
        for fault in FAULTS:
            if fault.survived:
                print(f"- {fault.name}: {fault.survived}")
    return len(FAULTS) - caught


def check(arguments: argparse.Namespace) -> int:
    """Say what of the list no longer fits the source."""
    problems = stale()
    print("\n".join(problems) or f"{len(FAULTS)} faults fit the source")
    return len(problems)


def main() -> None:
    """The command; exit code 1 where a fault survives or the list is stale."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=Path, default=ROWS)
    commands = parser.add_subparsers(required=True)
    for command in (run, table, check):
        one = commands.add_parser(command.__name__, help=command.__doc__.splitlines()[0])
        one.set_defaults(command=command)
        if command is run:
            one.add_argument("--only", default="", help="regular expression found in name, file or tests")
            one.add_argument("--again", action="store_true", help="rows that are there count for nothing")
    arguments = parser.parse_args()
    raise SystemExit(bool(arguments.command(arguments)))


if __name__ == "__main__":
    main()
