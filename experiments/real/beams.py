"""Are the stated uncertainties of spot centres true on pictures of real laser beams?

    python -m experiments.real.beams > experiments/real/beams.md

No truth is known, but a law holds: a picture taken apart into every fourth row and column gives sixteen pictures of one
beam, whose centres must agree as they say once the shift between them is undone. z = (centre - mean) / u by picture, 30
degrees of freedom; also even against odd rows and columns alone. Pictures per CPU second, finding and fitting,
beside cv2.imread of the same files.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy import stats

from experiments.common.clock import timed
from experiments.common.command_line import print_only
from experiments.common.figures import page_figure, title_and_figure
from experiments.common.page import heading, line
from tvsbayes.cameras.spot_fit import Centre, find_spot
from tvsbayes.files.images import in_grey_levels, read_image

BEAMS, FIGURE = Path("data/real/spots"), Path("data/docs/real_beams.png")
PARTS = 4
"""Rows and columns are taken apart by so many."""
TURNS = 3


@dataclass(frozen=True)
class Beam:
    """A picture, its spot, and what its parts say: their statuses, and z of the centres of those that are ok."""

    name: str
    picture: np.ndarray
    whole: Centre
    statuses: Counter[str]
    z: np.ndarray
    halves: np.ndarray

    @property
    def rms(self) -> float:
        """RMS of z; the mean was taken from the same centres."""
        return float(np.sqrt(np.sum(self.z**2) / (self.z.size - 2))) if self.z.size > 2 else float("nan")


def parts_of(picture: np.ndarray, rows: int, columns: int) -> list[Centre]:
    """Spots of the parts of a picture, in the pixels of the whole."""
    parts = []
    for row in range(rows):
        for column in range(columns):
            part = find_spot(np.ascontiguousarray(picture[row::rows, column::columns]))
            if part.centre_px is not None and part.covariance_px2 is not None:
                step = np.array([columns, rows])
                centre = part.centre_px * step + [column, row]
                part = Centre(part.status, centre, part.covariance_px2 * np.outer(step, step))
            parts.append(part)
    return parts


def deviations(spots: Sequence[Centre]) -> np.ndarray:
    """Z (n, 2) of centres about their mean, of those that are ok."""
    ok = [one.located for one in spots if one.status == "ok"]
    if len(ok) < 2:
        return np.empty((0, 2))
    centres = np.array([centre for centre, _ in ok])
    sds = np.sqrt([np.diag(covariance) for _, covariance in ok])
    return (centres - centres.mean(axis=0)) / sds


def beam_of(path: Path) -> Beam:
    """A picture with its results."""
    picture = read_image(path)
    sixteen = parts_of(picture, PARTS, PARTS)
    # Two centres: their difference over the root of both variances is twice the first's deviation over root two.
    halves = [np.sqrt(2) * deviations(parts_of(picture, *cut))[:1] for cut in ((2, 1), (1, 2))]
    statuses = Counter(one.status for one in sixteen)
    return Beam(path.stem, picture, find_spot(picture), statuses, deviations(sixteen), np.vstack(halves))


def draw(beams: Sequence[Beam]) -> None:
    """Every picture around its spot, with centre, status and RMS z."""
    with page_figure(FIGURE, 5.6, width_in=7.2) as figure:
        for axes, beam in zip(figure.subplots(3, 3).ravel(), beams, strict=False):
            grey = np.asarray(in_grey_levels(beam.picture), np.float32)[..., 0]
            small = cv2.resize(grey, (160, round(160 * grey.shape[0] / grey.shape[1])), interpolation=cv2.INTER_AREA)
            axes.imshow(np.sqrt(small), cmap="inferno")
            if beam.whole.status == "ok":
                axes.plot(*(beam.whole.located[0] * 160 / grey.shape[1]), "+", color="cyan", markersize=9)
            ((parts, _),) = beam.statuses.most_common(1)
            end = f", RMS z {beam.rms:.2f}" if beam.z.size else f", parts {parts}" * (parts != beam.whole.status)
            axes.set_title(f"{beam.name}: {beam.whole.status}{end}", fontsize=7)
            axes.set_axis_off()


def row(beam: Beam) -> str:
    """A line of the table."""
    bits = 8 if beam.picture.dtype == np.uint8 else 16
    height, width = beam.picture.shape[:2]
    cells = [beam.name, str(bits), f"{width} x {height}", beam.whole.status]
    if beam.whole.status == "ok":
        pairs = (beam.whole.axes_px, ".1f"), (beam.whole.located[0], ".3f")
        pairs += ((np.sqrt(np.diag(beam.whole.located[1])), ".4f"),)
        cells += [f"{u:{form}}, {v:{form}}" for (u, v), form in pairs]
    else:
        cells += ["", "", ""]
    cells.append(", ".join(f"{count} {status}" for status, count in beam.statuses.most_common()))
    if beam.z.size:
        low, high = np.sqrt(stats.chi2(beam.z.size - 2).ppf([0.025, 0.975]) / (beam.z.size - 2))
        cells += [f"{beam.rms:.2f}", f"{low:.2f} to {high:.2f}"]
    else:
        cells += ["", ""]
    cells.append(", ".join(f"{z:+.1f}" for z in beam.halves.ravel()))
    return line(*cells)


TEXT = f"""Written by `python -m experiments.real.beams`: pictures of `{BEAMS}`. Sixteen parts: every fourth row and
column; RMS z of their centres about their mean, with where 95 % of such numbers lie for true uncertainties;
even against odd rows (u, v), then columns (u, v), in stated sds.

{heading("beam | bits | px | whole | sds px | centre px | u px | sixteen parts | RMS z | by chance | even - odd")}"""


def main() -> None:
    print_only(__doc__)
    paths = sorted(BEAMS.glob("*.png"))
    beams = [beam_of(path) for path in paths]
    draw(beams)
    print(title_and_figure(__file__, "Real laser beams", FIGURE, "The beams, with centre, status and RMS z"))
    print(TEXT)
    print("\n".join(row(beam) for beam in beams))
    every = np.concatenate([beam.z for beam in beams if beam.z.size])
    dof = every.size - 2 * sum(bool(beam.z.size) for beam in beams)
    halves = np.concatenate([beam.halves.ravel() for beam in beams])
    print(f"\nAll: RMS z {np.sqrt(np.sum(every**2) / dof):.2f} with {dof} degrees of freedom;", end=" ")
    print(f"even against odd {np.sqrt(np.mean(halves**2)):.2f} of {halves.size}.\n")
    jobs = {
        "read": lambda: [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in paths],
        "found": lambda: [find_spot(read_image(path)) for path in paths],
    }
    rates = {name: len(paths) / min(timed(job)[1]["cpu_s"] for _ in range(TURNS)) for name, job in jobs.items()}
    print(f"Pictures per CPU second: {rates['found']:.0f} read, found and fitted,", end=" ")
    print(f"{rates['read']:.0f} by cv2.imread alone ({rates['found'] / rates['read']:.2f}).")


if __name__ == "__main__":
    main()
