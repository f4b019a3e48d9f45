"""Laser spots in pictures: centres with covariances from the frames of a campaign, or the reason why there is none.

Raw image px with the integer at the centre of a pixel; DN = grey levels of 8 bits; pictures (height, width, 3) uint8,
blue, green, red. Two methods:

- `fit` (default): an elliptic Gaussian on a sloping background, fitted to the pixels around the spot by iterated
  weighted least squares. Pixels next to a clipped one are left out: a clipped core is normal, costs information and so
  widens the standard uncertainty. Grey is (B + 2 G + R) / 4, in which every photosite of a Bayer sensor weighs alike;
  808 nm passes all three dyes, so hue tells nothing. Variance of a pixel with signal S:
  background + gain * S + (contrast * S)^2: what the frame shows without spot, shot noise, speckle.
- `contour`: the paper's (section 2.4): rectify, region of interest, HSV, threshold, contour, centroid of the binary
  region, here taken back to the raw pixels of the format.

Gain and contrast are learned from the campaign itself, per camera, from what a symmetric fit cannot follow: third-order
(skew) residuals have the scale of the spot, are noise alone for any symmetric spot, and average demosaicing and the
grain of speckle as the centre does. A skewed beam counts as noise and widens the sd. Sd of an intensity centroid under
speckle alone: contrast / sqrt(8 pi) = 0.2 contrast px, whatever the size of the spot (Gaussian spot, independent
pixels). No JAX.

Refusals (status in spots.csv: reason, then the camera): see `REASONS`.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tvsbayes.cameras.contour import contour_of, epipolar_refused, rectified_pair
from tvsbayes.cameras.spot_fit import (
    CLIPPED_SHARE_MAX,
    CONTRAST_DEFAULT,
    Centre,
    Patch,
    SpotNoise,
    centre_of,
    fit_spot,
    learn_noise,
    patch_around,
    skewness,
)
from tvsbayes.errors import InputError, NothingToEstimate, escaped, refusal
from tvsbayes.files.disk import make_folder, read_bytes, write_atomically
from tvsbayes.files.images import IMAGE_BYTES_MAX, decode_image, image_size, png_bytes
from tvsbayes.instrument.campaign import Campaign, Spot
from tvsbayes.instrument.stereo_pair import Stereo

METHODS = ("fit", "contour")
SIDES = ("left", "right")
REASONS = {
    "no-spot": "nothing stands out of the background",
    "two-spots": "a second spot holds over a quarter of the light of the first",
    "too-small": "the bright area is that of a hot pixel",
    "too-large": "the bright area is no laser spot: a lamp or an overexposed frame",
    "border": "the spot reaches the border of the picture",
    "clipped": "the clipped area is over half the bright area",
    "elongated": "the spot is over four times as long as wide",
    "misshapen": "skewed far beyond noise: a reflection, dust or an edge in the spot",
    "unfitted": "the fit did not settle",
    "epipolar": "left and right are not images of one point",
}
PILOTS_MAX = 24
"""Looks from which the weights of the fits are learned; uncertainties are stated from all."""
LEARNING_ROUNDS = 3
SKEWS_MAX = 4000


@dataclass(frozen=True)
class Detection:
    """What `detect` found.

    Attributes:
        campaign: the campaign with its new spots, rows as before.
        method: "fit" or "contour".
        processed: rows whose two frames were read.
        missing: rows without frames; they stay as they were.
        kept: rows refused by somebody else (a status that is none of `REASONS`); they stay as well.
        statuses: number of processed rows by status.
        noise: what spots of the left and of the right camera were weighted with.
        median_sd_px: median stated sd of the ok coordinates; None without any.
    """

    campaign: Campaign
    method: str
    processed: int
    missing: int
    kept: int
    statuses: dict[str, int]
    noise: dict[str, SpotNoise]
    median_sd_px: float | None

    def as_json(self) -> dict[str, object]:
        """The document of `tvsbayes detect --json`."""
        refused = {status: count for status, count in self.statuses.items() if status != "ok"}
        noise = {
            side: {"gain_dn": one.gain_dn, "speckle_contrast": one.speckle_contrast} for side, one in self.noise.items()
        }
        return {
            "method": self.method,
            "spots": len(self.campaign.spots),
            "ok": self.statuses.get("ok", 0),
            "refused": refused,
            "missing": self.missing,
            "kept": self.kept,
            "median_sd_px": self.median_sd_px,
            "noise": noise,
        }


def pair_status(left: Centre, right: Centre) -> str:
    """The word "ok", or the reasons of both cameras with their sides, as `spots.csv` holds them."""
    bad = [(c.status, side) for c, side in zip((left, right), SIDES, strict=True) if c.status != "ok"]
    if len(bad) == 2 and bad[0][0] == bad[1][0]:
        return f"{bad[0][0]} both"
    return ", ".join(f"{reason} {side}" for reason, side in bad) or "ok"


def _row(spot: Spot, left: Centre, right: Centre) -> Spot:
    """A row with what was found; pixels stay empty where a camera refused."""
    values: dict[str, float | None] = {}
    status = pair_status(left, right)
    for side, one in zip(SIDES, (left, right), strict=True):
        good = status == "ok"
        sds = np.sqrt(np.diag(one.covariance_px2)) if good else (None, None)
        for number, coordinate in enumerate("uv"):
            values[f"{coordinate}_{side}_px"] = round(float(one.centre_px[number]), 6) if good else None
            # The format's smallest sd; no spot is known that well.
            values[f"s{coordinate}_{side}_px"] = max(round(float(sds[number]), 7), 1e-4) if good else None
        values[f"ruv_{side}"] = round(float(one.covariance_px2[0, 1] / sds[0] / sds[1]), 6) if good else 0.0
    return replace(spot, **values, status=status)


@dataclass(frozen=True)
class _Frames:
    """Reads the frames of a campaign: names are fixed by the format, links out of the folder are refused."""

    folder: Path
    size: tuple[int, int]

    def path(self, spot: Spot, side: str) -> Path:
        return self.folder / "frames" / f"{spot.spot:06d}_{side}.png"

    def there(self, spot: Spot) -> bool:
        return all(os.path.lexists(self.path(spot, side)) for side in SIDES)

    def read(self, spot: Spot, side: str) -> np.ndarray:
        path = self.path(spot, side)
        # Its size before it is decoded: a small file can hold 50 million pixels, on every thread.
        data = read_bytes(path, IMAGE_BYTES_MAX, self.folder)
        size = image_size(data, escaped(path.name))
        if size != self.size:
            raise refusal(
                "image-size",
                file=path.name,
                found=f"{size[0]} x {size[1]} pixels",
                allowed=f"{self.size[0]} x {self.size[1]} as in stereo.json",
                remedy="calibrate and observe at one image size",
            )
        return decode_image(data, escaped(path.name))


def _parallel(job: Callable, items: Sequence, workers: int) -> Iterator:
    """Results in order. Decoding and OpenCV leave Python's lock, so threads do; Ctrl-C drops what has not begun."""
    pool = ThreadPoolExecutor(workers)
    try:
        yield from pool.map(job, items)
    finally:
        pool.shutdown(cancel_futures=True)


