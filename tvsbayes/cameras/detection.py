"""Laser spots in the frames of a campaign: centres with covariances, or the reason for a refusal.

Raw image px with the integer at the centre of a pixel. Two methods: `fit` (`cameras.spot_fit`), the default, and
`contour` (`cameras.contour`), the paper's (section 2.4): rectify, region of interest, HSV, threshold, contour, centroid
of the binary region, here taken back to the raw pixels of the format.

Gain and contrast are estimated from the campaign itself, per camera, from third-order (skew) residuals, which a
symmetric fit does not remove. They have the scale of the spot, are pure noise for any symmetric spot, and average
demosaicing and the grain of speckle as the centre does. A skewed beam counts as noise and increases the sd. The sd of
an intensity centroid under speckle alone is contrast / sqrt(8 pi) = 0.2 contrast px for any size of the spot (Gaussian
spot, independent pixels).

Refusals (status in spots.csv: reason, then the camera): see `REASONS`.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from tvsbayes.cameras.contour import Rectified, contour_of, epipolar_refused, rectified_pair
from tvsbayes.cameras.picture_pairs import SUFFIXES
from tvsbayes.cameras.spot_fit import AlternateLines, Centre, centre_of, fit_spot, measured_noise, skewness, widened
from tvsbayes.cameras.spot_noise import CONTRAST_DEFAULT, SHAPE_SPOTS_MIN, SpotNoise, learn_noise, mean_noise
from tvsbayes.cameras.spot_window import CLIPPED_DN, CLIPPED_SHARE_MAX, WIDE_SD_PX, Patch, patch_around
from tvsbayes.errors import InputError, NothingToEstimate, all_of, escaped, refusal, typed
from tvsbayes.files.disk import make_folder, read_bytes, write_atomically
from tvsbayes.files.images import (
    IMAGE_BYTES_MAX,
    decode_image,
    image_size,
    in_grey_levels,
    is_deep,
    png_bytes,
    white_level,
)
from tvsbayes.instrument.campaign import (
    CAMERAS,
    PIXEL_SDS,
    UNDETECTED,
    Campaign,
    Spot,
    frame_name,
    stereo_spots,
    with_pixels,
)
from tvsbayes.progress import Job, Show

METHODS = ("fit", "contour")
REASONS = {
    "no-spot": "nothing stands out of the background",
    "two-spots": "a second spot holds over a quarter of the light of the first",
    "too-small": "the bright area is that of a hot pixel",
    "too-large": "the bright area is no laser spot: a lamp or an overexposed frame",
    "lamp": "a lamp or window reaches in from the border, and no spot is beside it: shade it, or subtract with --dark",
    "border": "the spot reaches the border of the picture",
    "clipped": "the clipped area is over half the bright area",
    "elongated": "the spot is over four times as long as wide",
    "misshapen": "skewed far beyond noise: a reflection, dust or an edge in the spot",
    "unfitted": "the fit did not settle",
    "epipolar": "left and right are not images of one point",
}
LEVELLING, LEARNING, DETECTING = "finding the brightest pixel", "learning the noise", "detecting"
"""Stages of the progress; the first is only used for pictures of more than 8 bits."""
PILOT_LOOKS_MAX = 24
"""Largest number of looks used for the weights of the fits; all looks are used for the uncertainties."""
LEARNING_ROUNDS = 3
SKEW_SPOTS_MAX = 1000
OVERLAY_HALF_PX, OVERLAY_ZOOM = 32, 8
"""Half the side of the square in an overlay, and its magnification."""
PEDESTAL_DN = 8.0
"""Offset added to a difference of pictures, so that the noise of a dark background is not cut at 0."""
SD_MIN_PX = 1e-4
"""The smallest sd in the format; no spot is that accurate."""
MIXED_MIN = 3
"""Fewest looks off their epipolar line that say that pictures are mixed up, where they are most."""


@dataclass(frozen=True)
class Detection:
    """The result of `detect`.

    Attributes:
        campaign: the campaign with its new spots, in the same rows.
        method: "fit" or "contour".
        processed: rows whose two frames were read.
        missing: rows without frames; unchanged.
        kept: rows refused by a person (a status other than `REASONS`); unchanged.
        statuses: number of processed rows by status.
        noise: noise of the left and the right camera, for the weights.
        median_sd_px: median stated sd of the ok coordinates; None without any.
        lines: disagreeing rows or columns of the left and the right camera.
    """

    campaign: Campaign
    method: str
    processed: int
    missing: int
    kept: int
    statuses: dict[str, int]
    noise: dict[str, SpotNoise]
    median_sd_px: float | None
    lines: dict[str, tuple[AlternateLines, ...]]

    @property
    def warnings(self) -> list[str]:
        """What to look at where most pairs are no images of one point."""
        off, ok = self.statuses.get("epipolar", 0), self.statuses.get("ok", 0)
        if off < MIXED_MIN or off <= ok:
            return []
        first = next(spot.spot for spot in self.campaign.spots if spot.status == "epipolar")
        frames = " with ".join(frame_name(first, side) for side in CAMERAS)
        command = f"tvsbayes detect {typed(self.campaign.path or Path('CAMPAIGN'))} --overlay"
        return [
            f"{off} of {off + ok} looks with a spot in both pictures lie off their epipolar line: pictures may be "
            "mixed up (another moment, another direction, the other camera), or stereo.json is another pair's. Compare "
            f"{frames}; `{command}` draws what was found into results/overlay. Pair pictures anew in a new folder: "
            "`tvsbayes new OUT --pictures FOLDER` or `tvsbayes import BOOK.csv --to OUT --pictures FOLDER`"
        ]

    def as_json(self) -> dict[str, object]:
        """The document of `tvsbayes detect --json`."""
        refused = {status: count for status, count in self.statuses.items() if status != "ok"}
        noise = {side: {"gain_dn": n.gain_dn, "speckle_contrast": n.speckle_contrast} for side, n in self.noise.items()}
        return {
            "method": self.method,
            "spots": len(self.campaign.spots),
            "ok": self.statuses.get("ok", 0),
            "refused": refused,
            "missing": self.missing,
            "kept": self.kept,
            "median_sd_px": self.median_sd_px,
            "noise": noise,
            "alternate_lines": {side: [asdict(n) for n in lines] for side, lines in self.lines.items()},
            "warnings": self.warnings,
        }


def pair_status(left: Centre, right: Centre) -> str:
    """The word "ok", or the reasons of both cameras with their sides, as `spots.csv` holds them."""
    if left.status == right.status != "ok":
        return f"{left.status} both"
    statuses = zip((left.status, right.status), CAMERAS, strict=True)
    return ", ".join(f"{status} {side}" for status, side in statuses if status != "ok") or "ok"


def _row(spot: Spot, pair: Sequence[Centre]) -> Spot:
    """A row with its centres; pixels stay empty where one camera has a refusal."""
    status = pair_status(*pair)
    if status != "ok":
        return with_pixels(spot, status)
    pixels: list[float] = []
    sds: list[float] = []
    correlations: list[float] = []
    for centre_px, covariance in (centre.located for centre in pair):
        sd = np.sqrt(np.diag(covariance))
        pixels += [round(value, 6) for value in centre_px.tolist()]
        sds += [max(round(value, 7), SD_MIN_PX) for value in sd.tolist()]
        correlations.append(round(float(covariance[0, 1] / sd[0] / sd[1]), 6))
    return with_pixels(spot, status, pixels, sds, correlations)


@dataclass(frozen=True)
class _Frames:
    """Reads the frames of a campaign: the format fixes their names; links out of the folder are refused.

    `white` is the largest value of cameras with more than 8 bits; None before it is known. `dark` has pictures with the
    laser off, with the same names or one for each camera.
    """

    folder: Path
    sizes: Mapping[str, tuple[int, int]]
    dark: Path | None = None
    white: int | None = None

    def present(self, spot: Spot) -> bool:
        return all(os.path.lexists(self.folder / frame_name(spot.spot, side)) for side in CAMERAS)

    def read(self, spot: Spot, side: str) -> np.ndarray:
        """A picture (height, width, 3): uint8, or float32 grey levels of 8 bits (DN) for deeper pictures.

        A dark picture, if any, is subtracted and `PEDESTAL_DN` added; clipped pixels stay unchanged.
        """
        path = self.folder / frame_name(spot.spot, side)
        picture = in_grey_levels(decode_image(self._data(path, self.folder, side), path.name), self.white)
        if self.dark is None:
            return picture
        names = [path.name, *(f"{side}{suffix}" for suffix in SUFFIXES)]
        dark_path = next((self.dark / name for name in names if os.path.lexists(self.dark / name)), None)
        if dark_path is None:
            raise refusal(
                "missing-file",
                file=escaped(str(self.dark), 200),
                found=f"no dark picture of the {side} camera for {frame_name(spot.spot, side)}",
                allowed=f"{path.name}, or {side}.png for all looks",
                remedy="take one with the laser off, at the exposure of the others",
            )
        dark = in_grey_levels(decode_image(self._data(dark_path, self.dark, side), dark_path.name), self.white)
        difference = np.maximum(picture.astype(np.float32) - dark + PEDESTAL_DN, 0.0)
        return np.where(picture >= CLIPPED_DN, picture.astype(np.float32), difference)

    def largest(self, spot: Spot) -> int:
        """The largest value in the pictures of a look with more than 8 bits; 0 if none."""
        paths = {side: self.folder / frame_name(spot.spot, side) for side in CAMERAS}
        data = {path: self._data(path, self.folder, side) for side, path in paths.items()}
        return max((int(decode_image(png, path.name).max()) for path, png in data.items() if is_deep(png)), default=0)

    def refused(self, picture: tuple[Spot, str]) -> InputError | None:
        """The reason why a look's picture from one side cannot be used; None where it can."""
        path = self.folder / frame_name(picture[0].spot, picture[1])
        try:
            decode_image(self._data(path, self.folder, picture[1]), path.name)
        except InputError as error:
            return error
        return None

    def _data(self, path: Path, folder: Path, side: str) -> bytes:
        # The size is checked before decoding: a small file can hold 50 million pixels in every thread.
        data = read_bytes(path, IMAGE_BYTES_MAX, folder)
        size = image_size(data, escaped(path.name))
        if size != self.sizes[side]:
            raise refusal(
                "image-size",
                file=path.name,
                found=f"{size[0]} x {size[1]} pixels",
                allowed="{} x {} as in stereo.json".format(*self.sizes[side]),
                remedy="calibrate and observe at one image size",
            )
        return data


