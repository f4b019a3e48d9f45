"""Guide logs of PHD2, KStars and MaxIm, and tables of time and periodic error: a mount's RA axis that tracks a star.

A run lies between "Guiding Begins" and "Guiding Ends". Distances are pixels on the sky, durations ms, times s since the
beginning of the run. A pulse acts after its frame: the star's uncorrected motion is the raw distance plus the pulses of
all previous frames. Where the star is ahead of the mount, the axis lags: its angle is the drive's less the motion.
Angles of the axis, arcsec: those on the sky over cos(declination).
"""

from __future__ import annotations

import csv
import datetime
import math
import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from statistics import median
from typing import Any, NamedTuple

from tvsbayes.errors import Candidate, escaped
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.importing.asking import asked, refused
from tvsbayes.importing.axis import AxisRows
from tvsbayes.importing.clock import over_midnight, time_of_day
from tvsbayes.importing.columns import columns_of
from tvsbayes.importing.table import ForeignTable
from tvsbayes.importing.words import place_of

SIDEREAL_ARCSEC_PER_S = 1296000.0 / 86164.0905
"""A turn in a sidereal day (Explanatory Supplement to the Astronomical Almanac, 3rd edition, table 15.3)."""
PULSE_MAX = 1.2
"""Largest rate of a pulse, sidereal rates: guide speeds of mounts are at most one."""
RATES_AGREE = 0.25
"""Largest relative difference of two statements of the rate of a pulse."""
RATES_EQUAL = 0.05
"""Largest relative difference of rates between which nothing needs to decide."""
BEGINS, ENDS = "Guiding Begins at ", "Guiding Ends"
MAXIM = "Track Log Started at UT "
"""First line of a run of MaxIm DL, whose track log has offsets in px and corrections in s (its help, "Track Log")."""
NEEDED = ("Time", "RARawDistance", "RADuration", "RADirection")
TIME_MAX_S, RAW_MAX_PX, PULSE_MAX_MS, PIXEL_MAX_ARCSEC = 1e6, 1e5, 1e6, 1e4
"""Far beyond any night, camera and guider: larger numbers are damage."""
DECLINATION_MAX_DEG = 85.0
"""Largest declination: above it 1 / cos(declination) magnifies the seeing beyond the errors of the axis."""
PRIORS = {"per_command": {"value": 1.0, "u": 1e-3}, "transmission_error": {"value": 0.0, "u": 10.0}}
"""Priors of `[axis]`, arcsec: refraction and polar alignment change the apparent rate by parts in 1000; periodic errors
of worms are some arcsec to some tens of arcsec."""
ASSUMED = (
    "a pulse acts after its frame: motion = raw distance + W - E pulses of the frames before",
    "sign: a star ahead of the mount, which W pulses answer, is an axis that lags: angle = drive - motion",
)
ASSUMPTIONS = {
    "declination_deg": "declination of the star",
    "pulse_arcsec_per_s": "what a pulse turns the axis by, arcsec/s",
    "pixel_arcsec": "scale of the guide camera, arcsec per pixel",
    "drive_arcsec_per_s": "rate of the drive: sidereal",
    "pe_sign": "1 where a positive periodic error is an axis ahead of its drive, else -1",
    "ra_axis": "1 where X of a guide camera is right ascension, 2 where Y",
}
"""Values that `--assume` may state, with their meaning."""
_NUMBER = r"(-?\d+(?:\.\d+)?)"
_HEADER = {
    "pixel_arcsec": re.compile(rf"^Pixel scale = {_NUMBER} arc-sec/px"),
    "exposure_ms": re.compile(rf"^Exposure = {_NUMBER} ms"),
    "x_rate": re.compile(rf"\bxRate = {_NUMBER}"),
    "at_equator": re.compile(rf"^Norm rates RA = {_NUMBER}"),
    "guide_speed": re.compile(rf"\bRA Guide Speed = {_NUMBER} a-s/s"),
    "calibration_deg": re.compile(rf"\bCal Dec = {_NUMBER}"),
    "declination_deg": re.compile(rf"^(?:RA = [^,]*, *)?Dec = {_NUMBER} deg"),
    "pulse_max_ms": re.compile(rf"\bMax RA duration = {_NUMBER}"),
}
_CALIBRATED = re.compile(rf"Calibration guide speeds: RA = {_NUMBER} a-s/s")
_MOUNT, _PIER = re.compile(r"^Mount = ([^,]*)"), re.compile(r"\bPier side = (\w+)")
_EVENTS = (
    (re.compile(r"Settling (?:started|complete|failed)"), "", True),
    (re.compile(r"DITHER by"), "dither", True),
    (re.compile(r"SET LOCK POSITION|LOCK SHIFT"), "", True),
    (re.compile(r"received RESUME|Resumed"), "pause", True),
    (re.compile(r"(?=.*Guiding parameter change).* RA "), "change of the RA algorithm", False),
)
"""INFO lines: their words, what is counted, and whether the zero is new after them."""
_WORM = re.compile(r"^!WormPeriod\s*=\s*(\d+(?:\.\d+)?)", re.MULTILINE)


