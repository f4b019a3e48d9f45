"""Command view: a campaign as one HTML file for a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tvsbayes.cli.app import CampaignFolder, Force, Json, check_output, finish, report_line
from tvsbayes.cli.instruments import serve
from tvsbayes.cli.progress_bar import waiting
from tvsbayes.files.disk import make_folder, output_place, write_atomically
from tvsbayes.progress import Job


def view(
    campaign: CampaignFolder,
    beside: Annotated[
        Path | None, typer.Option("--beside", metavar="CAMPAIGN", help="A later campaign of the same instrument.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="HTML file (default CAMPAIGN/results/view.html).")
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """One HTML file to look at a campaign: rig in 3D, all looks.

    Every look has its pictures and residuals. A double click opens the file in a browser, without a network.
    """
    if serve("view", **locals()) or serve("view", beside):
        return
    folders = [folder for folder in (campaign, beside) if folder is not None]
    check_output(out, kind="page of view", force=force)
    from tvsbayes.view.scene import look_at

    result_scenes = look_at(campaign, beside, report_line)
    from tvsbayes.view.page import document, page_html
    from tvsbayes.view.pictures import PICTURES_BYTES_MAX, look_pictures

    pictures, share = [], PICTURES_BYTES_MAX // len(folders)
    stages = ("pictures", "pictures of the second campaign")[: len(folders)]
    with waiting() as progress, Job(dict.fromkeys(stages, 1.0), progress) as job:
        for folder, scene, stage in zip(folders, result_scenes.scenes, stages, strict=True):
            job.begin(stage)
            pictures.append(look_pictures(folder, scene.looks, share, job.at))
    html = page_html(document(result_scenes, pictures))
    path = out or output_place(campaign, "results") / "view.html"
    if out is None:
        make_folder(path.parent)
    write_atomically(path, html)
    counts = [len(scene.looks.spot) for scene in result_scenes.scenes]
    picture_counts, fitted = [len(chosen) for chosen in pictures], [scene.fitted for scene in result_scenes.scenes]
    result = {"view": str(path), "bytes": len(html), "looks": counts, "pictures": picture_counts, "fitted": fitted}
    notes = "".join(f"note: {note}\n" for scene in result_scenes.scenes for note in scene.notes)
    finish(result, f"{notes}written: {path} ({len(html) / 1e6:.1f} MB); open it in a browser", as_json)
