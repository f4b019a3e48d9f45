"""Pictures of a laser spot on a sheet by the twin's cameras.

The steps are those of a real camera: irradiance at the sensor (spot, speckle, ambient light, optical blur, integrated
over the pixel), Bayer mosaic, shot and read noise, clipping, 8 bits, demosaicing by OpenCV. Frame S (stereo) and the
cameras' own axes; mm; px with the integer at the centre of a pixel; DN = grey levels of 8 bits. Pictures are (height,
width, 3) uint8, blue, green, red. All random numbers follow from the given seeds, independently of order and number of
threads.

The spot is the image of a round Gaussian beam on an oblique sheet through the camera's linearised map at the point
where the beam's axis meets the sheet: an elliptic Gaussian whose centroid IS the projection of that point. The
neglected curvature of distortion and perspective across the spot would shift a centroid by 0.002 px at a spot sd of 2
px and 0.01 px at 4 px (`experiments/cameras/detection.md`). NumPy and OpenCV only, never the model under test.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tvsbayes.twin.physics import Camera, CameraPair, Light, camera_axes

WINDOW_SDS = 6.0
"""Half side of the rendered window in spot sds: a spot overexposed tenfold has 4e-5 DN there."""
_STREAMS = {"speckle": 0, "noise": 1, "board": 2}
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)


@dataclass(frozen=True)
class Sensor:
    """A low-cost colour sensor without IR-cut filter, its exposure included.

    Attributes:
        gain_dn_per_electron: 0.04 puts 255 DN at 6300 electrons, a pixel of about 2 um.
        read_noise_dn: sd of all noise independent of light, in a raw pixel.
        black_dn: level without light.
        response: relative response of blue, green, red: dyes pass 808 nm about equally (Sensors 2020, 20(19),
            5578), so that the spot is near white, slightly violet.
        blur_px: sd of the lens' point spread.
    """

    gain_dn_per_electron: float = 0.04
    read_noise_dn: float = 0.8
    black_dn: float = 4.0
    response: tuple[float, float, float] = (0.97, 0.92, 1.0)
    blur_px: float = 0.7


@dataclass(frozen=True)
class Scene:
    """Light of laser and room on the sheet.

    Attributes:
        beam_sd_mm: sd of the round Gaussian beam, across its axis.
        peak_dn: irradiance at the centre for a sheet normal to the beam; an oblique one gets the cosine of it. Above
            255 - black the core is clipped.
        ambient_dn: ambient light at the image's centre.
        ambient_gradient_dn: its change from the lower right to the upper left corner.
        speckle_contrast: sd over mean of the speckle in one pixel; 0 = none.
        speckle_grain_px: sd of the smoothing that gives speckle its grain; 0 = independent pixels.
    """

    beam_sd_mm: float = 0.8
    peak_dn: float = 320.0
    ambient_dn: float = 12.0
    ambient_gradient_dn: float = 6.0
    speckle_contrast: float = 0.4
    speckle_grain_px: float = 0.0


@dataclass(frozen=True)
class Footprint:
    """The image of a spot before the sensor: an elliptic Gaussian.

    Attributes:
        centre_px: (2,) projection of the point where the beam's axis meets the sheet.
        covariance_px2: (2, 2) covariance of the irradiance, with blur, without pixel integration.
        peak_dn: irradiance at the centre.
    """

    centre_px: np.ndarray
    covariance_px2: np.ndarray
    peak_dn: float


@dataclass(frozen=True)
class SpotFrames:
    """Pictures of one look."""

    left: np.ndarray
    right: np.ndarray


def footprint(
    camera: Camera,
    point_S_mm: np.ndarray,
    direction_S: np.ndarray,
    normal_S: np.ndarray,
    scene: Scene,
    blur_px: float,
) -> Footprint | None:
    """Compute the image of a beam on a sheet; None where it never meets the sheet or forms no image.

    Args:
        camera: the camera.
        point_S_mm: (3,) where the beam's axis meets the sheet, frame S.
        direction_S: (3,) direction of the beam.
        normal_S: (3,) normal of the sheet, any length.
        scene: beam and exposure.
        blur_px: sd of the lens' point spread.
    """
    point, beam, normal = (camera_axes(vector) for vector in (point_S_mm, direction_S, normal_S))
    beam, normal = beam / np.linalg.norm(beam), normal / np.linalg.norm(normal)
    if not np.isfinite(point).all():
        return None
    plane = np.linalg.svd(normal[None])[2][1:]  # (2, 3) orthonormal, in the sheet
    across = plane @ (np.eye(3) - np.outer(beam, beam)) @ plane.T
    sheet_covariance = scene.beam_sd_mm**2 * np.linalg.inv(across)
    step_mm = 1e-3  # truncation 1e-9 of the slope at 100 mm, rounding 1e-10
    pixels = camera.project(point + np.vstack((np.zeros(3), step_mm * plane, -step_mm * plane)))
    if not np.isfinite(pixels).all():
        return None
    slope = (pixels[1:3] - pixels[3:5]).T / (2 * step_mm)
    covariance = slope @ sheet_covariance @ slope.T + blur_px**2 * np.eye(2)
    return Footprint(pixels[0], covariance, scene.peak_dn * abs(float(beam @ normal)))


def spot_irradiance(spot: Footprint, width: int, height: int) -> tuple[tuple[slice, slice], np.ndarray]:
    """Integrate a spot's irradiance over the pixels of a window; return (rows, columns) of the image, and values.

    Three Gauss-Legendre nodes per pixel and axis are exact to the fifth order of the irradiance within a pixel.
    """
    half = WINDOW_SDS * np.sqrt(np.diag(spot.covariance_px2)) + 1
    low = np.clip(np.floor(spot.centre_px - half), 0, [width, height]).astype(int)
    high = np.clip(np.ceil(spot.centre_px + half) + 1, 0, [width, height]).astype(int)
    precision = np.linalg.inv(spot.covariance_px2)
    u = np.arange(low[0], high[0]) - spot.centre_px[0]
    v = np.arange(low[1], high[1])[:, None] - spot.centre_px[1]
    total = np.zeros((max(high[1] - low[1], 0), max(high[0] - low[0], 0)))
    for du, weight_u in zip(_NODES / 2, _WEIGHTS / 2, strict=True):
        for dv, weight_v in zip(_NODES / 2, _WEIGHTS / 2, strict=True):
            x, y = u + du, v + dv
            form = precision[0, 0] * x * x + 2 * precision[0, 1] * x * y + precision[1, 1] * y * y
            total += weight_u * weight_v * np.exp(-form / 2)
    return (slice(low[1], high[1]), slice(low[0], high[0])), spot.peak_dn * total


def speckle(shape: tuple[int, int], contrast: float, grain_px: float, rng: np.random.Generator) -> np.ndarray:
    """Draw a field of mean 1 and sd `contrast`, gamma-distributed as a sum of independent speckle patterns.

    With a grain, independent values of higher contrast are smoothed to the required contrast.
    """
    if contrast <= 0:
        return np.ones(shape)
    if grain_px <= 0:
        return rng.standard_gamma(1 / contrast**2, shape) * contrast**2
    import cv2

    margin = math.ceil(4 * grain_px)
    kernel = cv2.getGaussianKernel(2 * margin + 1, grain_px).ravel()
    raw = contrast / float(np.sum(kernel**2))
    field = rng.standard_gamma(1 / raw**2, (shape[0] + 2 * margin, shape[1] + 2 * margin)) * raw**2
    smooth = cv2.sepFilter2D(field, cv2.CV_64F, kernel, kernel)
    return smooth[margin : margin + shape[0], margin : margin + shape[1]]


@lru_cache(maxsize=8)
def mosaic_response(width: int, height: int, response: tuple[float, float, float]) -> np.ndarray:
    """Return the response (height, width) of an RGGB mosaic: red at even rows and columns."""
    blue, green, red = response
    tile = np.array([[red, green], [green, blue]], np.float32)
    return np.tile(tile, ((height + 1) // 2, (width + 1) // 2))[:height, :width]


@lru_cache(maxsize=8)
def ambient_level(width: int, height: int, level_dn: float, gradient_dn: float) -> np.ndarray:
    """Return the room's light (height, width) in DN: linear, `level_dn` in the middle, not negative."""
    u = np.linspace(-0.5, 0.5, width, dtype=np.float32)
    v = np.linspace(-0.5, 0.5, height, dtype=np.float32)[:, None]
    return np.maximum(level_dn - gradient_dn * (u + v) / 2, 0)


