"""The classic estimator of a head: a pointing model by least squares, with ratios and terms and gears without error.

All sightings have equal weight; the two residuals of each are angles on the sphere. Degrees, deg/step. No JAX.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tvsbayes.display import Shown, View
from tvsbayes.errors import NothingToEstimate, refusal
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import Campaign, ordered_spots
from tvsbayes.instrument.chains import chain_of
from tvsbayes.instrument.mechanisms import SIGHTING_HEAD
from tvsbayes.instrument.parameters import BLOCKS, TERMS
from tvsbayes.instrument.sightings import SIGHTINGS, Sighting, sighted_deg, sightings_of, tangent_frames

STEPS_MAX = 50
SETTLED = 1e-9
"""Change of every parameter, in its standard errors or as a share of itself, at which the Gauss-Newton steps end."""
COMPLEX_STEP = 1e-20
RATIO_KNOWN = 1e-4
"""Relative u below which a ratio is held fixed (encoder on the axis); elevation zero and both flexures act alike."""
RATIOS = tuple(f"degrees_per_step.{axis}" for axis in AXES)
ZEROS = ("azimuth_zero_deg", "elevation_zero_deg")
OWN_SHARE = 1e-6
"""Share of an unknown's effect on the sightings that no earlier unknown has: with less it is not determined."""


@dataclass(frozen=True, repr=False)
class PointingModel(Shown):
    """The least-squares estimate of a head's pointing model.

    Attributes:
        names: ratios and terms that the priors do not fix.
        value: their estimates, in the units of the names.
        standard_error: from the scatter of the residuals.
        residual_deg: observed minus predicted along azimuth and elevation on the sphere, shape (n, 2), in time order.
        known: ratios and terms that were held fixed.
        undetermined: those of `known` that the sightings cannot separate from others, as where an axis never moved.
    """

    names: tuple[str, ...]
    value: np.ndarray
    standard_error: np.ndarray
    residual_deg: np.ndarray
    known: dict[str, float]
    undetermined: tuple[str, ...] = ()

    @property
    def rms_deg(self) -> float:
        """Root mean square distance on the sphere."""
        return float(np.sqrt(np.mean(np.sum(self.residual_deg**2, axis=1))))

    def shown(self) -> View:
        """Show ratios and terms."""
        title = f"Pointing model by least squares, {len(self.residual_deg)} sightings, RMS {self.rms_deg:.3g} deg"
        rows = zip(self.names, self.value.tolist(), self.standard_error.tolist(), strict=True)
        return View(title, ("term", "value", "standard error"), list(rows))

    def off_deg(self, campaign: Campaign, rows: Sequence[Sighting]) -> np.ndarray:
        """Observed minus predicted for any sightings, shape (n, 2)."""
        values = self.known | dict(zip(self.names, self.value.tolist(), strict=True))
        return _off_deg(values, _steps(campaign, rows), tangent_frames(sighted_deg(rows))).real

    def as_json(self) -> dict[str, object]:
        """The document of `classic --json`."""
        terms = {
            name: {"value": float(value), "standard_error": float(error)}
            for name, value, error in zip(self.names, self.value, self.standard_error, strict=True)
        }
        held = {name: self.known[name] for name in self.undetermined}
        counts = {"sightings": len(self.residual_deg), "rms_deg": self.rms_deg}
        return {"kind": "pointing-model", "terms": terms, "undetermined": held, **counts}


def _steps(campaign: Campaign, rows: Sequence[Sighting]) -> np.ndarray:
    moves = [campaign.moves[row.move] for row in rows]
    return np.array([(move.pan_steps, move.tilt_steps) for move in moves], float).reshape(-1, 2)