def _threaded[Item, Result](job: Callable[[Item], Result], items: Sequence[Item], workers: int) -> Iterator[Result]:
    """Results in order. Decoding and OpenCV release Python's lock, so threads suffice; Ctrl-C cancels waiting jobs."""
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
    dark: Path | None = None,
    workers: int | None = None,
    overlay: Path | None = None,
    progress: Show | None = None,
) -> Detection:
    """Find the spots in the frames of a campaign folder; writes overlay pictures only.

    Args:
        campaign: read from a folder.
        method: "fit" or "contour".
        speckle_contrast: known contrast per independent pixel; by default `fit` estimates it from the looks of each
            camera and `contour` uses 0.4.
        dark: folder of pictures with the laser off, to be subtracted: named as the frames, or one for each camera,
            left.png and right.png.
        workers: number of threads; by default one per core.
        overlay: folder for one picture per look: outline of the bright area and centre.
        progress: shows the progress.

    Raises:
        InputError: a frame cannot be read safely or has another size, or the campaign has no folder.
        NothingToEstimate: no row has both frames.
    """
    frames, spots = _frames_of(campaign, method, dark), list(stereo_spots(campaign.spots))
    rows = [row for row, spot in enumerate(spots) if _may_detect(spot.status)]
    present = [row for row in rows if frames.present(spots[row])]
    if not present:
        raise _no_frames(campaign)
    looks, workers = [spots[row] for row in present], workers or os.cpu_count() or 1
    try:
        detector = _Detector(campaign, method, frames, speckle_contrast, workers, overlay)
        found = detector.centres(looks, progress)
    except InputError as first:
        pictures = list(product(looks, CAMERAS))
        raise all_of([error for error in _threaded(frames.refused, pictures, workers) if error] or [first]) from None
    centres, lines, sizes = [], {}, frames.sizes
    for side, own in zip(CAMERAS, found, strict=True):
        if method == "fit":
            detector.noise[side] = _final_noise(detector.noise[side], own, speckle_contrast)
        wide, lines[side] = widened([centre.under(detector.noise[side]) for centre in own])
        centres.append([centre.scaled(sizes[side], sizes["left"]) for centre in wide])
    pairs = dict(zip(present, zip(*centres, strict=True), strict=True))
    for row, pair in pairs.items():
        spots[row] = _row(spots[row], pair)
    located = {row: [centre.located for centre in pair] for row, pair in pairs.items() if spots[row].status == "ok"}
    pixels = np.reshape([[left[0], right[0]] for left, right in located.values()], (-1, 4))
    covariances = np.zeros((len(located), 4, 4))
    for covariance, (left, right) in zip(covariances, located.values(), strict=True):
        covariance[:2, :2], covariance[2:, 2:] = left[1], right[1]
    for row, off in zip(located, epipolar_refused(pixels, covariances, campaign.stereo_pair), strict=True):
        spots[row] = replace(spots[row], status="epipolar") if off else spots[row]
    detected = [spots[row] for row in present]
    sds = [getattr(spot, name) for spot in detected if spot.status == "ok" for name in PIXEL_SDS]
    return Detection(
        campaign=replace(campaign, spots=tuple(spots)),
        method=method,
        processed=len(present),
        missing=len(rows) - len(present),
        kept=len(spots) - len(rows),
        statuses=dict(Counter(spot.status for spot in detected).most_common()),
        noise=detector.noise,
        median_sd_px=float(np.median(sds)) if sds else None,
        lines=lines,
    )


