"""Point clouds with error bars, computed from looks block by block, and points by simpler calibrations.

Frame T, mm. Standard uncertainties are by the law of propagation, validated for some points by draws. Memory does not
grow with the number of points. NumPy.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from tvsbayes.calibration.located_point import meets
from tvsbayes.calibration.pointing import Calibration
from tvsbayes.coordinates.location import Linear, Settings, joined, locate_linear, locate_settings
from tvsbayes.coordinates.simple_calibration import SimpleCalibration, assumed_geometry
from tvsbayes.errors import InputError

CHECKED_MAX = 200
"""Largest number of looks validated by draws."""


@dataclass(frozen=True)
class CloudBlock:
    """Points of one block of looks; arrays over the n existing points.

    Attributes:
        lines: lines in the file, shape (n,).
        xyz_mm: points, shape (n, 3).
        covariance_mm2: covariance by the law of propagation, shape (n, 3, 3).
        extrapolated: whether the counters are outside those of the campaign's looks, shape (n,).
        simple_xyz_mm: points by simpler calibrations, by name, shapes (n, 3); NaN where they have none.
        refused: lines of the other looks, and the reasons.
    """

    lines: np.ndarray
    xyz_mm: np.ndarray
    covariance_mm2: np.ndarray
    extrapolated: np.ndarray
    simple_xyz_mm: Mapping[str, np.ndarray]
    refused: tuple[tuple[int, InputError], ...]

    @property
    def sd_mm(self) -> np.ndarray:
        """Return the standard uncertainties of x, y, z, shape (n, 3)."""
        return np.sqrt(np.einsum("pii->pi", self.covariance_mm2))


def cloud(
    calibration: Calibration, looks: Iterable[Settings], simple: Mapping[str, SimpleCalibration]
) -> Iterator[CloudBlock]:
    """Compute points of looks, one block of points for each block of looks.

    Args:
        calibration: from `load_calibration` or `calibration_of`.
        looks: blocks of looks, such as from `looks_file.look_blocks`.
        simple: further calibrations by name, such as "nominal", from `simple_calibration`.

    Raises:
        InputError: a calibration without draws.
    """
    for settings in looks:
        linear = locate_linear(calibration, settings)
        meets = _meets(calibration, settings, linear)
        pan, tilt = settings.steps[meets].T
        reading = settings.aperture_deg[meets]
        yield CloudBlock(
            lines=settings.lines[meets],
            xyz_mm=linear.value[meets],
            covariance_mm2=linear.covariance[meets],
            extrapolated=~np.asarray(calibration.covers(pan, tilt)),
            simple_xyz_mm={
                name: assumed_geometry(one, pan, tilt).points(reading, calibration.azimuth).T
                for name, one in simple.items()
            },
            refused=tuple(
                (int(settings.lines[k]), _refusal(calibration, settings, k)) for k in np.flatnonzero(~meets).tolist()
            ),
        )


def _meets(calibration: Calibration, settings: Settings, linear: Linear) -> np.ndarray:
    """Mark looks with a point, shape (n,): those that `Calibration.locate` does not refuse."""
    pan, tilt = settings.steps.T
    pan_side, tilt_side = settings.side.T
    beam = calibration.beam_at((pan, tilt), (pan_side, tilt_side))
    origin, direction = (np.stack(np.broadcast_arrays(*vector), axis=-1) for vector in beam)
    reach = np.einsum("pi,pi->p", linear.value - origin, direction)
    return np.asarray(meets(reach, direction, linear.covariance))


def _refusal(calibration: Calibration, settings: Settings, row: int) -> InputError:
    pan, tilt = settings.steps[row].tolist()
    pan_side, tilt_side = settings.side[row].tolist()
    return calibration.refusal(pan, tilt, float(settings.aperture_deg[row]), (pan_side, tilt_side))


class EvenSample:
    """At most `CHECKED_MAX` looks, evenly spread over a stream of unknown length, which is passed through `of`."""

    def __init__(self) -> None:
        self.looks: Settings | None = None
        self._stride, self._passed = 1, 0

    def of(self, blocks: Iterable[Settings]) -> Iterator[Settings]:
        """Collect looks and pass the blocks on."""
        for rows in blocks:
            chosen = rows[-self._passed % self._stride :: self._stride]
            looks = chosen if self.looks is None else joined([self.looks, chosen])
            while len(looks) > CHECKED_MAX:
                looks, self._stride = looks[::2], 2 * self._stride
            self.looks, self._passed = looks, self._passed + len(rows)
            yield rows


@dataclass(frozen=True)
class LawChecked:
    """Validation of the law of propagation by draws at some points.

    Attributes:
        points: number of validated points.
        held: number of them at which it held to one digit of u.
        off_mm: median difference of an end of a 95 % interval; `most_off_mm`: the largest.
    """

    points: int
    held: int
    off_mm: float | None
    most_off_mm: float | None


def checked(calibration: Calibration, looks: Settings, draws: int, seed: int) -> LawChecked:
    """Validate points of some looks by draws (JCGM 101, 8)."""
    located = locate_settings(calibration, looks, draws=draws, seed=seed)
    accepted = np.array([error is None for error in located.refused])
    agrees = np.asarray(located.digits_held).min(axis=1) >= 1
    off = located.law_off_mm[accepted]
    sizes = (float(np.median(off)), float(off.max())) if len(off) else (None, None)
    return LawChecked(len(off), int(np.sum(agrees & accepted)), *sizes)
