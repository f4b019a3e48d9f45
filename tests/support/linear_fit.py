"""A fit of a linear campaign in three groups, and the same refitted by linear algebra."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
from support.small_campaign import small_campaign

from tvsbayes.calibration.pointing import INPUT_NAMES
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.linear_spots import StopGroup, StopInformation
from tvsbayes.instrument.parameters import HARMONIC_NAMES, INDEX, NAMES, RIG_NAMES
from tvsbayes.model.parameter_space import parameter_space

ROWS, STATES = 160, 12


def linear_problem(stereo: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Jacobian (rows, parameters) in prior sds and load of the stop errors (rows, states) of a small campaign.

    Pixel errors are unit normal; `stereo` scales what one prior sd of the cameras does.
    """
    rng = np.random.default_rng(17)
    jacobian = rng.normal(size=(ROWS, len(NAMES))) * np.exp(rng.normal(size=len(NAMES)))
    # What the cameras do looks like what the rig does: no data tell one from the other.
    mix = rng.normal(size=(len(RIG_NAMES), len(NAMES) - len(RIG_NAMES)))
    jacobian[:, len(RIG_NAMES) :] = 0.02 * stereo * jacobian[:, : len(RIG_NAMES)] @ mix
    # Fixed in the rig, which has no transmission error.
    jacobian[:, [INDEX[name] for name in HARMONIC_NAMES]] = 0.0
    load = np.zeros((ROWS, STATES))
    for state in range(STATES):
        load[13 * state : 13 * state + 20, state] = 2.0 * rng.normal(size=len(load[13 * state : 13 * state + 20]))
    return jacobian, load


def fit_of(jacobian: np.ndarray, load: np.ndarray, rig, readings: bool = False) -> JointFit:
    """A `JointFit` that holds what `causes_of` reads, of a linear campaign in three groups."""
    inverse = np.linalg.inv(np.eye(ROWS) + load @ load.T)
    gain = inverse @ jacobian
    parts = (slice(0, 40), slice(40, 100), slice(100, ROWS))
    groups = tuple(StopGroup(p, np.zeros(p.stop - p.start), gain[p], inverse[p, p]) for p in parts)
    fit = object.__new__(JointFit)
    with jax.enable_x64(True):
        space = jax.tree.map(jnp.asarray, parameter_space(rig.table, rig.stereo))
    seen = np.array([True, True, False])
    # A spot of the padding does not count.
    aperture = np.array([False, readings, True])
    physical = np.full((50, len(NAMES)), 0.5) + 1e-3 * np.random.default_rng(3).normal(size=(50, len(NAMES)))
    values = {
        "information": StopInformation(groups, jacobian.T @ gain, *without_places(jacobian.shape[1])),
        "arrays": SimpleNamespace(spots=SimpleNamespace(has_aperture=aperture, valid=seen)),
        "space": space,
        "z": 0.1 * np.random.default_rng(4).normal(size=len(NAMES)),
        "draws": SimpleNamespace(physical=physical, place_errors_rad=np.zeros((len(physical), 0))),
        "campaign": small_campaign(),
    }
    for name, value in values.items():
        object.__setattr__(fit, name, value)
    return fit


def without_places(parameters: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What `StopInformation` says of errors at places where there are none."""
    return np.zeros(0), np.zeros((0, parameters)), np.zeros((0, 0))


def refitted(jacobian: np.ndarray, load: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How the estimate moves with every datum (parameters, rows) and prior (parameters, parameters), by lstsq."""
    variances, vectors = np.linalg.eigh(np.eye(ROWS) + load @ load.T)
    whitener = vectors @ np.diag(variances**-0.5) @ vectors.T
    system = np.concatenate([whitener @ jacobian, np.eye(len(NAMES))])
    right = np.zeros((len(system), ROWS + len(NAMES)))
    right[:ROWS, :ROWS], right[ROWS:, ROWS:] = whitener, np.eye(len(NAMES))
    moved = np.linalg.lstsq(system, right, rcond=None)[0]
    return moved[:, :ROWS], moved[:, ROWS:]


def slope_of(fit: JointFit) -> np.ndarray:
    """d(inputs)/dz by central differences."""
    columns = [INDEX[name] for name in INPUT_NAMES]
    with jax.enable_x64(True):
        physical = jax.jit(lambda z: fit.space.physical(z))
        moved = [
            [np.asarray(physical(jnp.asarray(fit.z + s * 1e-4 * row)))[columns] for s in (1, -1)]
            for row in np.eye(len(NAMES))
        ]
    return np.array([(plus - minus) / 2e-4 for plus, minus in moved]).T
