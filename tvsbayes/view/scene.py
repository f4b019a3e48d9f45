"""Content of a campaign's page: the looks as columns, the rig, the results of a fit; independent of a browser.

It is computed from a campaign and its fit, if any; the module does not depend on how a page is served. Frame S, mm; px;
deg; counters in steps. Unknown values are NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tvsbayes.estimators.campaign_arrays import campaign_arrays
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.instrument.axes import AXES, direction_of
from tvsbayes.instrument.campaign import (
    CAMERAS,
    PIXELS,
    Campaign,
    frame_name,
    ordered_spots,
    pixels_of,
    read_campaign,
    stereo_spots,
)
from tvsbayes.instrument.parameters import unit_of
from tvsbayes.instrument.stops import rests_of
from tvsbayes.model.parameter_space import parameter_space
from tvsbayes.pipeline import StoredOrFitted, Tell, compile_for, no_output
from tvsbayes.posterior.predictive import turned_by
from tvsbayes.report.evidence import GearBand, gear_bands
from tvsbayes.results.comparison_record import Comparison
from tvsbayes.results.estimates import StopResidual
from tvsbayes.results.fit_record import FitRecord
from tvsbayes.results.store import FIT
from tvsbayes.view.laser_ways import Ways, laser_ways
from tvsbayes.view.shapes import (
    PYRAMID_MM,
    PYRAMID_SHARE,
    Pyramid,
    Sheet,
    ellipsoid_axes_mm,
    point_covariance_mm2,
    pyramids,
    sheets,
)


@dataclass(frozen=True)
class LookColumns:
    """All looks of a campaign in the order of `spots.csv`, one row each.

    Attributes:
        spot, move: numbers of spot and move, shape (n,).
        target, status: entries of the table, n texts.
        direction: directions of the preceding moves of (pan, tilt), n pairs; "" where the approach is unknown.
        steps: counters (pan, tilt), shape (n, 2).
        pictures: whether the left and the right picture is kept, shape (n, 2).
        pixels_px, sd_px: centres found and their standard uncertainties, shape (n, 4).
        predicted_px: centres predicted by the fitted rig, at the observed range, shape (n, 4).
        point_mm: triangulated spot, shape (n, 3).
        ellipsoid_mm: half axes of its 95 % ellipsoid from pixel noise, shape (n, 3, 3).
        mirrors_mm, normals: points where the laser meets the mirrors, and their unit normals, shape (n, mirrors, 3).
        end_mm: point of the beam at the spot, shape (n, 3).
        deviation_deg, u_deg: observed minus fitted mirror angle of the stops of (pan, tilt), and its sd, shape (n, 2).
        suspect: whether the fit flags the look as suspect, or left it out, shape (n,).
    """

    spot: np.ndarray
    move: np.ndarray
    target: tuple[str, ...]
    status: tuple[str, ...]
    direction: tuple[tuple[str, str], ...]
    steps: np.ndarray
    pictures: np.ndarray
    pixels_px: np.ndarray
    sd_px: np.ndarray
    predicted_px: np.ndarray
    point_mm: np.ndarray
    ellipsoid_mm: np.ndarray
    mirrors_mm: np.ndarray
    normals: np.ndarray
    end_mm: np.ndarray
    deviation_deg: np.ndarray
    u_deg: np.ndarray
    suspect: np.ndarray


@dataclass(frozen=True)
class ParameterRow:
    """A parameter in the list of a page: its estimate, or its prior without a fit.

    `contraction` is the share of the prior's variance that the data removed; None for priors and fixed parameters.
    """

    name: str
    unit: str
    value: float
    sd: float
    contraction: float | None


@dataclass(frozen=True)
class Scene:
    """A campaign for display.

    Attributes:
        name: name of the campaign.
        fitted: whether results give residuals, a fitted rig and correlations; else the rig is the stated one.
        notes: remarks for the reader.
        image_px: width and height of the pictures.
        looks: all looks.
        cameras: left and right.
        sheets: sheets estimated from spots.
        origin_mm: origin of the positioner on its pan axis, shape (3,); NaN without a usable look.
        gears: repeatable errors of the gears over the counters; none where they do not vary.
        parameters: values with their uncertainty.
        correlated: names of the rows and columns of `correlation`.
        correlation: correlation of the estimated parameters, shape (p, p).
    """

    name: str
    fitted: bool
    notes: tuple[str, ...]
    image_px: tuple[int, int]
    looks: LookColumns
    cameras: tuple[Pyramid, ...]
    sheets: tuple[Sheet, ...]
    origin_mm: np.ndarray
    gears: tuple[GearBand, ...]
    parameters: tuple[ParameterRow, ...]
    correlated: tuple[str, ...]
    correlation: np.ndarray


@dataclass(frozen=True)
class Looked:
    """Content of a page: one campaign, or two with the changes between them."""

    scenes: tuple[Scene, ...]
    changes: Comparison | None = None


@dataclass(frozen=True)
class Fitted:
    """Results of a fit used in a scene.

    Attributes:
        fit: mode, residuals, linearised campaign.
        record: estimates and covariance.
        stops: deviations of all rests.
        gears: curves of the gears' errors.
    """

    fit: JointFit
    record: FitRecord
    stops: tuple[StopResidual, ...]
    gears: tuple[GearBand, ...]


def scene(campaign: Campaign, fitted: Fitted | None = None, notes: Sequence[str] = ()) -> Scene:
    """Make the scene of a campaign.

    Args:
        campaign: campaign with or without usable spots.
        fitted: results of exactly this campaign; None shows the rig stated in `campaign.toml`.
        notes: remarks for the reader.
    """
    ways = _ways(campaign, fitted)
    looks = LookColumns(**_of_tables(campaign), **_of_rig(campaign, ways, fitted))
    seen_mm = looks.point_mm[np.isfinite(looks.point_mm).all(axis=1)]
    reach_mm = float(np.median(np.linalg.norm(seen_mm, axis=1))) if len(seen_mm) else 0.0
    names, correlation = _correlation(fitted)
    return Scene(
        name=campaign.title,
        fitted=fitted is not None,
        notes=tuple(notes),
        image_px=(campaign.stereo_pair.image_width, campaign.stereo_pair.image_height),
        looks=looks,
        cameras=pyramids(campaign.stereo_pair, PYRAMID_SHARE * reach_mm or PYRAMID_MM),
        sheets=sheets(looks.target, looks.point_mm),
        origin_mm=np.full(3, np.nan) if ways is None else np.asarray(ways.origin_mm)[:, 0],
        gears=() if fitted is None else fitted.gears,
        parameters=_parameters(campaign, fitted),
        correlated=names,
        correlation=correlation,
    )


def _ways(campaign: Campaign, fitted: Fitted | None) -> Ways | None:
    """Paths of the usable spots in the order of the filter; None without spots."""
    if not any(spot.status == "ok" for spot in campaign.spots):
        return None
    if fitted is None:
        arrays = campaign_arrays(campaign)
        turned, space = np.zeros((int(arrays.count), 2)), parameter_space(campaign.rig, campaign.stereo)
        return laser_ways(np.zeros(space.size), turned, space, arrays)
    fit = fitted.fit
    turned = turned_by(fit.arrays, np.asarray(fit.mode.place_errors_rad)[None])[0]
    return laser_ways(fit.z, turned, fit.space, fit.arrays)


def _of_tables(campaign: Campaign) -> dict[str, Any]:
    """Columns of looks from the tables and the folder."""
    spots, frames = stereo_spots(campaign.spots), set[str]()
    if campaign.path is not None and (campaign.path / "frames").is_dir():
        frames = {f"frames/{path.name}" for path in (campaign.path / "frames").iterdir()}
    at = [campaign.moves[spot.move] for spot in spots]
    signs = {axis: rests_of(campaign.moves, axis) for axis in AXES}
    counted = [spot.status == "ok" for spot in spots]
    sds = [
        [getattr(spot, f"s{name}") if ok else None for name in PIXELS] for spot, ok in zip(spots, counted, strict=True)
    ]
    return {
        "spot": np.array([spot.spot for spot in spots], dtype=int),
        "move": np.array([spot.move for spot in spots], dtype=int),
        "target": tuple(spot.target for spot in spots),
        "status": tuple(spot.status for spot in spots),
        "direction": tuple(tuple(direction_of(a, signs[a][spot.move].sign) for a in AXES) for spot in spots),
        "steps": np.array([(move.pan_steps, move.tilt_steps) for move in at], dtype=int).reshape(-1, 2),
        "pictures": np.array([[frame_name(s.spot, c) in frames for c in CAMERAS] for s in spots], bool).reshape(-1, 2),
        "sd_px": np.array(sds, dtype=float).reshape(-1, 4),
    }


_WAY_SHAPES = {"mirrors_mm": (0, 3), "normals": (0, 3), "end_mm": (3,), "predicted_px": (4,)}
"""Shapes of values of a look, where the campaign has no usable spot."""


def _of_rig(campaign: Campaign, ways: Ways | None, fitted: Fitted | None) -> dict[str, Any]:
    """Columns of looks from the rig, stated or fitted: NaN where a look has no usable spot."""
    count, used = len(campaign.spots), ordered_spots(campaign)
    row_of = {spot.spot: row for row, spot in enumerate(campaign.spots)}
    rows = np.array([row_of[spot.spot] for spot in used], dtype=int)

    def column(values: np.ndarray) -> np.ndarray:
        laid = np.full((count, *values.shape[1:]), np.nan)
        laid[rows] = values[: len(rows)]
        return laid

    columns = {
        name: column(np.zeros((0, *shape)) if ways is None else np.moveaxis(np.asarray(getattr(ways, name)), -1, 0))
        for name, shape in _WAY_SHAPES.items()
    }
    columns["pixels_px"] = column(pixels_of(used))
    deviation, u = np.full((2, count, 2), np.nan)
    suspect, scale = np.zeros(count, dtype=bool), 1.0
    if fitted is None:
        # Residuals of an unfitted rig would only show its mounting.
        columns["predicted_px"][:] = np.nan
    else:
        scale = fitted.record.summary.parameters["pixel_scale"].value
        suspect[[row_of[spot] for spot in (*fitted.fit.suspect_spots, *fitted.fit.excluded_spots)]] = True
        for stop in fitted.stops:
            place = [row_of[spot] for spot in stop.spots], AXES.index(stop.axis)
            deviation[place], u[place] = stop.deviation_deg, stop.u_deg
    point, covariance = np.zeros((0, 3)), np.zeros((0, 3, 3))
    if used:
        point = campaign.points_mm[rows]
        noise = scale**2 * np.stack([spot.pixel_covariance() for spot in stereo_spots(used)])
        covariance = point_covariance_mm2(campaign.stereo_pair, point, noise)
    ellipsoid = ellipsoid_axes_mm(column(covariance))
    seen = {"point_mm": column(point), "ellipsoid_mm": ellipsoid, "suspect": suspect}
    return {**columns, **seen, "deviation_deg": deviation, "u_deg": u}


def _parameters(campaign: Campaign, fitted: Fitted | None) -> tuple[ParameterRow, ...]:
    """Parameters of the record, headlines first; else the stated priors."""
    if fitted is None:
        stated = campaign.rig.priors
        return tuple(ParameterRow(n, unit_of(n), stated[n].value, stated[n].u, None) for n in stated)
    named = fitted.record.summary.named.items()
    return tuple(ParameterRow(name, unit_of(name), e.value, e.sd, e.contraction) for name, e in named)


def _correlation(fitted: Fitted | None) -> tuple[tuple[str, ...], np.ndarray]:
    """Names and correlations of the estimated parameters, without those of the cameras."""
    if fitted is None:
        return (), np.zeros((0, 0))
    names, matrix = fitted.record.covariance.names, np.asarray(fitted.record.covariance.matrix, dtype=float)
    sds = np.sqrt(np.diag(matrix))
    kept = [k for k, name in enumerate(names) if sds[k] > 0 and not name.startswith("stereo.")]
    return tuple(names[k] for k in kept), matrix[np.ix_(kept, kept)] / np.outer(sds[kept], sds[kept])


NOT_FITTED = "no results: the rig is drawn as campaign.toml states it; `tvsbayes fit` adds residuals and the fitted rig"
NOT_OF_THESE = (
    "results/ are of other data, of a fit that did not converge, or of another version: the rig is drawn as "
    "campaign.toml states it; run `tvsbayes fit` again"
)


class StoredCampaign(NamedTuple):
    """A campaign with its results; where these cannot be used, `fitted` is None and `note` gives the reason."""

    campaign: Campaign
    fitted: Fitted | None
    note: str | None


def stored_campaign(folder: Path) -> StoredCampaign:
    """Read a campaign folder and its results.

    Raises:
        InputError: no campaign, or damaged results.
    """
    campaign = read_campaign(folder)
    results = StoredOrFitted(campaign)
    record, calibration = results.stored_record, results.stored_calibration
    fit = None if record is None else results.stored_fit
    if record is None or calibration is None or fit is None:
        is_fitted = (Path(folder) / "results" / FIT).exists()
        return StoredCampaign(campaign, None, NOT_OF_THESE if is_fitted else NOT_FITTED)
    from tvsbayes.assessment.residuals import stop_residuals

    return StoredCampaign(campaign, Fitted(fit, record, stop_residuals(fit), gear_bands(calibration)), None)


def look_at(folder: Path, beside: Path | None = None, tell: Tell = no_output) -> Looked:
    """Make the content of a campaign's page, with a second campaign where one is named.

    Args:
        folder: folder of the campaign.
        beside: folder of a later campaign of the same instrument.
        tell: shows a line before long work.

    Raises:
        InputError: no campaign, or damaged results.
    """
    compile_for(tell)
    campaigns = [stored_campaign(one) for one in (folder, beside) if one is not None]
    scenes = tuple(scene(campaign, fitted, [note] if note else []) for campaign, fitted, note in campaigns)
    fits = [fitted.fit for _, fitted, _ in campaigns if fitted is not None]
    if len(fits) < 2:
        return Looked(scenes)
    from tvsbayes.comparison.changes import compare

    return Looked(scenes, compare(*fits))
