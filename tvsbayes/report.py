"""What people and programs get to see of an estimate: text tables, `value(u)`, the files in `results/`.

Formats only; every number is computed elsewhere. Units are those of DESIGN 8.
"""

from __future__ import annotations

import io
import json
import math
import shlex
import sys
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from tvsbayes.calibration import Calibration, Steps, calibration_bytes
from tvsbayes.campaign import input_hashes
from tvsbayes.classic import DIRECTIONS, ClassicResult
from tvsbayes.files import escaped, make_folder, write_atomically

if TYPE_CHECKING:
    from tvsbayes.cameras import StereoCalibration
    from tvsbayes.comparison import Budget, Comparison, Gap, GapTerm, HoldOut
    from tvsbayes.coordinates import Locations
    from tvsbayes.information import Estimate, FitSummary
    from tvsbayes.joint import Derived, JointFit
    from tvsbayes.rigs import Stereo
    from tvsbayes.spots import Detection

FIT_FORMAT = "tvsbayes-fit/1"
KEY_PARAMETERS = (
    ("backlash_deg.pan", "backlash pan", "deg"),
    ("backlash_deg.tilt", "backlash tilt", "deg"),
    ("effective_mirror_offset_mm", "mirror offset (effective)", "mm"),
    ("mirror_offset_mm", "mirror offset L", "mm"),
    ("extrinsics.rotation_rad.x", "extrinsics rotation x", "rad"),
    ("extrinsics.rotation_rad.y", "extrinsics rotation y", "rad"),
    ("extrinsics.rotation_rad.z", "extrinsics rotation z", "rad"),
    ("extrinsics.translation_mm.x", "extrinsics translation x", "mm"),
    ("extrinsics.translation_mm.y", "extrinsics translation y", "mm"),
    ("extrinsics.translation_mm.z", "extrinsics translation z", "mm"),
    ("stop_sd_deg.left", "stop sd left", "deg"),
    ("stop_sd_deg.right", "stop sd right", "deg"),
    ("stop_sd_deg.up", "stop sd up", "deg"),
    ("stop_sd_deg.down", "stop sd down", "deg"),
    ("pixel_scale", "pixel noise / stated", ""),
)


def concise(value: float, sd: float) -> str:
    """`0.059394(81)`: the standard uncertainty's two digits in units of the last place (GUM 7.2.2).

    From 1 on the uncertainty keeps its decimal point, as in `21.3(1.5)`.
    """
    if not 0 < sd < math.inf:
        return f"{value:.6g}"
    # Of the rounded sd: 0.0996 has the digits 10, not 100.
    mantissa, exponent = f"{sd:.1e}".split("e")
    decimals = max(0, 1 - int(exponent))
    digits = mantissa.replace(".", "") if int(exponent) < 0 else f"{float(f'{sd:.1e}'):.{decimals}f}"
    return f"{value:.{decimals}f}({digits})"


def interval_text(low: float, high: float, sd: float) -> str:
    """Interval ends to one digit more than the standard uncertainty's second."""
    decimals = max(0, 2 - math.floor(math.log10(sd))) if sd > 0 else 6
    return f"[{low:.{decimals}f}, {high:.{decimals}f}]"


def text_table(title: str, columns: list[str], rows: list[list[str]]) -> str:
    """A table without lines, for terminals and files alike."""
    table = Table(title=title, title_justify="left", title_style="", box=None, pad_edge=False)
    for number, column in enumerate(columns):
        table.add_column(column, justify="left" if number == 0 else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    stream = io.StringIO()
    # Plain text whatever FORCE_COLOR and the like say: it also goes into files.
    Console(file=stream, width=120, highlight=False, color_system=None, force_terminal=False).print(table)
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines())


def classic_text(result: ClassicResult) -> str:
    """The classic estimator's table."""
    rows = []
    for direction in DIRECTIONS:
        r = result.directions[direction]
        if r is None:
            rows.append([direction, "0", "no experiment", "", "", ""])
            continue
        optional = (r.sd_deg_per_step, r.u_type_a_deg_per_step)
        sd, u = ("-" if x is None else f"{x:.6f}" for x in optional)
        gum = "-" if r.interval95_gum is None else interval_text(*r.interval95_gum, r.u_gum_deg_per_step)
        rows.append([direction, str(r.n), f"{r.mean_deg_per_step:.6f}", sd, u, gum])
    columns = ["direction", "n", "mean deg/step", "sd", "u type A", "95 % interval (GUM)"]
    return text_table("classic four-point estimator", columns, rows)


