"""The posterior with its prior, predictions and log likelihoods as a tree for ArviZ, and `posterior.nc`.

Variables have the public names and named dimensions; units are those of the names (deg, mm, rad, px).
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
import xarray as xr

from tvsbayes.files.packages import version_of
from tvsbayes.instrument.axes import AXES, DIRECTIONS
from tvsbayes.instrument.campaign import input_hashes, ordered_spots, pixels_of
from tvsbayes.instrument.mechanisms import TWO_MIRROR, Mechanism
from tvsbayes.instrument.parameters import (
    AMPLITUDE_NAMES,
    BLOCKS,
    HARMONIC_NAMES,
    QUANTITIES,
    STEREO_PARAMETER_NAMES,
    TERMS,
)
from tvsbayes.model.headlines import DERIVED, Derived
from tvsbayes.posterior.chain import fingerprint
from tvsbayes.posterior.draws import Draws, Posterior, derived_names
from tvsbayes.posterior.predictive import PIXEL_LABELS, move_log_likelihood, predictive_pixels
from tvsbayes.results.convergence import Convergence
from tvsbayes.results.tiers import CHAIN, IMPORTANCE

POSTERIOR_FORMAT = "tvsbayes-posterior/1"
RESAMPLED = 2048
"""Draws after resampling weighted draws with equal weights."""
COORDS: dict[str, tuple[str, ...]] = {
    "direction": DIRECTIONS,
    "axis": AXES,
    "laser_axis": ("x", "y"),
    "tilt_axis_component": ("x", "z"),
    "component": ("x", "y", "z"),
    "harmonic": tuple(name.removeprefix("harmonic_deg.") for name in HARMONIC_NAMES),
    "harmonic_amplitude": tuple(name.removeprefix("harmonic_amplitude_deg.") for name in AMPLITUDE_NAMES),
    "stereo_parameter": tuple(name.removeprefix("stereo.") for name in STEREO_PARAMETER_NAMES),
}


@dataclass(frozen=True)
class Variable:
    """A variable of posterior.nc: the names of its quantities, and their dimension beyond (chain, draw), if any."""

    names: tuple[str, ...]
    dim: str | None = None


def _of_block(block: str, names: tuple[str, ...]) -> Variable:
    """Build the variable of a block, with the dimension of its labels; a single quantity has none."""
    if len(names) == 1:
        return Variable(names)
    labels = tuple(name.removeprefix(f"{block}.") for name in names)
    return Variable(names, next(dim for dim, of_dim in COORDS.items() if of_dim == labels))


_RIG_BLOCKS = sorted({parameter.block: None for parameter in TWO_MIRROR.declared}, key=lambda b: len(BLOCKS[b]) > 1)
_DERIVED = {block: tuple(n for n in names if n in DERIVED) for block, names in QUANTITIES.blocks.items()}
VARIABLES: dict[str, Variable] = {
    **{block: _of_block(block, names) for block, names in _DERIVED.items() if names},
    "mean_degrees_per_step": _of_block("degrees_per_step", BLOCKS["degrees_per_step"]),
    **{b.replace(".", "_"): _of_block(b, BLOCKS[b]) for b in _RIG_BLOCKS if b != "degrees_per_step"},
    "stereo": Variable(STEREO_PARAMETER_NAMES, "stereo_parameter"),
}
"""Variables of posterior.nc. `degrees_per_step` by direction; the mean ratio of an axis is `mean_degrees_per_step`."""


def variables_of(mechanism: Mechanism) -> dict[str, Variable]:
    """Return the variables of posterior.nc for a mechanism; each term of a head's geometry is one."""
    own = {*mechanism.names, *derived_names(mechanism)}
    shared = {name: spec for name, spec in VARIABLES.items() if spec.names[0] in own}
    terms = [name for name in mechanism.names if mechanism.parameters[name] in TERMS]
    return shared | {name.replace(".", "_"): Variable((name,)) for name in terms}


def _variables(
    draws: Derived, varying: set[str], shape: tuple[int, int], mechanism: Mechanism
) -> dict[str, xr.DataArray]:
    """Return all variables that vary, with named dimensions; fixed entries of a dimension are left out."""
    columns = Draws(draws, mechanism)
    result = {}
    for variable, spec in variables_of(mechanism).items():
        chosen = np.array([name in varying for name in spec.names])
        if not chosen.any():
            continue
        values = np.stack([columns[name] for name in np.array(spec.names)[chosen]], axis=-1)
        coords: dict[str, object] = {"chain": np.arange(shape[0]), "draw": np.arange(shape[1])}
        if spec.dim is None:
            values = values.reshape(shape)
        else:
            values = values.reshape(*shape, -1)
            coords[spec.dim] = [label for label, yes in zip(COORDS[spec.dim], chosen, strict=True) if yes]
        result[variable] = xr.DataArray(values, coords, tuple(coords))
    return result


