"""Vectors, rotations and mirrors: their laws in Python floats, NumPy and JAX; the chain against the twin's."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.printed_vector import VECTOR

from tvsbayes.instrument.chains import chain_of
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.mirrors import (
    Optics,
    Vectors,
    beam_path,
)
from tvsbayes.instrument.parameters import BLOCKS, OPTICS_NAMES
from tvsbayes.twin.physics import mirror_chain

ROUNDING = 1e-15
"""Half a dozen operations on numbers of order one."""
CHAIN_ROUNDING = 1e-12
"""A hundred operations on lengths up to 30 mm, and on numbers of order one."""
PAN_RAD, TILT_RAD = np.radians([10.0, -25.0, 3.0]), np.radians([5.0, -12.0, 20.0])


def optics() -> Optics:
    """Optics of the printed test vector; the registry names the parameters of each field."""

    def block(name: str) -> float | list[float]:
        values = [math.radians(VECTOR[n]) if name.endswith("_deg") else VECTOR[n] for n in BLOCKS[name]]
        return values if len(values) > 1 else values[0]

    return chain_of(TWO_MIRROR, block)


def test_products_of_vectors():
    first, second = np.random.default_rng(3).standard_normal((2, 3, 5, 7))
    one, other = Vectors.of(first), Vectors.of(second)
    np.testing.assert_allclose(one.dot(other), np.sum(first * second, axis=0), atol=10 * ROUNDING)
    np.testing.assert_allclose(one.cross(other).stacked(), np.cross(first, second, axis=0), atol=10 * ROUNDING)


def test_the_chain_is_the_twins():
    """In frame P."""
    values = {name: VECTOR[name] for name in OPTICS_NAMES}
    for pan, tilt in zip(PAN_RAD.tolist(), TILT_RAD.tolist(), strict=True):
        way = beam_path(optics(), pan, tilt, math)
        parts = [np.array(way.pan.forward(part)) for part in way.rays[-1]]
        for part, expected in zip(parts, mirror_chain(pan, tilt, values), strict=True):
            np.testing.assert_allclose(part, expected, atol=CHAIN_ROUNDING)


@pytest.mark.usefixtures("x64")
def test_floats_numpy_and_jax_agree():
    """Derivatives too: NumPy's by a complex step (Squire and Trapp, SIAM Review 40 (1998) 110), JAX's own."""

    def ends(pan, functions):
        return beam_path(optics(), pan, TILT_RAD, functions).rays[-1]

    step = 1e-30
    expected, slopes = jax.jvp(lambda pan: ends(pan, jnp), (jnp.asarray(PAN_RAD),), (jnp.ones(3),))
    moved = ends(PAN_RAD + 1j * step, np)
    for k in range(2):
        np.testing.assert_allclose(ends(PAN_RAD, np)[k], expected[k], atol=CHAIN_ROUNDING)
        np.testing.assert_allclose(np.array(moved[k]).imag / step, slopes[k], atol=10 * CHAIN_ROUNDING)
        singles = [beam_path(optics(), p, t, math).rays[-1][k] for p, t in zip(PAN_RAD, TILT_RAD, strict=True)]
        np.testing.assert_allclose(np.transpose(singles), expected[k], atol=CHAIN_ROUNDING)
