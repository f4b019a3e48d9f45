"""Doubts about a fit that converged: results that physics excludes, and numbers that rest on the priors.

A doubt is a condition on the facts of a fit and a sentence; all lengths in the folder's unit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tvsbayes.display import concise
from tvsbayes.errors import escaped
from tvsbayes.results.estimates import Estimate, Measured, PeriodEstimate, varies_beyond
from tvsbayes.results.records import Record
from tvsbayes.single_axis.axis_campaign import TURNS
from tvsbayes.single_axis.axis_fit import DRAWS, AxisFit
from tvsbayes.single_axis.axis_mode import AxisMode, find_mode
from tvsbayes.single_axis.axis_model import AxisModel
from tvsbayes.single_axis.axis_parameters import AxisPrior
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


class AxisDoubt(Record, frozen=True):
    """A doubt about a fit.

    Attributes:
        name: what is doubted.
        text: a sentence.
        usable: whether the numbers may be used all the same.
    """

    name: str
    text: str
    usable: bool


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
    w = rng.multivariate_normal(mode.w, mode.covariance, DRAWS)
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
    """What doubts ask of a fit.

    Attributes:
        unit: unit of the readings.
        moves: moves with readings.
        freedom: degrees of freedom of the line; None where unknown.
        parameters: estimates by name.
        play: mean play over the positions read; None where no play was read.
        worst: largest error by position, and `worst_position`, its command; None where none was read.
        periods: waves by position.
        without: the fit without processes of position; None where there is no such question.
    """

    unit: str
    moves: int
    freedom: int | None
    parameters: Mapping[str, Estimate]
    play: Estimate | None
    worst: WithSd[float] | None
    worst_position: float
    periods: Sequence[PeriodEstimate]
    without: WithoutProcesses | None

    @property
    def scale(self) -> float:
        """Scatter of the readings over their u; 1 where the readings do not inform it."""
        scale = self.parameters.get("reading_scale")
        return scale.value if scale is not None and scale.informed else 1.0

    @property
    def play_varies(self) -> bool:
        """Whether the play varies by more than itself."""
        return varies_beyond(self.parameters.get("play_variation"), self.play)

    @property
    def error_exceeds_play(self) -> bool:
        """Whether an angle errs by more than gears have room for; a screw's lead may err more than its nut's play."""
        if self.unit not in TURNS or self.worst is None or self.play is None or not self.play.interval95[0] > 0:
            return False
        return abs(self.worst.value) - 2.0 * self.worst.sd > ERROR_PLAYS * self.play.interval95[1]

    @property
    def wave(self) -> PeriodEstimate | None:
        """The strongest wave that stands on an unexplained error as large as itself, which could make it."""
        error, length = map(self.parameters.get, ("transmission_error", "transmission_error_length"))
        if error is None or length is None or not error.informed:
            return None
        waves = [wave for wave in self.periods if wave.probability > LIKELY]
        # A process that is smooth over half a period makes no such wave.
        waves = [w for w in waves if error.value > w.amplitude.value and length.value < 0.5 * w.period.value]
        return max(waves, key=lambda wave: wave.amplitude.value, default=None)

    @property
    def idle(self) -> bool:
        """Whether the processes explain nothing beside a stated wave and widen the intervals."""
        plain = self.without
        if plain is None or plain.odds < ODDS_MIN or self.wave is not None:
            return False
        names = ("per_command", "backlash")
        return any(self.parameters[name].sd > WORSE * getattr(plain, name).sd > 0 for name in names)

    def text(self, template: str) -> str:
        """A sentence with the facts in place."""
        words: dict[str, object] = {f"now_{name}": _told(estimate) for name, estimate in self.parameters.items()}
        words |= {"unit": escaped(self.unit), "moves": self.moves, "freedom": self.freedom, "least": FREEDOM_MIN}
        words |= {"scale": f"{self.scale:.2g}", "position": f"{self.worst_position:.10g}"}
        if self.play is not None:
            words["play"] = _told(self.play)
        if self.worst is not None:
            words["worst"] = concise(abs(self.worst.value), self.worst.sd)
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


def doubts_of(facts: Facts) -> tuple[AxisDoubt, ...]:
    """The doubts about a fit."""
    return tuple(AxisDoubt(rule.name, facts.text(rule.sentence), rule.usable) for rule in RULES if rule.holds(facts))
