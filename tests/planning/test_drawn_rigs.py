"""Instruments that may stand there have coordinates under the priors of the analysis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.coarse_planning import ROUNDING, with_priors

from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import Prior
from tvsbayes.planning.drawn_rigs import BUILD_NAMES, alike, draw_instruments, instruments_in
from tvsbayes.planning.expectation import prior_knowledge
from tvsbayes.twin.true_rig import draw_truth

pytestmark = pytest.mark.usefixtures("small_searches")


def test_truths_have_coordinates(mounted_rig, knowledge):
    generator = np.random.default_rng(8)
    truths = [draw_truth(mounted_rig, generator) for _ in range(3)]
    instruments = instruments_in(knowledge, truths)
    assert len(instruments) == 3
    for drawn, physical in zip(truths, instruments.physical, strict=True):
        for name, index in TWO_MIRROR.index.items():
            true = drawn.parameters.get(name)
            if true is not None:
                assert physical[index] == pytest.approx(true, rel=ROUNDING, abs=ROUNDING), name
        assert physical[-24:] == pytest.approx(drawn.stereo.vector, rel=ROUNDING, abs=1e-6)


def test_what_the_priors_hold_fixed_is_held_at_its_true_value(mounted_rig):
    """U = 0 in the analysis, a spread in [truth]: coordinate 0, in a space of its own."""
    name = "mirror_offset_mm"
    stated = prior_knowledge(with_priors(mounted_rig, mirror_offset_mm=Prior(40.0, 0.0)))
    known = replace(stated, rig=mounted_rig)
    instruments = draw_instruments(known, 4, seed=2)
    assert (instruments.z[:, TWO_MIRROR.index[name]] == 0).all() and len(
        set(instruments.physical[:, TWO_MIRROR.index[name]])
    ) == 4
    second = instruments[np.array([1])]
    assert np.array_equal(second.physical[0], instruments.physical[1])
    assert (
        np.asarray(second.space_of(0).value)[TWO_MIRROR.index[name]] == instruments.physical[1, TWO_MIRROR.index[name]]
    )


def test_after_data_instruments_are_drawn_from_the_posterior(knowledge):
    """Their mean and covariance are those of what is known: 4 standard errors of 400 draws."""
    known = replace(knowledge, after_data=True, z=knowledge.z + 0.5, precision=4.0 * knowledge.precision)
    z = draw_instruments(known, 400, seed=3).z
    assert np.abs(z.mean(axis=0) - 0.5).max() < 5 * 0.5 / 20
    assert z.std() == pytest.approx(0.5, rel=4 / np.sqrt(2 * z.size))


def test_the_next_of_a_build_has_its_play_and_scatter_and_gears_of_its_own(mounted_rig, knowledge):
    """Of another that is known to a hundredth of each prior, half of it off; all else as drawn without it."""
    known = replace(knowledge, after_data=True, z=knowledge.z + 0.5, precision=1e4 * knowledge.precision)
    like, plain = draw_instruments(alike(knowledge, known), 30, seed=3), draw_instruments(knowledge, 30, seed=3)
    build = [
        TWO_MIRROR.index[name] for name in BUILD_NAMES if np.asarray(knowledge.space.u)[TWO_MIRROR.index[name]] > 0
    ]
    assert np.abs(like.z[:, build] - 0.5).max() < 5 * 0.01
    assert plain.z[:, build].std() > 0.5
    ratio = TWO_MIRROR.index["degrees_per_step.pan"]
    assert like.z[:, ratio].std() > 0.5 and abs(like.z[:, ratio].mean()) < 5 / np.sqrt(30)
    assert np.array_equal(alike(knowledge, known).precision, knowledge.precision)
