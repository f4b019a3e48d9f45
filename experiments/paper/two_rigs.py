"""Two rigs, one Table 1: equal gears with lost motion seen at an azimuth, and four literal ratios: are they separable?

    python -m experiments.paper.two_rigs run --n 8 --cores 0        # 10 minutes, resumable
    python -m experiments.paper.two_rigs table > experiments/paper/two_rigs.md

Seed s draws optics, cameras and mounting from the priors of `data/rigs/mounted`; then two machines are put into that
drawing, each solved so that the classic estimator reads Table 1's means without noise:

* "lost motion": one gear ratio for both axes, contrasts 0, a backlash per axis; the yaw makes the tilt look larger;
* "literal": four ratios, no play; turned so that the tilt experiments happen at azimuth 0, where a tilt is read as it
  is. Such gears drift away (no toothed gear can be so over long travel): homed before every experiment.

Both run the paper's plan as published, |N| = 200, 24 in each direction, every experiment from a homing at its start
counters, ended on the right and on the upper side, and the sides NOT recorded; with the stop errors of the paper twin
(which give the Table's sds) and 0.05 px. The nominal rig is declared, without knowledge of the mounting, with
N(0, 0.005 deg/step) for the contrasts: the default 2e-4 excludes literal ratios beforehand. Three models are fitted:
gears with play and one ratio per axis; ratios per direction without play; both. log10 of the Bayes factor = difference
of the Laplace evidences of the first two. It is called separated beyond 100 to 1, called the other rig with more than
20 to 1 against the truth. Effective ratios are those of the model with both, by Laplace with all homing hypotheses
weighed.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
from scipy import stats

from experiments.common.command_line import study
from experiments.common.page import heading, line
from experiments.common.rigs import PAPER_NOISE, mounted_rig, numbered, paper_values, unseen
from tvsbayes.assessment.summary import summarise
from tvsbayes.estimators.four_point import four_point_ratios, select_experiments
from tvsbayes.estimators.joint_fit import JointFit, fit
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.axes import AXES, DIRECTION_SIGNS, DIRECTIONS
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.model_choice import ModelChoice
from tvsbayes.instrument.parameters import Prior
from tvsbayes.instrument.plan import PlanStep, run_plan
from tvsbayes.instrument.protocols import twin_protocol
from tvsbayes.instrument.rig import Rig, read_rig
from tvsbayes.instrument.stereo_pair import Stereo, rotation_matrix
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.twin.physics import mirror_chain, project
from tvsbayes.twin.simulated_campaign import simulate
from tvsbayes.twin.true_rig import Truth, draw_truth, with_derived

Kind = Literal["lost motion", "literal"]
RIGS: tuple[Kind, Kind] = ("lost motion", "literal")
HOME_SIDES = "right", "up"
SHEETS_MM = 175.0, 275.0
STEPS, STARTS = 200, {"left": (0, 0), "right": (200, 0), "up": (100, -100), "down": (100, 100)}
"""Counters of pan and tilt at which the experiments of a direction start."""
MODELS = {"play": ModelChoice(per_axis=True), "ratios": ModelChoice(no_backlash=True), "both": ModelChoice()}
CONTRAST_U = 0.005
"""Prior sd of left - right and up - down, deg/step: twice what Table 1 shows for pan."""
TOLD_LOG10 = 2.0
AGAINST_LOG10 = np.log10(20)
SPOT_SD_PX = 0.05
QUANTITIES = tuple(f"{name}.{axis}" for name in ("ratio_contrast_deg_per_step", "backlash_deg") for axis in AXES)
CLASSIC_SEEDS = 10
NOTES = """\
True contrasts of the literal rigs: about -2.6 (pan) and +1.1 (tilt) in 1e-3 deg/step, of the others 0. True backlashes
of the rigs with lost motion: about 0.53 and 0.20 deg, of the others 0. Tilt over pan ratio: 1.000, and about 1.135.

