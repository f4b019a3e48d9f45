"""Do guide logs of real mounts give the periods that are published, and does one night predict the next?

    python -m experiments.real.guide_logs run FOLDER          # PHD2 logs, by the importer of `import --axis`
    python -m experiments.real.guide_logs table > experiments/real/guide_logs.md

Every run of at least `FRAMES_MIN` frames is read, with the periods that `import --axis` writes: one range of periods,
from a minute to a third of the run; fits by weighted draws.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from experiments.common.command_line import act, parser
from experiments.common.page import line
from experiments.common.rows import append_row, output, read_rows
from tvsbayes.importing.guide import GuideRun, is_guide_log, read_runs, rows_of_run
from tvsbayes.results.records import plain
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, Reading
from tvsbayes.single_axis.axis_fit import fit_axis
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.axis_record import summarise_axis
from tvsbayes.single_axis.waves import WavePeriods

ROWS = output(__file__, "guide_logs.jsonl")
FRAMES_MIN = 100
SURE = 0.95
"""Probability from which on a wave is named."""
PUBLISHED_S = {"AstroPhysics": 382.95, "Gemini": 239.34, "EQMOD": 478.69}
"""By the driver's name in the log: periods of worms (PHD2 wiki, page "Mount Worm Period Info", April 2022)."""


NIGHTS = {"PHD2_GuideLog_001.txt": "first", "PHD2_GuideLog_002.txt": "second"}
"""Of one mount."""
NEAR = 0.03
"""Share of the published period within which a wave is the worm's."""


def campaign_of(run: GuideRun, runs: list[GuideRun], file: str) -> AxisCampaign:
    """What `import --axis --run N` writes."""
    rows = rows_of_run(run, runs, file, {})
    if "period_between" not in rows.axis:
        raise SystemExit(f"{file}: too short a run")
    stated = {name: AxisPrior(**rows.axis[name]) for name in ("per_command", "transmission_error")}
    low, high = rows.axis["period_between"]
    moves = tuple(AxisMove(**row) for row in rows.moves)
    readings = tuple(Reading(**row) for row in rows.readings)
    periods = WavePeriods((), ((low, high),), True)
    return AxisCampaign("arcsec", moves, readings, stated, {"rate": rows.header["rate"]}, periods)


def run(arguments: argparse.Namespace) -> None:
    """A row for every run of every log in a folder that is not there yet."""
    done = {(row["file"], row["run"]) for row in read_rows(ROWS)}
    for file in sorted(arguments.folder.glob("*.txt"), reverse=True):
        text = file.read_text(encoding="utf-8", errors="replace")
        runs = read_runs(text, file.name) if is_guide_log(text) else []
        for logged in runs:
            if len(logged.frames) < FRAMES_MIN or (file.name, logged.number) in done:
                continue
            began = time.process_time()
            result = fit_axis(campaign_of(logged, runs, file.name), tier="importance")
            summary = summarise_axis(result)
            row = {"file": file.name, "run": logged.number, "mount": logged.header["mount"], "frames": summary.readings}
            row |= {"span_s": float(result.rows.time_s[-1] - result.rows.time_s[0]), "problems": list(summary.problems)}
            row |= {"periods": [plain(one) for one in summary.periods], "cpu_s": time.process_time() - began}
            append_row(ROWS, row)
            print(file.name, logged.number, f"{row['cpu_s']:.1f} s", *summary.problems)


TEXT = """# Periods of real mounts, from guide logs

Made by `python -m experiments.real.guide_logs`. Logs of PHD2 (OpenPHDGuiding/phd2, commit 27ca7e21dd, and
ste7e/PHD2Insight, commit 7de4df4d1e), uncorrected motion as `import --axis` makes it, with the one range of periods
that it writes. Value(u) with 95 % interval, given that there is the wave, strongest first; P/2N: period / (2 N) for N
periods in the run; arcsec: amplitude on the axis. The log names a driver, not a model: the worm is that of the
driver's mount that is published; the strongest wave of 02 is not its worm's, which its record does not show. Ten runs
at commit fa06a88.

| log, run | frames | strongest, s | 95 % | P/2N | arcsec | published | inside | further waves: arcsec every s | CPU s |
|---|---|---|---|---|---|---|---|---|---|"""
NIGHTS_TEXT = """
## One night predicts the next

The worm's wave in the runs of one mount on two nights: every run beside the weighted mean of the other night's.
z: difference over both u.

| night, run | arcsec | other night | z |
|---|---|---|---|"""


def table(_: argparse.Namespace) -> None:
    """A line for every run, then the nights of one mount."""
    print(TEXT)
    nights: dict[str, list[tuple[int, float, float]]] = {}
    for row in read_rows(ROWS):
        every = [wave for wave in row["periods"] if wave["probability"] > SURE]
        first, further = (every or row["periods"])[0], every[1:]
        value, (low, high) = first["period"]["value"], first["period"]["interval95"]
        published = next((period for name, period in PUBLISHED_S.items() if name in row["mount"]), None)
        cells = [f"`{row['file']}`, {row['run']}", str(row["frames"])]
        cells += [f"{value:.2f}({first['period']['sd']:.2f})", f"{low:.2f} to {high:.2f}"]
        cells += [f"{value**2 / (2 * row['span_s']):.1f}"]
        cells += [f"{first['amplitude']['value']:.2f}({first['amplitude']['sd']:.2f})"]
        cells += ["", ""] if published is None else [f"{published}", "yes" if low <= published <= high else "no"]
        cells += [", ".join(f"{w['amplitude']['value']:.2f} every {w['period']['value']:.1f}" for w in further)]
        print(line(*cells, f"{row['cpu_s']:.0f}"))
        if row["file"] in NIGHTS and published is not None and abs(value / published - 1) < NEAR:
            amplitude = first["amplitude"]
            nights.setdefault(row["file"], []).append((row["run"], amplitude["value"], amplitude["sd"]))
    print(NIGHTS_TEXT)
    for file, runs in nights.items():
        others = np.array([run for other, every in nights.items() if other != file for run in every])
        weight = others[:, 2] ** -2
        mean, u = float(weight @ others[:, 1] / weight.sum()), float(weight.sum() ** -0.5)
        for number, value, sd in runs:
            cells = (f"{NIGHTS[file]}, {number}", f"{value:.2f}({sd:.2f})", f"{mean:.2f}({u:.2f})")
            print(line(*cells, f"{(value - mean) / np.hypot(sd, u):.1f}"))


if __name__ == "__main__":
    cli = parser(__doc__, run=run, table=table)
    cli.add_argument("folder", type=Path, nargs="?", help="of logs, for run")
    act(cli)
