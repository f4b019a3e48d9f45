"""The noise of pixels: effect of demosaicing, and estimation from spots."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tvsbayes.cameras.spot_noise import _CORRELATION, grey_of, learn_noise


def test_noise_through_demosaicing_has_the_correlation_that_is_assumed():
    raw = np.clip(np.random.default_rng(1).normal(128, 12, (1000, 1000)), 0, 255).astype(np.uint8)
    grey = grey_of(cv2.cvtColor(raw, cv2.COLOR_BayerRGGB2BGR))[4:-4, 4:-4] - raw.mean()
    for i in range(3):
        for j in range(3):
            lag = np.mean(grey[i:, j:] * grey[: len(grey) - i, : len(grey) - j]) / raw.var()
            # A million pixels; the truth is 0.28 at lag 0 and sums to 1.
            assert lag == pytest.approx(_CORRELATION[2 + i, 2 + j], abs=0.003)


SHAPE = np.array([50.0, -20.0, 0.0, 100.0])
"""A beam's own skews, common to all looks, are no noise."""


def test_noise_is_estimated_from_skews_drawn_from_it():
    rng = np.random.default_rng(3)
    parts = np.column_stack((rng.uniform(1, 2, 400), rng.uniform(50, 200, 400), rng.uniform(5e3, 2e4, 400)))
    for gain, contrast in ((0.04, 0.0), (0.05, 0.4)):
        variance = parts @ [1.0, gain, contrast**2]
        skews = np.tile(SHAPE, 100) + rng.normal(0, np.sqrt(variance))
        learned = learn_noise(np.column_stack((skews, parts)).reshape(100, 4, 4))
        # 400 squares determine a variance to sqrt(2 / 400) = 7 %; its parts by gain and contrast^2 less.
        prediction = parts @ [1.0, learned.gain_dn, learned.speckle_contrast**2]
        assert prediction.mean() == pytest.approx(variance.mean(), rel=4 * np.sqrt(2 / 400))
        # A median of 100 values is known to 1.25 sds / 10; four of them.
        np.testing.assert_allclose(learned.skew, SHAPE, atol=4 * 0.125 * np.sqrt(variance.max()))
    assert learned.speckle_contrast == pytest.approx(0.4, rel=0.2)
    known = learn_noise(np.column_stack((skews, parts)).reshape(100, 4, 4), 0.3)
    assert known.speckle_contrast == pytest.approx(0.3)
