"""Versions of installed packages."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

UNKNOWN = "unknown"
"""A version in texts, where metadata are missing."""


def version_of(package: str) -> str | None:
    """The version of a package; None where its metadata are missing, as in a copied environment."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def own_version() -> str:
    """The version of tvsbayes, for texts."""
    return version_of("tvsbayes") or UNKNOWN
