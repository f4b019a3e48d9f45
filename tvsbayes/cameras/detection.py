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

from tvsbayes.cameras.alternate_lines import AlternateLines
from tvsbayes.cameras.contour import Rectified, contour_of, epipolar_refused, rectified_pair
from tvsbayes.cameras.picture_pairs import SUFFIXES
from tvsbayes.cameras.spot_fit import Centre, Located, centre_of, fit_spot, measured_noise, skewness, widened
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
from tvsbayes.instrument.campaign import CAMERAS, UNDETECTED, Campaign, Spot, frame_name, stereo_spots, with_pixels
from tvsbayes.instrument.stereo_pair import Stereo
from tvsbayes.progress import Job, Show

METHODS = ("fit", "contour")
_Patches = tuple[Patch | str, Patch | str]
"""Left and right patch of a look, or the reason for a missing one."""
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


def _row(spot: Spot, left: Centre, right: Centre) -> Spot:
    """A row with its centres; pixels stay empty where one camera has a refusal."""
    status = pair_status(left, right)
    if status != "ok":
        return with_pixels(spot, status)
    pixels: list[float] = []
    sds: list[float] = []
    correlations: list[float] = []
    for centre in (left, right):
        located = centre.located
        sd = np.sqrt(np.diag(located.covariance_px2))
        pixels += [round(float(value), 6) for value in located.centre_px]
        # The smallest sd in the format; no spot is that accurate.
        sds += [max(round(float(value), 7), 1e-4) for value in sd]
        correlations.append(round(float(located.covariance_px2[0, 1] / sd[0] / sd[1]), 6))
    return with_pixels(spot, status, pixels, sds, correlations)


