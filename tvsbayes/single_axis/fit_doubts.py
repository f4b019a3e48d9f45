"""What is doubtful about a fit: results that physics excludes, numbers that rest on the priors or on each other.

All lengths in the folder's unit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from tvsbayes.display import concise
from tvsbayes.errors import escaped
from tvsbayes.gears.states import crept
from tvsbayes.results.estimates import Measured, PeriodEstimate, varies_beyond
from tvsbayes.single_axis.axis_campaign import TURNS
from tvsbayes.single_axis.axis_density import AxisMode, find_mode
from tvsbayes.single_axis.axis_fit import DRAWS, AxisFit
from tvsbayes.single_axis.axis_model import AxisModel
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.axis_summary import AxisDoubt, AxisSummary, PositionDeviation
from tvsbayes.statistics.intervals import WithSd
from tvsbayes.statistics.streams import AxisStream, random_stream

PROCESSES = ("transmission_error", "play_variation")
FREEDOM_MIN = 5
"""Least degrees of freedom of a usable fit: with fewer, Student's t at 95 % exceeds 2.6 (GUM table G.2)."""
SCALE_MIN = 0.2
"""Least scatter of readings over their u: the prior, log-normal (1, 0.5), has 6e-4 below it."""
LIKELY = 0.5
"""Least probability of a wave in a doubt."""
ERROR_PLAYS = 2.0
"""Least error by position in plays. Gears whose error exceeds their play have no room for it and jam."""
WORSE = 1.5
"""Least ratio of a u with the processes to that without them, for a doubt."""
ODDS_MIN = 3.0
"""Least odds against the processes for a doubt: less is "not worth more than a bare mention" (Kass and Raftery, J. Am.
Stat. Assoc. 90 (1995) 773)."""


POSITIONS_FEW = 5
"""With fewer positions the posterior of a process of position is mostly its prior."""
REVERSED = 0.975
"""Least probability of a negative backlash for a warning."""


class WithoutProcesses(NamedTuple):
    """A fit with both processes of position stated 0: `odds` against them, unit per command and play with their sd."""

    odds: float
    per_command: WithSd[float]
    backlash: WithSd[float]


def without_processes(fit: AxisFit) -> WithoutProcesses | None:
    """Fit without the processes of position, by Laplace; None where no stated wave stands beside them."""
    model = fit.model
    stated = [wave for wave in model.coordinates.waves if wave.known is not None]
    if not stated or fit.rows.in_motion or not set(PROCESSES) & set(fit.free) or fit.mode.missing:
        return None
    priors = {**model.priors, **dict.fromkeys(PROCESSES, AxisPrior(0.0, 0.0))}
    plain = AxisModel.of(fit.rows, priors, None, model.coordinates.waves)
    mode = find_mode(plain)
    if mode.missing or not len(mode.w):
        return None
    rng = random_stream(fit.seed, AxisStream.DOUBTS)
    w = mode.drawn(DRAWS, rng)
    lines = np.array([plain.line_terms(per_command=1.0), plain.line_terms(backlash=1.0)])
    drawn = plain.linear(w).drawn(lines, rng)
    (ratio, play), (u_ratio, u_play) = drawn.mean(axis=0).tolist(), drawn.std(axis=0).tolist()
    odds = float(np.exp(np.clip(_log_evidence(mode) - _log_evidence(fit.mode), -50.0, 50.0)))
    return WithoutProcesses(odds, WithSd(ratio, u_ratio), WithSd(play, u_play))


def _log_evidence(mode: AxisMode) -> float:
    """Log evidence by Laplace; the constants of the prior and of the integral cancel."""
    return mode.log_density + 0.5 * float(np.linalg.slogdet(mode.covariance)[1])


@dataclass(frozen=True)
class Facts:
    """What doubts ask of a fit; `without` is that without processes of position, None where there is no question."""

    summary: AxisSummary
    without: WithoutProcesses | None

    @property
    def worst(self) -> PositionDeviation | None:
        """The largest error by position; None where none was read."""
        return max(self.summary.deviations, key=lambda each: abs(each.value), default=None)

    @property
    def freedom(self) -> int | None:
        """Degrees of freedom of the line; None where unknown."""
        return self.summary.classic.degrees_of_freedom

    @property
    def scale(self) -> float:
        """Scatter of the readings over their u; 1 where the readings do not inform it."""
        scale = self.summary.parameters.get("reading_scale")
        return scale.value if scale is not None and scale.informed else 1.0

    @property
    def play_varies(self) -> bool:
        """Whether the play varies by more than itself."""
        return varies_beyond(self.summary.parameters.get("play_variation"), self.summary.effective_backlash)

    @property
    def error_exceeds_play(self) -> bool:
        """Whether an angle errs by more than gears have room for; a screw's lead may err more than its nut's play."""
        worst, play = self.worst, self.summary.effective_backlash
        if self.summary.unit not in TURNS or worst is None or play is None or not play.interval95[0] > 0:
            return False
        return abs(worst.value) - 2.0 * worst.sd > ERROR_PLAYS * play.interval95[1]

    @property
    def wave(self) -> PeriodEstimate | None:
        """The strongest wave that stands on an unexplained error as large as itself, which could make it."""
        error, length = map(self.summary.parameters.get, ("transmission_error", "transmission_error_length"))
        if error is None or length is None or not error.informed:
            return None
        # A process that is smooth over half a period makes no such wave.
        waves = [
            wave
            for wave in (self.summary.periods if self.summary.periods_in == "unit" else ())
            if wave.probability > LIKELY
            and error.value > wave.amplitude.value
            and length.value < 0.5 * wave.period.value
        ]
        return max(waves, key=lambda wave: wave.amplitude.value, default=None)

    @property
    def idle(self) -> bool:
        """Whether the processes explain nothing beside a stated wave and widen the intervals."""
        plain = self.without
        if plain is None or plain.odds < ODDS_MIN or self.wave is not None:
            return False
        names = ("per_command", "backlash")
        return any(self.summary.parameters[name].sd > WORSE * getattr(plain, name).sd > 0 for name in names)

    def text(self, template: str) -> str:
        """A sentence with the facts in place."""
        words: dict[str, object] = {
            f"now_{name}": _told(estimate) for name, estimate in self.summary.parameters.items()
        }
        words |= {"unit": escaped(self.summary.unit), "moves": self.summary.moves, "freedom": self.freedom}
        words |= {"scale": f"{self.scale:.2g}", "least": FREEDOM_MIN}
        if self.summary.effective_backlash is not None:
            words["play"] = _told(self.summary.effective_backlash)
        if (worst := self.worst) is not None:
            words |= {"worst": concise(abs(worst.value), worst.sd), "position": f"{worst.position:.10g}"}
        if self.wave is not None:
            words |= {"amplitude": _told(self.wave.amplitude), "period": f"{self.wave.period.value:.6g}"}
        if self.without is not None:
            words |= {"odds": f"{self.without.odds:.0f}", "per_command": _told(self.without.per_command)}
            words["backlash"] = _told(self.without.backlash)
        return template.format(**words)


