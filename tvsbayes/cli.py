"""The command line: reads options, calls the library, prints tables or one JSON document (DESIGN 8).

Heavy modules are imported inside the commands that need them; `tvsbayes --help` loads none of them. Exit codes:
0 done, 2 bad input, 3 nothing to estimate, 4 not converged, 130 interrupted.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tvsbayes.files import (
    InputError,
    NotConverged,
    NothingToEstimate,
    TvsError,
    escaped,
    make_folder,
    shipped_data,
    write_atomically,
)

if TYPE_CHECKING:
    from tvsbayes.information import FitSummary
    from tvsbayes.posterior import Progress

INTERRUPTED = 130
DEMO_NOTE = "The twin's move history is our assumption, made so that the classic answer is the paper's Table 1."

app = typer.Typer(
    name="tvsbayes",
    help="What one motor step of a geared laser positioner does to the beam, and how sure that is.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Seed of everything random.")]
CampaignFolder = Annotated[Path, typer.Argument(metavar="CAMPAIGN", help="Campaign folder.")]


class _Ended(Exception):
    """Ends a command whose document is out with an exit code other than 0."""

    def __init__(self, exit_code: int):
        super().__init__(exit_code)
        self.exit_code = exit_code


def report_line(text: str) -> None:
    """A line for people, on stderr; text from files may hold control characters."""
    typer.echo("".join(c if c.isprintable() else "?" for c in text), err=True)


def print_json(document: dict[str, Any]) -> None:
    """The one document on stdout; NaN is a bug, not a value."""
    typer.echo(json.dumps(document, indent=1, allow_nan=False, ensure_ascii=True))


def _error_document(error: TvsError) -> dict[str, Any]:
    fields = {"code": error.code, "file": error.file, "line": error.line, "column": error.column}
    fields |= {"message": error.message, "found": error.found, "allowed": error.allowed, "remedy": error.remedy}
    return {"error": fields}


def _report_error(error: TvsError) -> None:
    report_line(f"error: {error.message}")
    if error.remedy and error.remedy not in error.message:
        report_line(f"what to do: {error.remedy}")


def _finish(document: dict[str, Any], text: str, as_json: bool, error: TvsError | None = None) -> None:
    """Print a result in the wanted form; one that must not be used carries its error and its exit code."""
    if as_json:
        print_json(document if error is None else {**document, **_error_document(error)})
    else:
        typer.echo(text)
    if error is not None:
        if not as_json:
            _report_error(error)
        raise _Ended(error.exit_code)


def _unusable(summary: FitSummary) -> TvsError | None:
    """Why a fit that ran to its end must not be used: not converged (4) or nothing learned (3)."""
    if not summary.converged and summary.sampling is not None and not summary.sampling["converged"]:
        return NotConverged(
            "unconverged",
            "UNCONVERGED: " + "; ".join(summary.sampling["missing"]) + ". The table is the Laplace approximation",
            remedy="run again with --resume and more --max-minutes",
        )
    if not summary.converged:
        return NotConverged(
            "not-converged",
            "NOT CONVERGED: " + "; ".join(summary.problems),
            remedy="check for swapped cameras or wrong counters, or state the extrinsics better in [rig.prior]",
        )
    if not summary.headline_informed:
        return NothingToEstimate(
            "uninformed",
            "the spots tell no more about any effective ratio than the priors do (contraction below 0.1 everywhere)",
            remedy="observe stops before and after moves of both axes",
        )
    return None


@app.command()
def demo(
    out: Annotated[Path | None, typer.Argument(metavar="[OUT]", help="Folder to keep the campaign in.")] = None,
    as_json: Json = False,
) -> None:
    """The whole way on the shipped paper twin: both estimators beside the truth."""
    import shutil
    import tempfile

    source = shipped_data() / "twins" / "paper_twin"
    with tempfile.TemporaryDirectory(prefix="tvsbayes-demo-") as scratch:
        folder = Path(scratch) / "paper_twin" if out is None else out
        make_folder(folder, empty=True)
        shutil.copytree(source, folder, dirs_exist_ok=True)
        report_line("paper twin: 96 four-point experiments of a simulated rig with known truth; fitting ...")
        from tvsbayes.campaign import read_campaign
        from tvsbayes.classic import classic as estimate_classic
        from tvsbayes.information import summarise
        from tvsbayes.joint import fit as fit_joint
        from tvsbayes.report import demo_text, write_results
        from tvsbayes.simulation import effective_deg_per_step, effective_mirror_offset_mm, read_truth
        from tvsbayes.solver import use_compilation_cache

        use_compilation_cache()
        campaign = read_campaign(folder)
        true = read_truth(folder / "truth.json", campaign.stereo).parameters
        classic_result = estimate_classic(campaign)
        result = fit_joint(campaign)
        summary = summarise(result)
        if out is not None:
            write_results(result, summary, folder / "results", seed=0)
    pose = (summary.reference_pose_deg["pan"], summary.reference_pose_deg["tilt"])
    truth = {
        **effective_deg_per_step(true, pose),
        "backlash_deg.pan": true["backlash_deg.pan"],
        "backlash_deg.tilt": true["backlash_deg.tilt"],
        "effective_mirror_offset_mm": effective_mirror_offset_mm(true, pose),
    }
    document = {"classic": classic_result.as_json(), "fit": summary.as_json(), "truth": truth}
    _finish(document, f"{demo_text(classic_result, summary, truth)}\n\n{DEMO_NOTE}", as_json, _unusable(summary))


@app.command()
def new(out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder to create.")], as_json: Json = False) -> None:
    """An empty campaign with commented files, and a rig file to plan and simulate with."""
    make_folder(out, empty=True)
    templates = sorted((shipped_data() / "templates").iterdir())
    for template in templates:
        write_atomically(out / template.name, template.read_bytes())
    names = [template.name for template in templates]
    text = f"{escaped(str(out), 200)}: {', '.join(names)}\n"
    text += "next: put stereo.json beside them, log moves and spots, then `tvsbayes check` this folder"
    _finish({"campaign": str(out), "files": names}, text, as_json)


@app.command()
def simulate(
    rig: Annotated[Path, typer.Argument(metavar="RIG", help="Rig file.")],
    plan: Annotated[Path, typer.Argument(metavar="PLAN", help="plan.csv.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Campaign folder to write.")],
    aperture: Annotated[bool, typer.Option("--aperture/--no-aperture", help="Looks also read the aperture.")] = False,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """The digital twin: draw a true rig, run a plan on it, write the campaign and truth.json."""
    from tvsbayes.campaign import read_plan
    from tvsbayes.rigs import read_rig
    from tvsbayes.simulation import simulate as run_plan

    result = run_plan(read_rig(rig), read_plan(plan), seed, aperture=aperture)
    result.write(out)
    moves, spots = len(result.campaign.moves), result.campaign.spots
    seen = sum(spot.status == "ok" for spot in spots)
    document = {"campaign": str(out), "moves": moves, "spots": len(spots), "ok": seen, "seed": seed}
    text = f"{escaped(str(out), 200)}: {moves} moves, {seen} of {len(spots)} spots seen; the truth is in truth.json"
    _finish(document, text, as_json)


@app.command()
def check(
    path: Annotated[Path, typer.Argument(metavar="PATH", help="Campaign folder, rig file or plan.")],
    as_json: Json = False,
) -> None:
    """Read a campaign, rig or plan strictly and say what it holds and what it cannot tell."""
    from tvsbayes.campaign import read_campaign, read_plan
    from tvsbayes.protocols import check_campaign
    from tvsbayes.rigs import read_rig

    if path.suffix == ".csv":
        steps = read_plan(path)
        actions = {action: sum(s.action == action for s in steps) for action in ("home", "place", "move", "look")}
        document: dict[str, Any] = {"kind": "plan", "steps": len(steps), **actions, "warnings": []}
    elif path.suffix == ".toml":
        rig = read_rig(path)
        document = {"kind": "rig", "sheets_mm": rig.sheets_mm, "costs_s": rig.costs_s, "warnings": []}
    else:
        document = check_campaign(read_campaign(path)).as_json()
    warnings = document["warnings"]
    lines = [f"{key}: {value}" for key, value in document.items() if key != "warnings"]
    lines += [f"warning: {warning}" for warning in warnings]
    lines.append(f"{escaped(str(path), 200)}: readable, {len(warnings)} warning{'s' * (len(warnings) != 1)}")
    _finish(document, "\n".join(lines), as_json)


@app.command()
def classic(campaign: CampaignFolder, as_json: Json = False) -> None:
    """The paper's four-point estimator: mean, sd, type A and GUM uncertainty per direction."""
    from tvsbayes.campaign import read_campaign
    from tvsbayes.classic import classic as estimate
    from tvsbayes.report import classic_text

    result = estimate(read_campaign(campaign))
    skipped = [f"experiment {s.experiment} skipped: {s.reason}" for s in result.skipped]
    _finish(result.as_json(), "\n".join([classic_text(result), *skipped]), as_json)


