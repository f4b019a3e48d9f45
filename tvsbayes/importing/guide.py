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
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median
from typing import Any, NamedTuple

from tvsbayes.errors import Candidate, escaped, plural
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.importing.asking import asked, refused
from tvsbayes.importing.axis import AxisRows
from tvsbayes.importing.clock import DAY_S, time_of_day
from tvsbayes.importing.columns import Column, columns_of
from tvsbayes.importing.table import ForeignTable
from tvsbayes.importing.words import place_of

SIDEREAL_ARCSEC_PER_S = 1296000.0 / 86164.0905
"""A turn in a sidereal day (Explanatory Supplement to the Astronomical Almanac, 3rd edition, table 15.3)."""
PULSE_MIN, PULSE_MAX = 0.05, 1.2
"""Least and largest rate of a pulse, sidereal rates: guide speeds of mounts are from a tenth to one."""
RATES_AGREE, RATES_EQUAL = 0.25, 0.05
"""Largest relative differences: of two statements of the rate of a pulse, and of rates between which none decides."""
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
DRIVEN = {"drive_arcsec_per_s": SIDEREAL_ARCSEC_PER_S, "pe_sign": 1.0}
"""What is assumed of a drive."""
ASSUMPTIONS = {
    "declination_deg": "declination of the star",
    "pulse_arcsec_per_s": "what a pulse turns the axis by, arcsec/s",
    "pixel_arcsec": "arcsec per pixel",
    "drive_arcsec_per_s": "rate of the drive: sidereal",
    "pe_sign": "1 where an axis ahead has a positive error, else -1",
    "ra_axis": "1 where X is right ascension, 2 where Y",
}
"""Values that `--assume` may state, with their meaning."""
MAXIM = "Track Log Started at UT"
"""First line of a run of MaxIm DL, whose track log has offsets in px and corrections in s (its help, "Track Log")."""
_BEGINS = re.compile(rf"^Guiding Begins at\b|^Calibration Begins at\b|{MAXIM}")
_COLUMNS = {
    "Frame,": ("Time", "RARawDistance", "RADuration", "RADirection"),
    "UT Time,": ("UT Time", "Star X", "Star Y", "OffsetX", "OffsetY", "Corr X", "Corr Y"),
}
"""Columns that a log needs, by the beginning of the line that names them."""
_NUMBER = r"(-?\d{1,9}(?:\.\d+)?)(?!,?\d)"
"""A decimal comma makes it no number: the whole part alone would be another."""
_HEADER = {
    "calibrated_speed": rf"Calibration guide speeds: RA = {_NUMBER} a-s/s",
    "pixel_arcsec": rf"^Pixel scale = {_NUMBER} arc-sec/px",
    # Adaptive optics have a line and an xRate of their own.
    "x_rate": rf"^Mount = .*\bxRate = {_NUMBER}",
    "at_equator": rf"^Norm rates RA = {_NUMBER}",
    "guide_speed": rf"\bRA Guide Speed = {_NUMBER} a-s/s",
    "calibration_deg": rf"\bCal Dec = {_NUMBER}",
    "declination_deg": rf"^(?:RA = [^,\n]*, *)?Dec = {_NUMBER} deg",
    "pulse_max_ms": rf"\bMax RA duration = {_NUMBER}",
    "mount": r"^Mount = ([^,\n]*)",
    "pier": r"\bPier side = (\w+)",
}
_EVENT = re.compile(
    r"Settling (?P<settling>started|complete|failed)|(?P<dither>DITHER by)|(?P<lock>SET LOCK POSITION|LOCK SHIFT)"
    r"|(?P<pause>received RESUME|Resumed)|(?P<change>Guiding parameter change.* RA )"
)
"""Of INFO lines; the zero is new after all but a change of the algorithm."""
_WORM = re.compile(r"^!WormPeriod\s*=\s*(\d+(?:\.\d+)?)", re.MULTILINE)


class GuideFrame(NamedTuple):
    """A row of a run: time, raw distance (None without a star), pulse after it (W positive); see `GuideRun.rows`."""

    time_s: float
    raw_px: float | None
    pulse_ms: float
    settling: bool
    is_new: bool


