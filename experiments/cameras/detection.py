"""How far from the best possible are the centres of `detect`, and is the stated uncertainty true?

    python -m experiments.cameras.detection run
    python -m experiments.cameras.detection table > experiments/cameras/detection.md

Per cell of a grid over spot size, exposure, ambient light and speckle: pictures of 200 x 160 px with a known centre at
random sub-pixel places, both methods, the Cramer-Rao bound of the same picture, stated against actual error. Rows go to
`experiments/output/cameras/` as they come; a cell that is there is not run again. Also: what the linear map of the
twin's spots leaves out.
"""

from __future__ import annotations

import argparse
import itertools
from dataclasses import replace

import numpy as np

from experiments.common.command_line import study
from experiments.common.page import heading, line
from experiments.common.rigs import mounted_rig, shipped_plan
from tvsbayes.cameras import contour, detection, spot_fit, spot_noise, spot_window
from tvsbayes.instrument.stereo_pair import Stereo
from tvsbayes.twin import spot_pictures
from tvsbayes.twin.physics import cameras_of
from tvsbayes.twin.simulated_campaign import simulate
from tvsbayes.twin.spot_pictures import Footprint, Scene, Sensor, ambient_level, render_spot, spot_irradiance

WIDTH, HEIGHT = 200, 160
SIZES_PX, PEAKS_DN, AMBIENTS_DN = (1.5, 2.5, 4.0), (60.0, 180.0, 330.0, 600.0), (12.0, 60.0)
CONTRASTS = (0.0, 0.4, 0.2, 0.6)
PICTURES = 120
METHODS, END = ("fit", "contour"), "ok | contour px | contour/bound | contour actual/stated | ok"


def tasks(_: argparse.Namespace) -> list[tuple[float, float, float, float]]:
    """Every cell of the grid: (size, peak, ambient, contrast)."""
    grid = itertools.product(CONTRASTS, SIZES_PX, PEAKS_DN, AMBIENTS_DN)
    return [(*others, contrast) for contrast, *others in grid]


def bound_px(mark, scene, sensor) -> float:
    """Root of the mean Cramer-Rao bound of u and v for the nine parameters of spot and background, px.

    Of the photosites: normal noise of variance read^2 + 1/12 + gain * light + (contrast * spot)^2, taken at the true
    values, whose slopes alone inform (for gamma speckle without other noise that is the exact information); photosites
    whose mean is clipped are left out.
    """
    response = spot_pictures.mosaic_response(WIDTH, HEIGHT, sensor.response).astype(float)
    ambient = ambient_level(WIDTH, HEIGHT, scene.ambient_dn, scene.ambient_gradient_dn).astype(float)
    window, light = spot_irradiance(mark, WIDTH, HEIGHT)
    rows, columns = window
    response, ambient = response[window], ambient[window]
    x = np.arange(columns.start, columns.stop) - mark.centre_px[0] + np.zeros(light.shape)
    y = np.arange(rows.start, rows.stop)[:, None] - mark.centre_px[1] + np.zeros(light.shape)
    slopes = [light]
    for step in ((1e-4, 0), (0, 1e-4)):
        ends = []
        for sign in (1, -1):
            moved = type(mark)(mark.centre_px + sign * np.array(step), mark.covariance_px2, mark.peak_dn)
            full = np.zeros((HEIGHT, WIDTH))
            place, values = spot_irradiance(moved, WIDTH, HEIGHT)
            full[place] = values
            ends.append(full[window])
        slopes.append((ends[0] - ends[1]) / 2e-4)
    slopes += [light * x * x, light * x * y, light * y * y, np.ones(light.shape), x, y]
    mean = sensor.black_dn + response * (ambient + light)
    unsaturated = mean < 255
    variance = sensor.read_noise_dn**2 + 1 / 12 + sensor.gain_dn_per_electron * response * (ambient + light)
    variance = variance + (scene.speckle_contrast * response * light) ** 2
    jacobian = np.stack([(response * s)[unsaturated] for s in slopes], axis=1)
    scale = np.linalg.norm(jacobian, axis=0)
    information = (jacobian / scale).T @ (jacobian / scale / variance[unsaturated][:, None])
    covariance = np.linalg.inv(information) / np.outer(scale, scale)
    return float(np.sqrt((covariance[1, 1] + covariance[2, 2]) / 2))