class GuideFrame(NamedTuple):
    """A frame with a star: line of the log, time, raw distance, pulse with W positive, whether the guider settles."""

    line: int
    time_s: float
    raw_px: float
    pulse_ms: float
    settling: bool


@dataclass
class GuideRun:
    """A run of a log.

    Attributes:
        number: number of the run, from 1.
        line: first line of the run.
        begins: local time as written, "" if missing.
        mount: driver of the mount as logged.
        pier: side of the pier.
        header: numbers of the header by the names of `_HEADER`.
        frames: those with a star.
        dropped_s: times of frames without a star.
        breaks: indices of `frames` with a new zero: after dithers, new lock positions, settling, pauses.
        counts: numbers of events by name.
        ended: whether the log contains the end of the run.
        program: that wrote the log, "PHD2", "KStars" or "MaxIm".
    """

    number: int
    line: int
    begins: str
    mount: str = "unknown"
    pier: str = "unknown"
    header: dict[str, float] = field(default_factory=dict)
    frames: list[GuideFrame] = field(default_factory=list)
    dropped_s: list[float] = field(default_factory=list)
    breaks: set[int] = field(default_factory=set)
    counts: Counter[str] = field(default_factory=Counter)
    ended: bool = False
    program: str = "PHD2"

    @property
    def minutes(self) -> float:
        """Time from the first frame to the last."""
        return (self.frames[-1].time_s - self.frames[0].time_s) / 60.0 if self.frames else 0.0

    @property
    def settling(self) -> int:
        """Number of frames while the mount settled."""
        return sum(frame.settling for frame in self.frames)


def is_guide_log(text: str) -> bool:
    """Whether a text is a guide log of PHD2, KStars or MaxIm."""
    return BEGINS in text or MAXIM in text or text.startswith(("PHD2 version", "KStars version"))


def read_runs(text: str, file: str, ra_axis: float | None = None) -> list[GuideRun]:
    """The runs of a log, without runs that have no frame; of MaxIm those of X, or of Y where `ra_axis` is 2.

    Raises:
        InputError: no run, or a table of frames without a required column.
    """
    program = "MaxIm" if MAXIM in text else "KStars" if text.lstrip("\ufeff").startswith("KStars") else "PHD2"
    found = _maxim_runs(text.splitlines(), ra_axis == 2) if program == "MaxIm" else _guided_runs(text, file)
    runs = [run for run in found if run.frames]
    if not runs:
        raise refused("no-guiding", file)
    return [replace(run, number=k, program=program) for k, run in enumerate(runs, start=1)]


def _guided_runs(text: str, file: str) -> list[GuideRun]:
    """The runs of PHD2 and KStars."""
    runs: list[GuideRun] = []
    run: GuideRun | None = None
    columns: list[str] = []
    settling, calibrating, steps, speeds = False, False, 0, dict[str, float]()
    for number, line in enumerate(map(str.strip, text.splitlines()), start=1):
        if line.startswith(BEGINS):
            run = GuideRun(0, number, line.removeprefix(BEGINS), header=dict(speeds))
            runs.append(run)
            run.counts["calibration step"], steps = steps, 0
            columns, settling, calibrating = [], False, False
        elif line.startswith("Calibration Begins at"):
            calibrating, run = True, None
        elif calibrating:
            if (match := _CALIBRATED.search(line)) and math.isfinite(speed := float(match[1])):
                speeds["calibrated_speed"] = speed
            steps += line.startswith(("West,", "East,", "North,", "South,", "Backlash,"))
        elif run is None or not line:
            continue
        elif line.startswith(ENDS):
            run.ended, run = True, None
        elif line.startswith("INFO:"):
            _, name, is_break = next((event for event in _EVENTS if event[0].search(line)), ("", "", False))
            run.counts.update([name] if name else [])
            run.breaks |= {len(run.frames)} if is_break else set()
            settles = re.search(r"Settling (?:complete|failed)", line) is None
            settling = "Settling started" in line or (settling and settles)
        elif line.startswith("Frame,"):
            columns = line.split(",")
            if missing := [name for name in NEEDED if name not in columns]:
                raise refused("frame-columns", file, line=number, names=missing, needed=NEEDED)
        elif columns:
            _frame(run, number, line, columns, settling)
        else:
            _header(run, line)
    return runs


