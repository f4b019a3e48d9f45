"""What is found in a campaign before a fit: one record of it, and the command that mends it.

A finding is certain where no rig, however odd, leaves such spots: commands that fit stop there. All others are doubts,
which are printed and stop nothing. No units, no frames.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from tvsbayes.errors import InputError, typed
from tvsbayes.instrument.campaign import Campaign


@dataclass(frozen=True)
class Finding:
    """What contradicts a campaign's tables.

    Attributes:
        code: short stable identifier, e.g. "counter-sign".
        message: what was seen and where, in words.
        remedy: what to do, with the command where one mends it; "" where the message says it.
        certain: no rig leaves this; commands that fit stop.
        file: of the campaign, None where no single one is wrong.
        line: the row in that file where it shows, 1-based, or None.
    """

    code: str
    message: str
    remedy: str = ""
    certain: bool = False
    file: str | None = None
    line: int | None = None

    @property
    def sentence(self) -> str:
        """Message and remedy in one sentence."""
        return f"{self.message}; {self.remedy}" if self.remedy else self.message


def doubts(code: str, sentences: Iterable[str], file: str | None = None) -> list[Finding]:
    """Findings that stop nothing, of what was said in words alone."""
    return [Finding(code, sentence, file=file) for sentence in sentences]


def line_of(row: int) -> int:
    """The line of a row of `moves.csv` or `spots.csv`, which begin with one line of names; rows count from 0."""
    return row + 2


def mending_command(campaign: Campaign, options: str) -> str:
    """The command that writes a corrected copy of a campaign, as it is typed."""
    if campaign.path is None:
        return f"`tvsbayes import CAMPAIGN --to MENDED {options} --yes`"
    folder = Path(campaign.path)
    mended = folder.parent / f"{folder.resolve().name}-mended"
    # "." has no name of its own, and its copy belongs beside it.
    mended = mended if folder.name else Path("..") / mended.name
    return f"`tvsbayes import {typed(folder)} --to {typed(mended)} {options} --yes`"


def stop_at(findings: Iterable[Finding], go_on: str) -> None:
    """Refuse a campaign with a certain finding.

    Args:
        findings: of the campaign.
        go_on: how to fit it all the same, in words.

    Raises:
        InputError: the first certain finding, the others in its message.
    """
    certain = [finding for finding in findings if finding.certain]
    if not certain:
        return
    first = certain[0]
    message = "; ".join(finding.message for finding in certain)
    remedies = dict.fromkeys(finding.remedy for finding in certain)
    remedy = f"{'; '.join(filter(None, remedies))}; {go_on}"
    raise InputError(first.code, message, file=first.file, line=first.line, remedy=remedy)
