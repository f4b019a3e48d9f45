"""Guide logs of PHD2: the motion of a mount's RA axis while it tracks a star, run by run.

A run lies between "Guiding Begins" and "Guiding Ends". Distances are pixels on the sky, durations ms, times s since the
beginning of the run. A pulse acts after its frame: the star's uncorrected motion is the raw distance plus the pulses of
all previous frames. Where the star is ahead of the mount, the axis lags: its angle is the drive's less the motion.
Angles of the axis, arcsec: those on the sky over cos(declination). No JAX.
"""

from __future__ import annotations

import csv
import datetime
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median
from typing import NamedTuple

from tvsbayes.errors import InputError, escaped, refusal
from tvsbayes.single_axis.axis_campaign import AxisMove, Reading
from tvsbayes.single_axis.foreign_readings import ForeignReadings, LoggedDrive

SIDEREAL_ARCSEC_PER_S = 1296000.0 / 86164.0905
"""A turn in a sidereal day (Explanatory Supplement to the Astronomical Almanac, 3rd edition, table 15.3)."""
BEGINS, ENDS = "Guiding Begins at ", "Guiding Ends"
NEEDED = ("Time", "RARawDistance", "RADuration", "RADirection")
DECLINATION_MAX_DEG = 85.0
"""Largest declination: above it 1 / cos(declination) magnifies the seeing beyond the errors of the axis."""
RATES_DIFFER = 0.1
"""Least relative difference of two rates of a pulse for a remark."""
PRIORS = {"per_command": (1.0, 1e-3), "transmission_error": (0.0, 10.0)}
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
}
"""Values that `--assume` may state, with their meaning."""
_NUMBER = r"(-?\d+(?:\.\d+)?)"
_HEADER = {
    "pixel_arcsec": re.compile(rf"^Pixel scale = {_NUMBER} arc-sec/px"),
    "exposure_ms": re.compile(rf"^Exposure = {_NUMBER} ms"),
    "rate_px_per_s": re.compile(rf"\bxRate = {_NUMBER}"),
    "at_equator": re.compile(rf"^Norm rates RA = {_NUMBER}"),
    "guide_speed": re.compile(rf"\bRA Guide Speed = {_NUMBER} a-s/s"),
    "calibration_deg": re.compile(rf"\bCal Dec = {_NUMBER}"),
    "declination_deg": re.compile(rf"^(?:RA = [^,]*, *)?Dec = {_NUMBER} deg"),
    "pulse_max_ms": re.compile(rf"\bMax RA duration = {_NUMBER}"),
}
_MOUNT, _PIER = re.compile(r"^Mount = ([^,]*)"), re.compile(r"\bPier side = (\w+)")


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

    @property
    def minutes(self) -> float:
        """Time from the first frame to the last."""
        return (self.frames[-1].time_s - self.frames[0].time_s) / 60.0 if self.frames else 0.0

    @property
    def settling(self) -> int:
        """Number of frames while the mount settled."""
        return sum(frame.settling for frame in self.frames)


def is_guide_log(text: str) -> bool:
    """Whether a text is a log of PHD2."""
    return BEGINS in text or text.startswith("PHD2 version")


def read_runs(text: str, file: str) -> list[GuideRun]:
    """The runs of a log, without runs that have no frame.

    Raises:
        InputError: no run, or a table of frames without a required column.
    """
    runs: list[GuideRun] = []
    run: GuideRun | None = None
    columns: list[str] | None = None
    settling, calibrating, calibration_steps = False, False, 0
    for number, text_line in enumerate(text.splitlines(), start=1):
        line = text_line.strip()
        if line.startswith(BEGINS):
            run, columns, settling, calibrating = (
                GuideRun(len(runs) + 1, number, line[len(BEGINS) :]),
                None,
                False,
                False,
            )
            run.counts["calibration step"], calibration_steps = calibration_steps, 0
            runs.append(run)
        elif line.startswith("Calibration Begins at"):
            calibrating, run = True, None
        elif calibrating:
            calibration_steps += line.startswith(("West,", "East,", "North,", "South,", "Backlash,"))
        elif run is None or not line:
            continue
        elif line.startswith(ENDS):
            run.ended, run = True, None
        elif line.startswith("INFO:"):
            settling = _event(run, line, settling)
        elif line.startswith("Frame,"):
            columns = line.split(",")
            if missing := [name for name in NEEDED if name not in columns]:
                found, remedy = f"no column {', '.join(missing)}", "export the log of the guider unchanged"
                raise refusal("csv", file=file, line=number, found=found, allowed=", ".join(NEEDED), remedy=remedy)
        elif columns is None:
            _header(run, line)
        else:
            _frame(run, number, line, columns, settling)
    runs_kept = [run for run in runs if run.frames]
    for k, run in enumerate(runs_kept, start=1):
        run.number = k
    if not runs_kept:
        found, remedy = "no run with frames", "give a log that holds guiding, not only calibration"
        raise refusal("empty", file=file, found=found, allowed=f'frames after "{BEGINS.strip()}"', remedy=remedy)
    return runs_kept


