"""Heads with absolute encoders: are they answered, is the promise kept the next night, is a moved zero seen?

    python -m experiments.watching.absolute_heads run --n 10 --cores 0     # 10 heads of each kind, resumable
    python -m experiments.watching.absolute_heads table > experiments/watching/absolute_heads.md

Head i of a kind is drawn with seed i by NumPy alone, nothing of the package in it: geometry, errors by position of its
encoders (`output`) or gears (`motor`, with play that varies), scatter of stops, a zero that walks. 40 to 100 stars are
found, each at its own angles, on a night of one power-up or of two; the approach of the first move is recorded or not.
The next night is another campaign of 40 stars. Tables go through `import --sightings --encoders`. CPU is in imports:
the CPU time of `import jax, optimistix, scipy.stats` in a process of its own, measured beside every head.
"""

from __future__ import annotations

import datetime
import json
import os
import resource
import subprocess
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import binom

from experiments.common.command_line import study
from experiments.common.rows import ROOT, commit, commits_of
from tvsbayes.errors import TvsError
from tvsbayes.studies.executors import SINGLE_THREADED

KINDS = tuple((encoder, sides) for encoder in ("output", "motor") for sides in ("recorded", "unrecorded"))
SEED, NEXT_STARS, NEXT_NIGHTS = 7311, 40, 20
FIRST_NIGHT = datetime.datetime(2026, 3, 1, 20, 0)
NIGHTS_APART = datetime.timedelta(hours=24)
U_DEG = 0.0005
MOVED_U = 10.0
PAN_DEG, TILT_DEG = (-120.0, 120.0), (15.0, 75.0)
IMPORTS = "import jax, optimistix, scipy.stats"


def matern52(distance: np.ndarray, length: float) -> np.ndarray:
    """Correlation of a twice differentiable process."""
    scaled = np.sqrt(5.0) * np.abs(distance) / length
    return (1 + scaled + scaled**2 / 3) * np.exp(-scaled)


def process(rng: np.random.Generator, at: np.ndarray, sd: float, length: float) -> np.ndarray:
    """A drawn process at angles (n,), deg."""
    near = matern52(at[:, None] - at, length) + 1e-9 * np.eye(len(at))
    return sd * np.linalg.cholesky(near) @ rng.standard_normal(len(at))


@dataclass(frozen=True)
class Night:
    """Stars of a night: encoder angles, true directions, deg; hours; sides of approach of the first move."""

    encoder_deg: np.ndarray
    seen_deg: np.ndarray
    hours: np.ndarray
    begins: tuple[int, ...]
    sides: tuple[str, str] | None

    def table(self, shift_deg: float = 0.0) -> str:
        """As a table of sightings; `shift_deg` moves the zero of the elevation."""
        rows = ["segment,time_s,encoder azimuth (deg),encoder elevation (deg),azimuth_deg,elevation_deg,u_deg"]
        rows[0] += ",pan_approach,tilt_approach" if self.sides else ""
        for k, (encoder, seen) in enumerate(zip(self.encoder_deg, self.seen_deg, strict=True)):
            segment = sum(k >= begin for begin in self.begins) - 1
            cells = [f"{segment}", f"{3600 * self.hours[k]:.1f}", *(f"{x:.5f}" for x in encoder)]
            cells += [f"{seen[0]:.6f}", f"{seen[1] + shift_deg:.6f}", f"{U_DEG}"]
            if self.sides:
                cells += list(self.sides) if k in self.begins else ["", ""]
            rows.append(",".join(cells))
        return "\n".join(rows) + "\n"


def turn(axis: int, angle_deg: np.ndarray) -> np.ndarray:
    """Rotation matrices (n, 3, 3) about a coordinate axis."""
    angle = np.radians(np.atleast_1d(angle_deg))
    one, other = [k for k in range(3) if k != axis]
    sign = -1.0 if axis == 1 else 1.0
    matrix = np.tile(np.eye(3), (len(angle), 1, 1))
    matrix[:, one, one] = matrix[:, other, other] = np.cos(angle)
    matrix[:, one, other], matrix[:, other, one] = -sign * np.sin(angle), sign * np.sin(angle)
    return matrix


@dataclass(frozen=True)
class Head:
    """What a drawn head is: scales by axis, deg and hours, and the stars of its first night."""

    stars: int
    drift: tuple[float, ...]
    stop_sd: tuple[float, ...]
    error: tuple[float, ...]
    length: tuple[float, ...]
    half_play: tuple[float, ...]


