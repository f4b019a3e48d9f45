"""Names of columns in other people's tables: their words by meaning, and the unit that they state.

The words are data: `data/words/tables.toml`, `units.toml`.
"""

from __future__ import annotations

import re
import tomllib
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from typing import NamedTuple

from tvsbayes.files.disk import shipped_data

Phrases = tuple[tuple[str, ...], ...]


def plain(text: str) -> str:
    """Lower case without accents, as the lists of words are spelled."""
    # The ASCII letters alone of microseconds, and of all other millionths, would be another unit.
    text = re.sub("[\u03bc\u00b5]", "u", text).replace("\u03c3", " sigma ").replace("\u00df", "ss")
    return unicodedata.normalize("NFKD", text.lower()).encode("ascii", "ignore").decode()


def words_of(name: str) -> list[str]:
    """The words of a name: "xLeft_px", "X left [px]" and "XL" alike."""
    # "Winkel [\u00b0]" is an angle; a temperature ("\u00b0C") and "N\u00b0" are not.
    name = re.sub("(?<![A-Za-z])[\u00b0\u00ba](?! ?[CFcf]\\b)", " deg ", name)
    name = re.sub("[\u03bc\u00b5](?=[A-Za-z])", "u", name).replace("\u03c3", " sigma ").replace("\u00df", "ss")
    name = name.replace("\u0394", "delta ").replace("\u2206", "delta ")
    ascii_name = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    words = []
    for part in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+", ascii_name):
        word = part.lower()
        # XL, ur, su: axis and camera written together.
        joined = re.fullmatch(r"(s?)([xyuv])([lr])|([lr])([xyuv])|(s)([xyuv])", word)
        words += [piece for piece in joined.groups() if piece] if joined else [word]
    return words


@cache
def _lists(file: str) -> dict[str, Phrases]:
    text = (shipped_data() / "words" / file).read_text("utf-8")
    sections = dict[str, list[str]]()
    for name, languages in tomllib.loads(text).items():
        # Signs are whole cells; the 1 of "Run 1" is none.
        signs = languages.pop("signs", "")
        sections |= {name: " ".join(languages.values()).split(), f"signs of {name}": signs.split()}
    # A sign is no hyphen.
    return {
        name: tuple(tuple(word.split("-")) if word[0].isalpha() else (word,) for word in words)
        for name, words in sections.items()
    }


def vocabulary(concept: str, file: str = "tables.toml") -> Phrases:
    """Words and phrases of a concept, in all languages."""
    return _lists(file)[concept]


def place_of(words: Sequence[str], concept: str, file: str = "tables.toml") -> int | None:
    """Place of the first word or phrase of a concept among words; None where there is none."""
    singles, phrases = _index(concept, file)
    for place, word in enumerate(words):
        if word in singles or any(_matches(words[place : place + len(phrase)], phrase) for phrase in phrases):
            return place
    return None


def _matches(words: Sequence[str], phrase: Sequence[str]) -> bool:
    """Whether words are a phrase; "soll*" and "*winkel" are longer words that begin or end so."""
    if len(words) < len(phrase):
        return False
    if phrase[0].endswith("*"):
        return words[0].startswith(phrase[0][:-1])
    return words[0].endswith(phrase[0][1:]) if phrase[0].startswith("*") else tuple(words) == tuple(phrase)


@cache
def _index(concept: str, file: str) -> tuple[frozenset[str], Phrases]:
    phrases = vocabulary(concept, file)
    singles = {phrase[0] for phrase in phrases if len(phrase) == 1 and "*" not in phrase[0]}
    return frozenset(singles), tuple(p for p in phrases if len(p) > 1 or "*" in p[0])


@lru_cache(maxsize=65536)
def means(text: str, concept: str) -> bool:
    """Whether a whole cell is one of the words of a concept, signs included."""
    cell = plain(text).strip() or text.strip()
    # "+1" and "1.0" are the number 1; a sign alone is a word.
    number = re.fullmatch(r"\+?(\d+)(?:[.,]0*)?", cell)
    return cell in _cells(concept) or (number is not None and number[1] in _cells(concept))


