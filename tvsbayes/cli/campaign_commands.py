"""Commands on campaigns: demo, simulate, detect, check."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option

from tvsbayes.cli.app import CampaignFolder, Json, Seed, check_order, finish, finite, is_part, report_line
from tvsbayes.cli.instruments import instrument_of, serve
from tvsbayes.cli.progress_bar import waiting
from tvsbayes.errors import InputError, escaped, plural, typed
from tvsbayes.files.disk import output_place, require_writable, shipped_data, write_atomically, write_folder
from tvsbayes.instrument.axes import DIRECTIONS, HOME_APPROACH
from tvsbayes.instrument.mechanisms import SIGHTING_HEAD
from tvsbayes.instrument.parameters import TARGETS
from tvsbayes.pipeline import FITTING, SAMPLING, calibrate, compile_for, unusable
from tvsbayes.progress import Job, Show

if TYPE_CHECKING:
    from tvsbayes.instrument.campaign import Campaign
    from tvsbayes.results.estimates import FitSummary

DEMO_NOTE = "The twin's move history is our assumption, made so that the classic answer is the paper's Table 1."


def demo(
    out: Annotated[Path | None, Argument(metavar="OUT", help="Folder to keep the campaign in.")] = None,
    as_json: Json = False,
) -> None:
    """Both estimators on the shipped paper twin, beside its truth."""
    import tempfile

    source = shipped_data() / "twins" / "paper_twin"
    with tempfile.TemporaryDirectory(prefix="tvsbayes-demo-") as scratch:
        folder = Path(scratch) / "paper_twin" if out is None else out
        # A checkout's own twin may have been fitted: results are not part of the campaign.
        write_folder(folder, {path.name: path.read_bytes() for path in sorted(source.iterdir()) if path.is_file()})
        report_line("paper twin: 96 four-point experiments of a simulated rig with known truth; fitting ...")
        from tvsbayes.estimators.four_point import classic as estimate_classic
        from tvsbayes.instrument.campaign import read_campaign
        from tvsbayes.report.fit_text import demo_text
        from tvsbayes.twin.true_rig import read_truth

        compile_for(report_line)
        campaign = read_campaign(folder)
        rig = read_truth(folder / "truth.json", campaign.stereo)
        classic_result = estimate_classic(campaign)
        # Evidence for reports takes as long as the fit, and is made only where the results are kept.
        with waiting() as progress:
            if out is None:
                summary = _sampled(campaign, progress)
            else:
                results = calibrate(campaign, out / "results", tier="importance", progress=progress)
                summary = results.record.summary
    pose = (summary.reference_pose_deg["pan"], summary.reference_pose_deg["tilt"])
    true = rig.headlines(campaign, pose) or {}
    others = {quantity.name: true[quantity.name] for quantity in TARGETS.values() if not quantity.ratio}
    truth = {direction: true[f"effective_deg_per_step.{direction}"] for direction in DIRECTIONS} | others
    document = {"classic": classic_result.as_json(), "fit": summary.as_json(), "truth": truth}
    finish(document, f"{demo_text(classic_result, summary, truth)}\n\n{DEMO_NOTE}", as_json, unusable(summary))


def _sampled(campaign: Campaign, progress: Show | None) -> FitSummary:
    """Fit a campaign and sample its posterior by importance sampling."""
    from tvsbayes.assessment.summary import summarise
    from tvsbayes.estimators.joint_fit import fit
    from tvsbayes.posterior.sampling import sample

    with Job({FITTING: 1.0, SAMPLING: 1.0}, progress) as job:
        result = fit(campaign, progress=job.part(FITTING))
        return summarise(result, sample(result, "importance", progress=job.part(SAMPLING)))


def simulate(
    rig: Annotated[Path, Argument(metavar="RIG", help="Rig file, or an axis folder.")],
    plan: Annotated[Path, Argument(metavar="PLAN", help="plan.csv; of an axis its moves.csv, or left out.")],
    out: Annotated[Path | None, Argument(metavar="OUT", help="Campaign folder to write.")] = None,
    aperture: Annotated[bool, Option("--aperture/--no-aperture", help="Looks also read the aperture.")] = False,
    frames: Annotated[bool, Option("--frames", help="Pictures for `detect` and `stereo`, no centroids.")] = False,
    unrecorded_sides: Annotated[
        bool, Option("--unrecorded-sides", help="Homing ends on sides that are drawn and not recorded.")
    ] = False,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """The digital twin runs a plan on a true rig that it draws. Writes the campaign and truth.json."""
    options = {"aperture": aperture, "frames": frames, "unrecorded_sides": unrecorded_sides, "seed": seed}
    if serve("simulate", rig, moves=None if out is None else plan, out=out or plan, as_json=as_json, **options):
        return
    if out is None:
        raise InputError("usage", "Missing argument 'OUT'.", remedy="see tvsbayes --help")
    check_order(rig, plan)
    from tvsbayes.instrument.plan import read_plan
    from tvsbayes.instrument.rig import read_rig
    from tvsbayes.twin.simulated_campaign import simulate as run_plan

    home_approach = None if unrecorded_sides else HOME_APPROACH
    declared = read_rig(rig)
    result = run_plan(
        *(declared, read_plan(plan, declared.table.mechanism), seed),
        aperture=aperture,
        home_approach=home_approach,
        sides_recorded=not unrecorded_sides,
    )
    moves, spots = len(result.campaign.moves), result.campaign.spots
    in_view = sum(spot.status == "ok" for spot in spots)
    document = {"campaign": str(out), "moves": moves, "spots": len(spots), "ok": in_view, "seed": seed}
    text = f"{escaped(str(out), 200)}: {moves} moves, {in_view} of {len(spots)} spots seen; the truth is in truth.json"
    if frames:
        from tvsbayes.twin.board_pictures import Board
        from tvsbayes.twin.frames import write_with_frames

        board = Board()
        with waiting("the pictures so far are kept; the same command goes on with them") as progress:
            pictures = write_with_frames(out, result.undetected(), seed, progress=progress)
        size = f"{board.columns}x{board.rows}"
        board_drawn = {"columns": board.columns, "rows": board.rows, "pitch_mm": board.pitch_mm}
        document |= {"ok": 0, "in_view": in_view, "pictures": pictures, "board": board_drawn}
        text += f"\n{pictures} pictures in frames/ and boards/; spots.csv waits for `tvsbayes detect {typed(out)}`"
        text += f"\nboard: {size} inner corners, squares of {board.pitch_mm:g} mm: `tvsbayes stereo "
        text += f"{typed(out / 'boards')} --board {size} --pitch-mm {board.pitch_mm:g} -o stereo.json`"
    else:
        result.write(out)
    finish(document, text, as_json)


def detect(
    campaign: CampaignFolder,
    method: Annotated[str, Option(help="fit, or contour (the paper's).")] = "fit",
    speckle_contrast: Annotated[
        float | None, Option(min=0.0, max=2.0, help="Per pixel (default: learned; contour: 0.4).")
    ] = None,
    dark: Annotated[
        Path | None, Option(help="Folder of pictures with the laser off, to subtract: as in frames/, or left.png ...")
    ] = None,
    overlay: Annotated[bool, Option("--overlay", help="Pictures of every spot in results/overlay.")] = False,
    as_json: Json = False,
) -> None:
    """Find the laser spots in a campaign's frames. Writes centres and uncertainties into spots.csv, in place."""
    if serve("detect", **locals()):
        return
    finite(speckle_contrast=speckle_contrast)
    from tvsbayes.cameras.detection import detect as find
    from tvsbayes.instrument.campaign import read_campaign, spots_bytes
    from tvsbayes.report.command_text import detection_text

    pictures = output_place(campaign, "results", "overlay") if overlay else None
    data = read_campaign(campaign)
    require_writable(campaign)
    with waiting() as progress:
        result = find(data, method, speckle_contrast=speckle_contrast, dark=dark, overlay=pictures, progress=progress)
    write_atomically(campaign / "spots.csv", spots_bytes(result.campaign.spots))
    document = {"campaign": str(campaign), **result.as_json()}
    text = detection_text(result) + f"\nwritten: {escaped(str(campaign / 'spots.csv'), 200)}"
    if overlay:
        document["overlay"] = str(pictures)
        text += f", {escaped(str(pictures), 200)}"
    finish(document, text, as_json)


