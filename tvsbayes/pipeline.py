"""From a campaign to its results: fit, posterior, calibration and evidence, stored in `results/`.

The commands and Python callers use this module. Units stand in the names; only fits load JAX.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from tvsbayes.display import Shown, View
from tvsbayes.errors import MISFIT_REMEDY, InputError, NotConverged, NothingToEstimate, TvsError, escaped
from tvsbayes.files.disk import make_folder, output_place, require_writable
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.model_choice import AS_STATED, ModelChoice
from tvsbayes.progress import Job, Show
from tvsbayes.results.tiers import CHAIN, IMPORTANCE

if TYPE_CHECKING:
    import numpy as np

    from tvsbayes.calibration.pointing import Calibration
    from tvsbayes.estimators.findings import Finding
    from tvsbayes.estimators.joint_fit import JointFit
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
    tier: Tier = CHAIN,
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
        tier: one of `TIERS`: "importance" for weighted draws alone, which take seconds, without `posterior.nc` and
            `chain.npz`; else a chain that must agree with them.
        max_minutes: time for sampling.
        resume: continue the chain in the folder.
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
    if directory is not None:
        require_writable(directory)
    fitting = {FITTING: sum(fit_stages(model.robust, campaign.moves).values())}
    with Job(fitting | _later_stages(sampled, tier, directory), progress) as job:
        joint = fit_joint(campaign, model=model, seed=seed, progress=job.part(FITTING))
        posterior, files = None, {}
        # A fit that must not be used is not sampled.
        if sampled and worth_sampling(joint):
            from tvsbayes.posterior.sampling import sample

            if directory is not None:
                make_folder(directory)
            sampling_progress = job.part(SAMPLING)
            if tier == IMPORTANCE:
                posterior = sample(joint, tier, seed=seed, progress=sampling_progress)
            else:
                posterior = sample(
                    joint,
                    tier,
                    max_minutes=max_minutes,
                    seed=seed,
                    checkpoint=None if directory is None else directory / "chain.npz",
                    resume=resume,
                    progress=sampling_progress,
                    first=None if first is None else lambda early: first(summarise(joint, early)),
                )
                job.begin(WRITING)
                files = _posterior_files(posterior, directory, tell)
        job.begin(SUMMARISING)
        return _results(joint, posterior, seed, directory, files, tell)


def _later_stages(sampled: bool, tier: Tier, folder: Path | None) -> dict[str, float]:
    """Stages of `calibrate` after its fit, with expected seconds; 0 for a stage left out."""
    from tvsbayes.posterior.sampling import sampling_stages

    sampling = sum(sampling_stages(tier).values()) if sampled else 0.0
    filing = WRITING_SECONDS if sampled and tier != IMPORTANCE and folder is not None else 0.0
    return {SAMPLING: sampling, WRITING: filing, SUMMARISING: SUMMARISING_SECONDS}


def _posterior_files(posterior: Posterior, folder: Path | None, tell: Tell) -> dict[str, str]:
    """Write a converged posterior for ArviZ; the chain is stored already."""
    if folder is None:
        return {}
    files = {}
    if posterior.converged:
        from tvsbayes.posterior.arviz_tree import write_posterior

        tell("computing log likelihoods and predictions for posterior.nc ...")
        write_posterior(posterior, folder / "posterior.nc")
        files["posterior"] = str(folder / "posterior.nc")
    return {**files, "chain": str(folder / "chain.npz")}


def _results(
    fit: JointFit, posterior: Posterior | None, seed: int, folder: Path | None, files: dict[str, str], tell: Tell
) -> CampaignResults:
    """Compute summary, calibration and evidence of a fit and its sample; write them where a folder is given.

    A `posterior.nc` there that is not among `files` belongs to another fit and is removed.
    """
    import numpy as np

    from tvsbayes.assessment.fitted_calibration import DRAWS_KEPT, calibration_of
    from tvsbayes.assessment.summary import equal_laplace_draws, summarise
    from tvsbayes.estimators.plausibility import misfit_causes
    from tvsbayes.instrument.campaign import input_hashes
    from tvsbayes.posterior.draws import Draws
    from tvsbayes.results.fit_record import FitRecord, covariance_of_draws, provenance
    from tvsbayes.results.stored_draws import ResultDraws, write_results

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
    )
    if folder is not None:
        if "posterior" not in files and (old_file := folder / "posterior.nc").exists():
            old_file.unlink()
            tell("posterior.nc of an earlier fit is removed: it would not be that of fit.json")
        mode = None if calibration is None else fit.stored
        files = {**write_results(folder, record, draws, calibration, mode), **files}
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

    Each part is looked up separately, since results of an older version may lack one. Missing parts come from one fit
    (Laplace approximation), made when the first of them is needed.

    Attributes:
        campaign: from `read_campaign`.
        tell: shows the reason for a new fit.
        progress: shows the progress.
    """

    campaign: Campaign
    tell: Tell = no_output
    progress: Show | None = None

    @cached_property
    def stored_calibration(self) -> Calibration | None:
        """The stored calibration, None where `results/` lack it."""
        from tvsbayes.calibration.calibration_file import stored_calibration

        return stored_calibration(self.campaign)

    @cached_property
    def stored_fit(self) -> JointFit | None:
        """The stored fit at its mode; None where `results/` lack it or another version named its parameters."""
        from tvsbayes.results.stored_draws import stored_mode

        if (mode := stored_mode(self.campaign)) is None:
            return None
        from tvsbayes.estimators.joint_fit import restored

        return restored(self.campaign, mode)

    @cached_property
    def stored_record(self) -> FitRecord | None:
        """The stored `fit.json`, None where it belongs to other data."""
        from tvsbayes.instrument.campaign import input_hashes
        from tvsbayes.results.fit_record import read_fit

        if self.campaign.path is None or self.stored_calibration is None:
            return None
        path = self.campaign.path / "results" / "fit.json"
        record = read_fit(path) if path.exists() else None
        return record if record and record.provenance.inputs == input_hashes(self.campaign) else None

    @cached_property
    def fitted(self) -> JointFit:
        """A new fit for a command without stored results.

        Raises:
            NotConverged: it did not converge.
        """
        return _converged_fit(self.campaign, self.tell, self.progress)

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
    def record(self) -> FitRecord:
        """The content of `fit.json` with the evidence for reports; a new fit is stored in the campaign's folder.

        Raises:
            InputError: the folder cannot be written.
        """
        if self.stored_record is not None and self.stored_record.evidence is not None:
            return self.stored_record
        place = None if self.campaign.path is None else output_place(self.campaign.path, "results")
        if place is not None:
            require_writable(place)
        return _results(self.fitted, None, 0, place, {}, self.tell).record


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