@dataclass(frozen=True)
class _Frames:
    """Reads the frames of a campaign: the format fixes their names; links out of the folder are refused.

    `white` is the largest value of cameras with more than 8 bits; None before it is known. `dark` has pictures with the
    laser off, with the same names or one for each camera.
    """

    folder: Path
    sizes: Mapping[str, tuple[int, int]]
    white: int | None = None
    dark: Path | None = None

    def path(self, spot: Spot, side: str) -> Path:
        return self.folder / frame_name(spot.spot, side)

    def present(self, spot: Spot) -> bool:
        return all(os.path.lexists(self.path(spot, side)) for side in CAMERAS)

    def read(self, spot: Spot, side: str) -> np.ndarray:
        """A picture (height, width, 3): uint8, or float32 grey levels of 8 bits (DN) for deeper pictures.

        A dark picture, if any, is subtracted and `PEDESTAL_DN` added; clipped pixels stay unchanged.
        """
        picture = in_grey_levels(decode_image(self._data(spot, side), self.path(spot, side).name), self.white)
        if self.dark is None:
            return picture
        dark_path = self._dark_picture(spot, side)
        data = read_bytes(dark_path, IMAGE_BYTES_MAX, self.dark)
        self._require_size(data, dark_path, side)
        dark = in_grey_levels(decode_image(data, dark_path.name), self.white)
        difference = np.maximum(picture.astype(np.float32) - dark + PEDESTAL_DN, 0.0)
        return np.where(picture >= CLIPPED_DN, picture.astype(np.float32), difference)

    def _dark_picture(self, spot: Spot, side: str) -> Path:
        """The dark picture of a look, else of its camera."""
        assert self.dark is not None
        name_of_look = frame_name(spot.spot, side)
        names = [Path(name_of_look).name, *(f"{side}{suffix}" for suffix in SUFFIXES)]
        for name in names:
            if os.path.lexists(self.dark / name):
                return self.dark / name
        raise refusal(
            "missing-file",
            file=escaped(str(self.dark), 200),
            found=f"no dark picture of the {side} camera for {name_of_look}",
            allowed=f"{Path(name_of_look).name}, or {side}.png for all looks",
            remedy="take one with the laser off, at the exposure of the others",
        )

    def deep(self, spot: Spot) -> bool:
        """Whether a picture of this look has more than 8 bits."""
        return any(is_deep(self._data(spot, side)) for side in CAMERAS)

    def largest(self, spot: Spot) -> int:
        """The largest value in the pictures of a look with more than 8 bits; 0 if none."""
        data = {side: self._data(spot, side) for side in CAMERAS}
        deep = {side: png for side, png in data.items() if is_deep(png)}
        return max((int(decode_image(png, self.path(spot, side).name).max()) for side, png in deep.items()), default=0)

    def refused(self, picture: tuple[Spot, str]) -> InputError | None:
        """The reason why a look's picture from one side cannot be used; None where it can."""
        try:
            decode_image(self._data(*picture), self.path(*picture).name)
        except InputError as error:
            return error
        return None

    def _data(self, spot: Spot, side: str) -> bytes:
        path = self.path(spot, side)
        # The size is checked before decoding: a small file can hold 50 million pixels in every thread.
        data = read_bytes(path, IMAGE_BYTES_MAX, self.folder)
        self._require_size(data, path, side)
        return data

    def _require_size(self, data: bytes, path: Path, side: str) -> None:
        """Refuse a picture of another size than in the calibration."""
        size = image_size(data, escaped(path.name))
        if size != self.sizes[side]:
            raise refusal(
                "image-size",
                file=path.name,
                found=f"{size[0]} x {size[1]} pixels",
                allowed="{} x {} as in stereo.json".format(*self.sizes[side]),
                remedy="calibrate and observe at one image size",
            )


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
    frames, before = replace(_frames_of(campaign, method), dark=dark), stereo_spots(campaign.spots)
    rows = [row for row, spot in enumerate(before) if _may_detect(spot.status)]
    present = [row for row in rows if frames.present(before[row])]
    if not present:
        raise _no_frames(campaign)
    workers = workers or os.cpu_count() or 1
    pilot_looks = min(PILOT_LOOKS_MAX, len(present)) if method == "fit" else 0
    present_spots = [before[row] for row in present]
    try:
        deep_looks = len(present) if frames.deep(present_spots[0]) else 0
        with Job({LEVELLING: deep_looks, LEARNING: pilot_looks, DETECTING: len(present)}, progress) as job:
            job.begin(LEVELLING)
            largest = 0
            # All looks are read: a few may lack the brightest pixel, and all looks need the same level.
            for count, largest_value in enumerate(_threaded(frames.largest, present_spots, workers)):
                largest = max(largest, largest_value)
                job.at(count / len(present))
            frames = replace(frames, white=white_level(largest) if largest else None)
            job.begin(LEARNING)
            looks = _prepared_looks(campaign, method, frames, present, speckle_contrast, workers, overlay)
            job.begin(DETECTING)
            pairs = []
            for pair in _threaded(looks.centres, present, workers):
                pairs.append(pair)
                job.at(len(pairs) / len(present), f"{len(pairs)} of {len(present)} looks")
    except InputError as first:
        errors = [error for error in _threaded(frames.refused, list(product(present_spots, CAMERAS)), workers) if error]
        raise all_of(errors or [first]) from None
    noise = _final_noise(looks.noise, pairs, speckle_contrast) if method == "fit" else looks.noise
    sides = {side: widened([pair[k].under(noise[side]) for pair in pairs]) for k, side in enumerate(CAMERAS)}
    sizes = campaign.stereo_pair.image_sizes
    right = [centre.scaled(sizes["right"], sizes["left"]) for centre in sides["right"].centres]
    centres = list(zip(sides["left"].centres, right, strict=True))
    spots = _rows(before, present, centres, campaign.stereo_pair)
    detected = [spots[row] for row in present]
    sds = [
        sd
        for spot in detected
        if spot.status == "ok"
        for sd in (spot.su_left_px, spot.sv_left_px, spot.su_right_px, spot.sv_right_px)
        if sd is not None
    ]
    return Detection(
        campaign=replace(campaign, spots=tuple(spots)),
        method=method,
        processed=len(present),
        missing=len(rows) - len(present),
        kept=len(campaign.spots) - len(rows),
        statuses=dict(Counter(spot.status for spot in detected).most_common()),
        noise=noise,
        median_sd_px=float(np.median(sds)) if sds else None,
        lines={side: camera.lines for side, camera in sides.items()},
    )


def _no_frames(campaign: Campaign) -> NothingToEstimate:
    """The refusal of a campaign without frames, with the ways to add pictures."""
    pairing = (
        f"`tvsbayes new {typed(campaign.path)} --pictures FOLDER` lists the pictures of a folder and copies them there"
    )
    message = f"frames/ holds pictures of none of the {len(campaign.spots)} rows of spots.csv"
    if not campaign.spots:
        message = "spots.csv has no rows: nothing says after which move a picture was taken"
    return NothingToEstimate(
        "no-frames",
        message,
        allowed="frames/000012_left.png and frames/000012_right.png for spot 12, its status undetected",
        remedy=f"{pairing}; or write centroids into spots.csv yourself",
    )


