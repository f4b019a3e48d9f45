"""Predicted readings of an axis: the adapter of `statistics.predicted_readings.PredictedMachine`.

Given the scales, a reading is a linear functional of line, contrast, play, processes, creep and thermal shift, whose
joint posterior is normal, plus homing, drift, stop error and noise (formulation 8). Commands as in the folder, readings
in its unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from tvsbayes.errors import NothingToEstimate
from tvsbayes.gears.states import HOUR_S, travelled
from tvsbayes.instrument.conditions import kelvin_at, pause_s
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove
from tvsbayes.single_axis.axis_fit import AxisFit
from tvsbayes.single_axis.axis_model import CONTRAST, AxisModel, noise_covariances
from tvsbayes.single_axis.axis_parameters import SAMPLED, AxisCoordinates
from tvsbayes.single_axis.axis_rows import AxisRows, PlayPlaces, legs_of, play_places, rows_of, warm_from
from tvsbayes.single_axis.waves import wave_columns
from tvsbayes.statistics.linear_posterior import LinearPosterior
from tvsbayes.statistics.predicted_readings import PredictedReadings, State, Use
from tvsbayes.statistics.streams import AxisStream, random_stream

DRAWS = 160
"""Number of draws of the scales in a prediction."""
OF_USE = ("home_sd", "drift_per_root_hour", "stop_sd.forward", "stop_sd.backward")
"""Scales that a use needs even where the campaign has none of it, as of homings with a single one: by their prior."""
SHIFTS = {"creep": "creep", "thermal_per_K": "temperature"}
"""Cause of each shift of the zero in time; the contrast of the directions adds with the travel."""


def transferred_scales(source: AxisModel, draws: np.ndarray, target: AxisModel, rng: np.random.Generator) -> np.ndarray:
    """Coordinates (n, d) for a model of more rows, from draws (n, d) for a model of fewer rows.

    Scales without a coordinate in `source`, such as the scatter of homings with a single homing, get their prior, one
    draw from each of its n equal shares; a backlash that is linear in `source` is drawn given the scales.
    """
    from scipy.special import ndtri

    shares = np.tile(np.arange(len(draws)) + 0.5, (len(target.coordinates.names), 1)) / len(draws)
    w = ndtri(rng.permuted(shares, axis=1).T)
    for column, name in enumerate(target.coordinates.names):
        if name in source.coordinates.names:
            w[:, column] = draws[:, source.coordinates.names.index(name)]
        elif name == "backlash":
            linear, backlash, prior = source.linear(draws), source.line_terms(backlash=1.0)[None], target.priors[name]
            values, sd = linear.mean_of(backlash)[:, 0], linear.sd_of(backlash)[:, 0]
            w[:, column] = (values + sd * rng.standard_normal(len(draws)) - prior.value) / prior.u
    return w


def _spread_draws(fit: AxisFit) -> np.ndarray:
    """`DRAWS` equal draws (n, d) of a fit, evenly spaced in the scatter of homings, so as not to miss its long tail."""
    names = fit.model.coordinates.names
    order = np.argsort(fit.w[:, names.index("home_sd")]) if "home_sd" in names else np.arange(len(fit.w))
    return fit.w[order[((np.arange(DRAWS) + 0.5) * len(order) / DRAWS).astype(int)]]


def _first_degC(campaign: AxisCampaign) -> float | None:
    """Temperature at the first move; None where none is known."""
    known = next((move for move in campaign.moves if move.temperature_degC is not None), None)
    clock = np.array([move.time_s for move in campaign.moves], dtype=float)
    since = None if known is None else kelvin_at(campaign.moves, np.array([known.time_s]), clock)
    return None if known is None or since is None else float(known.temperature_degC or 0.0) - float(since[0])


class PredictedAxis:
    """A fitted axis as a `PredictedMachine`.

    Attributes:
        fit: the fit.
        w: coordinates of the draws, shape (n, d).
        scales: values of all scales by name, each (n,).

    Raises:
        NothingToEstimate: the drive never stops.
    """

    def __init__(self, fit: AxisFit, seed: int = 0):
        if fit.rows.in_motion:
            raise NothingToEstimate(
                "in-motion",
                "the readings are of a drive at constant rate: they contain no stops and no reversal",
                file="campaign.toml",
                remedy="read stops from both directions into a folder without `rate`",
            )
        self.fit, self.unit, self.w = fit, fit.campaign.unit, _spread_draws(fit)
        model, known = fit.model, fit.model.coordinates
        absent = frozenset(SAMPLED) - set(known.names) - set(OF_USE)
        target = replace(model, coordinates=AxisCoordinates.of(model.priors, absent, known.waves))
        w = transferred_scales(model, self.w, target, random_stream(seed, AxisStream.PREDICTED_STOPS))
        self.scales = target.coordinates.values(w)
        linear, play = model.linear(self.w), model.line_terms(backlash=1.0)[None]
        self._backlash = linear.drawn(play, random_stream(seed, AxisStream.PREDICTED_STOPS, 1))[:, 0]

    @property
    def homings(self) -> int:
        """Number of homings that were read."""
        return 0 if self.fit.campaign.absolute else len(np.unique(self.fit.rows.zero))

    @property
    def _walked_hours(self) -> float:
        """Time that the zero of an absolute encoder walks until the campaign ends, from which a use goes on."""
        moves = self.fit.campaign.moves
        return (moves[-1].time_s - moves[0].time_s) / HOUR_S if self.fit.campaign.absolute else 0.0

    @cached_property
    def state(self) -> State:
        """Mean state of the rows."""
        rows = self.fit.rows
        kelvin = 0.0 if rows.kelvin is None else float(rows.kelvin.mean())
        return State(
            float(rows.since_homing.mean()), float(rows.path.mean()), float(rows.warm_s.mean()) / HOUR_S, kelvin
        )

    @cached_property
    def use(self) -> Use:
        """Use as in the campaign."""
        moves, kelvin = self.fit.campaign.moves, self.fit.rows.kelvin
        hours, travel = longest_use(moves)
        times_s = np.array([move.time_s for move in moves])[legs_of(moves).first]
        between = (0.0, 0.0) if kelvin is None else (float(kelvin.min()), float(kelvin.max()))
        return Use(hours, travel, (times_s - warm_from(self.fit.campaign)) / HOUR_S, between)

    def expected(self, command: np.ndarray, side: np.ndarray, state: State | None = None) -> PredictedReadings:
        """Predict the repeatable part of readings."""
        state = state or self.state
        travel = np.broadcast_to(np.asarray(state.travel, dtype=float), np.shape(command))[None]
        out = -float(np.sign(self.fit.rows.line.slope)) * np.asarray(side, dtype=float)[None]
        play = PlayPlaces(command[None], travel, out, out, np.zeros_like(out))
        return self._readings(command, play, state)

    def shifts(self, use: State, at: State) -> dict[str, PredictedReadings]:
        """Predict what the state adds: creep, temperature, and travel by the contrast of the directions."""
        model, linear, later, earlier = self.fit.model, self._linear, self._in_time(use), self._in_time(at)
        columns = {SHIFTS[name]: (model.shift_columns[name], later[name] - earlier[name]) for name in later}
        if model.priors["ratio_contrast"].u:
            columns["travel"] = CONTRAST, np.atleast_2d(0.5 * (np.asarray(use.travel) - np.asarray(at.travel)))
        return {
            cause: PredictedReadings(
                linear.mean[:, column, None] * by,
                linear.covariance[:, column, column, None, None] * by[:, :, None] * by[:, None, :],
            )
            for cause, (column, by) in columns.items()
        }

    def scatter(self, side: np.ndarray, use: State, u: np.ndarray | float) -> dict[str, np.ndarray]:
        """Compute what does not repeat, by cause, of readings after one homing, each at a stop of its own."""
        hours = np.broadcast_to(np.asarray(use.hours, dtype=float), np.shape(side)) + self._walked_hours
        variance = np.broadcast_to(np.asarray(u, dtype=float) ** 2, np.shape(side))
        return self._noise(np.zeros(len(side)), np.arange(len(side)), hours, side, variance)

    def _noise(self, *readings: np.ndarray) -> dict[str, np.ndarray]:
        return noise_covariances(self.scales, self.fit.rows, *readings)

    def read(self, campaign: AxisCampaign) -> PredictedReadings:
        """Predict the readings of another campaign of this axis, after homings of its own, at its own states.

        The zero of an absolute encoder walks on until then, by `created` of both. Its commands are those that the
        mechanics got; the values of its readings are not used.
        """
        rows = replace(rows_of(campaign), line=self.fit.rows.line)
        play = play_places(rows, self._backlash)
        known_degC, its_degC = _first_degC(self.fit.campaign), _first_degC(campaign)
        kelvin, unknown = self.state.kelvin, 0.0
        if rows.kelvin is not None and known_degC is not None and its_degC is not None:
            kelvin = rows.kelvin + its_degC - known_degC
        elif self.fit.rows.kelvin is not None:
            # Somewhere in the range that was read.
            unknown = float(np.ptp(self.fit.rows.kelvin)) ** 2 / 12
        hours = rows.since_homing
        if self.fit.campaign.absolute:
            pause = pause_s(self.fit.campaign.header, campaign.header, self.fit.campaign.moves[-1].time_s)
            hours = hours + self._walked_hours + pause / HOUR_S
        shared, own = self._shared_errors(campaign, rows)
        state = State(hours, rows.path, rows.warm_s / HOUR_S, kelvin)
        repeated = self._readings(rows.command, play, state, shared)
        scatter = self._noise(rows.zero, np.cumsum(rows.redrawn), hours, rows.side, rows.variance)
        covariance = repeated.covariance + sum(scatter.values()) + own @ own.T
        if "thermal_per_K" in self.fit.model.shifts:
            column = self.fit.model.shift_columns["thermal_per_K"]
            second = self._linear.mean[:, column] ** 2 + self._linear.covariance[:, column, column]
            covariance = covariance + unknown * second[:, None, None]
        # The start of a segment from an unknown side is uniform within the play.
        together = np.equal.outer(rows.segment, rows.segment)
        covariance = covariance + play.spread[:, :, None] * play.spread[:, None, :] * together / 3
        return PredictedReadings(repeated.mean, covariance)

    def noise(self, side: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """Mean variance (r,) drawn anew at every visit: of stops, and of readings with stated variances (r,)."""
        count = np.arange(len(side))
        scatter = self._noise(count, count, np.zeros(len(side)), side, variance)
        return np.diagonal(scatter["stops"] + scatter["readings"], axis1=1, axis2=2).mean(axis=0)

    @cached_property
    def _linear(self) -> LinearPosterior:
        return self.fit.model.linear(self.w)

    def _in_time(self, state: State) -> dict[str, np.ndarray]:
        """Factors of the shifts of the zero at a state: (1 or n, 1 or r)."""
        return self.fit.model.in_time(self.scales["creep_minutes"], HOUR_S * np.asarray(state.warm_hours), state.kelvin)

    def _shared_errors(self, campaign: AxisCampaign, rows: AxisRows) -> tuple[np.ndarray, np.ndarray]:
        """Errors of rows of another campaign that its readings share, by cause.

        Those of the fit's own reference (rows, its causes), where both name the same certificate, and others.
        """
        causes = self.fit.rows.reference_causes
        shared = np.zeros((len(rows.command), len(causes)))
        others = []
        same = campaign.reference.certificate == self.fit.campaign.reference.certificate
        for cause, column in zip(rows.reference_causes, rows.reference.T, strict=True):
            if same and cause in causes:
                shared[:, causes.index(cause)] = column
            else:
                others.append(column)
        return shared, np.column_stack(others) if others else np.zeros((len(rows.command), 1))

    def _readings(
        self, command: np.ndarray, play: PlayPlaces, state: State, reference: np.ndarray | float = 0.0
    ) -> PredictedReadings:
        """Predict the repeatable part at places of the play, with the processes at the commands.

        It is that of positions; with errors `reference` (r, causes) of the reference that of its readings.
        """
        known = self.fit.model
        model = AxisModel.of(known.rows, known.priors, command, known.coordinates.waves)
        in_time, waves = self._in_time(state), []
        for wave, draws in zip(model.coordinates.waves, model.coordinates.wave_draws(self.w), strict=True):
            x = model.clock(
                wave, command, np.zeros(len(command)), model.rows.line.offset + model.rows.line.slope * command
            )
            waves.append(wave_columns(x, draws.period, model.record(wave)))
        size = max(len(each) for each in (play.anchor, *in_time.values(), *waves))
        functionals = np.zeros((size, len(command), model.columns))
        model.fill(functionals, command, play, in_time, waves)
        functionals[..., model.layout["homed"]] = 1.0 / (len(model.homed) + 1)
        functionals[..., model.layout["reference"]] = reference
        linear = model.linear(self.w)
        functionals = functionals[0] if size == 1 else functionals
        covariance = functionals @ linear.covariance @ np.swapaxes(functionals, -1, -2)
        if not model.places.exact:
            covariance = covariance + model.between_nodes(self.scales)[:, None, None] * np.eye(len(command))
        return PredictedReadings(linear.mean_of(functionals), covariance)


def longest_use(moves: Sequence[AxisMove]) -> tuple[float, float]:
    """Longest time, hours, and travel, commands, of the segments of moves."""
    legs, time_s = legs_of(moves), np.array([move.time_s for move in moves])
    since_s = time_s - time_s[np.searchsorted(legs.segment, legs.segment)]
    return float(since_s.max()) / HOUR_S, float(travelled(legs.command, legs.segment).max())
