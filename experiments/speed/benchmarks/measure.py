"""Interleaved timing, rows that survive an interruption, medians with quartiles, and what the machine was.

Contenders of one case take turns, each once per repeat, and who goes first moves on with every repeat: whatever else
the machine does hits all alike. A ratio is taken within a repeat and its median over the repeats is what is printed.
Wall and CPU seconds are the process' own; peak memory (of child processes) is resident, MiB.
"""

from __future__ import annotations

import datetime
import hashlib
import importlib
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from experiments.common.rows import OUTPUT, ROOT, append_row, commit, git, read_rows

PACKAGES = (
    "numpy",
    "scipy",
    "jax",
    "optimistix",
    "emcee",
    "numpyro",
    "blackjax",
    "opencv-python-headless",
    "photutils",
    "astropy",
)


@dataclass(frozen=True)
class Column:
    """One printed measure: its key in the rows, its heading, and how a number of it is written."""

    key: str
    heading: str
    form: str = "{:.3g}"


@dataclass(frozen=True)
class Case:
    """One table: contenders that did the same work.

    Attributes:
        name: of the case in the rows.
        about: what was done, in a sentence or two.
        columns: what is printed of each contender.
        ratio: key of the measure that is also printed relative to that of `ours`; none if empty.
        ours: the contender that the others are compared with.
    """

    name: str
    about: str
    columns: tuple[Column, ...]
    ratio: str = ""
    ours: str = "tvsbayes"


Work = Callable[[int], Mapping[str, object]]


@dataclass
class Bench:
    """Where the rows of one part go; `rows` are those of the part that are there already."""

    part: str
    repeats: int
    path: Path
    rows: list[dict] = field(default_factory=list)

    def there(self, case: str, contender: str) -> set[int]:
        """Repeats that need not be made."""
        return {r["repeat"] for r in self.rows if (r["case"], r["contender"]) == (case, contender)}

    def missing(self, case: str, contenders: Sequence[str], repeats: int | None = None) -> bool:
        """Is there anything to do? Asked before a costly preparation."""
        count = self.repeats if repeats is None else repeats
        return any(not set(range(count)) <= self.there(case, name) for name in contenders)

    def interleaved(self, case: str, contenders: Mapping[str, Work], repeats: int | None = None) -> None:
        """Every contender once per repeat, in turn; `work(repeat)` returns the row's values."""
        names = list(contenders)
        done = {name: self.there(case, name) for name in names}
        for repeat in range(self.repeats if repeats is None else repeats):
            first = repeat % len(names)
            for name in names[first:] + names[:first]:
                if repeat not in done[name]:
                    self.keep(case, name, repeat, contenders[name](repeat))

    def keep(self, case: str, contender: str, repeat: int, values: Mapping[str, object]) -> None:
        """Append one row."""
        row = {"part": self.part, "case": case, "contender": contender, "repeat": repeat, "values": dict(values)}
        row |= {"load": os.getloadavg()[0], "at": f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d %H:%M}"}
        row |= {"commit": state(), "cores": len(os.sched_getaffinity(0))}
        append_row(self.path, row)
        self.rows.append(row)
        shown = ", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in values.items())
        print(f"{self.part} | {case} | {contender} | {repeat}: {shown}", flush=True)


def command_cost(
    command: Sequence[str], environment: Mapping[str, str] | None = None, limit_s: float = 600.0
) -> tuple[str, dict[str, float]]:
    """Standard output of a child process, with its wall and CPU seconds and its peak resident memory.

    Raises:
        subprocess.CalledProcessError: it failed.
        subprocess.TimeoutExpired: it ran longer than `limit_s` and was killed.
    """
    with tempfile.TemporaryDirectory() as place:
        report = Path(place) / "cost.json"
        launcher = [sys.executable, "-S", str(Path(__file__).with_name("child.py")), str(report), str(limit_s)]
        done = subprocess.run(
            [*launcher, *command], env=environment, cwd=ROOT, capture_output=True, text=True, errors="replace"
        )
        cost = json.loads(report.read_text())
    if cost.pop("late"):
        raise subprocess.TimeoutExpired(command, limit_s)
    if code := cost.pop("code"):
        raise subprocess.CalledProcessError(code, command, done.stdout, done.stderr[-2000:])
    return done.stdout, cost


def state() -> str:
    """Short commit of the working tree, with + where tracked files of the package differ from it; ? outside git."""
    return commit() + "+" * bool(git("diff", "--name-only", "HEAD", "--", "tvsbayes"))


def cpu_model() -> str:
    """The processor's own name."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def versions() -> dict[str, str]:
    """Of Python and every package that takes part; a package that is not there is left out."""
    version_of = {"Python": platform.python_version()}
    for name in PACKAGES:
        try:
            version_of[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return version_of


def rows_path() -> Path:
    """Rows of one machine, one set of versions and one state of the package never mix with others."""
    digest = hashlib.sha256(json.dumps([cpu_model(), os.cpu_count(), versions()]).encode())
    for path in sorted((ROOT / "tvsbayes").rglob("*.py")):
        digest.update(path.read_bytes())
    return OUTPUT / "speed" / f"benchmarks-{digest.hexdigest()[:12]}.jsonl"


def spread(values: Sequence[float], form: str = "{:.3g}") -> str:
    """Median, and quartiles in brackets where there is a spread."""
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
    text, ends = form.format(middle), (form.format(low), form.format(high))
    return text if ends == (text, text) else f"{text} ({ends[0]} to {ends[1]})"


def table(case: Case, rows: Sequence[Mapping]) -> list[str]:
    """Markdown of one case; empty without rows."""
    chosen: dict[str, dict[int, Mapping]] = {}
    for row in rows:
        if row["case"] == case.name:
            chosen.setdefault(row["contender"], {})[row["repeat"]] = row["values"]
    if not chosen:
        return []
    columns = [c for c in case.columns if any(c.key in v for of in chosen.values() for v in of.values())]
    heading = next((f"{c.heading}, relative to {case.ours}" for c in columns if c.key == case.ratio), "")
    titles = ["", *(c.heading for c in columns), *([heading] if case.ratio else []), "n"]
    lines = [f"{case.name}. {case.about}", "", f"| {' | '.join(titles)} |", "|" + "---|" * len(titles)]
    for name, of in chosen.items():
        cells = [name]
        for column in columns:
            values = [v[column.key] for v in of.values() if v.get(column.key) is not None]
            numbers = [v for v in values if not isinstance(v, str)]
            cells.append(spread(numbers, column.form) if numbers else (values[0] if values else ""))
        if case.ratio:
            ours = chosen.get(case.ours, {})
            both = [
                (of[k][case.ratio], ours[k][case.ratio])
                for k in sorted(set(of) & set(ours))
                if of[k].get(case.ratio) is not None and ours[k].get(case.ratio) is not None
            ]
            ratios = [a / b for a, b in both]
            cells.append(spread(ratios, "{:.3g}") if ratios and name != case.ours else "")
        lines.append(f"| {' | '.join([*cells, str(len(of))])} |")
    return [*lines, ""]


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