def flat_stereo():
    """A camera without distortion: rectified pictures are raw ones, so that `contour` needs one picture only."""
    matrix = np.array([[200.0, 0, 100.0], [0, 200.0, 80.0], [0, 0, 1.0]])
    none = np.zeros(5)
    turn, arm = np.eye(3), np.array([-85.0, 0, 0])
    return Stereo(WIDTH, HEIGHT, matrix, none, matrix, none, turn, arm, np.zeros((24, 24)), 0.1)


def run_cell(task: tuple[float, float, float, float]) -> dict:
    """One cell: errors, stated sds and the bound."""
    size, peak, ambient, contrast = task
    seed = 1000 + tasks(argparse.Namespace()).index(task)
    rng = np.random.default_rng(seed)
    scene, sensor = Scene(ambient_dn=ambient, ambient_gradient_dn=ambient / 2, speckle_contrast=contrast), Sensor()
    pictures, truth, bounds = [], [], []
    for k in range(PICTURES):
        centre = np.array([WIDTH / 2, HEIGHT / 2]) + rng.uniform(-5, 5, 2)
        c, s = np.cos(angle := rng.uniform(0, np.pi)), np.sin(angle)
        turn = np.array([[c, -s], [s, c]])
        mark = Footprint(centre, turn @ np.diag([1.2 * size**2, size**2 / 1.2]) @ turn.T, peak)
        pictures.append(render_spot(mark, WIDTH, HEIGHT, scene, sensor, (seed, k, 0)))
        truth.append(centre)
        if k < 20:
            bounds.append(bound_px(mark, scene, sensor))
    row = {"size": size, "peak": peak, "ambient": ambient, "contrast": contrast, "bound": float(np.mean(bounds))}
    patches = [spot_window.patch_around(picture) for picture in pictures]
    camera = contour.rectified_pair(flat_stereo())[0]
    pilots = [one for one in patches[: detection.PILOT_LOOKS_MAX] if not isinstance(one, str)]
    unclipped = [one for one in pilots if one.clipped_share <= spot_window.CLIPPED_SHARE_MAX]
    learned = detection._estimated_noise(unclipped, None)
    for method in METHODS:
        if method == "fit":
            centres = [spot_fit.centre_of(patch, learned) for patch in patches]
            learned = spot_noise.learn_noise(np.stack([one.skews for one in centres if one.status == "ok"]))
            centres = [one.under(learned) for one in centres]
            row["learned"] = [learned.gain_dn, learned.speckle_contrast]
        else:
            centres = [
                contour.contour_of(picture, camera, spot_noise.SpotNoise(speckle_contrast=contrast))
                for picture in pictures
            ]
        ok = [k for k, one in enumerate(centres) if one.status == "ok"]
        errors = np.array([centres[k].centre_px - truth[k] for k in ok]).reshape(-1, 2)
        stated = np.array([np.diag(centres[k].covariance_px2) for k in ok]).reshape(-1, 2)
        row[method] = {"ok": len(ok)}
        if len(ok) > 10:
            # The error that goes with where in its pixel the spot lies: what no averaging of looks removes.
            phase = np.concatenate(
                [np.sin(2 * np.pi * np.array(truth)[ok]), np.cos(2 * np.pi * np.array(truth)[ok])], 1
            )
            row[method] |= {
                "rms": float(np.sqrt(np.mean(errors**2))),
                "stated": float(np.sqrt(np.mean(stated))),
                "mean": errors.mean(axis=0).tolist(),
                "ratio": float(np.sqrt(np.mean(errors**2 / stated))),
                "phase": float(np.abs([np.mean(errors[:, i] * phase[:, i]) for i in (0, 1)]).max() * 2),
            }
    return row


