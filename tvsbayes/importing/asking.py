"""What the importer asks and refuses: rows of `data/words/questions.toml`, filled in with what was found.

A row has a code, `found`, `allowed` and a `remedy`, or `answers`: what an answer says, and the options of `import` that
say it. An answer with {each} stands for one answer of each item.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any

from tvsbayes.errors import Candidate, InputError, Question, escaped, question, refusal
from tvsbayes.files.disk import shipped_data

ANSWERS_MAX = 6
NAMES_MAX = 8


@cache
def _rows() -> dict[str, Any]:
    return tomllib.loads((shipped_data() / "words" / "questions.toml").read_text(encoding="utf-8"))


def listed(names: Iterable[str], most: int = NAMES_MAX) -> str:
    """The first names, quoted safely, and the number of the others."""
    names = list(names)
    rest = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(escaped(name) for name in names[:most]) + rest


def filled(what: str, values: Mapping[str, object]) -> dict[str, str]:
    """Texts of a row; names are made safe to print, lists of them cut."""
    shown = {name: _shown(value) for name, value in values.items()}
    return {name: text.format(**shown) for name, text in _rows()[what].items() if isinstance(text, str)}


def _shown(value: object) -> object:
    if isinstance(value, list | tuple):
        return listed(map(str, value))
    return escaped(value, 1000) if isinstance(value, str) else value


def refused(what: str, file: str, *, line: int | None = None, column: str | None = None, **values: Any) -> InputError:
    """The refusal of a row."""
    text = filled(what, values)
    texts = {name: text[name] for name in ("found", "allowed", "remedy")}
    return refusal(text["code"], file=file, line=line, column=column, **texts)


def asked(
    what: str,
    file: str,
    *,
    line: int | None = None,
    at: str | None = None,
    answers: Sequence[Candidate] = (),
    each: Iterable[object] = (),
    first: Mapping[str, Sequence[str]] | None = None,
    **values: Any,
) -> Question:
    """The question of a row.

    Args:
        what: name of the row.
        file: what is asked about.
        line: its line.
        at: column of a cell.
        answers: answers that the row does not hold.
        each: items of its answers.
        first: first values of the columns that the row's answers are about.
        values: what was found.
    """
    text, given = filled(what, values), list(answers)
    items = list(each)
    for says, *options in _rows()[what].get("answers", ()):
        for item in items if "{each" in f"{says}{options}" else [""]:
            words = tuple(word.format(each=item, **values) for word in options)
            given.append(
                Candidate(says.format(each=item, **{n: _shown(v) for n, v in values.items()}), words, first or {})
            )
    return question(
        file=file,
        line=line,
        column=at,
        found=text["found"],
        allowed=text["allowed"],
        candidates=given[:ANSWERS_MAX],
        code=text["code"],
    )