@cache
def _cells(concept: str) -> frozenset[str]:
    phrases = (*vocabulary(concept), *vocabulary(f"signs of {concept}"))
    return frozenset(joined for phrase in phrases for joined in (" ".join(phrase), "-".join(phrase)))


class Unit(NamedTuple):
    """A unit: its name in this package, its kind, base units in one of it, and what the numbers count of it.

    "1/100 mm" is mm with 0.01 as `per_number`.
    """

    name: str
    kind: str
    scale: float
    per_number: float = 1.0

    def in_units_of(self, other: Unit) -> float | None:
        """Numbers of another unit per number of this one; None where the kinds differ."""
        if self.kind != other.kind or self.kind == "other" or (self.kind == "count" and self.name != other.name):
            return None
        return self.scale * self.per_number / (other.scale * other.per_number)

    @property
    def text(self) -> str:
        """Its name, with the part of it that the numbers count."""
        return self.name if self.per_number == 1.0 else f"{self.per_number:g} {self.name}"

    @property
    def whole(self) -> Unit:
        """The unit itself, without its parts."""
        return self._replace(per_number=1.0)


@cache
def _units() -> tuple[dict[str, Unit], dict[str, float]]:
    content = tomllib.loads((shipped_data() / "words" / "units.toml").read_text("utf-8"))
    parts = {word: float(part) for part, names in content.pop("parts").items() for word in names.split()}
    units = {
        alias.replace("-", " "): Unit(name, kind, entry["scale"])
        for kind, entries in content.items()
        for name, entry in entries.items()
        for alias in entry["names"].split()
    }
    return units, parts


def unit_named(name: str) -> Unit:
    """The unit of a name of this package, as "arcsec"."""
    return next(unit for unit in _units()[0].values() if unit.name == name)


_PART = re.compile(
    r"(?:x ?|\* ?)?(?:1 ?/ ?(?P<over>10+)|(?P<decimal>0?[.,]0*1)|10 ?\^? ?-(?P<power>\d)|1e-0?(?P<e>\d))"
    r" ?[x*]? ?(?P<unit>\S.*)"
)


@lru_cache(maxsize=4096)
def parse_unit(text: str) -> Unit | None:
    """The unit that a whole text states, as in brackets: "mm", "1/100 mm", "Hundertstel mm", "mm/100"."""
    units, parts = _units()
    text = re.sub("[\u00b0\u00ba] ?(?=[cfCF]$)", "deg", text.strip().removeprefix("\u00b1").removeprefix("+/-").strip())
    text = {
        "\u00b0": "deg",
        "\u00ba": "deg",
        '"': "inch",
        "''": "arcsec",
        "\u2033": "arcsec",
        "'": "arcmin",
        "\u2032": "arcmin",
        "%": "percent",
        # Umdrehung; a small one is no unit.
        "U": "turn",
    }.get(text, text)
    key = " ".join(plain(text).replace("-", " ").replace("_", " ").strip(" .").split())
    if key in units:
        return units[key]
    if match := _PART.fullmatch(" ".join(plain(text).split())):
        digits = (
            len(match["over"]) - 1
            if match["over"]
            else len(match["decimal"].rpartition(".")[2].rpartition(",")[2])
            if match["decimal"]
            else int(match["power"] or match["e"])
        )
        unit = parse_unit(match["unit"])
        return unit and unit._replace(per_number=10.0**-digits)
    first, _, rest = key.partition(" ")
    if first in parts:
        unit = parse_unit(re.sub("^(?:of|de|d) ", "", rest) or "mm")
        return unit and unit._replace(per_number=parts[first])
    if match := re.fullmatch(r"(\S+) ?/ ?(10+)", key):
        unit = parse_unit(match[1])
        return unit and unit._replace(per_number=1.0 / int(match[2]))
    if "/" in key and parse_unit(key.partition("/")[0]) is not None:
        return Unit("other", "other", 1.0)
    return None


