"""Likelihood and pixels of looks, kept and new; the ArviZ tree of all that."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Float

from tvsbayes.estimators.campaign_arrays import CampaignArrays, spot_constants
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.likelihood import (
    STATES,
    Belief,
    FilterRows,
    filter_input,
    look,
    no_belief,
    observe_with_stop_errors,
)
from tvsbayes.files.disk import write_atomically
from tvsbayes.instrument.axes import DIRECTIONS, HOME_SD_DEG, SENSES
from tvsbayes.instrument.campaign import input_hashes, ordered_spots
from tvsbayes.instrument.parameters import HARMONIC_PRIORS, INDEX, NAMES, STEREO_PARAMETER_NAMES
from tvsbayes.model.headlines import Derived
from tvsbayes.model.parameter_space import ParameterSpace
from tvsbayes.posterior.draws import Draws, Posterior
from tvsbayes.posterior.sampling import fingerprint
from tvsbayes.posterior.transport import BATCH, in_batches

RANK_TOLERANCE = 1e-12
"""Share of a state's precision below which what other states leave of it is rounding, not information."""


class LaterSpots(eqx.Module):
    """What later spots say about the present state x: log density -x.precision.x/2 + score.x + constant."""

    precision: Float[Array, "6 6"]
    score: Float[Array, "6"]

    def with_spot(self, row: FilterRows) -> LaterSpots:
        """Add a spot that sees this state with unit noise."""
        precision = jnp.sum(row.load[:, :, None] * row.load[:, None, :], axis=0)
        return LaterSpots(self.precision + precision, self.score + jnp.sum(row.load * row.residual[:, None], axis=0))

    def before(self, row: FilterRows) -> LaterSpots:
        """Pass to the state of the previous spot: states drawn anew in between are integrated out, one by one."""
        precision, score = self.precision, self.score
        for state in range(STATES):
            variance = row.variance[state] * (1 - row.keep[state])
            column = precision[:, state]
            share = column * (variance / (1 + variance * column[state]))
            score = score - share * score[state]
            precision = precision - share[:, None] * column
        return LaterSpots(precision * (row.keep[:, None] * row.keep), score * row.keep)

    def joined(self, belief: Belief) -> Belief:
        """Belief of the state from earlier and later spots together.

        The later spots' precision is taken apart column by column (Cholesky without roots), each column acting
        like one more scalar look: no matrix library, whose calls would cost more than the filter.
        """
        mean, covariance = belief.mean, belief.covariance
        precision, score = self.precision, self.score
        floor = RANK_TOLERANCE * jnp.diagonal(precision)
        for state in range(STATES):
            pivot, column, moment = precision[state, state], precision[:, state], score[state]
            inverse = jnp.where(pivot > floor[state], 1 / jnp.where(pivot > floor[state], pivot, 1.0), 0.0)
            column = jnp.where(inverse > 0, column, 0.0)
            moment = jnp.where(inverse > 0, moment, 0.0)
            gain = jnp.sum(covariance * column, axis=1)
            weight = inverse / (1 + inverse * jnp.sum(column * gain))
            mean = mean + gain * (weight * (moment - jnp.sum(column * mean)))
            covariance = covariance - gain[:, None] * (gain * weight)
            precision = precision - column[:, None] * (column * inverse)
            score = score - column * (inverse * moment)
        return Belief(mean, covariance)


@eqx.filter_jit
def move_log_density(
    z: Float[Array, "batch parameters"], space: ParameterSpace, arrays: CampaignArrays
) -> Float[Array, "batch spots"]:
    """Log density of the spots of each move given ALL other spots and the parameters (DESIGN 4.3).

    Stop errors persist while their axis stands, so spots are not independent given the parameters; whole moves
    are the unit that can be left out. Backward and forward passes meet at each move (two-filter smoother: Fraser
    and Potter, IEEE Trans. Automat. Control 14 (1969) 387).

    Args:
        z: coordinates of many points.
        space: priors.
        arrays: the campaign.

    Returns:
        Contribution of each spot given the earlier spots of its own move and all spots of the other moves: the sum
        over a move's spots is the move's log density, without `likelihood.spot_constants`.
    """
    index = arrays.spots.move_index
    other = index[1:] != index[:-1]
    first, last = jnp.append(True, other), jnp.append(other, True)

    def backward(carry, row_and_last):
        later, beyond = carry
        row, last = row_and_last
        beyond = jax.tree.map(lambda a, b: jnp.where(last, a, b), later, beyond)
        return (later.with_spot(row).before(row), beyond), beyond

    def forward(carry, row_and_first):
        belief, cavity = carry
        row, first, beyond, log_scale = row_and_first
        belief = belief.renewed(row)
        cavity = jax.tree.map(lambda a, b: jnp.where(first, a, b), beyond.joined(belief), cavity)
        seen = look(cavity, row)
        log_density = log_scale - 0.5 * seen.log_variance - 0.5 * jnp.sum(seen.standardised**2)
        return (look(belief, row).belief, seen.belief), log_density

    def one(z):
        given = filter_input(space.model(z), arrays)
        nothing = LaterSpots(jnp.zeros((STATES, STATES)), jnp.zeros(STATES))
        _, beyond = jax.lax.scan(backward, (nothing, nothing), (given.rows, last), reverse=True)
        rows = (given.rows, first, beyond, given.log_scale)
        return jax.lax.scan(forward, (no_belief(), no_belief()), rows)[1]

    return jax.vmap(one)(z)