def beyond_linear() -> list[tuple[float, float]]:
    """(spot sd, largest shift) px: exact centroid of the paper twin's spots less the projection of the beam's axis."""
    twin = simulate(mounted_rig(), shipped_plan("paper"), 1)
    camera = cameras_of(twin.truth.stereo).left
    nodes, weights = np.polynomial.hermite_e.hermegauss(12)
    result = []
    for radius in (0.4, 0.8, 1.6):
        sds, shifts = [], []
        for row in range(0, 384, 8):
            point, beam, normal = (a[row] for a in (twin.light.points_mm, twin.light.directions, twin.light.normals))
            mark = spot_pictures.footprint(camera, point, beam, normal, replace(Scene(), beam_sd_mm=radius), 0.0)
            side = np.linalg.svd(beam[None])[2][1:]
            offsets = radius * (nodes[:, None, None] * side[0] + nodes[None, :, None] * side[1]).reshape(-1, 3)
            starts = point + offsets
            hits = starts + ((point - starts) @ normal / (beam @ normal))[:, None] * beam
            pixels = camera.project(np.column_stack((-hits[:, 1], -hits[:, 2], hits[:, 0])))
            share = np.outer(weights, weights).ravel()
            shifts.append(np.abs(share @ pixels / share.sum() - mark.centre_px).max())
            sds.append(np.sqrt(np.trace(mark.covariance_px2) / 2))
        result.append((float(np.mean(sds)), float(np.max(shifts))))
    return result


TEXT = f"""# Spot centres against the Cramer-Rao bound

`python -m experiments.cameras.detection run`, {PICTURES} pictures a cell, fixed seeds; errors are root mean \
squares of u and v in px; actual/stated is the root mean square of error over stated sd. Peak in DN above \
black: 330 and 600 are clipped at 251. `fit` learns the noise from the pictures of the cell, `contour` is \
told the true contrast.

{heading("spot sd px | peak DN | ambient DN | contrast | bound px | fit px | fit/bound | fit actual/stated", END)}"""


def cells_of(r: dict) -> list[str]:
    """A cell's line of the table."""
    cells = [f"{r[key]:g}" for key in ("size", "peak", "ambient", "contrast")] + [f"{r['bound']:.4f}"]
    for one in (r[method] for method in METHODS):
        known = "rms" in one
        cells += [f"{one['rms']:.4f}", f"{one['rms'] / r['bound']:.2f}", f"{one['ratio']:.2f}"] if known else [""] * 3
        cells.append(str(one["ok"]))
    return cells


def summary(rows: list[dict]) -> str:
    """The grid in a few lines."""
    lines = []
    chance = 1 / np.sqrt(4 * PICTURES)
    for method in METHODS:
        for name, chosen in (
            ("without speckle", lambda r: not r["contrast"]),
            ("with speckle", lambda r: r["contrast"]),
        ):
            cells = [r for r in rows if chosen(r) and "rms" in r[method]]
            ratio = np.array([r[method]["ratio"] for r in cells])
            loss = np.array([r[method]["rms"] / r["bound"] for r in cells])
            lines.append(
                f"- `{method}` {name}, {len(cells)} cells: actual/stated sd median {np.median(ratio):.2f}, "
                f"{ratio.min():.2f} to {ratio.max():.2f} (chance alone: +- {2 * chance:.2f}); outside 1 +- 0.10 "
                f"{np.sum(np.abs(ratio - 1) > 0.10)}, outside 1 +- 0.25 {np.sum(np.abs(ratio - 1) > 0.25)}; "
                f"error/bound median {np.median(loss):.2f}, {loss.min():.2f} to {loss.max():.2f}"
            )
    for method in METHODS:
        cells = [r for r in rows if "rms" in r[method]]
        sds = [np.abs(r[method]["mean"]).max() / r[method]["rms"] * np.sqrt(r[method]["ok"]) for r in cells]
        phase = np.median([r[method]["phase"] for r in cells if not r["contrast"]])
        pixels = [np.abs(r[method]["mean"]).max() for r in cells]
        lines.append(
            f"- bias of `{method}`: mean error of a cell at most {max(pixels):.4f} px ({max(sds):.1f} of its standard "
            f"errors; 2.9 expected of {2 * len(cells)}); part that follows the place in the pixel, without speckle: "
            f"{phase:.4f} px"
        )
    return "\n".join(lines)


def table(rows: list[dict]) -> None:
    print(TEXT)
    for row in sorted(rows, key=lambda r: (r["size"], r["contrast"], r["peak"], r["ambient"])):
        print(line(*cells_of(row)))
    print(f"\n{summary(rows)}")
    print("\nLeft out by the twin's linear map of a spot (paper twin, left camera, largest of 48 looks):\n")
    for sd, shift in beyond_linear():
        print(f"- spot sd {sd:.1f} px: {shift:.4f} px")


if __name__ == "__main__":
    study(__file__, __doc__, run_cell, ("size", "peak", "ambient", "contrast"), tasks, table)