@dataclass
class GuideRun:
    """A run of a log.

    Attributes:
        number: number of the run, from 1.
        line: first line of the run.
        begins: local time as written, "" if missing.
        program: that wrote the log, "PHD2", "KStars" or "MaxIm".
        header: what the log states by the names of `_HEADER`: numbers, the driver of the mount, the side of the pier.
        counts: numbers of events by name.
        rows: frames in time order; with `settling` they are left out, from `is_new` on the zero is another.
    """

    number: int
    line: int
    begins: str
    program: str
    header: dict[str, Any]
    counts: Counter[str]
    rows: list[GuideFrame] = field(default_factory=list)

    @property
    def frames(self) -> list[GuideFrame]:
        """Frames with a star."""
        return [row for row in self.rows if row.raw_px is not None]


def is_guide_log(text: str) -> bool:
    """Whether a text is a guide log of PHD2, KStars or MaxIm."""
    return "Guiding Begins at " in text or MAXIM in text or text.startswith(("PHD2 version", "KStars version"))


def read_runs(text: str, file: str, ra_axis: float | None = None) -> list[GuideRun]:
    """The runs of a log, without runs that have no frame; of MaxIm those of X, or of Y where `ra_axis` is 2.

    Raises:
        InputError: no run, or a table of frames without a required column.
    """
    program = "MaxIm" if MAXIM in text else "KStars" if text.lstrip("\ufeff").startswith("KStars") else "PHD2"
    mount = {"mount": "a mount of MaxIm" if program == "MaxIm" else "unknown", "pier": "unknown"}
    lines = list(enumerate(map(str.strip, text.splitlines()), start=1))
    starts = [k for k, (_, line) in enumerate(lines) if _BEGINS.search(line)]
    runs, steps, speed = list[GuideRun](), 0, dict[str, Any]()
    for start, end in pairwise([*starts, len(lines)]):
        (number, begins), part = lines[start], lines[start + 1 : end]
        named = next((k for k, (_, line) in enumerate(part) if line.startswith(tuple(_COLUMNS))), len(part))
        text = "\n".join(line for _, line in part[:named])
        found = {name: match[1] for name, form in _HEADER.items() if (match := re.search(form, text, re.MULTILINE))}
        header = {name: word if name in ("mount", "pier") else float(word) for name, word in found.items()}
        if begins.startswith("Calibration"):
            steps += sum(line.startswith(("West,", "East,", "North,", "South,", "Backlash,")) for _, line in part)
            speed = {"calibrated_speed": header["calibrated_speed"]} if "calibrated_speed" in header else speed
            continue
        counts, steps = Counter({"calibration step": steps, "end": program == "MaxIm"}), 0
        begins = _BEGINS.split(begins)[-1].strip()
        run = GuideRun(len(runs) + 1, number, begins, program, {**mount, **speed, **header}, counts)
        _read(run, part, "Y" if ra_axis == 2 else "X", file)
        runs += [run] if run.frames else []
    if not runs:
        raise refused("no-guiding", file)
    return runs


def _read(run: GuideRun, lines: Iterable[tuple[int, str]], axis: str, file: str) -> None:
    """Read the rows of a run; a damaged row, or one of another device, is only counted."""
    settling = is_new = False
    columns: Sequence[str] = _COLUMNS["UT Time,"] if run.program == "MaxIm" else ()
    for number, line in lines:
        needed = next((needed for head, needed in _COLUMNS.items() if line.startswith(head)), None)
        if line.startswith("Guiding Ends"):
            run.counts["end"] += 1
            break
        if needed is not None:
            columns = [name.strip() for name in line.split(",")]
            if missing := [name for name in needed if name not in columns]:
                raise refused("frame-columns", file, line=number, names=missing, needed=needed)
        elif line.startswith("INFO:"):
            if (event := _EVENT.search(line)) is not None:
                run.counts[str(event.lastgroup)] += 1
                is_new |= event["change"] is None
                settling = event["settling"] == "started" if event["settling"] else settling
        elif columns and line:
            try:
                cells = dict(zip(columns, map(str.strip, next(csv.reader([line]))), strict=False))
                device = cells.get("mount", "Mount")
                if device not in ("Mount", "DROP") and "RARawDistance" in cells:
                    run.counts[f"rows of {escaped(device, 12)}"] += 1
                    continue
                run.rows.append(GuideFrame(*_row(run, cells, axis), settling, is_new))
                run.counts["saturated"] += cells.get("ErrorCode") == "1"
                is_new = False
            except (KeyError, ValueError, csv.Error, StopIteration):
                # Its pulse is unknown.
                run.counts["damaged row"] += 1
                is_new = True


