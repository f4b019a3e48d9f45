"""The page of tables from the rows."""

from __future__ import annotations

import importlib
import os
import platform
from pathlib import Path

import numpy as np

from experiments.common.rows import read_rows
from experiments.speed.benchmarks.measure import cpu_model, rows_path, table, versions


def write(path: Path, parts: list[str]) -> None:
    """Write the Markdown page of everything that is there."""
    rows = read_rows(rows_path())
    if not rows:
        raise SystemExit(f"{path.name} stays: nothing was measured yet with these versions and this state of tvsbayes")
    page = ["# Benchmarks", "", "Written by `python -m experiments.speed.benchmarks` (`--help` says how).", ""]
    page += [f"{cpu_model()}, {os.cpu_count()} cores, {platform.system()}; "]
    page[-1] += ", ".join(f"{name} {number}" for name, number in versions().items()) + "."
    load = np.quantile([row["load"] for row in rows], [0.0, 0.25, 0.5, 0.75, 1.0])
    first, last = min(row["at"] for row in rows), max(row["at"] for row in rows)
    cores = {row["part"]: row.get("cores", "?") for row in rows}
    commits = ", ".join(sorted({row["commit"] for row in rows}))
    page += [
        "",
        f"Measured {first} to {last} UTC at commit {commits}; load average (1 minute) beside the rows: median "
        f"{load[2]:.1f}, quartiles {load[1]:.1f} and {load[3]:.1f}, {load[0]:.1f} to {load[4]:.1f}. "
        f"Cores allowed, by part: {'; '.join(f'{part} {count}' for part, count in sorted(cores.items()))}.",
    ]
    page += [
        "",
        "Numbers are medians of n repeats with quartiles in brackets. Contenders took turns, so that what else the "
        "machine did hit all alike; ratios are taken within a repeat. Compared code ran on one thread, commands ran as "
        "users start them.",
        "",
    ]
    for part in parts:
        chosen = [row for row in rows if row["part"] == part]
        if not chosen:
            continue
        module = importlib.import_module(f".{part}", __package__)
        page += [f"## {module.TITLE}", ""]
        for case in module.cases():
            page += table(case, chosen)
        if remarks := [f"- {line}" for line in module.remarks(chosen)] if hasattr(module, "remarks") else []:
            page += [*remarks, ""]
    path.write_text("\n".join(page).rstrip() + "\n", encoding="utf-8")
    print(f"wrote {path.name} from {len(rows)} rows")