def detect(
    campaign: Campaign,
    method: str = "fit",
    *,
    speckle_contrast: float | None = None,
    workers: int | None = None,
    overlay: Path | None = None,
    done: Callable[[int, int], None] | None = None,
) -> Detection:
    """Find the spots in the frames of a campaign folder; nothing is written but overlay pictures.

    Args:
        campaign: read from a folder.
        method: "fit" or "contour".
        speckle_contrast: contrast per independent pixel, taken as known; by default `fit` learns it from the
            looks of each camera and `contour` takes 0.4.
        workers: threads; default one per core.
        overlay: folder for one picture per look: outline of the bright area and centre.
        done: called with the number of looks finished and their total.

    Raises:
        InputError: a frame that cannot be read safely, has another size, or a campaign without folder.
        NothingToEstimate: no row has both frames.
    """
    if method not in METHODS:
        remedy = "choose one of them"
        raise InputError("method", f"no method {method!r}", found=method, allowed=", ".join(METHODS), remedy=remedy)
    if campaign.path is None:
        raise InputError("path", "a campaign that was not read from a folder has no frames")
    stereo = campaign.stereo
    frames = _Frames(Path(campaign.path), (stereo.image_width, stereo.image_height))
    rows = [row for row, spot in enumerate(campaign.spots) if _ours(spot.status)]
    present = [row for row in rows if frames.there(campaign.spots[row])]
    if not present:
        raise NothingToEstimate(
            "no-frames",
            f"frames/ holds pictures of none of the {len(campaign.spots)} rows of spots.csv",
            allowed="frames/000012_left.png and frames/000012_right.png for spot 12",
            remedy="put the pictures there, or write centroids into spots.csv yourself",
        )
    workers = workers or os.cpu_count() or 1
    noise = {side: SpotNoise(speckle_contrast=_contrast(speckle_contrast)) for side in SIDES}
    kept: dict[int, tuple[Patch | str, Patch | str]] = {}
    if method == "fit":
        kept = _pilots(campaign.spots, present, frames, workers)
        for number, side in enumerate(SIDES):
            found = [pair[number] for pair in kept.values() if not isinstance(pair[number], str)]
            noise[side] = _learned([one for one in found if one.clipped_share <= CLIPPED_SHARE_MAX], speckle_contrast)
    maps = rectified_pair(stereo) if method == "contour" else (None, None)
    if overlay is not None:
        make_folder(overlay)

    def look(row: int) -> tuple[Centre, Centre]:
        spot = campaign.spots[row]
        if row in kept and overlay is None:
            first, second = (centre_of(patch, noise[side]) for side, patch in zip(SIDES, kept[row], strict=True))
            return first, second
        found, pictures = [], []
        for side, camera in zip(SIDES, maps, strict=True):
            picture = frames.read(spot, side)
            found.append(
                centre_of(patch_around(picture), noise[side])
                if camera is None
                else contour_of(picture, camera, noise[side])
            )
            if overlay is not None:
                pictures.append(_overlay(picture, found[-1]))
        if overlay is not None:
            write_atomically(overlay / f"{spot.spot:06d}.png", png_bytes(np.hstack(pictures)))
        return found[0], found[1]

    pairs = []
    for pair in _parallel(look, present, workers):
        pairs.append(pair)
        if done is not None:
            done(len(pairs), len(present))
    if method == "fit":
        for number, side in enumerate(SIDES):
            skews = [pair[number].skews for pair in pairs if pair[number].status in ("ok", "misshapen")]
            if skews:
                table = np.vstack(skews)
                noise[side] = learn_noise(table[:: -(-len(table) // SKEWS_MAX)], speckle_contrast)
    seen = [(left.under(noise["left"]), right.under(noise["right"])) for left, right in pairs]
    spots = _rows(campaign.spots, present, seen, stereo)
    after = [spots[row] for row in present]
    stated = [s.su_left_px for s in after if s.status == "ok"] + [s.su_right_px for s in after if s.status == "ok"]
    return Detection(
        campaign=replace(campaign, spots=tuple(spots)),
        method=method,
        processed=len(present),
        missing=len(rows) - len(present),
        kept=len(campaign.spots) - len(rows),
        statuses=dict(Counter(spot.status for spot in after).most_common()),
        noise=noise,
        median_sd_px=float(np.median(stated)) if stated else None,
    )


def _pilots(
    spots: Sequence[Spot], present: Sequence[int], frames: _Frames, workers: int
) -> dict[int, tuple[Patch | str, Patch | str]]:
    """Left and right patch, or why there is none, of looks spread evenly over the campaign, by row of spots.csv."""
    rows = [present[k] for k in np.unique(np.linspace(0, len(present) - 1, PILOTS_MAX).astype(int))]

    def patches(row: int) -> tuple[Patch | str, Patch | str]:
        return patch_around(frames.read(spots[row], "left")), patch_around(frames.read(spots[row], "right"))

    return dict(zip(rows, _parallel(patches, rows, workers), strict=True))


def _rows(
    spots: Sequence[Spot], present: Sequence[int], seen: Sequence[tuple[Centre, Centre]], stereo: Stereo
) -> list[Spot]:
    """All rows of spots.csv, those in `present` with what was seen (left, right); off their epipolar line: refused."""
    spots, good = list(spots), []
    for row, (left, right) in zip(present, seen, strict=True):
        spots[row] = _row(spots[row], left, right)
        if spots[row].status == "ok":
            good.append((row, left, right))
    pixels, covariances = np.zeros((len(good), 4)), np.zeros((len(good), 4, 4))
    for place, (_, left, right) in enumerate(good):
        pixels[place] = *left.centre_px, *right.centre_px
        covariances[place, :2, :2], covariances[place, 2:, 2:] = left.covariance_px2, right.covariance_px2
    for place in np.flatnonzero(epipolar_refused(pixels, covariances, stereo)):
        row = good[place][0]
        spots[row] = replace(spots[row], status="epipolar")
    return spots


def _ours(status: str) -> bool:
    """Whether a row may be detected (again): a refusal by a person stands."""
    return status in ("ok", "undetected") or status.split(" ")[0] in REASONS


def _contrast(given: float | None) -> float:
    return CONTRAST_DEFAULT if given is None else given


def _learned(patches: Sequence[Patch], speckle_contrast: float | None) -> SpotNoise:
    """The noise of one camera from some of its spots: weights follow what is learned, so a few rounds."""
    noise = SpotNoise(speckle_contrast=_contrast(speckle_contrast))
    for _ in range(LEARNING_ROUNDS):
        fits = [(fitted, patch) for patch in patches if (fitted := fit_spot(patch, noise)) is not None]
        if not fits:
            return noise
        noise = learn_noise(np.vstack([skewness(*pair) for pair in fits]), speckle_contrast)
    return noise


OVERLAY_HALF_PX, OVERLAY_ZOOM = 32, 8
"""Half the side of the square that an overlay shows, and how many of its pixels show one."""


def _overlay(picture: np.ndarray, centre: Centre) -> np.ndarray:
    """The surroundings of a spot enlarged: outline green, centre red, the reason of a refusal in words (Figure 9)."""
    import cv2

    half, zoom = OVERLAY_HALF_PX, OVERLAY_ZOOM
    height, width = picture.shape[:2]
    middle = centre.centre_px
    if middle is None:
        known = centre.outline_px is not None and len(centre.outline_px)
        middle = centre.outline_px.mean(axis=0) if known else np.array([width, height]) / 2
    low = np.clip(np.round(middle).astype(int) - half, 0, np.maximum((width, height) - np.array(2 * half), 0))
    crop = picture[low[1] : low[1] + 2 * half, low[0] : low[0] + 2 * half]
    crop = cv2.copyMakeBorder(crop, 0, 2 * half - crop.shape[0], 0, 2 * half - crop.shape[1], cv2.BORDER_CONSTANT)
    large = cv2.resize(crop, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST)
    if centre.outline_px is not None and len(centre.outline_px):
        outline = np.round((centre.outline_px - low + 0.5) * zoom).astype(np.int32)
        cv2.polylines(large, [outline.reshape(-1, 1, 2)], True, (0, 255, 0), 1, cv2.LINE_AA)
    if centre.centre_px is not None:
        dot = np.round((centre.centre_px - low + 0.5) * zoom).astype(int)
        cv2.circle(large, tuple(map(int, dot)), zoom // 2, (0, 0, 255), -1, cv2.LINE_AA)
    if centre.status != "ok":
        cv2.putText(
            large, centre.status, (zoom, 3 * zoom), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (0, 255, 255), 1, cv2.LINE_AA
        )
    return large
