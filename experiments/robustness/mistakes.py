"""Which mistakes in a campaign's tables `check` sees, and how often it accuses a good campaign.

    python -m experiments.robustness.mistakes [--seeds 60]

Good campaigns are the shipped twins and simulations of the mounted rig after its four plans; each mistake is made in
every one of them. An alarm is any sentence of `estimators.plausibility.implausible`: warnings of what a plan cannot
tell are none.
"""

from __future__ import annotations

import argparse
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from tvsbayes.estimators.plausibility import implausible
from tvsbayes.files.disk import shipped_data, write_atomically
from tvsbayes.instrument.campaign import Campaign, Spot, read_campaign
from tvsbayes.instrument.parameters import Prior, names_of
from tvsbayes.instrument.plan import read_plan
from tvsbayes.instrument.protocols import grid_protocol
from tvsbayes.instrument.rig import read_rig
from tvsbayes.twin.simulated_campaign import simulate

PLANS = ("paper", "paper_twin", "mixed", "grid")
PIXELS = ("u_left_px", "v_left_px", "u_right_px", "v_right_px")
Change = Callable[[Campaign, np.random.Generator], Campaign]


def scaled(campaign: Campaign, factor: float) -> Campaign:
    """All pixels times a factor: pictures of another size."""

    def change(spot: Spot) -> Spot:
        values = {name: getattr(spot, name) for name in PIXELS}
        return replace(spot, **{name: None if value is None else factor * value for name, value in values.items()})

    return replace(campaign, spots=tuple(map(change, campaign.spots)))


def relative(campaign: Campaign, _: np.random.Generator) -> Campaign:
    """Counters hold the steps of each move."""
    moves = campaign.moves
    steps = [moves[0]] + [
        replace(b, pan_steps=b.pan_steps - a.pan_steps, tilt_steps=b.tilt_steps - a.tilt_steps)
        if a.segment == b.segment
        else b
        for a, b in pairwise(moves)
    ]
    return replace(campaign, moves=tuple(steps))


def turned(axis: str) -> Change:
    """One axis counts the other way."""

    def change(campaign: Campaign, _: np.random.Generator) -> Campaign:
        name = f"{axis}_steps"
        return replace(campaign, moves=tuple(replace(m, **{name: -getattr(m, name)}) for m in campaign.moves))

    return change


def exchanged(campaign: Campaign, _: np.random.Generator) -> Campaign:
    """Pan and tilt counters in each other's column."""
    moves = tuple(replace(m, pan_steps=m.tilt_steps, tilt_steps=m.pan_steps) for m in campaign.moves)
    return replace(campaign, moves=moves)


def renamed(share: float) -> Change:
    """Some spots called after another sheet."""

    def change(campaign: Campaign, rng: np.random.Generator) -> Campaign:
        names = sorted({spot.target for spot in campaign.spots})

        def other(spot: Spot) -> Spot:
            rest = [name for name in names if name != spot.target]
            return replace(spot, target=str(rng.choice(rest))) if rng.random() < share else spot

        return replace(campaign, spots=tuple(map(other, campaign.spots)))

    return change


def unnamed(campaign: Campaign, _: np.random.Generator) -> Campaign:
    """No sheet has a name."""
    return replace(campaign, spots=tuple(replace(spot, target="") for spot in campaign.spots))


def mistyped(offset_px: float) -> Change:
    """One pixel of one spot off."""

    def change(campaign: Campaign, rng: np.random.Generator) -> Campaign:
        ok = [k for k, spot in enumerate(campaign.spots) if spot.status == "ok"]
        row, name = int(rng.choice(ok)), str(rng.choice(PIXELS))
        spots = list(campaign.spots)
        spots[row] = replace(spots[row], **{name: getattr(spots[row], name) + offset_px * rng.choice([-1, 1])})
        return replace(campaign, spots=tuple(spots))

    return change


def shifted(campaign: Campaign, _: np.random.Generator) -> Campaign:
    """Every spot assigned to the move before."""
    spots = tuple(replace(spot, move=max(spot.move - 1, 0)) for spot in campaign.spots)
    return replace(campaign, spots=spots)


def one_missing(campaign: Campaign, _: np.random.Generator) -> Campaign:
    """From the middle on every spot assigned to the move after its own, as where the log lacks a row."""
    last, half = len(campaign.moves) - 1, len(campaign.moves) // 2
    spots = tuple(replace(s, move=min(s.move + (s.move >= half), last)) for s in campaign.spots)
    return replace(campaign, spots=spots)


def knocked(campaign: Campaign, _: np.random.Generator) -> Campaign:
    """The right camera turned halfway, by a sixth of a degree about its line of sight to the left one."""
    half = len(campaign.spots) // 2

    def change(place: int, spot: Spot) -> Spot:
        return spot if place < half or spot.v_right_px is None else replace(spot, v_right_px=spot.v_right_px + 3)

    return replace(campaign, spots=tuple(change(k, spot) for k, spot in enumerate(campaign.spots)))


