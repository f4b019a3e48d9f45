"""A small campaign with a kept fit that is stated to be its own, and its certificate."""

from __future__ import annotations

import datetime
import xml.etree.ElementTree as ET
from dataclasses import dataclass, replace
from pathlib import Path

from msgspec import structs
from support.known_calibration import known_calibration
from support.small_campaign import small_campaign

from tvsbayes.instrument.campaign import Campaign, input_hashes
from tvsbayes.metrology.positioning_table import positioning
from tvsbayes.metrology.scanner_certificate import dcc_bytes
from tvsbayes.results.fit_record import FitEvidence, FitRecord, read_fit

KEPT = Path(__file__).parents[1] / "data"
ISSUED = datetime.date(2026, 11, 21)


@dataclass(frozen=True)
class Certified:
    """A campaign and its fit."""

    campaign: Campaign
    fit: FitRecord

    def with_summary(self, **changes: object) -> Certified:
        """Another summary."""
        return replace(self, fit=replace(self.fit, summary=structs.replace(self.fit.summary, **changes)))

    def with_play(self, value: float, sd: float, interval95: tuple[float, float]) -> Certified:
        """Another backlash of the pan axis."""
        parameters = self.fit.summary.parameters
        play = structs.replace(parameters["backlash_deg.pan"], value=value, sd=sd, interval95=interval95)
        return self.with_summary(parameters={**parameters, "backlash_deg.pan": play})

    def with_provenance(self, **changes: object) -> Certified:
        """Made otherwise."""
        return replace(self, fit=replace(self.fit, provenance=structs.replace(self.fit.provenance, **changes)))

    def with_positioning(self) -> Certified:
        """With an ISO 230-2-style table."""
        known = known_calibration(**{"backlash_deg.pan": 0.3, "stop_sd_deg.left": 0.1})
        evidence = FitEvidence(positioning=(positioning(known, "pan", tests=200),))
        return replace(self, fit=replace(self.fit, evidence=evidence))

    def certificate(self, **options: object) -> bytes:
        """Issued on a fixed day."""
        return dcc_bytes(self.campaign, self.fit, **{"issued": ISSUED, **options})

    def root(self, **options: object) -> ET.Element:
        """Of its certificate."""
        return ET.fromstring(self.certificate(**options))


def certified(**header: object) -> Certified:
    """The small campaign and a kept fit whose inputs are stated to be its own; None leaves a key of the header out."""
    campaign = small_campaign()
    merged = {key: value for key, value in {**campaign.header, **header}.items() if value is not None}
    campaign = replace(campaign, header=merged)
    return Certified(campaign, read_fit(KEPT / "fit-1-laplace.json")).with_provenance(inputs=input_hashes(campaign))


def texts(root: ET.Element, path: str) -> list[str]:
    """Text of all elements under a path of local names, prefixes as in the document."""
    return [e.text for e in root.findall(path, {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si"})]
