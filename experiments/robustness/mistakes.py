"""Which mistakes in a campaign's tables `check` sees, and how often it accuses a sound campaign.

    python -m experiments.robustness.mistakes [--seeds 60] [--sound 500]

Mistakes are made in every one of the shipped twins and of simulations of the mounted rig after its four plans. Sound
campaigns are drawn by the twin from all protocols, from what `tvsbayes plan` proposes and from random grids and steps,
on rigs near and far from the shipped ones, and cut at many looks. A finding is any of
`estimators.plausibility.implausible`: warnings of what a plan cannot tell are none.
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
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.instrument.protocols import PROTOCOLS, four_point_protocol, grid_protocol
from tvsbayes.instrument.rig import Rig, read_rig
from tvsbayes.instrument.stereo_pair import pair_doubts
from tvsbayes.twin.simulated_campaign import simulate

PLANS = ("paper", "paper_twin", "mixed", "grid")
Change = Callable[[Campaign, np.random.Generator], Campaign]


def of_spots(change: Callable[[int, Spot, Campaign, np.random.Generator], Mapping[str, object]]) -> Change:
    """New fields of every spot, by its place, the campaign and chance."""
    return lambda campaign, rng: replace(
        campaign, spots=tuple(replace(s, **change(k, s, campaign, rng)) for k, s in enumerate(campaign.spots))
    )


def of_moves(change: Callable[[Move], Mapping[str, object]]) -> Change:
    """New fields of every move."""
    return lambda campaign, _: replace(campaign, moves=tuple(replace(move, **change(move)) for move in campaign.moves))


def scaled(factor: float) -> Change:
    """All pixels times a factor: pictures of another size."""
    return of_spots(lambda _, s, *__: {n: factor * v for n in PIXELS if (v := getattr(s, n)) is not None})


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
    return of_moves(lambda move: {f"{axis}_steps": -getattr(move, f"{axis}_steps")})


def renamed(share: float) -> Change:
    """Some spots called after another sheet."""

    def other(_: int, spot: Spot, campaign: Campaign, rng: np.random.Generator) -> Mapping[str, object]:
        rest = sorted({each.target for each in campaign.spots} - {spot.target})
        return {"target": str(rng.choice(rest))} if rng.random() < share else {}

    return of_spots(other)


def mistyped(offset_px: float) -> Change:
    """One pixel of one spot off."""

    def change(campaign: Campaign, rng: np.random.Generator) -> Campaign:
        row = int(rng.choice([k for k, spot in enumerate(campaign.spots) if spot.status == "ok"]))
        name, off_px = str(rng.choice(PIXELS)), offset_px * rng.choice([-1, 1])
        only = of_spots(lambda k, spot, *_: {name: getattr(spot, name) + off_px} if k == row else {})
        return only(campaign, rng)

    return change


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
        of_moves(lambda m: {"pan_steps": m.tilt_steps, "tilt_steps": m.pan_steps}),
        "columns exchanged",
    ),
    "pictures of half the size": (scaled(0.5), "half the size"),
    "5 % of the sheet names wrong": (renamed(0.05), "sheet of another name"),
    "half of the sheet names wrong": (renamed(0.5), "sheet of another name"),
    "sheet names blank": (of_spots(lambda *_: {"target": ""}), "column target is empty"),
    "cameras swapped": (as_corrected(Correction(swapped=True)), "left and right swapped"),
    "centres in millimetres": (scaled(0.003), "centres in millimetres"),
    "pixels counted from 1": (as_corrected(Correction(pixels_from=-1)), "count from 1"),
    "one pixel 10 px off": (mistyped(10.0), "apart from all others"),
    "one pixel 100 px off": (mistyped(100.0), "apart from all others|triangulate outside"),
    "spots one move early": (
        of_spots(lambda _, s, *__: {"move": max(s.move - 1, 0)}),
        "the move after theirs|rows shifted by one",
    ),
    # From the middle on every spot has the move after its own.
    "a row of the log missing halfway": (
        of_spots(lambda _, s, c, __: {"move": min(s.move + (s.move >= len(c.moves) // 2), len(c.moves) - 1)}),
        "the move before theirs|rows shifted by one",
    ),
    # Turned by a sixth of a degree about the line of sight to the left one.
    "right camera knocked by 3 px halfway": (
        of_spots(lambda k, s, c, _: {"v_right_px": s.v_right_px and s.v_right_px + 3 * (k >= len(c.spots) // 2)}),
        "was a camera knocked",
    ),
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


FIRST_LOOKS, CUTS = 24, 12
"""Campaigns are cut at every look up to that one, from the first that `check` looks at, and at so many later ones."""
POORLY = "cameras off by ten times what is stated of them"


def sound_rigs() -> dict[str, Rig]:
    """Rigs by what they are like."""
    rigs = {f"{name} rig": read_rig(shipped_data() / "rigs" / name / "rig.toml") for name in ("mounted", "nominal")}
    mounted = rigs["mounted rig"]
    rigs |= {name: replace(mounted, truth={**mounted.truth, **changed}) for name, changed in UNLIKE.items()}
    return rigs | {name: replace(mounted, sheets_mm=sheets) for name, sheets in SHEETS.items()} | {POORLY: mounted}


def drawn_plan(rng: np.random.Generator) -> tuple[PlanStep, ...]:
    """A protocol, what `plan` proposes for the mounted rig, a snake over a few counters, or four-point experiments."""
    kind = str(rng.choice([*PROTOCOLS, "planned", "snake", "four points"]))
    if kind == "snake":
        targets = sorted(rng.choice(["d1", "d2", "d3"], int(rng.integers(1, 4)), replace=False).tolist())
        pan = np.linspace(-60, int(rng.integers(40, 260)), int(rng.integers(3, 8))).astype(int)
        tilt = np.linspace(-90, int(rng.integers(-30, 100)), int(rng.integers(2, 6))).astype(int)
        return grid_protocol(targets=targets, pan_steps=pan.tolist(), tilt_steps=tilt.tolist())
    if kind == "four points":
        steps = rng.integers(20, 220, int(rng.integers(1, 4))).tolist()
        return four_point_protocol(int(rng.integers(3, 20)), steps=steps, targets=("d1", str(rng.choice(["d2", "d3"]))))
    return shipped_plan(kind) if kind == "planned" else PROTOCOLS[kind]()


def sound_campaign(number: int, rigs: Mapping[str, Rig]) -> tuple[str, Campaign]:
    """A campaign without a mistake, a new one for every number, with the name of its rig, which take turns."""
    rng = np.random.default_rng([7, number])
    name, plan = list(rigs)[number % len(rigs)], drawn_plan(rng)
    odd = {"aperture": bool(rng.integers(2)), "sides_recorded": bool(rng.integers(2)), "home_approach": None}
    campaign = simulate(rigs[name], plan, seed=1000 + number, **odd).campaign
    # A draw that no lens has (distortion that folds inside the picture) is a mistake of its own, and rightly named.
    while name == POORLY:
        off = 10 * rng.multivariate_normal(np.zeros(24), campaign.stereo.parameter_covariance)
        stereo = campaign.stereo.with_vector(campaign.stereo.vector + off)
        if not pair_doubts(stereo):
            return name, replace(campaign, stereo=stereo)
    return name, campaign


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
    rigs = sound_rigs()
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
