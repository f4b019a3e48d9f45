"""Transmission error by position, on the page and in the text of a fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs
from support.bent_rig import calibration
from support.geared_rig import SD_DEG, geared
from support.small_results import estimate

from tvsbayes.report.evidence import gear_bands, gear_errors
from tvsbayes.report.fit_text import fit_text
from tvsbayes.report.scanner_sections import fit_sections, gear_section
from tvsbayes.results.estimates import StopResidual


@pytest.fixture(scope="module")
def bands():
    return gear_bands(geared(calibration()))


@pytest.fixture
def geared_evidence(evidence, bands):
    """The paper twin's, of gears that vary."""
    summary = evidence.fit.summary
    scales = ("transmission_error_deg", "transmission_error_length_deg", "play_variation_deg")
    parameters = {f"{name}.{axis}": estimate(0.031, 0.0042) for name in scales for axis in ("pan", "tilt")}
    changed = structs.replace(
        summary,
        parameters={**summary.parameters, **parameters},
        local={"left": estimate(0.0601, 1e-4), "right": None},
        range_steps={"pan": (-60, 280), "tilt": (-140, 140)},
    )
    return replace(evidence, gears=bands, fit=replace(evidence.fit, summary=changed))


def test_bands_are_those_of_the_draws(bands):
    """95 % of the errors at places without looks lie within 1.96 sds of waves of normal amplitude and random phase."""
    assert [band.axis for band in bands] == ["pan", "tilt"] and gear_bands(calibration()) == ()
    for band in bands:
        assert band.error_deg.shape == band.play_deg.shape == (3, len(band.steps))
        assert np.all(band.error_deg[0] < band.error_deg[1]) and np.all(band.error_deg[1] < band.error_deg[2])
        sd = SD_DEG[f"transmission_error_at_deg.{band.axis}"]
        inside = (band.steps > band.seen_steps[0] + 50) & (band.steps < band.seen_steps[1] - 50)
        width = np.ptp(band.error_deg[::2], axis=0)
        assert width[inside].mean() < 0.4 * width[[0, -1]].mean() and 2.5 * sd < width[[0, -1]].mean() < 5 * sd


def test_stops_lie_on_the_error(bands):
    band = bands[0]
    at = {"axis": "pan", "spots": (1,), "leg_steps": 9, "depth_mm": (1.0,), "within": (), "time_s": 0.0, "u_deg": 0.1}
    stops = [StopResidual(steps=120, direction=side, deviation_deg=off, **at) for side, off in (("left", 0.02),)]
    figure = gear_errors(band, stops)
    (line,) = [line for line in figure.axes[0].lines if line.get_label() == "stops, moving left"]
    expected = np.interp(120, band.steps, band.error_deg[1]) + 0.02
    assert line.get_xydata().tolist() == [[120.0, pytest.approx(expected)]]
    assert len(figure.axes) == 2 and figure.axes[1].get_ylabel() == "change of play, deg"
    # Play that hardly varies has no panel.
    assert len(gear_errors(replace(band, play_deg=1e-3 * band.play_deg), stops).axes) == 1


def test_the_section_states_scales_range_and_both_ratios(geared_evidence, evidence):
    section = gear_section(geared_evidence)
    titles = [[part.title for part in fit_sections(e)] for e in (replace(evidence, gears=()), geared_evidence)]
    assert section.title not in titles[0] and section.title in titles[1]
    assert "pan -60 to 280, tilt -140 to 140 steps" in section.text[0] and len(section.figures) == 2
    waves, scales, ratios = section.tables
    assert waves is None, "no period is stated"
    assert [row[0] for row in scales.rows[:2]] == [
        "transmission error sd, pan, deg",
        "transmission error sd, tilt, deg",
    ]
    assert scales.rows[0][1] == "0.0310(42)"
    cells = {row[0]: row[1] for row in ratios.rows}
    assert cells["left, local, deg/step"] == "0.06010(10)" and "left, line, deg/step" in cells
    assert cells["right, local, deg/step"] == "never moved"


def test_the_text_of_a_fit_summarises_the_section(geared_evidence):
    text = fit_text(geared_evidence.fit.summary, details=True)
    assert "gears: what repeats by position" in text and "pan -60 to 280, tilt -140 to 140 steps" in text
    assert "local ratios, without errors of the gears, deg/step: left 0.06010(10)" in text