def _frames_of(campaign: Campaign, method: str) -> _Frames:
    """The frames of a campaign, after checks of method and campaign."""
    if method not in METHODS:
        remedy = "choose one of them"
        raise InputError("method", f"no method {method!r}", found=method, allowed=", ".join(METHODS), remedy=remedy)
    if campaign.path is None:
        raise InputError("path", "a campaign that was not read from a folder has no frames")
    if method != "fit" and campaign.stereo_pair.right_image_size is not None:
        remedy, allowed = "leave out --method: fit is the default", "cameras of one picture size for contour"
        raise InputError("method", f"cameras of two picture sizes; allowed: {allowed}", allowed=allowed, remedy=remedy)
    return _Frames(Path(campaign.path), campaign.stereo_pair.image_sizes)


@dataclass(frozen=True)
class _Looks:
    """Finds the centres of single looks.

    Attributes:
        spots: all rows of spots.csv.
        frames: their pictures.
        noise: noise of the left and the right camera.
        patches: patches of rows that were read before.
        rectified: both cameras for the method `contour`, empty for `fit`.
        overlay: folder for a picture of every look.
    """

    spots: Sequence[Spot]
    frames: _Frames
    noise: dict[str, SpotNoise]
    patches: dict[int, _Patches]
    rectified: dict[str, Rectified]
    overlay: Path | None

    def centres(self, row: int) -> tuple[Centre, Centre]:
        """Left and right centre of a row."""
        if row in self.patches and self.overlay is None:
            first, second = self.patches[row]
            return centre_of(first, self.noise["left"]), centre_of(second, self.noise["right"])
        spot = self.spots[row]
        pictures = {camera: self.frames.read(spot, camera) for camera in CAMERAS}
        left, right = (self._centre(camera, picture) for camera, picture in pictures.items())
        if self.overlay is not None:
            views = _overlay_of(pictures["left"], left), _overlay_of(pictures["right"], right)
            write_atomically(self.overlay / f"{spot.spot:06d}.png", png_bytes(np.hstack(views)))
        return left, right

    def _centre(self, camera: str, picture: np.ndarray) -> Centre:
        if camera in self.rectified:
            return contour_of(picture, self.rectified[camera], self.noise[camera])
        return centre_of(patch_around(picture), self.noise[camera])


def _prepared_looks(
    campaign: Campaign,
    method: str,
    frames: _Frames,
    present: Sequence[int],
    speckle_contrast: float | None,
    workers: int,
    overlay: Path | None,
) -> _Looks:
    """The inputs of a method: the noise of each camera from pilot looks, or the rectified pictures."""
    noise: dict[str, SpotNoise] = {}
    patches: dict[int, _Patches] = {}
    rectified: dict[str, Rectified] = {}
    spots = stereo_spots(campaign.spots)
    if method == "fit":
        patches = _pilots(spots, present, frames, workers)
        for number, camera in enumerate(CAMERAS):
            patches_of_camera = [patch for pair in patches.values() if not isinstance(patch := pair[number], str)]
            noise[camera] = _estimated_noise(
                [p for p in patches_of_camera if p.clipped_share <= CLIPPED_SHARE_MAX], speckle_contrast
            )
    else:
        noise["left"] = noise["right"] = SpotNoise(speckle_contrast=_contrast(speckle_contrast))
        rectified["left"], rectified["right"] = rectified_pair(campaign.stereo_pair)
    if overlay is not None:
        make_folder(overlay)
    return _Looks(spots, frames, noise, patches, rectified, overlay)


