"""The page of a report, written and printed, and the sequence of `calibrate`: check, classic, fit, report."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tvsbayes.cli.app import finish, print_part, report_line
from tvsbayes.cli.progress_bar import waiting
from tvsbayes.errors import TvsError
from tvsbayes.files.disk import output_place, require_writable
from tvsbayes.progress import Job

if TYPE_CHECKING:
    from tvsbayes.metrology.conformity import Criterion
    from tvsbayes.report.document import Document

DRAWING, PRINTING = "drawing the page", "printing to PDF"


@dataclass(frozen=True)
class Part:
    """A part of `calibrate`: key, document and text, and the error that ends the sequence, else None."""

    key: str
    document: Mapping[str, Any] | None
    text: str
    error: TvsError | None = None


@dataclass(frozen=True)
class WrittenPage:
    """A page on disk.

    Attributes:
        number: number on its first page.
        html: its bytes.
        path: its file.
        files: the page and the files made from it, by kind.
        removed: names of removed files of an earlier page.
    """

    number: str
    html: bytes
    path: Path
    files: dict[str, str]
    removed: list[str]

    def as_json(self, criteria: Sequence[Criterion] = ()) -> dict[str, Any]:
        """The document of `report --json`, with the limits that the user gave, judged."""
        return {"criteria": [asdict(c) for c in criteria], "number": self.number, "files": self.files}

    def report_removed(self, *, certificates: bool = False) -> None:
        """Report the removed files, except those written again; only pages of scanners have certificates."""
        written = {Path(place).name for place in self.files.values()}
        if removed := [name for name in self.removed if name not in written]:
            command = "`tvsbayes report --pdf`" + " or `--dcc`" * certificates
            report_line(f"removed: {', '.join(removed)}, made of an earlier report; {command} makes them again")

    def finish(self, as_json: bool) -> None:
        """Print the result of `report` for a page without limits and certificate."""
        self.report_removed()
        finish(self.as_json(), f"report {self.number}\nwritten: {', '.join(self.files.values())}", as_json)

    def part(self, lines: Sequence[str] = (), criteria: Sequence[Criterion] = ()) -> Part:
        """The last part of `calibrate`, with the verdicts on the limits, as lines and as criteria."""
        text = "\n".join([*lines, f"next: open {', '.join(self.files.values())} in a browser"])
        return Part("report", self.as_json(criteria), text)


def written_page(
    folder: Path, out: Path | None, pdf: bool, stages: Mapping[str, float], make: Callable[[Job], Document]
) -> WrittenPage:
    """Write the page of a campaign, and print it if requested.

    Args:
        folder: of the campaign.
        out: path stated by the user; None for `results/report.html`.
        pdf: whether to print it.
        stages: expected durations of the stages before printing, of which `make` begins each.
        make: makes the document.

    Raises:
        InputError: no browser can print it, or it cannot be written.
    """
    from tvsbayes.report.page import find_browser, page_html, print_to_pdf, replace_page

    if pdf:
        find_browser()
    path = out or output_place(folder, "results") / "report.html"
    require_writable(path.parent)
    files = {"report": str(path)}
    with waiting() as progress, Job({**stages, PRINTING: 3.0 if pdf else 0.0}, progress) as job:
        document = make(job)
        html = page_html(document)
        removed = replace_page(path, html, out)
        if pdf:
            job.begin(PRINTING)
            files["pdf"] = str(print_to_pdf(path))
    return WrittenPage(document.number, html, path, files, removed)


def print_parts(parts: Iterable[Part], as_json: bool) -> None:
    """Print the parts of `calibrate`, each as soon as it is made; an error ends them, and there is no report."""
    documents: dict[str, Any] = {}
    for part in parts:
        documents[part.key] = part.document
        if part.error is not None:
            finish({**documents, "report": None}, part.text, as_json, part.error)
        elif part.key == "report":
            finish(documents, part.text, as_json)
        else:
            print_part(part.text, as_json)
