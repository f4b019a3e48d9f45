"""Names of the methods that draw from a posterior; loads no library, since commands need the names before they run."""

from collections.abc import Mapping

IMPORTANCE, CHAIN = "importance", "emcee"
"""Weighted independent draws, or the chain of fits, named by the library that runs it."""
RUNS: Mapping[str, str] = {CHAIN: "ensemble:Run"}
"""What runs a chain, by tier: a module of `inference` and its class, made as `Run` is."""
TIERS = (IMPORTANCE, *RUNS)
