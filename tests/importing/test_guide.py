"""A guide log of a known mount gives the motion of that mount; frames without tracking are left out and counted."""

from __future__ import annotations

import math

import numpy as np
import pytest
from importing.samples import MAXIM_PX_PER_ARCSEC, MAXIM_PX_PER_S, maxim_log, maxim_wave_arcsec

from tvsbayes.errors import InputError, Question
from tvsbayes.importing.guide import (
    SIDEREAL_ARCSEC_PER_S,
    periodic_error_rows,
    read_runs,
    rows_of_run,
)
from tvsbayes.importing.table import table_of

PIXEL, DECLINATION, CALIBRATED, RATE_PX = 2.0, 40.0, 10.0, 3.0
AXIS_RATE = RATE_PX * PIXEL / math.cos(math.radians(CALIBRATED))
"""Arcsec of the axis per second of pulse, where xRate is that of the calibration's declination."""
COSINE = math.cos(math.radians(DECLINATION))
HEADER = f"""Guiding Begins at 2026-01-02 21:00:00
Equipment Profile = test
Pixel scale = {PIXEL} arc-sec/px, Binning = 1, Focal length = 500 mm
Exposure = 2000 ms
Mount = Some Mount (ASCOM),  connected, guiding enabled, xAngle = 1.0, xRate = {RATE_PX}, yAngle = 2.0, yRate = 3.0
{{norm}}Max RA duration = 800, Max DEC duration = 2500, DEC guide mode = Auto
RA Guide Speed = 6.1 a-s/s, Dec Guide Speed = 7.5 a-s/s, Cal Dec = {CALIBRATED}, Last Cal Issue = None
RA = 20.34 hr, Dec = {DECLINATION} deg, Hour angle = -1.70 hr, Pier side = West, Rotator pos = N/A
Frame,Time,mount,dx,dy,RARawDistance,DECRawDistance,RAGuideDistance,DECGuideDistance,RADuration,RADirection,DECDuration,DECDirection,XStep,YStep,StarMass,SNR,ErrorCode
"""


def motion_of(time_s: float) -> float:
    """Of the star against an uncorrected axis, arcsec of the axis, positive to the west: the axis lags."""
    return 8.0 * math.sin(2 * math.pi * time_s / 480.0) + 0.01 * time_s


def night(frames: int = 300, events: dict[int, list[str]] | None = None, pulse_rate: float = AXIS_RATE, norm: str = ""):
    """A log of one run: a guider that corrects the mount of `motion_of`, with rows or INFO lines before some frames."""
    lines, pulsed, lock = [HEADER.format(norm=norm).rstrip("\n")], 0.0, 0.0
    for k in range(frames):
        for event in (events or {}).get(k, []):
            lines.append(event)
            if "DITHER by" in event:
                lock += float(event.split("by ")[1].split(",")[0])
        time_s = 3.0 * (k + 1) + 0.1 * (k % 3)
        raw = (motion_of(time_s) - pulsed) * COSINE / PIXEL - lock
        ms = min(round(abs(raw) * 120), 800)
        way = "" if not ms else "W" if raw > 0 else "E"
        lines.append(f'{k + 1},{time_s:.3f},"Mount",0,0,{raw:.4f},0,0,0,{ms},{way},0,,,,900,30.0,{int(k == 7)}')
        pulsed += math.copysign(ms / 1000.0 * pulse_rate, raw)
    return "\n".join([*lines, "Guiding Ends at 2026-01-02 21:30:00", ""])


def motions(series):
    """Driven angle less the axis' of the readings that are ok, arcsec, and their times."""
    ok = [reading for reading in series.readings if reading["status"] == "ok"]
    times = np.array([reading["time_s"] for reading in ok])
    return times, SIDEREAL_ARCSEC_PER_S * times - np.array([reading["value"] for reading in ok])


# Raw distances are written to 1e-4 px, values to 1e-4 arcsec; the summed pulses are whole ms and exact.
ROUNDED = 0.5e-4 * PIXEL / COSINE + 0.5e-4 + 1e-6


