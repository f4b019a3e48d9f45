"""Two rigs, one Table 1: equal gears with lost motion seen at an azimuth, and four literal ratios; who tells?

    python experiments/two_rigs.py run --seeds 6 --core 0        # 10 minutes, resumable
    python experiments/two_rigs.py table > experiments/two_rigs.md      # writes the figure too

Seed s draws optics, cameras and mounting from the priors of `data/rigs/mounted`; then two machines are put into that
drawing, each solved so that the classic estimator reads Table 1's means without noise:

* "lost motion": one gear ratio for both axes, contrasts 0, a backlash per axis; the yaw makes the tilt look larger;
* "literal": four ratios, no play; turned so that the tilt experiments happen at azimuth 0, where a tilt is read as it
  is. Such gears drift away (no toothed gear can be so over long travel): homed before every experiment.

Both run the same plans, with the stop errors of the paper twin (which give the Table's sds) and 0.05 px. The nominal
rig is declared, which knows nothing of the mounting, with N(0, 0.005 deg/step) for the contrasts: the default 2e-4
excludes literal ratios beforehand. Three models are fitted: gears with play and one ratio per axis; ratios per
direction without play; both. log10 of the Bayes factor = difference of the Laplace evidences of the first two. It is
called told apart beyond 100 to 1. Campaigns:

* paper, as published: |N| = 200, 24 in each direction, every experiment from a homing at its start counters, ended on
  the right and on the upper side, and the sides NOT recorded;
* paper, sides recorded; mixed: 12 in each direction, |N| = 100 and 200 in turn, every second start reached from the
  other side of its homing;
* grid: the shipped grid, homed once per sheet; planned: 64 looks by the planner for the worst effective ratio.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from coverage import read_rows
from studies import mounted_rig, run_rows
from table1 import paper_values

ROWS = Path(__file__).parent / "output" / "two_rigs.jsonl"
PLANNED = ROWS.with_name("two_rigs_planned.csv")
FIGURE = Path(__file__).with_suffix(".png")
RIGS = ("lost motion", "literal")
CAMPAIGNS = ("paper, as published", "paper, sides recorded", "mixed", "grid", "planned")
MODELS = ("play", "ratios", "both")
CONTRAST_U = 0.005
"""Prior sd of left - right and up - down, deg/step: twice what Table 1 shows for pan."""
TOLD_LOG10 = 2.0
SPOT_SD_PX = 0.05
HOME_SIDES = "right", "up"
QUANTITIES = (
    "ratio_contrast_deg_per_step.pan",
    "ratio_contrast_deg_per_step.tilt",
    "backlash_deg.pan",
    "backlash_deg.tilt",
)
CLASSIC_SEEDS = 10
NOTES = """\
True contrasts of the literal rigs: about -2.6 (pan) and +1.1 (tilt) in 1e-3 deg/step, of the others 0. True backlashes
of the rigs with lost motion: about 0.53 and 0.20 deg, of the others 0. Tilt over pan ratio: 1.000, and about 1.135.

