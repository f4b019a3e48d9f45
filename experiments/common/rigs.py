"""The shipped rig, its plans and twins, and what studies do to simulated campaigns: small plans, other pixels."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import Campaign, Spot, read_campaign
from tvsbayes.instrument.parameters import CREEP_NAMES, LOOK_SCATTER_NAMES
from tvsbayes.instrument.plan import PlanStep, read_plan
from tvsbayes.instrument.rig import Rig, read_rig
from tvsbayes.twin.simulated_campaign import SimulatedCampaign
from tvsbayes.twin.true_rig import Truth, draw_truth, read_truth

TWINS = ("paper_twin", "grid_twin")
PIXELS = ("u_left_px", "v_left_px", "u_right_px", "v_right_px")
PAPER_NOISE = {
    **dict(zip((f"stop_sd_deg.{d}" for d in DIRECTIONS), (0.155, 0.022, 0.036, 0.008), strict=True)),
    "pixel_scale": 1.0,
}
"""Of the paper twin, which give the Table's sds."""
PAN_SWEEP = (0, 70, 140, 200, 140, 70)
TILT_SWEEP = (-60, -20, 20, 60, 20, -20)
TILT_STEPS = (-60, -36, -12, 12, 36, 60, 36, 12, -12, -36)
CROSSING = 100, -20
"""Tilt while panning is the second number, pan while tilting the first."""


def mounted_rig() -> Rig:
    """The shipped rig whose extrinsics are known to 0.03 rad and 5 mm."""
    return read_rig(shipped_data() / "rigs" / "mounted" / "rig.toml")


def drawn_rig() -> Rig:
    """The same, of whose true rigs the looks scatter as well: drawn from every prior that their fits have."""
    rig = mounted_rig()
    return replace(rig, truth={**rig.truth, **{name: rig.table.priors[name] for name in LOOK_SCATTER_NAMES}})


def shipped_plan(protocol: str) -> tuple[PlanStep, ...]:
    """A plan of the mounted rig."""
    return tuple(read_plan(shipped_data() / "rigs" / "mounted" / f"{protocol}.csv"))


def twin_campaign(name: str) -> Campaign:
    """A shipped twin, one of `TWINS`."""
    return read_campaign(shipped_data() / "twins" / name)


def shipped_twin(name: str) -> SimulatedCampaign:
    """A shipped twin with its truth, without its light."""
    campaign = twin_campaign(name)
    truth = read_truth(shipped_data() / "twins" / name / "truth.json", campaign.stereo)
    return SimulatedCampaign(campaign, truth, None)


def paper_values() -> dict[str, tuple[int, float, float]]:
    """Number, mean and sd of the paper's Table 1 by direction, deg/step."""
    with (shipped_data() / "reference" / "table1.csv").open() as file:
        keys = "direction", "experiments", "mean_deg_per_step", "sd_deg_per_step"
        rows = [[row[key] for key in keys] for row in csv.DictReader(file)]
    return {direction: (int(count), float(mean), float(sd)) for direction, count, mean, sd in rows}


def numbered(orders: Sequence[tuple]) -> tuple[PlanStep, ...]:
    """A plan from the arguments of its steps."""
    return tuple(PlanStep(number, *order) for number, order in enumerate(orders))


def swept(sheets: Sequence[str], poses: Sequence[tuple[int, int]]) -> tuple[PlanStep, ...]:
    """A look at every pose, on each sheet, after one homing."""
    orders: list[tuple] = [("home", 0, 0)]
    for sheet in sheets:
        orders.append(("place", None, None, sheet))
        for pose in poses:
            orders += [("move", *pose), ("look",)]
    return numbered(orders)


def small_plan(sheets: Sequence[str]) -> tuple[PlanStep, ...]:
    """Both axes swept there and back twice, 24 spots and moves per sheet: for two, twelve stops in every direction."""
    return swept(sheets, [(p, CROSSING[1]) for p in PAN_SWEEP * 2] + [(CROSSING[0], t) for t in TILT_SWEEP * 2])


def dense_plan(sheets: Sequence[str]) -> tuple[PlanStep, ...]:
    """30 spots per sheet, both axes driven between any two: every spot has new stops of both axes; 60 spots for two."""
    return swept(sheets, list(zip(PAN_SWEEP * 5, TILT_STEPS * 3, strict=True)))


def creeping_rig() -> Rig:
    """The drawn rig, whose zeros creep too."""
    rig = drawn_rig()
    return replace(rig, truth={name: prior for name, prior in rig.truth.items() if name not in CREEP_NAMES})


def drawn_truth(rig: Rig, seed: int) -> Truth:
    """The true rig that `simulate` draws itself from a seed."""
    return draw_truth(rig, np.random.default_rng(np.random.SeedSequence(seed).spawn(6)[0]))


def unseen(campaign: Campaign) -> int:
    """Looks without a spot in both images."""
    return sum(spot.status != "ok" for spot in campaign.spots)


def pixels_of(campaign: Campaign, prefix: str = "") -> np.ndarray:
    """Centres (spots, 4) in the order of `PIXELS`, px; with the prefix s their sds; NaN where there is none."""
    rows = [[getattr(spot, prefix + name) for name in PIXELS] for spot in campaign.spots]
    return np.array([[np.nan if value is None else value for value in row] for row in rows])


def with_pixels(spot: Spot, pixels_px: np.ndarray) -> Spot:
    """The spot with other centres, in the order of `PIXELS`."""
    return replace(spot, **dict(zip(PIXELS, map(float, pixels_px), strict=True)))
