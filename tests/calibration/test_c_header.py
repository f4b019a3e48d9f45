"""The C header backwards: counters for a point or a direction, as Python finds them."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from support.bent_rig import BENT, PERIODS_DEG, WOBBLE, calibration
from support.c_headers import answers_of_header, needs_compiler
from support.geared_rig import geared

from tvsbayes.calibration.aiming import Direction, Point, mirror_angles
from tvsbayes.calibration.c_header import calibration_header
from tvsbayes.errors import InputError
from tvsbayes.instrument.axes import SIDES

INVERSE = """
#include <stdio.h>
#define TVS_LIMIT_PAN_LOW -300
#define TVS_LIMIT_PAN_HIGH 420
#define TVS_LIMIT_TILT_LOW -200
#define TVS_LIMIT_TILT_HIGH 150
#include "tvs_calibration.h"
int main(void)
{
    double x, y, z, mirror[2];
    int kind, left, up;
    while (scanf("%d %lf %lf %lf %d %d", &kind, &x, &y, &z, &left, &up) == 6) {
        struct tvs_steps s = {0, 0, 0, 0, 0, 0, 0};
        const double xyz[3] = {x, y, z};
        int found = kind ? tvs_steps_for_point(xyz, left, up, &s) : tvs_steps_for_direction(x, y, left, up, &s);
        tvs_aim(kind ? xyz : (const double *)0, x, y, mirror);
        printf("%d %ld %ld %ld %ld %d %d %d %.17g %.17g %.17g\\n", found, s.pan_steps, s.tilt_steps, s.via_pan_steps,
               s.via_tilt_steps, s.pan_side, s.tilt_side, s.extrapolated, mirror[0], mirror[1], tvs_reading_deg(xyz));
    }
    return 0;
}
"""
INVERSE_LIMITS = {"pan": (-300.0, 420.0), "tilt": (-200.0, 150.0)}


def python_answer(one, kind: int, target: tuple[float, float, float], sides: tuple[int, int]) -> list[int]:
    """Counters, by way of which, sides and extrapolation, as the header returns them."""
    names = [
        {1: positive, -1: negative}.get(side) for side, (negative, positive) in zip(sides, SIDES.values(), strict=True)
    ]
    wish = {"xyz_mm": target} if kind else {"azimuth_deg": target[0], "elevation_deg": target[1]}
    # The header's 0 is the user's None, of each axis by itself.
    ways = [
        (pan, tilt)
        for pan in ([names[0]] if names[0] else ["left", "right"])
        for tilt in ([names[1]] if names[1] else ["up", "down"])
    ]
    for k, way in enumerate(ways):
        try:
            s = one.steps_for(**wish, approach=way, limits=INVERSE_LIMITS)
            break
        except InputError as error:
            if error.code != "outside-limits" or k == len(ways) - 1:
                return [{"out-of-reach": 0, "outside-limits": -1}[error.code]]
    signs = [1 if side in ("left", "up") else -1 for side in s.approach]
    counters = [s.pan_steps, s.tilt_steps, s.via_pan_steps, s.via_tilt_steps]
    return [2 if s.extrapolated else 1, *counters, *signs, int(s.extrapolated)]


@needs_compiler
@pytest.mark.parametrize(
    ("periods", "azimuth", "vary"), [({}, False, False), (PERIODS_DEG, True, False), ({}, False, True)]
)
def test_the_c_header_finds_the_same_counters(tmp_path, periods, azimuth, vary):
    """The way back: mirror angles to 1e-9 deg, the same whole counters, sides, limits and extrapolation."""
    one = calibration(BENT | (WOBBLE if periods else {}), period_deg=periods, azimuth=azimuth)
    one = replace(geared(one) if vary else one, range_steps=np.array([[-150.0, 250.0], [-90.0, 80.0]]))
    points = [(1, x, y, z) for x in (40.0, 300.0, 1000.0, 5000.0) for y in (-350.0, 20.0, 130.0) for z in (-60.0, 90.0)]
    points += [(1, -50.0, 0.0, 0.0), (1, 1e-3, 0.0, 900.0), (1, 600.0, 0.0, 0.0)]
    directions = [(0, a, e, 0.0) for a in (-89.0, -20.0, 3.0, 24.0) for e in (-9.0, 0.0, 5.0)] + [(0, 95.0, 0.0, 0.0)]
    requests = [(*target, *sides) for target in points + directions for sides in product((1, -1, 0), repeat=2)]
    answers = answers_of_header(tmp_path, calibration_header(one), INVERSE, requests)
    codes = set()
    for (kind, x, y, z, *sides), line in zip(requests, answers, strict=True):
        *numbers, pan_deg, tilt_deg, reading = line.split()
        wanted = python_answer(one, kind, (x, y, z), tuple(sides))
        assert list(map(int, numbers))[: len(wanted)] == wanted, (kind, x, y, z, sides)
        codes.add(wanted[0])
        if wanted[0]:
            target = Point(np.array([x, y, z])) if kind else Direction(x, y)
            angles = mirror_angles(one.estimates, target)
            np.testing.assert_allclose((float(pan_deg), float(tilt_deg)), angles, atol=1e-9)
        if kind and x > 0:
            assert float(reading) == pytest.approx(one.reading(np.array([x, y, z])), abs=1e-9)
    assert codes == {0, -1, 1, 2}
