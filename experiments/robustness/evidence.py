"""How reliable is all this? The figures of coverage, faults, kills, mutations and planted bugs on one page.

    python -m experiments.robustness.evidence device     # slow tests of protocol, journal and engine, about 25 minutes
    python -m experiments.robustness.evidence table      # rewrites evidence.md

`table` computes a figure again from the rows that its study left in `experiments/output/` (git ignores them: run the
command of a line to have its rows) and states their date and commit. A line whose rows are not there stays
as it stands in the page, with its own date and commit.
"""

from __future__ import annotations

import argparse
import datetime
import json
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy import stats

from experiments.common.command_line import act, parser
from experiments.common.headlines import HEADLINES, LEAST_CONTRACTION
from experiments.common.rows import OUTPUT, ROOT, git, output, read_rows
from experiments.common.uniformity import ALPHA, FAULT_SIMULATIONS, Band, pit_values
from experiments.common.watched import fine
from experiments.robustness.faults.listing import FAULTS
from tvsbayes.posterior.sampling import TIERS
from tvsbayes.statistics.chances import BOUND, binomial_bounds, rms_bounds

DEVICE = output(__file__, "evidence_device.json")
PAGE = Path(__file__).with_suffix(".md")
HEADINGS = ("claim", "figure", "holds", "rows of", "commit", "command")
DEVICE_TESTS = ("tests/positioner", "tests/acquisition")
LEVEL = 0.95


@dataclass(frozen=True)
class Line:
    """A claim of reliability.

    Attributes:
        claim: what is claimed.
        command: what makes the rows.
        rows: their file in `experiments/output/`.
        figure: computes the figure, and whether the claim holds, from the rows.
    """

    claim: str
    command: str
    rows: str
    figure: Callable[[list[dict]], tuple[str, bool | None]]


def held(inside: int, n: int) -> tuple[str, bool]:
    """Coverage of 95 % intervals with the bounds that a true one leaves once in 10 000."""
    low, high = binomial_bounds(n, LEVEL)
    share = inside / n
    return f"{100 * share:.1f} % of {n} ({100 * low:.1f} to {100 * high:.1f})", low <= share <= high


def classic_coverage(rows: list[dict]) -> tuple[str, bool]:
    """Share of classic type A intervals with the truth, by protocol; the claim is that they fail."""
    shares = {}
    for protocol in sorted({r["protocol"] for r in rows}):
        entries = [e for r in rows if r["protocol"] == protocol for e in (r.get("classic") or {}).values()]
        if entries:
            shares[protocol] = np.mean([e["type_a"][0] <= e["true"] <= e["type_a"][1] for e in entries])
    text = "holds it in " + ", ".join(f"{name} {100 * share:.0f} %" for name, share in shares.items())
    return text, all(share < binomial_bounds(300, LEVEL)[0] for share in shares.values())


def joint_coverage(rows: list[dict]) -> tuple[str, bool]:
    """Worst and best coverage of the joint 95 % intervals over protocols and headlines."""
    shares, outside = {}, []
    for protocol in sorted({r["protocol"] for r in rows}):
        good = [r for r in rows if r["protocol"] == protocol and r["converged"]]
        low, high = binomial_bounds(len(good), LEVEL)
        for name in good[0]["joint"]:
            entries = [r["joint"][name] for r in good]
            if np.median([e["contraction"] for e in entries]) < LEAST_CONTRACTION:
                continue
            share = float(np.mean([abs(e["pit"] - 0.5) <= LEVEL / 2 for e in entries]))
            shares[f"{name}, {protocol}"] = share
            if not low <= share <= high:
                outside.append(f"{name}, {protocol} {100 * share:.1f} %")
    worst, best = min(shares, key=shares.get), max(shares, key=shares.get)
    text = f"{len(shares)} intervals: {100 * shares[worst]:.1f} % ({worst}) to {100 * shares[best]:.1f} % ({best})"
    return text + (f"; outside the bounds: {', '.join(outside)}" if outside else ""), not outside


def protocol_coverage(protocol: str, rigs: int, accepted: list[dict]) -> tuple[str, bool]:
    """Of the 95 % intervals of the headlines of the accepted rigs that gained information on them."""
    if not accepted:
        return f"{protocol}, none of {rigs} rigs accepted: nothing to judge", False
    low, high = binomial_bounds(len(accepted), LEVEL)
    entries = {name: [values[name] for values in accepted] for name in HEADLINES}
    shares = {
        name: float(np.mean([abs(e["pit"] - 0.5) <= LEVEL / 2 for e in values]))
        for name, values in entries.items()
        if np.median([e["contraction"] for e in values]) >= LEAST_CONTRACTION
    }
    worst, best = min(shares, key=shares.get), max(shares, key=shares.get)
    text = f"{protocol}, {len(accepted)} of {rigs} rigs accepted: {100 * shares[worst]:.1f} % ({worst}) to "
    text += f"{100 * shares[best]:.1f} % ({best}), bounds {100 * low:.0f} to {100 * high:.0f} %"
    return text, all(low <= share <= high for share in shares.values())


