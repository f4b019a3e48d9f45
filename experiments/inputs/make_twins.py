"""Make everything under data/ that is computed: rigs with their stereo calibration, plans, twins.

    python -m experiments.inputs.make_twins

Deterministic: the same versions write the same bytes. Existing outputs are replaced.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np

from experiments.common.board_views import poses_in_view, seen_by_both
from experiments.common.command_line import print_only
from experiments.common.rigs import PAPER_NOISE, drawn_truth, paper_values
from experiments.common.rows import ROOT
from tvsbayes.estimators.four_point import classic, four_point_ratios, select_experiments
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import read_campaign
from tvsbayes.instrument.plan import write_plan
from tvsbayes.instrument.protocols import PROTOCOLS
from tvsbayes.instrument.rig import Rig, read_rig
from tvsbayes.instrument.stereo_pair import Stereo, rotation_matrix, write_stereo
from tvsbayes.twin.gear_errors import PERFECT
from tvsbayes.twin.simulated_campaign import SimulatedCampaign, simulate
from tvsbayes.twin.true_rig import Truth, draw_truth, with_derived

DATA = ROOT / "data"
SHEETS_MM = {"d1": 175.0, "d2": 275.0, "d3": 375.0}
BOARD_COLUMNS, BOARD_ROWS, BOARD_PITCH_MM = 9, 6, 25.0
BOARD_VIEWS = 20
CORNER_SD_PX = 0.15
STEREO_SEED = 20250405
PAPER_TWIN_SPOT_SD_PX = 0.05
MOUNTED_POSE = {
    "extrinsics.rotation_rad.x": 0.0,
    "extrinsics.rotation_rad.y": 0.0,
    "extrinsics.rotation_rad.z": 0.32,
    "extrinsics.translation_mm.x": 0.0,
    "extrinsics.translation_mm.y": -100.0,
    "extrinsics.translation_mm.z": 0.0,
}
"""T_SP of the mounted rig: yawed to the left so that 200 steps of pan give the paper's 18.5 to 30.4 deg."""
CREATED = datetime(2026, 1, 15, 10, 0, 0, tzinfo=UTC)
PAPER_TWIN_NOTE = (
    "Made to reproduce Table 1 of Metrology 2025, 5(4), 58 with the classic estimator. The history of its "
    "starts (left and down reversed, right and up cleared), one ratio and one backlash per axis and the "
    "larger stop error on left moves are OUR ASSUMPTION; the paper does not record them."
)
GRID_TWIN_NOTE = "A grid of poses at three sheets, both approach sides, with aperture readings; our own design."
GRID_TWIN_SEED = 11
MOUNTED_ROTATION_U_RAD = 0.03
MOUNTED_TRANSLATION_U_MM = 5.0


def stated_stereo() -> Stereo:
    """The shipped calibration: round values like the paper's rig, covariance of a board calibration."""
    stereo = Stereo(
        image_width=1280,
        image_height=720,
        M1=np.array([[801.0, 0.0, 642.0], [0.0, 800.5, 357.0], [0.0, 0.0, 1.0]]),
        D1=np.array([-0.30, 0.10, 0.0003, -0.0005, -0.010]),
        M2=np.array([[798.5, 0.0, 636.0], [0.0, 798.0, 363.0], [0.0, 0.0, 1.0]]),
        D2=np.array([-0.29, 0.095, -0.0002, 0.0004, -0.009]),
        R=rotation_matrix(np.array([0.004, -0.006, 0.003])),
        T=np.array([-85.0, 0.2, -0.3]),
        parameter_covariance=np.zeros((24, 24)),
        # OpenCV's rms is over corners, each with two coordinates.
        rms_px=round(CORNER_SD_PX * np.sqrt(2.0), 3),
    )
    covariance = calibration_covariance(stereo, np.random.default_rng(STEREO_SEED))
    return replace(stereo, parameter_covariance=covariance)