@app.command()
def fit(
    campaign: CampaignFolder,
    no_sample: Annotated[bool, typer.Option("--no-sample", help="Laplace approximation only.")] = False,
    max_minutes: Annotated[
        float, typer.Option("--max-minutes", min=0.01, help="Time for sampling; unconverged by then: exit 4.")
    ] = 10.0,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the chain of an earlier run.")] = False,
    robust: Annotated[bool, typer.Option("--robust", help="Downweight and exclude outlying spots, by name.")] = False,
    per_axis: Annotated[bool, typer.Option("--per-axis", help="One ratio per axis: contrasts fixed at 0.")] = False,
    harmonics: Annotated[bool, typer.Option("--harmonics", help="Free transmission errors of known period.")] = False,
    no_backlash: Annotated[bool, typer.Option("--no-backlash", help="No play: backlash fixed at 0.")] = False,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for results (default CAMPAIGN/results).")] = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Fit the joint model to every spot and sample its posterior: ratios, backlash, mirror offset, extrinsics."""
    from tvsbayes.campaign import read_campaign

    if resume and no_sample:
        raise InputError("usage", "--resume continues a chain and --no-sample makes none", remedy="give one of them")
    data = read_campaign(campaign)
    from tvsbayes.information import summarise
    from tvsbayes.joint import fit as fit_joint
    from tvsbayes.report import fit_text, write_results
    from tvsbayes.solver import use_compilation_cache

    use_compilation_cache()
    folder = out or campaign / "results"
    model = {"per_axis": per_axis, "harmonics": harmonics, "no_backlash": no_backlash}
    result = fit_joint(data, robust=robust, **model, seed=seed)
    summary, posterior, more = summarise(result), None, {}
    # A sample of what must not be used anyway would only take the user's time.
    if not no_sample and _unusable(summary) is None:
        from tvsbayes.posterior import sample, write_posterior

        make_folder(folder)
        with _sampling_progress() as progress:
            posterior = sample(
                result,
                max_minutes=max_minutes,
                seed=seed,
                checkpoint=folder / "chain.npz",
                resume=resume,
                progress=progress,
            )
        summary = summarise(result, posterior)
        if posterior.converged:
            report_line("computing log likelihoods and predictions for posterior.nc ...")
            write_posterior(posterior, folder / "posterior.nc")
            more = {"posterior": str(folder / "posterior.nc")}
        more["chain"] = str(folder / "chain.npz")
    files = {**write_results(result, summary, folder, seed, posterior), **more}
    document = {**summary.as_json(), "seed": seed, "files": files}
    _finish(document, f"{fit_text(summary)}\nwritten: {', '.join(files.values())}", as_json, _unusable(summary))


@contextmanager
def _sampling_progress() -> Iterator[Callable[[Progress], None]]:
    """A bar on a terminal, nothing elsewhere; Ctrl-C says how to go on."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    console, kept = Console(stderr=True), False
    columns = TextColumn("sampling"), BarColumn(), TextColumn("{task.fields[note]}"), TimeElapsedColumn()
    try:
        with Bar(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
            task = bar.add_task("sampling", total=None, note="preparing")

            def show(state: Progress) -> None:
                nonlocal kept
                kept = True
                ess = "" if state.worst_ess is None else f", least effective draws {state.worst_ess:.0f}"
                note = f"step {state.steps}{ess}, next look in {max(state.seconds_left, 0):.0f} s"
                bar.update(task, completed=state.steps, total=state.expected_steps, note=note)

            yield show
    except KeyboardInterrupt:
        # Before the first block of steps there is no chain to keep.
        if kept:
            report_line("the chain so far is kept in chain.npz; go on with --resume")
        raise


def run(arguments: list[str]) -> int:
    """Run one command and return its exit code; no traceback reaches a user."""
    wants_json = "--json" in arguments
    try:
        # Typer returns the code of its own Exit, into which it also turns Ctrl-C; commands return None.
        code = app(arguments, prog_name="tvsbayes", standalone_mode=False) or 0
    except TvsError as error:
        if wants_json:
            print_json(_error_document(error))
        else:
            _report_error(error)
        return error.exit_code
    except _Ended as ending:
        return ending.exit_code
    except typer.Exit as ending:
        return ending.exit_code
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except Exception as error:
        # Wrong options are bad input like any other; typer's own classes carry the text to show.
        if not hasattr(error, "format_message"):
            raise
        if wants_json:
            print_json(_error_document(InputError("usage", error.format_message(), remedy="see tvsbayes --help")))
        else:
            error.show()
        return InputError.exit_code
    if code == INTERRUPTED:
        report_line("interrupted")
    return code


def main() -> None:
    """Entry point of the `tvsbayes` script."""
    # Read when NumPy is first imported. The matrices here are small: OpenBLAS' second thread only waits, and its
    # busy waiting takes the time of XLA's threads, tenfold where two fits share two cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(run(sys.argv[1:]))
