"""view: a campaign looked at in a browser of this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tvsbayes.cli import axis_commands
from tvsbayes.cli.app import INTERRUPTED, CampaignFolder, Ended, Json, finish, report_line


def view(
    campaign: CampaignFolder,
    beside: Annotated[
        Path | None, typer.Option("--beside", metavar="CAMPAIGN", help="A later campaign of the same instrument.")
    ] = None,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="To listen on; 0 takes a free one.")] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Only print the link.")] = False,
    as_json: Json = False,
) -> None:
    """A page to look at a campaign: rig in 3D, looks, residuals.

    On 127.0.0.1 alone, by a link for one browser, until Ctrl-C. Needs the extra `view`.
    """
    for folder in (campaign, beside):
        if folder is not None:
            axis_commands.refuse_axis(folder, "view", "`tvsbayes report` makes the page of an axis")
    from tvsbayes.view.contents import Contents, page_files
    from tvsbayes.view.server import serve

    files = page_files()
    from tvsbayes.view.document import document
    from tvsbayes.view.gathering import look_at

    looked = look_at(campaign, beside, report_line)
    folders = tuple(folder for folder in (campaign, beside) if folder is not None)
    kept = tuple(frozenset(one.looks.spot.tolist()) for one in looked.scenes)
    contents = Contents(document(looked), folders, kept, files)

    def started(link: str) -> None:
        counts = [len(one.looks.spot) for one in looked.scenes]
        fitted = [one.fitted for one in looked.scenes]
        notes = "".join(f"note: {note}\n" for one in looked.scenes for note in one.notes)
        finish({"link": link, "looks": counts, "fitted": fitted}, f"{notes}open {link}\nCtrl-C ends it", as_json)
        if not (no_browser or as_json):
            import webbrowser

            webbrowser.open(link)

    try:
        serve(contents, port, started)
    except KeyboardInterrupt:
        # Its usual end, and the one document of --json is out.
        raise Ended(INTERRUPTED) from None