def calibration_covariance(stereo: Stereo, rng: np.random.Generator) -> np.ndarray:
    """Covariance (24, 24) of the stereo parameters after 20 views of the paper's board, poses eliminated.

    Least squares over all corners in both images with `CORNER_SD_PX`; the 120 pose parameters leave
    through the Schur complement of the normal matrix.
    """
    grid = np.mgrid[:BOARD_COLUMNS, :BOARD_ROWS].reshape(2, -1).T - np.array([4.0, 2.5])
    board = np.column_stack((BOARD_PITCH_MM * grid, np.zeros(len(grid))))
    information = np.zeros((24, 24))
    for pose in poses_in_view(board, stereo, BOARD_VIEWS, rng):
        by_stereo = _slopes(lambda v, pose=pose: seen_by_both(board, pose, stereo.with_vector(v)), stereo.vector)
        by_pose = _slopes(lambda p: seen_by_both(board, p, stereo), pose)
        coupling = by_stereo.T @ by_pose
        information += by_stereo.T @ by_stereo
        information -= coupling @ np.linalg.solve(by_pose.T @ by_pose, coupling.T)
    # Scaled to unit diagonal before inverting: px, rad and mm differ by ten powers of ten.
    scale = 1 / np.sqrt(np.diag(information))
    covariance = CORNER_SD_PX**2 * np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    return (covariance + covariance.T) / 2


def _slopes(function, at: np.ndarray) -> np.ndarray:
    """Jacobian by central differences with steps of 1e-6 of each value (at least of 1)."""
    columns = []
    for i, value in enumerate(at):
        step = 1e-6 * max(1.0, abs(value))
        ahead, behind = at.copy(), at.copy()
        ahead[i] += step
        behind[i] -= step
        columns.append((function(ahead) - function(behind)).ravel() / (2 * step))
    return np.column_stack(columns)


RIG_HEAD = """format = "tvsbayes-rig/1"
name = "{name}"
notes = "{title}"
stereo = "stereo.json"

[rig]
baseline_mm = {{ value = 200.0, u = 0.1 }}
pan_zero_emission_deg = {{ value = 90.0, u = 0.2 }}
aperture_zero_deg = {{ value = 0.0, u = 0.1 }}
aperture_sd_deg = {{ value = 0.02, u = 0.0 }}
aperture_convention = "in-plane"
focal_scale = {{ value = 1.0, u = 0.002 }}

"""
RIG_TAIL = """
[sheets]                # nominal X in frame S, mm
d1 = 175.0
d2 = 275.0
d3 = 375.0

[costs]                 # seconds
move_s = 1.5
look_s = 1.0
placement_s = 60.0
"""


def pose_entries() -> str:
    """TOML lines of the mounted pose with its standard uncertainties."""
    lines = []
    for name, value in MOUNTED_POSE.items():
        u = MOUNTED_ROTATION_U_RAD if "rotation" in name else MOUNTED_TRANSLATION_U_MM
        lines.append(f'"{name}" = {{ value = {value}, u = {u} }}\n')
    return "".join(lines)


def write_rigs() -> None:
    """data/rigs: the nominal and the mounted rig with calibration; plans for both beside the latter."""
    nominal = (
        "Nothing measured about its mounting; the analysis priors are the defaults.",
        "[truth]                 # stand as the mounted rig does: else few spots would be in view\n" + pose_entries(),
    )
    mounted = (
        "Extrinsics known to 0.03 rad and 5 mm; everything else as the nominal rig.",
        "[rig.prior]             # yawed left, so that 200 steps of pan give the paper's angles\n" + pose_entries(),
    )
    stereo = stated_stereo()
    for name, (title, entries) in {"nominal": nominal, "mounted": mounted}.items():
        folder = DATA / "rigs" / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        (folder / "rig.toml").write_text(
            RIG_HEAD.format(name=f"{name} rig", title=title) + entries + RIG_TAIL, encoding="utf-8"
        )
        write_stereo(stereo, folder / "stereo.json")
    for plan, make in PROTOCOLS.items():
        write_plan(make(), DATA / "rigs" / "mounted" / f"{plan}.csv")


def paper_twin(rig: Rig) -> SimulatedCampaign:
    """A campaign whose classic result is Table 1, under our assumption of how its starts were reached.

    One ratio and one backlash per axis. Left and down starts are reversed: classic sees k - b/200; right
    and up starts are cleared: classic sees k. Ratios and backlashes are solved so that the realised means
    are the Table's; the stop sds of left and right so that the realised sds are; up and down share the up
    stop, so the first seed is taken whose realisation has both within 6 %.
    """
    for seed in range(1, 400):
        twin = matched(rig, seed)
        sds = _realised(twin)[1]
        worst = max(abs(sds[name] / sd - 1) for name, (_, _, sd) in paper_values().items())
        if worst < 0.06 and all(spot.status == "ok" for spot in twin.campaign.spots):
            return twin
    raise RuntimeError("no seed below 400 reproduces Table 1; widen the search or change the stop errors")