def expose(irradiance_dn: np.ndarray, sensor: Sensor, rng: np.random.Generator | None) -> np.ndarray:
    """Expose an irradiance (height, width), in DN above black: mosaic, noise, clipping, 8 bits, colours.

    Shot noise is drawn as normal, which it is at the hundreds of electrons of any lit pixel; `rng` None adds no noise.
    """
    import cv2

    height, width = irradiance_dn.shape
    raw = irradiance_dn.astype(np.float32) * mosaic_response(width, height, sensor.response)
    if rng is not None:
        noise = rng.standard_normal(raw.shape, np.float32)
        noise *= np.sqrt(np.float32(sensor.gain_dn_per_electron) * raw + np.float32(sensor.read_noise_dn**2))
        raw += noise
    raw += np.float32(sensor.black_dn)
    levels = np.clip(np.rint(raw, out=raw), 0, 255, out=raw).astype(np.uint8)
    return cv2.cvtColor(levels, cv2.COLOR_BayerRGGB2BGR)


def random_stream(name: str, *numbers: int) -> np.random.Generator:
    """Return the generator of one random stream, a key of `_STREAMS`, for a scene identified by whole numbers."""
    return np.random.default_rng(np.random.SeedSequence([_STREAMS[name], *map(int, numbers)]))


