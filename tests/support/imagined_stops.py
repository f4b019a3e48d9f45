"""Stops of a pan axis whose mirrors stand where a test puts them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from support.known_calibration import known_calibration
from support.partial_arrays import no_gears
from support.small_campaign import small_campaign
from support.written_rows import move_row, spot_row

from tvsbayes.calibration.pointing import INPUT_NAMES
from tvsbayes.estimators.linear_spots import Linearised

STOPS = 27


def linearised(residual: np.ndarray, slope: np.ndarray, angles: np.ndarray) -> Linearised:
    """A linearised campaign of these spots; what stop readings do not need is 0."""
    spots, count = len(residual), len(INPUT_NAMES)
    shapes = {
        "play_sd_rad": (2,),
        "predicted": (5,),
        "stop_variance": (2,),
        "zero_variance": (2,),
        "scatter_variance": (2,),
    }
    shapes |= {"place_columns": (4, 0)}
    shapes |= {"residual_jacobian": (4, count), "predicted_jacobian": (5, count)}
    arrays = {
        "z": np.zeros(count),
        "place_root": np.zeros((0, 0)),
        "residual": residual,
        "slope": slope,
        "mirror_angles_rad": angles,
    }
    arrays |= {name: np.zeros((spots, *shape)) for name, shape in shapes.items()}
    return Linearised(**arrays)


def stops_of(offsets_deg: np.ndarray, looks: int = 2, noise: float = 0.0) -> SimpleNamespace:
    """What `stop_readings` reads of a fit: a pan axis driven 0, 100, 200 up and down, at every stop `looks` looks.

    The mirrors stand `offsets_deg` off what counters and play predict; whitened residuals follow linearly.
    """
    calibration = known_calibration(**{"backlash_deg.pan": 0.3})
    counters = [n for _ in range(4) for n in (0, 100, 200, 300, 200, 100)]
    moves = [move_row(0, 0, 0.0, -100, 0, "left", "up")]
    moves += [move_row(k + 1, 0, float(k), n, 0) for k, n in enumerate(counters)]
    # Steps too short to take up the play of 5 steps, at the end: only together they do.
    moves += [move_row(len(moves) + k, 0, 99.0, n, 0) for k, n in enumerate((102, 104, 106))]
    rng = np.random.default_rng(8)
    spots, rows = [], []
    for move in moves[1:]:
        for _ in range(looks):
            spots.append(spot_row(len(spots), move.move, "d1", None, None, *[1.0] * 8))
            rows.append(move.move)
    off = np.radians(offsets_deg)[np.array(rows) - 1]
    slope = rng.normal(size=(len(rows), 4, 2)) * 1e3
    tilt_error = rng.normal(size=len(rows)) * 1e-3
    residual = np.einsum("nki,ni->nk", slope, np.stack([off, tilt_error], axis=1))
    residual += noise * rng.normal(size=residual.shape)
    # The fit has left this spot out, and rightly.
    residual[0] += 1e3
    sense = np.sign(np.diff([m.pan_steps for m in moves]))[np.array(rows) - 1]
    predicted = np.array([moves[r].pan_steps for r in rows]) * 0.06 - 0.15 * sense
    angles = np.radians(np.stack([predicted, np.zeros(len(rows))], axis=1))
    campaign = replace(small_campaign(), moves=tuple(moves), spots=tuple(spots))
    return SimpleNamespace(
        names=INPUT_NAMES,
        mode=SimpleNamespace(physical=calibration.mean, place_errors_rad=np.zeros(0)),
        values=dict(zip(INPUT_NAMES, calibration.mean.tolist(), strict=True)),
        campaign=campaign,
        information=SimpleNamespace(place_mean=np.zeros(0)),
        linearised=linearised(residual, slope, angles),
        arrays=SimpleNamespace(used=np.arange(len(rows)) > 0, gears=no_gears(len(rows))),
        reference_pose_rad=np.zeros(2),
    )