def _row(run: GuideRun, cells: Mapping[str, str], axis: str) -> tuple[float, float | None, float]:
    """Time, raw distance and pulse of a row; any error of reading means that it is damaged."""
    last_s, raw_px, pulse_ms = run.rows[-1].time_s if run.rows else 0.0, None, 0.0
    if run.program == "MaxIm":
        if (of_day := time_of_day(cells["UT Time"])) is None:
            raise ValueError("no time of day")
        # The time of this clock next to the row before: a small step back is none over midnight.
        after_s = of_day - run.header.setdefault("begun_s", of_day) - last_s
        time_s = last_s + (after_s + DAY_S / 2) % DAY_S - DAY_S / 2
        if "fade" not in cells["Star X"].lower():
            # A positive correction moves the star to larger numbers, as a pulse to the east.
            raw_px, pulse_ms = float(cells[f"Offset{axis}"]), -1000.0 * float(cells[f"Corr {axis}"])
    else:
        time_s = float(cells["Time"])
        if cells.get("mount") != "DROP" and cells["RARawDistance"]:
            sign = {"W": 1.0, "E": -1.0, "": 0.0}[cells["RADirection"][:1].upper()]
            raw_px, pulse_ms = float(cells["RARawDistance"]), sign * float(cells["RADuration"] or 0)
    if not (last_s <= time_s <= TIME_MAX_S and abs(raw_px or 0.0) <= RAW_MAX_PX and abs(pulse_ms) <= PULSE_MAX_MS):
        raise ValueError("no row of a guider")
    return time_s, raw_px, pulse_ms


def run_rows(runs: Sequence[GuideRun]) -> list[dict[str, Any]]:
    """A row for each run, for the printed list of a log with several runs."""
    return [
        {
            "run": run.number,
            "begins": run.begins,
            "minutes": round((run.frames[-1].time_s - run.frames[0].time_s) / 60.0, 1),
            "frames": len(run.frames),
            "dropped": len(run.rows) - len(run.frames),
            "settling": sum(frame.settling for frame in run.frames),
            "dithers": run.counts["dither"],
            "declination_deg": run.header.get("declination_deg"),
            "pier": run.header["pier"],
            "mount": run.header["mount"],
        }
        for run in runs
    ]


# --- the rate of a pulse ---------------------------------------------------------------------------------------------
def _hypotheses(run: GuideRun, known: Mapping[str, Any]) -> dict[str, float]:
    """Rates of the axis during a pulse, arcsec/s, by what the program's xRate may be.

    PHD2: px/s at the declination of the run or of the calibration. KStars: arcsec/s on the sky at the declination of
    the run (Ekos, internalguider: 1000 / raPulseMillisecondsPerArcsecond); before, px/s.
    """
    rate, pixel = run.header.get("x_rate", 0.0), known.get("pixel_arcsec", 0.0)
    declination, calibration = known.get("declination_deg", 90.0), run.header.get("calibration_deg", 90.0)
    if not (min(rate, pixel) > 0 and abs(declination) <= DECLINATION_MAX_DEG):
        return {}
    cosine = math.cos(math.radians(declination))
    if run.program == "KStars":
        return {"xRate in arcsec/s on the sky": rate / cosine, "xRate in px/s": rate * pixel / cosine}
    rates = {"xRate in px/s at the run's declination": rate * pixel / cosine}
    if abs(calibration) < 90:
        name = f"xRate in px/s at the calibration's declination of {calibration:g} deg"
        rates[name] = rate * pixel / math.cos(math.radians(calibration))
    return rates


def _common_rate(runs: Sequence[GuideRun]) -> float:
    """The rate that the runs of PHD2 state alike, arcsec/s, else 0: one hypothesis is the same at all declinations."""
    rows = [tuple(rates.values()) for run in runs if len(rates := _hypotheses(run, run.header)) == 2]
    if len(rows) < 2 or runs[0].program == "KStars":
        return 0.0
    least, most = sorted((max(rates) / min(rates) - 1, median(rates)) for rates in zip(*rows, strict=True))
    return least[1] if most[0] >= RATES_EQUAL and least[0] <= 0.5 * most[0] else 0.0