POSTERIOR_FORMAT = "tvsbayes-posterior/1"
PIXELS = ("u_left", "v_left", "u_right", "v_right")


@dataclass(frozen=True)
class Variable:
    """A variable of posterior.nc: its dimensions beyond (chain, draw) and the contract names behind it."""

    dims: tuple[str, ...]
    names: np.ndarray


def _variable(dims: tuple[str, ...], pattern: str) -> Variable:
    """Fill `{}` in a pattern with the coordinates of the dimensions."""
    shape = tuple(len(COORDS[dim]) for dim in dims)
    names = [pattern.format(*(COORDS[d][i] for d, i in zip(dims, index, strict=True))) for index in np.ndindex(shape)]
    return Variable(dims, np.array(names).reshape(shape))


COORDS: dict[str, tuple[str, ...]] = {
    "direction": DIRECTIONS,
    "axis": ("pan", "tilt"),
    "laser_axis": ("x", "y"),
    "tilt_axis_component": ("x", "z"),
    "component": ("x", "y", "z"),
    "harmonic": tuple(name.removeprefix("harmonic_deg.") for name in HARMONIC_PRIORS),
    "stereo_parameter": tuple(name.removeprefix("stereo.") for name in STEREO_PARAMETER_NAMES),
}
VARIABLES: dict[str, Variable] = {
    "effective_deg_per_step": _variable(("direction",), "effective_deg_per_step.{}"),
    "degrees_per_step": _variable(("direction",), "degrees_per_step.{}"),
    "mean_degrees_per_step": _variable(("axis",), "degrees_per_step.{}"),
    "ratio_contrast_deg_per_step": _variable(("axis",), "ratio_contrast_deg_per_step.{}"),
    "backlash_deg": _variable(("axis",), "backlash_deg.{}"),
    "effective_mirror_offset_mm": _variable((), "effective_mirror_offset_mm"),
    **{
        name: _variable((), name)
        for name in (
            *("mirror_offset_mm", "tilt_zero_deg", "mirror1_error_deg", "mirror2_error_deg", "tilt_axis_skew_deg"),
            *("pixel_scale", "focal_scale", "baseline_mm", "pan_zero_emission_deg"),
            *("aperture_zero_deg", "aperture_sd_deg"),
        )
    },
    "laser_tilt_deg": _variable(("laser_axis",), "laser_tilt_deg.{}"),
    "laser_offset_mm": _variable(("laser_axis",), "laser_offset_mm.{}"),
    "tilt_axis_offset_mm": _variable(("tilt_axis_component",), "tilt_axis_offset_mm.{}"),
    "extrinsics_rotation_rad": _variable(("component",), "extrinsics.rotation_rad.{}"),
    "extrinsics_translation_mm": _variable(("component",), "extrinsics.translation_mm.{}"),
    "stop_sd_deg": _variable(("direction",), "stop_sd_deg.{}"),
    "harmonic_deg": _variable(("harmonic",), "harmonic_deg.{}"),
    "stereo": _variable(("stereo_parameter",), "stereo.{}"),
}
"""Variables of posterior.nc. `degrees_per_step` by direction; the mean ratio of an axis is `mean_degrees_per_step`."""


def _variables(draws: Derived, varying: set[str], shape: tuple[int, int]) -> dict[str, xr.DataArray]:
    """All variables that vary, with named dimensions; fixed entries of a dimension are left out."""
    columns = Draws(draws)
    result = {}
    for variable, spec in VARIABLES.items():
        chosen = np.array([name in varying for name in spec.names.ravel()])
        if not chosen.any():
            continue
        values = np.stack([columns[name] for name in spec.names.ravel()[chosen]], axis=-1)
        if spec.dims:
            labels = [label for label, yes in zip(COORDS[spec.dims[0]], chosen, strict=True) if yes]
            coords = {"chain": np.arange(shape[0]), "draw": np.arange(shape[1]), spec.dims[0]: labels}
            result[variable] = xr.DataArray(values.reshape(*shape, -1), coords, ("chain", "draw", *spec.dims))
        else:
            coords = {"chain": np.arange(shape[0]), "draw": np.arange(shape[1])}
            result[variable] = xr.DataArray(values.reshape(shape), coords, ("chain", "draw"))
    return result