def _why_not_stored(campaign: Campaign) -> str:
    """Why `results/` cannot be used, in words: the reason for a new fit."""
    from tvsbayes.instrument.campaign import input_hashes
    from tvsbayes.results.fit_record import provenance, read_fit

    path = None if campaign.path is None else campaign.path / "results" / "fit.json"
    if path is None or not path.exists():
        is_interrupted = path is not None and path.with_name("chain.npz").exists()
        return (
            "results/ hold only an interrupted chain (`tvsbayes fit --resume`)"
            if is_interrupted
            else "there are no results/ yet"
        )
    record = read_fit(path)
    hashes, stored = input_hashes(campaign), record.provenance
    files = {"moves": "moves.csv", "spots": campaign.looks_table.file, "stereo": "stereo.json", "rig": "[rig]"}
    changed_inputs = [file for name, file in files.items() if stored.inputs.get(name) != hashes[name]]
    version = stored.versions["tvsbayes"]
    of_another = f"results/ are of tvsbayes {escaped(version, 40)}, with another model of the rig"
    is_another = version != provenance(hashes, 0).versions["tvsbayes"]
    if is_another and changed_inputs == [files["rig"]]:
        return f"{of_another}, or of another [rig]"
    if changed_inputs:
        return f"results/ are of other {', '.join(changed_inputs)}"
    if not record.summary.converged:
        return "results/ are of a fit that did not converge"
    return of_another if is_another else "results/ lack what this command needs"


def _converged_fit(campaign: Campaign, tell: Tell, progress: Show | None) -> JointFit:
    """Make a new fit for a command without stored results."""
    tell(f"{_why_not_stored(campaign)}: {FITTING_FIRST}")
    from tvsbayes.estimators.joint_fit import fit as fit_joint

    compile_for(tell)
    result = fit_joint(campaign, progress=progress)
    if not result.converged:
        raise NotConverged.of(result.problems, "see `tvsbayes fit`; this command needs a fit that has converged")
    return result
