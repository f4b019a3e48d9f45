"""Heads with absolute encoders: are they answered, is the promise kept the next night, is a moved zero seen?

    python -m experiments.watching.absolute_heads run --n 10 --cores 0     # 10 heads of each kind, resumable
    python -m experiments.watching.absolute_heads table > experiments/watching/absolute_heads.md

Head i of a kind is drawn with seed i by NumPy alone, nothing of the package in it: geometry, errors by position of its
encoders (`output`) or gears (`motor`, with play that varies), scatter of stops, a zero that walks. 40 to 100 stars are
found, each at its own angles, on a night of one power-up or of two; the approach of the first move is recorded or not.
Heads are of three `USES`, in turn: a zero that walks little, as far as the prior says, or little and seen on
another night of 40 stars as well. The next night is another campaign of 40 stars, drawn eight times after the same
first one: the actual error is that of these. Tables go through `import --sightings --encoders`. CPU is in imports: the
CPU time of `import jax, optimistix, scipy.stats` in a process of its own, measured beside every head.
"""

from __future__ import annotations

import datetime
import json
import subprocess
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import binom

from experiments.common.command_line import study
from experiments.common.commands import IMPORTS, PROGRAM, measured
from experiments.common.page import table
from experiments.common.rows import commit, commits_of
from tvsbayes.errors import TvsError
from tvsbayes.studies.executors import SINGLE_THREADED

KINDS = tuple((encoder, sides) for encoder in ("output", "motor") for sides in ("recorded", "unrecorded"))
USES = (("walks little", 0.002, 1), ("walks as the prior says", 0.02, 1), ("walks little, two nights", 0.002, 2))
"""Names of uses, scale of the walk, deg per root hour, and nights of the campaign."""
SEED, NEXT_STARS, NEXT_NIGHTS = 7311, 40, 8
FIRST_NIGHT = datetime.datetime(2026, 3, 1, 20, 0)
NIGHTS_APART = datetime.timedelta(hours=24)
U_DEG = 0.0005
MOVED_U = 10.0
PAN_DEG, TILT_DEG = (-120.0, 120.0), (15.0, 75.0)


def process(rng: np.random.Generator, at: np.ndarray, sd: float, length: float) -> np.ndarray:
    """A drawn process at angles (n,), deg, twice differentiable: Matern's 5/2."""
    scaled = np.sqrt(5.0) * np.abs(at[:, None] - at) / length
    near = (1 + scaled + scaled**2 / 3) * np.exp(-scaled) + 1e-9 * np.eye(len(at))
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


def use_of(kind: tuple[str, str], seed: int) -> tuple[str, float, int]:
    """The use of a head: each kind has all of them in turn."""
    return USES[(seed + KINDS.index(kind)) % len(USES)]


