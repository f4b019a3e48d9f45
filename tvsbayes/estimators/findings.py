"""Findings in a campaign before a fit, and the command that corrects each.

A finding is certain where no possible rig produces such spots: commands that fit stop there. All others are doubts,
which are printed and do not stop a command. No units, no frames.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from tvsbayes.errors import InputError, typed
from tvsbayes.instrument.campaign import Campaign


@dataclass(frozen=True)
class Finding:
    """A contradiction in a campaign's tables.

    Attributes:
        code: short stable identifier, e.g. "counter-sign".
        message: what was found and where, in words.
        remedy: what to do, with the command where one corrects it; "" where the message says it.
        certain: no rig produces this; commands that fit stop.
        file: name of the wrong file of the campaign, None where it is not a single one.
        line: line in that file, 1-based, or None.
    """

    code: str
    message: str
    remedy: str = ""
    certain: bool = False
    file: str | None = None
    line: int | None = None

    @property
    def sentence(self) -> str:
        """Return message and remedy as one sentence."""
        return f"{self.message}; {self.remedy}" if self.remedy else self.message


def doubts(code: str, sentences: Iterable[str], file: str | None = None) -> list[Finding]:
    """Make findings that do not stop a command from sentences."""
    return [Finding(code, sentence, file=file) for sentence in sentences]


def line_of(row: int) -> int:
    """Return the line of a row of `moves.csv` or `spots.csv`, after one line of names; rows count from 0."""
    return row + 2


def mending_command(campaign: Campaign, options: str) -> str:
    """Return the command to type that writes a corrected copy of a campaign."""
    if campaign.path is None:
        return f"`tvsbayes import CAMPAIGN --to MENDED {options} --yes`"
    folder = Path(campaign.path)
    mended = folder.parent / f"{folder.resolve().name}-mended"
    # "." has no name; its copy is written beside it.
    mended = mended if folder.name else Path("..") / mended.name
    return f"`tvsbayes import {typed(folder)} --to {typed(mended)} {options} --yes`"


def stop_at(findings: Iterable[Finding], go_on: str) -> None:
    """Refuse a campaign with a certain finding.

    Args:
        findings: findings in the campaign.
        go_on: how to fit it nevertheless, in words.

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
