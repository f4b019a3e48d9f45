"""From campaign folders to what a page shows of them: results where there are some of exactly these data.

Nothing is fitted: a folder without results is shown as it is stated.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tvsbayes.instrument.campaign import Campaign, read_campaign
from tvsbayes.pipeline import StoredOrFitted, Tell, compile_for, untold
from tvsbayes.report.evidence import gear_bands
from tvsbayes.view.scene import Fitted, Looked, scene

NOT_FITTED = "no results: the rig is drawn as campaign.toml states it; `tvsbayes fit` adds residuals and the fitted rig"
NOT_OF_THESE = (
    "results/ are of other data, of a fit that did not converge, or of another version: the rig is drawn as "
    "campaign.toml states it; run `tvsbayes fit` again"
)


@dataclass(frozen=True)
class StoredCampaign:
    """A campaign with what its results say; `fitted` is None, and `note` says why, where there are none to use."""

    campaign: Campaign
    fitted: Fitted | None
    note: str | None


def stored_campaign(folder: Path) -> StoredCampaign:
    """A campaign folder and its results.

    Raises:
        InputError: no campaign, or damaged results.
    """
    campaign = read_campaign(folder)
    results = StoredOrFitted(campaign)
    record, calibration = results.stored_record, results.stored_calibration
    fit = None if record is None else results.stored_fit
    if record is None or calibration is None or fit is None:
        stored = (Path(folder) / "results" / "fit.json").exists()
        return StoredCampaign(campaign, None, NOT_OF_THESE if stored else NOT_FITTED)
    from tvsbayes.assessment.residuals import stop_residuals

    return StoredCampaign(campaign, Fitted(fit, record, stop_residuals(fit), gear_bands(calibration)), None)


def look_at(folder: Path, beside: Path | None = None, tell: Tell = untold) -> Looked:
    """What a page shows of a campaign, beside another where one is named.

    Args:
        folder: of the campaign.
        beside: of a later one of the same instrument.
        tell: shows what takes long.

    Raises:
        InputError: no campaign, or damaged results.
    """
    compile_for(tell)
    campaigns = [stored_campaign(one) for one in (folder, beside) if one is not None]
    scenes = tuple(scene(one.campaign, one.fitted, [one.note] if one.note else []) for one in campaigns)
    fits = [one.fitted.fit for one in campaigns if one.fitted is not None]
    if len(fits) < 2:
        return Looked(scenes)
    from tvsbayes.comparison.changes import compare

    return Looked(scenes, compare(*fits))
