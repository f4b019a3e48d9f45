"""The posterior with its prior, predictions and log likelihoods as a tree for ArviZ, and `posterior.nc`.

Variables have the public names and named dimensions; units are those of the names (deg, mm, rad, px).
"""

from __future__ import annotations

import json
import tempfile
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


type Variable = tuple[tuple[str, ...], str | None]
"""The names of a variable's quantities, and their dimension beyond (chain, draw), if any."""


def _of_block(block: str, names: tuple[str, ...]) -> Variable:
    """Build the variable of a block, with the dimension of its labels; a single quantity has none."""
    if len(names) == 1:
        return names, None
    labels = tuple(name.removeprefix(f"{block}.") for name in names)
    return names, next(dim for dim, of_dim in COORDS.items() if of_dim == labels)


_RIG_BLOCKS = sorted({parameter.block: None for parameter in TWO_MIRROR.declared}, key=lambda b: len(BLOCKS[b]) > 1)
_DERIVED = {block: tuple(n for n in names if n in DERIVED) for block, names in QUANTITIES.blocks.items()}
VARIABLES: dict[str, Variable] = {
    **{block: _of_block(block, names) for block, names in _DERIVED.items() if names},
    "mean_degrees_per_step": _of_block("degrees_per_step", BLOCKS["degrees_per_step"]),
    **{b.replace(".", "_"): _of_block(b, BLOCKS[b]) for b in _RIG_BLOCKS if b != "degrees_per_step"},
    "stereo": (STEREO_PARAMETER_NAMES, "stereo_parameter"),
}
"""Variables of posterior.nc. `degrees_per_step` by direction; the mean ratio of an axis is `mean_degrees_per_step`."""


def dataset(draws: Derived, varying: set[str], shape: tuple[int, int], mechanism: Mechanism) -> xr.Dataset:
    """Build the variables of posterior.nc of what varies; each term of a head's geometry is one.

    Of a dimension of which some entries are fixed the others have a dimension of the variable's own.
    """
    columns, variables = Draws(draws, mechanism), {}
    own = {*mechanism.names, *derived_names(mechanism)}
    shared = {name: spec for name, spec in VARIABLES.items() if spec[0][0] in own}
    of_terms = (name for name in mechanism.names if mechanism.parameters[name] in TERMS)
    terms = {name.replace(".", "_"): ((name,), None) for name in of_terms}
    for variable, (names, dim) in (shared | terms).items():
        chosen = [name for name in names if name in varying]
        if not chosen:
            continue
        values = np.stack([columns[name] for name in chosen], axis=-1).reshape(*shape, -1)
        coords: dict[str, object] = {"chain": np.arange(shape[0]), "draw": np.arange(shape[1])}
        if dim is not None:
            labels = [label for name, label in zip(names, COORDS[dim], strict=True) if name in varying]
            coords[dim if len(labels) == len(names) else f"{variable}_{dim}"] = labels
        variables[variable] = xr.DataArray(values[..., 0] if dim is None else values, coords, tuple(coords))
    return xr.Dataset(variables)


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
    weighted, source = posterior, None
    if weighted.tier == IMPORTANCE:
        source = weighted.equal_places(RESAMPLED)[None]
        posterior = weighted.taken(source)
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
    attributes: dict[str, object] = {}
    if source is not None:
        stats["source"] = xr.DataArray(source, coords, ("chain", "draw"))
        stats["log_weight"] = xr.DataArray(np.log(weighted.weights.ravel()[source]), coords, ("chain", "draw"))
        attributes["ess_mean"] = json.dumps(weighted.convergence.ess_bulk)
        attributes["ess_interval_ends"] = json.dumps(weighted.convergence.ess_tail)
    convergence = posterior.convergence
    if isinstance(convergence, Convergence):
        stats["acceptance_rate"] = xr.DataArray(convergence.acceptance, {"chain": coords["chain"]}, ("chain",))
        attributes |= {"steps": convergence.steps, "discarded": convergence.discarded, "thin": convergence.thin}
    places = {"spot": [s.spot for s in spots], "pixel": list(PIXEL_LABELS)}
    pixels = pixels_of(spots) if fit.campaign.has_images else np.zeros((len(spots), len(PIXEL_LABELS)))
    # Sightings have angles about the direction sighted, rad, in the columns of `sightings.SIGHTED`.
    observed = xr.DataArray(pixels, places, tuple(places), name="pixels")
    tree = xr.DataTree.from_dict(
        {
            "posterior": dataset(posterior.draws, varying, shape, mechanism),
            "prior": dataset(prior_draws, varying, prior_draws.physical.shape[:2], mechanism),
            "posterior_predictive": predictive_pixels(posterior).to_dataset(name="pixels"),
            "log_likelihood": move_log_likelihood(posterior).to_dataset(name="pixels"),
            "observed_data": observed.to_dataset(),
            "sample_stats": xr.Dataset(stats),
        }
    )
    tree.attrs = {
        "format": POSTERIOR_FORMAT,
        "sampling_library": "tvsbayes" if source is not None else posterior.tier,
        "tier": posterior.tier,
        "sampling_time": posterior.seconds,
        "seed": posterior.seed,
        "converged": int(posterior.converged),
        **attributes,
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
