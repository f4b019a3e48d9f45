"""tvsbayes: what one motor step of a geared laser positioner does to the beam, and how sure that is."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tvsbayes.campaign import read_campaign as read_campaign
    from tvsbayes.joint import fit as fit
    from tvsbayes.posterior import sample as sample

__all__ = ["fit", "read_campaign", "sample"]


def __getattr__(name: str) -> object:
    """Load what is asked for when it is first asked for: readers bring NumPy, the estimator brings JAX."""
    if name == "read_campaign":
        from tvsbayes.campaign import read_campaign

        return read_campaign
    if name == "fit":
        from tvsbayes.joint import fit

        return fit
    if name == "sample":
        from tvsbayes.posterior import sample

        return sample
    if name == "__version__":
        from importlib.metadata import version

        return version("tvsbayes")
    raise AttributeError(f"module 'tvsbayes' has no attribute {name!r}")
