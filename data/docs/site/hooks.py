"""Builds the site of the documents (mkdocs): pages from outside data/, links between them, formulas, API reference.

In the site `data/` is the root; README is its index; CONTRIBUTING, CHANGELOG and `experiments/` keep their places.
Links between files of the repository become links of the site. Formulas become MathML while the site is built, so that
a browser needs no script and no network for them.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import TYPE_CHECKING

from latex2mathml.converter import convert
from mkdocs.structure.files import File, InclusionLevel

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[3]
OUTSIDE = ("CONTRIBUTING.md", "CHANGELOG.md", "CITATION.cff", "LICENSE", "tvsbayes/positioner/firmware/README.md")
"""Pages and files from outside data/ that stand in the site where they stand in the repository."""
LINK = re.compile(r"(\]\()([^)#\s]+)")
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
CSS = """math { font-family: "Cambria Math", "STIX Two Math", "Latin Modern Math", math, serif; }
math[display=block] { overflow-x: auto; padding: 0.4em 0; }
"""
ROOM = re.compile(r"^\| `(\w+)` \|", re.MULTILINE)


def place_in_site(path: str) -> str:
    """Where a file of the repository stands in the site."""
    return "index.md" if path == "README.md" else path.removeprefix("data/")


def place_in_repository(path: str) -> str:
    """The reverse of `place_in_site`."""
    if path == "index.md":
        return "README.md"
    return f"data/{path}" if (ROOT / "data" / path).exists() else path


def modules() -> dict[str, list[str]]:
    """Modules by room, in the order of the rooms in architecture.md."""
    text = (ROOT / "data" / "docs" / "architecture.md").read_text(encoding="utf-8").split("## Rooms")[1]
    found = {}
    for room in ROOM.findall(text):
        names = sorted(path.stem for path in (ROOT / "tvsbayes" / room).glob("*.py") if path.stem != "__init__")
        found[room] = [f"tvsbayes.{room}.{name}" for name in names] or [f"tvsbayes.{room}"]
    return found


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the reference's pages into the navigation."""
    pages = [f"reference/{package}.md" for package in modules()]
    config.nav = [{"Reference": pages} if entry == {"Reference": []} else entry for entry in config.nav]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what does not lie in data/ and what is generated."""

    def add(place: str, content: str | bytes) -> None:
        files.append(File.generated(config, place, content=content, inclusion=InclusionLevel.INCLUDED))

    experiments = [path for path in sorted((ROOT / "experiments").rglob("*")) if path.suffix in (".md", ".png")]
    experiments = [path for path in experiments if "output" not in path.parts]
    for path in (ROOT / "README.md", *(ROOT / name for name in OUTSIDE), *experiments):
        content = path.read_bytes()
        place = place_in_site(path.relative_to(ROOT).as_posix())
        add(place, content.decode() if path.suffix == ".md" else content)
    for package, names in modules().items():
        add(f"reference/{package}.md", "\n\n".join([f"# {package}", *(f"::: {name}" for name in names)]) + "\n")
    add("site.css", CSS)
    return files


def on_page_markdown(markdown: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links between files of the repository into links between places of the site."""
    here = page.file.src_uri
    folder = posixpath.dirname(place_in_repository(here))

    def moved(match: re.Match[str]) -> str:
        opening, target = match.groups()
        if ":" in target:
            return match.group()
        there = posixpath.normpath(posixpath.join(folder, target))
        return opening + posixpath.relpath(place_in_site(there), posixpath.dirname(here) or ".")

    return LINK.sub(moved, markdown)


def on_page_content(html: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Formulas as MathML."""

    def shown(match: re.Match[str]) -> str:
        formula = match[3].replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&")
        return convert(formula, display="block" if match[2] == "[" else "inline")

    return FORMULA.sub(shown, html)
