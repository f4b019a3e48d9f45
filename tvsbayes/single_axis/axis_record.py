"""Results of a fitted axis for `fit --json` and `results/fit.json`; all lengths in the folder's unit."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta, field, structs

from tvsbayes.display import Shown, View
from tvsbayes.errors import NothingToEstimate, Reason, TvsError
from tvsbayes.progress import Show
from tvsbayes.results.convergence import Convergence, MonteCarloError
from tvsbayes.results.estimates import CONTRACTION_LIMIT, Estimate, PeriodEstimate
from tvsbayes.results.fit_record import Provenance, Sha256, provenance
from tvsbayes.results.metrology_tables import BudgetTable
from tvsbayes.results.records import (
    AnswerKind,
    Count,
    EstimatorName,
    NotNegative,
    Record,
    Tier,
    hold_to_schema,
    plain,
    read_record,
    schema_of,
)
from tvsbayes.results.store import AGAIN, FitFiles, damaged_draws, fit_id, stored_fit, write_fit
from tvsbayes.results.tiers import IMPORTANCE
from tvsbayes.single_axis.axis_budget import axis_budgets
from tvsbayes.single_axis.axis_campaign import AxisCampaign, axis_hashes
from tvsbayes.single_axis.axis_density import (
    HEADLINE_DRAWS,
    blocks_of,
    headline_functionals,
    line_factors,
    line_weights,
    mean_play,
)
from tvsbayes.single_axis.axis_doubts import axis_warnings
from tvsbayes.single_axis.axis_fit import AxisFit, conflict_text, fit_axis, model_of
from tvsbayes.single_axis.axis_parameters import AXIS_QUANTITIES, CONTRAST_PARTS, kind_of, prior_sd
from tvsbayes.single_axis.axis_periods import period_estimate, wave_samples, waves_at_an_end, weak_waves
from tvsbayes.single_axis.axis_rows import rows_of
from tvsbayes.single_axis.classic_line import ClassicAxis, classic_axis
from tvsbayes.single_axis.fit_doubts import AxisDoubt, Facts, WithoutProcesses, doubts_of, without_processes
from tvsbayes.statistics.intervals import NORMAL_95, WithSd, interval95
from tvsbayes.statistics.streams import AxisStream, random_stream

AXIS_FIT_FORMAT = "tvsbayes-axis-fit/1"
type PeriodClock = Literal["unit", "seconds"]
type BothSides[T] = Annotated[dict[str, T], Meta(extra_json_schema={"required": ("forward", "backward")})]
POSITIONS_FEW = 5
"""With fewer positions the posterior of a process of position is mostly its prior."""
REVERSED = 0.975
"""Least probability of a negative backlash for a warning."""
POSITIONS_LISTED = 400


class PositionDeviation(Record, frozen=True):
    """Deviation of the axis at a position from the line through the stops: the repeated error without drift and play.

    Attributes:
        position: a command.
        value, sd, interval95: in the folder's unit.
    """

    position: float
    value: float
    sd: NotNegative
    interval95: tuple[float, float]


class AxisSummary(Shown, Record, frozen=True):
    """A fit in the terms of `fit.json`.

    Attributes:
        unit: unit of all values but commands, hours and shares.
        estimator: "laplace" or "posterior".
        tier: method of the posterior's draws, weighted draws or a chain; None for a Laplace approximation.
        converged: whether there is a mode, and an accepted or rough answer of the sampler, where it ran.
        problems: why the answer is not accepted.
        per_command: ratio by direction, "forward" and "backward"; valid beyond the range read.
        effective_per_command: slope of the least-squares line through the positions read, by direction.
        range_command: least and largest command read; `effective_per_command` refers to this range.
        parameters: estimates by name.
        periods: waves of the gear, stated ones first.
        encoder_periods: waves of the encoder.
        periods_in: unit of the gear's periods: "unit", that of the readings, or "seconds".
        deviations: deviations from that line, by position read.
        classic: the classic estimate.
        moves, readings, positions: numbers used.
        weak_directions, warnings: as sentences.
        sampling: diagnosis of the draws.
        prior_conflicts: priors that the readings contradict, in words.
        answer: source of the intervals: an accepted sample, a rough one, or the Laplace approximation.
        monte_carlo_error: errors of every headline, in its sd.
        effective_backlash: mean of the play over the positions read; `backlash` is the mean of all positions, read or
            not; None where no play was read.
        doubts: results that physics excludes or that rest on the priors.
        budgets: GUM budgets of `effective_per_command` (mean of both directions), `effective_backlash`, and of E and A
            of ISO 230-2 where their u is known.
    """

    unit: str
    estimator: EstimatorName
    tier: Tier | None
    converged: bool
    problems: tuple[str, ...]
    per_command: BothSides[Estimate]
    effective_per_command: BothSides[Estimate]
    range_command: tuple[float, float]
    parameters: dict[str, Estimate]
    deviations: tuple[PositionDeviation, ...]
    classic: ClassicAxis
    moves: Count
    readings: Count
    positions: Count
    weak_directions: tuple[str, ...]
    warnings: tuple[str, ...]
    sampling: dict[str, float | int | None]
    prior_conflicts: tuple[str, ...] = ()
    answer: AnswerKind = "laplace"
    monte_carlo_error: dict[str, MonteCarloError] = field(default_factory=dict)
    periods: tuple[PeriodEstimate, ...] = ()
    encoder_periods: tuple[PeriodEstimate, ...] = ()
    periods_in: PeriodClock = "unit"
    effective_backlash: Estimate | None = None
    doubts: tuple[AxisDoubt, ...] = ()
    budgets: tuple[BudgetTable, ...] = ()

    @property
    def explained(self) -> bool:
        """Whether there is a mode, which sampling needs."""
        return self.converged or bool(self.sampling)

    def shown(self) -> View:
        """Show ratios by direction, then every parameter."""
        estimates = {f"per_command.{side}": e for side, e in self.per_command.items()}
        estimates |= {f"effective_per_command.{side}": e for side, e in self.effective_per_command.items()}
        estimates |= {name: e for name, e in self.parameters.items() if name != "per_command"}
        rows = [
            (name, e.value, e.sd, *e.interval95, None if e.contraction is None else round(100 * e.contraction, 1))
            for name, e in estimates.items()
        ]
        state = "converged" if self.converged else "NOT CONVERGED"
        title = f"AxisSummary in {self.unit}, {self.estimator}, {state}"
        return View(title, ("quantity", "value", "sd", "2.5 %", "97.5 %", "set by the data, %"), rows)


class AxisInputs(Record, frozen=True):
    """SHA-256 of the inputs of a fit."""

    moves: Sha256
    readings: Sha256
    axis: Sha256


@cache
def axis_fit_schema() -> dict[str, Any]:
    """The JSON schema of `results/fit.json` in an axis folder."""
    return schema_of(AxisSummary, Provenance, format={"const": AXIS_FIT_FORMAT}, inputs=AxisInputs)


def _estimate(
    draws: np.ndarray,
    prior: float | None,
    diagnosis: Mapping[str, float | None],
    moments: tuple[float, float] | None = None,
) -> Estimate:
    """An estimate by draws (n,); `moments`, value and sd, where they are known without the draws' own scatter."""
    value, sd = moments or (float(draws.mean()), float(draws.std()))
    contraction = None if not prior else float(max(1 - (sd / prior) ** 2, -1.0))
    return Estimate(value, sd, interval95(draws), prior, contraction, **diagnosis)


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
    priors = fit.model.priors
    sampled = [name for name in fit.free if not name.startswith("wave_")]
    sds = {name: prior_sd(kind_of(name), priors[name.split(".")[0]]) for name in (*sampled, *fit.model.shifts)}
    return sds | {
        name: float(np.hypot.reduce([factor * priors[key].u for key, factor in factors.items()], initial=0.0))
        for name, factors in line_factors(fit.model).items()
        # The offset has no prior of its own.
        if "offset" not in factors
    }