def _header(run: GuideRun, line: str) -> None:
    for name, pattern in _HEADER.items():
        if (match := pattern.search(line)) and name not in run.header:
            run.header[name] = float(match[1])
    if match := _MOUNT.search(line):
        run.mount = match[1].strip()
    if match := _PIER.search(line):
        run.pier = match[1]


def _event(run: GuideRun, line: str, settling: bool) -> bool:
    """Apply an INFO line to the run; return whether the mount settles from here on."""
    if "Settling started" in line:
        run.breaks.add(len(run.frames))
        return True
    if "Settling complete" in line or "Settling failed" in line:
        run.breaks.add(len(run.frames))
        return False
    if "DITHER by" in line or "SET LOCK POSITION" in line or "LOCK SHIFT" in line:
        run.counts["dither"] += "DITHER by" in line
        run.breaks.add(len(run.frames))
    elif "received RESUME" in line or "Resumed" in line:
        run.counts["pause"] += 1
        run.breaks.add(len(run.frames))
    elif "Guiding parameter change" in line and " RA " in line:
        run.counts["change of the RA algorithm"] += 1
    return settling


def _frame(run: GuideRun, number: int, line: str, columns: Sequence[str], settling: bool) -> None:
    """Add a row of the table to the run; a truncated row, or one of another device, is only counted."""
    try:
        cells = dict(zip(columns, next(csv.reader([line])), strict=False))
        time_s, device = float(cells["Time"]), cells.get("mount", "Mount")
        last = max((run.frames[-1].time_s if run.frames else 0.0, run.dropped_s[-1] if run.dropped_s else 0.0))
        if time_s < last or not math.isfinite(time_s):
            run.counts["damaged row"] += 1
        elif device == "DROP" or cells["RARawDistance"] == "":
            run.dropped_s.append(time_s)
        elif device != "Mount":
            run.counts[f"rows of {escaped(device, 12)}"] += 1
        else:
            raw, pulse_ms = float(cells["RARawDistance"]), float(cells["RADuration"] or 0)
            sign = {"W": 1.0, "E": -1.0, "": 0.0}[cells["RADirection"].strip()[:1].upper()]
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


@dataclass(frozen=True)
class _Scale:
    """Conversion of a log to angles of the axis, and its sources in words."""

    pixel_arcsec: float
    cos_declination: float
    pulse_arcsec_per_s: float
    drive_arcsec_per_s: float
    assumed: tuple[str, ...]


def _scale(run: GuideRun, stated: Mapping[str, float], file: str) -> _Scale:
    """The conversion of a run.

    Raises:
        InputError: a number that the log does not state, with the option that states it.
    """
    known = {**run.header, **stated}

    def need(name: str, words: str, option: str = "") -> float:
        if name in known:
            return known[name]
        found, remedy = f"run {run.number} does not state {words}", f"state it: --assume {option or name}=NUMBER"
        raise refusal("missing-value", file=file, line=run.line, found=found, allowed="a number", remedy=remedy)

    pixel, declination = need("pixel_arcsec", "the pixel scale"), need("declination_deg", "the declination")
    if not abs(declination) <= DECLINATION_MAX_DEG:
        found, allowed = f"a declination of {declination:g} deg", f"at most {DECLINATION_MAX_DEG:g} deg"
        remedy = "take a run on a star nearer to the equator; or is another one right: --assume declination_deg=NUMBER"
        raise refusal("range", file=file, line=run.line, found=found, allowed=allowed, remedy=remedy)
    if not pixel > 0:
        raise InputError("usage", "--assume pixel_arcsec: allowed: above 0", remedy="state arcsec per pixel")
    cosine = math.cos(math.radians(declination))
    assumed = [f"declination {declination:g} deg: distances on the sky over {cosine:.4f}; --assume declination_deg="]
    assumed.append(f"pixel scale {pixel:g} arcsec/px; --assume pixel_arcsec=")
    if "pulse_arcsec_per_s" in stated:
        pulse = stated["pulse_arcsec_per_s"]
        assumed.append(f"pulses turn the axis by {pulse:g} arcsec/s, as stated")
    else:
        pulse = _logged_pulse(known, need("rate_px_per_s", "xRate", "pulse_arcsec_per_s") * pixel, cosine, assumed)
    drive = stated.get("drive_arcsec_per_s", SIDEREAL_ARCSEC_PER_S)
    assumed.append(f"the drive turns at {drive:.6g} arcsec/s; --assume drive_arcsec_per_s=")
    return _Scale(pixel, cosine, pulse, drive, tuple(assumed))