Where the sides are not recorded every homing hypothesis is fitted (each side, or anywhere in the band at every start)
and weighed by its evidence. What tells the two apart is where the beam stands after moves both ways, against homings
that are good to 0.05 deg (the model's fixed value)."""


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
    p = {**drawn.parameters, **PAPER_NOISE}
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


def wide(rig: Rig) -> Rig:
    """The rig with a contrast prior that literal ratios pass."""
    loose = {f"ratio_contrast_deg_per_step.{axis}": Prior(0.0, CONTRAST_U) for axis in AXES}
    return replace(rig, table=replace(rig.table, priors={**rig.table.priors, **loose}))


def forget_sides(campaign: Campaign) -> Campaign:
    """The campaign without a record of where a start was reached from."""
    first = {"pan_approach": "unknown", "tilt_approach": "unknown"}
    return replace(campaign, moves=tuple(replace(m, **first) if m.pan_approach else m for m in campaign.moves))


def effective_ratios(joint: JointFit) -> dict[str, list[float]]:
    """Mode, sd and 95 % interval of the effective ratio of every direction, all homing hypotheses weighed."""
    rows = summarise(joint).effective if joint.converged else {}
    return {d: [e.value, e.sd, *e.interval95] for d, e in rows.items() if e is not None}


def read_by(rig: Rig, kind: str, seed: int, truth: Truth) -> Campaign:
    """The paper's campaign; other noise for every machine, or the two-sample tests would compare twins."""
    noise = 10_000 + 100 * seed + 10 * RIGS.index(kind)
    return simulate(rig, four_point_plan(), noise, truth, spot_sd_px=SPOT_SD_PX, home_approach=HOME_SIDES).campaign


def one_row(task: tuple[str, int]) -> dict[str, object]:
    """Simulate the campaign of one machine and fit the three models."""
    use_compilation_cache()
    kind, seed = task
    start = time.process_time()
    truth = solved(kind, mounted_rig(), seed)
    declared = wide(read_rig(shipped_data() / "rigs" / "nominal" / "rig.toml"))
    campaign = read_by(declared, kind, seed, truth)
    row: dict[str, object] = {"kind": kind, "seed": seed, "unseen": unseen(campaign), "models": {}}
    campaign = forget_sides(campaign)
    for model, choice in MODELS.items():
        try:
            result = fit(campaign, model=choice)
        except Exception as error:
            row["models"][model] = {"converged": False, "problems": [repr(error)]}
            continue
        draws, entry = result.draws.physical, {"converged": bool(result.converged), "problems": list(result.problems)}
        entry["log_evidence"], entry["chi2"] = result.log_evidence, result.chi2
        entry["homing_side"] = result.homing_side
        for quantity in QUANTITIES:
            column, mode = draws[:, TWO_MIRROR.index[quantity]], float(result.mode.physical[TWO_MIRROR.index[quantity]])
            entry[quantity] = [mode, float(column.std()), *np.quantile(column, (0.025, 0.975)).tolist()]
        if model == "both":
            entry["effective"] = effective_ratios(result)
        equal = draws[:, TWO_MIRROR.index["degrees_per_step.tilt"]] / draws[:, TWO_MIRROR.index["degrees_per_step.pan"]]
        entry["tilt over pan"] = [float(equal.mean()), float(equal.std())]
        row["models"][model] = entry
    row |= {"truth": {n: v for n, v in truth.parameters.items() if "step" in n}}
    return {**row, "effective": truth.effective_deg_per_step(campaign), "cpu_s": time.process_time() - start}


def weight_log10(row) -> float | None:
    """log10 of the Bayes factor of play against literal ratios; None where a fit failed."""
    pair = row["models"]
    if not (pair["play"]["converged"] and pair["ratios"]["converged"]):
        return None
    return (pair["play"]["log_evidence"] - pair["ratios"]["log_evidence"]) / np.log(10)


def drift_deg() -> tuple[float, float]:
    """How far pan and tilt of literal gears are off at the end of the paper's campaign without homings, degrees."""
    moves, result = run_plan(twin_protocol(), mounted_rig(), ("right", "up")).moves, []
    table = {name: values[1] for name, values in paper_values().items()}
    for axis, plus, minus in (("pan_steps", "left", "right"), ("tilt_steps", "up", "down")):
        steps = np.diff([getattr(m, axis) for m in moves])
        turned = np.sum(np.where(steps > 0, table[plus], table[minus]) * steps)
        # Against the mean ratio, which would bring the counter back to its value.
        result.append(float(turned - (table[plus] + table[minus]) / 2 * np.sum(steps)))
    return result[0], result[1]


def classic_part() -> None:
    """Both machines' Table 1, and whether the readings differ."""
    paper, rig = paper_values(), mounted_rig()
    readings: dict[tuple[str, str], list[np.ndarray]] = {}
    ratios = {kind: [] for kind in RIGS}
    for seed in range(CLASSIC_SEEDS):
        for kind in RIGS:
            truth = solved(kind, rig, seed)
            ratios[kind].append([truth.parameters[f"degrees_per_step.{d}"] for d in DIRECTIONS])
            for direction, values in classic_readings(read_by(rig, kind, seed, truth)).items():
                readings.setdefault((kind, direction), []).append(values)
    print("## The classic estimator\n")
    print(f"{CLASSIC_SEEDS} drawings, 24 experiments per direction each; deg/step; range of the true gear ratios.\n")
    titles = "direction | paper: mean, sd | lost motion: mean, sd | literal: mean, sd | true ratios, lost motion"
    print(heading(titles, "true ratios, literal | Welch p < 0.05"))
    every = []
    for k, name in enumerate(DIRECTIONS):
        cells = [f"{paper[name][1]:.6f}, {paper[name][2]:.6f}"]
        for kind in RIGS:
            values = readings[kind, name]
            spread = np.sqrt(np.mean([v.var(ddof=1) for v in values]))
            cells.append(f"{np.mean(values):.6f}, {spread:.6f}")
        cells += [f"{np.min(ratios[kind], axis=0)[k]:.4f} to {np.max(ratios[kind], axis=0)[k]:.4f}" for kind in RIGS]
        pairs = zip(*(readings[kind, name] for kind in RIGS), strict=True)
        p = [stats.ttest_ind(a, b, equal_var=False).pvalue for a, b in pairs]
        every += p
        print(f"| {name} | {' | '.join(cells)} | {sum(x < 0.05 for x in p)} of {len(p)} |")
    hits = sum(p < 0.05 for p in every)
    chance = stats.binomtest(hits, len(every), 0.05)
    uniform = stats.kstest(every, "uniform").pvalue
    print(f"\nOf {len(every)} two-sample tests {hits} have p < 0.05, where chance gives 5 % (binomial p of that count")
    print(f"{chance.pvalue:.2g}; the p-values against uniform, Kolmogorov-Smirnov: {uniform:.2g}).")
    pan, tilt = drift_deg()
    print("\nWithout the homings literal gears would have drifted by", end=" ")
    print(f"{pan:.0f} deg in pan and {tilt:.0f} deg in tilt at the end of the paper's 96 experiments.\n")


def table(rows: list[dict]) -> None:
    print("# Two rigs, one Table 1\n")
    print("Written by `python -m experiments.paper.two_rigs table` after `run`; what was done stands in the script.\n")
    classic_part()
    print("## The joint estimator\n")
    print(f"Told apart: the evidence is beyond {10**TOLD_LOG10:.0f} to 1 for the true one of play and literal ratios;")
    print("misled: for the wrong one. Contrast and backlash (medians over the seeds, sd of the model with both) in")
    print("1e-3 deg/step and deg; z of the contrast: largest of pan and tilt, |contrast| / sd, median.\n")
    titles = "truth | seeds | converged | told apart | undecided | misled | 20 to 1 against the truth"
    titles += " | log10 factor: median (range) | effective ratios in their 95 % intervals"
    print(heading(titles, "contrast pan | contrast tilt | z | backlash pan | backlash tilt | tilt over pan ratio"))
    for kind in RIGS:
        chosen = [row for row in rows if row["kind"] == kind]
        weights = [w for w in map(weight_log10, chosen) if w is not None]
        right = np.array(weights) * (1 if kind == "lost motion" else -1)
        sure, misled = int(np.sum(right > TOLD_LOG10)), int(np.sum(right < -TOLD_LOG10))
        cells = [sure, len(weights) - sure - misled, misled, np.sum(right < -AGAINST_LOG10)]
        cells.append(f"{np.median(weights):+.0f} ({min(weights):+.0f} to {max(weights):+.0f})")
        both = [row["models"]["both"] for row in chosen if row["models"]["both"]["converged"]]
        stated = [(row, row["models"]["both"].get("effective", {})) for row in chosen]
        held = [low <= row["effective"][d] <= high for row, of in stated for d, (_, _, low, high) in of.items()]
        at = {n: np.median([b[n][:2] for b in both], axis=0) for n in (*QUANTITIES, "tilt over pan")}
        z = np.median([max(abs(b[n][0]) / b[n][1] for n in QUANTITIES[:2]) for b in both])
        cells += [f"{sum(held)} of {len(held)}"]
        cells += [f"{1e3 * at[n][0]:+.2f} +- {1e3 * at[n][1]:.2f}" for n in QUANTITIES[:2]] + [f"{z:.1f}"]
        cells += [f"{at[n][0]:.3f} +- {at[n][1]:.3f}" for n in (*QUANTITIES[2:], "tilt over pan")]
        print(line(kind, len(chosen), len(weights), *cells))
    print(f"\n{NOTES}")


if __name__ == "__main__":
    study(__file__, __doc__, one_row, ("kind", "seed"), RIGS, table, 8)