def _told(measured: Measured | WithSd[float]) -> str:
    return concise(measured.value, measured.sd)


class _Rule(NamedTuple):
    """A doubt: its condition, whether the numbers may be used all the same, and its sentence."""

    name: str
    holds: Callable[[Facts], bool]
    usable: bool
    sentence: str


RULES = (
    _Rule(
        "few readings",
        lambda facts: facts.freedom is not None and facts.freedom < FREEDOM_MIN,
        False,
        "{moves} stops leave {freedom} of at least {least} degrees of freedom about the line: every u rests on default "
        "priors; read more stops, each position again and from both sides",
    ),
    _Rule(
        "stated u",
        lambda facts: facts.scale < SCALE_MIN,
        False,
        "the readings scatter by {scale} of their stated u, and the fit takes the scatter for their u: an error that "
        "all readings share, as of the reader's own scale, does not scatter and is in no u here; give readings.csv the "
        "u of independent errors alone, and add the common one to the results",
    ),
    _Rule(
        "play by position",
        lambda facts: facts.play_varies,
        False,
        "the play varies by {now_play_variation} {unit} (sd), more than the play itself, {play}, and no play is "
        "negative: the readings have errors that depend on position and side, such as of a camera's pose or an encoder "
        "off centre, or steps were lost",
    ),
    _Rule(
        "error by position",
        lambda facts: facts.error_exceeds_play,
        True,
        "an error by position of {worst} {unit} at command {position} exceeds the play, {play}: gears that mesh with "
        "play have no room for it (strain wave and sprung gears may); if the reader errs, as a camera whose pose is "
        "assumed or an encoder off centre, state `encoder_period` in [axis] or calibrate it",
    ),
    _Rule(
        "wave",
        lambda facts: facts.wave is not None,
        True,
        "the wave of {amplitude} {unit} every {period} stands on an unexplained error by position of "
        "{now_transmission_error} {unit} (sd), as large as itself and as short: amplitude and phase hold only if that "
        "error has no part of this period",
    ),
    _Rule(
        "idle processes",
        lambda facts: facts.idle,
        True,
        "beside the stated wave an error and a play by position explain nothing (odds {odds} : 1 against them) and "
        "widen its intervals: with `transmission_error` and `play_variation` = {{ value = 0, u = 0 }} in [axis] the "
        "gears turn {per_command} {unit} per command (now {now_per_command}) with a play of {backlash} (now "
        "{now_backlash})",
    ),
)
"""Doubts in the order of the report."""


def doubts_of(summary: AxisSummary, without: WithoutProcesses | None = None) -> tuple[AxisDoubt, ...]:
    """The doubts about a fit, `without` that without processes of position."""
    facts = Facts(summary, without)
    return tuple(AxisDoubt(rule.name, facts.text(rule.sentence), rule.usable) for rule in RULES if rule.holds(facts))


def reversed_play(fit: AxisFit) -> list[str]:
    """A warning where the sign of the reversal is not that of lost motion."""
    if not fit.rows.both_sides or np.mean(fit.draws["backlash"] < 0) < REVERSED:
        return []
    return [
        "the backlash is negative: stops reached forward lie ahead of those reached backward, which is no play; the "
        "controller compensates too much, the reading turns with the direction, or directions are exchanged"
    ]


def weak_directions(fit: AxisFit) -> list[str]:
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
        first, last = (crept(rows.warm_s[k], 60.0 * minutes) for k in (0, -1))
        moved = moved + draws["creep"] * (last - first)
    if "thermal_per_K" in fit.model.shifts and rows.kelvin is not None:
        moved = moved + draws["thermal_per_K"] * (rows.kelvin[-1] - rows.kelvin[0])
    moved = moved + 0.5 * draws["ratio_contrast"] * (rows.path[-1] - rows.path[0])
    size = f"{moved.mean():.3g} (u = {moved.std():.2g}) {fit.campaign.unit}"
    return f"; they are one thing to these readings: their sum moved the zero by {size}, and a table holds this sum"
