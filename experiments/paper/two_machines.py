"""Two machines that read Table 1: equal gears with lost motion seen at an azimuth, and four literal ratios.

A drawing of optics, cameras and mounting is solved so that the classic estimator reads the Table's means without noise;
the plans are the paper's, each experiment from a homing at its start. deg/step, deg, mm as named.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np

from experiments.common.rigs import PAPER_NOISE, numbered, paper_values
from tvsbayes.estimators.four_point import four_point_ratios, select_experiments
from tvsbayes.instrument.axes import AXES, DIRECTION_SIGNS, DIRECTIONS
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.instrument.rig import Rig
from tvsbayes.instrument.stereo_pair import Stereo, rotation_matrix
from tvsbayes.twin.physics import mirror_chain, project
from tvsbayes.twin.true_rig import Truth, draw_truth, with_derived

Kind = Literal["lost motion", "literal"]
RIGS: tuple[Kind, Kind] = ("lost motion", "literal")
HOME_SIDES = "right", "up"
NOISE = PAPER_NOISE
SHEETS_MM = 175.0, 275.0
STEPS, STARTS = 200, {"left": (0, 0), "right": (200, 0), "up": (100, -100), "down": (100, 100)}
"""Counters of pan and tilt at which the experiments of a direction start."""


def four_point_plan(repeats: int = 24) -> tuple[PlanStep, ...]:
    """The paper's experiments, each from a homing at its start."""
    orders: list[tuple] = []
    for direction, (name, sign) in DIRECTION_SIGNS.items():
        start = STARTS[direction]
        end = list(start)
        end[AXES.index(name)] += sign * STEPS
        for repeat in range(repeats):
            number = DIRECTIONS.index(direction) * repeats + repeat
            looks = [("look", None, None, None, number, point) for point in (1, 2, 3, 4)]
            near, far = (("place", None, None, sheet) for sheet in ("d1", "d2"))
            orders += [("home", *start), near, looks[0], far, looks[1], ("move", *end), looks[2], near, looks[3]]
    return numbered(orders)


def classic_without_noise(parameters: Mapping[str, float], stated: Stereo, true_stereo: Stereo) -> dict[str, float]:
    """What the classic chain reads of the four moves, deg/step, by the twin's optics on nominal sheets."""
    rotation = rotation_matrix(np.array([parameters[f"extrinsics.rotation_rad.{a}"] for a in "xyz"]))
    shift = np.array([parameters[f"extrinsics.translation_mm.{a}"] for a in "xyz"])
    points = []
    play = {axis: parameters[f"backlash_deg.{axis}"] / 2 for axis in AXES}
    for direction, (axis, sign) in DIRECTION_SIGNS.items():
        # Homings end on the right (+b/2) and on the upper side (-b/2).
        rest = [parameters[f"degrees_per_step.{a}"] * n for a, n in zip(AXES, STARTS[direction], strict=True)]
        rest = [rest[0] + play["pan"], rest[1] - play["tilt"] + parameters["tilt_zero_deg"]]
        turned = parameters[f"degrees_per_step.{direction}"] * STEPS
        # The play is taken up first where the move goes against the homing's last one.
        lost = 2 * play[axis] if direction in ("left", "down") else 0.0
        after = list(rest)
        after[AXES.index(axis)] += sign * (turned - lost)
        for pose, depth in ((rest, 0), (rest, 1), (after, 1), (after, 0)):
            origin, beam = (part @ rotation.T for part in mirror_chain(*np.radians(pose), parameters))
            origin = origin + shift
            points.append(origin + (SHEETS_MM[depth] - origin[0]) / beam[0] * beam)
    pixels = project(np.array(points), true_stereo, parameters["focal_scale"])
    axes, signs = map(np.array, zip(*DIRECTION_SIGNS.values(), strict=True))
    ratios = four_point_ratios(pixels.reshape(4, 4, 4), STEPS * signs, axes, stated)
    return dict(zip(DIRECTIONS, map(float, ratios), strict=True))


def solved(kind: Kind, rig: Rig, seed: int) -> Truth:
    """True rig of a kind from drawing `seed`, that reads Table 1's means.

    Raises:
        RuntimeError: the drawing cannot be made to read them.
    """
    # Play against literal ratios is the question: gears that repeat errors are another.
    drawn = draw_truth(rig, np.random.default_rng([seed, 2])).with_gears()
    table = {name: values[1] for name, values in paper_values().items()}
    p = {**drawn.parameters, **NOISE}
    ratio = {"pan": 0.062, "tilt": 0.062} if kind == "lost motion" else {"pan": 0.0607, "tilt": 0.0684}
    contrast, backlash = {"pan": 0.0, "tilt": 0.0}, {"pan": 0.0, "tilt": 0.0}
    if kind == "lost motion":
        p["extrinsics.rotation_rad.z"] = 0.345
        backlash = {"pan": 0.5, "tilt": 0.2}
    else:
        # The tilt experiments' beams go along the depth, between the cameras.
        p["extrinsics.rotation_rad.z"] += -0.32 - np.radians(100 * ratio["pan"])
        p["extrinsics.translation_mm.y"] += 100.0 - 42.5
    for _ in range(40):
        for axis in AXES:
            p[f"degrees_per_step.{axis}"] = ratio[axis]
            p[f"ratio_contrast_deg_per_step.{axis}"] = contrast[axis]
            p[f"backlash_deg.{axis}"] = backlash[axis]
        p = with_derived(p)
        read = classic_without_noise(p, rig.stereo, drawn.stereo)
        if kind == "lost motion":
            factor = table["right"] / read["right"]
            ratio = dict.fromkeys(ratio, ratio["pan"] * factor)
            grow = np.log(table["up"] / table["right"] / (read["up"] / read["right"]))
            # Projected tilt goes as 1/cos(azimuth): its logarithm as tan(azimuth) per rad of yaw.
            p["extrinsics.rotation_rad.z"] += grow / np.tan(p["extrinsics.rotation_rad.z"] + 0.108)
            backlash["pan"] += STEPS * (table["right"] - table["left"] - read["right"] + read["left"])
            backlash["tilt"] += STEPS * (table["up"] - table["down"] - read["up"] + read["down"]) / 1.1
        else:
            for axis, plus, minus in (("pan", "left", "right"), ("tilt", "up", "down")):
                ratio[axis] += (table[plus] + table[minus] - read[plus] - read[minus]) / 2
                contrast[axis] += table[plus] - table[minus] - read[plus] + read[minus]
    if max(abs(read[d] / table[d] - 1) for d in DIRECTIONS) > 1e-6 or min(backlash.values()) < 0:
        raise RuntimeError(f"drawing {seed} cannot be made to read Table 1 by {kind}: {read}")
    return replace(drawn, parameters=p)


def classic_readings(campaign: Campaign) -> dict[str, np.ndarray]:
    """Ratios by direction, without uncertainties."""
    chosen = select_experiments(campaign)
    ratios = four_point_ratios(chosen.pixels, chosen.steps, chosen.axis, campaign.stereo)
    return {d: ratios[chosen.direction == d] for d in DIRECTIONS}
