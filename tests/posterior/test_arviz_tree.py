"""Variables of posterior.nc with their dimensions, from draws made by hand."""

from __future__ import annotations

import numpy as np
import pytest
from support.drawn_quantities import drawn_quantities

from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import AMPLITUDE_NAMES, INDEX, NAMES
from tvsbayes.posterior.arviz_tree import COORDS, VARIABLES, _dataset, _variables

SHAPE = 2, 3
"""Chains and draws."""


@pytest.fixture
def draws():
    """Every parameter has values of its own in every draw."""
    physical = np.arange(np.prod(SHAPE) * len(NAMES), dtype=float).reshape(*SHAPE, len(NAMES))
    return drawn_quantities(*SHAPE, physical=physical)


@pytest.mark.parametrize("count", [1, 2, len(AMPLITUDE_NAMES)])
def test_amplitudes_of_stated_periods_have_a_dimension_of_their_own(draws, count):
    """One period or all: the labels are those of the contract names."""
    varying = AMPLITUDE_NAMES[-count:]
    variable = _dataset(_variables(draws, set(varying), SHAPE, TWO_MIRROR))["harmonic_amplitude_deg"]
    dim = variable.dims[-1]
    assert variable.sizes == {"chain": 2, "draw": 3, dim: count}
    assert [f"harmonic_amplitude_deg.{label}" for label in variable[dim].values] == list(varying)
    for label, name in zip(variable[dim].values, varying, strict=True):
        np.testing.assert_array_equal(variable.sel({dim: label}), draws.physical[..., INDEX[name]])


def test_every_variable_of_several_names_has_a_dimension_with_as_many_labels(draws):
    """All parameters at once, whatever a rig may leave open."""
    for name, variable in VARIABLES.items():
        labels = 1 if variable.dim is None else len(COORDS[variable.dim])
        assert labels == len(variable.names), name
    whole = _dataset(_variables(draws, {n for spec in VARIABLES.values() for n in spec.names}, SHAPE, TWO_MIRROR))
    assert set(whole.data_vars) == set(VARIABLES)
