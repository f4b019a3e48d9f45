"""The centre of one spot: its covariance, refusals by name, effects of clipping and neighbours."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from support.drawn_spots import HEIGHT, WIDTH, oval, picture

from tvsbayes.cameras.spot_fit import find_spot
from tvsbayes.cameras.spot_noise import SpotNoise
from tvsbayes.cameras.spot_window import CLIPPED_DN, patch_around
from tvsbayes.twin.spot_pictures import Footprint, Scene, Sensor, render_spot

SMALL = 2.5**2 * np.eye(2)
HERE = np.array([150.3, 110.8])
THERE = np.array([210.3, 120.8])


@pytest.mark.parametrize("contrast", [0.0, 0.4])
def test_propagation_of_known_noise(contrast):
    """200 pictures with known noise: the test is of its propagation by the fit."""
    rng, scene, chi2 = np.random.default_rng(8), Scene(speckle_contrast=contrast), []
    for number in range(200):
        centre = np.array([40.0, 32.0]) + rng.uniform(-1, 1, 2)
        frame = render_spot(Footprint(centre, oval(rng, 2.0), 200.0), 80, 64, scene, Sensor(), (9, number, 0))
        spot = find_spot(frame, SpotNoise(Sensor().gain_dn_per_electron, contrast))
        chi2.append((spot.centre_px - centre) @ np.linalg.solve(spot.covariance_px2, spot.centre_px - centre))
    # 400 degrees of freedom: 1 / sqrt(800) of the sd; four of them, and 8 % for the small picture's background.
    assert abs(np.sqrt(np.sum(chi2) / 400) - 1) < 4 / np.sqrt(800) + 0.08


def lamp() -> np.ndarray:
    dark = picture(None)
    cv2.rectangle(dark, (100, 60), (180, 140), (230, 230, 230), -1)
    return dark


def window(frame: np.ndarray) -> np.ndarray:
    """A bright window that reaches in from the corner: 60 x 50 px of 320 x 240."""
    lit = frame.copy()
    lit[:50, :60] = 235
    return lit


def hot_pixel() -> np.ndarray:
    raw = np.full((HEIGHT, WIDTH), 12, np.uint8)
    raw[100, 151] = 240
    return cv2.cvtColor(raw, cv2.COLOR_BayerRGGB2BGR)


REFUSED = {
    "no-spot": lambda: picture(None),
    "two-spots": lambda: picture(Footprint(HERE, SMALL, 180.0), Footprint(THERE, SMALL, 150.0)),
    "too-small": hot_pixel,
    "too-large": lamp,
    "lamp": lambda: window(picture(None)),
    "border": lambda: picture(Footprint(np.array([2.0, 100.0]), 4 * SMALL, 180.0)),
    "clipped": lambda: picture(Footprint(HERE, 2 * SMALL, 3000.0)),
    "misshapen": lambda: picture(Footprint(HERE, SMALL, 150.0), Footprint(HERE + np.array([7.0, 2.0]), SMALL, 60.0)),
    "elongated": lambda: picture(Footprint(HERE, np.diag([15.0**2, 2.0**2]), 180.0)),
}


@pytest.mark.parametrize("reason", REFUSED)
def test_every_refusal_has_its_name(reason):
    assert find_spot(REFUSED[reason]()).status == reason


def test_a_clipped_core_is_normal_and_a_larger_one_widens_the_sd():
    sds = []
    for peak in (240.0, 400.0, 700.0):
        spot = find_spot(picture(Footprint(HERE, SMALL, peak)), SpotNoise(0.04, 0.4))
        assert spot.status == "ok"
        sds.append(np.sqrt(np.trace(spot.covariance_px2)) * np.sqrt(peak))
    assert sds[0] < sds[1] < sds[2]


def test_neighbours_of_clipped_pixels_are_not_used():
    """Demosaicing has mixed a clipped photosite into each of its eight neighbours."""
    frame = picture(Footprint(HERE, SMALL, 400.0))
    patch = patch_around(frame)
    rows, columns = np.nonzero((frame >= CLIPPED_DN).any(axis=2))
    assert len(rows) > 3
    away = np.ones((HEIGHT, WIDTH), bool)
    for row, column in zip(rows, columns, strict=True):
        away[row - 1 : row + 2, column - 1 : column + 2] = False
    left, top = patch.corner
    height, width = patch.usable.shape
    np.testing.assert_array_equal(patch.usable, away[top : top + height, left : left + width])


def test_correlation_follows_a_turned_spot():
    """A long spot at 45 degrees is less certain along its axis: errors in u and v are correlated."""
    turned = np.array([[20.0, 14.0], [14.0, 20.0]])
    for sign in (1, -1):
        cov = find_spot(
            picture(Footprint(HERE, turned * [[1, sign], [sign, 1]], 180.0)), SpotNoise(0.04, 0)
        ).covariance_px2
        # Against even noise a Gaussian's centre has the correlation of the Gaussian, 14 / 20; demosaicing, which mixes
        # neighbours, changes it by less than a tenth.
        assert sign * cov[0, 1] / cov[0, 0] == pytest.approx(0.7, abs=0.1)


def beam(rng: np.random.Generator, white: int, gain_dn: float = 0.03) -> np.ndarray:
    """A direct beam on a monochrome sensor of 480 x 400 px: skewed, with a ring, shot noise and nothing else."""
    v, u = np.indices((400, 480))
    x, y = (u - 231.4) / 24.0, (v - 187.7) / 28.0
    light = 190 * np.exp(-(x**2 + y**2 + 0.4 * x * y) / 2) * (1 + 0.05 * (x**3 - 3 * x) / (1 + x**2) - 0.04 * y)
    light += 4 * np.exp(-((np.hypot(x, y) - 3) ** 2) / 0.1) + 1.5
    levels = np.clip(rng.normal(light, np.sqrt(gain_dn * light)), 0, 255) * (white / 255)
    return np.rint(np.repeat(levels[..., None], 3, axis=2)).astype(np.uint8 if white == 255 else np.uint16)


@pytest.mark.parametrize("white", (255, 4095, 65535))
def test_pixels_of_a_wide_beam_give_its_uncertainty(white):
    """Without truth: sixteen pictures of every fourth row and column agree within their sds, at any bit depth."""
    picture_of = beam(np.random.default_rng(white), white)
    centres, variances = [], []
    for row in range(4):
        for column in range(4):
            spot = find_spot(np.ascontiguousarray(picture_of[row::4, column::4]))
            assert spot.status == "ok"
            centres.append(4 * spot.centre_px + [column, row])
            variances.append(16 * np.diag(spot.covariance_px2))
    z = (np.array(centres) - np.mean(centres, axis=0)) / np.sqrt(variances)
    # 30 degrees of freedom: 1 / sqrt(60) of the root; four of them would be 0.52.
    assert 0.6 < np.sqrt(np.sum(z**2) / 30) < 1.4
    whole = find_spot(picture_of)
    # Four times the pixels each way; the whole has the centre of its parts.
    assert np.sqrt(np.mean(variances) / np.trace(whole.covariance_px2) * 2) == pytest.approx(4, rel=0.3)
    assert np.abs(whole.centre_px - np.mean(centres, axis=0)).max() < 0.05


@pytest.mark.parametrize("shape", [(1, 1), (4, 40), (7, 9), (8, 8)])
def test_a_picture_too_small_for_a_spot_has_none(shape):
    assert find_spot(np.random.default_rng(0).integers(0, 255, (*shape, 3)).astype(np.uint8)).status == "no-spot"
