"""Headers of fits on the processor of the board: a microcontroller sends what Python computes."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest
from support.bent_rig import calibration
from support.compensated import table
from support.emulated_board import BOARD, cross_compile
from support.firmware_sessions import NO_EMULATOR
from support.geared_rig import geared

from tvsbayes.calibration.c_header import calibration_header
from tvsbayes.compensation.correction import Correction
from tvsbayes.compensation.formats import FORMATS, Origin

pytestmark = pytest.mark.skipif(bool(NO_EMULATOR), reason=NO_EMULATOR)
ROUNDING = 1e-9
"""Relative, of the twelve digits of a table."""
AXIS = """
#include <stdio.h>
#include "fit.h"
int main() {
    double command; int side;
    while (scanf("%lf %d", &command, &side) == 2) printf("%.17g\\n", axis_sent(command, side));
    return 0;
}
"""
SCANNER = """
#include <stdio.h>
#include "fit.h"
int main() {
    double x, y, z; int left, up;
    while (scanf("%lf %lf %lf %d %d", &x, &y, &z, &left, &up) == 5) {
        struct tvs_steps s = {0, 0, 0, 0, 0, 0, 0};
        const double xyz[3] = {x, y, z};
        int found = tvs_steps_for_point(xyz, left, up, &s);
        printf("%d %ld %ld %ld %ld\\n", found, s.pan_steps, s.tilt_steps, s.via_pan_steps, s.via_tilt_steps);
    }
    return 0;
}
"""


def on_processor(folder: Path, header: str, program: str, lines: list[str]) -> list[str]:
    """What a program with a header prints on the emulated Cortex-M7; input and output by newlib's semihosting."""
    (folder / "fit.h").write_text(header)
    (folder / "fit.cpp").write_text(program)
    built = cross_compile(folder / "fit.elf", [folder / "fit.cpp"], "--specs=rdimon.specs")
    assert (built.returncode, built.stderr) == (0, ""), "no warning"
    hosted = ("-serial", "none", "-semihosting-config", "enable=on,target=native,arg=fit")
    command = [*BOARD, *hosted, "-kernel", str(folder / "fit.elf")]
    text = "\n".join(lines) + "\n"
    done = subprocess.run(command, input=text, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_the_table_of_an_axis(tmp_path):
    """On lines of the table, between them and beyond both ends."""
    commands = np.linspace(-25.0, 25.0, 41)
    wishes = [(float(c), side) for c in commands for side in (1, -1)]
    header = FORMATS["header"].write(table("header"), Origin("a fit", "0" * 64))
    answers = on_processor(tmp_path, header, AXIS, [f"{c!r} {side}" for c, side in wishes])
    command, side = np.array(wishes).T
    wanted = Correction.of(table("header")).sent(command, side)
    np.testing.assert_allclose(np.array(answers, dtype=float), wanted, rtol=ROUNDING, atol=ROUNDING)


def test_the_counters_of_a_scanner(tmp_path):
    """Also with gears that vary: the same whole counters, and those on the way."""
    one = geared(calibration())
    points = [(x, y, z) for x in (300.0, 1000.0) for y in (-100.0, 60.0) for z in (-40.0, 50.0)]
    wishes = [(*point, *sides) for point in points for sides in ((1, 1), (-1, -1), (1, -1))]
    answers = on_processor(tmp_path, calibration_header(one), SCANNER, [" ".join(map(repr, row)) for row in wishes])
    for (x, y, z, left, up), line in zip(wishes, answers, strict=True):
        s = one.steps_for((x, y, z), approach=("left" if left > 0 else "right", "up" if up > 0 else "down"))
        wanted = [2 if s.extrapolated else 1, s.pan_steps, s.tilt_steps, s.via_pan_steps, s.via_tilt_steps]
        assert list(map(int, line.split())) == wanted