def _no_frames(campaign: Campaign) -> NothingToEstimate:
    """The refusal of a campaign without frames, with the ways to add pictures."""
    message = f"frames/ holds pictures of none of the {len(campaign.spots)} rows of spots.csv"
    if not campaign.spots:
        message = "spots.csv has no rows: nothing says after which move a picture was taken"
    return NothingToEstimate(
        "no-frames",
        message,
        allowed="frames/000012_left.png and frames/000012_right.png for spot 12, its status undetected",
        remedy=f"`tvsbayes new {typed(campaign.path)} --pictures FOLDER` lists the pictures of a folder and copies "
        "them there; or write centroids into spots.csv yourself",
    )


def _frames_of(campaign: Campaign, method: str, dark: Path | None) -> _Frames:
    """The frames of a campaign, after checks of method and campaign."""
    if method not in METHODS:
        remedy = "choose one of them"
        raise InputError("method", f"no method {method!r}", found=method, allowed=", ".join(METHODS), remedy=remedy)
    if campaign.path is None:
        raise InputError("path", "a campaign that was not read from a folder has no frames")
    if method != "fit" and campaign.stereo_pair.right_image_size is not None:
        remedy, allowed = "leave out --method: fit is the default", "cameras of one picture size for contour"
        raise InputError("method", f"cameras of two picture sizes; allowed: {allowed}", allowed=allowed, remedy=remedy)
    return _Frames(Path(campaign.path), campaign.stereo_pair.image_sizes, dark)