@pytest.mark.parametrize("ends", ["\n", "\r\n"])
def test_the_uncorrected_motion_is_that_of_the_mount(ends):
    """Pulses act after their frame, at a rate that is of the calibration's declination; distances are on the sky."""
    (run,) = read_runs("\n \n" + night().replace("\n", ends), "log.txt")
    series = rows_of_run(run, [], "log.txt", {})
    times, motion = motions(series)
    assert motion == pytest.approx([motion_of(t) for t in times], abs=ROUNDED)
    assert (series.unit, series.header["rate"], len(series.moves)) == ("arcsec", SIDEREAL_ARCSEC_PER_S, 1)
    assert series.moves[0]["command"] == pytest.approx(SIDEREAL_ARCSEC_PER_S * series.moves[0]["time_s"], abs=1e-6)
    assert series.axis["period_between"] == [60.0, round((times[-1] - times[0]) / 3)]
    assert series.header["created"].isoformat() == "2026-01-02T21:00:00"
    assert any("calibration's declination of 10 deg" in text for text in series.assumed)
    assert any("1 frame with a saturated star" in text for text in series.notes)


SETTLING = "INFO: SETTLING STATE CHANGE, Settling {}"
EVENTS = {
    0: [SETTLING.format("started")],
    3: [SETTLING.format("complete")],
    100: ["INFO: DITHER by 4.0, 0.0, new lock pos = 5, 2", SETTLING.format("started")],
    105: [SETTLING.format("complete")],
    150: ['998,451.5,"DROP",,,,,,,,,,,,,0,0.00,3,"Star lost - low mass"'],
    200: ["INFO: Server received PAUSE", "INFO: Server received RESUME"],
    250: ['999,751.5,"AO",0,0,1.0,0,0,0,500,W,0,,,,900,30.0,0', "1000,7", "INFO: Guiding parameter change, RA x = 1"],
}


def test_dithers_settling_drops_and_pauses_are_left_out_and_split_the_series():
    """Each stretch has a zero of its own, so also after a damaged row, whose pulse is unknown."""
    (run,) = read_runs(night(events=EVENTS), "log.txt")
    series = rows_of_run(run, [], "log.txt", {})
    assert [move["segment"] for move in series.moves] == [0, 1, 2, 3]
    counts = {"ok": 292, "settling": 5, "dropped": 1}
    assert {status: sum(r["status"] == status for r in series.readings) for status in counts} == counts
    assert series.notes[0] == (
        "frames: 292 used of 301 (8 while settling, 1 dropped, 1 damaged row, 1 rows of AO left out); "
        "4 stretches with a zero of its own each (1 dither, 1 pause)"
    )
    times, motion = motions(series)
    part = np.array([r["move"] for r in series.readings if r["status"] == "ok"])
    off = motion - np.array([motion_of(t) for t in times])
    for stretch in range(4):
        assert np.ptp(off[part == stretch]) < 2 * ROUNDED
    assert abs(off[part == 1][0] - off[part == 0][0]) > 1.0, "the dither's jump is a zero, no motion"
    begins = [move["time_s"] for move in series.moves]
    assert all(begins[r["move"]] <= r["time_s"] for r in series.readings)


@pytest.mark.parametrize(
    ("old", "new", "message", "remedy"),
    [
        ("Dec = 40.0 deg", "Dec = Unknown", "does not state the declination", "--assume declination_deg=NUMBER"),
        ("Pixel scale = 2.0", "Pixel scale = ?", "does not state the pixel scale", "--assume pixel_arcsec=NUMBER"),
        (", xRate = 3.0", "", "does not state xRate", "--assume pulse_arcsec_per_s=NUMBER"),
        ("xRate = 3.0", "xRate = 3,0", "does not state xRate", "--assume pulse_arcsec_per_s=NUMBER"),
        ("Dec = 40.0 deg", "Dec = 89.3 deg", "a declination of 89.3 deg", "nearer to the equator"),
        ("xRate = 3.0", "xRate = 0.003", "0.05 to 1.2 x sidereal", "--assume pulse_arcsec_per_s=6.1"),
    ],
)
def test_values_missing_in_the_log_are_asked_for(old, new, message, remedy):
    (run,) = read_runs(night(20).replace(old, new), "log.txt")
    with pytest.raises(InputError, match=message) as refused:
        rows_of_run(run, [], "log.txt", {})
    said = refused.value
    assert remedy in (said.asked_by(()) if isinstance(said, Question) else said).remedy


