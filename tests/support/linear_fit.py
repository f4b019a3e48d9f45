"""A fit of a linear campaign in three groups, and the same refitted by linear algebra."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
from support.partial_arrays import no_gears, partial_arrays
from support.small_campaign import small_campaign

from tvsbayes.calibration.pointing import INPUT_NAMES
from tvsbayes.estimators.campaign_arrays import SpotArrays
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.linear_spots import Linearised, StopGroup, StopInformation
from tvsbayes.estimators.mode_search import NOISE_NAMES
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import HARMONIC_NAMES
from tvsbayes.model.compiled import placed
from tvsbayes.model.parameter_space import parameter_space

SPOTS = 40
ROWS, STATES = 4 * SPOTS, 12
REDRAWN = (0, 7, 14, 21, 28, 35), (0, 4, 11, 18, 25, 32)
"""Spots with a new stop error of pan, of tilt."""


def linear_problem(stereo: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Jacobian (rows, parameters) in prior sds and load of the stop errors (rows, states) of a small campaign.

    Pixel errors are unit normal; `stereo` scales what one prior sd of the cameras does.
    """
    rng = np.random.default_rng(17)
    jacobian = rng.normal(size=(ROWS, len(TWO_MIRROR.names))) * np.exp(rng.normal(size=len(TWO_MIRROR.names)))
    # Effects of cameras and rig are alike: no data separate them.
    mix = rng.normal(size=(len(TWO_MIRROR.rig_names), len(TWO_MIRROR.names) - len(TWO_MIRROR.rig_names)))
    jacobian[:, len(TWO_MIRROR.rig_names) :] = 0.02 * stereo * jacobian[:, : len(TWO_MIRROR.rig_names)] @ mix
    # Fixed in the rig, which has no transmission error; scales of errors move no spot.
    jacobian[:, [TWO_MIRROR.index[name] for name in (*HARMONIC_NAMES, *NOISE_NAMES)]] = 0.0
    load = np.zeros((SPOTS, 4, STATES))
    starts = [(begin, end) for spots in REDRAWN for begin, end in pairwise((*spots, SPOTS))]
    for state, (begin, end) in enumerate(starts):
        load[begin:end, :, state] = 2.0 * rng.normal(size=(end - begin, 4))
    return jacobian, load.reshape(ROWS, STATES)


def linearised(jacobian: np.ndarray, load: np.ndarray) -> Linearised:
    """The campaign of a linear problem; states are stop errors of unit variance, those of pan first."""
    half = STATES // 2
    slope = np.stack([load[:, :half].sum(axis=1), load[:, half:].sum(axis=1)], axis=1)
    shapes = {
        "play_sd_rad": (2,),
        "mirror_angles_rad": (2,),
        "predicted": (5,),
        "zero_variance": (2,),
        "scatter_variance": (2,),
    }
    shapes |= {"residual": (4,), "place_columns": (4, 0), "predicted_jacobian": (5, len(TWO_MIRROR.names))}
    arrays = {name: np.zeros((SPOTS, *shape)) for name, shape in shapes.items()}
    return Linearised(
        z=np.zeros(len(TWO_MIRROR.names)),
        slope=slope.reshape(SPOTS, 4, 2),
        stop_variance=np.ones((SPOTS, 2)),
        place_root=np.zeros((0, 0)),
        residual_jacobian=-jacobian.reshape(SPOTS, 4, -1),
        **arrays,
    )


