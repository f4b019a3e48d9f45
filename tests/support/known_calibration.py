"""A calibration whose every parameter is known, with draws of what a test lets vary."""

from __future__ import annotations

import numpy as np

from tvsbayes.calibration.pointing import INPUT_NAMES, NOISE_NAMES, Calibration


def known_calibration(draws: int = 50, **changed: float) -> Calibration:
    """Draws that all hold the same rig: an ideal chain but for what is changed; stop errors without any scatter."""
    values = dict.fromkeys(INPUT_NAMES, 0.0)
    values |= {"degrees_per_step.pan": 0.06, "degrees_per_step.tilt": 0.07, "mirror_offset_mm": 30.0}
    values |= {"baseline_mm": 200.0, "pan_zero_emission_deg": 90.0, **{k: v for k, v in changed.items() if k in values}}
    noise = {name: changed.get(name, 0.0) for name in NOISE_NAMES}
    mean = np.array([values[name] for name in INPUT_NAMES])
    return Calibration(
        mean=mean,
        covariance=np.zeros((len(mean), len(mean))),
        noise_variance={name: sd**2 for name, sd in noise.items()},
        overshoot_steps={"pan": 10, "tilt": 10},
        range_steps=np.array([[-100.0, 300.0], [-60.0, 60.0]]),
        inputs=np.tile(mean, (draws, 1)),
        noise=np.tile([noise[name] for name in NOISE_NAMES], (draws, 1)),
    )