def matched(rig: Rig, seed: int) -> SimulatedCampaign:
    """Twin of one seed with ratios, backlashes and pan stop sds solved; perfect gears, as the classic method has it."""
    drawn = draw_truth(rig, np.random.default_rng(seed)).with_gears()
    p = {**drawn.parameters, **PAPER_NOISE, "degrees_per_step.pan": 0.0615, "degrees_per_step.tilt": 0.0630}
    p |= {"ratio_contrast_deg_per_step.pan": 0.0, "ratio_contrast_deg_per_step.tilt": 0.0}
    p |= {"backlash_deg.pan": 0.526, "backlash_deg.tilt": 0.222}
    pairs, paper = {"pan": ("right", "left"), "tilt": ("up", "down")}, paper_values()  # cleared, reversed
    for _ in range(12):
        twin = _twin(rig, Truth(with_derived(p), drawn.stereo, gear_errors=PERFECT), seed)
        mean, sd = _realised(twin)
        for axis, (cleared, reverse) in pairs.items():
            lost = mean[reverse] - mean[cleared] - paper[reverse][1] + paper[cleared][1]
            p[f"backlash_deg.{axis}"] += 200 * lost
            p[f"degrees_per_step.{axis}"] *= paper[cleared][1] / mean[cleared]
        for name in ("left", "right"):
            p[f"stop_sd_deg.{name}"] *= np.clip(paper[name][2] / sd[name], 0.8, 1.25)
    p = {name: float(f"{value:.7g}") for name, value in p.items()}
    truth = Truth(with_derived(p), drawn.stereo, gear_errors=PERFECT, note=PAPER_TWIN_NOTE)
    return _twin(rig, truth, seed)


def _twin(rig: Rig, truth: Truth, seed: int) -> SimulatedCampaign:
    """The paper twin's plan on a true rig."""
    header = {"name": "paper twin", "created": CREATED, "notes": PAPER_TWIN_NOTE}
    return simulate(rig, PROTOCOLS["paper_twin"](), seed, truth, spot_sd_px=PAPER_TWIN_SPOT_SD_PX, header=header)


def _realised(twin: SimulatedCampaign) -> tuple[dict[str, float], dict[str, float]]:
    """Mean and sd of the classic ratios per direction."""
    chosen = select_experiments(twin.campaign)
    ratios = four_point_ratios(chosen.pixels, chosen.steps, chosen.axis, twin.campaign.stereo)
    of = {name: ratios[chosen.direction == name] for name in DIRECTIONS}
    sds = {name: float(np.std(values, ddof=1)) for name, values in of.items()}
    return {name: float(np.mean(values)) for name, values in of.items()}, sds


def grid_twin(rig: Rig) -> SimulatedCampaign:
    """A grid of poses at three sheets with aperture readings, on a rig of the mounted priors, its gears perfect."""
    header = {"name": "grid twin", "created": CREATED, "notes": GRID_TWIN_NOTE}
    truth = drawn_truth(rig, GRID_TWIN_SEED).with_gears()
    twin = simulate(rig, PROTOCOLS["grid"](), GRID_TWIN_SEED, truth, aperture=True, header=header)
    return replace(twin, truth=replace(twin.truth, note=GRID_TWIN_NOTE))


def main() -> None:
    """Write rigs, plans and twins; print the classic result of the paper twin."""
    print_only(__doc__)
    write_rigs()
    rig = read_rig(DATA / "rigs" / "mounted" / "rig.toml")
    for name, make in (("paper_twin", paper_twin), ("grid_twin", grid_twin)):
        folder = DATA / "twins" / name
        shutil.rmtree(folder, ignore_errors=True)
        twin = make(rig)
        twin.write(folder)
        counts = f"{len(twin.campaign.spots)} spots, {len(twin.campaign.moves)} moves"
        print(f"{folder.relative_to(DATA.parent)}: seed {twin.campaign.header['seed']}, {counts}")
    results = classic(read_campaign(DATA / "twins" / "paper_twin")).directions
    for direction, (_, mean, sd) in paper_values().items():
        result = results[direction]
        shown = f"mean {result.mean_deg_per_step:.6f} sd {result.sd_deg_per_step:.6f}"
        print(f"  {direction:5s} {shown} deg/step; Table 1: {mean:.6f}, {sd:.6f}")


if __name__ == "__main__":
    main()
