"""Names of the methods that draw from a posterior; loads no library, since commands need the names before they run."""

IMPORTANCE, CHAIN = TIERS = ("importance", "emcee")
"""Weighted independent draws, or a chain, named by the library that runs it."""