def render_spot(
    spot: Footprint | None,
    width: int,
    height: int,
    scene: Scene,
    sensor: Sensor,
    seed: Sequence[int],
    frame: int = 0,
) -> np.ndarray:
    """Render a picture of a spot, or of the ambient light alone where `spot` is None.

    Args:
        spot: the spot's image before the sensor.
        width: width of the picture, px.
        height: height of the picture, px.
        scene: ambient light and speckle.
        sensor: the sensor.
        seed: whole numbers that identify look and camera, which have their own speckle.
        frame: number of the exposure: frames of one look share the speckle, not the noise.
    """
    irradiance = ambient_level(width, height, scene.ambient_dn, scene.ambient_gradient_dn).copy()
    if spot is not None:
        window, light = spot_irradiance(spot, width, height)
        if light.size:
            grains = speckle(
                light.shape, scene.speckle_contrast, scene.speckle_grain_px, random_stream("speckle", *seed)
            )
            irradiance[window] += light * grains
    return expose(irradiance, sensor, random_stream("noise", *seed, frame))


def render_spots(
    cameras: CameraPair, light: Light, scene: Scene, sensor: Sensor, seed: int, spot: int, frame: int = 0
) -> SpotFrames:
    """Render both pictures of one look; speckle and noise of the two cameras are independent.

    Args:
        cameras: the true cameras at the laser's wavelength (`cameras_of` with the focal scale).
        light: light of one beam; where it meets no sheet there is ambient light only.
        scene: beam, exposure, ambient light, speckle.
        sensor: both sensors.
        seed: seed of the campaign.
        spot: number of the look.
        frame: number of the exposure of this look.
    """

    def taken(number: int, camera: Camera) -> np.ndarray:
        mark = footprint(camera, light.points_mm, light.directions, light.normals, scene, sensor.blur_px)
        return render_spot(mark, camera.width, camera.height, scene, sensor, (seed, spot, number), frame)

    return SpotFrames(taken(0, cameras.left), taken(1, cameras.right))
