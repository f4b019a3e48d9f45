"""Commands of a head that says where it was found to point, where they differ from the scanner's.

Options in, library called, table or JSON out; heavy imports stand inside the commands.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tvsbayes.cli.app import finish, report_line, tell_removed
from tvsbayes.cli.progress_bar import waiting
from tvsbayes.errors import InputError
from tvsbayes.files.disk import output_place
from tvsbayes.pipeline import StoredOrFitted
from tvsbayes.progress import Job

if TYPE_CHECKING:
    from tvsbayes.calibration.pointing import Calibration
    from tvsbayes.report.document import Issue

FITTING, DRAWING = "fit", "drawing the page"
OF_SIGHTINGS = "check, classic, fit, compare, report, steps-for --azimuth-deg --elevation-deg"
"""Commands that such a head has."""


def refuse_sightings(command: str, sightings: bool) -> None:
    """A command that needs spots does not take the rig file of a head that says where it points.

    Raises:
        InputError: `sightings`.
    """
    if sightings:
        message = f"{command} needs spots that a stereo pair sees, and this head says where it points"
        raise InputError("usage", message, remedy=f"of such a head: simulate, {OF_SIGHTINGS}")


def refuse_head(command: str, calibration: Calibration) -> None:
    """A command that needs the scanner's aperture does not take a head.

    Raises:
        InputError: the calibration is one of a head.
    """
    from tvsbayes.calibration.pointing import INPUT_NAMES

    if calibration.names != INPUT_NAMES:
        message = f"{command} meets the beam with the scanner's aperture, and a pan-tilt head has none"
        raise InputError("usage", message, remedy="steps-for says which counters point along a direction")


def classic(folder: Path, as_json: bool) -> None:
    """A pointing model by least squares, without gears."""
    from tvsbayes.head.pointing_model import pointing_model
    from tvsbayes.instrument.campaign import read_campaign
    from tvsbayes.report.command_text import pointing_text

    model = pointing_model(read_campaign(folder))
    finish(model.as_json(), pointing_text(model), as_json)


def report(folder: Path, issue: Issue, pdf: bool, out: Path | None, as_json: bool) -> None:
    """The page of a head; fits first where results are missing."""
    from tvsbayes.estimators.plausibility import check_campaign
    from tvsbayes.instrument.campaign import read_campaign
    from tvsbayes.report.head_document import head_document
    from tvsbayes.report.page import find_browser, page_html, print_to_pdf, replace_page

    if pdf:
        find_browser()
    data, path = read_campaign(folder), out or output_place(folder, "results") / "report.html"
    files = {"report": str(path)}
    with waiting() as progress, Job({FITTING: 3.0, DRAWING: 1.0}, progress) as job:
        record = StoredOrFitted(data, report_line, job.part(FITTING)).record
        job.begin(DRAWING)
        page = head_document(data, record, issue, check_campaign(data).warnings)
        removed = replace_page(path, page_html(page), out)
        if pdf:
            files["pdf"] = str(print_to_pdf(path))
    tell_removed(removed, files, certificates=False)
    document = {"criteria": [], "number": page.number, "files": files}
    finish(document, f"report {page.number}\nwritten: {', '.join(files.values())}", as_json)