def stereo_text(stereo: Stereo) -> str:
    """The 24 parameters of a pair with their standard uncertainties, both cameras beside each other."""
    sds = np.sqrt(np.diag(stereo.parameter_covariance))
    cells = [concise(float(value), float(sd)) for value, sd in zip(stereo.vector, sds, strict=True)]
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    units = ("px",) * 4 + ("",) * 5
    rows = [[name, cells[k], cells[9 + k], unit] for k, (name, unit) in enumerate(zip(names, units, strict=True))]
    title = f"stereo pair, {stereo.image_width} x {stereo.image_height} px"
    cameras = text_table(title, ["", "left(u)", "right(u)", "unit"], rows)
    rows = [[axis, cells[18 + k], cells[21 + k]] for k, axis in enumerate("xyz")]
    return f"{cameras}\n{text_table('x_right = R x_left + T', ['', 'rotation, rad', 'T, mm'], rows)}"


def stereo_calibration_text(result: StereoCalibration) -> str:
    """A calibration from checkerboards: parameters, views, and everything the reader must know about it."""

    def px(value: float | None) -> str:
        return "-" if value is None else f"{value:.3f}"

    rows = []
    for view in result.views:
        cells = [px(view.left_rms_px), px(view.right_rms_px), f"{view.distance_mm:.0f}", f"{view.tilt_deg:.0f}"]
        rows.append([escaped(view.name) or "-", *cells, "OUTLIER" if view.outlier else ""])
    columns = ["view", "left rms px", "right rms px", "distance mm", "tilt deg", ""]
    board, mean_sd = result.board, result.triangulated_pitch_mm
    lines = [
        stereo_text(result.stereo),
        text_table(f"{result.pairs} pairs, {len(result.views) - result.pairs} single views", columns, rows),
        f"rms over corners: both {result.stereo.rms_px:.3f}, left {px(result.left_rms_px)}, right "
        f"{px(result.right_rms_px)} px; one coordinate: sd {result.noise_sd_px:.3f} px, dof {result.dof}",
        "uncertainties hold for corner errors that the corners of a picture share: variances "
        f"{result.correlation_factor:.1f} times those of independent corners",
        f"baseline {concise(float(np.linalg.norm(result.stereo.T)), result.baseline_sd_mm)} mm; squares, triangulated: "
        f"{mean_sd[0]:.3f} mm on average, sd {mean_sd[1]:.3f}, stated {board.pitch_mm:g}",
        "boards cover "
        + ", ".join(f"{100 * share:.0f} % of the {side} image" for side, share in result.coverage.items()),
    ]
    if (found := result.found) is not None:
        lists = {
            "without their counterpart": found.unpaired,
            "no board found": found.without_board,
            "another size, not used": found.other_size,
            "found by the other finder": found.by_fallback,
            "right corners turned to agree": found.reordered,
        }
        lines += [f"{what}: {escaped(', '.join(names), 400)}" for what, names in lists.items() if names]
    if result.excluded:
        lines.append(f"left out: {escaped(', '.join(result.excluded), 400)}")
    lines += [f"warning: {warning}" for warning in result.warnings]
    return "\n".join(lines)


def detection_text(found: Detection) -> str:
    """What `detect` found, as a table of statuses."""
    from tvsbayes.spots import REASONS

    rows = [[status, str(count), REASONS.get(status.split(" ")[0], "")] for status, count in found.statuses.items()]
    rows += [["undetected", str(found.missing), "no frames"]] if found.missing else []
    rows += [["as it was", str(found.kept), "refused by somebody else"]] if found.kept else []
    noise = ", ".join(
        f"{side} contrast {one.speckle_contrast:.2f}, gain {one.gain_dn:.3f} DN" for side, one in found.noise.items()
    )
    sd = (
        ""
        if found.median_sd_px is None
        else f"median standard uncertainty of a coordinate {found.median_sd_px:.3f} px; "
    )
    title = f"{found.processed} looks"
    return f"{text_table(title, ['status', 'looks', 'meaning'], rows)}\nmethod {found.method}; {sd}noise: {noise}"


def estimate_row(label: str, estimate: Estimate | None, unit: str) -> list[str]:
    """Cells of one quantity: value(u), unit, interval, and whether data or prior set it."""
    if estimate is None:
        return [label, "never moved", unit, "", ""]
    origin = "fixed" if estimate.contraction is None else ("data" if estimate.informed else "prior")
    interval = interval_text(*estimate.interval95, estimate.sd)
    return [label, concise(estimate.value, estimate.sd), unit, interval, origin]


