"""A chain is extended until its diagnosis passes."""

from __future__ import annotations

import numpy as np

from tvsbayes.inference import ensemble
from tvsbayes.inference.chain import Chain
from tvsbayes.inference.diagnosis import TAU_LIMIT


def test_a_chain_is_lengthened_as_its_autocorrelation_asks():
    """Of a chain whose autocorrelation time is known: (1 + rho) / (1 - rho) steps."""
    generator, rho, walkers = np.random.default_rng(11), 0.6, 256
    w = generator.standard_normal((1000, walkers, 1))
    for step in range(1, len(w)):
        w[step] = rho * w[step - 1] + np.sqrt(1 - rho**2) * w[step]
    tau = (1 + rho) / (1 - rho)
    for steps, short in ((100, True), (140, True), (1000, False)):
        chain = Chain(w[:steps], w[:steps, :, 0], np.ones(walkers), (), 0, 0.0, steps)
        run = ensemble.Run.__new__(ensemble.Run)
        run.chain, run.goal = lambda chain=chain: chain, steps
        assert run.too_short() is short
        # The mean taken off a chain of n steps takes tau / n off each of the two windows of five tau that are summed;
        # a tenth is for chance.
        kept = 0.9 * steps
        wanted = TAU_LIMIT * tau / 0.9 * np.array([(1 - 10 * tau / kept) * 0.9, 1.1])
        least, most = np.clip(wanted, *(steps * np.array(ensemble.LENGTHENING_RANGE))) if short else (steps, steps)
        assert least <= run.goal <= most + 1