def _maxim_runs(lines: Sequence[str], is_y: bool) -> Iterator[GuideRun]:
    """Runs of MaxIm: a positive correction moves the star to larger numbers, so that it acts as a negative pulse."""
    starts = [k for k, line in enumerate(lines) if MAXIM in line]
    for first, end in pairwise([*starts, len(lines)]):
        begins = lines[first].partition(MAXIM)[2].strip()
        run = GuideRun(0, first + 1, begins, mount="a mount of MaxIm", ended=True)
        rows = [(number, lines[number - 1]) for number in range(first + 2, end + 1)]
        timed = [(of_day, *row) for row in rows if (of_day := time_of_day(row[1].split(",")[0].strip())) is not None]
        clocks_s = over_midnight([of_day for of_day, *_ in timed])
        for clock_s, (_, number, line) in zip(clocks_s, timed, strict=True):
            time_s, cells = clock_s - clocks_s[0], [cell.strip() for cell in line.split(",")[1:7]]
            numbers = [float(cell) if NUMBER.fullmatch(cell) else math.nan for cell in cells]
            offset, correction_s = numbers[2 + is_y : 5 + is_y : 2] if len(numbers) == 6 else (math.nan, math.nan)
            late = time_s < (run.frames[-1].time_s if run.frames else 0.0)
            if not late and abs(offset) <= RAW_MAX_PX and 1000 * abs(correction_s) <= PULSE_MAX_MS:
                run.frames.append(GuideFrame(number, time_s, offset, -1000.0 * correction_s, False))
            elif not late and "fade" in line.lower():
                run.dropped_s.append(time_s)
            else:
                run.counts["damaged row"] += 1
        yield run


def _header(run: GuideRun, line: str) -> None:
    for name, pattern in _HEADER.items():
        if (match := pattern.search(line)) and name not in run.header and math.isfinite(number := float(match[1])):
            run.header[name] = number
    if match := _MOUNT.search(line):
        run.mount = match[1].strip()
    if match := _PIER.search(line):
        run.pier = match[1]


def _frame(run: GuideRun, number: int, line: str, columns: Sequence[str], settling: bool) -> None:
    """Add a row of the table to the run; a truncated row, or one of another device, is only counted."""
    try:
        cells = dict(zip(columns, next(csv.reader([line])), strict=False))
        time_s, device = float(cells["Time"]), cells.get("mount", "Mount")
        last = max((run.frames[-1].time_s if run.frames else 0.0, run.dropped_s[-1] if run.dropped_s else 0.0))
        if not last <= time_s <= TIME_MAX_S:
            run.counts["damaged row"] += 1
        elif device == "DROP" or cells["RARawDistance"] == "":
            run.dropped_s.append(time_s)
        elif device != "Mount":
            run.counts[f"rows of {escaped(device, 12)}"] += 1
        else:
            raw, pulse_ms = float(cells["RARawDistance"]), float(cells["RADuration"] or 0)
            sign = {"W": 1.0, "E": -1.0, "": 0.0}[cells["RADirection"].strip()[:1].upper()]
            if not (abs(raw) <= RAW_MAX_PX and abs(pulse_ms) <= PULSE_MAX_MS):
                raise ValueError("no number of a guider")
            run.frames.append(GuideFrame(number, time_s, raw, sign * pulse_ms, settling))
            run.counts["frame with a saturated star"] += cells.get("ErrorCode") == "1"
    except (KeyError, ValueError, csv.Error, StopIteration):
        run.counts["damaged row"] += 1