def check(
    path: Annotated[Path, Argument(metavar="PATH", help="Campaign folder, rig file or plan.")],
    plan_file: Annotated[
        Path | None, Argument(metavar="PLAN", help="With a rig file: what the plan does not separate.")
    ] = None,
    repair_to: Annotated[Path | None, Option(help="New folder for the intact part of a damaged journal.")] = None,
    as_json: Json = False,
) -> None:
    """Contents and faults of a campaign, rig, plan or journal. Reads strictly, changes nothing."""
    if repair_to is not None:
        if plan_file is not None:
            raise InputError("usage", "a repaired journal takes no plan", remedy="leave out PLAN or --repair-to")
        from tvsbayes.acquisition.journal_check import repair_campaign

        repaired = repair_campaign(path, repair_to)
        lines = [f"{key}: {value}" for key, value in repaired.items()]
        finish(repaired, "\n".join([*lines, f"{escaped(str(repair_to), 200)}: written"]), as_json)
        return
    from tvsbayes.instrument.sightings import SIGHTINGS
    from tvsbayes.report.command_text import check_text

    document = _contents(path, plan_file)
    warnings, has_images = document["warnings"], not (path / SIGHTINGS.file).is_file()
    summary = f"{escaped(str(path), 200)}: readable, {plural(len(warnings), 'warning')}"
    finish(document, f"{check_text(document, has_images)}\n{summary}", as_json)