def _dataset(variables: Mapping[str, xr.DataArray]) -> xr.Dataset:
    """Join variables; a coordinate of which some have fewer entries is kept apart under the variable's name."""
    full = {}
    for name, array in variables.items():
        for dim in array.dims[2:]:
            if array.sizes[dim] < len(COORDS.get(dim, ())):
                array = array.rename({dim: f"{name}_{dim}"})
        full[name] = array
    return xr.Dataset(full)


def move_log_likelihood(posterior: Posterior) -> xr.DataArray:
    """Log p(spots of a move | all other spots, parameters), dimensions (chain, draw, move); constants included."""
    fit = posterior.fit
    spots = ordered_spots(fit.campaign)
    used = np.asarray(fit.arrays.spots.valid)[: len(spots)] > 0
    z = posterior.z.reshape(-1, posterior.z.shape[-1])
    with jax.enable_x64(True):
        by_spot = in_batches(lambda block: move_log_density(block, fit.space, fit.arrays), z)[:, : len(spots)]
    by_spot = by_spot + spot_constants(fit.campaign)
    index = np.array([spot.move for spot in spots])
    moves_seen = np.unique(index[used])
    values = np.stack([by_spot[:, used & (index == move)].sum(axis=1) for move in moves_seen], axis=1)
    chains, draws = posterior.z.shape[:2]
    coords = {"chain": np.arange(chains), "draw": np.arange(draws), "move": moves_seen}
    return xr.DataArray(values.reshape(chains, draws, -1), coords, ("chain", "draw", "move"))


def looks(fit: JointFit, z: np.ndarray, stop_error_rad: np.ndarray) -> np.ndarray:
    """Noiseless pixels of all ordered spots, shape (draws, spots, 4), for coordinates (draws, p)."""
    count, blocks = len(ordered_spots(fit.campaign)), []
    with jax.enable_x64(True):
        for start in range(0, len(z), BATCH):
            rows = np.arange(len(z))[start : start + BATCH]
            filled = np.resize(rows, BATCH)
            seen = observe_with_stop_errors(
                jnp.asarray(z[filled]), jnp.asarray(stop_error_rad[filled]), fit.space, fit.arrays
            )
            blocks.append(np.asarray(seen)[: len(rows), :count, :4])
    return np.concatenate(blocks)


def ideal_pixels(posterior: Posterior, draws: int) -> np.ndarray:
    """Pixels without noise and stop errors for evenly chosen draws, shape (draws, spots, 4)."""
    z = posterior.z.reshape(-1, posterior.z.shape[-1])
    chosen = z[np.linspace(0, len(z) - 1, draws).astype(int)]
    return looks(posterior.fit, chosen, np.zeros((draws, len(posterior.fit.arrays.spots.valid), 2)))


def predictive_pixels(posterior: Posterior, draws_per_chain: int = 8) -> xr.DataArray:
    """The same looks taken again: stop errors, home offsets, play and pixel noise drawn anew, ranges as observed.

    Returns:
        Dimensions (chain, draw, spot, pixel); the draws are a subset of the posterior's, by its own coordinate.
    """
    fit = posterior.fit
    generator = np.random.default_rng([posterior.seed, 1])
    chains, draws = posterior.z.shape[:2]
    chosen = np.unique(np.linspace(0, draws - 1, min(draws_per_chain, draws)).astype(int))
    z = posterior.z[:, chosen].reshape(-1, posterior.z.shape[-1])
    physical = posterior.draws.physical[:, chosen].reshape(len(z), -1)
    values = looks_again(fit, z, physical, generator).reshape(chains, len(chosen), -1, 4)
    spots = [spot.spot for spot in ordered_spots(fit.campaign)]
    coords = {"chain": np.arange(chains), "draw": chosen, "spot": spots, "pixel": list(PIXELS)}
    return xr.DataArray(values.astype(np.float32), coords, ("chain", "draw", "spot", "pixel"))