def in_metres(campaign: Campaign, _: np.random.Generator) -> Campaign:
    """The mirror offset stated in metres."""
    priors = dict(campaign.rig.priors)
    name = "mirror_offset_mm"
    priors[name] = replace(priors[name], value=priors[name].value / 1000, u=priors[name].u / 1000)
    return replace(campaign, rig=replace(campaign.rig, priors=priors))


MISTAKES: dict[str, tuple[Change, str]] = {
    "none": (lambda campaign, _: campaign, ""),
    "relative counters": (relative, "steps of each move"),
    "tilt sign": (turned("tilt"), "up counts up"),
    "pan sign": (turned("pan"), "left counts up"),
    "pan and tilt exchanged": (exchanged, "columns exchanged"),
    "pictures of half the size": (lambda campaign, _: scaled(campaign, 0.5), "half the size"),
    "5 % of the sheet names wrong": (renamed(0.05), "sheet of another name"),
    "half of the sheet names wrong": (renamed(0.5), "sheet of another name"),
    "sheet names blank": (unnamed, "column target is empty"),
    "one pixel 10 px off": (mistyped(10.0), "apart from all others"),
    "one pixel 100 px off": (mistyped(100.0), "apart from all others|triangulate outside"),
    "spots one move early": (shifted, "the move after theirs|their rows are one apart"),
    "a row of the log missing halfway": (one_missing, "the move before theirs|their rows are one apart"),
    "right camera knocked by 3 px halfway": (knocked, "was a camera knocked"),
    "mirror offset in metres": (in_metres, "in metres"),
}
"""What is done to a campaign, and the words by which `check` would name it."""


def good_campaigns(seeds: int) -> dict[str, Campaign]:
    """The shipped twins and simulated campaigns."""
    data = shipped_data()
    rig = read_rig(data / "rigs" / "mounted" / "rig.toml")
    found = {name: read_campaign(data / "twins" / name) for name in ("paper_twin", "grid_twin")}
    for plan in PLANS:
        steps = read_plan(data / "rigs" / "mounted" / f"{plan}.csv")
        for seed in range(seeds):
            found[f"{plan} {seed}"] = simulate(rig, steps, seed=1000 + seed, aperture=seed % 2 == 0).campaign
    return found


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
    """Cameras that are off by ten draws' worth of their stated covariance."""
    off = 10 * rng.multivariate_normal(np.zeros(24), campaign.stereo.parameter_covariance)
    return replace(campaign, stereo=campaign.stereo.with_vector(campaign.stereo.vector + off))


def unlike_table(seeds: int) -> list[str]:
    """How often good campaigns of rigs unlike the mounted one are accused."""
    rig = read_rig(shipped_data() / "rigs" / "mounted" / "rig.toml")
    plans = [read_plan(shipped_data() / "rigs" / "mounted" / f"{plan}.csv") for plan in ("paper", "grid")]
    plans.append(grid_protocol(targets=("d1", "d2"), pan_steps=(0, 100, 200), tilt_steps=(-60, 60)))
    rigs = {name: replace(rig, truth={**rig.truth, **changed}) for name, changed in UNLIKE.items()}
    rigs |= {name: replace(rig, sheets_mm=sheets) for name, sheets in SHEETS.items()}
    lines = ["| rig unlike the mounted one | campaigns | accused |", "|---|---|---|"]
    for name, other in rigs.items():
        said = [implausible(simulate(other, plan, seed=300 + k).campaign) for plan in plans for k in range(seeds)]
        lines.append(f"| {name} | {len(said)} | {sum(map(bool, said))} |")
    said = [
        implausible(poorly_calibrated(simulate(rig, plan, seed=300 + k).campaign, np.random.default_rng(k)))
        for plan in plans
        for k in range(seeds)
    ]
    lines.append(f"| cameras off by ten times what is stated of them | {len(said)} | {sum(map(bool, said))} |")
    return lines


def table(seeds: int) -> str:
    """How many campaigns with each mistake are accused, and how many by its name."""
    good = good_campaigns(seeds)
    lines = [f"{len(good)} campaigns: 2 shipped twins, {seeds} simulated ones of each plan ({', '.join(PLANS)})", ""]
    lines += ["| mistake | warned of | by its name |", "|---|---|---|"]
    kinds: Counter[str] = Counter()
    for name, (change, words) in MISTAKES.items():
        said = [implausible(change(c, np.random.default_rng(k))) for k, c in enumerate(good.values())]
        if name == "none":
            kinds.update(re.sub(r"[0-9.]+", "#", text)[:80] for texts in said for text in texts)
        any_word, own = sum(map(bool, said)), sum(bool(words and re.search(words, "\n".join(s))) for s in said)
        lines.append(f"| {name} | {any_word} | {own if words else '-'} |")
    lines += ["", *unlike_table(max(seeds // 3, 1))]
    lines += ["", *(f"accused though good, {count}: {kind}" for kind, count in kinds.items())]
    return "\n".join(lines).rstrip() + "\n"


def main() -> None:
    """Write the table beside this file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=60)
    text = table(parser.parse_args().seeds)
    print(text)
    heading = "# Mistakes that `check` sees\n\n`python -m experiments.robustness.mistakes`\n\n"
    write_atomically(Path(__file__).with_suffix(".md"), (heading + text).encode())


if __name__ == "__main__":
    main()