def together(parts: list[tuple[str, bool]]) -> tuple[str, bool]:
    """One figure of several, which holds where all do."""
    return "; ".join(text for text, _ in parts), all(holds for _, holds in parts)


def sampled_coverage(rows: list[dict], tier: str = TIERS[0]) -> tuple[str, bool]:
    """Coverage of the 95 % intervals by one tier, protocol by protocol; what was refused is counted."""
    chosen = [r for r in rows if r["tier"] == tier]
    parts = []
    for protocol in dict.fromkeys(r["protocol"] for r in chosen):
        every = [r for r in chosen if r["protocol"] == protocol]
        good = [r["posterior"] for r in every if r["converged"] and r["sampled"]]
        parts.append(protocol_coverage(protocol, len(every), good))
    return together(parts)


def coverage_with_gears(rows: list[dict]) -> tuple[str, bool]:
    """The same where gears repeat their errors, with all rigs whose errors were drawn by the priors."""
    parts = []
    for protocol in dict.fromkeys(r["protocol"] for r in rows):
        every = [r["repeating"] for r in rows if r["world"] == "priors" and r["protocol"] == protocol]
        good = [row["headlines"] for row in every if row["accepted"]]
        parts.append(protocol_coverage(protocol, len(every), good))
    return together(parts)


def points_coverage(rows: list[dict]) -> tuple[str, bool]:
    """95 % ellipsoids of located points, inside and outside the campaign's counters."""
    parts, well = [], True
    for where in ("inside", "outside"):
        entries = [r[where] for r in rows if r.get(where) and not r[where]["refused"]]
        text, good = held(sum(e["ellipsoid"] for e in entries), len(entries))
        parts.append(f"{where} {text}")
        well &= good
    return "; ".join(parts), well


def ranks(rows: list[dict], variant: str) -> tuple[str, bool | None]:
    """Least p of the simultaneous ECDF bands against its criterion; few simulations fail for no fault."""
    chosen = [r for r in rows if r["variant"] == variant and r["tier"] == TIERS[0]]
    good = [r for r in chosen if r["converged"]]
    if len(good) < 2:
        raise FileNotFoundError(variant)
    band, pit = Band(len(good)), pit_values(good, "ranks")
    p = {name: band.p_value(values) for name, values in pit.items()}
    least, limit = min(p, key=p.get), ALPHA / len(p)
    text = f"{len(good)} of {len(chosen)} simulations, {len(p)} quantities, least p {p[least]:.1e} ({least}), "
    text += f"criterion {limit:.1e}; log-posterior {p['log-posterior']:.1e}"
    if len(chosen) < FAULT_SIMULATIONS:
        return f"{text}; a fault needs {FAULT_SIMULATIONS} simulations to be seen", None
    return text, p[least] >= limit


def planted_in_sampler(rows: list[dict]) -> tuple[str, bool]:
    """Whether each planted fault of the calibration test fails it."""
    parts, all_fail = [], True
    for variant in ("prior x3", "camera dropped"):
        text, passes = ranks(rows, variant)
        parts.append(f"{variant}: {text}")
        all_fail &= not passes
    return "; ".join(parts), all_fail


def cameras(rows: list[dict]) -> tuple[str, bool]:
    """Chi-square of the true 24 parameters over 24, pooled over pictures and simulated corners."""
    parts, well = [], True
    for condition in sorted({r["condition"] for r in rows}):
        values = np.array([r["chi2"] for r in rows if r["condition"] == condition])
        low, high = stats.chi2.ppf([BOUND / 2, 1 - BOUND / 2], 24 * len(values)) / (24 * len(values))
        mean = values.mean() / 24
        well &= low <= mean <= high
        parts.append(f"{condition} {mean:.2f} ({low:.2f} to {high:.2f}, N = {len(values)})")
    return "; ".join(parts), well


def detection(rows: list[dict]) -> tuple[str, bool]:
    """Actual over stated standard deviation of the fitted centres."""
    ratio = np.array([r["fit"]["ratio"] for r in rows])
    text = f"median {np.median(ratio):.2f}, {ratio.min():.2f} to {ratio.max():.2f} over {len(ratio)} cells"
    return text, bool(np.all(np.abs(np.log(ratio)) < np.log(1.25)))