def run_rows(runs: Sequence[GuideRun]) -> list[dict[str, object]]:
    """A row for each run, for the printed list of a log with several runs."""
    return [
        {
            "run": run.number,
            "begins": run.begins,
            "minutes": round(run.minutes, 1),
            "frames": len(run.frames),
            "dropped": len(run.dropped_s),
            "settling": run.settling,
            "dithers": run.counts["dither"],
            "declination_deg": run.header.get("declination_deg"),
            "pier": run.pier,
            "mount": run.mount,
        }
        for run in runs
    ]


def _scale(
    run: GuideRun, runs: Sequence[GuideRun], stated: Mapping[str, float], file: str, assumed: list[str]
) -> tuple[float, float, float, float]:
    """Pixel scale, cosine of the declination, rates of pulses and drive, arcsec/s; their sources go to `assumed`."""
    known, is_maxim = {**run.header, **stated}, run.program == "MaxIm"
    needed = {"pixel_arcsec": "the pixel scale", "declination_deg": "the declination"}
    if is_maxim:
        needed |= {"pulse_arcsec_per_s": "the rate of a pulse"} if any(f.pulse_ms for f in run.frames) else {}
        needed |= {"ra_axis": "which of X and Y is right ascension"}
    if missing := [name for name in needed if name not in known]:
        numbers = tuple(w for name in missing if name != "ra_axis" for w in ("--assume", f"{name}=NUMBER"))
        axes = {f"{axis} is right ascension": ("--assume", f"ra_axis={k}") for k, axis in ((1, "X"), (2, "Y"))}
        ways = axes if "ra_axis" in missing else {"with your numbers": ()}
        answers = [Candidate(says, (*numbers, *words)) for says, words in ways.items()]
        said: dict[str, Any] = {"run": run.number, "values": " and ".join(needed[name] for name in missing)}
        raise asked("missing-value", file, line=run.line, answers=answers, **said)
    pixel, declination = known["pixel_arcsec"], known["declination_deg"]
    if not abs(declination) <= DECLINATION_MAX_DEG:
        raise refused("declination", file, line=run.line, declination=declination, most=DECLINATION_MAX_DEG)
    if not 0 < pixel <= PIXEL_MAX_ARCSEC:
        raise refused("pixel-scale", file, line=run.line, pixel=pixel, most=PIXEL_MAX_ARCSEC)
    cosine = math.cos(math.radians(declination))
    pulse, text = stated.get("pulse_arcsec_per_s", 0.0), "no corrections: the star's way is the axis' own"
    if "pulse_arcsec_per_s" in stated:
        text = f"pulses turn the axis by {pulse:g} arcsec/s, as stated"
        ratios = [abs(1000 * f.raw_px / f.pulse_ms) for f in run.frames if f.pulse_ms and is_maxim]
        if ratios and pulse > (1 + RATES_AGREE) * (most := median(ratios) * pixel / cosine):
            # A guider corrects at most what it sees.
            raise asked("large-pulses", file, line=run.line, pulse=pulse, most=most)
    elif not is_maxim:
        pulse, text = _logged_pulse(run, runs, pixel, declination, file)
        text += "; --assume pulse_arcsec_per_s="
    drive = stated.get("drive_arcsec_per_s", SIDEREAL_ARCSEC_PER_S)
    assumed += [
        f"declination {declination:g} deg: distances on the sky over {cosine:.4f}; --assume declination_deg=",
        f"pixel scale {pixel:g} arcsec/px; --assume pixel_arcsec=",
        text,
        f"the drive turns at {drive:.6g} arcsec/s; --assume drive_arcsec_per_s=",
    ]
    return pixel, cosine, pulse, drive


def _hypotheses(run: GuideRun, pixel: float, declination_deg: float) -> dict[str, float]:
    """Rates of the axis during a pulse, arcsec/s, by what the program's xRate may be.

    PHD2: px/s at the declination of the run or of the calibration. KStars: arcsec/s on the sky at the declination of
    the run (Ekos, internalguider: 1000 / raPulseMillisecondsPerArcsecond); before, px/s.
    """
    cosine, rate = math.cos(math.radians(declination_deg)), run.header.get("x_rate", 0.0)
    if not min(rate, pixel) > 0:
        return {}
    if run.program == "KStars":
        return {"xRate in arcsec/s on the sky": rate / cosine, "xRate in px/s": rate * pixel / cosine}
    rates = {"xRate in px/s at the run's declination": rate * pixel / cosine}
    calibration = run.header.get("calibration_deg")
    if calibration is not None and abs(calibration) < 90:
        name = f"xRate in px/s at the calibration's declination of {calibration:g} deg"
        rates[name] = rate * pixel / math.cos(math.radians(calibration))
    return rates