def fit_text(summary: FitSummary) -> str:
    """The joint estimator's table and everything the reader must know about it."""
    pose = summary.reference_pose_deg
    rows = [estimate_row(f"effective {d}", summary.effective[d], "deg/step") for d in DIRECTIONS]
    for axis, label in (("pan", "left - right"), ("tilt", "up - down")):
        if summary.contrasts[axis] is not None:
            rows.append(estimate_row(label, summary.contrasts[axis], "deg/step"))
    rows += [estimate_row(label, summary.parameters[name], unit) for name, label, unit in KEY_PARAMETERS]
    kind = {"laplace": "Laplace", "posterior": "posterior"}[summary.estimator]
    title = f"joint estimator ({kind}) at pan {pose['pan']:.2f} deg, tilt {pose['tilt']:.2f} deg"
    lines = [text_table(title, ["quantity", "value(u)", "unit", "95 % interval", "set by"], rows)]
    lines.append(f"chi2 {summary.chi2:.1f} for {summary.dof:.1f} degrees of freedom")
    predicted = [f"{d} {concise(e.value, e.sd)}" for d, e in summary.classic_predicted.items() if e is not None]
    if predicted:
        lines.append(f"the classic estimator should report, deg/step: {', '.join(predicted)}")
    if summary.sampling is not None:
        lines.append(sampling_line(summary.sampling))
    if summary.curves is not None:
        lines += lost_motion_lines(summary.curves["lost_motion"])
    for entry in summary.prior_sensitivity:
        word = "twice" if entry.factor > 1 else "half"
        lines.append(
            f"prior: with {word} the u of {entry.parameter}, {entry.quantity} moves {entry.shift_sd:+.2f} sd and its "
            f"sd changes by a factor {entry.sd_ratio:.2f}"
        )
    lines += [f"weak: {weak.text}" for weak in summary.weak_directions]
    lines += [f"leverage: {entry.text}" for entry in summary.leverage]
    lines += [f"prior conflict: {text}" for text in summary.prior_conflicts]
    if summary.excluded_spots:
        lines.append(f"excluded spots: {', '.join(map(str, summary.excluded_spots))}")
    if summary.suspect_spots:
        listed = ", ".join(map(str, summary.suspect_spots[:20]))
        lines.append(f"spots that disagree with all others: {listed}; look at them, or fit with --robust")
    return "\n".join(lines)


def sampling_line(sampling: dict[str, object]) -> str:
    """What stands behind a posterior, in one line."""
    rhat, ess, tail = (sampling[k] for k in ("worst_rhat", "least_ess_bulk", "least_ess_tail"))
    text = f"{sampling['walkers']} walkers, {sampling['steps']} steps ({sampling['discarded']} left out); worst R-hat "
    text += f"{rhat['value']:.3f} ({rhat['quantity']}), least effective draws {ess['value']:.0f} "
    text += f"({ess['quantity']}) and {tail['value']:.0f} in the tails ({tail['quantity']})"
    return text if sampling["converged"] else f"UNCONVERGED, the table is Laplace's: {text}"


def lost_motion_lines(lost: dict[str, list[dict[str, float]]]) -> list[str]:
    """Lost motion after a reversal, for the step counts that were used."""
    return [
        f"lost motion {direction}, deg: "
        + ", ".join(f"{e['steps']} steps {concise(e['value_deg'], e['sd_deg'])}" for e in entries)
        for direction, entries in lost.items()
    ]


def demo_text(classic_result: ClassicResult, summary: FitSummary, truth: dict[str, float]) -> str:
    """Both estimators beside the truth of a simulated campaign."""

    def holds(interval, true):
        return "-" if interval is None else ("yes" if interval[0] <= true <= interval[1] else "NO")

    rows = []
    for direction in DIRECTIONS:
        c, j = classic_result.directions[direction], summary.effective[direction]
        if c is None or j is None:
            continue
        true = truth[direction]
        shown = concise(c.mean_deg_per_step, c.u_type_a_deg_per_step or 0.0)
        cells = [direction, shown, holds(c.interval95_type_a, true), concise(j.value, j.sd)]
        rows.append([*cells, holds(j.interval95, true), f"{true:.6f}"])
    columns = ["deg/step", "classic, type A", "holds truth", "joint", "holds truth", "truth"]
    ratios = text_table("degrees of beam per motor step, value(u)", columns, rows)
    rows = []
    for name, label, unit in KEY_PARAMETERS[:3]:
        e, true = summary.parameters[name], truth[name]
        rows.append([f"{label}, {unit}", concise(e.value, e.sd), holds(e.interval95, true), f"{true:.4f}"])
    others = text_table("what the classic estimator cannot see", ["", "joint", "holds truth", "truth"], rows)
    return f"{ratios}\n\n{others}"


