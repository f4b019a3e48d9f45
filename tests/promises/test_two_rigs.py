"""The two rigs of experiments/two_rigs.py: both machines read Table 1, and the weight of evidence is one."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

EXPERIMENTS = Path(__file__).resolve().parents[2] / "experiments"


@pytest.fixture(scope="module")
def study():
    """The script as a module; neither its folder nor its neighbours (one is called coverage) stay importable."""
    if not EXPERIMENTS.is_dir():
        pytest.skip("experiments/ is not part of an installed package")
    before = set(sys.modules)
    sys.path.insert(0, str(EXPERIMENTS))
    try:
        import two_rigs
    finally:
        sys.path.remove(str(EXPERIMENTS))
        for name in set(sys.modules) - before:
            if str(EXPERIMENTS) in str(getattr(sys.modules[name], "__file__", None)):
                del sys.modules[name]
    return two_rigs


@pytest.mark.parametrize("kind", ["lost motion", "literal"])
def test_both_machines_read_table_1(study, kind):
    """Solved by a shortcut on nominal sheets; here the whole twin runs, gears with play included, without noise."""
    from tvsbayes.twin.simulated_campaign import simulate

    rig = study.mounted_rig()
    truth, _ = study.solved(kind, rig, 0)
    still = {name: 0.0 for name in study.NOISE}
    truth = replace(truth, parameters={**truth.parameters, **still})
    campaign = simulate(rig, study.four_point_plan(4), 3, truth, home_approach=study.HOME_SIDES).campaign
    table = study.paper_values()
    # A homing is off by 0.05 deg (1 sd): as much azimuth at 26 deg scales a tilt by 0.04 %; five of these.
    for direction, ratios in study.classic_readings(campaign).items():
        assert ratios == pytest.approx(table[direction][1], rel=0.002)


def test_evidence_is_that_of_a_conjugate_gaussian(study):
    sd = 0.3
    for reading in (0.2, 1.7):
        mode = reading / (1 + sd**2)
        density = -0.5 * mode**2 + stats.norm.logpdf(reading, mode, sd)
        result = SimpleNamespace(log_density=density, covariance=np.array([[sd**2 / (1 + sd**2)]]))
        exact = stats.norm.logpdf(reading, 0.0, np.sqrt(1 + sd**2))
        assert study.log_evidence(result) == pytest.approx(exact, abs=1e-12)