def _logged_pulse(
    run: GuideRun, runs: Sequence[GuideRun], pixel: float, declination_deg: float, file: str
) -> tuple[float, str]:
    """Rate of the axis during a pulse, arcsec/s, and its source: the hypothesis that other statements support."""
    rates = _hypotheses(run, pixel, declination_deg)
    header, cosine = run.header, math.cos(math.radians(declination_deg))
    if not rates:
        answers = [Candidate("with your number", ("--assume", "pulse_arcsec_per_s=NUMBER"))]
        raise asked("missing-value", file, line=run.line, answers=answers, run=run.number, values="xRate")
    stated = {
        "Norm rates": header.get("at_equator"),
        "the mount's guide speed": header.get("guide_speed"),
        "the calibration's guide speed": header["calibrated_speed"] / cosine if "calibrated_speed" in header else None,
    }
    evidence = {name: rate for name, rate in stated.items() if rate is not None and rate > 0}
    others = _other_rates(run, runs)
    if others is not None:
        evidence["the other runs"] = others
    deciding = next(iter(evidence.values()), None)
    near = min(rates, key=lambda name: abs(math.log(rates[name] / deciding))) if deciding else next(iter(rates))
    pulse = rates[near]
    text = f"pulses turn the axis by {pulse:.4g} arcsec/s: {near}"
    text += "".join(f"; {name}: {rate:.4g}, {100 * (rate / pulse - 1):+.0f} %" for name, rate in evidence.items())
    against = [name for name, rate in evidence.items() if abs(rate / pulse - 1) > RATES_AGREE]
    undecided = not evidence and max(rates.values()) / min(rates.values()) - 1 > RATES_EQUAL
    if against or undecided or pulse > PULSE_MAX * SIDEREAL_ARCSEC_PER_S:
        says = {**rates, **evidence}
        possible = [item for item in says.items() if item[1] <= PULSE_MAX * SIDEREAL_ARCSEC_PER_S]
        stated_rates = ", ".join(f"{rate:.4g} arcsec/s ({name})" for name, rate in says.items())
        said: dict[str, Any] = {"run": run.number, "rates": stated_rates, "agree": RATES_AGREE, "most": PULSE_MAX}
        raise asked("pulse-rates", file, line=run.line, each=possible, **said)
    return pulse, text


def _other_rates(run: GuideRun, runs: Sequence[GuideRun]) -> float | None:
    """The rate that the runs of a log state alike, arcsec/s: one hypothesis is the same at all declinations."""
    headers = ((other, other.header.get("pixel_arcsec"), other.header.get("declination_deg")) for other in runs)
    rates = [[*_hypotheses(o, p, d).values()] for o, p, d in headers if p is not None and d is not None and abs(d) < 85]
    rows = [row for row in rates if len(row) == 2]
    if len(rows) < 2 or run.program == "KStars":
        return None
    spreads = [max(column) / min(column) - 1 for column in zip(*rows, strict=True)]
    best = min((0, 1), key=lambda k: spreads[k])
    if spreads[1 - best] < RATES_EQUAL or spreads[best] > 0.5 * spreads[1 - best]:
        return None
    return median(row[best] for row in rows)