def drawn_nights(kind: tuple[str, str], seed: int) -> tuple[Night, list[Night], Head]:
    """The first night of a head, and `NEXT_NIGHTS` that may come a day later, each drawn anew after the first."""
    encoder, recorded = kind
    rng = np.random.default_rng([SEED, KINDS.index(kind), seed])
    first, of_motor = int(rng.integers(40, 101)), encoder == "motor"
    count = first + NEXT_NIGHTS * NEXT_STARS
    encoder_deg = np.stack([rng.uniform(*PAN_DEG, count), rng.uniform(*TILT_DEG, count)], axis=1)
    # Each next night begins a day after the first began.
    begun = np.r_[0, np.arange(first, count, NEXT_STARS)]
    night = np.searchsorted(begun, np.arange(count), side="right") - 1
    hours = np.cumsum(rng.uniform(0.02, 0.04, count))
    hours += np.where(night > 0, 24.0, 0.0) - hours[begun][night]
    ratio = 1 + (0.005 if of_motor else 1e-3) * rng.standard_normal(2)
    half = np.abs(rng.standard_normal(2)) * (0.15 if of_motor else 0.0)
    begins = (0, first // 2) if rng.uniform() < 0.5 else (0,)
    output, sides, scales = np.empty((count, 2)), rng.choice([-1, 1], 2), []
    for axis in range(2):
        q = ratio[axis] * encoder_deg[:, axis]
        sd, length = 0.02 * abs(rng.standard_normal()), 8.0 * np.exp(0.5 * rng.standard_normal())
        error = process(rng, encoder_deg[:, axis], sd, length)
        varied = process(rng, encoder_deg[:, axis], 0.1 * half[axis], length)
        at = 0.0
        for k in range(count):
            play = max(half[axis] + varied[k] / 2, 0.0)
            # A shaft that somebody turned by hand comes from either side.
            side = sides[axis] if k in begins or k in begun else None
            at = q[k] - play * side if side else float(np.clip(at, q[k] - play, q[k] + play))
            output[k, axis] = at
        stop_sd, drift = np.exp(0.5 * rng.standard_normal()) * 0.002, 0.002 * abs(rng.standard_normal())
        pause = np.where(np.arange(count) == begun[night], hours - hours[first - 1], np.diff(hours, prepend=0.0))
        walk = np.cumsum(np.sqrt(np.r_[0.0, pause[1:]]) * rng.standard_normal(count))
        # Every next night walks on from the end of the first.
        walk += np.where(night > 0, walk[first - 1] - walk[begun - 1][night], 0.0)
        output[:, axis] += error + stop_sd * rng.standard_normal(count) + drift * walk
        scales.append((drift, stop_sd, sd, length, half[axis]))
    zero, lean = rng.normal(0, 0.3, 2), rng.normal(0, 0.1, 2)
    square, beam = rng.normal(0, 0.1, 2)
    pointing = turn(0, lean[0]) @ turn(1, lean[1]) @ turn(2, output[:, 0] + zero[0])
    pointing = pointing @ turn(0, square) @ turn(1, -(output[:, 1] + zero[1])) @ turn(2, beam)
    x, y, z = pointing[:, :, 0].T
    seen = np.degrees(np.stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))], axis=1))
    off = U_DEG * rng.standard_normal((count, 2))
    seen += off / np.stack([np.cos(np.radians(seen[:, 1])), np.ones(count)], axis=1)
    words = (("right", "left")[int(sides[0] > 0)], ("down", "up")[int(sides[1] > 0)])
    named = words if recorded == "recorded" else None
    nights = []
    for k, at in enumerate(begun):
        p = slice(at, first if k == 0 else at + NEXT_STARS)
        nights.append(Night(encoder_deg[p], seen[p], hours[p] - hours[at], (0,) if k else begins, named))
    return nights[0], nights[1:], Head(first, *map(tuple, zip(*scales, strict=True)))


def tvsbayes(cwd: Path, *words: str) -> tuple[float, subprocess.CompletedProcess]:
    """CPU seconds of a command of the package, and what it left."""
    return cpu_s(cwd, "-m", "tvsbayes", *words)


def cpu_s(cwd: Path, *words: str) -> tuple[float, subprocess.CompletedProcess]:
    """CPU seconds of Python with these arguments, and what it left."""
    environment = {**os.environ, **SINGLE_THREADED, "PYTHONPATH": str(ROOT)}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, *words]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False, env=environment)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, done


def imported(cwd: Path, name: str, table: str, encoder: str, start: datetime.datetime) -> None:
    """Make a campaign of a night's table, dated."""
    (cwd / f"{name}.csv").write_text(table)
    words = ("import", f"{name}.csv", "--sightings", "--to", name, "--encoders", encoder, "--yes")
    _, done = tvsbayes(cwd, *words)
    if done.returncode:
        raise RuntimeError(done.stderr)
    campaign = cwd / name / "campaign.toml"
    first, *others = campaign.read_text().splitlines()
    campaign.write_text("\n".join([first, f"created = {start.isoformat()}", *others, ""]))


