"""Targets: read, refused, and their sensitivities."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize, stats
from support.coarse_planning import with_priors

from tvsbayes.errors import InputError
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import Prior
from tvsbayes.planning.expectation import prior_knowledge
from tvsbayes.planning.target import NOISE_AT_POINT, STOP_AT_POINT, Target, parse_target, sensitivity
from tvsbayes.twin.physics import aperture_angle_deg, mirror_chain, to_tvs

pytestmark = pytest.mark.usefixtures("small_searches")


def test_targets_are_read():
    assert parse_target("u(left) <= 2e-4 deg/step") == Target("u(left) <= 2e-4 deg/step", "left", 2e-4, "deg/step")
    point = parse_target("  U95(x)  at 1000, 0,-2.5 mm <= 60 mm ")
    assert (point.quantity, point.point_mm, point.limit) == ("x", (1000.0, 0.0, -2.5), 60.0)
    assert point.factor == pytest.approx(1.96, abs=1e-3)
    assert parse_target("u(backlash.tilt)<=.05deg").unit == "deg"


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("left <= 2e-4", "not of that form"),
        ("u(left) < 2e-4 deg/step", "not of that form"),
        ("u(left) <= 2e-4 mm", "in deg/step, not mm"),
        ("u(leftt) <= 2e-4 deg/step", "no quantity leftt"),
        ("u(left) <= 0 deg/step", "the limit 0"),
        ("u(left) <= -1 deg/step", "the limit -1"),
        ("u(left) <= 1e999 deg/step", "the limit inf"),
        ("u(left) <= 1e-300 deg/step", "the limit 1e-300"),
        ("U95(x) at 1e999,0,0 mm <= 60 mm", "too far away"),
        ("U95(x) at 0,0,-2e9 mm <= 60 mm", "too far away"),
        ("U95(x) <= 60 mm", "name the point"),
        ("u(left) at 1,2,3 mm <= 2e-4 deg/step", "leave the point out"),
        ("u(left) <= nan deg/step", "not of that form"),
        ("u(left) <= \u0661 deg/step", "not of that form"),
        ("u(left) <= 1 deg/step" + " " * 500, "not of that form"),
        ("", "not of that form"),
    ],
)
def test_other_targets_are_refused_with_what_is_allowed(text, word):
    with pytest.raises(InputError) as refused:
        parse_target(text)
    assert word in refused.value.message
    assert "U95(NAME) <= NUMBER UNIT" in refused.value.allowed


def test_a_point_has_its_own_uncertainty(knowledge):
    """A perfect calibration keeps stop and reading: dx = d^2 / b times their angles, b = a - L between the lines."""
    target = parse_target("u(x) at 1000,0,0 mm <= 60 mm")
    at = sensitivity(target, knowledge.z, knowledge.space, knowledge.rig.table, np.zeros(2))
    base_mm, stop_rad, reading_rad = 200.0 - 30.0, math.radians(0.04), math.radians(0.02)
    from_beam_mm2, from_aperture_mm2 = 1000.0**2 + 70.0**2, 1000.0**2 + 100.0**2
    expected_mm = math.hypot(stop_rad * from_beam_mm2, reading_rad * from_aperture_mm2) / base_mm
    # The tilt's stop enters x to second order; small angles of the triangle are left out: (b / d)^2 = 3 %.
    assert at.value(np.zeros((len(TWO_MIRROR.names), len(TWO_MIRROR.names)))) == pytest.approx(expected_mm, rel=0.03)
    assert at.value(knowledge.covariance) > 10 * expected_mm


@pytest.mark.parametrize("convention", ["in-plane", "azimuth"])
def test_stops_and_reading_at_a_point_are_those_of_the_twins_optics(mounted_rig, convention):
    """Beam and aperture of the twin, each angle moved by its sd: x, y and z by finite differences, axis by axis."""
    point_mm = (900.0, 50.0, 250.0)
    stops = {f"stop_sd_deg.{d}": Prior(sd, 1.0, "log-normal") for d, sd in zip(DIRECTIONS, (3, 5, 4, 7), strict=True)}
    rig = with_priors(mounted_rig, **{name: replace(p, value=0.01 * p.value) for name, p in stops.items()})
    table = replace(rig.table, aperture_convention=convention)
    known = prior_knowledge(replace(rig, table=table))
    values = {name: prior.value for name, prior in table.priors.items()}
    base_mm, reading_deg = values["baseline_mm"], float(aperture_angle_deg(point_mm, 200.0, convention))

    def ray(angles_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        origin, direction = mirror_chain(*angles_rad, values)
        ends = to_tvs(np.stack([origin, origin + direction]), base_mm, values["pan_zero_emission_deg"])
        return ends[0], ends[1] - ends[0]

    def passes(angles_rad: np.ndarray) -> np.ndarray:
        origin, direction = ray(angles_rad)
        return np.cross(direction, np.array(point_mm) - origin)[1:]

    aimed = optimize.fsolve(passes, np.radians([0.0, 10.0]), xtol=1e-13)

    def seen_at(pan_deg: float, tilt_deg: float, aperture_deg: float) -> np.ndarray:
        """Where beam and reading meet, frame T, mm."""
        origin, direction = ray(aimed + np.radians([pan_deg, tilt_deg]))

        def excess_deg(reach_mm: float) -> float:
            angle = aperture_angle_deg(origin + reach_mm * direction, base_mm, convention)
            return float(angle) - reading_deg - aperture_deg

        return origin + optimize.brentq(excess_deg, 500.0, 2000.0, xtol=1e-10) * direction

    assert seen_at(0, 0, 0) == pytest.approx(point_mm, abs=1e-6)
    # Central differences: the step moves the point by 3e-4 of its distance, the third derivative by its square.
    step_deg = 0.01
    moved = np.array([(seen_at(*step) - seen_at(*-step)) / (2 * step_deg) for step in step_deg * np.eye(3)])
    # By default a point is reached left and up; a look there meets the scatter of looks besides the stop error, which
    # before any data is the median of its half-normal prior.
    scatter_deg = [table.priors[f"look_scatter_deg.{axis}"].u * stats.halfnorm.median() for axis in ("pan", "tilt")]
    stop_mm2 = moved[0] ** 2 * (0.03**2 + scatter_deg[0] ** 2) + moved[1] ** 2 * (0.04**2 + scatter_deg[1] ** 2)
    reading_mm2 = (moved[2] * values["aperture_sd_deg"]) ** 2
    target = parse_target("u(xyz) at 900,50,250 mm <= 1 mm")
    at = sensitivity(target, known.z, known.space, table, np.zeros(2))
    # The machine stands at whole counters, up to half a step beside the point.
    half_step_rad = math.radians(values["degrees_per_step.tilt"]) / 2
    for cause, variance_mm2 in zip((STOP_AT_POINT, NOISE_AT_POINT), (stop_mm2, reading_mm2), strict=True):
        assert at.own[cause] == pytest.approx(variance_mm2, abs=half_step_rad * variance_mm2.max()), cause
    assert (moved[1] * 0.04)[2] ** 2 > 0.1 * stop_mm2[2], "tilt counts, or it could be left out"
    # Tolerance of the loop above, the half step: without the scatter of looks it would be missed.
    without_mm2 = (moved[0] * 0.03) ** 2 + (moved[1] * 0.04) ** 2
    assert stop_mm2.max() - without_mm2.max() > half_step_rad * stop_mm2.max()