def plans(rows: list[dict]) -> tuple[str, bool]:
    """RMS of (estimate - truth) over the sd predicted before any data, all headlines of all designs."""
    parts, well = [], True
    for name in dict.fromkeys(r["name"] for r in rows):
        good = [r for r in rows if r["name"] == name and r["converged"]]
        n = len(good)
        low, high = rms_bounds(n)
        rms = {}
        for quantity in good[0]["headlines"]:
            entries = [r["headlines"][quantity] for r in good]
            rms[quantity] = float(
                np.sqrt(np.mean([((e["value"] - e["truth"]) / e["predicted_sd"]) ** 2 for e in entries]))
            )
        outside = [f"{q} {v:.2f}" for q, v in rms.items() if not low <= v <= high]
        well &= not outside
        parts.append(
            f"{name} {min(rms.values()):.2f} to {max(rms.values()):.2f} ({low:.2f} to {high:.2f}, N = {n})"
            + (f", outside: {', '.join(outside)}" if outside else "")
        )
    return "; ".join(parts), well


def device(rows: list[dict]) -> tuple[str, bool]:
    """Sessions with faults, kills and journal changes of the slow tests."""
    row = rows[0]
    return f"{row['passed']} slow tests passed, {row['failed']} failed; {'; '.join(row['lines'])}", not row["failed"]


def planted(rows: list[dict]) -> tuple[str, bool]:
    """Planted bugs that the test suite sees, of those in the list."""
    last = {r["sentence"]: r["failed"] for r in rows if r.get("sentence") in {fault.sentence for fault in FAULTS}}
    return f"{sum(last.values())} of {len(FAULTS)} in the list are seen", sum(last.values()) == len(FAULTS)


def folders(rows: list[dict]) -> tuple[str, bool]:
    """Commands on crafted folders."""
    crafted = [r for r in rows if r["threat"] != "none"]
    good = sum(map(fine, crafted))
    names = len({r["name"] for r in crafted})
    return f"{good} of {len(crafted)} commands on {names} crafted folders did what they should", good == len(crafted)


def mutations(rows: list[dict]) -> tuple[str, bool]:
    """Defects that changed bytes of a good folder found."""
    defects = sum(len(r["defects"]) for r in rows)
    through = sum(sum(r["codes"].values()) for r in rows)
    text = f"{defects} defects in {sum(r['n'] for r in rows)} seeded mutations, {through} of them through the commands"
    return text, defects == 0


def false_alarms(rows: list[dict]) -> tuple[str, bool]:
    """Share of clean campaigns that fail their validation, with the bounds that its level leaves."""
    good = [r for r in rows if r["defect"] == "clean" and r["converged"] and "validation" in r]
    level, failed = good[0]["validation"]["level"], sum(not r["validation"]["passed"] for r in good)
    limit = stats.binom.isf(BOUND, len(good), level)
    text = f"{failed} of {len(good)} clean campaigns failed (level {100 * level:g} %, at most {limit:.0f})"
    return text, failed <= limit


LINES = (
    Line(
        "The classic 95 % type A interval misses the truth most of the time",
        "python -m experiments.intervals.laplace_coverage run --n 300 --cores 0 1",
        "intervals/laplace_coverage.jsonl",
        classic_coverage,
    ),
    Line(
        "The joint 95 % interval (Laplace) holds it",
        "python -m experiments.intervals.laplace_coverage run --n 300 --cores 0 1",
        "intervals/laplace_coverage.jsonl",
        joint_coverage,
    ),
    Line(
        "The 95 % interval by importance sampling holds it",
        "python -m experiments.intervals.posterior_coverage run --n 1000 --cores 0 1",
        "intervals/posterior_coverage.jsonl",
        sampled_coverage,
    ),
    Line(
        "... also where gears repeat their errors",
        "python -m experiments.gears.repeated_errors run --n 300 --cores 0 1",
        "gears/repeated_errors.jsonl",
        coverage_with_gears,
    ),
    Line(
        "... and by the chain",
        "python -m experiments.intervals.posterior_coverage run --tier emcee --n 100 --cores 0 1",
        "intervals/posterior_coverage.jsonl",
        partial(sampled_coverage, tier=TIERS[1]),
    ),
    Line(
        "Ranks of truths among posterior draws are uniform",
        "python -m experiments.intervals.sbc run --n 1000 --cores 0 1",
        "intervals/sbc.jsonl",
        lambda r: ranks(r, "clean"),
    ),
    Line(
        "... also with twelve stops in every direction",
        'python -m experiments.intervals.sbc run --variants "few stops" --n 50 --cores 0 1',
        "intervals/sbc.jsonl",
        lambda r: ranks(r, "few stops"),
    ),
    Line(
        "... and the test sees planted faults",
        'python -m experiments.intervals.sbc run --variants "prior x3" "camera dropped" --n 50 --cores 0 1',
        "intervals/sbc.jsonl",
        planted_in_sampler,
    ),
    Line(
        "95 % regions of located points hold them",
        "python -m experiments.millimetres.located_points run --n 1000 --cores 0 1",
        "millimetres/located_points.jsonl",
        points_coverage,
    ),
    Line(
        "The covariance of a stereo calibration is true",
        "python -m experiments.cameras.stereo_coverage run --n 50 --cores 0 1",
        "cameras/stereo_coverage.jsonl",
        cameras,
    ),
    Line(
        "The stated sd of a spot's centre is true",
        "python -m experiments.cameras.detection run",
        "cameras/detection.jsonl",
        detection,
    ),
    Line(
        "A plan predicts the error of its fit",
        "python -m experiments.planning.prediction run --n 100 --cores 0 1",
        "planning/prediction.jsonl",
        plans,
    ),
    Line(
        "No fault, kill or changed byte makes a false record",
        "python -m experiments.robustness.evidence device",
        "robustness/evidence_device.json",
        device,
    ),
    Line(
        "A stranger's folder runs nothing, fills no memory, writes nowhere else",
        "python -m experiments.robustness.hostile folders",
        "robustness/hostile-folders.jsonl",
        folders,
    ),
    Line(
        "Changed bytes end in a documented error",
        "python -m experiments.robustness.hostile mutations --n 100000",
        "robustness/hostile-mutations.jsonl",
        mutations,
    ),
    Line(
        "Validation seldom accuses a clean campaign",
        "python -m experiments.robustness.model_error run --clean 200 --n 20 --cores 0",
        "robustness/model_error.jsonl",
        false_alarms,
    ),
    Line(
        "The tests see planted bugs",
        "python -m experiments.robustness.planted_faults run",
        "robustness/planted_faults.jsonl",
        planted,
    ),
)