def spot_arrays(readings: bool) -> SpotArrays:
    """Its spots, in one segment; one has a reading, if any has."""
    size = SPOTS + 1
    redraw = np.zeros((size, 2), bool)
    for axis, spots in enumerate(REDRAWN):
        redraw[list(spots), axis] = True
    aperture = np.zeros(size)
    # A spot of the padding does not count.
    aperture[[1, -1]] = readings, 1.0
    shapes = {"pixels": (4,), "whitening": (4, 4), "aperture_rad": (), "triangulated_mm": (3,), "weight": ()}
    shapes |= {"redraw_mix": (2, 2), "hours": (2,), "homed": (2,)}
    with jax.enable_x64(True):
        return SpotArrays(
            move_index=placed(np.zeros(size, np.int32)),
            has_aperture=placed(aperture),
            valid=placed((np.arange(size) < SPOTS).astype(float)),
            redraw=placed(redraw),
            new_segment=placed(np.arange(size) == 0),
            new_zero=placed(np.tile(np.arange(size)[:, None] == 0, 2)),
            **{name: placed(np.zeros((size, *shape))) for name, shape in shapes.items()},
        )


def fit_of(jacobian: np.ndarray, load: np.ndarray, rig, readings: bool = False) -> JointFit:
    """A `JointFit` that holds what `causes_of` reads, of a linear campaign in three groups."""
    inverse = np.linalg.inv(np.eye(ROWS) + load @ load.T)
    gain = inverse @ jacobian
    parts = (slice(0, 40), slice(40, 100), slice(100, ROWS))
    groups = tuple(StopGroup(p, np.zeros(p.stop - p.start), gain[p], inverse[p, p]) for p in parts)
    fit = object.__new__(JointFit)
    with jax.enable_x64(True):
        space = jax.tree.map(jnp.asarray, parameter_space(rig.table, rig.stereo))
    physical = np.full((50, len(TWO_MIRROR.names)), 0.5) + 1e-3 * np.random.default_rng(3).normal(
        size=(50, len(TWO_MIRROR.names))
    )
    values = {
        "information": StopInformation(groups, jacobian.T @ gain, *without_places(jacobian.shape[1])),
        "linearised": linearised(jacobian, load),
        "free": np.ones(len(TWO_MIRROR.names), dtype=bool),
        "arrays": partial_arrays(spots=spot_arrays(readings), count=np.int32(SPOTS), gears=no_gears(SPOTS)),
        "draws_places": np.zeros((2048, 0)),
        "space": space,
        "z": 0.1 * np.random.default_rng(4).normal(size=len(TWO_MIRROR.names)),
        "draws": SimpleNamespace(physical=physical, place_errors_rad=np.zeros((len(physical), 0))),
        "campaign": small_campaign(),
        "sides": {},
    }
    for name, value in values.items():
        object.__setattr__(fit, name, value)
    return fit


def without_places(parameters: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`StopInformation` of errors at places where there are none."""
    return np.zeros(0), np.zeros((0, parameters)), np.zeros((0, 0))


def refitted(jacobian: np.ndarray, load: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How the estimate moves with every datum (parameters, rows) and prior (parameters, parameters), by lstsq."""
    variances, vectors = np.linalg.eigh(np.eye(ROWS) + load @ load.T)
    whitener = vectors @ np.diag(variances**-0.5) @ vectors.T
    system = np.concatenate([whitener @ jacobian, np.eye(len(TWO_MIRROR.names))])
    right = np.zeros((len(system), ROWS + len(TWO_MIRROR.names)))
    right[:ROWS, :ROWS], right[ROWS:, ROWS:] = whitener, np.eye(len(TWO_MIRROR.names))
    moved = np.linalg.lstsq(system, right, rcond=None)[0]
    return moved[:, :ROWS], moved[:, ROWS:]


def slope_of(fit: JointFit) -> np.ndarray:
    """d(inputs)/dz by central differences."""
    columns = [TWO_MIRROR.index[name] for name in INPUT_NAMES]
    with jax.enable_x64(True):
        physical = jax.jit(lambda z: fit.space.physical(z))
        moved = [
            [np.asarray(physical(jnp.asarray(fit.z + s * 1e-4 * row)))[columns] for s in (1, -1)]
            for row in np.eye(len(TWO_MIRROR.names))
        ]
    return np.array([(plus - minus) / 2e-4 for plus, minus in moved]).T
