"""A small, complete campaign made by hand for the tests of the readers; mm, px, degrees as named."""

from __future__ import annotations

import datetime

import numpy as np
from support.written_rows import move_row, spot_row

from tvsbayes.instrument.campaign import Campaign, Spot
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import Prior
from tvsbayes.instrument.rig import RigTable
from tvsbayes.instrument.stereo_pair import Stereo, rotation_matrix


def small_stereo() -> Stereo:
    """A pair 85 mm apart, 1280 x 720 px, with a full covariance in which k3 of both cameras is fixed."""
    mixing = np.random.default_rng(5).normal(size=(24, 24)) * 0.1 + np.eye(24)
    scale = np.array([*([1.0] * 4 + [1e-3] * 5) * 2, *[1e-4] * 3, *[0.05] * 3])
    scale[[8, 17]] = 0.0
    covariance = mixing @ mixing.T * scale[:, None] * scale[None, :]
    return Stereo(
        image_width=1280,
        image_height=720,
        M1=np.array([[802.0, 0.0, 645.0], [0.0, 801.0, 355.0], [0.0, 0.0, 1.0]]),
        D1=np.array([-0.32, 0.11, 4e-4, -6e-4, -0.015]),
        M2=np.array([[798.0, 0.0, 633.0], [0.0, 799.0, 362.0], [0.0, 0.0, 1.0]]),
        D2=np.array([-0.31, 0.1, -3e-4, 5e-4, -0.012]),
        R=rotation_matrix(np.array([0.004, -0.006, 0.003])),
        T=np.array([-85.2, 0.3, -0.4]),
        parameter_covariance=(covariance + covariance.T) / 2,
        rms_px=0.21,
    )


def seen_steps(campaign: Campaign) -> np.ndarray:
    """Lowest and highest counter of each axis that a look saw, shape (2, 2)."""
    moves = [campaign.moves[spot.move] for spot in campaign.spots if spot.status == "ok"]
    counters = np.array([(m.pan_steps, m.tilt_steps) for m in moves], dtype=float)
    return np.stack([counters.min(axis=0), counters.max(axis=0)], axis=1)


def small_campaign() -> Campaign:
    """Five moves in two segments, eight spots (one undetected, one refused), every optional field used."""
    moves = (
        move_row(0, 0, 0.0, 0, 0, "left", "up"),
        move_row(1, 0, 1.5, 200, 0),
        move_row(2, 0, 3.0, 200, 120),
        move_row(3, 1, 60.25, 0, 0, "unknown", "down"),
        move_row(4, 1, 60.25, -100, -7),
    )
    sds = (0.08, 0.09, 0.1, 0.11)
    spots = [
        Spot(
            spot=10 + 2 * i,
            move=(0, 0, 1, 1, 2, 3, 4, 4)[i],
            target="d1" if i % 2 else "white sheet, 275 mm",
            experiment=3 if i < 4 else None,
            point=i + 1 if i < 4 else None,
            **dict(zip(("u_left_px", "v_left_px", "u_right_px", "v_right_px"), pixels, strict=True)),
            **dict(zip(("su_left_px", "sv_left_px", "su_right_px", "sv_right_px"), sds, strict=True)),
            aperture_deg=None if i == 2 else 50.0 + i / 3,
            ruv_left=0.25 if i == 1 else 0.0,
            ruv_right=-0.5,
        )
        for i, pixels in enumerate(np.random.default_rng(6).uniform(100.0, 700.0, (8, 4)).tolist())
    ]
    last = spots[7]
    spots[6] = spot_row(22, 4, "d1", None, None, *[None] * 8, status="undetected", ruv_right=-0.5)
    refused = {f: getattr(last, f) for f in Spot.__slots__} | {"status": "saturated, 41 px", "v_left_px": 1e4}
    spots[7] = Spot(**refused)
    priors = dict(TWO_MIRROR.priors)
    priors["mirror_offset_mm"] = Prior(31.0, 2.0)
    priors["stop_sd_deg.up"] = Prior(0.05, 0.0, "log-normal")
    priors["focal_scale"] = Prior(1.001, 0.001)
    header: dict[str, object] = {
        "name": 'Läufer "A" \\ 2',
        "created": datetime.datetime(2026, 1, 15, 10, 0, tzinfo=datetime.UTC),
        "synthetic": False,
        "seed": 7,
        "notes": "two lines,\nsecond line # no comment",
        "environment": {"temperature_degC": {"value": 21.0, "u": 0.5}},
        "traceability": {"board_certificate": "B-17", "stereo_calibrated": datetime.date(2026, 1, 3)},
    }
    return Campaign(moves, tuple(spots), small_stereo(), RigTable(priors, "azimuth"), header)
