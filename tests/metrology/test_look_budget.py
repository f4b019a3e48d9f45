"""The budget of one point: by cause and by parameter, it adds up to the covariance."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.bent_rig import calibration
from support.geared_rig import geared

from tvsbayes.calibration.optics import GEAR_INPUTS
from tvsbayes.calibration.pointing import INPUT_NAMES, NOISE_NAMES, Calibration
from tvsbayes.coordinates.location import locate_linear, settings_of
from tvsbayes.errors import InputError
from tvsbayes.metrology.look_budget import APERTURE_HERE, PLAY_HERE, STOP_HERE, Budget, budget, coordinate_budget


def test_coordinate_budgets_by_parameter():
    one = calibration()
    rng = np.random.default_rng(7)
    noises = (
        "stop error pan",
        "stop error tilt",
        "place in the play, pan",
        "place in the play, tilt",
        "aperture noise",
    )
    names = (*INPUT_NAMES, *noises)
    u = np.concatenate([np.sqrt(np.diag(one.covariance)), [1.0, 1.0, 12**-0.5, 12**-0.5, 1.0]])
    slope = rng.normal(size=(len(names), 3))
    contribution = slope * u[:, None]
    correlation = np.eye(len(names))
    correlation[0, 2] = correlation[2, 0] = 0.7
    covariance = contribution.T @ correlation @ contribution
    parts = rng.dirichlet(np.ones(5), 3).T * np.diag(covariance)
    causes = ("pixel noise", "prior of extrinsics", STOP_HERE, PLAY_HERE, APERTURE_HERE)
    share = parts.sum(axis=1) / parts.sum()
    whole = Budget(causes, share, parts, names, contribution, correlation, covariance, (0.0, 0.0))
    for index, component in enumerate("xyz"):
        table = coordinate_budget(whole, one, (1.0, 2.0, 3.0), component)
        assert (table.estimate, table.unit) == (float(index + 1), "mm")
        assert table.u == pytest.approx(math.sqrt(covariance[index, index]))
        assert sum(row.share for row in table.rows) == pytest.approx(1.0, abs=1e-9)
        # Two of the parameters are not independent.
        pair = 2 * 0.7 * contribution[0, index] * contribution[2, index] / covariance[index, index]
        assert table.rows[-1].share == pytest.approx(pair, abs=1e-9)
    rows = {row.quantity: row for row in coordinate_budget(whole, one, (1.0, 2.0, 3.0), "x").rows}
    for name, row in rows.items():
        if name in names:
            k = names.index(name)
            assert row.u == pytest.approx(u[k]) and row.sensitivity == pytest.approx(slope[k, 0])
            assert row.kind == ("A, B" if name in INPUT_NAMES else "A" if name.startswith("stop") else "B")
    with pytest.raises(ValueError, match="allowed"):
        coordinate_budget(whole, one, (1.0, 2.0, 3.0), "w")


ALGEBRA = 1e-9
"""Relative, of solving 65 equations whose information spans six decades."""


@pytest.fixture(scope="module")
def caused() -> Calibration:
    """Two causes that are not multiples of each other and add up to the covariance."""
    one = calibration()
    weights = np.random.default_rng(2).uniform(0.1, 0.9, len(INPUT_NAMES))
    variances, vectors = np.linalg.eigh(one.covariance)
    root = vectors * np.sqrt(np.clip(variances, 0.0, None))
    parts = np.stack([root * weights @ root.T, root * (1 - weights) @ root.T])
    return replace(one, causes=("pixel noise", "stereo calibration"), cause_covariance=parts)


POINT = (130.0, 90.0, 60.0, ("right", "unknown"))


def test_budget_adds_up_to_the_covariance(caused):
    whole = budget(caused, *POINT)
    law = locate_linear(caused, settings_of(*POINT))
    np.testing.assert_allclose(whole.covariance_mm2, law.covariance[0], rtol=ALGEBRA)
    np.testing.assert_allclose(whole.variance_mm2.sum(axis=0), np.diag(law.covariance[0]), rtol=ALGEBRA)
    assert whole.causes == ("pixel noise", "stereo calibration", STOP_HERE, PLAY_HERE, APERTURE_HERE)
    assert whole.share.sum() == pytest.approx(1.0, abs=1e-12) and np.all(whole.share > 0)
    np.testing.assert_allclose(whole.share, whole.variance_mm2.sum(axis=1) / np.trace(law.covariance[0]), rtol=ALGEBRA)
    # By parameter: contributions and correlations give the covariance back, GUM eq. 16.
    rebuilt = whole.contribution_mm.T @ whole.correlation @ whole.contribution_mm
    np.testing.assert_allclose(rebuilt, law.covariance[0], rtol=ALGEBRA)
    assert whole.parameters[: len(INPUT_NAMES)] == INPUT_NAMES
    assert whole.contribution_mm.shape == (len(whole.parameters), 3)
    document = whole.as_json()
    assert [c["cause"] for c in document["causes"]] == list(whole.causes)
    np.testing.assert_allclose([c["u_mm"] for c in document["causes"]], np.sqrt(whole.variance_mm2), rtol=1e-12)


def test_each_cause_of_a_budget_is_its_own_propagation(caused):
    """Without the others, through the law: parts of the calibration and of this look."""
    whole = budget(caused, *POINT)
    settled = dict.fromkeys(NOISE_NAMES, 1e-9)

    def alone(covariance: np.ndarray, noise_deg: dict[str, float], play: bool = False) -> np.ndarray:
        one = replace(caused, covariance=covariance, noise_variance={name: sd**2 for name, sd in noise_deg.items()})
        if not play:
            # A known side of half the play keeps the beam and loses its variance.
            one = replace(one, mean=np.where(np.array(INPUT_NAMES) == "backlash_deg.tilt", 0.0, one.mean))
        return np.diag(locate_linear(one, settings_of(*POINT)).covariance[0])

    nothing = np.zeros_like(caused.covariance)
    rms = {name: variance**0.5 for name, variance in caused.noise_variance.items()}
    stops = {name: sd for name, sd in rms.items() if name.startswith("stop")}
    np.testing.assert_allclose(whole.variance_mm2[2], alone(nothing, settled | stops), rtol=1e-6)
    np.testing.assert_allclose(whole.variance_mm2[3], alone(nothing, settled, play=True), rtol=1e-6)
    readings = settled | {"aperture_sd_deg": rms["aperture_sd_deg"]}
    np.testing.assert_allclose(whole.variance_mm2[4], alone(nothing, readings), rtol=1e-6)


def test_budgets_of_gears_that_vary_have_their_rows():
    """Causes and parameters add up at counters seen and beyond; u of the gears is the larger away from the looks."""
    one = geared(calibration(noise_spread=0.0))
    count, variances = len(INPUT_NAMES), np.linalg.eigh(one.covariance)
    root = variances.eigenvectors * np.sqrt(np.clip(variances.eigenvalues, 0.0, None))
    weights = np.where(np.arange(len(one.mean)) < len(one.mean) // 2, 0.3, 0.7)
    parts = np.stack([root * weights @ root.T, root * (1 - weights) @ root.T])
    one = replace(one, causes=("pixel noise", "transmission error"), cause_covariance=parts)
    known = []
    for pan, reading in ((130.0, 60.0), (-780.0, 100.0)):
        whole = budget(one, pan, 90.0, reading, ("left", "up"))
        law = one.locate(pan, 90.0, reading, ("left", "up")).covariance_mm2
        np.testing.assert_allclose(whole.variance_mm2.sum(axis=0), np.diag(law), rtol=1e-6)
        assert whole.causes[:2] == ("pixel noise", "transmission error")
        assert whole.parameters[count : count + 4] == GEAR_INPUTS
        rebuilt = whole.contribution_mm.T @ whole.correlation @ whole.contribution_mm
        np.testing.assert_allclose(rebuilt, law, rtol=1e-6)
        point = one.locate(pan, 90.0, reading).xyz_mm.tolist()
        rows = {row.quantity: row for row in coordinate_budget(whole, one, point, "y").rows}
        row = rows["transmission_error_at_deg.pan"]
        assert row.unit == "deg" and row.estimate == one.estimates_at((pan, 90.0))["transmission_error_at_deg.pan"]
        known.append(row.u)
    assert known[1] > 3 * known[0]


def test_a_budget_needs_causes_and_a_point(caused):
    with pytest.raises(ValueError, match="causes"):
        budget(calibration(), *POINT)
    with pytest.raises(InputError, match="diverge"):
        budget(caused, 130.0, 90.0, 179.0)
    # Past the cone of all points under this angle: a complex step must not find an imaginary range there.
    for call in (caused.locate, caused.derivatives, lambda *look: budget(caused, *look)):
        with pytest.raises(InputError) as caught:
            call(-500.0, 0.0, 0.1)
        assert caught.value.code == "grazing"
