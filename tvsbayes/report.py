"""What people and programs get to see of an estimate: text tables, `value(u)`, `results/`, the HTML report.

Formats only; every number is computed elsewhere. Units are those of DESIGN 8. The report is one page: no script,
nothing fetched. Text of a campaign reaches it through jinja2's autoescape only; pictures are SVG inside `data:`
images, which browsers open without scripts and without network. Its policy (CSP) allows exactly its own style sheet,
by hash, and such images.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import math
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from rich.console import Console
from rich.table import Table
from rich.text import Text

from tvsbayes import plots
from tvsbayes.calibration import CONTRACTION_LIMIT, Calibration, Steps, calibration_bytes, mode_arrays
from tvsbayes.campaign import input_hashes
from tvsbayes.certificate import FIGURES, traceability
from tvsbayes.classic import DIRECTIONS, ClassicResult
from tvsbayes.files import InputError, escaped, listed, make_folder, shipped_data, write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tvsbayes.comparison import Budget, Comparison, Evidence, Gap, GapTerm, HoldOut
    from tvsbayes.coordinates import Locations
    from tvsbayes.device.spots import Detection
    from tvsbayes.device.stereo import StereoCalibration
    from tvsbayes.information import Estimate, FitSummary
    from tvsbayes.joint import Derived, JointFit
    from tvsbayes.rigs import Stereo

FIT_FORMAT = "tvsbayes-fit/1"
SPOTS_LISTED = 20
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


def two_digits(value: float) -> str:
    """An uncertainty to two significant digits, without an exponent (GUM 7.2.6)."""
    return np.format_float_positional(value, precision=2, fractional=False, trim="-")


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
    from tvsbayes.device.spots import REASONS

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
    if not summary.converged and summary.sampling is None:
        return astray_text(summary)
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
    if summary.validation is not None:
        told = validation_lines(summary.validation.as_json())
        lines += told
        if not summary.validation.passed:
            # Above and below the table: who reads either end of the text must meet it.
            lines.insert(0, told[0])
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
    if summary.few_stops:
        lines.append(few_stops_line(summary.few_stops, summary.estimator))
    lines += [f"weak: {weak.text}" for weak in summary.weak_directions]
    lines += [f"leverage: {entry.text}" for entry in summary.leverage]
    lines += [f"prior conflict: {text}" for text in summary.prior_conflicts]
    if summary.excluded_spots:
        lines.append(f"excluded spots: {', '.join(map(str, summary.excluded_spots))}")
    if summary.suspect_spots:
        lines.append(f"{suspect_line(summary.suspect_spots)}; look at them, or fit with --robust")
    return "\n".join(lines)


def astray_text(summary: FitSummary) -> str:
    """Where a fit that did not converge stopped: values without uncertainty, for whoever looks for the reason."""
    rows = [[label, f"{summary.parameters[name].value:.4g}", unit] for name, label, unit in KEY_PARAMETERS]
    table = text_table("where the fit stopped: NOT results", ["quantity", "value", "unit"], rows)
    lines = [f"NOT CONVERGED: {'; '.join(summary.problems)}", table]
    if summary.suspect_spots:
        lines.append(suspect_line(summary.suspect_spots))
    return "\n".join(lines)


def suspect_line(spots: Sequence[int]) -> str:
    """Spots that others foretell badly, at most `SPOTS_LISTED` by their ids."""
    return f"spots that disagree with all others: {listed(spots, SPOTS_LISTED)}"


def few_stops_line(few: Mapping[str, int], estimator: str) -> str:
    """What few stops of a direction do to its intervals."""
    named = ", ".join(f"{direction} {count}" for direction, count in few.items())
    told = f"few stops ({named}): they hardly tell their own scatter"
    if estimator == "posterior":
        return f"{told}; the intervals hold it, more stops would shorten them"
    told += ", and the Laplace intervals of ratio and backlash are too short"
    return f"{told}; sample the posterior (fit without --no-sample), or add stops"


def validation_lines(validation: Mapping[str, object]) -> list[str]:
    """What the residuals say of the model: one line where they agree, else the warning and every test that failed.

    Args:
        validation: the entry of `fit.json`.
    """
    tests = validation["tests"]
    if validation["passed"]:
        if not tests:
            return ["validation: nothing can be asked of so few spots"]
        least = f"least p {tests[0]['p']:.2g} ({tests[0]['name']})"
        return [
            f"validation: no sign of a model error in {len(tests)} tests, {least}; shapes that gears, mirrors and "
            "play can take themselves are not seen"
        ]
    warning = f"VALIDATION FAILED: {validation['cause']} (p {tests[0]['p']:.1e}); the table is as fitted, multiply "
    warning += f"every u and half-width in it by {validation['inflation']:.2f}"
    return [
        warning,
        *(
            f"validation: {t['name']}, {t['where']}: chi2 {t['chi2']:.1f} for {t['dof']}, p {t['p']:.1e}; would move a "
            f"headline by {t['shift_sd']:.1f} of its u"
            for t in tests
            if t["failed"]
        ),
    ]


def sampling_line(sampling: dict[str, object]) -> str:
    """What stands behind a posterior, in one line."""
    rhat, ess, tail = (sampling[k] for k in ("worst_rhat", "least_ess_bulk", "least_ess_tail"))
    text = f"{sampling['walkers']} walkers, {sampling['steps']} steps ({sampling['discarded']} left out); worst R-hat "
    text += f"{rhat['value']:.3f} ({rhat['quantity']}), least effective draws {ess['value']:.0f} "
    text += f"({ess['quantity']}) and {tail['value']:.0f} in the tails ({tail['quantity']})"
    return text if sampling["converged"] else f"UNCONVERGED, the table is Laplace's: {text}"


def lost_motion_lines(lost: dict[str, list[dict[str, float]]]) -> list[str]:
    """Lost motion after a reversal, for the step counts that were used."""
    lines = []
    for direction, entries in lost.items():
        told = []
        for text, group in groupby(entries, lambda e: concise(e["value_deg"], e["sd_deg"])):
            steps = [e["steps"] for e in group]
            told.append(f"{steps[0]} {f'to {steps[-1]} ' * (len(steps) > 1)}steps {text}")
        lines.append(f"lost motion {direction}, deg: {', '.join(told)}")
    return lines


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
        content = calibration_bytes(calibration, **arrays, **mode_arrays(fit.stored))
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
        half = " ".join(map(two_digits, found.u95_mm[index]))
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
        half = ", ".join(map(two_digits, steps.u95_mm))
        lines.append(f"whole steps leave {steps.rounding_mm:.3g} mm; beam there +- ({half}) mm (95 %)")
        lines.append(f"the aperture should read {steps.aperture_deg:.3f} deg")
    else:
        half = ", ".join(map(two_digits, steps.u95_deg))
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


CORRELATED = (
    *("degrees_per_step.pan", "degrees_per_step.tilt", "backlash_deg.pan", "backlash_deg.tilt"),
    *("mirror_offset_mm", "tilt_zero_deg", "laser_tilt_deg.x", "laser_tilt_deg.y", "focal_scale"),
)
"""Parameters of the correlation matrix, in order; those that were not estimated are left out."""
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "msedge")
PDF_SECONDS = 120
SHARE_SHOWN = 5e-4
"""Of a variance: smaller ones print as 0.0 %."""
ESTIMATORS = {"laplace": "Laplace approximation at the mode", "posterior": "posterior sampled by emcee"}


@dataclass(frozen=True)
class TableView:
    """A table of ready text; the first cell of a row is its header, and `pairs` have no other."""

    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    @property
    def pairs(self) -> bool:
        """Names with their values."""
        return not self.columns


@dataclass(frozen=True)
class FigureView:
    """A picture with what it says in words."""

    source: str
    alt: str
    caption: str
    width: int
    height: int


@dataclass(frozen=True)
class Section:
    """A part of the report."""

    title: str
    text: Sequence[str] = ()
    items: Sequence[str] = ()
    tables: Sequence[TableView | None] = ()
    figures: Sequence[FigureView | None] = ()


@dataclass(frozen=True)
class Number:
    """One of the three numbers at the top."""

    label: str
    value: str
    note: str


@dataclass(frozen=True)
class Page:
    """What the template is filled with."""

    report_id: str
    name: str
    verdict: str
    verdict_class: str
    numbers: Sequence[Number]
    criteria: TableView | None
    traceable: str
    warnings: Sequence[str]
    versions: Mapping[str, str]
    sections: Sequence[Section] = field(default_factory=tuple)


def find_browser() -> str:
    """The program that prints pages.

    Raises:
        InputError: none is installed.
    """
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        message = f"--pdf needs one of {', '.join(BROWSERS)} on the path"
        raise InputError("no-browser", message, remedy="print the page from any browser (A4)")
    return browser


def print_to_pdf(page: Path) -> Path:
    """Print a report with an installed Chromium or Chrome; the PDF lies beside it.

    Raises:
        InputError: none is installed, or it failed.
    """
    browser = find_browser()
    target = page.with_suffix(".pdf")
    remedy = f"open {page} in any browser and print it to PDF (A4)"
    with tempfile.TemporaryDirectory(prefix="tvsbayes-") as scratch:
        printed = Path(scratch) / "report.pdf"
        flags = ["--headless", "--disable-gpu", "--no-first-run", "--disable-background-networking", "--disable-sync"]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            # Chromium's own walls cannot be built by root; the page is ours and holds no script.
            flags.append("--no-sandbox")
        flags += ["--no-pdf-header-footer", "--generate-pdf-document-outline", f"--user-data-dir={scratch}/profile"]
        command = [browser, *flags, f"--print-to-pdf={printed}", page.resolve().as_uri()]
        try:
            done = subprocess.run(command, capture_output=True, timeout=PDF_SECONDS, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise InputError("pdf", f"{Path(browser).name} did not print the report", remedy=remedy) from error
        if done.returncode or not printed.exists():
            raise InputError("pdf", f"{Path(browser).name} ended with code {done.returncode}", remedy=remedy)
        write_atomically(target, printed.read_bytes())
    return target


def report_html(evidence: Evidence) -> bytes:
    """The report, UTF-8.

    Args:
        evidence: computed beforehand; nothing is computed here.
    """
    folder = shipped_data() / "report"
    environment = Environment(
        loader=FileSystemLoader(str(folder)), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    page = _page(evidence)
    css = (folder / "report.css").read_text(encoding="utf-8").replace("@ID@", page.report_id)
    digest = base64.b64encode(hashlib.sha256(css.encode()).digest()).decode()
    policy = f"default-src 'none'; img-src data:; style-src 'sha256-{digest}'; base-uri 'none'; form-action 'none'"
    # The style sheet is ours; escaped quotes would change its hash.
    html = environment.get_template("report.html").render(r=page, css=Markup(css), policy=policy)
    return html.encode()


def figure_view(figure: Figure, alt: str, caption: str) -> FigureView:
    """A figure as SVG in a `data:` address; the same figure gives the same bytes."""
    width, height = (round(96 * inch) for inch in figure.get_size_inches())
    picture = base64.b64encode(plots.svg(figure)).decode()
    return FigureView(f"data:image/svg+xml;base64,{picture}", alt, caption, width, height)


def _page(e: Evidence) -> Page:
    fit = e.fit
    inputs = fit["inputs"]
    report_id = (
        hashlib.sha256(
            repr((sorted(inputs.items()), fit["seed"], fit["versions"], fit["effective_deg_per_step"])).encode()
        )
        .hexdigest()[:12]
        .upper()
    )
    header = e.campaign.header
    verdict, kind = _verdict(e)
    sections = [
        _setup(e),
        _results(e),
        _identifiability(e),
        _residuals(e),
        _validation(e),
        _maps(e),
        _budgets(e),
        _axes(e),
        _plan(e),
        _method(e),
        _limits(e),
    ]
    rows = [[c.quantity, f"{c.limit:.3g} {c.unit}", f"{c.probability:.3f}", c.verdict] for c in e.criteria]
    criteria = None
    if rows:
        caption = "Decision rule: met if P(|error| <= limit) >= 0.95, not met if <= 0.05, else cannot tell"
        criteria = TableView(caption, ["error of", "limit", "probability", "verdict"], rows)
    return Page(
        report_id=report_id,
        name=str(header.get("name") or "campaign without a name"),
        verdict=verdict,
        verdict_class=kind,
        numbers=_numbers(e),
        criteria=criteria,
        traceable=traceability(e.campaign).statement,
        warnings=_warnings(e),
        versions=fit["versions"],
        sections=sections,
    )


def _verdict(e: Evidence) -> tuple[str, str]:
    """One line, and the class that colours it."""
    if not e.fit["converged"]:
        return "NOT CONVERGED: the numbers below must not be used", "not-met"
    validation = e.fit.get("validation")
    failed = "" if validation is None or validation["passed"] else validation_lines(validation)[0] + ". "
    if failed and not e.criteria:
        return f"{failed}No limit was stated", "cannot-tell"
    if not e.criteria:
        return (
            (
                "No limit was stated: the results below are without a verdict (state one with "
                "--limit-deg-per-step or --limit-mm)"
            ),
            "cannot-tell",
        )
    told = []
    for verdict in ("not met", "cannot tell", "met"):
        mine = [c for c in e.criteria if c.verdict == verdict]
        limits = dict.fromkeys((c.limit, c.unit) for c in mine)
        for limit, unit in limits:
            part = [c for c in mine if (c.limit, c.unit) == (limit, unit)]
            least = min(c.probability for c in part)
            names = ", ".join(c.quantity for c in part)
            told.append((verdict, f"{verdict}: {names} within {limit:.3g} {unit} (P at least {least:.3f})"))
    text = "; ".join(sentence for _, sentence in told)
    judged = "With that factor: " if failed else ""
    return failed + judged + text[0].upper() + text[1:], told[0][0].replace(" ", "-")


def _numbers(e: Evidence) -> list[Number]:
    """Worst ratio, how far off the classic is, millimetres at the stated range."""
    ratios = {d: x for d, x in e.fit["effective_deg_per_step"].items() if x is not None}
    numbers = []
    if ratios:
        half = {d: 0.5 * (x["interval95"][1] - x["interval95"][0]) for d, x in ratios.items()}
        worst = max(half, key=half.get)
        x, u = ratios[worst], half[worst]
        note = f"effective deg/step; 95 % interval +- {two_digits(u)}" if x["sd"] > 0 else "fixed"
        factor = (e.fit.get("validation") or {}).get("inflation", 1.0)
        if factor > 1:
            note += f"; validation failed: use {factor:.2f} times that, {two_digits(factor * u)}"
        numbers.append(Number(f"least certain ratio: {worst}", concise(x["value"], x["sd"]), note))
    if e.classic is not None and ratios:
        off = {
            d: 100 * (r.mean_deg_per_step / ratios[d]["value"] - 1)
            for d, r in e.classic.directions.items()
            if r is not None and d in ratios
        }
        if off:
            worst = max(off, key=lambda d: abs(off[d]))
            numbers.append(Number(f"classic mean, {worst}", f"{off[worst]:+.1f} %", "away from the joint estimate"))
    if len(numbers) < 2:
        numbers.append(Number("classic mean", "not applicable", "no complete four-point experiment"))
    joint = e.distances_mm["joint"]
    others = ", ".join(f"{name} {_mm(np.quantile(v, 0.95))}" for name, v in e.distances_mm.items() if name != "joint")
    note = f"95 % of 3D errors stay below this; {others}"
    numbers.append(Number(f"joint, {e.range_mm:g} mm away", _mm(np.quantile(joint, 0.95)), note))
    return numbers


def _mm(value: float) -> str:
    return f"{two_digits(value)} mm" if value < 100 else f"{value:.0f} mm"


def _warnings(e: Evidence) -> list[str]:
    found = [str(text) for text in e.fit["problems"]]
    validation = e.fit.get("validation")
    if validation is not None and not validation["passed"]:
        found += validation_lines(validation)
    if e.fit["estimator"] == "laplace":
        found.append(
            "Intervals are those of the Laplace approximation at the mode; with few stops of a direction that of the "
            "backlash is too short. The command fit without --no-sample samples the posterior."
        )
    if e.campaign.header.get("synthetic"):
        found.append("The campaign is synthetic: made by the digital twin, not measured.")
    if e.campaign.stereo.assumed:
        found.append("The stereo calibration's covariance is assumed, not estimated.")
    found += [f"Prior conflict: {text}" for text in e.fit["prior_conflicts"]]
    if e.fit.get("few_stops"):
        line = few_stops_line(e.fit["few_stops"], str(e.fit["estimator"]))
        found.append(f"{line[0].upper()}{line[1:]}.")
    if e.fit["suspect_spots"]:
        line = suspect_line(e.fit["suspect_spots"])
        found.append(f"{line[0].upper()}{line[1:]}.")
    return found


def _setup(e: Evidence) -> Section:
    campaign, header = e.campaign, e.campaign.header
    ok = sum(spot.status == "ok" for spot in campaign.spots)
    targets = sorted({spot.target for spot in campaign.spots if spot.target})
    rows = [
        [label, str(header[key])]
        for key, label in (
            *(
                ("instrument", "instrument"),
                ("serial", "serial number"),
                ("operator", "operator"),
                ("method", "method"),
            ),
            *(("created", "measured or made"), ("notes", "notes")),
        )
        if header.get(key)
    ]
    rows += [
        ["moves, segments", f"{len(campaign.moves)}, {1 + campaign.moves[-1].segment}"],
        ["spots used, in all", f"{ok - len(e.fit['excluded_spots'])}, {len(campaign.spots)}"],
        ["placements of the sheet", ", ".join(targets) or "not named"],
    ]
    environment = header.get("environment") or {}
    for key, unit in (("temperature_degC", "degC"), ("humidity_percent", "%")):
        stated = environment.get(key)
        if stated:
            rows.append([key.split("_")[0], f"{stated['value']:g} {unit}, u = {stated['u']:g} {unit}"])
    parameters = e.fit["parameters"]
    names = [f"extrinsics.translation_mm.{a}" for a in "xyz"]
    where = [parameters[n]["value"] for n in names] if all(n in parameters for n in names) else None
    baseline = campaign.rig.priors["baseline_mm"].value
    figures = [
        figure_view(
            plots.setup(campaign, where, baseline),
            "Positions of cameras, positioner and spots from above and from the side; the coordinates are in spots.csv "
            "and in the table of results",
            "The rig as estimated, frame S: left camera at the origin, X depth, Y left, Z up.",
        ),
        figure_view(
            plots.coverage(campaign),
            "Counters at which spots were seen, and where the spots lie in both images",
            "Data coverage. What lies outside of it is extrapolated.",
        ),
    ]
    return Section("Set-up and data", tables=[TableView("What was measured", [], rows)], figures=figures)


def _results(e: Evidence) -> Section:
    ratios, rows = e.fit["effective_deg_per_step"], []
    for direction in DIRECTIONS:
        joint = ratios.get(direction)
        classic = None if e.classic is None else e.classic.directions[direction]
        row = [direction]
        if joint is None:
            row += ["never moved", "", ""]
        else:
            low, high = joint["interval95"]
            row += [
                concise(joint["value"], joint["sd"]),
                interval_text(low, high, joint["sd"]),
                two_digits(0.5 * (high - low)),
            ]
        if e.classic is None:
            row += ["not applicable", ""]
        elif classic is None:
            row += ["no experiment", ""]
        else:
            row += [concise(classic.mean_deg_per_step, classic.u_gum_deg_per_step or 0.0), str(classic.n)]
        rows.append(row)
    pose = e.fit["reference_pose_deg"]
    columns = ["direction", "joint value(u)", "95 % interval", "half of it", "classic value(u)", "n"]
    caption = (
        f"Effective degrees of the beam per motor step at pan {pose['pan']:.2f} deg, tilt {pose['tilt']:.2f} "
        "deg, deg/step"
    )
    tables = [TableView(caption, columns, rows), _parameters(e)]
    joint_view = {d: None if x is None else (x["value"], tuple(x["interval95"])) for d, x in ratios.items()}
    classic_view = {}
    if e.classic is not None:
        classic_view = {
            d: None if r is None else (r.mean_deg_per_step, r.interval95_gum) for d, r in e.classic.directions.items()
        }
    figures = [
        figure_view(
            plots.intervals(joint_view, classic_view),
            "Ratios of both estimators with 95 % intervals; values in the table above",
            "Effective ratios, joint (circles) and classic (triangles).",
        )
    ]
    text = [
        (
            "value(u): the digits in brackets are the standard uncertainty in units of the last "
            "place, or with their decimal point the uncertainty itself."
        )
    ]
    if e.classic is None:
        text.append("Classic: not applicable, the campaign has no complete four-point experiment.")
    else:
        for direction in DIRECTIONS:
            result = e.classic.directions[direction]
            if result is None:
                continue
            joint = ratios.get(direction)
            alt = f"{result.n} experiments moving {direction}: mean {result.mean_deg_per_step:.6f} deg/step"
            if result.sd_deg_per_step is not None:
                alt += f", standard deviation {result.sd_deg_per_step:.6f}"
            pair = None if joint is None else (joint["value"], joint["sd"])
            figures.append(
                figure_view(
                    plots.direction_scatter(e.classic, direction, pair),
                    alt,
                    f"Experiments moving {direction}, with the mean and bands of 1, 2 and 3 sigma.",
                )
            )
    gaps = e.fit.get("gap")
    if gaps:
        tables.append(_gap_table(gaps))
        figures.append(
            figure_view(
                plots.gap_terms(gaps),
                "Terms of the difference between both estimators; values in the table above",
                "Why the classic differs from the joint.",
            )
        )
    if e.fit.get("curves"):
        figures.append(
            figure_view(
                plots.ratio_curves(e.fit["curves"]["effective_deg_per_step"]),
                "Effective ratios over the range of pan and tilt angles; values in fit.json",
                "Effective ratios over the range that was seen.",
            )
        )
    return Section("Results, classic beside joint", text, tables=tables, figures=figures)


def _gap_table(gaps: Mapping[str, Mapping[str, object] | None]) -> TableView:
    found = {d: g for d, g in gaps.items() if g is not None}
    names = [term["name"] for term in next(iter(found.values()))["terms"]]

    def cell(term: Mapping[str, float]) -> str:
        text = concise(term["value"], term["sd"])
        return text if text.startswith("-") else f"+{text}"

    rows = [["classic - joint", *(cell(g["total"]) for g in found.values())]]
    rows += [[name, *(cell(g["terms"][k]) for g in found.values())] for k, name in enumerate(names)]
    return TableView("The gap between both estimators by its terms, deg/step", ["term", *found], rows)


def _parameters(e: Evidence) -> TableView:
    rows = []
    for name, x in e.fit["parameters"].items():
        if name.startswith("stereo.") or x["sd"] == 0:
            continue
        set_by = "" if x["contraction"] is None else ("data" if x["contraction"] >= CONTRACTION_LIMIT else "prior")
        contraction = "" if x["contraction"] is None else f"{x['contraction']:.2f}"
        diagnosis = "" if x["rhat"] is None else f"{x['rhat']:.3f}"
        rows.append(
            [
                name,
                concise(x["value"], x["sd"]),
                interval_text(*x["interval95"], x["sd"]),
                f"{x['prior_sd']:.2g}",
                contraction,
                set_by,
                diagnosis,
            ]
        )
    columns = ["parameter", "value(u)", "95 % interval", "u of the prior", "contraction", "set by", "R-hat"]
    return TableView("Parameters of the joint model; the unit is in the name", columns, rows)


def _identifiability(e: Evidence) -> Section:
    covariance = e.fit["covariance"]
    names, matrix = covariance["names"], np.array(covariance["matrix"])
    kept = [n for n in CORRELATED if n in names and matrix[names.index(n), names.index(n)] > 0]
    figures, rows = [], []
    if len(kept) > 1:
        index = [names.index(n) for n in kept]
        part = matrix[np.ix_(index, index)]
        sd = np.sqrt(np.diag(part))
        correlation = part / np.outer(sd, sd)
        for i in range(len(kept)):
            for j in range(i):
                if abs(correlation[i, j]) > 0.8:
                    rows.append([f"{kept[j]} and {kept[i]}", f"{correlation[i, j]:+.3f}"])
        figures.append(
            figure_view(
                plots.correlations(kept, correlation),
                "Correlation matrix; every cell holds its value in per cent",
                "Correlations of the posterior.",
            )
        )
    items = [w["text"] for w in e.fit["weak_directions"]] + [entry["text"] for entry in e.fit["leverage"]]
    sensitive = [
        [
            f"{x['parameter']}, {'twice' if x['factor'] > 1 else 'half'} its u",
            x["quantity"],
            f"{x['shift_sd']:+.2f}",
            f"{x['sd_ratio']:.2f}",
        ]
        for x in e.fit["prior_sensitivity"]
    ]
    text = []
    if not items:
        text.append("Every direction that matters is set by the data; no single stop rules a headline.")
    caption = "Headlines that another prior would move: by how many of their sds, and the factor on the sd"
    columns = ["prior", "headline", "shift, sd", "sd, factor"]
    priors = TableView(caption, columns, sensitive) if sensitive else None
    table = TableView("Correlations beyond 0.8", ["parameters", "correlation"], rows) if rows else None
    return Section("What the data tell apart", text, items, [table, priors], figures)


def _residuals(e: Evidence) -> Section:
    causes = e.fit.get("residual_causes") or []
    noise = e.fit["noise"]
    text = [
        (
            f"chi-square {noise['chi2']:.1f} for {noise['dof']:.1f} degrees of freedom; the pixel "
            f"noise is {noise['pixel_scale']:.2f} times the stated one."
        )
    ]
    rows = [
        [
            f"{c['axis']}: {c['name']}",
            str(len(c["groups"])),
            "not tested" if c["p"] is None else f"{c['p']:.3f}",
            "SUSPICIOUS" if c["suspicious"] else "" if c["p"] is None else "no sign",
        ]
        for c in causes
    ]
    tables = (
        [TableView("Do the deviations of the stops depend on ...", ["cause", "groups", "p", "verdict"], rows)]
        if rows
        else []
    )
    groups = [
        [f"{c['axis']}, {c['name']}: {g['label']}", str(g["count"]), f"{g['mean']:+.2f}", f"{g['standard_error']:.2f}"]
        for c in causes
        for g in c["groups"]
        if len(c["groups"]) > 1
    ]
    if groups:
        tables.append(
            TableView(
                "Mean deviation of stops in units of its standard deviation",
                ["group", "count", "mean", "standard error"],
                groups,
            )
        )
    figures = []
    for axis in ("pan", "tilt"):
        if any(c["axis"] == axis for c in causes):
            alt = f"Mean deviation by group, {axis} axis; values in the table above"
            figures.append(figure_view(plots.causes(causes, axis), alt, f"{axis} axis: mean deviation by group."))
        stops = [x for x in e.fit.get("residuals") or [] if x["axis"] == axis]
        if stops:
            figures.append(
                figure_view(
                    plots.residuals(stops, axis),
                    (
                        f"Deviations of {len(stops)} stops of the {axis} axis over time and counter; "
                        "group means in the table above"
                    ),
                    f"Stops of the {axis} axis: observed minus fitted angle.",
                )
            )
    return Section("Residuals by cause", text, tables=tables, figures=figures)


def _validation(e: Evidence) -> Section:
    text, items, tables = [], [], []
    validation = e.fit.get("validation")
    if validation is None:
        text.append("The results hold no tests for model errors: run the command fit again.")
    else:
        text.append(
            f"A clean campaign fails the tests below with a probability of {100 * validation['level']:g} %, all "
            f"together. Factor on every u: {validation['inflation']:.2f}."
        )
        tables.append(_tests(validation))
    sampling = e.fit.get("sampling")
    if sampling is None:
        text.append("The posterior was not sampled: intervals are those of the Laplace approximation.")
    else:
        worst, bulk, tail = (sampling[k] for k in ("worst_rhat", "least_ess_bulk", "least_ess_tail"))
        text.append(
            f"{sampling['walkers']} walkers, {sampling['steps']} steps; worst R-hat {worst['value']:.3f} "
            f"({worst['quantity']}); least effective draws {bulk['value']:.0f} in the bulk "
            f"({bulk['quantity']}) and {tail['value']:.0f} in the tails ({tail['quantity']})."
        )
        items += [f"UNCONVERGED: {sentence}" for sentence in sampling["missing"]]
    predicted = e.fit.get("classic_predicted_deg_per_step") or {}
    rows = []
    if e.classic is not None:
        for direction in DIRECTIONS:
            told, seen = predicted.get(direction), e.classic.directions[direction]
            if told is not None and seen is not None:
                spread = np.hypot(told["sd"], seen.u_type_a_deg_per_step or 0.0)
                z = (seen.mean_deg_per_step - told["value"]) / spread if spread > 0 else 0.0
                rows.append(
                    [
                        direction,
                        concise(told["value"], told["sd"]),
                        concise(seen.mean_deg_per_step, seen.u_type_a_deg_per_step or 0.0),
                        f"{z:+.1f}",
                    ]
                )
    if rows:
        tables.append(
            TableView(
                "What the joint model says the classic estimator should report, and what it reports, deg/step",
                ["direction", "foretold", "reported, type A", "difference / u"],
                rows,
            )
        )
    if e.held_out is None:
        text.append(
            "Held-out experiments: not computed; run the command compare on the campaign and make the report again."
        )
    else:
        text.append(_held_out(e.held_out["held_out"], tables))
    return Section("Validation", text, items, tables)


def _held_out(held: Mapping[str, object], tables: list[TableView]) -> str:
    """Its tables are appended; the verdict is returned."""
    if held["classic"] is not None:
        rows = [
            [
                name,
                f"{held[name]['rms_deg']:.3f}",
                f"{held[name]['rms_block_deg']:.3f}",
                f"{100 * held[name]['coverage']:.0f} %",
            ]
            for name in ("classic", "joint")
        ]
        tables.append(
            TableView(
                "Angles of experiments that were left out, deg",
                ["estimator", "rms error", "rms of block means", "inside 95 % intervals"],
                rows,
            )
        )
    rows = [[d, f"{u:.1e}"] for d, u in held["unseen"].items()]
    tables.append(
        TableView(
            "What no hold-out sees: u by stereo calibration and focal scale, common to all spots, deg/step",
            ["direction", "u"],
            rows,
        )
    )
    return f"Held-out experiments: {held['verdict']}: {held['reason']}."


def _tests(validation: Mapping[str, object]) -> TableView:
    """Every test for a model error, the least p first."""
    rows = [
        [
            t["name"],
            t["where"],
            f"{t['chi2']:.1f}",
            str(t["dof"]),
            f"{t['p']:.2g}",
            "FAILED" if t["failed"] else "no sign",
        ]
        for t in validation["tests"]
    ]
    columns = ["sign of", "most at", "chi-square", "degrees of freedom", "p, all places", "verdict"]
    return TableView("Tests for errors that the model does not have", columns, rows)


def _maps(e: Evidence) -> Section:
    figures = []
    middle = len(e.maps.pan_steps) // 2, len(e.maps.tilt_steps) // 2
    rows = []
    for k, reach in enumerate(e.maps.range_mm):
        rows.append([f"{reach:g}", *(_cell(e.maps.rms_mm[name][middle][k]) for name in e.maps.rms_mm)])
    for k, reach in enumerate(e.maps.range_mm):
        figures.append(
            figure_view(
                plots.error_maps(e.maps, k),
                f"Root mean square error over pan and tilt at {reach:g} mm; every cell holds its value in mm",
                f"3D error at {reach:g} mm, root mean square over the rigs that the data allow.",
            )
        )
    at = f"pan {e.maps.pan_steps[middle[0]]:.0f}, tilt {e.maps.tilt_steps[middle[1]]:.0f} steps"
    table = TableView(f"Root mean square 3D error in mm at {at}, by range in mm", ["range", *e.maps.rms_mm], rows)
    text = [
        (
            "Nominal and classic users are given a baseline shortened by the mirror offset and "
            "moved by half of it; noise of one look is included for all."
        )
    ]
    at_middle = {name: values[middle] for name, values in e.maps.rms_mm.items()}
    if "nominal" in at_middle:
        worse = np.flatnonzero(at_middle["joint"] >= at_middle["nominal"])
        if len(worse):
            text.append(_no_better(e, [f"{e.maps.range_mm[k]:g}" for k in worse]))
    return Section("Errors in 3D", text, tables=[table], figures=figures)


def _no_better(e: Evidence, ranges_mm: Sequence[str]) -> str:
    """Why a calibration may place points no better than the nominal rig: what the campaign could not tell."""
    text = f"At {', '.join(ranges_mm)} mm the joint calibration places points no better than the nominal one"
    if e.budget is not None:
        largest = int(np.argmax(e.budget.share))
        text += f": {e.budget.causes[largest]} makes up {100 * e.budget.share[largest]:.0f} % of its variance"
        text += f" at {e.range_mm:g} mm"
    if not any(spot.aperture_deg is not None for spot in e.campaign.spots):
        text += "; the campaign has no aperture readings, which tell the range of a point"
    return f"{text}."


def _cell(value: float) -> str:
    return "no point" if not np.isfinite(value) else two_digits(value) if value < 10 else f"{value:.0f}"


def _budgets(e: Evidence) -> Section:
    tables, figures = [], []
    tables += [_gum_table(table) for table in e.fit["budgets"]]
    if e.budget is not None:
        u = np.sqrt(e.budget.variance_mm2)
        order = np.argsort(-e.budget.share)
        rows = [
            [e.budget.causes[k], f"{100 * e.budget.share[k]:.1f}", *map(two_digits, u[k])]
            for k in order
            if e.budget.share[k] >= SHARE_SHOWN
        ]
        tables.append(
            TableView(
                f"Budget of a point {e.range_mm:g} mm away, by cause",
                ["cause", "share %", "u(x) mm", "u(y) mm", "u(z) mm"],
                rows,
            )
        )
        figures.append(
            figure_view(
                plots.shares(e.budget),
                "Shares of the variance by cause; values at the bars and in the table above",
                f"What the uncertainty of a point {e.range_mm:g} mm away consists of.",
            )
        )
    if e.point is not None:
        tables.append(_gum_table(e.point.as_json(), f"{e.range_mm:g} mm away: "))
    return Section("Uncertainty budgets", tables=tables, figures=figures)


def _gum_table(table: Mapping[str, object], prefix: str = "") -> TableView:
    """A budget as GUM 7.2.7 asks for it; sources that matter to no digit are counted in one line."""
    shown = [row for row in table["rows"] if row["u"] is None or abs(row["share"]) >= SHARE_SHOWN]
    rows = [
        [
            row["quantity"],
            row["kind"],
            row["distribution"],
            "" if row["u"] is None else two_digits(row["u"]),
            _freedom(row["dof"]) if row["u"] is not None else "",
            _blank(row["sensitivity"], ".3g"),
            "" if row["contribution"] is None else two_digits(row["contribution"]),
            f"{100 * row['share']:.1f}",
        ]
        for row in shown
    ]
    if len(shown) < len(table["rows"]):
        rest = [row["share"] for row in table["rows"] if row not in shown]
        rows.insert(-1, [f"{len(rest)} smaller ones", "", "", "", "", "", "", f"{100 * sum(rest):.1f}"])
    caption = (
        f"{prefix}{table['quantity']}: {concise(table['estimate'], table['u'])} {table['unit']}; effective degrees of "
        f"freedom {_freedom(table['dof'])}, k = {table['coverage_factor']:.2f}, "
        f"p = {100 * table['probability']:.0f} %, U = {two_digits(table['expanded'])} {table['unit']}"
    )
    if any(row["share"] > 1 for row in shown):
        # GUM 5.2.2: with correlated inputs the cross terms are as real as the squares.
        caption += "; the inputs are correlated: single shares exceed 100 %, the row of correlations takes them back"
    columns = ["source", "type", "distribution", "u", "dof", "sensitivity", "contribution", "share %"]
    return TableView(caption, columns, rows)


def _blank(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def _freedom(dof: float | None) -> str:
    return "infinite" if dof is None else f"{dof:.0f}"


def _axes(e: Evidence) -> Section:
    tables, items = [], []
    for axis in e.fit["positioning"]:
        rows = [
            [
                " ".join(reversed(FIGURES[name])),
                f"{p['median']:.4f}",
                f"[{p['interval95'][0]:.4f}, {p['interval95'][1]:.4f}]",
                "" if axis["plug_in"] is None else _blank(axis["plug_in"].get(name), ".4f"),
            ]
            for name, p in (axis["predicted"] or {}).items()
        ]
        if rows:
            caption = (
                f"{axis['axis']} axis, deg: predicted for {axis['runs']} runs per side at {len(axis['target_steps'])} "
                "targets, and as the campaign's own stops have it"
            )
            tables.append(TableView(caption, ["figure", "median", "95 % interval", "own stops"], rows))
        if axis["missing"]:
            items.append(f"{axis['axis']}, own stops: {axis['missing']}")
        items += [note for note in axis["notes"] if note not in items]
    text = [] if tables or items else ["Not computed: the fit has not converged."]
    return Section("ISO 230-2-style figures", text, items, tables)


def _plan(e: Evidence) -> Section:
    items = [w["text"] for w in e.fit["weak_directions"]]
    if e.planned is None:
        text = [
            "tvsbayes plan RIG --given CAMPAIGN weighs further experiments; a report made after it shows them here."
        ]
        return Section("What to measure next", text, items)
    plan, unit = e.planned, e.planned["target"]["unit"]
    stop = plan["stop"]
    text = [
        f"Wanted: {plan['target']['text']}; known now to {plan['now']:.2g} {unit}. "
        f"{'Stop measuring' if stop['now'] else 'Go on measuring'}: {stop['reason']}. Rule: {stop['rule']}.",
    ]
    if plan["limited_by"]["needed"]:
        text.append(plan["limited_by"]["needed"])
    rows = [
        [batch["text"], f"{batch['minutes']:.1f}", f"{batch['gain']:.2g}", f"{batch['gain_per_minute']:.2g}"]
        for batch in plan["next"]
    ]
    columns = ["four looks", "minutes", f"gain, {unit}", f"gain a minute, {unit}"]
    tables = [TableView("Next experiments, best first", columns, rows)] if rows else []
    return Section("What to measure next", text, items, tables=tables)


def _method(e: Evidence) -> Section:
    fit, header = e.fit, e.campaign.header
    text = [
        (
            "Joint model: two-mirror positioner with per-direction ratios, backlash, mirror offset "
            "and misalignments, seen by a calibrated stereo pair; all spots at once; stop errors "
            "integrated out; stereo calibration and focal scale uncertain within their stated "
            "covariance. Classic: the four-point method of doi 10.3390/metrology5040058."
        ),
        (
            f"Estimator: {ESTIMATORS[fit['estimator']]}. Intervals are equal-tailed "
            "(JCGM 101:2008, 5.3.3), coverage probability 95 %."
        ),
        f"Command: {fit['command']}. Seed {fit['seed']}.",
    ]
    stated = header.get("traceability") or {}
    rows = [["traceability", key, str(value)] for key, value in stated.items()]
    rows += [["sha256", name, str(value)] for name, value in fit["inputs"].items()]
    rows += [["version", name, str(value)] for name, value in fit["versions"].items()]
    table = TableView("Traceability as declared, inputs, versions", ["", "name", "value"], rows)
    return Section("Method, traceability, provenance", text, tables=[table])


def _limits(e: Evidence) -> Section:
    items = [
        (
            "The scale of all angles is that of the stereo calibration; an error of its board "
            "or of the focal length at the laser's wavelength beyond the stated uncertainty is "
            "in no residual."
        ),
        (
            "Baseline, C0 and aperture zero cannot be seen in spots: without aperture readings "
            "they are the user's statement."
        ),
        (
            "Results hold for the range of counters and depths that was seen, at the temperature "
            "of the campaign, moving slowly enough to lose no step."
        ),
        "Angles are inferred through cameras and model; no angle standard was compared.",
    ]
    return Section("Limitations", items=items)