Where the sides are not recorded the model takes the play to stand anywhere in its band at every start, each anew:
starts that are always reached from the same side then look like a ratio. What tells the two apart is where the beam
stands after moves both ways, against homings that are good to 0.05 deg (the model's fixed value)."""
NOISE = {
    "stop_sd_deg.left": 0.155,
    "stop_sd_deg.right": 0.022,
    "stop_sd_deg.up": 0.036,
    "stop_sd_deg.down": 0.008,
    "pixel_scale": 1.0,
}
SHEETS_MM = 175.0, 275.0
STEPS, PAN_START, TILT_START = 200, {"left": 0, "right": 200}, {"up": -100, "down": 100}
SIGN = {"left": 1, "right": -1, "up": 1, "down": -1}
DIRECTIONS = tuple(SIGN)


def four_point_plan(repeats: int = 24, steps=(200,), other_side=(False,)):
    """The paper's experiments, each from a homing at its start; `other_side` starts have a run-up against it."""
    from tvsbayes.instrument.plan import PlanStep
    from tvsbayes.instrument.protocols import OVERSHOOT_STEPS

    orders: list[tuple] = []
    for direction, sign in SIGN.items():
        pan = direction in PAN_START
        start = [PAN_START[direction], 0] if pan else [100, TILT_START[direction]]
        axis, home_sign = (0, -1) if pan else (1, 1)
        for repeat in range(repeats):
            number = DIRECTIONS.index(direction) * repeats + repeat
            end, beyond = list(start), list(start)
            end[axis] += sign * steps[repeat % len(steps)]
            # Arriving by a move against the homing's last one.
            beyond[axis] += home_sign * OVERSHOOT_STEPS
            orders += [("home", *start), ("place", None, None, "d1")]
            if other_side[repeat % len(other_side)]:
                orders += [("move", *beyond), ("move", *start)]
            orders += [
                ("look", None, None, None, number, 1),
                ("place", None, None, "d2"),
                ("look", None, None, None, number, 2),
                ("move", *end),
                ("look", None, None, None, number, 3),
                ("place", None, None, "d1"),
                ("look", None, None, None, number, 4),
            ]
    return tuple(PlanStep(k, *order) for k, order in enumerate(orders))


def planned_steps(rig):
    """What the planner takes for 16 experiments' worth of looks, as in planning_design.py."""
    from tvsbayes.planning.candidates import LookArrays, candidates
    from tvsbayes.planning.expectation import prior_knowledge
    from tvsbayes.planning.search import Scope, design_family
    from tvsbayes.planning.target import DEFAULT_TARGET, parse_target, sensitivity

    knowledge, target = prior_knowledge(rig), parse_target(DEFAULT_TARGET)
    found = candidates(knowledge)
    seen = LookArrays(found.looks, knowledge, False).at(knowledge.z, knowledge.space)
    centre = sensitivity(target, knowledge.z, knowledge.space, rig.table, seen.mirror_angles_rad.mean(axis=0))
    return design_family(knowledge, found, seen, replace(target, limit=1e-9), centre, Scope(largest=16)).arranged(16).steps


def plan_of(name: str):
    """Plan of a campaign."""
    from tvsbayes.instrument.plan import PlanStep
    from tvsbayes.instrument.protocols import grid_protocol

    if name.startswith("paper"):
        return four_point_plan()
    if name == "mixed":
        return four_point_plan(12, steps=(100, 200), other_side=(False, False, True, True))
    if name == "planned":
        return planned_steps(mounted_rig())
    orders = []
    for step in grid_protocol():
        orders.append(step)
        if step.action == "place":
            orders.append(PlanStep(0, "home", 0, 0))
    return tuple(replace(step, step=number) for number, step in enumerate(orders))


def classic_without_noise(parameters, stated, true_stereo) -> dict[str, float]:
    """What the classic chain reads of the four moves, deg/step, by the twin's optics on nominal sheets."""
    from tvsbayes.estimators.four_point import four_point_ratios
    from tvsbayes.instrument.stereo_pair import rotation_matrix
    from tvsbayes.twin.physics import mirror_chain, project

    rotation = rotation_matrix(np.array([parameters[f"extrinsics.rotation_rad.{a}"] for a in "xyz"]))
    shift = np.array([parameters[f"extrinsics.translation_mm.{a}"] for a in "xyz"])
    points = []
    play = {axis: parameters[f"backlash_deg.{axis}"] / 2 for axis in ("pan", "tilt")}
    for direction, sign in SIGN.items():
        axis, k = ("pan", 0) if direction in PAN_START else ("tilt", 1)
        start = (PAN_START[direction], 0) if axis == "pan" else (100, TILT_START[direction])
        # Homings end on the right (+b/2) and on the upper side (-b/2).
        rest = [parameters[f"degrees_per_step.{a}"] * n for a, n in zip(("pan", "tilt"), start, strict=True)]
        rest = [rest[0] + play["pan"], rest[1] - play["tilt"] + parameters["tilt_zero_deg"]]
        turned = parameters[f"degrees_per_step.{direction}"] * STEPS
        # The play is taken up first where the move goes against the homing's last one.
        lost = 2 * play[axis] if direction in ("left", "down") else 0.0
        after = list(rest)
        after[k] += sign * (turned - lost)
        for pose, depth in ((rest, 0), (rest, 1), (after, 1), (after, 0)):
            origin, beam = (part @ rotation.T for part in mirror_chain(*np.radians(pose), parameters))
            origin = origin + shift
            points.append(origin + (SHEETS_MM[depth] - origin[0]) / beam[0] * beam)
    pixels = project(np.array(points), true_stereo, parameters["focal_scale"])
    signed = np.array([SIGN[d] * STEPS for d in DIRECTIONS])
    axes = np.array(["pan", "pan", "tilt", "tilt"])
    ratios = four_point_ratios(pixels.reshape(4, 4, 4), signed, axes, stated)
    return dict(zip(DIRECTIONS, map(float, ratios), strict=True))


def solved(kind: str, rig, seed: int):
    """True rig of a kind from drawing `seed`, that reads Table 1's means; and those readings."""
    from tvsbayes.twin.simulated_campaign import draw_truth, with_derived

    drawn = draw_truth(rig, np.random.default_rng([seed, 2]))
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
        for axis in ("pan", "tilt"):
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
    return replace(drawn, parameters=p), read


def wide(rig):
    """The rig with a contrast prior that literal ratios pass."""
    from tvsbayes.instrument.parameters import Prior

    loose = {f"ratio_contrast_deg_per_step.{axis}": Prior(0.0, CONTRAST_U) for axis in ("pan", "tilt")}
    return replace(rig, table=replace(rig.table, priors={**rig.table.priors, **loose}))


def forget_sides(campaign):
    """The campaign as somebody records it who does not note from where a start was reached."""
    first = {"pan_approach": "unknown", "tilt_approach": "unknown"}
    return replace(campaign, moves=tuple(replace(m, **first) if m.pan_approach else m for m in campaign.moves))


def log_evidence(result) -> float:
    """Laplace's ln p(data), up to the constant that all models of a campaign share.

    The coordinates have N(0, 1) priors, whose (2 pi)^(-p/2) the Gaussian integral cancels; a fixed one stays at 0
    with unit variance and adds nothing.
    """
    return float(result.log_density + 0.5 * np.linalg.slogdet(result.covariance)[1])


def one_row(task: tuple[str, str, int]) -> dict[str, object]:
    """Simulate one campaign of one machine and fit the three models."""
    from tvsbayes.estimators import campaign_arrays

    # As in coverage.py: ordinary fits pad to 512 spots.
    campaign_arrays.SMALLEST_BUCKET = 96
    from tvsbayes.estimators.campaign_arrays import use_compilation_cache
    from tvsbayes.estimators.joint_fit import fit
    from tvsbayes.files.disk import shipped_data
    from tvsbayes.instrument.model_choice import ModelChoice
    from tvsbayes.instrument.parameters import INDEX
    from tvsbayes.instrument.plan import read_plan
    from tvsbayes.instrument.rig import read_rig
    from tvsbayes.twin.simulated_campaign import simulate

    use_compilation_cache()
    kind, name, seed = task
    start = time.process_time()
    truth, _ = solved(kind, mounted_rig(), seed)
    declared = wide(read_rig(shipped_data() / "rigs" / "nominal" / "rig.toml"))
    plan = read_plan(PLANNED) if name == "planned" else plan_of(name)
    # Other noise for every machine and campaign, or the two-sample tests would compare twins.
    noise = 10_000 + 100 * seed + 10 * RIGS.index(kind) + CAMPAIGNS.index(name)
    campaign = simulate(declared, plan, noise, truth, spot_sd_px=SPOT_SD_PX, home_approach=HOME_SIDES).campaign
    row: dict[str, object] = {"kind": kind, "campaign": name, "seed": seed}
    row["unseen"] = sum(spot.status != "ok" for spot in campaign.spots)
    if name == "paper, as published":
        campaign = forget_sides(campaign)
    choices = {"play": ModelChoice(per_axis=True), "ratios": ModelChoice(no_backlash=True), "both": ModelChoice()}
    row["models"] = {}
    for model in MODELS:
        try:
            result = fit(campaign, model=choices[model])
        except Exception as error:
            row["models"][model] = {"converged": False, "problems": [repr(error)]}
            continue
        draws, found = result.draws.physical, {"converged": bool(result.converged), "problems": list(result.problems)}
        found["log_evidence"], found["chi2"] = log_evidence(result), result.chi2
        for axis in ("pan", "tilt"):
            for quantity in ("ratio_contrast_deg_per_step", "backlash_deg"):
                column = draws[:, INDEX[f"{quantity}.{axis}"]]
                ends = np.quantile(column, (0.025, 0.975)).tolist()
                mode = float(result.mode.physical[INDEX[f"{quantity}.{axis}"]])
                found[f"{quantity}.{axis}"] = [mode, float(column.std()), *ends]
        equal = draws[:, INDEX["degrees_per_step.tilt"]] / draws[:, INDEX["degrees_per_step.pan"]]
        found["tilt over pan"] = [float(equal.mean()), float(equal.std())]
        row["models"][model] = found
    return {
        **row,
        "truth": {n: v for n, v in truth.parameters.items() if "step" in n},
        "cpu_s": time.process_time() - start,
    }


def run(arguments: argparse.Namespace) -> None:
    """Append rows until every machine has every campaign under every seed."""
    from tvsbayes.estimators.campaign_arrays import use_compilation_cache
    from tvsbayes.instrument.plan import write_plan

    use_compilation_cache()
    PLANNED.parent.mkdir(parents=True, exist_ok=True)
    if not PLANNED.exists():
        write_plan(plan_of("planned"), PLANNED)
    tasks = [(kind, name, seed) for seed in range(arguments.seeds) for name in CAMPAIGNS for kind in RIGS]
    run_rows(one_row, tasks, ROWS, ("kind", "campaign", "seed"), [arguments.core])


def weight_log10(row) -> float | None:
    """log10 of the Bayes factor of play against literal ratios; None where a fit failed."""
    found = row["models"]
    if not (found["play"]["converged"] and found["ratios"]["converged"]):
        return None
    return (found["play"]["log_evidence"] - found["ratios"]["log_evidence"]) / np.log(10)


def drift_deg() -> tuple[float, float]:
    """How far pan and tilt of literal gears are off at the end of the paper's campaign without homings, degrees."""
    from tvsbayes.instrument.plan import run_plan
    from tvsbayes.instrument.protocols import twin_protocol

    moves, result = run_plan(twin_protocol(), mounted_rig(), ("right", "up")).moves, []
    table = {name: values[1] for name, values in paper_values().items()}
    for axis, plus, minus in (("pan_steps", "left", "right"), ("tilt_steps", "up", "down")):
        steps = np.diff([getattr(m, axis) for m in moves])
        turned = np.sum(np.where(steps > 0, table[plus], table[minus]) * steps)
        # Against the mean ratio, which would bring the counter back to where it says.
        result.append(float(turned - (table[plus] + table[minus]) / 2 * np.sum(steps)))
    return result[0], result[1]


def classic_part() -> None:
    """Both machines' Table 1, and whether the readings differ."""
    from scipy import stats

    from tvsbayes.twin.simulated_campaign import simulate

    paper, rig = paper_values(), mounted_rig()
    readings: dict[tuple[str, str], list[np.ndarray]] = {}
    ratios = {kind: [] for kind in RIGS}
    for seed in range(CLASSIC_SEEDS):
        for kind in RIGS:
            truth, _ = solved(kind, rig, seed)
            ratios[kind].append([truth.parameters[f"degrees_per_step.{d}"] for d in DIRECTIONS])
            noise = 10_000 + 100 * seed + 10 * RIGS.index(kind)
            plan = plan_of("paper, as published")
            campaign = simulate(rig, plan, noise, truth, spot_sd_px=SPOT_SD_PX, home_approach=HOME_SIDES).campaign
            for direction, values in classic_readings(campaign).items():
                readings.setdefault((kind, direction), []).append(values)
    print("## The classic estimator\n")
    print(f"{CLASSIC_SEEDS} drawings, 24 experiments per direction each; deg/step; range of the true gear ratios.\n")
    print(
        "| direction | paper: mean, sd | lost motion: mean, sd | literal: mean, sd | true ratios, lost motion ", end=""
    )
    print("| true ratios, literal | Welch p < 0.05 |\n|" + "---|" * 7)
    every = []
    for k, name in enumerate(DIRECTIONS):
        cells = [f"{paper[name][1]:.6f}, {paper[name][2]:.6f}"]
        for kind in RIGS:
            values = readings[kind, name]
            spread = np.sqrt(np.mean([v.var(ddof=1) for v in values]))
            cells.append(f"{np.mean(values):.6f}, {spread:.6f}")
        cells += [f"{np.min(ratios[kind], axis=0)[k]:.4f} to {np.max(ratios[kind], axis=0)[k]:.4f}" for kind in RIGS]
        p = [
            stats.ttest_ind(a, b, equal_var=False).pvalue
            for a, b in zip(*(readings[kind, name] for kind in RIGS), strict=True)
        ]
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


def classic_readings(campaign) -> dict[str, np.ndarray]:
    """Ratios by direction, without uncertainties."""
    from tvsbayes.estimators.four_point import four_point_ratios, select_experiments

    chosen = select_experiments(campaign)
    ratios = four_point_ratios(chosen.pixels, chosen.steps, chosen.axis, campaign.stereo)
    return {d: ratios[chosen.direction == d] for d in DIRECTIONS}


def table() -> None:
    """The page and its figure."""
    rows = read_rows(ROWS)
    print("# Two rigs, one Table 1\n")
    print("Written by `python experiments/two_rigs.py table` after `run`; what was done stands in the script.\n")
    classic_part()
    print("## The joint estimator\n")
    print(f"Told apart: the evidence is beyond {10**TOLD_LOG10:.0f} to 1 for the true one of play and literal ratios;")
    print("misled: for the wrong one. Contrast and backlash (medians over the seeds, sd of the model with both) in")
    print("1e-3 deg/step and deg; z of the contrast: largest of pan and tilt, |contrast| / sd, median.\n")
    print(
        "| campaign | truth | seeds | converged | told apart | undecided | misled | log10 factor: median (range) ",
        end="",
    )
    print("| contrast pan | contrast tilt | z | backlash pan | backlash tilt | tilt over pan ratio |\n|" + "---|" * 14)
    for name in CAMPAIGNS:
        for kind in RIGS:
            chosen = [r for r in rows if r["campaign"] == name and r["kind"] == kind]
            if not chosen:
                continue
            weights = [w for w in map(weight_log10, chosen) if w is not None]
            right = np.array(weights) * (1 if kind == "lost motion" else -1)
            told, misled = int(np.sum(right > TOLD_LOG10)), int(np.sum(right < -TOLD_LOG10))
            cells = [f"{told}", f"{len(weights) - told - misled}", f"{misled}"]
            cells.append(f"{np.median(weights):+.0f} ({min(weights):+.0f} to {max(weights):+.0f})" if weights else "-")
            both = [r["models"]["both"] for r in chosen if r["models"]["both"]["converged"]]
            if both:
                at = {n: np.median([b[n][:2] for b in both], axis=0) for n in QUANTITIES}
                z = np.median([max(abs(b[n][0]) / b[n][1] for n in QUANTITIES[:2]) for b in both])
                cells += [f"{1e3 * at[n][0]:+.2f} +- {1e3 * at[n][1]:.2f}" for n in QUANTITIES[:2]] + [f"{z:.1f}"]
                cells += [f"{at[n][0]:.3f} +- {at[n][1]:.3f}" for n in QUANTITIES[2:]]
                ratio = np.median([b["tilt over pan"] for b in both], axis=0)
                cells.append(f"{ratio[0]:.3f} +- {ratio[1]:.3f}")
            else:
                cells += ["-"] * 6
            print(f"| {name} | {kind} | {len(chosen)} | {len(weights)} | {' | '.join(cells)} |")
    print(f"\n{NOTES}")
    draw(rows)


def draw(rows) -> None:
    """Weight of the evidence by campaign, and contrast against backlash of pan."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    from tvsbayes.report.figures import BLACK, BLUE, RED, STYLE, WIDTH_IN

    looks = {"lost motion": (BLUE, "o"), "literal": (RED, "^")}
    with rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 3.4), layout="constrained")
        axes = figure.subplots()
        for kind, (colour, marker) in looks.items():
            places, weights = [], []
            for k, name in enumerate(CAMPAIGNS):
                chosen = [r for r in rows if r["campaign"] == name and r["kind"] == kind]
                for w in filter(lambda w: w is not None, map(weight_log10, chosen)):
                    places.append(k + (0.12 if kind == "literal" else -0.12))
                    weights.append(w)
            label = f"true: {'gears with play' if kind == 'lost motion' else 'literal ratios'}"
            axes.plot(weights, places, marker, color=colour, markersize=5, alpha=0.7, label=label)
        axes.axvline(0.0, color=BLACK, linewidth=0.8)
        axes.set(yticks=range(len(CAMPAIGNS)), yticklabels=CAMPAIGNS, ylim=(len(CAMPAIGNS) - 0.5, -0.5))
        axes.set_xlabel("log10 Bayes factor: literal ratios < 0 < play")
        figure.legend(loc="outside lower center", ncols=2)
        figure.savefig(FIGURE, dpi=130)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("run", "table"))
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--core", type=int, default=0)
    arguments = parser.parse_args()
    run(arguments) if arguments.action == "run" else table()


if __name__ == "__main__":
    main()