def summarise_axis(fit: AxisFit) -> AxisSummary:
    """The complete summary of a fit."""
    draws, sds, diagnoses = fit.draws, _prior_sds(fit), _diagnoses(fit)

    functionals = headline_functionals(fit.model, fit.w)
    lines = dict(
        zip(HEADLINE_DRAWS, zip(*map(np.ndarray.tolist, fit.linear.moments(functionals)), strict=True), strict=True)
    )

    def estimate(name: str) -> Estimate:
        return _estimate(draws[name], sds.get(name), diagnoses.get(name, diagnoses[""]), lines.get(name))

    def effective(half: float) -> Estimate:
        """Slope of the line through the positions, with this share of the contrast."""
        drawn = draws["effective_per_command"] + half * draws["ratio_contrast"]
        slope, contrast = (
            functionals[..., HEADLINE_DRAWS.index(n), :] for n in ("effective_per_command", "ratio_contrast")
        )
        (value,), (sd,) = (m.tolist() for m in fit.linear.moments((slope + half * contrast)[..., None, :]))
        return _estimate(drawn, None, diagnoses[""], (value, sd))

    sampled = [name for name in fit.free if not name.startswith("wave_")]
    linear = [name for name, quantity in AXIS_QUANTITIES.items() if quantity.line and not quantity.parts]
    names = [*sampled, *fit.model.shifts, *linear]
    samples = wave_samples(fit)
    classic, play = classic_axis(fit.rows), _effective_backlash(fit, diagnoses[""])
    summary = AxisSummary(
        unit=fit.campaign.unit,
        estimator=fit.estimator,
        tier=fit.tier,
        answer=fit.answer,
        monte_carlo_error={} if fit.sample is None else fit.sample.convergence.monte_carlo_error,
        converged=fit.error is None and (fit.sample is None or fit.answer != "laplace"),
        problems=fit.missing,
        per_command={side: estimate(f"per_command.{side}") for side in CONTRAST_PARTS},
        effective_per_command={side: effective(half) for side, half in CONTRAST_PARTS.items()},
        range_command=(float(fit.rows.command.min()), float(fit.rows.command.max())),
        parameters={name: estimate(name) for name in dict.fromkeys(names)} | _prior_backlash(fit),
        deviations=_deviations(fit),
        classic=classic,
        moves=len(fit.rows.move),
        readings=int(fit.rows.count.sum()),
        positions=len(fit.rows.positions),
        weak_directions=tuple([*_weak(fit), *weak_waves(fit, samples)]),
        warnings=(
            *axis_warnings(fit.campaign, fit.rows),
            *_reversed(fit),
            *waves_at_an_end(samples, fit.campaign.unit),
        ),
        sampling=_sampling(fit),
        prior_conflicts=tuple(conflict_text(conflict) for conflict in fit.conflicts),
        periods=tuple(period_estimate(sample) for sample in samples if sample.wave.clock != "encoder"),
        encoder_periods=tuple(period_estimate(sample) for sample in samples if sample.wave.clock == "encoder"),
        periods_in="seconds" if fit.campaign.periods.in_seconds else "unit",
        effective_backlash=play,
        budgets=axis_budgets(fit, effective(0.0), play, classic) if fit.error is None else (),
    )
    return structs.replace(summary, doubts=doubts_of(facts_of(summary, without_processes(fit))))


