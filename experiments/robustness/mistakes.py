"""Which mistakes in a campaign's tables `check` sees, and how often it accuses a sound campaign.

    python -m experiments.robustness.mistakes [--seeds 60] [--sound 500]

Mistakes are made in every one of the shipped twins and of simulations of the mounted rig after its four plans. Sound
campaigns are drawn by the twin from all protocols, from what `tvsbayes plan` proposes (plans/RIG_SEED.csv: `tvsbayes
plan data/rigs/RIG/rig.toml --draws 20 --minutes 30 --seed SEED`) and from random grids and steps, on rigs near and far
from the shipped ones, and cut at many looks. A finding is any of `estimators.plausibility.implausible`: warnings of
what a plan cannot tell are none.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from experiments.common.command_line import parser
from experiments.common.page import heading, line
from experiments.common.rigs import PIXELS, TWINS, mounted_rig, shipped_plan, twin_campaign
from tvsbayes.estimators.plausibility import implausible
from tvsbayes.estimators.spot_pattern import SPOTS_MIN
from tvsbayes.files.disk import shipped_data, write_atomically
from tvsbayes.instrument.campaign import Campaign, Move, Spot
from tvsbayes.instrument.corrections import Correction, corrected
from tvsbayes.instrument.parameters import Prior, names_of
from tvsbayes.instrument.plan import PlanStep, read_plan
from tvsbayes.instrument.protocols import PROTOCOLS, four_point_protocol, grid_protocol
from tvsbayes.instrument.rig import Rig, read_rig
from tvsbayes.instrument.stereo_pair import pair_doubts
from tvsbayes.twin.simulated_campaign import simulate

PLANS = ("paper", "paper_twin", "mixed", "grid")
Change = Callable[[Campaign, np.random.Generator], Campaign]


def of_spots(change: Callable[[int, Spot, np.random.Generator], Spot]) -> Change:
    """A change of every spot, by its place."""
    return lambda campaign, rng: replace(
        campaign, spots=tuple(change(place, spot, rng) for place, spot in enumerate(campaign.spots))
    )


def of_moves(change: Callable[[Move], Move]) -> Change:
    return lambda campaign, _: replace(campaign, moves=tuple(map(change, campaign.moves)))


def scaled(factor: float) -> Change:
    """All pixels times a factor: pictures of another size."""

    def change(_: int, spot: Spot, __: np.random.Generator) -> Spot:
        values = {name: getattr(spot, name) for name in PIXELS}
        return replace(spot, **{name: None if value is None else factor * value for name, value in values.items()})

    return of_spots(change)


def as_corrected(correction: Correction) -> Change:
    """Left and right pictures exchanged; or pixels as MATLAB counts them, which only spots at the very edge show."""
    return lambda campaign, _: replace(campaign, spots=corrected(None, campaign.spots, correction).spots)


def relative(campaign: Campaign, _: np.random.Generator) -> Campaign:
    """Counters hold the steps of each move."""
    steps = [campaign.moves[0]]
    for a, b in pairwise(campaign.moves):
        by = {"pan_steps": b.pan_steps - a.pan_steps, "tilt_steps": b.tilt_steps - a.tilt_steps}
        steps.append(replace(b, **by) if a.segment == b.segment else b)
    return replace(campaign, moves=tuple(steps))


def turned(axis: str) -> Change:
    """One axis counts the other way."""
    name = f"{axis}_steps"
    return of_moves(lambda move: replace(move, **{name: -getattr(move, name)}))


def renamed(share: float) -> Change:
    """Some spots called after another sheet."""

    def change(campaign: Campaign, rng: np.random.Generator) -> Campaign:
        names = sorted({spot.target for spot in campaign.spots})

        def other(_: int, spot: Spot, rng: np.random.Generator) -> Spot:
            rest = [name for name in names if name != spot.target]
            return replace(spot, target=str(rng.choice(rest))) if rng.random() < share else spot

        return of_spots(other)(campaign, rng)

    return change


def mistyped(offset_px: float) -> Change:
    """One pixel of one spot off."""

    def change(campaign: Campaign, rng: np.random.Generator) -> Campaign:
        ok = [k for k, spot in enumerate(campaign.spots) if spot.status == "ok"]
        row, name, spots = int(rng.choice(ok)), str(rng.choice(PIXELS)), list(campaign.spots)
        spots[row] = replace(spots[row], **{name: getattr(spots[row], name) + offset_px * rng.choice([-1, 1])})
        return replace(campaign, spots=tuple(spots))

    return change


def one_missing(campaign: Campaign, _: np.random.Generator) -> Campaign:
    """From the middle on every spot assigned to the move after its own, as where the log lacks a row."""
    last, half = len(campaign.moves) - 1, len(campaign.moves) // 2
    spots = tuple(replace(s, move=min(s.move + (s.move >= half), last)) for s in campaign.spots)
    return replace(campaign, spots=spots)


def knocked(campaign: Campaign, rng: np.random.Generator) -> Campaign:
    """The right camera turned halfway, by a sixth of a degree about its line of sight to the left one."""
    half = len(campaign.spots) // 2

    def change(place: int, spot: Spot, _: np.random.Generator) -> Spot:
        return spot if place < half or spot.v_right_px is None else replace(spot, v_right_px=spot.v_right_px + 3)

    return of_spots(change)(campaign, rng)


def in_metres(campaign: Campaign, _: np.random.Generator) -> Campaign:
    """The mirror offset stated in metres."""
    name, priors = "mirror_offset_mm", campaign.rig.priors
    small = replace(priors[name], value=priors[name].value / 1000, u=priors[name].u / 1000)
    return replace(campaign, rig=replace(campaign.rig, priors={**priors, name: small}))


MISTAKES: dict[str, tuple[Change, str]] = {
    "none": (lambda campaign, _: campaign, ""),
    "relative counters": (relative, "steps of each move"),
    "tilt sign": (turned("tilt"), "up counts up"),
    "pan sign": (turned("pan"), "left counts up"),
    "pan and tilt exchanged": (
        of_moves(lambda m: replace(m, pan_steps=m.tilt_steps, tilt_steps=m.pan_steps)),
        "columns exchanged",
    ),
    "pictures of half the size": (scaled(0.5), "half the size"),
    "5 % of the sheet names wrong": (renamed(0.05), "sheet of another name"),
    "half of the sheet names wrong": (renamed(0.5), "sheet of another name"),
    "sheet names blank": (of_spots(lambda _, spot, __: replace(spot, target="")), "column target is empty"),
    "cameras swapped": (as_corrected(Correction(swapped=True)), "left and right swapped"),
    "centres in millimetres": (scaled(0.003), "centres in millimetres"),
    "pixels counted from 1": (as_corrected(Correction(pixels_from=-1)), "count from 1"),
    "one pixel 10 px off": (mistyped(10.0), "apart from all others"),
    "one pixel 100 px off": (mistyped(100.0), "apart from all others|triangulate outside"),
    "spots one move early": (
        of_spots(lambda _, spot, __: replace(spot, move=max(spot.move - 1, 0))),
        "the move after theirs|rows shifted by one",
    ),
    "a row of the log missing halfway": (one_missing, "the move before theirs|rows shifted by one"),
    "right camera knocked by 3 px halfway": (knocked, "was a camera knocked"),
    "mirror offset in metres": (in_metres, "in metres"),
}
"""What is done to a campaign, and the words by which `check` would name it."""


def good_campaigns(seeds: int) -> dict[str, Campaign]:
    """The shipped twins and simulated campaigns."""
    rig, campaigns = mounted_rig(), {name: twin_campaign(name) for name in TWINS}
    for plan in PLANS:
        for seed in range(seeds):
            run = simulate(rig, shipped_plan(plan), seed=1000 + seed, aperture=seed % 2 == 0)
            campaigns[f"{plan} {seed}"] = run.campaign
    return campaigns


UNLIKE: dict[str, dict[str, Prior]] = {
    "rolled and pitched cameras (sd 0.3, 0.2 rad)": {
        "extrinsics.rotation_rad.x": Prior(0.0, 0.3),
        "extrinsics.rotation_rad.y": Prior(0.0, 0.2),
    },
    "backlash 2 deg, gear errors 0.5 deg": {
        **dict.fromkeys(names_of("backlash_deg"), Prior(2.0, 0.0, "half-normal")),
        **dict.fromkeys(names_of("transmission_error_deg"), Prior(0.5, 0.0, "half-normal")),
    },
    "stops scatter by 0.4 deg": dict.fromkeys(names_of("stop_sd_deg"), Prior(0.4, 0.0, "log-normal")),
    "pixel noise eight times the stated": {"pixel_scale": Prior(8.0, 0.0, "log-normal")},
    "zeros drift by 0.5 deg in an hour": dict.fromkeys(
        names_of("drift_deg_per_root_hour"), Prior(0.5, 0.0, "half-normal")
    ),
}
"""Rigs far from the mounted one, none of them a mistake in a table."""
SHEETS = {
    "sheets 25 mm apart": {"d1": 200.0, "d2": 225.0, "d3": 250.0},
    "sheets to 3 m": {"d1": 400.0, "d2": 1500.0, "d3": 3000.0},
}


def poorly_calibrated(campaign: Campaign, rng: np.random.Generator) -> Campaign:
    """Cameras that are off by ten draws' worth of their stated covariance.

    A draw that no lens has (distortion that folds inside the picture) is a mistake of its own, and rightly named:
    it is drawn again.
    """
    while True:
        off = 10 * rng.multivariate_normal(np.zeros(24), campaign.stereo.parameter_covariance)
        stereo = campaign.stereo.with_vector(campaign.stereo.vector + off)
        if not pair_doubts(stereo):
            return replace(campaign, stereo=stereo)


FIRST_LOOKS, CUTS = 24, 12
"""Campaigns are cut at every look up to that one, from the first that `check` looks at, and at so many later ones."""
POORLY = "cameras off by ten times what is stated of them"


def _rigs() -> dict[str, Rig]:
    """Rigs by what they are like."""
    shipped = {f"{name} rig": read_rig(shipped_data() / "rigs" / name / "rig.toml") for name in ("mounted", "nominal")}
    mounted = shipped["mounted rig"]
    unlike = {name: replace(mounted, truth={**mounted.truth, **changed}) for name, changed in UNLIKE.items()}
    unlike |= {name: replace(mounted, sheets_mm=sheets) for name, sheets in SHEETS.items()}
    return {**shipped, **unlike, POORLY: mounted}


def _random_grid(rng: np.random.Generator) -> tuple[PlanStep, ...]:
    """A snake over a grid of a few counters at one sheet or more."""
    targets = sorted(rng.choice(["d1", "d2", "d3"], int(rng.integers(1, 4)), replace=False).tolist())
    pan = np.linspace(-60, int(rng.integers(40, 260)), int(rng.integers(3, 8))).astype(int)
    tilt = np.linspace(-90, int(rng.integers(-30, 100)), int(rng.integers(2, 6))).astype(int)
    return grid_protocol(targets=targets, pan_steps=pan.tolist(), tilt_steps=tilt.tolist())


def _random_four_points(rng: np.random.Generator) -> tuple[PlanStep, ...]:
    """Four-point experiments of a few lengths."""
    steps = rng.integers(20, 220, int(rng.integers(1, 4))).tolist()
    return four_point_protocol(int(rng.integers(3, 20)), steps=steps, targets=("d1", str(rng.choice(["d2", "d3"]))))


def sound_campaign(number: int, rigs: Mapping[str, Rig]) -> tuple[str, Campaign]:
    """A campaign without a mistake, a new one for every number, with the name of its rig, which take turns."""
    rng = np.random.default_rng([7, number])
    name = list(rigs)[number % len(rigs)]
    planned = sorted((Path(__file__).parent / "plans").glob("*.csv"))
    kinds = [*PROTOCOLS, *planned, _random_grid, _random_four_points]
    kind = kinds[int(rng.integers(len(kinds)))]
    if isinstance(kind, Path):
        plan = read_plan(kind)
    else:
        plan = PROTOCOLS[kind]() if isinstance(kind, str) else kind(rng)
    odd = {"aperture": bool(rng.integers(2)), "sides_recorded": bool(rng.integers(2)), "home_approach": None}
    campaign = simulate(rigs[name], plan, seed=1000 + number, **odd).campaign
    return name, poorly_calibrated(campaign, rng) if name == POORLY else campaign


def cut(campaign: Campaign, looks: int) -> Campaign:
    """What there is of a campaign after so many looks."""
    spots = campaign.spots[:looks]
    return replace(campaign, spots=spots, moves=campaign.moves[: spots[-1].move + 1])


def cuts_of(campaign: Campaign, rng: np.random.Generator) -> list[int]:
    """Numbers of looks after which a campaign is checked, the last: all."""
    count = len(campaign.spots)
    later = rng.integers(FIRST_LOOKS, max(count, FIRST_LOOKS + 1), CUTS).tolist()
    return sorted({k for k in (*range(SPOTS_MIN, FIRST_LOOKS), *later, count) if k <= count})


def sound_table(count: int) -> list[str]:
    """How often sound campaigns are accused, whole and cut, by rig."""
    rigs = _rigs()
    counts = {name: Counter[str]() for name in rigs}
    kinds: Counter[str] = Counter()
    for number in range(count):
        name, campaign = sound_campaign(number, rigs)
        findings_of = {k: implausible(cut(campaign, k)) for k in cuts_of(campaign, np.random.default_rng([8, number]))}
        all_of_it = [finding for findings in findings_of.values() for finding in findings]
        kinds.update(f"{f.code}, {'certain' if f.certain else 'doubt'}, {name}" for f in all_of_it)
        counts[name].update(
            campaigns=1,
            asked=len(findings_of),
            accused=any(f.certain for f in all_of_it),
            doubted=bool(all_of_it),
            doubts=sum(map(bool, findings_of.values())),
        )
    title = f"{count} sound campaigns, each whole and cut at every look up to {FIRST_LOOKS} and {CUTS} later ones:"
    columns = ("campaigns", "asked", "accused", "doubted", "doubts")
    titles = "rig | campaigns | asked | campaigns accused (certain) | campaigns doubted | cuts doubted"
    rows = {**counts, "all": sum(counts.values(), Counter())}
    lines = [title, "", heading(titles), *(line(name, *(row[c] for c in columns)) for name, row in rows.items())]
    return lines + [""] * bool(kinds) + [f"said of sound ones, {n} times: {kind}" for kind, n in kinds.most_common()]


def table(seeds: int, sound: int) -> str:
    """How many campaigns with each mistake are accused, and how many by its name."""
    good = good_campaigns(seeds)
    lines = [f"{len(good)} campaigns: 2 shipped twins, {seeds} simulated ones of each plan ({', '.join(PLANS)})", ""]
    lines.append(heading("mistake | warned of | by its name | certain"))
    for name, (change, words) in MISTAKES.items():
        answers = [implausible(change(c, np.random.default_rng(k))) for k, c in enumerate(good.values())]
        named = sum(bool(words and re.search(words, "\n".join(f.sentence for f in findings))) for findings in answers)
        certain = sum(any(f.certain for f in findings) for findings in answers)
        lines.append(line(name, sum(map(bool, answers)), named if words else "-", certain))
    return "\n".join([*lines, "", *sound_table(sound)]).rstrip() + "\n"


def main() -> None:
    """Write the table beside this file."""
    cli = parser(__doc__)
    cli.add_argument("--seeds", type=int, default=60)
    cli.add_argument("--sound", type=int, default=500)
    wish = cli.parse_args()
    text = table(wish.seeds, wish.sound)
    print(text)
    heading = "# Mistakes that `check` sees\n\n`python -m experiments.robustness.mistakes`\n\n"
    write_atomically(Path(__file__).with_suffix(".md"), (heading + text).encode())


if __name__ == "__main__":
    main()
