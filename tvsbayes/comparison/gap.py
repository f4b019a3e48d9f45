"""Why classic and joint differ."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.errors import NothingToEstimate
from tvsbayes.estimators.four_point import Selection, classic, four_point_ratios, select_experiments
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.parameters import RIG_PRIORS
from tvsbayes.results.comparison_record import Gap, GapTerm

if TYPE_CHECKING:
    from tvsbayes.estimators.joint_fit import JointFit
    from tvsbayes.model.parameter_space import ParameterSpace
    from tvsbayes.posterior.draws import Posterior


GAP_DRAWS = 256
OPTICS = tuple(name for name in RIG_PRIORS if name.startswith(("mirror1", "mirror2", "laser_", "tilt_axis_")))
"""What bends the beam's way through the positioner; all zero in the nominal rig."""
BACKLASH, STEREO_SCALE, SKEW, PROJECTION, CHANCE = (
    "backlash over N",
    "stereo scale and focal scale",
    "skew of mirrors, laser and axes",
    "projection and pose",
    "chance",
)
"""Terms of the gap. The last is what the classic's own spots add: stop errors and pixel noise."""


def _ideal(space: ParameterSpace, names: Sequence[str]) -> ParameterSpace:
    """The priors with parameters fixed at their ideal values: 0, or 1 for the focal scale; cameras as stated."""
    import jax.numpy as jnp

    from tvsbayes.instrument.parameters import INDEX, RIG_NAMES

    rows = jnp.asarray([INDEX[name] for name in names if name in RIG_NAMES])
    ideal = jnp.asarray([1.0 if name == "focal_scale" else 0.0 for name in names if name in RIG_NAMES])
    space = replace(space, value=space.value.at[rows].set(ideal), u=space.u.at[rows].set(0.0))
    if "focal_scale" in names:
        space = replace(space, stereo_root=jnp.zeros_like(space.stereo_root))
    return space