def _contents(path: Path, plan_file: Path | None) -> dict[str, Any]:
    """Contents of a plan with its rig, a plan, a rig, a journal or a campaign; warnings under their own key."""
    from tvsbayes.instrument.plan import read_plan
    from tvsbayes.instrument.rig import read_rig

    if plan_file is not None:
        _check_rig_and_plan(path, plan_file)
        rig = read_rig(path)
        steps = read_plan(plan_file, rig.table.mechanism)
        from tvsbayes.planning.plan_check import check_plan

        compile_for(report_line)
        with waiting() as progress:
            return check_plan(rig, steps, progress=progress).as_json()
    # A part of a campaign cannot be checked without the other parts.
    if is_part(path):
        found, remedy = f"{escaped(path.name)} is a part of a campaign", f"check {escaped(str(path.parent), 200)}"
        raise InputError("usage", f"{found}, checked as a whole", allowed="a campaign folder", remedy=remedy)
    kind = path.suffix.lower()
    if kind == ".csv" and not path.is_dir():
        steps = read_plan(path, SIGHTING_HEAD)
        if any(step.action == "place" for step in steps):
            steps = read_plan(path)
        actions = {action: sum(s.action == action for s in steps) for action in ("home", "place", "move", "look")}
        return {"kind": "plan", "steps": len(steps), **actions, "warnings": []}
    if kind == ".toml" and not path.is_dir():
        rig = read_rig(path)
        return {"kind": "rig", "sheets_mm": rig.sheets_mm, "costs_s": rig.costs_s, "warnings": []}
    instrument = instrument_of(path)
    if instrument is None or "check" in instrument.shared:
        return campaign_contents(path)
    return instrument.command("contents")(path)


def _check_rig_and_plan(path: Path, plan_file: Path) -> None:
    """Refuse another kind of path in place of the rig file of a plan; the reader refuses a missing file."""
    check_order(path, plan_file)
    name = escaped(str(path), 200)
    if path.is_dir():
        rig_file = path / "rig.toml"
        if (instrument := instrument_of(path)) is not None:
            found = f"{instrument.folder}, whose plan is not checked"
            remedy = f"leave out PLAN: tvsbayes check {typed(path)}"
        elif rig_file.is_file():
            found, remedy = "a folder", f"name the rig file in it: {escaped(str(rig_file), 200)}"
        else:
            found, remedy = "a folder", f"name a rig file, or leave out PLAN: tvsbayes check {typed(path)}"
    elif path.exists() and path.suffix.lower() != ".toml":
        found, remedy = "no .toml file", "give the rig file first, then the plan"
    else:
        return
    message = f"a plan is checked together with a rig file, and {name} is {found}"
    raise InputError("usage", message, found=found, allowed="RIG PLAN", remedy=remedy)


def campaign_contents(path: Path, campaign: Campaign | None = None) -> dict[str, Any]:
    """The document of `check` for a campaign and its journal; for the journal alone before the first move.

    `campaign` is the campaign at the path, if it was read already.
    """
    from tvsbayes.estimators.plausibility import check_campaign
    from tvsbayes.instrument.campaign import read_campaign

    journal: dict[str, Any] | None = None
    if (path / "log.jsonl").exists():
        from tvsbayes.acquisition.journal_check import check_journal

        journal = check_journal(path)
    if journal is not None and not journal["moves"]:
        return {"kind": "journal", **journal}
    document: dict[str, Any] = check_campaign(campaign or read_campaign(path)).as_json()
    if journal is not None:
        document["warnings"] = [*journal.pop("warnings"), *document["warnings"]]
        document["journal"] = journal
    return document
