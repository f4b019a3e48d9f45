"""Results of a fitted axis for `fit --json` and `results/fit.json`; all lengths in the folder's unit."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from msgspec import structs

from tvsbayes.display import Shown, View
from tvsbayes.errors import NothingToEstimate, Reason, TvsError
from tvsbayes.progress import Show
from tvsbayes.results.convergence import Convergence
from tvsbayes.results.estimates import CONTRACTION_LIMIT, Estimate
from tvsbayes.results.fit_record import Provenance, provenance
from tvsbayes.results.records import (
    Tier,
    hold_to_schema,
    plain,
    read_record,
)
from tvsbayes.results.store import AGAIN, FitFiles, damaged_draws, fit_id, stored_fit, write_fit
from tvsbayes.results.tiers import IMPORTANCE
from tvsbayes.single_axis.axis_budget import axis_budgets
from tvsbayes.single_axis.axis_campaign import AxisCampaign, axis_hashes
from tvsbayes.single_axis.axis_density import (
    HEADLINE_DRAWS,
    blocks_of,
    deviation_functionals,
    headline_functionals,
    line_factors,
    mean_play,
)
from tvsbayes.single_axis.axis_doubts import axis_warnings
from tvsbayes.single_axis.axis_fit import AxisFit, fit_axis, model_of
from tvsbayes.single_axis.axis_parameters import AXIS_QUANTITIES, CONTRAST_PARTS, kind_of, prior_sd
from tvsbayes.single_axis.axis_periods import period_estimate, wave_samples, waves_at_an_end, weak_waves
from tvsbayes.single_axis.axis_rows import rows_of
from tvsbayes.single_axis.axis_summary import AXIS_FIT_FORMAT, AxisSummary, PositionDeviation, axis_fit_schema
from tvsbayes.single_axis.classic_line import classic_axis
from tvsbayes.single_axis.fit_doubts import doubts_of, reversed_play, weak_directions, without_processes
from tvsbayes.statistics.intervals import NORMAL_95, interval95
from tvsbayes.statistics.linear_posterior import LinearPosterior
from tvsbayes.statistics.streams import AxisStream, random_stream

POSITIONS_LISTED = 400
"""Largest number of positions in `deviations`."""


def _diagnoses(fit: AxisFit) -> dict[str, dict[str, float | None]]:
    """Diagnosis by quantity, as fields of `Estimate`; "" has the worst values, used for other quantities."""
    if fit.sample is None or fit.answer == "laplace":
        return {"": {}}
    state = fit.sample.convergence
    rhat, bulk, tail = state.rhat, state.ess_bulk, state.ess_tail
    by_name = {n: {"rhat": rhat.get(n), "ess_bulk": bulk[n], "ess_tail": tail[n]} for n in bulk}
    worst = {"rhat": max(rhat.values(), default=None), "ess_bulk": min(bulk.values()), "ess_tail": min(tail.values())}
    return {**by_name, "": worst}


def _prior_sds(fit: AxisFit) -> dict[str, float]:
    """Standard deviations of the priors by quantity; the offset has no prior of its own."""
    priors = fit.model.priors
    sampled = [name for name in fit.free if not name.startswith("wave_")]
    sds = {name: prior_sd(kind_of(name), priors[name.split(".")[0]]) for name in (*sampled, *fit.model.shifts)}
    return sds | {
        name: float(np.hypot.reduce([factor * priors[key].u for key, factor in factors.items()], initial=0.0))
        for name, factors in line_factors(fit.model).items()
        if "offset" not in factors
    }


def summarise_axis(fit: AxisFit) -> AxisSummary:
    """The complete summary of a fit."""
    model, rows, draws = fit.model, fit.rows, fit.draws
    sds, diagnoses, linear = _prior_sds(fit), _diagnoses(fit), fit.linear
    functionals = headline_functionals(model, fit.w)
    by_name = {name: functionals[..., k, :] for k, name in enumerate(HEADLINE_DRAWS)}
    lines = dict(zip(HEADLINE_DRAWS, np.transpose(linear.moments(functionals)).tolist(), strict=True))

    def estimate(name: str, drawn: np.ndarray | None = None, functional: np.ndarray | None = None) -> Estimate:
        """By draws; value and sd of a linear quantity without the draws' own scatter."""
        drawn = draws[name] if drawn is None else drawn
        value, sd = lines.get(name) or (float(drawn.mean()), float(drawn.std()))
        if functional is not None:
            (value,), (sd,) = (moment.tolist() for moment in linear.moments(functional[..., None, :]))
        prior = sds.get(name)
        contraction = None if not prior else float(max(1 - (sd / prior) ** 2, -1.0))
        diagnosis = diagnoses.get(name, diagnoses[""])
        return Estimate(value, sd, interval95(drawn), prior, contraction, **diagnosis)

    def effective(part: float) -> Estimate:
        """Slope of the line through the positions, with this part of the contrast."""
        drawn = draws["effective_per_command"] + part * draws["ratio_contrast"]
        return estimate("", drawn, by_name["effective_per_command"] + part * by_name["ratio_contrast"])

    sampled = [name for name in fit.free if not name.startswith("wave_")]
    line = [name for name, quantity in AXIS_QUANTITIES.items() if quantity.line and not quantity.parts]
    samples, classic, play = wave_samples(fit), classic_axis(rows), None
    # A drive has no play, nor has an axis of which every stop was reached from one side.
    if not rows.in_motion and rows.both_sides:
        functional = mean_play(model)
        [drawn] = linear.drawn(functional[None], random_stream(fit.seed, AxisStream.EFFECTIVE_BACKLASH)).T
        play = estimate("", drawn, functional)
    summary = AxisSummary(
        unit=fit.campaign.unit,
        estimator=fit.estimator,
        tier=fit.tier,
        answer=fit.answer,
        monte_carlo_error={} if fit.sample is None else fit.sample.convergence.monte_carlo_error,
        converged=fit.error is None and (fit.sample is None or fit.answer != "laplace"),
        problems=fit.missing,
        per_command={side: estimate(f"per_command.{side}") for side in CONTRAST_PARTS},
        effective_per_command={side: effective(part) for side, part in CONTRAST_PARTS.items()},
        range_command=(float(rows.command.min()), float(rows.command.max())),
        parameters={name: estimate(name) for name in dict.fromkeys([*sampled, *model.shifts, *line])}
        | _prior_backlash(fit),
        deviations=_deviations(fit),
        classic=classic,
        moves=len(rows.move),
        readings=int(rows.count.sum()),
        positions=len(rows.positions),
        weak_directions=(*weak_directions(fit), *weak_waves(fit, samples)),
        warnings=(
            *axis_warnings(fit.campaign, rows),
            *reversed_play(fit),
            *waves_at_an_end(samples, fit.campaign.unit),
        ),
        sampling=_sampling(fit),
        prior_conflicts=tuple(conflict.text for conflict in fit.conflicts),
        periods=tuple(period_estimate(sample) for sample in samples if sample.wave.clock != "encoder"),
        encoder_periods=tuple(period_estimate(sample) for sample in samples if sample.wave.clock == "encoder"),
        periods_in="seconds" if fit.campaign.periods.in_seconds else "unit",
        effective_backlash=play,
        budgets=axis_budgets(fit, effective(0.0), play, classic) if fit.error is None else (),
    )
    return structs.replace(summary, doubts=doubts_of(summary, without_processes(fit)))


