"""Words of reports for parameters, causes of uncertainty and tiers, in place of the names in files."""

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
"""Words by block of quantities; also of the positioner's pose as a whole."""


def made_by(tier: str) -> str:
    """The method of the numbers in words, by tier, or by estimator where results have no tier."""
    return _MADE_BY.get(tier, f"posterior sampled by {tier}")


def name_in_words(name: str) -> str:
    """A quantity in words, with its part and unit: "laser's direction, x, deg"; other names are unchanged."""
    quantity = QUANTITIES.get(name)
    return name if quantity is None or not quantity.words else quantity.in_words


def source_in_words(source: str) -> str:
    """A row of a budget in words, with part and unit: a parameter or its prior; others are unchanged."""
    for prefix, article in (("prior of ln ", ""), ("prior of ", "the ")):
        if source.startswith(prefix):
            name = source.removeprefix(prefix)
            words = name_in_words(name)
            return prefix + article * (words != name) + words
    return name_in_words(source)


def share_in_words(cause: str) -> str:
    """A cause of uncertainty in a table of shares: the priors of a group are one cause; others are unchanged."""
    name = cause.removeprefix("prior of ")
    return f"prior of {IN_WORDS[name]}" if cause != name and name in IN_WORDS else cause


def cause_in_words(cause: str) -> str:
    """A cause of uncertainty in a sentence."""
    name = cause.removeprefix("prior of ")
    return f"{IN_WORDS[name]} as stated beforehand" if name in IN_WORDS else cause


_NAMES = re.compile(r"\b(?:" + "|".join(sorted(map(re.escape, IN_WORDS), key=len, reverse=True)) + r")\b(?:\.\w+)*")


def sentence_in_words(text: str) -> str:
    """A sentence with words in place of names of parameters; commands between backticks are unchanged."""
    parts = text.split("`")

    def words(match: re.Match[str]) -> str:
        name = match.group()
        quantity = QUANTITIES.get(name)
        if quantity is None or not quantity.words:
            return IN_WORDS.get(name, name)
        return f"{quantity.words} ({' '.join(quantity.parts)})" if quantity.parts else quantity.words

    return "`".join(part if k % 2 else _NAMES.sub(words, part) for k, part in enumerate(parts))
