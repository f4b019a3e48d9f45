"""Doubts about a fit that converged: results that physics excludes, and numbers that rest on the priors.

A doubt is a condition on the facts of a fit and a sentence; all lengths in the folder's unit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tvsbayes.display import concise
from tvsbayes.errors import escaped
from tvsbayes.results.estimates import varies_beyond
from tvsbayes.results.records import Record
from tvsbayes.single_axis.axis_campaign import TURNS
from tvsbayes.single_axis.axis_fit import DRAWS, AxisFit
from tvsbayes.single_axis.axis_mode import AxisMode, find_mode
from tvsbayes.single_axis.axis_model import AxisModel
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.statistics.streams import AxisStream, random_stream

if TYPE_CHECKING:
    from tvsbayes.results.estimates import Estimate, PeriodEstimate
    from tvsbayes.single_axis.axis_record import AxisSummary

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
    per_command: tuple[float, float]
    backlash: tuple[float, float]


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
    return WithoutProcesses(odds, (ratio, u_ratio), (play, u_play))


def _log_evidence(mode: AxisMode) -> float:
    """Log evidence by Laplace; the constants of the prior and of the integral cancel."""
    return mode.log_density + 0.5 * float(np.linalg.slogdet(mode.covariance)[1])


@dataclass(frozen=True)
class Facts:
    """What doubts ask of a fit.

    Attributes:
        summary: the fit.
        without: the fit without processes of position; None where that was not asked.
    """

    summary: AxisSummary
    without: WithoutProcesses | None

    def sd(self, name: str) -> Estimate | None:
        """The estimate of a parameter that the readings inform; None where they do not, or there is none."""
        estimate = self.summary.parameters.get(name)
        return estimate if estimate is not None and estimate.informed else None

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the line."""
        freedom = self.summary.classic.degrees_of_freedom
        return FREEDOM_MIN if freedom is None else freedom

    @property
    def scale(self) -> float:
        """Scatter of the readings over their u; 1 where no u is stated."""
        scale = self.sd("reading_scale")
        return 1.0 if scale is None else scale.value

    @property
    def play(self) -> Estimate | None:
        """Mean play over the positions read."""
        return self.summary.effective_backlash

    @property
    def play_varies(self) -> bool:
        """Whether the play varies by more than itself."""
        return varies_beyond(self.summary.parameters.get("play_variation"), self.play)

    @property
    def error(self) -> float:
        """Largest error by position, less two sds."""
        return max((abs(each.value) - 2.0 * each.sd for each in self.summary.deviations), default=0.0)

    @property
    def error_exceeds_play(self) -> bool:
        """Whether an angle errs by more than gears have room for; a screw's lead may err more than its nut's play."""
        if self.summary.unit not in TURNS or self.play is None or not self.play.interval95[0] > 0:
            return False
        return self.error > ERROR_PLAYS * self.play.interval95[1]

    @property
    def wave(self) -> PeriodEstimate | None:
        """The strongest wave that stands on an unexplained error as large as itself, which could make it."""
        error, length = self.sd("transmission_error"), self.summary.parameters.get("transmission_error_length")
        if error is None or length is None or self.summary.periods_in != "unit":
            return None
        waves = [wave for wave in self.summary.periods if wave.probability > LIKELY]
        # A process that is smooth over half a period makes no such wave.
        waves = [w for w in waves if error.value > w.amplitude.value and length.value < 0.5 * w.period.value]
        return max(waves, key=lambda wave: wave.amplitude.value, default=None)

    @property
    def idle(self) -> bool:
        """Whether the processes explain nothing beside a stated wave and make the results worse."""
        if self.without is None or self.without.odds < ODDS_MIN or self.wave is not None:
            return False
        u, plain = self.summary.parameters, self.without
        return any(u[name].sd > WORSE * getattr(plain, name)[1] > 0 for name in ("per_command", "backlash"))

    def text(self, template: str) -> str:
        """A sentence with the facts in place."""
        wave, without = self.wave, self.without
        error = self.summary.parameters.get("transmission_error")
        variation = self.summary.parameters.get("play_variation")
        words: dict[str, object] = {
            "unit": escaped(self.summary.unit),
            "freedom": self.freedom,
            "least": FREEDOM_MIN,
            "moves": self.summary.moves,
            "scale": f"{self.scale:.2g}",
            "error": "" if error is None else concise(error.value, error.sd),
            "variation": "" if variation is None else concise(variation.value, variation.sd),
            "play": "" if self.play is None else concise(self.play.value, self.play.sd),
        }
        if self.summary.deviations:
            worst = max(self.summary.deviations, key=lambda each: abs(each.value))
            words |= {"worst": concise(abs(worst.value), worst.sd), "position": f"{worst.position:.10g}"}
        if wave is not None:
            words |= {
                "amplitude": concise(wave.amplitude.value, wave.amplitude.sd),
                "period": f"{wave.period.value:.6g}",
            }
        if without is not None:
            words |= {"odds": f"{without.odds:.0f}", "line": concise(*without.per_command)}
            words |= {"plain_play": concise(*without.backlash)}
            now = self.summary.parameters["per_command"], self.summary.parameters["backlash"]
            words |= dict(zip(("ratio", "backlash"), (concise(each.value, each.sd) for each in now), strict=True))
        return template.format(**words)


class _Rule(NamedTuple):
    """A doubt: its condition, whether the numbers may be used all the same, and its sentence."""

    name: str
    holds: Callable[[Facts], bool]
    usable: bool
    sentence: str


RULES = (
    _Rule(
        "few readings",
        lambda facts: facts.freedom < FREEDOM_MIN,
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
        "the play varies by {variation} {unit} (sd), more than the play itself, {play}, and no play is negative: the "
        "readings have errors that depend on position and side, such as of a camera's pose or an encoder off centre, "
        "or steps were lost",
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
        "the wave of {amplitude} {unit} every {period} stands on an unexplained error by position of {error} {unit} "
        "(sd), as large as itself and as short: amplitude and phase hold only if that error has no part of this period",
    ),
    _Rule(
        "idle processes",
        lambda facts: facts.idle,
        True,
        "beside the stated wave an error and a play by position explain nothing (odds {odds} : 1 against them) and "
        "widen its intervals: with `transmission_error` and `play_variation` = {{ value = 0, u = 0 }} in [axis] the "
        "gears turn {line} {unit} per command (now {ratio}) with a play of {plain_play} (now {backlash})",
    ),
)
"""Doubts in the order of the report."""


def doubts_of(summary: AxisSummary, without: WithoutProcesses | None) -> tuple[AxisDoubt, ...]:
    """The doubts about a fit; none where it must not be used at all."""
    facts = Facts(summary, without)
    if not summary.explained:
        return ()
    return tuple(AxisDoubt(rule.name, facts.text(rule.sentence), rule.usable) for rule in RULES if rule.holds(facts))