def _off_deg(values: dict[str, float | complex], steps: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Observed minus predicted on the sphere, shape (n, 2); complex where a value is."""
    pan, tilt = (np.radians(1.0) * values[name] * steps[:, k] for k, name in enumerate(RATIOS))
    values = {**SIGHTING_HEAD.constants, **values}

    def block(name: str) -> Any:
        parts = [values[each] * np.radians(1.0) for each in BLOCKS[name]]
        return parts if len(parts) > 1 else parts[0]

    optics = chain_of(SIGHTING_HEAD, block)
    sight = optics.leaving(pan, tilt + np.radians(1.0) * values["elevation_zero_deg"], np).direction
    sighted = np.stack(np.broadcast_arrays(*sight), axis=1)
    across, above, along = (np.sum(frames[:, k] * sighted, axis=1) for k in range(3))
    # For small angles tangent and angle agree; for large ones the tangent plane still gives the direction.
    return -np.degrees(1.0) * np.stack([across, above], axis=1) / np.maximum(along.real, 0.5)[:, None]


def _slope(
    values: dict[str, float | complex], names: Sequence[str], steps: np.ndarray, frames: np.ndarray
) -> np.ndarray:
    """Derivatives of the residuals by the unknowns, shape (2 n, unknowns)."""
    off = [_off_deg(values | {name: values[name] + 1j * COMPLEX_STEP}, steps, frames).imag.ravel() for name in names]
    return np.stack(off, axis=1) / COMPLEX_STEP


def _determined(names: Sequence[str], slope: np.ndarray) -> tuple[str, ...]:
    """The unknowns whose effect is not a combination of the effects of earlier ones, ratios and zeros being first."""
    first = (*RATIOS, *ZEROS)
    own = np.zeros((len(slope), 0))
    kept = set()
    for name in sorted(names, key=lambda name: name not in first):
        effect = slope[:, names.index(name)]
        rest = effect - own @ (own.T @ effect)
        # Twice is enough (Kahan): the first projection leaves rounding errors of the size of the effect.
        rest -= own @ (own.T @ rest)
        if np.linalg.norm(rest) > OWN_SHARE * np.linalg.norm(effect):
            own = np.column_stack([own, rest / np.linalg.norm(rest)])
            kept.add(name)
    return tuple(name for name in names if name in kept)


def pointing_model(campaign: Campaign) -> PointingModel:
    """Fit ratios and terms by least squares; those that the sightings do not determine keep their stated values.

    Args:
        campaign: campaign of a head, with sightings.

    Raises:
        InputError: the campaign has no sightings.
        NothingToEstimate: fewer residuals than unknowns.
    """
    mechanism, priors = campaign.rig.mechanism, campaign.rig.priors
    if not mechanism.sightings:
        allowed = "a campaign of a head with sightings"
        remedy = "`tvsbayes classic` of spots needs four-point experiments"
        raise refusal("no-sightings", file="spots.csv", found="spots", allowed=allowed, remedy=remedy)
    rows = sightings_of(ordered_spots(campaign))
    terms = [term.name for term in TERMS if term.name in priors]
    values: dict[str, float | complex] = {name: priors[name].value for name in (*RATIOS, *terms)}
    unknown = tuple(n for n in values if priors[n].u > (RATIO_KNOWN * abs(priors[n].value) if n in RATIOS else 0.0))
    steps, angles = _steps(campaign, rows), sighted_deg(rows)
    if 2 * len(rows) <= len(unknown):
        raise NothingToEstimate(
            "too-few-sightings",
            f"{len(rows)} sightings are fewer than {len(unknown)} unknowns ask for",
            file=SIGHTINGS.file,
            remedy="sight more directions",
        )
    frames = tangent_frames(angles)
    names = _determined(unknown, _slope(values, unknown, steps, frames))
    if "azimuth_zero_deg" in names:
        # Start on the turn nearest to the prior.
        zero = priors["azimuth_zero_deg"].value
        ahead = np.exp(1j * np.radians(angles[:, 0] - priors[RATIOS[0]].value * steps[:, 0] - zero))
        values["azimuth_zero_deg"] = zero + float(np.degrees(np.angle(ahead.mean())))
    errors = np.ones(len(names))
    for _ in range(STEPS_MAX):
        off = _off_deg(values, steps, frames).real.ravel()
        slope = _slope(values, names, steps, frames)
        # Columns are scaled: a ratio acts over thousands of steps, a term by its own angle.
        size = np.linalg.norm(slope, axis=0)
        change = np.linalg.lstsq(slope / size, -off, rcond=None)[0]
        change = change / size
        values |= {n: values[n] + c for n, c in zip(names, change.tolist(), strict=True)}
        scatter = float(np.sum((off + slope @ change) ** 2)) / (len(off) - len(names))
        inverse = np.linalg.pinv((slope / size).T @ (slope / size)) / np.outer(size, size)
        errors = np.sqrt(scatter * np.diag(inverse))
        if np.all(np.abs(change) <= SETTLED * np.maximum(errors, np.abs([values[n] for n in names]))):
            break
    residual = _off_deg(values, steps, frames).real
    fitted = np.array([float(np.real(values[n])) for n in names])
    known = {n: float(np.real(v)) for n, v in values.items() if n not in names}
    return PointingModel(names, fitted, errors, residual, known, tuple(n for n in unknown if n not in names))
