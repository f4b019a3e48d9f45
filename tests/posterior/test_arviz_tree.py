"""Variables of posterior.nc with their dimensions, from draws made by hand; the tree of weighted draws."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.drawn_quantities import drawn_quantities
from support.small_posterior import SEED, mapped_already, small_fit

from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import AMPLITUDE_NAMES
from tvsbayes.posterior.arviz_tree import COORDS, RESAMPLED, VARIABLES, data_tree, dataset
from tvsbayes.posterior.sampling import sample
from tvsbayes.results.tiers import IMPORTANCE

SHAPE = 2, 3
"""Chains and draws."""


@pytest.fixture
def draws():
    """Every parameter has values of its own in every draw."""
    physical = np.arange(np.prod(SHAPE) * len(TWO_MIRROR.names), dtype=float).reshape(*SHAPE, len(TWO_MIRROR.names))
    return drawn_quantities(*SHAPE, physical=physical)


@pytest.mark.parametrize("count", [1, 2, len(AMPLITUDE_NAMES)])
def test_amplitudes_of_stated_periods_have_a_dimension_of_their_own(draws, count):
    """One period or all: the labels are those of the contract names."""
    varying = AMPLITUDE_NAMES[-count:]
    variable = dataset(draws, set(varying), SHAPE, TWO_MIRROR)["harmonic_amplitude_deg"]
    dim = variable.dims[-1]
    assert variable.sizes == {"chain": 2, "draw": 3, dim: count}
    assert [f"harmonic_amplitude_deg.{label}" for label in variable[dim].values] == list(varying)
    for label, name in zip(variable[dim].values, varying, strict=True):
        np.testing.assert_array_equal(variable.sel({dim: label}), draws.physical[..., TWO_MIRROR.index[name]])


def test_every_variable_of_several_names_has_a_dimension_with_as_many_labels(draws):
    """All parameters at once, whatever a rig may leave open."""
    for name, (names, dim) in VARIABLES.items():
        assert len(names) == (1 if dim is None else len(COORDS[dim])), name
    whole = dataset(draws, {n for names, _ in VARIABLES.values() for n in names}, SHAPE, TWO_MIRROR)
    assert set(whole.data_vars) == set(VARIABLES)


@pytest.mark.thorough
def test_weighted_draws_become_one_chain_with_their_weights(monkeypatch):
    mapped_already(monkeypatch)
    posterior = sample(small_fit()[0], IMPORTANCE, seed=SEED)
    tree = data_tree(posterior)
    stats = tree["sample_stats"]
    assert dict(stats.sizes) == {"chain": 1, "draw": RESAMPLED}
    source = stats["source"].values[0]
    weights = posterior.weights.ravel()
    np.testing.assert_array_equal(stats["log_weight"].values[0], np.log(weights[source]))
    # Systematic resampling takes a draw as often as its weight says, rounded down or up.
    counts = np.bincount(source, minlength=len(weights))
    assert np.all(np.abs(counts - RESAMPLED * weights) < 1)
    name = "effective_deg_per_step.left"
    drawn = tree["posterior"]["effective_deg_per_step"].sel(direction="left").values[0]
    np.testing.assert_array_equal(drawn, posterior.by_name[name][source])
    assert json.loads(tree.attrs["ess_mean"])[name] == pytest.approx(posterior.convergence.ess_bulk[name])
