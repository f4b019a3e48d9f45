"""Optics and gears of a bench that shares nothing with the package: NumPy alone, derived on other ways.

Head frame H: z up along the pan axis, x along the nominal beam at pan angle 0, y left, origin where the nominal laser
meets mirror 1. World: OpenCV's axes of the left camera (x right, y down, z along its view). mm, deg, px with the
integer at a pixel's centre. A beam is followed through the mirrors by images: a plane mirror shows a source behind it,
and the second mirror shows that image once more, so the beam is the line through the image of the image. No ray is
intersected with a mirror.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

SOURCE_MM = 100.0
"""How far above the origin of H the laser's source is taken; any other gives the same beam."""
FOLD = 1.3
"""Points further out than so many half diagonals of an image are not seen: a distortion polynomial may fold there."""


def turn(axis: str, angle_deg: np.ndarray | float) -> np.ndarray:
    """Matrices (..., 3, 3) of the right-handed turn about a coordinate axis, "x", "y" or "z"."""
    angle = np.radians(np.asarray(angle_deg, float))
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    matrix = np.zeros((*angle.shape, 3, 3))
    matrix[..., i, i] = 1.0
    matrix[..., j, j] = matrix[..., k, k] = np.cos(angle)
    matrix[..., k, j] = np.sin(angle)
    matrix[..., j, k] = -np.sin(angle)
    return matrix


def turned(vector_rad: np.ndarray) -> np.ndarray:
    """The matrix (3, 3) of a rotation vector (3,): exp of its cross product, by the series, to rounding below 1 rad."""
    x, y, z = vector_rad
    generator = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    series = term = np.eye(3)
    for order in range(1, 25):
        term = term @ generator / order
        series = series + term
    return series