def explain_gap(found: JointFit, posterior: Posterior | None = None, draws: int = GAP_DRAWS) -> dict[str, Gap | None]:
    """The gap between both estimators, term by term (DESIGN 1).

    On every draw the model takes the classic estimator's spots without noise, and again without backlash, then with
    the stated cameras in place of the true ones, then with ideal optics. Each change of the classic mean is one
    term; what then still separates it from the ratio of the ideal optics is projection: the tilt read as
    atan(dZ/dX) off the X axis, the offset of the mirrors, poses other than the reference. Terms depend little on
    their order, and they add up.

    Args:
        found: a converged fit of the campaign.
        posterior: its sample, for its draws in place of the Laplace approximation's.
        draws: that the intervals of the terms rest on, at least two; ratio and gap rest on all.

    Returns:
        By direction; None without complete experiments.
    """
    import jax
    import jax.numpy as jnp

    from tvsbayes.model.headlines import derived_quantities
    from tvsbayes.posterior.predictive import looks

    selection = select_experiments(found.campaign)
    result: dict[str, Gap | None] = dict.fromkeys(DIRECTIONS)
    if not len(selection.experiments):
        return result
    if posterior is None:
        z = np.vstack([found.z, found.draws_z[:draws]])
        ratios_of_all = found.draws.effective_deg_per_step
    else:
        every = posterior.z.reshape(-1, posterior.z.shape[-1])
        z = every[np.linspace(0, len(every) - 1, draws).astype(int)]
        ratios_of_all = posterior.draws.effective_deg_per_step.reshape(-1, len(DIRECTIONS))
    pixels_of = experiment_pixels(found, selection)
    with jax.enable_x64(True):
        spaces = [found.space]
        for names in (("backlash_deg.pan", "backlash_deg.tilt"), ("focal_scale",), OPTICS):
            spaces.append(_ideal(spaces[-1], names))
        pose = jnp.asarray(found.reference_pose_rad)
        full, ideal = (
            np.asarray(derived_quantities(jnp.asarray(z), space, pose).effective_deg_per_step)
            for space in (spaces[0], spaces[-1])
        )
    try:
        measured = classic(found.campaign)
    except NothingToEstimate:
        return result
    quiet = np.zeros((len(z), len(found.arrays.spots.valid), 2))
    ratios = []
    for space in spaces:
        pixels = pixels_of(looks(replace(found, space=space), z, quiet))
        every = [four_point_ratios(p, selection.steps, selection.axis, found.campaign.stereo) for p in pixels]
        ratios.append(np.stack(every))
    # An experiment whose spots lie on one another, or beyond the lens model, has no ratio.
    sound = np.all([np.isfinite(r).all(axis=0) for r in ratios], axis=0)
    for k, direction in enumerate(DIRECTIONS):
        chosen = (selection.direction == direction) & sound
        found_classic = measured.directions[direction]
        if not chosen.any() or found_classic is None:
            continue
        seen = found_classic.mean_deg_per_step
        whole, unplayed, scaled, straight = (r[:, chosen].mean(axis=1) for r in ratios)
        parts = {
            BACKLASH: whole - unplayed,
            STEREO_SCALE: unplayed - scaled,
            SKEW: scaled - straight - (full[:, k] - ideal[:, k]),
            PROJECTION: straight - ideal[:, k],
            CHANCE: seen - whole,
        }

        # The ratio itself as every table states it, from all draws; its mean is a control variate for those of the
        # terms, which then add up to the gap.
        ratio, own = ratios_of_all[:, k], full[:, k]
        centre = own[0] if posterior is None else ratio.mean()

        def term(name: str, values: np.ndarray, own: np.ndarray = own, centre: float = centre) -> GapTerm:
            if posterior is None:
                value, sampled = values[0], values[1:]
            else:
                slope = np.cov(values, own)[0, 1] / own.var(ddof=1) if np.ptp(own) > 0 else 0.0
                value, sampled = values.mean() + slope * (centre - own.mean()), values
            return GapTerm(name, float(value), float(sampled.std()), _middle95(sampled))

        sd = float(ratio.std())
        joint = GapTerm("effective ratio", float(centre), sd, _middle95(ratio))
        total = GapTerm("classic - joint", float(seen - centre), sd, _middle95(seen - ratio))
        result[direction] = Gap(seen, joint, total, tuple(term(name, values) for name, values in parts.items()))
    return result


def _middle95(draws: np.ndarray) -> tuple[float, float]:
    low, high = np.quantile(draws, [0.025, 0.975])
    return float(low), float(high)


def experiment_pixels(found: JointFit, selection: Selection) -> Callable[[np.ndarray], np.ndarray]:
    """Picks the four looks of each experiment, (draws, e, 4, 4), from those of all spots in the filter's order."""
    from tvsbayes.instrument.campaign import ordered_spots

    row_of = {spot.spot: row for row, spot in enumerate(ordered_spots(found.campaign))}
    ids = [[row_of[found.campaign.spots[r].spot] for r in four] for four in selection.spot_rows]
    rows = np.array(ids, dtype=int).reshape(-1, 4)
    return lambda pixels: pixels[:, rows]


def _influence(found: JointFit, slopes: np.ndarray) -> np.ndarray:
    """Shift (q, p) of quantities with gradients (q, p) if the prior of coordinate j is off by its sd: (S e_j)."""
    fisher = found.information.fisher
    return slopes @ np.linalg.inv(fisher + np.eye(len(fisher)))


def camera_influence(found: JointFit, values: np.ndarray) -> np.ndarray:
    """That of the stereo calibration's priors and the focal scale's on quantities whose draws are (n, q)."""
    from tvsbayes.assessment.weaknesses import gradients
    from tvsbayes.instrument.parameters import INDEX, NAMES, RIG_NAMES

    cameras = [INDEX["focal_scale"], *range(len(RIG_NAMES), len(NAMES))]
    return _influence(found, gradients(found, values))[:, cameras]


def camera_u(found: JointFit) -> np.ndarray:
    """Standard uncertainty (4,) of the effective ratios that stereo calibration and focal scale alone cause."""
    shift = camera_influence(found, found.draws.effective_deg_per_step)
    return np.sqrt(np.sum(shift**2, axis=1))