def facts_of(summary: AxisSummary, without: WithoutProcesses | None) -> Facts:
    """What doubts ask of a fit; `without` is that without processes of position."""
    worst = max(summary.deviations, key=lambda each: abs(each.value), default=None)
    return Facts(
        unit=summary.unit,
        moves=summary.moves,
        freedom=summary.classic.degrees_of_freedom,
        parameters=summary.parameters,
        play=summary.effective_backlash,
        worst=None if worst is None else WithSd(worst.value, worst.sd),
        worst_position=0.0 if worst is None else worst.position,
        periods=summary.periods if summary.periods_in == "unit" else (),
        without=without,
    )


def _effective_backlash(fit: AxisFit, diagnosis: Mapping[str, float | None]) -> Estimate | None:
    """Estimate the mean of the play over the positions read; None for a drive, or with stops from one side alone."""
    rows, model = fit.rows, fit.model
    if rows.in_motion or not rows.both_sides:
        return None
    functional = mean_play(model)[None]
    drawn = fit.linear.drawn(functional, random_stream(fit.seed, AxisStream.EFFECTIVE_BACKLASH))
    (value,), (sd,) = (moment.tolist() for moment in fit.linear.moments(functional))
    return _estimate(drawn[:, 0], None, diagnosis, (value, sd))


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
            half = NORMAL_95 * u
            estimates[name] = Estimate(value, u, (value - half, value + half), u, 0.0)
    return estimates


