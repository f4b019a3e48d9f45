"""A table in LinuxCNC itself: the motor command has the correction of its side once."""

from __future__ import annotations

import numpy as np
import pytest
from support.compensated import table

from experiments.compensation.linuxcnc_loop import installed, motor_positions
from tvsbayes.compensation.correction import Correction
from tvsbayes.compensation.formats import FORMATS, Origin

PATH = [5.0, 17.0, 10.0, -5.0, 10.0]


@pytest.mark.slow
@pytest.mark.skipif(not installed(), reason="no linuxcnc: apt-get install --no-install-recommends linuxcnc-uspace")
def test_motor_command_has_the_correction_of_the_table():
    result = table("linuxcnc")
    text = FORMATS["linuxcnc"].write(result, Origin("a test", "0" * 64))
    wanted = Correction.of(result).sent(np.array(PATH), np.sign(np.diff([0.0, *PATH])))
    # The file has seven decimals, the pin six digits.
    np.testing.assert_allclose(motor_positions(PATH, text), wanted, atol=1e-4)
    np.testing.assert_allclose(motor_positions(PATH, text, backlash=0.5), wanted, atol=1e-4)