HOUR_ANGLE = Unit("deg", "angle", 1.0, 15.0)
"""An hour of right ascension."""
_BRACKETS = re.compile(r"[(\[{]([^()\[\]{}]*)[)\]}]")
_COVERAGE = re.compile(r"\bk\s*=?\s*([0-9]+(?:[.,][0-9]+)?)\b|\b([23])\s*(?:x\s*)?(?:sd|s|std|stdev|stabw|sigma)\b")
"""Coverage factor in the name of a column of expanded uncertainties (GUM, 6.2), or a multiple of sd."""
COVERAGE_USUAL = 2.0
_KNOWN = (
    *(
        "number",
        "command",
        "value",
        "position",
        "deviation",
        "u",
        "expanded",
        "time",
        "segment",
        "approach",
        "status",
        "excluded",
        "order",
        "speed",
        "increment",
        "homing",
        "condition",
        "moving",
    ),
    *("resting", "temperature", "repeat", "index", "aside", "statistic", "run", "several", "forward", "backward"),
    *("clockwise", "counterclockwise"),
)


@dataclass(frozen=True)
class Name:
    """A column's name.

    Attributes:
        text: as written.
        words: its words without those of the unit.
        unit: the unit that it states.
        unknown: the text of a unit in brackets that nobody knows, else "".
    """

    text: str
    words: tuple[str, ...]
    unit: Unit | None
    unknown: str

    @cached_property
    def _places(self) -> dict[str, int | None]:
        return {concept: place_of(self.words, concept) for concept in _KNOWN}

    def place(self, concept: str) -> int | None:
        """Place of the first word of a concept."""
        return self._places[concept]

    def has(self, *concepts: str) -> bool:
        """Whether a word of one of the concepts is in it."""
        return any(self._places[concept] is not None for concept in concepts)

    @property
    def numbers(self) -> tuple[int, ...]:
        """Whole numbers among its words."""
        return tuple(int(word) for word in self.words if word.isdigit())

    @property
    def is_time(self) -> bool:
        """Whether it names a time; a letter t beside other words, as in "T cam", does not."""
        place, is_unit = self.place("time"), self.unit is not None and self.unit.kind == "time"
        return is_unit or (place is not None and (self.words[place] != "t" or len(self.words) == 1))

    @cached_property
    def is_u(self) -> bool:
        """Whether it names an uncertainty, standard or expanded, or a multiple of a standard deviation."""
        return self.has("u", "expanded") or "\u00b1" in self.text or _COVERAGE.search(plain(self.text)) is not None

    @cached_property
    def is_spread(self) -> bool:
        """Whether it names a multiple of a standard deviation."""
        match = _COVERAGE.search(plain(self.text))
        return match is not None and match[2] is not None

    @cached_property
    def coverage(self) -> float | None:
        """The coverage factor of an expanded uncertainty; None for a standard one."""
        text = plain(self.text)
        if match := _COVERAGE.search(text):
            return float((match[1] or match[2]).replace(",", ".")) or None
        capital = re.match(r"U(?![A-Za-z])", self.text.strip()) is not None
        return COVERAGE_USUAL if capital or self.has("expanded") or re.search(r"\b95 ?%|\b95\b", text) else None


def name_of(text: str) -> Name:
    """Read a column's name."""
    unit, unknown, rest = None, "", text
    for match in reversed(list(_BRACKETS.finditer(text))):
        # Whole first: "0,01 mm" is one unit.
        pieces = [match[1], *re.split("[,;]", match[1])]
        unit = next((found for piece in pieces if (found := parse_unit(piece)) is not None), None)
        if unit is not None:
            rest = text[: match.start()] + " " + text[match.end() :]
            break
        if not unknown and (_is_unit_like(match[1]) or part_of_unit(match[1])):
            unknown, rest = match[1].strip(), text[: match.start()] + " " + text[match.end() :]
    words = words_of(rest)
    if unit is None and not unknown:
        unit, words = _unit_of_words(rest, words)
    if unit is not None and unit.name == "h" and place_of(words, "hour-angle") is not None:
        unit = HOUR_ANGLE
    return Name(text, tuple(words), unit, "" if unit else unknown)


