"""What makes the draws of a posterior, by name. No library is loaded: commands name them before they run."""

IMPORTANCE, CHAIN = TIERS = ("importance", "emcee")
"""Weighted independent draws, or a chain, named by the library that runs it."""