def fit_document(
    fit: JointFit, summary: FitSummary, seed: int, draws: Derived, evidence: Mapping[str, object] | None = None
) -> dict[str, object]:
    """The content of `results/fit.json` (DESIGN 7): estimates, covariance of `draws` with names, provenance.

    `evidence` adds what reports show besides: residuals by cause, the gap to the classic estimator.
    """
    names = list(summary.parameters)
    packages = ("tvsbayes", "jax", "optimistix", "equinox", "emcee", "arviz", "numpy", "scipy")
    packages += ("opencv-python-headless",)
    estimated = [index for index, name in enumerate(fit.names) if name in names]
    covariance = np.cov(draws.physical[:, estimated], rowvar=False)
    return {
        "format": FIT_FORMAT,
        **summary.as_json(),
        "covariance": {"names": [fit.names[i] for i in estimated], "matrix": covariance.tolist()},
        **(evidence or {}),
        "inputs": input_hashes(fit.campaign),
        "versions": {"python": sys.version.split()[0], **{name: version(name) for name in packages}},
        "seed": seed,
        "command": shlex.join(["tvsbayes", *sys.argv[1:]]),
    }


def write_results(
    fit: JointFit,
    summary: FitSummary,
    folder: Path,
    seed: int,
    calibration: Calibration | None = None,
    draws: Derived | None = None,
    evidence: Mapping[str, object] | None = None,
) -> dict[str, str]:
    """Write `fit.json` and `draws.npz`, each whole or not at all.

    Args:
        fit: the fit.
        summary: what is said of it.
        folder: is made where it does not exist.
        seed: of everything random.
        calibration: what `locate` and `steps-for` read back; None for a fit that must not be used.
        draws: behind the summary, one leading axis; None for the Laplace approximation's.
        evidence: further keys of `fit.json`, see `fit_document`.

    Returns:
        Paths by "fit" and "draws".

    Raises:
        InputError: the folder cannot be written.
    """
    draws = fit.draws if draws is None else draws
    arrays = {
        "names": np.array(fit.names),
        "estimator": np.array(summary.estimator),
        "physical": draws.physical,
        "effective_deg_per_step": draws.effective_deg_per_step,
        "reference_pose_rad": fit.reference_pose_rad,
    }
    if calibration is None:
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        content = buffer.getvalue()
    else:
        del arrays["estimator"]
        content = calibration_bytes(calibration, **arrays)
    document = json.dumps(fit_document(fit, summary, seed, draws, evidence), indent=1, allow_nan=False)
    contents = {"draws": ("draws.npz", content), "fit": ("fit.json", document.encode())}
    make_folder(folder)
    for name, data in contents.values():
        write_atomically(folder / name, data)
    return {key: str(folder / name) for key, (name, _) in contents.items()}


def locations_text(found: Locations) -> str:
    """Points with their uncertainty."""
    rows = []
    for index, error in enumerate(found.refused):
        if error is not None:
            rows.append([str(index), f"refused: {error.code}", "", "", "", ""])
            continue
        sd = np.sqrt(np.diag(found.covariance_mm2[index]))
        cells = [concise(float(x), float(u)) for x, u in zip(found.xyz_mm[index], sd, strict=True)]
        half = " ".join(f"{u:.2g}" for u in found.u95_mm[index])
        held = int(found.digits_held[index].min())
        verdict = f"validated at {held} digit{'s' * (held > 1)}" if held else "not validated"
        rows.append([str(index), *cells, half, verdict])
    columns = ["point", "x(u) mm", "y(u) mm", "z(u) mm", "U95 mm", "linear propagation"]
    return text_table(f"frame T, {found.draws} draws ({found.estimator})", columns, rows)