def one_head(task: tuple[str, str, int]) -> dict[str, object]:
    """One head: fitted by the command, then its next night, and the same with a zero that moved."""
    encoder, recorded, seed = task
    first, later, stars = drawn_nights((encoder, recorded), seed)
    row: dict[str, object] = {"encoder": encoder, "sides": recorded, "seed": seed, "stars": stars, "commit": commit()}
    with tempfile.TemporaryDirectory() as folder:
        cwd = Path(folder)
        imported(cwd, "night", first.table(), encoder, FIRST_NIGHT)
        imported(cwd, "next", later.table(), encoder, FIRST_NIGHT + NIGHTS_APART)
        imports, _ = cpu_s(cwd, "-c", IMPORTS)
        taken, done = tvsbayes(cwd, "fit", "night", "--quick", "--json")
        row |= {"imports": taken / imports, "import_s": imports, "answer": "none"}
        if done.returncode:
            return row | {"problem": done.stderr[-300:]}
        fitted = json.loads(done.stdout)
        zero = fitted["parameters"]["elevation_zero_deg"]["sd"]
        row |= {"answer": fitted["answer"], "u_zero_deg": zero}
        imported(cwd, "moved", later.table(MOVED_U * zero), encoder, FIRST_NIGHT + NIGHTS_APART)
        return row | _next_night(cwd)


def _next_night(cwd: Path) -> dict[str, object]:
    """Promise and errors of the next night, verdicts on it and on the moved zero."""
    from tvsbayes.comparison.verified_looks import SeenAngles, accepted_calibration, verify_looks
    from tvsbayes.comparison.watched_looks import WatchedLooks, watch
    from tvsbayes.instrument.campaign import read_campaign
    from tvsbayes.model.compilation_cache import use_compilation_cache
    from tvsbayes.pipeline import StoredOrFitted
    from tvsbayes.progress import Job

    use_compilation_cache()
    campaign, later, moved = (read_campaign(cwd / name) for name in ("night", "next", "moved"))
    with Job({"fit": 1.0}, None) as job:
        known = StoredOrFitted(campaign, str, job.part("fit")).fit
    result: dict[str, object] = {}
    for name, looks in (("next", later), ("moved", moved)):
        seen = watch(known, looks)
        result |= {f"{name}_verdict": seen.verdict, f"{name}_p": seen.p, f"{name}_what": [m.what for m in seen.moved]}
    try:
        calibration = accepted_calibration(campaign)
    except TvsError as error:
        return result | {"problem": error.message}
    promised = verify_looks(known, calibration, later)
    sides = np.zeros((len(later.spots), 2))
    errors = np.abs(SeenAngles.of(known, WatchedLooks(known, later), sides, 0).value)
    inside = float(np.mean(errors <= promised.promised95))
    verdict = {"verify": promised.verdict, "promised95_deg": promised.promised95, "inside": inside}
    return result | verdict | {"error95_deg": float(np.quantile(errors, 0.95))}


TEXT = """# Heads with absolute encoders

Made by `python -m experiments.watching.absolute_heads`. Heads drawn by NumPy alone: encoders on the axes (`output`) or
before the gears (`motor`), 40 to 100 stars, each at angles of its own, sides of approach recorded or not. `fit --quick`
on the first night; the next night, a day later, is 40 stars. CPU in imports of JAX, optimistix and scipy.stats."""


def table(rows: list[dict]) -> None:
    """Answers and cost by kind, then promises and alarms."""
    print(TEXT)
    print("\n| encoders | sides | heads | accepted | rough | other | median imports | largest |")
    print("|---|---|---|---|---|---|---|---|")
    for kind in (*KINDS, None):
        own = [row for row in rows if kind in (None, (row["encoder"], row["sides"]))]
        if not own:
            continue
        count = Counter(row["answer"] for row in own)
        imports = [row["imports"] for row in own]
        others = len(own) - count["accepted"] - count["rough"]
        name = "**all** | " if kind is None else " | ".join(kind)
        print(f"| {name} | {len(own)} | {count['accepted']} | {count['rough']} | {others}", end=" | ")
        print(f"{np.median(imports):.0f} | {max(imports):.0f} |")
    kept = [row for row in rows if "inside" in row]
    seen = [row for row in rows if "next_verdict" in row]
    if kept:
        ratio = np.array([row["promised95_deg"] / row["error95_deg"] for row in kept])
        inside = 100 * np.mean([row["inside"] for row in kept])
        print(
            f"\nPromise of the next night, {len(kept)} heads: {inside:.1f} % of errors within it; promise over", end=" "
        )
        print(
            f"the actual 95 % of a head's errors {np.median(ratio):.2f} (median), {ratio.max():.2f} (largest)", end="; "
        )
        print(f"BROKEN {sum(row['verify'] == 'BROKEN' for row in kept)}.")
    if seen:
        alarms = sum(row["next_verdict"] == "MOVED" for row in seen)
        most = binom.isf(0.001, len(seen), 0.01)
        found = sum(row["moved_verdict"] == "MOVED" for row in seen)
        print(f"\n`watch`, {len(seen)} heads: {alarms} false alarms (at 1 % at most {most:.0f} in 99.9 %); an", end=" ")
        print(f"elevation zero moved by {MOVED_U:g} u is MOVED in {found}.")
    print(f"\nCommit {commits_of(rows)}.")


if __name__ == "__main__":
    study(__file__, __doc__, one_head, ("encoder", "sides", "seed"), KINDS, table, 10)