def _final_noise(
    noise: dict[str, SpotNoise], pairs: Sequence[tuple[Centre, Centre]], speckle_contrast: float | None
) -> dict[str, SpotNoise]:
    """The noise of each camera from all of its spots."""
    result = dict(noise)
    for number, camera in enumerate(CAMERAS):
        usable = [pair[number] for pair in pairs if pair[number].status in ("ok", "misshapen")]
        skews = [centre.skews for centre in usable if centre.skews is not None]
        wide = all(min(centre.axes_px) >= WIDE_SD_PX for centre in usable)
        if len(skews) >= SHAPE_SPOTS_MIN or (skews and not wide):
            table = np.stack(skews)
            result[camera] = learn_noise(table[:: -(-len(table) // SKEW_SPOTS_MAX)], speckle_contrast)
    return result


def _pilots(spots: Sequence[Spot], present: Sequence[int], frames: _Frames, workers: int) -> dict[int, _Patches]:
    """Left and right patch, or the reason for none, of looks spread evenly over the campaign, by row of spots.csv."""
    rows = [present[k] for k in np.unique(np.linspace(0, len(present) - 1, PILOT_LOOKS_MAX).astype(int))]

    def patches(row: int) -> _Patches:
        return patch_around(frames.read(spots[row], "left")), patch_around(frames.read(spots[row], "right"))

    return dict(zip(rows, _threaded(patches, rows, workers), strict=True))


def _rows(
    spots: Sequence[Spot], present: Sequence[int], centres: Sequence[tuple[Centre, Centre]], stereo: Stereo
) -> list[Spot]:
    """All rows of spots.csv, those in `present` with their centres (left, right); off their epipolar line refused."""
    rows = list(spots)
    matched: list[tuple[int, Located, Located]] = []
    for row, (left, right) in zip(present, centres, strict=True):
        rows[row] = _row(rows[row], left, right)
        if rows[row].status == "ok":
            matched.append((row, left.located, right.located))
    pixels, covariances = np.zeros((len(matched), 4)), np.zeros((len(matched), 4, 4))
    for place, (_, left_spot, right_spot) in enumerate(matched):
        pixels[place] = *left_spot.centre_px, *right_spot.centre_px
        covariances[place, :2, :2], covariances[place, 2:, 2:] = left_spot.covariance_px2, right_spot.covariance_px2
    refused = epipolar_refused(pixels, covariances, stereo)
    for (row, _, _), is_refused in zip(matched, refused, strict=True):
        if is_refused:
            rows[row] = replace(rows[row], status="epipolar")
    return rows


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
        return mean_noise([measured_noise(patch).noise for patch in patches])
    noise = SpotNoise(speckle_contrast=0.0 if wide else _contrast(speckle_contrast))
    for _ in range(LEARNING_ROUNDS):
        fits = [(fitted, patch) for patch in patches if (fitted := fit_spot(patch, noise)) is not None]
        if not fits:
            return noise
        noise = learn_noise(np.stack([skewness(*pair) for pair in fits]), speckle_contrast)
    return noise


def _overlay_of(picture: np.ndarray, centre: Centre) -> np.ndarray:
    """An enlarged picture of a spot: outline green, centre red, reason of a refusal in words (Figure 9)."""
    import cv2

    if picture.dtype != np.uint8:
        picture = np.clip(np.rint(picture), 0, 255).astype(np.uint8)
    half, zoom = OVERLAY_HALF_PX, OVERLAY_ZOOM
    height, width = picture.shape[:2]
    middle = centre.centre_px
    if middle is None:
        outline = centre.outline_px
        middle = np.array([width, height]) / 2 if outline is None or not len(outline) else outline.mean(axis=0)
    corner = np.clip(np.round(middle).astype(int) - half, 0, np.maximum((width, height) - np.array(2 * half), 0))
    crop = picture[corner[1] : corner[1] + 2 * half, corner[0] : corner[0] + 2 * half]
    crop = cv2.copyMakeBorder(crop, 0, 2 * half - crop.shape[0], 0, 2 * half - crop.shape[1], cv2.BORDER_CONSTANT)
    large = cv2.resize(crop, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST)
    if centre.outline_px is not None and len(centre.outline_px):
        outline = np.round((centre.outline_px - corner + 0.5) * zoom).astype(np.int32)
        cv2.polylines(large, [outline.reshape(-1, 1, 2)], True, (0, 255, 0), 1, cv2.LINE_AA)
    if centre.centre_px is not None:
        dot = np.round((centre.centre_px - corner + 0.5) * zoom).astype(int)
        cv2.circle(large, tuple(map(int, dot)), zoom // 2, (0, 0, 255), -1, cv2.LINE_AA)
    if centre.status != "ok":
        cv2.putText(
            large, centre.status, (zoom, 3 * zoom), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (0, 255, 255), 1, cv2.LINE_AA
        )
    return large