def rows_of_run(run: GuideRun, runs: Sequence[GuideRun], file: str, stated: Mapping[str, float]) -> AxisRows:
    """A run as moves and readings: the drive's angle less the star's uncorrected motion, both in arcsec of the axis.

    Args:
        run: a run of the log.
        runs: all runs of the log.
        file: its name.
        stated: numbers by the names of `ASSUMPTIONS`, which override those of the log.

    Raises:
        InputError: a number that neither `stated` nor the log contains, or fewer than three usable frames.
    """
    assumed: list[str] = []
    pixel, cosine, pulse, drive = _scale(run, runs, stated, file, assumed)
    sign = math.copysign(1.0, stated.get("pe_sign", 1.0)) if run.program == "MaxIm" else 1.0
    if run.program == "MaxIm":
        which, where = ("Y" if stated.get("ra_axis") == 2 else "X"), "lags" if sign > 0 else "is ahead"
        assumed.append("a correction acts after its frame: motion = offset - corrections of the frames before")
        assumed.append(f"sign: where {which} grows the axis {where}; --assume pe_sign={-sign:g} says the other")
    else:
        assumed += ASSUMED
    moves: list[dict[str, Any]] = []
    rows: list[_Row] = []
    pulses, needs_move = 0.0, True
    for k, (_, time_s, raw, pulse_ms, settling) in enumerate(run.frames):
        needs_move = needs_move or k in run.breaks
        if needs_move and not settling:
            moves.append(_drive_move(len(moves), time_s, drive))
            pulses, needs_move = 0.0, False
        value = None if settling else drive * time_s - sign * (raw * pixel / cosine + pulses)
        rows.append((time_s, len(moves) - 1, value, "settling" if settling else "ok"))
        pulses += pulse_ms / 1000.0 * pulse
    used = sum(value is not None for _, _, value, _ in rows)
    if used < 3:
        raise refused("few-frames", file, line=run.line, count=used)
    starts_s = [move["time_s"] for move in moves]
    rows += [(t, bisect_right(starts_s, t) - 1, None, "dropped") for t in run.dropped_s]
    # Frames before the first stretch belong to no move.
    rows = [(t, max(0, m), v, said) for t, m, v, said in sorted(rows, key=lambda row: row[0]) if t >= starts_s[0]]
    notes = (_frames_text(run, used, len(moves)), *_remarks(run))
    return _drive_rows(drive, moves, rows, assumed, notes, _header_of(run, file))


_Row = tuple[float, int, float | None, str]
"""Time, move, value and status of a reading."""


def _drive_rows(
    rate: float,
    moves: list[dict[str, Any]],
    rows: Sequence[_Row],
    assumed: Sequence[str],
    notes: tuple[str, ...],
    header: Mapping[str, object],
    axis: Mapping[str, Any] | None = None,
) -> AxisRows:
    """Readings of a drive at a constant rate; an unknown period is from a minute to a third of the run, s, if any."""
    readings = [
        {"reading": k, "move": m, "value": None if v is None else round(v, 4), "u": 0.0, "status": status, "time_s": t}
        for k, (t, m, v, status) in enumerate(rows)
    ]
    span_s = rows[-1][0] - rows[0][0]
    between = {"periods_in": "seconds", "period_between": [60.0, round(span_s / 3.0, 0)]} if span_s > 360.0 else {}
    entries = {**PRIORS, **(between if axis is None else axis)}
    return AxisRows(moves, readings, "arcsec", tuple(assumed), notes, {"rate": rate, **header}, entries)


def _drive_move(number: int, time_s: float, rate: float) -> dict[str, Any]:
    at = {"move": number, "segment": number, "time_s": time_s}
    return {**at, "command": round(rate * time_s, 6), "approach": "forward"}


# --- tables of time and periodic error -------------------------------------------------------------------------------
def is_periodic_error(text: str, table: ForeignTable) -> bool:
    """Whether a table holds times and a periodic error, and nothing that is commanded."""
    if _WORM.search(text):
        return True
    columns = columns_of(table).values()
    has_error = any(place_of(column.name.words, "periodic-error") is not None and column.numeric for column in columns)
    return has_error and not any(column.name.has("command") for column in columns)