def _prior_backlash(fit: AxisFit) -> dict[str, Estimate]:
    """The backlash and what follows from it alone, from its prior, where every stop was reached from one side.

    Its draws would depend on how a start of unknown side is treated, which contains no information on the play.
    """
    prior = fit.model.priors["backlash"]
    if fit.rows.both_sides or not prior.u:
        return {}
    estimates = {}
    for name, factors in line_factors(fit.model).items():
        if set(factors) == {"backlash"}:
            value, u = factors["backlash"] * prior.value, factors["backlash"] * prior.u
            estimates[name] = Estimate(value, u, (value - NORMAL_95 * u, value + NORMAL_95 * u), u, 0.0)
    return estimates


CURVE_DRAWS = 400
"""Number of draws of the error by position in a figure, and where functionals differ by draw."""
STRATA = 16
"""Number of normal quantiles of each draw in a figure: the band is as smooth as that of thousands of draws."""


def drawn_deviations(fit: AxisFit, commands: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draws of the error that repeats by position at commands (t,), minus its line: (draws, t)."""
    parts = _curve_parts(fit) if fit.model.repeats_by_draw else [(fit.w, fit.linear)]
    return np.concatenate([linear.drawn(deviation_functionals(fit.model, w, commands), rng) for w, linear in parts])


def deviation_strata(fit: AxisFit, commands: np.ndarray) -> np.ndarray:
    """Equally probable values of the error at each command, for its band: (`CURVE_DRAWS` x `STRATA`, t).

    Values at two commands are not joint draws.
    """
    from scipy.special import ndtri

    normal, strata = ndtri((np.arange(STRATA) + 0.5) / STRATA)[:, None], []
    for w, linear in _curve_parts(fit):
        functionals = deviation_functionals(fit.model, w, commands)
        mean, sd = linear.mean_of(functionals), linear.sd_of(functionals)
        strata.append((mean[:, None] + normal * sd[:, None]).reshape(-1, len(commands)))
    return np.concatenate(strata)


def _curve_parts(fit: AxisFit) -> Iterator[tuple[np.ndarray, LinearPosterior]]:
    """Some of the draws in blocks, with the linear quantities given them."""
    w = fit.w[np.linspace(0, len(fit.w) - 1, CURVE_DRAWS).astype(int)]
    return ((part, fit.model.linear(part)) for part in blocks_of(w))


def _deviations(fit: AxisFit) -> tuple[PositionDeviation, ...]:
    positions = fit.rows.positions
    if fit.rows.in_motion and not any(wave.clock == "position" for wave in fit.model.coordinates.waves):
        return ()
    if len(positions) > POSITIONS_LISTED:
        positions = positions[np.linspace(0, len(positions) - 1, POSITIONS_LISTED).astype(int)]
    drawn = drawn_deviations(fit, positions, random_stream(fit.seed, AxisStream.DEVIATIONS))
    return tuple(
        PositionDeviation(float(p), float(v.mean()), float(v.std()), interval95(v))
        for p, v in zip(positions, drawn.T, strict=True)
    )


def _sampling(fit: AxisFit) -> dict[str, float | int | None]:
    if fit.sample is None:
        return {}
    convergence = fit.sample.convergence
    importance = convergence.importance
    numbers: dict[str, float | int | None] = {
        "draws": importance.draws,
        "rounds": importance.rounds,
        "effective": importance.effective_share * importance.draws,
        "pareto_k": importance.pareto_k,
    }
    if isinstance(convergence, Convergence):
        numbers |= {"steps": convergence.steps, "acceptance": float(convergence.acceptance.mean())}
        numbers["autocorrelation_times"] = (convergence.steps - convergence.discarded) / convergence.tau_steps
        if convergence.agreement is not None:
            numbers["agreement"] = convergence.agreement.worst.value
    return numbers


def uninformed(summary: AxisSummary) -> TvsError | None:
    """The error where the readings do not determine the ratio."""
    ratios = summary.per_command.values()
    if any(e.contraction is None or e.contraction >= CONTRACTION_LIMIT for e in ratios):
        return None
    return NothingToEstimate(
        "uninformed",
        "the readings do not determine the unit per command: they reduce its prior variance by less than a tenth",
        remedy="read stops farther apart, or state a wider prior",
    )


def keep_fit(fit: AxisFit, summary: AxisSummary, folder: Path) -> dict[str, str]:
    """Write the files of a fit; errors and paths as of `write_fit`."""
    origin = plain(provenance(axis_hashes(fit.campaign), fit.seed))
    document = {"format": AXIS_FIT_FORMAT, **summary.as_json(), **origin}
    arrays = {"names": np.array(list(fit.draws)), "w": fit.w, "draws": np.stack(list(fit.draws.values()), axis=-1)}
    return write_fit(folder, document | {"fit_id": fit_id(document)}, arrays)


@dataclass(frozen=True, repr=False)
class AxisResults(Shown):
    """A fit and its summary; `fit_id` is its id in `results/`, None for one that is not stored or older than ids."""

    summary: AxisSummary
    fit: AxisFit
    fit_id: str | None = None

    def shown(self) -> View:
        """Show the summary."""
        return self.summary.shown()


def _stored_w(arrays: Mapping[str, np.ndarray], names: int) -> np.ndarray:
    """Coordinates (draws, names) in `draws.npz`.

    Raises:
        InputError: they are missing or damaged.
    """
    w = arrays.get("w", np.zeros(0))
    # A single draw has no covariance.
    if w.dtype.kind != "f" or w.ndim != 2 or w.shape[1] != names or len(w) < 2 or not np.all(np.isfinite(w)):
        raise damaged_draws(f"w of shape {w.shape}", f"w of shape (draws, {names}), finite, as in results/fit.json")
    return w


FITTING_FIRST = "fitting first (weighted draws) ..."
OTHER_MODEL = "results/ are of a version with another model of the axis"


def results_for(
    campaign: AxisCampaign,
    more: np.ndarray | None = None,
    progress: Show | None = None,
    seed: int = 0,
    notify: Callable[[str], None] = lambda _: None,
    tier: Tier | None = IMPORTANCE,
) -> AxisResults:
    """The results in `results/` if they belong to these data and this model and converged; else those of a new fit.

    Args:
        campaign: from `read_axis`.
        more: further commands at which the error will be evaluated, shape (n,).
        progress: shows the progress of the fit.
        seed: seed of that fit.
        notify: reports that a fit runs first.
        tier: how that fit is sampled, as in `fit_axis`.

    Raises:
        InputError: stored results are damaged.
        NotConverged: the fit did not converge.
    """
    stored = stored_fit(campaign, axis_hashes(campaign))
    why = stored.reason if isinstance(stored, Reason) else "results/ are of a fit that did not converge"
    if isinstance(stored, FitFiles) and stored.keys.values.get("converged") is True:
        document = stored.keys
        document.word("format", AXIS_FIT_FORMAT)
        hold_to_schema(document, axis_fit_schema(), AGAIN)
        summary = read_record(AxisSummary, document, AGAIN, held=True)
        if "answer" not in document.values and summary.estimator == "posterior":
            # 0.2.0 had accepted samples only.
            summary = structs.replace(summary, answer="accepted")
        # Depends on no draw, but on `command_unit`; files of 0.3.0 hold other figures by the same names.
        summary = structs.replace(summary, classic=classic_axis(rows_of(campaign)))
        origin = read_record(Provenance, document, AGAIN, held=True)
        model = model_of(campaign, more)
        names = model.coordinates.names
        # The contrast of an axis in a length was free until 0.3.
        contrast = bool(model.priors["ratio_contrast"].u) == bool(summary.parameters["ratio_contrast"].prior_sd)
        if contrast and summary.parameters.keys() >= {name for name in names if not name.startswith("wave_")}:
            w = _stored_w(stored.arrays, len(names))
            return AxisResults(summary, AxisFit.of_draws(campaign, model, w, origin.seed), origin.fit_id)
        why = OTHER_MODEL
    notify(f"{why}: {FITTING_FIRST}")
    fit = fit_axis(campaign, tier=tier, seed=seed, more=more, progress=progress)
    if fit.error is not None:
        raise fit.error
    return AxisResults(summarise_axis(fit), fit)