def _logged_pulse(run: GuideRun, runs: Sequence[GuideRun], known: Mapping[str, Any], file: str) -> tuple[float, str]:
    """Rate of the axis during a pulse, arcsec/s, and its source: the hypothesis that other statements support."""
    rates, header = _hypotheses(run, known), run.header
    least, most = PULSE_MIN * SIDEREAL_ARCSEC_PER_S, PULSE_MAX * SIDEREAL_ARCSEC_PER_S
    answers = [Candidate("with your number", ("--assume", "pulse_arcsec_per_s=NUMBER"))]
    if not rates:
        raise asked("missing-value", file, line=run.line, answers=answers, run=run.number, values="xRate")
    cosine = math.cos(math.radians(known["declination_deg"]))
    stated = {
        "Norm rates": header.get("at_equator", 0.0),
        "the mount's guide speed": header.get("guide_speed", 0.0),
        "the calibration's guide speed": header.get("calibrated_speed", 0.0) / cosine,
        "the other runs": _common_rate(runs),
    }
    evidence = {name: rate for name, rate in stated.items() if rate > 0}
    first = next(iter({**evidence, **rates}.values()))
    near = min(rates, key=lambda name: abs(math.log(rates[name] / first)))
    pulse = rates[near]
    undecided = not evidence and max(rates.values()) / min(rates.values()) - 1 > RATES_EQUAL
    against = any(abs(rate / pulse - 1) > RATES_AGREE for rate in evidence.values())
    if undecided or against or not least <= pulse <= most:
        says = {**rates, **evidence}
        text = ", ".join(f"{rate:.4g} arcsec/s ({name})" for name, rate in says.items())
        said: dict[str, Any] = {"run": run.number, "rates": text, "agree": RATES_AGREE, "most": PULSE_MAX}
        possible = [item for item in says.items() if least <= item[1] <= most]
        answers = [] if possible else answers
        raise asked("pulse-rates", file, line=run.line, each=possible, answers=answers, least=PULSE_MIN, **said)
    text = "".join(f"; {name}: {rate:.4g}, {100 * (rate / pulse - 1):+.0f} %" for name, rate in evidence.items())
    return pulse, f"pulses turn the axis by {pulse:.4g} arcsec/s: {near}{text}; --assume pulse_arcsec_per_s="


# --- a run as readings -----------------------------------------------------------------------------------------------
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
    known, is_maxim = {**DRIVEN, **run.header, **stated}, run.program == "MaxIm"
    _check_known(run, known, file)
    cosine, drive = math.cos(math.radians(known["declination_deg"])), known["drive_arcsec_per_s"]
    pulse, text = known.get("pulse_arcsec_per_s", 0.0), "no corrections: the star's way is the axis' own"
    if "pulse_arcsec_per_s" in stated:
        text = f"pulses turn the axis by {pulse:g} arcsec/s, as stated"
    elif any(row.pulse_ms for row in run.rows):
        pulse, text = _logged_pulse(run, runs, known, file)
    scale = f"declination {known['declination_deg']:g} deg: distances on the sky over {cosine:.4f}"
    assumed = [
        f"{scale}; --assume declination_deg=",
        f"pixel scale {known['pixel_arcsec']:g} arcsec/px; --assume pixel_arcsec=",
        text,
        f"the drive turns at {drive:.6g} arcsec/s; --assume drive_arcsec_per_s=",
        *ASSUMED,
    ]
    sign = 1.0
    if is_maxim:
        sign = math.copysign(1.0, known["pe_sign"])
        which, where = "Y" if stated.get("ra_axis") == 2 else "X", "lags" if sign > 0 else "is ahead"
        assumed[-2:] = ["a correction acts after its frame: motion = offset - corrections of the frames before"]
        assumed.append(f"sign: where {which} grows the axis {where}; --assume pe_sign={-sign:g} says the other")
    points, pulses, is_new = list[tuple[float, float | None, str, bool]](), 0.0, True
    for row in run.rows:
        is_read, is_new = row.raw_px is not None and not row.settling, is_new or row.is_new
        pulses = 0.0 if is_read and is_new else pulses
        error = -sign * ((row.raw_px or 0.0) * known["pixel_arcsec"] / cosine + pulses) if is_read else None
        status = "ok" if is_read else "dropped" if row.raw_px is None else "settling"
        points.append((row.time_s, error, status, is_read and is_new))
        pulses, is_new = pulses + row.pulse_ms / 1000.0 * pulse, is_new and not is_read
    used = sum(error is not None for _, error, _, _ in points)
    if used < 3:
        raise refused("few-frames", file, line=run.line, count=used)
    header: dict[str, Any] = {"name": f"{file}, run {run.number}", "instrument": run.header["mount"][:200]}
    try:
        header["created"] = datetime.datetime.fromisoformat(run.begins)
    except ValueError:
        header["notes"] = f"begins {run.begins[:100]}"
    notes = _notes(run, used, sum(begins for *_, begins in points))
    return _drive_rows(drive, points, assumed, notes, header)


