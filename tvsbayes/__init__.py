"""tvsbayes: what one motor step of a geared, stepper-driven mechanism does, with its uncertainty.

From a campaign folder to a robot:

    campaign = tvsbayes.read_campaign("mine")            # any instrument: moves, spots, cameras, priors
    fit = tvsbayes.fit(campaign)                         # mode and Laplace approximation
    posterior = tvsbayes.sample(fit)                     # its posterior; .propagate takes it to any quantity
    calibration = tvsbayes.calibration_of(fit, posterior)
    found = tvsbayes.locate(calibration, 100, 20, 70.0)  # counters and aperture reading -> mm, with covariance
    results = tvsbayes.calibrate(campaign, folder)       # all steps above, and the files that `tvsbayes fit` writes
    calibration = tvsbayes.load_calibration("mine")      # from results/ after `tvsbayes fit mine`: needs NumPy alone
    posterior = tvsbayes.load_posterior("mine")          # its draws, for a scanner or an axis: without JAX

For one axis `compensate("stage", "linuxcnc")` makes a table for a controller. `verify("stage", "fresh")` tests whether
the machine keeps what its table, or a scanner's calibration, promises.

Units are mm, px, and degrees where a name says `deg`. Frames, signs and names: `data/docs/conventions.md`; the map of
all modules: `data/docs/architecture.md`; more examples: `data/docs/python.md`. Figures: `tvsbayes.plots`. Classic
estimator: `tvsbayes.estimators.four_point`; simulation: `tvsbayes.twin.simulated_campaign`; planning:
`tvsbayes.planning.planner`; two campaigns: `tvsbayes.comparison.changes`. Input that cannot be used raises
`tvsbayes.errors.InputError`, which states the place, the value found and the remedy.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tvsbayes.assessment.fitted_calibration import calibration_of as calibration_of
    from tvsbayes.calibration.pointing import Calibration as Calibration
    from tvsbayes.compensation.promise import compensate as compensate
    from tvsbayes.coordinates.location import Locations as Locations
    from tvsbayes.coordinates.location import locate as locate
    from tvsbayes.errors import TvsError as TvsError
    from tvsbayes.estimators.joint_fit import JointFit as JointFit
    from tvsbayes.estimators.joint_fit import fit as fit
    from tvsbayes.instrument.campaign import Campaign as Campaign
    from tvsbayes.instrument.model_choice import ModelChoice as ModelChoice
    from tvsbayes.pipeline import CampaignResults as CampaignResults
    from tvsbayes.pipeline import calibrate as calibrate
    from tvsbayes.pipeline import load_calibration as load_calibration
    from tvsbayes.pipeline import load_posterior as load_posterior
    from tvsbayes.pipeline import read_campaign as read_campaign
    from tvsbayes.pipeline import verify as verify
    from tvsbayes.posterior.draws import Posterior as Posterior
    from tvsbayes.posterior.sampling import sample as sample
    from tvsbayes.progress import Progress as Progress
    from tvsbayes.report import figures as plots
    from tvsbayes.results.comparison_record import Comparison as Comparison
    from tvsbayes.results.estimates import FitSummary as FitSummary
    from tvsbayes.results.fit_record import FitRecord as FitRecord
    from tvsbayes.results.fit_record import read_fit as read_fit

_HOME = {
    "Calibration": "calibration.pointing",
    "Campaign": "instrument.campaign",
    "CampaignResults": "pipeline",
    "Comparison": "results.comparison_record",
    "FitRecord": "results.fit_record",
    "FitSummary": "results.estimates",
    "JointFit": "estimators.joint_fit",
    "Locations": "coordinates.location",
    "ModelChoice": "instrument.model_choice",
    "Posterior": "posterior.draws",
    "Progress": "progress",
    "TvsError": "errors",
    "calibrate": "pipeline",
    "calibration_of": "assessment.fitted_calibration",
    "compensate": "compensation.promise",
    "fit": "estimators.joint_fit",
    "load_calibration": "pipeline",
    "load_posterior": "pipeline",
    "locate": "coordinates.location",
    "read_campaign": "pipeline",
    "read_fit": "results.fit_record",
    "sample": "posterior.sampling",
    "verify": "pipeline",
}
__all__ = [*_HOME, "plots"]


def __getattr__(name: str) -> object:
    """Load a public name when it is first used: readers import NumPy, the estimator imports JAX."""
    if name in _HOME:
        return getattr(import_module(f"tvsbayes.{_HOME[name]}"), name)
    if name == "plots":
        return import_module("tvsbayes.report.figures")
    if name == "__version__":
        from tvsbayes.files.packages import own_version

        return own_version()
    raise AttributeError(f"module 'tvsbayes' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return the public names, loaded or not."""
    return sorted([*__all__, "__version__"])