def drawn_nights(kind: tuple[str, str], seed: int) -> tuple[Night, list[Night], int]:
    """A head's campaign, `NEXT_NIGHTS` that may come a day later, each drawn anew, and the stars of the campaign."""
    encoder, recorded = kind
    rng = np.random.default_rng([SEED, KINDS.index(kind), seed])
    _, walks, nights = use_of(kind, seed)
    first, of_motor = int(rng.integers(40, 101)), encoder == "motor"
    known = first + (nights - 1) * NEXT_STARS
    count = known + NEXT_NIGHTS * NEXT_STARS
    encoder_deg = np.stack([rng.uniform(*PAN_DEG, count), rng.uniform(*TILT_DEG, count)], axis=1)
    # Each next night begins a day after the last one of the campaign began.
    begun = np.r_[0, np.arange(first, count, NEXT_STARS)]
    night = np.searchsorted(begun, np.arange(count), side="right") - 1
    hours = np.cumsum(rng.uniform(0.02, 0.04, count))
    hours += 24.0 * np.minimum(night, nights) - hours[begun][night]
    ratio = 1 + (0.005 if of_motor else 1e-3) * rng.standard_normal(2)
    half = np.abs(rng.standard_normal(2)) * (0.15 if of_motor else 0.0)
    begins = (0, first // 2) if rng.uniform() < 0.5 else (0,)
    begins += tuple(range(first, known, NEXT_STARS))
    output, sides = np.empty((count, 2)), rng.choice([-1, 1], 2)
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
        stops = np.exp(0.5 * rng.standard_normal()) * 0.002 * rng.standard_normal(count)
        later = night >= nights
        since = np.where(
            later & np.isin(np.arange(count), begun), hours - hours[known - 1], np.diff(hours, prepend=0.0)
        )
        walk = np.cumsum(np.sqrt(since) * rng.standard_normal(count))
        # Every next night walks on from the end of the campaign.
        walk += np.where(later, walk[known - 1] - walk[begun - 1][night], 0.0)
        output[:, axis] += error + stops + walks * abs(rng.standard_normal()) * walk
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
    parts = [slice(0, known), *(slice(at, at + NEXT_STARS) for at in begun[nights:])]
    first_rows = [begins, *((0,) for _ in parts[1:])]
    each = [
        Night(encoder_deg[p], seen[p], hours[p] - hours[p][0], b, named) for p, b in zip(parts, first_rows, strict=True)
    ]
    return each[0], each[1:], known


def ran(cwd: Path, *command: str) -> tuple[str, float]:
    """What a command prints, and its CPU seconds; on one thread."""
    printed, cost = measured(command, cwd=cwd, variables=SINGLE_THREADED)
    return printed, cost["cpu_s"]


def imported(cwd: Path, name: str, table: str, encoder: str, start: datetime.datetime) -> None:
    """Make a campaign of a night's table, dated."""
    (cwd / f"{name}.csv").write_text(table)
    ran(cwd, *PROGRAM, "import", f"{name}.csv", "--sightings", "--to", name, "--encoders", encoder, "--yes")
    campaign = cwd / name / "campaign.toml"
    first, *others = campaign.read_text().splitlines()
    campaign.write_text("\n".join([first, f"created = {start.isoformat()}", *others, ""]))


def one_head(task: tuple[str, str, int]) -> dict[str, object]:
    """One head: fitted by the command, then its next night, and the same with a zero that moved."""
    encoder, recorded, seed = task
    campaign, later, stars = drawn_nights((encoder, recorded), seed)
    use, _, nights = use_of((encoder, recorded), seed)
    next_night = FIRST_NIGHT + nights * NIGHTS_APART
    row: dict[str, object] = {"encoder": encoder, "sides": recorded, "seed": seed, "use": use, "stars": stars}
    row["commit"] = commit()
    with tempfile.TemporaryDirectory() as folder:
        cwd = Path(folder)
        imported(cwd, "night", campaign.table(), encoder, FIRST_NIGHT)
        for k, night in enumerate(later):
            imported(cwd, f"next{k}", night.table(), encoder, next_night)
        _, imports = ran(cwd, *IMPORTS)
        try:
            printed, taken = ran(cwd, *PROGRAM, "fit", "night", "--quick", "--json")
        except subprocess.CalledProcessError as error:
            return row | {"answer": "none", "problem": (error.stdout + error.stderr)[-300:]}
        row |= {"imports": taken / imports, "import_s": imports}
        fitted = json.loads(printed)
        zero = fitted["parameters"]["elevation_zero_deg"]["sd"]
        row |= {"answer": fitted["answer"], "u_zero_deg": zero}
        imported(cwd, "moved", later[0].table(MOVED_U * zero), encoder, next_night)
        return row | _next_night(cwd)


def _next_night(cwd: Path) -> dict[str, object]:
    """Promise and errors of the next nights, verdicts on the first of them and on the moved zero."""
    from tvsbayes.comparison.verified_looks import NOISE_DRAWS, accepted_calibration, verify_looks
    from tvsbayes.comparison.watched_looks import WatchedLooks, watch
    from tvsbayes.estimators.noise_scales import noise_draws
    from tvsbayes.instrument.campaign import read_campaign
    from tvsbayes.model.compilation_cache import use_compilation_cache
    from tvsbayes.pipeline import StoredOrFitted
    from tvsbayes.progress import Job

    use_compilation_cache()
    campaign, moved = (read_campaign(cwd / name) for name in ("night", "moved"))
    later = [read_campaign(cwd / f"next{k}") for k in range(NEXT_NIGHTS)]
    with Job({"fit": 1.0}, None) as job:
        known = StoredOrFitted(campaign, str, job.part("fit")).fit
    result: dict[str, object] = {}
    for name, looks in (("next", later[0]), ("moved", moved)):
        seen = watch(known, looks)
        result |= {f"{name}_verdict": seen.verdict, f"{name}_p": seen.p, f"{name}_what": [m.what for m in seen.moved]}
    try:
        calibration = accepted_calibration(campaign)
    except TvsError as error:
        return result | {"problem": error.message}
    promised, centre = verify_looks(known, calibration, later[0]), noise_draws(known, NOISE_DRAWS, 0).centre
    errors = []
    for looks in later:
        seen_angles = WatchedLooks(known, looks).departure(centre, angles=True)
        errors.append(np.abs(np.linalg.solve(seen_angles.information, seen_angles.score)))
    inside = [float(np.mean(each <= promised.promised95)) for each in errors]
    verdict = {"verify": promised.verdict, "promised95_deg": promised.promised95, "inside": inside}
    verdict["night95_deg"] = [float(np.quantile(each, 0.95)) for each in errors]
    return result | verdict | {"error95_deg": float(np.quantile(errors, 0.95))}


TEXT = """# Heads with absolute encoders

Made by `python -m experiments.watching.absolute_heads`. Heads drawn by NumPy alone: encoders on the axes (`output`) or
before the gears (`motor`), 40 to 100 stars, each at angles of its own, sides of approach recorded or not. `fit --quick`
on them; the next night, a day later, is 40 stars. CPU in imports of JAX, optimistix and scipy.stats.
"""


def page(rows: list[dict]) -> None:
    """Answers and cost by kind, then promises and alarms."""
    print(TEXT)
    lines = []
    for kind in (*KINDS, ("**all**", "")):
        if own := [row for row in rows if not kind[1] or kind == (row["encoder"], row["sides"])]:
            count, cost = Counter(row["answer"] for row in own), [row["imports"] for row in own if "imports" in row]
            named = count["accepted"], count["rough"], len(own) - count["accepted"] - count["rough"]
            lines.append((*kind, len(own), *named, f"{np.median(cost):.0f}", f"{max(cost):.0f}"))
    titles = ("encoders", "sides", "heads", "accepted", "rough", "other", "median imports", "largest")
    print(table(titles, lines))
    print("\nPromise of the next night over the actual 95 % of errors, of eight drawn nights and of one alone:\n")
    lines = []
    for use, *_ in USES:
        if own := [row for row in rows if "inside" in row and row["use"] == use]:
            ratio = np.array([row["promised95_deg"] / row["error95_deg"] for row in own])
            once = np.array([row["promised95_deg"] / np.array(row["night95_deg"]) for row in own])
            shown = f"{100 * np.mean([row['inside'] for row in own]):.1f} %", f"{np.median(ratio):.2f}"
            ends = f"{ratio.max():.2f}", f"{np.median(once):.2f}", sum(row["verify"] == "BROKEN" for row in own)
            lines.append((use, len(own), *shown, *ends))
    titles = ("the zero", "heads", "errors within", "promise over actual, median", "largest", "over one night's")
    print(table((*titles, "BROKEN"), lines))
    if seen := [row for row in rows if "next_verdict" in row]:
        alarms, found = (sum(row[f"{day}_verdict"] == "MOVED" for row in seen) for day in ("next", "moved"))
        most = binom.isf(0.001, len(seen), 0.01)
        print(f"\n`watch`, {len(seen)} heads: {alarms} false alarms (at 1 % at most {most:.0f} in 99.9 %); an", end=" ")
        print(f"elevation zero moved by {MOVED_U:g} u is MOVED in {found}.")
    print(f"\nCommit {commits_of(rows)}.")


if __name__ == "__main__":
    study(__file__, __doc__, one_head, ("encoder", "sides", "seed"), KINDS, page, 10)