def run_device(arguments: argparse.Namespace) -> None:
    """The slow tests of the instrument, with what they print."""
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-o",
        "addopts=",
        "-p",
        "no:cacheprovider",
        "-m",
        "slow",
        *DEVICE_TESTS,
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    lines = [line.strip() for line in done.stdout.splitlines()]
    sessions = sum(int(n) for n in re.findall(r": (\d+) sessions", done.stdout))
    kept = [f"{sessions} sessions with faults"] if sessions else []
    kept += [line for line in lines if re.match(r"\d+ kills|\d+ (changes|bytes|flips)", line)]
    counts = {word: int(n) for n, word in re.findall(r"(\d+) (passed|failed)", lines[-1] if lines else "")}
    totals = {"passed": counts.get("passed", 0), "failed": counts.get("failed", 0) + (done.returncode not in (0, 1))}
    DEVICE.parent.mkdir(parents=True, exist_ok=True)
    DEVICE.write_text(json.dumps({**totals, "lines": kept, "tail": lines[-5:]}) + "\n")
    print(DEVICE.read_text())


def standing(page: str) -> dict[str, str]:
    """Lines of the page's table by their claim."""
    lines = [line for line in page.splitlines() if line.startswith("| ")]
    return {line.split(" | ")[0].removeprefix("| "): line for line in lines}


def commit_at(moment: datetime.datetime) -> str:
    """The last commit before a moment."""
    return git("log", "-1", "--format=%h", f"--before={moment.isoformat()}") or "-"


def computed(line: Line) -> str | None:
    """The line of the table from its rows; None without any."""
    path = OUTPUT / line.rows
    try:
        rows = read_rows(path)
        if not rows:
            return None
        figure, holds = line.figure(rows)
    except FileNotFoundError:
        return None
    written = datetime.datetime.fromtimestamp(path.stat().st_mtime, datetime.UTC)
    word = {True: "yes", False: "NO", None: "-"}[holds]
    return f"| {line.claim} | {figure} | {word} | {written.date()} | {commit_at(written)} | `{line.command}` |"


def table(arguments: argparse.Namespace) -> None:
    """Write the page."""
    kept = standing(PAGE.read_text()) if PAGE.exists() else {}
    page = [
        "# Evidence",
        "",
        "Written by `python -m experiments.robustness.evidence table`. Bounds in brackets are left by a true claim",
        "once in 10 000 times. `commit` is the last one before the rows were finished. What is behind a figure stands",
        "in its script and in [the list of experiments](../README.md).",
        "",
        f"| {' | '.join(HEADINGS)} |",
        "|---" * len(HEADINGS) + "|",
    ]
    for line in LINES:
        page.append(
            computed(line) or kept.get(line.claim) or f"| {line.claim} | no rows | not run | - | - | `{line.command}` |"
        )
    PAGE.write_text("\n".join(page) + "\n")


def main() -> None:
    """Command line."""
    command = parser(__doc__)
    command.add_argument("action", choices=("device", "table"))
    act(command, device=run_device, table=table)


if __name__ == "__main__":
    main()