class _Detector:
    """Finds the centres of all looks by a method; `noise` is that of each camera, for the weights of the fits."""

    def __init__(
        self,
        campaign: Campaign,
        method: str,
        frames: _Frames,
        speckle_contrast: float | None,
        workers: int,
        overlay: Path | None,
    ):
        self.frames, self.speckle_contrast, self.workers, self.overlay = frames, speckle_contrast, workers, overlay
        self.noise: dict[str, SpotNoise] = {}
        self.rectified: dict[str, Rectified] = {}
        self.patches: dict[int, tuple[Patch | str, ...]] = {}
        if method == "contour":
            self.noise = dict.fromkeys(CAMERAS, SpotNoise(speckle_contrast=_contrast(speckle_contrast)))
            self.rectified = dict(zip(CAMERAS, rectified_pair(campaign.stereo_pair), strict=True))

    def centres(self, looks: Sequence[Spot], progress: Show | None) -> list[tuple[Centre, ...]]:
        """Centres of the left camera, and of the right one."""
        deep_looks = len(looks) if self.frames.largest(looks[0]) else 0
        count = 0 if self.rectified else PILOT_LOOKS_MAX
        pilots = np.unique(np.linspace(0, len(looks) - 1, count).astype(int))
        with Job({LEVELLING: deep_looks, LEARNING: len(pilots), DETECTING: len(looks)}, progress) as job:
            job.begin(LEVELLING)
            largest = 0
            # All looks are read: a few may lack the brightest pixel, and all looks need the same level.
            for count, value in enumerate(_threaded(self.frames.largest, looks, self.workers)):
                largest = max(largest, value)
                job.at(count / len(looks))
            self.frames = replace(self.frames, white=white_level(largest) if largest else None)
            job.begin(LEARNING)
            self._learn([looks[k] for k in pilots])
            if self.overlay is not None:
                make_folder(self.overlay)
            job.begin(DETECTING)
            pairs = []
            for pair in _threaded(self._pair, looks, self.workers):
                pairs.append(pair)
                job.at(len(pairs) / len(looks), f"{len(pairs)} of {len(looks)} looks")
        return list(zip(*pairs, strict=True))

    def _learn(self, pilots: Sequence[Spot]) -> None:
        """The noise of each camera, for the method `fit`, from looks spread evenly over the campaign."""

        def patches(spot: Spot) -> tuple[Patch | str, ...]:
            return tuple(patch_around(self.frames.read(spot, side)) for side in CAMERAS)

        found = list(_threaded(patches, pilots, self.workers))
        self.patches = {spot.spot: pair for spot, pair in zip(pilots, found, strict=True)}
        for side, own in zip(CAMERAS, zip(*found, strict=True), strict=False):
            usable = [p for p in own if not isinstance(p, str) and p.clipped_share <= CLIPPED_SHARE_MAX]
            self.noise[side] = _estimated_noise(usable, self.speckle_contrast)

    def _pair(self, spot: Spot) -> tuple[Centre, ...]:
        """Left and right centre of a look."""
        if spot.spot in self.patches and self.overlay is None:
            patches = zip(CAMERAS, self.patches[spot.spot], strict=True)
            return tuple(centre_of(patch, self.noise[side]) for side, patch in patches)
        pictures = {side: self.frames.read(spot, side) for side in CAMERAS}
        pair = tuple(
            contour_of(picture, self.rectified[side], self.noise[side])
            if self.rectified
            else centre_of(patch_around(picture), self.noise[side])
            for side, picture in pictures.items()
        )
        if self.overlay is not None:
            drawn = [_overlay_of(*own) for own in zip(pictures.values(), pair, strict=True)]
            write_atomically(self.overlay / f"{spot.spot:06d}.png", png_bytes(np.hstack(drawn)))
        return pair