def looks_again(fit: JointFit, z: np.ndarray, physical: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Pixels (draws, spots, 4) of the same looks taken again at coordinates z (draws, p) with values `physical`.

    Stop errors, home offsets, place in the play and pixel noise are drawn anew; ranges are those observed.
    """
    count = len(ordered_spots(fit.campaign))
    arrays = jax.tree.map(np.asarray, fit.arrays.spots)
    sd_deg = physical[:, [INDEX[f"stop_sd_deg.{d}"] for d in DIRECTIONS]]
    # Per axis (right, left) and (down, up), as `redraw_mix` orders them.
    sd_rad = np.radians(sd_deg.reshape(len(z), 2, 2)[..., ::-1])
    variance = np.sum(arrays.redraw_mix[None] * sd_rad[:, None] ** 2, axis=3)
    fresh = np.sqrt(variance) * generator.standard_normal(variance.shape)
    size = len(arrays.valid)
    rows = np.arange(size)[:, None]
    error = np.take_along_axis(fresh, np.maximum.accumulate(np.where(arrays.redraw, rows, 0), axis=0)[None], axis=1)
    home = np.radians(HOME_SD_DEG) * generator.standard_normal((len(z), size, 2)) * arrays.homed[:, None]
    segment = np.maximum.accumulate(np.where(arrays.new_segment, np.arange(size), 0))
    error = error + home[:, segment]
    # Where the play stands is unknown after an unknown approach: Gaussian, as in the filter.
    place = generator.standard_normal(home.shape)[:, segment]
    error[:, :count] += fit.linearised.play_sd_rad * place[:, :count]
    pixel_scale = physical[:, INDEX["pixel_scale"]].reshape(-1, 1, 1)
    ideal = looks(fit, z, error)
    root = np.linalg.inv(arrays.whitening[:count])
    noise = np.einsum("sij,nsj->nsi", root, generator.standard_normal(ideal.shape))
    return ideal + pixel_scale * noise


def data_tree(posterior: Posterior) -> xr.DataTree:
    """Everything ArviZ works on, in its groups.

    Posterior, prior, posterior_predictive, log_likelihood, observed_data and sample_stats.

    Args:
        posterior: a sampled posterior.

    Returns:
        A tree for `az.summary`, `az.loo`, `az.compare` and ArviZ's plots. The unit of the log likelihood is a move.
    """
    fit = posterior.fit
    shape = posterior.z.shape[:2]
    varying = {NAMES[i] for i in np.flatnonzero(fit.free)} | {"effective_mirror_offset_mm"}
    for axis, pair in SENSES.items():
        if varying & {f"degrees_per_step.{axis}", f"ratio_contrast_deg_per_step.{axis}"}:
            varying |= {f"degrees_per_step.{d}" for d in pair} | {f"effective_deg_per_step.{d}" for d in pair}
    prior_draws = jax.tree.map(lambda x: np.asarray(x)[None], fit.prior_draws)
    spots = ordered_spots(fit.campaign)
    pixels = np.array([(s.u_left_px, s.v_left_px, s.u_right_px, s.v_right_px) for s in spots])
    coords = {"chain": np.arange(shape[0]), "draw": np.arange(shape[1])}
    stats = {
        "lp": xr.DataArray(posterior.log_density, coords, ("chain", "draw")),
        "acceptance_rate": xr.DataArray(posterior.convergence.acceptance, {"chain": coords["chain"]}, ("chain",)),
    }
    observed = xr.DataArray(
        pixels, {"spot": [s.spot for s in spots], "pixel": list(PIXELS)}, ("spot", "pixel"), name="pixels"
    )
    tree = xr.DataTree.from_dict(
        {
            "posterior": _dataset(_variables(posterior.draws, varying, shape)),
            "prior": _dataset(_variables(prior_draws, varying, prior_draws.physical.shape[:2])),
            "posterior_predictive": predictive_pixels(posterior).to_dataset(name="pixels"),
            "log_likelihood": move_log_likelihood(posterior).to_dataset(name="pixels"),
            "observed_data": observed.to_dataset(),
            "sample_stats": xr.Dataset(stats),
        }
    )
    convergence = posterior.convergence
    tree.attrs = {
        "format": POSTERIOR_FORMAT,
        "sampling_library": "emcee",
        "sampling_time": posterior.seconds,
        "seed": posterior.seed,
        "converged": int(convergence.converged),
        "steps": convergence.steps,
        "discarded": convergence.discarded,
        "thin": convergence.thin,
        "versions": json.dumps({name: version(name) for name in ("tvsbayes", "emcee", "arviz", "jax", "numpy")}),
        "inputs": json.dumps(input_hashes(fit.campaign)),
        "fingerprint": fingerprint(fit),
        "reference_pose_deg": np.degrees(fit.reference_pose_rad),
        "log_likelihood_unit": "spots of a move given all other spots",
    }
    return tree


def write_posterior(posterior: Posterior, path: Path) -> None:
    """Write `posterior.nc` (netCDF-4), whole or not at all.

    Raises:
        InputError: the folder cannot be written.
    """
    tree = data_tree(posterior)
    packed = {"zlib": True, "complevel": 4, "shuffle": True}
    encoding = {f"/{name}": dict.fromkeys(group.data_vars, packed) for name, group in tree.children.items()}
    with tempfile.TemporaryDirectory(prefix="tvsbayes-") as scratch:
        file = Path(scratch) / "posterior.nc"
        tree.to_netcdf(file, engine="h5netcdf", encoding=encoding)
        write_atomically(path, file.read_bytes())