def _dataset(variables: Mapping[str, xr.DataArray]) -> xr.Dataset:
    """Join variables; a dimension with fewer entries in some variable gets a name of its own."""
    full = {}
    for name, array in variables.items():
        for dim in array.dims[2:]:
            if array.sizes[dim] < len(COORDS[str(dim)]):
                array = array.rename({dim: f"{name}_{dim}"})
        full[name] = array
    return xr.Dataset(full)


def data_tree(posterior: Posterior) -> xr.DataTree:
    """Build the tree for ArviZ with its groups.

    The groups are posterior, prior, posterior_predictive, log_likelihood, observed_data and sample_stats.

    Args:
        posterior: a sampled posterior.

    Returns:
        A tree for `az.summary`, `az.loo`, `az.compare` and ArviZ's plots. The unit of the log likelihood is a move.
        Weighted draws are resampled to one chain of equal weight; `sample_stats` has the number (`source`) and the
        weight of the draw that each was, the attributes of the tree the effective draws by quantity.
    """
    weighted = posterior if posterior.tier == IMPORTANCE else None
    source = None if weighted is None else weighted.equal_places(RESAMPLED)
    if weighted is not None and source is not None:
        posterior = weighted.taken(source[None])
    fit = posterior.fit
    shape = posterior.z.shape[:2]
    mechanism = fit.space.mechanism
    varying = {fit.names[i] for i in np.flatnonzero(fit.free)}
    # Quantities of one axis vary if its gears do.
    of_axis = {a: {f"degrees_per_step.{a}", f"ratio_contrast_deg_per_step.{a}"} & varying for a in AXES}
    varying |= {name for name in derived_names(mechanism) if (axis := QUANTITIES[name].axis) is None or of_axis[axis]}
    prior_draws = jax.tree.map(lambda x: np.asarray(x)[None], fit.prior_draws)
    spots = ordered_spots(fit.campaign)
    coords = {"chain": np.arange(shape[0]), "draw": np.arange(shape[1])}
    stats = {"lp": xr.DataArray(posterior.log_density, coords, ("chain", "draw"))}
    lengths: dict[str, int] = {}
    effective: dict[str, str] = {}
    if weighted is not None and source is not None:
        stats["source"] = xr.DataArray(source[None], coords, ("chain", "draw"))
        stats["log_weight"] = xr.DataArray(np.log(weighted.weights.ravel()[source])[None], coords, ("chain", "draw"))
        effective = {"ess_mean": json.dumps(weighted.convergence.ess_bulk)}
        effective["ess_interval_ends"] = json.dumps(weighted.convergence.ess_tail)
    if isinstance(posterior.convergence, Convergence):
        convergence = posterior.convergence
        stats["acceptance_rate"] = xr.DataArray(convergence.acceptance, {"chain": coords["chain"]}, ("chain",))
        lengths = {"steps": convergence.steps, "discarded": convergence.discarded, "thin": convergence.thin}
    places = {"spot": [s.spot for s in spots], "pixel": list(PIXEL_LABELS)}
    pixels = pixels_of(spots) if fit.campaign.has_images else np.zeros((len(spots), len(PIXEL_LABELS)))
    # Sightings have angles about the direction sighted, rad, in the columns of `sightings.SIGHTED`.
    observed = xr.DataArray(pixels, places, tuple(places), name="pixels")
    tree = xr.DataTree.from_dict(
        {
            "posterior": _dataset(_variables(posterior.draws, varying, shape, mechanism)),
            "prior": _dataset(_variables(prior_draws, varying, prior_draws.physical.shape[:2], mechanism)),
            "posterior_predictive": predictive_pixels(posterior).to_dataset(name="pixels"),
            "log_likelihood": move_log_likelihood(posterior).to_dataset(name="pixels"),
            "observed_data": observed.to_dataset(),
            "sample_stats": xr.Dataset(stats),
        }
    )
    tree.attrs = {
        "format": POSTERIOR_FORMAT,
        "sampling_library": posterior.tier if lengths else "tvsbayes",
        "tier": posterior.tier,
        "sampling_time": posterior.seconds,
        "seed": posterior.seed,
        "converged": int(posterior.converged),
        **lengths,
        **effective,
        "versions": json.dumps({name: version_of(name) for name in ("tvsbayes", CHAIN, "arviz", "jax", "numpy")}),
        "inputs": json.dumps(input_hashes(fit.campaign)),
        "fingerprint": fingerprint(fit),
        "reference_pose_deg": np.degrees(fit.reference_pose_rad),
        "log_likelihood_unit": "spots of a move given all other spots",
    }
    return tree


def posterior_bytes(posterior: Posterior, fit_id: str) -> bytes:
    """Make `posterior.nc` (netCDF-4); `fit_id` is the id of the fit whose file it is."""
    tree = data_tree(posterior)
    tree.attrs["fit_id"] = fit_id
    packed = {"zlib": True, "complevel": 4, "shuffle": True}
    encoding = {f"/{name}": dict.fromkeys(group.data_vars, packed) for name, group in tree.children.items()}
    with tempfile.TemporaryDirectory(prefix="tvsbayes-") as scratch:
        file = Path(scratch) / "posterior.nc"
        tree.to_netcdf(file, engine="h5netcdf", encoding=encoding)
        return file.read_bytes()
