"""Rigs drawn from a calibration's stored draws, each with the noises of one look. NumPy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tvsbayes.calibration.optics import Number
from tvsbayes.calibration.pointing import APERTURE, INPUT_NAMES, NOISE_NAMES, NOISES, STOPS, Calibration, Counters
from tvsbayes.errors import InputError
from tvsbayes.instrument.axes import SIDES
from tvsbayes.statistics.streams import Stream, random_stream


@dataclass(frozen=True)
class Drawn:
    """Drawn rigs, each with the unit noises of one look.

    Attributes:
        inputs: draws of `INPUT_NAMES`, then `NOISE_NAMES`, shape (draws, columns).
        gears: columns of the gears' errors, shape (draws, columns).
        noise: standard-normal stop errors (pan, tilt), uniform places in the play in [-1/2, 1/2] (pan, tilt), the
            aperture's standard-normal noise, shape (draws, `NOISES`).
    """

    inputs: np.ndarray
    gears: np.ndarray
    noise: np.ndarray

    def values_at(self, calibration: Calibration, steps: Counters) -> dict[str, Number]:
        """Return `look_inputs` and `NOISE_NAMES` by name at counters (n,), arrays (draws, 1) or (draws, n)."""
        names = (*calibration.names, *NOISE_NAMES)
        return {**dict(zip(names, self.inputs.T[..., None], strict=True)), **calibration.gears.at(self.gears, steps)}


def drawn(calibration: Calibration, draws: int, seed: int) -> Drawn:
    """Choose draws of parameters evenly, each with its own noises; the same for every point of a call.

    Raises:
        InputError: a calibration without draws.
    """
    stored = len(calibration.inputs)
    if stored == 0:
        raise InputError(
            "no-draws",
            "this calibration keeps moments only, as exported for a robot",
            remedy="locate from the campaign folder, or use calibration.locate, which needs no draws",
        )
    generator = random_stream(seed, Stream.LOOKS)
    # Fewer draws than stored are chosen evenly; for more, all are repeated with new noises.
    chosen = np.arange(draws) % stored if draws > stored else np.linspace(0, stored - 1, draws).astype(int)
    inputs, gears = np.split(calibration.inputs[chosen], [len(INPUT_NAMES)], axis=1)
    normal = generator.standard_normal((draws, NOISES))
    noise = np.column_stack([normal[:, STOPS], generator.uniform(-0.5, 0.5, (draws, 2)), normal[:, APERTURE]])
    return Drawn(np.concatenate([inputs, calibration.noise[chosen]], axis=1), gears, noise)


def noise_of_a_look(values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Compute sds by `NOISE_NAMES` (last axis): a single look at a stop has stop error and scatter of looks.

    A missing scatter of looks, as in results before 0.3.0, counts as zero.
    """
    variances = [values[name] for name in NOISE_NAMES]
    for axis, sides in SIDES.items():
        for side in sides:
            place = NOISE_NAMES.index(f"stop_sd_deg.{side}")
            variances[place] = np.hypot(variances[place], values.get(f"look_scatter_deg.{axis}", 0.0))
    return np.stack(variances, axis=-1)