def part_of_unit(content: str) -> str:
    """A number and its unit of length or angle at the end of a longer text, as in "div 0.01 mm"; "" without one."""
    match = re.search(r"([0-9]+(?:[.,][0-9]+)?) ?([^\W\d]+)\s*$", content)
    unit = None if match is None else parse_unit(match[2])
    return match[0] if match and unit is not None and unit.kind in ("length", "angle") else ""


def _is_unit_like(content: str) -> bool:
    """Whether brackets hold what can be a unit: no index, no word with another meaning."""
    words = words_of(content)
    if (
        not words
        or len(content) > 24
        or all(word.isdigit() for word in words)
        or re.match(r"\s*[ijkn](\s*[,=]|\s*$)", content)
    ):
        return False
    return not any(place_of(words, concept) is not None for concept in _KNOWN) and len(words) <= 3


def _unit_of_words(text: str, words: list[str]) -> tuple[Unit | None, list[str]]:
    """A unit without brackets: at the end of a name, after a slash or comma, or a clear word anywhere."""
    units, _ = _units()
    if "%" in text:
        return Unit("other", "other", 1.0), words
    if (after := re.search(r"(?:\s/\s*|[,:]\s*|\sin\s+)([^,/:]+)$", text)) and (
        unit := parse_unit(after[1])
    ) is not None:
        if text[: after.start()].strip():
            return unit, [*words_of(text[: after.start()]), *_of_count(unit, after[1])]
    parted = re.search(r"(?:(?:1/10+|0[.,]0*1) ?[a-z]+|[a-z]+ ?/ ?10+|[a-z]+ (?:of |de )?[a-z]+)$", plain(text))
    if parted and (unit := parse_unit(parted[0])) is not None and unit.per_number != 1.0:
        return unit, words_of(text[: parted.start()])
    if (slash := re.search(r"([A-Za-z]+)/([A-Za-z]+)$", text)) and parse_unit(slash[1]) and parse_unit(slash[2]):
        return Unit("other", "other", 1.0), words
    if len(words) == 1 and place_of(words, "value") is not None:
        # "Micrometer" is what was read.
        return None, words
    end = len(words)
    while end and words[end - 1].isdigit():
        end -= 1
    for size in (2, 1):
        last = " ".join(words[max(0, end - size) : end])
        unit = units.get(last) if end >= size else None
        if unit is not None and _may_end(unit, last, words[: end - size]):
            return unit, words if unit.kind == "count" else [*words[: end - size], *words[end:]]
    for place, word in enumerate(words):
        unit = units.get(word)
        clear = len(word) > 2 or word in ("mm", "um", "nm", "cm")
        if (
            unit is not None
            and clear
            and unit.kind in ("length", "angle")
            and not _is_direction(word)
            and word != "mil"
        ):
            return unit, words[:place] + words[place + 1 :]
    return next((units[word] for word in words if word in units and units[word].kind == "count"), None), words


def _of_count(unit: Unit, text: str) -> list[str]:
    return words_of(text) if unit.kind == "count" else []


def _may_end(unit: Unit, word: str, before: Sequence[str]) -> bool:
    """Whether a word at the end of a name is its unit, by the words before it."""
    if unit.kind in ("other", "voltage"):
        return False
    if _is_direction(word) and unit.kind != "temperature":
        # "Rev 1" is a run, "Measured rev" a number of revolutions.
        return any(place_of(before, concept) is not None for concept in ("command", "value", "position"))
    if unit.kind == "temperature":
        named = place_of(before, "temperature") is not None or before[:1] == ["t"]
        return named or word in ("celsius", "kelvin", "fahrenheit", "degc")
    if unit.kind == "time" and len(word) < 2:
        return place_of(before, "time") is not None or place_of(before, "hour-angle") is not None
    return True


def _is_direction(word: str) -> bool:
    return place_of([word], "forward") is not None or place_of([word], "backward") is not None
