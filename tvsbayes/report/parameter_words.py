"""What reports call parameters, causes of uncertainty and tiers: words for readers, beside the names in files."""

from __future__ import annotations

import re

from tvsbayes.instrument.parameters import QUANTITIES
from tvsbayes.results.tiers import CHAIN, IMPORTANCE

_MADE_BY = {
    "laplace": "Laplace approximation at the mode",
    IMPORTANCE: "posterior by importance sampling",
    "posterior": f"posterior sampled by {CHAIN}",
}
IN_WORDS = {**QUANTITIES.words, "extrinsics": "the positioner's pose"}
"""By block of quantities; those of the positioner's pose also as one."""


def made_by(tier: str) -> str:
    """What made the numbers, by tier, or by estimator where results name no tier."""
    return _MADE_BY.get(tier, f"posterior sampled by {tier}")


def name_in_words(name: str) -> str:
    """A quantity for readers, with its part and unit: "laser's direction, x, deg"; other names stay."""
    quantity = QUANTITIES.get(name)
    return name if quantity is None or not quantity.words else quantity.in_words


def source_in_words(source: str) -> str:
    """A row of a budget for readers, with part and unit: a parameter, the prior of one; others stay."""
    for begin, article in (("prior of ln ", ""), ("prior of ", "the ")):
        if source.startswith(begin):
            name = source.removeprefix(begin)
            words = name_in_words(name)
            return begin + article * (words != name) + words
    return name_in_words(source)


def share_in_words(cause: str) -> str:
    """A cause of uncertainty in a table of shares: priors of a group of parameters as one; others stay."""
    name = cause.removeprefix("prior of ")
    return f"prior of {IN_WORDS[name]}" if cause != name and name in IN_WORDS else cause


def cause_in_words(cause: str) -> str:
    """A cause of uncertainty in a sentence."""
    name = cause.removeprefix("prior of ")
    return f"{IN_WORDS[name]} as stated beforehand" if name in IN_WORDS else cause


_NAMES = re.compile(r"\b(?:" + "|".join(sorted(map(re.escape, IN_WORDS), key=len, reverse=True)) + r")\b(?:\.\w+)*")


def sentence_in_words(text: str) -> str:
    """A sentence with parameters by their words; commands between backticks stay."""
    parts = text.split("`")

    def words(match: re.Match[str]) -> str:
        name = match.group()
        quantity = QUANTITIES.get(name)
        if quantity is None or not quantity.words:
            return IN_WORDS.get(name, name)
        return f"{quantity.words} ({' '.join(quantity.parts)})" if quantity.parts else quantity.words

    return "`".join(part if k % 2 else _NAMES.sub(words, part) for k, part in enumerate(parts))
