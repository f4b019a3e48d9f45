"""Text files for other programs, filled from the templates in `data/export`."""

from __future__ import annotations

from functools import cache

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from tvsbayes.files.disk import shipped_data


@cache
def _environment() -> Environment:
    return Environment(
        loader=FileSystemLoader(str(shipped_data() / "export")),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def filled(name: str, **content: object) -> str:
    """Fill a template; a name in it that has no content is an error."""
    return _environment().get_template(name).render(double=double, **content)


def double(text: str) -> str:
    """A literal of C for a formatted number, which is no integer."""
    return text if set(text) & set(".en") else f"{text}.0"
