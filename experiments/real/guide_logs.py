"""Do guide logs of real mounts give the periods that are published?

    python -m experiments.real.guide_logs run FOLDER          # PHD2 logs, by the importer of `import --axis`
    python -m experiments.real.guide_logs table > experiments/real/guide_logs.md

Every run of at least `FRAMES_MIN` frames is read and asked for the waves of `ASKED`; fits by weighted draws.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from experiments.common.command_line import parser
from experiments.common.rows import append_row, output, read_rows
from tvsbayes.results.records import plain
from tvsbayes.single_axis.axis_campaign import AxisCampaign
from tvsbayes.single_axis.axis_fit import fit_axis
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.axis_record import summarise_axis
from tvsbayes.single_axis.guide_log import GuideRun, is_guide_log, read_runs, readings_of_run
from tvsbayes.single_axis.waves import AskedPeriods

ROWS = output(__file__, "guide_logs.jsonl")
FRAMES_MIN = 100
ASKED = AskedPeriods((), ((60.0, 200.0), (200.0, 700.0)), True)
"""s: one wave among those of gears before the worm, one among worms."""
PUBLISHED_S = {"AstroPhysics": 382.95, "Gemini": 239.34, "EQMOD": 478.69}
"""By the driver's name in the log: periods of worms (PHD2 wiki, page "Mount Worm Period Info", April 2022)."""


def campaign_of(run: GuideRun, file: str) -> AxisCampaign:
    """What `import --axis --run N` writes, asked for the waves of `ASKED`."""
    found = readings_of_run(run, file, {})
    if found.drive is None:
        raise SystemExit(f"{file}: no drive at constant rate")
    stated = {name: AxisPrior(value, u) for name, (value, u) in found.drive.priors.items()}
    return AxisCampaign("arcsec", found.moves, found.readings, stated, {"rate": found.drive.rate}, ASKED)


def run(arguments: argparse.Namespace) -> None:
    """A row for every run of every log in a folder that is not there yet."""
    done = {(row["file"], row["run"]) for row in read_rows(ROWS)}
    for file in sorted(arguments.folder.glob("*.txt"), reverse=True):
        text = file.read_text(encoding="utf-8", errors="replace")
        for logged in read_runs(text, file.name) if is_guide_log(text) else ():
            if len(logged.frames) < FRAMES_MIN or (file.name, logged.number) in done:
                continue
            began = time.process_time()
            found = fit_axis(campaign_of(logged, file.name), tier="importance")
            summary = summarise_axis(found)
            row = {
                "file": file.name,
                "run": logged.number,
                "mount": logged.mount,
                "frames": summary.readings,
                "span_s": float(found.rows.time_s[-1] - found.rows.time_s[0]),
                "problems": list(summary.problems),
                "periods": [plain(one) for one in summary.periods],
                "cpu_s": time.process_time() - began,
            }
            append_row(ROWS, row)
            print(file.name, logged.number, f"{row['cpu_s']:.1f} s", *summary.problems)


TEXT = """# Periods of real mounts, from guide logs

Made by `python -m experiments.real.guide_logs`. Logs of PHD2 (OpenPHDGuiding/phd2, commit 27ca7e21dd, and
ste7e/PHD2Insight, commit 7de4df4d1e), uncorrected motion as `import --axis` makes it. Value(u) with 95 % interval,
given that there is the wave; P/2N: period / (2 N) for N periods in the run; arcsec: amplitude on the axis. The log
names a driver, not a model: the worm is that of the driver's mount that is published.

| log, run | frames | 60 to 200 s | 200 to 700 s | 95 % | P/2N | published | inside | arcsec | there | CPU s |
|---|---|---|---|---|---|---|---|---|---|---|"""


def table(_: argparse.Namespace) -> None:
    """A line for every run."""
    print(TEXT)
    for row in read_rows(ROWS):
        short, long = row["periods"]
        value, (low, high) = long["period"]["value"], long["period"]["interval95"]
        published = next((period for name, period in PUBLISHED_S.items() if name in row["mount"]), None)
        cells = [f"`{row['file']}`, {row['run']}", str(row["frames"])]
        cells += [f"{short['amplitude']['value']:.2f} arcsec every {short['period']['value']:.2f} s"]
        cells += [f"{value:.2f}({long['period']['sd']:.2f})", f"{low:.2f} to {high:.2f}"]
        cells += [f"{value**2 / (2 * row['span_s']):.1f}"]
        cells += ["", ""] if published is None else [f"{published}", "yes" if low <= published <= high else "no"]
        cells += [f"{long['amplitude']['value']:.2f}({long['amplitude']['sd']:.2f})", f"{long['probability']:.3f}"]
        print("| " + " | ".join([*cells, f"{row['cpu_s']:.0f}"]) + " |")


def main() -> None:
    """Do what the command line asks for."""
    made = parser(__doc__)
    made.add_argument("action", choices=("run", "table"))
    made.add_argument("folder", type=Path, nargs="?", help="of logs, for run")
    arguments = made.parse_args()
    {"run": run, "table": table}[arguments.action](arguments)


if __name__ == "__main__":
    main()