def _logged_pulse(known: Mapping[str, float], x_rate: float, cosine: float, assumed: list[str]) -> float:
    """Rate of the axis during a pulse, arcsec/s: xRate is that at the run's declination or at the calibration's.

    Args:
        known: numbers of the header.
        x_rate: xRate times pixel scale, arcsec/s.
        cosine: cosine of the declination.
        assumed: sentences, to which the source is added.
    """
    calibration = known.get("calibration_deg")
    rate_of_run, source = x_rate / cosine, "at the run's declination"
    pulse = rate_of_run
    if calibration is not None and abs(calibration) < 90:
        rate_of_calibration = x_rate / math.cos(math.radians(calibration))
        rate_at_equator = known.get("at_equator")
        if rate_at_equator is None or abs(rate_of_calibration - rate_at_equator) < abs(rate_of_run - rate_at_equator):
            pulse, source = rate_of_calibration, f"at the calibration's declination of {calibration:g} deg"
    text = f"pulses turn the axis by {pulse:.4g} arcsec/s: xRate {x_rate:.4g} arcsec/s on the sky, taken {source}"
    if (speed := known.get("guide_speed")) and abs(pulse / speed - 1) > RATES_DIFFER:
        text += f"; the mount's guide speed is {speed:g}, {100 * (speed / pulse - 1):+.0f} %"
    assumed.append(f"{text}; --assume pulse_arcsec_per_s=")
    return pulse


def readings_of_run(run: GuideRun, file: str, stated: Mapping[str, float]) -> ForeignReadings:
    """A run as moves and readings: the drive's angle less the star's uncorrected motion, both in arcsec of the axis.

    Args:
        run: a run of the log.
        file: its name.
        stated: numbers by the names of `ASSUMPTIONS`, which override those of the log.

    Raises:
        InputError: a number that neither `stated` nor the log contains, or fewer than three usable frames.
    """
    scale = _scale(run, stated, file)
    moves: list[AxisMove] = []
    frames: list[tuple[float, int, float | None, str]] = []
    pulse_sum, needs_move = 0.0, True
    for k, (_, time_s, raw, pulse_ms, settling) in enumerate(run.frames):
        needs_move = needs_move or k in run.breaks
        status, value = "settling" if settling else "ok", None
        if not settling:
            if needs_move:
                command = round(scale.drive_arcsec_per_s * time_s, 6)
                moves.append(AxisMove(len(moves), len(moves), time_s, command, "forward"))
                pulse_sum, needs_move = 0.0, False
            motion = raw * scale.pixel_arcsec / scale.cos_declination + pulse_sum
            value = scale.drive_arcsec_per_s * time_s - motion
        frames.append((time_s, len(moves) - 1, value, status))
        pulse_sum += pulse_ms / 1000.0 * scale.pulse_arcsec_per_s
    used = sum(value is not None for _, _, value, _ in frames)
    if used < 3:
        remedy = "name another run with --run"
        raise refusal("empty", file=file, line=run.line, found=f"{used} frames", allowed="three or more", remedy=remedy)
    # Frames before the first stretch belong to no move.
    frames += [(time_s, -1, None, "dropped") for time_s in run.dropped_s]
    starts_s = [move.time_s for move in moves]
    rows = [
        (time_s, max(0, sum(start_s <= time_s for start_s in starts_s) - 1) if move < 0 else move, value, status)
        for time_s, move, value, status in sorted(frames, key=lambda row: row[0])
        if time_s >= starts_s[0]
    ]
    readings = tuple(
        Reading(k, move, None if value is None else round(value, 4), 0.0, status, time_s)
        for k, (time_s, move, value, status) in enumerate(rows)
    )
    between = _between([time_s for time_s, *_ in rows])
    drive = LoggedDrive(scale.drive_arcsec_per_s, _header_of(run, file), between, PRIORS)
    notes = (_frames_text(run, used, len(moves)), *_remarks(run))
    return ForeignReadings(tuple(moves), readings, (*scale.assumed, *ASSUMED), "arcsec", drive, notes)


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


def _remarks(run: GuideRun) -> list[str]:
    """Further remarks on a run."""
    remarks = [f"pier side {run.pier}"]
    if not run.ended:
        remarks.append("the log does not say that the run ended: it may be cut off")
    times = [frame.time_s for frame in run.frames]
    step = median([b - a for a, b in pairwise(times)] or [0.0])
    pulses = [abs(frame.pulse_ms) for frame in run.frames]
    if long_pulses := sum(p > 1000.0 * step for p in pulses):
        remarks.append(f"{long_pulses} pulses last longer than the {step:.2g} s between frames and act in part later")
    if (limit_ms := run.header.get("pulse_max_ms")) and (at_limit := sum(p >= limit_ms for p in pulses)):
        remarks.append(f"{at_limit} pulses at their limit of {limit_ms:g} ms")
    if n := run.counts["frame with a saturated star"]:
        remarks.append(f"{n} frame{'s' * (n > 1)} with a saturated star, used")
    if n := run.counts["change of the RA algorithm"]:
        remarks.append(f"{n} change{'s' * (n > 1)} of the RA algorithm during the run")
    return remarks


def _header_of(run: GuideRun, file: str) -> dict[str, object]:
    header: dict[str, object] = {"name": f"{file}, run {run.number}", "instrument": run.mount[:200]}
    try:
        header["created"] = datetime.datetime.fromisoformat(run.begins)
    except ValueError:
        header["notes"] = f"begins {run.begins[:100]}"
    return header


def _between(times_s: Sequence[float]) -> tuple[float, float] | None:
    """Range of periods, s, for a search: from a minute to a third of the run; None for a short run."""
    span_s = times_s[-1] - times_s[0]
    return (60.0, round(span_s / 3.0, 0)) if span_s > 360.0 else None