def deviation_functionals(fit: AxisFit, commands: np.ndarray) -> np.ndarray:
    """Error that repeats by position at commands (t,), minus its least-squares line over the rows.

    Shape (t, columns); (n, t, columns) for `fit.w` where a period is unknown.
    """
    model = fit.model
    level = model.functional(fit.rows.command, fit.w).mean(axis=-2)
    slope = line_weights(model, fit.w)
    offsets = (commands - model.middle)[:, None]
    return model.functional(commands, fit.w) - level[..., None, :] - offsets * slope[..., None, :]


CURVE_DRAWS = 400
"""Number of draws of the error by position in a figure, and where functionals differ by draw."""
STRATA = 16
"""Number of normal quantiles of each draw in a figure: the band is as smooth as that of thousands of draws."""


def drawn_deviations(fit: AxisFit, commands: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draws of the error that repeats by position at commands (t,), minus its line: (draws, t)."""
    if not fit.model.repeats_by_draw:
        return fit.linear.drawn(deviation_functionals(fit, commands), rng)
    parts = _curve_parts(fit)
    return np.concatenate([part.linear.drawn(deviation_functionals(part, commands), rng) for part in parts])


def deviation_strata(fit: AxisFit, commands: np.ndarray) -> np.ndarray:
    """Equally probable values of the error at each command, for its band: (`CURVE_DRAWS` x `STRATA`, t).

    Values at two commands are not joint draws.
    """
    from scipy.special import ndtri

    normal = ndtri((np.arange(STRATA) + 0.5) / STRATA)[:, None]

    def of_part(part: AxisFit) -> np.ndarray:
        functionals = deviation_functionals(part, commands)
        mean, sd = part.linear.mean_of(functionals), part.linear.sd_of(functionals)
        return (mean[:, None] + normal * sd[:, None]).reshape(-1, len(commands))

    return np.concatenate([of_part(part) for part in _curve_parts(fit)])


def _curve_parts(fit: AxisFit) -> Iterator[AxisFit]:
    w = fit.w[np.linspace(0, len(fit.w) - 1, CURVE_DRAWS).astype(int)]
    return (AxisFit.of_draws(fit.campaign, fit.model, part, fit.seed) for part in blocks_of(w))


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


def _reversed(fit: AxisFit) -> list[str]:
    """A warning where the sign of the reversal is not that of lost motion."""
    if not fit.rows.both_sides or np.mean(fit.draws["backlash"] < 0) < REVERSED:
        return []
    return [
        "the backlash is negative: stops reached forward lie ahead of those reached backward, which is no play; the "
        "controller compensates too much, the reading turns with the direction, or directions are exchanged"
    ]


def _weak(fit: AxisFit) -> list[str]:
    """Describe quantities that the data do not determine, with remedies."""
    rows, sentences = fit.rows, _weak_in_time(fit)
    if rows.in_motion:
        return [
            *sentences,
            "a drive at constant rate does not separate error by position from drift: both are in the drift",
        ]
    sides = set(rows.side.tolist()) - {0}
    if not rows.both_sides:
        sentences.append("backlash is not determined: every stop was reached from one side; add stops from the other")
    if len(rows.positions) < POSITIONS_FEW:
        sentences.append(
            f"{len(rows.positions)} positions do not separate the error by position from the ratio; read at least "
            f"{POSITIONS_FEW}, spread over the travel"
        )
    repeats = [np.sum((rows.command == p) & (rows.side == s)) for p in rows.positions for s in sides]
    if max(repeats, default=0) < 2:
        sentences.append(
            "no position was reached twice from one side: scatter and error by position are poorly separated"
        )
    return sentences


IN_TIME = {
    "creep": "a creep of the zero",
    "thermal_per_K": "a shift with the temperature",
    "ratio_contrast": "the contrast of the directions",
    "backlash": "the play",
}
"""Quantities that a shift of the zero in time may be taken for, in words."""
CREEP_SHARE, ONE_THING = 0.5, 0.9
"""Least correlations of two of them at which they count as weak, and at which their sum alone is stated."""
ORDER_SHARE = 0.9
"""Least correlation of commands and travel at which the positions count as read one after the other."""


def _weak_in_time(fit: AxisFit) -> list[str]:
    """Describe quantities that are hardly separable from a shift of the zero in time."""
    rows, sentences = fit.rows, []
    several = rows.both_sides and len(rows.positions) > 2
    in_turn = several and abs(np.corrcoef(rows.command, rows.path)[0, 1]) > ORDER_SHARE
    if in_turn and (fit.model.priors["ratio_contrast"].u or "creep" in fit.model.shifts):
        sentences.append(
            "the places were read one after the other: errors by position, a creep of the zero and a contrast of the "
            "directions are poorly separated: read them again in another order; of gears whose teeth keep step state "
            "`ratio_contrast = { value = 0, u = 0 }` in [axis], of a warm machine `creep` likewise"
        )
    draws = {name: fit.draws[name] for name in (*fit.model.shifts, "ratio_contrast", "backlash")}
    draws = {name: values for name, values in draws.items() if values.std() > 0 and name in IN_TIME}
    remedies = {
        "creep": "alternate the directions, come back to the first stop, wait until it is warm",
        "thermal_per_K": "come back to the first stop at another temperature",
    }
    for shift, other in combinations(draws, 2):
        if shift not in remedies or (other not in remedies and not rows.both_sides):
            continue
        together = abs(np.corrcoef(draws[shift], draws[other])[0, 1])
        if together > CREEP_SHARE:
            sentence = f"{IN_TIME[other]} and {IN_TIME[shift]} are poorly separated: {remedies[shift]}"
            sentences.append(sentence + (_sum_in_time(fit) if together > ONE_THING and other != "backlash" else ""))
    return sentences


def _sum_in_time(fit: AxisFit) -> str:
    """State how far creep, temperature and contrast together moved the zero over the readings."""
    rows, draws, moved = fit.rows, fit.draws, np.zeros(len(fit.w))
    if "creep" in fit.model.shifts:
        minutes = fit.model.coordinates.values(fit.w)["creep_minutes"]
        first, last = (-np.expm1(-rows.warm_s[k] / (60.0 * minutes)) for k in (0, -1))
        moved = moved + draws["creep"] * (last - first)
    if "thermal_per_K" in fit.model.shifts and rows.kelvin is not None:
        moved = moved + draws["thermal_per_K"] * (rows.kelvin[-1] - rows.kelvin[0])
    moved = moved + 0.5 * draws["ratio_contrast"] * (rows.path[-1] - rows.path[0])
    size = f"{moved.mean():.3g} (u = {moved.std():.2g}) {fit.campaign.unit}"
    return f"; they are one thing to these readings: their sum moved the zero by {size}, and a table holds this sum"


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
        document.word("format", (AXIS_FIT_FORMAT,))
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