def _check_known(run: GuideRun, known: Mapping[str, Any], file: str) -> None:
    """Ask for numbers that nobody states, and refuse those of which no angle comes."""
    others = {name: n for name, n in run.counts.items() if name.startswith("rows of") and n >= len(run.frames)}
    if others:
        raise refused("other-device", file, line=run.line, rows=list(others), frames=len(run.frames))
    needed = {"pixel_arcsec": "the pixel scale", "declination_deg": "the declination"}
    if run.program == "MaxIm":
        needed |= {"pulse_arcsec_per_s": "the rate of a pulse"} if any(row.pulse_ms for row in run.rows) else {}
        needed |= {"ra_axis": "which of X and Y is right ascension"}
    if missing := [name for name in needed if name not in known]:
        numbers = tuple(w for name in missing if name != "ra_axis" for w in ("--assume", f"{name}=NUMBER"))
        axes = {f"{axis} is right ascension": ("--assume", f"ra_axis={k}") for k, axis in ((1, "X"), (2, "Y"))}
        ways = axes if "ra_axis" in missing else {"with your numbers": ()}
        answers = [Candidate(says, (*numbers, *words)) for says, words in ways.items()]
        values = " and ".join(needed[name] for name in missing)
        raise asked("missing-value", file, line=run.line, answers=answers, run=run.number, values=values)
    pixel, declination = known["pixel_arcsec"], known["declination_deg"]
    if not abs(declination) <= DECLINATION_MAX_DEG:
        raise refused("declination", file, line=run.line, declination=declination, most=DECLINATION_MAX_DEG)
    if not 0 < pixel <= PIXEL_MAX_ARCSEC:
        raise refused("pixel-scale", file, line=run.line, pixel=pixel, most=PIXEL_MAX_ARCSEC)
    ratios = [abs(1000 * (f.raw_px or 0.0) / f.pulse_ms) for f in run.frames if f.pulse_ms]
    most = median(ratios or [0.0]) * pixel / math.cos(math.radians(declination))
    # A guider corrects at most what it sees.
    if run.program == "MaxIm" and ratios and known["pulse_arcsec_per_s"] > (1 + RATES_AGREE) * most:
        raise asked("large-pulses", file, line=run.line, pulse=known["pulse_arcsec_per_s"], most=most)


def _notes(run: GuideRun, used: int, stretches: int) -> tuple[str, ...]:
    """Numbers of frames used and left out, and further remarks on a run, in words."""
    counts, frames = run.counts, run.frames
    out = [f"{sum(f.settling for f in frames)} while settling", f"{len(run.rows) - len(frames)} dropped"]
    out += [plural(n, name) for name in ("damaged row", "calibration step") if (n := counts[name])]
    out += [f"{n} {name}" for name, n in counts.items() if name.startswith("rows of")]
    breaks = [plural(counts["dither"], "dither")] + [plural(counts["pause"], "pause")] * (counts["pause"] > 0)
    own = f"{stretches} stretch{'es' * (stretches != 1)} with a zero of its own{' each' * (stretches > 1)}"
    step_s = median([b.time_s - a.time_s for a, b in pairwise(frames)] or [0.0])
    pulses_ms, limit_ms = [abs(frame.pulse_ms) for frame in frames], run.header.get("pulse_max_ms", 0.0)
    long_pulses, at_limit = sum(p > 1000.0 * step_s for p in pulses_ms), sum(p >= limit_ms > 0 for p in pulses_ms)
    remarks = {
        f"frames: {used} used of {len(run.rows)} ({', '.join(out)} left out); {own} ({', '.join(breaks)})": True,
        f"pier side {run.header['pier']}": True,
        "the log does not say that the run ended: it may be cut off": not counts["end"],
        f"{long_pulses} pulses last longer than the {step_s:.2g} s between frames and act in part later": long_pulses,
        f"{at_limit} pulses at their limit of {limit_ms:g} ms": at_limit,
        f"{plural(counts['saturated'], 'frame')} with a saturated star, used": counts["saturated"],
        f"{plural(counts['change'], 'change')} of the RA algorithm during the run": counts["change"],
    }
    return tuple(remark for remark, is_so in remarks.items() if is_so)