def periodic_error_rows(table: ForeignTable, text: str, stated: Mapping[str, float]) -> AxisRows:
    """Times and periodic errors of a drive at constant rate as readings in motion, arcsec.

    Args:
        table: columns of times and errors; of EQMOD's recorder the first and the last of three.
        text: text of the file, for the period of the worm that it may state.
        stated: numbers by the names of `ASSUMPTIONS`.

    Raises:
        InputError: no times or errors, or fewer than three of them.
    """
    known, worm = columns_of(table), _WORM.search(text)
    errors = [n for n, c in known.items() if place_of(c.name.words, "periodic-error") is not None and c.numeric]
    times = [n for n, c in known.items() if c.name.has("time") and c.numeric]
    if worm and not errors and len(known) == 3:
        times, _, errors = ([name] for name in known)
    if len(errors) != 1 or len(times) != 1:
        raise refused("periodic-error", table.file, line=table.first_line, times=len(times), errors=len(errors))
    time_unit, unit = (known[name].name.unit for name in (*times, *errors))
    scale_s = time_unit.scale if time_unit and time_unit.kind == "time" else 1.0
    scale = 3600.0 * unit.scale * unit.per_number if unit and unit.kind == "angle" else 1.0
    pairs = [
        (scale_s * float(t), scale * float(e))
        for t, e in zip(table.columns[times[0]], table.columns[errors[0]], strict=True)
        if NUMBER.fullmatch(t) and NUMBER.fullmatch(e)
    ]
    if len(pairs) < 3 or any(b[0] < a[0] for a, b in pairwise(pairs)):
        raise refused("few-errors", table.file, count=len(pairs))
    sign = math.copysign(1.0, stated.get("pe_sign", 1.0))
    rate = stated.get("drive_arcsec_per_s", SIDEREAL_ARCSEC_PER_S)
    columns = f"times in column {escaped(times[0])}, periodic error in column {escaped(errors[0])}"
    assumed = [
        f"{columns}, {unit.name if unit else 'arcsec'}",
        f"the drive turns at {rate:.6g} arcsec/s; --assume drive_arcsec_per_s=",
        f"sign: a positive error is an axis {'ahead of' if sign > 0 else 'behind'} its drive; "
        f"--assume pe_sign={-sign:g} says the other",
        *([f"the worm's period: {worm[1]} s, as the file says"] if worm else []),
    ]
    axis = {"periods_in": "seconds", "periods": [float(worm[1])]} if worm else None
    notes, header = (f"{len(pairs)} of {len(table)} rows are numbers",), {"name": table.file[:200]}
    rows: list[_Row] = [(t, 0, rate * t + sign * e, "ok") for t, e in pairs]
    return _drive_rows(rate, [_drive_move(0, pairs[0][0], rate)], rows, assumed, notes, header, axis)


# --- texts -----------------------------------------------------------------------------------------------------------
def _several(count: int, name: str) -> str:
    return f"{count} {name}{'s' * (count != 1)}"


def _frames_text(run: GuideRun, used: int, stretches: int) -> str:
    """Numbers of frames used and left out, in words."""
    events = [f"{run.settling} while settling", f"{len(run.dropped_s)} dropped"]
    events += [_several(n, name) for name in ("damaged row", "calibration step") if (n := run.counts[name])]
    events += [f"{n} {name}" for name, n in run.counts.items() if name.startswith("rows of") and n]
    text = f"frames: {used} used of {len(run.frames) + len(run.dropped_s)} ({', '.join(events)} left out)"
    breaks = [_several(run.counts["dither"], "dither"), *([_several(n, "pause")] if (n := run.counts["pause"]) else [])]
    words = "of its own each" if stretches > 1 else "of its own"
    return f"{text}; {stretches} stretch{'es' * (stretches != 1)} with a zero {words} ({', '.join(breaks)})"


def _remarks(run: GuideRun) -> Iterator[str]:
    """Further remarks on a run."""
    yield f"pier side {run.pier}"
    if not run.ended:
        yield "the log does not say that the run ended: it may be cut off"
    step = median([b.time_s - a.time_s for a, b in pairwise(run.frames)] or [0.0])
    pulses, limit_ms = [abs(frame.pulse_ms) for frame in run.frames], run.header.get("pulse_max_ms")
    if long_pulses := sum(p > 1000.0 * step for p in pulses):
        yield f"{long_pulses} pulses last longer than the {step:.2g} s between frames and act in part later"
    if limit_ms and (at_limit := sum(p >= limit_ms for p in pulses)):
        yield f"{at_limit} pulses at their limit of {limit_ms:g} ms"
    if n := run.counts["frame with a saturated star"]:
        yield f"{_several(n, 'frame')} with a saturated star, used"
    if n := run.counts["change of the RA algorithm"]:
        yield f"{_several(n, 'change')} of the RA algorithm during the run"


def _header_of(run: GuideRun, file: str) -> dict[str, object]:
    header: dict[str, object] = {"name": f"{file}, run {run.number}", "instrument": run.mount[:200]}
    try:
        header["created"] = datetime.datetime.fromisoformat(run.begins)
    except ValueError:
        header["notes"] = f"begins {run.begins[:100]}"
    return header
