"""Quantities of any instrument: one entry has name, unit, words, purpose and where it applies.

Every instrument has its own list. The model computes a quantity from draws, the twin from a true instrument, each under
the entry's name.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, Self

from tvsbayes.instrument.axes import AXES, SENSES, Axis

Unit = Literal["deg/step", "deg/K", "deg", "rad", "mm", "px", "min", "1"]


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """One quantity of an instrument.

    Attributes:
        name: in JSON, draws, `posterior.nc` and tables.
        block: the name without its part; quantities that differ only in the part share it.
        unit: unit of its values; a single unit only where all instruments of the kind share it.
        words: name of the block in a sentence.
        label: name in tables.
        headline: a main result of a fit; the posterior's convergence is assessed by it.
        target: name under which plans and studies may target it.
        judged: a headline whose budget, leverage and sensitivity to priors are reported.
        ratio: degrees of the beam per step; only for directions in which the axis moved.
        stated: the parameter whose stated value studies compare with it; 0 if none.
    """

    name: str
    block: str
    unit: str
    words: str = ""
    label: str = ""
    headline: bool = False
    target: str = ""
    judged: bool = False
    ratio: bool = False
    stated: str = ""

    @property
    def parts(self) -> tuple[str, ...]:
        """Parts of the name after the block."""
        return tuple(self.name.removeprefix(self.block).split("."))[1:]

    @property
    def unit_text(self) -> str:
        """The unit beside a value; "" for a number."""
        return "" if self.unit == "1" else self.unit

    @property
    def in_words(self) -> str:
        """Words, part and unit: "laser's direction, x, deg"."""
        return ", ".join(filter(None, (self.words.removeprefix("the "), " ".join(self.parts), self.unit_text)))

    @property
    def axis(self) -> Axis | None:
        """Its axis; None where it belongs to no axis or to both."""
        return next((axis for axis in AXES if {axis, *SENSES[axis]} & set(self.parts)), None)

    @property
    def sides(self) -> tuple[str, ...]:
        """Both directions of its axis."""
        return () if self.axis is None else SENSES[self.axis]

    def applies(self, moved: Collection[str]) -> bool:
        """Whether a campaign with moves in these directions has the quantity."""
        directions = set(self.sides).intersection(self.parts) or set(self.sides)
        return not self.ratio or directions <= set(moved)

    @classmethod
    def many(cls, block: str, parts: Collection[str], **fields: Any) -> list[Self]:
        """Make quantities that differ only in their parts; a scalar has no parts.

        Texts may name parts as {0}, {1} ..., the axis as {axis}, and both of its directions as {sides}.
        """
        quantities = []
        for name in [f"{block}.{part}" for part in parts] or [block]:
            quantity = cls(name=name, block=block, **fields)
            parts_by_key = {"axis": quantity.axis, "sides": " - ".join(quantity.sides)}
            templates = {key: getattr(quantity, key) for key in ("label", "target", "stated")}
            texts = {key: text.format(*quantity.parts, **parts_by_key) for key, text in templates.items()}
            quantities.append(replace(quantity, **texts))
        return quantities


class Quantities[Q: Quantity](dict[str, Q]):
    """Entries by name, in the order of vectors and files."""

    def __init__(self, *entries: Q) -> None:
        super().__init__((entry.name, entry) for entry in entries)

    @cached_property
    def blocks(self) -> dict[str, tuple[str, ...]]:
        """Names by block."""
        blocks: dict[str, tuple[str, ...]] = {}
        for entry in self.values():
            blocks[entry.block] = (*blocks.get(entry.block, ()), entry.name)
        return blocks

    @cached_property
    def words(self) -> dict[str, str]:
        """Words by block."""
        return {entry.block: entry.words for entry in self.values() if entry.words}

    def of(self, name: str) -> Q | None:
        """The entry of a name; where its parts are counters, the entry of the block."""
        return self.get(name) or self.get(name.split(".", maxsplit=1)[0])