@dataclass(frozen=True)
class Head:
    """The laser and its two mirrors at 45 deg, with what is not square. Errors as fields say; frame H.

    Attributes:
        offset_mm: from the pan axis to the middle of mirror 2, along the tilt axis.
        mirror_error_deg: mirror 1 and mirror 2 beyond 45 deg.
        laser_tilt_deg: of the laser towards +x and +y.
        laser_shift_mm: where it passes the plane z = 0, x and y.
        skew_deg: of the tilt axis out of the horizontal.
        axis_shift_mm: of the tilt axis along x and z.
        tilt_zero_deg: tilt angle at counter 0.
    """

    offset_mm: float
    mirror_error_deg: tuple[float, float] = (0.0, 0.0)
    laser_tilt_deg: tuple[float, float] = (0.0, 0.0)
    laser_shift_mm: tuple[float, float] = (0.0, 0.0)
    skew_deg: float = 0.0
    axis_shift_mm: tuple[float, float] = (0.0, 0.0)
    tilt_zero_deg: float = 0.0

    def beams(self, pan_deg: np.ndarray, tilt_deg: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (n, 3) on the beams and their directions (n, 3) at stage angles (n,); the tilt zero is not added."""
        stage = turn("z", pan_deg)
        first = stage @ (turn("x", self.mirror_error_deg[0]) @ np.array([0.0, -np.sqrt(0.5), np.sqrt(0.5)]))
        carrier = turn("x", self.skew_deg)
        leaning = turn("z", -45.0 - self.mirror_error_deg[1]) @ np.array([0.0, 1.0, 0.0])
        second = np.einsum("nij,nj->ni", stage @ carrier, turn("y", -np.asarray(tilt_deg)) @ leaning)
        middle = stage @ np.array([self.axis_shift_mm[0], -self.offset_mm, self.axis_shift_mm[1]])
        down = np.array([*np.tan(np.radians(self.laser_tilt_deg)), -1.0])
        source = np.array([*self.laser_shift_mm, 0.0]) - SOURCE_MM * down
        image = _behind(_behind(source, first, np.zeros(3)), second, middle)
        ahead = _behind(_behind(down / np.linalg.norm(down), first, np.zeros(3)), second, np.zeros(3))
        return image, ahead

    def azimuth_elevation_deg(self, pan_deg: np.ndarray, tilt_deg: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Azimuth about the pan axis and elevation (n,) of the beams in H; the tilt zero is not added."""
        ahead = self.beams(pan_deg, tilt_deg)[1]
        return np.degrees(np.arctan2(ahead[:, 1], ahead[:, 0])), np.degrees(np.arcsin(ahead[:, 2]))

    def arm_mm(self, pan_deg: float, tilt_deg: float) -> float:
        """Signed distance of the beam from the pan axis, seen from above: positive to the right of the axis."""
        on, ahead = (ray[0, :2] for ray in self.beams(np.array([pan_deg]), np.array([tilt_deg])))
        right = np.array([ahead[1], -ahead[0]]) / np.linalg.norm(ahead)
        return float(on @ right)


def _behind(point: np.ndarray, normal: np.ndarray, on: np.ndarray) -> np.ndarray:
    """Image (n, 3) of points in plane mirrors with unit normals (n, 3) through points `on`."""
    return point - 2 * np.sum((point - on) * normal, axis=-1, keepdims=True) * normal


@dataclass(frozen=True)
class Camera:
    """A pinhole behind a lens of five distortion coefficients, in OpenCV's order; world to camera by R x + t."""

    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    lens: tuple[float, float, float, float, float]
    rotation: np.ndarray
    shift_mm: np.ndarray
    size: tuple[int, int]

    def project(self, points_mm: np.ndarray) -> np.ndarray:
        """Pixels (n, 2) of world points (n, 3), also outside the image; NaN behind the camera or far outside."""
        local = points_mm @ self.rotation.T + self.shift_mm
        with np.errstate(divide="ignore", invalid="ignore"):
            flat = np.where(local[:, 2:] > 1.0, local[:, :2] / local[:, 2:], np.nan)
        k1, k2, p1, p2, k3 = self.lens
        far2 = np.sum(flat**2, axis=1)
        gain = 1 + k1 * far2 + k2 * far2**2 + k3 * far2**3
        cross = 2 * flat[:, 0] * flat[:, 1]
        bent = flat * gain[:, None] + np.column_stack(
            (p1 * cross + p2 * (far2 + 2 * flat[:, 0] ** 2), p2 * cross + p1 * (far2 + 2 * flat[:, 1] ** 2))
        )
        bent[far2 > (FOLD * 0.5 * np.hypot(*self.size) / min(self.focal_px)) ** 2] = np.nan
        return bent * self.focal_px + self.centre_px

    def sees(self, pixels: np.ndarray, border_px: float = 5.0) -> np.ndarray:
        """Which pixels (n, 2) lie in the image, `border_px` from its edges."""
        with np.errstate(invalid="ignore"):
            return np.all((pixels > border_px) & (pixels < np.array(self.size) - 1 - border_px), axis=1)


@dataclass(frozen=True)
class Waves:
    """A smooth error of place: a few sine waves and a cubic, both without a mean over the range; deg.

    Attributes:
        amplitude_deg, period_deg, phase_rad: of the waves, (m,).
        bend_deg: of the Legendre polynomials of order 2 and 3 over `range_deg`.
        range_deg: the places of the counters used, lowest and highest.
    """

    amplitude_deg: np.ndarray
    period_deg: np.ndarray
    phase_rad: np.ndarray
    bend_deg: tuple[float, float]
    range_deg: tuple[float, float]

    def __call__(self, place_deg: np.ndarray) -> np.ndarray:
        """The error at places (n,)."""
        place = np.asarray(place_deg, float)
        waves = np.sin(2 * np.pi * place[..., None] / self.period_deg + self.phase_rad) @ self.amplitude_deg
        low, high = self.range_deg
        x = np.clip(2 * (place - low) / max(high - low, 1e-9) - 1, -1.5, 1.5)
        return waves + self.bend_deg[0] * (1.5 * x**2 - 0.5) + self.bend_deg[1] * (2.5 * x**3 - 1.5 * x)


@dataclass(frozen=True)
class Gear:
    """One geared axis: what the wheel does where the motor's counter stands.

    Attributes:
        deg_per_step: ratio.
        play_deg: lost motion at a place.
        error_deg: transmission error at a place of the wheel.
        zero_deg: how far the zero has crept after so many hours.
        stop_sd_deg: scatter of where it comes to rest.
        look_sd_deg: independent scatter of every look.
        homed_deg: sd of the zero after every homing but the first.
    """

    deg_per_step: float
    play_deg: Callable[[np.ndarray], np.ndarray]
    error_deg: Callable[[np.ndarray], np.ndarray]
    zero_deg: Callable[[np.ndarray], np.ndarray]
    stop_sd_deg: float
    look_sd_deg: float = 0.0
    homed_deg: float = 0.0

    def driven(
        self, counters: np.ndarray, homed: np.ndarray, hours: np.ndarray, side: int, rng: np.random.Generator
    ) -> np.ndarray:
        """Angles (n,) of the wheel at looks, deg.

        The motor pulls the wheel along where the play is used up; the wheel stays where it is otherwise. It comes to
        rest with an error that stays until the motor moves again.

        Args:
            counters: of every look, (n,).
            homed: whether the axis was homed before it, (n,).
            hours: when, (n,).
            side: +1 where a homing ends with a move to higher counters, -1 otherwise.
            rng: of stops and looks.
        """
        angle = np.empty(len(counters))
        wheel = rest = offset = 0.0
        half = 0.5 * self.play_deg(self.deg_per_step * counters)
        for i, counter in enumerate(counters):
            if homed[i]:
                offset = self.homed_deg * rng.standard_normal() if i else 0.0
            motor = self.deg_per_step * counter + offset
            if homed[i]:
                wheel = motor - side * half[i]
            wheel = min(max(wheel, motor - half[i]), motor + half[i])
            if homed[i] or counter != counters[i - 1]:
                rest = self.stop_sd_deg * rng.standard_normal()
            angle[i] = wheel + rest
        look = self.look_sd_deg * rng.standard_normal(len(counters))
        return angle + self.error_deg(angle) + self.zero_deg(hours) + look
