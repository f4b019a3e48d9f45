"""Pictures read in two fields: are even and odd lines of a spot in one place, and is it reported where they are not?

    python -m experiments.real.two_fields > experiments/real/two_fields.md

Real beams (data/real/spots): what alternates between their rows, gain and place. The same with their odd rows moved on
purpose. Pictures of the twin, which read all rows at once: how many are widened.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from experiments.common.command_line import print_only
from experiments.real.beams import BEAMS, deviations, parts_of
from tvsbayes.cameras.spot_fit import Centre, centre_of, measured_noise, widened
from tvsbayes.cameras.spot_noise import SpotNoise
from tvsbayes.cameras.spot_window import Patch, patch_around
from tvsbayes.files.images import in_grey_levels, read_image
from tvsbayes.twin.spot_pictures import Footprint, Scene, Sensor, render_spot

MOVED_PX = (0.05, 0.1, 0.2, 0.5, 2.0)
SPOTS = 1000
SIZES_PX, PEAKS_DN, CONTRASTS = (2.0, 2.5, 4.0, 8.0), (60.0, 200.0, 500.0), (0.0, 0.4)
TEXT = """Written by `python -m experiments.real.two_fields`. Real beams (`data/real/spots`): by how much the odd rows
are brighter; centre of odd less that of even rows (u, v); the same in sds as the two halves state them, each by its own
pixels; in sds of what the stated uncertainty of the whole leads to (twice u, white noise); u of v of the whole. Then
with the odd rows moved down on purpose: how much farther they lie below, u of v, and whether `detect` says so.
"""


def bare(picture: np.ndarray, noise: SpotNoise | None = None) -> Centre:
    """The centre without what alternate lines add; by its own noise where none is given."""
    patch: Patch | str = patch_around(in_grey_levels(picture))
    if noise is None and not isinstance(patch, str):
        noise, background = measured_noise(patch)
        patch = replace(patch, background_variance=background)
    return centre_of(patch, noise or SpotNoise())


def gain_of_odd_rows(picture: np.ndarray, at: np.ndarray) -> float:
    """Light of odd over that of the mean of the even rows around, less 1, within 20 px of a place."""
    grey = in_grey_levels(picture)[..., 0].astype(float)
    floor = np.median(np.concatenate((grey[0], grey[-1], grey[:, 0], grey[:, -1])))
    u, v = (int(x) for x in at)
    part = grey[v - 20 : v + 20, u - 20 : u + 20] - floor
    first = (v - 20) % 2
    odd = part[1 - first :: 2][1:-1].sum() / len(part[1 - first :: 2][1:-1])
    even = part[first::2]
    return float(odd / (even[1:-1].sum() / len(even[1:-1])) - 1)


def with_moved_rows(picture: np.ndarray, by_px: float, seed: int = 23) -> np.ndarray:
    """The picture whose odd rows see the beam so much lower.

    Light is interpolated linearly between rows, which moves a centre by `by_px`; whole grey levels are met by
    chance, unbiased: rounded as they fall, levels of 8 bits would hide a small move.
    """
    rows = np.arange(len(picture))
    above = np.clip(rows - by_px, 0, len(picture) - 1)
    low = np.minimum(above.astype(int), len(picture) - 2)
    share = (above - low).reshape(-1, *[1] * (picture.ndim - 1))
    moved = (1 - share) * picture[low] + share * picture[low + 1]
    moved += np.random.default_rng(seed).uniform(-0.5, 0.5, moved.shape)
    result = picture.copy()
    limits = np.iinfo(picture.dtype)
    result[1::2] = np.clip(np.rint(moved), limits.min, limits.max)[1::2]
    return result


def real_rows() -> None:
    """The real beams as they are, and moved."""
    print("| beam | odd rows brighter by | odd - even rows u, v px | sds of the halves | sds of the whole |", end="")
    print(" u of v px | odd rows moved by " + " | by ".join(f"{px:g} px" for px in MOVED_PX) + " |")
    print("|" + "---|" * (6 + len(MOVED_PX)))
    for path in sorted(BEAMS.glob("*.png")):
        picture = read_image(path)
        spot = bare(picture)
        if spot.status != "ok" or spot.lines_px is None:
            continue
        centre_px, covariance = spot.located
        shift, sds = spot.lines_px[0], np.sqrt(np.diag(covariance))
        # Two halves; the first's deviation from their mean is minus half of odd less even.
        halves = -np.sqrt(2) * deviations(parts_of(picture, 2, 1))[0]
        cells = [path.stem, f"{100 * gain_of_odd_rows(picture, centre_px):.1f} %"]
        cells += [f"{shift[0]:+.3f}, {shift[1]:+.3f}", f"{halves[0]:+.1f}, {halves[1]:+.1f}"]
        cells += [", ".join(f"{z:+.1f}" for z in shift / sds / 2), f"{sds[1]:.4f}"]
        for by in MOVED_PX:
            one = bare(with_moved_rows(picture, by))
            (after,), lines = widened([one])
            if one.status != "ok" or one.lines_px is None:
                cells.append(one.status)
                continue
            u = np.sqrt(after.located[1][1, 1])
            cells.append(f"{one.lines_px[0][1] - shift[1]:.3f}, u {u:.3f}" + (", said" if lines else ""))
        print("| " + " | ".join(cells) + " |")


def twin_row() -> None:
    """How many of the twin's pictures are widened."""
    rng, widened_spots, good, chi2 = np.random.default_rng(22), 0, 0, []
    for number in range(SPOTS):
        sd, peak = rng.choice(SIZES_PX), rng.choice(PEAKS_DN)
        contrast = float(rng.choice(CONTRASTS))
        mark = Footprint(np.array([100.0, 80.0]) + rng.uniform(-1, 1, 2), sd**2 * np.eye(2), float(peak))
        picture = render_spot(mark, 200, 160, Scene(speckle_contrast=contrast), Sensor(), (22, number, 0))
        if number % 2:
            # Every other one as of a monochrome camera whose pixels are photosites: no demosaicing mixes lines.
            picture = mono_picture(mark, contrast, number)
        spot = bare(picture, SpotNoise(Sensor().gain_dn_per_electron, contrast))
        if spot.status == "ok" and spot.lines_px is not None:
            good += 1
            widened_spots += bool(widened([spot])[1])
            inverse = np.linalg.inv(4 * spot.located[1])
            chi2.append((number % 2, float(np.einsum("ki,ij,kj->", spot.lines_px, inverse, spot.lines_px)) / 4))
    of_mono = np.mean([value for mono, value in chi2 if mono])
    of_colour = np.mean([value for mono, value in chi2 if not mono])
    print(f"\n{SPOTS} pictures of spots that were read at once, half of them monochrome: {good} ok,")
    print(f"{widened_spots} widened. Mean chi-square of the difference per coordinate: {of_mono:.2f} monochrome,")
    print(f"{of_colour:.2f} colour.")


def mono_picture(mark: Footprint, contrast: float, seed: int) -> np.ndarray:
    """A spot on a monochrome sensor: light, shot noise and speckle of single pixels, 8 bits."""
    rng = np.random.default_rng((23, seed))
    v, u = np.indices((160, 200))
    offset = np.stack((u - mark.centre_px[0], v - mark.centre_px[1]), axis=-1)
    light = mark.peak_dn * np.exp(-np.einsum("...i,ij,...j", offset, np.linalg.inv(mark.covariance_px2), offset) / 2)
    noisy = light * (1 + contrast * rng.normal(size=light.shape))
    grey = 12 + noisy + rng.normal(size=light.shape) * np.sqrt(1 + Sensor().gain_dn_per_electron * light)
    return np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def main() -> None:
    print_only(__doc__)
    print("# Pictures read in two fields\n")
    print(TEXT)
    real_rows()
    twin_row()


if __name__ == "__main__":
    main()
