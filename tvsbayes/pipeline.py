"""From a campaign to its results: fit, posterior, calibration and evidence, stored in `results/`.

The commands and Python callers use this module. Units stand in the names; only fits load JAX.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from tvsbayes.display import Shown, View
from tvsbayes.errors import (
    MISFIT_REMEDY,
    InputError,
    NotConverged,
    NothingToEstimate,
    Reason,
    TvsError,
    escaped,
    refusal,
)
from tvsbayes.files.disk import output_place
from tvsbayes.files.packages import version_of
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.model_choice import AS_STATED, ModelChoice
from tvsbayes.progress import Job, Show
from tvsbayes.results.store import CHAIN as CHAIN_FILE
from tvsbayes.results.store import FIT as FIT_FILE
from tvsbayes.results.store import POSTERIOR as POSTERIOR_FILE
from tvsbayes.results.store import FitFiles, read_fit_files, sole_writer, stored_fit
from tvsbayes.results.tiers import CHAIN, IMPORTANCE

if TYPE_CHECKING:
    import numpy as np

    from tvsbayes.calibration.pointing import Calibration
    from tvsbayes.estimators.findings import Finding
    from tvsbayes.estimators.joint_fit import JointFit
    from tvsbayes.inference.stored_posterior import StoredPosterior
    from tvsbayes.instrument.campaign import Campaign
    from tvsbayes.posterior.draws import Posterior
    from tvsbayes.results.compensation_record import Compensation, Verification
    from tvsbayes.results.estimates import FitSummary
    from tvsbayes.results.fit_record import FitEvidence, FitRecord
    from tvsbayes.results.records import Tier
    from tvsbayes.results.stored_draws import ResultDraws
    from tvsbayes.single_axis.axis_campaign import AxisCampaign


Tell = Callable[[str], None]
"""Shows a line to the user."""
FITTING, SAMPLING, WRITING, SUMMARISING = "fit", "posterior", "writing posterior.nc", "summarising"
MAX_MINUTES = 10.0
"""Default time for sampling."""
WRITING_SECONDS, SUMMARISING_SECONDS = 3.0, 1.5
"""Expected durations of writing posterior.nc and of summarising the results, for the progress display."""
RESIDUALS_LISTED = 4096
"""Largest number of stops in `fit.json`, evenly chosen: it limits the file of a long campaign."""
FITTING_FIRST = "fitting first (Laplace approximation) ..."
SAMPLING_FIRST = "fitting and sampling first ..."
_SHOWN_LINES: set[str] = set()
"""Lines that `compile_for` has shown in this process: a command may call it several times."""


def no_output(line: str) -> None:
    """Ignore a line: for callers without output."""


def compile_for(tell: Tell) -> None:
    """Enable the compilation cache; show once per process that the first compilation takes time."""
    from tvsbayes.model.compilation_cache import own_cache_folder, use_compilation_cache

    empty, folder = use_compilation_cache(), own_cache_folder()
    if fault := folder.fault():
        place = escaped(str(folder.path), 200)
        line = f"warning: {place} is not used to keep compiled functions: {fault}; see `tvsbayes doctor`"
    elif empty and sys.stderr.isatty():
        line = "first run: the model is compiled, half a minute to two minutes; later runs take it from the cache"
    else:
        return
    if line not in _SHOWN_LINES:
        _SHOWN_LINES.add(line)
        tell(line)


def unusable(summary: FitSummary, causes: Sequence[Finding] = ()) -> TvsError | None:
    """Why a finished fit must not be used: it did not converge (exit 4) or learned nothing (exit 3).

    `causes` explain a fit that did not converge; see `misfit_causes`.
    """
    if not summary.explained:
        return NotConverged.of(summary.problems, "; ".join(c.sentence for c in causes) or MISFIT_REMEDY)
    if not summary.headline_informed:
        return NothingToEstimate(
            "uninformed",
            "the looks do not determine any effective ratio: they reduce its prior variance by less than a tenth",
            remedy="observe stops before and after moves of both axes",
        )
    return None


@dataclass(frozen=True, repr=False)
class CampaignResults(Shown):
    """The results of a campaign.

    Attributes:
        record: the content of `fit.json`.
        fit: mode and Laplace approximation.
        posterior: its sample, None without sampling; the record ignores a sample that has not converged.
        calibration: input of `locate`; None where the fit did not converge.
        draws: the draws of the record.
        error: why the results must not be used; None where they may.
        causes: explanations of a fit that did not converge; else empty.
        files: paths of written files, by kind: "draws", "fit", "posterior", "chain".
    """

    record: FitRecord
    fit: JointFit
    posterior: Posterior | None
    calibration: Calibration | None
    draws: ResultDraws
    error: TvsError | None
    files: dict[str, str]
    causes: tuple[Finding, ...] = ()

    def shown(self) -> View:
        """Show the summary of the record, and whether the results may be used."""
        view = self.record.summary.shown()
        usable = "" if self.error is None else f"; DO NOT USE: {self.error.message}"
        return replace(view, title=f"CampaignResults: {view.title}{usable}")


def calibrate(
    campaign: Campaign,
    folder: Path | str | None = None,
    *,
    model: ModelChoice = AS_STATED,
    sampled: bool = True,
    tier: Tier | None = None,
    max_minutes: float = MAX_MINUTES,
    resume: bool = False,
    seed: int = 0,
    tell: Tell = no_output,
    progress: Show | None = None,
    first: Callable[[FitSummary], None] | None = None,
) -> CampaignResults:
    """Fit a campaign, sample its posterior, and summarise both, as the command `fit` does.

    Args:
        campaign: from `read_campaign`.
        folder: for `fit.json`, `draws.npz`, `posterior.nc` and `chain.npz`; None writes nothing. `locate` and the
            commands read them from `results` in the campaign's folder.
        model: options beyond the rig's priors.
        sampled: sample the posterior; else only the Laplace approximation is used.
        tier: None for weighted draws, and a chain only where they are not accepted; "importance" for weighted draws
            alone; "emcee" for a chain that must agree with them, whatever their answer.
        max_minutes: time for sampling.
        resume: continue the chain in the folder, whatever the answer of the weighted draws.
        seed: seed of all random numbers.
        tell: shows lines to the user.
        progress: shows the progress.
        first: shows the results of importance sampling before a chain starts.

    Raises:
        InputError: for the reasons of `fit` and `sample`, or the folder cannot be written.
        NothingToEstimate: too few spots, or no free parameter.
        NotConverged: the fit diverged. A fit that ended without a mode is returned with `error` set.
    """
    from tvsbayes.assessment.summary import summarise, worth_sampling
    from tvsbayes.estimators.joint_fit import fit as fit_joint
    from tvsbayes.estimators.joint_fit import fit_stages

    directory = None if folder is None else Path(folder)
    fitting = {FITTING: sum(fit_stages(model.robust, campaign.moves, campaign.rig).values())}
    held = nullcontext() if directory is None else sole_writer(directory)
    with held, Job(fitting | _later_stages(sampled, tier, directory), progress) as job:
        joint = fit_joint(campaign, model=model, seed=seed, progress=job.part(FITTING))
        posterior, walked = None, False

        def chain_begins(early: Posterior) -> None:
            nonlocal walked
            walked = True
            if first is not None:
                first(summarise(joint, early))

        # A fit that must not be used is not sampled.
        if sampled and worth_sampling(joint):
            from tvsbayes.posterior.sampling import sample

            posterior = sample(
                joint,
                tier,
                max_minutes=max_minutes,
                seed=seed,
                checkpoint=None if directory is None or tier == IMPORTANCE else directory / CHAIN_FILE,
                resume=resume,
                progress=job.part(SAMPLING),
                first=chain_begins,
            )
        return _results(joint, posterior, seed, directory, tell, job.begin, with_chain=walked)


def _later_stages(sampled: bool, tier: Tier | None, folder: Path | None) -> dict[str, float]:
    """Stages of `calibrate` after its fit, with expected seconds; 0 for a stage left out."""
    from tvsbayes.posterior.sampling import sampling_stages

    sampling = sum(sampling_stages(tier).values()) if sampled else 0.0
    filing = WRITING_SECONDS if sampled and folder is not None else 0.0
    return {SAMPLING: sampling, SUMMARISING: SUMMARISING_SECONDS, WRITING: filing}


def _results(
    fit: JointFit,
    posterior: Posterior | None,
    seed: int,
    folder: Path | None,
    tell: Tell,
    begin: Callable[[str], None] = no_output,
    *,
    with_chain: bool = False,
) -> CampaignResults:
    """Compute summary, calibration and evidence of a fit and its sample; write them where a folder is given.

    With a sample they include `posterior.nc`; one of another fit is removed. A chain has kept its `chain.npz` there.
    """
    import numpy as np

    from tvsbayes.assessment.fitted_calibration import DRAWS_KEPT, calibration_of
    from tvsbayes.assessment.summary import equal_laplace_draws, summarise
    from tvsbayes.estimators.plausibility import misfit_causes
    from tvsbayes.instrument.campaign import input_hashes
    from tvsbayes.posterior.draws import Draws
    from tvsbayes.results.fit_record import FitRecord, covariance_of_draws, provenance
    from tvsbayes.results.stored_draws import ResultDraws, write_results

    begin(SUMMARISING)
    summary = summarise(fit, posterior)
    sampled_posterior = posterior if summary.estimator == "posterior" else None
    calibration = calibration_of(fit, posterior, seed=seed) if fit.converged else None
    equal_draws = equal_laplace_draws(fit) if sampled_posterior is None else sampled_posterior.thinned(DRAWS_KEPT)
    physical, effective = np.asarray(equal_draws.physical), np.asarray(equal_draws.effective_deg_per_step)
    mechanism = fit.space.mechanism
    derived = {name: values for name, values in Draws(equal_draws, mechanism).items() if name not in fit.names}
    columns = np.stack(list(derived.values()), axis=1)
    draws = ResultDraws(fit.names, physical, effective, fit.reference_pose_rad, tuple(derived), columns)
    record = FitRecord(
        summary,
        covariance_of_draws(draws.names, draws.physical, summary.parameters),
        evidence_of(fit, summary, sampled_posterior, calibration, draws.physical),
        provenance(input_hashes(fit.campaign), seed),
    ).identified()
    files = {}
    if folder is not None:
        tree = None
        if posterior is not None and posterior.converged:
            from tvsbayes.posterior.arviz_tree import posterior_bytes

            begin(WRITING)
            tell("computing log likelihoods and predictions for posterior.nc ...")
            tree = posterior_bytes(posterior, record.digest)
        elif (folder / POSTERIOR_FILE).exists():
            tell("posterior.nc of an earlier fit is removed: it would not be that of fit.json")
        files = write_results(folder, record, draws, calibration, None if calibration is None else fit.stored, tree)
        if with_chain:
            files["chain"] = str(folder / CHAIN_FILE)
    causes = () if fit.converged else misfit_causes(fit.campaign, summary.parameters["pixel_scale"].value)
    return CampaignResults(record, fit, posterior, calibration, draws, unusable(summary, causes), files, causes)


def evidence_of(
    fit: JointFit,
    summary: FitSummary,
    posterior: Posterior | None,
    calibration: Calibration | None,
    physical: np.ndarray,
) -> FitEvidence:
    """Compute the evidence for reports besides the estimates; without a calibration this is the residuals alone.

    `physical` holds the draws of the calibration's inputs, one row per draw, in the units of their names.
    """
    from tvsbayes.assessment.causes import headline_budget, headline_causes
    from tvsbayes.assessment.residuals import residual_causes, stop_readings, stop_residuals
    from tvsbayes.comparison.gap import explain_gap
    from tvsbayes.metrology.positioning_table import positioning
    from tvsbayes.results.fit_record import FitEvidence

    stops = stop_residuals(fit)
    stops_listed, causes = stops[:: -(-len(stops) // RESIDUALS_LISTED) or 1], residual_causes(stops)
    if calibration is None:
        return FitEvidence(stops_listed, causes)
    gaps = explain_gap(fit, posterior)
    causes_by_quantity = headline_causes(fit)
    # Fixed quantities have no uncertainty to divide.
    estimates = {q: e for q in causes_by_quantity.quantities if (e := summary.named[q]).sd > 0}
    budgets = tuple(headline_budget(causes_by_quantity, q, e) for q, e in estimates.items())
    axes = []
    for axis in AXES:
        contrast = physical[:, fit.names.index(f"ratio_contrast_deg_per_step.{axis}")]
        readings = stop_readings(fit, axis)
        axes.append(positioning(calibration, axis, readings=readings, contrast_deg_per_step=contrast))
    return FitEvidence(stops_listed, causes, gaps if any(gaps.values()) else None, budgets, tuple(axes))


@dataclass(frozen=True)
class StoredOrFitted:
    """Results of a campaign: those stored in `results/` for the same data and priors, else those of a new fit.

    Stored parts are of one fit; results of an older version may lack one. Missing parts come from one fit (Laplace
    approximation), made when the first of them is needed.

    Attributes:
        campaign: from `read_campaign`.
        tell: shows the reason for a new fit.
        progress: shows the progress.
        tier: how a fit that is reported is sampled, as in `calibrate`.
    """

    campaign: Campaign
    tell: Tell = no_output
    progress: Show | None = None
    tier: Tier | None = CHAIN

    @cached_property
    def stored(self) -> FitFiles | Reason:
        """The files of the stored fit, or why there are none."""
        from tvsbayes.instrument.campaign import input_hashes

        return stored_fit(self.campaign, input_hashes(self.campaign))

    @cached_property
    def stored_calibration(self) -> Calibration | None:
        """The stored calibration, None where `results/` lack it."""
        from tvsbayes.calibration.calibration_file import calibration_of_arrays

        return None if isinstance(self.stored, Reason) else calibration_of_arrays(self.stored.arrays)

    @cached_property
    def stored_fit(self) -> JointFit | None:
        """The stored fit at its mode; None where `results/` lack it or another version named its parameters."""
        from tvsbayes.results.stored_draws import mode_of

        if isinstance(self.stored, Reason) or self.stored_calibration is None:
            return None
        if (mode := mode_of(self.stored.arrays, sum(s.status == "ok" for s in self.campaign.spots))) is None:
            return None
        from tvsbayes.estimators.joint_fit import restored

        return restored(self.campaign, mode)

    @cached_property
    def stored_record(self) -> FitRecord | None:
        """The stored `fit.json`, None where no calibration belongs to it."""
        from tvsbayes.results.fit_record import fit_of

        if isinstance(self.stored, Reason) or self.stored_calibration is None:
            return None
        return fit_of(self.stored.keys)

    @cached_property
    def fitted(self) -> JointFit:
        """A new fit for a command without stored results.

        Raises:
            NotConverged: it did not converge.
        """
        return _converged_fit(self.campaign, _why_not_stored(self.stored), self.tell, self.progress)

    @cached_property
    def calibration(self) -> Calibration:
        """The calibration, stored or from a new fit."""
        if self.stored_calibration is not None:
            return self.stored_calibration
        fit = self.fitted
        from tvsbayes.assessment.fitted_calibration import calibration_of

        return calibration_of(fit)

    @cached_property
    def fit(self) -> JointFit:
        """Mode and Laplace approximation."""
        compile_for(self.tell)
        return self.fitted if self.stored_fit is None else self.stored_fit

    @cached_property
    def reported(self) -> Reported:
        """What a report shows, of one fit with the evidence for it; a new fit is sampled and stored in the folder.

        Raises:
            InputError: the folder cannot be written.
            NotConverged: a new fit did not converge.
        """
        record, calibration = self.stored_record, self.stored_calibration
        if record is not None and record.evidence is not None and calibration is not None:
            from tvsbayes.results.stored_draws import ratios_of

            assert isinstance(self.stored, FitFiles)
            return Reported(record, calibration, ratios_of(self.stored.arrays))
        place = None if self.campaign.path is None else output_place(self.campaign.path, "results")
        self.tell(f"{_why_not_stored(self.stored)}: {SAMPLING_FIRST}")
        compile_for(self.tell)
        made = calibrate(self.campaign, place, tier=self.tier, tell=self.tell, progress=self.progress)
        if made.calibration is None:
            assert made.error is not None
            raise made.error
        return Reported(made.record, made.calibration, made.draws.effective_deg_per_step)


class Reported(NamedTuple):
    """A fit in a report: `fit.json`, its calibration, draws of the effective ratios (draws, 4) in deg/step."""

    record: FitRecord
    calibration: Calibration
    ratios_deg_per_step: np.ndarray


def load_posterior(folder: Path | str, *, anyway: bool = False) -> StoredPosterior:
    """Load the draws of a fit from a folder's `results/`, of any instrument, without JAX.

    Args:
        folder: folder of a campaign after `tvsbayes fit`, or its `results`, or a folder of `--out`.
        anyway: accept a rough answer or the Laplace approximation too.

    Returns:
        Named draws with weights, `.propagate(f)` for quantities of them.

    Raises:
        InputError: there are no results, they are not of one fit, of other data than lie in the folder, damaged, or of
            a version that cannot be read.
        NotConverged: the fit has no answer, or none that is accepted.
    """
    from tvsbayes.inference.stored_posterior import posterior_in

    return posterior_in(_loaded(Path(folder)), anyway=anyway)


def load_calibration(path: Path | str) -> Calibration:
    """Load a calibration with NumPy alone.

    Args:
        path: a campaign folder with `results/`, its `results` folder, a `draws.npz`, or the JSON that
            `tvsbayes steps-for CAMPAIGN --export json` prints.

    Returns:
        A calibration: `.ray(pan_steps, tilt_steps)` is the beam, `.locate(..., aperture_deg)` the point in mm with
        its covariance, `.steps_for(xyz_mm)` the counters to go to; from JSON without the draws that
        `tvsbayes.locate` needs.

    Raises:
        InputError: there is no such file, tvsbayes did not write it, or the results are not of one fit or of other
            data than lie in the folder.
    """
    from tvsbayes.calibration import calibration_file

    path = Path(path)
    if not path.exists():
        allowed = "a campaign folder with results/, a draws.npz, or the JSON of `steps-for --export json`"
        remedy = "run `tvsbayes fit` on the campaign first, or correct the path"
        file = escaped(str(path), 200)
        raise refusal("missing-file", file=file, found="no such file", allowed=allowed, remedy=remedy)
    if path.suffix == ".json" and path.is_file():
        return calibration_file.read_calibration_json(path)
    if path.is_file() and not path.with_name(FIT_FILE).exists():
        # Copied to a robot by itself.
        return calibration_file.read_draws(path)
    return calibration_file.calibration_in(_loaded(path.parent if path.is_file() else path).arrays)


def _loaded(folder: Path) -> FitFiles:
    """The files of one fit for Python, of the data in their campaign where there is one; errors as `load_posterior`."""
    inner = folder / "results"
    place = inner if inner.is_dir() or not (folder / FIT_FILE).exists() else folder
    campaign = place.absolute().parent
    inputs = inputs_of(read_campaign(campaign)) if (campaign / "campaign.toml").is_file() else None
    found = read_fit_files(place, inputs, other_models=True)
    if isinstance(found, Reason):
        allowed = "results/ of one fit, of the data beside them"
        code = "stale-results" if (place / FIT_FILE).exists() else "missing-file"
        file = escaped(str(folder), 200)
        raise refusal(code, file=file, found=found.reason, allowed=allowed, remedy=found.remedy)
    return found


def inputs_of(campaign: Campaign | AxisCampaign) -> dict[str, str]:
    """Hashes of the inputs of an estimate, of any instrument."""
    from tvsbayes.instrument.campaign import Campaign, input_hashes
    from tvsbayes.single_axis.axis_campaign import axis_hashes

    return input_hashes(campaign) if isinstance(campaign, Campaign) else axis_hashes(campaign)


def read_campaign(folder: Path | str) -> Campaign | AxisCampaign:
    """Read and check a campaign folder of any instrument, by the `format` line of its `campaign.toml`.

    Returns:
        A `Campaign` for a scanner, input of `fit`, `classic` and the plots; for an axis an `AxisCampaign`, input of
        `fit_axis`.

    Raises:
        InputError: missing, malformed or contradictory entries, with file, line and column.
    """
    from tvsbayes.instrument.campaign import read_campaign as read_scanner
    from tvsbayes.instrument.campaign_header import mechanism_key

    if mechanism_key(Path(folder)) == "axis":
        from tvsbayes.single_axis.axis_campaign import read_axis

        return read_axis(folder)
    return read_scanner(folder)


def verify(
    folder: Campaign | AxisCampaign | Path | str,
    fresh: Campaign | AxisCampaign | Path | str,
    *,
    made: Compensation | None = None,
    distance_mm: float = 1000.0,
    seed: int = 0,
    tell: Tell = no_output,
    progress: Show | None = None,
) -> Verification:
    """Test whether an axis keeps the promise of its table, or a scanner that of its calibration.

    Args:
        folder: holds the results with the table or the calibration in force.
        fresh: for an axis readings with the table in force, commands before the correction; for a scanner looks whose
            moves have the counters of `steps_for` or of the header.
        made: table of an axis; None for the one in `results/compensation.json`.
        distance_mm: along the beam of a scanner, for errors of points.
        seed: seed of all random numbers.
        tell: shows lines to the user.
        progress: shows the progress.

    Raises:
        InputError: a folder cannot be used, the fresh readings or looks are those of the first, or there is no table or
            calibration of these data.
        NotConverged: the fit is not accepted.
        NothingToEstimate: too few fresh readings or looks.
    """
    from tvsbayes.instrument.campaign import Campaign
    from tvsbayes.instrument.copies import refuse_same_looks
    from tvsbayes.single_axis.axis_campaign import AxisCampaign, refuse_same_readings

    campaign, looks = (read_campaign(each) if isinstance(each, Path | str) else each for each in (folder, fresh))
    if isinstance(campaign, AxisCampaign) and isinstance(looks, AxisCampaign):
        refuse_same_readings(campaign, looks)
        from tvsbayes.compensation.verification import verify_axis

        return verify_axis(campaign, looks, made=made, seed=seed, tell=tell, progress=progress)
    if not (isinstance(campaign, Campaign) and isinstance(looks, Campaign)):
        message = "an axis is verified by fresh readings of an axis, a scanner by fresh looks of a scanner"
        raise InputError("usage", message, remedy="give two folders of the same kind of machine")
    from tvsbayes.comparison.verified_looks import accepted_calibration, verify_looks

    calibration = accepted_calibration(campaign)
    refuse_same_looks(campaign, looks)
    with Job({FITTING: 1.0, "verification": 2.0}, progress) as job:
        joint = StoredOrFitted(campaign, tell, job.part(FITTING)).fit
        job.begin("verification")
        return verify_looks(joint, calibration, looks, distance_mm=distance_mm, seed=seed)


def _why_not_stored(stored: FitFiles | Reason) -> str:
    """Why `results/` cannot be used, in words: the reason for a new fit."""
    if isinstance(stored, Reason):
        return stored.reason
    if stored.keys.values.get("converged") is not True:
        return "results/ are of a fit that did not converge"
    version = stored.keys.table("versions").values.get("tvsbayes")
    if version != version_of("tvsbayes"):
        return f"results/ are of tvsbayes {escaped(str(version), 40)}, with another model of the rig"
    return "results/ lack what this command needs"


def _converged_fit(campaign: Campaign, why: str, tell: Tell, progress: Show | None) -> JointFit:
    """Make a new fit for a command without stored results."""
    tell(f"{why}: {FITTING_FIRST}")
    from tvsbayes.estimators.joint_fit import fit as fit_joint

    compile_for(tell)
    result = fit_joint(campaign, progress=progress)
    if not result.converged:
        raise NotConverged.of(result.problems, "see `tvsbayes fit`; this command needs a fit that has converged")
    return result