def budget_text(budget: Budget) -> str:
    """Uncertainty budget of a point: causes by share, then the parameters that contribute most."""
    order = np.argsort(-budget.share)
    rows = []
    for k in order[budget.share[order] >= 0.0005]:
        parts = [f"{np.sqrt(v):.3g}" for v in budget.variance_mm2[k]]
        rows.append([budget.causes[k], f"{100 * budget.share[k]:.1f}", *parts])
    causes = text_table("uncertainty by cause", ["cause", "share %", "u(x) mm", "u(y) mm", "u(z) mm"], rows)
    size = np.linalg.norm(budget.contribution_mm, axis=1)
    rows = [
        [budget.parameters[k], *(f"{v:+.3g}" for v in budget.contribution_mm[k])]
        for k in np.argsort(-size)[:10]
        if size[k] > 0
    ]
    title = "by parameter, one standard uncertainty each (correlated: they do not add up)"
    return f"{causes}\n\n{text_table(title, ['parameter', 'x mm', 'y mm', 'z mm'], rows)}"


def steps_text(steps: Steps) -> str:
    """Counters, the way there, and what remains."""
    pan, tilt = steps.approach
    lines = [
        f"go to      pan {steps.via_pan_steps}, tilt {steps.via_tilt_steps} steps (takes up the backlash)",
        f"then to    pan {steps.pan_steps}, tilt {steps.tilt_steps} steps, moving {pan} and {tilt}",
    ]
    if steps.xyz_mm is not None:
        half = ", ".join(f"{u:.2g}" for u in steps.u95_mm)
        lines.append(f"whole steps leave {steps.rounding_mm:.3g} mm; beam there +- ({half}) mm (95 %)")
        lines.append(f"the aperture should read {steps.aperture_deg:.3f} deg")
    else:
        half = ", ".join(f"{u:.2g}" for u in steps.u95_deg)
        lines.append(f"whole steps leave {steps.rounding_deg:.3g} deg; azimuth and elevation +- ({half}) deg (95 %)")
    return "\n".join(lines)


def gap_text(gaps: dict[str, Gap | None]) -> str:
    """The gap between both estimators by its terms."""
    found = {direction: gap for direction, gap in gaps.items() if gap is not None}
    rows = [
        ["classic mean", *(f"{gap.classic:.6f}" for gap in found.values())],
        ["effective ratio (joint)", *(concise(gap.joint.value, gap.joint.sd) for gap in found.values())],
        ["classic - joint", *(signed(gap.total) for gap in found.values())],
    ]
    for number, term in enumerate(next(iter(found.values())).terms):
        rows.append([f"  {term.name}", *(signed(gap.terms[number]) for gap in found.values())])
    return text_table("why the classic differs from the joint, deg/step, value(u)", ["", *found], rows)


def signed(term: GapTerm) -> str:
    """A difference with its sign, value(u)."""
    text = concise(term.value, term.sd)
    return text if text.startswith("-") else f"+{text}"


def hold_out_text(held: HoldOut) -> str:
    """Who foretells left-out angles better, and what no hold-out can see."""
    lines = []
    if held.classic is not None:
        rows = [
            [
                name,
                f"{score.rms_deg:.3f}",
                f"{score.rms_block_deg:.3f}",
                f"{100 * score.coverage:.0f} %",
                f"{score.log_density:+.2f}",
            ]
            for name, score in (("classic", held.classic), ("joint", held.joint))
        ]
        title = f"angles of {len(held.predictions)} experiments left out by {held.by}, deg"
        columns = ["", "rms error", "rms of block means", "inside 95 %", "log density"]
        lines.append(text_table(title, columns, rows))
    lines.append(f"held-out angles: {held.verdict}: {held.reason}")
    common = ", ".join(f"{d} {u:.1e}" for d, u in held.unseen.items())
    lines.append(f"not seen by any hold-out, common to all spots: u by stereo and focal scale, deg/step: {common}")
    return "\n".join(lines)


def changes_text(comparison: Comparison) -> str:
    """Two calibrations of one instrument."""
    rows = []
    for c in comparison.changes:
        cells = [c.quantity, f"{c.first:.6f}", f"{c.second:.6f}", concise(c.difference, c.u), c.unit]
        normalised = "fixed" if c.normalised is None else f"{c.normalised:+.2f}"
        rows.append([*cells, normalised, "yes" if c.significant else "no"])
    pan, tilt = comparison.reference_pose_deg
    title = f"A and B at pan {pan:.2f} deg, tilt {tilt:.2f} deg"
    table = text_table(title, ["quantity", "A", "B", "B - A (u)", "unit", "normalised", "significant"], rows)
    days = "" if comparison.days is None else f" in {comparison.days:.1f} days"
    cameras = "the same stereo calibration: its error is left out of u" if comparison.shared_cameras else "two cameras"
    return f"{table}\n{comparison.verdict}{days} (limit {comparison.limit:.2f} u for all together; {cameras})"