def test_adaptive_optics_have_a_rate_of_their_own_and_hide_the_axis():
    optics = "AO = Some AO, connected, guiding enabled, xAngle = 1.0, xRate = 152.1, yAngle = 2.0, yRate = 150.0\n"
    (run,) = read_runs(night().replace("Mount = Some", f"{optics}Mount = Some"), "log.txt")
    times, motion = motions(rows_of_run(run, [], "log.txt", {}))
    assert motion == pytest.approx([motion_of(t) for t in times], abs=ROUNDED)
    moved = "\n".join(line.replace("Mount", "AO") if k % 3 else line for k, line in enumerate(night().splitlines()))
    (run,) = read_runs(moved.replace("AO = Some", "Mount = Some"), "log.txt")
    with pytest.raises(InputError, match="rows of AO beside 100 frames of the mount"):
        rows_of_run(run, [], "log.txt", {})


@pytest.mark.parametrize(("head", "words"), [("Time (s),PE (px)", "PE"), ("Time (s),PE (zz)", "PE"), ("t (V),PE", "t")])
def test_a_periodic_error_in_no_angle_is_refused(head, words):
    names = head.split(",")
    rows = {names[0]: [str(k) for k in range(9)], names[1]: [f"{k % 4}.5" for k in range(9)]}
    table = table_of("pe.csv", "CSV", rows, range(1, 10))
    with pytest.raises(InputError, match=rf"in column {words}"):
        periodic_error_rows(table, "", {})


@pytest.mark.parametrize(
    ("log", "message"),
    [
        ("PHD2 version 2\n", "no run with frames"),
        ("Track Log Started at UT", "no run with frames"),
        (night(9).replace("RADuration", "Duration"), "no column RADuration"),
        (night(2), "2 frames"),
    ],
)
def test_logs_without_frames_are_refused(log, message):
    with pytest.raises(InputError, match=message):
        rows_of_run(read_runs(log, "log.txt")[0], [], "log.txt", {})


def test_a_track_log_of_maxim_gives_the_motion_of_its_mount():
    """Corrections are undone; px are written to 1e-2, so each reading is right to half of it and no sum of errors."""
    (run,) = read_runs(maxim_log(), "track.log", 1)
    pulse = MAXIM_PX_PER_S / MAXIM_PX_PER_ARCSEC
    stated = {"pixel_arcsec": 2.0, "declination_deg": 20.0, "pulse_arcsec_per_s": pulse, "ra_axis": 1.0}
    times, found = motions(rows_of_run(run, [run], "track.log", stated))
    expected = np.array([maxim_wave_arcsec(t) for t in times])
    assert (len(times), len(run.rows), times[-1]) == (199, 200, 796.0)
    assert np.abs(found - expected).max() < 0.5e-2 / MAXIM_PX_PER_ARCSEC + 1e-4
    reverse, _ = motions(rows_of_run(run, [run], "track.log", stated | {"pe_sign": -1.0}))[::-1]
    assert np.abs(reverse + expected).max() < 0.5e-2 / MAXIM_PX_PER_ARCSEC + 1e-4
    with pytest.raises(Question, match="correct more than the offsets"):
        rows_of_run(run, [run], "track.log", stated | {"pulse_arcsec_per_s": 2.5 * pulse})
    names, first, *others = maxim_log().split("\n", 2)
    (cut,) = read_runs("\n".join([names, first, others[0].replace("23:50:00", "23:5", 1)]), "track.log", 1)
    assert (len(cut.rows), cut.counts["damaged row"]) == (199, 1)
    (across,) = read_runs(maxim_log(), "track.log", 2)
    assert {frame.raw_px for frame in across.frames} == {0.1}


def test_a_rate_at_the_declination_of_the_run_is_recognised():
    """Later versions of the guider scale it, and state the rate at the equator beside it."""
    scaled = RATE_PX * PIXEL / COSINE
    norm = f'Norm rates RA = {scaled:.1f}"/s @ dec 0, Dec = 7.3"/s; ortho.err. = 8.7 deg\n'
    (run,) = read_runs(night(pulse_rate=scaled, norm=norm), "log.txt")
    series = rows_of_run(run, [], "log.txt", {})
    times, motion = motions(series)
    assert motion == pytest.approx([motion_of(t) for t in times], abs=ROUNDED)
    assert any("at the run's declination" in text and "guide speed: 6.1, -22 %" in text for text in series.assumed)