def _drive_rows(
    rate: float,
    points: Sequence[tuple[float, float | None, str, bool]],
    assumed: Sequence[str],
    notes: tuple[str, ...],
    header: Mapping[str, object],
    axis: Mapping[str, Any] | None = None,
) -> AxisRows:
    """An axis whose drive turns at a constant rate, by times, errors, statuses, and whether a stretch begins.

    Points before the first stretch belong to no move. An unknown period is from a minute to a third of the run, if any.
    """
    moves, readings = list[dict[str, Any]](), list[dict[str, Any]]()
    for time_s, error, status, begins in points:
        if begins:
            at = {"move": len(moves), "segment": len(moves), "time_s": time_s}
            moves.append({**at, "command": round(rate * time_s, 6), "approach": "forward"})
        if moves:
            value = None if error is None else round(rate * time_s + error, 4)
            reading = {"reading": len(readings), "move": len(moves) - 1, "value": value, "u": 0.0}
            readings.append({**reading, "status": status, "time_s": time_s})
    span_s = readings[-1]["time_s"] - readings[0]["time_s"]
    between = {"periods_in": "seconds", "period_between": [60.0, round(span_s / 3.0, 0)]} if span_s > 360.0 else {}
    entries = {**PRIORS, **(between if axis is None else axis)}
    return AxisRows(moves, readings, "arcsec", tuple(assumed), notes, {"rate": rate, **header}, entries)


# --- tables of time and periodic error -------------------------------------------------------------------------------
def _is_error(column: Column) -> bool:
    return column.numeric and place_of(column.name.words, "periodic-error") is not None


def is_periodic_error(text: str, table: ForeignTable) -> bool:
    """Whether a table holds times and a periodic error, and nothing that is commanded."""
    columns = columns_of(table).values()
    has_error = any(map(_is_error, columns))
    return _WORM.search(text) is not None or (has_error and not any(c.name.has("command") for c in columns))


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
    errors = [name for name, column in known.items() if _is_error(column)]
    clocks = {name for name, column in known.items() if column.name.unit and column.name.unit.kind == "time"}
    times = [n for n, column in known.items() if column.numeric and (n in clocks or column.name.has("time"))]
    if worm and not errors and len(known) == 3:
        times, _, errors = ([name] for name in known)
    if len(errors) != 1 or len(times) != 1:
        raise refused("periodic-error", table.file, line=table.first_line, times=len(times), errors=len(errors))
    clock, read = known[times[0]], known[errors[0]]
    for column, kind in ((clock, "time"), (read, "angle")):
        if column.name.unknown or (column.name.unit and column.name.unit.kind != kind):
            raise refused("error-unit", table.file, line=table.first_line, name=column.name.text, kind=kind)
    unit, scale_s = read.name.unit, clock.name.unit.scale if clock.name.unit else 1.0
    scale = 3600.0 * unit.scale * unit.per_number if unit else 1.0
    pairs = [
        (scale_s * float(t), scale * float(e))
        for t, e in zip(clock.cells, read.cells, strict=True)
        if NUMBER.fullmatch(t) and NUMBER.fullmatch(e)
    ]
    if len(pairs) < 3 or any(b[0] < a[0] for a, b in pairwise(pairs)):
        raise refused("few-errors", table.file, count=len(pairs))
    driven = {**DRIVEN, **stated}
    sign, rate = math.copysign(1.0, driven["pe_sign"]), driven["drive_arcsec_per_s"]
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
    points = [(time_s, sign * error, "ok", k == 0) for k, (time_s, error) in enumerate(pairs)]
    return _drive_rows(rate, points, assumed, notes, header, axis)