def _final_noise(noise: SpotNoise, centres: Sequence[Centre], speckle_contrast: float | None) -> SpotNoise:
    """The noise of a camera from all of its spots; that of the pilot looks where they are too few."""
    usable = [centre for centre in centres if centre.status in ("ok", "misshapen")]
    skews = [centre.skews for centre in usable if centre.skews is not None]
    wide = all(min(centre.axes_px) >= WIDE_SD_PX for centre in usable)
    if not skews or (wide and len(skews) < SHAPE_SPOTS_MIN):
        return noise
    return learn_noise(np.stack(skews)[:: -(-len(skews) // SKEW_SPOTS_MAX)], speckle_contrast)


def _may_detect(status: str) -> bool:
    """Whether a row may be detected (again): a refusal by a person is kept."""
    return status in ("ok", UNDETECTED) or status.split(" ")[0] in REASONS


def _contrast(stated: float | None) -> float:
    return CONTRAST_DEFAULT if stated is None else stated


def _estimated_noise(patches: Sequence[Patch], speckle_contrast: float | None) -> SpotNoise:
    """Estimate the noise of one camera from some of its spots, in a few rounds, since weights depend on the noise.

    With too few spots for a scatter between looks, the pixels of wide spots give the estimate.
    """
    # Wide spots are first fitted without speckle, whose weights would overrate the wings, which are not Gaussian.
    wide = bool(patches) and speckle_contrast is None and all(patch.wide for patch in patches)
    if wide and len(patches) < SHAPE_SPOTS_MIN:
        return mean_noise([measured_noise(patch)[0] for patch in patches])
    noise = SpotNoise(speckle_contrast=0.0 if wide else _contrast(speckle_contrast))
    for _ in range(LEARNING_ROUNDS):
        fits = [fitted for patch in patches if (fitted := fit_spot(patch, noise)) is not None]
        if not fits:
            return noise
        noise = learn_noise(np.stack([skewness(fitted) for fitted in fits]), speckle_contrast)
    return noise


def _overlay_of(picture: np.ndarray, centre: Centre) -> np.ndarray:
    """An enlarged picture of a spot: outline green, centre red, reason of a refusal in words (Figure 9)."""
    import cv2

    picture = picture if picture.dtype == np.uint8 else np.clip(np.rint(picture), 0, 255).astype(np.uint8)
    side, zoom = 2 * OVERLAY_HALF_PX, OVERLAY_ZOOM
    height, width = picture.shape[:2]
    outline = np.empty((0, 2)) if centre.outline_px is None else centre.outline_px
    middle = centre.centre_px
    if middle is None:
        middle = outline.mean(axis=0) if len(outline) else np.array([width, height]) / 2
    left, top = np.clip(np.round(middle).astype(int) - side // 2, 0, np.maximum(np.array((width, height)) - side, 0))
    crop = picture[top : top + side, left : left + side]
    crop = cv2.copyMakeBorder(crop, 0, side - crop.shape[0], 0, side - crop.shape[1], cv2.BORDER_CONSTANT)
    large = cv2.resize(crop, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST)

    def drawn(pixels: np.ndarray) -> np.ndarray:
        return np.round((pixels - (left, top) + 0.5) * zoom).astype(np.int32)

    if len(outline):
        cv2.polylines(large, [drawn(outline).reshape(-1, 1, 2)], True, (0, 255, 0), 1, cv2.LINE_AA)
    if centre.centre_px is not None:
        cv2.circle(large, drawn(centre.centre_px).tolist(), zoom // 2, (0, 0, 255), -1, cv2.LINE_AA)
    if centre.status != "ok":
        place, font = (zoom, 3 * zoom), cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(large, centre.status, place, font, 0.7, (0, 255, 255), 1, cv2.LINE_AA)
    return large
